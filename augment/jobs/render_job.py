"""A batch job: one scene, any number of recipes, images and labels into one output folder.

A job can be killed at any moment and run again: it goes on with what is missing. The files it
leaves do not depend on how often that happened, nor on the number of workers.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

import augment
from augment.base_photo import check_photos
from augment.cameras import Frame
from augment.effects import Sharing, share_effects
from augment.errors import ClimateGSError, OutputError
from augment.jobs.atomic import path_below, read_file, write_atomic
from augment.jobs.files import SceneIndex, select_frames, trajectory_id, uses_boxes
from augment.jobs.job_state import BoxCache, JobState
from augment.jobs.layout import MANIFEST, STATE_FOLDER, folder_name, variant_name
from augment.jobs.manifest import FAILED, OK, Identity
from augment.jobs.pools import ProcessPool, SerialPool, Work, WorkerPool, run_tasks
from augment.jobs.processes import (
    OutputLock,
    SharedScene,
    check_sendable,
    choose_backend,
    share_scene,
)
from augment.jobs.quality import resolve_quality_for
from augment.jobs.store import open_store
from augment.jobs.worker import (
    WORKERS,
    Chunk,
    Outcome,
    Renderer,
    SceneSetup,
    Setup,
    TaskFailed,
    WorkTimes,
)
from augment.memo import memo_of
from augment.progress import ProgressBar
from augment.scene import Scene
from recipes.fields import found, replaced
from recipes.files import read_files, with_digest
from recipes.load import dump_recipe
from recipes.schema import SECTIONS, Recipe

# ---- The files that a recipe names, beside the images: those of a style in `<variant>/style/` ----
# With them a variant's `recipe.yaml` renders it again wherever the folder is taken.

RECIPE_FILE = "recipe.yaml"
_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,16}")


def file_folders() -> tuple[str, ...]:
    """Folders inside a variant's that hold files which recipes name."""
    return tuple(path.split(".")[-1] for path, model in SECTIONS.items() if model.file_fields)


def stored_names(recipe: Recipe) -> dict[str, str]:
    """The name of each of the recipe's files inside the variant's folder, by dotted path of its
    field. It is the file's own where that is safe; another file of the same name gets its field's
    name before its own.
    """
    found: dict[str, str] = {}
    for section_path, section in recipe.sections().items():
        names: dict[str, str] = {}
        for key, path in section.files.items():
            name = _safe_name(path)
            while name.casefold() in {taken.casefold() for taken in names.values()}:
                name = f"{key}-{name}"
            names[key] = name
        folder = section_path.split(".")[-1]
        found |= {f"{section_path}.{key}": f"{folder}/{name}" for key, name in names.items()}
    return found


def portable_recipe(recipe: Recipe) -> Recipe:
    """The recipe with its files named from the variant's folder; its hash is the same."""
    for path, name in stored_names(recipe).items():
        recipe = replaced(recipe, path, name)
    return recipe


def check_kept(recipe: Recipe, folders: Collection[Path]) -> None:
    """Refuse to overwrite (`folders`) files that the recipe is about to need."""
    for path in stored_names(recipe):
        real = Path(found(recipe, path)).resolve()
        for folder in folders:
            if real.is_relative_to(folder.resolve()):
                raise OutputError(
                    f"{path} of recipe {recipe.name} is {real}, in the folder {folder}, "
                    f"which is to be overwritten: copy the recipe and its files out of it first"
                )


def copy_files(recipe: Recipe, folder: Path) -> None:
    """Put the recipe's files where `portable_recipe` names them. folder: the variant's. Raises
    RecipeError: they are unreadable or not those of the recipe's digest.
    """
    names = stored_names(recipe)
    for section_path, section in recipe.sections().items():
        for key, data in read_files(section).items() if section.files else ():
            path = folder / names[f"{section_path}.{key}"]
            if not (path.is_file() and read_file(path) == data):
                write_atomic(path, data)


def write_recipe(recipe: Recipe, folder: Path) -> None:
    """Write `recipe.yaml`, and the files that it names. folder: the variant's. Raises RecipeError:
    as copy_files. OutputError: the system refused, or a link leads out of the output.
    """
    place = folder.parent.name, folder.name
    for name in stored_names(recipe).values():
        path_below(folder.parents[1], (*place, *PurePath(name).parts[:-1]))
    copy_files(recipe, folder)
    write_atomic(folder / RECIPE_FILE, dump_recipe(portable_recipe(recipe)).encode())


def lacks_recipe(recipe: Recipe, folder: Path) -> bool:
    """Whether `recipe.yaml` or a file that it names is missing. folder: the variant's."""
    names = (RECIPE_FILE, *stored_names(recipe).values())
    return not all((folder / name).is_file() for name in names)


