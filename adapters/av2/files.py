"""What a log of Argoverse 2 is made of: Feather tables, the car's path, how its LiDARs turn, the
map of its ground.

    annotations.feather, city_SE3_egovehicle.feather    boxes (a test log has none), the car's path
    calibration/{egovehicle_SE3_sensor,intrinsics}.feather
    sensors/lidar/<ns>.feather, sensors/cameras/<camera>/<ns>.jpg
    map/                                                the ground's heights, drivable areas
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pyarrow as pa
from pydantic import BaseModel, Field
from scipy.spatial.transform import Rotation, Slerp

from adapters.plain_files import LARGEST, Number, inside, read_json, validated
from augment.errors import AdapterError
from augment.files.pickles import PickleError, read_npy
from augment.files.stated_sizes import StatedSizeError, check_texts, read_feather
from augment.semantics import SemanticClass
from recipes.files import open_file

# ---- Feather tables ------------------------------------------------------------------------------

POSES = "city_SE3_egovehicle.feather"
SENSORS = "calibration/egovehicle_SE3_sensor.feather"
LENSES = "calibration/intrinsics.feather"
ANNOTATIONS = "annotations.feather"
_QUAT, _PLACE = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
_UNIT_TOLERANCE = 1e-3
_COPY = "copy it from the dataset"
_TABLE_FAULTS = (pa.ArrowException, OSError, ValueError, KeyError, TypeError)


def read_columns(root: Path, name: str) -> Columns:
    """A whole table of the log at root.

    Raises:
        AdapterError: no file, or none of Feather's second version."""
    path = inside(root, name, str(root))
    try:
        with open_file(path) as file:
            table = read_feather(file.read())
    except FileNotFoundError:
        raise AdapterError(f"{path} does not exist; {_COPY}") from None
    except _TABLE_FAULTS as error:
        raise AdapterError(f"{path} is not a whole Feather table ({error}); {_COPY}") from None
    return Columns(table, path)


class Columns:
    """The columns of a table by name, checked as they are asked for; path: for messages."""

    def __init__(self, table: pa.Table, path: Path) -> None:
        self.table, self.path = table, path

    def _column(self, name: str) -> pa.ChunkedArray:
        if self.table.column_names.count(name) != 1:
            raise AdapterError(
                f"{self.path} must have one column {name}; it has {self.table.column_names}"
            )
        column = self.table[name]
        if column.null_count:
            raise AdapterError(
                f"{self.path}: the column {name} lacks {column.null_count} values; {_COPY}"
            )
        return column

    def floats(self, name: str) -> np.ndarray:
        """A copy in the file's own precision [N]."""
        return self._numbers(name, "f", "numbers with a fraction")

    def integers(self, name: str) -> np.ndarray:
        return self._numbers(name, "iu", "whole numbers")

    def _numbers(self, name: str, kinds: str, meaning: str) -> np.ndarray:
        column = self._column(name)
        is_number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
        values = np.array(column.to_numpy()) if is_number else np.empty(0, object)
        if values.dtype.kind not in kinds:
            kind = values.dtype if is_number else column.type
            raise AdapterError(
                f"{self.path}: the column {name} must hold {meaning}; it holds {kind}"
            )
        return values

    def texts(self, name: str) -> np.ndarray:
        """Objects [N]."""
        column = self._column(name)
        kind = column.type
        if pa.types.is_dictionary(kind):
            kind = kind.value_type
        if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
            raise AdapterError(
                f"{self.path}: the column {name} must hold texts; it holds {column.type}"
            )
        if pa.types.is_dictionary(column.type):
            try:
                check_texts(column)
            except StatedSizeError as error:
                raise AdapterError(f"{self.path}: the column {name}: {error}") from None
        return np.array(column.to_pylist(), object)

    def vectors(self, names: Sequence[str]) -> np.ndarray:
        """Finite numbers, float64 [N, names]."""
        values = np.stack([self.floats(name).astype(np.float64) for name in names], axis=1)
        if not (np.abs(values) <= LARGEST).all():
            row = int(np.flatnonzero(~(np.abs(values) <= LARGEST).all(axis=1))[0])
            raise AdapterError(
                f"{self.path}, row {row}: {', '.join(names)} must be finite, and at most "
                f"{LARGEST:g}; got {values[row].tolist()}"
            )
        return values

    def poses(self) -> np.ndarray:
        """Rigid transforms, float64 [N, 4, 4]."""
        quats = self.vectors(_QUAT)
        wrong = np.abs(np.linalg.norm(quats, axis=1) - 1) > _UNIT_TOLERANCE
        if wrong.any():
            row = int(wrong.argmax())
            raise AdapterError(
                f"{self.path}, row {row}: {', '.join(_QUAT)} must be a quaternion of length 1; "
                f"got {quats[row].tolist()}"
            )
        poses = np.tile(np.eye(4), (len(quats), 1, 1))
        if len(quats):
            poses[:, :3, :3] = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
        poses[:, :3, 3] = self.vectors(_PLACE)
        return poses


