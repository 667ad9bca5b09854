"""Average precision in resamples of scenes, without matching a detection again.

A resample takes scene s w_s times. Detections keep their order and their matches, so the number of
hits down to a score is the sum over scenes of w_s times the scene's hits down to it: a product of
two matrices for all resamples and scores.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

# Largest number of values [resamples, hits] that are held at a time.
_MAX_VALUES = 2_000_000


@dataclass(frozen=True, eq=False)
class SceneResampling:
    """Resamples of the scenes of some images."""

    scene_numbers: Int64[np.ndarray, " I"]
    """Number of the scene of each image."""
    weights: Int64[np.ndarray, "R S"]
    """Number of times that each resample has each scene."""

    def of_images(self, numbers: Int64[np.ndarray, " J"]) -> SceneResampling:
        """Return the same resamples for some of the images."""
        return SceneResampling(self.scene_numbers[numbers], self.weights)


@dataclass(frozen=True, eq=False)
class RankedDetections:
    """Detections of one category in all images, best score first, without ignored ones."""

    is_hit: Bool[np.ndarray, " N"]
    """True for detections that find an object."""
    is_readable: Bool[np.ndarray, " N"]
    """True where precision is read: nowhere between equal scores, if no threshold tells them
    apart."""
    scene_numbers: Int64[np.ndarray, " N"]
    """Number of each detection's scene."""
    num_objects: Int64[np.ndarray, " S"]
    """Number of objects that count, by scene."""


def resampled_precision(
    detections: RankedDetections,
    weights: Int64[np.ndarray, "R S"],
    recalls: Float64[np.ndarray, " K"],
) -> Float64[np.ndarray, " R"]:
    """Return the average precision of one category in each resample.

    It is the mean over `recalls` of the largest precision at a recall of at least that; NaN in
    resamples without an object.

    Args:
        detections: Detections of the category.
        weights: Number of times that each resample has each scene.
        recalls: Recalls of the mean, ascending.
    """
    num_scenes = weights.shape[1]
    ends = np.flatnonzero(detections.is_readable)
    # A place without a hit since the one before has less precision at the same recall.
    num_hits = np.cumsum(detections.is_hit)[ends]
    ends = ends[np.diff(num_hits, prepend=0) > 0]
    hits = np.empty((num_scenes, len(ends)))
    counts = np.empty((num_scenes, len(ends)))
    for scene in range(num_scenes):
        places = np.flatnonzero(detections.scene_numbers == scene)
        counts[scene] = np.searchsorted(places, ends, side="right")
        hit_places = places[detections.is_hit[places]]
        hits[scene] = np.searchsorted(hit_places, ends, side="right")
    num_objects = weights @ detections.num_objects
    precisions = np.full(len(weights), np.nan)
    rows_at_a_time = max(1, _MAX_VALUES // max(len(ends), 1))
    for start in range(0, len(weights), rows_at_a_time):
        rows = np.arange(start, min(start + rows_at_a_time, len(weights)))
        rows = rows[num_objects[rows] > 0]
        row_hits = weights[rows] @ hits
        precision = row_hits / np.maximum(weights[rows] @ counts, 1)
        best_precision = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
        row_recalls = row_hits / num_objects[rows, None]
        for k, row in enumerate(rows):
            first = np.searchsorted(row_recalls[k], recalls)
            precisions[row] = np.append(best_precision[k], 0.0)[first].mean()
    return precisions
