"""Snow close to the camera: discs that a pixel could tell apart are split, and show grain.

A cell of 5 cm is 20 pixels wide a few metres before a car's camera. There every disc becomes a few
that together cover what it covered, each a little brighter or darker: crumbs and clods of snow, lit
on the side of the sun. The noise they follow belongs to the place, so that all cameras and frames
see the same grain; it fades out with the distance before the discs grow whole again.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from augment.cameras import Camera
from augment.render.threads import kernel_threads
from augment.scene import Gaussians
from augment.snow import close_kernels
from augment.snow.close_kernels import MARGIN, TEXEL_M

# Splitting stops at a standard deviation of so many pixels, and of so much of the distance.
FINEST_PX, FINEST = 5.0, 0.0038
ROWS = 2048  # discs that a thread takes at a time
RELIEF = 3.4  # brightness per fall of the noise towards the sun, of a clear day's contrast
CRUMB_M = 0.025  # what one crumb of snow measures
TABLE = 512  # texels a side of the noise that grain follows: 5 m, repeated
MOTTLE = 0.16  # brightness per noise, in any light


@dataclass(frozen=True)
class Grain:
    """How snow looks from close by. amount: 0 smooth, 1 coarse. contrast: 0 to 1, by how much the
    sun outshines the sky on it. seed: of its noise.
    """

    amount: float
    contrast: float
    seed: int


@dataclass(frozen=True, eq=False)
class CloseSnow:
    """Snow of which near discs are split. whole: the layer's Gaussians, those that were split with
    opacity 0. fine: what they were split into. fine_slopes: theirs, where the layer has slopes.
    """

    whole: Gaussians
    fine: Gaussians
    fine_slopes: Float[Tensor, "F 3"] | None


def split_near(
    gaussians: Gaussians,
    slopes: Float[Tensor, "S 3"] | None,
    camera: Camera,
    sun: Float[Tensor, "3"],
    grain: Grain,
) -> CloseSnow | None:
    """The snow as the camera sees it; None where no disc is near enough.

    gaussians: of the world. sun: unit, towards it.
    """
    finest = finest_split(camera)
    splits = _count_splits(gaussians, camera, finest)
    chosen = np.flatnonzero(splits)
    if len(chosen) == 0:
        return None
    splits = splits[chosen]
    lasts = np.cumsum(splits.astype(np.int64) ** 2)
    total = int(lasts[-1])
    fine = Gaussians(
        means=torch.empty(total, 3),
        quats=torch.empty(total, 4),
        scales=torch.empty(total, 3),
        opacities=torch.from_numpy(np.full(total, gaussians.opacities.numpy()[0])),
        sh=torch.empty(total, 1, 3),
        semantic=None if gaussians.semantic is None else gaussians.semantic[:1].expand(total),
    )
    fine_slopes = torch.empty(0 if slopes is None else total, 3)
    with kernel_threads(ROWS):
        close_kernels.split(
            chosen,
            splits,
            lasts - splits.astype(np.int64) ** 2,
            camera.centre.numpy(),
            sun_step(sun.numpy()),
            shift_m(grain.seed),
            noise_table(),
            grain.amount * grain.contrast * RELIEF,
            grain.amount * MOTTLE,
            finest,
            *_arrays(gaussians, slopes),
            *_arrays(fine, fine_slopes),
        )
    opacities = gaussians.opacities.numpy().copy()  # numpy: torch would wake threads for so little
    opacities[chosen] = 0
    return CloseSnow(
        dataclasses.replace(gaussians, opacities=torch.from_numpy(opacities)),
        fine,
        None if slopes is None else fine_slopes,
    )


def finest_split(camera: Camera) -> float:
    """Standard deviation of a disc over its distance that splitting stops at."""
    return max(FINEST_PX / max(camera.fx, camera.fy), FINEST)


def view_limits(camera: Camera) -> np.ndarray:
    """Lowest and highest x / z, then y / z, of the discs that are split, float64 [4]."""
    wide = (1 + MARGIN) * np.array([-1.0, 1.0])
    across = (0.5 * camera.width - camera.cx + 0.5 * camera.width * wide) / camera.fx
    down = (0.5 * camera.height - camera.cy + 0.5 * camera.height * wide) / camera.fy
    return np.concatenate([across, down])


def sun_step(sun: np.ndarray) -> np.ndarray:
    """Half a step of the relief towards the sun, level, metres, float64 [3]. sun: unit."""
    level = sun * np.array([1.0, 1.0, 0.0])
    return 0.25 * CRUMB_M * level / max(float(np.linalg.norm(level)), 1e-9)


@functools.cache
def noise_table() -> np.ndarray:
    """float32 [TABLE, TABLE] of unit deviation, smooth over a crumb, whose borders meet."""
    white = np.random.Generator(np.random.PCG64(0)).standard_normal((TABLE, TABLE))
    smooth = ndimage.gaussian_filter(white, 0.5 * CRUMB_M / TEXEL_M, mode="wrap")
    return (smooth / smooth.std()).astype(np.float32)


@functools.lru_cache(8)
def shift_m(seed: int) -> np.ndarray:
    """Where a recipe's grain begins in the table, float64 [2]."""
    return np.random.Generator(np.random.PCG64(seed)).uniform(0, TABLE * TEXEL_M, 2)


def _count_splits(gaussians: Gaussians, camera: Camera, finest: float) -> np.ndarray:
    splits = np.empty(len(gaussians), np.uint8)
    with kernel_threads(ROWS):
        close_kernels.count_splits(
            gaussians.means.numpy(),
            gaussians.scales.numpy(),
            np.ascontiguousarray(camera.camera_from_world.numpy()[:3]),
            view_limits(camera),
            finest,
            splits,
        )
    return splits


def _arrays(gaussians: Gaussians, slopes: Tensor | None) -> tuple[np.ndarray, ...]:
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh)
    slopes = torch.empty(0, 3) if slopes is None else slopes
    return tuple(t.contiguous().numpy() for t in (*tensors, slopes))
