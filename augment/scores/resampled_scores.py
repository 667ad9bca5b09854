"""Intervals of a metric and of all scores that follow from it: a bootstrap by scene.

The metric is computed in each resample of scenes, and the scores of `augment.scores.robustness`
from its values there. The clean render, all variants and the baseline have the same resamples:
intervals of differences and quotients are those of pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from augment.scores.scene_bootstrap import interval_ends
from augment.scores.suite_scores import EffectScores, Interval, SuiteScores

# Number of resamples of a metric; each is computed like the metric itself.
NUM_METRIC_RESAMPLES = 1000
Resamples = Float64[np.ndarray, " R"]


@dataclass(frozen=True, eq=False)
class ResampledEffect:
    """A metric in the weather of one effect, in each resample; NaN where no object counts."""

    clean: Resamples
    """Value on the clean renders of the scenes that count."""
    levels: Float64[np.ndarray, "L R"]
    """Value at each level, mildest first."""
    num_scenes: int
    """Number of scenes that count. Resamples of one scene are all alike: no interval follows."""

    @property
    def resilience(self) -> Resamples:
        """Return RR."""
        return self.levels.mean(axis=0) / self.clean

    def corruption_error(self, baseline: ResampledEffect) -> Resamples:
        """Return CE against a baseline."""
        return (1 - self.levels).sum(axis=0) / (1 - baseline.levels).sum(axis=0)

    def relative_gain(self, baseline: ResampledEffect) -> Resamples:
        """Return RRA against a baseline."""
        return self.levels.sum(axis=0) / baseline.levels.sum(axis=0) - 1


@dataclass(frozen=True, eq=False)
class ResampledValues:
    """A metric in each resample of scenes."""

    clean: Resamples
    """Value on all clean renders."""
    effects: dict[str, ResampledEffect]
    """Values by effect."""

    def means(self, baseline: ResampledValues | None = None) -> dict[str, Resamples]:
        """Return the means over effects and levels, by field of `RobustnessScores`."""
        rows = [*self.effects.values()]
        performance = np.concatenate([row.levels for row in rows]).mean(axis=0)
        abilities = np.concatenate([row.levels / row.clean for row in rows])
        means = {
            "mpc": performance,
            "rpc": performance / np.mean([row.clean for row in rows], axis=0),
            "mrr": np.mean([row.resilience for row in rows], axis=0),
            "mra": abilities.mean(axis=0),
        }
        if baseline is not None:
            pairs = [(row, baseline.effects[name]) for name, row in self.effects.items()]
            errors = [row.corruption_error(base_row) for row, base_row in pairs]
            gains = [row.relative_gain(base_row) for row, base_row in pairs]
            means |= {"mce": _mean_of_finite(errors), "mrra": _mean_of_finite(gains)}
        return means


def _mean_of_finite(rows: Sequence[Resamples]) -> Resamples:
    """Return the mean over the rows that have a value, in each resample; NaN where none has."""
    values = np.array(rows)
    has_value = np.isfinite(values)
    return np.where(has_value, values, 0).sum(axis=0) / has_value.sum(axis=0)


def find_interval(values: Resamples) -> Interval | None:
    """Return the interval of the resamples that have a value; None if none has."""
    usable = values[np.isfinite(values)]
    return interval_ends(usable) if len(usable) else None


def add_intervals(
    scores: SuiteScores, values: ResampledValues, baseline: ResampledValues | None = None
) -> SuiteScores:
    """Return scores with the intervals of the metric and of all scores that follow from it.

    Args:
        scores: Scores of a network.
        values: Its metric in each resample.
        baseline: The baseline's metric in the same resamples, if scores compare with it.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        means = values.means(baseline)
        effects = {
            name: _with_intervals(
                effect, values.effects[name], None if baseline is None else baseline.effects[name]
            )
            for name, effect in scores.effects.items()
        }
    robustness = {f"{name}_interval": find_interval(mean) for name, mean in means.items()}
    return scores.model_copy(
        update={
            "clean_interval": find_interval(values.clean),
            "effects": effects,
            "robustness": scores.robustness.model_copy(update=robustness),
        }
    )


def _with_intervals(
    effect: EffectScores, values: ResampledEffect, baseline: ResampledEffect | None
) -> EffectScores:
    """Return the scores of an effect with their intervals; without any for a single scene."""
    if values.num_scenes < 2:
        return effect
    updates: dict[str, object] = {"resilience_interval": find_interval(values.resilience)}
    if baseline is not None:
        updates["corruption_error_interval"] = find_interval(values.corruption_error(baseline))
        updates["relative_gain_interval"] = find_interval(values.relative_gain(baseline))
    levels = []
    for k, level in enumerate(effect.levels):
        intervals = {"metric_interval": find_interval(values.levels[k])}
        if baseline is not None:
            difference = values.levels[k] - baseline.levels[k]
            intervals["difference_interval"] = find_interval(difference)
        levels.append(level.model_copy(update=intervals))
    return effect.model_copy(update={**updates, "levels": tuple(levels)})
