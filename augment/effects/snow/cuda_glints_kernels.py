"""Triton kernel: which crystals throw the sun into the eye (see
augment.effects.snow.near_camera).
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.effects.snow import glint_layout
from augment.effects.snow import near_camera as sparkle
from augment.render.cuda.project_kernels import dot, floats_at, three, three_where

FARTHEST_M, LEAST = tl.constexpr(sparkle.FARTHEST_M), tl.constexpr(sparkle.LEAST)
LOBE = tl.constexpr(1 - math.cos(math.radians(sparkle.LOBE_DEG)))
ADDRESSES, NUMBERS = tl.constexpr(glint_layout.ADDRESSES), tl.constexpr(glint_layout.NUMBERS)
N_EYE, N_SUN = tl.constexpr(glint_layout.N_EYE), tl.constexpr(glint_layout.N_SUN)
N_STRENGTH = tl.constexpr(glint_layout.N_STRENGTH)
A_PLACES, A_MIRRORS = tl.constexpr(glint_layout.A_PLACES), tl.constexpr(glint_layout.A_MIRRORS)
R_LAYER, R_FIRST = tl.constexpr(glint_layout.R_LAYER), tl.constexpr(glint_layout.R_FIRST)
R_COUNT, R_SLOT = tl.constexpr(glint_layout.R_COUNT), tl.constexpr(glint_layout.R_SLOT)
ROW, MOST = tl.constexpr(glint_layout.ROW), tl.constexpr(glint_layout.MOST)


@triton.jit
def find_glints(rows, layers, numbers, means, opacities, BLOCK: tl.constexpr):
    """The glints of one block of crystals, in its order; opacity 0 where there are fewer.

    rows int32 [B, ROW], layers int64 [L, ADDRESSES], numbers float32 [L, NUMBERS]: see
    glint_layout. means [G, 3], opacities [G]: written.
    """
    row = rows + tl.program_id(0) * ROW
    layer, count = tl.load(row + R_LAYER), tl.load(row + R_COUNT)
    first, slot = tl.load(row + R_FIRST), tl.load(row + R_SLOT)
    view, addresses = numbers + layer * NUMBERS, layers + layer * ADDRESSES
    lane = tl.arange(0, BLOCK)
    inside = lane < count
    places = floats_at(tl.load(addresses + A_PLACES)) + (first + lane) * 3
    mirrors = floats_at(tl.load(addresses + A_MIRRORS)) + (first + lane) * 3
    x, y, z = three_where(places, inside)
    eye, rest, sun = three(view + N_EYE), three(view + N_EYE + 3), three(view + N_SUN)
    view_x, view_y, view_z = eye[0] - x + rest[0], eye[1] - y + rest[1], eye[2] - z + rest[2]
    away = (view_x, view_y, view_z)
    distance = tl.maximum(tl.sqrt(dot(away, away)), 1e-6)
    half = (view_x / distance + sun[0], view_y / distance + sun[1], view_z / distance + sun[2])
    length = tl.maximum(tl.sqrt(dot(half, half)), 1e-6)
    off = (1.0 - dot(half, three_where(mirrors, inside)) / length) / LOBE  # 1 at the lobe's rim
    power = tl.load(view + N_STRENGTH) * tl.sqrt(tl.maximum(1.0 - off, 0.0))
    power *= 1.0 - distance / FARTHEST_M
    shown = inside & (power > LEAST)

    room = tl.minimum(count, MOST)
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
