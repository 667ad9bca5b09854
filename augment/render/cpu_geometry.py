"""Numba functions: where eight Gaussians stand in the camera, and which ellipses they become."""

from __future__ import annotations

import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_jit import inner
from augment.render.layout import (
    V_BLUR,
    V_CENTRE,
    V_EYE,
    V_FOCAL,
    V_HIGH,
    V_LOW,
    V_PARALLEL,
    V_ROTATION,
    U,
)


@inner()
def gather3(array, picked, at):
    """Rows of a [N, 3] array."""
    first = v8.gather(array, picked, at, U(3), U(0))
    second = v8.gather(array, picked, at, U(3), U(1))
    return first, second, v8.gather(array, picked, at, U(3), U(2))


@inner()
def from_eye(means, picked, at, view):
    """Means minus the camera's centre, in the part's axes: first, so that digits are kept."""
    x, y, z = gather3(means, picked, at)
    x = x - v8.splat(view[V_EYE]) - v8.splat(view[V_EYE + 3])
    y = y - v8.splat(view[V_EYE + 1]) - v8.splat(view[V_EYE + 4])
    z = z - v8.splat(view[V_EYE + 2]) - v8.splat(view[V_EYE + 5])
    return x, y, z


@inner()
def dot(ax, ay, az, bx, by, bz):
    return v8.fmuladd(ax, bx, v8.fmuladd(ay, by, az * bz))


@inner()
def cross(a, b, scale):
    """The cross product of two triples, times a number."""
    return (
        (a[1] * b[2] - a[2] * b[1]) * scale,
        (a[2] * b[0] - a[0] * b[2]) * scale,
        (a[0] * b[1] - a[1] * b[0]) * scale,
    )


@inner()
def rotation_row(view, row):
    at = U(V_ROTATION) + U(3) * row
    return v8.splat(view[at]), v8.splat(view[at + U(1)]), v8.splat(view[at + U(2)])


@inner()
def to_camera(d, view):
    r, s, t = rotation_row(view, U(0)), rotation_row(view, U(1)), rotation_row(view, U(2))
    x = dot(r[0], r[1], r[2], d[0], d[1], d[2])
    y = dot(s[0], s[1], s[2], d[0], d[1], d[2])
    return x, y, dot(t[0], t[1], t[2], d[0], d[1], d[2])


@inner()
def inverse_divisor(z, view):
    """1 over what x and y are divided by in the projection: z, or 1 where rays are parallel."""
    one = np.float32(1)
    parallel = view[V_PARALLEL]
    return v8.splat(one) / v8.fmuladd(v8.splat(one - parallel), z, v8.splat(parallel))


@inner()
def to_image(x, y, inverse, view):
    x = v8.fmuladd(v8.splat(view[V_FOCAL]) * x, inverse, v8.splat(view[V_CENTRE]))
    return x, v8.fmuladd(v8.splat(view[V_FOCAL + 1]) * y, inverse, v8.splat(view[V_CENTRE + 1]))


@inner()
def semi_axes(quats, scales, picked, at, x, y, inverse, view):
    """Ellipsoids' axes in the image, px right (3) and down (3), and what they were made of: the
    scales (3), the Jacobian's rows times the view's rotation (3 and 3), the rotations (9).
    """
    r, s, t = rotation_row(view, U(0)), rotation_row(view, U(1)), rotation_row(view, U(2))
    u = v8.minimum(v8.maximum(x * inverse, v8.splat(view[V_LOW])), v8.splat(view[V_HIGH]))
    v = v8.minimum(v8.maximum(y * inverse, v8.splat(view[V_LOW + 1])), v8.splat(view[V_HIGH + 1]))
    fx, fy = v8.splat(view[V_FOCAL]) * inverse, v8.splat(view[V_FOCAL + 1]) * inverse
    jx = fx * (r[0] - u * t[0]), fx * (r[1] - u * t[1]), fx * (r[2] - u * t[2])
    jy = fy * (s[0] - v * t[0]), fy * (s[1] - v * t[1]), fy * (s[2] - v * t[2])
    m = rotation_from_quats(quats, picked, at)
    sizes = gather3(scales, picked, at)
    right = (
        sizes[0] * dot(jx[0], jx[1], jx[2], m[0], m[3], m[6]),
        sizes[1] * dot(jx[0], jx[1], jx[2], m[1], m[4], m[7]),
        sizes[2] * dot(jx[0], jx[1], jx[2], m[2], m[5], m[8]),
    )
    down = (
        sizes[0] * dot(jy[0], jy[1], jy[2], m[0], m[3], m[6]),
        sizes[1] * dot(jy[0], jy[1], jy[2], m[1], m[4], m[7]),
        sizes[2] * dot(jy[0], jy[1], jy[2], m[2], m[5], m[8]),
    )
    return right, down, sizes, jx, jy, m


@inner()
def image_covariance(quats, scales, picked, at, x, y, inverse, view):
    """xx, xy, yy in px^2, not blurred, and det / (yy + blur), of which no digits cancel."""
    right, down, _, _, _, _ = semi_axes(quats, scales, picked, at, x, y, inverse, view)
    x0, x1, x2 = right
    y0, y1, y2 = down
    xx, xy, yy = (
        dot(x0, x1, x2, x0, x1, x2),
        dot(x0, x1, x2, y0, y1, y2),
        dot(y0, y1, y2, y0, y1, y2),
    )
    # Lagrange's identity, det = |x cross y|^2, each term divided before it is squared.
    scale = v8.splat(np.float32(1)) / v8.sqrt(yy + v8.splat(view[V_BLUR]))
    c0, c1, c2 = cross(right, down, scale)
    return xx, xy, yy, dot(c0, c1, c2, c0, c1, c2)


@inner()
def rotation_from_quats(quats, picked, at):
    """Rotation matrices, row by row, of unit quaternions wxyz."""
    one, two = v8.splat(np.float32(1)), v8.splat(np.float32(2))
    w, x = v8.gather(quats, picked, at, U(4), U(0)), v8.gather(quats, picked, at, U(4), U(1))
    y, z = v8.gather(quats, picked, at, U(4), U(2)), v8.gather(quats, picked, at, U(4), U(3))
    return (
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    )
