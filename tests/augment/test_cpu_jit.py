"""The CPU backend's building blocks: the kernel cache, vectors, exp2 and log2."""

from __future__ import annotations

import importlib
import importlib.metadata
import io
import os
import subprocess
import sys
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import prange

from augment.progress import ProgressBar
from augment.render import threads
from augment.render.compile_ahead import describe_type, find_type, read_signatures
from augment.render.cpu import jit as cpu_jit
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import KERNELS, compile_seconds, kernel
from augment.render.cpu.kernel_cache import (
    KEEP_DAYS,
    SECONDS_A_DAY,
    UserCacheLocator,
    make_folder,
    user_cache_folder,
)
from augment.render.cpu.simd import exp2, exp2_fine, log2
from augment.render.threads import kernel_threads

U = np.uint64
ROOT = Path(__file__).parents[2]


def double(values):
    for i in prange(values.size):
        values[i] *= 2


@kernel
def elementary(which, x, out):
    for group in prange(x.size // 8):
        at = U(group) * U(8)
        value = v8.load(x, at)
        if which == 0:
            v8.store(out, at, exp2(value))
        elif which == 1:
            v8.store(out, at, exp2_fine(value))
        elif which == 2:
            v8.store(out, at, log2(value))
        elif which == 3:
            v8.store(out, at, v8.floor(v8.negate(value)))
        elif which == 4:
            v8.store(out, at, v8.minus_abs(value))
        else:
            v8.store(out, at, v8.sqrt(v8.maximum(value, v8.broadcast(np.float32(2)))) / value)


def apply(which, x):
    x = np.asarray(x, np.float32)
    padded = np.resize(x, -(-x.size // 8) * 8)
    out = np.empty_like(padded)
    with kernel_threads():
        elementary(which, padded, out)
    return out[: x.size].astype(np.float64)


def test_a_kernel_is_compiled_again_when_any_source_changes(monkeypatch, tmp_path):
    # numba reads NUMBA_CACHE_DIR when it is imported.
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def hits(kernel_function):
        values = np.ones(4)
        with kernel_threads():
            kernel_function(values)
        assert values.tolist() == [2, 2, 2, 2]
        return sum(kernel_function.stats.cache_hits.values())

    hits(kernel(double))  # whatever an earlier run left, it is in the cache now
    assert hits(kernel(double)) == 1
    monkeypatch.setattr(
        cpu_jit, "SOURCES", "other sources " + np.random.default_rng().bytes(8).hex()
    )
    assert hits(kernel(double)) == 0
    assert hits(kernel(double)) == 1


@pytest.mark.long
def test_compiled_kernels_lie_in_the_users_cache_folder_and_not_beside_the_sources(tmp_path):
    code = (
        "from augment.render.cpu.jit import KERNELS\n"
        "from adapters.lidar_scene import surfels\n"
        "from adapters.street import raycast\n"
        "compiled = [*KERNELS.values(), surfels._levels]\n"
        "print(*{str(kernel._cache.cache_path) for kernel in compiled}, sep='\\n')"
    )
    for name, expected in (
        ("cache", f"{tmp_path}/cache/climategs/kernels/"),
        ("file", "__pycache__"),
    ):
        if name == "file":  # a cache folder that cannot be made
            (tmp_path / name).write_bytes(b"")
        environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / name)}
        environment.pop("NUMBA_CACHE_DIR", None)
        command = [sys.executable, "-c", code]
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        )
        places = done.stdout.split()
        assert places and all(expected in place for place in places)


def test_the_time_of_a_progress_bar_leaves_out_compiling(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    values = np.ones(4, np.float32)
    with ProgressBar(total=2, file=io.StringIO()) as bar:
        started = time.perf_counter()
        with kernel_threads():
            kernel(double)(values)
        bar.update()
        passed_s = time.perf_counter() - started
        assert compile_seconds() > 0 and bar.format_dict["elapsed"] < passed_s / 2


def test_the_folder_of_a_kernel_is_named_by_all_its_sources(tmp_path):
    def folder(text: str, sources_digest: str) -> str:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.py"
        path.write_text(text)
        place = type("Place", (UserCacheLocator,), {"digest_of_others": sources_digest})
        return place(double, str(path), tmp_path).get_cache_path()

    assert folder("a", "x") == folder("a", "x")
    assert len({folder("a", "x"), folder("b", "x"), folder("a", "y")}) == 3


def test_a_relative_cache_folder_does_not_count(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for cache_home in ("", "here"):
        monkeypatch.setenv("XDG_CACHE_HOME", cache_home)
        assert user_cache_folder() == tmp_path / ".cache/climategs"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "there"))
    assert user_cache_folder() == tmp_path / "there/climategs"


