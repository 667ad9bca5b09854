"""The tables of one nuScenes scene, read and checked; nothing here opens an image or a sweep.

    v1.0-*/scene.json, sample.json, sample_data.json, sample_annotation.json, ...   the tables
    samples/<CHANNEL>/, sweeps/<CHANNEL>/    files of keyframes, and of what lies between them
    lidarseg/v1.0-*/<token>_lidarseg.bin     class of each return of keyframes, where published
    panoptic/v1.0-*/<token>_panoptic.npz     class and object of each, likewise

A table is a JSON list of objects. It is read once, row by row, never in memory as a whole, and only
what belongs to the scene is kept: of mini that takes a second; of trainval, whose tables have 2 GB,
about half a minute. Rows are taken in order of time; prev and next links are not needed.
Coordinates are nuScenes' global ones in metres, times are nanoseconds. Errors are AdapterErrors
that name table, row and field.

nuScenes publishes one time a sweep, that of the end of its turn, and no times of returns. But the
sensor turns clockwise in 50 ms, and each camera is triggered as the LiDAR sweeps across the middle
of its view. So the keyframes' images tell the bearing at which a turn ends (to the left, a little
behind), and that tells the time of everything. It matters for what moves: its boxes stand where the
LiDAR met it, up to 50 ms before the sweep's time, as do the images.
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

from adapters.plain_files import Number, Text, inside, validated
from adapters.raw_drive import DriveOptions
from augment.errors import AdapterError
from augment.labels import Boxes
from recipes.files import open_file

_CHUNK = 1 << 22  # characters read at a time
_MAX_ROW = 1 << 24  # no published row has a ten-thousandth of it
_BETWEEN = re.compile(r"[\s,]*")
_UNIT_TOLERANCE = 1e-3
TURN_NS = 50_000_000
_TWO_PI = 2 * np.pi
# Images of one keyframe published agree to 4 degrees; other data in nuScenes's form need not turn
# like this at all.
_MAX_SPREAD_RAD = np.radians(20)
# The LiDAR turns in 50 ms; further from a sweep than two turns an image belongs to none.
_NEAR_NS = 100_000_000
LIDAR = "LIDAR_TOP"
_PUBLISHED = "v1.0-"  # how the names of published versions begin
_MAX_NAMES = 10  # that a message lists

# ---- What rows must hold; later editions may have more fields ------------------------------------

_Model = TypeVar("_Model", bound=BaseModel)
_Found = TypeVar("_Found")
_Vector = tuple[Number, Number, Number]
_Count = Annotated[int, Field(strict=True, ge=0, lt=2**62)]
_Pixels = Annotated[_Count, Field(ge=1)]
_Length = Annotated[Number, Field(gt=0)]


def _unit(quat: tuple[float, ...]) -> tuple[float, ...]:
    if abs(float(np.linalg.norm(quat)) - 1) > _UNIT_TOLERANCE:
        raise ValueError("must be a quaternion wxyz of length 1")
    return quat


def _pinhole(matrix: tuple[_Vector, _Vector, _Vector]) -> tuple[float, float, float, float]:
    (fx, _, cx), (_, fy, cy), _ = matrix
    plain = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if min(fx, fy) <= 0 or not np.allclose(matrix, plain, rtol=0, atol=1e-6):
        raise ValueError("must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    return fx, fy, cx, cy


def _whole(time: object) -> object:
    """Some converters write the same number as a float."""
    return int(time) if isinstance(time, float) and time.is_integer() else time


class _Timed(BaseModel):
    """timestamp: microseconds."""

    timestamp: Annotated[_Count, Field(gt=0, lt=2**62 // 1000), BeforeValidator(_whole)]


class _Posed(BaseModel):
    """translation: metres."""

    translation: _Vector
    rotation: Annotated[tuple[Number, Number, Number, Number], AfterValidator(_unit)]

    def pose(self) -> np.ndarray:
        """float64 [4, 4]."""
        w, x, y, z = self.rotation
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        pose[:3, 3] = self.translation
        return pose


class _Camera(_Posed):
    camera_intrinsic: Annotated[tuple[_Vector, _Vector, _Vector], AfterValidator(_pinhole)]


class _Data(_Timed):
    sample_token: Text
    filename: Text
    is_key_frame: Annotated[bool, Field(strict=True)]


class _Image(_Data):
    width: _Pixels
    height: _Pixels


class _Annotation(_Posed):
    """size: width, length, height, metres."""

    size: tuple[_Length, _Length, _Length]
    attribute_tokens: Annotated[list[Text], FailFast()]
    num_lidar_pts: _Count
    num_radar_pts: _Count


class _Category(BaseModel):
    name: Text
    index: _Count | None = None  # tables without lidarseg do not number them


# ---- Tables --------------------------------------------------------------------------------------


class Row(NamedTuple):
    """One row as in the file. path: its table."""

    path: Path
    number: int
    fields: dict[str, Any]

    def __str__(self) -> str:
        name = self.fields.get("token")
        named = repr(name) if isinstance(name, str) and name else f"number {self.number}"
        return f"{self.path}: row {named}"

    @property
    def token(self) -> str:
        token = self.text("token")
        if not token:
            raise self.fault("token", "a text that is not empty")
        return token

    def text(self, field: str) -> str:
        value = self.fields.get(field)
        # Half a pair of surrogates, as JSON can have, cannot be written again.
        if isinstance(value, str) and (value.isascii() or not re.search("[\ud800-\udfff]", value)):
            return value
        raise self.fault(field, "a text")

    def read(self, model: type[_Model]) -> _Model:
        return validated(model, self.fields, str(self))

    def fault(self, field: str, expected: str) -> AdapterError:
        """The error that the field is not what was expected."""
        got = f"{self.fields[field]!r:.200}" if field in self.fields else "no such field"
        return AdapterError(f"{self}: field {field!r} must be {expected}; got {got}")


def read_rows(path: Path) -> Iterator[Row]:
    """The rows of a table, in its order."""
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
    """The rows by their token, in the table's order; only those whose text `field` is among the
    values, where these are given."""
    kept: dict[str, Row] = {}
    for row in read_rows(path):
        if values is not None and row.text(field) not in values:
            continue
        if row.token in kept:
            raise AdapterError(
                f"{row}: the token of an earlier row too (row number {kept[row.token].number}); "
                f"tokens must be unique within a table"
            )
        kept[row.token] = row
    return kept


def referred(row: Row, field: str, table: Mapping[str, _Found], name: str) -> _Found:
    """The row that a field names by its token. name: the table's, for the message."""
    found = table.get(row.text(field))
    if found is None:
        raise row.fault(field, f"the token of a row of {name}.json, which has no such row")
    return found


