"""What cameras need of a plan: nothing that shows is left out, and what does not show is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment import views as apply
from augment.bounds import Bounds, bound_chunks, may_show
from augment.cameras import Camera
from augment.geometry import rigid, rotmat_from_quat
from augment.plan import ViewPlan, make_plan, plan_view
from augment.render.constants import RasterSettings
from augment.render.reference import half_extents, project_parts
from augment.scene import Ground, PosedGaussians, Scene
from augment.views import render_buffers, render_view
from recipes.flood import Flood, Waves
from recipes.schema import Output, Recipe, Weather
from recipes.snow import Snow
from tests.scenes import camera_ahead, random_gaussians, random_pose
from tests.snow_scenes import box_car, cameras_of, drive, sheet, side_wall

IMAGES = Output(depth="expected", labels=False)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A short road with cars ahead, behind and beside, seen all around from two places."""
    road = sheet((-2.0, 20.0), (-4.0, 4.0), semantic=1)
    wall = side_wall(4.0, (2.0, 20.0), (0.0, 1.0))
    cars = [
        box_car(start=start, moved_m=2.0, size=(3.0, 1.8, 1.0), track_id=str(start))
        for start in ((8.0, -2.0), (-9.0, 0.0), (1.0, -9.0), (0.0, 12.0))
    ]
    level = Ground(0.0, 0.0, "stated", None, 0, None)
    return dataclasses.replace(
        drive(road, wall, actors=cars), ground=level, ground_z_m=0.0, source="test:around"
    )


def around(camera: Camera) -> list[Camera]:
    """The camera turned to all sides, up and down."""
    eye, found = camera.centre, []
    for turns, pitch in ((0, 0), (0, 0.7), (1, -0.9), (2, 0), (2, -0.9), (3, 0.7)):
        yaw = turns * np.pi / 2
        level = camera_ahead(80, 46, 40.0, position=eye.tolist(), yaw=yaw)
        half = torch.tensor([np.cos(pitch / 2), np.sin(pitch / 2), 0, 0], dtype=torch.float64)
        turned = rotmat_from_quat(half) @ level.camera_from_world[:3, :3]
        pose = rigid(turned, -turned @ eye)
        found.append(dataclasses.replace(level, camera_from_world=pose))
    return found


def everything(plan, scene: Scene, camera: Camera, **_) -> ViewPlan:
    """Nothing left out of the plan."""
    actors = tuple(range(1, len(scene.actors) + 1))
    active = tuple(dataclasses.replace(own, seen=(0, *actors)) for own in plan.active(scene))
    return ViewPlan(actors, active, plan.buffers, plan.bare_buffers, plan.steps)


WEATHERS = {
    "clean": Weather(),
    "flood": Weather(flood=Flood(level_m=0.3, waves=Waves(preset="wind"))),
    "snow": Weather(snow=Snow(depth_m=0.1, cell_m=0.2)),
    "both": Weather(
        flood=Flood(level_m=0.05, reflection="screen_space"), snow=Snow(depth_m=0.1, cell_m=0.2)
    ),
}


@pytest.mark.parametrize("name", WEATHERS)
def test_what_is_left_out_changes_no_bit(scene, monkeypatch, name):
    surface = "scene" if name == "snow" else "solid"
    output = IMAGES.model_copy(update={"surface": surface})
    recipe = Recipe(weather=WEATHERS[name], output=output)
    plan = make_plan(recipe, scene)
    cameras = around(scene.frames[0].cameras["ahead"])
    left_out = 0
    for camera in cameras:
        view = plan_view(plan, scene, camera)
        left_out += (
            len(scene.actors) - len(view.actors) + (name == "snow" and "snow" not in view.names)
        )
        lean = render_view(scene, camera, recipe)
        with monkeypatch.context() as patched:
            patched.setattr(apply, "plan_view", everything)
            full = render_view(scene, camera, recipe)
        assert np.array_equal(lean.rgb, full.rgb) and np.array_equal(lean.depth_m, full.depth_m)
        assert lean.masks.keys() == full.masks.keys()
        assert all(np.array_equal(lean.masks[n], full.masks[n]) for n in full.masks)
    assert left_out > len(cameras)


