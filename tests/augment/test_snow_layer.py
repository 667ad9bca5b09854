"""Snow laid on beds made by hand: how deep, where, how closed, in which light, near the camera."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from augment.effects.gradient_noise import gradient_noise
from augment.effects.snow.depth import (
    PRESSED_SHARE,
    covered_share,
    define_depths,
    find_depths,
    make_depth_profile,
    mottle_noise,
)
from augment.effects.snow.glints import Crystals
from augment.effects.snow.layer import lay_snow
from augment.effects.snow.layer_kernels import (
    MAX_FOLIAGE_DEPTH_M,
    MAX_GRAIN_DISTANCE_M,
    MIN_DEPTH_M,
)
from augment.effects.snow.light import SnowIllumination, find_snow_light
from augment.effects.snow.part_snow import PartSnow, SnowLayers
from augment.effects.snow.relief import Carrier, Grain, add_grain
from augment.exposure.cells import FLUSH, OPEN_EDGE
from augment.light.scene_light import find_scene_light
from augment.light.srgb import display_from_linear, linear_from_display
from augment.render.buffers import ALPHA, RGB
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.render.threads import limit_threads
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.scene import Actor, Gaussians, Scene, Track
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky, LatLongSky, Sky
from recipes.snow import Snow, SnowLight
from tests.augment.pretend_gpu import AwayTensor, held_by, pretended_gpu
from tests.snow_beds import bed_of_cells, cells_on_grid, grid_surface, level_bed, looking, scene_of
from tests.snow_scenes import splats

CELL_M = 0.05
SUN = (0.8, 0.0, 0.6)
LIGHT = SnowIllumination(SUN, (0.95, 0.94, 0.92), (0.62, 0.68, 0.78), 0.3)
CALM = {"wind": {"drift": 0}, "grain": 0, "tracks": "never"}
FAR_AWAY = scene_of(grid_surface(np.zeros((1, 1)), CELL_M, corner_m=(-90.0, -90.0)))


def _lay(bed, scene=FAR_AWAY, *, seed=3, water=None, light=LIGHT, **options) -> SnowLayers:
    return lay_snow(bed, scene, Snow(**options), light, seed=seed, water_level_z_m=water)


def _depths(cells, *, seed=3, water=None, **options) -> np.ndarray:
    rng = np.random.default_rng(seed)
    profile = make_depth_profile(Snow(**options), rng, on_ground=True, water_level_z_m=water)
    return find_depths(cells, profile, np.uint64(seed)).depths_m


def _alpha(cover, camera) -> torch.Tensor:
    out = rasterize(cover.parts_for(FAR_AWAY, camera), camera, buffers=(RGB, ALPHA))
    assert out.alpha is not None
    return out.alpha


def _colors(gaussians) -> torch.Tensor:
    return gaussians.sh[:, 0] * SH_C0 + 0.5


# --- depth ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("depth_m", "drift"), [(0.05, 0.0), (0.3, 0.3), (2.0, 1.0)])
def test_median_depth_on_open_ground_is_the_recipes(depth_m, drift):
    """Over 60 m, some hundreds of the widest drifts: the median may be a few per cent off."""
    bed = level_bed(60.0, 0.2)
    heights = _depths(bed.ground, depth_m=depth_m, wind={"drift": drift}, tracks="never")
    assert abs(np.median(heights) / depth_m - 1) < (0.03 if drift < 1 else 0.06)
    assert heights.min() >= depth_m / 4.1 and heights.max() <= depth_m * 4.1


def test_layer_is_rounded_at_open_edges_and_nowhere_else():
    """A quarter of a circle: sqrt(1 - (1 - t)^2) of the depth, t depths from the edge."""
    depth_m = 0.4
    z = np.zeros((80, 80))
    z[38:42, 38:42] = np.nan
    cells = cells_on_grid(z, CELL_M)
    heights = _depths(cells, depth_m=depth_m, **CALM)
    t = np.minimum(cells.edge_distance_m.numpy() / depth_m, 1)
    ratio = heights / (depth_m * np.sqrt(1 - (1 - t) ** 2))
    assert abs(np.median(ratio) - 1) < 0.03 and ratio.std() < 0.05
    flush = _depths(cells_on_grid(z, CELL_M, holes=FLUSH), depth_m=depth_m, **CALM)
    assert flush.min() > 0.85 * depth_m


# --- patches --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("depth_m", "coverage"), [(0.1, 0.5), (0.002, 0.6), (0.01, 0.9)])
def test_share_of_level_ground_that_carries_snow(depth_m, coverage):
    snow = Snow(depth_m=depth_m, coverage=coverage)
    expected = coverage * (1 - math.exp(-depth_m / 0.004))
    assert math.isclose(covered_share(snow), expected, rel_tol=1e-9)
    heights = _depths(level_bed(100.0, 0.2).ground, depth_m=depth_m, coverage=coverage)
    assert abs((heights > 0).mean() - expected) < 0.02
    assert (heights[heights > 0] >= MIN_DEPTH_M).all()


def test_snow_through_foliage_is_thin_and_in_flecks():
    cells = level_bed(40.0, 0.1).ground
    green = dataclasses.replace(
        cells, semantic=torch.full_like(cells.semantic, int(SemanticClass.VEGETATION))
    )
    for depth_m in (0.01, 0.1, 0.5):
        open_m, left_m = (_depths(c, depth_m=depth_m, tracks="never") for c in (cells, green))
        assert 0.25 < (left_m > 0).mean() / (open_m > 0).mean() < 0.42
        assert left_m.max() <= MAX_FOLIAGE_DEPTH_M + 1e-6 and (left_m <= open_m).all()


# --- tracks and water -----------------------------------------------------------------------------


def test_tracks_are_pressed_where_the_recipe_says():
    wheel_tracks = np.zeros((100, 60))
    wheel_tracks[:, 20:26] = 1.0
    cells = cells_on_grid(np.zeros((100, 60)), CELL_M, tracks=wheel_tracks)
    rut = cells.track_share.numpy() == 1
    for depth_m, tracks, has_tracks in (
        (0.3, "auto", True),
        (0.31, "auto", False),
        (0.31, "always", True),
        (0.1, "never", False),
    ):
        heights = _depths(cells, depth_m=depth_m, tracks=tracks)
        ratio = np.median(heights[rut]) / np.median(heights[~rut])
        assert abs(ratio - (1 - PRESSED_SHARE if has_tracks else 1)) < 0.1


def test_no_snow_below_the_waters_edge():
    """Ground that rises by 2 m over 10 m, in water 1 m deep at its foot."""
    z = np.broadcast_to(np.linspace(0, 2, 200)[:, None], (200, 40)).copy()
    cells = cells_on_grid(z, CELL_M)
    cover = _lay(bed_of_cells(cells), depth_m=0.1, water=1.0, tracks="never")
    bed_z = cover.ground.gaussians.means[:, 0] * 0.2
    assert bed_z.min() > 1.0 and bed_z.min() < 1.03
    heights = _depths(cells, depth_m=0.1, water=1.0, tracks="never")
    low = cells.centers_m[:, 2].numpy() < 1.005
    assert not heights[low].any()
    assert (heights[~low] > 0).mean() > 0.99
    assert not len(_lay(bed_of_cells(cells), depth_m=0.1, water=5.0).ground.gaussians)


# --- closed surfaces ------------------------------------------------------------------------------


@pytest.mark.parametrize(("depth_m", "grain"), [(0.05, 1.0), (0.4, 0.0)])
def test_level_layer_lets_no_light_through(depth_m, grain):
    """At most 2 %, from above and from a car's height; half a metre of the bed's border is left."""
    cover = _lay(level_bed(6.0), depth_m=depth_m, grain=grain)
    for eye in ((3, 3, 5), (3, 3, 1.5), (-2.0, 3, 1.6)):
        camera = looking(eye, (3, 3, 0), 240, 160, 260.0)
        rays = camera.ray_directions(torch.float64)
        reach = -(eye[2] - depth_m) / rays[..., 2]
        hit = camera.centre + reach[..., None] * rays
        inside = (reach > 0) & ((hit[..., :2] - 3).abs() < 2.5).all(-1)
        assert inside.sum() > 2000
        assert _alpha(cover, camera)[inside].min() > 0.98


def test_discs_lie_in_the_surface_of_a_slope():
    """A plane of 30 degrees: discs' middles above it by the depth, their thin axes along it."""
    slope = math.tan(math.radians(30))
    z = np.broadcast_to(slope * np.arange(80)[:, None] * CELL_M, (80, 80)).copy()
    cells = cells_on_grid(z, CELL_M)
    gaussians = _lay(bed_of_cells(cells), depth_m=0.1, **CALM).ground.gaussians
    w, x, y, v = gaussians.quats.T
    thin = torch.stack([2 * (x * v + w * y), 2 * (y * v - w * x), 1 - 2 * (x * x + y * y)], 1)
    expected = torch.tensor([-slope, 0.0, 1.0]) / math.hypot(slope, 1)
    angles = torch.rad2deg(torch.acos((thin @ expected).clamp(-1, 1)))
    assert angles.median() < 4 and angles.max() < 20
    assert (gaussians.quats.norm(dim=1) - 1).abs().max() < 1e-5
    above = gaussians.means[:, 2] - slope * (gaussians.means[:, 0] - CELL_M / 2)
    assert abs(above.median() - 0.1) < 0.01
    assert (gaussians.scales[:, 0] >= gaussians.scales[:, 1]).all()


