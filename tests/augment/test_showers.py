"""Showers in space: what lies on a ray, in pictures, labels and sweeps, and drops that last."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment import effects
from augment.effects.effect import EffectPlan, LabelInputs
from augment.effects.falling.air import Precipitation, cell_walk, draw_falling, find_drops, glow_of
from augment.effects.falling.drops import sizes_of
from augment.effects.falling.effect import wind_velocity_mps
from augment.effects.falling.lidar import precipitation_echoes, scatterers_of
from augment.effects.falling.shower import (
    LIGHT_UNDER_CLOUD,
    Shower,
    extinctions_of,
    reference_place,
    shower_about,
)
from augment.effects.falling.shutter import STANDING
from augment.effects.lidar.beam import DEFAULT_MODEL, Echoes
from augment.render.buffers import REFERENCE
from augment.render.threads import limit_threads
from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import Boxes
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan, plan_at
from augment.view.render_view import render_view
from recipes.load import parse_recipe
from recipes.rain import Rain
from recipes.schema import Recipe, Weather
from recipes.shower import RateAtPlace
from recipes.snowfall import Snowfall
from tests.lidar_sweeps import WORLD_ORIGIN_M, sweep_of
from tests.scenes import camera_ahead, random_gaussians

# A shower that comes from -x, 1.5 km away.
COMING = Shower(
    ((-4000.0, 0.0), (-3500.0, 20.0), (-1800.0, 20.0), (-1500.0, 0.0)), (1.0, 0.0), (0.0, 0.0)
)
EYE_M = np.array([3.0, -2.0, 1.5])


def view(*, width: int = 160, yaw: float = 0.0, **others) -> Camera:
    return camera_ahead(width, width * 3 // 4, width * 0.5, yaw=yaw, **others)


def scene_of(camera: Camera) -> Scene:
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"front": camera})
    sky = ConstantSky(torch.tensor([0.7, 0.75, 0.8]))
    return Scene("drive", "test", random_gaussians(200), (), sky, (frame,))


def raining(places: Shower | None, *, kind: str = "rain", camera: Camera) -> Precipitation:
    falling = Precipitation(kind, 5.0, (2.0, 0.0), 0.0, 7, 0.005, 0.25, shower=places)  # type: ignore[arg-type]
    return falling.at(camera)


# ---- Along a ray ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["rain", "snow"])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (-0.6, 0.8)])
def test_the_optical_depth_of_a_ray_is_the_sum_over_its_places(kind, direction):
    """Within 1 % of 10,000 points."""
    scale = {"rain": 1.0, "snow": 0.2}[kind]
    places = tuple((distance, scale * rate) for distance, rate in COMING.places)
    shower = Shower(places, direction, (40.0, 7.0))
    table = shower_about(shower, kind, EYE_M)
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(400, 3)) * (1, 1, 0.2)
    rays *= (10 ** rng.uniform(1, 4, 400) / np.linalg.norm(rays, axis=1))[:, None]
    shares = (np.arange(10_000) + 0.5)[:, None] / 10_000
    lengths = np.linalg.norm(rays, axis=1)
    means = [
        extinctions_of(kind, shower.rates(shower.distance_m(EYE_M + shares * ray))).mean()
        for ray in rays
    ]
    expected = lengths * means
    actual = table.optical_depth(rays)
    assert (expected > 0.01).sum() > 30
    # A part in 2000 of the light is below a level of 8 bits.
    np.testing.assert_allclose(actual, expected, rtol=0.01, atol=5e-4)


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_the_extinction_of_a_rate_is_that_of_its_drops(kind):
    rates = np.array([0.0, 1e-5, 1e-3, 0.02, 0.7, 13.0, 280.0])
    expected = [sizes_of(kind, rate).extinction_per_m for rate in rates[1:]]
    np.testing.assert_allclose(extinctions_of(kind, rates)[1:], expected, rtol=1e-3)
    assert extinctions_of(kind, rates)[0] == 0


def test_a_step_has_the_rate_of_the_side_that_it_comes_from():
    step = Shower(((0.0, 8.0), (0.0, 1.0), (50.0, 1.0)), (1.0, 0.0), (0.0, 0.0))
    assert step.rates(np.array([-1.0, 0.0, 1e-9, 50.0, 60.0])).tolist() == [8, 8, 1, 1, 1]


# ---- In pictures ---------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [np.pi, 0.3, np.pi / 2])
@pytest.mark.parametrize("offset_m", [0.0, -1700.0, 2000.0])
def test_the_kernel_equals_its_definition(yaw, offset_m):
    """Before, within and behind a shower, along the wind and across it, with and without edges.

    The kernel has straight lines over eight pixels in the sky, which the definition has not.
    """
    camera = view(yaw=yaw, width=1280, position=(offset_m, 0, 1.5)).cropped(1, 300, 349, 240)
    rng = np.random.default_rng(1)
    shape = (240, 349)
    alpha, depth = (torch.from_numpy(rng.random(shape, np.float32)) for _ in range(2))
    rgb = torch.from_numpy(rng.random((*shape, 3), np.float32))
    depth = torch.where(depth > 0.2, 600 * depth**4, 0.0)
    alpha[100:120] = 1
    rest = alpha, depth, camera, raining(COMING, camera=camera)
    for splats in (0.5 * rgb, None):
        fast, mask = draw_falling(rgb.clone(), *rest, scene=scene_of(camera), splats=splats)
        slow, slow_mask = draw_falling(
            rgb.clone(), *rest, scene=scene_of(camera), splats=splats, backend=REFERENCE
        )
        np.testing.assert_allclose(fast, slow, atol=0.02)
        assert (fast - slow).abs().mean() < 3e-4
        assert (mask == slow_mask).all()
        assert torch.isfinite(fast).all()


def test_a_curtain_stands_where_the_shower_is_and_not_elsewhere():
    """Dry here: the sky on the shower's side turns grey, the other side and what is near stay."""
    for yaw, is_towards in ((np.pi, True), (0.0, False)):
        camera = view(yaw=yaw, position=(0, 0, 1.5))
        sky = torch.full((120, 160, 3), 0.7)
        alpha = torch.zeros(120, 160)
        alpha[80:] = 1
        depth = torch.where(alpha > 0, 20.0, 0.0)
        falling = raining(COMING, camera=camera)
        assert falling.rate_mm_h == 0
        out, mask = draw_falling(sky.clone(), alpha, depth, camera, falling, scene=scene_of(camera))
        assert not mask.any()
        np.testing.assert_allclose(out[80:], 0.7, atol=1e-4)
        if is_towards:
            assert (out[30:60] < 0.66).all()
        else:
            np.testing.assert_allclose(out[:80], 0.7, atol=1e-4)


