"""Triton kernels of a flooded view: waves, layers put together, mirrored rays, the water's colours.

They compute what `waves`, `flood_view`, `screen_space` and `water` define.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.effects.flood import kernels as cpu
from augment.effects.flood import refraction, water_plane
from augment.render.cuda.project_kernels import three

# ---- The water's normals at every pixel of a camera ----------------------------------------------
# As on the CPU, stretches of a row share an anchor pixel that float64 has placed, here on the host;
# n counts columns from it, s is the way to the plane at unit depth, and A the horizontal step:
#
#     p = p0 + s n A
#
# A wave's turns at the anchor are p0 times its turns per metre, hundreds of turns of which only the
# fraction counts. Both come as sums of a float32 of 12 significant bits and a rest, so that float32
# holds the product of the large parts exactly, whose fraction is all that is kept of it.

# Numbers of a stretch of a row: first and one past the last pixel that meets the plane, the anchor,
# the anchor's ray, the step A, the constant part of the step per row, p0 (of each coordinate the
# large part, the rest). Of a wave: turns per metre of x and y (in parts), turns at the eye, the
# tangents' five terms.
_BEGIN, _END, _ANCHOR, _RAY, _STEP, _DROP, _PLACE, _STRETCH = (
    tl.constexpr(k) for k in (0, 1, 2, 3, 6, 8, 10, 16)
)
_TURNS, _TERMS, _WAVE = (tl.constexpr(k) for k in (4, 5, 12))
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


# ---- Rows of an image that sees the water's plane: `water_plane.falling_rows` --------------------

_ROW_BEGIN, _ROW_END = tl.constexpr(water_plane.BEGIN), tl.constexpr(water_plane.END)
_ROW_ANCHOR, _FALL = tl.constexpr(water_plane.ANCHOR), tl.constexpr(water_plane.FALL)
_ROW = tl.constexpr(water_plane.ROW)


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


# ---- Layers put together, as `flood_view` defines it ---------------------------------------------
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
    transmittance = 1.0 - tl.load(alpha + pixel, mask=wet, other=0.0)
    own = 3 * ((row - top) * (right - left) + (column - left))
    for channel in tl.static_range(3):
        at = 3 * pixel + channel
        seen = tl.load(rgb + at, mask=wet, other=0.0)
        seen += transmittance * tl.load(color + own + channel, mask=wet, other=0.0)
        seen = tl.where(wet, seen, tl.load(sky + at, mask=rest, other=0.0))
        tl.store(rgb + at, seen, mask=wet | rest)


@triton.jit(
    do_not_specialize=[
        "left", "top", "behind_left", "behind_top", "wide", "count", "behind_width"
    ]
)  # fmt: skip
def merge_depths(
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


# ---- Mirrored rays: letters as in `screen_space`, pyramid, view and steps as in `kernels` --------
# Every ray is marched: where a CPU traces some and interpolates, a GPU would wait for the rest.

BLOCK = cpu.BLOCK

_BLOCK, _LEVELS = tl.constexpr(BLOCK), tl.constexpr(cpu.LEVELS)
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

    rows: `falling_rows`, the window's. alpha: of the whole image, width and height its size.
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


# ---- Where vectors lie in a layer's image, and what it shows there, for Triton kernels -----------
# A view is a layer's camera as the 22 numbers of `water.view_numbers`. Vectors start at the layer's
# eye. Lanes outside a mask load nothing and get zeros.

_MIP_LEVELS = tl.constexpr(refraction.MIP_LEVELS)
_MIN_DEPTH = tl.constexpr(refraction.MIN_DEPTH)
_CX, _CY, _WIDTH, _HEIGHT = (tl.constexpr(k) for k in (18, 19, 20, 21))


@triton.jit
def clamp(x, low, high):
    return tl.minimum(tl.maximum(x, low), high)


@triton.jit
def dot(numbers, x, y, z):
    """Of three numbers in memory and vectors."""
    return tl.load(numbers) * x + tl.load(numbers + 1) * y + tl.load(numbers + 2) * z


@triton.jit
def project(view, x, y, z):
    """Column and row; huge for what is behind the camera."""
    inverse = 1.0 / tl.maximum(dot(view + 6, x, y, z), _MIN_DEPTH)
    column = dot(view, x, y, z) * inverse + tl.load(view + _CX)
    return column, dot(view + 3, x, y, z) * inverse + tl.load(view + _CY)


@triton.jit
def clamp_to(view, column, row):
    column = clamp(column, 0.5, tl.load(view + _WIDTH) - 0.5)
    return column, clamp(row, 0.5, tl.load(view + _HEIGHT) - 0.5)


@triton.jit
def is_inside(view, column, row):
    across = (column >= 0.0) & (column < tl.load(view + _WIDTH))
    return across & (row >= 0.0) & (row < tl.load(view + _HEIGHT))


@triton.jit
def look(alpha, depth, view, column, row, mask):
    """Alpha and depth of the nearest pixels inside, and their centres."""
    width, height = tl.load(view + _WIDTH), tl.load(view + _HEIGHT)
    column = tl.floor(clamp(column, 0.0, width - 1.0))
    row = tl.floor(clamp(row, 0.0, height - 1.0))
    pixel = row.to(tl.int32) * width.to(tl.int32) + column.to(tl.int32)
    a = tl.load(alpha + pixel, mask=mask, other=0.0)
    return a, tl.load(depth + pixel, mask=mask, other=0.0), column + 0.5, row + 0.5


@triton.jit
def way(view, depth, column, row, x0, y0, z0):
    """How far the points that pixels show at a depth are from others."""
    x = depth * dot(view + 9, column, row, 1.0) - x0
    y = depth * dot(view + 12, column, row, 1.0) - y0
    z = depth * dot(view + 15, column, row, 1.0) - z0
    return tl.sqrt(x * x + y * y + z * z)


@triton.jit
def place(column, row, width, height):
    """The first of the four pixels round coordinates, and the way from it in columns and rows.

    width, height: floats. On the last pixels the way is 1, from those before.
    """
    x, y = clamp(column - 0.5, 0.0, width - 1.0), clamp(row - 0.5, 0.0, height - 1.0)
    c0 = tl.maximum(tl.minimum(tl.floor(x), width - 2.0), 0.0)
    r0 = tl.maximum(tl.minimum(tl.floor(y), height - 2.0), 0.0)
    return c0.to(tl.int32), r0.to(tl.int32), x - c0, y - r0


@triton.jit
def _mixed(image, a, b, c, d, fc, fr, mask):
    """Of four places in memory, by the way between them."""
    top = (1.0 - fc) * tl.load(image + a, mask=mask, other=0.0)
    top += fc * tl.load(image + b, mask=mask, other=0.0)
    bottom = (1.0 - fc) * tl.load(image + c, mask=mask, other=0.0)
    bottom += fc * tl.load(image + d, mask=mask, other=0.0)
    return (1.0 - fr) * top + fr * bottom


@triton.jit
def fetch(rgb, alpha, view, column, row, mask):
    """Colours and alphas between the pixels' centres."""
    width, height = tl.load(view + _WIDTH), tl.load(view + _HEIGHT)
    c0, r0, fc, fr = place(column, row, width, height)
    wide = width.to(tl.int32)
    a = r0 * wide + c0
    right = tl.minimum(wide - 1, 1)
    below = tl.minimum(height.to(tl.int32) - 1, 1) * wide
    b, c, d = a + right, a + below, a + (right + below)
    opaque = _mixed(alpha, a, b, c, d, fc, fr, mask)
    a, b, c, d = 3 * a, 3 * b, 3 * c, 3 * d
    red = _mixed(rgb, a, b, c, d, fc, fr, mask)
    green = _mixed(rgb + 1, a, b, c, d, fc, fr, mask)
    return red, green, _mixed(rgb + 2, a, b, c, d, fc, fr, mask), opaque


