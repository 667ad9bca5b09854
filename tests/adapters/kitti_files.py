"""A tiny street in KITTI's layouts, written from their description with nothing of the adapter's.

The street: ground, a wall on the left, a house across the end, a red car that drives ahead; x
forward, y left, z up, level, origin at the first GPS/IMU position. The recording car drives along
+x. Everything is analytic: see `colour_at`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tests.adapters.street import Drive, LabelledBox, View, box_distance, nearest_hits, rigid, turn

FRAMES, FRAME_S, SPEED_MPS, CAR_MPS = 3, 0.1, 8.0, 12.0
START = "2011-09-26 13:02:25"
START_NS = 1_317_042_145_000_000_000
GROUND_Z, WALL_Y, WALL_TOP, END_X = -0.93, 8.0, 4.0, 28.0
CAR_SIZE_M = np.array([4.0, 1.8, 1.5])  # length, width, height
WIDTH, HEIGHT, FOCAL_PX = 160, 72, 90.0
SKY, WALL, END, CAR = np.array([[120.0, 160, 220], [200, 180, 130], [90, 110, 80], [190, 30, 30]])
ROAD, LINE = np.full(3, 90.0), np.full(3, 230.0)
LATITUDE, LONGITUDE, ALTITUDE, YAW = 49.011212804408, 8.422885075119, 112.83, 0.35
EARTH_M = 6378137.0


AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # a camera's axes in the Velodyne's
VELO_TO_CAM = rigid(turn(0, 0.012) @ turn(1, -0.007) @ AXES, [-0.004, -0.076, -0.272])
R_RECT = rigid(turn(2, 0.0099) @ turn(1, 0.0074), [0, 0, 0])
IMU_TO_VELO = rigid(turn(2, 0.01), [-0.81, 0.32, -0.8])  # level, so that boxes are exact
PROJECTIONS = {
    "00": np.array([[FOCAL_PX, 0, 80.5, 0], [0, FOCAL_PX, 30.0, 0], [0, 0, 1, 0]]),
    "02": np.array([[FOCAL_PX, 0, 80.5, 5.4], [0, FOCAL_PX, 30.0, 0.2], [0, 0, 1, 0.0027]]),
    "03": np.array([[FOCAL_PX, 0, 80.5, -42.0], [0, FOCAL_PX, 30.0, 0.3], [0, 0, 1, 0.0027]]),
}


def imu_position(frame: int) -> np.ndarray:
    return np.array([SPEED_MPS * FRAME_S * frame, 0.0, 0.0])


def street_from_velo(frame: int) -> np.ndarray:
    return rigid(np.eye(3), imu_position(frame)) @ np.linalg.inv(IMU_TO_VELO)


def world_from_street() -> np.ndarray:
    """The Mercator world of the GPS/IMU files: x east, y north."""
    scale = np.cos(LATITUDE * np.pi / 180) * EARTH_M
    north = scale * np.log(np.tan((90 + LATITUDE) * np.pi / 360))
    return rigid(turn(2, YAW), [scale * LONGITUDE * np.pi / 180, north, ALTITUDE])


def car_centre(frame: float) -> np.ndarray:
    return np.array([10 + CAR_MPS * FRAME_S * frame, 2.5, GROUND_Z + CAR_SIZE_M[2] / 2])


def colour_at(origin: np.ndarray, rays: np.ndarray, frame: int) -> np.ndarray:
    """What is seen along rays [.., 3] from a point of the street, RGB 0 to 255."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (GROUND_Z - origin[2]) / rays[..., 2]
        wall = (WALL_Y - origin[1]) / rays[..., 1]
        end = (END_X - origin[0]) / rays[..., 0]
    is_line = np.abs(origin[1] + ground * rays[..., 1] + 1.5) < 0.25
    paint = np.where(is_line[..., None], LINE, ROAD)
    hits = [(box_distance(origin - car_centre(frame), rays, CAR_SIZE_M), CAR)]
    for distance, colour in ((ground, paint), (wall, WALL), (end, END)):
        z = origin[2] + distance * rays[..., 2]
        hits.append((np.where((z < WALL_TOP) & (z > GROUND_Z - 1e-6), distance, np.inf), colour))
    return nearest_hits(SKY, hits)[1]


