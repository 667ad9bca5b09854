"""Triton kernels that march mirrored rays through a pyramid of the nearest depth.

The letters are those of `screen_space`, which defines the result; the pyramid, the view's numbers
and the steps are those of `screen_space_kernels`. Every ray is marched: where a CPU traces some and
interpolates, a GPU would wait for the rays that are left.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.effects.flood import kernels as cpu
from augment.effects.flood import water_plane as plane_rows

# ---- Triton kernel for the water's normals at every pixel of a camera ----------------------------
# As in `waves_kernels`, stretches of a row share an anchor pixel that float64 has placed, here on
# the
# host; n counts columns from it, s is the way to the plane at unit depth, and A the horizontal
# step:
#
#     p = p0 + s n A
#
# A wave's turns at the anchor are p0 times its turns per metre, hundreds of turns of which only the
# fraction counts. Both come as sums of a float32 of 12 significant bits and a rest, so that float32
# holds the product of the large parts exactly, whose fraction is all that is kept of it.

# Numbers of a stretch of a row: its pixels that meet the plane, the anchor, the anchor's ray, the
# step A, the constant part of the step per row, p0 (of each coordinate the large part, the rest).
BEGIN, END, ANCHOR, X, Y, Z, STEP_X, STEP_Y, DROP_X, DROP_Y = range(10)
PLACE_X, REST_X, PLACE_Y, REST_Y = range(10, 14)
STRETCH = 16
# Numbers of a wave: turns per metre of x and y (as above), turns at the eye, tangents' terms.
TURN_X, TURN_REST_X, TURN_Y, TURN_REST_Y, TURNS, TERMS = range(6)
WAVE = 12

_BEGIN, _END, _ANCHOR = tl.constexpr(BEGIN), tl.constexpr(END), tl.constexpr(ANCHOR)
_RAY, _STEP, _DROP = tl.constexpr(X), tl.constexpr(STEP_X), tl.constexpr(DROP_X)
_PLACE, _STRETCH, _WAVE = tl.constexpr(PLACE_X), tl.constexpr(STRETCH), tl.constexpr(WAVE)
_TURNS, _TERMS = tl.constexpr(TURNS), tl.constexpr(TERMS)
_S0, _S1, _S2, _S3, _S4 = (tl.constexpr(float(c)) for c in cpu.SINE)
_C0, _C1, _C2, _C3, _C4 = (tl.constexpr(float(c)) for c in cpu.COSINE)
_TINY = tl.constexpr(float(cpu.TINY))


@triton.jit
def _sin_cos(turns):
    """sin and cos of 2 pi turns, off by less than 4e-7 beside what turns is off."""
    r = turns - tl.floor(turns + 0.5)
    z = r * r
    s = ((((_S4 * z + _S3) * z + _S2) * z + _S1) * z + _S0) * r
    c = (((_C4 * z + _C3) * z + _C2) * z + _C1) * z + _C0
    twice = s + s
    return twice * c, 1.0 - twice * s


@triton.jit
def _fraction(x):
    return x - tl.floor(x)


@triton.jit(do_not_specialize=["count", "width", "per_row"])
def fill_field(
    stretches, waves, count, width, per_row, height, step_z, bend_x, bend_y, upright, gone, full,
    normal_x, normal_y, variance, LANES: tl.constexpr,
):  # fmt: skip
    """Normals and slope variance of the pixels of a camera; 0 where their rays miss the plane.

    One program a stretch of LANES columns. stretches [H, per_row, STRETCH], waves [count, WAVE]:
    lines as above. height: of the eye over the plane. step_z: change of the ray's z per column.
    bend: the linear part of the step per row. upright: horizontal part of a ray below which it is
    vertical. gone, full: lengths in pixels at which a wave is gone, and at full height.
    """
    pid = tl.program_id(0)
    line = stretches + pid * _STRETCH
    columns = (pid % per_row) * LANES + tl.arange(0, LANES)
    begin, end = tl.load(line + _BEGIN), tl.load(line + _END)
    x0, y0, z0 = tl.load(line + _RAY), tl.load(line + _RAY + 1), tl.load(line + _RAY + 2)
    ax, ay = tl.load(line + _STEP), tl.load(line + _STEP + 1)
    drop_x, drop_y = tl.load(line + _DROP), tl.load(line + _DROP + 1)
    place_x, rest_x = tl.load(line + _PLACE), tl.load(line + _PLACE + 1)
    place_y, rest_y = tl.load(line + _PLACE + 2), tl.load(line + _PLACE + 3)
    column = columns.to(tl.float32)
    meets = (column >= begin) & (column < end)
    n = tl.where(meets, column - tl.load(line + _ANCHOR), 0.0)
    inverse = 1.0 / (step_z * n + z0)
    away = -height * inverse
    dense = 1.0 / tl.abs(away * inverse)
    way = away * n
    # A column is a step of the image's first axis: rays go on by it.
    dx = x0 + n * (ax + step_z / z0 * x0)
    dy = y0 + n * (ay + step_z / z0 * y0)
    length = tl.sqrt(dx * dx + dy * dy)
    slanted = length >= upright
    vx, vy = tl.where(slanted, dx / length, 1.0), tl.where(slanted, dy / length, 0.0)
    rise = 1.0 / (full - gone)
    xx = tl.zeros([LANES], tl.float32)
    xy, yy, gx, gy, lost = xx, xx, xx, xx, xx
    for i in range(tl.where(begin < end, count, 0)):
        wave = waves + i * _WAVE
        kx, ky = tl.load(wave), tl.load(wave + 2)
        fine_x, fine_y = tl.load(wave + 1), tl.load(wave + 3)
        turns = _fraction(place_x * kx) + _fraction(place_y * ky) + tl.load(wave + _TURNS)
        fine = place_x * fine_x + place_y * fine_y
        kx, ky = kx + fine_x, ky + fine_y
        turns = _fraction(turns + (fine + (rest_x * kx + rest_y * ky)))
        along = kx * ax + ky * ay
        side = along * z0
        down = (kx * drop_x + ky * drop_y) + (kx * bend_x + ky * bend_y) * n
        # The wave's length in pixels is that over the metres (in turns) of a pixel's step.
        pixels = dense * tl.rsqrt(tl.maximum(down * down + side * side, 1e-36))
        t = tl.minimum(tl.maximum((pixels - gone) * rise, 0.0), 1.0)
        weight = t * t * (3.0 - t - t)
        sine, cosine = _sin_cos(along * way + turns)
        sine, cosine = weight * sine, weight * cosine
        xx += tl.load(wave + _TERMS) * sine
        xy += tl.load(wave + _TERMS + 1) * sine
        yy += tl.load(wave + _TERMS + 2) * sine
        slope_x, slope_y = tl.load(wave + _TERMS + 3), tl.load(wave + _TERMS + 4)
        gx += slope_x * cosine
        gy += slope_y * cosine
        slope = slope_x * vx + slope_y * vy
        lost += (0.5 * (1.0 - weight * weight)) * (slope * slope)
    wide, deep = 1.0 - xx, 1.0 - yy
    nx, ny = -(xy * gy + deep * gx), -(xy * gx + wide * gy)
    nz = tl.maximum(wide * deep - xy * xy, 0.0)
    scale = 1.0 / tl.sqrt(tl.maximum(nx * nx + ny * ny + nz * nz, _TINY))
    pixels = (pid // per_row) * width + columns
    inside = columns < width
    tl.store(normal_x + pixels, tl.where(meets, nx * scale, 0.0), mask=inside)
    tl.store(normal_y + pixels, tl.where(meets, ny * scale, 0.0), mask=inside)
    tl.store(variance + pixels, tl.where(meets, tl.maximum(lost, 0.0), 0.0), mask=inside)


# ------------------------------------------------------------------------------------------------
# What Triton kernels read of the rows of an image that sees the water's plane (`plane_rows`)

_ROW_BEGIN, _ROW_END = (tl.constexpr(plane_rows.BEGIN), tl.constexpr(plane_rows.END))
_ROW_ANCHOR, _FALL = tl.constexpr(plane_rows.ANCHOR), tl.constexpr(plane_rows.FALL)
_ROW = tl.constexpr(plane_rows.ROW)


@triton.jit
def falls(rows, row, column, mask):
    """Whether the rays of pixels fall, of an image with these rows [H, 4]."""
    line = rows + row * _ROW
    begin = tl.load(line + _ROW_BEGIN, mask=mask, other=0)
    return mask & (column >= begin) & (column < tl.load(line + _ROW_END, mask=mask, other=0))


@triton.jit
def fall_of(rows, row, column, per_column, mask):
    """World z of falling rays, unit z in the camera. per_column: its change; -1 outside mask."""
    line = rows + row * _ROW
    nearest = tl.load(line + _FALL, mask=mask, other=0).to(tl.float32, bitcast=True)
    away = column - tl.load(line + _ROW_ANCHOR, mask=mask, other=0)
    return tl.where(mask, nearest + away.to(tl.float32) * per_column, -1.0)


# ---- Triton kernels that put the layers of a flooded view together: what `pour` defines ----------
# Programs take LANES pixels one after the other, row by row.


@triton.jit
def find_water(rows, alpha, width, count, shown, water, LANES: tl.constexpr):
    """water [H, W] uint8: 1 where a ray falls and alpha leaves more than half of it, else 0.

    shown [programs]: the largest share of a falling ray that alpha leaves in each, 0 where none
    falls. count: of pixels.
    """
    program = tl.program_id(0)
    pixel = program * LANES + tl.arange(0, LANES)
    inside = pixel < count
    row = pixel // width
    share = 1.0 - tl.load(alpha + pixel, mask=inside, other=1.0)
    share = tl.where(falls(rows, row, pixel - row * width, inside), share, 0.0)
    tl.store(water + pixel, (share > 0.5).to(tl.uint8), mask=inside)
    tl.store(shown + program, tl.max(share, 0))


@triton.jit(do_not_specialize=["dry", "left", "top", "right", "bottom"])
def composite_water(
    rows, alpha, color, sky, dry, left, top, right, bottom, width, count, rgb, LANES: tl.constexpr
):
    """rgb [H, W, 3] += (1 - alpha) color where rays fall; elsewhere it becomes that of `sky`.

    color: [h, w, 3], of the rows top to bottom - 1 and columns left to right - 1, which contain all
    pixels whose rays fall. sky: the first `dry` rows, which contain all whose rays do not.
    """
    pixel = tl.program_id(0) * LANES + tl.arange(0, LANES)
    inside = pixel < count
    row = pixel // width
    column = pixel - row * width
    wet = falls(rows, row, column, inside)
    wet = wet & (row >= top) & (row < bottom) & (column >= left) & (column < right)
    rest = inside & (wet == 0) & (row < dry)
    through = 1.0 - tl.load(alpha + pixel, mask=wet, other=0.0)
    own = 3 * ((row - top) * (right - left) + (column - left))
    for channel in tl.static_range(3):
        at = 3 * pixel + channel
        seen = tl.load(rgb + at, mask=wet, other=0.0)
        seen += through * tl.load(color + own + channel, mask=wet, other=0.0)
        seen = tl.where(wet, seen, tl.load(sky + at, mask=rest, other=0.0))
        tl.store(rgb + at, seen, mask=wet | rest)


@triton.jit(
    do_not_specialize=[
        "left", "top", "behind_left", "behind_top", "wide", "count", "behind_width"
    ]
)  # fmt: skip
def join(
    alpha, behind_alpha, depth, behind_depth, a, behind_a, b, behind_b, c, behind_c, d, behind_d,
    least, left, top, behind_left, behind_top, wide, count, width, behind_width,
    HAS_DEPTH: tl.constexpr, OTHERS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Buffers of two layers as one scene's, in place, where a window behind lies over the image.

    alpha, depth (expected): of both together. a to d: OTHERS buffers of 32 bits, which become those
    of the layer that covers more of a pixel. wide, count: columns and pixels that both share, whose
    first is (left, top) in the image and (behind_left, behind_top) behind.
    """
    shared = tl.program_id(0) * LANES + tl.arange(0, LANES)
    inside = shared < count
    row = shared // wide
    column = shared - row * wide
    here = (row + top) * width + column + left
    there = (row + behind_top) * behind_width + column + behind_left
    own = tl.load(alpha + here, mask=inside, other=0.0)
    share = (1.0 - own) * tl.load(behind_alpha + there, mask=inside, other=0.0)
    if HAS_DEPTH:
        total = own * tl.load(depth + here, mask=inside, other=0.0)
        total += share * tl.load(behind_depth + there, mask=inside, other=0.0)
        tl.store(depth + here, total / tl.maximum(own + share, least), mask=inside)
    hidden = inside & (share > own)
    if OTHERS > 0:
        tl.store(a + here, tl.load(behind_a + there, mask=hidden, other=0), mask=hidden)
    if OTHERS > 1:
        tl.store(b + here, tl.load(behind_b + there, mask=hidden, other=0), mask=hidden)
    if OTHERS > 2:
        tl.store(c + here, tl.load(behind_c + there, mask=hidden, other=0), mask=hidden)
    if OTHERS > 3:
        tl.store(d + here, tl.load(behind_d + there, mask=hidden, other=0), mask=hidden)
    tl.store(alpha + here, own + share, mask=inside)


