"""Numba kernels that turn depths of snow on cells into Gaussians; `augment.snow.layer` launches.

Every covered cell gets a disc on the snow's surface. Where the surface drops by more than a disc
can lean, over the cell's border, upright discs close the wall below it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu_jit import inner, kernel
from augment.render.sh import SH_C0
from augment.snow.cells import OPEN_EDGE

MOST_WALLS = 8  # discs one above the other that close a wall
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
SHADED_HOLLOW, LARGEST_BEND = 0.9, 0.12  # a hollow's loss of brightness per bend, and most bend
THIN_M, THIN_LOSS = 0.005, 0.42  # depth through which the ground darkens snow, and how much
PACKED_SHARE = 0.6  # brightness of packed snow, of fresh snow's
DARKEST, BRIGHTEST = 0.35, 0.8  # light on the bare surface where the sun is out of sight, and full
_UNIT = 2.0**-53
_STEP = np.uint64(0x9E3779B97F4A7C15)
_A, _B = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S11, _S27, _S30, _S31 = (np.uint64(s) for s in (11, 27, 30, 31))


@inner()
def _uniform(bits, number):
    """The number-th random number of these bits, in [-1, 1)."""
    bits = bits + np.uint64(number + 1) * _STEP
    bits = (bits ^ (bits >> _S30)) * _A
    bits = (bits ^ (bits >> _S27)) * _B
    bits = bits ^ (bits >> _S31)
    return np.float64(np.int64(bits >> _S11)) * _UNIT * 2.0 - 1.0


@kernel
def settle(neighbours, z, settled_z):
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
    return min(math.ceil(drop / size), MOST_WALLS), drop


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
def _slope(i, axis, neighbours, size, bed_slope, centers, tops):
    """Rise of the surface per metre along x (axis 0) or y (1)."""
    before, run_before = _beyond(i, 2 * axis, neighbours, size, centers, tops)
    after, run_after = _beyond(i, 2 * axis + 1, neighbours, size, centers, tops)
    if run_before < size:  # the bed's own height where the layer ends, not its middle's
        before -= run_before * bed_slope
    if run_after < size:
        after += run_after * bed_slope
    if run_before == 0.0 and run_after == 0.0:
        return bed_slope
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


@inner()
def _shade(s, normal, tints, packed, seen, lights, look, sh, normals, slopes):
    """Colour of Gaussian s: by its normal, or what the light's share is added to.

    tints: of red, green and blue. packed: 0 to 1, darker. seen: share of the sun.
    """
    share = normal[0] * lights[0, 0] + normal[1] * lights[0, 1] + normal[2] * lights[0, 2]
    share = min(max((share + look.wrap) / (1.0 + look.wrap), 0.0), 1.0)
    # Packed snow gives back less of every colour alike: what is grey has the tint of the light.
    left = 1.0 - packed * (1.0 - PACKED_SHARE)
    for c in range(3):
        shadow = tints[c] * left * lights[2, c]
        rise = tints[c] * left * (lights[1, c] - lights[2, c]) * seen
        baked = share if look.is_baked else 0.0
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
def fill(
    centers, bed_normals, sizes, neighbours, tracks, light, heights, mottle, draws, tops, firsts,
    lights, look, means, quats, scales, sh, normals, slopes,
):  # fmt: skip
    """The Gaussians of every covered cell, from index firsts[i] on.

    lights [3, 3]: direction of the sun, colours of lit and of shaded snow. normals, slopes: [S, 3],
    or empty where they are not asked for.
    """
    for i in prange(len(heights)):
        if heights[i] == 0:
            continue
        size, draw, h = np.float64(sizes[i]), draws[i], np.float64(heights[i])
        x, y = np.float64(centers[i, 0]), np.float64(centers[i, 1])
        up = np.float64(bed_normals[i, 2])
        gx = _slope(i, 0, neighbours, size, -bed_normals[i, 0] / up, centers, tops)
        gy = _slope(i, 1, neighbours, size, -bed_normals[i, 1] / up, centers, tops)
        steep = math.sqrt(gx * gx + gy * gy)
        if steep > LEAN:
            gx, gy, steep = gx * LEAN / steep, gy * LEAN / steep, LEAN
        stretch = math.sqrt(1.0 + steep * steep)
        normal = (-gx / stretch, -gy / stretch, 1.0 / stretch)

        in_x, in_y = _inwards(i, 0, neighbours, heights), _inwards(i, 1, neighbours, heights)
        at_rim = in_x != 0 or in_y != 0
        spread = RIM_SPREAD if at_rim else SPREAD + (STEEP_SPREAD - SPREAD) * min(steep, 1.0)
        spread *= size
        spread *= 1.0 + 0.2 * look.grain * abs(_uniform(draw, 0))
        # On steep sides discs are long, and scattered ones would look like fur.
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

        bend = min(max(_hollow(i, neighbours, size, tops), -LARGEST_BEND), LARGEST_BEND)
        pale = 1.0 + (PALE + PALE_GRAIN * look.grain) * _uniform(draw, 3) + MOTTLED * mottle[i]
        pale *= 1.0 - THIN_LOSS * math.exp(-h / THIN_M)
        loss = SHADED_HOLLOW * bend
        tints = (pale * (1.0 - loss), pale * (1.0 - 0.8 * loss), pale * (1.0 - 0.55 * loss))
        dirt = min(max(0.8 + 0.2 * mottle[i] + 0.15 * _uniform(draw, 4), 0.3), 1.0)
        packed = look.packed * tracks[i] * tracks[i] * dirt
        seen = min(max((light[i] - DARKEST) / (BRIGHTEST - DARKEST), 0.0), 1.0)
        seen = seen * seen * (3.0 - 2.0 * seen)
        rough = (ROUGH + ROUGH_GRAIN * look.grain) / stretch
        facing = _rough(normal, rough, draw, 5)
        _shade(s, facing, tints, packed, seen, lights, look, sh, normals, slopes)

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
                _shade(s, facing, tints, packed, seen, lights, look, sh, normals, slopes)


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