def points_at(frame: int) -> np.ndarray:
    """Points on the street's surfaces, float64 [N, 3], others each frame."""
    rng = np.random.default_rng(frame)

    def grid(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = np.meshgrid(first, second)
        return tuple(v.ravel() + rng.uniform(-0.1, 0.1, v.size) for v in (a, b))

    x, y = grid(np.arange(-8, END_X, 0.25), np.arange(-6, WALL_Y, 0.25))
    ground = np.stack([x, y, np.full_like(x, GROUND_Z)], 1)
    x, z = grid(np.arange(-8, END_X, 0.25), np.arange(GROUND_Z, WALL_TOP, 0.25))
    wall = np.stack([x, np.full_like(x, WALL_Y), z], 1)
    y, z = grid(np.arange(-6, WALL_Y, 0.25), np.arange(GROUND_Z, WALL_TOP, 0.25))
    end = np.stack([np.full_like(y, END_X), y, z], 1)
    a, b = np.meshgrid(np.linspace(-0.5, 0.5, 30), np.linspace(-0.3, 0.5, 14))
    a, b = a.ravel(), b.ravel()
    half = np.full_like(a, 0.5)
    faces = [np.stack([-half, a, b], 1), np.stack([a, -half, b], 1), np.stack([a, b, half], 1)]
    return np.concatenate(
        [ground, wall, end, np.concatenate(faces) * CAR_SIZE_M + car_centre(frame)]
    )


def pixels_from_velo(number: str) -> np.ndarray:
    """The files' matrices put together, [3, 4]."""
    return PROJECTIONS[number] @ R_RECT @ VELO_TO_CAM


def picture(pixels_from_street: np.ndarray, frame: int, shade: float = 1.0) -> np.ndarray:
    """The street through a projection matrix [3, 4], BGR uint8."""
    inverse = np.linalg.inv(pixels_from_street[:, :3])
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ inverse.T
    image = colour_at(-inverse @ pixels_from_street[:, 3], rays, frame) * shade
    return np.ascontiguousarray(image[..., ::-1].astype(np.uint8))


@dataclass(frozen=True)
class Tracklet:
    first: int
    boxes: tuple[tuple[float, ...], ...]  # tx ty tz rx ry rz
    label: str = "Car"
    size: tuple[float, float, float] = tuple(CAR_SIZE_M)


def write_as_kitti(day: Path, *, frames: int = FRAMES, cameras=("02", "03")) -> Path:
    """Write a day's folder with calibration and one drive; returns the drive's folder."""
    drive = day / "2011_09_26_drive_0001_sync"
    write_calibration(day)
    for number in cameras:
        for frame in range(frames):
            matrix = pixels_from_velo(number) @ np.linalg.inv(street_from_velo(frame))
            _image(drive / f"image_{number}/data/{frame:010d}.png", picture(matrix, frame))
        write_times(drive / f"image_{number}", frames, offset_ms=3)
    for frame in range(frames):
        write_sweep(
            drive / f"velodyne_points/data/{frame:010d}.bin", street_from_velo(frame), frame
        )
        write_oxts(drive, frame)
    write_times(drive / "velodyne_points", frames)
    write_times(drive / "oxts", frames, offset_ms=7)
    write_tracklets(drive, [moving_tracklet(frames), Tracklet(1, ((9.0, -4, -1.7, 0, 0, 0),))])
    return drive


# The release before synchronisation and rectification: lenses, OpenCV's pixel coordinates, and the
# cameras' places by R and T. Image n + 2 is taken 30 ms after sweep n.
LENS_SIZE = (176, 80)
LENS_K = np.array([[125.0, 0, 87.3], [0, 124.6, 36.8], [0, 0, 1]])
LENS_D = np.array([-0.37, 0.2, 0.0014, 0.0006, -0.068])
UNRECTIFIED_FROM_CAMERA_0 = rigid(turn(1, 0.02) @ turn(0, -0.004), [0.059, -0.0001, -0.0074])
IMAGE_OFFSET_MS = 30
IMAGE_LEAD = 2


def unrectified_from_velo() -> np.ndarray:
    return UNRECTIFIED_FROM_CAMERA_0 @ VELO_TO_CAM


def unrectified_picture(moment: float) -> np.ndarray:
    """The street through the lens at a frame number that may lie between frames, BGR uint8."""
    width, height = LENS_SIZE
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT, 200, 0.0)
    xy = cv2.undistortPoints(pixels, LENS_K, LENS_D, criteria=criteria).reshape(height, width, 2)
    street_from_camera = street_from_velo(moment) @ np.linalg.inv(unrectified_from_velo())
    rays = np.concatenate([xy, np.ones_like(xy[..., :1])], -1) @ street_from_camera[:3, :3].T
    image = colour_at(street_from_camera[:3, 3], rays, moment)
    return np.ascontiguousarray(image[..., ::-1].astype(np.uint8))


