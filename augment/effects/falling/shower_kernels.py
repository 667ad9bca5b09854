"""Numba kernel: a picture behind drops and the veil of a shower, whose rate differs by place.

The veil is that of `drop_kernels.blend_falling` at the eye's rate, plus what the rays' rates differ
from it. `augment.effects.falling.shower` has the equations and the tables.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.effects.falling.drop_kernels import (
    EDGE,
    ROWS,
    blend_colour,
    classes_in_row,
    cover_band,
    decay,
    light_of_row,
    nearest_in_row,
    surface_parts,
    veil_depth,
)
from augment.effects.falling.drops import NUM_CLASSES
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.layout import NUM_LANES, Index

# Height above the eye from which rain and snow fall, metres.
LAYER_M = 1000.0
# Distance between two rows of the table, metres.
STEP_M = 5.0
# Height of the cloud's top above the eye, metres. Assumed.
CLOUD_TOP_M = 4000.0
# Extinction of light by the cloud, 1/m: below a real one, so that its edge is soft. Assumed.
CLOUD_EXTINCTION_PER_M = 2e-3
# Distance between two cells of the tile of lumps, metres.
LUMP_STEP_M = 60.0
# Change of a cloud's light by a lump. Assumed.
LUMP_LIGHT = 0.25
# Change of a cloud's depth by a lump. Assumed.
LUMP_DEPTH = 0.7
# Climb of a ray over its length below which lumps fade: they are smaller than a pixel there.
LUMP_CLIMB = 0.12
# Distance along the way below which a ray has the rate of its eye, metres.
MIN_ALONG_M = 0.5
# Numbers of a ray to the sky, see _integrate_sky.
NUM_SKY_NUMBERS = 4

_MIN_CLIMB = np.float32(1e-6)  # smallest climb of a ray to the sky over its way ahead
_MIN_ALONG = np.float32(MIN_ALONG_M)
_PER_STEP = np.float32(1 / STEP_M)
_LAYER = np.float32(LAYER_M)
_TOP = np.float32(CLOUD_TOP_M)
_CLOUD_DEPTH = np.float32(CLOUD_EXTINCTION_PER_M * (CLOUD_TOP_M - LAYER_M))  # straight up
_MIN_INTEGRAL = np.float32(1e-9)  # smallest G that the light of the veil is divided by
_LAYER_CELLS = np.float32(LAYER_M / LUMP_STEP_M)  # height of the cloud's base in cells of lumps
_PER_LUMP_CLIMB = np.float32(1 / LUMP_CLIMB)
_LUMP_DEPTH = np.float32(LUMP_DEPTH)
_LUMP_LIGHT = np.float32(LUMP_LIGHT)


@kernel_function()
def _integral(rows, distance, column):
    """Return a column of ShowerTable's rows at a distance from the eye along the way."""
    x = distance * _PER_STEP + np.float32(len(rows) // 2)
    last = np.float32(len(rows) - 2)
    low = np.int64(min(max(x, np.float32(0)), last))
    share = x - np.float32(low)
    first = rows[low, column]
    return first + share * (rows[low + 1, column] - first)


@kernel_function()
def _lump(lumps, x, y):
    """Return a periodic tile's value between its cells."""
    size = np.int64(len(lumps))
    column = np.floor(x)
    row = np.floor(y)
    i = np.int64(column) % size
    j = np.int64(row) % size
    right = (i + 1) % size
    below = (j + 1) % size
    x -= column
    y -= row
    # Smooth weights, since the cells of a linear mean would show.
    x = x * x * (np.float32(3) - np.float32(2) * x)
    y = y * y * (np.float32(3) - np.float32(2) * y)
    upper = lumps[j, i] + x * (lumps[j, right] - lumps[j, i])
    lower = lumps[below, i] + x * (lumps[below, right] - lumps[below, i])
    return upper + y * (lower - upper)


@kernel_function()
def _integrate_surfaces(row, width, depth, rays, table, axes, at_eye, excess, light):
    """Write what the shower differs by up to the surfaces of an image row.

    Args:
        excess: output [width], optical depth that the rate at the eye leaves out, over the length
            of the ray at unit depth.
        light: output [width], light of the veil.
    """
    zero = np.float32(0)
    unit = np.float32(1)
    v = (np.float32(row) + np.float32(0.5) - rays[3]) * rays[1]
    start = axes[0, 1] * v + axes[0, 2] + (np.float32(0.5) - rays[2]) * rays[0] * axes[0, 0]
    step = rays[0] * axes[0, 0]
    middle = np.float32(len(table) // 2)
    last = np.float32(len(table) - 2)
    extinction = at_eye[0]
    first = Index(row * width)
    for j in range(Index(width)):
        z = depth[first + j]
        distance = z * (start + np.float32(j) * step)
        x = distance * _PER_STEP + middle
        low = np.int32(min(max(x, zero), last))
        share = x - np.float32(low)
        integral = table[low, 0] + share * (table[low + 1, 0] - table[low, 0])
        lit = table[low, 1] + share * (table[low + 1, 1] - table[low, 1])
        is_long = abs(distance) > _MIN_ALONG
        mean = integral / distance if is_long else extinction
        excess[j] = z * (mean - extinction)
        light[j] = lit / integral if is_long and abs(integral) > _MIN_INTEGRAL else unit


@kernel_function()
def _shows_sky(row, width, alpha, depth):
    """Return True if any pixel of an image row shows some sky."""
    first = Index(row * width)
    for j in range(Index(width)):
        if not (alpha[first + j] >= np.float32(1) and depth[first + j] > np.float32(0)):
            return True
    return False


@kernel_function()
def _integrate_sky(column, row, rays, climb, table, axes, at_eye, lumps, eye, numbers):
    """Write what lies before the sky on the ray through a place of the image.

    Args:
        column: column of the place, pixels.
        row: row of the place, pixels.
        numbers: output [NUM_SKY_NUMBERS]: optical depth of the rain, and of the cloud, over the
            length of the ray at unit depth; light of the veil, and of the cloud.
    """
    unit = np.float32(1)
    u = (column - rays[2]) * rays[0]
    v = (row - rays[3]) * rays[1]
    slope = max(climb[0] * u + climb[1] * v + climb[2], _MIN_CLIMB)
    per_climb = unit / slope
    along = axes[0, 0] * u + axes[0, 1] * v + axes[0, 2]
    base = _LAYER * along * per_climb
    top = _TOP * along * per_climb
    mean = at_eye[0]
    light = unit
    if abs(base) > _MIN_ALONG:
        integral = _integral(table, base, 0)
        mean = integral / base
        if abs(integral) > _MIN_INTEGRAL:
            light = _integral(table, base, 1) / integral
    cover = at_eye[1]
    if abs(top - base) > _MIN_ALONG:
        cover = (_integral(table, top, 2) - _integral(table, base, 2)) / (top - base)
    cloud_light = unit
    lump_weight = slope * _PER_LUMP_CLIMB - np.float32(0.5)
    if cover > 0 and lump_weight > 0:
        across = axes[1, 0] * u + axes[1, 1] * v + axes[1, 2]
        reach = _LAYER_CELLS * per_climb
        lump = _lump(lumps, eye[0] + reach * along, eye[1] + reach * across)
        lump *= min(lump_weight, unit)
        cover *= unit + _LUMP_DEPTH * lump
        cloud_light += _LUMP_LIGHT * lump
    numbers[0] = _LAYER * per_climb * mean
    numbers[1] = _CLOUD_DEPTH * per_climb * cover
    numbers[2] = light
    numbers[3] = cloud_light


@kernel_function()
def _integrate_sky_row(row, width, rays, climb, table, axes, at_eye, lumps, eye, nodes):
    """Write what lies before the sky at the ends of each eight pixels of an image row.

    The numbers change slowly with the direction, so they are straight lines in between.

    Args:
        nodes: output [blocks + 2, NUM_SKY_NUMBERS] at every eighth column, then at both
            ends of the last eight pixels.
    """
    count = -(-width // NUM_LANES)
    v = np.float32(row) + np.float32(0.5)
    for block in range(count + 2):
        column = np.float32(min(block, count - 1) * NUM_LANES)
        if block >= count:
            column = np.float32(width - NUM_LANES * (count + 1 - block))
        # Lane 0 is in the middle of its pixel.
        column += np.float32(0.5)
        _integrate_sky(column, v, rays, climb, table, axes, at_eye, lumps, eye, nodes[block])


@kernel_function()
def _veil(color, splats, is_mixed, edge, light, opacity, surface, sky):
    """Return the square of a colour behind the veil, as drop_kernels does.

    Args:
        light: airlight and light of a cloud, in places 0 and 4.
        surface: transmittance up to the surfaces, and the light of the veil before them.
        sky: transmittance up to the sky, and the shares of airlight and cloud in its light.
    """
    zeros = v8.broadcast(np.float32(0))
    air = v8.broadcast(light[0])
    surface_air = air * surface[1]
    sky_air = air * sky[1] + v8.broadcast(light[4]) * sky[2]
    squares = color * color
    before_surface = surface_air + surface[0] * (squares - surface_air)
    before_sky = sky_air + sky[0] * squares
    veiled = before_sky + opacity * (before_surface - before_sky)
    if is_mixed:
        sky_share = v8.broadcast(np.float32(1)) - opacity
        sky_part = v8.minimum(v8.maximum(color - splats, zeros), sky_share)
        surface_part = (color - sky_part) / v8.maximum(opacity, v8.broadcast(np.float32(EDGE)))
        sky_part = sky_part / v8.maximum(sky_share, v8.broadcast(np.float32(EDGE)))
        surface_part = surface_air + surface[0] * (surface_part * surface_part - surface_air)
        sky_part = sky_air + sky[0] * sky_part * sky_part
        mixed = opacity * v8.sqrt(v8.maximum(surface_part, zeros))
        mixed = mixed + sky_share * v8.sqrt(v8.maximum(sky_part, zeros))
        veiled = v8.select(edge, mixed * mixed, veiled)
    return veiled


@kernel_function()
def _blend_pixels(pixels, at, splats, pixel, u, lengths, opacity, clear, surface, sky, light):
    """Blend eight pixels with the veil and the drops, in place.

    surface, sky: as in _veil. light [3, 5]: as light_of_row writes it, and light of a cloud.
    """
    ones = v8.broadcast(np.float32(1))
    zeros = v8.broadcast(np.float32(0))
    per_length = ones / lengths
    red, green, blue = v8.load_colours(pixels, at)
    (r, g, b), edge, is_mixed = surface_parts(splats, pixel, opacity, red, green, blue)
    red = _veil(v8.maximum(red, zeros), r, is_mixed, edge, light[0], opacity, surface, sky)
    green = _veil(v8.maximum(green, zeros), g, is_mixed, edge, light[1], opacity, surface, sky)
    blue = _veil(v8.maximum(blue, zeros), b, is_mixed, edge, light[2], opacity, surface, sky)
    red = blend_colour(red, light[0], u, clear, per_length)
    green = blend_colour(green, light[1], u, clear, per_length)
    blue = blend_colour(blue, light[2], u, clear, per_length)
    v8.store_colours(pixels, at, red, green, blue)


@kernel_function()
def _between(begin, end):
    """Return eight numbers on a straight line, of which the first is `begin`, the ninth `end`."""
    step = (end - begin) * np.float32(1 / NUM_LANES)
    return v8.broadcast(begin) + v8.lane_numbers() * v8.broadcast(step)


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
    bands,
    light,
    partial,
    excess,
    veil_light,
    nodes,
    pixels,
):
    """Blend a row of blend_shower.

    Args:
        clear: from index `first` on.
        excess: as in _integrate_surfaces.
        veil_light: its `light`.
        nodes: as in _integrate_sky_row.
        partial: scratch.
        pixels: scratch.
    """
    zeros = v8.broadcast(np.float32(0))
    ones = v8.broadcast(np.float32(1))
    half = np.float32(0.5)
    count, slope, offset = classes_in_row(nearest, bands, partial)
    v = (np.float32(row) + half - rays[3]) * rays[1]
    flat = v8.broadcast(np.float32(1) + v * v)
    for j in range(0, width, NUM_LANES):
        # The last eight pixels of a row include earlier ones, which are not written.
        at = min(j, width - NUM_LANES)
        pixel = Index(row * width + at)
        u = v8.broadcast(np.float32(at) + half - rays[2]) + v8.lane_numbers()
        u = u * v8.broadcast(rays[0])
        lengths = v8.sqrt(flat + u * u)
        z = v8.load(depth, pixel)
        tau = veil_depth(z, count, slope, offset, partial)
        tau = tau + v8.load(excess, Index(at))
        surface = (decay(tau * lengths), v8.load(veil_light, Index(at)))
        block = Index(j // NUM_LANES)
        if at < j or j + NUM_LANES >= width:
            block = Index(-(-width // NUM_LANES))
        begin = nodes[block]
        end = nodes[block + 1]
        through_rain = decay(_between(begin[0], end[0]) * lengths)
        through_cloud = decay(_between(begin[1], end[1]) * lengths)
        sky = (
            through_rain * through_cloud,
            (ones - through_rain) * _between(begin[2], end[2]),
            through_rain * (ones - through_cloud) * _between(begin[3], end[3]),
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
                surface,
                sky,
                light,
            )
        else:
            for k in range(Index(3 * NUM_LANES)):
                pixels[k] = rgb[Index(3) * pixel + k]
            _blend_pixels(
                pixels,
                Index(0),
                splats,
                pixel,
                u,
                lengths,
                opacity,
                clear_share,
                surface,
                sky,
                light,
            )
            for k in range(Index(3 * (j - at)), Index(3 * NUM_LANES)):
                rgb[Index(3) * pixel + k] = pixels[k]


@kernel
def blend_shower(
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
    airlight,
    glow,
    table,
    axes,
    at_eye,
    cloud,
    lumps,
    eye,
    mask,
):
    """Blend a picture with the drops and the veil of a shower, in place.

    Args:
        rgb: as in drop_kernels.blend_falling, like all arguments that are not named here.
        splats: the same.
        alpha: the same.
        depth: the same.
        drops: the same, of the rate at the eye.
        listed: the same.
        begins: the same.
        min_clear_share: the same.
        rays: the same.
        climb: the same.
        bands: the same, of the rate at the eye.
        airlight: the same.
        glow: the same.
        table: rows of ShowerTable.
        axes: [2, 3] the direction in which the shower moves, and that across it to the left, along
            the camera's axes.
        at_eye: [2] extinction by all drops at the eye, 1/m, and cover of the sky by cloud.
        cloud: [3] light of a cloud from below.
        lumps: [N, N] lumps of the cloud's base, a tile that repeats.
        eye: [2] the eye's column and row in that tile.
        mask: output, the same.
    """
    height, width = mask.shape
    for band in prange(len(begins) - 1):
        top = np.int64(band) * ROWS
        bottom = min(top + ROWS, height)
        clear = np.empty(ROWS * width, np.float32)
        nearest = np.empty(ROWS, np.float32)
        light = np.empty((3, 5), np.float32)
        partial = np.empty((NUM_CLASSES, 5), np.float32)
        excess = np.empty(width, np.float32)
        veil_light = np.empty(width, np.float32)
        # Rows without sky leave the numbers of earlier rows: their weight is 0.
        nodes = np.zeros((-(-width // NUM_LANES) + 2, NUM_SKY_NUMBERS), np.float32)
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
            light[:, 4] = cloud
            _integrate_surfaces(row, width, depth, rays, table, axes, at_eye, excess, veil_light)
            if _shows_sky(row, width, alpha, depth):
                _integrate_sky_row(row, width, rays, climb, table, axes, at_eye, lumps, eye, nodes)
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
                bands,
                light,
                partial,
                excess,
                veil_light,
                nodes,
                pixels,
            )
