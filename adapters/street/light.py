"""Baked light: a sun with soft shadows, sky light in a street canyon, mirrors, haze, exposure.

All light is a function of the place on a surface. What depends on the viewer (the sky in a window,
the shine of paint) is worked out for one viewer, at the nearest point of the ego cameras' path.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from adapters.street.forms import Material, Shapes, albedo, fractal_noise, value_noise
from adapters.street.raycast import Tree
from augment.sky import CubemapSky, directions_of_cubemap

SUN_RGB = np.array([1.0, 0.91, 0.76]) * 2.75
SKY_RGB = np.array([0.66, 0.77, 0.98]) * 1.0
BOUNCE_RGB = np.array([0.55, 0.50, 0.44]) * 0.50
HAZE_RGB = np.array([0.64, 0.73, 0.83])
SUN_SAMPLES = 8
SUN_RADIUS_RAD = 0.018  # four times the real sun: shadow edges as soft as the splats are wide
SHADOW_OFFSET_M = 0.004
# What panes and paint mirror: the far side of the street, and the sky low and high.
MIRROR_RGB = np.array([0.42, 0.38, 0.34])
MIRROR_LOW_RGB, MIRROR_HIGH_RGB = np.array([0.75, 0.86, 1.0]), np.array([0.28, 0.45, 0.85])


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light in one body's frame. to_sun [3]: unit. eye_path [2, 3]: segment the cameras move along.

    canyon: y of the street's right and left walls, z of their tops. sunlit: share of its way that
    the body spends in the sun. footprints [C, 4]: x, y and half sizes of parked cars, which keep
    sky light off the ground.
    """

    to_sun: np.ndarray
    eye_path: np.ndarray
    canyon: tuple[float, float, float]
    ground_z: float = 0.0
    sunlit: float = 1.0
    footprints: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4)))

    def sun_directions(self) -> np.ndarray:
        """[SUN_SAMPLES, 3] unit vectors spread over the sun's disc (a sunflower pattern)."""
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
        """The nearest place of the cameras' path to each point, [N, 3]."""
        start, end = self.eye_path
        along = end - start
        length = max(float(along @ along), 1e-9)
        fraction = np.clip((points - start) @ along / length, 0, 1)
        return start + fraction[:, None] * along


