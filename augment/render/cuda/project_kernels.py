"""Triton kernel that projects the Gaussians of all parts to splats of one image.

`cuda.driver` launches `project_gaussians`. The definition is augment.render.reference.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.render import fog, layout, sh, shading
from augment.render.cuda import splats

# ---- Triton functions: transmittance of fog (augment.render.fog) ---------------------------------

LOG2_E = tl.constexpr(math.log2(math.e))
MAX_EXPONENT = tl.constexpr(fog.MAX_EXPONENT)
# Exponent of 2 from which exp(-tau) is below the smallest normal float32.
MAX_DEPTH = tl.constexpr(126.0)


@triton.jit
def transmittance(tau):
    """Return exp(-tau) for tau >= 0, which may be infinite; exactly 1 at 0."""
    return tl.exp2(tl.maximum(tau * -LOG2_E, -MAX_DEPTH))


@triton.jit
def mean_density(eye_height, climb):
    """Return the mean density of layered fog from the eye to a point, relative to its base.

    It is exp(-min(a, b)) (1 - exp(-x)) / x with x = |b - a|.

    Args:
        eye_height: a, the eye's height above the base, scale heights.
        climb: b - a, scale heights.
    """
    x = tl.abs(climb)
    series = tl.fma(x, 1 / 120, -1 / 24)
    series = tl.fma(x, series, 1 / 6)
    series = tl.fma(x, series, -1 / 2)
    series = tl.fma(x, series, 1.0)
    # Below 0.1 the difference 1 - exp(-x) has lost a digit, and the series' next term is 1e-8.
    is_short = x < 0.1
    mean = tl.where(is_short, series, (1.0 - transmittance(x)) / tl.where(is_short, 1.0, x))
    lowest = eye_height + tl.minimum(climb, 0.0)
    power = tl.minimum(-lowest, MAX_EXPONENT) * LOG2_E
    return tl.exp2(tl.maximum(power, -MAX_DEPTH)) * mean


# ---- Triton functions: Gaussians in the camera, and their ellipses in the image ------------------
# A view is read through a pointer to its VIEW numbers (see layout); triples are tuples. Sums of
# products name their fused multiply-adds, so that a splat has the same bits whatever else a kernel
# computes beside it.

V_ROTATION = tl.constexpr(layout.V_ROTATION)
V_EYE = tl.constexpr(layout.V_EYE)
V_FOCAL = tl.constexpr(layout.V_FOCAL)
V_CENTRE = tl.constexpr(layout.V_CENTRE)
V_LOW = tl.constexpr(layout.V_LOW)
V_HIGH = tl.constexpr(layout.V_HIGH)
V_PARALLEL = tl.constexpr(layout.V_PARALLEL)


@triton.jit
def floats_at(address):
    """Return the float32 array that starts at an address."""
    return address.to(tl.pointer_type(tl.float32))


@triton.jit
def three(pointer):
    """Return three numbers, or three blocks of them, side by side in memory."""
    return tl.load(pointer), tl.load(pointer + 1), tl.load(pointer + 2)


@triton.jit
def three_where(pointer, mask):
    return (
        tl.load(pointer, mask, 0.0),
        tl.load(pointer + 1, mask, 0.0),
        tl.load(pointer + 2, mask, 0.0),
    )


@triton.jit
def four_where(pointer, mask):
    """Return four numbers each, in one read of 16 bytes; they begin at a multiple of 16 bytes."""
    places = tl.multiple_of(pointer[:, None] + tl.arange(0, 4)[None, :], (16, 16))
    numbers = tl.load(places, mask[:, None], 0.0)
    even, odd = tl.split(tl.reshape(numbers, (pointer.shape[0], 2, 2)))
    first, third = tl.split(even)
    second, fourth = tl.split(odd)
    return first, second, third, fourth


@triton.jit
def eight(a, b, c, d, e, f, g, h):
    """Return eight blocks side by side, [B, 8]."""
    even = tl.join(tl.join(a, e), tl.join(c, g))
    odd = tl.join(tl.join(b, f), tl.join(d, h))
    return tl.reshape(tl.join(even, odd), (a.shape[0], 8))


@triton.jit
def dot(a, b):
    return tl.fma(a[0], b[0], tl.fma(a[1], b[1], a[2] * b[2]))


@triton.jit
def cross(a, b, scale):
    """Return the cross product of two triples, times a number."""
    return (
        tl.fma(a[1], b[2], -(a[2] * b[1])) * scale,
        tl.fma(a[2], b[0], -(a[0] * b[2])) * scale,
        tl.fma(a[0], b[1], -(a[1] * b[0])) * scale,
    )


@triton.jit
def from_eye(means, view):
    """Return means minus the camera's centre, in the part's axes.

    This subtraction comes first, so that digits are kept.
    """
    eye = three(view + V_EYE)
    remainder = three(view + V_EYE + 3)
    return (
        means[0] - eye[0] - remainder[0],
        means[1] - eye[1] - remainder[1],
        means[2] - eye[2] - remainder[2],
    )


@triton.jit
def rotation_rows(view):
    rows = view + V_ROTATION
    return three(rows), three(rows + 3), three(rows + 6)


@triton.jit
def inverse_divisor(z, view):
    """Return 1 over the divisor of x and y in the projection: z, or 1 for parallel rays."""
    parallel = tl.load(view + V_PARALLEL)
    return 1.0 / tl.fma(1.0 - parallel, z, parallel)


@triton.jit
def to_image(x, y, inverse, view):
    mean_x = tl.fma(tl.load(view + V_FOCAL) * x, inverse, tl.load(view + V_CENTRE))
    mean_y = tl.fma(tl.load(view + V_FOCAL + 1) * y, inverse, tl.load(view + V_CENTRE + 1))
    return mean_x, mean_y


@triton.jit
def rotation_columns(quats):
    """Return the columns of the rotation matrices of unit quaternions wxyz."""
    w, x, y, z = quats
    return (
        (
            tl.fma(-2.0, tl.fma(y, y, z * z), 1.0),
            2.0 * tl.fma(x, y, w * z),
            2.0 * tl.fma(x, z, -(w * y)),
        ),
        (
            2.0 * tl.fma(x, y, -(w * z)),
            tl.fma(-2.0, tl.fma(x, x, z * z), 1.0),
            2.0 * tl.fma(y, z, w * x),
        ),
        (
            2.0 * tl.fma(x, z, w * y),
            2.0 * tl.fma(y, z, -(w * x)),
            tl.fma(-2.0, tl.fma(x, x, y * y), 1.0),
        ),
    )


@triton.jit
def along_axes(direction, columns, sizes):
    """Return a direction's part along each semi-axis: columns of a rotation, times lengths."""
    return (
        sizes[0] * dot(direction, columns[0]),
        sizes[1] * dot(direction, columns[1]),
        sizes[2] * dot(direction, columns[2]),
    )


