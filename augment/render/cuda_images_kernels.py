"""Triton kernel: the images of a view as files hold them, all of them in one pass.

Definition: augment.view_images.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render.cuda_composite_kernels import pixels_of

# Columns of the table of parts, int64 [parts, 3].
FIRST, CLASSES, INSTANCE = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)
COLUMNS = tl.constexpr(3)


@triton.jit
def to_bytes(value):
    """Clamped to [0, 1], times 255, rounded to the nearest."""
    scaled = tl.fma(value, 255.0, 0.5)
    return tl.minimum(tl.maximum(scaled, 0.0), 255.0).to(tl.uint8)


@triton.jit
def _part_of(splat, parts, count, halvings, here):
    """The part that a splat belongs to: the last one that begins at it or before."""
    part = tl.zeros(splat.shape, tl.int32)
    for level in range(halvings):
        later = part + (1 << (halvings - 1 - level))
        there = here & (later < count)
        begins = tl.load(parts + later * COLUMNS + FIRST, there, 0)
        part = tl.where(there & (begins <= splat), later, part)
    return part


@triton.jit
def _class_of(splat, row, here):
    """Classes of splats whose parts have the rows; 0 where a part has none."""
    address = tl.load(row + CLASSES, here, 0)
    own = splat - tl.load(row + FIRST, here, 0)
    known = here & (address != 0)
    return tl.load(address.to(tl.pointer_type(tl.int16)) + own, known, 0)


@triton.jit(do_not_specialize=["count", "width", "part_count", "halvings"])
def make_images(
    rgb, depth, scene_depth, water, snow, alpha, splat_ids, parts,
    rgb_out, depth_out, scene_depth_out, water_out, snow_out, semantic_out, instance_out,
    count, width, part_count, halvings,
    cx, cy, ifx, ify, fall_u, fall_v, fall_w, eye_m,
    least_alpha, sky_class, water_class,
    SHOWS_WATER: tl.constexpr, IN_AIR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Every image that there is something to make of; None stands for the others.

    water, snow: uint8, 1 where they are. alpha, splat_ids: of the surfaces that classes and
    instances are of. parts: int64 [part_count, 3], of each part its first splat, the address of its
    splats' int16 classes, 0 without, and its instance. halvings: bits of part_count - 1.
    SHOWS_WATER: where water is, it is what depth, classes and instances show; IN_AIR: its surface,
    eye_m below the eye, which rays meet that fall by fall_u x / z + fall_v y / z + fall_w per metre
    of depth; else its depth is 0.
    """
    pixel, here, u, v = pixels_of(count, width, cx, cy, ifx, ify, BLOCK)
    for third in tl.static_range(3):  # colours as a row of numbers: whole words are moved
        at = (tl.program_id(0) * 3 + third) * BLOCK + tl.arange(0, BLOCK)
        value = tl.load(rgb + at, at < 3 * count, 0.0)
        tl.store(rgb_out + at, to_bytes(value), at < 3 * count)
    covered = tl.zeros((BLOCK,), tl.int1)
    if water is not None:
        wet = tl.load(water + pixel, here, 0) != 0
        tl.store(water_out + pixel, tl.where(wet, 255, 0).to(tl.uint8), here)
        if SHOWS_WATER:
            covered = wet
    if snow is not None:
        white = tl.load(snow + pixel, here, 0) != 0
        tl.store(snow_out + pixel, tl.where(white, 255, 0).to(tl.uint8), here)
    if scene_depth is not None:
        tl.store(scene_depth_out + pixel, tl.load(scene_depth + pixel, here, 0.0), here)
    if depth is not None:
        z = tl.load(depth + pixel, here, 0.0)
        surface = tl.zeros((BLOCK,), tl.float32)
        if SHOWS_WATER and IN_AIR:
            fall = tl.fma(fall_u, u, tl.fma(fall_v, v, fall_w))
            surface = tl.where(fall > 0, eye_m / tl.where(fall > 0, fall, 1.0), float("inf"))
        tl.store(depth_out + pixel, tl.where(covered, surface, z), here)
    if splat_ids is not None:
        splat = tl.load(splat_ids + pixel, here, -1)
        solid = tl.load(alpha + pixel, here, 0.0) >= least_alpha
        seen = here & solid & (splat >= 0) & ~covered
        row = parts + _part_of(splat, parts, part_count, halvings, seen) * COLUMNS
        if semantic_out is not None:
            none = tl.where(covered, water_class, sky_class)
            shown = tl.where(seen, _class_of(splat, row, seen).to(tl.int32), none)
            tl.store(semantic_out + pixel, shown.to(tl.uint8), here)
        if instance_out is not None:
            instance = tl.load(row + INSTANCE, seen, 0)
            tl.store(instance_out + pixel, instance.to(tl.int16), here)