@dataclass(frozen=True, eq=False)
class Body:
    """Shapes that move together, how rays meet them, and their light, in one frame."""

    shapes: Shapes
    tree: Tree
    lighting: Lighting

    def colors(self, shape: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Display-encoded colour [N, 3] on shapes [N], averaged over local places [G, N, 3].

        Albedo and the sun's shadows are averaged; other light is taken at the first place.
        """
        shapes, lighting, local = self.shapes, self.lighting, places[0]
        base = np.zeros((len(shape), 3))
        for place in places:
            base += albedo(shapes, shape, place)
        points, smooth = shapes.points(shape, local), shapes.shading_normals(shape, local)
        facing = smooth @ lighting.to_sun
        leaf = shapes.material[shape] == Material.LEAF  # light also comes through from behind
        facing = np.maximum(np.where(leaf, 0.35 + 0.65 * np.abs(facing), facing), 0)
        sun = facing * self._sun_share(shape, places, facing > 0) * lighting.sunlit
        sky = _sky_share(lighting, points, smooth) * shapes.ambient[shape]
        upward = 0.5 + 0.5 * smooth[:, 2]
        ambient = sky[:, None] * (upward[:, None] * SKY_RGB + (1 - upward)[:, None] * BOUNCE_RGB)
        radiance = base / len(places) * (sun[:, None] * SUN_RGB + ambient)
        material = shapes.material[shape]
        glossy = np.isin(material, (Material.GLASS, Material.SHOP, Material.PAINT))
        if glossy.any():
            given = (points, smooth, material, sun, sky)
            radiance[glossy] += _mirrored(lighting, *(values[glossy] for values in given))
        # Far things pale towards the horizon, by their distance to the cameras' path.
        distance = np.linalg.norm(points - lighting.eyes_for(points), axis=1)
        veil = 1 - np.exp(-np.maximum(distance - 25, 0) / 260)
        return encode_display(radiance * (1 - veil)[:, None] + veil[:, None] * HAZE_RGB * 0.8)

    def _sun_share(self, shape: np.ndarray, places: np.ndarray, lit: np.ndarray) -> np.ndarray:
        """Share of the sun's disc that is seen where shapes are lit, [N], averaged over the places
        (G divides SUN_SAMPLES). Half of the rays are cast first; the others only where those
        disagree."""
        directions = self.lighting.sun_directions()
        seen, index = np.zeros(len(shape)), np.flatnonzero(lit)
        for half in range(2):
            for number in range(half, SUN_SAMPLES, 2):
                local = places[(number // 2) % len(places), index]
                origins = self._off_surface(shape[index], local)
                seen[index] += ~self.tree.occluded(origins, directions[number])
            if half == 0:
                doubtful = (seen[index] > 0) & (seen[index] < SUN_SAMPLES / 2)
                seen[index[~doubtful]] *= 2
                index = index[doubtful]
        return seen / SUN_SAMPLES

    def _off_surface(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Where rays to the sun start: just outside; all of a leaf tuft starts at its sunny end."""
        shapes = self.shapes
        points = shapes.points(shape, local) + SHADOW_OFFSET_M * shapes.normals(shape, local)
        leaf = shapes.material[shape] == Material.LEAF
        size = np.linalg.norm(shapes.axes[shape[leaf]], axis=2).max(1, keepdims=True)
        points[leaf] = shapes.origin[shape[leaf]] + 1.05 * size * self.lighting.to_sun
        return points


def _sky_share(lighting: Lighting, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Share of the sky's light that reaches a place, by closed forms rather than rays, [N]."""
    right_wall, left_wall, top = lighting.canyon
    below = np.maximum(top - points[:, 2], 0)
    to_left = np.maximum(left_wall - points[:, 1], 0.05)
    to_right = np.maximum(points[:, 1] - right_wall, 0.05)
    left, right = to_left / np.hypot(to_left, below), to_right / np.hypot(to_right, below)
    open_sky = (left + right) / 2  # of an endless street between equal walls
    inside = (points[:, 1] < left_wall + 0.6) & (points[:, 1] > right_wall - 0.6)
    share = np.where(inside, 0.42 + 0.58 * open_sky, 1.0)
    height = points[:, 2] - lighting.ground_z
    upright = inside & (np.abs(normals[:, 2]) < 0.5)
    share *= 1 - 0.35 * upright * np.exp(-np.maximum(height - 0.05, 0) / 0.35)
    ground = (normals[:, 2] > 0.7) & (height < 0.3)
    if len(lighting.footprints) and ground.any():
        share[ground] *= _under_cars(points[ground], lighting.footprints)
    return share


def _under_cars(points: np.ndarray, footprints: np.ndarray) -> np.ndarray:
    """What is left of the sky beside and below parked cars, [N]."""
    left = np.ones(len(points))
    for x, y, half_length, half_width in footprints:
        dx = np.maximum(np.abs(points[:, 0] - x) - (half_length - 0.45), 0)
        dy = np.maximum(np.abs(points[:, 1] - y) - (half_width - 0.45), 0)
        distance = np.minimum(np.hypot(dx, dy) - 0.45, 3.0)  # to a rounded rectangle
        left *= 1 - 0.85 / (1 + np.exp((distance - 0.02) / 0.13))
    return left


def _mirrored(
    lighting: Lighting, points: np.ndarray, normals: np.ndarray, material: np.ndarray,
    sun: np.ndarray, sky: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Reflected radiance [N, 3]: sky above the roofs, the street below, a glint of the sun."""
    view = points - lighting.eyes_for(points)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    cosine = np.clip(-(view * normals).sum(1), 0, 1)
    reflected = view + 2 * cosine[:, None] * normals
    is_glass = material != Material.PAINT
    fresnel = 0.04 + 0.96 * (1 - cosine) ** 5
    strength = np.where(is_glass, 0.30 + 0.70 * fresnel, fresnel)
    roofs = 0.45 * np.abs(reflected[:, 1]) + 0.05  # how high the far side of the street stands
    roofs += 0.10 * value_noise(points[:, :2] * [0.13, 0.0], 7)
    seen = 1 / (1 + np.exp(-(reflected[:, 2] - roofs) / 0.04))
    clouds = 0.5 + 0.5 * fractal_noise((points[:, :2] + 6 * reflected[:, :2]) * 0.35, 3, 8)
    high = np.clip(reflected[:, 2] * 1.4, 0, 1) * (1 - 0.8 * clouds)
    skylight = MIRROR_LOW_RGB + high[:, None] * (MIRROR_HIGH_RGB - MIRROR_LOW_RGB)
    street = 0.75 + 0.5 * value_noise((points + 18 * reflected)[:, [0, 2]] * [0.35, 0.6], 9)
    mirrored = seen[:, None] * skylight
    mirrored += ((1 - seen) * sky * street)[:, None] * MIRROR_RGB
    mirrored *= (0.65 + 0.35 / (1 + np.exp(-reflected[:, 2] / 0.02)))[:, None]  # down: the ground
    glint = np.clip(reflected @ lighting.to_sun, 0, 1) ** 180 * 2.5 * (sun > 0)
    return strength[:, None] * mirrored + (~is_glass * glint * 0.25)[:, None] * SUN_RGB


def encode_display(radiance: np.ndarray) -> np.ndarray:
    """Display-encoded sRGB in [0, 1] of linear radiance, with a soft shoulder for highlights."""
    linear = 1 - np.exp(-1.05 * np.maximum(radiance, 0))
    low = 12.92 * linear
    high = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, low, high)


# ---- The sky: a gradient with a sun, cumulus clouds, and a hazy skyline below which land begins --

FACE_SIZE = 512
ZENITH_RGB = np.array([0.16, 0.34, 0.74])
HORIZON_RGB = np.array([0.66, 0.77, 0.92])
CLOUD_RGB = np.array([1.75, 1.72, 1.68])
CLOUD_SHADE_RGB = np.array([0.62, 0.67, 0.74])
CLOUD_HEIGHT = 1.0  # clouds lie on a plane; its height only sets their size against the noise


def direction_to_sun(seed: int) -> np.ndarray:
    """Unit vector to the sun: behind one shoulder of the driver, high enough to reach the road."""
    rng = np.random.default_rng([seed, 6])
    azimuth = np.radians(rng.uniform(118, 150)) * rng.choice([-1, 1])
    height = np.radians(rng.uniform(43, 54))
    flat = np.cos(height)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)])


@lru_cache(maxsize=2)
def build_sky(seed: int) -> CubemapSky:
    """A cubemap of display-encoded colours; the last two are kept."""
    to_sun = direction_to_sun(seed)
    directions = directions_of_cubemap(FACE_SIZE).numpy().reshape(-1, 3)
    faces = np.empty_like(directions)
    above = directions[:, 2] > -0.03
    faces[above] = encode_display(_radiance(directions[above], seed, to_sun))
    faces[~above] = encode_display(HAZE_RGB * 0.62)
    cube = faces.reshape(6, FACE_SIZE, FACE_SIZE, 3).astype(np.float32)
    return CubemapSky(torch.from_numpy(cube))


def _radiance(directions: np.ndarray, seed: int, to_sun: np.ndarray) -> np.ndarray:
    """Linear radiance [N, 3] of directions at or above the horizon."""
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
    up = directions[:, 2]
    high = up > 0.02
    d = directions[high]
    plane = d[:, :2] / (d[:, 2:] + 0.12) * CLOUD_HEIGHT
    billow = fractal_noise(plane * 1.1, 6, seed * 7 + 100)
    cover = 0.5 + 0.5 * fractal_noise(plane * 0.35, 2, seed * 7 + 200)
    thick = np.clip((billow + 0.75 * (cover - 0.55)) * 3.2, 0, 1)
    density = thick * thick * (3 - 2 * thick)
    density *= np.clip((up[high] - 0.02) / 0.10, 0, 1)
    # The belly of a thick cloud is grey, its rims towards the sun are bright.
    shade = np.clip(thick * 0.75 - 0.12 * billow, 0, 1)[:, None]
    lit = CLOUD_RGB * (0.82 + 0.25 * np.clip(cosine[high], 0, 1)[:, None] ** 2)
    cloud = lit * (1 - shade) + CLOUD_SHADE_RGB * 1.35 * shade
    far = np.exp(-up[high] / 0.10)[:, None]
    cloud = cloud * (1 - 0.7 * far) + HORIZON_RGB * 0.7 * far
    sky[high] = sky[high] + density[:, None] * 0.92 * (cloud - sky[high])


def _add_skyline(sky: np.ndarray, directions: np.ndarray, seed: int) -> None:
    """Two hazy ridges of hills and woods just above the horizon."""
    near_horizon = np.flatnonzero(directions[:, 2] < 0.12)
    d = directions[near_horizon]
    azimuth = np.arctan2(d[:, 1], d[:, 0])
    # On a circle, so that the ridge closes at azimuth +-pi.
    circle = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    far, near = np.array([0.50, 0.60, 0.72]), HAZE_RGB * 0.62
    for scale, base, spread, rgb in ((3.0, 0.030, 0.028, far), (9.0, 0.012, 0.014, near)):
        crest = base + spread * fractal_noise(circle * scale, 4, seed * 7 + 300 + int(scale))
        inside = np.clip((crest - d[:, 2]) / 0.004 + 0.5, 0, 1)[:, None]
        sky[near_horizon] += inside * (rgb - sky[near_horizon])
