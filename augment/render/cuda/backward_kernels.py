"""Triton kernels: from the loss's gradient by the image to those of the splats' colours.

The blend is linear in the colours, so its way back is the transposed blend: the same weights,
summed over pixels instead of splats. A tile's share of a splat has a place of its own, and those
places are added up in the order of the tiles; nothing depends on the order in which programs run.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import layout, sh
from augment.render.cuda.splats import TILE

_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_RECORD = tl.constexpr(layout.RECORD)
_MEAN_X, _MEAN_Y = tl.constexpr(layout.MEAN_X), tl.constexpr(layout.MEAN_Y)
_LEAN_X, _SHARP_X = tl.constexpr(layout.LEAN_X), tl.constexpr(layout.SHARP_X)
_FALL_Y, _LOG_OPACITY = tl.constexpr(layout.FALL_Y), tl.constexpr(layout.LOG_OPACITY)
_RED = tl.constexpr(layout.RED)
_V_ROTATION, _V_EYE = tl.constexpr(layout.V_ROTATION), tl.constexpr(layout.V_EYE)
_V_PARALLEL = tl.constexpr(layout.V_PARALLEL)
_C0, _C1 = tl.constexpr(sh.SH_C0), tl.constexpr(sh._C1)
_C2_XY, _C2_ZZ = tl.constexpr(sh._C2_XY), tl.constexpr(sh._C2_ZZ)
_C3_CUBIC, _C3_XYZ = tl.constexpr(sh._C3_CUBIC), tl.constexpr(sh._C3_XYZ)
_C3_ZZ, _C3_ZZZ = tl.constexpr(sh._C3_ZZ), tl.constexpr(sh._C3_ZZZ)


@triton.jit(do_not_specialize=["width", "height", "columns"])
def share_colors(
    records, tile_splat_ids, tile_offsets, d_rgb, shares,
    width, height, columns, alpha_max, log_cut, least, end,
    BATCH: tl.constexpr,
):  # fmt: skip
    """A program a tile: sum over its pixels of weight times dL/d rgb, for each entry of its list.

    d_rgb: float32 [height, width, 3]. shares: float32 [3, entries], zeros; written as far as light
    reaches. alpha_max, log_cut = log2(ALPHA_MIN), least (what a splat must leave more of than this
    to be blended), end (the transmittance at which a pixel is finished): as the forward blend's.
    BATCH entries are looked at at once, all pixels of them, which leaves the products of
    transmittances as the only chain.
    """
    tile = tl.program_id(0)
    entries = tl.load(tile_offsets + tl.num_programs(0)).to(tl.int64)  # three times as many places
    at = tl.load(tile_offsets + tile)
    last = tl.load(tile_offsets + tile + 1)
    pixel = tl.arange(0, _PIXELS)
    column = tile % columns * _TILE + pixel % _TILE
    row = tile // columns * _TILE + pixel // _TILE
    inside = (column < width) & (row < height)
    first = (row * width + column) * 3
    red = tl.load(d_rgb + first, mask=inside, other=0.0)[None, :]
    green = tl.load(d_rgb + first + 1, mask=inside, other=0.0)[None, :]
    blue = tl.load(d_rgb + first + 2, mask=inside, other=0.0)[None, :]
    x = (column.to(tl.float32) + 0.5)[None, :]
    y = (row.to(tl.float32) + 0.5)[None, :]
    transmittance = tl.where(inside, 1.0, 0.0)
    while (at < last) & (tl.max(transmittance, 0) > end):
        entry = at + tl.arange(0, BATCH)
        listed = entry < last
        record = (
            records + tl.load(tile_splat_ids + entry, mask=listed, other=0).to(tl.int64) * _RECORD
        )
        log_opacity = tl.load(record + _LOG_OPACITY, mask=listed, other=float("-inf"))[:, None]
        mean_x = tl.load(record + _MEAN_X, mask=listed, other=0.0)[:, None]
        mean_y = tl.load(record + _MEAN_Y, mask=listed, other=0.0)[:, None]
        sharp = tl.load(record + _SHARP_X, mask=listed, other=0.0)[:, None]
        lean = tl.load(record + _LEAN_X, mask=listed, other=0.0)[:, None]
        fall = tl.load(record + _FALL_Y, mask=listed, other=0.0)[:, None]
        dy = y - mean_y
        off = sharp * (x - mean_x - lean * dy)
        e = log_opacity - off * off - fall * dy * dy
        alpha = tl.where(e >= log_cut, tl.minimum(tl.exp2(e), alpha_max), 0.0)
        passed = 1 - alpha
        after = transmittance[None, :] * tl.cumprod(passed, 0)
        before = after / passed  # what is not kept may be 0 / 0
        kept = (after > least) & (before > end)
        weight = tl.where(kept, alpha * before, 0.0)
        tl.store(shares + entry, tl.sum(weight * red, 1), mask=listed)
        tl.store(shares + entries + entry, tl.sum(weight * green, 1), mask=listed)
        tl.store(shares + 2 * entries + entry, tl.sum(weight * blue, 1), mask=listed)
        transmittance = tl.min(after, 0)
        at += BATCH


@triton.jit(do_not_specialize=["count", "entries"])
def sum_shares(
    shares, order, firsts, records, d_colors, count, entries,
    SPLATS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """dL by every splat's colour before its clamp at 0, float32 [count, 3].

    order: int64 [entries], list entries splat by splat, in the order of the tiles. firsts: int64
    [count + 1], where each splat's begin in it. A splat's entries go to LANES sums in turn, which
    are then added as a tree.
    """
    splat = tl.program_id(0).to(tl.int64) * SPLATS + tl.arange(0, SPLATS)
    is_one = splat < count
    first = tl.load(firsts + splat, mask=is_one, other=0)
    last = tl.load(firsts + splat + 1, mask=is_one, other=0)
    red = tl.zeros([SPLATS, LANES], tl.float32)
    green = tl.zeros([SPLATS, LANES], tl.float32)
    blue = tl.zeros([SPLATS, LANES], tl.float32)
    longest = tl.max(last - first, 0)
    place = first[:, None] + tl.arange(0, LANES)[None, :]
    done = longest * 0
    while done < longest:
        own = place < last[:, None]
        entry = tl.load(order + place, mask=own, other=0)
        red += tl.load(shares + entry, mask=own, other=0.0)
        green += tl.load(shares + entries + entry, mask=own, other=0.0)
        blue += tl.load(shares + 2 * entries + entry, mask=own, other=0.0)
        place += LANES
        done += LANES
    for channel in tl.static_range(3):
        total = red if channel == 0 else (green if channel == 1 else blue)
        # Records of splats that are not drawn hold anything; their sums are 0 either way.
        color = tl.load(records + splat * _RECORD + _RED + channel, mask=is_one, other=0.0)
        passed = tl.where(color > 0, tl.sum(total, 1), 0.0)
        tl.store(d_colors + splat * 3 + channel, passed, mask=is_one)


@triton.jit(do_not_specialize=["count", "used"])
def spread_to_sh(
    means, view, d_colors, d_sh, count, used,
    SPLATS: tl.constexpr, VALUES: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """dL by spherical harmonics: basis functions at each splat's direction times dL by its colour.

    means: [count, 3] of one part; view: its numbers (layout's V_*). d_sh: float32 [count, VALUES],
    VALUES = 3 K, filled; 0 in functions from `used` on. COLUMNS: VALUES or the power of two above.
    """
    splat = tl.program_id(0).to(tl.int64) * SPLATS + tl.arange(0, SPLATS)
    is_one = splat < count
    x, y, z = tl.load(view + _V_EYE), tl.load(view + _V_EYE + 1), tl.load(view + _V_EYE + 2)
    rest_x, rest_y = tl.load(view + _V_EYE + 3), tl.load(view + _V_EYE + 4)
    rest_z = tl.load(view + _V_EYE + 5)
    x = tl.load(means + splat * 3, mask=is_one, other=0.0) - x - rest_x
    y = tl.load(means + splat * 3 + 1, mask=is_one, other=0.0) - y - rest_y
    z = tl.load(means + splat * 3 + 2, mask=is_one, other=1.0) - z - rest_z
    parallel = tl.load(view + _V_PARALLEL) != 0
    x = tl.where(parallel, tl.load(view + _V_ROTATION + 6), x)
    y = tl.where(parallel, tl.load(view + _V_ROTATION + 7), y)
    z = tl.where(parallel, tl.load(view + _V_ROTATION + 8), z)
    # Scaled first: a square of metres must neither overflow nor vanish.
    size = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    scale = tl.where(size > 0, 1 / size, 0.0)
    x, y, z = x * scale, y * scale, z * scale
    length = tl.sqrt(tl.maximum(x * x + y * y + z * z, 1e-30))
    x, y, z = (x / length)[:, None], (y / length)[:, None], (z / length)[:, None]
    xx, yy, zz = x * x, y * y, z * z
    column = tl.arange(0, COLUMNS)[None, :]
    k, channel = column // 3, column % 3
    basis = tl.where(k == 0, _C0, 0.0)
    if VALUES > 3:
        basis = tl.where(k == 1, -_C1 * y, basis)
        basis = tl.where(k == 2, _C1 * z, basis)
        basis = tl.where(k == 3, -_C1 * x, basis)
    if VALUES > 12:
        basis = tl.where(k == 4, _C2_XY * x * y, basis)
        basis = tl.where(k == 5, -_C2_XY * y * z, basis)
        basis = tl.where(k == 6, _C2_ZZ * (2 * zz - xx - yy), basis)
        basis = tl.where(k == 7, -_C2_XY * x * z, basis)
        basis = tl.where(k == 8, 0.5 * _C2_XY * (xx - yy), basis)
    if VALUES > 27:
        basis = tl.where(k == 9, -_C3_CUBIC * y * (3 * xx - yy), basis)
        basis = tl.where(k == 10, _C3_XYZ * x * y * z, basis)
        basis = tl.where(k == 11, -_C3_ZZ * y * (4 * zz - xx - yy), basis)
        basis = tl.where(k == 12, _C3_ZZZ * z * (2 * zz - 3 * xx - 3 * yy), basis)
        basis = tl.where(k == 13, -_C3_ZZ * x * (4 * zz - xx - yy), basis)
        basis = tl.where(k == 14, 0.5 * _C3_XYZ * z * (xx - yy), basis)
        basis = tl.where(k == 15, -_C3_CUBIC * x * (xx - 3 * yy), basis)
    own = is_one[:, None] & (column < VALUES)
    basis = tl.where(k < used, basis, 0.0)
    color = tl.load(d_colors + splat[:, None] * 3 + channel, mask=own, other=0.0)
    tl.store(d_sh + splat[:, None] * VALUES + column, basis * color, mask=own)
