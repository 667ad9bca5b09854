"""Scores of one network on a suite, as they are written to JSON and read as a baseline."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from augment.errors import ScoreError
from augment.output.atomic import read_file
from augment.scores.robustness import EffectValues

# Lower and upper end.
Interval = tuple[float, float]


class _Closed(BaseModel):
    """Base of the parts of the file."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, ser_json_inf_nan="strings"
    )


class LevelScore(_Closed):
    """Score at one level of an effect."""

    variant: str
    """Name of the variant, such as `fog-3`."""
    level: int
    """Level, from 1 on."""
    value: float | None
    """The effect's physical number."""
    metric: float
    """The metric, 0 to 1."""
    metric_interval: Interval | None = None
    """Its interval of 95 %, a bootstrap by scene; None with a single scene, and for NDS."""
    difference: float | None = None
    """The metric less the baseline's; None without a baseline."""
    difference_interval: Interval | None = None
    """Its interval of 95 %, in pairs; None where the baseline's predictions are not known."""
    ability: float
    """RA: the metric over that on the clean renders of the same scenes."""
    by_category: dict[str, float | None]
    """The metric by category; None where no object counts."""
    recall: float | None
    """Share of the objects that are found at the clean threshold; None for semantics and NDS."""
    recall_interval: Interval | None
    """Its interval of 95 %, a bootstrap by scene; None with a single scene."""
    false_per_image: float | None
    """False positives per image at the clean threshold."""


class HalfRecallScore(_Closed):
    """V50: the physical number at which recall has halved."""

    text: str
    """The number with its unit, or on which side of the levels it lies, or between which levels of
    the same number."""
    value: float | None
    """The number; None if it lies outside the levels, or between two of the same number."""
    interval: tuple[str, str] | None
    """Its interval of 95 %, a bootstrap by scene; None with a single scene."""


class EffectScores(_Closed):
    """Scores in the weather of one effect."""

    number: str
    """Name of the effect's physical number."""
    unit: str
    """Unit of that number."""
    omitted_scenes: tuple[str, ...]
    """Scenes whose recording has the effect already; they do not count here."""
    clean: float
    """The metric on the clean renders of the scenes that count."""
    clean_recall: float | None
    """Recall there."""
    levels: tuple[LevelScore, ...]
    """Scores by level, mildest first."""
    resilience: float
    """RR: sum over the levels, over the number of levels times the clean value."""
    resilience_interval: Interval | None = None
    """Its interval of 95 %."""
    corruption_error: float | None
    """CE against the baseline."""
    corruption_error_interval: Interval | None = None
    """Its interval of 95 %, in pairs."""
    relative_gain: float | None
    """RRA against the baseline."""
    relative_gain_interval: Interval | None = None
    """Its interval of 95 %, in pairs."""
    half_recall: HalfRecallScore | None
    """V50; None for effects without a physical number, semantics and NDS."""

    @property
    def values(self) -> EffectValues:
        """Return the metric's values alone."""
        return EffectValues(self.clean, tuple(level.metric for level in self.levels))


class RecallBinScore(_Closed):
    """Recall of the objects in a range of a number."""

    lower: float
    """Lower bound of the number."""
    upper: float | None
    """Upper bound; None for none."""
    objects: int
    """Number of objects, over all levels."""
    num_found: int
    """Number of them that are found at the clean threshold."""
    recall: float | None
    """Share that is found; None without objects."""


class RecallBins(_Closed):
    """Recall of one effect by what was visible of each object, over all levels."""

    transmittance: tuple[RecallBinScore, ...]
    """By the share of the object's light that the weather lets through."""
    visible_fraction: tuple[RecallBinScore, ...]
    """By the share that other objects leave visible."""
    range_m: tuple[RecallBinScore, ...]
    """By the distance from the camera, metres."""


class WorstObject(_Closed):
    """An object in such an image."""

    box: tuple[float, float, float, float]
    """Left, top, right, bottom of the pixels that show it."""
    is_found: bool
    """True if it is found in this variant."""
    is_found_clean: bool
    """True if it is found in the clean render."""


class WorstImage(_Closed):
    """An image in which the weather costs a detector most."""

    variant: str
    """Name of the variant."""
    number: int
    """Number of the image."""
    scene: str
    """Name of the scene."""
    frame: int
    """Frame number."""
    camera: str
    """Name of the camera."""
    path: str
    """Path of the image in the output."""
    clean_path: str
    """Path of the clean render."""
    clean_hits: float
    """Objects that are found in the clean render; of semantics the share of right pixels."""
    hits: float
    """The same in this variant."""
    objects: tuple[WorstObject, ...]
    """Objects that count; none for semantics."""


