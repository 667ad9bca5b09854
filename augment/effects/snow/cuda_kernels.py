"""Triton kernels of snow: near discs split, glints found, splats lit, points of the ground seen.

They are those of `kernels`, `near_camera` and `surface_kernels` in float32, which counts from the
eye or from near the points: so it tells a texel of the noise wherever in the world they are.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.effects.snow import kernels as cpu
from augment.effects.snow import near_camera
from augment.render.cuda.project_kernels import (
    dot,
    floats_at,
    four_where,
    rotation_columns,
    three,
    three_where,
)
from augment.render.sh import SH_C0

_C0 = tl.constexpr(SH_C0)

# ---- Near discs split into finer ones ------------------------------------------------------------

_REACH, _SPREAD = tl.constexpr(cpu.REACH), tl.constexpr(cpu.SPREAD)
_FARTHEST_M = tl.constexpr(cpu.FARTHEST_M)
_TEXELS = tl.constexpr(1.0 / cpu.TEXEL_M)  # per metre
_COARSER = tl.constexpr(cpu.COARSER)
_CRUMB_SHARE, _CLOD_SHARE = tl.constexpr(cpu.CRUMB), tl.constexpr(cpu.CLOD)
_TABLE = tl.constexpr(near_camera.TABLE)
# Numbers of a view, after camera_from_part's rotation: the eye (3, and the 3 remainders that
# float32 could not hold), lowest and highest x / z, then y / z; see `kernels.split`; the sun's
# level direction times half a step, metres; where the eye lies in the noise, texels: of crumbs, of
# clods.
_EYE, _LIMITS, _FINEST, _RELIEF, _MOTTLE, _SUN, _CRUMB, _CLOD = (
    tl.constexpr(k) for k in (9, 15, 19, 20, 21, 22, 24, 26)
)


@triton.jit
def split_discs(
    rows, numbers, order, noise, means, quats, scales, opacities, sh, slopes,
    left, fine_means, fine_quats, fine_scales, fine_opacities, fine_sh, fine_slopes,
    LIT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One finer disc of every disc of a block: program (b, p) writes the p-th of block b's.

    rows int32 [B, 4]: a block's first place in the order of discs, how many it has, into how many
    along a side one of them is split at most, the place of its first finer disc. numbers: _EYE and
    the following. order int32 [S]: of the discs. noise [T, T]. left: opacities of the whole
    discs, 0 written for those that are split. Of a block's finer discs the first of all come first;
    of those that are none the opacity is 0. slopes: read and written where LIT.
    """
    row, piece = rows + tl.program_id(0) * 4, tl.program_id(1)
    most = tl.load(row + 2)
    if piece < most * most:
        count, lane = tl.load(row + 1), tl.arange(0, BLOCK)
        inside = lane < count
        disc = tl.load(order + tl.load(row) + lane, inside, 0)
        eye, rest = three(numbers + _EYE), three(numbers + _EYE + 3)
        mx, my, mz = three_where(means + disc * 3, inside)
        x, y, z = mx - eye[0] - rest[0], my - eye[1] - rest[1], mz - eye[2] - rest[2]
        wide, deep, thick = three_where(scales + disc * 3, inside)
        wide, deep, finest = wide * _REACH, deep * _REACH, tl.load(numbers + _FINEST)
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
        p = ((j.to(tl.float32) + 0.5) / n - 0.5) * (wide / _SPREAD)
        q = ((k.to(tl.float32) + 0.5) / n - 0.5) * (deep / _SPREAD)
        u, v = columns[0], columns[1]
        dx, dy, dz = p * u[0] + q * v[0], p * u[1] + q * v[1], p * u[2] + q * v[2]

        fade = tl.minimum(tl.maximum(2.0 * (1.0 - far / _FARTHEST_M), 0.0), 1.0)
        # 0 where discs grow whole again
        fade *= tl.minimum(tl.maximum(2.0 * side / (finest * far) - 3.0, 0.0), 1.0)
        sx, sy = tl.load(numbers + _SUN), tl.load(numbers + _SUN + 1)
        px, py, pz = x + dx, y + dy, z + dz
        behind = _grain(px - sx, py - sy, pz, kept, numbers, noise)
        sunward = _grain(px + sx, py + sy, pz, kept, numbers, noise)
        bright = tl.load(numbers + _RELIEF) * (behind - sunward)
        bright += 0.5 * tl.load(numbers + _MOTTLE) * (behind + sunward)
        factor = 1.0 + fade * bright

        slot = tl.load(row + 3) + piece * count + lane
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
    place, limits = (x, y, z), numbers + _LIMITS
    right, down = dot(three(numbers), place), dot(three(numbers + 3), place)
    away = dot(three(numbers + 6), place)
    seen = inside & (away > 0.0) & (far < _FARTHEST_M)
    seen &= (right >= tl.load(limits) * away) & (right <= tl.load(limits + 1) * away)
    seen &= (down >= tl.load(limits + 2) * away) & (down <= tl.load(limits + 3) * away)
    splits = tl.minimum(tl.floor(side / (finest * far) + 0.5), most.to(tl.float32))
    return tl.where(seen & (splits > 1.0), splits, 0.0).to(tl.int32)


