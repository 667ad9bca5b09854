"""Plans carried out, on scenes small enough to know what every pixel must show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment.effects.snow.effect import SnowView
from augment.render.constants import RasterSettings
from augment.render.reference import half_extents, project_parts
from augment.scene.bounds import Bounds, bound_squares, may_show
from augment.scene.boxes import instances_of
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid, rotmat_from_quat
from augment.scene.labels import Boxes
from augment.scene.scene import Actor, Gaussians, Ground, PosedGaussians, Scene, Track
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky, CubemapSky
from augment.view import render_view as apply
from augment.view.box_labels import measure_boxes
from augment.view.plan import ViewPlan, make_plan, plan_view
from augment.view.render_view import render_buffers, render_view
from recipes.flood import Flood, Waves
from recipes.schema import Output, Recipe, Render, Smog, Weather
from recipes.snow import Snow
from tests.scenes import camera_ahead, random_gaussians, random_pose
from tests.snow_scenes import box_car, drive, sheet, side_wall

C0 = 0.28209479177387814  # Y_00
SKY = (0.3, 0.5, 0.9)
AIRLIGHT = (0.7, 0.7, 0.7)


def wall(depth: float, left: float, right: float, rgb: tuple[float, float, float], semantic: int):
    """Flat opaque splats side by side, facing a camera that looks along +y from the origin."""
    x = torch.arange(left, right, 0.05)
    z = torch.arange(-3.0, 3.0, 0.05)
    xx, zz = torch.meshgrid(x, z, indexing="ij")
    count = xx.numel()
    means = torch.stack([xx.reshape(-1), torch.full((count,), depth), zz.reshape(-1)], -1)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[0.05, 0.001, 0.05]]).repeat(count, 1),
        opacities=torch.full((count,), 0.999),
        sh=((torch.tensor(rgb) - 0.5) / C0).expand(count, 1, 3).contiguous(),
        semantic=torch.full((count,), semantic, dtype=torch.int16),
    )


def camera() -> Camera:
    """World x right, y forward, z up: camera x = world x, y = -world z, z = world y."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    return Camera("front", 64, 48, 60.0, 60.0, 32.0, 24.0, pose, timestamp_ns=0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A building to the left at 10 m, a car (an actor) in its middle at 5 m, sky to the right."""
    background = wall(10.0, -8.0, 0.0, (0.8, 0.2, 0.1), int(SemanticClass.BUILDING))
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, 3] = torch.tensor([-1.0, 5.0, 0.0], dtype=torch.float64)
    body = wall(0.0, -0.6, 0.6, (0.1, 0.9, 0.1), int(SemanticClass.VEHICLE))
    low = body.select(body.means[:, 2].abs() < 0.6)
    car = Actor("car", "Car", low, Track(torch.tensor([0]), pose), (1.2, 0.1, 1.2))
    view = camera()
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"front": view})
    sky = ConstantSky(torch.tensor(SKY))
    return Scene("toy", "test:toy", background, (car,), sky, (frame,), ground_z_m=-2.0)


class CarLabels:
    """The car, and another behind the building."""

    def boxes(self, frame_index: int) -> Boxes:
        places = np.array([[-1.0, 5, 0], [-3, 20, 0]])
        sizes, turns = np.full((2, 3), 1.2), np.array([[1.0, 0, 0, 0]] * 2)
        return Boxes(("car", "hidden"), ("Car", "Car"), places, sizes, turns)

    def lidar(self, frame_index: int) -> None:
        return None


BUILDING, CAR, NOTHING = (10, 4), (24, 20), (24, 60)  # row, column


def view_of(scene: Scene, smog: Smog | None = None, **output):
    recipe = Recipe(weather=Weather(smog=smog), output=Output(**output))
    return render_view(scene, camera(), recipe)


def test_the_clean_view_shows_wall_car_and_sky(scene):
    view = view_of(scene, depth="median", semantic=True, instance=True)
    # One grey level of rounding, and up to 1 % of what lies behind shines through (0.3 % of 255).
    assert np.abs(view.rgb[BUILDING] - np.array([204, 51, 26])).max() <= 3
    assert np.abs(view.rgb[CAR] - np.array([26, 230, 26])).max() <= 3
    assert view.rgb[NOTHING].tolist() == [77, 128, 230]
    assert view.depth_m[BUILDING] == pytest.approx(10, abs=1e-3)
    assert view.depth_m[CAR] == pytest.approx(5, abs=1e-3)
    assert view.depth_m[NOTHING] == 0
    assert view.semantic[BUILDING] == SemanticClass.BUILDING
    assert view.semantic[CAR] == SemanticClass.VEHICLE
    assert view.semantic[NOTHING] == SemanticClass.SKY
    assert [int(view.instance[p]) for p in (BUILDING, CAR, NOTHING)] == [0, 1, 0]


