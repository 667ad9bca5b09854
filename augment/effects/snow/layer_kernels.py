"""Numba kernels of lying snow: depths on cells, Gaussians, fine grain, and LiDAR beams.

`depth` launches `find_depths`; `layer` launches `count_splats`, `fill_splats` and the kernels
beside them; `relief` launches `add_grain`; `lidar` launches `intersect_layer` and `fill_layer`.
Callers prepare the arrays, and kernels trust them. C counts cells, S Gaussians, N beams.

Every cell with snow gets one disc on the snow's surface. Where the surface drops by more than a
disc can lean, over the cell's border, upright discs close the wall below it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.effects.gradient_noise import DEVIATION
from augment.exposure.cells import OPEN_EDGE
from augment.render.cpu.hash_kernels import mix
from augment.render.cpu.jit import kernel, kernel_function, serial_kernel
from augment.render.sh import SH_C0
from augment.rng import STEP_X, STEP_Y
from augment.scene.semantics import SemanticClass

# ---- Noise ---------------------------------------------------------------------------------------

_COLUMN_STEP = np.uint64(STEP_X)  # step of the hash per lattice column
_ROW_STEP = np.uint64(STEP_Y)  # step of the hash per lattice row
_LOW_MASK = np.uint64(0xFFFFFFFF)  # mask of the low 32 bits
_UNIT = 2.0**-53  # size of one step of a float64 in [0, 1)
_SHIFT_11 = np.uint64(11)  # shift to the upper 53 bits
_SHIFT_32 = np.uint64(32)  # shift to the upper 32 bits


@kernel_function()
def _uniform(bits, number):
    """Return the number-th random number of these bits, in [-1, 1)."""
    bits = mix(bits + np.uint64(number + 1) * _COLUMN_STEP)
    return np.float64(np.int64(bits >> _SHIFT_11)) * _UNIT * 2.0 - 1.0


# ---- Discs of snow on cells ----------------------------------------------------------------------

MAX_WALLS = 8  # largest number of discs, one above the other, that close a wall
MAX_DISC_SLOPE = 1.5  # steepest slope that a cell's disc follows
# Largest share of the depth by which snow evens out the surface beneath it.
MAX_SMOOTHING_SHARE = 0.5
DISC_SIGMA = 0.78  # standard deviation of a disc, in cells
STEEP_DISC_SIGMA = 0.64  # the same on a slope of 45 degrees, where discs are stretched as well
RIM_DISC_SIGMA = 0.58  # the same beside bare ground, so that the snow's edge is sharp
MAX_RIM_STRETCH = 1.2  # largest stretch of such a disc down a slope
RIM_INSET = 0.2  # distance by which a disc keeps away from bare ground, in cells
MAX_DISC_SHIFT = 0.2  # largest distance of a disc from its cell's middle, in cells
MAX_DISC_THICKNESS = 0.2  # largest thickness of a disc, in cells
WALL_DISC_SIGMA = 0.7  # upward standard deviation of a wall's discs, in heights of one
WALL_LIFT = 0.25  # height of the lowest disc over the wall's foot, in heights of one
WALL_INSET = 0.12  # distance of a wall behind the cell's border, in cells
DISC_DEPTH = 0.5  # depth of a disc's middle below the surface, in its thickness
ROUGHNESS_RAD = 0.03  # tilt of a disc's normal for its light, radians
GRAIN_ROUGHNESS_RAD = 0.15  # further tilt at a grain of 1
BRIGHTNESS_NOISE = 0.01  # random change of a disc's brightness
GRAIN_BRIGHTNESS_NOISE = 0.035  # further change at a grain of 1
MOTTLE_BRIGHTNESS = 0.010  # change of brightness per deviation of the mottling noise
HOLLOW_LOSS = 0.9  # loss of brightness in a hollow, per bend
MAX_BEND = 0.12  # largest bend that counts
THIN_DEPTH_M = 0.005  # depth of snow through which the ground darkens it by 1/e
THIN_LOSS = 0.42  # loss of brightness of the thinnest snow
PACKED_SHARE = 0.6  # brightness of packed snow over that of fresh snow
SUNLESS_LIGHT = 0.35  # light on the bare surface where the sun does not reach
SUNLIT_LIGHT = 0.8  # light on the bare surface where the sun reaches fully


@kernel
def relax_heights(neighbours, z, relaxed_z):
    """Run one step that evens out the surface beneath the snow, all [C].

    Each height moves towards the mean of opposite neighbours, so that slopes stay as they are. The
    step ignores where snow lies; otherwise deeper snow would stand lower where it evens out more.
    """
    for i in prange(len(z)):
        dz = 0.0
        for axis in range(2):
            before = neighbours[i, 2 * axis]
            after = neighbours[i, 2 * axis + 1]
            if before >= 0 and after >= 0:
                dz += 0.5 * (np.float64(z[before]) + z[after]) - z[i]
        relaxed_z[i] = np.float32(z[i] + 0.25 * dz)


@kernel
def soften_light(neighbours, heights, light, softened):
    """Run one step that evens out the light on cells that carry snow, as `relax_heights` does."""
    for i in prange(len(heights)):
        dl = 0.0
        if heights[i] > 0:
            for axis in range(2):
                before = neighbours[i, 2 * axis]
                after = neighbours[i, 2 * axis + 1]
                if before >= 0 and after >= 0 and heights[before] > 0 and heights[after] > 0:
                    dl += 0.5 * (np.float64(light[before]) + light[after]) - light[i]
        softened[i] = np.float32(light[i] + 0.25 * dl)


@kernel
def find_tops(centers, heights, relaxed_z, tops):
    """Compute z of every cell's surface, snow included, float64 [C]."""
    for i in prange(len(heights)):
        h = np.float64(heights[i])
        z = np.float64(centers[i, 2])
        smoothing = min(
            max(np.float64(relaxed_z[i]) - z, -MAX_SMOOTHING_SHARE * h), MAX_SMOOTHING_SHARE * h
        )
        tops[i] = z + h + (smoothing if h > 0 else 0.0)


