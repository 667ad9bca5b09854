"""Scenes of Argoverse 2 sensor logs: Gaussians from accumulated, image-coloured LiDAR.

`open_av2` makes the scene of a log's folder, `av2_labels` its labels.

World: the city's frame, less whole metres. Ego: Argoverse's frame (x forward, y left, z up, origin
at the rear axle, some 0.3 m above the road), as it stood at the sweep's time. Frame numbers count
the sweeps from 0 in order of time. Each camera adds its nearest image, from where the car was at
that image's own time. Images are undistorted as published: the coefficients k1, k2, k3 describe the
raw lens.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import torch
from pydantic import Field
from tqdm import tqdm

from adapters.av2.files import (
    ANNOTATIONS,
    DOWN,
    LENSES,
    POSES,
    SENSORS,
    UP,
    CityPath,
    Columns,
    GroundMap,
    Spin,
    read_columns,
    sensor_of_laser,
)
from adapters.lidar_scene.image_views import read_image
from adapters.plain_files import resolve_inside
from adapters.raw_drive import (
    BoxSample,
    DriveImages,
    DriveOptions,
    Picture,
    RawDrive,
    Sweep,
    TimedBoxes,
    colour_every,
    describe_frames,
    drive_origin,
    find_objects,
    is_usable,
    recenter_pose,
    scene_of_drive,
    usable_images,
)
from adapters.recorded_lenses import no_lens_note
from adapters.uri import format_uri
from augment.effects.lidar.codes import CODE_COLUMN, INDEX_COLUMN, UNCHANGED
from augment.errors import AdapterError
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid, quat_from_rotmat
from augment.scene.ground import measure_ground
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Ground, Scene
from augment.scene.semantics import SemanticClass

# ---- A log, and its labels -----------------------------------------------------------------------

# Columns of a sweep's table that hold a return's place.
_XYZ_COLUMNS = ("x", "y", "z")


class Lens(NamedTuple):
    """Calibration of one camera.

    Attributes:
        size: width and height in pixels.
        intrinsic: fx, fy, cx, cy in pixels, with pixel centres at +0.5.
        ego_from_camera: float64 [4, 4]; the camera's x is right, y down, z forward.
    """

    size: tuple[int, int]
    intrinsic: tuple[float, float, float, float]
    ego_from_camera: np.ndarray


class Returns(NamedTuple):
    """Returns of one sweep.

    Attributes:
        points: float64 [N, 3], ego frame at the sweep's stamp.
        offsets_ns: int64 [N], times after the stamp.
        intensity: [N], as in the file.
        lasers: [N], laser numbers as in the file.
    """

    points: np.ndarray
    offsets_ns: np.ndarray
    intensity: np.ndarray
    lasers: np.ndarray


@dataclass(frozen=True, eq=False)
class Annotations:
    """All boxes of a log in the city's world.

    Attributes:
        timestamps_ns: int64 [B].
        world_from_box: float64 [B, 4, 4].
        sizes_m: float64 [B, 3].
        track_ids: objects [B], track_uuid of the file.
        labels: objects [B], category of the file.
        counts: int64 [B], returns in the box.
    """

    timestamps_ns: np.ndarray
    world_from_box: np.ndarray
    sizes_m: np.ndarray
    track_ids: np.ndarray
    labels: np.ndarray
    counts: np.ndarray

    @staticmethod
    def read(root: Path, city: CityPath) -> Annotations:
        """Read the boxes of the log at root, and place them in the city."""
        columns = read_columns(root, ANNOTATIONS)
        times = columns.integers("timestamp_ns").astype(np.int64)
        world_from_box = city.at(times) @ columns.poses()
        return Annotations(
            times,
            world_from_box,
            columns.vectors(("length_m", "width_m", "height_m")),
            columns.texts("track_uuid"),
            columns.texts("category"),
            columns.integers("num_interior_pts").astype(np.int64),
        )

    @cached_property
    def stamps(self) -> np.ndarray:
        """Return the different times of the boxes, ascending."""
        return np.unique(self.timestamps_ns)

    def at(self, timestamp_ns: int) -> Boxes:
        """Return the boxes of one time."""
        rows = np.flatnonzero(self.timestamps_ns == timestamp_ns)
        poses = self.world_from_box[rows]
        return Boxes(
            tuple(self.track_ids[rows]),
            tuple(self.labels[rows]),
            poses[:, :3, 3].copy(),
            self.sizes_m[rows],
            quat_from_rotmat(torch.from_numpy(poses[:, :3, :3].copy())).numpy(),
            {"num_interior_pts": self.counts[rows]},
        )


@dataclass(frozen=True, eq=False)
class Av2Log:
    """A log, and the labels of its frames: boxes in memory, sweeps that are read on demand.

    Boxes: track_ids are track_uuid, labels the category; the attribute is num_interior_pts. Sweeps:
    columns x y z (float64, city), intensity (0 to 255), laser_number, both as in the file, and
    timestamp_ns, the time of each return. The sweep's classes are the map's: ROAD and TERRAIN.

    Attributes:
        root: the log's folder.
        city: the car's poses.
        stamps_ns: times of the sweeps, ascending.
        lenses: calibration by camera.
        ego_from_sensor: poses of both LiDARs, float64 [4, 4].
        annotations: the boxes. None if the log has none.
        ground: the map. None if the log has none.
        problems: one sentence for each thing that is missing.
        step: difference of the frame numbers of consecutive sweeps. Frames between them have images
            only.
    """

    root: Path
    city: CityPath
    stamps_ns: tuple[int, ...]
    lenses: Mapping[str, Lens]
    ego_from_sensor: Mapping[str, np.ndarray]
    annotations: Annotations | None = None
    ground: GroundMap | None = None
    problems: tuple[str, ...] = ()
    step: int = 1

    @staticmethod
    def read(path: str) -> Av2Log:
        """Read a log's tables. Sweeps and images are only listed.

        Raises:
            AdapterError: the folder is no log, or its path, calibration, boxes or map are missing
                or damaged.
        """
        root = Path(path)
        if not (root / POSES).is_file():
            log_folder = next((p.parent for p in sorted(root.glob(f"*/{POSES}"))), None)
            hint = "" if log_folder is None else f"; it holds logs, give one: av2:{log_folder}"
            raise AdapterError(
                f"{root} is not a log of Argoverse 2's sensor dataset: it has no {POSES}{hint}"
            )
        city = CityPath.read(root)
        sensors = read_columns(root, SENSORS)
        ego_from_sensor = dict(zip(sensors.texts("sensor_name"), sensors.poses(), strict=True))
        for name in (UP, DOWN):
            if name not in ego_from_sensor:
                raise AdapterError(
                    f"{root / SENSORS} has no row {name}; it has {sorted(ego_from_sensor)}"
                )
        lenses = _read_lenses(root, ego_from_sensor)
        sweep_stamps = _stamps(root / "sensors/lidar", ".feather")
        stamps = tuple(stamp for stamp in sweep_stamps if city.covers(stamp))
        if not stamps:
            fault = (
                f"only sweeps of times that {POSES} lacks" if sweep_stamps else "no <ns>.feather"
            )
            raise AdapterError(
                f"{root / 'sensors/lidar'} holds {fault}; a scene cannot be built without sweeps, "
                f"copy them from the dataset"
            )
        problems = []
        if len(stamps) < len(sweep_stamps):
            problems.append(
                f"left out {len(sweep_stamps) - len(stamps)} sweeps before or after all poses"
            )
        annotations = None
        if (root / ANNOTATIONS).exists():
            annotations = Annotations.read(root, city)
        else:
            problems.append(f"{root} has no {ANNOTATIONS}: no boxes are known")
        ground = GroundMap.read(root)
        ego_from_lidar = {name: ego_from_sensor[name] for name in (UP, DOWN)}
        return Av2Log(
            root, city, stamps, lenses, ego_from_lidar, annotations, ground, tuple(problems)
        )

    # As labels.

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame; none for frames between sweeps."""
        stamp = self._stamp(frame_index)
        if stamp is None or self.annotations is None:
            return Boxes.empty()
        return self.annotations.at(stamp)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """Return a frame's sweep in the city's world.

        The result is None for frames between sweeps, and if the file is damaged; then the scene's
        problems say so.
        """
        stamp = self._stamp(frame_index)
        try:
            returns = None if stamp is None else self.returns(stamp)
        except AdapterError:
            return None
        if stamp is None or returns is None:
            return None
        points = self.in_city(returns.points, stamp)
        columns = {name: np.ascontiguousarray(points[:, i]) for i, name in enumerate(_XYZ_COLUMNS)}
        columns |= {"intensity": returns.intensity, "laser_number": returns.lasers}
        return LidarSweep(columns | {"timestamp_ns": stamp + returns.offsets_ns})

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """Return the map's semantic class of each return, or None if the map is missing."""
        if self.ground is None or self.ground.is_road is None:
            return None
        return self.ground.classes(sweep.points_m)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the position of each return's sensor at the return's own time, float64 [N, 3]."""
        stamp = self._stamp(frame_index)
        if stamp is None:
            return None
        lasers = np.asarray(sweep.columns["laser_number"])
        return self.origins(stamp, sweep.points_m, lasers, sweep.columns["timestamp_ns"])

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """Return the file of a frame's sweep."""
        stamp = self._stamp(frame_index)
        return (
            ()
            if stamp is None
            else (resolve_inside(self.root, _sweep_name(stamp), str(self.root)),)
        )

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Return the content of a file that holds the sweep.

        The columns, types and notes are those of the original. Returns that moved are rounded as
        the dataset's returns are, to 16 bits: 3 cm at 50 m.
        """
        table = read_columns(self.root, str(file.relative_to(self.root))).table
        table = table.take(pa.array(sweep.columns[INDEX_COLUMN]))
        columns = Columns(table, file)
        pose = self.city.at(np.array([self._stamp(frame_index)]))[0]
        ego_points = (sweep.points_m - pose[:3, 3]) @ pose[:3, :3]
        is_changed = np.asarray(sweep.columns[CODE_COLUMN]) != UNCHANGED
        recorded_points = np.stack(
            [columns.floats(name).astype(np.float64) for name in _XYZ_COLUMNS], axis=1
        )
        has_moved = is_changed & (np.abs(ego_points - recorded_points) > _MAX_ROUNDING_M).any(
            axis=1
        )
        values = {}
        for axis, name in enumerate(_XYZ_COLUMNS):
            values[name] = columns.floats(name)
            values[name][has_moved] = ego_points[has_moved, axis]
        intensity_type = columns.integers("intensity").dtype
        values["intensity"] = np.rint(np.asarray(sweep.columns["intensity"])).astype(intensity_type)
        for name, column in values.items():
            column_index = table.schema.get_field_index(name)
            table = table.set_column(
                column_index, table.schema.field(column_index), pa.array(column)
            )
        buffer = io.BytesIO()
        feather.write_feather(table, buffer, compression="lz4")
        return buffer.getvalue()

    # As a drive.

    def returns(self, stamp_ns: int) -> Returns:
        """Read the returns of the sweep at a stamp.

        Raises:
            AdapterError: the file is missing or damaged.
        """
        columns = read_columns(self.root, _sweep_name(stamp_ns))
        return Returns(
            np.stack([columns.floats(name).astype(np.float64) for name in _XYZ_COLUMNS], axis=1),
            columns.integers("offset_ns").astype(np.int64),
            columns.integers("intensity"),
            columns.integers("laser_number"),
        )

    def in_city(self, points: np.ndarray, stamp_ns: int) -> np.ndarray:
        """Transform points [N, 3] of a sweep to the city's world."""
        pose = self.city.at(np.array([stamp_ns]))[0]
        with np.errstate(all="ignore"):  # returns that are no numbers stay none
            return points @ pose[:3, :3].T + pose[:3, 3]

    def origins(
        self, stamp_ns: int, city_points: np.ndarray, lasers: np.ndarray, times_ns: np.ndarray
    ) -> np.ndarray:
        """Return the sensors' places at the returns' times, float64 [N, 3], city.

        Args:
            stamp_ns: stamp of the sweep.
            city_points: float64 [N, 3], returns.
            lasers: int [N], their laser numbers.
            times_ns: int64 [N], their times.
        """
        pose = self.city.at(np.array([stamp_ns]))[0]
        with np.errstate(all="ignore"):  # returns that are no numbers stay none
            ego_points = np.nan_to_num((city_points - pose[:3, 3]) @ pose[:3, :3])
        sensors = sensor_of_laser(lasers, ego_points, self.ego_from_sensor)
        sensor_positions = np.stack([self.ego_from_sensor[name][:3, 3] for name in (UP, DOWN)])[
            sensors
        ]
        times, pose_index = np.unique(times_ns, return_inverse=True)
        poses = self.city.at(times)[pose_index]
        return np.einsum("nij,nj->ni", poses[:, :3, :3], sensor_positions) + poses[:, :3, 3]

    def _stamp(self, frame_index: int) -> int | None:
        number, remainder = divmod(frame_index, self.step)
        is_sweep = not remainder and 0 <= number < len(self.stamps_ns)
        return self.stamps_ns[number] if is_sweep else None


