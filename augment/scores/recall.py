"""Recall at the clean threshold: by variant, by scene, and by what was visible of each object.

A detector is used at one threshold of confidence. Here it is the one at which its F1 on the clean
renders is largest. An object is found if a detection of its category, at or above the threshold,
overlaps it by half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from augment.scores.matching import assign_detections, box_overlaps, covered_shares
from augment.scores.predictions import ImageDetections, PredictionKind
from augment.scores.truth import ImageTruth

# Smallest overlap of a detection with the object that it finds.
MIN_OVERLAP = 0.5
# Bounds of the bins of the share that weather, or that other objects, leave visible.
SHARE_BOUNDS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
# Bounds of the bins of range, metres.
RANGE_BOUNDS_M = (0.0, 20.0, 40.0, 60.0, np.inf)


@dataclass(frozen=True, eq=False)
class ImageHits:
    """Detections of one image against its objects."""

    object_scores: Float64[np.ndarray, " T"]
    """Score of the detection that finds each object; -inf where none does."""
    false_scores: Float64[np.ndarray, " N"]
    """Scores of the detections that find nothing."""
    is_counted: Bool[np.ndarray, " T"]
    """True for the objects that count."""

    def are_found(self, threshold: float) -> Bool[np.ndarray, " T"]:
        """Return True for objects that count and are found at a threshold."""
        return self.is_counted & (self.object_scores >= threshold)

    def count_false(self, threshold: float) -> int:
        """Return the number of false positives at a threshold."""
        return int((self.false_scores >= threshold).sum())


def match_image(truth: ImageTruth, detections: ImageDetections, kind: PredictionKind) -> ImageHits:
    """Return which objects of an image are found, and with which scores.

    KITTI's boxes are compared with whole objects, others with the pixels that show them.
    """
    boxes = truth.amodal_boxes if kind == "kitti" else truth.boxes
    is_same = detections.categories[:, None] == truth.categories[None]
    overlaps = np.where(is_same, box_overlaps(detections.boxes, boxes), -1.0)
    shares = covered_shares(detections.boxes, boxes)
    assignment = assign_detections(
        overlaps, detections.scores, truth.is_ignored, MIN_OVERLAP, shares
    )
    object_scores = np.full(len(truth), -np.inf)
    is_hit = assignment.object_numbers >= 0
    object_scores[assignment.object_numbers[is_hit]] = detections.scores[is_hit]
    is_false = ~(is_hit | assignment.is_ignored)
    return ImageHits(object_scores, detections.scores[is_false], ~truth.is_ignored)


def best_threshold(images: Sequence[ImageHits]) -> float:
    """Return the threshold at which F1 over some images is largest; inf if nothing is found."""
    hit_scores = np.concatenate([image.object_scores[image.is_counted] for image in images])
    num_objects = len(hit_scores)
    hit_scores = hit_scores[np.isfinite(hit_scores)]
    false_scores = np.concatenate([image.false_scores for image in images])
    scores = np.concatenate([hit_scores, false_scores])
    if not len(hit_scores):
        return np.inf
    is_hit = np.arange(len(scores)) < len(hit_scores)
    order = np.argsort(-scores, kind="stable")
    is_last_of_score = np.append(np.diff(scores[order]) != 0, True)
    num_hits = np.cumsum(is_hit[order])
    f1 = 2 * num_hits / (np.arange(1, len(scores) + 1) + num_objects)
    return float(scores[order][np.where(is_last_of_score, f1, -1.0).argmax()])


@dataclass(frozen=True)
class RecallBin:
    """Objects in a range of a number, and how many of them are found."""

    lower: float
    """Lower bound of the number."""
    upper: float
    """Upper bound; inf for none."""
    objects: int
    """Number of objects."""
    num_found: int
    """Number of them that are found."""

    @property
    def recall(self) -> float | None:
        """Return the share that is found; None without objects."""
        return self.num_found / self.objects if self.objects else None


def recall_by(
    numbers: Float64[np.ndarray, " T"], is_found: Bool[np.ndarray, " T"], bounds: Sequence[float]
) -> list[RecallBin]:
    """Return recall in bins of a number of each object; NaN falls into no bin.

    Args:
        bounds: Bounds of the bins, ascending. A bin has its lower bound; the last has both.
    """
    is_known = ~np.isnan(numbers)
    places = np.clip(np.digitize(numbers[is_known], bounds) - 1, 0, len(bounds) - 2)
    objects = np.bincount(places, minlength=len(bounds) - 1)
    hits = np.bincount(places[is_found[is_known]], minlength=len(bounds) - 1)
    return [
        RecallBin(bounds[k], bounds[k + 1], int(objects[k]), int(hits[k]))
        for k in range(len(bounds) - 1)
    ]