# --- colour ---------------------------------------------------------------------------------------


def _slope_facing(sign: float):
    z = np.broadcast_to(-sign * 0.4 * np.arange(40)[:, None] * CELL_M, (40, 40)).copy()
    return bed_of_cells(cells_on_grid(z, CELL_M))


def test_colours_follow_the_sun_and_stay_between_shade_and_light():
    facing, away = (
        _colors(_lay(_slope_facing(s), depth_m=0.1).ground.gaussians).mean(0) for s in (1, -1)
    )
    assert (facing > away + 0.05).all()
    assert facing.max() < 1.0 and away.min() > 0.55
    assert away[2] - away[0] > facing[2] - facing[0] + 0.03  # bluish where the sun is low


def test_two_shadings_agree_where_normals_do():
    bed = level_bed(4.0)
    baked = _lay(bed, depth_m=0.1).ground
    per_pixel = _lay(bed, depth_m=0.1, shading="per_pixel").ground
    assert (
        baked.sunlight_rgb is None
        and per_pixel.sunlight_rgb is not None
        and per_pixel.normals is None
    )
    share = (SUN[2] + LIGHT.wrap) / (1 + LIGHT.wrap)  # of a level surface
    lit = _colors(per_pixel.gaussians) + share * per_pixel.sunlight_rgb
    assert torch.equal(baked.gaussians.means, per_pixel.gaussians.means)
    assert (lit.mean(0) - _colors(baked.gaussians).mean(0)).abs().max() < 0.01
    assert (per_pixel.sunlight_rgb >= 0).all()
    part = _lay(bed, depth_m=0.1, shading="per_pixel").parts_for(
        FAR_AWAY, looking((2, 2, 3), (2, 2, 0))
    )[-1]
    assert part.is_overlay and part.shading is not None and part.shading.sun == SUN


