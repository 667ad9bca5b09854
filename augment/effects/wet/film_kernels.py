"""Numba kernels of wet ground: which pixels show it, and what its film of water mirrors.

`reflection` and `ripples` define what they compute, and launch them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.render.cpu import simd as v8
from augment.render.cpu.hash_kernels import mix
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.cpu.simd import LOG2_E, exp2_fine, log2
from augment.render.layout import NUM_LANES, Index
from augment.rng import STEP_X, STEP_Y

# Channels of the ground's map, see ground.WetGround; NUM_CHANNELS is their number.
HEIGHT, EXPOSURE, SLOPE_X, SLOPE_Y, PUDDLE_ORDER, WHEEL_TRACK, NUM_CHANNELS = range(7)

# ---- Rings of drops ------------------------------------------------------------------------------

SQUARE_M = 0.12  # side of the squares; a ring ends before it is as wide
MAX_DROPS = 2  # largest number of drops in a square at a time
# Largest number of drops that may reach a square; the row after them names it.
MAX_NEARBY_DROPS = 9 * MAX_DROPS
LIFE_NS = 400_000_000  # life of a ring
SPEED_MPS = 0.23  # least speed of capillary-gravity waves on water, at a length of 1.7 cm
RING_WAVE_M = 0.022  # length of a ring's waves
RING_WIDTH_M = 0.016  # width of a ring
RING_SLOPE = 0.1  # largest slope of a ring
RING_END_WIDTHS = 3.0  # number of widths from its crest at which a ring ends
MIN_FALL = 1e-7  # least fall of a ray that meets a plane, at unit depth
MIN_FOOTPRINT_SINE = 0.02  # least sine of the angle between ray and ground, for a pixel's footprint
FADED_PX = 2.0  # length of waves, in pixels, below which they do not show
FULL_PX = 4.0  # length of waves, in pixels, from which on they show fully
_COLUMN_STEP = np.uint64(STEP_X)  # step of the hash per column
_ROW_STEP = np.uint64(STEP_Y)  # step of the hash per row
_SHIFT_24 = np.uint64(24)
_SHIFT_44 = np.uint64(44)
_LOW_20_BITS = np.uint64(0xFFFFF)  # mask of the low 20 bits
_LIFE_NS_UINT = np.uint64(LIFE_NS)
_UNIT = 2.0**-20  # size of one step of those bits


@kernel_function()
def _find_drops(column, row, rings, seed, timestamp_ns, drops):
    """Enter the rings that may reach a square: how many, and x, y, radius and slope of each."""
    reach = SPEED_MPS * LIFE_NS * 1e-9
    num_found = 0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            i = column + di
            j = row + dj
            place_bits = np.uint64(np.int64(i)) * _COLUMN_STEP + np.uint64(np.int64(j)) * _ROW_STEP
            for drop in range(MAX_DROPS):
                drop_bits = mix(place_bits + seed + np.uint64(drop))
                elapsed_ns = timestamp_ns + np.int64((drop_bits >> _SHIFT_24) % _LIFE_NS_UINT)
                num_falls = elapsed_ns // LIFE_NS
                age = (elapsed_ns % LIFE_NS) / LIFE_NS
                bits = mix(drop_bits ^ (np.uint64(num_falls) * _COLUMN_STEP))
                if np.float64(np.int64(bits & _LOW_20_BITS)) * _UNIT < rings[0]:
                    u = np.float64(np.int64(bits >> _SHIFT_44)) * _UNIT
                    v = np.float64(np.int64((bits >> _SHIFT_24) & _LOW_20_BITS)) * _UNIT
                    drops[num_found, 0] = (i + u) * SQUARE_M
                    drops[num_found, 1] = (j + v) * SQUARE_M
                    drops[num_found, 2] = reach * age
                    drops[num_found, 3] = RING_SLOPE * (1.0 - age) * (1.0 - age)
                    num_found += 1
    drops[MAX_NEARBY_DROPS, 0] = column
    drops[MAX_NEARBY_DROPS, 1] = row
    drops[MAX_NEARBY_DROPS, 2] = num_found


@kernel_function()
def rings_at(x, y, footprint, rings, seed, timestamp_ns, drops):
    """Return the rings' slopes towards x and y at a point, and the variance of the rest.

    rings: share, variance, unseen. drops [MAX_NEARBY_DROPS + 1, 4]: rings about the square of the
    last point, which the last row names.
    """
    visible_share = (RING_WAVE_M / max(footprint, 1e-9) - FADED_PX) / (FULL_PX - FADED_PX)
    visible_share = min(max(visible_share, 0.0), 1.0)
    visible_share = visible_share * visible_share * (3.0 - 2.0 * visible_share)
    variance = rings[1] + (rings[2] - rings[1]) * visible_share * visible_share
    sx = sy = 0.0
    if visible_share <= 0.0 or rings[0] <= 0.0:
        return sx, sy, variance
    column = math.floor(x / SQUARE_M)
    row = math.floor(y / SQUARE_M)
    if not (drops[MAX_NEARBY_DROPS, 0] == column and drops[MAX_NEARBY_DROPS, 1] == row):
        _find_drops(column, row, rings, seed, timestamp_ns, drops)
    for k in range(np.int64(drops[MAX_NEARBY_DROPS, 2])):
        dx = x - drops[k, 0]
        dy = y - drops[k, 1]
        d = max(math.sqrt(dx * dx + dy * dy), 1e-4)
        crest_distance = (d - drops[k, 2]) / RING_WIDTH_M
        if abs(crest_distance) > RING_END_WIDTHS:
            continue
        s = drops[k, 3] * math.exp(-crest_distance * crest_distance)
        s *= math.sin((2.0 * math.pi * RING_WIDTH_M / RING_WAVE_M) * crest_distance) / d
        sx += s * dx
        sy += s * dy
    return sx * visible_share, sy * visible_share, variance


# ---- Eight pixels at a time ----------------------------------------------------------------------


@kernel_function()
def _splat(number):
    """Return eight copies of a number."""
    return v8.broadcast(np.float32(number))


@kernel_function()
def _clamp(value, low, high):
    """Clamp values; the result is low where they are NaN."""
    return v8.minimum(v8.maximum(value, _splat(low)), _splat(high))


@kernel_function()
def _linear(value, slope, offset):
    """Return value * slope + offset."""
    return v8.fmuladd(value, _splat(slope), _splat(offset))


@kernel_function()
def _smoothstep(t):
    """Smooth step from 0 at t = 0 to 1 at t = 1."""
    t = _clamp(t, 0.0, 1.0)
    return t * t * _linear(t, -2.0, 3.0)


@kernel_function()
def _dot(x, y, z, a, b, c):
    """Return the dot product of (x, y, z) and (a, b, c)."""
    return v8.fmuladd(x, a, v8.fmuladd(y, b, z * c))


@kernel_function()
def _rotate(row, x, y, z):
    """Return a row of a matrix times vectors."""
    return _dot(x, y, z, v8.broadcast(row[0]), v8.broadcast(row[1]), v8.broadcast(row[2]))


@kernel_function()
def _ray_x(first, lens):
    """Return x at unit depth of the pixels from column `first` on; lens: 1 / fx, 1 / fy, cx, cy."""
    middle = v8.broadcast(np.float32(first) + np.float32(0.5) - lens[2])
    return (middle + v8.lane_numbers()) * v8.broadcast(lens[0])


@kernel_function()
def _any(mask):
    """Tell if any lane of a mask is set."""
    return v8.mask_bits(mask) != Index(0)


@kernel_function()
def _store_texels(texels, spare, u, v, i, j):
    """Store texels of float coordinates (column, row), and shares of the way to the next texels."""
    v8.store_integers(texels, Index(0), i)
    v8.store_integers(texels, Index(NUM_LANES), j)
    v8.store(spare, Index(0), u - i)
    v8.store(spare, Index(NUM_LANES), v - j)


# ---- Pixels that show open ground ----------------------------------------------------------------
# In the loops over pixels, tuples hold numbers alone: numba counts references to arrays of records,
# which takes longer than the arithmetic. `spare` passes values between lanes and loops: shares of
# the way to the next texels, then, from RESULTS_START on, results.

# Height off the ground, in metres and in metres per metre of distance, up to which a pixel shows
# ground for certain.
GROUND_TOLERANCE_M = 0.08
GROUND_TOLERANCE_PER_M = 0.003
# The same, from which on it shows something else.
MAX_GROUND_OFFSET_M = 0.2
MAX_GROUND_OFFSET_PER_M = 0.008
MIN_GROUND_SHARE = 0.004  # smaller shares of ground count as 0
RESULTS_START = 2 * NUM_LANES  # index of the results in `spare`
SPARE_SIZE = 8 * NUM_LANES  # size of `spare`


class MapView(NamedTuple):
    """View of a camera on the map. `_read_view` makes tuples of its arrays."""

    lens: Any  # 1 / fx, 1 / fy, cx, cy
    axes: Any  # [3, 3], world_from_camera
    # [8]: the eye's column and row in the map (from the first cell's middle), cells per metre, z;
    # its column and row in the coarse and in the fine mottle, without whole turns.
    eye: Any
    eye_xy: Any  # x and y of the eye, float64
    rows: Any  # rows of the map, 2 at least
    columns: Any  # columns of the map, 2 at least


@kernel_function()
def _read_view(view):
    """Return the view with tuples in place of arrays."""
    lens = view.lens
    eye = view.eye
    return MapView(
        (lens[0], lens[1], lens[2], lens[3]),
        _read_matrix(view.axes),
        (eye[0], eye[1], eye[2], eye[3], eye[4], eye[5], eye[6], eye[7]),
        (view.eye_xy[0], view.eye_xy[1]),
        view.rows,
        view.columns,
    )


@kernel_function()
def _read_matrix(m):
    """Return a 3 x 3 matrix as tuples."""
    return ((m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2]))


@kernel_function()
def _find_cells(px, py, view, texels, spare):
    """Return which points lie on the map, and store the cell and the weights of each in `texels`.

    The cell is the one at the lower corner (the floor of both coordinates). Coordinates on the map
    are offset * cells per metre + the eye's own.

    Args:
        px: x of eight points, offsets from the eye, metres.
        py: y of the points, likewise.
        view: the map's size, and the eye on it: coordinates in cells, and cells per metre.
        texels: receives the cells and weights, see `_store_texels`.
        spare: work space of `_store_texels`.
    """
    eye = view.eye
    zero = _splat(0)
    per_m = v8.broadcast(view.eye[2])
    u = v8.fmuladd(px, per_m, v8.broadcast(eye[0]))
    v = v8.fmuladd(py, per_m, v8.broadcast(eye[1]))
    is_inside = v8.mask_and(v8.at_least(u, zero), v8.at_least(_splat(view.columns - 1), u))
    is_inside = v8.mask_and(is_inside, v8.at_least(v, zero))
    is_inside = v8.mask_and(is_inside, v8.at_least(_splat(view.rows - 1), v))
    i = v8.floor(_clamp(u, 0, view.columns - 2))
    j = v8.floor(_clamp(v, 0, view.rows - 2))
    _store_texels(texels, spare, u, v, i, j)
    return is_inside


@kernel_function()
def _interpolate_channels(cells, num_channels, columns, channel, count, texels, spare):
    """Interpolate `count` of `num_channels` channels from `channel` on between the map's cells.

    The results go to spare[RESULTS_START + k NUM_LANES + lane].
    """
    step = Index(num_channels)
    down = Index(columns * num_channels)
    for lane in range(Index(NUM_LANES)):
        start = (
            Index(texels[lane + Index(NUM_LANES)]) * down
            + Index(texels[lane]) * step
            + Index(channel)
        )
        u = spare[lane]
        v = spare[lane + Index(NUM_LANES)]
        for k in range(Index(count)):
            index = start + k
            a = cells[index] + (cells[index + step] - cells[index]) * u
            index += down
            b = cells[index] + (cells[index + step] - cells[index]) * u
            spare[Index(RESULTS_START) + k * Index(NUM_LANES) + lane] = a + (b - a) * v


@kernel_function()
def _find_ground_in_row(row, width, view, cells, depth, visible_share, share):
    """Find the open ground in one row of the image; return the row's largest share."""
    view = _read_view(view)
    lens = view.lens
    axes = view.axes
    texels = np.empty(2 * NUM_LANES, np.int32)
    spare = np.empty(SPARE_SIZE, np.float32)
    zero = _splat(0)
    ones = _splat(1)
    half = np.float32(0.5)
    down = (np.float32(row) + half - lens[3]) * lens[1]
    b = v8.broadcast(down)
    max_share = zero
    for x in range(Index(row * width), Index((row + 1) * width)):
        share[x] = np.float32(0)
    left = (half - lens[2]) * lens[0]
    right = (np.float32(width) - half - lens[2]) * lens[0]
    level = axes[2][1] * down + axes[2][2]
    if min(axes[2][0] * left, axes[2][0] * right) + level >= np.float32(0):
        return np.float32(0)
    for j in range(0, width, NUM_LANES):
        first = min(
            j, width - NUM_LANES
        )  # the last eight pixels of a row overlap those before them
        pixel = Index(row * width + first)
        z = v8.load(depth, pixel)
        ground_share = v8.load(visible_share, pixel)
        a = _ray_x(first, lens)
        ray_z = _rotate(axes[2], a, b, ones)
        is_ground = v8.mask_and(v8.greater(z, zero), v8.greater(ground_share, zero))
        is_ground = v8.mask_and(is_ground, v8.greater(zero, ray_z))
        if not _any(is_ground):
            continue
        px = z * _rotate(axes[0], a, b, ones)
        py = z * _rotate(axes[1], a, b, ones)
        pz = z * ray_z
        is_ground = v8.mask_and(is_ground, _find_cells(px, py, view, texels, spare))
        if not _any(is_ground):
            continue
        _interpolate_channels(cells, NUM_CHANNELS, view.columns, HEIGHT, 2, texels, spare)
        height_gap = v8.absolute(
            pz + v8.broadcast(view.eye[3]) - v8.load(spare, Index(RESULTS_START))
        )
        distance = z * v8.sqrt(_dot(a, b, ones, a, b, ones))
        tolerance_m = _linear(distance, GROUND_TOLERANCE_PER_M, GROUND_TOLERANCE_M)
        gap = _linear(
            distance,
            MAX_GROUND_OFFSET_PER_M - GROUND_TOLERANCE_PER_M,
            MAX_GROUND_OFFSET_M - GROUND_TOLERANCE_M,
        )
        ground_share = (
            ground_share
            * v8.load(spare, Index(RESULTS_START + NUM_LANES))
            * (ones - _smoothstep((height_gap - tolerance_m) / gap))
        )
        ground_share = v8.select(
            v8.mask_and(is_ground, v8.greater(ground_share, _splat(MIN_GROUND_SHARE))),
            ground_share,
            zero,
        )
        v8.store(share, pixel, ground_share)
        max_share = v8.maximum(max_share, ground_share)
    v8.store(spare, Index(0), max_share)
    row_max = spare[0]
    for lane in range(1, NUM_LANES):
        row_max = max(row_max, spare[lane])
    return row_max


