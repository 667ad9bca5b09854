"""Colours that change over time: a Fourier series of every splat's view-independent colour.

Street Gaussians gives an actor's splats such colours (Yan et al. 2024, section 3.1, "4D spherical
harmonics"): sh_00(t) = sum_k c_k b_k(t) with b_k = cos(pi k t) for even k, sin(pi (k + 1) t) for
odd k.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int64
from torch import Tensor

if TYPE_CHECKING:
    from augment.scene import Gaussians


@dataclass(frozen=True, eq=False)
class ColorWaves:
    """What is added to sh[:, 0] of N Gaussians over time; c_0 is sh[:, 0] itself, as b_0 is 1.

    coefficients [N, F - 1, 3]: c_1 to c_{F-1}, of the Gaussians' dtype. timestamps_ns [T]: strictly
    increasing. phases: float64 [T], t at these times; linear between them, held beyond them.
    """

    coefficients: Float[Tensor, "N terms 3"]
    timestamps_ns: Int64[Tensor, "T"]
    phases: Float[Tensor, "T"]

    def __post_init__(self) -> None:
        count = self.timestamps_ns.shape[0]
        if count < 1 or tuple(self.phases.shape) != (count,):
            raise ValueError(
                f"colour waves need T >= 1 timestamps and as many phases; got {count} and "
                f"{list(self.phases.shape)}"
            )
        if count > 1 and not bool((self.timestamps_ns.diff() > 0).all()):
            raise ValueError("timestamps of colour waves must be strictly increasing")
        if not bool(torch.isfinite(self.phases).all()):
            raise ValueError("phases of colour waves must be finite")

    @property
    def nbytes(self) -> int:
        return self.coefficients.numel() * self.coefficients.element_size()

    def phase_at(self, timestamp_ns: int) -> float:
        times, phases = self.timestamps_ns.tolist(), self.phases.tolist()
        after = bisect_right(times, timestamp_ns)
        if after == 0:
            return phases[0]
        if after == len(times):
            return phases[-1]
        share = (timestamp_ns - times[after - 1]) / (times[after] - times[after - 1])
        return phases[after - 1] + share * (phases[after] - phases[after - 1])

    def change_at(self, timestamp_ns: int) -> Float[Tensor, "N 3"]:
        """What is added to sh[:, 0] at a time."""
        weights = basis(self.phase_at(timestamp_ns), self.coefficients.shape[1] + 1)[1:]
        change = torch.zeros_like(self.coefficients[:, 0])
        for term, weight in enumerate(weights):
            change.add_(self.coefficients[:, term], alpha=weight)
        return change

    def at(self, gaussians: Gaussians, timestamp_ns: int) -> Gaussians:
        """The Gaussians in the colours of a time."""
        sh = gaussians.sh.clone()
        sh[:, 0] += self.change_at(timestamp_ns)
        return replace(gaussians, sh=sh)

    def select(self, index: Tensor) -> ColorWaves:
        """Those of the Gaussians at the given indices or mask, in that order."""
        return replace(self, coefficients=self.coefficients[index])


def basis(phase: float, terms: int) -> list[float]:
    """b_0 to b_{terms-1} at a phase."""
    return [
        math.cos(math.pi * k * phase) if k % 2 == 0 else math.sin(math.pi * (k + 1) * phase)
        for k in range(terms)
    ]
