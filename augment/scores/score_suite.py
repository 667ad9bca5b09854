"""Scoring of a network on a suite: predictions are read, checked, measured and compared.

In: an output in which a suite was rendered, and a folder of predictions with a folder for each
variant. Out: `SuiteScores`. Nothing is scored unless everything fits: images, categories, variants,
probes, baseline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import augment
from augment.errors import ScoreError
from augment.output.store import Store
from augment.scores.guards import (
    check_equal_predictions,
    check_probes,
    check_variants,
    equal_picture_warnings,
    equal_score_warnings,
)
from augment.scores.half_recall import Levels, find_half_recall
from augment.scores.kitti_metric import KittiView
from augment.scores.metric_values import (
    CocoMetric,
    KittiMetric,
    Metric,
    MetricValue,
    NuScenesMetric,
    SemanticMetric,
)
from augment.scores.nuscenes_metric import NuScenesSplit
from augment.scores.predictions import (
    ExpectedImages,
    PredictionKind,
    Predictions,
    find_kind,
    read_predictions,
)
from augment.scores.recall import (
    RANGE_BOUNDS_M,
    SHARE_BOUNDS,
    ImageHits,
    RecallBin,
    best_threshold,
    match_image,
    recall_by,
)
from augment.scores.resampled_precision import SceneResampling
from augment.scores.resampled_scores import (
    NUM_METRIC_RESAMPLES,
    ResampledEffect,
    ResampledValues,
    add_intervals,
)
from augment.scores.robustness import EffectValues, summarize
from augment.scores.scene_bootstrap import recall_interval, resample_scenes
from augment.scores.suite_facts import CLEAN_VARIANT, RenderedSuite, list_names, read_suite
from augment.scores.suite_scores import (
    EffectScores,
    HalfRecallScore,
    LevelScore,
    RecallBins,
    RecallBinScore,
    RobustnessScores,
    SuiteScores,
    WorstImage,
    WorstObject,
    check_baseline,
    read_scores,
)
from augment.scores.truth import SuiteTruth, read_transmittances, read_truth
from recipes.schema import Category

# Folder of predictions for the recorded images, beside those of the variants.
RECORDED = "recorded"
# Seed of the bootstrap.
BOOTSTRAP_SEED = 20_080_501
# Number of worst images of an effect, and of all effects.
MAX_WORST_OF_EFFECT = 2
MAX_WORST = 16


@dataclass(frozen=True)
class ScoreOptions:
    """Options of `score_suite`."""

    effects: tuple[str, ...] | None = None
    """Effects that are scored; None for all of the suite."""
    categories: Sequence[Category] | None = None
    """Table from the dataset's labels to categories; None makes every label one."""
    kitti_view: KittiView = "bbox"
    """Overlap of KITTI's AP."""
    kitti_difficulty: str = "moderate"
    """Difficulty of KITTI's AP: easy, moderate or hard."""
    nuscenes: NuScenesSplit | None = None
    """Samples of nuScenes, for NDS."""


@dataclass(frozen=True, eq=False)
class _Run:
    """Everything that the scores of one network are computed from."""

    suite: RenderedSuite
    effects: dict[str, tuple[str, ...]]
    """Variants of each effect that is scored, mildest first."""
    predictions: dict[str, Predictions]
    """Predictions by variant."""
    metric: Metric
    truth: SuiteTruth | None
    """True objects; None for semantics and NDS."""
    hits: dict[str, list[ImageHits]]
    """Matched objects of each image by variant; empty for semantics and NDS."""
    threshold: float
    """Clean threshold; inf for semantics and NDS."""