# ---- The car's path, and when its LiDARs look where ----------------------------------------------


@dataclass(frozen=True, eq=False)
class CityPath:
    """The car's poses. timestamps_ns: int64 [P], ascending. poses: city_from_ego, float64 [P, 4,
    4]."""

    timestamps_ns: np.ndarray
    poses: np.ndarray

    @staticmethod
    def read(root: Path) -> CityPath:
        columns = read_columns(root, POSES)
        times, poses = columns.integers("timestamp_ns").astype(np.int64), columns.poses()
        order = np.argsort(times, kind="stable")
        if len(times) < 2 or (np.diff(times[order]) <= 0).any():
            raise AdapterError(
                f"{columns.path} must hold two poses or more, of different timestamp_ns; it holds "
                f"{len(times)}, of {len(np.unique(times))} times"
            )
        return CityPath(times[order], poses[order])

    def covers(self, timestamp_ns: int) -> bool:
        return bool(self.timestamps_ns[0] <= timestamp_ns <= self.timestamps_ns[-1])

    def at(self, timestamps_ns: np.ndarray) -> np.ndarray:
        """city_from_ego at times [N], float64 [N, 4, 4]: linear in position, slerp in rotation, the
        last pose at its end after it, and the first before it."""
        # Nanoseconds since 1970 exceed float64's whole numbers; those since the first pose do not.
        knots = (self.timestamps_ns - self.timestamps_ns[0]).astype(np.float64)
        times = np.clip(timestamps_ns - self.timestamps_ns[0], 0, knots[-1]).astype(np.float64)
        out = np.tile(np.eye(4), (len(times), 1, 1))
        out[:, :3, :3] = self._turns(times).as_matrix()
        for axis in range(3):
            out[:, axis, 3] = np.interp(times, knots, self.poses[:, axis, 3])
        return out

    @cached_property
    def _turns(self) -> Slerp:
        knots = (self.timestamps_ns - self.timestamps_ns[0]).astype(np.float64)
        return Slerp(knots, Rotation.from_matrix(self.poses[:, :3, :3]))


# Two sensors of 32 lasers each turn clockwise in 100 ms, half a turn apart, so that each direction
# is met every 50 ms. Returns come compensated for the car's motion to the sweep's stamp, where the
# turn begins; what moves by itself stands where it was met, twice. Boxes bear the stamp, but hold
# the returns: in a published sweep three of four moving cars fit their box at the mean of the two
# moments, none at the stamp.
TURN_NS = 100_000_000
UP, DOWN, NUM_LASERS = "up_lidar", "down_lidar", 32
_MIN_REGULAR = 0.9  # mean resultant length of the bearings at which turns begin; published 0.999
_MIN_LASER_POINTS = 50
_CLEARLY = 0.8  # of the usual assignment's spread, for the other one to be believed


