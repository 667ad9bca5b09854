"""Triton kernel: which points of the ground are seen by some camera.

The same as augment.effects.snow.surface_kernels, in float32 and about an origin near the points.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.effects.snow import visibility_layout

VIEW = tl.constexpr(visibility_layout.VIEW)


@triton.jit(do_not_specialize=["count", "view_count"])
def find_seen(
    points, normals, is_sure, views, sizes, depths, tolerances, lifts, seen, count, view_count,
    LIFTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """seen uint8 [C]: as visibility_kernels.find_seen says, with its other arguments as float32.

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
        view = views + VIEW * number
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
def _pixel(u, v, wanted, width, height):
    """The pixel at a place, or the nearest that there is."""
    column = tl.floor(tl.where(wanted, u, 0.0)).to(tl.int32)
    row = tl.floor(tl.where(wanted, v, 0.0)).to(tl.int32)
    column = tl.minimum(tl.maximum(column, 0), width - 1)
    return column, tl.minimum(tl.maximum(row, 0), height - 1)


@triton.jit
def _depth_at(start, column, row, width, height, wanted, other):
    """The depth of a pixel, `other` beyond the image."""
    inside = wanted & (column >= 0) & (row >= 0) & (column < width) & (row < height)
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
