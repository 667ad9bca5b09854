"""A task's metric on some images of a variant: mAP, KITTI's AP, mIoU or NDS.

One class for each kind of predictions, all with the method of `Metric`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from augment.errors import ScoreError
from augment.output.codecs import decode_png
from augment.scene.semantics import SemanticClass
from augment.scores.coco_metric import coco_average_precision
from augment.scores.kitti_metric import DIFFICULTIES, KittiView, kitti_average_precision
from augment.scores.nuscenes_metric import NuScenesSplit, detection_score
from augment.scores.predictions import RESULTS_FILE, Predictions
from augment.scores.resampled_precision import SceneResampling
from augment.scores.semantic_metric import class_overlaps, count_pixels
from augment.scores.suite_facts import CLEAN_VARIANT, RenderedSuite
from augment.scores.truth import SuiteTruth


class MetricValue(NamedTuple):
    """A metric's value on some images."""

    value: float
    """Mean over the categories that have objects, 0 to 1."""
    by_category: dict[str, float | None]
    """Value of each category; None where no object counts."""
    resampled: np.ndarray | None = None
    """Value in each resample of scenes, float64 [R], NaN where no object counts; None without
    resamples."""


@runtime_checkable
class Metric(Protocol):
    """A metric of predictions on images of a suite."""

    @property
    def name(self) -> str:
        """Name of the metric, for reports and to compare baselines."""
        ...

    def measure(
        self,
        predictions: Predictions,
        numbers: Sequence[int],
        resampling: SceneResampling | None = None,
    ) -> MetricValue:
        """Return the metric's value on the images of some numbers.

        Args:
            numbers: Numbers of the images that count.
            resampling: Resamples of the scenes of all images of the suite, if wanted.
        """
        ...


@dataclass(frozen=True, eq=False)
class CocoMetric:
    """COCO's mAP of boxes."""

    truth: SuiteTruth
    """True objects."""

    @property
    def name(self) -> str:
        """Name of the metric."""
        return "mAP@[.5:.95] (COCO)"

    def measure(
        self,
        predictions: Predictions,
        numbers: Sequence[int],
        resampling: SceneResampling | None = None,
    ) -> MetricValue:
        """Return mAP on the images of some numbers."""
        precisions = coco_average_precision(
            [self.truth.images[number] for number in numbers],
            [predictions.detections[number] for number in numbers],
            len(self.truth.categories),
            _of_images(resampling, numbers),
        )
        return mean_of_categories(*precisions, self.truth.categories)


@dataclass(frozen=True, eq=False)
class KittiMetric:
    """KITTI's AP at 40 recalls."""

    truth: SuiteTruth
    """True objects."""
    view: KittiView
    """Overlap of boxes in the image, from above, or in space."""
    difficulty: str
    """Name of the difficulty."""

    @property
    def name(self) -> str:
        """Name of the metric."""
        return f"AP|R40 {self.view} {self.difficulty} (KITTI)"

    def measure(
        self,
        predictions: Predictions,
        numbers: Sequence[int],
        resampling: SceneResampling | None = None,
    ) -> MetricValue:
        """Return the mean AP on the images of some numbers.

        Raises:
            ScoreError: The view needs 3D boxes, and a detection has none.
        """
        sizes = np.concatenate([image.boxes_3d[:, 3:6] for image in predictions.detections])
        without_size = int((~np.all(sizes > 0, axis=1)).sum())
        if self.view != "bbox" and without_size:
            raise ScoreError(
                f"{predictions.folder}: {without_size} of {len(sizes)} detections have no height, "
                f"width and length above 0, which the view {self.view} needs"
            )
        precisions = kitti_average_precision(
            [self.truth.images[number] for number in numbers],
            [predictions.detections[number] for number in numbers],
            self.truth.categories,
            view=self.view,
            difficulty=DIFFICULTIES[self.difficulty],
            resampling=_of_images(resampling, numbers),
        )
        return mean_of_categories(*precisions, self.truth.categories)


