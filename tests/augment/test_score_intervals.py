"""Intervals of metrics and scores: resamples equal the metric on scenes that are repeated."""

from __future__ import annotations

import json

import numpy as np
import pytest

from augment.output.store import open_store
from augment.scores.coco_metric import coco_average_precision
from augment.scores.kitti_metric import kitti_average_precision
from augment.scores.predictions import ImageDetections
from augment.scores.resampled_precision import SceneResampling
from augment.scores.resampled_scores import ResampledEffect, ResampledValues
from augment.scores.robustness import EffectValues, summarize
from augment.scores.score_suite import score_suite
from augment.scores.truth import ImageTruth
from tests.augment.suite_folders import found_by_level, write_coco, write_suite
from tests.augment.test_score_metrics import make_detections, make_truth

SCENE_NUMBERS = np.array([0, 0, 1, 1, 1, 2, 3, 3])
# Each scene once; two of them twice; a scene alone, whose images lack a category.
WEIGHTS = np.array([[1, 1, 1, 1], [2, 0, 2, 0], [0, 0, 4, 0], [0, 3, 0, 1]])


def random_images(seed: int) -> tuple[list[ImageTruth], list[ImageDetections]]:
    """Return objects and detections of eight images, with ignored objects and equal scores."""
    rng = np.random.default_rng(seed)
    truths = []
    detections = []
    for image in range(len(SCENE_NUMBERS)):
        corners = rng.uniform(0, 400, (6, 2))
        boxes = np.concatenate([corners, corners + rng.uniform(30, 120, (6, 2))], axis=1)
        num_categories = 1 if SCENE_NUMBERS[image] == 2 else 3
        truths.append(make_truth(boxes, rng.integers(0, num_categories, 6), ignored=(5,)))
        rows = boxes[rng.integers(0, 6, 12)] + rng.normal(0, 4, (12, 4))
        scores = rng.uniform(0, 1, 12).round(1 if seed else 6)
        detections.append(make_detections(rows, scores, rng.integers(0, 3, 12)))
    return truths, detections


def repeated(images: list, weights: np.ndarray) -> list:
    """Return the images of each scene as often as a resample has the scene."""
    return [
        image
        for image, scene in zip(images, SCENE_NUMBERS, strict=True)
        for _ in range(weights[scene])
    ]


def is_inside(value: float, interval: tuple[float, float]) -> bool:
    """Return True for a value inside an interval, but for the rounding of sums."""
    return interval[0] - 1e-9 <= value <= interval[1] + 1e-9


def test_resampled_coco_precision_is_that_of_repeated_scenes():
    pytest.importorskip("pycocotools")
    truths, detections = random_images(0)
    resampling = SceneResampling(SCENE_NUMBERS, WEIGHTS)
    precisions = coco_average_precision(truths, detections, 3, resampling)
    assert precisions.resampled is not None
    assert 0.02 < precisions.values.min() < precisions.values.max() < 0.95
    # pycocotools adds 2e-16 to what it divides by.
    assert precisions.resampled[0] == pytest.approx(precisions.values, abs=1e-12)
    for weights, values in zip(WEIGHTS, precisions.resampled, strict=True):
        expected = coco_average_precision(
            repeated(truths, weights), repeated(detections, weights), 3
        )
        assert values == pytest.approx(expected.values, abs=1e-12, nan_ok=True)
    assert np.isnan(precisions.resampled[2]).tolist() == [False, True, True]
    nothing = [make_detections([], [])] * len(truths)
    zeros = coco_average_precision(truths, nothing, 3, resampling)
    assert zeros.resampled is not None and zeros.values.tolist() == [0.0] * 3
    assert np.isnan(zeros.resampled[2]).tolist() == [False, True, True]


def test_resampled_kitti_precision_is_that_of_repeated_scenes_with_equal_scores():
    truths, detections = random_images(1)
    names = ["Pedestrian", "Cyclist", "Person"]  # an overlap of 0.5
    resampling = SceneResampling(SCENE_NUMBERS, WEIGHTS)
    precisions = kitti_average_precision(truths, detections, names, resampling=resampling)
    assert precisions.resampled is not None
    assert 0.02 < precisions.values.min() < precisions.values.max() < 0.95
    for weights, values in zip(WEIGHTS, precisions.resampled, strict=True):
        expected = kitti_average_precision(
            repeated(truths, weights), repeated(detections, weights), names
        )
        assert values == pytest.approx(expected.values, abs=1e-12, nan_ok=True)