# --- actors ---------------------------------------------------------------------------------------


def _driving_scene(yaw: float, bed_cells):
    roof = grid_surface(np.zeros((4, 4)), 0.5, corner_m=(-1.0, -1.0))
    scene = scene_of(FAR_AWAY.background, (standing_car("car", roof, yawed(yaw, 5.0, 2.0)),))
    return scene, bed_of_cells(level_bed(0.1).ground, car=bed_cells)


@pytest.mark.parametrize("shading", ["per_splat", "per_pixel"])
def test_snow_on_a_vehicle_is_carried_along_and_lit_where_it_stands(shading):
    """A slope of the vehicle that faces the sun is bright, and dull once it has turned round."""
    cells = _slope_facing(1).ground
    brightness = []
    for yaw in (0.0, math.pi):
        scene, bed = _driving_scene(yaw, cells)
        cover = _lay(bed, scene, depth_m=0.1, shading=shading)
        snow = cover.parts_for(scene, looking((5, 2, 9), (5, 2, 0)))[-1]
        assert snow.is_overlay and snow.instance_id == 1 and snow.world_from_part is not None
        if shading == "per_splat":
            assert snow.shading is None
            brightness.append(float(_colors(snow.gaussians).mean()))
        else:
            assert snow.shading is not None
            assert abs(snow.shading.sun[0] - math.cos(yaw) * SUN[0]) < 1e-9
    if shading == "per_splat":
        assert brightness[0] > brightness[1] + 0.1


# --- glints ---------------------------------------------------------------------------------------


def test_sparkle_adds_a_few_glints_that_change_with_the_view():
    bed = level_bed(8.0)
    camera = looking((2.0, 4.0, 1.5), (6.0, 4.0, 0.0))
    counts = []
    for sparkle in (0.0, 0.3, 1.0):
        cover = _lay(bed, depth_m=0.1, sparkle=sparkle)
        parts = cover.parts_for(FAR_AWAY, camera)
        counts.append(len(parts[-1].gaussians) if parts[-1].gaussians.scales.max() < 0.005 else 0)
    assert counts[0] == 0 < 2 * counts[1] < counts[2] < 0.05 * 160 * 160
    glints = cover.parts_for(FAR_AWAY, camera)[-1]
    assert glints.is_overlay and glints.gaussians.scales.max() < 0.005
    moved = cover.parts_for(FAR_AWAY, looking((3.5, 5.0, 1.5), (6.0, 4.0, 0.0)))[-1]
    here, there = (set(map(tuple, p.gaussians.means.tolist())) for p in (glints, moved))
    assert len(here & there) < 0.6 * len(here)
    overcast = SnowIllumination(SUN, LIGHT.lit_rgb, LIGHT.lit_rgb, 0.3)
    assert _lay(bed, depth_m=0.1, sparkle=1.0, light=overcast).ground.crystals is None


