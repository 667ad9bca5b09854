"""The recording car in recorded images: its outline by edges, and the weather that stays off it."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from augment.photo.own_car import find_own_car_mask, own_car_in_view
from augment.photo.own_car_outline import find_symmetric_outline, refine_outline
from augment.scene.scene import Scene
from augment.view.render_view import render_view
from recipes.flood import Flood, Waves
from recipes.lens_drops import LensDrops
from recipes.rain import Rain
from recipes.schema import Output, Recipe, Render, Sensor, Smog, Weather
from recipes.snow import Snow
from recipes.snowfall import Snowfall
from recipes.style import Style
from tests.adapters import drives
from tests.snow_scenes import drive, sheet, wall

SIZE = (640, 360)
FORWARD = torch.eye(4, dtype=torch.float64)
WALL_M = 20.0

# ---- Outlines ------------------------------------------------------------------------------------


def street_picture(seed: int, top: np.ndarray | None, level: int = 150) -> np.ndarray:
    """A rough dark road with lines along it below a bright sky; below `top` [W] smooth paint."""
    rng = np.random.default_rng(seed)
    width, height = SIZE
    grey = np.full((height, width), 200.0)
    rough = cv2.GaussianBlur(rng.normal(0, 60, (height, width)), (0, 0), 1.5)
    grey[180:] = 70 + rough[180:]
    for x in (120, 420):  # kerbs that run away from the camera
        cv2.line(grey, (x, height), (width // 2, 185), 230.0, 4)
    if top is not None:
        rows = np.arange(height)[:, None]
        paint = level + 0.2 * (rows - top) + 8 * np.sin(np.arange(width) / 40)
        cover = np.clip(rows + 1 - top, 0, 1)
        grey = (1 - cover) * grey + cover * paint
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7)
    return np.repeat(grey[..., None], 3, 2).clip(0, 255).astype(np.uint8)


def roof(apex: float, bow: float, tilt: float = 0.0) -> np.ndarray:
    d = (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) / (SIZE[0] / 2)
    return apex + bow * d**2 + tilt * d


def camera(frame: int = 0):
    return drives.camera("a", frame, size=SIZE, focal_px=330.0, position=(0, 0, 1.6))


@pytest.mark.parametrize(("apex", "bow", "tilt"), [(270, 25, 0), (320, 30, 3), (300, 60, -3)])
def test_a_parked_car_is_told_by_its_edge_in_one_image(apex, bow, tilt):
    top = roof(apex, bow, tilt)
    mask = find_own_car_mask([camera()], [street_picture(1, top)], [FORWARD])
    rows = np.where(mask.any(axis=0), mask.argmax(axis=0), SIZE[1])
    shown = top < SIZE[1] - 4
    # An edge of three pixels belongs to the car; noise of the road draws single columns aside.
    assert np.quantile(np.abs(rows - top)[shown], 0.95) < 4
    assert np.abs(np.median((rows - top)[shown])) < 2
    expected = np.arange(SIZE[1])[:, None] >= top
    assert (mask & expected).sum() / expected.sum() > 0.98
    assert (mask & expected).sum() / mask.sum() > 0.94


def test_nothing_is_told_where_nothing_can_be_told():
    top = roof(270, 25)
    picture = street_picture(1, top)
    assert not find_own_car_mask([camera()], [picture]).any()  # where the car heads is not known
    aside = torch.eye(4, dtype=torch.float64)
    aside[:2, :2] = torch.tensor([[0.0, -1], [1, 0]], dtype=torch.float64)
    assert not find_own_car_mask([camera()], [picture], [aside]).any()
    for seed in range(4):
        for other in (
            None,  # a road alone
            roof(300, 0),  # a stop line, a shadow: straight
            np.linspace(250, 330, SIZE[0]),  # a kerb
            roof(290, -25),  # bowed up to the sides
        ):
            assert not find_own_car_mask([camera()], [street_picture(seed, other)], [FORWARD]).any()
        # Kerbs of black and white stones, in a bend: brighter on either side in turn.
        stones = street_picture(seed, None)
        edge = np.rint(top).astype(int)
        for x in range(SIZE[0]):
            stones[edge[x] : edge[x] + 40, x] = 230 if x // 40 % 2 else 15
        assert find_symmetric_outline([stones], 0.5, 0.5) is None


def test_the_edge_that_stands_still_is_taken():
    """Edges of passing cars near the outline are stronger, but elsewhere in each image."""
    top = roof(280, 30)
    images = []
    for seed in range(8):
        image = street_picture(seed, top, level=120)
        rows = slice(240 + 4 * seed, 243 + 4 * seed)
        image[rows] = np.where(np.arange(240, 243)[:, None, None] < 0, image[rows], 255)
        body = np.arange(SIZE[1])[:, None] >= top
        image[body] = street_picture(seed, top, level=120)[body]
        images.append(image)
    rough = (top - 8) / SIZE[1]
    refined = refine_outline(images, rough)
    assert np.quantile(np.abs(refined - top), 0.95) < 4
    assert np.abs(np.median(refined - top)) < 2


# ---- Weather that stays off ----------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A road up to a wall, with noise as photos, in whose lower part a mask shows the car."""
    road, end = sheet((0.6, WALL_M), (-12, 12)), wall(WALL_M, (-12, 12), (0, 3))
    recorded_scene = drive(road, end, ground_z_m=0.0)
    frames = []
    for frame in recorded_scene.frames:
        path = tmp_path / f"{frame.index}.png"
        image = np.random.default_rng(frame.index).integers(0, 256, (90, 160, 3), np.uint8)
        assert cv2.imwrite(str(path), image)
        frames.append(dataclasses.replace(frame, image_paths={"ahead": str(path)}))
    rows, columns = np.mgrid[:90, :160]
    mask = rows >= 66 + ((columns - 80) / 40) ** 2
    return dataclasses.replace(recorded_scene, frames=tuple(frames), ego_masks={"ahead": mask})


