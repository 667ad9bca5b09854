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
from augment.render import cpu_simd as v8
from augment.render.cpu_color import write_basis
from augment.render.cpu_geometry import from_eye
from augment.render.cpu_jit import inner, kernel
from augment.render.cpu_layout import BLOCK, LANES, V_FOCAL, V_ROTATION, U
from augment.render.cpu_math import floats_at
from augment.render.cpu_project_backward import G_ABS, G_COLOR, G_RADIUS, GRAD

# Step sizes and other numbers of an update, float32 each.
R_MEANS, R_QUATS, R_SCALES, R_OPACITIES, R_SH_DC, R_SH_REST = range(6)
R_BETA1, R_BETA2, R_OPACITY_DECAY, R_SCALE_DECAY, R_SMALLEST, R_LARGEST = range(6, 12)
R_ABS_UNIT, R_RADIUS_UNIT = 12, 13  # what turns 1/px and px into the units of Splats.grads
RATES = 14

CORRECTED = 10_000  # updates after which Adam's bias is taken as gone

_EPS = np.float32(1e-15)
_FAINTEST, _FULLEST = np.float32(1e-4), np.float32(0.9995)
_FUNCTIONS = 16


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
    """One step of Adam for every row of gradients.

    addresses, sizes, views, blocks: as in cpu_project; the splats are changed in place. firsts:
    int64 [P], index of each part's first splat in the arrays of moments. rows, ids, counts: what
    cpu_project_backward wrote. functions: SH functions that are learnt by now. rates: float32
    [RATES]. corrections: as `bias_corrections` gives them, flat. geometry_m to grads: flat arrays of
    `Splats`.
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
        g = np.empty(_FUNCTIONS * 3, np.float32)
        step = np.empty(_FUNCTIONS * 3, np.float32)
        base = U(block * BLOCK)
        for at in range(U(0), U(counts[block]), U(LANES)):
            _write_bases(means, ids, base + at, U(counts[block]) - at, view, functions, basis)
            for lane in range(min(U(LANES), U(counts[block]) - at)):
                row = (base + at + lane) * U(GRAD)
                splat = U(ids[base + at + lane])
                one = U(firsts[part]) + splat
                age[one] += 1
                grads[U(3) * one] += rows[row + U(G_ABS)] * rates[R_ABS_UNIT]
                grads[U(3) * one + U(1)] += np.float32(1)
                radius = rows[row + U(G_RADIUS)] * rates[R_RADIUS_UNIT]
                grads[U(3) * one + U(2)] = max(grads[U(3) * one + U(2)], radius)
                if math.isfinite(_row_sum(rows, row)):
                    _update_geometry(
                        means, quats, scales, opacities, splat, rows, row,
                        basis[U(_FUNCTIONS * LANES) + lane], rates, corrections, age[one],
                        geometry_m, geometry_v, one * U(GEOMETRY), g, step,
                    )  # fmt: skip
                    _update_sh(
                        sh, U(total), splat, rows, row, basis, lane, U(functions), rates,
                        corrections, age[one], sh_m, sh_v, one * U(total) * U(3), g, step,
                    )  # fmt: skip


@inner()
def _row_sum(rows, row):
    total = np.float32(0)
    for i in range(U(G_ABS)):
        total += rows[row + i]
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
def _adam(g, count, rates, corrections, age, m, v, at, step):
    """Moments brought up to date; step: what Adam takes a learning rate's multiple of."""
    beta1, beta2 = rates[R_BETA1], rates[R_BETA2]
    rest1, rest2 = np.float32(1) - beta1, np.float32(1) - beta2
    n = U(min(age, CORRECTED))
    correct1, correct2 = corrections[U(2) * n], corrections[U(2) * n + U(1)]
    for i in range(count):
        first = beta1 * m[at + i] + rest1 * g[i]
        second = beta2 * v[at + i] + rest2 * g[i] * g[i]
        m[at + i] = first
        v[at + i] = second
        step[i] = first * correct1 / (np.float32(math.sqrt(second * correct2)) + _EPS)


@inner()
def _update_geometry(
    means,
    quats,
    scales,
    opacities,
    splat,
    rows,
    row,
    pixel_m,
    rates,
    corrections,
    age,
    m,
    v,
    at,
    g,
    step,
):
    o = min(max(opacities[splat], _FAINTEST), _FULLEST)
    one = np.float32(1)
    for i in range(U(GEOMETRY)):
        g[i] = rows[row + i]
    for i in range(U(3)):
        g[U(7) + i] += rates[R_SCALE_DECAY] * scales[U(3) * splat + i]
    g[U(10)] = g[U(10)] * (one - o) + rates[R_OPACITY_DECAY] * o * (one - o)
    _adam(g, U(GEOMETRY), rates, corrections, age, m, v, at, step)
    for i in range(U(3)):
        means[U(3) * splat + i] -= rates[R_MEANS] * pixel_m * step[i]
    norm = np.float32(0)
    for i in range(U(4)):
        q = quats[U(4) * splat + i] - rates[R_QUATS] * step[U(3) + i]
        quats[U(4) * splat + i] = q
        norm += q * q
    norm = one / np.float32(math.sqrt(norm))
    for i in range(U(4)):
        quats[U(4) * splat + i] *= norm
    for i in range(U(3)):
        factor = np.float32(math.exp(-rates[R_SCALES] * step[U(7) + i]))
        s = scales[U(3) * splat + i] * factor
        scales[U(3) * splat + i] = min(max(s, rates[R_SMALLEST]), rates[R_LARGEST])
    odds = (one - o) / o * np.float32(math.exp(rates[R_OPACITIES] * step[U(10)]))
    opacities[splat] = min(max(one / (one + odds), _FAINTEST), _FULLEST)


@inner()
def _update_sh(
    sh, total, splat, rows, row, basis, lane, functions, rates, corrections, age, m, v, at, g, step
):  # fmt: skip
    red, green = rows[row + U(G_COLOR)], rows[row + U(G_COLOR + 1)]
    blue = rows[row + U(G_COLOR + 2)]
    for k in range(functions):
        value = basis[k * U(LANES) + lane]
        g[U(3) * k] = value * red
        g[U(3) * k + U(1)] = value * green
        g[U(3) * k + U(2)] = value * blue
    _adam(g, functions * U(3), rates, corrections, age, m, v, at, step)
    first = splat * total * U(3)
    for i in range(functions * U(3)):
        rate = rates[R_SH_DC] if i < U(3) else rates[R_SH_REST]
        sh[first + i] -= rate * step[i]
