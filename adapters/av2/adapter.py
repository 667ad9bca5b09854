"""An Argoverse 2 sensor log: Gaussians from accumulated, image-coloured LiDAR.

World: the city's, less whole metres. Ego: Argoverse's (x forward, y left, z up, origin at the rear
axle, some 0.3 m above the road), as it stood at the sweep's time. Frame numbers count the sweeps
from 0 in order of time; each camera adds its nearest image, from where the car was at that image's
own time. Images are undistorted as published: the coefficients k1, k2, k3 describe the raw lens.
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
from adapters.plain_files import inside
from adapters.raw_drive import (
    BoxSample,
    DriveImages,
    DriveOptions,
    Picture,
    RawDrive,
    Sweep,
    TimedBoxes,
    colour_every,
    drive_origin,
    find_objects,
    is_usable,
    recentred,
    scene_of_drive,
    some,
    usable_images,
)
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.effects.lidar.codes import CODE_COLUMN, INDEX_COLUMN, UNCHANGED
from augment.errors import AdapterError
from augment.geometry import invert_rigid, quat_from_rotmat
from augment.ground import measure_ground
from augment.labels import Boxes, LidarSweep
from augment.scene import Ground, Scene
from augment.semantics import SemanticClass

# ---- A log, and its labels -----------------------------------------------------------------------

_RETURN = ("x", "y", "z")


class Lens(NamedTuple):
    """Of one camera. size: width, height. intrinsic: fx, fy, cx, cy, pixels, centres at +0.5.
    ego_from_camera: float64 [4, 4], x right, y down, z forward."""

    size: tuple[int, int]
    intrinsic: tuple[float, float, float, float]
    ego_from_camera: np.ndarray


class Returns(NamedTuple):
    """One sweep. points: float64 [N, 3], ego at the stamp. offsets_ns: int64 [N], after the stamp.
    intensity, lasers: as in the file."""

    points: np.ndarray
    offsets_ns: np.ndarray
    intensity: np.ndarray
    lasers: np.ndarray


@dataclass(frozen=True, eq=False)
class Annotations:
    """All boxes of a log in the city's world. timestamps_ns: int64 [B]. world_from_box: float64
    [B, 4, 4]. sizes_m: [B, 3]. track_ids, labels: objects [B]. counts: int64 [B], returns in it."""

    timestamps_ns: np.ndarray
    world_from_box: np.ndarray
    sizes_m: np.ndarray
    track_ids: np.ndarray
    labels: np.ndarray
    counts: np.ndarray

    @staticmethod
    def read(root: Path, city: CityPath) -> Annotations:
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
        """The different times, ascending."""
        return np.unique(self.timestamps_ns)

    def at(self, timestamp_ns: int) -> Boxes:
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
    """A log, and labels of its frames: boxes from memory, sweeps read when asked.

    Boxes: track_ids are track_uuid, labels the category; the attribute num_interior_pts. Sweeps:
    columns x y z (float64, city), intensity (0 to 255), laser_number, both as in the file, and
    timestamp_ns, each return's own. Its classes are the map's: ROAD and TERRAIN.

    stamps_ns: of the sweeps, in order. lenses: by camera. ego_from_sensor: of both LiDARs. step:
    from one sweep's frame number to the next; those between are frames of images alone.
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
        """
        Raises:
            AdapterError: no log, or its path, calibration, boxes or map are missing or damaged."""
        root = Path(path)
        if not (root / POSES).is_file():
            below = next((p.parent for p in sorted(root.glob(f"*/{POSES}"))), None)
            hint = "" if below is None else f"; it holds logs, give one: av2:{below}"
            raise AdapterError(
                f"{root} is not a log of Argoverse 2's sensor dataset: it has no {POSES}{hint}"
            )
        city = CityPath.read(root)
        sensors = read_columns(root, SENSORS)
        ego_from = dict(zip(sensors.texts("sensor_name"), sensors.poses(), strict=True))
        for name in (UP, DOWN):
            if name not in ego_from:
                raise AdapterError(f"{root / SENSORS} has no row {name}; it has {sorted(ego_from)}")
        lenses = _read_lenses(root, ego_from)
        known = _stamps(root / "sensors/lidar", ".feather")
        stamps = tuple(stamp for stamp in known if city.covers(stamp))
        if not stamps:
            what = f"only sweeps of times that {POSES} lacks" if known else "no <ns>.feather"
            raise AdapterError(
                f"{root / 'sensors/lidar'} holds {what}; a scene cannot be built without sweeps, "
                f"copy them from the dataset"
            )
        problems = []
        if len(stamps) < len(known):
            problems.append(f"left out {len(known) - len(stamps)} sweeps before or after all poses")
        annotations = None
        if (root / ANNOTATIONS).exists():
            annotations = Annotations.read(root, city)
        else:
            problems.append(f"{root} has no {ANNOTATIONS}: no boxes are known")
        ground = GroundMap.read(root)
        lidars = {name: ego_from[name] for name in (UP, DOWN)}
        return Av2Log(root, city, stamps, lenses, lidars, annotations, ground, tuple(problems))

    # As labels.

    def boxes(self, frame_index: int) -> Boxes:
        stamp = self._stamp(frame_index)
        if stamp is None or self.annotations is None:
            return Boxes.empty()
        return self.annotations.at(stamp)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """None for other frames, and where the file is damaged, which the scene's problems say."""
        stamp = self._stamp(frame_index)
        try:
            returns = None if stamp is None else self.returns(stamp)
        except AdapterError:
            return None
        if stamp is None or returns is None:
            return None
        points = self.in_city(returns.points, stamp)
        columns = {name: np.ascontiguousarray(points[:, i]) for i, name in enumerate(_RETURN)}
        columns |= {"intensity": returns.intensity, "laser_number": returns.lasers}
        return LidarSweep(columns | {"timestamp_ns": stamp + returns.offsets_ns})

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        if self.ground is None or self.ground.is_road is None:
            return None
        return self.ground.classes(sweep.points_m)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Where the sensor was that made each return, at the return's own time."""
        stamp = self._stamp(frame_index)
        if stamp is None:
            return None
        pose = self.city.at(np.array([stamp]))[0]
        local = np.nan_to_num((sweep.points_m - pose[:3, 3]) @ pose[:3, :3])
        lasers = np.asarray(sweep.columns["laser_number"])
        sensors = sensor_of_laser(lasers, local, self.ego_from_sensor)
        places = np.stack([self.ego_from_sensor[name][:3, 3] for name in (UP, DOWN)])[sensors]
        times, at = np.unique(sweep.columns["timestamp_ns"], return_inverse=True)
        poses = self.city.at(times)[at]
        return np.einsum("nij,nj->ni", poses[:, :3, :3], places) + poses[:, :3, 3]

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        stamp = self._stamp(frame_index)
        return () if stamp is None else (inside(self.root, _sweep_name(stamp), str(self.root)),)

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """The same columns, types and notes. Returns that moved are rounded as the dataset's own
        are, to 16 bits: 3 cm at 50 m."""
        table = read_columns(self.root, str(file.relative_to(self.root))).table
        table = table.take(pa.array(sweep.columns[INDEX_COLUMN]))
        columns = Columns(table, file)
        pose = self.city.at(np.array([self._stamp(frame_index)]))[0]
        places = (sweep.points_m - pose[:3, 3]) @ pose[:3, :3]
        changed = np.asarray(sweep.columns[CODE_COLUMN]) != UNCHANGED
        was = np.stack([columns.floats(name).astype(np.float64) for name in _RETURN], axis=1)
        moved = changed & (np.abs(places - was) > _STILL_M).any(axis=1)
        values = {}
        for axis, name in enumerate(_RETURN):
            values[name] = columns.floats(name)
            values[name][moved] = places[moved, axis]
        kind = columns.integers("intensity").dtype
        values["intensity"] = np.rint(np.asarray(sweep.columns["intensity"])).astype(kind)
        for name, column in values.items():
            at = table.schema.get_field_index(name)
            table = table.set_column(at, table.schema.field(at), pa.array(column))
        sink = io.BytesIO()
        feather.write_feather(table, sink, compression="lz4")
        return sink.getvalue()

    # As a drive.

    def returns(self, stamp_ns: int) -> Returns:
        """
        Raises:
            AdapterError: the file is missing or damaged."""
        columns = read_columns(self.root, _sweep_name(stamp_ns))
        return Returns(
            np.stack([columns.floats(name).astype(np.float64) for name in _RETURN], axis=1),
            columns.integers("offset_ns").astype(np.int64),
            columns.integers("intensity"),
            columns.integers("laser_number"),
        )

    def in_city(self, points: np.ndarray, stamp_ns: int) -> np.ndarray:
        """Points [N, 3] of a sweep in the city's world."""
        pose = self.city.at(np.array([stamp_ns]))[0]
        with np.errstate(all="ignore"):  # returns that are no numbers stay none
            return points @ pose[:3, :3].T + pose[:3, 3]

    def _stamp(self, frame_index: int) -> int | None:
        number, between = divmod(frame_index, self.step)
        is_sweep = not between and 0 <= number < len(self.stamps_ns)
        return self.stamps_ns[number] if is_sweep else None