@kernel
def find_ground(view, cells, width, depth, visible_share, share, row_max):
    """Find how much of each pixel is open ground, share [H W], and each row's largest share.

    cells: the map, flat, NUM_CHANNELS of each cell. depth, visible_share: [H W]. W >= NUM_LANES.
    """
    for y in prange(row_max.size):
        row_max[y] = _find_ground_in_row(
            np.int64(y), width, view, cells, depth, visible_share, share
        )


# ---- Reflections in the film ---------------------------------------------------------------------

R0 = 0.0201  # reflectance of water at normal incidence
# Standard deviations of slopes: alpha / sqrt 2, for alpha of 0.12 and 0.011.
ASPHALT_ROUGHNESS = 0.085
PUDDLE_ROUGHNESS = 0.008
TRACK_SMOOTHING = 0.35  # share of the roughness that wheels have polished away
FILM_SHARE = 0.75  # share of wet asphalt that shows water: stones stand out of it
PUDDLE_RIM = 0.12  # half width of a puddle's rim, in PUDDLE_ORDER
# Texels on a side of the noise that makes film and roughness uneven; a power of 2.
MOTTLE_SIDE = 256
FINE_TEXEL_M = 0.012  # texel of the fine noise
COARSE_TEXEL_M = 0.2  # texel of the coarse noise
FINE_AMPLITUDE = 0.07  # change of the film per deviation of the fine noise
COARSE_AMPLITUDE = 0.05  # change of the film per deviation of the coarse noise
# Number of levels of the mirrored picture: sharp, and blurred upright by 2 to 256 pixels.
NUM_LEVELS = 9
MIN_BLUR_PX = 2.0  # blur, in pixels of the image, below which the picture stays sharp
SKY_DISTANCE_M = 1e5  # distance of the sky
VALUES_PER_TASK = 6144  # number of values that a thread decodes at a time
_MIN_ONE_MINUS_COSINE = 1e-6  # least value of 1 - cosine
# Rows of each level.
_ROW_SCALES = np.array([0.5 ** max(k - 1, 0) for k in range(NUM_LEVELS)], np.float32)


