"""Numba kernels of the tables that hold the light of each lamp in the air, and their look-up.

A ray is known at a lamp by the angle gamma between them and by the plane that holds both. Luminance
times h changes slowly with either. So it is computed once for each lamp at some angles and planes,
and rays between them take bilinear look-ups. `augment.lamps.air_light` gives the equations.

Angles are nodes of w = sqrt(2 sin(gamma / 2)), which are dense about the lamp. Behind the camera,
beyond a right angle, w is mirrored, W_END - sqrt(2 sin((pi - gamma) / 2)), and the tables hold
luminance times the lamp's distance. Angles at the lamp are nodes of sqrt(delta), which are dense
towards the camera.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.lamps.pattern_kernels import COLUMN_SCALE, ROOT, ROOT_OFFSET, ROW_SCALE
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.layout import Index

# Number of optical distances u of the table of G.
NUM_DISTANCES = 96
# Number of steps of theta in that table.
NUM_ANGLES = 512
# Largest u of that table; the light of lamps further from the ray is zero.
MAX_DISTANCE = 20.0
# Optical distance at which the table's spacing turns from linear to logarithmic.
DISTANCE_KNEE = 0.01

# Nodes of w to a unit of w.
NODES_PER_W = 40
# Largest w, straight behind a lamp: twice that of a right angle.
W_END = 2 * 2**0.25
# Largest factor of luminance, so that lights stay finite where fog is absurdly dense.
MAX_SCALE = 1e24
# Angle, radians, beyond which the factor for multiple scattering grows no more: 45 degrees.
MAX_FACTOR_ANGLE_RAD = math.pi / 4
# Least share of what multiple scattering adds to a lamp of a beam's mean intensity that the beam
# itself has, from all sides.
FLOOR_SHARE = 0.13
# Share of the angle of cut-off from which on a halo fades to zero.
FADE_FROM = 0.8

_DISTANCE_SCALE = (NUM_DISTANCES - 1) / math.asinh(MAX_DISTANCE / DISTANCE_KNEE)
_ANGLE_SCALE = NUM_ANGLES / math.pi
_ROOT_DEGREES = math.sqrt(180 / math.pi)
_SMALL_OFFSET = np.float32(ROOT_OFFSET)
_SMALL_ROOT = np.float32(ROOT)
_SMALL_ROW_SCALE = np.float32(ROW_SCALE)
_SMALL_COLUMN_SCALE = np.float32(COLUMN_SCALE)
_TINY = np.float32(1e-30)


class HaloLamps(NamedTuple):
    """Lamps as the kernels read them, in camera axes: M lamps."""

    frames: np.ndarray  # float64 [M, 3, 3]: unit vectors to the lamp, and two at right angles to it
    distances_m: np.ndarray  # float64 [M]
    sigmas_per_m: np.ndarray  # float64 [M]
    colors: np.ndarray  # float64 [M, 3]: linear sRGB of 1 cd
    means_cd: np.ndarray  # float64 [M]: mean intensity over all directions
    factors: np.ndarray  # float64 [M, 2]: c T of the lamp, and of a lamp that is no beam
    ends: np.ndarray  # float64 [M, 2]: angle of cut-off in radians, and its cosine
    layouts: np.ndarray  # int64 [M, 10]: see the columns below


# Columns of HaloLamps.layouts.
PLANES = Index(0)  # number of planes
INTERVALS = Index(1)  # number of intervals of the angle at the lamp
SAMPLES = Index(2)  # samples of the pattern over half a turn
SCATTER = Index(3)  # table of G
FLUX_START = Index(4)  # first number in the integrals of the intensity
FIRST_NODE = Index(5)  # first node of w
NUM_NODES = Index(6)  # number of nodes of w
SLICE_START = Index(7)  # first number in the table of slices
REACH_START = Index(8)  # first number in the table by the angle at the lamp
REACH_NODES = Index(9)  # number of nodes of w in that table


@kernel_function()
def angle_of(y, x):
    """Return atan2(y, x) for y >= 0, within 1e-5 rad and 3e-5 of itself, without a branch on x."""
    size = abs(x)
    ratio = min(y, size) / max(max(y, size), 1e-30)
    q = ratio * ratio
    p = -0.01172120 * q + 0.05265332
    p = p * q - 0.11643287
    p = p * q + 0.19354346
    p = p * q - 0.33262347
    p = (p * q + 0.99997726) * ratio
    p = 0.5 * math.pi - p if y > size else p
    return math.pi - p if x < 0 else p


@kernel_function()
def _scattered(table, row, row_share, theta):
    """Return G between two rows of its table, at an angle in radians."""
    column = theta * _ANGLE_SCALE
    k = min(int(column), NUM_ANGLES - 1)
    q = min(column - k, 1.0)
    near = table[row, k] * (1 - q) + table[row, k + 1] * q
    far = table[row + 1, k] * (1 - q) + table[row + 1, k + 1] * q
    return near * (1 - row_share) + far * row_share


@kernel
def fill_flux(tables, patterns, local_frames, intensities, layouts, flux, peaks):
    """Integrate each lamp's intensity over the angle at the lamp, in planes through the camera.

    Args:
        tables: float32 [K, V, U], packed patterns.
        patterns: int64 [M], row of the tables of each lamp.
        local_frames: float32 [M, 3, 3], unit vectors from the camera to the lamp, and two at right
            angles, each by its share forward, right and up in the lamp's axes.
        intensities: float64 [M], candela.
        layouts: int64 [M, 10], HaloLamps.layouts.
        flux: output float32; a lamp has intervals + 1 rows of one integral a plane, from 0 on,
            candela times rad.
        peaks: output float64 [M], largest mean intensity of an interval.
    """
    zero = np.float32(0)
    one_f32 = np.float32(1)
    two = np.float32(2)
    half_rows = np.float32(0.5 * (tables.shape[1] - 1))
    half_columns = np.float32(0.5 * (tables.shape[2] - 1))
    last_i = tables.shape[1] - 2
    last_j = tables.shape[2] - 2
    for m in prange(len(patterns)):
        num_planes = layouts[m, PLANES]
        num_intervals = layouts[m, INTERVALS]
        table = tables[patterns[m]]
        frame = local_frames[m]
        sides = np.empty((3, num_planes), np.float32)
        for p in range(num_planes):
            turn = 2 * math.pi * p / num_planes
            cosine = np.float32(math.cos(turn))
            sine = np.float32(math.sin(turn))
            for axis in range(3):
                sides[axis, p] = cosine * frame[1, axis] + sine * frame[2, axis]
        rows = np.empty(num_planes, np.float32)
        columns = np.empty(num_planes, np.float32)
        sums = np.empty(num_planes, np.float32)
        start = layouts[m, FLUX_START]
        for p in range(num_planes):
            flux[start + p] = zero
        peak = 0.0
        for j in range(num_intervals):
            low = math.pi * (j / num_intervals) ** 2
            width = math.pi * (2 * j + 1) / (num_intervals * num_intervals)
            num_samples = math.ceil(width * layouts[m, SAMPLES] / math.pi)
            for p in range(num_planes):
                sums[p] = zero
            for sample in range(num_samples):
                angle = low + width * (sample + 0.5) / num_samples
                along = np.float32(-math.cos(angle))  # towards the camera at angle 0
                aside = np.float32(math.sin(angle))
                forward_along = along * frame[0, 0]
                right_along = along * frame[0, 1]
                up_along = along * frame[0, 2]
                # Places in the pattern, as `pattern_kernels.place_eight` finds them.
                for p in range(num_planes):
                    forward = forward_along + aside * sides[0, p]
                    right = right_along + aside * sides[1, p]
                    up = up_along + aside * sides[2, p]
                    level = np.float32(math.sqrt(forward * forward + right * right))
                    fold = abs(up) / max(abs(up) + level, _TINY)
                    row = np.float32(math.sqrt(fold + _SMALL_OFFSET)) - _SMALL_ROOT
                    row *= _SMALL_ROW_SCALE
                    row = -row if up < zero else row
                    fold = abs(right) / max(abs(forward) + abs(right), _TINY)
                    fold = two - fold if forward < zero else fold
                    column = np.float32(math.sqrt(fold + _SMALL_OFFSET)) - _SMALL_ROOT
                    column *= _SMALL_COLUMN_SCALE
                    column = -column if right < zero else column
                    rows[p] = min(max((row + one_f32) * half_rows, zero), two * half_rows)
                    columns[p] = min(
                        max((column + one_f32) * half_columns, zero), two * half_columns
                    )
                for p in range(num_planes):
                    i = min(int(rows[p]), last_i)
                    k = min(int(columns[p]), last_j)
                    v = rows[p] - np.float32(i)
                    u = columns[p] - np.float32(k)
                    below = table[i, k] + u * (table[i, k + 1] - table[i, k])
                    above = table[i + 1, k] + u * (table[i + 1, k + 1] - table[i + 1, k])
                    sums[p] += below + v * (above - below)
            scale = np.float32(intensities[m] / num_samples)
            step = np.float32(width)
            place = start + j * num_planes
            for p in range(num_planes):
                mean = sums[p] * scale
                peak = max(peak, mean)
                flux[place + num_planes + p] = flux[place + p] + mean * step
        peaks[m] = peak


@kernel_function()
def _factors_at(lamps, index, gamma, cosine):
    """Return what scales the light of a lamp at an angle: all of it, the beam, and its floor.

    Args:
        lamps: the lamps.
        index: the lamp's row.
        gamma: angle at the camera between ray and lamp, radians.
        cosine: its cosine.

    Returns:
        Factor of the light; factor for multiple scattering; what it adds at least, for 1 cd.
    """
    # Factor for multiple scattering: of this lamp, and as a floor, a share of what it adds to a
    # lamp of the mean intensity that is no beam.
    root = _ROOT_DEGREES * math.sqrt(min(gamma, MAX_FACTOR_ANGLE_RAD))
    beam_gain = math.exp(lamps.factors[index, 0] * root)
    wide_gain = math.exp(lamps.factors[index, 1] * root)
    added_mean = FLOOR_SHARE * lamps.means_cd[index] * (wide_gain - 1)
    sigma = lamps.sigmas_per_m[index]
    scale = sigma * math.exp(-sigma * lamps.distances_m[index] * cosine)
    end = lamps.ends[index, 0]
    fade = (gamma - FADE_FROM * end) / ((1 - FADE_FROM) * end)
    if end < math.pi and fade > 0:
        weight = max(1 - fade, 0.0)
        scale *= weight * weight * (1 + 2 * fade)
    return scale, beam_gain, added_mean


@kernel
def fill_tables(lamps, scatter, slices, flux, slice_table, reach_table):
    """Write luminance times h of each lamp, by the ray's place and the end of the ray.

    The medium is integrated exactly in each interval of the angle at the lamp, the intensity enters
    by its mean over the interval. So narrow beams do not fall between points.

    Args:
        lamps: the lamps.
        scatter: float32 [P, U, T], tables of G.
        slices: float64 [K], inverse distances, falling, 1/m; the last is 0.
        flux: result of `fill_flux`.
        slice_table: output float32: nodes of w, planes, slices of distance.
        reach_table: output float32: nodes of w, planes, angles at the lamp.
    """
    zero = np.float32(0)
    num_slices = len(slices)
    for m in prange(len(lamps.distances_m)):
        layout = lamps.layouts[m]
        num_planes = layout[PLANES]
        num_intervals = layout[INTERVALS]
        table = scatter[layout[SCATTER]]
        distance = lamps.distances_m[m]
        sigma = lamps.sigmas_per_m[m]
        flux_start = layout[FLUX_START]
        totals = np.empty((num_intervals + 1, num_planes), np.float32)
        lights = np.empty((max(num_slices, num_intervals + 1), num_planes), np.float32)
        scattered = np.empty(num_intervals + 1, np.float64)
        for node in range(layout[NUM_NODES]):
            w = (layout[FIRST_NODE] + node) / NODES_PER_W
            is_behind = w > 0.5 * W_END
            folded = max(W_END - w, 0.0) if is_behind else w
            half_sine = (
                0.5 * folded * folded
            )  # of half of gamma, or of what it lacks to a half turn
            cosine = 1 - 2 * half_sine * half_sine
            gamma = 2 * math.asin(half_sine)
            if is_behind:
                cosine = -cosine
                gamma = math.pi - gamma
            sine = max(math.sin(gamma), 1e-6)
            u = sigma * distance * sine
            slice_start = layout[SLICE_START] + node * num_planes * num_slices
            reach_start = layout[REACH_START] + node * num_planes * (num_intervals + 1)
            has_reach = node < layout[REACH_NODES]
            if u >= MAX_DISTANCE or gamma >= lamps.ends[m, 0]:
                for place in range(slice_start, slice_start + num_planes * num_slices):
                    slice_table[place] = zero
                if has_reach:
                    for place in range(reach_start, reach_start + num_planes * (num_intervals + 1)):
                        reach_table[place] = zero
                continue
            ratio = u * (1 / DISTANCE_KNEE)
            row_place = math.log(ratio + math.sqrt(ratio * ratio + 1)) * _DISTANCE_SCALE
            row = min(int(row_place), NUM_DISTANCES - 2)
            row_share = row_place - row
            scale, beam_gain, added_mean = _factors_at(lamps, m, gamma, cosine)
            if is_behind:
                scale /= sine
            scale = min(scale, MAX_SCALE)
            beam_scale = np.float32(scale * beam_gain)
            plain_scale = np.float32(scale)
            for j in range(num_intervals + 1):
                angle = math.pi * (j / num_intervals) ** 2
                scattered[j] = _scattered(table, row, row_share, min(gamma + angle, math.pi))
            for p in range(num_planes):
                totals[0, p] = zero
            for j in range(num_intervals):
                width = math.pi * (2 * j + 1) / (num_intervals * num_intervals)
                weight = np.float32((scattered[j + 1] - scattered[j]) / width)
                place = flux_start + j * num_planes
                for p in range(num_planes):
                    mean = flux[place + num_planes + p] - flux[place + p]
                    totals[j + 1, p] = totals[j, p] + mean * weight
            # To the slices of distance.
            for k in range(num_slices):
                reach = min(angle_of(sine, distance * slices[k] - cosine), math.pi - gamma)
                j = min(int(num_intervals * math.sqrt(reach * (1 / math.pi))), num_intervals - 1)
                part = _scattered(table, row, row_share, min(gamma + reach, math.pi))
                step = scattered[j + 1] - scattered[j]
                share = np.float32(min(max((part - scattered[j]) / max(step, 1e-30), 0.0), 1.0))
                floor = np.float32(scale * (part - scattered[0]) * added_mean)
                for p in range(num_planes):
                    total = totals[j, p] + share * (totals[j + 1, p] - totals[j, p])
                    lights[k, p] = max(total * beam_scale, total * plain_scale + floor)
            for p in range(num_planes):
                place = slice_start + p * num_slices
                for k in range(num_slices):
                    slice_table[place + k] = lights[k, p]
            if not has_reach:
                continue
            for j in range(num_intervals + 1):
                floor = np.float32(scale * (scattered[j] - scattered[0]) * added_mean)
                for p in range(num_planes):
                    total = totals[j, p]
                    lights[j, p] = max(total * beam_scale, total * plain_scale + floor)
            for p in range(num_planes):
                place = reach_start + p * (num_intervals + 1)
                for j in range(num_intervals + 1):
                    reach_table[place + j] = lights[j, p]


@kernel_function()
def place_at_lamp(lamps, index, x, y, z):
    """Return the place of a ray in a lamp's tables.

    Args:
        lamps: the lamps.
        index: the lamp's row.
        x: unit direction of the ray in camera axes, like y and z.

    Returns:
        Cosine and sine of the angle between ray and lamp; node of w and share of the next; plane,
        the next one, and that one's share.
    """
    frame = lamps.frames[index]
    layout = lamps.layouts[index]
    cosine = x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2]
    side = x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]
    rise = x * frame[2, 0] + y * frame[2, 1] + z * frame[2, 2]
    square = side * side + rise * rise
    sine = max(math.sqrt(square), 1e-6)
    cosine_gap = 1 - abs(cosine)
    w = math.sqrt(math.sqrt(square + cosine_gap * cosine_gap))
    w = w if cosine > 0 else W_END - w
    node_place = max(w * NODES_PER_W - layout[FIRST_NODE], 0.0)
    node = min(int(node_place), layout[NUM_NODES] - 2)
    node_share = min(node_place - node, 1.0)
    num_planes = layout[PLANES]
    plane = angle_of(abs(rise), side)
    plane = (2 * math.pi - plane if rise < 0 else plane) * (num_planes / (2 * math.pi))
    upper = int(plane)
    plane_share = plane - upper
    upper = upper if upper < num_planes else 0
    lower = upper + 1 if upper + 1 < num_planes else 0
    return cosine, sine, node, node_share, upper, lower, plane_share


@kernel_function()
def _corner_light(reach_table, first, second, third, fourth, shares, j, q):
    """Return a value of the table by reach between four corners and two angles at the lamp."""
    node_share, plane_share = shares
    a = reach_table[first + j] + q * (reach_table[first + j + 1] - reach_table[first + j])
    b = reach_table[second + j] + q * (reach_table[second + j + 1] - reach_table[second + j])
    c = reach_table[third + j] + q * (reach_table[third + j + 1] - reach_table[third + j])
    d = reach_table[fourth + j] + q * (reach_table[fourth + j + 1] - reach_table[fourth + j])
    near = a + plane_share * (b - a)
    far = c + plane_share * (d - c)
    return near + node_share * (far - near)


@kernel_function()
def light_to_ends(lamps, index, reach_table, x, y, z, near, far, max_difference):
    """Return the luminance of a lamp's light along a ray times h, to two distances.

    Args:
        lamps: the lamps.
        index: the lamp's row.
        reach_table: result of `fill_tables`.
        x: unit direction of the ray in camera axes, like y and z.
        near: inverse of the nearer distance to which the ray goes, 1/m.
        far: inverse of the further distance.
        max_difference: largest relative difference of the two at which both get the light to their
            mean.

    Returns:
        The two, and 1 if the lamp lies before the camera, else 0.
    """
    cosine, sine, node, node_share, upper, lower, plane_share = place_at_lamp(lamps, index, x, y, z)
    layout = lamps.layouts[index]
    node = min(node, layout[REACH_NODES] - 2)
    num_intervals = layout[INTERVALS]
    length = num_intervals + 1
    row = layout[REACH_START] + node * layout[PLANES] * length
    next_row = row + layout[PLANES] * length
    corners = (
        row + upper * length, row + lower * length,
        next_row + upper * length, next_row + lower * length,
    )  # fmt: skip
    shares = (node_share, plane_share)
    distance = lamps.distances_m[index]
    has_two = near - far > max_difference * near
    first = far if has_two else 0.5 * (near + far)
    place = num_intervals * math.sqrt(angle_of(sine, distance * first - cosine) * (1 / math.pi))
    j = min(int(place), num_intervals - 1)
    far_light = _corner_light(reach_table, *corners, shares, j, min(place - j, 1.0))
    near_light = far_light
    if has_two:
        place = num_intervals * math.sqrt(angle_of(sine, distance * near - cosine) * (1 / math.pi))
        j = min(int(place), num_intervals - 1)
        near_light = _corner_light(reach_table, *corners, shares, j, min(place - j, 1.0))
    return near_light, far_light, 1.0 if cosine > 0 else 0.0
