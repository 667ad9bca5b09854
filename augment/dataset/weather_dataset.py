"""Dataset over the files that jobs have written.

In: output folders or stores. Out: samples (`augment.dataset.samples`). Only the manifest is held in
memory; files are read when a sample is asked for.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import tempfile
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.dataset
import torch
from pyarrow.compute import Expression
from torch.utils.data import Dataset, get_worker_info

from augment.dataset.samples import (
    NAMES,
    BoxFrame,
    ImageType,
    Labels,
    Sample,
    SampleOptions,
    buffers,
    check_index,
    loadable,
    make_sample,
)
from augment.errors import OutputError
from augment.output.atomic import read_file
from augment.output.box_tables import BoxNumbers
from augment.output.box_weather import box_tables
from augment.output.calibration import CameraRecord, read_camera, read_entries
from augment.output.codecs import decode_image, decode_png
from augment.output.layout import mask_names, path_kinds
from augment.output.manifest import OK, concat_rows, read_manifest_rows, weather_columns
from augment.output.names import resolve_inside
from augment.output.store import Store, StoredFileMissing, open_store
from augment.output.tables import read_boxes, read_lidar
from recipes.tags import CLASS_COLUMNS

pc: Any = pyarrow.compute  # type checkers do not see the functions that it makes on import

# ---- Rows of a manifest in a quarter of its memory, with quick access to single ones -------------
# Most of a row in the manifest's table (440 bytes with short names, 110 here) are paths and names
# that repeat. Here every column is dictionary-encoded with the smallest codes; paths are split into
# folder and file name, of which there are few. Arrow's buffers are shared by forked workers.

_PATH = r"(?s)^(?P<folder>.*/)?(?P<name>[^/]*)$"  # pattern of a path; the folder has its slash
_FOLDERS = "/folders"  # suffix of the name of a path's column of folders
_DIGEST = pa.binary(32)  # type of a SHA-256
_MAX_CODED_NUMBERS = 1 << 16  # number of distinct values above which numbers are not encoded
_MAX_PYTHON_VALUES = 1 << 12  # number of values above which a column's values stay Arrow's
_OUTPUT = "output"  # name of the column that holds an output's URI

Row = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a manifest."""

    batch: pa.RecordBatch
    """Columns of the manifest, encoded."""
    weather: tuple[str, ...]
    """Names of the columns that hold weather numbers."""

    @staticmethod
    def from_table(table: pa.Table) -> Rows:
        """Return the rows of a manifest's table; columns ending in `_path` hold paths."""
        encoded: dict[str, pa.Array] = {}
        for name, column in zip(table.column_names, table.columns, strict=True):
            if name.endswith("_path"):
                folders, column = pc.extract_regex(column, _PATH).combine_chunks().flatten()
                encoded[name + _FOLDERS] = _encode_column(pa.chunked_array([folders]))
                column = pa.chunked_array([column])
            encoded[name] = (
                _encode_digests(column) if name == "checksum" else _encode_column(column)
            )
        weather = (name for name in weather_columns(table) if name != _OUTPUT)
        return Rows(pa.RecordBatch.from_pydict(encoded), tuple(weather))

    def __reduce__(self) -> tuple:
        return Rows, (self.batch, self.weather)  # without what is cached

    def __len__(self) -> int:
        return self.batch.num_rows

    @property
    def names(self) -> list[str]:
        """Return the names of the manifest's columns."""
        return [name for name in self.batch.schema.names if not name.endswith(_FOLDERS)]

    def __getitem__(self, name: str) -> pa.Array:
        """Return a column as the manifest has it."""
        column = self.batch.column(name)
        if pa.types.is_dictionary(column.type):
            column = column.dictionary_decode()
        elif column.type == _DIGEST:
            column = pa.array([digest.hex() for digest in column.to_pylist()], pa.string())
        if name.endswith("_path"):
            column = pc.binary_join_element_wise(self[name + _FOLDERS], column, "")
        return column

    def numbers(self, name: str) -> np.ndarray:
        """Return a column as an array [N]; null is NaN in numbers."""
        return self[name].to_numpy(zero_copy_only=False)

    def codes(self, name: str) -> tuple[np.ndarray, list[Any]]:
        """Return every row's code in a column, [N], and the values; a code is an index of them."""
        column = self.batch.column(name)
        if not pa.types.is_dictionary(column.type):
            column = column.dictionary_encode("encode")
        return column.indices.to_numpy(), column.dictionary.to_pylist()

    def row(self, index: int) -> dict[str, Any]:
        """Return a row as the manifest has it, by columns."""
        object_columns, arrow_columns = self._lookups
        row = {name: values[codes[index]] for name, codes, values in object_columns}
        for name, codes, values in arrow_columns:
            value = values[codes[index]].as_py()
            row[name] = value.hex() if isinstance(value, bytes) else value
        for name in self._paths:
            folder = row.pop(name + _FOLDERS)
            file = row[name]
            row[name] = None if file is None else folder + file
        return row

    @cached_property
    def _lookups(self) -> tuple[list[tuple[str, Any, Any]], list[tuple[str, Any, Any]]]:
        """Return name, codes of the rows, and values of every column, in two lists.

        In the first list the values are Python objects, which are ten times as fast. Columns of the
        second list have too many values for that, as each worker has its own objects: they stay
        Arrow's.
        """
        object_columns = []
        arrow_columns = []
        for name, column in zip(self.batch.schema.names, self.batch.columns, strict=True):
            codes = range(len(self))
            values = column
            if pa.types.is_dictionary(column.type):
                indices: Any = column.indices.to_numpy()
                codes = memoryview(indices)
                values = column.dictionary
            if values is column or len(values) > _MAX_PYTHON_VALUES:
                arrow_columns.append((name, codes, values))
            else:
                object_columns.append((name, codes, values.to_pylist()))
        return object_columns, arrow_columns

    @cached_property
    def _paths(self) -> list[str]:
        """Return the names of the columns that hold paths."""
        return [name for name in self.names if name.endswith("_path")]

    def take(self, rows: np.ndarray) -> Rows:
        """Return the rows of these numbers, or those where a mask is true."""
        return Rows(self.batch.take(pa.array(np.arange(len(self))[rows])), self.weather)

    def groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Group the rows by output, scene and variant.

        Returns:
            The first row of every group, int64 [G], and the group of every row, int64 [N].
        """
        names = [n for n in (_OUTPUT, "scene", "variant") if n in self.batch.schema.names]
        group = number_groups([self.codes(name)[0] for name in names])
        return np.unique(group, return_index=True)[1], group

    def has_file(self, kind: str) -> np.ndarray:
        """Return the mask of rows that name a file of a kind of `samples.loadable`, bool [N]."""
        codes, names = self.codes(f"{'labels' if kind == 'boxes' else kind}_path")
        is_file = np.array([name is not None for name in names], bool)
        return is_file[codes] if len(is_file) else np.zeros(len(self), bool)

    def to_arrow(self) -> pa.Table:
        """Return the manifest's rows as a table again."""
        return pa.table({name: self[name] for name in self.names})


