"""Fog on LiDAR: extinction at its wavelength, the soft echo, what is lost and what is scattered."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from augment.effects.lidar import ATTENUATED, LOST, SCATTERED, UNCHANGED
from augment.effects.lidar.beam import LidarModel
from augment.effects.lidar.sweep import weathered_sweep
from augment.effects.smog import scatter_before, soft_echo, soft_response, wavelength_factor
from augment.render.fog import Fog, optical_depth_of_arrays
from recipes.schema import Smog
from recipes.smog import KOSCHMIEDER
from tests.lidar_sweeps import ranges_of, recipe, some_points, street, sweep_of

MODEL = LidarModel()


@pytest.mark.parametrize(
    ("visibility_km", "expected"),
    [(0.05, 1.0), (0.5, 1.0), (1.0, 0.779), (6.0, 0.523), (20.0, 0.523), (60.0, 0.451)],
)
def test_kims_factor(visibility_km: float, expected: float) -> None:
    """The table's values by hand: (0.905 / 0.55)^-q, q = 0, 0, 0.5, 1.3, 1.3, 1.6."""
    factor = wavelength_factor(KOSCHMIEDER / (1000 * visibility_km))
    assert factor == pytest.approx(expected, abs=1e-3)
    assert wavelength_factor(0.0) == 1.0


def test_extinction_rises_with_the_smogs_density_at_905_nm_too() -> None:
    sigma = np.geomspace(1e-6, 10, 4000)
    thinned = np.array([s * wavelength_factor(float(s)) for s in sigma])
    assert (np.diff(thinned) > 0).all()


def test_intensities_fall_by_two_ways() -> None:
    points = some_points()
    sweep = sweep_of(points, intensity=0.5)
    out = weathered_sweep(street(), recipe(smog=Smog(extinction_per_m=0.01)), 0, sweep)
    code = out.columns["weather_code"]
    seen = code == ATTENUATED
    assert seen.all(), "nothing is near the noise yet"
    expected = 0.5 * np.exp(-2 * 0.01 * ranges_of(sweep))
    np.testing.assert_allclose(out.columns["intensity"][seen], expected[seen], rtol=1e-5)
    assert (out.points_m[seen] == sweep.points_m[seen]).all()


@pytest.mark.parametrize("alpha", [0.002, 0.06, 0.5])
def test_the_soft_echo_is_the_integral(alpha: float) -> None:
    w = MODEL.pulse_m
    beta = 0.046 * alpha / math.log(20)

    def echo(reported: float) -> float:
        def integrand(r: float) -> float:
            x = reported + w - r
            overlap = min(max((r - 0.9) / 0.1, 0.0), 1.0)
            return (
                beta
                * math.sin(math.pi * x / (2 * w)) ** 2
                * math.exp(-2 * alpha * r)
                * overlap
                / r**2
            )

        low, high = max(reported - w, 0.9), reported + w
        return quad(integrand, low, high, points=[min(max(1.0, low), high)], epsabs=0, limit=200)[0]

    at = np.array([0.95, 1.3, 1.8, 2.5, 4.0, 8.0])
    exact = np.array([echo(float(r)) for r in at])
    # The midpoint rule steps 2 cm through an overlap that rises within 10.
    np.testing.assert_allclose(soft_response(alpha, at, MODEL), exact, rtol=5e-3)
    fine = np.arange(0.9, 6, 0.01)
    peak = fine[np.argmax([echo(float(r)) for r in fine])]
    table = soft_echo(alpha, MODEL)
    assert table.ranges_m[table.signal.argmax()] == pytest.approx(peak, abs=0.04)


def test_dense_fog_shows_itself_and_hides_what_is_far() -> None:
    sweep = sweep_of(some_points(2000), intensity=0.2)
    out = weathered_sweep(street(), recipe(smog=40), 0, sweep)
    code, before, after = out.columns["weather_code"], ranges_of(sweep), ranges_of(out)
    assert (code[before > 60] != ATTENUATED).all()
    assert (code[before < 8] == ATTENUATED).all()
    scattered = code == SCATTERED
    assert scattered.mean() > 0.2
    assert (after[scattered] < before[scattered]).all() and (after[scattered] > 0.89).all()
    assert np.median(after[scattered]) < 6
    assert (out.columns["intensity"][scattered] < 0.05).all()
    lost = code == LOST
    assert np.isnan(out.points_m[lost]).all() and (out.columns["intensity"][lost] == 0).all()


def test_denser_smog_leaves_less() -> None:
    sweep = sweep_of(some_points(1500), intensity=np.linspace(0, 1, 1500))
    scene = street()
    kept, bright, unchanged = [], [], []
    for visibility_m in (5000, 1000, 300, 100, 50, 20, 5):
        out = weathered_sweep(scene, recipe(smog=visibility_m), 0, sweep)
        code = out.columns["weather_code"]
        kept.append(code == ATTENUATED)
        unchanged.append(code == UNCHANGED)
        bright.append(np.where(kept[-1], out.columns["intensity"], 0))
    for thin, dense in itertools.pairwise(unchanged):
        assert not (dense & ~thin).any()
    for (thin, dense), (lit, dim) in zip(
        itertools.pairwise(kept), itertools.pairwise(bright), strict=True
    ):
        assert not (dense & ~thin & ~unchanged[0]).any()
        assert (dim[dense & thin] <= lit[dense & thin]).all()


def test_whole_numbers_stay_whole() -> None:
    points = some_points(300)
    sweep = sweep_of(
        points, intensity=None, intensity_8=np.zeros(300), i=np.full(300, 40, np.uint8)
    )
    out = weathered_sweep(street(), recipe(smog=2000), 0, sweep)
    assert out.columns["i"].dtype == np.uint8
    code = out.columns["weather_code"]
    assert ((code == UNCHANGED) == (out.columns["i"] == 40)).all() and (code == UNCHANGED).any()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.floats(1e-9, 100.0),
    st.one_of(st.none(), st.floats(0.1, 1e5)),
    st.floats(-1e4, 1e4),
    st.integers(0, 2**31),
)
def test_extremes(sigma: float, height: float | None, base: float, seed: int) -> None:
    medium = Fog(sigma, (1.0, 1.0, 1.0), height, base)
    rng = np.random.default_rng(seed)
    ends = np.array([0.0, 1e-3, 0.9, 0.91, 5.0, 200.0, 1e6])
    eyes = np.full(7, 1.8)
    tau = optical_depth_of_arrays(medium, ends, eyes, eyes - 0.01 * ends)
    assert (tau >= 0).all()
    found = scatter_before(medium, eyes, ends, MODEL, rng)
    assert np.isfinite(found.signal).all() and (found.signal >= 0).all()
    assert (found.ranges_m <= ends).all() and (found.signal[:3] == 0).all()
