"""Writes images that a dataset stores in Parquet tables as undistorted files, once they are read.

    FOLDER/packed.json          the table, its column, and the row and the lens of each image
    FOLDER/CAMERA/NAME.jpg      exists after the image was read once

A drive has a thousand images; opening it needs a few, and most are never rendered. Each costs a
decoder and an encoder. `augment.files.recorded_images` calls this module for missing images.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError
from pydantic.dataclasses import dataclass

from augment.errors import AdapterError, OutputError
from augment.files.image_size import decode_pixels, image_header
from augment.files.stated_sizes import StatedSizeError, check_row_group
from augment.files.undistorted_images import write_copy
from augment.output.tables import open_parquet
from recipes.files import open_file

PACKED = "packed.json"  # the file that describes a folder's images
_MAX_PACKED_BYTES = 1 << 26  # bytes of that file
_READ_ERRORS = (OutputError, OSError, pa.ArrowException, UnicodeDecodeError, StatedSizeError)
_ADVICE = "write it as the dataset does, or copy the dataset's own file"
_IMAGES_AT_ONCE = 16  # images of a batch: some 6 MB of JPEGs, decoded 0.1 GB
_JPEG_QUALITY = 95  # of the written images
_NUM_THREADS = 4  # decoders and encoders release the interpreter

# ---- Rows of large tables ------------------------------------------------------------------------


@contextmanager
def parquet_errors(path: Path) -> Iterator[None]:
    """Turn errors of Arrow and the system into AdapterErrors that name the file."""
    try:
        yield
    except _READ_ERRORS as error:
        raise AdapterError(f"{path} cannot be read as Parquet ({error}); {_ADVICE}") from error


class ColumnKind(NamedTuple):
    """A kind of values that a column must hold."""

    words: str  # its name, for messages
    matches: Callable[[pa.DataType], bool]  # returns True for a type of that kind


def is_number(kind: pa.DataType) -> bool:
    """Return True for a type of numbers."""
    return pa.types.is_floating(kind) or pa.types.is_integer(kind)


def is_list(kind: pa.DataType) -> bool:
    """Return True for a type of lists."""
    return (
        pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)
    )


NUMBER_LISTS = ColumnKind(
    "lists of numbers", lambda kind: is_list(kind) and is_number(kind.value_type)
)
FILE_BYTES = ColumnKind(
    "bytes of files", lambda kind: pa.types.is_binary(kind) or pa.types.is_large_binary(kind)
)
WHOLE_NUMBERS = ColumnKind("whole numbers", pa.types.is_integer)


class RowReader:
    """Reads rows of a large file by number. Thread-safe.

    Ascending order is cheapest: a row group is decoded from its start on, in pieces, and decoding
    goes on where it stopped.

    Args:
        path: a Parquet file.
        columns: the columns to read, and the kind of values of each.
        rows_at_once: how many rows are decoded together.

    Raises:
        AdapterError: the file is no Parquet file, or lacks a column of that kind.
    """

    def __init__(self, path: Path, columns: Mapping[str, ColumnKind], rows_at_once: int) -> None:
        self._path = path
        self._columns = list(columns)
        self._rows_at_once = rows_at_once
        self._stack = ExitStack()
        self._lock = threading.Lock()
        with parquet_errors(path):
            self._content, self._file = self._stack.enter_context(open_parquet(path, str(path)))
            metadata = self._file.metadata
            schema = self._file.schema_arrow
            sizes = [metadata.row_group(g).num_rows for g in range(metadata.num_row_groups)]
        for name, kind in columns.items():
            if schema.names.count(name) != 1:
                fault = "stands there twice" if name in schema.names else "is missing"
                raise AdapterError(f"{path}: column {name} {fault}; {_ADVICE}")
            if not kind.matches(schema.field(name).type):
                raise AdapterError(
                    f"{path}: column {name} must hold {kind.words}; it holds "
                    f"{schema.field(name).type}; {_ADVICE}"
                )
        self._starts = np.cumsum([0, *sizes])
        self._batches: Iterator[pa.RecordBatch] = iter(())
        self._batch: pa.RecordBatch | None = None
        self._first = self._group = -1

    def __del__(self) -> None:
        self._stack.close()

    def read(self, rows: Sequence[int]) -> dict[int, dict[str, Any]]:
        """Return the cells of rows, Arrow's scalars, by row number and column."""
        cells_of_row = {}
        with self._lock, parquet_errors(self._path):
            for row in sorted(map(int, rows)):
                batch = self._batch_of(row)
                index = row - self._first
                cells_of_row[row] = {name: batch[name][index] for name in self._columns}
        return cells_of_row

    def _batch_of(self, row: int) -> pa.RecordBatch:
        """Decode the batch that holds a row."""
        group = int(np.searchsorted(self._starts, row, side="right")) - 1
        if self._batch is None or group != self._group or row < self._first:
            check_row_group(self._content, self._file, group, self._columns)
            self._batches = self._file.iter_batches(
                self._rows_at_once, row_groups=[group], columns=self._columns
            )
            self._group, self._first, self._batch = group, int(self._starts[group]), None
        while self._batch is None or row >= self._first + len(self._batch):
            if self._batch is not None:
                self._first += len(self._batch)
            batch = self._batch = next(self._batches, None)
            if batch is None:
                raise AdapterError(f"{self._path} ends before row {row}; {_ADVICE}")
            batch.validate(full=True)
        return self._batch


