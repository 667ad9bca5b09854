"""Tables of one nuScenes scene, read and checked. No image or sweep is opened here.

    v1.0-*/scene.json, sample.json, sample_data.json, sample_annotation.json, ...   the tables
    samples/<CHANNEL>/, sweeps/<CHANNEL>/    files of keyframes, and of the time between them
    lidarseg/v1.0-*/<token>_lidarseg.bin     class of each return of keyframes, where published
    panoptic/v1.0-*/<token>_panoptic.npz     class and object of each, likewise

A table is a JSON list of objects. It is read once, row by row, never in memory as a whole, and only
the rows of the scene stay in memory. Reading takes a second for mini and about half a minute for
trainval, whose tables have 2 GB. Rows are taken in order of time; prev and next links are not
needed. Coordinates are nuScenes' global ones in metres, times are nanoseconds. Errors are
AdapterErrors that name table, row and field. The caller is `adapters.nuscenes.adapter`.

nuScenes publishes one time per sweep, the end of its turn, and no times of returns. But the sensor
turns clockwise in 50 ms, and each camera is triggered when the LiDAR sweeps across the middle of
its view. The keyframes' images therefore give the bearing at which a turn ends (to the left, a
little behind), and this bearing gives the time of every return. Moving objects need it: their boxes
stand where the LiDAR met them, up to 50 ms before the sweep's time, as the images do.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, FailFast, Field
from scipy.spatial.transform import Rotation

from adapters.plain_files import Number, Text, resolve_inside, validate_content
from adapters.raw_drive import DriveOptions
from augment.errors import AdapterError
from augment.scene.labels import Boxes
from recipes.files import open_file

# Characters that are read at a time.
_CHUNK_CHARS = 1 << 22
# Largest row. No published row has a ten-thousandth of it.
_MAX_ROW_CHARS = 1 << 24
# Characters between two rows.
_SEPARATOR = re.compile(r"[\s,]*")
# Largest deviation of a quaternion's length from 1.
_UNIT_TOLERANCE = 1e-3
# Duration of a turn of the LiDAR.
TURN_NS = 50_000_000
_TWO_PI = 2 * np.pi
# Largest spread of the bearings at which turns end. Published images of one keyframe agree to 4
# degrees; other data in nuScenes' format need not turn like this at all.
_MAX_SPREAD_RAD = np.radians(20)
# Largest time between an image and its sweep: two turns of the LiDAR.
_MAX_TIME_DIFFERENCE_NS = 100_000_000
# Channel of the LiDAR.
LIDAR = "LIDAR_TOP"
# Beginning of the names of published versions.
_PUBLISHED_PREFIX = "v1.0-"
# Names that a message lists.
_MAX_NAMES = 10

# ---- What rows must hold; later editions may have more fields ------------------------------------

_Model = TypeVar("_Model", bound=BaseModel)
_Target = TypeVar("_Target")
_Vector = tuple[Number, Number, Number]
_Count = Annotated[int, Field(strict=True, ge=0, lt=2**62)]
_Pixels = Annotated[_Count, Field(ge=1)]
_Length = Annotated[Number, Field(gt=0)]


def _check_unit(quat: tuple[float, ...]) -> tuple[float, ...]:
    """Return a quaternion if its length is 1."""
    if abs(float(np.linalg.norm(quat)) - 1) > _UNIT_TOLERANCE:
        raise ValueError("must be a quaternion wxyz of length 1")
    return quat


def _read_pinhole(matrix: tuple[_Vector, _Vector, _Vector]) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a pinhole matrix."""
    (fx, _, cx), (_, fy, cy), _ = matrix
    pinhole = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if min(fx, fy) <= 0 or not np.allclose(matrix, pinhole, rtol=0, atol=1e-6):
        raise ValueError("must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    return fx, fy, cx, cy


def _as_whole_number(time: object) -> object:
    """Return a whole number that a converter has written as a float."""
    return int(time) if isinstance(time, float) and time.is_integer() else time


class _TimedRow(BaseModel):
    """Row with a time. timestamp: microseconds."""

    timestamp: Annotated[_Count, Field(gt=0, lt=2**62 // 1000), BeforeValidator(_as_whole_number)]


class _PosedRow(BaseModel):
    """Row with a pose. translation: metres. rotation: quaternion wxyz."""

    translation: _Vector
    rotation: Annotated[tuple[Number, Number, Number, Number], AfterValidator(_check_unit)]

    def pose(self) -> np.ndarray:
        """Return the pose, float64 [4, 4]."""
        w, x, y, z = self.rotation
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        pose[:3, 3] = self.translation
        return pose


class _CameraRow(_PosedRow):
    camera_intrinsic: Annotated[tuple[_Vector, _Vector, _Vector], AfterValidator(_read_pinhole)]


class _DataRow(_TimedRow):
    sample_token: Text
    filename: Text
    is_key_frame: Annotated[bool, Field(strict=True)]


class _ImageRow(_DataRow):
    width: _Pixels
    height: _Pixels


class _AnnotationRow(_PosedRow):
    """Row of a box. size: width, length, height, metres."""

    size: tuple[_Length, _Length, _Length]
    attribute_tokens: Annotated[list[Text], FailFast()]
    num_lidar_pts: _Count
    num_radar_pts: _Count


class _CategoryRow(BaseModel):
    name: Text
    index: _Count | None = None  # tables without lidarseg do not number them


# ---- Tables --------------------------------------------------------------------------------------


class Row(NamedTuple):
    """One row as in the file.

    Attributes:
        path: the table's file.
        number: the row's number in the table, from 0.
        fields: values by field.
    """

    path: Path
    number: int
    fields: dict[str, Any]

    def __str__(self) -> str:
        name = self.fields.get("token")
        token_text = repr(name) if isinstance(name, str) and name else f"number {self.number}"
        return f"{self.path}: row {token_text}"

    @property
    def token(self) -> str:
        """Return the row's token."""
        token = self.text("token")
        if not token:
            raise self.fault("token", "a text that is not empty")
        return token

    def text(self, field: str) -> str:
        """Return a field's text."""
        value = self.fields.get(field)
        # Half a pair of surrogates, as JSON can have, cannot be written again.
        if isinstance(value, str) and (value.isascii() or not re.search("[\ud800-\udfff]", value)):
            return value
        raise self.fault(field, "a text")

    def read(self, model: type[_Model]) -> _Model:
        """Return the row's fields as a model."""
        return validate_content(model, self.fields, str(self))

    def fault(self, field: str, expected: str) -> AdapterError:
        """Return the error that a field is not as expected."""
        got = f"{self.fields[field]!r:.200}" if field in self.fields else "no such field"
        return AdapterError(f"{self}: field {field!r} must be {expected}; got {got}")


def read_rows(path: Path) -> Iterator[Row]:
    """Read the rows of a table, in its order."""
    try:
        with io.TextIOWrapper(open_file(path), encoding="utf-8-sig") as file:
            yield from _rows(path, file)
    except FileNotFoundError:
        raise AdapterError(f"{path} does not exist; copy it from the dataset") from None
    except (OSError, UnicodeDecodeError) as error:
        raise AdapterError(f"{path} cannot be read as text: {error}") from None


def read_table(
    path: Path, field: str = "token", values: Container[str] | None = None
) -> dict[str, Row]:
    """Read the rows by their token, in the table's order.

    Args:
        path: the table's file.
        field: field that selects rows.
        values: texts of `field` whose rows are returned. None for all rows.
    """
    rows_by_token: dict[str, Row] = {}
    for row in read_rows(path):
        if values is not None and row.text(field) not in values:
            continue
        if row.token in rows_by_token:
            raise AdapterError(
                f"{row}: the token of an earlier row too (row number "
                f"{rows_by_token[row.token].number}); tokens must be unique within a table"
            )
        rows_by_token[row.token] = row
    return rows_by_token


def find_row(row: Row, field: str, table: Mapping[str, _Target], name: str) -> _Target:
    """Return the row that a field names by its token.

    Args:
        row: the referring row.
        field: its field.
        table: rows by token.
        name: the table's name, for the message.
    """
    target = table.get(row.text(field))
    if target is None:
        raise row.fault(field, f"the token of a row of {name}.json, which has no such row")
    return target


def _rows(path: Path, file: Any) -> Iterator[Row]:
    """Decode the rows of a JSON list one by one."""
    decoder = json.JSONDecoder()
    first_character = file.read(1)
    while first_character.isspace():
        first_character = file.read(1)
    if first_character != "[":
        start = first_character + file.read(20)
        raise AdapterError(f"{path} must hold a list of rows; it starts with {start!r}")
    text = ""
    position = 0
    number = 0
    is_ended = False
    while True:
        separator = _SEPARATOR.match(text, position)
        assert separator is not None
        position = separator.end()
        if text[position : position + 1] == "]":
            return
        try:
            fields, position = decoder.raw_decode(text, position)
        except (ValueError, RecursionError) as error:
            if (
                is_ended
                or len(text) - position > _MAX_ROW_CHARS
                or isinstance(error, RecursionError)
            ):
                reason = "it is cut short" if is_ended and position >= len(text) else str(error)
                raise AdapterError(
                    f"{path} is not readable JSON after its first {number} rows ({reason}); copy "
                    f"it again"
                ) from None
            next_text = file.read(_CHUNK_CHARS)
            text = text[position:] + next_text
            position = 0
            is_ended = not next_text
            continue
        if not isinstance(fields, dict):
            raise AdapterError(
                f"{path}: row number {number} must be an object; got {type(fields).__name__}"
            )
        yield Row(path, number, fields)
        number += 1


@dataclass(frozen=True)
class Turn:
    """Timing of the LiDAR's turns.

    Attributes:
        end_rad: bearing of the end of a turn, from the car's forward axis to the left. None if it
            is not known; then all returns have the sweep's time.
    """

    end_rad: float | None

    @staticmethod
    def of_images(bearings_rad: np.ndarray, before_ns: np.ndarray) -> Turn:
        """Estimate the timing from images.

        Args:
            bearings_rad: float [N], bearings of the cameras' optical axes.
            before_ns: int [N], time from each image to its keyframe's sweep.
        """
        looks_apart = len(bearings_rad) > 1 and np.ptp(bearings_rad) > _MAX_SPREAD_RAD
        if not looks_apart:
            return Turn(None)
        end_bearings = bearings_rad - _TWO_PI * before_ns / TURN_NS
        end_rad = float(np.angle(np.exp(1j * end_bearings).mean()))
        spread = np.abs(np.angle(np.exp(1j * (end_bearings - end_rad))))
        return Turn(end_rad if np.quantile(spread, 0.9) < _MAX_SPREAD_RAD else None)

    def before_ns(self, directions: np.ndarray) -> np.ndarray:
        """Return how long before the sweep's time the LiDAR looked in each direction, int64 [N].

        Args:
            directions: float [N, 2 or 3] from the sensor, in the car's axes. NaN counts as forward.
        """
        if self.end_rad is None:
            return np.zeros(len(directions), np.int64)
        bearings = np.arctan2(directions[:, 1], directions[:, 0])
        turned_fraction = np.mod(np.nan_to_num(bearings) - self.end_rad, _TWO_PI) / _TWO_PI
        return np.round(turned_fraction * TURN_NS).astype(np.int64)


class NuScenesOptions(DriveOptions):
    """Options of a nuScenes scene. version, scene: if missing, there must be only one."""

    version: str | None = Field(None, description="a folder of tables such as v1.0-mini")
    scene: str | None = Field(None, description="a scene's name or token")
    sweeps: Literal["1", "0"] = Field(
        "1", description="1 for keyframes and the sweeps between them, 0 for keyframes only"
    )


@dataclass(frozen=True, eq=False)
class SensorFile:
    """One image or sweep: a row of sample_data, with the rows that it refers to.

    Attributes:
        token: its token.
        sample_token: token of its keyframe.
        channel: name of the sensor.
        filename: path relative to the dataset's folder, inside it.
        is_key_frame: True for files of keyframes.
        timestamp_ns: the file's time.
        world_from_ego: float64 [4, 4], at the file's time.
        ego_from_sensor: float64 [4, 4].
        intrinsic: fx, fy, cx, cy in pixels. None for a LiDAR.
        size: width and height in pixels. None for a LiDAR.
    """

    token: str
    sample_token: str
    channel: str
    filename: str
    is_key_frame: bool
    timestamp_ns: int
    world_from_ego: np.ndarray
    ego_from_sensor: np.ndarray
    intrinsic: tuple[float, float, float, float] | None
    size: tuple[int, int] | None

    @property
    def world_from_sensor(self) -> np.ndarray:
        """Return the sensor's pose at the file's time, float64 [4, 4]."""
        return self.world_from_ego @ self.ego_from_sensor


@dataclass(frozen=True, eq=False)
class Sample:
    """A keyframe and its boxes, with the attributes of NuScenesLabels except `interpolated`."""

    token: str
    timestamp_ns: int
    boxes: Boxes


@dataclass(frozen=True, eq=False)
class SceneTables:
    """Tables of one scene, everything in order of time.

    Attributes:
        root: the dataset's folder.
        version: name of the folder of tables.
        name: name of the scene.
        samples: keyframes.
        lidar: sweeps of LIDAR_TOP.
        images: images by camera.
        semantic_files: lidarseg file by the token of its sweep.
        panoptic_files: panoptic file by the token of its sweep.
        class_names: class names by the numbers in those files.
        turn: timing of the LiDAR's turns.
    """

    root: Path
    version: str
    name: str
    samples: tuple[Sample, ...]
    lidar: tuple[SensorFile, ...]
    images: Mapping[str, tuple[SensorFile, ...]]
    semantic_files: Mapping[str, str]
    panoptic_files: Mapping[str, str]
    class_names: Mapping[int, str]
    turn: Turn


def read_tables(root: Path, version: str | None, scene: str | None) -> SceneTables:
    """Read the tables of the scene of a name or token. version, scene: None for the only one."""
    folder = root / choose_version(root, version)
    row = choose_scene(folder, scene)
    samples = read_table(folder / "sample.json", "scene_token", {row.token})
    if not samples:
        raise AdapterError(f"{row}: {folder / 'sample.json'} has no keyframe of this scene")
    files = _read_files(root, folder, samples)
    lidar = tuple(file for file in files if file.channel == LIDAR)
    if not lidar:
        raise AdapterError(
            f"{folder / 'sample_data.json'} has no file of {LIDAR} for scene {row.text('name')!r}; "
            f"a scene cannot be built without LiDAR"
        )
    cameras = sorted({file.channel for file in files if file.intrinsic is not None})
    images = {name: tuple(f for f in files if f.channel == name) for name in cameras}
    rows = read_table(folder / "category.json")
    categories = {token: row.read(_CategoryRow) for token, row in rows.items()}
    return SceneTables(
        root=root,
        version=folder.name,
        name=row.text("name"),
        samples=_read_samples(folder, samples, categories),
        lidar=lidar,
        images=images,
        semantic_files=_files_of_sweeps(root, folder / "lidarseg.json", lidar),
        panoptic_files=_files_of_sweeps(root, folder / "panoptic.json", lidar),
        class_names={c.index: c.name for c in categories.values() if c.index is not None},
        turn=_read_turn(lidar, images),
    )


def _read_turn(lidar: Sequence[SensorFile], images: Mapping[str, tuple[SensorFile, ...]]) -> Turn:
    """Estimate the timing of the LiDAR's turns from the images of keyframes."""
    sweeps = {file.sample_token: file.timestamp_ns for file in lidar if file.is_key_frame}
    keyframe_images = [
        (np.arctan2(file.ego_from_sensor[1, 2], file.ego_from_sensor[0, 2]), file)
        for files in images.values()
        for file in files
        if file.is_key_frame and file.sample_token in sweeps
    ]
    before_sweep_ns = [sweeps[file.sample_token] - file.timestamp_ns for _, file in keyframe_images]
    return Turn.of_images(
        np.array([bearing for bearing, _ in keyframe_images]), np.array(before_sweep_ns)
    )


def choose_version(root: Path, version: str | None) -> str:
    """Return the folder of tables of a version, or the only one."""
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a nuScenes dataset with v1.0-*/")
    versions = table_folders(root)
    if not versions:
        parent = root.absolute().parent
        is_above = bool(table_folders(parent)) or _holds_tables(root)
        raise AdapterError(
            f"{root} holds no nuScenes tables (v1.0-*/scene.json), such as those of v1.0-mini; "
            + (f"give the folder above it, {parent}" if is_above else "unpack the metadata there")
        )
    if version is not None and version not in versions:
        raise AdapterError(
            f"{root} has no tables of version={version}; it has {_list_names(versions)}"
        )
    published_versions = [name for name in versions if name.startswith(_PUBLISHED_PREFIX)]
    choice = [version] if version is not None else published_versions or versions
    if len(choice) > 1:
        raise AdapterError(
            f"{root} holds several versions; add version= one of {_list_names(choice)}"
        )
    return choice[0]


def table_folders(root: Path) -> list[str]:
    """Return the names of the folders with nuScenes tables in a dataset's folder.

    They are v1.0-mini or such, or any name that a converter chose.
    """
    folders = sorted(path.parent for path in root.glob("*/scene.json"))
    return [folder.name for folder in folders if _holds_tables(folder)]


def _holds_tables(folder: Path) -> bool:
    """Return True if a folder holds the table of scenes and at least one other table."""
    other_tables = ("sample", "sample_data", "calibrated_sensor")  # a missing one is told later
    is_file = [(folder / f"{name}.json").is_file() for name in ("scene", *other_tables)]
    return is_file[0] and any(is_file[1:])


def choose_scene(folder: Path, scene: str | None) -> Row:
    """Return the row of the scene of a name or token, or the only one."""
    rows = list(read_table(folder / "scene.json").values())
    matching_rows = [row for row in rows if scene in (None, row.token, row.text("name"))]
    names = _list_names([row.text("name") for row in rows])
    if len(matching_rows) == 1:
        return matching_rows[0]
    if not rows:
        raise AdapterError(f"{folder / 'scene.json'} holds no scene")
    if scene is None:
        raise AdapterError(
            f"{folder} holds {len(rows)} scenes; add scene= the name or token of one: {names}"
        )
    if not matching_rows:
        raise AdapterError(f"{folder} has no scene {scene!r}; it has {len(rows)}: {names}")
    tokens = ", ".join(row.token for row in matching_rows)
    raise AdapterError(
        f"{folder} has {len(matching_rows)} scenes {scene!r}; give a token: {tokens}"
    )


def _list_names(names: list[str]) -> str:
    """Return names for a message, the first ones only if there are many."""
    num_others = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {num_others} more" if num_others > 0 else "")


def _read_files(root: Path, folder: Path, samples: Mapping[str, Row]) -> tuple[SensorFile, ...]:
    """Read the images and the sweeps of LIDAR of a scene, in order of time."""
    sensors = read_table(folder / "sensor.json")
    calibrations = read_table(folder / "calibrated_sensor.json")
    channels: dict[str, tuple[str, _PosedRow]] = {}  # by calibration, of those sensors alone
    for token, row in calibrations.items():
        sensor = find_row(row, "sensor_token", sensors, "sensor")
        is_camera = sensor.text("modality") == "camera"
        if is_camera or sensor.text("channel") == LIDAR:
            channels[token] = (
                sensor.text("channel"),
                row.read(_CameraRow if is_camera else _PosedRow),
            )
    rows: dict[str, Row] = {}
    for token, row in read_table(folder / "sample_data.json", "sample_token", samples).items():
        find_row(row, "calibrated_sensor_token", calibrations, "calibrated_sensor")
        if row.text("calibrated_sensor_token") in channels:
            rows[token] = row
    pose_tokens = {row.text("ego_pose_token") for row in rows.values()}
    poses = read_table(folder / "ego_pose.json", "token", pose_tokens)
    files = []
    for row in rows.values():
        channel, calibration = channels[row.text("calibrated_sensor_token")]
        is_camera = isinstance(calibration, _CameraRow)
        data = row.read(_ImageRow if is_camera else _DataRow)
        resolve_inside(root, data.filename, f"{row}: field 'filename'")
        files.append(
            SensorFile(
                token=row.token,
                sample_token=data.sample_token,
                channel=channel,
                filename=data.filename,
                is_key_frame=data.is_key_frame,
                timestamp_ns=data.timestamp * 1000,
                world_from_ego=find_row(row, "ego_pose_token", poses, "ego_pose")
                .read(_PosedRow)
                .pose(),
                ego_from_sensor=calibration.pose(),
                intrinsic=calibration.camera_intrinsic if is_camera else None,
                size=(data.width, data.height) if isinstance(data, _ImageRow) else None,
            )
        )
    return tuple(sorted(files, key=lambda file: file.timestamp_ns))


def _read_samples(
    folder: Path, samples: Mapping[str, Row], categories: Mapping[str, _CategoryRow]
) -> tuple[Sample, ...]:
    """Read the keyframes with their boxes, in order of time."""
    rows = read_table(folder / "sample_annotation.json", "sample_token", samples)
    instance_tokens = {row.text("instance_token") for row in rows.values()}
    instances = read_table(folder / "instance.json", "token", instance_tokens)
    names = {
        token: row.text("name") for token, row in read_table(folder / "attribute.json").items()
    }
    levels = {t: row.text("level") for t, row in read_table(folder / "visibility.json").items()}
    by_sample: dict[str, list[_Box]] = {token: [] for token in samples}
    for row in rows.values():
        instance = find_row(row, "instance_token", instances, "instance")
        category = find_row(instance, "category_token", categories, "category")
        visibility = row.text("visibility_token")
        if visibility and visibility not in levels:
            raise row.fault("visibility_token", "the token of a row of visibility.json, or empty")
        box = row.read(_AnnotationRow)
        if not all(name in names for name in box.attribute_tokens):
            raise row.fault("attribute_tokens", "tokens of rows of attribute.json")
        attributes = ",".join(names[name] for name in box.attribute_tokens)
        visibility_level = levels[visibility] if visibility else ""
        box_row = _Box(row.token, instance.token, category.name, box, attributes, visibility_level)
        by_sample[row.text("sample_token")].append(box_row)
    unsorted_samples = [
        Sample(token, row.read(_TimedRow).timestamp * 1000, _boxes(by_sample[token]))
        for token, row in samples.items()
    ]
    return tuple(sorted(unsorted_samples, key=lambda sample: sample.timestamp_ns))


class _Box(NamedTuple):
    token: str
    instance: str
    category: str
    annotation: _AnnotationRow
    attributes: str
    visibility: str


def _boxes(rows: Sequence[_Box]) -> Boxes:
    """Return the boxes of a keyframe."""
    boxes = [row.annotation for row in rows]
    sizes_m = np.array([box.size for box in boxes], np.float64).reshape(-1, 3)
    return Boxes(
        tuple(row.instance for row in rows),
        tuple(row.category for row in rows),
        centers_m=np.array([box.translation for box in boxes], np.float64).reshape(-1, 3),
        sizes_m=np.ascontiguousarray(sizes_m[:, [1, 0, 2]]),  # length, width, height
        quats=np.array([box.rotation for box in boxes], np.float64).reshape(-1, 4),
        attributes={
            "token": np.array([row.token for row in rows], object),
            "attributes": np.array([row.attributes for row in rows], object),
            "visibility": np.array([row.visibility for row in rows], object),
            "num_lidar_pts": np.array([box.num_lidar_pts for box in boxes], np.int64),
            "num_radar_pts": np.array([box.num_radar_pts for box in boxes], np.int64),
        },
    )


def _files_of_sweeps(root: Path, path: Path, lidar: Sequence[SensorFile]) -> dict[str, str]:
    """Return the files that a table names for sweeps, by the sweep's token.

    It is empty without the table.
    """
    if not path.exists():
        return {}
    sweeps = {file.token for file in lidar}
    files: dict[str, str] = {}
    for row in read_rows(path):
        sweep = row.text("sample_data_token")
        if sweep in sweeps:
            resolve_inside(root, row.text("filename"), f"{row}: field 'filename'")
            files[sweep] = row.text("filename")
    return files


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """Files of one frame.

    Attributes:
        index: number of the frame.
        sweep: LiDAR file, whose time is the frame's.
        images: by camera, the images nearest to that time. A camera without an image near it is
            absent.
    """

    index: int
    sweep: SensorFile
    images: Mapping[str, SensorFile]


def scene_frames(
    tables: SceneTables, *, sweeps: bool
) -> tuple[tuple[FrameFiles, ...], tuple[str, ...]]:
    """Return the frames of a scene, in order of time, and a sentence for each camera with unused
    images.

    A keyframe has its own images. Each other image goes to the nearest frame that has none of its
    camera yet, nearest pairs first.

    Args:
        tables: the scene's tables.
        sweeps: True for one frame per LiDAR file (20 a second; cameras take 12 images), False for
            one per keyframe.
    """
    lidar_files = [file for file in tables.lidar if sweeps or file.is_key_frame]
    images: list[dict[str, SensorFile]] = [{} for _ in lidar_files]
    problems = []
    for channel, files in tables.images.items():
        if not sweeps:
            files = tuple(file for file in files if file.is_key_frame)
        matches = _match_images(lidar_files, files)
        for number, file in matches.items():
            images[number][channel] = file
        num_unused = len(files) - len(matches)
        if num_unused:
            problems.append(
                f"camera {channel}: {num_unused} of {len(files)} images have no frame, since no "
                f"sweep of {LIDAR} that lacks an image of this camera lies within "
                f"{_MAX_TIME_DIFFERENCE_NS / 1e9:.1f} s of them"
            )
    frames = zip(lidar_files, images, strict=True)
    return tuple(FrameFiles(i, *frame) for i, frame in enumerate(frames)), tuple(problems)


def _match_images(
    sweeps: Sequence[SensorFile], files: Sequence[SensorFile]
) -> dict[int, SensorFile]:
    """Return one camera's images by the number of their sweep."""
    pairs = []
    for j, file in enumerate(files):
        for i, sweep in enumerate(sweeps):
            time_difference = abs(sweep.timestamp_ns - file.timestamp_ns)
            is_same_keyframe = sweep.is_key_frame and file.is_key_frame
            is_same_keyframe = is_same_keyframe and sweep.sample_token == file.sample_token
            if is_same_keyframe or time_difference <= _MAX_TIME_DIFFERENCE_NS:
                pairs.append((not is_same_keyframe, time_difference, i, j))
    matches: dict[int, SensorFile] = {}
    used_images: set[int] = set()
    for _, _, i, j in sorted(pairs):
        if i not in matches and j not in used_images:
            matches[i] = files[j]
            used_images.add(j)
    return matches
