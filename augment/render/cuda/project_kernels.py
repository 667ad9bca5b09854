"""Triton kernel: Gaussians of all parts to splats of one image."""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.render import fog, layout, sh, shading
from augment.render.cuda import splats

# ---- Triton functions: what is seen through fog (augment.render.fog) -----------------------------

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


# ---- Triton functions: where Gaussians stand in the camera, and which ellipses they become -------
# A view is read through a pointer to its VIEW numbers (see layout); triples are tuples. Sums of
# products name their fused multiply-adds, so that a splat has the same bits whatever else a kernel
# computes beside it.

V_ROTATION = tl.constexpr(layout.V_ROTATION)
V_EYE = tl.constexpr(layout.V_EYE)
V_FOCAL = tl.constexpr(layout.V_FOCAL)
V_CENTRE = tl.constexpr(layout.V_CENTRE)
V_LOW, V_HIGH = tl.constexpr(layout.V_LOW), tl.constexpr(layout.V_HIGH)
V_PARALLEL = tl.constexpr(layout.V_PARALLEL)


@triton.jit
def floats_at(address):
    """The float32 array that starts at a memory address."""
    return address.to(tl.pointer_type(tl.float32))


@triton.jit
def three(pointer):
    """Three numbers, or three blocks of them, side by side in memory."""
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
    """Four numbers each, in one read of 16 bytes, at a multiple of which they begin."""
    places = tl.multiple_of(pointer[:, None] + tl.arange(0, 4)[None, :], (16, 16))
    numbers = tl.load(places, mask[:, None], 0.0)
    even, odd = tl.split(tl.reshape(numbers, (pointer.shape[0], 2, 2)))
    first, third = tl.split(even)
    second, fourth = tl.split(odd)
    return first, second, third, fourth


@triton.jit
def eight(a, b, c, d, e, f, g, h):
    """Eight blocks side by side, [B, 8]. The last pairing alternates fastest, the first slowest."""
    even = tl.join(tl.join(a, e), tl.join(c, g))
    odd = tl.join(tl.join(b, f), tl.join(d, h))
    return tl.reshape(tl.join(even, odd), (a.shape[0], 8))


@triton.jit
def dot(a, b):
    return tl.fma(a[0], b[0], tl.fma(a[1], b[1], a[2] * b[2]))


@triton.jit
def cross(a, b, scale):
    """The cross product of two triples, times a number."""
    return (
        tl.fma(a[1], b[2], -(a[2] * b[1])) * scale,
        tl.fma(a[2], b[0], -(a[0] * b[2])) * scale,
        tl.fma(a[0], b[1], -(a[1] * b[0])) * scale,
    )


@triton.jit
def from_eye(means, view):
    """Means minus the camera's centre, in the part's axes: first, so that digits are kept."""
    eye, rest = three(view + V_EYE), three(view + V_EYE + 3)
    return means[0] - eye[0] - rest[0], means[1] - eye[1] - rest[1], means[2] - eye[2] - rest[2]


@triton.jit
def rotation_rows(view):
    rows = view + V_ROTATION
    return three(rows), three(rows + 3), three(rows + 6)


@triton.jit
def inverse_divisor(z, view):
    """1 over what x and y are divided by in the projection: z, or 1 where rays are parallel."""
    parallel = tl.load(view + V_PARALLEL)
    return 1.0 / tl.fma(1.0 - parallel, z, parallel)


@triton.jit
def to_image(x, y, inverse, view):
    mean_x = tl.fma(tl.load(view + V_FOCAL) * x, inverse, tl.load(view + V_CENTRE))
    mean_y = tl.fma(tl.load(view + V_FOCAL + 1) * y, inverse, tl.load(view + V_CENTRE + 1))
    return mean_x, mean_y


@triton.jit
def rotation_columns(quats):
    """Columns of the rotation matrices of unit quaternions wxyz."""
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
    """A direction's part along each semi-axis: columns of a rotation, and lengths."""
    return (
        sizes[0] * dot(direction, columns[0]),
        sizes[1] * dot(direction, columns[1]),
        sizes[2] * dot(direction, columns[2]),
    )


