"""Numba kernels: normals of a picture's surfaces, and the lamps' light on them.

`augment.lamps.surface_light` prepares the arrays and holds the plain definitions. A picture is
looked at in nodes, one in each block of `step` x `step` pixels; `spread_light` takes the light from
the nodes to the pixels.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.lamps.pattern_kernels import pattern_at, pattern_place
from augment.render.cpu.jit import kernel, kernel_function

TILE = 8  # nodes along a side of a tile, whose nodes share a list of lamps
# Rows and columns of a tile on one plane in which nodes are lit; the others lie between.
LIT_ROWS = np.array([0, 2, 5, 7])
# Lit row before each row, by its place in LIT_ROWS.
LIT_BEFORE = np.array([0, 0, 1, 1, 1, 2, 2, 2])
# Share of the next lit row.
LIT_SHARE = np.array([0, 1 / 2, 0, 1 / 3, 2 / 3, 0, 1 / 2, 1])
# Least distance of such a tile from the lamps that light it, in its diagonals.
MIN_SPANS = 3.0
# Least cosine of a node's normal to the mean normal of a tile on one plane.
MIN_PLANE_NORMAL = 0.97
# Largest distance of a node from the plane, as a share of the tile's diagonal.
PLANE_TOLERANCE = 0.02
# Nodes of a whole tile at which the lamps are compared: corners, and four about the middle.
SAMPLES = np.array([0, 7, 18, 21, 42, 45, 56, 63])
# Light that a lamp may have between these points, over the most that it has at one of them.
SAMPLE_MARGIN = 4.0
# Distance of the nodes over which slopes are first estimated, nodes.
SLOPE_STEP = 2
# Difference between the slopes on both sides of a node, as a share of the inverse depth and a node,
# up to which both are its surface's.
SLOPE_TOLERANCE = 0.02
# Rows of the nine nodes whose normals are averaged, from the one in the middle.
MEAN_ROWS = np.array([0, -1, 1, 0, 0, -2, -2, 2, 2])
# Columns of those nodes.
MEAN_COLUMNS = np.array([0, 0, 0, -1, 1, -2, 2, -2, 2])
# Loss of length of a mean normal up to which the surface is smooth.
SMOOTH_LOSS = 0.1
# Mean cosine of a lamp to surfaces whose normals point anywhere.
ROUGH_COSINE = 0.25
# Difference of inverse depths, as a share, at which a node does not light a pixel.
SAME_SURFACE = 0.08
# Weight of nodes on other surfaces, for pixels whose surface no node has.
OTHER_SURFACE_WEIGHT = 1e-4


class NodeView(NamedTuple):
    """View of the nodes."""

    lens: Any
    """1 / fx, 1 / fy, cx, cy of pixels, pixels between nodes, middle of the first node's pixel."""
    axes: Any
    """World_from_camera, [3, 3]."""
    eye: Any
    """Place of the eye, world, metres."""


class LampArrays(NamedTuple):
    """Lamps as the kernels take them, float64 unless said."""

    positions: Any
    """Places, [M, 3]."""
    axes: Any
    """Axes of the patterns, [M, 3]."""
    ups: Any
    """Upward directions of the patterns, [M, 3]."""
    intensities: Any
    """Candela where the pattern is 1, [M]."""
    peaks: Any
    """Largest candela in any direction, [M]."""
    patterns: Any
    """Rows of the tables, int64 [M]."""
    tables: Any
    """Packed patterns, float32 [K, V, U]."""
    colors: Any
    """Linear sRGB of luminance 1, [M, 3]."""
    extinctions: Any
    """Extinction between the lamps and what they light, per metre, [M]."""
    softening: Any
    """Square of the distance below which a lamp is no point, m2, [M]."""
    shadow_maps: Any
    """Index of the shadow map, -1 without one, int64 [M]."""
    is_own: Any
    """True for lamps of the recording car, whose light signs send back, bool [M]."""


class ShadowArrays(NamedTuple):
    """Depth maps from the places of lamps."""

    inverse_depths: Any
    """1 / z of the first surface, 0 without one, float32 [S, h, w]."""
    poses: Any
    """camera_from_world, float64 [S, 3, 4]."""
    lenses: Any
    """fx, fy, cx, cy, float64 [S, 4]."""
    tolerances: Any
    """Share of the inverse depth, and inverse metres, by which a surface may be behind, [2]."""


