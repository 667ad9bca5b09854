"""The dataset over the files that jobs have written."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.dataset
import torch
from pyarrow.compute import Expression
from torch.utils.data import Dataset, get_worker_info

from augment.cameras import Camera, Frame
from augment.dataset.samples import (
    BoxFrame,
    ImageType,
    Labels,
    Pixels,
    SampleOptions,
    buffer_names,
    loadable,
    make_sample,
)
from augment.effects import Sharing, share_effects
from augment.errors import BackendUnavailable, OutputError
from augment.jobs.box_tables import BoxNumbers, Item
from augment.jobs.files import (
    CameraRecord,
    SceneIndex,
    View,
    box_tables,
    camera_record,
    check_view,
    decode_image,
    decode_png,
    encode_image,
    label_view,
    quantise_depth,
    read_camera,
    read_entries,
    select_frames,
    uses_boxes,
)
from augment.jobs.layout import mask_names, path_kinds, resolve_inside, variant_name
from augment.jobs.manifest import OK, concat_rows, read_finished, weather_columns
from augment.jobs.processes import choose_backend
from augment.jobs.quality import resolve_quality
from augment.jobs.store import Store, StoredFileMissing, open_store
from augment.jobs.tables import FrameBoxes, read_boxes, read_lidar
from augment.jobs.worker import Renderer, default_renderer
from augment.labels import LidarSweep
from augment.memo import memo_of
from augment.render.buffers import CUDA
from augment.scene import Scene
from recipes.files import with_digest
from recipes.schema import Recipe

# ---- A PyTorch dataset that renders a scene under one recipe when a sample is asked for ----------

_FORKED = (
    "backend 'cuda' cannot render in a forked process, which the GPU does not answer: give the "
    "DataLoader num_workers=0 or multiprocessing_context='spawn', or take backend 'cpu'"
)


class SceneDataset(Dataset):
    """The samples that `WeatherDataset` would read after a job, without writing anything.

    The pixels are those of the files: depth is in steps of 1/256 m, and where the recipe writes
    JPEG the image passes through JPEG in memory. `paths` holds only None.

    What all images share (where snow can lie, the maps of a style) is found here, once for all
    samples and worker processes. So are the settings of a recipe whose quality has still to choose
    them: `recipe` has them in numbers.

    scene: an open scene. frames, cameras: what to keep, None for all. backend: as in `rasterize`;
    "auto" never takes a GPU, which processes that a DataLoader forks could not use. "cuda" is for
    samples of this process, or of workers that are started afresh (`spawn`).
    renderer: `augment.views.render_view` if None. load, box_frame, transform: as for
    `WeatherDataset`; a live scene passes no sweeps on.

    Raises:
        SceneError: an unknown frame or camera, or the scene cannot have the recipe's snow.
        RecipeError, StyleError: a file of the recipe's style cannot be used.
        BackendUnavailable: the backend.
        ValueError: the backend, or an unknown option.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        *,
        frames: Sequence[int] | None = None,
        cameras: Sequence[str] | None = None,
        backend: str = "auto",
        image_type: ImageType = "float32",
        renderer: Renderer | None = None,
        load: Collection[str] | None = None,
        box_frame: BoxFrame = "world",
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        self.options = SampleOptions.checked(image_type, load, box_frame)
        if load is not None and "lidar" in load:
            raise ValueError(
                "load must not have 'lidar' for a live scene: run a job with output: {lidar: true} "
                "and read it with WeatherDataset"
            )
        self.scene, self.transform = scene, transform
        self._backend = backend
        if renderer is None:
            self._backend = choose_backend(backend, scene, gpu=False)
        self._process = os.getpid()
        recipe = with_digest(recipe)
        self.recipe = resolve_quality(
            recipe, scene, backend=self._backend, renderer=renderer
        ).recipe
        self._renderer = renderer or default_renderer()
        self._index = SceneIndex.of(scene)
        selection = select_frames(self._index, frames, cameras)
        self._items = [(frame, name) for frame, names in selection for name in names]

        share_effects(Sharing(scene, [self.recipe], backend=self._backend))
        self._memo = memo_of(scene).shared()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """In another process the scene is another object, whose memo is empty."""
        self.__dict__.update(state)
        self._process = os.getpid()
        memo_of(self.scene).update(self._memo)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of a dataset of {len(self)}")
        sample = self._render(*self._items[index])
        return sample if self.transform is None else self.transform(sample)

    def _render(self, frame: Frame, name: str) -> dict[str, Any]:
        camera, recipe, load = frame.cameras[name], self.recipe, self.options.load
        if self._backend == CUDA and self._process != os.getpid():  # not unpickled: forked
            raise BackendUnavailable(_FORKED)
        view = self._renderer(self.scene, camera, recipe, backend=self._backend)
        written = camera.scaled(recipe.render.scale)
        check_view(view, written, recipe)
        origin_m = self._index.world_origin_m
        view, labels = self._labelled(frame, written, view)
        world_from_ego = frame.world_from_ego.clone()
        world_from_ego[:3, 3] += torch.from_numpy(origin_m)
        return make_sample(
            options=self.options,
            pixels=self._pixels(view),
            camera=camera_record(written, origin_m),
            world_from_ego=world_from_ego,
            labels=labels if "boxes" in load else Labels(),
            weather={n: v for n, v in recipe.columns().items() if isinstance(v, float)},
            paths=dict.fromkeys(path_kinds()),
            names={
                "scene": self.scene.name,
                "variant": variant_name(recipe),
                "frame": frame.index,
                "recipe_hash": recipe.hash,
                "surface": recipe.output.surface,
            },
        )

    def _pixels(self, view: View) -> Pixels:
        """What of a view the samples hold, as files would."""
        load, output, rgb = self.options.load, self.recipe.output, None
        if "image" in load:
            rgb = view.rgb
            if output.image != "png":
                rgb = decode_image(encode_image(rgb, output))
        depth = None if view.depth_m is None else quantise_depth(view.depth_m)
        buffers = {"depth": depth, "semantic": view.semantic, "instance": view.instance}
        masks = {name: mask for name, mask in view.masks.items() if name in load}
        return Pixels(rgb, **{k: b for k, b in buffers.items() if k in load}, masks=masks)

    def _labelled(self, frame: Frame, camera: Camera, view: View) -> tuple[View, Labels]:
        """A view with the boxes of its frame, and these as the files of a job would have them.
        camera: as written.
        """
        load, recipe, index = self.options.load, self.recipe, self._index
        requested = "boxes" in load or "instance" in load
        if not (requested and uses_boxes(recipe) and frame.index in index.labelled):
            return view, Labels()
        boxes = self.scene.boxes(frame.index)
        view, measured = label_view(
            boxes, index.instances, index.world_origin_m, camera, view, recipe
        )
        if not recipe.output.labels:
            return view, Labels()
        return view, Labels(boxes, measured, instances=index.instances.of(boxes.track_ids))