def _safe_name(path: str) -> str:
    """The file's name as `folder_name` has it, with its suffix still at the end."""
    name = PurePath(path)
    if _SUFFIX.fullmatch(name.suffix):
        return folder_name(name.stem) + name.suffix
    return folder_name(name.name)


# ---- The job -------------------------------------------------------------------------------------

_log = logging.getLogger(__name__)
SceneLoader = Callable[[str], Scene]
TASK_IMAGES = 32  # at most that a worker process gets at a time: between, its threads have no work


@dataclass(frozen=True, eq=False)
class RenderJob:
    """What to render, and where to. recipes: resolved, one a variant; their `name` and `variant`
    number make the folder. Missing digests of style files are filled in; settings that a quality
    leaves open are chosen once and kept in the output. frames: the dataset's frame numbers, or None
    for all. cameras: names, or None for all. camera_path: frames to render in place of the scene's
    own, poses in the scene's world; labels and LiDAR pass through where a frame of the scene has
    the same number and timestamp. workers: 1 renders in this process. overwrite: replace the
    variants' folders, finished or not, and choose their settings anew. shared_dir: keeps
    what lies in files of what images share (where snow can lie) for later jobs; the output folder's
    state if None. source_digest: of the scene's content (adapters.scene_cache.scene_digest); images
    of other content in the output are then refused.
    """

    scene_uri: str
    recipes: Sequence[Recipe]
    out_dir: Path | str
    frames: Sequence[int] | None = None
    cameras: Sequence[str] | None = None
    camera_path: Sequence[Frame] | None = None
    workers: int = 1
    backend: str = "auto"
    overwrite: bool = False
    shared_dir: Path | None = None
    source_digest: str | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ValueError(f"workers must be >= 1; got {self.workers}")
        names = Counter(variant_name(recipe) for recipe in self.recipes)
        if not names:
            raise ValueError("a job needs at least one recipe; got none")
        repeated = sorted(name for name, count in names.items() if count > 1)
        if repeated:
            raise ValueError(
                f"recipes of one job need different names or variant numbers; repeated: {repeated}"
            )


@dataclass(frozen=True)
class JobResult:
    """Counts of images of this job. skipped: finished by earlier runs. failures: a line each.
    seconds: wall clock. timings: seconds by kind of work, summed over threads and workers, or of
    the job itself (open, settle, prepare, labels, share, finish); `worker.shares_of` says what
    bound it.
    """

    written: int
    skipped: int
    failed: int
    manifest: Path
    seconds: float
    failures: tuple[str, ...] = ()
    timings: dict[str, float] = field(default_factory=dict)


def run_job(
    job: RenderJob,
    *,
    scene_loader: SceneLoader,
    renderer: Renderer | None = None,
    progress: bool = True,
    on_outcome: Callable[[Outcome], None] | None = None,
) -> JobResult:
    """Render what is missing, then write labels, calibration and manifest. scene_loader: called
    once with `job.scene_uri`. renderer: `augment.views.render_view` if None; with several workers
    an importable function, and the scene's labels and sky of importable classes. progress: a bar on
    stderr. on_outcome: called after each image, from several threads, one at a time. An image that
    fails is recorded in the manifest and the rest goes on. A KeyboardInterrupt finishes the images
    at hand, writes the manifest of what there is, and is raised again. Raises SceneError: the scene
    cannot be opened, lacks a requested frame, camera or photo, or cannot have a recipe's snow;
    StyleError, RecipeError: a style or one of its files cannot be used; no file of a variant has
    been written or replaced then. OutputError: the folder cannot be written, is in use, or holds
    something else.
    """
    started = time.perf_counter()
    run = _Run(job, scene_loader(job.scene_uri), renderer, on_outcome, progress)
    opening = time.perf_counter() - started
    run.times.add("open", opening - run.times.so_far().get("settle", 0.0))
    run.go()
    seconds = time.perf_counter() - started
    run.times.add(WORKERS, job.workers * seconds)
    return JobResult(
        written=run.counts[OK],
        skipped=run.skipped,
        failed=run.counts[FAILED],
        manifest=run.out_dir / MANIFEST,
        seconds=seconds,
        failures=tuple(sorted(run.failures)),
        timings=run.times.so_far(),
    )


