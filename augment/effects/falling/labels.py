"""Rain and snowfall on labelled boxes: transmittance up to each box, and pixels with a drop."""

from __future__ import annotations

import numpy as np

from augment.boxes import NOT_COUNTED, PlacedBoxes, count_pixels
from augment.cameras import Camera
from augment.effects.effect import EffectView
from augment.effects.smog import box_transmittance
from augment.jobs.box_tables import BoxTable, share_of_pixels
from augment.render.fog import Fog


def falling_table(name: str, drop: str) -> BoxTable:
    """Return the label table of an effect. drop: `streak` or `flake`.

    Columns:
        {name}_transmittance: 0 to 1, of all drops between camera and box, drawn or veil; NaN for a
            box whose numbers are not finite.
        pixels: number of pixels that show the box, or NOT_COUNTED.
        {drop}_pixels: number of those pixels that lie in the effect's mask.
    """
    through = f"{name}_transmittance"
    marked = f"{drop}_pixels"
    share = f"{drop}_fraction"
    return BoxTable(
        name=f"box_{name}",
        file=f"labels/{name}.parquet",
        kind=f"box {name}",
        columns={through: np.float64, "pixels": np.int64, marked: np.int64, share: np.float64},
        sampled=(through, share),
        derived={share: share_of_pixels(marked)},
        visible=through,
    )


def measure_falling(
    table: BoxTable, placed: PlacedBoxes, camera: Camera, view: EffectView
) -> dict[str, np.ndarray]:
    """Return the stored columns of a `falling_table`.

    The transmittance is the mean by distance, as in the veil. Drawn drops take as much on average.
    """
    through, _, marked = table.stored
    data = view.placed.data
    fog = None if data is None else Fog(data.sizes.extinction_per_m, (0.0, 0.0, 0.0))
    estimate = box_transmittance(placed, camera, fog, view.depth_m, view.water_level_z_m)
    stored = {
        through: estimate.transmittance,
        "pixels": np.full(len(placed), NOT_COUNTED),
        marked: np.zeros(len(placed), np.int64),
    }
    if data is not None and view.depth_m is not None and view.mask is not None:
        counted = count_pixels(placed, camera, view.depth_m, view.mask)
        stored |= {"pixels": counted.pixels, marked: counted.marked}
    return stored
