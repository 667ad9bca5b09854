"""Numba kernels of fog banks: their density, its mean along rays, and the look-up of such means.

`fog_banks` has the definition of the density. The mean along a ray is weighted by the plain fog's
extinction, so the optical depth of a ray is that of plain fog times the mean.

    mean(d) = int_0^d m(x(r)) w(r) dr / int_0^d w(r) dr,    w = exp(-k r),  k = climb / scale height

Two points stand for each step of a ray: the weight's centroid, plus and minus its standard
deviation. For equal weights that is Gauss' rule. Steps grow with the distance.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.hash_kernels import mix
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.fog_banks import DEVIATION, STEP_Z
from augment.rng import STEP_X, STEP_Y

_X = np.uint64(STEP_X)
_Y = np.uint64(STEP_Y)
_Z = np.uint64(STEP_Z)
_S21 = np.uint64(21)
_S42 = np.uint64(42)
_MASK = np.uint64(2**21 - 1)
_UNIT = 2.0**-20
_LN_2 = np.float32(math.log(2))
_PER_DEVIATION = 1 / DEVIATION
# Numbers of a cell: its position, and three of a gradient for each of its corners.
CELL = 3 + 8 * 3
# Numbers at the head of a table, see `fog_table.BankTable`.
HEAD = 8
# Step of a ray near the eye, in lattice steps of the last octave.
STEP = 0.5
# Growth of the steps with the distance.
STEP_GROWTH = 0.03


@kernel_function()
def bank_density_at(x, y, z, lattices, seeds, log_mean, cells):
    """Return m at a point (scene world, metres).

    cells: float64 [NUM_OCTAVES, CELL]: for each octave the cell that was read last, and the
        gradients at its corners. Steps of a ray stay in a cell for a while.
    """
    exponent = -log_mean
    for octave in range(seeds.size):
        row = lattices[octave]
        u = row[0] * x + row[1] * y + row[2] * z + row[9]
        v = row[3] * x + row[4] * y + row[5] * z + row[10]
        w = row[6] * x + row[7] * y + row[8] * z + row[11]
        exponent += row[12] * _gradient_noise(u, v, w, seeds[octave], cells[octave])
    return math.exp(exponent)


@kernel_function()
def empty_cells(num_octaves):
    """Return cells of which none has been read."""
    cells = np.empty((num_octaves, CELL))
    cells[:, :3] = np.nan
    return cells


@kernel_function()
def _gradient_noise(u, v, w, seed, cell):
    """Return gradient noise of variance 1 at lattice coordinates."""
    column = math.floor(u)
    row = math.floor(v)
    layer = math.floor(w)
    if cell[0] != column or cell[1] != row or cell[2] != layer:
        _read_cell(column, row, layer, seed, cell)
    x = u - column
    y = v - row
    z = w - layer
    fade_x = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    fade_y = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    fade_z = z * z * z * (z * (z * 6.0 - 15.0) + 10.0)
    lower = _plane(cell, 3, x, y, z, fade_x, fade_y)
    upper = _plane(cell, 15, x, y, z - 1.0, fade_x, fade_y)
    return (lower + fade_z * (upper - lower)) * _PER_DEVIATION


@kernel_function()
def _plane(cell, first, x, y, z, fade_x, fade_y):
    """Return the noise between the four corners whose gradients start at `first`."""
    a = cell[first] * x + cell[first + 1] * y + cell[first + 2] * z
    b = cell[first + 3] * (x - 1.0) + cell[first + 4] * y + cell[first + 5] * z
    c = cell[first + 6] * x + cell[first + 7] * (y - 1.0) + cell[first + 8] * z
    d = cell[first + 9] * (x - 1.0) + cell[first + 10] * (y - 1.0) + cell[first + 11] * z
    near = a + fade_x * (b - a)
    far = c + fade_x * (d - c)
    return near + fade_y * (far - near)


@kernel_function()
def _read_cell(column, row, layer, seed, cell):
    """Write a cell's position and the gradients at its eight corners."""
    cell[0] = column
    cell[1] = row
    cell[2] = layer
    first = np.uint64(np.int64(column)) * _X + np.uint64(np.int64(row)) * _Y
    first += np.uint64(np.int64(layer)) * _Z
    place = 3
    for corner in range(8):
        bits = first
        if corner & 1:
            bits += _X
        if corner & 2:
            bits += _Y
        if corner & 4:
            bits += _Z
        bits = mix(bits ^ seed)
        cell[place] = np.float64(np.int64(bits & _MASK)) * _UNIT - 1.0
        cell[place + 1] = np.float64(np.int64(bits >> _S21 & _MASK)) * _UNIT - 1.0
        cell[place + 2] = np.float64(np.int64(bits >> _S42 & _MASK)) * _UNIT - 1.0
        place += 3


