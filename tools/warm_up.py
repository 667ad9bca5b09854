"""Compiling what a job's recipes need before it starts, so that no image waits for it."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch

from augment.boxes import PlacedBoxes, find_occlusion
from augment.cameras import Camera, Frame
from augment.effects.lidar.beam import weathered_sweep
from augment.geometry import rigid
from augment.ground_heights import Ground
from augment.jobs.backends import renders_on_gpu
from augment.jobs.files import uses_boxes
from augment.labels import Boxes, LidarSweep
from augment.render.buffers import CPU, CUDA
from augment.render.cpu import driver as cpu
from augment.render.cuda.runtime import is_interpreted
from augment.render.threads import thread_count
from augment.scene import Gaussians, Scene
from augment.sky import CubemapSky
from augment.views import render_view
from recipes.schema import Recipe

SIZE = 32  # pixels a side
ACROSS, SPACING_M = 10, 0.1  # splats of the road to each side, and between them


def warm_up(recipes: Sequence[Recipe], backend: str = CPU) -> float:
    """Compile the kernels that the recipes take, or load them; seconds it took."""
    if not renders_on_gpu(backend):
        seconds = cpu.warm_up()
        started = time.perf_counter()
        _warm_recipes(recipes)
        return seconds + time.perf_counter() - started
    if is_interpreted():  # there is nothing to compile, and drawing takes long
        return 0.0
    started = time.perf_counter()
    _warm_recipes(recipes, CUDA)
    return time.perf_counter() - started


def warm_up_for_workers(recipes: Sequence[Recipe], backend: str) -> float:
    """As `warm_up`, for other processes, which find what was compiled in the caches on the disk.

    A GPU is used in a process of its own: this one would hold a part of its memory until it ends.
    """
    if not renders_on_gpu(backend):
        return warm_up(recipes)
    started = time.perf_counter()
    process = multiprocessing.get_context("spawn").Process(target=warm_up, args=(recipes, backend))
    process.start()
    process.join()
    return time.perf_counter() - started


@contextmanager
def warming_up_beside(recipes: Sequence[Recipe]) -> Iterator[None]:
    """Meanwhile a second process compiles for the last recipes first, where there is a core for it.

    numba compiles one kernel at a time in a process, and finds in its cache what another process
    has compiled: `warm_up` in this one goes on from the first recipe until they meet.
    """
    if thread_count() < 2:
        yield
        return
    spawn = multiprocessing.get_context("spawn")
    beside = spawn.Process(target=_warm_recipes, args=(recipes[::-1],), daemon=True)
    beside.start()
    try:
        yield
        beside.join()
    finally:
        beside.kill()


def _warm_recipes(recipes: Sequence[Recipe], backend: str = CPU) -> None:
    seen = set()
    if any(uses_boxes(recipe) for recipe in recipes):
        nothing = PlacedBoxes.of(Boxes.empty(), np.zeros(3))
        find_occlusion(nothing, _camera(1.0), np.zeros((SIZE, SIZE), np.float32))
    for recipe in recipes:
        flood, snow, output = recipe.weather.flood, recipe.weather.snow, recipe.output
        style = recipe.style if recipe.style and recipe.style.changes else None
        is_clear = flood is None and snow is None and style is None
        for_boxes = uses_boxes(recipe) and output.depth == "none"
        if is_clear and not for_boxes and backend == CPU:  # `cpu.warm_up` has drawn one
            continue
        ids = output.semantic or output.instance
        water, light = flood and flood.reflection, snow and snow.shading
        style_parts = style and (style.applied_to, style.method)
        shown = (output.depth, ids, output.surface, for_boxes)
        kernels = (water, light, *shown, style_parts, recipe.lidar)
        if kernels not in seen:
            seen.add(kernels)
            level_z_m = 0.0 if flood is None else flood.level_m
            scene = _warm_up_scene(level_z_m, with_labels=output.labels)
            render_view(scene, scene.frames[0].cameras["warm-up"], recipe, backend=backend)
            if recipe.lidar == "weather":
                weathered_sweep(scene, recipe, 0, _one_return(level_z_m))


def _warm_up_scene(level_z_m: float, *, with_labels: bool) -> Scene:
    """A level road above a flood's surface, and a splat below it; the level counts from z = 0."""
    across = torch.arange(-ACROSS, ACROSS + 1) * SPACING_M
    x, y = torch.meshgrid(across + 4, across, indexing="ij")
    road = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), level_z_m + 0.1)], 1)
    means = torch.cat([road, torch.tensor([[4.0, 0.0, level_z_m - 0.1]])])
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(len(means), 1),
        scales=torch.tensor([[SPACING_M, SPACING_M, 0.02]]).repeat(len(means), 1),
        opacities=torch.full((len(means),), 0.9),
        sh=torch.zeros(len(means), 1, 3),
    )
    sky = CubemapSky(torch.zeros(6, 2, 2, 3))
    camera = _camera(level_z_m + 1.0)
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {camera.name: camera})
    return Scene(
        "warm-up",
        "warm-up",
        gaussians,
        (),
        sky,
        (frame,),
        labels=_NoLabels() if with_labels else None,
        ground_z_m=0.0,  # smog that thins with height asks for it
        ground=Ground(0.0, 0.0, "stated"),
    )


class _NoLabels:
    """Labels of which there are none: what is drawn for labels' sake is drawn."""

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return None


def _one_return(z_m: float) -> LidarSweep:
    """Of the road, ahead."""
    return LidarSweep({"x": np.array([4.0]), "y": np.array([0.0]), "z": np.array([z_m])})


def _camera(z_m: float) -> Camera:
    """Level, ahead along +x."""
    rotation = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    centre = torch.tensor([0.0, 0.0, z_m], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("warm-up", SIZE, SIZE, 20.0, 20.0, SIZE / 2, SIZE / 2, pose)
