"""An output's images as views with depth, and which pairs of them are compared."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from augment.cameras import Camera
from augment.dataset.clips_pairs import clean_mask
from augment.dataset.weather_dataset import Companions, RowReader, Rows, StoredFiles
from augment.errors import OutputError
from augment.geometry import invert_rigid
from augment.jobs.files import depth_in_metres
from augment.jobs.manifest import OK, read_finished
from augment.jobs.store import Store
from augment.jobs.tables import read_boxes
from augment.metrics.consistency import ActorPaths, DepthView
from tools.report_pictures import evenly

SHORT, LONG, CAMERAS = "short", "long", "cameras"
KINDS = (SHORT, LONG, CAMERAS)
MAX_ANGLE_DEG = 90.0  # between the optical axes of neighbouring cameras
_BUFFERS = ("image", "depth", "water", "instance")
_KEPT = 12  # decoded views; a pair of frames needs 2, the cameras of a frame mostly 6 or 7


@dataclass(frozen=True, eq=False)
class View:
    """An image with its depth. shows_water, shows_actor: bool [H, W], None where no file says."""

    depth_view: DepthView
    shows_water: np.ndarray | None
    shows_actor: np.ndarray | None


@dataclass(frozen=True)
class Pair:
    """Rows of the manifest: b is warped into a."""

    kind: str
    a: int
    b: int


@dataclass(frozen=True, eq=False)
class Drive:
    """The images of one variant of one scene. rows: by (frame, camera)."""

    scene: str
    variant: str
    recipe: str
    effects: str
    rows: dict[tuple[int, str], int]


class Views:
    """Reads the views of an output, the last ones kept.

    scenes, recipes: which to keep; None for all.

    Raises:
        OutputError: nothing is finished there, or nothing of these scenes and recipes.
    """

    def __init__(
        self,
        store: Store,
        scenes: Sequence[str] | None = None,
        recipes: Sequence[str] | None = None,
    ) -> None:
        table = read_finished(store)
        table = table.filter(pc.equal(table["status"], OK))
        for column, wanted in (("scene", scenes), ("recipe", recipes)):
            if wanted is None:
                continue
            there = set(pc.unique(table[column]).to_pylist())
            if unknown := sorted(set(wanted) - there):
                raise OutputError(
                    f"{store.uri} has no {column} {unknown}; finished are: "
                    f"{', '.join(sorted(there)) or 'none'}"
                )
            table = table.filter(pc.is_in(table[column], pa.array(wanted, pa.string())))
        self.rows = Rows.of(table)
        self._store = store
        self._reader = RowReader(store, verify=False)
        self._paths = Companions(StoredFiles(store), _read_paths)
        self._kept: OrderedDict[int, View] = OrderedDict()

    def drives(self) -> list[Drive]:
        """In the manifest's order."""
        found: dict[tuple[str, str], Drive] = {}
        clean = clean_mask(self.rows)
        for row in range(len(self.rows)):
            scene, variant = self.rows["scene"][row], self.rows["variant"][row]
            if (scene, variant) not in found:
                effects = "clean" if clean[row] else _effects(self.rows, row)
                recipe = self.rows["recipe"][row]
                found[scene, variant] = Drive(scene, variant, recipe, effects, {})
            item = self.rows["frame"][row], self.rows["camera"][row]
            found[scene, variant].rows[item] = row
        return list(found.values())

    def camera(self, row: int) -> Camera:
        """The row's camera in the dataset's world, which is that of the boxes."""
        record, _ = self._reader.camera(self.rows, row)
        try:
            return Camera(
                record.name,
                record.width,
                record.height,
                float(record.K[0, 0]),
                float(record.K[1, 1]),
                float(record.K[0, 2]),
                float(record.K[1, 2]),
                invert_rigid(record.world_from_camera),
                record.timestamp_ns,
            )
        except (RuntimeError, TypeError, ValueError) as error:
            raise OutputError(
                f"{self._store.uri}: {self.rows['calibration_path'][row]} is damaged (frame "
                f"{self.rows['frame'][row]}, camera {record.name!r}: {error}); delete it and run "
                f"the job again, which makes it anew"
            ) from error

    def view(self, row: int) -> View:
        """What the row's files hold.

        Raises:
            OutputError: the row has no depth, or a file is missing or damaged.
        """
        if row not in self._kept:
            self._kept[row] = self._read(row)
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(row)
        return self._kept[row]

    def paths(self, row: int) -> ActorPaths:
        """Where the boxes of the row's drive are; none where it has no labels."""
        column: Any = self.rows["labels_path"]
        parts = column.parts(row)
        return ActorPaths({}) if parts is None else self._paths.get(*parts)[0]

    def _read(self, row: int) -> View:
        pixels = self._reader.pixels(self.rows, row, _BUFFERS)
        if pixels.depth is None:
            raise OutputError(
                f"{self._store.uri}: variant {self.rows['variant'][row]!r} of scene "
                f"{self.rows['scene'][row]!r} has no depth images, by which views are compared; "
                f"render it with output: {{depth: median}}"
            )
        assert pixels.rgb is not None
        depth_m = depth_in_metres(pixels.depth)
        return View(
            DepthView(
                self.camera(row),
                pixels.rgb.astype(np.float32) / np.float32(255),
                depth_m,
                (depth_m > 0).astype(np.float32),
            ),
            None if pixels.water is None else pixels.water > 0,
            None if pixels.instance is None else pixels.instance > 0,
        )


