"""What to know of a drive before learning from it: does the calibration fit, is exposure steady."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from adapters.recorded.calibration import CameraOffset, measure_offset, read_intensities
from adapters.recorded.camera_timing import measure_time_offset, with_camera_times
from adapters.recorded.views import RecordedViews
from augment.reconstruct.view import ViewKey
from augment.scene import Scene

_WORST_TIME_S = 0.030  # rolling shutters alone make 10 to 20 ms
_WORST_DEG = 0.35  # a pixel at 480 columns is up to 0.25
_WORST_PX = 1.2
_FRAMES = 7  # that the calibration is measured in
_JUMP_STOPS = 0.4  # a third more or less light
_JUMP_TIMES = 5.0  # this many times the camera's usual change
_BLOCKS = (32, 18)  # columns and rows of the means that are compared
_NAMED = 3  # jumps of a camera that are named one by one


@dataclass(frozen=True)
class Checks:
    """problems: one sentence each. time_offset_s: how much later than stamped the images fit the
    LiDAR best, None where unknown. offsets: how images and LiDAR are shifted, a camera each, once
    that is taken into account.
    """

    problems: tuple[str, ...]
    time_offset_s: float | None
    offsets: tuple[CameraOffset, ...]

    @property
    def facts(self) -> dict[str, Any]:
        """JSON-able, for reports: pixels of the image compared, to the right and down."""
        late = self.time_offset_s
        return {
            "camera_time_offset_ms": None if late is None else 1e3 * late,
            "calibration_offsets": {
                o.camera: {
                    "right_px": o.right_px,
                    "down_px": o.down_px,
                    "angle_deg": o.angle_deg,
                    "is_sure": o.is_sure,
                }
                for o in self.offsets
            },
        }


def check_views(scene: Scene, views: RecordedViews) -> Checks:
    """Compare LiDAR with images and images with each other; takes some seconds.

    The calibration is not checked where sweeps have no intensity.
    """
    keys = sorted((*views.train, *views.test), key=lambda key: key.frame)
    own = {name: [k for k in keys if k.camera == name] for name in scene.camera_names}
    own = {name: found for name, found in own.items() if found}
    problems: list[str] = []
    for found in own.values():
        problems += exposure_jumps(views, found)
    # What is measured changes the cameras, so held-out images have no part in it.
    learnt = {name: [k for k in found if k in set(views.train)] for name, found in own.items()}
    own = {name: _spread(found, _FRAMES) for name, found in learnt.items() if found}
    returns = read_intensities(scene, (key.frame for found in own.values() for key in found))
    late = measure_time_offset(scene, returns, views, own)
    if late is not None and abs(late) > _WORST_TIME_S:
        problems.append(
            f"images fit the LiDAR best if they were taken {abs(late) * 1e3:.0f} ms "
            f"{'after' if late > 0 else 'before'} their time stamps: one of the clocks is wrong"
        )
    timed = scene if late is None else with_camera_times(scene, late)
    offsets = []
    for found in own.values():
        cameras = {k: timed.frame(k.frame).cameras[k.camera] for k in found}
        offset = measure_offset(returns, views, cameras)
        if offset is not None:
            offsets.append(offset)
            problems += _offset_problem(offset)
    return Checks(tuple(problems), late, tuple(offsets))


def _spread(keys: Sequence[ViewKey], count: int) -> list[ViewKey]:
    places = np.linspace(0, len(keys) - 1, min(count, len(keys))).round().astype(int)
    return [keys[i] for i in places]


def _offset_problem(offset: CameraOffset) -> list[str]:
    shift_px = float(np.hypot(offset.right_px, offset.down_px))
    if not offset.is_sure or offset.angle_deg < _WORST_DEG or shift_px < _WORST_PX:
        return []
    return [
        f"camera {offset.camera}: its images lie {offset.angle_deg:.2f} degrees beside the LiDAR "
        f"({offset.right_px:+.1f} px to the right, {offset.down_px:+.1f} px down, of "
        f"{offset.width_px} columns); its rotation, focal length or timestamps are wrong, and "
        f"what it shows will be blurred or doubled"
    ]


def exposure_jumps(views: RecordedViews, keys: Sequence[ViewKey]) -> list[str]:
    """A sentence for each sudden change of brightness between neighbouring images of a camera.

    The change is the median, over blocks of the image, of the logarithm of their ratio, so that
    what moves through the image hardly counts.
    """
    if len(keys) < 3:
        return []
    levels = [_block_stops(views.image(key)) for key in keys]
    change = np.array([np.median(b - a) for a, b in itertools.pairwise(levels)])
    usual = float(np.median(np.abs(change)))
    bound = max(_JUMP_STOPS, _JUMP_TIMES * usual)
    found = np.flatnonzero(np.abs(change) > bound)
    out = [
        f"camera {keys[i].camera}: brightness changes by a factor of {2 ** change[i]:.2f} between "
        f"frames {keys[i].frame} and {keys[i + 1].frame}; one exposure for the whole drive will "
        f"not fit both"
        for i in found[:_NAMED]
    ]
    if len(found) > _NAMED:
        out.append(
            f"camera {keys[0].camera}: brightness jumps {len(found) - _NAMED} more times, last "
            f"after frame {keys[found[-1]].frame}"
        )
    return out


def _block_stops(rgb: np.ndarray) -> np.ndarray:
    """Logarithm to base 2 of the blocks' mean brightness, float32."""
    size = (min(_BLOCKS[0], rgb.shape[1]), min(_BLOCKS[1], rgb.shape[0]))
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    return np.log2(grey.astype(np.float32) + 4)  # a few levels, so that black does not count
