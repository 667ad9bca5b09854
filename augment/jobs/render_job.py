"""Batch job: renders one scene under any number of recipes into one output folder.

In: a `RenderJob` and a function that opens scenes. Out: images, labels, calibration and the
manifest, and a `JobResult`. Called by `climategs render` and by the workers of `generate`.

A job can be killed at any moment and run again: it goes on with the missing images. Its files do
not depend on how often that happened, nor on the number of workers.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import augment
from augment.effects import JobContext, precompute_effects
from augment.errors import ClimateGSError
from augment.jobs.job_state import BoxCache, JobState
from augment.jobs.pools import ProcessPool, SerialPool, Work, run_tasks
from augment.jobs.processes import OutputLock, SharedScene, check_sendable, share_scene
from augment.jobs.time_shares import WORKERS, WorkTimes
from augment.jobs.worker import Chunk, Outcome, SceneSetup, TaskFailed
from augment.memo import memo_of
from augment.output.calibration import trajectory_id
from augment.output.layout import variant_name
from augment.output.manifest import FAILED, OK, Identity
from augment.output.names import MANIFEST_FILE, STATE_FOLDER
from augment.output.recipe_files import check_not_overwritten, lacks_recipe, write_recipe
from augment.output.store import open_store
from augment.photo.recorded_base import check_photos
from augment.progress import ProgressBar
from augment.render.backends import choose_backend
from augment.scene.cameras import Frame
from augment.scene.scene import Scene
from augment.scene.scene_index import SceneIndex, select_frames
from augment.view.box_labels import uses_boxes
from augment.view.quality import choose_settings
from augment.view.results import Renderer
from recipes.files import with_digest
from recipes.schema import Recipe

_log = logging.getLogger(__name__)
SceneLoader = Callable[[str], Scene]
# Most images that a worker process gets at a time; between two tasks its threads have no work.
MAX_TASK_IMAGES = 32


@dataclass(frozen=True, eq=False)
class RenderJob:
    """The images to render, and the folder for them."""

    scene_uri: str
    """URI of the scene, as the scene loader takes it."""
    recipes: Sequence[Recipe]
    """Resolved recipes, one for each variant; their `name` and `variant` number make the folder's
    name. Missing digests of style files are filled in. Settings that a quality leaves open are
    chosen once and kept in the output.
    """
    out_dir: Path | str
    """Output folder."""
    frames: Sequence[int] | None = None
    """Frame numbers of the dataset; None for all."""
    cameras: Sequence[str] | None = None
    """Camera names; None for all."""
    camera_path: Sequence[Frame] | None = None
    """Frames to render in place of the scene's own, with poses in the scene's world. Labels and
    LiDAR pass through where a frame of the scene has the same number and timestamp.
    """
    workers: int = 1
    """Number of worker processes; 1 renders in this process."""
    backend: str = "auto"
    """Name of the rasteriser's backend."""
    overwrite: bool = False
    """If True, the variants' folders are replaced, finished or not, and their settings are chosen
    again.
    """
    shared_files_dir: Path | None = None
    """Folder that keeps the files that images share (exposed surfaces) for later jobs; the state
    folder of the output if None.
    """
    source_digest: str | None = None
    """Digest of the scene's content (adapters.scene_cache.scene_digest). Images of other content in
    the output are then refused.
    """

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
    """Counts of this job's images, and where the time went."""

    written: int
    """Images rendered by this call."""
    skipped: int
    """Images finished by earlier runs."""
    failed: int
    """Images that could not be rendered."""
    manifest: Path
    """Path of the manifest."""
    seconds: float
    """Wall-clock time, seconds."""
    failures: tuple[str, ...] = ()
    """One line for each failure."""
    timings: dict[str, float] = field(default_factory=dict)
    """Seconds by kind of work, summed over threads and workers, or of the job itself (open,
    choose_settings, prepare, read_labels, share_scene, finish).
    `time_shares.compute_time_shares` says what bound the job.
    """