@kernel_function()
def _side_surface(i, side, neighbours, size, centers, tops):
    """Return z of the surface on one side of a covered cell, and the level distance to it.

    The distance is half a cell where the layer ends: at an open edge, and above a neighbour whose
    snow does not reach up. It is 0 where the layer ends against something higher.
    """
    neighbour = neighbours[i, side]
    z = np.float64(centers[i, 2])
    if neighbour < 0:
        return z, (0.5 * size if neighbour == OPEN_EDGE else 0.0)
    if tops[neighbour] < z - MAX_DISC_SLOPE * size:
        return z, 0.5 * size
    if centers[neighbour, 2] > tops[i] + MAX_DISC_SLOPE * size:
        return z, 0.0
    return tops[neighbour], size


@kernel_function()
def _count_walls(i, side, neighbours, sizes, centers, tops):
    """Return the number of discs that close the wall on one side of a cell, and its height."""
    size = np.float64(sizes[i])
    lower_z, run = _side_surface(i, side, neighbours, size, centers, tops)
    drop = tops[i] - lower_z
    if run == 0.0 or drop <= MAX_DISC_SLOPE * size:
        return 0, drop
    return min(math.ceil(drop / size), MAX_WALLS), drop


@kernel
def count_splats(neighbours, sizes, centers, heights, tops, counts):
    """Count the Gaussians of each cell's snow, [C]."""
    for i in prange(len(heights)):
        count = 0
        if heights[i] > 0:
            count = 1
            for side in range(4):
                count += _count_walls(i, side, neighbours, sizes, centers, tops)[0]
        counts[i] = count


@kernel_function()
def _surface_slope(i, axis, neighbours, size, ground_slope, centers, tops):
    """Return the rise of the surface per metre along x (axis 0) or y (1)."""
    before, run_before = _side_surface(i, 2 * axis, neighbours, size, centers, tops)
    after, run_after = _side_surface(i, 2 * axis + 1, neighbours, size, centers, tops)
    if run_before < size:  # where the layer ends, the bare surface's height counts
        before -= run_before * ground_slope
    if run_after < size:
        after += run_after * ground_slope
    if run_before == 0.0 and run_after == 0.0:
        return ground_slope
    if run_before == 0.0:
        return (after - tops[i]) / run_after
    if run_after == 0.0:
        return (tops[i] - before) / run_before
    return (after - before) / (run_before + run_after)


@kernel_function()
def _surface_bend(i, neighbours, size, tops):
    """Return the upward bend of the surface around a cell, as slope over a cell; 0 = level."""
    bend = 0.0
    count = 0
    for side in range(4):
        neighbour = neighbours[i, side]
        if neighbour >= 0:
            bend += tops[neighbour] - tops[i]
            count += 1
    return bend / size if count == 4 else 0.0


@kernel_function()
def _direction_inwards(i, axis, neighbours, heights):
    """Return -1, 0 or 1 along x (axis 0) or y (1), away from bare ground; 2 between two."""
    before_id = neighbours[i, 2 * axis]
    after_id = neighbours[i, 2 * axis + 1]
    is_bare_before = before_id == OPEN_EDGE or (before_id >= 0 and heights[before_id] == 0)
    is_bare_after = after_id == OPEN_EDGE or (after_id >= 0 and heights[after_id] == 0)
    if is_bare_before and is_bare_after:
        return 2
    return 1 if is_bare_before else (-1 if is_bare_after else 0)


@kernel_function()
def _write_quaternion(nx, ny, nz, s, quats):
    """Write the quaternion wxyz that turns z to the unit normal and x to the fall line.

    The normal's nz is >= 0.
    """
    horizontal = math.sqrt(nx * nx + ny * ny)
    cos = nx / horizontal if horizontal > 1e-9 else 1.0
    half_cos = math.sqrt(max(0.5 * (1.0 + cos), 0.0))
    half_sin = math.copysign(math.sqrt(max(0.5 * (1.0 - cos), 0.0)), ny)
    tilt_cos = math.sqrt(max(0.5 * (1.0 + nz), 0.0))
    tilt_sin = math.sqrt(max(0.5 * (1.0 - nz), 0.0))
    quats[s, 0] = half_cos * tilt_cos
    quats[s, 1] = -half_sin * tilt_sin
    quats[s, 2] = half_cos * tilt_sin
    quats[s, 3] = half_sin * tilt_cos


# Kernels read the records' fields one by one: numba 0.6x takes an unpacked record for a shape.


class CellArrays(NamedTuple):
    """Arrays of ExposedCells that snow is made from."""

    centers: np.ndarray
    normals: np.ndarray
    sizes: np.ndarray
    edges: np.ndarray
    neighbours: np.ndarray
    light: np.ndarray
    tracks: np.ndarray
    banks: np.ndarray
    semantic: np.ndarray


