"""nuScenes v1.0 datasets written after the published schema, by code of their own.

`write_as_nuscenes`: two scenes of three keyframes each, with sweeps between them, of the tiny
street, whose every pixel is known; the second scene lies turned and far from the map's origin.
`write_keyframe`: one scene of one keyframe around the real images and returns that the
project's shared data hold. Both load in the official devkit.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.adapters import street
from tests.adapters.street import PARKED_AT, PARKED_SIZE_M, Drive, LabelledBox, View

VERSION = "v1.0-mini"
TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
    "sample_annotation", "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
# In the order of their indices, which are the bytes of lidarseg files.
CATEGORIES = (
    "noise", "animal", "human.pedestrian.adult", "human.pedestrian.child",
    "human.pedestrian.construction_worker", "human.pedestrian.personal_mobility",
    "human.pedestrian.police_officer", "human.pedestrian.stroller", "human.pedestrian.wheelchair",
    "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
    "movable_object.trafficcone", "static_object.bicycle_rack", "vehicle.bicycle",
    "vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction",
    "vehicle.emergency.ambulance", "vehicle.emergency.police", "vehicle.motorcycle",
    "vehicle.trailer", "vehicle.truck", "flat.driveable_surface", "flat.other", "flat.sidewalk",
    "flat.terrain", "static.manmade", "static.other", "static.vegetation", "vehicle.ego",
)  # fmt: skip
ATTRIBUTES = (
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider",
    "cycle.without_rider", "pedestrian.sitting_lying_down", "pedestrian.standing",
    "pedestrian.moving",
)  # fmt: skip
VISIBILITIES = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}

SCENES = ("scene-0001", "scene-0002")
SAMPLES, KEYFRAME_S = 3, 0.5
SWEEPS, SWEEP_S = 11, 0.1  # of the LiDAR, keyframes among them
IMAGES, IMAGE_S = 5, 0.25  # of each camera, keyframes among them
START_US = (1_532_402_927_647_951, 1_535_000_000_000_000)
# Channel: the street's camera, and how long before the LiDAR's keyframe it takes its own.
# The LiDAR turns clockwise in 50 ms, and a camera is triggered as it looks along its axis; the turn
# ends, and the sweep has its time, at 104.4 degrees to the left. So it is in the real keyframe.
TURN_S, TURN_END_DEG = 0.05, 104.4
CAMERAS = {"CAM_FRONT": ("front_camera", 35_500), "CAM_FRONT_LEFT": ("left_camera", 48_000)}
EGO_FROM_LIDAR = np.array([[0.0, 1, 0, 0.94], [-1, 0, 0, 0], [0, 0, 1, 1.84], [0, 0, 0, 1]])
_TURN = Rotation.from_euler("z", 30, degrees=True).as_matrix()
_FAR = np.vstack([np.column_stack([_TURN, [2100.25, 900.5, 3.0]]), [0, 0, 0, 1]])
WORLD_FROM_STREET = (np.eye(4), _FAR)  # of each scene
CAR, PARKED, WALKER = "car", "parked", "walker"
WALKER_SIZE_M = np.array([0.7, 0.6, 1.8])


def token(*parts: object) -> str:
    """32 hexadecimal digits, as the dataset's tokens are, the same for the same words."""
    return hashlib.md5("/".join(map(str, parts)).encode()).hexdigest()


