"""Floods on LiDAR: mirrors, shallow beds, mud."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augment.effects.flood.flood import FloodMedium
from augment.effects.flood.lidar import ABSORPTION_905_PER_M, meet_water, water_reflectance
from augment.effects.flood.waves import make_waves
from augment.effects.lidar import LOST, MOVED, SCATTERED, UNCHANGED
from augment.effects.lidar.sweep import weathered_sweep
from recipes.flood import Flood, Waves
from tests.lidar_sweeps import beams, ground_points, recipe, some_points, street, sweep_of

CLEAR = Flood(level_m=0.02, reference="absolute", turbidity_ntu=0)


def medium(level_m: float = 0.02, extinction: float = 0.34, index: float = 1.333) -> FloodMedium:
    return FloodMedium(
        level_z_m=level_m,
        extinction_per_m=(extinction, 0.06, 0.01),
        rgb=(0.4, 0.4, 0.3),
        waves=make_waves(Waves(preset="still"), seed=0, depth_m=1.0),
        refraction_index=index,
    )


def test_a_shallow_bed_by_hand() -> None:
    """Straight down through 2 cm: 1 - F = 0.98, exp(-2 7.5 0.02), and 2 cm of water as 2.7."""
    found = meet_water(medium(), *beams(np.array([[0.0, 0.0, 0.0]])), np.array([0.3]))
    transmitted = 1 - ((1.333 - 1) / (1.333 + 1)) ** 2
    assert found.kept[0] == pytest.approx(transmitted**2 * math.exp(-0.04 * ABSORPTION_905_PER_M))
    assert found.range_m[0] == pytest.approx(1.78 + 1.333 * 0.02)
    assert found.surface_m[0] == pytest.approx(1.78) and found.is_bed[0]


def test_a_slanted_beam_bends() -> None:
    """45 degrees: asin(sin 45 / n) below, so 2 cm take 2 cm / cos of that."""
    found = meet_water(medium(), *beams(np.array([[1.8, 0.0, 0.0]])), np.array([0.3]))
    below = math.asin(math.sin(math.pi / 4) / 1.333)
    expected = 1.78 * math.sqrt(2) + 1.333 * 0.02 / math.cos(below)
    assert found.range_m[0] == pytest.approx(expected, abs=1e-9)


def test_without_refraction_and_depth_nothing_changes() -> None:
    origins, directions, ends = beams(ground_points(np.linspace(1, 20, 30)))
    found = meet_water(medium(1e-12, index=1.0), origins, directions, ends, np.full(30, 0.3))
    np.testing.assert_allclose(found.range_m, ends[found.rows], rtol=1e-12)
    np.testing.assert_allclose(found.kept, 1.0, atol=1e-8)


def test_a_clear_flood_shows_its_bed_near_the_car_and_nothing_farther() -> None:
    distances = np.linspace(1, 60, 200)
    sweep = sweep_of(ground_points(distances), intensity=0.2)
    out = weathered_sweep(street(), recipe(flood=CLEAR), 0, sweep)
    code = out.columns["weather_code"]
    assert code[0] == MOVED and code[-1] == LOST
    assert SCATTERED not in code and UNCHANGED not in code
    moved = code != LOST
    assert (np.diff(moved.astype(int)) <= 0).all(), "once lost, farther is lost, too"
    assert (out.columns["intensity"][moved] < 0.2).all()
    # Slower light makes it seem deeper straight below, bent beams less deep at a slant.
    rises = out.points_m[moved][:, 2] - sweep.points_m[moved][:, 2]
    slanted = distances[moved] > 3
    assert rises[0] < 0 and slanted.any() and (rises[slanted] > 0).all()


def test_deep_clear_water_swallows_what_is_not_right_below() -> None:
    sweep = sweep_of(ground_points(np.linspace(4, 60, 50)), intensity=0.9)
    deep = Flood(level_m=0.5, reference="absolute", turbidity_ntu=0)
    out = weathered_sweep(street(), recipe(flood=deep), 0, sweep)
    assert (out.columns["weather_code"] == LOST).all()


def test_mud_shows_its_surface_near_by() -> None:
    sweep = sweep_of(ground_points(np.linspace(1, 90, 100)), intensity=0.2)
    muddy = Flood(level_m=0.4, reference="absolute", turbidity_ntu=200)
    out = weathered_sweep(street(), recipe(flood=muddy), 0, sweep)
    code = out.columns["weather_code"]
    assert code[0] == SCATTERED and code[-1] == LOST
    np.testing.assert_allclose(out.points_m[code == SCATTERED][:, 2], 41.5 + 0.4, atol=1e-6)
    assert water_reflectance(medium(extinction=0.34)) == 0
    assert 0.05 < water_reflectance(medium(extinction=100.0)) < 0.33


def test_what_stands_out_of_the_water_stays() -> None:
    points = some_points(400)
    sweep = sweep_of(points, intensity=0.2)
    out = weathered_sweep(street(), recipe(flood=0.05), 0, sweep)
    dry = points[:, 2] > 0.05
    assert ((out.columns["weather_code"] == UNCHANGED) == dry).all()


def test_a_drowned_sensor_sees_nothing() -> None:
    sweep = sweep_of(some_points(50), intensity=0.2)
    out = weathered_sweep(street(), recipe(flood=2.0), 0, sweep)
    assert (out.columns["weather_code"] == LOST).all()


def test_more_water_never_leaves_more() -> None:
    sweep = sweep_of(some_points(800), intensity=0.3)
    scene = street()
    before = np.ones(800, bool)
    for level_m in (0.001, 0.01, 0.1, 0.5, 1.5, 1.79, 1.81, 5.0):
        out = weathered_sweep(scene, recipe(flood=level_m), 0, sweep)
        unchanged = out.columns["weather_code"] == UNCHANGED
        assert not (unchanged & ~before).any()
        before = unchanged


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(-50, 1.79), st.floats(0, 1e6), st.floats(1, 3), st.floats(0.0, 1.0))
def test_extremes(level: float, extinction: float, index: float, rho: float) -> None:
    points = np.vstack([some_points(20), [[1e-9, 0, -100], [1e5, 0, 1.7999], [1, 0, 1.8]]])
    found = meet_water(medium(level, extinction, index), *beams(points), np.full(23, rho))
    for values in (found.surface_m, found.range_m, found.kept, found.reflectance):
        assert np.isfinite(values).all() and (values >= 0).all()
    assert (found.kept <= 1 + 1e-12).all() and (found.reflectance < 0.33).all()
    assert (found.range_m >= found.surface_m).all()
