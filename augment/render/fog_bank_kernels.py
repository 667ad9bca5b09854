"""Numba kernels of fog banks: their mean density along rays, and the look-up of such means.

`fog_banks` has the definition of the density m. The mean along a ray is weighted by the extinction
of plain fog, so the optical depth of a ray is that of plain fog times the mean. Over the level
distance d of a ray that climbs by k scale heights a metre of it,

    mean(d) = int_0^d m(r) exp(-k r) dr / int_0^d exp(-k r) dr.

A table (`fog_table.BankTable`) holds log2 of the means of one eye over k, heading and d. It is flat
float32: a head of HEAD numbers, see H_ROTATION and the following, then [climbs, headings,
distances].
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu import simd as v8
from augment.render.cpu.hash_kernels import mix
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.cpu.simd import exp2_fine, log2
from augment.render.fog_banks import DEVIATION
from augment.render.layout import NUM_LANES, Index
from augment.rng import STEP_X, STEP_Y

_X = np.uint64(STEP_X)
_Y = np.uint64(STEP_Y)
_S32 = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
_UNIT = 2.0**-31
_PER_DEVIATION = 1 / DEVIATION
# Numbers of a cell: its position, and two of a gradient for each of its corners.
CELL = 2 + 4 * 2
# world_from_camera's rotation, nine numbers, row by row.
H_ROTATION = 0
# 1 / the level distance at which the nodes begin to grow apart, 1/m.
H_PER_M = 9
# Nodes per doubling of the distance.
H_DOUBLING = 10
# Number of headings per quarter.
H_QUARTER = 11
# Climb, in scale heights a metre, is this times the slope; 0 for uniform fog.
H_CLIMB = 12
# Nodes per doubling of the climb.
H_CLIMBS = 13
# Largest climb.
H_MAX_CLIMB = 14
# Numbers of climbs, headings and distances.
H_SHAPE = 15
# Numbers of the head.
HEAD = 18
# Largest depth that is looked up, metres: beyond every table.
FARTHEST_M = 1e7
# Step of a ray near the eye, in lattice steps of the last octave.
STEP = 0.5
# Growth of the steps with the distance.
STEP_GROWTH = 0.03

# ---- Density -------------------------------------------------------------------------------------


@kernel_function()
def bank_density_at(x, y, lattices, seeds, log_mean, cells):
    """Return m at a place (scene world, metres).

    cells: float64 [NUM_OCTAVES CELL], flat: for each octave the cell that was read last, and the
        gradients at its corners. Steps of a ray stay in a cell for a while.
    """
    exponent = -log_mean
    for octave in range(seeds.size):
        u = lattices[octave, 0] * x + lattices[octave, 1] * y + lattices[octave, 4]
        v = lattices[octave, 2] * x + lattices[octave, 3] * y + lattices[octave, 5]
        noise = _gradient_noise(u, v, seeds[octave], cells, octave * CELL)
        exponent += lattices[octave, 6] * noise
    return math.exp(exponent)


@kernel_function()
def empty_cells(num_octaves):
    """Return cells of which none has been read."""
    return np.full(num_octaves * CELL, np.nan)


@kernel_function()
def _gradient_noise(u, v, seed, cells, first):
    """Return gradient noise of variance 1 at lattice coordinates."""
    column = math.floor(u)
    row = math.floor(v)
    if cells[first] != column or cells[first + 1] != row:
        _read_cell(column, row, seed, cells, first)
    x = u - column
    y = v - row
    fade_x = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    fade_y = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    a = cells[first + 2] * x + cells[first + 3] * y
    b = cells[first + 4] * (x - 1.0) + cells[first + 5] * y
    c = cells[first + 6] * x + cells[first + 7] * (y - 1.0)
    d = cells[first + 8] * (x - 1.0) + cells[first + 9] * (y - 1.0)
    near = a + fade_x * (b - a)
    far = c + fade_x * (d - c)
    return (near + fade_y * (far - near)) * _PER_DEVIATION


@kernel_function()
def _read_cell(column, row, seed, cells, place):
    """Write a cell's position and the gradients at its four corners."""
    cells[place] = column
    cells[place + 1] = row
    first = np.uint64(np.int64(column)) * _X + np.uint64(np.int64(row)) * _Y
    place += 2
    for corner in range(4):
        bits = first
        if corner & 1:
            bits += _X
        if corner & 2:
            bits += _Y
        bits = mix(bits ^ seed)
        cells[place] = np.float64(np.int64(bits >> _S32)) * _UNIT - 1.0
        cells[place + 1] = np.float64(np.int64(bits & _LOW)) * _UNIT - 1.0
        place += 2


