"""Glints: crystals on snow that throw the sun at a camera, and come and go as it moves.

`draw_crystals` draws the crystals once a scene. `Crystals.glints` makes Gaussians for each view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from augment.memo import memo_of
from augment.render.buffers import AUTO, CUDA
from augment.render.cuda import runtime as gpu
from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians
from augment.scene.semantics import SemanticClass

MAX_GLINT_DISTANCE_M = 15.0  # distance from the camera at which glints have faded
LOBE_DEG = 9.0  # largest angle between a mirror and the normal that throws the sun at the camera
MIN_OPACITY = 0.02  # least opacity of a glint
# Mirrors face every direction alike, so that one crystal in 80 throws the sun at an eye. A GPU does
# not count the glints; it has room for one crystal in CRYSTALS_PER_GLINT, five times as many.
CRYSTALS_PER_GLINT = 16
GLINT_SIZE_M = 0.002  # standard deviation of a glint
GLINT_LIFT = 4.0  # height of a glint over a disc's middle, in the disc's thickness
MAX_CRYSTALS_PER_DISC = 2  # largest number of crystals on a disc
MAX_GLINT_DISC_M = 0.15  # larger discs are too far away for any glint
MIN_SUN_CONTRAST = 0.02  # luminance by which lit snow outshines shaded snow where glints begin
FULL_SUN_CONTRAST = 0.25  # the same where glints are full
# Least brightness of a disc with glints, over the median: packed and shaded snow has none.
MIN_GLINT_BRIGHTNESS = 0.9
_BLOCK_ROWS = 256  # number of neighbouring points in a block


@dataclass(frozen=True, eq=False)
class Crystals:
    """G crystals that may glint, in the part's frame."""

    places_m: Float32[Tensor, "G 3"]  # positions
    mirrors: Float32[Tensor, "G 3"]  # unit normals of the mirrors
    strength: float  # strength of their light, 0 to 1
    disc_ids: Int64[Tensor, "G"] | None = None  # discs of the layer that they lie on

    def glints(
        self, sun: Float[Tensor, "3"], eye_m: Float[Tensor, "3"], *, backend: str = AUTO
    ) -> Gaussians | None:
        """Make bright Gaussians where a mirror throws the sun into the eye; None without any.

        Args:
            sun: unit vector towards the sun, in the part's frame.
            eye_m: the camera's centre, in the part's frame.
            backend: with "cuda" the Gaussians lie on the GPU. They are not counted there, so some
                of them have opacity 0.
        """
        eye = eye_m.numpy().astype(np.float32)
        towards_sun = sun.numpy().astype(np.float32)
        near_ids = _find_near_rows(self, self.places_m.numpy(), eye, MAX_GLINT_DISTANCE_M)
        if backend == CUDA and len(near_ids):
            rows = gpu.upload(near_ids)
            view = gpu.upload(np.stack([towards_sun, eye]))
            places, mirrors = (gpu.gpu_copy(t)[rows] for t in (self.places_m, self.mirrors))
            power = glint_power(places, mirrors, self.strength, view[0], view[1])
            power, index = power.topk(
                min(len(near_ids), 64 + len(near_ids) // CRYSTALS_PER_GLINT), sorted=False
            )
            opacities = torch.where(power > MIN_OPACITY, power.clip(max=1), 0.0)
            return _glints_at(places[index], opacities)
        # numpy, since starting threads would take longer than the arithmetic on one part's crystals
        places = self.places_m.numpy()[near_ids]
        mirrors = self.mirrors.numpy()[near_ids]
        power = glint_power(places, mirrors, self.strength, towards_sun, eye)
        is_visible = power > MIN_OPACITY
        if not is_visible.any():
            return None
        opacities = np.minimum(power[is_visible], 1).astype(np.float32)
        return _glints_at(torch.from_numpy(places[is_visible]), torch.from_numpy(opacities))


def glint_power(places: Any, mirrors: Any, strength: float, sun: Any, eye: Any) -> Any:
    """Opacities of crystals' glints, [G]; below MIN_OPACITY there is no glint.

    Args:
        places: [G, 3], positions, float32 array or tensor.
        mirrors: [G, 3], unit normals of the mirrors.
        strength: strength of the sun's light, 0 to 1.
        sun: [3], unit vector towards the sun.
        eye: [3], the camera's centre. All are in the part's frame.
    """
    views = eye - places
    distances = ((views * views).sum(1) ** 0.5).clip(1e-6)
    half_vectors = views / distances[:, None] + sun
    lengths = ((half_vectors * half_vectors).sum(1) ** 0.5).clip(1e-6)
    aligned = (half_vectors * mirrors).sum(1) / lengths
    lobe_share = (1 - aligned) / (1 - math.cos(math.radians(LOBE_DEG)))  # 1 at the lobe's rim
    return strength * (1 - lobe_share).clip(0) ** 0.5 * (1 - distances / MAX_GLINT_DISTANCE_M)


def _glints_at(places: Tensor, opacities: Tensor) -> Gaussians:
    """Return white Gaussians at places [G, 3]."""
    count = len(places)
    device = places.device
    return Gaussians(
        means=places,
        quats=torch.eye(4, device=device)[:1].repeat(count, 1),
        scales=torch.full((count, 3), GLINT_SIZE_M, device=device),
        opacities=opacities,
        sh=torch.full((count, 1, 3), 0.5 / SH_C0, device=device),  # white
        semantic=torch.full((count,), int(SemanticClass.SNOW), dtype=torch.int16, device=device),
    )


def draw_crystals(
    gaussians: Gaussians,
    normals: Float32[Tensor, "S 3"],
    sun_contrast: float,
    sparkle: float,
    rng: np.random.Generator,
) -> Crystals | None:
    """Draw crystals on a layer's discs; None where the light makes no glints.

    Mirrors face every direction above the snow alike.

    Args:
        gaussians: the layer's discs.
        normals: [S, 3], normals of the discs.
        sun_contrast: luminance by which snow in the sun is brighter than in shade.
        sparkle: share of all possible crystals, from the recipe.
        rng: random numbers of this part.
    """
    strength = min((sun_contrast - MIN_SUN_CONTRAST) / (FULL_SUN_CONTRAST - MIN_SUN_CONTRAST), 1.0)
    if strength <= 0 or len(gaussians) == 0:
        return None
    brightness = gaussians.sh[:, 0].mean(1) * SH_C0 + 0.5
    has_glints = gaussians.scales[:, :2].amax(1) < MAX_GLINT_DISC_M
    has_glints &= brightness > MIN_GLINT_BRIGHTNESS * brightness.median()
    draws = torch.from_numpy(rng.random((5, MAX_CRYSTALS_PER_DISC * len(gaussians)), np.float32))
    crystal_ids = ((draws[0] < sparkle) & has_glints.repeat(MAX_CRYSTALS_PER_DISC)).nonzero()[:, 0]
    draws = draws[:, crystal_ids]
    disc_ids = crystal_ids % len(gaussians)
    mirror_z = draws[1]
    azimuth = 2 * math.pi * draws[2]
    mirror_xy = (1 - mirror_z * mirror_z).sqrt()
    mirrors = torch.stack([mirror_xy * azimuth.cos(), mirror_xy * azimuth.sin(), mirror_z], 1)
    side_m = gaussians.scales[disc_ids, 1:2]
    thickness_m = gaussians.scales[disc_ids, 2:3]
    offsets = torch.stack([draws[3] - 0.5, draws[4] - 0.5, torch.zeros_like(mirror_z)], 1) * side_m
    places = gaussians.means[disc_ids] + GLINT_LIFT * thickness_m * normals[disc_ids] + offsets
    return Crystals(places, mirrors, strength, disc_ids)


def _find_near_rows(
    owner: Any, points: np.ndarray, eye_m: np.ndarray, reach_m: float
) -> np.ndarray:
    """Select the rows of points [P, 3] that hold all points within reach of the eye, int64.

    Points are tested in blocks of neighbouring rows, so some farther points are selected, too.

    Args:
        owner: object that the points belong to; the blocks' boxes are remembered with it.
        points: [P, 3].
        eye_m: [3], in the points' frame.
        reach_m: distance from the eye.
    """

    def corners() -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest corner of each block, [B, 3]."""
        starts = np.arange(0, len(points), _BLOCK_ROWS)
        return np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)

    if not len(points):
        return np.zeros(0, np.int64)
    lows, highs = memo_of(owner).get(("corners of blocks",), corners)
    gaps = np.maximum(np.maximum(lows - eye_m, eye_m - highs), 0.0)
    blocks = np.flatnonzero((gaps * gaps).sum(1) <= (1.001 * reach_m) ** 2)
    rows = (blocks[:, None] * _BLOCK_ROWS + np.arange(_BLOCK_ROWS)).reshape(-1)
    return rows[: np.searchsorted(rows, len(points))]