def _rows(path: Path, file: Any) -> Iterator[Row]:
    decoder = json.JSONDecoder()
    first = file.read(1)
    while first.isspace():
        first = file.read(1)
    if first != "[":
        start = first + file.read(20)
        raise AdapterError(f"{path} must hold a list of rows; it starts with {start!r}")
    text, position, number, ended = "", 0, 0, False
    while True:
        between = _BETWEEN.match(text, position)
        assert between is not None
        position = between.end()
        if text[position : position + 1] == "]":
            return
        try:
            fields, position = decoder.raw_decode(text, position)
        except (ValueError, RecursionError) as error:
            if ended or len(text) - position > _MAX_ROW or isinstance(error, RecursionError):
                reason = "it is cut short" if ended and position >= len(text) else str(error)
                raise AdapterError(
                    f"{path} is not readable JSON after its first {number} rows ({reason}); copy "
                    f"it again"
                ) from None
            more = file.read(_CHUNK)
            text, position, ended = text[position:] + more, 0, not more
            continue
        if not isinstance(fields, dict):
            raise AdapterError(
                f"{path}: row number {number} must be an object; got {type(fields).__name__}"
            )
        yield Row(path, number, fields)
        number += 1


@dataclass(frozen=True)
class Turn:
    """end_rad: bearing of the end of a turn, from the car's forward axis to the left; None where it
    is not known, then everything counts as seen at the sweep's time."""

    end_rad: float | None

    @staticmethod
    def of_images(bearings_rad: np.ndarray, before_ns: np.ndarray) -> Turn:
        """The turn told by images: where their cameras look, and how long before their keyframe's
        sweep they were taken; both [N]."""
        looks_apart = len(bearings_rad) > 1 and np.ptp(bearings_rad) > _MAX_SPREAD_RAD
        if not looks_apart:
            return Turn(None)
        ends = bearings_rad - _TWO_PI * before_ns / TURN_NS
        end = float(np.angle(np.exp(1j * ends).mean()))
        spread = np.abs(np.angle(np.exp(1j * (ends - end))))
        return Turn(end if np.quantile(spread, 0.9) < _MAX_SPREAD_RAD else None)

    def before_ns(self, directions: np.ndarray) -> np.ndarray:
        """How long before the sweep's time the LiDAR looked there, int64 [N].

        directions: [N, 2 or 3] from the sensor, in the car's axes; no numbers count as forward."""
        if self.end_rad is None:
            return np.zeros(len(directions), np.int64)
        bearings = np.arctan2(directions[:, 1], directions[:, 0])
        past = np.mod(np.nan_to_num(bearings) - self.end_rad, _TWO_PI) / _TWO_PI
        return np.round(past * TURN_NS).astype(np.int64)


