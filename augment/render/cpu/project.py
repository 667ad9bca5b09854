"""Numba kernels that project the Gaussians of all parts to splats of one image.

The projection has two steps, so that splats hidden by nearer ones are never projected.
`rank_splats` finds z and a generous box. `project_slice` does the rest for the splats of one range
of z, if a tile that they touch is still open. Both take Gaussians eight at a time.
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
    gather3,
    height_of,
    image_covariance,
    inverse_divisor,
    light_eight,
    offsets_from_eye,
    rotation_from_quats,
    rotation_row,
    to_camera,
    to_image,
)
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.cpu.simd import LOG2_E, exp2_fine, floats_at, log2, scalar_fmuladd, shorts_at
from augment.render.fog import MAX_EXPONENT
from augment.render.fog_bank_kernels import write_log_means
from augment.render.layout import (
    BIN_SHIFT,
    BLOCK_SIZE,
    CUT,
    MAP,
    NUM_LANES,
    RECORD,
    TILE_H,
    TILE_W,
    Index,
)
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

# ---- Numba kernels: colour of a splat towards the camera, from SH of degrees 0 to 3, then fog ----
# `prepare_colors` computes the terms that depend on the direction alone, eight splats at a time.
# `write_color` sums over the coefficients of one splat, which are read in place in the scene.

# Largest number of SH functions.
MAX_FUNCTIONS = 16
# Row of the fog's transmittance, after those of the SH functions.
TRANSMITTANCE = MAX_FUNCTIONS
# Number of rows for colours.
COLOR_ROWS = MAX_FUNCTIONS + 1

_C0, _C1, _C2_XY, _C2_ZZ, _C2_XX = map(np.float32, (SH_C0, C1, C2_XY, C2_ZZ, C2_XX))
_C3_CUBIC, _C3_XYZ, _C3_ZZ, _C3_ZZZ, _C3_ZXX = map(
    np.float32, (C3_CUBIC, C3_XYZ, C3_ZZ, C3_ZZZ, C3_ZXX)
)


@kernel_function()
def prepare_colors(dx, dy, dz, view, num_functions, fog, has_banks, rows):
    """Write SH functions and transmittance of eight splats.

    Args:
        dx, dy, dz: vectors from the eye, in the part's axes.
        view: numbers of the view.
        num_functions: number of SH functions.
        fog: mode of the fog.
        has_banks: if True, the row of the transmittance holds log2 of the mean density of the fog's
            banks.
        rows: COLOR_ROWS rows of eight numbers, flat; written.
    """
    distance = v8.sqrt(v8.fmuladd(dx, dx, v8.fmuladd(dy, dy, dz * dz)))
    inverse = v8.broadcast(np.float32(1)) / distance
    write_basis(dx * inverse, dy * inverse, dz * inverse, num_functions, rows)
    if fog != L.NO_FOG:
        tau = v8.broadcast(view[L.V_EXTINCTION]) * distance
        if fog == L.LAYERED_FOG:
            tau = tau * _layered_density(dx, dy, dz, view)
        if has_banks:
            tau = tau * exp2_fine(v8.load(rows, Index(TRANSMITTANCE * NUM_LANES)))
        lowest = v8.broadcast(np.float32(-126))  # 1e-38: fog that deep is opaque
        transmittance = exp2_fine(v8.maximum(tau * v8.broadcast(-LOG2_E), lowest))
        v8.store(rows, Index(TRANSMITTANCE * NUM_LANES), transmittance)


@kernel_function()
def _layered_density(dx, dy, dz, view):
    """Return the mean density along a ray, relative to the base: exp(-min(a, b)) (1 - exp(-x)) / x.

    a and b are the heights of eye and splat in scale heights, and x = |b - a|; see
    augment.render.fog.
    """
    ones = v8.broadcast(np.float32(1))
    zeros = v8.broadcast(np.float32(0))
    climb = v8.broadcast(view[L.V_UP + 2]) * dz
    climb = v8.fmuladd(v8.broadcast(view[L.V_UP + 1]), dy, climb)
    climb = v8.fmuladd(v8.broadcast(view[L.V_UP]), dx, climb)
    x = v8.maximum(climb, v8.negate(climb))
    lowest = v8.broadcast(view[L.V_EYE_HEIGHT]) + v8.minimum(climb, zeros)
    fade = exp2_fine(v8.maximum(x * v8.broadcast(-LOG2_E), v8.broadcast(np.float32(-126))))
    series = v8.fmuladd(x, v8.broadcast(np.float32(1 / 120)), v8.broadcast(np.float32(-1 / 24)))
    series = v8.fmuladd(x, series, v8.broadcast(np.float32(1 / 6)))
    series = v8.fmuladd(x, series, v8.broadcast(np.float32(-1 / 2)))
    series = v8.fmuladd(x, series, ones)
    # Below 0.1 the difference 1 - exp(-x) has lost a digit, and the series' next term is 1e-8.
    is_short = v8.greater(v8.broadcast(np.float32(0.1)), x)
    mean = v8.select(is_short, series, (ones - fade) / v8.select(is_short, ones, x))
    power = v8.minimum(v8.negate(lowest), v8.broadcast(np.float32(MAX_EXPONENT))) * v8.broadcast(
        LOG2_E
    )
    return exp2_fine(v8.maximum(power, v8.broadcast(np.float32(-126)))) * mean


@kernel_function()
def write_basis(x, y, z, num_functions, rows):
    """Write the first `num_functions` spherical harmonics of unit directions (see render.sh)."""
    v8.store(rows, Index(0 * NUM_LANES), v8.broadcast(_C0))
    if num_functions > 1:
        v8.store(rows, Index(1 * NUM_LANES), v8.broadcast(-_C1) * y)
        v8.store(rows, Index(2 * NUM_LANES), v8.broadcast(_C1) * z)
        v8.store(rows, Index(3 * NUM_LANES), v8.broadcast(-_C1) * x)
    if num_functions > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        xy = x * y
        two = v8.broadcast(np.float32(2))
        v8.store(rows, Index(4 * NUM_LANES), v8.broadcast(_C2_XY) * xy)
        v8.store(rows, Index(5 * NUM_LANES), v8.broadcast(-_C2_XY) * y * z)
        v8.store(rows, Index(6 * NUM_LANES), v8.broadcast(_C2_ZZ) * (two * zz - xx - yy))
        v8.store(rows, Index(7 * NUM_LANES), v8.broadcast(-_C2_XY) * x * z)
        v8.store(rows, Index(8 * NUM_LANES), v8.broadcast(_C2_XX) * (xx - yy))
        if num_functions > 9:
            three = v8.broadcast(np.float32(3))
            four = v8.broadcast(np.float32(4))
            v8.store(rows, Index(9 * NUM_LANES), v8.broadcast(-_C3_CUBIC) * y * (three * xx - yy))
            v8.store(rows, Index(10 * NUM_LANES), v8.broadcast(_C3_XYZ) * xy * z)
            v8.store(rows, Index(11 * NUM_LANES), v8.broadcast(-_C3_ZZ) * y * (four * zz - xx - yy))
            v8.store(
                rows,
                Index(12 * NUM_LANES),
                v8.broadcast(_C3_ZZZ) * z * (two * zz - three * (xx + yy)),
            )
            v8.store(rows, Index(13 * NUM_LANES), v8.broadcast(-_C3_ZZ) * x * (four * zz - xx - yy))
            v8.store(rows, Index(14 * NUM_LANES), v8.broadcast(_C3_ZXX) * z * (xx - yy))
            v8.store(rows, Index(15 * NUM_LANES), v8.broadcast(-_C3_CUBIC) * x * (xx - three * yy))


@kernel_function()
def write_color(sh, sh_start, num_functions, maps, map_start, view, fog, rows, lane, records, slot):
    """Write max(0.5 + sum sh Y, 0), mapped and in the fog, to the record that starts at `slot`.

    Args:
        sh: SH coefficients, flat.
        sh_start: position of the splat's coefficients.
        num_functions: number of SH functions.
        maps: colour maps, flat.
        map_start: position of the splat's colour map; negative without one.
        view: numbers of the view.
        fog: mode of the fog.
        rows, lane: rows that prepare_colors wrote, and the splat's number in them.
        records, slot: records, flat, and position of the splat's record.
    """
    r = g = b = np.float32(0.5)
    for k in range(Index(num_functions)):
        value = rows[k * Index(NUM_LANES) + lane]
        r = scalar_fmuladd(value, sh[sh_start], r)
        g = scalar_fmuladd(value, sh[sh_start + Index(1)], g)
        b = scalar_fmuladd(value, sh[sh_start + Index(2)], b)
        sh_start += Index(3)
    zero = np.float32(0)
    r = max(r, zero)
    g = max(g, zero)
    b = max(b, zero)
    if map_start >= 0:
        mapped_r = _map_channel(maps, Index(map_start), r, g, b)
        mapped_g = _map_channel(maps, Index(map_start) + Index(4), r, g, b)
        b = _map_channel(maps, Index(map_start) + Index(8), r, g, b)
        r = mapped_r
        g = mapped_g
    if fog != L.NO_FOG:
        transmittance = rows[Index(TRANSMITTANCE * NUM_LANES) + lane]
        fog_share = np.float32(1) - transmittance
        r = scalar_fmuladd(transmittance, r, fog_share * view[L.V_AIRLIGHT])
        g = scalar_fmuladd(transmittance, g, fog_share * view[L.V_AIRLIGHT + 1])
        b = scalar_fmuladd(transmittance, b, fog_share * view[L.V_AIRLIGHT + 2])
    records[slot + Index(L.RED)] = r
    records[slot + Index(L.GREEN)] = g
    records[slot + Index(L.BLUE)] = b


@kernel_function()
def _map_channel(maps, row_start, r, g, b):
    """Return one row of a colour map, four numbers, applied to a colour; not below 0."""
    value = scalar_fmuladd(maps[row_start], r, maps[row_start + Index(3)])
    value = scalar_fmuladd(maps[row_start + Index(1)], g, value)
    return max(scalar_fmuladd(maps[row_start + Index(2)], b, value), np.float32(0))


@kernel_function()
def add_direction_slopes(x, y, z, num_functions, rows):
    """Return the sum over SH functions k >= 1 of a row's weight times the function's slope by x, y,
    z.

    The slopes are those of the polynomials in `write_basis`; only their part across the direction
    has a meaning.

    rows: flat; the weights of function k for eight splats start at k NUM_LANES.
    """
    two = v8.broadcast(np.float32(2))
    three = v8.broadcast(np.float32(3))
    c1 = v8.broadcast(_C1)
    gx = v8.negate(c1 * v8.load(rows, Index(3 * NUM_LANES)))
    gy = v8.negate(c1 * v8.load(rows, Index(1 * NUM_LANES)))
    gz = c1 * v8.load(rows, Index(2 * NUM_LANES))
    if num_functions > Index(4):
        xy = v8.broadcast(_C2_XY)
        zz = v8.broadcast(_C2_ZZ)
        a4 = xy * v8.load(rows, Index(4 * NUM_LANES))
        a5 = xy * v8.load(rows, Index(5 * NUM_LANES))
        a6 = two * zz * v8.load(rows, Index(6 * NUM_LANES))
        a7 = xy * v8.load(rows, Index(7 * NUM_LANES))
        a8 = two * v8.broadcast(_C2_XX) * v8.load(rows, Index(8 * NUM_LANES))
        gx = gx + a4 * y - a6 * x - a7 * z + a8 * x
        gy = gy + a4 * x - a5 * z - a6 * y - a8 * y
        gz = gz - a5 * y + two * a6 * z - a7 * x
    if num_functions > Index(9):
        four = v8.broadcast(np.float32(4))
        xx = x * x
        yy = y * y
        zz = z * z
        cubic = v8.broadcast(_C3_CUBIC)
        high = v8.broadcast(_C3_ZZ)
        a9 = cubic * v8.load(rows, Index(9 * NUM_LANES))
        a15 = cubic * v8.load(rows, Index(15 * NUM_LANES))
        a10 = v8.broadcast(_C3_XYZ) * v8.load(rows, Index(10 * NUM_LANES))
        a11 = high * v8.load(rows, Index(11 * NUM_LANES))
        a13 = high * v8.load(rows, Index(13 * NUM_LANES))
        a12 = three * v8.broadcast(_C3_ZZZ) * v8.load(rows, Index(12 * NUM_LANES))
        a14 = v8.broadcast(_C3_ZXX) * v8.load(rows, Index(14 * NUM_LANES))
        three_diff = three * (xx - yy)
        two_xy = two * x * y
        gx = gx - three * a9 * two_xy + a10 * y * z + a11 * two_xy - two * a12 * x * z
        gx = gx - a13 * (four * zz - three * xx - yy) + two * a14 * x * z - a15 * three_diff
        gy = gy - a9 * three_diff + a10 * x * z - a11 * (four * zz - xx - three * yy)
        gy = gy - two * a12 * y * z + a13 * two_xy - two * a14 * y * z + three * a15 * two_xy
        gz = gz + a10 * x * y - two * four * a11 * y * z + a12 * (two * zz - xx - yy)
        gz = gz - two * four * a13 * x * z + a14 * (xx - yy)
    return gx, gy, gz


# Rows of eight numbers that `_project_eight` writes: colour, covered pixels, record, cut, light.
_X_LO, _X_HI, _Y_LO, _Y_HI = (COLOR_ROWS + i for i in range(4))
_FIELDS = COLOR_ROWS + 4
_CUTS = _FIELDS + L.DEPTH + 1
_LIGHTS = _CUTS + CUT
_ROWS = _LIGHTS + SHADING_LINES
# Places in which a thread looks for ties at a time.
_TIE_RUN = 4096
# Largest sum of variances, px^2: beyond it float32 overflows, which no pixel would show.
_HUGE = np.float32(1e37)


class Parts(NamedTuple):
    """Parts that are projected.

    addresses: uint64 [P, NUM_ADDRESSES], see layout.
    sizes: int64 [P, 2], numbers of Gaussians and of SH functions.
    first_ids: int64 [P], index of each part's first Gaussian, counted through all parts.
    orders: uint64 [P], addresses of int32: the Gaussian at every place of means, quats, scales and
        opacities. 0 if they stand in the part's own order, as all other arrays do.
    views: float32 [P, VIEW], see layout.
    blocks: int64 [B, 3], part, first and last + 1 place.
    modes: int64 [MODES], see layout.
    """

    addresses: Any
    sizes: Any
    first_ids: Any
    orders: Any
    views: Any
    blocks: Any
    modes: Any


class Splats(NamedTuple):
    """Splats of a slice. Block b owns slots [b BLOCK_SIZE, (b + 1) BLOCK_SIZE) and fills the first
    of them.

    records: RECORD float32 of each slot, in the order of the block's places.
    rects: uint64, the tiles that a splat touches, as blend unpacks them.
    keys: uint32, the bits of z.
    splat_counts: int64 [B], splats of each block.
    bin_counts: int32 [B, Z], splats in each bin of the slice.
    cuts: CUT float32 of each slot, if modes ask for a clip.
    lights: SHADING_LINES float32 of each slot, if modes ask for light.
    """

    records: Any
    rects: Any
    keys: Any
    splat_counts: Any
    bin_counts: Any
    cuts: Any
    lights: Any


@kernel
def rank_splats(inputs, depths, histograms):
    """Write z of every Gaussian that may be seen, 0 for the others, and the cover of the image
    along z.

    Args:
        inputs: the parts.
        depths: float32 [B BLOCK_SIZE], written.
        histograms: float64 [C, 2, BINS], written: opacity times area (px^2) and number of the
            splats in each bin of z. Each of C runs of blocks has its own.
    """
    num_runs = histograms.shape[0]
    for run in prange(num_runs):
        addresses = inputs.addresses
        num_blocks = inputs.blocks.shape[0]
        histogram = histograms[run]
        gaussian_ids = np.empty(NUM_LANES, np.int32)
        areas = np.empty(NUM_LANES, np.float32)
        for z_bin in range(histogram.shape[1]):
            histogram[0, z_bin] = histogram[1, z_bin] = 0
        for block in range(num_blocks * run // num_runs, num_blocks * (run + 1) // num_runs):
            part, first, last = inputs.blocks[block]
            count = inputs.sizes[part, 0]
            view = inputs.views[part]
            means = floats_at(addresses[part, L.A_MEANS], count * 3)
            scales = floats_at(addresses[part, L.A_SCALES], count * 3)
            opacities = floats_at(addresses[part, L.A_OPACITIES], count)
            slot = block * BLOCK_SIZE
            for group in range(first, last, NUM_LANES):
                for lane in range(NUM_LANES):
                    gaussian_ids[lane] = min(group + lane, last - 1)
                _rank_eight(
                    means, scales, opacities, view, gaussian_ids, depths, Index(slot), areas
                )
                for lane in range(min(NUM_LANES, last - group)):
                    z = depths[slot + lane]
                    if z > 0:
                        z_bin = np.float32(z).view(np.int32) >> BIN_SHIFT
                        histogram[0, z_bin] += areas[lane]
                        histogram[1, z_bin] += 1
                slot += NUM_LANES


@kernel_function()
def _rank_eight(means, scales, opacities, view, gaussian_ids, depths, slot, areas):
    """Write z (0 if they cannot be seen) and the expected areas of eight Gaussians."""
    zeros = v8.broadcast(np.float32(0))
    two = v8.broadcast(np.float32(2))
    d = offsets_from_eye(means, gaussian_ids, Index(0), view)
    x, y, z = to_camera(d, view)
    inverse = inverse_divisor(z, view)
    x, y = to_image(x, y, inverse, view)
    s0, s1, s2 = gather3(scales, gaussian_ids, Index(0))
    opacity = v8.gather(opacities, gaussian_ids, Index(0), Index(1), Index(0))
    # No direction of an ellipsoid is longer than its longest axis, and no blur wider than 2 px.
    longest = v8.maximum(s0, v8.maximum(s1, s2))
    reach = longest * inverse
    extent_x = v8.fmuladd(v8.broadcast(view[L.V_GAIN]), reach, two)
    extent_y = v8.fmuladd(v8.broadcast(view[L.V_GAIN + 1]), reach, two)
    # Near plane and opacity, the image's four edges, the fog, the clip, the radius clip.
    may_be_seen = v8.mask_and(
        v8.at_least(z, v8.broadcast(view[L.V_NEAR])),
        v8.at_least(opacity, v8.broadcast(view[L.V_ALPHA_MIN])),
    )
    may_be_seen = v8.mask_and(may_be_seen, v8.at_least(x + extent_x, zeros))
    may_be_seen = v8.mask_and(
        may_be_seen, v8.at_least(v8.broadcast(view[L.V_SIZE]) - x + extent_x, zeros)
    )
    may_be_seen = v8.mask_and(may_be_seen, v8.at_least(y + extent_y, zeros))
    may_be_seen = v8.mask_and(
        may_be_seen, v8.at_least(v8.broadcast(view[L.V_SIZE + 1]) - y + extent_y, zeros)
    )
    max_distance_squared = v8.broadcast(view[L.V_FOG_FAR] * view[L.V_FOG_FAR])
    may_be_seen = v8.mask_and(
        may_be_seen, v8.at_least(max_distance_squared, dot(d[0], d[1], d[2], d[0], d[1], d[2]))
    )
    height = height_of(d, view)
    size = v8.broadcast(view[L.V_EXTENT]) * longest
    may_be_seen = v8.mask_and(may_be_seen, v8.at_least(height + size, zeros))
    may_be_seen = v8.mask_and(
        may_be_seen, v8.at_least(v8.broadcast(view[L.V_CLIP_REACH]), height - size)
    )
    if view[L.V_RADIUS_CLIP] > np.float32(0):
        may_be_seen = v8.mask_and(may_be_seen, _may_exceed_clip(opacity, reach, view))
    v8.store(depths, slot, v8.select(may_be_seen, z, zeros))
    # The mean over all directions of the ellipse's area, 2 pi sigma^2, only cuts z into slices.
    squares = s0 * s1 + s1 * s2 + s0 * s2
    focal = v8.broadcast(view[L.V_FOCAL] * view[L.V_FOCAL + 1] * np.float32(2 * math.pi / 3))
    area = v8.fmuladd(focal * squares, inverse * inverse, two) * opacity
    v8.store(areas, Index(0), v8.minimum(area, v8.broadcast(view[L.V_SIZE] * view[L.V_SIZE + 1])))


@kernel_function()
def _may_exceed_clip(opacity, reach, view):
    """Return False only for splats that are surely no larger than the view's radius clip.

    The bound is that of the projection with the longest axis for all axes, and with the opacity
    before antialiasing, which only lowers it. The margins are a thousand times the rounding error.

    reach: longest semi-axis over the divisor.
    """
    k = v8.broadcast(np.float32(0.5) * LOG2_E)
    budget = (
        v8.maximum(log2(opacity) - v8.broadcast(view[L.V_LOG_CUT]), v8.broadcast(np.float32(0))) / k
    )
    gain = max(view[L.V_GAIN], view[L.V_GAIN + 1]) / view[L.V_EXTENT]
    axis = v8.broadcast(gain) * reach
    square = (budget + v8.broadcast(np.float32(1e-3))) * v8.fmuladd(
        axis, axis, v8.broadcast(view[L.V_BLUR])
    )
    clip = view[L.V_RADIUS_CLIP]
    return v8.greater(square, v8.broadcast(clip * clip * np.float32(1 - 1e-3)))


@kernel
def project_slice(inputs, depth_bits, bins, open_sums, splats):
    """Project the Gaussians in bins[0] <= bin of z < bins[1] that touch an open tile.

    Args:
        inputs: the parts.
        depth_bits: uint32, z as rank_splats wrote it.
        bins: first bin, and one past the last.
        open_sums: int32 [rows + 1, columns + 1], number of open tiles above and left.
        splats: written.
    """
    for block in prange(inputs.blocks.shape[0]):
        # A separate function, since numba drops what a parallel loop writes to a record's arrays.
        _project_block(np.int64(block), inputs, depth_bits, bins, open_sums, splats)


@kernel_function()
def _project_block(block, inputs, depth_bits, bins, open_sums, splats):
    """Project the Gaussians of one block."""
    part, first, last = inputs.blocks[block]
    addresses = inputs.addresses
    modes = inputs.modes
    view = inputs.views[part]
    records = splats.records
    rects = splats.rects
    keys = splats.keys
    bin_counts = splats.bin_counts
    gaussian_ids = np.empty(BLOCK_SIZE + NUM_LANES, np.int32)
    rows = np.empty(_ROWS * NUM_LANES, np.float32)
    base = block * BLOCK_SIZE
    # Gaussians of the slice, and the arrays of their part.
    num_picked = _pick_bins(depth_bits, base, first, last, bins, gaussian_ids)
    count, num_stored_functions = inputs.sizes[part]
    means = floats_at(addresses[part, L.A_MEANS], count * 3)
    quats = floats_at(addresses[part, L.A_QUATS], count * 4)
    scales = floats_at(addresses[part, L.A_SCALES], count * 3)
    opacities = floats_at(addresses[part, L.A_OPACITIES], count)
    sh = floats_at(addresses[part, L.A_SH], count * num_stored_functions * 3)
    slopes = floats_at(addresses[part, L.A_SLOPES], count * 3 if view[L.V_LIT] > 0 else 1)
    map_count = np.int64(view[L.V_MAPS])
    maps = floats_at(addresses[part, L.A_MAPS], max(map_count, 1) * MAP)
    map_rows = shorts_at(addresses[part, L.A_ROWS], count if map_count > 1 else 1)
    is_ordered = inputs.orders[part] != Index(0)
    order = floats_at(inputs.orders[part], count if is_ordered else 1)
    num_functions = min(modes[L.M_NUM_SH_FUNCTIONS], num_stored_functions)
    # Project eight Gaussians, then write those that touch an open tile one by one.
    slot = Index(base)
    for group in range(Index(0), Index(num_picked), Index(NUM_LANES)):
        _project_eight(
            means, quats, scales, opacities, view, gaussian_ids, group, num_functions, modes, rows
        )
        for lane in range(min(Index(NUM_LANES), Index(num_picked) - group)):
            if not _touches_open_tile(rows, lane, open_sums, rects, slot):
                continue
            splat = gaussian_ids[group + lane]
            if is_ordered:
                splat = np.float32(order[splat]).view(np.int32)
            record = slot * Index(RECORD)
            _write_record(rows, lane, inputs.first_ids[part] + splat, records, record)
            records[record + Index(L.IS_OVERLAY)] = view[L.V_OVERLAY]
            if modes[L.M_COLOR]:
                sh_start = Index(splat) * Index(num_stored_functions * 3)
                map_start = _map_start(map_rows, splat, map_count)
                write_color(
                    sh,
                    sh_start,
                    num_functions,
                    maps,
                    map_start,
                    view,
                    modes[L.M_FOG],
                    rows,
                    lane,
                    records,
                    record,
                )
            if modes[L.M_CLIP]:
                for field in range(Index(L.C_REACH + 1)):
                    cut = rows[(Index(_CUTS) + field) * Index(NUM_LANES) + lane]
                    splats.cuts[slot * Index(CUT) + field] = cut
            if modes[L.M_LIGHT]:
                _write_lights(slopes, splat, modes[L.M_FOG], view, rows, lane, splats.lights, slot)
            keys[slot] = np.float32(records[record + Index(L.DEPTH)]).view(np.uint32)
            slot += Index(1)
    # Count the block's splats, in all and in each bin of z.
    splats.splat_counts[block] = slot - Index(base)
    for z_bin in range(bin_counts.shape[1]):
        bin_counts[block, z_bin] = 0
    for i in range(Index(base), slot):
        bin_counts[block, np.int64(keys[i] >> np.uint32(BIN_SHIFT)) - bins[0]] += 1


@kernel
def order_ties(keys, slots, rects, records):
    """Put splats of equal keys in the order of their ids. keys are sorted; slots and rects move."""
    num_runs = (keys.size + _TIE_RUN - 1) // _TIE_RUN
    for run in prange(num_runs):
        end = min((np.int64(run) + 1) * _TIE_RUN, keys.size)
        first = np.int64(run) * _TIE_RUN
        while 0 < first < end and keys[first] == keys[first - 1]:  # the run before sorts these
            first += 1
        while first < end:
            last = first + 1
            while last < keys.size and keys[last] == keys[first]:
                last += 1
            if last - first > 1:
                _sort_by_id(slots, rects, records, first, last)
            first = last


@kernel_function()
def _sort_by_id(slots, rects, records, first, last):
    """Sort by id with Shell's sort: equal depths come in a few rising runs, of any length."""
    gap = 1
    while 3 * gap < last - first:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(first + gap, last):
            slot = slots[i]
            rect = rects[i]
            number = _id_of(records, slot)
            j = i
            while j - gap >= first and _id_of(records, slots[j - gap]) > number:
                slots[j], rects[j] = slots[j - gap], rects[j - gap]
                j -= gap
            slots[j] = slot
            rects[j] = rect
        gap //= 3


