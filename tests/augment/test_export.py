"""Scenes as splat files: baked as they are rendered, part by part, and what is said to be lost."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.base import open_scene
from augment.errors import OutputError
from augment.files.export import (
    export_cameras,
    export_losses,
    export_ply_parts,
    export_splats,
    inria_cameras,
    is_parts_folder,
)
from augment.render.rasterize import rasterize
from augment.render.sh import evaluate_sh
from augment.scene.geometry import rigid, rotmat_from_quat, transform_points
from augment.scene.scene import Actor, ColorSeries, Gaussians, PosedGaussians, Scene, Track
from augment.scene.semantics import SemanticClass
from augment.scene.transform import bake_scene, transform_gaussians_rigidly
from tests.fitted_scenes import START_NS, fitted_scene, frame, with_classes
from tests.scenes import camera_ahead, random_gaussians, slight_pose

NOW = START_NS + 100_000_000


def drive(**changes) -> Scene:
    """Actors ahead of the camera: one turned by 2 radians with colours that change, one of plain
    colours, one that is gone by NOW.
    """
    times = torch.tensor([START_NS, START_NS + 200_000_000])
    turned = rigid(
        rotmat_from_quat(torch.tensor([0.54, 0.3, -0.5, 0.6], dtype=torch.float64)),
        torch.tensor([4.0, 0.5, 0.2], dtype=torch.float64),
    )
    moved = rigid(turned[:3, :3], turned[:3, 3] + 0.4)
    rng = torch.Generator().manual_seed(5)
    waves = ColorSeries(
        0.3 * torch.randn(60, 4, 3, generator=rng), times, torch.tensor([0.0, 0.7]).double()
    )
    around = random_gaussians(60, seed=3, sh_degree=3)
    around = dataclasses.replace(around, means=0.2 * around.means)
    slight = torch.stack([slight_pose(), slight_pose((0.2, 0, 0))])
    size = (4.0, 2.0, 1.5)
    gone = Track(times - 10**12, slight)
    actors = (
        Actor("car/1", "Car", around, Track(times, torch.stack([turned, moved])), size, waves),
        Actor("b", "Car", with_classes(random_gaussians(40, seed=4, sh_degree=0)),
              Track(times, slight), size),
        Actor("gone", "Car", random_gaussians(30, seed=8), gone, size),
    )  # fmt: skip
    scene = fitted_scene(
        background=with_classes(random_gaussians(300, seed=2, sh_degree=1)), actors=actors
    )
    return dataclasses.replace(scene, **changes)


def image(parts) -> torch.Tensor:
    return rasterize(parts, camera_ahead(64, 48, 40.0)).rgb


def differences(ours: torch.Tensor, theirs: torch.Tensor) -> np.ndarray:
    """Of each pixel, in 1/255."""
    return 255 * (ours - theirs).abs().amax(-1).numpy().ravel()


# Baking


@pytest.mark.parametrize("offset_ns", [0, 130_000_001])
def test_a_baked_scene_renders_as_the_scene(offset_ns):
    scene, time_ns = drive(), START_NS + offset_ns
    ours, theirs = (
        image(tuple(scene.parts_at(time_ns))),
        image([PosedGaussians(bake_scene(scene, time_ns))]),
    )
    assert np.quantile(differences(ours, theirs), 0.999) < 0.05  # rounding; cut-offs may flip
    bare = image([PosedGaussians(scene.background)])
    assert differences(ours, bare).max() > 20  # the actors are in view
    later = image([PosedGaussians(bake_scene(scene, time_ns + 60_000_000))])
    assert differences(ours, later).max() > 10  # and are not the same at another moment


def test_what_baked_gaussians_are():
    scene = drive()
    gaussians = bake_scene(scene, NOW)
    assert len(gaussians) == 300 + 60 + 40 and gaussians.sh_degree == 3
    for name in ("means", "quats", "scales", "opacities", "semantic"):
        ours, theirs = getattr(gaussians, name), getattr(scene.background, name)
        assert torch.equal(ours[:300], theirs), name
    assert not gaussians.sh[:300, 4:].any()
    assert gaussians.semantic[300:360].unique().tolist() == [int(SemanticClass.UNKNOWN)]
    assert torch.equal(gaussians.semantic[360:], scene.actors[1].gaussians.semantic)
    pose = scene.actors[0].track.pose_at(NOW)
    expected = transform_points(pose, scene.actors[0].gaussians.means.double())
    torch.testing.assert_close(gaussians.means[300:360].double(), expected, rtol=1e-6, atol=1e-7)
    lengths = gaussians.quats.norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(400), rtol=0, atol=1e-6)


def test_scenes_with_less_in_them():
    alone = drive(actors=())
    assert bake_scene(alone, NOW) is alone.background
    gone = drive(background=Gaussians.empty(3), actors=drive().actors[2:])
    assert len(bake_scene(gone, NOW)) == 0
    plain = drive(background=random_gaussians(5, sh_degree=0), actors=drive().actors[1:2])
    assert bake_scene(plain, NOW).sh_degree == 0
    bare = dataclasses.replace(drive().actors[0], color_waves=None)
    assert bake_scene(drive(background=random_gaussians(5), actors=(bare,)), NOW).semantic is None


UNIT = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.1)


@settings(max_examples=60, deadline=None)
@given(quat=UNIT, shift=st.tuples(*[st.floats(-1e3, 1e3)] * 3), degree=st.integers(0, 3))
def test_shape_and_colour_turn_along(quat, shift, degree):
    """Covariances, and the colour seen from a direction that turns with the Gaussians."""
    before = random_gaussians(20, sh_degree=degree)
    rotation = rotmat_from_quat(torch.tensor(quat, dtype=torch.float64))
    after = transform_gaussians_rigidly(before, rotation, torch.tensor(shift, dtype=torch.float64))

    def covariances(gaussians: Gaussians) -> torch.Tensor:
        axes = rotmat_from_quat(gaussians.quats.double()) * gaussians.scales[:, None].double()
        return axes @ axes.transpose(1, 2)

    turned = rotation @ covariances(before) @ rotation.T
    torch.testing.assert_close(covariances(after), turned, rtol=1e-5, atol=1e-8)
    expected = before.means.double() @ rotation.T + torch.tensor(shift, dtype=torch.float64)
    torch.testing.assert_close(after.means.double(), expected, rtol=2e-7, atol=1e-7)
    seen = torch.nn.functional.normalize(torch.randn(20, 3), dim=1)
    colours = evaluate_sh(before.sh, seen)
    there = torch.nn.functional.normalize(seen @ rotation.float().T, dim=1)
    torch.testing.assert_close(evaluate_sh(after.sh, there), colours, rtol=0, atol=1e-5)


# Files of one moment


def test_an_exported_ply_opens_as_the_scene_was(tmp_path):
    scene = drive(has_metric_scale=True, has_known_gravity=True)
    export_splats(scene, tmp_path / "a.ply", NOW)
    assert export_cameras(scene, tmp_path)
    again = open_scene(str(tmp_path / "a.ply"))
    assert again.has_metric_scale and again.has_known_gravity
    assert again.camera_names == scene.camera_names
    assert [f.index for f in again.frames] == [f.index for f in scene.frames]
    for ours, theirs in zip(again.frames, scene.frames, strict=True):
        for name, camera in theirs.cameras.items():
            pose = ours.cameras[name].camera_from_world
            torch.testing.assert_close(pose, camera.camera_from_world, rtol=0, atol=1e-12)
            assert (ours.cameras[name].fx, ours.cameras[name].fy) == (camera.fx, camera.fy)
    ours = image(tuple(scene.parts_at(NOW)))
    theirs = image(tuple(again.parts_at(0)))
    assert np.quantile(differences(ours, theirs), 0.999) < 2


def test_cameras_are_inrias(tmp_path):
    """Read here as INRIA's own reader does: position and rotation are world_from_camera's."""
    scene = drive()
    views = json.loads(inria_cameras(scene))
    assert [v["id"] for v in views] == [0, 1, 2, 3]
    assert [v["img_name"] for v in views[:2]] == ["ahead/000004", "left/000004"]
    camera = scene.frames[0].cameras["left"]
    view = views[1]
    assert (view["width"], view["height"]) == (camera.width, camera.height)
    rotation = np.array(view["rotation"])
    point = np.array([5.0, 7.0, -2.0])
    seen = rotation.T @ (point - view["position"])
    expected = transform_points(camera.camera_from_world, torch.from_numpy(point))
    np.testing.assert_allclose(seen, expected, atol=1e-12)
    assert (view["cx"], view["cy"]) == (camera.cx, camera.cy)

    (tmp_path / "folder" / "cameras.json").mkdir(parents=True)
    assert not export_cameras(scene, tmp_path / "folder")
    (tmp_path / "cameras.json").write_text("[]")
    assert not export_cameras(scene, tmp_path)
    assert (tmp_path / "cameras.json").read_text() == "[]"
    assert not export_cameras(drive(frames=()), tmp_path)
    assert export_cameras(scene, tmp_path / "new") and export_cameras(scene, tmp_path / "new")
    above = dataclasses.replace(camera_ahead(), is_orthographic=True)
    only = dataclasses.replace(scene.frames[0], cameras={"ahead": above})
    assert inria_cameras(drive(frames=(only,))) is None


# Parts


def test_parts_open_again(tmp_path):
    scene = drive(has_metric_scale=True, has_known_gravity=True)
    folder = tmp_path / "new" / "parts"
    export_ply_parts(scene, folder)
    facts = json.loads((folder / "parts.json").read_text())
    assert facts["format"] == "climategs-parts" and facts["world_origin_m"][0] == 448_262
    assert facts["background"] == {"file": "background.ply", "count": 300}
    for uri in (folder, folder / "background.ply"):
        again = open_scene(str(uri))
        assert torch.equal(again.background.sh, scene.background.sh)
        assert again.camera_names == scene.camera_names
    assert len({entry["file"] for entry in facts["actors"]}) == 3
    for entry, actor in zip(facts["actors"], scene.actors, strict=True):
        assert (entry["track_id"], entry["label"]) == (actor.track_id, actor.label)
        assert entry["size_m"] == list(actor.size_m) and entry["count"] == len(actor.gaussians)
        track = Track(
            torch.tensor(entry["track"]["timestamps_ns"]),
            torch.tensor(entry["track"]["world_from_actor"], dtype=torch.float64),
        )
        assert torch.equal(track.world_from_actor, actor.track.world_from_actor)
        assert torch.equal(track.timestamps_ns, actor.track.timestamps_ns)
        part = open_scene(f"gaussians:{folder / entry['file']}")
        assert torch.equal(part.background.sh, actor.gaussians.sh)
        assert torch.equal(part.background.means, actor.gaussians.means)
    assert facts["actors"][0]["file"].startswith("actors/car_1-")
    assert not [p for p in folder.parent.iterdir() if p.name.startswith(".")]


def test_parts_without_gaussians_have_no_file(tmp_path):
    scene = drive(background=Gaussians.empty(), frames=())
    export_ply_parts(scene, tmp_path / "parts")
    facts = json.loads((tmp_path / "parts" / "parts.json").read_text())
    assert facts["background"] == {"file": None, "count": 0}
    names = sorted(p.name for p in (tmp_path / "parts").iterdir())
    assert names == ["actors", "parts.json"]
    assert "parts without Gaussians have no file" in export_losses(scene, "ply-parts")


def test_parts_are_replaced_as_a_whole(tmp_path):
    folder = tmp_path / "parts"
    folder.mkdir()
    export_ply_parts(drive(), folder)
    (tmp_path / "link").symlink_to(folder)
    export_ply_parts(drive(actors=(), name="new"), tmp_path / "link")
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["background.ply", "cameras.json", "parts.json"]


@pytest.mark.parametrize("name", ["notes.txt", "actors/notes.txt"])
def test_a_folder_with_other_files_is_not_replaced(tmp_path, name):
    folder = tmp_path / "parts"
    export_ply_parts(drive(), folder)
    assert is_parts_folder(folder)
    (folder / name).write_text("keep")
    with pytest.raises(OutputError, match="holds something else than exported parts"):
        export_ply_parts(drive(), folder)
    (folder / name).unlink()
    (folder / "parts.json").write_text('{"format": "of another program"}')
    for place in (folder, folder / "background.ply"):
        with pytest.raises(OutputError, match="holds something else than exported parts"):
            export_ply_parts(drive(), place)
    assert (folder / "background.ply").exists()


# What is said to be lost


def test_losses_are_said():
    scene = drive(frames=(frame(4, START_NS),))
    ply = export_losses(scene, "ply", NOW)
    splat = export_losses(scene, "splat", NOW)
    parts = export_losses(scene, "ply-parts")
    for said in (ply, splat, parts):
        assert "the sky is left out" in said
        assert any("recorded colours of ahead, left differ" in s for s in said)
        assert any("ground_z=-1.235" in s for s in said)
        assert any("principal points" in s and "0.7 px off" in s for s in said)
        assert all(s == s.strip() and not s.endswith(".") for s in said)
    assert f"actors (2) stand still where they are at {NOW} ns" in ply
    assert "actors (1) that are not there then are left out" in ply
    assert "colours of actors (1) that change over time are those of that moment" in ply
    assert "colours of actors (1) that change over time are their constant part" in parts
    assert any("8 bits" in s for s in splat) and any("SH bands above 0" in s for s in splat)
    assert not any("8 bits" in s or "stand still" in s for s in parts)

    late = dataclasses.replace(camera_ahead(), timestamp_ns=START_NS + 40_000_000)
    scene = drive(frames=(dataclasses.replace(frame(4, START_NS), cameras={"ahead": late}),))
    assert any("up to 40 ms from that" in s for s in export_losses(scene, "ply", START_NS))
    assert not any("from that" in s for s in (*ply, *export_losses(scene, "ply-parts")))

    least = drive(actors=(), color_maps={}, image_color_maps={}, frames=(), made_by={},
                  ground_z_m=None, ground=None)  # fmt: skip
    assert export_losses(least, "ply", NOW) == ("the sky is left out",)
    (saved,) = export_losses(scene, "scene")
    assert "read from test:recording" in saved
    assert "folders of this machine" in export_losses(scene, "file")[1]
    assert "0.05 degrees" in export_losses(scene, "file", half=True)[2]
    assert export_losses(dataclasses.replace(least, recorded_source=None), "scene") == ()
