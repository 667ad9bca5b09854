"""The dataset over the files that jobs have written."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.dataset
from pyarrow.compute import Expression
from torch.utils.data import Dataset, get_worker_info

from augment.batch.manifest import OK
from augment.batch.parts import read_finished
from augment.batch.store import Store, open_store
from augment.dataset.boxes import BoxFrame
from augment.dataset.reading import RowReader
from augment.dataset.rows import Coded, Rows
from augment.dataset.samples import DEFAULT_LOAD, ImageType, SampleOptions, make_sample

_NAMES = ("scene", "variant", "frame", "recipe_hash", "surface")
Sample = dict[str, Any]


class WeatherDataset(Dataset):
    """The finished images of an output folder, with depth, boxes, camera and weather.

    root: where jobs have written or are writing: a path, a URI (`s3://bucket/fog`), or an open
    store. where: an Arrow expression over the manifest's columns, such as
    `pyarrow.compute.field("smog_extinction_per_m") > 0.02`. scenes, variants, cameras, frames: what
    to keep, None for all. image_type: `float32` in [0, 1] or `uint8`. verify: compare every image
    with its checksum, about 1 ms a megabyte. load: what to read, of image, depth, semantic,
    instance, water, snow, boxes and lidar; all but lidar by default, and what is not read is None.
    box_frame: whose axes boxes and LiDAR points are in: `world`, the dataset's own, unchanged to
    the bit; `ego`, x forward, y left, z up; or `camera` (OpenCV), x right, y down, z forward.
    transform: called with every sample; what it returns is the sample.

    Holds the manifest only, in about a hundred bytes an image; files are read when asked for.
    Samples come in the manifest's order: scene, variant, frame, camera.

    Raises:
        OutputError: no finished output folder; later, from indexing, a file that is missing,
            damaged, or outside the folder.
        ValueError: a name in a filter that the manifest does not have, or an unknown option.
    """

    def __init__(
        self,
        root: str | Path | Store,
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
        self.store = open_store(root) if isinstance(root, str | Path) else root
        self._reader = RowReader(self.store, verify=verify)
        wanted = {"scene": scenes, "variant": variants, "camera": cameras, "frame": frames}
        self.rows = _read_rows(self.store, where, wanted)

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
        row, rows, reader = index % count, self.rows, self._reader
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
    store: Store, where: Expression | None, wanted: dict[str, Collection | None]
) -> Rows:
    """The finished rows of a store that a filter keeps."""
    table = read_finished(store)
    fits = None if where is None else _fitting(table, where)
    rows = Rows.of(table)
    del table
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
            raise ValueError(f"{store.uri} has no {name} {unknown}; finished are: {told}")
        keep &= _is_among(column, set(values))
    if fits is not None:
        keep &= fits
    return rows if keep.all() else rows.take(keep)


def _fitting(table: pa.Table, where: Expression) -> np.ndarray:
    """bool [N]: rows for which an expression is true."""
    columns = {"fits": where}
    found = pyarrow.dataset.dataset(table).scanner(columns=columns, use_threads=False).to_table()
    return found["fits"].fill_null(False).to_numpy()


def _is_among(column: Coded, values: set[Any]) -> np.ndarray:
    wanted = np.array([value in values for value in column.values], bool)
    return wanted[column.codes] if len(wanted) else np.zeros(len(column), bool)
