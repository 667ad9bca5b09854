"""Every kernel of the GPU backend compiles for a Hopper GPU, without one, into what it should."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections import Counter

import pytest
import torch

from augment.render.cuda import runtime as gpu
from augment.views import render_view

pytest.importorskip("triton")
from tests.augment import compiled_kernels as kernels
from tests.augment.kernel_compiling import Launch, compile_launches, complaints, recorded_launches
from tests.augment.kernel_frames import RECIPES, small_scene, views

interpreted = pytest.mark.skipif(
    not gpu.is_interpreted(), reason="launches are recorded while kernels are interpreted"
)


def record_small_kernels() -> Counter[Launch]:
    source, target = torch.ones(40), torch.zeros(40)
    with recorded_launches() as counts:
        for count in (1, 16, 39):
            gpu.launch(kernels.scale, (3,), source, target, count, 2.5, BLOCK=16, num_warps=1)
        assert target[:39].eq(1.25).all() and target[39] == 0  # they run all the same
        gpu.launch(kernels.scale, (1,), source[1:], target, 3, 1.0, BLOCK=16, num_warps=2)
        gpu.launch(kernels.add_wide, (1,), source, target, BLOCK=16, num_warps=1)
        gpu.launch(kernels.scale, (0,), source, target, 0, 1.0, BLOCK=64)
    return counts


def record_views(*names: str) -> list[Launch]:
    every = views()
    with recorded_launches() as counts:
        for name in names or every:
            every[name]()
    return [*counts]


@pytest.mark.long
@interpreted
def test_launches_are_told_apart_by_what_is_compiled_for_them():
    counts = record_small_kernels()
    assert [(each.name, n) for each, n in counts.items()] == [
        ("scale", 3), ("scale", 1), ("add_wide", 1)
    ]  # fmt: skip
    first, unaligned, _ = [each.arguments for each in counts]
    assert first["source"] == {"tensor": "float32", "aligned": True} and first["BLOCK"] == 16
    assert not unaligned["source"]["aligned"] and unaligned["num_warps"] == 2


@pytest.mark.long
@interpreted
def test_what_is_wrong_with_a_kernel_is_seen():
    with recorded_launches() as broken, pytest.raises(Exception, match="arange"):
        gpu.launch(kernels.broken, (1,), torch.ones(40), BLOCK=16)
    with recorded_launches() as crowded:
        many = torch.ones(2048)
        gpu.launch(kernels.crowd, (1,), many, many, BLOCK=2048, num_warps=1, maxnreg=32)
    compiled = compile_launches([*(record_small_kernels() | broken | crowded)])
    good = [each for each in compiled if each.kernel.endswith(":scale")]
    assert len(good) == 2 and not complaints(good) and all(each.registers for each in good)
    found = {each.kernel.partition(":")[2]: complaints([each]) for each in compiled}
    assert "does not compile" in found["broken"][0] and "power of 2" in found["broken"][0]
    assert "spills" in found["crowd"][0]
    assert "float64" in found["add_wide"][0] and "atomics" in found["add_wide"][1]


@interpreted
@pytest.mark.long
def test_kernels_of_views_compile_into_what_they_should():
    """One of each kernel of a few views, since compiling takes seconds; all of them below."""
    launches = {each.name: each for each in record_views("clean")}
    assert launches.keys() >= {"project_gaussians", "count_tiles", "list_pairs", "blend_blocks"}
    assert not complaints(compile_launches([*launches.values()]))


@pytest.mark.gpu
def test_kernels_of_all_views_compile_into_what_they_should():
    """In a process in which they are interpreted, since here they run on the GPU."""
    code = (
        "from tests.augment.test_cuda_compiles import *\n"
        "assert not (wrong := complaints(compile_launches(record_views()))), wrong"
    )
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment
    )
    if "only 0-dimensional arrays" in done.stderr:
        pytest.skip("this Triton interprets loops with older numpy only (3.6 with less than 2.4)")
    assert done.returncode == 0, done.stderr


@interpreted
@pytest.mark.long
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
    assert second and set(second) <= set(first)
