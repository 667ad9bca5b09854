"""Label files of an output for trainers, COCO, KITTI and YOLO, in `labels/` of the output.

    labels/index.csv                              image of each number
    labels/coco/instances_train.json              images by their path in the output
    labels/kitti/training/{image_2,label_2,calib}/000000.*, ImageSets/train.txt
    labels/yolo/{data.yaml, images/train/000000.png, labels/train/000000.txt}

In: the manifest, the label tables and the recipes of an output. Out: the files above, by
`write_labels`, whole or not at all. Images are the output's own under a second name, or copies
where links cannot be had.

Objects that at least one pixel shows are labelled. Pixels count from the image's upper left corner:
the first one's centre is at 0.5.
"""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
import torch
from pydantic import BaseModel, NonNegativeInt

from augment.dataset.clips_pairs import split_by_scene
from augment.dataset.samples import points_in_frame
from augment.dataset.weather_dataset import RowReader
from augment.errors import OutputError
from augment.output.atomic import (
    copy_file,
    link_file,
    path_below,
    raise_output_error,
    read_file,
    write_folder_atomically,
)
from augment.output.box_tables import BOXES_2D, MASK_SIDES, MASKS, SIDES
from augment.output.box_weather import box_tables, combine_visibility
from augment.output.calibration import CameraRecord
from augment.output.claims import hold_claim
from augment.output.manifest import OK, read_manifest_rows
from augment.output.names import MANIFEST_FILE, folder_name, resolve_inside
from augment.output.store import open_store
from augment.output.tables import read_boxes
from augment.scene.boxes import are_usable
from augment.scene.geometry import invert_rigid, rotmat_from_quat
from augment.scene.scene import Scene
from recipes.load import load_recipe, read_overrides
from recipes.schema import Category, LabelFormat, Output

LABELS = "labels"  # folder of the labels, inside the output
RECORD = "labels.json"  # file that says how the labels were written, inside LABELS
INDEX = "index.csv"  # file that lists the image of every number, inside LABELS
FORMATS: tuple[LabelFormat, ...] = ("coco", "kitti", "yolo")
WHOLE = {"train": 1.0}  # the only part where nothing is said
FILES: dict[LabelFormat, tuple[str, ...]] = {
    "coco": ("coco/instances_train.json",),
    "kitti": ("kitti/training/{image_2,label_2,calib}/*", "kitti/ImageSets/train.txt"),
    "yolo": ("yolo/data.yaml", "yolo/{images,labels}/train/*"),
}
# KITTI's states of occlusion, by the fraction of an object that no nearer object hides.
FULLY = 0  # state of an object whose visible fraction is FULLY_VISIBLE or more
PARTLY = 1  # state of an object whose visible fraction is PARTLY_VISIBLE or more
LARGELY = 2  # state of an object whose visible fraction is less than PARTLY_VISIBLE
UNKNOWN = 3  # state of an object whose visible fraction is not known
FULLY_VISIBLE = 0.9  # smallest visible fraction of a FULLY visible object, 0 to 1
PARTLY_VISIBLE = 0.5  # smallest visible fraction of a PARTLY visible object, 0 to 1
DONT_CARE = "DontCare"  # KITTI's type of an object that counts neither as a hit nor as a miss


class NothingLabelled(OutputError):
    """No image of the output has what labels are written from."""


class LabelOptions(BaseModel, frozen=True, extra="forbid"):
    """Options of `write_labels`."""

    split: dict[str, float] = WHOLE
    """Shares of the scenes by part (`split_by_scene`)."""
    seed: int = 0
    """Seed of the split."""
    changes: tuple[str, ...] = ()
    """Changes of the recipes' fields, written as for `--set`."""


class LabelsRecord(BaseModel, frozen=True, extra="forbid"):
    """Content of the file RECORD of an output."""

    asked: LabelOptions
    """Options of the labels."""
    categories: tuple[str, ...]
    """Names of the categories, in the order of their numbers."""
    images: dict[LabelFormat, NonNegativeInt]
    """Number of images by format."""
    objects: dict[LabelFormat, NonNegativeInt]
    """Number of objects by format."""
    hidden: dict[LabelFormat, NonNegativeInt]
    """Number of objects that the weather hides, by format."""
    unmapped: dict[str, NonNegativeInt]
    """Number of boxes by label, for labels without a category."""


