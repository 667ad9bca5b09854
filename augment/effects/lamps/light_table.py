"""Lamps in labels: the light on each labelled box, its contrast, its lamps, and glare over it."""

from __future__ import annotations

import math

import numpy as np

from augment.effects.effect import LabelInputs
from augment.effects.lamps.plan import LightPlan
from augment.effects.lamps.view_lamps import lamps_at
from augment.lamps.surface_light import illuminance
from augment.output.box_tables import BoxTable, pixel_fraction
from augment.scene.boxes import NOT_COUNTED, WorldBoxes, count_pixels
from augment.scene.cameras import Camera

# Reflectance of an object in the contrast.
OBJECT_REFLECTANCE = 0.2
# Reflectance of the ground behind it.
GROUND_REFLECTANCE = 0.1
# Distance about a box within which a lamp is the box's, metres.
_LAMP_MARGIN_M = 0.3
# Distance behind a box at which the ground is compared with it, metres.
_BEHIND_M = 5.0

# illuminance_lux: of the side that faces the camera, by sky, moon and all lamps.
# luminance_contrast: (object - ground) / ground, at the reflectances above, in clear air.
# lamps: number of the box's lamps that are on. pixels: number of pixels that show the box, or
# NOT_COUNTED. glare_pixels: number of those that lamps saturate.
LIGHT_TABLE = BoxTable(
    name="box_light",
    file="labels/light.parquet",
    kind="box light",
    columns={
        "illuminance_lux": np.float64,
        "luminance_contrast": np.float64,
        "lamps": np.int64,
        "pixels": np.int64,
        "glare_pixels": np.int64,
        "glare_fraction": np.float64,
    },
    sample_columns=("illuminance_lux", "luminance_contrast", "glare_fraction"),
    derived_columns={"glare_fraction": pixel_fraction("glare_pixels")},
)


def measure_light(boxes: WorldBoxes, camera: Camera, inputs: LabelInputs) -> dict[str, np.ndarray]:
    """Return the stored columns of LIGHT_TABLE."""
    count = len(boxes)
    columns = {
        "illuminance_lux": np.full(count, np.nan),
        "luminance_contrast": np.full(count, np.nan),
        "lamps": np.zeros(count, np.int64),
        "pixels": np.full(count, NOT_COUNTED),
        "glare_pixels": np.zeros(count, np.int64),
    }
    plan: LightPlan | None = inputs.plan.data
    if plan is None:
        return columns
    is_usable = boxes.is_usable
    if is_usable.any():
        lamps = lamps_at(plan, plan.scene, camera)
        corners = boxes.corners_m[is_usable]
        eye = camera.centre.numpy()
        centres = boxes.centres_m[is_usable]
        to_eye = eye - centres
        to_eye[:, 2] = 0
        to_eye /= np.maximum(np.linalg.norm(to_eye, axis=1, keepdims=True), 1e-9)
        half_depths = np.abs(((corners - centres[:, None]) * to_eye[:, None]).sum(2)).max(1)
        faces = centres + half_depths[:, None] * to_eye
        bottoms = centres - (half_depths + _BEHIND_M)[:, None] * to_eye
        bottoms[:, 2] = corners[..., 2].min(1)
        level = np.tile([0.0, 0.0, 1.0], (len(centres), 1))
        face_lux = plan.hour.ground_lux / 2 + _total(illuminance(lamps, faces, to_eye))
        ground_lux = plan.hour.ground_lux + _total(illuminance(lamps, bottoms, level))
        columns["illuminance_lux"][is_usable] = face_lux
        object_light = OBJECT_REFLECTANCE * face_lux / math.pi
        ground_light = np.maximum(GROUND_REFLECTANCE * ground_lux / math.pi, 1e-9)
        columns["luminance_contrast"][is_usable] = object_light / ground_light - 1
        low = corners.min(1) - _LAMP_MARGIN_M
        high = corners.max(1) + _LAMP_MARGIN_M
        places = lamps.positions_m[:, None]
        is_inside = ((places >= low) & (places <= high)).all(2)
        is_of_actor = (lamps.owners > 0)[:, None]
        columns["lamps"][is_usable] = (is_inside & is_of_actor).sum(0)
    if inputs.depth_m is not None and inputs.mask is not None:
        box_pixels = count_pixels(boxes, camera, inputs.depth_m, inputs.mask)
        columns |= {"pixels": box_pixels.num_pixels, "glare_pixels": box_pixels.num_marked}
    return columns


def _total(lux: np.ndarray) -> np.ndarray:
    """Return the sum over lamps, [N]."""
    return lux.sum(1) if lux.shape[1] else np.zeros(len(lux))
