"""Numba kernels: lamps in wet ground and water, as streaks of a rough mirror.

`augment.lamps.wet_glints` prepares the arrays and holds the plain definition. Symbols: m Beckmann's
roughness, h the unit vector half way between eye and lamp, theta_h its angle to the normal.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.lamps.surface_light_kernels import insert_ranked, lit_share, lux_along_ray, read_lamp
from augment.render.cpu.jit import kernel, kernel_function

TILE_PX = 16  # pixels along a side of a tile, whose pixels share a list of lamps
REFRACTION_INDEX = 1.33  # of water
# Exponent of Beckmann's distribution, (tan theta_h / m)^2, from which on nothing glints.
MAX_EXPONENT = 14.0
# Pixels of a whole tile at which the lamps are compared: corners and middle.
SAMPLES = np.array([0, 15, 119, 240, 255])
# Tangent of an angle over its sine, for the tilts of waves.
TILT_MARGIN = 1.2
# Blur across the streak, in squares of a pixel, twice the variance: of half a pixel, so that a far
# lamp's streak keeps its light wherever it lies between the pixels.
PIXEL_BLUR = 0.5
# Largest square of the tangent from pixel to pixel.
MAX_PIXEL_TILT2 = 0.09
# Least cosine between the normal and the eye.
MIN_COSINE = 0.005


@kernel_function()
def fresnel(cosine):
    """Return the reflectance of water for unpolarised light by the cosine of its incidence."""
    sine2 = (1.0 - cosine * cosine) * (1.0 / (REFRACTION_INDEX * REFRACTION_INDEX))
    inside = math.sqrt(1.0 - sine2)
    s = (cosine - REFRACTION_INDEX * inside) / (cosine + REFRACTION_INDEX * inside)
    p = (inside - REFRACTION_INDEX * cosine) / (inside + REFRACTION_INDEX * cosine)
    return 0.5 * (s * s + p * p)


@kernel_function()
def masking(cosine, m):
    """Return Smith's share of a rough surface that a direction reaches.

    The rational approximation of Walter et al. 2007, "Microfacet Models for Refraction".
    """
    tangent = math.sqrt(max(1.0 - cosine * cosine, 0.0)) / cosine
    if m * tangent * 1.6 <= 1.0:
        return 1.0
    a = 1.0 / (m * tangent)
    return (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)


@kernel_function()
def _half_vector(dx, dy, dz, eye_x, eye_y, eye_z, up):
    """Return the half vector between unit directions to a lamp and to the eye, by its tangents.

    Returns:
        The squares of the tangents of its angle to the normal, in the plane of eye and normal and
        across it; its cosine to the normal; the cosines of the lamp to it, and of lamp and eye to
        the normal.
    """
    hx = dx + eye_x
    hy = dy + eye_y
    hz = dz + eye_z
    per_length = 1.0 / math.sqrt(max(hx * hx + hy * hy + hz * hz, 1e-12))
    cosine_h = (hx * up[0] + hy * up[1] + hz * up[2]) * per_length
    incidence = (dx * hx + dy * hy + dz * hz) * per_length
    to_lamp = dx * up[0] + dy * up[1] + dz * up[2]
    to_eye = eye_x * up[0] + eye_y * up[1] + eye_z * up[2]
    per_cosine2 = 1.0 / max(cosine_h * cosine_h, 1e-9)
    tangent2 = max(per_cosine2 - 1.0, 0.0)
    # The triple product of h, eye and normal, over the eye's level part, is h's part across.
    across = (
        hx * (eye_y * up[2] - eye_z * up[1])
        + hy * (eye_z * up[0] - eye_x * up[2])
        + hz * (eye_x * up[1] - eye_y * up[0])
    ) * per_length
    across2 = across * across * per_cosine2 / max(1.0 - to_eye * to_eye, 1e-9)
    across2 = min(across2, tangent2)
    return tangent2 - across2, across2, cosine_h, incidence, to_lamp, to_eye


@kernel_function()
def _pixel_tilt2(to_eye, eye_distance, to_lamp, lamp_distance, pixel_rad):
    """Return the square of the half vector's tangent from one pixel to the next one beside it."""
    cosines = max(to_eye, MIN_COSINE) + max(to_lamp, MIN_COSINE)
    tilt = pixel_rad * (1.0 + eye_distance / lamp_distance) / cosines
    return min(tilt * tilt, MAX_PIXEL_TILT2)


