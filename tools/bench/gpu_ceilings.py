"""The least that a picture can take on a GPU: the longer of what its stages move, at the speed of a
copy, and of its blends, at the speed of a kernel that does nothing else.
"""

import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from numba import prange

from augment.cameras import Camera
from augment.render.buffers import RenderOutput
from augment.render.constants import ALPHA_MIN, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cpu.jit import kernel
from augment.render.cuda.driver import list_tiles, project
from augment.render.cuda.runtime import gpu_device, launch
from augment.render.cuda.splats import TILE, CudaSplats, CudaTiles, gather_inputs
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
from augment.scene import PosedGaussians
from tools.bench.harness import Action

LANES = 256  # pixels of a program that only blends


@triton.jit(do_not_specialize=["steps"])
def blend_only(out, steps, alpha_max, alpha_min, LANES: tl.constexpr):
    """LANES pixels of a row, each blended `steps` times with a splat that moves along the row.

    What a rasteriser's inner loop does for a pixel and a splat once all that is the same for a row
    is known: a Gaussian, an exponential, the two limits of alpha, transmittance, three colours. The
    sums are written so that none of it can be left out. out: float32 [programs, LANES].
    """
    pixel = tl.arange(0, LANES)
    x = pixel.to(tl.float32)
    transmittance = tl.full([LANES], 1.0, tl.float32)
    red = tl.zeros([LANES], tl.float32)
    green = tl.zeros([LANES], tl.float32)
    blue = tl.zeros([LANES], tl.float32)
    mean = 0.0
    for _ in range(steps):
        bend = 0.1 * (x - mean)
        alpha = tl.minimum(tl.exp2(-0.5 - bend * bend), alpha_max)
        weight = tl.where(alpha >= alpha_min, alpha * transmittance, 0.0)
        transmittance -= weight
        red += weight * 0.3
        green += weight * 0.5
        blue += weight * 0.7
        mean += 0.37
    tl.store(out + tl.program_id(0) * LANES + pixel, transmittance + red + green + blue)


@dataclass(frozen=True)
class Ceilings:
    """bytes_per_s: read and written, of a copy. blends_per_s: of a pixel and a splat, with colour,
    everything in registers.
    """

    bytes_per_s: float
    blends_per_s: float

    def ms(self, moved: float, blends: float = 0.0) -> float:
        """The least that so many bytes and blends can take, one beside the other."""
        return 1e3 * max(moved / self.bytes_per_s, blends / self.blends_per_s)


def measure_ceilings(
    measure: Callable[[Mapping[str, Action]], Mapping[str, list[float]]],
    *,
    copy_bytes: int = 1 << 30,
    programs: int = 132 * 32,
    steps: int = 8192,
) -> Ceilings:
    """measure: seconds of actions. The load is far more than caches hold and launches take."""
    device, count = gpu_device(), copy_bytes // 4
    source, target = torch.ones(count, device=device), torch.zeros(count, device=device)
    out = torch.zeros((programs, LANES), device=device)

    def blend() -> None:
        limits = (RasterSettings().alpha_max, ALPHA_MIN)
        launch(blend_only, (programs,), out, steps, *limits, LANES=LANES, num_warps=8)

    seconds = measure({"copy": lambda: target.copy_(source), "blend": blend})
    best = {name: statistics.median(each) for name, each in seconds.items()}
    return Ceilings(
        bytes_per_s=2 * 4 * count / best["copy"],
        blends_per_s=programs * LANES * steps / best["blend"],
    )


