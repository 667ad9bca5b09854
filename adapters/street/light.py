"""Baked light of the procedural street, and the cube map of its sky.

Light on surfaces: a sun with soft shadows, sky light in a street canyon, reflections, haze,
exposure. All of it is a function of the place on a surface. Light that depends on the viewer (the
sky in a window, the shine of paint) is computed for one viewer, at the nearest point of the ego
cameras' path. The callers are `adapters.street.splats` and `adapters.procedural`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from adapters.street.forms import Material, Shapes, albedo, fractal_noise, value_noise
from adapters.street.raycast import Tree
from augment.scene.sky import CubemapSky, directions_of_cubemap

# Linear colour of sunlight.
SUN_RGB = np.array([1.0, 0.91, 0.76]) * 2.75
# Linear colour of the sky's light from above.
SKY_RGB = np.array([0.66, 0.77, 0.98]) * 1.0
# Linear colour of the light that the street reflects upwards.
BOUNCE_RGB = np.array([0.55, 0.50, 0.44]) * 0.50
# Linear colour of haze.
HAZE_RGB = np.array([0.64, 0.73, 0.83])
# Rays towards the sun's disc from each place.
SUN_SAMPLES = 8
# Angular radius of the sun: four times the real one, so that shadow edges are as soft as the splats
# are wide.
SUN_RADIUS_RAD = 0.018
# Shadow rays start this far off the surface.
SHADOW_OFFSET_M = 0.004
# Linear colour of the far side of the street in panes and paint.
MIRROR_RGB = np.array([0.42, 0.38, 0.34])
# Linear colour of the low sky in panes and paint.
MIRROR_LOW_RGB = np.array([0.75, 0.86, 1.0])
# Linear colour of the high sky in panes and paint.
MIRROR_HIGH_RGB = np.array([0.28, 0.45, 0.85])


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light in one body's frame.

    Attributes:
        to_sun: float [3], unit vector.
        eye_path: float [2, 3], segment along which the cameras move.
        canyon: y of the street's right and left walls, z of their tops.
        ground_z: height of the ground.
        sunlit: fraction of its way that the body spends in the sun.
        footprints: float [C, 4], x, y and half sizes of parked cars, which keep sky light off the
            ground.
    """

    to_sun: np.ndarray
    eye_path: np.ndarray
    canyon: tuple[float, float, float]
    ground_z: float = 0.0
    sunlit: float = 1.0
    footprints: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4)))

    def sun_directions(self) -> np.ndarray:
        """Return unit vectors [SUN_SAMPLES, 3] spread over the sun's disc (a sunflower pattern)."""
        index = np.arange(SUN_SAMPLES)
        radius = SUN_RADIUS_RAD * np.sqrt((index + 0.5) / SUN_SAMPLES)
        angle = index * 2.399963
        u = np.cross([0.0, 0.0, 1.0], self.to_sun)
        u /= np.linalg.norm(u)
        v = np.cross(self.to_sun, u)
        spread = radius[:, None] * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)
        directions = self.to_sun + spread
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def eyes_for(self, points: np.ndarray) -> np.ndarray:
        """Return the place of the cameras' path that is nearest to each point, [N, 3]."""
        start, end = self.eye_path
        along = end - start
        length = max(float(along @ along), 1e-9)
        fraction = np.clip((points - start) @ along / length, 0, 1)
        return start + fraction[:, None] * along


