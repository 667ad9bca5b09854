"""Triton kernel that splits near discs of snow into finer ones, as `close_kernels` does.

Places are taken from the eye, so that float32 tells a texel of the noise wherever in the world the
eye stands.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.effects.snow import close_layout
from augment.effects.snow import kernels as close_kernels
from augment.effects.snow import near_camera as close
from augment.render.cuda.project_kernels import (
    dot,
    four_where,
    rotation_columns,
    three,
    three_where,
)
from augment.render.sh import SH_C0

C0 = tl.constexpr(SH_C0)
REACH, SPREAD = tl.constexpr(close_kernels.REACH), tl.constexpr(close_kernels.SPREAD)
FARTHEST_M = tl.constexpr(close_kernels.FARTHEST_M)
TEXELS = tl.constexpr(1.0 / close_kernels.TEXEL_M)  # per metre
COARSER = tl.constexpr(close_kernels.COARSER)
CRUMB, CLOD = tl.constexpr(close_kernels.CRUMB), tl.constexpr(close_kernels.CLOD)
TABLE = tl.constexpr(close.TABLE)
N_ROTATION, N_EYE = tl.constexpr(close_layout.N_ROTATION), tl.constexpr(close_layout.N_EYE)
N_LIMITS, N_FINEST = tl.constexpr(close_layout.N_LIMITS), tl.constexpr(close_layout.N_FINEST)
N_RELIEF, N_MOTTLE = tl.constexpr(close_layout.N_RELIEF), tl.constexpr(close_layout.N_MOTTLE)
N_SUN, N_CRUMB = tl.constexpr(close_layout.N_SUN), tl.constexpr(close_layout.N_CRUMB)
N_CLOD = tl.constexpr(close_layout.N_CLOD)
R_FIRST, R_COUNT = tl.constexpr(close_layout.R_FIRST), tl.constexpr(close_layout.R_COUNT)
R_SPLITS, R_SLOT = tl.constexpr(close_layout.R_SPLITS), tl.constexpr(close_layout.R_SLOT)
ROW = tl.constexpr(close_layout.ROW)


@triton.jit
def split_discs(
    rows, numbers, order, noise, means, quats, scales, opacities, sh, slopes,
    left, fine_means, fine_quats, fine_scales, fine_opacities, fine_sh, fine_slopes,
    LIT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One finer disc of every disc of a block: program (b, p) writes the p-th of block b's.

    rows int32 [B, ROW], numbers: see close_layout. order int32 [S]: of the discs. noise [TABLE,
    TABLE]. left: opacities of the whole discs, 0 written for those that are split. Of a block's
    finer discs the first of all come first; of those that are none the opacity is 0. slopes: read
    and written where LIT.
    """
    row, piece = rows + tl.program_id(0) * ROW, tl.program_id(1)
    most = tl.load(row + R_SPLITS)
    if piece < most * most:
        count, lane = tl.load(row + R_COUNT), tl.arange(0, BLOCK)
        inside = lane < count
        disc = tl.load(order + tl.load(row + R_FIRST) + lane, inside, 0)
        eye, rest = three(numbers + N_EYE), three(numbers + N_EYE + 3)
        mx, my, mz = three_where(means + disc * 3, inside)
        x, y, z = mx - eye[0] - rest[0], my - eye[1] - rest[1], mz - eye[2] - rest[2]
        wide, deep, thick = three_where(scales + disc * 3, inside)
        wide, deep, finest = wide * REACH, deep * REACH, tl.load(numbers + N_FINEST)
        far = tl.sqrt(dot((x, y, z), (x, y, z)))
        side = tl.maximum(wide, deep)
        splits = _splits(x, y, z, far, side, finest, most, inside, numbers)
        kept = piece < splits * splits
        if piece == 0:
            tl.store(left + disc, 0.0, kept)

        columns = rotation_columns(four_where(quats + disc * 4, kept))
        by_three = splits == 3
        n = tl.where(by_three, 3.0, 2.0)
        j = tl.where(by_three, piece // 3, piece // 2)
        k = tl.where(by_three, piece % 3, piece % 2)
        p = ((j.to(tl.float32) + 0.5) / n - 0.5) * (wide / SPREAD)
        q = ((k.to(tl.float32) + 0.5) / n - 0.5) * (deep / SPREAD)
        u, v = columns[0], columns[1]
        dx, dy, dz = p * u[0] + q * v[0], p * u[1] + q * v[1], p * u[2] + q * v[2]

        fade = tl.minimum(tl.maximum(2.0 * (1.0 - far / FARTHEST_M), 0.0), 1.0)
        # 0 where discs grow whole again
        fade *= tl.minimum(tl.maximum(2.0 * side / (finest * far) - 3.0, 0.0), 1.0)
        sx, sy = tl.load(numbers + N_SUN), tl.load(numbers + N_SUN + 1)
        px, py, pz = x + dx, y + dy, z + dz
        behind = _grain(px - sx, py - sy, pz, kept, numbers, noise)
        sunward = _grain(px + sx, py + sy, pz, kept, numbers, noise)
        bright = tl.load(numbers + N_RELIEF) * (behind - sunward)
        bright += 0.5 * tl.load(numbers + N_MOTTLE) * (behind + sunward)
        factor = 1.0 + fade * bright

        slot = tl.load(row + R_SLOT) + piece * count + lane
        tl.store(fine_opacities + slot, tl.load(opacities + disc, kept, 0.0), inside)
        _store_three(fine_means + slot * 3, (mx + dx, my + dy, mz + dz), inside)
        _store_three(fine_scales + slot * 3, (wide / n, deep / n, thick), inside)
        for axis in tl.static_range(4):
            tl.store(fine_quats + slot * 4 + axis, tl.load(quats + disc * 4 + axis, inside), inside)
        red, green, blue = three_where(sh + disc * 3, inside)
        shades = (_shade(red, factor), _shade(green, factor), _shade(blue, factor))
        _store_three(fine_sh + slot * 3, shades, inside)
        if LIT:
            red, green, blue = three_where(slopes + disc * 3, inside)
            _store_three(fine_slopes + slot * 3, (red * factor, green * factor, blue * factor),
                         inside)  # fmt: skip


@triton.jit
def _splits(x, y, z, far, side, finest, most, inside, numbers):
    """Into how many discs along a side each is split; 0 where it stays whole."""
    place, rotation, limits = (x, y, z), numbers + N_ROTATION, numbers + N_LIMITS
    right, down = dot(three(rotation), place), dot(three(rotation + 3), place)
    away = dot(three(rotation + 6), place)
    seen = inside & (away > 0.0) & (far < FARTHEST_M)
    seen &= (right >= tl.load(limits) * away) & (right <= tl.load(limits + 1) * away)
    seen &= (down >= tl.load(limits + 2) * away) & (down <= tl.load(limits + 3) * away)
    splits = tl.minimum(tl.floor(side / (finest * far) + 0.5), most.to(tl.float32))
    return tl.where(seen & (splits > 1.0), splits, 0.0).to(tl.int32)


@triton.jit
def _grain(x, y, z, mask, numbers, noise):
    """The noise that the grain follows, at a place from the eye in metres: two scales of one table.

    Half a texel of a turn is no whole number of tables, so the eye has a place in it for each.
    """
    u, v = (x + 0.7 * z) * TEXELS, (y + 0.7 * z) * TEXELS
    crumb = _texel(u, v, mask, numbers + N_CRUMB, noise)
    u, v = (0.8 * u - 0.6 * v) * COARSER, (0.6 * u + 0.8 * v) * COARSER
    clod = _texel(u, v, mask, numbers + N_CLOD, noise)
    return crumb * CRUMB + clod * CLOD


@triton.jit
def _texel(u, v, mask, start, noise):
    row = tl.floor(u + tl.load(start)).to(tl.int32) & (TABLE - 1)
    column = tl.floor(v + tl.load(start + 1)).to(tl.int32) & (TABLE - 1)
    return tl.load(noise + row * TABLE + column, mask, 0.0)


@triton.jit
def _shade(sh, factor):
    return (factor * (sh * C0 + 0.5) - 0.5) / C0


@triton.jit
def _store_three(pointer, values, mask):
    tl.store(pointer, values[0], mask)
    tl.store(pointer + 1, values[1], mask)
    tl.store(pointer + 2, values[2], mask)
