"""Renders the items of an opened scene, one frame of one variant at a time, and writes them.

The same code runs in the job's own process and in its workers.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from augment.box_estimates import evidence_of
from augment.boxes import Instances
from augment.cameras import Camera, Frame
from augment.errors import GpuLost, OutputError
from augment.jobs.atomic import write_atomic
from augment.jobs.files import (
    BoxWeather,
    View,
    WritePump,
    check_view,
    label_view,
    uses_boxes,
    write_view,
)
from augment.jobs.layout import item_paths, variant_name
from augment.jobs.manifest import FAILED, OK
from augment.jobs.processes import (
    InheritedLock,
    available_cores,
    gpu_is_lost,
    quick_turns,
    renders_on_gpu,
)
from augment.jobs.tables import lidar_bytes, read_lidar_note
from augment.labels import Boxes, LidarSweep
from augment.memo import memo_of
from augment.scene import Scene
from recipes.schema import Recipe

# ---- Where a job's time goes: seconds by kind of work, and what the job was bound by -------------
# In every worker one thread renders and hands finished views to threads that encode and write them.
# The rendering thread waits (is *held*) when these have too much in hand, and at the end for what
# they still have. Whoever is busiest bounds the job: what others do beside it costs nothing.

# Of the threads that render. `render` holds `await`: for the view in flight to be done.
RENDER, AWAIT, HELD, RENDERERS = "render", "await", "held", "renderers"
# Of the threads that write.
ENCODE, WRITE, MEASURE, LIDAR, WRITERS = "encode", "write", "measure", "lidar", "writers"
WORKERS = "workers"  # all of a job's workers, from its begin to its end

_WRITING = {ENCODE: "encoding", WRITE: "writing to disk", MEASURE: "boxes", LIDAR: "LiDAR"}
_BESIDE = {
    "open": "opening scenes",
    "settle": "choosing settings",
    "prepare": "preparing effects",
    "labels": "reading labels",
    "share": "handing the scene to workers",
    "finish": "writing manifests",
    "publish": "publishing",
}


class WorkTimes:
    """Seconds by kind of work; several threads may add to them."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._lock = threading.Lock()

    def add(self, kind: str, seconds: float) -> None:
        with self._lock:
            self._seconds[kind] += seconds

    @contextmanager
    def spent(self, *kinds: str) -> Iterator[None]:
        """The time within is added to each of these kinds, also if it ends with an exception."""
        started = time.perf_counter()
        try:
            yield
        finally:
            for kind in kinds:
                self.add(kind, time.perf_counter() - started)

    def update(self, seconds: Mapping[str, float]) -> None:
        for kind, spent in seconds.items():
            self.add(kind, spent)

    def so_far(self) -> dict[str, float]:
        with self._lock:
            return dict(self._seconds)


@dataclass(frozen=True)
class Shares:
    """Parts of a job's time, 0 to 1. Of the workers' time: rendering, of that awaiting views in
    flight; held, waiting for files; beside, all else, and its greatest part. Of the writing
    threads' time: writing, by kind.
    """

    rendering: float
    awaiting: float
    held: float
    beside: float
    beside_by: str
    writing: Mapping[str, float]

    @property
    def bound_by(self) -> str:
        if sum(self.writing.values()) > self.rendering + self.beside:
            return max(self.writing, key=self.writing.__getitem__)
        return "rendering" if self.rendering >= self.beside else self.beside_by

    @property
    def sentence(self) -> str:
        """All of it in one line."""
        wait = f" ({_percent(self.awaiting)} for views in flight)" if self.awaiting else ""
        beside = f"other work {_percent(self.beside)}, first of all {self.beside_by}"
        kinds = ", ".join(f"{kind} {_percent(share)}" for kind, share in self.writing.items())
        return (
            f"bound by {self.bound_by}: rendering {_percent(self.rendering)} of the time{wait}, "
            f"waiting for files {_percent(self.held)}, {beside}; "
            f"writing threads {_percent(sum(self.writing.values()))} busy ({kinds})"
        )


