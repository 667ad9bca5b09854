"""Kernel functions: the pixels of one tile of water, with their places, normals and roughness.

`wet_glint_kernels` calls them. An array has a row for each number of a pixel, and in it the tile's
pixels row by row.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from augment.lamps.road_unevenness_kernels import tilt_tile
from augment.lamps.vector_kernels import copies, dot, largest_of, vector_copies
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel_function
from augment.render.layout import NUM_LANES, Index

TILE_PX = 16  # pixels along a side of a tile
TILE_SIZE = TILE_PX * TILE_PX  # pixels of a tile
NUM_GROUPS = TILE_SIZE // NUM_LANES  # groups of eight pixels in a tile
# Numbers of a pixel: place; normal; eye x normal; distance of the eye; its height along the
# normal; square of its distance from the normal, and the inverse; m^2; share of water.
NUM_PIXEL_NUMBERS = 15
ROUGHNESS2 = 13  # row of m^2
SHARE = 14  # row of the share of water


class WaterArrays(NamedTuple):
    """Water as the kernel takes it; what it does not have is empty."""

    share: Any
    """Share of each pixel that shows water, or the road that may be wet, float32 [H, W]."""
    depth: Any
    """z of the water, metres, float32 [H, W]."""
    roughness: Any
    """Beckmann's m, float32 [H, W]; empty if `film` has it."""
    tilts: Any
    """x and y of the waves' normals less those of the water's plane, float32 [H, W, 2]."""
    film: Any
    """Film on a road, in fewer pixels: m, share of the road that it covers, share of the slopes'
    variance that waves have, float32 [h, w, 3]."""
    octaves: Any
    """Waves of a road, as `tilt_tile` takes them."""
    keys: Any
    """Keys of these waves, uint64."""


class WaterView(NamedTuple):
    """View of the water, float64."""

    lens: Any
    """1 / fx, 1 / fy, cx, cy."""
    axes: Any
    """Rotation from the camera to the water's frame, [3, 3]."""
    frame: Any
    """Rotation from the world to the water's frame, [3, 3]."""
    eye: Any
    """Place of the eye, world."""


@kernel_function()
def _fill_film(top, left, bottom, right, film, height, width, shares, rough2, resolved):
    """Write m^2 and the share of waves of a tile's pixels, and multiply their share by the film's.

    The film is interpolated as cv2.resize does: the middles of its outer pixels lie half a pixel
    of the film inside the picture.
    """
    rows, columns = film.shape[:2]
    zero = np.float32(0)
    half = np.float32(0.5)
    per_row = np.float32(rows / height)
    per_column = np.float32(columns / width)
    cells = np.zeros(TILE_PX, np.int64)
    weights = np.zeros(TILE_PX, np.float32)
    for j in range(left, right):
        u = min(max((np.float32(j) + half) * per_column - half, zero), np.float32(columns - 1))
        cells[j - left] = min(int(u), max(columns - 2, 0))
        weights[j - left] = u - np.float32(cells[j - left])
    first = cells[0]
    last = min(cells[right - 1 - left] + 1, columns - 1)
    blend = np.empty((TILE_PX + 2, 3), np.float32)
    for i in range(top, bottom):
        v = min(max((np.float32(i) + half) * per_row - half, zero), np.float32(rows - 1))
        a = min(int(v), max(rows - 2, 0))
        v -= np.float32(a)
        above = film[a]
        below = film[min(a + 1, rows - 1)]
        for b in range(first, last + 1):
            for c in range(3):
                blend[b - first, c] = above[b, c] + (below[b, c] - above[b, c]) * v
        for j in range(right - left):
            k = (i - top) * TILE_PX + j
            u = weights[j]
            b = cells[j] - first
            beside = min(b + 1, last - first)
            m = blend[b, 0] + (blend[beside, 0] - blend[b, 0]) * u
            rough2[k] = m * m
            shares[k] *= blend[b, 1] + (blend[beside, 1] - blend[b, 1]) * u
            resolved[k] = blend[b, 2] + (blend[beside, 2] - blend[b, 2]) * u


