"""The tiny street as a PandaSet sequence. The world is the sequence's own, z up."""

from __future__ import annotations

import gzip
import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from tests.adapters import street
from tests.adapters.street import Drive, LabelledBox, View

CAR_IDS = ("car-a", "car-b")  # the same car as either sensor's box


def write_as_pandaset(
    root: Path, *, offset_m: np.ndarray | None = None, semantic: bool = True
) -> Path:
    """Write the sequence into a folder, coordinates moved by offset_m; returns the folder."""
    offset = np.zeros(3) if offset_m is None else offset_m
    for name in street.CAMERAS:
        _write_camera(root, name, offset)
    (root / "lidar").mkdir()
    heading = {"w": np.sqrt(0.5), "x": 0.0, "y": 0.0, "z": -np.sqrt(0.5)}  # y forward, x right
    poses = [
        {"position": _xyz(street.ego_position(f) + offset), "heading": heading}
        for f in range(street.FRAMES)
    ]
    _dump(root / "lidar" / "poses.json", poses)
    _dump(root / "lidar" / "timestamps.json", [street.time_s(f) for f in range(street.FRAMES)])
    for frame in range(street.FRAMES):
        points, classes, times, sensor = street.sweep(frame)
        points = points + offset
        table = {c: points[:, i] for i, c in enumerate("xyz")}
        table |= {"i": np.full(len(points), 12.0), "t": times, "d": sensor}
        write_table(root / "lidar" / f"{frame:02d}.pkl.gz", table)
        if semantic:
            write_table(root / "annotations/semseg" / f"{frame:02d}.pkl.gz", {"class": classes})
        write_table(root / "annotations/cuboids" / f"{frame:02d}.pkl.gz", cuboids(frame, offset))
    return root


def drive_of_pandaset(root: Path) -> Drive:
    times_ns = {n: street.START_NS + round(1e9 * street.FRAME_S) * n for n in range(street.FRAMES)}
    parked = LabelledBox("Car", street.PARKED_AT, street.CAR_SIZE_M)
    return Drive(
        scheme="pandaset",
        path=root,
        name=root.name,
        times_ns=times_ns,
        world_from_ego={n: street.rigid(np.eye(3), street.ego_position(n)) for n in times_ns},
        views={
            n: {
                name: View(time, street.rigid(axes, street.camera_centre(n)))
                for name, axes in street.CAMERAS.items()
            }
            for n, time in times_ns.items()
        },
        lenses=dict.fromkeys(street.CAMERAS, street.LENS),
        boxes={n: {CAR_IDS[0]: street.car_box(n), "parked": parked} for n in times_ns},
        points_m={n: street.sweep(n)[0] for n in times_ns},
        car=CAR_IDS[0],
        world_from_car=street.world_from_car,
        ground_z_m=street.GROUND_Z,
        time_atol_ns=1000,  # float64 seconds
        # The boxes' own times are known to within the sweep's half width of 10 ms: 6 cm.
        car_atol_m=0.07,
    )


def write_table(path: Path, columns: dict[str, object]) -> None:
    """Pickle a table as the dataset does: object columns, named by an object index."""
    path.parent.mkdir(parents=True, exist_ok=True)
    series = {}
    for name, values in columns.items():
        is_text = isinstance(values, list)
        series[name] = pd.Series(values, dtype=object if is_text else None)
    frame = pd.DataFrame(series)
    frame.columns = pd.Index(list(columns), dtype=object)
    with gzip.open(path, "wb", compresslevel=1) as file:
        pickle.dump(frame, file, protocol=4)


def _write_camera(root: Path, name: str, offset: np.ndarray) -> None:
    folder = root / "camera" / name
    folder.mkdir(parents=True)
    poses = []
    for frame in range(street.FRAMES):
        cv2.imwrite(str(folder / f"{frame:02d}.jpg"), street.image(name, frame))
        position = street.camera_centre(frame) + offset
        poses.append({"position": _xyz(position), "heading": _quat(street.CAMERAS[name])})
    _dump(folder / "poses.json", poses)
    _dump(folder / "timestamps.json", [street.time_s(f) for f in range(street.FRAMES)])
    k = {"fx": street.FOCAL_PX, "fy": street.FOCAL_PX}
    _dump(folder / "intrinsics.json", k | {"cx": street.WIDTH / 2, "cy": street.HEIGHT / 2})


def cuboids(frame: int, offset: np.ndarray) -> dict[str, object]:
    """The moving car once a sensor, and a parked one far away."""
    centre = np.stack([street.car_centre(street.FRAME_S * frame)] * 2 + [street.PARKED_AT]) + offset
    return {
        "uuid": [*CAR_IDS, "parked"],
        "label": ["Car"] * 3,
        "yaw": np.full(3, -np.pi / 2),  # PandaSet's zero points along +y; this is +x
        "stationary": np.array([False, False, True]),
        "camera_used": np.full(3, -1),
        **{f"position.{axis}": centre[:, i] for i, axis in enumerate("xyz")},
        "dimensions.x": np.full(3, street.CAR_SIZE_M[1]),
        "dimensions.y": np.full(3, street.CAR_SIZE_M[0]),
        "dimensions.z": np.full(3, street.CAR_SIZE_M[2]),
        "attributes.object_motion": ["Moving", "Moving", "Parked"],
        "cuboids.sibling_id": [CAR_IDS[1], CAR_IDS[0], "-"],
        "cuboids.sensor_id": np.array([0, 1, -1]),
        "attributes.rider_status": [np.nan, np.nan, np.nan],
    }


def _quat(rotation: np.ndarray) -> dict[str, float]:
    """wxyz of the two rotations used here, whose trace is zero: w = 1/2."""
    r = rotation
    w = np.sqrt(1 + np.trace(r)) / 2
    x, y, z = (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    return {"w": w, "x": x / (4 * w), "y": y / (4 * w), "z": z / (4 * w)}


def _xyz(position: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", (float(v) for v in position), strict=True))


def _dump(path: Path, value: object) -> None:
    path.write_text(json.dumps(value), encoding="utf-8")