def _sweep_name(stamp_ns: int) -> str:
    return f"sensors/lidar/{stamp_ns}.feather"


_STILL_M = 1e-4  # a return that is no further from its record has not moved


def _stamps(folder: Path, suffix: str) -> list[int]:
    """The nanoseconds that the files of a folder are named by, ascending; none without a folder."""
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
    """The labels of a log; whatever frames= says, they are those of all its frames."""
    options = Av2Options.from_query("av2", query)
    return replace(Av2Log.read(path), step=options.step)


# ---- The scene -----------------------------------------------------------------------------------

_LIDAR_TOP_DEG = 25.0  # down_lidar's uppermost laser: it hangs upside down
_NEAR_NS = 25_000_000  # images come every 50 ms
# The car (4.9 m by 1.9 m, origin at the rear axle). Published sweeps hold no return in it.
_EGO_M = np.array([[-1.3, -1.1, -0.5], [4.0, 1.1, 1.9]])
_MAX_RETURNS = 8_000_000  # of a whole log: a voxel is hit more than once
_THREADS = 4  # NumPy and Arrow release the interpreter
_GREY_LEVELS = 6  # apart, colours of a grey image are the JPEG's rounding


class Av2Options(DriveOptions):
    """images: nearest, or all for frames between the sweeps too, of the images that no sweep has.
    The scene's surfaces and colours are the same."""

    images: Literal["nearest", "all"] = Field(
        "nearest",
        description="nearest for the images nearest to the sweeps, all for the others too, in "
        "frames between the sweeps",
    )

    @property
    def step(self) -> int:
        """From one sweep's frame number to the next."""
        return 2 if self.images == "all" else 1


