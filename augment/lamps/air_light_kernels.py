"""Numba kernels of the light that lamps send into the air: tables, nodes, pixels.

`augment.lamps.air_light` calls them, gives the equations and says what the arrays mean.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.lamps.pattern_kernels import intensity
from augment.render.cpu.jit import kernel, kernel_function

# Number of optical distances u of the table of G.
NUM_DISTANCES = 96
# Number of steps of theta in that table.
NUM_ANGLES = 512
# Largest u of that table; the light of lamps further from the ray is zero.
MAX_DISTANCE = 20.0
# Optical distance at which the table's spacing turns from linear to logarithmic.
DISTANCE_KNEE = 0.01

# Least difference of two inverse distances that are told apart, 1/m.
TINY = np.float32(1e-9)
# Radius about a lamp within which nodes soften 1 / h, in their steps.
SOFT_STEPS = 1.5
# Square of the radius about a lamp in which nodes add what coarse nodes lack, in softened radii.
COARSE_END = 9.0
# Square of the radius about a lamp in which pixels add what nodes lack, in softened radii.
CORE_END = 16.0
# Largest relative difference of the two inverse distances of a node that are computed as one.
SAME_DISTANCE = 0.15
# Pixels whose mean of 1 / r about a lamp is that at the lamp's own pixel: 1 / SOFT_PX.
SOFT_PX = 0.28
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


class HaloLamps(NamedTuple):
    """Lamps as the kernels read them, in camera axes: M lamps."""

    frames: np.ndarray  # float64 [M, 3, 3]: unit vectors to the lamp, and two at right angles to it
    distances_m: np.ndarray  # float64 [M]
    sigmas_per_m: np.ndarray  # float64 [M]
    colors: np.ndarray  # float64 [M, 3]: linear sRGB of 1 cd
    means_cd: np.ndarray  # float64 [M]: mean intensity over all directions
    factors: np.ndarray  # float64 [M, 2]: c T of the lamp, and of a lamp that is no beam
    ends: np.ndarray  # float64 [M, 2]: angle of cut-off in radians, and its cosine
    tables: (
        np.ndarray
    )  # int64 [M, 5]: first number in planes, rows, cells, scatter table, intervals


class ImageGrid(NamedTuple):
    """The lens of an image, and the grid of nodes over it."""

    lens: np.ndarray  # float64 [5]: fx, fy, cx, cy and the geometric mean of fx and fy, pixels
    steps: np.ndarray  # int64 [2]: pixels between nodes, nodes between coarse ones


@kernel_function()
def _angle(y, x):
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
    q = column - k
    near = table[row, k] * (1 - q) + table[row, k + 1] * q
    far = table[row + 1, k] * (1 - q) + table[row + 1, k + 1] * q
    return near * (1 - row_share) + far * row_share


@kernel_function()
def _planes_beside(layout, plane):
    """Return the first numbers of the two planes beside a place, and the second one's share.

    Args:
        layout: the lamp's row of HaloLamps.tables.
        plane: plane through lamp and ray, in rows of the lamp's planes.
    """
    upper = int(plane)
    lower = upper + 1 if upper + 1 < layout[1] else 0
    length = layout[2] + 1
    return layout[0] + upper * length, layout[0] + lower * length, plane - upper


@kernel_function()
def _flux(planes, first, second, second_share, num_cells, angle):
    """Return the integral of a lamp's intensity from 0 to an angle, candela times rad.

    Args:
        planes: float32, integrals of the intensity over the angle at the lamp, one plane a row.
        first: first number of a plane.
        second: first number of the next plane.
        second_share: share of the second plane.
        num_cells: cells of a plane.
        angle: angle at the lamp, radians.
    """
    cell = angle * (num_cells / math.pi)
    k = min(int(cell), num_cells - 1)
    q = cell - k
    flux_a = planes[first + k] * (1 - q) + planes[first + k + 1] * q
    flux_b = planes[second + k] * (1 - q) + planes[second + k + 1] * q
    return flux_a * (1 - second_share) + flux_b * second_share


@kernel_function()
def _light_sums(scatter, planes, layout, plane, shares, row, row_share, gamma, reach):
    """Return the integral of intensity times what is scattered, and that of 1 cd.

    The medium is integrated exactly in each interval, the intensity enters by its mean over the
    interval. So narrow beams do not fall between points.

    Args:
        scatter: float32 [P, U, T], tables of G.
        planes: float32, integrals of the intensity over the angle at the lamp, one plane a row.
        layout: the lamp's row of HaloLamps.tables.
        plane: plane through lamp and ray, in rows of the lamp's planes.
        shares: float64 [17, 17, 2]; row K has the shares of the range at which K intervals end,
            and the inverse shares that they take.
        row: row of the table of G.
        row_share: share of the next row.
        gamma: angle at the camera between ray and lamp, radians.
        reach: angle at the lamp between the camera and the end of the ray, radians.
    """
    num_cells = layout[2]
    num_intervals = layout[4]
    table = scatter[layout[3]]
    first_plane, second_plane, second_share = _planes_beside(layout, plane)
    first_scatter = _scattered(table, row, row_share, gamma)
    last_scatter = first_scatter
    last_flux = 0.0
    total = 0.0
    for index in range(num_intervals):
        angle = reach * shares[num_intervals, index, 0]
        flux = _flux(planes, first_plane, second_plane, second_share, num_cells, angle)
        scattered = _scattered(table, row, row_share, gamma + angle)
        inverse_share = shares[num_intervals, index, 1]
        total += (flux - last_flux) * (scattered - last_scatter) * inverse_share
        last_scatter = scattered
        last_flux = flux
    return total / max(reach, 1e-12), last_scatter - first_scatter


@kernel_function()
def _ray_at_lamp(lamps, index, x, y, z):
    """Return a ray's geometry at a lamp, and the factors of the lamp's light along it.

    Args:
        lamps: the lamps.
        index: the lamp's row.
        x: unit direction of the ray in camera axes, like y and z.

    Returns:
        True if the lamp lights the ray; h, metres; cosine and sine of the angle between ray and
        lamp; that angle, radians; row of the table of G and share of the next; plane through lamp
        and ray, in rows of the lamp's planes; factor of the light; factor for multiple scattering
        of the lamp; and what it adds at least, for 1 cd.
    """
    frame = lamps.frames[index]
    cosine = x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2]
    if cosine <= lamps.ends[index, 1]:
        return False, 1.0, cosine, 0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    side = x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]
    rise = x * frame[2, 0] + y * frame[2, 1] + z * frame[2, 2]
    sine = max(math.sqrt(side * side + rise * rise), 1e-6)
    gamma = _angle(sine, cosine)
    distance = lamps.distances_m[index]
    sigma = lamps.sigmas_per_m[index]
    h = distance * sine
    u = sigma * h
    if u >= MAX_DISTANCE:
        return False, h, cosine, sine, gamma, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    num_planes = lamps.tables[index, 1]
    plane = _angle(abs(rise), side)
    plane = (2 * math.pi - plane if rise < 0 else plane) * (num_planes / (2 * math.pi))
    plane = plane if plane < num_planes else 0.0
    ratio = u * (1 / DISTANCE_KNEE)
    row_place = math.log(ratio + math.sqrt(ratio * ratio + 1)) * _DISTANCE_SCALE
    row = min(int(row_place), NUM_DISTANCES - 2)
    row_share = row_place - row
    # Factor for multiple scattering: of this lamp, and as a floor, a share of what it adds to a
    # lamp of the mean intensity that is no beam.
    root = _ROOT_DEGREES * math.sqrt(min(gamma, MAX_FACTOR_ANGLE_RAD))
    beam_gain = math.exp(lamps.factors[index, 0] * root)
    wide_gain = beam_gain
    if lamps.factors[index, 1] != lamps.factors[index, 0]:
        wide_gain = math.exp(lamps.factors[index, 1] * root)
    added_mean = FLOOR_SHARE * lamps.means_cd[index] * (wide_gain - 1)
    scale = sigma * math.exp(-sigma * distance * cosine)
    end = lamps.ends[index, 0]
    fade = (gamma - FADE_FROM * end) / ((1 - FADE_FROM) * end)
    if end < math.pi and fade > 0:
        scale *= (1 - fade) * (1 - fade) * (1 + 2 * fade)
    return (
        True, h, cosine, sine, gamma, row, row_share, plane, scale, beam_gain, added_mean,
    )  # fmt: skip


@kernel_function()
def _ray_light(lamps, index, scatter, planes, shares, x, y, z, near, far):
    """Return the luminance of a lamp's light along a ray times h, to two distances.

    Returns:
        The two, and 1 if the lamp lies before the camera, else 0.

    Args:
        lamps: the lamps.
        index: the lamp's row.
        scatter: as in `_light_sums`, like planes and shares.
        x: unit direction of the ray in camera axes, like y and z.
        near: inverse of the nearer distance to which the ray goes, 1/m.
        far: inverse of the further distance; where it is nearly the same, both get its light.
    """
    (
        is_lit, _, cosine, sine, gamma, row, row_share, plane, scale, beam_gain, added_mean,
    ) = _ray_at_lamp(lamps, index, x, y, z)  # fmt: skip
    if not is_lit:
        return 0.0, 0.0, 0.0
    layout = lamps.tables[index]
    distance = lamps.distances_m[index]
    # The angle at the lamp to a point at distance d: atan2(d sin, D - d cos), times 1 / d.
    has_two = near - far > SAME_DISTANCE * near
    first = far if has_two else 0.5 * (near + far)
    reach = min(_angle(sine, distance * first - cosine), math.pi - gamma)
    light, mean_light = _light_sums(
        scatter, planes, layout, plane, shares, row, row_share, gamma, reach
    )
    far_light = scale * max(light * beam_gain, light + mean_light * added_mean)
    near_light = far_light
    if has_two:
        reach = min(_angle(sine, distance * near - cosine), math.pi - gamma)
        light, mean_light = _light_sums(
            scatter, planes, layout, plane, shares, row, row_share, gamma, reach
        )
        near_light = scale * max(light * beam_gain, light + mean_light * added_mean)
    return near_light, far_light, 1.0 if cosine > 0 else 0.0


@kernel_function()
def _add_slices(
    lamps, index, scatter, planes, shares, x, y, z, softness, slices, first, last, values
):
    """Add the luminance of a lamp's light along a ray, up to each of some distances.

    The sum is that of `_light_sums`, with more intervals.

    Args:
        lamps: the lamps.
        index: the lamp's row.
        scatter: as in `_light_sums`, like planes and shares.
        x: unit direction of the ray in camera axes, like y and z.
        softness: radius about the lamp within which 1 / h is softened, radians.
        slices: float64 [K], inverse distances, falling, 1/m.
        first: the first slice that is wanted.
        last: the last slice that is wanted.
        values: float32 [K, 3], changed in place: luminance, linear sRGB, of the wanted slices.
    """
    (
        is_lit, h, cosine, sine, gamma, row, row_share, plane, scale, beam_gain, added_mean,
    ) = _ray_at_lamp(lamps, index, x, y, z)  # fmt: skip
    if not is_lit:
        return
    layout = lamps.tables[index]
    distance = lamps.distances_m[index]
    num_cells = layout[2]
    table = scatter[layout[3]]
    first_plane, second_plane, second_share = _planes_beside(layout, plane)
    soft = softness * distance if cosine > 0 else 0.0
    scale /= math.sqrt(h * h + soft * soft)
    first_scatter = _scattered(table, row, row_share, gamma)
    last_scatter = first_scatter
    last_flux = 0.0
    last_angle = 0.0
    total = 0.0
    end = min(_angle(sine, distance * slices[last] - cosine), math.pi - gamma)
    interval = 0
    for k in range(first, last + 1):
        reach = end
        if k < last:
            reach = min(_angle(sine, distance * slices[k] - cosine), end)
        while last_angle < reach:
            # Intervals end where those of `_light_sums` do, and at the slices.
            angle = end * shares[layout[4], interval, 0]
            if angle >= reach or interval == layout[4] - 1:
                angle = reach
            else:
                interval += 1
            flux = _flux(planes, first_plane, second_plane, second_share, num_cells, angle)
            scattered = _scattered(table, row, row_share, gamma + angle)
            if angle > last_angle:
                mean = (flux - last_flux) / (angle - last_angle)
                total += mean * (scattered - last_scatter)
            last_scatter = scattered
            last_flux = flux
            last_angle = angle
        mean_light = last_scatter - first_scatter
        light = scale * max(total * beam_gain, total + mean_light * added_mean)
        values[k, 0] += np.float32(light * lamps.colors[index, 0])
        values[k, 1] += np.float32(light * lamps.colors[index, 1])
        values[k, 2] += np.float32(light * lamps.colors[index, 2])


@kernel
def fill_planes(tables, patterns, axes, ups, frames, intensities, layouts, planes, peaks):
    """Integrate each lamp's intensity over the angle at the lamp, in planes through the camera.

    Args:
        tables: float32 [K, V, U], packed patterns.
        patterns: int64 [M], row of the tables of each lamp.
        axes: float64 [M, 3], axes of the lamps, like ups.
        frames: float64 [M, 3, 3], unit vectors from the camera to the lamp, and two at right
            angles, in the axes of `axes`.
        intensities: float64 [M], candela.
        layouts: int64 [M, 5], HaloLamps.tables.
        planes: output float32; a lamp has rows of cells + 1 integrals from 0 on, candela times rad.
        peaks: output float64 [M], largest mean intensity of a cell.
    """
    for m in prange(len(patterns)):
        num_rows = layouts[m, 1]
        num_cells = layouts[m, 2]
        peak = 0.0
        for row in range(num_rows):
            turn = 2 * math.pi * row / num_rows
            cos_turn = math.cos(turn)
            sin_turn = math.sin(turn)
            side_x = cos_turn * frames[m, 1, 0] + sin_turn * frames[m, 2, 0]
            side_y = cos_turn * frames[m, 1, 1] + sin_turn * frames[m, 2, 1]
            side_z = cos_turn * frames[m, 1, 2] + sin_turn * frames[m, 2, 2]
            place = layouts[m, 0] + row * (num_cells + 1)
            planes[place] = 0.0
            total = 0.0
            for cell in range(num_cells):
                angle = math.pi * (cell + 0.5) / num_cells
                along = -math.cos(angle)  # towards the camera at angle 0
                aside = math.sin(angle)
                mean = intensities[m] * intensity(
                    tables,
                    patterns[m],
                    axes[m],
                    ups[m],
                    along * frames[m, 0, 0] + aside * side_x,
                    along * frames[m, 0, 1] + aside * side_y,
                    along * frames[m, 0, 2] + aside * side_z,
                )
                peak = max(peak, mean)
                total += mean * (math.pi / num_cells)
                planes[place + cell + 1] = total
        peaks[m] = peak


@kernel
def find_node_ranges(inverse_distances, step, ranges):
    """Write the smallest and the largest inverse distance in the four cells about each node.

    Args:
        inverse_distances: float32 [H, W], 1/m, 0 for the sky.
        step: pixels between nodes.
        ranges: output float32 [rows, columns, 2]: largest and smallest.
    """
    height, width = inverse_distances.shape
    num_rows, num_columns, _ = ranges.shape
    for row in prange(num_rows):
        largest = np.zeros(num_columns, np.float32)  # of the cell after each node
        smallest = np.full(num_columns, np.inf, np.float32)
        for y in range(max((row - 1) * step, 0), min((row + 1) * step, height)):
            for cell in range(num_columns - 1):
                high = largest[cell]
                low = smallest[cell]
                for x in range(cell * step, min((cell + 1) * step, width)):
                    value = inverse_distances[y, x]
                    high = max(high, value)
                    low = min(low, value)
                largest[cell] = high
                smallest[cell] = low
        for column in range(num_columns):
            before = max(column - 1, 0)
            ranges[row, column, 0] = max(largest[before], largest[column])
            ranges[row, column, 1] = min(smallest[before], smallest[column])


@kernel
def light_slices(grid, lamps, scatter, planes, shares, slices, ranges, volume):
    """Write the light of all lamps along the rays through coarse nodes, up to slices of distance.

    Far from a lamp its light changes slowly, so that few nodes show it. About the lamp, where it
    goes as 1 / h, it is softened here; `light_nodes` adds the difference.

    Args:
        grid: lens of the image, and its grid of fine nodes.
        lamps: the lamps.
        scatter: as in `_light_sums`, like planes and shares.
        slices: float64 [K], inverse distances, falling, 1/m; the last is 0.
        ranges: float32 [rows, columns, 2] of `find_node_ranges`.
        volume: output float32 [coarse rows, coarse columns, K, 3], luminance in linear sRGB; 0 in
            slices that no fine node looks up.
    """
    num_rows, num_columns, num_slices, _ = volume.shape
    num_steps = grid.steps[1]
    step = num_steps * grid.steps[0]
    softness = SOFT_STEPS * step / grid.lens[4]
    for row in prange(num_rows):
        v = (row * step - grid.lens[3]) / grid.lens[1]
        for column in range(num_columns):
            largest = np.float32(0.0)
            smallest = np.float32(np.inf)
            top = max((row - 1) * num_steps, 0)
            left = max((column - 1) * num_steps, 0)
            for i in range(top, min((row + 1) * num_steps + 1, ranges.shape[0])):
                for j in range(left, min((column + 1) * num_steps + 1, ranges.shape[1])):
                    largest = max(largest, ranges[i, j, 0])
                    smallest = min(smallest, ranges[i, j, 1])
            first = 0
            while first < num_slices - 2 and slices[first + 1] >= largest:
                first += 1
            last = first + 1
            while last < num_slices - 1 and slices[last] > smallest:
                last += 1
            volume[row, column] = 0.0
            u = (column * step - grid.lens[2]) / grid.lens[0]
            z = 1 / math.sqrt(1 + u * u + v * v)
            for index in range(len(lamps.distances_m)):
                _add_slices(
                    lamps, index, scatter, planes, shares, u * z, v * z, z, softness, slices, first,
                    last, volume[row, column],
                )  # fmt: skip


@kernel_function()
def _slice_place(slices, inverse):
    """Return the slice beyond a distance, the share of the one before it, and a factor of both.

    Args:
        slices: float64 [K], inverse distances, falling, 1/m.
        inverse: inverse of the distance, 1/m.
    """
    if inverse >= slices[0]:
        return 1, 1.0, slices[0] / inverse
    k = 1
    while slices[k] > inverse:
        k += 1
    return k, (inverse - slices[k]) / (slices[k - 1] - slices[k]), 1.0


@kernel
def light_nodes(grid, lamps, scatter, planes, shares, slices, volume, windows, ranges, nodes):
    """Add the light of all lamps along the rays through the nodes, to two distances each.

    It is that of the coarse nodes, and about each lamp what softened coarse nodes lack. Near a lamp
    it goes as 1 / h, which no grid can show. So h is softened here as well, and `add_cores` adds
    the difference.

    Args:
        grid: lens of the image, and its grid of nodes.
        lamps: the lamps.
        scatter: as in `_light_sums`, like planes and shares.
        slices: as in `light_slices`, like volume.
        windows: int64 [M, 4], first row of nodes, last row + 1, first column, last column + 1, in
            which the softening of coarse nodes about each lamp is seen.
        ranges: float32 [rows, columns, 2] of `find_node_ranges`.
        nodes: float32 [rows, columns, 6], changed in place: colour to the nearer and to the further
            distance.
    """
    num_rows, num_columns, _ = nodes.shape
    step = grid.steps[0]
    num_steps = grid.steps[1]
    per_step = 1 / num_steps
    softness = SOFT_STEPS * step / grid.lens[4]
    coarse_softness = num_steps * softness
    last_row = volume.shape[0] - 1
    last_column = volume.shape[1] - 1
    for row in prange(num_rows):
        i = row // num_steps
        v_share = (row - i * num_steps) * per_step
        below = min(i + 1, last_row)
        light_before = np.zeros(3, np.float32)
        for column in range(num_columns):
            j = column // num_steps
            u_share = (column - j * num_steps) * per_step
            beside = min(j + 1, last_column)
            weight_a = np.float32((1 - v_share) * (1 - u_share))
            weight_b = np.float32((1 - v_share) * u_share)
            weight_c = np.float32(v_share * (1 - u_share))
            weight_d = np.float32(v_share * u_share)
            is_one = ranges[row, column, 0] == ranges[row, column, 1]
            for side in range(2):
                if side == 1 and is_one:
                    for channel in range(3):
                        nodes[row, column, 3 + channel] += light_before[channel]
                    continue
                k, share, factor = _slice_place(slices, ranges[row, column, side])
                before = np.float32(share * factor)
                beyond = np.float32((1 - share) * factor)
                for channel in range(3):
                    light = weight_a * (
                        before * volume[i, j, k - 1, channel] + beyond * volume[i, j, k, channel]
                    )
                    light += weight_b * (
                        before * volume[i, beside, k - 1, channel]
                        + beyond * volume[i, beside, k, channel]
                    )
                    light += weight_c * (
                        before * volume[below, j, k - 1, channel]
                        + beyond * volume[below, j, k, channel]
                    )
                    light += weight_d * (
                        before * volume[below, beside, k - 1, channel]
                        + beyond * volume[below, beside, k, channel]
                    )
                    nodes[row, column, 3 * side + channel] += light
                    light_before[channel] = light
        v = (row * step - grid.lens[3]) / grid.lens[1]
        for index in range(len(lamps.distances_m)):
            if row < windows[index, 0] or row >= windows[index, 1]:
                continue
            frame = lamps.frames[index]
            distance = lamps.distances_m[index]
            soft_square = (softness * distance) ** 2
            coarse_square = (coarse_softness * distance) ** 2
            end_square = COARSE_END * coarse_square
            for column in range(windows[index, 2], windows[index, 3]):
                u = (column * step - grid.lens[2]) / grid.lens[0]
                z = 1 / math.sqrt(1 + u * u + v * v)
                side = (u * frame[1, 0] + v * frame[1, 1] + frame[1, 2]) * z
                rise = (u * frame[2, 0] + v * frame[2, 1] + frame[2, 2]) * z
                square = (side * side + rise * rise) * distance * distance
                if square >= end_square:
                    continue
                near, far, is_ahead = _ray_light(
                    lamps, index, scatter, planes, shares, u * z, v * z, z,
                    ranges[row, column, 0], ranges[row, column, 1],
                )  # fmt: skip
                window = min((1 - square / end_square) * (1 / 0.75), 1.0)
                gain = 1 / math.sqrt(square + soft_square) - 1 / math.sqrt(square + coarse_square)
                gain *= is_ahead * window * window * (3 - 2 * window)
                node = nodes[row, column]
                for channel in range(3):
                    node[channel] += np.float32(near * gain * lamps.colors[index, channel])
                    node[3 + channel] += np.float32(far * gain * lamps.colors[index, channel])


@kernel
def spread_nodes(grid, inverse_distances, ranges, nodes, light):
    """Add each pixel's light from its four nodes, at the pixel's own distance.

    A node's two distances span those of all pixels that read it. Distances and light are
    interpolated between the nodes; the pixel's own distance lies between the two. So light does not
    cross a silhouette.

    Args:
        grid: lens of the image, and its grid of nodes.
        inverse_distances: float32 [H, W], 1/m.
        ranges: as in `light_nodes`, like nodes.
        light: float32 [H, W, 3], changed in place.
    """
    height, width, _ = light.shape
    step = grid.steps[0]
    num_columns = nodes.shape[1]
    one_f32 = np.float32(1)
    zero = np.float32(0)
    for y in prange(height):
        row_place = np.float32((y + 0.5) / step)
        row = int(row_place)
        below = row_place - np.float32(row)
        above = one_f32 - below
        # The two distances, and the light to each, between the rows of nodes.
        columns = np.empty((num_columns, 8), np.float32)
        for j in range(num_columns):
            for k in range(2):
                columns[j, k] = above * ranges[row, j, k] + below * ranges[row + 1, j, k]
            for k in range(6):
                columns[j, 2 + k] = above * nodes[row, j, k] + below * nodes[row + 1, j, k]
        for j in range(num_columns - 1):
            brightest = zero
            for k in range(2, 8):
                brightest = max(brightest, max(columns[j, k], columns[j + 1, k]))
            if brightest <= zero:
                continue
            for x in range(j * step, min((j + 1) * step, width)):
                u = np.float32((x + 0.5) / step) - np.float32(j)
                largest = columns[j, 0] + u * (columns[j + 1, 0] - columns[j, 0])
                smallest = columns[j, 1] + u * (columns[j + 1, 1] - columns[j, 1])
                share = (inverse_distances[y, x] - smallest) / max(largest - smallest, TINY)
                share = min(max(share, zero), one_f32)
                for k in range(3):
                    near = columns[j, 2 + k] + u * (columns[j + 1, 2 + k] - columns[j, 2 + k])
                    far = columns[j, 5 + k] + u * (columns[j + 1, 5 + k] - columns[j, 5 + k])
                    light[y, x, k] += far + share * (near - far)


@kernel
def add_cores(grid, lamps, scatter, planes, shares, windows, ranges, inverse_distances, light):
    """Add to the pixels about each lamp what softened nodes lack of 1 / r.

    Luminance times h is smooth there. It is computed at the nodes, and 1 / h at the pixels.

    Args:
        grid: lens of the image, and its grid of nodes.
        lamps: the lamps.
        scatter: as in `_light_sums`, like planes and shares.
        windows: int64 [M, 4], first row of nodes, last row + 1, first column, last column + 1, in
            which each lamp's core is.
        ranges: float32 [rows, columns, 2] of `find_node_ranges`.
        inverse_distances: float32 [H, W], 1/m.
        light: float32 [H, W, 3], changed in place.
    """
    height, width, _ = light.shape
    step = grid.steps[0]
    softness = SOFT_STEPS * step / grid.lens[4]
    pixel = SOFT_PX / grid.lens[4]
    num_bands = ranges.shape[0] - 1
    for band in prange(num_bands):  # a band lies between two rows of nodes
        values = np.empty((2, ranges.shape[1], 2), np.float64)
        for index in range(len(lamps.distances_m)):
            if band < windows[index, 0] or band + 1 >= windows[index, 1]:
                continue
            first_column = windows[index, 2]
            num_columns = windows[index, 3] - first_column
            distance = lamps.distances_m[index]
            pixel_square = (pixel * distance) ** 2
            soft_square = (softness * distance) ** 2
            end_square = CORE_END * soft_square
            frame = lamps.frames[index]
            for i in range(2):
                v = ((band + i) * step - grid.lens[3]) / grid.lens[1]
                for j in range(num_columns):
                    column = first_column + j
                    u = (column * step - grid.lens[2]) / grid.lens[0]
                    z = 1 / math.sqrt(1 + u * u + v * v)
                    near, far, _ = _ray_light(
                        lamps, index, scatter, planes, shares, u * z, v * z, z,
                        ranges[band + i, column, 0], ranges[band + i, column, 1],
                    )  # fmt: skip
                    values[i, j, 0] = near
                    values[i, j, 1] = far
            for y in range(band * step, min((band + 1) * step, height)):
                v = (y + 0.5 - grid.lens[3]) / grid.lens[1]
                row_share = (y + 0.5) / step - band
                for x in range(first_column * step, min((windows[index, 3] - 1) * step, width)):
                    u = (x + 0.5 - grid.lens[2]) / grid.lens[0]
                    z = 1 / math.sqrt(1 + u * u + v * v)
                    side = (u * frame[1, 0] + v * frame[1, 1] + frame[1, 2]) * z
                    rise = (u * frame[2, 0] + v * frame[2, 1] + frame[2, 2]) * z
                    square = (side * side + rise * rise) * distance * distance
                    if square >= end_square:
                        continue
                    column_place = (x + 0.5) / step
                    column = int(column_place)
                    column_share = column_place - column
                    value = 0.0
                    for corner in range(4):
                        i = corner >> 1
                        j = column + (corner & 1)
                        weight = row_share if i else 1 - row_share
                        weight *= column_share if corner & 1 else 1 - column_share
                        largest = ranges[band + i, j, 0]
                        smallest = ranges[band + i, j, 1]
                        share = 0.0
                        if largest > smallest:
                            share = (inverse_distances[y, x] - smallest) / (largest - smallest)
                            share = min(max(share, 0.0), 1.0)
                        k = j - first_column
                        value += weight * (values[i, k, 0] * share + values[i, k, 1] * (1 - share))
                    window = min((1 - square / end_square) * (1 / 0.75), 1.0)
                    gain = 1 / math.sqrt(square + pixel_square)
                    gain -= 1 / math.sqrt(square + soft_square)
                    value *= gain * window * window * (3 - 2 * window)
                    light[y, x, 0] += np.float32(value * lamps.colors[index, 0])
                    light[y, x, 1] += np.float32(value * lamps.colors[index, 1])
                    light[y, x, 2] += np.float32(value * lamps.colors[index, 2])