@triton.jit
def image_axes(x, y, inverse, columns, sizes, view):
    """Return ellipsoids' semi-axes in the image, px right (3) and px down (3).

    The projection is linearised at the splat's centre, or at the nearest point within the limits of
    the Jacobian.
    """
    r, s, t = rotation_rows(view)
    u = tl.minimum(tl.maximum(x * inverse, tl.load(view + V_LOW)), tl.load(view + V_HIGH))
    v = tl.minimum(tl.maximum(y * inverse, tl.load(view + V_LOW + 1)), tl.load(view + V_HIGH + 1))
    fx = tl.load(view + V_FOCAL) * inverse
    fy = tl.load(view + V_FOCAL + 1) * inverse
    right = (fx * tl.fma(-u, t[0], r[0]), fx * tl.fma(-u, t[1], r[1]), fx * tl.fma(-u, t[2], r[2]))
    down = (fy * tl.fma(-v, t[0], s[0]), fy * tl.fma(-v, t[1], s[1]), fy * tl.fma(-v, t[2], s[2]))
    return along_axes(right, columns, sizes), along_axes(down, columns, sizes)


# ---- Triton functions: colour of a splat towards the camera, from SH of degrees 0 to 3, then fog -

LAYERED_FOG = tl.constexpr(layout.LAYERED_FOG)
MAP = tl.constexpr(layout.MAP)
V_EXTINCTION = tl.constexpr(layout.V_EXTINCTION)
V_AIRLIGHT = tl.constexpr(layout.V_AIRLIGHT)
V_EYE_HEIGHT = tl.constexpr(layout.V_EYE_HEIGHT)
V_UP = tl.constexpr(layout.V_UP)

