"""Rendering of an opened scene's images, one frame of one variant at a time, and their writing.

In: a scene, its frames and a `SceneSetup`. Out: files in the output folder, and an `Outcome` for
each image. `render_job` calls it. The same code runs in the job's own process and in its workers.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from augment.errors import GpuLost, OutputError
from augment.jobs.processes import InheritedLock, available_cores, shorten_switch_interval
from augment.jobs.time_shares import (
    ENCODE,
    LIDAR,
    MEASURE,
    RENDER,
    RENDERERS,
    WAIT_FOR_FILES,
    WAIT_FOR_VIEWS,
    WRITE,
    WRITERS,
    WorkTimes,
)
from augment.jobs.view_files import write_view
from augment.jobs.write_pump import WritePump
from augment.memo import memo_of
from augment.output.atomic import write_atomic
from augment.output.box_tables import BoxWeather
from augment.output.layout import item_paths, variant_name
from augment.output.manifest import FAILED, OK
from augment.output.tables import lidar_bytes, read_lidar_note
from augment.render.backends import gpu_is_lost, renders_on_gpu
from augment.scene.box_estimates import evidence_of
from augment.scene.boxes import Instances
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.moved_actors import RECORDED_SWEEPS
from augment.scene.scene import Scene
from augment.view.box_labels import label_view, uses_boxes
from augment.view.render_view import ViewPool
from augment.view.results import Pending, Renderer, ViewResult, check_view
from recipes.schema import Recipe

# ---- Frames rendered, labelled and written -------------------------------------------------------

# Longest message of a failure in the manifest, characters.
MESSAGE_LENGTH = 500
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Chunk:
    """Images of one frame under one recipe."""

    variant: int
    """Position in SceneSetup.recipes."""
    frame: int
    """Frame number."""
    cameras: tuple[str, ...]
    """Camera names."""


@dataclass(frozen=True)
class Outcome:
    """Result of one image."""

    variant: int
    """Position in SceneSetup.recipes."""
    frame: int
    """Frame number."""
    camera: str
    """Camera name."""
    status: str
    """`manifest.OK` or `manifest.FAILED`."""
    message: str = ""
    """Reason of a failure."""
    checksum: str = ""
    """SHA-256 of the image file, hexadecimal."""
    lidar: str | None = None
    """As of PassedLidar."""
    lidar_note: str | None = None
    """As `note` of PassedLidar."""
    box_weather: BoxWeather = field(default_factory=dict)
    """Measured numbers of the image's boxes."""
    measures: Mapping[str, float] = field(default_factory=dict)
    """Numbers that were measured of the image, as of ViewFiles."""


@dataclass(frozen=True)
class TaskFailed:
    """Result of a worker's task that could not be done."""

    text: str
    """Reason, for people."""
    is_output: bool = False
    """True if nothing can be written, so that every other task would fail too."""
    is_scene_error: bool = False
    """True if the scene could not be opened, so that its other blocks would fail too."""
    of_memory: bool = False
    """True if memory ran out: the task may succeed while no other worker uses any."""


class PassedLidar(NamedTuple):
    """LiDAR sweep of a frame in the output."""

    lidar: str | None = None
    """`weather` or `clean`; None where the frame has no sweep."""
    note: str | None = None
    """As of Recipe.lidar_note."""


def describe_error(error: BaseException, activity: str) -> str:
    """Return one line for the manifest: the activity, the error's type and its text.

    Args:
        activity: Activity that failed.
    """
    text = " ".join(f"{activity}: {type(error).__name__}: {error}".split())
    return text if len(text) <= MESSAGE_LENGTH else text[: MESSAGE_LENGTH - 3] + "..."


@dataclass(frozen=True, eq=False)
class _RenderedView:
    """Image whose rendering is done, or has begun."""

    chunk: Chunk
    """Chunk that the image belongs to."""
    recipe: Recipe
    """Recipe of the image."""
    camera: Camera
    """Camera at the written resolution."""
    lidar: Future
    """Result of `_pass_lidar` for the frame."""


