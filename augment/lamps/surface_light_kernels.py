"""Numba kernels: the lamps' light at the nodes of a picture.

`augment.lamps.surface_light` prepares the arrays and holds the plain definitions. A picture is
looked at in nodes, one in each block of pixels, whose normals `surface_normals` finds;
`surface_spread_kernels` takes the light from the nodes to the pixels.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.lamps.pattern_kernels import between_nodes, patterns_of_eight
from augment.lamps.vector_kernels import copies, dot, largest_of, vector_copies
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.layout import NUM_LANES, Index

TILE = 8  # nodes along a side of a tile, whose nodes share a list of lamps
TILE_NODES = TILE * TILE  # nodes of a tile
# Rows of the numbers of a tile, each of TILE_NODES: x, y and z of the points from the eye.
POINTS = 0
NORMALS = 3 * TILE_NODES  # x, y and z of the normals
ROUGH = 6 * TILE_NODES  # cosine to lamps anywhere, of rough surfaces
SAMPLE_POINTS = 7 * TILE_NODES  # points at which lamps are compared
SAMPLE_NORMALS = 10 * TILE_NODES  # their normals
SPARE = 13 * TILE_NODES  # eight numbers that pass between lanes
LUX = 14 * TILE_NODES  # red, green and blue lux
OWN_LUX = 17 * TILE_NODES  # the same of own lamps, as signs return it
NUM_FIELDS = 20  # number of these rows
# Nodes of a whole tile at which the lamps are compared: corners, middles of the sides, middle.
SAMPLES = np.array([0, 3, 7, 24, 27, 31, 56, 59, 63])
# Light that a lamp may have between these points, over the most that it has at one of them.
SAMPLE_MARGIN = 4.0
# Cosine to a lamp at least, where lamps of a tile are compared: its other nodes may face it.
MIN_RANK_COSINE = 0.02
# Loss of length of a mean normal up to which the surface is smooth.
SMOOTH_LOSS = 0.1
# Depth from a lamp up to which nothing shades a point, metres.
MIN_SHADOW_DEPTH_M = 0.05
# Mean cosine of a lamp to surfaces whose normals point anywhere.
ROUGH_COSINE = 0.25


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
    if depth <= MIN_SHADOW_DEPTH_M:
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
def _lit_shares(shadows, shadow_map, eye, point, texels):
    """Return `lit_share` of eight points.

    Args:
        shadows: depth maps of lamps.
        shadow_map: index of the map.
        eye: place of the eye.
        point: the points, from the eye.
        texels: work space, int32 [8].
    """
    pose = shadows.poses[shadow_map]
    lens = shadows.lenses[shadow_map]
    images = shadows.inverse_depths.reshape(shadows.inverse_depths.size)
    height, width = shadows.inverse_depths.shape[1:]
    x = _row_times(pose[0], eye, point)
    y = _row_times(pose[1], eye, point)
    depth = _row_times(pose[2], eye, point)
    zero = copies(0)
    unit = copies(1)
    per_z = unit / v8.maximum(depth, copies(MIN_SHADOW_DEPTH_M))
    last_column = copies(width - 1)
    last_row = copies(height - 1)
    u = v8.fmuladd(x * per_z, copies(lens[0]), copies(lens[2] - 0.5))
    v = v8.fmuladd(y * per_z, copies(lens[1]), copies(lens[3] - 0.5))
    is_inside = v8.mask_and(v8.at_least(u, zero), v8.at_least(last_column, u))
    is_inside = v8.mask_and(is_inside, v8.at_least(v, zero))
    is_inside = v8.mask_and(is_inside, v8.at_least(last_row, v))
    is_inside = v8.mask_and(is_inside, v8.greater(depth, copies(MIN_SHADOW_DEPTH_M)))
    i = v8.floor(v8.minimum(v8.maximum(v, zero), last_row - unit))
    j = v8.floor(v8.minimum(v8.maximum(u, zero), last_column - unit))
    v8.store_integers(texels, Index(0), v8.fmuladd(i, copies(width), j))
    first = shadow_map * height * width
    nearest = between_nodes(images, texels, first, width, u - j, v - i)
    tolerance = v8.fmuladd(copies(shadows.tolerances[0]), per_z, copies(shadows.tolerances[1]))
    share = copies(2) - (nearest - per_z) / tolerance
    share = v8.minimum(v8.maximum(share, zero), unit)
    return v8.select(is_inside, share, unit)


@kernel_function()
def _row_times(row, eye, point):
    """Return a row of a pose times eight points, which are from the eye."""
    at_eye = row[0] * eye[0] + row[1] * eye[1] + row[2] * eye[2] + row[3]
    return dot(vector_copies(row[0], row[1], row[2]), point) + copies(at_eye)


@kernel_function()
def insert_ranked(chosen, scores, number, m, score):
    """Insert a lamp into those of a tile, highest score first; a full list loses its last.

    Args:
        chosen: indices of the lamps, int64 [max_lamps], changed in place.
        scores: their scores, float64 [max_lamps], changed in place.
        number: number of lamps in the list.
        m: index of the lamp.
        score: its score; higher than the last one's if the list is full.

    Returns:
        The number of lamps that the list then has.
    """
    number = min(number + 1, len(chosen))
    place = number - 1
    while place > 0 and scores[place - 1] < score:
        scores[place] = scores[place - 1]
        chosen[place] = chosen[place - 1]
        place -= 1
    scores[place] = score
    chosen[place] = m
    return number


@kernel_function()
def _load_vectors(numbers, index):
    """Return eight vectors whose x, y and z lie in three rows of TILE_NODES numbers."""
    return (
        v8.load(numbers, Index(index)),
        v8.load(numbers, Index(index + TILE_NODES)),
        v8.load(numbers, Index(index + 2 * TILE_NODES)),
    )


@kernel_function()
def _lux_of_eight(tables, size, lamp, towards, squared, per_m, texels):
    """Return lux of a lamp on eight surfaces that face it.

    Args:
        tables: packed patterns, flat.
        size: rows and columns of a pattern.
        lamp: result of `_read_lamp`.
        towards: from the surfaces to the lamp, metres.
        squared: their squared lengths.
        per_m: one over their lengths.
        texels: work space, int32 [8].
    """
    _, axis, right, up, candela, first, extinction, softening = lamp
    away = v8.negate(per_m)
    share = patterns_of_eight(
        tables,
        first,
        size[0],
        size[1],
        dot(towards, vector_copies(*axis)) * away,
        dot(towards, vector_copies(*right)) * away,
        dot(towards, vector_copies(*up)) * away,
        texels,
    )
    lux = copies(candela) * share / (squared + copies(softening))
    if extinction > 0:
        power = copies(-extinction) * v8.sqrt(squared) * v8.broadcast(v8.LOG2_E)
        lux = lux * v8.exp2_fine(v8.maximum(power, copies(-126)))
    return lux


@kernel_function()
def _read_lamp(lamps, eye, m):
    """Return lamp m as numbers: place from the eye, axis, right, up, candela, pattern, air, size.

    The pattern is the index of its first value in the flat tables, the air is its extinction, the
    size is the lamp's softening. Loops over points read a lamp once: numba counts references to
    arrays, which takes long.
    """
    ax = lamps.axes[m, 0]
    ay = lamps.axes[m, 1]
    az = lamps.axes[m, 2]
    ux = lamps.ups[m, 0]
    uy = lamps.ups[m, 1]
    uz = lamps.ups[m, 2]
    return (
        (
            lamps.positions[m, 0] - eye[0],
            lamps.positions[m, 1] - eye[1],
            lamps.positions[m, 2] - eye[2],
        ),
        (ax, ay, az),
        (ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux),
        (ux, uy, uz),
        lamps.intensities[m],
        lamps.patterns[m] * lamps.tables.shape[1] * lamps.tables.shape[2],
        lamps.extinctions[m],
        lamps.softening[m],
    )


@kernel_function()
def _box_of_tile(work, count):
    """Return the least and the largest x, y and z of a tile's nodes, from the eye."""
    low = _load_vectors(work, POINTS)
    high = low
    for p in range(NUM_LANES, count, NUM_LANES):
        point = _load_vectors(work, POINTS + p)
        low = (
            v8.minimum(low[0], point[0]),
            v8.minimum(low[1], point[1]),
            v8.minimum(low[2], point[2]),
        )
        high = (
            v8.maximum(high[0], point[0]),
            v8.maximum(high[1], point[1]),
            v8.maximum(high[2], point[2]),
        )
    return (
        (
            -largest_of(v8.negate(low[0])),
            -largest_of(v8.negate(low[1])),
            -largest_of(v8.negate(low[2])),
        ),
        (largest_of(high[0]), largest_of(high[1]), largest_of(high[2])),
    )


