"""An output's labels as trainers read them: COCO, KITTI and YOLO, in `labels/` of the output.

    labels/index.csv                              which image each number is
    labels/coco/instances_train.json              images by their path in the output
    labels/kitti/training/{image_2,label_2,calib}/000000.*, ImageSets/train.txt
    labels/yolo/{data.yaml, images/train/000000.png, labels/train/000000.txt}

They follow from the manifest, the label tables and the recipes alone, and are written whole or not
at all. Images are the output's own under a second name, or copies where links cannot be had.

Labelled are the objects that at least one pixel shows. Pixels count from the image's upper left
corner: the first one's centre is at 0.5.
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

from augment.boxes import are_usable
from augment.dataset.clips_pairs import split_by_scene
from augment.dataset.samples import moved_points
from augment.dataset.weather_dataset import RowReader
from augment.errors import OutputError
from augment.geometry import invert_rigid, rotmat_from_quat
from augment.jobs.atomic import (
    copy_file,
    link_file,
    path_below,
    read_file,
    refusals_of,
    replaced_folder,
)
from augment.jobs.box_tables import BOXES_2D, MASK_SIDES, MASKS, SIDES
from augment.jobs.claims import hold
from augment.jobs.files import CameraRecord, box_tables, visibility
from augment.jobs.layout import folder_name, resolve_inside
from augment.jobs.manifest import MANIFEST, OK, read_finished
from augment.jobs.store import open_store
from augment.jobs.tables import read_boxes
from augment.scene import Scene
from recipes.load import load_recipe, read_overrides
from recipes.schema import Category, LabelFormat, Output

LABELS = "labels"  # the folder
RECORD, INDEX = "labels.json", "index.csv"
FORMATS: tuple[LabelFormat, ...] = ("coco", "kitti", "yolo")
WHOLE = {"train": 1.0}  # the only part where nothing is said
FILES: dict[LabelFormat, tuple[str, ...]] = {
    "coco": ("coco/instances_train.json",),
    "kitti": ("kitti/training/{image_2,label_2,calib}/*", "kitti/ImageSets/train.txt"),
    "yolo": ("yolo/data.yaml", "yolo/{images,labels}/train/*"),
}
# KITTI's states of occlusion, by how much of an object nothing before it hides.
FULLY, PARTLY, LARGELY, UNKNOWN = 0, 1, 2, 3
FULLY_VISIBLE, PARTLY_VISIBLE = 0.9, 0.5
DONT_CARE = "DontCare"


class NothingLabelled(OutputError):
    """No image of the output has what labels are written from."""


class LabelsAsked(BaseModel, frozen=True, extra="forbid"):
    """How labels are written. split: shares of the scenes by part (`split_by_scene`). changes: of
    the recipes' fields, as of `--set`.
    """

    split: dict[str, float] = WHOLE
    seed: int = 0
    changes: tuple[str, ...] = ()


class LabelsRecord(BaseModel, frozen=True, extra="forbid"):
    """What RECORD says of labels that are written; see LabelsAsked and LabelsWritten."""

    asked: LabelsAsked
    categories: tuple[str, ...]
    images: dict[LabelFormat, NonNegativeInt]
    objects: dict[LabelFormat, NonNegativeInt]
    hidden: dict[LabelFormat, NonNegativeInt]
    unmapped: dict[str, NonNegativeInt]


@dataclass(frozen=True)
class LabelsWritten:
    """images, objects, hidden: how many, by format; hidden are objects that the weather hides,
    marked or left out. parts: images by part. unmapped: labels of no category ("": the dataset has
    none), and how many boxes. unused: rows of category tables that no label is of. without_numbers:
    objects of kitti whose 3D box has numbers that no box can have: DontCare there.
    """

    folder: Path
    images: Mapping[str, int]
    objects: Mapping[str, int]
    hidden: Mapping[str, int]
    parts: Mapping[str, int]
    unmapped: Mapping[str, int]
    unused: tuple[str, ...]
    without_numbers: int = 0


def write_labels(out: Path | str, asked: LabelsAsked | None = None) -> LabelsWritten:
    """Write the labels of an output on this machine, in place of those that are there. asked: None
    for as the last time, or as the recipes say. Raises NothingLabelled: no variant asks for any
    format, or has masks. OutputError: no label is of any category, or a file of the output is
    damaged. RecipeError: a change is none. ValueError: a split whose shares do not add up to 1, or
    a part that is no name.
    """
    out = Path(out).absolute()
    folder, store = path_below(out, (LABELS,)), open_store(out)
    asked = asked or _asked_before(folder)
    if wrong := [part for part in asked.split if folder_name(part) != part]:
        raise ValueError(f"parts are names of files: letters, digits, -, _ and .; got {wrong[0]!r}")
    with hold(store, LABELS):
        table = read_finished(store)
        parts = split_by_scene(table, asked.split, asked.seed)
        of_scene = {s: part for part, own in parts.items() for s in own["scene"].unique().tolist()}
        rows = [row for row in table.to_pylist() if row["status"] == OK]
        if any(folder_name(row["scene"]) == LABELS for row in rows):
            raise OutputError(
                f"{out} has images of a scene called {LABELS!r}, whose folder the labels would "
                f"take: render it under another name into another output"
            )
        policies = _policies(out, rows, asked.changes)
        rows = [row for row in rows if (row["scene"], row["variant"]) in policies]
        if not rows:
            raise NothingLabelled(
                f"{out / MANIFEST}: no image has masks to write labels from; render a scene that "
                f"has boxes with output.labels: [{', '.join(FORMATS)}], or some of them"
            )
        names = _categories(out, rows, policies)
        run = _Writing(out, RowReader(store, verify=False), asked, policies, names)
        with replaced_folder(folder, (*FORMATS, INDEX, RECORD)) as new:
            return replace(run.go(new, rows, of_scene), folder=folder)


def _asked_before(folder: Path) -> LabelsAsked:
    try:
        return LabelsAsked.model_validate(json.loads(read_file(folder / RECORD))["asked"])
    except (OSError, LookupError, TypeError, ValueError, RecursionError):
        return LabelsAsked()


# ---- Which categories the labels are of ----------------------------------------------------------

Variant = tuple[str, str]  # scene and name


def _policies(
    out: Path, rows: Sequence[Mapping[str, Any]], changes: Sequence[str]
) -> dict[Variant, Output]:
    """What the recipes of those variants say that ask for formats and have masks."""
    found: dict[Variant, Output | None] = {}
    for row in rows:
        key = row["scene"], row["variant"]
        if key in found or row["box_mask_path"] is None:
            continue
        image = resolve_inside(out, row["image_path"])
        recipe = load_recipe(image.parents[2] / "recipe.yaml", read_overrides(changes))
        output = recipe.resolve(0).output
        found[key] = output if output.label_formats else None
    return {key: output for key, output in found.items() if output is not None}


def category_of(label: str, table: Sequence[Category] | None) -> str | None:
    """The name of the first row that takes the label; None of no row, and where the dataset gives
    no label (""). table: None for the labels themselves.
    """
    if not label:
        return None
    if table is None:
        return label
    return next((row.name for row in table if row.takes(label)), None)


def planned_labels(scene: Scene, output: Output) -> dict[str, Any] | None:
    """What a job will write of a scene for trainers; None where the recipe asks for no format.
    files: in LABELS of the output. categories: how many boxes in the scene's frames, and of how
    many objects, by name, of which images get those that a pixel of them shows. unmapped: boxes by
    labels of no category.
    """
    if not output.label_formats:
        return None
    boxes, unmapped = Counter[str](), Counter[str]()
    tracks: dict[str, set[str]] = {}
    for frame in scene.frames:
        own = scene.boxes(frame.index)
        for label, track in zip(own.labels, own.track_ids, strict=True):
            if (name := category_of(label, output.categories)) is None:
                unmapped[label] += 1
            else:
                boxes[name] += 1
                tracks.setdefault(name, set()).add(track)
    return {
        "files": [f"{LABELS}/{name}" for kind in output.label_formats for name in FILES[kind]],
        "categories": {
            name: {"boxes": count, "objects": len(tracks[name])}
            for name, count in sorted(boxes.items())
        },
        "unmapped": dict(sorted(unmapped.items())),
        "min_visibility": output.min_visibility,
        "on_hidden": output.on_hidden,
    }


class _Categories(NamedTuple):
    """names: all, in the order of their numbers. Others as of LabelsWritten."""

    names: tuple[str, ...]
    unmapped: Mapping[str, int]
    unused: tuple[str, ...]


def _categories(
    out: Path, rows: Sequence[Mapping[str, Any]], policies: Mapping[Variant, Output]
) -> _Categories:
    """The tables' names in their order; then labels without a table, sorted."""
    labels: dict[Variant, Counter[str]] = {key: Counter() for key in policies}
    read: dict[tuple[Variant, str], None] = dict.fromkeys(
        ((row["scene"], row["variant"]), row["labels_path"]) for row in rows
    )
    for key, path in read:
        for frame in read_boxes(resolve_inside(out, path)).values():
            labels[key].update(frame.boxes.labels)
    names: dict[str, None] = {}
    own, known, unmapped = Counter[str](), Counter[str](), Counter[str]()
    for key, output in policies.items():
        known.update(labels[key])
        if output.categories is None:
            own.update(label for label in labels[key] if label)
        names |= dict.fromkeys(row.name for row in output.categories or ())
        unmapped.update({
            label: count
            for label, count in labels[key].items()
            if category_of(label, output.categories) is None
        })  # fmt: skip
    tables = (output.categories or () for output in policies.values())
    written = dict.fromkeys(row for table in tables for row in table)
    unused = tuple(row.label for row in written if not any(map(row.takes, known)))
    if written and known and not own and len(unused) == len(written):
        raise OutputError(
            f"{out}: output.categories names {', '.join(unused[:5])}; no object has such a label. "
            f"The labels are {', '.join(sorted(known))}"
        )
    ordered = (*names, *sorted(label for label in own if label not in names))
    return _Categories(ordered, dict(sorted(unmapped.items())), unused)