# ---- A manifest's rows in a fifth of its memory, with random access to single ones ---------------
# Most of a row in an Arrow table (440 bytes with short names, 84 here) are paths and names that
# repeat. Here a column is its distinct values and one small number a row; paths are split into
# folder and file name, of which there are few. Rows are NumPy arrays, so forked workers share them.

pc: Any = pyarrow.compute  # type checkers do not see the functions that it makes on import
_PATH = r"(?s)^(?P<folder>.*/)?(?P<name>[^/]*)$"  # the folder with its slash
_MAX_CODES = 1 << 16  # numbers of more distinct values are kept as they are
_DIGEST = "V32"  # a SHA-256


@runtime_checkable
class Column(Protocol):
    """One column: a value by its row, or as an Arrow array."""

    def __getitem__(self, row: int) -> Any: ...
    def take(self, rows: np.ndarray) -> Column: ...
    @property
    def nbytes(self) -> int: ...
    def arrow(self, kind: pa.DataType) -> pa.Array: ...


@dataclass(frozen=True, eq=False)
class Coded:
    """values: the distinct ones. codes: unsigned [N], which of them a row has."""

    codes: np.ndarray
    values: list[Any]

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, row: int) -> Any:
        return self.values[self.codes[row]]

    @property
    def nbytes(self) -> int:
        return self.codes.nbytes

    def take(self, rows: np.ndarray) -> Coded:
        return Coded(self.codes[rows], self.values)

    def arrow(self, kind: pa.DataType) -> pa.Array:
        return pa.array(self.values, kind).take(pa.array(self.codes))


