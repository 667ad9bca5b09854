"""Water and drops under lamps, in whole pictures: wet ground, floods, rain and snow at night."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from augment.effects.wet.film_kernels import ASPHALT_ROUGHNESS
from augment.effects.wet.ground_map import NO_PUDDLES
from augment.effects.wet.mirroring_film import mirroring_film
from augment.effects.wet.reflection import Film, Plane
from augment.lamps.road_unevenness import water_of_road
from augment.light.srgb import linear_from_display
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import WeatheredBuffers, render_buffers
from recipes.schema import Recipe
from tests.augment.test_wet import NO_RINGS, flat_map
from tests.lamp_scenes import camera_at, road_depth
from tests.snow_scenes import drive, sheet

# A camera without noise and glare, whose pictures with and without a lamp can be subtracted.
NIGHT = {
    "time": "night",
    "vehicles": "off",
    "street": "off",
    "own_beams": "off",
    "noise": 0.0,
    "glare": 0.0,
    "exposure": "fixed",
    "iso": 800.0,
    "white_balance": 0.0,
}
LAMP = {"x_m": 12.0, "y_m": 0.0, "z_m": 1.4, "candela": 200.0, "kind": "bulb"}
# Light of single drops over that of the air around them, of white. The brightest have 0.03 in rain
# and 0.1 in snow; lit air alone differs by less than 0.001 within 9 pixels.
MIN_DROP_LIGHT = 0.005


@pytest.fixture(scope="module")
def street() -> Scene:
    """A flat road, and nothing else."""
    return drive(sheet((0.6, 40), (-10, 10), semantic=int(SemanticClass.ROAD)), ground_z_m=0.0)


def lamp_gain(
    scene: Scene,
    weather: dict[str, object],
    lamp: dict[str, object] = LAMP,
    camera: Camera | None = None,
) -> tuple[np.ndarray, WeatheredBuffers]:
    """Return the linear light that a lamp adds to each pixel, and the picture with the lamp."""
    pictures = list[np.ndarray]()
    camera = camera or scene.frames[0].cameras["ahead"]
    for lamps in ((), (lamp,)):
        output = {"depth": "none", "labels": False}
        sections = {"weather": weather, "output": output, "light": {**NIGHT, "lamps": lamps}}
        recipe = Recipe.model_validate({"name": "r", **sections})
        buffers = render_buffers(scene, camera, make_plan(recipe, scene), backend="cpu")
        code = buffers.rgb.numpy().astype(np.float64).clip(0)
        pictures.append(linear_from_display(code).mean(-1))
    return pictures[1] - pictures[0], buffers


@pytest.mark.parametrize(
    "weather",
    [
        {"rain": {"rate_mm_h": 2.0, "wetness": 1.0}},
        {"flood": {"level_m": 0.3, "turbidity_ntu": 500.0, "waves": {"height": 0.0}}},
    ],
)
def test_wet_ground_and_water_mirror_a_lamp_below_it(street, weather) -> None:
    camera = street.frames[0].cameras["ahead"]
    level_m = 0.3 if "flood" in weather else 0.0
    eye_m = float(camera.centre[2]) - level_m
    row = round(camera.cy + camera.fy * (eye_m + LAMP["z_m"] - level_m) / LAMP["x_m"])
    rows = slice(row - 3, row + 4)
    column = round(camera.cx)
    streak = (rows, slice(column - 4, column + 5))
    beside = (rows, slice(column + 13, column + 22))
    dry, _ = lamp_gain(street, {})
    wet, _ = lamp_gain(street, weather)
    # What a road scatters by itself is nearly alike over a few columns; the mirror is a streak.
    assert dry[streak].mean() < 2 * dry[beside].mean()
    assert wet[streak].mean() > 8 * wet[beside].mean()
    assert wet[streak].mean() > 20 * dry[streak].mean()


def test_a_wet_road_beside_the_streak_is_no_brighter_than_a_dry_one(street) -> None:
    """Water darkens the road, and the day's sky in it is no colour of the road."""
    camera = street.frames[0].cameras["ahead"]
    dry, _ = lamp_gain(street, {})
    wet, _ = lamp_gain(street, {"rain": {"rate_mm_h": 0.1, "wetness": 1.0, "spray": False}})
    column = round(camera.cx)
    beside = (slice(-12, None), slice(column + 30, column + 50))
    assert dry[beside].mean() > 0
    assert wet[beside].mean() < 1.02 * dry[beside].mean()