class RobustnessScores(_Closed):
    """Means over effects and levels."""

    mpc: float
    """mPC: mean of the metric over effects and levels."""
    mpc_interval: Interval | None = None
    """Its interval of 95 %."""
    rpc: float
    """rPC: mPC over the clean value."""
    rpc_interval: Interval | None = None
    """Its interval of 95 %."""
    mrr: float
    """mRR: mean resilience."""
    mrr_interval: Interval | None = None
    """Its interval of 95 %."""
    mra: float
    """mRA: mean resilience ability."""
    mra_interval: Interval | None = None
    """Its interval of 95 %."""
    mce: float | None
    """mCE against the baseline; less is better."""
    mce_interval: Interval | None = None
    """Its interval of 95 %."""
    mrra: float | None
    """mRRA against the baseline; more is better."""
    mrra_interval: Interval | None = None
    """Its interval of 95 %."""


class SuiteScores(_Closed):
    """All scores."""

    format: int = 1
    """Version of the file's format."""
    suite: str
    """Name of the suite, with its version."""
    suite_sha256: str
    """SHA-256 of the content of its `suite.json`."""
    images_sha256: str
    """SHA-256 of the identities of the images that were scored."""
    code_version: str
    """Version of this package."""
    metric: str
    """Name of the metric."""
    images: int
    """Number of images of a variant."""
    scenes: int
    """Number of scenes."""
    objects: int | None
    """Number of objects that count in the images of a variant; None for semantics and NDS."""
    categories: tuple[str, ...]
    """Names of the categories."""
    threshold: float | None
    """Clean threshold: the confidence at which F1 on the clean renders is largest."""
    clean: float
    """The metric on all clean renders (clean-rendered)."""
    clean_interval: Interval | None = None
    """Its interval of 95 %, a bootstrap by scene; None with a single scene, and for NDS."""
    clean_by_category: dict[str, float | None]
    """The same by category."""
    clean_recall: float | None
    """Recall on all clean renders at the clean threshold."""
    clean_false_per_image: float | None
    """False positives per image there."""
    recorded: float | None
    """The metric on the recorded images (clean-recorded); None where these were not predicted."""
    robustness: RobustnessScores
    """Means over effects and levels."""
    effects: dict[str, EffectScores]
    """Scores by effect."""
    recall_bins: dict[str, RecallBins]
    """Recall by what was visible, by effect."""
    worst_images: tuple[WorstImage, ...]
    """Images in which the weather costs most."""
    baseline: str | None
    """Path of the baseline."""
    warnings: tuple[str, ...]
    """Doubts about the scores."""
    notes: tuple[str, ...]
    """Images, scenes and labels that do not count."""

    @property
    def values(self) -> dict[str, EffectValues]:
        """Return the metric's values alone, by effect."""
        return {name: effect.values for name, effect in self.effects.items()}


def read_scores(path: Path) -> SuiteScores:
    """Return scores that `climategs score --json` wrote.

    Raises:
        ScoreError: The file is missing or damaged.
    """
    try:
        return SuiteScores.model_validate_json(read_file(path))
    except (OSError, ValidationError) as error:
        raise ScoreError(f"{path} holds no scores of `climategs score`: {error!s:.300}") from error


def check_baseline(scores: SuiteScores, baseline: SuiteScores, where: str) -> list[str]:
    """Refuse a baseline of another suite, metric or images; return warnings.

    Raises:
        ScoreError: The baseline cannot be compared with.
    """
    shared_effects = scores.effects.keys() & baseline.effects.keys()
    facts = {
        "suite": (scores.suite, baseline.suite),
        "metric": (scores.metric, baseline.metric),
        "categories": (scores.categories, baseline.categories),
        "images (scenes, frames and cameras)": (scores.images_sha256, baseline.images_sha256),
        "scenes that do not count": tuple(
            {name: record.effects[name].omitted_scenes for name in sorted(shared_effects)}
            for record in (scores, baseline)
        ),
        "levels": tuple(
            {
                name: tuple(level.level for level in record.effects[name].levels)
                for name in sorted(shared_effects)
            }
            for record in (scores, baseline)
        ),
    }  # fmt: skip
    for name, (value, baseline_value) in facts.items():
        if value != baseline_value:
            raise ScoreError(
                f"the baseline {where} is of another {name}: {baseline_value} there, {value} here; "
                f"score the baseline's predictions on this suite"
            )
    if scores.suite_sha256 == baseline.suite_sha256:
        return []
    return [
        f"the baseline {where} was scored on other files of {scores.suite}: rendered by another "
        f"version or backend, or at another scale"
    ]