C0 = tl.constexpr(sh.SH_C0)
C1 = tl.constexpr(sh.C1)
C2_XY = tl.constexpr(sh.C2_XY)
C2_ZZ = tl.constexpr(sh.C2_ZZ)
C2_XX = tl.constexpr(sh.C2_XX)
C3_CUBIC = tl.constexpr(sh.C3_CUBIC)
C3_XYZ = tl.constexpr(sh.C3_XYZ)
C3_ZZ = tl.constexpr(sh.C3_ZZ)
C3_ZZZ = tl.constexpr(sh.C3_ZZZ)
C3_ZXX = tl.constexpr(sh.C3_ZXX)


@triton.jit
def through_fog(d, distance, view, FOG: tl.constexpr):
    """Return the transmittance from the eye to splats; d: from the eye, in the part's axes."""
    tau = tl.load(view + V_EXTINCTION) * distance
    if FOG == LAYERED_FOG:
        tau = tau * mean_density(tl.load(view + V_EYE_HEIGHT), dot(three(view + V_UP), d))
    return transmittance(tau)


@triton.jit
def color_of(sh, num_functions, directions, distance, mask, FUNCTIONS: tl.constexpr):
    """Return max(0.5 + sum sh Y, 0).

    Args:
        sh: pointers to every splat's coefficients.
        num_functions: number of SH functions of a splat.
        directions: vectors from the eye, in the part's axes, of length `distance`.
        distance: their lengths.
        mask: splats that are drawn.
        FUNCTIONS: largest number of functions that is read.
    """
    inverse = 1.0 / distance
    x = directions[0] * inverse
    y = directions[1] * inverse
    z = directions[2] * inverse
    basis = sh_basis(x, y, z, FUNCTIONS)
    half = tl.full(x.shape, 0.5, tl.float32)
    color = (half, half, half)
    num_read = tl.where(mask, num_functions, 0)
    if num_functions % 4 == 0:
        color = _sum_fours(color, sh, basis, num_read, FUNCTIONS)
    else:
        color = _sum_ones(color, sh, basis, num_read, FUNCTIONS)
    return tl.maximum(color[0], 0.0), tl.maximum(color[1], 0.0), tl.maximum(color[2], 0.0)


@triton.jit
def sh_basis(x, y, z, FUNCTIONS: tl.constexpr):
    """Return spherical harmonics of unit directions (see render.sh); 0 for those not read."""
    zero = tl.zeros_like(x)
    y0 = zero + C0
    y1 = zero
    y2 = zero
    y3 = zero
    y4 = zero
    y5 = zero
    y6 = zero
    y7 = zero
    y8 = zero
    y9 = zero
    y10 = zero
    y11 = zero
    y12 = zero
    y13 = zero
    y14 = zero
    y15 = zero
    if FUNCTIONS > 1:
        y1 = y * -C1
        y2 = z * C1
        y3 = x * -C1
    if FUNCTIONS > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        xy = x * y
        y4 = xy * C2_XY
        y5 = y * z * -C2_XY
        y7 = x * z * -C2_XY
        y6 = (2.0 * zz - xx - yy) * C2_ZZ
        y8 = (xx - yy) * C2_XX
        if FUNCTIONS > 9:
            y9 = y * tl.fma(3.0, xx, -yy) * -C3_CUBIC
            y15 = x * tl.fma(-3.0, yy, xx) * -C3_CUBIC
            y10 = xy * z * C3_XYZ
            y14 = z * (xx - yy) * C3_ZXX
            y11 = y * (4.0 * zz - xx - yy) * -C3_ZZ
            y13 = x * (4.0 * zz - xx - yy) * -C3_ZZ
            y12 = z * tl.fma(-3.0, xx + yy, 2.0 * zz) * C3_ZZZ
    return y0, y1, y2, y3, y4, y5, y6, y7, y8, y9, y10, y11, y12, y13, y14, y15


