"""What of drivestudio's files is refused, and what is gone on without and said."""

from __future__ import annotations

import json
import os
from collections import OrderedDict
from pathlib import Path

import drivestudio_files as files
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.detect_format import recognised
from adapters.drivestudio.adapter import drivestudio_labels, open_drivestudio
from adapters.drivestudio.drive import CONVENTIONS
from augment.errors import AdapterError
from augment.sky import ConstantSky


@pytest.fixture
def numbers(tmp_path):
    return files.write_run(tmp_path)


def opened(numbers, **query):
    return open_drivestudio(str(numbers.folder), query)


def change_checkpoint(numbers, change) -> None:
    path = numbers.folder / "checkpoint_final.pth"
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)


def refused(numbers, message: str, **query) -> str:
    with pytest.raises(AdapterError, match=message) as caught:
        opened(numbers, **query)
    return str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("data.dataset", "mars", "axes of 'mars' are not known.*waymo, nuscenes, pandaset, argov"),
        ("data.dataset", None, "data.dataset: Field required"),
        ("data.dataset", 3, "data.dataset: Input should be a valid string .got 3"),
        ("data.data_root", "${root}/x", r"data.data_root is '\$\{root\}/x', which refers"),
        ("data.pixel_source.cameras", ["${cam}"], r"data.pixel_source.cameras is '\$\{cam\}'"),
        ("data.start_timestep", 1.5, "data.start_timestep: Input should be a valid integer"),
        ("data.start_timestep", 6, "frames data.start_timestep 6 to data.end_timestep 5 .* none"),
        ("data.pixel_source.cameras", [0, 5], r"camera numbers, 0 to 4, each once; got \[0, 5\]"),
        ("data.pixel_source.cameras", [0, 0, 1], "each once"),
        ("data.pixel_source.cameras", [], "data.pixel_source.cameras: List should have at least 1"),
        ("data.pixel_source.cameras", [True, 2], "cameras.0: Input should be a valid integer"),
        ("data.pixel_source.downscale_when_loading", [2, 2], "factor > 0 for each of the 3"),
        ("data.pixel_source.downscale_when_loading", [2, 0, 2], "loading.1: .*greater than 0"),
        ("data.pixel_source.downscale_when_loading", [2000, 2, 2], "leaves no pixel of 1920x1280"),
        ("data.pixel_source.test_image_stride", -1, "greater than or equal to 0 .got -1"),
        ("data.data_root", "/nowhere", r"/nowhere/007 of its config.yaml is not here.*data=DIR"),
        ("data.scene_idx", None, "does not say where the data is.*data=DIR"),
    ],
)
def test_a_config_that_cannot_be_used_is_refused(numbers, key, value, message):
    files.write_config(numbers.folder, numbers.data.parent, "waymo", {key: value})
    assert "config.yaml" in refused(numbers, message)


def test_options_that_cannot_be_used_are_refused(numbers):
    refused(numbers, "unknown option 'nodes'; .* data: .*; checkpoint: .*; frames:", nodes="1")
    refused(numbers, "frames must be first:stop", frames="3")
    refused(numbers, "frames must be first:stop", frames="4:2")
    refused(numbers, "frames=7: selects none of the 5 frames .1 to 5", frames="7:")
    refused(numbers, "no such folder; give the processed scene's", data="/nowhere")
    refused(numbers, "data must be the processed scene's folder", data="")
    refused(numbers, "does not exist; the run has checkpoint_final.pth", checkpoint="b.pth")
    refused(numbers, "without '..'", checkpoint="../b.pth")
    (numbers.folder / "config.yaml").unlink()
    refused(numbers, "config.yaml does not exist; a drivestudio run is")


def test_runs_are_recognised_and_data_found(numbers, tmp_path, monkeypatch):
    assert recognised(numbers.folder) == "drivestudio"
    assert open_scene(str(numbers.folder)).name == "run"
    # A relative root is one from above the run, or from where one is.
    files.write_config(numbers.folder, Path("data"), "waymo", {})
    assert opened(numbers).frames[0].image_paths["front_camera"].startswith(str(tmp_path))
    elsewhere = tmp_path / "elsewhere"
    (tmp_path / "data").rename(elsewhere)
    refused(numbers, "data/007 of its config.yaml is not here")
    found = opened(numbers, data=str(elsewhere / "007"))
    assert found.frames[0].image_paths["front_camera"].startswith(str(elsewhere))
    monkeypatch.chdir(elsewhere.rename(tmp_path / "cwd").parent)
    (tmp_path / "cwd").rename(tmp_path / "data")
    assert len(opened(numbers).frames) == files.COUNT


