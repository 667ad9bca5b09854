"""Showers: rain or snowfall whose rate differs along the wind, in front of a camera and its sky.

The rate R depends on q alone, the distance along the shower's way. A ray from the eye leaves q by c
a metre, so what lies on its first s metres is an integral over q, which a table holds:

    int_0^s k(R) ds' = (G(q + c s) - G(q)) / c          G(q) = int k(R(q')) dq'

k is the extinction by all drops. Rain falls from LAYER_M above the eye, as in
`augment.effects.falling.air`. Above lies the shower's cloud, up to CLOUD_TOP_M: its cover of the
sky follows from the rate, thins out over CLOUD_EDGE_M, and has a table C of its own. Air under a
cloud has less light. The camera's exposure follows the light where the camera is, so a curtain at a
distance is darker than the sky around it while the camera is in the dry, and as bright as rain that
is the same everywhere once the camera is in it. Table E is that of k(R) times this light.

How dark a cloud and the air below it are is assumed: the constants say so.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from augment.effects.falling.drops import Kind, sizes_of
from augment.effects.falling.shower_kernels import LUMP_STEP_M, MIN_ALONG_M, STEP_M
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.rain import OVERCAST_MM_H
from recipes.shower import CLOUD_EDGE_M, MAX_PLACE_RATE_MM_H

# Number of rows, half of them before the eye and half behind.
NUM_ROWS = 8001
# Number of places in each step at which the rate is taken.
_NUM_PLACES = 4
# Share of the light that is left in the air under a cloud. Assumed.
LIGHT_UNDER_CLOUD = 0.6
# Light of a cloud from below, over that of the sky above the horizon. Assumed.
CLOUD_LIGHT = 0.42
# Size of the largest lumps of a cloud's base, metres. Assumed.
LUMP_M = 1500.0
# Number of cells of the tile in each direction.
NUM_LUMPS = 256
# Share of its hue that a cloud keeps of the sky above the horizon. Assumed.
CLOUD_HUE = 0.5
# Smallest rate of the table of extinctions, mm/h; below it, the extinction is in proportion.
_MIN_RATE_MM_H = 1e-3
# Number of rates of that table.
_NUM_RATES = 96


@dataclass(frozen=True)
class Shower:
    """Rates along the way of a shower."""

    places: tuple[tuple[float, float], ...]
    """Distance from the reference place, metres, rising, and rate there, mm/h."""

    direction: tuple[float, float]
    """Unit vector along world x and y in which the shower moves."""

    reference_m: tuple[float, float]
    """Reference place, world x and y."""

    seed: int = 0
    """Seed of the lumps of the cloud."""

    def distance_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return the distance of points [..., 2 or 3] from the reference place, along the way."""
        x = points_m[..., 0] - self.reference_m[0]
        y = points_m[..., 1] - self.reference_m[1]
        return np.asarray(self.direction[0] * x + self.direction[1] * y)

    def rates(self, distance_m: np.ndarray) -> np.ndarray:
        """Return the rates at distances from the reference place, mm/h.

        At a step, it is the rate on the side that the shower comes from.
        """
        known_m, rates = np.array(self.places).T
        after = np.searchsorted(known_m, distance_m, side="left")
        high = np.minimum(after, len(known_m) - 1)
        low = np.maximum(high - 1, 0)
        width = known_m[high] - known_m[low]
        offset = distance_m - known_m[low]
        share = np.divide(offset, width, out=np.ones_like(offset), where=width > 0)
        between = rates[low] + np.clip(share, 0, 1) * (rates[high] - rates[low])
        between = np.where(distance_m <= known_m[0], rates[0], between)
        return np.asarray(np.where(after == len(known_m), rates[-1], between))

    def rate_at(self, point_m: np.ndarray) -> float:
        """Return the rate at a point of the world, mm/h."""
        return float(self.rates(self.distance_m(point_m)))


