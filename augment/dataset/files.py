"""The dataset over the files that jobs have written."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.dataset
from pyarrow.compute import Expression
from torch.utils.data import Dataset, get_worker_info

from augment.batch.manifest import OK, concat_rows
from augment.batch.parts import read_finished
from augment.batch.store import Store, open_store
from augment.dataset.boxes import BoxFrame
from augment.dataset.reading import RowReader
from augment.dataset.rows import Coded, Rows
from augment.dataset.samples import DEFAULT_LOAD, LOADABLE, ImageType, SampleOptions, make_sample

_NAMES = ("scene", "variant", "frame", "recipe_hash", "surface")
# What samples may lack beside others that have it: only such weather has these masks.
_MASKS = ("water", "snow")
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
        load: Collection[str] = DEFAULT_LOAD,
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
        wanted = {"scene": scenes, "variant": variants, "camera": cameras, "frame": frames}
        self.rows = _read_rows(self.stores, where, wanted)
        _check_all_have(self.rows, self.options.load, self.uris)

    def given(self) -> frozenset[str]:
        """What of `load` the samples have, the masks of water and snow left out."""
        load = self.options.load.difference(_MASKS)
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
    stores: Sequence[Store], where: Expression | None, wanted: dict[str, Collection | None]
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
    for name, values in wanted.items():
        if values is None:
            continue
        if isinstance(values, str):
            raise ValueError(f"{name}s must be a collection of names; got the string {values!r}")
        column = rows.coded(name)
        known = {column.values[code] for code in np.unique(column.codes[finished])}
        if unknown := sorted(set(values) - known):
            told = ", ".join(map(str, sorted(known))) or "none"
            raise ValueError(f"{', '.join(uris)}: no {name} {unknown}; finished are: {told}")
        keep &= _is_among(column, set(values))
    if fits is not None:
        keep &= fits
    return rows if keep.all() else rows.take(keep)


def _check_all_have(rows: Rows, load: Collection[str], uris: list[str]) -> None:
    """Raise ValueError where some variants have what is to be loaded, and others have none of it.

    A single frame without labels or a sweep is no fault: a dataset may lack its file.
    """
    groups, codes = rows.variants()
    lacking = {}
    for kind in sorted(set(load).difference(_MASKS, ["image"])):
        given = np.bincount(codes[rows.has(kind)], minlength=len(groups)) > 0
        if given.any() and not given.all():
            lacking[kind] = [group for group, there in zip(groups, given, strict=True) if not there]
    if not lacking:
        return
    told = "; ".join(f"{kind}: none in {_listed(found, uris)}" for kind, found in lacking.items())
    kept = tuple(kind for kind in LOADABLE if kind in load and kind not in lacking)
    raise ValueError(
        f"load asks for what only a part of the outputs has, so that batches would not stack. "
        f"{told}. Leave it out (load={kept!r}), choose outputs, scenes or variants that are alike, "
        f"or render those again with it under the recipe's `output`"
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
    wanted = np.array([value in values for value in column.values], bool)
    return wanted[column.codes] if len(wanted) else np.zeros(len(column), bool)
