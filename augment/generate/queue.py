"""Which block a worker gets next: one of the scene it has open, as long as there are any."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from augment.generate.records import Block


class BlockQueue:
    """Blocks by scene, in order. A worker stays with a scene; a new scene goes to one worker.

    Where no scene is left that nobody works on, a worker joins the one with most images left.
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