def score_suite(
    store: Store, folder: Path, baseline: Path | None = None, options: ScoreOptions = ScoreOptions()
) -> SuiteScores:
    """Return the scores of predictions on a suite.

    Args:
        store: Output in which the suite was rendered.
        folder: Folder with a folder of predictions for each variant, and `recorded` if wanted.
        baseline: Folder of a baseline's predictions, or scores of it in JSON.
        options: Options.

    Raises:
        ScoreError: The predictions or the baseline do not fit the suite.
        OutputError: The suite is missing or damaged.
    """
    run = _open_run(read_suite(store), folder, options)
    scores, values = _make_scores(run, folder)
    base_values = None
    if baseline is not None:
        if baseline.is_dir():
            base_scores, base_values = _make_scores(
                _open_run(run.suite, baseline, options), baseline
            )
        else:
            base_scores = read_scores(baseline)
        scores = add_baseline(scores, base_scores, str(baseline))
    return scores if values is None else add_intervals(scores, values, base_values)


def add_baseline(scores: SuiteScores, baseline: SuiteScores, where: str) -> SuiteScores:
    """Return scores with those that compare with a baseline.

    Args:
        where: Path of the baseline.

    Raises:
        ScoreError: The baseline is of another suite, metric or images.
    """
    warnings = check_baseline(scores, baseline, where)
    base_values = baseline.values
    summary = summarize(scores.values, base_values)
    effects = {
        name: effect.model_copy(
            update={
                "levels": _differences(effect, baseline.effects[name]),
                "corruption_error": effect.values.corruption_error(base_values[name]),
                "relative_gain": effect.values.relative_gain(base_values[name]),
            }
        )
        for name, effect in scores.effects.items()
    }
    robustness = scores.robustness.model_copy(
        update={"mce": summary.mean_corruption_error, "mrra": summary.mean_relative_gain}
    )
    return scores.model_copy(
        update={
            "effects": effects,
            "robustness": robustness,
            "baseline": where,
            "warnings": (*scores.warnings, *warnings),
        }
    )


def _differences(effect: EffectScores, baseline: EffectScores) -> tuple[LevelScore, ...]:
    """Return the levels of an effect with the metric less the baseline's."""
    pairs = zip(effect.levels, baseline.levels, strict=True)
    return tuple(
        level.model_copy(update={"difference": level.metric - base_level.metric})
        for level, base_level in pairs
    )


def _open_run(suite: RenderedSuite, folder: Path, options: ScoreOptions) -> _Run:
    """Read and check the predictions of a network."""
    if not folder.is_dir():
        raise ScoreError(f"{folder} is no folder; expected one with a folder for each variant")
    effects = _choose_effects(suite, options.effects)
    variants = [CLEAN_VARIANT, *(name for names in effects.values() for name in names)]
    check_variants(variants, lambda name: (folder / name).is_dir(), str(folder))
    folder_names = {path.name for path in folder.iterdir() if path.is_dir()}
    other_folders = folder_names - {*suite.rows, RECORDED}
    if other_folders:
        raise ScoreError(
            f"{folder} has folders that are no variant of {suite.name}: "
            f"{list_names(sorted(other_folders))}"
        )
    kinds: dict[str, PredictionKind] = {name: find_kind(folder / name) for name in variants}
    if len(set(kinds.values())) > 1:
        by_kind = {kind: name for name, kind in kinds.items()}
        texts = ", ".join(f"{kind} in {name}" for kind, name in by_kind.items())
        raise ScoreError(f"{folder} mixes formats of predictions: {texts}")
    kind = kinds[CLEAN_VARIANT]
    truth = read_truth(suite, options.categories) if kind in ("coco", "kitti") else None
    predictions = {
        name: read_predictions(folder / name, kind, _expected_images(suite, truth, name))
        for name in variants
    }
    check_probes(suite, predictions)
    check_equal_predictions(suite, predictions)
    metric = _choose_metric(suite, truth, kind, options)
    run = _Run(suite, effects, predictions, metric, truth, {}, np.inf)
    if truth is None:
        return run
    hits = {name: _match_images(truth, of_variant) for name, of_variant in predictions.items()}
    return replace(run, hits=hits, threshold=best_threshold(hits[CLEAN_VARIANT]))


