"""Kernels of wet ground: which pixels show it, and what its film mirrors. `reflection` and
`ripples` define what they compute, and launch them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.kernels import mix
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import inner, kernel
from augment.render.cpu.simd import LOG2_E, exp2_fine, log2
from augment.render.layout import LANES, U
from augment.rng import STEP_X, STEP_Y

# Channels of the ground's map.
HEIGHT, OPEN, RISE_X, RISE_Y, HOLLOW, TRACK, CHANNELS = range(7)

# ---- Rings of drops ------------------------------------------------------------------------------

SQUARE_M = 0.12  # a ring ends before it is as wide
MAX_DROPS = 2  # in a square at a time
AT = 9 * MAX_DROPS  # rows of drops that may reach a square; one more names it
LIFE_NS = 400_000_000
SPEED_MPS = 0.23  # least of capillary-gravity waves on water, whose length is 1.7 cm
WAVE_M, WIDTH_M, SLOPE = 0.022, 0.016, 0.1
ENDS = 3.0  # widths beyond which a ring is none
LEAST_FALL = 1e-7  # of a ray that meets a plane, at unit depth
LEAST_SINE = 0.02  # of the angle at which a pixel's footprint is judged
FADED_PX, FULL_PX = 2.0, 4.0  # waves of so many pixels are gone, and full
_X, _Y = np.uint64(STEP_X), np.uint64(STEP_Y)
_S24, _S44 = np.uint64(24), np.uint64(44)
_LOW20, _LIFE, _UNIT = np.uint64(0xFFFFF), np.uint64(LIFE_NS), 2.0**-20


@inner()
def _find_drops(column, row, rings, seed, timestamp_ns, drops):
    """Enter the rings that may reach a square: how many, and x, y, radius and slope of each."""
    reach = SPEED_MPS * LIFE_NS * 1e-9
    found = 0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            i, j = column + di, row + dj
            place = np.uint64(np.int64(i)) * _X + np.uint64(np.int64(j)) * _Y
            for drop in range(MAX_DROPS):
                first = mix(place + seed + np.uint64(drop))
                passed = timestamp_ns + np.int64((first >> _S24) % _LIFE)
                again, age = passed // LIFE_NS, (passed % LIFE_NS) / LIFE_NS
                bits = mix(first ^ (np.uint64(again) * _X))
                if np.float64(np.int64(bits & _LOW20)) * _UNIT < rings[0]:
                    u = np.float64(np.int64(bits >> _S44)) * _UNIT
                    v = np.float64(np.int64((bits >> _S24) & _LOW20)) * _UNIT
                    drops[found, 0], drops[found, 1] = (i + u) * SQUARE_M, (j + v) * SQUARE_M
                    drops[found, 2] = reach * age
                    drops[found, 3] = SLOPE * (1.0 - age) * (1.0 - age)
                    found += 1
    drops[AT, 0], drops[AT, 1], drops[AT, 2] = column, row, found


@inner()
def rings_at(x, y, footprint, rings, seed, timestamp_ns, drops):
    """(slope x, slope y, variance of the rest). rings: share, variance, unseen. drops [AT + 1, 4]:
    those about the square of the last point, which its last row names.
    """
    shown = (WAVE_M / max(footprint, 1e-9) - FADED_PX) / (FULL_PX - FADED_PX)
    shown = min(max(shown, 0.0), 1.0)
    shown = shown * shown * (3.0 - 2.0 * shown)
    variance = rings[1] + (rings[2] - rings[1]) * shown * shown
    sx = sy = 0.0
    if shown <= 0.0 or rings[0] <= 0.0:
        return sx, sy, variance
    column, row = math.floor(x / SQUARE_M), math.floor(y / SQUARE_M)
    if not (drops[AT, 0] == column and drops[AT, 1] == row):
        _find_drops(column, row, rings, seed, timestamp_ns, drops)
    for k in range(np.int64(drops[AT, 2])):
        dx, dy = x - drops[k, 0], y - drops[k, 1]
        d = max(math.sqrt(dx * dx + dy * dy), 1e-4)
        off = (d - drops[k, 2]) / WIDTH_M
        if abs(off) > ENDS:
            continue
        s = drops[k, 3] * math.exp(-off * off)
        s *= math.sin((2.0 * math.pi * WIDTH_M / WAVE_M) * off) / d
        sx += s * dx
        sy += s * dy
    return sx * shown, sy * shown, variance


# ---- Eight pixels at a time ----------------------------------------------------------------------


@inner()
def _splat(number):
    return v8.splat(np.float32(number))


@inner()
def _clamp(value, low, high):
    """low where it is NaN."""
    return v8.minimum(v8.maximum(value, _splat(low)), _splat(high))


@inner()
def _line(value, slope, offset):
    return v8.fmuladd(value, _splat(slope), _splat(offset))


@inner()
def _smoothstep(t):
    """From 0 at t = 0 to 1 at 1."""
    t = _clamp(t, 0.0, 1.0)
    return t * t * _line(t, -2.0, 3.0)


@inner()
def _dot(x, y, z, a, b, c):
    return v8.fmuladd(x, a, v8.fmuladd(y, b, z * c))


@inner()
def _turn(row, x, y, z):
    """A row of a matrix times vectors."""
    return _dot(x, y, z, v8.splat(row[0]), v8.splat(row[1]), v8.splat(row[2]))


@inner()
def _across(first, lens):
    """x at unit depth of the pixels from column `first` on. lens: 1 / fx, 1 / fy, cx, cy."""
    middle = v8.splat(np.float32(first) + np.float32(0.5) - lens[2])
    return (middle + v8.lane_numbers()) * v8.splat(lens[0])


@inner()
def _any(mask):
    return v8.mask_bits(mask) != U(0)


@inner()
def _store_places(places, spare, u, v, i, j):
    """Texels of float coordinates, column and row, and shares of the way to the next ones."""
    v8.store_whole(places, U(0), i)
    v8.store_whole(places, U(LANES), j)
    v8.store(spare, U(0), u - i)
    v8.store(spare, U(LANES), v - j)


# ---- Which pixels show open ground ---------------------------------------------------------------
# In the loops over pixels tuples hold numbers alone: numba counts references to arrays of records,
# which takes longer than the arithmetic. `spare` is what lanes are handed over in: shares of the
# way to the next texels, then, from OUT on, results.

NEAR_OFF, NEAR_PER_M = 0.08, 0.003  # metres off the ground's height that a pixel surely may be
FAR_OFF, FAR_PER_M = 0.2, 0.008  # and where it is something else
FAINT = 0.004  # shares below this are none
OUT, SPARE = 2 * LANES, 8 * LANES


class View(NamedTuple):
    """lens: 1 / fx, 1 / fy, cx, cy. axes [3, 3]: world_from_camera. eye [8]: its column and row in
    the map, from the first cell's middle on, cells per metre, z; its columns and rows in the coarse
    and in the fine mottle, less whole turns. place: its x and y, float64. rows, columns: of the
    map, 2 at least. `_read_view` makes tuples of the arrays.
    """

    lens: Any
    axes: Any
    eye: Any
    place: Any
    rows: Any
    columns: Any


@inner()
def _read_view(view):
    lens, eye = view.lens, view.eye
    return View(
        (lens[0], lens[1], lens[2], lens[3]),
        _read_matrix(view.axes),
        (eye[0], eye[1], eye[2], eye[3], eye[4], eye[5], eye[6], eye[7]),
        (view.place[0], view.place[1]),
        view.rows,
        view.columns,
    )


@inner()
def _read_matrix(m):
    return ((m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2]))


@inner()
def _find_cells(px, py, view, places, spare):
    """Whether points from the eye lie on the map; finds the cells below left of them."""
    eye, zero, per_m = view.eye, _splat(0), v8.splat(view.eye[2])
    u, v = v8.fmuladd(px, per_m, v8.splat(eye[0])), v8.fmuladd(py, per_m, v8.splat(eye[1]))
    inside = v8.both(v8.at_least(u, zero), v8.at_least(_splat(view.columns - 1), u))
    inside = v8.both(inside, v8.at_least(v, zero))
    inside = v8.both(inside, v8.at_least(_splat(view.rows - 1), v))
    i, j = v8.floor(_clamp(u, 0, view.columns - 2)), v8.floor(_clamp(v, 0, view.rows - 2))
    _store_places(places, spare, u, v, i, j)
    return inside


@inner()
def _look_up(cells, columns, channel, count, places, spare):
    """spare[OUT + k LANES + lane]: `count` channels from `channel` on, between the map's cells."""
    step, down = U(CHANNELS), U(columns * CHANNELS)
    for lane in range(U(LANES)):
        first = U(places[lane + U(LANES)]) * down + U(places[lane]) * step + U(channel)
        u, v = spare[lane], spare[lane + U(LANES)]
        for k in range(U(count)):
            at = first + k
            a = cells[at] + (cells[at + step] - cells[at]) * u
            at += down
            b = cells[at] + (cells[at + step] - cells[at]) * u
            spare[U(OUT) + k * U(LANES) + lane] = a + (b - a) * v


