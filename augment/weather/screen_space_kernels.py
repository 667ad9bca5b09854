"""Numba kernels that march mirrored rays through a pyramid of the nearest depth.

The letters are those of `screen_space`, which defines the result. The pyramid holds inverse depths,
which are linear along a ray's image: a cell of level l is the largest of 2^l x 2^l pixels, 0 where
nothing stands. A ray whose own inverse depth stays above a cell's, all the way across it, is in
front of everything there and passes the cell at once.

shape [levels, 3]: rows, columns, and the index at which the level starts. view: the vertical in
the camera (3), its image N (3), fx, fy, cx, cy, and the eye's height over the water.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from augment.render.cpu_jit import inner, kernel

COVERED = np.float32(1 - 1 / 512)  # an alpha through which the water does not show
THICKNESS_M = np.float32(0.5)  # how thick anything is taken to be, at least,
THICKNESS = np.float32(0.05)  # and as a share of its depth
HIDDEN_PX = np.float32(64)  # a ray may run behind something for so long
NEAR_M = np.float32(0.05)  # rays coming back end so far from the camera's plane
AGREEING = np.float32(0.05)  # neighbours of one surface: relative difference of inverse depths
EDGE = np.float32(0.04)  # share of the image over which the weight falls to 0

_MAX_STEPS = 1024  # cells a ray may look at; streets need 30 on average
_NUDGE = np.float32(1e-3)  # pixels past a cell's border, against rounding
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_INFINITE = np.float32(math.inf)
# Ways (fractions of |x|) that one bilinear patch may hold: those of one surface.
_SMOOTH, _SMOOTH_M = np.float32(0.1), np.float32(0.25)


@kernel
def build_pyramid(alpha, depth, shape, pyramid):
    """Largest inverse depths, from the pixels down to a single cell."""
    height, width = alpha.shape
    for i in numba.prange(height):
        row = i * width
        for j in range(width):
            solid = alpha[i, j] >= _HALF
            pyramid[row + j] = _ONE / depth[i, j] if solid else _ZERO
    for level in range(1, len(shape)):
        rows, columns, start = shape[level]
        fine_rows, fine_columns, fine = shape[level - 1]
        for i in numba.prange(rows):
            above = fine + 2 * i * fine_columns
            below = above + fine_columns if 2 * i + 1 < fine_rows else above
            whole = fine_columns // 2
            for j in range(whole):
                pyramid[start + i * columns + j] = max(
                    max(pyramid[above + 2 * j], pyramid[above + 2 * j + 1]),
                    max(pyramid[below + 2 * j], pyramid[below + 2 * j + 1]),
                )
            if whole < columns:  # an odd column stands alone
                last = fine_columns - 1
                value = max(pyramid[above + last], pyramid[below + last])
                pyramid[start + i * columns + whole] = value


@inner()
def _back_side(surface):
    depth = _ONE / surface
    return _ONE / (depth + max(THICKNESS * depth, THICKNESS_M))


@inner()
def _difference(pyramid, here, before, has_before, after, has_after):
    """Change of the inverse depth per pixel, from those neighbours that belong to the surface."""
    total, count = _ZERO, _ZERO
    if has_after:
        change = pyramid[after] - here
        if abs(change) < AGREEING * here:
            total += change
            count += _ONE
    if has_before:
        change = here - pyramid[before]
        if abs(change) < AGREEING * here:
            total += change
            count += _ONE
    return total / max(count, _ONE)


@inner()
def _edge_weight(x, y, width, height):
    fx = min(max(min(x, width - x) / (EDGE * width), _ZERO), _ONE)
    fy = min(max(min(y, height - y) / (EDGE * height), _ZERO), _ONE)
    two, three = np.float32(2), np.float32(3)
    return fx * fx * (three - two * fx) * fy * fy * (three - two * fy)


@inner()
def _march(pyramid, shape, view, column, row):
    """(way / |x|, weight) of the ray mirrored at a pixel of the image that sees the water."""
    height, width = shape[0, 0], shape[0, 1]
    if row < 0 or row >= height or column < 0 or column >= width:
        return _INFINITE, _ZERO
    x0, y0 = np.float32(column) + _HALF, np.float32(row) + _HALF
    u, v = (x0 - view[8]) / view[6], (y0 - view[9]) / view[7]
    slope = u * view[0] + v * view[1] + view[2]
    gx, gy = view[3] - x0 * view[5], view[4] - y0 * view[5]
    g = max(max(abs(gx), abs(gy)), np.float32(1e-9))
    rise = np.float32(-2) * slope
    scale = rise * g
    bend = (_ONE + rise * view[2]) / scale
    near = -slope / view[10]
    dx, dy = gx / g, gy / g
    # A ray along an axis never gets to the other axis's next border.
    inverse_x = _ONE / dx if dx != _ZERO else np.float32(1e30)
    inverse_y = _ONE / dy if dy != _ZERO else np.float32(1e30)
    ahead_x, ahead_y = 1 if dx >= _ZERO else 0, 1 if dy >= _ZERO else 0
    w, h = np.float32(width), np.float32(height)
    end = min((w - x0 if ahead_x else -x0) * inverse_x, (h - y0 if ahead_y else -y0) * inverse_y)
    to_sky = False
    if bend < _ZERO:
        end = min(end, (_ONE - _ONE / (near * NEAR_M)) / bend)
    elif bend * end >= _ONE:
        end, to_sky = _ONE / bend, True
    # Nothing is met in the pixel that the ray starts from.
    t = _NUDGE + min(
        (np.float32(column + ahead_x) - x0) * inverse_x, (np.float32(row + ahead_y) - y0) * inverse_y
    )
    top = len(shape) - 1
    level = min(1, top)
    hidden, clean = _ZERO, True
    for _ in range(_MAX_STEPS):
        if t >= end:
            if to_sky and clean:
                return _INFINITE, _edge_weight(x0 + end * dx, y0 + end * dy, w, h)
            return _INFINITE, _ZERO
        cx = min(max(int(x0 + t * dx), 0), width - 1) >> level
        cy = min(max(int(y0 + t * dy), 0), height - 1) >> level
        border_x = np.float32((cx + ahead_x) << level)
        border_y = np.float32((cy + ahead_y) << level)
        leave = min(min((border_x - x0) * inverse_x, (border_y - y0) * inverse_y), end)
        leave = max(leave, t)
        k0, k1 = (_ONE - bend * t) * near, (_ONE - bend * leave) * near
        surface = pyramid[shape[level, 2] + cy * shape[level, 1] + cx]
        if surface == _ZERO or min(k0, k1) > surface:
            hidden = _ZERO
        elif level > 0:
            level -= 1
            continue
        elif max(k0, k1) >= _back_side(surface):
            way, at = _meet(pyramid, width, height, cx, cy, x0, y0, dx, dy, bend, near, end)
            weight = _edge_weight(x0 + at * dx, y0 + at * dy, w, h)
            return way / scale, weight
        else:
            clean = False
            hidden += leave - t
            if hidden > HIDDEN_PX:
                return _INFINITE, _ZERO
        t = leave + _NUDGE
        # Up only out of the parent: it has been looked into already.
        parent_x, parent_y = int(x0 + t * dx) >> (level + 1), int(y0 + t * dy) >> (level + 1)
        if level < top and (parent_x != cx >> 1 or parent_y != cy >> 1):
            level += 1
    return _INFINITE, _ZERO


@inner()
def _meet(pyramid, width, height, cx, cy, x0, y0, dx, dy, bend, near, end):
    """t / (1 - c t) and t where the ray meets the plane through the pixel, at most 1 px off it."""
    at = cy * width + cx
    here = pyramid[at]
    across = _difference(pyramid, here, at - 1, cx > 0, at + 1, cx + 1 < width)
    down = _difference(pyramid, here, at - width, cy > 0, at + width, cy + 1 < height)
    off_x, off_y = np.float32(cx) + _HALF - x0, np.float32(cy) + _HALF - y0
    closing = -bend * near - across * dx - down * dy
    middle = off_x * dx if abs(dx) >= abs(dy) else off_y * dy
    t = middle
    if closing != _ZERO:
        t = (here - across * off_x - down * off_y - near) / closing
    reach = np.float32(1.5)
    t = min(max(min(max(t, middle - reach), middle + reach), _ZERO), end)
    # Not farther than what was met, however the ray grazes it.
    return t / (max((_ONE - bend * t) * near, _back_side(here)) / near), t


@inner()
def _sees_water(view, alpha, column, row):
    """Whether the pixel's ray falls and the front leaves something of the water to see."""
    if 0 <= row < alpha.shape[0] and 0 <= column < alpha.shape[1] and alpha[row, column] >= COVERED:
        return False
    u = (np.float32(column) + _HALF - view[8]) / view[6]
    v = (np.float32(row) + _HALF - view[9]) / view[7]
    return u * view[0] + v * view[1] + view[2] < _ZERO


