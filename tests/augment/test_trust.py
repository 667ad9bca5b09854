"""What is said of scenes with holes, panes of sky, and cameras that they were never fitted to."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from adapters.camera_files.paths import with_camera_path
from augment.dataset.weather_dataset import WeatherDataset
from augment.files.scene_file import load_scene_parts, save_scene
from augment.jobs.blocks import SceneRecord, cut_into_blocks
from augment.jobs.render_job import RenderJob, run_job
from augment.output.layout import item_paths
from augment.output.manifest import read_manifest
from augment.photo.lidar_view import elevation_rad
from augment.photo.trust import (
    MAX_MAGNIFICATION,
    judge_scene,
    judge_view,
    nearest_view,
    source_views,
    trust_mask,
    unfitted_cameras,
)
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Actor, Gaussians, Scene, Track
from augment.scene.sky import ConstantSky
from augment.view.render_view import render_view
from recipes.fields import changed
from recipes.load import load_recipe
from recipes.schema import Recipe
from tests.scenes import camera_ahead, one_gaussian, stack
from tests.streets import open_street

CLEAR = changed(load_recipe("clear").resolve(0), {"render.scale": 0.25, "output.depth": "none"})


def fitted(scene: Scene, scale: float = 0.25, cameras: tuple[str, ...] = ("front",)) -> Scene:
    views = {name: [frame.index for frame in scene.frames] for name in cameras}
    return dataclasses.replace(scene, made_by={"fitted": {"scale": scale, "views": views}})


def without(scene: Scene, mask: torch.Tensor) -> Scene:
    return dataclasses.replace(scene, background=scene.background.select(~mask))


def screen(x_m: float) -> Gaussians:
    """A dark grey wall across the view of a camera that looks along +x."""
    places = [(x_m, y, z) for y in np.arange(-24.0, 26, 2) for z in np.arange(-18.0, 19, 2)]
    return stack(*(one_gaussian(at, (0.05, 1.5, 1.5), 0.999, (0.3,) * 3) for at in places))


def mean_trust(scene: Scene, camera: Camera) -> float:
    return trust_mask(scene, camera).mean() / 255


def with_sheet(scene: Scene) -> Scene:
    """A sheet of sky 15 m ahead of the front camera, 6 m over it."""
    camera = scene.frames[0].cameras["front"]
    forward = camera.world_from_camera[:3, 2]
    mean = camera.centre + 15 * forward + torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64)
    sheet = one_gaussian(tuple(mean.tolist()), scale=1.5, opacity=0.99, rgb=(0.7, 0.8, 0.9))
    bands = scene.background.sh.shape[1]
    sh = torch.zeros(1, bands, 3)
    sh[:, :1] = sheet.sh
    road = dataclasses.replace(scene.background, semantic=None)
    return dataclasses.replace(
        scene, background=stack(road, dataclasses.replace(sheet, sh=sh)), actors=()
    )


def recorded(scene: Scene, folder: Path) -> Scene:
    """The scene with its own clear renders as the recorded images of the front camera."""
    frames = []
    for frame in scene.frames:
        path = folder / f"{frame.index}.png"
        rgb = render_view(scene, frame.cameras["front"], CLEAR).rgb
        cv2.imwrite(str(path), rgb[..., ::-1])
        frames.append(dataclasses.replace(frame, image_paths={"front": str(path)}))
    return dataclasses.replace(scene, frames=tuple(frames))


def test_a_street_has_no_hole_and_its_sky_is_unknown():
    trust = judge_scene(open_street(), cameras=["front", "left"])
    assert all(
        view.ground_open == 0 for camera_trust in trust.cameras for view in camera_trust.views
    )
    assert all("lets more than 2 %" in text for text in trust.problems)  # it is a coarse one
    assert trust.unknown == ("whether the sky is empty: no recorded image tells where it is",)
    assert [camera_trust.seen_images for camera_trust in trust.cameras] == [2, 2]


def test_a_hole_in_the_road_is_counted_named_and_not_trusted():
    street = open_street()
    camera = street.frames[0].cameras["front"].scaled(0.25)
    local = street.background.means.double() - camera.centre
    across, _, along = (local @ camera.world_from_camera[:3, :3]).T
    hole = without(street, (along > 5) & (along < 9) & (across.abs() < 2) & (local[:, 2] < 0))
    (camera_trust,) = judge_scene(hole, hole.frames[:1], ["front"], count=1).cameras
    assert 0.05 < camera_trust.views[0].ground_open < 0.8
    assert camera_trust.views[0].ground_leaks >= camera_trust.views[0].ground_open
    assert "of the ground has no surface" in camera_trust.problems[0]
    lost = mean_trust(street, camera) - mean_trust(hole, camera)
    below = elevation_rad(camera) < 0
    assert lost / below.mean() == pytest.approx(camera_trust.views[0].ground_open, abs=0.1)
    assert trust_mask(hole, camera)[~below].mean() > 0.95 * 255
    # A frame of a camera path that looks back, with the number of a recorded frame.
    ahead = hole.frames[0].cameras["front"]
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    back = dataclasses.replace(ahead, camera_from_world=turn @ ahead.camera_from_world)
    path = [dataclasses.replace(hole.frames[0], cameras={"front": back})]
    (camera_trust,) = judge_scene(hole, path, ["front"], count=1).cameras
    assert camera_trust.views[0].ground_open == 0


def test_sky_on_a_sheet_is_found_by_the_recorded_image_and_not_trusted(tmp_path):
    drive = recorded(open_street(), tmp_path)
    empty = judge_view(drive, drive.frames[0].cameras["front"].scaled(0.25), 0)
    assert empty.sky_covered is not None and empty.sky_covered < 0.01
    pane = with_sheet(drive)
    (camera_trust,) = judge_scene(pane, cameras=["front"], count=1).cameras
    assert camera_trust.views[0].sky_covered > 0.03
    assert any(
        "% of the image, has a surface nearer than 200 m" in text for text in camera_trust.problems
    )
    camera = pane.frames[camera_trust.views[0].frame].cameras["front"].scaled(0.25)
    assert mean_trust(drive, camera) - mean_trust(pane, camera) > 0.01


def test_hardly_any_sky_is_not_judged_and_the_share_is_said(tmp_path):
    """A pale wall is taken for sky where an image shows little of it."""
    camera = camera_ahead(128, 96, 60.0)
    scene = Scene(
        "wall", "test:", screen(20.0), (), ConstantSky(torch.zeros(3)),
        (Frame(0, 0, torch.eye(4, dtype=torch.float64), {"ahead": camera}),),
    )  # fmt: skip
    said = []
    for rows in (4, 30):
        rgb = np.full((96, 128, 3), 90, np.uint8)
        rgb[rows:] -= np.random.default_rng(0).integers(0, 60, (96 - rows, 128, 3), np.uint8)
        rgb[:rows] = 230
        path = tmp_path / f"{rows}.png"
        cv2.imwrite(str(path), rgb)
        frame = dataclasses.replace(scene.frames[0], image_paths={"ahead": str(path)})
        drive = dataclasses.replace(scene, frames=(frame,))
        (camera_trust,) = judge_scene(drive, count=1).cameras
        assert camera_trust.views[0].sky == pytest.approx(rows / 96, abs=0.03)
        assert camera_trust.views[0].sky_covered > 0.3
        said += [text for text in camera_trust.problems if "of the sky" in text]
    (text,) = said
    assert "of the sky, which is 29 % of the image, has a surface nearer than 200 m" in text


def test_what_images_from_elsewhere_contradict_is_believed_less(tmp_path):
    cameras = [
        camera_ahead(64, 48, 60.0, position=(0.0, 1.5 * n, 0.0), timestamp_ns=n) for n in range(5)
    ]
    frames = []
    for n, camera in enumerate(cameras):
        path = tmp_path / f"{n}.png"
        cv2.imwrite(str(path), np.full((48, 64, 3), 77, np.uint8))  # too dark for a sky
        pose = torch.eye(4, dtype=torch.float64)
        frames.append(Frame(n, n, pose, {"ahead": camera}, {"ahead": str(path)}))
    grey = screen(20.0)
    bar = one_gaussian((9.0, 0.0, 0.0), scale=(0.05, 0.3, 3.0), opacity=0.99, rgb=(1.0,) * 3)
    scene = Scene("bar", "test:", stack(grey, bar), (), ConstantSky(torch.zeros(3)), tuple(frames))
    mask = trust_mask(scene, cameras[0])
    assert mask[24, 32] < 0.4 * 255 and (mask[:, :20] == 255).all()
    alone = dataclasses.replace(scene, background=grey)
    assert (trust_mask(alone, cameras[0]) == 255).all()
    unknown = tuple(dataclasses.replace(frame, image_paths={}) for frame in frames)
    assert (trust_mask(dataclasses.replace(scene, frames=unknown), cameras[0]) == 255).all()


def test_cameras_that_were_never_fitted_are_named_and_left_out():
    scene = fitted(open_street(), scale=0.25, cameras=("front", "left"))
    assert unfitted_cameras(scene) == ("front_left", "front_right", "right", "back")
    assert unfitted_cameras(open_street()) == ()
    trust = judge_scene(scene, cameras=["front", "back"], scale=0.5, count=1)
    front, back = trust.cameras
    assert not back.views and "never fitted" in back.problems[0]
    assert any("2.0 times as large" in text for text in front.problems)
    record = SceneRecord.of(scene, "street", 0.0)
    assert SceneRecord.from_json(record.to_json(), "here") == record
    recipes = [load_recipe("clear").resolve(0)]
    assert cut_into_blocks(record, recipes)[0].cameras == ("front", "left")
    assert len(cut_into_blocks(record, recipes, cameras=("all",))[0].cameras) == 6
    assert cut_into_blocks(record, recipes, cameras=("back",))[0].cameras == ("back",)


def test_fits_of_before_there_was_a_record_tell_by_their_settings():
    street = open_street()
    settings = {"scale": 0.5, "cameras": "front,back", "holdout": "every-2nd"}
    old = source_views(dataclasses.replace(street, made_by={"settings": settings}))
    assert old.is_fit and {view.frame for view in old.views} == {street.frames[0].index}
    assert old.names == ("front", "back") and old.views[0].camera.width == 480
    for damaged in ({"scale": -1, "views": {}}, {"views": 3}, "front"):
        assert not source_views(dataclasses.replace(street, made_by={"fitted": damaged})).is_fit


def test_only_what_was_seen_from_near_enough_is_trusted():
    scene = fitted(open_street())
    cameras = scene.frames[0].cameras
    # Trust falls smoothly with the logarithm of the magnification: a half at 2.
    for scale, least, most in (
        (0.25, 0.98, 1),
        (0.3, 0.9, 0.98),
        (0.5, 0.45, 0.55),
        (1.0, 0, 0.05),
    ):
        assert least <= mean_trust(scene, cameras["front"].scaled(scale)) <= most
    assert mean_trust(scene, cameras["back"].scaled(0.25)) < 0.05
    nearest = nearest_view(source_views(scene), cameras["front"])
    assert nearest.magnification == pytest.approx(4) and nearest.magnification > MAX_MAGNIFICATION


def wall(x_m: float) -> Gaussians:
    return one_gaussian((x_m, 0.0, 0.0), scale=(0.05, 3.0, 3.0), opacity=0.999)


@pytest.mark.parametrize(("walls", "trusted"), [((10.0,), True), ((5.0, 10.0), False)])
def test_what_stood_behind_something_else_was_not_seen(walls, trusted):
    camera = camera_ahead(64, 48, 60.0)
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"ahead": camera})
    background = stack(*map(wall, walls))
    scene = Scene("walls", "test:", background, (), ConstantSky(torch.zeros(3)), (frame,))
    behind = camera_ahead(32, 24, 15.0, position=(7.0, 0.0, 0.0), timestamp_ns=5)
    assert trust_mask(scene, behind)[12, 16] == 255 * trusted


def test_a_camera_path_is_judged_by_what_the_scene_was_made_from(tmp_path):
    street = fitted(open_street(), cameras=("front", "back"))
    poses = [frame.cameras["front"].world_from_camera.clone() for frame in street.frames]
    for pose in poses:
        pose[1, 3] += 5.0
    path = tmp_path / "cameras.json"
    entry = {"width": 96, "height": 54, "fx": 60.0, "fy": 60.0}
    path.write_text(
        json.dumps([
            {"id": i, "img_name": str(i), **entry,
             "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
            for i, pose in enumerate(poses)
        ])
    )  # fmt: skip
    moved = with_camera_path(street, path)
    assert len(source_views(moved).views) == 4
    (camera_trust,) = judge_scene(moved, count=1).cameras
    assert camera_trust.away and "stand away from all images" in camera_trust.problems[0]
    save_scene(moved, tmp_path / "saved")
    again = load_scene_parts(tmp_path / "saved")
    assert [f.index for f in again.seen_frames] == [f.index for f in street.frames]
    assert len(source_views(again).views) == 4
    save_scene(street, tmp_path / "plain")  # older versions read what has no such frames
    assert "seen_frames" not in (tmp_path / "plain/scene.json").read_text()
    nowhere = dataclasses.replace(street, made_by={}, seen_frames=())
    assert "no camera that it was made from is known" in judge_scene(nowhere, count=1).unknown[0]


def small_recipe(**output) -> Recipe:
    return changed(
        load_recipe("dense-fog").resolve(0),
        {"render.scale": 0.1, "output.depth": "none", "output.lidar": False}
        | {f"output.{name}": value for name, value in output.items()},
    )


def run(out: Path, scene: Scene, recipe: Recipe, **options):
    job = RenderJob("street", [recipe], out, cameras=["front"], **options)
    return run_job(job, scene_loader=lambda _: scene, progress=False)


def test_a_job_writes_the_mask_and_its_share_and_the_dataset_reads_them(tmp_path):
    street, recipe = open_street(), small_recipe(trust=True)
    assert run(tmp_path, street, recipe).written == 2
    rows = read_manifest(tmp_path).to_pylist()
    for row, sample in zip(rows, WeatherDataset(tmp_path), strict=True):
        mask = cv2.imread(str(tmp_path / row["trust_path"]), cv2.IMREAD_UNCHANGED)
        camera = street.frame(row["frame"]).cameras["front"].scaled(0.1)
        np.testing.assert_array_equal(mask, trust_mask(street, camera))
        assert row["trusted_fraction"] == pytest.approx(mask.mean() / 255) and mask.mean() > 0.9
        np.testing.assert_array_equal(sample["trust"].numpy(), mask.astype(np.float32) / 255)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.png")}
    (tmp_path / rows[0]["trust_path"]).unlink()
    again = run(tmp_path, street, recipe)
    assert (again.written, again.skipped) == (1, 1)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.png")} == before
    assert str(read_manifest(tmp_path).to_pylist()) == str(rows)  # NaN is not equal to itself


def test_without_being_asked_there_is_no_mask_and_no_share(tmp_path):
    recipe = small_recipe()
    assert recipe.hash == changed(recipe, {"output.trust": False}).hash
    assert recipe.hash != small_recipe(trust=True).hash
    run(tmp_path, open_street(), recipe, frames=[0])
    (row,) = read_manifest(tmp_path).to_pylist()
    assert row["trusted_fraction"] is None and row["trust_path"] is None
    assert item_paths("street", recipe, "front", 0)["trust"] is None
    assert WeatherDataset(tmp_path)[0]["trust"] is None


def test_extremes_give_figures_and_no_nan():
    camera = camera_ahead(40, 30, 20.0)
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"ahead": camera})
    for background in (
        one_gaussian((0.0, 0.0, 0.0), scale=5.0, opacity=0.99),  # around the camera
        one_gaussian((-5.0, 0.0, 0.0)),  # nothing in view
        one_gaussian((9e6, 0.0, 0.0), scale=9e6),
    ):
        scene = Scene("one", "test:", background, (), ConstantSky(torch.zeros(3)), (frame,))
        view = judge_view(scene, camera, 0)
        assert 0 <= view.ground_open <= view.ground_leaks <= 1
        assert trust_mask(scene, camera).shape == (30, 40)
    lost = Track(torch.tensor([0]), torch.full((1, 4, 4), math.nan, dtype=torch.float64))
    actor = Actor("a", "car", background, lost, (4.0, 2.0, 1.5))
    broken = judge_scene(dataclasses.replace(scene, actors=(actor,)))
    assert "frame 0 cannot be drawn" in broken.problems[0]
    no_up = dataclasses.replace(scene, has_known_gravity=False)
    assert judge_view(no_up, camera, 0).ground_open is None


@pytest.mark.long
def test_masks_do_not_depend_on_workers_or_order(tmp_path):
    """The graph cut's colours begin at random: in every thread and process alike."""
    drive = recorded(open_street(), tmp_path)
    masks = []
    for name, options in {"one": {}, "two": {"workers": 2}, "late": {"frames": [1]}}.items():
        run(tmp_path / name, drive, small_recipe(trust=True), **options)
        rows = read_manifest(tmp_path / name).to_pylist()
        masks.append({r["frame"]: (tmp_path / name / r["trust_path"]).read_bytes() for r in rows})
    assert masks[0] == masks[1] and masks[2] == {1: masks[0][1]}