@pytest.mark.parametrize("model", ["per_gaussian", "deferred"])
def test_smog_fades_each_surface_by_its_own_distance(scene, model):
    view = view_of(scene, Smog(extinction_per_m=0.1, color=AIRLIGHT, model=model))
    cam = camera()
    for pixel, depth, rgb in ((BUILDING, 10.0, (0.8, 0.2, 0.1)), (CAR, 5.0, (0.1, 0.9, 0.1))):
        t = np.exp(-0.1 * depth * float(cam.ray_lengths()[pixel]))
        expected = 255 * (t * np.array(rgb) + (1 - t) * np.array(AIRLIGHT))
        # The nearest splat centre is up to 3.5 cm of 10 m off the pixel: 0.1 grey levels.
        assert np.abs(view.rgb[pixel] - expected).max() <= 3
    assert view.rgb[NOTHING].tolist() == [179, 179, 179]  # no sky through uniform smog


def test_boxes_are_measured_by_the_surfaces_in_the_smog(scene):
    """The pixels of a car in the smog are mixed with the airlight as its label says."""
    smog = Smog(extinction_per_m=0.1, color=AIRLIGHT)
    labelled = dataclasses.replace(scene, labels=CarLabels())
    view, clean = view_of(labelled, smog, depth="none"), view_of(scene)
    assert view.depth_m is None and view.effects["smog"].water_level_z_m is None
    instances = instances_of(labelled)
    measured = measure_boxes(CarLabels().boxes(0), instances, np.zeros(3), camera(), view)
    measured = measured["box_smog"]
    assert measured["pixels"][0] > 100 and measured["pixels"][1] == 0
    t = (view.rgb[CAR] - 255 * AIRLIGHT[0]) / (clean.rgb[CAR] - 255 * AIRLIGHT[0])
    assert measured["transmittance"][0] == pytest.approx(t.mean(), abs=0.01)  # of 8-bit colours
    # Behind the wall that the camera sees.
    assert measured["transmittance"][1] == pytest.approx(np.exp(-0.1 * np.hypot(3, 20)), rel=0.01)


def test_thin_haze_shows_the_zenith_and_hides_the_horizon(scene):
    blue = CubemapSky(torch.tensor(SKY).expand(6, 4, 4, 3).contiguous())
    empty = dataclasses.replace(scene, sky=blue)
    haze = Smog(extinction_per_m=0.02, color=AIRLIGHT, scale_height_m=20.0)
    rgb = view_of(empty, haze).rgb[:, 60].astype(int)  # a column of sky, from the top downwards
    assert (np.diff(rgb[:24, 2]) <= 0).all()  # blue fades towards the horizon
    assert rgb[0, 2] > rgb[23, 2] + 10
    assert rgb[24:].tolist() == [[179, 179, 179]] * 24  # rays that do not climb never leave it


def test_a_camera_exposes_what_the_weather_left(scene):
    """Weather first, colour map last: smog, sky and surfaces alike go through the map."""
    matrix = torch.tensor([[0.5, 0.0, 0.0, 0.1], [0.0, 0.8, 0.1, 0.0], [0.0, 0.0, 0.6, 0.2]])
    mapped = dataclasses.replace(scene, color_maps={"front": matrix})
    for smog in (None, Smog(visibility_m=30)):
        recipe = Recipe(weather=Weather(smog=smog))
        plain = render_buffers(scene, camera(), make_plan(recipe, scene))
        expected = plain.rgb @ matrix[:, :3].T + matrix[:, 3]
        plan = make_plan(recipe, mapped)
        for backend in ("cpu", "reference"):
            got = render_buffers(mapped, camera(), plan, backend=backend)
            # Backends differ in the order of sums, as in the test of both backends above.
            assert float((got.rgb - expected).abs().quantile(0.99)) < 1e-4
        fast = render_buffers(mapped, camera(), plan)
        assert torch.equal(fast.raster.rgb, plain.raster.rgb)
        assert torch.equal(fast.depth_m, plain.depth_m)


def test_without_a_map_of_its_own_a_camera_keeps_every_bit(scene):
    clean = view_of(scene)
    dark = torch.eye(3, 4) * 0.5
    mapped_scene = dataclasses.replace(scene, color_maps={"rear": dark, "front": torch.eye(3, 4)})
    assert np.array_equal(view_of(mapped_scene).rgb, clean.rgb)
    neutral = Recipe(render=Render(exposure="neutral"))
    mapped = dataclasses.replace(scene, color_maps={"front": dark})
    assert np.array_equal(render_view(mapped, camera(), neutral).rgb, clean.rgb)
    assert not np.array_equal(view_of(mapped).rgb, clean.rgb)