class NuScenesOptions(DriveOptions):
    """version, scene: the only one there is without them."""

    version: str | None = Field(None, description="a folder of tables such as v1.0-mini")
    scene: str | None = Field(None, description="a scene's name or token")
    sweeps: Literal["1", "0"] = Field(
        "1", description="1 for keyframes and the sweeps between them, 0 for keyframes only"
    )


@dataclass(frozen=True, eq=False)
class SensorFile:
    """One image or sweep: a row of sample_data and what it refers to.

    filename: relative to the dataset's folder, inside it. world_from_ego, ego_from_sensor: float64
    [4, 4], at the file's own time. intrinsic: fx, fy, cx, cy, pixels, and size: width, height, both
    None of a LiDAR."""

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
        return self.world_from_ego @ self.ego_from_sensor


@dataclass(frozen=True, eq=False)
class Sample:
    """A keyframe and its boxes, with the attributes that NuScenesLabels says but `interpolated`."""

    token: str
    timestamp_ns: int
    boxes: Boxes


@dataclass(frozen=True, eq=False)
class SceneTables:
    """One scene, everything in order of time.

    lidar: sweeps of LIDAR_TOP. images: by camera. semantic_files, panoptic_files: the lidarseg and
    panoptic file of a sweep by its token. class_names: by the numbers in those files. turn: how
    the LiDAR turns."""

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
    """The tables of the scene of that name or token.

    version, scene: None for the only one."""
    folder = root / _choose_version(root, version)
    row = _choose_scene(folder, scene)
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
    categories = {token: row.read(_Category) for token, row in rows.items()}
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
    sweeps = {file.sample_token: file.timestamp_ns for file in lidar if file.is_key_frame}
    keys = [
        (np.arctan2(file.ego_from_sensor[1, 2], file.ego_from_sensor[0, 2]), file)
        for files in images.values()
        for file in files
        if file.is_key_frame and file.sample_token in sweeps
    ]
    before = [sweeps[file.sample_token] - file.timestamp_ns for _, file in keys]
    return Turn.of_images(np.array([bearing for bearing, _ in keys]), np.array(before))


def _choose_version(root: Path, version: str | None) -> str:
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a nuScenes dataset with v1.0-*/")
    versions = table_folders(root)
    if not versions:
        above = root.absolute().parent
        is_above = bool(table_folders(above)) or _holds_tables(root)
        raise AdapterError(
            f"{root} holds no nuScenes tables (v1.0-*/scene.json), such as those of v1.0-mini; "
            + (f"give the folder above it, {above}" if is_above else "unpack the metadata there")
        )
    if version is not None and version not in versions:
        raise AdapterError(f"{root} has no tables of version={version}; it has {_listed(versions)}")
    published = [name for name in versions if name.startswith(_PUBLISHED)]
    choice = [version] if version is not None else published or versions
    if len(choice) > 1:
        raise AdapterError(f"{root} holds several versions; add version= one of {_listed(choice)}")
    return choice[0]


