"""A batch job: one scene, any number of recipes, images and labels into one output folder.

A job can be killed at any moment and run again: it goes on with what is missing. The files it
leaves do not depend on how often that happened, nor on the number of workers.
"""

from __future__ import annotations

import copy
import re
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath

from tqdm import tqdm

import augment
from augment.cameras import Frame
from augment.errors import OutputError
from augment.jobs.atomic import write_atomic
from augment.jobs.backends import choose_backend
from augment.jobs.files import SceneIndex, frames_to_json, select_frames, trajectory_id, uses_boxes
from augment.jobs.job_state import BoxCache, JobState, finish, needs_finish
from augment.jobs.layout import MANIFEST, STATE_FOLDER, folder_name, variant_name
from augment.jobs.manifest import FAILED, OK, Identity
from augment.jobs.prepare import (
    StoredBed,
    StoredMaps,
    snow_to_lay,
    store_beds,
    store_maps,
    style_to_apply,
)
from augment.jobs.processes import OutputLock, share_scene
from augment.jobs.store import open_store
from augment.jobs.worker import (
    WORKERS,
    Chunk,
    Outcome,
    Renderer,
    Setup,
    run_in_processes,
    run_serially,
)
from augment.scene import Scene
from recipes.files import read_files, with_digest
from recipes.load import dump_recipe
from recipes.schema import Recipe
from recipes.weather import Style

# ---- The files of a style beside the images that it made: `<variant>/style/` ---------------------
# With them a variant's `recipe.yaml` renders it again wherever the folder is taken.

STYLE_FOLDER = "style"
_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,16}")


def stored_names(style: Style) -> dict[str, str]:
    """The name of each of the style's files inside the variant's folder, by field. The image keeps
    its name where that is safe; another file of the same name gets its field's name before its own.
    """
    names: dict[str, str] = {}
    for key, path in style.files.items():
        name = _safe_name(path)
        while name.casefold() in {taken.casefold() for taken in names.values()}:
            name = f"{key}-{name}"
        names[key] = name
    return {key: f"{STYLE_FOLDER}/{name}" for key, name in names.items()}


def portable_recipe(recipe: Recipe) -> Recipe:
    """The recipe with its style's files named from the variant's folder; its hash is the same."""
    style = recipe.style
    if style is None or not style.files:
        return recipe
    return recipe.model_copy(update={"style": style.model_copy(update=stored_names(style))})


def check_kept(recipe: Recipe, folders: Collection[Path]) -> None:
    """Refuse to overwrite (`folders`) files that the recipe is about to need."""
    files = {} if recipe.style is None else recipe.style.files
    for key, path in files.items():
        real = Path(path).resolve()
        for folder in folders:
            if real.is_relative_to(folder.resolve()):
                raise OutputError(
                    f"style.{key} of recipe {recipe.name} is {real}, in the folder {folder}, "
                    f"which is to be overwritten: copy the recipe and its files out of it first"
                )


def copy_style_files(recipe: Recipe, folder: Path) -> None:
    """Put the style's files where `portable_recipe` names them. folder: the variant's. Raises
    RecipeError: they cannot be read or are not those of the recipe's digest. OutputError: they
    cannot be written.
    """
    if recipe.style is None or not recipe.style.files:
        return
    names = stored_names(recipe.style)
    for key, data in read_files(recipe.style).items():
        path = folder / names[key]
        if not (path.is_file() and path.read_bytes() == data):
            write_atomic(path, data)


def _safe_name(path: str) -> str:
    """The file's name as `folder_name` has it, with its suffix still at the end."""
    name = PurePath(path)
    if _SUFFIX.fullmatch(name.suffix):
        return folder_name(name.stem) + name.suffix
    return folder_name(name.name)


# ---- The job -------------------------------------------------------------------------------------

SceneLoader = Callable[[str], Scene]