@kernel_function()
def _weight(kd):
    """Return (1 - exp(-x)) / x, the mean of the weight over a step of x = k times its length."""
    if abs(kd) < 1e-4:
        return 1.0 - 0.5 * kd
    return -math.expm1(-kd) / kd


@kernel_function()
def _centroid(kd):
    """Return where the weight exp(-x) has its centroid, as a share of a step of length x."""
    if abs(kd) < 1e-3:
        return 0.5 - kd / 12.0
    if kd > 500.0:
        return 1.0 / kd
    if kd < -500.0:
        return 1.0 + 1.0 / kd
    return 1.0 / kd - 1.0 / math.expm1(kd)


@kernel_function()
def _spread(kd):
    """Return the standard deviation of the weight exp(-x) over a step of length x, as its share."""
    x = abs(kd)
    if x < 0.1:
        return math.sqrt(1.0 / 12.0 - x * x / 240.0)
    half = math.sinh(0.5 * min(x, 500.0))
    return math.sqrt(1.0 / (x * x) - 0.25 / (half * half))


@kernel_function()
def extend_mean(
    mean, total, start_m, end_m, eye, direction, rate, finest_m, lattices, seeds, log_mean, cells
):
    """Return the mean along a ray up to end_m and its total weight, from those up to start_m.

    The total weight is relative to the extinction at the eye if the fog thins along the ray, and
    else to the extinction at the end, so that it stays finite.

    Args:
        mean: mean up to start_m.
        total: total weight up to start_m, metres.
        start_m: distance from the eye, metres.
        end_m: distance from the eye, metres.
        eye: start of the ray [3], scene world, metres.
        direction: its unit direction [3].
        rate: k, 1/m.
        finest_m: lattice step of the last octave, metres.
        lattices: rows of `FogBanks.lattices`.
        seeds: seeds of the octaves.
        log_mean: `FogBanks.log_mean`.
        cells: as in `bank_density_at`.
    """
    length = end_m - start_m
    if length <= 0.0:
        return mean, total
    middle = 0.5 * (start_m + end_m)
    count = max(1, math.ceil(length / (STEP * finest_m + STEP_GROWTH * middle)))
    step = length / count
    kd = rate * step
    fade = math.exp(-abs(kd))
    weight = step * _weight(abs(kd))
    shift = _centroid(kd) * step
    spread = _spread(kd) * step
    scale = math.exp(-rate * start_m) if rate > 0.0 else 1.0
    for i in range(count):
        density = 0.0
        for side in range(-1, 2, 2):
            distance = start_m + i * step + shift + side * spread
            density += 0.5 * bank_density_at(
                eye[0] + distance * direction[0],
                eye[1] + distance * direction[1],
                eye[2] + distance * direction[2],
                lattices,
                seeds,
                log_mean,
                cells,
            )
        if rate > 0.0:
            added = weight * scale
            scale *= fade
            total += added
        else:
            added = weight
            total = total * fade + added
        if total > 0.0:
            mean += (density - mean) * (added / total)
    return mean, total


@kernel
def tabulate_means(
    eye, axes, u0, v0, step, distances, rise, scale_rate, finest_m, lattices, seeds, log_mean, out
):
    """Write the mean along the rays of a grid, up to each distance.

    Args:
        eye: [3], scene world, metres.
        axes: world_from_camera's rotation [3, 3].
        u0: x/z of the first column.
        v0: y/z of the first row.
        step: step of x/z and y/z.
        distances: distances [D] along the rays, rising from 0, metres.
        rise: the z row of `axes` [3].
        scale_rate: 1 / scale height; 0 for uniform fog.
        finest_m: lattice step of the last octave, metres.
        lattices: rows of `FogBanks.lattices`.
        seeds: seeds of the octaves.
        log_mean: `FogBanks.log_mean`.
        out: float64 [D, rows, columns].
    """
    num_distances, num_rows, num_columns = out.shape
    for ray in prange(num_rows * num_columns):
        cells = empty_cells(seeds.size)
        near = bank_density_at(eye[0], eye[1], eye[2], lattices, seeds, log_mean, cells)
        row = ray // num_columns
        column = ray - row * num_columns
        u = u0 + column * step
        v = v0 + row * step
        length = math.sqrt(1.0 + u * u + v * v)
        direction = np.empty(3)
        for axis in range(3):
            direction[axis] = (axes[axis, 0] * u + axes[axis, 1] * v + axes[axis, 2]) / length
        rate = (rise[0] * u + rise[1] * v + rise[2]) / length * scale_rate
        mean = near
        total = 0.0
        out[0, row, column] = near
        for node in range(1, num_distances):
            mean, total = extend_mean(
                mean,
                total,
                distances[node - 1],
                distances[node],
                eye,
                direction,
                rate,
                finest_m,
                lattices,
                seeds,
                log_mean,
                cells,
            )
            out[node, row, column] = mean