@inner()
def _find_in_row(row, width, view, cells, depth, shown, share):
    view = _read_view(view)
    lens, axes = view.lens, view.axes
    places, spare = np.empty(2 * LANES, np.int32), np.empty(SPARE, np.float32)
    zero, one, half = _splat(0), _splat(1), np.float32(0.5)
    down = (np.float32(row) + half - lens[3]) * lens[1]
    b, best = v8.splat(down), zero
    for x in range(U(row * width), U((row + 1) * width)):
        share[x] = np.float32(0)
    left, right = (half - lens[2]) * lens[0], (np.float32(width) - half - lens[2]) * lens[0]
    level = axes[2][1] * down + axes[2][2]
    if min(axes[2][0] * left, axes[2][0] * right) + level >= np.float32(0):
        return np.float32(0)
    for j in range(0, width, LANES):
        first = min(j, width - LANES)  # the last eight of a row take those before them
        pixel = U(row * width + first)
        z, own, a = v8.load(depth, pixel), v8.load(shown, pixel), _across(first, lens)
        rise = _turn(axes[2], a, b, one)
        falls = v8.both(v8.greater(z, zero), v8.greater(own, zero))
        falls = v8.both(falls, v8.greater(zero, rise))
        if not _any(falls):
            continue
        px, py, pz = z * _turn(axes[0], a, b, one), z * _turn(axes[1], a, b, one), z * rise
        falls = v8.both(falls, _find_cells(px, py, view, places, spare))
        if not _any(falls):
            continue
        _look_up(cells, view.columns, HEIGHT, 2, places, spare)
        off = v8.absolute(pz + v8.splat(view.eye[3]) - v8.load(spare, U(OUT)))
        distance = z * v8.sqrt(_dot(a, b, one, a, b, one))
        near = _line(distance, NEAR_PER_M, NEAR_OFF)
        gap = _line(distance, FAR_PER_M - NEAR_PER_M, FAR_OFF - NEAR_OFF)
        own = own * v8.load(spare, U(OUT + LANES)) * (one - _smoothstep((off - near) / gap))
        own = v8.select(v8.both(falls, v8.greater(own, _splat(FAINT))), own, zero)
        v8.store(share, pixel, own)
        best = v8.maximum(best, own)
    v8.store(spare, U(0), best)
    most = spare[0]
    for lane in range(1, LANES):
        most = max(most, spare[lane])
    return most


