"""Renders the items of an opened scene, one frame of one variant at a time, and writes them.

The same code runs in the job's own process and in its workers.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from augment.boxes import Instances
from augment.cameras import Camera
from augment.errors import GpuLost, OutputError
from augment.jobs.atomic import write_atomic
from augment.jobs.backends import gpu_is_lost, renders_on_gpu
from augment.jobs.files import frames_from_json
from augment.jobs.layout import item_paths, variant_name
from augment.jobs.manifest import FAILED, OK
from augment.jobs.prepare import StoredBed, StoredMaps
from augment.jobs.tables import lidar_bytes, read_lidar_note
from augment.jobs.times import (
    AWAIT,
    ENCODE,
    HELD,
    LIDAR,
    MEASURE,
    RENDER,
    RENDERERS,
    WRITE,
    WRITERS,
    WorkTimes,
)
from augment.jobs.view_files import (
    BoxWeather,
    View,
    WritePump,
    check_view,
    label_view,
    uses_boxes,
    write_view,
)
from augment.labels import Boxes, LidarSweep
from augment.scene import Scene
from recipes.schema import Recipe

MESSAGE_LENGTH = 500
_log = logging.getLogger(__name__)


@runtime_checkable
class Renderer(Protocol):
    """`augment.views.render_view`, `begin_view`, or a stand-in.

    Returns a `writer.View`, or a `Pending` one: a job then begins the next view before it waits.
    """

    def __call__(self, scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> Any: ...


@runtime_checkable
class Pending(Protocol):
    """A view that is begun; `augment.views.PendingView` is one."""

    def result(self) -> Any:
        """The `writer.View`, once it is there."""
        ...


@dataclass(frozen=True)
class Setup:
    """What rendering needs besides the scene; small, and picklable.

    camera_path: JSON of `trajectory`, or None for the scene's frames. labelled: numbers of the
    frames whose labels and LiDAR pass through. instances: of the scene's objects. beds: where the
    recipes' snow can lie; the scene to render remembers them. maps: those of the recipes' styles.
    """

    out_dir: str
    recipes: tuple[Recipe, ...]
    backend: str
    camera_path: str | None
    labelled: frozenset[int]
    instances: Instances
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

    lidar, lidar_note: as of PassedLidar. box_weather: what is seen of its boxes, and what each
    effect of the recipe does to them, where there are labels.
    """

    variant: int
    frame: int
    camera: str
    status: str
    message: str = ""
    checksum: str = ""
    lidar: str | None = None
    lidar_note: str | None = None
    box_weather: BoxWeather = field(default_factory=dict)


class PassedLidar(NamedTuple):
    """A frame's sweep. lidar: weather or clean, None without one. note: as of Recipe.lidar_note."""

    lidar: str | None = None
    note: str | None = None


def describe(error: BaseException, doing: str) -> str:
    """One line for the manifest: what was being done, the error's type and what it says."""
    text = " ".join(f"{doing}: {type(error).__name__}: {error}".split())
    return text if len(text) <= MESSAGE_LENGTH else text[: MESSAGE_LENGTH - 3] + "..."


def default_renderer() -> Renderer:
    """The library's own; imported only here, for it brings the rasteriser."""
    from augment.views import render_view

    return render_view


def job_renderer(backend: str) -> Renderer:
    """The library's own for a job: on a GPU it begins views and does not wait for them.

    On the CPU a begun view would be a finished one, whose files would come a view too late.
    """
    from augment.views import begin_view, render_view

    return begin_view if renders_on_gpu(backend) else render_view


@dataclass(frozen=True, eq=False)
class _Drawn:
    """An image that the renderer has drawn, or begun. camera: at the written resolution.

    lidar: what `_pass_lidar` says of its frame.
    """

    chunk: Chunk
    recipe: Recipe
    camera: Camera
    lidar: Future


