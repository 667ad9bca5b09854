"""The snow of a recipe before it is laid in a scene, and labelled boxes with snow on them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from augment.boxes import SIDES_M, BoxPixels, PlacedBoxes, count_pixels
from augment.cameras import Camera
from augment.effects.snow.placement import PlacementSettings, has_invented_drive
from augment.scene import Scene
from recipes.snow import Snow


@dataclass(frozen=True)
class PlacedSnow:
    """Snow of one recipe. seed: of its drifts. water_level_z_m: of the flood that melts what it
    reaches, scene world; None without one.
    """

    snow: Snow
    seed: int
    water_level_z_m: float | None = None


def placement_settings(snow: Snow, scene: Scene) -> PlacementSettings:
    """Return the settings of a recipe's snow that decide where it can lie in a scene."""
    return PlacementSettings(
        cell_m=snow.cell_m,
        max_slope_deg=snow.max_slope_deg,
        invented_tracks=snow.tracks == "always" and has_invented_drive(scene),
    )


# ---- How much of what an image shows of labelled boxes is snow -----------------------------------

MARGIN_M = 0.05  # by which splats blur the layer's surface
DRIFTED = 1.5  # how deep drifts make the layer, relative to its depth on level ground
KEPT_OF_HEIGHT = 0.25  # of a low box in deep snow, from its top down


def snow_pixels(
    placed: PlacedBoxes,
    camera: Camera,
    surface_depth_m: Float32[np.ndarray, "H W"],
    snow: UInt8[np.ndarray, "H W"],
    thickness_m: float,
) -> BoxPixels:
    """How many pixels show each box or the snow on it, and how many of them (`marked`) show snow.

    surface_depth_m: z of the first solid surface, snow included; 0 = none. snow: 255 where the
    pixel shows snow. thickness_m: of the layer on level ground.
    """
    return count_pixels(placed_in_snow(placed, thickness_m), camera, surface_depth_m, snow)


def placed_in_snow(placed: PlacedBoxes, thickness_m: float) -> PlacedBoxes:
    """The boxes with the snow on them. thickness_m: of the layer on level ground.

    The top of a box is raised, for the snow on it counts as the box; so is its bottom, for the snow
    around its wheels does not.
    """
    height = placed.sizes_m[:, 2]
    low, high = placed.low_m.copy(), placed.high_m.copy()
    above_ground = np.minimum(thickness_m + MARGIN_M, (1 - KEPT_OF_HEIGHT) * height)
    low[:, 2] = np.maximum(low[:, 2], above_ground - height / 2)
    high[:, 2] = height / 2 + max(SIDES_M, DRIFTED * thickness_m + MARGIN_M)
    return dataclasses.replace(placed, low_m=low, high_m=high)
