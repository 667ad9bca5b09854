"""Numba kernels: the drops in a camera's view, their cover of each pixel, and the veil."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.effects.falling.drops import CELL_FACTORS, MAX_IN_CELL, NUM_CLASSES
from augment.render.cpu import simd as v8
from augment.render.cpu.hash_kernels import mix
from augment.render.cpu.jit import kernel, kernel_function, serial_kernel
from augment.render.cpu.simd import LOG2_E, exp2_fine
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import NUM_LANES, Index
from augment.rng import STEP_X

ROWS = 16  # image rows of a band, which a thread draws at a time
FADE = 0.75  # share of a class's drawn depth beyond which its drops fade into the veil
SOFT = 0.03  # share of its depth by which a drop is behind a surface when it is fully hidden
LEAST_RADIUS = 1.25  # smallest radius, pixels; a smaller one would show the pixel grid
LEAST_LENGTH = 0.05  # shortest path of a drop, pixels; rest is a path of this length
EDGE = 0.02  # smallest alpha, and green from the sky, of a pixel that shows surface and sky
NUM_NUMBERS = 9  # numbers of a drop in the picture
_HALF = float(2**-21)
_CELL_X, _CELL_Y, _CELL_Z = (np.uint64(f) for f in CELL_FACTORS)
_STEP = np.uint64(STEP_X)


class CellWalk(NamedTuple):
    """Arguments of `find_drops`, in its order."""

    slabs: np.ndarray
    columns: np.ndarray
    cells: np.ndarray
    keys: np.ndarray
    moves: np.ndarray
    sways: np.ndarray
    quantiles: np.ndarray
    shares: np.ndarray
    planes: np.ndarray
    shutter: np.ndarray
    lens: np.ndarray


class Veil(NamedTuple):
    """Arguments of `blend_falling`, float32."""

    rays: np.ndarray
    climb: np.ndarray
    bands: np.ndarray
    upwards: np.ndarray
    airlight: np.ndarray
    glow: np.ndarray


@kernel_function()
def _unit(bits, shift):
    """Return 21 of the bits as a number in [0, 1)."""
    return np.float64((bits >> np.uint64(shift)) & np.uint64(0x1FFFFF)) * _HALF


@kernel_function()
def _cosine(turns):
    """Return cos(2 pi turns), within 1e-9, without a branch (no processor could predict it)."""
    x = 2 * math.pi * (0.25 - abs(turns - math.floor(turns + 0.5)))  # the result is the sine of x
    q = x * x
    p = 1 - q * (1 / 110) * (1 - q * (1 / 156))
    p = 1 - q * (1 / 20) * (1 - q * (1 / 42) * (1 - q * (1 / 72) * p))
    return x * (1 - q * (1 / 6) * p)


@kernel_function()
def _sway(x, y, z, sways, flutter):
    """Return how far the air's eddies and a flake's own flutter move it, along x, y and z.

    Eddies are three transverse waves, so they do not compress the air. Flutter is a level circle of
    each flake.

    sways: as in find_drops. flutter: turns of the flake.
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
    drops,
):
    """Find the drops in a camera's view.

    If `drops` is empty, only `counts` is written: the number of all drops in the cells, in view or
    not, which takes almost no time. All arrays are float64 except the integers and `drops`.

    Args:
        slabs: [S, 2] class, x of the cells.
        columns: [B, 2] first y, end.
        cells: [B, 5] size; largest distance of a visible part of a drop from its cell's middle;
            depth up to which the class is drawn; largest distance of a visible part from the drop's
            position in the lattice; share of the lattice's drops that fall.
        keys: [B] keys of the hashes.
        moves: [B, 3, 3] displacement of the lattice as the shutter opens, in the middle, and as it
            closes.
        sways: their speed, the time, turns of the three eddies, turns of a flake's flutter, and
            the turns that each unit of the flake's number adds.
        quantiles: [B, Q] diameters.
        shares: as drops.cell_counts.
        planes: [5, 4] inward normal and offset of the view's sides and its front.
        shutter: [2, 3, 4] camera_from_world as the shutter opens and closes.
        lens: fx, fy, cx, cy, width, height, smallest depth, diameter of the aperture, depth in
            focus.
        offsets: [S] first row in `drops` of each slab.
        counts: output [S], number of drops of each slab that are in view.
        drops: output [N, NUM_NUMBERS] column and row of the disc as the shutter opens and as it
            closes, 1 / z there, radius up to which the disc covers as much as in its middle, radius
            beyond which it covers nothing, share that a resting disc covers in its middle (up to 2;
            more than 1 counts where the disc moves).
    """
    is_counting = len(drops) == 0
    for slab in prange(len(slabs)):
        b = slabs[slab, 0]
        i = slabs[slab, 1]
        size = cells[b, 0]
        reach = cells[b, 1]
        farthest = cells[b, 2]
        number = np.int64(0)
        spread_m = cells[b, 3]
        falling_share = cells[b, 4]
        point = np.empty(3)
        ends = np.empty((2, 3))
        for j in range(columns[b, 0], columns[b, 1]):
            x = (np.float64(i) + 0.5) * size + moves[b, 1, 0]
            y = (np.float64(j) + 0.5) * size + moves[b, 1, 1]
            low = -1e18
            high = 1e18  # z of the cells' middles, scene world
            for side in range(6):
                n = min(side, 4)  # the last one is the far end, which faces the front
                flip = -1.0 if side == 5 else 1.0
                plane_offset = flip * (planes[n, 0] * x + planes[n, 1] * y + planes[n, 3]) + reach
                if side == 5:
                    plane_offset += farthest
                slope = flip * planes[n, 2]
                if abs(slope) < 1e-9:
                    if plane_offset < 0:
                        high = -1e18
                elif slope > 0:
                    low = max(low, -plane_offset / slope)
                else:
                    high = min(high, -plane_offset / slope)
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
                    point[0] = (np.float64(i) + _unit(bits, 0)) * size + moves[b, 1, 0]
                    point[1] = (np.float64(j) + _unit(bits, 21)) * size + moves[b, 1, 1]
                    point[2] = (np.float64(k) + _unit(bits, 42)) * size + moves[b, 1, 2]
                    inside = np.inf
                    ahead = 0.0
                    for n in range(5):
                        ahead = (
                            planes[n, 0] * point[0]
                            + planes[n, 1] * point[1]
                            + planes[n, 2] * point[2]
                        )
                        ahead += planes[n, 3]
                        inside = min(inside, ahead)
                    if inside < -spread_m or ahead > farthest + spread_m:
                        continue
                    more = mix(bits ^ _STEP)
                    if falling_share < 1.0 and _unit(more, 42) >= falling_share:
                        continue
                    for c in range(3):
                        point[c] += moves[b, 0, c] - moves[b, 1, c]
                    if sways[0] > 0:  # the sway while the shutter is open is below a flake's size
                        flutter = np.float64((more >> np.uint64(21)) & np.uint64(0x1FFFFF))
                        dx, dy, dz = _sway(point[0], point[1], point[2], sways, flutter)
                        point[0] += dx
                        point[1] += dy
                        point[2] += dz
                    for end in range(2):
                        if end == 1:
                            for c in range(3):
                                point[c] += moves[b, 2, c] - moves[b, 0, c]
                        for c in range(3):
                            ends[end, c] = (
                                shutter[end, c, 0] * point[0]
                                + shutter[end, c, 1] * point[1]
                                + shutter[end, c, 2] * point[2]
                                + shutter[end, c, 3]
                            )
                    min_depth = lens[6]
                    z0 = ends[0, 2]
                    z1 = ends[1, 2]
                    if max(z0, z1) <= min_depth:
                        continue
                    for end in range(2):  # cut off the part behind the view's front
                        if ends[end, 2] < min_depth:
                            cut = (min_depth - z0) / (z1 - z0)
                            for c in range(3):
                                ends[end, c] = ends[0, c] + cut * (ends[1, c] - ends[0, c])
                            ends[end, 2] = min_depth
                            z0 = ends[0, 2]
                            z1 = ends[1, 2]
                    z = 0.5 * (z0 + z1)
                    if z >= farthest:
                        continue
                    quantile_index = _unit(more, 0) * (quantiles.shape[1] - 1)
                    q = np.int64(quantile_index)
                    across = quantiles[b, q]
                    across += (quantile_index - q) * (quantiles[b, q + 1] - across)
                    focal = math.sqrt(lens[0] * lens[1])
                    width_px = across / z * focal
                    blur = lens[7] * abs(1 / z - 1 / lens[8]) * focal
                    outside = max(0.5 * (width_px + blur) + 0.5, LEAST_RADIUS)
                    inside = max(0.5 * abs(width_px - blur) - 0.5, 0.0)
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
                    fade = min(max((farthest - z) / ((1 - FADE) * farthest), 0.0), 1.0)
                    # Two cross-sections, over the integral of the disc's profile.
                    cover = width_px * width_px / (outside * outside + inside * inside)
                    row = offsets[slab] + number
                    drops[row, 0] = u0
                    drops[row, 1] = v0
                    drops[row, 2] = u1
                    drops[row, 3] = v1
                    drops[row, 4] = 1 / z0
                    drops[row, 5] = 1 / z1
                    drops[row, 6] = inside
                    drops[row, 7] = outside
                    drops[row, 8] = cover * fade
                    number += 1
        counts[slab] = number