def _sweep_name(stamp_ns: int) -> str:
    return f"sensors/lidar/{stamp_ns}.feather"


# A return that is at most this far from its record has not moved.
_MAX_ROUNDING_M = 1e-4


def _stamps(folder: Path, suffix: str) -> list[int]:
    """Return the nanoseconds in the names of a folder's files, ascending.

    It is empty without a folder.
    """
    names = (path.stem for path in folder.glob(f"*{suffix}"))
    return sorted(int(n) for n in names if n.isascii() and n.isdigit() and 0 < len(n) < 19)


def _read_lenses(root: Path, ego_from: Mapping[str, np.ndarray]) -> dict[str, Lens]:
    columns = read_columns(root, LENSES)
    path = columns.path
    names = columns.texts("sensor_name")
    values = columns.vectors(("fx_px", "fy_px", "cx_px", "cy_px"))
    sizes = [columns.integers(name) for name in ("width_px", "height_px")]
    lenses = {}
    for name, (fx, fy, cx, cy), width, height in zip(names, values, *sizes, strict=True):
        if not re.fullmatch(r"\w{1,100}", name, re.ASCII):
            raise AdapterError(f"{path}: {name!r:.200} cannot be a camera's folder")
        if name not in ego_from:
            raise AdapterError(f"{path}: camera {name} has no pose in {SENSORS}; add its row")
        if min(fx, fy, width, height) <= 0:
            raise AdapterError(
                f"{path}: camera {name}: fx_px, fy_px, width_px, height_px must be above 0; got "
                f"{fx:g}, {fy:g}, {width}, {height}"
            )
        # Argoverse counts whole numbers at the middle of pixels.
        lens = (float(fx), float(fy), float(cx) + 0.5, float(cy) + 0.5)
        lenses[str(name)] = Lens((int(width), int(height)), lens, ego_from[name])
    return lenses


