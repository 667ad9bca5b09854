"""The blue sky in glossy surfaces turns grey; paint of other blues, and matte things, stay."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from augment.light.sky_gloss import (
    NUM_STEPS,
    GreyedGloss,
    SkyGloss,
    find_sky_gloss,
    grey_of,
    grey_weights,
    mirror_share,
)
from augment.photo.greyed_photo import FULL_EXCESS, MIN_LEVEL, grey_photo, grey_pixels
from augment.photo.greyed_photo_kernels import grey_image
from augment.photo.recorded_base import Photo
from augment.photo.sky_matte import SkyMatte
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.rain import Rain
from recipes.schema import Recipe, Render, Smog, Weather
from recipes.snow import Snow, SnowLight
from recipes.snowfall import Snowfall
from tests.snow_scenes import drive, sheet, wall

BLUE = (0.46, 0.56, 0.71)  # a clear sky
GLOSS = SkyGloss(BLUE, (1.0, 1.0, 1.0))
GREY = np.array([0.3, 0.3, 0.3], np.float32)
PAINT = np.array([0.05, 0.15, 0.5], np.float32)  # more saturated than the sky
BUILDING = int(SemanticClass.BUILDING)
PEDESTRIAN = int(SemanticClass.PEDESTRIAN)


def mixed(share: float) -> np.ndarray:
    """A grey body that mirrors the sky."""
    return ((1 - share) * GREY + share * np.array(BLUE)).astype(np.float32)


def colored(g: Gaussians, rgb: np.ndarray) -> Gaussians:
    sh = torch.from_numpy(((rgb - 0.5) / SH_C0).astype(np.float32)).expand(len(g), 1, 3)
    return dataclasses.replace(g, sh=sh.contiguous())


def wall_of_a_house(x_m: float, height_m: float) -> Gaussians:
    g = wall(x_m, (-6, 6), (0.1, height_m))
    return dataclasses.replace(g, semantic=torch.full((len(g),), BUILDING, dtype=torch.int16))


def street(rgb: np.ndarray, sky: tuple[float, float, float] = BLUE) -> Scene:
    """A grey road before a wall of a colour."""
    road = colored(sheet((-15, 15), (-6, 6), semantic=int(SemanticClass.ROAD)), GREY)
    house = colored(wall_of_a_house(15, 6.0), rgb)
    scene = drive(road, house, ground_z_m=0.0)
    return dataclasses.replace(scene, sky=ConstantSky(torch.tensor(sky)))


def picture(scene: Scene, **weather: object) -> np.ndarray:
    plan = make_plan(Recipe(weather=Weather.model_validate(weather)), scene)
    camera = next(iter(scene.frames[0].cameras.values()))
    return render_buffers(scene, camera, plan, backend="cpu").rgb.numpy()


def test_a_mirror_of_the_sky_has_its_hue_and_at_most_its_saturation():
    shares = mirror_share(np.stack([mixed(s) for s in (0.0, 0.1, 0.3, 0.6, 1.0)]), GLOSS)
    assert shares[0] == 0 and shares[-1] == 1 and (np.diff(shares) >= 0).all() and shares[2] > 0.9
    others = np.array([PAINT, [0.5, 0.1, 0.1], [0.2, 0.5, 0.2], [0.5, 0.3, 0.6], [0.2, 0.6, 0.6]])
    np.testing.assert_array_equal(mirror_share(others.astype(np.float32), GLOSS), 0)
    warm = SkyGloss(BLUE, (1.1, 1.0, 0.9))  # in warm light grey things are not blue
    assert mirror_share(np.array([0.33, 0.3, 0.27], np.float32), warm) == 0


def test_the_grey_of_a_picture_is_its_roads_within_limits():
    assert grey_of(np.tile(np.array([0.27, 0.3, 0.33], np.float32), (200, 1))) == pytest.approx(
        (0.9, 1.0, 1.1), abs=1e-5
    )
    assert grey_of(np.tile(np.array([0.6, 0.3, 0.1], np.float32), (200, 1))) == pytest.approx(
        (1.15, 1.0, 0.85)
    )
    assert grey_of(np.zeros((3, 3), np.float32)) == (1, 1, 1)


@pytest.mark.parametrize("size", [(1, 1), (7, 13), (64, 33)])
def test_the_kernel_is_its_definition(size: tuple[int, int]):
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 256, (*size, 3), np.uint8)
    levels = rng.integers(0, 256, size, np.uint8)
    grey_rgb = (0.92, 1.0, 1.08)
    out = np.empty_like(pixels)
    grey_image(
        pixels,
        levels,
        MIN_LEVEL,
        np.array(grey_rgb, np.float32),
        np.array(grey_weights(grey_rgb), np.float32),
        np.float32(0.8),
        np.float32(FULL_EXCESS),
        out,
    )
    difference = out.astype(int) - grey_pixels(pixels, levels, grey_rgb, 0.8)
    assert np.abs(difference).max() <= 1  # sums in another order may round to the next level
    assert (difference != 0).mean() < 0.01
    np.testing.assert_array_equal(grey_pixels(pixels, levels, grey_rgb, 0.0), pixels)


def test_only_glossy_classes_of_a_photo_turn_grey():
    height, width = 60, 90
    pixels = np.tile(np.rint(255 * mixed(0.6)).astype(np.uint8), (height, width, 1))
    classes = np.full((height, width), BUILDING, np.int16)
    classes[:, 30:60] = PEDESTRIAN
    classes[:, 60:] = -1
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera("front", width, height, 80.0, 80.0, 45.0, 30.0, pose, 0)
    photo = Photo(camera, pixels, "cpu")
    greyed = grey_photo(photo, classes, GLOSS, 1.0).pixels.astype(int)
    pane = greyed[20, 10]
    assert pane[2] - pane[0] <= 2 < pixels[20, 10, 2].astype(int) - pixels[20, 10, 0]
    assert pane @ grey_weights((1.0, 1.0, 1.0)) == pytest.approx(
        pixels[20, 10] @ np.array(grey_weights((1.0, 1.0, 1.0))), abs=1
    )
    # The share is smoothed over SMOOTHING_PX, and so greys a class within two pixels of its border.
    np.testing.assert_array_equal(greyed[:, 32:], pixels[:, 32:])
    assert grey_photo(photo, classes, SkyGloss((0.7, 0.7, 0.71), (1.0, 1.0, 1.0)), 1.0) is photo


def test_pixels_that_show_some_sky_keep_their_bits_beside_a_mirroring_building():
    height, width = 60, 90
    pixels = np.tile(np.rint(255 * mixed(0.6)).astype(np.uint8), (height, width, 1))
    sky_share = np.zeros((height, width), np.float32)
    sky_share[:, 60:] = 1.0
    sky_share[:, 58:60] = 0.4  # a soft edge
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera("front", width, height, 80.0, 80.0, 45.0, 30.0, pose, 0)
    matte = SkyMatte(sky_share, pixels, np.zeros_like(pixels))
    classes = np.full((height, width), BUILDING, np.int16)
    greyed = grey_photo(Photo(camera, pixels, "cpu", matte=matte), classes, GLOSS, 1.0).pixels
    np.testing.assert_array_equal(greyed[:, 58:], pixels[:, 58:])
    assert (greyed[:, :57, 2].astype(int) - greyed[:, :57, 0] <= 2).all()


def test_rain_greys_a_pane_of_a_photo_and_not_the_recording_car(tmp_path):
    scene = street(GREY)
    camera = scene.frames[0].cameras["ahead"]
    photo = np.random.default_rng(0).integers(70, 85, (90, 160, 1), np.uint8).repeat(3, 2)
    photo[:21] = (235, 228, 220)
    pane = (slice(26, 37), slice(70, 110))
    photo[pane] = np.rint(255 * mixed(0.6))
    # Before the house, as blue as the pane, and most of the pixels in which the scene has a road.
    car = (slice(48, None), slice(None))
    photo[car] = np.rint(255 * mixed(0.6))
    path = tmp_path / "0.png"
    assert cv2.imwrite(str(path), photo[..., ::-1])
    frame = dataclasses.replace(scene.frames[0], image_paths={"ahead": str(path)})
    mask = np.zeros((90, 160), bool)
    mask[car] = True
    scene = dataclasses.replace(scene, frames=(frame,), ego_masks={"ahead": mask})
    images = []
    for fade in (0.0, None):
        rain = {"rate_mm_h": 5.0, "wetness": 0.0, "gloss_fade": fade}
        weather = Weather.model_validate({"rain": rain})
        plan = make_plan(Recipe(weather=weather, render=Render(base="recorded")), scene)
        images.append(render_buffers(scene, camera, plan, backend="cpu").rgb.numpy())
        np.testing.assert_array_equal(np.rint(255 * images[-1])[mask], photo[mask])
    excess = [(image[..., 2] - image[..., 0])[pane].mean() for image in images]
    assert excess[1] < 0.35 * excess[0]  # the rain's veil has the sky's blue as well


def test_splats_that_mirror_the_sky_turn_grey_under_rain():
    scene = street(mixed(0.6))
    before = picture(scene, rain={"rate_mm_h": 5.0, "wetness": 0.0, "gloss_fade": 0.0})
    after = picture(scene, rain={"rate_mm_h": 5.0, "wetness": 0.0})
    is_wall = (before[..., 2] - before[..., 0] > 0.05) & (np.abs(after - before).max(-1) > 0.01)
    assert is_wall.mean() > 0.02
    excess = [(image[..., 2] - image[..., 0])[is_wall].mean() for image in (before, after)]
    assert excess[1] < 0.35 * excess[0]  # the rain's veil has the sky's blue as well


def test_without_gloss_no_bit_changes():
    for rgb in (GREY, PAINT):
        scene = street(rgb)
        gloss = find_sky_gloss(scene)
        assert gloss is not None
        part = PosedGaussians(scene.background)
        assert GreyedGloss(gloss, 1.0).apply_to(part) is part
        rain = {"rate_mm_h": 5.0, "wetness": 0.0}
        np.testing.assert_array_equal(
            picture(scene, rain=rain), picture(scene, rain={**rain, "gloss_fade": 0.0})
        )


def test_a_styles_maps_come_after_the_gloss():
    g = colored(wall_of_a_house(15, 1.0), mixed(0.6))
    style_map = torch.tensor([[[0.5, 0.2, 0.0, 0.1], [0.0, 0.9, 0.1, 0.0], [0.3, 0.0, 0.6, 0.05]]])
    styled = PosedGaussians(g, color_maps=style_map)
    greyed = GreyedGloss(GLOSS, 1.0)
    plain = greyed.apply_to(PosedGaussians(g))
    both = greyed.apply_to(styled)
    assert plain.color_maps is not None and both.color_maps is not None
    assert plain.color_rows is not None and both.color_rows is not None
    assert len(plain.color_maps) == NUM_STEPS + 1
    color = torch.from_numpy(mixed(0.6))
    grey = plain.color_maps[int(plain.color_rows[0])][:, :3] @ color
    assert float(grey.max() - grey.min()) < 0.02
    combined = both.color_maps[int(both.color_rows[0])]
    torch.testing.assert_close(
        combined[:, :3] @ color + combined[:, 3], style_map[0, :, :3] @ grey + style_map[0, :, 3]
    )


def fade_of(scene: Scene, **weather: object) -> float:
    return make_plan(Recipe(weather=Weather.model_validate(weather)), scene).gloss_fade


def test_weather_hides_the_blue_sky_by_its_rate_or_light():
    scene = street(mixed(0.6))
    assert fade_of(scene) == 0
    assert fade_of(scene, smog=Smog(visibility_m=100)) == 0
    assert fade_of(scene, smog=Smog(visibility_m=100, gloss_fade=0.7)) == pytest.approx(0.7)
    drizzle, rain = (fade_of(scene, rain=Rain(rate_mm_h=rate)) for rate in (0.1, 3.0))
    assert drizzle == pytest.approx(0.632, abs=0.001) and rain > 0.999
    assert fade_of(scene, rain=Rain(rate_mm_h=0.0, wetness=0.5)) == 0
    assert fade_of(scene, snowfall=Snowfall(rate_mm_h=1.0)) > 0.999
    assert fade_of(scene, snow=Snow(depth_m=0.1)) == 0
    overcast = Snow(depth_m=0.1, light=SnowLight(sun=0.2))
    assert fade_of(scene, snow=overcast) == pytest.approx(0.8)
    assert fade_of(scene, snow=overcast, rain=Rain(rate_mm_h=3.0, gloss_fade=0.5)) == pytest.approx(
        0.9
    )
    grey_sky = street(mixed(0.6), sky=(0.7, 0.71, 0.72))
    assert fade_of(grey_sky, rain=Rain(rate_mm_h=3.0)) == 0
    background = dataclasses.replace(scene.background, semantic=None)
    unknown = dataclasses.replace(scene, background=background)
    assert fade_of(unknown, rain=Rain(rate_mm_h=3.0)) == 0
