"""Triton kernel for a water surface: what `water.shade_water` defines.

A program takes a rectangle of pixels, so that what they look up lies close together. Pixels without
water cost it nothing where there are no others; averages and the two slopes besides a pixel's own
are taken where one of its pixels is rough.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.effects.flood import refraction
from augment.effects.flood import refraction as layer_lookup
from augment.effects.flood import refraction as reflection_lookup
from augment.effects.flood import refraction as water_surface
from augment.effects.flood.cuda_screen_kernels import fall_of, falls

# ---- Where vectors lie in a layer's image, and what it shows there, for Triton kernels -----------
# A view is a layer's camera as 22 numbers (see `water_launch.view_numbers`): focal length times its
# right, down (fx, fy) and forward axes; coefficients of column, row and 1 in the x, y, z of a
# pixel's
# ray; cx, cy; the image's width and height. Vectors start at the layer's eye. Lanes outside a mask
# load nothing and get zeros.

LEVELS = tl.constexpr(layer_lookup.MIP_LEVELS)
_MIN_DEPTH = tl.constexpr(layer_lookup.MIN_DEPTH)
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
    """From a level of averages (`cuda_mip_kernels.average`) of the view's image, whole numbers."""
    width, height = tl.load(view + _WIDTH).to(tl.int32), tl.load(view + _HEIGHT).to(tl.int32)
    first = tl.zeros_like(level)
    wide, high = width, height
    for below in tl.static_range(LEVELS - 1):
        first += tl.where(level > below, wide * high, 0)
        wide, high = (wide + 1) >> 1, (high + 1) >> 1
    step = 1 << level
    wide, high = (width + step - 1) >> level, (height + step - 1) >> level
    scale = 1.0 / step.to(tl.float32)
    c0, r0, fc, fr = place(column * scale, row * scale, wide.to(tl.float32), high.to(tl.float32))
    right, below_it = tl.minimum(wide - 1, 1), tl.where(high > 1, wide, 0)
    return fetch_square(mips, first + r0 * wide + c0, below_it, right, fc, fr, mask)


# ---- Triton kernel for averages over ever larger squares of pixels: all levels in one launch -----

HALVINGS = layer_lookup.MIP_LEVELS - 1
SIDE = 2**HALVINGS  # pixels along a program's square, which becomes one of the smallest image

_HALVINGS, _SIDE = tl.constexpr(HALVINGS), tl.constexpr(SIDE)


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


# ---- cuda water kernels --------------------------------------------------------------------------

# Numbers that the kernel is given: world_from_camera; 1 / focal lengths, way from the principal
# point to the first pixel, change of the fall per column; three views; the medium; limits.
AXES, LENS, BED, MIRROR, FRONT, MEDIUM, LIMITS = 0, 9, 14, 36, 58, 80, 94

_AXES, _LENS, _BED = tl.constexpr(AXES), tl.constexpr(LENS), tl.constexpr(BED)
_MIRROR, _FRONT = tl.constexpr(MIRROR), tl.constexpr(FRONT)
_PLANE_HEIGHT, _INDEX, _EXTINCTION, _RGB = (tl.constexpr(MEDIUM + k) for k in (0, 1, 3, 6))
_SMOG, _SMOG_ABOVE, _AIRLIGHT = (tl.constexpr(MEDIUM + k) for k in (9, 10, 11))
_COVER, _SMOOTH = tl.constexpr(LIMITS), tl.constexpr(LIMITS + 1)

