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
LOBE_DEG = 9.0  # how far a mirror may be off what throws the sun at the camera
LEAST = 0.02  # opacity below which a glint is none
SIZE_M = 0.002  # standard deviation of a glint
LIFTED = 4.0  # height over a disc's middle, in its thickness
PER_DISC = 2  # crystals at most
WIDEST_M = 0.15  # discs larger than this are too far for any glint
DULL, STRONG = 0.02, 0.25  # by how much lit snow outshines shaded snow where glints begin, are full
CLEAN = 0.9  # of the usual brightness: packed and shaded snow below it shows none


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
        # numpy, since starting threads would take longer than the arithmetic on one part's crystals
        eye, towards_sun = eye_m.numpy().astype(np.float32), sun.numpy().astype(np.float32)
        places = self.places_m.numpy()
        near = np.flatnonzero(np.abs(places[:, 0] - eye[0]) < FARTHEST_M)
        views = eye - places[near]
        distances = np.maximum(np.sqrt((views * views).sum(1)), np.float32(1e-6))
        halves = views / distances[:, None] + towards_sun
        lengths = np.maximum(np.sqrt((halves * halves).sum(1)), np.float32(1e-6))
        aligned = (halves * self.mirrors.numpy()[near]).sum(1) / lengths
        off = (1 - aligned) / (1 - math.cos(math.radians(LOBE_DEG)))  # 1 at the lobe's rim
        power = self.strength * np.sqrt(np.maximum(1 - off, 0)) * (1 - distances / FARTHEST_M)
        shown = power > LEAST
        count = int(shown.sum())
        if count == 0:
            return None
        return Gaussians(
            means=torch.from_numpy(places[near[shown]]),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            scales=torch.full((count, 3), SIZE_M),
            opacities=torch.from_numpy(np.minimum(power[shown], 1).astype(np.float32)),
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
    """As many of all possible crystals as `sparkle` says; None where the light makes no glints.

    Their mirrors face every direction above the snow alike. normals: of the discs. rises: by how
    much snow in the sun is brighter than in shade.
    """
    strength = min((rises - DULL) / (STRONG - DULL), 1.0)
    if strength <= 0 or len(gaussians) == 0:
        return None
    brightness = gaussians.sh[:, 0].mean(1) * SH_C0 + 0.5
    bearing = gaussians.scales[:, :2].amax(1) < WIDEST_M
    bearing &= brightness > CLEAN * brightness.median()
    draws = torch.from_numpy(rng.random((5, PER_DISC * len(gaussians)), np.float32))
    kept = ((draws[0] < sparkle) & bearing.repeat(PER_DISC)).nonzero()[:, 0]
    draws, discs = draws[:, kept], kept % len(gaussians)
    up, around = draws[1], 2 * math.pi * draws[2]
    flat = (1 - up * up).sqrt()
    mirrors = torch.stack([flat * around.cos(), flat * around.sin(), up], 1)
    side, thick = gaussians.scales[discs, 1:2], gaussians.scales[discs, 2:3]
    beside = torch.stack([draws[3] - 0.5, draws[4] - 0.5, torch.zeros_like(up)], 1) * side
    places = gaussians.means[discs] + LIFTED * thick * normals[discs] + beside
    return Crystals(places, mirrors, strength)
