"""KITTI's average precision of detections in the image, from above and in space.

Definition: Geiger, Lenz and Urtasun (CVPR 2012), with 40 recalls as in Simonelli et al. (ICCV
2019): AP = 1/40 sum over r = 1/40 ... 1 of the largest precision at a recall of r or more. The
precision is read at every score; KITTI's own program reads it at 41 scores and differs in the third
digit where there are few objects.

An object counts at a difficulty if its box in the image is high enough, and others or the image's
border hide little enough of it. Other objects are ignored, as are unmatched detections that are
lower than the smallest box that counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64

from augment.scores.box_overlaps_3d import overlaps_3d
from augment.scores.coco_metric import CategoryPrecisions
from augment.scores.matching import assign_detections, box_overlaps
from augment.scores.predictions import ImageDetections
from augment.scores.resampled_precision import (
    RankedDetections,
    SceneResampling,
    resampled_precision,
)
from augment.scores.truth import ImageTruth

KittiView = Literal["bbox", "bev", "3d"]
# Number of recalls of the mean.
NUM_RECALLS = 40


@dataclass(frozen=True)
class Difficulty:
    """Objects that count, as KITTI divides them."""

    min_height_px: float
    """Smallest height of the box in the image."""
    min_visible_fraction: float
    """Smallest share that other objects leave visible. It stands for KITTI's states of occlusion,
    as `augment.dataset.label_files` writes them."""
    max_truncated_fraction: float
    """Largest share outside the image."""


DIFFICULTIES = {
    "easy": Difficulty(40.0, 0.9, 0.15),
    "moderate": Difficulty(25.0, 0.5, 0.30),
    "hard": Difficulty(25.0, 0.0, 0.50),
}
# Smallest overlap of a find, by a word in the category's name; others have DEFAULT_OVERLAP.
SMALL_OBJECTS = ("pedestrian", "person", "human", "cyclist", "bicycle", "motorcycle", "rider")
SMALL_OVERLAP = 0.5
DEFAULT_OVERLAP = 0.7


def min_overlap_of(category: str) -> float:
    """Return the smallest overlap of a find: 0.5 for people and two-wheelers, 0.7 for others."""
    is_small = any(word in category.lower() for word in SMALL_OBJECTS)
    return SMALL_OVERLAP if is_small else DEFAULT_OVERLAP


def counted_objects(truth: ImageTruth, difficulty: Difficulty) -> Bool[np.ndarray, " T"]:
    """Return True for objects that count at a difficulty."""
    height_px = truth.amodal_boxes[:, 3] - truth.amodal_boxes[:, 1]
    return (
        (height_px >= difficulty.min_height_px)
        & (truth.visible_fractions >= difficulty.min_visible_fraction)
        & (truth.truncated_fractions <= difficulty.max_truncated_fraction)
    )


def kitti_average_precision(
    truths: Sequence[ImageTruth],
    detections: Sequence[ImageDetections],
    categories: Sequence[str],
    *,
    view: KittiView = "bbox",
    difficulty: Difficulty = DIFFICULTIES["moderate"],
    resampling: SceneResampling | None = None,
) -> CategoryPrecisions:
    """Return the AP of each category at 40 recalls.

    Args:
        truths: True objects of each image.
        detections: Detections of the same images; with 3D boxes unless the view is `bbox`.
        categories: Names of the categories.
        view: Overlap of boxes in the image, from above, or in space.
        difficulty: Objects that count.
        resampling: Resamples of the images' scenes, if wanted.
    """
    rows = [
        _match_category(truths, detections, number, min_overlap_of(name), view, difficulty)
        for number, name in enumerate(categories)
    ]
    values = np.array([row.average_precision() for row in rows])
    if resampling is None:
        return CategoryPrecisions(values, None)
    resampled = [row.resample(resampling) for row in rows]
    return CategoryPrecisions(values, np.stack(resampled, axis=1))


@dataclass(frozen=True, eq=False)
class _CategoryMatches:
    """Detections of one category against its objects."""

    scores: Float64[np.ndarray, " N"]
    """Score of each detection that counts."""
    is_hit: Bool[np.ndarray, " N"]
    """True for detections that find an object."""
    image_numbers: Int64[np.ndarray, " N"]
    """Place of each detection's image among the images."""
    num_objects: Int64[np.ndarray, " I"]
    """Number of objects that count in each image."""

    def average_precision(self) -> float:
        """Return the AP; NaN where no object counts."""
        count = int(self.num_objects.sum())
        if not count:
            return np.nan
        return float(precision_at_recalls(self.scores, self.is_hit, count).mean())

    def resample(self, resampling: SceneResampling) -> Float64[np.ndarray, " R"]:
        """Return the AP in each resample of scenes."""
        order = np.argsort(-self.scores, kind="stable")
        num_scenes = resampling.weights.shape[1]
        num_objects = np.bincount(
            resampling.scene_numbers, weights=self.num_objects, minlength=num_scenes
        )
        ranked = RankedDetections(
            self.is_hit[order],
            _is_last_of_score(self.scores[order]),
            resampling.scene_numbers[self.image_numbers[order]],
            num_objects.astype(np.int64),
        )
        recalls = np.arange(1, NUM_RECALLS + 1) / NUM_RECALLS
        return resampled_precision(ranked, resampling.weights, recalls)


