"""True objects of a suite's images, and the share of each that the weather leaves visible.

In: box tables of a rendered suite. Out: `ImageTruth` of every image. All variants have the same
truth, that of the clean render: an object that the weather hides and that a detector misses counts
as missed. Recall by visibility (`augment.scores.recall`) tells such misses apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from augment.dataset.label_files import category_of
from augment.dataset.samples import points_in_frame
from augment.dataset.weather_dataset import RowReader
from augment.errors import ScoreError
from augment.output.box_tables import BOXES_2D, MODAL_SIDES, SIDES
from augment.output.box_weather import combine_visibility
from augment.scene.geometry import rotmat_from_quat
from augment.scores.suite_facts import CLEAN_VARIANT, RenderedSuite, Row
from recipes.schema import Category

# Number of pixels that an object of the main score has at least in the clean render.
MIN_PIXELS = 25
# Smallest share of such an object that no other object hides.
MIN_VISIBLE_FRACTION = 0.1
# Columns of a 3D box: middle of the bottom (x right, y down, z forward of the camera), height,
# width, length, in metres, and the turn about the camera's y axis in radians.
NUM_BOX_3D_COLUMNS = 7


@dataclass(frozen=True, eq=False)
class ImageTruth:
    """True objects of one image."""

    width: int
    """Width of the image, pixels."""
    height: int
    """Height of the image, pixels."""
    categories: Int64[np.ndarray, " T"]
    """Category of each object, an index of the suite's category names."""
    boxes: Float64[np.ndarray, "T 4"]
    """Left, top, right, bottom of the pixels that show each object."""
    amodal_boxes: Float64[np.ndarray, "T 4"]
    """Left, top, right, bottom of the projected box inside the image, hidden or not."""
    boxes_3d: Float64[np.ndarray, "T 7"]
    """3D box of each object in the camera's frame."""
    is_ignored: Bool[np.ndarray, " T"]
    """True for objects that are too small or too hidden: neither finding nor missing them counts.
    """
    pixels: Int64[np.ndarray, " T"]
    """Number of pixels that show each object."""
    visible_fractions: Float64[np.ndarray, " T"]
    """Share of each object that other objects leave visible; NaN if not known."""
    truncated_fractions: Float64[np.ndarray, " T"]
    """Share of the projected box that lies outside the image."""
    ranges_m: Float64[np.ndarray, " T"]
    """Distance of each object's centre from the camera."""
    box_places: Int64[np.ndarray, " T"]
    """Place of each object among the boxes of its frame."""

    def __len__(self) -> int:
        return len(self.categories)


@dataclass(frozen=True, eq=False)
class SuiteTruth:
    """True objects of all images of a suite."""

    categories: tuple[str, ...]
    """Names of the categories."""
    images: tuple[ImageTruth, ...]
    """Objects of each image, by the image's number."""
    unmapped_labels: dict[str, int]
    """Number of boxes by label, for labels of no category."""

    def count(self, numbers: Sequence[int]) -> int:
        """Return the number of objects that count in some images."""
        return sum(int((~self.images[number].is_ignored).sum()) for number in numbers)


def read_truth(suite: RenderedSuite, categories: Sequence[Category] | None = None) -> SuiteTruth:
    """Return the true objects of a suite's images.

    Args:
        categories: Table from the dataset's labels to categories; None makes every label one.

    Raises:
        ScoreError: The suite has no labels, or no label has a category.
        OutputError: A label table is damaged.
    """
    reader = RowReader(suite.store, verify=False)
    rows = suite.rows[CLEAN_VARIANT]
    lacking = [row for row in rows if row["labels_path"] is None or row["box_2d_path"] is None]
    if lacking:
        raise ScoreError(
            f"{suite.store.uri}: {len(lacking)} of {len(rows)} images of {CLEAN_VARIANT} have no "
            f"labels to compare detections with; the scenes have no boxes, or the suite was "
            f"rendered with output.labels: false"
        )
    labelled = [reader.labels(row, ("boxes",)) for row in rows]
    label_counts = Counter(
        label
        for labels in labelled
        for label in (() if labels.boxes is None else labels.boxes.labels)
    )
    mapped = {label: category_of(label, categories) for label in label_counts}
    names = dict.fromkeys(
        (row.name for row in categories) if categories else sorted(n for n in mapped.values() if n)
    )
    if not any(mapped.values()):
        raise ScoreError(
            f"{suite.store.uri}: no box has a category; the labels are "
            f"{', '.join(sorted(label_counts)) or 'none at all'}"
        )
    category_numbers = {name: number for number, name in enumerate(names)}
    number_by_label = {
        label: -1 if name is None else category_numbers[name] for label, name in mapped.items()
    }
    images = (
        _image_truth(reader, row, labels, number_by_label)
        for row, labels in zip(rows, labelled, strict=True)
    )
    unmapped = {label: label_counts[label] for label in sorted(mapped) if mapped[label] is None}
    return SuiteTruth(tuple(names), tuple(images), unmapped)