def pairs_of(views: Views, drive: Drive, short: int, long: int, most: int | None) -> list[Pair]:
    """The pairs of a drive: of one camera, `short` and `long` frame numbers apart (the later one is
    warped into the earlier), and of neighbouring cameras of one frame (the second by name into the
    first). most: of each kind at most so many, evenly chosen.
    """
    frames = sorted({frame for frame, _ in drive.rows})
    cameras = sorted({camera for _, camera in drive.rows})
    found: dict[str, list[Pair]] = {kind: [] for kind in KINDS}
    for kind, apart in ((SHORT, short), (LONG, long)):
        for camera in cameras:
            for frame in frames:
                a, b = (drive.rows.get((number, camera)) for number in (frame, frame + apart))
                if a is not None and b is not None:
                    found[kind].append(Pair(kind, a, b))
    for frame in frames:
        rows = [drive.rows[frame, name] for name in cameras if (frame, name) in drive.rows]
        found[CAMERAS] += [Pair(CAMERAS, a, b) for a, b in _neighbours(views, rows)]
    return [
        pair
        for each in found.values()
        for pair in (each if most is None or not each else evenly(each, most))
    ]


def _neighbours(views: Views, rows: Sequence[int]) -> Iterator[tuple[int, int]]:
    axes = {row: views.camera(row).world_from_camera[:3, 2].numpy() for row in rows}
    least = math.cos(math.radians(MAX_ANGLE_DEG))
    for place, a in enumerate(rows):
        for b in rows[place + 1 :]:
            if float(axes[a] @ axes[b]) >= least - 1e-9:
                yield a, b


def _effects(rows: Rows, row: int) -> str:
    """Which effects the manifest's numbers name: `smog + snow`."""
    present = {
        "smog": _number(rows, row, "smog_extinction_per_m") > 0,
        "flood": not math.isnan(_number(rows, row, "flood_level_m")),
        "snow": _number(rows, row, "snow_depth_m") > 0,
        "style": rows["style"][row] is not None,
    }
    return " + ".join(name for name, there in present.items() if there) or "other"


def _number(rows: Rows, row: int, name: str) -> float:
    """A weather number; NaN where there is none."""
    value = rows[name][row] if name in rows.weather else None
    return math.nan if value is None else value


def _read_paths(path: Any) -> tuple[ActorPaths]:
    return (ActorPaths(read_boxes(path)),)