@pytest.mark.parametrize("name", ["rain", "snowfall"])
def test_drops_near_a_lamp_shine_one_by_one(street, name) -> None:
    near = {**LAMP, "x_m": 6.0, "candela": 5000.0}
    section = {"rate_mm_h": 30.0, "wetness": 0.0, "spray": False}
    if name == "snowfall":
        section = {"rate_mm_h": 5.0}
    gain, buffers = lamp_gain(street, {name: section}, near)
    sky_gain = gain[:30].astype(np.float32)  # no ground, and far from the lamp itself
    single_light = sky_gain - cv2.GaussianBlur(sky_gain, (9, 9), 0)
    is_bright = single_light > MIN_DROP_LIGHT
    assert is_bright.sum() > 10
    # The mask holds pixels that a drop or flake covers by more than a twentieth.
    mask = buffers.masks[name].numpy()[:30]
    assert mask.any() and is_bright[mask].mean() > 0.9


@pytest.mark.parametrize(("name", "rate_mm_h"), [("rain", 30.0), ("snowfall", 5.0)])
def test_air_and_drops_under_lamps_have_the_showers_rate_at_the_camera(street, name, rate_mm_h):
    """It is dry where the drive began, 200 m away."""
    first = street.frames[0].cameras["ahead"]
    world_from_moved = torch.eye(4, dtype=torch.float64)
    world_from_moved[0, 3] = 200.0
    camera = replace(first, camera_from_world=first.camera_from_world @ world_from_moved)
    lamp = {**LAMP, "x_m": -194.0, "candela": 5000.0}
    section = {"wetness": 0.0, "spray": False} if name == "rain" else {}
    along = [
        {"distance_m": 0, "rate_mm_h": 0},
        {"distance_m": 50, "rate_mm_h": 0},
        {"distance_m": 50, "rate_mm_h": rate_mm_h},
    ]
    shower = {name: {**section, "rate_mm_h": 0, "along": along}}
    in_shower, _ = lamp_gain(street, shower, lamp, camera)
    everywhere, _ = lamp_gain(street, {name: {**section, "rate_mm_h": rate_mm_h}}, lamp, camera)
    assert everywhere.mean() > 1e-3
    # The veil before the lamp ends at the shower's edge, 150 m away.
    np.testing.assert_allclose(in_shower, everywhere, atol=0.02)
    assert in_shower.mean() == pytest.approx(everywhere.mean(), rel=0.02)
    dry, _ = lamp_gain(street, {}, lamp, camera)
    assert dry.mean() < 0.8 * everywhere.mean()


def test_a_wet_road_is_as_rough_as_its_slopes_have_variance() -> None:
    """Beckmann's m^2 is twice the variance of the slopes along one axis."""
    camera = camera_at(1.5, width=160, height=100, focal_px=60.0)
    depth = torch.from_numpy(road_depth(camera, 25.0))
    share = (depth > 0).float()
    film = Film(1.0, NO_PUDDLES, NO_RINGS)
    plane = Plane((0.0, 0.0, 1.0), 0.0)
    road = mirroring_film(camera, depth, share, flat_map(), film, plane, 0.0)
    water = water_of_road(road, camera)
    is_water = water.share > 0
    m = np.sqrt(2) * ASPHALT_ROUGHNESS
    assert (water.roughness[is_water] <= m * (1 + 1e-5)).all()
    # A pixel has many waves from about 5 m on: none is drawn as a tilt.
    is_far = is_water & (water.depth_m > 10)
    assert is_far.sum() > 100
    np.testing.assert_allclose(water.roughness[is_far], m, rtol=1e-5)
    assert water.tilts is not None and not water.tilts[is_far].any()
