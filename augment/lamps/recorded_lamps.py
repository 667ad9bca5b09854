"""Lamps that a photograph shows lit: brake lamps of vehicles and traffic signals.

In: a recorded image and the pixels of vehicles that may have lamps on. Out: how much of each pixel
is a lamp's own light, which stays when the daylight goes. A lit lamp is a small patch that is
clipped or nearly so in its main channel, coloured, and far brighter than its surroundings; a signal
also has a dark housing around it. White lamps are not looked for: chrome and wet paint in the sun
look the same. The photograph clips lamps, so their luminance is that of their kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from augment.exposure.vehicle_cells import parked_vehicles
from augment.lamps.braking import travels
from augment.lamps.lamp import GREEN, RED, LampKind
from augment.lamps.vehicle_places import body_of
from augment.light.srgb import linear_from_display
from augment.scene.boxes import CORNERS, MIN_DEPTH_M
from augment.scene.cameras import Camera
from augment.scene.scene import Scene

# Luminance of a lit stop lamp, cd/m²: 100 cd from 50 cm².
STOP_LUMINANCE_CD_M2 = 2e4
# Luminance of a traffic signal, cd/m²: 200 cd from a disc of 200 mm.
SIGNAL_LUMINANCE_CD_M2 = 6e3

# Display value of the main channel from which on a pixel may be a lamp.
_MIN_VALUE = 0.75
# Display value that some pixel of the patch must reach.
_MIN_PEAK = 0.95
# The same for signals, which are dimmer than brake lamps.
_MIN_SIGNAL_PEAK = 0.88
# Least difference of the main channel from the one that it is told by, as a share of it.
_MIN_SATURATION = 0.25
# Fewest pixels of a brake lamp. Fewer are specks of the sensor's colour filter.
_MIN_STOP_PIXELS = 5
# Fewest pixels of a signal.
_MIN_SIGNAL_PIXELS = 10
# Largest side of a patch, in widths of the image. A brake lamp 0.3 m wide has it at 10 m.
_MAX_SIDE = 0.025
# Least share of a signal's bounding box that its patch fills.
_MIN_FILL = 0.55
# Largest ratio of the sides of a signal's bounding box.
_MAX_ASPECT = 1.8
# Least linear brightness of a brake lamp over that of the ring around it.
_MIN_STOP_CONTRAST = 2.5
# The same for a signal, whose housing is dark.
_MIN_SIGNAL_CONTRAST = 6.0
# Width of the ring in which the surroundings are measured, in sides of the patch.
_RING_SIDES = 0.8
# Length of the housing above a green disc and below a red one, in sides of the patch.
_HOUSING_SIDES = 2.0
# Largest linear brightness of the housing over that of the disc, for nine of ten of its pixels.
_MAX_HOUSING = 0.2


class RecordedLamp(NamedTuple):
    """One lit lamp of a photograph."""

    kind: LampKind
    """STOP or SIGNAL."""
    column: float
    """Column of its middle, pixels."""
    row: float
    """Row of its middle, pixels."""
    is_red: bool
    """True for red lamps, False for green ones."""


@dataclass(frozen=True, eq=False)
class RecordedLamps:
    """Lit lamps of a photograph."""

    share: Float32[np.ndarray, "H W"]
    """Share of each pixel's light that is a lamp's, 0 to 1."""
    luminance_cd_m2: Float32[np.ndarray, "H W 3"]
    """Luminance of the lamps alone, linear sRGB, cd/m²."""
    lamps: tuple[RecordedLamp, ...]
    """The lamps, from top to bottom."""


class VehiclePixels(NamedTuple):
    """Pixels of the boxes of vehicles in a photograph."""

    moving: Bool[np.ndarray, "H W"]
    """Vehicles that are not parked: brake lamps are looked for there."""
    parked: Bool[np.ndarray, "H W"]
    """Parked vehicles: reflectors in the sun are no lamps. Signals are looked for elsewhere."""


def find_recorded_lamps(rgb: UInt8[np.ndarray, "H W 3"], vehicles: VehiclePixels) -> RecordedLamps:
    """Return the lit lamps that a photograph shows.

    Args:
        rgb: the photograph, display-encoded.
        vehicles: pixels of vehicles, as from `vehicle_pixels`.
    """
    is_open = ~(vehicles.moving | vehicles.parked)
    height, width = rgb.shape[:2]
    share = np.zeros((height, width), np.float32)
    luminance = np.zeros((height, width, 3), np.float32)
    lamps: list[RecordedLamp] = []
    red = rgb[..., 0].astype(np.float32) / 255
    green = rgb[..., 1].astype(np.float32) / 255
    blue = rgb[..., 2].astype(np.float32) / 255
    searches = (
        (red, np.maximum(green, blue), vehicles.moving, LampKind.STOP, True),
        (red, np.maximum(green, blue), is_open, LampKind.SIGNAL, True),
        (green, red, is_open, LampKind.SIGNAL, False),  # signals are bluish green
    )
    for main, other, area, kind, is_red in searches:
        is_lamp = (main > _MIN_VALUE) & (main - other > _MIN_SATURATION * main) & area
        for lamp, window, lamp_share in _find_patches(is_lamp, main, kind, is_red):
            lamps.append(lamp)
            share[window] = np.maximum(share[window], lamp_share)
            level = STOP_LUMINANCE_CD_M2 if kind == LampKind.STOP else SIGNAL_LUMINANCE_CD_M2
            color = np.asarray(RED if is_red else GREEN, np.float32) * np.float32(level)
            light = lamp_share[..., None] * color
            luminance[window] = np.maximum(luminance[window], light)
    return RecordedLamps(
        share, luminance, tuple(sorted(lamps, key=lambda lamp: (lamp.row, lamp.column)))
    )


def _find_patches(
    is_lamp: np.ndarray, main: np.ndarray, kind: LampKind, is_red: bool
) -> list[tuple[RecordedLamp, tuple[slice, slice], np.ndarray]]:
    """Return the patches that are lamps, each with its window and its share of every pixel."""
    height, width = is_lamp.shape
    count, numbers, boxes, middles = cv2.connectedComponentsWithStats(is_lamp.astype(np.uint8))
    is_signal = kind == LampKind.SIGNAL
    patches = []
    for number in range(1, count):
        left, top, columns, rows, num_pixels = boxes[number].tolist()
        side = max(columns, rows)
        min_pixels = _MIN_SIGNAL_PIXELS if is_signal else _MIN_STOP_PIXELS
        if num_pixels < min_pixels or side > max(_MAX_SIDE * width, 3):
            continue
        if is_signal and not _is_disc(columns, rows, num_pixels):
            continue
        margin = max(round(_RING_SIDES * side), 2)
        window = (
            slice(max(top - margin, 0), min(top + rows + margin, height)),
            slice(max(left - margin, 0), min(left + columns + margin, width)),
        )
        patch = numbers[window] == number
        if main[window][patch].max() < (_MIN_SIGNAL_PEAK if is_signal else _MIN_PEAK):
            continue
        # One pixel of blur and glow around the patch counts neither to it nor to the ring.
        ring = cv2.dilate(patch.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
        if not ring.any():
            continue
        linear = linear_from_display(main[window])
        core = float(np.median(linear[patch]))
        outside = float(np.median(linear[ring]))
        contrast = core / max(outside, 1e-3)
        if contrast < (_MIN_SIGNAL_CONTRAST if is_signal else _MIN_STOP_CONTRAST):
            continue
        if is_signal and not _has_housing(main, boxes[number].tolist(), core, is_red):
            continue
        glow = np.clip((linear - outside) / max(core - outside, 1e-3), 0, 1)
        lamp_share = np.where(ring, 0, glow).astype(np.float32)
        column, row = middles[number]
        lamp = RecordedLamp(kind, float(column) + 0.5, float(row) + 0.5, is_red)
        patches.append((lamp, window, lamp_share))
    return patches


def _is_disc(columns: int, rows: int, num_pixels: int) -> bool:
    """Return True if a patch may be a signal's disc or arrow."""
    aspect = max(columns, rows) / min(columns, rows)
    return aspect <= _MAX_ASPECT and num_pixels >= _MIN_FILL * columns * rows


