"""The noise that snow follows, and its kernel against the numpy definition."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.effects.snow.layer import (
    field_of,
    find_depths,
    gradient_noise,
    heights_of,
    mottle_of,
    octaves_of,
    profile_of,
    threshold_of,
)
from augment.render.threads import limit_threads
from recipes.snow import Snow
from tests.snow_beds import cells_on_grid

SEED = np.uint64(77)


def _points(count: int, *, seed: int = 0, far: float = 1e5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-far, far, count), rng.uniform(-far, far, count)


def test_noise_has_unit_deviation_and_median_zero():
    """400 000 points apart: the standard errors are 0.0012 and 0.0024; four of each are allowed."""
    noise = gradient_noise(*_points(400_000), SEED)
    assert abs(noise.std() - 1) < 0.005
    assert abs(np.median(noise)) < 0.01


def test_noise_is_continuous_also_across_the_lattice():
    u, v = _points(20_000, far=50)
    u[:5000] = np.round(u[:5000])
    step = 1e-6
    for du, dv in ((step, 0), (-step, 0), (0, step), (0, -step)):
        change = gradient_noise(u + du, v + dv, SEED) - gradient_noise(u, v, SEED)
        assert np.abs(change).max() < 40 * step  # its steepest rise is about 15


def test_noise_is_zero_on_the_lattice_and_not_mirrored_at_the_origin():
    whole = np.arange(-3.0, 4.0)
    assert np.array_equal(gradient_noise(whole, whole[::-1], SEED), np.zeros(7))
    u, v = (np.abs(p) for p in _points(1000, far=20))
    here, mirrored = gradient_noise(u, v, SEED), gradient_noise(-u, v, SEED)
    assert abs(np.corrcoef(here, mirrored)[0, 1]) < 0.1


def test_noise_of_other_seeds_and_far_places_is_unrelated():
    u, v = _points(20_000, far=100)
    here = gradient_noise(u, v, SEED)
    for other in (gradient_noise(u, v, np.uint64(78)), gradient_noise(u + 1e6, v - 1e6, SEED)):
        assert abs(np.corrcoef(here, other)[0, 1]) < 0.04  # 5.6 standard errors
        assert abs(other.std() - 1) < 0.03


def test_threshold_leaves_the_share_it_was_asked_for():
    octaves = octaves_of(((2.6, 1.0), (1.1, 0.5), (0.45, 0.3)), np.random.default_rng(5))
    field = field_of(octaves, *_points(200_000, seed=3))
    for share in (0.01, 0.5, 0.9):
        got = (field > threshold_of(octaves, share)).mean()
        assert abs(got - share) < 0.005  # standard errors 0.0011 here and 0.0014 of the threshold
    assert threshold_of(octaves, 0.0) == math.inf and threshold_of(octaves, 1.0) == -math.inf


def test_stretched_noise_changes_faster_along_the_wind():
    octaves = octaves_of(((2.0, 1.0),), np.random.default_rng(1), along=0.7, stretch=2.0)
    x, y = _points(20_000, far=1000)
    here = field_of(octaves, x, y)
    cos, sin = 0.1 * math.cos(0.7), 0.1 * math.sin(0.7)
    along = np.abs(field_of(octaves, x + cos, y + sin) - here).mean()
    across = np.abs(field_of(octaves, x - sin, y + cos) - here).mean()
    assert 3.4 < along / across < 4.6  # 2 over 1/2


def test_octaves_fade_before_cells_are_too_large_to_show_them():
    octaves = octaves_of(((0.4, 1.0),), np.random.default_rng(1))
    x, y = _points(2000)
    whole = field_of(octaves, x, y, 0.1)
    assert np.array_equal(whole, field_of(octaves, x, y))
    np.testing.assert_allclose(field_of(octaves, x, y, 0.15), 0.5 * whole, rtol=1e-12)
    assert not field_of(octaves, x, y, 0.2).any()


def _rugged_cells(corner_m=(0.0, 0.0)):
    rng = np.random.default_rng(4)
    z = rng.normal(0, 0.05, (40, 30))
    z[10:16, 10:20] = np.nan
    cells = cells_on_grid(z, 0.1, corner_m=corner_m, tracks=rng.random((40, 30)))
    count = len(cells)
    banks = torch.from_numpy(rng.uniform(-1, 1, (count, 2)).astype(np.float32))
    sizes = torch.from_numpy(rng.choice([0.05, 0.1, 0.4], count).astype(np.float32))
    return dataclasses.replace(cells, banks=banks, sizes_m=sizes)


@pytest.mark.parametrize(
    "options, corner_m, water",
    [
        ({"depth_m": 0.2, "tracks": "never"}, (0.0, 0.0), None),
        ({"depth_m": 0.1, "coverage": 0.5, "grain": 1.0}, (-37.5, 1e6), -0.01),
        ({"depth_m": 0.003}, (0.0, 0.0), -0.01),
        (
            {"depth_m": 10.0, "wind": {"drift": 1.0, "direction_deg": 200}, "tracks": "always"},
            *((-37.5, 1e6), None),
        ),
    ],
)
def test_kernel_computes_what_the_definition_says(options, corner_m, water):
    """Everything is float64 but the result, which is rounded to float32."""
    cells = _rugged_cells(corner_m)
    rng = np.random.default_rng(9)
    profile = profile_of(Snow(**options), rng, on_ground=True, water_level_z_m=water)
    depths = find_depths(cells, profile, SEED)
    expected = heights_of(cells, profile)
    assert (expected == 0).any() == (water is not None or options["depth_m"] < 0.2)
    np.testing.assert_allclose(depths.heights, expected, rtol=2e-6, atol=1e-12)
    covered = expected > 0
    np.testing.assert_allclose(
        depths.mottle[covered], mottle_of(cells, profile)[covered], rtol=1e-6, atol=1e-6
    )


def test_random_bits_hang_on_the_place_and_differ_between_cells():
    cells = cells_on_grid(np.zeros((60, 50)), 0.05)
    profile = profile_of(Snow(depth_m=0.1), np.random.default_rng(0), on_ground=True)
    draws = find_depths(cells, profile, SEED).draws
    assert len(np.unique(draws)) == len(cells)
    some = cells_on_grid(np.zeros((30, 50)), 0.05, corner_m=(1.5, 0.0))
    assert np.array_equal(find_depths(some, profile, SEED).draws, draws[1500:])


def test_depths_have_the_same_bits_for_any_number_of_threads():
    cells = cells_on_grid(np.zeros((150, 100)), 0.05)
    profile = profile_of(Snow(depth_m=0.01), np.random.default_rng(0), on_ground=True)
    found = []
    for count in (1, 2):
        limit_threads(count)
        try:
            found.append(find_depths(cells, profile, SEED))
        finally:
            limit_threads(None)
    for one, two in zip(*found, strict=True):
        assert np.array_equal(one, two)