@triton.jit
def _sum_ones(color, sh, basis, num_read, FUNCTIONS: tl.constexpr):
    """Return colour plus coefficients times basis, one function at a time."""
    for k in tl.static_range(FUNCTIONS):
        coefficients = sh + 3 * k
        mask = num_read > k
        red = tl.load(coefficients, mask, 0.0)
        green = tl.load(coefficients + 1, mask, 0.0)
        blue = tl.load(coefficients + 2, mask, 0.0)
        color = _add(color, basis[k], red, green, blue)
    return color


@triton.jit
def _sum_fours(color, sh, basis, num_read, FUNCTIONS: tl.constexpr):
    """Return the same as _sum_ones, by reads of 16 bytes.

    Four functions of a splat fill three such reads, and rows of 4 and of 16 functions begin at a
    multiple of 16 bytes.
    """
    for k in tl.static_range(0, FUNCTIONS, 4):
        red, green, blue, red1 = four_where(sh + 3 * k, num_read > k)
        color = _add(color, basis[k], red, green, blue)
        if k + 1 < FUNCTIONS:
            green1, blue1, red2, green2 = four_where(sh + 3 * k + 4, num_read > k)
            blue2, red3, green3, blue3 = four_where(sh + 3 * k + 8, num_read > k)
            color = _add(color, basis[k + 1], red1, green1, blue1)
            color = _add(color, basis[k + 2], red2, green2, blue2)
            color = _add(color, basis[k + 3], red3, green3, blue3)
    return color


@triton.jit
def _add(color, value, red, green, blue):
    return (
        tl.fma(value, red, color[0]),
        tl.fma(value, green, color[1]),
        tl.fma(value, blue, color[2]),
    )


@triton.jit
def map_colors(color, maps, rows, map_count, mask):
    """Return colours under their colour maps. A row that is not among the maps means the first map.

    Args:
        color: the colours.
        maps: maps of the part, [C, 3, 4].
        rows: pointers to every Gaussian's row, int16; read if there is more than one map.
        map_count: number of maps.
        mask: splats that are drawn.
    """
    map_row = tl.zeros(mask.shape, tl.int32)
    if map_count > 1:
        map_row = tl.load(rows, mask, 0).to(tl.int32)
        map_row = tl.where((map_row >= 0) & (map_row < map_count), map_row, 0)
    at = maps + map_row * MAP
    return (
        _map_channel(at, color, mask),
        _map_channel(at + 4, color, mask),
        _map_channel(at + 8, color, mask),
    )


@triton.jit
def _map_channel(at, color, mask):
    """Return one row of the maps applied to the colours; not below 0."""
    red, green, blue, more = four_where(at, mask)
    value = tl.fma(green, color[1], tl.fma(red, color[0], more))
    return tl.maximum(tl.fma(blue, color[2], value), 0.0)


@triton.jit
def in_fog(color, transmittance, view):
    """Return colours seen through the fog; a transmittance of 1 keeps their bits."""
    airlight = three(view + V_AIRLIGHT)
    fog_share = 1.0 - transmittance
    return (
        tl.fma(transmittance, color[0], fog_share * airlight[0]),
        tl.fma(transmittance, color[1], fog_share * airlight[1]),
        tl.fma(transmittance, color[2], fog_share * airlight[2]),
    )


# ---- Triton functions: splats cut at a height (see augment.render.layout) ------------------------