@inner()
def _surface_range(view, column, row):
    """|x|, metres from the eye to the water."""
    u = (np.float32(column) + _HALF - view[8]) / view[6]
    v = (np.float32(row) + _HALF - view[9]) / view[7]
    slope = u * view[0] + v * view[1] + view[2]
    return math.sqrt(_ONE + u * u + v * v) * view[10] / -slope


@kernel
def trace(pyramid, shape, view, alpha, left, top, stride, ways, weights):
    """Ways (in |x|) and weights of every `stride`-th pixel; weight -1 where no water shows."""
    for i in numba.prange(ways.shape[0]):
        row = top + i * stride
        for j in range(ways.shape[1]):
            column = left + j * stride
            way, weight = _INFINITE, np.float32(-1)
            if _sees_water(view, alpha, column, row):
                way, weight = _march(pyramid, shape, view, column, row)
            ways[i, j] = way
            weights[i, j] = weight


@kernel
def spread(pyramid, shape, view, alpha, left, top, stride, ways, weights, distance, weight):
    """Metres and weights of all pixels; the four traced around a pixel speak for it if they agree.

    Where they do not, at silhouettes and beside covered pixels, the pixel is traced itself.
    """
    height, width = distance.shape
    rows, columns = ways.shape
    part = _ONE / np.float32(stride)
    for i in numba.prange(rows):
        below = min(i + 1, rows - 1)
        for j in range(columns):
            right = min(j + 1, columns - 1)
            w00, w01, w10, w11 = ways[i, j], ways[i, right], ways[below, j], ways[below, right]
            t00, t01 = weights[i, j], weights[i, right]
            t10, t11 = weights[below, j], weights[below, right]
            least, most = min(min(w00, w01), min(w10, w11)), max(max(w00, w01), max(w10, w11))
            sure = min(min(t00, t01), min(t10, t11))
            doubt = max(max(t00, t01), max(t10, t11))
            same = sure >= _ZERO and (sure > _ZERO or doubt == _ZERO)
            infinite = least == _INFINITE
            if same and not infinite:
                r = _surface_range(view, left + j * stride, top + i * stride)
                same = most - least <= _SMOOTH * least + _SMOOTH_M / r
            for di in range(min(stride, height - i * stride)):
                fy = np.float32(di) * part
                y = i * stride + di
                for dj in range(min(stride, width - j * stride)):
                    fx = np.float32(dj) * part
                    x = j * stride + dj
                    way, trust = w00, t00
                    if not _sees_water(view, alpha, left + x, top + y):
                        way, trust = _INFINITE, _ZERO
                    elif same:
                        upper, lower = t00 + (t01 - t00) * fx, t10 + (t11 - t10) * fx
                        trust = upper + (lower - upper) * fy
                        if not infinite:
                            upper, lower = w00 + (w01 - w00) * fx, w10 + (w11 - w10) * fx
                            way = upper + (lower - upper) * fy
                    elif di > 0 or dj > 0:
                        way, trust = _march(pyramid, shape, view, left + x, top + y)
                    distance[y, x] = way * _surface_range(view, left + x, top + y)
                    weight[y, x] = trust
