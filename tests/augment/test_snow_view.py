"""Snow in finished views, in labels, and on a street whose true surface is known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from adapters.base import open_scene, parse_uri
from adapters.procedural import open_truth
from augment.effects.snow.snowy_boxes import count_snow_pixels
from augment.errors import SceneError
from augment.exposure.search import ExposureSettings, find_exposed_surface
from augment.metrics.consistency import DepthView, find_warp
from augment.scene.boxes import SIDE_MARGIN_M
from augment.scene.labels import Boxes
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers, render_view
from recipes.flood import Flood, Waves
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.snow import Snow
from tests.augment.box_views import (
    CAR_M,
    UPRIGHT,
    boxes_at_random,
    count_by_hand,
    make_boxes,
    make_camera,
    placed,
    plane_depth,
)
from tests.snow_scenes import box_car, drive, sheet, side_wall, splats, stack_all
from tools.bench.scenes import all_cameras
from tools.bench.snow_truth import (
    camera_from_above,
    cells_over,
    pixel_positions,
    snow_accuracy,
    support_heights,
    true_points,
    without_movers,
)

ROAD, BUILDING, CAR = (int(SemanticClass[name]) for name in ("ROAD", "BUILDING", "VEHICLE"))
DEPTH_M, CELL_M = 0.1, 0.1


class NoBoxes:
    """Labels of a drive on which nothing was labelled."""

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> None:
        return None


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A road, a wall beside it with a flat roof on it, and a car that drives away."""
    ground = sheet((-2.0, 24.0), (-4.0, 4.0), semantic=ROAD)
    wall = side_wall(4.0, (2.0, 24.0), (0.0, 1.0))
    wall = dataclasses.replace(wall, semantic=torch.full((len(wall),), BUILDING).short())
    roof = sheet((2.0, 24.0), (4.0, 8.0), 1.0, semantic=BUILDING)
    car = box_car(start=(8.0, -2.0), moved_m=3.0, size=(3.0, 1.8, 1.0), semantic=CAR)
    return drive(ground, wall, roof, actors=[car], labels=NoBoxes())


def snow(**options) -> Snow:
    return Snow(**({"depth_m": DEPTH_M, "cell_m": CELL_M, "tracks": "never"} | options))


def recipe_of(weather_snow: Snow | None = None, *, smog=None, flood=None, **output) -> Recipe:
    weather = Weather(snow=weather_snow, smog=smog, flood=flood)
    return Recipe(weather=weather, output=Output(**({"semantic": True} | output)))


def view_of(scene: Scene, weather_snow: Snow | None = None, frame=0, backend="auto", **options):
    camera = scene.frames[frame].cameras["ahead"]
    return render_view(scene, camera, recipe_of(weather_snow, **options), backend=backend)


def heights_of(view) -> np.ndarray:
    """World z of every pixel's surface, NaN where there is none."""
    rays = view.camera.ray_directions(torch.float64)[..., 2].numpy()
    z = float(view.camera.centre[2]) + view.depth_m * rays
    return np.where(view.depth_m > 0, z, np.nan)


def test_snow_lies_on_the_road_the_roof_and_the_car(scene):
    clean, white = view_of(scene, instance=True), view_of(scene, snow(), instance=True)
    lies = white.masks["snow"] == 255
    assert set(np.unique(white.masks["snow"])) == {0, 255}
    for kind in (ROAD, CAR):
        class_mask = clean.semantic == kind
        assert class_mask.sum() > 50
    assert lies[clean.semantic == ROAD].mean() > 0.9
    assert (white.semantic[lies] == SemanticClass.SNOW).mean() > 0.98
    assert not lies[clean.semantic == SemanticClass.SKY][:200].any()
    on_car = lies & (white.instance == 1)
    assert on_car.sum() > 10  # the roof's, which is part of the car
    ground = lies & (white.instance == 0)
    brighter = white.rgb[ground].mean() - clean.rgb[ground].mean()
    assert brighter > 40


def test_depth_is_that_of_the_snow(scene):
    bare, white = view_of(scene), view_of(scene, snow())
    near = (bare.semantic == ROAD) & (white.masks["snow"] == 255) & (bare.depth_m < 12)
    assert near.sum() > 1000
    rise = (heights_of(white) - heights_of(bare))[near]
    assert np.median(rise) == pytest.approx(DEPTH_M, abs=0.02)


def test_the_cars_snow_drives_with_it(scene):
    for frame in (0, 1):
        view = view_of(scene, snow(), frame=frame, instance=True, surface="solid")
        on_car = (view.masks["snow"] == 255) & (view.instance == 1)
        x = float(view.camera.centre[0]) + view.depth_m[on_car]
        rear = 8.0 - 1.5 + 3.0 * frame
        assert on_car.sum() > 10
        low, high = np.percentile(x, [10, 90])  # the rest are pixels at its edges
        assert rear - 0.1 < low and high < rear + 3.1
        assert np.median(heights_of(view)[on_car]) > 1.0


