"""Snow that grows and melts from image to image, laid once a scene."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment.effects.snow.changing_kernels import ChangingCells
from augment.effects.snow.changing_snow import (
    GRASS_COVERING_DEPTH_M,
    changing_cells,
    define_snow,
    find_depths_at,
    laid_plan,
    state_of,
)
from augment.effects.snow.effect import build_changing_layers
from augment.effects.snow.lidar import find_lidar_snow
from augment.effects.snow.plan import SnowPlan, exposure_settings
from augment.exposure.exposed_surface import exposed_surface_of
from augment.render.buffers import CPU, REFERENCE
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.render_view import render_view
from recipes.schema import Output, Recipe, Weather
from recipes.snow import HARD_COVERING_DEPTH_M, Snow, SnowRoad
from tests.snow_scenes import box_car, drive, sheet

ROAD, GRASS, CAR = (int(SemanticClass[name]) for name in ("ROAD", "TERRAIN", "VEHICLE"))
LAID_M = 0.05
PLACES = tuple((float(x), 0.0, 1.5) for x in range(0, 12, 2))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A road along x with grass on both sides, and a car that drives ahead."""
    return drive(
        sheet((-4.0, 24.0), (-4.0, 4.0), semantic=ROAD),
        sheet((-4.0, 24.0), (4.0, 12.0), semantic=GRASS, rgb=(0.2, 0.4, 0.1)),
        sheet((-4.0, 24.0), (-12.0, -4.0), semantic=GRASS, rgb=(0.2, 0.4, 0.1)),
        actors=[box_car(start=(8.0, -2.0), moved_m=3.0, size=(3.0, 1.8, 1.0), semantic=CAR)],
        places=PLACES,
    )


def snow(depth_m: float, road_m: float | None = None, **fields) -> Snow:
    road = None if road_m is None else SnowRoad(depth_m=road_m, **fields.pop("road", {}))
    options = {"placed_depth_m": LAID_M, "cell_m": 0.1, "tracks": "never", **fields}
    return Snow(depth_m=depth_m, road=road, **options)


def _camera(scene: Scene, frame: int = 0) -> Camera:
    return next(iter(scene.frames[frame].cameras.values()))


def recipe_of(weather_snow: Snow) -> Recipe:
    return Recipe(weather=Weather(snow=weather_snow), output=Output(semantic=True))


def view_of(scene: Scene, weather_snow: Snow, **options):
    return render_view(scene, _camera(scene), recipe_of(weather_snow), **options)


def cells_of(scene: Scene, weather_snow: Snow) -> ChangingCells:
    plan = laid_plan(SnowPlan(weather_snow, 7))
    surface = exposed_surface_of(scene, exposure_settings(plan.snow, scene))
    return changing_cells(surface.ground, None, scene, plan)


def test_the_kernel_is_its_definition(scene: Scene) -> None:
    for weather_snow in (
        snow(0.02, 0.005, traffic=0.6, road={"driven": 0.7}),
        snow(0.001),
        snow(0.05, coverage=0.5),
    ):
        cells = cells_of(scene, weather_snow)
        state = state_of(weather_snow)
        shares, depths_m = define_snow(cells, state)
        by_kernel = find_depths_at(cells, state)
        is_sure = np.abs(shares - 0.5) > 1e-3  # tables are interpolated
        expected_m = np.where(shares >= 0.5, depths_m, 0)
        np.testing.assert_allclose(by_kernel[is_sure], expected_m[is_sure], atol=1e-6)


def test_the_layer_is_laid_once_for_all_depths(scene: Scene) -> None:
    first, second = (
        build_changing_layers(scene, SnowPlan(snow(depth_m, depth_m / 2), 7))
        for depth_m in (0.004, 0.05)
    )
    assert first is second


def test_the_white_share_grows_with_depth_first_on_grass_where_roads_are_warm(scene: Scene) -> None:
    cells = cells_of(scene, snow(0.01, 0.002))
    is_road = (cells.road > 0.99) & (cells.depths_m > 0)
    is_grass = (cells.soft > 0.99) & (cells.depths_m > 0)
    before = (0.0, 0.0)
    for depth_m, road_m in ((0.004, 0.0), (0.01, 0.001), (0.02, 0.01), (0.05, 0.04)):
        share, _ = define_snow(cells, state_of(snow(depth_m, road_m)))
        means = (share[is_grass].mean(), share[is_road].mean())
        assert means > before
        before = means
        # thin snow shines through, and the noise of a small scene has a share of its own
        assert means[0] == pytest.approx(-np.expm1(-depth_m / GRASS_COVERING_DEPTH_M), abs=0.12)
        assert means[1] == pytest.approx(-np.expm1(-road_m / HARD_COVERING_DEPTH_M), abs=0.12)
    assert before[1] > 0.95


def test_snow_of_the_laid_depth_is_the_layer_as_it_was_laid(scene: Scene) -> None:
    layers = build_changing_layers(scene, SnowPlan(snow(LAID_M), 7))
    laid = layers.laid.ground.gaussians
    scaled = layers.at(snow(LAID_M)).ground.gaussians
    is_covered = scaled.opacities > 0.97
    assert is_covered.float().mean() > 0.75  # all but grass, of which 8 % shows
    for name in ("means", "scales", "sh"):
        a, b = (getattr(g, name)[is_covered] for g in (laid, scaled))
        # all but the rims of grass that shows
        assert torch.quantile((a - b).abs().flatten()[::7], 0.99) < 2e-3