@serial_kernel
def list_drops(drops, bands, begins, listed):
    """List the rows of the drops that reach into each of `bands` bands of ROWS image rows.

    Rows are in order. If `listed` is too short, it is not filled.

    begins [bands + 1]: output, start of each band in `listed`.

    Returns:
        The length that `listed` needs.
    """
    for band in range(bands + 1):
        begins[band] = 0
    last_band = np.float32(bands - 1)
    per_row = np.float32(1 / ROWS)
    zero = np.float32(0)
    for is_filling in range(2):
        for row in range(len(drops)):
            v0 = drops[row, 1]
            v1 = drops[row, 3]
            outside = drops[row, 7]
            top = np.int64(min(max((min(v0, v1) - outside) * per_row, zero), last_band))
            end = np.int64(min(max((max(v0, v1) + outside) * per_row, zero), last_band))
            for band in range(top, end + 1):
                if is_filling == 1:
                    listed[begins[band]] = row
                begins[band] += 1
        if is_filling == 1:  # begins[band] is now the end of a band, the start of the next one
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


@kernel_function()
def nearest_in_row(row, width, alpha, depth, eight):
    """Return the depth of the nearest surface in an image row. eight: scratch."""
    zeros = v8.broadcast(np.float32(0))
    no_surface = v8.broadcast(np.float32(np.inf))
    nearest_z = no_surface
    for j in range(0, width, NUM_LANES):
        pixel = Index(row * width + min(j, width - NUM_LANES))
        z = v8.load(depth, pixel)
        has_surface = v8.mask_and(v8.greater(z, zeros), v8.greater(v8.load(alpha, pixel), zeros))
        nearest_z = v8.minimum(nearest_z, v8.select(has_surface, z, no_surface))
    v8.store(eight, Index(0), nearest_z)
    nearest = eight[0]
    for lane in range(1, NUM_LANES):
        nearest = min(nearest, eight[lane])
    return nearest