@kernel_function()
def fill_tile(top, left, bottom, right, water, view, pixels, wet):
    """Write the numbers of a tile's pixels.

    Args:
        top: first row of the tile.
        left: its first column.
        bottom: row after its last one.
        right: column after its last one.
        water: the water.
        view: the view of it.
        pixels: output, float32 [NUM_PIXEL_NUMBERS, TILE_SIZE].
        wet: output, pixels of the tile that show water, int64 [TILE_SIZE].

    Returns:
        Number of wet pixels; largest and least m; largest tilt.
    """
    shares = pixels[SHARE]
    rough2 = pixels[ROUGHNESS2]
    depths = pixels[0]  # the places come later
    shares[:] = np.float32(0)
    depths[:] = np.float32(0)
    has_film = water.film.size > 0
    has_waves = water.tilts.size > 0
    count = 0
    for i in range(top, bottom):
        row_shares = water.share[i]
        row_depths = water.depth[i]
        for j in range(left, right):
            z = row_depths[j]
            if row_shares[j] > 0 and z > 0 and z < np.float32(1e6):
                k = (i - top) * TILE_PX + j - left
                shares[k] = row_shares[j]
                depths[k] = z
                wet[count] = k
                count += 1
    if count == 0:
        return count, 0.0, 0.0, 0.0
    tilts = np.zeros(2 * TILE_SIZE, np.float32)
    resolved = np.zeros(TILE_SIZE, np.float32)
    rough2[:] = np.float32(1)
    if has_film:
        height, width = water.share.shape
        _fill_film(top, left, bottom, right, water.film, height, width, shares, rough2, resolved)
    else:
        for w in range(count):
            k = wet[w]
            i = top + k // TILE_PX
            j = left + k % TILE_PX
            rough2[k] = water.roughness[i, j] * water.roughness[i, j]
            if has_waves:
                tilts[k] = water.tilts[i, j, 0]
                tilts[k + TILE_SIZE] = water.tilts[i, j, 1]
    _fill_places(top, left, view, pixels)
    if has_film:
        tilt_tile(pixels, resolved, view, water.octaves, water.keys, tilts)
    largest_tilt2 = _fill_normals(pixels, tilts, view.frame)
    largest_m2 = np.float32(0)
    least_m2 = np.float32(1e18)
    for w in range(count):
        largest_m2 = max(largest_m2, rough2[wet[w]])
        least_m2 = min(least_m2, rough2[wet[w]])
    largest_m = math.sqrt(np.float64(largest_m2))
    least_m = math.sqrt(np.float64(least_m2))
    return count, largest_m, least_m, math.sqrt(largest_tilt2)


@kernel_function()
def _fill_places(top, left, view, pixels):
    """Write the places of a tile's pixels, from the eye in the water's frame, over their z."""
    lens = view.lens
    axes = view.axes
    size = Index(TILE_SIZE)
    ax = copies(axes[0, 0])
    ay = copies(axes[1, 0])
    az = copies(axes[2, 0])
    per_focal = copies(lens[0])
    for group in range(NUM_GROUPS):
        first = Index(group * NUM_LANES)
        row = group * NUM_LANES // TILE_PX
        column = group * NUM_LANES % TILE_PX
        y = (top + row + 0.5 - lens[3]) * lens[1]
        x = v8.fmuladd(
            v8.lane_numbers(), per_focal, copies((left + column + 0.5 - lens[2]) * lens[0])
        )
        z = v8.load(pixels, first)
        v8.store(pixels, first, z * v8.fmuladd(ax, x, copies(axes[0, 1] * y + axes[0, 2])))
        v8.store(pixels, first + size, z * v8.fmuladd(ay, x, copies(axes[1, 1] * y + axes[1, 2])))
        z = z * v8.fmuladd(az, x, copies(axes[2, 1] * y + axes[2, 2]))
        v8.store(pixels, first + size + size, z)


@kernel_function()
def _fill_normals(pixels, tilts, frame):
    """Write the normals of a tile's pixels and what follows from them; return the largest tilt^2.

    Args:
        pixels: numbers of the pixels, with their places.
        tilts: x of the normals less those of the plane, world, then y, float32 [2 TILE_SIZE].
        frame: rotation from the world to the water's frame.
    """
    size = Index(TILE_SIZE)
    unit = copies(1)
    largest = copies(0)
    for group in range(NUM_GROUPS):
        first = Index(group * NUM_LANES)
        px = v8.load(pixels, first)
        py = v8.load(pixels, first + size)
        pz = v8.load(pixels, first + size + size)
        a = v8.load(tilts, first)
        b = v8.load(tilts, first + size)
        largest = v8.maximum(largest, v8.fmuladd(a, a, b * b))
        a = a + copies(frame[2, 0])
        b = b + copies(frame[2, 1])
        c = v8.sqrt(v8.maximum(unit - v8.fmuladd(a, a, b * b), copies(0.01)))
        nx = dot(vector_copies(frame[0, 0], frame[0, 1], frame[0, 2]), (a, b, c))
        ny = dot(vector_copies(frame[1, 0], frame[1, 1], frame[1, 2]), (a, b, c))
        nz = dot(vector_copies(frame[2, 0], frame[2, 1], frame[2, 2]), (a, b, c))
        cx = pz * ny - py * nz
        cy = px * nz - pz * nx
        cz = py * nx - px * ny
        squared = dot((px, py, pz), (px, py, pz))
        r2 = v8.maximum(dot((cx, cy, cz), (cx, cy, cz)), copies(1e-9) * squared)
        v8.store(pixels, first + Index(3) * size, nx)
        v8.store(pixels, first + Index(4) * size, ny)
        v8.store(pixels, first + Index(5) * size, nz)
        v8.store(pixels, first + Index(6) * size, cx)
        v8.store(pixels, first + Index(7) * size, cy)
        v8.store(pixels, first + Index(8) * size, cz)
        v8.store(pixels, first + Index(9) * size, v8.sqrt(squared))
        v8.store(pixels, first + Index(10) * size, v8.negate(dot((px, py, pz), (nx, ny, nz))))
        v8.store(pixels, first + Index(11) * size, r2)
        v8.store(pixels, first + Index(12) * size, unit / v8.maximum(r2, copies(1e-20)))
    return np.float64(largest_of(largest))