def table_folders(root: Path) -> list[str]:
    """Names of the folders with nuScenes tables in a dataset's folder: v1.0-mini or such, or
    whatever a converter called its own."""
    folders = sorted(path.parent for path in root.glob("*/scene.json"))
    return [folder.name for folder in folders if _holds_tables(folder)]


def _holds_tables(folder: Path) -> bool:
    others = ("sample", "sample_data", "calibrated_sensor")  # a missing one is told later
    is_there = [(folder / f"{name}.json").is_file() for name in ("scene", *others)]
    return is_there[0] and any(is_there[1:])


def _choose_scene(folder: Path, scene: str | None) -> Row:
    rows = list(read_table(folder / "scene.json").values())
    chosen = [row for row in rows if scene in (None, row.token, row.text("name"))]
    names = _listed([row.text("name") for row in rows])
    if len(chosen) == 1:
        return chosen[0]
    if not rows:
        raise AdapterError(f"{folder / 'scene.json'} holds no scene")
    if scene is None:
        raise AdapterError(
            f"{folder} holds {len(rows)} scenes; add scene= the name or token of one: {names}"
        )
    if not chosen:
        raise AdapterError(f"{folder} has no scene {scene!r}; it has {len(rows)}: {names}")
    tokens = ", ".join(row.token for row in chosen)
    raise AdapterError(f"{folder} has {len(chosen)} scenes {scene!r}; give a token: {tokens}")


def _listed(names: list[str]) -> str:
    rest = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def _read_files(root: Path, folder: Path, samples: Mapping[str, Row]) -> tuple[SensorFile, ...]:
    """The images, and the sweeps of LIDAR, of the keyframes and between them, in order of time."""
    sensors = read_table(folder / "sensor.json")
    calibrations = read_table(folder / "calibrated_sensor.json")
    channels: dict[str, tuple[str, _Posed]] = {}  # by calibration, of those sensors alone
    for token, row in calibrations.items():
        sensor = referred(row, "sensor_token", sensors, "sensor")
        is_camera = sensor.text("modality") == "camera"
        if is_camera or sensor.text("channel") == LIDAR:
            channels[token] = sensor.text("channel"), row.read(_Camera if is_camera else _Posed)
    rows: dict[str, Row] = {}
    for token, row in read_table(folder / "sample_data.json", "sample_token", samples).items():
        referred(row, "calibrated_sensor_token", calibrations, "calibrated_sensor")
        if row.text("calibrated_sensor_token") in channels:
            rows[token] = row
    pose_tokens = {row.text("ego_pose_token") for row in rows.values()}
    poses = read_table(folder / "ego_pose.json", "token", pose_tokens)
    files = []
    for row in rows.values():
        channel, calibration = channels[row.text("calibrated_sensor_token")]
        is_camera = isinstance(calibration, _Camera)
        data = row.read(_Image if is_camera else _Data)
        inside(root, data.filename, f"{row}: field 'filename'")
        files.append(
            SensorFile(
                token=row.token,
                sample_token=data.sample_token,
                channel=channel,
                filename=data.filename,
                is_key_frame=data.is_key_frame,
                timestamp_ns=data.timestamp * 1000,
                world_from_ego=referred(row, "ego_pose_token", poses, "ego_pose")
                .read(_Posed)
                .pose(),
                ego_from_sensor=calibration.pose(),
                intrinsic=calibration.camera_intrinsic if is_camera else None,
                size=(data.width, data.height) if isinstance(data, _Image) else None,
            )
        )
    return tuple(sorted(files, key=lambda file: file.timestamp_ns))