# ---- Normals -------------------------------------------------------------------------------------


@kernel_function()
def _least_slope(inverse, row, column, d_row, d_column, centre):
    """Return the change of the inverse depth per node along a direction, on the smoother side."""
    height, width = inverse.shape
    ahead = 0.0
    behind = 0.0
    has_ahead = False
    has_behind = False
    i = row + d_row * SLOPE_STEP
    j = column + d_column * SLOPE_STEP
    if i < height and j < width and inverse[i, j] > 0:
        ahead = (inverse[i, j] - centre) / SLOPE_STEP
        has_ahead = True
    i = row - d_row * SLOPE_STEP
    j = column - d_column * SLOPE_STEP
    if i >= 0 and j >= 0 and inverse[i, j] > 0:
        behind = (centre - inverse[i, j]) / SLOPE_STEP
        has_behind = True
    if has_ahead and has_behind:
        # Where both agree they share the noise; at an edge the smaller one is the surface's own.
        if abs(ahead - behind) < SLOPE_TOLERANCE * centre:
            return 0.5 * (ahead + behind)
        return ahead if abs(ahead) < abs(behind) else behind
    if has_ahead:
        return ahead
    return behind if has_behind else 0.0


@kernel
def find_slopes(inverse, view, normals):
    """Find each node's normal by the slopes of the inverse depth about it.

    A plane is linear in inverse depth: a + b x + c y = 1 / z, at unit depth (x, y). Its normal is
    along (b, c, a) in the camera.

    Args:
        inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        view: the view of the nodes.
        normals: output, unit normals towards the eye, world, float32 [h, w, 3]; 0 for the sky.
    """
    height, width = inverse.shape
    for row in prange(height):
        ifx = view.lens[0]
        ify = view.lens[1]
        step = view.lens[4]
        y = (row * step + view.lens[5] - view.lens[3]) * ify
        for column in range(width):
            centre = np.float64(inverse[row, column])
            if centre <= 0:
                for k in range(3):
                    normals[row, column, k] = 0.0
                continue
            b = _least_slope(inverse, row, column, 0, 1, centre) / (step * ifx)
            c = _least_slope(inverse, row, column, 1, 0, centre) / (step * ify)
            x = (column * step + view.lens[5] - view.lens[2]) * ifx
            a = centre - b * x - c * y
            per_length = -1.0 / math.sqrt(a * a + b * b + c * c)
            for k in range(3):
                n = view.axes[k, 0] * b + view.axes[k, 1] * c + view.axes[k, 2] * a
                normals[row, column, k] = n * per_length


@kernel
def average_normals(inverse, normals, means):
    """Average the normals of nine nodes of the same surface about each node.

    Args:
        inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        normals: result of `find_slopes`.
        means: output, means, float32 [h, w, 3]. They are as short as the normals disagree.
    """
    height, width = inverse.shape
    for row in prange(height):
        for column in range(width):
            centre = inverse[row, column]
            x = np.float32(0)
            y = np.float32(0)
            z = np.float32(0)
            count = np.float32(0)
            limit = centre * np.float32(SAME_SURFACE)
            for sample in range(9):
                i = row + MEAN_ROWS[sample]
                j = column + MEAN_COLUMNS[sample]
                if i < 0 or j < 0 or i >= height or j >= width:
                    continue
                if abs(inverse[i, j] - centre) <= limit and centre > 0:
                    x += normals[i, j, 0]
                    y += normals[i, j, 1]
                    z += normals[i, j, 2]
                    count += np.float32(1)
            share = np.float32(1) / max(count, np.float32(1))
            means[row, column, 0] = x * share
            means[row, column, 1] = y * share
            means[row, column, 2] = z * share


# ---- Light at the nodes --------------------------------------------------------------------------


