"""Dataset job: renders many scenes under many recipes into one output, by any number of workers.

In: a `GenerateJob` (recipes, scenes, output, executor). Out: images, labels and the manifest in the
output, and a `GenerateResult`. Called by `climategs generate` (`tools/generate.py`).

The output alone says which images are finished. Therefore a job that was killed at any moment goes
on when it is started again, and any number of processes on any number of machines can work on the
same job: they claim, render and publish blocks of images one by one. The files do not depend on
which process rendered which block, nor on how often the job was interrupted.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

import augment
from augment.errors import OutputError
from augment.jobs.block_queue import BlockWork, SceneWork
from augment.jobs.block_worker import IndexTask, JobWorkerSetup, ResolvedRecipes, ResolveTask
from augment.jobs.blocks import Block, JobPlan, SceneRecord, make_job_plan, select_shard, store_plan
from augment.jobs.pools import ProcessPool, RayPool, SerialPool, Work, WorkerPool, run_tasks
from augment.jobs.processes import available_cores
from augment.jobs.publishing import clear_leftovers
from augment.jobs.scene_changes import SceneChange, changes_in
from augment.jobs.time_shares import WORKERS
from augment.output.atomic import raise_output_error
from augment.output.calibration import RECORDED
from augment.output.claims import try_claim
from augment.output.layout import FileListing, path_kinds, variant_folder, variant_name
from augment.output.manifest import (
    FAILED,
    KEY,
    OK,
    TRAILING,
    Identity,
    compact,
    image_row,
    leading_columns,
    lidar_notes,
    list_parts,
    parts_to_merge,
    publish_part,
    read_manifest_rows,
    rows_to_table,
    rows_without_files,
)
from augment.output.names import MANIFEST_FILE, STATE_FOLDER
from augment.output.recipe_files import lacks_recipe, write_recipe
from augment.output.store import Store, StoredFileMissing, open_store
from augment.photo.trust import magnification_sentence, skipped_cameras_sentence
from augment.progress import ProgressBar
from augment.render.backends import renders_on_gpu
from augment.render.buffers import AUTO, CUDA
from augment.view.quality import Question, read_choice
from recipes.files import with_digest
from recipes.job import JobScene, SceneRecipes
from recipes.schema import Recipe, columns_of_effects

_log = logging.getLogger(__name__)

# ---- Settings that recipe qualities choose in each scene, before there is a plan -----------------
# The output keeps every choice: scenes without an open choice are not opened again.

# Reads from the store at a time: a read spends most of its time waiting.
_NUM_READS = 16

# Record of a scene, or why it cannot be opened, by URI and name.
SceneRecords = Mapping[tuple[str, str | None], SceneRecord | str]
# Resolved recipe, or why it could not choose its settings, by scene and variant.
Choices = dict[tuple[str, str], Recipe | str]


def resolve_recipes(
    job: GenerateJob,
    store: Store,
    workers: Workers,
    scene_records: SceneRecords,
    *,
    progress: bool,
    keep: bool,
) -> Choices:
    """Return the recipes that had to choose settings, by scene and variant.

    Args:
        scene_records: Record of every scene, or why it cannot be opened, by URI and name.
        keep: If True, the output keeps new choices.

    Returns:
        Resolved recipe, or a text that says why it could not choose.
    """
    questions = [
        (Question(recipe, record.name, record.source, RECORDED, job.setup.backend), entry)
        for entry in job.scenes
        if isinstance(record := scene_records[entry.uri, entry.name], SceneRecord)
        for recipe in job.recipes.resolve_for_scene(entry, record.name)
        if recipe.has_open_choice
    ]
    with ThreadPoolExecutor(_NUM_READS, thread_name_prefix="choices") as pool:
        answers = list(pool.map(lambda pair: read_choice(store, pair[0]), questions))
    choices: Choices = {}
    open_recipes: defaultdict[tuple[str, str | None, str], list[Recipe]] = defaultdict(list)
    for (question, entry), answer in zip(questions, answers, strict=True):
        if answer is None:
            open_recipes[entry.uri, entry.name, question.scene].append(question.recipe)
        else:
            choices[question.scene, variant_name(question.recipe)] = answer
    tasks = {
        ResolveTask(uri, name, tuple(dict.fromkeys(recipes)), keep): scene
        for (uri, name, scene), recipes in open_recipes.items()
    }
    bar = ProgressBar(
        total=len(tasks), unit="scene", desc="choosing settings", disable=not progress or not tasks
    )

    def on_result(task: ResolveTask, resolved: ResolvedRecipes | str) -> None:
        for number, recipe in enumerate(task.recipes):
            outcome = resolved if isinstance(resolved, str) else resolved.recipes[number]
            choices[tasks[task], variant_name(recipe)] = outcome
        bar.update()

    with bar:
        is_timed = any(r.quality.budget_ms is not None for task in tasks for r in task.recipes)
        # Each shard begins at another task, so that shards that start together do not wait for each
        # other's choices.
        number, count = job.shard
        start = (number - 1) * len(tasks) // count
        ordered_tasks = [*tasks][start:] + [*tasks][:start]
        activity = "choosing the settings of its recipes"
        # Choices that measure frame times run one by one, so that none disturbs another's times.
        workers.run(
            SceneWork(ordered_tasks, on_result, activity, workers.scene_of_slot),
            slots=1 if is_timed else None,
        )
    return choices


# ---- The job -------------------------------------------------------------------------------------

# Folder of the output's records of scenes.
SCENES = f"{STATE_FOLDER}/scenes"
# Kinds of workers, as `GenerateJob.executor` names them.
EXECUTORS = ("serial", "processes", "ray")
# Least time between two merges of the manifest while the job runs, seconds.
_MERGE_INTERVAL_S = 60.0
# Longest wait at the job's end for another process that is merging the manifest, seconds.
_MERGE_PATIENCE_S = 30.0
# Notes about the scenes that are logged one by one.
_MAX_NOTES = 20


@dataclass(frozen=True)
class GenerateJob:
    """A dataset job: recipes, scenes and output, and the workers that render it."""

    recipes: SceneRecipes
    """Loaded recipes of the job."""
    scenes: Sequence[JobScene]
    """Scenes of the job, with patterns already expanded."""
    setup: JobWorkerSetup
    """Output, backend and scene loader of the workers."""
    executor: str = "processes"
    """`serial` renders in this process, `processes` in several processes of this machine, `ray` in
    actors on a cluster.
    """
    workers: int | None = None
    """Number of workers. None: one for each core; one process where a GPU renders; one actor for
    each GPU of the cluster.
    """
    shard: tuple[int, int] = (1, 1)
    """Part of the job that is done here, counted from 1, and the number of parts."""
    reopens_scenes: bool = False
    """If True, all scenes are opened again, in case they have changed."""

    def __post_init__(self) -> None:
        if self.executor not in EXECUTORS:
            raise ValueError(f"executor must be one of {EXECUTORS}; got {self.executor!r}")
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be >= 1; got {self.workers}")
        number, count = self.shard
        if not 1 <= number <= count:
            raise ValueError(f"shard must be i/n with 1 <= i <= n; got {number}/{count}")


@dataclass(frozen=True)
class GenerateResult:
    """Counts of the images of this shard, and where the time went."""

    written: int
    """Images rendered by this call."""
    skipped: int
    """Images that were finished before, here or by another process."""
    failed: int
    """Images that could not be rendered."""
    unusable: dict[str, str]
    """Reasons why scenes cannot be used, by URI."""
    failures: tuple[str, ...]
    """One line for each failure."""
    seconds: float
    """Wall-clock time of the call, seconds."""
    timings: dict[str, float] = field(default_factory=dict)
    """Seconds by kind of work, summed over threads and workers, as
    `time_shares.compute_time_shares` takes them. Measured by the clock: `plan`, `find_finished` for
    what is done, and `render_wall`, everything else.
    """


def run_generate(
    job: GenerateJob,
    *,
    progress: bool = True,
    prepare: Callable[[list[Recipe]], None] = lambda recipes: None,
    on_image: Callable[[int, int], None] = lambda done, failed: None,
) -> GenerateResult:
    """Render and publish the images of the job that are not finished yet.

    A KeyboardInterrupt lets workers finish the images at hand, merges the published images into the
    manifest, and is raised again.

    Args:
        progress: If True, show bars on stderr.
        prepare: Called before the first image is rendered, with one recipe of each name; compiles
            kernels once instead of in every worker, for example.
        on_image: Called with the number of images done and the number of failed ones, from several
            threads.

    Raises:
        OutputError: The output cannot be written, or it holds images of another kind under the same
            names; no image was written in the second case.
        ClimateGSError: No scene can be used.
        RecipeError: A recipe cannot be used.
    """
    return _Generation(_with_backend(job), progress, prepare, on_image).run()


def plan_job(job: GenerateJob, *, progress: bool = True) -> JobPlan:
    """Return the job's plan; opens scenes that have no record yet, and writes nothing."""
    job = _with_backend(job)
    store = open_store(job.setup.store_uri)
    with contextlib.closing(Workers(job)) as workers:
        plan, changes = _plan(job, store, workers, progress, keep=False)
    for change in changes:
        change.check(store)
    return plan


