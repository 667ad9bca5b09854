"""What Triton kernels read of the rows of an image that sees the water's plane (`plane_rows`)."""

from __future__ import annotations

import triton
import triton.language as tl

from augment.weather import plane_rows

_BEGIN, _END = tl.constexpr(plane_rows.BEGIN), tl.constexpr(plane_rows.END)
_ANCHOR, _FALL = tl.constexpr(plane_rows.ANCHOR), tl.constexpr(plane_rows.FALL)
_ROW = tl.constexpr(plane_rows.ROW)


@triton.jit
def falls(rows, row, column, mask):
    """Whether the rays of pixels fall, of an image with these rows [H, 4]."""
    line = rows + row * _ROW
    begin = tl.load(line + _BEGIN, mask=mask, other=0)
    return mask & (column >= begin) & (column < tl.load(line + _END, mask=mask, other=0))


@triton.jit
def fall_of(rows, row, column, per_column, mask):
    """World z of falling rays, unit z in the camera. per_column: its change; -1 outside mask."""
    line = rows + row * _ROW
    nearest = tl.load(line + _FALL, mask=mask, other=0).to(tl.float32, bitcast=True)
    away = column - tl.load(line + _ANCHOR, mask=mask, other=0)
    return tl.where(mask, nearest + away.to(tl.float32) * per_column, -1.0)
