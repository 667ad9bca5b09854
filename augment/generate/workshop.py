"""What a worker does, wherever it runs: open scenes, render blocks, publish them.

A worker keeps one scene and no more: the last that it opened.
"""

from __future__ import annotations

import gc
import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from augment.batch.claims import try_claim
from augment.batch.job import RenderJob, SceneLoader, run_job
from augment.batch.layout import STATE_FOLDER, folder_name
from augment.batch.lock import file_lock
from augment.batch.parts import list_parts
from augment.batch.runner import Outcome, Renderer, describe
from augment.batch.store import Store, open_store
from augment.batch.times import WorkTimes
from augment.errors import ClimateGSError, GpuLost, OutputError, SceneError, StyleError
from augment.generate.leftovers import clear_block, clear_files_of
from augment.generate.publish import Publisher, staging_folder
from augment.generate.records import Block, SceneRecord
from augment.generate.variants import enter_variant
from augment.scene import Scene
from recipes.schema import Recipe

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WorkSetup:
    """What all workers of a job share; picklable.

    store_uri: the output. scratch: where blocks are rendered on their way to an output that is not
    on this machine. open_scene, renderer: importable functions; None renders with the library's.
    """

    store_uri: str
    scratch: Path | None
    backend: str
    open_scene: SceneLoader
    renderer: Renderer | None = None


@dataclass(frozen=True)
class IndexTask:
    """Open a scene and say what is in it. name: to be called so, or None for its own name."""

    uri: str
    name: str | None


@dataclass(frozen=True)
class BlockTask:
    """Render a block. is_trial: its worker died before, so each image is rendered in a process of
    its own, and one that ends it is the only one lost.
    """

    block: Block
    name: str | None
    is_trial: bool = False


@dataclass(frozen=True)
class SettleTask:
    """Let the qualities of recipes choose their settings in a scene, or find what they have chosen.

    name: as of an IndexTask. keep: whether a new choice is kept in the output.
    """

    uri: str
    name: str | None
    recipes: tuple[Recipe, ...]
    keep: bool = True


Task = IndexTask | SettleTask | BlockTask


@dataclass(frozen=True)
class BlockDone:
    """What became of a block. skipped: images that were finished before, here or elsewhere.

    is_elsewhere: another process is at it; nothing was done. seconds: by kind of work, as of
    `batch.times`.
    """

    written: int = 0
    skipped: int = 0
    failed: int = 0
    failures: tuple[str, ...] = ()
    is_elsewhere: bool = False
    seconds: dict[str, float] | None = None


@dataclass(frozen=True)
class SettledRecipes:
    """The recipes of a SettleTask, in its order."""

    recipes: tuple[Recipe, ...]


@dataclass(frozen=True)
class TaskFailed:
    """The task could not be done. is_output: nothing can be written, so that all others would fail.

    of_scene: the scene could not be opened, so that its other blocks would fail too. of_memory: it
    may succeed while no other worker takes any.
    """

    text: str
    is_output: bool = False
    of_scene: bool = False
    of_memory: bool = False


Result = SceneRecord | SettledRecipes | BlockDone | TaskFailed
Tell = Callable[[Outcome], None]


