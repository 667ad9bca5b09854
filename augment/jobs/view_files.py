"""Writes one finished view: its buffers first, its image last, each file whole or absent."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from augment.boxes import Instances, PlacedBoxes, with_boxes
from augment.cameras import Camera
from augment.effects.snow.snow import placed_in_snow
from augment.jobs.atomic import write_atomic
from augment.jobs.backends import renders_on_gpu
from augment.jobs.box_tables import BoxWeather, View, measure_boxes
from augment.jobs.files import encode_depth, encode_ids, encode_image, encode_mask
from augment.jobs.layout import ItemPaths
from augment.jobs.processes import uninterrupted
from augment.labels import Boxes
from recipes.schema import Recipe


@dataclass(frozen=True)
class Written:
    """checksum: SHA-256 of the image file, hexadecimal. files: relative to the output folder.
    Times in seconds.
    """

    checksum: str
    files: tuple[str, ...]
    encode_s: float
    write_s: float


def check_view(view: View, camera: Camera, recipe: Recipe) -> None:
    """Raise ValueError unless the view has the camera's size and the buffers the recipe asks for.
    camera: at the written resolution.
    """
    output, weather = recipe.output, recipe.weather
    has_flood, has_snow = weather.flood is not None, weather.snow is not None
    _check_fact("water level", view.flood is not None, "a flood", has_flood)
    _check_fact("snow depth", view.snowy is not None, "snow", has_snow)
    _check_fact("smog density", view.smoggy is not None, "smog", weather.smog is not None)
    wanted = {
        "rgb": True,
        "depth_m": output.depth != "none",
        "semantic": output.semantic,
        "instance": output.instance,
        "water": has_flood,
        "snow": has_snow,
    }
    for name, needed in wanted.items():
        buffer = getattr(view, name)
        if (buffer is not None) != needed:
            raise ValueError(
                f"the renderer returned {'no' if needed else 'a'} {name} buffer, which the "
                f"recipe {'asks' if needed else 'does not ask'} for"
            )
        if needed and buffer.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"the renderer returned {name} of {list(buffer.shape)}; camera {camera.name!r} "
                f"writes {camera.height} rows of {camera.width} pixels"
            )


def _check_fact(fact: str, is_given: bool, effect: str, is_wanted: bool) -> None:
    if is_given != is_wanted:
        raise ValueError(
            f"the renderer returned {'a' if is_given else 'no'} {fact} for a recipe "
            f"{'with' if is_wanted else 'without'} {effect}"
        )


def write_view(out_dir: Path, paths: ItemPaths, view: View, recipe: Recipe) -> Written:
    """Encode and write all files of a view that `check_view` has passed. Raises ValueError: a
    buffer has another type or shape than View says. OutputError: the system refused; no partial
    file is left.
    """
    started = time.perf_counter()
    files: dict[str, bytes] = {}
    if paths.depth is not None:
        assert view.depth_m is not None
        files[paths.depth] = encode_depth(view.depth_m)
    if paths.semantic is not None:
        assert view.semantic is not None
        files[paths.semantic] = encode_ids(view.semantic, np.uint8)
    if paths.instance is not None:
        assert view.instance is not None
        files[paths.instance] = encode_ids(view.instance, np.uint16)
    if paths.water is not None:
        assert view.water is not None
        files[paths.water] = encode_mask(view.water)
    if paths.snow is not None:
        assert view.snow is not None
        files[paths.snow] = encode_mask(view.snow)
    files[paths.image] = encode_image(view.rgb, recipe.output)
    checksum = hashlib.sha256(files[paths.image]).hexdigest()
    encoded = time.perf_counter()
    for relative, data in files.items():
        write_atomic(out_dir / relative, data, clear=False)
    return Written(checksum, tuple(files), encoded - started, time.perf_counter() - encoded)


class WritePump:
    """Runs writes on threads beside the renderer, with few waiting: memory stays bounded. OpenCV's
    encoders and file writes release the GIL, so they overlap with rendering. The first exception of
    a task stops the pump: `submit` and `close` raise it.
    """

    def __init__(self, threads: int = 2, waiting: int = 4) -> None:
        """waiting: how many tasks there are at most, those included that threads are at."""
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="writer")
        self._slots = threading.BoundedSemaphore(waiting)
        self._error: BaseException | None = None

    @staticmethod
    def beside(backend: str, cores: int) -> WritePump:
        """For pictures that `backend` draws in a process that has so many cores. A CPU backend
        draws on the same cores, so two threads do. A GPU leaves all cores free, and draws faster
        than one of them can encode. Two pictures more than threads wait, so that none is idle while
        one is handed over.
        """
        return WritePump(cores, cores + 2) if renders_on_gpu(backend) else WritePump()

    def submit(self, task: Callable[[], Any]) -> Future:
        """Queue a task; blocks while too many wait. Tasks start in the order they come."""
        if self._slots.acquire(blocking=False):
            return self._queue(task)
        # What has been drawn is written also where an interrupt comes during the wait.
        return uninterrupted(lambda: self._queue_when_free(task))

    def _queue_when_free(self, task: Callable[[], Any]) -> Future:
        self._slots.acquire()
        return self._queue(task)

    def _queue(self, task: Callable[[], Any]) -> Future:
        if self._error is not None:
            self._slots.release()
            raise self._error
        future = self._pool.submit(task)
        future.add_done_callback(self._done)
        return future

    def after(self, future: Future, task: Callable[[], Any]) -> None:
        """Run a short task as soon as `future` is done: now, or in the thread that is at it. So no
        thread waits for another one's task.
        """

        def run(_: Future) -> None:
            try:
                task()
            except BaseException as error:  # a future would only log it
                self._error = self._error or error

        future.add_done_callback(run)

    def close(self) -> None:
        """Wait for all tasks. Raises what one of them raised."""
        self._pool.shutdown(wait=True)
        if self._error is not None:
            raise self._error

    def _done(self, future: Future) -> None:
        self._error = self._error or future.exception()
        self._slots.release()


def uses_boxes(recipe: Recipe) -> bool:
    """Whether images of the recipe take the boxes of their frame."""
    return recipe.output.labels or recipe.output.instance


def label_view(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: View,
    recipe: Recipe,
) -> tuple[View, BoxWeather]:
    """One of a frame's images with the frame's boxes: in the instance image those that have no
    actor, too; and what is measured of them, where labels are written. camera: at the written
    resolution. view: one that `check_view` has passed.
    """
    measured: BoxWeather = {}
    if recipe.output.labels:
        measured = measure_boxes(boxes, instances, world_origin_m, camera, view)
    surface = view.surface
    if view.instance is None or surface is None:
        return view, measured
    assert surface.shown_depth_m is not None and surface.shown_classes is not None
    placed = PlacedBoxes.of(boxes, world_origin_m)
    if surface.shown_snow_m:
        placed = placed_in_snow(placed, surface.shown_snow_m)
    painted = with_boxes(
        view.instance,
        placed,
        instances.of(boxes.track_ids),
        camera,
        surface.shown_depth_m,
        surface.shown_classes,
        len(instances.actors),
    )
    changed: Any = view
    return dataclasses.replace(changed, instance=painted), measured