class Workers:
    """The workers that a job asks for.

    Attributes:
        scene_of_slot: Name of the scene that each slot has open.
    """

    def __init__(self, job: GenerateJob) -> None:
        self.pool = _make_pool(job)
        self.scene_of_slot = dict[int, str]()
        self.slots = self.pool.slots
        self.close = self.pool.close

    def run(self, work: Work, **options: Any) -> None:
        """Do all of the work; options as of `run_tasks`."""
        run_tasks(self.pool, work, **options)


def _make_pool(job: GenerateJob) -> WorkerPool:
    """Return the pool of workers of the job's executor."""
    if job.executor == "serial":
        return SerialPool(job.setup)
    if job.executor == "ray":
        return RayPool(job.setup, job.workers)
    # Several processes would share one GPU, and each would keep a copy of its scene there.
    default = 1 if renders_on_gpu(job.setup.backend) else available_cores()
    return ProcessPool(job.setup, job.workers or default)


def _with_backend(job: GenerateJob) -> GenerateJob:
    """Return the job with `auto` resolved where this machine's GPU renders.

    Other processes that share the job, or go on with it, can then add no pictures of a CPU. The
    machines of a Ray cluster differ: there `auto` means a CPU.
    """
    setup = job.setup
    is_unresolved = setup.backend == AUTO and setup.renderer is None and job.executor != "ray"
    if not (is_unresolved and renders_on_gpu(AUTO)):
        return job
    return replace(job, setup=replace(setup, backend=CUDA))


