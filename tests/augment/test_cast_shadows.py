"""What the ground shows of the sun: found where it was put, and not in dark asphalt."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.street.layout import parse_parameters
from adapters.street.world import build_street
from augment.effects.snow.light import describe_light, find_snow_light
from augment.light.cast_shadows import CastShadows, faded_shadows, shadows_of, sun_transmittance
from augment.light.scene_light import find_scene_light
from augment.light.srgb import display_from_linear, linear_from_display, luminance
from augment.render.fog import Fog
from augment.render.sh import SH_C0
from augment.scene.scene import PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers, render_view
from recipes.rain import Rain
from recipes.schema import Recipe, Render, Smog, Weather
from recipes.snow import Snow, SnowLight
from recipes.snowfall import Snowfall
from tests.snow_scenes import drive, sheet, side_wall, wall

ROAD = int(SemanticClass.ROAD)
RATIO = np.array([0.25, 0.28, 0.34])
WALL_M, HIGH_M = 6.0, 3.0
SUN_DEG = (90.0, 36.0)  # azimuth, elevation: behind the wall


def street(lit: np.ndarray, *, albedo: np.ndarray | float = 0.1) -> Scene:
    """A road between walls of HIGH_M. lit: of its splats [N], 0 to 1. albedo: of these."""
    road = sheet((-15, 15), (-WALL_M, WALL_M), semantic=ROAD)
    light = RATIO + (1 - RATIO) * lit[:, None]
    rgb = display_from_linear(2.0 * np.broadcast_to(np.asarray(albedo), lit.shape)[:, None] * light)
    sh = torch.from_numpy(((rgb - 0.5) / SH_C0).astype(np.float32))[:, None]
    road = dataclasses.replace(road, sh=sh)
    ends = ((-15, 15), (0.1, HIGH_M))
    walls = [side_wall(WALL_M, *ends), side_wall(-WALL_M, *ends)]
    return drive(road, *walls, wall(15, (-WALL_M, WALL_M), (0.1, HIGH_M)), ground_z_m=0.0)


def places() -> np.ndarray:
    return sheet((-15, 15), (-WALL_M, WALL_M)).means.numpy()


def in_sun() -> np.ndarray:
    """Of the road's splats, under the sun of SUN_DEG."""
    reach_m = HIGH_M / np.tan(np.radians(SUN_DEG[1]))
    return (places()[:, 1] < WALL_M - reach_m).astype(float)


def found(scene: Scene) -> CastShadows:
    shadows = shadows_of(scene)
    assert shadows is not None
    return shadows


def test_the_sun_is_where_shadows_say():
    shadows = found(street(in_sun()))
    assert shadows.certainty == 1 and shadows.explained_share.max() > 0.6
    assert abs(shadows.azimuth_deg - SUN_DEG[0]) <= 50  # a long wall's shadow tells little of it
    np.testing.assert_allclose(shadows.shade_ratio, RATIO, atol=0.03)
    spots = places()
    lit, known_share, height_m = shadows.sample(spots[:, 0], spots[:, 1])
    inner = known_share > 0.99
    assert inner.mean() > 0.7 and np.abs(height_m[inner]).max() < 0.02
    assert ((lit > 0.5) == (in_sun() > 0.5))[inner].mean() > 0.95
    beyond = shadows.sample(np.array([1e6, np.nan]), np.array([0.0, 0.0]))
    assert beyond[1].tolist() == [0, 0]


def test_dark_asphalt_is_no_shadow_and_a_grey_day_has_none():
    spots = places()
    patched = np.where((spots[:, 0] > -2) & (spots[:, 1] < -1), 0.06, 0.1)
    worn = 0.1 * np.exp(np.random.default_rng(1).normal(0, 0.3, len(spots)))
    for albedo in (patched, worn, 0.1):
        scene = street(np.ones(len(spots)), albedo=albedo)
        shadows = found(scene)
        assert shadows.certainty == 0 and shadows.luminance_ratio == 1
        assert find_scene_light(scene).sun_share == pytest.approx(0.1)
        assert "flat" in describe_light(scene, Snow(depth_m=0.1))


def test_snow_has_the_contrast_of_the_ground():
    """Shaded over level lit snow, unless snow's own light fills the shadow or the recipe says."""

    def contrast(scene: Scene, snow: Snow) -> float:
        own = find_snow_light(scene, snow)
        lit, shadow = (
            luminance(linear_from_display(np.array(c))) for c in (own.lit_rgb, own.shadow_rgb)
        )
        return shadow / (shadow + (lit - shadow) * (own.sun[2] + own.wrap) / (1 + own.wrap))

    snow = Snow(depth_m=0.1)
    half = np.clip(in_sun() + 0.35, 0, 1)
    mild = street(half)
    ratio = found(mild).luminance_ratio
    assert 0.45 < ratio < 0.65
    assert contrast(mild, snow) == pytest.approx(ratio, abs=0.02)
    assert 0.35 < contrast(street(in_sun()), snow) < 0.5
    snow_without_sun = Snow(depth_m=0.1, light=SnowLight(sun=0.0))
    assert contrast(mild, snow_without_sun) > 0.9 and "light.sun is 0" in describe_light(
        mild, snow_without_sun
    )