class FrameRunner:
    """Renders chunks, and writes their files on other threads.

    The library's own renderer renders several views at once (`augment.view.render_view.ViewPool`)
    and hands them over in their order. Where another renderer returns pending views, the next view
    is begun before the last one is waited for, so that a GPU has work while pictures come back.

    An error of the scene or of the renderer fails one image; an OutputError or GpuLost ends the
    run.

    Attributes:
        setup: Recipes, output, backend and renderer.
        scene: Opened scene.
        frames: Frames to render; may hold more.
        deliver: Called with each image's Outcome by the writing threads, once its files are on the
            disk.
    """

    def __init__(
        self,
        setup: SceneSetup,
        scene: Scene,
        frames: Sequence[Frame],
        deliver: Callable[[Outcome], None],
    ) -> None:
        self._cameras = {f.index: f.cameras for f in frames}
        self._scene = scene
        self._setup = setup
        self._views = None
        renderer = setup.renderer
        if renderer is None:
            self._views = ViewPool(scene, setup.backend)
            renderer = self._views.begin
        self._renderer: Renderer = renderer
        self._ahead = 1 if self._views is None else self._views.num_in_flight
        self._deliver = deliver
        self._pump = _make_pump(setup)
        self._boxes: dict[int, Boxes] = {}  # by number of the frames read so far
        self._reading_boxes = threading.Lock()
        self._warned: set[str] = set()  # variants with a sweep that stayed clear
        self._in_flight: deque[tuple[_RenderedView, Pending]] = deque()
        self._times = WorkTimes()
        self._start_s = time.perf_counter()

    def run(self, chunk: Chunk) -> None:
        """Render the chunk's images. The last may stay in flight until `close` or later ones."""
        recipe = self._setup.recipes[chunk.variant]
        lidar = self._submit(lambda: self._pass_lidar(chunk, recipe))
        for name in chunk.cameras:
            self._render(chunk, recipe, name, lidar)

    def _finish_oldest_view(self) -> None:
        """Wait for the oldest view in flight and queue the writing of its files."""
        rendered, pending_view = self._in_flight[0]
        try:
            with self._times.measure(RENDER, WAIT_FOR_VIEWS):
                view = pending_view.result()
        except Exception as error:
            self._in_flight.popleft()
            self._fail(rendered.chunk, rendered.camera.name, error)
            return
        # Not earlier: after an interrupt, `close` still finishes the views in flight.
        self._in_flight.popleft()
        self._queue_writes(rendered, view)

    def close(self) -> dict[str, float]:
        """Wait for the writes, and raise the error that stopped them.

        Returns:
            Seconds by kind of work.
        """
        try:
            while self._in_flight:
                self._finish_oldest_view()
        finally:
            if self._views is not None:
                self._views.close()
            with self._times.measure(WAIT_FOR_FILES):
                self._pump.close()
        seconds = time.perf_counter() - self._start_s
        self._times.add(RENDERERS, seconds)
        self._times.add(WRITERS, seconds * self._pump.threads)
        return self._times.so_far()

    def _render(self, chunk: Chunk, recipe: Recipe, name: str, lidar: Future) -> None:
        """Render or begin one image; queue the writing of finished ones."""
        camera = self._cameras[chunk.frame][name]
        try:
            with self._times.measure(RENDER):
                view = self._renderer(self._scene, camera, recipe, backend=self._setup.backend)
        except Exception as error:
            self._fail(chunk, name, error)
            return
        rendered = _RenderedView(chunk, recipe, camera.scaled(recipe.render.scale), lidar)
        if isinstance(view, Pending):
            self._in_flight.append((rendered, view))
            while len(self._in_flight) > self._ahead:
                self._finish_oldest_view()
        else:
            self._queue_writes(rendered, view)

    def _queue_writes(self, rendered: _RenderedView, view: ViewResult) -> None:
        """Queue the writing of a view's files."""
        try:
            check_view(view, rendered.camera, rendered.recipe)
        except Exception as error:
            self._fail(rendered.chunk, rendered.camera.name, error)
            return
        self._submit(lambda: self._write(rendered, view))

    def _fail(self, chunk: Chunk, name: str, error: Exception) -> None:
        """Queue the failure of one image; raise GpuLost where the GPU no longer answers."""
        _log.debug("frame %d, camera %s", chunk.frame, name, exc_info=error)
        message = describe_error(error, "rendering")
        if gpu_is_lost(self._setup.backend):
            self._in_flight.clear()
            raise GpuLost(
                f"the GPU no longer answers this process since frame {chunk.frame}, camera {name} "
                f"({message}); start the same again to go on from there"
            ) from error
        outcome = Outcome(chunk.variant, chunk.frame, name, FAILED, message)
        self._submit(lambda: self._deliver(outcome))

    def _submit(self, task: Callable[[], Any]) -> Future:
        """Queue a task of the writing threads; waiting for a free place is WAIT_FOR_FILES."""
        with self._times.measure(WAIT_FOR_FILES):
            return self._pump.submit(task)

    def _write(self, rendered: _RenderedView, view: ViewResult) -> None:
        """Write the files of a view; it is delivered once its frame's sweep is written too."""
        chunk = rendered.chunk
        recipe = rendered.recipe
        name = rendered.camera.name
        paths = item_paths(self._scene.name, recipe, name, chunk.frame)
        failed_outcome = Outcome(chunk.variant, chunk.frame, name, FAILED)
        activity = "measuring the boxes"
        try:
            with self._times.measure(MEASURE):
                view, box_weather = self._label(chunk.frame, recipe, rendered.camera, view)
            activity = "encoding"
            written_files = write_view(
                Path(self._setup.out_dir), paths, view, rendered.camera, recipe
            )
        except OutputError:
            raise
        except Exception as error:
            _log.debug("frame %d, camera %s", chunk.frame, name, exc_info=True)
            self._deliver(replace(failed_outcome, message=describe_error(error, activity)))
            return
        self._times.add(ENCODE, written_files.encode_s)
        self._times.add(WRITE, written_files.write_s)
        outcome = replace(
            failed_outcome,
            status=OK,
            checksum=written_files.checksum,
            box_weather=box_weather,
            measures=written_files.measures,
        )
        self._pump.after(
            rendered.lidar, lambda: self._complete(outcome, rendered.lidar, written_files.files)
        )

    def _complete(self, outcome: Outcome, lidar: Future, files: tuple[str, ...]) -> None:
        """Deliver an image whose files are written, or a failure where its sweep has failed."""
        sweep_result = lidar.result()
        if isinstance(sweep_result, str):
            for file in files:
                (Path(self._setup.out_dir) / file).unlink(missing_ok=True)
            outcome = Outcome(outcome.variant, outcome.frame, outcome.camera, FAILED, sweep_result)
        else:
            outcome = replace(outcome, lidar=sweep_result.lidar, lidar_note=sweep_result.note)
        with self._times.measure(WRITE):
            self._deliver(outcome)

    def _label(
        self, frame: int, recipe: Recipe, camera: Camera, view: ViewResult
    ) -> tuple[ViewResult, BoxWeather]:
        """Return the view with its frame's boxes and their numbers, where the recipe asks
        for them.
        """
        if not uses_boxes(recipe) or frame not in self._setup.labelled:
            return view, {}
        with self._reading_boxes:
            if frame not in self._boxes:
                self._boxes[frame] = self._scene.boxes(frame)
        origin = np.asarray(self._scene.world_origin_m, np.float64)
        boxes = self._boxes[frame]
        return label_view(
            boxes,
            self._setup.instances,
            origin,
            camera,
            view,
            recipe,
            evidence=lambda: evidence_of(self._scene, frame),
        )

    def _pass_lidar(self, chunk: Chunk, recipe: Recipe) -> PassedLidar | str:
        """Write the frame's sweep, in the weather or clean, unless it exists already.

        Returns:
            State of the sweep, or a message where it cannot be read.
        """
        if recipe.lidar is None or chunk.frame not in self._setup.labelled:
            return PassedLidar()
        paths = item_paths(self._scene.name, recipe, "", chunk.frame)
        target = Path(self._setup.out_dir) / (paths["lidar"] or "")
        is_moved = bool(self._scene.moved_instances)
        if target.exists() and not self._setup.overwrite:
            with contextlib.suppress(OutputError):  # a damaged file is written again
                return _lidar_entries(recipe, read_lidar_note(target), is_moved)
        with self._times.measure(LIDAR):
            try:
                sweep = self._scene.lidar(chunk.frame)
                if sweep is None:
                    return PassedLidar()
                sweep, fault = self._weathered(sweep, chunk.frame, recipe)
                data = lidar_bytes(sweep, note=fault)
            except Exception as error:
                return describe_error(error, "reading the LiDAR sweep")
            write_atomic(target, data, clear=False)
            return _lidar_entries(recipe, fault, is_moved)

    def _weathered(
        self, sweep: LidarSweep, frame: int, recipe: Recipe
    ) -> tuple[LidarSweep, str | None]:
        """Return the sweep as the recipe asks for it, and why it has no weather although it should.

        Where only `auto` asks for weather, a sweep that cannot have it passes through clean.
        """
        if recipe.lidar != "weather":
            return sweep, None
        from augment.view.weathered_sweep import weathered_sweep

        try:
            return weathered_sweep(self._scene, recipe, frame, sweep), None
        except Exception as error:
            if recipe.output.lidar != "auto":
                raise
            fault = describe_error(error, "no weather on this sweep")
            variant = variant_name(recipe)
            if variant not in self._warned:  # the manifest notes its other frames
                self._warned.add(variant)
                _log.warning("%s, frame %d: LiDAR passes through: %s", variant, frame, fault)
            return sweep, fault