def test_a_view_of_a_surface_takes_the_shower_up_to_it():
    """One black surface 1 km away: its veil is that of the optical depth between."""
    camera = view(yaw=np.pi, position=(-1000.0, 0, 1.5))
    falling = raining(COMING, camera=camera)
    table = falling.shower_about(camera.centre.numpy())
    assert table is not None
    z = 1000.0
    ones = torch.ones(120, 160)
    scene = scene_of(camera)
    out, _ = draw_falling(torch.zeros(120, 160, 3), ones, z * ones, camera, falling, scene=scene)
    depth = table.optical_depth(np.array([[-z, 0.0, 0.0]]))[0]
    assert 0.2 < depth < 2
    extinction, lit_extinction, _ = table.integrals(np.array([-z]))[0]
    light = lit_extinction / extinction
    assert LIGHT_UNDER_CLOUD <= light < 0.95  # darker than the sky around the camera
    # The middle pixels look along -x, half a pixel beside it.
    expected = glow_of(scene).airlight * light * (1 - np.exp(-depth))
    np.testing.assert_allclose(out[60, 80] ** 2, expected, rtol=0.01)


def recipe_of(**fields) -> Recipe:
    return Recipe(weather=Weather(rain=Rain(wetness=0.0, **fields)))


def test_a_uniform_rate_has_the_bits_of_rain_that_is_the_same_everywhere():
    camera = view(position=(0, 0, 1.5))
    scene = scene_of(camera)
    plain = render_view(scene, camera, recipe_of(rate_mm_h=9.0))
    places = (RateAtPlace(distance_m=-50, rate_mm_h=9), RateAtPlace(distance_m=90, rate_mm_h=9))
    uniform = render_view(scene, camera, recipe_of(rate_mm_h=9.0, along=places, front_mps=7.0))
    np.testing.assert_array_equal(plain.rgb, uniform.rgb)