def open_av2(path: str, query: dict[str, str]) -> Scene:
    """The scene of a log's folder, such as `sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede`.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out, see DriveOptions;
    images, see Av2Options. Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option; tables or maps that are missing or damaged; no usable sweep or
            image; a camera all of whose images are damaged. What single frames lack is in
            Scene.problems."""
    options = Av2Options.from_query("av2", query)
    log = Av2Log.read(path)
    drive = read_av2(log, format_uri("av2", path, query), options)
    scene = scene_of_drive(drive, options, ground=_ground(log, drive))
    return scene if options.images == "nearest" else _with_images_between(scene, log, options.step)


def _with_images_between(scene: Scene, log: Av2Log, step: int) -> Scene:
    """The scene with frames between sweeps, of the images that no sweep has: each camera's nearest
    to the middle. They have neither a sweep nor boxes."""
    stamps_of = {name: _image_stamps(log, name)[0] for name in log.lenses}
    times: dict[tuple[int, str], int] = {}
    for first, second in zip(scene.frames, scene.frames[1:], strict=False):
        if second.index != first.index + 1:
            continue
        middle_ns = (first.timestamp_ns + second.timestamp_ns) // 2
        for name, stamps in stamps_of.items():
            used = [f.cameras[name].timestamp_ns for f in (first, second) if name in f.cameras]
            free = stamps[~np.isin(stamps, used)]
            free = free[(free > first.timestamp_ns) & (free < second.timestamp_ns)]
            if len(free):
                times[first.index, name] = int(free[np.abs(free - middle_ns).argmin()])
    pictures = [
        Picture(name, number, _image_file(log, name, time), log.lenses[name].size)
        for (number, name), time in times.items()
    ]
    images = usable_images(pictures, every_camera=False)
    frames: list[Frame] = []
    for frame in scene.frames:
        frames.append(replace(frame, index=step * frame.index))
        own = [time for (number, _), time in times.items() if number == frame.index]
        if own:
            stamp = round(sum(time - own[0] for time in own) / len(own)) + own[0]
            between = _frame(log, frame.index, stamp, times, images, scene.world_origin_m)
            frames.append(replace(between, index=step * frame.index + 1))
    return replace(
        scene,
        frames=tuple(frames),
        labels=replace(log, step=step),
        problems=(*scene.problems, *images.problems),
    )


