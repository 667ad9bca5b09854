"""How much of the light of labelled boxes comes through the smog before them.

Boxes come in the dataset's world (`augment.labels`), smog and cameras in the scene's, which is the
dataset's less `world_origin_m`. NumPy on one thread: the numbers depend on no thread count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from augment.box_pixels import NOT_COUNTED, PlacedBoxes, shown_pixels
from augment.cameras import Camera
from augment.labels import Boxes
from augment.weather.smog import MAX_EXPONENT, SmogMedium


@dataclass(frozen=True, eq=False)
class BoxTransmittance:
    """transmittance: 0 to 1, NaN of boxes whose numbers are not finite. pixels: those that it is
    the mean of; where there are none, or they are NOT_COUNTED, it is an estimate.
    """

    transmittance: Float64[np.ndarray, " B"]
    pixels: Int64[np.ndarray, " B"]


def box_transmittance(
    boxes: Boxes,
    world_origin_m: Float64[np.ndarray, "3"],
    camera: Camera,
    medium: SmogMedium | None,
    surface_depth_m: Float32[np.ndarray, "H W"] | None,
    water_level_z_m: float | None = None,
) -> BoxTransmittance:
    """exp(-tau) between the eye and each box, by the smog that the image shows.

    medium: None where there is none, which lets everything through. surface_depth_m: z of what the
    pixels show, 0 = none; it decides which of them show a box, and how far it is there. A box that
    none shows (it is hidden, or out of view) has the mean over its corners and its centre, as has
    any where the depth is not known. water_level_z_m: of the water in the image, scene world;
    an eye in it looks at what else is in it through no smog, as `flood_view` draws it.
    """
    placed = PlacedBoxes.of(boxes, world_origin_m)
    pixels = np.full(len(placed), NOT_COUNTED)
    through = np.ones(len(placed))
    if medium is not None:
        smog = _SmogFromEye(medium, camera.centre.numpy(), water_level_z_m)
        through = _estimate(placed, smog)
        if surface_depth_m is not None:
            pixels[:] = 0
            for number, rows, columns in shown_pixels(placed, camera, surface_depth_m):
                z = surface_depth_m[rows, columns].astype(np.float64)
                pixels[number] = len(rows)
                through[number] = _mean_over_pixels(rows, columns, z, camera, smog)
    return BoxTransmittance(np.where(placed.is_finite, through, np.nan), pixels)


@dataclass(frozen=True, eq=False)
class _SmogFromEye:
    medium: SmogMedium
    eye_m: np.ndarray  # float64 [3], scene world
    water_level_z_m: float | None

    def transmittance(self, distance_m: np.ndarray, point_z_m: np.ndarray) -> np.ndarray:
        """Of the ways to points at a distance from the eye (float64, any shape)."""
        through = np.exp(-optical_depth(self.medium, distance_m, self.eye_m[2], point_z_m))
        level = self.water_level_z_m
        if level is None or self.eye_m[2] > level:
            return through
        return np.where(point_z_m <= level, 1.0, through)


def optical_depth(
    medium: SmogMedium, distance_m: np.ndarray, eye_z_m: float, point_z_m: np.ndarray
) -> np.ndarray:
    """`smog.optical_depth` of NumPy arrays."""
    uniform = medium.sigma_per_m * distance_m
    if medium.scale_height_m is None:
        return uniform
    a = (eye_z_m - medium.base_z_m) / medium.scale_height_m
    b = (point_z_m - medium.base_z_m) / medium.scale_height_m
    difference = np.abs(b - a)
    small = difference < 1e-8  # there 1 - x/2 is exact to float64
    safe = np.where(small, 1.0, difference)
    mean = np.where(small, 1 - difference / 2, -np.expm1(-safe) / safe)
    return uniform * np.exp(np.minimum(-np.minimum(a, b), MAX_EXPONENT)) * mean


def _estimate(placed: PlacedBoxes, smog: _SmogFromEye) -> np.ndarray:
    """float64 [B]: the mean over each box's corners and its centre."""
    points = np.concatenate([placed.corners_m, placed.centres_m[:, None]], axis=1)  # [B, 9, 3]
    distance = np.linalg.norm(points - smog.eye_m, axis=-1)
    return smog.transmittance(distance, points[..., 2]).mean(axis=1)


def _mean_over_pixels(
    rows: np.ndarray, columns: np.ndarray, z: np.ndarray, camera: Camera, smog: _SmogFromEye
) -> float:
    """z: depth of what the pixels show, float64, metres."""
    across = (columns + 0.5 - camera.cx) / camera.fx
    down = (rows + 0.5 - camera.cy) / camera.fy
    upwards = camera.world_from_camera[2, :3].numpy()  # the world's z along the camera's axes
    point_z = smog.eye_m[2] + z * (across * upwards[0] + down * upwards[1] + upwards[2])
    return float(smog.transmittance(z * np.sqrt(1 + across**2 + down**2), point_z).mean())
