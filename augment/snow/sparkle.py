"""Crystals on snow that throw the sun at a camera: glints, which come and go as it moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from augment.render.sh import SH_C0
from augment.scene import Gaussians
from augment.semantics import SemanticClass

FARTHEST_M = 15.0  # from the camera: glints fade until there
LEAN_DEG = 45.0  # farthest that a crystal's mirror leans from the snow's normal
LOBE_DEG = 4.5  # how far a mirror may be off what throws the sun at the camera
SIZE_M = 0.0015  # standard deviation of a glint
LIFTED = 2.0  # height over a disc's middle, in its thickness
WIDEST_M = 0.15  # discs larger than this are too far for any glint
DULL = 0.02  # less difference of lit and shaded snow shows no glints
UNIT_GAIN = 0.3  # difference that makes glints of full strength


@dataclass(frozen=True, eq=False)
class Crystals:
    """G crystals that may glint. places_m [G, 3], mirrors [G, 3] (unit): in the part's frame.

    strength: of their light, 0 to 1.
    """

    places_m: Float32[Tensor, "G 3"]
    mirrors: Float32[Tensor, "G 3"]
    strength: float

    def glints(self, sun: Float[Tensor, "3"], eye_m: Float[Tensor, "3"]) -> Gaussians | None:
        """Small bright Gaussians where a mirror throws the sun into the eye; None without any.

        sun: unit, towards it. eye_m: the camera's centre. Both in the part's frame.
        """
        eye, towards_sun = eye_m.float(), sun.float()
        near = ((self.places_m - eye).abs().amax(1) < FARTHEST_M).nonzero()[:, 0]
        places, mirrors = self.places_m[near], self.mirrors[near]
        views = eye - places
        distances = views.norm(dim=1).clamp_min(1e-6)
        halves = views / distances[:, None] + towards_sun
        halves = halves / halves.norm(dim=1, keepdim=True).clamp_min(1e-6)
        lobe = 1 - math.cos(math.radians(LOBE_DEG))
        off = (1 - (halves * mirrors).sum(1)) / lobe  # 0: exactly; 1: at the lobe's rim
        power = self.strength * (1 - off) * (1 - distances / FARTHEST_M)
        shown = power > 0.02
        count = int(shown.sum())
        if count == 0:
            return None
        return Gaussians(
            means=places[shown],
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            scales=torch.full((count, 3), SIZE_M),
            opacities=power[shown].clamp(0, 1),
            sh=torch.full((count, 1, 3), 0.5 / SH_C0),  # white
            semantic=torch.full((count,), int(SemanticClass.SNOW), dtype=torch.int16),
        )


def crystals_of(
    gaussians: Gaussians,
    normals: Float32[Tensor, "S 3"],
    rises: float,
    sparkle: float,
    rng: np.random.Generator,
) -> Crystals | None:
    """Crystals on `sparkle` of the discs; None where the light makes no glints.

    normals: of the discs. rises: by how much snow in the sun is brighter than in shade.
    """
    strength = min((rises - DULL) / UNIT_GAIN, 1.0)
    if strength <= 0:
        return None
    draws = torch.from_numpy(rng.random((5, len(gaussians)), np.float32))
    kept = (draws[0] < sparkle) & (gaussians.scales[:, :2].amax(1) < WIDEST_M)
    draws, normals = draws[:, kept], normals[kept]
    # Even over the cap of directions that lean at most LEAN_DEG.
    up = 1 - draws[1] * (1 - math.cos(math.radians(LEAN_DEG)))
    around, flat = 2 * math.pi * draws[2], (1 - up * up).clamp_min(0).sqrt()
    leaning = torch.stack([flat * around.cos(), flat * around.sin(), up], 1)
    mirrors = leaning + normals - torch.tensor([0.0, 0.0, 1.0])
    mirrors = mirrors / mirrors.norm(dim=1, keepdim=True).clamp_min(1e-6)
    spread = gaussians.scales[kept, 1:2]
    lifted = normals * (LIFTED * gaussians.scales[kept, 2:3])
    beside = torch.stack([draws[3] - 0.5, draws[4] - 0.5, torch.zeros_like(up)], 1) * spread
    return Crystals(gaussians.means[kept] + lifted + beside, mirrors, strength)