@dataclass(frozen=True, eq=False)
class Numbers:
    """A number a row, or a SHA-256 (of type _DIGEST), whose value is its hexadecimal digits."""

    numbers: np.ndarray

    def __getitem__(self, row: int) -> Any:
        value = self.numbers[row]
        return value.tobytes().hex() if self.numbers.dtype == _DIGEST else value.item()

    @property
    def nbytes(self) -> int:
        return self.numbers.nbytes

    def take(self, rows: np.ndarray) -> Numbers:
        return Numbers(self.numbers[rows])

    def arrow(self, kind: pa.DataType) -> pa.Array:
        is_digest = self.numbers.dtype == _DIGEST
        return pa.array(list(self) if is_digest else self.numbers, kind)

    def __iter__(self) -> Iterator[Any]:
        return (self[row] for row in range(len(self.numbers)))


@dataclass(frozen=True, eq=False)
class Paths:
    """folders, names: whose texts joined are the path; None where a row has none."""

    folders: Coded
    names: Coded

    def __getitem__(self, row: int) -> str | None:
        parts = self.parts(row)
        return None if parts is None else parts[0] + parts[1]

    def parts(self, row: int) -> tuple[str, str] | None:
        """The folder, with its slash or empty, and the file's name."""
        name = self.names[row]
        return None if name is None else (self.folders[row], name)

    @property
    def nbytes(self) -> int:
        return self.folders.nbytes + self.names.nbytes

    def take(self, rows: np.ndarray) -> Paths:
        return Paths(self.folders.take(rows), self.names.take(rows))

    def arrow(self, kind: pa.DataType) -> pa.Array:
        return pc.binary_join_element_wise(self.folders.arrow(kind), self.names.arrow(kind), "")


