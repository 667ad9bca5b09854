"""A view's buffers into images as files hold them: 8 bits, depth, classes, instances, masks.

On a GPU they are made there, and nobody waits for their copies before they are needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.plan import Plan
from augment.render.buffers import RenderOutput
from augment.render.composite import to_bytes
from augment.render.cuda.runtime import download, resident
from augment.scene import PosedGaussians
from augment.semantics import SemanticClass
from augment.timing import timed

if TYPE_CHECKING:
    from augment.views import WeatheredBuffers

SURFACE_ALPHA = 0.5  # a pixel less covered than this shows more sky than surface: it has no depth
_MASK = "mask "


@dataclass(frozen=True, eq=False)
class ViewImages:
    """As the fields of `augment.views.WeatheredView`; masks: those that the buffers have.
    scene_depth_m: float32 [H, W], the buffers' depth, where labels need it.
    """

    rgb: np.ndarray
    depth_m: np.ndarray | None = None
    semantic: np.ndarray | None = None
    instance: np.ndarray | None = None
    scene_depth_m: np.ndarray | None = None
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)


def begin_images(view: WeatheredBuffers, plan: Plan) -> Callable[[], ViewImages]:
    """The images that the plan asks for; what is returned waits for those on a GPU."""
    images = download({n: i for n, i in _make_images(view, plan).items() if i is not None})

    def finish() -> ViewImages:
        found = images()
        masks = {name: found.pop(_MASK + name) for name in view_masks}
        return ViewImages(masks=masks, **found)

    view_masks = tuple(view.masks)  # and not the buffers, which the images may long outlive
    return finish


def _make_images(view: WeatheredBuffers, plan: Plan) -> dict[str, Tensor | None]:
    """Fields of ViewImages, where the buffers lie."""
    shown = view.bare or view
    paints_boxes = plan.instance and plan.finds_boxes  # by depth and class of what is shown
    shows_depth = plan.depth_buffer is not None or (paints_boxes and view.bare is not None)
    fronts = [
        (view.masks[mask], own.effect.front_surface(own, view.camera))
        for own in view.plan.effects
        if plan.shows_first and (mask := own.effect.mask) in view.masks and mask
    ]
    device, depth = view.rgb.device, shown.depth_m if shows_depth else None
    semantic = instance = None
    if plan.semantic or paints_boxes:
        with timed("semantic image"):
            table = _semantic_table(shown.parts, device)
            semantic = _look_up(shown.raster, table, int(SemanticClass.SKY))
    if plan.instance:
        with timed("instance image"):
            instance = _look_up(shown.raster, _instance_table(shown.parts, device), 0)
    for mask, front in fronts:
        if front is None:
            continue
        semantic = None if semantic is None else semantic.masked_fill(mask, front.semantic)
        instance = None if instance is None else instance.masked_fill(mask, 0)
        if depth is not None:
            with timed("depth image"):
                there = torch.zeros_like(depth) if front.depth_m is None else front.depth_m
                depth = torch.where(mask, there.to(depth), depth)
    with timed("8 bits"):
        rgb = to_bytes(view.rgb)
    return {
        "rgb": rgb,
        "depth_m": _floats(depth),
        "semantic": None if semantic is None else semantic.to(torch.uint8),
        "instance": None if instance is None else instance.to(torch.int16).view(torch.uint16),
        "scene_depth_m": _floats(view.depth_m) if plan.finds_boxes else None,
        **{_MASK + name: mask.to(torch.uint8) * 255 for name, mask in view.masks.items()},
    }


def _floats(image: Float[Tensor, "H W"] | None) -> Float[Tensor, "H W"] | None:
    return None if image is None else image.float()


def _semantic_table(parts: tuple[PosedGaussians, ...], device: torch.device) -> Tensor:
    """int16 [total splats]: the class of every splat, in the order splat_ids counts them."""
    classes = [p.gaussians.semantic for p in parts]
    return torch.cat([
        torch.zeros(len(p.gaussians), dtype=torch.int16, device=device)
        if own is None
        else own if own.device == device else resident(own)
        for p, own in zip(parts, classes, strict=True)
    ])  # fmt: skip


def _instance_table(parts: tuple[PosedGaussians, ...], device: torch.device) -> Tensor:
    """int32 [total splats]: the instance of every splat's part."""
    counts = [len(part.gaussians) for part in parts]
    own = torch.tensor([[part.instance_id for part in parts], counts], dtype=torch.int32)
    own = own.to(device)
    return torch.repeat_interleave(own[0], own[1], output_size=sum(counts))


def _look_up(raster: RenderOutput, table: Tensor, none: int) -> Tensor:
    index = raster.splat_ids
    assert index is not None
    if len(table) == 0:  # no part has a splat: an empty background, and actors that are not there
        return torch.full_like(index, none)
    return torch.where(_is_surface(raster), table[index.clamp_min(0)], none)


def _is_surface(raster: RenderOutput) -> Tensor:
    assert raster.splat_ids is not None and raster.alpha is not None
    return (raster.splat_ids >= 0) & (raster.alpha.detach() >= SURFACE_ALPHA)