# --- extremes -------------------------------------------------------------------------------------


def test_same_bits_for_any_number_of_threads_and_another_seed_is_another_snow():
    bed = level_bed(8.0, 0.1, border=OPEN_EDGE)
    layers = []
    for count in (1, 2):
        limit_threads(count)
        layers.append(_lay(bed, depth_m=0.3, coverage=0.7).ground.gaussians)
    for name in ("means", "quats", "scales", "sh"):
        assert torch.equal(getattr(layers[0], name), getattr(layers[1], name))
    other = _lay(bed, depth_m=0.3, coverage=0.7, seed=4).ground.gaussians
    assert len(other) != len(layers[0]) or not torch.equal(other.means, layers[0].means)


SEED = np.uint64(77)


def test_noise_has_unit_deviation_and_median_zero():
    """400 000 points apart: the standard errors are 0.0012 and 0.0024; four of each are allowed."""
    u, v = np.random.default_rng(0).uniform(-1e5, 1e5, (2, 400_000))
    noise = gradient_noise(u, v, SEED)
    assert abs(noise.std() - 1) < 0.005
    assert abs(np.median(noise)) < 0.01


def _rugged_cells(corner_m=(0.0, 0.0)):
    rng = np.random.default_rng(4)
    z = rng.normal(0, 0.05, (40, 30))
    z[10:16, 10:20] = np.nan
    cells = cells_on_grid(z, 0.1, corner_m=corner_m, tracks=rng.random((40, 30)))
    count = len(cells)
    banks = torch.from_numpy(rng.uniform(-1, 1, (count, 2)).astype(np.float32))
    sizes = torch.from_numpy(rng.choice([0.05, 0.1, 0.4], count).astype(np.float32))
    semantic = torch.where(torch.arange(count) % 3 == 0, int(SemanticClass.VEGETATION), 1).short()
    return dataclasses.replace(cells, obstacle_vectors=banks, sizes_m=sizes, semantic=semantic)


@pytest.mark.parametrize(
    "options, corner_m, water",
    [
        ({"depth_m": 0.2, "tracks": "never"}, (0.0, 0.0), None),
        ({"depth_m": 0.1, "coverage": 0.5, "grain": 1.0}, (-37.5, 1e6), -0.01),
        ({"depth_m": 0.003}, (0.0, 0.0), -0.01),
        (
            {"depth_m": 10.0, "wind": {"drift": 1.0, "direction_deg": 200}, "tracks": "always"},
            *((-37.5, 1e6), None),
        ),
    ],
)
def test_kernel_computes_what_the_definition_says(options, corner_m, water):
    """Everything is float64 but the result, which is rounded to float32."""
    cells = _rugged_cells(corner_m)
    rng = np.random.default_rng(9)
    profile = make_depth_profile(Snow(**options), rng, on_ground=True, water_level_z_m=water)
    depths = find_depths(cells, profile, SEED)
    expected = define_depths(cells, profile)
    open_m = expected[cells.semantic.numpy() != SemanticClass.VEGETATION]
    assert (open_m == 0).any() == (water is not None or options["depth_m"] < 0.2)
    np.testing.assert_allclose(depths.depths_m, expected, rtol=2e-6, atol=1e-12)
    covered = expected > 0
    np.testing.assert_allclose(
        depths.mottle[covered], mottle_noise(cells, profile)[covered], rtol=1e-6, atol=1e-6
    )


# ---- light ---------------------------------------------------------------------------------------

HEIGHT = 180  # a row a degree
GREY = (0.35, 0.35, 0.35)
BLUE_SKY = (0.30, 0.45, 0.75)


def sky_with_sun(
    azimuth_deg: float, elevation_deg: float, *, radius_deg: float = 1.5, rgb: object = BLUE_SKY
) -> LatLongSky:
    """An even sky, a dark land, and a disc of sun."""
    elevations = np.radians(90 - (np.arange(HEIGHT) + 0.5))
    azimuths = np.radians((np.arange(2 * HEIGHT) + 0.5) - 180)
    e, a = np.meshgrid(elevations, azimuths, indexing="ij")
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    image = np.where(e[..., None] > 0, np.asarray(rgb), 0.2)
    image[directions @ unit(azimuth_deg, elevation_deg) > np.cos(np.radians(radius_deg))] = 1.0
    return LatLongSky(torch.from_numpy(image.astype(np.float32)))