# ---- Means along single rays ---------------------------------------------------------------------
# Two points stand for each step: the weight's centroid, plus and minus its standard deviation. For
# equal weights that is Gauss' rule.


@kernel_function()
def weight_centroid(kd):
    """Return where the weight exp(-x) has its centroid, as a share of a step of length x."""
    if abs(kd) < 1e-3:
        return 0.5 - kd / 12.0
    if kd > 500.0:
        return 1.0 / kd
    if kd < -500.0:
        return 1.0 + 1.0 / kd
    return 1.0 / kd - 1.0 / math.expm1(kd)


@kernel_function()
def weight_variance(kd):
    """Return the variance of the weight exp(-x) over a step of length x, in its square."""
    x = abs(kd)
    if x < 0.1:
        return 1.0 / 12.0 - x * x / 240.0
    half = math.sinh(0.5 * min(x, 500.0))
    return 1.0 / (x * x) - 0.25 / (half * half)


@kernel_function()
def weight_share(k, start_m, end_m):
    """Return the share that a step from start_m to end_m has in the weight of a ray up to end_m."""
    if abs(k) * end_m < 1e-6:
        return (end_m - start_m) / end_m
    if k > 0.0:
        part = math.exp(-k * start_m) * math.expm1(-k * (end_m - start_m))
        return part / math.expm1(-k * end_m)
    return math.expm1(k * (end_m - start_m)) / math.expm1(k * end_m)


@kernel
def means_of_rays(places, headings, distances, climbs, finest_m, lattices, seeds, log_mean, out):
    """Write the mean along each of N rays up to its level distance.

    Args:
        places: x and y of the rays' starts [N, 2], scene world, metres.
        headings: level unit directions [N, 2].
        distances: level distances [N], metres.
        climbs: k of the rays [N], 1/m.
        finest_m: lattice step of the last octave, metres.
        lattices: rows of `FogBanks.lattices`.
        seeds: seeds of the octaves.
        log_mean: `FogBanks.log_mean`.
        out: float64 [N].
    """
    for ray in prange(distances.size):
        cells = empty_cells(seeds.size)
        x = places[ray, 0]
        y = places[ray, 1]
        k = climbs[ray]
        mean = bank_density_at(x, y, lattices, seeds, log_mean, cells)
        start_m = 0.0
        while start_m < distances[ray]:
            step = STEP * finest_m + STEP_GROWTH * start_m
            end_m = min(start_m + step, distances[ray])
            step = end_m - start_m
            centre = start_m + weight_centroid(k * step) * step
            spread = math.sqrt(weight_variance(k * step)) * step
            density = 0.0
            for side in range(-1, 2, 2):
                distance = centre + side * spread
                density += 0.5 * bank_density_at(
                    x + distance * headings[ray, 0],
                    y + distance * headings[ray, 1],
                    lattices,
                    seeds,
                    log_mean,
                    cells,
                )
            mean += (density - mean) * weight_share(k, start_m, end_m)
            start_m = end_m
        out[ray] = mean


# ---- Tables --------------------------------------------------------------------------------------