@dataclass(frozen=True)
class LabelsResult:
    """Labels that one call of `write_labels` has written."""

    folder: Path
    """Folder of the labels."""
    images: Mapping[str, int]
    """Number of images by format."""
    objects: Mapping[str, int]
    """Number of objects by format."""
    num_hidden: Mapping[str, int]
    """Number of objects that the weather hides by format, whether they are marked or left out."""
    parts: Mapping[str, int]
    """Number of images by part."""
    unmapped: Mapping[str, int]
    """Number of boxes by label, for labels without a category ("" where the dataset gives no
    label)."""
    unused_rows: tuple[str, ...]
    """Rows of category tables that match no label."""
    without_numbers: int = 0
    """Number of kitti objects that are DontCare because a number of their 3D box is not usable."""


def write_labels(out: Path | str, options: LabelOptions | None = None) -> LabelsResult:
    """Write the labels of an output on this machine; they replace the labels that it has.

    Args:
        out: folder of the output.
        options: options; None takes those of the last call, or the recipes' if there was none.

    Raises:
        NothingLabelled: no variant has both masks and a recipe that asks for a format.
        OutputError: no label has a category, or a file of the output is damaged.
        RecipeError: a change is not valid.
        ValueError: the shares of a split do not add up to 1, or the name of a part is no file name.
    """
    out = Path(out).absolute()
    folder = path_below(out, (LABELS,))
    store = open_store(out)
    request = options or _last_request(folder)
    if wrong := [part for part in request.split if folder_name(part) != part]:
        raise ValueError(f"parts are names of files: letters, digits, -, _ and .; got {wrong[0]!r}")
    with hold_claim(store, LABELS):
        table = read_manifest_rows(store)
        parts = split_by_scene(table, request.split, request.seed)
        of_scene = {
            s: part
            for part, part_table in parts.items()
            for s in part_table["scene"].unique().tolist()
        }
        rows = [row for row in table.to_pylist() if row["status"] == OK]
        if any(folder_name(row["scene"]) == LABELS for row in rows):
            raise OutputError(
                f"{out} has images of a scene called {LABELS!r}, whose folder the labels would "
                f"take: render it under another name into another output"
            )
        policies = _policies(out, rows, request.changes)
        rows = [row for row in rows if (row["scene"], row["variant"]) in policies]
        if not rows:
            raise NothingLabelled(
                f"{out / MANIFEST_FILE}: no image has masks to write labels from; render a "
                f"scene that has boxes with output.labels: [{', '.join(FORMATS)}], or some of them"
            )
        names = _categories(out, rows, policies)
        run = _Writing(out, RowReader(store, verify=False), request, policies, names)
        with write_folder_atomically(folder, (*FORMATS, INDEX, RECORD)) as new:
            return replace(run.go(new, rows, of_scene), folder=folder)


def _last_request(folder: Path) -> LabelOptions:
    """Return the options of the folder's labels; the defaults if they cannot be read."""
    try:
        return LabelOptions.model_validate(json.loads(read_file(folder / RECORD))["asked"])
    except (OSError, LookupError, TypeError, ValueError, RecursionError):
        return LabelOptions()


# ---- Categories of the labels --------------------------------------------------------------------

Variant = tuple[str, str]  # scene and name


def _policies(
    out: Path, rows: Sequence[Mapping[str, Any]], changes: Sequence[str]
) -> dict[Variant, Output]:
    """Return the section `output` of every variant that has masks and whose recipe asks for
    formats.
    """
    outputs: dict[Variant, Output | None] = {}
    for row in rows:
        key = row["scene"], row["variant"]
        if key in outputs or row["box_mask_path"] is None:
            continue
        image = resolve_inside(out, row["image_path"])
        recipe = load_recipe(image.parents[2] / "recipe.yaml", read_overrides(changes))
        output = recipe.resolve(0).output
        outputs[key] = output if output.label_formats else None
    return {key: output for key, output in outputs.items() if output is not None}


