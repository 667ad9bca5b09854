"""Builders of simple forms: rectangles, boxes, discs, tubes, blobs and meshes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapters.street.shapes import ALL_EDGES, OPEN_DIAGONAL, Kind, Look, Shapes, join, make_shapes


def _rows(values: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.atleast_2d(np.asarray(values, np.float64))


def parallelograms(
    origin: Sequence[float] | np.ndarray,
    u: Sequence[float] | np.ndarray,
    v: Sequence[float] | np.ndarray,
    look: Look,
    *,
    edges: np.ndarray | int = ALL_EDGES,
) -> Shapes:
    """Flat panels with corner `origin` and sides u, v ([3] or [P, 3]); they face u x v."""
    origin, u, v = np.broadcast_arrays(_rows(origin), _rows(u), _rows(v))
    normal = np.cross(u, v)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return make_shapes(Kind.PARALLELOGRAM, origin, np.stack([u, v, normal], 1), look, edges=edges)


def boxes(
    low: Sequence[float] | np.ndarray,
    high: Sequence[float] | np.ndarray,
    look: Look,
    *,
    faces: Sequence[str] = ("+x", "-x", "+y", "-y", "+z"),
    edges: int = ALL_EDGES,
) -> Shapes:
    """Axis-aligned boxes between corners low and high ([3] or [P, 3]); the named faces only."""
    low, high = np.broadcast_arrays(_rows(low), _rows(high))
    corners, us, vs = [], [], []
    for face in faces:
        axis, outward = "xyz".index(face[1]), face[0] == "+"
        first, second = ((axis + 1) % 3, (axis + 2) % 3)
        if not outward:
            first, second = second, first
        corner = low.copy()
        if outward:
            corner[:, axis] = high[:, axis]
        u, v = np.zeros_like(corner), np.zeros_like(corner)
        u[:, first] = (high - low)[:, first]
        v[:, second] = (high - low)[:, second]
        corners.append(corner)
        us.append(u)
        vs.append(v)
    sides = (np.concatenate(part) for part in (corners, us, vs))
    return parallelograms(*sides, look, edges=edges)


def disc(centre: Sequence[float], normal: Sequence[float], radius_m: float, look: Look) -> Shapes:
    """A flat round plate."""
    u, v, w = _frame(np.asarray(normal, np.float64))
    axes = np.stack([u * radius_m, v * radius_m, w])[None]
    return make_shapes(Kind.DISC, _rows(centre), axes, look)


def tube(
    start: Sequence[float],
    end: Sequence[float],
    radius_m: float,
    look: Look,
    *,
    caps: bool = False,
) -> Shapes:
    """A round tube between two points, with flat ends if asked."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    u, v, w = _frame(b - a)
    axes = np.stack([u * radius_m, v * radius_m, (b - a) / 2])[None]
    side = make_shapes(Kind.CYLINDER, _rows((a + b) / 2), axes, look)
    if not caps:
        return side
    return join([side, disc(b, w, radius_m, look), disc(a, -w, radius_m, look)])


def ellipsoids(centres: np.ndarray, axes: np.ndarray, look: Look) -> Shapes:
    """Ellipsoids with orthogonal semi-axes axes [P, 3, 3] (rows), metres."""
    return make_shapes(Kind.ELLIPSOID, _rows(centres), axes, look)


def ball(centre: Sequence[float], radii: Sequence[float], look: Look) -> Shapes:
    """One ellipsoid along the coordinate axes."""
    return ellipsoids(_rows(centre), np.diag(np.asarray(radii, np.float64))[None], look)


def quads(
    corners: np.ndarray, look: Look, *, normals: np.ndarray | None = None, edges: int = 0
) -> Shapes:
    """Four-sided panels [P, 4, 3], corners in turn, facing (c1 - c0) x (c3 - c0).

    Parallelograms stay whole; others become two triangles. normals [P, 4, 3]: shading normals at
    the corners, for panels of a smooth mesh.
    """
    corners = np.asarray(corners, np.float64)
    slack = np.abs(corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]).max(1)
    whole = slack < 1e-9
    if normals is not None:
        whole[:] = False
    parts = []
    if whole.any():
        c = corners[whole]
        parts.append(
            parallelograms(c[:, 0], c[:, 1] - c[:, 0], c[:, 3] - c[:, 0], look, edges=edges)
        )
    if not whole.all():
        c = corners[~whole]
        for (i, j, k), flag in (((0, 1, 3), 0), ((2, 3, 1), OPEN_DIAGONAL)):
            parts.append(_triangles(c[:, i], c[:, j], c[:, k], look, flag, normals, (i, j, k)))
    return join(parts)


def triangle(corners: np.ndarray, look: Look) -> Shapes:
    """One triangle [3, 3], facing (c1 - c0) x (c2 - c0)."""
    a, b, c = (np.asarray(corner, np.float64)[None] for corner in corners)
    return _triangles(a, b, c, look, 0, None, (0, 1, 2))


def _triangles(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    look: Look,
    flag: int,
    normals: np.ndarray | None,
    corner: tuple[int, int, int],
) -> Shapes:
    u, v = b - a, c - a
    w = np.cross(u, v)
    w = w / np.linalg.norm(w, axis=1, keepdims=True)
    shading = None
    if normals is not None:
        n0, n1, n2 = (normals[:, i] for i in corner)
        shading = np.stack([n0, n1 - n0, n2 - n0], 1)
    axes = np.stack([u, v, w], 1)
    return make_shapes(Kind.TRIANGLE, a, axes, look, edges=flag, shading=shading)


def _frame(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit u, v, w, right-handed, with w along the direction."""
    w = direction / np.linalg.norm(direction)
    helper = np.array([1.0, 0.0, 0.0]) if abs(w[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    u = np.cross(helper, w)
    u /= np.linalg.norm(u)
    return u, np.cross(w, u), w
