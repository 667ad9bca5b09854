"""Images that a dataset keeps in Parquet tables, written as files without lens distortion once they
are read.

    FOLDER/packed.json          the table, its column, and of each image its row and lens
    FOLDER/CAMERA/NAME.jpg      there once it was asked for

A drive has a thousand images, of which its opening needs some and most renders none; each costs a
decoder and an encoder. `augment.files.recorded_images` asks for those that it finds missing.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError
from pydantic.dataclasses import dataclass

from augment.errors import AdapterError, OutputError
from augment.files.image_size import image_header
from augment.files.recorded_images import decode_pixels
from augment.files.stated_sizes import StatedSizeError, check_row_group
from augment.jobs.atomic import temporary_beside
from augment.jobs.tables import opened_parquet
from recipes.files import open_file

PACKED = "packed.json"
_MAX_PACKED = 1 << 26  # bytes of it
_DAMAGED = (OutputError, OSError, pa.ArrowException, UnicodeDecodeError, StatedSizeError)
_ADVICE = "write it as the dataset does, or copy the dataset's own file"
_AT_ONCE = 16  # images: some 6 MB of JPEGs, decoded 0.1 GB
_JPEG_QUALITY = 95
_THREADS = 4  # decoders and encoders release the interpreter

# ---- Rows of large tables ------------------------------------------------------------------------


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Errors of Arrow and the system become AdapterErrors that name the file."""
    try:
        yield
    except _DAMAGED as error:
        raise AdapterError(f"{path} cannot be read as Parquet ({error}); {_ADVICE}") from error


class ColumnKind(NamedTuple):
    """What a column must hold. words: that, for messages."""

    words: str
    matches: Callable[[pa.DataType], bool]


def is_number(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind)


def is_list(kind: pa.DataType) -> bool:
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
    """Rows of a large file by number. Cheapest in ascending order: a row group is decoded from its
    start on, in pieces, and goes on from where it was left. Thread-safe.

    Args:
        path: a Parquet file.
        columns: the columns to read, and what each must hold.
        rows_at_once: how many rows are decoded together.

    Raises:
        AdapterError: the file is no Parquet file, or lacks a column of that kind."""

    def __init__(self, path: Path, columns: Mapping[str, ColumnKind], rows_at_once: int) -> None:
        self._path, self._columns, self._rows_at_once = path, list(columns), rows_at_once
        self._stack, self._lock = ExitStack(), threading.Lock()
        with reading(path):
            self._content, self._file = self._stack.enter_context(opened_parquet(path, str(path)))
            metadata, schema = self._file.metadata, self._file.schema_arrow
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
        """By row number, its cells by column, Arrow's scalars."""
        found = {}
        with self._lock, reading(self._path):
            for row in sorted(map(int, rows)):
                batch = self._batch_of(row)
                at = row - self._first
                found[row] = {name: batch[name][at] for name in self._columns}
        return found

    def _batch_of(self, row: int) -> pa.RecordBatch:
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