class MirrorView(NamedTuple):
    """Mirrored camera and picture."""

    lens: Any  # fx, fy, cx, cy
    rotation: Any  # [3, 3], camera_from_world
    offset: Any  # [3], centre of the mirrored camera, from the eye
    width: Any  # width of all levels, 2 at least
    rows: Any  # number of rows of the first level


@kernel_function()
def _read_mirror(mirror):
    """Return the mirror with tuples in place of arrays."""
    lens = mirror.lens
    offset = mirror.offset
    return MirrorView(
        (lens[0], lens[1], lens[2], lens[3]),
        _read_matrix(mirror.rotation),
        (offset[0], offset[1], offset[2]),
        mirror.width,
        mirror.rows,
    )


class WaterOnGround(NamedTuple):
    """Water on the ground."""

    wetness: Any  # see reflection.Film
    puddle_threshold: Any  # see reflection.Film
    rings: Any  # share, variance, unseen
    seed: Any
    timestamp_ns: Any


@kernel_function()
def _read_water(water):
    """Return the water with tuples in place of arrays."""
    rings = water.rings[0], water.rings[1], water.rings[2]
    return WaterOnGround(
        water.wetness, water.puddle_threshold, rings, water.seed, water.timestamp_ns
    )


@kernel_function()
def _lanes_if(condition):
    """Return the number of turns of a loop over lanes: all or none.

    Numba prunes references of arrays that a loop uses, but not of those that a branch uses.
    """
    return Index(NUM_LANES) if condition else Index(0)


