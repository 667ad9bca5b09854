"""Depth images of a recording back-projected: sweeps for a drive without LiDAR.

depth/<camera>/<frame>.png: 16 bits, metres x 256 along the optical axis, 0 = none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from adapters.lidar.split import Sweep
from adapters.recording.files import numbered_files
from augment.batch.encode import decode_png, depth_in_metres
from augment.batch.layout import folder_name
from augment.cameras import Camera, Frame
from augment.semantics import SemanticClass
from recipes.files import open_file

POINTS_PER_IMAGE = 40_000  # more than the voxels near the path need of each image of a drive
_FARTHEST_M = 200.0  # beyond, one step of the file's may be less than the depth's own error
# A pixel whose inverse depth is off the line through its neighbours by more than this part lies on
# an edge, where renderers and estimators mix two depths. A plane's inverse depth is linear.
_BENT = 0.05


def depth_sweeps(root: Path, frames: Sequence[Frame]) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """One sweep for each depth image of the frames' cameras, and a sentence for each image that
    cannot be used. Each point has its camera's time.

    Raises:
        AdapterError: a file lies outside the folder.
    """
    sweeps, problems = [], []
    names = dict.fromkeys(name for frame in frames for name in frame.cameras)
    files = {n: numbered_files(root, f"depth/{folder_name(n)}", (".png",)) for n in names}
    for frame in frames:
        for name, camera in frame.cameras.items():
            path = files[name].get(frame.index)
            if path is None:
                continue
            try:
                with open_file(path) as file:
                    depth_m = depth_in_metres(decode_png(file.read(), np.uint16))
                if depth_m.shape != (camera.height, camera.width):
                    raise ValueError(
                        f"it is {depth_m.shape[1]}x{depth_m.shape[0]} pixels, the camera "
                        f"{camera.width}x{camera.height}"
                    )
            except (OSError, ValueError) as error:
                problems.append(f"camera {name}, frame {frame.index}: depth {path}: {error}")
                continue
            sweeps.append(back_project(depth_m, camera))
    return tuple(sweeps), tuple(problems)


def back_project(depth_m: np.ndarray, camera: Camera) -> Sweep:
    """Points of a depth image [H, W], at most about POINTS_PER_IMAGE, on a regular grid of pixels.

    Left out: no depth, far depth, and pixels on edges between near and far.
    """
    inverse = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-3), 0).astype(np.float32)
    usable = (depth_m > 0) & (depth_m < _FARTHEST_M)
    usable[1:-1] &= _is_straight(inverse[:-2], inverse[1:-1], inverse[2:])
    usable[:, 1:-1] &= _is_straight(inverse[:, :-2], inverse[:, 1:-1], inverse[:, 2:])
    step = max(1, math.ceil(math.sqrt(depth_m.size / POINTS_PER_IMAGE)))
    rows, columns = np.nonzero(usable[step // 2 :: step, step // 2 :: step])
    rows, columns = rows * step + step // 2, columns * step + step // 2
    z = depth_m[rows, columns].astype(np.float64)
    local = np.stack(
        [
            (columns + 0.5 - camera.cx) / camera.fx * z,
            (rows + 0.5 - camera.cy) / camera.fy * z,
            z,
        ],
        axis=1,
    )
    pose = camera.world_from_camera.numpy()
    points = (local @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    return Sweep(
        points,
        np.full(len(points), camera.timestamp_ns),
        np.full(len(points), SemanticClass.UNKNOWN, np.int16),
    )


def _is_straight(before: np.ndarray, here: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.abs(before + after - 2 * here) <= _BENT * here
