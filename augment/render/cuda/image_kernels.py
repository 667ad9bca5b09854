"""Triton kernel: the images of a view as files hold them, all of them in one pass.

Definition: augment.views.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.render import fog
from augment.render import sh as sh_layout

# --------------------------------------------------------------------------------------------------
# Triton functions: the sky in a direction, and what is seen of it and of surfaces through fog.
# Definitions: augment.sky, augment.render.fog.

LOG2_E = tl.constexpr(math.log2(math.e))
MAX_EXPONENT = tl.constexpr(fog.MAX_EXPONENT)
# exp(-tau) from there on is below the least normal float32.
MAX_DEPTH = tl.constexpr(126.0)


@triton.jit
def transmittance(tau):
    """exp(-tau) for tau >= 0, which may be infinite; exactly 1 at 0."""
    return tl.exp2(tl.maximum(tau * -LOG2_E, -MAX_DEPTH))


@triton.jit
def mean_density(eye_height, up):
    """Mean density of layered fog from the eye to a point, relative to its base.

    exp(-min(a, b)) (1 - exp(-x)) / x with x = |b - a|. eye_height: a, the eye's height above the
    base in scale heights. up: b - a, likewise.
    """
    x = tl.abs(up)
    series = tl.fma(x, 1 / 120, -1 / 24)
    series = tl.fma(x, series, 1 / 6)
    series = tl.fma(x, series, -1 / 2)
    series = tl.fma(x, series, 1.0)
    # Below 0.1 the difference 1 - exp(-x) has lost a digit, and the series' next term is 1e-8.
    short = x < 0.1
    mean = tl.where(short, series, (1.0 - transmittance(x)) / tl.where(short, 1.0, x))
    lowest = eye_height + tl.minimum(up, 0.0)
    power = tl.minimum(-lowest, MAX_EXPONENT) * LOG2_E
    return tl.exp2(tl.maximum(power, -MAX_DEPTH)) * mean


@triton.jit
def sky_transmittance(x, y, z, strength):
    """What layered fog lets through of the sky in a direction of any length.

    strength: the fog's optical depth straight up. 0 for rays that do not climb.
    """
    climbs = z > 0
    tau = strength * tl.sqrt(x * x + y * y + z * z) / tl.where(climbs, z, 1.0)
    return tl.where(climbs, transmittance(tau), 0.0)


@triton.jit
def cubemap_color(faces, side, x, y, z, mask):
    """Red, green and blue of a cube map in directions of any length, bilinear.

    faces: float32 [6, side, side, 3] with one texel of their neighbours around each
    (augment.sky.with_border).
    """
    ax, ay, az = tl.abs(x), tl.abs(y), tl.abs(z)
    along_x = (ax >= ay) & (ax >= az)
    along_y = ay >= az
    axis = tl.where(along_x, x, tl.where(along_y, y, z))
    positive = axis >= 0
    face = tl.where(along_x, 0, tl.where(along_y, 2, 4)) + tl.where(positive, 0, 1)
    s_other = tl.where(along_y, x, tl.where(positive, x, -x))
    s = tl.where(along_x, tl.where(positive, -z, z), s_other)
    t = tl.where(along_x | (az > ay), -y, tl.where(positive, z, -z))
    scale = (side - 2).to(tl.float32) * 0.5
    inverse = scale / tl.abs(axis)
    middle = scale + 0.5  # of a face, from the centre of the first texel of its border
    column, row = tl.fma(s, inverse, middle), tl.fma(t, inverse, middle)
    c0, r0 = column.to(tl.int32), row.to(tl.int32)
    fc, fr = column - c0.to(tl.float32), row - r0.to(tl.float32)
    first = faces + 3 * ((face * side + r0) * side + c0)
    red = _bilinear(first, side, fc, fr, mask)
    green = _bilinear(first + 1, side, fc, fr, mask)
    return red, green, _bilinear(first + 2, side, fc, fr, mask)


@triton.jit
def _bilinear(first, side, fc, fr, mask):
    """Between four texels, of which `first` are the upper left ones."""
    below = first + 3 * side
    top = tl.load(first, mask, 0.0) * (1.0 - fc) + tl.load(first + 3, mask, 0.0) * fc
    bottom = tl.load(below, mask, 0.0) * (1.0 - fc) + tl.load(below + 3, mask, 0.0) * fc
    return top * (1.0 - fr) + bottom * fr


# --------------------------------------------------------------------------------------------------
# Triton kernels: the sky behind the splats, fog on finished images, colour maps, finished pixels.
# Images are flat: pixel p is column p % width of row p // width.


@triton.jit
def pixels_of(count, width, cx, cy, ifx, ify, BLOCK: tl.constexpr):
    """(pixel, whether there is one, u, v): this program's pixels and x / z, y / z of their rays."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = pixel // width
    u = ((pixel - row * width).to(tl.float32) + 0.5 - cx) * ifx
    v = (row.to(tl.float32) + 0.5 - cy) * ify
    return pixel, pixel < count, u, v