@dataclass(frozen=True, eq=False)
class SemanticMetric:
    """Mean intersection over union against the classes of the clean render."""

    suite: RenderedSuite
    """The suite."""
    pixel_counts: dict[str, np.ndarray] = field(default_factory=dict)
    """Counts [images, true class, predicted class] of the predictions that were measured, by their
    hash."""

    @property
    def name(self) -> str:
        """Name of the metric."""
        return "mIoU"

    def measure(
        self,
        predictions: Predictions,
        numbers: Sequence[int],
        resampling: SceneResampling | None = None,
    ) -> MetricValue:
        """Return mIoU on the images of some numbers."""
        counts = self.count(predictions)[np.asarray(numbers, np.int64)]
        names = [semantic_class.name.lower() for semantic_class in SemanticClass]
        resampled = None
        image_resampling = _of_images(resampling, numbers)
        if image_resampling is not None:
            num_scenes = image_resampling.weights.shape[1]
            by_scene = np.zeros((num_scenes, *counts.shape[1:]), np.int64)
            np.add.at(by_scene, image_resampling.scene_numbers, counts)
            sums = np.tensordot(image_resampling.weights, by_scene, axes=1)
            resampled = np.stack([class_overlaps(table) for table in sums])
        return mean_of_categories(class_overlaps(counts.sum(axis=0)), resampled, names)

    def count(self, predictions: Predictions) -> np.ndarray:
        """Return the pixels of each true and predicted class, [images, true, predicted].

        Raises:
            ScoreError: An image is missing, of another size, or has unknown classes.
        """
        key = predictions.content_hash
        if key not in self.pixel_counts:
            self.pixel_counts[key] = np.stack(
                [self._count_image(predictions, number) for number in range(len(self.suite.images))]
            )
        return self.pixel_counts[key]

    def _count_image(self, predictions: Predictions, number: int) -> np.ndarray:
        """Return the pixels of an image by true and predicted class."""
        row = self.suite.rows[CLEAN_VARIANT][number]
        path = row["semantic_path"]
        if path is None:
            raise ScoreError(
                f"{self.suite.store.uri}: {CLEAN_VARIANT} has no semantic images to compare with; "
                f"render the suite with --set output.semantic=true"
            )
        true_classes = decode_png(self.suite.store.read(path), np.uint8)
        try:
            predicted_classes = predictions.class_image(number, (row["width"], row["height"]))
            return count_pixels(true_classes, predicted_classes)
        except ValueError as error:
            raise ScoreError(f"{predictions.folder}: image {number:06d}: {error}") from error


@dataclass(frozen=True, eq=False)
class NuScenesMetric:
    """nuScenes detection score, computed by nuscenes-devkit on a split."""

    suite: RenderedSuite
    """The suite."""
    split: NuScenesSplit
    """Samples that are scored."""
    values: dict[tuple[str, tuple[str, ...]], MetricValue] = field(default_factory=dict)
    """Values by the hash of the predictions and the names of the scenes that do not count."""

    @property
    def name(self) -> str:
        """Name of the metric."""
        return f"NDS ({self.split.split})"

    def measure(
        self,
        predictions: Predictions,
        numbers: Sequence[int],
        resampling: SceneResampling | None = None,
    ) -> MetricValue:
        """Return NDS on the scenes of the images of some numbers. It has no resamples.

        Raises:
            ScoreError: The devkit is missing, or refuses the results.
        """
        scenes = {image.scene for image in self.suite.images}
        omitted = tuple(sorted(scenes - {self.suite.images[number].scene for number in numbers}))
        key = (predictions.content_hash, omitted)
        if key not in self.values:
            path = predictions.folder / RESULTS_FILE
            score = detection_score(path, self.split, scenes, omitted)
            self.values[key] = MetricValue(score.score, dict(score.by_class))
        return self.values[key]


def mean_of_categories(
    values: np.ndarray, resampled: np.ndarray | None, names: Sequence[str]
) -> MetricValue:
    """Return the mean over the categories that have a value; NaN if none has.

    Args:
        values: Value of each category [C], NaN where no object counts.
        resampled: The same in each resample [R, C]; None without resamples.
        names: Names of the categories.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the mean of nothing
        mean = float(np.nanmean(values))
        means = None if resampled is None else np.nanmean(resampled, axis=1)
    by_category = {
        name: None if np.isnan(value) else float(value)
        for name, value in zip(names, values, strict=True)
    }
    return MetricValue(mean, by_category, means)


def _of_images(
    resampling: SceneResampling | None, numbers: Sequence[int]
) -> SceneResampling | None:
    """Return resamples for the images of some numbers."""
    return None if resampling is None else resampling.of_images(np.asarray(numbers, np.int64))
