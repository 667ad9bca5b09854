"""Files of an Argoverse 2 log: Feather tables, the car's path, the LiDARs' turning, the ground
map.

 annotations.feather, city_SE3_egovehicle.feather    boxes (a test log has none), the car's path
    calibration/{egovehicle_SE3_sensor,intrinsics}.feather
    sensors/lidar/<ns>.feather, sensors/cameras/<camera>/<ns>.jpg
    map/                                                the ground's heights, drivable areas

Every value is checked when it is read; a missing or damaged file raises an AdapterError. The caller
is `adapters.av2.adapter`.
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

from adapters.plain_files import LARGEST, Number, read_json, resolve_inside, validate_content
from augment.errors import AdapterError
from augment.files.pickles import PickleError, read_npy
from augment.files.stated_sizes import StatedSizeError, check_texts, read_feather
from augment.scene.semantics import SemanticClass
from recipes.files import open_file

# ---- Feather tables ------------------------------------------------------------------------------

POSES = "city_SE3_egovehicle.feather"
SENSORS = "calibration/egovehicle_SE3_sensor.feather"
LENSES = "calibration/intrinsics.feather"
ANNOTATIONS = "annotations.feather"
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
_POSITION_COLUMNS = ("tx_m", "ty_m", "tz_m")
# Largest deviation of a quaternion's length from 1, and of a rotation's entries from orthogonality.
_UNIT_TOLERANCE = 1e-3
# Advice at the end of messages about missing or damaged files.
_COPY_ADVICE = "copy it from the dataset"
# Exceptions that a damaged Feather file can raise.
_TABLE_FAULTS = (pa.ArrowException, OSError, ValueError, KeyError, TypeError)


def read_columns(root: Path, name: str) -> Columns:
    """Read a whole table of the log at root.

    Raises:
        AdapterError: the file is missing, or is no file of Feather's second version.
    """
    path = resolve_inside(root, name, str(root))
    try:
        with open_file(path) as file:
            table = read_feather(file.read())
    except FileNotFoundError:
        raise AdapterError(f"{path} does not exist; {_COPY_ADVICE}") from None
    except _TABLE_FAULTS as error:
        raise AdapterError(
            f"{path} is not a whole Feather table ({error}); {_COPY_ADVICE}"
        ) from None
    return Columns(table, path)


class Columns:
    """Columns of a table by name. Each column is checked when it is read.

    Args:
        table: the table.
        path: its file, for messages.
    """

    def __init__(self, table: pa.Table, path: Path) -> None:
        self.table = table
        self.path = path

    def _column(self, name: str) -> pa.ChunkedArray:
        if self.table.column_names.count(name) != 1:
            raise AdapterError(
                f"{self.path} must have one column {name}; it has {self.table.column_names}"
            )
        column = self.table[name]
        if column.null_count:
            raise AdapterError(
                f"{self.path}: the column {name} lacks {column.null_count} values; {_COPY_ADVICE}"
            )
        return column

    def floats(self, name: str) -> np.ndarray:
        """Return a copy of a column in the file's own precision, [N]."""
        return self._numbers(name, "f", "numbers with a fraction")

    def integers(self, name: str) -> np.ndarray:
        """Return a copy of a column of whole numbers, [N]."""
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
        """Return a column of texts, objects [N]."""
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
        """Return columns of finite numbers side by side, float64 [N, len(names)]."""
        values = np.stack([self.floats(name).astype(np.float64) for name in names], axis=1)
        if not (np.abs(values) <= LARGEST).all():
            row = int(np.flatnonzero(~(np.abs(values) <= LARGEST).all(axis=1))[0])
            raise AdapterError(
                f"{self.path}, row {row}: {', '.join(names)} must be finite, and at most "
                f"{LARGEST:g}; got {values[row].tolist()}"
            )
        return values

    def poses(self) -> np.ndarray:
        """Return the rigid transforms of the table's rows, float64 [N, 4, 4]."""
        quats = self.vectors(_QUATERNION_COLUMNS)
        is_not_unit = np.abs(np.linalg.norm(quats, axis=1) - 1) > _UNIT_TOLERANCE
        if is_not_unit.any():
            row = int(is_not_unit.argmax())
            raise AdapterError(
                f"{self.path}, row {row}: {', '.join(_QUATERNION_COLUMNS)} must be a quaternion of "
                f"length 1; got {quats[row].tolist()}"
            )
        poses = np.tile(np.eye(4), (len(quats), 1, 1))
        if len(quats):
            poses[:, :3, :3] = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
        poses[:, :3, 3] = self.vectors(_POSITION_COLUMNS)
        return poses


# ---- The car's path, and when its LiDARs look where ----------------------------------------------


