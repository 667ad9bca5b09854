"""Samples in the shape that torchvision's detectors and transforms (v2) take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
import torch

from augment.boxes import PlacedBoxes, shown_pixels
from augment.cameras import Camera
from augment.dataset.samples import IMAGES, boxes_2d, boxes_in_camera
from augment.labels import Boxes
from augment.semantics import class_of_label

_KEPT = ("frame", "scene", "variant")


def torchvision_sample(
    sample: Mapping[str, Any],
    *,
    label_ids: Mapping[str, int] | Callable[[str], int] = class_of_label,
    masks: bool = False,
    bounds: Literal["amodal", "modal"] = "amodal",
    min_visible_fraction: float = 0.0,
    min_visibility: float = 0.0,
    min_side_px: float = 1.0,
    min_pixels: int = 1,
) -> tuple[torch.Tensor, dict[str, Any]]:
    """(image, target) of a sample, for `WeatherDataset(transform=torchvision_sample)`.

    The image is [3, H, W] of the sample's type. The target holds, of the N boxes that are kept:

        boxes             float32 [N, 4], pixels, xyxy, cut off at the image's borders: amodal, of
                          the whole box (`boxes_2d`), or modal, of the pixels that show it
        labels            int64 [N], by label_ids: `SemanticClass` by default (vehicles are 10);
                          boxes of labels that a mapping lacks are left out
        visible_fraction  float64 [N], of each what nothing before it hides (NaN: not known), if the
                          sample has it
        visibility        float64 [N], what the weather leaves of each
        track_ids         list of N
        masks             bool [N, H, W], if asked for: the pixels that show each box, by depth
        depth, semantic, instance, water, snow   [H, W], those that the sample has
        frame, scene, variant

    Kept are boxes in view with sides of min_side_px at least, of which min_visible_fraction at
    least is not hidden by other things and min_visibility not by weather; with modal bounds, those
    that a pixel shows; with masks, those that min_pixels at least show. Where torchvision is
    installed, image, boxes and masks are its `tv_tensors`, so that its transforms move them
    together; depth too is a `Mask`, which transforms never blend. Else they are plain tensors.

    Raises:
        ValueError: the sample has no image or boxes, or lacks the depth that masks need, or what
            modal bounds and min_visible_fraction need.
    """
    if sample["image"] is None:
        raise ValueError("the sample has no image; open the dataset with 'image' in load")
    if bounds not in ("amodal", "modal"):
        raise ValueError(f"bounds must be 'amodal' or 'modal'; got {bounds!r}")
    flat, boxes = boxes_2d(sample), sample["boxes"]
    ids = [_id_of(label, label_ids) for label in boxes["labels"]]
    kept = flat.in_view.numpy() & (boxes["visibility"].numpy() >= min_visibility)
    xyxy = flat.xyxy
    if bounds == "modal" or min_visible_fraction > 0:
        _check_measured(sample)
    if bounds == "modal":
        xyxy = boxes["modal_xyxy"]
    if min_visible_fraction > 0:  # where it is not known (NaN), the box is left out
        kept &= boxes["visible_fraction"].numpy() >= min_visible_fraction
    sides = xyxy[:, 2:] - xyxy[:, :2]
    kept &= (sides >= min_side_px).all(dim=1).numpy() & xyxy.isfinite().all(dim=1).numpy()
    kept &= np.array([number is not None for number in ids], bool)
    shown = None
    if masks:
        shown = box_masks(sample)
        kept &= shown.flatten(1).sum(dim=1).numpy() >= min_pixels
    chosen = np.flatnonzero(kept)
    wrap = _wrappers(tuple(sample["image"].shape[-2:]))
    target: dict[str, Any] = {
        "boxes": wrap["boxes"](xyxy[chosen]),
        "labels": torch.tensor([ids[k] for k in chosen], dtype=torch.int64),
        "visibility": boxes["visibility"][chosen],
        "track_ids": [boxes["track_ids"][k] for k in chosen],
        **{key: sample[key] for key in _KEPT},
    }
    if boxes["visible_fraction"] is not None:
        target["visible_fraction"] = boxes["visible_fraction"][chosen]
    if shown is not None:
        target["masks"] = wrap["mask"](shown[chosen])
    buffers = (key for key in IMAGES if key != "image" and sample[key] is not None)
    target |= {key: wrap["mask"](sample[key]) for key in buffers}
    return wrap["image"](sample["image"]), target


def _check_measured(sample: Mapping[str, Any]) -> None:
    if sample["boxes"]["visible_fraction"] is None:
        raise ValueError(
            f"modal bounds and min_visible_fraction need what labels/boxes_2d.parquet says; scene "
            f"{sample['scene']!r}, variant {sample['variant']!r}, frame {sample['frame']} is of an "
            f"output without it: overwrite the variant, or take amodal bounds and no threshold"
        )


def box_masks(sample: Mapping[str, Any]) -> torch.Tensor:
    """bool [B, H, W]: the pixels that show each of a sample's boxes. A pixel does if the surface of
    the depth image there lies inside the box, its lowest centimetres left out and the other sides
    10 cm wider (`augment.boxes`); so what hides a box is not in its mask. Where boxes overlap a
    pixel is in both. Raises ValueError: the sample has no boxes or no depth.
    """
    boxes, depth, camera = sample["boxes"], sample["depth"], sample["camera"]
    if boxes is None or depth is None:
        raise ValueError(
            f"masks need boxes and depth; the sample of scene {sample['scene']!r}, frame "
            f"{sample['frame']} lacks {'boxes' if boxes is None else 'depth'}"
        )
    K = camera["K"].numpy()
    view = Camera(
        camera["name"], camera["width"], camera["height"], K[0, 0], K[1, 1], K[0, 2], K[1, 2],
        torch.eye(4, dtype=torch.float64),
    )  # fmt: skip
    centers_m, quats = boxes_in_camera(boxes, camera)
    names = tuple(boxes["track_ids"])
    there = Boxes(names, tuple(boxes["labels"]), centers_m, boxes["sizes_m"].numpy(), quats)
    masks = np.zeros((len(names), camera["height"], camera["width"]), bool)
    for number, rows, columns in shown_pixels(
        PlacedBoxes.of(there, np.zeros(3)), view, depth.numpy()
    ):
        masks[number, rows, columns] = True
    return torch.from_numpy(masks)


def _id_of(label: str, label_ids: Mapping[str, int] | Callable[[str], int]) -> int | None:
    if isinstance(label_ids, Mapping):
        return label_ids.get(label)
    return int(label_ids(label))


def _wrappers(size: tuple[int, ...]) -> dict[str, Callable[[torch.Tensor], torch.Tensor]]:
    """What makes torchvision's kinds of tensors, or leaves them as they are. size: (H, W)."""
    try:
        from torchvision import tv_tensors  # pyright: ignore[reportMissingImports]
    except ImportError:
        return dict.fromkeys(("image", "boxes", "mask"), lambda tensor: tensor)
    return {
        "image": tv_tensors.Image,
        "boxes": lambda xyxy: tv_tensors.BoundingBoxes(xyxy, format="XYXY", canvas_size=size),
        "mask": tv_tensors.Mask,
    }