def write_as_kitti_extract(day: Path, *, frames: int = FRAMES) -> Path:
    """Write a day's folder with calibration and one drive before synchronisation."""
    drive = day / "2011_09_26_drive_0001_extract"
    write_calibration(day)
    lens_lines = [
        f"K_02: {_words(LENS_K)}",
        f"D_02: {_words(LENS_D)}",
        f"R_02: {_words(UNRECTIFIED_FROM_CAMERA_0[:3, :3])}",
        f"T_02: {_words(UNRECTIFIED_FROM_CAMERA_0[:3, 3])}",
    ]
    path = day / "calib_cam_to_cam.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("S_02")]
    _text(path, [*lines, f"S_02: {LENS_SIZE[0]:e} {LENS_SIZE[1]:e}", *lens_lines])
    for number in range(frames + IMAGE_LEAD):
        moment = number - IMAGE_LEAD + IMAGE_OFFSET_MS / 100
        _image(drive / f"image_02/data/{number:010d}.png", unrectified_picture(moment))
    image_ms = [100 * (n - IMAGE_LEAD) + IMAGE_OFFSET_MS for n in range(frames + IMAGE_LEAD)]
    _text(drive / "image_02/timestamps.txt", [_time_text(ms) for ms in image_ms])
    for frame in range(frames):
        points = points_at(frame)
        pose = street_from_velo(frame)
        sensor = (points - pose[:3, 3]) @ pose[:3, :3]
        rows = np.column_stack([sensor, np.linspace(0, 0.99, len(points))])
        text = [" ".join(f"{value:.6f}" for value in row) for row in rows]
        _text(drive / f"velodyne_points/data/{frame:010d}.txt", text)
    _text(drive / "velodyne_points/timestamps.txt", [_time_text(100 * f) for f in range(frames)])
    packet_ms = range(0, 100 * frames + 100, 50)  # the first one's latitude gives the world's scale
    for number, ms in enumerate(packet_ms):
        write_oxts(drive, number, moment=ms / 100)
    _text(drive / "oxts/timestamps.txt", [_time_text(ms) for ms in packet_ms])
    return drive


def _time_text(milliseconds: int) -> str:
    seconds = 25 + milliseconds / 1000
    return f"{START[:-2]}{seconds:012.9f}"


def drive_of_kitti(root: Path) -> Drive:
    world = world_from_street()
    times_ns = {n: START_NS + 100_000_001 * n for n in range(FRAMES)}
    world_from_velo = {n: world @ street_from_velo(n) for n in times_ns}

    def view(n: int, number: str) -> View:
        matrix = PROJECTIONS[number]
        shift = rigid(np.eye(3), np.linalg.solve(matrix[:, :3], matrix[:, 3]))
        world_from_camera = world_from_velo[n] @ np.linalg.inv(shift @ R_RECT @ VELO_TO_CAM)
        return View(times_ns[n] + 3_000_000, world_from_camera)

    def in_world(places: np.ndarray, pose: np.ndarray = world) -> np.ndarray:
        return places @ pose[:3, :3].T + pose[:3, 3]

    boxes = {n: {"0": LabelledBox("Car", in_world(car_centre(n)), CAR_SIZE_M)} for n in times_ns}
    parked = np.array([9, -4, -1.7 + CAR_SIZE_M[2] / 2])
    boxes[1]["1"] = LabelledBox("Car", in_world(parked, world_from_velo[1]), CAR_SIZE_M)
    return Drive(
        scheme="kitti",
        path=root,
        name=root.name,
        times_ns=times_ns,
        world_from_ego=world_from_velo,
        views={n: {f"image_{c}": view(n, c) for c in ("02", "03")} for n in times_ns},
        lenses={
            f"image_{c}": (WIDTH, HEIGHT, *PROJECTIONS[c][[0, 1, 0, 1], [0, 1, 2, 2]])
            for c in ("02", "03")
        },
        boxes=boxes,
        points_m={n: in_world(points_at(n)) for n in times_ns},
        car="0",
        world_from_car=lambda time: world @ rigid(np.eye(3), car_centre((time - START_NS) * 1e-8)),
        ground_z_m=ALTITUDE + GROUND_Z,
        pose_atol=2e-6,
        box_atol_m=2e-6,
        point_atol_m=1e-5,  # float32 in the file
        car_atol_m=1e-5,
        min_psnr_db=23.5,
        ground_atol_m=0.03,
    )