@dataclass(frozen=True)
class Spin:
    """How the LiDARs turn. start_ns: offset of a sweep's first returns. begin_rad: bearing, modulo
    half a turn, at which one of them looks at offset 0; None where that cannot be told."""

    start_ns: int = 0
    begin_rad: float | None = None

    @staticmethod
    def of_returns(directions: np.ndarray, offsets_ns: np.ndarray) -> Spin:
        """directions: [N, 2 or more] from the sensors in the car's axes."""
        if len(offsets_ns) == 0:
            return Spin()
        bearings = np.arctan2(directions[:, 1], directions[:, 0])
        begins = np.exp(2j * (bearings + 2 * np.pi * offsets_ns / TURN_NS)).mean()
        is_regular = abs(begins) > _MIN_REGULAR
        return Spin(int(offsets_ns.min()), float(np.angle(begins)) / 2 if is_regular else None)

    def met_ns(self, directions: np.ndarray) -> np.ndarray:
        """How long after the stamp the LiDARs meet what lies there, the mean of both, int64 [N]."""
        if self.begin_rad is None:
            return np.zeros(len(directions), np.int64)
        bearings = np.arctan2(directions[:, 1], directions[:, 0])
        offsets = (self.begin_rad - bearings) / (2 * np.pi) * TURN_NS - self.start_ns
        half = TURN_NS // 2
        return np.round(self.start_ns + np.mod(offsets, half) + half / 2).astype(np.int64)


