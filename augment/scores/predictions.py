"""Predictions of a network for a variant of a suite, read and checked.

    P/fog-3/meta.json      {"variant": "fog-3", "probe": {...}, "image_ids": [...]}
    P/fog-3/results.json   COCO results, or nuScenes results
    P/fog-3/kitti/000000.txt
    P/fog-3/semantic/000000.png

In: one such folder. Out: `Predictions`. Images are named by their number in the suite
(`augment.scores.suite_facts`), in COCO results also by their path. Whatever does not fit the suite
is refused with its count and its first names.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import BaseModel, ConfigDict, ValidationError

from augment.errors import ScoreError
from augment.files.image_size import image_header
from augment.output.atomic import read_file
from augment.output.codecs import decode_png
from augment.scores.suite_facts import ImageKey, list_names
from augment.scores.truth import NUM_BOX_3D_COLUMNS

PredictionKind = Literal["coco", "kitti", "nuscenes", "semantic"]
# Names of the files and folders of a variant's predictions.
META_FILE = "meta.json"
RESULTS_FILE = "results.json"
KITTI_FOLDER = "kitti"
SEMANTIC_FOLDER = "semantic"
# KITTI's type of a region that does not count.
DONT_CARE = "DontCare"
# Number of columns of a line of KITTI's results.
NUM_KITTI_COLUMNS = 16
# Value of a pixel of which a network says nothing.
NO_CLASS = 255
# Number of first bytes of a file of results in which its first character is looked for.
_NUM_FIRST_BYTES = 1024


class Meta(BaseModel):
    """Content of `meta.json`."""

    model_config = ConfigDict(frozen=True)

    variant: str
    """Name of the variant that the network was shown."""
    probe: dict[str, str] = {}
    """Answer of `augment.scores.probe`."""
    image_ids: tuple[int | str, ...] | None = None
    """Images that the network was shown, for COCO results: images without a detection too."""


@dataclass(frozen=True, eq=False)
class ImageDetections:
    """Detections of one image."""

    categories: Int64[np.ndarray, " N"]
    """Category of each detection, an index of the suite's category names."""
    boxes: Float64[np.ndarray, "N 4"]
    """Left, top, right, bottom, pixels."""
    scores: Float64[np.ndarray, " N"]
    """Confidence of each detection."""
    boxes_3d: Float64[np.ndarray, "N 7"]
    """3D boxes, as of `ImageTruth`; NaN where the predictions have none."""

    def __len__(self) -> int:
        return len(self.categories)


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions for one variant."""

    folder: Path
    """Folder of the predictions."""
    kind: PredictionKind
    """Format of the predictions."""
    meta: Meta | None
    """Content of `meta.json`; None without one."""
    content_hash: str
    """SHA-256 of what is predicted, without `meta.json`."""
    detections: tuple[ImageDetections, ...] = ()
    """Detections by the image's number, of coco and kitti."""

    @property
    def is_empty(self) -> bool:
        """Return True for detections of which there are none in any image."""
        has_boxes = self.kind in ("coco", "kitti")
        return has_boxes and not any(len(image) for image in self.detections)

    def class_image(self, number: int, size: tuple[int, int]) -> np.ndarray:
        """Return the classes that are predicted for an image, uint8 [H, W].

        Args:
            number: The image's number.
            size: Width and height that the image must have, pixels. A file that states another size
                is not decoded: a few bytes may state a gigabyte.
        """
        path = self.folder / SEMANTIC_FOLDER / f"{number:06d}.png"
        try:
            data = read_file(path)
            header = image_header(data)
            if header is not None and header.size != size:
                raise ScoreError(
                    f"{self.folder}: image {number:06d}: expected {size[0]} x {size[1]} pixels; "
                    f"got {header.width} x {header.height}"
                )
            return decode_png(data, np.uint8)
        except (OSError, ValueError) as error:
            raise ScoreError(f"{path} is no 8-bit PNG of classes: {error}") from error


@dataclass(frozen=True, eq=False)
class ExpectedImages:
    """Images and categories that predictions may name."""

    images: tuple[ImageKey, ...]
    """Images of the suite."""
    paths: tuple[str, ...]
    """Path of each image of the variant."""
    categories: tuple[str, ...]
    """Names of the categories; none where nothing is detected."""


def read_predictions(folder: Path, kind: PredictionKind, expected: ExpectedImages) -> Predictions:
    """Return the predictions in a variant's folder.

    Args:
        folder: The folder.
        kind: Format of its predictions, by `find_kind`.
        expected: Images and categories that they may name.

    Raises:
        ScoreError: The predictions do not fit the suite.
    """
    meta = _read_meta(folder)
    if kind == "semantic":
        content_hash = _check_folder(folder / SEMANTIC_FOLDER, ".png", expected)
        return Predictions(folder, kind, meta, content_hash)
    if kind == "nuscenes":
        results = _read_json(folder / RESULTS_FILE)["results"]
        _check_nuscenes(folder / RESULTS_FILE, results)
        return Predictions(folder, kind, meta, _hash_json(results))
    if kind == "kitti":
        content_hash = _check_folder(folder / KITTI_FOLDER, ".txt", expected)
        detections = read_kitti(folder / KITTI_FOLDER, expected.categories, len(expected.images))
        return Predictions(folder, kind, meta, content_hash, detections)
    entries = _read_json(folder / RESULTS_FILE)
    detections = read_coco(folder / RESULTS_FILE, entries, meta, expected)
    return Predictions(folder, kind, meta, _hash_json(entries), detections)


