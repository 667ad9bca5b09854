"""Plain splat files as scenes: axes, unit, origin, cameras found and grouped, ground, doubts."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from adapters.base import open_scene
from adapters.camera_files.camera_files import look_at_pose
from adapters.camera_files.paths import solid_points
from adapters.detect_format import detect_scheme
from adapters.gaussian_files import (
    GaussianOptions,
    doubt_about_metres,
    find_ground,
    find_splat_files,
    open_gaussians,
    scale_from_cameras,
)
from adapters.world import WorldChange, nearest_axis, parse_up, rotation_to_z_up
from augment.errors import AdapterError, SceneError
from augment.files.ply import write_ply, write_splat
from augment.output.view_files import check_frames
from augment.scene.scene import Gaussians
from tests.adapters.splat_scenes import gaussians_at, street

TO_Y_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z-up world to COLMAP's usual y-down


def inria_cameras(poses: dict[str, np.ndarray]) -> list[dict]:
    return [
        {
            "id": number, "img_name": name, "width": 96, "height": 54, "fx": 60.0, "fy": 60.0,
            "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(),
        }
        for number, (name, pose) in enumerate(poses.items())
    ]  # fmt: skip


def drive_poses(names: list[str], *, change: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Cameras 2 m apart along +x at 1.6 m, looking ahead; `change` turns their world."""
    poses = {}
    for number, name in enumerate(names):
        eye = (2.0 * number + 1, 0.0, 1.6)
        pose = look_at_pose(eye, (eye[0] + 5, 0.0, 1.6), where="test")
        turn = np.eye(4)
        turn[:3, :3] = np.eye(3) if change is None else change
        poses[name] = turn @ pose
    return poses


def turned(gaussians: Gaussians, rotation: np.ndarray) -> Gaussians:
    """Balls only: their orientation does not matter."""
    means = gaussians.means @ torch.from_numpy(rotation).float().T
    return Gaussians(**{**vars(gaussians), "means": means})


def save_model(folder: Path, gaussians: Gaussians, cameras: list | None = None) -> Path:
    """An INRIA output folder."""
    target = folder / "point_cloud" / "iteration_30000"
    target.mkdir(parents=True)
    write_ply(target / "point_cloud.ply", gaussians)
    if cameras is not None:
        (folder / "cameras.json").write_text(json.dumps(cameras))
    return folder


def problem_with(scene, words: str) -> str:
    found = [p for p in scene.problems if words in p]
    assert len(found) == 1, scene.problems
    return found[0]


def test_a_bare_street_is_turned_and_driven_and_says_what_was_estimated(tmp_path: Path) -> None:
    write_ply(tmp_path / "corner.ply", turned(street(), TO_Y_DOWN))
    scene = open_gaussians(tmp_path / "corner.ply", {})
    assert scene.name == "corner" and scene.has_metric_scale and scene.has_known_gravity
    assert "estimated to be -y: " in problem_with(scene, "up is estimated")
    problem_with(scene, "a unit is estimated to be 1 m")
    problem_with(scene, "no cameras came with the scene: made a straight drive")
    assert scene.camera_names == ("front", "left", "right")
    assert scene.ground_z_m == pytest.approx(0, abs=0.05)
    stated = open_gaussians(tmp_path / "corner.ply", {"up": "-y", "scale": "1"})
    assert torch.equal(stated.background.means, scene.background.means)
    assert [p[:10] for p in stated.problems] == ["no cameras"]
    for one, other in zip(scene.frames, stated.frames, strict=True):
        assert torch.equal(one.world_from_ego, other.world_from_ego)


