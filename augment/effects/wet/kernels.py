"""Kernels of wet ground: which pixels show it, and what its film mirrors. `reflection` and
`ripples` define what they compute, and launch them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.kernels import mix
from augment.render.cpu.jit import inner, kernel
from augment.render.layout import U
from augment.rng import STEP_X, STEP_Y

# Channels of the ground's map.
HEIGHT, OPEN, RISE_X, RISE_Y, HOLLOW, TRACK, CHANNELS = range(7)

# ---- Rings of drops ------------------------------------------------------------------------------

SQUARE_M = 0.12  # a ring ends before it is as wide
MAX_DROPS = 2  # in a square at a time
AT = 9 * MAX_DROPS  # rows of drops that may reach a square; one more names it
LIFE_NS = 400_000_000
SPEED_MPS = 0.23  # least of capillary-gravity waves on water, whose length is 1.7 cm
WAVE_M, WIDTH_M, SLOPE = 0.022, 0.016, 0.1
ENDS = 3.0  # widths beyond which a ring is none
LEAST_FALL = 1e-7  # of a ray that meets a plane, at unit depth
LEAST_SINE = 0.02  # of the angle at which a pixel's footprint is judged
FADED_PX, FULL_PX = 2.0, 4.0  # waves of so many pixels are gone, and full
_X, _Y = np.uint64(STEP_X), np.uint64(STEP_Y)
_S24, _S44 = np.uint64(24), np.uint64(44)
_LOW20, _LIFE, _UNIT = np.uint64(0xFFFFF), np.uint64(LIFE_NS), 2.0**-20


@inner()
def _find_drops(column, row, rings, seed, timestamp_ns, drops):
    """Enter the rings that may reach a square: how many, and x, y, radius and slope of each."""
    reach = SPEED_MPS * LIFE_NS * 1e-9
    found = 0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            i, j = column + di, row + dj
            place = np.uint64(np.int64(i)) * _X + np.uint64(np.int64(j)) * _Y
            for drop in range(MAX_DROPS):
                first = mix(place + seed + np.uint64(drop))
                passed = timestamp_ns + np.int64((first >> _S24) % _LIFE)
                again, age = passed // LIFE_NS, (passed % LIFE_NS) / LIFE_NS
                bits = mix(first ^ (np.uint64(again) * _X))
                if np.float64(np.int64(bits & _LOW20)) * _UNIT < rings[0]:
                    u = np.float64(np.int64(bits >> _S44)) * _UNIT
                    v = np.float64(np.int64((bits >> _S24) & _LOW20)) * _UNIT
                    drops[found, 0], drops[found, 1] = (i + u) * SQUARE_M, (j + v) * SQUARE_M
                    drops[found, 2] = reach * age
                    drops[found, 3] = SLOPE * (1.0 - age) * (1.0 - age)
                    found += 1
    drops[AT, 0], drops[AT, 1], drops[AT, 2] = column, row, found


@inner()
def rings_at(x, y, footprint, rings, seed, timestamp_ns, drops):
    """(slope x, slope y, variance of the rest). rings: share, variance, unseen. drops [AT + 1, 4]:
    those about the square of the last point, which its last row names.
    """
    shown = (WAVE_M / max(footprint, 1e-9) - FADED_PX) / (FULL_PX - FADED_PX)
    shown = min(max(shown, 0.0), 1.0)
    shown = shown * shown * (3.0 - 2.0 * shown)
    variance = rings[1] + (rings[2] - rings[1]) * shown * shown
    sx = sy = 0.0
    if shown <= 0.0 or rings[0] <= 0.0:
        return sx, sy, variance
    column, row = math.floor(x / SQUARE_M), math.floor(y / SQUARE_M)
    if not (drops[AT, 0] == column and drops[AT, 1] == row):
        _find_drops(column, row, rings, seed, timestamp_ns, drops)
    for k in range(np.int64(drops[AT, 2])):
        dx, dy = x - drops[k, 0], y - drops[k, 1]
        d = max(math.sqrt(dx * dx + dy * dy), 1e-4)
        off = (d - drops[k, 2]) / WIDTH_M
        if abs(off) > ENDS:
            continue
        s = drops[k, 3] * math.exp(-off * off)
        s *= math.sin((2.0 * math.pi * WIDTH_M / WAVE_M) * off) / d
        sx += s * dx
        sy += s * dy
    return sx * shown, sy * shown, variance


# ---- Which pixels show open ground ---------------------------------------------------------------

NEAR_OFF, NEAR_PER_M = 0.08, 0.003  # metres off the ground's height that a pixel surely may be
FAR_OFF, FAR_PER_M = 0.2, 0.008  # and where it is something else
FAINT = 0.004  # shares below this are none


class View(NamedTuple):
    """lens: fx, fy, cx, cy. pose: world_from_camera [3, 4]. corner: of the map, x and y. cell_m."""

    lens: np.ndarray
    pose: np.ndarray
    corner: np.ndarray
    cell_m: float


@inner()
def _smoothstep(t):
    """From 0 at t = 0 to 1 at 1."""
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@inner()
def _place(x, y, corner, per_cell, rows, columns):
    """(is it in the map, index of the texel below left, shares to the right and up)."""
    u, v = (x - corner[0]) * per_cell - 0.5, (y - corner[1]) * per_cell - 0.5
    inside = u >= 0.0 and v >= 0.0 and u <= columns - 1 and v <= rows - 1
    if not inside:
        return False, U(0), 0.0, 0.0
    i, j = min(np.int64(u), columns - 2), min(np.int64(v), rows - 2)
    return True, U(j * columns + i), u - i, v - j


@inner()
def _between(flat, at, columns, channel, u, v):
    channel, below = U(channel), at + U(columns)
    a = flat[at, channel] + (flat[at + U(1), channel] - flat[at, channel]) * u
    b = flat[below, channel] + (flat[below + U(1), channel] - flat[below, channel]) * u
    return a + (b - a) * v


@inner()
def _find_in_row(row, view, depth, shown, flat, rows, columns, share, most):
    lens, pose, corner, per_cell = view.lens, view.pose, view.corner, 1.0 / view.cell_m
    b, per_focal = (row + 0.5 - lens[3]) / lens[1], 1.0 / lens[0]
    best = np.float32(0)
    for x in range(depth.shape[1]):
        share[row, x] = np.float32(0)
        z = np.float64(depth[row, x])
        if not (z > 0.0 and shown[row, x] > 0):
            continue
        a = (x + 0.5 - lens[2]) * per_focal
        rise = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]
        if not rise < 0.0:
            continue
        px = pose[0, 3] + z * (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2])
        py = pose[1, 3] + z * (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2])
        inside, at, u, v = _place(px, py, corner, per_cell, rows, columns)
        if not inside:
            continue
        open_ = _between(flat, at, columns, OPEN, u, v)
        if not open_ > FAINT:
            continue
        off = abs(pose[2, 3] + z * rise - _between(flat, at, columns, HEIGHT, u, v))
        distance = z * math.sqrt(1.0 + a * a + b * b)
        near, far = NEAR_OFF + NEAR_PER_M * distance, FAR_OFF + FAR_PER_M * distance
        s = shown[row, x] * open_ * (1.0 - _smoothstep((off - near) / (far - near)))
        if s > FAINT:
            share[row, x] = np.float32(s)
            best = max(best, np.float32(s))
    most[row] = best


@kernel
def find_ground(view, depth, shown, flat, rows, columns, share, most):
    """share [H, W]: of each pixel that is open ground; most [H]: of a row's pixels.

    flat [rows columns, CHANNELS]: the map, of 2 by 2 cells at least.
    """
    for y in prange(depth.shape[0]):
        _find_in_row(np.int64(y), view, depth, shown, flat, rows, columns, share, most)


# ---- What the film mirrors -----------------------------------------------------------------------

R0 = 0.0201  # of water under a right angle
ASPHALT, PUDDLE = 0.085, 0.008  # standard deviations of slopes: alpha / sqrt 2 of 0.12 and 0.011
TRACK_SMOOTHS = 0.35  # share of the roughness that wheels have polished away
FILM = 0.75  # of wet asphalt that shows water: stones stand out of it
RIM = 0.12  # of a puddle, in HOLLOW
MOTTLE_SIDE = 256  # a power of 2: texels of the noise that makes film and roughness uneven
FINE_M, COARSE_M = 0.012, 0.2  # its texels
FINE, COARSE = 0.07, 0.05  # by how much of the film
LEVELS = 9  # of the mirrored picture: sharp, and blurred upright by 2 to 256 pixels
FARTHEST_M = 1e5  # stands for the sky
# Steps of the table of reflectance, and the largest deviation of slopes in it.
COSINES, ROUGHNESSES, ROUGHEST = 512, 64, 0.4
TABLE = 1024  # steps of the tables of the display's encoding


class Mirrored(NamedTuple):
    """lens, rotation [3, 3] (camera_from_world): of the mirrored camera. offset [3]: its centre,
    from the eye. colors [texels, 3]: linear light, its levels one after the other. table [LEVELS,
    3]: first texel, width, height of each. depth [h, w]: z, 0 of the sky.
    """

    lens: np.ndarray
    rotation: np.ndarray
    offset: np.ndarray
    colors: np.ndarray
    table: np.ndarray
    depth: np.ndarray


class Water(NamedTuple):
    """wetness, level: see reflection.Film. rings: share, variance, unseen. noise: MOTTLE_SIDE
    squared. reflectance [ROUGHNESSES + 1, COSINES + 1]. decoded: linear light of i / TABLE.
    encoded: display values of (i / TABLE)^2.
    """

    wetness: float
    level: float
    rings: np.ndarray
    seed: np.uint64
    timestamp_ns: np.int64
    noise: np.ndarray
    reflectance: np.ndarray
    decoded: np.ndarray
    encoded: np.ndarray


@inner()
def _mottle(noise, x, y, per_texel):
    u, v = x * per_texel, y * per_texel
    i, j = math.floor(u), math.floor(v)
    u, v = u - i, v - j
    side = MOTTLE_SIDE
    i0, j0 = U(np.int64(i) & (side - 1)), U(np.int64(j) & (side - 1))
    i1, j1 = (i0 + U(1)) & U(side - 1), (j0 + U(1)) & U(side - 1)
    a = noise[j0, i0] + (noise[j0, i1] - noise[j0, i0]) * u
    b = noise[j1, i0] + (noise[j1, i1] - noise[j1, i0]) * u
    return a + (b - a) * v


@inner()
def _look_up(table, cosine, rough):
    u, v = cosine * COSINES, min(rough * (1.0 / ROUGHEST), 1.0) * ROUGHNESSES
    i, j = U(min(np.int64(u), COSINES - 1)), U(min(np.int64(v), ROUGHNESSES - 1))
    u, v = u - np.int64(i), v - np.int64(j)
    right, down = i + U(1), j + U(1)
    a = table[j, i] + (table[j, right] - table[j, i]) * u
    b = table[down, i] + (table[down, right] - table[down, i]) * u
    return a + (b - a) * v


@inner()
def _step_of(table, at):
    i = min(np.int64(at), TABLE - 1)
    low, high = table[U(i)], table[U(i + 1)]
    return low + (high - low) * (at - i)


@inner()
def _decode(table, value):
    if value > 1.0:
        return ((value + 0.055) / 1.055) ** 2.4
    return _step_of(table, max(value, 0.0) * TABLE)


@inner()
def _encode(table, linear):
    if linear > 1.0:
        return 1.055 * linear ** (1.0 / 2.4) - 0.055
    return _step_of(table, math.sqrt(max(linear, 0.0)) * TABLE)


@inner()
def _project(rotation, lens, x, y, z):
    a = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
    b = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
    c = 1.0 / max(rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z, 1e-3)
    return lens[0] * a * c + lens[2], lens[1] * b * c + lens[3]


@inner()
def _way_at(depth, rotation, lens, per_x, per_y, offset, column, row, x, y, z):
    """Metres from a point of the ground to what the mirrored picture shows."""
    h, w = depth.shape
    i = np.int64(min(max(column, 0.0), w - 1.0))
    j = np.int64(min(max(row, 0.0), h - 1.0))
    far = np.float64(depth[U(j), U(i)])
    if not far > 0.0:
        return FARTHEST_M
    a, b = (i + 0.5 - lens[2]) * per_x * far, (j + 0.5 - lens[3]) * per_y * far
    dx = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * far + offset[0] - x
    dy = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * far + offset[1] - y
    dz = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * far + offset[2] - z
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@inner()
def _texel(colors, table, level, column, row):
    first, w, h = table[level, 0], table[level, 1], table[level, 2]
    if level > 1:
        row = row / (1 << (level - 1))
    x, y = min(max(column - 0.5, 0.0), w - 1.0), min(max(row - 0.5, 0.0), h - 1.0)
    i, j = np.int64(x), np.int64(y)
    u, v, at = x - i, y - j, U(first + j * w + i)
    right = at + U(i < w - 1)
    down = U(w if j < h - 1 else 0)
    a, b, c, d = (1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v
    low, low_right = at + down, right + down
    return (
        a * colors[at, U(0)]
        + b * colors[right, U(0)]
        + c * colors[low, U(0)]
        + d * colors[low_right, U(0)],
        a * colors[at, U(1)]
        + b * colors[right, U(1)]
        + c * colors[low, U(1)]
        + d * colors[low_right, U(1)],
        a * colors[at, U(2)]
        + b * colors[right, U(2)]
        + c * colors[low, U(2)]
        + d * colors[low_right, U(2)],
    )


@kernel
def decode(rgb, table, linear):
    """Linear light of display-encoded colours, [H, W, 3] both."""
    for y in prange(rgb.shape[0]):
        line = np.int64(y)
        for x in range(rgb.shape[1]):
            for c in range(3):
                linear[line, x, c] = np.float32(_decode(table, np.float64(rgb[line, x, c])))


@inner()
def _shade_row(line, view, depth, share, flat, rows, columns, mirror, water, rgb):
    lens, pose, corner, per_cell = view.lens, view.pose, view.corner, 1.0 / view.cell_m
    m_lens, rotation, offset = mirror.lens, mirror.rotation, mirror.offset
    colors, table, m_depth = mirror.colors, mirror.table, mirror.depth
    wetness, level, rings, noise = water.wetness, water.level, water.rings, water.noise
    seed, timestamp_ns = water.seed, water.timestamp_ns
    decoded, encoded = water.decoded, water.encoded
    reflectance = water.reflectance
    drops = np.full((AT + 1, 4), np.nan)
    per_x, per_y = 1.0 / m_lens[0], 1.0 / m_lens[1]
    per_focal, per_row = 1.0 / lens[0], 1.0 / lens[1]
    b = (line + 0.5 - lens[3]) * per_row
    for x in range(depth.shape[1]):
        own = np.float64(share[line, x])
        if not own > 0.0:
            continue
        a = (x + 0.5 - lens[2]) * per_focal
        z = np.float64(depth[line, x])
        px = z * (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2])
        py = z * (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2])
        pz = z * (pose[2, 0] * a + pose[2, 1] * b + pose[2, 2])
        wx, wy = px + pose[0, 3], py + pose[1, 3]
        _, at, u, v = _place(wx, wy, corner, per_cell, rows, columns)
        hollow = _between(flat, at, columns, HOLLOW, u, v)
        puddle = wetness * _smoothstep((hollow - level) * (0.5 / RIM) + 0.5)
        track = _between(flat, at, columns, TRACK, u, v)
        distance = math.sqrt(px * px + py * py + pz * pz)
        per_distance = -1.0 / distance
        ex, ey, ez = px * per_distance, py * per_distance, pz * per_distance
        footprint = distance * per_row / max(ez, LEAST_SINE)
        nx = -_between(flat, at, columns, RISE_X, u, v) * (1.0 - puddle)
        ny = -_between(flat, at, columns, RISE_Y, u, v) * (1.0 - puddle)
        fine = FINE * min(max(2.0 - footprint * (1.0 / FINE_M), 0.0), 1.0)
        coarse = COARSE * min(max(2.0 - footprint * (1.0 / COARSE_M), 0.0), 1.0)
        uneven = 0.0
        if coarse > 0.0:
            uneven += coarse * _mottle(noise, wx, wy, 1.0 / COARSE_M)
        if fine > 0.0:
            uneven += fine * _mottle(noise, wx, wy, 1.0 / FINE_M)
        rough = ASPHALT * (1.0 - TRACK_SMOOTHS * track) * (1.0 - uneven)
        still = PUDDLE
        if puddle > 0.0:
            sx, sy, variance = rings_at(wx, wy, footprint, rings, seed, timestamp_ns, drops)
            nx -= sx * puddle
            ny -= sy * puddle
            still = math.sqrt(PUDDLE * PUDDLE + 0.5 * variance)
        rough += puddle * (still - rough)
        nz = 1.0 / math.sqrt(nx * nx + ny * ny + 1.0)
        nx, ny = nx * nz, ny * nz
        cosine = min(max(nx * ex + ny * ey + nz * ez, 0.005), 1.0)
        film = min(max(FILM + uneven + 0.1 * track, 0.0), 1.0)
        cover = wetness * (film + (1.0 - film) * puddle)
        strength = own * cover * _look_up(reflectance, cosine, rough)
        rx, ry, rz = 2.0 * cosine * nx - ex, 2.0 * cosine * ny - ey, 2.0 * cosine * nz - ez
        mx, my, mz = px - offset[0], py - offset[1], pz - offset[2]
        column, row = _project(rotation, m_lens, mx, my, mz)
        way = _way_at(m_depth, rotation, m_lens, per_x, per_y, offset, column, row, px, py, pz)
        tx, ty, tz = mx + way * rx, my + way * ry, mz + way * rz
        column, row = _project(rotation, m_lens, tx, ty, tz)
        sigma = m_lens[1] * 2.0 * rough * way / (way + distance)
        sigma = max(sigma * sigma / (sigma + 1.0), 1.0)
        low, width = np.int64(0), 1.0
        while low < LEVELS - 2 and sigma >= 2.0 * width:
            low, width = low + 1, 2.0 * width
        upper = min(sigma / width - 1.0, 1.0)
        red = green = blue = 0.0
        for k in range(2):
            weight = upper if k else 1.0 - upper
            if weight > 0.0:
                r, g, b_ = _texel(colors, table, low + k, column, row)
                red, green, blue = red + weight * r, green + weight * g, blue + weight * b_
        for c in range(3):
            seen = red if c == 0 else green if c == 1 else blue
            mine = _decode(decoded, np.float64(rgb[line, x, c]))
            rgb[line, x, c] = np.float32(_encode(encoded, mine + strength * (seen - mine)))


@kernel
def shade_wet(view, depth, share, flat, rows, columns, mirror, water, rgb):
    """Mix reflections into rgb [H, W, 3], in place, where share says how much is open ground."""
    for y in prange(depth.shape[0]):
        _shade_row(np.int64(y), view, depth, share, flat, rows, columns, mirror, water, rgb)


@inner()
def _add_in_row(line, axes, centre, height, lens, rings, seed, timestamp_ns, nxs, nys, variance):
    drops = np.full((AT + 1, 4), np.nan)
    b = (line + 0.5 - lens[3]) / lens[1]
    for x in range(nxs.shape[1]):
        a = (x + 0.5 - lens[2]) / lens[0]
        fall = -(axes[2, 0] * a + axes[2, 1] * b + axes[2, 2])
        if not fall > LEAST_FALL:
            continue
        z = height / fall
        px = centre[0] + z * (axes[0, 0] * a + axes[0, 1] * b + axes[0, 2])
        py = centre[1] + z * (axes[1, 0] * a + axes[1, 1] * b + axes[1, 2])
        length = math.sqrt(1.0 + a * a + b * b)
        footprint = z * length / lens[1] / max(fall / length, LEAST_SINE)
        sx, sy, rest = rings_at(px, py, footprint, rings, seed, timestamp_ns, drops)
        nx, ny = np.float64(nxs[line, x]), np.float64(nys[line, x])
        nz = math.sqrt(max(1.0 - nx * nx - ny * ny, 1e-6))
        gx, gy = nx / nz - sx, ny / nz - sy
        scale = 1.0 / math.sqrt(gx * gx + gy * gy + 1.0)
        nxs[line, x], nys[line, x] = np.float32(gx * scale), np.float32(gy * scale)
        variance[line, x] += np.float32(0.5 * rest)


@kernel
def add_rings(axes, centre, height, lens, rings, seed, timestamp_ns, normal_x, normal_y, variance):
    """Rings on the waves of a level plane, `height` below the eye, in place: normals' x and y, and
    the variance of slope, [H, W]. axes: world_from_camera [3, 3]. centre: world x and y.
    """
    for y in prange(normal_x.shape[0]):
        _add_in_row(
            np.int64(y), axes, centre, height, lens, rings, seed, timestamp_ns,
            normal_x, normal_y, variance,
        )  # fmt: skip