def reference_place(scene: Scene) -> tuple[float, float]:
    """Return where a recipe's rate falls: world x and y of the drive's first camera.

    It is one place for all images, so that all cameras see one shower, and a place has one rate.
    """
    for frame in scene.frames[:1]:
        for camera in frame.cameras.values():
            x, y = camera.centre.tolist()[:2]
            return x, y
        x, y = frame.world_from_ego[:2, 3].tolist()
        return x, y
    return 0.0, 0.0


@functools.cache
def _extinction_table(kind: Kind) -> tuple[np.ndarray, np.ndarray]:
    """Return logarithms of rates and of their extinctions in 1/m."""
    rates = np.geomspace(_MIN_RATE_MM_H, MAX_PLACE_RATE_MM_H, _NUM_RATES)
    extinctions = [sizes_of.__wrapped__(kind, float(rate)).extinction_per_m for rate in rates]
    return np.log(rates), np.log(extinctions)


def extinctions_of(kind: Kind, rates_mm_h: np.ndarray) -> np.ndarray:
    """Return the extinction of visible light at rates, 1/m, within 1e-4 of that of `sizes_of`."""
    log_rates, log_extinctions = _extinction_table(kind)
    logs = np.log(np.maximum(rates_mm_h, _MIN_RATE_MM_H))
    extinctions = np.exp(np.interp(logs, log_rates, log_extinctions))
    return np.asarray(extinctions * np.minimum(rates_mm_h / _MIN_RATE_MM_H, 1.0))


class ShowerTable(NamedTuple):
    """A shower about one eye. Distances along the way count from the eye."""

    rows: np.ndarray  # float64 [NUM_ROWS, 3]: G, E, and C in metres; each is 0 at the eye
    extinction_per_m: float  # k at the eye
    cloud_cover: float  # share of the sky that cloud covers above the eye
    direction: tuple[float, float]  # as in Shower
    eye_m: tuple[float, float]  # the eye along the way and across it, from the first place
    seed: int  # as in Shower

    def integrals(self, distance_m: np.ndarray) -> np.ndarray:
        """Return G, E and C [..., 3] at distances from the eye along the way."""
        x = distance_m / STEP_M + NUM_ROWS // 2
        low = np.clip(np.floor(x), 0, NUM_ROWS - 2).astype(np.int64)
        share = (x - low)[..., None]
        return self.rows[low] + share * (self.rows[low + 1] - self.rows[low])

    def optical_depth(self, vectors_m: np.ndarray) -> np.ndarray:
        """Return the optical depth [...] on straight ways from the eye.

        Args:
            vectors_m: ends of the ways from the eye, [..., 3].
        """
        lengths = np.sqrt((vectors_m * vectors_m).sum(-1))
        along = self.direction[0] * vectors_m[..., 0] + self.direction[1] * vectors_m[..., 1]
        has_course = np.abs(along) > MIN_ALONG_M
        mean = np.divide(
            self.integrals(along)[..., 0],
            along,
            out=np.full(np.shape(along), self.extinction_per_m),
            where=has_course,
        )
        return np.asarray(lengths * mean)


def shower_about(shower: Shower, kind: Kind, eye_m: np.ndarray) -> ShowerTable:
    """Return the table of a shower about an eye, [2 or 3], world."""
    middle = NUM_ROWS // 2
    eye_along_m = float(shower.distance_m(np.asarray(eye_m, np.float64)))
    offsets = (np.arange(_NUM_PLACES) + 0.5) / _NUM_PLACES
    steps = np.arange(NUM_ROWS - 1) - middle
    places = eye_along_m + STEP_M * (steps[:, None] + offsets)  # [NUM_ROWS - 1, _NUM_PLACES]
    rates = shower.rates(places)
    extinctions = extinctions_of(kind, rates).mean(1)
    covers = _smoothed(-np.expm1(-rates / OVERCAST_MM_H).mean(1))
    cover = float((covers[middle - 1] + covers[middle]) / 2)
    light = 1 - (1 - LIGHT_UNDER_CLOUD) * covers
    light /= 1 - (1 - LIGHT_UNDER_CLOUD) * cover
    parts = np.stack([extinctions, extinctions * np.minimum(light, 1.0), covers], 1)
    rows = np.concatenate([np.zeros((1, 3)), np.cumsum(STEP_M * parts, axis=0)])
    rows -= rows[middle]
    rate = float(shower.rates(np.array(eye_along_m)))
    extinction = float(extinctions_of(kind, np.array(rate)))
    x, y = np.asarray(eye_m, np.float64)[:2] - shower.reference_m
    across_m = float(shower.direction[0] * y - shower.direction[1] * x)
    # The lumps move with the shower, so they count from its first place.
    eye_in_shower_m = (eye_along_m - shower.places[0][0], across_m)
    return ShowerTable(rows, extinction, cover, shower.direction, eye_in_shower_m, shower.seed)