@kernel_function()
def lit_share(shadows, shadow_map, x, y, z):
    """Return the share of a lamp's light that reaches a point, 0 in shadow to 1.

    Inverse depths are interpolated, as they are linear on a plane: a road seen at a grazing angle
    throws no shadow on itself.
    """
    pose = shadows.poses[shadow_map]
    lens = shadows.lenses[shadow_map]
    depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    if depth <= 0.05:
        return 1.0
    per_z = 1.0 / depth
    u = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) * per_z
    v = (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) * per_z
    height, width = shadows.inverse_depths[shadow_map].shape
    u = u * lens[0] + lens[2] - 0.5
    v = v * lens[1] + lens[3] - 0.5
    if u < 0 or v < 0 or u > width - 1 or v > height - 1:
        return 1.0
    i = min(int(v), height - 2)
    j = min(int(u), width - 2)
    v -= i
    u -= j
    image = shadows.inverse_depths[shadow_map]
    above = image[i, j] * (1.0 - u) + image[i, j + 1] * u
    below = image[i + 1, j] * (1.0 - u) + image[i + 1, j + 1] * u
    nearest = above * (1.0 - v) + below * v
    # From fully lit to dark over one more tolerance.
    tolerance = shadows.tolerances[0] * per_z + shadows.tolerances[1]
    return min(max(2.0 - (nearest - per_z) / tolerance, 0.0), 1.0)


@kernel_function()
def read_lamp(lamps, m):
    """Return lamp m as numbers: place, axis, right, up, candela, pattern, extinction, softening.

    Loops over points read it once: numba counts references to arrays, which takes long.
    """
    ax = lamps.axes[m, 0]
    ay = lamps.axes[m, 1]
    az = lamps.axes[m, 2]
    ux = lamps.ups[m, 0]
    uy = lamps.ups[m, 1]
    uz = lamps.ups[m, 2]
    return (
        (lamps.positions[m, 0], lamps.positions[m, 1], lamps.positions[m, 2]),
        (ax, ay, az),
        (ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux),
        (ux, uy, uz),
        lamps.intensities[m],
        lamps.patterns[m],
        lamps.extinctions[m],
        lamps.softening[m],
    )


@kernel_function()
def lux_along_ray(tables, lamp, x, y, z):
    """Return lux of a lamp on a surface that faces it, and the unit direction to the lamp.

    Args:
        tables: packed patterns.
        lamp: result of `read_lamp`.
        x: x of the point, world, metres.
        y: y of the point.
        z: z of the point.
    """
    place, axis, right, up, candela, pattern, extinction, softening = lamp
    dx = place[0] - x
    dy = place[1] - y
    dz = place[2] - z
    squared = dx * dx + dy * dy + dz * dz
    distance = math.sqrt(squared)
    per_m = 1.0 / max(distance, 1e-9)
    dx *= per_m
    dy *= per_m
    dz *= per_m
    share = pattern_at(
        tables,
        pattern,
        -(dx * axis[0] + dy * axis[1] + dz * axis[2]),
        -(dx * right[0] + dy * right[1] + dz * right[2]),
        -(dx * up[0] + dy * up[1] + dz * up[2]),
    )
    lux = candela * share / (squared + softening)
    if extinction > 0:
        lux *= math.exp(-extinction * distance)
    return lux, dx, dy, dz


@kernel_function()
def light_points(table, lamp, points, count, lux):
    """Write a lamp's lux on the surfaces at points: `lux_along_ray` times the cosine.

    The loop has no branches and no calls, so that the compiler lights many points at a time.

    Args:
        table: the lamp's pattern, float32 [V, U].
        lamp: result of `read_lamp`.
        points: float64 [7, N]: places, normals, roughness times ROUGH_COSINE.
        count: number of the points.
        lux: output, float64 [N].
    """
    place, axis, right, up, candela, _, extinction, softening = lamp
    xs = points[0]
    ys = points[1]
    zs = points[2]
    normals_x = points[3]
    normals_y = points[4]
    normals_z = points[5]
    rough = points[6]
    last_row = table.shape[0] - 1
    last_column = table.shape[1] - 1
    for e in range(count):
        dx = place[0] - xs[e]
        dy = place[1] - ys[e]
        dz = place[2] - zs[e]
        squared = dx * dx + dy * dy + dz * dz
        per_m = 1.0 / math.sqrt(max(squared, 1e-18))
        dx *= per_m
        dy *= per_m
        dz *= per_m
        row, column = pattern_place(
            last_row,
            last_column,
            -(dx * axis[0] + dy * axis[1] + dz * axis[2]),
            -(dx * right[0] + dy * right[1] + dz * right[2]),
            -(dx * up[0] + dy * up[1] + dz * up[2]),
        )
        i = min(int(row), last_row - 1)
        j = min(int(column), last_column - 1)
        v = row - i
        u = column - j
        below = table[i, j] * (1.0 - u) + table[i, j + 1] * u
        above = table[i + 1, j] * (1.0 - u) + table[i + 1, j + 1] * u
        share = below * (1.0 - v) + above * v
        cosine = normals_x[e] * dx + normals_y[e] * dy + normals_z[e] * dz
        lux[e] = candela * share / (squared + softening) * (max(cosine, 0.0) + rough[e])
    if extinction > 0:
        for e in range(count):
            dx = place[0] - xs[e]
            dy = place[1] - ys[e]
            dz = place[2] - zs[e]
            lux[e] *= math.exp(-extinction * math.sqrt(dx * dx + dy * dy + dz * dz))


