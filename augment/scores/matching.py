"""Assignment of detections to true objects, by descending score.

A detection takes the object of its category with the largest overlap that no better detection has
taken. An object that counts is preferred to an ignored one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64


@dataclass(frozen=True, eq=False)
class Assignment:
    """Detections of an image and the objects that they find."""

    object_numbers: Int64[np.ndarray, " N"]
    """Number of the object that each detection finds; -1 for none."""
    is_ignored: Bool[np.ndarray, " N"]
    """True for detections that are neither hits nor false positives."""


def box_overlaps(
    boxes: Float64[np.ndarray, "N 4"], other_boxes: Float64[np.ndarray, "T 4"]
) -> Float64[np.ndarray, "N T"]:
    """Return the intersection over union of boxes left, top, right, bottom."""
    shared_area = _shared_areas(boxes, other_boxes)
    return shared_area / (_areas(boxes)[:, None] + _areas(other_boxes)[None] - shared_area)


def covered_shares(
    boxes: Float64[np.ndarray, "N 4"], regions: Float64[np.ndarray, "T 4"]
) -> Float64[np.ndarray, "N T"]:
    """Return the share of each box that lies inside each region."""
    return _shared_areas(boxes, regions) / _areas(boxes)[:, None]


def _areas(boxes: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, " N"]:
    """Return the area of each box."""
    return np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)


def _shared_areas(
    boxes: Float64[np.ndarray, "N 4"], other_boxes: Float64[np.ndarray, "T 4"]
) -> Float64[np.ndarray, "N T"]:
    """Return the area that each box shares with each of the others."""
    lower = np.maximum(boxes[:, None, :2], other_boxes[None, :, :2])
    upper = np.minimum(boxes[:, None, 2:], other_boxes[None, :, 2:])
    return np.prod(np.maximum(upper - lower, 0.0), axis=2)


def assign_detections(
    overlaps: Float64[np.ndarray, "N T"],
    scores: Float64[np.ndarray, " N"],
    is_ignored: Bool[np.ndarray, " T"],
    min_overlap: float,
    shares_in_ignored: Float64[np.ndarray, "N T"] | None = None,
) -> Assignment:
    """Return the object that each detection finds.

    Args:
        overlaps: Overlap of each detection with each object of the same category; 0 or less for
            objects of other categories.
        scores: Confidence of each detection; of equal ones the earlier comes first.
        is_ignored: True for objects that do not count.
        min_overlap: Smallest overlap of a find.
        shares_in_ignored: Share of each detection that lies inside each object. A detection that
            lies inside an ignored object by this share, `min_overlap` at least, is ignored; several
            may be. None takes `overlaps`.
    """
    object_numbers = np.full(len(scores), -1, np.int64)
    is_detection_ignored = np.zeros(len(scores), bool)
    if not overlaps.size:
        return Assignment(object_numbers, is_detection_ignored)
    free_overlaps = np.where(is_ignored[None], -1.0, overlaps)
    ignored_shares = overlaps if shares_in_ignored is None else shares_in_ignored
    ignored_shares = np.where(is_ignored[None] & (overlaps >= 0), ignored_shares, -1.0)
    is_taken = np.zeros(len(is_ignored), bool)
    for detection in np.argsort(-scores, kind="stable"):
        candidates = np.where(is_taken, -1.0, free_overlaps[detection])
        best = int(candidates.argmax())
        if candidates[best] >= min_overlap:
            object_numbers[detection] = best
            is_taken[best] = True
        elif ignored_shares[detection].max() >= min_overlap:
            is_detection_ignored[detection] = True
    return Assignment(object_numbers, is_detection_ignored)
