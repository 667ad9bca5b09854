"""Carries out a plan: the order of the effects in plain sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.plan import Plan, make_plan
from augment.render.buffers import RenderOutput
from augment.render.composite import composite_sky, map_colors, quantise
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
from augment.semantics import SemanticClass
from augment.weather.smog import fog_buffers
from recipes.schema import Recipe

SURFACE_ALPHA = 0.5  # a pixel less covered than this shows more sky than surface: it has no depth


@dataclass(frozen=True, eq=False)
class WeatheredBuffers:
    """One finished view in floats. rgb [H, W, 3]: display-encoded, not clamped, sky included.

    depth_m [H, W]: z along the optical axis, 0 where there is no surface; None unless planned.
    """

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]


@dataclass(frozen=True, eq=False)
class FloodedView:
    """What a view's labels under water are measured from.

    level_z_m: the water's surface, scene world. scene_depth_m: float32 [H, W], z of the scene's own
    surface, seen through the water where there is some; 0 = none.
    """

    level_z_m: float
    scene_depth_m: np.ndarray


@dataclass(frozen=True, eq=False)
class WeatheredView:
    """One finished view as it is written to files.

    rgb: uint8 [H, W, 3]. depth_m: float32 [H, W], 0 = none. semantic: uint8 [H, W], SemanticClass.
    instance: uint16 [H, W], 0 = background or sky, else 1 + the actor's index in the scene.
    water: uint8 [H, W], 255 where a ray meets water first, else 0; None where the recipe has no
    flood. flood: None where no water is in view.
    """

    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray | None
    semantic: np.ndarray | None
    instance: np.ndarray | None
    water: np.ndarray | None = None
    flood: FloodedView | None = None


def render_view(
    scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = "auto"
) -> WeatheredView:
    """The view of `camera` (before recipe.render.scale) under the recipe's weather, in 8 bits."""
    plan = make_plan(recipe, scene)
    buffers = render_buffers(scene, camera.scaled(recipe.render.scale), plan, backend=backend)
    semantic = instance = None
    if plan.semantic:
        semantic = _look_up(
            buffers.raster, semantic_table(buffers.parts), int(SemanticClass.SKY), np.uint8
        )
    if plan.instance:
        instance = _look_up(buffers.raster, instance_table(buffers.parts), 0, np.uint16)
    return WeatheredView(
        camera=buffers.camera,
        rgb=quantise(buffers.rgb),
        depth_m=None if buffers.depth_m is None else buffers.depth_m.float().numpy(),
        semantic=semantic,
        instance=instance,
    )


def render_buffers(
    scene: Scene, camera: Camera, plan: Plan, *, backend: str = "auto"
) -> WeatheredBuffers:
    """The view of `camera` at its own resolution, as floats."""
    parts = scene.parts_for(camera)
    raster = rasterize(
        parts,
        camera,
        buffers=plan.buffers,
        settings=plan.settings,
        smog=plan.smog_in_splats,
        backend=backend,
    )
    assert raster.rgb is not None and raster.alpha is not None
    rgb = raster.rgb
    if plan.smog_on_buffers is not None:
        rgb = _fog_on_buffers(raster, camera, plan)
    rgb = composite_sky(
        rgb, raster.alpha, camera, scene.sky, smog=plan.smog, fast=backend != "reference"
    )
    color_map = scene.color_map(camera.name) if plan.recorded_exposure else None
    if color_map is not None:  # a camera exposes what the weather has left, so this comes last
        rgb = map_colors(rgb, color_map, fast=backend != "reference")
    depth = None
    if plan.depth_buffer is not None:
        z = getattr(raster, plan.depth_buffer)
        depth = torch.where(raster.alpha >= SURFACE_ALPHA, z, torch.zeros_like(z))
    return WeatheredBuffers(camera, rgb, raster, depth, parts)


def _fog_on_buffers(raster: RenderOutput, camera: Camera, plan: Plan) -> Tensor:
    smog = plan.smog_on_buffers
    assert smog is not None and raster.rgb is not None
    assert raster.alpha is not None and raster.expected_depth is not None
    depth = raster.expected_depth
    ray_distance = depth * camera.ray_lengths(depth.dtype)
    eye_z_m = float(camera.centre[2])
    point_z_m = None
    if smog.scale_height_m is not None:
        point_z_m = eye_z_m + depth * camera.ray_directions(depth.dtype)[..., 2]
    return fog_buffers(raster.rgb, raster.alpha, ray_distance, smog, eye_z_m, point_z_m)


def semantic_table(parts: tuple[PosedGaussians, ...]) -> np.ndarray:
    """int16 [total splats]: the class of every splat, in the order splat_ids counts them."""
    return np.concatenate([
        np.zeros(len(p.gaussians), np.int16)
        if p.gaussians.semantic is None
        else p.gaussians.semantic.numpy()
        for p in parts
    ])  # fmt: skip


def instance_table(parts: tuple[PosedGaussians, ...]) -> np.ndarray:
    """uint16 [total splats]: the instance of every splat, in the order splat_ids counts them."""
    counts = [len(p.gaussians) for p in parts]
    return np.repeat(np.array([p.instance_id for p in parts], np.uint16), counts)


def _look_up(raster: RenderOutput, table: np.ndarray, none: int, dtype: type) -> np.ndarray:
    assert raster.splat_ids is not None and raster.alpha is not None
    index = raster.splat_ids.numpy()
    seen = (index >= 0) & (raster.alpha.numpy() >= SURFACE_ALPHA)
    return np.where(seen, table[np.maximum(index, 0)], none).astype(dtype)
