"""Numba kernels: Gaussians of all parts to splats of one image.

Two steps, so that what nearer splats hide is never projected: `rank_splats` finds z and a generous
box, `project_slice` does the rest for the splats of one range of z, if a tile they touch is still
open. Both take Gaussians eight at a time.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.render import layout as L
from augment.render.cpu import simd as v8
from augment.render.cpu.geometry import (
    L_FACING,
    L_LEAN_X,
    L_LEAN_Y,
    L_RED,
    L_WRAP,
    L_X,
    L_Y,
    SHADING_LINES,
    cut_eight,
    dot,
    from_eye,
    gather3,
    height_of,
    image_covariance,
    inverse_divisor,
    light_eight,
    rotation_from_quats,
    rotation_row,
    to_camera,
    to_image,
)
from augment.render.cpu.jit import inner, kernel
from augment.render.cpu.simd import LOG2_E, exp2_fine, floats_at, log2, scalar_fmuladd, shorts_at
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import BIN_SHIFT, BLOCK, CUT, LANES, MAP, RECORD, TILE_H, TILE_W, U
from augment.render.sh import (
    C1,
    C2_XX,
    C2_XY,
    C2_ZZ,
    C3_CUBIC,
    C3_XYZ,
    C3_ZXX,
    C3_ZZ,
    C3_ZZZ,
    SH_C0,
)

# ---- Numba kernels: what colour a splat shows to the camera. SH of degrees 0 to 3, then fog -----
# Eight splats at a time for what depends on the direction alone (`prepare_colors`), one at a time
# for the sum over its coefficients (`write_color`), which are read where they lie in the scene.

MAX_FUNCTIONS = 16
TRANSMITTANCE = MAX_FUNCTIONS  # row of the fog's transmittance, after those of the SH functions
COLOR_ROWS = MAX_FUNCTIONS + 1

_C0, _C1, _C2_XY, _C2_ZZ, _C2_XX = map(np.float32, (SH_C0, C1, C2_XY, C2_ZZ, C2_XX))
_C3_CUBIC, _C3_XYZ, _C3_ZZ, _C3_ZZZ, _C3_ZXX = map(
    np.float32, (C3_CUBIC, C3_XYZ, C3_ZZ, C3_ZZZ, C3_ZXX)
)


@inner()
def prepare_colors(dx, dy, dz, view, functions, fog, rows):
    """SH functions and transmittance of eight splats, d from the eye in the part's axes.

    rows: flat, COLOR_ROWS of eight, filled.
    """
    distance = v8.sqrt(v8.fmuladd(dx, dx, v8.fmuladd(dy, dy, dz * dz)))
    inverse = v8.splat(np.float32(1)) / distance
    write_basis(dx * inverse, dy * inverse, dz * inverse, functions, rows)
    if fog != L.NO_FOG:
        tau = v8.splat(view[L.V_SIGMA]) * distance
        if fog == L.LAYERED_FOG:
            tau = tau * _layered_density(dx, dy, dz, view)
        lowest = v8.splat(np.float32(-126))  # 1e-38: nothing is seen through it
        transmittance = exp2_fine(v8.maximum(tau * v8.splat(-LOG2_E), lowest))
        v8.store(rows, U(TRANSMITTANCE * LANES), transmittance)


@inner()
def _layered_density(dx, dy, dz, view):
    """Mean density along the way, relative to the base: exp(-min(a, b)) (1 - exp(-x)) / x.

    a, b: heights of eye and splat in scale heights, x = |b - a|; see weather.fog.
    """
    one, zero = v8.splat(np.float32(1)), v8.splat(np.float32(0))
    up = v8.splat(view[L.V_UP + 2]) * dz
    up = v8.fmuladd(v8.splat(view[L.V_UP + 1]), dy, up)
    up = v8.fmuladd(v8.splat(view[L.V_UP]), dx, up)
    x = v8.maximum(up, v8.negate(up))
    lowest = v8.splat(view[L.V_EYE_HEIGHT]) + v8.minimum(up, zero)
    fade = exp2_fine(v8.maximum(x * v8.splat(-LOG2_E), v8.splat(np.float32(-126))))
    series = v8.fmuladd(x, v8.splat(np.float32(1 / 120)), v8.splat(np.float32(-1 / 24)))
    series = v8.fmuladd(x, series, v8.splat(np.float32(1 / 6)))
    series = v8.fmuladd(x, series, v8.splat(np.float32(-1 / 2)))
    series = v8.fmuladd(x, series, one)
    # Below 0.1 the difference 1 - exp(-x) has lost a digit, and the series' next term is 1e-8.
    short = v8.greater(v8.splat(np.float32(0.1)), x)
    mean = v8.select(short, series, (one - fade) / v8.select(short, one, x))
    power = v8.minimum(v8.negate(lowest), v8.splat(np.float32(MAX_EXPONENT))) * v8.splat(LOG2_E)
    return exp2_fine(v8.maximum(power, v8.splat(np.float32(-126)))) * mean


@inner()
def write_basis(x, y, z, functions, rows):
    """The first `functions` spherical harmonics of unit directions, as render.sh lists them."""
    v8.store(rows, U(0 * LANES), v8.splat(_C0))
    if functions > 1:
        v8.store(rows, U(1 * LANES), v8.splat(-_C1) * y)
        v8.store(rows, U(2 * LANES), v8.splat(_C1) * z)
        v8.store(rows, U(3 * LANES), v8.splat(-_C1) * x)
    if functions > 4:
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        two = v8.splat(np.float32(2))
        v8.store(rows, U(4 * LANES), v8.splat(_C2_XY) * xy)
        v8.store(rows, U(5 * LANES), v8.splat(-_C2_XY) * y * z)
        v8.store(rows, U(6 * LANES), v8.splat(_C2_ZZ) * (two * zz - xx - yy))
        v8.store(rows, U(7 * LANES), v8.splat(-_C2_XY) * x * z)
        v8.store(rows, U(8 * LANES), v8.splat(_C2_XX) * (xx - yy))
        if functions > 9:
            three, four = v8.splat(np.float32(3)), v8.splat(np.float32(4))
            v8.store(rows, U(9 * LANES), v8.splat(-_C3_CUBIC) * y * (three * xx - yy))
            v8.store(rows, U(10 * LANES), v8.splat(_C3_XYZ) * xy * z)
            v8.store(rows, U(11 * LANES), v8.splat(-_C3_ZZ) * y * (four * zz - xx - yy))
            v8.store(rows, U(12 * LANES), v8.splat(_C3_ZZZ) * z * (two * zz - three * (xx + yy)))
            v8.store(rows, U(13 * LANES), v8.splat(-_C3_ZZ) * x * (four * zz - xx - yy))
            v8.store(rows, U(14 * LANES), v8.splat(_C3_ZXX) * z * (xx - yy))
            v8.store(rows, U(15 * LANES), v8.splat(-_C3_CUBIC) * x * (xx - three * yy))


@inner()
def write_color(sh, at, functions, maps, at_map, view, fog, rows, lane, records, slot):
    """max(0.5 + sum sh Y, 0), mapped and in the fog, to the record that starts at `slot`.

    sh, maps: flat; the splat's coefficients start at `at`, its colour map at `at_map`, which is
    negative where it has none.
    """
    r = g = b = np.float32(0.5)
    for k in range(U(functions)):
        value = rows[k * U(LANES) + lane]
        r = scalar_fmuladd(value, sh[at], r)
        g = scalar_fmuladd(value, sh[at + U(1)], g)
        b = scalar_fmuladd(value, sh[at + U(2)], b)
        at += U(3)
    zero = np.float32(0)
    r, g, b = max(r, zero), max(g, zero), max(b, zero)
    if at_map >= 0:
        mapped_r = _map_channel(maps, U(at_map), r, g, b)
        mapped_g = _map_channel(maps, U(at_map) + U(4), r, g, b)
        b = _map_channel(maps, U(at_map) + U(8), r, g, b)
        r, g = mapped_r, mapped_g
    if fog != L.NO_FOG:
        t = rows[U(TRANSMITTANCE * LANES) + lane]
        hidden = np.float32(1) - t
        r = scalar_fmuladd(t, r, hidden * view[L.V_AIRLIGHT])
        g = scalar_fmuladd(t, g, hidden * view[L.V_AIRLIGHT + 1])
        b = scalar_fmuladd(t, b, hidden * view[L.V_AIRLIGHT + 2])
    records[slot + U(L.RED)] = r
    records[slot + U(L.GREEN)] = g
    records[slot + U(L.BLUE)] = b


@inner()
def _map_channel(maps, at, r, g, b):
    """One row of a colour map, at four numbers from `at`, applied to a colour; not below 0."""
    value = scalar_fmuladd(maps[at], r, maps[at + U(3)])
    value = scalar_fmuladd(maps[at + U(1)], g, value)
    return max(scalar_fmuladd(maps[at + U(2)], b, value), np.float32(0))


@inner()
def add_direction_slopes(x, y, z, functions, rows):
    """Sum over SH functions k >= 1 of a row's weight times the slope of the function, by x, y, z.

    rows: flat; the weights of function k for eight splats start at k LANES. Slopes are those of
    the polynomials in `write_basis`; only their part across the direction has a meaning.
    """
    two, three = v8.splat(np.float32(2)), v8.splat(np.float32(3))
    c1 = v8.splat(_C1)
    gx = v8.negate(c1 * v8.load(rows, U(3 * LANES)))
    gy = v8.negate(c1 * v8.load(rows, U(1 * LANES)))
    gz = c1 * v8.load(rows, U(2 * LANES))
    if functions > U(4):
        xy, zz = v8.splat(_C2_XY), v8.splat(_C2_ZZ)
        a4, a5 = xy * v8.load(rows, U(4 * LANES)), xy * v8.load(rows, U(5 * LANES))
        a6, a7 = two * zz * v8.load(rows, U(6 * LANES)), xy * v8.load(rows, U(7 * LANES))
        a8 = two * v8.splat(_C2_XX) * v8.load(rows, U(8 * LANES))
        gx = gx + a4 * y - a6 * x - a7 * z + a8 * x
        gy = gy + a4 * x - a5 * z - a6 * y - a8 * y
        gz = gz - a5 * y + two * a6 * z - a7 * x
    if functions > U(9):
        four = v8.splat(np.float32(4))
        xx, yy, zz = x * x, y * y, z * z
        cubic, high = v8.splat(_C3_CUBIC), v8.splat(_C3_ZZ)
        a9, a15 = cubic * v8.load(rows, U(9 * LANES)), cubic * v8.load(rows, U(15 * LANES))
        a10 = v8.splat(_C3_XYZ) * v8.load(rows, U(10 * LANES))
        a11, a13 = high * v8.load(rows, U(11 * LANES)), high * v8.load(rows, U(13 * LANES))
        a12 = three * v8.splat(_C3_ZZZ) * v8.load(rows, U(12 * LANES))
        a14 = v8.splat(_C3_ZXX) * v8.load(rows, U(14 * LANES))
        three_diff = three * (xx - yy)
        two_xy = two * x * y
        gx = gx - three * a9 * two_xy + a10 * y * z + a11 * two_xy - two * a12 * x * z
        gx = gx - a13 * (four * zz - three * xx - yy) + two * a14 * x * z - a15 * three_diff
        gy = gy - a9 * three_diff + a10 * x * z - a11 * (four * zz - xx - three * yy)
        gy = gy - two * a12 * y * z + a13 * two_xy - two * a14 * y * z + three * a15 * two_xy
        gz = gz + a10 * x * y - two * four * a11 * y * z + a12 * (two * zz - xx - yy)
        gz = gz - two * four * a13 * x * z + a14 * (xx - yy)
    return gx, gy, gz


# Rows of eight that the projection leaves for writing: a record, the pixels a splat covers, colour.
_X_LO, _X_HI, _Y_LO, _Y_HI = (COLOR_ROWS + i for i in range(4))
_FIELDS = COLOR_ROWS + 4
_CUTS = _FIELDS + L.DEPTH + 1
_LIGHTS = _CUTS + CUT
_ROWS = _LIGHTS + SHADING_LINES
_TIE_RUN = 4096  # places that a thread looks for ties in at a time
_HUGE = np.float32(1e37)  # px^2; beyond it float32 overflows, and no pixel could tell


class Parts(NamedTuple):
    """What is projected. addresses: uint64 [P, ADDRESSES], see layout. sizes: int64 [P, 2],
    Gaussians and SH functions. first_ids: int64 [P]. orders: uint64 [P], addresses of int32, the
    Gaussian at every place of means, quats, scales and opacities; 0 where they stand in the part's
    own order, as all else does. views: float32 [P, VIEW]. blocks: int64 [B, 3], part, first and
    last + 1 place. modes: int64 [MODES].
    """

    addresses: Any
    sizes: Any
    first_ids: Any
    orders: Any
    views: Any
    blocks: Any
    modes: Any


class Splats(NamedTuple):
    """Block b owns slots [b BLOCK, (b + 1) BLOCK) and fills found[b] of them in the order of its
    places: records, RECORD float32 each; rects, uint64, the tiles touched as blend unpacks
    them; keys, uint32, the bits of z. counts: int32 [B, Z], of those in each bin of the slice.
    cuts: CUT float32 each, where modes ask for a clip; lights: LINES each, where for light.
    """

    records: Any
    rects: Any
    keys: Any
    found: Any
    counts: Any
    cuts: Any
    lights: Any


@kernel
def rank_splats(inputs, depths, histograms):
    """z of every Gaussian that may be seen, 0 for the others, and where along z the image is paid.

    depths: float32 [B BLOCK]. histograms: float64 [C, BINS], each of C runs of blocks its own:
    opacity times area, px^2.
    """
    runs = histograms.shape[0]
    for run in prange(runs):
        addresses, total = inputs.addresses, inputs.blocks.shape[0]
        histogram = histograms[run]
        picked, areas = np.empty(LANES, np.int32), np.empty(LANES, np.float32)
        for z_bin in range(histogram.shape[1]):
            histogram[0, z_bin] = histogram[1, z_bin] = 0
        for block in range(total * run // runs, total * (run + 1) // runs):
            part, first, last = inputs.blocks[block]
            count, view = inputs.sizes[part, 0], inputs.views[part]
            means = floats_at(addresses[part, L.A_MEANS], count * 3)
            scales = floats_at(addresses[part, L.A_SCALES], count * 3)
            opacities = floats_at(addresses[part, L.A_OPACITIES], count)
            at = block * BLOCK
            for group in range(first, last, LANES):
                for lane in range(LANES):
                    picked[lane] = min(group + lane, last - 1)
                _rank_eight(means, scales, opacities, view, picked, depths, U(at), areas)
                for lane in range(min(LANES, last - group)):
                    z = depths[at + lane]
                    if z > 0:
                        z_bin = np.float32(z).view(np.int32) >> BIN_SHIFT
                        histogram[0, z_bin] += areas[lane]
                        histogram[1, z_bin] += 1
                at += LANES


@inner()
def _rank_eight(means, scales, opacities, view, picked, depths, at, areas):
    zero, two = v8.splat(np.float32(0)), v8.splat(np.float32(2))
    d = from_eye(means, picked, U(0), view)
    x, y, z = to_camera(d, view)
    inverse = inverse_divisor(z, view)
    x, y = to_image(x, y, inverse, view)
    s0, s1, s2 = gather3(scales, picked, U(0))
    opacity = v8.gather(opacities, picked, U(0), U(1), U(0))
    # No direction of an ellipsoid is longer than its longest axis, and no blur wider than 2 px.
    longest = v8.maximum(s0, v8.maximum(s1, s2))
    reach = longest * inverse
    far_x = v8.fmuladd(v8.splat(view[L.V_GAIN]), reach, two)
    far_y = v8.fmuladd(v8.splat(view[L.V_GAIN + 1]), reach, two)
    seen = v8.both(
        v8.at_least(z, v8.splat(view[L.V_NEAR])),
        v8.at_least(opacity, v8.splat(view[L.V_ALPHA_MIN])),
    )
    seen = v8.both(seen, v8.at_least(x + far_x, zero))
    seen = v8.both(seen, v8.at_least(v8.splat(view[L.V_SIZE]) - x + far_x, zero))
    seen = v8.both(seen, v8.at_least(y + far_y, zero))
    seen = v8.both(seen, v8.at_least(v8.splat(view[L.V_SIZE + 1]) - y + far_y, zero))
    far = v8.splat(view[L.V_FOG_FAR] * view[L.V_FOG_FAR])
    seen = v8.both(seen, v8.at_least(far, dot(d[0], d[1], d[2], d[0], d[1], d[2])))
    height, size = height_of(d, view), v8.splat(view[L.V_EXTENT]) * longest
    seen = v8.both(seen, v8.at_least(height + size, zero))
    seen = v8.both(seen, v8.at_least(v8.splat(view[L.V_CLIP_REACH]), height - size))
    if view[L.V_RADIUS_CLIP] > np.float32(0):
        seen = v8.both(seen, _may_exceed_clip(opacity, reach, view))
    v8.store(depths, at, v8.select(seen, z, zero))
    # Mean over all directions of the ellipse's area, 2 pi sigma^2; it only cuts z into slices.
    squares = s0 * s1 + s1 * s2 + s0 * s2
    focal = v8.splat(view[L.V_FOCAL] * view[L.V_FOCAL + 1] * np.float32(2 * math.pi / 3))
    area = v8.fmuladd(focal * squares, inverse * inverse, two) * opacity
    v8.store(areas, U(0), v8.minimum(area, v8.splat(view[L.V_SIZE] * view[L.V_SIZE + 1])))


@inner()
def _may_exceed_clip(opacity, reach, view):
    """False only of splats that are surely no larger than the view's radius clip.

    reach: longest semi-axis over the divisor. The bound is that of the projection with the longest
    axis for all and the opacity before antialiasing, which only lowers it; the margins are a
    thousand times what rounding may take off.
    """
    k = v8.splat(np.float32(0.5) * LOG2_E)
    budget = v8.maximum(log2(opacity) - v8.splat(view[L.V_LOG_CUT]), v8.splat(np.float32(0))) / k
    gain = max(view[L.V_GAIN], view[L.V_GAIN + 1]) / view[L.V_EXTENT]
    axis = v8.splat(gain) * reach
    square = (budget + v8.splat(np.float32(1e-3))) * v8.fmuladd(
        axis, axis, v8.splat(view[L.V_BLUR])
    )
    clip = view[L.V_RADIUS_CLIP]
    return v8.greater(square, v8.splat(clip * clip * np.float32(1 - 1e-3)))


@kernel
def project_slice(inputs, depth_bits, bins, open_sums, splats):
    """Splats of the Gaussians in bins[0] <= bin of z < bins[1] that touch an open tile.

    depth_bits: uint32, what rank_splats wrote. open_sums: int32 [rows + 1, columns + 1], number of
    open tiles above and left. splats: written.
    """
    for block in prange(inputs.blocks.shape[0]):
        # Of its own: numba drops what a parallel loop itself writes to arrays of a record.
        _project_block(np.int64(block), inputs, depth_bits, bins, open_sums, splats)


@inner()
def _project_block(block, inputs, depth_bits, bins, open_sums, splats):
    part, first, last = inputs.blocks[block]
    addresses, modes, view = inputs.addresses, inputs.modes, inputs.views[part]
    records, rects, keys, counts = splats.records, splats.rects, splats.keys, splats.counts
    picked = np.empty(BLOCK + LANES, np.int32)
    rows = np.empty(_ROWS * LANES, np.float32)
    base = block * BLOCK
    taken = _pick_bins(depth_bits, base, first, last, bins, picked)
    count, functions = inputs.sizes[part]
    means = floats_at(addresses[part, L.A_MEANS], count * 3)
    quats = floats_at(addresses[part, L.A_QUATS], count * 4)
    scales = floats_at(addresses[part, L.A_SCALES], count * 3)
    opacities = floats_at(addresses[part, L.A_OPACITIES], count)
    sh = floats_at(addresses[part, L.A_SH], count * functions * 3)
    slopes = floats_at(addresses[part, L.A_SLOPES], count * 3 if view[L.V_LIT] > 0 else 1)
    map_count = np.int64(view[L.V_MAPS])
    maps = floats_at(addresses[part, L.A_MAPS], max(map_count, 1) * MAP)
    map_rows = shorts_at(addresses[part, L.A_ROWS], count if map_count > 1 else 1)
    is_ordered = inputs.orders[part] != U(0)
    order = floats_at(inputs.orders[part], count if is_ordered else 1)
    used = min(modes[L.M_FUNCTIONS], functions)
    slot = U(base)
    for at in range(U(0), U(taken), U(LANES)):
        _project_eight(means, quats, scales, opacities, view, picked, at, used, modes, rows)
        for lane in range(min(U(LANES), U(taken) - at)):
            if not _touches_open(rows, lane, open_sums, rects, slot):
                continue
            splat = picked[at + lane]
            if is_ordered:
                splat = np.float32(order[splat]).view(np.int32)
            record = slot * U(RECORD)
            _write_record(rows, lane, inputs.first_ids[part] + splat, records, record)
            records[record + U(L.IS_OVERLAY)] = view[L.V_OVERLAY]
            if modes[L.M_COLOR]:
                from_sh = U(splat) * U(functions * 3)
                at_map = _map_of(map_rows, splat, map_count)
                write_color(
                    sh, from_sh, used, maps, at_map, view, modes[L.M_FOG], rows, lane,
                    records, record,
                )  # fmt: skip
            if modes[L.M_CLIP]:
                for field in range(U(L.C_REACH + 1)):
                    cut = rows[(U(_CUTS) + field) * U(LANES) + lane]
                    splats.cuts[slot * U(CUT) + field] = cut
            if modes[L.M_LIGHT]:
                _write_lights(slopes, splat, modes[L.M_FOG], view, rows, lane, splats.lights, slot)
            keys[slot] = np.float32(records[record + U(L.DEPTH)]).view(np.uint32)
            slot += U(1)
    splats.found[block] = slot - U(base)
    for z_bin in range(counts.shape[1]):
        counts[block, z_bin] = 0
    for i in range(U(base), slot):
        counts[block, np.int64(keys[i] >> np.uint32(BIN_SHIFT)) - bins[0]] += 1


@kernel
def order_ties(keys, slots, rects, records):
    """Put splats of equal keys in the order of their ids. keys: sorted, slots and rects alike."""
    runs = (keys.size + _TIE_RUN - 1) // _TIE_RUN
    for run in prange(runs):
        end = min((np.int64(run) + 1) * _TIE_RUN, keys.size)
        first = np.int64(run) * _TIE_RUN
        while 0 < first < end and keys[first] == keys[first - 1]:  # the run before has these
            first += 1
        while first < end:
            last = first + 1
            while last < keys.size and keys[last] == keys[first]:
                last += 1
            if last - first > 1:
                _sort_by_id(slots, rects, records, first, last)
            first = last


@inner()
def _sort_by_id(slots, rects, records, first, last):
    """Shell's sort: equal depths come in a few rising runs, of any length."""
    gap = 1
    while 3 * gap < last - first:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(first + gap, last):
            slot, rect = slots[i], rects[i]
            number = _id_of(records, slot)
            j = i
            while j - gap >= first and _id_of(records, slots[j - gap]) > number:
                slots[j], rects[j] = slots[j - gap], rects[j - gap]
                j -= gap
            slots[j], rects[j] = slot, rect
        gap //= 3


