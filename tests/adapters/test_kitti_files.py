"""KITTI's files one by one: calibration, times, poses, tracklets, labels, and what is wrong."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import kitti_files as street
import numpy as np
import pytest
import torch

from adapters.kitti import adapter as tracklets
from adapters.kitti.adapter import boxes_at, find_source, kitti_labels, open_kitti
from adapters.kitti.files import kitti_root, oxts_poses, registered_poses
from augment.errors import AdapterError
from augment.geometry import rotmat_from_quat


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return street.write_raw(tmp_path_factory.mktemp("kitti") / "2011_09_26")


@pytest.fixture
def drive(original, tmp_path) -> Path:
    return Path(shutil.copytree(original.parent, tmp_path / "day")) / original.name


@pytest.fixture(scope="module")
def original_objects(tmp_path_factory) -> Path:
    return street.write_object(tmp_path_factory.mktemp("object"), numbers=(1, 7, 9, 12))


@pytest.fixture
def objects(original_objects, tmp_path) -> Path:
    return Path(shutil.copytree(original_objects, tmp_path / "object"))


def problems_of(path: Path, **query: str) -> str:
    return "\n".join(find_source(str(path), query)[0].problems)


def poses_of(path: Path, **query: str):
    return find_source(str(path), query)[0].labels.world_from_velodyne


def replace(path: Path, pattern: str, text: str) -> None:
    before = path.read_text()
    after = re.sub(pattern, text, before, flags=re.MULTILINE)
    assert after != before
    path.write_text(after)


# Where things are


def test_the_root_of_a_drive_and_of_an_object_folder(drive, objects, tmp_path):
    assert kitti_root(str(drive)) == (drive, drive.parent)
    for path in drive.parent.glob("calib_*.txt"):
        shutil.move(path, drive)
    assert kitti_root(drive) == (drive, drive)
    assert kitti_root(objects) == (objects, objects / "calib")
    (tmp_path / "benchmark").mkdir()
    shutil.move(objects, tmp_path / "benchmark/training")
    training = tmp_path / "benchmark/training"
    assert kitti_root(tmp_path / "benchmark") == (training, training / "calib")


def test_a_relative_path_finds_the_calibration_above(drive, monkeypatch):
    monkeypatch.chdir(drive)
    assert kitti_root(".") == (Path("."), drive.parent)
    assert find_source(".", {})[0].name == drive.name


def test_folders_that_are_no_drive(drive, tmp_path):
    with pytest.raises(AdapterError, match=rf"holds drives, .*; give one: .*{drive.name}$"):
        kitti_root(drive.parent)
    with pytest.raises(
        AdapterError, match=rf"expected velodyne_points/.*; {drive}, above it, is one$"
    ):
        kitti_root(drive / "oxts")
    with pytest.raises(AdapterError, match="is not a folder"):
        kitti_root(tmp_path / "nowhere")
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(AdapterError, match=r"no calib_cam_to_cam\.txt in it or in .*calib\.zip"):
        kitti_root(drive)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ({"voxels": "1"}, r"unknown option 'voxels'.*poses: icp"),
        ({"frame": "1"}, r"frame= means nothing for a raw drive"),
        ({"poses": ""}, r"poses must be icp, or a file"),
        ({"frames": "7:9"}, r"frames=7:9 selects none of the 3 frames"),
    ],
)
def test_wrong_options_of_a_drive(original, query, message):
    with pytest.raises(AdapterError, match=message):
        find_source(str(original), query)


@pytest.mark.parametrize(
    "name",
    [
        "image_02/data/0000000001.png",
        "velodyne_points/data/0000000001.bin",
        "oxts/data/0000000001.txt",
        "velodyne_points/timestamps.txt",
        "tracklet_labels.xml",
    ],
)
def test_links_out_of_the_drive_are_refused(drive, tmp_path, name):
    secret = tmp_path / "secret"
    shutil.move(drive / name, secret)
    (drive / name).symlink_to(secret)
    if "data" in name and "image" not in name:  # a single frame's, which goes on without
        scene = open_kitti(str(drive), {"voxel_m": "1", "sky_size": "8"})
        (problem,) = (p for p in scene.problems if "leads through a link" in p)
        assert problem.startswith("frame 1") and scene.lidar(1) is None
    else:
        with pytest.raises(AdapterError, match="leads through a link"):
            open_kitti(str(drive), {"voxel_m": "1", "sky_size": "8"})


def test_a_linked_folder_of_images_is_followed(drive, tmp_path):
    shutil.move(drive / "image_02", tmp_path / "disk")
    (drive / "image_02").symlink_to(tmp_path / "disk")
    assert set(find_source(str(drive), {})[0].images["image_02"]) == {0, 1, 2}


# Calibration


@pytest.mark.parametrize(
    ("file", "pattern", "text", "message"),
    [
        ("cam_to_cam", "^P_rect_02:.*", "", r"calib_cam_to_cam\.txt has no 'P_rect_02'"),
        ("cam_to_cam", "^R_rect_00:.*", "", r"calib_cam_to_cam\.txt has no 'R_rect_00'"),
        ("cam_to_cam", "^(P_rect_02: \\S+).*", r"\1", r"P_rect_02 must hold 3 x 4 numbers.* 1$"),
        ("cam_to_cam", "^P_rect_02: \\S+", "P_rect_02: nan", r"P_rect_02 holds NaN or infinite"),
        ("cam_to_cam", "^P_rect_02: \\S+", "P_rect_02: wide", r"P_rect_02 must hold numbers"),
        ("cam_to_cam", "^P_rect_02: \\S+", "P_rect_02: -90", r"must be a rectified pinhole"),
        ("cam_to_cam", "^R_rect_00: \\S+", "R_rect_00: 2", r"R_rect_00 must be a rotation"),
        ("cam_to_cam", "^S_rect_02:.*", "S_rect_02: 160 7.5", r"S_rect_02 must be a width and"),
        ("cam_to_cam", "^(P_rect_02:.*)", r"\1\n\1", r"line 11: 'P_rect_02' is there twice"),
        ("cam_to_cam", "^corner_dist:", "corner dist", r"line 2: expected `key: numbers`"),
        ("velo_to_cam", "^T:.*", "", r"calib_velo_to_cam\.txt has no 'T'"),
        ("velo_to_cam", "^T:.*", "T: 0 0", r"T must hold 3 numbers; it holds 2"),
        ("imu_to_velo", "^R:.*", "R: " + "0 " * 9, r"R and T must be a rotation"),
    ],
)
def test_wrong_calibration(drive, file, pattern, text, message):
    replace(drive.parent / f"calib_{file}.txt", pattern, text)
    with pytest.raises(AdapterError, match=message):
        find_source(str(drive), {})


def test_missing_calibration_files(drive):
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    with pytest.raises(AdapterError, match=r"calib_imu_to_velo\.txt does not exist"):
        find_source(str(drive), {})
    assert len(poses_of(drive, poses="icp")) == 3  # only GPS/IMU poses need it
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(AdapterError, match=r"calib_velo_to_cam\.txt does not exist"):
        find_source(str(drive), {"poses": "icp"})


# Times


def test_times_are_exact_and_their_gaps_are_said(drive):
    path = drive / "velodyne_points/timestamps.txt"
    path.write_text("2011-09-26 13:02:25.964389445\n\n2011-09-26 13:02:26.17\n")
    source = find_source(str(drive), {})[0]
    start = street.START_NS + 964_389_445
    assert source.labels.timestamps_ns == {
        0: start,
        1: start + 100_000_000,
        2: street.START_NS + 1_170_000_000,
    }
    (problem,) = source.problems
    assert "timestamps.txt has no line for 1 frame (1); ten frames a second" in problem


def test_without_times_ten_frames_a_second_are_assumed(drive):
    for path in drive.glob("*/timestamps.txt"):
        path.unlink()
    source = find_source(str(drive), {})[0]
    assert source.labels.timestamps_ns == {0: 0, 1: 100_000_000, 2: 200_000_000}
    assert "its timestamps.txt has no times for 3 frames (0, 1, 2)" in "".join(source.problems)


def test_the_cameras_times_serve_where_the_velodyne_has_none(drive):
    (drive / "velodyne_points/timestamps.txt").unlink()
    source = find_source(str(drive), {})[0]
    assert source.labels.timestamps_ns[1] - street.START_NS == 103_000_001
    assert source.problems == ()


@pytest.mark.parametrize("line", ["2011-13-26 13:02:25", "1", "9999-01-01 00:00:00"])
def test_lines_that_are_no_time(drive, line):
    path = drive / "image_03/timestamps.txt"
    path.write_text(f"2011-09-26 13:02:25.9\n{line}\n")
    with pytest.raises(AdapterError, match=r"image_03/timestamps\.txt, line 2: expected a time"):
        find_source(str(drive), {})


def test_times_that_do_not_increase(drive):
    path = drive / "velodyne_points/timestamps.txt"
    path.write_text("\n".join(reversed(path.read_text().splitlines())))
    with pytest.raises(AdapterError, match=r"frame 1 was not taken after frame 0"):
        find_source(str(drive), {})


# Poses


def relative(poses) -> np.ndarray:
    return np.stack([np.linalg.inv(poses[0]) @ poses[n] for n in sorted(poses)])


def test_roll_pitch_and_yaw_are_turns_about_x_then_y_then_z(drive):
    street.write_oxts(drive, 1, roll=0.1, pitch=-0.2, yaw=1.1)
    poses = oxts_poses(drive, {1: "oxts/data/0000000001.txt"}, np.eye(4)).world_from_velodyne
    expected = street.turn(2, 1.1) @ street.turn(1, -0.2) @ street.turn(0, 0.1)
    np.testing.assert_allclose(poses[1][:3, :3], expected, atol=1e-12)
    # Positive pitch is front down, positive roll left side up.
    down = street.turn(1, 0.1) @ [1, 0, 0]
    left = street.turn(0, 0.1) @ [0, 1, 0]
    assert down[2] < 0 < left[2]


def test_poses_do_not_depend_on_the_frames_chosen(drive):
    every, some = poses_of(drive), poses_of(drive, frames="1:2")
    np.testing.assert_array_equal(every[1], some[1])
    chosen = find_source(str(drive), {"frames": "1:2"})[0]
    np.testing.assert_array_equal(
        chosen.world_origin_m, find_source(str(drive), {})[0].world_origin_m
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("49 8 112", "must hold 30 numbers; it holds 3"),
        ("49 8 112 0 0 zero" + " 0" * 24, "must hold numbers only"),
        ("49 8 112 0 0 inf" + " 0" * 24, "holds NaN or infinite"),
        ("95 8 112 0 0 0" + " 0" * 24, "must begin with latitude"),
    ],
)
def test_a_damaged_pose_costs_its_frame(drive, content, message):
    (drive / "oxts/data/0000000000.txt").write_text(content)
    source = find_source(str(drive), {})[0]
    assert source.chosen.numbers == (1, 2) and message in source.problems[0]
    for path in (drive / "oxts/data").iterdir():
        path.write_text(content)
    with pytest.raises(AdapterError, match=rf"no file can be used: frame 0.*{message[:20]}"):
        find_source(str(drive), {})


def test_a_file_of_poses_gives_the_same_motion(drive, tmp_path):
    street.write_odometry(tmp_path / "poses.txt", 3)
    poses = poses_of(drive, poses=str(tmp_path / "poses.txt"))
    np.testing.assert_allclose(relative(poses), relative(poses_of(drive)), atol=1e-6)
    # Its world is camera 0's turned to z up: the car drives along x, and the origin is the camera.
    assert poses[2][0, 3] - poses[0][0, 3] == pytest.approx(1.6, abs=1e-3)
    centre = poses[0] @ np.linalg.inv(street.R_RECT @ street.VELO_TO_CAM)
    np.testing.assert_allclose(centre[:3, 3], 0, atol=1e-6)
    shutil.rmtree(drive / "oxts")
    again = poses_of(drive, poses=str(tmp_path / "poses.txt"), frames="1:")
    np.testing.assert_array_equal(again[2], poses[2])


def test_poses_go_by_number_unless_there_are_as_many_as_frames(drive, tmp_path):
    street.write_odometry(tmp_path / "poses.txt", 2)
    source = find_source(str(drive), {"poses": str(tmp_path / "poses.txt")})[0]
    assert source.chosen.numbers == (0, 1)
    assert source.problems == ("left out 1 frame (2): no pose is known",)
    for folder in ("image_02", "image_03", "velodyne_points"):
        for path in sorted((drive / folder / "data").iterdir(), reverse=True):
            path.rename(path.with_stem(f"{int(path.stem) + 40:010d}"))
    with pytest.raises(AdapterError, match=r"has 2 poses, none of them of frames 40 to 42"):
        find_source(str(drive), {"poses": str(tmp_path / "poses.txt")})
    street.write_odometry(tmp_path / "poses.txt", 3)
    assert set(poses_of(drive, poses=str(tmp_path / "poses.txt"))) == {40, 41, 42}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", "line 2 must hold 3 x 4 numbers; it holds 11"),
        ("1 0 0 0 0 1 0 0 0 0 1 x", "line 2 must hold numbers only"),
        ("2 0 0 0 0 1 0 0 0 0 1 0", "line 2 must be a rotation"),
    ],
)
def test_lines_that_are_no_pose(drive, tmp_path, line, message):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" + line)
    with pytest.raises(AdapterError, match=message):
        find_source(str(drive), {"poses": str(path)})


def test_a_file_of_poses_that_is_missing(drive):
    with pytest.raises(AdapterError, match=r"poses must be icp or a file .* got 'ipc', .*/ipc$"):
        find_source(str(drive), {"poses": "ipc"})


def test_registration_finds_the_motion(drive):
    source = find_source(str(drive), {"poses": "icp"})[0]
    found = relative(source.labels.world_from_velodyne)
    # Made of other points every frame, and with a car in it that drives away.
    np.testing.assert_allclose(found, relative(poses_of(drive)), atol=0.03)
    assert "registering 3 sweeps" in source.problems[0] and "inlier RMSE 0.0" in source.problems[0]
    again = find_source(str(drive), {"poses": "icp"})[0].labels.world_from_velodyne
    for number in range(3):
        np.testing.assert_array_equal(source.labels.world_from_velodyne[number], again[number])


def test_registration_recovers_turns_and_long_steps():
    points = street.points_at(0)
    points = points[points[:, 0] > 2]
    truth = street.rigid(street.turn(2, 0.03) @ street.turn(1, 0.01), [2.5, -0.1, 0.05])
    moved = (street.points_at(3)[:, :3] - truth[:3, 3]) @ truth[:3, :3]
    sweeps = {4: points, 5: moved}
    found = registered_poses([4, 5], sweeps.get).world_from_velodyne
    np.testing.assert_allclose(found[5], truth, atol=0.03)


def test_registration_goes_on_without_a_sweep_but_not_without_surfaces(drive):
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    source = find_source(str(drive), {"poses": "icp"})[0]
    assert source.chosen.numbers == (0, 2)
    assert "left out 1 frame (1): no pose is known" in source.problems
    np.zeros((500, 4), "<f4").tofile(drive / "velodyne_points/data/0000000002.bin")
    with pytest.raises(AdapterError, match=r"the sweep of frame 2 has too few surfaces"):
        find_source(str(drive), {"poses": "icp"})


def test_without_poses_a_single_frame_still_opens(drive):
    shutil.rmtree(drive / "oxts")
    with pytest.raises(AdapterError, match=r"for 3 frames \(0, 1, 2\).*poses=FILE.*icp.*frames="):
        find_source(str(drive), {})
    scene = open_kitti(str(drive), {"frames": "1:2", "voxel_m": "1", "sky_size": "8"})
    assert [frame.index for frame in scene.frames] == [1]
    assert torch.equal(scene.frame(1).world_from_ego, torch.eye(4, dtype=torch.float64))


# Folders copied by half


def test_sweeps_or_images_alone(drive):
    for path in (drive / "velodyne_points/data").iterdir():
        path.rename(path.with_suffix(".txt"))
    with pytest.raises(AdapterError, match=r"velodyne_points/data holds no sweep"):
        find_source(str(drive), {})
    shutil.rmtree(drive / "image_02")
    shutil.rmtree(drive / "image_03")
    for path in (drive / "velodyne_points/data").iterdir():
        path.rename(path.with_suffix(".bin"))
    with pytest.raises(AdapterError, match=r"holds no images: expected image_02/data/"):
        find_source(str(drive), {})


def test_sweeps_without_images_and_images_without_sweeps_are_said(drive):
    (drive / "velodyne_points/data/0000000000.bin").unlink()
    for camera in ("image_02", "image_03"):
        (drive / camera / "data/0000000002.png").unlink()
    (drive / "tracklet_labels.xml").unlink()
    scene = open_kitti(str(drive), {"voxel_m": "0.5", "sky_size": "8"})
    text = "\n".join(scene.problems)
    assert "has no tracklet_labels.xml: no boxes are known" in text
    assert "camera image_02: 1 frame (2) without an image" in text
    assert "camera image_03: 1 frame (2) without an image" in text
    assert "1 frame (0) without a sweep" in text and len(scene.problems) == 4
    with pytest.raises(AdapterError, match=r"there are no returns in 1 frame \(0\)"):
        open_kitti(str(drive), {"frames": "0:1"})
    with pytest.raises(
        AdapterError, match=r"image_02: none of its images is usable.*1 frame \(2\)"
    ):
        open_kitti(str(drive), {"frames": "2:3"})


def test_an_empty_camera_folder_is_said(drive):
    shutil.rmtree(drive / "image_03/data")
    source = find_source(str(drive), {})[0]
    assert set(source.images) == {"image_02"}
    assert "camera image_03: " in source.problems[0] and "holds no image" in source.problems[0]


# Tracklets


def test_a_box_stands_on_its_position_and_turns(drive):
    tracklet = street.Tracklet(5, ((1.0, 2, 3, 0, 0, 0.5), (1, 2, 3, 0.1, 0.2, 0.5)), "Van")
    street.write_tracklets(drive, [tracklet])
    (found,) = find_source(str(drive), {})[0].labels.tracklets
    assert (found.label, found.first_frame, len(found.poses)) == ("Van", 5, 2)
    boxes = boxes_at((found,), 5, np.eye(4))
    np.testing.assert_allclose(boxes.centers_m, [[1, 2, 3.75]])
    turned = boxes_at((found,), 6, np.eye(4))
    rotation = street.turn(2, 0.5) @ street.turn(1, 0.2) @ street.turn(0, 0.1)
    found_rotation = rotmat_from_quat(torch.from_numpy(turned.quats[0])).numpy()
    np.testing.assert_allclose(found_rotation, rotation, atol=1e-7)
    np.testing.assert_allclose(turned.centers_m[0], [1, 2, 3] + rotation[:, 2] * 0.75)
    assert len(boxes_at((found,), 7, np.eye(4))) == len(boxes_at((found,), 4, np.eye(4))) == 0


GOOD = street.tracklets_xml([street.Tracklet(0, ((9.0, 0, -1, 0, 0, 0),))])


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (GOOD.replace("boost_serialization>\n<boost", 'x SYSTEM "file:///etc/passwd">\n<boost'),
         "declares a document type"),
        (GOOD.replace("<!DOCTYPE boost_serialization>",
                      '<!DOCTYPE boost_serialization [<!ENTITY a "&b;"><!ENTITY b "c">]>'),
         "declares a document type"),
        (GOOD.replace("Car", "&evil;"), "is not whole XML"),
        (GOOD[:-60], "is not whole XML"),
        ("", "is not whole XML"),
        ("<a/>", "has no <tracklets>"),
        (GOOD.replace("<objectType>", "<a>" * 20 + "</a>" * 20 + "<objectType>"), "nested deeper"),
        (GOOD.replace("<tx>9", "<tx>nan"), r"tracklet 0: <tx> must hold a finite number; got 'nan"),
        (GOOD.replace("<tx>9", "<tx>wide"), "<tx> must hold a finite number"),
        (re.sub("<rz>.*?</rz>", "", GOOD), "<rz> must hold a finite number; got None"),
        (re.sub("<h>.*?</h>", "<h>0</h>", GOOD), "l, w, h must be metres > 0"),
        (GOOD.replace("<first_frame>0", "<first_frame>0.5"), "first_frame must be a frame's"),
        (GOOD.replace("<first_frame>0", "<first_frame>-3"), "first_frame must be a frame's"),
        (GOOD.replace("<state>2", "<state>so"), "<state> must hold a finite number"),
    ],
)  # fmt: skip
def test_wrong_or_hostile_tracklets(drive, xml, message):
    (drive / "tracklet_labels.xml").write_text(xml)
    with pytest.raises(AdapterError, match=message):
        kitti_labels(str(drive), {})


def test_tracklets_in_another_encoding_hide_nothing(drive):
    text = GOOD.replace("UTF-8", "UTF-16")
    (drive / "tracklet_labels.xml").write_bytes(text.encode("utf-16"))
    with pytest.raises(AdapterError, match="cannot be read as text"):
        kitti_labels(str(drive), {})
    (drive / "tracklet_labels.xml").write_bytes(text.encode("utf-16-le"))
    with pytest.raises(AdapterError, match="is not UTF-8"):
        kitti_labels(str(drive), {})


def test_tracklets_of_no_drives_size_are_refused(drive, monkeypatch):
    monkeypatch.setattr(tracklets, "_MAX_ELEMENTS", 20)
    with pytest.raises(AdapterError, match="more than 20 of them"):
        kitti_labels(str(drive), {})
    monkeypatch.setattr(tracklets, "_MAX_BYTES", 1000)
    with pytest.raises(AdapterError, match="is larger than"):
        kitti_labels(str(drive), {})


def test_no_tracklets_in_the_file_are_no_boxes(drive):
    street.write_tracklets(drive, [])
    labels = kitti_labels(str(drive), {})
    assert len(labels.boxes(0)) == 0 and problems_of(drive) == ""


# The object benchmark


def test_which_object_frame(objects):
    examples = r"\(000001, 000007, 000009, \.\.\.\)"
    with pytest.raises(AdapterError, match=rf"4 unrelated frames {examples}.*frame=000001"):
        find_source(str(objects), {})
    with pytest.raises(AdapterError, match=r"has no frame 000003; it has 4: 000001"):
        find_source(str(objects), {"frame": "3"})
    with pytest.raises(AdapterError, match=r"frame must be a frame's number.*got '-1'"):
        find_source(str(objects), {"frame": "-1"})
    with pytest.raises(AdapterError, match=r"poses= means nothing for an object folder"):
        find_source(str(objects), {"frame": "1", "poses": "icp"})
    assert find_source(str(objects), {"frame": "12"})[0].name == "000012"
    with pytest.raises(AdapterError, match=r"holds out all 1 frames"):
        find_source(str(objects), {"frame": "1", "held_out": "0::1"})


def test_the_only_object_frame_needs_no_name(tmp_path):
    root = street.write_object(tmp_path / "one", numbers=(5,))
    assert find_source(str(root), {})[0].name == "000005"
    (root / "velodyne/000005.bin").unlink()
    with pytest.raises(AdapterError, match=r"velodyne/000005\.bin does not exist"):
        find_source(str(root), {})
    (root / "image_2/000005.png").unlink()
    with pytest.raises(AdapterError, match=r"holds neither velodyne/"):
        find_source(str(root), {})


def test_an_object_frame_without_image_calibration_or_labels(objects):
    (objects / "label_2/000001.txt").unlink()
    assert "000001.txt does not exist: no boxes" in problems_of(objects, frame="1")
    assert len(kitti_labels(str(objects), {"frame": "1"}).boxes(1)) == 0
    (objects / "calib/000007.txt").unlink()
    with pytest.raises(AdapterError, match=r"calib/000007\.txt does not exist"):
        find_source(str(objects), {"frame": "7"})
    (objects / "image_2/000009.png").unlink()
    with pytest.raises(AdapterError, match=r"image_2/000009\.png does not exist"):
        find_source(str(objects), {"frame": "9"})
    replace(objects / "calib/000012.txt", "^Tr_velo_to_cam", "Tr_velo_cam")
    with pytest.raises(AdapterError, match=r"000012\.txt has no 'Tr_velo_to_cam'; it has P0"):
        find_source(str(objects), {"frame": "12"})


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0 0 0 1 2 3 4 1.5 1.6 3.9 1 1 9", "line 1: expected a type and 14 numbers.*14 words"),
        ("Car 0 0 0 1 2 3 4 1.5 1.6 3.9 1 1 9 x", "line 1 must hold numbers only"),
        ("Car 0 0 0 1 2 3 4 1.5 1.6 3.9 1 1 nan 0", "line 1 holds NaN"),
        ("Car 0 0 0 1 2 3 4 1.5 -1 3.9 1 1 9 0", "line 1: h, w, l must be metres > 0"),
    ],
)
def test_wrong_object_lines(objects, line, message):
    (objects / "label_2/000001.txt").write_text(line + "\n")
    with pytest.raises(AdapterError, match=message):
        find_source(str(objects), {"frame": "1"})


def test_scores_and_empty_label_files(objects):
    car, _, van = street.object_lines(1)
    (objects / "label_2/000001.txt").write_text(f"{car} 0.75\n\n{van}\n")
    boxes = kitti_labels(str(objects), {"frame": "1"}).boxes(1)
    np.testing.assert_array_equal(boxes.attributes["score"], [0.75, np.nan])
    assert boxes.track_ids == ("0", "2")
    (objects / "label_2/000001.txt").write_text("")
    assert len(kitti_labels(str(objects), {"frame": "1"}).boxes(1)) == 0