def test_a_bare_file_that_may_be_anything_gets_no_path(tmp_path: Path) -> None:
    """Opened, so that it can be looked at and exported; to render it says what to give."""
    small = street()
    small = Gaussians(**{**vars(small), "means": small.means / 20, "scales": small.scales / 20})
    ball = torch.nn.functional.normalize(torch.randn(2000, 3), dim=1)
    for gaussians, why in (
        (small, "in metres it would be no street: "),
        (gaussians_at(ball), "which way is up is not clear; the best guess is "),
    ):
        write_ply(tmp_path / "a.ply", gaussians)
        scene = open_gaussians(tmp_path / "a.ply", {})
        assert scene.frames == () and not scene.has_metric_scale
        problem_with(scene, why)
        with pytest.raises(SceneError, match=rf"no frames to render.*{why}.*\?up=\+z&scale=1"):
            check_frames(scene)
        circled = open_gaussians(tmp_path / "a.ply", {"path": "orbit"})
        assert circled.camera_names == ("orbit",) and not circled.has_metric_scale
        assert open_gaussians(tmp_path / "a.ply", {"up": "+z", "scale": "20"}).frames


def test_cameras_on_a_car_give_up_and_unit(tmp_path: Path) -> None:
    """As training from COLMAP leaves it: y down, in a unit of its own."""
    source = turned(street(heading_deg=0), TO_Y_DOWN)
    source = Gaussians(**{**vars(source), "means": source.means / 5, "scales": source.scales / 5})
    poses = drive_poses(["1", "2", "3"], change=TO_Y_DOWN)
    for pose in poses.values():
        pose[:3, 3] /= 5
    scene = open_gaussians(save_model(tmp_path, source, inria_cameras(poses)), {})
    assert scene.has_metric_scale and scene.has_known_gravity
    assert "which is taken as 1.6 m, give or take a quarter" in problem_with(
        scene, "a unit is estimated"
    )
    problem_with(scene, "up is estimated to be -y")
    heights = [float(f.cameras["camera"].centre[2]) for f in scene.frames]
    # Splats lie up to 2 cm about the road, and parked cars and strays beside the cameras.
    assert heights == pytest.approx([1.6] * 3, abs=0.1)
    assert scene.ground_z_m == pytest.approx(0, abs=0.1)


def test_notes_of_the_file_are_believed(tmp_path: Path) -> None:
    gaussians = turned(street(), TO_Y_DOWN)
    write_ply(tmp_path / "a.ply", gaussians, notes={"unit": "metre", "up": "-y"})
    scene = open_gaussians(tmp_path / "a.ply", {})
    assert scene.has_metric_scale
    torch.testing.assert_close(scene.background.means, street().means, rtol=0, atol=1e-5)


def test_model_folder_with_cameras(tmp_path: Path) -> None:
    """A y-down model whose cameras drive along the street: turned, scaled, grouped, grounded."""
    source = turned(street(heading_deg=0), TO_Y_DOWN)
    names = [f"{frame:04d}_{camera}" for frame in (3, 5) for camera in ("front", "left")]
    poses = drive_poses(names, change=TO_Y_DOWN)
    model = save_model(tmp_path / "trained", source, inria_cameras(poses))
    scene = open_gaussians(model, {"up": "-y", "scale": "2"})
    assert scene.name == "trained"
    assert [frame.index for frame in scene.frames] == [3, 5]
    assert scene.camera_names == ("front", "left")
    np.testing.assert_allclose(
        scene.frames[0].cameras["left"].centre, [2 * 3, 0, 2 * 1.6], atol=1e-12
    )
    np.testing.assert_allclose(
        scene.frames[0].cameras["left"].world_from_camera[:3, 2], [1, 0, 0], atol=1e-12
    )
    torch.testing.assert_close(
        scene.background.means, 2 * street(heading_deg=0).means, rtol=0, atol=2e-5
    )
    assert scene.ground_z_m == pytest.approx(0, abs=0.3)
    assert scene.problems == ()
    file = model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    by_file = open_gaussians(file, {"up": "-y", "scale": "2"})
    assert by_file.name == "trained" and len(by_file.frames) == 2