@kernel_function()
def rank_lamps(lamps, points, count, has_own, min_lux, max_lamps, chosen, scores):
    """Choose the lamps that light a tile most, brightest first; return their number.

    Args:
        lamps: the lamps.
        points: points of the tile, [N, 7]: place, normal, roughness.
        count: number of the points.
        has_own: True if signs send the light of the recording car's lamps back.
        min_lux: lux of all its points below which a lamp is left out.
        max_lamps: largest number of lamps.
        chosen: output, int64 [max_lamps], indices of the lamps.
        scores: work space, float64 [max_lamps].
    """
    low = np.empty(3)
    high = np.empty(3)
    for k in range(3):
        low[k] = points[0, k]
        high[k] = points[0, k]
    for p in range(1, count):
        for k in range(3):
            low[k] = min(low[k], points[p, k])
            high[k] = max(high[k], points[p, k])
    samples = np.empty((7, len(SAMPLES)))
    lux = np.empty(len(SAMPLES))
    for sample in range(len(SAMPLES)):
        p = SAMPLES[sample] * (count - 1) // (TILE * TILE - 1)
        for k in range(7):
            samples[k, sample] = points[p, k]
    number = 0
    for m in range(len(lamps.intensities)):
        squared = 0.0
        for k in range(3):
            gap = max(low[k] - lamps.positions[m, k], lamps.positions[m, k] - high[k], 0.0)
            squared += gap * gap
        bound = lamps.peaks[m] / (squared + lamps.softening[m])
        least = min_lux
        if number == max_lamps:
            least = max(least, scores[number - 1])
        if bound < least:
            continue
        bound *= math.exp(-lamps.extinctions[m] * math.sqrt(squared))
        if bound < least:
            continue
        score = 0.0
        lamp = read_lamp(lamps, m)
        if has_own and lamps.is_own[m]:
            for sample in range(len(SAMPLES)):
                facing = lux_along_ray(
                    lamps.tables, lamp, samples[0, sample], samples[1, sample], samples[2, sample]
                )[0]
                score = max(score, facing)
        else:
            light_points(lamps.tables[lamps.patterns[m]], lamp, samples, len(SAMPLES), lux)
            for sample in range(len(SAMPLES)):
                score = max(score, lux[sample])
        if SAMPLE_MARGIN * score < least:
            continue
        if number == max_lamps and score <= scores[number - 1]:
            continue
        number = min(number + 1, max_lamps)
        place = number - 1
        while place > 0 and scores[place - 1] < score:
            scores[place] = scores[place - 1]
            chosen[place] = chosen[place - 1]
            place -= 1
        scores[place] = score
        chosen[place] = m
    return number