@dataclass(frozen=True, eq=False)
class CityPath:
    """The car's poses over time.

    Attributes:
        timestamps_ns: int64 [P], ascending.
        poses: city_from_ego, float64 [P, 4, 4].
    """

    timestamps_ns: np.ndarray
    poses: np.ndarray

    @staticmethod
    def read(root: Path) -> CityPath:
        """Read the poses of the log at root, in order of time."""
        columns = read_columns(root, POSES)
        times = columns.integers("timestamp_ns").astype(np.int64)
        poses = columns.poses()
        order = np.argsort(times, kind="stable")
        if len(times) < 2 or (np.diff(times[order]) <= 0).any():
            raise AdapterError(
                f"{columns.path} must hold two poses or more, of different timestamp_ns; it holds "
                f"{len(times)}, of {len(np.unique(times))} times"
            )
        return CityPath(times[order], poses[order])

    def covers(self, timestamp_ns: int) -> bool:
        """Return True if the poses begin before and end after a time."""
        return bool(self.timestamps_ns[0] <= timestamp_ns <= self.timestamps_ns[-1])

    def at(self, timestamps_ns: np.ndarray) -> np.ndarray:
        """Return city_from_ego at times [N], float64 [N, 4, 4].

        Positions are interpolated linearly, rotations by slerp. The first pose holds before the
        path, the last one after it.
        """
        # Nanoseconds since 1970 exceed float64's whole numbers; those since the first pose do not.
        knot_times = (self.timestamps_ns - self.timestamps_ns[0]).astype(np.float64)
        sample_times = np.clip(timestamps_ns - self.timestamps_ns[0], 0, knot_times[-1]).astype(
            np.float64
        )
        out = np.tile(np.eye(4), (len(sample_times), 1, 1))
        out[:, :3, :3] = self._rotations(sample_times).as_matrix()
        for axis in range(3):
            out[:, axis, 3] = np.interp(sample_times, knot_times, self.poses[:, axis, 3])
        return out

    @cached_property
    def _rotations(self) -> Slerp:
        """Interpolator of the rotations over seconds since the first pose, in nanoseconds."""
        knots = (self.timestamps_ns - self.timestamps_ns[0]).astype(np.float64)
        return Slerp(knots, Rotation.from_matrix(self.poses[:, :3, :3]))


# Two sensors of 32 lasers each turn clockwise in 100 ms, half a turn apart, so that one of them
# looks in each direction every 50 ms. The file's returns are compensated for the car's motion to
# the sweep's stamp, when the turn begins. A moving object is recorded twice, at the places where
# the two sensors met it. Boxes bear the stamp, but enclose the returns: in a published sweep three
# of four moving cars fit their box at the mean of the two moments, none at the stamp.

# Duration of a turn.
TURN_NS = 100_000_000
# Name of the upper LiDAR in the calibration.
UP = "up_lidar"
# Name of the lower LiDAR in the calibration.
DOWN = "down_lidar"
# Number of lasers of each LiDAR.
NUM_LASERS = 32
# Smallest mean resultant length of the bearings at which turns begin; published sweeps have 0.999.
_MIN_REGULARITY = 0.9
# Lasers with fewer returns than this do not count in the spread of elevations.
_MIN_LASER_POINTS = 50
# The swapped assignment of lasers is believed if its spread is below this part of the usual one's.
_MAX_SPREAD_RATIO = 0.8


@dataclass(frozen=True)
class Spin:
    """Timing of the LiDARs' turns.

    Attributes:
        start_ns: offset of a sweep's first returns after its stamp.
        begin_rad: bearing, modulo half a turn, at which one of the LiDARs looks at offset 0. None
            if the returns do not tell it.
    """

    start_ns: int = 0
    begin_rad: float | None = None

    @staticmethod
    def of_returns(directions: np.ndarray, offsets_ns: np.ndarray) -> Spin:
        """Estimate the timing from the returns of one sweep.

        Args:
            directions: float [N, 2 or more], from the sensors to the returns in the car's axes.
            offsets_ns: int64 [N], time of the returns after the sweep's stamp.
        """
        if len(offsets_ns) == 0:
            return Spin()
        bearings = np.arctan2(directions[:, 1], directions[:, 0])
        mean_phase = np.exp(2j * (bearings + 2 * np.pi * offsets_ns / TURN_NS)).mean()
        is_regular = abs(mean_phase) > _MIN_REGULARITY
        return Spin(int(offsets_ns.min()), float(np.angle(mean_phase)) / 2 if is_regular else None)

    def met_ns(self, directions: np.ndarray) -> np.ndarray:
        """Return the time after the stamp at which the LiDARs look in each direction, int64 [N].

        The time is the mean of both LiDARs' moments.
        """
        if self.begin_rad is None:
            return np.zeros(len(directions), np.int64)
        bearings = np.arctan2(directions[:, 1], directions[:, 0])
        offsets = (self.begin_rad - bearings) / (2 * np.pi) * TURN_NS - self.start_ns
        half_turn_ns = TURN_NS // 2
        return np.round(self.start_ns + np.mod(offsets, half_turn_ns) + half_turn_ns / 2).astype(
            np.int64
        )