def find_kind(folder: Path) -> PredictionKind:
    """Return the format of the predictions in a variant's folder.

    COCO's results are told by their first character: the list may be long, and is read later.

    Raises:
        ScoreError: There are none, or several.
    """
    kinds: list[PredictionKind] = []
    if (folder / RESULTS_FILE).is_file():
        kinds.append(_kind_of_results(folder / RESULTS_FILE))
    if (folder / KITTI_FOLDER).is_dir():
        kinds.append("kitti")
    if (folder / SEMANTIC_FOLDER).is_dir():
        kinds.append("semantic")
    if len(kinds) != 1:
        raise ScoreError(
            f"{folder} has {'no predictions' if not kinds else ' and '.join(kinds)}; expected one "
            f"of {RESULTS_FILE} (COCO or nuScenes), {KITTI_FOLDER}/000000.txt, "
            f"{SEMANTIC_FOLDER}/000000.png"
        )
    return kinds[0]


def _kind_of_results(path: Path) -> PredictionKind:
    """Return the format of a file of results."""
    with path.open("rb") as file:
        if file.read(_NUM_FIRST_BYTES).lstrip().startswith(b"["):
            return "coco"
    content = _read_json(path)
    if isinstance(content, list):
        return "coco"
    if isinstance(content, dict) and isinstance(content.get("results"), dict):
        return "nuscenes"
    raise ScoreError(
        f"{path} is neither COCO's results (a list of detections) nor nuScenes' (an object with "
        f"`results`)"
    )


def read_coco(
    path: Path, entries: list[Any], meta: Meta | None, expected: ExpectedImages
) -> tuple[ImageDetections, ...]:
    """Return the detections of COCO results, by the image's number.

    Raises:
        ScoreError: An image or a category is unknown, a number is not finite, a box has no area, or
            an image has no detection and `meta.json` does not name it.
    """
    numbers_by_id: dict[int | str, int] = dict(enumerate(range(len(expected.images))))
    numbers_by_id |= {image_path: k for k, image_path in enumerate(expected.paths)}
    rows: dict[int, list[list[float]]] = {}
    unknown_images: dict[object, None] = {}
    unknown_categories: dict[object, None] = {}
    wrong: list[str] = []
    for k, entry in enumerate(entries):
        try:
            image_id = entry["image_id"]
            category_id = entry["category_id"]
            left, top, width, height = (float(value) for value in entry["bbox"])
            score = float(entry["score"])
            is_finite = all(map(math.isfinite, (left, top, width, height, score)))
        except (LookupError, OverflowError, TypeError, ValueError) as error:
            raise ScoreError(
                f"{path}: entry {k} is no detection of COCO with image_id, category_id, bbox and "
                f"score: {error!r:.200}"
            ) from error
        if isinstance(image_id, bool) or not isinstance(image_id, int | str):
            unknown_images[repr(image_id)] = None
        elif image_id not in numbers_by_id:
            unknown_images[image_id] = None
        elif type(category_id) is not int or not 1 <= category_id <= len(expected.categories):
            unknown_categories[repr(category_id)] = None
        elif not is_finite or min(width, height) <= 0:
            wrong.append(f"entry {k}: bbox {entry['bbox']}, score {entry['score']}")
        else:
            row = [float(category_id - 1), left, top, left + width, top + height, score]
            rows.setdefault(numbers_by_id[image_id], []).append(row)
    refuse(path, "images that the suite does not have", unknown_images)
    names = ", ".join(f"{k} {name}" for k, name in enumerate(expected.categories, start=1))
    refuse(path, f"category_id that are not of the suite's ({names})", unknown_categories)
    refuse(path, "detections with numbers that are not finite, or without area", wrong)
    stated_ids = set(meta.image_ids or ()) if meta is not None else set()
    refuse(path.parent / META_FILE, "image_ids that the suite does not have",
           sorted(map(str, stated_ids - numbers_by_id.keys())))  # fmt: skip
    covered = {*rows, *(numbers_by_id[image_id] for image_id in stated_ids)}
    refuse(
        path,
        f"images without a detection that {META_FILE} does not name in image_ids (the images that "
        f"the network was shown)",
        [expected.paths[number] for number in range(len(expected.images)) if number not in covered],
    )
    return tuple(
        _detections(np.array(rows.get(number, []), np.float64).reshape(-1, 6))
        for number in range(len(expected.images))
    )