@kernel_function()
def _mottle(noise, px, py, weight, per_texel, column, row, texels, spare):
    """Return weighted noise at points from the eye; column, row: the eye's, in texels."""
    u = v8.fmuladd(px, _splat(per_texel), v8.broadcast(column))
    v = v8.fmuladd(py, _splat(per_texel), v8.broadcast(row))
    _store_texels(texels, spare, u, v, v8.floor(u), v8.floor(v))
    side = Index(MOTTLE_SIDE)
    wrap = np.int32(MOTTLE_SIDE - 1)
    has_weight = v8.greater(weight, _splat(0))
    for lane in range(_lanes_if(_any(has_weight))):
        i = texels[lane]
        j = texels[lane + Index(NUM_LANES)]
        left = Index(i & wrap)
        right = Index((i + np.int32(1)) & wrap)
        low = Index(j & wrap) * side
        high = Index((j + np.int32(1)) & wrap) * side
        a = noise[low + left] + (noise[low + right] - noise[low + left]) * spare[lane]
        b = noise[high + left] + (noise[high + right] - noise[high + left]) * spare[lane]
        spare[Index(RESULTS_START) + lane] = a + (b - a) * spare[lane + Index(NUM_LANES)]
    return v8.select(has_weight, weight * v8.load(spare, Index(RESULTS_START)), _splat(0))


@kernel_function()
def _ring_lanes(px, py, footprint, puddle, eye_xy, water, spare, drops):
    """Compute `rings_at` for the lanes with puddles."""
    is_visible = v8.mask_and(
        v8.greater(puddle, _splat(0)), v8.greater(_splat(RING_WAVE_M / FADED_PX), footprint)
    )
    v8.store(spare, Index(0), px)
    v8.store(spare, Index(NUM_LANES), py)
    v8.store(spare, Index(RESULTS_START), _splat(0))
    v8.store(spare, Index(RESULTS_START + NUM_LANES), _splat(0))
    v8.store(spare, Index(RESULTS_START + 2 * NUM_LANES), _splat(water.rings[1]))
    v8.store(
        spare, Index(RESULTS_START + 3 * NUM_LANES), v8.select(is_visible, footprint, _splat(0))
    )
    for lane in range(_lanes_if(water.rings[0] > 0 and _any(is_visible))):
        index = Index(RESULTS_START) + lane
        footprint_m = spare[index + Index(3 * NUM_LANES)]
        if footprint_m > np.float32(0):
            x = eye_xy[0] + spare[lane]
            y = eye_xy[1] + spare[lane + Index(NUM_LANES)]
            sx, sy, rest_variance = rings_at(
                x, y, np.float64(footprint_m), water.rings, water.seed, water.timestamp_ns, drops
            )
            spare[index] = np.float32(sx)
            spare[index + Index(NUM_LANES)] = np.float32(sy)
            spare[index + Index(2 * NUM_LANES)] = np.float32(rest_variance)
    slopes = v8.load(spare, Index(RESULTS_START)), v8.load(spare, Index(RESULTS_START + NUM_LANES))
    return slopes[0], slopes[1], v8.load(spare, Index(RESULTS_START + 2 * NUM_LANES))


@kernel_function()
def _reflectance(cosine, roughness):
    """Return the mean reflectance, as reflection.mean_reflectance defines it."""
    ones = _splat(1)
    power = _splat(5) * exp2_fine(roughness * _splat(-2.69 * LOG2_E))
    one_minus_cosine = v8.maximum(ones - cosine, _splat(_MIN_ONE_MINUS_COSINE))
    schlick_term = exp2_fine(v8.maximum(power * log2(one_minus_cosine), _splat(-126)))
    schlick_term = schlick_term / _linear(roughness * v8.sqrt(roughness), 22.7, 1.0)
    return _linear(schlick_term, 1 - R0, R0)


@kernel_function()
def _to_linear(value):
    """Convert display-encoded values to linear light."""
    value = v8.maximum(value, _splat(0))
    high = exp2_fine(_splat(2.4) * log2(_linear(value, 1 / 1.055, 0.055 / 1.055)))
    low = value * _splat(1 / 12.92)
    return v8.select(v8.greater(value, _splat(0.04045)), high, low)


@kernel_function()
def _to_display(linear):
    """Convert linear light to display-encoded values; light below 0 counts as 0."""
    high = exp2_fine(_splat(1 / 2.4) * log2(v8.maximum(linear, _splat(0.0031308))))
    low = v8.maximum(linear, _splat(0)) * _splat(12.92)
    return v8.select(v8.greater(linear, _splat(0.0031308)), _linear(high, 1.055, -0.055), low)


@kernel_function()
def _project(mirror, x, y, z):
    """Return column and row of points from the mirrored eye."""
    lens = mirror.lens
    rotation = mirror.rotation
    per_z = _splat(1) / v8.maximum(_rotate(rotation[2], x, y, z), _splat(1e-3))
    column = _rotate(rotation[0], x, y, z) * per_z
    row = _rotate(rotation[1], x, y, z) * per_z
    column = v8.fmuladd(v8.broadcast(lens[0]), column, v8.broadcast(lens[2]))
    return column, v8.fmuladd(v8.broadcast(lens[1]), row, v8.broadcast(lens[3]))