@kernel_function()
def _path_integral(h2, start, length):
    """Return the integral of (h^2 - x^2)+ over the path x = start to start + length.

    h2: h^2; 0 is returned where it is negative.
    """
    zeros = v8.broadcast(np.float32(0))
    third = v8.broadcast(np.float32(1 / 3))
    h2 = v8.maximum(h2, zeros)
    h = v8.sqrt(h2)
    low = v8.maximum(start, zeros - h)
    high = v8.minimum(start + length, h)
    between = v8.maximum(high - low, zeros)
    squares = v8.fmuladd(high, high + low, low * low)
    return v8.maximum(between * (h2 - squares * third), zeros)


@kernel_function()
def cover_band(drops, listed, first, end, top, bottom, width, alpha, depth, clear):
    """Write the share of each pixel of image rows top to bottom that no drop covers into clear.

    The drops count in their order. alpha, depth: of all pixels.

    A drop is a disc whose cover falls from the radius i to the radius o as a paraboloid, the
    difference of (o^2 - r^2)+ and (i^2 - r^2)+ over o^2 - i^2. While the shutter is open it moves
    by L, so a pixel has the mean over the disc's path, whose ends are tapered. At the offset y from
    the path, with h^2 = R^2 - y^2 and the path's part from `low` to `high` within h of the pixel,

        int (R^2 - y^2 - x^2) dx = (high - low) (h^2 - (high^2 + high low + low^2) / 3)
    """
    zero = np.float32(0)
    half = np.float32(0.5)
    unit = np.float32(1)
    image_end = np.float32(width)
    last_block = width - NUM_LANES
    zeros = v8.broadcast(zero)
    ones = v8.broadcast(unit)
    soft = v8.broadcast(np.float32(1 / SOFT))
    for i in range(Index((bottom - top) * width)):
        clear[i] = unit
    for position in range(first, end):
        drop = drops[listed[position]]
        u0 = drop[0]
        v0 = drop[1]
        first_per_z = drop[4]
        outside = drop[7]
        share = drop[8]
        du = drop[2] - u0
        dv = drop[3] - v0
        per_z_change = drop[5] - first_per_z
        inside = drop[6]
        length = math.sqrt(du * du + dv * dv)
        if length < np.float32(LEAST_LENGTH):
            length = np.float32(LEAST_LENGTH)
            u0 = half * (u0 + drop[2] - length)
            du = length
            dv = zero
        per_length = unit / (length * length)
        beyond = outside * outside
        within = inside * inside
        ramp = share / ((beyond - within) * length)
        ends = v8.broadcast(length)
        # In all rows a nearly upright streak is evaluated over its full width.
        is_slanted = abs(du) > np.float32(NUM_LANES / 2) and abs(dv) > np.float32(1e-3)
        per_row = unit / dv if is_slanted else zero
        begin = max(top, np.int64(min(v0, drop[3]) - outside + np.float32(ROWS)) - ROWS)
        last = min(bottom, np.int64(max(max(v0, drop[3]) + outside, zero)) + 1)
        left = np.int64(max(min(u0, drop[2]) - outside, zero))
        right = np.int64(min(max(max(u0, drop[2]) + outside + unit, zero), image_end))
        for row in range(begin, last):
            v = np.float32(row) + half - v0
            if is_slanted:  # the piece of the streak that is so near to the row
                middle = v * per_row
                reach = outside * abs(per_row)
                ua = u0 + min(max(middle - reach, zero), unit) * du
                ub = u0 + min(max(middle + reach, zero), unit) * du
                left = np.int64(max(min(ua, ub) - outside, zero))
                right = np.int64(min(max(max(ua, ub) + outside + unit, zero), image_end))
            ax = v8.broadcast(du * per_length)
            base = v8.broadcast(v * dv * per_length)
            for j in range(left, right, NUM_LANES):
                at = min(j, last_block)  # the last eight pixels of a row take those before them
                x = v8.broadcast(np.float32(at) + half - u0) + v8.lane_numbers()
                along = v8.fmuladd(x, ax, base)
                across = v8.fmuladd(x, v8.broadcast(dv / length), v8.broadcast(-v * du / length))
                across2 = across * across
                start = along * v8.broadcast(-length)  # of the path, from the pixel
                covered = _path_integral(v8.broadcast(beyond) - across2, start, ends)
                if inside > zero:
                    covered = covered - _path_integral(v8.broadcast(within) - across2, start, ends)
                covered = v8.minimum(covered * v8.broadcast(ramp), ones)
                along = v8.minimum(v8.maximum(along, zeros), ones)
                pixel = Index(row * width + at)
                surface = v8.load(depth, pixel)
                per_z = v8.fmuladd(along, v8.broadcast(per_z_change), v8.broadcast(first_per_z))
                hidden_weight = (ones - surface * per_z) * soft
                hidden_share = v8.load(alpha, pixel) * v8.minimum(
                    v8.maximum(hidden_weight, zeros), ones
                )
                hidden_share = v8.select(v8.greater(surface, zeros), hidden_share, zeros)
                covered = covered * (ones - hidden_share)
                if at < j:
                    numbers = v8.lane_numbers() + v8.broadcast(np.float32(at - j))
                    covered = v8.select(v8.at_least(numbers, zeros), covered, zeros)
                band_pixel = Index((row - top) * width + at)
                v8.store(clear, band_pixel, v8.load(clear, band_pixel) * (ones - covered))


