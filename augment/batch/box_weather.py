"""All that weather does to the boxes of an image, by the manifest's kind of path."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from augment.batch.box_tables import BoxNumbers, BoxTable
from augment.batch.snow_labels import SNOW_TABLE, measure_snow
from augment.batch.water_labels import WATER_TABLE, measure_water
from augment.batch.writer import View
from augment.cameras import Camera
from augment.labels import Boxes

BoxWeather = Mapping[str, BoxNumbers]  # what each effect in a view does to the boxes, by kind
TABLES: Mapping[str, BoxTable[Any]] = {"box_water": WATER_TABLE, "box_snow": SNOW_TABLE}


def has_box_weather(view: View) -> bool:
    """Whether the view has an effect that boxes are measured for."""
    return view.flood is not None or view.snowy is not None


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
    return measured
