"""The index of a scene: frames, labels and objects without Gaussians; selection of its frames.

In: an open scene, numbers of frames, names of cameras. Out: a `SceneIndex` and the selected frames.
Jobs and `augment.dataset.live` call it.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from augment.errors import SceneError
from augment.scene.boxes import Instances, instances_of
from augment.scene.cameras import Frame
from augment.scene.labels import LabelSource
from augment.scene.scene import Scene
from augment.scene.scene_times import scene_times
from recipes.moment import SceneTimes


@dataclass(frozen=True, eq=False)
class SceneIndex:
    """A scene without its Gaussians, which a job keeps while workers hold the complete scene."""

    name: str
    """Name of the scene."""
    source: str
    """The scene's own statement of its origin."""
    frames: tuple[Frame, ...]
    """The scene's own frames, or those of a camera path."""
    labels: LabelSource | None
    """Source of boxes and LiDAR; None if there is none."""
    labelled_frames: frozenset[int]
    """Numbers of the frames whose boxes and LiDAR pass through. For a camera path these are the
    frames with number and timestamp of a frame of the scene.
    """
    instances: Instances
    """Numbers of the objects in all of the scene's own frames."""
    world_origin_m: np.ndarray
    """Origin that was subtracted from the dataset's world, metres."""
    has_metric_scale: bool
    """True if the scene's unit is the metre."""
    times: SceneTimes
    """Times of the scene's own images, by which its weather changes."""

    @staticmethod
    def of(scene: Scene, camera_path: Sequence[Frame] | None = None) -> SceneIndex:
        """Return the index of an open scene."""
        if camera_path is None:
            check_frames(scene)
        frames = scene.frames if camera_path is None else tuple(camera_path)
        times = {frame.index: frame.timestamp_ns for frame in scene.frames}
        labelled = {f.index for f in frames if times.get(f.index) == f.timestamp_ns}
        return SceneIndex(
            name=scene.name,
            source=scene.source,
            frames=frames,
            labels=scene.labels,
            labelled_frames=frozenset(labelled) if scene.labels is not None else frozenset(),
            instances=instances_of(scene),
            world_origin_m=np.asarray(scene.world_origin_m, np.float64),
            has_metric_scale=scene.has_metric_scale,
            times=scene_times(scene),
        )

    @functools.cached_property
    def frames_by_number(self) -> dict[int, Frame]:
        """Frames by number."""
        return {frame.index: frame for frame in self.frames}


def check_frames(scene: Scene) -> None:
    """Raise SceneError, with its adapter's messages, where a scene has no frames to render."""
    if not scene.frames:
        message = "; ".join(scene.problems) or "give camera_path=FILE in its URI"
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no frames to render: {message}"
        )


def select_frames(
    index: SceneIndex, frames: Sequence[int] | None, cameras: Sequence[str] | None
) -> list[tuple[Frame, tuple[str, ...]]]:
    """Return the selected frames in order of number, each with its selected cameras by name.

    None selects all. A frame without any of the cameras is left out.

    Raises:
        SceneError: A frame or camera does not exist, or no image is selected.
    """
    frame_of_number = index.frames_by_number
    if len(frame_of_number) != len(index.frames):
        raise SceneError(f"scene {index.name!r}: frame numbers repeat; each must be used once")
    if frames is not None and (unknown_frames := sorted(set(frames) - frame_of_number.keys())):
        raise SceneError(
            f"scene {index.name!r} has no frame {_join_names(unknown_frames)}; it has "
            f"{_format_ranges(frame_of_number)}"
        )
    names = sorted({name for frame in index.frames for name in frame.cameras})
    if cameras is not None and (unknown_cameras := sorted(set(cameras) - set(names))):
        raise SceneError(
            f"scene {index.name!r} has no camera {_join_names(unknown_cameras)}; it has "
            f"{_join_names(names)}"
        )
    requested_cameras = set(names if cameras is None else cameras)
    selection = [
        (
            frame_of_number[number],
            tuple(sorted(requested_cameras & frame_of_number[number].cameras.keys())),
        )
        for number in sorted(frame_of_number if frames is None else set(frames))
    ]
    selection = [(frame, names) for frame, names in selection if names]
    if not selection:
        raise SceneError(
            f"scene {index.name!r} ({index.source}): the selection holds no image; the scene has "
            f"{len(frame_of_number)} frames and the cameras {_join_names(names) or 'none'}"
        )
    return selection


def has_lidar(scene: Scene, frames: Iterable[int]) -> bool:
    """Return True if any of the frames has a LiDAR sweep, readable or not."""
    labels = scene.labels
    if labels is None:
        return False
    for number in frames:
        try:
            if labels.lidar(number) is not None:
                return True
        except Exception:  # a damaged file is reported with its own frame
            return True
    return False


def _join_names(values: Sequence[object]) -> str:
    """Return values as a list for people."""
    return ", ".join(map(str, values))


def _format_ranges(numbers: Sequence[int] | dict[int, Frame]) -> str:
    """Return numbers as ranges: `0-9, 12, 14-15`."""
    ranges: list[list[int]] = []
    for number in sorted(numbers):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return (
        ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)
        or "no frames"
    )