def default_scratch(store_uri: str) -> Path | None:
    """Return a folder of this user for blocks on their way to a remote output.

    None for a local output.
    """
    store = open_store(store_uri)
    if store.local_dir is not None:
        return None
    digest = hashlib.sha256(store.uri.encode()).hexdigest()[:16]
    root = Path(tempfile.gettempdir()) / f"climategs-{os.getuid()}"
    with raise_output_error(root):
        root.mkdir(mode=0o700, exist_ok=True)
        if root.stat().st_uid != os.getuid() or root.is_symlink():
            raise OutputError(f"{root} belongs to somebody else; name another folder (--scratch)")
        return root / digest


class _Generation:
    """State of one call of run_generate."""

    def __init__(
        self,
        job: GenerateJob,
        progress: bool,
        prepare: Callable[[list[Recipe]], None],
        on_image: Callable[[int, int], None],
    ) -> None:
        self._job = job
        self._progress = progress
        self._prepare = prepare
        self._on_image = on_image
        self._store = open_store(job.setup.store_uri)
        self._merged_at = time.monotonic()
        self._merge_s = 0.0
        self._timings: dict[str, float] = {}

    def run(self) -> GenerateResult:
        """Plan the job, render what is missing, and merge the manifest."""
        start_s = time.perf_counter()
        with contextlib.closing(Workers(self._job)) as workers:
            plan, changes = _plan(self._job, self._store, workers, self._progress, keep=True)
            self._plan = plan
            self._accept_changes(changes)
            self._timings["plan"] = time.perf_counter() - start_s
            blocks = select_shard(plan.blocks, *self._job.shard)
            pending_blocks = self._find_pending_blocks(blocks)
            self._timings["find_finished"] = time.perf_counter() - start_s - self._timings["plan"]
            work = BlockWork(
                pending_blocks,
                plan.names,
                workers.scene_of_slot,
                self._publish_failure,
                self._show_progress,
                self._damaged_keys,
            )
            num_images = sum(block.images for block in blocks)
            work.tally.skipped = num_images - sum(block.images for block in pending_blocks)
            render_start_s = time.perf_counter()
            self._render(workers, work, pending_blocks, num_images)
            self._timings["render_wall"] = time.perf_counter() - render_start_s
        self._merge(wait=True)
        tally = work.tally
        return GenerateResult(
            tally.written,
            tally.skipped,
            tally.failed,
            dict(plan.unusable),
            tuple(tally.failures),
            time.perf_counter() - start_s,
            {**tally.seconds, **self._timings},
        )

    def _find_pending_blocks(self, blocks: Sequence[Block]) -> list[Block]:
        """Return the blocks that are not published, have lost files, or have failures to try again.

        Refuses an output that holds images of another kind.
        """
        table = self._finished_rows()
        if table is not None and (changes := changes_in(table, blocks)):
            # A record that says otherwise would hide the change from the next run.
            names = self._plan.names
            paths = [_record_path(change.uri, names.get(change.scene)) for change in changes]
            self._store.delete(paths)
            self._accept_changes(changes)
            table = self._finished_rows()
        parts = list_parts(self._store)
        published_blocks = [block for block in blocks if block.key in parts]
        damaged_blocks = [] if table is None else self._find_damaged_blocks(table, published_blocks)
        self._restore_recipes(published_blocks)
        pending_blocks = [b for b in blocks if b.key not in parts or parts[b.key].has_failures]
        pending_blocks += [block for block in damaged_blocks if not parts[block.key].has_failures]
        self._damaged_keys = {block.key for block in damaged_blocks}
        new_blocks = [block for block in pending_blocks if block.key not in parts]
        if new_blocks:
            _check_not_mixed(self._store, self._plan, new_blocks)
        store_plan(self._store, self._plan)
        pending_keys = {block.key for block in pending_blocks}
        published_blocks = [block for block in blocks if block.key not in pending_keys]
        clear_leftovers(self._store, self._job.setup.scratch_dir, published_blocks)
        return pending_blocks

    def _accept_changes(self, changes: Iterable[SceneChange]) -> None:
        """Refuse to mix images of changed scenes with their earlier images.

        Where the earlier images were deleted, the output's records of them are deleted too.
        """
        for change in changes:
            change.check(self._store)
        for change in changes:
            change.accept(self._store, self._job.setup.scratch_dir)

    def _finished_rows(self) -> pa.Table | None:
        """Return the manifest's rows of the images that are finished on this machine.

        The table has the columns of files and of the scenes' content. None where nothing is
        finished, or where the output is remote.
        """
        if self._store.local_dir is None:
            return None
        column_names = (*leading_columns(), *columns_of_effects(), *TRAILING)
        columns = {*KEY, "status", "source_digest", *(f"{kind}_path" for kind in path_kinds())}
        try:
            return read_manifest_rows(
                self._store, [name for name in column_names if name not in columns]
            )
        except OutputError:
            if self._store.exists(MANIFEST_FILE):
                raise
            return None

    def _find_damaged_blocks(
        self, table: pa.Table, published_blocks: Sequence[Block]
    ) -> list[Block]:
        """Return the blocks of which a file is missing."""
        assert self._store.local_dir is not None, "the files of others are not looked at"
        images = rows_without_files(table, FileListing(self._store.local_dir))
        if not images:
            return []
        return [
            block
            for block in published_blocks
            if any(
                (block.scene, block.variant, frame, camera) in images
                for frame in block.frames
                for camera in block.cameras
            )
        ]

    def _restore_recipes(self, published_blocks: Sequence[Block]) -> None:
        """Write the missing recipes into the folders of variants."""
        output_dir = self._store.local_dir
        if output_dir is None:
            return
        for block in {(block.scene, block.variant): block for block in published_blocks}.values():
            folder = output_dir / variant_folder(block.scene, block.variant)
            if lacks_recipe(block.recipe, folder):
                write_recipe(with_digest(block.recipe), folder)

    def _render(
        self, workers: Workers, work: BlockWork, pending_blocks: Sequence[Block], num_images: int
    ) -> None:
        """Log notes about the scenes, then render the pending blocks."""
        if pending_blocks:
            records = self._plan.records
            lidar_blocks = [block for block in pending_blocks if records[block.scene].has_lidar]
            notes = lidar_notes({b.variant: b.recipe for b in lidar_blocks}.values())
            notes += _trust_notes(pending_blocks, records)
            for note in notes[:_MAX_NOTES]:
                _log.warning("note: %s", note)
            if more := notes[_MAX_NOTES:]:
                _log.warning("note: and %d more; `climategs inspect` says them", len(more))
            self._prepare(
                list({block.recipe.name: block.recipe for block in pending_blocks}.values())
            )
        num_skipped = work.tally.skipped
        start_s = time.perf_counter()
        self._bar = ProgressBar(
            total=num_images, initial=num_skipped, unit="image", disable=not self._progress
        )
        with self._bar:
            try:
                workers.run(work, idle=self._merge_at_times)
            except KeyboardInterrupt:
                workers.close()
                self._merge(wait=True)
                raise KeyboardInterrupt(
                    "stopped; start the same job again to go on from there"
                ) from None
        self._timings[WORKERS] = (time.perf_counter() - start_s) * workers.slots

    def _show_progress(self, num_done: int, num_failed: int) -> None:
        """Update the progress bar and call `on_image`."""
        if num_failed:
            self._bar.set_postfix(failed=num_failed, refresh=False)
        self._bar.update(num_done - self._bar.n)
        self._on_image(num_done, num_failed)

    def _publish_failure(self, block: Block, message: str) -> None:
        """Publish a block whose images have all failed, unless another process has finished it."""
        record = self._plan.records[block.scene]
        identity = block.identity(self._plan.backend)
        empty_paths = {f"{kind}_path": None for kind in path_kinds()}
        rows = [
            image_row(
                block.scene,
                block.recipe,
                identity,
                pictured,
                record.times,
                paths=empty_paths,
                status=FAILED,
                message=message,
            )
            for pictured in block.list_images(record)
        ]
        claim = try_claim(self._store, block.claim)
        if claim is not None:  # otherwise another process renders it, and publishes its rows
            with claim:
                publish_part(self._store, block.key, rows_to_table(rows))

    def _merge_at_times(self) -> None:
        """Merge new parts into the manifest, using at most a twentieth of the time."""
        if time.monotonic() - self._merged_at > max(_MERGE_INTERVAL_S, 20 * self._merge_s):
            self._merge(wait=False)

    def _merge(self, *, wait: bool) -> None:
        """Merge the parts into the manifest, unless another process is doing so.

        Args:
            wait: If True, wait for that process for a while.
        """
        start_s = time.monotonic()
        while parts_to_merge(self._store):
            claim = try_claim(self._store, "manifest")
            if claim is not None:
                with claim:
                    compact(self._store)
                break
            if not wait or time.monotonic() - start_s > _MERGE_PATIENCE_S:
                _log.info("%s is being written by another process", MANIFEST_FILE)
                break
            time.sleep(0.2)
        self._merged_at = time.monotonic()
        self._merge_s = self._merged_at - start_s


