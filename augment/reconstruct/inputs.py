"""The splats of a view as the CPU kernels take them: addresses into the arrays being fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from augment.cameras import Camera
from augment.reconstruct.splats import Splats
from augment.render import layout
from augment.render.constants import RasterSettings
from augment.render.cpu_inputs import Inputs
from augment.render.part_views import part_views, raster_modes

_FIELDS = ("means", "quats", "scales", "opacities", "sh")


def splat_inputs(
    splats: Splats,
    parts: Sequence[int],
    poses: np.ndarray,
    camera: Camera,
    settings: RasterSettings,
) -> Inputs:
    """Inputs of the parts that exist now. parts: their numbers. poses: world_from_part, float64
    [P, 4, 4]. Nothing is copied: kernels read, and Adam writes, the arrays of `splats`, which must
    outlive the inputs.

    first_ids are positions in the arrays of `splats`.
    """
    starts = splats.starts[list(parts)]
    counts = splats.starts[np.asarray(parts) + 1] - starts
    functions = splats.sh.shape[1]
    strides = [getattr(splats, name)[:1].nbytes for name in _FIELDS]
    bases = [getattr(splats, name).ctypes.data for name in _FIELDS]
    addresses = np.array(bases, np.uint64) + starts[:, None].astype(np.uint64) * np.array(
        strides, np.uint64
    )
    # no part has slopes of light, or colour maps
    absent = np.zeros((len(starts), layout.ADDRESSES - len(_FIELDS)), np.uint64)
    return Inputs(
        addresses=np.concatenate([addresses, absent], 1),
        sizes=np.stack([counts, np.full_like(counts, functions)], 1),
        first_ids=starts.copy(),
        views=part_views(poses, camera, settings, None),
        blocks=_blocks(counts),
        modes=raster_modes(settings, None, with_color=True),
        arrays=[getattr(splats, name) for name in _FIELDS],
    )


def _blocks(counts: np.ndarray) -> np.ndarray:
    """int64 [B, 3]: part, first and last + 1 of every block."""
    per_part = -(-counts // layout.BLOCK)
    part = np.repeat(np.arange(len(counts)), per_part)
    first_block = np.repeat(np.cumsum(per_part) - per_part, per_part)
    first = (np.arange(len(part)) - first_block) * layout.BLOCK
    last = np.minimum(first + layout.BLOCK, counts[part])
    return np.stack([part, first, last], 1).astype(np.int64)
