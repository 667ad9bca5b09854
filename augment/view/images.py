"""Conversion of a view's float buffers into images as files hold them.

In: `WeatheredBuffers` and the plan. Out: `ViewImages`: 8-bit colours, depth, classes, instances and
masks as NumPy arrays. On a GPU the images are made there, and their copies to the CPU are waited
for only when they are needed. `augment.view.render_view` is the caller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.render.buffers import RenderOutput
from augment.render.composite import to_bytes
from augment.render.constants import SURFACE_ALPHA
from augment.render.cuda.runtime import download, gpu_copy
from augment.scene.scene import PosedGaussians
from augment.scene.semantics import SemanticClass
from augment.timing import timed
from augment.view.plan import Plan
from augment.view.results import WeatheredBuffers

_MASK = "mask "
"""Prefix that tells masks from the other images among the downloaded ones."""


@dataclass(frozen=True, eq=False)
class ViewImages:
    """Images of one view, as the fields of `augment.view.results.WeatheredView`."""

    rgb: np.ndarray
    """The picture, uint8 [H, W, 3]."""
    depth_m: np.ndarray | None = None
    """Depth, float32 [H, W], metres, 0 = none; None unless needed."""
    semantic: np.ndarray | None = None
    """SemanticClass of each pixel, uint8 [H, W]; None unless needed."""
    instance: np.ndarray | None = None
    """Instance of each pixel, uint16 [H, W]; None unless planned."""
    scene_depth_m: np.ndarray | None = None
    """The depth in the buffers, float32 [H, W], where labels are measured from it."""
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Masks of the effects in view, by name, uint8 [H, W], 0 or 255."""
    luminance_cd_m2: np.ndarray | None = None
    """Luminance of the picture, float32 [H, W]; None where no effect measures it."""


def start_images(view: WeatheredBuffers, plan: Plan) -> Callable[[], ViewImages]:
    """Begin the images that the plan asks for, and return a function that waits for them.

    Args:
        view: the buffers of the view.
        plan: the plan, which says which images are needed.
    """
    images = download({n: i for n, i in _make_images(view, plan).items() if i is not None})

    def finish() -> ViewImages:
        fields = images()
        masks = {name: fields.pop(_MASK + name) for name in view_masks}
        return ViewImages(masks=masks, **fields)

    # `finish` holds the names and not the buffers, which the images may long outlive.
    view_masks = tuple(view.masks)
    return finish


def _make_images(view: WeatheredBuffers, plan: Plan) -> dict[str, Tensor | None]:
    """Return the fields of ViewImages as tensors, on the device of the buffers."""
    label_surface = view.bare_buffers or view
    paints_boxes = plan.has_instance and plan.finds_boxes  # by depth and class of what is shown
    shows_depth = plan.depth_buffer is not None or (paints_boxes and view.bare_buffers is not None)
    fronts = [
        (view.masks[mask], effect.hooks.front_surface(effect, view.camera))
        for effect in view.plan.effects
        if plan.shows_first_hit and (mask := effect.hooks.mask_name) in view.masks and mask
    ]
    device = view.rgb.device
    depth = label_surface.depth_m if shows_depth else None
    semantic = None
    instance = None
    if plan.has_semantic or paints_boxes:
        with timed("semantic image"):
            table = _semantic_table(label_surface.parts, device)
            semantic = _look_up(label_surface.raster, table, int(SemanticClass.SKY))
    if plan.has_instance:
        with timed("instance image"):
            instance = _look_up(
                label_surface.raster, _instance_table(label_surface.parts, device), 0
            )
    for mask, front in fronts:
        if front is None:
            continue
        semantic = None if semantic is None else semantic.masked_fill(mask, front.semantic_class)
        instance = None if instance is None else instance.masked_fill(mask, 0)
        if depth is not None:
            with timed("depth image"):
                front_depth = torch.zeros_like(depth) if front.depth_m is None else front.depth_m
                depth = torch.where(mask, front_depth.to(depth), depth)
    with timed("8 bits"):
        rgb = to_bytes(view.rgb)
    return {
        "rgb": rgb,
        "depth_m": _floats(depth),
        "semantic": None if semantic is None else semantic.to(torch.uint8),
        "instance": None if instance is None else instance.to(torch.int16).view(torch.uint16),
        "scene_depth_m": _floats(view.depth_m) if plan.finds_boxes else None,
        "luminance_cd_m2": _floats(view.luminance_cd_m2),
        **{_MASK + name: mask.to(torch.uint8) * 255 for name, mask in view.masks.items()},
    }


def _floats(image: Float[Tensor, "H W"] | None) -> Float[Tensor, "H W"] | None:
    """Return the image as float32; None stays None."""
    return None if image is None else image.float()


def _semantic_table(parts: tuple[PosedGaussians, ...], device: torch.device) -> Tensor:
    """Return the class of every splat, int16 [total splats], in the order of splat_ids."""
    classes = [p.gaussians.semantic for p in parts]
    return torch.cat(
        [
            torch.zeros(len(p.gaussians), dtype=torch.int16, device=device)
            if part_classes is None
            else part_classes
            if part_classes.device == device
            else gpu_copy(part_classes)
            for p, part_classes in zip(parts, classes, strict=True)
        ]
    )


def _instance_table(parts: tuple[PosedGaussians, ...], device: torch.device) -> Tensor:
    """Return the instance id of every splat's part, int32 [total splats]."""
    counts = [len(part.gaussians) for part in parts]
    ids_and_counts = torch.tensor([[part.instance_id for part in parts], counts], dtype=torch.int32)
    ids_and_counts = ids_and_counts.to(device)
    return torch.repeat_interleave(ids_and_counts[0], ids_and_counts[1], output_size=sum(counts))


def _look_up(raster: RenderOutput, table: Tensor, default: int) -> Tensor:
    """Return the table's value for the heaviest splat of each surface pixel, else `default`."""
    index = raster.splat_ids
    assert index is not None
    if len(table) == 0:  # no part has a splat: an empty background, and actors that are not there
        return torch.full_like(index, default)
    return torch.where(_is_surface(raster), table[index.clamp_min(0)], default)


def _is_surface(raster: RenderOutput) -> Tensor:
    """Return the mask of pixels that have a splat and show more surface than sky."""
    assert raster.splat_ids is not None and raster.alpha is not None
    return (raster.splat_ids >= 0) & (raster.alpha.detach() >= SURFACE_ALPHA)