def sensor_of_laser(
    lasers: np.ndarray, points: np.ndarray, ego_from_sensor: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return the number of the LiDAR that made each return: 0 for UP, 1 for DOWN, [N].

    Lasers below 32 are those of UP, unless they draw much narrower cones around DOWN.

    Args:
        lasers: int [N], the returns' laser numbers.
        points: float64 [N, 3], ego frame, compensated for the car's motion.
        ego_from_sensor: poses [4, 4] of both LiDARs.
    """
    usual_sensors = (lasers >= NUM_LASERS).astype(np.int64)
    spreads = [
        _cone_spread(lasers, points, s, ego_from_sensor) for s in (usual_sensors, 1 - usual_sensors)
    ]
    return 1 - usual_sensors if spreads[1] < _MAX_SPREAD_RATIO * spreads[0] else usual_sensors


def _cone_spread(
    lasers: np.ndarray,
    points: np.ndarray,
    sensors: np.ndarray,
    ego_from_sensor: Mapping[str, np.ndarray],
) -> float:
    """Return the median over the lasers of the spread of their elevations, radians.

    Without enough returns the result is infinite.
    """
    elevation = np.zeros(len(points))
    for number, name in enumerate((UP, DOWN)):
        pose = ego_from_sensor[name]
        is_of_sensor = sensors == number
        local_points = (points[is_of_sensor] - pose[:3, 3]) @ pose[:3, :3]
        elevation[is_of_sensor] = np.arctan2(
            local_points[:, 2], np.hypot(local_points[:, 0], local_points[:, 1])
        )
    spreads = [
        np.ptp(np.quantile(elevation[lasers == laser], (0.1, 0.9)))
        for laser in np.unique(lasers)
        if (lasers == laser).sum() >= _MIN_LASER_POINTS
    ]
    return float(np.median(spreads)) if spreads else np.inf


# ---- The map -------------------------------------------------------------------------------------

_HEIGHTS_PATTERN = "*_ground_height_surface____*.npy"
_GRID_PATTERN = "*___img_Sim2_city.json"
_AREAS_PATTERN = "log_map_*.json"
# A return between these two heights around the map's is one of the ground: 97 % of a published
# sweep's returns on the road that lie within 0.6 m of the map. Kerbs, tyres and objects on the road
# are higher; the noise of far returns is lower.
# Largest height above the map's.
_MAX_ABOVE_GROUND_M = 0.15
# Largest depth below the map's height.
_MAX_BELOW_GROUND_M = 0.3
# Distance from the car's path up to which the map's heights are used.
_PATH_MARGIN_M = 16.0
# Largest number of cells that a map may have.
_MAX_CELLS = 100_000_000
# Fractional bits of the pixel coordinates that OpenCV gets.
_SUBPIXEL_BITS = 4
# Largest pixel coordinate that OpenCV gets, in units of 2^-_SUBPIXEL_BITS px.
_MAX_PIXEL_COORDINATE = 1 << 29


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
    """Heights of the ground over a grid.

    The cell of a place is cells_per_m * (rotation @ xy + offset_m); its x is the column.

    Attributes:
        heights_m: float16 [H, W], city frame, NaN outside the mapped region.
        is_road: bool [H, W], drivable areas. None if they are not known.
        rotation: float64 [2, 2], grid from city.
        offset_m: float64 [2].
        cells_per_m: cells along a metre.
    """

    heights_m: np.ndarray
    is_road: np.ndarray | None
    rotation: np.ndarray
    offset_m: np.ndarray
    cells_per_m: float

    @staticmethod
    def read(root: Path) -> GroundMap | None:
        """Read the map of the log at root. Return None if it has no heights."""
        heights, grid, areas = (
            _find_map_file(root, name) for name in (_HEIGHTS_PATTERN, _GRID_PATTERN, _AREAS_PATTERN)
        )
        if heights is None:
            return None
        if grid is None:
            raise AdapterError(
                f"{root / 'map'} has no {_GRID_PATTERN}, which places the heights; {_COPY_ADVICE}"
            )
        try:
            with open_file(heights) as file:
                values = read_npy(file)
        except (OSError, PickleError) as error:
            raise AdapterError(
                f"{heights} is no whole .npy file ({error}); {_COPY_ADVICE}"
            ) from None
        if values.ndim != 2 or values.dtype.kind != "f" or not 0 < values.size <= _MAX_CELLS:
            raise AdapterError(
                f"{heights} must hold heights [rows, columns]; it holds {values.dtype} "
                f"{list(values.shape)}"
            )
        stated_grid = validate_content(_Grid, read_json(grid), str(grid))
        rotation = np.array(stated_grid.R).reshape(2, 2)
        if not np.allclose(rotation @ rotation.T, np.eye(2), atol=_UNIT_TOLERANCE):
            raise AdapterError(
                f"{grid}: R must be a rotation, 4 numbers by rows; got {stated_grid.R}"
            )
        ground = GroundMap(values, None, rotation, np.array(stated_grid.t), stated_grid.s)
        return ground if areas is None else replace(ground, is_road=_rasterize_areas(areas, ground))

    def cells(self, xy: np.ndarray) -> np.ndarray:
        """Return the columns and rows, with fractions, of city places [N, 2]."""
        return self.cells_per_m * (xy @ self.rotation.T + self.offset_m)

    def classes(self, points: np.ndarray) -> np.ndarray:
        """Return the semantic class of city points [N, 3] by place and height alone, int16 [N].

        The class is ROAD, TERRAIN (which includes footpaths) or UNKNOWN.
        """
        out = np.full(len(points), SemanticClass.UNKNOWN, np.int16)
        if self.is_road is None:
            return out
        with np.errstate(invalid="ignore"):
            cells = np.floor(self.cells(points[:, :2]))
            is_inside = ((cells >= 0) & (cells < self.heights_m.shape[::-1])).all(axis=1)
            column, row = cells[is_inside].astype(np.int64).T
            height_above_ground_m = points[is_inside, 2] - self.heights_m[row, column]
            on_ground = (height_above_ground_m > -_MAX_BELOW_GROUND_M) & (
                height_above_ground_m < _MAX_ABOVE_GROUND_M
            )
        index = np.flatnonzero(is_inside)[on_ground]
        is_road = self.is_road[row[on_ground], column[on_ground]]
        out[index] = np.where(is_road, SemanticClass.ROAD, SemanticClass.TERRAIN)
        return out

    def under(self, positions: np.ndarray) -> np.ndarray:
        """Return one ground point per cell near city positions [P, 3], float64 [N, 3]."""
        margin_cells = self.cells_per_m * _PATH_MARGIN_M
        cells = self.cells(positions[:, :2])
        low = np.clip(np.floor(cells.min(axis=0) - margin_cells), 0, self.heights_m.shape[::-1])
        high = np.clip(np.ceil(cells.max(axis=0) + margin_cells), 0, self.heights_m.shape[::-1])
        (left, top) = low.astype(int)
        (right, bottom) = high.astype(int)
        heights = self.heights_m[top:bottom, left:right].astype(np.float64)
        row, column = np.nonzero(np.isfinite(heights))
        cell_centers = np.stack([column + left + 0.5, row + top + 0.5], axis=1)
        xy = (cell_centers / self.cells_per_m - self.offset_m) @ self.rotation
        return np.column_stack([xy, heights[row, column]])


def _find_map_file(root: Path, pattern: str) -> Path | None:
    """Return the only file of the log's map that matches a pattern.

    The result is None if there is none.
    """
    paths = sorted((root / "map").glob(pattern))
    if len(paths) > 1:
        raise AdapterError(
            f"{root / 'map'} holds {len(paths)} files {pattern}, of which a log has one: "
            f"{', '.join(path.name for path in paths[:3])}; leave its own"
        )
    return resolve_inside(root, f"map/{paths[0].name}", str(root)) if paths else None


def _rasterize_areas(path: Path, ground: GroundMap) -> np.ndarray:
    """Return a mask of the cells in drivable areas, bool [H, W]."""
    image = np.zeros(ground.heights_m.shape, np.uint8)
    for area in validate_content(_Areas, read_json(path), str(path)).drivable_areas.values():
        xy = np.array([[corner.x, corner.y] for corner in area.area_boundary])
        # OpenCV's whole numbers are the middles of pixels.
        outline = np.round((ground.cells(xy) - 0.5) * (1 << _SUBPIXEL_BITS))
        outline = np.clip(outline, -_MAX_PIXEL_COORDINATE, _MAX_PIXEL_COORDINATE).astype(np.int32)
        cv2.fillPoly(image, [outline], 1, shift=_SUBPIXEL_BITS)
    return image.astype(np.bool_)
