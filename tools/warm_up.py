"""Kernels of recipes: compiled, or loaded, by drawing a tiny scene before a job begins."""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from augment import effects
from augment.render.backends import renders_on_gpu
from augment.render.buffers import CPU, CUDA
from augment.render.cuda.runtime import is_interpreted
from augment.scene.boxes import WorldBoxes, find_occlusion
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Gaussians, Ground, Scene
from augment.scene.sky import CubemapSky
from augment.view.box_labels import uses_boxes
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from augment.view.weathered_sweep import weathered_sweep
from recipes.moment import ANY_DRIVE
from recipes.schema import Recipe
from tools.output import compiling_noted
from tools.pictures import write_rgb

# Of the scene that kernels are compiled with.
SIZE = 32  # pixels a side
ACROSS = 10  # the number of the road's splats to each side
SPACING_M = 0.1  # the distance between two of these splats, in metres


def warm_up(recipes: Sequence[Recipe], backend: str = CPU) -> None:
    """Compile the kernels that the recipes take at any time, or load them."""
    recipes = [state for recipe in recipes for state in recipe.over_time(ANY_DRIVE)]
    if not renders_on_gpu(backend):
        _warm_recipes(recipes)
    elif not is_interpreted():  # there is nothing to compile then, and drawing takes long
        _warm_recipes(recipes, CUDA)


def warm_up_for_workers(recipes: Sequence[Recipe], backend: str) -> None:
    """Compile kernels for other processes, which find them in the caches on disk. See `warm_up`.

    A GPU is used in a process of its own: this one would hold a part of its memory until it ends.
    """
    on_gpu = renders_on_gpu(backend)
    with compiling_noted(kernel_modules(recipes, backend), on_gpu=on_gpu):
        if not on_gpu:
            warm_up(recipes)
            return
        spawn = multiprocessing.get_context("spawn")
        process = spawn.Process(target=warm_up, args=(recipes, backend))
        process.start()
        process.join()


def kernel_modules(
    recipes: Sequence[Recipe], backend: str = CPU, *, of_street: bool = False
) -> list[str]:
    """How the names of modules begin that hold the recipes' kernels for the CPU. of_street: and
    those that build the procedural street.
    """
    street = ["adapters.street"] if of_street else []
    if renders_on_gpu(backend):
        return street
    present_effects = [
        e for e in effects.EFFECTS if any(e.section_of(recipe) is not None for recipe in recipes)
    ]
    folders = {
        folder
        for effect in present_effects
        for folder in (type(effect).__module__.removesuffix(".effect"), *effect.kernel_folders)
    }
    pictures = (f"augment.render.{name}" for name in ("cpu", "composite_kernels"))
    passes = ["augment.render.picture_kernels"] if any(map(_alters_picture, recipes)) else []
    if any(map(_has_banks, recipes)):
        passes.append("augment.render.fog_bank_kernels")
    return [*street, "augment.scene", *pictures, *passes, *sorted(folders)]


def _has_banks(recipe: Recipe) -> bool:
    return recipe.weather.smog is not None and recipe.weather.smog.patchiness > 0


def _alters_picture(recipe: Recipe) -> bool:
    """True if airlight by elevation, scatter or a camera's noise pass over the recipe's picture."""
    smog = recipe.weather.smog
    of_smog = smog is not None and (smog.scatter > 0 or smog.overcast > 0)
    return recipe.camera.noise > 0 or of_smog


def _warm_recipes(recipes: Sequence[Recipe], backend: str = CPU) -> None:
    kernel_sets = set()
    if any(uses_boxes(recipe) for recipe in recipes):
        no_boxes = WorldBoxes.from_labels(Boxes.empty(), np.zeros(3))
        find_occlusion(no_boxes, _camera(1.0), np.zeros((SIZE, SIZE), np.float32))
    for recipe in recipes:
        output = recipe.output
        sections = ((effect, effect.section_of(recipe)) for effect in effects.EFFECTS)
        effect_kernels = tuple(
            e.kernel_key(section) if section is not None else None for e, section in sections
        )
        for_boxes = uses_boxes(recipe) and output.depth == "none"
        ids = output.semantic or output.instance
        base = recipe.render.base
        kernels = (
            *effect_kernels,
            base,
            output.depth,
            ids,
            output.surface,
            for_boxes,
            recipe.lidar,
        )
        if kernels not in kernel_sets:
            kernel_sets.add(kernels)
            with tempfile.NamedTemporaryFile(suffix=".png") as photo:
                write_rgb(Path(photo.name), np.zeros((SIZE, SIZE, 3), np.uint8))
                _warm_recipe(recipe, photo.name, backend)


def _warm_recipe(recipe: Recipe, photo: str, backend: str) -> None:
    scene = _warm_up_scene(0.0, photo, with_labels=False)
    effect_plans = make_plan(recipe, scene).effect_plans.values()
    level_z_m = next((p.water_level_z_m for p in effect_plans if p.water_level_z_m), 0.0)
    scene = _warm_up_scene(level_z_m, photo, with_labels=recipe.output.labels)
    render_view(scene, scene.frames[0].cameras["warm-up"], recipe, backend=backend)
    if recipe.lidar == "weather":
        weathered_sweep(scene, recipe, 0, _one_return(level_z_m))


def _warm_up_scene(level_z_m: float, photo: str, *, with_labels: bool) -> Scene:
    """Return a scene of a level road above a flood's surface, and a splat below it."""
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
    world_from_ego = torch.eye(4, dtype=torch.float64)
    frame = Frame(0, 0, world_from_ego, {camera.name: camera}, {camera.name: photo})
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
    """An empty set of labels, so that everything that labels need is drawn."""

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return None


def _one_return(z_m: float) -> LidarSweep:
    """Return a sweep with one return, from the road ahead."""
    return LidarSweep({"x": np.array([4.0]), "y": np.array([0.0]), "z": np.array([z_m])})


def _camera(z_m: float) -> Camera:
    """Return a level camera that looks ahead along +x."""
    rotation = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    centre = torch.tensor([0.0, 0.0, z_m], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("warm-up", SIZE, SIZE, 20.0, 20.0, SIZE / 2, SIZE / 2, pose)
