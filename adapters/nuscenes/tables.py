"""The tables of one nuScenes scene, read and checked; nothing here opens an image or a sweep.

    v1.0-*/scene.json, sample.json, sample_data.json, sample_annotation.json, ...   the tables
    samples/<CHANNEL>/, sweeps/<CHANNEL>/    files of keyframes, and of what lies between them
    lidarseg/v1.0-*/<token>_lidarseg.bin     class of each return of keyframes, where published
    panoptic/v1.0-*/<token>_panoptic.npz     class and object of each, likewise

Each table is read once, row by row, and only what belongs to the scene is kept. Of mini that takes
a second; of trainval, whose tables have 2 GB, about half a minute. Rows are taken in order
of time; prev and next links are not needed. Coordinates are nuScenes' global ones in metres, times
are nanoseconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.nuscenes.rows import Row, read_all, read_rows, read_where, referred
from adapters.nuscenes.turning import Turn
from adapters.plain_files import array_of, inside
from augment.errors import AdapterError

LIDAR = "LIDAR_TOP"
_MOST_NAMES = 10  # that a message lists


@dataclass(frozen=True, eq=False)
class SensorFile:
    """One image or sweep: a row of sample_data and what it refers to.

    filename: relative to the dataset's folder, inside it. world_from_ego, ego_from_sensor: float64
    [4, 4], at the file's own time. intrinsic: fx, fy, cx, cy, pixels; None of a LiDAR. width,
    height: pixels; 0 of a LiDAR.
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
    the LiDAR turns.
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
    """The tables of the scene of that name or token.

    version, scene: None for the only one.

    Raises:
        AdapterError: no nuScenes dataset, no such version or scene, several to choose from, or a
            table that is missing, damaged or contradicts another; names table, row and field.
    """
    folder = root / _choose_version(root, version)
    row = _choose_scene(folder, scene)
    samples = read_where(folder / "sample.json", "scene_token", {row.token})
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
    categories = read_all(folder / "category.json")
    return SceneTables(
        root=root,
        version=folder.name,
        name=row.text("name"),
        samples=_read_samples(folder, samples, categories),
        lidar=lidar,
        images=images,
        semantic_files=_files_of_sweeps(root, folder / "lidarseg.json", lidar),
        panoptic_files=_files_of_sweeps(root, folder / "panoptic.json", lidar),
        class_names=_class_names(categories),
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
    rows = list(read_all(folder / "scene.json").values())
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
    rest = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def _read_files(root: Path, folder: Path, samples: Mapping[str, Row]) -> tuple[SensorFile, ...]:
    sensors = read_all(folder / "sensor.json")
    calibrations = read_all(folder / "calibrated_sensor.json")
    channels: dict[str, Row] = {}
    for token, row in calibrations.items():
        sensor = referred(row, "sensor_token", sensors, "sensor")
        if sensor.text("channel") == LIDAR or sensor.text("modality") == "camera":
            channels[token] = sensor
    rows: dict[str, Row] = {}
    for token, row in read_where(folder / "sample_data.json", "sample_token", samples).items():
        referred(row, "calibrated_sensor_token", calibrations, "calibrated_sensor")
        if row.text("calibrated_sensor_token") in channels:  # not a radar's
            rows[token] = row
    wanted = {row.text("ego_pose_token") for row in rows.values()}
    poses = read_where(folder / "ego_pose.json", "token", wanted)
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
    rows = read_where(folder / "sample_annotation.json", "sample_token", samples)
    wanted = {row.text("instance_token") for row in rows.values()}
    instances = read_where(folder / "instance.json", "token", wanted)
    attributes = read_all(folder / "attribute.json")
    visibilities = read_all(folder / "visibility.json")
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


def _class_names(categories: Mapping[str, Row]) -> dict[int, str]:
    """Class numbers of lidarseg files; tables without lidarseg do not number their categories."""
    numbered = [row for row in categories.values() if "index" in row.fields]
    return {row.integer("index"): row.text("name") for row in numbered}
