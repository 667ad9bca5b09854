"""Labels of light: boxes, the mask of glare, and the manifest's numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from augment.effects.effect import LabelInputs
from augment.effects.lamps.light_table import (
    EXPOSURE_COLUMNS,
    LIGHT_TABLE,
    lamps_of_boxes,
    measure_exposure,
    measure_light,
)
from augment.effects.lamps.luminance import MIN_VEIL, read_light
from augment.effects.lamps.view_lamps import lamps_at
from augment.lamps.lamp import LampKind
from augment.light.srgb import LUMINANCE_WEIGHTS, display_from_linear, linear_from_display
from augment.scene.boxes import WorldBoxes
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from augment.view.weathered_sweep import weathered_sweep
from recipes.schema import Recipe
from recipes.style import Style
from tests.streets import LABELLED_STREET, open_fast_street

OFF = {"vehicles": "off", "own_beams": "off", "street": "off"}
STEADY = {"time": "night", "noise": 0.0, "exposure": "fixed", "exposure_ms": 20.0, "iso": 800.0}


def light(*, labels: bool = True, **fields: object) -> Recipe:
    output = {"depth": "none", "labels": labels}
    return Recipe.model_validate({"name": "r", "output": output, "light": fields})


@pytest.fixture(scope="module")
def street():
    return open_fast_street(LABELLED_STREET)


@pytest.fixture(scope="module")
def camera(street):
    return street.frames[0].cameras["front"]


def boxes_of(street) -> WorldBoxes:
    boxes = street.labels.boxes(street.frames[0].index)
    return WorldBoxes.from_labels(boxes, street.world_origin_m)


def inputs_of(street, camera, recipe: Recipe) -> LabelInputs:
    return render_view(street, camera, recipe).effects["lamps"]


def table_of(street, camera, recipe: Recipe) -> dict[str, np.ndarray]:
    boxes = boxes_of(street)
    columns = measure_light(boxes, camera, inputs_of(street, camera, recipe))
    return {**LIGHT_TABLE.make_numbers(boxes.track_ids, **columns).columns}


def test_luminance_and_veil_equal_their_definition() -> None:
    rng = np.random.default_rng(3)
    linear = rng.uniform(0, 1, (37, 61, 3)) ** 6 * 30
    rgb = display_from_linear(linear).astype(np.float32)
    rgb[:2] = -0.1  # darker than black
    glare = (rng.uniform(0, 1, (19, 31, 3)) ** 4).astype(np.float32)  # at half the resolution
    for veil in (None, glare):
        kernel = read_light(rgb, veil, 7.0, needs_luminance=True)
        plain = read_light(rgb, veil, 7.0, needs_luminance=True, uses_kernels=False)
        np.testing.assert_allclose(kernel.luminance_cd_m2, plain.luminance_cd_m2, rtol=1e-4)
        # float32 and float64 decide differently where glare and light are nearly equal
        assert (kernel.is_veiled == plain.is_veiled).mean() > 0.999
        assert kernel.is_veiled.any() == (veil is not None)
    alone = read_light(rgb, glare, 7.0, needs_luminance=False)
    assert alone.luminance_cd_m2 is None
    assert np.array_equal(alone.is_veiled, kernel.is_veiled)


def test_a_veil_must_outshine_the_scene_and_be_seen() -> None:
    cases = (
        (0.0, 0.9 * MIN_VEIL, False),
        (0.0, 1.1 * MIN_VEIL, True),
        (0.5, 0.4, False),
        (0.02, 0.03, True),
    )
    for light_of_pixels, veil, is_veiled in cases:
        rgb = display_from_linear(np.full((3, 5, 3), light_of_pixels)).astype(np.float32)
        glare = np.full((2, 3, 3), veil, np.float32)
        reading = read_light(rgb, glare, 1.0, needs_luminance=False)
        assert (reading.is_veiled == is_veiled).all()


def test_luminance_of_a_scene_is_its_reflectance_under_the_sky(street, camera) -> None:
    luminance = {}
    for sky in (0.05, 0.5):
        for iso in (800.0, 3200.0):
            fields = {**STEADY, **OFF, "glare": 0.0, "sky_luminance_cd_m2": sky, "iso": iso}
            inputs = inputs_of(street, camera, light(**fields))
            luminance[sky, iso] = inputs.luminance_cd_m2
    road = np.s_[-12:, :]
    first = luminance[0.05, 800.0]
    # Ten times the light, and no matter how the camera exposes; 2e-3 for the table of codes.
    np.testing.assert_allclose(luminance[0.05, 3200.0], first, rtol=2e-3)
    np.testing.assert_allclose(luminance[0.5, 800.0], 10 * first, rtol=2e-3)
    # E = pi 0.05 lx on level ground, and the road has a reflectance of some 0.05 to 0.3.
    assert 0.05 * 0.05 < np.median(first[road]) < 0.3 * 0.05


def test_luminance_of_a_listed_lamp_is_in_the_picture_of_the_meter(street, camera) -> None:
    ahead = camera.centre.numpy() + 15 * camera.world_from_camera[:3, 2].numpy()
    ahead = ahead + street.world_origin_m + [0, 0, 1.0]
    lamp = {"x_m": ahead[0], "y_m": ahead[1], "z_m": ahead[2], "kind": "bulb", "candela": 500.0}
    lamp = {name: float(v) if name != "kind" else v for name, v in lamp.items()}
    fields = {**STEADY, **OFF, "glare": 0.0}
    lit = inputs_of(street, camera, light(**fields, lamps=(lamp,))).luminance_cd_m2
    dark = inputs_of(street, camera, light(**fields)).luminance_cd_m2
    added = (lit.astype(np.float64) - dark)[: camera.height // 2]
    place = camera.camera_from_world.numpy() @ [*(ahead - street.world_origin_m), 1.0]
    row = int(camera.fy * place[1] / place[2] + camera.cy)
    column = int(camera.fx * place[0] / place[2] + camera.cx)
    window = added[max(row - 3, 0) : row + 4, column - 3 : column + 4]
    # Illuminance at the lens: luminance times the solid angle of the pixels; off the axis a pixel
    # has cos^3 of the solid angle.
    distance_m = np.linalg.norm(place[:3])
    solid_angle = (place[2] / distance_m) ** 3 / (camera.fx * camera.fy)
    assert window.sum() * solid_angle == pytest.approx(500 / distance_m**2, rel=0.05)


def test_luminance_is_measured_where_boxes_are_labelled(street, camera) -> None:
    recipe = light(**STEADY)
    assert inputs_of(street, camera, recipe).luminance_cd_m2 is not None
    unlabelled = light(**STEADY, labels=False)
    assert inputs_of(street, camera, unlabelled).luminance_cd_m2 is None
    views = [render_view(street, camera, r) for r in (recipe, unlabelled)]
    assert np.array_equal(views[0].rgb, views[1].rgb)
    assert np.array_equal(views[0].masks["glare"], views[1].masks["glare"])


def test_boxes_have_the_lamps_of_their_own_tracks(street, camera) -> None:
    boxes = boxes_of(street)
    data = make_plan(light(**STEADY, vehicles="on"), street).effect_plans["lamps"].data
    lamps = lamps_at(data, street, camera)
    is_of_box = lamps_of_boxes(lamps, boxes, data)
    assert is_of_box.sum(1).max() <= 1
    tracks = [actor.track_id for actor in street.actors]
    for m in np.flatnonzero(lamps.owners > 0):
        (box,) = np.flatnonzero(is_of_box[m])
        assert boxes.track_ids[box] == tracks[lamps.owners[m] - 1]
    assert not is_of_box[np.isin(lamps.kinds, (LampKind.STREET, LampKind.OTHER))].any()
    table = table_of(street, camera, light(**STEADY, vehicles="on"))
    assert table["lamps"].max() >= 4
    for count, words in zip(table["lamps"], table["lamp_kinds"], strict=True):
        assert (count == 0) == (words == "")
        assert set(words.split()) <= {"dipped", "tail", "stop"}
    dark = table_of(street, camera, light(**STEADY, vehicles="off"))
    assert not dark["lamps"].any() and set(dark["lamp_kinds"]) == {""}


def test_illuminance_of_a_box_is_that_of_sky_and_lamps(street, camera) -> None:
    dark = {**STEADY, **OFF, "sky_luminance_cd_m2": 0.05, "moon_lux": 0.2}
    under_sky = table_of(street, camera, light(**dark))["illuminance_lux"]
    # An upright side sees half of the sky.
    np.testing.assert_allclose(under_sky, (math.pi * 0.05 + 0.2) / 2)
    boxes = boxes_of(street)
    box = int(np.argmax(boxes.is_usable))
    to_eye = camera.centre.numpy() - boxes.centres_m[box]
    to_eye[2] = 0
    to_eye /= np.linalg.norm(to_eye)
    half_m = np.abs((boxes.corners_m[box] - boxes.centres_m[box]) @ to_eye).max()
    place = boxes.centres_m[box] + (half_m + 6.0) * to_eye + street.world_origin_m
    lamp = {"x_m": float(place[0]), "y_m": float(place[1]), "z_m": float(place[2])}
    lamp |= {"kind": "bulb", "candela": 720.0}
    lit = table_of(street, camera, light(**dark, lamps=(lamp,)))["illuminance_lux"]
    # 720 cd over the square of 6 m; 1 % for the lamp's size
    assert lit[box] - under_sky[box] == pytest.approx(20.0, rel=0.01)


def test_contrast_tells_lit_boxes_from_their_surround(street, camera) -> None:
    dark = table_of(street, camera, light(**STEADY, **OFF, glare=0.0))
    beams = table_of(street, camera, light(**STEADY, **{**OFF, "own_beams": "high"}, glare=0.0))
    is_shown = dark["pixels"] > 0
    assert is_shown.any()
    for table in (dark, beams):
        assert np.isfinite(table["luminance_cd_m2"][is_shown]).all()
        assert (table["luminance_contrast"][is_shown] > -1).all()
        assert np.isnan(table["luminance_cd_m2"][~is_shown]).all()
        assert (table["saturated_pixels"] <= table["pixels"]).all()
    is_lit = beams["illuminance_lux"] > 2 * dark["illuminance_lux"]
    brighter = beams["luminance_cd_m2"] > dark["luminance_cd_m2"]
    assert brighter[is_shown & is_lit].all() and (is_shown & is_lit).any()


def test_glare_mask_is_of_saturation_alone_without_glare(street, camera) -> None:
    clean = render_view(street, camera, light(**STEADY, glare=0.0))
    mask = clean.masks["glare"] > 0
    assert 0 < mask.mean() < 0.2 and (clean.rgb[mask].max(-1) > 220).all()
    wet = render_view(street, camera, light(**STEADY, glare=10.0)).masks["glare"] > 0
    assert (wet | ~mask).all() and wet.sum() > mask.sum()


def test_manifest_has_the_exposure_that_a_recipe_fixes(street, camera) -> None:
    values = measure_exposure(camera, inputs_of(street, camera, light(**STEADY)))
    assert set(values) == set(EXPOSURE_COLUMNS)
    assert (values["light_exposure_ms"], values["light_iso"]) == (20.0, 800.0)
    # 78 / S = pi L T t / (4 N^2), with f/2 and T = 0.9
    assert values["light_white_cd_m2"] == pytest.approx(
        78 / 800 * 4 * 2.0**2 / (math.pi * 0.9 * 0.020)
    )
    assert values["light_ground_lux"] == pytest.approx(math.pi * 0.05)
    assert values["light_lamps"] >= 2  # the own beams
    by_day = measure_exposure(camera, inputs_of(street, camera, light(vehicles="on")))
    assert set(by_day) == set(EXPOSURE_COLUMNS) - {"light_exposure_ms", "light_iso"}
    assert measure_exposure(camera, inputs_of(street, camera, light(**OFF))) == {}


def test_labels_by_day_take_the_white_of_a_style(street, camera) -> None:
    recipe = light(vehicles="on")
    recipe = recipe.model_copy(update={"style": Style(preset="dusk")})
    view = render_view(street, camera, recipe)
    inputs = view.effects["lamps"]
    white_cd_m2 = measure_exposure(camera, inputs)["light_white_cd_m2"]
    codes = view.rgb / 255
    is_mid = ((codes > 0.3) & (codes < 0.9)).all(-1)
    assert is_mid.sum() > 100
    expected = linear_from_display(codes[is_mid]) @ np.array(LUMINANCE_WEIGHTS) * white_cd_m2
    # 8 bits at a code of 0.3 are 0.4 % of the code, 1 % of the light.
    np.testing.assert_allclose(inputs.luminance_cd_m2[is_mid], expected, rtol=0.02)


def test_sweeps_are_the_same_at_night(street) -> None:
    frame = street.frames[0].index
    sweep = street.lidar(frame)
    by_day = weathered_sweep(street, light(), frame, sweep)
    by_night = weathered_sweep(street, light(time="night", vehicles="on"), frame, sweep)
    assert by_day.columns.keys() == by_night.columns.keys()
    for name, column in by_day.columns.items():
        assert np.array_equal(column, by_night.columns[name]), name


def test_damaged_boxes_have_no_light(street, camera) -> None:
    inputs = inputs_of(street, camera, light(**STEADY))
    labels = street.labels.boxes(street.frames[0].index)
    centers_m = labels.centers_m.copy()
    centers_m[0] = math.nan
    boxes = WorldBoxes.from_labels(replace(labels, centers_m=centers_m), street.world_origin_m)
    columns = measure_light(boxes, camera, inputs)
    assert math.isnan(columns["illuminance_lux"][0]) and columns["lamps"][0] == 0
    assert np.isfinite(columns["illuminance_lux"][1:]).all()