def _smoothed(values: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Return running means over CLOUD_EDGE_M before and behind."""
    reach = round(CLOUD_EDGE_M / STEP_M)
    padded = np.pad(values, reach, mode="edge")
    sums = np.concatenate([[0.0], np.cumsum(padded)])
    width = 2 * reach + 1
    return ((sums[width:] - sums[:-width]) / width).clip(0, 1)


class ShowerInView(NamedTuple):
    """Arguments of `shower_kernels.blend_shower`, float32."""

    rows: np.ndarray  # [NUM_ROWS, 3] as in ShowerTable
    axes: np.ndarray  # [2, 3] the shower's way and across it, along the camera's axes
    at_eye: np.ndarray  # [2] extinction by all drops at the eye, 1/m, and cover of the sky by cloud
    cloud: np.ndarray  # [3] light of a cloud from below, squares of display-encoded colours
    lumps: np.ndarray  # [NUM_LUMPS, NUM_LUMPS] lumps of the cloud, -1 to 1, a tile that repeats
    eye: np.ndarray  # [2] the eye in that tile, in its cells


def shower_in_view(table: ShowerTable, camera: Camera, airlight: np.ndarray) -> ShowerInView:
    """Return a shower as the kernel takes it.

    Args:
        table: the shower about the camera.
        camera: camera of the picture.
        airlight: light of the sky above the horizon as the picture shows it, [3].
    """
    world = camera.world_from_camera[:3, :3].numpy()
    along, across = table.direction
    axes = np.array([[along, across], [-across, along]]) @ world[:2]
    exposure = 1 - (1 - LIGHT_UNDER_CLOUD) * table.cloud_cover
    grey = float(airlight.mean())
    cloud = CLOUD_LIGHT / exposure * (grey + CLOUD_HUE * (airlight - grey))
    at_eye = (table.extinction_per_m, table.cloud_cover)
    eye = np.asarray(table.eye_m) / LUMP_STEP_M % NUM_LUMPS
    numbers = (table.rows, axes, at_eye, cloud, lumps_of_cloud(table.seed), eye)
    return ShowerInView(*(np.asarray(n, np.float32, order="C") for n in numbers))


@functools.lru_cache(maxsize=8)
def lumps_of_cloud(seed: int) -> np.ndarray:
    """Return the lumps of a cloud's base, float32 [NUM_LUMPS, NUM_LUMPS], -1 to 1, periodic.

    Their spectrum falls from LUMP_M on as that of turbulence in a plane, k^(-8/3).
    """
    rng = np.random.default_rng([seed, 0x5EED])
    frequency = np.hypot(np.fft.fftfreq(NUM_LUMPS)[:, None], np.fft.rfftfreq(NUM_LUMPS))
    largest = LUMP_STEP_M / LUMP_M
    amplitude = (frequency**2 + largest**2) ** (-4 / 6)
    amplitude[frequency > 0.15] = 0
    amplitude[0, 0] = 0
    noise = np.fft.rfft2(rng.standard_normal((NUM_LUMPS, NUM_LUMPS)))
    lumps = np.fft.irfft2(noise * amplitude, (NUM_LUMPS, NUM_LUMPS))
    return np.clip(lumps / (2 * lumps.std()), -1, 1).astype(np.float32)