# ---- cuda screen kernels -------------------------------------------------------------------------

LEVELS, BLOCK = cpu.LEVELS, cpu.BLOCK

_BLOCK, _LEVELS = tl.constexpr(BLOCK), tl.constexpr(LEVELS)
_COVERED, _THICKNESS_M = tl.constexpr(float(cpu.COVERED)), tl.constexpr(float(cpu.THICKNESS_M))
_THICKNESS, _HIDDEN_PX = tl.constexpr(float(cpu.THICKNESS)), tl.constexpr(float(cpu.HIDDEN_PX))
_NEAR_M, _AGREEING = tl.constexpr(float(cpu.NEAR_M)), tl.constexpr(float(cpu.AGREEING))
_EDGE, _NUDGE = tl.constexpr(float(cpu.EDGE)), tl.constexpr(float(cpu.NUDGE))
_FARTHEST, _MAX_STEPS = tl.constexpr(float(cpu.FARTHEST)), tl.constexpr(cpu.MAX_STEPS)
_AT_ONCE = tl.constexpr(4)  # steps before a program asks whether any of its rays still goes on
_INFINITE = tl.constexpr(float("inf"))


@triton.jit
def _store_cells(value, pyramid, rows, columns, tile_y, tile_x, SIZE: tl.constexpr):
    """A tile's cells of a level above the pixels: SIZE along a side."""
    pitch = columns + columns // 4
    first = rows - rows * SIZE * 4 // _BLOCK
    row = first + tile_y * SIZE + tl.arange(0, SIZE)
    column = columns + tile_x * SIZE + tl.arange(0, SIZE)
    tl.store(pyramid + row[:, None] * pitch + column[None, :], value)


