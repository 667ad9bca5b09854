"""Renders the items of an opened scene, one frame of one variant at a time, and writes them.

The same code runs in the job's own process and in its workers.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from augment.batch.atomic import write_atomic
from augment.batch.box_weather import BoxWeather, has_box_weather, measure_boxes
from augment.batch.label_files import lidar_bytes
from augment.batch.layout import item_paths
from augment.batch.manifest import FAILED, OK
from augment.batch.snow_beds import StoredBed
from augment.batch.style_maps import StoredMaps
from augment.batch.trajectory import frames_from_json
from augment.batch.writer import View, WritePump, check_view, write_view
from augment.cameras import Camera
from augment.labels import Boxes
from augment.scene import Scene
from recipes.schema import Recipe

MESSAGE_LENGTH = 500
_log = logging.getLogger(__name__)


@runtime_checkable
class Renderer(Protocol):
    """`augment.apply.render_view`, or a stand-in. Returns a `writer.View`."""

    def __call__(self, scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> Any: ...


@dataclass(frozen=True)
class Setup:
    """What rendering needs besides the scene; small, and picklable.

    camera_path: JSON of `trajectory`, or None for the scene's frames. labelled: numbers of the
    frames whose labels and LiDAR pass through. beds: where the recipes' snow can lie; the scene to
    render remembers them. maps: those of the recipes' styles.
    """

    out_dir: str
    recipes: tuple[Recipe, ...]
    backend: str
    camera_path: str | None
    labelled: frozenset[int]
    beds: tuple[StoredBed, ...] = ()
    maps: tuple[StoredMaps, ...] = ()


@dataclass(frozen=True)
class Chunk:
    """Images of one frame under one recipe. variant: position in Setup.recipes."""

    variant: int
    frame: int
    cameras: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """What became of one image.

    lidar: whether the frame has a sweep. box_weather: what each effect of the recipe does to its
    boxes, where there are labels. seconds: by kind of work.
    """

    variant: int
    frame: int
    camera: str
    status: str
    message: str = ""
    checksum: str = ""
    lidar: bool = False
    box_weather: BoxWeather = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


def describe(error: BaseException, doing: str) -> str:
    """One line for the manifest: what was being done, the error's type and what it says."""
    text = " ".join(f"{doing}: {type(error).__name__}: {error}".split())
    return text if len(text) <= MESSAGE_LENGTH else text[: MESSAGE_LENGTH - 3] + "..."


def default_renderer() -> Renderer:
    """The library's own; imported only here, for it brings the rasteriser."""
    from augment.apply import render_view

    return render_view


class FrameRunner:
    """Renders chunks in this thread, writes on others, and tells `deliver` of each image.

    deliver: called from the writing threads, after all files of the image are on the disk.
    An error of the scene or the renderer concerns one image; an OutputError ends the run, since
    the next write would fail too.
    """

    def __init__(
        self,
        scene: Scene,
        setup: Setup,
        renderer: Renderer | None,
        deliver: Callable[[Outcome], None],
        pump: WritePump,
    ) -> None:
        frames = scene.frames
        if setup.camera_path is not None:
            frames = frames_from_json(setup.camera_path)
        self._cameras = {f.index: f.cameras for f in frames}
        self._scene, self._setup = scene, setup
        self._renderer = renderer or default_renderer()
        self._deliver, self._pump = deliver, pump
        self._maps = {stored.style: stored for stored in setup.maps}
        self._boxes: dict[int, Boxes] = {}  # of the frames so far

    def run(self, chunk: Chunk, stopped: Callable[[], bool] = lambda: False) -> None:
        """Render the chunk's images; those not begun when `stopped()` turns true are left."""
        recipe = self._setup.recipes[chunk.variant]
        if recipe.style in self._maps:  # one at a time: a scene remembers few
            self._maps[recipe.style].take_over(self._scene)
        lidar = self._pump.submit(lambda: self._pass_lidar(chunk, recipe))
        for name in chunk.cameras:
            if stopped():
                return
            self._render(chunk, recipe, name, lidar)

    def close(self) -> None:
        """Wait for the writes; raises what stopped them."""
        self._pump.close()

    def _render(self, chunk: Chunk, recipe: Recipe, name: str, lidar: Future) -> None:
        camera = self._cameras[chunk.frame][name]
        started = time.perf_counter()
        doing = "rendering"
        try:
            view = self._renderer(self._scene, camera, recipe, backend=self._setup.backend)
            written = camera.scaled(recipe.render.scale)
            check_view(view, written, recipe)
            doing = "measuring the boxes in the weather"
            box_weather = self._measure(chunk.frame, recipe, written, view)
        except Exception as error:
            _log.debug("frame %d, camera %s", chunk.frame, name, exc_info=True)
            message = describe(error, doing)
            outcome = Outcome(chunk.variant, chunk.frame, name, FAILED, message)
            self._pump.submit(lambda: self._deliver(outcome))
            return
        render_s = time.perf_counter() - started
        done = Outcome(
            chunk.variant,
            chunk.frame,
            name,
            OK,
            box_weather=box_weather,
            seconds={"render": render_s},
        )
        self._pump.submit(lambda: self._write(done, recipe, view, lidar))

    def _measure(self, frame: int, recipe: Recipe, camera: Camera, view: View) -> BoxWeather:
        """What the weather does to the frame's boxes; nothing without labels."""
        has_labels = recipe.output.labels and frame in self._setup.labelled
        if not has_labels or not has_box_weather(view):
            return {}
        if frame not in self._boxes:
            self._boxes[frame] = self._scene.boxes(frame)
        origin = np.asarray(self._scene.world_origin_m, np.float64)
        return measure_boxes(self._boxes[frame], origin, camera, view)

    def _write(self, done: Outcome, recipe: Recipe, view: View, lidar: Future) -> None:
        """Write the files of a view and deliver `done`, completed, or a failure in its place."""
        out_dir = Path(self._setup.out_dir)
        paths = item_paths(self._scene.name, recipe, done.camera, done.frame)
        passed = lidar.result()
        if isinstance(passed, str):
            self._deliver(Outcome(done.variant, done.frame, done.camera, FAILED, passed))
            return
        try:
            written = write_view(out_dir, paths, view, recipe)
        except ValueError as error:
            message = describe(error, "encoding")
            self._deliver(Outcome(done.variant, done.frame, done.camera, FAILED, message))
            return
        seconds = {**done.seconds, "encode": written.encode_s, "write": written.write_s}
        self._deliver(replace(done, checksum=written.checksum, lidar=passed, seconds=seconds))

    def _pass_lidar(self, chunk: Chunk, recipe: Recipe) -> bool | str:
        """Write the frame's sweep, in the weather or as it is, unless it is there already.

        Returns whether the frame has one, or a message where it cannot be read.
        """
        if not recipe.output.lidar or chunk.frame not in self._setup.labelled:
            return False
        paths = item_paths(self._scene.name, recipe, "", chunk.frame)
        assert paths.lidar is not None
        target = Path(self._setup.out_dir) / paths.lidar
        if target.exists():
            return True
        try:
            sweep = self._scene.lidar(chunk.frame)
            if sweep is not None and recipe.output.lidar == "weather":
                from augment.lidar_weather.apply import weathered_sweep  # it brings the kernels

                sweep = weathered_sweep(self._scene, recipe, chunk.frame, sweep)
            data = None if sweep is None else lidar_bytes(sweep)
        except Exception as error:
            return describe(error, "reading the LiDAR sweep")
        if data is None:
            return False
        write_atomic(target, data)
        return True