def _image_stamps(log: Av2Log, camera: str) -> tuple[np.ndarray, int]:
    """The times of a camera's images that poses cover, int64, ascending, and how many others."""
    stamps = np.array(_stamps(log.root / "sensors/cameras" / camera, ".jpg"), np.int64)
    covered = np.array([log.city.covers(stamp) for stamp in stamps], bool)
    return stamps[covered], int((~covered).sum())


def _image_file(log: Av2Log, camera: str, stamp_ns: int) -> Path:
    return inside(log.root, f"sensors/cameras/{camera}/{stamp_ns}.jpg", str(log.root))


def read_av2(log: Av2Log, source: str, options: DriveOptions) -> RawDrive:
    """The frames that the options ask for, with their images, sweeps and boxes."""
    chosen = options.select(range(len(log.stamps_ns)), where=source)
    origin = drive_origin(log.city.poses[:, :3, 3])
    times, image_problems = _image_times(log, chosen.numbers)
    files = {
        (number, camera): _image_file(log, camera, time) for (number, camera), time in times.items()
    }
    pictures = [
        Picture(camera, number, files[number, camera], log.lenses[camera].size)
        for number, camera in times
    ]
    images = usable_images(pictures) if pictures else DriveImages({}, {}, ())
    grey = _grey_cameras(images)
    coloured = sum(len(images.paths.get(n, {}).keys() - grey) for n in chosen.used)
    frames = tuple(
        _frame(log, number, log.stamps_ns[number], times, images, origin)
        for number in chosen.numbers
    )
    sweeps, spin, sweep_problems = _read_sweeps(log, chosen.used, origin)
    moving, box_problems = _moving_boxes(log, spin, frames, origin)
    return RawDrive(
        name=log.root.absolute().name,
        source=source,
        frames=frames,
        held_out=chosen.held_out,
        sweeps=sweeps,
        boxes=moving,
        labels=log,
        world_origin_m=origin,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(
            *log.problems,
            *chosen.problems,
            *image_problems,
            *images.problems,
            *sweep_problems,
            *box_problems,
        ),
        grey_cameras=grey,
        colour_every=colour_every(coloured),
    )


def _image_times(
    log: Av2Log, numbers: Sequence[int]
) -> tuple[dict[tuple[int, str], int], tuple[str, ...]]:
    """The time of the image that each frame takes of each camera, and what is missing."""
    found: dict[tuple[int, str], int] = {}
    problems = []
    for camera in sorted(log.lenses):
        folder = log.root / "sensors/cameras" / camera
        stamps, num_others = _image_stamps(log, camera)
        if num_others:
            problems.append(
                f"camera {camera}: left out {num_others} images before or after all poses"
            )
        missing = []
        for number in numbers:
            apart = np.abs(stamps - log.stamps_ns[number])
            if len(apart) and apart.min() <= _NEAR_NS:
                found[number, camera] = int(stamps[apart.argmin()])
            else:
                missing.append(number)
        if len(missing) == len(numbers):
            problems.append(f"camera {camera}: {folder} has no image of the frames")
        elif missing:
            problems.append(
                f"camera {camera}: no image within {_NEAR_NS // 10**6} ms of {some(missing)}"
            )
    return found, tuple(problems)


def _frame(
    log: Av2Log,
    number: int,
    stamp: int,
    times: Mapping[tuple[int, str], int],
    images: DriveImages,
    origin: np.ndarray,
) -> Frame:
    own = {camera: time for (n, camera), time in times.items() if n == number}
    poses = log.city.at(np.array([stamp, *own.values()], np.int64))
    cameras = {}
    for (name, time), city_from_ego in zip(own.items(), poses[1:], strict=True):
        lens = log.lenses[name]
        pose = recentred(city_from_ego @ lens.ego_from_camera, origin)
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
        world_from_ego=recentred(poses[0], origin),
        cameras=cameras,
        image_paths=images.paths.get(number, {}),
    )