class Workshop:
    """Does one task after the other. tell: hears of every image, from several threads."""

    def __init__(self, setup: WorkSetup, tell: Tell) -> None:
        self._setup, self._tell = setup, tell
        self._store: Store = open_store(setup.store_uri)
        self._scene: Scene | None = None
        self._opened: tuple[str, str | None] | None = None
        self._entered: set[tuple[str, str]] = set()

    def do(self, task: Task) -> Result:
        """The task's result; errors that concern the task alone are results too.

        Raises:
            GpuLost: this process can do no other task either.
        """
        try:
            if isinstance(task, IndexTask):
                return self._index(task)
            if isinstance(task, SettleTask):
                return SettledRecipes(tuple(self._settle(task, recipe) for recipe in task.recipes))
            return self._render(task)
        except OutputError as error:
            return TaskFailed(str(error), is_output=True)
        except GpuLost:
            raise
        except _SceneFailed as error:
            of_memory = isinstance(error.__cause__, MemoryError)
            return TaskFailed(str(error), of_scene=True, of_memory=of_memory)
        except Exception as error:
            _log.debug("task failed", exc_info=True)
            return TaskFailed(_said(error), of_memory=isinstance(error, MemoryError))

    def _index(self, task: IndexTask) -> SceneRecord:
        started = time.perf_counter()
        scene = self._scene_of(task.uri, task.name)
        return SceneRecord.of(scene, task.uri, time.perf_counter() - started)

    def _settle(self, task: SettleTask, recipe: Recipe) -> Recipe:
        from augment.quality.record import settle_for

        scene, setup = self._scene_of(task.uri, task.name), self._setup
        try:
            return settle_for(
                self._store,
                recipe,
                scene,
                backend=setup.backend,
                renderer=setup.renderer,
                keep=task.keep,
            )
        except (SceneError, StyleError) as error:
            raise ClimateGSError(
                f"recipe {recipe.name}, variant {recipe.variant}: quality {recipe.quality.words} "
                f"cannot choose its settings: {error}"
            ) from error

    def _scene_of(self, uri: str, name: str | None) -> Scene:
        if self._opened != (uri, name) or self._scene is None:
            self._forget()
            try:
                scene = self._setup.open_scene(uri)
            except OutputError:
                raise
            except Exception as error:
                _log.debug("%s", uri, exc_info=True)
                raise _SceneFailed(_said(error)) from error
            self._scene = scene if name is None else replace(scene, name=name)
            self._opened = (uri, name)
        return self._scene

    def _forget(self) -> None:
        """Let go of the scene before another one is opened: never two at a time."""
        self._scene = self._opened = None
        gc.collect()

    def _render(self, task: BlockTask) -> BlockDone:
        block = task.block
        claim = try_claim(self._store, block.claim)
        if claim is None:
            return BlockDone(is_elsewhere=True)
        with claim:
            part = list_parts(self._store, folder_name(block.scene)).get(block.key)
            if part is not None and not part.has_failures:
                clear_block(self._store, self._setup.scratch, block)  # killed just before it did
                return BlockDone(skipped=block.images)
            return self._render_claimed(task)

    def _render_claimed(self, task: BlockTask) -> BlockDone:
        block, times = task.block, WorkTimes()
        if task.is_trial:  # its processes share a scene of their own: not two at a time
            self._forget()
        else:
            with times.spent("open"):
                scene = self._scene_of(block.uri, task.name)
            with times.spent("place"):
                self._lay_bed(block, scene)
        self._enter(block)
        folder = staging_folder(self._store, self._setup.scratch, block)
        if folder.is_dir():
            clear_files_of(self._store, block)
        job = RenderJob(
            scene_uri=block.uri,
            recipes=[block.recipe],
            out_dir=folder,
            frames=block.frames,
            cameras=block.cameras,
            backend=self._setup.backend,
            workers=2 if task.is_trial else 1,
            beds_dir=self._beds_dir(),
        )
        with Publisher(self._store, folder, block) as publisher:

            def tell(outcome: Outcome) -> None:
                publisher.image_done(outcome)
                self._tell(outcome)

            result = run_job(
                job,
                scene_loader=lambda uri: self._scene_of(uri, task.name),
                renderer=self._setup.renderer,
                progress=False,
                tell=tell,
            )
            with times.spent("publish"):
                publisher.finish()
            if not result.failed:
                clear_block(self._store, self._setup.scratch, block)
        seconds = Counter(result.timings)
        seconds.update(times.so_far())
        return BlockDone(
            result.written, result.skipped, result.failed, result.failures, seconds=dict(seconds)
        )

    def _enter(self, block: Block) -> None:
        variant = (block.scene, block.variant)
        if variant not in self._entered:
            enter_variant(self._store, *variant, block.identity(self._setup.backend))
            self._entered.add(variant)

    def _beds_dir(self) -> Path:
        if self._store.local_dir is not None:
            return self._store.local_dir / STATE_FOLDER
        assert self._setup.scratch is not None
        return self._setup.scratch

    def _lay_bed(self, block: Block, scene: Scene) -> None:
        """Let one process look where the snow can lie, and the others on this disk wait for it."""
        from augment.batch.snow_beds import snow_to_lay, store_beds

        if snow_to_lay(block.recipe) is not None:
            folder = self._beds_dir()
            with file_lock(folder / f"beds-{folder_name(block.scene)}.lock"):
                store_beds(scene, [block.recipe], folder, backend=self._setup.backend)


class _SceneFailed(ClimateGSError):
    """A scene could not be opened."""


def _said(error: Exception) -> str:
    """Our own errors say what to do; of others the kind matters too."""
    if isinstance(error, MemoryError):
        return f"memory ran out ({error}); use fewer workers, or a machine with more"
    return str(error) if isinstance(error, ClimateGSError) else describe(error, "in a worker")