class Dataset:
    """The tables of one version as they are filled; `write` puts them into the folder."""

    def __init__(self, root: Path, version: str = VERSION) -> None:
        self.root, self.version = root, version
        self.rows: dict[str, list[dict]] = {name: [] for name in TABLES}
        for index, name in enumerate(CATEGORIES):
            self.add("category", token(name), name=name, description="", index=index)
        for name in ATTRIBUTES:
            self.add("attribute", token(name), name=name, description="")
        for key, level in VISIBILITIES.items():
            self.add("visibility", key, level=level, description="")

    def add(self, table: str, key: str, **fields: object) -> str:
        self.rows.setdefault(table, []).append({"token": key, **fields})
        return key

    def add_sensor(self, channel: str, modality: str) -> str:
        key = token(channel)
        if not any(row["token"] == key for row in self.rows["sensor"]):
            self.add("sensor", key, channel=channel, modality=modality)
        return key

    def add_calibration(
        self, scene: str, channel: str, ego_from_sensor: np.ndarray, intrinsic: Sequence = ()
    ) -> str:
        sensor = self.add_sensor(channel, "camera" if len(intrinsic) else "lidar")
        return self.add(
            "calibrated_sensor",
            token("calibration", scene, channel),
            sensor_token=sensor,
            **_pose(ego_from_sensor),
            camera_intrinsic=[list(map(float, row)) for row in intrinsic],
        )

    def add_data(
        self,
        key: str,
        sample: str,
        calibration: str,
        world_from_ego: np.ndarray,
        timestamp_us: int,
        filename: str,
        *,
        is_key_frame: bool,
        size: tuple[int, int] = (0, 0),
    ) -> None:
        """size: width, height; of images. prev and next are tied by `write`."""
        self.add("ego_pose", key, timestamp=timestamp_us, **_pose(world_from_ego))
        self.add(
            "sample_data",
            key,
            sample_token=sample,
            ego_pose_token=key,
            calibrated_sensor_token=calibration,
            timestamp=timestamp_us,
            fileformat="jpg" if size[0] else "pcd",
            is_key_frame=is_key_frame,
            height=size[1],
            width=size[0],
            filename=filename,
            prev="",
            next="",
        )

    def add_scene(self, name: str, timestamps_us: Sequence[int]) -> list[str]:
        """The scene, its log, its map and its samples; returns the samples' tokens."""
        log = self.add(
            "log", token("log", name), logfile=f"n000-{name}", vehicle="n000",
            date_captured="2018-07-24", location="singapore-onenorth",
        )  # fmt: skip
        picture = f"maps/{token('map', name)}.png"
        (self.root / "maps").mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(self.root / picture), np.zeros((8, 8), np.uint8))
        self.add(
            "map", token("map", name), log_tokens=[log], category="semantic_prior", filename=picture
        )
        samples = [token("sample", name, i) for i in range(len(timestamps_us))]
        scene = self.add(
            "scene", token("scene", name), log_token=log, nbr_samples=len(samples),
            first_sample_token=samples[0], last_sample_token=samples[-1], name=name,
            description="a street",
        )  # fmt: skip
        for key, time, before, after in zip(
            samples, timestamps_us, ["", *samples], [*samples[1:], ""], strict=False
        ):
            self.add("sample", key, timestamp=time, prev=before, next=after, scene_token=scene)
        return samples

    def add_instance(self, key: str, category: str, boxes: Sequence[dict]) -> None:
        """One object. boxes: in order, each with sample, world_from_box, size_m (length, width,
        height), attributes (names), visibility, lidar_points."""
        keys = [token("annotation", key, box["sample"]) for box in boxes]
        self.add(
            "instance", key, category_token=token(category), nbr_annotations=len(boxes),
            first_annotation_token=keys[0], last_annotation_token=keys[-1],
        )  # fmt: skip
        for i, (own, box) in enumerate(zip(keys, boxes, strict=True)):
            length, width, height = (float(v) for v in box["size_m"])
            self.add(
                "sample_annotation",
                own,
                sample_token=box["sample"],
                instance_token=key,
                visibility_token=box.get("visibility", "4"),
                attribute_tokens=[token(name) for name in box.get("attributes", ())],
                **_pose(box["world_from_box"]),
                size=[width, length, height],
                prev=keys[i - 1] if i else "",
                next=keys[i + 1] if i + 1 < len(keys) else "",
                num_lidar_pts=int(box.get("lidar_points", 0)),
                num_radar_pts=int(box.get("radar_points", 0)),
            )

    def add_classes(self, data: str, classes: np.ndarray) -> None:
        """The class of every return of a sweep, in a lidarseg file."""
        name = f"lidarseg/{self.version}/{data}_lidarseg.bin"
        write_bytes(self.root / name, classes.astype(np.uint8).tobytes())
        self.add("lidarseg", data, sample_data_token=data, filename=name)

    def write(self) -> Path:
        self._tie_data()
        for name, rows in self.rows.items():
            write_table(self.root, name, rows, self.version)
        return self.root

    def _tie_data(self) -> None:
        """Sweeps of a sensor follow each other as the links say, keyframes or not."""
        groups: dict[str, list[dict]] = {}
        for row in self.rows["sample_data"]:
            groups.setdefault(row["calibrated_sensor_token"], []).append(row)
        for rows in groups.values():
            rows.sort(key=lambda row: row["timestamp"])
            for before, after in itertools.pairwise(rows):
                before["next"], after["prev"] = after["token"], before["token"]


