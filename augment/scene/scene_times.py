"""Times of a scene's drive, by which the weather goes on."""

from __future__ import annotations

from augment.memo import memo_of
from augment.scene.scene import Scene
from recipes.moment import SceneTimes


def scene_times(scene: Scene) -> SceneTimes:
    """Return the times of the first and the last image of a scene.

    All images count, whatever a job selects: so an image has the same weather in every job.
    """
    return memo_of(scene).get("scene times", lambda: _find_times(scene))


def _find_times(scene: Scene) -> SceneTimes:
    frames = scene.frames
    images = [camera.timestamp_ns for frame in frames for camera in frame.cameras.values()]
    times = images or [frame.timestamp_ns for frame in frames] or [0]
    return SceneTimes(min(times), max(times), len(frames))
