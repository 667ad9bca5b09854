"""Small splat scenes made in code: a straight street of Gaussians. World: metres, +z up."""

from __future__ import annotations

import torch

from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians


def gaussians_at(means: torch.Tensor, rgb=(0.5, 0.5, 0.5), *, degree: int = 0) -> Gaussians:
    """Opaque balls of 10 cm at the means [N, 3], of one colour."""
    count = len(means)
    sh = torch.zeros(count, (degree + 1) ** 2, 3)
    sh[:, 0] = (torch.tensor(rgb) - 0.5) / SH_C0
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=means.float(),
        quats=quats,
        scales=torch.full((count, 3), 0.1),
        opacities=torch.full((count,), 0.9),
        sh=sh,
    )


def street(*, heading_deg: float = 30.0, length: float = 60.0, slope: float = 0.0) -> Gaussians:
    """A road 8 m wide between walls of 6 m, with a row of parked cars along its right side.

    It starts at the world's origin and runs along `heading`; the road's surface is at z = 0 there
    and climbs by `slope` per metre. 20 stray Gaussians lie below the ground.
    """
    rng = torch.Generator().manual_seed(7)

    def box(count: int, low, high) -> torch.Tensor:
        low, high = torch.tensor(low), torch.tensor(high)
        return low + (high - low) * torch.rand(count, 3, generator=rng)

    pieces = [
        box(6000, [0.0, -4.0, -0.02], [length, 4.0, 0.02]),
        box(4000, [0.0, 4.0, 0.0], [length, 4.3, 6.0]),
        box(4000, [0.0, -4.3, 0.0], [length, -4.0, 6.0]),
        box(20, [0.0, -4.0, -5.0], [length, 4.0, -0.5]),
    ]
    for start in range(2, int(length) - 6, 8):
        pieces.append(box(300, [float(start), -4.0, 0.2], [start + 5.0, -2.0, 1.6]))
    points = torch.cat(pieces)
    points[:, 2] += slope * points[:, 0]
    angle = torch.deg2rad(torch.tensor(heading_deg))
    cosine, sine = torch.cos(angle), torch.sin(angle)
    turn = torch.tensor([[cosine, -sine], [sine, cosine]])
    points[:, :2] = points[:, :2] @ turn.T
    return gaussians_at(points)
