"""What the GPU's projection hands on, made from the definition's: to test later stages alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from augment.cameras import Camera
from augment.render import layout
from augment.render.constants import ALPHA_MIN, RasterSettings
from augment.render.cuda.splats import HIDDEN, TILE, CudaSplats
from augment.render.fog import Fog
from augment.render.layout import CUT, HeightClip
from augment.render.reference import half_extents, project_parts
from augment.render.shading import LINES
from augment.scene import PosedGaussians

_K = 0.5 * math.log2(math.e)


def drawn_splats(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings | None = None,
    clip: HeightClip | None = None,
    smog: Fog | None = None,
) -> CudaSplats:
    """The splats of the parts, computed in their own precision; NaN in rows that nobody may read.

    Lies on the CPU.
    """
    splats = project_parts(parts, camera, settings or RasterSettings(), smog, clip)
    half, size = half_extents(splats), torch.tensor([camera.width, camera.height])
    low = torch.ceil((splats.means2d - half - 0.5).clamp_min(0))
    high = torch.floor(torch.minimum(splats.means2d + half - 0.5, size - 1))
    drawn = (low <= high).all(1) & (splats.opacities >= ALPHA_MIN)
    splats, half = splats.select(drawn), half[drawn]
    first, last = (edge[drawn].int() // TILE for edge in (low, high))

    count, rows = sum(len(part.gaussians) for part in parts), splats.ids
    xx, xy, yy = splats.covs2d.unbind(1)
    fields = {
        layout.MEAN_X: splats.means2d[:, 0],
        layout.MEAN_Y: splats.means2d[:, 1],
        layout.LEAN_X: xy / yy,
        layout.SHARP_X: torch.sqrt(_K * yy / splats.dets),
        layout.FALL_Y: _K / yy,
        layout.LOG_OPACITY: torch.log2(splats.opacities),
        layout.RADIUS_Y: half[:, 1],
        layout.FALL_X: _K / xx,
        layout.LEAN_Y: xy / xx,
        layout.BLUNT_Y: torch.sqrt(splats.dets / xx / _K),
        layout.DEPTH: splats.depths,
        layout.IS_OVERLAY: splats.overlay,
    }
    assert splats.colors is not None
    fields |= {layout.RED + channel: splats.colors[:, channel] for channel in range(3)}
    records = torch.full((count, layout.RECORD), math.nan)
    for field, values in fields.items():
        records[rows, field] = values.float()
    records[rows, layout.SPLAT_ID] = rows.int().view(torch.float32)
    keys = torch.full((count,), HIDDEN, dtype=torch.int32)
    keys[rows] = splats.depths.float().view(torch.int32)
    rects = torch.full((count, 2), -1, dtype=torch.int32)
    for corner, tile in enumerate((first, last)):
        rects[rows, corner] = tile[:, 0] + (tile[:, 1] << 16)
    counts = torch.zeros(count, dtype=torch.int32)
    counts[rows] = (last - first + 1).prod(1).int()
    cuts = lights = None
    if splats.cuts is not None:
        cuts = torch.full((count, CUT), math.nan)
        cuts[rows, : splats.cuts.shape[1]] = splats.cuts.float()
    if splats.lights is not None:
        lights = torch.full((count, LINES), math.nan)
        lights[rows] = splats.lights.float()
    return CudaSplats(records, keys, rects, counts, cuts, lights)