@kernel_function()
def _id_of(records, slot):
    return np.float32(records[Index(slot) * Index(RECORD) + Index(L.SPLAT_ID)]).view(np.int32)


@kernel_function()
def _pick_bins(depth_bits, base, first, last, bins, gaussian_ids):
    """Write the numbers of a block's Gaussians in a range of bins, filled up to groups of eight."""
    low = np.uint32(bins[0] << BIN_SHIFT)
    span = np.uint32((bins[1] - bins[0]) << BIN_SHIFT)
    num_picked = Index(0)
    for i in range(Index(last - first)):
        gaussian_ids[num_picked] = np.int32(first + np.int64(i))
        num_picked += Index(np.uint32(depth_bits[Index(base) + i] - low) < span)
    for lane in range(Index(NUM_LANES)):
        gaussian_ids[num_picked + lane] = gaussian_ids[max(num_picked, Index(1)) - Index(1)]
    return num_picked


@kernel_function()
def _map_start(map_rows, splat, map_count):
    """Return the position of a splat's colour map, -1 without one. A wrong row means the first."""
    if map_count == 0:
        return np.int64(-1)
    row = np.int64(0)
    if map_count > 1:
        row = np.int64(map_rows[splat])
        if row < 0 or row >= map_count:
            row = np.int64(0)
    return row * np.int64(MAP)