def moving_tracklet(frames: int) -> Tracklet:
    boxes = []
    for frame in range(frames):
        velo_from_street = np.linalg.inv(street_from_velo(frame))
        bottom = np.append(car_centre(frame) - [0, 0, CAR_SIZE_M[2] / 2], 1)
        heading = np.arctan2(velo_from_street[1, 0], velo_from_street[0, 0])
        boxes.append((*(velo_from_street @ bottom)[:3], 0.0, 0.0, heading))
    return Tracklet(0, tuple(boxes))


def write_calibration(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for number, matrix in PROJECTIONS.items():
        lines += [
            f"S_{number}: 1.392000e+03 5.120000e+02",
            f"S_rect_{number}: {WIDTH:e} {HEIGHT:e}",
            f"R_rect_{number}: {_words(R_RECT[:3, :3])}",
            f"P_rect_{number}: {_words(matrix)}",
        ]
    _text(folder / "calib_cam_to_cam.txt", lines)
    for name, pose in (("velo_to_cam", VELO_TO_CAM), ("imu_to_velo", IMU_TO_VELO)):
        parts = [f"R: {_words(pose[:3, :3])}", f"T: {_words(pose[:3, 3])}"]
        more = ["delta_f: 0.000000e+00 0.000000e+00"] if name == "velo_to_cam" else []
        _text(folder / f"calib_{name}.txt", ["calib_time: 15-Mar-2012 11:37:16", *parts, *more])


def write_sweep(path: Path, street_from_sensor: np.ndarray, frame: int) -> None:
    points = points_at(frame)
    sensor = (points - street_from_sensor[:3, 3]) @ street_from_sensor[:3, :3]
    reflectance = np.linspace(0, 0.99, len(points))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(np.column_stack([sensor, reflectance]).astype("<f4").tobytes())


def write_oxts(drive: Path, frame: int, moment: float | None = None, **replaced: float) -> None:
    """Write a packet. moment: frame number at its time; None for that of its own number."""
    scale = np.cos(LATITUDE * np.pi / 180) * EARTH_M
    position = imu_position(frame if moment is None else moment)
    x, y, z = (world_from_street() @ np.append(position, 1))[:3]
    values = {
        "latitude": np.degrees(2 * np.arctan(np.exp(y / scale)) - np.pi / 2),
        "longitude": np.degrees(x / scale),
        "altitude": z,
        "roll": 0.0,
        "pitch": 0.0,
        "yaw": YAW,
    }
    numbers = [*(values | replaced).values(), *([0.5] * 19), 4, 10, 4, 4, 0]
    _text(drive / f"oxts/data/{frame:010d}.txt", [" ".join(f"{v:.16g}" for v in numbers)])


def write_times(folder: Path, frames: int, offset_ms: int = 0) -> None:
    lines = [f"{START}.{100 * f + offset_ms:03d}000{f:03d}" for f in range(frames)]
    _text(folder / "timestamps.txt", lines)


def write_odometry(path: Path, frames: int) -> None:
    """The drive as poses of the rectified camera 0, in its own first frame."""
    rect_from_velo = R_RECT @ VELO_TO_CAM
    poses = [street_from_velo(f) @ np.linalg.inv(rect_from_velo) for f in range(frames)]
    _text(path, [_words((np.linalg.inv(poses[0]) @ pose)[:3]) for pose in poses])


def tracklets_xml(tracklets) -> str:
    items = "".join(_tracklet(t) for t in tracklets)
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n'
        "<!DOCTYPE boost_serialization>\n"
        '<boost_serialization signature="serialization::archive" version="9">\n'
        '<tracklets class_id="0" tracking_level="0" version="0">\n'
        f"<count>{len(tracklets)}</count>\n<item_version>1</item_version>\n{items}</tracklets>\n"
        "</boost_serialization>\n"
    )