def test_resampled_scores_follow_the_formulas_of_scores():
    rng = np.random.default_rng(3)
    ours, theirs = (
        ResampledValues(
            rng.uniform(0.5, 1, 5),
            {
                name: ResampledEffect(
                    rng.uniform(0.5, 1, 5), rng.uniform(0.1, 0.5, (count, 5)), num_scenes=4
                )
                for name, count in (("fog", 3), ("rain", 2))
            },
        )
        for _ in range(2)
    )  # fmt: skip
    theirs.effects["fog"].levels[:, 0] = 0.0  # no gain over it, in this resample
    with np.errstate(divide="ignore"):
        means = ours.means(theirs)
    for k in range(5):
        rows, base_rows = (
            {
                name: EffectValues(effect.clean[k], tuple(effect.levels[:, k]))
                for name, effect in values.effects.items()
            }
            for values in (ours, theirs)
        )
        summary = summarize(rows, base_rows)
        assert {name: values[k] for name, values in means.items()} == pytest.approx(
            {
                "mpc": summary.mean_performance,
                "rpc": summary.relative_performance,
                "mrr": summary.mean_resilience,
                "mra": summary.mean_ability,
                "mce": summary.mean_corruption_error,
                "mrra": summary.mean_relative_gain,
            }
        )


def test_scores_have_intervals_and_differences_those_of_pairs(tmp_path):
    pytest.importorskip("pycocotools")
    suite = write_suite(tmp_path / "out")
    store = open_store(suite.path)

    def one_less(number: int, level: int) -> list[int]:
        """Find less than `found_by_level` in the weather, in one scene of three."""
        return found_by_level(number, level)[: 1 if level and number < 2 else 3]

    top = write_coco(tmp_path / "p", suite)
    base = write_coco(tmp_path / "base", suite, one_less)
    scores = score_suite(store, top, base)
    fog = scores.effects["fog"]
    for level in fog.levels:
        assert level.metric_interval is not None and level.difference is not None
        assert is_inside(level.metric, level.metric_interval)
        assert level.difference_interval is not None
        assert is_inside(level.difference, level.difference_interval)
    # The scenes of the fixture are alike but for the baseline's.
    widths = [np.ptp(level.difference_interval or (0.0, 0.0)) for level in fog.levels]
    assert max(widths) > 0.01
    assert scores.clean_interval == pytest.approx((1.0, 1.0))
    assert scores.robustness.mce_interval is not None and scores.robustness.mce is not None
    assert scores.robustness.mce_interval[0] <= scores.robustness.mce < 1
    itself = score_suite(store, top, top)
    assert itself.robustness.mce_interval == (1.0, 1.0)
    assert {level.difference_interval for level in itself.effects["fog"].levels} == {(0.0, 0.0)}
    # Scores in JSON have no resamples: the differences have no interval.
    path = tmp_path / "base.json"
    path.write_text(json.dumps(score_suite(store, base).model_dump(mode="json")))
    from_json = score_suite(store, top, path)
    assert from_json.robustness.mce == scores.robustness.mce
    assert from_json.robustness.mce_interval is None
    assert from_json.robustness.mpc_interval == scores.robustness.mpc_interval


def test_an_effect_that_counts_in_one_scene_has_no_interval(tmp_path):
    pytest.importorskip("pycocotools")
    omitted = {"scene-a": ["fog"], "scene-b": ["fog"]}
    suite = write_suite(tmp_path / "out", omitted=omitted)
    scores = score_suite(open_store(suite.path), write_coco(tmp_path / "p", suite))
    fog = scores.effects["fog"]
    assert fog.resilience_interval is None
    assert {level.metric_interval for level in fog.levels} == {None}
    assert {level.recall_interval for level in fog.levels} == {None}
    assert scores.clean_interval is not None  # of three scenes
