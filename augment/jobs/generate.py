"""A dataset job: many scenes under many recipes into one output, by any number of workers.

What is finished shows in the output alone, so a job that was killed, wherever and however, goes on
when it is started again, and any number of processes on any number of machines can be at the same
job: blocks of images are claimed, rendered, and published one by one. The files do not depend on
who rendered what, nor on how often that was interrupted.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

import augment
from augment.errors import OutputError
from augment.jobs.atomic import refusals_of
from augment.jobs.block_worker import (
    BlockDone,
    BlockTask,
    IndexTask,
    ResolvedRecipes,
    ResolveTask,
    WorkSetup,
    clear_leftovers,
)
from augment.jobs.blocks import Block, Plan, SceneRecord, make_plan, shard_of, store_plan
from augment.jobs.claims import try_claim
from augment.jobs.files import RECORDED
from augment.jobs.layout import (
    MANIFEST,
    STATE_FOLDER,
    FileListing,
    path_kinds,
    variant_folder,
    variant_name,
)
from augment.jobs.manifest import (
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
    read_finished,
    rows_to_table,
    rows_without_files,
)
from augment.jobs.pools import ProcessPool, RayPool, SerialPool, Work, WorkerPool, run_tasks
from augment.jobs.processes import available_cores, renders_on_gpu
from augment.jobs.quality import Question, recorded
from augment.jobs.render_job import RenderJob, SceneLoader, lacks_recipe, run_job, write_recipe
from augment.jobs.scene_changes import SceneChange, changes_in
from augment.jobs.store import Store, StoredFileMissing, open_store
from augment.jobs.worker import WORKERS, Outcome, TaskFailed
from augment.progress import ProgressBar
from augment.render.buffers import AUTO, CUDA
from augment.scene import Scene
from augment.trust import left_out_sentence, magnified_sentence
from recipes.files import with_digest
from recipes.job import JobRecipes, JobScene
from recipes.schema import Recipe, columns_of_effects

# ---- Which block a worker gets next: one of the scene it has open, as long as there are any ------


class BlockQueue:
    """Blocks by scene, in order. A worker stays with a scene; a new scene goes to one worker. Where
    no scene is left that nobody works on, a worker joins the one with most images left.
    """

    def __init__(self, blocks: Iterable[Block]) -> None:
        self._scenes: dict[str, deque[Block]] = {}
        self._images: dict[str, int] = {}
        for block in blocks:
            self._scenes.setdefault(block.scene, deque()).append(block)
            self._images[block.scene] = self._images.get(block.scene, 0) + block.images

    def __len__(self) -> int:
        return sum(map(len, self._scenes.values()))

    def take(self, scene: str | None, elsewhere: Iterable[str]) -> Block | None:
        """The next block for a worker that has `scene` open, while others have `elsewhere`."""
        if not self._scenes:
            return None
        if scene not in self._scenes:
            busy = set(elsewhere)
            free = [name for name in self._scenes if name not in busy]
            scene = free[0] if free else max(self._scenes, key=lambda name: self._images[name])
        block = self._scenes[scene].popleft()
        self._images[scene] -= block.images
        if not self._scenes[scene]:
            del self._scenes[scene]
        return block

    def take_all(self, scene: str) -> list[Block]:
        """All blocks of a scene that cannot be opened."""
        self._images.pop(scene, None)
        return list(self._scenes.pop(scene, ()))

    def put_back(self, block: Block) -> None:
        """To be tried again, after the others of its scene."""
        self._scenes.setdefault(block.scene, deque()).append(block)
        self._images[block.scene] = self._images.get(block.scene, 0) + block.images


# ---- Blocks and what comes before them, as work for a pool ---------------------------------------

MAX_LOST = 3  # blocks of a scene whose workers die even alone, before the scene is given up
ELSEWHERE_S = 2.0  # how long to leave a block alone that another process is at
_log = logging.getLogger(__name__)

FailBlock = Callable[[Block, str], None]


@dataclass
class Tally:
    """Images of the blocks done so far. skipped: finished before. failures: a line each."""

    written: int = 0
    skipped: int = 0
    failed: int = 0
    failures: list[str] = field(default_factory=list)
    seconds: Counter[str] = field(default_factory=Counter)

    def add(self, done: BlockDone) -> None:
        self.written += done.written
        self.skipped += done.skipped
        self.failed += done.failed
        self.failures += done.failures
        self.seconds.update(done.seconds or {})


class SceneWork(Work):
    """Tasks that open scenes, before there are blocks; `each` gets a task's result, or a text that
    says why there is none. doing: what they do. opened: the scene that each slot has open.
    """

    def __init__(
        self,
        tasks: Iterable[Any],
        each: Callable[[Any, Any], None],
        doing: str,
        opened: dict[int, str],
    ) -> None:
        self._tasks, self._each, self._doing = deque(tasks), each, doing
        self._opened = opened

    def take(self, slot: int) -> Any:
        return self._tasks.popleft() if self._tasks else None

    def done(self, slot: int, task: Any, result: Any) -> None:
        if isinstance(result, SceneRecord):
            self._opened[slot] = result.name
        self._each(task, result.text if isinstance(result, TaskFailed) else result)

    def lost(self, slot: int, task: Any, how: str) -> None:
        self._each(task, f"the worker {how} while {self._doing}, alone too")


class BlockWork(Work):
    """Renders and publishes blocks. names: by scene, what the job calls it. opened: the scene that
    each slot has open. fail: records all images of a block as failed. on_image: told how many
    images are done, and how many of them failed. damaged: keys of published blocks that have lost
    files. A block whose worker dies is tried once more, each
    of its images in a process of its own.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        names: Mapping[str, str | None],
        opened: dict[int, str],
        fail: FailBlock,
        on_image: Callable[[int, int], None] = lambda done, failed: None,
        damaged: Collection[str] = (),
    ) -> None:
        self.tally = Tally()
        self._damaged = frozenset(damaged)
        self._queue, self._names = BlockQueue(blocks), names
        self._fail, self._on_image = fail, on_image
        self._partial: dict[int, list[int]] = defaultdict(lambda: [0, 0])  # by slot: done, failed
        self._opened = opened
        self._busy: set[int] = set()
        self._lost_alone: Counter[str] = Counter()  # blocks of a scene that nobody survived
        self._later: list[tuple[float, Block]] = []  # another process is at them

    def tick(self, slot: int, outcome: Outcome) -> None:
        partial = self._partial[slot]
        partial[0] += 1
        partial[1] += outcome.status == FAILED
        self._report()

    def take(self, slot: int) -> BlockTask | None:
        now = time.monotonic()
        for when, block in list(self._later):
            if when <= now:
                self._later.remove((when, block))
                self._queue.put_back(block)
        block = self._queue.take(self._opened.get(slot), {self._opened[s] for s in self._busy})
        if block is None:
            return None
        self._opened[slot] = block.scene
        self._busy.add(slot)
        is_damaged = block.key in self._damaged
        return BlockTask(block, self._names.get(block.scene), is_damaged=is_damaged)

    def later_s(self) -> float | None:
        return max(0.0, self._later[0][0] - time.monotonic()) if self._later else None

    def retry(self, slot: int, task: BlockTask, why: str) -> list[BlockTask]:
        _log.warning("%s is tried once more, alone: %s", task.block.key, why)
        self._free(slot)
        return [replace(task, is_trial=True)]

    def done(self, slot: int, task: BlockTask, result: BlockDone | TaskFailed) -> None:
        self._free(slot)
        if isinstance(result, TaskFailed):
            others = self._queue.take_all(task.block.scene) if result.of_scene else []
            self._give_up([task.block, *others], result.text)
        elif result.is_elsewhere:
            self._later.append((time.monotonic() + ELSEWHERE_S, task.block))
        else:
            self.tally.add(result)
        self._report()

    def lost(self, slot: int, task: BlockTask, how: str) -> None:
        self._free(slot)
        scene = task.block.scene
        self._opened.pop(slot, None)
        self._lost_alone[scene] += 1
        others = self._queue.take_all(scene) if self._lost_alone[scene] == MAX_LOST else []
        self._give_up(
            [task.block, *others],
            f"the worker {how} while at this block of images, and again when it was tried alone; "
            f"if memory ran out, use fewer workers or a machine with more",
        )
        self._report()

    def _free(self, slot: int) -> None:
        self._busy.discard(slot)
        self._partial.pop(slot, None)

    def _report(self) -> None:
        tally, partial = self.tally, list(self._partial.values())
        done = tally.written + tally.skipped + tally.failed + sum(p[0] for p in partial)
        self._on_image(done, tally.failed + sum(p[1] for p in partial))

    def _give_up(self, blocks: Sequence[Block], message: str) -> None:
        for block in blocks:
            self._fail(block, message)
            self.tally.failed += block.images
            name = f"{block.scene}/{block.variant}, {block.images} images"
            self.tally.failures.append(f"{name}: {message}")