@dataclass(frozen=True, eq=False)
class Rows:
    """Columns of equal length by name. schema: the manifest's, in its order of columns. weather:
    the names of the columns that hold weather numbers.
    """

    columns: Mapping[str, Column]
    schema: pa.Schema
    weather: tuple[str, ...]

    @staticmethod
    def of(table: pa.Table) -> Rows:
        """The rows of a manifest; its columns ending in `_path` hold paths."""
        schema, weather = table.schema, tuple(weather_columns(table))
        return Rows(dict(_packed_columns(table)), schema, weather)

    def __len__(self) -> int:
        return len(self.coded("status"))

    def __getitem__(self, name: str) -> Column:
        return self.columns[name]

    @property
    def nbytes(self) -> int:
        """Of the columns' arrays; their distinct values come on top."""
        return sum(column.nbytes for column in self.columns.values())

    def take(self, rows: np.ndarray) -> Rows:
        """The rows of these numbers, or where a mask is true."""
        columns = {name: column.take(rows) for name, column in self.columns.items()}
        return Rows(columns, self.schema, self.weather)

    def coded(self, name: str) -> Coded:
        """A column of names or of other values that repeat. Raises TypeError: the column is none of
        those.
        """
        column = self.columns[name]
        if isinstance(column, Numbers):  # numbers that hardly repeat
            values, codes = np.unique(column.numbers, return_inverse=True)
            return Coded(_smallest(codes, len(values)), values.tolist())
        if not isinstance(column, Coded):
            raise TypeError(f"column {name!r} holds {type(column).__name__}, not names or numbers")
        return column

    def with_outputs(self, uris: list[str], lengths: list[int]) -> Rows:
        """The rows with a column `output`: the first rows are of the first URI, and so on."""
        codes = _smallest(np.repeat(np.arange(len(uris)), lengths), len(uris))
        schema = self.schema.append(pa.field("output", pa.string()))
        return Rows({**self.columns, "output": Coded(codes, list(uris))}, schema, self.weather)

    def output_of(self, row: int) -> int:
        """Which of several outputs a row is of, by its number."""
        return int(self.coded("output").codes[row]) if "output" in self.columns else 0

    def variants(self) -> tuple[list[tuple[int, str, str]], np.ndarray]:
        """The output's number, scene and variant of all that there are, and which of them each row
        is of, int64 [N].
        """
        scenes, variants = self.coded("scene"), self.coded("variant")
        keys = scenes.codes.astype(np.int64) * len(variants.values) + variants.codes
        if "output" in self.columns:
            outputs = self.coded("output").codes.astype(np.int64)
            keys += outputs * len(scenes.values) * len(variants.values)
        found, codes = np.unique(keys, return_inverse=True)
        rest, variant = np.divmod(found, max(len(variants.values), 1))
        output, scene = np.divmod(rest, max(len(scenes.values), 1))
        each = zip(output.tolist(), scene.tolist(), variant.tolist(), strict=True)
        return [(o, scenes.values[s], variants.values[v]) for o, s, v in each], codes

    def has(self, kind: str) -> np.ndarray:
        """bool [N]: the rows that name a file of a kind of `samples.loadable`."""
        column = self.columns[f"{'labels' if kind == 'boxes' else kind}_path"]
        assert isinstance(column, Paths)
        there = np.array([name is not None for name in column.names.values], bool)
        return there[column.names.codes] if len(there) else np.zeros(len(self), bool)

    def numbers(self, name: str) -> np.ndarray:
        """A numeric column, [N]; null is NaN. Raises TypeError: the column holds no numbers."""
        column = self.columns[name]
        if isinstance(column, Numbers):
            return column.numbers
        kind = self.schema.field(name).type
        if not (
            isinstance(column, Coded) and (pa.types.is_integer(kind) or pa.types.is_floating(kind))
        ):
            raise TypeError(f"column {name!r} holds {kind}, not numbers")
        is_whole = pa.types.is_integer(kind) and None not in column.values
        values = np.array(column.values, np.int64 if is_whole else np.float64)
        return values[column.codes] if len(values) else np.zeros(0, values.dtype)

    def to_arrow(self) -> pa.Table:
        """The manifest's rows again."""
        arrays = [self.columns[field.name].arrow(field.type) for field in self.schema]
        return pa.Table.from_arrays(arrays, schema=self.schema)


def _packed_columns(table: pa.Table) -> Iterator[tuple[str, Column]]:
    for name in table.column_names:
        column = table[name]
        table = table.drop_columns(name)  # its memory is free as soon as it is packed
        yield name, _packed(name, column)


def _packed(name: str, column: pa.ChunkedArray) -> Column:
    if name.endswith("_path") and pa.types.is_string(column.type):
        parts: Any = pc.extract_regex(column, _PATH)
        folders, names = parts.combine_chunks().flatten() if len(column) else (column, column)
        return Paths(_coded(pa.chunked_array([folders])), _coded(pa.chunked_array([names])))
    if name == "checksum" and (digests := _digests(column)) is not None:
        return Numbers(digests)
    coded = _coded(column)
    is_number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
    if is_number and len(coded.values) > _MAX_CODES and column.null_count == 0:
        return Numbers(column.to_numpy())
    return coded


