"""What a GPU can do at best, measured: bytes it copies and splats it blends in a second."""

from __future__ import annotations

import statistics
from dataclasses import dataclass

import torch

from augment.render.constants import ALPHA_MIN, RasterSettings
from augment.render.cuda.runtime import gpu_device, launch
from tools.gpu_clock import Timing, times_in_turns

LANES = 256  # pixels of a program


@dataclass(frozen=True)
class Load:
    """How much work a ceiling is measured with: far more than caches hold and launches take."""

    copy_bytes: int = 1 << 30
    programs: int = 132 * 32
    steps: int = 8192


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


def measure_ceilings(timing: Timing, load: Load = Load()) -> Ceilings:
    from tools.bench_gpu_kernels import blend_only

    device, count = gpu_device(), load.copy_bytes // 4
    source = torch.ones(count, device=device)
    target = torch.zeros(count, device=device)
    out = torch.zeros((load.programs, LANES), device=device)
    alpha_max = RasterSettings().alpha_max

    def blend() -> None:
        grid = (load.programs,)
        launch(blend_only, grid, out, load.steps, alpha_max, ALPHA_MIN, LANES=LANES, num_warps=8)

    ms = times_in_turns({"copy": lambda: target.copy_(source), "blend": blend}, timing)
    best = {name: statistics.median(values) / 1e3 for name, values in ms.items()}
    return Ceilings(
        bytes_per_s=2 * 4 * count / best["copy"],
        blends_per_s=load.programs * LANES * load.steps / best["blend"],
    )