def test_the_newest_checkpoint_is_taken_where_none_is_final(numbers):
    final = numbers.folder / "checkpoint_final.pth"
    content = torch.load(final, weights_only=True)
    final.unlink()
    refused(numbers, "holds no checkpoint_final.pth and no checkpoint_NNNNN.pth")
    for name, count in (("09000", 3), ("15000", 11), ("100000", 2)):
        content["models"]["SMPLNodes"]["_means"] = torch.zeros(count, 3)
        torch.save(content, numbers.folder / f"checkpoint_{name}.pth")
    assert any("2 Gaussians of SMPL" in p for p in opened(numbers).problems)
    chosen = opened(numbers, checkpoint="checkpoint_15000.pth")
    assert any("11 Gaussians of SMPL" in p for p in chosen.problems)
    file = str(numbers.folder / "checkpoint_09000.pth")
    assert any("3 Gaussians of SMPL" in p for p in open_drivestudio(file, {}).problems)
    with pytest.raises(AdapterError, match="is a checkpoint already"):
        open_drivestudio(file, {"checkpoint": "checkpoint_15000.pth"})


def put(model: str, name: str, value):
    def change(content):
        content["models"][model][name] = value

    return change


def drop(*keys: str):
    def change(content):
        for key in keys[:-1]:
            content = content[key]
        del content[keys[-1]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop("models"), "holds no dictionary 'models'; it holds step"),
        (drop("step"), "step must be a number of training steps; got None"),
        (drop("models", "Background"), "holds no dictionary 'Background'; it holds RigidNodes"),
        (drop("models", "Background", "_quats"), "Background lacks the tensor '_quats'"),
        (put("Background", "_scales", torch.zeros(80, 2)), r"_scales must be .*\[80, 3\]; got"),
        (put("Background", "_means", torch.zeros(80, 3).double()), "_means must be float32"),
        (put("Background", "_features_rest", torch.zeros(80, 24, 3)), "0, 3, 8 or 15 rows.*got 24"),
        (put("Background", "_features_rest", torch.zeros(80, 4, 3)), "0, 3, 8 or 15 rows.*got 4"),
        (put("Background", "_taus", torch.zeros(80, 1)), "holds _taus besides plain Gaussians"),
        (put("RigidNodes", "points_ids", torch.full((40, 1), 2)), "points_ids must be 0 to 1"),
        (put("RigidNodes", "points_ids", torch.zeros(40, dtype=torch.long)), "points_ids must be"),
        (put("RigidNodes", "instances_fv", torch.ones(9, 2).bool()), "instances_fv has 9 frames;"),
        (put("RigidNodes", "instances_fv", torch.ones(5, 2)), "instances_fv must be bool"),
        (put("RigidNodes", "instances_quats", torch.zeros(5, 2, 4)), "NaN, infinite or zero"),
        (put("RigidNodes", "instances_trans", torch.zeros(5, 3, 3)), r"instances_trans must be"),
        (drop("models", "RigidNodes", "instances_size"), "lacks the tensor 'instances_size'"),
        (put("Sky", "base", torch.zeros(6, 8, 4, 3)), r"base must be \[6, R, R, 3\]"),
        (put("Sky", "base", torch.full((6, 2, 2, 3), torch.nan)), "base holds NaN"),
        (put("Affine", "embedding.weight", torch.zeros(14, 4)), r"embedding.weight must be .*15"),
        (put("Affine", "decoder.0.weight", torch.zeros(16, 5)), "must take the 4 numbers"),
        (put("Affine", "decoder.2.bias", torch.zeros(9)), r"decoder.2.bias must be .*\[12\]"),
        (put("CamPose", "embeds.weight", torch.zeros(15, 6)), r"embeds.weight must be .*\[15, 9\]"),
        (put("CamPose", "embeds.weight", -torch.eye(15, 9).roll(3, 1)), "that are no rotation"),
        (put("CamPose", "embeds.weight", torch.full((15, 9), torch.inf)), "NaN or infinite"),
    ],
)
def test_a_checkpoint_of_another_layout_is_refused(numbers, change, message):
    change_checkpoint(numbers, change)
    assert "checkpoint_final.pth" in refused(numbers, message)


def test_data_that_is_missing_or_wrong_is_refused(numbers):
    bin_file = numbers.data / "lidar" / "002.bin"
    bin_file.write_bytes(bin_file.read_bytes()[:-4])
    with pytest.raises(AdapterError, match=r"002\.bin must hold rows of 14 float32"):
        opened(numbers).lidar(2)
    pose = numbers.data / "ego_pose" / "002.txt"
    text = pose.read_text()
    pose.write_text("1 2 3")
    refused(numbers, r"002\.txt must hold 4 x 4 numbers")
    pose.write_text(text)
    intrinsics = numbers.data / "intrinsics" / "2.txt"
    intrinsics.write_text("0 1 2 3")
    refused(numbers, r"2\.txt must hold fx fy cx cy")
    intrinsics.unlink()
    refused(numbers, r"2\.txt does not exist")