@kernel
def find_ground(view, cells, width, depth, shown, share, most):
    """share [H W]: of each pixel that is open ground; most [H]: of a row's pixels.

    cells: the map, flat, CHANNELS of each cell. depth, shown: [H W]. W >= LANES.
    """
    for y in prange(most.size):
        most[y] = _find_in_row(np.int64(y), width, view, cells, depth, shown, share)


# ---- What the film mirrors -----------------------------------------------------------------------

R0 = 0.0201  # of water under a right angle
ASPHALT, PUDDLE = 0.085, 0.008  # standard deviations of slopes: alpha / sqrt 2 of 0.12 and 0.011
TRACK_SMOOTHS = 0.35  # share of the roughness that wheels have polished away
FILM = 0.75  # of wet asphalt that shows water: stones stand out of it
RIM = 0.12  # of a puddle, in HOLLOW
MOTTLE_SIDE = 256  # a power of 2: texels of the noise that makes film and roughness uneven
FINE_M, COARSE_M = 0.012, 0.2  # its texels
FINE, COARSE = 0.07, 0.05  # by how much of the film
LEVELS = 9  # of the mirrored picture: sharp, and blurred upright by 2 to 256 pixels
SHARP_PX = 2.0  # of the image: blurs of less are none
FARTHEST_M = 1e5  # stands for the sky
RUN = 6144  # numbers that a thread decodes at a time
_LEAST = 1e-6  # what 1 - cosine is at least
_PER_ROW = np.array([0.5 ** max(k - 1, 0) for k in range(LEVELS)], np.float32)


