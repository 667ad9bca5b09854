"""Smog, haze and fog as an effect of a recipe, and the labels of boxes in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from augment.boxes import NOT_COUNTED, PlacedBoxes, shown_pixels
from augment.cameras import Camera
from augment.labels import Boxes
from augment.render.fog import Fog, optical_depth_of_arrays

# ---- How much of the light of labelled boxes comes through the smog before them ------------------
# Boxes come in the dataset's world, which lies `world_origin_m` off the scene's. NumPy on one
# thread: the numbers depend on no thread count.


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
    medium: Fog | None,
    surface_depth_m: Float32[np.ndarray, "H W"] | None,
    water_level_z_m: float | None = None,
) -> BoxTransmittance:
    """exp(-tau) between the eye and each box, by the smog that the image shows.

    surface_depth_m: z of what the pixels show, 0 = none; it decides which of them show a box, and
    how far it is there. A box that none shows, or any where depth is not known, has the mean over
    its corners and its centre. water_level_z_m: scene world; an eye in the water looks at what
    else is in it through no smog, as `flood_view` draws it.
    """
    placed = PlacedBoxes.of(boxes, world_origin_m)
    pixels = np.full(len(placed), NOT_COUNTED)
    transmittance = np.ones(len(placed))
    if medium is None:
        return BoxTransmittance(np.where(placed.is_finite, transmittance, np.nan), pixels)
    eye_m = camera.centre.numpy()
    is_dry = water_level_z_m is None or eye_m[2] > water_level_z_m

    def transmittance_to(distance_m: np.ndarray, point_z_m: np.ndarray) -> np.ndarray:
        t = np.exp(-optical_depth_of_arrays(medium, distance_m, eye_m[2], point_z_m))
        return t if is_dry else np.where(point_z_m <= water_level_z_m, 1.0, t)

    points = np.concatenate([placed.corners_m, placed.centres_m[:, None]], axis=1)  # [B, 9, 3]
    distance = np.linalg.norm(points - eye_m, axis=-1)
    transmittance = transmittance_to(distance, points[..., 2]).mean(axis=1)
    if surface_depth_m is not None:
        pixels[:] = 0
        upwards = camera.world_from_camera[2, :3].numpy()  # the world's z along the camera's axes
        for number, rows, columns in shown_pixels(placed, camera, surface_depth_m):
            z = surface_depth_m[rows, columns].astype(np.float64)
            across = (columns + 0.5 - camera.cx) / camera.fx
            down = (rows + 0.5 - camera.cy) / camera.fy
            point_z = eye_m[2] + z * (across * upwards[0] + down * upwards[1] + upwards[2])
            distance = z * np.sqrt(1 + across**2 + down**2)
            pixels[number] = len(rows)
            transmittance[number] = float(transmittance_to(distance, point_z).mean())
    return BoxTransmittance(np.where(placed.is_finite, transmittance, np.nan), pixels)