def test_data_of_another_scene_is_refused(numbers):
    (numbers.data / "ego_pose" / "005.txt").unlink()
    refused(numbers, "embedding.weight must be")
    change_checkpoint(numbers, drop("models", "Affine"))
    change_checkpoint(numbers, drop("models", "CamPose"))
    refused(numbers, "instances_fv has 5 frames; .* have 4 .1 to 4.. Is it the scene")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: {"a": v["0"]}, "a.*: Input should be a valid integer"),
        (lambda v: {"0": {"id": 1}}, "0.frame_annotations.frame_idx: Field required"),
        (lambda v: {"0": v["0"], "1": v["0"]}, "ids of objects repeat"),
        (lambda v: {"0": notes(v["0"], frame_idx=[0])}, r"of equal length; got \(1, 6, 6\)"),
        (lambda v: {"0": notes(v["0"], frame_idx=[0] * 6)}, "frame numbers, each once"),
        (lambda v: {"0": notes(v["0"], frame_idx=[10**400] * 6)}, "frame_idx: .*must hold T numb"),
        (lambda v: {"0": notes(v["0"], box_size=[["1"] * 3] * 6)}, "must hold T x 3 numbers"),
        (lambda v: {"9" * 5000: v["0"]}, "Unable to parse|unable to parse"),
        (lambda v: {"0": notes(v["0"], box_size=[[1, 2]] * 6)}, "box_size: .*must hold T x 3 numb"),
        (lambda v: {"0": notes(v["0"], box_size=[[1, 2, 0]] * 6)}, "box_size > 0"),
        (lambda v: {"0": notes(v["0"], obj_to_world=[[2.0] * 16] * 6)}, "must be rotations"),
    ],
)
def test_objects_that_are_none_are_refused(numbers, change, message):
    path = numbers.data / "instances" / "instances_info.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    assert "instances_info.json" in refused(numbers, message)


def notes(entry: dict, **values) -> dict:
    return {**entry, "frame_annotations": {**entry["frame_annotations"], **values}}


def test_objects_that_cannot_be_told_keep_their_numbers(numbers):
    path = numbers.data / "instances" / "instances_info.json"
    info = json.loads(path.read_text())
    twin = {**info["2"], "id": "car-c"}
    path.write_text(json.dumps({**info, "3": twin}))
    scene = opened(numbers)
    assert [a.track_id for a in scene.actors] == ["rigid-0", "car-b"]
    assert scene.actors[0].label == "vehicle"
    assert any("could not be told" in p and p.endswith("rigid-0") for p in scene.problems)
    path.unlink()
    scene = opened(numbers)
    assert [a.track_id for a in scene.actors] == ["rigid-0", "rigid-1"]
    assert any("holds no instances/instances_info.json" in p for p in scene.problems)
    assert len(scene.boxes(1)) == 0


def test_poses_of_objects_may_be_flat(numbers):
    before = opened(numbers).boxes(1)
    path = numbers.data / "instances" / "instances_info.json"
    info = json.loads(path.read_text())
    for key, entry in info.items():
        poses = np.array(entry["frame_annotations"]["obj_to_world"]).reshape(-1, 16)
        info[key] = notes(entry, obj_to_world=poses.tolist())
    nothing = {name: [] for name in ("frame_idx", "obj_to_world", "box_size")}
    info["3"] = {"id": 9, "frame_annotations": nothing}
    path.write_text(json.dumps(info, indent=4))
    os.utime(path, ns=(0, 0))
    assert np.array_equal(opened(numbers).boxes(1).centers_m, before.centers_m)


def test_objects_elsewhere_or_of_another_size_are_not_taken_for_the_model_s(numbers):
    path = numbers.data / "instances" / "instances_info.json"
    info = json.loads(path.read_text())
    moved = np.array(info["2"]["frame_annotations"]["obj_to_world"])
    moved[:, 0, 3] += 5
    info["2"] = notes(info["2"], obj_to_world=moved.tolist())
    info["1"] = notes(info["1"], box_size=[[4.5, 1.9, 1.7]] * 4)
    path.write_text(json.dumps(info))
    assert [a.track_id for a in opened(numbers).actors] == ["rigid-0", "rigid-1"]