def test_no_snow_changes_no_bit_and_a_little_more_changes_little(scene: Scene) -> None:
    clear = render_view(scene, _camera(scene), Recipe())
    assert np.array_equal(view_of(scene, snow(0.0)).rgb, clear.rgb)
    for depth_m in (0.0, 0.0003, 0.004, 0.012, 0.03):
        road_m = depth_m / 2
        now, next_ = (
            view_of(scene, snow(depth_m + step_m, road_m + step_m / 2)).rgb.astype(int)
            for step_m in (0.0, 2e-5)
        )
        # a popping disc changes its pixels by a hundred levels
        assert np.abs(next_ - now).max() <= 4
        assert np.abs(next_ - now).mean() < 0.1


@pytest.mark.parametrize(("depth_m", "missing_share"), [(0.006, 0.12), (0.01, 0.05)])
def test_splats_larger_than_cells_do_not_hide_the_snow_behind_their_centres(
    scene: Scene, depth_m: float, missing_share: float
) -> None:
    dry, thin, deep = (view_of(scene, snow(d)) for d in (0.0, depth_m, LAID_M))
    is_road = dry.semantic == ROAD
    light, whitened, white = (view.rgb.astype(float)[is_road].mean() for view in (dry, thin, deep))
    cells = cells_of(scene, snow(depth_m))
    shares, _ = define_snow(cells, state_of(snow(depth_m)))
    share = shares[(cells.road > 0.99) & (cells.depths_m > 0)].mean()
    # Splats before the snow hide some of it where it has gaps: twice as much if one bare cell
    # kept them whole.
    assert share - missing_share < (whitened - light) / (white - light) < share + 0.02


def test_what_views_leave_out_changes_no_bit(scene: Scene) -> None:
    layers = build_changing_layers(scene, SnowPlan(snow(0.02), 7))
    camera = _camera(scene, 2)
    everything = layers.at(snow(0.02))
    in_view = layers.at(snow(0.02), (camera,))
    assert len(in_view.ground.gaussians) < len(everything.ground.gaussians)
    rendered = [_colors(layer.parts_for(scene, camera), camera) for layer in (everything, in_view)]
    assert torch.equal(*rendered)


def _colors(parts, camera) -> torch.Tensor:
    rgb = rasterize(parts, camera, buffers=frozenset({"rgb"}), backend=CPU).rgb
    assert rgb is not None
    return rgb


def test_a_view_is_the_same_alone_and_by_the_definition(scene: Scene) -> None:
    weather_snow = snow(0.015, 0.004, traffic=0.5, road={"wetness": 0.8, "driven": 0.5})
    first = view_of(scene, weather_snow, backend=CPU)
    view_of(scene, snow(0.04, 0.03), backend=CPU)
    assert np.array_equal(view_of(scene, weather_snow, backend=CPU).rgb, first.rgb)
    other = dataclasses.replace(scene)
    assert np.array_equal(view_of(other, weather_snow, backend=CPU).rgb, first.rgb)
    levels = view_of(scene, weather_snow, backend=REFERENCE).rgb.astype(int) - first.rgb
    assert np.abs(levels).max() <= 1  # backends round in other orders


def test_depth_mask_and_sweeps_follow_the_depth(scene: Scene) -> None:
    deep = find_lidar_snow(scene, SnowPlan(snow(0.05), 7)).ground
    thin = find_lidar_snow(scene, SnowPlan(snow(0.02), 7)).ground
    none = find_lidar_snow(scene, SnowPlan(snow(0.0), 7)).ground
    assert deep is not None and thin is not None and none is None
    tops = [np.median(grid.top[np.isfinite(grid.top)]) for grid in (thin, deep)]
    assert tops[1] == pytest.approx(0.05, abs=0.006) and tops[0] == pytest.approx(0.02, abs=0.004)
    shares = [view_of(scene, snow(d)).masks["snow"].mean() for d in (0.002, 0.01, 0.05)]
    assert shares == sorted(shares) and shares[0] < shares[2] / 2


def test_traffic_bares_tracks_as_its_cars_drive(scene: Scene) -> None:
    cells = cells_of(scene, snow(0.03, 0.03, traffic=0.8))
    bare = []
    for driven in (0.0, 0.1, 0.4, 1.0):
        state = state_of(snow(0.03, 0.03, traffic=0.8, road={"driven": driven}))
        share, _ = define_snow(cells, state)
        bare.append(float((share[cells.road > 0.99] < 0.1).mean()))
    assert bare == sorted(bare) and bare[0] < 0.02 and bare[-1] > 0.15


def test_melt_wets_the_road_and_not_the_grass() -> None:
    scene = drive(
        sheet((-4.0, 24.0), (-4.0, 4.0), semantic=ROAD),
        sheet((-4.0, 24.0), (4.0, 12.0), semantic=GRASS),
        places=PLACES,
    )
    camera = _camera(scene)
    dry, wet = (
        render_view(scene, camera, recipe_of(snow(0.0, 0.0, road={"wetness": w}))).rgb.mean(2)
        for w in (0.0, 1.0)
    )
    classes = render_view(scene, camera, recipe_of(snow(0.0))).semantic
    change = wet.astype(float) - dry
    assert change[classes == ROAD].mean() < -5
    assert np.abs(change[classes == GRASS]).mean() < 1.5  # only beside the kerb