def shares_of(seconds: Mapping[str, float], held_up: int = 1) -> Shares | None:
    """The shares of a job's seconds by kind of work; None where nothing was rendered. held_up: how
    many workers there are while the job itself does other work than rendering.
    """
    whole, writers = seconds.get(WORKERS, 0.0), seconds.get(WRITERS, 0.0)
    if not (seconds.get(RENDER) and whole and writers):
        return None
    # A worker's writing threads are there as long as the worker is, at work or not.
    writers *= whole / seconds[RENDERERS]
    rendering, held = seconds[RENDER] / whole, seconds.get(HELD, 0.0) / whole
    rest = max(0.0, 1 - rendering - held)
    beside = {label: held_up * seconds.get(k, 0.0) / whole for k, label in _BESIDE.items()}
    beside["workers that start or have nothing to do"] = rest - sum(beside.values())
    return Shares(
        rendering=rendering,
        awaiting=seconds.get(AWAIT, 0.0) / whole,
        held=held,
        beside=rest,
        beside_by=max(beside, key=beside.__getitem__),
        writing={label: seconds.get(kind, 0.0) / writers for kind, label in _WRITING.items()},
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


# ---- Frames rendered, labelled and written -------------------------------------------------------

MESSAGE_LENGTH = 500
_log = logging.getLogger(__name__)


@runtime_checkable
class Renderer(Protocol):
    """`augment.views.render_view`, `begin_view`, or a stand-in: makes a View, or a Pending one; a
    job then begins the next before it waits.
    """

    def __call__(self, scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> Any: ...


@runtime_checkable
class Pending(Protocol):
    """A view that is begun; `augment.views.PendingView` is one."""

    def result(self) -> Any: ...


@dataclass(frozen=True)
class Setup:
    """What rendering needs besides scene and frames; small, and picklable. labelled: numbers of the
    frames whose labels and LiDAR pass through. instances: of the scene's objects. memo: what
    the recipes' images share; the scene to render takes it over. overwrite: sweeps that are there.
    """

    out_dir: str
    recipes: tuple[Recipe, ...]
    backend: str
    labelled: frozenset[int]
    instances: Instances
    memo: Mapping[Hashable, Any] = field(default_factory=dict)
    overwrite: bool = False


@dataclass(frozen=True)
class Chunk:
    """Images of one frame under one recipe. variant: position in Setup.recipes."""

    variant: int
    frame: int
    cameras: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """What became of one image. lidar, lidar_note: as of PassedLidar. box_weather: of its boxes.
    shares: as of Written.
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
    shares: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TaskFailed:
    """A worker's task could not be done. is_output: nothing can be written, so that all others
    would fail. of_scene: the scene could not be opened, so that its other blocks would fail too.
    of_memory: it may succeed while no other worker takes any.
    """

    text: str
    is_output: bool = False
    of_scene: bool = False
    of_memory: bool = False


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


@dataclass(frozen=True, eq=False)
class _Drawn:
    """An image that is drawn, or begun. camera: as written. lidar: of `_pass_lidar`."""

    chunk: Chunk
    recipe: Recipe
    camera: Camera
    lidar: Future


class FrameRunner:
    """Renders chunks, writes on other threads, and gives `deliver` each image from the writing
    threads, once its files are on the disk. The library's own renderer draws several views at once
    (`augment.views.ViewPool`), handed over in their order. Where another returns pending views, the
    next is begun before the last is waited for, so that a GPU has work while pictures come back. An
    error of the scene or the renderer concerns one image; an OutputError or GpuLost ends the run.
    """

    def __init__(
        self,
        scene: Scene,
        frames: Sequence[Frame],
        setup: Setup,
        renderer: Renderer | None,
        deliver: Callable[[Outcome], None],
        pump: WritePump,
    ) -> None:
        self._cameras = {f.index: f.cameras for f in frames}
        self._scene, self._setup = scene, setup
        self._views = None
        if renderer is None:
            from augment.views import ViewPool  # which brings the rasteriser

            self._views = ViewPool(scene, setup.backend)
            renderer = self._views.begin
        self._renderer: Renderer = renderer
        self._ahead = 1 if self._views is None else self._views.ahead
        self._deliver, self._pump = deliver, pump
        self._boxes: dict[int, Boxes] = {}  # of the frames so far
        self._reading_boxes = threading.Lock()
        self._warned: set[str] = set()  # variants of which a sweep could not be weathered
        self._in_flight: deque[tuple[_Drawn, Pending]] = deque()
        self._times, self._started = WorkTimes(), time.perf_counter()

    def run(self, chunk: Chunk) -> None:
        """Render the chunk's images. The last may stay in flight until `close` or later ones."""
        recipe = self._setup.recipes[chunk.variant]
        lidar = self._submit(lambda: self._pass_lidar(chunk, recipe))
        for name in chunk.cameras:
            self._render(chunk, recipe, name, lidar)

    def _land(self) -> None:
        """Wait for the first view in flight and hand it over."""
        drawn, pending = self._in_flight[0]
        try:
            with self._times.spent(RENDER, AWAIT):
                view = pending.result()
        except Exception as error:
            self._in_flight.popleft()
            self._fail(drawn.chunk, drawn.camera.name, error)
            return
        self._in_flight.popleft()  # no sooner: what an interrupt finds in flight is left to `close`
        self._hand_over(drawn, view)

    def close(self) -> dict[str, float]:
        """Wait for the writes; raises what stopped them. Returns the seconds by `times`' kinds."""
        try:
            while self._in_flight:
                self._land()
        finally:
            if self._views is not None:
                self._views.close()
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
            self._in_flight.append((drawn, view))
            while len(self._in_flight) > self._ahead:
                self._land()
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
            self._in_flight.clear()
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
        done = replace(
            failed,
            status=OK,
            checksum=written.checksum,
            box_weather=box_weather,
            shares=written.shares,
        )
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
        return label_view(
            boxes, self._setup.instances, origin, camera, view, recipe,
            evidence=lambda: evidence_of(self._scene, frame),
        )  # fmt: skip

    def _pass_lidar(self, chunk: Chunk, recipe: Recipe) -> PassedLidar | str:
        """Write the frame's sweep, in the weather or as it is, unless it is there already; what
        became of it, or a message where it cannot be read.
        """
        if recipe.lidar is None or chunk.frame not in self._setup.labelled:
            return PassedLidar()
        paths = item_paths(self._scene.name, recipe, "", chunk.frame)
        target = Path(self._setup.out_dir) / (paths["lidar"] or "")
        if target.exists() and not self._setup.overwrite:
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
        from augment.effects.lidar.sweep import weathered_sweep

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


# ---- What a worker of one open scene does --------------------------------------------------------


@dataclass(frozen=True)
class SceneSetup:
    """What workers of one scene share. scene: opens it, with its frames, in the worker's process.
    lock: only held: the output stays the job's until its last worker ends. workers: how many.
    """

    setup: Setup
    scene: Callable[[], tuple[Scene, Sequence[Frame]]]
    renderer: Renderer | None
    lock: InheritedLock | None = None
    workers: int = 1

    @property
    def backend(self) -> str:
        return self.setup.backend

    @property
    def output(self) -> str:
        return self.setup.out_dir

    def worker(self, on_outcome: Callable[[Outcome], None]) -> SceneWorker:
        return SceneWorker(self, on_outcome)


class SceneWorker:
    """Renders chunks: a task is a tuple of them, its result the seconds by kind of work."""

    def __init__(self, setup: SceneSetup, on_outcome: Callable[[Outcome], None]) -> None:
        self._setup, self._on_outcome = setup, on_outcome
        self._opened: tuple[Scene, Sequence[Frame]] | None = None

    def do(self, task: tuple[Chunk, ...]) -> dict[str, float] | TaskFailed:
        try:
            return self._render(task)
        except OutputError as error:
            return TaskFailed(str(error), is_output=True)

    def _render(self, task: tuple[Chunk, ...]) -> dict[str, float]:
        own, on_gpu = self._setup, renders_on_gpu(self._setup.backend)
        if self._opened is None:
            self._opened = own.scene()
            memo_of(self._opened[0]).update(own.setup.memo)
        if own.workers == 1 or on_gpu:
            pump = WritePump.beside(own.backend, max(1, available_cores() // own.workers))
        else:  # one thread and little waiting: the memory of a view counts once per worker
            pump = WritePump(threads=1, waiting=2)
        runner = FrameRunner(*self._opened, own.setup, own.renderer, self._on_outcome, pump)
        with quick_turns(on_gpu):
            try:
                for chunk in task:
                    runner.run(chunk)
            finally:
                seconds = runner.close()
        return seconds