_RADIAL = (0.8, 1.2)  # beyond, the polynomial is no lens any more
_MAX_ZOOM = 2.0


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Lens:
    """A camera's image as recorded. Size and f, c: pixels; OpenCV's five coefficients."""

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
        return not any((self.k1, self.k2, self.p1, self.p2, self.k3))

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Recorded pixels of rays (x, y, 1), OpenCV axes, and where the lens model holds."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        u = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        v = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        valid = (radial >= _RADIAL[0]) & (radial <= _RADIAL[1])
        return self.f_u * u + self.c_u, self.f_v * v + self.c_v, valid

    @cached_property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of the image without distortion, of the same size: the recorded ones, or
        a longer focal length where its border would show what was not recorded."""

        def fits(zoom: float) -> bool:
            columns = np.arange(self.width) + 0.5
            rows = np.arange(self.height) + 0.5
            u = np.concatenate([columns, columns, 0 * rows + 0.5, 0 * rows + self.width - 0.5])
            v = np.concatenate([0 * columns + 0.5, 0 * columns + self.height - 0.5, rows, rows])
            u, v, valid = self.project(*self._rays(u, v, zoom))
            inside = (u >= 0) & (u <= self.width) & (v >= 0) & (v <= self.height)
            return bool((inside & valid).all())

        low, high = 1.0, _MAX_ZOOM
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
        """Where each undistorted pixel lies in the recorded image, for cv2.remap, whose pixel
        centres are whole numbers."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        u, v, _ = self.project(*self._rays(u, v, self.pinhole[0] / self.f_u))
        u, v = (u - 0.5).astype(np.float32), (v - 0.5).astype(np.float32)
        return cv2.convertMaps(u, v, cv2.CV_16SC2)

    def undistorted(self, image: np.ndarray) -> np.ndarray:
        return cv2.remap(image, *self.maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def _rays(self, u: np.ndarray, v: np.ndarray, zoom: float) -> tuple[np.ndarray, np.ndarray]:
        return (u - self.c_u) / (zoom * self.f_u), (v - self.c_v) / (zoom * self.f_v)


# ---- Images --------------------------------------------------------------------------------------


class PackedImages(BaseModel):
    """What a folder's images are made of. rows: of the table, by CAMERA/NAME.jpg. lenses: by
    camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    table: str
    column: str
    lenses: Mapping[str, Lens]
    rows: Mapping[str, NonNegativeInt]

    def put(self, folder: Path, asked: Sequence[str], now: Sequence[str]) -> dict[str, str]:
        """Say in the folder what its images are made of, look at those asked for, and write some of
        them at once, where they are not there. Returns what is wrong with images, by name, the end
        of a sentence; that decoders refuse one is told of those alone that are written.

        Raises:
            AdapterError: the table is damaged, or the folder cannot be written."""
        _write(folder / PACKED, self.model_dump_json().encode())
        faults: dict[str, str] = {}
        wanted = {name for name in now if not (folder / name).is_file()}
        reader = RowReader(Path(self.table), {self.column: FILE_BYTES}, _AT_ONCE)
        names = sorted(asked, key=self.rows.__getitem__)
        with ThreadPoolExecutor(_THREADS) as pool:
            for start in range(0, len(names), _AT_ONCE):
                own = names[start : start + _AT_ONCE]
                cells = self._read(reader, own)
                jobs = [
                    (folder / n if n in wanted else None, cells[n], self.lenses[n.split("/")[0]])
                    for n in own
                ]
                found = pool.map(_unpack, jobs)
                faults |= {n: fault for n, fault in zip(own, found, strict=True) if fault}
        return faults

    def unpack(self, folder: Path, name: str) -> str:
        """Write an image and those beside it in the table; what is wrong with it, or nothing."""
        names = sorted(self.rows, key=self.rows.__getitem__)
        first = names.index(name) // _AT_ONCE * _AT_ONCE
        own = [n for n in names[first : first + _AT_ONCE] if not (folder / n).is_file()]
        cells = self._read(_reader(self.table, self.column, os.getpid()), own)
        jobs = [(folder / n, cells[n], self.lenses[n.split("/")[0]]) for n in own]
        with ThreadPoolExecutor(_THREADS) as pool:
            faults = dict(zip(own, pool.map(_unpack, jobs), strict=True))
        return faults.get(name, "")

    def _read(self, reader: RowReader, names: Sequence[str]) -> dict[str, Any]:
        cells = reader.read([self.rows[name] for name in names])
        return {name: cells[self.rows[name]][self.column] for name in names}


@lru_cache(maxsize=2)
def _reader(table: str, column: str, _pid: int) -> RowReader:
    # Another process must not go on with this one's file.
    return RowReader(Path(table), {column: FILE_BYTES}, _AT_ONCE)


def is_packed(path: Path) -> bool:
    """Whether the image can be written from a table; it may be there already."""
    packed = _packed_of(path)
    return packed is not None and _name(path) in packed.rows


def unpack_image(path: Path) -> str:
    """Write an image that is not there, if a table has it. Returns what is wrong, the end of a
    sentence, or nothing: also where no table is known to have it."""
    packed = _packed_of(path)
    if packed is None or _name(path) not in packed.rows:
        return ""
    try:
        return packed.unpack(path.parents[1], _name(path))
    except AdapterError as error:
        return f"cannot be had from its table: {error}"


def _name(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def _packed_of(path: Path) -> PackedImages | None:
    if len(path.parents) < 2:
        return None
    file = path.parents[1] / PACKED
    try:
        return _read_packed(file, file.stat().st_mtime_ns)
    except (OSError, ValidationError):
        return None


@lru_cache(maxsize=4)
def _read_packed(file: Path, _changed_ns: int) -> PackedImages:
    with open_file(file) as opened:
        return PackedImages.model_validate_json(opened.read(_MAX_PACKED))


def _unpack(job: tuple[Path | None, Any, Lens]) -> str:
    """Check an image and, given a path, write it without distortion. Returns what is wrong with it,
    or nothing."""
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
        data = cv2.imencode(".jpg", lens.undistorted(image), quality)[1].tobytes()
    _write(path, data)
    return ""


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new = temporary_beside(path)
        new.write_bytes(data)
        os.replace(new, path)
    except OSError as error:
        raise AdapterError(
            f"{path} cannot be written ({error.strerror or error}); images without distortion are "
            f"kept there, set XDG_CACHE_HOME to a folder with room for them"
        ) from error