def av2_labels(path: str, query: dict[str, str]) -> Av2Log:
    """Return the labels of a log. They cover all its frames, whatever frames= says."""
    options = Av2Options.from_query("av2", query)
    return replace(Av2Log.read(path), step=options.step)


# ---- The scene -----------------------------------------------------------------------------------

# Elevation of down_lidar's uppermost laser: this LiDAR hangs upside down.
_LIDAR_TOP_DEG = 25.0
# Largest time between a sweep and the image that is taken with it. Images come every 50 ms.
_MAX_TIME_DIFFERENCE_NS = 25_000_000
# Least and greatest corner of the car, ego frame: it is 4.9 m by 1.9 m, with its origin at the rear
# axle. Published sweeps hold no return in it.
_EGO_BOX_M = np.array([[-1.3, -1.1, -0.5], [4.0, 1.1, 1.9]])
# Largest number of returns that a whole log contributes. A voxel is hit more than once.
_MAX_RETURNS = 8_000_000
# Threads that read sweeps. NumPy and Arrow release the interpreter.
_NUM_THREADS = 4
# Largest difference of the channels, 0 to 255, in a grey image: the rounding of JPEG.
_MAX_GREY_DIFFERENCE = 6


class Av2Options(DriveOptions):
    """Options of an Argoverse 2 scene.

    images: nearest, or all for frames between the sweeps too, made of the images that no sweep has.
    The scene's surfaces and colours are the same.
    """

    images: Literal["nearest", "all"] = Field(
        "nearest",
        description="nearest for the images nearest to the sweeps, all for the others too, in "
        "frames between the sweeps",
    )

    @property
    def step(self) -> int:
        """Return the difference of the frame numbers of consecutive sweeps."""
        return 2 if self.images == "all" else 1


