"""COCO's average precision of boxes, computed by pycocotools.

Resamples take the matches that pycocotools has made.
"""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from augment.errors import ScoreError
from augment.scores.predictions import ImageDetections
from augment.scores.resampled_precision import (
    RankedDetections,
    SceneResampling,
    resampled_precision,
)
from augment.scores.truth import ImageTruth, coco_annotations


class CategoryPrecisions(NamedTuple):
    """Average precision of each category."""

    values: np.ndarray
    """AP of each category [C], float64; NaN where no object counts."""
    resampled: np.ndarray | None
    """The same in each resample, [R, C]; None without resamples."""


def coco_average_precision(
    truths: Sequence[ImageTruth],
    detections: Sequence[ImageDetections],
    num_categories: int,
    resampling: SceneResampling | None = None,
) -> CategoryPrecisions:
    """Return the AP of each category, averaged over the overlaps 0.5 to 0.95.

    The mean of the values without NaN is COCO's mAP.

    Args:
        truths: True objects of each image.
        detections: Detections of the same images.
        num_categories: Number of categories.
        resampling: Resamples of the images' scenes, if wanted.

    Raises:
        ScoreError: pycocotools is not installed.
    """
    try:
        coco_module: Any = importlib.import_module("pycocotools.coco")
        eval_module: Any = importlib.import_module("pycocotools.cocoeval")
    except ImportError as error:
        raise ScoreError(
            "COCO's mAP needs pycocotools: pip install climategs[score], or pip install pycocotools"
        ) from error
    results = []
    for number, image_detections in enumerate(detections):
        for k in range(len(image_detections)):
            left, top, right, bottom = image_detections.boxes[k].tolist()
            results.append({
                "image_id": number,
                "category_id": int(image_detections.categories[k]) + 1,
                "bbox": [left, top, right - left, bottom - top],
                "score": float(image_detections.scores[k]),
            })  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its progress
        coco = coco_module.COCO()
        coco.dataset = {
            "info": {},
            "images": [{"id": number} for number in range(len(truths))],
            "annotations": coco_annotations(truths),
            "categories": [{"id": k, "name": str(k)} for k in range(1, num_categories + 1)],
        }
        coco.createIndex()
        if not results:
            return _precisions_of_nothing(truths, num_categories, resampling)
        evaluation = eval_module.COCOeval(coco, coco.loadRes(results), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
    # Axes: overlap, recall, category, area (the first: all), number of detections (the last: 100).
    precision = evaluation.eval["precision"][:, :, :, 0, -1]
    means = precision.mean(axis=(0, 1))
    values = np.where((precision > -1).all(axis=(0, 1)), means, np.nan)
    if resampling is None:
        return CategoryPrecisions(values, None)
    resampled = [
        _resample_category(evaluation, category, resampling) for category in range(num_categories)
    ]
    return CategoryPrecisions(values, np.stack(resampled, axis=1))


def _precisions_of_nothing(
    truths: Sequence[ImageTruth], num_categories: int, resampling: SceneResampling | None
) -> CategoryPrecisions:
    """Return the AP without any detection: 0 where a category has objects."""
    counts = np.stack([
        np.bincount(truth.categories[~truth.is_ignored], minlength=num_categories)
        for truth in truths
    ])  # fmt: skip
    values = np.where(counts.any(axis=0), 0.0, np.nan)
    if resampling is None:
        return CategoryPrecisions(values, None)
    objects = resampling.weights[:, resampling.scene_numbers] @ counts
    return CategoryPrecisions(values, np.where(objects > 0, 0.0, np.nan))


def _resample_category(evaluation: Any, category: int, resampling: SceneResampling) -> np.ndarray:
    """Return the AP of a category in each resample, from the matches of an evaluation."""
    params = evaluation.params
    num_images = len(params.imgIds)
    # Matches are ordered by category, area (the first: all) and image.
    start = category * len(params.areaRng) * num_images
    matches = enumerate(evaluation.evalImgs[start : start + num_images])
    images = [(number, match) for number, match in matches if match is not None]
    num_scenes = resampling.weights.shape[1]
    num_objects = np.zeros(num_scenes, np.int64)
    for number, match in images:
        is_counted = np.asarray(match["gtIgnore"]) == 0
        num_objects[resampling.scene_numbers[number]] += int(is_counted.sum())
    if not num_objects.any():
        return np.full(len(resampling.weights), np.nan)
    limit = params.maxDets[-1]
    scores = np.concatenate([match["dtScores"][:limit] for _, match in images])
    numbers = np.concatenate([
        np.full(len(match["dtScores"][:limit]), number, np.int64) for number, match in images
    ])  # fmt: skip
    order = np.argsort(-scores, kind="stable")
    is_matched = np.concatenate([m["dtMatches"][:, :limit] for _, m in images], axis=1) != 0
    is_ignored = np.concatenate([m["dtIgnore"][:, :limit] for _, m in images], axis=1) != 0
    by_overlap = []
    for matched, ignored in zip(is_matched[:, order], is_ignored[:, order], strict=True):
        is_used = ~ignored
        ranked = RankedDetections(
            matched[is_used],
            np.ones(int(is_used.sum()), bool),
            resampling.scene_numbers[numbers[order][is_used]],
            num_objects,
        )
        by_overlap.append(resampled_precision(ranked, resampling.weights, params.recThrs))
    return np.mean(by_overlap, axis=0)
