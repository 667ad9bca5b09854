"""Sets of Gaussians into one."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from augment.scene import Gaussians


def join_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """All parts in one. Parts have one degree of spherical harmonics, and classes unless empty."""
    names = ("means", "quats", "scales", "opacities", "sh")
    joined = {name: torch.cat([getattr(p, name) for p in parts]) for name in names}
    semantic = torch.cat([p.semantic for p in parts if p.semantic is not None])
    return Gaussians(**joined, semantic=semantic)