@triton.jit
def image_axes(x, y, inverse, columns, sizes, view):
    """Ellipsoids' semi-axes in the image, px right (3) and px down (3).

    Linearised at the splat's centre, or at the nearest point within the limits of the Jacobian.
    """
    r, s, t = rotation_rows(view)
    u = tl.minimum(tl.maximum(x * inverse, tl.load(view + V_LOW)), tl.load(view + V_HIGH))
    v = tl.minimum(tl.maximum(y * inverse, tl.load(view + V_LOW + 1)), tl.load(view + V_HIGH + 1))
    fx, fy = tl.load(view + V_FOCAL) * inverse, tl.load(view + V_FOCAL + 1) * inverse
    right = (fx * tl.fma(-u, t[0], r[0]), fx * tl.fma(-u, t[1], r[1]), fx * tl.fma(-u, t[2], r[2]))
    down = (fy * tl.fma(-v, t[0], s[0]), fy * tl.fma(-v, t[1], s[1]), fy * tl.fma(-v, t[2], s[2]))
    return along_axes(right, columns, sizes), along_axes(down, columns, sizes)


# ---- Triton functions: what colour a splat shows to the camera. SH of degrees 0 to 3, then fog --

LAYERED_FOG = tl.constexpr(layout.LAYERED_FOG)
MAP = tl.constexpr(layout.MAP)
V_SIGMA, V_AIRLIGHT = tl.constexpr(layout.V_SIGMA), tl.constexpr(layout.V_AIRLIGHT)
V_EYE_HEIGHT, V_UP = tl.constexpr(layout.V_EYE_HEIGHT), tl.constexpr(layout.V_UP)

C0, C1 = tl.constexpr(sh.SH_C0), tl.constexpr(sh.C1)
C2_XY, C2_ZZ, C2_XX = tl.constexpr(sh.C2_XY), tl.constexpr(sh.C2_ZZ), tl.constexpr(sh.C2_XX)
C3_CUBIC, C3_XYZ = tl.constexpr(sh.C3_CUBIC), tl.constexpr(sh.C3_XYZ)
C3_ZZ, C3_ZZZ, C3_ZXX = tl.constexpr(sh.C3_ZZ), tl.constexpr(sh.C3_ZZZ), tl.constexpr(sh.C3_ZXX)


@triton.jit
def through_fog(d, distance, view, FOG: tl.constexpr):
    """Transmittance from the eye to splats; d: from the eye, in the part's axes."""
    tau = tl.load(view + V_SIGMA) * distance
    if FOG == LAYERED_FOG:
        tau = tau * mean_density(tl.load(view + V_EYE_HEIGHT), dot(three(view + V_UP), d))
    return transmittance(tau)


@triton.jit
def color_of(sh, functions, towards, distance, mask, FUNCTIONS: tl.constexpr):
    """max(0.5 + sum sh Y, 0). sh: pointers to every splat's coefficients, of `functions` functions;
    FUNCTIONS: how many are read at most. towards: from the eye, in the part's axes, of length
    `distance`.
    """
    inverse = 1.0 / distance
    x, y, z = towards[0] * inverse, towards[1] * inverse, towards[2] * inverse
    basis = sh_basis(x, y, z, FUNCTIONS)
    half = tl.full(x.shape, 0.5, tl.float32)
    color = (half, half, half)
    read = tl.where(mask, functions, 0)
    if functions % 4 == 0:
        color = _sum_fours(color, sh, basis, read, FUNCTIONS)
    else:
        color = _sum_ones(color, sh, basis, read, FUNCTIONS)
    return tl.maximum(color[0], 0.0), tl.maximum(color[1], 0.0), tl.maximum(color[2], 0.0)