_FARTHEST = tl.constexpr(water_surface.FARTHEST)
_MIN_COSINE = tl.constexpr(water_surface.MIN_COSINE)
_STEEPEST = tl.constexpr(water_surface.STEEPEST)
_SOLID = tl.constexpr(layer_lookup.SOLID_ALPHA)
_BED_STEPS, _SETTLED = tl.constexpr(refraction.BED_STEPS), tl.constexpr(refraction.SETTLED_M)
_OPAQUE = tl.constexpr(refraction.MAX_OPTICAL_DEPTH)
_EDGE, _FAINT = tl.constexpr(reflection_lookup.EDGE), tl.constexpr(reflection_lookup.FAINT)
_MATCH_M = tl.constexpr(reflection_lookup.MATCH_M)
_MATCH_SHARE = tl.constexpr(reflection_lookup.MATCH_SHARE)
_TINY = tl.constexpr(1e-7)  # a weight beside 1 that changes no colour


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
    fade = clamp(border / _EDGE, 0.0, 1.0)
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

    numbers: as above. rows: of `plane_rows`. faces: flat cube map with its border, `size` squared
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
    smog = tl.load(numbers + _SMOG)
    red, green, blue = (
        tl.load(numbers + _RGB),
        tl.load(numbers + _RGB + 1),
        tl.load(numbers + _RGB + 2),
    )
    fog_r, fog_g, fog_b = (
        tl.load(numbers + _AIRLIGHT),
        tl.load(numbers + _AIRLIGHT + 1),
        tl.load(numbers + _AIRLIGHT + 2),
    )
    sum_r = tl.where(meets, tl.where(smog > 0.0, fog_r, red), 0.0)
    sum_g = tl.where(meets, tl.where(smog > 0.0, fog_g, green), 0.0)
    sum_b = tl.where(meets, tl.where(smog > 0.0, fog_b, blue), 0.0)
    if tl.max(shown.to(tl.int32), 0) > 0:
        eye = tl.load(numbers + _PLANE_HEIGHT)
        index = tl.load(numbers + _INDEX)
        # The ray, and where it meets the plane.
        dz = fall_of(rows, i, j, tl.load(numbers + _LENS + 4), shown)
        u = (j.to(tl.float32) + tl.load(numbers + _LENS + 2)) * tl.load(numbers + _LENS)
        v = (i.to(tl.float32) + tl.load(numbers + _LENS + 3)) * tl.load(numbers + _LENS + 1)
        dx = dot(numbers + _AXES, u, v, 1.0)
        dy = dot(numbers + _AXES + 3, u, v, 1.0)
        along = tl.minimum(eye / -dz, _FARTHEST)
        px, py = along * dx, along * dy
        length = tl.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = 1.0 / length
        vx, vy, vz = -dx * inverse, -dy * inverse, -dz * inverse
        near = smog * along * length
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
            needed = shown & (rest > _TINY)
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
            smog_above = tl.load(numbers + _SMOG_ABOVE)
            for tap in range(taps):
                offset = tl.where(tap == 0, 0.0, tl.where(tap == 1, spread, -spread))
                part = tl.where(rough, tl.where(tap == 0, 2.0 / 3, 1.0 / 6), 1.0)
                part = tl.where((tap > 0) & (rough == 0), 0.0, part)
                _, _, _, _, _, share, x, y, z = _facet(
                    sx + offset * vx, sy + offset * vy, vx, vy, vz, index, SCHLICK
                )
                r, g, b, a = weight * image_r, weight * image_g, weight * image_b, weight * image_a
                if HAS_MIRROR:
                    wanted = needed & (part > 0.0)
                    column, row = _in_mirror(mirror, px, py, eye, far, x, y, z)
                    r0, g0, b0, a0 = fetch_level(mips, mirror, low, column, row, wanted)
                    if taps > 1:
                        mask = wanted & (above > 0.0)
                        r1, g1, b1, a1 = fetch_level(mips, mirror, low + 1, column, row, mask)
                        keep = 1.0 - above
                        r0, g0 = keep * r0 + above * r1, keep * g0 + above * g1
                        b0, a0 = keep * b0 + above * b1, keep * a0 + above * a1
                    r, g, b, a = r + rest * r0, g + rest * g0, b + rest * b0, a + rest * a0
                through = 1.0 - a
                shines = through > _FAINT
                sky_r, sky_g, sky_b = _sky(faces, size, x, y, z, shown & shines & (part > 0.0))
                t = tl.where(smog_above >= 0.0, tl.exp(-(near + smog_above / z)), 1.0)
                whole = tl.where(shines, 1.0, 1.0 / tl.maximum(a, 0.5))
                clear_sky = tl.where(shines, through * t, 0.0)
                hazy_sky = tl.where(shines, through * (1.0 - t), 0.0)
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