@pytest.mark.parametrize("nothing", [{"depth_m": 0.0}, {"coverage": 0.0}])
def test_snow_of_no_depth_is_the_clean_view_to_the_bit(scene, nothing):
    clean, white = view_of(scene, instance=True), view_of(scene, snow(**nothing), instance=True)
    for name in ("rgb", "depth_m", "semantic", "instance"):
        assert np.array_equal(getattr(clean, name), getattr(white, name))
    assert not white.masks["snow"].any() and white.effects["snow"].depth_m is None
    assert not clean.masks and not clean.effects


def test_images_of_the_bare_surface_are_those_of_the_clean_scene(scene):
    clean = view_of(scene, instance=True)
    white = view_of(scene, snow(), instance=True, surface="scene")
    for name in ("depth_m", "semantic", "instance"):
        assert np.array_equal(getattr(clean, name), getattr(white, name))
    assert white.masks["snow"].any() and not np.array_equal(clean.rgb, white.rgb)
    solid = view_of(scene, snow(), instance=True)
    assert np.array_equal(solid.rgb, white.rgb) and np.array_equal(
        solid.masks["snow"], white.masks["snow"]
    )
    lies = white.masks["snow"] == 255
    off = np.abs(white.effects["snow"].depth_m - solid.depth_m)[lies] / solid.depth_m[lies]
    assert np.quantile(off, 0.9) < 0.05  # expected depth for the labels, median in the image


@pytest.mark.parametrize("shading", ["per_splat", "per_pixel"])
def test_both_backends_show_the_same_snow(scene, shading):
    plan = make_plan(recipe_of(snow(shading=shading, cell_m=0.2)), scene)
    camera = scene.frames[0].cameras["ahead"].scaled(0.5)
    fast, slow = (
        render_buffers(scene, camera, plan, backend=name) for name in ("cpu", "reference")
    )
    difference = (fast.rgb - slow.rgb).abs().amax(-1)
    # The sums of some hundred splats in another order; a flip at a cut-off is 1/255 at most.
    assert float(difference.quantile(0.99)) < 1e-3 and float(difference.max()) < 2e-2
    assert float((fast.masks["snow"] != slow.masks["snow"]).float().mean()) < 1e-3


@pytest.mark.parametrize("model", ["per_gaussian", "deferred"])
def test_fog_lies_over_the_snow(scene, model):
    fog = Smog(extinction_per_m=0.2, color=(0.5, 0.5, 0.5), model=model)
    clear = view_of(scene, snow())
    foggy = view_of(scene, snow(), smog=fog, semantic=False, depth="none")
    assert np.array_equal(clear.masks["snow"], foggy.masks["snow"])
    lies = (clear.masks["snow"] == 255) & (clear.depth_m > 3)
    t = np.exp(-0.2 * clear.depth_m * clear.camera.ray_lengths().numpy())[..., None]
    expected = t * clear.rgb + (1 - t) * 0.5 * 255
    assert np.median(np.abs(foggy.rgb - expected)[lies]) < 3


def test_water_melts_the_snow_it_reaches_and_mirrors_the_rest(scene):
    flood = Flood(level_m=0.3, reference="absolute", waves=Waves(preset="still"))
    wet = view_of(scene, snow(), flood=flood, surface="first")
    water, lies = wet.masks["water"] == 255, wet.masks["snow"] == 255
    assert water.any() and lies.any()
    assert not (water & lies).any()
    assert (wet.semantic[water] == SemanticClass.WATER).all()
    heights = heights_of(wet)[lies]
    assert np.nanmin(heights) > 0.3  # of the road's snow nothing is left
    dry = view_of(scene, snow(), flood=flood.model_copy(update={"level_m": -0.5}), surface="first")
    plain = view_of(scene, snow(), surface="first")
    covered = plain.semantic != SemanticClass.SKY  # beyond the sheets the water shows
    assert np.median(np.abs(dry.rgb.astype(int) - plain.rgb)[covered]) == 0
    assert (dry.masks["snow"] != plain.masks["snow"]).mean() < 0.005


def test_scenes_without_metres_or_gravity_are_refused_before_anything_is_rendered(scene):
    for lacks in ({"has_metric_scale": False}, {"has_known_gravity": False}):
        with pytest.raises(SceneError, match="metres and gravity"):
            make_plan(recipe_of(snow()), dataclasses.replace(scene, **lacks))
    make_plan(recipe_of(snow(depth_m=0.0)), dataclasses.replace(scene, has_metric_scale=False))


# ---- labels --------------------------------------------------------------------------------------

ALL = np.full((106, 160), 255, np.uint8)