def test_a_wrong_up_is_noticed(tmp_path: Path) -> None:
    names = [f"{n:03d}" for n in range(4)]
    source = turned(street(heading_deg=0), TO_Y_DOWN)
    cameras = inria_cameras(drive_poses(names, change=TO_Y_DOWN))
    write_ply(tmp_path / "cloud.ply", gaussians_at(torch.randn(2000, 3)))
    query = {"cameras": str(tmp_path / "m" / "cameras.json"), "scale": "1"}
    model = save_model(tmp_path / "m", source, cameras)
    text = problem_with(open_gaussians(tmp_path / "cloud.ply", query), "mean up direction")
    assert "90 degrees from" in text and "+z;" in text and "up=-y if" in text
    for up in ("-y", "cameras", "0,-1,0"):
        scene = open_gaussians(model, {"scale": "1", "up": up})
        assert scene.problems == ()
        np.testing.assert_allclose(
            scene.frames[0].cameras["camera"].world_from_camera[:3, 1], [0, 0, -1], atol=1e-12
        )
    # One that was given is not doubted.
    assert open_gaussians(model, {"scale": "1", "up": "+z"}).problems == ()


def test_cameras_elsewhere_and_none(tmp_path: Path) -> None:
    model = save_model(tmp_path / "m", street(), inria_cameras(drive_poses(["1", "2"])))
    path = tmp_path / "path.json"
    frames = [{"position": [0, 0, 2], "look_at": [1, 1, 2]}]
    path.write_text(json.dumps({"width": 9, "height": 9, "fx": 9, "frames": frames}))
    other = open_gaussians(model, {"cameras": str(path), "scale": "1"})
    assert other.frames[0].cameras["camera"].width == 9
    (model / "cameras.json").write_text("{")
    with pytest.raises(AdapterError, match=r"is not readable JSON.*cameras=none"):
        open_gaussians(model, {})
    none = open_gaussians(model, {"cameras": "none", "scale": "1"})
    assert none.camera_names == ("front", "left", "right")


def test_cameras_of_another_world_are_noticed(tmp_path: Path) -> None:
    poses = drive_poses(["1", "2"])
    for pose in poses.values():
        pose[:3, 3] += [0, 0, 500]
    model = save_model(tmp_path, street(heading_deg=0), inria_cameras(poses))
    text = problem_with(open_gaussians(model, {"scale": "1"}), "different worlds")
    assert "see 0.00% of the Gaussians" in text


def test_far_coordinates_are_recentred(tmp_path: Path) -> None:
    """Doubles far away keep their precision, and their cameras come along."""
    near = street(heading_deg=0)
    table = np.zeros(len(near), dtype=_double_columns())
    offset = np.array([500_000.25, 5_300_000.5, 400.0])
    for axis, name in enumerate("xyz"):
        table[name] = near.means[:, axis].double().numpy() + offset[axis]
    table["rot_0"], table["opacity"] = 1, 3
    for name in ("scale_0", "scale_1", "scale_2"):
        table[name] = -2
    path = tmp_path / "utm.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")]).write(str(path))
    poses = drive_poses(["1", "2"])
    for pose in poses.values():
        pose[:3, 3] += offset
    (tmp_path / "cameras.json").write_text(json.dumps(inria_cameras(poses)))
    scene = open_gaussians(path, {"scale": "1"})
    assert scene.problems == ()
    assert (scene.world_origin_m == np.round(scene.world_origin_m)).all()
    world = scene.background.means.double().numpy() + scene.world_origin_m
    # float32 keeps 2 um at 30 m
    np.testing.assert_allclose(world, near.means.double().numpy() + offset, atol=1e-5)
    centre = scene.frames[1].cameras["camera"].centre.numpy() + scene.world_origin_m
    np.testing.assert_allclose(centre, offset + np.array([3, 0, 1.6]), atol=1e-6)
    assert scene.ground_z_m == pytest.approx(offset[2] - scene.world_origin_m[2], abs=0.3)


def test_far_float32_coordinates_are_recentred_and_lamented(tmp_path: Path) -> None:
    near = street(heading_deg=0)
    write_ply(tmp_path / "a.ply", Gaussians(**{**vars(near), "means": near.means + 2_000_000}))
    scene = open_gaussians(tmp_path / "a.ply", {"scale": "1"})
    assert scene.background.means.abs().max() < 100
    text = problem_with(scene, "km from zero")
    assert "steps of up to 0.12 m" in text


