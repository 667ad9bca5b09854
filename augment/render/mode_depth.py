"""Mode depth: where along a ray the heaviest cluster of what it meets is most dense.

A pixel's samples are (z, w), the depth and the weight alpha T of every splat, nearest first. They
are clustered as they come. The running cluster, with weight W, mean and variance var of its
depths, is taken for a Gumbel distribution, by moments

    beta = sqrt(6 var) / pi,    mu = mean - gamma beta,    gamma: Euler's constant,

and the next sample joins where that density is more than half its peak. With u = (z - mu) / beta,
log density(u) / density(0) = 1 - u - exp(-u), so it joins where LOW < u < HIGH, the two solutions
of u + exp(-u) - 1 = log 2, which have no unit of length. A sample that does not join closes the
cluster and begins the next one. Mode depth is mu of the heaviest cluster, the nearest of equals;
mean and median depth of a ray that passes a near edge lie between near and far, mode depth does
not.

After He et al. 2025 (ClimateGS), "Gumbel distribution", with three departures. The density is
compared with its own peak, so that the result scales with the unit of length. The last cluster is
compared too. And beta is kept from vanishing where samples join, by max(floor, beta), but not in
the result: an opaque surface's mode is its depth, and would with a floor be gamma floor, 11 cm,
nearer. mu may lie before the nearest sample of a cluster by up to 5 % of its extent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

GAMMA = 0.5772156649015329
LOW, HIGH = -0.9851998094567154, 1.4611862275734109
BETA_PER_SIGMA = math.sqrt(6) / math.pi
# The same interval about the mean, in beta: how much farther and how much nearer a sample may be.
FARTHER, NEARER = HIGH - GAMMA, GAMMA - LOW


@dataclass(frozen=True, eq=False)
class Clusters:
    """What is known of P rays so far.

    Of the running cluster: first, the depth that it began with; mass, the sum of its weights; then
    those of weight times (z - first), and times its square. best_mass, best_mode: of the heaviest
    closed one.
    """

    first: Float[Tensor, "P"]
    mass: Float[Tensor, "P"]
    moment: Float[Tensor, "P"]
    square: Float[Tensor, "P"]
    best_mass: Float[Tensor, "P"]
    best_mode: Float[Tensor, "P"]

    @staticmethod
    def empty(count: int, dtype: torch.dtype) -> Clusters:
        return Clusters(*torch.zeros(6, count, dtype=dtype))

    def add(
        self, depths: Float[Tensor, "P"], weights: Float[Tensor, "P"], floor_m: float
    ) -> Clusters:
        """With the next sample of each ray; those of weight 0 do not count."""
        with torch.no_grad():
            beta = (BETA_PER_SIGMA * self._sigma()).clamp_min(floor_m)
            u = (depths - self._mean()) / beta + GAMMA
            joins = (u > LOW) & (u < HIGH) & (self.mass > 0)
            begins = (weights > 0) & ~joins
            heavier = begins & (self.mass > self.best_mass)
        first = torch.where(begins, depths.detach(), self.first)  # any point near will do
        off = torch.where(weights > 0, depths - first, 0)
        mass, moment, square = (
            torch.where(begins, 0, sums) for sums in (self.mass, self.moment, self.square)
        )
        return Clusters(
            first,
            mass + weights,
            moment + weights * off,
            square + weights * off * off,
            torch.where(heavier, self.mass, self.best_mass),
            torch.where(heavier, self._mode(), self.best_mode),
        )

    def heaviest_mode(self) -> Float[Tensor, "P"]:
        """Mode of the heaviest cluster, the running one included; 0 where there is none."""
        return torch.where(self.mass > self.best_mass, self._mode(), self.best_mode)

    def _mean(self) -> Tensor:
        return self.first + self.moment / self._positive_mass()

    def _sigma(self) -> Tensor:
        spread = self.mass * self.square - self.moment * self.moment  # mass^2 var
        # The slope of sqrt is infinite at 0, where it is taken as 0.
        is_spread = spread > torch.finfo(spread.dtype).tiny
        root = torch.sqrt(torch.where(is_spread, spread, 1))
        return torch.where(is_spread, root, 0) / self._positive_mass()

    def _mode(self) -> Tensor:
        return self._mean() - GAMMA * BETA_PER_SIGMA * self._sigma()

    def _positive_mass(self) -> Tensor:
        return torch.where(self.mass > 0, self.mass, 1)