def _has_housing(main: np.ndarray, box: list[int], core: float, is_red: bool) -> bool:
    """Return True if dark lamps of a signal lie below a red patch or above a green one."""
    left, top, columns, rows, _ = box
    length = max(round(_HOUSING_SIDES * max(columns, rows)), 3)
    # One pixel between the patch and its housing is glow.
    first = top + rows + 1 if is_red else top - 1 - length
    housing = main[max(first, 0) : max(first + length, 0), left : left + columns]
    if housing.shape[0] < length:
        return False
    return float(np.quantile(linear_from_display(housing), 0.9)) <= _MAX_HOUSING * core


# Values of the image in which boxes are painted.
_MOVING = 1
_PARKED = 2


def vehicle_pixels(scene: Scene, camera: Camera) -> VehiclePixels:
    """Return the pixels of the boxes of vehicles; where boxes overlap, of the nearer one.

    Args:
        scene: the scene, with actors and labelled boxes.
        camera: the camera of the photograph.
    """
    scene = scene.as_recorded  # the photograph shows them there
    boxes: list[tuple[np.ndarray, bool]] = []
    poses = scene.poses_at(camera.timestamp_ns)
    for owner, actor in enumerate(scene.actors, start=1):
        if owner in poses and body_of(actor.label, actor.size_m) is not None:
            corners = CORNERS * np.array(actor.size_m)
            pose = poses[owner]
            boxes.append(
                (corners @ pose[:3, :3].T + pose[:3, 3], travels(actor.track) is not False)
            )
    for parked in parked_vehicles(scene):
        corners = CORNERS * np.array(parked.size_m)
        boxes.append((corners @ parked.rotation.T + parked.centre_m, parked.is_stopped))
    camera_from_world = camera.camera_from_world.numpy()
    in_camera = [
        (corners @ camera_from_world[:3, :3].T + camera_from_world[:3, 3], may_be_lit)
        for corners, may_be_lit in boxes
    ]
    mask = np.zeros((camera.height, camera.width), np.uint8)
    for corners, may_be_lit in sorted(in_camera, key=lambda box: -box[0][:, 2].mean()):
        if corners[:, 2].min() < MIN_DEPTH_M:
            continue
        pixels = corners[:, :2] / corners[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        limit = 4.0 * max(camera.width, camera.height)
        hull = cv2.convexHull(np.clip(np.round(pixels), -limit, limit).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, _MOVING if may_be_lit else _PARKED)
    return VehiclePixels(mask == _MOVING, mask == _PARKED)