def _match_images(truth: SuiteTruth, predictions: Predictions) -> list[ImageHits]:
    """Return the matched objects of each image."""
    pairs = zip(truth.images, predictions.detections, strict=True)
    return [match_image(objects, boxes, predictions.kind) for objects, boxes in pairs]


def _choose_effects(
    suite: RenderedSuite, names: Sequence[str] | None
) -> dict[str, tuple[str, ...]]:
    """Return the variants of the chosen effects that have a scene to score."""
    unknown = [name for name in names or () if name not in suite.effects]
    if unknown:
        raise ScoreError(
            f"{suite.name} was not rendered with {', '.join(unknown)}; its effects are "
            f"{', '.join(suite.effects)}"
        )
    effects = {
        name: variants
        for name, variants in suite.effects.items()
        if (names is None or name in names) and suite.numbers_of(name)
    }
    if not effects:
        raise ScoreError(
            f"{suite.store.uri}: no effect can be scored: the suite has no level above 0, or every "
            f"scene was recorded in such weather"
        )
    return effects


def _expected_images(
    suite: RenderedSuite, truth: SuiteTruth | None, variant: str
) -> ExpectedImages:
    """Return what predictions for a variant may name."""
    paths = tuple(row["image_path"] for row in suite.rows[variant])
    return ExpectedImages(suite.images, paths, () if truth is None else truth.categories)


def _choose_metric(
    suite: RenderedSuite, truth: SuiteTruth | None, kind: str, options: ScoreOptions
) -> Metric:
    """Return the metric of a kind of predictions."""
    if truth is not None:
        if kind == "coco":
            return CocoMetric(truth)
        return KittiMetric(truth, options.kitti_view, options.kitti_difficulty)
    if kind == "semantic":
        return SemanticMetric(suite)
    if options.nuscenes is None:
        raise ScoreError("nuScenes results need the dataset's annotations: --nuscenes PATH")
    return NuScenesMetric(suite, options.nuscenes)


def _resample_images(suite: RenderedSuite) -> SceneResampling | None:
    """Return resamples of the scenes of all images; None with a single scene."""
    names, scene_numbers = np.unique([image.scene for image in suite.images], return_inverse=True)
    if len(names) < 2:
        return None
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    weights = resample_scenes(len(names), rng, NUM_METRIC_RESAMPLES)
    return SceneResampling(scene_numbers, weights)


def _resampled_values(
    suite: RenderedSuite,
    clean: MetricValue,
    cleans: Mapping[str, MetricValue],
    levels: Mapping[str, list[MetricValue]],
) -> ResampledValues | None:
    """Return a metric in each resample; None without resamples.

    Args:
        suite: The suite.
        clean: Value on all clean renders.
        cleans: Value on the clean renders that count for each effect.
        levels: Values at the levels of each effect.
    """
    if clean.resampled is None:
        return None
    effects = {}
    for effect, of_effect in levels.items():
        clean_resampled = cleans[effect].resampled
        by_level = [measured.resampled for measured in of_effect if measured.resampled is not None]
        assert clean_resampled is not None and len(by_level) == len(of_effect), "of one metric"
        scenes = {suite.images[number].scene for number in suite.numbers_of(effect)}
        effects[effect] = ResampledEffect(clean_resampled, np.stack(by_level), len(scenes))
    return ResampledValues(clean.resampled, effects)


