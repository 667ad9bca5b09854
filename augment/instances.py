"""The numbers of a scene's objects, one for each, in instance images and beside its boxes.

An actor has 1 + its index in the scene. Boxes without an actor (parked cars: splats of the
background) come after those, by tracks, in the order in which the frames of the whole scene first
show them. So a number depends neither on the frames and cameras that are rendered nor on who
renders them.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from augment.box_pixels import PlacedBoxes, shown_pixels
from augment.cameras import Camera
from augment.labels import Boxes, LabelSource
from augment.scene import Scene
from augment.semantics import SemanticClass

MAX_INSTANCE = 65535  # instance images have 16 bits
# Classes that no labelled object is of: they lie under it, before it or behind it.
_NO_OBJECT = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
    SemanticClass.SKY,
    SemanticClass.WATER,
)
_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class Instances:
    """Numbers of the objects of one scene. Picklable.

    actors: their track_ids, in the scene's order. frames: numbers of all its frames. labels: None
    where there are no boxes.
    """

    actors: tuple[str, ...]
    frames: tuple[int, ...]
    labels: LabelSource | None

    @cached_property
    def by_track(self) -> Mapping[str, int]:
        """The number of every track. The first use reads the boxes of all frames; those of a frame
        that cannot be read are left out, for that is an error of the frame's own images.
        """
        numbers = {track_id: number for number, track_id in enumerate(self.actors, start=1)}
        labels = self.labels
        for frame in self.frames:
            try:
                boxes = Boxes.empty() if labels is None else labels.boxes(frame)
            except Exception as error:
                _log.debug("boxes of frame %d", frame, exc_info=error)
                continue
            for track_id in boxes.track_ids:
                numbers.setdefault(track_id, len(numbers) + 1)
        if len(numbers) > MAX_INSTANCE:
            _log.warning(
                "the scene has %d actors and tracks of boxes; instance images number %d of them, "
                "and the rest have instance 0",
                len(numbers),
                MAX_INSTANCE,
            )
        return numbers

    def agree(self, track_ids: tuple[str, ...], numbers: np.ndarray) -> bool:
        """Whether boxes numbered so earlier have these numbers today; of tracks that are known."""
        known = np.array([track_id in self.by_track for track_id in track_ids], bool)
        return bool((self.of(track_ids) == numbers)[known].all())

    def of(self, track_ids: tuple[str, ...]) -> UInt16[np.ndarray, " B"]:
        """The number of each box, by its track; 0 of what is no track of the scene's frames, or
        beyond MAX_INSTANCE.
        """
        numbers = np.array([self.by_track.get(track_id, 0) for track_id in track_ids], np.int64)
        return np.where(numbers > MAX_INSTANCE, 0, numbers).astype(np.uint16)


_remembered: WeakKeyDictionary[Scene, Instances] = WeakKeyDictionary()


def instances_of(scene: Scene) -> Instances:
    """The numbers of the scene's objects, remembered as long as the scene lives."""
    found = _remembered.get(scene)
    if found is None:
        actors = tuple(actor.track_id for actor in scene.actors)
        frames = tuple(sorted(frame.index for frame in scene.frames))
        found = _remembered[scene] = Instances(actors, frames, scene.labels)
    return found


def with_boxes(
    instance: UInt16[np.ndarray, "H W"],
    placed: PlacedBoxes,
    numbers: UInt16[np.ndarray, " B"],
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    classes: UInt8[np.ndarray, "H W"],
    num_actors: int,
) -> UInt16[np.ndarray, "H W"]:
    """The instance image of a scene's actors with the boxes that have none.

    A pixel of no actor shows the box in which its surface lies (`box_pixels.shown_pixels`), unless
    it is of a class that no object is of. Of several boxes it is that whose labelled sides enclose
    the surface before one of which it lies in the margin, and then the smaller one.

    numbers: of the boxes, those of actors up to num_actors. depth_m, classes: of the surfaces that
    the image shows, 0 = none.
    """
    free = (instance == 0) & ~np.isin(classes, _NO_OBJECT)
    volumes = np.prod(placed.sizes_m, axis=1)
    painted = instance.copy()
    for boxes in (placed, placed.without_margins()):
        shown = list(shown_pixels(boxes, camera, depth_m))
        # The last stays: the smallest, and of equal ones that of the lowest number.
        shown.sort(key=lambda pixels: (-volumes[pixels[0]], -int(numbers[pixels[0]])))
        for number, rows, columns in shown:
            if numbers[number] > num_actors:
                own = free[rows, columns]
                painted[rows[own], columns[own]] = numbers[number]
    return painted