# ---- The objects of an image ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LabelledObject:
    """One object that an image shows. is_hidden: by the weather, as the recipe counts it. amodal:
    left, top, right, bottom of its projected box inside the image, hidden or not; of `visible`
    where the box has no projection there. visible: of the pixels that show it; rle: these as COCO's
    run lengths. visibility: what the weather leaves of it, visible_fraction: what other objects
    leave, NaN: not known. is_estimated: the pixels follow from its 3D box (`box_estimates`).
    centre_m, size_m (length, width, height), camera_from_box: of its box.
    """

    category: str
    track_id: str
    instance: int
    is_hidden: bool
    amodal: np.ndarray
    visible: np.ndarray
    pixels: int
    rle: str
    visibility: float
    visible_fraction: float
    truncated_fraction: float
    is_estimated: bool
    centre_m: np.ndarray
    size_m: np.ndarray
    camera_from_box: np.ndarray

    @property
    def has_numbers(self) -> bool:
        """Whether its 3D box can stand somewhere."""
        numbers = np.concatenate([self.centre_m, self.size_m, self.camera_from_box[:, 0]])
        return bool(are_usable(numbers[None], self.size_m[None])[0])


def objects_of(
    reader: RowReader, row: Mapping[str, Any], camera: CameraRecord, output: Output
) -> list[LabelledObject]:
    """The objects that a row's image shows, of the categories, in the labels' order."""
    key = row["frame"], row["camera"]
    frames = reader.parsed("labels", row["labels_path"], read_boxes)
    measured = {
        kind: reader.parsed(kind, row[f"{kind}_path"], table.read).get(key)
        for kind, table in box_tables().items()
        if row[f"{kind}_path"] is not None
    }
    if row["frame"] not in frames or None in measured.values():
        raise OutputError(
            f"{reader.store.uri}: the label tables of scene {row['scene']!r}, variant "
            f"{row['variant']!r} lack frame {row['frame']}, camera {row['camera']!r}; delete them "
            f"and run the job again, which makes them anew"
        )
    boxes = frames[row["frame"]].boxes
    weather: Any = measured
    masks, flat = weather[MASKS.name], weather[BOXES_2D.name]
    left = visibility(weather, len(boxes))
    world_from_camera = camera.world_from_camera.numpy()
    centres = moved_points(boxes.centers_m, world_from_camera)
    rotations = rotmat_from_quat(torch.from_numpy(boxes.quats)).numpy()
    found = []
    for k, label in enumerate(boxes.labels):
        category = category_of(label, output.categories)
        if category is None or not masks["pixels"][k]:
            continue
        amodal = np.array([flat[side][k] for side in SIDES])
        visible = np.array([masks[side][k] for side in MASK_SIDES])
        found.append(
            LabelledObject(
                category=category,
                track_id=boxes.track_ids[k],
                instance=int(flat["instance"][k]),
                is_hidden=bool(left[k] < output.min_visibility),
                amodal=amodal if (amodal[2:] > amodal[:2]).all() else visible.astype(np.float64),
                visible=visible,
                pixels=int(masks["pixels"][k]),
                rle=masks["rle"][k],
                visibility=float(left[k]),
                visible_fraction=float(flat["visible_fraction"][k]),
                truncated_fraction=float(flat["truncated_fraction"][k]),
                is_estimated=bool(flat["is_estimated"][k]),
                centre_m=centres[k],
                size_m=boxes.sizes_m[k],
                camera_from_box=world_from_camera[:3, :3].T @ rotations[k],
            )
        )
    return found