def number_groups(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Number the combinations of values that rows have in all columns, int64 [N].

    Numbers go from 0 without gaps, in the order of the first column, then of the second, and so on.
    """
    group = np.zeros(len(columns[0]), np.int64)
    for codes in columns:
        group = group * (int(codes.max(initial=0)) + 1) + codes
        group = np.unique(group, return_inverse=True)[1]
    return group


def _encode_column(column: pa.ChunkedArray) -> pa.Array:
    """Encode a column by its distinct values. Numbers that hardly repeat stay as they are."""
    is_coded = pa.types.is_dictionary(column.type)
    encoding: Any = (column if is_coded else column.dictionary_encode("encode")).combine_chunks()
    count = len(encoding.dictionary)
    if count > _MAX_CODED_NUMBERS and pa.types.is_primitive(column.type):
        return column.combine_chunks()
    if count <= 1 << 8:
        code_type = pa.uint8()
    elif count <= 1 << 16:
        code_type = pa.uint16()
    else:
        code_type = pa.int32()
    return pa.DictionaryArray.from_arrays(encoding.indices.cast(code_type), encoding.dictionary)


def _encode_digests(column: pa.ChunkedArray) -> pa.Array:
    """Return SHA-256 digests in lower-case digits as bytes; a column with other texts unchanged."""
    if column.null_count or not pc.all(pc.match_substring_regex(column, "^[0-9a-f]{64}$")).as_py():
        return column.combine_chunks()
    digests = pa.py_buffer(bytes.fromhex("".join(column.to_pylist())))
    return pa.Array.from_buffers(_DIGEST, len(column), [None, digests])


# ---- Contents of the files of a manifest's rows, on this machine or in an object store -----------
# A manifest may come from anybody, so no path leaves the output folder, by `..` or through a link.
# Checking that takes longer than opening a file, so a folder's path is checked once, and a file
# itself is opened such that it cannot be a link.

# Entries of parsed files that are kept, each a frame's or an image's: tens of megabytes.
CACHED_ENTRIES = 4096


class RowReader:
    """Reader of the files that rows of a manifest name, from one store; picklable.

    Args:
        store: the store.
        verify: if True, compare images with their checksums.
    """

    def __init__(self, store: Store, *, verify: bool) -> None:
        self.store = store
        self.verify = verify
        root, mark, query = store.uri.partition("?")
        if store.local_dir is not None:
            root = str(store.local_dir)
            mark = ""
            query = ""
        self._name_head = root.rstrip("/") + "/"
        self._name_tail = mark + query
        self._folders: dict[str, str] = {}
        self._parsed: defaultdict[str, OrderedDict[str, Any]] = defaultdict(OrderedDict)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_folders": {}, "_parsed": defaultdict(OrderedDict)}

    def name(self, path: str) -> str:
        """Return the name of a file in messages and samples: its path here, or its URI."""
        return f"{self._name_head}{path}{self._name_tail}"

    def images(self, row: Row, load: Collection[str]) -> dict[str, np.ndarray]:
        """Return the row's image and buffers of `load`, as files store them: RGB and [H, W]."""
        images = {}
        for kind in ("image", *buffers()):
            path = row[f"{kind}_path"]
            if kind not in load or path is None:
                continue
            data = self._read(path)
            with self._named(path):
                if kind == "image" and self.verify:
                    _check_digest(data, row["checksum"])
                is_image = kind == "image"
                image = (
                    decode_image(data) if is_image else decode_png(data, buffers()[kind].pixel_type)
                )
                _check_size(image, row)
            images[kind] = image
        return images

    def camera(self, row: Row) -> tuple[CameraRecord, torch.Tensor]:
        """Return the row's camera, and world_from_ego, float64 [4, 4]."""
        path = row["calibration_path"]
        if path is None:
            raise OutputError(
                f"{self.store.uri}: the manifest's row of scene {row['scene']!r}, variant "
                f"{row['variant']!r}, {_item_text(row)} has status ok and names no calibration "
                f"file; it is damaged"
            )
        entries = self.read_parsed("calibration", path, read_entries)
        with self._named(path, f" ({_item_text(row)})"):
            entry = entries[row["frame"]]
            ego = torch.tensor(entry["world_from_ego"], dtype=torch.float64)
            return read_camera(entry, row["camera"]), ego

    def labels(self, row: Row, load: Collection[str]) -> Labels:
        """Return the boxes of the row's frame, their measures in the row's image, and the sweep."""
        box_fields = {}
        sweep = None
        if "boxes" in load and (path := row["labels_path"]) is not None:
            frames = self.read_parsed("labels", path, read_boxes)
            with self._named(path):
                if row["frame"] not in frames:
                    raise ValueError(f"it lacks frame {row['frame']}")
            frame_boxes = frames[row["frame"]]
            weather = dict(self._box_weather(row, len(frame_boxes.boxes)))
            box_fields = {
                "boxes": frame_boxes.boxes,
                "instances": frame_boxes.instances,
                "box_weather": weather,
            }
        if "lidar" in load and (path := row["lidar_path"]) is not None:
            sweep = self.read_parsed("lidar", path, read_lidar)
        return Labels(**box_fields, lidar=sweep)

    def _box_weather(self, row: Row, count: int) -> Iterator[tuple[str, BoxNumbers]]:
        """Yield the kind and the numbers of each table of weather at the boxes of the row's
        image.
        """
        for kind, table in box_tables().items():
            if (path := row[f"{kind}_path"]) is None or not table.sample_columns:
                continue
            numbers = self.read_parsed(kind, path, table.read).get((row["frame"], row["camera"]))
            with self._named(path):
                if numbers is None:
                    raise ValueError(f"it lacks {_item_text(row)}")
                if (boxes := len(numbers.track_ids)) != count:
                    raise ValueError(
                        f"{_item_text(row)}: it has {boxes} boxes, the labels have {count}"
                    )
            yield kind, numbers

    def read_parsed(self, kind: str, path: str, parse_file: Callable[[Path], Any]) -> Any:
        """Return the result of `parse_file` for a file of a kind.

        Results are cached for each kind: the last used one, and more of them while they have at
        most CACHED_ENTRIES together.
        """
        parsed_files = self._parsed[kind]
        if path not in parsed_files:
            parsed_files[path] = self._parse(path, parse_file)
            num_entries = sum(map(len, parsed_files.values()))
            while num_entries > CACHED_ENTRIES and len(parsed_files) > 1:
                num_entries -= len(parsed_files.popitem(last=False)[1])
        parsed_files.move_to_end(path)
        return parsed_files[path]

    def _parse(self, path: str, parse_file: Callable[[Path], Any]) -> Any:
        """Return the result of `parse_file`; a file of an object store is parsed from a copy."""
        if self.store.local_dir is not None:
            return parse_file(resolve_inside(self.store.local_dir, path))
        data = self._read(path)
        with tempfile.TemporaryDirectory(prefix="climategs-") as scratch:
            copy = Path(scratch) / PurePosixPath(path).name
            copy.write_bytes(data)
            try:
                return parse_file(copy)
            except OutputError as error:
                raise OutputError(str(error).replace(str(copy), self.name(path))) from error

    def _read(self, path: str) -> bytes:
        """Return the bytes of a file.

        Raises:
            OutputError: the file cannot be read.
        """
        try:
            if self.store.local_dir is None:
                return self.store.read(path)
            return self._read_here(self.store.local_dir, path)
        except (OSError, StoredFileMissing) as error:
            is_system = isinstance(error, OSError)
            why = error.strerror or str(error) if is_system else "there is no such file"
            raise OutputError(
                f"{self.name(path)} cannot be read ({why}), though the manifest lists it; run the "
                f"job again: it renders what is missing"
            ) from error

    def _read_here(self, root: Path, path: str) -> bytes:
        """Return the bytes of a file below `root`, which no link may lead out of."""
        folder, _, name = path.rpartition("/")
        if folder not in self._folders:
            self._folders[folder] = f"{resolve_inside(root, folder) if folder else root}/"
        try:
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC
            flags |= os.O_NONBLOCK  # without it, opening a pipe would wait
            descriptor = os.open(self._folders[folder] + name, flags)
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            return read_file(resolve_inside(root, path))  # a link may stay inside
        with open(descriptor, "rb", buffering=0) as file:
            return file.read()

    @contextmanager
    def _named(self, path: str, where: str = "") -> Iterator[None]:
        """Add the name of the file to errors that are raised while its content is read."""
        try:
            yield
        except (ArithmeticError, KeyError, RuntimeError, TypeError, ValueError) as error:
            fault = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
            raise OutputError(
                f"{self.name(path)} is damaged: {fault}{where}. Delete it and run the job again, "
                f"which renders it anew"
            ) from error


def _check_digest(data: bytes, checksum: str) -> None:
    """Raise ValueError unless the data have the checksum."""
    if hashlib.sha256(data).hexdigest() != checksum:
        raise ValueError(f"its SHA-256 is not the manifest's {checksum}")


def _check_size(image: np.ndarray, row: Row) -> None:
    """Raise ValueError unless the image has the row's size."""
    height, width = image.shape[:2]
    expected_width = row["width"]
    expected_height = row["height"]
    if (width, height) != (expected_width, expected_height):
        raise ValueError(
            f"it is {width}x{height}, the manifest says {expected_width}x{expected_height}"
        )


def _item_text(row: Row) -> str:
    """Return the frame and camera of a row as a text."""
    return f"frame {row['frame']}, camera {row['camera']!r}"


# ---- The dataset ---------------------------------------------------------------------------------


class WeatherDataset(Dataset):
    """The finished images of output folders, with depth, boxes, camera and weather.

    It holds the manifest only, in about a hundred bytes an image; files are read when asked for.
    Samples come in the manifest's order: scene, variant, frame, camera; output after output.

    Args:
        root: where jobs have written or are writing: a path, a URI (`s3://bucket/fog`), or an open
            store; or a list of them.
        where: Arrow expression over the manifest's columns, numbers and tags, such as
            `pyarrow.compute.field("smog_extinction_per_m") > 0.02`, or
            `pyarrow.compute.field("osi_fog").isin(["thick", "dense"])`.
        scenes: names of the scenes to keep; None for all.
        variants: names of the variants to keep; None for all.
        cameras: names of the cameras to keep; None for all.
        frames: numbers of the frames to keep; None for all.
        image_type: `float32` in [0, 1] or `uint8`.
        verify: if True, compare every image with its checksum, about 1 ms a megabyte.
        load: what to read, of image, depth, semantic, instance, water, snow, trust, boxes and
            lidar; others are None. None reads all but lidar.
        box_frame: axes of boxes and LiDAR points: `world`, the dataset's own, unchanged to the
            bit; `ego`, x forward, y left, z up; or `camera` (OpenCV), x right, y down, z forward.
        transform: called with every sample; its result is the sample.

    Raises:
        OutputError: no finished output folder; later, from indexing, a file that is missing,
            damaged, or outside the folder.
        ValueError: a name in a filter that no manifest has, a tag in `where` that rows of older
            versions lack, an unknown option, no root, or what `load` asks for is there for some
            variants and not for others (the masks of water and snow excepted, which only such
            weather has): batches would not stack.
    """

    def __init__(
        self,
        root: str | Path | Store | Sequence[str | Path | Store],
        *,
        where: Expression | None = None,
        scenes: Collection[str] | None = None,
        variants: Collection[str] | None = None,
        cameras: Collection[str] | None = None,
        frames: Collection[int] | None = None,
        image_type: ImageType = "float32",
        verify: bool = True,
        load: Collection[str] | None = None,
        box_frame: BoxFrame = "world",
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        self.options = SampleOptions.create(image_type, load, box_frame)
        self.transform = transform
        roots = [root] if isinstance(root, str | Path | Store) else list(root)
        if not roots:
            raise ValueError("root must be an output folder or a list of them; got an empty list")
        stores = [r if isinstance(r, Store) else open_store(r) for r in roots]
        self.uris = [store.uri for store in stores]  # in the order of `root`
        self._readers = {store.uri: RowReader(store, verify=verify) for store in stores}
        requested = {"scene": scenes, "variant": variants, "camera": cameras, "frame": frames}
        self.rows = _read_rows(stores, where, requested)
        _check_all_have(self.rows, self.options.load, self.uris)

    def available_kinds(self) -> frozenset[str]:
        """Return the kinds of data in `load` that the samples have, without the masks."""
        load = self.options.load.difference(mask_names())
        return frozenset(k for k in load if k == "image" or self.rows.has_file(k).any())

    @property
    def table(self) -> pa.Table:
        """Return the manifest's rows behind the samples, in their order, as a new table each
        time.
        """
        return self.rows.to_arrow()

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Any:
        sample = self.sample(index)
        return sample if self.transform is None else self.transform(sample)

    def sample(self, index: int, *, without: Collection[str] = ()) -> Sample:
        """Return one sample before `transform`.

        Args:
            index: number of the sample.
            without: names of `load` to leave out.
        """
        row = self.rows.row(check_index(index, len(self)))
        if get_worker_info() is not None:
            # The workers are the parallelism. Not 1: a worker forked after its parent used OpenCV's
            # threads would wait for theirs for ever.
            cv2.setNumThreads(0)
        reader = self._readers[row.get(_OUTPUT, self.uris[0])]
        load = self.options.load.difference(without)
        camera, world_from_ego = reader.camera(row)
        paths = {kind: row[f"{kind}_path"] for kind in path_kinds()}
        metadata = {
            "weather": {name: row[name] for name in self.rows.weather},
            "paths": {kind: path and reader.name(path) for kind, path in paths.items()},
        }
        return make_sample(
            options=self.options,
            images=reader.images(row, load),
            camera=camera,
            world_from_ego=world_from_ego,
            labels=reader.labels(row, load),
            metadata=metadata | {name: row[name] for name in NAMES},
        )

    def select(self, rows: np.ndarray) -> WeatherDataset:
        """Return the dataset of some samples, by numbers int64 [K], or by a mask bool [N]."""
        selection = object.__new__(WeatherDataset)
        selection.__dict__.update(self.__dict__, rows=self.rows.take(rows))
        return selection


def _read_rows(
    stores: Sequence[Store], where: Expression | None, requested: dict[str, Collection | None]
) -> Rows:
    """Return the finished rows of the stores that a filter keeps."""
    tables = [read_manifest_rows(store) for store in stores]
    uris = [store.uri for store in stores]
    table = tables[0]
    if len(stores) > 1:
        codes = np.repeat(np.arange(len(stores)), [len(table) for table in tables])
        outputs = pa.DictionaryArray.from_arrays(codes, uris)
        table = concat_rows(tables).append_column(_OUTPUT, outputs)
    rows = Rows.from_table(table)
    finished = mask = pc.equal(rows["status"], OK)
    for name, values in requested.items():
        if values is None:
            continue
        if isinstance(values, str):
            raise ValueError(f"{name}s must be a collection of names; got the string {values!r}")
        finished_values = pc.unique(rows[name].filter(finished))
        if unknown := sorted(set(values).difference(finished_values.to_pylist())):
            message = ", ".join(map(str, sorted(finished_values.to_pylist()))) or "none"
            raise ValueError(f"{', '.join(uris)}: no {name} {unknown}; finished are: {message}")
        mask = pc.and_(mask, pc.is_in(rows[name], pa.array(list(values), finished_values.type)))
    if where is not None:
        _check_has_tags(rows, finished, where, uris)
        columns = {"fits": where}
        fits = pyarrow.dataset.dataset(table).scanner(columns, use_threads=False).to_table()["fits"]
        mask = pc.and_(mask, fits.fill_null(False).combine_chunks())
    mask = mask.to_numpy(zero_copy_only=False)
    return rows if mask.all() else rows.take(mask)


def _check_has_tags(rows: Rows, finished: Any, where: Expression, uris: list[str]) -> None:
    """Raise ValueError if a filter names a class of weather that finished rows lack.

    Such rows are older than the columns, and would be left out in silence.

    Args:
        rows: all rows.
        finished: Arrow mask of the finished rows, [N].
        where: the filter.
        uris: the outputs.
    """
    names = set(re.findall(r"\w+", re.sub(r'"[^"]*"', "", str(where))))
    for name in CLASS_COLUMNS:
        if name in names and (num_lacking := rows[name].filter(finished).null_count):
            raise ValueError(
                f"where asks for {name}, and {num_lacking} of {pc.sum(finished).as_py()} finished "
                f"images of {', '.join(uris)} have none: an older version wrote them. "
                f"Filter by numbers, such as smog_extinction_per_m; `climategs tags` lists the "
                f"tags of any output"
            )


def _check_all_have(rows: Rows, load: Collection[str], uris: list[str]) -> None:
    """Raise ValueError if a kind of file to load exists for some variants and not for others.

    A single frame without labels or a sweep is no fault, as the recording may lack it.
    """
    first, group = rows.groups()
    variants_without_kind = {}
    for kind in sorted(set(load).difference(mask_names(), ["image"])):
        has_kind = np.bincount(group[rows.has_file(kind)], minlength=len(first)) > 0
        if has_kind.any() and not has_kind.all():
            variants_without_kind[kind] = _list_variants(
                [rows.row(int(row)) for row in first[~has_kind]], uris[0]
            )
    if not variants_without_kind:
        return
    message = "; ".join(
        f"{kind}: none in {variants}" for kind, variants in variants_without_kind.items()
    )
    names = tuple(kind for kind in loadable() if kind in load and kind not in variants_without_kind)
    raise ValueError(
        f"load asks for what only a part of the outputs has, so that batches would not stack. "
        f"{message}. Leave it out (load={names!r}), choose outputs, scenes or variants that are "
        f"alike, or render those again with it under the recipe's `output`"
    )


def _list_variants(variants: list[dict[str, Any]], uri: str) -> str:
    """Return a text that lists variants by output, three of each.

    Args:
        variants: a row of each variant.
        uri: the only output.
    """
    names = defaultdict(list)
    for row in variants:
        names[row.get(_OUTPUT, uri)].append(f"{row['scene']}/{row['variant']}")
    more = {uri: f" and {len(n) - 3} more" if len(n) > 3 else "" for uri, n in names.items()}
    return ", ".join(f"{uri} ({', '.join(n[:3])}{more[uri]})" for uri, n in names.items())
