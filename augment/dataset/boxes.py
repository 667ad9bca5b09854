"""Boxes as images show them, and samples in the shape that detectors are trained on.

In: samples of a dataset (`augment.dataset.samples`). Out: 2D boxes, masks, and (image, target)
pairs for torchvision.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from augment.dataset.samples import buffers, check_choice, points_in_frame, quats_in_frame
from augment.scene.boxes import WorldBoxes, outline_boxes, pixels_of_boxes
from augment.scene.cameras import Camera
from augment.scene.geometry import invert_rigid, rotmat_from_quat
from augment.scene.labels import Boxes
from augment.scene.semantics import class_of_label


@dataclass(frozen=True, eq=False)
class Boxes2d:
    """Boxes in the image."""

    xyxy: torch.Tensor
    """Left, top, right, bottom, float32 [B, 4], pixels, inside the image (0 to its width and
    height; the first pixel's centre is at 0.5); zeros for boxes out of view."""
    in_view: torch.Tensor
    """True for boxes with a part inside the image, hidden by others or not, bool [B]."""


def boxes_2d(sample: Mapping[str, Any]) -> Boxes2d:
    """Return the tight bounds of a sample's boxes in the image.

    The bounds enclose the projected box, cut off at the image's borders. (Bounds of the projected
    corners would be wider for a box that a border cuts.) Weather and objects that hide a box do not
    change them. A box whose numbers are not finite is out of view.

    Raises:
        ValueError: the sample has no boxes.
    """
    boxes = sample["boxes"]
    camera = sample["camera"]
    if boxes is None:
        raise ValueError(
            f"scene {sample['scene']!r}, frame {sample['frame']}: the sample has no boxes; open "
            f"the dataset with 'boxes' in load, of a variant whose recipe writes labels"
        )
    _check_pinhole(camera)
    centers_m, quats = boxes_in_camera(boxes, camera)
    rotations = rotmat_from_quat(torch.from_numpy(quats)).numpy()  # NaN of quaternions of zeros
    size = (camera["width"], camera["height"])
    outlines = outline_boxes(
        centers_m, boxes["sizes_m"].numpy(), rotations, camera["K"].numpy(), size
    )
    return Boxes2d(
        torch.from_numpy(outlines.xyxy.astype(np.float32)), torch.from_numpy(outlines.in_view)
    )


def _check_pinhole(camera: Mapping[str, Any]) -> None:
    """Raise ValueError for a camera with a lens or a shutter, through which nothing is projected.

    Args:
        camera: `camera` of a sample; one without the two entries is a pinhole.
    """
    if camera.get("lens") is not None or camera.get("shutter") is not None:
        raise ValueError(
            f"camera {camera['name']!r} has a lens or a rolling shutter, and boxes are projected "
            f"here as a pinhole shows them; take the sample's own modal_xyxy and the box tables, "
            f"which are measured in the image itself, or open the scene without lens=recorded"
        )


def boxes_in_camera(
    boxes: Mapping[str, Any], camera: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Return centers_m [B, 3] and quats [B, 4], float64, of a sample's boxes in its camera's frame.

    The sample's boxes may be in any frame.

    Args:
        boxes: `boxes` of the sample.
        camera: `camera` of the sample.
    """
    centers_m = boxes["centers_m"].numpy()
    quats = boxes["quats"].numpy()
    if boxes["frame"] == "camera":
        return centers_m, quats
    frame_from_camera = camera["world_from_camera"].numpy()
    if boxes["frame"] == "ego":
        frame_from_camera = invert_rigid(camera["world_from_ego"]).numpy() @ frame_from_camera
    return points_in_frame(centers_m, frame_from_camera), quats_in_frame(quats, frame_from_camera)


# ---- Samples in the shape that torchvision's detectors and transforms (v2) take ------------------

Bounds = Literal["amodal", "modal"]


def torchvision_sample(
    sample: Mapping[str, Any],
    *,
    label_ids: Mapping[str, int] | Callable[[str], int] = class_of_label,
    masks: bool = False,
    bounds: Bounds = "amodal",
    min_visible_fraction: float = 0.0,
    min_visibility: float = 0.0,
    min_side_px: float = 1.0,
    min_pixels: int = 1,
) -> tuple[torch.Tensor, dict[str, Any]]:
    """Return (image, target) of a sample, for `WeatherDataset(transform=torchvision_sample)`.

    The image is [3, H, W] of the sample's type. The target holds, of the N boxes that are kept:

        boxes             float32 [N, 4], pixels, xyxy, cut off at the image's borders: amodal, of
                          the whole box (`boxes_2d`), or modal, of the pixels that show it
        labels            int64 [N], by label_ids: `SemanticClass` by default (vehicles are 10);
                          boxes of labels that a mapping lacks are left out
        visible_fraction  float64 [N], part that nothing before the box hides (NaN: not known), if
                          the sample has it
        visibility        float64 [N], part that the weather leaves visible
        track_ids         list of N
        masks             bool [N, H, W], if asked for: the pixels that show each box, by depth
        depth, semantic, instance, water, snow   [H, W], those that the sample has
        frame, scene, variant

    Where torchvision is installed, image, boxes and masks are its `tv_tensors`, so that its
    transforms move them together; depth, too, is a `Mask`, which transforms never blend. Else they
    are plain tensors.

    Args:
        sample: a sample with an image and boxes.
        label_ids: number of each label: a mapping, or a function that returns None for none.
        masks: if True, the target has masks, and boxes that fewer than min_pixels show are left
            out.
        bounds: amodal or modal; modal bounds leave out boxes that no pixel shows.
        min_visible_fraction: part of a box that other things must leave visible.
        min_visibility: part of a box that the weather must leave visible.
        min_side_px: shortest side of a box in the image.
        min_pixels: pixels that must show a box, with masks.

    Raises:
        ValueError: the sample has no image or boxes, or lacks the depth that masks need, or what
            modal bounds and min_visible_fraction need.
    """
    if sample["image"] is None:
        raise ValueError("the sample has no image; open the dataset with 'image' in load")
    check_choice("bounds", bounds, Bounds)
    outlines = boxes_2d(sample)
    boxes = sample["boxes"]
    visible = boxes["visible_fraction"]
    if visible is None and (bounds == "modal" or min_visible_fraction > 0):
        raise ValueError(
            f"modal bounds and min_visible_fraction need what labels/boxes_2d.parquet says; scene "
            f"{sample['scene']!r}, variant {sample['variant']!r}, frame {sample['frame']} is of an "
            f"output without it: overwrite the variant, or take amodal bounds and no threshold"
        )
    xyxy = boxes["modal_xyxy"] if bounds == "modal" else outlines.xyxy
    find_id = label_ids.get if isinstance(label_ids, Mapping) else label_ids
    ids = [find_id(label) for label in boxes["labels"]]
    mask = outlines.in_view & (boxes["visibility"] >= min_visibility) & xyxy.isfinite().all(dim=1)
    mask &= (xyxy[:, 2:] - xyxy[:, :2] >= min_side_px).all(dim=1)
    mask &= torch.tensor([number is not None for number in ids], dtype=torch.bool)
    if visible is not None and min_visible_fraction > 0:
        # A box whose visible fraction is not known (NaN) is left out.
        mask &= visible >= min_visible_fraction
    pixel_masks = box_masks(sample) if masks else None
    if pixel_masks is not None:
        mask &= pixel_masks.flatten(1).sum(dim=1) >= min_pixels
    box_numbers = mask.nonzero()[:, 0]
    wrap = _wrappers(tuple(sample["image"].shape[-2:]))
    target: dict[str, Any] = {
        "boxes": wrap["boxes"](xyxy[box_numbers]),
        "labels": torch.tensor([ids[k] for k in box_numbers.tolist()], dtype=torch.int64),
        "visibility": boxes["visibility"][box_numbers],
        "track_ids": [boxes["track_ids"][k] for k in box_numbers.tolist()],
        **{key: sample[key] for key in ("frame", "scene", "variant")},
    }
    if visible is not None:
        target["visible_fraction"] = visible[box_numbers]
    if pixel_masks is not None:
        target["masks"] = wrap["mask"](pixel_masks[box_numbers])
    target |= {k: wrap["mask"](sample[k]) for k in buffers() if sample[k] is not None}
    return wrap["image"](sample["image"]), target


def box_masks(sample: Mapping[str, Any]) -> torch.Tensor:
    """Return the pixels that show each of a sample's boxes, bool [B, H, W].

    A pixel shows a box if its surface, by the depth image, lies inside the box without its lowest
    centimetres and with the other sides 10 cm wider (`augment.scene.boxes`). An object in front of
    a box is therefore not in the mask of the box. Where boxes overlap, a pixel is in both masks.

    Raises:
        ValueError: the sample has no boxes or no depth.
    """
    boxes = sample["boxes"]
    depth = sample["depth"]
    camera = sample["camera"]
    if boxes is None or depth is None:
        raise ValueError(
            f"masks need boxes and depth; the sample of scene {sample['scene']!r}, frame "
            f"{sample['frame']} lacks {'boxes' if boxes is None else 'depth'}"
        )
    _check_pinhole(camera)
    K = camera["K"].numpy()
    view = Camera(
        camera["name"],
        camera["width"],
        camera["height"],
        K[0, 0],
        K[1, 1],
        K[0, 2],
        K[1, 2],
        torch.eye(4, dtype=torch.float64),
    )
    centers_m, quats = boxes_in_camera(boxes, camera)
    names = tuple(boxes["track_ids"])
    camera_boxes = Boxes(names, tuple(boxes["labels"]), centers_m, boxes["sizes_m"].numpy(), quats)
    masks = np.zeros((len(names), camera["height"], camera["width"]), bool)
    for number, rows, columns in pixels_of_boxes(
        WorldBoxes.from_labels(camera_boxes, np.zeros(3)), view, depth.numpy()
    ):
        masks[number, rows, columns] = True
    return torch.from_numpy(masks)


def _wrappers(size: tuple[int, ...]) -> dict[str, Callable[[torch.Tensor], torch.Tensor]]:
    """Return functions that make torchvision's kinds of tensors.

    Without torchvision they return the tensor unchanged.

    Args:
        size: (H, W) of the image.
    """
    try:
        from torchvision import tv_tensors  # pyright: ignore[reportMissingImports]
    except ImportError:
        return dict.fromkeys(("image", "boxes", "mask"), lambda tensor: tensor)
    return {
        "image": tv_tensors.Image,
        "boxes": lambda xyxy: tv_tensors.BoundingBoxes(xyxy, format="XYXY", canvas_size=size),
        "mask": tv_tensors.Mask,
    }