@kernel_function()
def _distance_at(mirror, depth, column, row, px, py, pz, texels, spare):
    """Return the distance from points of the ground to what the mirrored picture shows, metres."""
    lens = mirror.lens
    m = mirror.rotation
    offset = mirror.offset
    width = Index(mirror.width)
    i = v8.floor(_clamp(column, 0, mirror.width - 1))
    j = v8.floor(_clamp(row, 0, mirror.rows - 1))
    v8.store_integers(texels, Index(0), i)
    v8.store_integers(texels, Index(NUM_LANES), j)
    for lane in range(Index(NUM_LANES)):
        spare[lane] = depth[Index(texels[lane + Index(NUM_LANES)]) * width + Index(texels[lane])]
    z = v8.load(spare, Index(0))
    half = np.float32(0.5)
    unit = np.float32(1)
    a = (i + v8.broadcast(half - lens[2])) * v8.broadcast(unit / lens[0]) * z
    b = (j + v8.broadcast(half - lens[3])) * v8.broadcast(unit / lens[1]) * z
    x = _rotate((m[0][0], m[1][0], m[2][0]), a, b, z) + v8.broadcast(offset[0]) - px
    y = _rotate((m[0][1], m[1][1], m[2][1]), a, b, z) + v8.broadcast(offset[1]) - py
    up = _rotate((m[0][2], m[1][2], m[2][2]), a, b, z) + v8.broadcast(offset[2]) - pz
    distances = v8.sqrt(_dot(x, y, up, x, y, up))
    return v8.select(v8.greater(z, _splat(0)), distances, _splat(SKY_DISTANCE_M))


@kernel_function()
def _look_up_mirror(mirror, colors, levels, column, row, sigma, texels, spare):
    """Return linear light of the mirrored picture at points, blurred upright by sigma pixels.

    sigma >= 1.
    """
    lower_level = v8.floor(_clamp(log2(sigma), 0, NUM_LEVELS - 2))
    upper_share = _clamp(sigma / exp2_fine(lower_level) - _splat(1), 0, 1)
    x = _clamp(column - _splat(0.5), 0, mirror.width - 1)
    i = v8.minimum(v8.floor(x), _splat(mirror.width - 2))
    _store_texels(texels, spare, x, upper_share + lower_level, i, lower_level)
    v8.store(spare, Index(RESULTS_START), _clamp(row, -1e6, 1e6))
    pixel = Index(3)
    row_stride = Index(3 * mirror.width)
    red = Index(RESULTS_START + 2 * NUM_LANES)
    green = Index(RESULTS_START + 3 * NUM_LANES)
    blue = Index(RESULTS_START + 4 * NUM_LANES)
    for lane in range(Index(NUM_LANES)):
        level = Index(texels[lane + Index(NUM_LANES)])
        y = spare[Index(RESULTS_START) + lane]
        color = _splat(0)
        for k in range(Index(2)):
            last = np.int64(levels[Index(1), level]) - 1
            v = y * _ROW_SCALES[level] - np.float32(0.5)
            v = min(max(v, np.float32(0)), np.float32(last))
            j = np.int64(v)
            index = (
                pixel * (Index(levels[Index(0), level]) + Index(texels[lane]))
                + Index(j) * row_stride
            )
            above = v8.load(colors, index)
            below = v8.load(colors, index + (row_stride if j < last else Index(0)))
            between = v8.fmuladd(v8.broadcast(v - np.float32(j)), below - above, above)
            weight = (
                spare[lane + Index(NUM_LANES)]
                if k
                else np.float32(1) - spare[lane + Index(NUM_LANES)]
            )
            color = v8.fmuladd(v8.broadcast(weight), between, color)
            level += Index(1)
        v8.store(
            spare, Index(RESULTS_START + NUM_LANES), color
        )  # colours of two texels side by side
        index = Index(RESULTS_START + NUM_LANES)
        u = spare[lane]
        spare[red + lane] = spare[index] + (spare[index + Index(3)] - spare[index]) * u
        spare[green + lane] = (
            spare[index + Index(1)] + (spare[index + Index(4)] - spare[index + Index(1)]) * u
        )
        spare[blue + lane] = (
            spare[index + Index(2)] + (spare[index + Index(5)] - spare[index + Index(2)]) * u
        )
    return v8.load(spare, red), v8.load(spare, green), v8.load(spare, blue)


@kernel_function()
def _film_on_ground(track, puddle, unevenness, variance, wetness):
    """Return the deviation of slopes, and the share of the ground that the film covers."""
    ones = _splat(1)
    roughness = (
        _splat(ASPHALT_ROUGHNESS) * _linear(track, -TRACK_SMOOTHING, 1.0) * (ones - unevenness)
    )
    puddle_roughness = v8.sqrt(_linear(variance, 0.5, PUDDLE_ROUGHNESS * PUDDLE_ROUGHNESS))
    film_share = _clamp(_linear(track, 0.1, FILM_SHARE) + unevenness, 0.0, 1.0)
    covered_share = v8.broadcast(wetness) * v8.fmuladd(ones - film_share, puddle, film_share)
    return v8.fmuladd(puddle, puddle_roughness - roughness, roughness), covered_share


@kernel_function()
def _mix_light(encoded, reflected, strength):
    """Mix display-encoded values with reflected linear light by a strength."""
    linear = _to_linear(encoded)
    return _to_display(v8.fmuladd(strength, reflected - linear, linear))