@kernel
def light_nodes(depth, normals, view, lamps, shadows, min_lux, max_lamps, lux, own_lux):
    """Sum the lamps' illuminance at the nodes.

    Args:
        depth: z of the nodes, metres, 0 for the sky, float32 [h, w].
        normals: normals, world, float32 [h, w, 3], as short as the surface is rough.
        view: the view of the nodes.
        lamps: the lamps.
        shadows: depth maps of the lamps that have one.
        min_lux: lux below which a lamp does not light a tile; 0 for all light at all nodes.
        max_lamps: largest number of lamps that light a tile.
        lux: output, float32 [h, w, 3], lux in linear sRGB on the surfaces.
        own_lux: output, float32 [h, w, 3], lux of the recording car's lamps on surfaces that face
            them, times how much of their light comes back to the eye (`return_share`); empty if it
            is not asked for.
    """
    height, width = depth.shape
    tile_columns = (width + TILE - 1) // TILE
    tile_rows = (height + TILE - 1) // TILE
    has_own = own_lux.size > 0
    for tile in prange(tile_columns * tile_rows):
        top = (tile // tile_columns) * TILE
        left = (tile % tile_columns) * TILE
        points = np.empty((TILE * TILE, 7))
        nodes = np.empty((TILE * TILE, 2), np.int64)
        chosen = np.empty(max_lamps, np.int64)
        scores = np.empty(max_lamps)
        light = np.empty((TILE * TILE, 6))
        lit_points = np.empty((7, TILE * TILE))
        lit_lux = np.empty(TILE * TILE)
        count = 0
        for i in range(top, min(top + TILE, height)):
            y = (i * view.lens[4] + view.lens[5] - view.lens[3]) * view.lens[1]
            for j in range(left, min(left + TILE, width)):
                for k in range(3):
                    lux[i, j, k] = 0.0
                    if has_own:
                        own_lux[i, j, k] = 0.0
                z = np.float64(depth[i, j])
                if not (z > 0 and z < 1e6):
                    continue
                x = (j * view.lens[4] + view.lens[5] - view.lens[2]) * view.lens[0]
                for k in range(3):
                    ray = view.axes[k, 0] * x + view.axes[k, 1] * y + view.axes[k, 2]
                    points[count, k] = view.eye[k] + z * ray
                length = 0.0
                for k in range(3):
                    points[count, 3 + k] = normals[i, j, k]
                    length += np.float64(normals[i, j, k]) ** 2
                # Shorter normals are means of some that disagree: leaves, grass, noise.
                roughness = (1.0 - SMOOTH_LOSS - math.sqrt(length)) / (1.0 - SMOOTH_LOSS)
                points[count, 6] = ROUGH_COSINE * max(roughness, 0.0)
                nodes[count, 0] = i
                nodes[count, 1] = j
                count += 1
        if count == 0:
            continue
        number = rank_lamps(lamps, points, count, has_own, min_lux, max_lamps, chosen, scores)
        is_smooth = (
            min_lux > 0
            and count == TILE * TILE
            and is_one_plane(points)
            and is_far_from_lamps(points, lamps, chosen, number)
        )
        num_lit = len(LIT_ROWS) ** 2 if is_smooth else count
        light[:num_lit] = 0.0
        for e in range(num_lit):
            p = e
            if is_smooth:
                p = LIT_ROWS[e // len(LIT_ROWS)] * TILE + LIT_ROWS[e % len(LIT_ROWS)]
            for k in range(7):
                lit_points[k, e] = points[p, k]
        for c in range(number):
            m = chosen[c]
            lamp = read_lamp(lamps, m)
            tables = lamps.tables
            shadow_map = lamps.shadow_maps[m]
            is_returned = has_own and lamps.is_own[m]
            red = lamps.colors[m, 0]
            green = lamps.colors[m, 1]
            blue = lamps.colors[m, 2]
            if shadow_map < 0 and not is_returned:
                light_points(tables[lamps.patterns[m]], lamp, lit_points, num_lit, lit_lux)
                for e in range(num_lit):
                    light[e, 0] += lit_lux[e] * red
                    light[e, 1] += lit_lux[e] * green
                    light[e, 2] += lit_lux[e] * blue
                continue
            place = lamp[0]
            for e in range(num_lit):
                x = lit_points[0, e]
                y = lit_points[1, e]
                z = lit_points[2, e]
                nx = lit_points[3, e]
                ny = lit_points[4, e]
                nz = lit_points[5, e]
                above = nx * (place[0] - x) + ny * (place[1] - y) + nz * (place[2] - z)
                rough = lit_points[6, e]
                if above <= 0 and rough <= 0 and not is_returned:
                    continue
                facing, dx, dy, dz = lux_along_ray(tables, lamp, x, y, z)
                if shadow_map >= 0 and facing > 0:
                    facing *= lit_share(shadows, shadow_map, x, y, z)
                lit = facing * (max(nx * dx + ny * dy + nz * dz, 0.0) + rough)
                light[e, 0] += lit * red
                light[e, 1] += lit * green
                light[e, 2] += lit * blue
                if is_returned:
                    facing *= _return_share(view, x, y, z, dx, dy, dz)
                    light[e, 3] += facing * red
                    light[e, 4] += facing * green
                    light[e, 5] += facing * blue
        for p in range(count):
            i = nodes[p, 0]
            j = nodes[p, 1]
            for k in range(6 if has_own else 3):
                value = light[p, k]
                if is_smooth:
                    # Between the four lit nodes about this one.
                    first = LIT_BEFORE[i - top] * len(LIT_ROWS) + LIT_BEFORE[j - left]
                    second = first + len(LIT_ROWS)
                    v = LIT_SHARE[i - top]
                    u = LIT_SHARE[j - left]
                    value = (light[first, k] * (1.0 - u) + light[first + 1, k] * u) * (1.0 - v)
                    value += (light[second, k] * (1.0 - u) + light[second + 1, k] * u) * v
                if k < 3:
                    lux[i, j, k] = np.float32(value)
                else:
                    own_lux[i, j, k - 3] = np.float32(value)


@kernel_function()
def is_far_from_lamps(points, lamps, chosen, number):
    """Return True if a tile is so far from its lamps that their light changes little over it.

    Args:
        points: points of the tile, [N, 7].
        lamps: the lamps.
        chosen: indices of the lamps that light the tile.
        number: number of these lamps.
    """
    last = len(points) - 1
    span = 0.0
    for k in range(3):
        span = span + (points[last, k] - points[0, k]) ** 2
    for c in range(number):
        squared = 0.0
        for k in range(3):
            middle = 0.5 * (points[0, k] + points[last, k])
            squared += (lamps.positions[chosen[c], k] - middle) ** 2
        if squared < MIN_SPANS**2 * span:
            return False
    return True


@kernel_function()
def is_one_plane(points):
    """Return True if all points of a whole tile lie in one plane, and their normals agree.

    Args:
        points: [N, 7]: place, normal, roughness.
    """
    mean = np.zeros(7)
    for p in range(len(points)):
        for k in range(7):
            mean[k] += points[p, k]
    for k in range(7):
        mean[k] /= len(points)
    length = math.sqrt(mean[3] * mean[3] + mean[4] * mean[4] + mean[5] * mean[5])
    if mean[6] > 0 or length < MIN_PLANE_NORMAL:
        return False
    span = 0.0
    for k in range(3):
        span += (points[len(points) - 1, k] - points[0, k]) ** 2
    limit = PLANE_TOLERANCE * math.sqrt(span) * length
    for p in range(len(points)):
        distance = 0.0
        cosine = 0.0
        for k in range(3):
            distance += (points[p, k] - mean[k]) * mean[3 + k]
            cosine += points[p, 3 + k] * mean[3 + k]
        if abs(distance) > limit or cosine < MIN_PLANE_NORMAL * length:
            return False
    return True


@kernel_function()
def _return_share(view, x, y, z, dx, dy, dz):
    """Return `return_share` at the angle between the eye and a lamp, seen from a sign."""
    ex = view.eye[0] - x
    ey = view.eye[1] - y
    ez = view.eye[2] - z
    per_m = 1.0 / max(math.sqrt(ex * ex + ey * ey + ez * ez), 1e-9)
    # The chord of the angle, which is exact for small angles where a cosine loses its digits.
    ax = ex * per_m - dx
    ay = ey * per_m - dy
    az = ez * per_m - dz
    return return_share(math.sqrt(ax * ax + ay * ay + az * az))


# Observation angle of a sign up to which all of its light comes back, radians: 0.2 degrees.
FULL_RETURN_RAD = 0.2 * math.pi / 180
# Observation angle of the second value of the table, radians: 0.33 degrees.
MIDDLE_RETURN_RAD = 0.33 * math.pi / 180
MIDDLE_RETURN = 180.0 / 250.0  # share of the light that comes back there
# Observation angle of the third value, radians: 2 degrees.
LAST_RETURN_RAD = 2.0 * math.pi / 180
LAST_RETURN = 5.0 / 250.0  # share of the light that comes back there
_MIDDLE_POWER = math.log(MIDDLE_RETURN) / math.log(MIDDLE_RETURN_RAD / FULL_RETURN_RAD)
_LAST_POWER = math.log(LAST_RETURN / MIDDLE_RETURN) / math.log(LAST_RETURN_RAD / MIDDLE_RETURN_RAD)


@kernel_function()
def return_share(angle_rad):
    """Return the light that a sign sends back at an observation angle, over that at 0.2 degrees.

    Powers of the angle join the values of a reflective sheeting of class RA2.
    """
    if angle_rad <= FULL_RETURN_RAD:
        return 1.0
    if angle_rad <= MIDDLE_RETURN_RAD:
        return (angle_rad / FULL_RETURN_RAD) ** _MIDDLE_POWER
    return MIDDLE_RETURN * (angle_rad / MIDDLE_RETURN_RAD) ** _LAST_POWER


# ---- From nodes to pixels ------------------------------------------------------------------------


@kernel
def spread_light(
    depth, node_inverse, lux, own_lux, step, first, reflectance, return_per_lux, picture
):
    """Add the nodes' light to the picture: reflectance / pi times lux, and what signs send back.

    Each pixel takes the four nodes about it, those on its surface first.

    Args:
        depth: z of the pixels, metres, 0 for the sky, float32 [H, W].
        node_inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        lux: result of `light_nodes`.
        own_lux: result of `light_nodes`, or empty.
        step: pixels between nodes.
        first: column and row of the first node's pixel.
        reflectance: float32 [H, W, 3].
        return_per_lux: coefficient of retroreflection, cd/m2 per lux, float32 [H, W]; empty if no
            surface has one.
        picture: luminance in linear sRGB, cd/m2, changed in place, float32 [H, W, 3].
    """
    height, width = depth.shape
    rows, columns = node_inverse.shape
    per_pi = 1.0 / math.pi
    for row in prange(height):
        weights = np.empty(4)
        total = np.empty(3)
        v = min(max((row - first) / step, 0.0), rows - 1.0)
        i = min(int(v), max(rows - 2, 0))
        v -= i
        below = min(i + 1, rows - 1)
        for column in range(width):
            z = depth[row, column]
            if not (z > 0 and z < 1e6):
                continue
            u = min(max((column - first) / step, 0.0), columns - 1.0)
            j = min(int(u), max(columns - 2, 0))
            u -= j
            beside = min(j + 1, columns - 1)
            brightest = np.float32(0)
            for k in range(3):
                brightest = max(brightest, max(lux[i, j, k], lux[i, beside, k]))
                brightest = max(brightest, max(lux[below, j, k], lux[below, beside, k]))
            sends_back = return_per_lux.size > 0 and return_per_lux[row, column] > 0
            if brightest <= 0 and not sends_back:
                continue
            weights[0] = (1.0 - u) * (1.0 - v)
            weights[1] = u * (1.0 - v)
            weights[2] = (1.0 - u) * v
            weights[3] = u * v
            total_weight = 0.0
            for corner in range(4):
                a = i if corner < 2 else below
                b = j if corner % 2 == 0 else beside
                gap = abs(node_inverse[a, b] * z - 1.0) * (1.0 / SAME_SURFACE)
                weights[corner] *= max(1.0 - gap * gap, OTHER_SURFACE_WEIGHT)
                if node_inverse[a, b] <= 0:
                    weights[corner] = 0.0
                total_weight += weights[corner]
            if total_weight <= 0:
                continue
            for k in range(3):
                total[k] = 0.0
            for corner in range(4):
                a = i if corner < 2 else below
                b = j if corner % 2 == 0 else beside
                for k in range(3):
                    total[k] += weights[corner] * lux[a, b, k]
            for k in range(3):
                luminance = total[k] / total_weight * reflectance[row, column, k] * per_pi
                picture[row, column, k] += np.float32(luminance)
            if sends_back:
                for k in range(3):
                    total[k] = 0.0
                for corner in range(4):
                    a = i if corner < 2 else below
                    b = j if corner % 2 == 0 else beside
                    for k in range(3):
                        total[k] += weights[corner] * own_lux[a, b, k]
                for k in range(3):
                    luminance = total[k] / total_weight * return_per_lux[row, column]
                    picture[row, column, k] += np.float32(luminance * reflectance[row, column, k])
