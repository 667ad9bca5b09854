"""An Argoverse 2 log written after the published format, by code of its own.

`write_as_av2`: the tiny street, whose every pixel is known, in a city some
kilometres from its origin. The car drives 8 m/s along the street's x and turns to the left on the
spot, so that every moment has another pose. Two LiDARs turn clockwise half a turn apart.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
from scipy.spatial.transform import Rotation

from tests.adapters import street
from tests.adapters.street import PARKED_AT, PARKED_SIZE_M, Drive, LabelledBox, View, rigid

NAME = "0a1b2c3d-0000-3000-8000-000000000001"
START_NS = 315_966_253_660_357_000
FRAMES = 4
# Sweeps do not come every 100 ms to the nanosecond.
STAMPS_NS = tuple(START_NS + 100_000_000 * f + (0, 196_000, -271_000, -75_000)[f] for f in range(4))
FIRST_NS, TURN_NS = 2_654_000, 100_000_000
YAW_RADPS, EGO_ABOVE_M = 0.25, 0.3
GROUND_Z = street.GROUND_Z
CAR, PARKED = "11111111-aaaa", "22222222-bbbb"
EGO_CV = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # ego_from_camera of one that looks ahead


def turned(degrees: float) -> np.ndarray:
    return street.turn(2, np.radians(degrees))


CITY_FROM_STREET = rigid(turned(30), [5172.668, 2419.103, 66.93])
# Camera: ego_from_camera, width, height, fx, fy, cx, cy with whole numbers at pixels' middles; how
# long after a sweep's stamp it takes the image that is nearest to that.
CAMERAS = {
    "ring_front_center": (rigid(EGO_CV, [1.6, 0, 1.4]), (96, 128), (80.0, 80.0, 46.2, 60.9), -9.9),
    "ring_side_left": (
        rigid(turned(90) @ EGO_CV, [1.3, 0.3, 1.4]), (160, 96), (80.0, 81.0, 80.3, 47.0), 14.2
    ),
    "stereo_front_left": (rigid(EGO_CV, [1.6, 0.25, 1.2]), (80, 60), (70.0, 70.0, 39.5, 29.5), 2.0),
}  # fmt: skip
LIDARS = {
    "up_lidar": rigid(turned(3), [1.35, 0.0, 1.64]),
    "down_lidar": rigid(turned(-11) @ np.diag([1.0, -1, -1]), [1.347, 0.005, 1.525]),
}


def street_from_ego(time_s: float) -> np.ndarray:
    """Time in seconds after START_NS."""
    place = [street.EGO_SPEED_MPS * time_s, 0, GROUND_Z + EGO_ABOVE_M]
    return rigid(turned(np.degrees(YAW_RADPS * time_s)), place)


def city_from_ego(timestamp_ns: int) -> np.ndarray:
    return CITY_FROM_STREET @ street_from_ego((timestamp_ns - START_NS) * 1e-9)


def into_street(points: np.ndarray) -> np.ndarray:
    """City points [N, 3] in the street."""
    return (points - CITY_FROM_STREET[:3, 3]) @ CITY_FROM_STREET[:3, :3]


def passes_ns(directions: np.ndarray) -> np.ndarray:
    """When the up and the down LiDAR look along directions in ego axes [N, 2], after the stamp;
    [N, 2], of which the earlier is less than half a turn after FIRST_NS."""
    bearings = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    up = (144.0 - bearings) / 360 * TURN_NS
    both = np.stack([up, up + TURN_NS / 2], axis=1)
    return FIRST_NS + np.mod(both - FIRST_NS, TURN_NS)


def met_ns(place: np.ndarray, stamp_ns: int) -> float:
    """Mean of the moments at which the LiDARs meet what lies at a place of the street."""
    ego = np.linalg.inv(street_from_ego((stamp_ns - START_NS) * 1e-9)) @ np.append(place, 1)
    return float(passes_ns((ego[:3] - LIDARS["up_lidar"][:3, 3])[None]).mean())


def sweep(frame: int) -> dict[str, np.ndarray]:
    """Ground, wall and the moving car, each return as it stood when it was met, in the car's axes
    at the stamp."""
    rng = np.random.default_rng(frame)
    stamp = STAMPS_NS[frame]
    ground, wall, local = street.scattered_surfaces(
        rng, step_m=0.25, reach_m=30, jitter_m=0.1, num_on_face=700
    )
    ego_from_street = np.linalg.inv(street_from_ego((stamp - START_NS) * 1e-9))

    def met(points: np.ndarray, sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ego = points @ ego_from_street[:3, :3].T + ego_from_street[:3, 3]
        both = passes_ns(ego - LIDARS["up_lidar"][:3, 3])
        return ego, both[np.arange(len(points)), sensor]

    static = np.concatenate([ground, wall])
    sensors = [rng.integers(0, 2, len(part)) for part in (static, local)]
    points, offsets = met(static, sensors[0])
    stamp_s = (stamp - START_NS) * 1e-9
    _, car_offsets = met(local + street.car_centre(stamp_s + 0.05), sensors[1])
    places = np.stack([street.car_centre(stamp_s + t * 1e-9) for t in car_offsets])
    car, _ = met(local + places, sensors[1])
    points, offsets = np.concatenate([points, car]), np.concatenate([offsets, car_offsets])
    order = np.argsort(offsets, kind="stable")
    lasers = rng.integers(0, 32, len(points)) + 32 * np.concatenate(sensors)
    columns = {axis: points[order, i].astype(np.float16) for i, axis in enumerate("xyz")}
    columns["intensity"] = (np.arange(len(points)) % 256).astype(np.uint8)
    columns["laser_number"] = lasers[order].astype(np.uint8)
    columns["offset_ns"] = offsets[order].astype(np.int32)
    return columns


def image_times_ns(camera: str) -> list[int]:
    """Every 50 ms, two in each sweep and one before."""
    offset = round(CAMERAS[camera][3] * 1e6)
    return [START_NS + offset + 50_000_000 * i for i in range(-1, 2 * FRAMES)]


def picture(camera: str, timestamp_ns: int) -> np.ndarray:
    """RGB uint8 [H, W, 3]; grey in three channels of a stereo camera."""
    ego_from_camera, (width, height), (fx, fy, cx, cy), _ = CAMERAS[camera]
    time_s = (timestamp_ns - START_NS) * 1e-9
    pose = street_from_ego(time_s) @ ego_from_camera
    u, v = np.meshgrid((np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ pose[:3, :3].T
    image = street.colour_at(pose[:3, 3], rays, time_s).astype(np.uint8)
    grey = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    return grey if camera.startswith("stereo") else image


def columns_of(poses: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    matrices = np.stack(poses)
    x, y, z, w = Rotation.from_matrix(matrices[:, :3, :3]).as_quat().T
    places = dict(zip(("tx_m", "ty_m", "tz_m"), matrices[:, :3, 3].T, strict=True))
    return {"qw": w, "qx": x, "qy": y, "qz": z, **places}


def write_table(path: Path, columns: Mapping[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(dict(columns)), path)


def write_as_av2(root: Path, *, cameras: Sequence[str] = tuple(CAMERAS)) -> Path:
    """Write a log into a folder; returns the folder."""
    steps = np.arange(-80_000_000, 520_000_000, 4_300_000) + START_NS
    times = np.unique(np.concatenate([steps, STAMPS_NS]))
    poses = [city_from_ego(int(time)) for time in times]
    write_table(root / "city_SE3_egovehicle.feather", {"timestamp_ns": times, **columns_of(poses)})
    sensors = {name: CAMERAS[name][0] for name in cameras} | LIDARS
    write_table(
        root / "calibration/egovehicle_SE3_sensor.feather",
        {"sensor_name": list(sensors), **columns_of(list(sensors.values()))},
    )
    lenses = np.array([CAMERAS[name][2] for name in cameras]).T
    sizes = np.array([CAMERAS[name][1] for name in cameras], np.uint16).T
    write_table(
        root / "calibration/intrinsics.feather",
        {
            "sensor_name": list(cameras),
            **dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), lenses, strict=True)),
            **{name: np.full(len(cameras), -0.28) for name in ("k1", "k2", "k3")},
            "height_px": sizes[1],
            "width_px": sizes[0],
        },
    )
    for name in cameras:
        folder = root / "sensors/cameras" / name
        folder.mkdir(parents=True)
        for time in image_times_ns(name):
            image = np.ascontiguousarray(picture(name, time)[..., ::-1])
            flags = [cv2.IMWRITE_JPEG_QUALITY, 98]
            assert cv2.imwrite(str(folder / f"{time}.jpg"), image, flags)
    for frame, stamp in enumerate(STAMPS_NS):
        write_table(root / f"sensors/lidar/{stamp}.feather", sweep(frame))
    write_annotations(root)
    write_map(root)
    return root


def drive_of_av2(root: Path) -> Drive:
    times_ns = dict(enumerate(STAMPS_NS))
    views: dict[int, dict[str, View]] = {n: {} for n in times_ns}
    for n, stamp in times_ns.items():
        for name in CAMERAS:
            nearest = min(image_times_ns(name), key=lambda time, stamp=stamp: abs(time - stamp))
            views[n][name] = View(nearest, city_from_ego(nearest) @ CAMERAS[name][0])
    # Argoverse's whole numbers are the middles of pixels, ours are their corners.
    lenses = {
        name: (*size, fx, fy, cx + 0.5, cy + 0.5)
        for name, (_, size, (fx, fy, cx, cy), _) in CAMERAS.items()
    }

    def in_city(place: np.ndarray) -> np.ndarray:
        return (CITY_FROM_STREET @ np.append(place, 1))[:3]

    def world_from_car(timestamp_ns: int) -> np.ndarray:
        time_s = (timestamp_ns - START_NS) * 1e-9
        return CITY_FROM_STREET @ rigid(np.eye(3), street.car_centre(time_s))

    parked = LabelledBox("BOX_TRUCK", in_city(PARKED_AT), PARKED_SIZE_M)
    points_m = {}
    for n, stamp in times_ns.items():
        columns = sweep(n)
        pose = city_from_ego(stamp)
        local = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
        points_m[n] = local @ pose[:3, :3].T + pose[:3, 3]
    return Drive(
        scheme="av2",
        path=root,
        name=root.name,
        times_ns=times_ns,
        world_from_ego={n: city_from_ego(stamp) for n, stamp in times_ns.items()},
        views=views,
        lenses=lenses,
        boxes={
            n: {
                CAR: LabelledBox("REGULAR_VEHICLE", in_city(car_met(stamp)), street.CAR_SIZE_M),
                PARKED: parked,
            }
            for n, stamp in times_ns.items()
        },
        points_m=points_m,
        car=CAR,
        world_from_car=world_from_car,
        # Heights of 16 bits: 6 cm apart at 67 m.
        ground_z_m=float(np.float16(GROUND_Z + CITY_FROM_STREET[2, 3])),
        min_psnr_db=23.5,
        pose_atol=2e-6,  # between two poses 4 ms apart the drive is straight to a micrometre
        # Half a degree of bearing, which returns of 16 bits are wrong by, is 0.14 ms.
        car_atol_m=0.01,
    )


def car_met(stamp_ns: int) -> np.ndarray:
    """Place in the street at which the LiDARs of a sweep meet the car."""
    time_s = (stamp_ns - START_NS) * 1e-9
    middle = street.car_centre(time_s + 0.05)
    return street.car_centre(time_s + met_ns(middle, stamp_ns) * 1e-9)


def write_annotations(root: Path) -> None:
    rows: list[dict[str, object]] = []
    for stamp in STAMPS_NS:
        ego_from_city = np.linalg.inv(city_from_ego(stamp))
        things = {
            CAR: ("REGULAR_VEHICLE", car_met(stamp), street.CAR_SIZE_M, 900),
            PARKED: ("BOX_TRUCK", PARKED_AT, PARKED_SIZE_M, 0),
        }
        for name, (category, place, size, count) in things.items():
            pose = ego_from_city @ CITY_FROM_STREET @ rigid(np.eye(3), place)
            rows.append(
                {"timestamp_ns": stamp, "track_uuid": name, "category": category}
                | dict(zip(("length_m", "width_m", "height_m"), map(float, size), strict=True))
                | {k: float(v[0]) for k, v in columns_of([pose]).items()}
                | {"num_interior_pts": count}
            )
    write_table(root / "annotations.feather", {k: [row[k] for row in rows] for k in rows[0]})


def write_map(root: Path, *, rotation_deg: float = 0.0) -> None:
    """Heights over cells of 0.3 m; the street's road lies right of y = 4 m. rotation_deg: of the
    grid's axes in the city's."""
    folder, prefix = root / "map", f"{NAME}_"
    folder.mkdir(parents=True, exist_ok=True)
    scale, rotation = 1 / 0.3, turned(rotation_deg)[:2, :2]
    x, y = np.meshgrid([-20.0, 45.0], [-15.0, 15.0])
    corners = np.stack([x.ravel(), y.ravel()], 1) @ CITY_FROM_STREET[:2, :2].T
    corners = corners @ rotation.T + rotation @ CITY_FROM_STREET[:2, 3]
    offset = -corners.min(axis=0)
    columns, rows = np.ceil(scale * (corners.max(axis=0) + offset)).astype(int)
    heights = np.full((rows, columns), GROUND_Z + CITY_FROM_STREET[2, 3], np.float16)
    heights[:5] = np.nan
    np.save(folder / f"{prefix}ground_height_surface____PIT.npy", heights)
    grid = {"R": rotation.ravel().tolist(), "t": offset.tolist(), "s": scale}
    (folder / f"{NAME}___img_Sim2_city.json").write_text(json.dumps(grid))
    outline = [[-20, -15], [45, -15], [45, 4], [-20, 4]]
    boundary = [CITY_FROM_STREET @ [x, y, GROUND_Z, 1] for x, y in outline]
    area = {"id": 7, "area_boundary": [dict(zip("xyz", p[:3], strict=True)) for p in boundary]}
    content = {"drivable_areas": {"7": area}, "lane_segments": {}, "pedestrian_crossings": {}}
    path = folder / f"log_map_archive_{NAME}____PIT_city_1.json"
    path.write_text(json.dumps(content))
