"""PyTorch datasets: over the files a job has written, and rendered on the fly.

Both yield the samples that `augment.dataset_samples` describes, with the same pixels.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import pyarrow as pa
from pyarrow.compute import Expression
from torch.utils.data import Dataset

from augment.batch.box_tables import BoxNumbers, Item
from augment.batch.box_weather import TABLES
from augment.batch.calibration import CameraRecord, read_camera, read_entries
from augment.batch.encode import decode_image, decode_png
from augment.batch.label_files import read_boxes
from augment.batch.layout import PATH_KINDS, resolve_inside
from augment.batch.manifest import OK, read_manifest, weather_columns
from augment.dataset_samples import ImageType, Pixels, collate_frames, make_sample
from augment.dataset_scene import SceneDataset
from augment.errors import OutputError
from augment.labels import Boxes

__all__ = ["SceneDataset", "WeatherDataset", "collate_frames"]

_BUFFERS = {
    "depth": np.uint16,
    "semantic": np.uint8,
    "instance": np.uint16,
    "water": np.uint8,
    "snow": np.uint8,
}
CACHED_VARIANTS = 8  # whose boxes and calibration are kept: neighbours in the order of the rows
Value = TypeVar("Value")


class WeatherDataset(Dataset):
    """The finished images of an output folder, with depth, boxes, camera and weather.

    out_dir: where jobs have written. where: an Arrow expression over the manifest's columns, such
    as `pyarrow.compute.field("smog_extinction_per_m") > 0.02`. scenes, variants, cameras, frames:
    what to keep, None for all. image_type: `float32` in [0, 1] or `uint8`. verify: compare every
    image with its checksum, about 1 ms a megabyte.

    Holds the manifest only; files are read when asked for. Samples come in the manifest's order:
    scene, variant, frame, camera.

    Raises:
        OutputError: no finished output folder; later, from indexing, a file that is missing,
            damaged, or outside the folder.
        ValueError: a name in a filter that the manifest does not have.
    """

    def __init__(
        self,
        out_dir: str | Path,
        *,
        where: Expression | None = None,
        scenes: Collection[str] | None = None,
        variants: Collection[str] | None = None,
        cameras: Collection[str] | None = None,
        frames: Collection[int] | None = None,
        image_type: ImageType = "float32",
        verify: bool = True,
    ) -> None:
        if image_type not in ("float32", "uint8"):
            raise ValueError(f"image_type must be 'float32' or 'uint8'; got {image_type!r}")
        self.out_dir = Path(out_dir).absolute()
        self.image_type: ImageType = image_type
        self.verify = verify
        table = read_manifest(self.out_dir)
        self._weather = weather_columns(table)
        wanted = {"scene": scenes, "variant": variants, "camera": cameras, "frame": frames}
        table = _keep_only(table, {"status": [OK]}, self.out_dir)
        table = _keep_only(table, wanted, self.out_dir)
        self._table = table if where is None else table.filter(where)
        self._boxes: _Cache[dict[int, Boxes]] = _Cache(_read_all_boxes)
        self._box_weather: dict[str, _Cache[dict[Item, BoxNumbers]]] = {
            kind: _Cache(table.read) for kind, table in TABLES.items()
        }
        self._calibration: _Cache[dict[int, dict[str, Any]]] = _Cache(read_entries)

    @property
    def table(self) -> pa.Table:
        """The manifest's rows behind the samples, in their order."""
        return self._table

    def __len__(self) -> int:
        return self._table.num_rows

    def __getitem__(self, index: int) -> dict[str, Any]:
        count = len(self)
        if not -count <= index < count:
            raise IndexError(f"sample {index} of a dataset of {count}")
        row = self._table.slice(index % count, 1).to_pylist()[0]
        paths = {
            kind: None
            if row[f"{kind}_path"] is None
            else resolve_inside(self.out_dir, row[f"{kind}_path"])
            for kind in PATH_KINDS
        }
        names = ("scene", "variant", "frame", "recipe_hash", "surface")
        boxes = self._read_boxes(row, paths)
        return make_sample(
            pixels=self._read_pixels(row, paths),
            image_type=self.image_type,
            camera=self._read_camera(row, paths),
            boxes=boxes,
            box_weather={} if boxes is None else self._read_box_weather(row, paths, len(boxes)),
            weather={name: row[name] for name in self._weather},
            paths={kind: None if path is None else str(path) for kind, path in paths.items()},
            names={name: row[name] for name in names},
        )

    def _read_pixels(self, row: dict[str, Any], paths: dict[str, Path | None]) -> Pixels:
        path = paths["image"]
        if path is None:
            raise OutputError(f"{self.out_dir}: a row with status ok names no image: {row}")
        data = _read_file(path)
        if self.verify and hashlib.sha256(data).hexdigest() != row["checksum"]:
            raise _damaged(path, f"its SHA-256 is not the manifest's {row['checksum']}")
        images = {"rgb": _decoded(path, lambda: decode_image(data))}
        for kind, dtype in _BUFFERS.items():
            if (buffer := paths[kind]) is not None:
                images[kind] = _read_png(buffer, dtype)
        for kind, image in images.items():
            if image.shape[:2] != (row["height"], row["width"]):
                file = paths["image" if kind == "rgb" else kind]
                raise _damaged(
                    file,
                    f"it is {image.shape[1]}x{image.shape[0]}, the manifest says "
                    f"{row['width']}x{row['height']}",
                )
        return Pixels(**images)

    def _read_camera(self, row: dict[str, Any], paths: dict[str, Path | None]) -> CameraRecord:
        path = paths["calibration"]
        if path is None:
            raise OutputError(f"{self.out_dir}: a row with status ok names no calibration: {row}")
        try:
            return read_camera(self._calibration.get(path)[row["frame"]], row["camera"])
        except KeyError as error:
            where = f"frame {row['frame']}, camera {row['camera']!r}"
            raise _damaged(path, f"it lacks {error} ({where})") from error

    def _read_boxes(self, row: dict[str, Any], paths: dict[str, Path | None]) -> Boxes | None:
        path = paths["labels"]
        if path is None:
            return None
        try:
            return self._boxes.get(path)[row["frame"]]
        except KeyError as error:
            raise _damaged(path, f"it lacks frame {row['frame']}") from error

    def _read_box_weather(
        self, row: dict[str, Any], paths: dict[str, Path | None], count: int
    ) -> dict[str, BoxNumbers]:
        found = {}
        where = f"frame {row['frame']}, camera {row['camera']!r}"
        for kind, tables in self._box_weather.items():
            path = paths[kind]
            if path is None:
                continue
            numbers = tables.get(path).get((row["frame"], row["camera"]))
            if numbers is None:
                raise _damaged(path, f"it lacks {where}")
            boxes = len(numbers.track_ids)
            if boxes != count:
                raise _damaged(path, f"{where}: it has {boxes} boxes, the labels have {count}")
            found[kind] = numbers
        return found