def _coded(column: pa.ChunkedArray) -> Coded:
    # Nulls have no code in Arrow: they get the one behind the last.
    encoded: Any = column.dictionary_encode().unify_dictionaries()
    values = encoded.chunk(0).dictionary.to_pylist() if encoded.num_chunks else []
    indices = [chunk.indices.fill_null(len(values)) for chunk in encoded.chunks]
    codes = pa.chunked_array(indices, pa.int32()).to_numpy()
    if column.null_count:
        values = [*values, None]
    return Coded(_smallest(codes, len(values)), values)


def _smallest(codes: np.ndarray, count: int) -> np.ndarray:
    """Codes below `count` in as few bytes as hold them."""
    return codes.astype(np.min_scalar_type(max(count - 1, 0)))


def _digests(column: pa.ChunkedArray) -> np.ndarray | None:
    """[N] of a column of SHA-256 in lower-case digits; None where it is not one."""
    if column.null_count or not pc.all(pc.match_substring_regex(column, "^[0-9a-f]{64}$")).as_py():
        return None
    return np.frombuffer(bytes.fromhex("".join(column.to_pylist())), _DIGEST)


# ---- The files that a manifest names, read from this machine or from an object store -------------
# A manifest may come from anybody, so no path leaves the output folder, by `..` or through a link.
# Checking that takes longer than opening a file, so a folder's way is checked once, and a file
# itself is opened such that it cannot be a link.


Value = TypeVar("Value")
SizedValue = TypeVar("SizedValue", bound=Sized)

CACHED_ENTRIES = 4096  # of companion files, each a frame's or an image's: tens of megabytes
_FLAGS = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
_CAN_REFUSE_LINKS = hasattr(os, "O_NOFOLLOW")


class StoredFiles:
    """Reads the files of an output folder by the manifest's paths; picklable."""

    def __init__(self, store: Store) -> None:
        self.store = store
        root, mark, query = store.uri.partition("?")
        if store.local_dir is not None:
            root, mark, query = str(store.local_dir), "", ""
        self._before, self._after = root.rstrip("/") + "/", mark + query
        self._folders: dict[str, str] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_folders": {}}

    def name(self, folder: str, name: str) -> str:
        """What a file is called in messages and samples: its path here, or its URI."""
        return f"{self._before}{folder}{name}{self._after}"

    def read(self, folder: str, name: str) -> bytes:
        """The bytes of a file. folder: with its slash, or empty."""
        try:
            if self.store.local_dir is None:
                return self.store.read(folder + name)
            return self._read_here(self.store.local_dir, folder, name)
        except StoredFileMissing as error:
            raise _unreadable(self.name(folder, name), "there is no such file") from error
        except OSError as error:
            raise _unreadable(self.name(folder, name), error.strerror or str(error)) from error

    def parse(self, folder: str, name: str, read: Callable[[Path], Value]) -> Value:
        """What `read` makes of a file."""
        if self.store.local_dir is not None:
            return read(resolve_inside(self.store.local_dir, folder + name))
        data = self.read(folder, name)
        with tempfile.TemporaryDirectory(prefix="climategs-") as scratch:
            copy = Path(scratch) / PurePosixPath(name).name
            copy.write_bytes(data)
            try:
                return read(copy)
            except OutputError as error:
                message = str(error).replace(str(copy), self.name(folder, name))
                raise OutputError(message) from error

    def _read_here(self, root: Path, folder: str, name: str) -> bytes:
        if not _CAN_REFUSE_LINKS or name in ("", ".", "..") or "\\" in name or "\0" in name:
            return resolve_inside(root, folder + name).read_bytes()
        try:
            descriptor = os.open(self._folder(root, folder) + name, _FLAGS)
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            return resolve_inside(root, folder + name).read_bytes()  # a link may stay inside
        with open(descriptor, "rb", buffering=0) as file:
            return file.read()

    def _folder(self, root: Path, folder: str) -> str:
        if folder not in self._folders:
            checked = resolve_inside(root, folder) if folder else root
            self._folders[folder] = f"{checked}/"
        return self._folders[folder]