@dataclass(frozen=True, eq=False)
class Body:
    """Shapes that move together, the tree in which rays meet them, and their light, in one
    frame.
    """

    shapes: Shapes
    tree: Tree
    lighting: Lighting

    def colors(self, shape: np.ndarray, sample_places: np.ndarray) -> np.ndarray:
        """Return the display-encoded colour on shapes, float [N, 3].

        Albedo and the sun's shadows are averaged over the places; other light is taken at the first
        place.

        Args:
            shape: int [N], numbers of the shapes.
            sample_places: float [G, N, 3], local coordinates.
        """
        shapes = self.shapes
        lighting = self.lighting
        local = sample_places[0]
        base = np.zeros((len(shape), 3))
        for place in sample_places:
            base += albedo(shapes, shape, place)
        points = shapes.points(shape, local)
        shading_normals = shapes.shading_normals(shape, local)
        cosine = shading_normals @ lighting.to_sun
        is_leaf = shapes.material[shape] == Material.LEAF  # light also comes through from behind
        cosine = np.maximum(np.where(is_leaf, 0.35 + 0.65 * np.abs(cosine), cosine), 0)
        sun = (
            cosine * self._visible_sun_fraction(shape, sample_places, cosine > 0) * lighting.sunlit
        )
        sky = _visible_sky_fraction(lighting, points, shading_normals) * shapes.ambient[shape]
        upward = 0.5 + 0.5 * shading_normals[:, 2]
        ambient = sky[:, None] * (upward[:, None] * SKY_RGB + (1 - upward)[:, None] * BOUNCE_RGB)
        radiance = base / len(sample_places) * (sun[:, None] * SUN_RGB + ambient)
        material = shapes.material[shape]
        glossy = np.isin(material, (Material.GLASS, Material.SHOP, Material.PAINT))
        if glossy.any():
            inputs = (points, shading_normals, material, sun, sky)
            radiance[glossy] += _reflected_radiance(
                lighting, *(values[glossy] for values in inputs)
            )
        # Far things pale towards the horizon, by their distance to the cameras' path.
        distance = np.linalg.norm(points - lighting.eyes_for(points), axis=1)
        veil = 1 - np.exp(-np.maximum(distance - 25, 0) / 260)
        return encode_display(radiance * (1 - veil)[:, None] + veil[:, None] * HAZE_RGB * 0.8)

    def _visible_sun_fraction(
        self, shape: np.ndarray, sample_places: np.ndarray, is_lit: np.ndarray
    ) -> np.ndarray:
        """Return the visible fraction of the sun's disc at lit shapes, [N], averaged over the
        places.

        G divides SUN_SAMPLES. Half of the rays are cast first; the others are cast only if those
        disagree.
        """
        directions = self.lighting.sun_directions()
        visible_fraction = np.zeros(len(shape))
        index = np.flatnonzero(is_lit)
        for half in range(2):
            for number in range(half, SUN_SAMPLES, 2):
                local = sample_places[(number // 2) % len(sample_places), index]
                origins = self._shadow_ray_origins(shape[index], local)
                visible_fraction[index] += ~self.tree.occluded(origins, directions[number])
            if half == 0:
                is_doubtful = (visible_fraction[index] > 0) & (
                    visible_fraction[index] < SUN_SAMPLES / 2
                )
                visible_fraction[index[~is_doubtful]] *= 2
                index = index[is_doubtful]
        return visible_fraction / SUN_SAMPLES

    def _shadow_ray_origins(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return the origins of rays to the sun: just outside; for a leaf tuft, its sunny end."""
        shapes = self.shapes
        points = shapes.points(shape, local) + SHADOW_OFFSET_M * shapes.normals(shape, local)
        is_leaf = shapes.material[shape] == Material.LEAF
        size = np.linalg.norm(shapes.axes[shape[is_leaf]], axis=2).max(1, keepdims=True)
        points[is_leaf] = shapes.origin[shape[is_leaf]] + 1.05 * size * self.lighting.to_sun
        return points


def _visible_sky_fraction(
    lighting: Lighting, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return the fraction of the sky's light that reaches a place, [N], by closed forms rather
    than rays.
    """
    right_wall, left_wall, top = lighting.canyon
    depth_below_roofs = np.maximum(top - points[:, 2], 0)
    to_left = np.maximum(left_wall - points[:, 1], 0.05)
    to_right = np.maximum(points[:, 1] - right_wall, 0.05)
    left_sine = to_left / np.hypot(to_left, depth_below_roofs)
    right_sine = to_right / np.hypot(to_right, depth_below_roofs)
    sky_fraction = (left_sine + right_sine) / 2  # of an endless street between equal walls
    is_inside_canyon = (points[:, 1] < left_wall + 0.6) & (points[:, 1] > right_wall - 0.6)
    visibility = np.where(is_inside_canyon, 0.42 + 0.58 * sky_fraction, 1.0)
    height = points[:, 2] - lighting.ground_z
    is_upright = is_inside_canyon & (np.abs(normals[:, 2]) < 0.5)
    visibility *= 1 - 0.35 * is_upright * np.exp(-np.maximum(height - 0.05, 0) / 0.35)
    is_ground = (normals[:, 2] > 0.7) & (height < 0.3)
    if len(lighting.footprints) and is_ground.any():
        visibility[is_ground] *= _sky_beside_cars(points[is_ground], lighting.footprints)
    return visibility


def _sky_beside_cars(points: np.ndarray, footprints: np.ndarray) -> np.ndarray:
    """Return the remaining fraction of the sky beside and below parked cars, [N]."""
    visibility = np.ones(len(points))
    for x, y, half_length, half_width in footprints:
        dx = np.maximum(np.abs(points[:, 0] - x) - (half_length - 0.45), 0)
        dy = np.maximum(np.abs(points[:, 1] - y) - (half_width - 0.45), 0)
        distance = np.minimum(np.hypot(dx, dy) - 0.45, 3.0)  # to a rounded rectangle
        visibility *= 1 - 0.85 / (1 + np.exp((distance - 0.02) / 0.13))
    return visibility


def _reflected_radiance(
    lighting: Lighting,
    points: np.ndarray,
    normals: np.ndarray,
    material: np.ndarray,
    sun: np.ndarray,
    sky: np.ndarray,
) -> np.ndarray:
    """Return the reflected radiance [N, 3]: sky above the roofs, the street below, a glint of
    the sun.
    """
    view = points - lighting.eyes_for(points)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    cosine = np.clip(-(view * normals).sum(1), 0, 1)
    reflected = view + 2 * cosine[:, None] * normals
    is_glass = material != Material.PAINT
    fresnel = 0.04 + 0.96 * (1 - cosine) ** 5
    strength = np.where(is_glass, 0.30 + 0.70 * fresnel, fresnel)
    roofs = 0.45 * np.abs(reflected[:, 1]) + 0.05  # how high the far side of the street stands
    roofs += 0.10 * value_noise(points[:, :2] * [0.13, 0.0], 7)
    sky_fraction = 1 / (1 + np.exp(-(reflected[:, 2] - roofs) / 0.04))
    clouds = 0.5 + 0.5 * fractal_noise((points[:, :2] + 6 * reflected[:, :2]) * 0.35, 3, 8)
    elevation_weight = np.clip(reflected[:, 2] * 1.4, 0, 1) * (1 - 0.8 * clouds)
    skylight = MIRROR_LOW_RGB + elevation_weight[:, None] * (MIRROR_HIGH_RGB - MIRROR_LOW_RGB)
    street = 0.75 + 0.5 * value_noise((points + 18 * reflected)[:, [0, 2]] * [0.35, 0.6], 9)
    radiance = sky_fraction[:, None] * skylight
    radiance += ((1 - sky_fraction) * sky * street)[:, None] * MIRROR_RGB
    radiance *= (0.65 + 0.35 / (1 + np.exp(-reflected[:, 2] / 0.02)))[:, None]  # down: the ground
    glint = np.clip(reflected @ lighting.to_sun, 0, 1) ** 180 * 2.5 * (sun > 0)
    return strength[:, None] * radiance + (~is_glass * glint * 0.25)[:, None] * SUN_RGB


def encode_display(radiance: np.ndarray) -> np.ndarray:
    """Return linear radiance as display-encoded sRGB in [0, 1], with a soft shoulder for
    highlights.
    """
    linear = 1 - np.exp(-1.05 * np.maximum(radiance, 0))
    low = 12.92 * linear
    high = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, low, high)


# ---- The sky: a gradient with a sun, cumulus clouds, and a hazy skyline below which land begins --

# Side of a face of the sky's cube map.
SKY_FACE_SIZE_PX = 512
# Linear colour of the sky at the zenith.
ZENITH_RGB = np.array([0.16, 0.34, 0.74])
# Linear colour of the sky at the horizon.
HORIZON_RGB = np.array([0.66, 0.77, 0.92])
# Linear colour of sunlit clouds.
CLOUD_RGB = np.array([1.75, 1.72, 1.68])
# Linear colour of the shaded sides of clouds.
CLOUD_SHADE_RGB = np.array([0.62, 0.67, 0.74])
# Height of the plane in which the clouds lie. It only sets their size relative to the noise.
CLOUD_HEIGHT = 1.0


def direction_to_sun(seed: int) -> np.ndarray:
    """Return the unit vector to the sun: behind one shoulder of the driver, high enough to reach
    the road.
    """
    rng = np.random.default_rng([seed, 6])
    azimuth = np.radians(rng.uniform(118, 150)) * rng.choice([-1, 1])
    height = np.radians(rng.uniform(43, 54))
    flat = np.cos(height)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)])