@kernel
def cover_pixels(drops, listed, begins, alpha, depth, clear):
    """Write the share of each pixel that no drop covers into clear [H, W], where W >= NUM_LANES.

    Args:
        drops: result of find_drops; they count in their order.
        listed: result of list_drops.
        begins: result of list_drops.
        alpha: [H W] opacity of the surfaces.
        depth: [H W] z of the surfaces; 0 without a surface.
        clear: output.
    """
    height, width = clear.shape
    for band in prange(len(begins) - 1):
        top = np.int64(band) * ROWS
        bottom = min(top + ROWS, height)
        band_clear = np.empty(ROWS * width, np.float32)
        cover_band(
            drops,
            listed,
            begins[band],
            begins[band + 1],
            top,
            bottom,
            width,
            alpha,
            depth,
            band_clear,
        )
        for row in range(top, bottom):
            for j in range(Index(width)):
                clear[Index(row), j] = band_clear[Index((row - top) * width) + j]


@kernel_function()
def _light_row(row, width, clear, first, before, cells, step, picture):
    """Add the light of a range's drops to a row of the picture, and note what they hide.

    Args:
        row: row of the picture.
        width: its width.
        clear: share of each pixel that the drops leave, from index `first` on.
        first: index of the row's first pixel in `clear` and `before`.
        before: share of each pixel that nearer drops leave, changed in place.
        cells: luminance of the range's drops, [h, 3, w].
        step: side of a cell.
        picture: the picture, [H, W, 3], changed in place.
    """
    rows = cells.shape[0]
    unit = np.float32(1)
    zero = np.float32(0)
    last_column = max((width + step - 1) // step - 1, 0)
    v = min(
        max((np.float32(row) + np.float32(0.5)) / np.float32(step) - np.float32(0.5), zero),
        np.float32(rows - 1),
    )
    i = min(int(v), max(rows - 2, 0))
    v -= np.float32(i)
    below = min(i + 1, rows - 1)
    for start in range(0, width, NUM_LANES):
        end = min(start + NUM_LANES, width)
        if end - start == NUM_LANES:
            eight = v8.load(clear, first + Index(start))
            if v8.mask_bits(v8.greater(v8.broadcast(unit), eight)) == Index(0):
                continue
        # Eight pixels lie between the same cells.
        u = (np.float32(start) + np.float32(0.5)) / np.float32(step) - np.float32(0.5)
        j = min(max(math.floor(u), 0), max(last_column - 1, 0))
        beside = min(j + 1, last_column)
        red = cells[i, 0, j] + (cells[below, 0, j] - cells[i, 0, j]) * v
        green = cells[i, 1, j] + (cells[below, 1, j] - cells[i, 1, j]) * v
        blue = cells[i, 2, j] + (cells[below, 2, j] - cells[i, 2, j]) * v
        more_red = cells[i, 0, beside] + (cells[below, 0, beside] - cells[i, 0, beside]) * v - red
        more_green = (
            cells[i, 1, beside] + (cells[below, 1, beside] - cells[i, 1, beside]) * v - green
        )
        more_blue = cells[i, 2, beside] + (cells[below, 2, beside] - cells[i, 2, beside]) * v - blue
        for column in range(start, end):
            pixel = first + Index(column)
            cover = unit - clear[pixel]
            if cover <= zero:
                continue
            u = (np.float32(column) + np.float32(0.5)) / np.float32(step) - np.float32(0.5)
            u = min(max(u, zero), np.float32(last_column)) - np.float32(j)
            weight = before[pixel] * cover
            before[pixel] *= clear[pixel]
            picture[row, column, 0] += weight * (red + more_red * u)
            picture[row, column, 1] += weight * (green + more_green * u)
            picture[row, column, 2] += weight * (blue + more_blue * u)


@kernel
def add_lit_drops(drops, listed, begins, ends, alpha, depth, padded_width, cells, step, picture):
    """Add the light of drops in ranges of distances to a picture, in place.

    Args:
        drops: result of find_drops, nearest range first; they count in their order.
        listed: result of list_drops.
        begins: result of list_drops.
        ends: number of drops up to the end of each range, int64 [K].
        alpha: opacity of the surfaces, flat, [H padded_width].
        depth: z of the surfaces; 0 without a surface.
        padded_width: width of the images, at least NUM_LANES.
        cells: luminance of drops in cells of the picture, float32 [K, h, 3, w].
        step: side of a cell, pixels, a multiple of 2 NUM_LANES.
        picture: luminance, float32 [H, W, 3], changed in place.
    """
    height, width = picture.shape[:2]
    for band in prange(len(begins) - 1):
        if begins[band] == begins[band + 1]:
            continue
        top = np.int64(band) * ROWS
        bottom = min(top + ROWS, height)
        clear = np.empty(ROWS * padded_width, np.float32)
        before = np.ones(ROWS * padded_width, np.float32)
        position = begins[band]
        for k in range(len(ends)):
            first = position
            while position < begins[band + 1] and listed[position] < ends[k]:
                position += 1
            if position == first:
                continue
            cover_band(
                drops, listed, first, position, top, bottom, padded_width, alpha, depth, clear
            )
            for row in range(top, bottom):
                start = Index((row - top) * padded_width)
                _light_row(row, width, clear, start, before, cells[k], step, picture)


@kernel_function()
def classes_in_row(nearest, bands, partial):
    """Sort the classes of blend_falling's bands for one image row.

    partial [NUM_CLASSES, 5]: output, bands of the classes that are not completely veil at the
    nearest surface.

    Returns:
        The number of rows of `partial`, and slope and offset of the optical depth of the other
        classes, which is linear in z.
    """
    count = 0
    slope = np.float32(0)
    offset = np.float32(0)
    for b in range(NUM_CLASSES):
        if bands[b, 4] > nearest:
            for k in range(5):
                partial[count, k] = bands[b, k]
            count += 1
        else:
            slope += bands[b, 0]
            offset += bands[b, 0] * (bands[b, 2] * bands[b, 2] * bands[b, 3] - bands[b, 4])
    return count, slope, offset


@kernel_function()
def veil_depth(z, count, slope, offset, partial):
    """Return the veil's optical depth at unit depth up to eight surfaces at z.

    count, slope, offset, partial: as classes_in_row gives them.
    """
    zeros = v8.broadcast(np.float32(0))
    tau = v8.broadcast(slope) * z + v8.broadcast(offset)
    for b in range(Index(count)):
        inside = v8.maximum(z - v8.broadcast(partial[b, 1]), zeros)
        inside = v8.minimum(inside, v8.broadcast(partial[b, 2]))
        beyond = v8.maximum(z - v8.broadcast(partial[b, 4]), zeros)
        tau = tau + v8.broadcast(partial[b, 0]) * (
            inside * inside * v8.broadcast(partial[b, 3]) + beyond
        )
    return tau


@kernel_function()
def decay(x):
    """Return exp(-x) for x >= 0; larger x than MAX_EXPONENT count as MAX_EXPONENT."""
    x = v8.minimum(
        v8.maximum(x, v8.broadcast(np.float32(0))), v8.broadcast(np.float32(MAX_EXPONENT))
    )
    return exp2_fine(x * v8.broadcast(-LOG2_E))


@kernel_function()
def light_of_row(row, rays, airlight, glow, light):
    """Write the light of veil and drops in an image row.

    Args:
        row: the row.
        rays: as in blend_falling.
        airlight: as in blend_falling.
        glow: as in blend_falling.
        light: output [3, >= 4]: airlight; mean light of a drop; its change to the right; its change
            ahead.
    """
    v = (np.float32(row) + np.float32(0.5) - rays[3]) * rays[1]
    for c in range(3):
        light[c, 0] = airlight[c]
        light[c, 1] = glow[c, 3]
        light[c, 2] = glow[c, 0]
        light[c, 3] = glow[c, 1] * v + glow[c, 2]


@kernel_function()
def surface_parts(splats, pixel, opacity, red, green, blue):
    """Return the surfaces' part of eight colours, and where it is apart from the sky's.

    Args:
        splats: as in blend_falling.
        pixel: number of the first pixel.
        opacity: alpha of the pixels.
        red: red of the picture.
        green: green of the picture.
        blue: blue of the picture.

    Returns:
        Red, green and blue; the lanes whose pixels show both surfaces and sky; True if any does.
    """
    zeros = v8.broadcast(np.float32(0))
    ones = v8.broadcast(np.float32(1))
    r = red
    g = green
    b = blue
    edge = v8.minimum(opacity, ones - opacity) - v8.broadcast(np.float32(EDGE))
    is_mixed = False
    if splats.size > 0 and v8.has_nonnegative_lane(edge):
        r, g, b = v8.load_colours(splats, Index(3) * pixel)
        edge = v8.minimum(edge, green - g - v8.broadcast(np.float32(EDGE)))
        is_mixed = v8.has_nonnegative_lane(edge)
    return (r, g, b), v8.at_least(edge, zeros), is_mixed


@kernel_function()
def _blend_pixels(pixels, at, splats, pixel, u, lengths, opacity, clear, tau, sky, light):
    """Blend eight pixels with the veil and the drops, in place.

    splats: as in blend_falling. opacity: alpha. tau: the veil's optical depth at unit depth. sky:
    transmittance up to the sky. light [3, 4]: airlight; mean light of a drop; its change to the
    right; its change ahead.
    """
    zeros = v8.broadcast(np.float32(0))
    ones = v8.broadcast(np.float32(1))
    surface_transmittance = decay(tau * lengths)
    per_length = ones / lengths
    red, green, blue = v8.load_colours(pixels, at)
    (r, g, b), edge, is_mixed = surface_parts(splats, pixel, opacity, red, green, blue)
    red = _veil(
        v8.maximum(red, zeros), r, is_mixed, edge, light[0], opacity, surface_transmittance, sky
    )
    green = _veil(
        v8.maximum(green, zeros), g, is_mixed, edge, light[1], opacity, surface_transmittance, sky
    )
    blue = _veil(
        v8.maximum(blue, zeros), b, is_mixed, edge, light[2], opacity, surface_transmittance, sky
    )
    red = blend_colour(red, light[0], u, clear, per_length)
    green = blend_colour(green, light[1], u, clear, per_length)
    blue = blend_colour(blue, light[2], u, clear, per_length)
    v8.store_colours(pixels, at, red, green, blue)


@kernel_function()
def _veil(color, splats, is_mixed, edge, light, opacity, surface_transmittance, sky):
    """Return the square of a colour behind the veil.

    edge: lanes whose pixels show both surfaces and sky, each behind its own veil, if is_mixed.
    surface_transmittance: transmittance up to the surfaces.
    """
    zeros = v8.broadcast(np.float32(0))
    air = v8.broadcast(light[0])
    veiled = air + (sky + opacity * (surface_transmittance - sky)) * (color * color - air)
    if is_mixed:
        sky_share = v8.broadcast(np.float32(1)) - opacity
        sky_part = v8.minimum(v8.maximum(color - splats, zeros), sky_share)
        surface_part = (color - sky_part) / v8.maximum(opacity, v8.broadcast(np.float32(EDGE)))
        sky_part = sky_part / v8.maximum(sky_share, v8.broadcast(np.float32(EDGE)))
        surface_part = opacity * v8.sqrt(
            v8.maximum(air + surface_transmittance * (surface_part * surface_part - air), zeros)
        )
        sky_part = sky_share * v8.sqrt(v8.maximum(air + sky * (sky_part * sky_part - air), zeros))
        veiled = v8.select(edge, (surface_part + sky_part) * (surface_part + sky_part), veiled)
    return veiled


@kernel_function()
def blend_colour(veiled, light, u, clear, per_length):
    """Return the colour whose square is `veiled`, behind the drops."""
    glow = (
        v8.broadcast(light[1]) + (v8.broadcast(light[2]) * u + v8.broadcast(light[3])) * per_length
    )
    out = glow + clear * (veiled - glow)
    return v8.sqrt(v8.maximum(out, v8.broadcast(np.float32(0))))


@kernel_function()
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
    partial,
    pixels,
):
    """Blend a row of blend_falling. clear: from index `first` on. partial, pixels: scratch."""
    zeros = v8.broadcast(np.float32(0))
    half = np.float32(0.5)
    min_climb = np.float32(1e-6)
    count, slope, offset = classes_in_row(nearest, bands, partial)
    v = (np.float32(row) + half - rays[3]) * rays[1]
    flat = v8.broadcast(np.float32(1) + v * v)
    level = climb[1] * v + climb[2]
    left = (half - rays[2]) * rays[0]
    right = (np.float32(width) - rays[2]) * rays[0]
    shows_sky = max(climb[0] * left, climb[0] * right) + level > min_climb
    for j in range(0, width, NUM_LANES):
        # The last eight pixels of a row include earlier ones, which are not written.
        at = min(j, width - NUM_LANES)
        pixel = Index(row * width + at)
        u = v8.broadcast(np.float32(at) + half - rays[2]) + v8.lane_numbers()
        u = u * v8.broadcast(rays[0])
        lengths = v8.sqrt(flat + u * u)
        z = v8.load(depth, pixel)
        tau = veil_depth(z, count, slope, offset, partial)
        sky = zeros
        if shows_sky:  # below the horizon nothing is visible through so much veil
            steep = v8.broadcast(climb[0]) * u + v8.broadcast(level)
            sky = decay(
                v8.broadcast(upwards) * lengths / v8.maximum(steep, v8.broadcast(min_climb))
            )
        opacity = v8.select(v8.greater(z, zeros), v8.load(alpha, pixel), zeros)
        clear_share = v8.load(clear, first + Index(at))
        if at == j:
            _blend_pixels(
                rgb,
                Index(3) * pixel,
                splats,
                pixel,
                u,
                lengths,
                opacity,
                clear_share,
                tau,
                sky,
                light,
            )
        else:
            for k in range(Index(3 * NUM_LANES)):
                pixels[k] = rgb[Index(3) * pixel + k]
            _blend_pixels(
                pixels, Index(0), splats, pixel, u, lengths, opacity, clear_share, tau, sky, light
            )
            for k in range(Index(3 * (j - at)), Index(3 * NUM_LANES)):
                rgb[Index(3) * pixel + k] = pixels[k]