def test_the_same_bytes_from_any_number_of_threads():
    camera = view(position=(0, 0, 1.5), yaw=np.pi)
    scene = scene_of(camera)
    places = (RateAtPlace(distance_m=-900, rate_mm_h=30), RateAtPlace(distance_m=300, rate_mm_h=1))
    recipe = recipe_of(rate_mm_h=7.0, along=places, front_mps=7.0)
    images = []
    for threads in (1, 2):
        limit_threads(threads)
        images.append(render_view(scene, camera, recipe).rgb)
    np.testing.assert_array_equal(images[0], images[1])


SHOWER = """
weather:
  rain:
    rate_mm_h: {timeline: [[0, 0], [20, 30], [40, 4]], shape: smooth}
    front_mps: 12
    wind_from_deg: 180
  clock: {speed: 100, start_s: 3}
"""


def driving_away() -> Scene:
    """Four frames, a tenth of a second and 120 m of a shower apart, beside each other."""
    frames = []
    for index in range(4):
        camera = view(position=(120.0 * index, 0, 1.5), timestamp_ns=10**8 * index, yaw=np.pi)
        camera = dataclasses.replace(camera, name="front")
        pose = torch.eye(4, dtype=torch.float64)
        frames.append(Frame(index, camera.timestamp_ns, pose, {"front": camera}))
    return dataclasses.replace(scene_of(frames[0].cameras["front"]), frames=tuple(frames))


def test_an_image_alone_has_the_bits_of_the_image_in_sequence():
    recipe = parse_recipe(SHOWER, source="shower").resolve(0)
    scene = driving_away()
    images = [render_view(scene, frame.cameras["front"], recipe).rgb for frame in scene.frames]
    alone = driving_away()
    last = render_view(alone, alone.frames[-1].cameras["front"], recipe)
    np.testing.assert_array_equal(images[-1], last.rgb)
    assert (images[0] != images[2]).any()


def test_who_drives_with_the_shower_stays_in_its_rate():
    recipe = parse_recipe(SHOWER, source="shower").resolve(0)
    scene = driving_away()
    rates = []
    for frame in scene.frames:
        camera = frame.cameras["front"]
        _, plan = plan_at(recipe, scene, camera.timestamp_ns)
        rates.append(plan.effect_plans["rain"].data.at(camera).rate_mm_h)
    assert rates[0] > 0
    np.testing.assert_allclose(rates, rates[0], rtol=0.02)


# ---- Drops ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_drops_last_while_the_rate_changes(kind):
    """At a lower rate fall some of the drops of a higher one, at the same places."""
    camera = view(width=640, position=(0, 0, 1.5), timestamp_ns=3 * 10**9)
    peak = {"rain": 20.0, "snow": 4.0}[kind]
    falling = Precipitation(kind, peak, (0.0, 0.0), 0.3, 7, 0.001, 0.25, peak_mm_h=peak)  # type: ignore[arg-type]
    numbers = []
    for share in (1.0, 0.9):
        now = dataclasses.replace(falling, rate_mm_h=share * peak)
        numbers.append(find_drops(cell_walk(now, camera, STANDING, "x")))
    # A drop's size changes a little with the rate, so compare places.
    places = [{tuple(np.round(drop[[0, 1, 4]], 2)) for drop in drops} for drops in numbers]
    assert len(places[1] & places[0]) > 0.9 * min(map(len, places)) > 50
    other = dataclasses.replace(falling, rate_mm_h=0.9 * peak, peak_mm_h=None)
    moved = find_drops(cell_walk(other, camera, STANDING, "x"))
    assert len({tuple(np.round(drop[[0, 1, 4]], 2)) for drop in moved} & places[0]) < 10