def category_of(label: str, table: Sequence[Category] | None) -> str | None:
    """Return the name of the first row that matches the label.

    None if no row does, or if the dataset gives no label ("").

    Args:
        label: label of an object.
        table: the recipe's categories; None makes every label its own category.
    """
    if not label:
        return None
    if table is None:
        return label
    return next((row.name for row in table if row.matches(label)), None)


def forecast_labels(scene: Scene, output: Output) -> dict[str, Any] | None:
    """Return a forecast of the labels that a job will write for a scene.

    None if the recipe asks for no format.

    Returns:
        files: paths of the files in the output. categories: by name, the numbers of boxes and of
            objects in the scene's frames (images get only the boxes that a pixel shows). unmapped:
            number of boxes by label, for labels without a category.
    """
    if not output.label_formats:
        return None
    box_counts = Counter[str]()
    unmapped_counts = Counter[str]()
    tracks: dict[str, set[str]] = {}
    for frame in scene.frames:
        frame_boxes = scene.boxes(frame.index)
        for label, track in zip(frame_boxes.labels, frame_boxes.track_ids, strict=True):
            if (name := category_of(label, output.categories)) is None:
                unmapped_counts[label] += 1
            else:
                box_counts[name] += 1
                tracks.setdefault(name, set()).add(track)
    return {
        "files": [f"{LABELS}/{name}" for kind in output.label_formats for name in FILES[kind]],
        "categories": {
            name: {"boxes": count, "objects": len(tracks[name])}
            for name, count in sorted(box_counts.items())
        },
        "unmapped": dict(sorted(unmapped_counts.items())),
        "min_visibility": output.min_visibility,
        "on_hidden": output.on_hidden,
    }


class _Categories(NamedTuple):
    """Categories of an output."""

    names: tuple[str, ...]
    """All names, in the order of their numbers."""
    unmapped: Mapping[str, int]
    """As in LabelsResult."""
    unused: tuple[str, ...]
    """As in LabelsResult."""


def _categories(
    out: Path, rows: Sequence[Mapping[str, Any]], policies: Mapping[Variant, Output]
) -> _Categories:
    """Return the tables' names in their order, then labels without a table, sorted."""
    labels: dict[Variant, Counter[str]] = {key: Counter() for key in policies}
    label_paths: dict[tuple[Variant, str], None] = dict.fromkeys(
        ((row["scene"], row["variant"]), row["labels_path"]) for row in rows
    )
    for key, path in label_paths:
        for frame in read_boxes(resolve_inside(out, path)).values():
            labels[key].update(frame.boxes.labels)
    table_names: dict[str, None] = {}
    free_labels = Counter[str]()
    label_counts = Counter[str]()
    unmapped = Counter[str]()
    for key, output in policies.items():
        label_counts.update(labels[key])
        if output.categories is None:
            free_labels.update(label for label in labels[key] if label)
        table_names |= dict.fromkeys(row.name for row in output.categories or ())
        unmapped.update(
            {
                label: count
                for label, count in labels[key].items()
                if category_of(label, output.categories) is None
            }
        )
    tables = (output.categories or () for output in policies.values())
    table_rows = dict.fromkeys(row for table in tables for row in table)
    unused = tuple(row.label for row in table_rows if not any(map(row.matches, label_counts)))
    if table_rows and label_counts and not free_labels and len(unused) == len(table_rows):
        raise OutputError(
            f"{out}: output.categories names {', '.join(unused[:5])}; no object has such a label. "
            f"The labels are {', '.join(sorted(label_counts))}"
        )
    category_names = (
        *table_names,
        *sorted(label for label in free_labels if label not in table_names),
    )
    return _Categories(category_names, dict(sorted(unmapped.items())), unused)