@kernel_function()
def _shade_row(
    line, width, view, cells, depth, share, mirror, colors, levels, mirror_depth, water, noise, rgb
):
    """Mix reflections into one row of the image."""
    view = _read_view(view)
    mirror = _read_mirror(mirror)
    water = _read_water(water)
    lens = view.lens
    axes = view.axes
    eye = view.eye
    offset = mirror.offset
    texels = np.empty(2 * NUM_LANES, np.int32)
    spare = np.empty(SPARE_SIZE, np.float32)
    drops = np.full((MAX_NEARBY_DROPS + 1, 4), np.nan)
    ones = _splat(1)
    b = v8.broadcast((np.float32(line) + np.float32(0.5) - lens[3]) * lens[1])
    for j in range(0, width, NUM_LANES):
        # The last eight pixels of a row overlap those before them, which stay as they are.
        first = min(j, width - NUM_LANES)
        pixel = Index(line * width + first)
        ground_share = v8.load(share, pixel)
        is_ground = v8.mask_and(
            v8.greater(ground_share, _splat(0)), v8.at_least(v8.lane_numbers(), _splat(j - first))
        )
        if not _any(is_ground):
            continue
        a = _ray_x(first, lens)
        z = v8.select(is_ground, v8.load(depth, pixel), ones)
        px = z * _rotate(axes[0], a, b, ones)
        py = z * _rotate(axes[1], a, b, ones)
        pz = z * _rotate(axes[2], a, b, ones)
        _find_cells(px, py, view, texels, spare)
        _interpolate_channels(cells, NUM_CHANNELS, view.columns, SLOPE_X, 4, texels, spare)
        slope_x = v8.load(spare, Index(RESULTS_START))
        slope_y = v8.load(spare, Index(RESULTS_START + NUM_LANES))
        puddle_order = v8.load(spare, Index(RESULTS_START + 2 * NUM_LANES))
        track = v8.load(spare, Index(RESULTS_START + 3 * NUM_LANES))
        puddle = _smoothstep(
            _linear(puddle_order - v8.broadcast(water.puddle_threshold), 0.5 / PUDDLE_RIM, 0.5)
        )
        puddle = v8.select(is_ground, puddle * v8.broadcast(water.wetness), _splat(0))
        distance = v8.sqrt(_dot(px, py, pz, px, py, pz))
        inverse_distance = ones / distance
        footprint = v8.maximum(v8.negate(pz * inverse_distance), _splat(MIN_FOOTPRINT_SINE))
        footprint = distance * v8.broadcast(lens[1]) / footprint
        coarse = _splat(COARSE_AMPLITUDE) * _clamp(
            _linear(footprint, -1 / COARSE_TEXEL_M, 2.0), 0.0, 1.0
        )
        coarse = _mottle(noise, px, py, coarse, 1 / COARSE_TEXEL_M, eye[4], eye[5], texels, spare)
        fine = _splat(FINE_AMPLITUDE) * _clamp(_linear(footprint, -1 / FINE_TEXEL_M, 2.0), 0.0, 1.0)
        fine = _mottle(noise, px, py, fine, 1 / FINE_TEXEL_M, eye[6], eye[7], texels, spare)
        sx, sy, variance = _ring_lanes(px, py, footprint, puddle, view.eye_xy, water, spare, drops)
        roughness, cover = _film_on_ground(track, puddle, coarse + fine, variance, water.wetness)
        asphalt_weight = puddle - ones
        nx = slope_x * asphalt_weight - sx * puddle
        ny = slope_y * asphalt_weight - sy * puddle
        nz = ones / v8.sqrt(v8.fmuladd(nx, nx, v8.fmuladd(ny, ny, ones)))
        nx = nx * nz
        ny = ny * nz
        cosine = v8.negate(_dot(nx, ny, nz, px, py, pz) * inverse_distance)
        cosine = _clamp(cosine, 0.005, 1.0)
        # The mirrored ray is 2 cosine normal - direction to the eye; find the point that it meets.
        mx = px - v8.broadcast(offset[0])
        my = py - v8.broadcast(offset[1])
        mz = pz - v8.broadcast(offset[2])
        column, row = _project(mirror, mx, my, mz)
        mirror_distance = _distance_at(mirror, mirror_depth, column, row, px, py, pz, texels, spare)
        double_cosine = cosine + cosine
        column, row = _project(
            mirror,
            v8.fmuladd(mirror_distance, v8.fmuladd(px, inverse_distance, double_cosine * nx), mx),
            v8.fmuladd(mirror_distance, v8.fmuladd(py, inverse_distance, double_cosine * ny), my),
            v8.fmuladd(mirror_distance, v8.fmuladd(pz, inverse_distance, double_cosine * nz), mz),
        )
        sigma = (
            v8.broadcast(np.float32(2) / lens[1])
            * roughness
            * mirror_distance
            / (mirror_distance + distance)
        )
        sigma = sigma * sigma / (sigma + _splat(MIN_BLUR_PX))
        sigma = v8.maximum(sigma * v8.broadcast(mirror.lens[1] * lens[1]), ones)
        red, green, blue = _look_up_mirror(
            mirror, colors, levels, column, row, sigma, texels, spare
        )
        strength = ground_share * cover * _reflectance(cosine, roughness)
        r, g, b_ = v8.load_colours(rgb, Index(3) * pixel)
        red = v8.select(is_ground, _mix_light(r, red, strength), r)
        green = v8.select(is_ground, _mix_light(g, green, strength), g)
        blue = v8.select(is_ground, _mix_light(b_, blue, strength), b_)
        v8.store_colours(rgb, Index(3) * pixel, red, green, blue)