def open_av2(path: str, query: dict[str, str]) -> Scene:
    """Open the scene of a log's folder, such as
    `sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede`.

    Opening is deterministic: the same files and options give the same bits.

    Args:
        path: the log's folder.
        query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out, see DriveOptions;
            images, see Av2Options.

    Raises:
        AdapterError: an option is wrong; tables or maps are missing or damaged; no sweep or image
            is usable; all images of a camera are damaged. What single frames lack is listed in
            Scene.problems.
    """
    options = Av2Options.from_query("av2", query)
    log = Av2Log.read(path)
    drive = read_av2(log, format_uri("av2", path, query), options)
    scene = scene_of_drive(drive, options, ground=_ground(log, drive))
    return scene if options.images == "nearest" else _with_images_between(scene, log, options.step)


def _with_images_between(scene: Scene, log: Av2Log, step: int) -> Scene:
    """Return the scene with added frames between sweeps.

    They are made of the images that no sweep has: those of each camera nearest to the middle. They
    have neither a sweep nor boxes.
    """
    stamps_of = {name: _image_stamps(log, name)[0] for name in log.lenses}
    times: dict[tuple[int, str], int] = {}
    for first, second in zip(scene.frames, scene.frames[1:], strict=False):
        if second.index != first.index + 1:
            continue
        middle_ns = (first.timestamp_ns + second.timestamp_ns) // 2
        for name, stamps in stamps_of.items():
            used_stamps = [
                f.cameras[name].timestamp_ns for f in (first, second) if name in f.cameras
            ]
            free_stamps = stamps[~np.isin(stamps, used_stamps)]
            free_stamps = free_stamps[
                (free_stamps > first.timestamp_ns) & (free_stamps < second.timestamp_ns)
            ]
            if len(free_stamps):
                times[first.index, name] = int(
                    free_stamps[np.abs(free_stamps - middle_ns).argmin()]
                )
    pictures = [
        Picture(name, number, _image_file(log, name, time), log.lenses[name].size)
        for (number, name), time in times.items()
    ]
    images = usable_images(pictures, every_camera=False)
    frames: list[Frame] = []
    for frame in scene.frames:
        frames.append(replace(frame, index=step * frame.index))
        image_times = [time for (number, _), time in times.items() if number == frame.index]
        if image_times:
            stamp = (
                round(sum(time - image_times[0] for time in image_times) / len(image_times))
                + image_times[0]
            )
            frame_between = _frame(log, frame.index, stamp, times, images, scene.world_origin_m)
            frames.append(replace(frame_between, index=step * frame.index + 1))
    return replace(
        scene,
        frames=tuple(frames),
        labels=replace(log, step=step),
        problems=(*scene.problems, *images.problems),
    )


