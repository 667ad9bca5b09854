"""The images of a finished view as files hold them: 8 bits, depth, classes, instances and masks.

On the CPU they are made here, image by image. On a GPU one kernel makes all of them, and one copy
brings them back (augment.render.cuda_images).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.plan import Plan
from augment.render.backends import CUDA, kernels_for
from augment.render.buffers import RenderOutput
from augment.render.composite import quantise
from augment.scene import PosedGaussians
from augment.semantics import SemanticClass
from augment.stopwatch import lap
from augment.views import SURFACE_ALPHA, WeatheredBuffers
from augment.weather.water_plane import plane_depth


@dataclass(frozen=True, eq=False)
class ViewImages:
    """rgb, depth_m, semantic, instance: as those of WeatheredView. water, snow: uint8 [H, W], 255
    where the buffers of these names are true, None where there are none. scene_depth_m: float32
    [H, W], the buffers' depth, where labels need it.
    """

    rgb: np.ndarray
    depth_m: np.ndarray | None = None
    semantic: np.ndarray | None = None
    instance: np.ndarray | None = None
    water: np.ndarray | None = None
    snow: np.ndarray | None = None
    scene_depth_m: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Wanted:
    """What of a view's buffers becomes images.

    shown: the surfaces that depth, semantic and instance images show, and the parts that its
    splat_ids count through. first: pixels in which these images show the water instead.
    plane_z_m: the water's surface, scene world, if an eye in the air sees it there; None leaves the
    depth of such pixels 0. semantic, instance, depth_m, scene_depth_m: whether, or of what.
    """

    rgb: Float[Tensor, "H W 3"]
    shown: RenderOutput
    parts: tuple[PosedGaussians, ...]
    semantic: bool
    instance: bool
    depth_m: Float[Tensor, "H W"] | None
    scene_depth_m: Float[Tensor, "H W"] | None
    first: Tensor | None
    plane_z_m: float | None
    water: Tensor | None
    snow: Tensor | None


def begin_images(view: WeatheredBuffers, plan: Plan, *, backend: str) -> Callable[[], ViewImages]:
    """The images that the plan asks for, of buffers that lie where the backend leaves them. What is
    returned waits for them, where there is something to wait for.
    """
    wanted = _wanted(view, plan)
    if kernels_for(backend, wanted.rgb.detach()) == CUDA:
        from augment.render.cuda_images import begin_cuda_images

        with lap("images"):
            return begin_cuda_images(wanted, view.camera)
    images = _images(wanted, view)
    return lambda: images


def _wanted(view: WeatheredBuffers, plan: Plan) -> Wanted:
    shown = view.bare or view  # the scene's surfaces that the other images show
    first = view.water if plan.shows_water else None
    in_air = plan.flood is not None and float(view.camera.centre[2]) > plan.flood.level_z_m
    paints_boxes = plan.instance and plan.finds_boxes  # by depth and class of what is shown
    shows_depth = plan.depth_buffer is not None or (paints_boxes and view.bare is not None)
    return Wanted(
        rgb=view.rgb,
        shown=shown.raster,
        parts=shown.parts,
        semantic=plan.semantic or paints_boxes,
        instance=plan.instance,
        depth_m=shown.depth_m if shows_depth else None,
        scene_depth_m=view.depth_m if plan.finds_boxes else None,
        first=first,
        plane_z_m=plan.flood.level_z_m if plan.flood is not None and in_air else None,
        water=view.water,
        snow=view.snow,
    )


def _images(wanted: Wanted, view: WeatheredBuffers) -> ViewImages:
    """The definition, on the CPU."""
    semantic = instance = depth = None
    first, parts = wanted.first, wanted.parts
    if wanted.semantic:
        with lap("semantic image"):
            table = semantic_table(parts)
            semantic = _look_up(wanted.shown, table, int(SemanticClass.SKY), np.uint8)
            if first is not None:
                semantic[first.numpy()] = int(SemanticClass.WATER)
    if wanted.instance:
        with lap("instance image"):
            instance = _look_up(wanted.shown, instance_table(parts), 0, np.uint16)
            if first is not None:
                instance[first.numpy()] = 0
    if wanted.depth_m is not None:
        depth = wanted.depth_m
        if first is not None:
            with lap("depth image"):
                surface = torch.zeros_like(depth)
                if wanted.plane_z_m is not None:
                    surface = plane_depth(view.camera, wanted.plane_z_m).to(depth.dtype)
                depth = torch.where(first, surface, depth)
    with lap("8 bits"):
        rgb = quantise(wanted.rgb)
    return ViewImages(
        rgb=rgb,
        depth_m=_floats(depth),
        semantic=semantic,
        instance=instance,
        water=_mask(wanted.water),
        snow=_mask(wanted.snow),
        scene_depth_m=_floats(wanted.scene_depth_m),
    )


def _floats(image: Tensor | None) -> np.ndarray | None:
    return None if image is None else image.detach().float().numpy()


def _mask(shown: Tensor | None) -> np.ndarray | None:
    """uint8 [H, W]: 255 where `shown`, else 0."""
    return None if shown is None else shown.numpy().astype(np.uint8) * np.uint8(255)


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
    if len(table) == 0:  # no part has a splat: an empty background, and actors that are not there
        return np.full(index.shape, none, dtype)
    seen = (index >= 0) & (raster.alpha.detach().numpy() >= SURFACE_ALPHA)
    return np.where(seen, table[np.maximum(index, 0)], none).astype(dtype)
