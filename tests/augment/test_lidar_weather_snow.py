"""Lying snow on LiDAR: beams end on the layer that the images show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from augment.effects.lidar import MOVED, UNCHANGED
from augment.effects.lidar.sweep import weathered_sweep
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.effect import snow_layers_of
from augment.effects.snow.lidar import GROUND_SLACK_M, LidarSnow, layer_of, meet_layers, snow_in
from augment.effects.snow.snow import PlacedSnow, placement_settings
from augment.memo import memo_of
from recipes.snow import Snow
from tests.lidar_sweeps import (
    SENSOR_M,
    WORLD_ORIGIN_M,
    beams,
    ground_points,
    ranges_of,
    recipe,
    street,
    sweep_of,
)
from tests.snow_beds import cells_on_grid
from tests.snow_scenes import box_car

SNOW = Snow(depth_m=0.1)
FLAT = cells_on_grid(np.zeros((200, 60)), 0.1, corner_m=(0.0, -3.0))


@pytest.fixture(scope="module")
def scene():
    """A street whose support is known: no test here draws it from above."""
    car = box_car(start=(4.0, 3.0), moved_m=3.0)
    opened = street(actors=(car,))
    roof = cells_on_grid(np.full((40, 18), 0.75), 0.1, corner_m=(-2.0, -0.9))
    support = SnowSupport(ground=FLAT, actors={"car": roof})
    memo_of(opened).put(("snow support", placement_settings(SNOW)), support)
    return opened


def meets(cells: SnowCells, depths: np.ndarray | float, points: np.ndarray) -> np.ndarray:
    """Where beams to points end on a layer of snow, [N, 3]."""
    layer = layer_of(cells, np.broadcast_to(np.float32(depths), len(cells)).copy())
    snow = LidarSnow(layer, {}, 0.8)
    origins, directions, ends = beams(points)
    hits = meet_layers(snow, street(), sweep_of(points), 0, origins, directions, ends)
    assert (hits <= ends).all()
    return origins + hits[:, None] * directions


def test_level_snow_is_met_at_its_top() -> None:
    points = ground_points(np.linspace(1, 19, 300))
    found = meets(FLAT, 0.1, points)
    np.testing.assert_allclose(found[:, 2], 0.1, atol=1e-6)  # cells are float32
    expected = SENSOR_M[0] + (points[:, 0] - SENSOR_M[0]) * (1.7 / 1.8)
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-5)


def test_beams_over_and_beside_the_layer_go_on() -> None:
    over = np.array([[19.0, 0.0, 0.11], [15.0, 2.0, 3.0], [0.0, 0.0, 9.0], [-5.0, 0.0, 0.0]])
    np.testing.assert_allclose(meets(FLAT, 0.1, over), over, atol=1e-12)


def test_a_bank_is_met_at_its_side() -> None:
    depths = np.where(FLAT.centers_m[:, 0].numpy() > 5, 0.5, 0.0)
    found = meets(FLAT, depths, np.array([[5.2, 0.0, 0.3], [4.9, 0.0, 0.0], [19.0, 0.0, 1.9]]))
    np.testing.assert_allclose(found[0, 0], 5.0, atol=1e-4)
    np.testing.assert_allclose(found[1:], [[4.9, 0.0, 0.0], [19.0, 0.0, 1.9]], atol=1e-12)


def test_what_lies_under_a_roof_stays() -> None:
    roof = cells_on_grid(np.full((40, 40), 3.0), 0.1, corner_m=(4.0, -2.0))
    under = np.array([[6.0, 0.0, 0.0], [6.0, 0.0, 2.0], [7.9, 1.0, 2.5]])
    np.testing.assert_allclose(meets(roof, 0.2, under), under, atol=1e-12)
    rising = np.array([[6.0, 0.0, 8.0], [8.5, 0.5, 5.0]])  # through the roof, from below
    np.testing.assert_allclose(meets(roof, 0.2, rising), rising, atol=1e-12)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.floats(0.0, 3.0), st.floats(1.0, 4.0))
def test_the_march_is_what_a_search_in_small_steps_finds(seed: int, depth: float, deeper: float):
    """Against the definition, along each beam; and deeper snow never lets a beam go farther."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(0, 0.2, (30, 20))
    ground[rng.random((30, 20)) < 0.1] = np.nan
    cells = cells_on_grid(ground, 0.5, corner_m=(0.5, -5.0))
    depths = (depth * rng.random(len(cells)) * (rng.random(len(cells)) < 0.8)).astype(np.float32)
    points = np.column_stack(
        [rng.uniform(1, 16, 12), rng.uniform(-5, 5, 12), rng.uniform(0, 3, 12)]
    )
    layer = layer_of(cells, depths, grid_m=0.5)
    if layer is None:
        return
    origins, directions, ends = beams(points)
    shallow = meet_layers(
        LidarSnow(layer, {}, 1.0), street(), sweep_of(points), 0, origins, directions, ends
    )
    steps = np.arange(0.3, 20, 5e-3)
    at = origins[:, None] + steps[:, None] * directions[:, None]
    index = np.floor((at[..., :2] - layer.corner) / layer.cell_m).astype(int)
    rows, columns = layer.base.shape
    inside = ((index >= 0) & (index < [columns, rows])).all(-1)
    row, column = np.clip(index[..., 1], 0, rows - 1), np.clip(index[..., 0], 0, columns - 1)
    low, high = layer.base[row, column] - GROUND_SLACK_M, layer.top[row, column]
    within = inside & (at[..., 2] >= low) & (at[..., 2] <= high) & (steps < ends[:, None])
    first = np.where(within.any(1), steps[within.argmax(1)], ends)
    entered = directions[:, 2] < 0  # a step from below may be taken for one from a side
    # A beam may clip a corner by less than a step, which the search does not see.
    assert (shallow[entered] <= first[entered] + 1e-6).all()
    assert (np.abs(shallow - first)[entered] < 1e-2).mean() > 0.8
    deep = layer_of(cells, deeper * depths, grid_m=0.5)
    hits = meet_layers(
        LidarSnow(deep, {}, 1.0), street(), sweep_of(points), 0, origins, directions, ends
    )
    assert (hits <= shallow + 1e-6).all()