# ---- The formats ---------------------------------------------------------------------------------


def coco_annotation(it: LabelledObject, size: tuple[int, int]) -> dict[str, Any]:
    """An annotation without its numbers. size: of the image, width and height. Beside COCO's own
    keys: bbox_amodal, occlusion, truncation, visibility, is_estimated (the box by its 3D box, not
    by pixels), track_id, instance; null: not known.
    """
    return {
        "bbox": _xywh(it.visible),
        "area": it.pixels,
        "segmentation": {"size": [size[1], size[0]], "counts": it.rle},
        "iscrowd": int(it.is_hidden),
        "bbox_amodal": _xywh(it.amodal),
        "occlusion": _rounded(1 - it.visible_fraction),
        "truncation": _rounded(it.truncated_fraction),
        "visibility": _rounded(it.visibility),
        "is_estimated": it.is_estimated,
        "track_id": it.track_id,
        "instance": it.instance,
    }


def _xywh(sides: np.ndarray) -> list[float]:
    left, top, right, bottom = sides.tolist()
    return [round(float(n), 3) for n in (left, top, right - left, bottom - top)]


def _rounded(number: float) -> float | None:
    return None if math.isnan(number) else round(number, 4)


def yolo_line(it: LabelledObject, category: int, size: tuple[int, int]) -> str:
    """`class cx cy w h` of the visible part, in widths and heights of the image."""
    left, top, right, bottom = it.visible.tolist()
    width, height = size
    numbers = (left + right) / 2 / width, (top + bottom) / 2 / height
    numbers = (*numbers, (right - left) / width, (bottom - top) / height)
    return " ".join([str(category), *(f"{number:.6f}" for number in numbers)])


