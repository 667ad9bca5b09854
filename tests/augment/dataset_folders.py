"""Output folders and stores for the tests of the datasets."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from batch_scenes import fake_render, make_recipe, open_fake

from augment.jobs.render_job import RenderJob, run_job
from augment.jobs.store import StoredFile, StoredFileMissing
from recipes.flood import Flood

CLEAR = make_recipe("clear", lidar=True)
FOGGY = make_recipe(image="jpg", lidar=True)
FLOODED = make_recipe("clear", variant=9, flood=Flood(level_m=0.3), surface="first")


def write_scene(out: Path, recipes: list, name: str = "street", frames: int = 4) -> None:
    """A scene of two cameras under some recipes."""
    job = RenderJob(f"fake:{name}?frames={frames}", recipes, out)
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)


@dataclass
class MemoryStore:
    """A store that is not on this machine, as far as readers can tell."""

    files: dict[str, bytes] = field(default_factory=dict)
    uri: str = "memory://bucket/out?region=here"
    local_dir: Path | None = None

    @staticmethod
    def of(folder: Path) -> MemoryStore:
        found = (path for path in folder.rglob("*") if path.is_file())
        return MemoryStore({p.relative_to(folder).as_posix(): p.read_bytes() for p in found})

    def read(self, path: str) -> bytes:
        if path not in self.files:
            raise StoredFileMissing(f"{path} is not in {self.uri}")
        return self.files[path]

    def write(self, path: str, data: bytes) -> None:
        self.files[path] = data

    def put_file(self, path: str, source: Path) -> None:
        self.files[path] = source.read_bytes()

    def list(self, folder: str) -> dict[str, StoredFile]:
        inside = f"{folder}/" if folder else ""
        names = sorted(name for name in self.files if name.startswith(inside))
        return {name: StoredFile(len(self.files[name]), 0.0) for name in names}

    def exists(self, path: str) -> bool:
        return path in self.files

    def delete(self, paths: Iterable[str]) -> None:
        for path in paths:
            self.files.pop(path, None)


def assert_same_sample(a: Any, b: Any, *, but: tuple[str, ...] = ()) -> None:
    """Equal in types, dtypes and values; NaN equals NaN. but: keys that are not compared."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a.keys() - set(but):
            assert_same_sample(a[key], b[key])
    elif isinstance(a, list):
        for one, other in zip(a, b, strict=True):
            assert_same_sample(one, other)
    elif isinstance(a, torch.Tensor):
        same = np.array_equal(a.numpy(), b.numpy(), equal_nan=a.is_floating_point())
        assert a.dtype == b.dtype and same
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and [repr(v) for v in a.ravel()] == [repr(v) for v in b.ravel()]
    elif isinstance(a, float):
        assert a == b or (a != a and b != b)
    else:
        assert a == b