def test_the_layer_is_that_of_the_images(scene) -> None:
    placed = PlacedSnow(SNOW, seed=0)
    top = snow_in(scene, placed).ground.top
    means = snow_layers_of(scene, placed).ground.gaussians.means.numpy()
    covered = np.isfinite(top)
    # A splat's middle lies a centimetre inside the layer whose surface it shows.
    assert np.median(top[covered]) == pytest.approx(np.median(means[:, 2]), abs=0.02)
    layer = snow_in(scene, placed).ground
    index = np.floor((means[:, :2] - layer.corner) / layer.cell_m).astype(int)
    near = top[np.clip(index[:, 1], 0, top.shape[0] - 1), np.clip(index[:, 0], 0, top.shape[1] - 1)]
    # Drifts are centimetres high and metres long: with another seed they would not agree.
    rises = np.corrcoef(near[np.isfinite(near)], means[np.isfinite(near), 2])[0, 1]
    assert rises > 0.9


def test_a_sweep_in_the_snow(scene) -> None:
    points = ground_points(np.linspace(1, 19, 200))
    points[:, 1] = np.linspace(-2.5, 2.5, 200)
    sweep = sweep_of(points, intensity=0.1)
    out = weathered_sweep(scene, recipe(snow=SNOW), 0, sweep)
    code = out.columns["weather_code"]
    assert (code == MOVED).mean() > 0.9
    moved = code == MOVED
    assert (ranges_of(out)[moved] < ranges_of(sweep)[moved]).all()
    before = sweep.points_m[moved] - WORLD_ORIGIN_M - SENSOR_M
    after = out.points_m[moved] - WORLD_ORIGIN_M - SENSOR_M
    assert np.linalg.norm(np.cross(before, after), axis=1).max() < 1e-6
    # Level snow at a slant of theta gives back 0.79 cos(theta).
    slant = -before[:, 2] / np.linalg.norm(before, axis=1)
    np.testing.assert_allclose(
        out.columns["intensity"][moved], 0.93 * 0.85 * np.maximum(slant, 0.02), rtol=1e-5
    )


def test_snow_rides_on_a_car_as_its_returns_say_when(scene) -> None:
    """At 0 s the car stands at x = 4, 0.1 s later at 7: its returns are of 0.1 s."""
    points = np.array([[8.5, 3.0, 1.575], [8.4, 3.2, 1.575], [8.3, 2.8, 1.575]])
    late = sweep_of(points, timestamp_ns=np.full(3, 100_000_000))
    out = weathered_sweep(scene, recipe(snow=SNOW), 0, late)
    assert (out.columns["weather_code"] == MOVED).all()
    assert (out.points_m[:, 2] - WORLD_ORIGIN_M[2] > 1.53).all()
    gone = sweep_of(points, timestamp_ns=np.zeros(3, np.int64))
    still = weathered_sweep(scene, recipe(snow=SNOW), 0, gone)
    assert (still.columns["weather_code"] == UNCHANGED).all()


def test_no_snow_where_none_lies() -> None:
    assert layer_of(FLAT, np.zeros(len(FLAT), np.float32)) is None
    empty = dataclasses.replace(
        FLAT, **{f.name: getattr(FLAT, f.name)[:0] for f in dataclasses.fields(FLAT)}
    )
    assert layer_of(empty, np.zeros(0, np.float32)) is None
    assert torch.equal(empty.centers_m, torch.zeros(0, 3))