@triton.jit
def _load_color(rgb, pixel, mask):
    at = rgb + 3 * pixel
    return tl.load(at, mask, 0.0), tl.load(at + 1, mask, 0.0), tl.load(at + 2, mask, 0.0)


@triton.jit
def _store_color(rgb, pixel, red, green, blue, mask):
    at = rgb + 3 * pixel
    tl.store(at, red, mask)
    tl.store(at + 1, green, mask)
    tl.store(at + 2, blue, mask)


@triton.jit(do_not_specialize=["count"])
def composite_color(rgb, alpha, out, count, red, green, blue, BLOCK: tl.constexpr):
    """out = rgb + (1 - alpha) of one colour."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = pixel < count
    r, g, b = _load_color(rgb, pixel, here)
    transmittance = 1.0 - tl.load(alpha + pixel, here, 1.0)
    r, g, b = (
        tl.fma(transmittance, red, r),
        tl.fma(transmittance, green, g),
        tl.fma(transmittance, blue, b),
    )
    _store_color(out, pixel, r, g, b, here)


@triton.jit(do_not_specialize=["count", "width", "side"])
def composite_cubemap(
    rgb, alpha, faces, out,
    count, width, side, cx, cy, ifx, ify,
    xu, xv, xw, yu, yv, yw, zu, zv, zw,
    strength, red, green, blue,
    FOG: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """out = rgb + (1 - alpha) sky of a cube map, with FOG through the layered fog before it.

    side: of a face with its border. xu ... zw: rows of world_from_camera. strength: optical depth
    of the fog straight up; red, green, blue: its airlight.
    """
    pixel, here, u, v = pixels_of(count, width, cx, cy, ifx, ify, BLOCK)
    x = tl.fma(xu, u, tl.fma(xv, v, xw))
    y = tl.fma(yu, u, tl.fma(yv, v, yw))
    z = tl.fma(zu, u, tl.fma(zv, v, zw))
    sky_r, sky_g, sky_b = cubemap_color(faces, side, x, y, z, here)
    if FOG:
        visible = sky_transmittance(x, y, z, strength)
        hidden = 1.0 - visible
        sky_r = tl.fma(visible, sky_r, hidden * red)
        sky_g = tl.fma(visible, sky_g, hidden * green)
        sky_b = tl.fma(visible, sky_b, hidden * blue)
    r, g, b = _load_color(rgb, pixel, here)
    transmittance = 1.0 - tl.load(alpha + pixel, here, 1.0)
    r, g, b = (
        tl.fma(transmittance, sky_r, r),
        tl.fma(transmittance, sky_g, g),
        tl.fma(transmittance, sky_b, b),
    )
    _store_color(out, pixel, r, g, b, here)


@triton.jit(do_not_specialize=["count", "width"])
def fog(
    rgb, alpha, depth, out,
    count, width, cx, cy, ifx, ify,
    sigma, red, green, blue, eye_height, up_u, up_v, up_w,
    LAYERED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Deferred fog on premultiplied colour (augment.render.fog.fog_buffers).

    eye_height: above the fog's base. up_u, up_v, up_w: what x / z, y / z and 1 of a ray climb per
    metre of depth. Both in scale heights; read with LAYERED only.
    """
    pixel, here, u, v = pixels_of(count, width, cx, cy, ifx, ify, BLOCK)
    z = tl.load(depth + pixel, here, 0.0)
    tau = sigma * (z * tl.sqrt(tl.fma(u, u, tl.fma(v, v, 1.0))))
    if LAYERED:
        tau *= mean_density(eye_height, z * tl.fma(up_u, u, tl.fma(up_v, v, up_w)))
    t = transmittance(tau)
    airlight = (1.0 - t) * tl.load(alpha + pixel, here, 0.0)
    r, g, b = _load_color(rgb, pixel, here)
    r, g, b = (
        tl.fma(t, r, airlight * red),
        tl.fma(t, g, airlight * green),
        tl.fma(t, b, airlight * blue),
    )
    _store_color(out, pixel, r, g, b, here)