@pytest.mark.parametrize("thickness_m", [0.0, 1e-4, 0.02, 0.3, 10.0])
def test_pixels_are_those_counted_one_by_one(thickness_m: float) -> None:
    rng = np.random.default_rng(5)
    boxes, camera = boxes_at_random(rng), make_camera(pitch=0.15)
    depth = rng.uniform(-1, 25, (106, 160)).clip(0).astype(np.float32)
    snow = np.where(rng.random((106, 160)) < 0.4, 255, 0).astype(np.uint8)
    extents = []
    for size in boxes.sizes_m:
        low, high = -size / 2 - SIDE_MARGIN_M, size / 2 + SIDE_MARGIN_M
        bottom = max(min(0.08, size[2] / 4), min(thickness_m + 0.05, size[2] * 3 / 4))
        low[2] = -size[2] / 2 + bottom
        high[2] = size[2] / 2 + max(0.10, 1.5 * thickness_m + 0.05)
        extents.append((low, high))
    got = count_snow_pixels(placed(boxes), camera, depth, snow, thickness_m)
    pixels, marked = count_by_hand(boxes, extents, camera, depth, snow)
    assert sum(p > 0 for p in pixels) > 30 and sum(marked) > 0
    np.testing.assert_array_equal(got.num_pixels, pixels)
    np.testing.assert_array_equal(got.num_marked, marked)


@pytest.mark.parametrize("thickness_m", [0.02, 0.1, 0.3])
def test_snow_on_the_roof_is_the_cars_and_snow_around_its_wheels_is_not(thickness_m: float) -> None:
    boxes = make_boxes(((8, 0, 0.75), CAR_M, UPRIGHT))  # from the road to 1.5 m
    high = dataclasses.replace(make_camera(pitch=0.5), camera_from_world=raised(4.0, 0.5))
    roof = plane_depth(high, 1.5 + thickness_m)
    got = count_snow_pixels(placed(boxes), high, roof, ALL, thickness_m)
    assert got.num_pixels[0] == got.num_marked[0] > 300
    # Drifts on the roof are half as deep again.
    drift = plane_depth(high, 1.5 + 1.5 * thickness_m)
    assert count_snow_pixels(placed(boxes), high, drift, ALL, thickness_m).num_pixels[0] > 300
    ground = plane_depth(high, thickness_m)
    assert count_snow_pixels(placed(boxes), high, ground, ALL, thickness_m).num_pixels[0] == 0


@pytest.mark.parametrize("resolution", [0.5, 1.0, 2.0])
def test_the_snowy_part_is_that_of_the_cap(resolution: float) -> None:
    """A face straight ahead, 2 m high and bare, with 40 cm of snow on it."""
    camera = dataclasses.replace(make_camera(), cx=80.0, cy=53.0).scaled(resolution)
    boxes = make_boxes(((10, 0, 1.0), (1, 2, 2), UPRIGHT))  # face at x = 9.5 m, from 0 to 2 m
    rays = camera.ray_directions(torch.float64).numpy()
    z = 1.6 + 9.5 * rays[..., 2]
    depth = np.where(z < 2.4, 9.5, 0).astype(np.float32)  # the snow's top, and sky
    snow = np.where(z > 2.0, 255, 0).astype(np.uint8)
    got = count_snow_pixels(placed(boxes), camera, depth, snow, 0.4)
    expected = 0.4 / (2.4 - 0.45)  # the lowest 45 cm stand in snow
    # Each edge is off by half a pixel, of the 20 that the face has at resolution 1.
    assert got.num_marked[0] / got.num_pixels[0] == pytest.approx(expected, abs=1 / 20 / resolution)


def raised(height_m: float, pitch: float) -> torch.Tensor:
    """camera_from_world of a camera at (0, 0, height_m), looking along +x and down by pitch."""
    pose = make_camera(pitch=pitch).camera_from_world.clone()
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0, 0, height_m], dtype=torch.float64)
    return pose


# ---- a street whose true surface is known --------------------------------------------------------

STREET = "procedural:street?seed=3&frames=2&gaussians=110000&parked=4&moving=1&pedestrians=1"
STREET_CELL_M, REACH_M = 0.1, 10.0


@pytest.fixture(scope="module")
def true_street():
    return open_scene(STREET)


@pytest.fixture(scope="module")
def found(true_street):
    return snow_accuracy(
        true_street,
        open_truth(parse_uri(STREET)[2]),
        cell_m=STREET_CELL_M,
        reach_m=REACH_M,
        pixel_m=0.1,
        depths_m=(0.02, 0.1),
        estimators=("mode", "expected"),
    )


@pytest.fixture(scope="module")
def mode(found):
    return found["estimators"][0]


