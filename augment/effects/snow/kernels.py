"""Numba kernels that turn depths of snow on cells into Gaussians; `augment.effects.snow.layer`
launches.

Every covered cell gets a disc on the snow's surface. Where the surface drops by more than a disc
can lean, over the cell's border, upright discs close the wall below it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.effects.snow.cells import OPEN_EDGE
from augment.kernels import mix
from augment.render.cpu.jit import inner, kernel, serial_kernel
from augment.render.sh import SH_C0
from augment.rng import STEP_X, STEP_Y
from augment.semantics import SemanticClass

# ---- Noise ---------------------------------------------------------------------------------------

# Standard deviation of the noise over the plane where the gradients' components are uniform in
# [-1, 1]: the mean over a square of 4 w^2 (x^2 + y^2) / 3, w the blend of a corner at (0, 0).
DEVIATION = 0.17612713
_X, _Y = np.uint64(STEP_X), np.uint64(STEP_Y)
_LOW, _UNIT = np.uint64(0xFFFFFFFF), 2.0**-53
_S11, _S32 = np.uint64(11), np.uint64(32)


@inner()
def _uniform(bits, number):
    """The number-th random number of these bits, in [-1, 1)."""
    bits = mix(bits + np.uint64(number + 1) * _X)
    return np.float64(np.int64(bits >> _S11)) * _UNIT * 2.0 - 1.0


# ---- Discs of snow on cells ----------------------------------------------------------------------

MAX_WALLS = 8  # discs one above the other that close a wall
LEAN = 1.5  # steepest slope that a cell's own disc follows
SETTLED = 0.5  # of the depth: by this much at most does snow even out what lies beneath it
SPREAD = 0.78  # standard deviation of a disc, in cells
STEEP_SPREAD = 0.64  # of one on a slope of 45 degrees, which is stretched as well
RIM_SPREAD = 0.58  # of one beside what is bare, so that the snow's edge is sharp
RIM_STRETCH = 1.2  # most that such a disc is stretched down a slope
DRAWN_IN = 0.2  # by how much of a cell it keeps away from what is bare
SHIFT = 0.2  # farthest that a disc is moved from its cell's middle, in cells
THICK = 0.2  # most that a disc's thickness measures, in cells
WALL_SPREAD = 0.7  # of a wall's discs upwards, in heights of one
WALL_LIFT = 0.25  # by which its lowest keeps clear of the wall's foot, in heights of one
INSET = 0.12  # by which a wall stands behind the cell's border, in cells
SUNK = 0.5  # by which a disc's middle lies below the surface, in its thickness
ROUGH, ROUGH_GRAIN = 0.03, 0.15  # tilt of a disc's normal for its light, and more with grain
PALE, PALE_GRAIN = 0.01, 0.035  # of its brightness
MOTTLED = 0.010  # of the brightness per deviation of the mottling noise
SHADED_HOLLOW, MAX_BEND = 0.9, 0.12  # a hollow's loss of brightness per bend, and most bend
THIN_M, THIN_LOSS = 0.005, 0.42  # depth through which the ground darkens snow, and how much
PACKED_SHARE = 0.6  # brightness of packed snow, of fresh snow's
DARKEST, BRIGHTEST = 0.35, 0.8  # light on the bare surface where the sun is out of sight, and full


@kernel
def relax_heights(neighbours, z, settled_z):
    """One step of evening out the surface beneath the snow, all [C].

    Towards the mean of opposite neighbours: slopes stay as they are. Whatever snow lies there, or
    deeper snow would stand lower where it evens out more.
    """
    for i in prange(len(z)):
        dz = 0.0
        for axis in range(2):
            a, b = neighbours[i, 2 * axis], neighbours[i, 2 * axis + 1]
            if a >= 0 and b >= 0:
                dz += 0.5 * (np.float64(z[a]) + z[b]) - z[i]
        settled_z[i] = np.float32(z[i] + 0.25 * dz)


@kernel
def soften(neighbours, heights, light, softened):
    """One step of evening out the light on the snow, as `settle` does, where both carry snow."""
    for i in prange(len(heights)):
        dl = 0.0
        if heights[i] > 0:
            for axis in range(2):
                a, b = neighbours[i, 2 * axis], neighbours[i, 2 * axis + 1]
                if a >= 0 and b >= 0 and heights[a] > 0 and heights[b] > 0:
                    dl += 0.5 * (np.float64(light[a]) + light[b]) - light[i]
        softened[i] = np.float32(light[i] + 0.25 * dl)


@kernel
def find_tops(centers, heights, settled_z, tops):
    """Height of the surface, snow included, of every cell, float64 [C]."""
    for i in prange(len(heights)):
        h, z = np.float64(heights[i]), np.float64(centers[i, 2])
        eased = min(max(np.float64(settled_z[i]) - z, -SETTLED * h), SETTLED * h)
        tops[i] = z + h + (eased if h > 0 else 0.0)


@inner()
def _beyond(i, side, neighbours, size, centers, tops):
    """Height of the surface on one side of a covered cell, and the level distance to there.

    Half a cell where the layer ends: at an open edge, and above what even the neighbour's snow does
    not reach up from. 0 where it ends against something higher.
    """
    n, z = neighbours[i, side], np.float64(centers[i, 2])
    if n < 0:
        return z, (0.5 * size if n == OPEN_EDGE else 0.0)
    if tops[n] < z - LEAN * size:
        return z, 0.5 * size
    if centers[n, 2] > tops[i] + LEAN * size:
        return z, 0.0
    return tops[n], size


@inner()
def _walls(i, side, neighbours, sizes, centers, tops):
    """Discs that close the wall on one side of a covered cell, and how far down it reaches."""
    size = np.float64(sizes[i])
    low, run = _beyond(i, side, neighbours, size, centers, tops)
    drop = tops[i] - low
    if run == 0.0 or drop <= LEAN * size:
        return 0, drop
    return min(math.ceil(drop / size), MAX_WALLS), drop


@kernel
def count_splats(neighbours, sizes, centers, heights, tops, counts):
    """Gaussians that each cell's snow is made of, [C]."""
    for i in prange(len(heights)):
        count = 0
        if heights[i] > 0:
            count = 1
            for side in range(4):
                count += _walls(i, side, neighbours, sizes, centers, tops)[0]
        counts[i] = count


