"""Numba kernel: Adam on the splats that a view touched, in the arrays that the rasteriser reads.

Values are kept activated: a step on the logarithm of a scale multiplies it, a step on the logit of
an opacity divides its odds, quaternions are turned along the sphere and normalised. Kingma & Ba
2015, with the bias correction counted per splat, since a view touches a few of them only.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.reconstruct.splats import GEOMETRY
from augment.render.cpu import simd as v8
from augment.render.cpu.backward_kernels import (
    G_ABS,
    G_COLOR,
    G_MEAN,
    G_OPACITY,
    G_QUAT,
    G_RADIUS,
    G_SCALE,
    GRAD,
)
from augment.render.cpu.geometry import from_eye
from augment.render.cpu.jit import inner, kernel
from augment.render.cpu.project import write_basis
from augment.render.cpu.simd import LOG2_E, exp2_fine, floats_at
from augment.render.layout import BLOCK, LANES, V_FOCAL, V_ROTATION, U

# ---- Numba kernel: how the loss pulls at whole parts, from the gradients of their splats' means --

# Of a block, with g = dL/d mean and p the mean: sums of g (3) and p x g (3), to which is added what
# turning the splats themselves does.
MOMENTS = 6


@kernel
def sum_forces(addresses, sizes, blocks, rows, ids, counts, moments):
    """moments: float64 [B, MOMENTS], filled, in each part's axes.

    addresses, sizes, blocks: as in cpu_project; rows (flat), ids, counts: as project_backward
    wrote them. Splats whose gradient is not finite are left out, as they are of the update.
    """
    for block in prange(blocks.shape[0]):
        part = blocks[block, 0]
        means = floats_at(addresses[part, 0], sizes[part, 0] * 3)
        quats = floats_at(addresses[part, 1], sizes[part, 0] * 4)
        for i in range(MOMENTS):
            moments[block, i] = 0.0
        for at in range(U(block * BLOCK), U(block * BLOCK + counts[block])):
            row = at * U(GRAD)
            splat = U(ids[at])
            p, q = U(3) * splat, U(4) * splat
            gx, gy, gz = _three(rows, row + U(G_MEAN))
            px, py, pz = _three(means, p)
            # A turn by w takes q to q + (0, w) q / 2.
            hw = np.float64(rows[row + U(G_QUAT)])
            hx, hy, hz = _three(rows, row + U(G_QUAT + 1))
            w = np.float64(quats[q])
            x, y, z = _three(quats, q + U(1))
            if not math.isfinite(gx + gy + gz + hw + hx + hy + hz):
                continue
            moments[block, 0] += gx
            moments[block, 1] += gy
            moments[block, 2] += gz
            moments[block, 3] += py * gz - pz * gy + 0.5 * (w * hx - hw * x + y * hz - z * hy)
            moments[block, 4] += pz * gx - px * gz + 0.5 * (w * hy - hw * y + z * hx - x * hz)
            moments[block, 5] += px * gy - py * gx + 0.5 * (w * hz - hw * z + x * hy - y * hx)


@inner()
def _three(array, at):
    return np.float64(array[at]), np.float64(array[at + U(1)]), np.float64(array[at + U(2)])


# Numbers of an update, float32: step sizes of a row's first 16 columns as GRAD lists them (negative
# for opacity, whose odds are divided), of the SH, and the rest.
R_ROW, R_SH_DC, R_SH_REST, R_BETA1, R_BETA2 = 0, 16, 17, 18, 19
R_OPACITY_DECAY, R_SCALE_DECAY, R_SMALLEST, R_LARGEST = 20, 21, 22, 23
R_ABS_UNIT, R_RADIUS_UNIT = 24, 25  # what turns 1/px and px into the units of Splats.grads
RATES = 26

CORRECTED = 10_000  # updates after which Adam's bias is taken as gone

_EPS = np.float32(1e-15)
_FAINTEST, _FULLEST = np.float32(1e-4), np.float32(0.9995)
_FUNCTIONS = 16
_ROWS = 1024
_WORK = 48  # room for a splat's SH: gradients, moments, steps


def bias_corrections(beta1: float, beta2: float) -> np.ndarray:
    """float32 [CORRECTED + 1, 2]: what moments are multiplied with after so many updates."""
    n = np.arange(CORRECTED + 1, dtype=np.float64)[:, None]
    n[0] = 1  # never read: a splat is updated before it is corrected
    return (1 / (1 - np.array([beta1, beta2]) ** n)).astype(np.float32)


@kernel
def update_splats(
    addresses,
    sizes,
    views,
    blocks,
    firsts,
    rows,
    ids,
    counts,
    functions,
    rates,
    corrections,
    geometry_m,
    geometry_v,
    sh_m,
    sh_v,
    age,
    grads,
):
    """One step of Adam for every row of gradients; a splat whose row is not finite stays as it is.

    addresses, sizes, views, blocks: as in cpu_project; the splats are changed in place. firsts:
    int64 [P], index of each part's first splat in the arrays of moments. rows, ids, counts: what
    cpu_project_backward wrote. functions: SH functions that are learnt by now. rates: float32
    [RATES]. corrections: as `bias_corrections` gives them, flat. geometry_m to grads: flat arrays
    of `Splats`.
    """
    for block in prange(blocks.shape[0]):
        part = blocks[block, 0]
        count, total = sizes[part]
        means = floats_at(addresses[part, 0], count * 3)
        quats = floats_at(addresses[part, 1], count * 4)
        scales = floats_at(addresses[part, 2], count * 3)
        opacities = floats_at(addresses[part, 3], count)
        sh = floats_at(addresses[part, 4], count * total * 3)
        view = views[part]
        basis = np.empty((_FUNCTIONS + 2) * LANES, np.float32)
        work = np.zeros(4 * _WORK, np.float32)
        base = U(block * BLOCK)
        for at in range(U(0), U(counts[block]), U(LANES)):
            _write_bases(means, ids, base + at, U(counts[block]) - at, view, functions, basis)
            for lane in range(min(U(LANES), U(counts[block]) - at)):
                row = (base + at + lane) * U(GRAD)
                splat = U(ids[base + at + lane])
                one = U(firsts[part]) + splat
                if not math.isfinite(_row_power(rows, row)):
                    continue
                age[one] += 1
                grads[U(3) * one] += rows[row + U(G_ABS)] * rates[R_ABS_UNIT]
                grads[U(3) * one + U(1)] += np.float32(1)
                radius = rows[row + U(G_RADIUS)] * rates[R_RADIUS_UNIT]
                grads[U(3) * one + U(2)] = max(grads[U(3) * one + U(2)], radius)
                n = U(min(age[one], CORRECTED))
                first, second = corrections[U(2) * n], corrections[U(2) * n + U(1)]
                _update_geometry(
                    means, quats, scales, opacities, splat, rows, row,
                    basis[U(_FUNCTIONS * LANES) + lane], rates, first, second,
                    geometry_m, geometry_v, one * U(GEOMETRY), work,
                )  # fmt: skip
                _update_sh(
                    sh, U(total), splat, rows, row, basis, lane, U(functions), rates, first,
                    second, sh_m, sh_v, one * U(total) * U(3), work,
                )  # fmt: skip


@inner()
def _row_power(rows, row):
    """Sum of squares: not finite where a number is not, or its second moment would not be."""
    total = np.float32(0)
    for i in range(U(GRAD)):
        total += rows[row + i] * rows[row + i]
    return total


@inner()
def _write_bases(means, ids, at, left, view, functions, basis):
    """SH functions of eight splats, and the width of a pixel where they are, metres."""
    picked = np.empty(LANES, np.int32)
    for lane in range(U(LANES)):
        picked[lane] = ids[at + min(lane, left - U(1))]
    dx, dy, dz = from_eye(means, picked, U(0), view)
    inverse = v8.splat(np.float32(1)) / v8.sqrt(v8.fmuladd(dx, dx, v8.fmuladd(dy, dy, dz * dz)))
    write_basis(dx * inverse, dy * inverse, dz * inverse, functions, basis)
    row = U(V_ROTATION + 6)
    z = v8.fmuladd(v8.splat(view[row]), dx, v8.splat(view[row + U(1)]) * dy)
    z = v8.fmuladd(v8.splat(view[row + U(2)]), dz, z)
    v8.store(basis, U(_FUNCTIONS * LANES), z * v8.splat(np.float32(1) / view[V_FOCAL]))


@inner()
def _adam8(g, rates, first, second, m, m_at, v, v_at):
    """Eight moments brought up to date; returns what a step size is multiplied with."""
    one = np.float32(1)
    beta1, beta2 = rates[R_BETA1], rates[R_BETA2]
    new_m = v8.fmuladd(v8.splat(beta1), v8.load(m, m_at), v8.splat(one - beta1) * g)
    new_v = v8.fmuladd(v8.splat(beta2), v8.load(v, v_at), v8.splat(one - beta2) * g * g)
    v8.store(m, m_at, new_m)
    v8.store(v, v_at, new_v)
    root = v8.sqrt(new_v * v8.splat(second)) + v8.splat(_EPS)
    return new_m * v8.splat(first) / root


@inner()
def _update_geometry(
    means, quats, scales, opacities, splat, rows, row, pixel_m, rates, first, second, m, v, at,
    work,
):  # fmt: skip
    one = np.float32(1)
    o = min(max(opacities[splat], _FAINTEST), _FULLEST)
    for i in range(U(3)):
        rows[row + U(G_SCALE) + i] += rates[R_SCALE_DECAY] * scales[U(3) * splat + i]
    slope = rows[row + U(G_OPACITY)] + rates[R_OPACITY_DECAY] * o
    rows[row + U(G_OPACITY)] = slope * (one - o)
    low = _adam8(v8.load(rows, row), rates, first, second, m, at, v, at)
    v8.store(work, U(0), low * v8.load(rates, U(R_ROW)))
    high = _adam8(v8.load(rows, row + U(8)), rates, first, second, m, at + U(8), v, at + U(8))
    factors = exp2_fine(v8.splat(-LOG2_E) * high * v8.load(rates, U(R_ROW + 8)))
    v8.store(work, U(8), factors)
    for i in range(U(3)):
        means[U(3) * splat + i] -= pixel_m * work[i]
    norm = np.float32(0)
    for i in range(U(4)):
        q = quats[U(4) * splat + i] - work[U(G_QUAT) + i]
        quats[U(4) * splat + i] = q
        norm += q * q
    norm = one / np.float32(math.sqrt(norm))
    for i in range(U(4)):
        quats[U(4) * splat + i] *= norm
    for i in range(U(3)):
        s = scales[U(3) * splat + i] * work[U(G_SCALE) + i]
        scales[U(3) * splat + i] = min(max(s, rates[R_SMALLEST]), rates[R_LARGEST])
    odds = (one - o) / o * work[U(G_OPACITY)]
    opacities[splat] = min(max(one / (one + odds), _FAINTEST), _FULLEST)


@inner()
def _update_sh(
    sh, total, splat, rows, row, basis, lane, functions, rates, first, second, m, v, at, work
):
    red, green = rows[row + U(G_COLOR)], rows[row + U(G_COLOR + 1)]
    blue = rows[row + U(G_COLOR + 2)]
    count = U(3) * functions
    # A copy of its own, since eight at a time would reach into the next splat's moments.
    for k in range(functions):
        value = basis[k * U(LANES) + lane]
        work[U(3) * k] = value * red
        work[U(3) * k + U(1)] = value * green
        work[U(3) * k + U(2)] = value * blue
    for i in range(count):
        work[U(_WORK) + i] = m[at + i]
        work[U(2 * _WORK) + i] = v[at + i]
    for i in range(U(0), count, U(LANES)):
        steps = _adam8(
            v8.load(work, i), rates, first, second, work, U(_WORK) + i, work, U(2 * _WORK) + i
        )
        v8.store(work, U(3 * _WORK) + i, steps)
    for i in range(count):
        m[at + i] = work[U(_WORK) + i]
        v[at + i] = work[U(2 * _WORK) + i]
    start = splat * total * U(3)
    for i in range(U(3)):
        sh[start + i] -= rates[R_SH_DC] * work[U(3 * _WORK) + i]
    for i in range(U(3), count):
        sh[start + i] -= rates[R_SH_REST] * work[U(3 * _WORK) + i]


@kernel
def update_rows(values, m, v, age, rows, grads, rate, betas, corrections):
    """One step of Adam for rows of three numbers, each row once; values stay within [0, 1].

    values, m, v: float32 [N * 3]. age: int32 [N]. rows: int32 [T]. grads: float32 [T, 3]. betas:
    float32 [2]. corrections: as for `update_splats`.
    """
    for run in prange((rows.size + _ROWS - 1) // _ROWS):
        one = np.float32(1)
        for i in range(U(run * _ROWS), U(min((run + 1) * _ROWS, rows.size))):
            row = U(rows[i])
            age[row] += 1
            n = U(min(age[row], CORRECTED))
            first, second = corrections[U(2) * n], corrections[U(2) * n + U(1)]
            for channel in range(U(3)):
                at = U(3) * row + channel
                g = grads[i, channel]
                m[at] = betas[0] * m[at] + (one - betas[0]) * g
                v[at] = betas[1] * v[at] + (one - betas[1]) * g * g
                root = np.float32(math.sqrt(v[at] * second)) + _EPS
                values[at] = min(max(values[at] - rate * first * m[at] / root, np.float32(0)), one)
