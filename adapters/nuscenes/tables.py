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
from typing import Any, Literal, TypeGuard

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from adapters.plain_files import LARGEST, array_of, inside
from adapters.raw_drive import DriveOptions
from augment.errors import AdapterError
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
_MAX_NAMES = 10  # that a message lists


@dataclass(frozen=True)
class Row:
    """One row. path: its table. fields: as in the file, of which later editions may have more. All
    readers raise AdapterError, naming table, row and field, where a field is missing or wrong."""

    path: Path
    number: int
    fields: dict[str, Any]

    def __str__(self) -> str:
        name = self.fields.get("token")
        return f"{self.path}: row {name!r}" if isinstance(name, str) else self._numbered

    @property
    def _numbered(self) -> str:
        return f"{self.path}: row number {self.number}"

    @property
    def token(self) -> str:
        token = self.text("token")
        if not token:
            raise AdapterError(f"{self._numbered}: field 'token' must not be empty")
        return token

    def fault(self, field: str, expected: str) -> AdapterError:
        """The error that the field is not what was expected."""
        try:
            got = repr(self.fields[field]) if field in self.fields else "no such field"
        except RecursionError:
            got = "lists in lists"
        got = got if len(got) <= 200 else got[:200] + "…"
        return AdapterError(f"{self}: field {field!r} must be {expected}; got {got}")

    def text(self, field: str) -> str:
        value = self.fields.get(field)
        if not _is_text(value):
            raise self.fault(field, "a text")
        return value

    def texts(self, field: str) -> tuple[str, ...]:
        value = self.fields.get(field)
        if not isinstance(value, list) or not all(map(_is_text, value)):
            raise self.fault(field, "a list of texts")
        return tuple(value)

    def integer(self, field: str, *, low: int = 0) -> int:
        value = self.fields.get(field)
        if type(value) is not int or not low <= value < 2**62:
            raise self.fault(field, f"an integer of at least {low}")
        return value

    def nanoseconds(self) -> int:
        """The field `timestamp`, which the table has in microseconds."""
        value = self.fields.get("timestamp")
        # Some converters write the same number as a float.
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if type(value) is not int or not 0 < value < 2**62 // 1000:
            raise self.fault("timestamp", "a time in microseconds, a whole number above 0")
        return value * 1000

    def flag(self, field: str) -> bool:
        value = self.fields.get(field)
        if not isinstance(value, bool):
            raise self.fault(field, "true or false")
        return value

    def numbers(self, field: str, count: int) -> np.ndarray:
        """float64 [count], finite."""
        value = self.fields.get(field)
        if not isinstance(value, list) or len(value) != count or not all(map(_is_finite, value)):
            raise self.fault(field, f"a list of {count} finite numbers of at most {LARGEST:g}")
        return np.array(value, np.float64)

    def quaternion(self) -> np.ndarray:
        """The field `rotation`, wxyz, as it is: float64 [4]."""
        quat = self.numbers("rotation", 4)
        if abs(float(np.linalg.norm(quat)) - 1) > _UNIT_TOLERANCE:
            raise self.fault("rotation", "a quaternion wxyz of length 1")
        return quat

    def pose(self) -> np.ndarray:
        """The fields `translation` (metres) and `rotation`, float64 [4, 4]."""
        w, x, y, z = self.quaternion()
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        pose[:3, 3] = self.numbers("translation", 3)
        return pose


def read_rows(path: Path) -> Iterator[Row]:
    """The rows of a table, in its order."""
    try:
        with io.TextIOWrapper(open_file(path), encoding="utf-8") as file:
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
                f"tokens must be unique, copy the table again"
            )
        kept[row.token] = row
    return kept


def referred(row: Row, field: str, table: dict[str, Row], name: str) -> Row:
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


def _is_finite(value: object) -> bool:
    return type(value) in (int, float) and -LARGEST <= value <= LARGEST  # type: ignore[operator]


