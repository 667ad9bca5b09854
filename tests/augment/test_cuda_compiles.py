"""Every kernel of the GPU backend compiles for a Hopper GPU, without one, into what it should."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest
import torch

from augment.render.cuda import runtime as gpu
from augment.views import render_view

pytest.importorskip("triton")
from tests.augment import compiled_kernels as kernels
from tools.gpu_kernels import complaints, record_views, report
from tools.kernel_compiling import Compiled, compile_launches
from tools.kernel_frames import RECIPES, small_scene
from tools.kernel_launches import Recording, recorded_launches

interpreted = pytest.mark.skipif(
    not gpu.is_interpreted(), reason="launches are recorded while kernels are interpreted"
)


def record_small_kernels() -> Recording:
    source, target = torch.ones(40), torch.zeros(40)
    with recorded_launches() as recording:
        for count in (1, 16, 39):
            gpu.launch(kernels.scale, (3,), source, target, count, 2.5, BLOCK=16, num_warps=1)
        assert target[:39].eq(1.25).all() and target[39] == 0  # they run all the same
        gpu.launch(kernels.scale, (1,), source[1:], target, 3, 1.0, BLOCK=16, num_warps=2)
        gpu.launch(kernels.add_wide, (1,), source, target, BLOCK=16, num_warps=1)
        gpu.launch(kernels.scale, (0,), source, target, 0, 1.0, BLOCK=64)
    return recording


@interpreted
def test_launches_are_told_apart_by_what_is_compiled_for_them():
    recording = record_small_kernels()
    assert [(each.name, n) for each, n in recording.counts.items()] == [
        ("scale", 3), ("scale", 1), ("add_wide", 1)
    ]  # fmt: skip
    assert list(recording.programs.values()) == [9, 1, 1]
    first, unaligned, _ = [each.arguments for each in recording.counts]
    assert first["source"] == {"tensor": "float32", "aligned": True} and first["BLOCK"] == 16
    assert not unaligned["source"]["aligned"] and unaligned["num_warps"] == 2


@interpreted
def test_what_is_wrong_with_a_kernel_is_seen():
    recording = record_small_kernels()
    with recorded_launches() as broken, pytest.raises(Exception, match="arange"):
        gpu.launch(kernels.broken, (1,), torch.ones(40), BLOCK=16)
    with recorded_launches() as crowded:
        many = torch.ones(2048)
        gpu.launch(kernels.crowd, (1,), many, many, BLOCK=2048, num_warps=1, maxnreg=32)
    for other in (broken, crowded):
        recording.counts |= other.counts
        recording.programs |= other.programs
    table, compiled = report(recording)
    by_name = {each.kernel.partition(":")[2]: each for each in compiled}
    good = [each for each in compiled if each.kernel.endswith(":scale")]
    assert not complaints(good) and len(good) == 2
    assert all(each.registers > 0 and each.instructions for each in good)
    assert table.count("`scale`") == 2 and "source float32 unaligned, num_warps 2" in table
    assert by_name["add_wide"].doubles > 0 and by_name["add_wide"].atomics
    assert by_name["crowd"].stack_bytes > 0
    assert "power of 2" in (by_name["broken"].error or "")
    wrong = "\n".join(complaints(compiled))
    assert all(part in wrong for part in ("does not compile", "float64", "atomics", "spills"))


def test_threads_at_once_follow_from_registers_and_shared_memory():
    assert Compiled("k", "", registers=32, warps=4).occupancy == 1
    assert Compiled("k", "", registers=33, warps=4).occupancy == 48 / 64
    assert Compiled("k", "", registers=128, warps=8).occupancy == 16 / 64
    assert Compiled("k", "", registers=16, warps=1).occupancy == 32 / 64
    assert Compiled("k", "", registers=16, shared_bytes=100 * 1024, warps=4).occupancy == 8 / 64


def test_nothing_to_compile_starts_nothing():
    assert compile_launches([]) == []


@interpreted
def test_kernels_of_views_compile_into_what_they_should():
    """One of each kernel of a few views, since compiling takes seconds; all of them below."""
    recording = record_views(["clean", "style folded into SH", "ground is seen"])
    assert {each.name for each in recording.counts} >= {
        "project_gaussians", "count_tiles", "list_pairs", "blend_blocks", "make_images", "map_sh",
        "find_seen",
    }  # fmt: skip
    compiled = compile_launches(list({each.name: each for each in recording.counts}.values()))
    assert not complaints(compiled)


@pytest.mark.gpu
def test_kernels_of_all_views_compile_into_what_they_should():
    done = subprocess.run(
        [sys.executable, "-m", "tools.gpu_kernels"], capture_output=True, text=True, check=False
    )
    if "only 0-dimensional arrays" in done.stderr:
        pytest.skip("this Triton interprets loops with older numpy only (3.6 with less than 2.4)")
    assert done.returncode == 0, done.stderr


@interpreted
def test_the_next_frame_compiles_nothing_new():
    """Counts and places that change from frame to frame are none of a kernel's constants."""
    scene = small_scene()
    camera, recipe = scene.frames[0].cameras["ahead"], RECIPES["flood, sky"]
    with recorded_launches() as first:
        render_view(scene, camera, recipe, backend="cuda")
    pose = camera.camera_from_world.clone()
    pose[:3, 3] += torch.tensor([0.2, 0.1, -0.3], dtype=torch.float64)
    later = dataclasses.replace(camera, camera_from_world=pose, timestamp_ns=10**7)
    fewer = scene.background.select(torch.arange(len(scene.background)) >= 5)
    with recorded_launches() as second:
        render_view(dataclasses.replace(scene, background=fewer), later, recipe, backend="cuda")
    assert second.counts and set(second.counts) <= set(first.counts)