@kernel
def tabulate_means(
    place, headings, edges, nodes, parts, shares, lattices, seeds, log_mean, refinement, out
):
    """Write log2 of the means of one eye.

    Args:
        place: x and y of the eye, scene world, metres.
        headings: level unit directions [A, 2], once around.
        edges: level distances between which the rays' steps lie [S + 1], from 0, metres.
        nodes: int64 [S + 1]: the node of the table at each edge; negative where there is none.
        parts: float64 [climbs, S, 3]: weights of the densities at a step's start, middle and end.
        shares: float64 [climbs, S]: share of a step in the weight up to its end.
        lattices: rows of `FogBanks.lattices`.
        seeds: seeds of the octaves.
        log_mean: `FogBanks.log_mean`.
        refinement: number of headings of the table for each of A; cubics fill it.
        out: float32 [climbs, refinement A + 1, nodes].
    """
    num_headings = headings.shape[0]
    num_steps = edges.size - 1
    for a in prange(num_headings):
        cells = empty_cells(seeds.size)
        densities = np.empty(2 * num_steps + 1)
        for i in range(2 * num_steps + 1):
            distance = edges[i >> 1]
            if i & 1:
                distance = 0.5 * (distance + edges[(i >> 1) + 1])
            densities[i] = bank_density_at(
                place[0] + distance * headings[a, 0],
                place[1] + distance * headings[a, 1],
                lattices,
                seeds,
                log_mean,
                cells,
            )
        for climb in range(out.shape[0]):
            mean = densities[0]
            out[climb, a * refinement, 0] = math.log2(mean)
            for step in range(num_steps):
                density = parts[climb, step, 0] * densities[2 * step]
                density += parts[climb, step, 1] * densities[2 * step + 1]
                density += parts[climb, step, 2] * densities[2 * step + 2]
                mean += (density - mean) * shares[climb, step]
                if nodes[step + 1] >= 0:
                    out[climb, a * refinement, nodes[step + 1]] = math.log2(mean)
    # Cubics through four headings (Catmull and Rom) between those that were integrated.
    for a in prange(num_headings):
        before = ((a + num_headings - 1) % num_headings) * refinement
        first = a * refinement
        second = ((a + 1) % num_headings) * refinement
        after = ((a + 2) % num_headings) * refinement
        for climb in range(out.shape[0]):
            for i in range(1, refinement):
                t = i / refinement
                w0 = t * (t * (2.0 - t) - 1.0) * 0.5
                w1 = (t * t * (3.0 * t - 5.0) + 2.0) * 0.5
                w2 = t * (t * (4.0 - 3.0 * t) + 1.0) * 0.5
                w3 = t * t * (t - 1.0) * 0.5
                for node in range(out.shape[2]):
                    value = w0 * out[climb, before, node] + w1 * out[climb, first, node]
                    value += w2 * out[climb, second, node] + w3 * out[climb, after, node]
                    out[climb, first + i, node] = value
    for climb in range(out.shape[0]):
        for node in range(out.shape[2]):
            out[climb, num_headings * refinement, node] = out[climb, 0, node]