def _is_text(value: object) -> TypeGuard[str]:
    """Whether a text can be written again: half a pair of surrogates, as JSON can have, cannot."""
    if not isinstance(value, str):
        return False
    return value.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in value)


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
    [4, 4], at the file's own time. intrinsic: fx, fy, cx, cy, pixels; None of a LiDAR. width,
    height: pixels; 0 of a LiDAR."""

    token: str
    sample_token: str
    channel: str
    filename: str
    is_key_frame: bool
    timestamp_ns: int
    world_from_ego: np.ndarray
    ego_from_sensor: np.ndarray
    intrinsic: tuple[float, float, float, float] | None
    width: int
    height: int

    @property
    def world_from_sensor(self) -> np.ndarray:
        return self.world_from_ego @ self.ego_from_sensor


@dataclass(frozen=True, eq=False)
class Annotation:
    """One box of a keyframe, as in sample_annotation. center_m, quat (wxyz): global. size_m:
    length, width, height. attributes, visibility: names, the latter '' where not known."""

    token: str
    instance: str
    category: str
    center_m: np.ndarray
    size_m: np.ndarray
    quat: np.ndarray
    attributes: tuple[str, ...]
    visibility: str
    lidar_points: int
    radar_points: int


@dataclass(frozen=True, eq=False)
class Sample:
    """A keyframe and its boxes."""

    token: str
    timestamp_ns: int
    annotations: tuple[Annotation, ...]


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
    categories = read_table(folder / "category.json")
    return SceneTables(
        root=root,
        version=folder.name,
        name=row.text("name"),
        samples=_read_samples(folder, samples, categories),
        lidar=lidar,
        images=images,
        semantic_files=_files_of_sweeps(root, folder / "lidarseg.json", lidar),
        panoptic_files=_files_of_sweeps(root, folder / "panoptic.json", lidar),
        # Tables without lidarseg do not number their categories.
        class_names={
            row.integer("index"): row.text("name")
            for row in categories.values()
            if "index" in row.fields
        },
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
    found = sorted(path.parent.name for path in root.glob("v1.0-*/scene.json"))
    if not found:
        above = root.absolute().parent
        is_above = any(above.glob("v1.0-*/scene.json")) or (root / "scene.json").is_file()
        raise AdapterError(
            f"{root} holds no nuScenes tables (v1.0-*/scene.json), such as those of v1.0-mini; "
            + (f"give the folder above it, {above}" if is_above else "unpack the metadata there")
        )
    if version is None and len(found) > 1:
        raise AdapterError(f"{root} holds several versions; add version= one of {_listed(found)}")
    if version is not None and version not in found:
        raise AdapterError(f"{root} has no tables of version={version}; it has {_listed(found)}")
    return version or found[0]


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
    sensors = read_table(folder / "sensor.json")
    calibrations = read_table(folder / "calibrated_sensor.json")
    channels: dict[str, Row] = {}
    for token, row in calibrations.items():
        sensor = referred(row, "sensor_token", sensors, "sensor")
        if sensor.text("channel") == LIDAR or sensor.text("modality") == "camera":
            channels[token] = sensor
    rows: dict[str, Row] = {}
    for token, row in read_table(folder / "sample_data.json", "sample_token", samples).items():
        referred(row, "calibrated_sensor_token", calibrations, "calibrated_sensor")
        if row.text("calibrated_sensor_token") in channels:  # not a radar's
            rows[token] = row
    pose_tokens = {row.text("ego_pose_token") for row in rows.values()}
    poses = read_table(folder / "ego_pose.json", "token", pose_tokens)
    files = []
    for row in rows.values():
        calibration = calibrations[row.text("calibrated_sensor_token")]
        pose = referred(row, "ego_pose_token", poses, "ego_pose")
        files.append(_sensor_file(root, row, calibration, channels[calibration.token], pose))
    return tuple(sorted(files, key=lambda file: file.timestamp_ns))


def _sensor_file(root: Path, row: Row, calibration: Row, sensor: Row, pose: Row) -> SensorFile:
    is_camera = sensor.text("modality") == "camera"
    name = row.text("filename")
    inside(root, name, f"{row}: field 'filename'")
    return SensorFile(
        token=row.token,
        sample_token=row.text("sample_token"),
        channel=sensor.text("channel"),
        filename=name,
        is_key_frame=row.flag("is_key_frame"),
        timestamp_ns=row.nanoseconds(),
        world_from_ego=pose.pose(),
        ego_from_sensor=calibration.pose(),
        intrinsic=_intrinsic(calibration) if is_camera else None,
        width=row.integer("width", low=1) if is_camera else 0,
        height=row.integer("height", low=1) if is_camera else 0,
    )


def _intrinsic(row: Row) -> tuple[float, float, float, float]:
    expected = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0"
    matrix = array_of(row.fields.get("camera_intrinsic"))
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise row.fault("camera_intrinsic", expected)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    plain = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if min(fx, fy) <= 0 or not np.allclose(matrix, plain, rtol=0, atol=1e-6):
        raise row.fault("camera_intrinsic", expected)
    return float(fx), float(fy), float(cx), float(cy)


def _read_samples(
    folder: Path, samples: Mapping[str, Row], categories: dict[str, Row]
) -> tuple[Sample, ...]:
    rows = read_table(folder / "sample_annotation.json", "sample_token", samples)
    instance_tokens = {row.text("instance_token") for row in rows.values()}
    instances = read_table(folder / "instance.json", "token", instance_tokens)
    attributes = read_table(folder / "attribute.json")
    visibilities = read_table(folder / "visibility.json")
    by_sample: dict[str, list[Annotation]] = {token: [] for token in samples}
    for row in rows.values():
        instance = referred(row, "instance_token", instances, "instance")
        visibility = row.text("visibility_token")
        if visibility and visibility not in visibilities:
            raise row.fault("visibility_token", "the token of a row of visibility.json, or empty")
        names = row.texts("attribute_tokens")
        if not all(name in attributes for name in names):
            raise row.fault("attribute_tokens", "tokens of rows of attribute.json")
        by_sample[row.text("sample_token")].append(
            Annotation(
                token=row.token,
                instance=instance.token,
                category=referred(instance, "category_token", categories, "category").text("name"),
                center_m=row.numbers("translation", 3),
                size_m=_size(row),
                quat=row.quaternion(),
                attributes=tuple(attributes[name].text("name") for name in names),
                visibility=visibilities[visibility].text("level") if visibility else "",
                lidar_points=row.integer("num_lidar_pts"),
                radar_points=row.integer("num_radar_pts"),
            )
        )
    read = [
        Sample(token, row.nanoseconds(), tuple(by_sample[token])) for token, row in samples.items()
    ]
    return tuple(sorted(read, key=lambda sample: sample.timestamp_ns))


def _size(row: Row) -> np.ndarray:
    width, length, height = row.numbers("size", 3)
    if min(width, length, height) <= 0:
        raise row.fault("size", "width, length and height above 0 (metres)")
    return np.array([length, width, height])


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


@dataclass(frozen=True)
class FrameToken:
    """What a frame's image or sweep is in the tables. token: of its row in sample_data. filename:
    relative to the dataset's folder."""

    token: str
    filename: str
    is_key_frame: bool


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


def frame_tokens(path: str, query: dict[str, str]) -> dict[int, dict[str, FrameToken]]:
    """What every frame of a scene is in the dataset's tables: by frame number (Frame.index, those
    too that frames= leaves out) and channel (LIDAR_TOP among them), missing files included."""
    options = NuScenesOptions.from_query("nuscenes", query)
    tables = read_tables(Path(path), options.version, options.scene)
    frames, _ = scene_frames(tables, sweeps=options.sweeps == "1")
    return {
        frame.index: {
            file.channel: FrameToken(file.token, file.filename, file.is_key_frame)
            for file in (frame.sweep, *frame.images.values())
        }
        for frame in frames
    }


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