@triton.jit
def _grain(x, y, z, mask, numbers, noise):
    """The noise that the grain follows, at a place from the eye in metres: two scales of one table.

    Half a texel of a turn is no whole number of tables, so the eye has a place in it for each.
    """
    u, v = (x + 0.7 * z) * _TEXELS, (y + 0.7 * z) * _TEXELS
    crumb = _texel(u, v, mask, numbers + _CRUMB, noise)
    u, v = (0.8 * u - 0.6 * v) * _COARSER, (0.6 * u + 0.8 * v) * _COARSER
    clod = _texel(u, v, mask, numbers + _CLOD, noise)
    return crumb * _CRUMB_SHARE + clod * _CLOD_SHARE


@triton.jit
def _texel(u, v, mask, start, noise):
    row = tl.floor(u + tl.load(start)).to(tl.int32) & (_TABLE - 1)
    column = tl.floor(v + tl.load(start + 1)).to(tl.int32) & (_TABLE - 1)
    return tl.load(noise + row * _TABLE + column, mask, 0.0)


@triton.jit
def _shade(sh, factor):
    return (factor * (sh * _C0 + 0.5) - 0.5) / _C0


@triton.jit
def _store_three(pointer, values, mask):
    tl.store(pointer, values[0], mask)
    tl.store(pointer + 1, values[1], mask)
    tl.store(pointer + 2, values[2], mask)


# ---- Which crystals throw the sun into the eye ---------------------------------------------------

_FARTHEST_GLINT_M = tl.constexpr(near_camera.FARTHEST_M)
_MIN_OPACITY = tl.constexpr(near_camera.MIN_OPACITY)
_LOBE = tl.constexpr(1 - math.cos(math.radians(near_camera.LOBE_DEG)))


@triton.jit
def find_glints(
    rows, layers, numbers, means, opacities, MAX_GLINTS: tl.constexpr, BLOCK: tl.constexpr
):
    """The glints of one block of crystals, in its order; opacity 0 where there are fewer.

    rows int32 [B, 4]: a block's layer, its first crystal, how many, the place of its first glint.
    layers int64 [L, 2]: addresses of the crystals' places and mirrors. numbers float32 [L, 10]: the
    eye (3, and the remainders that float32 could not hold), the sun (unit), the light's strength;
    in the layer's frame. means [G, 3], opacities [G]: written.
    """
    row = rows + tl.program_id(0) * 4
    layer, count = tl.load(row), tl.load(row + 2)
    first, slot = tl.load(row + 1), tl.load(row + 3)
    view, addresses = numbers + layer * 10, layers + layer * 2
    lane = tl.arange(0, BLOCK)
    inside = lane < count
    places = floats_at(tl.load(addresses)) + (first + lane) * 3
    mirrors = floats_at(tl.load(addresses + 1)) + (first + lane) * 3
    x, y, z = three_where(places, inside)
    eye, rest, sun = three(view), three(view + 3), three(view + 6)
    view_x, view_y, view_z = eye[0] - x + rest[0], eye[1] - y + rest[1], eye[2] - z + rest[2]
    away = (view_x, view_y, view_z)
    distance = tl.maximum(tl.sqrt(dot(away, away)), 1e-6)
    half = (view_x / distance + sun[0], view_y / distance + sun[1], view_z / distance + sun[2])
    length = tl.maximum(tl.sqrt(dot(half, half)), 1e-6)
    off = (1.0 - dot(half, three_where(mirrors, inside)) / length) / _LOBE  # 1 at the lobe's rim
    power = tl.load(view + 9) * tl.sqrt(tl.maximum(1.0 - off, 0.0))
    power *= 1.0 - distance / _FARTHEST_GLINT_M
    shown = inside & (power > _MIN_OPACITY)

    room = tl.minimum(count, MAX_GLINTS)
    total = tl.sum(shown.to(tl.int32), 0)
    at = tl.cumsum(shown.to(tl.int32), 0) - 1
    kept = shown & (at < room)
    own = slot + tl.where(kept, at, 0)
    tl.store(opacities + own, tl.minimum(power, 1.0), kept)
    tl.store(means + own * 3, x, kept)
    tl.store(means + own * 3 + 1, y, kept)
    tl.store(means + own * 3 + 2, z, kept)
    empty = (lane >= total) & (lane < room)
    tl.store(opacities + slot + lane, tl.zeros_like(x), empty)
    for axis in tl.static_range(3):
        tl.store(means + (slot + lane) * 3 + axis, tl.zeros_like(x), empty)