@triton.jit
def sh_basis(x, y, z, FUNCTIONS: tl.constexpr):
    """Spherical harmonics of unit directions, as render.sh lists them; 0 for those not read."""
    zero = tl.zeros_like(x)
    y0 = zero + C0
    y1, y2, y3, y4, y5, y6, y7, y8 = zero, zero, zero, zero, zero, zero, zero, zero
    y9, y10, y11, y12, y13, y14, y15 = zero, zero, zero, zero, zero, zero, zero
    if FUNCTIONS > 1:
        y1, y2, y3 = y * -C1, z * C1, x * -C1
    if FUNCTIONS > 4:
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        y4, y5, y7 = xy * C2_XY, y * z * -C2_XY, x * z * -C2_XY
        y6, y8 = (2.0 * zz - xx - yy) * C2_ZZ, (xx - yy) * C2_XX
        if FUNCTIONS > 9:
            y9 = y * tl.fma(3.0, xx, -yy) * -C3_CUBIC
            y15 = x * tl.fma(-3.0, yy, xx) * -C3_CUBIC
            y10, y14 = xy * z * C3_XYZ, z * (xx - yy) * C3_ZXX
            y11, y13 = y * (4.0 * zz - xx - yy) * -C3_ZZ, x * (4.0 * zz - xx - yy) * -C3_ZZ
            y12 = z * tl.fma(-3.0, xx + yy, 2.0 * zz) * C3_ZZZ
    return y0, y1, y2, y3, y4, y5, y6, y7, y8, y9, y10, y11, y12, y13, y14, y15


@triton.jit
def _sum_ones(color, sh, basis, read, FUNCTIONS: tl.constexpr):
    """Colour plus coefficients times basis; read: of how many functions. Any number in a row."""
    for k in tl.static_range(FUNCTIONS):
        at, mask = sh + 3 * k, read > k
        red, green, blue = (
            tl.load(at, mask, 0.0),
            tl.load(at + 1, mask, 0.0),
            tl.load(at + 2, mask, 0.0),
        )
        color = _add(color, basis[k], red, green, blue)
    return color


@triton.jit
def _sum_fours(color, sh, basis, read, FUNCTIONS: tl.constexpr):
    """As _sum_ones, by 16 bytes: four functions of a splat fill three such pieces, and rows of 4
    and of 16 functions begin at a multiple of 16 bytes.
    """
    for k in tl.static_range(0, FUNCTIONS, 4):
        red, green, blue, red1 = four_where(sh + 3 * k, read > k)
        color = _add(color, basis[k], red, green, blue)
        if k + 1 < FUNCTIONS:
            green1, blue1, red2, green2 = four_where(sh + 3 * k + 4, read > k)
            blue2, red3, green3, blue3 = four_where(sh + 3 * k + 8, read > k)
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
def mapped(color, maps, rows, map_count, mask):
    """Colours under their maps. maps: of the part, [C, 3, 4]; rows: pointers to every Gaussian's,
    int16, read where there is more than one map. Rows that are none mean the first.
    """
    own = tl.zeros(mask.shape, tl.int32)
    if map_count > 1:
        own = tl.load(rows, mask, 0).to(tl.int32)
        own = tl.where((own >= 0) & (own < map_count), own, 0)
    at = maps + own * MAP
    return (
        _map_channel(at, color, mask),
        _map_channel(at + 4, color, mask),
        _map_channel(at + 8, color, mask),
    )


@triton.jit
def _map_channel(at, color, mask):
    """One row of the maps applied to the colours; not below 0."""
    red, green, blue, more = four_where(at, mask)
    value = tl.fma(green, color[1], tl.fma(red, color[0], more))
    return tl.maximum(tl.fma(blue, color[2], value), 0.0)


@triton.jit
def in_fog(color, transmittance, view):
    """Colours seen through the fog; where all comes through, the same bits."""
    air, hidden = three(view + V_AIRLIGHT), 1.0 - transmittance
    return (
        tl.fma(transmittance, color[0], hidden * air[0]),
        tl.fma(transmittance, color[1], hidden * air[1]),
        tl.fma(transmittance, color[2], hidden * air[2]),
    )


# ---- Triton functions: splats cut at a height (see augment.render.layout) ------------------------
# --------------------------

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
    """Which splats have a part on the kept side, and their cuts, [B, CUT] as in layout."""
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
    whole = height >= reach
    offset = tl.where(whole, FAR, offset) + tl.load(view + V_CLIP_EDGE)
    lx, ly = tl.where(whole, 0.0, lx * scale), tl.where(whole, 0.0, ly * scale)
    deep = tl.sqrt(dot(away, away)) * inverse
    deep = tl.minimum(extent * deep, tl.load(view + V_CLIP_LONGEST))
    partly = (height + reach >= 0.0) & (height - reach <= tl.load(view + V_CLIP_REACH))
    zero = tl.zeros_like(deep)
    cut = eight(offset, lx, ly, gx * inverse, gy * inverse, deep, zero, zero)
    return partly, cut