# ---- The objects of an image ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LabelledObject:
    """One object that an image shows."""

    category: str
    """Name of its category."""
    track_id: str
    """Its track."""
    instance: int
    """Its number in instance images."""
    is_hidden: bool
    """If True, the weather hides it, by the recipe's threshold."""
    amodal: np.ndarray
    """Left, top, right, bottom of its projected box inside the image, hidden or not; the same as
    `visible` if the box has no projection there."""
    visible: np.ndarray
    """Left, top, right, bottom of the pixels that show it."""
    pixels: int
    """Number of these pixels."""
    rle: str
    """These pixels as COCO's run lengths."""
    visibility: float
    """Fraction that the weather leaves visible; NaN if not known."""
    visible_fraction: float
    """Fraction that other objects leave visible; NaN if not known."""
    truncated_fraction: float
    """Fraction of the projected box outside the image."""
    is_estimated: bool
    """If True, the pixels follow from its 3D box (`box_estimates`)."""
    centre_m: np.ndarray
    """Centre of its 3D box, in the camera's frame."""
    size_m: np.ndarray
    """Length, width and height of its 3D box."""
    camera_from_box: np.ndarray
    """Rotation of its 3D box."""

    @property
    def has_numbers(self) -> bool:
        """Return True if position, size and heading of the 3D box are usable numbers."""
        numbers = np.concatenate([self.centre_m, self.size_m, self.camera_from_box[:, 0]])
        return bool(are_usable(numbers[None], self.size_m[None])[0])


def objects_of(
    reader: RowReader, row: Mapping[str, Any], camera: CameraRecord, output: Output
) -> list[LabelledObject]:
    """Return the objects of a category that a row's image shows, in the order of the labels."""
    key = row["frame"], row["camera"]
    frames = reader.read_parsed("labels", row["labels_path"], read_boxes)
    tables = {
        kind: reader.read_parsed(kind, row[f"{kind}_path"], table.read).get(key)
        for kind, table in box_tables().items()
        if row[f"{kind}_path"] is not None
    }
    if row["frame"] not in frames or None in tables.values():
        raise OutputError(
            f"{reader.store.uri}: the label tables of scene {row['scene']!r}, variant "
            f"{row['variant']!r} lack frame {row['frame']}, camera {row['camera']!r}; delete them "
            f"and run the job again, which makes them anew"
        )
    boxes = frames[row["frame"]].boxes
    weather: Any = tables
    masks = weather[MASKS.name]
    boxes_2d = weather[BOXES_2D.name]
    visibilities = combine_visibility(weather, len(boxes))
    world_from_camera = camera.world_from_camera.numpy()
    centres = points_in_frame(boxes.centers_m, world_from_camera)
    rotations = rotmat_from_quat(torch.from_numpy(boxes.quats)).numpy()
    objects = []
    for k, label in enumerate(boxes.labels):
        category = category_of(label, output.categories)
        if category is None or not masks["pixels"][k]:
            continue
        amodal = np.array([boxes_2d[side][k] for side in SIDES])
        visible = np.array([masks[side][k] for side in MASK_SIDES])
        objects.append(
            LabelledObject(
                category=category,
                track_id=boxes.track_ids[k],
                instance=int(boxes_2d["instance"][k]),
                is_hidden=bool(visibilities[k] < output.min_visibility),
                amodal=amodal if (amodal[2:] > amodal[:2]).all() else visible.astype(np.float64),
                visible=visible,
                pixels=int(masks["pixels"][k]),
                rle=masks["rle"][k],
                visibility=float(visibilities[k]),
                visible_fraction=float(boxes_2d["visible_fraction"][k]),
                truncated_fraction=float(boxes_2d["truncated_fraction"][k]),
                is_estimated=bool(boxes_2d["is_estimated"][k]),
                centre_m=centres[k],
                size_m=boxes.sizes_m[k],
                camera_from_box=world_from_camera[:3, :3].T @ rotations[k],
            )
        )
    return objects


# ---- The formats ---------------------------------------------------------------------------------


