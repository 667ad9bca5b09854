"""How the style network is trained: lengths, weights and schedule, the paper's where it says."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

from augment.style.pair_losses import PairWeights

Through = Literal["picture", "renderer"]
LEARNING_RATES = {"small": 1e-3, "b0": 1e-4}  # the paper's is B0's, which starts from ImageNet


@dataclass(frozen=True)
class StyleTrainConfig:
    """One training.

    steps: of the optimiser (Adam); the paper takes 300,000. learning_rate is multiplied by `decay`
    after each third of them. warm_up: the part of the steps in which the cycle loss is alone.
    style, consistency, cycle: weights of L_s, L_con and L_cyc; pairs: of the losses of pairs, which
    pair_weights weigh among themselves. batch: contents with a style each, a step; pair_batch:
    pairs. scene_share: of the contents, where there are both scenes and photos. perturbed: share of
    the style pictures that are recoloured first. colors: Gaussians, or pixels, whose colours are
    compared, an item. through: see augment.style.scene_views. gradient_limit: norm that a step's
    gradient is shortened to, where it is longer.

    Raises:
        ValueError: a value outside its range.
    """

    steps: int
    seed: int = 0
    learning_rate: float = LEARNING_RATES["small"]
    decay: float = 0.1
    warm_up: float = 0.1
    style: float = 1.0
    consistency: float = 10.0
    cycle: float = 10.0
    pairs: float = 1.0
    pair_weights: PairWeights = field(default_factory=PairWeights)
    batch: int = 2
    pair_batch: int = 4
    scene_share: float = 0.5
    perturbed: float = 0.5
    colors: int = 1024
    through: Through = "picture"
    gradient_limit: float = 10.0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "pair_batch", "colors"):
            self._check(name, getattr(self, name) >= 1, "at least 1")
        for name in ("warm_up", "scene_share", "perturbed"):
            self._check(name, 0 <= getattr(self, name) <= 1, "between 0 and 1")
        for name in ("style", "consistency", "cycle", "pairs"):
            value = getattr(self, name)
            self._check(name, math.isfinite(value) and value >= 0, "finite and at least 0")
        for name, value in dataclasses.asdict(self.pair_weights).items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"pair_weights.{name} must be finite and at least 0; got {value!r}"
                )
        for name in ("learning_rate", "gradient_limit"):
            value = getattr(self, name)
            self._check(name, math.isfinite(value) and value > 0, "finite and above 0")
        self._check("decay", 0 < self.decay <= 1, "above 0 and at most 1")
        self._check("through", self.through in ("picture", "renderer"), "picture or renderer")
        if not self.style + self.consistency + self.cycle + self.pairs > 0:
            raise ValueError("all losses weigh 0: nothing would be learnt")

    def learning_rate_at(self, step: int) -> float:
        """Of the step with this number, counted from 0."""
        return self.learning_rate * self.decay ** (3 * step // self.steps)

    def is_warming_up(self, step: int) -> bool:
        """Whether the cycle loss is alone in this step; never, where it weighs nothing."""
        return self.cycle > 0 and step < self.warm_up * self.steps

    def _check(self, name: str, is_good: bool, wanted: str) -> None:
        if not is_good:
            raise ValueError(f"{name} must be {wanted}; got {getattr(self, name)!r}")
