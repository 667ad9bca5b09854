"""What the files of one manifest row hold."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.batch.box_tables import BoxNumbers
from augment.batch.box_weather import TABLES
from augment.batch.calibration import CameraRecord, read_camera, read_entries
from augment.batch.encode import decode_image, decode_png
from augment.batch.label_files import FrameBoxes, read_boxes, read_lidar
from augment.batch.layout import PATH_KINDS
from augment.batch.store import Store
from augment.dataset.rows import Rows
from augment.dataset.samples import BUFFERS, Labels, Pixels
from augment.dataset.stored import Companions, StoredFiles, damaged
from augment.errors import OutputError
from augment.labels import LidarSweep

_TYPES = {
    "depth": np.uint16,
    "semantic": np.uint8,
    "instance": np.uint16,
    "water": np.uint8,
    "snow": np.uint8,
}


class RowReader:
    """Reads what the rows of a manifest name, from one store. verify: compare checksums."""

    def __init__(self, store: Store, *, verify: bool) -> None:
        self.store, self.verify = store, verify
        self._files = StoredFiles(store)
        self._boxes = Companions(self._files, read_boxes)
        self._box_weather = {k: Companions(self._files, table.read) for k, table in TABLES.items()}
        self._calibration = Companions(self._files, read_entries)
        self._sweeps = Companions(self._files, _read_one_sweep)

    def names(self, rows: Rows, row: int) -> dict[str, str | None]:
        """The row's files by kind, as they are called here."""
        found = {kind: _parts(rows, row, kind) for kind in PATH_KINDS}
        return {
            k: None if parts is None else self._files.name(*parts) for k, parts in found.items()
        }

    def pixels(self, rows: Rows, row: int, load: Collection[str]) -> Pixels:
        """The row's image and buffers, those of `load`."""
        images = {}
        if "image" in load:
            images["rgb"] = self._image(rows, row)
        for kind in BUFFERS:
            parts = _parts(rows, row, kind) if kind in load else None
            if parts is not None:
                images[kind] = self._decoded(
                    parts, lambda data, k=kind: decode_png(data, _TYPES[k])
                )
        size = (rows["height"][row], rows["width"][row])
        for kind, image in images.items():
            if image.shape[:2] != size:
                parts = _parts(rows, row, "image" if kind == "rgb" else kind)
                assert parts is not None
                raise damaged(
                    self._files.name(*parts),
                    f"it is {image.shape[1]}x{image.shape[0]}, the manifest says "
                    f"{size[1]}x{size[0]}",
                )
        return Pixels(**images)

    def camera(self, rows: Rows, row: int) -> tuple[CameraRecord, torch.Tensor]:
        """The row's camera, and world_from_ego, float64 [4, 4]."""
        parts = self._needed(rows, row, "calibration")
        frame, camera = rows["frame"][row], rows["camera"][row]
        try:
            entry = self._calibration.get(*parts)[frame]
            ego = torch.tensor(entry["world_from_ego"], dtype=torch.float64)
            return read_camera(entry, camera), ego
        except KeyError as error:
            where = f"frame {frame}, camera {camera!r}"
            raise damaged(self._files.name(*parts), f"it lacks {error} ({where})") from error
        except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:
            where = f"frame {frame}, camera {camera!r}"
            raise damaged(self._files.name(*parts), f"{error} ({where})") from error

    def labels(self, rows: Rows, row: int, load: Collection[str]) -> Labels:
        """The boxes of the row's frame, what is measured of them in its image, and the sweep."""
        frame = self._frame_boxes(rows, row) if "boxes" in load else None
        boxes = None if frame is None else frame.boxes
        parts = _parts(rows, row, "lidar") if "lidar" in load else None
        return Labels(
            boxes=boxes,
            box_weather=None if boxes is None else self._weather_of(rows, row, len(boxes)),
            lidar=None if parts is None else self._sweeps.get(*parts)[0],
            instances=None if frame is None else frame.instances,
        )

    def _image(self, rows: Rows, row: int) -> np.ndarray:
        parts = self._needed(rows, row, "image")
        return self._decoded(parts, decode_image, rows["checksum"][row] if self.verify else None)

    def _decoded(
        self,
        parts: tuple[str, str],
        decode: Callable[[bytes], np.ndarray],
        checksum: str | None = None,
    ) -> np.ndarray:
        data = self._files.read(*parts)
        if checksum is not None and hashlib.sha256(data).hexdigest() != checksum:
            name = self._files.name(*parts)
            raise damaged(name, f"its SHA-256 is not the manifest's {checksum}")
        try:
            return decode(data)
        except ValueError as error:
            raise damaged(self._files.name(*parts), str(error)) from error

    def _frame_boxes(self, rows: Rows, row: int) -> FrameBoxes | None:
        parts = _parts(rows, row, "labels")
        if parts is None:
            return None
        try:
            return self._boxes.get(*parts)[rows["frame"][row]]
        except KeyError as error:
            name = self._files.name(*parts)
            raise damaged(name, f"it lacks frame {rows['frame'][row]}") from error

    def _weather_of(self, rows: Rows, row: int, count: int) -> dict[str, BoxNumbers]:
        found = {}
        item = (rows["frame"][row], rows["camera"][row])
        for kind, tables in self._box_weather.items():
            parts = _parts(rows, row, kind)
            if parts is None:
                continue
            numbers = tables.get(*parts).get(item)
            where = f"frame {item[0]}, camera {item[1]!r}"
            if numbers is None:
                raise damaged(self._files.name(*parts), f"it lacks {where}")
            boxes = len(numbers.track_ids)
            if boxes != count:
                told = f"{where}: it has {boxes} boxes, the labels have {count}"
                raise damaged(self._files.name(*parts), told)
            found[kind] = numbers
        return found

    def _needed(self, rows: Rows, row: int, kind: str) -> tuple[str, str]:
        parts = _parts(rows, row, kind)
        if parts is None:
            raise OutputError(
                f"{self.store.uri}: the manifest's row of scene {rows['scene'][row]!r}, variant "
                f"{rows['variant'][row]!r}, frame {rows['frame'][row]}, camera "
                f"{rows['camera'][row]!r} has status ok and names no {kind} file; it is damaged"
            )
        return parts


def _parts(rows: Rows, row: int, kind: str) -> tuple[str, str] | None:
    """The folder and the name of a row's file; None where it has none."""
    column: Any = rows[f"{kind}_path"]
    return column.parts(row)


def _read_one_sweep(path: Path) -> tuple[LidarSweep]:
    return (read_lidar(path),)
