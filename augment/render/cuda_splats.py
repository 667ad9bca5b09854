"""What the stages of the GPU rasteriser hand to each other. Tensors lie on the GPU."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

HIDDEN = 0x7F800000  # key of Gaussians that are not drawn: infinity's bits, behind all others
TILE = 16  # pixels a side


@dataclass(frozen=True, eq=False)
class CudaSplats:
    """All N Gaussians of all parts, by index; rows of those that are not drawn are not written.

    records: as augment.render.layout's RECORD. keys: bits of float32 z, HIDDEN where not drawn.
    rects: first tile of a splat, column + (row << 16), and its last, likewise; not written where it
    is not drawn. counts: how many tiles that is, 0 where not drawn. cuts: of a clip, as layout's
    CUT; None without one. lights: augment.render.shading's lines; None
    where no part is lit pixel by pixel or no colour is asked for.
    """

    records: Float32[Tensor, "N 16"]
    keys: Int32[Tensor, "N"]
    rects: Int32[Tensor, "N 2"]
    counts: Int32[Tensor, "N"]
    cuts: Float32[Tensor, "N 8"] | None
    lights: Float32[Tensor, "N 9"] | None


@dataclass(frozen=True, eq=False)
class CudaTiles:
    """Which splats each tile blends, nearest first, ties by index.

    members: rows of CudaSplats, tile after tile. starts: int32 [tiles + 1]: tile i (row by row)
    owns members[starts[i]:starts[i + 1]]. Tiles without a wanted pixel own none.
    """

    members: Int32[Tensor, "E"]
    starts: Int32[Tensor, "T"]
    columns: int
    rows: int


class StageClock:
    """Times of a frame's stages on the GPU, by events, so that nothing waits until they are read.

    Where kernels are interpreted there is no GPU to time, and all are 0.
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self._events: list[torch.cuda.Event] = []
        self.counts: dict[str, int] = {}
        self._mark()

    def lap(self, name: str) -> None:
        """The time since the lap before belongs to `name`."""
        self._names.append(name)
        self._mark()

    def _mark(self) -> None:
        if torch.cuda.is_available():
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self._events.append(event)

    def milliseconds(self) -> dict[str, float]:
        """Waits for the GPU."""
        out = dict.fromkeys(self._names, 0.0)
        if self._events:
            self._events[-1].synchronize()
            for name, start, end in zip(
                self._names, self._events[:-1], self._events[1:], strict=True
            ):
                out[name] += start.elapsed_time(end)
        return out
