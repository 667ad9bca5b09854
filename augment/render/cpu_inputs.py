"""What the CPU kernels read: scene parts by address, and the numbers of a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera
from augment.render import layout
from augment.render.clip import HeightClip
from augment.render.constants import RasterSettings
from augment.render.part_views import raster_modes, views_of
from augment.scene import PosedGaussians
from augment.weather.smog import SmogMedium


@dataclass(frozen=True, eq=False)
class Inputs:
    """All parts for one launch: nothing is concatenated, and actors cost no launch of their own.

    addresses, sizes, first_ids, views, blocks: see cpu_project. modes: see layout. arrays: what the
    addresses point to, kept alive by this.
    """

    addresses: np.ndarray
    sizes: np.ndarray
    first_ids: np.ndarray
    views: np.ndarray
    blocks: np.ndarray
    modes: np.ndarray
    arrays: list[np.ndarray]

    @property
    def slots(self) -> int:
        """Room for every Gaussian, block by block."""
        return len(self.blocks) * layout.BLOCK


def gather_inputs(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    smog: SmogMedium | None,
    clip: HeightClip | None = None,
    *,
    with_color: bool,
) -> Inputs:
    """Addresses and numbers of all parts; their tensors are not copied if they are contiguous."""
    arrays, addresses, sizes, blocks = [], [], [], []
    for number, part in enumerate(parts):
        g, count = part.gaussians, len(part.gaussians)
        tensors = (g.means, g.quats, g.scales, g.opacities, g.sh)
        own = [t.detach().to(torch.float32).contiguous().numpy() for t in tensors]
        own += [_slopes(part), *_color_maps(part)]
        arrays += own
        addresses.append([array.ctypes.data for array in own])
        sizes.append([count, g.sh.shape[1]])
        starts = range(0, count, layout.BLOCK)
        blocks += [(number, start, min(start + layout.BLOCK, count)) for start in starts]
    counts = [size[0] for size in sizes]
    modes = raster_modes(settings, smog, clip, with_color=with_color)
    modes[layout.M_LIGHT] = with_color and any(part.shading is not None for part in parts)
    return Inputs(
        addresses=np.array(addresses, np.uint64).reshape(-1, layout.ADDRESSES),
        sizes=np.array(sizes, np.int64).reshape(-1, 2),
        first_ids=np.cumsum([0, *counts[:-1]], dtype=np.int64),
        views=views_of(parts, camera, settings, smog, clip),
        blocks=np.array(blocks, np.int64).reshape(-1, 3),
        modes=modes,
        arrays=arrays,
    )


def _slopes(part: PosedGaussians) -> np.ndarray:
    """float32 [N, 3], or [1] for parts of splats of one colour."""
    if part.shading is None:
        return np.zeros(1, np.float32)
    return part.shading.slopes.detach().to(torch.float32).contiguous().numpy()


def _color_maps(part: PosedGaussians) -> tuple[np.ndarray, np.ndarray]:
    """Float32 [C, 3, 4] and int16 [N], or [1] of what is not read."""
    maps, rows = np.zeros(1, np.float32), np.zeros(1, np.int16)
    if part.color_maps is not None:
        maps = part.color_maps.detach().to(torch.float32).contiguous().numpy()
    if part.map_rows is not None:
        rows = part.map_rows.contiguous().numpy()
    return maps, rows