def floor_of(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    images: RenderOutput,
    ceilings: Ceilings,
) -> dict[str, Any]:
    """What a clean frame must move and blend by stage, counted, and the least that it can take.

    Inputs are read once, results written once, of the colours those of splats in view: what a sort
    moves besides, and records that several tiles read, are the price of how it is done.
    """
    inputs = gather_inputs(parts, camera, settings, None, None, with_color=True)
    splats = project(inputs)
    tiles = list_tiles(splats, camera, None)
    counted = count_blends(splats, tiles, camera, settings)
    count, visible = len(splats.keys), int((splats.counts > 0).sum())
    record = splats.records.shape[1] * 4
    geometry = count * 4 * (3 + 3 + 1) + visible * 4 * 4  # means, scales, opacities; quaternions
    colors = sum(12 * part.gaussians.sh.shape[1] * len(part.gaussians) for part in parts)
    keys = 2 * 4 * count  # of depth, and how many tiles
    drawn = [image for image in vars(images).values() if image is not None]
    moved = {
        "project": geometry + colors * visible // count + keys + visible * (record + 8),
        "list": keys + visible * 8 + 4 * len(tiles.tile_splat_ids) + 4 * len(tiles.tile_offsets),
        "blend": 4 * counted.entries
        + counted.used * record
        + sum(image.numel() * image.element_size() for image in drawn),
    }
    ms = {n: ceilings.ms(m, counted.done if n == "blend" else 0) for n, m in moved.items()}
    return {
        "bytes": sum(moved.values()),
        "bytes_of": moved,
        "ms": {**ms, "frame": sum(ms.values())},
        "splats": count,
        "visible": visible,
        "pairs": len(tiles.tile_splat_ids),
        **dataclasses.asdict(counted),
    }


@dataclass(frozen=True)
class Blends:
    """done: pixels and splats that are blended, as the image's definition asks. listed: pixels and
    splats of the tiles' lists. reached: those of them before all pixels of a tile are finished.
    entries: entries of lists that are reached. used: splats that are in one of those.
    """

    done: int
    listed: int
    reached: int
    entries: int
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
    offsets, cuts = tiles.tile_offsets.cpu().numpy(), splats.cuts
    used = np.zeros(len(splats.records), np.uint8)
    done, reached, entries = _count_tiles(
        splats.records.cpu().numpy(),
        np.empty((0, 8), np.float32) if cuts is None else cuts.cpu().numpy(),
        tiles.tile_splat_ids.cpu().numpy(),
        offsets,
        np.array([tiles.columns, camera.width, camera.height], np.int64),
        np.array(limits, np.float32),
        used,
    )
    widths = np.minimum(TILE, camera.width - TILE * np.arange(tiles.columns))
    heights = np.minimum(TILE, camera.height - TILE * np.arange(tiles.rows))
    pixels = (heights[:, None] * widths[None]).reshape(-1)
    return Blends(
        done=int(done.sum()),
        listed=int((np.diff(offsets) * pixels).sum()),
        reached=int(reached.sum()),
        entries=int(entries.sum()),
        used=int(used.sum()),
    )


@kernel
def _count_tiles(records, cuts, tile_splat_ids, tile_offsets, sizes, limits, used):
    """Blends, pixels reached and entries reached of every tile; see layout.RECORD.

    used: uint8 [N], set to 1 for the splats of reached entries.
    """
    columns, width, height = sizes
    alpha_max, log_cut, least, end = limits
    half, zero, one = np.float32(0.5), np.float32(0), np.float32(1)
    tiles = len(tile_offsets) - 1
    done, reached = np.zeros(tiles, np.int64), np.zeros(tiles, np.int64)
    entries = np.zeros(tiles, np.int64)
    for tile in prange(tiles):
        left, top = TILE * (tile % columns), TILE * (tile // columns)
        right, bottom = min(left + TILE, width), min(top + TILE, height)
        pixels = (right - left) * (bottom - top)
        transmittance = np.ones((TILE, TILE), np.float32)
        still = pixels
        for at in range(tile_offsets[tile], tile_offsets[tile + 1]):
            if still == 0:
                break
            row = tile_splat_ids[at]
            entries[tile] += 1
            reached[tile] += pixels
            used[row] = 1
            splat = records[row]
            for y in range(top, bottom):
                dy = np.float32(y) + half - splat[MEAN_Y]
                for x in range(left, right):
                    before = transmittance[y - top, x - left]
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
                    transmittance[y - top, x - left] = after
    return done, reached, entries