FAR = tl.constexpr(layout.FAR_PX)
SHARP = tl.constexpr(layout.SHARP_PX2)
TINY = tl.constexpr(1e-20)
V_EXTENT = tl.constexpr(layout.V_EXTENT)
V_CLIP_EYE = tl.constexpr(layout.V_CLIP_EYE)
V_CLIP_PART = tl.constexpr(layout.V_CLIP_PART)
V_CLIP_CAMERA = tl.constexpr(layout.V_CLIP_CAMERA)
V_CLIP_EDGE = tl.constexpr(layout.V_CLIP_EDGE)
V_CLIP_REACH = tl.constexpr(layout.V_CLIP_REACH)
V_CLIP_FALL = tl.constexpr(layout.V_CLIP_FALL)
V_CLIP_LONGEST = tl.constexpr(layout.V_CLIP_LONGEST)


@triton.jit
def cut_of(d, right, down, columns, sizes, inverse, view):
    """Return which splats have a part on the kept side, and their cuts, [B, CUT] as in layout."""
    up = three(view + V_CLIP_PART)
    extent = tl.load(view + V_EXTENT)
    rise = along_axes(up, columns, sizes)
    away = along_axes(three(view + V_ROTATION + 6), columns, sizes)
    height = dot(up, d) + tl.load(view + V_CLIP_EYE)
    reach = extent * tl.sqrt(dot(rise, rise))
    gx, gy = _depth_slope(right, down, away)

    fall = tl.load(view + V_CLIP_FALL) * inverse * inverse
    lx = tl.fma(-fall, gx, tl.load(view + V_CLIP_CAMERA) / tl.load(view + V_FOCAL))
    ly = tl.fma(-fall, gy, tl.load(view + V_CLIP_CAMERA + 1) / tl.load(view + V_FOCAL + 1))
    scale = 1.0 / tl.maximum(tl.sqrt(tl.fma(lx, lx, ly * ly)), TINY)
    offset = tl.maximum(tl.minimum(height * inverse * scale, FAR), -FAR)
    is_uncut = height >= reach
    offset = tl.where(is_uncut, FAR, offset) + tl.load(view + V_CLIP_EDGE)
    lx = tl.where(is_uncut, 0.0, lx * scale)
    ly = tl.where(is_uncut, 0.0, ly * scale)
    growth_limit = tl.sqrt(dot(away, away)) * inverse
    growth_limit = tl.minimum(extent * growth_limit, tl.load(view + V_CLIP_LONGEST))
    has_kept_part = (height + reach >= 0.0) & (height - reach <= tl.load(view + V_CLIP_REACH))
    zero = tl.zeros_like(growth_limit)
    cut = eight(offset, lx, ly, gx * inverse, gy * inverse, growth_limit, zero, zero)
    return has_kept_part, cut


@triton.jit
def _depth_slope(x, y, z):
    """Return g = S2^-1 c of semi-axes right, down and away (see augment.render.layout), per px.

    As in render.cpu.geometry, determinants are products of cross products, all divided by y.y + b,
    so that no digits cancel and nothing overflows.
    """
    inverse = 1.0 / (dot(y, y) + SHARP)
    root = tl.sqrt(inverse)
    c = cross(x, y, root)
    right = cross(z, y, root)
    down = cross(x, z, root)
    by_blur = inverse * SHARP
    det = dot(c, c) + tl.fma(by_blur, dot(x, x), SHARP)
    gx = tl.fma(by_blur, dot(x, z), dot(c, right))
    gy = tl.fma(by_blur, dot(y, z), dot(c, down))
    return gx / det, gy / det


# ---- Triton functions: lines of splats that are lit pixel by pixel (see augment.render.shading) --

MIN_FACING = tl.constexpr(shading.MIN_FACING)
V_SUN = tl.constexpr(layout.V_SUN)
V_WRAP = tl.constexpr(layout.V_WRAP)