def kitti_line(it: LabelledObject) -> str:
    """A line of label_2 (KITTI's object development kit, readme.txt): type, truncated, occluded,
    alpha, the amodal box in pixels, height, width, length, the middle of the box's bottom and the
    turn about the camera's y, in metres and radians, x right, y down, z forward. The bottom is half
    a height below the centre along the camera's y, so the centre stays where it is also in a camera
    that leans, which the format cannot say. A hidden object, or one whose box has no numbers, is
    DontCare.
    """
    sides = it.amodal
    heading = it.camera_from_box[:, 0]
    if it.is_hidden or not it.has_numbers:
        unknown = [-1.0, -1.0, -1.0, -1000.0, -1000.0, -1000.0, -10.0]
        return _kitti_text(DONT_CARE, -1.0, -1, [-10.0, *sides, *unknown])
    length, width, height = it.size_m
    x, y, z = it.centre_m
    turn = math.atan2(-heading[2], heading[0])
    alpha = math.remainder(turn - math.atan2(x, z), math.tau)
    truncated = min(max(it.truncated_fraction, 0.0), 1.0)
    rest = [alpha, *sides, height, width, length, x, y + height / 2, z, turn]
    return _kitti_text("_".join(it.category.split()), truncated, _occluded(it), rest)


def _occluded(it: LabelledObject) -> int:
    left = it.visible_fraction
    if math.isnan(left):
        return UNKNOWN
    return FULLY if left >= FULLY_VISIBLE else PARTLY if left >= PARTLY_VISIBLE else LARGELY


