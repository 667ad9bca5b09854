"""Triton kernel: Gaussians of all parts to splats of one image."""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.render import cuda_inputs, cuda_splats, layout, shading
from augment.render.cuda_clip_kernels import cut_of
from augment.render.cuda_color_kernels import color_of, in_smog, mapped, through_smog
from augment.render.cuda_geometry_kernels import (
    cross,
    dot,
    eight,
    floats_at,
    four_where,
    from_eye,
    image_axes,
    inverse_divisor,
    rotation_columns,
    rotation_rows,
    three_where,
    to_image,
)
from augment.render.cuda_light_kernels import store_lights

COLUMNS = tl.constexpr(cuda_inputs.COLUMNS)
T_COUNT, T_FUNCTIONS = tl.constexpr(cuda_inputs.T_COUNT), tl.constexpr(cuda_inputs.T_FUNCTIONS)
T_FIRST, T_BLOCK = tl.constexpr(cuda_inputs.T_FIRST), tl.constexpr(cuda_inputs.T_BLOCK)
A_MEANS, A_QUATS = tl.constexpr(layout.A_MEANS), tl.constexpr(layout.A_QUATS)
A_SCALES, A_OPACITIES = tl.constexpr(layout.A_SCALES), tl.constexpr(layout.A_OPACITIES)
A_SH, A_SLOPES = tl.constexpr(layout.A_SH), tl.constexpr(layout.A_SLOPES)
A_MAPS, A_ROWS = tl.constexpr(layout.A_MAPS), tl.constexpr(layout.A_ROWS)
VIEW = tl.constexpr(layout.VIEW)
V_SIZE, V_NEAR = tl.constexpr(layout.V_SIZE), tl.constexpr(layout.V_NEAR)
V_BLUR, V_ALPHA_MIN = tl.constexpr(layout.V_BLUR), tl.constexpr(layout.V_ALPHA_MIN)
V_LOG_CUT, V_RADIUS_CLIP = tl.constexpr(layout.V_LOG_CUT), tl.constexpr(layout.V_RADIUS_CLIP)
V_PARALLEL, V_SNOW = tl.constexpr(layout.V_PARALLEL), tl.constexpr(layout.V_SNOW)
V_LIT, V_MAPS = tl.constexpr(layout.V_LIT), tl.constexpr(layout.V_MAPS)
V_ROTATION = tl.constexpr(layout.V_ROTATION)
NO_SMOG = tl.constexpr(layout.NO_SMOG)
HIDDEN, TILE = tl.constexpr(cuda_splats.HIDDEN), tl.constexpr(cuda_splats.TILE)
K = tl.constexpr(0.5 * math.log2(math.e))  # exponents of alpha are of 2
HUGE = tl.constexpr(1e37)  # px^2; beyond it float32 overflows, and no pixel could tell
CUT, LINES = tl.constexpr(layout.CUT), tl.constexpr(shading.LINES)
RECORD = tl.constexpr(layout.RECORD)


