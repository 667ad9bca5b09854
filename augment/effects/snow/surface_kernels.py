"""Numba kernels on grids of heights: smoothing, planes, which cells hang together, edges.

Grids are [H, W], rows towards +y. Each row's result depends on its inputs alone, so that bits do
not depend on threads. Sides are in the order -x, +x, -y, +y.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import inner, kernel, serial_kernel

# ---- Which points of the ground are seen by some camera ------------------------------------------


@inner()
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


@inner()
def _farthest(depths, size, column, row):
    """The largest depth of three by three pixels."""
    width, height, start = size
    deepest = np.float32(0)
    for k in range(max(0, row - 1), min(height, row + 2)):
        for m in range(max(0, column - 1), min(width, column + 2)):
            deepest = max(deepest, depths[start + k * width + m])
    return deepest


@inner()
def _is_there(view, depths, size, point, tolerances):
    """1 where the view shows something solid at the point, -1 where it looks through it, else 0."""
    width, height, start = size
    u, v, depth = _project(view, point[0], point[1], point[2])
    if depth == 0.0 or u < 0 or v < 0 or u >= width or v >= height:
        return 0
    column, row = math.floor(u), math.floor(v)
    slack = depth * (tolerances[0] - 1.0) + tolerances[1]
    for k in range(max(0, row - 1), min(height, row + 2)):
        for m in range(max(0, column - 1), min(width, column + 2)):
            if abs(depths[start + k * width + m] - depth) <= slack:
                return 1
    return -1 if depths[start + row * width + column] > depth else 0


@inner()
def _is_seen(view, depths, size, point, normal, lifts, tolerances):
    far_share, far_m, below_share, grazing, margin = tolerances
    width, height, start = size
    x, y, z = point
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
        facing = normal[0] * tx + normal[1] * ty + normal[2] * tz
        if facing >= -grazing * math.sqrt(tx * tx + ty * ty + tz * tz):
            if depth <= _farthest(depths, size, column, row) * far_share + far_m:
                return True
        elif lift > 0.0 and depth <= depths[start + row * width + column] * below_share:
            return True
    return False


@kernel
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
        point = (points[i, 0], points[i, 1], points[i, 2])
        normal = (normals[i, 0], normals[i, 1], normals[i, 2])
        found, there = False, 0
        for v in range(views.shape[0]):
            size = (sizes[v, 0], sizes[v, 1], sizes[v, 2])
            if not is_sure[i]:
                there += _is_there(views[v], depths, size, point, tolerances)
            found = found or _is_seen(views[v], depths, size, point, normal, lifts, tolerances)
            if found and is_sure[i]:
                break
        seen[i] = found and there >= 0


# ---- Which cells around a hole lie in one plane --------------------------------------------------

_ROUNDS = 4
_LINE = 1e-9  # of the extents' product: cells that spread less across are in a line


@serial_kernel
def find_plane(rows, columns, heights, first_m, alike_m, min_cells, used, fits):
    """Slopes per column and row of the plane of most of the cells, NaN where there is none.

    rows, columns: int64 [P]. heights: float64 [P]. Cells within first_m of the median of the
    heights are taken at first, then, round by round, those within alike_m of the last plane: at
    least `min_cells` of them, not in a line. used, fits: bool [P], what the last plane was fitted
    to and what lies in it.
    """
    median = np.median(heights)
    for p in range(len(heights)):
        fits[p] = abs(heights[p] - median) < first_m
    across = along = math.nan
    for _ in range(_ROUNDS):
        n = x = y = z = 0.0
        for p in range(len(heights)):
            used[p] = fits[p]
            if used[p]:
                n, x, y, z = n + 1.0, x + columns[p], y + rows[p], z + heights[p]
        if n < min_cells:
            return math.nan, math.nan
        x, y, z = x / n, y / n, z / n
        xx = xy = yy = xz = yz = 0.0
        for p in range(len(heights)):
            if used[p]:
                dx, dy, dz = columns[p] - x, rows[p] - y, heights[p] - z
                xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
                xz, yz = xz + dx * dz, yz + dy * dz
        determinant = xx * yy - xy * xy
        if determinant <= _LINE * (xx + yy) ** 2:
            return math.nan, math.nan
        across, along = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
        for p in range(len(heights)):
            level = z + across * (columns[p] - x) + along * (rows[p] - y)
            fits[p] = abs(heights[p] - level) < alike_m
    return across, along


# ---- The cells of a plan's tiles that lie under points -------------------------------------------


@serial_kernel
def find_numbers(xy, origin, side_m, tile_rows, tile_columns, sides, starts, numbers, out):
    """Numbers of the cells under points float64 [P, 2], into out int32 [P]; -1 where there is none.

    The tiles, row by row from origin: sides, starts: int64 [Y X], cells along each one's side and
    where it begins in numbers int32, a tile's cells row by row.
    """
    for p in range(xy.shape[0]):
        out[p] = -1
        x, y = (xy[p, 0] - origin[0]) / side_m, (xy[p, 1] - origin[1]) / side_m
        if not (x >= 0.0 and y >= 0.0 and x < tile_columns and y < tile_rows):  # NaN is nowhere
            continue
        column, row = math.floor(x), math.floor(y)
        tile = np.int64(row) * tile_columns + np.int64(column)
        side = sides[tile]
        if side > 0:
            i = min(np.int64((y - row) * side), side - 1)
            j = min(np.int64((x - column) * side), side - 1)
            out[p] = numbers[starts[tile] + i * side + j]


# ---- surface kernels -----------------------------------------------------------------------------

LINK, OPEN, RISES = 0, -1, -2  # what is on a cell's side; the last two are those of SnowCells

_LEFT, _RIGHT, _DOWN, _UP = 1, 2, 4, 8  # bits: neighbours on the same surface
_DOWN_LEFT, _DOWN_RIGHT, _UP_LEFT, _UP_RIGHT = 16, 32, 64, 128
_UNKNOWN = 1 << 30  # half cells to an edge that is not known yet


@kernel
def median_heights(height, covered, radius, out):
    """Median of the covered heights in squares of 2 radius + 1 cells, into out [H, W] float32."""
    rows, columns = height.shape
    for row in prange(rows):
        i = np.int64(row)  # unsigned, it would turn sums with signed numbers into floats
        found = np.empty((2 * radius + 1) ** 2, np.float32)
        for j in range(columns):
            out[i, j] = height[i, j]
            if not covered[i, j]:
                continue
            count = 0
            for k in range(max(0, i - radius), min(rows, i + radius + 1)):
                for m in range(max(0, j - radius), min(columns, j + radius + 1)):
                    if covered[k, m]:
                        value, at = height[k, m], count
                        while at > 0 and found[at - 1] > value:
                            found[at] = found[at - 1]
                            at -= 1
                        found[at] = value
                        count += 1
            upper = count // 2
            out[i, j] = found[upper]
            if count % 2 == 0:
                out[i, j] = np.float32(0.5) * (found[upper - 1] + found[upper])


@kernel
def fit_planes(height, covered, radius, cell, slack, steepest, height_slack, fitted, slopes, good):
    """A plane through each covered cell's surroundings: its height there and its slopes.

    Taken in are covered cells within radius whose height differs by at most slack + steepest times
    the distance; good [H, W] is false where they are too few or lie in a line. fitted: the plane's
    height, at most height_slack from the cell's own. slopes [H, W, 2]: dz/dx, dz/dy.
    """
    rows, columns = height.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            fitted[i, j] = height[i, j]
            slopes[i, j, 0] = slopes[i, j, 1] = 0.0
            good[i, j] = False
            if not covered[i, j]:
                continue
            n = sx = sy = sz = sxx = sxy = syy = sxz = syz = 0.0
            middle = float(height[i, j])
            for k in range(max(0, i - radius), min(rows, i + radius + 1)):
                for m in range(max(0, j - radius), min(columns, j + radius + 1)):
                    if not covered[k, m]:
                        continue
                    x, y, z = float(m - j), float(k - i), float(height[k, m]) - middle
                    if abs(z) > slack + steepest * cell * math.sqrt(x * x + y * y):
                        continue
                    n += 1.0
                    sx, sy, sz = sx + x, sy + y, sz + z
                    sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
                    sxz, syz = sxz + x * z, syz + y * z
            if 2.5 * n < (2 * radius + 1) ** 2:
                continue
            vxx, vxy, vyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
            vxz, vyz = sxz - sx * sz / n, syz - sy * sz / n
            determinant = vxx * vyy - vxy * vxy
            if determinant < 0.02 * (vxx + vyy) ** 2 or vxx + vyy <= 0.0:
                continue
            gx = (vyy * vxz - vxy * vyz) / determinant
            gy = (vxx * vyz - vxy * vxz) / determinant
            level = (sz - gx * sx - gy * sy) / n
            fitted[i, j] = middle + min(max(level, -height_slack), height_slack)
            slopes[i, j, 0], slopes[i, j, 1] = gx / cell, gy / cell
            good[i, j] = True


@kernel
def compare_sides(height, lowest, covered, can_carry, step, sides):
    """sides int8 [H, W, 4]: what follows on each side of the cells that can carry snow.

    lowest: float32 [H, W], least height around each cell. OPEN: nothing follows, or what lies
    lower by more than step, or carries none and leads down so far. RISES: what stands higher by
    more than step, or carries none and does not lead down. LINK: the same surface; beyond the grid,
    too. Others hold LINK.
    """
    rows, columns = height.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            for side in range(4):
                sides[i, j, side] = LINK
                if not can_carry[i, j]:
                    continue
                k, m = i, j
                if side < 2:
                    m += 2 * side - 1
                else:
                    k += 2 * side - 5
                if k < 0 or m < 0 or k >= rows or m >= columns:
                    continue
                if not covered[k, m]:
                    sides[i, j, side] = OPEN
                elif height[k, m] - height[i, j] > step:
                    sides[i, j, side] = RISES
                elif height[k, m] - height[i, j] < -step:
                    sides[i, j, side] = OPEN
                elif not can_carry[k, m]:
                    falls = lowest[k, m] - height[i, j] < -step
                    sides[i, j, side] = OPEN if falls else RISES


@kernel
def _find_links(can_carry, sides, links, offsets):
    """links uint8 [H, W]: bits of the neighbours beside, below and above that each cell is linked
    to. offsets int32 [H, W, 2]: x and y, in half cells, of its own open edge, or _UNKNOWN.
    """
    rows, columns = can_carry.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            links[i, j] = 0
            offsets[i, j, 0] = offsets[i, j, 1] = _UNKNOWN
            if not can_carry[i, j]:
                continue
            for side in range(4):
                if sides[i, j, side] == OPEN:
                    sign = 1 if side % 2 else -1
                    offsets[i, j, 0] = sign if side < 2 else 0
                    offsets[i, j, 1] = 0 if side < 2 else sign
            if j > 0 and sides[i, j, 0] == LINK and can_carry[i, j - 1]:
                links[i, j] |= _LEFT
            if j < columns - 1 and sides[i, j, 1] == LINK and can_carry[i, j + 1]:
                links[i, j] |= _RIGHT
            if i > 0 and sides[i, j, 2] == LINK and can_carry[i - 1, j]:
                links[i, j] |= _DOWN
            if i < rows - 1 and sides[i, j, 3] == LINK and can_carry[i + 1, j]:
                links[i, j] |= _UP


@inner()
def _leads(links, i, j, across, along):
    """Whether a cell hangs together with a diagonal neighbour, by way of one between them."""
    dx, dy = (-1 if across == _LEFT else 1), (-1 if along == _DOWN else 1)
    return (links[i, j] & across and links[i, j + dx] & along) or (
        links[i, j] & along and links[i + dy, j] & across
    )


@kernel
def _find_ways(links, ways):
    """ways uint8 [H, W]: the links, and the bits of diagonal neighbours that they lead to."""
    rows, columns = links.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            way = links[i, j]
            if _leads(links, i, j, _LEFT, _DOWN):
                way |= _DOWN_LEFT
            if _leads(links, i, j, _RIGHT, _DOWN):
                way |= _DOWN_RIGHT
            if _leads(links, i, j, _LEFT, _UP):
                way |= _UP_LEFT
            if _leads(links, i, j, _RIGHT, _UP):
                way |= _UP_RIGHT
            ways[i, j] = way


@inner()
def _nearer(offsets, k, m, dx, dy, x, y, square):
    """The edge at (x, y), in half cells, or that of the neighbour (k, m), which is (dx, dy) away,
    where that is nearer; with its distance squared.
    """
    if offsets[k, m, 0] == _UNKNOWN:
        return x, y, square
    x_there, y_there = np.int64(offsets[k, m, 0]) + dx, np.int64(offsets[k, m, 1]) + dy
    square_there = x_there * x_there + y_there * y_there
    if square_there < square:
        return x_there, y_there, square_there
    return x, y, square


@inner()
def _take(offsets, ways, i, j, straight, beside, dx, before, after, dy):
    """Let cell (i, j) take the nearest edge of those that its neighbours know: the one straight
    below or above (dy), the one beside it (dx), and the diagonal ones of the same row as the first.
    The bits of the ways there: straight, beside, before (to -x), after (to +x).
    """
    way = ways[i, j]
    if not way & (straight | beside | before | after):
        return
    own_x, own_y = np.int64(offsets[i, j, 0]), np.int64(offsets[i, j, 1])
    own = own_x * own_x + own_y * own_y
    x, y, square = own_x, own_y, own
    if way & straight:
        x, y, square = _nearer(offsets, i + dy, j, 0, 2 * dy, x, y, square)
    if way & beside:
        x, y, square = _nearer(offsets, i, j + dx, 2 * dx, 0, x, y, square)
    if way & before:
        x, y, square = _nearer(offsets, i + dy, j - 1, -2, 2 * dy, x, y, square)
    if way & after:
        x, y, square = _nearer(offsets, i + dy, j + 1, 2, 2 * dy, x, y, square)
    if square < own:
        offsets[i, j, 0], offsets[i, j, 1] = x, y


@inner()
def _sweep(ways, offsets):
    """Hand offsets on from row to row, up and down again, and along each row both ways."""
    rows, columns = ways.shape
    for i in range(rows):
        for j in range(columns):
            _take(offsets, ways, i, j, _DOWN, _LEFT, -1, _DOWN_LEFT, _DOWN_RIGHT, -1)
        for j in range(columns - 2, -1, -1):
            _take(offsets, ways, i, j, 0, _RIGHT, 1, 0, 0, 0)
    for i in range(rows - 1, -1, -1):
        for j in range(columns - 1, -1, -1):
            _take(offsets, ways, i, j, _UP, _RIGHT, 1, _UP_LEFT, _UP_RIGHT, 1)
        for j in range(1, columns):
            _take(offsets, ways, i, j, 0, _LEFT, -1, 0, 0, 0)


@kernel
def _distances(offsets, far, out):
    rows, columns = out.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            x, y = 0.5 * offsets[i, j, 0], 0.5 * offsets[i, j, 1]
            out[i, j] = min(math.sqrt(x * x + y * y), far)


@serial_kernel
def edge_distances(can_carry, sides, far, out):
    """Distance in cells from the middle of each cell to the nearest open edge of its own surface,
    into out [H, W] float32; at most far.

    Offsets to edges are handed from cell to cell (Danielsson 1980), along links only, in two
    sweeps there and back. In half cells they are whole numbers, and so exact.
    """
    links, ways = np.empty(can_carry.shape, np.uint8), np.empty(can_carry.shape, np.uint8)
    offsets = np.empty((can_carry.shape[0], can_carry.shape[1], 2), np.int32)
    _find_links(can_carry, sides, links, offsets)
    _find_ways(links, ways)
    for _ in range(2):
        _sweep(ways, offsets)
    _distances(offsets, far, out)
