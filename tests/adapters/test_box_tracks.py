"""Boxes joined into tracks, points moved along them, sweeps taken apart."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import kitti_files
import numpy as np
import nuscenes_files
import pandas as pd
import pandaset_folder
import pyarrow.parquet as pq
import pytest
import torch
from drivestudio_files import write_run
from recording_folder import write_recording

from adapters.drivestudio.adapter import drivestudio_labels
from adapters.kitti.adapter import KittiLabels
from adapters.lidar_scene.split import FLOOR_M, HALO_M, Motion, join_tracks, split_sweeps
from adapters.nuscenes.adapter import nuscenes_labels
from adapters.pandaset import PandaSetLabels
from adapters.procedural import StreetLabels
from adapters.raw_drive import BoxSample, Sweep
from adapters.recording.adapter import RecordingLabels
from adapters.street_gaussians.adapter import StreetGaussiansLabels
from augment.effects.lidar import ATTENUATED, LOST, MOVED, SCATTERED, UNCHANGED, drop_lost
from augment.effects.lidar.beam import intensity_column
from augment.errors import AdapterError
from augment.geometry import rigid, rotmat_from_quat
from augment.jobs.tables import lidar_bytes
from augment.labels import LidarSweep, StoresLidar
from augment.scene import Track
from augment.semantics import SemanticClass

MS = 1_000_000
SIZE = np.array([4.0, 2.0, 1.5])


def pose(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    quat = torch.tensor([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], dtype=torch.float64)
    return rigid(rotmat_from_quat(quat), torch.tensor([x, y, SIZE[2] / 2])).numpy()


def sample(name, frame, x, *, sibling=None, at_ms=None, yaw=0.0, y=0.0) -> BoxSample:
    time = (100 * frame if at_ms is None else at_ms) * MS
    return BoxSample(name, sibling, "Car", frame, time, pose(x, y, yaw), SIZE)


def test_siblings_become_one_sample_between_them():
    (track,) = join_tracks(
        [
            sample("a", 0, 0.0, sibling="b", at_ms=0),
            sample("b", 0, 0.4, sibling="a", at_ms=40),
            sample("a", 1, 1.0, sibling="b", at_ms=100),
            sample("b", 1, 1.4, sibling="a", at_ms=140),
        ]
    )
    assert track.track_id == "a"
    assert track.track.timestamps_ns.tolist() == [20 * MS, 120 * MS]
    np.testing.assert_allclose(track.track.world_from_actor[:, 0, 3], [0.2, 1.2])


def test_siblings_are_followed_through_a_change_of_name():
    # The forward sensor's box is renamed half way; the other sensor's box ties all three together.
    tracks = join_tracks(
        [
            sample("a", 0, 0, sibling="b"),
            sample("b", 0, 0, sibling="a"),
            sample("a", 1, 1, sibling="c"),
            sample("c", 1, 1, sibling="a"),
            sample("c", 2, 2, sibling="gone"),
            sample("other", 2, 9),
        ]
    )
    assert [t.track_id for t in tracks] == ["a", "other"]
    assert len(tracks[0].track.timestamps_ns) == 3


def test_headings_either_side_of_half_a_turn_are_averaged_the_short_way():
    (track,) = join_tracks(
        [
            sample("a", 0, 0, sibling="b", yaw=np.pi - 0.1),
            sample("b", 0, 0, sibling="a", yaw=-np.pi + 0.1, at_ms=1),
        ]
    )
    np.testing.assert_allclose(track.track.world_from_actor[0, 0, 0], -1, atol=1e-12)


def test_times_always_increase():
    # The second frame's box was seen no later than the first's: one of the two is kept.
    (track,) = join_tracks([sample("a", 0, 0.0, at_ms=50), sample("a", 1, 0.1, at_ms=50)])
    assert track.track.timestamps_ns.tolist() == [50 * MS]


def random_track(knots: int = 5) -> Track:
    rng = np.random.default_rng(3)
    quats = torch.from_numpy(rng.normal(size=(knots, 4)))
    times = torch.from_numpy(np.cumsum(rng.integers(20, 150, knots)) * MS)
    return Track(
        times, rigid(rotmat_from_quat(quats), torch.from_numpy(rng.normal(size=(knots, 3))))
    )


@pytest.mark.parametrize("knots", [1, 2, 5])
def test_motion_is_the_track(knots):
    track = random_track(knots)
    motion = Motion.of(track)
    first, last = int(track.timestamps_ns[0]), int(track.timestamps_ns[-1])
    times = np.linspace(first - 120 * MS, last + 120 * MS, 41).astype(np.int64)
    for time in [*times, *track.timestamps_ns.tolist()]:
        expected = track.pose_at(int(time))
        got = motion.pose_at(int(time))
        assert (expected is None) == (got is None) == (not motion.exists_at(np.array([time]))[0])
        if expected is not None:
            # Two routes through float64 quaternions.
            np.testing.assert_allclose(got, expected, atol=1e-9)


def test_points_go_into_the_actor_each_at_its_own_time():
    track = random_track()
    motion = Motion.of(track)
    local = np.random.default_rng(1).normal(size=(50, 3))
    first, last = int(track.timestamps_ns[0]), int(track.timestamps_ns[-1])
    times = np.linspace(first, last, 50).astype(np.int64)
    poses = [track.pose_at(int(t)).numpy() for t in times]
    world = np.stack([m[:3, :3] @ p + m[:3, 3] for m, p in zip(poses, local, strict=True)])
    np.testing.assert_allclose(motion.into_actor(world, times), local, atol=1e-9)


def sweep_of(points, times_ms, classes) -> Sweep:
    return Sweep(
        np.array(points, np.float32), np.array(times_ms, np.int64) * MS, np.array(classes, np.int16)
    )


def test_returns_follow_the_box_through_the_sweep():
    (track,) = join_tracks([sample("a", 0, 0.0), sample("a", 1, 10.0)])
    car = SemanticClass.VEHICLE
    # The same bumper seen at three moments, and a post where the car stood before.
    sweep = sweep_of(
        [[2.0, 0, 0.5], [7.0, 0, 0.5], [12.0, 0, 0.5], [0.0, 0, 0.5]],
        [0, 50, 100, 100],
        [car, car, car, SemanticClass.POLE],
    )
    world, (actor,) = split_sweeps([sweep], [track])
    np.testing.assert_allclose(actor.points, [[2.0, 0, 0.5 - SIZE[2] / 2]] * 3, atol=1e-6)
    np.testing.assert_allclose(world.points, [[0, 0, 0.5]])


def test_ground_in_a_box_is_ground_and_the_halo_is_nobodys():
    (track,) = join_tracks([sample("a", 0, 0.0), sample("a", 1, 0.5)])
    vehicle, road, unknown = SemanticClass.VEHICLE, SemanticClass.ROAD, SemanticClass.UNKNOWN
    side = SIZE[1] / 2
    sweep = sweep_of(
        [
            [0, 0, 0.02],  # road under the car
            [0, side + HALO_M / 2, 0.7],  # a stray return beside it
            [0, side + HALO_M * 1.1, 0.7],  # the world
            [0, 0, FLOOR_M / 2],  # of no class: tyre or road
            [0, side, 0.7],  # its side
        ],
        [0] * 5,
        [road, vehicle, vehicle, unknown, vehicle],
    )
    world, (actor,) = split_sweeps([sweep], [track])
    assert world.semantic.tolist() == [road, vehicle]
    assert len(actor) == 1


def test_returns_after_the_track_belong_to_the_world():
    (track,) = join_tracks([sample("a", 0, 0.0), sample("a", 1, 0.5)])
    sweep = sweep_of([[0.5, 0, 0.7]], [300], [SemanticClass.VEHICLE])
    world, (actor,) = split_sweeps([sweep], [track])
    assert len(world) == 1 and len(actor) == 0


CODES = np.array([UNCHANGED, UNCHANGED, ATTENUATED, LOST, MOVED, SCATTERED], np.uint8)
PANOPTIC = "panoptic/v1.0-mini/0_panoptic.npz"


def _pandaset(root: Path) -> PandaSetLabels:
    return PandaSetLabels(pandaset_folder.write_sequence(root, offset_m=np.array([9e4, -4e4, 30])))


def _nuscenes(root: Path):
    nuscenes_files.write_dataset(root)
    token = nuscenes_files.data_token(1, "LIDAR_TOP", 0)
    row = {"token": token, "sample_data_token": token, "filename": PANOPTIC}
    nuscenes_files.write_table(root, "panoptic", [row])
    labels = nuscenes_labels(str(root), {"scene": "scene-0002"})
    (root / PANOPTIC).parent.mkdir(parents=True)
    np.savez_compressed(root / PANOPTIC, data=np.arange(len(labels.lidar(0)), dtype=np.uint16))
    return labels


def _kitti(root: Path, velodyne_from_rectified: np.ndarray | None = None):
    drive = kitti_files.write_raw(root / "2011_09_26")
    pose = kitti_files.world_from_street() @ kitti_files.street_from_velo(0)
    (name,) = (p.relative_to(drive) for p in drive.glob("velodyne_points/data/*0.bin"))
    return KittiLabels(drive, {0: str(name)}, {0: 10**18}, {0: pose}, None, velodyne_from_rectified)


def _ours(root: Path) -> RecordingLabels:
    (root / "lidar").mkdir(parents=True)
    sweep = RecordingLabels(write_recording(root / "plain", frames=1)).lidar(0)
    columns = {**sweep.columns, "note": np.array(["a", "b"], object)[np.arange(len(sweep)) % 2]}
    columns["intensity"] = (np.arange(len(sweep)) % 256).astype(np.uint8)
    (root / "lidar/000000.parquet").write_bytes(lidar_bytes(LidarSweep(columns)))
    return RecordingLabels(root)


DATASETS: dict[str, Callable[[Path], StoresLidar]] = {
    "pandaset": _pandaset,
    "nuscenes": _nuscenes,
    "kitti": _kitti,
    "kitti-object": lambda root: _kitti(root, np.eye(4)),
    "recording": lambda root: RecordingLabels(write_recording(root, frames=1)),
    "recording-of-ours": _ours,
    "waymo": lambda root: drivestudio_labels(str(write_run(root, dataset="waymo").folder), {}),
    "drivestudio-nuscenes": lambda root: drivestudio_labels(
        str(write_run(root, dataset="nuscenes").folder), {}
    ),
}


def weathered(sweep: LidarSweep) -> LidarSweep:
    """All that can become of returns; those that moved by some metres."""
    codes = CODES[np.arange(len(sweep)) % len(CODES)]
    rng = np.random.default_rng(5)
    columns = {name: np.array(column) for name, column in sweep.columns.items()}
    moved = np.isin(codes, (MOVED, SCATTERED))
    for axis in "xyz":
        columns[axis] = np.where(moved, columns[axis] + rng.normal(0, 3, len(sweep)), columns[axis])
        columns[axis][codes == LOST] = np.nan
    name = intensity_column(sweep)
    if name is not None:
        values = columns[name] * np.where(codes == UNCHANGED, 1, 0.5)
        columns[name] = values.astype(sweep.columns[name].dtype)
    index = np.arange(len(sweep), dtype=np.int32)
    return LidarSweep({**columns, "source_index": index, "weather_code": codes})


@pytest.mark.parametrize("dataset", DATASETS)
def test_files_give_back_the_weathered_sweep(dataset: str, tmp_path: Path) -> None:
    labels = DATASETS[dataset](tmp_path / "data")
    assert isinstance(labels, StoresLidar)
    source = labels.lidar(0)
    wanted = drop_lost(weathered(source))
    assert 0.8 < len(wanted) / len(source) < 0.9
    files = labels.lidar_files(0)
    contents = [labels.lidar_content(0, file, wanted) for file in files]
    assert contents == [labels.lidar_content(0, file, wanted) for file in files]  # every time
    for file, content in zip(files, contents, strict=True):
        file.write_bytes(content)
    read = labels.lidar(0)
    assert {k: v.dtype for k, v in read.columns.items()} == {
        k: v.dtype for k, v in source.columns.items()
    }
    moved = np.isin(wanted.columns["weather_code"], (MOVED, SCATTERED))
    np.testing.assert_array_equal(read.points_m[~moved], wanted.points_m[~moved])
    np.testing.assert_allclose(read.points_m, wanted.points_m, rtol=0, atol=1e-5)
    told = "timestamp_ns" if dataset == "nuscenes" else ""  # by the bearing, of those that moved
    for name in source.columns.keys() - {"x", "y", "z", told}:
        np.testing.assert_array_equal(read.columns[name], wanted.columns[name], err_msg=name)
    assert labels.lidar_files(99) == ()


def test_pandas_opens_the_tables_and_their_rows_still_name_each_other(tmp_path: Path) -> None:
    labels = _pandaset(tmp_path)
    before = [pd.read_pickle(file) for file in labels.lidar_files(0)]
    wanted = drop_lost(weathered(labels.lidar(0)))
    for file, old in zip(labels.lidar_files(0), before, strict=True):
        file.write_bytes(labels.lidar_content(0, file, wanted))
        new = pd.read_pickle(file)
        np.testing.assert_array_equal(new.index, old.index[wanted.columns["source_index"]])
        assert list(new.columns) == list(old.columns) and new.dtypes.equals(old.dtypes)
        assert new.columns.dtype == object  # as all versions of pandas read them
    assert set(labels.lidar(0).columns["d"]) == {0, 1}


def test_labels_of_nuscenes_returns_stay_with_their_returns(tmp_path: Path) -> None:
    labels = _nuscenes(tmp_path)
    wanted = drop_lost(weathered(labels.lidar(0)))
    names = [file.parts[len(tmp_path.parts)] for file in labels.lidar_files(0)]
    assert names == ["samples", "lidarseg", "panoptic"]
    panoptic = labels.lidar_files(0)[2]
    content = labels.lidar_content(0, panoptic, wanted)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:  # no time of day: the same bytes again
        assert archive.getinfo("data.npy").date_time == (1980, 1, 1, 0, 0, 0)
    panoptic.write_bytes(content)
    with np.load(panoptic) as archive:
        assert archive["data"].dtype == np.uint16
        np.testing.assert_array_equal(archive["data"], wanted.columns["source_index"])
    panoptic.write_bytes(b"PK no archive")
    with pytest.raises(AdapterError, match=r"0_panoptic\.npz must hold an array `data`"):
        labels.lidar_content(0, panoptic, wanted)
    classes = labels.lidar_files(0)[1]
    classes.write_bytes(b"abc")
    with pytest.raises(AdapterError, match=r"_lidarseg\.bin has 3 classes, fewer than samples/"):
        labels.lidar_content(0, classes, wanted)
    (between,) = labels.lidar_files(1)  # no keyframe has none of them
    assert between.relative_to(tmp_path).parts[0] == "sweeps"


def test_a_recordings_file_keeps_its_notes(tmp_path: Path) -> None:
    labels = _ours(tmp_path)
    (file,) = labels.lidar_files(0)
    schema = pq.read_schema(file)
    file.write_bytes(labels.lidar_content(0, file, drop_lost(weathered(labels.lidar(0)))))
    assert pq.read_schema(file).equals(schema, check_metadata=True)


def test_sweeps_without_files_of_their_own_cannot_be_stored(tmp_path: Path) -> None:
    assert not isinstance(StreetGaussiansLabels(tmp_path), StoresLidar)
    assert not issubclass(StreetLabels, StoresLidar)
