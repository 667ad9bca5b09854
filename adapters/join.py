"""Sets of Gaussians into one, and the class of an object's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch

from augment.scene import Gaussians
from augment.semantics import class_of_label


def join_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """All parts in one. Parts have one degree of spherical harmonics, and classes unless empty."""
    names = ("means", "quats", "scales", "opacities", "sh")
    joined = {name: torch.cat([getattr(p, name) for p in parts]) for name in names}
    semantic = torch.cat([p.semantic for p in parts if p.semantic is not None])
    return Gaussians(**joined, semantic=semantic)


def with_class_of(label: str, gaussians: Gaussians) -> Gaussians:
    """The Gaussians of an object of which no more is known than its label."""
    classes = torch.full((len(gaussians),), int(class_of_label(label)), dtype=torch.int16)
    return dataclasses.replace(gaussians, semantic=classes)