class Mirrored(NamedTuple):
    """lens: fx, fy, cx, cy; rotation [3, 3] (camera_from_world): of the mirrored camera. offset
    [3]: its centre, from the eye. width: of all its levels, 2 at least. rows: of the first.
    """

    lens: Any
    rotation: Any
    offset: Any
    width: Any
    rows: Any


@inner()
def _read_mirror(mirror):
    lens, offset = mirror.lens, mirror.offset
    return Mirrored(
        (lens[0], lens[1], lens[2], lens[3]),
        _read_matrix(mirror.rotation),
        (offset[0], offset[1], offset[2]),
        mirror.width,
        mirror.rows,
    )


class Water(NamedTuple):
    """wetness, level: see reflection.Film. rings: share, variance, unseen."""

    wetness: Any
    level: Any
    rings: Any
    seed: Any
    timestamp_ns: Any


@inner()
def _read_water(water):
    rings = water.rings[0], water.rings[1], water.rings[2]
    return Water(water.wetness, water.level, rings, water.seed, water.timestamp_ns)


@inner()
def _lanes_if(condition):
    """How often a loop over lanes runs. Numba prunes references of arrays that a loop uses, but not
    of those that a branch does.
    """
    return U(LANES) if condition else U(0)


@inner()
def _mottle(noise, px, py, weight, per_texel, column, row, places, spare):
    """Weighted noise. column, row: the eye's."""
    u = v8.fmuladd(px, _splat(per_texel), v8.splat(column))
    v = v8.fmuladd(py, _splat(per_texel), v8.splat(row))
    _store_places(places, spare, u, v, v8.floor(u), v8.floor(v))
    side, wrap = U(MOTTLE_SIDE), np.int32(MOTTLE_SIDE - 1)
    counts = v8.greater(weight, _splat(0))
    for lane in range(_lanes_if(_any(counts))):
        i, j = places[lane], places[lane + U(LANES)]
        left, right = U(i & wrap), U((i + np.int32(1)) & wrap)
        low, high = U(j & wrap) * side, U((j + np.int32(1)) & wrap) * side
        a = noise[low + left] + (noise[low + right] - noise[low + left]) * spare[lane]
        b = noise[high + left] + (noise[high + right] - noise[high + left]) * spare[lane]
        spare[U(OUT) + lane] = a + (b - a) * spare[lane + U(LANES)]
    return v8.select(counts, weight * v8.load(spare, U(OUT)), _splat(0))


