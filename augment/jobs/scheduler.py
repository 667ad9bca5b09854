"""Hands a job's tasks to a pool of workers and takes in what becomes of them."""

from __future__ import annotations

import logging
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from augment.errors import OutputError
from augment.jobs.block_pools import Event, Lost, WorkerPool
from augment.jobs.block_worker import BlockDone, BlockTask, IndexTask, ResolveTask, TaskFailed
from augment.jobs.blocks import Block, SceneRecord
from augment.jobs.manifest import FAILED
from augment.jobs.worker import Outcome

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
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


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
        self._open: list[str | None] = [None] * self._pool.slots  # the scene of every slot

    @property
    def slots(self) -> int:
        """How many workers there are at most."""
        return self._pool.slots

    def close(self) -> None:
        self._pool.close()

    def do_first(
        self,
        tasks: Sequence[_First],
        each: Callable[[_First, Any], None],
        *,
        one_by_one: bool = False,
    ) -> None:
        """What comes before the blocks; `each` gets a task's result, or a text that says why there
        is none. A task whose worker dies is tried once more, while no other worker is busy.

        one_by_one: no two at a time, so that none is in the way of another's frame times.
        """
        slots = 1 if one_by_one else self._pool.slots
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
        self, blocks: Sequence[Block], names: dict[str, str | None], fail: FailBlock
    ) -> None:
        """Render and publish the blocks. names: by scene, what it is called if not by itself. fail:
        records all images of a block as failed. A block whose worker dies is tried once more while
        no other worker is busy, each of its images in a process of its own.
        """
        run = _Rendering(self, BlockQueue(blocks), names, fail)
        while run.dispatch():
            for event in self._pool.wait(WAIT_S):
                run.collect(event)
            self._idle()

    def _tick(self, slot: int, outcome: Outcome) -> None:
        partial = self._partial[slot]
        partial[0] += 1
        partial[1] += outcome.status == FAILED
        self.report()

    def report(self) -> None:
        tally, partial = self.tally, list(self._partial.values())
        done = tally.written + tally.skipped + tally.failed + sum(p[0] for p in partial)
        self._on_image(done, tally.failed + sum(p[1] for p in partial))


class _Rendering:
    """The blocks of one run, and who is at which."""

    def __init__(
        self, scheduler: Scheduler, queue: BlockQueue, names: dict[str, str | None], fail: FailBlock
    ) -> None:
        self._scheduler, self._pool = scheduler, scheduler._pool
        self._queue, self._names, self._fail = queue, names, fail
        self._busy: dict[int, BlockTask] = {}
        self._trials: list[Block] = []
        self._lost_alone: Counter[str] = Counter()  # blocks of a scene that nobody survived
        self._later: list[tuple[float, Block]] = []  # another process is at them

    def dispatch(self) -> bool:
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
        for slot in range(self._pool.slots):
            if slot in self._busy:
                continue
            open_scenes = self._scheduler._open
            others = [open_scenes[s] for s in self._busy]
            block = self._queue.take(open_scenes[slot], [name for name in others if name])
            if block is not None:
                self._give(slot, block)
        if not self._busy and self._later:
            time.sleep(min(WAIT_S, max(0.0, self._later[0][0] - now)))
        return bool(self._busy or self._later or len(self._queue))

    def _give(self, slot: int, block: Block, *, is_trial: bool = False) -> None:
        task = BlockTask(block, self._names.get(block.scene), is_trial)
        self._busy[slot] = task
        self._scheduler._open[slot] = block.scene
        self._pool.give(slot, task)

    def collect(self, event: Event) -> None:
        task = self._busy.pop(event.slot)
        self._scheduler._partial.pop(event.slot, None)
        block = task.block
        if isinstance(event, Lost):
            self._scheduler._open[event.slot] = None
        if _wants_memory(event) and not task.is_trial:
            _log.warning("%s is tried once more, alone: %s", block.key, _why(event))
            self._trials.append(block)
        elif isinstance(event, Lost):
            self._give_up(block, _lost_twice(event))
            self._lost_alone[block.scene] += 1
            if self._lost_alone[block.scene] == MAX_LOST:
                for other in self._queue.take_all(block.scene):
                    self._give_up(other, _lost_twice(event))
        elif isinstance(event.result, TaskFailed):
            _raise_if_output(event.result)
            others = self._queue.take_all(block.scene) if event.result.of_scene else []
            for failed in (block, *others):
                self._give_up(failed, event.result.text)
        else:
            assert isinstance(event.result, BlockDone)
            if event.result.is_elsewhere:
                self._later.append((time.monotonic() + ELSEWHERE_S, block))
            else:
                self._done(block, event.result)
        self._scheduler.report()

    def _done(self, block: Block, done: BlockDone) -> None:
        tally = self._scheduler.tally
        tally.written += done.written
        tally.skipped += done.skipped
        tally.failed += done.failed
        tally.failures += done.failures
        for kind, seconds in (done.seconds or {}).items():
            tally.seconds[kind] += seconds

    def _give_up(self, block: Block, message: str) -> None:
        self._fail(block, message)
        tally = self._scheduler.tally
        tally.failed += block.images
        tally.failures.append(f"{block.scene}/{block.variant}, {block.images} images: {message}")


def _wants_memory(event: Event) -> bool:
    """Whether the task may succeed alone: its worker died, or ran out of memory."""
    if isinstance(event, Lost):
        return True
    return isinstance(event.result, TaskFailed) and event.result.of_memory


def _why(event: Event) -> str:
    if isinstance(event, Lost):
        return f"its worker {event.how}"
    return event.result.text if isinstance(event.result, TaskFailed) else ""


def _lost_twice(event: Lost) -> str:
    return (
        f"the worker {event.how} while at this block of images, and again when it was tried alone; "
        f"if memory ran out, use fewer workers or a machine with more"
    )


def _raise_if_output(failed: TaskFailed) -> None:
    if failed.is_output:  # nothing can be written any more
        raise OutputError(failed.text)
