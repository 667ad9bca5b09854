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
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import pyarrow as pa
from tqdm import tqdm

import augment
from augment.errors import OutputError
from augment.jobs.atomic import refusals_of
from augment.jobs.block_pools import Event, Lost, ProcessPool, RayPool, SerialPool, Tick, WorkerPool
from augment.jobs.block_worker import (
    BlockDone,
    BlockTask,
    IndexTask,
    ResolvedRecipes,
    ResolveTask,
    TaskFailed,
    WorkSetup,
    clear_leftovers,
)
from augment.jobs.blocks import Block, Plan, SceneRecord, make_plan, shard_of, store_plan
from augment.jobs.claims import try_claim
from augment.jobs.files import RECORDED
from augment.jobs.layout import MANIFEST, STATE_FOLDER, path_kinds, variant_name
from augment.jobs.manifest import (
    FAILED,
    OK,
    Identity,
    compact,
    image_row,
    lidar_notes,
    list_parts,
    parts_to_merge,
    publish_part,
    read_finished,
    rows_to_table,
)
from augment.jobs.processes import available_cores, renders_on_gpu
from augment.jobs.quality import Question, recorded
from augment.jobs.render_job import RenderJob, SceneLoader, run_job
from augment.jobs.store import Store, StoredFileMissing, open_store
from augment.jobs.worker import WORKERS, Outcome
from augment.render.buffers import AUTO, CUDA
from augment.scene import Scene
from recipes.job import JobRecipes, JobScene
from recipes.schema import Recipe

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


# ---- The scheduler -------------------------------------------------------------------------------

WAIT_S = 1.0
MAX_LOST = 3  # blocks of a scene whose workers die even alone, before the scene is given up
ELSEWHERE_S = 2.0  # how long to leave a block alone that another process is at
_RESOLVING = "choosing the settings of its recipes"
_log = logging.getLogger(__name__)

MakePool = Callable[[Callable[[int, Outcome], None]], WorkerPool]
_First = TypeVar("_First", IndexTask, ResolveTask)
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