# ---- what cameras need of a plan -----------------------------------------------------------------

IMAGES = Output(depth="expected", labels=False)


@pytest.fixture(scope="module")
def surrounded() -> Scene:
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
    eye, cameras = camera.centre, []
    for turns, pitch in ((0, 0), (0, 0.7), (1, -0.9), (2, 0), (2, -0.9), (3, 0.7)):
        yaw = turns * np.pi / 2
        level = camera_ahead(80, 46, 40.0, position=eye.tolist(), yaw=yaw)
        half = torch.tensor([np.cos(pitch / 2), np.sin(pitch / 2), 0, 0], dtype=torch.float64)
        turned = rotmat_from_quat(half) @ level.camera_from_world[:3, :3]
        pose = rigid(turned, -turned @ eye)
        cameras.append(dataclasses.replace(level, camera_from_world=pose))
    return cameras


def everything(plan, scene: Scene, camera: Camera, **_) -> ViewPlan:
    """Nothing left out of the plan."""
    actors = tuple(range(1, len(scene.actors) + 1))
    in_view = SnowView(frozenset((0, *actors)), tuple(around(camera)))
    active = tuple(
        dataclasses.replace(effect, view_data=in_view) for effect in plan.active_effects(scene)
    )
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
def test_what_is_left_out_changes_no_bit(surrounded, monkeypatch, name):
    surface = "scene" if name == "snow" else "solid"
    output = IMAGES.model_copy(update={"surface": surface})
    recipe = Recipe(weather=WEATHERS[name], output=output)
    plan = make_plan(recipe, surrounded)
    cameras = around(surrounded.frames[0].cameras["ahead"])
    num_left_out = 0
    for camera in cameras:
        view = plan_view(plan, surrounded, camera)
        num_left_out += (
            len(surrounded.actors)
            - len(view.actor_ids)
            + (name == "snow" and "snow" not in view.effect_names)
        )
        lean = render_view(surrounded, camera, recipe)
        with monkeypatch.context() as patched:
            patched.setattr(apply, "plan_view", everything)
            full = render_view(surrounded, camera, recipe)
        assert np.array_equal(lean.rgb, full.rgb) and np.array_equal(lean.depth_m, full.depth_m)
        assert lean.masks.keys() == full.masks.keys()
        assert all(np.array_equal(lean.masks[n], full.masks[n]) for n in full.masks)
    assert num_left_out > len(cameras)


def test_actors_keep_their_numbers(surrounded):
    """The car ahead is the first; looking back, the second is seen and the first is not."""
    plan = make_plan(Recipe(output=Output(depth="none")), surrounded)
    front, back = (camera_ahead(80, 46, 40.0, position=(0, 0, 1.5), yaw=yaw) for yaw in (0, np.pi))
    assert plan_view(plan, surrounded, front).actor_ids == (1,)
    view = render_buffers(surrounded, back, plan)
    assert view.plan.actor_ids == (2,) and [part.instance_id for part in view.parts] == [0, 2]
    [step] = [s for s in view.plan.steps if s.name == "rasterise"]
    assert "1 of 4 actors (0 absent at this time, 3 out of view)" in step.why


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
    bounds_of_each = Bounds(means.astype(np.float32).astype(float), np.zeros((count, 3)),
        g.scales.numpy().max(1).astype(float), np.zeros(count, int))  # fmt: skip
    may = may_show(bounds_of_each, pose.numpy(), camera, 0.01)
    splats = project_parts([PosedGaussians(g, pose)], camera, RasterSettings(), with_color=False)
    low, high = splats.means2d - half_extents(splats), splats.means2d + half_extents(splats)
    size = torch.tensor([camera.width, camera.height])
    touches = ((torch.ceil(low - 0.5) <= high - 0.5) & (high >= 0.5) & (low <= size - 0.5)).all(1)
    is_shown = np.zeros(count, bool)
    is_shown[splats.ids[touches].numpy()] = True
    assert may[is_shown].all()
    assert is_shown.sum() > 200 and (~may).sum() > 200
    # One box around neighbours is in view wherever one of them is.
    groups = bound_squares(g, np.ones(count, bool), 1.0)
    squares = np.floor(g.means.numpy()[:, :2].astype(float) / 1.0).astype(int)
    numbers = np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1)
    assert may_show(groups, pose.numpy(), camera, 0.01)[numbers[may]].all()
