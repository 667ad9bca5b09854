"""The colours that weather adds: one exposure for all cameras, whatever their colour maps."""

import dataclasses

import numpy as np
import pytest
import torch

from augment.effects.falling.air import glow_of
from augment.light.common_exposure import AddedColors, added_colors, exposure_change
from augment.scene.cameras import Camera
from augment.scene.scene import Ground, Scene
from augment.scene.sky import CubemapSky
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.flood import Flood
from recipes.rain import Rain
from recipes.schema import Recipe, Render, Weather
from recipes.snow import Snow
from recipes.snowfall import Snowfall
from tests.scenes import camera_ahead
from tests.snow_scenes import drive, sheet

# Cameras: one exposes less, one more and with another white balance, and one has no map.
MAPS = {
    "left": torch.tensor([[0.8, 0.02, 0, -0.03], [0, 0.78, 0, 0.01], [0.03, 0, 0.75, 0.0]]),
    "right": torch.tensor([[1.1, 0, 0, 0.0], [0, 1.05, 0.05, 0.02], [0, 0, 1.2, 0.01]]),
}
CAMERAS = ("left", "right", "rear")
DENSE = {"rate_mm_h": 100.0}
GREY_LEVEL = 1 / 255


@pytest.fixture(scope="module")
def road() -> Scene:
    """A road of 60 m under a blue sky, in three cameras of one place."""
    known = Ground(0.0, 0.0, "stated", None, 0, None)
    plain = drive(
        sheet((1.0, 60.0), (-4.0, 4.0)), places=((0.0, 0.0, 1.5),), ground=known, ground_z_m=0.0
    )
    names = {name: camera(name) for name in CAMERAS}
    frame = dataclasses.replace(plain.frames[0], cameras=names)
    blue = CubemapSky(torch.tensor([0.3, 0.45, 0.8]).expand(6, 4, 4, 3).contiguous())
    return dataclasses.replace(plain, frames=(frame,), sky=blue)


@pytest.fixture(scope="module")
def mapped(road) -> Scene:
    """The same road, with the cameras' colour maps."""
    return dataclasses.replace(road, color_maps=MAPS)


def camera(name: str) -> Camera:
    return dataclasses.replace(camera_ahead(80, 46, 40.0, position=(0.0, 0.0, 1.5)), name=name)


def picture(scene: Scene, name: str, exposure: str, **weather):
    recipe = Recipe(weather=Weather(**weather), render=Render(exposure=exposure))
    return render_buffers(scene, camera(name), make_plan(recipe, scene), backend="cpu")


def spread(scene: Scene, exposure: str, area, **weather) -> float:
    """Return the largest difference of the cameras' mean colours of an area, a channel."""
    images = [picture(scene, name, exposure, **weather) for name in CAMERAS]
    return float(np.ptp([i.rgb[area(i)].mean(0).numpy() for i in images], axis=0).max())


def snow_area(buffers):
    return buffers.masks["snow"] & (buffers.raster.overlay > 0.99)


def low_sky(buffers):
    rows = torch.zeros(buffers.rgb.shape[:2], dtype=torch.bool)
    rows[19:22] = True  # 1 to 6 degrees over the horizon
    return rows


def water_area(buffers):
    return buffers.masks["water"]


@pytest.mark.parametrize(
    ("area", "weather", "limit"),
    [
        (snow_area, {"snow": Snow(depth_m=0.1)}, 0.2 * GREY_LEVEL),  # nothing shines through
        (snow_area, {"snow": Snow(depth_m=0.1, shading="per_pixel")}, 0.2 * GREY_LEVEL),
        # The veil leaves up to a hundredth of the cameras' own sky.
        (low_sky, {"rain": Rain(**DENSE, wetness=0)}, 2 * GREY_LEVEL),
        (low_sky, {"rain": Rain(**DENSE, wetness=0, color=(0.6, 0.62, 0.7))}, 2 * GREY_LEVEL),
        (low_sky, {"snowfall": Snowfall(rate_mm_h=20.0)}, 2 * GREY_LEVEL),
        # Without reflection, muddy water shows its own colour.
        (
            water_area,
            {"flood": Flood(level_m=0.5, absorption_per_m=(90, 90, 90), refraction_index=1.0)},
            2 * GREY_LEVEL,
        ),
    ],
)
def test_what_weather_adds_has_one_colour_in_all_cameras(mapped, area, weather, limit):
    assert spread(mapped, "recorded", area, **weather) > 30 * GREY_LEVEL
    assert spread(mapped, "common", area, **weather) < limit


def test_snow_has_the_colour_that_the_mean_map_gives_it(road, mapped):
    """C(A), with A the snow's colour without any map."""
    plain = picture(road, "left", "common", snow=Snow(depth_m=0.1))
    common = torch.stack(list(MAPS.values())).mean(0)
    expected = plain.rgb @ common[:, :3].T + common[:, 3]
    got = picture(mapped, "left", "common", snow=Snow(depth_m=0.1))
    area = snow_area(plain)
    # Discs of opacity 0.98 leave up to 1 / 200 of the road; damping moves colours by 2e-4.
    assert float((got.rgb - expected)[area].abs().max()) < 3e-3


def test_surfaces_and_sky_keep_the_exposure_of_their_camera(mapped):
    for name in CAMERAS:
        common, recorded = (
            picture(mapped, name, exposure, snow=Snow(depth_m=0.1))
            for exposure in ("common", "recorded")
        )
        bare = common.raster.overlay == 0
        assert bool(bare.any())
        assert torch.equal(common.rgb[bare], recorded.rgb[bare])


def test_without_maps_or_with_one_map_for_all_no_bit_changes(road):
    one_map = dataclasses.replace(road, color_maps=dict.fromkeys(CAMERAS, MAPS["left"]))
    weather = {"snow": Snow(depth_m=0.1), "rain": Rain(rate_mm_h=20.0)}
    for scene in (road, one_map):
        common, recorded = (
            picture(scene, "left", exposure, **weather).rgb for exposure in ("common", "recorded")
        )
        # The mean of equal maps is that map, up to the rounding of a mean.
        assert float((common - recorded).abs().max()) < 1e-6
    assert torch.equal(*(picture(road, "left", e, **weather).rgb for e in ("common", "recorded")))


def test_light_of_drops_is_mapped_as_its_colour_is(mapped):
    """Squares of colours: light and its slope agree with differences of mapped colours."""
    colors = added_colors(mapped, camera("right"))
    assert colors is not None
    glow = glow_of(mapped)
    light, step = glow.mean, 1e-6
    mapped_slope = colors.slope_of_light(light, glow.slope)
    for axis in range(3):
        differences = colors.of_light(light + step * glow.slope[:, axis])
        differences = (differences - colors.of_light(light)) / step
        # Second-order terms of a step of 1e-6.
        np.testing.assert_allclose(mapped_slope[:, axis], differences, rtol=1e-4, atol=1e-6)


def test_colours_never_fall_below_black():
    dark = torch.tensor([[1.0, 0, 0, 0.5], [0, 1, 0, 0.5], [0, 0, 1, 0.5]])
    change = exposure_change(dark, torch.eye(3, 4).double())
    colors = AddedColors((torch.eye(3, 4).double() + change).float())
    assert colors.of_color((0.1, 0.2, 0.3)) == (0.0, 0.0, 0.0)
    assert colors.of_color((0.9, 0.9, 0.9)) == pytest.approx((0.4, 0.4, 0.4), abs=1e-3)