# ---- What the qualities of a job's recipes choose in its scenes, before there is a plan ----------
# A choice is kept in the output: the scenes in which everything was chosen are not opened again.

_READS = 16  # at a time: most of the time of one is waiting

Found = Mapping[tuple[str, str | None], SceneRecord | str]
Choices = dict[tuple[str, str], Recipe | str]


def resolve_recipes(
    job: GenerateJob, store: Store, workers: Workers, found: Found, *, progress: bool, keep: bool
) -> Choices:
    """By scene and variant: the recipes that had to choose, resolved, or why they could not. found:
    the scene of every URI and name. keep: whether new choices are kept in the output.
    """
    asked = [
        (Question(recipe, record.name, record.source, RECORDED, job.setup.backend), entry)
        for entry in job.scenes
        if isinstance(record := found[entry.uri, entry.name], SceneRecord)
        for recipe in job.recipes.of_scene(entry, record.name)
        if recipe.quality.is_open
    ]
    with ThreadPoolExecutor(_READS, thread_name_prefix="choices") as pool:
        answers = list(pool.map(lambda pair: recorded(store, pair[0]), asked))
    choices: Choices = {}
    left: defaultdict[tuple[str, str | None, str], list[Recipe]] = defaultdict(list)
    for (question, entry), answer in zip(asked, answers, strict=True):
        if answer is None:
            left[entry.uri, entry.name, question.scene].append(question.recipe)
        else:
            choices[question.scene, variant_name(question.recipe)] = answer
    tasks = {
        ResolveTask(uri, name, tuple(dict.fromkeys(recipes)), keep): scene
        for (uri, name, scene), recipes in left.items()
    }
    bar = ProgressBar(
        total=len(tasks), unit="scene", desc="choosing settings", disable=not progress or not tasks
    )

    def each(task: ResolveTask, resolved: ResolvedRecipes | str) -> None:
        for number, recipe in enumerate(task.recipes):
            outcome = resolved if isinstance(resolved, str) else resolved.recipes[number]
            choices[tasks[task], variant_name(recipe)] = outcome
        bar.update()

    with bar:
        timed = any(r.quality.budget_ms is not None for task in tasks for r in task.recipes)
        # Each shard begins elsewhere, so that those that start together do not wait for each other.
        number, count = job.shard
        start = (number - 1) * len(tasks) // count
        turned = [*tasks][start:] + [*tasks][:start]
        doing = "choosing the settings of its recipes"
        # Timed ones one by one, so that none disturbs another's frame times.
        workers.do(SceneWork(turned, each, doing, workers.opened), slots=1 if timed else None)
    return choices