def _double_columns() -> list[tuple[str, str]]:
    names = ["f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
             "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    return [(axis, "f8") for axis in "xyz"] + [(name, "f4") for name in names]


def test_which_file_of_a_folder(tmp_path: Path) -> None:
    model = save_model(tmp_path / "m", street(length=8))
    early = model / "point_cloud" / "iteration_7000"
    early.mkdir()
    write_ply(early / "point_cloud.ply", street(length=8))
    (newest,) = find_splat_files(model, GaussianOptions())
    assert newest.parent.name == "iteration_30000"
    (chosen,) = find_splat_files(model, GaussianOptions(iteration=7000))
    assert chosen.parent.name == "iteration_7000"
    with pytest.raises(AdapterError, match=r"no iteration 8; it has \[7000, 30000\]"):
        find_splat_files(model, GaussianOptions(iteration=8))
    folder = tmp_path / "f"
    folder.mkdir()
    with pytest.raises(AdapterError, match=r"expected .* found none"):
        find_splat_files(folder, GaussianOptions())
    write_splat(folder / "a.splat", street(length=8))
    (only,) = find_splat_files(folder, GaussianOptions())
    assert only.name == "a.splat"
    write_ply(folder / "b.ply", street(length=8))
    with pytest.raises(AdapterError, match=r"several kinds.* found \['a\.splat', 'b\.ply'\]"):
        open_gaussians(folder, {})
    assert len(open_scene(f"gaussians:{folder}?files=b.ply").background) == len(street(length=8))


def test_files_of_a_folder_are_parts_of_one_scene(tmp_path: Path) -> None:
    """Two halves of a street, of which one has colours by direction and lies far from zero."""
    whole = street(length=8)
    left = whole.means[:, 1] > 0
    near, far = whole.select(left), whole.select(~left)
    bands = torch.nn.functional.pad(far.sh, (0, 0, 0, 4 - far.sh.shape[1]))
    write_ply(tmp_path / "b.ply", dataclasses.replace(far, sh=bands))
    write_ply(tmp_path / "a.ply", near)
    assert detect_scheme(tmp_path) == "gaussians"
    scene = open_scene(f"{tmp_path}?up=+z&scale=1")
    said = problem_with(scene, "2 files are taken as parts of one scene")
    assert f"a.ply ({len(near)}), b.ply ({len(far)})" in said and "filled up with zeros" in said
    assert scene.name == tmp_path.name and scene.background.sh_degree == 1
    assert torch.equal(scene.background.means, torch.cat([near.means, far.means]))
    assert not scene.background.sh[: len(near), 1:].any()
    turned_round = open_scene(f"gaussians:{tmp_path}?files=b.ply,a.ply&up=+z&scale=1")
    assert torch.equal(turned_round.background.means, torch.cat([far.means, near.means]))
    write_ply(tmp_path / "b.ply", far, notes={"up": "-y"})
    with pytest.raises(AdapterError, match=r"differ in 'up': a\.ply says nothing, b\.ply says -y"):
        open_gaussians(tmp_path, {})
    write_ply(tmp_path / "a.ply", near, notes={"up": "+z"})
    with pytest.raises(AdapterError, match="differ in 'up'"):
        open_gaussians(tmp_path, {"up": "+z"})
    for files in ("c.ply", "../a.ply"):
        with pytest.raises(AdapterError, match=r"no file of this folder.* a\.ply, b\.ply"):
            open_gaussians(tmp_path, {"files": files})


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ({"upp": "z"}, r"'upp'; did you mean 'up'. allowed are up: .*; scale: metres per unit"),
        ({"up": "north"}, "up must be"),
        ({"scale": "big"}, "scale must be metres per unit.*got 'big'"),
        ({"scale": "-1"}, "scale must be"),
        ({"scale": "nan"}, "scale must be"),
        ({"scale": "1e300"}, "scale must be"),
        ({"path": "walk"}, "path must be auto, drive or orbit"),
        ({"iteration": "last"}, "iteration must be the number"),
        ({"sky": "blue"}, "sky must be .*overcast .a light grey., black, white"),
        ({"sky": "0,0,2"}, "sky must be"),
        ({"files": "a.ply,"}, "files must be the names"),
        ({"files": "a.ply"}, "this is a file"),
        ({"lod": "fine"}, "lod must be the level of detail"),
        ({"lod": "1"}, "no levels of detail"),
        ({"activated": "maybe"}, "activated must be of a .ply"),
        ({"cameras": "absent.json"}, r"absent\.json: no such file"),
        ({"up": "cameras"}, "up=cameras needs cameras"),
    ],
)
def test_bad_queries(tmp_path: Path, query: dict[str, str], message: str) -> None:
    write_ply(tmp_path / "a.ply", street(length=8))
    with pytest.raises(SceneError, match=message):
        open_gaussians(tmp_path / "a.ply", query)


