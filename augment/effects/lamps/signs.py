"""Pixels of traffic signs, which throw the own beams' light back."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool

from augment.effects.effect import RenderedView
from augment.memo import memo_of
from augment.render.constants import SURFACE_ALPHA
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass


def has_signs(scene: Scene) -> bool:
    """Return True if the background has Gaussians of the class of signs."""
    classes = scene.background.semantic
    if classes is None:
        return False
    return memo_of(scene).get(
        ("lamps, signs",), lambda: bool((classes == SemanticClass.SIGN).any())
    )


def sign_pixels(view: RenderedView) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels whose heaviest splat is of a sign; None where the splats are not known."""
    index = view.raster.splat_ids
    alpha = view.raster.alpha
    if index is None or alpha is None:
        return None
    classes = [
        torch.zeros(len(part.gaussians), dtype=torch.int16)
        if part.gaussians.semantic is None
        else part.gaussians.semantic.cpu()
        for part in view.layers.parts
    ]
    table = torch.cat(classes) == SemanticClass.SIGN
    if len(table) == 0:
        return None
    index = index.cpu().long()
    is_surface = (index >= 0) & (alpha.detach().cpu() >= SURFACE_ALPHA)
    return (is_surface & table[index.clamp(0, len(table) - 1)]).numpy()
