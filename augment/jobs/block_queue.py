"""Queue of blocks, and the work of opening scenes and rendering blocks, for a pool of workers.

In: blocks of a job plan. Out: tasks for workers, and a `Tally` of their results. `generate` calls
it. A worker gets blocks of its open scene as long as there are any. A block whose worker dies is
tried once more, alone.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from augment.jobs.block_worker import BlockResult, BlockTask
from augment.jobs.blocks import Block, SceneRecord
from augment.jobs.pools import Work
from augment.jobs.worker import Outcome, TaskFailed
from augment.output.manifest import FAILED

_log = logging.getLogger(__name__)


class BlockQueue:
    """Queue of blocks by scene, in order.

    A worker stays with its open scene, and a new scene goes to one worker. Where every scene left
    has a worker already, a further worker joins the scene with the most images left.
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
        """Return the next block for a worker, or None where no block is left.

        Args:
            scene: Name of the scene that the worker has open.
            elsewhere: Names of the scenes that other workers have open.
        """
        if not self._scenes:
            return None
        if scene not in self._scenes:
            busy_scenes = set(elsewhere)
            free_scenes = [name for name in self._scenes if name not in busy_scenes]
            scene = (
                free_scenes[0]
                if free_scenes
                else max(self._scenes, key=lambda name: self._images[name])
            )
        block = self._scenes[scene].popleft()
        self._images[scene] -= block.images
        if not self._scenes[scene]:
            del self._scenes[scene]
        return block

    def take_all(self, scene: str) -> list[Block]:
        """Remove and return all blocks of a scene that cannot be opened."""
        self._images.pop(scene, None)
        return list(self._scenes.pop(scene, ()))

    def put_back(self, block: Block) -> None:
        """Queue a block once more, after the other blocks of its scene."""
        self._scenes.setdefault(block.scene, deque()).append(block)
        self._images[block.scene] = self._images.get(block.scene, 0) + block.images


# ---- Opening scenes and rendering blocks, as work for a pool of workers --------------------------

# Blocks of one scene that may kill even a worker that works alone; then the scene is given up.
MAX_LOST = 3
# Wait before a block is tried again that another process has claimed, seconds.
ELSEWHERE_S = 2.0

# Records all images of a block as failed, with a message.
FailBlock = Callable[[Block, str], None]


@dataclass
class Tally:
    """Counts of the images of the blocks that are done so far."""

    written: int = 0
    """Images rendered by this call."""
    skipped: int = 0
    """Images that were finished before."""
    failed: int = 0
    """Images that could not be rendered."""
    failures: list[str] = field(default_factory=list)
    """One line for each failure."""
    seconds: Counter[str] = field(default_factory=Counter)
    """Seconds by kind of work."""

    def add(self, result: BlockResult) -> None:
        """Add the counts of a finished block."""
        self.written += result.written
        self.skipped += result.skipped
        self.failed += result.failed
        self.failures += result.failures
        self.seconds.update(result.seconds or {})


class SceneWork(Work):
    """Tasks that open scenes, before there are blocks.

    Attributes:
        tasks: Tasks for the workers.
        on_result: Called with a task and its result, or with a text that says why there is no
            result.
        activity: What the tasks do, after "while", for messages.
        scene_of_slot: Name of the scene that each slot has open; kept up to date here.
    """

    def __init__(
        self,
        tasks: Iterable[Any],
        on_result: Callable[[Any, Any], None],
        activity: str,
        scene_of_slot: dict[int, str],
    ) -> None:
        self._tasks = deque(tasks)
        self._on_result = on_result
        self._activity = activity
        self._scene_of_slot = scene_of_slot

    def take(self, slot: int) -> Any:
        return self._tasks.popleft() if self._tasks else None

    def done(self, slot: int, task: Any, result: Any) -> None:
        if isinstance(result, SceneRecord):
            self._scene_of_slot[slot] = result.name
        self._on_result(task, result.text if isinstance(result, TaskFailed) else result)

    def lost(self, slot: int, task: Any, how: str) -> None:
        self._on_result(task, f"the worker {how} while {self._activity}, alone too")


