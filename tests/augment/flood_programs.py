"""Interpreted Triton kernels take their time by the operation, hardly by the pixel."""

from __future__ import annotations

import pytest

from augment.render.cuda import runtime as gpu


def few_programs(monkeypatch: pytest.MonkeyPatch, size: int = 64) -> None:
    """Lets the flood's kernels take squares of so many pixels a side where they are interpreted."""
    if not gpu.is_interpreted():
        return
    from augment.effects.flood import cuda

    for name in ("TRACE_TILE", "SHADE_TILE"):
        monkeypatch.setattr(cuda, name, (size, size))
    monkeypatch.setattr(cuda, "LANES", size * size)