@triton.jit
def fetch_square(image, a, width, right, fc, fr, mask):
    """From images of four channels: pixels a, the one `right` of it, and a width below both."""
    b, c, d = 4 * (a + right), 4 * (a + width), 4 * (a + width + right)
    a = 4 * a
    red = _mixed(image, a, b, c, d, fc, fr, mask)
    green = _mixed(image + 1, a, b, c, d, fc, fr, mask)
    blue = _mixed(image + 2, a, b, c, d, fc, fr, mask)
    return red, green, blue, _mixed(image + 3, a, b, c, d, fc, fr, mask)


@triton.jit
def fetch_level(mips, view, level, column, row, mask):
    """From a level of averages (`average`) of the view's image, whole numbers."""
    width, height = tl.load(view + _WIDTH).to(tl.int32), tl.load(view + _HEIGHT).to(tl.int32)
    first = tl.zeros_like(level)
    wide, high = width, height
    for below in tl.static_range(_MIP_LEVELS - 1):
        first += tl.where(level > below, wide * high, 0)
        wide, high = (wide + 1) >> 1, (high + 1) >> 1
    step = 1 << level
    wide, high = (width + step - 1) >> level, (height + step - 1) >> level
    scale = 1.0 / step.to(tl.float32)
    c0, r0, fc, fr = place(column * scale, row * scale, wide.to(tl.float32), high.to(tl.float32))
    right, below_it = tl.minimum(wide - 1, 1), tl.where(high > 1, wide, 0)
    return fetch_square(mips, first + r0 * wide + c0, below_it, right, fc, fr, mask)