@inner()
def _ring_lanes(px, py, footprint, puddle, place, water, spare, drops):
    """`rings_at` where puddles are: see there."""
    shown = v8.both(v8.greater(puddle, _splat(0)), v8.greater(_splat(WAVE_M / FADED_PX), footprint))
    v8.store(spare, U(0), px)
    v8.store(spare, U(LANES), py)
    v8.store(spare, U(OUT), _splat(0))
    v8.store(spare, U(OUT + LANES), _splat(0))
    v8.store(spare, U(OUT + 2 * LANES), _splat(water.rings[1]))
    v8.store(spare, U(OUT + 3 * LANES), v8.select(shown, footprint, _splat(0)))
    for lane in range(_lanes_if(water.rings[0] > 0 and _any(shown))):
        at = U(OUT) + lane
        wide = spare[at + U(3 * LANES)]
        if wide > np.float32(0):
            x, y = place[0] + spare[lane], place[1] + spare[lane + U(LANES)]
            sx, sy, rest = rings_at(
                x, y, np.float64(wide), water.rings, water.seed, water.timestamp_ns, drops
            )
            spare[at] = np.float32(sx)
            spare[at + U(LANES)] = np.float32(sy)
            spare[at + U(2 * LANES)] = np.float32(rest)
    slopes = v8.load(spare, U(OUT)), v8.load(spare, U(OUT + LANES))
    return slopes[0], slopes[1], v8.load(spare, U(OUT + 2 * LANES))


@inner()
def _reflectance(cosine, rough):
    """As reflection.mean_reflectance."""
    one = _splat(1)
    power = _splat(5) * exp2_fine(rough * _splat(-2.69 * LOG2_E))
    base = v8.maximum(one - cosine, _splat(_LEAST))
    rest = exp2_fine(v8.maximum(power * log2(base), _splat(-126)))
    rest = rest / _line(rough * v8.sqrt(rough), 22.7, 1.0)
    return _line(rest, 1 - R0, R0)


@inner()
def _to_linear(value):
    """Linear light of display-encoded values."""
    value = v8.maximum(value, _splat(0))
    high = exp2_fine(_splat(2.4) * log2(_line(value, 1 / 1.055, 0.055 / 1.055)))
    low = value * _splat(1 / 12.92)
    return v8.select(v8.greater(value, _splat(0.04045)), high, low)


@inner()
def _to_display(linear):
    """Display-encoded values of linear light; of what is below 0, those of 0."""
    high = exp2_fine(_splat(1 / 2.4) * log2(v8.maximum(linear, _splat(0.0031308))))
    low = v8.maximum(linear, _splat(0)) * _splat(12.92)
    return v8.select(v8.greater(linear, _splat(0.0031308)), _line(high, 1.055, -0.055), low)


@inner()
def _project(mirror, x, y, z):
    """Column and row of points from the mirrored eye."""
    lens, rotation = mirror.lens, mirror.rotation
    per_z = _splat(1) / v8.maximum(_turn(rotation[2], x, y, z), _splat(1e-3))
    column, row = _turn(rotation[0], x, y, z) * per_z, _turn(rotation[1], x, y, z) * per_z
    column = v8.fmuladd(v8.splat(lens[0]), column, v8.splat(lens[2]))
    return column, v8.fmuladd(v8.splat(lens[1]), row, v8.splat(lens[3]))