def _trust_notes(blocks: Sequence[Block], records: Mapping[str, SceneRecord]) -> list[str]:
    """Return notes on cameras that are left out and on scenes that are not fit for weather."""
    notes = []
    for name in dict.fromkeys(block.scene for block in blocks):
        record = records[name]
        scene_blocks = [block for block in blocks if block.scene == name]
        cameras = {camera for block in scene_blocks for camera in block.cameras}
        if omitted_cameras := [camera for camera in record.unfitted if camera not in cameras]:
            notes.append(
                f"{name}: {skipped_cameras_sentence(omitted_cameras, '`cameras: all` in the job')}"
            )
        notes += [f"{name}: {text}" for text in record.problems]
        scale = max(block.recipe.render.scale for block in scene_blocks)
        if sentence := magnification_sentence(record.learnt_scale, scale):
            notes.append(f"{name}: {sentence}")
    return notes


def _plan(
    job: GenerateJob, store: Store, workers: Workers, progress: bool, *, keep: bool
) -> tuple[JobPlan, list[SceneChange]]:
    """Return the job's plan, and the scenes that changed since the output's records were made.

    Args:
        keep: If True, records of other scenes are written.
    """
    known_records, changes = _read_scene_records(job, store, keep=keep)
    changed_paths = {change.record_path for change in changes}
    scene_records: dict[tuple[str, str | None], SceneRecord | str] = (
        {} if job.reopens_scenes else {**known_records}
    )
    tasks = [IndexTask(e.uri, e.name) for e in job.scenes if (e.uri, e.name) not in scene_records]
    with ProgressBar(
        total=len(tasks), unit="scene", desc="opening", disable=not progress or not tasks
    ) as bar:

        def on_result(task: IndexTask, record: SceneRecord | str) -> None:
            scene_records[task.uri, task.name] = record
            path = _record_path(task.uri, task.name)
            if keep and isinstance(record, SceneRecord) and path not in changed_paths:
                store.write(path, record.to_json())
            bar.update()

        scene_work = SceneWork(
            dict.fromkeys(tasks), on_result, "opening the scene", workers.scene_of_slot
        )
        workers.run(scene_work)
    resolved_recipes = resolve_recipes(
        job, store, workers, scene_records, progress=progress, keep=keep
    )
    return make_job_plan(
        job.recipes, job.scenes, scene_records, job.setup.backend, resolved_recipes
    ), changes