# ---- Triton kernel for averages over ever larger squares of pixels: all levels in one launch -----

SIDE = 2 ** (
    refraction.MIP_LEVELS - 1
)  # pixels along a program's square, which becomes one of the smallest image

_HALVINGS, _SIDE = tl.constexpr(refraction.MIP_LEVELS - 1), tl.constexpr(SIDE)


@triton.jit
def _shown_by(tile, size):
    """Pixels that a tile's SIDE leaves along one axis stand for; at odd borders the last again."""
    leaf = tl.arange(0, _SIDE)
    at = tl.zeros([_SIDE], tl.int32) + tile
    for level in tl.static_range(_HALVINGS - 1, -1, -1):
        last = ((size + (1 << level) - 1) >> level) - 1
        at = tl.minimum(2 * at + ((leaf >> level) & 1), last)
    return at


@triton.jit
def _halve(value, SIZE: tl.constexpr):
    """Averages over 2 x 2 of 2 SIZE x 2 SIZE pixels."""
    return 0.25 * tl.sum(tl.sum(tl.reshape(value, (SIZE, 2, SIZE, 2)), 1), 2)


@triton.jit
def _store(value, image, tile_x, tile_y, width, height, SIZE: tl.constexpr):
    """A tile of one channel into its image of four."""
    row, column = tile_y * SIZE + tl.arange(0, SIZE), tile_x * SIZE + tl.arange(0, SIZE)
    inside = (row < height)[:, None] & (column < width)[None, :]
    tl.store(image + 4 * (row[:, None] * width + column[None, :]), value, mask=inside)


@triton.jit(do_not_specialize=["width", "height", "across", "levels"])
def average(rgb, alpha, width, height, across, levels, mips):
    """Levels 0 to levels - 1 of an image, one after the other, in mips [sum of pixels, 4].

    A level is an image of ceil(size / 2^level); across: programs that share the width.
    """
    tile_y, tile_x = tl.program_id(0) // across, tl.program_id(0) % across
    row, column = _shown_by(tile_y, height), _shown_by(tile_x, width)
    own_row = tile_y * _SIDE + tl.arange(0, _SIDE)
    own_column = tile_x * _SIDE + tl.arange(0, _SIDE)
    valid = (own_row < height)[:, None] & (own_column < width)[None, :]
    pixel = row[:, None] * width + column[None, :]
    for channel in tl.static_range(4):
        value = tl.load(rgb + 3 * pixel + channel) if channel < 3 else tl.load(alpha + pixel)
        tl.store(mips + 4 * pixel + channel, value, mask=valid)
        image, wide, high = mips + channel, width, height
        for level in tl.static_range(1, _HALVINGS + 1):
            value = _halve(value, _SIDE >> level)
            image += 4 * wide * high
            wide, high = (wide + 1) >> 1, (high + 1) >> 1
            if level < levels:
                _store(value, image, tile_x, tile_y, wide, high, _SIDE >> level)