@inner()
def _id_of(records, slot):
    return np.float32(records[U(slot) * U(RECORD) + U(L.SPLAT_ID)]).view(np.int32)


@inner()
def _pick_bins(depth_bits, base, first, last, bins, picked):
    """Numbers of a block's Gaussians in a range of bins, filled up to whole groups of eight."""
    low = np.uint32(bins[0] << BIN_SHIFT)
    span = np.uint32((bins[1] - bins[0]) << BIN_SHIFT)
    taken = U(0)
    for i in range(U(last - first)):
        picked[taken] = np.int32(first + np.int64(i))
        taken += U(np.uint32(depth_bits[U(base) + i] - low) < span)
    for lane in range(U(LANES)):
        picked[taken + lane] = picked[max(taken, U(1)) - U(1)]
    return taken


@inner()
def _map_of(map_rows, splat, map_count):
    """Where a splat's colour map starts, -1 without one; rows that are none mean the first."""
    if map_count == 0:
        return np.int64(-1)
    row = np.int64(0)
    if map_count > 1:
        row = np.int64(map_rows[splat])
        if row < 0 or row >= map_count:
            row = np.int64(0)
    return row * np.int64(MAP)


@inner()
def _touches_open(rows, lane, open_sums, rects, slot):
    """Whether a splat covers a pixel centre and one of its tiles is open; writes its tiles."""
    x_lo, x_hi = rows[U(_X_LO * LANES) + lane], rows[U(_X_HI * LANES) + lane]
    y_lo, y_hi = rows[U(_Y_LO * LANES) + lane], rows[U(_Y_HI * LANES) + lane]
    if not (x_lo <= x_hi and y_lo <= y_hi):
        return False
    c0, c1 = U(x_lo) // U(TILE_W), U(x_hi) // U(TILE_W)
    r0, r1 = U(y_lo) // U(TILE_H), U(y_hi) // U(TILE_H)
    rects[slot] = c0 | r0 << U(16) | c1 << U(32) | r1 << U(48)
    c1, r1 = c1 + U(1), r1 + U(1)
    return open_sums[r1, c1] - open_sums[r0, c1] - open_sums[r1, c0] + open_sums[r0, c0] > 0