def test_folders_of_kernels_go_when_unused_for_long(tmp_path):
    recent, old = tmp_path / "recent", tmp_path / "old"
    for path, days in ((recent, KEEP_DAYS - 1), (old, KEEP_DAYS + 1)):
        path.mkdir()
        then = time.time() - days * SECONDS_A_DAY
        os.utime(path, (then, then))
    make_folder(tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "recent"]
    make_folder(recent)  # in use again
    assert time.time() - recent.stat().st_mtime < 60


def test_the_list_of_signatures_names_kernels_and_types():
    assert read_signatures()
    for name, forms in read_signatures():
        importlib.import_module(name.partition(":")[0])
        assert KERNELS[name].py_func.__code__.co_argcount == len(forms), name
        assert [describe_type(find_type(form)) for form in forms] == forms


COMPILED_BY_PRESETS = """
from numba.core import event
from adapters.base import open_scene
from tools.warm_up import warm_up
from recipes.load import load_recipe, preset_names
log = event.RecordingListener()
event.register("numba:compile", log)
open_scene("procedural:street?frames=1")
warm_up([load_recipe(name).resolve(0) for name in preset_names()])
print({e.data["dispatcher"].py_func.__name__ for _, e in log.buffer if e.is_start})
"""


@pytest.mark.long
def test_what_presets_compile_is_in_the_list_of_signatures(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    ahead = "from augment.render.compile_ahead import compile_listed; compile_listed(['a'])"
    subprocess.run([sys.executable, "-c", ahead], check=True)
    found = subprocess.run(
        [sys.executable, "-c", COMPILED_BY_PRESETS], check=True, capture_output=True, text=True
    )
    assert found.stdout == "set()\n"


@pytest.mark.long
def test_importing_compiles_nothing():
    code = (
        "import numba.core.event as e\n"
        "log = e.RecordingListener()\n"
        "e.register('numba:compile', log)\n"
        "import augment.render.cpu.driver\n"
        "print(len(log.buffer))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
    )
    assert result.stdout == "0\n", result.stderr


def test_exp2():
    x = np.linspace(-126, 126, 100_001)
    expected = np.exp2(np.float64(np.float32(x)))
    np.testing.assert_allclose(apply(0, x), expected, rtol=3e-6)
    np.testing.assert_allclose(apply(1, x), expected, rtol=2e-7)
    # Smog without density must change no bit.
    assert apply(1, [0.0, -0.0]).tolist() == [1.0, 1.0]


def test_log2():
    x = np.exp2(np.linspace(-125, 125, 100_001)).astype(np.float32)
    expected = np.log2(x.astype(np.float64))
    assert np.all(np.abs(apply(2, x) - expected) <= 2e-7 * (1 + np.abs(expected)))
    assert apply(2, [1.0, 0.5, 8.0]).tolist() == [0.0, -1.0, 3.0]
    # Nothing in the numbers a culled splat brings may look visible.
    assert (apply(2, [0.0, 1e-44]) < -100).all()


@pytest.mark.parametrize(
    ("which", "function"),
    [
        (3, lambda x: np.floor(-x)),
        (4, lambda x: -np.abs(x)),
        (5, lambda x: np.sqrt(np.maximum(x, np.float32(2))) / x),
    ],
)
def test_lanes(which, function):
    x = np.array([-2.5, -1, -0.25, 0.5, 1, 1.5, 3, 1e6, 7, -7], np.float32)
    assert apply(which, x).tolist() == function(x).astype(np.float32).tolist()


@kernel
def turned(rows, table, out):
    """Eight and sixteen at once: turned rows, 2**x of lanes above -1, and rows of an image."""
    for part in prange(2):
        if part == 0:
            kind = v8.lane_numbers()
            v8.transpose_rows(kind, table, rows, U(3), U(9), out, U(0))
            v8.store(
                out, U(512), v8.exp2_where(v8.at_least(kind, v8.broadcast(np.float32(3))), kind)
            )
        else:
            kind = v8.wide_columns()
            v8.transpose_rows(kind, table, rows, U(3), U(9), out, U(16))
            for row in range(v8.rows_in(kind)):
                v8.store(out, U(544) + row * U(8), v8.load_row(kind, table, row))


def test_turned_rows_stop_at_the_last_and_masked_lanes_are_zero():
    table = np.arange(320, dtype=np.float32)
    rows, out = np.arange(19, 0, -1, dtype=np.int32), np.zeros(600, np.float32)
    with kernel_threads():
        turned(rows, table, out)
    taken = rows[np.minimum(3 + np.arange(v8.WIDE), 9)]
    fields = table.reshape(20, 16)[taken].T
    assert np.array_equal(out[:512].reshape(16, 32)[:, :8], fields[:, :8])
    assert np.array_equal(out[:512].reshape(16, 32)[:, 16 : 16 + v8.WIDE], fields)
    assert out[512:520] == pytest.approx([0, 0, 0, 8, 16, 32, 64, 128], rel=3e-6)
    assert out[512:515].tolist() == [0, 0, 0]
    each = v8.WIDE // 8
    for row in range(each):
        assert out[544 + 8 * row : 552 + 8 * row].tolist() == [*range(row, v8.WIDE, each)]


SECONDS = 120  # for a fresh process on a busy machine; a worker that hangs would wait for ever

FORKED_WORKERS = """
import torch
from torch.utils.data import DataLoader, Dataset
from augment.render.cpu.driver import rasterize_cpu
from augment.render.constants import RasterSettings
from augment.render.threads import limit_threads, num_kernel_threads
from augment.scene.scene import PosedGaussians
from tests.scenes import camera_ahead, random_gaussians

PARTS = [PosedGaussians(random_gaussians(500))]

def render(index):
    camera = camera_ahead(64, 48, 50.0, yaw=0.1 * index)
    return rasterize_cpu(PARTS, camera, frozenset({"rgb", "alpha"}), RasterSettings(), None).rgb

class Frames(Dataset):
    def __len__(self):
        return 6
    def __getitem__(self, index):
        return render(index), num_kernel_threads()

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
from augment.render.compile_ahead import describe_type, find_type, read_signatures
threads._preload_tbb = lambda: False
from augment.render.cpu.driver import rasterize_cpu
from augment.render.constants import RasterSettings
from augment.scene.scene import PosedGaussians
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


PICTURES = """
import dataclasses, hashlib, sys, torch
from augment.render.buffers import BUFFERS
from augment.render.constants import RasterSettings
from augment.render.cpu.simd import WIDE
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.scene.scene import PosedGaussians
from tests.augment.hard_scenes import KINDS, hard_gaussians, in_weather, wide_camera

camera, everything = wide_camera(60.0, (75, 53)), frozenset(BUFFERS)
cases = (("clear", {"rgb", "alpha"}, None), ("clear", everything, None),
         ("clear", everything, HeightClip(0.1, "above")), ("light", {"rgb", "overlay"}, None))
digest = hashlib.sha256()
for kind in KINDS:
    scene = hard_gaussians(kind, camera, 700)
    for weather, names, clip in cases:
        for stop in (1e-4, 0.02):
            picture = rasterize([in_weather(scene, weather)], camera, buffers=frozenset(names),
                                clip=clip, settings=RasterSettings(transmittance_stop=stop),
                                backend="cpu")
            for name in sorted(names):
                digest.update(getattr(picture, name).numpy().tobytes())
scene = hard_gaussians("plain", camera, 700)
sh = scene.sh.clone().requires_grad_()
part = PosedGaussians(dataclasses.replace(scene, sh=sh))
rasterize([part], camera, buffers=frozenset({"rgb", "alpha"}),
          backend="cpu").rgb.square().sum().backward()
digest.update(sh.grad.numpy().tobytes())
print(WIDE, digest.hexdigest())
"""


@pytest.mark.long
@pytest.mark.skipif(v8.WIDE != 16, reason="the processor has no AVX-512")
def test_pictures_and_gradients_have_the_same_bits_with_eight_and_sixteen_lanes():
    older = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma"}
    found = [
        subprocess.run(
            [sys.executable, "-c", PICTURES], cwd=ROOT, capture_output=True, text=True, check=True,
            env={**os.environ, **more},
        ).stdout.split()
        for more in ({}, older)
    ]  # fmt: skip
    assert [lanes for lanes, _ in found] == ["16", "8"]
    assert found[0][1] == found[1][1]


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


NAMED_LAYER = """
from augment.errors import BackendUnavailable
from augment.render import threads
try:
    print(threads.select_thread_pool(), end=" ")
    with threads.kernel_threads():
        print(threads.num_kernel_threads() > 0)
except BackendUnavailable as error:
    print(error)
"""


@needs_tbb
@pytest.mark.parametrize(
    ("layer", "message"),
    [("tbb", "tbb True"), ("bogus", "NUMBA_THREADING_LAYER=bogus: The threading layer requested")],
)
def test_a_layer_that_the_user_names_is_used_or_refused_in_our_words(layer: str, message: str):
    result = subprocess.run(
        [sys.executable, "-c", NAMED_LAYER], cwd=ROOT, capture_output=True, text=True, check=True,
        env={**os.environ, "NUMBA_THREADING_LAYER": layer},
    )  # fmt: skip
    assert result.stdout.startswith(message)


@needs_tbb
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="workers are forked on Linux only")
def test_workers_forked_after_the_parent_rendered():
    run(FORKED_WORKERS)


@pytest.mark.long
def test_without_tbb_callers_take_turns():
    """numba's own layer ends the process when two threads launch kernels at once."""
    assert "install the package 'tbb'" in run(ONE_CALLER).stderr


def test_limits():
    threads.limit_threads(1)
    assert threads.num_kernel_threads() == 1
    with threads.kernel_threads():
        assert numba.get_num_threads() == 1
    threads.limit_threads(10_000)
    assert threads.num_kernel_threads() == numba.get_num_threads()
    with pytest.raises(ValueError, match="count must be >= 1 thread, or None for no limit; got 0"):
        threads.limit_threads(0)


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