def _grey_cameras(images: DriveImages) -> frozenset[str]:
    """The cameras whose first image is grey, as the stereo pair's are."""
    first = {
        name: path for own in reversed(list(images.paths.values())) for name, path in own.items()
    }
    grey = set()
    for name, path in first.items():
        image = read_image(Path(path), 0.125)
        if image is not None and np.ptp(image.astype(np.int16), axis=2).max() <= _GREY_LEVELS:
            grey.add(name)
    return frozenset(grey)


def _read_sweeps(
    log: Av2Log, numbers: Sequence[int], origin: np.ndarray
) -> tuple[tuple[Sweep, ...], Spin, tuple[str, ...]]:
    """The usable returns of the frames in the scene's world, and how the first sweep turned."""
    spin = _first_spin(log, numbers)

    def read(number: int) -> Sweep | str:
        stamp = log.stamps_ns[number]
        try:
            returns = log.returns(stamp)
        except AdapterError as error:
            return f"frame {number}: {error}"
        city = log.in_city(returns.points, stamp)
        classes = np.full(len(city), SemanticClass.UNKNOWN, np.int16)
        if log.ground is not None:
            classes = log.ground.classes(city)
        with np.errstate(over="ignore"):  # of returns that are no numbers
            points = (city - origin).astype(np.float32)
        sweep = Sweep(points, stamp + returns.offsets_ns, classes)
        pose = log.city.at(np.array([stamp]))[0]
        return sweep.select(is_usable(sweep, city, pose, _EGO_M))

    with ThreadPoolExecutor(_THREADS) as pool:
        read_on = tqdm(pool.map(read, numbers), "LiDAR", len(numbers), unit="sweep", disable=None)
        found = list(read_on)
    problems = [sweep for sweep in found if isinstance(sweep, str)]
    sweeps = [sweep for sweep in found if isinstance(sweep, Sweep)]
    part = _MAX_RETURNS / max(_MAX_RETURNS, sum(map(len, sweeps)))
    if part < 1:  # rows go by lasers in turn: every other one would be half of the lasers
        rng = np.random.default_rng(len(sweeps))
        sweeps = [sweep.select(rng.random(len(sweep)) < part) for sweep in sweeps]
    return tuple(sweeps), spin, tuple(problems)


def _first_spin(log: Av2Log, numbers: Sequence[int]) -> Spin:
    """How the first sweep turned of which it can be told."""
    middle = np.mean([pose[:3, 3] for pose in log.ego_from_sensor.values()], axis=0)
    spin = Spin()
    for number in numbers:
        with contextlib.suppress(AdapterError):
            returns = log.returns(log.stamps_ns[number])
            finite = np.isfinite(returns.points).all(axis=1)
            spin = Spin.of_returns(returns.points[finite] - middle, returns.offsets_ns[finite])
        if spin.begin_rad is not None:
            break
    return spin


def _moving_boxes(
    log: Av2Log, spin: Spin, frames: Sequence[Frame], origin: np.ndarray
) -> tuple[tuple[BoxSample, ...], tuple[str, ...]]:
    """The boxes of moving objects around the frames, in the scene's world, each at the time that
    the LiDARs met it. An object moves if it travels within the log."""
    if log.annotations is None:
        return (), ()
    stamps = log.annotations.stamps
    timed = []
    for number, (stamp, pose) in enumerate(zip(stamps, log.city.at(stamps), strict=True)):
        boxes = log.annotations.at(int(stamp))
        local = (boxes.centers_m - pose[:3, 3]) @ pose[:3, :3]
        met_ns = spin.met_ns(local - log.ego_from_sensor[UP][:3, 3])
        timed.append(TimedBoxes(number, boxes, stamp + met_ns))
    found = find_objects(timed, origin)
    first = np.searchsorted(stamps, frames[0].timestamp_ns, side="right") - 1
    last = np.searchsorted(stamps, frames[-1].timestamp_ns)
    return tuple(box for box in found.moving if first - 1 <= box.frame <= last + 1), found.problems


def _ground(log: Av2Log, drive: RawDrive) -> Ground | None:
    """The map's heights under the drive; None where it has none there."""
    if log.ground is None:
        return None
    path = np.stack([frame.world_from_ego[:3, 3].numpy() for frame in drive.frames])
    points = log.ground.under(path + drive.world_origin_m) - drive.world_origin_m
    return measure_ground(points, path, "map")