def read_table(root: Path, name: str, version: str = VERSION) -> list[dict]:
    return json.loads((root / version / f"{name}.json").read_text())


def write_table(root: Path, name: str, rows: object, version: str = VERSION) -> None:
    path = root / version / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=0))


def write_bytes(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def write_as_nuscenes(
    root: Path, *, version: str = VERSION, scenes: Sequence[str] = SCENES, semantic: bool = True
) -> Path:
    """The street as a dataset; returns its folder. semantic: with lidarseg, of keyframes."""
    data = Dataset(root, version)
    for number, name in enumerate(SCENES):
        if name in scenes:
            _write_scene(data, number, name, semantic=semantic)
    return data.write()


def drive_of_nuscenes(root: Path) -> Drive:
    """The second scene, which lies far from the map's origin."""
    times_ns = {n: 1000 * time for n, time in enumerate(sweep_times_us(1))}
    views: dict[int, dict[str, View]] = {n: {} for n in times_ns}
    for channel in CAMERAS:
        # The sweep that is nearest in time has the image.
        for n, time_us in zip((0, 2, 5, 7, 10), image_times_us(1, channel), strict=True):
            ego = world_from_ego(1, (time_us - START_US[1]) * 1e-6)
            views[n][channel] = View(1000 * time_us, ego @ ego_from_camera(channel))
    kinds = {
        CAR: ("vehicle.car", street.CAR_SIZE_M),
        PARKED: ("vehicle.truck", PARKED_SIZE_M),
        WALKER: ("human.pedestrian.adult", WALKER_SIZE_M),
    }

    def box(thing: str, keyframe: int) -> LabelledBox:
        label, size_m = kinds[thing]
        return LabelledBox(label, box_pose(1, thing, KEYFRAME_S * keyframe)[:3, 3], size_m)

    def world_from_car(timestamp_ns: int) -> np.ndarray:
        time_s = (timestamp_ns - 1000 * START_US[1]) * 1e-9
        return WORLD_FROM_STREET[1] @ street.rigid(np.eye(3), place(CAR, time_s))

    turn, shift = WORLD_FROM_STREET[1][:3, :3], WORLD_FROM_STREET[1][:3, 3]
    return Drive(
        scheme="nuscenes",
        path=root,
        query={"scene": SCENES[1]},
        name=SCENES[1],
        times_ns=times_ns,
        world_from_ego={n: world_from_ego(1, SWEEP_S * n) for n in times_ns},
        views=views,
        lenses=dict.fromkeys(CAMERAS, street.LENS),
        boxes={
            5 * k: {instance_token(1, t): box(t, k) for t in kinds if t != WALKER or k}
            for k in range(SAMPLES)
        },
        points_m={n: sweep(n)[0] @ turn.T + shift for n in times_ns},
        car=instance_token(1, CAR),
        world_from_car=world_from_car,
        ground_z_m=WORLD_FROM_STREET[1][2, 3] + street.GROUND_Z,
        min_psnr_db=25.5,
        point_atol_m=1e-5,  # float32 in the sensor's axes
        # In the sweep's 40 ms before its boxes' time it moved by 0.24 m: that is accounted for.
        car_atol_m=2e-3,
    )


def ego_from_camera(channel: str) -> np.ndarray:
    """The street's camera stands above the ego's origin, which nuScenes has on the ground."""
    return street.rigid(street.CAMERAS[CAMERAS[channel][0]], [0, 0, street.CAMERA_HEIGHT_M])


def world_from_ego(scene: int, time_s: float) -> np.ndarray:
    place = [street.EGO_SPEED_MPS * time_s, 0, street.GROUND_Z]
    return WORLD_FROM_STREET[scene] @ street.rigid(np.eye(3), place)


def place(thing: str, time_s: float) -> np.ndarray:
    """Where the centre of a thing is in the street."""
    walked = np.array([12.0 + time_s, -4.0, street.GROUND_Z + 0.9])
    return {CAR: street.car_centre(time_s), PARKED: PARKED_AT, WALKER: walked}[thing]


def met_s(thing: str, time_s: float) -> float:
    """When the sweep that has this time met a thing."""
    x, y, _ = place(thing, time_s) - [street.EGO_SPEED_MPS * time_s + EGO_FROM_LIDAR[0, 3], 0, 0]
    turned = (np.degrees(np.arctan2(y, x)) - TURN_END_DEG) % 360 / 360
    return float(time_s - turned * TURN_S)


def box_pose(scene: int, thing: str, time_s: float) -> np.ndarray:
    """world_from_box of a thing as a keyframe of this time has it: where the LiDAR met it. All look
    along the street's x."""
    return WORLD_FROM_STREET[scene] @ street.rigid(np.eye(3), place(thing, met_s(thing, time_s)))


def image_times_us(scene: int, channel: str) -> list[int]:
    start = START_US[scene] - CAMERAS[channel][1]
    return [start + round(IMAGE_S * 1e6) * i for i in range(IMAGES)]


def sweep_times_us(scene: int) -> list[int]:
    return [START_US[scene] + round(SWEEP_S * 1e6) * i for i in range(SWEEPS)]


def data_token(scene: int, channel: str, number: int) -> str:
    """Of the number-th image or sweep of a channel, from 0 in time."""
    return token("data", SCENES[scene], channel, number)


def sample_token(scene: int, number: int) -> str:
    return token("sample", SCENES[scene], number)


def instance_token(scene: int, thing: str) -> str:
    return token("instance", SCENES[scene], thing)


def filename(scene: int, channel: str, number: int) -> str:
    """Of the number-th image or sweep, relative to the dataset's folder."""
    if channel == "LIDAR_TOP":
        time, suffix = sweep_times_us(scene)[number], "pcd.bin"
        is_key = number % round(KEYFRAME_S / SWEEP_S) == 0
    else:
        time, suffix = image_times_us(scene, channel)[number], "jpg"
        is_key = number % round(KEYFRAME_S / IMAGE_S) == 0
    folder = "samples" if is_key else "sweeps"
    return f"{folder}/{channel}/n000-{SCENES[scene]}__{channel}__{time}.{suffix}"


def sweep(number: int) -> tuple[np.ndarray, np.ndarray]:
    """The number-th sweep: returns float64 [N, 3] in the street's world, and their lidarseg bytes.

    Ground, a wall, and the moving car's back, side and roof; two on the recording car's own roof.
    """
    rng = np.random.default_rng(number)
    time = SWEEP_S * number
    ground, wall, car = street.scattered_surfaces(
        rng, step_m=0.3, reach_m=34, jitter_m=0.15, num_on_face=300
    )
    car = car + place(CAR, met_s(CAR, time))
    own = np.array([[0.5, 0.3, 1.45], [1.5, -0.4, 1.4]]) + np.array(
        [street.EGO_SPEED_MPS * time, 0, street.GROUND_Z]
    )
    parts = (len(ground), len(wall), len(car), len(own))
    return np.concatenate([ground, wall, car, own]), np.repeat([24, 28, 17, 31], parts)


def sweep_bytes(points: np.ndarray) -> bytes:
    """Records of x, y, z, intensity, ring as float32. points: float64 [N, 3], sensor."""
    records = np.zeros((len(points), 5), np.float32)
    records[:, :3] = points
    records[:, 3] = np.arange(len(points)) % 256
    records[:, 4] = np.arange(len(points)) % 32
    return records.tobytes()


def _write_scene(data: Dataset, scene: int, name: str, *, semantic: bool) -> None:
    times = [START_US[scene] + round(KEYFRAME_S * 1e6) * i for i in range(SAMPLES)]
    samples = data.add_scene(name, times)
    _write_lidar(data, scene, name, samples, semantic=semantic)
    for channel in CAMERAS:
        _write_images(data, scene, name, channel, samples)
    kinds = {
        CAR: ("vehicle.car", street.CAR_SIZE_M, ("vehicle.moving",), range(SAMPLES)),
        PARKED: ("vehicle.truck", PARKED_SIZE_M, ("vehicle.parked",), range(SAMPLES)),
        # Labelled from the second keyframe on.
        WALKER: ("human.pedestrian.adult", WALKER_SIZE_M, ("pedestrian.moving",), range(1, 3)),
    }
    for thing, (category, size, attributes, numbers) in kinds.items():
        boxes = [
            {
                "sample": samples[i],
                "world_from_box": box_pose(scene, thing, KEYFRAME_S * i),
                "size_m": size,
                "attributes": attributes,
                "visibility": "3" if thing == PARKED else "4",
                "lidar_points": 900 if thing == CAR else 0,
            }
            for i in numbers
        ]
        data.add_instance(instance_token(scene, thing), category, boxes)


def _write_lidar(
    data: Dataset, scene: int, name: str, samples: list[str], *, semantic: bool
) -> None:
    calibration = data.add_calibration(name, "LIDAR_TOP", EGO_FROM_LIDAR)
    for number, time in enumerate(sweep_times_us(scene)):
        ego = world_from_ego(scene, SWEEP_S * number)
        world_from_lidar = ego @ EGO_FROM_LIDAR
        points, classes = sweep(number)
        points = points @ WORLD_FROM_STREET[scene][:3, :3].T + WORLD_FROM_STREET[scene][:3, 3]
        local = (points - world_from_lidar[:3, 3]) @ world_from_lidar[:3, :3]
        file = filename(scene, "LIDAR_TOP", number)
        write_bytes(data.root / file, sweep_bytes(local))
        key = data_token(scene, "LIDAR_TOP", number)
        is_key = file.startswith("samples/")
        # A sweep belongs to the keyframe that comes after it.
        sample = samples[-(-number // round(KEYFRAME_S / SWEEP_S))]
        data.add_data(key, sample, calibration, ego, time, file, is_key_frame=is_key)
        if is_key and semantic:
            data.add_classes(key, classes)


def _write_images(data: Dataset, scene: int, name: str, channel: str, samples: list[str]) -> None:
    width, height, focal = street.WIDTH, street.HEIGHT, street.FOCAL_PX
    intrinsic = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    ego_from_cam = ego_from_camera(channel)
    calibration = data.add_calibration(name, channel, ego_from_cam, intrinsic)
    street_from_world = np.linalg.inv(WORLD_FROM_STREET[scene])
    for number, time in enumerate(image_times_us(scene, channel)):
        time_s = (time - START_US[scene]) * 1e-6
        ego = world_from_ego(scene, time_s)
        pose = street_from_world @ ego @ ego_from_cam
        image = street.colour_at(pose[:3, 3], street.local_rays() @ pose[:3, :3].T, time_s)
        file = filename(scene, channel, number)
        (data.root / file).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(data.root / file), image[..., ::-1].astype(np.uint8))
        sample = samples[-(-number // round(KEYFRAME_S / IMAGE_S))]
        data.add_data(
            data_token(scene, channel, number), sample, calibration, ego, time, file,
            is_key_frame=file.startswith("samples/"), size=(width, height),
        )  # fmt: skip


def write_keyframe(root: Path, source: Path) -> Path:
    """One scene of the one real keyframe in `source` (info.json and demo_nuscenes/)."""
    info = json.loads((source / "info.json").read_text())
    (frame,) = info["data_list"]
    names = {number: name for name, number in info["metainfo"]["categories"].items()}
    data = Dataset(root)
    name = "scene-0061"
    time = _microseconds(frame["timestamp"])
    (sample,) = data.add_scene(name, [time])
    world_from_lidar = np.array(frame["ego2global"]) @ np.array(frame["lidar_points"]["lidar2ego"])
    data.add_data(
        token("data", "LIDAR_TOP"), sample,
        data.add_calibration(name, "LIDAR_TOP", np.array(frame["lidar_points"]["lidar2ego"])),
        np.array(frame["ego2global"]), time,
        _copy(source, root, "LIDAR_TOP", frame["lidar_points"]["lidar_path"]), is_key_frame=True,
    )  # fmt: skip
    for channel, image in frame["images"].items():
        ego_from_cam = np.array(image["cam2ego"])
        # The car moved on between the LiDAR's moment and the camera's: its pose then.
        ego = world_from_lidar @ np.linalg.inv(ego_from_cam @ np.array(image["lidar2cam"]))
        data.add_data(
            image["sample_data_token"], sample,
            data.add_calibration(name, channel, ego_from_cam, image["cam2img"]),
            ego, _microseconds(image["timestamp"]),
            _copy(source, root, channel, image["img_path"]), is_key_frame=True, size=(1600, 900),
        )  # fmt: skip
    for number, thing in enumerate(frame["instances"]):
        ending = _ENDINGS.get(names.get(thing["bbox_label_3d"], ""), ".debris")
        category = next(c for c in CATEGORIES if c.endswith(ending))
        x, y, z, length, width, height, yaw = thing["bbox_3d"]
        box = np.eye(4)
        box[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
        box[:3, 3] = x, y, z
        moves = np.hypot(*(v or 0.0 for v in thing["velocity"])) > 0.5  # some are unknown
        kind = category.split(".")[0 if category.startswith("vehicle") else 1]
        data.add_instance(
            token("instance", name, number),
            category,
            [
                {
                    "sample": sample,
                    "world_from_box": world_from_lidar @ box,
                    "size_m": (length, width, height),
                    "attributes": (f"{kind}.moving",)
                    if moves and kind in ("vehicle", "pedestrian")
                    else (),
                    "lidar_points": thing["num_lidar_pts"],
                    "radar_points": thing["num_radar_pts"],
                }
            ],
        )
    return data.write()


_ENDINGS = {
    "car": ".car", "truck": ".truck", "trailer": ".trailer", "bus": ".bus.rigid",
    "construction_vehicle": ".construction", "bicycle": ".bicycle", "motorcycle": ".motorcycle",
    "pedestrian": ".pedestrian.adult", "traffic_cone": ".trafficcone", "barrier": ".barrier",
}  # fmt: skip


def _copy(source: Path, root: Path, channel: str, name: str) -> str:
    file = f"samples/{channel}/{name}"
    (root / file).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source / "demo_nuscenes" / name, root / file)
    return file


def _microseconds(seconds: float) -> int:
    return round(seconds * 1e6)


def _pose(matrix: np.ndarray) -> dict[str, list[float]]:
    """A pose as the tables have it: metres, and a quaternion wxyz."""
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return {
        "translation": [float(v) for v in matrix[:3, 3]],
        "rotation": [float(w), float(x), float(y), float(z)],
    }