@dataclass(frozen=True, eq=False)
class RenderJob:
    """What to render, and where to.

    recipes: resolved recipes, one a variant; their `name` and `variant` number make the folder.
    Where a style names files without a digest, the job fills it in; where a quality has still to
    choose its settings, they are chosen once and kept in the output, for every later run.
    frames: the dataset's frame numbers, or None for all. cameras: names, or None for all.
    camera_path: frames to render in place of the scene's own, poses in the scene's world; labels
    and LiDAR pass through where a frame of the scene has the same number and timestamp.
    workers: 1 renders in this process. overwrite: replace the variants' folders, finished or not,
    and choose their settings anew.
    beds_dir: where it is kept where snow can lie, for later jobs; in the output folder if None.
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
    beds_dir: Path | None = None

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
    """Counts of images of this job. skipped: finished by earlier runs. failures: one line each.
    manifest: its path. seconds: wall clock. timings: seconds by kind of work, summed over threads
    and workers (the kinds of `times`), or of the job itself (open, settle, place, style, labels,
    share, finish). `times.shares_of` says what the job was bound by.
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
    """Render what is missing, then write labels, calibration and manifest.

    scene_loader: called once with `job.scene_uri`. renderer: `augment.views.render_view` if None;
    with several workers it must be an importable function, and the scene's labels and sky of
    importable classes, since both are sent to other processes. progress: a bar on stderr. tell: is
    called after each image with what became of it, from several threads, one at a time.

    An image that fails is recorded in the manifest and the rest goes on. A KeyboardInterrupt
    finishes the images at hand, writes the manifest of what there is, and is raised again.

    Raises:
        SceneError: the scene cannot be opened, lacks a wanted frame or camera, or cannot have the
            snow of a recipe. StyleError, RecipeError: a style or one of its files cannot be used.
            No file of a variant has been written or replaced then.
        OutputError: the folder cannot be written, is in use, or holds something else.
    """
    started = time.perf_counter()
    run = _Run(job, scene_loader(job.scene_uri), renderer, on_outcome, progress)
    run.timings["open"] = time.perf_counter() - started - run.timings.get("settle", 0.0)
    run.go(progress)
    seconds = time.perf_counter() - started
    run.timings[WORKERS] = job.workers * seconds
    return JobResult(
        written=run.counts[OK],
        skipped=run.skipped,
        failed=run.counts[FAILED],
        manifest=run.out_dir / MANIFEST,
        seconds=seconds,
        failures=tuple(sorted(run.failures)),
        timings=dict(run.timings),
    )


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
        self.scene: Scene | None = scene  # None once workers have it
        self.timings: defaultdict[str, float] = defaultdict(float)
        # A stand-in has its own idea of backends.
        self.backend = job.backend if renderer else choose_backend(job.backend, scene)
        self.index = SceneIndex.of(scene, job.camera_path)
        self.selection = select_frames(self.index, job.frames, job.cameras)
        self.out_dir = Path(job.out_dir).absolute()
        self.trajectory = trajectory_id(job.camera_path)
        self.recipes = tuple(self._resolved(with_digest(r), progress) for r in job.recipes)
        self.job_state = JobState(self.out_dir, self.index, self.recipes, self._identities())
        self.boxes = BoxCache(self.index)
        self.beds: tuple[StoredBed, ...] = ()
        self.maps: tuple[StoredMaps, ...] = ()
        self.counts: Counter[str] = Counter()
        self.failures: list[str] = []
        self.counting = threading.Lock()  # outcomes arrive from several threads

    def go(self, progress: bool) -> None:
        self.total = len(self.recipes) * sum(len(names) for _, names in self.selection)
        with OutputLock(self.out_dir) as lock:
            if self.job.overwrite:  # this may fail, so it comes before anything is given up
                self._check_kept()
                self._prepare(self.recipes, progress)
            self.job_state.open(overwrite=self.job.overwrite)
            chunks = list(self.job_state.pending(self.selection))
            self.skipped = self.total - sum(len(chunk.cameras) for chunk in chunks)
            try:
                if not self.job.overwrite:
                    pending = sorted({chunk.variant for chunk in chunks})
                    self._prepare([self.recipes[number] for number in pending], progress)
                self.bar = tqdm(
                    total=self.total, initial=self.skipped, unit="image", disable=not progress
                )
                with self.bar:
                    self._render(chunks, lock)
                    if self.counts or needs_finish(self.job_state):
                        self._finish()
            except KeyboardInterrupt:
                self._finish()
                raise KeyboardInterrupt(
                    f"stopped with {self.skipped + self.counts[OK]} of {self.total} images "
                    f"finished; run the same command again to go on from there"
                ) from None
            finally:
                self.job_state.close()

    def _render(self, chunks: list[Chunk], lock: OutputLock) -> None:
        if chunks:
            self._begin(chunks)
            chunks = self._leave_unlabelled(chunks)
        path = self.job.camera_path
        setup = Setup(
            out_dir=str(self.out_dir),
            recipes=self.recipes,
            backend=self.backend,
            camera_path=None if path is None else frames_to_json(path),
            labelled=self.index.labelled,
            instances=self.index.instances,
            beds=self.beds,
            maps=self.maps,
        )
        assert self.scene is not None
        if not chunks:
            return
        if self.job.workers == 1:
            spent = run_serially(self.scene, setup, chunks, self.renderer, self._deliver)
            self.timings.update(spent)
            return
        started = time.perf_counter()
        shared = share_scene(self.scene, self.out_dir / STATE_FOLDER)
        self.scene = None  # this process needs no more of it than the index
        self.timings["share"] += time.perf_counter() - started
        try:
            spent = run_in_processes(
                setup,
                chunks,
                workers=self.job.workers,
                shared=shared,
                renderer=self.renderer,
                deliver=self._deliver,
                lock=lock,
            )
        finally:
            shared.remove()
        self.timings.update(spent)

    def _resolved(self, recipe: Recipe, progress: bool) -> Recipe:
        """The recipe with the settings that its quality chooses here, or has chosen before."""
        if not recipe.quality.is_open:
            return recipe
        from augment.jobs.quality import resolve_quality_for

        started = time.perf_counter()
        assert self.scene is not None
        settled = resolve_quality_for(
            open_store(self.out_dir),
            recipe,
            self.scene,
            backend=self.backend,
            camera_path=self.job.camera_path,
            renderer=self.renderer,
            anew=self.job.overwrite,
            progress=progress,
        )
        self.timings["settle"] += time.perf_counter() - started
        return settled

    def _identities(self) -> list[Identity]:
        return [
            Identity(
                source=self.index.source,
                recipe_hash=recipe.hash,
                trajectory=self.trajectory,
                version=augment.__version__,
                backend=self.backend,
            )
            for recipe in self.recipes
        ]

    def _check_kept(self) -> None:
        folders = [self.out_dir / variant.folder for variant in self.job_state.variants]
        for recipe in self.recipes:
            check_kept(recipe, folders)

    def _prepare(self, recipes: Collection[Recipe], progress: bool) -> None:
        """Find what images of these recipes share, for all cameras of the scene or the path. Where
        their snow can lie, and the colour maps of their styles.
        """
        snowy = [recipe for recipe in recipes if snow_to_lay(recipe) is not None]
        styled = [recipe for recipe in recipes if style_to_apply(recipe) is not None]
        assert self.scene is not None
        cameras, path = None, self.job.camera_path
        if path is not None and (snowy or styled):
            # An object of its own, or the caller's would remember what was found for this path.
            self.scene = copy.copy(self.scene)
            cameras = [camera for frame in path for camera in frame.cameras.values()]
        if styled:
            started = time.perf_counter()
            self.maps = store_maps(self.scene, styled, cameras=cameras)
            self.timings["style"] += time.perf_counter() - started
        if snowy:
            started = time.perf_counter()
            folder = self.job.beds_dir or self.out_dir / STATE_FOLDER
            self.beds = store_beds(
                self.scene, snowy, folder, cameras=cameras, backend=self.backend, progress=progress
            )
            self.timings["place"] += time.perf_counter() - started

    def _begin(self, chunks: Sequence[Chunk]) -> None:
        """Announce the variants that will be written, before their first file."""
        for number in sorted({chunk.variant for chunk in chunks}):
            variant = self.job_state.variants[number]
            variant.progress_log.begin(variant.identity)
            folder = self.out_dir / variant.folder
            copy_style_files(variant.recipe, folder)
            text = dump_recipe(portable_recipe(variant.recipe)).encode()
            write_atomic(folder / "recipe.yaml", text)

    def _leave_unlabelled(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """Record as failed what belongs to frames whose boxes cannot be read; return the rest."""
        started = time.perf_counter()
        labelled = {c.frame for c in chunks if uses_boxes(self.recipes[c.variant])}
        self.boxes.get(sorted(labelled))
        if labelled:
            _ = self.index.instances.by_track  # read once, and not by every worker
        self.timings["labels"] += time.perf_counter() - started
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
        self.job_state.record(outcome, self.index.frames_by_number[outcome.frame])
        with self.counting:
            self.counts[outcome.status] += 1
            if outcome.status == FAILED:
                where = f"frame {outcome.frame}, camera {outcome.camera}"
                folder = self.job_state.variants[outcome.variant].folder
                self.failures.append(f"{folder}, {where}: {outcome.message}")
                self.bar.set_postfix(failed=self.counts[FAILED], refresh=False)
            self.bar.update()
            if self.on_outcome is not None:
                self.on_outcome(outcome)

    def _finish(self) -> None:
        started = time.perf_counter()
        finish(self.job_state, self.trajectory, self.boxes)
        self.timings["finish"] += time.perf_counter() - started
