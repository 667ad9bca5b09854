"""Triton functions: where Gaussians stand in the camera, and which ellipses they become.

A view is read through a pointer to its VIEW numbers (see layout); triples are tuples. Sums of
products name their fused multiply-adds, so that a splat has the same bits whatever else a kernel
computes beside it.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import layout

V_ROTATION = tl.constexpr(layout.V_ROTATION)
V_EYE = tl.constexpr(layout.V_EYE)
V_FOCAL = tl.constexpr(layout.V_FOCAL)
V_CENTRE = tl.constexpr(layout.V_CENTRE)
V_LOW, V_HIGH = tl.constexpr(layout.V_LOW), tl.constexpr(layout.V_HIGH)
V_PARALLEL = tl.constexpr(layout.V_PARALLEL)


@triton.jit
def floats_at(address):
    """The float32 array that starts at a memory address."""
    return address.to(tl.pointer_type(tl.float32))


@triton.jit
def three(pointer):
    """Three numbers, or three blocks of them, side by side in memory."""
    return tl.load(pointer), tl.load(pointer + 1), tl.load(pointer + 2)


@triton.jit
def three_where(pointer, mask):
    return (
        tl.load(pointer, mask, 0.0),
        tl.load(pointer + 1, mask, 0.0),
        tl.load(pointer + 2, mask, 0.0),
    )


@triton.jit
def four_where(pointer, mask):
    """Four numbers each, in one read of 16 bytes, at a multiple of which they begin."""
    places = tl.multiple_of(pointer[:, None] + tl.arange(0, 4)[None, :], (16, 16))
    numbers = tl.load(places, mask[:, None], 0.0)
    even, odd = tl.split(tl.reshape(numbers, (pointer.shape[0], 2, 2)))
    first, third = tl.split(even)
    second, fourth = tl.split(odd)
    return first, second, third, fourth


@triton.jit
def eight(a, b, c, d, e, f, g, h):
    """Eight blocks side by side, [B, 8]. The last pairing alternates fastest, the first slowest."""
    even = tl.join(tl.join(a, e), tl.join(c, g))
    odd = tl.join(tl.join(b, f), tl.join(d, h))
    return tl.reshape(tl.join(even, odd), (a.shape[0], 8))


@triton.jit
def dot(a, b):
    return tl.fma(a[0], b[0], tl.fma(a[1], b[1], a[2] * b[2]))


@triton.jit
def cross(a, b, scale):
    """The cross product of two triples, times a number."""
    return (
        tl.fma(a[1], b[2], -(a[2] * b[1])) * scale,
        tl.fma(a[2], b[0], -(a[0] * b[2])) * scale,
        tl.fma(a[0], b[1], -(a[1] * b[0])) * scale,
    )


@triton.jit
def from_eye(means, view):
    """Means minus the camera's centre, in the part's axes: first, so that digits are kept."""
    eye, rest = three(view + V_EYE), three(view + V_EYE + 3)
    return means[0] - eye[0] - rest[0], means[1] - eye[1] - rest[1], means[2] - eye[2] - rest[2]


@triton.jit
def rotation_rows(view):
    rows = view + V_ROTATION
    return three(rows), three(rows + 3), three(rows + 6)


@triton.jit
def inverse_divisor(z, view):
    """1 over what x and y are divided by in the projection: z, or 1 where rays are parallel."""
    parallel = tl.load(view + V_PARALLEL)
    return 1.0 / tl.fma(1.0 - parallel, z, parallel)


@triton.jit
def to_image(x, y, inverse, view):
    mean_x = tl.fma(tl.load(view + V_FOCAL) * x, inverse, tl.load(view + V_CENTRE))
    mean_y = tl.fma(tl.load(view + V_FOCAL + 1) * y, inverse, tl.load(view + V_CENTRE + 1))
    return mean_x, mean_y


@triton.jit
def rotation_columns(quats):
    """Columns of the rotation matrices of unit quaternions wxyz."""
    w, x, y, z = quats
    return (
        (
            tl.fma(-2.0, tl.fma(y, y, z * z), 1.0),
            2.0 * tl.fma(x, y, w * z),
            2.0 * tl.fma(x, z, -(w * y)),
        ),
        (
            2.0 * tl.fma(x, y, -(w * z)),
            tl.fma(-2.0, tl.fma(x, x, z * z), 1.0),
            2.0 * tl.fma(y, z, w * x),
        ),
        (
            2.0 * tl.fma(x, z, w * y),
            2.0 * tl.fma(y, z, -(w * x)),
            tl.fma(-2.0, tl.fma(x, x, y * y), 1.0),
        ),
    )


@triton.jit
def along_axes(direction, columns, sizes):
    """A direction's part along each semi-axis: columns of a rotation, and lengths."""
    return (
        sizes[0] * dot(direction, columns[0]),
        sizes[1] * dot(direction, columns[1]),
        sizes[2] * dot(direction, columns[2]),
    )


@triton.jit
def image_axes(x, y, inverse, columns, sizes, view):
    """Ellipsoids' semi-axes in the image, px right (3) and px down (3).

    Linearised at the splat's centre, or at the nearest point within the limits of the Jacobian.
    """
    r, s, t = rotation_rows(view)
    u = tl.minimum(tl.maximum(x * inverse, tl.load(view + V_LOW)), tl.load(view + V_HIGH))
    v = tl.minimum(tl.maximum(y * inverse, tl.load(view + V_LOW + 1)), tl.load(view + V_HIGH + 1))
    fx, fy = tl.load(view + V_FOCAL) * inverse, tl.load(view + V_FOCAL + 1) * inverse
    right = (
        fx * tl.fma(-u, t[0], r[0]),
        fx * tl.fma(-u, t[1], r[1]),
        fx * tl.fma(-u, t[2], r[2]),
    )
    down = (
        fy * tl.fma(-v, t[0], s[0]),
        fy * tl.fma(-v, t[1], s[1]),
        fy * tl.fma(-v, t[2], s[2]),
    )
    return along_axes(right, columns, sizes), along_axes(down, columns, sizes)