def test_what_is_gone_on_without_is_said(numbers):
    (numbers.data / "images" / "002_0.jpg").unlink()
    first = numbers.data / "images" / "000_3.jpg"
    first.write_bytes((numbers.data / "images" / "000_0.jpg").read_bytes())

    def change(content):
        models = content["models"]
        del models["Sky"]
        width = torch.zeros(16, 6)
        models["Affine"]["decoder.0.weight"] = width
        models["Extra"] = OrderedDict(weight=torch.zeros(2))
        models["RigidNodes"]["instances_fv"][:, 1] = False
        models["Background"]["_means"][:3] = torch.nan
        rotated = torch.tensor([1.0, 0, 0, 1])
        models["RigidNodes"]["instances_quats"][0, 0] = rotated

    change_checkpoint(numbers, change)
    changes = {"data.pixel_source.undistort": False, "trainer.render.antialiased": True}
    files.write_config(numbers.folder, numbers.data.parent, "waymo", changes)
    scene = opened(numbers)
    assert isinstance(scene.sky, ConstantSky) and scene.color_maps == scene.image_color_maps == {}
    said = "\n".join(scene.problems)
    for part in (
        "1 of 15 images are missing, the first 002_0.jpg",
        "000_3.jpg is of 1920x1280 pixels; drivestudio takes the intrinsics of left_camera to be",
        "holds no Sky; the sky is black",
        "differ over the image (pixel_affine); they are left out",
        "the model Extra is left out",
        "no actors: rigid-1",
        "left out 3 of 80 Gaussians with NaN",
        "as if it had none (undistort is off)",
        "trainer.render.antialiased",
    ):
        assert part in said
    assert "front_camera" not in scene.frame(2).image_paths
    assert len(scene.background) == 77


def test_a_sky_of_another_kind_is_black_and_said(numbers):
    change_checkpoint(numbers, lambda c: c["models"].update(Sky={"grid": torch.zeros(2)}))
    scene = opened(numbers)
    assert isinstance(scene.sky, ConstantSky)
    assert any("not known here (grid); the sky is black" in p for p in scene.problems)


def test_a_run_without_objects_or_corrections_is_a_scene(numbers):
    for name in ("RigidNodes", "Affine", "CamPose", "SMPLNodes", "DeformableNodes"):
        change_checkpoint(numbers, drop("models", name))
    scene = opened(numbers)
    assert scene.actors == () and scene.color_maps == {}
    camera = scene.frame(1).cameras["front_camera"]
    expected = files.ego_from_opencv(0)
    assert np.allclose(camera.world_from_camera.numpy(), expected, atol=1e-9)
    assert len(scene.boxes(1)) == 3


def test_perturbed_poses_are_applied_before_the_learnt_ones(numbers):
    def change(content):
        shift = torch.zeros(15, 9)
        shift[:, 0] = 0.5
        quarter = torch.zeros(15, 9)
        quarter[:, 3:] = torch.tensor([-1.0, -1, 0, 1, -1, 0])  # rows (0 -1 0) and (1 0 0)
        content["models"]["CamPosePerturb"] = {"embeds.weight": quarter}
        content["models"]["CamPose"] = {"embeds.weight": shift}

    change_checkpoint(numbers, change)
    camera = opened(numbers).frame(1).cameras["front_camera"]
    turned = files.pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [0, 0, 0])
    expected = files.ego_from_opencv(0) @ turned @ files.pose(np.eye(3), [0.5, 0, 0])
    assert np.allclose(camera.world_from_camera.numpy(), expected, atol=1e-7)


@pytest.mark.parametrize(
    ("dataset", "slope", "lies"),
    [
        ("nuscenes", 0.3, False),
        ("pandaset", 0.3, False),
        ("waymo", 0.6, True),
        ("nuscenes", np.pi / 2, True),
    ],
)
def test_a_car_on_no_road_is_taken_to_stand_level(tmp_path, monkeypatch, dataset, slope, lies):
    level = files.dataset_from_ego
    c, s = np.cos(slope), np.sin(slope)
    nose_up = files.pose(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), [0, 0, 0])
    monkeypatch.setattr(files, "dataset_from_ego", lambda frame: level(frame) @ nose_up)
    scene = opened(files.write_run(tmp_path, dataset=dataset))
    assert any("taken to stand level" in problem for problem in scene.problems) == lies
    expected = np.eye(3)[2] if lies else [-s, 0, c]
    assert np.allclose(scene.frames[0].world_from_ego[2, :3].numpy(), expected, atol=1e-12)


def test_labels_need_no_readable_checkpoint(numbers):
    (numbers.folder / "checkpoint_final.pth").write_bytes(b"")
    labels = drivestudio_labels(str(numbers.folder), {"frames": "2:3"})
    assert labels.boxes(1).track_ids == ("walker", "car-b", "car-a")


def test_axes_of_datasets_are_rotations():
    for c in CONVENTIONS.values():
        for axes in (
            c.camera_from_opencv, c.scene_from_model, c.pose_from_ego, c.object_from_actor,
        ):  # fmt: skip
            assert np.array_equal(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) > 0