@kernel
def means_of_rays(
    origins, directions, distances, scale_rate, finest_m, lattices, seeds, log_mean, out
):
    """Write the mean along each of N rays up to its distance, by the steps of `extend_mean`.

    Args:
        origins: [N, 3], scene world, metres.
        directions: unit directions [N, 3].
        distances: [N], metres.
        scale_rate: 1 / scale height; 0 for uniform fog.
        finest_m: lattice step of the last octave, metres.
        lattices: rows of `FogBanks.lattices`.
        seeds: seeds of the octaves.
        log_mean: `FogBanks.log_mean`.
        out: float64 [N].
    """
    for ray in prange(distances.size):
        eye = origins[ray]
        cells = empty_cells(seeds.size)
        near = bank_density_at(eye[0], eye[1], eye[2], lattices, seeds, log_mean, cells)
        mean = near
        total = 0.0
        start_m = 0.0
        # Legs that double, so that steps are short near the eye.
        end_m = 4.0 * finest_m
        while start_m < distances[ray]:
            end_m = min(end_m, distances[ray])
            mean, total = extend_mean(
                mean,
                total,
                start_m,
                end_m,
                eye,
                directions[ray],
                directions[ray, 2] * scale_rate,
                finest_m,
                lattices,
                seeds,
                log_mean,
                cells,
            )
            start_m = end_m
            end_m *= 1.5
        out[ray] = mean


@kernel_function()
def interpolate_mean(table, x, y, node):
    """Return log2 of the mean along a ray up to a distance, float32, from a flat table.

    Beyond the table's border a ray has the value of the border.

    Args:
        table: float32: a head of HEAD numbers (1 / step, -u0 / step, -v0 / step, columns, rows,
            distances, 1 / the distance at which the nodes begin to grow apart, nodes per doubling),
            then log2 of the means [distances, rows, columns].
        x: position of the ray among the columns.
        y: position of the ray among the rows.
        node: position of the distance among the nodes.
    """
    zero = np.float32(0)
    num_columns = np.int64(table[3])
    num_rows = np.int64(table[4])
    num_distances = np.int64(table[5])
    x = min(max(x, zero), np.float32(num_columns - 1))
    y = min(max(y, zero), np.float32(num_rows - 1))
    node = min(max(node, zero), np.float32(num_distances - 1))
    column = min(np.int64(x), num_columns - 2)
    row = min(np.int64(y), num_rows - 2)
    plane = min(np.int64(node), num_distances - 2)
    x -= np.float32(column)
    y -= np.float32(row)
    node -= np.float32(plane)
    first = HEAD + (plane * num_rows + row) * num_columns + column
    near = _bilinear(table, first, num_columns, x, y)
    far = _bilinear(table, first + num_rows * num_columns, num_columns, x, y)
    return near + node * (far - near)


@kernel_function()
def _bilinear(table, first, num_columns, x, y):
    """Return the value between four neighbours of a table."""
    upper = table[first] + x * (table[first + 1] - table[first])
    first += num_columns
    lower = table[first] + x * (table[first + 1] - table[first])
    return upper + y * (lower - upper)


@kernel
def look_up_image(table, u, v, depth, out):
    """Write the means along the rays of an image up to each pixel's depth.

    Args:
        table: as `interpolate_mean` takes it.
        u: x/z of the columns, [W], float32.
        v: y/z of the rows, [H], float32.
        depth: z, [H, W], float32, metres.
        out: float32 [H, W].
    """
    one = np.float32(1)
    for i in prange(depth.shape[0]):
        square = one + v[i] * v[i]
        for j in range(depth.shape[1]):
            distance = depth[i, j] * math.sqrt(square + u[j] * u[j])
            node = np.float32(math.log2(one + distance * table[6])) * table[7]
            x = u[j] * table[0] + table[1]
            mean = interpolate_mean(table, x, v[i] * table[0] + table[2], node)
            out[i, j] = math.exp(mean * _LN_2)