def unit(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def discs(rgb: object, semantic: SemanticClass | None, *, count: int = 30, z: float = 0.0):
    """Level discs of one colour."""
    means = np.stack([np.arange(count), np.zeros(count), np.full(count, z)], 1)
    return splats(means, (0.3, 0.3, 0.01), rgb=rgb, semantic=semantic, opacity=0.9)


def scene(sky: Sky, ground: Gaussians, frames: tuple[Frame, ...] = ()) -> Scene:
    return Scene("s", "test:s", ground, (), sky, frames)


def street(sky: Sky, rgb: object = GREY) -> Scene:
    return scene(sky, discs(rgb, SemanticClass.ROAD))


def snow(*, albedo: float = 0.85, **light: float) -> Snow:
    return Snow(depth_m=0.1, albedo=albedo, light=SnowLight(**light))


def level(light: SnowIllumination) -> np.ndarray:
    """Linear colour of level snow that sees the sun."""
    lit, shadow = (linear_from_display(np.array(c)) for c in (light.lit_rgb, light.shadow_rgb))
    return shadow + (lit - shadow) * (light.sun[2] + light.wrap) / (1 + light.wrap)


def luminance(rgb: object) -> float:
    return float(linear_from_display(np.asarray(rgb)) @ [0.2126, 0.7152, 0.0722])


def degrees_between(a: object, b: object) -> float:
    return math.degrees(math.acos(min(1.0, float(np.dot(np.asarray(a), np.asarray(b))))))


def check(light: SnowIllumination) -> None:
    values = (*light.sun, *light.lit_rgb, *light.shadow_rgb, light.wrap)
    assert all(type(value) is float and math.isfinite(value) for value in values)
    assert math.hypot(*light.sun) == pytest.approx(1, abs=1e-12)
    pairs = zip(light.shadow_rgb, light.lit_rgb, strict=True)
    assert all(0 <= shadow <= lit <= 1 for shadow, lit in pairs)
    assert 0 <= light.wrap <= 1


def test_encoding_is_srgb_and_inverts() -> None:
    values = np.linspace(0, 1, 1001)
    # both halves of the standard are given to four digits
    assert display_from_linear(linear_from_display(values)) == pytest.approx(values, abs=1e-6)
    assert float(linear_from_display(np.array(0.5))) == pytest.approx(0.214041, abs=1e-6)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(-170, 12), (64, 45), (179, 85)])
def test_the_sun_is_found(azimuth_deg: float, elevation_deg: float) -> None:
    light = find_snow_light(street(sky_with_sun(azimuth_deg, elevation_deg)), snow())
    # samples are 1.1 degrees apart and are averaged over 8
    assert degrees_between(light.sun, unit(azimuth_deg, elevation_deg)) < 1.5
    check(light)


def test_an_even_sky_is_overcast() -> None:
    for rgb in ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0), (0.2, 0.3, 0.6)):
        light = find_snow_light(street(ConstantSky(torch.tensor(rgb))), snow())
        assert light.sun == pytest.approx(unit(135, 45), abs=1e-9)
        # soft shadows: 8 to 10 % darker than what faces the light
        assert 0.90 < luminance(light.shadow_rgb) / luminance(light.lit_rgb) < 0.92
        assert light.wrap > 0.8
        check(light)


def test_a_clear_sky_makes_blue_shadows_half_as_bright_and_warm_light() -> None:
    scene_light = find_scene_light(street(sky_with_sun(0, 45, radius_deg=4)))
    assert scene_light.sun_share == pytest.approx(0.9)
    light = find_snow_light(street(sky_with_sun(0, 45, radius_deg=4)), snow())
    assert 0.45 < luminance(light.shadow_rgb) / luminance(light.lit_rgb) < 0.6
    red, green, blue = light.shadow_rgb
    assert red < green < blue and blue - red < 0.2
    assert light.lit_rgb[0] > light.lit_rgb[2] and light.lit_rgb[0] - light.lit_rgb[2] < 0.05
    assert light.wrap == pytest.approx(0.54)


def test_level_snow_gets_the_light_of_the_road() -> None:
    """Far below white, linear radiance is the road's times the ratio of the albedos."""
    for sky in (sky_with_sun(0, 30, radius_deg=4), ConstantSky(torch.tensor([0.2, 0.2, 0.2]))):
        for rgb in ((0.05, 0.05, 0.05), (0.2, 0.2, 0.2)):
            light = find_snow_light(street(sky, rgb), snow(albedo=0.8))
            snow_luminance = float(level(light) @ [0.2126, 0.7152, 0.0722])
            # sRGB's two halves are given to four digits
            assert snow_luminance == pytest.approx(luminance(rgb) * 0.8 / 0.10, rel=1e-4)


