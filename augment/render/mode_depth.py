"""Mode depth: the depth along a ray at which the heaviest cluster of splats is most dense.

A pixel's samples are (z, w), the depth and the weight alpha T of every splat, nearest first. They
are clustered in that order. The running cluster, with weight W, mean and variance var of its
depths, is taken for a Gumbel distribution, by moments

    beta = sqrt(6 var) / pi,    mu = mean - gamma beta,    gamma: Euler's constant,

and the next sample joins where that density is more than half its peak. With u = (z - mu) / beta,
log density(u) / density(0) = 1 - u - exp(-u), so it joins where LOW < u < HIGH, the two solutions
of u + exp(-u) - 1 = log 2, which have no unit of length. A sample that does not join closes the
cluster and begins the next one. Mode depth is mu of the heaviest cluster, the nearest of equals.
Where a ray passes a near edge, mean and median depth lie between near and far; mode depth does not.

After He et al. 2025 (ClimateGS), "Gumbel distribution", with three departures. The density is
compared with its own peak, so that the result scales with the unit of length. The last cluster is
compared too. And a floor, max(floor, beta), keeps beta from vanishing where samples join, but not
in the result: the mode of an opaque surface is its depth, and with a floor it would be nearer by
gamma floor, 11 cm. mu may lie before the nearest sample of a cluster by up to 5 % of its extent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

# Euler's constant.
GAMMA = 0.5772156649015329
# Smallest u at which a sample joins a cluster.
LOW = -0.9851998094567154
# Largest u at which a sample joins a cluster.
HIGH = 1.4611862275734109
# beta of a Gumbel distribution of standard deviation 1.
BETA_PER_SIGMA = math.sqrt(6) / math.pi
# Largest distance of a joining sample behind the mean, in beta.
FARTHER = HIGH - GAMMA
# Largest distance of a joining sample before the mean, in beta.
NEARER = GAMMA - LOW


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters of the samples of P rays so far.

    first: depth with which the running cluster began.
    mass: sum of the weights of the running cluster.
    moment: sum of weight times (z - first) of the running cluster.
    square: sum of weight times (z - first)^2 of the running cluster.
    best_mass: sum of the weights of the heaviest closed cluster.
    best_mode: mode of the heaviest closed cluster.
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
        """Return the clusters with the next sample of each ray. Samples of weight 0 are ignored."""
        with torch.no_grad():
            beta = (BETA_PER_SIGMA * self._sigma()).clamp_min(floor_m)
            u = (depths - self._mean()) / beta + GAMMA
            has_joined = (u > LOW) & (u < HIGH) & (self.mass > 0)
            is_new = (weights > 0) & ~has_joined
            is_heavier = is_new & (self.mass > self.best_mass)
        first = torch.where(is_new, depths.detach(), self.first)  # any depth nearby would do
        depth_offset = torch.where(weights > 0, depths - first, 0)
        mass, moment, square = (
            torch.where(is_new, 0, sums) for sums in (self.mass, self.moment, self.square)
        )
        return Clusters(
            first,
            mass + weights,
            moment + weights * depth_offset,
            square + weights * depth_offset * depth_offset,
            torch.where(is_heavier, self.mass, self.best_mass),
            torch.where(is_heavier, self._mode(), self.best_mode),
        )

    def heaviest_mode(self) -> Float[Tensor, "P"]:
        """Return the mode of the heaviest cluster, running one included; 0 without a cluster."""
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