@triton.jit
def _largest(value, SIZE: tl.constexpr):
    """Of each 4 x 4 of 4 SIZE x 4 SIZE numbers."""
    return tl.max(tl.max(tl.reshape(value, (SIZE, 4, SIZE, 4)), 1), 2)


@triton.jit
def build_pyramid(alpha, depth, width, height, rows, columns, pyramid):
    """Largest inverse depths of the front's solid pixels, in pyramid [rows, columns * 5 / 4]."""
    tile_y, tile_x = tl.program_id(0) // (columns // _BLOCK), tl.program_id(0) % (columns // _BLOCK)
    row, column = tile_y * _BLOCK + tl.arange(0, _BLOCK), tile_x * _BLOCK + tl.arange(0, _BLOCK)
    inside = (row < height)[:, None] & (column < width)[None, :]
    pixel = row[:, None] * width + column[None, :]
    solid = tl.load(alpha + pixel, mask=inside, other=0.0) >= 0.5
    nearest = tl.where(solid, 1.0 / tl.load(depth + pixel, mask=solid, other=1.0), 0.0)
    pitch = columns + columns // 4
    tl.store(pyramid + row[:, None] * pitch + column[None, :], nearest)
    for level in tl.static_range(1, _LEVELS + 1):
        nearest = _largest(nearest, _BLOCK >> (2 * level))
        _store_cells(nearest, pyramid, rows, columns, tile_y, tile_x, _BLOCK >> (2 * level))


