"""What a job renders: a scene as it is known without its Gaussians, and the images wanted."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from augment.cameras import Frame
from augment.errors import SceneError
from augment.instances import Instances, instances_of
from augment.labels import LabelSource
from augment.scene import Scene


@dataclass(frozen=True, eq=False)
class SceneIndex:
    """A scene without its Gaussians: small enough to keep while workers hold the whole of it.

    frames: those of the job, the scene's own or a camera path's. labelled: numbers of the frames
    whose boxes and LiDAR pass through: all of the scene's own; of a camera path, those that share
    number and timestamp with a frame of the scene. instances: of the objects in all the scene's
    own frames.
    """

    name: str
    source: str
    frames: tuple[Frame, ...]
    labels: LabelSource | None
    labelled: frozenset[int]
    instances: Instances
    world_origin_m: np.ndarray
    has_metric_scale: bool

    @staticmethod
    def of(scene: Scene, camera_path: Sequence[Frame] | None = None) -> SceneIndex:
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
            labelled=frozenset(labelled) if scene.labels is not None else frozenset(),
            instances=instances_of(scene),
            world_origin_m=np.asarray(scene.world_origin_m, np.float64),
            has_metric_scale=scene.has_metric_scale,
        )

    @functools.cached_property
    def frames_by_number(self) -> dict[int, Frame]:
        return {frame.index: frame for frame in self.frames}


def check_frames(scene: Scene) -> None:
    """Raises SceneError, with what its adapter said, where a scene has no frames to render."""
    if not scene.frames:
        said = "; ".join(scene.problems) or "give camera_path=FILE in its URI"
        raise SceneError(f"scene {scene.name!r} ({scene.source}) has no frames to render: {said}")


def select_frames(
    index: SceneIndex, frames: Sequence[int] | None, cameras: Sequence[str] | None
) -> list[tuple[Frame, tuple[str, ...]]]:
    """The wanted frames in order of number, each with its wanted cameras in order of name.

    None wants all. A frame without any of the cameras is left out.

    Raises:
        SceneError: a frame or camera is unknown (the message lists those there are), a number is
            used twice, or nothing remains.
    """
    known = index.frames_by_number
    if len(known) != len(index.frames):
        raise SceneError(f"scene {index.name!r}: frame numbers repeat; each must be used once")
    if frames is not None and (unknown := sorted(set(frames) - known.keys())):
        raise SceneError(
            f"scene {index.name!r} has no frame {_listed(unknown)}; it has {_ranges(known)}"
        )
    names = sorted({name for frame in index.frames for name in frame.cameras})
    if cameras is not None and (missing := sorted(set(cameras) - set(names))):
        raise SceneError(
            f"scene {index.name!r} has no camera {_listed(missing)}; it has {_listed(names)}"
        )
    wanted = set(names if cameras is None else cameras)
    selected = [
        (known[number], tuple(sorted(wanted & known[number].cameras.keys())))
        for number in sorted(known if frames is None else set(frames))
    ]
    selected = [(frame, names) for frame, names in selected if names]
    if not selected:
        raise SceneError(
            f"scene {index.name!r} ({index.source}): the selection holds no image; the scene has "
            f"{len(known)} frames and the cameras {_listed(names) or 'none'}"
        )
    return selected


def has_lidar(scene: Scene, frames: Iterable[int]) -> bool:
    """Whether any of the frames has a LiDAR sweep, readable or not."""
    labels = scene.labels
    if labels is None:
        return False
    for number in frames:
        try:
            if labels.lidar(number) is not None:
                return True
        except Exception:  # of a damaged file its own frame tells
            return True
    return False


def _listed(values: Sequence[object]) -> str:
    return ", ".join(map(str, values))


def _ranges(numbers: Sequence[int] | dict[int, Frame]) -> str:
    """`0-9, 12, 14-15`."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs) or "no frames"