@inner()
def _slope(i, axis, neighbours, size, ground_slope, centers, tops):
    """Rise of the surface per metre along x (axis 0) or y (1)."""
    before, run_before = _beyond(i, 2 * axis, neighbours, size, centers, tops)
    after, run_after = _beyond(i, 2 * axis + 1, neighbours, size, centers, tops)
    if run_before < size:  # the support's own height where the layer ends, not its middle's
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


@inner()
def _hollow(i, neighbours, size, tops):
    """How much the surface bends upwards around a cell, 0 where level: slope over a cell."""
    bend, count = 0.0, 0
    for side in range(4):
        n = neighbours[i, side]
        if n >= 0:
            bend += tops[n] - tops[i]
            count += 1
    return bend / size if count == 4 else 0.0


@inner()
def _inwards(i, axis, neighbours, heights):
    """-1, 0 or 1 along x (axis 0) or y (1), away from what is bare; 2 if both sides are."""
    a, b = neighbours[i, 2 * axis], neighbours[i, 2 * axis + 1]
    before = a == OPEN_EDGE or (a >= 0 and heights[a] == 0)
    after = b == OPEN_EDGE or (b >= 0 and heights[b] == 0)
    if before and after:
        return 2
    return 1 if before else (-1 if after else 0)


@inner()
def _turn(nx, ny, nz, s, quats):
    """wxyz that turns z to the unit normal (nz >= 0) and x to the fall line."""
    level = math.sqrt(nx * nx + ny * ny)
    cos = nx / level if level > 1e-9 else 1.0
    half_cos = math.sqrt(max(0.5 * (1.0 + cos), 0.0))
    half_sin = math.copysign(math.sqrt(max(0.5 * (1.0 - cos), 0.0)), ny)
    tilt_cos = math.sqrt(max(0.5 * (1.0 + nz), 0.0))
    tilt_sin = math.sqrt(max(0.5 * (1.0 - nz), 0.0))
    quats[s, 0] = half_cos * tilt_cos
    quats[s, 1] = -half_sin * tilt_sin
    quats[s, 2] = half_cos * tilt_sin
    quats[s, 3] = half_sin * tilt_cos


# Kernels read the records' fields one by one: numba 0.6x takes an unpacked record for a shape.


class Cells(NamedTuple):
    """The arrays of SnowCells that snow is made from."""

    centers: np.ndarray
    normals: np.ndarray
    sizes: np.ndarray
    edges: np.ndarray
    neighbours: np.ndarray
    light: np.ndarray
    tracks: np.ndarray
    banks: np.ndarray
    semantic: np.ndarray