# ---- Lenses --------------------------------------------------------------------------------------

_RADIAL_RANGE = (0.8, 1.2)  # radial factors of a real lens; the polynomial is wrong beyond
_MAX_ZOOM = 2.0  # the largest factor of the focal length


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Lens:
    """A camera's recorded image: size, focal lengths f and principal point c in pixels.

    k1 to k3 and p1, p2 are OpenCV's five distortion coefficients.
    """

    width: int
    height: int
    f_u: float
    f_v: float
    c_u: float
    c_v: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float

    @property
    def is_pinhole(self) -> bool:
        """True for a lens without distortion."""
        return not any((self.k1, self.k2, self.p1, self.p2, self.k3))

    @property
    def without_distortion(self) -> Lens:
        """The same image with no distortion to take out: its bytes stay as they are."""
        return replace(self, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """The recorded fx, fy, cx, cy, pixels."""
        return self.f_u, self.f_v, self.c_u, self.c_v

    @property
    def coefficients(self) -> tuple[float, float, float, float, float]:
        """The distortion in OpenCV's order: k1, k2, p1, p2, k3."""
        return self.k1, self.k2, self.p1, self.p2, self.k3

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project rays (x, y, 1), OpenCV axes, into recorded pixels.

        Returns:
            u and v in pixels, and True where the lens model holds.
        """
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        u = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        v = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        valid = (radial >= _RADIAL_RANGE[0]) & (radial <= _RADIAL_RANGE[1])
        return self.f_u * u + self.c_u, self.f_v * v + self.c_v, valid

    @cached_property
    def pinhole(self) -> tuple[float, float, float, float]:
        """Return fx, fy, cx, cy of the image without distortion, of the same size, in pixels.

        They are the recorded ones, or a longer focal length if the border would otherwise show
        pixels that were not recorded.
        """

        def fits(zoom: float) -> bool:
            columns = np.arange(self.width) + 0.5
            rows = np.arange(self.height) + 0.5
            u = np.concatenate([columns, columns, 0 * rows + 0.5, 0 * rows + self.width - 0.5])
            v = np.concatenate([0 * columns + 0.5, 0 * columns + self.height - 0.5, rows, rows])
            u, v, valid = self.project(*self._rays(u, v, zoom))
            inside = (u >= 0) & (u <= self.width) & (v >= 0) & (v <= self.height)
            return bool((inside & valid).all())

        low = 1.0
        high = _MAX_ZOOM
        if fits(low):
            high = low
        elif not fits(high):
            raise ValueError("its distortion leaves no picture")
        while high - low > 1e-6:
            middle = (low + high) / 2
            low, high = (low, middle) if fits(middle) else (middle, high)
        return high * self.f_u, high * self.f_v, self.c_u, self.c_v

    @cached_property
    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the recorded position of each undistorted pixel, as maps for cv2.remap.

        Its pixel centres are whole numbers.
        """
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        u, v, _ = self.project(*self._rays(u, v, self.pinhole[0] / self.f_u))
        u = (u - 0.5).astype(np.float32)
        v = (v - 0.5).astype(np.float32)
        return cv2.convertMaps(u, v, cv2.CV_16SC2)

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """Return the image without distortion."""
        return cv2.remap(image, *self.maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def _rays(self, u: np.ndarray, v: np.ndarray, zoom: float) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y of the rays of undistorted pixels."""
        return (u - self.c_u) / (zoom * self.f_u), (v - self.c_v) / (zoom * self.f_v)


# ---- Images --------------------------------------------------------------------------------------


class PackedImages(BaseModel):
    """The content of packed.json: the source of a folder's images."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    table: str  # path of the table
    column: str  # its column of image files
    lenses: Mapping[str, Lens]  # by camera
    rows: Mapping[str, NonNegativeInt]  # row of the table by CAMERA/NAME.jpg

    def write_folder(
        self, folder: Path, checked_names: Sequence[str], written_names: Sequence[str]
    ) -> dict[str, str]:
        """Write packed.json, check images, and write some of them at once if they are missing.

        Args:
            folder: the folder of the images.
            checked_names: names of the images to check.
            written_names: names of the images to write.

        Returns:
            The fault of each faulty image by name, as the end of a sentence. Only images that are
            written are decoded, so only their decoding errors are reported.

        Raises:
            AdapterError: the table is damaged, or the folder cannot be written.
        """
        write_copy(folder / PACKED, self.model_dump_json().encode())
        faults: dict[str, str] = {}
        missing_names = {name for name in written_names if not (folder / name).is_file()}
        reader = RowReader(Path(self.table), {self.column: FILE_BYTES}, _IMAGES_AT_ONCE)
        names = sorted(checked_names, key=self.rows.__getitem__)
        with ThreadPoolExecutor(_NUM_THREADS) as pool:
            for start in range(0, len(names), _IMAGES_AT_ONCE):
                batch_names = names[start : start + _IMAGES_AT_ONCE]
                cells = self._read(reader, batch_names)
                jobs = [
                    (
                        folder / n if n in missing_names else None,
                        cells[n],
                        self.lenses[n.split("/")[0]],
                    )
                    for n in batch_names
                ]
                batch_faults = pool.map(_unpack, jobs)
                faults |= {
                    n: fault for n, fault in zip(batch_names, batch_faults, strict=True) if fault
                }
        return faults

    def unpack(self, folder: Path, name: str) -> str:
        """Write an image and its neighbours in the table; return its fault, or ""."""
        names = sorted(self.rows, key=self.rows.__getitem__)
        first = names.index(name) // _IMAGES_AT_ONCE * _IMAGES_AT_ONCE
        batch_names = [
            n for n in names[first : first + _IMAGES_AT_ONCE] if not (folder / n).is_file()
        ]
        cells = self._read(_reader(self.table, self.column, os.getpid()), batch_names)
        jobs = [(folder / n, cells[n], self.lenses[n.split("/")[0]]) for n in batch_names]
        with ThreadPoolExecutor(_NUM_THREADS) as pool:
            faults = dict(zip(batch_names, pool.map(_unpack, jobs), strict=True))
        return faults.get(name, "")

    def _read(self, reader: RowReader, names: Sequence[str]) -> dict[str, Any]:
        """Read the cells of images by name."""
        cells = reader.read([self.rows[name] for name in names])
        return {name: cells[self.rows[name]][self.column] for name in names}


@lru_cache(maxsize=2)
def _reader(table: str, column: str, _pid: int) -> RowReader:
    """Return the open table of this process."""
    # A child process must not go on with its parent's file: _pid is a part of the cache's key.
    return RowReader(Path(table), {column: FILE_BYTES}, _IMAGES_AT_ONCE)


def is_packed(path: Path) -> bool:
    """Return True if the image can be written from a table; it may exist already."""
    packed = _packed_of(path)
    return packed is not None and _name(path) in packed.rows


def unpack_image(path: Path) -> str:
    """Write a missing image if a table has it.

    Returns:
        The fault, as the end of a sentence; "" without a fault, and if no known table has it.
    """
    packed = _packed_of(path)
    if packed is None or _name(path) not in packed.rows:
        return ""
    try:
        return packed.unpack(path.parents[1], _name(path))
    except AdapterError as error:
        return f"cannot be had from its table: {error}"


def _name(path: Path) -> str:
    """Return CAMERA/NAME of an image."""
    return f"{path.parent.name}/{path.name}"


def _packed_of(path: Path) -> PackedImages | None:
    """Return the content of packed.json in the image's folder, if there is one."""
    if len(path.parents) < 2:
        return None
    file = path.parents[1] / PACKED
    try:
        return _read_packed(file, file.stat().st_mtime_ns)
    except (OSError, ValidationError):
        return None


@lru_cache(maxsize=4)
def _read_packed(file: Path, _changed_ns: int) -> PackedImages:
    """Read packed.json; the time of its last change is a part of the cache's key."""
    with open_file(file) as opened:
        return PackedImages.model_validate_json(opened.read(_MAX_PACKED_BYTES))


def _unpack(job: tuple[Path | None, Any, Lens]) -> str:
    """Check an image and, given a path, write it without distortion; return its fault, or ""."""
    path, cell, lens = job
    data = b"" if cell.as_buffer() is None else cell.as_buffer().to_pybytes()
    header = image_header(data)
    if header is None or header.format != "JPEG" or b"\xff\xd9" not in data[-64:]:
        return f"of {len(data)} bytes is no whole JPEG"
    if (header.width, header.height) != (lens.width, lens.height):
        size = f"{header.width}x{header.height}"
        return f"is of {size} pixels, its camera of {lens.width}x{lens.height}"
    if path is None:
        return ""
    if not lens.is_pinhole:
        image = decode_pixels(data, cv2.IMREAD_COLOR)
        if image is None:
            return "cannot be decoded"
        quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        data = cv2.imencode(".jpg", lens.undistort(image), quality)[1].tobytes()
    write_copy(path, data)
    return ""
