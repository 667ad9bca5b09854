"""Spray behind vehicles: how much there is, where, in pictures and along a LiDAR's beams."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from augment.effects.lidar.beam import DEFAULT_MODEL, Echoes
from augment.effects.lidar.codes import SCATTERED, UNCHANGED
from augment.effects.spray.lidar import extinction_at, look_through, spray_echoes
from augment.effects.spray.picture import blend_puffs, windows_of
from augment.effects.spray.puffs import (
    INTERVAL_S,
    MIN_SPEED_MPS,
    Puffs,
    film_depth_m,
    spray_puffs,
    spraying_actors,
)
from augment.render.buffers import CPU, REFERENCE
from augment.render.fog import Fog
from augment.scene.scene import Actor, Gaussians, Scene, Track
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from recipes.schema import Rain, Recipe, Render, Weather
from tests.lidar_sweeps import sweep_of
from tests.scenes import camera_ahead, one_gaussian
from tests.streets import LABELLED_STREET, open_fast_street, open_street

CAMERA = camera_ahead(96, 64, 80.0, position=(0, 0, 1.5))
LIGHT = np.array([0.4, 0.5, 0.6])


def vehicle(speed_mps: float, *, x_m: float = 0.0, begins_s: float = 0.0) -> Actor:
    """A car that drives along +x, at x_m when 10 s have passed; its track is 10 s long."""
    times = torch.arange(21) * 500_000_000 + round(1e9 * begins_s)
    poses = torch.eye(4, dtype=torch.float64).repeat(21, 1, 1)
    poses[:, 0, 3] = x_m + speed_mps * (times.double() / 1e9 - 10)
    poses[:, 2, 3] = 0.75
    return Actor(f"car {speed_mps}", "car", Gaussians.empty(), Track(times, poses), (4.5, 1.8, 1.5))


def traffic(*actors: Actor) -> Scene:
    ground = one_gaussian((30, 0, -5), 1.0, 0.9)
    return Scene("traffic", "test", ground, actors, ConstantSky(torch.tensor([0.6, 0.6, 0.6])), ())


def puffs_at(
    scene: Scene, seconds: float, water_m: float = 1e-3, *, seed: int = 3, wind=(0.0, 0.0)
) -> Puffs:
    return spray_puffs(scene, round(1e9 * seconds), water_m, seed=seed, wind_mps=wind)


def one_puff(x_m: float, extinction: float = 0.3, scale_m: float = 1.0) -> Puffs:
    centre = np.array([[x_m, 0.0, 1.5]])
    return Puffs(centre, np.eye(3)[None] / scale_m, np.array([extinction]))


# ---- How much, and where -------------------------------------------------------------------------


def test_water_on_the_road_is_that_of_the_law_of_drainage():
    assert film_depth_m(10.0) == pytest.approx(0.7e-3, rel=0.02) and film_depth_m(0.0) == 0


def test_a_car_at_90_km_h_on_a_millimetre_lifts_the_extinction_of_the_law():
    scene = traffic(vehicle(25.0))
    area = []  # per metre driven, of what has just come up
    for seconds in 7 + 0.4 * np.arange(40) / 10:
        puffs = puffs_at(scene, seconds)
        whole = puffs.extinction_per_m * (2 * math.pi) ** 1.5 / np.linalg.det(puffs.whitenings)
        area.append(whole.max() / (25 * INTERVAL_S))
    assert np.median(area) == pytest.approx(0.067 * 3 * 1.2, rel=0.35)  # the thickest of a few
    # When the car's middle is 7.5 m on.
    points = np.stack([np.full(50, -4.0), np.linspace(-4, 4, 50), np.full(50, 0.7)], 1)
    behind = extinction_at(puffs_at(scene, 10.3), points)
    assert 0.02 < behind.max() < 0.3 and behind[0] < 0.01


def test_slow_vehicles_lift_nothing_and_fast_ones_more_than_less_fast_ones():
    scene = traffic(vehicle(11.0), vehicle(14.0), vehicle(25.0), vehicle(33.0))
    assert spraying_actors(scene) == (1, 2, 3)
    strengths = [
        puffs_at(traffic(vehicle(speed)), 9.0).extinction_per_m.max()
        for speed in (14.0, 25.0, 33.0)
    ]
    assert 3 * strengths[0] < strengths[1] < strengths[2]
    assert pytest.approx(11.11, abs=0.01) == MIN_SPEED_MPS
    assert len(puffs_at(scene, 9.0, 0.0).extinction_per_m) == 0


def test_puffs_are_a_function_of_time_stay_behind_and_thin_out():
    scene = traffic(vehicle(20.0))
    first = puffs_at(scene, 9.0)
    puffs_at(scene, 9.7)
    again = puffs_at(dataclasses.replace(scene), 9.0)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    later = puffs_at(scene, 9.0 + INTERVAL_S)
    ends = [puffs.centres_m[:, 0].max() for puffs in (first, later)]
    assert ends[0] < -20 - 2.25 and ends[1] - ends[0] == pytest.approx(2.0, abs=0.5)
    # Each is the next one's elder brother: where it was born it stays but for wake and eddies.
    moved = later.centres_m[-21:-1] - first.centres_m[-20:]
    assert np.abs(moved[:, 0]).max() < 1.0 and moved[:, 0].min() > -0.2
    assert (later.extinction_per_m[-21:-4] < first.extinction_per_m[-20:-3]).all()
    blown = puffs_at(scene, 9.0, wind=(0.0, 5.0))
    assert blown.centres_m[0, 1] > first.centres_m[0, 1] + 3
    assert not np.array_equal(puffs_at(scene, 9.0, seed=4).centres_m, first.centres_m)


def test_spray_is_there_when_a_track_begins_and_gone_some_time_after_its_end():
    scene = traffic(vehicle(25.0))
    assert len(puffs_at(scene, 0.0).extinction_per_m) > 20
    assert len(puffs_at(scene, 11.0).extinction_per_m) > 10
    assert len(puffs_at(scene, 14.0).extinction_per_m) == 0
    standing = dataclasses.replace(vehicle(25.0), track=Track(
        torch.zeros(1, dtype=torch.int64), torch.eye(4, dtype=torch.float64)[None]))  # fmt: skip
    assert spraying_actors(traffic(standing)) == ()


# ---- In pictures ---------------------------------------------------------------------------------


def seen(puffs: Puffs, depth_m: float, *, backend: str = CPU, fog: Fog | None = None):
    rgb = torch.full((64, 96, 3), 0.2)
    depth = torch.full((64, 96), depth_m)
    alpha = torch.ones_like(depth)
    return blend_puffs(rgb, alpha, depth, CAMERA, puffs, LIGHT, fog=fog, backend=backend)


@pytest.mark.parametrize("depth_m", [50.0, 10.0, 9.0, 4.0])
def test_a_puff_takes_what_its_extinction_integrates_to_up_to_the_surface(depth_m):
    found = seen(one_puff(10.0), depth_m)[32, 48].double().numpy() ** 2
    ray = CAMERA.ray_directions(torch.float64)[32, 48].numpy()
    z = np.linspace(0, depth_m, 20001)
    points = z[:, None] * ray + (0, 0, 1.5)
    tau = np.trapezoid(extinction_at(one_puff(10.0), points), z) * np.linalg.norm(ray)
    expected = np.exp(-tau) * 0.04 + (1 - np.exp(-tau)) * LIGHT
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_a_puff_around_the_camera_counts_from_the_eye_on_and_one_behind_it_not_at_all():
    found = seen(one_puff(0.0), 50.0)[32, 48].double().numpy() ** 2
    tau = 0.3 * math.sqrt(math.pi / 2)
    np.testing.assert_allclose(found, np.exp(-tau) * 0.04 + (1 - np.exp(-tau)) * LIGHT, atol=2e-3)
    bare = torch.full((64, 96, 3), 0.2)
    for hidden in (one_puff(-4.0), one_puff(60.0)):
        assert torch.equal(seen(hidden, 50.0), bare)


def test_fog_stands_before_spray():
    fog = Fog(0.2, (0.9, 0.9, 0.9))
    clear, foggy = (seen(one_puff(20.0, 3.0), 50.0, fog=f)[32, 48] for f in (None, fog))
    share = math.exp(-0.2 * 20)
    expected = share * LIGHT + (1 - share) * 0.81
    np.testing.assert_allclose(foggy.double().numpy() ** 2, expected, atol=5e-3)
    np.testing.assert_allclose(clear.double().numpy() ** 2, LIGHT, atol=5e-3)


def test_kernel_and_torch_blend_alike():
    scene = traffic(vehicle(25.0, x_m=15.0), vehicle(30.0, x_m=2.0))
    puffs = puffs_at(scene, 10.0)
    for depth_m in (8.0, 60.0):
        fog = Fog(0.02, (0.8, 0.8, 0.8), 5.0)
        own, other = (seen(puffs, depth_m, backend=b, fog=fog) for b in (CPU, REFERENCE))
        torch.testing.assert_close(own, other, rtol=0, atol=1e-6)
        assert own.isfinite().all() and (own > 0.2).float().mean() > 0.2


def test_no_pixel_outside_of_a_puffs_window_sees_it():
    camera = CAMERA
    puffs = puffs_at(traffic(vehicle(25.0, x_m=15.0)), 10.0)
    rays = camera.ray_directions(torch.float64).reshape(-1, 3).numpy()
    lengths = np.linalg.norm(rays, axis=1)
    eyes = np.tile(camera.centre.numpy(), (len(rays), 1))
    for number, (top, bottom, left, right, run) in enumerate(windows_of(puffs, camera).tolist()):
        one = Puffs(*(array[number : number + 1] for array in puffs))
        tau, _ = look_through(one, eyes, rays / lengths[:, None], np.full(len(rays), 1e3))
        peak = math.sqrt(2 * math.pi) * one.extinction_per_m[0] * one.scales_m.max()
        shown = tau.reshape(64, 96) > 0.02 * peak  # a puff ends at three standard deviations
        shown[top:bottom, left:right] = False
        assert not shown.any() and 1 <= run <= 8


# ---- Along beams ---------------------------------------------------------------------------------


BRIGHTNESS: Any = np.array([0.05, 0.9, 0.3, 0.3])


def test_dense_spray_gives_echoes_of_its_own_and_dims_what_stands_behind():
    points = np.array([[40.0, 0, 1.5], [40.0, 0, 1.5], [40.0, 15, 1.5], [6.0, 0, 1.5]])
    sweep = sweep_of(points, intensity=BRIGHTNESS)
    origins = np.tile(np.array([0.0, 0, 1.5]), (4, 1))
    world = sweep.points_m[0] - points[0]
    for extinction, scattered in ((0.6, True), (0.02, False)):
        echoes = Echoes.from_sweep(sweep, origins + world, world, DEFAULT_MODEL)
        spray_echoes(echoes, one_puff(12.0, extinction), np.random.default_rng(0))
        assert (echoes.codes[0] == SCATTERED) == scattered
        tau = extinction * math.sqrt(2 * math.pi)
        assert scattered or echoes.gain[1] == pytest.approx(math.exp(-2 * tau), rel=1e-3)
        assert echoes.codes[2:].tolist() == [UNCHANGED] * 2 and echoes.gain[2:].tolist() == [1, 1]
        assert not scattered or 10 < echoes.ranges_m[0] < 14


# ---- In a recipe ---------------------------------------------------------------------------------


def rainy(**rain) -> Recipe:
    return Recipe(weather=Weather(rain=Rain(rate_mm_h=50.0, **rain)), render=Render(scale=0.5))


def test_a_recipe_has_spray_where_somebody_drives_fast_enough_and_else_the_same_bits():
    slow = open_street(LABELLED_STREET, has_wet_ground=True)
    camera = slow.frames[0].cameras["front"]
    dry, wet = (render_view(slow, camera, rainy(spray=on)) for on in (False, True))
    assert np.array_equal(dry.rgb, wet.rgb)
    fast = open_fast_street(has_wet_ground=True)
    steps = [
        {s.name: s for s in make_plan(recipe, scene).steps}["spray behind vehicles"]
        for recipe, scene in ((Recipe(), fast), (rainy(spray=False), fast), (rainy(), slow),
                              (rainy(), fast))
    ]  # fmt: skip
    assert [step.runs for step in steps] == [False, False, False, True]
    assert "40 km/h" in steps[2].why and "mm of water" in steps[3].why
    without, sprayed = (render_view(fast, camera, rainy(spray=on)) for on in (False, True))
    assert not np.array_equal(without.rgb, sprayed.rgb)
    assert without.depth_m is not None and sprayed.depth_m is not None
    assert np.array_equal(without.depth_m, sprayed.depth_m)
    alone = render_view(open_fast_street(has_wet_ground=True), camera, rainy())
    assert np.array_equal(alone.rgb, sprayed.rgb)