def _make_scores(run: _Run, folder: Path) -> tuple[SuiteScores, ResampledValues | None]:
    """Return the scores of a network without a baseline, and its metric in each resample."""
    suite = run.suite
    resampling = _resample_images(suite)
    all_numbers = suite.numbers_of(None)
    clean = run.metric.measure(run.predictions[CLEAN_VARIANT], all_numbers, resampling)
    clean_by_numbers = {all_numbers: clean}
    for effect in run.effects:
        numbers = suite.numbers_of(effect)
        if numbers not in clean_by_numbers:
            measured = run.metric.measure(run.predictions[CLEAN_VARIANT], numbers, resampling)
            clean_by_numbers[numbers] = measured
    cleans = {effect: clean_by_numbers[suite.numbers_of(effect)] for effect in run.effects}
    levels = {
        effect: [
            run.metric.measure(run.predictions[name], suite.numbers_of(effect), resampling)
            for name in names
        ]
        for effect, names in run.effects.items()
    }
    values = {
        effect: EffectValues(cleans[effect].value, tuple(measured.value for measured in of_effect))
        for effect, of_effect in levels.items()
    }
    summary = summarize(values)
    variants = [name for names in run.effects.values() for name in names]
    warnings = equal_picture_warnings(suite, variants)
    warnings += [
        warning
        for effect, names in run.effects.items()
        for warning in equal_score_warnings(
            suite, values[effect].clean, dict(zip(names, values[effect].levels, strict=True))
        )
    ]
    scores = SuiteScores(
        suite=suite.name,
        suite_sha256=suite.content_hash,
        images_sha256=suite.images_hash,
        code_version=augment.__version__,
        metric=run.metric.name,
        images=len(suite.images),
        scenes=len({image.scene for image in suite.images}),
        objects=None if run.truth is None else run.truth.count(all_numbers),
        categories=tuple(clean.by_category),
        threshold=run.threshold if np.isfinite(run.threshold) else None,
        clean=clean.value,
        clean_by_category=clean.by_category,
        clean_recall=_recall(run, CLEAN_VARIANT, all_numbers),
        clean_false_per_image=_false_per_image(run, CLEAN_VARIANT, all_numbers),
        recorded=_recorded_value(run, folder),
        robustness=RobustnessScores(
            mpc=summary.mean_performance,
            rpc=summary.relative_performance,
            mrr=summary.mean_resilience,
            mra=summary.mean_ability,
            mce=None,
            mrra=None,
        ),
        effects={
            effect: _effect_scores(run, effect, values[effect], of_effect)
            for effect, of_effect in levels.items()
        },
        recall_bins={effect: _recall_bins(run, effect) for effect in run.effects if run.hits},
        worst_images=tuple(_find_worst(run)),
        baseline=None,
        warnings=tuple(warnings),
        notes=tuple(_notes(run)),
    )
    return scores, _resampled_values(suite, clean, cleans, levels)


def _effect_scores(
    run: _Run, effect: str, values: EffectValues, levels: Sequence[MetricValue]
) -> EffectScores:
    """Return the scores of one effect."""
    suite = run.suite
    names = run.effects[effect]
    numbers = suite.numbers_of(effect)
    facts = suite.entries.variants[names[0]]
    scenes = suite.entries.scenes
    return EffectScores(
        number=facts.number,
        unit=facts.unit,
        omitted_scenes=tuple(s for s in sorted(scenes) if effect in scenes[s].omitted_effects),
        clean=values.clean,
        clean_recall=_recall(run, CLEAN_VARIANT, numbers),
        levels=tuple(
            LevelScore(
                variant=name,
                level=suite.entries.variants[name].level,
                value=suite.entries.variants[name].value,
                metric=measured.value,
                ability=measured.value / values.clean,
                by_category=measured.by_category,
                recall=_recall(run, name, numbers),
                recall_interval=_recall_interval(run, name, numbers),
                false_per_image=_false_per_image(run, name, numbers),
            )
            for name, measured in zip(names, levels, strict=True)
        ),
        resilience=values.resilience,
        corruption_error=None,
        relative_gain=None,
        half_recall=_half_recall(run, effect),
    )


def _recall(run: _Run, variant: str, numbers: Sequence[int]) -> float | None:
    """Return the share of objects that are found at the clean threshold."""
    if not run.hits:
        return None
    images = [run.hits[variant][number] for number in numbers]
    count = sum(int(image.is_counted.sum()) for image in images)
    num_found = sum(int(image.are_found(run.threshold).sum()) for image in images)
    return num_found / count if count else None


def _false_per_image(run: _Run, variant: str, numbers: Sequence[int]) -> float | None:
    """Return the number of false positives per image at the clean threshold."""
    if not run.hits:
        return None
    return float(np.mean([run.hits[variant][n].count_false(run.threshold) for n in numbers]))