def test_what_the_recipe_says_holds() -> None:
    place = street(sky_with_sun(50, 40))
    scene_light = find_scene_light(place)
    azimuth = find_snow_light(place, snow(sun_azimuth_deg=-100))
    assert azimuth.sun == pytest.approx(unit(-100, scene_light.elevation_deg), abs=1e-9)
    elevation = find_snow_light(place, snow(sun_elevation_deg=0))
    assert elevation.sun == pytest.approx(unit(scene_light.azimuth_deg, 0), abs=1e-9)
    both = find_snow_light(place, snow(sun_azimuth_deg=90, sun_elevation_deg=90))
    assert both.sun == pytest.approx((0, 0, 1), abs=1e-9)
    ratios = []
    for share in (0.0, 0.5, 1.0):
        light = find_snow_light(place, snow(sun=share))
        ratios.append(luminance(light.shadow_rgb) / luminance(light.lit_rgb))
        check(light)
    assert ratios[0] > ratios[1] > ratios[2] and ratios[2] == pytest.approx(0.5, abs=0.01)
    bright = find_snow_light(place, snow(brightness=0.8))
    assert luminance(bright.lit_rgb) == pytest.approx(luminance((0.8, 0.8, 0.8)), rel=1e-6)
    check(find_snow_light(place, snow(brightness=1.0, albedo=1.0)))


def test_any_scene_gives_colours() -> None:
    numbers = ((0.0, 0.0), (0.0, math.nan), (1e-4, 40.0), (7.0, 1.0), (math.nan, 0.5))
    for (sky, road), semantic in itertools.product(numbers, (SemanticClass.ROAD, None)):
        count = 1 if road == 0.5 else 30
        place = scene(ConstantSky(torch.full((3,), sky)), discs((road,) * 3, semantic, count=count))
        for recipe in (snow(), snow(albedo=1.0, sun=1.0), snow(brightness=0.0)):
            check(find_snow_light(place, recipe))


# ---- near the camera -----------------------------------------------------------------------------

CLOSE_CELL_M, OPACITY = 0.05, 0.98
CLOSE_SUN = torch.tensor([math.cos(0.6), 0.0, math.sin(0.6)], dtype=torch.float64)
GRAIN = Grain(amount=0.5, contrast=0.4, seed=5)


def camera(x_m=0.0, y_m=0.0, z_m=1.4, f=500.0, width=320, height=240) -> Camera:
    """Looking along +x, 20 degrees down."""
    tilt = math.radians(20)
    forward = torch.tensor([math.cos(tilt), 0.0, -math.sin(tilt)], dtype=torch.float64)
    right = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    centre = torch.tensor([x_m, y_m, z_m], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("close", width, height, f, f, width / 2, height / 2, pose)


def above(x_m: float = 0.0, height_m: float = 2.0, focal: float = 500.0) -> Camera:
    """Looking straight down at snow at z = 0, which a pixel shows 4 mm of."""
    return looking((x_m, 0.0, height_m), (x_m, 0.0, 0.0), 160, 120, focal)


def grained(view: Camera, *, height_m=2.0, occluded=None, carriers=(), backend="cpu", **options):
    """Return a picture of even snow at z = 0 with grain, from straight above; float32 [H, W, 3]."""
    size = (view.height, view.width)
    args = {"grain": GRAIN, "snow": torch.ones(size), "extinction_per_m": 0.0} | options
    grain, snow = args.pop("grain"), args.pop("snow")
    even, depth = torch.full((*size, 3), 0.7), args.pop("depth", torch.full(size, height_m))
    sun = tuple(CLOSE_SUN.tolist())
    return add_grain(
        *(even, depth, snow, occluded, view, grain, sun, carriers), backend=backend, **args
    )


def test_grain_shows_crumbs_and_is_neither_lighter_nor_darker():
    shown = grained(above())[..., 0]
    assert abs(float(shown.mean()) / 0.7 - 1) < 0.01
    assert 0.01 < float(shown.std()) / 0.7 < 0.08
    steps = (shown[:, 1:] - shown[:, :-1]).abs().mean()
    assert float(steps) > 0.1 * float(shown.std())  # within a few pixels, not over the whole
    coarse = grained(above(focal=20.0))[..., 0]  # 10 cm a pixel: wider than any of it
    assert torch.equal(coarse, torch.full_like(coarse, 0.7))


def test_grain_belongs_to_the_place_and_to_the_vehicle():
    """Ten pixels to the side the camera sees the same crumbs ten pixels over; those on a vehicle
    are seen unmoved by a camera that drives beside it.
    """
    here, there = grained(above()), grained(above(0.04))
    # Towards the image's border a pixel is a little farther away, and shows less.
    torch.testing.assert_close(here[:, 10:], there[:, :-10], atol=1e-3, rtol=0)
    other = grained(above(), grain=dataclasses.replace(GRAIN, seed=6))
    assert float((other - here).abs().mean()) > 0.005
    size = np.array([5.0, 5.0, 5.0])
    views = []
    for x_m in (0.0, 7.3):
        pose = np.eye(4)
        pose[0, 3] = -x_m
        views.append(grained(above(x_m), carriers=[Carrier(pose, -size, size)]))
    torch.testing.assert_close(*views, atol=1e-5, rtol=0)
    assert float((grained(above(7.3)) - views[1]).abs().mean()) > 0.005


def test_no_grain_where_nothing_shows_it():
    view = above()
    size, even = (view.height, view.width), torch.full((view.height, view.width, 3), 0.7)
    cases: list[dict[str, Any]] = [
        {"snow": torch.zeros(size)},
        {"occluded": torch.ones(size, dtype=torch.bool)},
        {"height_m": 0.0},
        {"height_m": MAX_GRAIN_DISTANCE_M + 0.1},
        {"height_m": math.nan},
        {"grain": Grain(0.0, 0.4, 5)},
        {"extinction_per_m": 1e6},
    ]
    for options in cases:
        assert torch.equal(grained(view, **options), even), options
    steep = 2.0 + 0.04 * torch.arange(view.width).expand(size).contiguous()
    assert torch.equal(grained(view, depth=steep), even)  # 4 cm from pixel to pixel
    level = Grain(1.0, 1.0, 5)
    for sun in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)):
        out = add_grain(
            even.clone(), torch.full(size, 0.01), torch.ones(size), None, view, level, sun, []
        )
        assert bool(torch.isfinite(out).all()) and 0.4 < float(out.min()) < float(out.max()) < 1