def _detections(rows: np.ndarray, boxes_3d: np.ndarray | None = None) -> ImageDetections:
    """Return the detections of rows [N, 6] of category, box and score."""
    if boxes_3d is None:
        boxes_3d = np.full((len(rows), NUM_BOX_3D_COLUMNS), np.nan)
    return ImageDetections(rows[:, 0].astype(np.int64), rows[:, 1:5], rows[:, 5], boxes_3d)


def read_kitti(
    folder: Path, categories: tuple[str, ...], num_images: int
) -> tuple[ImageDetections, ...]:
    """Return the detections of a folder of KITTI's result files, by the image's number.

    A line has type, truncated, occluded, alpha, left, top, right, bottom, height, width, length, x,
    y, z, rotation_y and score. Blanks in names of categories are written as `_`.

    Raises:
        ScoreError: A line has other columns, a number is not finite, or a type is unknown.
    """
    category_numbers = {"_".join(name.split()): k for k, name in enumerate(categories)}
    unknown_types: dict[str, None] = {}
    wrong: list[str] = []
    images = []
    for number in range(num_images):
        path = folder / f"{number:06d}.txt"
        rows: list[list[float]] = []
        boxes_3d: list[list[float]] = []
        for line_number, line in enumerate(
            read_file(path).decode("ascii", "replace").splitlines(), 1
        ):
            kind, *texts = line.split() or [DONT_CARE]
            if kind == DONT_CARE:
                continue
            try:
                values = [float(text) for text in texts]
            except ValueError:
                values = []
            if len(values) != NUM_KITTI_COLUMNS - 1 or not all(map(math.isfinite, values)):
                wrong.append(f"{path.name}, line {line_number}: {line[:80]}")
                continue
            left, top, right, bottom, height, width, length, x, y, z, turn, score = values[3:]
            if right <= left or bottom <= top:
                wrong.append(f"{path.name}, line {line_number}: {line[:80]}")
            elif kind not in category_numbers:
                unknown_types[kind] = None
            else:
                rows.append([category_numbers[kind], left, top, right, bottom, score])
                boxes_3d.append([x, y, z, height, width, length, turn])
        stacked = np.array(boxes_3d, np.float64).reshape(-1, NUM_BOX_3D_COLUMNS)
        images.append(_detections(np.array(rows, np.float64).reshape(-1, 6), stacked))
    refuse(
        folder, f"types that are not of the suite's ({', '.join(category_numbers)})", unknown_types
    )
    refuse(
        folder,
        f"lines that are not {NUM_KITTI_COLUMNS} columns of finite numbers with a box of some area",
        wrong,
    )
    return tuple(images)


def refuse(path: Path, problem: str, names: Iterable[object]) -> None:
    """Raise ScoreError with the count of names and the first of them, if there are any."""
    listed_names = list(names)
    if listed_names:
        raise ScoreError(f"{path}: {problem}: {list_names(listed_names)}")


def _check_folder(folder: Path, ending: str, expected: ExpectedImages) -> str:
    """Compare the files of a folder with the suite's images; return the SHA-256 of them all."""
    names = {f"{number:06d}{ending}" for number in range(len(expected.images))}
    file_names = {path.name for path in folder.iterdir()}
    refuse(folder, "files for images that the suite does not have", sorted(file_names - names))
    refuse(folder, "missing files", sorted(names - file_names))
    digest = hashlib.sha256()
    for name in sorted(names):
        data = read_file(folder / name)
        digest.update(f"{name} {len(data)}\n".encode() + data)
    return digest.hexdigest()


def _check_nuscenes(path: Path, results: Mapping[str, Any]) -> None:
    """Refuse boxes of nuScenes results whose numbers are not finite."""
    wrong = []
    for token, boxes in results.items():
        box_list: list[Any] = boxes if isinstance(boxes, list) else []
        for k, box in enumerate(box_list):
            try:
                numbers = [
                    *box["translation"],
                    *box["size"],
                    *box["rotation"],
                    box["detection_score"],
                ]
                is_usable = len(numbers) == 11 and all(math.isfinite(float(n)) for n in numbers)
            except (LookupError, OverflowError, TypeError, ValueError):
                is_usable = False
            if not is_usable:
                wrong.append(f"sample {token}, box {k}")
    refuse(path, "boxes with numbers that are missing or not finite", wrong)
    not_lists = [token for token, boxes in results.items() if not isinstance(boxes, list)]
    refuse(path, "samples without a list of boxes", not_lists)


def _read_meta(folder: Path) -> Meta | None:
    """Return the content of `meta.json`; None if there is no such file."""
    path = folder / META_FILE
    if not path.is_file():
        return None
    try:
        return Meta.model_validate(_read_json(path))
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()[:3]
        )
        raise ScoreError(f"{path} is not usable: {problems}") from error


def _read_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    try:
        return json.loads(read_file(path))
    except (OSError, ValueError, RecursionError) as error:
        raise ScoreError(f"{path} cannot be read as JSON: {error}") from error


def _hash_json(content: Any) -> str:
    """Return the SHA-256 of a JSON value, whatever its layout."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