def sensor_of_laser(
    lasers: np.ndarray, points: np.ndarray, ego_from_sensor: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Which of UP, DOWN made each return, as 0 or 1 [N]: lasers below 32 are UP's, unless they draw
    much narrower cones around DOWN. points: float64 [N, 3], ego, as compensated."""
    usual = (lasers >= NUM_LASERS).astype(np.int64)
    spreads = [_cone_spread(lasers, points, s, ego_from_sensor) for s in (usual, 1 - usual)]
    return 1 - usual if spreads[1] < _CLEARLY * spreads[0] else usual


def _cone_spread(
    lasers: np.ndarray,
    points: np.ndarray,
    sensors: np.ndarray,
    ego_from_sensor: Mapping[str, np.ndarray],
) -> float:
    """Median over the lasers of how much their elevation varies, radians; inf without returns."""
    elevation = np.zeros(len(points))
    for number, name in enumerate((UP, DOWN)):
        pose, own = ego_from_sensor[name], sensors == number
        local = (points[own] - pose[:3, 3]) @ pose[:3, :3]
        elevation[own] = np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1]))
    spreads = [
        np.ptp(np.quantile(elevation[lasers == laser], (0.1, 0.9)))
        for laser in np.unique(lasers)
        if (lasers == laser).sum() >= _MIN_LASER_POINTS
    ]
    return float(np.median(spreads)) if spreads else np.inf


# ---- The map -------------------------------------------------------------------------------------

_HEIGHTS, _GRID, _AREAS = (
    "*_ground_height_surface____*.npy",
    "*___img_Sim2_city.json",
    "log_map_*.json",
)
# Around the map's height a return is the ground's: of a published sweep's on the road 97 % of those
# within 0.6 m. Higher are kerbs, tyres and what lies about; lower is noise of far returns.
_ABOVE_M, _BELOW_M = 0.15, 0.3
_NEAR_PATH_M = 16.0
_MAX_CELLS = 100_000_000
_SUBPIXEL_BITS = 4
_FAR_CELL = 1 << 29  # in parts of a pixel


class _Grid(BaseModel):
    R: tuple[Number, Number, Number, Number]
    t: tuple[Number, Number]
    s: Annotated[Number, Field(gt=0)]


class _Corner(BaseModel):
    x: Number
    y: Number


class _Area(BaseModel):
    area_boundary: Annotated[list[_Corner], Field(min_length=3)]


class _Areas(BaseModel):
    drivable_areas: dict[str, _Area]


@dataclass(frozen=True, eq=False)
class GroundMap:
    """The ground's heights over a grid. heights_m: float16 [H, W], city, NaN outside the mapped
    region. is_road: bool [H, W], drivable areas; None where they are not known. rotation [2, 2],
    offset_m [2], cells_per_m: a place's cell is cells_per_m * (rotation @ xy + offset_m), x the
    column."""

    heights_m: np.ndarray
    is_road: np.ndarray | None
    rotation: np.ndarray
    offset_m: np.ndarray
    cells_per_m: float

    @staticmethod
    def read(root: Path) -> GroundMap | None:
        """The map of a log; None where it has no heights."""
        heights, grid, areas = (_one(root, name) for name in (_HEIGHTS, _GRID, _AREAS))
        if heights is None:
            return None
        if grid is None:
            raise AdapterError(f"{root / 'map'} has no {_GRID}, which places the heights; {_COPY}")
        try:
            with open_file(heights) as file:
                values = read_npy(file)
        except (OSError, PickleError) as error:
            raise AdapterError(f"{heights} is no whole .npy file ({error}); {_COPY}") from None
        if values.ndim != 2 or values.dtype.kind != "f" or not 0 < values.size <= _MAX_CELLS:
            raise AdapterError(
                f"{heights} must hold heights [rows, columns]; it holds {values.dtype} "
                f"{list(values.shape)}"
            )
        placed = validated(_Grid, read_json(grid), str(grid))
        rotation = np.array(placed.R).reshape(2, 2)
        if not np.allclose(rotation @ rotation.T, np.eye(2), atol=_UNIT_TOLERANCE):
            raise AdapterError(f"{grid}: R must be a rotation, 4 numbers by rows; got {placed.R}")
        found = GroundMap(values, None, rotation, np.array(placed.t), placed.s)
        return found if areas is None else replace(found, is_road=_drawn(areas, found))

    def cells(self, xy: np.ndarray) -> np.ndarray:
        """Columns and rows of city places [N, 2], with their fractions."""
        return self.cells_per_m * (xy @ self.rotation.T + self.offset_m)

    def classes(self, points: np.ndarray) -> np.ndarray:
        """SemanticClass of city points [N, 3] by place and height alone, int16 [N]: ROAD, TERRAIN
        (footpaths too) or UNKNOWN."""
        out = np.full(len(points), SemanticClass.UNKNOWN, np.int16)
        if self.is_road is None:
            return out
        with np.errstate(invalid="ignore"):
            cells = np.floor(self.cells(points[:, :2]))
            there = ((cells >= 0) & (cells < self.heights_m.shape[::-1])).all(axis=1)
            column, row = cells[there].astype(np.int64).T
            above = points[there, 2] - self.heights_m[row, column]
            on_ground = (above > -_BELOW_M) & (above < _ABOVE_M)
        index = np.flatnonzero(there)[on_ground]
        is_road = self.is_road[row[on_ground], column[on_ground]]
        out[index] = np.where(is_road, SemanticClass.ROAD, SemanticClass.TERRAIN)
        return out

    def under(self, positions: np.ndarray) -> np.ndarray:
        """The ground's points near city positions [P, 3], a cell each, float64 [N, 3]."""
        reach = self.cells_per_m * _NEAR_PATH_M
        cells = self.cells(positions[:, :2])
        low = np.clip(np.floor(cells.min(axis=0) - reach), 0, self.heights_m.shape[::-1])
        high = np.clip(np.ceil(cells.max(axis=0) + reach), 0, self.heights_m.shape[::-1])
        (left, top), (right, bottom) = low.astype(int), high.astype(int)
        heights = self.heights_m[top:bottom, left:right].astype(np.float64)
        row, column = np.nonzero(np.isfinite(heights))
        middles = np.stack([column + left + 0.5, row + top + 0.5], axis=1)
        xy = (middles / self.cells_per_m - self.offset_m) @ self.rotation
        return np.column_stack([xy, heights[row, column]])


def _one(root: Path, pattern: str) -> Path | None:
    found = sorted((root / "map").glob(pattern))
    if len(found) > 1:
        raise AdapterError(
            f"{root / 'map'} holds {len(found)} files {pattern}, of which a log has one: "
            f"{', '.join(path.name for path in found[:3])}; leave its own"
        )
    return inside(root, f"map/{found[0].name}", str(root)) if found else None


def _drawn(path: Path, ground: GroundMap) -> np.ndarray:
    """The cells of the drivable areas, bool [H, W]."""
    image = np.zeros(ground.heights_m.shape, np.uint8)
    for area in validated(_Areas, read_json(path), str(path)).drivable_areas.values():
        xy = np.array([[corner.x, corner.y] for corner in area.area_boundary])
        # OpenCV's whole numbers are the middles of pixels.
        outline = np.round((ground.cells(xy) - 0.5) * (1 << _SUBPIXEL_BITS))
        outline = np.clip(outline, -_FAR_CELL, _FAR_CELL).astype(np.int32)
        cv2.fillPoly(image, [outline], 1, shift=_SUBPIXEL_BITS)
    return image.astype(np.bool_)