def _read_scene_records(
    job: GenerateJob, store: Store, *, keep: bool
) -> tuple[dict[tuple[str, str | None], SceneRecord], list[SceneChange]]:
    """Return the output's records of the job's scenes by URI and name, and the changed scenes."""

    def look_up(entry: JobScene) -> tuple[SceneRecord | None, str | None]:
        record = _read_scene_record(store, entry)
        digest_of = job.setup.scene_digest
        return record, None if record is None or digest_of is None else digest_of(entry.uri)

    records: dict[tuple[str, str | None], SceneRecord] = {}
    changes: list[SceneChange] = []
    with ThreadPoolExecutor(_NUM_READS, thread_name_prefix="scenes") as pool:
        pairs = list(pool.map(look_up, job.scenes))
    for entry, (record, digest) in zip(job.scenes, pairs, strict=True):
        path = _record_path(entry.uri, entry.name)
        if record is None:
            continue
        if digest is not None and record.digest is None:
            _log.warning(
                "note: %s holds the scene %s of an older version, which did not note its content; "
                "it is taken to be the scene as it is now",
                store.uri,
                record.name,
            )
            record = replace(record, digest=digest)
            if keep:
                store.write(path, record.to_json())
        if digest in (None, record.digest):
            records[entry.uri, entry.name] = record
        else:
            digests = str(record.digest), str(digest)
            changes.append(SceneChange(record.name, entry.uri, *digests, record_path=path))
    return records, changes