@triton.jit
def _step(pyramid, rows, columns, x0, y0, dx, dy, inverse_x, inverse_y, near, change, end, t, stop,
          size, hidden, clean, met):  # fmt: skip
    """Rays look into one cell each, and pass it or go into its parts.

    t, the t to stop at, the cell's size, pixels spent behind something without a break, whether
    there were none ever, whether something is met.
    """
    inverse = 1.0 / size
    going = t < stop
    cell_x, cell_y = tl.floor((t * dx + x0) * inverse), tl.floor((t * dy + y0) * inverse)
    above_pixels = size > 1.0
    level_row = tl.where(above_pixels, rows - rows * 4.0 * inverse, 0.0)
    level_column = tl.where(above_pixels, columns, 0.0)
    pitch = (columns * 1.25).to(tl.int32)
    cell = (cell_y + level_row).to(tl.int32) * pitch + (cell_x + level_column).to(tl.int32)
    cell = tl.minimum(tl.maximum(cell, 0), rows.to(tl.int32) * pitch - 1)
    surface = tl.load(pyramid + cell, mask=going, other=0.0)
    ahead_x = tl.where(inverse_x >= 0.0, 1.0, 0.0)
    ahead_y = tl.where(inverse_y >= 0.0, 1.0, 0.0)
    leave_x = ((cell_x + ahead_x) * size - x0) * inverse_x
    leave_y = ((cell_y + ahead_y) * size - y0) * inverse_y
    leave = tl.maximum(tl.minimum(tl.minimum(leave_x, leave_y), end), t)
    beyond = leave + _NUDGE
    # Up only out of the parent, which has been looked into already.
    above = inverse * 0.25
    other_x = tl.floor((beyond * dx + x0) * above) != tl.floor(cell_x * 0.25)
    other_y = tl.floor((beyond * dy + y0) * above) != tl.floor(cell_y * 0.25)
    climbs = (size < _BLOCK) & (other_x | other_y)
    k0, k1 = near - change * t, near - change * leave
    reached = going & (surface >= tl.maximum(tl.minimum(k0, k1), _FARTHEST))
    thick = tl.maximum(_THICKNESS, _THICKNESS_M * surface)
    entered = tl.maximum(k0, k1) * (1.0 + thick) >= surface
    pixel = reached & (size <= 1.0)
    hit = pixel & entered
    clean = clean & ((pixel == 0) | entered)
    hidden = tl.where(pixel, hidden + (leave - t), tl.where(reached, hidden, 0.0))
    stop = tl.where(hit | (hidden > _HIDDEN_PX), -1.0, stop)
    goes_in = reached & (size > 1.0)
    t = tl.where(going & (hit == 0) & (goes_in == 0), beyond, t)
    size = tl.where(reached, tl.maximum(size * 0.25, 1.0), tl.where(climbs, size * 4.0, size))
    return t, stop, size, hidden, clean, met | hit