# ---- The water's colours, as `water.shade_water` defines them ------------------------------------
# A program takes a rectangle of pixels, so that what they look up lies close together. Pixels
# without water cost it nothing where there are no others; averages and the two slopes besides a
# pixel's own are taken where one of its pixels is rough.

# Numbers that the kernel is given: world_from_camera; 1 / focal lengths, way from the principal
# point to the first pixel, change of the fall per column; three views; the medium
# (`water.medium_numbers`); the largest cover of water that shows, the variance of smooth pixels.
_AXES, _LENS, _BED, _MIRROR, _FRONT = (tl.constexpr(k) for k in (0, 9, 14, 36, 58))
_PLANE_HEIGHT, _INDEX, _EXTINCTION, _RGB = (tl.constexpr(k) for k in (80, 81, 83, 86))
_FOG, _FOG_ABOVE, _AIRLIGHT = (tl.constexpr(k) for k in (89, 90, 91))
_COVER, _SMOOTH = tl.constexpr(94), tl.constexpr(95)

_FARTHEST_RAY = tl.constexpr(refraction.FARTHEST)
_MIN_COSINE = tl.constexpr(refraction.MIN_COSINE)
_STEEPEST = tl.constexpr(refraction.STEEPEST)
_SOLID = tl.constexpr(refraction.SOLID_ALPHA)
_BED_STEPS, _SETTLED = tl.constexpr(refraction.BED_STEPS), tl.constexpr(refraction.SETTLED_M)
_OPAQUE = tl.constexpr(refraction.MAX_OPTICAL_DEPTH)
_FADE, _FAINT = tl.constexpr(refraction.EDGE), tl.constexpr(refraction.FAINT)
_MATCH_M = tl.constexpr(refraction.MATCH_M)
_MATCH_SHARE = tl.constexpr(refraction.MATCH_SHARE)
_TINY_WEIGHT = tl.constexpr(1e-7)  # a weight beside 1 that changes no colour


@triton.jit
def _reflectance(c, inside, n, SCHLICK: tl.constexpr):
    """Share of reflected light. c, inside: cosines in the air and in the water."""
    if SCHLICK:
        base = (n - 1.0) / (n + 1.0)
        base = base * base
        x = 1.0 - c
        return base + (1.0 - base) * ((x * x) * (x * x) * x)
    a, b = c - n * inside, c + n * inside
    d, e = n * c - inside, n * c + inside
    quotient = 1.0 / (b * e)
    rs, rp = a * e * quotient, d * b * quotient
    return 0.5 * (rs * rs + rp * rp)


@triton.jit
def _facet(sx, sy, vx, vy, vz, index, SCHLICK: tl.constexpr):
    """Of facets with these slopes: normals, cosines in air and water, reflected share, rays."""
    nz = tl.rsqrt(sx * sx + sy * sy + 1.0)
    nx, ny = sx * nz, sy * nz
    cosine = nx * vx + ny * vy + nz * vz
    c = clamp(cosine, _MIN_COSINE, 1.0)
    ratio = 1.0 / index
    inside = tl.sqrt(tl.maximum(1.0 - (1.0 - c * c) * ratio * ratio, 0.0))
    twice = cosine + cosine
    x, y = twice * nx - vx, twice * ny - vy
    z = tl.maximum(twice * nz - vz, _MIN_COSINE)
    unit = tl.rsqrt(x * x + y * y + z * z)
    share = _reflectance(c, inside, index, SCHLICK)
    return nx, ny, nz, c, inside, share, x * unit, y * unit, z * unit


@triton.jit
def _refract(nx, ny, nz, c, inside, vx, vy, vz, index):
    """Refracted rays per metre of depth, and their length per metre."""
    ratio = 1.0 / index
    bend = c * ratio - inside
    x, y = bend * nx - vx * ratio, bend * ny - vy * ratio
    z = tl.maximum(vz * ratio - bend * nz, _MIN_COSINE)
    steep = 1.0 / z
    return x * steep, y * steep, tl.sqrt(x * x + y * y + z * z) * steep