def _read_samples(
    folder: Path, samples: Mapping[str, Row], categories: Mapping[str, _Category]
) -> tuple[Sample, ...]:
    rows = read_table(folder / "sample_annotation.json", "sample_token", samples)
    instance_tokens = {row.text("instance_token") for row in rows.values()}
    instances = read_table(folder / "instance.json", "token", instance_tokens)
    names = {
        token: row.text("name") for token, row in read_table(folder / "attribute.json").items()
    }
    levels = {t: row.text("level") for t, row in read_table(folder / "visibility.json").items()}
    by_sample: dict[str, list[_Box]] = {token: [] for token in samples}
    for row in rows.values():
        instance = referred(row, "instance_token", instances, "instance")
        category = referred(instance, "category_token", categories, "category")
        visibility = row.text("visibility_token")
        if visibility and visibility not in levels:
            raise row.fault("visibility_token", "the token of a row of visibility.json, or empty")
        box = row.read(_Annotation)
        if not all(name in names for name in box.attribute_tokens):
            raise row.fault("attribute_tokens", "tokens of rows of attribute.json")
        said = ",".join(names[name] for name in box.attribute_tokens)
        seen = levels[visibility] if visibility else ""
        found = _Box(row.token, instance.token, category.name, box, said, seen)
        by_sample[row.text("sample_token")].append(found)
    read = [
        Sample(token, row.read(_Timed).timestamp * 1000, _boxes(by_sample[token]))
        for token, row in samples.items()
    ]
    return tuple(sorted(read, key=lambda sample: sample.timestamp_ns))


class _Box(NamedTuple):
    token: str
    instance: str
    category: str
    annotation: _Annotation
    attributes: str
    visibility: str


def _boxes(rows: Sequence[_Box]) -> Boxes:
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
    """The files that a table names for sweeps, by the sweep's token; none without the table."""
    if not path.exists():
        return {}
    sweeps = {file.token for file in lidar}
    files: dict[str, str] = {}
    for row in read_rows(path):
        sweep = row.text("sample_data_token")
        if sweep in sweeps:
            inside(root, row.text("filename"), f"{row}: field 'filename'")
            files[sweep] = row.text("filename")
    return files


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame. sweep: its LiDAR file, whose time is the frame's. images: by camera, those taken
    nearest to that; a camera that took none near it is absent."""

    index: int
    sweep: SensorFile
    images: Mapping[str, SensorFile]


def scene_frames(
    tables: SceneTables, *, sweeps: bool
) -> tuple[tuple[FrameFiles, ...], tuple[str, ...]]:
    """The frames of a scene, numbered in order of time, and a sentence for each camera with images
    in none of them.

    sweeps: one frame a LiDAR file (20 a second; cameras take 12 images), else one a keyframe. A
    keyframe has its own images; each other image goes to the nearest frame that has none of its
    camera yet, nearest pairs first."""
    chosen = [file for file in tables.lidar if sweeps or file.is_key_frame]
    images: list[dict[str, SensorFile]] = [{} for _ in chosen]
    problems = []
    for channel, files in tables.images.items():
        if not sweeps:
            files = tuple(file for file in files if file.is_key_frame)
        matches = _match(chosen, files)
        for number, file in matches.items():
            images[number][channel] = file
        unused = len(files) - len(matches)
        if unused:
            problems.append(
                f"camera {channel}: {unused} of {len(files)} images have no frame, since no sweep "
                f"of {LIDAR} that lacks an image of this camera lies within "
                f"{_NEAR_NS / 1e9:.1f} s of them"
            )
    frames = zip(chosen, images, strict=True)
    return tuple(FrameFiles(i, *frame) for i, frame in enumerate(frames)), tuple(problems)


def _match(sweeps: Sequence[SensorFile], files: Sequence[SensorFile]) -> dict[int, SensorFile]:
    """One camera's images by the number of their sweep."""
    pairs = []
    for j, file in enumerate(files):
        for i, sweep in enumerate(sweeps):
            apart = abs(sweep.timestamp_ns - file.timestamp_ns)
            own = sweep.is_key_frame and file.is_key_frame
            own = own and sweep.sample_token == file.sample_token
            if own or apart <= _NEAR_NS:
                pairs.append((not own, apart, i, j))
    matches: dict[int, SensorFile] = {}
    taken: set[int] = set()
    for _, _, i, j in sorted(pairs):
        if i not in matches and j not in taken:
            matches[i] = files[j]
            taken.add(j)
    return matches