@pytest.mark.long
def test_open_flat_and_seen_ground_is_covered(mode):
    assert mode["covered"] >= 0.96
    assert all(share is None or share >= 0.95 for share in mode["rings"].values())
    for row in mode["depths"]:
        assert row["covered"] >= 0.95  # pixels of 10 cm, half of which may be something else


@pytest.mark.long
def test_little_lies_where_the_sky_is_not_seen(mode):
    assert all(row["sheltered"] <= 0.01 for row in mode["depths"])


@pytest.mark.long
def test_snow_is_as_high_as_its_depth(found, mode):
    for row in mode["depths"]:
        assert row["error_on_scene_m"]["median"] <= 0.2 * row["depth_m"] + 0.01
    assert abs(mode["error_m"]["bias"] - found["scene_bias_m"]) < 0.01
    assert mode["error_m"]["p95"] < 0.06


@pytest.mark.long
def test_mode_depth_beats_expected_depth(found):
    mode, expected = found["estimators"]
    assert (mode["estimator"], expected["estimator"]) == ("mode", "expected")
    assert mode["covered"] > expected["covered"] + 0.03
    assert mode["error_m"]["median"] < 0.8 * expected["error_m"]["median"]
    for ours, theirs in zip(mode["depths"], expected["depths"], strict=True):
        assert ours["error_m"]["p95"] < 0.8 * theirs["error_m"]["p95"]


@pytest.mark.long
def test_floaters_do_not_lift_the_snow(true_street):
    """A thin veil a metre and a half above the road: it takes a fifth of the light from above."""
    spacing = 0.3
    x, y = np.meshgrid(np.arange(-6.0, 6.0, spacing), np.arange(-5.0, 2.0, spacing))
    count = x.size
    means = np.stack([x.ravel(), y.ravel(), np.full(count, 1.5)], 1)
    veil = splats(means, (0.2, 0.2, 0.2), semantic=SemanticClass.UNKNOWN, opacity=0.08)
    background = stack_all([true_street.background, veil])
    veiled = dataclasses.replace(true_street, background=background)
    cameras = all_cameras(true_street)
    above = camera_from_above(cameras, reach_m=REACH_M, pixel_m=0.3)
    truth = without_movers(open_truth(parse_uri(STREET)[2]))
    points = true_points(truth, cameras, pixel_positions(above).reshape(-1, 2), reach_m=REACH_M)
    under = (np.abs(points.xy[:, 0]) < 5) & (points.xy[:, 1] > -4) & (points.xy[:, 1] < 1)
    open_points = points.select(under & points.is_seen & (points.slope < math.radians(30)))
    cells = find_exposed_surface(veiled, cameras, ExposureSettings(cell_m=0.2)).ground
    assert (cells_over(cells, open_points) >= 0).any()
    assert np.nanmedian(np.abs(support_heights(cells, open_points) - open_points.z)) < 0.06


RING = ("front", "front_right", "right", "back", "left", "front_left")  # cameras, clockwise


@pytest.mark.long
@pytest.mark.parametrize("shading", ["per_splat", "per_pixel"])
def test_neighbouring_views_agree_on_the_snow(true_street, shading):
    """Neighbours, and a camera and itself a frame ahead, at the points that both views show."""
    snow = Snow(depth_m=DEPTH_M, cell_m=STREET_CELL_M, shading=shading)
    output = Output(depth="expected", labels=False)
    plan = make_plan(Recipe(weather=Weather(snow=snow), output=output), true_street)

    def draw(frame, name):
        camera = true_street.frame(frame).cameras[name].scaled(0.25)
        camera = dataclasses.replace(camera, timestamp_ns=true_street.frame(0).timestamp_ns)
        drawn = render_buffers(true_street, camera, plan)
        images = drawn.rgb.clamp(0, 1), drawn.raster.expected_depth, drawn.raster.alpha
        return DepthView(camera, *(i.numpy() for i in images)), drawn.masks["snow"].numpy()

    now = [draw(0, name) for name in RING]
    ahead = [draw(1, name) for name in RING]
    for others in ([*now[1:], now[0]], ahead):
        is_same, squares = zip(*map(compare_snow, now, others), strict=True)
        assert sum(map(len, is_same)) > 5000
        assert np.concatenate(is_same).mean() >= 0.985
        assert 255 * math.sqrt(np.concatenate(squares).mean()) < 9


def compare_snow(first, second):
    """Where both masks say the same, and squared colour differences where both are snow."""
    (view, mask), (other_view, other_mask) = first, second
    warp = find_warp(view, other_view)
    images = np.concatenate([other_view.picture, other_mask[..., None]], -1)
    warped = warp.sample(images)[warp.is_counted]
    is_same = mask[warp.is_counted] == (warped[:, 3] > 0.5)
    both = mask[warp.is_counted] & is_same
    return is_same, (view.picture[warp.is_counted][both] - warped[both, :3]) ** 2
