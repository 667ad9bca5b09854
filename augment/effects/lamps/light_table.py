"""Lamps in labels: the light on each labelled box, its contrast, its lamps, and glare over it."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float32, Float64

from augment.effects.effect import LabelInputs
from augment.effects.lamps.exposure import Exposure
from augment.effects.lamps.plan import LightPlan
from augment.effects.lamps.scene_exposure import exposure_of_picture
from augment.effects.lamps.view_lamps import lamps_at, lamps_of_view
from augment.lamps.lamp import EGO_OWNER, MAP_OWNER, LampKind, Lamps
from augment.lamps.surface_light import illuminance
from augment.output.box_tables import BoxTable, pixel_fraction
from augment.scene.boxes import NOT_COUNTED, WorldBoxes, pixels_of_boxes
from augment.scene.cameras import Camera

# Distance about a box within which a parked vehicle's lamp is the box's, metres.
_LAMP_MARGIN_M = 0.3
# Width of the surround of a box, of the bounds of its pixels.
_SURROUND_SHARE = 0.2
# Least width of the surround, pixels.
_MIN_SURROUND_PX = 3
# Kinds of lamps that vehicles have.
_VEHICLE_KINDS = (
    LampKind.DIPPED,
    LampKind.HIGH,
    LampKind.TAIL,
    LampKind.STOP,
    LampKind.REAR_FOG,
    LampKind.FRONT_FOG,
    LampKind.INDICATOR,
    LampKind.DAYTIME,
)

# illuminance_lux: of the side that faces the camera, by sky, moon and the lamps of others.
# luminance_cd_m2: mean over the pixels that show the box. luminance_contrast: (mean - surround) /
# surround, the median of the pixels about the box. lamps: number of the box's lamps that are on.
# lamp_kinds: their kinds, in words. pixels: number of pixels that show the box, or NOT_COUNTED.
# saturated_pixels: those that are as bright as a white that saturates the sensor. glare_pixels:
# those in the mask `glare`.
LIGHT_TABLE = BoxTable(
    name="box_light",
    file="labels/light.parquet",
    kind="box light",
    columns={
        "illuminance_lux": np.float64,
        "luminance_cd_m2": np.float64,
        "luminance_contrast": np.float64,
        "lamps": np.int64,
        "lamp_kinds": object,
        "pixels": np.int64,
        "saturated_pixels": np.int64,
        "glare_pixels": np.int64,
        "glare_fraction": np.float64,
    },
    sample_columns=(
        "illuminance_lux",
        "luminance_cd_m2",
        "luminance_contrast",
        "lamps",
        "glare_fraction",
    ),
    derived_columns={"glare_fraction": pixel_fraction("glare_pixels")},
    contrast_column="luminance_contrast",
)
# Manifest columns of what holds for a whole image: light on level ground, luminance that saturates
# the sensor, exposure time, ISO speed, number of lamps that light the image.
EXPOSURE_COLUMNS = (
    "light_ground_lux",
    "light_white_cd_m2",
    "light_exposure_ms",
    "light_iso",
    "light_lamps",
)


def measure_exposure(camera: Camera, inputs: LabelInputs) -> dict[str, float]:
    """Return the values of EXPOSURE_COLUMNS for an image; those that it does not have are absent.

    Args:
        camera: camera of the image.
        inputs: the plan.
    """
    plan: LightPlan | None = inputs.plan.data
    if plan is None:
        return {}
    exposure = _exposure_of(plan, camera, inputs)
    values = {
        "light_ground_lux": plan.hour.ground_lux,
        "light_white_cd_m2": exposure.white_cd_m2,
        "light_exposure_ms": exposure.exposure_ms,
        "light_iso": exposure.iso,
        "light_lamps": len(lamps_of_view(plan, plan.scene, camera)),
    }
    return {name: float(value) for name, value in values.items() if value is not None}


def _exposure_of(plan: LightPlan, camera: Camera, inputs: LabelInputs) -> Exposure:
    """Return the exposure of the picture, in the light that a style gave the scene."""
    lit_scene = plan.scene if inputs.effect is None else inputs.effect.lit_scene
    return exposure_of_picture(plan, plan.scene, lit_scene, camera)


def measure_light(boxes: WorldBoxes, camera: Camera, inputs: LabelInputs) -> dict[str, np.ndarray]:
    """Return the stored columns of LIGHT_TABLE."""
    count = len(boxes)
    columns = {
        "illuminance_lux": np.full(count, np.nan),
        "luminance_cd_m2": np.full(count, np.nan),
        "luminance_contrast": np.full(count, np.nan),
        "lamps": np.zeros(count, np.int64),
        "lamp_kinds": np.full(count, "", object),
        "pixels": np.full(count, NOT_COUNTED),
        "saturated_pixels": np.zeros(count, np.int64),
        "glare_pixels": np.zeros(count, np.int64),
    }
    plan: LightPlan | None = inputs.plan.data
    if plan is None or count == 0:
        return columns
    lamps = lamps_at(plan, plan.scene, camera)
    is_of_box = lamps_of_boxes(lamps, boxes, plan)
    columns["lamps"] = is_of_box.sum(0)
    columns["lamp_kinds"][:] = [_kinds_in_words(lamps.kinds[is_mine]) for is_mine in is_of_box.T]
    columns["illuminance_lux"] = _illuminance_lux(plan, lamps, boxes, is_of_box, camera)
    if inputs.depth_m is None or inputs.mask is None:
        return columns
    columns["pixels"] = np.zeros(count, np.int64)
    white_cd_m2 = _exposure_of(plan, camera, inputs).white_cd_m2
    for box, rows, cols in pixels_of_boxes(boxes, camera, inputs.depth_m):
        columns["pixels"][box] = len(rows)
        columns["glare_pixels"][box] = np.count_nonzero(inputs.mask[rows, cols] == 255)
        if inputs.luminance_cd_m2 is None:
            continue
        luminances = inputs.luminance_cd_m2[rows, cols].astype(np.float64)
        mean = luminances.mean()
        surround = _surround_cd_m2(inputs.luminance_cd_m2, rows, cols)
        columns["luminance_cd_m2"][box] = mean
        columns["saturated_pixels"][box] = np.count_nonzero(luminances >= white_cd_m2)
        if surround > 0:
            columns["luminance_contrast"][box] = mean / surround - 1
    return columns


def lamps_of_boxes(lamps: Lamps, boxes: WorldBoxes, plan: LightPlan) -> Bool[np.ndarray, "M B"]:
    """Return which lamp is fixed to which box.

    Lamps of actors belong to the box of the actor's track, which may stand where the actor is at
    another time. Lamps of parked vehicles belong to the box that they lie in.

    Args:
        lamps: the lamps.
        boxes: the boxes.
        plan: the plan, with the scene.
    """
    is_of_box = np.zeros((len(lamps), len(boxes)), bool)
    tracks = [actor.track_id for actor in plan.scene.actors]
    is_parked = (lamps.owners == MAP_OWNER) & np.isin(lamps.kinds, _VEHICLE_KINDS)
    for box in range(len(boxes)):
        if not boxes.is_usable[box]:
            continue
        track = boxes.track_ids[box]
        if track in tracks:
            is_of_box[:, box] = lamps.owners == tracks.index(track) + 1
            continue
        places = (lamps.positions_m - boxes.centres_m[box]) @ boxes.rotations[box]
        is_inside = (np.abs(places) <= boxes.sizes_m[box] / 2 + _LAMP_MARGIN_M).all(1)
        is_of_box[:, box] = is_inside & (is_parked | (lamps.owners == EGO_OWNER))
    return is_of_box


def _illuminance_lux(
    plan: LightPlan,
    lamps: Lamps,
    boxes: WorldBoxes,
    is_of_box: Bool[np.ndarray, "M B"],
    camera: Camera,
) -> Float64[np.ndarray, " B"]:
    """Return the light on the upright side of each box that faces the camera, lux; NaN if unusable.

    A box's lamps do not count for itself, and fog weakens the lamps of others.
    """
    centres = boxes.centres_m
    to_eye = camera.centre.numpy() - centres
    to_eye[:, 2] = 0
    to_eye /= np.maximum(np.linalg.norm(to_eye, axis=1, keepdims=True), 1e-9)
    half_depths_m = np.abs(((boxes.corners_m - centres[:, None]) * to_eye[:, None]).sum(2)).max(1)
    sides = centres + half_depths_m[:, None] * to_eye
    lux = illuminance(lamps, sides, to_eye, plan.extinction_per_m)
    total = plan.hour.ground_lux / 2 + np.where(is_of_box.T, 0, lux).sum(1)
    return np.where(boxes.is_usable, total, np.nan)


def _surround_cd_m2(
    luminance_cd_m2: Float32[np.ndarray, "H W"], rows: np.ndarray, columns: np.ndarray
) -> float:
    """Return the median luminance of the pixels about those of a box; 0 if there are none."""
    sides = []
    for places, size in zip((rows, columns), luminance_cd_m2.shape, strict=True):
        first = int(places.min())
        stop = int(places.max()) + 1
        margin = max(_MIN_SURROUND_PX, math.ceil(_SURROUND_SHARE * (stop - first)))
        sides.append(slice(max(first - margin, 0), min(stop + margin, size)))
    window = luminance_cd_m2[sides[0], sides[1]]
    is_surround = np.ones(window.shape, bool)
    is_surround[rows - sides[0].start, columns - sides[1].start] = False
    return float(np.median(window[is_surround])) if is_surround.any() else 0.0


def _kinds_in_words(kinds: np.ndarray) -> str:
    """Return the different kinds of lamps in lower case, by number, as in `tail stop`."""
    return " ".join(LampKind(kind).name.lower() for kind in np.unique(kinds))
