"""What is known of a Street Gaussians scene besides its Gaussians.

World: the dataset's, minus the mean position of the car over all its frames, as the models are
trained. Vehicle frame: x forward, y left, z up. Times are seconds as the dataset has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

CAMERA_NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")


@dataclass(frozen=True)
class ModelConfig:
    """What of a model's configuration decides how it is read; the defaults are the project's own.

    cameras: numbers in CAMERA_NAMES. selected_frames: first and last, both included; None for all.
    split_test, split_train: every how manyeth frame is held out or trained on; -1 where unused.
    """

    source_path: str = ""
    cameras: tuple[int, ...] = (0, 1, 2)
    selected_frames: tuple[int, int] | None = None
    use_tracker: bool = False
    split_test: int = -1
    split_train: int = -1
    sh_degree: int = 3
    fourier_dim: int = 1
    fourier_scale: float = 1.0
    include_sky: bool = False
    white_background: bool = False
    opt_track: bool = True
    use_color_correction: bool = False
    color_correction_mode: str = "image"
    color_correction_mlp: bool = False
    use_pose_correction: bool = False
    pose_correction_mode: str = "image"


@dataclass(frozen=True, eq=False)
class StreetImage:
    """One image, or a camera without its image. cam: number in CAMERA_NAMES.

    world_from_ego: float64 [4, 4], at the moment of the image. camera_from_ego: float64 [4, 4],
    OpenCV axes. width, height, fx, fy, cx, cy: of the recorded image, pixels. is_held_out: not
    trained on. number: its position among all images of the selected frames and cameras, by frame,
    then camera, those included that are left out: the index of per-image corrections.
    """

    frame: int
    cam: int
    path: Path | None
    timestamp_s: float
    world_from_ego: np.ndarray
    camera_from_ego: np.ndarray
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    is_held_out: bool
    number: int

    @property
    def name(self) -> str:
        return CAMERA_NAMES[self.cam]

    @property
    def timestamp_ns(self) -> int:
        return round(self.timestamp_s * 1e9)


@dataclass(frozen=True, eq=False)
class TrackedObject:
    """A moving object of the model: `obj_{track_id:03d}`.

    size_m: length, width, height; training kept splats in a box that was wider and longer by
    data.box_scale. start_frame, end_frame: first and last in which it is tracked.
    start_s, end_s: when it is drawn.
    """

    track_id: int
    label: str
    size_m: tuple[float, float, float]
    start_frame: int
    end_frame: int
    start_s: float
    end_s: float


@dataclass(frozen=True, eq=False)
class Tracklets:
    """Where objects are in each of F selected frames, in the columns that the model has them in.

    ids: int64 [F, M], -1 for none. positions: float64 [F, M, 3], metres, vehicle frame at the
    frame's time. quats: float64 [F, M, 4] wxyz.
    """

    ids: np.ndarray
    positions: np.ndarray
    quats: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetData:
    """A dataset directory as a model sees it.

    frames: selected numbers, ascending. frame_times_s: float64 [F]. world_from_ego: float64
    [F, 4, 4] at the frames' times; between its neighbours' where the file is missing, so that the
    rows stay those of the model, but such a frame has no images. images: of the selected frames and
    cameras, by frame, then camera. objects: in order of their first appearance in the track file,
    static ones left out.
    """

    root: Path
    world_origin_m: np.ndarray
    frames: tuple[int, ...]
    frame_times_s: np.ndarray
    world_from_ego: np.ndarray
    images: tuple[StreetImage, ...]
    objects: tuple[TrackedObject, ...]
    tracklets: Tracklets
    problems: tuple[str, ...] = ()
