"""The Gaussians that a recipe's snow becomes when a picture needs them."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from augment.boxes import SIDES_M, BoxPixels, PlacedBoxes, count_pixels
from augment.cameras import Camera
from augment.effects.snow.cells import SnowSupport
from augment.effects.snow.layer import build_snow_layer
from augment.effects.snow.light import illumination_of
from augment.effects.snow.near_camera import SnowLayers
from augment.effects.snow.placement import PlacementSettings
from augment.effects.snow.support import support_of
from augment.effects.style.style import SceneStyle
from augment.labels import Boxes
from augment.render.buffers import AUTO
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


# ---- How much of what an image shows of labelled boxes is snow -----------------------------------
# Boxes come in the dataset's world, which lies `world_origin_m` off the scene's.

MARGIN_M = 0.05  # by which splats blur the layer's surface
DRIFTED = 1.5  # how deep drifts make the layer, relative to its depth on level ground
KEPT_OF_HEIGHT = 0.25  # of a low box in deep snow, from its top down


def snow_pixels(
    boxes: Boxes,
    world_origin_m: Float64[np.ndarray, "3"],
    camera: Camera,
    surface_depth_m: Float32[np.ndarray, "H W"],
    snow: UInt8[np.ndarray, "H W"],
    thickness_m: float,
) -> BoxPixels:
    """How many pixels show each box or the snow on it, and how many of them (`marked`) show snow.

    surface_depth_m: z of the first solid surface, snow included; 0 = none. snow: 255 where the
    pixel shows snow. thickness_m: of the layer on level ground.
    """
    placed = placed_in_snow(PlacedBoxes.of(boxes, world_origin_m), thickness_m)
    return count_pixels(placed, camera, surface_depth_m, snow)


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


# ---- Snow laid in a scene, kept for the next frame -----------------------------------------------

_MAX_KEPT = 2  # of a scene, that are kept: a job goes through its variants frame by frame


def placement_settings(snow: Snow) -> PlacementSettings:
    """What of a recipe's snow decides where it can lie."""
    return PlacementSettings(cell_m=snow.cell_m, max_slope_deg=snow.max_slope_deg)


def snow_layers_of(
    scene: Scene, placed: PlacedSnow, style: SceneStyle | None = None, *, backend: str = AUTO
) -> SnowLayers:
    """The snow in the scene; remembered for as long as the scene lives and no third is asked for.

    style: the scene's style, in whose light the snow lies. backend: that finds where snow can lie,
    unless that is known (augment.effects.snow.support).

    Raises:
        SceneError: snow cannot be placed in this scene, or not with cells this small.
    """
    laid = _laid.setdefault(scene, OrderedDict())
    support = support_of(scene, placement_settings(placed.snow), backend=backend)
    laid_on, layers = laid.get((placed, style), (None, None))
    if layers is None or laid_on is not support:
        light = illumination_of(scene if style is None else style.lighting_scene, placed.snow)
        own = {"seed": placed.seed, "water_level_z_m": placed.water_level_z_m}
        layers = build_snow_layer(support, scene, placed.snow, light, **own)
        laid[placed, style] = (support, layers)
    laid.move_to_end((placed, style))
    while len(laid) > _MAX_KEPT:
        laid.popitem(last=False)
    return layers


_Laid = OrderedDict[tuple[PlacedSnow, SceneStyle | None], tuple[SnowSupport, SnowLayers]]
_laid: WeakKeyDictionary[Scene, _Laid] = WeakKeyDictionary()
