import math
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from augment.dataset.weather_env import EnvWeather, read_cameras, weather_env
from augment.errors import ClimateGSError
from recipes.load import parse_recipe
from recipes.schema import Recipe

WIDTH = 256
HEIGHT = 144
FOG = "version: 1\nname: f\nweather: {smog: {visibility_m: 50, color: [0.7, 0.75, 0.8]}}\n"
RAIN = "version: 1\nname: r\nweather: {rain: {rate_mm_h: 150, wetness: 0}}\n"
V2C = [[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1.0]]
INTRINSIC = {"W": WIDTH, "H": HEIGHT, "fovx": 1.2, "fovy": 0.8, "cx": WIDTH / 2, "cy": HEIGHT / 2}


class DepthEnv(gymnasium.Env):
    """Drives ahead towards a wall; the upper half of its picture is sky."""

    observation_space = gymnasium.spaces.Dict({})
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self) -> None:
        self.step_number = 0

    def observe(self) -> tuple[dict[str, Any], dict[str, Any]]:
        rgb = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        rgb[: HEIGHT // 2] = 200
        depth = np.full((HEIGHT, WIDTH), 25.0 - 0.5 * self.step_number, np.float32)
        semantic = np.zeros((HEIGHT, WIDTH), np.uint8)
        semantic[: HEIGHT // 2] = 10
        images = {"rgb": rgb, "depth": depth, "semantic": semantic}
        info = {
            "ego_pos": [0.5 * self.step_number, 0.0, 0.0],
            "ego_rot": [0.0, 0.0, 0.0],
            "timestamp": 0.1 * self.step_number,
            "cam_params": {"front": {"intrinsic": INTRINSIC, "v2c": V2C}},
        }
        return {name: {"front": image} for name, image in images.items()}, info

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.step_number = 0
        return self.observe()

    def step(self, action: Any) -> Any:
        self.step_number += 1
        return *self.observe()[:1], 1.0, False, False, self.observe()[1]


def recipe_of(text: str) -> Recipe:
    return parse_recipe(text, source="test").resolve(0)


def pictures(env: gymnasium.Env, seed: int, num_steps: int = 3) -> list[np.ndarray]:
    observation, _ = env.reset(seed=seed)
    images = [observation["rgb"]["front"]]
    for _ in range(num_steps):
        images.append(env.step(np.zeros(1))[0]["rgb"]["front"])
    return images


def test_fog_is_koschmieders_law_by_ray_distance_and_hides_the_sky() -> None:
    env = weather_env(DepthEnv(), recipe_of(FOG), sky_classes=(10,))
    observation, info = env.reset(seed=0)
    camera = read_cameras(info, "z-up")["front"]
    distance_m = 25.0 * camera.ray_lengths().numpy()
    extinction_per_m = 3.912 / 50
    transmittance = np.exp(-extinction_per_m * distance_m)[..., None]
    airlight = np.array([0.7, 0.75, 0.8])
    expected = transmittance * (90 / 255) + (1 - transmittance) * airlight
    expected[: HEIGHT // 2] = airlight
    rgb = observation["rgb"]["front"].astype(np.float64) / 255
    assert rgb.shape == expected.shape
    # Half a level of rounding; visibility is of 5 % contrast or of 3.912, to the fourth digit.
    assert np.abs(rgb - expected).max() < 0.6 / 255
    assert np.array_equal(observation["depth"]["front"], DepthEnv().observe()[0]["depth"]["front"])


@pytest.mark.parametrize("text", (FOG, RAIN))
def test_equal_seeds_and_steps_give_equal_bits(text: str) -> None:
    options = {"sky_classes": (10,)}
    first = pictures(weather_env(DepthEnv(), recipe_of(text), **options), 5)
    env = weather_env(DepthEnv(), recipe_of(text), **options)
    pictures(env, 6)
    again = pictures(env, 5)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))


def test_streaks_differ_by_seed_and_are_marked_by_a_mask() -> None:
    env = weather_env(DepthEnv(), recipe_of(RAIN), sky_classes=(10,))
    _, info = env.reset(seed=1)
    mask = info["weather_masks"]["front"]["rain"]
    assert mask.dtype == bool and mask.any() and not mask.all()
    assert (pictures(env, 1)[-1] != pictures(env, 2)[-1]).any()


def test_effects_that_need_a_scene_are_refused_or_left_out_on_demand() -> None:
    snow = recipe_of(
        "version: 1\nname: s\nweather: {snow: {depth_m: 0.1}, smog: {visibility_m: 90}}\n"
    )
    with pytest.raises(ClimateGSError, match=r"snow \(weather.snow\).*omits_scene_effects"):
        EnvWeather(snow)
    weather = EnvWeather(snow, omits_scene_effects=True)
    assert weather.omitted == ("snow",)
    for text, name in (
        ("weather: {flood: {level_m: 0.2}}", "flood"),
        ("weather: {rain: {rate_mm_h: 5}}", "wet"),
        ("light: {time: night}", "lamps"),
    ):
        with pytest.raises(ClimateGSError, match=name):
            EnvWeather(recipe_of(f"version: 1\nname: x\n{text}\n"))
    later = "{timeline: [[0, 0], [3, 0], [4, 0.1], [5, 0]]}"  # not at start, middle or end
    text = f"version: 1\nname: x\nweather: {{snow: {{depth_m: {later}}}}}\n"
    with pytest.raises(ClimateGSError, match="snow"):
        EnvWeather(recipe_of(text), duration_s=6.0)
    assert "snow" in EnvWeather(recipe_of(text), duration_s=6.0, omits_scene_effects=True).omitted


def test_observations_that_do_not_fit_are_refused_in_words() -> None:
    observation, info = DepthEnv().observe()
    short = {**observation, "rgb": {"front": observation["rgb"]["front"][:-1]}}
    shallow = {**observation, "depth": {"front": observation["depth"]["front"][:, :-1]}}
    coarse = {**observation, "semantic": {"front": observation["semantic"]["front"][::2]}}
    other = {**observation, "rgb": {"left": observation["rgb"]["front"]}}
    floats = {**observation, "rgb": {"front": observation["rgb"]["front"] / 255}}
    skewed = {"front": {"intrinsic": INTRINSIC, "v2c": np.eye(4) * 2}}
    wide = {"front": {"intrinsic": {**INTRINSIC, "fovx": 4.0}, "v2c": V2C}}
    cases: list[tuple[Any, Any, str]] = [
        (short, info, "rgb must be uint8"),
        (floats, info, "rgb must be uint8"),
        (shallow, info, "depth must be"),
        (other, info, "no 'front'; it has left"),
        (coarse, info, "semantic must be"),
        (observation, {}, "no 'ego_pos'"),
        (observation, {**info, "timestamp": math.nan}, "timestamp must be finite"),
        (observation, {**info, "ego_pos": [0, math.inf, 0]}, "finite numbers"),
        (observation, {**info, "cam_params": skewed}, "v2c must be"),
        (observation, {**info, "cam_params": wide}, "fovx must be"),
        (observation, {**info, "cam_params": {}}, "no camera"),
    ]
    for bad_observation, bad_info, words in cases:
        with pytest.raises(ClimateGSError, match=words):
            EnvWeather(recipe_of(FOG), sky_classes=(10,)).apply(bad_observation, bad_info)
    weather = EnvWeather(recipe_of(FOG))
    weather.apply(observation, {**info, "timestamp": 5.0})
    with pytest.raises(ClimateGSError, match="time went back"):
        weather.apply(observation, {**info, "timestamp": 4.0})
    changing = (
        "version: 1\nname: c\nweather: {smog: {visibility_m: {timeline: [[0, 50], [1, 100]]}}}\n"
    )
    with pytest.raises(ClimateGSError, match="duration_s"):
        EnvWeather(recipe_of(changing))


def test_cameras_of_a_world_whose_y_points_down_look_level() -> None:
    _, info = DepthEnv().observe()
    info = {**info, "ego_pos": [2.0, -1.0, 7.0]}
    info["cam_params"] = {"front": {"intrinsic": INTRINSIC, "v2c": np.eye(4)}}
    camera = read_cameras(info, "y-down")["front"]
    rotation = camera.world_from_camera[:3, :3]
    assert torch.allclose(rotation[:, 2], torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert torch.allclose(rotation[:, 1], torch.tensor([0, 0, -1.0], dtype=torch.float64))
    assert torch.allclose(camera.centre, torch.tensor([7.0, -2.0, 1.0], dtype=torch.float64))