def test_little_or_no_ground_tells_nothing():
    open_road = drive(sheet((-15, 15), (-6, 6), semantic=ROAD), ground_z_m=0.0)
    little = drive(sheet((0, 2), (0, 2), semantic=ROAD), wall(3, (0, 2), (0, 2)))
    for scene in (open_road, little):
        assert shadows_of(scene) is None
        assert find_scene_light(scene).shadow_ratio is None


# ---- Shadows in smog -----------------------------------------------------------------------------


def view(scene: Scene, **smog) -> np.ndarray:
    """Linear colours under smog that is next to clear but keeps the sun out."""
    recipe = Recipe(weather=Weather(smog=Smog(**{"extinction_per_m": 1e-7} | smog)))
    camera = scene.frames[0].cameras["ahead"]
    return linear_from_display(render_buffers(scene, camera, make_plan(recipe, scene)).rgb.numpy())


def test_without_the_sun_the_ground_has_one_light_and_its_mean(monkeypatch):
    scene = street(in_sun())
    rows, left, right = slice(66, 72), slice(10, 35), slice(100, 140)  # far from the edge
    before = view(scene)
    assert before[rows, left].mean() < 0.5 * before[rows, right].mean()
    for through, least, most in ((0.0, 0.85, 1.1), (0.5, 0.45, 0.75)):
        monkeypatch.setattr("augment.effects.smog.sun_transmittance", lambda *_, t=through: t)
        after = view(scene, shadow_fade=1.0)
        contrast = after[rows, left].mean() / after[rows, right].mean()
        assert least < contrast < most
        q, mean = found(scene).luminance_ratio, found(scene).lit_share
        expected = 0.2 * (q + (1 - q) * (through + (1 - through) * mean))
        assert after[rows, right].mean() == pytest.approx(expected, rel=0.1)
    np.testing.assert_array_equal(view(scene, shadow_fade=0.0), before)
    grey = street(np.ones(len(places())))
    np.testing.assert_array_equal(view(grey, shadow_fade=1.0), view(grey))


def test_smog_takes_the_sun_by_its_depth():
    shadows = found(street(in_sun()))
    climb = np.sin(np.radians(shadows.elevation_deg))
    for sigma in (0.0, 1e-4, 0.01, 100.0):
        uniform = sun_transmittance(Fog(sigma, (0.7,) * 3), shadows, 0.0)
        assert uniform == pytest.approx(np.exp(-200 * sigma / climb))
        layered = sun_transmittance(Fog(sigma, (0.7,) * 3, 20.0, 5.0), shadows, 25.0)
        assert layered == pytest.approx(np.exp(-20 * sigma * np.exp(-1) / climb))


def test_fading_comes_before_a_style():
    scene = street(in_sun())
    faded = faded_shadows(scene, 0.3)
    assert faded is not None and faded.rows.max() > 0
    part = PosedGaussians(scene.background)
    maps = torch.rand(3, 3, 4)
    classes = torch.arange(len(scene.background)).remainder(5).to(torch.int16) - 1
    for style_maps, rows in ((maps[:1], None), (maps, classes)):
        styled = dataclasses.replace(part, color_maps=style_maps, color_rows=rows)
        both = faded.apply_to(styled)
        assert both.color_maps is not None and both.color_rows is not None
        found_maps = both.color_maps[both.color_rows.long()]
        row = (
            0
            if rows is None
            else torch.where((rows >= 0) & (rows < len(style_maps)), rows, 0).long()
        )
        inner = faded.maps[faded.rows.long()][:, :, :3]
        expected = style_maps[row] if rows is not None else style_maps.expand(len(classes), 3, 4)
        torch.testing.assert_close(found_maps[..., :3], expected[..., :3] @ inner)
        torch.testing.assert_close(found_maps[..., 3], expected[..., 3].contiguous())


def test_a_photo_fades_as_its_scene(tmp_path):
    scene = street(in_sun())
    camera = scene.frames[0].cameras["ahead"]
    clear = render_view(scene, camera, Recipe()).rgb
    assert cv2.imwrite(str(tmp_path / "0.png"), clear[..., ::-1])
    frame = dataclasses.replace(scene.frames[0], image_paths={"ahead": str(tmp_path / "0.png")})
    scene = dataclasses.replace(scene, frames=(frame, *scene.frames[1:]))
    smog = Weather(smog=Smog(visibility_m=100, shadow_fade=1.0))
    splats, photo = (
        render_view(scene, camera, Recipe(weather=smog, render=Render(base=base))).rgb.astype(float)
        for base in ("splats", "recorded")
    )
    road = slice(62, 88)
    assert np.quantile(np.abs(splats - photo)[road, 10:150], 0.9) < 8


