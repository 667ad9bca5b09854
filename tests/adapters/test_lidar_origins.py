"""Where beams start, as each adapter's labels say: rays through known surfaces tell."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import nuscenes_files
import pandaset_folder
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from drivestudio_files import write_run

from adapters.drivestudio.adapter import drivestudio_labels
from adapters.kitti.adapter import KittiLabels
from adapters.nuscenes.adapter import nuscenes_labels
from adapters.pandaset.files import SENSORS_M, PandaSetLabels, read_lidar
from adapters.procedural import LOWEST_DEG, StreetLabels, lidar_rays
from adapters.recording.adapter import RecordingLabels
from adapters.street.layout import StreetParameters
from adapters.street_gaussians.adapter import ROOF_SENSOR_M, StreetGaussiansLabels
from augment.labels import KnowsLidarOrigins, LidarSweep

PANDASET = Path(__file__).resolve().parents[3] / "shared" / "data" / "pandaset_mini" / "002"


def test_street_origins_give_back_the_beams() -> None:
    parameters = StreetParameters(frames=2, lidar_columns=16, lidar_rings=8)
    labels = StreetLabels(parameters)
    origins, directions, times = lidar_rays(SimpleNamespace(parameters=parameters), 1)
    count = directions.shape[1]
    points = (origins[:, None] + 7.0 * directions).reshape(-1, 3)
    columns = {name: points[:, axis] for axis, name in enumerate("xyz")}
    sweep = LidarSweep({**columns, "timestamp_ns": np.repeat(times, count)})
    found = labels.lidar_origins(1, sweep)
    np.testing.assert_allclose(np.linalg.norm(points - found, axis=1), 7.0, atol=1e-9)
    lowest = np.degrees(np.arcsin((points - found)[::count, 2] / 7.0))
    np.testing.assert_allclose(lowest, LOWEST_DEG, atol=1e-6)
    assert isinstance(labels, KnowsLidarOrigins)


def test_pandasets_sensors_ride_on_the_car(tmp_path: Path) -> None:
    offset = np.array([1000.0, -50.0, 3.0])
    labels = PandaSetLabels(pandaset_folder.write_sequence(tmp_path, offset_m=offset))
    first = pandaset_folder.time_s(0)
    seconds = first + np.array([0.1, 0.05, 0.0, -0.1, 0.1])
    sweep = LidarSweep({name: np.zeros(5) for name in "xyz"} | {
        "t": seconds, "d": np.array([0, 0, 0, 0, 1]),
    })  # fmt: skip
    found = labels.lidar_origins(1, sweep) - offset
    along = pandaset_folder.EGO_SPEED_MPS * (seconds - first)
    expected = SENSORS_M[[0, 0, 0, 0, 1]] + along[:, None] * [1.0, 0.0, 0.0]
    np.testing.assert_allclose(found, expected, atol=1e-5)  # float64 seconds since 1970
    assert labels.lidar_origins(99, sweep) is None


@pytest.mark.skipif(not PANDASET.is_dir(), reason=f"{PANDASET} is not there")
def test_published_beams_of_each_sensor_do_not_cross() -> None:
    """From where a sensor is, its returns hide each other least: from half a metre beside, more of
    a direction's returns lie at different ranges.
    """
    table = read_lidar(PANDASET, 5)
    labels = PandaSetLabels(PANDASET)
    sweep = labels.lidar(5)
    assert table is not None and sweep is not None
    origins = labels.lidar_origins(5, sweep)
    forward = np.asarray(sweep.columns["d"]) == 1
    points, at = sweep.points_m[forward], origins[forward]

    def crossed(offset: tuple[float, float, float]) -> float:
        ray = points - at - np.array(offset)
        ranges = np.linalg.norm(ray, axis=1)
        azimuth = np.floor(np.degrees(np.arctan2(ray[:, 1], ray[:, 0])) / 0.15).astype(int)
        elevation = np.floor(np.degrees(np.arcsin(ray[:, 2] / ranges)) / 0.15).astype(int)
        order = np.lexsort([ranges, elevation, azimuth])
        same = (np.diff(azimuth[order]) == 0) & (np.diff(elevation[order]) == 0)
        return float((np.diff(np.log(ranges[order]))[same] > 0.1).mean())

    here = crossed((0.0, 0.0, 0.0))
    for axis in range(1, 3):
        for side in (-0.4, 0.4):
            offset = [0.0, 0.0, 0.0]
            offset[axis] = side
            assert crossed((offset[0], offset[1], offset[2])) > 1.1 * here


def test_nuscenes_sensor_at_the_files_time(tmp_path: Path) -> None:
    root = nuscenes_files.write_dataset(tmp_path)
    labels = nuscenes_labels(str(root), {"scene": "scene-0001"})
    sweep = labels.lidar(0)
    found = labels.lidar_origins(0, sweep)
    assert found.shape == (len(sweep), 3) and labels.lidar_origins(99, sweep) is None
    np.testing.assert_array_equal(found[0], labels.frames[0].sweep.world_from_sensor[:3, 3])
    ranges = np.linalg.norm(sweep.points_m - found, axis=1)
    assert np.median(ranges[np.isfinite(ranges)]) < 100


def test_kittis_velodyne(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 5.0, 6.0, 7.0
    labels = KittiLabels(tmp_path, {}, {}, {2: pose})
    sweep = LidarSweep({name: np.zeros(3) for name in "xyz"})
    np.testing.assert_array_equal(labels.lidar_origins(2, sweep), np.tile([5.0, 6.0, 7.0], (3, 1)))
    assert labels.lidar_origins(3, sweep) is None


def test_recordings_may_bring_their_own(tmp_path: Path) -> None:
    (tmp_path / "lidar").mkdir()
    columns = {name: np.arange(4.0) for name in ("x", "y", "z", "origin_x", "origin_y", "origin_z")}
    pq.write_table(pa.table(columns), tmp_path / "lidar" / "000000.parquet")
    labels = RecordingLabels(tmp_path)
    sweep = labels.lidar(0)
    np.testing.assert_array_equal(labels.lidar_origins(0, sweep), sweep.points_m)
    bare = LidarSweep({name: np.arange(4.0) for name in "xyz"})
    assert labels.lidar_origins(0, bare) is None


@pytest.mark.parametrize("dataset", ["waymo", "nuscenes", "pandaset"])
def test_drivestudio_data(tmp_path: Path, dataset: str) -> None:
    labels = drivestudio_labels(str(write_run(tmp_path, dataset=dataset).folder), {})
    sweep = labels.lidar(3)
    found = labels.lidar_origins(3, sweep)
    if dataset == "pandaset":
        assert found is None
    elif dataset == "waymo":
        np.testing.assert_array_equal(found[:, 0], sweep.columns["origin_x"])
    else:
        assert found.shape == (len(sweep), 3) and np.isfinite(found).all()


def test_waymos_roof_sensor(tmp_path: Path) -> None:
    (tmp_path / "ego_pose").mkdir()
    pose = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "ego_pose" / "000004.txt", pose)
    labels = StreetGaussiansLabels(tmp_path)
    sweep = LidarSweep({name: np.zeros(2) for name in "xyz"})
    forward, left, up = ROOF_SENSOR_M
    expected = [10 - left, 20 + forward, 30 + up]
    np.testing.assert_allclose(labels.lidar_origins(4, sweep), np.tile(expected, (2, 1)))
    assert labels.lidar_origins(5, sweep) is None