class _ImageWork(Work):
    """The images of a job as tasks: all of them for one worker, else a few frames at a time. Where
    a worker dies, what it had in hand is tried once more, each image alone.
    """

    def __init__(
        self,
        chunks: Sequence[Chunk],
        workers: int,
        deliver: Callable[[Outcome], None],
        times: WorkTimes,
    ) -> None:
        images = sum(len(chunk.cameras) for chunk in chunks)
        most = images if workers == 1 else max(1, min(TASK_IMAGES, images // (4 * workers)))
        self._tasks: deque[tuple[Chunk, ...]] = deque(_tasks(chunks, most))
        self._deliver, self._times = deliver, times
        self._done: set[tuple[int, int, str]] = set()

    def tick(self, slot: int, outcome: Outcome) -> None:
        self._done.add((outcome.variant, outcome.frame, outcome.camera))
        self._deliver(outcome)

    def take(self, slot: int) -> tuple[Chunk, ...] | None:
        return self._tasks.popleft() if self._tasks else None

    def retry(self, slot: int, task: tuple[Chunk, ...], why: str) -> list[tuple[Chunk, ...]]:
        left = self._left(task)
        _log.warning("%d images are tried once more, alone: %s", len(left), why)
        return [(image,) for image in left]

    def done(self, slot: int, task: tuple[Chunk, ...], result: Any) -> None:
        if isinstance(result, TaskFailed):
            raise ClimateGSError(result.text)
        self._times.update(result)

    def lost(self, slot: int, task: tuple[Chunk, ...], how: str) -> None:
        message = (
            f"the worker process {how} while rendering this image, and again when it was tried "
            f"alone; if memory ran out, use fewer workers"
        )
        for image in self._left(task):
            name = image.cameras[0]
            self._deliver(Outcome(image.variant, image.frame, name, FAILED, message))

    def _left(self, task: tuple[Chunk, ...]) -> list[Chunk]:
        """A chunk for each image that has not been delivered."""
        images = [replace(chunk, cameras=(name,)) for chunk in task for name in chunk.cameras]
        return [i for i in images if (i.variant, i.frame, i.cameras[0]) not in self._done]


def _tasks(chunks: Sequence[Chunk], most: int) -> Iterator[tuple[Chunk, ...]]:
    """Runs of chunks, each of about so many images."""
    run: list[Chunk] = []
    for chunk in chunks:
        run.append(chunk)
        if sum(len(own.cameras) for own in run) >= most:
            yield tuple(run)
            run = []
    if run:
        yield tuple(run)


class _Run:
    """One call of run_job."""

    def __init__(
        self,
        job: RenderJob,
        scene: Scene,
        renderer: Renderer | None,
        on_outcome: Callable[[Outcome], None] | None,
        progress: bool,
    ) -> None:
        self.job, self.renderer, self.on_outcome = job, renderer, on_outcome
        self.progress, self.times = progress, WorkTimes()
        self.scene: Scene | None = scene  # None once workers have it
        # A stand-in has its own idea of backends.
        self.backend = job.backend if renderer else choose_backend(job.backend, scene)
        self.index = SceneIndex.of(scene, job.camera_path)
        self.selection = select_frames(self.index, job.frames, job.cameras)
        is_path = job.camera_path is not None
        check_photos(job.recipes, scene.name, self.selection, is_path=is_path)
        self.out_dir = Path(job.out_dir).absolute()
        self.trajectory = trajectory_id(job.camera_path)
        self.recipes = tuple(self._resolved(with_digest(r)) for r in job.recipes)
        identities = [self._identity(recipe) for recipe in self.recipes]
        self.job_state = JobState(self.out_dir, self.index, self.recipes, identities)
        self.boxes = BoxCache(self.index)
        self.counts: Counter[str] = Counter()
        self.failures: list[str] = []
        self.counting = threading.Lock()  # outcomes arrive from several threads

    def go(self) -> None:
        self.total = len(self.recipes) * sum(len(names) for _, names in self.selection)
        with OutputLock(self.out_dir) as lock:
            if self.job.overwrite:  # this may fail, so it comes before anything is given up
                folders = [variant.place for variant in self.job_state.variants]
                for recipe in self.recipes:
                    check_kept(recipe, folders)
                self._prepare(self.recipes)
            self.job_state.open(overwrite=self.job.overwrite)
            self._restore_recipes()
            chunks = list(self.job_state.pending(self.selection))
            self.skipped = self.total - sum(len(chunk.cameras) for chunk in chunks)
            try:
                if not self.job.overwrite:
                    pending = sorted({chunk.variant for chunk in chunks})
                    self._prepare([self.recipes[number] for number in pending])
                self.bar = ProgressBar(
                    total=self.total, initial=self.skipped, unit="image", disable=not self.progress
                )
                with self.bar:
                    self._render(chunks, lock)
                    if self.counts or not self.job_state.is_complete():
                        self._finish()
            except KeyboardInterrupt:
                self._finish()
                raise KeyboardInterrupt(
                    f"stopped with {self.skipped + self.counts[OK]} of {self.total} images "
                    f"finished; run the same command again to go on from there"
                ) from None
            finally:
                self.job_state.close()

    def _restore_recipes(self) -> None:
        """Write the recipes of begun variants, and files that they name, where they are missing."""
        for variant in self.job_state.variants:
            if variant.rows and lacks_recipe(variant.recipe, variant.place):
                write_recipe(variant.recipe, variant.place)

    def _render(self, chunks: list[Chunk], lock: OutputLock) -> None:
        if chunks:
            self._begin(chunks)
            chunks = self._leave_unlabelled(chunks)
        assert self.scene is not None
        setup = Setup(
            out_dir=str(self.out_dir),
            recipes=self.recipes,
            backend=self.backend,
            labelled=self.index.labelled,
            instances=self.index.instances,
            memo=memo_of(self.scene).shared(),
            overwrite=self.job.overwrite,
        )
        if not chunks:
            return
        shared = None
        if self.job.workers > 1:
            check_sendable(self.renderer)
            with self.times.spent("share"):
                shared = share_scene(self.scene, self.index.frames, self.out_dir / STATE_FOLDER)
            self.scene = None  # this process needs no more of it than the index
        work = _ImageWork(chunks, self.job.workers, self._deliver, self.times)
        try:
            with contextlib.closing(self._pool(setup, shared, lock)) as pool:
                run_tasks(pool, work)
        finally:
            if shared is not None:
                shared.remove()

    def _pool(self, setup: Setup, shared: SharedScene | None, lock: OutputLock) -> WorkerPool:
        """This process, or several that open the shared scene."""
        workers = self.job.workers
        if shared is None:
            assert self.scene is not None
            opened = (self.scene, self.index.frames)
            return SerialPool(SceneSetup(setup, lambda: opened, self.renderer))
        own = SceneSetup(setup, shared.open, self.renderer, lock.inherited(), workers)
        return ProcessPool(own, workers)

    def _resolved(self, recipe: Recipe) -> Recipe:
        """The recipe with the settings that its quality chooses here, or has chosen before."""
        if not recipe.quality.is_open:
            return recipe
        assert self.scene is not None
        with self.times.spent("settle"):
            return resolve_quality_for(
                open_store(self.out_dir),
                recipe,
                self.scene,
                backend=self.backend,
                camera_path=self.job.camera_path,
                renderer=self.renderer,
                anew=self.job.overwrite,
                progress=self.progress,
            )

    def _identity(self, recipe: Recipe) -> Identity:
        return Identity(
            self.index.source,
            recipe.hash,
            self.trajectory,
            augment.__version__,
            self.backend,
            self.job.source_digest,
        )

    def _prepare(self, recipes: Sequence[Recipe]) -> None:
        """Find what images of these recipes share, for all cameras of the scene or the path."""
        assert self.scene is not None
        cameras, path = None, self.job.camera_path
        if path is not None and any(recipe.sections() for recipe in recipes):
            # An object of its own, or the caller's would remember what was found for this path.
            self.scene = copy.copy(self.scene)
            cameras = [camera for frame in path for camera in frame.cameras.values()]
        with self.times.spent("prepare"):
            folder = self.job.shared_dir or self.out_dir / STATE_FOLDER
            given = (self.scene, recipes, cameras, folder, self.backend, self.progress)
            share_effects(Sharing(*given))

    def _begin(self, chunks: Sequence[Chunk]) -> None:
        """Announce the variants that will be written, before their first file."""
        for number in sorted({chunk.variant for chunk in chunks}):
            variant = self.job_state.variants[number]
            variant.check_folders(n for c in chunks if c.variant == number for n in c.cameras)
            variant.progress_log.begin(variant.identity)
            write_recipe(variant.recipe, variant.place)

    def _leave_unlabelled(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """Record as failed what belongs to frames whose boxes cannot be read; return the rest."""
        with self.times.spent("labels"):
            labelled = {c.frame for c in chunks if uses_boxes(self.recipes[c.variant])}
            self.boxes.get(sorted(labelled))
            if labelled:
                _ = self.index.instances.by_track  # read once, and not by every worker
        rest = []
        for chunk in chunks:
            message = self.boxes.errors.get(chunk.frame)
            if message is None or not uses_boxes(self.recipes[chunk.variant]):
                rest.append(chunk)
                continue
            for name in chunk.cameras:
                self._deliver(Outcome(chunk.variant, chunk.frame, name, FAILED, message))
        return rest

    def _deliver(self, outcome: Outcome) -> None:
        variant = self.job_state.variants[outcome.variant]
        variant.record(outcome, self.index.frames_by_number[outcome.frame])
        with self.counting:
            self.counts[outcome.status] += 1
            if outcome.status == FAILED:
                where = f"frame {outcome.frame}, camera {outcome.camera}"
                self.failures.append(f"{variant.folder}, {where}: {outcome.message}")
                self.bar.set_postfix(failed=self.counts[FAILED], refresh=False)
            self.bar.update()
            if self.on_outcome is not None:
                self.on_outcome(outcome)

    def _finish(self) -> None:
        with self.times.spent("finish"):
            self.job_state.finish(self.boxes)