@triton.jit
def _difference(before, here, after, has_before, has_after):
    """Change of the inverse depth per pixel, from those neighbours that belong to the surface."""
    follows = has_after & (tl.abs(after - here) < _AGREEING * here)
    leads = has_before & (tl.abs(here - before) < _AGREEING * here)
    total = tl.where(follows, after - here, 0.0) + tl.where(leads, here - before, 0.0)
    return total / tl.where(follows & leads, 2.0, 1.0)


@triton.jit
def _meet(pyramid, pitch, width, height, x0, y0, dx, dy, t, change, near, met):
    """t / k and t where rays, of inverse depth k, meet the plane through the pixel found at t.

    At most 1 px off that pixel.
    """
    cx = tl.minimum(tl.maximum((x0 + t * dx).to(tl.int32), 0), width - 1)
    cy = tl.minimum(tl.maximum((y0 + t * dy).to(tl.int32), 0), height - 1)
    at = pyramid + cy * pitch + cx
    has_left, has_right = met & (cx > 0), met & (cx < width - 1)
    has_above, has_below = met & (cy > 0), met & (cy < height - 1)
    here = tl.load(at, mask=met, other=0.0)
    left = tl.load(at - 1, mask=has_left, other=0.0)
    right = tl.load(at + 1, mask=has_right, other=0.0)
    across = _difference(left, here, right, has_left, has_right)
    above = tl.load(at - pitch, mask=has_above, other=0.0)
    below = tl.load(at + pitch, mask=has_below, other=0.0)
    down = _difference(above, here, below, has_above, has_below)
    off_x, off_y = cx.to(tl.float32) + 0.5 - x0, cy.to(tl.float32) + 0.5 - y0
    closing = -change - across * dx - down * dy
    middle = tl.where(tl.abs(dx) >= tl.abs(dy), off_x * dx, off_y * dy)
    closes = closing != 0.0
    meet = (here - across * off_x - down * off_y - near) / tl.where(closes, closing, 1.0)
    meet = tl.where(closes, meet, middle)
    meet = tl.maximum(tl.minimum(tl.maximum(meet, middle - 1.5), middle + 1.5), 0.0)
    # Not farther than what was met, however the ray grazes it.
    back = here / (1.0 + tl.maximum(_THICKNESS, _THICKNESS_M * here))
    return meet / tl.maximum(near - change * meet, tl.maximum(back, 1e-30)), meet


@triton.jit
def _edge_weight(at, size):
    inner = tl.minimum(tl.maximum(tl.minimum(at, size - at) / (_EDGE * size), 0.0), 1.0)
    return inner * inner * (3.0 - 2.0 * inner)


