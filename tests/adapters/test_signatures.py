"""Scenes told apart by a few names: each kind, files and folders, and what is said of others."""

from __future__ import annotations

from pathlib import Path

import pytest

from adapters.base import recognise
from adapters.detect_format import FILES, FOLDERS, looked_for, recognised
from augment.errors import AdapterError

MULTI_PART = b"ply\nformat binary_little_endian 1.0\nelement vertex_background 1\n"
PLAIN = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
TREES = {
    "pandaset": ["camera/", "lidar/"],
    "nuscenes": ["samples/", "v1.0-mini/scene.json"],
    "street_gaussians": ["ego_pose/", "extrinsics/", "track/", "images/"],
    "drivestudio": ["config.yaml", "checkpoint_final.pth"],
    "kitti": ["calib/", "image_2/", "label_2/", "velodyne/"],
    "recording": ["calibration.json", "images/"],
    "gaussians": ["point_cloud/iteration_7/point_cloud.ply"],
}
OTHERS = {
    "street_gaussians": ["trained_model/iteration_30000.pth", "configs/"],
    "kitti": ["training/calib/", "training/image_2/"],
}


def grow(root: Path, names: list[str], data: bytes = PLAIN) -> Path:
    for name in names:
        path = root / name
        (path if name.endswith("/") else path.parent).mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            path.write_bytes(data)
    return root


@pytest.mark.parametrize("scheme", TREES)
def test_folders_are_recognised(tmp_path, scheme):
    assert recognised(grow(tmp_path / "a", TREES[scheme])) == scheme
    if scheme in OTHERS:
        assert recognised(grow(tmp_path / "b", OTHERS[scheme])) == scheme


def test_a_drive_of_kitti_has_its_calibration_in_it_or_above(tmp_path):
    drive = grow(tmp_path / "2011_09_26" / "drive", ["velodyne_points/", "image_02/"])
    assert recognised(drive) is None
    grow(drive.parent, ["calib_cam_to_cam.txt"])
    assert recognised(drive) == "kitti"
    assert recognised(grow(tmp_path / "x", ["velodyne_points/", "calib_cam_to_cam.txt"])) == "kitti"


def test_a_model_in_several_parts_is_no_plain_splat_file(tmp_path):
    name = "point_cloud/iteration_7/point_cloud.ply"
    assert recognised(grow(tmp_path / "many", [name], MULTI_PART)) == "street_gaussians"
    assert recognised(tmp_path / "many" / name) == "street_gaussians"
    assert recognised(grow(tmp_path / "one", [name]) / name) == "gaussians"


def test_files_are_recognised(tmp_path):
    grow(
        tmp_path,
        ["iteration_7.pth", "checkpoint_final.pth", "a.climategs", "a.splat", "a.pth"],
        b"x",
    )
    found = {path.name: recognised(path) for path in sorted(tmp_path.iterdir())}
    assert found == {
        "a.climategs": "scene",
        "a.pth": None,
        "a.splat": "gaussians",
        "checkpoint_final.pth": "drivestudio",
        "iteration_7.pth": "street_gaussians",
    }


def test_what_is_not_known_is_answered_with_what_was_looked_for(tmp_path):
    grow(tmp_path / "set" / "seq", TREES["nuscenes"])
    with pytest.raises(AdapterError) as caught:
        recognise(tmp_path / "set")
    for signature in FOLDERS:
        assert signature.what in str(caught.value)
    assert f"give one, such as {tmp_path}/set/seq. Or name the scheme" in str(caught.value)
    (tmp_path / "a.txt").write_text("hello")
    assert all(signature.what in looked_for(tmp_path / "a.txt") for signature in FILES)