class CellDepths(NamedTuple):
    """Snow on C cells."""

    depths_m: np.ndarray  # depth in metres, 0 where there is no snow
    mottle: np.ndarray  # noise that the snow's colour follows
    random_bits: np.ndarray  # uint64, random bits for the grain


class SplatArrays(NamedTuple):
    """Arrays of S Gaussians."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    sh: np.ndarray
    normals: np.ndarray  # [S, 3], or empty if not asked for
    slopes: np.ndarray  # [S, 3], or empty if not asked for


@kernel_function()
def _write_colour(s, normal, tints, packed, sun_share, lights, colors, sh, normals, slopes):
    """Write the colour of Gaussian s: lit by its normal, or in shade with the slope of light.

    tints: factors of red, green and blue. packed: 0 to 1, darker. sun_share: share of the sun.
    """
    share = normal[0] * lights[0, 0] + normal[1] * lights[0, 1] + normal[2] * lights[0, 2]
    share = min(max((share + colors.wrap) / (1.0 + colors.wrap), 0.0), 1.0)
    # Packed snow reflects less of every colour alike: a grey surface has the tint of the light.
    reflectance = 1.0 - packed * (1.0 - PACKED_SHARE)
    for c in range(3):
        shadow = tints[c] * reflectance * lights[2, c]
        rise = tints[c] * reflectance * (lights[1, c] - lights[2, c]) * sun_share
        baked_share = share if colors.is_baked else 0.0
        sh[s, 0, c] = np.float32((shadow + rise * baked_share - 0.5) / SH_C0)
        if len(slopes) > 0:
            slopes[s, c] = np.float32(rise)
        if len(normals) > 0:
            normals[s, c] = np.float32(normal[c])


@kernel_function()
def _rough_normal(normal, amount, bits, number):
    """Return the normal, tilted at random by about `amount` radians."""
    x = normal[0] + amount * _uniform(bits, number)
    y = normal[1] + amount * _uniform(bits, number + 1)
    z = normal[2] + amount * _uniform(bits, number + 2)
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@kernel
def fill_splats(cells, depths, tops, firsts, lights, colors, splats):
    """Write the Gaussians of every covered cell, from index firsts[i] on.

    lights [3, 3]: direction of the sun, colour of lit snow, colour of shaded snow. splats: written.
    """
    for i in prange(len(depths.depths_m)):
        # A function of its own, since numba compiles the body of a parallel loop many times over.
        _fill_cell(np.int64(i), cells, depths, tops, firsts, lights, colors, splats)


@kernel_function()
def _fill_cell(i, cells, depths, tops, firsts, lights, colors, splats):
    """Write the disc of cell i, and the upright discs of the walls below it."""
    centers = cells.centers
    ground_normals = cells.normals
    sizes = cells.sizes
    neighbours = cells.neighbours
    tracks = cells.tracks
    light = cells.light
    depths_m = depths.depths_m
    mottle = depths.mottle
    random_bits = depths.random_bits
    means = splats.means
    quats = splats.quats
    scales = splats.scales
    sh = splats.sh
    normals = splats.normals
    slopes = splats.slopes
    if depths_m[i] == 0:
        return
    size = np.float64(sizes[i])
    bits = random_bits[i]
    depth_m = np.float64(depths_m[i])
    x = np.float64(centers[i, 0])
    y = np.float64(centers[i, 1])
    up = np.float64(ground_normals[i, 2])
    gx = _surface_slope(i, 0, neighbours, size, -ground_normals[i, 0] / up, centers, tops)
    gy = _surface_slope(i, 1, neighbours, size, -ground_normals[i, 1] / up, centers, tops)
    steepness = math.sqrt(gx * gx + gy * gy)
    if steepness > MAX_DISC_SLOPE:
        gx = gx * MAX_DISC_SLOPE / steepness
        gy = gy * MAX_DISC_SLOPE / steepness
        steepness = MAX_DISC_SLOPE
    stretch = math.sqrt(1.0 + steepness * steepness)
    normal = (-gx / stretch, -gy / stretch, 1.0 / stretch)

    inwards_x = _direction_inwards(i, 0, neighbours, depths_m)
    inwards_y = _direction_inwards(i, 1, neighbours, depths_m)
    is_rim = inwards_x != 0 or inwards_y != 0
    sigma = (
        RIM_DISC_SIGMA
        if is_rim
        else DISC_SIGMA + (STEEP_DISC_SIGMA - DISC_SIGMA) * min(steepness, 1.0)
    )
    sigma *= size
    sigma *= 1.0 + 0.2 * colors.grain * abs(_uniform(bits, 0))
    # Discs on steep sides are long; if scattered, they would look like fur.
    shift = (0.5 if is_rim else max(1.0 - 1.2 * steepness, 0.1)) * MAX_DISC_SHIFT * size
    dx = shift * _uniform(bits, 1)
    dy = shift * _uniform(bits, 2)
    dx += RIM_INSET * size * inwards_x if inwards_x < 2 else 0.0
    dy += RIM_INSET * size * inwards_y if inwards_y < 2 else 0.0
    thickness = min(MAX_DISC_THICKNESS * size, 0.006 + 0.25 * depth_m)
    s = firsts[i]
    means[s, 0] = np.float32(x + dx)
    means[s, 1] = np.float32(y + dy)
    means[s, 2] = np.float32(tops[i] + gx * dx + gy * dy - DISC_DEPTH * thickness)
    _write_quaternion(normal[0], normal[1], normal[2], s, quats)
    long_stretch = min(stretch, MAX_RIM_STRETCH) if is_rim else stretch
    scales[s, 0] = sigma * long_stretch
    scales[s, 1] = sigma
    scales[s, 2] = thickness

    bend = min(max(_surface_bend(i, neighbours, size, tops), -MAX_BEND), MAX_BEND)
    brightness = (
        1.0
        + (BRIGHTNESS_NOISE + GRAIN_BRIGHTNESS_NOISE * colors.grain) * _uniform(bits, 3)
        + MOTTLE_BRIGHTNESS * mottle[i]
    )
    brightness *= 1.0 - THIN_LOSS * math.exp(-depth_m / THIN_DEPTH_M)
    hollow_loss = HOLLOW_LOSS * bend
    tints = (
        brightness * (1.0 - hollow_loss),
        brightness * (1.0 - 0.8 * hollow_loss),
        brightness * (1.0 - 0.55 * hollow_loss),
    )
    dirt = min(max(0.8 + 0.2 * mottle[i] + 0.15 * _uniform(bits, 4), 0.3), 1.0)
    packed = colors.packed * tracks[i] * tracks[i] * dirt
    sun_share = min(max((light[i] - SUNLESS_LIGHT) / (SUNLIT_LIGHT - SUNLESS_LIGHT), 0.0), 1.0)
    sun_share = sun_share * sun_share * (3.0 - 2.0 * sun_share)
    roughness = (ROUGHNESS_RAD + GRAIN_ROUGHNESS_RAD * colors.grain) / stretch
    facing = _rough_normal(normal, roughness, bits, 5)
    _write_colour(s, facing, tints, packed, sun_share, lights, colors, sh, normals, slopes)

    for side in range(4):
        count, drop = _count_walls(i, side, neighbours, sizes, centers, tops)
        out_x = (1.0 if side == 1 else -1.0) if side < 2 else 0.0
        out_y = (1.0 if side == 3 else -1.0) if side >= 2 else 0.0
        for k in range(count):
            s += 1
            means[s, 0] = np.float32(x + (0.5 - WALL_INSET) * size * out_x)
            means[s, 1] = np.float32(y + (0.5 - WALL_INSET) * size * out_y)
            step = drop / (count + WALL_LIFT)
            means[s, 2] = np.float32(tops[i] - step * (k + 0.5))
            normal = (0.96 * out_x, 0.96 * out_y, 0.28)
            _write_quaternion(normal[0], normal[1], normal[2], s, quats)
            scales[s, 0] = WALL_DISC_SIGMA * step
            scales[s, 1] = DISC_SIGMA * size
            scales[s, 2] = thickness
            normal = (0.8 * out_x, 0.8 * out_y, 0.6)  # normal of a rounded side, for its light
            facing = _rough_normal(normal, roughness, bits, 8 + 12 * side + 3 * (k % 4))
            _write_colour(s, facing, tints, packed, sun_share, lights, colors, sh, normals, slopes)


@kernel
def hide_buried(hideable_ids, covering_cells, depths_m, opacities):
    """Set opacity 0 for every Gaussian hideable_ids[b] whose covering_cells[b] all carry snow."""
    for b in prange(len(hideable_ids)):
        is_hidden = True
        for k in range(covering_cells.shape[1]):
            cell_id = covering_cells[b, k]
            is_hidden &= cell_id >= 0 and depths_m[cell_id] > 0
        if is_hidden:
            opacities[hideable_ids[b]] = 0


# ---- Grain of near snow, as `relief.add_grain` defines it ----------------------------------------

MAX_GRAIN_DISTANCE_M = 9.0  # largest distance of grain from the camera; it fades beyond half of it
MIN_SNOW_SHARE = 0.02  # least share of snow in a pixel with grain
NUM_GRAIN_OCTAVES = 3  # number of octaves
GRAIN_TABLE_SIDE = 64  # texels on a side of the noise's table, which is repeated
COARSEST_TEXEL_M = 0.013  # texel of the coarsest octave; features are five texels wide
TEXEL_RATIO = 0.42  # ratio of an octave's texel to that of the one before
# Half a feature's width in texels. An octave shows by this times texel over pixel, less 1: features
# of two pixels begin to show, those of four show fully.
VISIBILITY_RATIO = 2.5
# Cosine and sine of the turn about the vertical from one octave to the next.
TURN_COS = 0.8
TURN_SIN = 0.6
# Least sine of the angle between ray and level surface, for a pixel's size on it.
MIN_FALL_SINE = 0.05
MAX_GRAIN = 0.35  # largest change of brightness


class GrainView(NamedTuple):
    """View of a camera on grain, float64."""

    lens: np.ndarray  # fx, fy, cx, cy
    pose: np.ndarray  # [3, 4], world_from_camera
    sun: np.ndarray  # level unit vector towards the sun
    shift: np.ndarray  # [3], offset of the noise, metres
    # [K, 18], a row for each `relief.Carrier`: rotation by rows, translation, low, high.
    carriers: np.ndarray
    relief: float  # brightness per slope
    mottle: float  # brightness per noise
    extinction: float  # per metre


@kernel
def add_grain(rgb, depth, snow, hidden_mask, view, noise):
    """Add grain to the snow of rgb [H, W, 3], in place.

    hidden_mask: bool [H, W], pixels without grain, or [0, 0] for none. noise: cubic, flat, z first.
    """
    for i in prange(rgb.shape[0]):
        _grain_row(np.int64(i), rgb, depth, snow, hidden_mask, view, noise)


@kernel_function()
def _grain_row(i, rgb, depth, snow, hidden_mask, view, noise):
    """Add grain to one row of the image."""
    lens = view.lens
    pose = view.pose
    carriers = view.carriers
    ray_y = (i + 0.5 - lens[3]) / lens[1]
    for j in range(rgb.shape[1]):
        z = np.float64(depth[i, j])
        if not (snow[i, j] > MIN_SNOW_SHARE and z > 0.0 and z < MAX_GRAIN_DISTANCE_M):
            continue
        if hidden_mask.size > 0 and hidden_mask[i, j]:
            continue
        ray_x = (j + 0.5 - lens[2]) / lens[0]
        rx = ray_x * pose[0, 0] + ray_y * pose[0, 1] + pose[0, 2]
        ry = ray_x * pose[1, 0] + ray_y * pose[1, 1] + pose[1, 2]
        rz = ray_x * pose[2, 0] + ray_y * pose[2, 1] + pose[2, 2]
        length = math.sqrt(rx * rx + ry * ry + rz * rz)
        ray_distance = z * length
        fade = min(2.0 * (1.0 - ray_distance / MAX_GRAIN_DISTANCE_M), 1.0)
        if fade <= 0.0:
            continue
        x = z * rx + pose[0, 3]
        y = z * ry + pose[1, 3]
        height = z * rz + pose[2, 3]
        du = view.sun[0]
        dv = view.sun[1]
        for k in range(carriers.shape[0]):
            c = carriers[k]
            px = c[0] * x + c[1] * y + c[2] * height + c[9]
            py = c[3] * x + c[4] * y + c[5] * height + c[10]
            pz = c[6] * x + c[7] * y + c[8] * height + c[11]
            if c[12] <= px <= c[15] and c[13] <= py <= c[16] and c[14] <= pz <= c[17]:
                x = px
                y = py
                height = pz
                du, dv = c[0] * du + c[1] * dv, c[3] * du + c[4] * dv
                break
        pixel_m = _pixel_on_snow(i, j, depth, (rx, ry, rz), length, lens, pose)
        x = x + view.shift[0]
        y = y + view.shift[1]
        height = height + view.shift[2]
        brightness = _grain_at(x, y, height, du, dv, pixel_m, view.relief, view.mottle, noise)
        transmittance = math.exp(-view.extinction * ray_distance) if view.extinction > 0.0 else 1.0
        factor = np.float32(1.0 + fade * snow[i, j] * transmittance * brightness)
        for channel in range(3):
            rgb[i, j, channel] *= factor


@kernel_function()
def _larger_magnitude(a, b):
    """Return the number of larger magnitude."""
    return a if abs(a) > abs(b) else b


@kernel_function()
def _pixel_on_snow(i, j, depth, ray, length, lens, pose):
    """Return the size of a pixel on the surface, metres.

    It is that of level snow, or more where the change of depth to the neighbours shows that the
    surface is steeper along the ray, or ends.
    """
    z = np.float64(depth[i, j])
    change_x = _larger_magnitude(
        z - depth[i, max(j - 1, 0)], depth[i, min(j + 1, depth.shape[1] - 1)] - z
    )
    change_y = _larger_magnitude(
        z - depth[max(i - 1, 0), j], depth[min(i + 1, depth.shape[0] - 1), j] - z
    )
    width_m2 = height_m2 = 0.0
    for c in range(3):
        step = change_x * ray[c] + z / lens[0] * pose[c, 0]
        rise = change_y * ray[c] + z / lens[1] * pose[c, 1]
        width_m2 = width_m2 + step * step
        height_m2 = height_m2 + rise * rise
    fall_sine = max(abs(ray[2]) / length, MIN_FALL_SINE)
    level_m = z * length / lens[0]
    return max(math.sqrt(max(width_m2, height_m2 * fall_sine * fall_sine)), level_m) / math.sqrt(
        fall_sine
    )


@kernel_function()
def _grain_at(x, y, z, dx, dy, pixel_m, relief, mottle, noise):
    """Return the change of brightness at a point x, y, z (metres), for a pixel of a size in metres.

    (dx, dy): level direction to the sun. The noise and its rise along that direction are
    interpolated between the eight texels about the point.
    """
    side = GRAIN_TABLE_SIDE
    mask = GRAIN_TABLE_SIDE - 1
    brightness = 0.0
    texel = COARSEST_TEXEL_M
    for _ in range(NUM_GRAIN_OCTAVES):
        visible_share = min(VISIBILITY_RATIO * texel / pixel_m - 1.0, 1.0)
        if visible_share <= 0.0:
            break
        per_m = 1.0 / texel
        u = x * per_m
        v = y * per_m
        w = z * per_m
        i = math.floor(u)
        j = math.floor(v)
        k = math.floor(w)
        u = u - i
        v = v - j
        w = w - k
        # Unsigned and flat indices: signed ones would be checked for counting from the end.
        i0 = np.uint64(np.int64(i) & mask)
        i1 = np.uint64((np.int64(i) + 1) & mask)
        j0 = np.uint64(side * (np.int64(j) & mask))
        j1 = np.uint64(side * ((np.int64(j) + 1) & mask))
        k0 = np.uint64(side * side * (np.int64(k) & mask))
        k1 = np.uint64(side * side * ((np.int64(k) + 1) & mask))
        a = noise[k0 + j0 + i0] + w * (noise[k1 + j0 + i0] - noise[k0 + j0 + i0])
        b = noise[k0 + j0 + i1] + w * (noise[k1 + j0 + i1] - noise[k0 + j0 + i1])
        c = noise[k0 + j1 + i0] + w * (noise[k1 + j1 + i0] - noise[k0 + j1 + i0])
        d = noise[k0 + j1 + i1] + w * (noise[k1 + j1 + i1] - noise[k0 + j1 + i1])
        value = (a + u * (b - a)) * (1.0 - v) + (c + u * (d - c)) * v
        slope = ((b - a) * (1.0 - v) + (d - c) * v) * dx + ((c - a) * (1.0 - u) + (d - b) * u) * dy
        brightness += visible_share * (mottle * value - relief * slope)
        x, y = TURN_COS * x - TURN_SIN * y, TURN_SIN * x + TURN_COS * y
        dx, dy = TURN_COS * dx - TURN_SIN * dy, TURN_SIN * dx + TURN_COS * dy
        texel *= TEXEL_RATIO
    return min(max(brightness, -MAX_GRAIN), MAX_GRAIN)


# ---- The snow's depth, as `depth.define_depths` defines it ---------------------------------------

MIN_DEPTH_M = 0.002  # depth of snow below which a surface is bare
MIN_TRACK_DEPTH_M = 0.004  # least depth that wheels leave
TRACK_UNEVENNESS = 0.8  # unevenness of a track's sides per deviation of the mottling noise
WATER_MARGIN_M = 0.005  # height above the water that is bare
WATER_RIM_M = 0.02  # height above that over which snow thins out
# Noise that the foot of an obstacle adds to the patches, so that snow stays there.
OBSTACLE_SHELTER = 0.4
WINDWARD_GAIN = 0.8  # share of the depth that the wind adds before an obstacle
LEEWARD_LOSS = 0.4  # share of the depth that the wind takes behind an obstacle
# Most snow falls through foliage. The rest lies in flecks on about a third of it: where a noise of
# the two finest octaves of the patches exceeds a threshold.
FOLIAGE = int(SemanticClass.VEGETATION)
FOLIAGE_COARSE_WEIGHT = 0.6  # weight of the coarser octave
FOLIAGE_FINE_WEIGHT = 0.8  # weight of the finer octave
FOLIAGE_THRESHOLD = 0.42  # threshold of the noise
FOLIAGE_SHARE = 0.3  # depth on foliage over the depth on the ground
MAX_FOLIAGE_DEPTH_M = 0.04  # largest depth on foliage
# Largest logarithm of the drift: depths stay between 1/4 and 4 times the usual depth.
MAX_LOG_DRIFT = 1.4


@kernel_function()
def _corner_noise(column_bits, row_bits, seed, x, y):
    """Return the contribution of one lattice corner to gradient noise."""
    bits = mix((column_bits + row_bits) ^ seed)
    gx = np.float64(np.int64(bits >> _SHIFT_32)) * 2.0**-31 - 1.0
    gy = np.float64(np.int64(bits & _LOW_MASK)) * 2.0**-31 - 1.0
    return gx * x + gy * y


@kernel_function()
def _noise(u, v, seed):
    """Return gradient noise at lattice coordinates, as `gradient_noise` defines it."""
    column = math.floor(u)
    row = math.floor(v)
    x = u - column
    y = v - row
    fade_x = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    fade_y = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    column_bits = np.uint64(np.int64(column)) * _COLUMN_STEP
    row_bits = np.uint64(np.int64(row)) * _ROW_STEP
    lower = _corner_noise(column_bits, row_bits, seed, x, y)
    lower += fade_x * (
        _corner_noise(column_bits + _COLUMN_STEP, row_bits, seed, x - 1.0, y) - lower
    )
    upper = _corner_noise(column_bits, row_bits + _ROW_STEP, seed, x, y - 1.0)
    upper += fade_x * (
        _corner_noise(column_bits + _COLUMN_STEP, row_bits + _ROW_STEP, seed, x - 1.0, y - 1.0)
        - upper
    )
    return (lower + fade_y * (upper - lower)) / DEVIATION


@kernel_function()
def _octave_sum(x, y, size, turns, amplitudes, lengths, seeds):
    """Return the sum of octaves at a point, as `sum_octaves` of gradient_noise.py defines it."""
    total = 0.0
    for k in range(len(amplitudes)):
        visible_share = min(max(2.0 - 4.0 * size / lengths[k], 0.0), 1.0)
        if visible_share > 0.0:
            u = turns[k, 0, 0] * x + turns[k, 0, 1] * y
            v = turns[k, 1, 0] * x + turns[k, 1, 1] * y
            total += amplitudes[k] * visible_share * _noise(u, v, seeds[k])
    return total


@kernel_function()
def _is_fleck(x, y, turns, seeds):
    """Tell if snow lies on foliage at a point; the last two octaves of turns and seeds count."""
    total = 0.0
    for octave in range(2):
        k = len(seeds) - 2 + octave
        u = turns[k, 0, 0] * x + turns[k, 0, 1] * y
        v = turns[k, 1, 0] * x + turns[k, 1, 1] * y
        total += (FOLIAGE_FINE_WEIGHT if octave else FOLIAGE_COARSE_WEIGHT) * _noise(u, v, seeds[k])
    return total > FOLIAGE_THRESHOLD


@kernel_function()
def _pillow(t):
    """Quarter of a circle from (0, 0) up to (1, 1), then 1."""
    t = min(max(t, 0.0), 1.0)
    return math.sqrt(t * (2.0 - t))


@kernel
def find_depths(cells, settings, drifts, patches, mottling, seed, depths):
    """Compute the depth of snow, its colour's noise, and random bits of every cell, all [C].

    drifts, patches, mottling: octaves as (turns, amplitudes, lengths, seeds). random_bits: uint64
    that depend on the cell's place and the seed. The patches' noise is skipped where no snow is
    patchy.
    """
    centers = cells.centers
    sizes = cells.sizes
    edges = cells.edges
    tracks = cells.tracks
    banks = cells.banks
    semantic = cells.semantic
    depths_m = depths.depths_m
    mottle = depths.mottle
    random_bits = depths.random_bits
    is_everywhere = settings.threshold <= -1e9
    for i in prange(len(sizes)):
        x = np.float64(centers[i, 0])
        y = np.float64(centers[i, 1])
        size = np.float64(sizes[i])
        column = np.uint64(np.int64(math.floor(x / size))) * _COLUMN_STEP
        row = np.uint64(np.int64(math.floor(y / size))) * _ROW_STEP
        random_bits[i] = mix((column + row) ^ seed)
        depths_m[i] = mottle[i] = np.float32(0)
        above_water = np.float64(centers[i, 2]) - settings.floor_z_m
        over_threshold = 1e9
        if not is_everywhere:
            bank_x = np.float64(banks[i, 0])
            bank_y = np.float64(banks[i, 1])
            over_threshold = _octave_sum(x, y, 0.0, patches[0], patches[1], patches[2], patches[3])
            over_threshold += (
                OBSTACLE_SHELTER * math.sqrt(bank_x * bank_x + bank_y * bank_y) - settings.threshold
            )
        if semantic[i] == FOLIAGE and not _is_fleck(x, y, patches[0], patches[3]):
            continue
        if not (above_water > 0.0 and over_threshold > 0.0):
            continue
        bank_along_wind = banks[i, 0] * settings.wind_x + banks[i, 1] * settings.wind_y
        pile_factor = (
            1.0
            + settings.drift
            * (WINDWARD_GAIN if bank_along_wind > 0.0 else LEEWARD_LOSS)
            * bank_along_wind
        )
        drift = _octave_sum(x, y, size, drifts[0], drifts[1], drifts[2], drifts[3])
        drift = math.exp(min(max(drift, -MAX_LOG_DRIFT), MAX_LOG_DRIFT)) * pile_factor
        full_depth_m = settings.depth_m * drift * _pillow(edges[i] / settings.radius_m)
        if semantic[i] == FOLIAGE:
            full_depth_m = min(FOLIAGE_SHARE * full_depth_m, MAX_FOLIAGE_DEPTH_M)
        depth_m = MIN_DEPTH_M + max(full_depth_m - MIN_DEPTH_M, 0.0) * min(
            over_threshold / settings.rim, 1.0
        )
        mottle_noise = _octave_sum(x, y, size, mottling[0], mottling[1], mottling[2], mottling[3])
        track = np.float64(tracks[i])
        track += TRACK_UNEVENNESS * mottle_noise * track * (1.0 - track)
        track = min(max(track, 0.0), 1.0)
        depth_m = max(depth_m * (1.0 - settings.pressed * track), min(depth_m, MIN_TRACK_DEPTH_M))
        depth_m = MIN_DEPTH_M + (depth_m - MIN_DEPTH_M) * min(above_water / WATER_RIM_M, 1.0)
        depths_m[i] = np.float32(depth_m)
        mottle[i] = np.float32(mottle_noise)


# ---- Where a LiDAR's beams meet a layer of snow on a grid ----------------------------------------
# These kernels run on the calling thread alone, without the GIL: sweeps are weathered beside the
# renderer.

# Cells on a side of a block; nothing in a block is higher than its entry in `highest`.
BLOCK = 16
_MIN_BEAM_M = 0.3  # distance from the sensor within which nothing is met
_STEP_M = 1e-7  # step beyond a border, so that a beam on it goes on


@serial_kernel
def intersect_layer(
    origins, directions, hits, part_from_world, circle, corner, cell, base, top, highest, slack
):
    """Shorten `hits` [N], the beams' lengths, to where they first meet the layer, in place.

    A beam meets the layer from above or from a side, never from below.

    Args:
        origins: float64 [N, 3], world.
        directions: float64 [N, 3], unit, world.
        hits: float64 [N], written.
        part_from_world: [3, 4].
        circle: x, y, radius (world) of a circle that holds the part.
        corner: least x and y of the grid, in the part's frame.
        cell: side of the grid's cells, metres.
        base: float32 [H, W], underside of the layer, -inf where there is none.
        top: float32 [H, W], surface of the layer, -inf where there is none.
        highest: [h, w], largest `top` in each block of BLOCK cells a side.
        slack: depth below its underside at which the layer still counts, for uneven ground.
    """
    rows, columns = base.shape
    for i in range(len(hits)):
        end = hits[i]
        if not end > _MIN_BEAM_M:
            continue
        if not _enters_circle(origins[i], directions[i], end, circle):
            continue
        ox = oy = oz = dx = dy = dz = 0.0
        for k in range(3):
            o = origins[i, k]
            d = directions[i, k]
            ox += part_from_world[0, k] * o
            oy += part_from_world[1, k] * o
            oz += part_from_world[2, k] * o
            dx += part_from_world[0, k] * d
            dy += part_from_world[1, k] * d
            dz += part_from_world[2, k] * d
        ox = (ox + part_from_world[0, 3] - corner[0]) / cell
        oy = (oy + part_from_world[1, 3] - corner[1]) / cell
        oz += part_from_world[2, 3]
        dx = dx / cell
        dy = dy / cell
        entry, last = _clip_beam(ox, dx, float(columns), _MIN_BEAM_M, end)
        entry, last = _clip_beam(oy, dy, float(rows), entry, last)
        inverse_dx = 1.0 / dx if dx != 0.0 else np.inf
        inverse_dy = 1.0 / dy if dy != 0.0 else np.inf
        t = entry
        is_met = False
        while t < last and not is_met:
            # The cell ahead: a step inside, so that a beam on a border goes on.
            ahead = t + _STEP_M
            column = min(max(math.floor(ox + ahead * dx), 0), columns - 1)
            row = min(max(math.floor(oy + ahead * dy), 0), rows - 1)
            block_column = column // BLOCK
            block_row = row // BLOCK
            block_exit = min(
                _exit_distance(ox, inverse_dx, block_column * BLOCK, BLOCK),
                _exit_distance(oy, inverse_dy, block_row * BLOCK, BLOCK),
                last,
            )
            block_exit = max(block_exit, ahead)
            ceiling = highest[block_row, block_column]
            if min(oz + t * dz, oz + block_exit * dz) > ceiling:
                t = block_exit
                continue
            if oz + t * dz > ceiling:  # a falling beam meets nothing above the ceiling
                t = max(t, min((ceiling - oz) / dz, block_exit))
            while t < block_exit:
                ahead = t + _STEP_M
                column = min(max(math.floor(ox + ahead * dx), 0), columns - 1)
                row = min(max(math.floor(oy + ahead * dy), 0), rows - 1)
                cell_exit = min(
                    _exit_distance(ox, inverse_dx, column, 1),
                    _exit_distance(oy, inverse_dy, row, 1),
                    block_exit,
                )
                cell_exit = max(cell_exit, ahead)
                z = oz + t * dz
                surface = top[row, column]
                if z <= surface:
                    is_met = z >= base[row, column] - slack
                elif oz + cell_exit * dz < surface:
                    t = max(t, min((surface - oz) / dz, cell_exit))
                    is_met = True
                if is_met:
                    hits[i] = min(t, end)
                    break
                t = cell_exit


@kernel_function()
def _enters_circle(origin, direction, end, circle):
    """Tell if a beam, seen from above, comes within a circle."""
    if circle[2] == np.inf:
        return True
    x = circle[0] - origin[0]
    y = circle[1] - origin[1]
    level_square = direction[0] * direction[0] + direction[1] * direction[1]
    t = 0.0
    if level_square > 0:
        t = min(max((x * direction[0] + y * direction[1]) / level_square, 0.0), end)
    x = x - t * direction[0]
    y = y - t * direction[1]
    return x * x + y * y <= circle[2] * circle[2]


@kernel_function()
def _clip_beam(o, d, size, first, last):
    """Return the part of a beam from first to last that lies between 0 and size along an axis."""
    if d == 0.0:
        return (first, last) if 0.0 <= o < size else (1.0, 0.0)
    a = -o / d
    b = (size - o) / d
    return max(first, min(a, b)), min(last, max(a, b))


@kernel_function()
def _exit_distance(o, inverse_d, low, size):
    """Return where a beam leaves the stretch from low to low + size along an axis."""
    if inverse_d == np.inf:
        return np.inf
    return ((low + size if inverse_d > 0.0 else low) - o) * inverse_d


@serial_kernel
def fill_layer(centers, sizes, depths, corner, cell, base, top):
    """Enter snow on square cells [C] into a grid; the highest counts where several cells meet.

    centers [C, 3], sizes [C]: see ExposedCells. depths [C]: 0 is no snow. base, top: float32 [H,
    W], -inf before the call.
    """
    rows, columns = base.shape
    for i in range(len(depths)):
        if not depths[i] > 0:
            continue
        half = 0.5 * np.float64(sizes[i]) - 1e-4
        x = np.float64(centers[i, 0]) - corner[0]
        y = np.float64(centers[i, 1]) - corner[1]
        z = centers[i, 2]
        surface = z + depths[i]
        # A cell finer than the grid's counts where its middle is.
        half = half if 2 * half > cell else 0.0
        left = max(math.floor((x - half) / cell), 0)
        right = min(math.floor((x + half) / cell), columns - 1)
        low = max(math.floor((y - half) / cell), 0)
        high = min(math.floor((y + half) / cell), rows - 1)
        for row in range(low, high + 1):
            for column in range(left, right + 1):
                if surface > top[row, column]:
                    base[row, column] = z
                    top[row, column] = surface
