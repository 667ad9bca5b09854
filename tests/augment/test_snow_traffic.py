"""Traces of traffic and dirt in the snow: lanes, bare and wet tracks, slush, colours."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from augment.effects.snow.depth import find_depths, profile_on_part
from augment.effects.snow.effect import WET_PASS, build_snow_layers
from augment.effects.snow.lidar import find_lidar_snow
from augment.effects.snow.plan import SnowPlan, exposure_settings
from augment.effects.snow.slush import road_snow
from augment.effects.snow.traffic import (
    GRID_M,
    LANE_WIDTH_M,
    STEP_M,
    WheelPoints,
    count_passes,
    find_road_wear,
    paint_cells,
)
from augment.effects.snow.wet_tracks import make_wet_road, rough_reflectance, wet_tracks
from augment.exposure.exposed_surface import exposed_surface_of
from augment.exposure.wheel_tracks import WheelPath, find_wheel_paths, parallel_path
from augment.render.fog import Fog
from augment.render.sh import SH_C0
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.rain import Rain
from recipes.schema import Recipe, Smog, Weather
from recipes.snow import Snow
from tests.scenes import camera_ahead
from tests.snow_scenes import box_car, drive, sheet, stack_all

ROAD = int(SemanticClass.ROAD)
SIDEWALK = int(SemanticClass.SIDEWALK)
ROAD_HALF_M = 5.0  # three lanes of 3.3 m
WHEEL_M = 0.8  # from the middle of a lane to the wheels
PLACES = tuple((float(x), 0.0, 1.5) for x in range(0, 12, 2))


@pytest.fixture(scope="module")
def street() -> Scene:
    """A road of three lanes along x with pavements; the ego drives in the middle lane."""
    return drive(
        sheet((-4.0, 30.0), (-ROAD_HALF_M, ROAD_HALF_M), semantic=ROAD),
        sheet((-4.0, 30.0), (ROAD_HALF_M, ROAD_HALF_M + 4), 0.1, semantic=SIDEWALK),
        sheet((-4.0, 30.0), (-ROAD_HALF_M - 4, -ROAD_HALF_M), 0.1, semantic=SIDEWALK),
        places=PLACES,
    )


def snow(**fields) -> Snow:
    return Snow(depth_m=0.05, cell_m=0.1, **fields)


def traces_of(scene: Scene, *, seed: int = 7, **fields):
    """Cells of the ground, depths of fresh snow on them, and the traces."""
    plan = SnowPlan(snow(**fields), seed)
    cells = exposed_surface_of(scene, exposure_settings(plan.snow, scene)).ground
    profile, rng = profile_on_part(None, scene, plan.snow, plan.seed, None)
    depths = find_depths(cells, profile, rng.integers(0, 2**64, dtype=np.uint64))
    return cells, depths, road_snow(depths, cells, scene, plan)


def near(cells, y_m: float, width_m: float = 0.3) -> np.ndarray:
    """Mask of cells along a line of this y, ahead of the ego."""
    x, y, _ = cells.centers_m.numpy().T
    return (np.abs(y - y_m) < width_m / 2) & (x > 6) & (x < 22)


# ---- Where cars drive ----------------------------------------------------------------------------


def test_a_line_of_wheels_is_one_pass_in_its_middle_and_none_a_tyre_beside():
    along = np.arange(0.0, 10.0, STEP_M)
    for angle in (0.0, 0.4, math.pi / 4):
        xy = np.stack([along * math.cos(angle), along * math.sin(angle)], 1)
        points = WheelPoints(xy + 1.0, np.ones(len(xy)))
        passes = count_passes(points, np.zeros(2), (260, 260))
        middle = np.floor((xy[30:70] + 1.0) / GRID_M).astype(int)
        beside = xy[30:70] + 1.0 + 0.35 * np.array([-math.sin(angle), math.cos(angle)])
        beside = np.floor(beside / GRID_M).astype(int)
        # Cells of 5 cm lie up to 3.5 cm beside the line, half a standard deviation.
        assert 0.85 < passes[middle[:, 1], middle[:, 0]].mean() < 1.05
        assert passes[beside[:, 1], beside[:, 0]].max() < 0.02


def test_cells_are_painted_where_they_lie():
    centers = np.array([[0.1, 0.1], [0.5, 0.3], [9.0, 9.0]])
    mask = paint_cells(centers, np.array([0.2, 0.2, 0.2]), np.zeros(2), 0.1, (6, 8))
    expected = np.zeros((6, 8), bool)
    expected[0:2, 0:2] = True
    expected[2:4, 4:6] = True
    assert np.array_equal(mask, expected)


def test_a_parallel_path_keeps_its_distance_in_a_bend():
    angle = np.linspace(0, math.pi / 2, 200)
    bend = WheelPath(np.stack([20 * np.cos(angle), 20 * np.sin(angle), 0 * angle], 1), 1.9)
    inner = parallel_path(bend, 3.0).points_m
    assert np.abs(np.linalg.norm(inner[:, :2], axis=1) - 17.0).max() < 0.01


def test_cars_drive_in_all_lanes_of_the_road_and_on_no_pavement(street):
    cells, _, _ = traces_of(street)
    wear = find_road_wear(
        cells, find_wheel_paths(street), traffic=0.8, seed=1, scene_name="a street"
    )
    for lane in (-1, 0, 1):
        wheels, middle = (
            np.mean([wear.passes[near(cells, lane * LANE_WIDTH_M + y)].mean() for y in offsets])
            for offsets in ((-WHEEL_M, WHEEL_M), (0.0,))
        )
        # Three quarters of the cars of a lane pass here; they wander by 0.2 m.
        assert wheels > 4 and middle < 0.4 * wheels
    classes = cells.semantic.numpy()
    assert not wear.passes[classes == SIDEWALK].any()
    assert not wear.is_road[classes == SIDEWALK].any()
    assert np.median(wear.kerb_m[near(cells, 0.0)]) > 2
    for distance_m in (0.5, -0.5):
        kerb = near(cells, ROAD_HALF_M - distance_m, 0.12)
        assert abs(np.median(wear.kerb_m[kerb]) - distance_m) < 0.2  # splats of 20 cm


def test_tracks_cross_where_a_vehicle_of_the_scene_crosses(street):
    across = box_car(start=(14.0, -4.0), moved_m=0.0, with_shadow=False, track_id="crossing")
    turned = across.track.world_from_actor.clone()
    turned[:, :2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    turned[1, 1, 3] = 4.0
    track = dataclasses.replace(across.track, world_from_actor=turned)
    vehicles = torch.full((len(across.gaussians),), int(SemanticClass.VEHICLE)).short()
    gaussians = dataclasses.replace(across.gaussians, semantic=vehicles)
    across = dataclasses.replace(across, track=track, gaussians=gaussians)
    scene = dataclasses.replace(street, actors=(across,))
    cells, _, _ = traces_of(street)
    x, y, _ = cells.centers_m.numpy().T
    at_crossing = (np.abs(np.abs(x - 14.0) - 0.75) < 0.15) & (np.abs(np.abs(y) - 1.65) < 0.3)
    with_car, without = (
        find_road_wear(cells, find_wheel_paths(s), traffic=0.5, seed=1, scene_name="a street")
        for s in (scene, street)
    )
    assert with_car.passes[at_crossing].mean() > without.passes[at_crossing].mean() + 2


def test_without_a_path_nobody_drives_and_dirt_still_lies_on_the_road(street):
    scene = dataclasses.replace(street, seen_frames=())
    cells, depths, traces = traces_of(scene, traffic=1.0, dirt=1.0, tracks="auto")
    assert np.array_equal(traces.depths.depths_m > 0, depths.depths_m > 0)
    assert not traces.wetness.any()
    is_road = cells.semantic.numpy() == ROAD
    assert traces.tints[is_road].mean() < 0.95


# ---- Depth, wetness, colour ----------------------------------------------------------------------


def test_more_traffic_bares_more_of_the_road(street):
    shares, volumes = [], []
    for traffic in (0.0, 0.3, 0.6, 1.0):
        cells, depths, traces = traces_of(street, traffic=traffic, dirt=0.1)
        is_road = cells.semantic.numpy() == ROAD
        shares.append(float((traces.depths.depths_m[is_road] == 0).mean()))
        volumes.append(float(traces.depths.depths_m[is_road].mean()))
        beside = cells.semantic.numpy() == SIDEWALK
        assert np.array_equal(traces.depths.depths_m[beside], depths.depths_m[beside])
        assert traces.depths.depths_m.max() < 0.12  # 5 cm with drifts, and a ridge of 3.5 cm
    assert shares[0] == 0 and shares == sorted(shares) and shares[-1] > 0.3
    assert volumes == sorted(volumes, reverse=True)


def test_bare_tracks_are_wet_and_slush_lies_beside_them(street):
    cells, _, traces = traces_of(street, traffic=1.0)
    depths_m = traces.depths.depths_m
    assert not traces.wetness[depths_m > 0].any()
    track, ridge = (near(cells, y) for y in (WHEEL_M, 0.0))
    assert (depths_m[track] == 0).mean() > 0.8 and traces.wetness[track].mean() > 0.6
    assert (depths_m[ridge] > 0).mean() > 0.6
    # The scraper leaves 0.6 of 5 cm; wheels on both sides push slush onto the middle.
    assert depths_m[ridge & (depths_m > 0)].mean() > 0.02


def test_dirt_is_grey_brown_on_the_road_and_nowhere_far_from_it(street):
    cells, _, traces = traces_of(street, dirt=1.0)
    red, green, blue = traces.tints.T
    is_road = cells.semantic.numpy() == ROAD
    assert (red >= green).all() and (green >= blue).all()
    assert 0.6 < red[is_road].mean() < 0.85 and traces.tints.min() > 0.5
    _, y, _ = cells.centers_m.numpy().T
    far = np.abs(y) > ROAD_HALF_M + 1.6
    assert far.any() and (traces.tints[far] == 1).all()
    kerb, lane = (near(cells, y) for y in (ROAD_HALF_M - 0.15, 2 * WHEEL_M))
    assert red[kerb].mean() < red[lane].mean() - 0.05  # most of it lies at the kerb


def test_roofs_and_cars_over_the_road_stay_clean(street):
    """Also what lies within a metre of the road, seen from above."""
    roof = sheet((8.0, 14.0), (ROAD_HALF_M - 1, ROAD_HALF_M + 3), 3.0, semantic=6)
    low = dataclasses.replace(street, background=stack_all([street.background, roof]))
    cameras = {"ahead": camera_ahead(160, 90, 80.0, position=(-4.0, 4.0, 6.0))}
    frame = dataclasses.replace(low.frames[0], index=99, cameras=cameras)
    cells, _, traces = traces_of(
        dataclasses.replace(low, frames=(*low.frames, frame)), dirt=1.0, traffic=1.0
    )
    is_roof = cells.centers_m[:, 2].numpy() > 2
    assert is_roof.sum() > 100 and (traces.tints[is_roof] == 1).all()
    assert (traces.depths.depths_m[is_roof] > 0).all()


def test_snow_without_traces_keeps_its_bits_and_its_hash(street):
    assert traces_of(street)[2] is None
    recipe = Recipe(weather=Weather(snow=Snow(depth_m=0.05)))
    explicit = Recipe(weather=Weather(snow=Snow(depth_m=0.05, dirt=0.0, traffic=0.0)))
    traced = Recipe(weather=Weather(snow=Snow(depth_m=0.05, traffic=0.5)))
    assert recipe.hash == explicit.hash != traced.hash
    with pytest.raises(ValidationError):
        Snow(depth_m=0.05, traffic=1.2)


def test_traces_are_of_seed_and_place_alone(street):
    def layers(seed: int):
        scene = dataclasses.replace(street)  # nothing is remembered of another one
        return build_snow_layers(scene, SnowPlan(snow(traffic=0.7, dirt=0.5), seed))

    first, again, other = layers(1), layers(1), layers(2)
    assert torch.equal(first.ground.gaussians.sh, again.ground.gaussians.sh)
    assert torch.equal(first.ground.gaussians.means, again.ground.gaussians.means)
    assert torch.equal(first.wet_road.wetness, again.wet_road.wetness)
    assert len(first.ground.gaussians) != len(other.ground.gaussians)


def test_lit_and_shaded_colours_are_dirty_alike(street):
    """Per pixel, base and slope have the factors of the snow that is lit splat by splat."""
    clean, dirty = (
        build_snow_layers(street, SnowPlan(snow(dirt=d, shading="per_pixel", tracks="never"), 3))
        for d in (0.0, 0.8)
    )
    base = (dirty.ground.gaussians.sh[:, 0] * SH_C0 + 0.5) / (
        clean.ground.gaussians.sh[:, 0] * SH_C0 + 0.5
    )
    lit = clean.ground.sunlight_rgb > 0.02
    slope = dirty.ground.sunlight_rgb[lit] / clean.ground.sunlight_rgb[lit]
    assert float((slope - base[lit]).abs().max()) < 1e-3 and float(base.min()) < 0.8


def test_lidar_finds_no_snow_in_bare_tracks(street):
    plan = SnowPlan(snow(traffic=1.0), 7)
    grid = find_lidar_snow(street, plan).ground
    cells, _, traces = traces_of(street, traffic=1.0)
    track = near(cells, WHEEL_M) & (traces.depths.depths_m == 0)
    cell = np.floor((cells.centers_m.numpy()[track, :2] - grid.corner) / grid.cell_m).astype(int)
    # A cell of the grid takes the highest of the cells that touch it.
    assert np.isneginf(grid.top[cell[:, 1], cell[:, 0]]).mean() > 0.8


# ---- The picture ---------------------------------------------------------------------------------


def picture(scene: Scene, **weather):
    recipe = Recipe(weather=Weather(**weather))
    plan = make_plan(recipe, scene)
    return render_buffers(scene, scene.frames[0].cameras["ahead"], plan, backend="cpu"), plan


def test_wet_road_is_known_where_it_is_bare_and_at_its_height(street):
    cells, _, traces = traces_of(street, traffic=1.0)
    road = make_wet_road(cells, traces.wetness)
    wet = torch.from_numpy(traces.wetness > 0.9)
    on_road = road.sample(cells.centers_m[wet])
    assert float((on_road > 0.5).float().mean()) > 0.9
    assert not road.sample(cells.centers_m[wet] + torch.tensor([0.0, 0.0, 0.5])).any()
    assert not road.sample(cells.centers_m[wet] + torch.tensor([500.0, 0.0, 0.0])).any()
    assert make_wet_road(cells, np.zeros(len(cells), np.float32)) is None


def test_bare_road_in_tracks_is_darker_than_dry_road_and_shines_far_away(street):
    traced, plan = picture(street, snow=snow(traffic=1.0))
    clear, _ = picture(street)
    assert next(step for step in plan.steps if step.name == WET_PASS).runs
    bare = (traced.raster.overlay < 0.01) & (clear.raster.alpha > 0.99)
    changed = bare & ((traced.rgb - clear.rgb).abs().amax(-1) > 0.02)
    rows = torch.arange(len(bare))[:, None]
    close = changed & (rows > 62)  # 12 degrees below the horizon and steeper
    assert int(close.sum()) > 30
    assert float((traced.rgb - clear.rgb)[close].mean()) < -0.05
    cosines = torch.tensor([1.0, 0.5, 0.2, 0.05])
    sheen = rough_reflectance(cosines)
    assert bool((sheen.diff() > 0).all()) and 0 < float(sheen[0]) < 0.01 < float(sheen[-1]) < 0.2


def test_fog_lies_before_the_wet_road(street):
    """In fog that lets nothing through, no track is wet."""
    fog = Smog(visibility_m=4.0)
    traced, _ = picture(street, snow=snow(traffic=1.0), smog=fog)
    plain, _ = picture(street, smog=fog)
    far = (traced.raster.expected_depth > 12) & (traced.raster.alpha > 0.9)
    assert bool(far.any()) and float((traced.rgb - plain.rgb).abs()[far].max()) < 2 / 255


def test_wet_ground_leaves_no_track_to_wet_twice(street):
    rain = Rain(rate_mm_h=0, wetness=0.8)
    _, plan = picture(street, snow=snow(traffic=1.0), rain=rain)
    step = next(step for step in plan.steps if step.name == WET_PASS)
    assert not step.runs and "rain" in step.why


FOGS = [
    None,
    Fog(0.02, (0.7, 0.72, 0.75)),
    Fog(0.03, (0.7, 0.72, 0.75), scale_height_m=3.0, base_z_m=0.2),
    Fog(0.05, (0.7, 0.6, 0.5), elevation_gain=0.8, varying_airlight_rgb=(0.5, 0.5, 0.4)),
]


@pytest.mark.parametrize("fog", FOGS)
def test_the_kernel_wets_tracks_as_the_definition_does(street, fog):
    cells, _, traces = traces_of(street, traffic=1.0)
    road = make_wet_road(cells, traces.wetness)
    camera = camera_ahead(83, 47, 40.0, position=(0.0, 0.3, 1.5))  # an odd size
    plan = make_plan(Recipe(), street)
    clear = render_buffers(street, camera, plan, backend="cpu")
    depth = clear.raster.expected_depth
    if depth is None:
        fall = -camera.ray_directions()[..., 2]
        depth = torch.where(fall > 0.05, 1.5 / fall.clamp_min(0.05), 0.0).float()
    share = clear.raster.alpha * torch.linspace(0, 1, 83)
    sky = ConstantSky(torch.tensor([0.9, 0.5, 0.2]))
    scene = dataclasses.replace(street, sky=sky)
    images = [
        wet_tracks(
            clear.rgb.clone(), depth, share, camera, road, scene=scene, fog=fog, backend=backend
        )
        for backend in ("cpu", "reference")
    ]
    # Pixels on the border between two cells of the map may fall on either side of it.
    difference = (images[0] - images[1]).abs().amax(-1)
    assert float((difference < 1e-4).float().mean()) > 0.998
    assert float((images[0] - clear.rgb).abs().max()) > (0.05 if fog is None else 0.01)