def test_the_kernel_adds_grain_as_its_definition_does():
    view = looking((0.0, 0.0, 1.5), (4.0, 0.5, 0.0), 160, 120, 150.0)
    rng = torch.Generator().manual_seed(2)
    depth = 1.5 / (-view.ray_directions()[..., 2]).clamp_min(0.1)  # level, with bumps
    depth *= 1 + torch.rand(120, 160, generator=rng) ** 8 / 50
    snow, hidden = torch.rand(120, 160, generator=rng), torch.rand(120, 160, generator=rng) < 0.1
    boxes = [
        Carrier(np.linalg.inv(yawed(0.7, x, 0.5).numpy()), np.full(3, -1.0), np.full(3, 1.0))
        for x in (2.0, 4.0)
    ]
    found, expected = (
        add_grain(
            torch.full((120, 160, 3), 0.6),
            *(depth, snow, hidden, view, GRAIN, (0.6, 0.0, 0.8), boxes),
            extinction_per_m=0.05,
            backend=backend,
        )
        for backend in ("cpu", "reference")
    )
    assert float((expected - 0.6).abs().max()) > 0.02
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


# ---- Against definitions, and on a GPU -----------------------------------------------------------

WRAP = 0.3
CLOSE = {"f": 900.0, "width": 640, "height": 480}


def near_discs(count: int, seed: int, *, far_m: float = 11.0) -> Gaussians:
    """Snow ahead of the camera, as far as it is split and farther, of many sizes and colours."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(count, 7, generator=generator)
    tilt = 0.3 * (drawn[:, 5] - 0.5)
    zero = torch.zeros(count)
    means = torch.stack([1.5 + far_m * drawn[:, 0] ** 2, 4 * drawn[:, 1] - 2, zero], 1)
    turns = torch.stack([torch.cos(tilt), torch.sin(tilt), zero, zero], 1)
    scales = torch.stack([0.02 + 0.03 * drawn[:, 2], 0.02 + 0.03 * drawn[:, 3], zero + 0.01], 1)
    return splats(means, scales, turns, drawn[:, 4:], SemanticClass.SNOW, opacity=0.98)


def crystals(count: int, seed: int, *, spread_m=6.0) -> Crystals:
    rng = np.random.default_rng(seed)
    places = rng.uniform((0, -spread_m, 0), (20, spread_m, 0.1), (count, 3)).astype(np.float32)
    up, around = rng.random(count), 2 * np.pi * rng.random(count)
    flat = np.sqrt(1 - up * up)
    mirrors = np.stack([flat * np.cos(around), flat * np.sin(around), up], 1).astype(np.float32)
    return Crystals(torch.from_numpy(places), torch.from_numpy(mirrors), 0.9)


def drawn_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Those with an opacity, by place: the GPU lists them in an order of its own."""
    names = ("means", "quats", "scales", "opacities", "sh")
    held = {name: held_by_or_own(getattr(gaussians, name)).numpy() for name in names}
    shown = np.flatnonzero(held["opacities"] > 0)
    order = shown[np.lexsort(np.round(held["means"][shown], 4).T)]
    return {name: values[order] for name, values in held.items()}