@kernel_function()
def _rank_lamps(lamps, tables, size, eye, work, texels, count, least_lux, chosen, scores, before):
    """Choose the brightest lamps of a tile, brightest first.

    Returns:
        Their number, and the lux of the brightest lamp that is not among them.

    Args:
        lamps: the lamps.
        tables: packed patterns, flat.
        size: rows and columns of a pattern.
        eye: place of the eye.
        work: numbers of the tile.
        texels: work space, int32 [8].
        count: number of the tile's nodes.
        least_lux: lux of all nodes below which a lamp is left out, and the same for lamps of the
            recording car.
        chosen: output, int64 [max_lamps], indices of the lamps.
        scores: output, float64 [max_lamps], the most lux of each at some of the points.
        before: lamps of the tile before, which are tried first, and their number as the last.
    """
    low, high = _box_of_tile(work, count)
    for sample in range(2 * NUM_LANES):
        p = SAMPLES[min(sample, len(SAMPLES) - 1)] * (count - 1) // (TILE_NODES - 1)
        for k in range(6):
            work[SAMPLE_POINTS + k * TILE_NODES + sample] = work[POINTS + k * TILE_NODES + p]
    max_lamps = len(chosen)
    number = 0
    dropped = 0.0
    num_before = before[max_lamps]
    for place in range(num_before + len(lamps.intensities)):
        m = before[place] if place < num_before else place - num_before
        is_known = False
        if place >= num_before:
            for k in range(num_before):
                is_known |= before[k] == m
        if is_known:
            continue
        squared = 0.0
        for k in range(3):
            at = lamps.positions[m, k] - eye[k]
            gap = max(low[k] - at, at - high[k], 0.0)
            squared += gap * gap
        least = least_lux[1] if lamps.is_own[m] else least_lux[0]
        bound = lamps.peaks[m] / (squared + lamps.softening[m])
        if bound < least or (number == max_lamps and bound <= dropped):
            continue
        if lamps.extinctions[m] > 0:
            bound *= math.exp(-lamps.extinctions[m] * math.sqrt(squared))
            if bound < least or (number == max_lamps and bound <= dropped):
                continue
        lamp = _read_lamp(lamps, eye, m)
        best = copies(0)
        brightest = copies(0)
        for p in range(0, 2 * NUM_LANES, NUM_LANES):
            point = _load_vectors(work, SAMPLE_POINTS + p)
            towards = _towards(lamp[0], point)
            squares = dot(towards, towards)
            per_m = copies(1) / v8.maximum(v8.sqrt(squares), copies(1e-9))
            lux = _lux_of_eight(tables, size, lamp, towards, squares, per_m, texels)
            brightest = v8.maximum(brightest, lux)
            cosine = dot(towards, _load_vectors(work, SAMPLE_NORMALS + p)) * per_m
            best = v8.maximum(best, lux * v8.maximum(cosine, copies(MIN_RANK_COSINE)))
        if SAMPLE_MARGIN * largest_of(brightest) < least:
            continue
        score = np.float64(largest_of(best))
        if number == max_lamps:
            if score <= scores[number - 1]:
                dropped = max(dropped, score)
                continue
            dropped = max(dropped, scores[number - 1])
        number = insert_ranked(chosen, scores, number, m, score)
    for k in range(number):
        before[k] = chosen[k]
    before[max_lamps] = number
    return number, dropped