SNOW = Snow(depth_m=0.3, cell_m=0.2, tracks="never")
FLOOD = Flood(level_m=0.6, turbidity_ntu=500.0, waves=Waves(height=0.0))
WEATHERS = {
    "snow": Weather(snow=SNOW),
    "flood": Weather(flood=FLOOD),
    "rain": Weather(rain=Rain(rate_mm_h=40.0)),
    "fog": Weather(smog=Smog(visibility_m=20.0)),
    "blizzard": Weather(snow=SNOW, snowfall=Snowfall(rate_mm_h=12.0), smog=Smog(visibility_m=60)),
}


def recipe_of(weather: Weather, **sections) -> Recipe:
    output = Output(semantic=True, instance=True, depth="expected", trust=True)
    return Recipe(weather=weather, render=Render(base="recorded"), output=output, **sections)


@pytest.mark.parametrize("name", WEATHERS)
@pytest.mark.parametrize("has_color_map", [False, True])
def test_weather_leaves_every_bit_of_the_recording_car(scene, name, has_color_map):
    if has_color_map:
        rows = [[1.2, 0.1, 0.0, -0.05], [0.0, 0.8, 0.1, 0.02], [0.05, 0.0, 1.1, 0.0]]
        scene = dataclasses.replace(scene, color_maps={"ahead": torch.tensor(rows)})
    view_camera = scene.frames[0].cameras["ahead"]
    photo = cv2.imread(scene.frames[0].image_paths["ahead"], cv2.IMREAD_COLOR_RGB)
    assert scene.ego_masks is not None
    car = scene.ego_masks["ahead"]
    view = render_view(scene, view_camera, recipe_of(WEATHERS[name]))
    np.testing.assert_array_equal(view.rgb[car], photo[car])
    beside = cv2.dilate(car.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool) & ~car
    assert (view.rgb != photo).any(-1)[40:][~car[40:]].mean() > 0.5  # the weather is there
    without = dataclasses.replace(scene, ego_masks={})
    covered = render_view(without, view_camera, recipe_of(WEATHERS[name]))
    assert (covered.rgb[car] != photo[car]).any(-1).mean() > 0.5
    # The border is soft, and beyond two pixels there is none.
    distance_px = cv2.distanceTransform((~car).astype(np.uint8), cv2.DIST_L2, 3)
    np.testing.assert_array_equal(view.rgb[distance_px > 3], covered.rgb[distance_px > 3])
    assert (view.rgb != covered.rgb).any(-1)[beside & (distance_px < 2)].any()
    for mask_name, mask in view.masks.items():
        assert not mask[car].any(), mask_name
    assert not view.depth_m[car].any() and not view.semantic[car].any()
    assert not view.instance[car].any()
    assert view.surface is None or view.surface.own_car is not None