@triton.jit(do_not_specialize=["left", "top", "wide", "high", "across"])
def trace(
    pyramid, rows, alpha, needed, left, top, wide, high, across, width, height, pyramid_rows,
    pyramid_columns, per_column, up_x, up_y, up_z, image_x, image_y, fx, fy, cx, cy, eye_height,
    distance, weight, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """Metres and weights of the mirrored rays of a window's pixels, [high, wide].

    rows: of `plane_rows`, the window's. alpha: of the whole image, width and height its size.
    needed: bytes of the window. up: the vertical in the camera; image: its image N; per_column:
    change of a ray's world z. across: programs that share the window's width, each WIDE columns and
    HIGH rows.
    """
    lane, pid = tl.arange(0, WIDE * HIGH), tl.program_id(0)
    i = (pid // across) * HIGH + lane // WIDE
    j = (pid % across) * WIDE + lane % WIDE
    inside = (i < high) & (j < wide)
    own = i * wide + j
    column, row = j + left, i + top
    shown = inside & (tl.load(needed + own, mask=inside, other=0) != 0)
    shown = shown & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    shown = shown & (tl.load(alpha + row * width + column, mask=shown, other=1.0) < _COVERED)
    shown = falls(rows, i, j, shown)
    slope = fall_of(rows, i, j, per_column, shown)

    x0, y0 = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    gx, gy = image_x - x0 * up_z, image_y - y0 * up_z
    g = tl.maximum(tl.maximum(tl.abs(gx), tl.abs(gy)), 1e-9)  # 0 at the point below the eye
    scale = -2.0 * slope * g
    bend = (1.0 - 2.0 * slope * up_z) / scale
    near = -slope / eye_height
    dx, dy = gx / g, gy / g
    # A ray along an axis never gets to the other axis's next border.
    inverse_x = 1.0 / tl.where(tl.abs(dx) > 1e-30, dx, 1e-30)
    inverse_y = 1.0 / tl.where(tl.abs(dy) > 1e-30, dy, 1e-30)
    end_x = (tl.where(inverse_x >= 0.0, width.to(tl.float32), 0.0) - x0) * inverse_x
    end_y = (tl.where(inverse_y >= 0.0, height.to(tl.float32), 0.0) - y0) * inverse_y
    end = tl.minimum(end_x, end_y)
    end = tl.where(bend < 0.0, tl.minimum(end, (1.0 - 1.0 / (near * _NEAR_M)) / bend), end)
    to_sky = bend * end >= 1.0
    end = tl.where(to_sky, 1.0 / bend, end)
    change = bend * near
    # Nothing is met in the pixel that the ray starts from.
    t = 0.5 * tl.minimum(tl.abs(inverse_x), tl.abs(inverse_y)) + _NUDGE
    stop = tl.where(shown, end, -1.0)
    size = tl.zeros_like(x0) + 4.0
    hidden = tl.zeros_like(x0)
    clean, met = shown, shown & (t < 0.0)
    cells, cells_across = pyramid_rows.to(tl.float32), pyramid_columns.to(tl.float32)
    steps = 0
    while (tl.max((t < stop).to(tl.int32), 0) > 0) & (steps < _MAX_STEPS):
        for _ in tl.static_range(_AT_ONCE):
            t, stop, size, hidden, clean, met = _step(
                pyramid, cells, cells_across, x0, y0, dx, dy, inverse_x, inverse_y, near, change,
                end, t, stop, size, hidden, clean, met,
            )  # fmt: skip
        steps += _AT_ONCE

    sky = shown & (t >= stop) & (stop >= 0.0) & clean & to_sky
    pitch = pyramid_columns + pyramid_columns // 4
    way, last = _meet(pyramid, pitch, width, height, x0, y0, dx, dy, t, change, near, met)
    last = tl.where(met, tl.minimum(last, end), end)
    u, v = (x0 - cx) / fx, (y0 - cy) / fy
    metres = tl.sqrt(1.0 + u * u + v * v) / near
    # way is in t / k, of which near / scale makes shares of the way to the water.
    metres = tl.where(met, way * near / scale * metres, _INFINITE)
    trust = _edge_weight(x0 + last * dx, width.to(tl.float32))
    trust = trust * _edge_weight(y0 + last * dy, height.to(tl.float32))
    tl.store(distance + own, metres, mask=inside)
    tl.store(weight + own, tl.where(met | sky, trust, 0.0), mask=inside)
