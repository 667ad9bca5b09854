"""Colours that change over time: a Fourier series of every splat's view-independent colour.

Street Gaussians gives an actor's splats such colours (Yan et al. 2024, section 3.1, "4D spherical
harmonics"): sh_00(t) = sum_k c_k b_k(t) with b_k = cos(pi k t) for even k, sin(pi (k + 1) t) for
odd k.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from augment import color_kernels
from augment.render.sh import rotate_sh, sh_turn
from augment.render.threads import kernel_threads


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

    def weights_at(self, timestamp_ns: int) -> list[float]:
        """b_1 to b_{F-1} at a time."""
        return basis(self.phase_at(timestamp_ns), self.coefficients.shape[1] + 1)[1:]

    def change_at(self, timestamp_ns: int) -> Float[Tensor, "N 3"]:
        """What is added to sh[:, 0] at a time."""
        weights = self.weights_at(timestamp_ns)
        change = torch.zeros_like(self.coefficients[:, 0])
        for term, weight in enumerate(weights):
            change.add_(self.coefficients[:, term], alpha=weight)
        return change


def basis(phase: float, terms: int) -> list[float]:
    """b_0 to b_{terms-1} at a phase."""
    return [
        math.cos(math.pi * k * phase) if k % 2 == 0 else math.sin(math.pi * (k + 1) * phase)
        for k in range(terms)
    ]


def colors_at(
    sh: Float[Tensor, "N K 3"],
    waves: ColorWaves | None,
    timestamp_ns: int,
    turn: Float[Tensor, "3 3"] | None,
    *,
    fast: bool = True,
) -> Float[Tensor, "N K 3"]:
    """SH in the colours of a time, and turned by a rotation, where there are such.

    fast: float32 goes through the CPU kernel, equal to the definition here within float rounding.
    """
    if fast and sh.dtype == torch.float32 and not sh.requires_grad:
        return _colors_by_kernel(sh, waves, timestamp_ns, turn)
    if waves is not None:
        first = sh[:, :1] + waves.change_at(timestamp_ns)[:, None]
        sh = torch.cat([first, sh[:, 1:]], 1)
    return sh if turn is None or sh.shape[1] == 1 else rotate_sh(sh, turn)


def _colors_by_kernel(
    sh: Tensor, waves: ColorWaves | None, timestamp_ns: int, turn: Tensor | None
) -> Tensor:
    coefficients, weights = np.zeros((len(sh), 0, 3), np.float32), []
    if waves is not None:
        coefficients = waves.coefficients.detach().contiguous().numpy()
        weights = waves.weights_at(timestamp_ns)
    matrix = np.zeros((0, 0), np.float32)
    if turn is not None and sh.shape[1] > 1:
        matrix = sh_turn(turn, math.isqrt(sh.shape[1]) - 1).numpy().astype(np.float32)
    out = np.empty(tuple(sh.shape), np.float32)
    with kernel_threads(1):
        color_kernels.colors_at(
            sh.detach().contiguous().numpy(),
            coefficients,
            np.asarray(weights, np.float32),
            matrix,
            out,
        )
    return torch.from_numpy(out)