@kernel_function()
def _touches_open_tile(rows, lane, open_sums, rects, slot):
    """Write a splat's tiles, and return True if it covers a pixel centre and one of its tiles is
    open.
    """
    x_lo = rows[Index(_X_LO * NUM_LANES) + lane]
    x_hi = rows[Index(_X_HI * NUM_LANES) + lane]
    y_lo = rows[Index(_Y_LO * NUM_LANES) + lane]
    y_hi = rows[Index(_Y_HI * NUM_LANES) + lane]
    if not (x_lo <= x_hi and y_lo <= y_hi):
        return False
    c0 = Index(x_lo) // Index(TILE_W)
    c1 = Index(x_hi) // Index(TILE_W)
    r0 = Index(y_lo) // Index(TILE_H)
    r1 = Index(y_hi) // Index(TILE_H)
    rects[slot] = c0 | r0 << Index(16) | c1 << Index(32) | r1 << Index(48)
    c1 = c1 + Index(1)
    r1 = r1 + Index(1)
    return open_sums[r1, c1] - open_sums[r0, c1] - open_sums[r1, c0] + open_sums[r0, c0] > 0


@kernel_function()
def _write_record(rows, lane, number, records, record):
    """Copy a splat's fields from `rows` to its record."""
    for field in range(Index(L.DEPTH + 1)):
        records[record + field] = rows[(Index(_FIELDS) + field) * Index(NUM_LANES) + lane]
    records[record + Index(L.SPLAT_ID)] = np.int32(number).view(np.float32)


