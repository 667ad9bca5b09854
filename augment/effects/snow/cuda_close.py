"""Near discs of snow split on the GPU, as `augment.effects.snow.near_camera` does on the CPU.

Nothing comes back to be counted: the CPU knows blocks of neighbouring discs and reserves as many
finer discs for a block as one near its eye could need; those that are none have the opacity 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.snow import close_layout as layout
from augment.effects.snow.blocks import Blocks, blocks_of
from augment.effects.snow.cuda_constants import snow_classes
from augment.effects.snow.kernels import COARSER, FARTHEST_M, MAX_SPLITS, REACH, TEXEL_M
from augment.effects.snow.near_camera import (
    MOTTLE,
    RELIEF,
    TABLE,
    CloseSnow,
    Grain,
    finest_split,
    noise_table,
    shift_m,
    sun_step,
    view_limits,
)
from augment.render.cuda import runtime as gpu
from augment.scene import Gaussians

_ROUNDING = 1e-4  # of float32, on the safe side: of distances, and metres at the view's sides


@dataclass(frozen=True, eq=False)
class Split:
    """What of a layer is split for a view. rows int32 [B, ROW], numbers float32: see close_layout.
    total: finer discs at most.
    """

    gaussians: Gaussians
    slopes: Float[Tensor, "S 3"] | None
    order: Tensor
    rows: np.ndarray
    numbers: np.ndarray
    total: int

    def run(self, rows: Tensor, numbers: Tensor) -> CloseSnow:
        """The discs, of which `split_near` tells; rows and numbers as they lie on the GPU."""
        from augment.effects.snow import cuda_close_kernels as kernels

        g, count = self.gaussians, self.total
        means, quats, scales, opacities, sh = (
            gpu.resident(tensor) for tensor in (g.means, g.quats, g.scales, g.opacities, g.sh)
        )
        slopes = None if self.slopes is None else gpu.resident(self.slopes)
        left = opacities.clone()

        def new(*shape: int) -> Tensor:
            return torch.empty((count, *shape), dtype=torch.float32, device=means.device)

        fine = Gaussians(
            new(3), new(4), new(3), new(), new(1, 3),
            semantic=None if g.semantic is None else snow_classes(count),
        )  # fmt: skip
        fine_slopes = None if slopes is None else new(3)
        gpu.launch(
            kernels.split_discs,
            (len(self.rows), MAX_SPLITS**2),
            *(rows, numbers, gpu.resident(self.order), gpu.resident(_noise())),
            *(means, quats, scales, opacities, sh, slopes, left),
            *(fine.means, fine.quats, fine.scales, fine.opacities, fine.sh, fine_slopes),
            LIT=slopes is not None,
            BLOCK=layout.BLOCK,
        )
        whole = Gaussians(means, quats, scales, left, sh, g.semantic)
        return CloseSnow(whole, fine, fine_slopes)


def plan_split(
    gaussians: Gaussians,
    slopes: Float[Tensor, "S 3"] | None,
    camera: Camera,
    sun: np.ndarray,
    grain: Grain,
) -> Split | None:
    """What `split_near` would split, and perhaps more that is not; None where that is nothing.

    sun: unit, towards it, float64 [3].
    """
    if not len(gaussians):
        return None
    discs, finest, eye = _discs_of(gaussians), finest_split(camera), camera.centre.numpy()
    blocks = discs.blocks
    near, distances = blocks.near(eye, FARTHEST_M * (1 + _ROUNDING))
    distances = np.maximum(distances * (1 - _ROUNDING), 1e-9)
    most = np.minimum(np.floor(discs.widest[near] / (finest * distances) + 0.5), MAX_SPLITS)
    chosen, splits = near[most > 1], most[most > 1].astype(int)
    seen = blocks.may_lie_in(chosen, _sides(camera))
    chosen, splits = chosen[seen], splits[seen]
    if not len(chosen):
        return None
    counts = blocks.counts(chosen)
    ends = np.cumsum(counts * splits**2)
    rows = np.empty((len(chosen), layout.ROW), np.int32)
    rows[:, layout.R_FIRST], rows[:, layout.R_COUNT] = chosen * blocks.size, counts
    rows[:, layout.R_SPLITS], rows[:, layout.R_SLOT] = splits, ends - counts * splits**2
    numbers = _numbers(camera, sun, grain, finest)
    return Split(gaussians, slopes, discs.order, rows, numbers, int(ends[-1]))


@dataclass(frozen=True, eq=False)
class _Discs:
    """Blocks of a layer's discs. order int32 [S]: theirs. widest [B]: the widest side in each."""

    blocks: Blocks
    order: Tensor
    widest: np.ndarray


_known: WeakKeyDictionary[Gaussians, _Discs] = WeakKeyDictionary()


def _discs_of(gaussians: Gaussians) -> _Discs:
    """Worked out once for as long as the layer lives."""
    found = _known.get(gaussians)
    if found is None:
        blocks = blocks_of(gaussians.means.numpy(), layout.BLOCK)
        sides = REACH * gaussians.scales.numpy()[:, :2].max(1).astype(np.float64)
        found = _Discs(blocks, torch.from_numpy(blocks.order), blocks.largest(sides))
        _known[gaussians] = found
    return found


def _sides(camera: Camera) -> np.ndarray:
    """float64 [5, 4]: what of the world may be split, see Blocks.may_lie_in."""
    right, down, away = camera.camera_from_world.numpy()[:3]
    left_most, right_most, top, bottom = view_limits(camera)
    sides = np.stack([away, right - left_most * away, right_most * away - right,
                      down - top * away, bottom * away - down])  # fmt: skip
    sides[:, 3] += _ROUNDING * (1 + np.abs(sides[:, :3]).sum(1))
    return sides


def _numbers(camera: Camera, sun: np.ndarray, grain: Grain, finest: float) -> np.ndarray:
    eye, numbers = camera.centre.numpy(), np.zeros(layout.NUMBERS)
    coarse = eye.astype(np.float32)
    numbers[layout.N_ROTATION :][:9] = camera.camera_from_world.numpy()[:3, :3].reshape(-1)
    numbers[layout.N_EYE :][:6] = *coarse, *(eye - coarse)
    numbers[layout.N_LIMITS :][:4] = view_limits(camera)
    numbers[layout.N_FINEST] = finest
    numbers[layout.N_RELIEF] = grain.amount * grain.contrast * RELIEF
    numbers[layout.N_MOTTLE] = grain.amount * MOTTLE
    numbers[layout.N_SUN :][:2] = sun_step(sun)[:2]
    u, v = (eye[:2] + 0.7 * eye[2] + shift_m(grain.seed)) / TEXEL_M
    numbers[layout.N_CRUMB :][:2] = u % TABLE, v % TABLE
    turned = np.array([0.8 * u - 0.6 * v, 0.6 * u + 0.8 * v])
    numbers[layout.N_CLOD :][:2] = COARSER * turned % TABLE
    return numbers.astype(np.float32)


@cache
def _noise() -> Tensor:
    return torch.from_numpy(noise_table())
