"""A batch job: one scene, any number of recipes, images and labels into one output folder.

A job can be killed at any moment and run again: it goes on with what is missing. The files it
leaves do not depend on how often that happened, nor on the number of workers.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

import augment
from augment.batch.atomic import write_atomic
from augment.batch.backends import choose_backend
from augment.batch.executors import run_in_processes, run_serially
from augment.batch.finish import BoxCache, finish, needs_finish
from augment.batch.journal import Identity
from augment.batch.layout import MANIFEST, variant_name
from augment.batch.ledger import Ledger
from augment.batch.lock import OutputLock
from augment.batch.manifest import FAILED, OK
from augment.batch.runner import Chunk, Outcome, Renderer, Setup
from augment.batch.selection import SceneIndex, select_frames
from augment.batch.trajectory import frames_to_json, trajectory_id
from augment.batch.worker import SceneLoader
from augment.cameras import Frame
from augment.scene import Scene
from recipes.dump import dump_recipe
from recipes.schema import Recipe


@dataclass(frozen=True, eq=False)
class RenderJob:
    """What to render, and where to.

    recipes: resolved recipes, one a variant; their `name` and `variant` number make the folder.
    frames: the dataset's frame numbers, or None for all. cameras: names, or None for all.
    camera_path: frames to render in place of the scene's own, poses in the scene's world; labels
    and LiDAR pass through where a frame of the scene has the same number and timestamp.
    workers: 1 renders in this process. overwrite: replace the variants' folders, finished or not.
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

    manifest: its path. seconds: wall clock. timings: seconds by kind of work, summed over
    threads and workers (render, encode, write), or of the job itself (open, labels, finish).
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
) -> JobResult:
    """Render what is missing, then write labels, calibration and manifest.

    scene_loader: opens `job.scene_uri`; renderer: `augment.apply.render_view` if None. With
    several workers both must be importable functions, since each worker process calls them.
    An image that fails is recorded in the manifest and the rest goes on. A KeyboardInterrupt
    finishes the images at hand, writes the manifest of what there is, and is raised again.

    Raises:
        SceneError: the scene cannot be opened, or lacks a wanted frame or camera.
        OutputError: the folder cannot be written, is in use, or holds something else.
    """
    return _Run(job, scene_loader, renderer).go(progress)


