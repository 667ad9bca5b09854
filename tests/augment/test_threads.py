"""The thread layer: which pool, how many threads, and workers forked after the parent rendered."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from augment.render import threads

ROOT = Path(__file__).parents[2]
SECONDS = 120  # for a fresh process on a busy machine; a worker that hangs would wait for ever

FORKED_WORKERS = """
import torch
from torch.utils.data import DataLoader, Dataset
from augment.render.cpu.driver import rasterize_cpu
from augment.render.constants import RasterSettings
from augment.render.threads import limit_threads, thread_count
from augment.scene import PosedGaussians
from tests.scenes import camera_ahead, random_gaussians

PARTS = [PosedGaussians(random_gaussians(500))]

def render(index):
    camera = camera_ahead(64, 48, 50.0, yaw=0.1 * index)
    return rasterize_cpu(PARTS, camera, frozenset({"rgb", "alpha"}), RasterSettings(), None).rgb

class Frames(Dataset):
    def __len__(self):
        return 6
    def __getitem__(self, index):
        return render(index), thread_count()

if __name__ == "__main__":
    limit_threads(2)
    expected = [render(index) for index in range(6)]
    loader = DataLoader(Frames(), batch_size=None, num_workers=2, timeout=60,
                        multiprocessing_context="fork")
    for _ in range(2):
        for index, (image, count) in enumerate(loader):
            assert torch.equal(image, expected[index]), index
            assert count == 1, count
    assert torch.equal(render(0), expected[0])
    print("done")
"""

ONE_CALLER = """
import logging
from concurrent.futures import ThreadPoolExecutor
logging.basicConfig()
import numba, torch
from augment.render import threads
threads._preload_tbb = lambda: False
from augment.render.cpu.driver import rasterize_cpu
from augment.render.constants import RasterSettings
from augment.scene import PosedGaussians
from tests.scenes import camera_ahead, random_gaussians

parts = [PosedGaussians(random_gaussians(3000))]
def render(_):
    camera = camera_ahead(128, 96, 90.0)
    return rasterize_cpu(parts, camera, frozenset({"rgb", "alpha"}), RasterSettings(), None).rgb
expected = render(0)
with ThreadPoolExecutor(4) as pool:
    assert all(torch.equal(image, expected) for image in pool.map(render, range(12)))
assert numba.threading_layer() == "workqueue"
print("done")
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=SECONDS
    )
    assert result.returncode == 0 and result.stdout == "done\n", result.stderr
    return result


def has_tbb() -> bool:
    try:
        importlib.metadata.version("tbb")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


needs_tbb = pytest.mark.skipif(not has_tbb(), reason="the package tbb is not installed")


@needs_tbb
def test_tbb_is_chosen():
    assert threads.select_thread_pool() == "tbb"
    with threads.kernel_threads():
        pass
    assert numba.threading_layer() == "tbb"


@needs_tbb
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="workers are forked on Linux only")
def test_workers_forked_after_the_parent_rendered():
    run(FORKED_WORKERS)


def test_without_tbb_callers_take_turns():
    """numba's own layer ends the process when two threads launch kernels at once."""
    assert "install the package 'tbb'" in run(ONE_CALLER).stderr


def test_a_layer_the_user_named_is_kept(monkeypatch):
    named = "from augment.render.threads import select_thread_pool; print(select_thread_pool())"
    monkeypatch.setenv("NUMBA_THREADING_LAYER", "workqueue")
    result = subprocess.run(
        [sys.executable, "-c", named], cwd=ROOT, capture_output=True, text=True, timeout=SECONDS
    )
    assert result.stdout == "workqueue\n", result.stderr


def test_limits():
    before = threads.thread_count()
    try:
        threads.limit_threads(1)
        assert threads.thread_count() == 1
        with threads.kernel_threads():
            assert numba.get_num_threads() == 1
        threads.limit_threads(10_000)
        assert threads.thread_count() == numba.get_num_threads()
    finally:
        threads.limit_threads(None)
    assert threads.thread_count() == before
    with pytest.raises(ValueError, match="count must be >= 1 thread, or None for no limit; got 0"):
        threads.limit_threads(0)


def test_kernel_threads_leave_the_caller_s_setting():
    before = numba.get_num_threads(), numba.get_parallel_chunksize()
    with pytest.raises(RuntimeError, match="inside"), threads.kernel_threads(3):
        assert numba.get_parallel_chunksize() == 3
        raise RuntimeError("inside")
    assert (numba.get_num_threads(), numba.get_parallel_chunksize()) == before


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "50000 100000\n"}, 1),
        ({"cpu.max": "max 100000\n"}, None),
        ({"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
        ({"cpu.max": "nonsense"}, None),
        ({}, None),
    ],
)
def test_container_quota(files, cores, tmp_path, monkeypatch):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(threads, "_CGROUP", tmp_path)
    threads._container_cores.cache_clear()
    try:
        assert threads._container_cores() == cores
        assert 1 <= threads.usable_cores() <= (cores or 10_000)
    finally:
        threads._container_cores.cache_clear()
