"""Scores of robustness from a metric's values at every level of every effect.

M is the metric, 0 to 1, more is better; c an effect, s a level. Sources: mCE and mRR of Robo3D
(Kong et al., ICCV 2023), RA and RRA of MultiCorrupt (Beemelmanns et al. 2024), mPC and rPC of the
robust detection benchmark (Michaelis et al. 2019).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from augment.errors import ScoreError


@dataclass(frozen=True)
class EffectValues:
    """A metric's values in the weather of one effect."""

    clean: float
    """Value on the clean renders of the scenes that count for the effect."""
    levels: tuple[float, ...]
    """Value at each level, mildest first."""

    @property
    def resilience(self) -> float:
        """Return RR: the sum over the levels, over the number of levels times the clean value."""
        return sum(self.levels) / (len(self.levels) * self.clean)

    def corruption_error(self, baseline: EffectValues) -> float | None:
        """Return CE: the sum of 1 - M over that of a baseline; None where that makes no error."""
        baseline_error = sum(1 - value for value in baseline.levels)
        if baseline_error == 0:
            return None
        return sum(1 - value for value in self.levels) / baseline_error

    def relative_gain(self, baseline: EffectValues) -> float | None:
        """Return RRA: the sum over the levels over that of a baseline, less 1; None where the
        baseline scores 0 at every level."""
        if sum(baseline.levels) == 0:
            return None
        return sum(self.levels) / sum(baseline.levels) - 1


@dataclass(frozen=True)
class Robustness:
    """Means over effects and levels."""

    mean_performance: float
    """mPC: mean of M over effects and levels."""
    relative_performance: float
    """rPC: mPC over the clean value."""
    mean_resilience: float
    """mRR: mean over effects of RR."""
    mean_ability: float
    """mRA: mean over effects and levels of M over the clean value."""
    mean_corruption_error: float | None
    """mCE: mean of CE over the effects that have one; None without a baseline."""
    mean_relative_gain: float | None
    """mRRA: mean of RRA over the effects that have one; None without a baseline."""


def summarize(
    effects: Mapping[str, EffectValues], baseline: Mapping[str, EffectValues] | None = None
) -> Robustness:
    """Return the scores of robustness over all effects.

    Args:
        effects: Values by effect.
        baseline: Values of the baseline for the same effects and levels.

    Raises:
        ScoreError: A clean value is 0, or the baseline lacks an effect or level.
    """
    for name, values in effects.items():
        if not values.clean > 0:
            raise ScoreError(
                f"the clean value is {values.clean} for {name}: without a hit in clear air, "
                f"robustness has no meaning. Check categories, image numbers and box coordinates"
            )
    if baseline is not None:
        wrong = [
            name
            for name, values in effects.items()
            if name not in baseline or len(baseline[name].levels) != len(values.levels)
        ]
        if wrong:
            raise ScoreError(f"the baseline lacks effects, or levels of them: {', '.join(wrong)}")
    rows = [*effects.values()]
    level_means = [value for row in rows for value in row.levels]
    abilities = [value / row.clean for row in rows for value in row.levels]
    errors = gains = None
    if baseline is not None:
        pairs = [(row, baseline[name]) for name, row in effects.items()]
        errors = _mean_of_known([row.corruption_error(base_row) for row, base_row in pairs])
        gains = _mean_of_known([row.relative_gain(base_row) for row, base_row in pairs])
    return Robustness(
        mean_performance=_mean(level_means),
        relative_performance=_mean(level_means) / _mean([row.clean for row in rows]),
        mean_resilience=_mean([row.resilience for row in rows]),
        mean_ability=_mean(abilities),
        mean_corruption_error=errors,
        mean_relative_gain=gains,
    )


def _mean(values: Sequence[float]) -> float:
    """Return the mean of numbers."""
    return float(np.mean(values))


def _mean_of_known(values: Sequence[float | None]) -> float | None:
    """Return the mean of the numbers that are known; None if none is."""
    known_values = [value for value in values if value is not None]
    return _mean(known_values) if known_values else None