@triton.jit
def store_lights(lines, normals, points, slopes, transmittance, is_lit, mask, view):
    """Write the shading numbers of splats, all 0 for a splat that is not lit.

    Args:
        lines: pointers to every splat's numbers.
        normals: unit normals, in the part's axes.
        points: centres in the camera.
        slopes: slopes of the colour; 0 for a splat that is not lit.
        transmittance: transmittance of the fog before them.
        is_lit: splats that are lit.
        mask: splats that are drawn.
        view: numbers of the view.
    """
    r, s, t = rotation_rows(view)
    nx = dot(r, normals)
    ny = dot(s, normals)
    nz = dot(t, normals)
    is_parallel = tl.load(view + V_PARALLEL) > 0.0
    facing = tl.where(is_parallel, nz, dot((nx, ny, nz), points))
    nx = tl.where(facing > 0.0, -nx, nx)
    ny = tl.where(facing > 0.0, -ny, ny)
    nz = tl.where(facing > 0.0, -nz, nz)
    sun = three(view + V_SUN)
    wrap = tl.load(view + V_WRAP)
    inverse = 1.0 / tl.maximum(-nz, MIN_FACING)
    ax = nx * inverse
    ay = ny * inverse
    fx = tl.load(view + V_FOCAL)
    fy = tl.load(view + V_FOCAL + 1)
    scale = 1.0 / (1.0 + wrap)
    tl.store(lines, tl.where(is_lit, dot((nx, ny, nz), sun) * scale, 0.0), mask)
    tl.store(lines + 1, tl.where(is_lit, tl.fma(ax, sun[2], sun[0]) / fx * scale, 0.0), mask)
    tl.store(lines + 2, tl.where(is_lit, tl.fma(ay, sun[2], sun[1]) / fy * scale, 0.0), mask)
    tl.store(lines + 3, tl.where(is_lit, wrap * scale, 0.0), mask)
    tl.store(lines + 4, tl.where(is_lit, ax / fx, 0.0), mask)
    tl.store(lines + 5, tl.where(is_lit, ay / fy, 0.0), mask)
    tl.store(lines + 6, transmittance * slopes[0], mask)
    tl.store(lines + 7, transmittance * slopes[1], mask)
    tl.store(lines + 8, transmittance * slopes[2], mask)


COLUMNS = tl.constexpr(splats.COLUMNS)
T_COUNT = tl.constexpr(splats.T_COUNT)
T_FUNCTIONS = tl.constexpr(splats.T_FUNCTIONS)
T_FIRST = tl.constexpr(splats.T_FIRST)
T_BLOCK = tl.constexpr(splats.T_BLOCK)
A_MEANS = tl.constexpr(layout.A_MEANS)
A_QUATS = tl.constexpr(layout.A_QUATS)
A_SCALES = tl.constexpr(layout.A_SCALES)
A_OPACITIES = tl.constexpr(layout.A_OPACITIES)
A_SH = tl.constexpr(layout.A_SH)
A_SLOPES = tl.constexpr(layout.A_SLOPES)
A_MAPS = tl.constexpr(layout.A_MAPS)
A_ROWS = tl.constexpr(layout.A_ROWS)
VIEW = tl.constexpr(layout.VIEW)
V_SIZE = tl.constexpr(layout.V_SIZE)
V_NEAR = tl.constexpr(layout.V_NEAR)
V_BLUR = tl.constexpr(layout.V_BLUR)
V_ALPHA_MIN = tl.constexpr(layout.V_ALPHA_MIN)
V_LOG_CUT = tl.constexpr(layout.V_LOG_CUT)
V_RADIUS_CLIP = tl.constexpr(layout.V_RADIUS_CLIP)
V_OVERLAY = tl.constexpr(layout.V_OVERLAY)
V_LIT = tl.constexpr(layout.V_LIT)
V_MAPS = tl.constexpr(layout.V_MAPS)
NO_FOG = tl.constexpr(layout.NO_FOG)
HIDDEN = tl.constexpr(splats.HIDDEN)
TILE = tl.constexpr(splats.TILE)
# Half of log2(e): exponents of alpha are of 2.
K = tl.constexpr(0.5 * math.log2(math.e))
# Largest sum of variances, px^2: beyond it float32 overflows, which no pixel would show.
HUGE = tl.constexpr(1e37)
CUT = tl.constexpr(layout.CUT)
LINES = tl.constexpr(shading.LINES)
RECORD = tl.constexpr(layout.RECORD)