def _read_scene_record(store: Store, entry: JobScene) -> SceneRecord | None:
    """Return the output's record of a scene; None where it has no readable one."""
    path = _record_path(entry.uri, entry.name)
    try:
        return SceneRecord.from_json(store.read(path), f"{store.uri}/{path}")
    except StoredFileMissing:
        return None
    except OutputError as error:
        _log.warning("%s", error)
        return None


def _record_path(uri: str, name: str | None) -> str:
    """Return the path of a scene's record in the output."""
    digest = hashlib.sha256(f"{augment.__version__}\n{uri}\n{name or ''}".encode()).hexdigest()
    return f"{SCENES}/{digest[:20]}.json"


def _check_not_mixed(store: Store, plan: JobPlan, blocks: Sequence[Block]) -> None:
    """Refuse to put images beside images of the same name that were made otherwise."""
    try:
        table = read_manifest_rows(store)
    except OutputError:
        if store.exists(MANIFEST_FILE):
            raise
        return
    block_of_variant = {(block.scene, block.variant): block for block in blocks}
    for scene, variant, identity in _identities(table):
        block = block_of_variant.get((scene, variant))
        if block is not None:
            adopts_backend = plan.backend == AUTO and identity.backend != CUDA
            backend = identity.backend if adopts_backend else plan.backend
            block.identity(backend).check(identity, f"{store.uri}/{scene}/{variant}")


def _identities(table: pa.Table) -> list[tuple[str, str, Identity]]:
    """Return the distinct kinds of finished images."""
    names = ["scene", "variant", *Identity.__dataclass_fields__]
    kinds = table.filter(pa.array([status == OK for status in table["status"].to_pylist()]))
    rows = kinds.select(names).group_by(names, use_threads=False).aggregate([]).to_pylist()
    return [(row["scene"], row["variant"], Identity.of_row(row)) for row in rows]
