"""Numba kernel: which points of the ground are seen by some camera."""

from __future__ import annotations

import math

import numba
import numpy as np
from numba import prange


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(view, x, y, z):
    """Column, row and depth of a world point; depth 0 where it is behind the camera."""
    x, y, z = x - view[12], y - view[13], z - view[14]
    depth = view[6] * x + view[7] * y + view[8] * z
    if depth < 0.1:
        return 0.0, 0.0, 0.0
    u, v = view[0] * x + view[1] * y + view[2] * z, view[3] * x + view[4] * y + view[5] * z
    if view[15] == 0.0:
        u, v = u / depth, v / depth
    return u * view[9] + view[10], v * view[11] + view[16], depth


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _farthest(depths, start, width, height, column, row):
    """The largest depth of three by three pixels."""
    deepest = np.float32(0)
    for k in range(max(0, row - 1), min(height, row + 2)):
        for m in range(max(0, column - 1), min(width, column + 2)):
            deepest = max(deepest, depths[start + k * width + m])
    return deepest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_there(view, depths, start, width, height, x, y, z, tolerances):
    """1 where the view shows something solid at the point, -1 where it looks through it, else 0."""
    u, v, depth = _project(view, x, y, z)
    if depth == 0.0 or u < 0 or v < 0 or u >= width or v >= height:
        return 0
    column, row = math.floor(u), math.floor(v)
    slack = depth * (tolerances[0] - 1.0) + tolerances[1]
    for k in range(max(0, row - 1), min(height, row + 2)):
        for m in range(max(0, column - 1), min(width, column + 2)):
            if abs(depths[start + k * width + m] - depth) <= slack:
                return 1
    return -1 if depths[start + row * width + column] > depth else 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_seen(view, depths, start, width, height, x, y, z, nx, ny, nz, lifts, tolerances):
    far_share, far_m, below_share, grazing, margin = tolerances
    for lift in lifts:
        top = z + lift
        u, v, depth = _project(view, x, y, top)
        if depth == 0.0:
            continue
        if u < -margin or v < -margin or u > width + margin or v > height + margin:
            continue
        column = min(max(math.floor(u), 0), width - 1)
        row = min(max(math.floor(v), 0), height - 1)
        if view[15] == 0.0:
            tx, ty, tz = view[12] - x, view[13] - y, view[14] - top
        else:
            tx, ty, tz = -view[6], -view[7], -view[8]
        facing = nx * tx + ny * ty + nz * tz
        if facing >= -grazing * math.sqrt(tx * tx + ty * ty + tz * tz):
            deepest = _farthest(depths, start, width, height, column, row)
            if depth <= deepest * far_share + far_m:
                return True
        elif lift > 0.0 and depth <= depths[start + row * width + column] * below_share:
            return True
    return False


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def find_seen(points, normals, is_sure, views, sizes, depths, lifts, tolerances, seen):
    """seen [C] bool: points [C, 3] that some view sees, at one of the lifts over them, and where no
    more views look through the point itself than show something there; is_sure [C]: this is known.

    views: float64 [V, 17]: rotation camera_from_world by rows, fx, cx, fy, centre, 1 where
    orthographic, cy. sizes: int64 [V, 3]: width, height, where its depths begin. depths: float32 of
    all views, infinite where nothing is. tolerances: a point that faces the view is seen up to the
    depth there times the first plus the second (metres); what shows only its underside up to the
    depth times the third; the fourth is the sine of the angle up to which a surface seen from
    behind counts as facing; the fifth, pixels beyond the image that count.
    """
    for i in prange(points.shape[0]):
        x, y, z = points[i]
        nx, ny, nz = normals[i]
        found, there = False, 0
        for view in range(views.shape[0]):
            width, height, start = sizes[view]
            if not is_sure[i]:
                there += _is_there(views[view], depths, start, width, height, x, y, z, tolerances)
            if not found and _is_seen(
                views[view],
                depths,
                start,
                width,
                height,
                x,
                y,
                z,
                nx,
                ny,
                nz,
                lifts,
                tolerances,
            ):
                found = True
            if found and is_sure[i]:
                break
        seen[i] = found and there >= 0