class BlockWork(Work):
    """Work that renders and publishes blocks.

    A block whose worker dies is tried once more, each of its images in a process of its own.

    Attributes:
        names: Name that the job gives each scene, by scene.
        fail: Records all images of a block as failed.
        on_image: Called with the number of images done and the number of failed ones.
        scene_of_slot: Name of the scene that each slot has open; kept up to date here.
        damaged_keys: Keys of published blocks that have lost files.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        names: Mapping[str, str | None],
        scene_of_slot: dict[int, str],
        fail: FailBlock,
        on_image: Callable[[int, int], None] = lambda done, failed: None,
        damaged_keys: Collection[str] = (),
    ) -> None:
        self.tally = Tally()
        self._damaged_block_keys = frozenset(damaged_keys)
        self._queue = BlockQueue(blocks)
        self._names = names
        self._fail = fail
        self._on_image = on_image
        self._partial: dict[int, list[int]] = defaultdict(lambda: [0, 0])  # by slot: done, failed
        self._scene_of_slot = scene_of_slot
        self._busy_slots: set[int] = set()
        self._lone_losses: Counter[str] = Counter()  # blocks by scene that killed a lone worker
        # Times (monotonic) and blocks to try again: another process has claimed them.
        self._postponed: list[tuple[float, Block]] = []

    def tick(self, slot: int, outcome: Outcome) -> None:
        partial = self._partial[slot]
        partial[0] += 1
        partial[1] += outcome.status == FAILED
        self._report()

    def take(self, slot: int) -> BlockTask | None:
        now_s = time.monotonic()
        for retry_s, block in list(self._postponed):
            if retry_s <= now_s:
                self._postponed.remove((retry_s, block))
                self._queue.put_back(block)
        block = self._queue.take(
            self._scene_of_slot.get(slot), {self._scene_of_slot[s] for s in self._busy_slots}
        )
        if block is None:
            return None
        self._scene_of_slot[slot] = block.scene
        self._busy_slots.add(slot)
        is_damaged = block.key in self._damaged_block_keys
        return BlockTask(block, self._names.get(block.scene), is_damaged=is_damaged)

    def later_s(self) -> float | None:
        return max(0.0, self._postponed[0][0] - time.monotonic()) if self._postponed else None

    def retry(self, slot: int, task: BlockTask, reason: str) -> list[BlockTask]:
        _log.warning("%s is tried once more, alone: %s", task.block.key, reason)
        self._free_slot(slot)
        return [replace(task, is_trial=True)]

    def done(self, slot: int, task: BlockTask, result: BlockResult | TaskFailed) -> None:
        self._free_slot(slot)
        if isinstance(result, TaskFailed):
            other_blocks = self._queue.take_all(task.block.scene) if result.is_scene_error else []
            self._give_up([task.block, *other_blocks], result.text)
        elif result.is_claimed_elsewhere:
            self._postponed.append((time.monotonic() + ELSEWHERE_S, task.block))
        else:
            self.tally.add(result)
        self._report()

    def lost(self, slot: int, task: BlockTask, how: str) -> None:
        self._free_slot(slot)
        scene = task.block.scene
        self._scene_of_slot.pop(slot, None)
        self._lone_losses[scene] += 1
        other_blocks = self._queue.take_all(scene) if self._lone_losses[scene] == MAX_LOST else []
        self._give_up(
            [task.block, *other_blocks],
            f"the worker {how} while at this block of images, and again when it was tried alone; "
            f"if memory ran out, use fewer workers or a machine with more",
        )
        self._report()

    def _free_slot(self, slot: int) -> None:
        self._busy_slots.discard(slot)
        self._partial.pop(slot, None)

    def _report(self) -> None:
        tally = self.tally
        partial_counts = list(self._partial.values())
        num_done = tally.written + tally.skipped + tally.failed + sum(p[0] for p in partial_counts)
        self._on_image(num_done, tally.failed + sum(p[1] for p in partial_counts))

    def _give_up(self, blocks: Sequence[Block], message: str) -> None:
        """Record all images of the blocks as failed."""
        for block in blocks:
            self._fail(block, message)
            self.tally.failed += block.images
            name = f"{block.scene}/{block.variant}, {block.images} images"
            self.tally.failures.append(f"{name}: {message}")
