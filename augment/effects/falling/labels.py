"""Rain and snowfall on labelled boxes: transmittance up to each box, and pixels with a drop."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from augment.effects.effect import LabelInputs
from augment.effects.falling.shower import ShowerTable
from augment.effects.smog import box_transmittance
from augment.output.box_tables import BoxTable, pixel_fraction
from augment.render.fog import Fog
from augment.scene.boxes import NOT_COUNTED, WorldBoxes, count_pixels, pixels_of_boxes
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
    if data is not None and data.shower is not None:
        shower = data.shower_about(camera.centre.numpy())
        transmittance = shower_transmittance(boxes, camera, shower, inputs.depth_m)
    else:
        fog = None if data is None else Fog(data.sizes.extinction_per_m, (0.0, 0.0, 0.0))
        estimate = box_transmittance(boxes, camera, fog, inputs.depth_m, inputs.water_level_z_m)
        transmittance = estimate.transmittance
    columns = {
        transmittance_column: transmittance,
        "pixels": np.full(len(boxes), NOT_COUNTED),
        marked_column: np.zeros(len(boxes), np.int64),
    }
    if data is not None and inputs.depth_m is not None and inputs.mask is not None:
        box_pixels = count_pixels(boxes, camera, inputs.depth_m, inputs.mask)
        columns |= {"pixels": box_pixels.num_pixels, marked_column: box_pixels.num_marked}
    return columns


def shower_transmittance(
    boxes: WorldBoxes,
    camera: Camera,
    shower: ShowerTable,
    surface_depth_m: Float32[np.ndarray, "H W"] | None,
) -> Float64[np.ndarray, " B"]:
    """Return the transmittance of a shower between the camera's eye and each box.

    Args:
        boxes: the boxes, in the scene's world.
        camera: camera of the image.
        shower: the shower about the camera.
        surface_depth_m: z of the surfaces that the pixels show, metres, 0 = none. The result is the
            mean over a box's pixels, or, without any, over its corners and its centre.
    """
    eye_m = camera.centre.numpy()
    points = np.concatenate([boxes.corners_m, boxes.centres_m[:, None]], axis=1)  # [B, 9, 3]
    points = np.where(boxes.is_usable[:, None, None], points, eye_m)
    transmittance = np.exp(-shower.optical_depth(points - eye_m)).mean(axis=1)
    if surface_depth_m is not None:
        world_from_camera = camera.world_from_camera[:3, :3].numpy()
        for number, rows, columns in pixels_of_boxes(boxes, camera, surface_depth_m):
            z = surface_depth_m[rows, columns].astype(np.float64)
            if not len(z):
                continue
            across = (columns + 0.5 - camera.cx) / camera.fx
            down = (rows + 0.5 - camera.cy) / camera.fy
            rays = np.stack([z * across, z * down, z], 1) @ world_from_camera.T
            transmittance[number] = float(np.exp(-shower.optical_depth(rays)).mean())
    return np.where(boxes.is_usable, transmittance, np.nan)
