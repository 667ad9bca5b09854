"""Pixels of traffic signs, which throw the own beams' light back."""

from __future__ import annotations

import numpy as np
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
    is_sign = [
        np.zeros(len(part.gaussians), bool)
        if part.gaussians.semantic is None
        else part.gaussians.semantic.cpu().numpy() == SemanticClass.SIGN
        for part in view.layers.parts
    ]
    if sum(map(len, is_sign)) == 0:
        return None
    table = np.concatenate([*is_sign, [False]])  # pixels without a splat have the index -1
    signs = table[index.cpu().numpy()]
    return signs & (alpha.detach().cpu().numpy() >= SURFACE_ALPHA)