# ---- Snow in the light that its own normals catch ------------------------------------------------


@triton.jit
def light_splats(rows, numbers, lit, BLOCK: tl.constexpr):
    """SH of the splats of layer program_id(1), BLOCK of them a program.

    rows int64 [L, 5]: addresses of normals, slopes and SH; how many splats, and the place of the
    first in lit [S, 3], written. numbers float32 [L, 4]: the sun (unit, layer's frame), wrap.
    """
    layer, first = tl.program_id(1), tl.program_id(0) * BLOCK
    row, view = rows + layer * 5, numbers + layer * 4
    count = tl.load(row + 3).to(tl.int32)
    if first < count:
        lane = first + tl.arange(0, BLOCK)
        inside = lane < count
        normals = three_where(floats_at(tl.load(row)) + lane * 3, inside)
        slopes = three_where(floats_at(tl.load(row + 1)) + lane * 3, inside)
        sh = three_where(floats_at(tl.load(row + 2)) + lane * 3, inside)
        wrap = tl.load(view + 3)
        facing = (dot(normals, three(view)) + wrap) / (1.0 + wrap)
        share = tl.minimum(tl.maximum(facing, 0.0), 1.0) / _C0
        own = lit + (tl.load(row + 4).to(tl.int32) + lane) * 3
        tl.store(own, sh[0] + slopes[0] * share, inside)
        tl.store(own + 1, sh[1] + slopes[1] * share, inside)
        tl.store(own + 2, sh[2] + slopes[2] * share, inside)


# ---- Which points of the ground are seen by some camera ------------------------------------------


