"""How many blends an image takes: every pixel and every splat that adds to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange

from augment.cameras import Camera
from augment.render.constants import ALPHA_MIN, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cpu.jit import kernel
from augment.render.cuda.splats import TILE, CudaSplats, CudaTiles
from augment.render.layout import (
    C_AT,
    C_X,
    C_Y,
    FALL_Y,
    LEAN_X,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    SHARP_X,
)
from augment.render.threads import select_thread_pool


@dataclass(frozen=True)
class Blends:
    """done: pixels and splats that are blended, as the image's definition asks. listed: pixels and
    splats of the tiles' lists. reached: those of them before all pixels of a tile are finished.
    members: entries of lists that are reached. used: splats that are in one of those.
    """

    done: int
    listed: int
    reached: int
    members: int
    used: int


def count_blends(
    splats: CudaSplats, tiles: CudaTiles, camera: Camera, settings: RasterSettings
) -> Blends:
    """Counted on the CPU from the lists that the GPU blends."""
    select_thread_pool()
    limits = (
        settings.alpha_max,
        math.log2(ALPHA_MIN),
        min(settings.transmittance_stop, TRANSMITTANCE_STOP),
        settings.transmittance_stop,
    )
    members, starts = tiles.members.cpu().numpy(), tiles.starts.cpu().numpy()
    cuts = splats.cuts
    used = np.zeros(len(splats.records), np.uint8)
    done, reached, lasts = _count_tiles(
        splats.records.cpu().numpy(),
        np.empty((0, 8), np.float32) if cuts is None else cuts.cpu().numpy(),
        members,
        starts,
        np.array([tiles.columns, camera.width, camera.height], np.int64),
        np.array(limits, np.float32),
        used,
    )
    widths = np.minimum(TILE, camera.width - TILE * np.arange(tiles.columns))
    heights = np.minimum(TILE, camera.height - TILE * np.arange(tiles.rows))
    pixels = (heights[:, None] * widths[None]).reshape(-1)
    return Blends(
        done=int(done.sum()),
        listed=int((np.diff(starts) * pixels).sum()),
        reached=int(reached.sum()),
        members=int(lasts.sum()),
        used=int(used.sum()),
    )


@kernel
def _count_tiles(records, cuts, members, starts, sizes, limits, used):
    """Blends, pixels reached and entries reached of every tile; see layout.RECORD.

    used: uint8 [N], set to 1 for the splats of reached entries.
    """
    columns, width, height = sizes
    alpha_max, log_cut, least, end = limits
    half, zero, one = np.float32(0.5), np.float32(0), np.float32(1)
    tiles = len(starts) - 1
    done, reached = np.zeros(tiles, np.int64), np.zeros(tiles, np.int64)
    lasts = np.zeros(tiles, np.int64)
    for tile in prange(tiles):
        left, top = TILE * (tile % columns), TILE * (tile // columns)
        right, bottom = min(left + TILE, width), min(top + TILE, height)
        pixels = (right - left) * (bottom - top)
        through = np.ones((TILE, TILE), np.float32)
        still = pixels
        for at in range(starts[tile], starts[tile + 1]):
            if still == 0:
                break
            row = members[at]
            lasts[tile] += 1
            reached[tile] += pixels
            used[row] = 1
            splat = records[row]
            for y in range(top, bottom):
                dy = np.float32(y) + half - splat[MEAN_Y]
                for x in range(left, right):
                    before = through[y - top, x - left]
                    if before < 0:  # finished
                        continue
                    dx = np.float32(x) + half - splat[MEAN_X]
                    bend = splat[SHARP_X] * (dx - splat[LEAN_X] * dy)
                    e = splat[LOG_OPACITY] - bend * bend - splat[FALL_Y] * dy * dy
                    if e < log_cut:
                        continue
                    alpha = min(np.float32(2.0**e), alpha_max)
                    if len(cuts) > 0:
                        cut = cuts[row]
                        share = cut[C_AT] + cut[C_X] * dx + cut[C_Y] * dy
                        alpha *= min(max(share, zero), one)
                        if alpha <= 0:
                            continue
                    after = before * (one - alpha)
                    done[tile] += after > least
                    if after <= end:
                        still -= 1
                        after = np.float32(-1)
                    through[y - top, x - left] = after
    return done, reached, lasts