@triton.jit
def _depth_slope(x, y, z):
    """g = S2^-1 c of semi-axes right, down and away (see augment.render.layout), per px.

    As render.cpu.geometry's: determinants as products of cross products, all divided by y.y + b, so
    that no digits cancel and nothing overflows.
    """
    inverse = 1.0 / (dot(y, y) + SHARP)
    root = tl.sqrt(inverse)
    c, right, down = cross(x, y, root), cross(z, y, root), cross(x, z, root)
    by_blur = inverse * SHARP
    det = dot(c, c) + tl.fma(by_blur, dot(x, x), SHARP)
    gx = tl.fma(by_blur, dot(x, z), dot(c, right))
    gy = tl.fma(by_blur, dot(y, z), dot(c, down))
    return gx / det, gy / det


# ---- Triton functions: lines of splats that are lit pixel by pixel (see augment.render.shading) --

MIN_FACING = tl.constexpr(shading.MIN_FACING)
V_SUN, V_WRAP = tl.constexpr(layout.V_SUN), tl.constexpr(layout.V_WRAP)


@triton.jit
def store_lights(lines, normals, points, slopes, transmittance, lit, mask, view):
    """Write the lines of splats, all 0 where they are not lit.

    lines: pointers to every splat's. normals: unit, in the part's axes; points: in the camera.
    slopes: 0 where not lit; transmittance: of the fog before them.
    """
    r, s, t = rotation_rows(view)
    nx, ny, nz = dot(r, normals), dot(s, normals), dot(t, normals)
    parallel = tl.load(view + V_PARALLEL) > 0.0
    facing = tl.where(parallel, nz, dot((nx, ny, nz), points))
    nx, ny = tl.where(facing > 0.0, -nx, nx), tl.where(facing > 0.0, -ny, ny)
    nz = tl.where(facing > 0.0, -nz, nz)
    sun, wrap = three(view + V_SUN), tl.load(view + V_WRAP)
    inverse = 1.0 / tl.maximum(-nz, MIN_FACING)
    ax, ay = nx * inverse, ny * inverse
    fx, fy = (tl.load(view + V_FOCAL), tl.load(view + V_FOCAL + 1))
    scale = 1.0 / (1.0 + wrap)
    tl.store(lines, tl.where(lit, dot((nx, ny, nz), sun) * scale, 0.0), mask)
    tl.store(lines + 1, tl.where(lit, tl.fma(ax, sun[2], sun[0]) / fx * scale, 0.0), mask)
    tl.store(lines + 2, tl.where(lit, tl.fma(ay, sun[2], sun[1]) / fy * scale, 0.0), mask)
    tl.store(lines + 3, tl.where(lit, wrap * scale, 0.0), mask)
    tl.store(lines + 4, tl.where(lit, ax / fx, 0.0), mask)
    tl.store(lines + 5, tl.where(lit, ay / fy, 0.0), mask)
    tl.store(lines + 6, transmittance * slopes[0], mask)
    tl.store(lines + 7, transmittance * slopes[1], mask)
    tl.store(lines + 8, transmittance * slopes[2], mask)


COLUMNS = tl.constexpr(splats.COLUMNS)
T_COUNT, T_FUNCTIONS = tl.constexpr(splats.T_COUNT), tl.constexpr(splats.T_FUNCTIONS)
T_FIRST, T_BLOCK = tl.constexpr(splats.T_FIRST), tl.constexpr(splats.T_BLOCK)
A_MEANS, A_QUATS = tl.constexpr(layout.A_MEANS), tl.constexpr(layout.A_QUATS)
A_SCALES, A_OPACITIES = tl.constexpr(layout.A_SCALES), tl.constexpr(layout.A_OPACITIES)
A_SH, A_SLOPES = tl.constexpr(layout.A_SH), tl.constexpr(layout.A_SLOPES)
A_MAPS, A_ROWS = tl.constexpr(layout.A_MAPS), tl.constexpr(layout.A_ROWS)
VIEW = tl.constexpr(layout.VIEW)
V_SIZE, V_NEAR = tl.constexpr(layout.V_SIZE), tl.constexpr(layout.V_NEAR)
V_BLUR, V_ALPHA_MIN = tl.constexpr(layout.V_BLUR), tl.constexpr(layout.V_ALPHA_MIN)
V_LOG_CUT, V_RADIUS_CLIP = tl.constexpr(layout.V_LOG_CUT), tl.constexpr(layout.V_RADIUS_CLIP)
V_OVERLAY = tl.constexpr(layout.V_OVERLAY)
V_LIT, V_MAPS = tl.constexpr(layout.V_LIT), tl.constexpr(layout.V_MAPS)
NO_FOG = tl.constexpr(layout.NO_FOG)
HIDDEN, TILE = tl.constexpr(splats.HIDDEN), tl.constexpr(splats.TILE)
K = tl.constexpr(0.5 * math.log2(math.e))  # exponents of alpha are of 2
HUGE = tl.constexpr(1e37)  # px^2; beyond it float32 overflows, and no pixel could tell
CUT, LINES = tl.constexpr(layout.CUT), tl.constexpr(shading.LINES)
RECORD = tl.constexpr(layout.RECORD)


