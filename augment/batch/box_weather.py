"""All that is measured of the boxes of an image, by the manifest's kind of path: what of each it
shows, and what the weather does to them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from augment.batch.box_tables import BoxNumbers, BoxTable
from augment.batch.boxes_2d import BOX_2D_TABLE, measure_2d
from augment.batch.smog_labels import SMOG_TABLE, BoxSmog, measure_smog
from augment.batch.snow_labels import SNOW_TABLE, BoxSnow, measure_snow
from augment.batch.water_labels import WATER_TABLE, BoxWater, measure_water
from augment.batch.writer import View
from augment.box_pixels import PlacedBoxes
from augment.cameras import Camera
from augment.instances import Instances, with_boxes
from augment.labels import Boxes
from augment.snow.labels import placed_in_snow
from recipes.schema import Recipe

# What is seen of the boxes in a view, and what each effect there does to them, by kind.
BoxWeather = Mapping[str, BoxNumbers]
TABLES: Mapping[str, BoxTable[Any]] = {
    "box_2d": BOX_2D_TABLE,
    "box_water": WATER_TABLE,
    "box_snow": SNOW_TABLE,
    "box_smog": SMOG_TABLE,
}


def uses_boxes(recipe: Recipe) -> bool:
    """Whether images of the recipe take the boxes of their frame."""
    return recipe.output.labels or recipe.output.instance


def label_view(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: View,
    recipe: Recipe,
) -> tuple[View, BoxWeather]:
    """One of a frame's images with the frame's boxes: in the instance image those that have no
    actor, too; and what is measured of them, where labels are written.

    camera: at the written resolution. view: one that `writer.check_view` has passed.
    """
    measured: BoxWeather = {}
    if recipe.output.labels:
        measured = measure_boxes(boxes, instances, world_origin_m, camera, view)
    surface = view.surface
    if view.instance is None or surface is None:
        return view, measured
    assert surface.shown_depth_m is not None and surface.shown_classes is not None
    placed = PlacedBoxes.of(boxes, world_origin_m)
    if surface.shown_snow_m:
        placed = placed_in_snow(placed, surface.shown_snow_m)
    painted = with_boxes(
        view.instance,
        placed,
        instances.of(boxes.track_ids),
        camera,
        surface.shown_depth_m,
        surface.shown_classes,
        len(instances.actors),
    )
    changed: Any = view
    return dataclasses.replace(changed, instance=painted), measured


def measure_boxes(
    boxes: Boxes, instances: Instances, world_origin_m: np.ndarray, camera: Camera, view: View
) -> BoxWeather:
    """The boxes of a frame in one of its images; camera and view as for `label_view`."""
    measured: dict[str, BoxNumbers] = {}
    if view.surface is not None:
        measured["box_2d"] = measure_2d(boxes, instances, world_origin_m, camera, view.surface)
    if view.flood is not None:
        assert view.water is not None
        measured["box_water"] = measure_water(boxes, world_origin_m, camera, view.water, view.flood)
    if view.snowy is not None:
        assert view.snow is not None
        measured["box_snow"] = measure_snow(boxes, world_origin_m, camera, view.snow, view.snowy)
    if view.smoggy is not None:
        measured["box_smog"] = measure_smog(boxes, world_origin_m, camera, view.smoggy)
    return measured


def visibility(weather: BoxWeather, count: int) -> Float64[np.ndarray, " B"]:
    """What the weather leaves of each box: transmittance of the smog, times the part of its pixels
    that no water hides, times the part that no snow covers; [count], 0 to 1.

    An effect that there is not, or that says nothing of a box (NaN: no pixel shows it, or its own
    numbers are not finite), takes nothing from it. So this is no answer to whether a box is in
    view, or behind another: `pixels` of the tables is.
    """
    factors = [np.ones(count)]
    if (smog := weather.get("box_smog")) is not None:
        assert isinstance(smog, BoxSmog)
        factors.append(smog.transmittance)
    if (water := weather.get("box_water")) is not None:
        assert isinstance(water, BoxWater)
        factors.append(1 - water.hidden_fraction)
    if (snow := weather.get("box_snow")) is not None:
        assert isinstance(snow, BoxSnow)
        factors.append(1 - snow.snow_fraction)
    return np.prod([np.where(np.isnan(factor), 1.0, factor) for factor in factors], axis=0)