@triton.jit
def project_gaussians(
    table,
    views,
    block_parts,
    outputs,
    COLOR: tl.constexpr,
    FUNCTIONS: tl.constexpr,
    ANTIALIASED: tl.constexpr,
    FOG: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Project the Gaussians of every part; each program takes BLOCK of one part.

    Args:
        table, views, block_parts: see splats.
        outputs: fields of CudaSplats; cuts and lights are None if no mode asks for them.
        COLOR, FUNCTIONS, ANTIALIASED, FOG: the other modes (see layout).
    """
    records, keys, rects, counts, cuts, lights = outputs
    program = tl.program_id(0)
    part = tl.load(block_parts + program)
    row = table + part * COLUMNS
    view = views + part * VIEW
    # Positions in memory that all lanes share are int64; those of single lanes are int32.
    first = (program - tl.load(row + T_BLOCK)) * BLOCK
    first_row = tl.load(row + T_FIRST) + first
    lane = tl.arange(0, BLOCK)
    is_inside = lane < (tl.load(row + T_COUNT) - first).to(tl.int32)

    # Centres in the camera, and their ellipses in the image.
    means = floats_at(tl.load(row + A_MEANS)) + first * 3 + lane * 3
    d = from_eye(three_where(means, is_inside), view)
    opacity = tl.load(floats_at(tl.load(row + A_OPACITIES)) + first + lane, is_inside, 0.0)
    r, s, t = rotation_rows(view)
    x = dot(r, d)
    y = dot(s, d)
    z = dot(t, d)
    may_be_seen = (z >= tl.load(view + V_NEAR)) & (opacity >= tl.load(view + V_ALPHA_MIN))
    inverse = inverse_divisor(z, view)
    quats = floats_at(tl.load(row + A_QUATS)) + first * 4 + lane * 4
    columns = rotation_columns(four_where(quats, may_be_seen))
    scales = three_where(floats_at(tl.load(row + A_SCALES)) + first * 3 + lane * 3, may_be_seen)
    right, down = image_axes(x, y, inverse, columns, scales, view)

    xy, blurred_x, blurred_y, minors, variance_along_row = _covariance(
        right, down, tl.load(view + V_BLUR)
    )
    # Conic, and the box in which alpha reaches the cut.
    inverse_x = 1.0 / blurred_x
    inverse_y = 1.0 / blurred_y
    log_opacity = tl.log2(opacity)
    if ANTIALIASED:
        log_opacity = tl.fma(0.5, tl.log2(minors / variance_along_row), log_opacity)
    log_cut = tl.load(view + V_LOG_CUT)
    budget = tl.maximum(log_opacity - log_cut, 0.0) / K
    radius_x = tl.sqrt(budget * blurred_x)
    radius_y = tl.sqrt(budget * blurred_y)
    is_drawn = may_be_seen & (log_opacity >= log_cut) & (blurred_x + blurred_y <= HUGE)
    is_drawn = is_drawn & (tl.maximum(radius_x, radius_y) > tl.load(view + V_RADIUS_CLIP))
    if cuts is not None:
        has_kept_part, cut = cut_of(d, right, down, columns, scales, inverse, view)
        is_drawn = is_drawn & has_kept_part
    mean_x, mean_y = to_image(x, y, inverse, view)
    first_x, last_x = _pixels(mean_x, radius_x, tl.load(view + V_SIZE))
    first_y, last_y = _pixels(mean_y, radius_y, tl.load(view + V_SIZE + 1))
    is_drawn = is_drawn & (first_x <= last_x) & (first_y <= last_y)

    # Covered tiles.
    c0 = _tile(first_x, is_drawn)
    c1 = _tile(last_x, is_drawn)
    r0 = _tile(first_y, is_drawn)
    r1 = _tile(last_y, is_drawn)
    tl.store(
        keys + first_row + lane, tl.where(is_drawn, z.to(tl.int32, bitcast=True), HIDDEN), is_inside
    )
    tl.store(
        counts + first_row + lane, tl.where(is_drawn, (c1 - c0 + 1) * (r1 - r0 + 1), 0), is_inside
    )
    _store_rows(
        rects + first_row * 2, tl.join(c0 + (r0 << 16), c1 + (r1 << 16)), is_drawn, BLOCK, 2
    )

    # Colour, under its colour map and in the fog.
    zero = tl.zeros_like(z)
    color = (zero, zero, zero)
    transmittance = zero + 1.0
    if COLOR:
        directions = d
        if tl.load(view + V_PARALLEL) > 0.0:
            directions = (t[0] + zero, t[1] + zero, t[2] + zero)
        distance = tl.sqrt(dot(directions, directions))
        num_functions = tl.load(row + T_FUNCTIONS).to(tl.int32)
        sh = floats_at(tl.load(row + A_SH)) + first * 3 * num_functions + lane * 3 * num_functions
        color = color_of(sh, num_functions, directions, distance, is_drawn, FUNCTIONS)
        map_count = tl.load(view + V_MAPS).to(tl.int32)
        if map_count > 0:
            maps = floats_at(tl.load(row + A_MAPS))
            map_rows = tl.load(row + A_ROWS).to(tl.pointer_type(tl.int16)) + first + lane
            color = map_colors(color, maps, map_rows, map_count, is_drawn)
        if FOG != NO_FOG:
            transmittance = through_fog(directions, distance, view, FOG)
            color = in_fog(color, transmittance, view)

    number = (first_row.to(tl.int32) + lane).to(tl.float32, bitcast=True)
    overlay = zero + tl.load(view + V_OVERLAY)
    # In layout's order of fields, those of even number and those of odd number.
    even = eight(
        mean_x, xy * inverse_y, inverse_y * K, radius_y, xy * inverse_x, z, color[0], color[2]
    )
    odd = eight(
        mean_y,
        tl.sqrt(1.0 / variance_along_row * K),
        log_opacity,
        inverse_x * K,
        tl.sqrt(variance_along_row * blurred_y * inverse_x / K),
        number,
        color[1],
        overlay,
    )
    record = tl.reshape(tl.join(even, odd), (BLOCK, RECORD))
    _store_rows(records + first_row * RECORD, record, is_drawn, BLOCK, RECORD)
    if cuts is not None:
        _store_rows(cuts + first_row * CUT, cut, is_drawn, BLOCK, CUT)
    if lights is not None:
        is_lit = tl.where(is_drawn, tl.load(view + V_LIT), 0.0) > 0.0
        slopes = three_where(floats_at(tl.load(row + A_SLOPES)) + first * 3 + lane * 3, is_lit)
        lines = lights + first_row * LINES + lane * LINES
        store_lights(lines, columns[2], (x, y, z), slopes, transmittance, is_lit, is_drawn, view)


@triton.jit
def _covariance(right, down, blur):
    """Return xy, blurred xx and yy, px^2, and variances along a row, before the blur and after.

    The variance along a row is det / yy. By Lagrange's identity, det = |right cross down|^2, no
    digits cancel; each term is divided before it is squared, so that nothing overflows.
    """
    xx = dot(right, right)
    xy = dot(right, down)
    yy = dot(down, down)
    inverse = 1.0 / (yy + blur)
    across = cross(right, down, tl.sqrt(inverse))
    minors = dot(across, across)
    return xy, xx + blur, yy + blur, minors, blur + tl.fma(blur * xx, inverse, minors)


@triton.jit
def _pixels(mean, radius, size):
    """Return the first and last pixel whose centre lies within the radius.

    The last is below the first if there is none.
    """
    first = tl.maximum(mean - radius - 0.5, 0.0)
    last = tl.minimum(mean + radius - 0.5, size - 1.0)
    return tl.ceil(first), tl.floor(last)


@triton.jit
def _tile(pixel, is_drawn):
    return tl.where(is_drawn, pixel, 0.0).to(tl.int32) // TILE


@triton.jit
def _store_rows(pointer, rows, mask, ROWS: tl.constexpr, FIELDS: tl.constexpr):
    at = tl.arange(0, ROWS)[:, None] * FIELDS + tl.arange(0, FIELDS)[None, :]
    tl.store(pointer + at, rows, mask[:, None])