@inner()
def _way_at(mirror, depth, column, row, px, py, pz, places, spare):
    """Metres from points of the ground to what the mirrored picture shows."""
    lens, m, offset, width = mirror.lens, mirror.rotation, mirror.offset, U(mirror.width)
    i = v8.floor(_clamp(column, 0, mirror.width - 1))
    j = v8.floor(_clamp(row, 0, mirror.rows - 1))
    v8.store_whole(places, U(0), i)
    v8.store_whole(places, U(LANES), j)
    for lane in range(U(LANES)):
        spare[lane] = depth[U(places[lane + U(LANES)]) * width + U(places[lane])]
    z, half, one = v8.load(spare, U(0)), np.float32(0.5), np.float32(1)
    a = (i + v8.splat(half - lens[2])) * v8.splat(one / lens[0]) * z
    b = (j + v8.splat(half - lens[3])) * v8.splat(one / lens[1]) * z
    x = _turn((m[0][0], m[1][0], m[2][0]), a, b, z) + v8.splat(offset[0]) - px
    y = _turn((m[0][1], m[1][1], m[2][1]), a, b, z) + v8.splat(offset[1]) - py
    up = _turn((m[0][2], m[1][2], m[2][2]), a, b, z) + v8.splat(offset[2]) - pz
    way = v8.sqrt(_dot(x, y, up, x, y, up))
    return v8.select(v8.greater(z, _splat(0)), way, _splat(FARTHEST_M))


@inner()
def _look_at(mirror, colors, levels, column, row, sigma, places, spare):
    """Linear light of the mirrored picture at points, blurred upright by sigma >= 1 pixels."""
    low = v8.floor(_clamp(log2(sigma), 0, LEVELS - 2))
    upper = _clamp(sigma / exp2_fine(low) - _splat(1), 0, 1)
    x = _clamp(column - _splat(0.5), 0, mirror.width - 1)
    i = v8.minimum(v8.floor(x), _splat(mirror.width - 2))
    _store_places(places, spare, x, upper + low, i, low)
    v8.store(spare, U(OUT), _clamp(row, -1e6, 1e6))
    pixel, wide = U(3), U(3 * mirror.width)
    red, green, blue = U(OUT + 2 * LANES), U(OUT + 3 * LANES), U(OUT + 4 * LANES)
    for lane in range(U(LANES)):
        level, y, color = U(places[lane + U(LANES)]), spare[U(OUT) + lane], _splat(0)
        for k in range(U(2)):
            last = np.int64(levels[U(1), level]) - 1
            v = y * _PER_ROW[level] - np.float32(0.5)
            v = min(max(v, np.float32(0)), np.float32(last))
            j = np.int64(v)
            at = pixel * (U(levels[U(0), level]) + U(places[lane])) + U(j) * wide
            above = v8.load(colors, at)
            below = v8.load(colors, at + (wide if j < last else U(0)))
            between = v8.fmuladd(v8.splat(v - np.float32(j)), below - above, above)
            weight = spare[lane + U(LANES)] if k else np.float32(1) - spare[lane + U(LANES)]
            color = v8.fmuladd(v8.splat(weight), between, color)
            level += U(1)
        v8.store(spare, U(OUT + LANES), color)  # of two texels side by side
        at, u = U(OUT + LANES), spare[lane]
        spare[red + lane] = spare[at] + (spare[at + U(3)] - spare[at]) * u
        spare[green + lane] = spare[at + U(1)] + (spare[at + U(4)] - spare[at + U(1)]) * u
        spare[blue + lane] = spare[at + U(2)] + (spare[at + U(5)] - spare[at + U(2)]) * u
    return v8.load(spare, red), v8.load(spare, green), v8.load(spare, blue)


@inner()
def _film(track, puddle, uneven, variance, wetness):
    """Deviation of slopes, and the share of the ground that the film covers."""
    one = _splat(1)
    rough = _splat(ASPHALT) * _line(track, -TRACK_SMOOTHS, 1.0) * (one - uneven)
    still = v8.sqrt(_line(variance, 0.5, PUDDLE * PUDDLE))
    film = _clamp(_line(track, 0.1, FILM) + uneven, 0.0, 1.0)
    cover = v8.splat(wetness) * v8.fmuladd(one - film, puddle, film)
    return v8.fmuladd(puddle, still - rough, rough), cover


@inner()
def _mixed(own, seen, strength):
    linear = _to_linear(own)
    return _to_display(v8.fmuladd(strength, seen - linear, linear))


