"""Times of a scene's drive, by which the weather goes on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from augment.memo import memo_of
from augment.scene.scene import Scene
from recipes.moment import SceneTimes


def scene_times(scene: Scene) -> SceneTimes:
    """Return the times of the first and the last image of a scene.

    All images count, whatever a job selects: so an image has the same weather in every job.
    """
    scene = scene.as_recorded
    return memo_of(scene).get("scene times", lambda: _find_times(scene))


def _find_times(scene: Scene) -> SceneTimes:
    images = (camera.timestamp_ns for frame in scene.frames for camera in frame.cameras.values())
    return times_of_drive(images, [frame.timestamp_ns for frame in scene.frames])


def times_of_drive(images_ns: Iterable[int], frames_ns: Sequence[int]) -> SceneTimes:
    """Return the times of a drive: those of its images, or of its frames if it has no images.

    Args:
        images_ns: times of all images, in any order.
        frames_ns: times of all frames, in any order.
    """
    times = list(images_ns) or frames_ns or [0]
    return SceneTimes(min(times), max(times), len(frames_ns))