def _image_stamps(log: Av2Log, camera: str) -> tuple[np.ndarray, int]:
    """Return the times of a camera's images within the car's poses, and the number of other
    images.

    The times are int64, ascending.
    """
    stamps = np.array(_stamps(log.root / "sensors/cameras" / camera, ".jpg"), np.int64)
    covered = np.array([log.city.covers(stamp) for stamp in stamps], bool)
    return stamps[covered], int((~covered).sum())


def _image_file(log: Av2Log, camera: str, stamp_ns: int) -> Path:
    return resolve_inside(log.root, f"sensors/cameras/{camera}/{stamp_ns}.jpg", str(log.root))


def read_av2(log: Av2Log, source: str, options: DriveOptions) -> RawDrive:
    """Read the frames that the options select, with their images, sweeps and boxes."""
    selection = options.select(range(len(log.stamps_ns)), where=source)
    origin = drive_origin(log.city.poses[:, :3, 3])
    times, image_problems = _image_times(log, selection.numbers)
    files = {
        (number, camera): _image_file(log, camera, time) for (number, camera), time in times.items()
    }
    pictures = [
        Picture(camera, number, files[number, camera], log.lenses[camera].size)
        for number, camera in times
    ]
    images = usable_images(pictures) if pictures else DriveImages({}, {}, ())
    grey = _grey_cameras(images)
    num_colored = sum(len(images.paths.get(n, {}).keys() - grey) for n in selection.used)
    frames = tuple(
        _frame(log, number, log.stamps_ns[number], times, images, origin)
        for number in selection.numbers
    )
    sweeps, spin, sweep_problems = _read_sweeps(log, selection.used, origin)
    moving_boxes, box_problems = _moving_boxes(log, spin, frames, origin)
    return RawDrive(
        name=log.root.absolute().name,
        source=source,
        frames=frames,
        held_out=selection.held_out,
        sweeps=sweeps,
        boxes=moving_boxes,
        labels=log,
        world_origin_m=origin,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(
            *log.problems,
            *selection.problems,
            *image_problems,
            *images.problems,
            *sweep_problems,
            *box_problems,
            *no_lens_note("images of Argoverse 2", options.lens),
        ),
        grey_cameras=grey,
        colour_every=colour_every(num_colored),
    )