def coco_annotation(obj: LabelledObject, size: tuple[int, int]) -> dict[str, Any]:
    """Return a COCO annotation without its ids. size: width and height of the image. Keys that
    COCO does not have: bbox_amodal, occlusion, truncation, visibility, is_estimated (the box
    follows from the 3D box and not from pixels), track_id, instance. null means not known.
    """
    return {
        "bbox": _xywh(obj.visible),
        "area": obj.pixels,
        "segmentation": {"size": [size[1], size[0]], "counts": obj.rle},
        "iscrowd": int(obj.is_hidden),
        "bbox_amodal": _xywh(obj.amodal),
        "occlusion": _rounded(1 - obj.visible_fraction),
        "truncation": _rounded(obj.truncated_fraction),
        "visibility": _rounded(obj.visibility),
        "is_estimated": obj.is_estimated,
        "track_id": obj.track_id,
        "instance": obj.instance,
    }


def _xywh(sides: np.ndarray) -> list[float]:
    left, top, right, bottom = sides.tolist()
    return [round(float(n), 3) for n in (left, top, right - left, bottom - top)]


def _rounded(number: float) -> float | None:
    return None if math.isnan(number) else round(number, 4)


def yolo_line(obj: LabelledObject, category: int, size: tuple[int, int]) -> str:
    """Return the line `class cx cy w h` of the visible part, in widths and heights of the image."""
    left, top, right, bottom = obj.visible.tolist()
    width, height = size
    numbers = (left + right) / 2 / width, (top + bottom) / 2 / height
    numbers = (*numbers, (right - left) / width, (bottom - top) / height)
    return " ".join([str(category), *(f"{number:.6f}" for number in numbers)])


def kitti_line(obj: LabelledObject) -> str:
    """Return a line of label_2 (KITTI's object development kit, readme.txt).

    Columns: type, truncated, occluded, alpha, the amodal box in pixels, height, width, length, the
    middle of the box's bottom and the turn about the camera's y. Units are metres and radians; x is
    right, y down, z forward. The bottom is half a height below the centre along the camera's y, so
    that the centre is right even if the camera leans, which the format cannot express. A hidden
    object, or one whose box has no usable numbers, is DontCare.
    """
    sides = obj.amodal
    heading = obj.camera_from_box[:, 0]
    if obj.is_hidden or not obj.has_numbers:
        unknown = [-1.0, -1.0, -1.0, -1000.0, -1000.0, -1000.0, -10.0]
        return _kitti_text(DONT_CARE, -1.0, -1, [-10.0, *sides, *unknown])
    length, width, height = obj.size_m
    x, y, z = obj.centre_m
    rotation_y = math.atan2(-heading[2], heading[0])
    alpha = math.remainder(rotation_y - math.atan2(x, z), math.tau)
    truncated = min(max(obj.truncated_fraction, 0.0), 1.0)
    numbers = [alpha, *sides, height, width, length, x, y + height / 2, z, rotation_y]
    return _kitti_text("_".join(obj.category.split()), truncated, _occluded(obj), numbers)


def _occluded(obj: LabelledObject) -> int:
    visible_fraction = obj.visible_fraction
    if math.isnan(visible_fraction):
        return UNKNOWN
    return (
        FULLY
        if visible_fraction >= FULLY_VISIBLE
        else PARTLY
        if visible_fraction >= PARTLY_VISIBLE
        else LARGELY
    )


def _kitti_text(kind: str, truncated: float, occluded: int, numbers: Sequence[float]) -> str:
    texts = [f"{number:.4f}" for number in numbers]
    return " ".join([kind, f"{truncated:.2f}", str(occluded), *texts])


def kitti_calibration(camera: CameraRecord, world_from_ego: torch.Tensor) -> str:
    """Return the text of a file of calib. P0 to P3 are this camera's projection, and its frame is
    the rectified one. The ego frame (x forward, y left, z up) stands for the LiDAR's and the IMU's.
    """
    if camera.lens is not None or camera.shutter is not None:
        raise OutputError(
            f"camera {camera.name!r} has a lens or a rolling shutter, which KITTI's calib cannot "
            f"hold; write coco or yolo, or render without lens=recorded in the scene's URI"
        )
    projection = np.concatenate([camera.K.numpy(), np.zeros((3, 1))], axis=1)
    camera_from_ego = (invert_rigid(camera.world_from_camera) @ world_from_ego).numpy()[:3]
    matrices = {
        **{f"P{number}": projection for number in range(4)},
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": camera_from_ego,
        "Tr_imu_to_velo": np.eye(3, 4),
    }
    lines = (f"{n}: {' '.join(f'{v:.12e}' for v in m.ravel())}\n" for n, m in matrices.items())
    return "".join(lines)