class Scheduler:
    """Runs tasks in a pool. on_image: told how many images are done, and how many of them failed.
    idle: called now and then between events.
    """

    def __init__(
        self,
        make_pool: MakePool,
        *,
        on_image: Callable[[int, int], None] = lambda done, failed: None,
        idle: Callable[[], None] = lambda: None,
    ) -> None:
        self.tally = Tally()
        self._partial: dict[int, list[int]] = defaultdict(lambda: [0, 0])  # by slot: done, failed
        self._on_image, self._idle = on_image, idle
        self._pool = make_pool(self._tick)
        self.slots, self.close = self._pool.slots, self._pool.close
        self._open: list[str | None] = [None] * self.slots  # the scene of every slot
        self._busy: dict[int, BlockTask] = {}  # by slot
        self._trials: list[Block] = []  # whose worker died: tried once more, alone
        self._lost_alone: Counter[str] = Counter()  # blocks of a scene that nobody survived
        self._later: list[tuple[float, Block]] = []  # another process is at them

    def do_first(
        self,
        tasks: Sequence[_First],
        each: Callable[[_First, Any], None],
        *,
        one_by_one: bool = False,
    ) -> None:
        """What comes before the blocks; `each` gets a task's result, or a text that says why there
        is none. A task whose worker dies is tried once more while no other worker is busy.
        one_by_one: so that none disturbs another's frame times.
        """
        slots = 1 if one_by_one else self.slots
        waiting, alone = deque(tasks), deque[_First]()
        busy: dict[int, _First] = {}
        tried_alone: set[_First] = set()
        while waiting or alone or busy:
            for slot in range(slots):
                if waiting and slot not in busy:
                    busy[slot] = waiting.popleft()
                    self._pool.give(slot, busy[slot])
            if alone and not busy:
                busy[0] = alone.popleft()
                tried_alone.add(busy[0])
                self._pool.give(0, busy[0])
            for event in self._pool.wait(WAIT_S):
                task = busy.pop(event.slot)
                if _wants_memory(event) and task not in tried_alone:
                    alone.append(task)
                elif isinstance(event, Lost):
                    doing = "opening the scene" if isinstance(task, IndexTask) else _RESOLVING
                    each(task, f"the worker {event.how} while {doing}, alone too")
                elif isinstance(event.result, TaskFailed):
                    _raise_if_output(event.result)
                    each(task, event.result.text)
                else:
                    if isinstance(event.result, SceneRecord):
                        self._open[event.slot] = event.result.name
                    each(task, event.result)

    def render(
        self, blocks: Sequence[Block], names: Mapping[str, str | None], fail: FailBlock
    ) -> None:
        """Render and publish the blocks. names: by scene, what the job calls it. fail: records all
        images of a block as failed. A block whose worker dies is tried once more while no other
        worker is busy, each of its images in a process of its own.
        """
        self._queue, self._names, self._fail = BlockQueue(blocks), names, fail
        while self._dispatch():
            for event in self._pool.wait(WAIT_S):
                self._collect(event)
            self._idle()

    def _tick(self, slot: int, outcome: Outcome) -> None:
        partial = self._partial[slot]
        partial[0] += 1
        partial[1] += outcome.status == FAILED
        self._report()

    def _report(self) -> None:
        tally, partial = self.tally, list(self._partial.values())
        done = tally.written + tally.skipped + tally.failed + sum(p[0] for p in partial)
        self._on_image(done, tally.failed + sum(p[1] for p in partial))

    def _dispatch(self) -> bool:
        """Give work to idle workers; False when there is none left, in hand or waiting."""
        now = time.monotonic()
        for when, block in list(self._later):
            if when <= now:
                self._later.remove((when, block))
                self._queue.put_back(block)
        if self._trials and not self._busy:  # alone: memory may be what it died of
            self._give(0, self._trials.pop(0), is_trial=True)
        if self._trials or any(task.is_trial for task in self._busy.values()):
            return True
        for slot in range(self.slots):
            if slot not in self._busy:
                others = [name for s in self._busy if (name := self._open[s])]
                block = self._queue.take(self._open[slot], others)
                if block is not None:
                    self._give(slot, block)
        if not self._busy and self._later:
            time.sleep(min(WAIT_S, max(0.0, self._later[0][0] - now)))
        return bool(self._busy or self._later or len(self._queue))

    def _give(self, slot: int, block: Block, *, is_trial: bool = False) -> None:
        task = BlockTask(block, self._names.get(block.scene), is_trial)
        self._busy[slot], self._open[slot] = task, block.scene
        self._pool.give(slot, task)

    def _collect(self, event: Event) -> None:
        task = self._busy.pop(event.slot)
        self._partial.pop(event.slot, None)
        block = task.block
        if isinstance(event, Lost):
            self._open[event.slot] = None
        if _wants_memory(event) and not task.is_trial:
            _log.warning("%s is tried once more, alone: %s", block.key, _why(event))
            self._trials.append(block)
        elif isinstance(event, Lost):
            self._lost_alone[block.scene] += 1
            is_hopeless = self._lost_alone[block.scene] == MAX_LOST
            others = self._queue.take_all(block.scene) if is_hopeless else []
            self._give_up(
                [block, *others],
                f"the worker {event.how} while at this block of images, and again when it was "
                f"tried alone; if memory ran out, use fewer workers or a machine with more",
            )
        elif isinstance(event.result, TaskFailed):
            _raise_if_output(event.result)
            others = self._queue.take_all(block.scene) if event.result.of_scene else []
            self._give_up([block, *others], event.result.text)
        else:
            assert isinstance(event.result, BlockDone)
            if event.result.is_elsewhere:
                self._later.append((time.monotonic() + ELSEWHERE_S, block))
            else:
                self.tally.add(event.result)
        self._report()

    def _give_up(self, blocks: Sequence[Block], message: str) -> None:
        for block in blocks:
            self._fail(block, message)
            self.tally.failed += block.images
            name = f"{block.scene}/{block.variant}, {block.images} images"
            self.tally.failures.append(f"{name}: {message}")


def _wants_memory(event: Event) -> bool:
    """Whether the task may succeed alone: its worker died, or ran out of memory."""
    if isinstance(event, Lost):
        return True
    return isinstance(event.result, TaskFailed) and event.result.of_memory


def _why(event: Event) -> str:
    if isinstance(event, Lost):
        return f"its worker {event.how}"
    return event.result.text if isinstance(event.result, TaskFailed) else ""


def _raise_if_output(failed: TaskFailed) -> None:
    if failed.is_output:  # nothing can be written any more
        raise OutputError(failed.text)


# ---- What the qualities of a job's recipes choose in its scenes, before there is a plan ----------
# A choice is kept in the output: the scenes in which everything was chosen are not opened again.

_READS = 16  # at a time: most of the time of one is waiting

Found = Mapping[tuple[str, str | None], SceneRecord | str]
Choices = dict[tuple[str, str], Recipe | str]


