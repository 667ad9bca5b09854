"""The least that a picture can take on a GPU: what it must move and blend, counted.

Each stage reads its inputs once and writes its results once; what a sort moves besides, and records
that several tiles read, are the price of how it is done and not counted. Of the colours only those
of splats in view are read. A stage's floor is the longer of its bytes at the speed of a copy and
its blends at the speed of a kernel that does nothing else (bench_gpu_ceilings).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch

from augment.cameras import Camera
from augment.render.buffers import RGB, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.cuda.splats import CudaSplats, CudaTiles
from augment.scene import PosedGaussians
from tools.bench_gpu_blends import Blends, count_blends
from tools.bench_gpu_ceilings import Ceilings

STAGES = ("project", "list", "blend")
PIXEL = "pixels"  # what is done to finished images


@dataclass(frozen=True, eq=False)
class RasterPass:
    """One run of the rasteriser inside a frame, and what its stages handed over."""

    parts: Sequence[PosedGaussians]
    camera: Camera
    buffers: frozenset[str]
    settings: RasterSettings
    splats: CudaSplats
    tiles: CudaTiles
    images: Mapping[str, torch.Tensor]


@contextmanager
def noted_passes() -> Iterator[list[RasterPass]]:
    """The runs of the GPU rasteriser while this is open. The stages are noted where they are
    called, so that what is counted is the frame as it is made.
    """
    from augment.render.cuda import driver as cuda

    passes: list[RasterPass] = []
    rasterize, blend = cuda.rasterize_cuda, cuda.blend
    running: list[Sequence[PosedGaussians]] = []

    def noted_rasterize(parts: Sequence[PosedGaussians], *args: Any, **kwargs: Any) -> RenderOutput:
        running.append(parts)
        try:
            return rasterize(parts, *args, **kwargs)
        finally:
            running.pop()

    def noted_blend(
        splats: CudaSplats,
        tiles: CudaTiles,
        camera: Camera,
        buffers: frozenset[str],
        settings: RasterSettings,
    ) -> dict[str, torch.Tensor]:
        images = blend(splats, tiles, camera, buffers, settings)
        passes.append(
            RasterPass(running[-1], camera, buffers, settings, splats, tiles, dict(images))
        )
        return images

    try:
        cuda.rasterize_cuda, cuda.blend = noted_rasterize, noted_blend
        yield passes
    finally:
        cuda.rasterize_cuda, cuda.blend = rasterize, blend


@dataclass
class Floor:
    """bytes_of: by stage. Blends and counts are sums over all runs of the rasteriser."""

    bytes_of: dict[str, int] = field(default_factory=lambda: dict.fromkeys((*STAGES, PIXEL), 0))
    blends: int = 0
    splats: int = 0
    visible: int = 0
    used: int = 0
    pairs: int = 0
    pairs_reached: int = 0
    listed_blends: int = 0
    reached_blends: int = 0
    passes: int = 0

    @property
    def bytes(self) -> int:
        return sum(self.bytes_of.values())

    def ms_of(self, ceilings: Ceilings) -> dict[str, float]:
        """By stage, and of all."""
        found = {
            name: ceilings.ms(moved, self.blends if name == "blend" else 0)
            for name, moved in self.bytes_of.items()
        }
        return {**found, "frame": sum(found.values())}

    def add_pass(self, seen: RasterPass) -> None:
        counted = count_blends(seen.splats, seen.tiles, seen.camera, seen.settings)
        visible = int((seen.splats.counts > 0).sum())
        for name, moved in pass_bytes(seen, visible, counted).items():
            self.bytes_of[name] += moved
        self.blends += counted.done
        self.splats += len(seen.splats.keys)
        self.visible += visible
        self.used += counted.used
        self.pairs += len(seen.tiles.members)
        self.pairs_reached += counted.members
        self.listed_blends += counted.listed
        self.reached_blends += counted.reached
        self.passes += 1

    def as_dict(self, ceilings: Ceilings) -> dict[str, Any]:
        return {**dataclasses.asdict(self), "bytes": self.bytes, "ms": self.ms_of(ceilings)}


def pass_bytes(seen: RasterPass, visible: int, counted: Blends) -> dict[str, int]:
    """Bytes that each stage of one run must read and write."""
    splats, count = seen.splats, len(seen.splats.keys)
    record = splats.records.shape[1] * 4
    extra = sum(4 * t.shape[1] for t in (splats.cuts, splats.lights) if t is not None)
    geometry = count * 4 * (3 + 3 + 1) + visible * 4 * 4  # means, scales, opacities; quaternions
    total = max(sum(len(part.gaussians) for part in seen.parts), 1)
    colors = sum(12 * part.gaussians.sh.shape[1] * len(part.gaussians) for part in seen.parts)
    read_colors = colors * visible // total if RGB in seen.buffers else 0
    images = sum(image.numel() * image.element_size() for image in seen.images.values())
    keys = 2 * 4 * count  # of depth, and how many tiles
    return {
        "project": geometry + read_colors + keys + visible * (record + extra + 8),
        "list": keys + visible * 8 + 4 * len(seen.tiles.members) + 4 * len(seen.tiles.starts),
        "blend": 4 * counted.members + counted.used * (record + extra) + images,
    }


def frame_floor(passes: Sequence[RasterPass], finished_bytes: int) -> Floor:
    """Of a frame: its runs of the rasteriser, then every image that they wrote read once and what
    is finished, of so many bytes, written once.
    """
    floor = Floor()
    for seen in passes:
        floor.add_pass(seen)
        floor.bytes_of[PIXEL] += sum(i.numel() * i.element_size() for i in seen.images.values())
    floor.bytes_of[PIXEL] += finished_bytes
    return floor