# ---- The files -----------------------------------------------------------------------------------


@dataclass(eq=False)
class _Writing:
    """One call of write_labels. counts: numbers of images, objects and hidden objects, by kind and
    format. without_numbers: as in LabelsResult.
    """

    out: Path
    reader: RowReader
    request: LabelOptions
    policies: Mapping[Variant, Output]
    categories: _Categories
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    parts: Counter[str] = field(default_factory=Counter)
    without_numbers: int = 0

    def go(
        self, new: Path, rows: Sequence[Mapping[str, Any]], of_scene: Mapping[str, str]
    ) -> LabelsResult:
        formats = {f for output in self.policies.values() for f in output.label_formats}
        self.parts.update(dict.fromkeys(self.request.split, 0))
        with raise_output_error(new):
            self._make_folders(new, formats)
            coco = _CocoFiles(new / "coco", self.request.split, self.categories.names, formats)
            sets = {part: list[str]() for part in self.request.split}
            with (new / INDEX).open("w", newline="") as file, coco:
                index = csv.writer(file)
                index.writerow(("number", "part", "scene", "variant", "frame", "camera", "image"))
                for number, row in enumerate(rows):
                    part = of_scene[row["scene"]]
                    image = row["image_path"]
                    keys = ("scene", "variant", "frame", "camera")
                    index.writerow((number, part, *(row[key] for key in keys), image))
                    self.parts[part] += 1
                    if "kitti" in self._write_image(new, number, part, row, coco):
                        sets[part].append(f"{number:06d}\n")
            self._write_lists(new, formats, sets)
        return LabelsResult(
            folder=new,
            images=self._counts("images", formats),
            objects=self._counts("objects", formats),
            num_hidden=self._counts("hidden", formats),
            parts=dict(self.parts),
            unmapped=self.categories.unmapped,
            unused_rows=self.categories.unused,
            without_numbers=self.without_numbers,
        )

    def _counts(self, kind: str, formats: set[str]) -> dict[Any, int]:
        """Return the number of images, objects or hidden objects by format."""
        return {name: self.counts[kind, name] for name in sorted(formats)}

    def _make_folders(self, new: Path, formats: set[str]) -> None:
        parts = [
            f"yolo/{kind}/{part}" for kind in ("images", "labels") for part in self.request.split
        ]
        kitti = [f"kitti/training/{name}" for name in ("image_2", "label_2", "calib")]
        for name in ("coco", *kitti, "kitti/ImageSets", *parts):
            if name.split("/")[0] in formats:
                (new / name).mkdir(parents=True)

    def _write_image(
        self, new: Path, number: int, part: str, row: Mapping[str, Any], coco: _CocoFiles
    ) -> tuple[LabelFormat, ...]:
        output = self.policies[row["scene"], row["variant"]]
        camera, world_from_ego = self.reader.camera(row)
        objects = objects_of(self.reader, row, camera, output)
        size = (row["width"], row["height"])
        is_marking = output.on_hidden == "mark"
        labelled_objects = [obj for obj in objects if is_marking or not obj.is_hidden]
        image = resolve_inside(self.out, row["image_path"])
        numbers = {name: k for k, name in enumerate(self.categories.names)}
        for kind in output.label_formats:
            format_objects = (
                [obj for obj in labelled_objects if not obj.is_hidden]
                if kind == "yolo"
                else labelled_objects
            )
            self.counts["images", kind] += 1
            self.counts["objects", kind] += len(format_objects)
            self.counts["hidden", kind] += sum(obj.is_hidden for obj in objects)
            if kind == "coco":
                coco.add(
                    number, part, row, [(numbers[obj.category], obj) for obj in format_objects]
                )
            elif kind == "kitti":
                self.without_numbers += sum(not obj.has_numbers for obj in format_objects)
                top = new / "kitti/training"
                name = f"{number:06d}"
                _put_image(image, top / "image_2" / f"{name}{image.suffix}")
                _put_lines(
                    top / "label_2" / f"{name}.txt", [kitti_line(obj) for obj in format_objects]
                )
                (top / "calib" / f"{name}.txt").write_text(
                    kitti_calibration(camera, world_from_ego)
                )
            else:
                top = new / "yolo"
                name = f"{part}/{number:06d}"
                _put_image(image, top / "images" / f"{name}{image.suffix}")
                lines = [yolo_line(obj, numbers[obj.category], size) for obj in format_objects]
                _put_lines(top / "labels" / f"{name}.txt", lines)
        return output.label_formats

    def _write_lists(self, new: Path, formats: set[str], sets: Mapping[str, Sequence[str]]) -> None:
        parts = list(self.request.split)
        if "kitti" in formats:
            for part, numbers in sets.items():
                (new / "kitti/ImageSets" / f"{part}.txt").write_text("".join(numbers))
        if "yolo" in formats:
            # Trainers require a part "val"; without one, "val" names the first part.
            by_part = {**{p: p for p in parts}, "val": "val" if "val" in parts else parts[0]}
            lines = [f"{part}: images/{image_part}" for part, image_part in by_part.items()]
            names = enumerate(self.categories.names)
            lines += ["names:", *(f"  {k}: {json.dumps(name)}" for k, name in names)]
            _put_lines(new / "yolo/data.yaml", lines)
        record = LabelsRecord(
            asked=self.request,
            categories=self.categories.names,
            unmapped=dict(self.categories.unmapped),
            images=self._counts("images", formats),
            objects=self._counts("objects", formats),
            hidden=self._counts("hidden", formats),
        )
        (new / RECORD).write_text(record.model_dump_json(indent=1) + "\n")


