"""The samples that the datasets yield, whether read from files or rendered on the fly.

A sample is a dictionary:

    image             float32 [3, H, W] in [0, 1], or uint8 if asked for; RGB, display-encoded
    depth             float32 [H, W], metres along the optical axis, 0 = none; or None
    semantic          uint8 [H, W], augment.semantics.SemanticClass; or None
    instance          int32 [H, W], 0 = none, else the object's number: `boxes` has them; or None
    water             bool [H, W], where a ray meets water first; None where there is no flood
    snow              bool [H, W], where the pixel shows snow; None where there is no snow
    boxes             all boxes of the frame, see `boxes.box_tensors`; None where there are none
    lidar             the frame's sweep, see `lidar_tensors`; None where there is none
    camera            name, width, height, timestamp_ns, K float64 [3, 3] in pixels of the image,
                      world_from_camera, world_from_ego float64 [4, 4] in the dataset's world
    weather           the recipe's numbers by name, floats; NaN where absent
    paths             the files by kind (image, depth, ...), None where there is none
    scene, variant    names;  frame: the dataset's number;  recipe_hash: 16 hexadecimal digits
    surface           what depth, semantic and instance show of the weather: `solid`, snow but not
                      water, `scene`, neither, or `first`, both

What a dataset was not asked to load is None.

Frames: the dataset's world, right-handed, z up, metres; the ego's x forward, y left, z up; the
camera's (OpenCV) x right, y down, z forward. The first pixel's centre is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.utils.data import get_worker_info

from augment.boxes import PlacedBoxes, outline_boxes, shown_pixels
from augment.cameras import Camera
from augment.geometry import rotmat_from_quat
from augment.jobs.files import BoxWeather, CameraRecord, box_tables, depth_in_metres, visibility
from augment.jobs.layout import mask_names
from augment.labels import Boxes, LidarSweep
from augment.semantics import class_of_label

# ---- Boxes for training: in the frame of the world, the car or the camera, and as 2D boxes -------
# Quaternions are wxyz. A box's own axes: x along its length, y its width, z its height.

BoxFrame = Literal["world", "ego", "camera"]
BOX_FRAMES = ("world", "ego", "camera")


@dataclass(frozen=True, eq=False)
class Boxes2d:
    """Boxes in the image. xyxy: float32 [B, 4], pixels, left, top, right, bottom, inside the image
    (0 to its width and height; the first pixel's centre is at 0.5); zeros of boxes out of view.
    in_view: bool [B], whether any of the box lies in the image, hidden by others or not.
    """

    xyxy: torch.Tensor
    in_view: torch.Tensor


def box_tensors(
    boxes: Boxes,
    weather: BoxWeather,
    box_frame: BoxFrame,
    world_from_frame: np.ndarray,
    *,
    instances: np.ndarray | None = None,
) -> dict[str, Any]:
    """centers_m [B, 3], sizes_m [B, 3] (length, width, height), quats [B, 4] (wxyz,
    frame_from_box): float64 tensors in `frame`, which is `box_frame`. labels, track_ids: lists of
    strings. attributes: the dataset's further columns, NumPy arrays by name.

    instance: int32 [B], the objects' numbers in instance images. modal_xyxy: float32 [B, 4], as
    `Boxes2d.xyxy`, but of the pixels that show a box; NaN where none does. visible_fraction:
    float64 [B], of the pixels that show a box or what stands before it; NaN where there are
    neither. truncated_fraction: float64 [B], of the projected box's area, outside the image. All
    four None where the output is older than they.

    submerged_fraction, hidden_fraction: float64 [B], how much of a box's height is under water,
    and of its pixels behind water (NaN where the image shows none); None where there is no flood.
    snow_fraction: float64 [B], how much of its pixels is snow (as above); None without snow.
    transmittance: float64 [B], of the smog before the box, 0 to 1; None without smog.
    visibility: float64 [B], what all of that leaves of the box, 0 to 1
    (`augment.jobs.files.visibility`).

    world_from_frame: float64 [4, 4]; unused where the frame is the world, whose numbers keep their
    bits.
    """
    centers_m, quats = boxes.centers_m.copy(), boxes.quats.copy()
    if box_frame != "world":
        centers_m = moved_points(centers_m, world_from_frame)
        quats = _turned(quats, world_from_frame)
    fractions = {
        name: torch.from_numpy(weather[kind][name].copy()) if kind in weather else None
        for kind, table in box_tables().items()
        for name in table.sampled
    }
    return {
        "frame": box_frame,
        "centers_m": torch.from_numpy(centers_m),
        "sizes_m": torch.from_numpy(boxes.sizes_m.copy()),
        "quats": torch.from_numpy(quats),
        "labels": list(boxes.labels),
        "track_ids": list(boxes.track_ids),
        "attributes": dict(boxes.attributes),
        "instance": None if instances is None else torch.from_numpy(instances.astype(np.int32)),
        **fractions,
        "visibility": torch.from_numpy(visibility(weather, len(boxes))),
    }


def moved_points(points_m: np.ndarray, world_from_frame: np.ndarray) -> np.ndarray:
    """Points of the world [N, 3] in another frame."""
    with np.errstate(invalid="ignore"):  # of points that are not finite, and stay so
        return (points_m - world_from_frame[:3, 3]) @ world_from_frame[:3, :3]


def boxes_2d(sample: Mapping[str, Any]) -> Boxes2d:
    """A sample's boxes as the image shows them: bounds of what lies inside the image, tight. They
    enclose the projected box cut off at the image's borders, not the projected corners, whose
    bounds are wider for a box that a border cuts. Weather and what hides a box change nothing. A
    box whose numbers are not finite is out of view. Raises ValueError: the sample has no boxes.
    """
    boxes, camera = sample["boxes"], sample["camera"]
    if boxes is None:
        raise ValueError(
            f"scene {sample['scene']!r}, frame {sample['frame']}: the sample has no boxes; open "
            f"the dataset with 'boxes' in load, of a variant whose recipe writes labels"
        )
    centers_m, quats = boxes_in_camera(boxes, camera)
    rotations = rotmat_from_quat(torch.from_numpy(quats)).numpy()  # NaN of quaternions of zeros
    size = (camera["width"], camera["height"])
    outlines = outline_boxes(
        centers_m, boxes["sizes_m"].numpy(), rotations, camera["K"].numpy(), size
    )
    return Boxes2d(
        torch.from_numpy(outlines.xyxy.astype(np.float32)), torch.from_numpy(outlines.in_view)
    )


def boxes_in_camera(
    boxes: Mapping[str, Any], camera: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """centers_m [B, 3] and quats [B, 4] of a sample's boxes in its camera's frame, float64,
    whatever frame they are in.
    """
    centers_m, quats = boxes["centers_m"].numpy(), boxes["quats"].numpy()
    if boxes["frame"] == "camera":
        return centers_m, quats
    frame_from_camera = camera["world_from_camera"].numpy()
    if boxes["frame"] == "ego":
        frame_from_camera = inverted(camera["world_from_ego"].numpy()) @ frame_from_camera
    return moved_points(centers_m, frame_from_camera), _turned(quats, frame_from_camera)


def inverted(transform: np.ndarray) -> np.ndarray:
    """The inverse of a rigid transform [4, 4]."""
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


def _turned(quats: np.ndarray, world_from_frame: np.ndarray) -> np.ndarray:
    """Rotations world_from_box as frame_from_box; the quaternions keep their norms."""
    x, y, z, w = Rotation.from_matrix(world_from_frame[:3, :3].T).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    with np.errstate(invalid="ignore"):
        return quats @ left.T


# ---- Batches of samples for a DataLoader ---------------------------------------------------------

_MATRICES = ("K", "world_from_camera", "world_from_ego")


def collate_frames(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A batch of samples, for `DataLoader(collate_fn=collate_frames)`. Images and buffers of one
    size are stacked to [N, ...]; of unlike sizes they stay a list, as do masks of water and snow
    where a sample has none. camera: K [N, 3, 3], world_from_camera and world_from_ego [N, 4, 4] and
    int64 [N] tensors, name a list. weather: float64 [N] per number, NaN where a sample lacks it.
    Everything else, boxes above all, is a list with one entry a sample. Clips gain the same
    dimension in front: image [N, T, C, 3, H, W], K [N, T, C, 3, 3], frame [N, T]. Pairs become a
    dictionary of two batches. Raises ValueError: some samples have an image or buffer that others
    lack, masks excepted: datasets of unlike outputs or `load` are mixed.
    """
    first = samples[0]
    if "weathered" in first and "clean" in first:
        return {side: collate_frames([pair[side] for pair in samples]) for side in first}
    batch: dict[str, Any] = {key: [sample[key] for sample in samples] for key in first}
    masks = mask_names()
    for key in ("image", *buffer_names()):
        if key not in masks:  # only such weather has them
            _check_all_have(key, samples)
        batch[key] = stacked(batch[key])
    batch["camera"] = _cameras(batch["camera"])
    numbers = dict.fromkeys(name for sample in samples for name in sample["weather"])
    batch["weather"] = {
        name: torch.tensor(
            [sample["weather"].get(name, float("nan")) for sample in samples], dtype=torch.float64
        )
        for name in numbers
    }
    batch["frame"] = _whole(batch["frame"])
    return batch


def _check_all_have(key: str, samples: Sequence[Mapping[str, Any]]) -> None:
    lacking = [sample for sample in samples if sample[key] is None]
    if 0 < len(lacking) < len(samples):
        names = {f"{sample['scene']}/{sample['variant']}": None for sample in lacking}
        raise ValueError(
            f"{len(lacking)} of a batch's {len(samples)} samples have no {key}: of scene/variant "
            f"{', '.join(names)}. Leave {key!r} out of `load` in all datasets that are mixed, or "
            f"mix only outputs that have it"
        )


def stacked(values: Sequence[Any]) -> Any:
    """Tensors of one shape as one tensor, in memory that a worker process shares with its parent;
    None where there are only None; else the list.
    """
    tensors = [value for value in values if isinstance(value, torch.Tensor)]
    if len(tensors) < len(values):
        return None if all(value is None for value in values) else list(values)
    first = tensors[0]
    if len({tensor.shape for tensor in tensors}) > 1:
        return tensors
    if get_worker_info() is None:
        return torch.stack(tensors)
    # Else the queue to the parent would copy the batch once more, as torch's own collate knows.
    size = (len(tensors), *first.shape)
    storage = first._typed_storage()._new_shared(first.numel() * len(tensors), device=first.device)
    return torch.stack(tensors, out=first.new(storage).resize_(size))


def _cameras(cameras: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    values = {key: [camera[key] for camera in cameras] for key in cameras[0]}
    return {
        key: column if key == "name" else stacked(column) if key in _MATRICES else _whole(column)
        for key, column in values.items()
    }


def _whole(values: Sequence[Any]) -> Any:
    """Numbers as int64 [N]; tensors stacked."""
    return stacked(values) if isinstance(values[0], torch.Tensor) else torch.tensor(values)


# ---- samples -------------------------------------------------------------------------------------

_WORLD = np.eye(4)
ImageType = Literal["float32", "uint8"]


def buffer_names() -> tuple[str, ...]:
    """Images beside the picture: depth, semantic, instance, and the effects' masks."""
    return ("depth", "semantic", "instance", *mask_names())


def loadable() -> tuple[str, ...]:
    """What samples can hold, by the names of `load`."""
    return ("image", *buffer_names(), "boxes", "lidar")


@dataclass(frozen=True)
class SampleOptions:
    """What samples hold and how. load: of `loadable`. box_frame: of boxes and LiDAR points."""

    image_type: ImageType
    load: frozenset[str]
    box_frame: BoxFrame

    @staticmethod
    def checked(
        image_type: str = "float32", load: Collection[str] | None = None, box_frame: str = "world"
    ) -> SampleOptions:
        """The options of these values. load: None for all but sweeps, which are large, and few
        train on both. Raises ValueError: a value that there is not.
        """
        if load is None:
            load = set(loadable()) - {"lidar"}
        if image_type not in ("float32", "uint8"):
            raise ValueError(f"image_type must be 'float32' or 'uint8'; got {image_type!r}")
        if box_frame not in BOX_FRAMES:
            raise ValueError(f"box_frame must be one of {', '.join(BOX_FRAMES)}; got {box_frame!r}")
        # A single name is no collection of names, though its letters are one.
        if isinstance(load, str) or not set(load) <= set(loadable()):
            raise ValueError(f"load must be some of {', '.join(loadable())}; got {load!r}")
        return SampleOptions(image_type, frozenset(load), box_frame)


@dataclass(frozen=True, eq=False)
class Pixels:
    """Decoded images of one view. rgb: uint8 [H, W, 3]. depth: uint16 [H, W], steps of 1/256 m.
    semantic: uint8 [H, W]. instance: uint16 [H, W]. masks: uint8 [H, W], 0 or 255, by name.
    """

    rgb: np.ndarray | None = None
    depth: np.ndarray | None = None
    semantic: np.ndarray | None = None
    instance: np.ndarray | None = None
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Labels:
    """What a frame has beside its images, in the dataset's world. box_weather: for the boxes.
    instances: uint16 [B], their numbers.
    """

    boxes: Boxes | None = None
    box_weather: BoxWeather | None = None
    lidar: LidarSweep | None = None
    instances: np.ndarray | None = None


def make_sample(
    *,
    options: SampleOptions,
    pixels: Pixels,
    camera: CameraRecord,
    world_from_ego: torch.Tensor,
    labels: Labels,
    weather: Mapping[str, float],
    paths: Mapping[str, str | None],
    names: Mapping[str, Any],
) -> dict[str, Any]:
    """One sample as the module describes it. names: scene, variant, frame, recipe_hash, surface."""
    depth, semantic, instance = pixels.depth, pixels.semantic, pixels.instance
    masks = {name: pixels.masks.get(name) for name in mask_names()}
    origins = {"ego": world_from_ego.numpy(), "camera": camera.world_from_camera.numpy()}
    placed = (options.box_frame, origins.get(options.box_frame, _WORLD))
    boxes, lidar = labels.boxes, labels.lidar
    return {
        "image": None if pixels.rgb is None else image_tensor(pixels.rgb, options.image_type),
        "depth": None if depth is None else torch.from_numpy(depth_in_metres(depth)),
        "semantic": None if semantic is None else torch.from_numpy(semantic),
        "instance": None if instance is None else torch.from_numpy(instance.astype(np.int32)),
        **{n: None if mask is None else torch.from_numpy(mask == 255) for n, mask in masks.items()},
        "boxes": None
        if boxes is None
        else box_tensors(boxes, labels.box_weather or {}, *placed, instances=labels.instances),
        "lidar": None if lidar is None else lidar_tensors(lidar, *placed),
        "camera": {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "timestamp_ns": camera.timestamp_ns,
            "K": camera.K,
            "world_from_camera": camera.world_from_camera,
            "world_from_ego": world_from_ego,
        },
        "weather": dict(weather),
        "paths": dict(paths),
        **names,
    }


def image_tensor(rgb: np.ndarray, image_type: ImageType) -> torch.Tensor:
    """uint8 [H, W, 3] as [3, H, W] of the type."""
    planes: Any = np.empty((3, *rgb.shape[:2]), np.uint8)
    cv2.split(rgb, list(planes))  # a third of the time of NumPy's transposed copy
    image = torch.from_numpy(planes)
    if image_type == "uint8":
        return image
    # In place: half of the time goes into touching new memory. An integer tensor / 255 takes six
    # times as long as this.
    return image.float().div_(255)


def lidar_tensors(
    sweep: LidarSweep, frame: BoxFrame, world_from_frame: np.ndarray
) -> dict[str, Any]:
    """points_m: float64 [N, 3] in the frame of the boxes. The dataset's further columns under their
    names (intensity, timestamp_ns, weather_code, ...) as tensors of their own types; text stays a
    NumPy array.
    """
    points_m = sweep.points_m
    if frame != "world":
        points_m = moved_points(points_m, world_from_frame)
    rest = {name: column for name, column in sweep.columns.items() if name not in "xyz"}
    return {
        "points_m": torch.from_numpy(points_m),
        **{n: torch.from_numpy(c) if c.dtype.kind in "biuf" else c for n, c in rest.items()},
    }


# ---- Samples in the shape that torchvision's detectors and transforms (v2) take ------------------

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
    buffers = (key for key in buffer_names() if sample[key] is not None)
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
