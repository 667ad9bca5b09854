"""Stand-in renderers that begin views, as a GPU does, and note when somebody waits for them.

Worker processes import this module by name, so it needs nothing of pytest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from batch_scenes import FakeView, fake_render

from augment.cameras import Camera
from augment.scene import Scene
from recipes.schema import Recipe


@dataclass
class FakePending:
    finish: Callable[[], FakeView]

    def result(self) -> FakeView:
        return self.finish()


@dataclass
class Gpu:
    """Begins views and finishes them when they are waited for; `notes` has the order."""

    notes: list[tuple[str, int]] = field(default_factory=list)
    count: int = 0

    def __call__(self, scene: Scene, camera: Camera, recipe: Recipe, *, backend: str):
        number, self.count = self.count, self.count + 1
        self.began(number)

        def finish() -> FakeView:
            self.awaited(number)
            return fake_render(scene, camera, recipe, backend=backend)

        return FakePending(finish)

    def began(self, number: int) -> None:
        self.notes.append(("begin", number))

    def awaited(self, number: int) -> None:
        self.notes.append(("await", number))


def begin_fake(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakePending:
    return FakePending(lambda: fake_render(scene, camera, recipe, backend=backend))