def test_the_border_shows_the_car_once_however_many_effects_there_are(scene):
    view_camera = scene.frames[0].cameras["ahead"]
    recipe = recipe_of(WEATHERS["blizzard"])
    view = render_view(scene, view_camera, recipe)
    covered = render_view(dataclasses.replace(scene, ego_masks={}), view_camera, recipe)
    photo = cv2.imread(scene.frames[0].image_paths["ahead"], cv2.IMREAD_COLOR_RGB)
    own_car = own_car_in_view(scene, view_camera)
    assert own_car is not None
    weights = own_car.weights[..., None]
    assert ((weights > 0) & (weights < 1)).sum() > 100
    rows = own_car.rows
    blended = (1 - weights) * covered.rgb[rows] + weights * photo[rows]
    assert np.abs(view.rgb[rows] - blended).max() < 1.6  # steps of 8 bits


def test_a_style_colours_the_car_and_drops_lie_before_it(scene):
    view_camera = scene.frames[0].cameras["ahead"]
    car = scene.ego_masks["ahead"]
    for applied_to in ("scene", "picture"):
        style = Style(preset="dusk", applied_to=applied_to)
        clear = render_view(scene, view_camera, recipe_of(Weather(), style=style))
        snowy = render_view(scene, view_camera, recipe_of(Weather(snow=SNOW), style=style))
        np.testing.assert_array_equal(snowy.rgb[car], clear.rgb[car])
        photo = cv2.imread(scene.frames[0].image_paths["ahead"], cv2.IMREAD_COLOR_RGB)
        assert (clear.rgb[car] != photo[car]).mean() > 0.5
    drops = Sensor(lens_drops=LensDrops(count=400, radius_mm=3.0))
    wet = render_view(scene, view_camera, recipe_of(Weather(snow=SNOW), camera=drops))
    dry = render_view(scene, view_camera, recipe_of(Weather(snow=SNOW)))
    before_car = (wet.masks["lens_drops"] > 0) & car
    assert before_car.sum() > 50
    assert (wet.rgb[before_car] != dry.rgb[before_car]).any(-1).mean() > 0.9


def test_pictures_without_a_car_keep_their_bits(scene):
    """An empty mask is no mask, and splats are drawn as they were."""
    view_camera = scene.frames[0].cameras["ahead"]
    none = dataclasses.replace(scene, ego_masks={})
    empty = dataclasses.replace(scene, ego_masks={"ahead": np.zeros((90, 160), bool)})
    assert own_car_in_view(none, view_camera) is None
    assert own_car_in_view(empty, view_camera) is None
    recipe = recipe_of(WEATHERS["blizzard"])
    np.testing.assert_array_equal(
        render_view(none, view_camera, recipe).rgb, render_view(empty, view_camera, recipe).rgb
    )
    splats = recipe.model_copy(update={"render": Render()})
    np.testing.assert_array_equal(
        render_view(none, view_camera, splats).rgb, render_view(scene, view_camera, splats).rgb
    )


@pytest.mark.parametrize("scale", [0.5, 0.3])
def test_the_mask_fits_pictures_of_any_size(scene, scale):
    recipe = recipe_of(Weather(snow=SNOW)).model_copy(
        update={"render": Render(base="recorded", scale=scale)}
    )
    view_camera = scene.frames[0].cameras["ahead"]
    small = render_view(scene, view_camera, recipe)
    clear = render_view(scene, view_camera, recipe.model_copy(update={"weather": Weather()}))
    height, width = small.rgb.shape[:2]
    rows = np.arange(height)[:, None] / height * 90
    columns = np.arange(width) / width * 160
    car = rows >= 67 + 1 / scale + ((columns - 80) / 40) ** 2
    np.testing.assert_array_equal(small.rgb[car], clear.rgb[car])


def test_snow_lies_on_the_car_where_a_recipe_asks_for_it(scene):
    view_camera = scene.frames[0].cameras["ahead"]
    car = scene.ego_masks["ahead"]

    def picture(weather: Weather, own_car: str, frame: int = 0) -> np.ndarray:
        render = Render(base="recorded", own_car=own_car)
        recipe = Recipe(weather=weather, render=render)
        return render_view(scene, scene.frames[frame].cameras["ahead"], recipe).rgb

    dry = picture(Weather(snow=SNOW), "dry")
    snowy = picture(Weather(snow=SNOW), "snowy")
    inner = cv2.erode(car.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert dry[inner].std() > 60 and snowy[inner].std() < 12  # noise, and snow of one colour
    ground = render_view(scene, view_camera, recipe_of(Weather(snow=SNOW))).masks["snow"] > 0
    ground[:50] = False
    assert abs(float(np.median(snowy[inner])) - float(np.median(dry[ground]))) < 12
    np.testing.assert_array_equal(snowy, picture(Weather(snow=SNOW), "snowy"))
    np.testing.assert_array_equal(
        picture(Weather(flood=FLOOD), "snowy"), picture(Weather(flood=FLOOD), "dry")
    )