@triton.jit(do_not_specialize=["count"])
def map_colors(
    rgb, count,
    rr, rg, rb, r1, gr, gg, gb, g1, br, bg, bb, b1,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Every colour becomes M[:, :3] @ colour + M[:, 3], in place. rr ... b1: M, row by row."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = pixel < count
    r, g, b = _load_color(rgb, pixel, here)
    red = tl.fma(rr, r, tl.fma(rg, g, tl.fma(rb, b, r1)))
    green = tl.fma(gr, r, tl.fma(gg, g, tl.fma(gb, b, g1)))
    blue = tl.fma(br, r, tl.fma(bg, g, tl.fma(bb, b, b1)))
    _store_color(rgb, pixel, red, green, blue, here)


@triton.jit(do_not_specialize=["count"])
def renormalise_alpha(alpha, rgb, overlay, count, least, BLOCK: tl.constexpr):
    """Pixels of alpha >= least become opaque, and what they hold grows with it, in place.

    rgb, overlay: None where there is no such image.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    a = tl.load(alpha + pixel, pixel < count, 0.0)
    done = (a >= least) & (pixel < count)
    scale = 1.0 / tl.where(done, a, 1.0)
    tl.store(alpha + pixel, 1.0, done)
    if rgb is not None:
        r, g, b = _load_color(rgb, pixel, done)
        _store_color(rgb, pixel, r * scale, g * scale, b * scale, done)
    if overlay is not None:
        value = tl.load(overlay + pixel, done, 0.0)
        tl.store(overlay + pixel, value * scale, done)


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
    rgb, depth, scene_depth, water, overlay, alpha, splat_ids, parts,
    rgb_out, depth_out, scene_depth_out, water_out, overlay_out, semantic_out, instance_out,
    count, width, part_count, halvings,
    cx, cy, ifx, ify, fall_u, fall_v, fall_w, eye_m,
    min_alpha, sky_class, water_class,
    SHOWS_WATER: tl.constexpr, IN_AIR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Every image that there is something to make of; None stands for the others.

    water, overlay: uint8, 1 where they are. alpha, splat_ids: of the surfaces that classes and
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
    if overlay is not None:
        white = tl.load(overlay + pixel, here, 0) != 0
        tl.store(overlay_out + pixel, tl.where(white, 255, 0).to(tl.uint8), here)
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
        solid = tl.load(alpha + pixel, here, 0.0) >= min_alpha
        seen = here & solid & (splat >= 0) & ~covered
        row = parts + _part_of(splat, parts, part_count, halvings, seen) * COLUMNS
        if semantic_out is not None:
            none = tl.where(covered, water_class, sky_class)
            shown = tl.where(seen, _class_of(splat, row, seen).to(tl.int32), none)
            tl.store(semantic_out + pixel, shown.to(tl.uint8), here)
        if instance_out is not None:
            instance = tl.load(row + INSTANCE, seen, 0)
            tl.store(instance_out + pixel, instance.to(tl.int16), here)


# ---- Triton kernel: colour maps folded into spherical harmonics, at the speed of memory. ---------
# A program's lanes each take four colours in a row: twelve numbers, three 16-byte vectors.

FOLDED = tl.constexpr(sh_layout.FOLDED)
OFFSET = tl.constexpr(9)  # of what the first function gets, in a folded map
CHANGES = tl.constexpr(sh_layout.FOLDED - 1)


@triton.jit
def map_sh(
    source, target, numbers, classes, folded, least,
    FUNCTIONS: tl.constexpr, BY_CLASS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """target = source with every splat's functions mapped; both float32 [numbers], or one array.

    numbers: 3 FUNCTIONS of every splat. classes: int16, rows of folded [C, FOLDED], read where
    BY_CLASS; else all take the first. least: what shows of a colour, where FUNCTIONS is 1.
    """
    quad = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    place = quad[:, None] * 12 + tl.arange(0, 4)[None, :]
    first = tl.load(source + place, mask=place < numbers, other=0.0)
    second = tl.load(source + place + 4, mask=place + 4 < numbers, other=0.0)
    third = tl.load(source + place + 8, mask=place + 8 < numbers, other=0.0)
    r0, g0, b0, r1 = _parts(first)
    g1, b1, r2, g2 = _parts(second)
    b2, r3, g3, b3 = _parts(third)
    r0, g0, b0 = _color(r0, g0, b0, quad, 0, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    r1, g1, b1 = _color(r1, g1, b1, quad, 1, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    r2, g2, b2 = _color(r2, g2, b2, quad, 2, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    r3, g3, b3 = _color(r3, g3, b3, quad, 3, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    tl.store(target + place, _joined(r0, g0, b0, r1), mask=place < numbers)
    tl.store(target + place + 4, _joined(g1, b1, r2, g2), mask=place + 4 < numbers)
    tl.store(target + place + 8, _joined(b2, r3, g3, b3), mask=place + 8 < numbers)


@triton.jit
def _color(
    red, green, blue, quad, NUMBER: tl.constexpr, numbers, classes, folded, least,
    FUNCTIONS: tl.constexpr, BY_CLASS: tl.constexpr,
):  # fmt: skip
    """The mapped colour that is NUMBER of each quad."""
    if FUNCTIONS % 4 == 0:  # a splat's functions fill whole quads, which share its map
        splat = quad // (FUNCTIONS // 4)
        is_first = (quad % (FUNCTIONS // 4) == 0) & (NUMBER == 0)
    else:
        splat = (quad * 4 + NUMBER) // FUNCTIONS
        is_first = (quad * 4 + NUMBER) % FUNCTIONS == 0
    if BY_CLASS:
        known = splat * (3 * FUNCTIONS) < numbers
        row = folded + FOLDED * tl.load(classes + splat, mask=known, other=0).to(tl.int32)
    else:
        row = folded
    shown_red, shown_green, shown_blue = red, green, blue
    if FUNCTIONS == 1:
        shown_red = tl.maximum(red, least)
        shown_green = tl.maximum(green, least)
        shown_blue = tl.maximum(blue, least)
    changes = tl.load(row + CHANGES) != 0
    return (
        tl.where(changes, _row(shown_red, shown_green, shown_blue, row, 0, is_first), red),
        tl.where(changes, _row(shown_red, shown_green, shown_blue, row, 1, is_first), green),
        tl.where(changes, _row(shown_red, shown_green, shown_blue, row, 2, is_first), blue),
    )


@triton.jit
def _row(red, green, blue, row, CHANNEL: tl.constexpr, is_first):
    mapped = tl.load(row + 3 * CHANNEL) * red
    mapped += tl.load(row + 3 * CHANNEL + 1) * green
    mapped += tl.load(row + 3 * CHANNEL + 2) * blue
    return tl.where(is_first, mapped + tl.load(row + OFFSET + CHANNEL), mapped)


@triton.jit
def _parts(four):
    """The columns of [N, 4]."""
    even, odd = tl.split(tl.reshape(four, (four.shape[0], 2, 2)))
    a, c = tl.split(even)
    b, d = tl.split(odd)
    return a, b, c, d


@triton.jit
def _joined(a, b, c, d):
    return tl.reshape(tl.join(tl.join(a, c), tl.join(b, d)), (a.shape[0], 4))
