"""The effect lamps in whole pictures: what changes, what keeps its bits, what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from augment.effects.lamps.plan import EMITTERS
from augment.effects.lamps.recording_car import light_recording_car
from augment.effects.lamps.scene_exposure import exposure_of
from augment.effects.lamps.view_lamps import lamps_at
from augment.errors import ClimateGSError
from augment.lamps.lamp import EGO_OWNER
from augment.scene.scene import Scene
from augment.view.plan import make_plan, plan_view
from augment.view.render_view import render_buffers, render_view, render_views
from recipes.errors import RecipeError
from recipes.light import Light
from recipes.load import load_recipe, parse_recipe
from recipes.schema import Recipe
from tests.streets import open_fast_street

OUTPUT = {"depth": "none", "labels": False}


def recipe_of(**sections: object) -> Recipe:
    return Recipe.model_validate({"name": "r", "output": OUTPUT, **sections})


def light(**fields: object) -> Recipe:
    return recipe_of(light=fields)


@pytest.fixture(scope="module")
def street() -> Scene:
    return open_fast_street(has_wet_ground=True)


@pytest.fixture(scope="module")
def camera(street):
    return street.frames[0].cameras["front"]


@pytest.fixture(scope="module")
def clear(street, camera):
    return render_view(street, camera, recipe_of()).rgb


def test_pictures_by_day_without_lamps_in_view_keep_their_bits(street, camera, clear) -> None:
    for fields in (
        {},  # auto: a clear day
        {"vehicles": "off", "street": "off", "own_beams": "dipped"},
        {"vehicles": "on", "vehicle_share": 0.0, "street": "off"},
    ):
        assert np.array_equal(render_view(street, camera, light(**fields)).rgb, clear), fields


def test_lamps_by_day_change_pixels_about_them_alone(street, camera, clear) -> None:
    rgb = render_view(street, camera, light(vehicles="on")).rgb
    changed = (rgb != clear).any(-1)
    assert 0 < changed.mean() < 0.02
    assert (rgb[changed].astype(int) >= clear[changed].astype(int)).all()


def test_lamps_bloom_by_day_as_far_as_the_glass_is_dirty(street, camera, clear) -> None:
    changed = []
    for glare in (0.0, 1.0, 10.0):
        gloomy = light(vehicles="on", sky_luminance_cd_m2=300.0, glare=glare)
        changed.append((render_view(street, camera, gloomy).rgb != clear).any(-1).sum())
    assert 0 < changed[0] < changed[1] < changed[2]


def test_white_balance_takes_the_warmth_out_of_the_road(street, camera) -> None:
    warmth = []
    for share in (0.0, 0.6, 1.0):
        night = light(time="night", noise=0.0, street_kelvin=2200.0, white_balance=share)
        road = render_view(street, camera, night).rgb[3 * camera.height // 4 :].astype(float)
        warmth.append(road[..., 0].mean() / road[..., 2].mean())
    assert warmth[0] > 1.5 and warmth[0] > 1.2 * warmth[1] > 1.2 * warmth[2]


def test_paint_of_the_recording_car_is_lit_evenly(street, camera) -> None:
    lamps = lamps_at(
        make_plan(light(time="night"), street).effect_plans["lamps"].data, street, camera
    )
    rgb = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    added = np.zeros_like(rgb)
    pixels = np.zeros(rgb.shape[:2], bool)
    pixels[-9:] = True
    light_recording_car(added, pixels, rgb, 0.9, lamps, camera, uses_kernels=True)
    assert not added[:-9].any()
    assert (added[-9:] > 0).all() and np.ptp(added[-9:], axis=(0, 1)).max() == 0
    own = lamps.select(lamps.owners == EGO_OWNER)
    again = added.copy()
    light_recording_car(again, pixels, rgb, 0.9, own, camera, uses_kernels=True)
    assert np.array_equal(again, added)


def test_night_is_dark_but_for_lamps(street, camera, clear) -> None:
    off = {"vehicles": "off", "own_beams": "off", "street": "off"}
    dark = render_view(street, camera, light(time="night", noise=0.0, **off)).rgb
    lit = render_view(street, camera, light(time="night", noise=0.0)).rgb
    assert dark.mean() < 0.15 * clear.mean()
    assert (lit > 250).any() and not (dark > 128).any()
    # both are metered: at equal exposure lamps only add light
    fixed = {"time": "night", "noise": 0.0, "glare": 0.0, "exposure": "fixed", "iso": 1600.0}
    fixed["white_balance"] = 0.0
    dark = render_view(street, camera, light(**fixed, **off)).rgb.astype(int)
    lit = render_view(street, camera, light(**fixed)).rgb.astype(int)
    assert (lit >= dark - 1).all() and (lit - dark).mean() > 1


def test_own_beams_light_the_road_ahead(street, camera) -> None:
    lone = {"time": "night", "vehicles": "off", "street": "off", "noise": 0.0}
    lone |= {"exposure": "fixed", "exposure_ms": 30.0}
    dark = render_view(street, camera, light(**lone, own_beams="off")).rgb
    dipped = render_view(street, camera, light(**lone, own_beams="dipped")).rgb
    high = render_view(street, camera, light(**lone, own_beams="high")).rgb
    lower = slice(2 * camera.height // 3, None)
    assert dipped[lower].mean() > dark[lower].mean() + 5
    upper = slice(0, camera.height // 2)
    assert high[upper].mean() > dipped[upper].mean()


def test_fog_turns_lamps_on_by_itself_and_shows_their_halos(street, camera) -> None:
    fog = {"smog": {"visibility_m": 60.0, "blend": "linear"}}
    plain = render_view(street, camera, recipe_of(weather=fog)).rgb.astype(int)
    lit = render_view(street, camera, recipe_of(weather=fog, light={})).rgb.astype(int)
    assert (lit - plain).max() > 10 and (lit >= plain).all()
    thin = {"smog": {"visibility_m": 5000.0}}
    plan = make_plan(recipe_of(weather=thin, light={}), street)
    assert plan.effect_plans["lamps"].data is None


def test_a_picture_is_the_same_alone_in_sequence_and_of_a_fresh_scene(street) -> None:
    recipe = recipe_of(light={"time": "night"}, weather={"rain": {"rate_mm_h": 5.0}})
    cameras = [frame.cameras[name] for frame in street.frames for name in ("front", "back")]
    sequence = [view.rgb for view in render_views(street, cameras, recipe)]
    for camera, rgb in reversed(list(zip(cameras, sequence, strict=True))):
        assert np.array_equal(render_view(street, camera, recipe).rgb, rgb)
    fresh = open_fast_street(has_wet_ground=True)
    assert np.array_equal(render_view(fresh, cameras[-1], recipe).rgb, sequence[-1])


def test_seeds_change_the_noise_and_nothing_else_of_the_light(street, camera) -> None:
    base = light(time="night", vehicles="off")
    other = base.model_copy(update={"seed": 7})
    first = render_view(street, camera, base).rgb.astype(int)
    second = render_view(street, camera, other).rgb.astype(int)
    assert (first != second).any()
    assert np.abs(first.mean((0, 1)) - second.mean((0, 1))).max() < 1
    quiet = {"time": "night", "vehicles": "off", "noise": 0.0}
    views = [
        render_view(street, camera, light(**quiet).model_copy(update={"seed": seed})).rgb
        for seed in (0, 7)
    ]
    assert np.array_equal(*views)


def test_exposure_is_one_for_the_scene(street) -> None:
    recipe = light(time="dusk")
    data = make_plan(recipe, street).effect_plans["lamps"].data
    exposure = exposure_of(data, street)
    fresh = open_fast_street()
    assert exposure_of(make_plan(recipe, fresh).effect_plans["lamps"].data, fresh) == exposure
    assert 0 < exposure.scale < 10


def test_cameras_with_other_recorded_exposures_show_one_night(street, camera) -> None:
    dimmed = torch.eye(3, 4) * 0.7
    mapped = replace(street, color_maps={"front": dimmed})
    recipe = light(time="night", noise=0.0, glare=0.0)
    plain = render_view(street, camera, recipe).rgb.astype(int)
    other = render_view(mapped, camera, recipe).rgb.astype(int)
    # By day the codes differ by 0.7, and light by half. At night what differs is the sRGB curve's
    # departure from a power law.
    assert np.abs(plain - other).mean() < 3
    by_day = [render_view(scene, camera, recipe_of()).rgb.mean() for scene in (street, mapped)]
    assert by_day[1] / by_day[0] == pytest.approx(0.7, abs=0.01)


def test_explain_names_lamps_and_their_passes(street, camera) -> None:
    plan = make_plan(light(time="night"), street)
    steps = {step.name: step for step in plan_view(plan, street, camera).steps}
    assert steps[EMITTERS].runs and "street lamps" in steps[EMITTERS].why
    assert "own dipped beams" in steps[EMITTERS].why
    assert "ISO" in steps["hour and exposure"].why


def test_lamps_of_the_recipe_shine_where_they_are(street, camera) -> None:
    ahead = camera.centre.numpy() + 12 * camera.world_from_camera[:3, 2].numpy()
    ahead = ahead + street.world_origin_m
    lamp = {"x_m": ahead[0], "y_m": ahead[1], "z_m": ahead[2] + 1.0}
    lamp = {key: float(value) for key, value in lamp.items()}
    lamp |= {"candela": 2000.0, "kind": "bulb", "color": "green"}
    off = {"vehicles": "off", "own_beams": "off", "street": "off", "noise": 0.0, "glare": 0.0}
    off |= {"time": "night", "exposure": "fixed", "iso": 400.0}
    dark = render_view(street, camera, light(**off)).rgb.astype(int)
    lit = render_view(street, camera, light(**off, lamps=(lamp,))).rgb.astype(int)
    row, column = np.unravel_index((lit - dark).sum(-1).argmax(), dark.shape[:2])
    point = np.array([*ahead[:2], ahead[2] + 1.0]) - street.world_origin_m
    point = camera.camera_from_world.numpy() @ [*point, 1.0]
    assert abs(camera.fx * point[0] / point[2] + camera.cx - column - 0.5) <= 1
    assert abs(camera.fy * point[1] / point[2] + camera.cy - row - 0.5) <= 1
    assert lit[row, column, 1] >= lit[row, column, 0]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ("{candela: -1, x_m: 0, y_m: 0, z_m: 5}", "light.lamps[0].candela"),
        ("{candela: 1, x_m: 0, y_m: 0, z_m: 5, kind: sun}", "light.lamps[0].kind"),
        ("{candela: 1, x_m: 0, y_m: 0}", "light.lamps[0]"),
    ],
)
def test_wrong_lamps_are_refused_with_their_place(fields: str, words: str) -> None:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(f"light:\n  lamps:\n    - {fields}\n", source="r.yaml", name="r")
    assert words in str(caught.value)


def test_wrong_exposures_and_too_many_lamps_are_refused() -> None:
    for fields in ({"exposure_ms": 0}, {"iso": 0}, {"f_number": 0}, {"sky_luminance_cd_m2": -1}):
        with pytest.raises(ValueError, match=next(iter(fields))):
            Light(**fields)
    lamp = {"x_m": 0.0, "y_m": 0.0, "z_m": 5.0, "candela": 1.0}
    with pytest.raises(ValueError, match="lamps"):
        Light(lamps=(lamp,) * 10_000)


def test_lamps_under_the_ground_are_refused(street, camera) -> None:
    lamp = {"x_m": 0.0, "y_m": 0.0, "z_m": -5.0, "candela": 1.0}
    with pytest.raises(ClimateGSError, match="under the road"):
        render_view(street, camera, light(time="night", lamps=(lamp,)))


def test_extreme_nights_are_finite(street, camera) -> None:
    for fields in (
        {"sky_luminance_cd_m2": 0.0, "vehicles": "off", "own_beams": "off", "street": "off"},
        {"sky_luminance_cd_m2": 1e5, "iso": 1e6, "exposure_ms": 1000.0, "exposure": "fixed"},
        {"iso": 1.0, "f_number": 32.0, "exposure_ms": 1e-3, "glare": 20.0, "noise": 4.0},
        {"street_lumen": 200000.0, "street_spacing_m": 5.0, "moon_lux": 1.0, "glow": 20.0},
    ):
        plan = make_plan(light(time="night", **fields), street)
        rgb = render_buffers(street, camera, plan).rgb  # before 8 bits, which hide NaN
        assert rgb.shape == (camera.height, camera.width, 3), fields
        assert rgb.isfinite().all(), fields


@pytest.mark.parametrize("name", ["night", "night-rain", "night-fog", "dusk-lamps", "foggy-lamps"])
def test_presets_state_light_and_turn_lamps_on(name: str, street) -> None:
    recipe = load_recipe(name).resolve(0)
    assert recipe.light is not None
    assert recipe.light.is_dark == (name != "foggy-lamps")
    data = make_plan(recipe, street).effect_plans["lamps"].data
    assert data is not None and data.has_vehicle_lamps