@inner()
def _write_record(rows, lane, number, records, record):
    for field in range(U(L.DEPTH + 1)):
        records[record + field] = rows[(U(_FIELDS) + field) * U(LANES) + lane]
    records[record + U(L.SPLAT_ID)] = np.int32(number).view(np.float32)


@inner()
def _write_lights(slopes, splat, fog, view, rows, lane, lights, slot):
    first = slot * U(SHADING_LINES)
    if not view[L.V_LIT] > np.float32(0):
        for line in range(U(SHADING_LINES)):
            lights[first + line] = np.float32(0)
        return
    for line in range(U(L_RED)):
        lights[first + line] = rows[(U(_LIGHTS) + line) * U(LANES) + lane]
    transmittance = np.float32(1)
    if fog != L.NO_FOG:
        transmittance = rows[U(TRANSMITTANCE * LANES) + lane]
    for channel in range(U(3)):
        slope = slopes[U(splat) * U(3) + channel]
        lights[first + U(L_RED) + channel] = transmittance * slope


@inner()
def _project_eight(means, quats, scales, opacities, view, picked, at, functions, modes, rows):
    """Records, pixel boxes and colour rows of eight Gaussians, side by side in `rows`."""
    d = from_eye(means, picked, at, view)
    if modes[L.M_COLOR]:
        towards = rotation_row(view, U(2)) if view[L.V_PARALLEL] > 0 else d
        prepare_colors(towards[0], towards[1], towards[2], view, functions, modes[L.M_FOG], rows)
    x, y, z = to_camera(d, view)
    inverse = inverse_divisor(z, view)
    xx, xy, yy, minors = image_covariance(quats, scales, picked, at, x, y, inverse, view)

    one, half = v8.splat(np.float32(1)), v8.splat(np.float32(0.5))
    blur, k = v8.splat(view[L.V_BLUR]), v8.splat(np.float32(0.5) * LOG2_E)
    blurred_x, blurred_y = xx + blur, yy + blur
    inverse_y, inverse_x = one / blurred_y, one / blurred_x
    # Variance along a row, det / yy. minors = det / yy before the blur, so nothing overflows.
    along = blur + v8.fmuladd(blur * xx, inverse_y, minors)
    log_opacity = log2(v8.gather(opacities, picked, at, U(1), U(0)))
    if modes[L.M_ANTIALIASED]:
        log_opacity = v8.fmuladd(half, log2(minors / along), log_opacity)
    log_cut = v8.splat(view[L.V_LOG_CUT])
    budget = v8.maximum(log_opacity - log_cut, v8.splat(np.float32(0))) / k
    radius_x, radius_y = v8.sqrt(budget * blurred_x), v8.sqrt(budget * blurred_y)

    mean_x, mean_y = to_image(x, y, inverse, view)
    drawn = v8.both(
        v8.at_least(log_opacity, log_cut), v8.at_least(v8.splat(_HUGE), blurred_x + blurred_y)
    )
    larger = v8.maximum(radius_x, radius_y)
    drawn = v8.both(drawn, v8.greater(larger, v8.splat(view[L.V_RADIUS_CLIP])))
    if modes[L.M_CLIP]:
        partly, offset, lx, ly, gx, gy, deep = cut_eight(
            quats, scales, picked, at, d, x, y, inverse, view
        )
        drawn = v8.both(drawn, partly)
        v8.store(rows, U((_CUTS + L.C_AT) * LANES), offset)
        v8.store(rows, U((_CUTS + L.C_X) * LANES), lx)
        v8.store(rows, U((_CUTS + L.C_Y) * LANES), ly)
        v8.store(rows, U((_CUTS + L.C_RIGHT) * LANES), gx)
        v8.store(rows, U((_CUTS + L.C_DOWN) * LANES), gy)
        v8.store(rows, U((_CUTS + L.C_REACH) * LANES), deep)
    if modes[L.M_LIGHT] and view[L.V_LIT] > np.float32(0):
        zero = v8.splat(np.float32(0))
        ray = (zero, zero, one) if view[L.V_PARALLEL] > 0 else (x, y, z)
        lines = light_eight(rotation_from_quats(quats, picked, at), ray, view)
        v8.store(rows, U((_LIGHTS + L_FACING) * LANES), lines[0])
        v8.store(rows, U((_LIGHTS + L_X) * LANES), lines[1])
        v8.store(rows, U((_LIGHTS + L_Y) * LANES), lines[2])
        v8.store(rows, U((_LIGHTS + L_WRAP) * LANES), lines[3])
        v8.store(rows, U((_LIGHTS + L_LEAN_X) * LANES), lines[4])
        v8.store(rows, U((_LIGHTS + L_LEAN_Y) * LANES), lines[5])
    _write_box(mean_x, radius_x, v8.splat(view[L.V_SIZE]), drawn, U(_X_LO), U(_X_HI), rows)
    _write_box(mean_y, radius_y, v8.splat(view[L.V_SIZE + 1]), drawn, U(_Y_LO), U(_Y_HI), rows)
    _write(rows, U(L.MEAN_X), mean_x)
    _write(rows, U(L.MEAN_Y), mean_y)
    _write(rows, U(L.LEAN_X), xy * inverse_y)
    _write(rows, U(L.SHARP_X), v8.sqrt(k / along))
    _write(rows, U(L.FALL_Y), k * inverse_y)
    _write(rows, U(L.LOG_OPACITY), log_opacity)
    _write(rows, U(L.RADIUS_Y), radius_y)
    _write(rows, U(L.FALL_X), k * inverse_x)
    _write(rows, U(L.LEAN_Y), xy * inverse_x)
    _write(rows, U(L.BLUNT_Y), v8.sqrt(along * blurred_y * inverse_x / k))
    _write(rows, U(L.DEPTH), z)


@inner()
def _write(rows, field, value):
    v8.store(rows, (U(_FIELDS) + field) * U(LANES), value)


@inner()
def _write_box(mean, radius, size, drawn, low, high, rows):
    """First and last pixel whose centre lies within the radius; the last below where none does."""
    zero, half = v8.splat(np.float32(0)), v8.splat(np.float32(0.5))
    one = v8.splat(np.float32(1))
    first = v8.maximum(mean - radius - half, zero)
    last = v8.minimum(mean + radius - half, size - one)
    v8.store(rows, low * U(LANES), v8.negate(v8.floor(v8.negate(first))))
    v8.store(rows, high * U(LANES), v8.select(drawn, v8.floor(last), v8.negate(one)))