def test_a_file_without_a_sky_has_an_overcast_one(tmp_path: Path) -> None:
    model = save_model(tmp_path, street(length=8))
    up = torch.tensor([[0.0, 0, 1]])
    red, green, blue = open_gaussians(model, {}).sky.sample(up)[0].tolist()
    assert red == green == blue and 0.7 < red < 0.95
    assert open_gaussians(model, {"sky": "black"}).sky.sample(up).tolist() == [[0, 0, 0]]
    (model / "cfg_args").write_text("Namespace(sh_degree=3, white_background=True)")
    assert open_gaussians(model, {}).sky.sample(up).tolist() == [[1, 1, 1]]
    grey = open_gaussians(model, {"sky": "0.5,0.5,0.5"}).sky.sample(up)
    assert grey.tolist() == [[0.5, 0.5, 0.5]]


def test_real_tiles_open(shared_dir: Path) -> None:
    tile = shared_dir / "data" / "splats" / "tile_x000_y002.splat"
    bare = open_scene(str(tile))  # a blur without a ground
    assert len(bare.background) == 121_833 and bare.frames == ()
    scene = open_scene(f"{tile}?up=%2Bz&scale=1")
    assert scene.camera_names == ("front", "left", "right")
    assert scene.ground_z_m is not None and -4 < scene.ground_z_m < 1


TILTED = "0.25,-0.9,0.3"


def posed(gaussians: Gaussians, up: str, unit: float = 1.0) -> Gaussians:
    """Balls of a z-up world as a file whose `up` points up stores them, in units of `unit` m."""
    turn = torch.from_numpy(rotation_to_z_up(parse_up(up)).T).float()
    return Gaussians(
        **{
            **vars(gaussians),
            "means": gaussians.means @ turn.T / unit,
            "scales": gaussians.scales / unit,
        }
    )


def box(count: int, low: list[float], high: list[float]) -> torch.Tensor:
    rng = torch.Generator().manual_seed(count)
    first, last = torch.tensor(low), torch.tensor(high)
    return first + (last - first) * torch.rand(count, 3, generator=rng)


def with_strays(gaussians: Gaussians, share: float) -> Gaussians:
    """And that many balls hundreds of metres away, on all sides."""
    rng = torch.Generator().manual_seed(5)
    far = 300 * torch.randn(int(share * len(gaussians)), 3, generator=rng)
    return gaussians_at(torch.cat([gaussians.means, far]))


@pytest.mark.parametrize("up", ["+z", "-y", TILTED])
def test_up_is_found_in_any_pose_and_unit_among_strays(up: str) -> None:
    found = find_ground(posed(with_strays(street(), 0.2), up, 7.3))
    assert found is not None and found.is_clear
    # An axis exactly; else what a plane through voxels of a road with cars on it can tell.
    off_deg = math.degrees(math.acos(min(1.0, float(found.up @ parse_up(up)))))
    assert off_deg < 1e-5 if up != TILTED else off_deg < 1.0


def test_what_has_no_clear_ground_is_not_guessed_at() -> None:
    rng = torch.Generator().manual_seed(2)
    cloud = torch.randn(4000, 3, generator=rng)
    room = [
        box(3000, [0, 0, 0], [6, 5, 0.01]), box(3001, [0, 0, 2.99], [6, 5, 3]),
        box(3002, [0, 0, 0], [6, 0.01, 3]), box(3003, [0, 4.99, 0], [6, 5, 3]),
    ]  # fmt: skip
    corner = [box(3000, [0, 0, 0], [9, 9, 0.01]), box(3001, [0, 0, 0], [9, 0.01, 9])]
    refused = {
        "a blob": cloud,
        "a ball": torch.nn.functional.normalize(cloud, dim=1),
        "a floor under a ceiling": torch.cat(room),
        "a floor and a wall of its size": torch.cat(corner),
        "twenty points": cloud[:20],
        "one place": torch.ones(4000, 3),
    }
    for what, means in refused.items():
        found = find_ground(gaussians_at(means))
        assert found is None or not found.is_clear, what