def resolve_recipes(
    job: GenerateJob,
    store: Store,
    scheduler: Scheduler,
    found: Found,
    *,
    progress: bool,
    keep: bool,
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
    bar = tqdm(
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
        scheduler.do_first(turned, each, one_by_one=timed)
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
    scheduler = Scheduler(lambda tick: make_pool(job, tick))
    with contextlib.closing(scheduler):
        return _plan(job, store, scheduler, progress, keep=False)


def make_pool(job: GenerateJob, tick: Tick) -> WorkerPool:
    """The workers that the job asks for."""
    if job.executor == "serial":
        return SerialPool(job.setup, tick)
    if job.executor == "ray":
        return RayPool(job.setup, tick, job.workers)
    # Several processes would share one GPU, and each have a copy of its scene there.
    default = 1 if renders_on_gpu(job.setup.backend) else available_cores()
    return ProcessPool(job.setup, tick, job.workers or default)


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
        self._rendering_s = 0.0

    def go(self) -> GenerateResult:
        started = time.perf_counter()
        self._scheduler = Scheduler(
            lambda tick: make_pool(self._job, tick), on_image=self._show, idle=self._merge_at_times
        )
        with contextlib.closing(self._scheduler):
            self._plan = plan = _plan(
                self._job, self._store, self._scheduler, self._progress, keep=True
            )
            self._timings["plan"] = time.perf_counter() - started
            blocks = shard_of(plan.blocks, *self._job.shard)
            pending = self._pending(blocks)
            self._timings["scan"] = time.perf_counter() - started - self._timings["plan"]
            done = sum(b.images for b in blocks) - sum(b.images for b in pending)
            self._scheduler.tally.skipped = done
            begun = time.perf_counter()
            self._render(pending, total=sum(block.images for block in blocks))
            self._timings["render_wall"] = time.perf_counter() - begun
            self._timings[WORKERS] = self._rendering_s * self._scheduler.slots
        self._merge(wait=True)
        tally = self._scheduler.tally
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
        parts = list_parts(self._store)
        pending = [b for b in blocks if b.key not in parts or parts[b.key].has_failures]
        new = [block for block in pending if block.key not in parts]
        if new:
            _check_not_mixed(self._store, self._plan, new)
        store_plan(self._store, self._plan)
        left = {block.key for block in pending}
        published = [block for block in blocks if block.key not in left]
        clear_leftovers(self._store, self._job.setup.scratch, published)
        return pending

    def _render(self, pending: Sequence[Block], total: int) -> None:
        if pending:
            records = self._plan.records
            with_lidar = [block for block in pending if records[block.scene].has_lidar]
            for note in lidar_notes({b.variant: b.recipe for b in with_lidar}.values()):
                _log.warning("note: %s", note)
            self._prepare(list({block.recipe.name: block.recipe for block in pending}.values()))
        self._bar = tqdm(
            total=total,
            initial=self._scheduler.tally.skipped,
            unit="image",
            disable=not self._progress,
        )
        with self._bar:
            try:
                if pending:
                    started = time.perf_counter()
                    self._scheduler.render(pending, dict(self._plan.names), self._fail)
                    self._rendering_s = time.perf_counter() - started
            except KeyboardInterrupt:
                self._scheduler.close()
                self._merge(wait=True)
                raise KeyboardInterrupt(
                    "stopped; start the same job again to go on from there"
                ) from None

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


def _plan(
    job: GenerateJob, store: Store, scheduler: Scheduler, progress: bool, *, keep: bool
) -> Plan:
    found: dict[tuple[str, str | None], SceneRecord | str] = {}
    for entry in job.scenes:
        record = None if job.rescan else _known(store, entry)
        if record is not None:
            found[entry.uri, entry.name] = record
    tasks = [IndexTask(e.uri, e.name) for e in job.scenes if (e.uri, e.name) not in found]
    with tqdm(
        total=len(tasks), unit="scene", desc="opening", disable=not progress or not tasks
    ) as bar:

        def each(task: IndexTask, record: SceneRecord | str) -> None:
            found[task.uri, task.name] = record
            if keep and isinstance(record, SceneRecord):
                store.write(_record_path(task.uri, task.name), record.to_json())
            bar.update()

        scheduler.do_first(list(dict.fromkeys(tasks)), each)
    resolved = resolve_recipes(job, store, scheduler, found, progress=progress, keep=keep)
    return make_plan(job.recipes, job.scenes, found, job.setup.backend, resolved)


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