def _match_category(
    truths: Sequence[ImageTruth],
    detections: Sequence[ImageDetections],
    category: int,
    min_overlap: float,
    view: KittiView,
    difficulty: Difficulty,
) -> _CategoryMatches:
    """Return the detections of one category against its objects."""
    num_objects: list[int] = []
    scores: list[np.ndarray] = []
    hits: list[np.ndarray] = []
    for truth, image_detections in zip(truths, detections, strict=True):
        objects = np.flatnonzero(truth.categories == category)
        rows = np.flatnonzero(image_detections.categories == category)
        is_counted = counted_objects(truth, difficulty)[objects]
        num_objects.append(int(is_counted.sum()))
        boxes = image_detections.boxes[rows]
        if view == "bbox":
            overlaps = box_overlaps(boxes, truth.amodal_boxes[objects])
        else:
            overlaps = overlaps_3d(
                image_detections.boxes_3d[rows],
                truth.boxes_3d[objects],
                is_from_above=view == "bev",
            )
        image_scores = image_detections.scores[rows]
        assignment = assign_detections(overlaps, image_scores, ~is_counted, min_overlap)
        is_hit = assignment.object_numbers >= 0
        is_low = boxes[:, 3] - boxes[:, 1] < difficulty.min_height_px
        is_used = is_hit | ~(assignment.is_ignored | is_low)
        scores.append(image_scores[is_used])
        hits.append(is_hit[is_used])
    return _CategoryMatches(
        np.concatenate(scores),
        np.concatenate(hits),
        np.repeat(np.arange(len(scores)), [len(rows) for rows in scores]),
        np.array(num_objects, np.int64),
    )


def precision_at_recalls(
    scores: Float64[np.ndarray, " N"], is_hit: Bool[np.ndarray, " N"], num_objects: int
) -> Float64[np.ndarray, " 40"]:
    """Return the largest precision at a recall of k/40 or more, for k = 1 to 40.

    Detections of equal scores count together: no threshold tells them apart.
    """
    order = np.argsort(-scores, kind="stable")
    is_last_of_score = _is_last_of_score(scores[order])
    num_hits = np.cumsum(is_hit[order])[is_last_of_score]
    num_detections = np.arange(1, len(order) + 1)[is_last_of_score]
    precision = num_hits / num_detections
    best_precision = np.maximum.accumulate(precision[::-1])[::-1]
    # Whole numbers: recall 3/10 is reached by 3 of 10 objects, whatever 0.3 is in binary.
    first = np.searchsorted(num_hits * NUM_RECALLS, np.arange(1, NUM_RECALLS + 1) * num_objects)
    return np.append(best_precision, 0.0)[first]


def _is_last_of_score(scores: Float64[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Return True for the last of equal scores, of scores in descending order."""
    return np.append(np.diff(scores) != 0, True)[: len(scores)]