class _CocoFiles:
    """COCO's JSON file of every part. Annotations are written at once, images at the end."""

    def __init__(
        self, folder: Path, parts: Mapping[str, float], names: Sequence[str], formats: set[str]
    ) -> None:
        coco_parts = parts if "coco" in formats else ()
        self._paths = {part: folder / f"instances_{part}.json" for part in coco_parts}
        self._categories = [{"id": k, "name": name} for k, name in enumerate(names, start=1)]
        self._files: dict[str, TextIO] = {}
        self._images: dict[str, list[str]] = {part: [] for part in coco_parts}
        self._count: Counter[str] = Counter()

    def __enter__(self) -> None:
        head = json.dumps({"info": {}, "licenses": [], "categories": self._categories})
        for part, path in self._paths.items():
            self._files[part] = path.open("w")
            self._files[part].write(head[:-1] + ', "annotations": [')

    def __exit__(self, *_: object) -> None:
        for part, file in self._files.items():
            file.write('\n],\n"images": [\n' + ",\n".join(self._images[part]) + "\n]}\n")
            file.close()

    def add(
        self,
        number: int,
        part: str,
        row: Mapping[str, Any],
        objects: Sequence[tuple[int, LabelledObject]],
    ) -> None:
        size = row["width"], row["height"]
        keys = ("width", "height", "scene", "variant", "frame", "camera", "timestamp_ns")
        image = {"id": number, "file_name": row["image_path"], **{key: row[key] for key in keys}}
        self._images[part].append(json.dumps(image))
        for category, obj in objects:
            comma = "," if self._count[part] else ""
            self._count[part] += 1
            ids = {"id": self._count[part], "image_id": number, "category_id": category + 1}
            text = json.dumps({**ids, **coco_annotation(obj, size)})
            self._files[part].write(f"{comma}\n{text}")


def _put_lines(path: Path, lines: Sequence[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines))


def _put_image(image: Path, target: Path) -> None:
    if not link_file(str(image), str(target)):
        copy_file(str(image), str(target))
