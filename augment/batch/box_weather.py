"""All that weather does to the boxes of an image, by the manifest's kind of path."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from augment.batch.box_tables import BoxNumbers, BoxTable
from augment.batch.smog_labels import SMOG_TABLE, BoxSmog, measure_smog
from augment.batch.snow_labels import SNOW_TABLE, BoxSnow, measure_snow
from augment.batch.water_labels import WATER_TABLE, BoxWater, measure_water
from augment.batch.writer import View
from augment.cameras import Camera
from augment.labels import Boxes

BoxWeather = Mapping[str, BoxNumbers]  # what each effect in a view does to the boxes, by kind
TABLES: Mapping[str, BoxTable[Any]] = {
    "box_water": WATER_TABLE,
    "box_snow": SNOW_TABLE,
    "box_smog": SMOG_TABLE,
}


def has_box_weather(view: View) -> bool:
    """Whether the view has an effect that boxes are measured for."""
    return any(fact is not None for fact in (view.flood, view.snowy, view.smoggy))


def measure_boxes(
    boxes: Boxes, world_origin_m: np.ndarray, camera: Camera, view: View
) -> BoxWeather:
    """The boxes of a frame in one of its images. camera: at the written resolution.

    view: one that `writer.check_view` has passed.
    """
    measured: dict[str, BoxNumbers] = {}
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