@lru_cache(maxsize=2)
def build_sky(seed: int) -> CubemapSky:
    """Return a cube map of display-encoded colours. The last two are cached."""
    to_sun = direction_to_sun(seed)
    directions = directions_of_cubemap(SKY_FACE_SIZE_PX).numpy().reshape(-1, 3)
    faces = np.empty_like(directions)
    is_above_horizon = directions[:, 2] > -0.03
    faces[is_above_horizon] = encode_display(_radiance(directions[is_above_horizon], seed, to_sun))
    faces[~is_above_horizon] = encode_display(HAZE_RGB * 0.62)
    cube = faces.reshape(6, SKY_FACE_SIZE_PX, SKY_FACE_SIZE_PX, 3).astype(np.float32)
    return CubemapSky(torch.from_numpy(cube))


def _radiance(directions: np.ndarray, seed: int, to_sun: np.ndarray) -> np.ndarray:
    """Return the linear radiance [N, 3] of directions at or above the horizon."""
    up = np.maximum(directions[:, 2], 0)
    fade = (1 - up) ** 3.2
    sky = ZENITH_RGB + fade[:, None] * (HORIZON_RGB - ZENITH_RGB)
    cosine = np.clip(directions @ to_sun.astype(np.float32), -1, 1)
    glow = 0.35 * np.clip(cosine, 0, 1) ** 12 + 0.8 * np.clip(cosine, 0, 1) ** 220
    sky = sky + glow[:, None] * np.array([1.0, 0.93, 0.80])
    _add_clouds(sky, directions, cosine, seed)
    disc = np.clip((cosine - np.cos(0.013)) / (1 - np.cos(0.013)) * 4, 0, 1)
    sky = sky + disc[:, None] * 12.0
    _add_skyline(sky, directions, seed)
    return sky