# ---- How long a job will take and how large its output gets, from a few pictures -----------------

MAX_SAMPLED = 8  # recipes whose pictures are made; the others take their mean


class Sample(NamedTuple):
    """What a recipe's images cost. per megapixel: seconds of rendering and writing, and bytes."""

    seconds_per_mpx: float
    bytes_per_mpx: float
    prepare_s: float


@dataclass(frozen=True)
class Estimate:
    """samples: by recipe. seconds: of one worker alone, its scenes' opening included. bytes: of
    all files. unsampled: recipes that were not tried.
    """

    samples: dict[str, Sample]
    seconds: float
    bytes: float
    unsampled: tuple[str, ...]


def estimate(
    plan: Plan, open_scene: SceneLoader, *, each: Callable[[str], None] = lambda name: None
) -> Estimate:
    """Render a frame under each recipe, and scale what it takes by the pixels of the job; right to
    within a factor of two or so. The pictures are the middle frame of the recipe's first scene in
    one camera, twice: what the first takes beyond the second (snow placement, style maps,
    compiling) counts once a scene. each: called before every recipe.
    """
    firsts: dict[str, Block] = {}
    for block in plan.blocks:
        firsts.setdefault(block.recipe.name, block)
    tried = dict(list(firsts.items())[:MAX_SAMPLED])
    samples: dict[str, Sample] = {}
    opened: dict[str, Scene] = {}  # never more than one
    for name, block in tried.items():
        each(name)
        if block.uri not in opened:
            opened.clear()
            opened[block.uri] = open_scene(block.uri)
        samples[name] = _sample(block, opened.__getitem__, plan)
    mean = Sample(*(sum(each) / len(samples) for each in zip(*samples.values(), strict=True)))
    pixels, scenes = _megapixels(plan)
    costs = {name: samples.get(name, mean) for name in firsts}
    opening = sum(record.open_s for record in plan.records.values())
    seconds = sum(pixels[n] * c.seconds_per_mpx + scenes[n] * c.prepare_s for n, c in costs.items())
    size = sum(pixels[name] * cost.bytes_per_mpx for name, cost in costs.items())
    return Estimate(samples, opening + seconds, size, tuple(sorted(firsts.keys() - tried.keys())))