def run_job(
    job: RenderJob,
    *,
    scene_loader: SceneLoader,
    renderer: Renderer | None = None,
    progress: bool = True,
    on_outcome: Callable[[Outcome], None] | None = None,
) -> JobResult:
    """Render the missing images, then write labels, calibration and manifest.

    An image that fails is recorded in the manifest, and the job goes on with the other images. A
    KeyboardInterrupt finishes the images at hand, writes the manifest of the finished images, and
    is raised again.

    Args:
        scene_loader: Called once with `job.scene_uri`.
        renderer: `augment.view.render_view.render_view` if None. With several workers it must be an
        importable
            function, and the scene's labels and sky must be of importable classes.
        progress: If True, show a bar on stderr.
        on_outcome: Called after each image, from several threads, one call at a time.

    Raises:
        SceneError: The scene cannot be opened, lacks a requested frame, camera or photo, or cannot
            have a recipe's snow.
        StyleError, RecipeError: A style or one of its files cannot be used; no file of a variant
            has been written or replaced then.
        OutputError: The folder cannot be written, is in use, or holds something else.
    """
    start_s = time.perf_counter()
    job_run = _Run(job, scene_loader(job.scene_uri), renderer, on_outcome, progress)
    opening_s = time.perf_counter() - start_s
    job_run.times.add("open", opening_s - job_run.times.so_far().get("choose_settings", 0.0))
    job_run.execute()
    seconds = time.perf_counter() - start_s
    job_run.times.add(WORKERS, job.workers * seconds)
    return JobResult(
        written=job_run.counts[OK],
        skipped=job_run.skipped,
        failed=job_run.counts[FAILED],
        manifest=job_run.out_dir / MANIFEST_FILE,
        seconds=seconds,
        failures=tuple(sorted(job_run.failures)),
        timings=job_run.times.so_far(),
    )