@triton.jit
def project_gaussians(
    table, views, block_parts, written,
    COLOR: tl.constexpr, FUNCTIONS: tl.constexpr, ANTIALIASED: tl.constexpr, FOG: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Splats of the Gaussians of every part; each program takes BLOCK of one part.

    table, views, block_parts: see splats. written: fields of CudaSplats; cuts and lights are None
    where no mode asks for them. In capitals: the other modes (see layout).
    """
    records, keys, rects, counts, cuts, lights = written
    program = tl.program_id(0)
    part = tl.load(block_parts + program)
    row, view = table + part * COLUMNS, views + part * VIEW
    # Places in memory are int64 as far as all lanes share them, and int32 beyond.
    first = (program - tl.load(row + T_BLOCK)) * BLOCK
    out = tl.load(row + T_FIRST) + first
    lane = tl.arange(0, BLOCK)
    inside = lane < (tl.load(row + T_COUNT) - first).to(tl.int32)

    means = floats_at(tl.load(row + A_MEANS)) + first * 3 + lane * 3
    d = from_eye(three_where(means, inside), view)
    opacity = tl.load(floats_at(tl.load(row + A_OPACITIES)) + first + lane, inside, 0.0)
    r, s, t = rotation_rows(view)
    x, y, z = dot(r, d), dot(s, d), dot(t, d)
    seen = (z >= tl.load(view + V_NEAR)) & (opacity >= tl.load(view + V_ALPHA_MIN))
    inverse = inverse_divisor(z, view)
    quats = floats_at(tl.load(row + A_QUATS)) + first * 4 + lane * 4
    columns = rotation_columns(four_where(quats, seen))
    scales = three_where(floats_at(tl.load(row + A_SCALES)) + first * 3 + lane * 3, seen)
    right, down = image_axes(x, y, inverse, columns, scales, view)

    xy, blurred_x, blurred_y, minors, along = _covariance(right, down, tl.load(view + V_BLUR))
    inverse_x, inverse_y = 1.0 / blurred_x, 1.0 / blurred_y
    log_opacity = tl.log2(opacity)
    if ANTIALIASED:
        log_opacity = tl.fma(0.5, tl.log2(minors / along), log_opacity)
    log_cut = tl.load(view + V_LOG_CUT)
    budget = tl.maximum(log_opacity - log_cut, 0.0) / K
    radius_x, radius_y = tl.sqrt(budget * blurred_x), tl.sqrt(budget * blurred_y)
    drawn = seen & (log_opacity >= log_cut) & (blurred_x + blurred_y <= HUGE)
    drawn = drawn & (tl.maximum(radius_x, radius_y) > tl.load(view + V_RADIUS_CLIP))
    if cuts is not None:
        partly, cut = cut_of(d, right, down, columns, scales, inverse, view)
        drawn = drawn & partly
    mean_x, mean_y = to_image(x, y, inverse, view)
    first_x, last_x = _pixels(mean_x, radius_x, tl.load(view + V_SIZE))
    first_y, last_y = _pixels(mean_y, radius_y, tl.load(view + V_SIZE + 1))
    drawn = drawn & (first_x <= last_x) & (first_y <= last_y)

    c0, c1 = _tile(first_x, drawn), _tile(last_x, drawn)
    r0, r1 = _tile(first_y, drawn), _tile(last_y, drawn)
    tl.store(keys + out + lane, tl.where(drawn, z.to(tl.int32, bitcast=True), HIDDEN), inside)
    tl.store(counts + out + lane, tl.where(drawn, (c1 - c0 + 1) * (r1 - r0 + 1), 0), inside)
    _store_rows(rects + out * 2, tl.join(c0 + (r0 << 16), c1 + (r1 << 16)), drawn, BLOCK, 2)

    zero = tl.zeros_like(z)
    color, transmittance = (zero, zero, zero), zero + 1.0
    if COLOR:
        towards = d
        if tl.load(view + V_PARALLEL) > 0.0:
            towards = (t[0] + zero, t[1] + zero, t[2] + zero)
        distance = tl.sqrt(dot(towards, towards))
        functions = tl.load(row + T_FUNCTIONS).to(tl.int32)
        sh = floats_at(tl.load(row + A_SH)) + first * 3 * functions + lane * 3 * functions
        color = color_of(sh, functions, towards, distance, drawn, FUNCTIONS)
        map_count = tl.load(view + V_MAPS).to(tl.int32)
        if map_count > 0:
            maps = floats_at(tl.load(row + A_MAPS))
            map_rows = tl.load(row + A_ROWS).to(tl.pointer_type(tl.int16)) + first + lane
            color = mapped(color, maps, map_rows, map_count, drawn)
        if FOG != NO_FOG:
            transmittance = through_fog(towards, distance, view, FOG)
            color = in_fog(color, transmittance, view)

    number = (out.to(tl.int32) + lane).to(tl.float32, bitcast=True)
    overlay = zero + tl.load(view + V_OVERLAY)
    # In layout's order of fields, those of even number and those of odd number.
    even = eight(
        mean_x, xy * inverse_y, inverse_y * K, radius_y, xy * inverse_x, z, color[0], color[2]
    )
    odd = eight(
        mean_y, tl.sqrt(1.0 / along * K), log_opacity, inverse_x * K,
        tl.sqrt(along * blurred_y * inverse_x / K), number, color[1], overlay,
    )  # fmt: skip
    record = tl.reshape(tl.join(even, odd), (BLOCK, RECORD))
    _store_rows(records + out * RECORD, record, drawn, BLOCK, RECORD)
    if cuts is not None:
        _store_rows(cuts + out * CUT, cut, drawn, BLOCK, CUT)
    if lights is not None:
        lit = tl.where(drawn, tl.load(view + V_LIT), 0.0) > 0.0
        slopes = three_where(floats_at(tl.load(row + A_SLOPES)) + first * 3 + lane * 3, lit)
        lines = lights + out * LINES + lane * LINES
        store_lights(lines, columns[2], (x, y, z), slopes, transmittance, lit, drawn, view)


@triton.jit
def _covariance(right, down, blur):
    """xy, and blurred xx and yy, px^2; variances along a row, det / yy, before the blur and after.

    By Lagrange's identity, det = |right cross down|^2, no digits cancel; each term is divided
    before it is squared, so that nothing overflows.
    """
    xx, xy, yy = dot(right, right), dot(right, down), dot(down, down)
    inverse = 1.0 / (yy + blur)
    across = cross(right, down, tl.sqrt(inverse))
    minors = dot(across, across)
    return xy, xx + blur, yy + blur, minors, blur + tl.fma(blur * xx, inverse, minors)


@triton.jit
def _pixels(mean, radius, size):
    """First and last pixel whose centre lies within the radius; the last below where none does."""
    first = tl.maximum(mean - radius - 0.5, 0.0)
    last = tl.minimum(mean + radius - 0.5, size - 1.0)
    return tl.ceil(first), tl.floor(last)


@triton.jit
def _tile(pixel, drawn):
    return tl.where(drawn, pixel, 0.0).to(tl.int32) // TILE


@triton.jit
def _store_rows(pointer, rows, mask, ROWS: tl.constexpr, FIELDS: tl.constexpr):
    at = tl.arange(0, ROWS)[:, None] * FIELDS + tl.arange(0, FIELDS)[None, :]
    tl.store(pointer + at, rows, mask[:, None])