def _lidar_entries(recipe: Recipe, fault: str | None, is_moved: bool) -> PassedLidar:
    """Return the manifest's entries of a sweep.

    Args:
        fault: Reason why it has no weather although it should; None otherwise.
        is_moved: If True, actors of the scene are elsewhere than in the sweep.
    """
    lidar = recipe.lidar if fault is None else "clean"
    note = recipe.lidar_note(lidar)
    if fault is not None:
        note = f"{note}: {fault}"
    if is_moved:
        note = RECORDED_SWEEPS if note is None else f"{RECORDED_SWEEPS}; {note}"
    return PassedLidar(lidar, note)


def _make_pump(setup: SceneSetup) -> WritePump:
    """Return the writing threads of one worker.

    A GPU leaves the cores free, and renders faster than one core can encode. A CPU backend renders
    on the same cores: two threads write. One thread and a short queue do where there are several
    workers, because the memory of waiting views counts once per worker.
    """
    if renders_on_gpu(setup.backend):
        cores = max(1, available_cores() // setup.workers)
        return WritePump(cores, cores + 2)
    return WritePump() if setup.workers == 1 else WritePump(threads=1, waiting=2)


# ---- The worker of one open scene ----------------------------------------------------------------


@dataclass(frozen=True)
class SceneSetup:
    """Everything that the workers of one scene share; small, and picklable if its parts are."""

    out_dir: str
    """Output folder."""
    recipes: tuple[Recipe, ...]
    """Resolved recipes, one for each variant."""
    backend: str
    """Name of the rasteriser's backend."""
    renderer: Renderer | None
    """Renderer of the images; the library's own if None."""
    open_scene: Callable[[], tuple[Scene, Sequence[Frame]]]
    """Opens the scene, with its frames, in the worker's process."""
    labelled: frozenset[int]
    """Numbers of the frames whose labels and LiDAR pass through."""
    instances: Instances
    """Numbers of the scene's objects."""
    memo: Mapping[Hashable, Any]
    """Data that the recipes' images share; the memo of the opened scene takes it over."""
    overwrite: bool
    """If True, LiDAR sweeps that exist already are written again."""
    workers: int = 1
    """Number of workers."""
    lock: InheritedLock | None = None
    """Held only: the output stays locked for the job until its last worker ends."""

    @property
    def output(self) -> str:
        """Output folder, for messages."""
        return self.out_dir

    def worker(self, on_outcome: Callable[[Outcome], None]) -> SceneWorker:
        """Return a worker for this process."""
        return SceneWorker(self, on_outcome)


class SceneWorker:
    """Worker that renders chunks.

    A task is a tuple of chunks; its result is the seconds by kind of work.
    """

    def __init__(self, setup: SceneSetup, on_outcome: Callable[[Outcome], None]) -> None:
        self._setup = setup
        self._on_outcome = on_outcome
        self._opened: tuple[Scene, Sequence[Frame]] | None = None

    def do(self, task: tuple[Chunk, ...]) -> dict[str, float] | TaskFailed:
        """Render the task's chunks, and wait until their files are written."""
        if self._opened is None:
            self._opened = self._setup.open_scene()
            memo_of(self._opened[0].as_recorded).take_shared(self._setup.memo)
        try:
            with shorten_switch_interval(renders_on_gpu(self._setup.backend)):
                runner = FrameRunner(self._setup, *self._opened, self._on_outcome)
                try:
                    for chunk in task:
                        runner.run(chunk)
                finally:
                    seconds = runner.close()
        except OutputError as error:
            return TaskFailed(str(error), is_output=True)
        return seconds