class Depths(NamedTuple):
    """Of the snow on C cells: its depth in metres, 0 where there is none; noise that its colour
    follows; uint64 to draw grain from.
    """

    heights: np.ndarray
    mottle: np.ndarray
    draws: np.ndarray


class Splats(NamedTuple):
    """The arrays of S Gaussians. normals, slopes: [S, 3], or empty where they are not asked for."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    sh: np.ndarray
    normals: np.ndarray
    slopes: np.ndarray


@inner()
def _shade(s, normal, tints, packed, seen, lights, colors, sh, normals, slopes):
    """Colour of Gaussian s: by its normal, or what the light's share is added to.

    tints: of red, green and blue. packed: 0 to 1, darker. seen: share of the sun.
    """
    share = normal[0] * lights[0, 0] + normal[1] * lights[0, 1] + normal[2] * lights[0, 2]
    share = min(max((share + colors.wrap) / (1.0 + colors.wrap), 0.0), 1.0)
    # Packed snow gives back less of every colour alike: what is grey has the tint of the light.
    left = 1.0 - packed * (1.0 - PACKED_SHARE)
    for c in range(3):
        shadow = tints[c] * left * lights[2, c]
        rise = tints[c] * left * (lights[1, c] - lights[2, c]) * seen
        baked = share if colors.is_baked else 0.0
        sh[s, 0, c] = np.float32((shadow + rise * baked - 0.5) / SH_C0)
        if len(slopes) > 0:
            slopes[s, c] = np.float32(rise)
        if len(normals) > 0:
            normals[s, c] = np.float32(normal[c])


@inner()
def _rough(normal, amount, draw, number):
    """The normal, tilted at random by about `amount` radians."""
    x = normal[0] + amount * _uniform(draw, number)
    y = normal[1] + amount * _uniform(draw, number + 1)
    z = normal[2] + amount * _uniform(draw, number + 2)
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@kernel
def fill(cells, depths, tops, firsts, lights, colors, splats):
    """The Gaussians of every covered cell, from index firsts[i] on.

    lights [3, 3]: direction of the sun, colours of lit and of shaded snow. splats: written.
    """
    for i in prange(len(depths.heights)):
        # A function of its own: numba compiles what stands in a parallel loop many times over.
        _fill_cell(np.int64(i), cells, depths, tops, firsts, lights, colors, splats)


@inner()
def _fill_cell(i, cells, depths, tops, firsts, lights, colors, splats):
    centers, ground_normals, sizes = cells.centers, cells.normals, cells.sizes
    neighbours, tracks, light = cells.neighbours, cells.tracks, cells.light
    heights, mottle, draws = depths.heights, depths.mottle, depths.draws
    means, quats, scales = splats.means, splats.quats, splats.scales
    sh, normals, slopes = splats.sh, splats.normals, splats.slopes
    if heights[i] == 0:
        return
    size, draw, h = np.float64(sizes[i]), draws[i], np.float64(heights[i])
    x, y = np.float64(centers[i, 0]), np.float64(centers[i, 1])
    up = np.float64(ground_normals[i, 2])
    gx = _slope(i, 0, neighbours, size, -ground_normals[i, 0] / up, centers, tops)
    gy = _slope(i, 1, neighbours, size, -ground_normals[i, 1] / up, centers, tops)
    steep = math.sqrt(gx * gx + gy * gy)
    if steep > LEAN:
        gx, gy, steep = gx * LEAN / steep, gy * LEAN / steep, LEAN
    stretch = math.sqrt(1.0 + steep * steep)
    normal = (-gx / stretch, -gy / stretch, 1.0 / stretch)

    in_x, in_y = _inwards(i, 0, neighbours, heights), _inwards(i, 1, neighbours, heights)
    at_rim = in_x != 0 or in_y != 0
    spread = RIM_SPREAD if at_rim else SPREAD + (STEEP_SPREAD - SPREAD) * min(steep, 1.0)
    spread *= size
    spread *= 1.0 + 0.2 * colors.grain * abs(_uniform(draw, 0))
    # On steep sides discs are long, and scattered ones would colors like fur.
    shift = (0.5 if at_rim else max(1.0 - 1.2 * steep, 0.1)) * SHIFT * size
    dx, dy = shift * _uniform(draw, 1), shift * _uniform(draw, 2)
    dx += DRAWN_IN * size * in_x if in_x < 2 else 0.0
    dy += DRAWN_IN * size * in_y if in_y < 2 else 0.0
    thick = min(THICK * size, 0.006 + 0.25 * h)
    s = firsts[i]
    means[s, 0] = np.float32(x + dx)
    means[s, 1] = np.float32(y + dy)
    means[s, 2] = np.float32(tops[i] + gx * dx + gy * dy - SUNK * thick)
    _turn(normal[0], normal[1], normal[2], s, quats)
    longer = min(stretch, RIM_STRETCH) if at_rim else stretch
    scales[s, 0], scales[s, 1], scales[s, 2] = spread * longer, spread, thick

    bend = min(max(_hollow(i, neighbours, size, tops), -MAX_BEND), MAX_BEND)
    pale = 1.0 + (PALE + PALE_GRAIN * colors.grain) * _uniform(draw, 3) + MOTTLED * mottle[i]
    pale *= 1.0 - THIN_LOSS * math.exp(-h / THIN_M)
    loss = SHADED_HOLLOW * bend
    tints = (pale * (1.0 - loss), pale * (1.0 - 0.8 * loss), pale * (1.0 - 0.55 * loss))
    dirt = min(max(0.8 + 0.2 * mottle[i] + 0.15 * _uniform(draw, 4), 0.3), 1.0)
    packed = colors.packed * tracks[i] * tracks[i] * dirt
    seen = min(max((light[i] - DARKEST) / (BRIGHTEST - DARKEST), 0.0), 1.0)
    seen = seen * seen * (3.0 - 2.0 * seen)
    rough = (ROUGH + ROUGH_GRAIN * colors.grain) / stretch
    facing = _rough(normal, rough, draw, 5)
    _shade(s, facing, tints, packed, seen, lights, colors, sh, normals, slopes)

    for side in range(4):
        count, drop = _walls(i, side, neighbours, sizes, centers, tops)
        out_x = (1.0 if side == 1 else -1.0) if side < 2 else 0.0
        out_y = (1.0 if side == 3 else -1.0) if side >= 2 else 0.0
        for k in range(count):
            s += 1
            means[s, 0] = np.float32(x + (0.5 - INSET) * size * out_x)
            means[s, 1] = np.float32(y + (0.5 - INSET) * size * out_y)
            step = drop / (count + WALL_LIFT)
            means[s, 2] = np.float32(tops[i] - step * (k + 0.5))
            normal = (0.96 * out_x, 0.96 * out_y, 0.28)
            _turn(normal[0], normal[1], normal[2], s, quats)
            scales[s, 0], scales[s, 1] = WALL_SPREAD * step, SPREAD * size
            scales[s, 2] = thick
            normal = (0.8 * out_x, 0.8 * out_y, 0.6)  # of a rounded side, for its light
            facing = _rough(normal, rough, draw, 8 + 12 * side + 3 * (k % 4))
            _shade(s, facing, tints, packed, seen, lights, colors, sh, normals, slopes)


@kernel
def bury(buried, buried_by, heights, opacities):
    """Opacity 0 for every Gaussian buried[b] whose cells buried_by[b] all carry snow."""
    for b in prange(len(buried)):
        hidden = True
        for k in range(buried_by.shape[1]):
            n = buried_by[b, k]
            hidden &= n >= 0 and heights[n] > 0
        if hidden:
            opacities[buried[b]] = 0


# ---- Grain of near snow, as `relief.add_grain` defines it ----------------------------------------

FARTHEST_M = 9.0  # from the camera; beyond half of it grain fades
MIN_SNOW = 0.02  # share of a pixel
GRAINS = 3  # octaves
GRAIN_SIDE = 64  # texels a side of the noise, repeated
COARSEST_TEXEL_M, FINER = 0.013, 0.42  # of the noise's table, whose features are five texels wide
SHOWN_AT = 2.5  # half of that: features of two pixels begin to show, those of four do
TURN_COS, TURN_SIN = 0.8, 0.6  # about the vertical, from one octave to the next
MIN_FALL = 0.05  # sine of the angle that a level surface is seen at, for a pixel's size on it
MOST_GRAIN = 0.35  # of the brightness


class GrainView(NamedTuple):
    """What grain is seen by, float64. lens: fx, fy, cx, cy. pose [3, 4]: world_from_camera. sun:
    level unit vector towards it. shift [3]: of the noise, metres. carriers [K, 18]: those of
    `relief.Carrier`, rotation by rows, translation, low, high. relief: brightness per slope;
    mottle: per noise. extinction: per metre.
    """

    lens: np.ndarray
    pose: np.ndarray
    sun: np.ndarray
    shift: np.ndarray
    carriers: np.ndarray
    relief: float
    mottle: float
    extinction: float


@kernel
def add_grain(rgb, depth, snow, hidden, view, noise):
    """Grain on the snow of rgb [H, W, 3], in place; hidden: bool [H, W], or [0, 0] for nowhere.
    noise: cubic, flattened, z first.
    """
    for i in prange(rgb.shape[0]):
        _grain_row(np.int64(i), rgb, depth, snow, hidden, view, noise)


@inner()
def _grain_row(i, rgb, depth, snow, hidden, view, noise):
    lens, pose, carriers = view.lens, view.pose, view.carriers
    down = (i + 0.5 - lens[3]) / lens[1]
    for j in range(rgb.shape[1]):
        z = np.float64(depth[i, j])
        if not (snow[i, j] > MIN_SNOW and z > 0.0 and z < FARTHEST_M):
            continue
        if hidden.size > 0 and hidden[i, j]:
            continue
        across = (j + 0.5 - lens[2]) / lens[0]
        rx = across * pose[0, 0] + down * pose[0, 1] + pose[0, 2]
        ry = across * pose[1, 0] + down * pose[1, 1] + pose[1, 2]
        rz = across * pose[2, 0] + down * pose[2, 1] + pose[2, 2]
        length = math.sqrt(rx * rx + ry * ry + rz * rz)
        far = z * length
        fade = min(2.0 * (1.0 - far / FARTHEST_M), 1.0)
        if fade <= 0.0:
            continue
        x, y, height = z * rx + pose[0, 3], z * ry + pose[1, 3], z * rz + pose[2, 3]
        du, dv = view.sun[0], view.sun[1]
        for k in range(carriers.shape[0]):
            c = carriers[k]
            px = c[0] * x + c[1] * y + c[2] * height + c[9]
            py = c[3] * x + c[4] * y + c[5] * height + c[10]
            pz = c[6] * x + c[7] * y + c[8] * height + c[11]
            if c[12] <= px <= c[15] and c[13] <= py <= c[16] and c[14] <= pz <= c[17]:
                x, y, height = px, py, pz
                du, dv = c[0] * du + c[1] * dv, c[3] * du + c[4] * dv
                break
        pixel_m = _pixel_on_snow(i, j, depth, (rx, ry, rz), length, lens, pose)
        x, y, height = x + view.shift[0], y + view.shift[1], height + view.shift[2]
        bright = _grain_at(x, y, height, du, dv, pixel_m, view.relief, view.mottle, noise)
        clear = math.exp(-view.extinction * far) if view.extinction > 0.0 else 1.0
        factor = np.float32(1.0 + fade * snow[i, j] * clear * bright)
        for channel in range(3):
            rgb[i, j, channel] *= factor


@inner()
def _larger(a, b):
    return a if abs(a) > abs(b) else b


@inner()
def _pixel_on_snow(i, j, depth, ray, length, lens, pose):
    """Size of a pixel on the surface, metres: that of level snow, or more where the depth's change
    to the neighbours shows that the surface is steeper along the ray, or ends.
    """
    z = np.float64(depth[i, j])
    across = _larger(z - depth[i, max(j - 1, 0)], depth[i, min(j + 1, depth.shape[1] - 1)] - z)
    down = _larger(z - depth[max(i - 1, 0), j], depth[min(i + 1, depth.shape[0] - 1), j] - z)
    wide = high = 0.0
    for c in range(3):
        step, rise = (
            across * ray[c] + z / lens[0] * pose[c, 0],
            down * ray[c] + z / lens[1] * pose[c, 1],
        )
        wide, high = wide + step * step, high + rise * rise
    fall, level = max(abs(ray[2]) / length, MIN_FALL), z * length / lens[0]
    return max(math.sqrt(max(wide, high * fall * fall)), level) / math.sqrt(fall)


@inner()
def _grain_at(x, y, z, dx, dy, pixel_m, relief, mottle, noise):
    """Change of brightness at a place, metres, of a pixel's size; (dx, dy): level, to the sun.

    The noise and its rise along that way are interpolated between the eight texels about the place.
    """
    side, mask, bright, texel = GRAIN_SIDE, GRAIN_SIDE - 1, 0.0, COARSEST_TEXEL_M
    for _ in range(GRAINS):
        shown = min(SHOWN_AT * texel / pixel_m - 1.0, 1.0)
        if shown <= 0.0:
            break
        per_m = 1.0 / texel
        u, v, w = x * per_m, y * per_m, z * per_m
        i, j, k = math.floor(u), math.floor(v), math.floor(w)
        u, v, w = u - i, v - j, w - k
        # Unsigned and in one dimension: else every look asks whether it counts from the end.
        i0, i1 = np.uint64(np.int64(i) & mask), np.uint64((np.int64(i) + 1) & mask)
        j0, j1 = (
            np.uint64(side * (np.int64(j) & mask)),
            np.uint64(side * ((np.int64(j) + 1) & mask)),
        )
        k0 = np.uint64(side * side * (np.int64(k) & mask))
        k1 = np.uint64(side * side * ((np.int64(k) + 1) & mask))
        a = noise[k0 + j0 + i0] + w * (noise[k1 + j0 + i0] - noise[k0 + j0 + i0])
        b = noise[k0 + j0 + i1] + w * (noise[k1 + j0 + i1] - noise[k0 + j0 + i1])
        c = noise[k0 + j1 + i0] + w * (noise[k1 + j1 + i0] - noise[k0 + j1 + i0])
        d = noise[k0 + j1 + i1] + w * (noise[k1 + j1 + i1] - noise[k0 + j1 + i1])
        value = (a + u * (b - a)) * (1.0 - v) + (c + u * (d - c)) * v
        along = ((b - a) * (1.0 - v) + (d - c) * v) * dx + ((c - a) * (1.0 - u) + (d - b) * u) * dy
        bright += shown * (mottle * value - relief * along)
        x, y = TURN_COS * x - TURN_SIN * y, TURN_SIN * x + TURN_COS * y
        dx, dy = TURN_COS * dx - TURN_SIN * dy, TURN_SIN * dx + TURN_COS * dy
        texel *= FINER
    return min(max(bright, -MOST_GRAIN), MOST_GRAIN)


# ---- The snow's depth, as `layer.heights_of` defines it ------------------------------------------

BARE_M = 0.002  # less snow than this is none
FILM_M = 0.004  # what wheels leave at least
CRUMBLED = 0.8  # of the mottling noise, by which a track's sides are uneven
WATER_MARGIN_M, WATER_RIM_M = 0.005, 0.02  # bare above the water, and thinner above that
SHELTER = 0.4  # what the foot of an obstacle adds to the noise of the patches, which it keeps
PILED, SCOURED = 0.8, 0.4  # by wind that blows at an obstacle, and off one
# Through foliage most snow falls: what is left lies where this noise exceeds a threshold, which is
# about a third of it, in flecks that the two finest octaves of the patches make.
FOLIAGE = int(SemanticClass.VEGETATION)
FOLIAGE_COARSE, FOLIAGE_FINE, FOLIAGE_ABOVE = 0.6, 0.8, 0.42
FOLIAGE_SHARE, FOLIAGE_MOST_M = 0.3, 0.04  # of the depth, and most of it
STEEPEST = 1.4  # of the logarithm of the drift: within four times the depth, or a quarter of it


@inner()
def _corner(across, down, seed, x, y):
    bits = mix((across + down) ^ seed)
    gx = np.float64(np.int64(bits >> _S32)) * 2.0**-31 - 1.0
    gy = np.float64(np.int64(bits & _LOW)) * 2.0**-31 - 1.0
    return gx * x + gy * y


@inner()
def _noise(u, v, seed):
    column, row = math.floor(u), math.floor(v)
    x, y = u - column, v - row
    fade_x = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    fade_y = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    across, down = np.uint64(np.int64(column)) * _X, np.uint64(np.int64(row)) * _Y
    near = _corner(across, down, seed, x, y)
    near += fade_x * (_corner(across + _X, down, seed, x - 1.0, y) - near)
    far = _corner(across, down + _Y, seed, x, y - 1.0)
    far += fade_x * (_corner(across + _X, down + _Y, seed, x - 1.0, y - 1.0) - far)
    return (near + fade_y * (far - near)) / DEVIATION


@inner()
def _field(x, y, size, turns, amplitudes, lengths, seeds):
    total = 0.0
    for k in range(len(amplitudes)):
        shown = min(max(2.0 - 4.0 * size / lengths[k], 0.0), 1.0)
        if shown > 0.0:
            u = turns[k, 0, 0] * x + turns[k, 0, 1] * y
            v = turns[k, 1, 0] * x + turns[k, 1, 1] * y
            total += amplitudes[k] * shown * _noise(u, v, seeds[k])
    return total


@inner()
def _is_fleck(x, y, turns, seeds):
    """Whether snow lies on foliage at a place; turns, seeds: of octaves, the last two count."""
    total = 0.0
    for back in range(2):
        k = len(seeds) - 2 + back
        u, v = turns[k, 0, 0] * x + turns[k, 0, 1] * y, turns[k, 1, 0] * x + turns[k, 1, 1] * y
        total += (FOLIAGE_FINE if back else FOLIAGE_COARSE) * _noise(u, v, seeds[k])
    return total > FOLIAGE_ABOVE


@inner()
def _pillow(t):
    t = min(max(t, 0.0), 1.0)
    return math.sqrt(t * (2.0 - t))


@kernel
def lay(cells, numbers, drifts, patches, mottling, seed, depths):
    """Depth of the snow, what mottles its colour, and random bits, all [C], of every cell.

    drifts, patches, mottling: octaves as (turns, amplitudes, lengths, seeds). draws: uint64 that
    hang on the cell's place and the seed. Where nothing of the layer is patchy, the patches' noise
    is not worked out.
    """
    centers, sizes, edges = cells.centers, cells.sizes, cells.edges
    tracks, banks, semantic = cells.tracks, cells.banks, cells.semantic
    heights, mottle, draws = depths.heights, depths.mottle, depths.draws
    everywhere = numbers.threshold <= -1e9
    for i in prange(len(sizes)):
        x, y = np.float64(centers[i, 0]), np.float64(centers[i, 1])
        size = np.float64(sizes[i])
        column = np.uint64(np.int64(math.floor(x / size))) * _X
        row = np.uint64(np.int64(math.floor(y / size))) * _Y
        draws[i] = mix((column + row) ^ seed)
        heights[i] = mottle[i] = np.float32(0)
        room = np.float64(centers[i, 2]) - numbers.floor_z_m
        above = 1e9
        if not everywhere:
            bx, by = np.float64(banks[i, 0]), np.float64(banks[i, 1])
            above = _field(x, y, 0.0, patches[0], patches[1], patches[2], patches[3])
            above += SHELTER * math.sqrt(bx * bx + by * by) - numbers.threshold
        if semantic[i] == FOLIAGE and not _is_fleck(x, y, patches[0], patches[3]):
            continue
        if not (room > 0.0 and above > 0.0):
            continue
        at_wind = banks[i, 0] * numbers.wind_x + banks[i, 1] * numbers.wind_y
        piled = 1.0 + numbers.drift * (PILED if at_wind > 0.0 else SCOURED) * at_wind
        drift = _field(x, y, size, drifts[0], drifts[1], drifts[2], drifts[3])
        drift = math.exp(min(max(drift, -STEEPEST), STEEPEST)) * piled
        full = numbers.depth_m * drift * _pillow(edges[i] / numbers.radius_m)
        if semantic[i] == FOLIAGE:
            full = min(FOLIAGE_SHARE * full, FOLIAGE_MOST_M)
        h = BARE_M + max(full - BARE_M, 0.0) * min(above / numbers.rim, 1.0)
        mottled = _field(x, y, size, mottling[0], mottling[1], mottling[2], mottling[3])
        track = np.float64(tracks[i])
        track += CRUMBLED * mottled * track * (1.0 - track)
        track = min(max(track, 0.0), 1.0)
        h = max(h * (1.0 - numbers.pressed * track), min(h, FILM_M))
        h = BARE_M + (h - BARE_M) * min(room / WATER_RIM_M, 1.0)
        heights[i] = np.float32(h)
        mottle[i] = np.float32(mottled)


# ---- Where a LiDAR's beams meet a layer of snow on a grid ----------------------------------------
# On the calling thread alone, without the GIL: sweeps are weathered beside the renderer.

# Cells a side of a block; nothing in a block is higher than its entry in `highest`.
BLOCK = 16
_NEAR_BEAM_M = 0.3  # from the sensor, where nothing is looked for
_STEP_M = 1e-7


@serial_kernel
def meet_layer(
    origins, directions, hits, part_from_world, circle, corner, cell, base, top, highest, slack
):
    """Shorten `hits` [N], the beams' lengths, to where they first meet the layer, in place.

    origins, directions: float64 [N, 3], world. part_from_world: [3, 4]. circle: x, y, radius,
    world, that holds the part. corner: least x and y of the grid, in the part's frame. base, top:
    float32 [H, W], the layer's underside and surface, -inf where there is none. highest [h, w]:
    of `top` in blocks. slack: how far below its underside the layer counts, for grounds that are
    not level. A beam meets the layer from above or from a side, never from below.
    """
    rows, columns = base.shape
    for i in range(len(hits)):
        end = hits[i]
        if not end > _NEAR_BEAM_M:
            continue
        if not _passes(origins[i], directions[i], end, circle):
            continue
        ox = oy = oz = dx = dy = dz = 0.0
        for k in range(3):
            o, d = origins[i, k], directions[i, k]
            ox += part_from_world[0, k] * o
            oy += part_from_world[1, k] * o
            oz += part_from_world[2, k] * o
            dx += part_from_world[0, k] * d
            dy += part_from_world[1, k] * d
            dz += part_from_world[2, k] * d
        ox = (ox + part_from_world[0, 3] - corner[0]) / cell
        oy = (oy + part_from_world[1, 3] - corner[1]) / cell
        oz += part_from_world[2, 3]
        dx, dy = dx / cell, dy / cell
        first, last = _within(ox, dx, float(columns), _NEAR_BEAM_M, end)
        first, last = _within(oy, dy, float(rows), first, last)
        over_x = 1.0 / dx if dx != 0.0 else np.inf
        over_y = 1.0 / dy if dy != 0.0 else np.inf
        t, is_met = first, False
        while t < last and not is_met:
            # What lies ahead: a step inside, so that a beam on a border goes on.
            inside = t + _STEP_M
            column = min(max(math.floor(ox + inside * dx), 0), columns - 1)
            row = min(max(math.floor(oy + inside * dy), 0), rows - 1)
            block_column, block_row = column // BLOCK, row // BLOCK
            leaves = min(
                _exit(ox, over_x, block_column * BLOCK, BLOCK),
                _exit(oy, over_y, block_row * BLOCK, BLOCK),
                last,
            )
            leaves = max(leaves, inside)
            ceiling = highest[block_row, block_column]
            if min(oz + t * dz, oz + leaves * dz) > ceiling:
                t = leaves
                continue
            if oz + t * dz > ceiling:  # it falls: nothing is met before it comes so low
                t = max(t, min((ceiling - oz) / dz, leaves))
            while t < leaves:
                inside = t + _STEP_M
                column = min(max(math.floor(ox + inside * dx), 0), columns - 1)
                row = min(max(math.floor(oy + inside * dy), 0), rows - 1)
                after = min(_exit(ox, over_x, column, 1), _exit(oy, over_y, row, 1), leaves)
                after = max(after, inside)
                z, surface = oz + t * dz, top[row, column]
                if z <= surface:
                    is_met = z >= base[row, column] - slack
                elif oz + after * dz < surface:
                    t, is_met = max(t, min((surface - oz) / dz, after)), True
                if is_met:
                    hits[i] = min(t, end)
                    break
                t = after


@inner()
def _passes(origin, direction, end, circle):
    """Whether a beam comes, seen from above, within a circle."""
    if circle[2] == np.inf:
        return True
    x, y = circle[0] - origin[0], circle[1] - origin[1]
    flat = direction[0] * direction[0] + direction[1] * direction[1]
    t = 0.0
    if flat > 0:
        t = min(max((x * direction[0] + y * direction[1]) / flat, 0.0), end)
    x, y = x - t * direction[0], y - t * direction[1]
    return x * x + y * y <= circle[2] * circle[2]


@inner()
def _within(o, d, size, first, last):
    """The part of a beam from first to last that lies between 0 and size along an axis."""
    if d == 0.0:
        return (first, last) if 0.0 <= o < size else (1.0, 0.0)
    a, b = -o / d, (size - o) / d
    return max(first, min(a, b)), min(last, max(a, b))


@inner()
def _exit(o, over_d, low, size):
    """Where a beam leaves the stretch from low to low + size along an axis."""
    if over_d == np.inf:
        return np.inf
    return ((low + size if over_d > 0.0 else low) - o) * over_d


@serial_kernel
def fill_layer(centers, sizes, depths, corner, cell, base, top):
    """Enter snow of some depth on square cells [C] into a grid: the highest where several meet.

    centers [C, 3], sizes [C], depths [C]: see SnowCells; 0 is no snow. base, top: float32 [H, W],
    -inf before.
    """
    rows, columns = base.shape
    for i in range(len(depths)):
        if not depths[i] > 0:
            continue
        half = 0.5 * np.float64(sizes[i]) - 1e-4
        x, y = np.float64(centers[i, 0]) - corner[0], np.float64(centers[i, 1]) - corner[1]
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
                    base[row, column], top[row, column] = z, surface