@triton.jit(do_not_specialize=["count", "view_count"])
def find_seen(
    points, normals, is_sure, views, sizes, depths, tolerances, lifts, seen, count, view_count,
    LIFTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """seen uint8 [C]: as surface_kernels.find_seen says, with its other arguments as float32.

    points, normals: [3, C]. is_sure: uint8. sizes: int32. Lanes of a program are neighbours, which
    the same few views see: what no lane needs is not looked up.
    """
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_point = lane < count
    x = tl.load(points + lane, mask=is_point, other=0.0)
    y = tl.load(points + count + lane, mask=is_point, other=0.0)
    z = tl.load(points + 2 * count + lane, mask=is_point, other=0.0)
    nx = tl.load(normals + lane, mask=is_point, other=0.0)
    ny = tl.load(normals + count + lane, mask=is_point, other=0.0)
    nz = tl.load(normals + 2 * count + lane, mask=is_point, other=0.0)
    asks = is_point & (tl.load(is_sure + lane, mask=is_point, other=1) == 0)
    far_share, far_m, below_share = (
        tl.load(tolerances), tl.load(tolerances + 1), tl.load(tolerances + 2)
    )  # fmt: skip
    grazing, margin = tl.load(tolerances + 3), tl.load(tolerances + 4)
    found = lane < 0
    there = tl.zeros((BLOCK,), tl.int32)
    for number in range(view_count):
        view = views + 17 * number
        width, height = tl.load(sizes + 3 * number), tl.load(sizes + 3 * number + 1)
        start = depths + tl.load(sizes + 3 * number + 2)
        u, v, depth = _project(view, x, y, z)
        shows = asks & (depth > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < width) & (v < height)
        if tl.max(shows.to(tl.int32), 0) > 0:
            column, row = _pixel(u, v, shows, width, height)
            slack = depth * (far_share - 1.0) + far_m
            solid = lane < 0
            for k in tl.static_range(-1, 2):
                for m in tl.static_range(-1, 2):
                    near = _depth_at(start, column + m, row + k, width, height, shows, -1.0)
                    solid |= (near >= 0.0) & (tl.abs(near - depth) <= slack)
            behind = _depth_at(start, column, row, width, height, shows, -1.0) > depth
            there += tl.where(shows & solid, 1, 0) - tl.where(shows & ~solid & behind, 1, 0)
        for at in tl.static_range(LIFTS):
            lift = tl.load(lifts + at)
            top = z + lift
            u, v, depth = _project(view, x, y, top)
            looks = is_point & ~found & (depth > 0.0) & (u >= -margin) & (v >= -margin)
            looks &= (u <= width + margin) & (v <= height + margin)
            if tl.max(looks.to(tl.int32), 0) > 0:
                column, row = _pixel(u, v, looks, width, height)
                faces = _faces(view, x, y, top, nx, ny, nz, grazing)
                deepest = tl.zeros((BLOCK,), tl.float32)
                for k in tl.static_range(-1, 2):
                    for m in tl.static_range(-1, 2):
                        near = _depth_at(start, column + m, row + k, width, height, looks, 0.0)
                        deepest = tl.maximum(deepest, near)
                own = _depth_at(start, column, row, width, height, looks, 0.0)
                by_face = depth <= deepest * far_share + far_m
                from_below = depth <= tl.where(lift > 0.0, own * below_share, -1.0)
                found |= looks & tl.where(faces, by_face, from_below)
    tl.store(seen + lane, (found & (there >= 0)).to(tl.uint8), mask=is_point)


@triton.jit
def _project(view, x, y, z):
    """Column, row and depth; depth 0 where it is behind the camera."""
    x, y, z = x - tl.load(view + 12), y - tl.load(view + 13), z - tl.load(view + 14)
    depth = tl.load(view + 6) * x + tl.load(view + 7) * y + tl.load(view + 8) * z
    u = tl.load(view) * x + tl.load(view + 1) * y + tl.load(view + 2) * z
    v = tl.load(view + 3) * x + tl.load(view + 4) * y + tl.load(view + 5) * z
    depth = tl.where(depth < 0.1, 0.0, depth)
    by = tl.where(tl.load(view + 15) == 0.0, tl.where(depth > 0.0, depth, 1.0), 1.0)
    u = u / by * tl.load(view + 9) + tl.load(view + 10)
    return u, v / by * tl.load(view + 11) + tl.load(view + 16), depth


@triton.jit
def _pixel(u, v, mask, width, height):
    """The pixel at a place, or the nearest that there is."""
    column = tl.floor(tl.where(mask, u, 0.0)).to(tl.int32)
    row = tl.floor(tl.where(mask, v, 0.0)).to(tl.int32)
    column = tl.minimum(tl.maximum(column, 0), width - 1)
    return column, tl.minimum(tl.maximum(row, 0), height - 1)


@triton.jit
def _depth_at(start, column, row, width, height, mask, other):
    """The depth of a pixel, `other` beyond the image."""
    inside = mask & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return tl.load(start + row * width + column, mask=inside, other=other)


@triton.jit
def _faces(view, x, y, z, nx, ny, nz, grazing):
    """Whether a surface turns its upper side to the view, or nearly."""
    parallel = tl.load(view + 15) != 0.0
    tx = tl.where(parallel, -tl.load(view + 6), tl.load(view + 12) - x)
    ty = tl.where(parallel, -tl.load(view + 7), tl.load(view + 13) - y)
    tz = tl.where(parallel, -tl.load(view + 8), tl.load(view + 14) - z)
    facing = nx * tx + ny * ty + nz * tz
    return facing >= -grazing * tl.sqrt(tx * tx + ty * ty + tz * tz)