class Companions(Generic[SizedValue]):
    """Parsed files beside the images, the last used ones kept. read: what makes something with
    entries of a file. At least one file is kept, and others as long as they have no more than
    CACHED_ENTRIES together.
    """

    def __init__(self, files: StoredFiles, read: Callable[[Path], SizedValue]) -> None:
        self._files, self._read = files, read
        self._values: OrderedDict[tuple[str, str], SizedValue] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_values": OrderedDict()}

    def get(self, folder: str, name: str) -> SizedValue:
        key = (folder, name)
        if key not in self._values:
            self._values[key] = self._files.parse(folder, name, self._read)
            held = sum(map(len, self._values.values()))
            while held > CACHED_ENTRIES and len(self._values) > 1:
                held -= len(self._values.popitem(last=False)[1])
        self._values.move_to_end(key)
        return self._values[key]


def damaged(file: str, what: str) -> OutputError:
    """The error of a file that holds something else than it should."""
    return OutputError(
        f"{file} is damaged: {what}. Delete it and run the job again, which renders it anew"
    )


def _unreadable(file: str, why: str) -> OutputError:
    return OutputError(
        f"{file} cannot be read ({why}), though the manifest lists it; run the job again: it "
        f"renders what is missing"
    )


# ---- What the files of one manifest row hold -----------------------------------------------------

_TYPES = {"depth": np.uint16, "instance": np.uint16}  # others are of 8 bits


