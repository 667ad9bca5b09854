"""Check that a raw drive's cameras and LiDAR returns are in plausible frames of reference.

Poses and returns in other axes raise no error by themselves: the scene is a blur, or empty. If the
mistake is plain, these checks return a sentence that says what to do; otherwise they return
nothing. The caller is `adapters.raw_drive`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from augment.scene.cameras import Frame

# Cosine between a camera's y axis and up from which it is upside down: 60 degrees at most.
_UPSIDE_DOWN = 0.5
# Cosine between a front camera's axis and the car's, from which it looks back.
_LOOKS_BACK = -0.5
_FRONT = re.compile(r"(?i)(?<![a-z])(front|forward)(?![a-z])")
_BACK = re.compile(r"(?i)(?<![a-z])(rear|back|behind)(?![a-z])")

# ---- Camera axes ---------------------------------------------------------------------------------


def camera_problems(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Return a sentence for cameras that are upside down, or look back though they are front ones.

    Args:
        frames: of the drive, world z up, cameras in OpenCV's axes as far as is known.
    """
    by_camera: dict[str, list[tuple[float, float]]] = {}
    for frame in frames:
        ahead = frame.world_from_ego[:3, 0].numpy()
        for name, camera in frame.cameras.items():
            axes = camera.world_from_camera[:3, :3].numpy()
            by_camera.setdefault(name, []).append((axes[2, 1], float(axes[:, 2] @ ahead)))
    means = {name: np.mean(values, axis=0) for name, values in by_camera.items()}
    upside_down = [name for name, (up, _) in means.items() if up > _UPSIDE_DOWN]
    if upside_down and 2 * len(upside_down) > len(means):
        return (
            f"cameras {', '.join(upside_down)} are upside down: the y axis of world_from_camera "
            f"points up. Axes must be OpenCV's (x right, y down, z forward); of OpenGL's (x right, "
            f"y up, z back), as NeRF tools and Blender write them, negate the second and the third "
            f"column",
        )
    back = [
        name
        for name, (_, along) in means.items()
        if along < _LOOKS_BACK and _FRONT.search(name) and not _BACK.search(name)
    ]
    if not back:
        return ()
    return (
        f"cameras {', '.join(back)} look back along the car. Axes of a camera must be OpenCV's (x "
        f"right, y down, z forward), those of world_from_ego x forward, y left, z up",
    )


# ---- The frame of LiDAR returns ------------------------------------------------------------------

# Edge of a cell of the plan, and how far the plan reaches to each side.
_CELL_M = 0.5
_REACH_M = 40.0
# A cell whose returns are this far apart in height has something upright in it.
_UPRIGHT_M = 1.0
_MIN_UPRIGHT_CELLS = 60
# How far the car drives between the sweeps of a pair: at least, and preferably.
_MIN_STEP_M = 1.5
_STEP_M = 4.0
# How far it may turn meanwhile.
_MAX_TURN_RAD = 0.1
_MAX_PAIRS = 3
# Sweeps that are looked at as the first of a pair, and those after each.
_MAX_STARTS = 60
_MAX_LATER = 200
# What fits best lies as far off as the car drove, give or take.
_TOLERANCE_M = 0.75
_TOLERANCE = 0.2
# How much better it must fit there than where it lies, and at least: of PandaSet's sweep in the
# car's frame 1.7 to 1.9 times, 0.63 to 0.68; in its own frame nothing fits better than it lies.
_MIN_GAIN = 1.4
_MIN_OVERLAP = 0.4


class _Pair(NamedTuple):
    """Two sweeps. step_m: distance that the car drove between them."""

    first: np.ndarray
    second: np.ndarray
    step_m: float