@kernel_function()
def glint(along2, across2, cosine_h, incidence, to_lamp, to_eye, m, pixel_tilt2):
    """Return F D G / (4 cos(eye)): luminance per lux on a surface that faces the lamp."""
    m2 = m * m
    across_m2 = m2 + PIXEL_BLUR * pixel_tilt2
    exponent = along2 / m2 + across2 / across_m2
    if exponent > MAX_EXPONENT or to_lamp <= 0 or to_eye <= 0:
        return 0.0
    to_eye = max(to_eye, MIN_COSINE)
    spread = math.exp(-exponent) / (math.pi * m * math.sqrt(across_m2) * cosine_h**4)
    shares = masking(max(to_lamp, MIN_COSINE), m) * masking(to_eye, m)
    return fresnel(min(incidence, 1.0)) * spread * shares / (4.0 * to_eye)


@kernel
def add_glints(
    share,
    roughness,
    depth,
    tilts,
    lens,
    axes,
    eye,
    up,
    lamps,
    shadows,
    min_luminance,
    max_lamps,
    picture,
):
    """Add the lamps' glints to the pixels that show water.

    Args:
        share: share of each pixel that shows water, float32 [H, W].
        roughness: Beckmann's m, float32 [H, W].
        depth: z of the water, metres, float32 [H, W].
        tilts: x and y of the waves' normals less those of `up`, float32 [H, W, 2]; empty for none.
        lens: 1 / fx, 1 / fy, cx, cy, float64 [4].
        axes: world_from_camera, float64 [3, 3].
        eye: place of the eye, world, float64 [3].
        up: normal of the water, world, float64 [3].
        lamps: the lamps, `surface_light_kernels.LampArrays`.
        shadows: depth maps, `surface_light_kernels.ShadowArrays`.
        min_luminance: luminance that need not be added, cd/m2.
        max_lamps: largest number of lamps that glint in a tile.
        picture: luminance in linear sRGB, cd/m2, changed in place, float32 [H, W, 3].
    """
    height, width = share.shape
    tile_columns = (width + TILE_PX - 1) // TILE_PX
    tile_rows = (height + TILE_PX - 1) // TILE_PX
    has_waves = tilts.size > 0
    for tile in prange(tile_columns * tile_rows):
        top = (tile // tile_columns) * TILE_PX
        left = (tile % tile_columns) * TILE_PX
        points = np.empty((TILE_PX * TILE_PX, 3))
        pixels = np.empty((TILE_PX * TILE_PX, 2), np.int64)
        chosen = np.empty(max_lamps, np.int64)
        scores = np.empty(max_lamps)
        normal = (up[0], up[1], up[2])
        count = 0
        largest_m = 0.0
        largest_tilt = 0.0
        for i in range(top, min(top + TILE_PX, height)):
            y = (i + 0.5 - lens[3]) * lens[1]
            for j in range(left, min(left + TILE_PX, width)):
                z = np.float64(depth[i, j])
                if not (share[i, j] > 0 and z > 0 and z < 1e6):
                    continue
                x = (j + 0.5 - lens[2]) * lens[0]
                for k in range(3):
                    points[count, k] = z * (axes[k, 0] * x + axes[k, 1] * y + axes[k, 2])
                pixels[count, 0] = i
                pixels[count, 1] = j
                largest_m = max(largest_m, np.float64(roughness[i, j]))
                if has_waves:
                    tilt = math.sqrt(np.float64(tilts[i, j, 0]) ** 2 + tilts[i, j, 1] ** 2)
                    largest_tilt = max(largest_tilt, tilt)
                count += 1
        if count == 0:
            continue
        number = 0
        for m in range(len(lamps.intensities)):
            if lamps.peaks[m] <= 0:
                continue
            # The least tilt of h at some points, less what it may fall between them.
            smallest = np.inf
            largest = 0.0
            nearest = np.inf
            blur2 = 0.0
            for sample in range(len(SAMPLES)):
                p = SAMPLES[sample] * (count - 1) // (TILE_PX * TILE_PX - 1)
                tilt, squared, pixel_tilt2 = _tilt(points, p, eye, normal, lamps, m, lens[0])
                smallest = min(smallest, tilt)
                largest = max(largest, tilt)
                nearest = min(nearest, squared)
                blur2 = max(blur2, PIXEL_BLUR * pixel_tilt2)
            reach = 2.0 * smallest - largest - TILT_MARGIN * largest_tilt
            m2 = largest_m * largest_m + 0.25 * lamps.softening[m] / nearest
            exponent = max(reach, 0.0) ** 2 / (m2 + blur2)
            if exponent > MAX_EXPONENT:
                continue
            # A bound of F D G / (4 cos), with G / cos at most about 1 / m.
            bound = lamps.peaks[m] / nearest * math.exp(-exponent)
            bound /= 4.0 * math.pi * m2 * math.sqrt(m2)
            if bound < min_luminance:
                continue
            # Lamps are ranked by their glints at the points, and those that pass between by a bit.
            score = 1e-4 * bound
            lamp = read_lamp(lamps, m)
            for sample in range(len(SAMPLES)):
                p = SAMPLES[sample] * (count - 1) // (TILE_PX * TILE_PX - 1)
                rough = np.float64(roughness[pixels[p, 0], pixels[p, 1]])
                strength = _glint_at(points, p, lamp, eye, normal, rough, lens[0])
                if strength > 0:
                    x = points[p, 0] + eye[0]
                    y = points[p, 1] + eye[1]
                    z = points[p, 2] + eye[2]
                    lux = lux_along_ray(lamps.tables, lamp, x, y, z)[0]
                    score = max(score, strength * lux)
            if number == max_lamps and score <= scores[number - 1]:
                continue
            number = insert_ranked(chosen, scores, number, m, score)
        for c in range(number):
            m = chosen[c]
            lamp = read_lamp(lamps, m)
            tables = lamps.tables
            shadow_map = lamps.shadow_maps[m]
            red = lamps.colors[m, 0]
            green = lamps.colors[m, 1]
            blue = lamps.colors[m, 2]
            for p in range(count):
                x = points[p, 0]
                y = points[p, 1]
                z = points[p, 2]
                i = pixels[p, 0]
                j = pixels[p, 1]
                if has_waves:
                    a = up[0] + tilts[i, j, 0]
                    b = up[1] + tilts[i, j, 1]
                    normal = (a, b, math.sqrt(max(1.0 - a * a - b * b, 0.01)))
                rough = np.float64(roughness[i, j])
                strength = _glint_at(points, p, lamp, eye, normal, rough, lens[0])
                if strength <= 0:
                    continue
                lux = lux_along_ray(tables, lamp, x + eye[0], y + eye[1], z + eye[2])[0]
                if shadow_map >= 0 and lux > 0:
                    lux *= lit_share(shadows, shadow_map, x + eye[0], y + eye[1], z + eye[2])
                luminance = strength * lux * share[i, j]
                picture[i, j, 0] += np.float32(luminance * red)
                picture[i, j, 1] += np.float32(luminance * green)
                picture[i, j, 2] += np.float32(luminance * blue)


@kernel_function()
def _tilt(points, p, eye, normal, lamps, m, pixel_rad):
    """Return tan(theta_h) of a lamp at a point, the square of its distance, and `_pixel_tilt2`."""
    x = points[p, 0]
    y = points[p, 1]
    z = points[p, 2]
    dx = lamps.positions[m, 0] - eye[0] - x
    dy = lamps.positions[m, 1] - eye[1] - y
    dz = lamps.positions[m, 2] - eye[2] - z
    squared = max(dx * dx + dy * dy + dz * dz, 1e-6)
    distance = math.sqrt(squared)
    per_m = 1.0 / distance
    eye_distance = math.sqrt(x * x + y * y + z * z)
    per_eye_m = 1.0 / eye_distance
    along2, across2, _, _, to_lamp, to_eye = _half_vector(
        dx * per_m, dy * per_m, dz * per_m, -x * per_eye_m, -y * per_eye_m, -z * per_eye_m, normal
    )
    pixel_tilt2 = _pixel_tilt2(to_eye, eye_distance, to_lamp, distance, pixel_rad)
    return math.sqrt(along2 + across2), squared, pixel_tilt2


@kernel_function()
def _glint_at(points, p, lamp, eye, normal, rough, pixel_rad):
    """Return a lamp's luminance per lux in a point of the water.

    Args:
        points: points from the eye, [N, 3].
        p: row of the point.
        lamp: result of `read_lamp`.
        eye: place of the eye, world.
        normal: normal of the water.
        rough: roughness of the water.
        pixel_rad: width of a pixel, radians.
    """
    x = points[p, 0]
    y = points[p, 1]
    z = points[p, 2]
    dx = lamp[0][0] - eye[0] - x
    dy = lamp[0][1] - eye[1] - y
    dz = lamp[0][2] - eye[2] - z
    squared = max(dx * dx + dy * dy + dz * dz, 1e-6)
    distance = math.sqrt(squared)
    per_m = 1.0 / distance
    eye_distance = math.sqrt(x * x + y * y + z * z)
    per_eye_m = 1.0 / eye_distance
    along2, across2, cosine_h, incidence, to_lamp, to_eye = _half_vector(
        dx * per_m, dy * per_m, dz * per_m, -x * per_eye_m, -y * per_eye_m, -z * per_eye_m, normal
    )
    # The lamp's disc blurs the mirror by half its angle.
    m = math.sqrt(rough * rough + 0.25 * lamp[7] / squared)
    if along2 > MAX_EXPONENT * m * m:
        return 0.0
    pixel_tilt2 = _pixel_tilt2(to_eye, eye_distance, to_lamp, distance, pixel_rad)
    return glint(along2, across2, cosine_h, incidence, to_lamp, to_eye, m, pixel_tilt2)