class RowReader:
    """Reads what the rows of a manifest name, from one store. verify: compare checksums."""

    def __init__(self, store: Store, *, verify: bool) -> None:
        self.store, self.verify = store, verify
        self._files = StoredFiles(store)
        self._boxes = Companions(self._files, read_boxes)
        self._box_weather = {
            k: Companions(self._files, partial(_read_numbers, k)) for k in box_tables()
        }
        self._calibration = Companions(self._files, read_entries)
        self._sweeps = Companions(self._files, _read_one_sweep)

    def names(self, rows: Rows, row: int) -> dict[str, str | None]:
        """The row's files by kind, as they are called here."""
        found = {kind: _parts(rows, row, kind) for kind in path_kinds()}
        return {
            k: None if parts is None else self._files.name(*parts) for k, parts in found.items()
        }

    def pixels(self, rows: Rows, row: int, load: Collection[str]) -> Pixels:
        """The row's image and buffers, those of `load`."""
        images = {}
        if "image" in load:
            images["rgb"] = self._image(rows, row)
        for kind in buffer_names():
            parts = _parts(rows, row, kind) if kind in load else None
            if parts is not None:
                images[kind] = self._decoded(
                    parts, lambda data, k=kind: decode_png(data, _TYPES.get(k, np.uint8))
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
        masks = {name: images.pop(name) for name in mask_names() if name in images}
        return Pixels(**images, masks=masks)

    def camera(self, rows: Rows, row: int) -> tuple[CameraRecord, torch.Tensor]:
        """The row's camera, and world_from_ego, float64 [4, 4]."""
        parts = self._needed(rows, row, "calibration")
        frame, camera = rows["frame"][row], rows["camera"][row]
        try:
            entry = self._calibration.get(*parts)[frame]
            ego = torch.tensor(entry["world_from_ego"], dtype=torch.float64)
            return read_camera(entry, camera), ego
        except (ArithmeticError, KeyError, RuntimeError, TypeError, ValueError) as error:
            what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
            where = f"frame {frame}, camera {camera!r}"
            raise damaged(self._files.name(*parts), f"{what} ({where})") from error

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
                message = f"{where}: it has {boxes} boxes, the labels have {count}"
                raise damaged(self._files.name(*parts), message)
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


def _read_numbers(kind: str, path: Path) -> dict[Item, BoxNumbers]:
    """By the table's name: tables hold functions, which do not travel to other processes."""
    return box_tables()[kind].read(path)


def _read_one_sweep(path: Path) -> tuple[LidarSweep]:
    return (read_lidar(path),)


# ---- The dataset ---------------------------------------------------------------------------------

_NAMES = ("scene", "variant", "frame", "recipe_hash", "surface")
Sample = dict[str, Any]


class WeatherDataset(Dataset):
    """The finished images of output folders, with depth, boxes, camera and weather.

    root: where jobs have written or are writing: a path, a URI (`s3://bucket/fog`), or an open
    store; or a list of them. where: an Arrow expression over the manifest's columns, such as
    `pyarrow.compute.field("smog_extinction_per_m") > 0.02`. scenes, variants, cameras, frames: what
    to keep, None for all. image_type: `float32` in [0, 1] or `uint8`. verify: compare every image
    with its checksum, about 1 ms a megabyte. load: what to read, of image, depth, semantic,
    instance, water, snow, boxes and lidar; all but lidar by default, and what is not read is None.
    box_frame: whose axes boxes and LiDAR points are in: `world`, the dataset's own, unchanged to
    the bit; `ego`, x forward, y left, z up; or `camera` (OpenCV), x right, y down, z forward.
    transform: called with every sample; what it returns is the sample.

    Holds the manifest only, in about a hundred bytes an image; files are read when asked for.
    Samples come in the manifest's order: scene, variant, frame, camera; output after output.

    Raises:
        OutputError: no finished output folder; later, from indexing, a file that is missing,
            damaged, or outside the folder.
        ValueError: a name in a filter that no manifest has, an unknown option, no root, or what
            `load` asks for is there for some variants and not for others (the masks of water and
            snow excepted, which only such weather has): batches would not stack.
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
        self.options = SampleOptions.checked(image_type, load, box_frame)
        self.transform = transform
        roots = [root] if isinstance(root, str | Path | Store) else list(root)
        if not roots:
            raise ValueError("root must be an output folder or a list of them; got an empty list")
        self.stores = [r if isinstance(r, Store) else open_store(r) for r in roots]
        self._readers = [RowReader(store, verify=verify) for store in self.stores]
        requested = {"scene": scenes, "variant": variants, "camera": cameras, "frame": frames}
        self.rows = _read_rows(self.stores, where, requested)
        _check_all_have(self.rows, self.options.load, self.uris)

    def given(self) -> frozenset[str]:
        """What of `load` the samples have, the masks of water and snow left out."""
        load = self.options.load.difference(mask_names())
        return frozenset(k for k in load if k == "image" or self.rows.has(k).any())

    @property
    def uris(self) -> list[str]:
        """Of the outputs, in the order of `root`."""
        return [store.uri for store in self.stores]

    @property
    def table(self) -> pa.Table:
        """The manifest's rows behind the samples, in their order; put together anew each time."""
        return self.rows.to_arrow()

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Any:
        sample = self.sample(index)
        return sample if self.transform is None else self.transform(sample)

    def sample(self, index: int, *, without: Collection[str] = ()) -> Sample:
        """One sample as it is before `transform`. without: what of `load` to leave out."""
        count = len(self)
        if not -count <= index < count:
            raise IndexError(f"sample {index} of a dataset of {count}")
        if get_worker_info() is not None:
            # The workers are the parallelism. Not 1: a worker forked after its parent used OpenCV's
            # threads would wait for theirs for ever.
            cv2.setNumThreads(0)
        row, rows = index % count, self.rows
        reader = self._readers[rows.output_of(row)]
        load = self.options.load.difference(without)
        camera, world_from_ego = reader.camera(rows, row)
        return make_sample(
            options=self.options,
            pixels=reader.pixels(rows, row, load),
            camera=camera,
            world_from_ego=world_from_ego,
            labels=reader.labels(rows, row, load),
            weather={name: rows[name][row] for name in rows.weather},
            paths=reader.names(rows, row),
            names={name: rows[name][row] for name in _NAMES},
        )

    def select(self, rows: np.ndarray) -> WeatherDataset:
        """The dataset of some samples: their numbers int64 [K], or a mask bool [N]."""
        chosen = object.__new__(WeatherDataset)
        chosen.__dict__.update(self.__dict__, rows=self.rows.take(rows))
        return chosen


def _read_rows(
    stores: Sequence[Store], where: Expression | None, requested: dict[str, Collection | None]
) -> Rows:
    """The finished rows of the stores that a filter keeps."""
    tables = [read_finished(store) for store in stores]
    lengths, uris = [len(table) for table in tables], [store.uri for store in stores]
    table = tables[0] if len(tables) == 1 else concat_rows(tables)
    fits = None if where is None else _fitting(table, where)
    rows = Rows.of(table)
    del tables, table
    if len(stores) > 1:
        rows = rows.with_outputs(uris, lengths)
    finished = _is_among(rows.coded("status"), {OK})
    keep = finished.copy()
    for name, values in requested.items():
        if values is None:
            continue
        if isinstance(values, str):
            raise ValueError(f"{name}s must be a collection of names; got the string {values!r}")
        column = rows.coded(name)
        known = {column.values[code] for code in np.unique(column.codes[finished])}
        if unknown := sorted(set(values) - known):
            message = ", ".join(map(str, sorted(known))) or "none"
            raise ValueError(f"{', '.join(uris)}: no {name} {unknown}; finished are: {message}")
        keep &= _is_among(column, set(values))
    if fits is not None:
        keep &= fits
    return rows if keep.all() else rows.take(keep)


def _check_all_have(rows: Rows, load: Collection[str], uris: list[str]) -> None:
    """Raise ValueError where some variants have what is to be loaded, and others have none of it. A
    single frame without labels or a sweep is no fault: a dataset may lack its file.
    """
    groups, codes = rows.variants()
    lacking = {}
    for kind in sorted(set(load).difference(mask_names(), ["image"])):
        given = np.bincount(codes[rows.has(kind)], minlength=len(groups)) > 0
        if given.any() and not given.all():
            lacking[kind] = [group for group, there in zip(groups, given, strict=True) if not there]
    if not lacking:
        return
    message = "; ".join(
        f"{kind}: none in {_listed(found, uris)}" for kind, found in lacking.items()
    )
    kept = tuple(kind for kind in loadable() if kind in load and kind not in lacking)
    raise ValueError(
        f"load asks for what only a part of the outputs has, so that batches would not stack. "
        f"{message}. Leave it out (load={kept!r}), choose outputs, scenes or variants that are "
        f"alike, or render those again with it under the recipe's `output`"
    )


def _listed(variants: list[tuple[int, str, str]], uris: list[str]) -> str:
    """Variants by their outputs, as a text; the first three of each."""
    names = defaultdict(list)
    for output, scene, variant in variants:
        names[uris[output]].append(f"{scene}/{variant}")
    more = {uri: f" and {len(n) - 3} more" if len(n) > 3 else "" for uri, n in names.items()}
    return ", ".join(f"{uri} ({', '.join(n[:3])}{more[uri]})" for uri, n in names.items())


def _fitting(table: pa.Table, where: Expression) -> np.ndarray:
    """bool [N]: rows for which an expression is true."""
    columns = {"fits": where}
    found = pyarrow.dataset.dataset(table).scanner(columns=columns, use_threads=False).to_table()
    return found["fits"].fill_null(False).to_numpy()


def _is_among(column: Coded, values: set[Any]) -> np.ndarray:
    requested = np.array([value in values for value in column.values], bool)
    return requested[column.codes] if len(requested) else np.zeros(len(column), bool)
