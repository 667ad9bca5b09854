"""Fixtures shared by all tests, and the run-time check of the library's shape annotations."""

from __future__ import annotations

import gc
import os
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

# Before torch is loaded. Processes that share the cores wait for each other's threads at the end of
# every operation, ten times as long as these small ones take. (numba's threads are others.)
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["CLIMATEGS_SCENE_CACHE_GB"] = "0"  # tests build what they look at

import pytest
import torch
from jaxtyping import config, install_import_hook

ROOT = Path(__file__).resolve().parents[1]
KERNELS = re.compile(
    r"^(import numba|from numba|from augment\.render\.cpu\.jit|import triton)", re.MULTILINE
)
SHAPES = re.compile(r"^\s*from jaxtyping import", re.MULTILINE)

# Triton reads this where a kernel is defined: without a GPU its kernels run in Python.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")


def _checked_modules() -> list[str]:
    """Modules of the library whose annotations state shapes, without those that hold numba or
    Triton kernels.

    The hook wraps every function of a module, and a wrapped kernel can be neither compiled nor
    cached. Each call of a wrapped function costs tens of microseconds, and its import a compiled
    wrapper: where no shape is stated, the type checker has the same annotations without running.
    """
    texts = {path: path.read_text() for path in sorted((ROOT / "augment").rglob("*.py"))}
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path, text in texts.items()
        if path.name != "__init__.py" and SHAPES.search(text) and not KERNELS.search(text)
    ]
    assert "augment.scene.scene" in names and "augment.render.composite_kernels" not in names
    return names


gc.disable()  # until all tests are imported: imports make millions of objects and hardly garbage
install_import_hook(_checked_modules(), "beartype.beartype")


def pytest_collection_finish() -> None:
    """Spare the garbage collector what imports have made: jobs collect after every scene."""
    gc.collect()
    gc.freeze()
    gc.enable()


# Files of a few long tests. At the end one of them would keep a single core busy.
LONG = {
    f"test_{name}.py"
    for name in (
        "bench", "cli", "fit", "fit_report", "flood_view", "generate", "generate_ray",
        "job_workers", "packages", "procedural", "prune", "reconstruct_updates", "render_backward",
        "rendered_suite", "score_suite", "snow_view", "store", "style", "weather_over_time",
    )
}  # fmt: skip


def pytest_runtest_setup() -> None:
    """Kernels on one thread, in processes that share the cores: on two they wait for each other's
    threads, at times 30 times as long as they compute. Tests of threads set their own numbers.
    """
    if threads := sys.modules.get("augment.render.threads"):
        threads.limit_threads(1)


@pytest.fixture
def ends_soon() -> Iterator[None]:
    """Fails a test whose input would keep it busy or waiting, instead of hanging with it."""

    def too_late(*_: object) -> None:
        pytest.fail("still at work after 30 s")

    before = signal.signal(signal.SIGALRM, too_late)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first (make test tells pytest-xdist to keep to this order). Without a GPU the
    tests that need one are skipped.
    """
    items.sort(key=lambda item: item.path.name not in LONG)
    if not torch.cuda.is_available():
        skip = pytest.mark.skip(reason="needs a GPU")
        for item in items:
            if "gpu" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(scope="session", autouse=True)
def interruptible():
    """Ctrl-C works in tests also where a shell in the background has switched it off."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of real data and reference renders beside the project; skips where absent."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"real data and reference renders are not at {folder}")
    return folder


@pytest.fixture
def quick_folder() -> Iterator[Path]:
    """A folder in memory where there is one: for tests that flush thousands of files."""
    memory = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(dir=memory if memory.is_dir() else None))
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def unchecked():
    """Turns the check of annotations off, for tests of the library's own messages."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