def held_by_or_own(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.inner if isinstance(tensor, AwayTensor) else tensor.cpu()


def assert_alike(found: Gaussians, expected: Gaussians, *, opacity=0.0) -> None:
    """opacity: how far those of glints may be off: a lobe is narrow, and its rim steep."""
    a, b = drawn_of(found), drawn_of(expected)
    for name, values in b.items():
        assert a[name].shape == values.shape, name
        # Places lie metres from the origin, of which float32 tells 1e-7.
        atol = opacity if name == "opacities" else 2e-6
        wrong = np.abs(a[name] - values).reshape(len(values), -1).max(1, initial=0) > (
            atol + 2e-7 * np.abs(values).reshape(len(values), -1).max(1, initial=0)
        )
        assert not wrong.any(), f"{name}: {wrong.sum()}"


def yawed(angle: float, x: float, y: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64)
    return rigid(turn, torch.tensor([x, y, 0.5], dtype=torch.float64))


def standing_car(name: str, gaussians: Gaussians, pose: torch.Tensor) -> Actor:
    track = Track(torch.tensor([0, 10]), torch.stack([pose, pose]))
    return Actor(name, "car", gaussians, track, (2.0, 2.0, 1.0))


@pytest.fixture
def glinting_street():
    """Snow on the ground and on two vehicles, all of which glints."""
    normals = torch.nn.functional.normalize(
        torch.tensor([[0.0, 0.3, 1.0]])
        + 0.5 * torch.rand(70, 3, generator=torch.Generator().manual_seed(4)),
        dim=1,
    )
    far = near_discs(300, 6)
    far = dataclasses.replace(far, means=far.means + torch.tensor([12.0, 0.0, 0.0]))
    ground = PartSnow(far, torch.ones(3), crystals=crystals(1500, 7))
    cars = {
        name: PartSnow(
            near_discs(count, seed, far_m=2.0),
            torch.ones(2),
            sunlight_rgb=0.3 * torch.ones(count, 3),
            normals=normals[:count],
            crystals=crystals(count, seed, spread_m=1.0) if seed == 8 else None,
        )
        for name, count, seed in (("a", 70, 8), ("b", 33, 9))
    }
    actors = tuple(
        standing_car(name, near_discs(2, 3), pose)
        for name, pose in (("a", yawed(0.7, 3.0, 1.0)), ("b", yawed(-2.0, 5.0, -2.0)))
    )
    layers = SnowLayers(ground, cars, tuple(CLOSE_SUN.tolist()), WRAP, 0.1, GRAIN)
    return scene_of(near_discs(3, 4), actors), layers


def test_a_street_full_of_snow_is_the_cpus(glinting_street, monkeypatch):
    """Lit by normals, glinting, in parts that are turned: the same parts in the same order."""
    scene, cover = glinting_street
    expected = cover.parts_for(scene, camera(**CLOSE))
    with pretended_gpu(monkeypatch):
        found = cover.parts_for(scene, camera(**CLOSE), backend="cuda")
        again = cover.parts_for(scene, camera(**CLOSE), backend="cuda")
    assert len(expected) == 3 + 1 + 1 + 2 + 1  # own; ground and glints, twice that or no glints
    # A part whose crystals all face away is listed all the same, without one that shows.
    assert [(p.instance_id, p.is_overlay) for p in found] == [
        (p.instance_id, p.is_overlay) for p in expected
    ]
    for a, b, c in zip(found, expected, again, strict=True):
        assert_alike(a.gaussians, b.gaussians, opacity=2e-4)
        assert a.world_from_part is b.world_from_part or torch.equal(
            a.world_from_part, b.world_from_part
        )
        for name in ("means", "opacities", "sh"):
            one, two = (held_by_or_own(getattr(p.gaussians, name)) for p in (a, c))
            assert torch.equal(one, two)
    # What is the part's own is one object from frame to frame, on either side.
    assert all(a.gaussians is b.gaussians is c.gaussians
               for a, b, c in zip(found[:3], expected[:3], again[:3], strict=True))  # fmt: skip
    glints = found[4].gaussians
    assert 0 < int((held_by(glints.opacities) > 0).sum()) < 60