@triton.jit
def _search_bed(found, depth, px, py, height, tx, ty, alpha, depths, view):
    """(found, depth, column, row) where refracted rays meet the bed."""
    going = found
    for _ in tl.static_range(_BED_STEPS):
        column, row = project(view, px + depth * tx, py + depth * ty, -height - depth)
        a, z, c, r = look(alpha, depths, view, column, row, going)
        met = is_inside(view, column, row) & (a >= _SOLID)
        found = found & ((going == 0) | met)
        going = going & met
        better = tl.maximum(-height - z * dot(view + 15, c, r, 1.0), 0.0)
        better = tl.where(going, better, depth)
        going = going & (tl.abs(better - depth) > _SETTLED)
        depth = better
    column, row = project(view, px + depth * tx, py + depth * ty, -height - depth)
    return found & is_inside(view, column, row), depth, column, row


@triton.jit
def _absorb(seen, alpha, water, length, extinction):
    t = tl.exp(-length * extinction)
    return t * (seen + (1.0 - alpha) * water) + (1.0 - t) * water


@triton.jit
def _end(px, py, pz, distance, rx, ry, rz):
    """Where rays end, and their directions where that is nowhere (a distance < 0)."""
    met = distance >= 0.0
    x, y = tl.where(met, px + distance * rx, rx), tl.where(met, py + distance * ry, ry)
    return x, y, tl.where(met, pz + distance * rz, rz)


@triton.jit
def _mirror_distance(alpha, depth, view, column, row, px, py, height, mask):
    """From the surface to what the mirrored layer shows, -1 where that is nothing."""
    a, z, c, r = look(alpha, depth, view, column, row, mask)
    return tl.where(a >= _SOLID, way(view, z, c, r, px, py, height), -1.0)


@triton.jit
def _in_mirror(view, px, py, height, distance, rx, ry, rz):
    """Column and row where a reflected ray ends in the mirrored layer."""
    x, y, z = _end(px, py, height, distance, rx, ry, rz)
    column, row = project(view, x, y, z)
    return clamp_to(view, column, row)


@triton.jit
def _find_in_image(distance, trust, px, py, pz, rx, ry, rz, alpha, depth, view, mask):
    """(column, row, weight) of the image's pixels in which rays end."""
    x, y, z = _end(px, py, pz, distance, rx, ry, rz)
    column, row = project(view, x, y, z)
    finite = distance >= 0.0
    a, seen_z, c, r = look(alpha, depth, view, column, row, mask)
    better = finite & (a >= _SOLID)
    distance = tl.where(better, way(view, seen_z, c, r, px, py, pz), distance)
    x, y, z = _end(px, py, pz, distance, rx, ry, rz)
    column, row = project(view, x, y, z)
    a, seen_z, c, r = look(alpha, depth, view, column, row, mask)
    solid = a >= _SOLID
    ahead = dot(view + 6, x, y, z)
    near = tl.abs(seen_z - ahead) < tl.maximum(_MATCH_SHARE * ahead, _MATCH_M)
    seen = mask & ((finite & solid & near) | ((finite == 0) & (solid == 0)))
    columns, rows = tl.load(view + 20), tl.load(view + 21)
    across = tl.minimum(column, columns - column) / columns
    border = tl.minimum(across, tl.minimum(row, rows - row) / rows)
    fade = clamp(border / _FADE, 0.0, 1.0)
    column, row = clamp_to(view, column, row)
    return column, row, tl.where(seen, trust * (fade * fade * (3.0 - (fade + fade))), 0.0)


@triton.jit
def _sky(faces, size, x, y, z, mask):
    """Colours of a cube map with a border, four numbers a texel, in directions that climb."""
    ax, ay = tl.abs(x), tl.abs(y)
    by_x = (ax >= ay) & (ax >= z)
    by_y = ay >= z
    major = tl.where(by_x, ax, tl.where(by_y, ay, z))
    right, ahead = x >= 0.0, y >= 0.0
    across = tl.where(by_x, tl.where(right, -z, z), x)
    turned = tl.where(by_y, tl.where(ahead, z, -z), -y)
    down = tl.where(by_x, -y, turned)
    face = tl.where(by_y, tl.where(ahead, 2, 3), 4)
    face = tl.where(by_x, tl.where(right, 0, 1), face)
    side = size.to(tl.float32)
    middle = 0.5 * side
    inverse = (middle - 1.0) / major
    c0, r0, fc, fr = place(across * inverse + middle, down * inverse + middle, side, side)
    at = (r0 + face * size) * size + c0
    r, g, b, _ = fetch_square(faces, at, size, 1, fc, fr, mask)
    return r, g, b