def _half_recall(run: _Run, effect: str) -> HalfRecallScore | None:
    """Return V50 of an effect; None where it has no meaning."""
    names = run.effects[effect]
    facts = [run.suite.entries.variants[name] for name in names]
    values = [entry.value for entry in facts if entry.value is not None and entry.value > 0]
    if not run.hits or not facts[0].unit or len(values) < len(names):
        return None
    numbers = run.suite.numbers_of(effect)
    return find_half_recall(
        np.stack([_hits_by_scene(run, name, numbers) for name in names], axis=1),
        _hits_by_scene(run, CLEAN_VARIANT, numbers),
        _objects_by_scene(run, numbers),
        Levels(names, tuple(values), facts[0].unit),
        np.random.default_rng(BOOTSTRAP_SEED),
    )


def _recall_interval(run: _Run, variant: str, numbers: Sequence[int]) -> tuple[float, float] | None:
    """Return the interval of a variant's recall."""
    if not run.hits:
        return None
    return recall_interval(
        _hits_by_scene(run, variant, numbers),
        _objects_by_scene(run, numbers),
        np.random.default_rng(BOOTSTRAP_SEED),
    )


def _hits_by_scene(run: _Run, variant: str, numbers: Sequence[int]) -> np.ndarray:
    """Return the number of objects that are found in each scene, float64 [scenes]."""
    images = (run.hits[variant][number] for number in numbers)
    return _sum_by_scene(
        run, numbers, [int(image.are_found(run.threshold).sum()) for image in images]
    )


def _objects_by_scene(run: _Run, numbers: Sequence[int]) -> np.ndarray:
    """Return the number of objects that count in each scene, float64 [scenes]."""
    images = (run.hits[CLEAN_VARIANT][number] for number in numbers)
    return _sum_by_scene(run, numbers, [int(image.is_counted.sum()) for image in images])


def _sum_by_scene(run: _Run, numbers: Sequence[int], counts: list[int]) -> np.ndarray:
    """Return the sum of counts of images over each scene."""
    names = [run.suite.images[number].scene for number in numbers]
    _, places = np.unique(names, return_inverse=True)
    return np.bincount(places, weights=counts)


def _recall_bins(run: _Run, effect: str) -> RecallBins:
    """Return recall by what was visible of each object, over all levels of an effect."""
    assert run.truth is not None, "only detections have hits"
    transmittances: list[np.ndarray] = []
    visible_fractions: list[np.ndarray] = []
    ranges_m: list[np.ndarray] = []
    is_found: list[np.ndarray] = []
    numbers = run.suite.numbers_of(effect)
    for name in run.effects[effect]:
        shares = read_transmittances(run.suite, run.truth, name)
        for number in numbers:
            hits = run.hits[name][number]
            truth = run.truth.images[number]
            transmittances.append(shares[number][hits.is_counted])
            visible_fractions.append(truth.visible_fractions[hits.is_counted])
            ranges_m.append(truth.ranges_m[hits.is_counted])
            is_found.append(hits.are_found(run.threshold)[hits.is_counted])
    is_object_found = np.concatenate(is_found)
    columns = {
        "transmittance": (transmittances, SHARE_BOUNDS),
        "visible_fraction": (visible_fractions, SHARE_BOUNDS),
        "range_m": (ranges_m, RANGE_BOUNDS_M),
    }
    bins = {
        name: tuple(map(_bin_score, recall_by(np.concatenate(arrays), is_object_found, bounds)))
        for name, (arrays, bounds) in columns.items()
    }
    return RecallBins(**bins)


def _bin_score(counted: RecallBin) -> RecallBinScore:
    """Return a bin as it is written."""
    return RecallBinScore(
        lower=counted.lower,
        upper=counted.upper if np.isfinite(counted.upper) else None,
        objects=counted.objects,
        num_found=counted.num_found,
        recall=counted.recall,
    )