class FrameRunner:
    """Renders chunks in this thread, writes on others, and tells `deliver` of each image.

    Where the renderer returns pending views one of them is in flight: the next is begun before the
    last one is waited for, so that a GPU has work while its pictures come back and are handed over.

    deliver: called from the writing threads, after all files of the image are on the disk.
    An error of the scene or the renderer concerns one image. An OutputError ends the run, since the
    next write would fail too, and so does GpuLost.
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
        self._renderer = renderer or job_renderer(setup.backend)
        self._deliver, self._pump = deliver, pump
        self._maps = {stored.style: stored for stored in setup.maps}
        self._boxes: dict[int, Boxes] = {}  # of the frames so far
        self._reading_boxes = threading.Lock()
        self._warned: set[str] = set()  # variants of which a sweep could not be weathered
        self._in_flight: tuple[_Drawn, Pending] | None = None
        self._times, self._started = WorkTimes(), time.perf_counter()

    def run(self, chunk: Chunk, stopped: Callable[[], bool] = lambda: False) -> None:
        """Render the chunk's images; those not begun when `stopped()` turns true are left.

        The last of them may still be in flight afterwards, until `land` or the next one.
        """
        recipe = self._setup.recipes[chunk.variant]
        if recipe.style in self._maps:  # one at a time: a scene remembers few
            self._maps[recipe.style].take_over(self._scene)
        lidar = self._submit(lambda: self._pass_lidar(chunk, recipe))
        for name in chunk.cameras:
            if stopped():
                return
            self._render(chunk, recipe, name, lidar)

    def land(self) -> None:
        """Wait for the view in flight, if there is one, and hand it over."""
        if self._in_flight is None:
            return
        drawn, pending = self._in_flight
        try:
            with self._times.spent(RENDER, AWAIT):
                view = pending.result()
        except Exception as error:
            self._in_flight = None
            self._fail(drawn.chunk, drawn.camera.name, error)
            return
        self._in_flight = None  # no sooner: what an interrupt finds in flight is left to `close`
        self._hand_over(drawn, view)

    def close(self) -> dict[str, float]:
        """Wait for the writes; raises what stopped them. Returns the seconds by `times`' kinds."""
        try:
            self.land()
        finally:
            with self._times.spent(HELD):
                self._pump.close()
        seconds = time.perf_counter() - self._started
        self._times.add(RENDERERS, seconds)
        self._times.add(WRITERS, seconds * self._pump.threads)
        return self._times.so_far()

    def _render(self, chunk: Chunk, recipe: Recipe, name: str, lidar: Future) -> None:
        camera = self._cameras[chunk.frame][name]
        try:
            with self._times.spent(RENDER):
                view = self._renderer(self._scene, camera, recipe, backend=self._setup.backend)
        except Exception as error:
            self._fail(chunk, name, error)
            return
        drawn = _Drawn(chunk, recipe, camera.scaled(recipe.render.scale), lidar)
        if isinstance(view, Pending):
            self.land()
            self._in_flight = drawn, view
        else:
            self._hand_over(drawn, view)

    def _hand_over(self, drawn: _Drawn, view: View) -> None:
        """Give a view to the writing threads."""
        try:
            check_view(view, drawn.camera, drawn.recipe)
        except Exception as error:
            self._fail(drawn.chunk, drawn.camera.name, error)
            return
        self._submit(lambda: self._write(drawn, view))

    def _fail(self, chunk: Chunk, name: str, error: Exception) -> None:
        _log.debug("frame %d, camera %s", chunk.frame, name, exc_info=error)
        message = describe(error, "rendering")
        if gpu_is_lost(self._setup.backend):
            raise GpuLost(
                f"the GPU no longer answers this process since frame {chunk.frame}, camera {name} "
                f"({message}); start the same again to go on from there"
            ) from error
        outcome = Outcome(chunk.variant, chunk.frame, name, FAILED, message)
        self._submit(lambda: self._deliver(outcome))

    def _submit(self, task: Callable[[], Any]) -> Future:
        with self._times.spent(HELD):
            return self._pump.submit(task)

    def _write(self, drawn: _Drawn, view: View) -> None:
        """Write the files of a view; it is delivered when its frame's sweep is there too."""
        chunk, recipe, name = drawn.chunk, drawn.recipe, drawn.camera.name
        paths = item_paths(self._scene.name, recipe, name, chunk.frame)
        failed = Outcome(chunk.variant, chunk.frame, name, FAILED)
        doing = "measuring the boxes"
        try:
            with self._times.spent(MEASURE):
                view, box_weather = self._label(chunk.frame, recipe, drawn.camera, view)
            doing = "encoding"
            written = write_view(Path(self._setup.out_dir), paths, view, recipe)
        except OutputError:
            raise
        except Exception as error:
            _log.debug("frame %d, camera %s", chunk.frame, name, exc_info=True)
            self._deliver(replace(failed, message=describe(error, doing)))
            return
        self._times.add(ENCODE, written.encode_s)
        self._times.add(WRITE, written.write_s)
        done = replace(failed, status=OK, checksum=written.checksum, box_weather=box_weather)
        self._pump.after(drawn.lidar, lambda: self._complete(done, drawn.lidar, written.files))

    def _complete(self, done: Outcome, lidar: Future, files: tuple[str, ...]) -> None:
        """Deliver an image whose files are there, or a failure where its sweep has failed."""
        passed = lidar.result()
        if isinstance(passed, str):
            for file in files:
                (Path(self._setup.out_dir) / file).unlink(missing_ok=True)
            done = Outcome(done.variant, done.frame, done.camera, FAILED, passed)
        else:
            done = replace(done, lidar=passed.lidar, lidar_note=passed.note)
        with self._times.spent(WRITE):
            self._deliver(done)

    def _label(
        self, frame: int, recipe: Recipe, camera: Camera, view: View
    ) -> tuple[View, BoxWeather]:
        """The view with the frame's boxes, and what is measured of them, where they are wanted."""
        if not uses_boxes(recipe) or frame not in self._setup.labelled:
            return view, {}
        with self._reading_boxes:
            if frame not in self._boxes:
                self._boxes[frame] = self._scene.boxes(frame)
        origin = np.asarray(self._scene.world_origin_m, np.float64)
        boxes = self._boxes[frame]
        return label_view(boxes, self._setup.instances, origin, camera, view, recipe)

    def _pass_lidar(self, chunk: Chunk, recipe: Recipe) -> PassedLidar | str:
        """Write the frame's sweep, in the weather or as it is, unless it is there already.

        Returns what became of it, or a message where it cannot be read.
        """
        if recipe.lidar is None or chunk.frame not in self._setup.labelled:
            return PassedLidar()
        paths = item_paths(self._scene.name, recipe, "", chunk.frame)
        assert paths.lidar is not None
        target = Path(self._setup.out_dir) / paths.lidar
        if target.exists():
            with contextlib.suppress(OutputError):  # a damaged one is written anew
                return _passed(recipe, read_lidar_note(target))
        with self._times.spent(LIDAR):
            try:
                sweep = self._scene.lidar(chunk.frame)
                if sweep is None:
                    return PassedLidar()
                sweep, fault = self._weathered(sweep, chunk.frame, recipe)
                data = lidar_bytes(sweep, note=fault)
            except Exception as error:
                return describe(error, "reading the LiDAR sweep")
            write_atomic(target, data, clear=False)
            return _passed(recipe, fault)

    def _weathered(
        self, sweep: LidarSweep, frame: int, recipe: Recipe
    ) -> tuple[LidarSweep, str | None]:
        """The sweep as the recipe wants it. Where only `auto` asks for weather, one that cannot
        have it is passed through, with the reason."""
        if recipe.lidar != "weather":
            return sweep, None
        from augment.effects.lidar.beam import weathered_sweep

        try:
            return weathered_sweep(self._scene, recipe, frame, sweep), None
        except Exception as error:
            if recipe.output.lidar != "auto":
                raise
            fault = describe(error, "no weather on this sweep")
            variant = variant_name(recipe)
            if variant not in self._warned:  # of its other frames the manifest tells
                self._warned.add(variant)
                _log.warning("%s, frame %d: LiDAR passes through: %s", variant, frame, fault)
            return sweep, fault


def _passed(recipe: Recipe, fault: str | None) -> PassedLidar:
    """What the manifest says of a sweep. fault: why it has no weather, where it should have."""
    if fault is None:
        return PassedLidar(recipe.lidar, recipe.lidar_note(recipe.lidar))
    return PassedLidar("clean", f"{recipe.lidar_note('clean')}: {fault}")
