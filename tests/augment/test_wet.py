"""Wet ground: how dark it gets, where water stands, what its film mirrors, rings of drops."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.effects.flood.water_plane import mirrored_camera
from augment.effects.flood.waves import WaveField
from augment.effects.wet import film_kernels, reflection
from augment.effects.wet.darkening import (
    darken_gaussians,
    to_display,
    to_linear,
    wet_albedo,
    wet_ratio,
)
from augment.effects.wet.effect import DARKENING_PASS, MIRROR_PASS, REFLECTION_PASS
from augment.effects.wet.film_kernels import EXPOSURE, HEIGHT, NUM_CHANNELS, PUDDLE_ORDER, SLOPE_X
from augment.effects.wet.ground_map import (
    EXPOSURE_SETTINGS,
    GROUND_CELL_M,
    NO_PUDDLES,
    WetGround,
    wet_ground,
    wet_splats,
)
from augment.effects.wet.reflection import (
    Film,
    Mirror,
    Plane,
    blur_upright,
    find_ground,
    mirror_camera,
    plane_in_view,
    shade_wet,
)
from augment.effects.wet.ripples import (
    RING_M2,
    add_ring_waves,
    drops_per_m2_s,
    make_rings,
    ring_slopes,
)
from augment.exposure.cells import ExposedSurface
from augment.memo import memo_of
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan, plan_view
from augment.view.render_view import render_buffers, render_view
from recipes.fields import changed
from recipes.rain import Rain
from recipes.schema import Output, Recipe, Render, Weather
from tests.scenes import one_gaussian, random_gaussians, stack
from tests.snow_beds import cells_on_grid, grid_surface, looking

NO_RINGS = make_rings(0.0, 0, 0)
ROAD = (0.3, 0.3, 0.3)
QUIET = Output(depth="none", semantic=False, labels=False)


def flat_map(size_m: float = 60.0, rise: float = 0.0, hollow: float = 0.0) -> WetGround:
    """Open ground about the origin that climbs towards +x."""
    count = round(size_m / GROUND_CELL_M)
    x = (np.arange(count) + 0.5) * GROUND_CELL_M - size_m / 2
    channels = torch.zeros(count, count, NUM_CHANNELS)
    channels[..., HEIGHT] = torch.from_numpy(rise * x).float()
    channels[..., EXPOSURE], channels[..., SLOPE_X], channels[..., PUDDLE_ORDER] = 1.0, rise, hollow
    tops = channels[..., HEIGHT].clone()
    return WetGround(
        *(-size_m / 2, -size_m / 2, channels, tops, torch.ones_like(tops)), np.zeros(16, np.float32)
    )


def rain(rate: float = 10.0, **more) -> Recipe:
    weather = Weather(rain=Rain(rate_mm_h=rate, **more))
    return Recipe(weather=weather, output=QUIET, seed=3)


# ---- Darkening -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dry", "wet"),
    [(0.05, 0.025), (0.1, 0.052), (0.2, 0.109), (0.3, 0.172), (0.5, 0.323), (0.7, 0.516)],
)
def test_wet_over_dry_albedo_is_angstroms(dry, wet):
    assert float(wet_albedo(torch.tensor(dry))) == pytest.approx(wet, rel=0.02)


def test_a_splat_loses_the_light_that_its_albedo_says():
    white, dry = 0.8, torch.tensor([0.06, 0.2, 0.5])
    gaussians = one_gaussian(rgb=to_display(dry * white).numpy())
    wet = darken_gaussians(gaussians, torch.ones(1), white)
    ratio = to_linear(0.5 + SH_C0 * wet.sh[0, 0]) / to_linear(0.5 + SH_C0 * gaussians.sh[0, 0])
    assert torch.allclose(ratio, wet_albedo(dry) / dry, rtol=0.005)
    half = wet_ratio(to_display(dry * white)[None], white, 0.5)[0]
    assert bool(((half < 1) & (half > ratio.sqrt().sqrt() * 0.5)).all())


def test_dry_splats_keep_their_bits_and_black_ones_stay_finite():
    gaussians = random_gaussians(50, seed=1)
    assert darken_gaussians(gaussians, torch.zeros(50), 0.5) is gaussians
    wet = torch.zeros(50)
    wet[7] = 1.0
    darkened = darken_gaussians(gaussians, wet, 1e-4)
    is_dry = torch.arange(50) != 7
    assert torch.equal(darkened.sh[is_dry], gaussians.sh[is_dry])
    black = dataclasses.replace(gaussians, sh=gaussians.sh - 9.0)
    assert bool(torch.isfinite(darken_gaussians(black, torch.ones(50), 0.3).sh).all())


# ---- The map of the ground -----------------------------------------------------------------------


def scene_with(z_m: np.ndarray, cell_m=0.2, corner_m=(0.0, 0.0), above=(), frames=()) -> Scene:
    """A road of heights z_m [nx, ny], NaN where something keeps the rain off, and what stands on
    it.
    """
    ground = grid_surface(np.nan_to_num(z_m), cell_m, ROAD, corner_m)
    scene = Scene(
        name="wet",
        source="made by hand",
        background=stack(ground, *above) if above else ground,
        actors=(),
        sky=ConstantSky(torch.tensor([0.62, 0.7, 0.8])),
        frames=frames,
    )
    cells = cells_on_grid(z_m, cell_m, corner_m=corner_m)
    memo_of(scene).put(("exposed surface", EXPOSURE_SETTINGS), ExposedSurface(cells, {}))
    return scene


def test_what_is_sheltered_stays_dry_with_a_soft_edge():
    z = np.zeros((100, 60))
    z[40:60] = np.nan  # under a bridge, x from 8 m to 12 m
    scene = scene_with(z)
    ground = wet_ground(scene, 0)
    x = torch.tensor([5.0, 7.5, 8.0, 8.5, 10.0, 15.0], dtype=torch.float64)
    open_ = ground.interpolate(x, torch.full_like(x, 6.0))[:, EXPOSURE]
    assert float(open_[0]) > 0.95 and float(open_[-1]) > 0.95
    assert float(open_[4]) == 0 and 0.05 < float(open_[2]) < 0.95
    splats = wet_splats(scene, ground)
    under = (scene.background.means[:, 0] > 9) & (scene.background.means[:, 0] < 11)
    beside = (scene.background.means[:, 0] > 2) & (scene.background.means[:, 0] < 6)
    inside = (scene.background.means[:, 1] - 6).abs() < 4
    assert float(splats.wet[under].max()) == 0
    assert float(splats.wet[beside & inside].min()) > 0.9
    assert bool(splats.is_ground[under].all())  # it mirrors nothing, and is not mirrored


def test_water_stands_in_hollows_first_and_never_on_a_slope():
    x = (np.arange(150) + 0.5) * 0.2
    bowl = -0.05 * np.exp(-(((x[:, None] - 20) ** 2 + (x[None, :75] - 7) ** 2) / 0.8))
    slope = np.where(x < 8, 0.4 * (8 - x), 0.0)[:, None]  # 22 degrees
    ground = wet_ground(scene_with(bowl + slope), 5)
    for share in (0.05, 0.3):
        level = ground.find_puddle_threshold(share)
        channels = ground.channels
        is_open = channels[..., EXPOSURE] > 0.5
        wet = channels[..., PUDDLE_ORDER] > level
        assert float((wet & is_open).sum() / is_open.sum()) == pytest.approx(share, abs=0.01)
        at = ground.interpolate(*torch.tensor([[20.0], [7.0]], dtype=torch.float64))
        assert float(at[0, PUDDLE_ORDER]) > level
        columns = ground.left_m + (torch.arange(channels.shape[1]) + 0.5) * GROUND_CELL_M
        assert not bool(wet[:, columns < 6].any())
    assert ground.find_puddle_threshold(0.0) == NO_PUDDLES


def test_a_scene_without_open_ground_is_left_as_it_is():
    scene = scene_with(np.full((4, 4), np.nan))
    eye = looking((0.4, 0.4, 1.5), (3.0, 0.4, 0.8))
    view = plan_view(make_plan(rain(), scene), scene, eye)
    skipped = {s.name: s for s in view.steps}
    assert not skipped[MIRROR_PASS].runs and "no open ground" in skipped[REFLECTION_PASS].why
    film = rain(0.0, wetness=1.0)  # without what falls
    dry, wet = (render_buffers(scene, eye, make_plan(r, scene)).rgb for r in (Recipe(), film))
    assert torch.equal(dry, wet)


# ---- The plane and the mirrored picture ----------------------------------------------------------


def test_the_mirror_of_level_ground_is_a_floods():
    camera = looking((3.0, -2.0, 1.5), (12.0, 1.0, 0.7))
    mine, flood = mirror_camera(camera, Plane((0.0, 0.0, 1.0), 0.25)), mirrored_camera(camera, 0.25)
    assert torch.allclose(mine.camera_from_world, flood.camera_from_world, atol=1e-12)
    assert (mine.cx, mine.cy, mine.fx) == (flood.cx, flood.cy, flood.fx)


@pytest.mark.parametrize("rise", [0.0, 0.06])
def test_the_plane_follows_the_ground_in_view(rise):
    plane = plane_in_view(
        looking((-20.0, 0.0, 1.5 - 20 * rise), (0.0, 0.0, 0.3)), flat_map(rise=rise)
    )
    assert plane is not None
    assert -plane.up[0] / plane.up[2] == pytest.approx(rise, abs=2e-3)
    assert abs(plane.up[1]) < 1e-3 and abs(plane.offset_m) < 0.02
    assert plane_in_view(looking((0.0, 0.0, 1.5), (9.0, 0.0, 9.0)), flat_map()) is None
    assert plane_in_view(looking((-20.0, 0.0, -1.5), (0.0, 0.0, -1.5)), flat_map()) is None


def shown_by(lamp, rise: float, film: Film, focal=600.0):
    """(camera, plane, the light that a black road mirrors of a lamp in the dark)."""
    camera = looking((-15.0, 0.0, 1.5 - 15 * rise), (0.0, 0.0, 0.3), 320, 240, focal)
    ground = flat_map(rise=rise, hollow=5.0)
    plane = plane_in_view(camera, ground)
    assert plane is not None
    up = torch.tensor(plane.up, dtype=torch.float64)
    rays = camera.ray_directions(torch.float64)
    depth = (plane.offset_m - float(up @ camera.centre)) / (rays @ up)
    depth = torch.where(depth > 0, depth, 0.0).float()
    view = mirror_camera(camera, plane)
    out = rasterize(
        [PosedGaussians(one_gaussian(lamp, 0.05, 0.99, (1.0, 1.0, 1.0)))],
        view,
        buffers=("rgb", "alpha", "expected_depth"),
        clip=plane.above(0.3),
    )
    assert out.rgb is not None and out.alpha is not None and out.expected_depth is not None
    mirror = Mirror(
        view, blur_upright(out.rgb), torch.where(out.alpha > 0.5, out.expected_depth, 0)
    )
    share, _ = find_ground(camera, depth, torch.ones_like(depth), ground)
    dark = torch.zeros(camera.height, camera.width, 3)
    lit = shade_wet(dark.clone(), camera, depth, share, ground, film, mirror)
    return camera, plane, to_linear(lit).sum(-1)


def mirrored_pixel(camera: Camera, plane: Plane, lamp) -> tuple[float, float]:
    n, at = np.array(plane.up), np.array(lamp, np.float64)
    image = at - 2 * (n @ at - plane.offset_m) * n
    x, y, z = camera.camera_from_world[:3, :3].numpy() @ (image - camera.centre.numpy())
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


@pytest.mark.parametrize("rise", [0.0, 0.05])
def test_a_lamps_reflection_lies_at_the_mirrored_pixel(rise):
    lamp = (12.0, 1.5, 2.5 + 12 * rise)
    film = Film(1.0, -10.0, NO_RINGS)  # one puddle
    camera, plane, light = shown_by(lamp, 0.0 if rise == 0 else rise, film)
    row, column = divmod(int(light.argmax()), camera.width)
    x, y = mirrored_pixel(camera, plane, lamp)
    # A puddle is level: on a slope what it mirrors is lower than the slope's plane would show it.
    if rise == 0:
        assert abs(column + 0.5 - x) < 1 and abs(row + 0.5 - y) < 1.5
    film = Film(1.0, NO_PUDDLES, NO_RINGS)  # wet asphalt: its streak is about the same pixel
    camera, plane, light = shown_by(lamp, rise, film)
    x, y = mirrored_pixel(camera, plane, lamp)
    columns = torch.arange(camera.width) + 0.5
    rows = torch.arange(camera.height) + 0.5
    total = float(light.sum())
    middle = float((light.sum(0) * columns).sum()) / total
    assert abs(middle - x) < 1
    upright = float((light.sum(1) * (rows - y) ** 2).sum()) / total
    sideways = float((light.sum(0) * (columns - middle) ** 2).sum()) / total
    assert upright > 6 * sideways  # a long streak along the view
    assert 0.2 < math.sqrt(upright) / (camera.fy * 2 * film_kernels.ASPHALT_ROUGHNESS * 0.6) < 1.5


def test_a_rough_film_reflects_more_at_grazing_angles():
    cosines = torch.tensor([1.0, 0.5, 0.2, 0.05])
    for slopes in (0.0, 0.085):
        share = reflection.mean_reflectance(cosines, torch.full((4,), slopes))
        assert bool((share.diff() > 0).all()) and 0.02 < float(share[0]) < 0.021
    assert float(share[-1]) < 0.7  # facets turn to the eye


# ---- Kernels and definitions ---------------------------------------------------------------------


def test_kernels_do_as_the_definitions_do():
    gen = torch.Generator().manual_seed(0)
    camera = looking((-10.0, 1.0, 1.4), (0.0, 0.0, 0.2), 97, 61, 90.0, timestamp_ns=1_234_567_891)
    ground = flat_map()
    ground.channels[..., PUDDLE_ORDER] = torch.randn(ground.channels.shape[:2], generator=gen)
    ground.channels[..., SLOPE_X] = 0.01 * torch.randn(ground.channels.shape[:2], generator=gen)
    ground.channels[..., HEIGHT] = 0.05 * torch.randn(ground.channels.shape[:2], generator=gen)
    rays = camera.ray_directions(torch.float64)
    depth = torch.where(rays[..., 2] < -0.01, -1.4 / rays[..., 2].clamp_max(-0.01), 0.0).float()
    depth[5:9, 5:9] = math.inf
    visible_share = torch.rand(depth.shape, generator=gen)
    share, rows = find_ground(camera, depth, visible_share, ground)
    expected, same = find_ground(camera, depth, visible_share, ground, backend="reference")
    assert rows == same and torch.allclose(share, expected, atol=1e-5)
    picture = 1.2 * torch.rand(40, 97, 3, generator=gen)
    levels, defined = blur_upright(picture), blur_upright(picture, backend="reference")
    assert all(torch.allclose(a, b, atol=2e-5) for a, b in zip(levels, defined, strict=True))
    view = mirror_camera(camera, Plane((0.0, 0.0, 1.0), 0.0)).cropped(0, 5, 97, 40)
    far = 30 * torch.rand(40, 97, generator=gen)
    mirror = Mirror(view, levels, torch.where(far > 6, far, 0.0))
    film = Film(0.8, 0.3, make_rings(8.0, 7, camera.timestamp_ns))
    rgb = torch.rand(61, 97, 3, generator=gen)
    arguments = camera, depth, share, ground, film, mirror
    actual = shade_wet(rgb.clone(), *arguments)
    defined = shade_wet(rgb.clone(), *arguments, backend="reference")
    assert bool(torch.isfinite(actual).all())
    # Depth of the mirror is noise here: a texel's border moves a few looks by the last bit.
    error = (actual - defined).abs()
    assert float(error.quantile(0.995)) < 1e-4
    assert torch.equal(actual[share == 0], rgb[share == 0])


def test_rings_on_a_flood_are_the_definitions():
    camera = looking((0.0, 0.0, 1.2), (2.0, 0.3, 0.0), 80, 60, 3000.0, timestamp_ns=987_654_321)
    still = WaveField(*(torch.zeros(60, 80) for _ in range(3)))
    rings = make_rings(20.0, 1, camera.timestamp_ns)
    field = add_ring_waves(still, camera, 0.0, rings)
    expected = add_ring_waves(still, camera, 0.0, rings, backend="reference")
    for name in ("normal_x", "normal_y", "slope_variance"):
        assert torch.allclose(getattr(field, name), getattr(expected, name), atol=1e-6)
    assert float(field.normal_x.abs().max()) > 0.02 and float(still.normal_x.abs().max()) == 0
    assert add_ring_waves(still, camera, 0.0, NO_RINGS) is still


# ---- Rings ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "flux"), [(2.5, 1381), (10.0, 3114), (50.0, 7069), (100.0, 9743)])
def test_as_many_drops_meet_the_ground_as_their_sizes_and_speeds_say(rate, flux):
    assert drops_per_m2_s(rate, 0.5) == pytest.approx(flux, rel=0.01)


def test_rings_are_a_function_of_seed_place_and_time():
    x, y = (torch.rand(4000, generator=torch.Generator().manual_seed(k)).double() for k in (1, 2))
    fine = torch.full((4000,), 1e-3)

    def at(seed=3, ns=10**18 + 5, rate=5.0, footprint=fine):
        return ring_slopes(make_rings(rate, seed, ns), x, y, footprint)

    same = at()
    assert all(torch.equal(a, b) for a, b in zip(same, at(), strict=True))
    assert not torch.equal(same[0], at(seed=4)[0]) and not torch.equal(same[0], at(ns=10**18)[0])
    later = at(ns=10**18 + 5 + 1_000_000)[0]  # a millisecond on they have hardly moved
    assert float((later - same[0]).abs().mean()) < 0.3 * float(same[0].abs().mean())
    far = at(footprint=torch.full((4000,), 0.5))
    assert not bool(far[0].any()) and float(far[2][0]) == pytest.approx(
        make_rings(5.0, 3, 0).variance
    )
    assert all(not bool(part.any()) for part in at(rate=0.0))


def test_slopes_of_rings_have_the_variance_that_stands_for_them():
    gen = torch.Generator().manual_seed(0)
    x, y = (50 * torch.rand(60_000, generator=gen).double() for _ in range(2))
    rings = make_rings(3.0, 0, 77)
    sx, sy, _ = ring_slopes(rings, x, y, torch.full((60_000,), 1e-4))
    measured = float((sx**2 + sy**2).mean())
    assert measured == pytest.approx(rings.variance - rings.undrawn_variance, rel=0.25)
    assert make_rings(300.0, 0, 0).variance < 0.1 and RING_M2 > 0


# ---- Whole pictures ------------------------------------------------------------------------------


def street() -> tuple[Scene, Camera]:
    """A road, x from 0 to 24 m, with a red wall across its end."""
    wall = grid_surface(np.zeros((40, 25)), 0.3, (0.8, 0.1, 0.1))
    points = torch.stack((torch.full((1000,), 22.0), wall.means[:, 0] - 0.0, wall.means[:, 1]), 1)
    wall = dataclasses.replace(
        wall,
        means=points,
        scales=torch.tensor([0.01, 0.25, 0.25]).repeat(1000, 1),
        semantic=torch.full((1000,), int(SemanticClass.BUILDING), dtype=torch.int16),
    )
    eye = looking((1.0, 6.0, 1.5), (22.0, 6.0, 0.6), 96, 64, 80.0, timestamp_ns=5_000_000)
    z = np.zeros((120, 60))
    z[108:] = np.nan
    frame = Frame(0, eye.timestamp_ns, torch.eye(4, dtype=torch.float64), {"front": eye})
    return scene_with(z, above=(wall,), frames=(frame,)), eye


def test_a_dry_recipe_keeps_its_bits_and_a_wet_one_mirrors_the_wall():
    scene, eye = street()
    clean = render_view(scene, eye, Recipe(output=QUIET)).rgb
    assert np.array_equal(render_view(scene, eye, rain(0.0)).rgb, clean)
    for dry in (rain(0.0), rain(5.0, wetness=0.0)):
        plan = {s.name: s for s in make_plan(dry, scene).steps}
        assert not plan[DARKENING_PASS].runs and plan[DARKENING_PASS].why
    wet = rain(0.0, wetness=1.0, puddles=0.0)
    image = render_view(scene, eye, wet).rgb
    assert np.array_equal(image, render_view(scene, eye, wet).rgb)  # alone and again
    assert np.array_equal(image[:20], clean[:20])  # the wall and the sky
    near, foot = image[60:, 40:56].astype(float), image[38:42, 40:56].astype(float)
    assert foot[..., 0].mean() > foot[..., 2].mean() + 10  # red at the wall's foot
    assert near.mean() < clean[60:, 40:56].mean()  # darker where it is seen steeply


def test_a_coarse_mirror_shows_nearly_what_a_fine_one_does():
    scene, eye = street()
    wet = rain(0.0, wetness=1.0)
    fine, coarse = (
        render_view(
            scene, eye.scaled(4.0), changed(wet, {"render.speed.mirror_px": px})
        ).rgb.astype(float)
        for px in (2.0, 4.0)
    )
    assert 0 < np.abs(fine - coarse).mean() < 0.5  # of 255: 0.2, most of it at the wall's edges


def test_what_lies_on_the_ground_and_cars_are_not_mirrors():
    ground, camera = flat_map(), looking((-10.0, 0.0, 1.5), (0.0, 0.0, 0.5), 64, 48, 60.0)
    rays = camera.ray_directions(torch.float64)
    for height, wet in ((0.0, True), (0.05, True), (0.6, False), (-0.8, False)):
        fall = (-rays[..., 2]).clamp_min(1e-9)
        depth = torch.where(rays[..., 2] < -0.05, (1.5 - height) / fall, 0.0).float()
        share, rows = find_ground(camera, depth, torch.ones_like(depth), ground)
        assert bool((share > 0.9).any()) == wet and (rows != (0, 0)) == wet


def test_extremes_stay_finite():
    scene, eye = street()
    for recipe in (rain(300.0, puddles=1.0), rain(1e-6), rain(30.0, wetness=1.0, puddles=0.5)):
        tiny = recipe.model_copy(update={"render": Render(scale=0.02)})
        for weather in (recipe, tiny):
            plan = make_plan(weather, scene)
            out = render_buffers(scene, eye.scaled(weather.render.scale), plan)
            assert bool(torch.isfinite(out.rgb).all())
    low = looking((5.0, 6.0, -0.5), (22.0, 6.0, 3.0), 64, 48, 60.0)
    assert bool(torch.isfinite(render_buffers(scene, low, make_plan(rain(), scene)).rgb).all())
    inside = looking((21.9, 6.0, 0.06), (10.0, 6.0, 0.0), 64, 48, 60.0)
    assert bool(torch.isfinite(render_buffers(scene, inside, make_plan(rain(), scene)).rgb).all())