def _image_times(
    log: Av2Log, numbers: Sequence[int]
) -> tuple[dict[tuple[int, str], int], tuple[str, ...]]:
    """Return the time of each camera's image in each frame, and a sentence for what is missing."""
    image_times: dict[tuple[int, str], int] = {}
    problems = []
    for camera in sorted(log.lenses):
        folder = log.root / "sensors/cameras" / camera
        stamps, num_others = _image_stamps(log, camera)
        if num_others:
            problems.append(
                f"camera {camera}: left out {num_others} images before or after all poses"
            )
        missing_frames = []
        for number in numbers:
            time_differences = np.abs(stamps - log.stamps_ns[number])
            if len(time_differences) and time_differences.min() <= _MAX_TIME_DIFFERENCE_NS:
                image_times[number, camera] = int(stamps[time_differences.argmin()])
            else:
                missing_frames.append(number)
        if len(missing_frames) == len(numbers):
            problems.append(f"camera {camera}: {folder} has no image of the frames")
        elif missing_frames:
            problems.append(
                f"camera {camera}: no image within {_MAX_TIME_DIFFERENCE_NS // 10**6} ms of "
                f"{describe_frames(missing_frames)}"
            )
    return image_times, tuple(problems)


def _frame(
    log: Av2Log,
    number: int,
    stamp: int,
    times: Mapping[tuple[int, str], int],
    images: DriveImages,
    origin: np.ndarray,
) -> Frame:
    """Return a frame with the cameras of its images, each where it was at the image's time."""
    image_times = {camera: time for (n, camera), time in times.items() if n == number}
    poses = log.city.at(np.array([stamp, *image_times.values()], np.int64))
    cameras = {}
    for (name, time), city_from_ego in zip(image_times.items(), poses[1:], strict=True):
        lens = log.lenses[name]
        pose = recenter_pose(city_from_ego @ lens.ego_from_camera, origin)
        cameras[name] = Camera(
            name,
            *lens.size,
            *lens.intrinsic,
            camera_from_world=invert_rigid(pose),
            timestamp_ns=time,
        )
    return Frame(
        index=number,
        timestamp_ns=stamp,
        world_from_ego=recenter_pose(poses[0], origin),
        cameras=cameras,
        image_paths=images.paths.get(number, {}),
    )


def _grey_cameras(images: DriveImages) -> frozenset[str]:
    """Return the cameras whose first image is grey, as the images of the stereo pair are."""
    first_paths = {
        name: path
        for paths in reversed(list(images.paths.values()))
        for name, path in paths.items()
    }
    grey_cameras = set()
    for name, path in first_paths.items():
        image = read_image(Path(path), 0.125)
        if (
            image is not None
            and np.ptp(image.astype(np.int16), axis=2).max() <= _MAX_GREY_DIFFERENCE
        ):
            grey_cameras.add(name)
    return frozenset(grey_cameras)