@triton.jit
def project_gaussians(
    table,
    views,
    block_parts,
    records,
    keys,
    rects,
    counts,
    cuts,
    lights,
    COLOR: tl.constexpr,
    FUNCTIONS: tl.constexpr,
    ANTIALIASED: tl.constexpr,
    SMOG: tl.constexpr,
    CLIP: tl.constexpr,
    LIGHT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Splats of the Gaussians of every part; each program takes BLOCK of one part.

    table, views, block_parts: see cuda_inputs. The rest: of cuda_splats, and written; cuts and
    lights where CLIP and LIGHT ask for them. In capitals: the modes (see layout).
    """
    program = tl.program_id(0)
    part = tl.load(block_parts + program)
    row, view = table + part * COLUMNS, views + part * VIEW
    # Places in memory are int64 as far as all lanes share them, and int32 beyond.
    first = (program - tl.load(row + T_BLOCK)) * BLOCK
    out = tl.load(row + T_FIRST) + first
    lane = tl.arange(0, BLOCK)
    inside = lane < (tl.load(row + T_COUNT) - first).to(tl.int32)

    means = floats_at(tl.load(row + A_MEANS)) + first * 3 + lane * 3
    d = from_eye(three_where(means, inside), view)
    opacity = tl.load(floats_at(tl.load(row + A_OPACITIES)) + first + lane, inside, 0.0)
    r, s, t = rotation_rows(view)
    x, y, z = dot(r, d), dot(s, d), dot(t, d)
    seen = (z >= tl.load(view + V_NEAR)) & (opacity >= tl.load(view + V_ALPHA_MIN))
    inverse = inverse_divisor(z, view)
    quats = floats_at(tl.load(row + A_QUATS)) + first * 4 + lane * 4
    columns = rotation_columns(four_where(quats, seen))
    scales = three_where(floats_at(tl.load(row + A_SCALES)) + first * 3 + lane * 3, seen)
    right, down = image_axes(x, y, inverse, columns, scales, view)

    xy, blurred_x, blurred_y, minors, along = _covariance(right, down, tl.load(view + V_BLUR))
    inverse_x, inverse_y = 1.0 / blurred_x, 1.0 / blurred_y
    log_opacity = tl.log2(opacity)
    if ANTIALIASED:
        log_opacity = tl.fma(0.5, tl.log2(minors / along), log_opacity)
    log_cut = tl.load(view + V_LOG_CUT)
    budget = tl.maximum(log_opacity - log_cut, 0.0) / K
    radius_x, radius_y = tl.sqrt(budget * blurred_x), tl.sqrt(budget * blurred_y)
    drawn = seen & (log_opacity >= log_cut) & (blurred_x + blurred_y <= HUGE)
    drawn = drawn & (tl.maximum(radius_x, radius_y) > tl.load(view + V_RADIUS_CLIP))
    if CLIP:
        partly, cut = cut_of(d, right, down, columns, scales, inverse, view)
        drawn = drawn & partly
    mean_x, mean_y = to_image(x, y, inverse, view)
    first_x, last_x = _pixels(mean_x, radius_x, tl.load(view + V_SIZE))
    first_y, last_y = _pixels(mean_y, radius_y, tl.load(view + V_SIZE + 1))
    drawn = drawn & (first_x <= last_x) & (first_y <= last_y)

    c0, c1 = _tile(first_x, drawn), _tile(last_x, drawn)
    r0, r1 = _tile(first_y, drawn), _tile(last_y, drawn)
    tl.store(keys + out + lane, tl.where(drawn, z.to(tl.int32, bitcast=True), HIDDEN), inside)
    tl.store(counts + out + lane, tl.where(drawn, (c1 - c0 + 1) * (r1 - r0 + 1), 0), inside)
    _store_rows(rects + out * 2, tl.join(c0 + (r0 << 16), c1 + (r1 << 16)), drawn, BLOCK, 2)

    zero = tl.zeros_like(z)
    color, through = (zero, zero, zero), zero + 1.0
    if COLOR:
        towards = d
        if tl.load(view + V_PARALLEL) > 0.0:
            towards = (t[0] + zero, t[1] + zero, t[2] + zero)
        distance = tl.sqrt(dot(towards, towards))
        functions = tl.load(row + T_FUNCTIONS).to(tl.int32)
        sh = floats_at(tl.load(row + A_SH)) + first * 3 * functions + lane * 3 * functions
        color = color_of(sh, functions, towards, distance, drawn, FUNCTIONS)
        map_count = tl.load(view + V_MAPS).to(tl.int32)
        if map_count > 0:
            maps = floats_at(tl.load(row + A_MAPS))
            map_rows = tl.load(row + A_ROWS).to(tl.pointer_type(tl.int16)) + first + lane
            color = mapped(color, maps, map_rows, map_count, drawn)
        if SMOG != NO_SMOG:
            through = through_smog(towards, distance, view, SMOG)
            color = in_smog(color, through, view)

    number = (out.to(tl.int32) + lane).to(tl.float32, bitcast=True)
    snow = zero + tl.load(view + V_SNOW)
    # In layout's order of fields, those of even number and those of odd number.
    even = eight(
        mean_x, xy * inverse_y, inverse_y * K, radius_y, xy * inverse_x, z, color[0], color[2]
    )
    odd = eight(
        mean_y, tl.sqrt(1.0 / along * K), log_opacity, inverse_x * K,
        tl.sqrt(along * blurred_y * inverse_x / K), number, color[1], snow,
    )  # fmt: skip
    record = tl.reshape(tl.join(even, odd), (BLOCK, RECORD))
    _store_rows(records + out * RECORD, record, drawn, BLOCK, RECORD)
    if CLIP:
        _store_rows(cuts + out * CUT, cut, drawn, BLOCK, CUT)
    if LIGHT:
        lit = tl.where(drawn, tl.load(view + V_LIT), 0.0) > 0.0
        slopes = three_where(floats_at(tl.load(row + A_SLOPES)) + first * 3 + lane * 3, lit)
        lines = lights + out * LINES + lane * LINES
        store_lights(lines, columns[2], (x, y, z), slopes, through, lit, drawn, view)


@triton.jit
def _covariance(right, down, blur):
    """xy, and blurred xx and yy, px^2; variances along a row, det / yy, before the blur and after.

    By Lagrange's identity, det = |right cross down|^2, no digits cancel; each term is divided
    before it is squared, so that nothing overflows.
    """
    xx, xy, yy = dot(right, right), dot(right, down), dot(down, down)
    inverse = 1.0 / (yy + blur)
    across = cross(right, down, tl.sqrt(inverse))
    minors = dot(across, across)
    return xy, xx + blur, yy + blur, minors, blur + tl.fma(blur * xx, inverse, minors)


@triton.jit
def _pixels(mean, radius, size):
    """First and last pixel whose centre lies within the radius; the last below where none does."""
    first = tl.maximum(mean - radius - 0.5, 0.0)
    last = tl.minimum(mean + radius - 0.5, size - 1.0)
    return tl.ceil(first), tl.floor(last)


@triton.jit
def _tile(pixel, drawn):
    return tl.where(drawn, pixel, 0.0).to(tl.int32) // TILE


@triton.jit
def _store_rows(pointer, rows, mask, ROWS: tl.constexpr, FIELDS: tl.constexpr):
    at = tl.arange(0, ROWS)[:, None] * FIELDS + tl.arange(0, FIELDS)[None, :]
    tl.store(pointer + at, rows, mask[:, None])
