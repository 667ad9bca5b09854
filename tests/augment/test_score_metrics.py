"""Metrics of detections and classes against numbers worked out by hand, and other programs."""

from __future__ import annotations

import contextlib
import io
import math

import cv2
import numpy as np
import pytest

from augment.errors import ScoreError
from augment.scores.box_overlaps_3d import (
    clip_polygon,
    corners_from_above,
    overlaps_3d,
    polygon_area,
)
from augment.scores.coco_metric import coco_average_precision
from augment.scores.half_recall import (
    HARSHER,
    MILDER,
    Levels,
    find_half_recall,
    half_places,
    place_text,
    value_at,
)
from augment.scores.kitti_metric import DIFFICULTIES, kitti_average_precision, precision_at_recalls
from augment.scores.matching import assign_detections, box_overlaps
from augment.scores.predictions import ImageDetections
from augment.scores.recall import ImageHits, best_threshold, match_image, recall_by
from augment.scores.robustness import EffectValues, summarize
from augment.scores.scene_bootstrap import recall_interval
from augment.scores.semantic_metric import class_overlaps, count_pixels
from augment.scores.truth import ImageTruth
from recipes.suite import load_suite


def make_truth(boxes, categories=None, ignored=(), boxes_3d=None, truncated=0.0) -> ImageTruth:
    """Return the truth of an image of 1000 x 500 pixels; boxes are left, top, right, bottom."""
    boxes = np.array(boxes, np.float64).reshape(-1, 4)
    count = len(boxes)
    return ImageTruth(
        width=1000,
        height=500,
        categories=np.zeros(count, np.int64) if categories is None else np.array(categories),
        boxes=boxes,
        amodal_boxes=boxes,
        boxes_3d=np.zeros((count, 7)) if boxes_3d is None else np.array(boxes_3d, np.float64),
        is_ignored=np.isin(np.arange(count), ignored),
        pixels=np.prod(boxes[:, 2:] - boxes[:, :2], axis=1).astype(np.int64),
        visible_fractions=np.ones(count),
        truncated_fractions=np.full(count, truncated),
        ranges_m=np.full(count, 10.0),
        box_places=np.arange(count),
    )


def make_detections(boxes, scores, categories=None, boxes_3d=None) -> ImageDetections:
    boxes = np.array(boxes, np.float64).reshape(-1, 4)
    return ImageDetections(
        np.zeros(len(boxes), np.int64) if categories is None else np.array(categories, np.int64),
        boxes,
        np.array(scores, np.float64),
        np.full((len(boxes), 7), np.nan) if boxes_3d is None else np.array(boxes_3d, np.float64),
    )


SQUARES = [[100 * k, 100, 100 * k + 60, 160] for k in range(5)]


def test_overlap_of_boxes_is_intersection_over_union():
    first = np.array([[0.0, 0.0, 10.0, 10.0]])
    others = np.array([[5.0, 0.0, 15.0, 10.0], [0.0, 0.0, 10.0, 10.0], [20.0, 20.0, 30.0, 30.0]])
    np.testing.assert_allclose(box_overlaps(first, others), [[1 / 3, 1.0, 0.0]])


def test_a_detection_takes_the_best_free_object_and_ignored_ones_only_last():
    overlaps = np.array([[0.9, 0.8, 0.0], [0.95, 0.7, 0.0], [0.6, 0.9, 0.0], [0.0, 0.0, 0.8]])
    ignored = np.array([False, False, True])
    assignment = assign_detections(overlaps, np.array([0.9, 0.8, 0.7, 0.6]), ignored, 0.5)
    # The first takes object 0, so the second must take 1; the third finds both taken.
    assert assignment.object_numbers.tolist() == [0, 1, -1, -1]
    assert assignment.is_ignored.tolist() == [False, False, False, True]


def test_precision_at_recalls_of_a_curve_worked_by_hand():
    # Hit, miss, hit, of four objects: precision 1 up to recall 1/4, then 2/3 up to 2/4, then 0.
    scores = np.array([0.9, 0.8, 0.7])
    precision = precision_at_recalls(scores, np.array([True, False, True]), 4)
    assert precision.tolist() == [1.0] * 10 + [2 / 3] * 10 + [0.0] * 20
    # Equal scores cannot be told apart: one point with a precision of 2/3.
    precision = precision_at_recalls(np.full(3, 0.9), np.array([True, False, True]), 4)
    assert precision.tolist() == [2 / 3] * 20 + [0.0] * 20
    assert precision_at_recalls(np.zeros(0), np.zeros(0, bool), 4).tolist() == [0.0] * 40
    # 3 of 10 objects reach recall 12/40 exactly.
    assert precision_at_recalls(scores, np.ones(3, bool), 10).sum() == 12


