"""Rain and snowfall on labelled boxes: transmittance up to each box, and pixels with a drop."""

from __future__ import annotations

import numpy as np

from augment.effects.effect import LabelInputs
from augment.effects.smog import box_transmittance, mean_transmittance
from augment.output.box_tables import BoxTable, pixel_fraction
from augment.render.fog import Fog
from augment.scene.boxes import NOT_COUNTED, WorldBoxes, count_pixels
from augment.scene.cameras import Camera


def falling_table(name: str, drop: str) -> BoxTable:
    """Return the label table of an effect. drop: `streak` or `flake`.

    Columns:
        {name}_transmittance: 0 to 1, of all drops between camera and box, drawn or veil; NaN for a
            box whose numbers are not finite.
        pixels: number of pixels that show the box, or NOT_COUNTED.
        {drop}_pixels: number of those pixels that lie in the effect's mask.
    """
    transmittance_column = f"{name}_transmittance"
    marked_column = f"{drop}_pixels"
    share_column = f"{drop}_fraction"
    return BoxTable(
        name=f"box_{name}",
        file=f"labels/{name}.parquet",
        kind=f"box {name}",
        columns={
            transmittance_column: np.float64,
            "pixels": np.int64,
            marked_column: np.int64,
            share_column: np.float64,
        },
        sample_columns=(transmittance_column, share_column),
        derived_columns={share_column: pixel_fraction(marked_column)},
        visible_column=transmittance_column,
    )


def measure_falling(
    table: BoxTable, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
) -> dict[str, np.ndarray]:
    """Return the stored columns of a `falling_table`.

    The transmittance is the mean by distance, as in the veil. Drawn drops take as much on average.
    """
    transmittance_column, _, marked_column = table.stored_columns
    data = inputs.plan.data
    surfaces = (inputs.depth_m, inputs.water_level_z_m)
    shower = None if data is None else data.shower_about(camera.centre.numpy())
    if shower is not None:
        eye_m = camera.centre.numpy()
        estimate = mean_transmittance(
            boxes, camera, lambda points_m: shower.optical_depth(points_m - eye_m), *surfaces
        )
    else:
        fog = None if data is None else Fog(data.sizes.extinction_per_m, (0.0, 0.0, 0.0))
        estimate = box_transmittance(boxes, camera, fog, *surfaces)
    columns = {
        transmittance_column: estimate.transmittance,
        "pixels": np.full(len(boxes), NOT_COUNTED),
        marked_column: np.zeros(len(boxes), np.int64),
    }
    if data is not None and inputs.depth_m is not None and inputs.mask is not None:
        box_pixels = count_pixels(boxes, camera, inputs.depth_m, inputs.mask)
        columns |= {"pixels": box_pixels.num_pixels, marked_column: box_pixels.num_marked}
    return columns