class _ImageWork(Work):
    """Tasks that render the images of a job.

    One worker gets all images as one task; several workers get a few frames at a time. Where a
    worker dies, the images it had in hand are tried once more, each image alone.
    """

    def __init__(
        self,
        chunks: Sequence[Chunk],
        workers: int,
        deliver: Callable[[Outcome], None],
        times: WorkTimes,
    ) -> None:
        num_images = sum(len(chunk.cameras) for chunk in chunks)
        max_images = (
            num_images
            if workers == 1
            else max(1, min(MAX_TASK_IMAGES, num_images // (4 * workers)))
        )
        self._tasks: deque[tuple[Chunk, ...]] = deque(_tasks(chunks, max_images))
        self._deliver = deliver
        self._times = times
        self._done: set[tuple[int, int, str]] = set()

    def tick(self, slot: int, outcome: Outcome) -> None:
        self._done.add((outcome.variant, outcome.frame, outcome.camera))
        self._deliver(outcome)

    def take(self, slot: int) -> tuple[Chunk, ...] | None:
        return self._tasks.popleft() if self._tasks else None

    def retry(self, slot: int, task: tuple[Chunk, ...], reason: str) -> list[tuple[Chunk, ...]]:
        chunks = self._undelivered(task)
        _log.warning("%d images are tried once more, alone: %s", len(chunks), reason)
        return [(image,) for image in chunks]

    def done(self, slot: int, task: tuple[Chunk, ...], result: Any) -> None:
        if isinstance(result, TaskFailed):
            raise ClimateGSError(result.text)
        self._times.update(result)

    def lost(self, slot: int, task: tuple[Chunk, ...], how: str) -> None:
        message = (
            f"the worker process {how} while rendering this image, and again when it was tried "
            f"alone; if memory ran out, use fewer workers"
        )
        for image in self._undelivered(task):
            name = image.cameras[0]
            self._deliver(Outcome(image.variant, image.frame, name, FAILED, message))

    def _undelivered(self, task: tuple[Chunk, ...]) -> list[Chunk]:
        """Return a chunk for each image that has not been delivered."""
        images = [replace(chunk, cameras=(name,)) for chunk in task for name in chunk.cameras]
        return [i for i in images if (i.variant, i.frame, i.cameras[0]) not in self._done]


def _tasks(chunks: Sequence[Chunk], max_images: int) -> Iterator[tuple[Chunk, ...]]:
    """Yield runs of chunks, each of about `max_images` images."""
    run: list[Chunk] = []
    for chunk in chunks:
        run.append(chunk)
        if sum(len(run_chunk.cameras) for run_chunk in run) >= max_images:
            yield tuple(run)
            run = []
    if run:
        yield tuple(run)


class _Run:
    """State of one call of run_job."""

    def __init__(
        self,
        job: RenderJob,
        scene: Scene,
        renderer: Renderer | None,
        on_outcome: Callable[[Outcome], None] | None,
        progress: bool,
    ) -> None:
        self.job = job
        self.renderer = renderer
        self.on_outcome = on_outcome
        self.progress = progress
        self.times = WorkTimes()
        self.scene: Scene | None = scene  # None once workers have it
        # A stand-in renderer decides on backends itself.
        self.backend = job.backend if renderer else choose_backend(job.backend, scene)
        self.index = SceneIndex.of(scene, job.camera_path)
        self.selection = select_frames(self.index, job.frames, job.cameras)
        is_path = job.camera_path is not None
        check_photos(job.recipes, scene.name, self.selection, is_path=is_path)
        self.out_dir = Path(job.out_dir).absolute()
        self.trajectory = trajectory_id(job.camera_path)
        self.recipes = tuple(self._resolve_quality(with_digest(r)) for r in job.recipes)
        identities = [self._identity(recipe) for recipe in self.recipes]
        self.job_state = JobState(self.out_dir, self.index, self.recipes, identities)
        self.boxes = BoxCache(self.index)
        self.counts: Counter[str] = Counter()
        self.failures: list[str] = []
        self.counting = threading.Lock()  # outcomes arrive from several threads

    def execute(self) -> None:
        """Render what is missing under the output folder's lock, and write the tables."""
        self.total = len(self.recipes) * sum(len(names) for _, names in self.selection)
        with OutputLock(self.out_dir) as lock:
            if self.job.overwrite:  # may fail, so it comes before anything is deleted
                folders = [variant.path for variant in self.job_state.variants]
                for recipe in self.recipes:
                    check_not_overwritten(recipe, folders)
                self._prepare(self.recipes)
            self.job_state.open(overwrite=self.job.overwrite)
            self._restore_recipes()
            chunks = list(self.job_state.pending(self.selection))
            self.skipped = self.total - sum(len(chunk.cameras) for chunk in chunks)
            try:
                if not self.job.overwrite:
                    pending_variants = sorted({chunk.variant for chunk in chunks})
                    self._prepare([self.recipes[number] for number in pending_variants])
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
        """Write the missing recipes of begun variants, and the missing files that they name."""
        for variant in self.job_state.variants:
            if variant.rows and lacks_recipe(variant.recipe, variant.path):
                write_recipe(variant.recipe, variant.path)

    def _render(self, chunks: list[Chunk], lock: OutputLock) -> None:
        """Render the chunks in this process, or in worker processes."""
        if chunks:
            self._begin(chunks)
            chunks = self._fail_unlabelled(chunks)
        if not chunks:
            return
        work = _ImageWork(chunks, self.job.workers, self._deliver, self.times)
        with contextlib.ExitStack() as stack:
            if self.job.workers == 1:
                pool = SerialPool(self._setup())
            else:
                setup = self._setup()
                shared_scene = self._share_scene()
                stack.callback(shared_scene.remove)
                setup = replace(setup, open_scene=shared_scene.open, lock=lock.inherited())
                pool = ProcessPool(setup, self.job.workers)
            stack.callback(pool.close)
            run_tasks(pool, work)

    def _setup(self) -> SceneSetup:
        """Return the setup of a worker in this process."""
        scene, _ = self._opened_scene()
        return SceneSetup(
            out_dir=str(self.out_dir),
            recipes=self.recipes,
            backend=self.backend,
            renderer=self.renderer,
            open_scene=self._opened_scene,
            labelled=self.index.labelled_frames,
            instances=self.index.instances,
            memo=memo_of(scene.as_recorded).shared(),
            overwrite=self.job.overwrite,
            workers=self.job.workers,
        )

    def _opened_scene(self) -> tuple[Scene, Sequence[Frame]]:
        assert self.scene is not None, "workers have it"
        return self.scene, self.index.frames

    def _share_scene(self) -> SharedScene:
        """Hand the scene to worker processes; this process needs only the index from now on."""
        check_sendable(self.renderer)
        with self.times.measure("share_scene"):
            shared_scene = share_scene(*self._opened_scene(), self.out_dir / STATE_FOLDER)
        self.scene = None
        return shared_scene

    def _resolve_quality(self, recipe: Recipe) -> Recipe:
        """Return the recipe with the settings that its quality chooses, or has chosen before."""
        if not recipe.has_open_choice:
            return recipe
        assert self.scene is not None
        with self.times.measure("choose_settings"):
            return choose_settings(
                open_store(self.out_dir),
                recipe,
                self.scene,
                backend=self.backend,
                camera_path=self.job.camera_path,
                renderer=self.renderer,
                choose_again=self.job.overwrite,
                progress=self.progress,
            )

    def _identity(self, recipe: Recipe) -> Identity:
        """Return the identity of the recipe's images."""
        return Identity(
            self.index.source,
            recipe.hash,
            self.trajectory,
            augment.__version__,
            self.backend,
            self.job.source_digest,
        )

    def _prepare(self, recipes: Sequence[Recipe]) -> None:
        """Compute the data that images of these recipes share.

        The data cover all cameras of the scene or of the path.
        """
        assert self.scene is not None
        cameras = None
        path = self.job.camera_path
        if path is not None and any(recipe.sections() for recipe in recipes):
            # A copy: the caller's scene must not remember data of this path.
            self.scene = self.scene.without_memo()
            cameras = [camera for frame in path for camera in frame.cameras.values()]
        with self.times.measure("prepare"):
            folder = self.job.shared_files_dir or self.out_dir / STATE_FOLDER
            arguments = (self.scene, recipes, cameras, folder, self.backend, self.progress)
            precompute_effects(JobContext(*arguments))

    def _begin(self, chunks: Sequence[Chunk]) -> None:
        """Note the variants that will be written, before their first file."""
        for number in sorted({chunk.variant for chunk in chunks}):
            variant = self.job_state.variants[number]
            variant.check_folders(n for c in chunks if c.variant == number for n in c.cameras)
            variant.progress_log.begin(variant.identity)
            write_recipe(variant.recipe, variant.path)

    def _fail_unlabelled(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """Record the images of frames with unreadable boxes as failed; return the other chunks."""
        with self.times.measure("read_labels"):
            labelled_frames = {c.frame for c in chunks if uses_boxes(self.recipes[c.variant])}
            self.boxes.get(sorted(labelled_frames))
            if labelled_frames:
                _ = self.index.instances.by_track  # read once here, and not by every worker
        remaining_chunks = []
        for chunk in chunks:
            message = self.boxes.errors.get(chunk.frame)
            if message is None or not uses_boxes(self.recipes[chunk.variant]):
                remaining_chunks.append(chunk)
                continue
            for name in chunk.cameras:
                self._deliver(Outcome(chunk.variant, chunk.frame, name, FAILED, message))
        return remaining_chunks

    def _deliver(self, outcome: Outcome) -> None:
        """Record an image's outcome, and count it."""
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
        """Write labels, calibration and manifest."""
        with self.times.measure("finish"):
            self.job_state.finish(self.boxes)