def _kitti_text(kind: str, truncated: float, occluded: int, numbers: Sequence[float]) -> str:
    texts = [f"{number:.4f}" for number in numbers]
    return " ".join([kind, f"{truncated:.2f}", str(occluded), *texts])


def kitti_calibration(camera: CameraRecord, world_from_ego: torch.Tensor) -> str:
    """A file of calib: P0 to P3 are this camera's, whose frame is the rectified one; the ego frame
    (x forward, y left, z up) stands for the LiDAR's and the IMU's.
    """
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
    """One call of write_labels. counts: of images, objects and hidden ones, by kind and format.
    without_numbers: as of LabelsWritten.
    """

    out: Path
    reader: RowReader
    asked: LabelsAsked
    policies: Mapping[Variant, Output]
    categories: _Categories
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    parts: Counter[str] = field(default_factory=Counter)
    without_numbers: int = 0

    def go(
        self, new: Path, rows: Sequence[Mapping[str, Any]], of_scene: Mapping[str, str]
    ) -> LabelsWritten:
        asked = {f for output in self.policies.values() for f in output.label_formats}
        self.parts.update(dict.fromkeys(self.asked.split, 0))
        with refusals_of(new):
            self._make_folders(new, asked)
            coco = _CocoFiles(new / "coco", self.asked.split, self.categories.names, asked)
            sets = {part: list[str]() for part in self.asked.split}
            with (new / INDEX).open("w", newline="") as file, coco:
                index = csv.writer(file)
                index.writerow(("number", "part", "scene", "variant", "frame", "camera", "image"))
                for number, row in enumerate(rows):
                    part, image = of_scene[row["scene"]], row["image_path"]
                    keys = ("scene", "variant", "frame", "camera")
                    index.writerow((number, part, *(row[key] for key in keys), image))
                    self.parts[part] += 1
                    if "kitti" in self._write_image(new, number, part, row, coco):
                        sets[part].append(f"{number:06d}\n")
            self._write_lists(new, asked, sets)
        return LabelsWritten(
            folder=new,
            **self._counted(asked),
            parts=dict(self.parts),
            unmapped=self.categories.unmapped,
            unused=self.categories.unused,
            without_numbers=self.without_numbers,
        )

    def _counted(self, asked: set[str]) -> dict[str, Any]:
        kinds = ("images", "objects", "hidden")
        return {kind: {f: self.counts[kind, f] for f in sorted(asked)} for kind in kinds}

    def _make_folders(self, new: Path, asked: set[str]) -> None:
        parts = [
            f"yolo/{kind}/{part}" for kind in ("images", "labels") for part in self.asked.split
        ]
        kitti = [f"kitti/training/{name}" for name in ("image_2", "label_2", "calib")]
        for name in ("coco", *kitti, "kitti/ImageSets", *parts):
            if name.split("/")[0] in asked:
                (new / name).mkdir(parents=True)

    def _write_image(
        self, new: Path, number: int, part: str, row: Mapping[str, Any], coco: _CocoFiles
    ) -> tuple[LabelFormat, ...]:
        output = self.policies[row["scene"], row["variant"]]
        camera, world_from_ego = self.reader.camera(row)
        objects = objects_of(self.reader, row, camera, output)
        size, marks = (row["width"], row["height"]), output.on_hidden == "mark"
        shown = [it for it in objects if marks or not it.is_hidden]
        image = resolve_inside(self.out, row["image_path"])
        numbers = {name: k for k, name in enumerate(self.categories.names)}
        for kind in output.label_formats:
            listed = [it for it in shown if not it.is_hidden] if kind == "yolo" else shown
            self.counts["images", kind] += 1
            self.counts["objects", kind] += len(listed)
            self.counts["hidden", kind] += sum(it.is_hidden for it in objects)
            if kind == "coco":
                coco.add(number, part, row, [(numbers[it.category], it) for it in listed])
            elif kind == "kitti":
                self.without_numbers += sum(not it.has_numbers for it in listed)
                top, name = new / "kitti/training", f"{number:06d}"
                _put_image(image, top / "image_2" / f"{name}{image.suffix}")
                _put_lines(top / "label_2" / f"{name}.txt", [kitti_line(it) for it in listed])
                (top / "calib" / f"{name}.txt").write_text(
                    kitti_calibration(camera, world_from_ego)
                )
            else:
                top, name = new / "yolo", f"{part}/{number:06d}"
                _put_image(image, top / "images" / f"{name}{image.suffix}")
                lines = [yolo_line(it, numbers[it.category], size) for it in listed]
                _put_lines(top / "labels" / f"{name}.txt", lines)
        return output.label_formats

    def _write_lists(self, new: Path, asked: set[str], sets: Mapping[str, Sequence[str]]) -> None:
        parts = list(self.asked.split)
        if "kitti" in asked:
            for part, numbers in sets.items():
                (new / "kitti/ImageSets" / f"{part}.txt").write_text("".join(numbers))
        if "yolo" in asked:
            # Trainers want a val; without one it is what there is.
            by_part = {**{p: p for p in parts}, "val": "val" if "val" in parts else parts[0]}
            lines = [f"{part}: images/{own}" for part, own in by_part.items()]
            names = enumerate(self.categories.names)
            lines += ["names:", *(f"  {k}: {json.dumps(name)}" for k, name in names)]
            _put_lines(new / "yolo/data.yaml", lines)
        record = LabelsRecord(
            asked=self.asked,
            categories=self.categories.names,
            unmapped=dict(self.categories.unmapped),
            **self._counted(asked),
        )
        (new / RECORD).write_text(record.model_dump_json(indent=1) + "\n")


class _CocoFiles:
    """A JSON file a part, written as its images come: annotations at once, images at the end."""

    def __init__(
        self, folder: Path, parts: Mapping[str, float], names: Sequence[str], asked: set[str]
    ) -> None:
        wanted = parts if "coco" in asked else ()
        self._paths = {part: folder / f"instances_{part}.json" for part in wanted}
        self._categories = [{"id": k, "name": name} for k, name in enumerate(names, start=1)]
        self._files: dict[str, TextIO] = {}
        self._images: dict[str, list[str]] = {part: [] for part in wanted}
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
        for category, it in objects:
            comma = "," if self._count[part] else ""
            self._count[part] += 1
            ids = {"id": self._count[part], "image_id": number, "category_id": category + 1}
            text = json.dumps({**ids, **coco_annotation(it, size)})
            self._files[part].write(f"{comma}\n{text}")


def _put_lines(path: Path, lines: Sequence[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines))


def _put_image(image: Path, target: Path) -> None:
    if not link_file(str(image), str(target)):
        copy_file(str(image), str(target))