def _read_sweeps(
    log: Av2Log, numbers: Sequence[int], origin: np.ndarray
) -> tuple[tuple[Sweep, ...], Spin, tuple[str, ...]]:
    """Read the usable returns of frames in the scene's world, and the timing of the first sweep."""
    spin = _first_spin(log, numbers)

    def read(number: int) -> Sweep | str:
        stamp = log.stamps_ns[number]
        try:
            returns = log.returns(stamp)
        except AdapterError as error:
            return f"frame {number}: {error}"
        city_points = log.in_city(returns.points, stamp)
        classes = np.full(len(city_points), SemanticClass.UNKNOWN, np.int16)
        if log.ground is not None:
            classes = log.ground.classes(city_points)
        with np.errstate(over="ignore"):  # of returns that are no numbers
            points = (city_points - origin).astype(np.float32)
        times = stamp + returns.offsets_ns
        origins = log.origins(stamp, city_points, returns.lasers, times) - origin
        sweep = Sweep(points, times, classes, origins.astype(np.float32))
        pose = log.city.at(np.array([stamp]))[0]
        return sweep.select(is_usable(sweep, city_points, pose, _EGO_BOX_M))

    with ThreadPoolExecutor(_NUM_THREADS) as pool:
        reading = tqdm(pool.map(read, numbers), "LiDAR", len(numbers), unit="sweep", disable=None)
        sweeps_or_problems = list(reading)
    problems = [sweep for sweep in sweeps_or_problems if isinstance(sweep, str)]
    sweeps = [sweep for sweep in sweeps_or_problems if isinstance(sweep, Sweep)]
    kept_fraction = _MAX_RETURNS / max(_MAX_RETURNS, sum(map(len, sweeps)))
    if kept_fraction < 1:  # rows go by lasers in turn: every other one would be half of the lasers
        rng = np.random.default_rng(len(sweeps))
        sweeps = [sweep.select(rng.random(len(sweep)) < kept_fraction) for sweep in sweeps]
    return tuple(sweeps), spin, tuple(problems)


def _first_spin(log: Av2Log, numbers: Sequence[int]) -> Spin:
    """Return the timing of the first sweep from which it can be estimated."""
    lidar_center = np.mean([pose[:3, 3] for pose in log.ego_from_sensor.values()], axis=0)
    spin = Spin()
    for number in numbers:
        with contextlib.suppress(AdapterError):
            returns = log.returns(log.stamps_ns[number])
            is_finite = np.isfinite(returns.points).all(axis=1)
            spin = Spin.of_returns(
                returns.points[is_finite] - lidar_center, returns.offsets_ns[is_finite]
            )
        if spin.begin_rad is not None:
            break
    return spin


def _moving_boxes(
    log: Av2Log, spin: Spin, frames: Sequence[Frame], origin: np.ndarray
) -> tuple[tuple[BoxSample, ...], tuple[str, ...]]:
    """Return the boxes of moving objects around the frames in the scene's world.

    Each box is given at the time when the LiDARs met it. An object moves if it travels within the
    log.
    """
    if log.annotations is None:
        return (), ()
    stamps = log.annotations.stamps
    timed_boxes = []
    for number, (stamp, pose) in enumerate(zip(stamps, log.city.at(stamps), strict=True)):
        boxes = log.annotations.at(int(stamp))
        ego_centers = (boxes.centers_m - pose[:3, 3]) @ pose[:3, :3]
        met_ns = spin.met_ns(ego_centers - log.ego_from_sensor[UP][:3, 3])
        timed_boxes.append(TimedBoxes(number, boxes, stamp + met_ns))
    objects = find_objects(timed_boxes, origin)
    first_sweep = np.searchsorted(stamps, frames[0].timestamp_ns, side="right") - 1
    last_sweep = np.searchsorted(stamps, frames[-1].timestamp_ns)
    return tuple(
        box for box in objects.moving_boxes if first_sweep - 1 <= box.frame <= last_sweep + 1
    ), objects.problems


def _ground(log: Av2Log, drive: RawDrive) -> Ground | None:
    """Return the map's heights under the drive, or None if the map has no heights there."""
    if log.ground is None:
        return None
    path = np.stack([frame.world_from_ego[:3, 3].numpy() for frame in drive.frames])
    points = log.ground.under(path + drive.world_origin_m) - drive.world_origin_m
    return measure_ground(points, path, "map")
