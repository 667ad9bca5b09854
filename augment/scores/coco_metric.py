"""COCO's average precision of boxes, computed by pycocotools."""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from augment.errors import ScoreError
from augment.scores.predictions import ImageDetections
from augment.scores.truth import ImageTruth, coco_annotations


def coco_average_precision(
    truths: Sequence[ImageTruth], detections: Sequence[ImageDetections], num_categories: int
) -> np.ndarray:
    """Return the AP of each category, averaged over the overlaps 0.5 to 0.95, float64.

    NaN for categories without an object that counts. Their mean without NaN is COCO's mAP.

    Args:
        truths: True objects of each image.
        detections: Detections of the same images.

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
            has_objects = np.zeros(num_categories, bool)
            for truth in truths:
                has_objects[truth.categories[~truth.is_ignored]] = True
            return np.where(has_objects, 0.0, np.nan)
        evaluation = eval_module.COCOeval(coco, coco.loadRes(results), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
    # Axes: overlap, recall, category, area (the first: all), number of detections (the last: 100).
    precision = evaluation.eval["precision"][:, :, :, 0, -1]
    means = precision.mean(axis=(0, 1))
    return np.where((precision > -1).all(axis=(0, 1)), means, np.nan)
