"""Numba kernels: which drops a camera sees, what of a pixel they cover, the veil of the rest."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.effects.falling.drops import CELL_FACTORS, MAX_IN_CELL, NUM_CLASSES
from augment.kernels import mix
from augment.render.cpu.jit import inner, kernel
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import U
from augment.render.picture_kernels import decay
from augment.rng import STEP_X

ROWS = 16  # image rows of a band, which a thread draws at a time
FADE = 0.75  # of the distance to which a class is drawn: beyond, its drops fade into the veil
SOFT = 0.03  # of its depth: so far behind a surface a drop is hidden
LEAST_RADIUS = 1.25  # pixels; a smaller one would show where pixels lie
NUM_NUMBERS = 9  # of a drop in the picture
_HALF = float(2**-21)
_CELL_X, _CELL_Y, _CELL_Z = (np.uint64(f) for f in CELL_FACTORS)
_STEP = np.uint64(STEP_X)


@inner()
def _unit(bits, shift):
    """21 of the bits as a number in [0, 1)."""
    return np.float64((bits >> np.uint64(shift)) & np.uint64(0x1FFFFF)) * _HALF


@inner()
def _sway(out, point, time, phase, sway):
    """Adds to a point where the air's eddies and a flake's own flutter have it.

    sway: speed of each of the two, m/s. Eddies: three waves across their direction of travel, so
    the air is neither pressed nor thinned; flutter: a level circle of the flake's own.
    """
    x, y, z = point[0], point[1], point[2]
    for wave in range(3):
        along = x if wave == 0 else y if wave == 1 else z
        pace = 2.0 + 0.7 * wave
        angle = (1.1 + 0.4 * wave) * along + pace * time
        size = 0.6 * sway / pace
        out[(wave + 1) % 3] += size * math.sin(angle)
        out[(wave + 2) % 3] += size * math.cos(angle)
    pace = 4 + 8 * phase
    out[0] += sway / pace * math.sin(pace * time + 50 * phase)
    out[1] += sway / pace * math.cos(pace * time + 50 * phase)


@kernel
def find_drops(
    slabs, columns, cells, keys, moves, sways, quantiles, shares, planes, shutter, lens,
    offsets, counts, found,
):  # fmt: skip
    """counts [S]: drops of each slab of cells that are seen. found [N, NUM_NUMBERS]: theirs from
    offsets [S] on: column and row at both ends of a streak, 1 / z there, radius up to which it
    covers as much as in its middle, radius beyond which nothing, covered share. Empty: counts are
    of all drops in the cells, which takes next to no time.

    slabs [S, 2]: class, x of the cells. columns [B, 2]: first y, end. cells [B, 3]: size, how far a
    drop can be from its cell's middle, depth to which the class is drawn. keys [B]: of the hashes.
    moves [B, 3, 3]: where the lattice has moved to as the shutter opens, between, as it closes.
    sways: their speed, and the time. quantiles [B, Q]. shares: as drops.cell_counts. planes [5, 4]:
    inwards normal and offset of the view's sides and its front. shutter [2, 3, 4]:
    camera_from_world as the shutter opens and closes. lens: fx, fy, cx, cy, width, height, least
    depth, diameter of the aperture, depth in focus. All float64 but for the integers and found.
    """
    is_counting = len(found) == 0
    for slab in prange(len(slabs)):
        b, i = slabs[slab, 0], slabs[slab, 1]
        size, reach, farthest = cells[b, 0], cells[b, 1], cells[b, 2]
        number = np.int64(0)
        at, ends = np.empty(3), np.empty((2, 3))
        for j in range(columns[b, 0], columns[b, 1]):
            x = (np.float64(i) + 0.5) * size + moves[b, 1, 0]
            y = (np.float64(j) + 0.5) * size + moves[b, 1, 1]
            low, high = -1e18, 1e18  # z of the cells' middles, scene world
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
                    more = mix(bits ^ _STEP)
                    at[0] = (np.float64(i) + _unit(bits, 0)) * size + moves[b, 0, 0]
                    at[1] = (np.float64(j) + _unit(bits, 21)) * size + moves[b, 0, 1]
                    at[2] = (np.float64(k) + _unit(bits, 42)) * size + moves[b, 0, 2]
                    if sways[0] > 0:  # which moves it less than its size while the shutter is open
                        ends[0, 0], ends[0, 1], ends[0, 2] = at[0], at[1], at[2]
                        _sway(at, ends[0], sways[1], _unit(more, 21), sways[0])
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
                    z0, z1 = ends[0, 2], ends[1, 2]
                    if max(z0, z1) <= near:
                        continue
                    for end in range(2):  # what is behind the front is cut off
                        if ends[end, 2] < near:
                            cut = (near - z0) / (z1 - z0)
                            for c in range(3):
                                ends[end, c] = ends[0, c] + cut * (ends[1, c] - ends[0, c])
                            ends[end, 2] = near
                            z0, z1 = ends[0, 2], ends[1, 2]
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
                    found[row, 0], found[row, 1] = u0, v0
                    found[row, 2], found[row, 3] = u1, v1
                    found[row, 4], found[row, 5] = 1 / z0, 1 / z1
                    found[row, 6], found[row, 7] = inside, outside
                    found[row, 8] = cover * fade
                    number += 1
        counts[slab] = number


@kernel
def cover_pixels(drops, listed, begins, alpha, depth, clear):
    """clear [H, W]: share of each pixel that none of the drops covers, in their order.

    drops: as found by find_drops. listed: rows of it, those that reach into band b of ROWS image
    rows from begins[b] to begins[b + 1]. alpha, depth [H, W]: of the surfaces; depth 0 where none
    is.
    """
    height, width = clear.shape
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    end = np.float32(width)
    for band in prange(len(begins) - 1):
        top = np.int64(band) * ROWS
        bottom = min(top + ROWS, height)
        for place in range(begins[band], begins[band + 1]):
            drop = drops[listed[place]]
            u0, v0, near, outside, share = drop[0], drop[1], drop[4], drop[7], drop[8]
            du, dv, farther = drop[2] - u0, drop[3] - v0, drop[5] - near
            per_length = one / max(du * du + dv * dv, np.float32(1e-12))
            beyond = outside * outside
            ramp = share / (beyond - drop[6] * drop[6])
            leans = abs(dv) > np.float32(1e-3)
            per_row = one / dv if leans else zero
            first = max(top, np.int64(min(v0, drop[3]) - outside + np.float32(ROWS)) - ROWS)
            last = min(bottom, np.int64(max(max(v0, drop[3]) + outside, zero)) + 1)
            for row in range(first, last):
                i = U(row)  # what is not signed needs no check
                v = np.float32(row) + half - v0
                # The piece of the streak that is so near to the row.
                a, b = zero, one
                if leans:
                    middle, reach = v * per_row, outside * abs(per_row)
                    a = min(max(middle - reach, zero), one)
                    b = min(max(middle + reach, zero), one)
                ua, ub = u0 + a * du, u0 + b * du
                ax, base = du * per_length, v * dv * per_length
                left = np.int64(max(min(ua, ub) - outside, zero))
                right = np.int64(min(max(max(ua, ub) + outside + one, zero), end))
                for column in range(left, right):
                    j = U(column)
                    x, y = np.float32(column) + half - u0, v
                    along = min(max(x * ax + base, zero), one)
                    x -= along * du
                    y -= along * dv
                    covered = min(max((beyond - (x * x + y * y)) * ramp, zero), share)
                    # Without a branch, which no processor could foresee; 1 / z of the drop is
                    # near + along * farther.
                    surface = depth[i, j]
                    behind = (one - surface * (near + along * farther)) * np.float32(1 / SOFT)
                    hidden = alpha[i, j] * min(max(behind, zero), one)
                    covered *= one - (hidden if surface > zero else zero)
                    clear[i, j] *= one - covered


@kernel
def blend_falling(rgb, alpha, depth, clear, rays, climb, bands, upwards, airlight, glow):
    """rgb [H, W, 3] behind the veil and the drops, in place.

    clear: as of cover_pixels. rays: 1 / fx, 1 / fy, cx, cy. climb [3]: the world's z along the
    camera's axes. bands [NUM_CLASSES, 5]: extinction of a class, depth where it begins, over which
    depth it grows, half its inverse, depth from which on it is whole. upwards: optical depth
    straight up. airlight [3]. glow [3, 4]: light of a drop by direction along the camera's axes,
    and in the mean. Light is squares of display-encoded colours. All float32.
    """
    height, width = depth.shape
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    most = np.float32(MAX_EXPONENT)
    for i in prange(height):
        # In loops without branches, of few arrays each, so that LLVM writes vectors.
        v = (np.float32(i) + half - rays[3]) * rays[1]
        tau, lengths = np.zeros(width, np.float32), np.empty(width, np.float32)
        for b in range(NUM_CLASSES):
            extinction, begin, grows = bands[b, 0], bands[b, 1], bands[b, 2]
            half_inverse, whole = bands[b, 3], bands[b, 4]
            for j in range(U(width)):
                z = depth[i, j]
                inside = min(max(z - begin, zero), grows)
                tau[j] += extinction * (inside * inside * half_inverse + max(z - whole, zero))
        across, left = rays[0], half - rays[2]
        sideways, level = climb[0], climb[1] * v + climb[2]
        for j in range(U(width)):
            u = (np.float32(np.int32(j)) + left) * across
            lengths[j] = math.sqrt(one + u * u + v * v)
        for j in range(U(width)):
            u = (np.float32(np.int32(j)) + left) * across
            # Of the sky: straight up over the sine of the elevation.
            slope = max(sideways * u + level, np.float32(1e-6))
            sky = decay(min(upwards * lengths[j] / slope, most))
            shown = alpha[i, j] if depth[i, j] > zero else zero
            tau[j] = sky + shown * (decay(min(tau[j] * lengths[j], most)) - sky)
            lengths[j] = one / lengths[j]
        red, green, blue = airlight[0], airlight[1], airlight[2]
        red_mean, green_mean, blue_mean = glow[0, 3], glow[1, 3], glow[2, 3]
        red_right, green_right, blue_right = glow[0, 0], glow[1, 0], glow[2, 0]
        red_ahead = glow[0, 1] * v + glow[0, 2]
        green_ahead = glow[1, 1] * v + glow[1, 2]
        blue_ahead = glow[2, 1] * v + glow[2, 2]
        for j in range(U(width)):
            u = (np.float32(np.int32(j)) + left) * across
            seen, through, k = tau[j], clear[i, j], lengths[j]
            r, g, b = max(rgb[i, j, 0], zero), max(rgb[i, j, 1], zero), max(rgb[i, j, 2], zero)
            light = red_mean + (red_right * u + red_ahead) * k
            r = light + through * (red + seen * (r * r - red) - light)
            light = green_mean + (green_right * u + green_ahead) * k
            g = light + through * (green + seen * (g * g - green) - light)
            light = blue_mean + (blue_right * u + blue_ahead) * k
            b = light + through * (blue + seen * (b * b - blue) - light)
            rgb[i, j, 0] = math.sqrt(max(r, zero))
            rgb[i, j, 1] = math.sqrt(max(g, zero))
            rgb[i, j, 2] = math.sqrt(max(b, zero))