@kernel
def shade_wet(
    view, cells, width, depth, share, mirror, colors, levels, mirror_depth, water, noise, rgb
):
    """Mix reflections into rgb [3 H W], in place, where share says how much is open ground.

    cells, depth, share: as of find_ground. colors: flat, linear light of the mirror's levels one
    after another, and two numbers more. levels [2, NUM_LEVELS]: first texel and number of rows of
    each. mirror_depth: flat, z, 0 for the sky. noise: flat, MOTTLE_SIDE squared.
    """
    for y in prange(depth.size // width):
        _shade_row(
            np.int64(y),
            width,
            view,
            cells,
            depth,
            share,
            mirror,
            colors,
            levels,
            mirror_depth,
            water,
            noise,
            rgb,
        )


# ---- A road that gets wet and dries --------------------------------------------------------------

# Channels of the map that says how a road dries, see drying.DryingMap.
DRYING_RANK, PUDDLE_RANK, TRACK, NUM_DRYING_CHANNELS = range(4)
# Share of the largest film at which the first places are dry; assumed.
FIRST_DRY_SHARE = 0.65
# Film from which on ground is as dark as it gets, mm; assumed.
DARK_FILM_MM = 0.06
# Largest film from which on no place is left that no drop has hit, mm; stains cover 99 % at it.
EVEN_FILM_MM = 0.15
# Film below which stones of asphalt break the mirror image, mm; assumed.
MATT_FILM_MM = 0.04
# Change of the drying rank per deviation of the coarse and of the fine noise.
COARSE_RANK = 0.05
FINE_RANK = 0.015
# Side of the table of stains, texels; a power of 2.
STAIN_SIDE = 1024
# Side of its texels, metres.
STAIN_TEXEL_M = 0.001
# Number of levels of the table; each halves its side.
NUM_STAIN_LEVELS = 6


class RoadWaterNumbers(NamedTuple):
    """Water on a road at one moment, see drying.RoadFilm."""

    film_share: Any  # film over the largest since the road was dry
    peak_mm: Any  # that largest film, mm
    full_mm: Any  # film of a full road, mm
    hit_share: Any  # share of the ground that an even film has reached
    film_wetness: Any  # wetness under a full film
    puddle_wetness: Any  # wetness under puddles
    track_loss: Any  # share of the film that wheels have pushed out of their tracks
    spots: Any  # share of the ground that drops have stained
    puddle_threshold: Any  # value of PUDDLE_RANK above which water stands
    # Light that a white surface reflects, and Angstrom's (1 - R) (1 - p) and p.
    white: Any
    wet_gain: Any
    wet_loss: Any


@kernel_function()
def _stain_lanes(stains, px, py, texel_size, mean, eye_xy, texels, spare):
    """Return the share of stained ground about points; `mean` where texels are larger than all."""
    v8.store(spare, Index(0), px)
    v8.store(spare, Index(NUM_LANES), py)
    level_of = log2(texel_size * _splat(1 / STAIN_TEXEL_M))
    is_small = v8.greater(_splat(NUM_STAIN_LEVELS - 1), level_of)
    v8.store(spare, Index(RESULTS_START), level_of)
    for lane in range(_lanes_if(_any(is_small))):
        level = max(spare[Index(RESULTS_START) + lane], np.float32(0))
        value = np.float32(mean)
        if level < np.float32(NUM_STAIN_LEVELS - 1):
            k = np.int64(level)
            x = eye_xy[0] + spare[lane]
            y = eye_xy[1] + spare[lane + Index(NUM_LANES)]
            below = _stain_at(stains, k, x, y)
            above = np.float32(mean)
            if k + 1 < NUM_STAIN_LEVELS - 1:
                above = _stain_at(stains, k + 1, x, y)
            value = below + (above - below) * (level - np.float32(k))
        spare[Index(RESULTS_START) + lane] = value
    return v8.select(is_small, v8.load(spare, Index(RESULTS_START)), _splat(mean))


@kernel_function()
def _stain_at(stains, level, x, y):
    """Return one level of the table between its texels, at world x and y."""
    side = STAIN_SIDE >> level
    start = (STAIN_SIDE * STAIN_SIDE - side * side) * 4 // 3  # texels of all finer levels
    scale = 1.0 / (STAIN_TEXEL_M * (1 << level))
    u = x * scale - 0.5
    v = y * scale - 0.5
    i = math.floor(u)
    j = math.floor(v)
    u = np.float32(u - i)
    v = np.float32(v - j)
    left = np.int64(i) & (side - 1)
    right = (left + 1) & (side - 1)
    low = start + (np.int64(j) & (side - 1)) * side
    high = start + ((np.int64(j) + 1) & (side - 1)) * side
    a = stains[low + left] + (stains[low + right] - stains[low + left]) * u
    b = stains[high + left] + (stains[high + right] - stains[high + left]) * u
    return a + (b - a) * v


@kernel_function()
def _wet_light(encoded, wetness, water):
    """Return display-encoded values of ground of which a share is wet."""
    linear = _to_linear(encoded)
    albedo = _clamp(linear * v8.broadcast(np.float32(1) / water.white), 1e-4, 0.95)
    ones = _splat(1)
    ratio = v8.broadcast(water.wet_gain) / (ones - v8.broadcast(water.wet_loss) * albedo)
    return _to_display(linear * v8.fmuladd(wetness, ratio - ones, ones))


@kernel_function()
def _wet_row(line, width, view, drying, depth, share, water, noise, stains, rgb):
    """Darken one row of the image, and find how much of each pixel mirrors."""
    view = _read_view(view)
    lens = view.lens
    axes = view.axes
    eye = view.eye
    texels = np.empty(2 * NUM_LANES, np.int32)
    spare = np.empty(SPARE_SIZE, np.float32)
    ones = _splat(1)
    zero = _splat(0)
    b = v8.broadcast((np.float32(line) + np.float32(0.5) - lens[3]) * lens[1])
    has_stains = np.float32(0) < water.spots and water.spots < np.float32(1)
    full_mm = v8.broadcast(np.float32(1) / (water.full_mm - np.float32(MATT_FILM_MM)))
    film_mirror = water.film_wetness / water.puddle_wetness
    for j in range(0, width, NUM_LANES):
        first = min(j, width - NUM_LANES)
        pixel = Index(line * width + first)
        ground_share = v8.load(share, pixel)
        is_ground = v8.mask_and(
            v8.greater(ground_share, zero), v8.at_least(v8.lane_numbers(), _splat(j - first))
        )
        if not _any(is_ground):
            continue
        a = _ray_x(first, lens)
        z = v8.select(is_ground, v8.load(depth, pixel), ones)
        px = z * _rotate(axes[0], a, b, ones)
        py = z * _rotate(axes[1], a, b, ones)
        pz = z * _rotate(axes[2], a, b, ones)
        _find_cells(px, py, view, texels, spare)
        _interpolate_channels(
            drying, NUM_DRYING_CHANNELS, view.columns, DRYING_RANK, 3, texels, spare
        )
        rank = v8.load(spare, Index(RESULTS_START))
        puddle_rank = v8.load(spare, Index(RESULTS_START + NUM_LANES))
        track = v8.load(spare, Index(RESULTS_START + 2 * NUM_LANES))
        distance = v8.sqrt(_dot(px, py, pz, px, py, pz))
        sine = v8.maximum(v8.negate(pz) / distance, _splat(MIN_FOOTPRINT_SINE))
        across = distance * v8.broadcast(lens[1])
        footprint = across / sine
        coarse = _splat(COARSE_RANK) * _clamp(
            _linear(footprint, -1 / COARSE_TEXEL_M, 2.0), 0.0, 1.0
        )
        rank = rank + _mottle(
            noise, px, py, coarse, 1 / COARSE_TEXEL_M, eye[4], eye[5], texels, spare
        )
        fine = _splat(FINE_RANK) * _clamp(_linear(footprint, -1 / FINE_TEXEL_M, 2.0), 0.0, 1.0)
        rank = rank + _mottle(noise, px, py, fine, 1 / FINE_TEXEL_M, eye[6], eye[7], texels, spare)
        # Film at which the place is dry, over the largest; then the film that lies there, mm.
        dry_share = _splat(FIRST_DRY_SHARE) * (ones - _clamp(rank, 0.0, 1.0))
        film = v8.maximum(v8.broadcast(water.film_share) - dry_share, zero) / (ones - dry_share)
        film = film * v8.broadcast(water.peak_mm)
        film = film * (ones - v8.broadcast(water.track_loss) * track)
        dark = v8.broadcast(water.hit_share) * _smoothstep(film * _splat(1 / DARK_FILM_MM))
        mirror = _smoothstep((film - _splat(MATT_FILM_MM)) * full_mm)
        if has_stains:
            size = across / v8.sqrt(sine)
            spots = _stain_lanes(stains, px, py, size, water.spots, view.eye_xy, texels, spare)
            dark = v8.maximum(dark, spots)
        else:
            dark = v8.maximum(dark, v8.broadcast(water.spots))
        puddle = _smoothstep(
            _linear(puddle_rank - v8.broadcast(water.puddle_threshold), 0.5 / PUDDLE_RIM, 0.5)
        )
        dark = v8.maximum(
            dark * v8.broadcast(water.film_wetness), puddle * v8.broadcast(water.puddle_wetness)
        )
        mirror = v8.maximum(mirror * v8.broadcast(film_mirror), puddle)
        v8.store(share, pixel, v8.select(is_ground, ground_share * mirror, ground_share))
        dark = v8.select(is_ground, dark * ground_share, zero)
        if not _any(v8.greater(dark, zero)):
            continue
        red, green, blue = v8.load_colours(rgb, Index(3) * pixel)
        red = v8.select(is_ground, _wet_light(red, dark, water), red)
        green = v8.select(is_ground, _wet_light(green, dark, water), green)
        blue = v8.select(is_ground, _wet_light(blue, dark, water), blue)
        v8.store_colours(rgb, Index(3) * pixel, red, green, blue)


@kernel
def wet_ground(view, drying, width, depth, share, water, noise, stains, rgb):
    """Darken ground in rgb [3 H W], in place, by the film that lies on it.

    share [H W], as of find_ground, receives the share of each pixel whose film mirrors.
    drying: flat, NUM_DRYING_CHANNELS of each cell of the map. depth: as of find_ground.
    noise: flat, MOTTLE_SIDE squared. stains: all levels of the table, flat.
    """
    for y in prange(depth.size // width):
        _wet_row(np.int64(y), width, view, drying, depth, share, water, noise, stains, rgb)


@kernel
def decode_srgb(rgb, linear):
    """Convert display-encoded numbers to linear light, in flat arrays of >= NUM_LANES numbers."""
    count = rgb.size
    for run in prange((count + VALUES_PER_TASK - 1) // VALUES_PER_TASK):
        start = np.int64(run) * VALUES_PER_TASK
        for i in range(start, min(start + VALUES_PER_TASK, count), NUM_LANES):
            at = Index(min(i, count - NUM_LANES))
            v8.store(linear, at, _to_linear(v8.load(rgb, at)))


# ---- Rings on a flood ----------------------------------------------------------------------------


@kernel_function()
def _add_rings_in_row(
    line, axes, centre, height, lens, rings, seed, timestamp_ns, nxs, nys, variance
):
    """Add rings to one row of the image."""
    drops = np.full((MAX_NEARBY_DROPS + 1, 4), np.nan)
    b = (line + 0.5 - lens[3]) / lens[1]
    for x in range(nxs.shape[1]):
        a = (x + 0.5 - lens[2]) / lens[0]
        fall = -(axes[2, 0] * a + axes[2, 1] * b + axes[2, 2])
        if not fall > MIN_FALL:
            continue
        z = height / fall
        px = centre[0] + z * (axes[0, 0] * a + axes[0, 1] * b + axes[0, 2])
        py = centre[1] + z * (axes[1, 0] * a + axes[1, 1] * b + axes[1, 2])
        length = math.sqrt(1.0 + a * a + b * b)
        footprint = z * length / lens[1] / max(fall / length, MIN_FOOTPRINT_SINE)
        sx, sy, rest_variance = rings_at(px, py, footprint, rings, seed, timestamp_ns, drops)
        nx = np.float64(nxs[line, x])
        ny = np.float64(nys[line, x])
        nz = math.sqrt(max(1.0 - nx * nx - ny * ny, 1e-6))
        gx = nx / nz - sx
        gy = ny / nz - sy
        scale = 1.0 / math.sqrt(gx * gx + gy * gy + 1.0)
        nxs[line, x] = np.float32(gx * scale)
        nys[line, x] = np.float32(gy * scale)
        variance[line, x] += np.float32(0.5 * rest_variance)


@kernel
def add_rings(axes, centre, height, lens, rings, seed, timestamp_ns, normal_x, normal_y, variance):
    """Add rings to the waves of a level plane, `height` below the eye, in place.

    normal_x, normal_y, variance: [H, W], normals' x and y and the variance of slope. axes: [3, 3],
    world_from_camera. centre: world x and y.
    """
    for y in prange(normal_x.shape[0]):
        _add_rings_in_row(
            np.int64(y),
            axes,
            centre,
            height,
            lens,
            rings,
            seed,
            timestamp_ns,
            normal_x,
            normal_y,
            variance,
        )