@pytest.mark.long
def test_the_streets_shadows_are_its_suns():
    query = {"seed": "3", "frames": "2"}
    body = build_street(parse_parameters(query)).static
    scene = open_scene("procedural:street?seed=3&frames=2")
    shadows = found(scene)
    x, y, z = body.lighting.to_sun
    assert shadows.certainty == 1
    assert abs(shadows.azimuth_deg - np.degrees(np.arctan2(y, x))) < 10
    assert abs(shadows.elevation_deg - np.degrees(np.arcsin(z))) < 6
    road = (scene.background.semantic == ROAD).numpy()
    spots = scene.background.means.double().numpy()[road][::7]
    spots = spots[np.abs(spots[:, 0]) < 30]
    is_lit = ~body.tree.occluded(spots + np.array([0, 0, 0.02]), body.lighting.to_sun)
    lit, known_share, _ = shadows.sample(spots[:, 0], spots[:, 1])
    assert ((lit > 0.5) == is_lit)[known_share > 0.99].mean() > 0.9


# ---- Shadows under clouds ------------------------------------------------------------------------


def sun_share_of(scene: Scene, **weather) -> float:
    return make_plan(Recipe(weather=Weather(**weather)), scene).sun_share


def test_clouds_that_rain_or_snow_take_the_sun():
    """By the rate, by the snow's own light, or as a recipe says; the shares multiply."""
    scene = street(in_sun())
    assert sun_share_of(scene) == 1
    assert sun_share_of(scene, rain=Rain(rate_mm_h=0.0, wetness=0.5)) == 1
    drizzle, rain = (sun_share_of(scene, rain=Rain(rate_mm_h=r)) for r in (0.1, 3.0))
    assert drizzle == pytest.approx(np.exp(-1)) and rain < 1e-9
    assert sun_share_of(scene, rain=Rain(rate_mm_h=3.0, shadow_fade=0.0)) == 1
    assert sun_share_of(scene, snowfall=Snowfall(rate_mm_h=1.0)) < 1e-4
    assert sun_share_of(scene, snow=Snow(depth_m=0.1)) == 1
    overcast = Snow(depth_m=0.1, light=SnowLight(sun=0.2))
    assert sun_share_of(scene, snow=overcast) == pytest.approx(0.2)
    fade = Rain(rate_mm_h=3.0, shadow_fade=0.5)
    assert sun_share_of(scene, snow=overcast, rain=fade) == pytest.approx(0.1)
    grey = street(np.ones(len(places())))
    assert sun_share_of(grey, rain=Rain(rate_mm_h=3.0)) == 1


def test_in_rain_and_snowfall_the_ground_has_one_light():
    """Splats away from the edge and splats at it: the map's metre of blur leaves no stripe."""
    scene = street(in_sun())
    faded = faded_shadows(scene, 0.0)
    assert faded is not None
    gains = faded.maps[faded.rows.long()].diagonal(dim1=1, dim2=2).numpy()
    count = len(places())
    rgb = (0.5 + SH_C0 * scene.background.sh[:count, 0].numpy()).clip(0, 1)
    before, after = (linear_from_display(c).mean(1) for c in (rgb, rgb * gains[:count]))
    lit = in_sun() > 0.5
    reach_m = HIGH_M / np.tan(np.radians(SUN_DEG[1]))
    off_edge_m = np.abs(places()[:, 1] - (WALL_M - reach_m))
    known = (np.abs(places()[:, 0]) < 10) & (np.abs(places()[:, 1]) < WALL_M - 0.6)
    for near_m, far_m in ((1.0, 3.0), (0.1, 1.0)):
        zone = known & (off_edge_m > near_m) & (off_edge_m < far_m)
        ratio = np.median(after[zone & ~lit]) / np.median(after[zone & lit])
        assert np.median(before[zone & ~lit]) < 0.35 * np.median(before[zone & lit])
        assert 0.85 < ratio < 1.15, (near_m, ratio)


def test_recipes_without_the_field_keep_their_hash_and_dry_pictures_their_bits():
    weather = Weather(rain=Rain(rate_mm_h=2.0), snow=Snow(depth_m=0.1))
    stated = Weather(rain=Rain(rate_mm_h=2.0, shadow_fade=None), snow=Snow(depth_m=0.1))
    assert Recipe(weather=weather).hash == Recipe(weather=stated).hash
    scene = street(in_sun())
    camera = scene.frames[0].cameras["ahead"]
    dry = Recipe(weather=Weather(snow=Snow(depth_m=0.1, coverage=0.0)))
    np.testing.assert_array_equal(
        render_view(scene, camera, dry).rgb, render_view(scene, camera, Recipe()).rgb
    )