def test_cameras_decide_between_a_floor_and_a_wall_of_its_size() -> None:
    corner = gaussians_at(
        torch.cat([box(3000, [0, 0, 0], [9, 9, 0.01]), box(3001, [0, 0, 0], [9, 0.01, 9])])
    )
    leaning = np.array([0.2, 0.1, 0.97]) / np.linalg.norm([0.2, 0.1, 0.97])
    found = find_ground(corner, near=leaning)
    assert found is not None and found.is_clear and found.up.tolist() == [0, 0, 1]


def poses(height: float, *, pitch_deg: float = 0.0, jump: float = 0.0) -> np.ndarray:
    """Along the street of heading 0; jump: every second camera's additional height."""
    eyes = [(2.0 * n + 5, 0.0, height + jump * (n % 2)) for n in range(20)]
    drop = math.tan(math.radians(pitch_deg))
    return np.stack([look_at_pose(e, (e[0] + 1, 0.0, e[2] - drop), where="test") for e in eyes])


def test_cameras_above_the_ground_give_the_unit() -> None:
    points = solid_points(street(heading_deg=0))
    for height in (1.2, 1.6, 2.0):  # the unit is a metre, and stays so to the bit
        found = scale_from_cameras(points, poses(height))
        assert found is not None and found[0] == 1.0
    for unit in (0.1, 4.0):
        scaled = poses(1.6)
        scaled[:, :3, 3] /= unit
        found = scale_from_cameras(points / unit, scaled)
        # Splats lie up to 2 cm about the road, and strays below it.
        assert found is not None and found[0] == pytest.approx(unit, rel=0.05)
        assert "give or take a quarter" in found[1]
    assert scale_from_cameras(points, poses(9.0, pitch_deg=60)) is None  # a drone's
    assert scale_from_cameras(points, poses(1.6, jump=9)) is None
    assert scale_from_cameras(points + 50.0, poses(1.6)) is None  # nothing under them


def test_streets_may_be_in_metres_and_other_sizes_may_not() -> None:
    gaussians = street()
    points = solid_points(gaussians)
    assert doubt_about_metres(points, gaussians.scales) is None
    for unit in (0.1, 100.0):
        doubt = doubt_about_metres(points / unit, gaussians.scales / unit)
        assert doubt is not None and "wide (10 to 2000 expected)" in doubt
    assert "splat" in str(doubt_about_metres(points, 20 * gaussians.scales))


def test_parse_up() -> None:
    assert parse_up("-y").tolist() == [0, -1, 0]
    assert parse_up("Z").tolist() == parse_up("+z").tolist() == [0, 0, 1]
    np.testing.assert_allclose(parse_up("0, -3, 4"), [0, -0.6, 0.8])
    for text in ("", "up", "+w", "--z", "0,0,0", "1,2", "nan,0,1", "1e999,0,0"):
        with pytest.raises(AdapterError, match="up must be"):
            parse_up(text)


def test_axes_turn_exactly_and_any_direction_turns_to_up() -> None:
    for axis in ("+x", "-x", "+y", "-y", "+z", "-z"):
        rotation = rotation_to_z_up(parse_up(axis))
        assert (rotation @ parse_up(axis)).tolist() == [0, 0, 1]
        assert np.linalg.det(rotation) == 1 and set(np.abs(rotation).ravel()) == {0, 1}
        assert nearest_axis(parse_up(axis)) == axis
    for tilt in (1e-9, 1e-7, 1e-5, 0.1, 3.0):  # next to -z the half-way direction almost vanishes
        up = np.array([np.sin(tilt), 0, -np.cos(tilt)])
        rotation = rotation_to_z_up(up)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=2e-8)


def test_no_change_keeps_the_bits() -> None:
    source = Gaussians.empty()
    assert WorldChange().gaussians(source, np.zeros(3)) is source