def _recorded_value(run: _Run, folder: Path) -> float | None:
    """Return the metric on the recorded images; None where these were not predicted."""
    if not (folder / RECORDED).is_dir():
        return None
    expected = _expected_images(run.suite, run.truth, CLEAN_VARIANT)
    kind = run.predictions[CLEAN_VARIANT].kind
    recorded_kind = find_kind(folder / RECORDED)
    if recorded_kind != kind:
        raise ScoreError(f"{folder / RECORDED} has {recorded_kind}, the variants have {kind}")
    predictions = read_predictions(folder / RECORDED, kind, expected)
    return run.metric.measure(predictions, run.suite.numbers_of(None)).value


def _find_worst(run: _Run) -> list[WorstImage]:
    """Return the images in which the weather costs a network most, a few of each effect."""
    counts = {name: _found_counts(run, name) for name in run.predictions}
    if not counts[CLEAN_VARIANT]:
        return []
    clean_counts = counts[CLEAN_VARIANT]
    worst = []
    for effect, names in run.effects.items():
        losses = sorted(
            (counts[name][number] - clean_counts[number], name, number)
            for name in names
            for number in run.suite.numbers_of(effect)
        )
        numbers_in_list: set[int] = set()
        for loss, name, number in losses:
            if loss >= 0 or len(numbers_in_list) == MAX_WORST_OF_EFFECT:
                break
            if number not in numbers_in_list:
                numbers_in_list.add(number)
                worst.append((loss, name, number))
    return [
        WorstImage(
            variant=name,
            number=number,
            **run.suite.images[number]._asdict(),
            path=run.suite.rows[name][number]["image_path"],
            clean_path=run.suite.rows[CLEAN_VARIANT][number]["image_path"],
            clean_hits=clean_counts[number],
            hits=counts[name][number],
            objects=_worst_objects(run, name, number),
        )
        for _, name, number in worst[:MAX_WORST]
    ]


def _worst_objects(run: _Run, variant: str, number: int) -> tuple[WorstObject, ...]:
    """Return the objects of an image that count, for its picture."""
    if run.truth is None:
        return ()
    hits = run.hits[variant][number]
    is_found = hits.are_found(run.threshold)
    was_found = run.hits[CLEAN_VARIANT][number].are_found(run.threshold)
    boxes = run.truth.images[number].boxes
    return tuple(
        WorstObject(
            box=tuple(boxes[k].tolist()),
            is_found=bool(is_found[k]),
            is_found_clean=bool(was_found[k]),
        )
        for k in np.flatnonzero(hits.is_counted)
    )


def _found_counts(run: _Run, variant: str) -> list[float]:
    """Return the objects that are found in each image, or of semantics the share of right pixels.

    Empty for NDS.
    """
    if run.hits:
        return [float(image.are_found(run.threshold).sum()) for image in run.hits[variant]]
    if isinstance(run.metric, SemanticMetric):
        pixel_counts = run.metric.count(run.predictions[variant])
        right = np.trace(pixel_counts, axis1=1, axis2=2)
        return (right / np.maximum(pixel_counts.sum(axis=(1, 2)), 1)).tolist()
    return []


def _notes(run: _Run) -> list[str]:
    """Return sentences about images, scenes and labels that do not count."""
    suite = run.suite
    notes = []
    if suite.omitted_images:
        notes.append(
            f"images that some variant lacks count in none: {list_names(suite.omitted_images)}"
        )
    if run.truth is not None and run.truth.unmapped_labels:
        counts = ", ".join(f"{name} ({n})" for name, n in run.truth.unmapped_labels.items())
        notes.append(f"boxes of no category do not count: {counts}")
    for effect in suite.effects:
        if effect not in run.effects and not suite.numbers_of(effect):
            notes.append(f"{effect} has no score: every scene was recorded in it")
    if len({image.scene for image in suite.images}) == 1:
        notes.append("one scene: scores have no interval, which would be a bootstrap by scene")
    return notes
