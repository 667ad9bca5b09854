"""Which images of a scene its settings are chosen by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from augment.cameras import Camera, Frame

COUNT = 3


class View(NamedTuple):
    """An image that is rendered to find out what settings cost. frame: its number."""

    frame: int
    name: str
    camera: Camera


def calibration_views(frames: Sequence[Frame], count: int = COUNT) -> tuple[View, ...]:
    """Images spread over the frames and over each frame's cameras; at most `count`, at least one.

    frames: all that the scene or the camera path has, never a selection, so that what is rendered
    beside an image does not change it.

    Raises:
        ValueError: no frame has a camera, or count is below 1.
    """
    if count < 1:
        raise ValueError(f"count must be >= 1; got {count}")
    pictured = sorted((f for f in frames if f.cameras), key=lambda frame: frame.index)
    if not pictured:
        raise ValueError(f"none of the {len(frames)} frames has a camera")
    views: dict[tuple[int, str], View] = {}
    for number in range(count):
        frame = pictured[(2 * number + 1) * len(pictured) // (2 * count)]
        names = sorted(frame.cameras)
        name = names[number * len(names) // count]
        views.setdefault((frame.index, name), View(frame.index, name, frame.cameras[name]))
    return tuple(views.values())