class _Cache(Generic[Value]):
    """The last few files read, parsed; small enough to travel to DataLoader workers."""

    def __init__(self, read: Callable[[Path], Value]) -> None:
        self._read = read
        self._values: OrderedDict[Path, Value] = OrderedDict()

    def get(self, path: Path) -> Value:
        if path not in self._values:
            self._values[path] = self._read(path)
            if len(self._values) > CACHED_VARIANTS:
                self._values.popitem(last=False)
        self._values.move_to_end(path)
        return self._values[path]


def _read_all_boxes(path: Path) -> dict[int, Boxes]:
    return {number: frame.boxes for number, frame in read_boxes(path).items()}


def _keep_only(
    table: pa.Table, wanted: dict[str, Collection | Sequence | None], out_dir: Path
) -> pa.Table:
    mask = np.ones(table.num_rows, bool)
    for name, values in wanted.items():
        if values is None:
            continue
        if isinstance(values, str):
            raise ValueError(f"{name}s must be a collection of names; got the string {values!r}")
        column = table[name].to_numpy(zero_copy_only=False)
        unknown = sorted(set(values) - set(column.tolist()))
        if unknown and name != "status":
            known = ", ".join(map(str, sorted(set(column.tolist()))))
            raise ValueError(f"{out_dir} has no {name} {unknown}; finished are: {known or 'none'}")
        mask &= np.isin(column, list(values))
    return table.filter(pa.array(mask))


def _read_file(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise OutputError(
            f"{path} cannot be read ({error.strerror}), though the manifest lists it; run the "
            f"job again: it renders what is missing"
        ) from error


def _read_png(path: Path, dtype: type) -> np.ndarray:
    data = _read_file(path)
    return _decoded(path, lambda: decode_png(data, dtype))


def _decoded(path: Path, decode: Callable[[], np.ndarray]) -> np.ndarray:
    try:
        return decode()
    except ValueError as error:
        raise _damaged(path, str(error)) from error


def _damaged(path: Path | None, what: str) -> OutputError:
    return OutputError(
        f"{path} is damaged: {what}. Delete it and run the job again, which renders it anew"
    )