def test_kitti_precision_worked_by_hand():
    truth = make_truth(SQUARES[:4])
    wrong_box = [700, 300, 760, 360]
    detections = make_detections([SQUARES[0], wrong_box, SQUARES[1]], [0.9, 0.8, 0.7])
    # (10 x 1 + 10 x 2/3) / 40
    assert kitti_average_precision([truth], [detections], ["Car"]).values[0] == pytest.approx(
        5 / 12
    )
    # A car needs an overlap of 0.7, a pedestrian of 0.5: 45 of 60 x 60 is 0.6.
    shifted = make_detections([[15, 100, 75, 160]], [0.9])
    one = [make_truth(SQUARES[:1])]
    assert kitti_average_precision(one, [shifted], ["Car"]).values[0] == 0.0
    assert kitti_average_precision(one, [shifted], ["Pedestrian"]).values[0] == 1.0


def slow_precision(truths, detections) -> float:
    """Return KITTI's AP of one category by its definition: matching anew at every threshold."""
    scores = sorted({score for image in detections for score in image.scores.tolist()})
    num_objects = sum(len(truth) for truth in truths)
    points = []
    for threshold in scores:
        hits = misses = 0
        for truth, image in zip(truths, detections, strict=True):
            taken = set()
            for score, box in sorted(zip(image.scores, image.boxes.tolist(), strict=True))[::-1]:
                if score < threshold:
                    continue
                best = (0.0, -1)
                for k, other in enumerate(truth.boxes.tolist()):
                    width = min(box[2], other[2]) - max(box[0], other[0])
                    height = min(box[3], other[3]) - max(box[1], other[1])
                    shared = max(width, 0) * max(height, 0)
                    areas = [(b[2] - b[0]) * (b[3] - b[1]) for b in (box, other)]
                    if k not in taken:
                        best = max(best, (shared / (sum(areas) - shared), k))
                if best[0] >= 0.7:
                    taken.add(best[1])
                    hits += 1
                else:
                    misses += 1
        points.append((hits / num_objects, hits / (hits + misses)))
    steps = [k / 40 for k in range(1, 41)]
    return sum(max((p for r, p in points if r >= step - 1e-12), default=0.0) for step in steps) / 40


def test_kitti_precision_equals_its_definition_on_random_detections():
    rng = np.random.default_rng(4)
    truths = []
    detections = []
    for _ in range(8):
        corners = rng.uniform(0, 300, (5, 2))
        boxes = np.concatenate([corners, corners + rng.uniform(30, 120, (5, 2))], axis=1)
        truths.append(make_truth(boxes))
        rows = boxes[rng.integers(0, 5, 8)] + rng.normal(0, 3, (8, 4))
        is_high = rows[:, 3] - rows[:, 1] >= 25  # lower ones are ignored where they find nothing
        detections.append(make_detections(rows[is_high], rng.uniform(0, 1, is_high.sum())))
    ours = kitti_average_precision(truths, detections, ["Car"]).values[0]
    assert 0.05 < ours < 0.95
    assert ours == pytest.approx(slow_precision(truths, detections), abs=1e-12)


def test_kitti_ignores_objects_of_harder_classes_and_low_detections():
    low = [300, 100, 360, 120]  # 20 pixels high: counts at no difficulty
    truth = make_truth([SQUARES[0], low])
    low_miss = [600, 100, 660, 120]
    detections = make_detections([SQUARES[0], low, low_miss], [0.5, 0.9, 0.8])
    assert kitti_average_precision([truth], [detections], ["Car"]).values[0] == 1.0
    hard_only = make_truth(SQUARES[:1], truncated=0.4)
    precisions = [
        kitti_average_precision([hard_only], [detections], ["Car"], difficulty=difficulty).values[0]
        for difficulty in DIFFICULTIES.values()
    ]
    assert np.isnan(precisions[:2]).all()
    assert precisions[2] == 1.0


