"""Worker of a dataset job: opens scenes, renders blocks of images, and publishes them.

In: tasks of `generate` (`IndexTask`, `ResolveTask`, `BlockTask`). Out: their results, and files in
the output. The pools run it, in this process or in others. A worker keeps only one scene, the last
that it opened.
"""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from augment import effects
from augment.errors import ClimateGSError, GpuLost, OutputError, SceneError, StyleError
from augment.jobs.blocks import Block, SceneRecord
from augment.jobs.pools import OutcomeCallback
from augment.jobs.processes import file_lock
from augment.jobs.publishing import (
    Publisher,
    clear_block,
    clear_files_of,
    enter_variant,
    link_published_files,
    link_published_sweeps,
    staging_folder,
)
from augment.jobs.render_job import RenderJob, SceneLoader, run_job
from augment.jobs.time_shares import WorkTimes
from augment.jobs.worker import Outcome, TaskFailed, describe_error
from augment.output.claims import try_claim
from augment.output.manifest import Part, list_parts
from augment.output.names import STATE_FOLDER, folder_name
from augment.output.store import Store, open_store
from augment.scene.scene import Scene
from augment.view.quality import choose_settings
from augment.view.results import Renderer
from recipes.schema import Recipe

# ---- The worker ----------------------------------------------------------------------------------

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobWorkerSetup:
    """Everything that all workers of a job share; picklable."""

    store_uri: str
    """URI of the output."""
    scratch_dir: Path | None
    """Folder where blocks are rendered on their way to an output that is not on this machine."""
    backend: str
    """Name of the rasteriser's backend."""
    open_scene: SceneLoader
    """Opens a scene by its URI; an importable function."""
    renderer: Renderer | None = None
    """Importable function that renders an image; None for the library's own."""
    scene_digest: Callable[[str], str | None] | None = None
    """Importable function that returns the digest of a scene's content; None notes no digest."""

    @property
    def output(self) -> str:
        """URI of the output, for messages."""
        return self.store_uri

    def worker(self, on_outcome: OutcomeCallback) -> BlockWorker:
        """Return a worker for this process."""
        return BlockWorker(self, on_outcome)


@dataclass(frozen=True)
class IndexTask:
    """Task to open a scene and return its record."""

    uri: str
    """URI of the scene."""
    name: str | None
    """Name of the scene in the output; None for its own name."""


@dataclass(frozen=True)
class BlockTask:
    """Task to render a block."""

    block: Block
    """The block."""
    name: str | None
    """As of an IndexTask."""
    is_trial: bool = False
    """True if a worker died at the block before. Each image is then rendered in a process of its
    own, so that only the image is lost that ends its process.
    """
    is_damaged: bool = False
    """True if the block is published and has lost files since."""


@dataclass(frozen=True)
class ResolveTask:
    """Task to choose the open settings of recipes in a scene, or to find earlier choices."""

    uri: str
    """URI of the scene."""
    name: str | None
    """As of an IndexTask."""
    recipes: tuple[Recipe, ...]
    """Recipes whose quality leaves settings open."""
    keep: bool = True
    """If True, the output keeps new choices."""


Task = IndexTask | ResolveTask | BlockTask


@dataclass(frozen=True)
class BlockResult:
    """Counts of a block's images."""

    written: int = 0
    """Images rendered now."""
    skipped: int = 0
    """Images that were finished before, here or by another process."""
    failed: int = 0
    """Images that could not be rendered."""
    failures: tuple[str, ...] = ()
    """One line for each failure."""
    is_claimed_elsewhere: bool = False
    """True if another process has claimed the block; nothing was done."""
    seconds: dict[str, float] | None = None
    """Seconds by kind of work, as of `time_shares.WorkTimes`."""


@dataclass(frozen=True)
class ResolvedRecipes:
    """Result of a ResolveTask: its recipes, resolved, in its order."""

    recipes: tuple[Recipe, ...]
    """Resolved recipes."""


Result = SceneRecord | ResolvedRecipes | BlockResult | TaskFailed