def test_a_lattice_with_a_peak_has_as_many_drops_as_one_of_its_rate():
    camera = view(width=640, position=(0, 0, 1.5))
    counts = []
    for peak in (None, 40.0):
        falling = Precipitation("rain", 8.0, (0.0, 0.0), 0.0, 7, 0.001, 0.25, peak_mm_h=peak)
        counts.append(len(find_drops(cell_walk(falling, camera, STANDING, "x"))))
    assert counts[1] == pytest.approx(counts[0], abs=5 * counts[0] ** 0.5)


# ---- Labels, sweeps, plans -----------------------------------------------------------------------


def test_beams_and_boxes_lose_what_the_pictures_rays_lose():
    camera = view(yaw=np.pi, position=(-1450.0, 0, 1.5))
    falling = raining(COMING, camera=camera)
    table = falling.shower_about(camera.centre.numpy())
    assert table is not None
    end_m = np.array([-1610.0, 0.0, 1.5])
    expected = np.exp(-table.optical_depth(end_m[None] - camera.centre.numpy()))[0]
    assert 0.8 < expected < 0.99
    count = 3
    sweep = sweep_of(np.tile(end_m, (count, 1)), 0.9)
    origins = np.tile(camera.centre.numpy() + WORLD_ORIGIN_M, (count, 1))
    echoes = Echoes.from_sweep(sweep, origins, WORLD_ORIGIN_M, DEFAULT_MODEL)
    scatterers = scatterers_of("rain", falling.rate_mm_h)
    precipitation_echoes(echoes, scatterers, np.random.default_rng(0), table)
    np.testing.assert_allclose(echoes.gain, expected**2, rtol=1e-9)

    effect = next(effect for effect in effects.EFFECTS if effect.name == "rain")
    boxes = WorldBoxes.from_labels(
        Boxes(("car",), ("a",), end_m[None], np.full((1, 3), 0.02), np.array([[1.0, 0, 0, 0]])),
        np.zeros(3),
    )
    inputs = LabelInputs(EffectPlan(falling, ()), None, None, None)
    columns = effect.measure_boxes(boxes, camera, inputs)
    np.testing.assert_allclose(columns["rain_transmittance"], expected, rtol=1e-3)
    # From under water, no rain lies before what is under water.
    flooded = dataclasses.replace(inputs, water_level_z_m=2.0)
    assert effect.measure_boxes(boxes, camera, flooded)["rain_transmittance"] == 1


def test_the_plan_tells_the_shower_and_a_dry_place_has_its_curtain():
    camera = view(position=(4.0, 5.0, 1.5))
    scene = scene_of(camera)
    assert reference_place(scene) == (4.0, 5.0)
    assert wind_velocity_mps(1.0, 0.0) == pytest.approx((-1.0, 0.0))
    assert wind_velocity_mps(1.0, 90.0) == pytest.approx((0.0, -1.0))
    places = (RateAtPlace(distance_m=-900, rate_mm_h=30), RateAtPlace(distance_m=-300, rate_mm_h=0))
    for weather in (
        Weather(rain=Rain(rate_mm_h=0.0, along=places)),
        Weather(snowfall=Snowfall(rate_mm_h=0.0, along=places)),
    ):
        plan = make_plan(Recipe(weather=weather), scene)
        steps = [step for step in plan.steps if step.runs and "veil" in step.name]
        assert len(steps) == 1
        assert "a shower of 0 to 30 mm/h along the wind" in steps[0].why