def test_kitti_in_space_counts_the_turn_and_the_height():
    box = [0.0, 1.5, 20.0, 1.5, 1.6, 4.0, 0.3]
    truth = make_truth(SQUARES[:1], boxes_3d=[box])
    turned = [*box[:6], 0.3 + math.pi]  # the same volume
    raised = [0.0, 0.5, *box[2:]]  # a third of the height is shared
    cases = ((box, 1.0, 1.0), (turned, 1.0, 1.0), (raised, 0.0, 1.0))
    for other, in_space, from_above in cases:
        detections = [make_detections(SQUARES[:1], [0.9], boxes_3d=[other])]
        assert (
            kitti_average_precision([truth], detections, ["Car"], view="3d").values[0] == in_space
        )
        assert (
            kitti_average_precision([truth], detections, ["Car"], view="bev").values[0]
            == from_above
        )


def test_overlap_in_space_worked_by_hand():
    box = np.array([[0.0, 0.0, 10.0, 2.0, 2.0, 4.0, 0.0]])
    moved = np.array([[1.0, 0.0, 10.0, 2.0, 2.0, 4.0, 0.0]])  # along its length: 3 of 4 m
    np.testing.assert_allclose(overlaps_3d(box, moved), [[3 / 5]])
    crossed = np.array([[0.0, 0.0, 10.0, 2.0, 2.0, 4.0, math.pi / 2]])  # 2 x 2 of 8 + 8 - 4
    np.testing.assert_allclose(overlaps_3d(box, crossed), [[1 / 3]])
    lower = np.array([[0.0, 1.0, 10.0, 2.0, 2.0, 4.0, 0.0]])  # half of the height
    np.testing.assert_allclose(overlaps_3d(box, lower), [[1 / 3]])
    np.testing.assert_allclose(overlaps_3d(box, lower, is_from_above=True), [[1.0]])
    far = np.array([[50.0, 0.0, 10.0, 2.0, 2.0, 4.0, 0.0]])
    assert overlaps_3d(box, far)[0, 0] == 0.0


def test_shared_area_of_turned_boxes_equals_that_of_opencv():
    rng = np.random.default_rng(3)
    boxes = np.zeros((40, 7))
    boxes[:, [0, 2]] = rng.uniform(-2, 2, (40, 2))
    boxes[:, 4:6] = rng.uniform(1, 4, (40, 2))
    boxes[:, 6] = rng.uniform(-math.pi, math.pi, 40)
    corners = corners_from_above(boxes)
    for k in range(0, 40, 2):
        area = polygon_area(clip_polygon(corners[k], corners[k + 1]))
        hulls = [cv2.convexHull(corners[k + j].astype(np.float32)) for j in (0, 1)]
        expected = cv2.intersectConvexConvex(*hulls)[0]
        assert area == pytest.approx(expected, abs=1e-4)  # OpenCV computes in float32


def test_turn_about_the_camera_axis_is_that_of_kitti():
    # rotation_y = -pi/2: the car's front looks along +z, away from the camera.
    (corners,) = corners_from_above(np.array([[0.0, 0.0, 10.0, 1.5, 1.6, 4.0, -math.pi / 2]]))
    assert np.ptp(corners[:, 1]) == pytest.approx(4.0)
    assert corners[0, 1] == pytest.approx(12.0)  # a front corner


# ---- COCO ----------------------------------------------------------------------------------------


def test_coco_precision_worked_by_hand():
    pytest.importorskip("pycocotools")
    truth = make_truth([*SQUARES[:4], [10, 300, 70, 360]], categories=[0, 0, 0, 0, 1])
    detections = make_detections(
        [SQUARES[0], SQUARES[1], [600, 300, 660, 360]], [0.9, 0.7, 0.8], categories=[0, 0, 0]
    )
    precisions = coco_average_precision([truth], [detections], 3).values
    # 101 recalls: precision 1 at 0 ... 0.25 (26 of them), 2/3 at 0.26 ... 0.5 (25), 0 above.
    assert precisions[0] == pytest.approx((26 + 25 * 2 / 3) / 101)
    assert precisions[1] == 0.0
    assert np.isnan(precisions[2])


