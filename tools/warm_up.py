"""Compiling what a job's recipes need before it starts, so that no image waits for it."""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch

from augment.apply import render_view
from augment.cameras import Camera
from augment.geometry import rigid
from augment.ground_heights import Ground
from augment.render import cpu
from augment.scene import Gaussians, Scene
from augment.sky import CubemapSky
from recipes.schema import Recipe

SIZE = 32  # pixels a side


def warm_up(recipes: Sequence[Recipe]) -> float:
    """Compile the CPU kernels that the recipes take, or load them; seconds it took."""
    seconds = cpu.warm_up()
    started = time.perf_counter()
    seen = set()
    for recipe in recipes:
        flood = recipe.weather.flood
        if flood is None:
            continue
        ids = recipe.output.semantic or recipe.output.instance
        kernels = (flood.reflection, recipe.output.depth, ids)
        if kernels not in seen:
            seen.add(kernels)
            render_view(_pool(flood.level_m), _camera(flood.level_m + 0.5), recipe)
    return seconds + time.perf_counter() - started


def _pool(level_z_m: float) -> Scene:
    """A splat above the water and one below it; the level counts from z = 0."""
    means = torch.tensor([[4.0, 0.0, level_z_m + 0.1], [4.0, 0.0, level_z_m - 0.1]])
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.1),
        opacities=torch.full((2,), 0.9),
        sh=torch.zeros(2, 1, 3),
    )
    sky = CubemapSky(torch.zeros(6, 2, 2, 3))
    return Scene("warm-up", "warm-up", gaussians, (), sky, (), ground=Ground(0.0, 0.0, "stated"))


def _camera(z_m: float) -> Camera:
    """Level, ahead along +x."""
    rotation = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    centre = torch.tensor([0.0, 0.0, z_m], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("warm-up", SIZE, SIZE, 20.0, 20.0, SIZE / 2, SIZE / 2, pose)