@kernel_function()
def write_log_means(table, x, y, z, rows, target):
    """Write log2 of the means along eight rays up to points.

    Args:
        table: the table.
        x: x of the points in the camera, metres.
        y: y of the points in the camera.
        z: z of the points in the camera.
        rows: flat float32; rows of eight numbers at 0, 1 and 2 are overwritten.
        target: position in `rows` where the eight results go.
    """
    zeros = v8.broadcast(np.float32(0))
    ones = v8.broadcast(np.float32(1))
    tiny = v8.broadcast(np.float32(1e-30))
    east = _turned(table, Index(H_ROTATION), x, y, z)
    north = _turned(table, Index(H_ROTATION + 3), x, y, z)
    level = v8.sqrt(v8.fmuladd(east, east, north * north))
    # Heading on a square that stands on its corner, 0 to 4 quarters.
    size = v8.maximum(east, v8.negate(east)) + v8.maximum(north, v8.negate(north))
    turn = north / v8.maximum(size, tiny)
    turn = v8.select(v8.at_least(east, zeros), turn, v8.broadcast(np.float32(2)) - turn) + ones
    v8.store(rows, Index(0), turn * v8.broadcast(table[H_QUARTER]))
    node = log2(v8.fmuladd(level, v8.broadcast(table[H_PER_M]), ones))
    v8.store(rows, Index(NUM_LANES), node * v8.broadcast(table[H_DOUBLING]))
    has_climb = table[H_CLIMB] > np.float32(0)
    if has_climb:
        up = _turned(table, Index(H_ROTATION + 6), x, y, z)
        limit = v8.broadcast(table[H_MAX_CLIMB])
        climb = v8.maximum(up, v8.negate(up)) * v8.broadcast(table[H_CLIMB])
        climb = v8.minimum(climb / v8.maximum(level, tiny), limit)
        climb = log2(climb + v8.sqrt(v8.fmuladd(climb, climb, ones)))
        climb = climb * v8.broadcast(table[H_CLIMBS])
        climb = v8.select(v8.at_least(up, zeros), climb, v8.negate(climb))
        v8.store(rows, Index(2 * NUM_LANES), climb)
    num_climbs = Index(table[H_SHAPE])
    num_headings = Index(table[H_SHAPE + 1])
    num_nodes = Index(table[H_SHAPE + 2])
    last_node = table[H_SHAPE + 2] - np.float32(1)
    for lane in range(Index(NUM_LANES)):
        turned = min(max(rows[lane], np.float32(0)), table[H_SHAPE + 1] - np.float32(1))
        heading = min(Index(np.int32(turned)), num_headings - Index(2))
        turned -= np.float32(heading)
        along = min(max(rows[Index(NUM_LANES) + lane], np.float32(0)), last_node)
        first = min(Index(np.int32(along)), num_nodes - Index(2))
        along -= np.float32(first)
        first += Index(HEAD) + heading * num_nodes
        if has_climb:
            middle = np.float32((num_climbs - Index(1)) // Index(2))
            risen = rows[Index(2 * NUM_LANES) + lane] + middle
            risen = min(max(risen, np.float32(0)), table[H_SHAPE] - np.float32(1))
            layer = min(Index(np.int32(risen)), num_climbs - Index(2))
            risen -= np.float32(layer)
            first += layer * num_headings * num_nodes
            low = _bilinear(table, first, num_nodes, along, turned)
            high = _bilinear(table, first + num_headings * num_nodes, num_nodes, along, turned)
            rows[target + lane] = low + risen * (high - low)
        else:
            rows[target + lane] = _bilinear(table, first, num_nodes, along, turned)


@kernel_function()
def _turned(table, first, x, y, z):
    """Return one coordinate in the world's axes of vectors in the camera's."""
    part = v8.broadcast(table[first + Index(2)]) * z
    part = v8.fmuladd(v8.broadcast(table[first + Index(1)]), y, part)
    return v8.fmuladd(v8.broadcast(table[first]), x, part)


@kernel_function()
def _bilinear(table, first, stride, x, y):
    """Return the value between four neighbours of a table."""
    near = table[first] + x * (table[first + Index(1)] - table[first])
    first += stride
    far = table[first] + x * (table[first + Index(1)] - table[first])
    return near + y * (far - near)


@kernel
def look_up_image(table, lens, depth, out):
    """Write the means along the rays of an image up to each pixel's depth.

    Args:
        table: the table.
        lens: 1 / fx, 1 / fy, cx, cy, float32.
        depth: z, [H, W], float32, metres.
        out: float32 [H, W].
    """
    width = depth.shape[1]
    for i in prange(depth.shape[0]):
        padded = -(-width // NUM_LANES) * NUM_LANES
        z_row = np.empty(padded, np.float32)
        z_row[width:] = np.float32(1)
        z_row[:width] = depth[i]
        mean_row = np.empty(padded, np.float32)
        rows = np.empty(4 * NUM_LANES, np.float32)
        half = np.float32(0.5)
        farthest = v8.broadcast(np.float32(FARTHEST_M))
        v = v8.broadcast((np.float32(i) + half - lens[3]) * lens[1])
        for first in range(Index(0), Index(padded), Index(NUM_LANES)):
            u = v8.broadcast(np.float32(first) + half - lens[2]) + v8.lane_numbers()
            z = v8.minimum(v8.load(z_row, first), farthest)
            x = u * v8.broadcast(lens[0]) * z
            write_log_means(table, x, v * z, z, rows, Index(3 * NUM_LANES))
            v8.store(mean_row, first, exp2_fine(v8.load(rows, Index(3 * NUM_LANES))))
        out[i] = mean_row[:width]