def test_coco_precision_equals_pycocotools_called_directly():
    coco_module = pytest.importorskip("pycocotools.coco")
    eval_module = pytest.importorskip("pycocotools.cocoeval")
    rng = np.random.default_rng(1)
    truths = []
    detections = []
    for _ in range(12):
        corners = rng.uniform(0, 400, (6, 2))
        boxes = np.concatenate([corners, corners + rng.uniform(10, 120, (6, 2))], axis=1)
        truths.append(make_truth(boxes, categories=rng.integers(0, 3, 6), ignored=(5,)))
        noise = rng.normal(0, 5, (9, 4))
        rows = boxes[rng.integers(0, 6, 9)] + noise
        categories = rng.integers(0, 3, 9)
        detections.append(make_detections(rows, rng.uniform(0, 1, 9), categories))
    ours = coco_average_precision(truths, detections, 3).values

    def xywh(box):
        return [*box[:2].tolist(), *(box[2:] - box[:2]).tolist()]

    objects = [
        {"image_id": n, "category_id": int(t.categories[k]), "bbox": xywh(t.boxes[k]),
         "area": float(t.pixels[k]), "iscrowd": int(t.is_ignored[k])}
        for n, t in enumerate(truths) for k in range(len(t))
    ]  # fmt: skip
    results = [
        {"image_id": n, "category_id": int(d.categories[k]), "bbox": xywh(d.boxes[k]),
         "score": float(d.scores[k])}
        for n, d in enumerate(detections) for k in range(len(d))
    ]  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        coco = coco_module.COCO()
        coco.dataset = {
            "info": {},
            "images": [{"id": n} for n in range(len(truths))],
            "categories": [{"id": k} for k in range(3)],
            "annotations": [{"id": k, **entry} for k, entry in enumerate(objects, 1)],
        }
        coco.createIndex()
        evaluation = eval_module.COCOeval(coco, coco.loadRes(results), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    assert 0.05 < evaluation.stats[0] < 0.95
    assert float(np.nanmean(ours)) == pytest.approx(evaluation.stats[0], abs=1e-12)


# ---- Classes -------------------------------------------------------------------------------------


def test_mean_overlap_of_classes_worked_by_hand():
    true = np.array([[1, 1, 6, 6], [1, 1, 6, 0]], np.uint8)
    predicted = np.array([[1, 6, 6, 6], [1, 1, 255, 9]], np.uint8)
    counts = count_pixels(true, predicted)
    assert counts.sum() == 7  # a pixel of the class UNKNOWN does not count
    overlaps = class_overlaps(counts)
    assert overlaps[1] == 3 / 4  # 3 shared, 4 true, 3 predicted
    assert overlaps[6] == 2 / 4  # 2 shared, 3 true, 3 predicted
    assert np.isnan(overlaps[9])
    assert np.nanmean(overlaps) == 0.625


def test_classes_and_sizes_that_do_not_fit_are_refused():
    true = np.ones((2, 3), np.uint8)
    with pytest.raises(ValueError, match=r"expected 3 x 2 pixels; got 2 x 2"):
        count_pixels(true, np.ones((2, 2), np.uint8))
    with pytest.raises(ValueError, match=r"6 pixels have classes .* 0 to 16: \[40\]"):
        count_pixels(true, np.full((2, 3), 40, np.uint8))


# ---- Recall --------------------------------------------------------------------------------------


def test_recall_prefers_the_threshold_with_the_largest_f1():
    truth = make_truth(SQUARES[:3])
    miss = [600, 300, 660, 360]
    detections = make_detections(
        [SQUARES[0], miss, SQUARES[1], miss, miss], [0.9, 0.8, 0.7, 0.6, 0.5]
    )
    hits = match_image(truth, detections, "coco")
    # F1 at 0.9: 2/4, at 0.8: 2/5, at 0.7: 4/6, at 0.6: 4/7.
    assert best_threshold([hits]) == 0.7
    assert hits.are_found(0.7).tolist() == [True, True, False]
    assert hits.are_found(0.8).tolist() == [True, False, False]
    assert hits.count_false(0.7) == 1
    nothing = ImageHits(np.full(2, -np.inf), np.array([0.9]), np.ones(2, bool))
    assert best_threshold([nothing]) == np.inf


def test_other_categories_and_ignored_objects_are_no_hits():
    truth = make_truth(SQUARES[:2], ignored=(1,))
    inside_ignored = [110, 110, 150, 150]
    detections = make_detections([SQUARES[0], inside_ignored], [0.9, 0.8], categories=[1, 0])
    hits = match_image(truth, detections, "coco")
    assert not hits.are_found(0.0).any()
    assert hits.false_scores.tolist() == [0.9]  # the second lies inside an ignored object


def test_recall_in_bins_counts_each_object_once():
    numbers = np.array([0.0, 0.04, 0.05, 0.5, 1.0, np.nan])
    is_found = np.array([True, False, True, False, True, True])
    bins = recall_by(numbers, is_found, (0.0, 0.05, 0.5, 1.0))
    assert [(counted.objects, counted.num_found) for counted in bins] == [(2, 1), (1, 1), (2, 1)]
    assert recall_by(np.zeros(0), np.zeros(0, bool), (0.0, 1.0))[0].recall is None


# ---- Robustness ----------------------------------------------------------------------------------


def test_scores_of_robustness_worked_by_hand():
    effects = {
        "fog": EffectValues(0.8, (0.6, 0.4, 0.2)),
        "rain": EffectValues(0.8, (0.8, 0.6, 0.4)),
    }
    baseline = {
        "fog": EffectValues(0.5, (0.5, 0.3, 0.1)),
        "rain": EffectValues(0.5, (0.4, 0.4, 0.4)),
    }
    scores = summarize(effects, baseline)
    assert scores.mean_performance == pytest.approx(0.5)
    assert scores.relative_performance == pytest.approx(0.5 / 0.8)
    assert scores.mean_resilience == pytest.approx((1.2 / 2.4 + 1.8 / 2.4) / 2)
    assert scores.mean_ability == pytest.approx(0.5 / 0.8)
    assert scores.mean_corruption_error == pytest.approx((1.8 / 2.1 + 1.2 / 1.8) / 2)
    assert scores.mean_relative_gain == pytest.approx((1.2 / 0.9 - 1 + 1.8 / 1.2 - 1) / 2)
    itself = summarize(effects, effects)
    assert itself.mean_corruption_error == 1.0
    assert itself.mean_relative_gain == 0.0
    assert summarize(effects).mean_corruption_error is None


def test_robustness_without_a_clean_hit_or_a_fitting_baseline_is_refused():
    effects = {"fog": EffectValues(0.8, (0.6, 0.4))}
    with pytest.raises(ScoreError, match=r"clean value is 0.0 for fog"):
        summarize({"fog": EffectValues(0.0, (0.0, 0.0))})
    with pytest.raises(ScoreError, match=r"lacks effects, or levels of them: fog"):
        summarize(effects, {"fog": EffectValues(0.8, (0.6,))})


def test_means_against_a_baseline_are_over_the_effects_in_which_it_can_be_compared():
    effects = {"fog": EffectValues(0.8, (0.6, 0.4)), "rain": EffectValues(0.8, (0.8, 0.6))}
    blind = {"fog": EffectValues(0.8, (0.0, 0.0)), "rain": EffectValues(0.8, (0.4, 0.4))}
    assert effects["fog"].relative_gain(blind["fog"]) is None
    assert summarize(effects, blind).mean_relative_gain == pytest.approx(1.4 / 0.8 - 1)
    perfect = {"fog": EffectValues(1.0, (1.0, 1.0)), "rain": EffectValues(0.8, (0.4, 0.4))}
    assert effects["fog"].corruption_error(perfect["fog"]) is None
    assert summarize(effects, perfect).mean_corruption_error == pytest.approx(0.6 / 1.2)
    assert summarize({"fog": effects["fog"]}, blind).mean_relative_gain is None


def test_half_recall_is_interpolated_over_the_logarithm():
    values = (600.0, 300.0, 150.0, 75.0, 37.0)
    recalls = np.array([[0.8, 0.6, 0.2, 0.1, 0.0], [0.3, 0.2, 0.1, 0.0, 0.0], [0.8] * 5])
    places = half_places(np.full(3, 0.8), recalls)
    assert places.tolist() == [1.5, MILDER, HARSHER]  # 0.4 is halfway from 0.6 to 0.2
    assert value_at(1.5, values) == pytest.approx(math.sqrt(300 * 150))
    assert half_places(np.array([0.8]), np.array([[0.4, 0.3]])).tolist() == [0.0]


def test_half_recall_between_levels_of_one_number_is_stated_in_words():
    """Levels 4 and 5 of `wet` have the same film: that of level 5 has puddles."""
    wet = load_suite("weather-c-v1").effects["wet"]
    values = tuple(level.value for level in wet.levels)
    levels = Levels(tuple(f"wet-{k}" for k in range(1, 6)), values, wet.unit)
    texts = {
        2.5: "0.346 mm",
        3.0: "0.6 mm",
        3.4: "wet-5 but not wet-4, both 0.6 mm",
        4.0: "wet-5 but not wet-4, both 0.6 mm",
        MILDER: "milder than 0.02 mm",
        HARSHER: "harsher than wet-5, 0.6 mm",
    }
    assert {place: place_text(place, levels) for place in texts} == texts
    assert [value_at(place, values) for place in (3.4, 4.0, HARSHER)] == [None] * 3
    # Recall halves in the puddles of level 5 alone.
    hits = np.array([[10.0, 10.0, 9.0, 8.0, 3.0]] * 2)
    full = np.full(2, 10.0)
    half = find_half_recall(hits, full, full, levels, np.random.default_rng(5))
    assert half is not None and half.value is None
    assert {half.text, *(half.interval or ())} == {"wet-5 but not wet-4, both 0.6 mm"}


def test_interval_of_half_recall_covers_the_scenes_and_is_reproducible():
    # Scene after scene: recall halves between levels 2 and 3, or between 4 and 5.
    early = [9.0, 9.0, 1.0, 0.0, 0.0]
    late = [10.0, 10.0, 9.0, 9.0, 1.0]
    hits = np.array([early, late] * 6)
    levels = Levels(tuple("abcde"), (1.0, 4.0, 16.0, 50.0, 100.0), "mm/h")
    clean_hits = np.full(12, 10.0)
    results = [
        find_half_recall(hits, clean_hits, np.full(12, 10.0), levels, np.random.default_rng(5))
        for _ in range(2)
    ]
    assert results[0] == results[1]
    half = results[0]
    assert half is not None and half.value is not None and half.interval is not None
    low, high = (float(text.split()[0]) for text in half.interval)
    assert 4.0 < low < half.value < high < 100.0
    alone = find_half_recall(
        hits[:1], clean_hits[:1], np.full(1, 10.0), levels, np.random.default_rng(5)
    )
    assert alone is not None and alone.interval is None
    nothing = np.zeros(12)
    assert find_half_recall(hits, nothing, clean_hits, levels, np.random.default_rng(5)) is None


def test_interval_of_recall_is_that_of_scenes_and_not_of_boxes():
    # All or nothing by scene: a tenth of the scenes holds as many independent facts.
    hits = np.tile([100.0, 0.0], 20)
    low, high = recall_interval(hits, np.full(40, 100.0), np.random.default_rng(2)) or (0, 0)
    # Binomial of 40 scenes: 0.5 +- 1.96 sqrt(0.25 / 40) = 0.345 ... 0.655.
    assert low == pytest.approx(0.345, abs=0.02)
    assert high == pytest.approx(0.655, abs=0.02)
    assert recall_interval(hits[:1], hits[:1], np.random.default_rng(2)) is None
    assert recall_interval(np.zeros(2), np.zeros(2), np.random.default_rng(2)) is None


def test_bootstrap_interval_covers_the_truth_as_often_as_it_says():
    """Scenes of which a share q halves early: 95 % intervals hold the true V50 most of the time."""
    values = (1.0, 2.0, 4.0, 8.0)
    truth_hits = np.array([[9.0, 7.0, 4.0, 1.0], [10.0, 9.0, 8.0, 3.0]])
    true_place = half_places(np.array([1.0]), truth_hits.mean(axis=0)[None] / 10)[0]
    true_value = value_at(true_place, values)
    rng = np.random.default_rng(8)
    covered = 0
    for _ in range(40):
        hits = truth_hits[rng.integers(0, 2, 30)]
        full = np.full(30, 10.0)
        half = find_half_recall(hits, full, full, Levels(tuple("abcd"), values, "m"), rng)
        assert half is not None and half.interval is not None
        low, high = (float(text.split()[0]) for text in half.interval)
        covered += low * 0.995 <= true_value <= high * 1.005  # texts have three digits
    assert covered >= 34  # 38 expected; 1 in 200 of such experiments has fewer