class BlockWorker:
    """Does one task after the other.

    Attributes:
        setup: Output, backend and scene loader.
        on_outcome: Called with every image's Outcome, from several threads.
    """

    def __init__(self, setup: JobWorkerSetup, on_outcome: OutcomeCallback) -> None:
        self._setup = setup
        self._on_outcome = on_outcome
        self._store: Store = open_store(setup.store_uri)
        self._scene: Scene | None = None
        self._scene_key: tuple[str, str | None] | None = None
        self._entered_variants: set[tuple[str, str]] = set()

    def do(self, task: Task) -> Result:
        """Do a task; errors that concern only the task are results too.

        Raises:
            GpuLost: This process cannot do any other task either.
        """
        try:
            if isinstance(task, IndexTask):
                return self._index(task)
            if isinstance(task, ResolveTask):
                return ResolvedRecipes(
                    tuple(self._resolve(task, recipe) for recipe in task.recipes)
                )
            return self._render(task)
        except OutputError as error:
            return TaskFailed(str(error), is_output=True)
        except GpuLost:
            raise
        except _SceneFailed as error:
            of_memory = isinstance(error.__cause__, MemoryError)
            return TaskFailed(str(error), is_scene_error=True, of_memory=of_memory)
        except Exception as error:
            _log.debug("task failed", exc_info=True)
            return TaskFailed(_message_of(error), of_memory=isinstance(error, MemoryError))

    def _index(self, task: IndexTask) -> SceneRecord:
        """Open a scene and return its record."""
        start_s = time.perf_counter()
        scene = self._open_scene(task.uri, task.name)
        digest = (
            self._setup.scene_digest(task.uri) if self._setup.scene_digest is not None else None
        )
        return SceneRecord.of(scene, task.uri, time.perf_counter() - start_s, digest)

    def _resolve(self, task: ResolveTask, recipe: Recipe) -> Recipe:
        """Return the recipe with the settings that its quality chooses in the scene."""
        scene = self._open_scene(task.uri, task.name)
        setup = self._setup
        try:
            return choose_settings(
                self._store,
                recipe,
                scene,
                backend=setup.backend,
                renderer=setup.renderer,
                keep_choice=task.keep,
            )
        except (SceneError, StyleError) as error:
            raise ClimateGSError(
                f"recipe {recipe.name}, variant {recipe.variant}: quality {recipe.quality.summary} "
                f"cannot choose its settings: {error}"
            ) from error

    def _open_scene(self, uri: str, name: str | None) -> Scene:
        """Return the opened scene; opens it unless it is the one at hand."""
        if self._scene_key != (uri, name) or self._scene is None:
            self._drop_scene()
            try:
                scene = self._setup.open_scene(uri)
            except OutputError:
                raise
            except Exception as error:
                _log.debug("%s", uri, exc_info=True)
                raise _SceneFailed(_message_of(error)) from error
            self._scene = scene if name is None else replace(scene, name=name)
            self._scene_key = (uri, name)
        return self._scene

    def _drop_scene(self) -> None:
        """Drop the scene before another one is opened, so that two are never in memory."""
        self._scene = self._scene_key = None
        gc.collect()

    def _render(self, task: BlockTask) -> BlockResult:
        """Claim a block and render it, unless it is finished already."""
        block = task.block
        claim = try_claim(self._store, block.claim)
        if claim is None:
            return BlockResult(is_claimed_elsewhere=True)
        with claim:
            part = list_parts(self._store, folder_name(block.scene)).get(block.key)
            if part is not None and not part.has_failures and not task.is_damaged:
                # A killed process may have left the folder.
                clear_block(self._store, self._setup.scratch_dir, block)
                return BlockResult(skipped=block.images)
            return self._render_claimed(task, part if task.is_damaged else None)

    def _render_claimed(self, task: BlockTask, damaged_part: Part | None) -> BlockResult:
        """Render and publish a block whose claim this process holds."""
        block = task.block
        times = WorkTimes()
        if task.is_trial:  # its processes open the scene themselves: never two in memory
            self._drop_scene()
        else:
            with times.measure("open"):
                scene = self._open_scene(block.uri, task.name)
            with times.measure("prepare"):
                self._share_files(block, scene)
        self._enter_variant(block)
        folder = staging_folder(self._store, self._setup.scratch_dir, block)
        if folder.is_dir():
            clear_files_of(self._store, block)
        if damaged_part is not None:
            link_published_files(self._store, folder, block, damaged_part)
        link_published_sweeps(self._store, folder, block)
        job = RenderJob(
            scene_uri=block.uri,
            recipes=[block.recipe],
            out_dir=folder,
            frames=block.frames,
            cameras=block.cameras,
            backend=self._setup.backend,
            workers=2 if task.is_trial else 1,
            shared_files_dir=self._shared_dir(),
            source_digest=block.digest,
        )
        with Publisher(self._store, folder, block) as publisher:

            def on_outcome(outcome: Outcome) -> None:
                publisher.image_done(outcome)
                self._on_outcome(outcome)

            result = run_job(
                job,
                scene_loader=lambda uri: self._open_scene(uri, task.name),
                renderer=self._setup.renderer,
                progress=False,
                on_outcome=on_outcome,
            )
            with times.measure("publish"):
                publisher.finish()
            if not result.failed:
                clear_block(self._store, self._setup.scratch_dir, block)
        times.update(result.timings)
        counts = result.written, result.skipped, result.failed, result.failures
        return BlockResult(*counts, seconds=times.so_far())

    def _enter_variant(self, block: Block) -> None:
        """Make sure that the images of the block's variant have one identity; once per variant."""
        variant = (block.scene, block.variant)
        if variant not in self._entered_variants:
            enter_variant(self._store, *variant, block.identity(self._setup.backend))
            self._entered_variants.add(variant)

    def _shared_dir(self) -> Path:
        """Return the folder for files that images share."""
        if self._store.local_dir is not None:
            return self._store.local_dir / STATE_FOLDER
        assert self._setup.scratch_dir is not None
        return self._setup.scratch_dir

    def _share_files(self, block: Block, scene: Scene) -> None:
        """Let one process compute the files that images share.

        The other processes on this disk wait for it.
        """
        recipe = block.recipe
        backend = self._setup.backend
        if any(e.precomputes_files and e.section_of(recipe) is not None for e in effects.EFFECTS):
            folder = self._shared_dir()
            lock = folder / f"shared-files-{folder_name(block.scene)}.lock"
            with file_lock(lock, "finds the surfaces that are open to the sky"):
                context = effects.JobContext(scene, [recipe], folder=folder, backend=backend)
                effects.precompute_effects(context, only_files=True)


class _SceneFailed(ClimateGSError):
    """Error of a scene that could not be opened."""


def _message_of(error: Exception) -> str:
    """Return an error's message; the type is added unless the error is one of this package."""
    if isinstance(error, MemoryError):
        return f"memory ran out ({error}); use fewer workers, or a machine with more"
    return str(error) if isinstance(error, ClimateGSError) else describe_error(error, "in a worker")