@kernel
def blend_falling(
    rgb,
    splats,
    alpha,
    depth,
    drops,
    listed,
    begins,
    min_clear_share,
    rays,
    climb,
    bands,
    upwards,
    airlight,
    glow,
    mask,
):
    """Blend a picture with the veil and the drops, in place.

    Light is in squares of display-encoded colours. All arrays are float32 except indices and mask.

    Args:
        rgb: [3 H W] the picture, changed in place.
        splats: [3 H W] the surfaces' part of rgb; the other part is the sky's. If the parts are not
            known, it is empty: then both lie behind the mean of their veils, so that a bright sky
            shines at edges.
        alpha: as in cover_pixels.
        depth: as in cover_pixels.
        drops: as in cover_pixels.
        listed: as in cover_pixels.
        begins: as in cover_pixels.
        min_clear_share: clear share of a pixel below which the pixel is in the mask.
        rays: 1 / fx, 1 / fy, cx, cy.
        climb: [3] the world's z along the camera's axes.
        bands: [NUM_CLASSES, 5] extinction of a class, depth where its veil begins, depth over which
            it grows, half the inverse of that, depth from which it is complete.
        upwards: optical depth straight up.
        airlight: [3].
        glow: [3, 4] light of a drop by direction along the camera's axes, and its mean.
        mask: output [H, W], pixels of which drawn drops leave less than `min_clear_share`.
    """
    height, width = mask.shape
    for band in prange(len(begins) - 1):
        top = np.int64(band) * ROWS
        bottom = min(top + ROWS, height)
        clear = np.empty(ROWS * width, np.float32)
        nearest = np.empty(ROWS, np.float32)
        light = np.empty((3, 4), np.float32)
        partial = np.empty((NUM_CLASSES, 5), np.float32)
        pixels = np.empty(3 * NUM_LANES, np.float32)
        for row in range(top, bottom):  # this also brings the surfaces into the cache, in order
            nearest[row - top] = nearest_in_row(row, width, alpha, depth, pixels)
        cover_band(
            drops, listed, begins[band], begins[band + 1], top, bottom, width, alpha, depth, clear
        )
        for row in range(top, bottom):
            first = Index((row - top) * width)
            for j in range(Index(width)):
                mask[Index(row), j] = clear[first + j] < min_clear_share
            light_of_row(row, rays, airlight, glow, light)
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
                partial,
                pixels,
            )
