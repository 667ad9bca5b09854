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
    floats_at,
    from_eye,
    image_axes,
    inverse_divisor,
    rotation_columns,
    rotation_rows,
    three_where,
    to_image,
)
from augment.render.cuda_light_kernels import light_lines

CUT, LINES = 8, shading.LINES
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
N_CUT, N_LINES, N_RECORD = tl.constexpr(CUT), tl.constexpr(LINES), tl.constexpr(layout.RECORD)


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

    table, views, block_parts: see cuda_inputs. The rest: of cuda_splats, and written. In capitals:
    the modes (see layout).
    """
    program = tl.program_id(0)
    part = tl.load(block_parts + program)
    table_row, view = table + part * COLUMNS, views + part * VIEW
    lane = tl.arange(0, BLOCK)
    # In int64 as far as all lanes share it: places in memory may exceed 2^31.
    first = (program - tl.load(table_row + T_BLOCK)) * BLOCK
    inside = lane < tl.load(table_row + T_COUNT) - first
    out = tl.load(table_row + T_FIRST) + first

    means = floats_at(tl.load(table_row + A_MEANS)) + first * 3 + lane * 3
    quats = floats_at(tl.load(table_row + A_QUATS)) + first * 4 + lane * 4
    scales = floats_at(tl.load(table_row + A_SCALES)) + first * 3 + lane * 3
    opacities = floats_at(tl.load(table_row + A_OPACITIES)) + first + lane
    d = from_eye(three_where(means, inside), view)
    opacity = tl.load(opacities, inside, 0.0)
    r, s, t = rotation_rows(view)
    x, y, z = dot(r, d), dot(s, d), dot(t, d)
    seen = (z >= tl.load(view + V_NEAR)) & (opacity >= tl.load(view + V_ALPHA_MIN))

    inverse = inverse_divisor(z, view)
    columns = rotation_columns(
        tl.load(quats, seen, 0.0),
        tl.load(quats + 1, seen, 0.0),
        tl.load(quats + 2, seen, 0.0),
        tl.load(quats + 3, seen, 0.0),
    )
    sizes = three_where(scales, seen)
    right, down = image_axes(x, y, inverse, columns, sizes, view)
    xx, xy, yy = dot(right, right), dot(right, down), dot(down, down)
    blur = tl.load(view + V_BLUR)
    blurred_x, blurred_y = xx + blur, yy + blur
    inverse_x, inverse_y = 1.0 / blurred_x, 1.0 / blurred_y
    # Variance along a row, det / yy, by Lagrange's identity, det = |right cross down|^2: no digits
    # cancel, and each term is divided before it is squared, so that nothing overflows.
    across = cross(right, down, tl.sqrt(inverse_y))
    minors = dot(across, across)
    along = blur + tl.fma(blur * xx, inverse_y, minors)
    log_opacity = tl.log2(opacity)
    if ANTIALIASED:
        log_opacity = tl.fma(0.5, tl.log2(minors / along), log_opacity)
    log_cut = tl.load(view + V_LOG_CUT)
    budget = tl.maximum(log_opacity - log_cut, 0.0) / K
    radius_x, radius_y = tl.sqrt(budget * blurred_x), tl.sqrt(budget * blurred_y)
    drawn = seen & (log_opacity >= log_cut) & (blurred_x + blurred_y <= HUGE)
    drawn = drawn & (tl.maximum(radius_x, radius_y) > tl.load(view + V_RADIUS_CLIP))
    if CLIP:
        partly, offset, lx, ly, gx, gy, deep = cut_of(d, right, down, columns, sizes, inverse, view)
        drawn = drawn & partly

    mean_x, mean_y = to_image(x, y, inverse, view)
    x_lo, x_hi = _pixels(mean_x, radius_x, tl.load(view + V_SIZE))
    y_lo, y_hi = _pixels(mean_y, radius_y, tl.load(view + V_SIZE + 1))
    drawn = drawn & (x_lo <= x_hi) & (y_lo <= y_hi)
    column, last_column = _tile(x_lo, drawn), _tile(x_hi, drawn)
    row, last_row = _tile(y_lo, drawn), _tile(y_hi, drawn)
    touched = (last_column - column + 1) * (last_row - row + 1)
    tl.store(keys + out + lane, tl.where(drawn, z.to(tl.int32, bitcast=True), HIDDEN), inside)
    tl.store(counts + out + lane, tl.where(drawn, touched, 0), inside)
    tl.store(rects + out * 2 + lane * 2, column + (row << 16), drawn)
    tl.store(rects + out * 2 + lane * 2 + 1, last_column + (last_row << 16), drawn)

    zero = tl.zeros_like(z)
    color = (zero, zero, zero)
    if COLOR:
        towards = d
        if tl.load(view + V_PARALLEL) > 0.0:
            towards = (t[0] + zero, t[1] + zero, t[2] + zero)
        distance = tl.sqrt(dot(towards, towards))
        step = tl.load(table_row + T_FUNCTIONS).to(tl.int32)
        sh = floats_at(tl.load(table_row + A_SH)) + first * 3 * step + lane * 3 * step
        color = color_of(sh, step, towards, distance, drawn, FUNCTIONS)
        map_count = tl.load(view + V_MAPS).to(tl.int32)
        if map_count > 0:
            maps, rows = tl.load(table_row + A_MAPS), tl.load(table_row + A_ROWS)
            color = mapped(color, maps, rows, map_count, first + lane, drawn)
        if SMOG != NO_SMOG:
            through = through_smog(towards, distance, view, SMOG)
            color = in_smog(color, through, view)

    if CLIP:
        cut = _eight(offset, lx, ly, gx, gy, deep, zero, zero)
        at = (out + lane)[:, None] * N_CUT + tl.arange(0, N_CUT)[None, :]
        tl.store(cuts + at, cut, drawn[:, None])
    if LIGHT:
        is_lit = tl.where(drawn, tl.load(view + V_LIT), 0.0) > 0.0
        parallel = tl.load(view + V_PARALLEL) > 0.0
        ray = (tl.where(parallel, 0.0, x), tl.where(parallel, 0.0, y), tl.where(parallel, 1.0, z))
        lines = light_lines(columns[2], ray, view)
        slopes = floats_at(tl.load(table_row + A_SLOPES)) + first * 3 + lane * 3
        red, green, blue = three_where(slopes, is_lit)
        if SMOG != NO_SMOG:
            red, green, blue = through * red, through * green, through * blue
        line = lights + out * N_LINES + lane * N_LINES
        tl.store(line, tl.where(is_lit, lines[0], 0.0), drawn)
        tl.store(line + 1, tl.where(is_lit, lines[1], 0.0), drawn)
        tl.store(line + 2, tl.where(is_lit, lines[2], 0.0), drawn)
        tl.store(line + 3, tl.where(is_lit, lines[3], 0.0), drawn)
        tl.store(line + 4, tl.where(is_lit, lines[4], 0.0), drawn)
        tl.store(line + 5, tl.where(is_lit, lines[5], 0.0), drawn)
        tl.store(line + 6, red, drawn)
        tl.store(line + 7, green, drawn)
        tl.store(line + 8, blue, drawn)

    number = (out + lane).to(tl.int32).to(tl.float32, bitcast=True)
    sharp_x, blunt_y = tl.sqrt(1.0 / along * K), tl.sqrt(along * blurred_y * inverse_x / K)
    # In layout's order of fields, those of even number and those of odd number.
    even = _eight(
        mean_x, xy * inverse_y, inverse_y * K, radius_y, xy * inverse_x, z, color[0], color[2]
    )
    odd = _eight(
        mean_y, sharp_x, log_opacity, inverse_x * K, blunt_y, number, color[1],
        zero + tl.load(view + V_SNOW),
    )  # fmt: skip
    record = tl.reshape(tl.join(even, odd), (BLOCK, N_RECORD))
    at = (out + lane)[:, None] * N_RECORD + tl.arange(0, N_RECORD)[None, :]
    tl.store(records + at, record, drawn[:, None])


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
def _eight(a, b, c, d, e, f, g, h):
    """Eight blocks side by side, [B, 8]. The last pairing alternates fastest, the first slowest."""
    even = tl.join(tl.join(a, e), tl.join(c, g))
    odd = tl.join(tl.join(b, f), tl.join(d, h))
    return tl.reshape(tl.join(even, odd), (a.shape[0], 8))
