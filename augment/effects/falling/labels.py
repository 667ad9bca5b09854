"""What rain and snowfall do to labelled boxes: how much of their light comes through, and how many
of their pixels show a drop.
"""

from __future__ import annotations

import numpy as np

from augment.boxes import NOT_COUNTED, PlacedBoxes, count_pixels
from augment.cameras import Camera
from augment.effects.effect import EffectView
from augment.effects.smog import box_transmittance
from augment.jobs.box_tables import BoxTable, share_of_pixels
from augment.render.fog import Fog


def falling_table(name: str, drop: str) -> BoxTable:
    """The table of an effect. drop: what falls, `streak` or `flake`.

    {name}_transmittance: 0 to 1, of all drops between camera and box, drawn or veil; NaN of a box
    whose numbers are not finite. pixels: that show the box, or NOT_COUNTED. {drop}_pixels: those
    of them in the effect's mask.
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
    """The stored columns of a falling_table. Drops count on average by distance, as in the veil:
    those that are drawn take as much, somewhere near.
    """
    through, _, marked = table.stored
    data = view.placed.data
    medium = None if data is None else Fog(data.sizes.extinction_per_m, (0.0, 0.0, 0.0))
    found = box_transmittance(placed, camera, medium, view.depth_m, view.water_level_z_m)
    stored = {
        through: found.transmittance,
        "pixels": np.full(len(placed), NOT_COUNTED),
        marked: np.zeros(len(placed), np.int64),
    }
    if data is not None and view.depth_m is not None and view.mask is not None:
        counted = count_pixels(placed, camera, view.depth_m, view.mask)
        stored |= {"pixels": counted.pixels, marked: counted.marked}
    return stored
