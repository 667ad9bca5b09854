"""Water and drops under lamps, in whole pictures: wet ground, floods, rain and snow at night."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from augment.light.srgb import linear_from_display
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import WeatheredBuffers, render_buffers
from recipes.schema import Recipe
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
    scene: Scene, weather: dict[str, object], lamp: dict[str, object] = LAMP
) -> tuple[np.ndarray, WeatheredBuffers]:
    """Return the linear light that a lamp adds to each pixel, and the picture with the lamp."""
    pictures = list[np.ndarray]()
    camera = scene.frames[0].cameras["ahead"]
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