@kernel_function()
def _towards(place, point):
    """Return the way from eight points to a place."""
    return (copies(place[0]) - point[0], copies(place[1]) - point[1], copies(place[2]) - point[2])


@kernel_function()
def _read_tile(depth, normals, view, top, left, work, nodes):
    """Enter the nodes of a tile that show a surface into `work`; return their number.

    Places after the last node, up to a multiple of eight, have its numbers.
    """
    height, width = depth.shape
    count = 0
    for i in range(top, min(top + TILE, height)):
        y = (i * view.lens[4] + view.lens[5] - view.lens[3]) * view.lens[1]
        for j in range(left, min(left + TILE, width)):
            z = np.float64(depth[i, j])
            if not (z > 0 and z < 1e6):
                continue
            x = (j * view.lens[4] + view.lens[5] - view.lens[2]) * view.lens[0]
            squared = np.float32(0)
            for k in range(3):
                ray = view.axes[k, 0] * x + view.axes[k, 1] * y + view.axes[k, 2]
                work[POINTS + k * TILE_NODES + count] = z * ray
                normal = normals[i, j, k]
                work[NORMALS + k * TILE_NODES + count] = normal
                squared += normal * normal
            # Shorter normals are means of some that disagree: leaves, grass, noise.
            rough = (1.0 - SMOOTH_LOSS - math.sqrt(squared)) / (1.0 - SMOOTH_LOSS)
            work[ROUGH + count] = ROUGH_COSINE * max(rough, 0.0)
            nodes[count, 0] = i
            nodes[count, 1] = j
            count += 1
    if count > 0:
        for p in range(count, (count + NUM_LANES - 1) // NUM_LANES * NUM_LANES):
            for k in range(7):
                work[k * TILE_NODES + p] = work[k * TILE_NODES + count - 1]
    return count


@kernel_function()
def _light_tile(lamps, tables, size, view, eye, shadows, work, texels, count, m, fade, has_own):
    """Add the light of a lamp to a tile's nodes.

    Args:
        lamps: the lamps.
        tables: packed patterns, flat.
        size: rows and columns of a pattern.
        view: the view of the nodes.
        eye: place of the eye.
        shadows: depth maps of the lamps that have one.
        work: numbers of the tile, changed in place.
        texels: work space, int32 [8].
        count: number of the tile's nodes.
        m: index of the lamp.
        fade: factor of its light.
        has_own: True if the light that comes back from signs is asked for.
    """
    zero = copies(0)
    lamp = _read_lamp(lamps, eye, m)
    shadow_map = lamps.shadow_maps[m]
    is_returned = has_own and lamps.is_own[m]
    red = fade * lamps.colors[m, 0]
    green = fade * lamps.colors[m, 1]
    blue = fade * lamps.colors[m, 2]
    for p in range(0, count, NUM_LANES):
        towards = _towards(lamp[0], _load_vectors(work, POINTS + p))
        squared = dot(towards, towards)
        per_m = copies(1) / v8.maximum(v8.sqrt(squared), copies(1e-9))
        cosine = dot(towards, _load_vectors(work, NORMALS + p)) * per_m
        gain = v8.maximum(cosine, zero) + v8.load(work, Index(ROUGH + p))
        if v8.mask_bits(v8.greater(gain, zero)) == Index(0) and not is_returned:
            continue
        facing = _lux_of_eight(tables, size, lamp, towards, squared, per_m, texels)
        if shadow_map >= 0:
            point = _load_vectors(work, POINTS + p)
            facing = facing * _lit_shares(shadows, shadow_map, eye, point, texels)
        _add_color(work, LUX + p, facing * gain, red, green, blue)
        if is_returned:
            v8.store(work, Index(SPARE), facing)
            for lane in range(NUM_LANES):
                x = np.float64(work[POINTS + p + lane])
                y = np.float64(work[POINTS + TILE_NODES + p + lane])
                z = np.float64(work[POINTS + 2 * TILE_NODES + p + lane])
                work[SPARE + lane] *= _return_share(x, y, z, lamp[0])
            facing = v8.load(work, Index(SPARE))
            _add_color(work, OWN_LUX + p, facing, red, green, blue)


@kernel_function()
def _add_color(work, index, light, red, green, blue):
    """Add light of a colour to eight nodes."""
    sums = _load_vectors(work, index)
    v8.store(work, Index(index), v8.fmuladd(light, copies(red), sums[0]))
    v8.store(work, Index(index + TILE_NODES), v8.fmuladd(light, copies(green), sums[1]))
    v8.store(work, Index(index + 2 * TILE_NODES), v8.fmuladd(light, copies(blue), sums[2]))


@kernel_function()
def _light_row_of_tiles(
    tile_row,
    depth,
    normals,
    view,
    lamps,
    tables,
    shadows,
    is_sign,
    min_lux,
    min_own_lux,
    max_lamps,
    lux,
    own_lux,
):
    """Sum the lamps' illuminance at the nodes of a row of tiles."""
    height, width = depth.shape
    top = tile_row * TILE
    step = np.int64(view.lens[4])
    top_px = max((top - 1) * step, 0)
    bottom_px = is_sign.shape[0] if top + TILE >= height else (top + TILE + 1) * step
    bottom_px = min(bottom_px, is_sign.shape[0])
    eye = (view.eye[0], view.eye[1], view.eye[2])
    size = (lamps.tables.shape[1], lamps.tables.shape[2])
    work = np.zeros(NUM_FIELDS * TILE_NODES, np.float32)
    nodes = np.empty((TILE_NODES, 2), np.int64)
    texels = np.empty(NUM_LANES, np.int32)
    chosen = np.empty(max_lamps, np.int64)
    scores = np.empty(max_lamps)
    before = np.zeros(max_lamps + 1, np.int64)
    for i in range(top, min(top + TILE, height)):
        for j in range(width):
            for k in range(3):
                lux[i, j, k] = 0.0
                if own_lux.size > 0:
                    own_lux[i, j, k] = 0.0
    for left in range(0, width, TILE):
        count = _read_tile(depth, normals, view, top, left, work, nodes)
        if count == 0:
            continue
        # Signs read the nodes of this tile, or those of the next tile beside these.
        left_px = max((left - 1) * step, 0)
        right_px = is_sign.shape[1] if left + TILE >= width else (left + TILE + 1) * step
        right_px = min(right_px, is_sign.shape[1])
        has_own = False
        for i in range(top_px, bottom_px):
            for j in range(left_px, right_px):
                has_own |= is_sign[i, j]
        least_lux = (min_lux, min_own_lux if has_own else min_lux)
        number, dropped = _rank_lamps(
            lamps, tables, size, eye, work, texels, count, least_lux, chosen, scores, before
        )
        if number == 0:
            continue
        work[LUX:] = 0
        for c in range(number):
            # A lamp fades before it is dropped, so that tiles have no edges.
            fade = 1.0 if dropped <= 0 else min(max(scores[c] / dropped - 1.0, 0.0), 1.0)
            if fade > 0:
                _light_tile(
                    lamps,
                    tables,
                    size,
                    view,
                    eye,
                    shadows,
                    work,
                    texels,
                    count,
                    chosen[c],
                    fade,
                    has_own,
                )
        for p in range(count):
            i = nodes[p, 0]
            j = nodes[p, 1]
            for k in range(3):
                lux[i, j, k] = work[LUX + k * TILE_NODES + p]
                if has_own:
                    own_lux[i, j, k] = work[OWN_LUX + k * TILE_NODES + p]


@kernel
def light_nodes(
    depth, normals, view, lamps, shadows, is_sign, min_lux, min_own_lux, max_lamps, lux, own_lux
):
    """Sum the lamps' illuminance at the nodes.

    Args:
        depth: z of the nodes, metres, 0 for the sky, float32 [h, w].
        normals: normals, world, float32 [h, w, 3], as short as the surface is rough.
        view: the view of the nodes.
        lamps: the lamps.
        shadows: depth maps of the lamps that have one.
        is_sign: pixels of signs, bool [H, W]; empty if no sign sends own light back.
        min_lux: lux below which a lamp does not light a tile.
        min_own_lux: the same for lamps of the recording car, where signs are.
        max_lamps: largest number of lamps that light a tile.
        lux: output, float32 [h, w, 3], lux in linear sRGB on the surfaces.
        own_lux: output, float32 [h, w, 3], lux of the recording car's lamps on surfaces that face
            them, times how much of their light comes back to the eye (`return_share`), in tiles
            with signs; empty without any.
    """
    tables = lamps.tables.reshape(lamps.tables.size)
    for tile_row in prange((depth.shape[0] + TILE - 1) // TILE):
        _light_row_of_tiles(
            np.int64(tile_row),
            depth,
            normals,
            view,
            lamps,
            tables,
            shadows,
            is_sign,
            min_lux,
            min_own_lux,
            max_lamps,
            lux,
            own_lux,
        )


@kernel_function()
def _return_share(x, y, z, place):
    """Return `return_share` at the angle between the eye and a lamp, seen from a sign.

    Args:
        x: x of the sign, from the eye, metres.
        y: y of the sign.
        z: z of the sign.
        place: place of the lamp, from the eye.
    """
    dx = place[0] - x
    dy = place[1] - y
    dz = place[2] - z
    per_lamp_m = 1.0 / max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
    per_eye_m = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-9)
    # The chord of the angle, which is exact for small angles where a cosine loses its digits.
    ax = x * per_eye_m + dx * per_lamp_m
    ay = y * per_eye_m + dy * per_lamp_m
    az = z * per_eye_m + dz * per_lamp_m
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
