"""The section `light` at its extremes and with bad input: finite frames, reasons, fallbacks."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from augment.effects.lamps.light_table import measure_exposure, measure_light
from augment.effects.lamps.plan import EMITTERS
from augment.errors import ClimateGSError, LampError
from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from recipes.errors import RecipeError
from recipes.load import load_recipe, parse_recipe
from recipes.schema import Recipe
from tests.augment.extremes import Place, cameras, places, recipes, rendered
from tests.augment.hard_scenes import drawing
from tests.streets import open_fast_street


def recipe_of(**sections: object) -> Recipe:
    return Recipe.model_validate({"name": "r", "output": {"depth": "none"}, **sections})


@pytest.fixture(scope="module")
def street() -> Scene:
    return open_fast_street()


@pytest.fixture(scope="module")
def camera(street) -> Camera:
    return street.frames[0].cameras["front"]


def step_reason(recipe: Recipe, scene: Scene) -> str:
    steps = {step.name: step for step in make_plan(recipe, scene).steps}
    return steps[EMITTERS].why


@drawing(4)
@given(places(), cameras(), recipes(frozenset({"light"})))
def test_any_scene_from_anywhere_at_any_hour(place: Place, camera: Camera, recipe: Recipe):
    rendered(place.scene(), camera, recipe)


@pytest.mark.long
@drawing(6)
@given(places(), cameras(), recipes(frozenset({"light", "rain", "snowfall", "smog", "flood"})))
def test_any_scene_in_any_weather_at_any_hour(place: Place, camera: Camera, recipe: Recipe):
    rendered(place.scene(), camera, recipe)


@drawing(6)
@given(
    st.fixed_dictionaries(
        {
            "time": st.sampled_from(("day", "dusk", "night")),
            "vehicles": st.sampled_from(("on", "off")),
            "sky_luminance_cd_m2": st.sampled_from((None, 0.0, 5e-324, 1e5)),
            "moon_lux": st.sampled_from((0.0, 1.0)),
            "exposure": st.sampled_from(("auto", "fixed")),
            "exposure_ms": st.sampled_from((0.001, 1000.0)),
            "iso": st.sampled_from((1.0, 1e6)),
            "f_number": st.sampled_from((0.5, 32.0)),
            "glare": st.sampled_from((0.0, 20.0)),
            "noise": st.sampled_from((0.0, 4.0)),
        }
    )
)
def test_labels_of_light_have_no_infinite_number(fields: dict[str, object]):
    scene = open_fast_street()
    camera = scene.frames[0].cameras["front"].scaled(0.2)
    recipe = recipe_of(light=fields)
    inputs = render_view(scene, camera, recipe).effects["lamps"]
    boxes = WorldBoxes.from_labels(scene.boxes(scene.frames[0].index), scene.world_origin_m)
    table = measure_light(boxes, camera, inputs)
    for name, column in table.items():
        if column.dtype.kind == "f":
            # NaN stands for a box that no pixel shows, or that has nothing about it.
            assert not np.isinf(column).any(), name
    assert (table["illuminance_lux"][~np.isnan(table["illuminance_lux"])] >= 0).all()
    assert all(math.isfinite(value) for value in measure_exposure(camera, inputs).values())


def test_rain_falls_through_lit_fog(street, camera):
    for scale_height_m in (None, 20.0):
        smog = {"visibility_m": 150.0, "blend": "linear", "scale_height_m": scale_height_m}
        weather = {"smog": smog, "rain": {"rate_mm_h": 10.0, "spray": False}}
        recipe = recipe_of(weather=weather, light={"time": "night", "noise": 0.0})
        assert render_view(street, camera, recipe).rgb.max() > 200


@pytest.mark.parametrize(
    ("field", "name"),
    [
        ("lamps: [{candela: -1, x_m: 0, y_m: 0, z_m: 5}]", "light.lamps[0].candela"),
        ("lamps: [{candela: .nan, x_m: 0, y_m: 0, z_m: 5}]", "light.lamps[0].candela"),
        ("lamps: [{candela: .inf, x_m: 0, y_m: 0, z_m: 5}]", "light.lamps[0].candela"),
        ("lamps: [{candela: 1, x_m: .inf, y_m: 0, z_m: 5}]", "light.lamps[0].x_m"),
        ("lamps: [{candela: 1, x_m: 0, y_m: 0, z_m: 5, radius_m: 0}]", "light.lamps[0].radius_m"),
        ("lamps: [{candela: 1, x_m: 0, y_m: 0, z_m: 5, kelvin: 10}]", "light.lamps[0].kelvin"),
        ("exposure_ms: 0", "light.exposure_ms"),
        ("iso: 0", "light.iso"),
        ("f_number: 0", "light.f_number"),
        ("street_lumen: -5", "light.street_lumen"),
        ("vehicle_share: 1.5", "light.vehicle_share"),
        ("sky_luminance_cd_m2: -0.1", "light.sky_luminance_cd_m2"),
        ("time: evening", "light.time"),
        ("lamps: [" + ", ".join(["{candela: 1, x_m: 0, y_m: 0, z_m: 5}"] * 1001) + "]", "1000"),
        ("street_ies: ../lamp.ies", "light.street_ies"),
        ("street_ies: /etc/passwd", "light.street_ies"),
    ],
)
def test_wrong_fields_are_refused_with_their_place(field: str, name: str):
    with pytest.raises(RecipeError) as caught:
        parse_recipe(f"light:\n  {field}\n", source="r.yaml", name="r").resolve(0)
    assert name in str(caught.value) and len(str(caught.value)) < 600


def test_lamps_in_the_ground_and_in_walls_are_refused_by_number(street, camera):
    free = camera.centre.numpy() + street.world_origin_m + [0.0, 0.0, 1.0]
    wall = street.background.means[street.background.semantic == 9][:1].double().numpy()
    places_m = {"under the road": [free[0], free[1], free[2] - 8]}
    if len(wall):
        places_m["within a surface"] = (wall[0] + street.world_origin_m).tolist()
    good = dict(zip(("x_m", "y_m", "z_m"), map(float, free), strict=True)) | {"candela": 1.0}
    for words, place in places_m.items():
        bad = good | dict(zip(("x_m", "y_m", "z_m"), map(float, place), strict=True))
        for hour in ("night", "day"):
            with pytest.raises(LampError, match=f"lamp 1 of the list.*{words}"):
                render_view(street, camera, recipe_of(light={"time": hour, "lamps": (good, bad)}))


def test_damaged_and_hostile_ies_files_stop_with_a_reason(street, camera, tmp_path: Path):
    contents = {
        b"": "no line TILT=",
        b"\x00\xff" * 5000: "no line TILT=",
        b"TILT=../../etc/passwd\n": "names another file",
        b"TILT=NONE\n1 1000 1 999999999 1 1 2 0 0 0 1 1 60\n": "vertical angles",
        b" " * 5_000_000: "at most",
    }
    for content, words in contents.items():
        (tmp_path / "lamp.ies").write_bytes(content)
        (tmp_path / "r.yaml").write_text("light: {time: night, street: on, street_ies: lamp.ies}")
        start_s = time.monotonic()
        with pytest.raises(ClimateGSError, match=words):
            render_view(street, camera, load_recipe(str(tmp_path / "r.yaml")).resolve(0))
        assert time.monotonic() - start_s < 20
    (tmp_path / "lamp.ies").unlink()
    with pytest.raises(RecipeError, match=r"lamp\.ies"):
        load_recipe(str(tmp_path / "r.yaml")).resolve(0)


def test_scenes_without_metres_say_that_distances_are_in_their_units(street, camera):
    recipe = recipe_of(light={"time": "night", "noise": 0.0})
    unscaled = replace(street, has_metric_scale=False)
    assert "metre" in step_reason(recipe, unscaled)
    assert "metre" not in step_reason(recipe, street)
    views = [render_view(scene, camera, recipe).rgb for scene in (street, unscaled)]
    assert np.array_equal(*views)


def test_drives_without_boxes_have_dark_vehicles_and_say_so(street, camera):
    bare = replace(street, labels=None, actors=())
    recipe = recipe_of(light={"time": "night", "noise": 0.0, "exposure": "fixed"})
    assert "no vehicle has a box" in step_reason(recipe, bare)
    assert "no vehicle has a box" not in step_reason(recipe, street)
    dark = recipe_of(light={**recipe.light.model_dump(exclude_none=True), "vehicles": "off"})
    assert np.array_equal(
        render_view(bare, camera, recipe).rgb, render_view(bare, camera, dark).rgb
    )


@pytest.mark.long
def test_a_thousand_listed_lamps_take_seconds(street, camera):
    centre = camera.centre.numpy() + street.world_origin_m
    ahead = camera.world_from_camera[:3, 2].numpy()
    lamps = []
    for number in range(1000):
        place = centre + (2 + 0.05 * number) * ahead + [0, 0, 12 + 0.01 * number]
        lamps.append(
            {"x_m": float(place[0]), "y_m": float(place[1]), "z_m": float(place[2])}
            | {"candela": 200.0, "kind": "bulb"}
        )
    recipe = recipe_of(light={"time": "night", "lamps": tuple(lamps)})
    render_view(street, camera, recipe)
    start_s = time.monotonic()
    view = render_view(street, camera, recipe)
    # 160x96 pixels; the limit has room for a loaded machine
    assert time.monotonic() - start_s < 20
    assert view.rgb.mean() > 1