@inner()
def _shade_row(
    line, width, view, cells, depth, share, mirror, colors, levels, mirror_depth, water, noise, rgb
):
    view, mirror, water = _read_view(view), _read_mirror(mirror), _read_water(water)
    lens, axes, eye, offset = view.lens, view.axes, view.eye, mirror.offset
    places, spare = np.empty(2 * LANES, np.int32), np.empty(SPARE, np.float32)
    drops, one = np.full((AT + 1, 4), np.nan), _splat(1)
    b = v8.splat((np.float32(line) + np.float32(0.5) - lens[3]) * lens[1])
    for j in range(0, width, LANES):
        # The last eight of a row take those before them, which stay as they are.
        first = min(j, width - LANES)
        pixel = U(line * width + first)
        own = v8.load(share, pixel)
        inside = v8.both(
            v8.greater(own, _splat(0)), v8.at_least(v8.lane_numbers(), _splat(j - first))
        )
        if not _any(inside):
            continue
        a, z = _across(first, lens), v8.select(inside, v8.load(depth, pixel), one)
        px, py = z * _turn(axes[0], a, b, one), z * _turn(axes[1], a, b, one)
        pz = z * _turn(axes[2], a, b, one)
        _find_cells(px, py, view, places, spare)
        _look_up(cells, view.columns, RISE_X, 4, places, spare)
        rise_x, rise_y = v8.load(spare, U(OUT)), v8.load(spare, U(OUT + LANES))
        hollow, track = v8.load(spare, U(OUT + 2 * LANES)), v8.load(spare, U(OUT + 3 * LANES))
        puddle = _smoothstep(_line(hollow - v8.splat(water.level), 0.5 / RIM, 0.5))
        puddle = v8.select(inside, puddle * v8.splat(water.wetness), _splat(0))
        distance = v8.sqrt(_dot(px, py, pz, px, py, pz))
        per_distance = one / distance
        footprint = v8.maximum(v8.negate(pz * per_distance), _splat(LEAST_SINE))
        footprint = distance * v8.splat(lens[1]) / footprint
        coarse = _splat(COARSE) * _clamp(_line(footprint, -1 / COARSE_M, 2.0), 0.0, 1.0)
        coarse = _mottle(noise, px, py, coarse, 1 / COARSE_M, eye[4], eye[5], places, spare)
        fine = _splat(FINE) * _clamp(_line(footprint, -1 / FINE_M, 2.0), 0.0, 1.0)
        fine = _mottle(noise, px, py, fine, 1 / FINE_M, eye[6], eye[7], places, spare)
        sx, sy, variance = _ring_lanes(px, py, footprint, puddle, view.place, water, spare, drops)
        rough, cover = _film(track, puddle, coarse + fine, variance, water.wetness)
        flat = puddle - one
        nx, ny = rise_x * flat - sx * puddle, rise_y * flat - sy * puddle
        nz = one / v8.sqrt(v8.fmuladd(nx, nx, v8.fmuladd(ny, ny, one)))
        nx, ny = nx * nz, ny * nz
        cosine = v8.negate(_dot(nx, ny, nz, px, py, pz) * per_distance)
        cosine = _clamp(cosine, 0.005, 1.0)
        # What a ray, 2 cosine normal - towards the eye, meets.
        mx, my, mz = px - v8.splat(offset[0]), py - v8.splat(offset[1]), pz - v8.splat(offset[2])
        column, row = _project(mirror, mx, my, mz)
        way = _way_at(mirror, mirror_depth, column, row, px, py, pz, places, spare)
        twice = cosine + cosine
        column, row = _project(
            mirror,
            v8.fmuladd(way, v8.fmuladd(px, per_distance, twice * nx), mx),
            v8.fmuladd(way, v8.fmuladd(py, per_distance, twice * ny), my),
            v8.fmuladd(way, v8.fmuladd(pz, per_distance, twice * nz), mz),
        )
        sigma = v8.splat(np.float32(2) / lens[1]) * rough * way / (way + distance)
        sigma = sigma * sigma / (sigma + _splat(SHARP_PX))
        sigma = v8.maximum(sigma * v8.splat(mirror.lens[1] * lens[1]), one)
        red, green, blue = _look_at(mirror, colors, levels, column, row, sigma, places, spare)
        strength = own * cover * _reflectance(cosine, rough)
        r, g, b_ = v8.load_colours(rgb, U(3) * pixel)
        red = v8.select(inside, _mixed(r, red, strength), r)
        green = v8.select(inside, _mixed(g, green, strength), g)
        blue = v8.select(inside, _mixed(b_, blue, strength), b_)
        v8.store_colours(rgb, U(3) * pixel, red, green, blue)


