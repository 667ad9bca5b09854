"""Triton kernels that march mirrored rays through a pyramid of the nearest depth.

The letters are those of `screen_space`, which defines the result; the pyramid, the view's numbers
and the steps are those of `screen_space_kernels`. Every ray is marched: where a CPU traces some and
interpolates, a GPU would wait for the rays that are left.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.weather import screen_space_kernels as cpu
from augment.weather.cuda_rows_kernels import fall_of, falls

LEVELS, BLOCK = cpu.LEVELS, cpu.BLOCK

_BLOCK, _LEVELS = tl.constexpr(BLOCK), tl.constexpr(LEVELS)
_COVERED, _THICKNESS_M = tl.constexpr(float(cpu.COVERED)), tl.constexpr(float(cpu.THICKNESS_M))
_THICKNESS, _HIDDEN_PX = tl.constexpr(float(cpu.THICKNESS)), tl.constexpr(float(cpu.HIDDEN_PX))
_NEAR_M, _AGREEING = tl.constexpr(float(cpu.NEAR_M)), tl.constexpr(float(cpu.AGREEING))
_EDGE, _NUDGE = tl.constexpr(float(cpu.EDGE)), tl.constexpr(float(cpu.NUDGE))
_FARTHEST, _MOST_STEPS = tl.constexpr(float(cpu.FARTHEST)), tl.constexpr(cpu.MOST_STEPS)
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
    while (tl.max((t < stop).to(tl.int32), 0) > 0) & (steps < _MOST_STEPS):
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
