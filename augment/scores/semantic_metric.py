"""Mean intersection over union of semantic images."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64

from augment.scene.semantics import SemanticClass
from augment.scores.predictions import NO_CLASS

NUM_CLASSES = len(SemanticClass)


def count_pixels(
    true_classes: np.ndarray, predicted_classes: np.ndarray
) -> Int64[np.ndarray, "C D"]:
    """Return the number of pixels of each true class (rows) that have each predicted class.

    Pixels of the true class UNKNOWN do not count. The last column has pixels without a prediction.

    Args:
        true_classes: Classes of an image, uint8 [H, W].
        predicted_classes: Classes that a network gives, uint8 [H, W]; NO_CLASS for none.

    Raises:
        ValueError: The sizes differ, or a predicted class is unknown.
    """
    if true_classes.shape != predicted_classes.shape:
        raise ValueError(
            f"expected {true_classes.shape[1]} x {true_classes.shape[0]} pixels; got "
            f"{' x '.join(map(str, predicted_classes.shape[::-1]))}"
        )
    classes, counts = np.unique(predicted_classes, return_counts=True)
    is_unknown = (classes >= NUM_CLASSES) & (classes != NO_CLASS)
    if is_unknown.any():
        raise ValueError(
            f"{counts[is_unknown].sum()} pixels have classes that are not of the suite's 0 to "
            f"{NUM_CLASSES - 1}: {classes[is_unknown].tolist()}"
        )
    columns = np.where(predicted_classes == NO_CLASS, NUM_CLASSES, predicted_classes)
    is_counted = true_classes != SemanticClass.UNKNOWN
    cells = true_classes[is_counted].astype(np.int64) * (NUM_CLASSES + 1) + columns[is_counted]
    table = np.bincount(cells, minlength=NUM_CLASSES * (NUM_CLASSES + 1))
    return table.reshape(NUM_CLASSES, NUM_CLASSES + 1)


def class_overlaps(pixel_counts: Int64[np.ndarray, "C D"]) -> np.ndarray:
    """Return the intersection over union of each class; NaN for classes that no pixel has.

    mIoU is their mean without NaN. A class that is predicted and nowhere true has NaN, too: its
    pixels count against the classes that are true there.

    Args:
        pixel_counts: Sum of `count_pixels` over images.
    """
    shared = np.diagonal(pixel_counts).astype(np.float64)
    true_pixels = pixel_counts.sum(axis=1)
    predicted_pixels = pixel_counts.sum(axis=0)[: len(pixel_counts)]
    union = true_pixels + predicted_pixels - shared
    return np.where(true_pixels > 0, shared / np.maximum(union, 1), np.nan)