@triton.jit(do_not_specialize=["left", "top", "levels", "size", "width", "height", "across"])
def shade(
    numbers, rows, faces, size, cover, normal_x, normal_y, variance, bed_rgb, bed_alpha, bed_depth,
    left, top, mirror_alpha, mirror_depth, mips, levels, front_rgb, front_alpha, front_depth,
    front_distance, front_weight, out, width, height, across, HAS_MIRROR: tl.constexpr,
    HAS_FRONT: tl.constexpr, BENDS: tl.constexpr, SCHLICK: tl.constexpr, WIDE: tl.constexpr,
    HIGH: tl.constexpr,
):  # fmt: skip
    """Water of the pixels of a camera into out [H, W, 3].

    numbers: as above. rows: `falling_rows`. faces: flat cube map with its border, `size` squared
    texels of four numbers a face. left, top: of the camera's window in the bed's. mips: the
    mirrored layer and its averages. front: the layer of the screen-space reflection, whose rays run
    front_distance. across: programs that share the width, each WIDE columns and HIGH rows.
    """
    lane, pid = tl.arange(0, WIDE * HIGH), tl.program_id(0)
    i = (pid // across) * HIGH + lane // WIDE
    j = (pid % across) * WIDE + lane % WIDE
    inside_image = (i < height) & (j < width)
    pixel = i * width + j
    meets = falls(rows, i, j, inside_image)
    covered = tl.load(cover + pixel, mask=meets, other=2.0)
    shown = covered <= tl.load(numbers + _COVER)
    fog = tl.load(numbers + _FOG)
    red, green, blue = three(numbers + _RGB)
    fog_r, fog_g, fog_b = three(numbers + _AIRLIGHT)
    sum_r = tl.where(meets, tl.where(fog > 0.0, fog_r, red), 0.0)
    sum_g = tl.where(meets, tl.where(fog > 0.0, fog_g, green), 0.0)
    sum_b = tl.where(meets, tl.where(fog > 0.0, fog_b, blue), 0.0)
    if tl.max(shown.to(tl.int32), 0) > 0:
        eye = tl.load(numbers + _PLANE_HEIGHT)
        index = tl.load(numbers + _INDEX)
        # The ray, and where it meets the plane.
        dz = fall_of(rows, i, j, tl.load(numbers + _LENS + 4), shown)
        u = (j.to(tl.float32) + tl.load(numbers + _LENS + 2)) * tl.load(numbers + _LENS)
        v = (i.to(tl.float32) + tl.load(numbers + _LENS + 3)) * tl.load(numbers + _LENS + 1)
        dx = dot(numbers + _AXES, u, v, 1.0)
        dy = dot(numbers + _AXES + 3, u, v, 1.0)
        along = tl.minimum(eye / -dz, _FARTHEST_RAY)
        px, py = along * dx, along * dy
        length = tl.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = 1.0 / length
        vx, vy, vz = -dx * inverse, -dy * inverse, -dz * inverse
        near = fog * along * length
        nx = tl.load(normal_x + pixel, mask=shown, other=0.0)
        ny = tl.load(normal_y + pixel, mask=shown, other=0.0)
        upright = tl.rsqrt(tl.maximum(1.0 - nx * nx - ny * ny, _STEEPEST))
        sx, sy = nx * upright, ny * upright
        nx, ny, nz, c, inside, share, rx, ry, rz = _facet(sx, sy, vx, vy, vz, index, SCHLICK)

        # Through the surface.
        t = tl.exp(-near)
        water_r = t * red + (1.0 - t) * fog_r
        water_g = t * green + (1.0 - t) * fog_g
        water_b = t * blue + (1.0 - t) * fog_b
        bed = numbers + _BED
        own_row, own_column = i + top, j + left
        bed_width = tl.load(bed + 20).to(tl.int32)
        behind = shown & (own_row >= 0) & (own_row < tl.load(bed + 21).to(tl.int32))
        behind = behind & (own_column >= 0) & (own_column < bed_width)
        own = own_row * bed_width + own_column
        a = tl.load(bed_alpha + own, mask=behind, other=0.0)
        own_depth = -tl.load(bed_depth + own, mask=behind, other=0.0) * dz - eye
        own_depth = tl.maximum(own_depth, 0.0)
        steep = 1.0 / vz
        if BENDS:
            tx, ty, steep = _refract(nx, ny, nz, c, inside, vx, vy, vz, index)
        least = tl.minimum(tl.load(numbers + _EXTINCTION), tl.load(numbers + _EXTINCTION + 1))
        least = tl.minimum(least, tl.load(numbers + _EXTINCTION + 2))
        clear = behind & (a >= _SOLID) & (own_depth * steep * least < _OPAQUE)
        depth = own_depth
        missed = clear
        r, g, b = tl.zeros_like(dx), tl.zeros_like(dx), tl.zeros_like(dx)
        if BENDS:
            found, bent, column, row = _search_bed(
                clear, own_depth, px, py, eye, tx, ty, bed_alpha, bed_depth, bed
            )
            r, g, b, opaque = fetch(bed_rgb, bed_alpha, bed, column, row, found)
            found = found & (opaque >= _SOLID)
            missed = clear & (found == 0)
            depth, a = tl.where(found, bent, own_depth), tl.where(found, opaque, a)
        r = tl.where(missed, tl.load(bed_rgb + 3 * own, mask=missed, other=0.0), r)
        g = tl.where(missed, tl.load(bed_rgb + 3 * own + 1, mask=missed, other=0.0), g)
        b = tl.where(missed, tl.load(bed_rgb + 3 * own + 2, mask=missed, other=0.0), b)
        path = depth * steep
        below_r = _absorb(r, a, water_r, path, tl.load(numbers + _EXTINCTION))
        below_g = _absorb(g, a, water_g, path, tl.load(numbers + _EXTINCTION + 1))
        below_b = _absorb(b, a, water_b, path, tl.load(numbers + _EXTINCTION + 2))
        below_r = tl.where(clear, below_r, water_r)
        below_g = tl.where(clear, below_g, water_g)
        below_b = tl.where(clear, below_b, water_b)
        seen_r, seen_g, seen_b = below_r, below_g, below_b

        if BENDS:
            spread = tl.load(variance + pixel, mask=shown, other=0.0)
            rough = spread >= tl.load(numbers + _SMOOTH)
            # What stands above the water, where the image shows it.
            weight = tl.zeros_like(dx)
            image_r, image_g, image_b, image_a = weight, weight, weight, weight
            if HAS_FRONT:
                smooth = shown & (rough == 0)
                front = numbers + _FRONT
                distance = tl.load(front_distance + pixel, mask=smooth, other=-1.0)
                distance = tl.where(distance < float("inf"), distance, -1.0)
                trust = tl.load(front_weight + pixel, mask=smooth, other=0.0)
                column, row, weight = _find_in_image(
                    distance, trust, px, py, -eye, rx, ry, rz, front_alpha, front_depth, front,
                    smooth,
                )  # fmt: skip
                image_r, image_g, image_b, image_a = fetch(
                    front_rgb, front_alpha, front, column, row, weight > 0.0
                )
            rest = 1.0 - weight
            # A slope to each side along the view, as far as three times its variance.
            flat = tl.maximum(tl.sqrt(vx * vx + vy * vy), 1e-12)
            spread = tl.where(rough, tl.sqrt(3.0 * spread) / flat, 0.0)
            taps = tl.where(tl.max((rough & shown).to(tl.int32), 0) > 0, 3, 1)
            mirror = numbers + _MIRROR
            far = tl.zeros_like(dx)
            low, above = tl.zeros_like(i), tl.zeros_like(dx)
            needed = shown & (rest > _TINY_WEIGHT)
            if HAS_MIRROR:
                column, row = project(mirror, dx, dy, -dz)
                column, row = clamp_to(mirror, column, row)
                far = _mirror_distance(
                    mirror_alpha, mirror_depth, mirror, column, row, px, py, eye, needed
                )
                column, row = _in_mirror(mirror, px, py, eye, far, rx, ry, rz)
                far = _mirror_distance(
                    mirror_alpha, mirror_depth, mirror, column, row, px, py, eye, needed
                )
                if taps > 1:
                    # The level of averages whose pixels are as wide as the places lie apart.
                    column, row = _in_mirror(mirror, px, py, eye, far, rx, ry, rz)
                    apart = tl.zeros_like(dx)
                    for side in range(2):
                        offset = tl.where(side == 0, spread, -spread)
                        _, _, _, _, _, _, x, y, z = _facet(
                            sx + offset * vx, sy + offset * vy, vx, vy, vz, index, SCHLICK
                        )
                        x, y = _in_mirror(mirror, px, py, eye, far, x, y, z)
                        x, y = x - column, y - row
                        apart += tl.sqrt(x * x + y * y)
                    level = tl.log2(tl.maximum(0.5 * apart, 1.0))
                    level = tl.where(rough, tl.minimum(level, (levels - 1).to(tl.float32)), 0.0)
                    low = tl.floor(level).to(tl.int32)
                    above = level - tl.floor(level)
            fog_above = tl.load(numbers + _FOG_ABOVE)
            for tap in range(taps):
                offset = tl.where(tap == 0, 0.0, tl.where(tap == 1, spread, -spread))
                part = tl.where(rough, tl.where(tap == 0, 2.0 / 3, 1.0 / 6), 1.0)
                part = tl.where((tap > 0) & (rough == 0), 0.0, part)
                _, _, _, _, _, share, x, y, z = _facet(
                    sx + offset * vx, sy + offset * vy, vx, vy, vz, index, SCHLICK
                )
                r, g, b, a = weight * image_r, weight * image_g, weight * image_b, weight * image_a
                if HAS_MIRROR:
                    looks = needed & (part > 0.0)
                    column, row = _in_mirror(mirror, px, py, eye, far, x, y, z)
                    r0, g0, b0, a0 = fetch_level(mips, mirror, low, column, row, looks)
                    if taps > 1:
                        mask = looks & (above > 0.0)
                        r1, g1, b1, a1 = fetch_level(mips, mirror, low + 1, column, row, mask)
                        keep = 1.0 - above
                        r0, g0 = keep * r0 + above * r1, keep * g0 + above * g1
                        b0, a0 = keep * b0 + above * b1, keep * a0 + above * a1
                    r, g, b, a = r + rest * r0, g + rest * g0, b + rest * b0, a + rest * a0
                transmittance = 1.0 - a
                shines = transmittance > _FAINT
                sky_r, sky_g, sky_b = _sky(faces, size, x, y, z, shown & shines & (part > 0.0))
                t = tl.where(fog_above >= 0.0, tl.exp(-(near + fog_above / z)), 1.0)
                whole = tl.where(shines, 1.0, 1.0 / tl.maximum(a, 0.5))
                clear_sky = tl.where(shines, transmittance * t, 0.0)
                hazy_sky = tl.where(shines, transmittance * (1.0 - t), 0.0)
                part = part * share
                seen_r += part * (r * whole + clear_sky * sky_r + hazy_sky * fog_r - below_r)
                seen_g += part * (g * whole + clear_sky * sky_g + hazy_sky * fog_g - below_g)
                seen_b += part * (b * whole + clear_sky * sky_b + hazy_sky * fog_b - below_b)
        sum_r = tl.where(shown, seen_r, sum_r)
        sum_g = tl.where(shown, seen_g, sum_g)
        sum_b = tl.where(shown, seen_b, sum_b)
    tl.store(out + 3 * pixel, sum_r, mask=inside_image)
    tl.store(out + 3 * pixel + 1, sum_g, mask=inside_image)
    tl.store(out + 3 * pixel + 2, sum_b, mask=inside_image)