@kernel
def shade_wet(
    view, cells, width, depth, share, mirror, colors, levels, mirror_depth, water, noise, rgb
):
    """Mix reflections into rgb [3 H W], in place, where share says how much is open ground.

    cells, depth, share: as of find_ground. colors: flat, linear light of the mirror's levels one
    after the other, and two numbers more. levels [2, LEVELS]: first texel and rows of each.
    mirror_depth: flat, z, 0 of the sky. noise: flat, MOTTLE_SIDE squared.
    """
    for y in prange(depth.size // width):
        _shade_row(
            np.int64(y), width, view, cells, depth, share,
            mirror, colors, levels, mirror_depth, water, noise, rgb,
        )  # fmt: skip


@kernel
def decode(rgb, linear):
    """Linear light of display-encoded numbers, flat, LANES of them at least."""
    count = rgb.size
    for run in prange((count + RUN - 1) // RUN):
        start = np.int64(run) * RUN
        for i in range(start, min(start + RUN, count), LANES):
            at = U(min(i, count - LANES))
            v8.store(linear, at, _to_linear(v8.load(rgb, at)))


# ---- Rings on a flood ----------------------------------------------------------------------------


@inner()
def _add_in_row(line, axes, centre, height, lens, rings, seed, timestamp_ns, nxs, nys, variance):
    drops = np.full((AT + 1, 4), np.nan)
    b = (line + 0.5 - lens[3]) / lens[1]
    for x in range(nxs.shape[1]):
        a = (x + 0.5 - lens[2]) / lens[0]
        fall = -(axes[2, 0] * a + axes[2, 1] * b + axes[2, 2])
        if not fall > LEAST_FALL:
            continue
        z = height / fall
        px = centre[0] + z * (axes[0, 0] * a + axes[0, 1] * b + axes[0, 2])
        py = centre[1] + z * (axes[1, 0] * a + axes[1, 1] * b + axes[1, 2])
        length = math.sqrt(1.0 + a * a + b * b)
        footprint = z * length / lens[1] / max(fall / length, LEAST_SINE)
        sx, sy, rest = rings_at(px, py, footprint, rings, seed, timestamp_ns, drops)
        nx, ny = np.float64(nxs[line, x]), np.float64(nys[line, x])
        nz = math.sqrt(max(1.0 - nx * nx - ny * ny, 1e-6))
        gx, gy = nx / nz - sx, ny / nz - sy
        scale = 1.0 / math.sqrt(gx * gx + gy * gy + 1.0)
        nxs[line, x], nys[line, x] = np.float32(gx * scale), np.float32(gy * scale)
        variance[line, x] += np.float32(0.5 * rest)


@kernel
def add_rings(axes, centre, height, lens, rings, seed, timestamp_ns, normal_x, normal_y, variance):
    """Rings on the waves of a level plane, `height` below the eye, in place: normals' x and y, and
    the variance of slope, [H, W]. axes: world_from_camera [3, 3]. centre: world x and y.
    """
    for y in prange(normal_x.shape[0]):
        _add_in_row(
            np.int64(y), axes, centre, height, lens, rings, seed, timestamp_ns,
            normal_x, normal_y, variance,
        )  # fmt: skip