def test_actors_keep_their_numbers(scene):
    """The car ahead is the first; looking back, the second is seen and the first is not."""
    plan = make_plan(Recipe(output=Output(depth="none")), scene)
    front, back = (camera_ahead(80, 46, 40.0, position=(0, 0, 1.5), yaw=yaw) for yaw in (0, np.pi))
    assert plan_view(plan, scene, front).actors == (1,)
    view = render_buffers(scene, back, plan)
    assert view.plan.actors == (2,) and [part.instance_id for part in view.parts] == [0, 2]
    [step] = [s for s in view.plan.steps if s.name == "rasterise"]
    assert "1 of 4 actors (0 absent at this time, 3 out of view)" in step.why


def test_reasons_are_the_cameras(scene):
    recipe = Recipe(weather=WEATHERS["both"], output=IMAGES)
    plan = make_plan(recipe, scene)
    up = around(cameras_of(scene)[0])
    views = [plan_view(plan, scene, camera) for camera in up]
    away = [view for view in views if not view.names]
    assert away and len(away) < len(views)
    for view in away:
        assert {s.name for s in view.steps if s.runs} == {"rasterise", "sky", "depth image"}
        assert view.buffers == {"rgb", "alpha", "expected_depth"}
    reasons = {s.name: s.why for s in away[0].steps}
    assert reasons["flood: bed"] == "no ray of this camera meets the water's plane"
    assert "can be in view" in reasons["snow: placement and layer"]
    assert views[0].names == ("snow", "flood")


def orthographic(camera: Camera) -> Camera:
    return dataclasses.replace(camera, is_orthographic=True, fx=6.0, fy=5.0)


@pytest.mark.parametrize("kind", ["pinhole", "wide", "orthographic"])
def test_a_gaussian_that_touches_the_image_is_never_out_of_view(kind):
    """Places all around the camera, through its plane and at all its edges; 1 mm to 9 m."""
    rng, count = np.random.default_rng(3), 2000
    camera = camera_ahead(33, 21, 4.0 if kind == "wide" else 30.0)
    camera = orthographic(camera) if kind == "orthographic" else camera
    pose = random_pose(5, (0.3, -0.2, 0.1))
    means = rng.uniform(-1, 1, (count, 3)) * 10 ** rng.uniform(-2, 1.3, (count, 1))
    g = random_gaussians(count, sh_degree=0)
    g = dataclasses.replace(
        g,
        means=torch.from_numpy(means).float(),
        scales=torch.from_numpy(10 ** rng.uniform(-3, 0.95, (count, 3))).float(),
        opacities=torch.from_numpy(rng.choice([0.01, 0.5, 1.0], count)).float(),
    )
    each = Bounds(means.astype(np.float32).astype(float), np.zeros((count, 3)),
        g.scales.numpy().max(1).astype(float), np.zeros(count, int))  # fmt: skip
    may = may_show(each, pose.numpy(), camera, 0.01)
    splats = project_parts([PosedGaussians(g, pose)], camera, RasterSettings(), with_color=False)
    low, high = splats.means2d - half_extents(splats), splats.means2d + half_extents(splats)
    size = torch.tensor([camera.width, camera.height])
    touches = ((torch.ceil(low - 0.5) <= high - 0.5) & (high >= 0.5) & (low <= size - 0.5)).all(1)
    shown = np.zeros(count, bool)
    shown[splats.ids[touches].numpy()] = True
    assert may[shown].all()
    assert shown.sum() > 200 and (~may).sum() > 200
    # One box around neighbours is in view wherever one of them is.
    groups = bound_chunks(g, np.ones(count, bool), 1.0)
    squares = np.floor(g.means.numpy()[:, :2].astype(float) / 1.0).astype(int)
    numbers = np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1)
    assert may_show(groups, pose.numpy(), camera, 0.01)[numbers[may]].all()