class _Run:
    def __init__(
        self, job: RenderJob, scene_loader: SceneLoader, renderer: Renderer | None
    ) -> None:
        self.job, self.scene_loader, self.renderer = job, scene_loader, renderer
        self.out_dir = Path(job.out_dir).absolute()
        self.timings: defaultdict[str, float] = defaultdict(float)
        self.counts: Counter[str] = Counter()
        self.failures: list[str] = []
        self.counting = threading.Lock()  # outcomes arrive from several threads
        self.backend = job.backend

    def go(self, progress: bool) -> JobResult:
        started = time.perf_counter()
        scene: Scene | None = self.scene_loader(self.job.scene_uri)
        self.timings["open"] += time.perf_counter() - started
        if self.renderer is None:  # a stand-in has its own idea of backends
            self.backend = choose_backend(self.job.backend, scene)
        index = SceneIndex.of(scene, self.job.camera_path)
        selection = select_frames(index, self.job.frames, self.job.cameras)
        if self.job.workers > 1:
            scene = None  # its memory is the workers' to use
        recipes = tuple(self.job.recipes)
        total = len(recipes) * sum(len(names) for _, names in selection)
        with OutputLock(self.out_dir) as lock:
            ledger = Ledger(self.out_dir, index, recipes, self._identities(index, recipes))
            ledger.open(overwrite=self.job.overwrite)
            chunks = list(ledger.pending(selection))
            left = sum(len(chunk.cameras) for chunk in chunks)
            bar = tqdm(
                total=total, initial=total - left, unit="image", disable=not progress, leave=True
            )
            try:
                with bar:
                    self._render(scene, index, ledger, chunks, lock, bar)
            except KeyboardInterrupt:
                done = total - left + self.counts[OK]
                raise KeyboardInterrupt(
                    f"stopped with {done} of {total} images finished; run the same command "
                    f"again to go on from there"
                ) from None
            finally:
                ledger.close()
        return JobResult(
            written=self.counts[OK],
            skipped=total - left,
            failed=self.counts[FAILED],
            manifest=self.out_dir / MANIFEST,
            seconds=time.perf_counter() - started,
            failures=tuple(sorted(self.failures)),
            timings=dict(self.timings),
        )

    def _render(
        self,
        scene: Scene | None,
        index: SceneIndex,
        ledger: Ledger,
        chunks: list[Chunk],
        lock: OutputLock,
        bar: tqdm,
    ) -> None:
        boxes = BoxCache(index)
        try:
            if chunks:
                self._begin(ledger, chunks)
                chunks = self._leave_unlabelled(ledger, chunks, boxes, bar)
                self._execute(scene, index, ledger, chunks, lock, bar)
        except KeyboardInterrupt:
            self._finish(ledger, boxes)
            raise
        if self.counts or needs_finish(ledger):
            self._finish(ledger, boxes)

    def _execute(
        self,
        scene: Scene | None,
        index: SceneIndex,
        ledger: Ledger,
        chunks: list[Chunk],
        lock: OutputLock,
        bar: tqdm,
    ) -> None:
        path = self.job.camera_path
        setup = Setup(
            scene_uri=self.job.scene_uri,
            out_dir=str(self.out_dir),
            recipes=tuple(self.job.recipes),
            backend=self.backend,
            camera_path=None if path is None else frames_to_json(path),
            labelled=index.labelled,
        )

        def deliver(outcome: Outcome) -> None:
            self._deliver(ledger, outcome, bar)

        if scene is not None:
            run_serially(scene, setup, chunks, self.renderer, deliver)
        elif chunks:
            run_in_processes(
                setup,
                chunks,
                workers=self.job.workers,
                scene_loader=self.scene_loader,
                renderer=self.renderer,
                deliver=deliver,
                lock=lock,
            )

    def _identities(self, index: SceneIndex, recipes: Sequence[Recipe]) -> list[Identity]:
        return [
            Identity(
                source=index.source,
                recipe_hash=recipe.hash,
                trajectory=trajectory_id(self.job.camera_path),
                version=augment.__version__,
                backend=self.backend,
            )
            for recipe in recipes
        ]

    def _begin(self, ledger: Ledger, chunks: Sequence[Chunk]) -> None:
        """Announce the variants that will be written, before their first file."""
        for number in sorted({chunk.variant for chunk in chunks}):
            variant = ledger.variants[number]
            variant.journal.begin(variant.identity)
            text = dump_recipe(variant.recipe).encode()
            write_atomic(self.out_dir / variant.folder / "recipe.yaml", text)

    def _leave_unlabelled(
        self, ledger: Ledger, chunks: Sequence[Chunk], boxes: BoxCache, bar: tqdm
    ) -> list[Chunk]:
        """Record as failed what belongs to frames whose boxes cannot be read; return the rest."""
        started = time.perf_counter()
        labelled = {c.frame for c in chunks if ledger.variants[c.variant].recipe.output.labels}
        boxes.get(sorted(labelled))
        self.timings["labels"] += time.perf_counter() - started
        rest = []
        for chunk in chunks:
            message = boxes.errors.get(chunk.frame)
            if message is None or not ledger.variants[chunk.variant].recipe.output.labels:
                rest.append(chunk)
                continue
            for name in chunk.cameras:
                outcome = Outcome(chunk.variant, chunk.frame, name, FAILED, message)
                self._deliver(ledger, outcome, bar)
        return rest

    def _deliver(self, ledger: Ledger, outcome: Outcome, bar: tqdm) -> None:
        ledger.record(outcome, ledger.index.frames_by_number[outcome.frame])
        with self.counting:
            self.counts[outcome.status] += 1
            for kind, seconds in outcome.seconds.items():
                self.timings[kind] += seconds
            if outcome.status == FAILED:
                where = f"frame {outcome.frame}, camera {outcome.camera}"
                folder = ledger.variants[outcome.variant].folder
                self.failures.append(f"{folder}, {where}: {outcome.message}")
                bar.set_postfix(failed=self.counts[FAILED], refresh=False)
            bar.update()

    def _finish(self, ledger: Ledger, boxes: BoxCache) -> None:
        started = time.perf_counter()
        finish(ledger, trajectory_id(self.job.camera_path), boxes)
        self.timings["finish"] += time.perf_counter() - started
