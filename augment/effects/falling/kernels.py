"""Numba kernels: which drops a camera sees, what of a pixel they cover, the veil of the rest."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.effects.falling.drops import CELL_FACTORS, MAX_IN_CELL, NUM_CLASSES
from augment.kernels import mix
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import inner, kernel, serial_kernel
from augment.render.cpu.simd import LOG2_E, exp2_fine
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import LANES, U
from augment.rng import STEP_X

ROWS = 16  # image rows of a band, which a thread draws at a time
FADE = 0.75  # of the distance to which a class is drawn: beyond, its drops fade into the veil
SOFT = 0.03  # of its depth: so far behind a surface a drop is hidden
LEAST_RADIUS = 1.25  # pixels; a smaller one would show where pixels lie
EDGE = 0.02  # of alpha, and of green from the sky: from here on a pixel shows both
NUM_NUMBERS = 9  # of a drop in the picture
_HALF = float(2**-21)
_CELL_X, _CELL_Y, _CELL_Z = (np.uint64(f) for f in CELL_FACTORS)
_STEP = np.uint64(STEP_X)


@inner()
def _unit(bits, shift):
    """21 of the bits as a number in [0, 1)."""
    return np.float64((bits >> np.uint64(shift)) & np.uint64(0x1FFFFF)) * _HALF


@inner()
def _cosine(turns):
    """cos(2 pi turns), within 1e-9; without a branch, which no processor could foresee."""
    x = 2 * math.pi * (0.25 - abs(turns - math.floor(turns + 0.5)))  # whose sine it is
    q = x * x
    p = 1 - q * (1 / 110) * (1 - q * (1 / 156))
    p = 1 - q * (1 / 20) * (1 - q * (1 / 42) * (1 - q * (1 / 72) * p))
    return x * (1 - q * (1 / 6) * p)


@inner()
def _sway(x, y, z, sways, flutter):
    """How far the air's eddies and a flake's own flutter move it, along x, y and z.

    sways: as of find_drops. flutter: turns of the flake. Eddies: three waves across their direction
    of travel, so the air is neither pressed nor thinned; flutter: a level circle of its own.
    """
    speed = sways[0]
    per_turn = 1 / (2 * math.pi)
    a = 0.6 / 2.0 * speed
    b = 0.6 / 2.7 * speed
    c = 0.6 / 3.4 * speed
    d = speed / (4 + 8 * (flutter * _HALF))
    along_x = 1.1 * per_turn * x + sways[2]
    along_y = 1.5 * per_turn * y + sways[3]
    along_z = 1.9 * per_turn * z + sways[4]
    around = sways[5] + flutter * sways[6]
    dx = b * _cosine(along_y) + c * _cosine(along_z - 0.25) + d * _cosine(around - 0.25)
    dy = a * _cosine(along_x - 0.25) + c * _cosine(along_z) + d * _cosine(around)
    dz = a * _cosine(along_x) + b * _cosine(along_y - 0.25)
    return dx, dy, dz


@kernel
def find_drops(
    slabs,
    columns,
    cells,
    keys,
    moves,
    sways,
    quantiles,
    shares,
    planes,
    shutter,
    lens,
    offsets,
    counts,
    found,
):
    """counts [S]: drops of each slab of cells that are seen. found [N, NUM_NUMBERS]: theirs from
    offsets [S] on: column and row at both ends of a streak, 1 / z there, radius up to which it
    covers as much as in its middle, radius beyond which nothing, covered share. Empty: counts are
    of all drops in the cells, which takes next to no time.

    slabs [S, 2]: class, x of the cells. columns [B, 2]: first y, end. cells [B, 4]: size, how far
    what is seen of a drop can be from its cell's middle, depth to which the class is drawn, how far
    it can be from the drop's place in the lattice. keys [B]: of the hashes. moves [B, 3, 3]: where
    the lattice has moved to as the shutter opens, between, as it closes. sways: their speed, the
    time, turns of the three eddies, those of a flake's flutter and what its number adds to them.
    quantiles [B, Q]. shares: as drops.cell_counts. planes [5, 4]:
    inwards normal and offset of the view's sides and its front. shutter [2, 3, 4]:
    camera_from_world as the shutter opens and closes. lens: fx, fy, cx, cy, width, height, least
    depth, diameter of the aperture, depth in focus. All float64 but for the integers and found.
    """
    is_counting = len(found) == 0
    for slab in prange(len(slabs)):
        b = slabs[slab, 0]
        i = slabs[slab, 1]
        size = cells[b, 0]
        reach = cells[b, 1]
        farthest = cells[b, 2]
        number = np.int64(0)
        spare = cells[b, 3]
        at = np.empty(3)
        ends = np.empty((2, 3))
        for j in range(columns[b, 0], columns[b, 1]):
            x = (np.float64(i) + 0.5) * size + moves[b, 1, 0]
            y = (np.float64(j) + 0.5) * size + moves[b, 1, 1]
            low = -1e18
            high = 1e18  # z of the cells' middles, scene world
            for side in range(6):
                n = min(side, 4)  # the last one is the far end, which faces the front
                flip = -1.0 if side == 5 else 1.0
                rest = flip * (planes[n, 0] * x + planes[n, 1] * y + planes[n, 3]) + reach
                if side == 5:
                    rest += farthest
                slope = flip * planes[n, 2]
                if abs(slope) < 1e-9:
                    if rest < 0:
                        high = -1e18
                elif slope > 0:
                    low = max(low, -rest / slope)
                else:
                    high = min(high, -rest / slope)
            if low > high:
                continue
            first = np.int64(math.floor((low - moves[b, 1, 2]) / size - 0.5))
            last = np.int64(math.ceil((high - moves[b, 1, 2]) / size - 0.5))
            for k in range(first, last + 1):
                cell = keys[b] + np.uint64(i) * _CELL_X
                cell = cell + np.uint64(j) * _CELL_Y + np.uint64(k) * _CELL_Z
                cell = mix(cell)
                share = np.float64(cell >> np.uint64(11)) * (1.0 / 9007199254740992.0)
                for drop in range(MAX_IN_CELL):
                    if share < shares[drop]:
                        break
                    if is_counting:
                        number += 1
                        continue
                    bits = mix(cell + np.uint64(drop + 1) * _STEP)
                    at[0] = (np.float64(i) + _unit(bits, 0)) * size + moves[b, 1, 0]
                    at[1] = (np.float64(j) + _unit(bits, 21)) * size + moves[b, 1, 1]
                    at[2] = (np.float64(k) + _unit(bits, 42)) * size + moves[b, 1, 2]
                    inside = np.inf
                    ahead = 0.0
                    for n in range(5):
                        ahead = planes[n, 0] * at[0] + planes[n, 1] * at[1] + planes[n, 2] * at[2]
                        ahead += planes[n, 3]
                        inside = min(inside, ahead)
                    if inside < -spare or ahead > farthest + spare:
                        continue
                    more = mix(bits ^ _STEP)
                    for c in range(3):
                        at[c] += moves[b, 0, c] - moves[b, 1, c]
                    if sways[0] > 0:  # which moves it less than its size while the shutter is open
                        flutter = np.float64((more >> np.uint64(21)) & np.uint64(0x1FFFFF))
                        dx, dy, dz = _sway(at[0], at[1], at[2], sways, flutter)
                        at[0], at[1], at[2] = at[0] + dx, at[1] + dy, at[2] + dz
                    for end in range(2):
                        if end == 1:
                            for c in range(3):
                                at[c] += moves[b, 2, c] - moves[b, 0, c]
                        for c in range(3):
                            ends[end, c] = (
                                shutter[end, c, 0] * at[0]
                                + shutter[end, c, 1] * at[1]
                                + shutter[end, c, 2] * at[2]
                                + shutter[end, c, 3]
                            )
                    near = lens[6]
                    z0 = ends[0, 2]
                    z1 = ends[1, 2]
                    if max(z0, z1) <= near:
                        continue
                    for end in range(2):  # what is behind the front is cut off
                        if ends[end, 2] < near:
                            cut = (near - z0) / (z1 - z0)
                            for c in range(3):
                                ends[end, c] = ends[0, c] + cut * (ends[1, c] - ends[0, c])
                            ends[end, 2] = near
                            z0 = ends[0, 2]
                            z1 = ends[1, 2]
                    z = 0.5 * (z0 + z1)
                    if z >= farthest:
                        continue
                    place = _unit(more, 0) * (quantiles.shape[1] - 1)
                    q = np.int64(place)
                    across = quantiles[b, q]
                    across += (place - q) * (quantiles[b, q + 1] - across)
                    focal = math.sqrt(lens[0] * lens[1])
                    wide = across / z * focal
                    blur = lens[7] * abs(1 / z - 1 / lens[8]) * focal
                    outside = max(0.5 * (wide + blur) + 0.5, LEAST_RADIUS)
                    inside = max(0.5 * abs(wide - blur) - 0.5, 0.0)
                    u0 = lens[0] * ends[0, 0] / z0 + lens[2]
                    v0 = lens[1] * ends[0, 1] / z0 + lens[3]
                    u1 = lens[0] * ends[1, 0] / z1 + lens[2]
                    v1 = lens[1] * ends[1, 1] / z1 + lens[3]
                    if (
                        max(u0, u1) < -outside
                        or max(v0, v1) < -outside
                        or min(u0, u1) > lens[4] + outside
                        or min(v0, v1) > lens[5] + outside
                    ):
                        continue
                    length = math.sqrt((u1 - u0) ** 2 + (v1 - v0) ** 2)
                    slope = (2 * outside + inside) * (outside - inside)
                    spread = length * (2 * inside + slope / (1.5 * (outside + inside)))
                    spread += 0.5 * math.pi * (outside * outside + inside * inside)
                    fade = min(max((farthest - z) / ((1 - FADE) * farthest), 0.0), 1.0)
                    cover = min(0.5 * math.pi * wide * wide / spread, 1.0)  # two cross-sections
                    row = offsets[slab] + number
                    found[row, 0] = u0
                    found[row, 1] = v0
                    found[row, 2] = u1
                    found[row, 3] = v1
                    found[row, 4] = 1 / z0
                    found[row, 5] = 1 / z1
                    found[row, 6] = inside
                    found[row, 7] = outside
                    found[row, 8] = cover * fade
                    number += 1
        counts[slab] = number


@serial_kernel
def list_drops(drops, bands, begins, listed):
    """Rows of drops, those that reach into each of `bands` bands of ROWS image rows, in order.

    begins [bands + 1]: where each band's begin in `listed`, which may be too short: then it is not
    filled. Returns how long it has to be.
    """
    for band in range(bands + 1):
        begins[band] = 0
    most = np.float32(bands - 1)
    per_row = np.float32(1 / ROWS)
    zero = np.float32(0)
    for is_filling in range(2):
        for row in range(len(drops)):
            v0 = drops[row, 1]
            v1 = drops[row, 3]
            outside = drops[row, 7]
            top = np.int64(min(max((min(v0, v1) - outside) * per_row, zero), most))
            end = np.int64(min(max((max(v0, v1) + outside) * per_row, zero), most))
            for band in range(top, end + 1):
                if is_filling == 1:
                    listed[begins[band]] = row
                begins[band] += 1
        if is_filling == 1:  # each ends where the next one began
            for band in range(bands, 0, -1):
                begins[band] = begins[band - 1]
            begins[0] = 0
        else:
            total = 0
            for band in range(bands + 1):
                total, begins[band] = total + begins[band], total
            if total > len(listed):
                return total
    return begins[bands]


@inner()
def _nearest_in_row(row, width, alpha, depth, eight):
    """Depth of the nearest surface in an image row. eight: spare."""
    zeros = v8.splat(np.float32(0))
    never = v8.splat(np.float32(np.inf))
    found = never
    for j in range(0, width, LANES):
        pixel = U(row * width + min(j, width - LANES))
        z = v8.load(depth, pixel)
        shown = v8.both(v8.greater(z, zeros), v8.greater(v8.load(alpha, pixel), zeros))
        found = v8.minimum(found, v8.select(shown, z, never))
    v8.store(eight, U(0), found)
    nearest = eight[0]
    for lane in range(1, LANES):
        nearest = min(nearest, eight[lane])
    return nearest


@inner()
def _cover_band(drops, listed, first, end, top, bottom, width, alpha, depth, clear):
    """clear: share of each pixel of image rows top to bottom that none of the drops covers, in
    their order. alpha, depth: of all pixels.
    """
    zero = np.float32(0)
    half = np.float32(0.5)
    one = np.float32(1)
    far = np.float32(width)
    last_block = width - LANES
    zeros = v8.splat(zero)
    ones = v8.splat(one)
    soft = v8.splat(np.float32(1 / SOFT))
    for i in range(U((bottom - top) * width)):
        clear[i] = one
    for place in range(first, end):
        drop = drops[listed[place]]
        u0 = drop[0]
        v0 = drop[1]
        near = drop[4]
        outside = drop[7]
        share = drop[8]
        du = drop[2] - u0
        dv = drop[3] - v0
        farther = drop[5] - near
        per_length = one / max(du * du + dv * dv, np.float32(1e-12))
        beyond = outside * outside
        ramp = share / (beyond - drop[6] * drop[6])
        # A streak that is about upright is looked at over its whole width in all rows.
        leans = abs(du) > np.float32(LANES / 2) and abs(dv) > np.float32(1e-3)
        per_row = one / dv if leans else zero
        begin = max(top, np.int64(min(v0, drop[3]) - outside + np.float32(ROWS)) - ROWS)
        last = min(bottom, np.int64(max(max(v0, drop[3]) + outside, zero)) + 1)
        left = np.int64(max(min(u0, drop[2]) - outside, zero))
        right = np.int64(min(max(max(u0, drop[2]) + outside + one, zero), far))
        for row in range(begin, last):
            v = np.float32(row) + half - v0
            if leans:  # the piece of the streak that is so near to the row
                middle = v * per_row
                reach = outside * abs(per_row)
                ua = u0 + min(max(middle - reach, zero), one) * du
                ub = u0 + min(max(middle + reach, zero), one) * du
                left = np.int64(max(min(ua, ub) - outside, zero))
                right = np.int64(min(max(max(ua, ub) + outside + one, zero), far))
            ax = v8.splat(du * per_length)
            base = v8.splat(v * dv * per_length)
            for j in range(left, right, LANES):
                at = min(j, last_block)  # the last eight pixels of a row take those before them
                x = v8.splat(np.float32(at) + half - u0) + v8.lane_numbers()
                along = v8.minimum(v8.maximum(v8.fmuladd(x, ax, base), zeros), ones)
                x = v8.fmuladd(along, v8.splat(-du), x)
                y = v8.fmuladd(along, v8.splat(-dv), v8.splat(v))
                away = v8.fmuladd(x, x, y * y)
                covered = (v8.splat(beyond) - away) * v8.splat(ramp)
                covered = v8.minimum(v8.maximum(covered, zeros), v8.splat(share))
                pixel = U(row * width + at)
                surface = v8.load(depth, pixel)
                per_z = v8.fmuladd(along, v8.splat(farther), v8.splat(near))
                behind = (ones - surface * per_z) * soft
                hidden = v8.load(alpha, pixel) * v8.minimum(v8.maximum(behind, zeros), ones)
                hidden = v8.select(v8.greater(surface, zeros), hidden, zeros)
                covered = covered * (ones - hidden)
                if at < j:
                    numbers = v8.lane_numbers() + v8.splat(np.float32(at - j))
                    covered = v8.select(v8.at_least(numbers, zeros), covered, zeros)
                own = U((row - top) * width + at)
                v8.store(clear, own, v8.load(clear, own) * (ones - covered))


@kernel
def cover_pixels(drops, listed, begins, alpha, depth, clear):
    """clear [H, W]: share of each pixel that none of the drops covers, in their order.

    drops: as found by find_drops. listed, begins: as of list_drops. alpha, depth [H W]: of the
    surfaces; depth 0 where none is. W >= LANES.
    """
    height, width = clear.shape
    for band in prange(len(begins) - 1):
        top = np.int64(band) * ROWS
        bottom = min(top + ROWS, height)
        own = np.empty(ROWS * width, np.float32)
        _cover_band(
            drops, listed, begins[band], begins[band + 1], top, bottom, width, alpha, depth, own
        )
        for row in range(top, bottom):
            for j in range(U(width)):
                clear[U(row), j] = own[U((row - top) * width) + j]


@inner()
def _classes_in_row(nearest, bands, own):
    """What blend_falling's bands say of a row: how many rows `own` [NUM_CLASSES, 5] has of classes
    that are not all veil where the nearest surface is, and slope and offset of the optical depth
    of the others, which grows with z alone.
    """
    count = 0
    slope = np.float32(0)
    offset = np.float32(0)
    for b in range(NUM_CLASSES):
        if bands[b, 4] > nearest:
            for k in range(5):
                own[count, k] = bands[b, k]
            count += 1
        else:
            slope += bands[b, 0]
            offset += bands[b, 0] * (bands[b, 2] * bands[b, 2] * bands[b, 3] - bands[b, 4])
    return count, slope, offset


@inner()
def _decay(x):
    """exp(-x) where 0 <= x, of 80 where that is more."""
    x = v8.minimum(v8.maximum(x, v8.splat(np.float32(0))), v8.splat(np.float32(MAX_EXPONENT)))
    return exp2_fine(x * v8.splat(-LOG2_E))


@inner()
def _blend_pixels(pixels, at, splats, pixel, u, lengths, shown, clear, tau, sky, light):
    """Eight pixels behind the veil and the drops, in place.

    splats: as of blend_falling. shown: alpha. tau: the veil's optical depth at unit depth. sky:
    transmittance up to the sky. light [3, 4]: airlight; light of a drop in the mean, what of it
    grows to the right, and ahead.
    """
    zeros = v8.splat(np.float32(0))
    one = v8.splat(np.float32(1))
    near = _decay(tau * lengths)
    per_length = one / lengths
    red, green, blue = v8.load_colours(pixels, at)
    r = red
    g = green
    b = blue
    edge = v8.minimum(shown, one - shown) - v8.splat(np.float32(EDGE))
    is_mixed = False
    if splats.size > 0 and v8.any_not_negative(edge):
        r, g, b = v8.load_colours(splats, U(3) * pixel)
        edge = v8.minimum(edge, green - g - v8.splat(np.float32(EDGE)))
        is_mixed = v8.any_not_negative(edge)
    edge = v8.at_least(edge, zeros)
    red = _veil(v8.maximum(red, zeros), r, is_mixed, edge, light[0], shown, near, sky)
    green = _veil(v8.maximum(green, zeros), g, is_mixed, edge, light[1], shown, near, sky)
    blue = _veil(v8.maximum(blue, zeros), b, is_mixed, edge, light[2], shown, near, sky)
    red = _blend_colour(red, light[0], u, clear, per_length)
    green = _blend_colour(green, light[1], u, clear, per_length)
    blue = _blend_colour(blue, light[2], u, clear, per_length)
    v8.store_colours(pixels, at, red, green, blue)


@inner()
def _veil(own, splats, is_mixed, edge, light, shown, near, sky):
    """The square of a colour behind the veil. edge: lanes whose pixels show both surfaces and sky,
    each behind its own, if any is_mixed. near: transmittance up to the surfaces.
    """
    zeros = v8.splat(np.float32(0))
    air = v8.splat(light[0])
    veiled = air + (sky + shown * (near - sky)) * (own * own - air)
    if is_mixed:
        rest = v8.splat(np.float32(1)) - shown
        behind = v8.minimum(v8.maximum(own - splats, zeros), rest)
        ahead = (own - behind) / v8.maximum(shown, v8.splat(np.float32(EDGE)))
        behind = behind / v8.maximum(rest, v8.splat(np.float32(EDGE)))
        ahead = shown * v8.sqrt(v8.maximum(air + near * (ahead * ahead - air), zeros))
        behind = rest * v8.sqrt(v8.maximum(air + sky * (behind * behind - air), zeros))
        veiled = v8.select(edge, (ahead + behind) * (ahead + behind), veiled)
    return veiled


@inner()
def _blend_colour(veiled, light, u, clear, per_length):
    """The colour whose square is `veiled`, behind the drops."""
    glow = v8.splat(light[1]) + (v8.splat(light[2]) * u + v8.splat(light[3])) * per_length
    out = glow + clear * (veiled - glow)
    return v8.sqrt(v8.maximum(out, v8.splat(np.float32(0))))


@inner()
def _blend_row(
    row,
    width,
    rgb,
    splats,
    alpha,
    depth,
    clear,
    first,
    nearest,
    rays,
    climb,
    bands,
    upwards,
    light,
    own,
    rest,
):
    """A row of blend_falling. clear: from place `first` on. own, rest: spare."""
    zeros = v8.splat(np.float32(0))
    half = np.float32(0.5)
    least = np.float32(1e-6)
    count, slope, offset = _classes_in_row(nearest, bands, own)
    v = (np.float32(row) + half - rays[3]) * rays[1]
    flat = v8.splat(np.float32(1) + v * v)
    level = climb[1] * v + climb[2]
    left = (half - rays[2]) * rays[0]
    right = (np.float32(width) - rays[2]) * rays[0]
    shows_sky = max(climb[0] * left, climb[0] * right) + level > least
    for j in range(0, width, LANES):
        # The last eight of a row take pixels before them, which are not written.
        at = min(j, width - LANES)
        pixel = U(row * width + at)
        u = v8.splat(np.float32(at) + half - rays[2]) + v8.lane_numbers()
        u = u * v8.splat(rays[0])
        lengths = v8.sqrt(flat + u * u)
        z = v8.load(depth, pixel)
        tau = v8.splat(slope) * z + v8.splat(offset)
        for b in range(U(count)):
            inside = v8.maximum(z - v8.splat(own[b, 1]), zeros)
            inside = v8.minimum(inside, v8.splat(own[b, 2]))
            beyond = v8.maximum(z - v8.splat(own[b, 4]), zeros)
            tau = tau + v8.splat(own[b, 0]) * (inside * inside * v8.splat(own[b, 3]) + beyond)
        sky = zeros
        if shows_sky:  # below the horizon nothing is seen through so much
            steep = v8.splat(climb[0]) * u + v8.splat(level)
            sky = _decay(v8.splat(upwards) * lengths / v8.maximum(steep, v8.splat(least)))
        shown = v8.select(v8.greater(z, zeros), v8.load(alpha, pixel), zeros)
        through = v8.load(clear, first + U(at))
        if at == j:
            _blend_pixels(
                rgb, U(3) * pixel, splats, pixel, u, lengths, shown, through, tau, sky, light
            )
        else:
            for k in range(U(3 * LANES)):
                rest[k] = rgb[U(3) * pixel + k]
            _blend_pixels(rest, U(0), splats, pixel, u, lengths, shown, through, tau, sky, light)
            for k in range(U(3 * (j - at)), U(3 * LANES)):
                rgb[U(3) * pixel + k] = rest[k]


@kernel
def blend_falling(
    rgb,
    splats,
    alpha,
    depth,
    drops,
    listed,
    begins,
    least,
    rays,
    climb,
    bands,
    upwards,
    airlight,
    glow,
    mask,
):
    """rgb [3 H W] behind the veil and the drops, in place; mask [H, W]: where a drawn drop leaves
    less than `least` of a pixel clear.

    splats [3 H W]: what of rgb is the surfaces', the rest being the sky's; empty where that is not
    known: then both are seen through the mean of their veils, so that a bright sky shines at edges.
    alpha, depth, drops, listed, begins: as of cover_pixels. rays: 1 / fx, 1 / fy, cx, cy. climb
    [3]: the world's z along the camera's axes. bands [NUM_CLASSES, 5]: extinction of a class, depth
    where it begins, over which depth it grows, half its inverse, depth from which on it is whole.
    upwards: optical depth straight up. airlight [3]. glow [3, 4]: light of a drop by direction
    along the camera's axes, and in the mean. Light is squares of display-encoded colours. All
    float32.
    """
    height, width = mask.shape
    for band in prange(len(begins) - 1):
        top = np.int64(band) * ROWS
        bottom = min(top + ROWS, height)
        clear = np.empty(ROWS * width, np.float32)
        nearest = np.empty(ROWS, np.float32)
        light = np.empty((3, 4), np.float32)
        own = np.empty((NUM_CLASSES, 5), np.float32)
        rest = np.empty(3 * LANES, np.float32)
        for row in range(top, bottom):  # which brings the surfaces into the cache, in order
            nearest[row - top] = _nearest_in_row(row, width, alpha, depth, rest)
        _cover_band(
            drops, listed, begins[band], begins[band + 1], top, bottom, width, alpha, depth, clear
        )
        for row in range(top, bottom):
            first = U((row - top) * width)
            for j in range(U(width)):
                mask[U(row), j] = clear[first + j] < least
            v = (np.float32(row) + np.float32(0.5) - rays[3]) * rays[1]
            for c in range(3):
                light[c, 0], light[c, 1], light[c, 2] = airlight[c], glow[c, 3], glow[c, 0]
                light[c, 3] = glow[c, 1] * v + glow[c, 2]
            _blend_row(
                row,
                width,
                rgb,
                splats,
                alpha,
                depth,
                clear,
                first,
                nearest[row - top],
                rays,
                climb,
                bands,
                upwards,
                light,
                own,
                rest,
            )
