"""Numba kernels on grids of heights: visibility, smoothing, planes, links between cells, edges.

`height_map`, `tiles`, `holes` and `surface` launch them. Grids are [H, W], rows towards +y. Each
row's result depends on its inputs alone, so that bits do not depend on threads. Sides are in the
order -x, +x, -y, +y.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel, kernel_function, serial_kernel

# ---- Points of the ground that some camera sees --------------------------------------------------


@kernel_function()
def _project(view, x, y, z):
    """Return column, row and depth of a world point; depth 0 where it is behind the camera."""
    x = x - view[12]
    y = y - view[13]
    z = z - view[14]
    depth = view[6] * x + view[7] * y + view[8] * z
    if depth < 0.1:
        return 0.0, 0.0, 0.0
    u = view[0] * x + view[1] * y + view[2] * z
    v = view[3] * x + view[4] * y + view[5] * z
    if view[15] == 0.0:
        u = u / depth
        v = v / depth
    return u * view[9] + view[10], v * view[11] + view[16], depth


@kernel_function()
def _max_depth_nearby(depths, size, column, row):
    """Return the largest depth of three by three pixels."""
    width, height, start = size
    deepest = np.float32(0)
    for k in range(max(0, row - 1), min(height, row + 2)):
        for m in range(max(0, column - 1), min(width, column + 2)):
            deepest = max(deepest, depths[start + k * width + m])
    return deepest


@kernel_function()
def _vote_for_point(view, depths, size, point, tolerances):
    """Return 1 if the view shows something at the point, -1 if it looks through it, else 0."""
    width, height, start = size
    u, v, depth = _project(view, point[0], point[1], point[2])
    if depth == 0.0 or u < 0 or v < 0 or u >= width or v >= height:
        return 0
    column = math.floor(u)
    row = math.floor(v)
    slack = depth * (tolerances[0] - 1.0) + tolerances[1]
    for k in range(max(0, row - 1), min(height, row + 2)):
        for m in range(max(0, column - 1), min(width, column + 2)):
            if abs(depths[start + k * width + m] - depth) <= slack:
                return 1
    return -1 if depths[start + row * width + column] > depth else 0


@kernel_function()
def _is_visible(view, depths, size, point, normal, lifts, tolerances):
    """Tell if a view sees a point at one of the lifts over it."""
    depth_share, depth_m, below_share, facing_sine, margin = tolerances
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
            tx = view[12] - x
            ty = view[13] - y
            tz = view[14] - top
        else:
            tx = -view[6]
            ty = -view[7]
            tz = -view[8]
        facing = normal[0] * tx + normal[1] * ty + normal[2] * tz
        if facing >= -facing_sine * math.sqrt(tx * tx + ty * ty + tz * tz):
            if depth <= _max_depth_nearby(depths, size, column, row) * depth_share + depth_m:
                return True
        elif lift > 0.0 and depth <= depths[start + row * width + column] * below_share:
            return True
    return False


@kernel
def find_visible(points, normals, is_sure, views, sizes, depths, lifts, tolerances, is_visible):
    """Find the points that some view sees, is_visible: bool [C].

    A point is visible at one of the lifts over it. It counts only where no more views look through
    the point itself than show something there, or where is_sure says that the surface is there.

    Args:
        points: float64 [C, 3], world.
        normals: float64 [C, 3], unit.
        is_sure: bool [C].
        views: float64 [V, 17]: rotation camera_from_world by rows, fx, cx, fy, centre, 1 where
            orthographic, cy.
        sizes: int64 [V, 3]: width, height, and where the view's depths begin.
        depths: float32, depths of all views, infinite where nothing is.
        lifts: float64, heights of a layer's top over the points, metres.
        tolerances: five numbers. A point that faces the view is visible up to the depth there times
            the first plus the second (metres); a point that shows only its underside up to the
            depth times the third. The fourth is the sine of the angle up to which a surface seen
            from behind counts as facing, the fifth the number of pixels beyond the image that
            count.
        is_visible: bool [C], written.
    """
    for i in prange(points.shape[0]):
        point = (points[i, 0], points[i, 1], points[i, 2])
        normal = (normals[i, 0], normals[i, 1], normals[i, 2])
        is_seen = False
        votes = 0
        for v in range(views.shape[0]):
            size = (sizes[v, 0], sizes[v, 1], sizes[v, 2])
            if not is_sure[i]:
                votes += _vote_for_point(views[v], depths, size, point, tolerances)
            is_seen = is_seen or _is_visible(
                views[v], depths, size, point, normal, lifts, tolerances
            )
            if is_seen and is_sure[i]:
                break
        is_visible[i] = is_seen and votes >= 0


# ---- Plane through the cells around a hole -------------------------------------------------------

_NUM_FITS = 4  # number of fits
# Least determinant over the squared sum of variances; cells that spread less across lie in a line.
_MIN_DETERMINANT = 1e-9


@serial_kernel
def find_plane(
    rows, columns, heights, first_tolerance_m, tolerance_m, min_cells, is_fitted, is_in_plane
):
    """Return the slopes per column and row of the plane of most of the cells, or NaN.

    The first round takes the cells within first_tolerance_m of the median height; each further
    round takes those within tolerance_m of the last plane. A plane needs `min_cells` of them or
    more, not in a line.

    Args:
        rows: int64 [P].
        columns: int64 [P].
        heights: float64 [P].
        first_tolerance_m: largest distance from the median.
        tolerance_m: largest distance from a plane.
        min_cells: least number of cells.
        is_fitted: bool [P], written: cells that the last plane was fitted to.
        is_in_plane: bool [P], written: cells that lie in the last plane.
    """
    median = np.median(heights)
    for p in range(len(heights)):
        is_in_plane[p] = abs(heights[p] - median) < first_tolerance_m
    slope_x = slope_y = math.nan
    for _ in range(_NUM_FITS):
        n = x = y = z = 0.0
        for p in range(len(heights)):
            is_fitted[p] = is_in_plane[p]
            if is_fitted[p]:
                n = n + 1.0
                x = x + columns[p]
                y = y + rows[p]
                z = z + heights[p]
        if n < min_cells:
            return math.nan, math.nan
        x = x / n
        y = y / n
        z = z / n
        xx = xy = yy = xz = yz = 0.0
        for p in range(len(heights)):
            if is_fitted[p]:
                dx = columns[p] - x
                dy = rows[p] - y
                dz = heights[p] - z
                xx = xx + dx * dx
                xy = xy + dx * dy
                yy = yy + dy * dy
                xz = xz + dx * dz
                yz = yz + dy * dz
        determinant = xx * yy - xy * xy
        if determinant <= _MIN_DETERMINANT * (xx + yy) ** 2:
            return math.nan, math.nan
        slope_x = (yy * xz - xy * yz) / determinant
        slope_y = (xx * yz - xy * xz) / determinant
        for p in range(len(heights)):
            plane_m = z + slope_x * (columns[p] - x) + slope_y * (rows[p] - y)
            is_in_plane[p] = abs(heights[p] - plane_m) < tolerance_m
    return slope_x, slope_y


# ---- Cells of a plan's tiles that lie under points -----------------------------------------------


@serial_kernel
def find_cell_ids(xy, origin, side_m, tile_rows, tile_columns, sides, starts, numbers, cell_ids):
    """Write the indices of the cells under points float64 [P, 2] into cell_ids, int32 [P].

    The index is -1 where there is no cell. Tiles lie row by row from origin. sides, starts: int64
    [Y X], number of cells along a tile's side and where the tile begins in `numbers`, int32, which
    holds each tile's cells row by row.
    """
    for p in range(xy.shape[0]):
        cell_ids[p] = -1
        x = (xy[p, 0] - origin[0]) / side_m
        y = (xy[p, 1] - origin[1]) / side_m
        if not (x >= 0.0 and y >= 0.0 and x < tile_columns and y < tile_rows):  # NaN is in no tile
            continue
        column = math.floor(x)
        row = math.floor(y)
        tile = np.int64(row) * tile_columns + np.int64(column)
        side = sides[tile]
        if side > 0:
            i = min(np.int64((y - row) * side), side - 1)
            j = min(np.int64((x - column) * side), side - 1)
            cell_ids[p] = numbers[starts[tile] + i * side + j]


# ---- Surfaces: smoothing, planes, sides, edges ---------------------------------------------------

# Codes of a cell's side. FALLS and RISES are the numbers of OPEN_EDGE and FLUSH in `cells`.
LINK = 0  # the same surface goes on
FALLS = -1  # the surface falls away
RISES = -2  # something higher follows

# Bits of the neighbours on the same surface.
_LEFT = 1
_RIGHT = 2
_DOWN = 4
_UP = 8
_DOWN_LEFT = 16
_DOWN_RIGHT = 32
_UP_LEFT = 64
_UP_RIGHT = 128
_NO_EDGE = 1 << 30  # offset, in half cells, of an edge that is not found yet


@kernel
def median_heights(height, covered, radius, medians):
    """Write the median of covered heights in squares of 2 radius + 1 cells to medians."""
    rows, columns = height.shape
    for row in prange(rows):
        i = np.int64(row)  # an unsigned i would turn sums with signed numbers into floats
        sorted_heights = np.empty((2 * radius + 1) ** 2, np.float32)
        for j in range(columns):
            medians[i, j] = height[i, j]
            if not covered[i, j]:
                continue
            count = 0
            for k in range(max(0, i - radius), min(rows, i + radius + 1)):
                for m in range(max(0, j - radius), min(columns, j + radius + 1)):
                    if covered[k, m]:
                        height_m = height[k, m]
                        slot = count
                        while slot > 0 and sorted_heights[slot - 1] > height_m:
                            sorted_heights[slot] = sorted_heights[slot - 1]
                            slot -= 1
                        sorted_heights[slot] = height_m
                        count += 1
            upper = count // 2
            medians[i, j] = sorted_heights[upper]
            if count % 2 == 0:
                medians[i, j] = np.float32(0.5) * (
                    sorted_heights[upper - 1] + sorted_heights[upper]
                )


@kernel
def fit_planes(
    height, covered, radius, cell, slack_m, max_slope, max_change_m, fitted_m, slopes, is_fitted
):
    """Fit a plane to the surroundings of each covered cell: its height there and its slopes.

    A plane is fitted to covered cells within radius whose height differs by at most slack_m +
    max_slope times the distance.

    Args:
        height: float32 [H, W].
        covered: bool [H, W].
        radius: cells.
        cell: side of a cell, metres.
        slack_m: metres.
        max_slope: slope.
        max_change_m: largest distance of the result from the cell's own height, metres.
        fitted_m: [H, W], written: the plane's height.
        slopes: [H, W, 2], written: dz/dx, dz/dy.
        is_fitted: bool [H, W], written: False where the cells are too few or lie in a line.
    """
    rows, columns = height.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            fitted_m[i, j] = height[i, j]
            slopes[i, j, 0] = slopes[i, j, 1] = 0.0
            is_fitted[i, j] = False
            if not covered[i, j]:
                continue
            n = sx = sy = sz = sxx = sxy = syy = sxz = syz = 0.0
            center_m = float(height[i, j])
            for k in range(max(0, i - radius), min(rows, i + radius + 1)):
                for m in range(max(0, j - radius), min(columns, j + radius + 1)):
                    if not covered[k, m]:
                        continue
                    x = float(m - j)
                    y = float(k - i)
                    z = float(height[k, m]) - center_m
                    if abs(z) > slack_m + max_slope * cell * math.sqrt(x * x + y * y):
                        continue
                    n += 1.0
                    sx = sx + x
                    sy = sy + y
                    sz = sz + z
                    sxx = sxx + x * x
                    sxy = sxy + x * y
                    syy = syy + y * y
                    sxz = sxz + x * z
                    syz = syz + y * z
            if 2.5 * n < (2 * radius + 1) ** 2:
                continue
            vxx = sxx - sx * sx / n
            vxy = sxy - sx * sy / n
            vyy = syy - sy * sy / n
            vxz = sxz - sx * sz / n
            vyz = syz - sy * sz / n
            determinant = vxx * vyy - vxy * vxy
            if determinant < 0.02 * (vxx + vyy) ** 2 or vxx + vyy <= 0.0:
                continue
            gx = (vyy * vxz - vxy * vyz) / determinant
            gy = (vxx * vyz - vxy * vxz) / determinant
            plane_m = (sz - gx * sx - gy * sy) / n
            fitted_m[i, j] = center_m + min(max(plane_m, -max_change_m), max_change_m)
            slopes[i, j, 0] = gx / cell
            slopes[i, j, 1] = gy / cell
            is_fitted[i, j] = True


@kernel
def compare_sides(height, lowest, covered, is_exposed, max_step_m, sides):
    """Write the code of each side of the exposed cells, sides int8 [H, W, 4].

    - FALLS: nothing follows, or the next cell lies lower by more than max_step_m, or it is not
      exposed and leads down so far.
    - RISES: the next cell stands higher by more than max_step_m, or is not exposed and does not
      lead down.
    - LINK: the same surface goes on. Cells at the grid's border have it, too, and those that are
      not exposed.

    lowest: float32 [H, W], lowest height around each cell.
    """
    rows, columns = height.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            for side in range(4):
                sides[i, j, side] = LINK
                if not is_exposed[i, j]:
                    continue
                k = i
                m = j
                if side < 2:
                    m += 2 * side - 1
                else:
                    k += 2 * side - 5
                if k < 0 or m < 0 or k >= rows or m >= columns:
                    continue
                if not covered[k, m]:
                    sides[i, j, side] = FALLS
                elif height[k, m] - height[i, j] > max_step_m:
                    sides[i, j, side] = RISES
                elif height[k, m] - height[i, j] < -max_step_m:
                    sides[i, j, side] = FALLS
                elif not is_exposed[k, m]:
                    is_falling = lowest[k, m] - height[i, j] < -max_step_m
                    sides[i, j, side] = FALLS if is_falling else RISES


@kernel
def _find_links(is_exposed, sides, links, offsets):
    """Write links uint8 [H, W], the bits of the neighbours that each cell is linked to.

    offsets: int32 [H, W, 2], written: x and y, in half cells, of the cell's own open edge, or
    _NO_EDGE.
    """
    rows, columns = is_exposed.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            links[i, j] = 0
            offsets[i, j, 0] = offsets[i, j, 1] = _NO_EDGE
            if not is_exposed[i, j]:
                continue
            for side in range(4):
                if sides[i, j, side] == FALLS:
                    sign = 1 if side % 2 else -1
                    offsets[i, j, 0] = sign if side < 2 else 0
                    offsets[i, j, 1] = 0 if side < 2 else sign
            if j > 0 and sides[i, j, 0] == LINK and is_exposed[i, j - 1]:
                links[i, j] |= _LEFT
            if j < columns - 1 and sides[i, j, 1] == LINK and is_exposed[i, j + 1]:
                links[i, j] |= _RIGHT
            if i > 0 and sides[i, j, 2] == LINK and is_exposed[i - 1, j]:
                links[i, j] |= _DOWN
            if i < rows - 1 and sides[i, j, 3] == LINK and is_exposed[i + 1, j]:
                links[i, j] |= _UP


@kernel_function()
def _is_diagonal_link(links, i, j, side, vertical):
    """Tell if a cell is linked to a diagonal neighbour through a cell between them."""
    dx = -1 if side == _LEFT else 1
    dy = -1 if vertical == _DOWN else 1
    return (links[i, j] & side and links[i, j + dx] & vertical) or (
        links[i, j] & vertical and links[i + dy, j] & side
    )


@kernel
def _find_diagonal_links(links, neighbour_bits):
    """Write neighbour_bits uint8 [H, W]: the links, and the diagonal neighbours they reach."""
    rows, columns = links.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            bits = links[i, j]
            if _is_diagonal_link(links, i, j, _LEFT, _DOWN):
                bits |= _DOWN_LEFT
            if _is_diagonal_link(links, i, j, _RIGHT, _DOWN):
                bits |= _DOWN_RIGHT
            if _is_diagonal_link(links, i, j, _LEFT, _UP):
                bits |= _UP_LEFT
            if _is_diagonal_link(links, i, j, _RIGHT, _UP):
                bits |= _UP_RIGHT
            neighbour_bits[i, j] = bits


@kernel_function()
def _nearer_edge(offsets, k, m, dx, dy, x, y, square):
    """Return the nearer of two edges and its distance squared.

    One edge is at (x, y), in half cells; the other is that of the neighbour (k, m), which is (dx,
    dy) away.
    """
    if offsets[k, m, 0] == _NO_EDGE:
        return x, y, square
    neighbour_x = np.int64(offsets[k, m, 0]) + dx
    neighbour_y = np.int64(offsets[k, m, 1]) + dy
    neighbour_square = neighbour_x * neighbour_x + neighbour_y * neighbour_y
    if neighbour_square < square:
        return neighbour_x, neighbour_y, neighbour_square
    return x, y, square


@kernel_function()
def _take_nearest_edge(offsets, neighbour_bits, i, j, straight, beside, dx, before, after, dy):
    """Let cell (i, j) take the nearest edge that its neighbours know.

    The neighbours are the one straight below or above (dy), the one beside it (dx), and the
    diagonal ones in the row of the first. straight, beside, before (to -x), after (to +x): their
    bits in neighbour_bits.
    """
    bits = neighbour_bits[i, j]
    if not bits & (straight | beside | before | after):
        return
    first_x = np.int64(offsets[i, j, 0])
    first_y = np.int64(offsets[i, j, 1])
    first_square = first_x * first_x + first_y * first_y
    x = first_x
    y = first_y
    square = first_square
    if bits & straight:
        x, y, square = _nearer_edge(offsets, i + dy, j, 0, 2 * dy, x, y, square)
    if bits & beside:
        x, y, square = _nearer_edge(offsets, i, j + dx, 2 * dx, 0, x, y, square)
    if bits & before:
        x, y, square = _nearer_edge(offsets, i + dy, j - 1, -2, 2 * dy, x, y, square)
    if bits & after:
        x, y, square = _nearer_edge(offsets, i + dy, j + 1, 2, 2 * dy, x, y, square)
    if square < first_square:
        offsets[i, j, 0] = x
        offsets[i, j, 1] = y


@kernel_function()
def _sweep_edges(neighbour_bits, offsets):
    """Pass offsets on from row to row, up and down again, and along each row both ways."""
    rows, columns = neighbour_bits.shape
    for i in range(rows):
        for j in range(columns):
            _take_nearest_edge(
                offsets, neighbour_bits, i, j, _DOWN, _LEFT, -1, _DOWN_LEFT, _DOWN_RIGHT, -1
            )
        for j in range(columns - 2, -1, -1):
            _take_nearest_edge(offsets, neighbour_bits, i, j, 0, _RIGHT, 1, 0, 0, 0)
    for i in range(rows - 1, -1, -1):
        for j in range(columns - 1, -1, -1):
            _take_nearest_edge(
                offsets, neighbour_bits, i, j, _UP, _RIGHT, 1, _UP_LEFT, _UP_RIGHT, 1
            )
        for j in range(1, columns):
            _take_nearest_edge(offsets, neighbour_bits, i, j, 0, _LEFT, -1, 0, 0, 0)


@kernel
def _edge_lengths(offsets, max_distance, distances):
    """Write the lengths of offsets, in cells, at most max_distance, into distances."""
    rows, columns = distances.shape
    for row in prange(rows):
        i = np.int64(row)
        for j in range(columns):
            x = 0.5 * offsets[i, j, 0]
            y = 0.5 * offsets[i, j, 1]
            distances[i, j] = min(math.sqrt(x * x + y * y), max_distance)


@serial_kernel
def edge_distances(is_exposed, sides, max_distance, distances):
    """Write the distance from each cell to the nearest open edge of its surface, [H, W].

    Distances are in cells, at most `max_distance`. Offsets to edges are handed from cell to cell
    (Danielsson 1980), along links only, in two sweeps there and back. In half cells they are whole
    numbers, and so exact.
    """
    links = np.empty(is_exposed.shape, np.uint8)
    neighbour_bits = np.empty(is_exposed.shape, np.uint8)
    offsets = np.empty((is_exposed.shape[0], is_exposed.shape[1], 2), np.int32)
    _find_links(is_exposed, sides, links, offsets)
    _find_diagonal_links(links, neighbour_bits)
    for _ in range(2):
        _sweep_edges(neighbour_bits, offsets)
    _edge_lengths(offsets, max_distance, distances)