@kernel_function()
def _write_lights(slopes, splat, fog, view, rows, lane, lights, slot):
    """Write the lights of a splat; zeros if its part is not lit pixel by pixel."""
    first = slot * Index(SHADING_LINES)
    if not view[L.V_LIT] > np.float32(0):
        for line in range(Index(SHADING_LINES)):
            lights[first + line] = np.float32(0)
        return
    for line in range(Index(L_RED)):
        lights[first + line] = rows[(Index(_LIGHTS) + line) * Index(NUM_LANES) + lane]
    transmittance = np.float32(1)
    if fog != L.NO_FOG:
        transmittance = rows[Index(TRANSMITTANCE * NUM_LANES) + lane]
    for channel in range(Index(3)):
        slope = slopes[Index(splat) * Index(3) + channel]
        lights[first + Index(L_RED) + channel] = transmittance * slope


@kernel_function()
def _project_eight(
    means, quats, scales, opacities, view, gaussian_ids, group, num_functions, modes, rows
):
    """Write records, pixel boxes and colour rows of eight Gaussians, side by side in `rows`."""
    # SH functions and fog towards the eye.
    d = offsets_from_eye(means, gaussian_ids, group, view)
    x, y, z = to_camera(d, view)
    if modes[L.M_COLOR]:
        directions = rotation_row(view, Index(2)) if view[L.V_PARALLEL] > 0 else d
        has_banks = modes[L.M_BANKS] != 0
        if has_banks:
            table = floats_at(np.uint64(modes[L.M_BANKS]), modes[L.M_BANKS_COUNT])
            write_log_means(table, x, y, z, rows, Index(TRANSMITTANCE * NUM_LANES))
        prepare_colors(
            directions[0],
            directions[1],
            directions[2],
            view,
            num_functions,
            modes[L.M_FOG],
            has_banks,
            rows,
        )
    # Covariance in the image.
    inverse = inverse_divisor(z, view)
    xx, xy, yy, minors = image_covariance(quats, scales, gaussian_ids, group, x, y, inverse, view)

    ones = v8.broadcast(np.float32(1))
    half = v8.broadcast(np.float32(0.5))
    blur = v8.broadcast(view[L.V_BLUR])
    k = v8.broadcast(np.float32(0.5) * LOG2_E)
    blurred_x = xx + blur
    blurred_y = yy + blur
    inverse_y = ones / blurred_y
    inverse_x = ones / blurred_x
    # Variance along a row, det / yy. minors = det / yy before the blur, so nothing overflows.
    variance_along_row = blur + v8.fmuladd(blur * xx, inverse_y, minors)
    log_opacity = log2(v8.gather(opacities, gaussian_ids, group, Index(1), Index(0)))
    if modes[L.M_ANTIALIASED]:
        log_opacity = v8.fmuladd(half, log2(minors / variance_along_row), log_opacity)
    # Box in which alpha reaches the cut.
    log_cut = v8.broadcast(view[L.V_LOG_CUT])
    budget = v8.maximum(log_opacity - log_cut, v8.broadcast(np.float32(0))) / k
    radius_x = v8.sqrt(budget * blurred_x)
    radius_y = v8.sqrt(budget * blurred_y)

    mean_x, mean_y = to_image(x, y, inverse, view)
    is_drawn = v8.mask_and(
        v8.at_least(log_opacity, log_cut), v8.at_least(v8.broadcast(_HUGE), blurred_x + blurred_y)
    )
    larger_radius = v8.maximum(radius_x, radius_y)
    is_drawn = v8.mask_and(is_drawn, v8.greater(larger_radius, v8.broadcast(view[L.V_RADIUS_CLIP])))
    # Cut at a height, and lines of the light.
    if modes[L.M_CLIP]:
        has_kept_part, offset, lx, ly, gx, gy, growth_limit = cut_eight(
            quats, scales, gaussian_ids, group, d, x, y, inverse, view
        )
        is_drawn = v8.mask_and(is_drawn, has_kept_part)
        v8.store(rows, Index((_CUTS + L.C_VALUE) * NUM_LANES), offset)
        v8.store(rows, Index((_CUTS + L.C_X) * NUM_LANES), lx)
        v8.store(rows, Index((_CUTS + L.C_Y) * NUM_LANES), ly)
        v8.store(rows, Index((_CUTS + L.C_RIGHT) * NUM_LANES), gx)
        v8.store(rows, Index((_CUTS + L.C_DOWN) * NUM_LANES), gy)
        v8.store(rows, Index((_CUTS + L.C_REACH) * NUM_LANES), growth_limit)
    if modes[L.M_LIGHT] and view[L.V_LIT] > np.float32(0):
        zeros = v8.broadcast(np.float32(0))
        ray = (zeros, zeros, ones) if view[L.V_PARALLEL] > 0 else (x, y, z)
        lines = light_eight(rotation_from_quats(quats, gaussian_ids, group), ray, view)
        v8.store(rows, Index((_LIGHTS + L_FACING) * NUM_LANES), lines[0])
        v8.store(rows, Index((_LIGHTS + L_X) * NUM_LANES), lines[1])
        v8.store(rows, Index((_LIGHTS + L_Y) * NUM_LANES), lines[2])
        v8.store(rows, Index((_LIGHTS + L_WRAP) * NUM_LANES), lines[3])
        v8.store(rows, Index((_LIGHTS + L_LEAN_X) * NUM_LANES), lines[4])
        v8.store(rows, Index((_LIGHTS + L_LEAN_Y) * NUM_LANES), lines[5])
    # Covered pixels, and the fields of the record.
    _write_box(
        mean_x, radius_x, v8.broadcast(view[L.V_SIZE]), is_drawn, Index(_X_LO), Index(_X_HI), rows
    )
    _write_box(
        mean_y,
        radius_y,
        v8.broadcast(view[L.V_SIZE + 1]),
        is_drawn,
        Index(_Y_LO),
        Index(_Y_HI),
        rows,
    )
    _write(rows, Index(L.MEAN_X), mean_x)
    _write(rows, Index(L.MEAN_Y), mean_y)
    _write(rows, Index(L.LEAN_X), xy * inverse_y)
    _write(rows, Index(L.SHARP_X), v8.sqrt(k / variance_along_row))
    _write(rows, Index(L.FALL_Y), k * inverse_y)
    _write(rows, Index(L.LOG_OPACITY), log_opacity)
    _write(rows, Index(L.RADIUS_Y), radius_y)
    _write(rows, Index(L.FALL_X), k * inverse_x)
    _write(rows, Index(L.LEAN_Y), xy * inverse_x)
    _write(rows, Index(L.BLUNT_Y), v8.sqrt(variance_along_row * blurred_y * inverse_x / k))
    _write(rows, Index(L.DEPTH), z)


@kernel_function()
def _write(rows, field, value):
    v8.store(rows, (Index(_FIELDS) + field) * Index(NUM_LANES), value)


@kernel_function()
def _write_box(mean, radius, size, is_drawn, first_field, last_field, rows):
    """Write the first and last pixel whose centre lies within the radius.

    The last is below the first if there is none.
    """
    zeros = v8.broadcast(np.float32(0))
    half = v8.broadcast(np.float32(0.5))
    ones = v8.broadcast(np.float32(1))
    first = v8.maximum(mean - radius - half, zeros)
    last = v8.minimum(mean + radius - half, size - ones)
    v8.store(rows, first_field * Index(NUM_LANES), v8.negate(v8.floor(v8.negate(first))))
    v8.store(
        rows, last_field * Index(NUM_LANES), v8.select(is_drawn, v8.floor(last), v8.negate(ones))
    )