def write_tracklets(drive: Path, tracklets) -> None:
    (drive / "tracklet_labels.xml").write_text(tracklets_xml(tracklets), encoding="utf-8")


def _tracklet(tracklet: Tracklet) -> str:
    length, width, height = tracklet.size
    poses = ""
    for box in tracklet.boxes:
        named = zip(("tx", "ty", "tz", "rx", "ry", "rz"), box, strict=True)
        numbers = "".join(f"<{name}>{value:.17g}</{name}>" for name, value in named)
        poses += (
            f'<item class_id="3" tracking_level="0" version="1">{numbers}<state>2</state>'
            "<occlusion>1</occlusion><occlusion_kf>0</occlusion_kf><truncation>0</truncation>"
            "<amt_occlusion>0</amt_occlusion><amt_occlusion_kf>-1</amt_occlusion_kf>"
            "<amt_border_l>0.5</amt_border_l></item>\n"
        )
    return (
        '<item class_id="1" tracking_level="0" version="1">\n'
        f"<objectType>{tracklet.label}</objectType><h>{height:.17g}</h><w>{width:.17g}</w>"
        f"<l>{length:.17g}</l><first_frame>{tracklet.first}</first_frame>\n"
        '<poses class_id="2" tracking_level="0" version="0">\n'
        f"<count>{len(tracklet.boxes)}</count><item_version>1</item_version>\n{poses}</poses>\n"
        "<finished>1</finished></item>\n"
    )


# The object benchmark's: an exactly level camera, so that headings are exact.
OBJECT_VELO_TO_CAM = rigid(AXES, [-0.004, -0.076, -0.272])
OBJECT_FROM_VELO = PROJECTIONS["02"] @ OBJECT_VELO_TO_CAM
STREET_FROM_OBJECT = rigid(np.eye(3), [0, 0, 0.8])  # the Velodyne of an object frame


def write_as_kitti_object(root: Path, numbers=(1,)) -> Path:
    """Write an object folder; frame n is the street at its moment n."""
    for number in numbers:
        name = f"{number:06d}"
        matrices = {f"P{i}": PROJECTIONS[f"0{i}"] for i in (0, 2, 3)}
        matrices |= {"P1": PROJECTIONS["00"], "R0_rect": np.eye(3)}
        matrices |= {"Tr_velo_to_cam": OBJECT_VELO_TO_CAM[:3], "Tr_imu_to_velo": IMU_TO_VELO[:3]}
        lines = [f"{key}: {_words(matrix)}" for key, matrix in matrices.items()]
        _text(root / "calib" / f"{name}.txt", [*lines, ""])
        matrix = OBJECT_FROM_VELO @ np.linalg.inv(STREET_FROM_OBJECT)
        _image(root / "image_2" / f"{name}.png", picture(matrix, number))
        write_sweep(root / "velodyne" / f"{name}.bin", STREET_FROM_OBJECT, number)
        _text(root / "label_2" / f"{name}.txt", object_lines(number))
    return root


def object_lines(number: int) -> list[str]:
    velo = car_centre(number) - STREET_FROM_OBJECT[:3, 3]
    x, y, z = AXES @ velo + OBJECT_VELO_TO_CAM[:3, 3] + [0, CAR_SIZE_M[2] / 2, 0]
    length, width, height = CAR_SIZE_M
    car = f"Car 0.10 1 -1.58 40.50 20.25 80.75 60.00 {height} {width} {length} {x} {y} {z}"
    other = "Van 0.00 2 0.30 1.00 2.00 3.00 4.00 2.0 1.9 5.0 -3.0 1.6 20.0 0.4"
    region = "DontCare -1 -1 -10 5.00 6.00 7.00 8.00 -1 -1 -1 -1000 -1000 -1000 -10"
    return [f"{car} {-np.pi / 2:.17g}", region, other]


def _image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def _text(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _words(values: np.ndarray) -> str:
    return " ".join(f"{v:.12e}" for v in np.ravel(values))