def lidar_problems(
    frames: Sequence[Frame], sweeps: Sequence[tuple[int, np.ndarray]]
) -> tuple[str, ...]:
    """Return a sentence where the returns of different frames fit each other best as far apart as
    the car drove: then they move with it, as returns in the car's or the sensor's frame do.

    Args:
        frames: of the drive.
        sweeps: of some of its frames, the middle of the times, nanoseconds, and the points [N, 3],
            world, metres.
    """
    offsets = [(pair.step_m, _best_offset(pair)) for pair in _pairs(frames, sweeps)]
    moved = [
        (step_m, offset_m)
        for step_m, offset_m in offsets
        if offset_m is not None and abs(offset_m - step_m) < max(_TOLERANCE_M, _TOLERANCE * step_m)
    ]
    if not moved or 2 * len(moved) <= len(offsets):
        return ()
    step_m, offset_m = moved[0]
    return (
        f"LiDAR returns move with the car: where it drove {step_m:.1f} m between two sweeps, what "
        f"stands beside the road lies {offset_m:.1f} m apart in them. Their coordinates seem to be "
        f"in another frame than the format's: a recording's are in the world of its poses "
        f"(world_from_ego @ ego_from_sensor @ point), other datasets' as their publishers say",
    )


def _pairs(frames: Sequence[Frame], sweeps: Sequence[tuple[int, np.ndarray]]) -> list[_Pair]:
    """Return some pairs of sweeps between which the car drove about _STEP_M without a turn."""
    if len(sweeps) < 2:
        return []
    times = np.array([frame.timestamp_ns for frame in frames], np.int64)
    poses = np.stack(
        [frames[int(np.abs(times - time).argmin())].world_from_ego.numpy() for time, _ in sweeps]
    )
    pairs: list[_Pair] = []
    for start in range(0, len(sweeps) - 1, max(1, len(sweeps) // _MAX_STARTS)):
        later = poses[start + 1 : start + 1 + _MAX_LATER]
        steps_m = np.linalg.norm(later[:, :2, 3] - poses[start, :2, 3], axis=1)
        is_straight = later[:, :3, 0] @ poses[start, :3, 0] > np.cos(_MAX_TURN_RAD)
        misfit = np.where(is_straight & (steps_m > _MIN_STEP_M), np.abs(steps_m - _STEP_M), np.inf)
        best = int(misfit.argmin())
        if np.isfinite(misfit[best]):
            end = start + 1 + best
            pairs.append(_Pair(sweeps[start][1], sweeps[end][1], float(steps_m[best])))
    return pairs[:: max(1, len(pairs) // _MAX_PAIRS)][:_MAX_PAIRS]


def _best_offset(pair: _Pair) -> float | None:
    """Return the offset at which two sweeps fit each other best, metres.

    The result is None if no offset fits much better than none.
    """
    if not len(pair.first) or not len(pair.second):
        return None
    corner = np.median(pair.first[:, :2], axis=0) - _REACH_M
    first = _upright_cells(pair.first, corner)
    second = _upright_cells(pair.second, corner)
    if min(first.sum(), second.sum()) < _MIN_UPRIGHT_CELLS:
        return None
    reach = int(np.ceil((pair.step_m * (1 + _TOLERANCE) + _TOLERANCE_M) / _CELL_M))
    padded = cv2.copyMakeBorder(first, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    hits = cv2.matchTemplate(padded.astype(np.float32), second.astype(np.float32), cv2.TM_CCORR)
    overlap = hits / second.sum()
    row, column = np.unravel_index(int(overlap.argmax()), overlap.shape)
    best = float(overlap[row, column])
    overlap_as_placed = float(overlap[reach, reach])
    if best < _MIN_OVERLAP or best < _MIN_GAIN * overlap_as_placed:
        return None
    return float(np.hypot(row - reach, column - reach)) * _CELL_M


def _upright_cells(points: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Return the cells of a square of the plan that hold something upright, uint8 [S, S]."""
    side = round(2 * _REACH_M / _CELL_M)
    cells = np.floor((points[:, :2] - corner) / _CELL_M)
    inside = ((cells >= 0) & (cells < side)).all(axis=1)
    index = cells[inside].astype(np.int64) @ [side, 1]
    heights = points[inside, 2]
    low = np.full(side * side, np.inf)
    high = np.full(side * side, -np.inf)
    np.minimum.at(low, index, heights)
    np.maximum.at(high, index, heights)
    with np.errstate(invalid="ignore"):
        return (high - low > _UPRIGHT_M).astype(np.uint8).reshape(side, side)