def _megapixels(plan: Plan) -> tuple[dict[str, float], dict[str, int]]:
    """By recipe: pixels of all its images, in millions, and how many scenes have it."""
    pixels: defaultdict[str, float] = defaultdict(float)
    scenes: defaultdict[str, set[str]] = defaultdict(set)
    for block in plan.blocks:
        pictured = block.pictured(plan.records[block.scene])
        pixels[block.recipe.name] += sum(p.width * p.height for p in pictured) / 1e6
        scenes[block.recipe.name].add(block.scene)
    return dict(pixels), {name: len(held) for name, held in scenes.items()}


def _sample(block: Block, loader: SceneLoader, plan: Plan) -> Sample:
    record, camera = plan.records[block.scene], block.cameras[0]
    having = [f.number for f in record.frames if camera in f.cameras]
    pictured = next(p for p in block.pictured(record) if p.camera == camera)
    mpx = pictured.width * pictured.height / 1e6
    took, size = [], 0
    with tempfile.TemporaryDirectory(prefix="climategs-estimate-") as folder:
        for out in (Path(folder) / "0", Path(folder) / "1"):
            job = RenderJob(
                block.uri,
                [block.recipe],
                out,
                frames=[having[len(having) // 2]],
                cameras=[camera],
                backend=plan.backend,
                shared_dir=Path(folder) / "beds",
            )
            started = time.perf_counter()
            run_job(job, scene_loader=loader, progress=False)
            took.append(time.perf_counter() - started)
            files = [p for p in out.rglob("*") if p.is_file()]
            size = sum(p.stat().st_size for p in files if STATE_FOLDER not in p.parts)
    return Sample(took[1] / mpx, size / mpx, max(0.0, took[0] - took[1]))


# ---- The job -------------------------------------------------------------------------------------

SCENES = f"{STATE_FOLDER}/scenes"
EXECUTORS = ("serial", "processes", "ray")
_COMPACT_S = 60.0
_CLAIM_S = 30.0
_MAX_NOTES = 20


@dataclass(frozen=True)
class GenerateJob:
    """recipes: of the job, loaded. scenes: the job's, without patterns. executor: `serial` renders
    in this process, `processes` in several of this machine, `ray` in actors on a cluster. workers:
    how many; None for one a core, where a GPU renders one process, or an actor for each GPU of the
    cluster. shard: which part of the job is done here, from 1, and how many there are. rescan: open
    all scenes anew, in case they have changed.
    """

    recipes: JobRecipes
    scenes: Sequence[JobScene]
    setup: WorkSetup
    executor: str = "processes"
    workers: int | None = None
    shard: tuple[int, int] = (1, 1)
    rescan: bool = False

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
    """Images of this shard. skipped: finished before, here or elsewhere. unusable: scenes by URI.
    timings: seconds by kind of work, summed over threads and workers (see `worker.shares_of`); and
    by the clock: `plan`, `scan` of what is finished, and `render_wall`, all else.
    """

    written: int
    skipped: int
    failed: int
    unusable: dict[str, str]
    failures: tuple[str, ...]
    seconds: float
    timings: dict[str, float] = field(default_factory=dict)


def run_generate(
    job: GenerateJob,
    *,
    progress: bool = True,
    prepare: Callable[[list[Recipe]], None] = lambda recipes: None,
    on_image: Callable[[int, int], None] = lambda done, failed: None,
) -> GenerateResult:
    """Render and publish what of the job is not finished yet. progress: bars on stderr. prepare:
    called before the first image is rendered, with one recipe of each name, to compile kernels once
    and not in every worker, say. on_image: told how many images are done and how many of them
    failed, from several threads. A KeyboardInterrupt lets workers finish the images at hand, merges
    what is published into the manifest, and is raised again. Raises OutputError: the output cannot
    be written, or holds images of another kind under the same names, and none was written.
    ClimateGSError: no scene can be used. RecipeError: a recipe cannot be used.
    """
    return _Generation(_with_backend(job), progress, prepare, on_image).go()


def plan_job(job: GenerateJob, *, progress: bool = True) -> Plan:
    """The job's plan, for which its scenes are opened that have not been; writes nothing."""
    job = _with_backend(job)
    store = open_store(job.setup.store_uri)
    with contextlib.closing(Workers(job)) as workers:
        plan, changes = _plan(job, store, workers, progress, keep=False)
    for change in changes:
        change.check(store)
    return plan


class Workers:
    """The workers that a job asks for. opened: the scene that each has open, by slot."""

    def __init__(self, job: GenerateJob) -> None:
        self.pool, self.opened = _make_pool(job), dict[int, str]()
        self.slots, self.close = self.pool.slots, self.pool.close

    def do(self, work: Work, **options: Any) -> None:
        run_tasks(self.pool, work, **options)


def _make_pool(job: GenerateJob) -> WorkerPool:
    if job.executor == "serial":
        return SerialPool(job.setup)
    if job.executor == "ray":
        return RayPool(job.setup, job.workers)
    # Several processes would share one GPU, and each have a copy of its scene there.
    default = 1 if renders_on_gpu(job.setup.backend) else available_cores()
    return ProcessPool(job.setup, job.workers or default)


def _with_backend(job: GenerateJob) -> GenerateJob:
    """`auto` gets its name where this machine's GPU renders, so that others which share the work or
    go on with it cannot add pictures of a CPU. Ray's machines differ: there `auto` is a CPU.
    """
    setup = job.setup
    is_open = setup.backend == AUTO and setup.renderer is None and job.executor != "ray"
    if not (is_open and renders_on_gpu(AUTO)):
        return job
    return replace(job, setup=replace(setup, backend=CUDA))


def default_scratch(store_uri: str) -> Path | None:
    """A folder of this user's for blocks on their way to that output; None for a local one."""
    store = open_store(store_uri)
    if store.local_dir is not None:
        return None
    digest = hashlib.sha256(store.uri.encode()).hexdigest()[:16]
    root = Path(tempfile.gettempdir()) / f"climategs-{os.getuid()}"
    with refusals_of(root):
        root.mkdir(mode=0o700, exist_ok=True)
        if root.stat().st_uid != os.getuid() or root.is_symlink():
            raise OutputError(f"{root} belongs to somebody else; name another folder (--scratch)")
        return root / digest


class _Generation:
    """One call of run_generate."""

    def __init__(
        self,
        job: GenerateJob,
        progress: bool,
        prepare: Callable[[list[Recipe]], None],
        on_image: Callable[[int, int], None],
    ) -> None:
        self._job, self._progress = job, progress
        self._prepare, self._on_image = prepare, on_image
        self._store = open_store(job.setup.store_uri)
        self._merged_at, self._merge_s = time.monotonic(), 0.0
        self._timings: dict[str, float] = {}

    def go(self) -> GenerateResult:
        started = time.perf_counter()
        with contextlib.closing(Workers(self._job)) as workers:
            plan, changes = _plan(self._job, self._store, workers, self._progress, keep=True)
            self._plan = plan
            self._accept(changes)
            self._timings["plan"] = time.perf_counter() - started
            blocks = shard_of(plan.blocks, *self._job.shard)
            pending = self._pending(blocks)
            self._timings["scan"] = time.perf_counter() - started - self._timings["plan"]
            work = BlockWork(
                pending, plan.names, workers.opened, self._fail, self._show, self._damaged_keys
            )
            total = sum(block.images for block in blocks)
            work.tally.skipped = total - sum(block.images for block in pending)
            begun = time.perf_counter()
            self._render(workers, work, pending, total)
            self._timings["render_wall"] = time.perf_counter() - begun
        self._merge(wait=True)
        tally = work.tally
        return GenerateResult(
            tally.written,
            tally.skipped,
            tally.failed,
            dict(plan.unusable),
            tuple(tally.failures),
            time.perf_counter() - started,
            {**tally.seconds, **self._timings},
        )

    def _pending(self, blocks: Sequence[Block]) -> list[Block]:
        """What is not published, or with failures that are tried again; refuses a mixed output."""
        table = self._finished_rows()
        if table is not None and (changes := changes_in(table, blocks)):
            # A record that says otherwise would hide the change from the next run.
            names = self._plan.names
            paths = [_record_path(change.uri, names.get(change.scene)) for change in changes]
            self._store.delete(paths)
            self._accept(changes)
            table = self._finished_rows()
        parts = list_parts(self._store)
        published = [block for block in blocks if block.key in parts]
        damaged = [] if table is None else self._damaged(table, published)
        self._restore_recipes(published)
        pending = [b for b in blocks if b.key not in parts or parts[b.key].has_failures]
        pending += [block for block in damaged if not parts[block.key].has_failures]
        self._damaged_keys = {block.key for block in damaged}
        new = [block for block in pending if block.key not in parts]
        if new:
            _check_not_mixed(self._store, self._plan, new)
        store_plan(self._store, self._plan)
        left = {block.key for block in pending}
        published = [block for block in blocks if block.key not in left]
        clear_leftovers(self._store, self._job.setup.scratch, published)
        return pending

    def _accept(self, changes: Iterable[SceneChange]) -> None:
        """Refuse to mix images of changed scenes with those of before; what is left of deleted ones
        is forgotten.
        """
        for change in changes:
            change.check(self._store)
        for change in changes:
            change.accept(self._store, self._job.setup.scratch)

    def _finished_rows(self) -> pa.Table | None:
        """What an output on this machine has of finished images: their files, and what they were
        made from; None where nothing is finished, or the output is elsewhere.
        """
        if self._store.local_dir is None:
            return None
        known = (*leading_columns(), *columns_of_effects(), *TRAILING)
        columns = {*KEY, "status", "source_digest", *(f"{kind}_path" for kind in path_kinds())}
        try:
            return read_finished(self._store, [name for name in known if name not in columns])
        except OutputError:
            if self._store.exists(MANIFEST):
                raise
            return None

    def _damaged(self, table: pa.Table, published: Sequence[Block]) -> list[Block]:
        """The blocks of which a file is gone."""
        assert self._store.local_dir is not None, "the files of others are not looked at"
        images = rows_without_files(table, FileListing(self._store.local_dir))
        if not images:
            return []
        return [
            block
            for block in published
            if any(
                (block.scene, block.variant, frame, camera) in images
                for frame in block.frames
                for camera in block.cameras
            )
        ]

    def _restore_recipes(self, published: Sequence[Block]) -> None:
        """Write what is missing of the recipes in the folders of variants."""
        out = self._store.local_dir
        if out is None:
            return
        for block in {(block.scene, block.variant): block for block in published}.values():
            folder = out / variant_folder(block.scene, block.variant)
            if lacks_recipe(block.recipe, folder):
                write_recipe(with_digest(block.recipe), folder)

    def _render(
        self, workers: Workers, work: BlockWork, pending: Sequence[Block], total: int
    ) -> None:
        if pending:
            records = self._plan.records
            with_lidar = [block for block in pending if records[block.scene].has_lidar]
            notes = lidar_notes({b.variant: b.recipe for b in with_lidar}.values())
            notes += _trust_notes(pending, records)
            for note in notes[:_MAX_NOTES]:
                _log.warning("note: %s", note)
            if more := notes[_MAX_NOTES:]:
                _log.warning("note: and %d more; `climategs inspect` says them", len(more))
            self._prepare(list({block.recipe.name: block.recipe for block in pending}.values()))
        skipped, started = work.tally.skipped, time.perf_counter()
        self._bar = ProgressBar(
            total=total, initial=skipped, unit="image", disable=not self._progress
        )
        with self._bar:
            try:
                workers.do(work, idle=self._merge_at_times)
            except KeyboardInterrupt:
                workers.close()
                self._merge(wait=True)
                raise KeyboardInterrupt(
                    "stopped; start the same job again to go on from there"
                ) from None
        self._timings[WORKERS] = (time.perf_counter() - started) * workers.slots

    def _show(self, done: int, failed: int) -> None:
        if failed:
            self._bar.set_postfix(failed=failed, refresh=False)
        self._bar.update(done - self._bar.n)
        self._on_image(done, failed)

    def _fail(self, block: Block, message: str) -> None:
        """Publish a block whose images have all failed, unless others have finished it."""
        record = self._plan.records[block.scene]
        identity = block.identity(self._plan.backend)
        nowhere = {f"{kind}_path": None for kind in path_kinds()}
        rows = [
            image_row(
                block.scene,
                block.recipe,
                identity,
                pictured,
                paths=nowhere,
                status=FAILED,
                message=message,
            )
            for pictured in block.pictured(record)
        ]
        claim = try_claim(self._store, block.claim)
        if claim is not None:  # else another process is at it, and will say
            with claim:
                publish_part(self._store, block.key, rows_to_table(rows))

    def _merge_at_times(self) -> None:
        """Keep the manifest fresh, for at most a twentieth of the time."""
        if time.monotonic() - self._merged_at > max(_COMPACT_S, 20 * self._merge_s):
            self._merge(wait=False)

    def _merge(self, *, wait: bool) -> None:
        """Merge the parts into the manifest; left to others where they are just doing so."""
        started = time.monotonic()
        while parts_to_merge(self._store):
            claim = try_claim(self._store, "manifest")
            if claim is not None:
                with claim:
                    compact(self._store)
                break
            if not wait or time.monotonic() - started > _CLAIM_S:
                _log.info("%s is being written by another process", MANIFEST)
                break
            time.sleep(0.2)
        self._merged_at = time.monotonic()
        self._merge_s = self._merged_at - started


def _trust_notes(blocks: Sequence[Block], records: Mapping[str, SceneRecord]) -> list[str]:
    """What of the scenes to be rendered is left out, or not fit for weather."""
    notes = []
    for name in dict.fromkeys(block.scene for block in blocks):
        record, own = records[name], [block for block in blocks if block.scene == name]
        cameras = {camera for block in own for camera in block.cameras}
        if left_out := [camera for camera in record.unfitted if camera not in cameras]:
            notes.append(f"{name}: {left_out_sentence(left_out, '`cameras: all` in the job')}")
        notes += [f"{name}: {text}" for text in record.problems]
        scale = max(block.recipe.render.scale for block in own)
        if sentence := magnified_sentence(record.learnt_scale, scale):
            notes.append(f"{name}: {sentence}")
    return notes


def _plan(
    job: GenerateJob, store: Store, workers: Workers, progress: bool, *, keep: bool
) -> tuple[Plan, list[SceneChange]]:
    """The plan, and the scenes that have changed since the output's record of them was made. keep:
    whether records of other scenes are written.
    """
    known, changes = _known_scenes(job, store, keep=keep)
    changed = {change.record_path for change in changes}
    found: dict[tuple[str, str | None], SceneRecord | str] = {} if job.rescan else {**known}
    tasks = [IndexTask(e.uri, e.name) for e in job.scenes if (e.uri, e.name) not in found]
    with ProgressBar(
        total=len(tasks), unit="scene", desc="opening", disable=not progress or not tasks
    ) as bar:

        def each(task: IndexTask, record: SceneRecord | str) -> None:
            found[task.uri, task.name] = record
            path = _record_path(task.uri, task.name)
            if keep and isinstance(record, SceneRecord) and path not in changed:
                store.write(path, record.to_json())
            bar.update()

        opening = SceneWork(dict.fromkeys(tasks), each, "opening the scene", workers.opened)
        workers.do(opening)
    resolved = resolve_recipes(job, store, workers, found, progress=progress, keep=keep)
    return make_plan(job.recipes, job.scenes, found, job.setup.backend, resolved), changes


def _known_scenes(
    job: GenerateJob, store: Store, *, keep: bool
) -> tuple[dict[tuple[str, str | None], SceneRecord], list[SceneChange]]:
    """The records of the job's scenes by URI and name, and those of scenes that have changed."""

    def look_up(entry: JobScene) -> tuple[SceneRecord | None, str | None]:
        record, digest_of = _known(store, entry), job.setup.digest_of
        return record, None if record is None or digest_of is None else digest_of(entry.uri)

    known: dict[tuple[str, str | None], SceneRecord] = {}
    changes: list[SceneChange] = []
    with ThreadPoolExecutor(_READS, thread_name_prefix="scenes") as pool:
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
            known[entry.uri, entry.name] = record
        else:
            digests = str(record.digest), str(digest)
            changes.append(SceneChange(record.name, entry.uri, *digests, record_path=path))
    return known, changes


def _known(store: Store, entry: JobScene) -> SceneRecord | None:
    path = _record_path(entry.uri, entry.name)
    try:
        return SceneRecord.from_json(store.read(path), f"{store.uri}/{path}")
    except StoredFileMissing:
        return None
    except OutputError as error:
        _log.warning("%s", error)
        return None


def _record_path(uri: str, name: str | None) -> str:
    digest = hashlib.sha256(f"{augment.__version__}\n{uri}\n{name or ''}".encode()).hexdigest()
    return f"{SCENES}/{digest[:20]}.json"


def _check_not_mixed(store: Store, plan: Plan, blocks: Sequence[Block]) -> None:
    """Refuse to put images beside others of the same name that were made otherwise."""
    try:
        table = read_finished(store)
    except OutputError:
        if store.exists(MANIFEST):
            raise
        return
    planned = {(block.scene, block.variant): block for block in blocks}
    for scene, variant, identity in _identities(table):
        block = planned.get((scene, variant))
        if block is not None:
            is_chosen = plan.backend == AUTO and identity.backend != CUDA
            backend = identity.backend if is_chosen else plan.backend
            block.identity(backend).check(identity, f"{store.uri}/{scene}/{variant}")


def _identities(table: pa.Table) -> list[tuple[str, str, Identity]]:
    """The kinds of finished images there are, each once."""
    names = ["scene", "variant", *Identity.__dataclass_fields__]
    kinds = table.filter(pa.array([status == OK for status in table["status"].to_pylist()]))
    rows = kinds.select(names).group_by(names, use_threads=False).aggregate([]).to_pylist()
    return [(row["scene"], row["variant"], Identity.of_row(row)) for row in rows]
