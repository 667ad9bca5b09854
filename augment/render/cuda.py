"""The GPU rasteriser: stages in Triton, and the order in which they run.

    project   record, tiles and colour of every Gaussian                  (cuda_project)
    list      by z, ties by index; then the splats of every tile          (cuda_tiles)
    blend     every tile's, front to back, into the images asked for      (cuda_blend)

No sum depends on the order in which programs run, so the same bits come out every time.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from augment.cameras import Camera
from augment.render.buffers import RGB, RenderOutput
from augment.render.clip import HeightClip
from augment.render.constants import RasterSettings
from augment.render.cuda_blend import blend
from augment.render.cuda_inputs import gather_inputs
from augment.render.cuda_project import project
from augment.render.cuda_splats import StageClock
from augment.render.cuda_tiles import list_tiles
from augment.scene import PosedGaussians
from augment.weather.smog import SmogMedium


def rasterize_cuda(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
    smog: SmogMedium | None,
    clip: HeightClip | None = None,
    wanted: torch.Tensor | None = None,
    *,
    clock: StageClock | None = None,
) -> RenderOutput:
    """The image of the parts in float32, on the GPU, without gradients. Arguments are checked by
    `rasterize`.

    wanted: bool [H, W]; tiles without a wanted pixel are left out and hold zeros. clock: told of
    "project", "list" and "blend", and of the counts "visible" (splats that touch a tile) and
    "pairs" (of splats and tiles).
    """
    inputs = gather_inputs(parts, camera, settings, smog, clip, with_color=RGB in buffers)
    splats = project(inputs)
    if clock is not None:
        clock.lap("project")
    tiles = list_tiles(splats, camera, wanted)
    if clock is not None:
        clock.lap("list")
        clock.counts["visible"] = int((splats.counts > 0).sum())
        clock.counts["pairs"] = len(tiles.members)
    images = blend(splats, tiles, camera, buffers, settings)
    if clock is not None:
        clock.lap("blend")
    return RenderOutput(**images)