def _image_truth(
    reader: RowReader, row: Row, labels: Any, number_by_label: dict[str, int]
) -> ImageTruth:
    """Return the objects of a category that an image of the clean render shows."""
    boxes = labels.boxes
    numbers = labels.box_weather[BOXES_2D.name]
    categories = np.array([number_by_label[label] for label in boxes.labels], np.int64)
    places = np.flatnonzero((categories >= 0) & (numbers["pixels"] > 0))
    camera, _ = reader.camera(row)
    world_from_camera = camera.world_from_camera.numpy()
    centres_m = points_in_frame(boxes.centers_m, world_from_camera)[places]
    rotations = rotmat_from_quat(torch.from_numpy(boxes.quats)).numpy()
    headings = (world_from_camera[:3, :3].T @ rotations)[places, :, 0].reshape(-1, 3)
    length_m, width_m, height_m = boxes.sizes_m[places].reshape(-1, 3).T
    turns = np.arctan2(-headings[:, 2], headings[:, 0])
    x_m, y_m, z_m = centres_m.reshape(-1, 3).T
    modal_boxes = np.stack([numbers[side] for side in MODAL_SIDES], axis=1)[places]
    amodal_boxes = np.stack([numbers[side] for side in SIDES], axis=1)[places]
    has_outline = np.all(amodal_boxes[:, 2:] > amodal_boxes[:, :2], axis=1)
    pixels = numbers["pixels"][places]
    visible_fractions = numbers["visible_fraction"][places]
    return ImageTruth(
        width=row["width"],
        height=row["height"],
        categories=categories[places],
        boxes=modal_boxes,
        amodal_boxes=np.where(has_outline[:, None], amodal_boxes, modal_boxes),
        boxes_3d=np.stack(
            [x_m, y_m + height_m / 2, z_m, height_m, width_m, length_m, turns], axis=1
        ),
        is_ignored=np.asarray((pixels < MIN_PIXELS) | (visible_fractions < MIN_VISIBLE_FRACTION)),
        pixels=pixels,
        visible_fractions=visible_fractions,
        truncated_fractions=numbers["truncated_fraction"][places],
        ranges_m=np.linalg.norm(centres_m.reshape(-1, 3), axis=1),
        box_places=places,
    )


def read_transmittances(
    suite: RenderedSuite, truth: SuiteTruth, variant: str
) -> list[Float64[np.ndarray, " T"]]:
    """Return the share of each object's light that a variant's weather lets through, by image.

    It is the product over the effects: transmittance of fog, rain and snowfall, and the share that
    no water hides.

    Raises:
        OutputError: A label table is damaged.
        ScoreError: The variant has other boxes than the clean render.
    """
    reader = RowReader(suite.store, verify=False)
    shares = []
    for number, row in enumerate(suite.rows[variant]):
        places = truth.images[number].box_places
        labels = reader.labels(row, ("boxes",))
        count = 0 if labels.boxes is None else len(labels.boxes)
        if len(places) and (labels.boxes is None or places.max() >= count):
            raise ScoreError(
                f"{suite.store.uri}: {variant} has {count} boxes in scene {row['scene']!r}, frame "
                f"{row['frame']}, camera {row['camera']!r}, and {CLEAN_VARIANT} has more"
            )
        shares.append(combine_visibility(labels.box_weather or {}, count)[places])
    return shares


def coco_annotations(images: Sequence[ImageTruth]) -> list[dict[str, Any]]:
    """Return the objects of images as annotations of COCO, numbered as of `coco_truth`."""
    annotations: list[dict[str, Any]] = []
    for number, image in enumerate(images):
        for k in range(len(image)):
            left, top, right, bottom = image.boxes[k].tolist()
            annotations.append({
                "id": len(annotations) + 1,
                "image_id": number,
                "category_id": int(image.categories[k]) + 1,
                "bbox": [left, top, right - left, bottom - top],
                "area": int(image.pixels[k]),
                "iscrowd": int(image.is_ignored[k]),
            })  # fmt: skip
    return annotations


def coco_truth(suite: RenderedSuite, truth: SuiteTruth, variant: str) -> dict[str, Any]:
    """Return the truth as a COCO file, with the image paths of a variant.

    Ignored objects have `iscrowd: 1`. `id` of an image is its number, of a category its place from
    1 on.
    """
    return {
        "info": {"suite": suite.name, "variant": variant},
        "images": [
            {
                "id": number,
                "file_name": suite.rows[variant][number]["image_path"],
                "width": truth.images[number].width,
                "height": truth.images[number].height,
                **image._asdict(),
            }
            for number, image in enumerate(suite.images)
        ],
        "annotations": coco_annotations(truth.images),
        "categories": [{"id": k, "name": name} for k, name in enumerate(truth.categories, start=1)],
    }