def _add_clouds(sky: np.ndarray, directions: np.ndarray, cosine: np.ndarray, seed: int) -> None:
    """Blend cumulus clouds into the sky's radiance [N, 3], in place."""
    up = directions[:, 2]
    is_high = up > 0.02
    d = directions[is_high]
    plane = d[:, :2] / (d[:, 2:] + 0.12) * CLOUD_HEIGHT
    billow = fractal_noise(plane * 1.1, 6, seed * 7 + 100)
    cover = 0.5 + 0.5 * fractal_noise(plane * 0.35, 2, seed * 7 + 200)
    thickness = np.clip((billow + 0.75 * (cover - 0.55)) * 3.2, 0, 1)
    density = thickness * thickness * (3 - 2 * thickness)
    density *= np.clip((up[is_high] - 0.02) / 0.10, 0, 1)
    # The belly of a thick cloud is grey, its rims towards the sun are bright.
    shade = np.clip(thickness * 0.75 - 0.12 * billow, 0, 1)[:, None]
    lit_rgb = CLOUD_RGB * (0.82 + 0.25 * np.clip(cosine[is_high], 0, 1)[:, None] ** 2)
    cloud = lit_rgb * (1 - shade) + CLOUD_SHADE_RGB * 1.35 * shade
    haze = np.exp(-up[is_high] / 0.10)[:, None]
    cloud = cloud * (1 - 0.7 * haze) + HORIZON_RGB * 0.7 * haze
    sky[is_high] = sky[is_high] + density[:, None] * 0.92 * (cloud - sky[is_high])


def _add_skyline(sky: np.ndarray, directions: np.ndarray, seed: int) -> None:
    """Blend two hazy ridges of hills and woods just above the horizon into the radiance, in
    place.
    """
    indices_near_horizon = np.flatnonzero(directions[:, 2] < 0.12)
    d = directions[indices_near_horizon]
    azimuth = np.arctan2(d[:, 1], d[:, 0])
    # On a circle, so that the ridge closes at azimuth +-pi.
    circle = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    far_rgb = np.array([0.50, 0.60, 0.72])
    near_rgb = HAZE_RGB * 0.62
    for scale, base, spread, rgb in ((3.0, 0.030, 0.028, far_rgb), (9.0, 0.012, 0.014, near_rgb)):
        crest = base + spread * fractal_noise(circle * scale, 4, seed * 7 + 300 + int(scale))
        coverage = np.clip((crest - d[:, 2]) / 0.004 + 0.5, 0, 1)[:, None]
        sky[indices_near_horizon] += coverage * (rgb - sky[indices_near_horizon])
