"""Snow in finished views: what images and masks show, alone and with other weather."""

import dataclasses

import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.labels import Boxes
from augment.plan import make_plan
from augment.scene import Scene
from augment.semantics import SemanticClass
from augment.views import render_buffers, render_view
from recipes.flood import Flood, Waves
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.snow import Snow
from tests.snow_scenes import box_car, drive, sheet, side_wall

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
    wall = dataclasses.replace(wall, semantic=torch.full((len(wall),), BUILDING, dtype=torch.int16))
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
        seen = clean.semantic == kind
        assert seen.sum() > 50
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
    t = np.exp(-0.2 * clear.depth_m * view_lengths(clear))[..., None]
    expected = t * clear.rgb + (1 - t) * 0.5 * 255
    assert np.median(np.abs(foggy.rgb - expected)[lies]) < 3


def view_lengths(view) -> np.ndarray:
    return view.camera.ray_lengths().numpy()


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
