"""Rain and snowfall on LiDAR beams: what drops give back, how often, and what they take."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from augment.effects.falling.lidar import (
    DROP_REFLECTANCE,
    Scatterers,
    beam_width,
    echo_table,
    precipitation_echoes,
    scatterers_of,
    seen_share,
    sphere_reflectance,
    strongest_drops,
)
from augment.effects.lidar import ATTENUATED, LOST, PRECIPITATION, UNCHANGED
from augment.effects.lidar.beam import Echoes, LidarModel, signal
from augment.effects.smog import fog_echoes
from augment.render.fog import Fog
from tests.lidar_sweeps import SENSOR_M, WORLD_ORIGIN_M, some_points, sweep_of

MODEL = LidarModel()


def rain(rate_mm_h: float) -> Scatterers:
    return scatterers_of("rain", float(rate_mm_h))


def echoes_of(points: np.ndarray, intensity: float | np.ndarray = 0.3) -> Echoes:
    origins = np.tile(SENSOR_M + WORLD_ORIGIN_M, (len(points), 1))
    return Echoes.of(sweep_of(points, intensity), origins, WORLD_ORIGIN_M, MODEL)


def test_a_sphere_gives_back_what_traced_rays_say() -> None:
    """dsigma/dOmega = b db / (sin theta dtheta) of rays that leave almost straight back."""
    index = 1.3275
    inside = lambda b: math.asin(b / index)  # noqa: E731
    turned = {0: lambda b: 2 * math.asin(b), 1: lambda b: 2 * math.asin(b) - 4 * inside(b)}
    r = ((index - 1) / (index + 1)) ** 2
    found, step = 0.0, 1e-4
    for order, weight in ((0, r), (1, (1 - r) ** 2 * r)):
        low, high = (abs(turned[order](b)) for b in (step, 2 * step))  # from straight back
        area, angle = math.pi * 3 * step**2, 2 * math.pi * (math.cos(low) - math.cos(high))
        found += weight * area / angle
    assert sphere_reflectance(index) == pytest.approx(found, rel=1e-3)
    assert sphere_reflectance(1.0) == 0


@pytest.mark.parametrize("kind", [rain(100), scatterers_of("snow", 1.0)])
def test_the_strongest_echo_is_that_of_drops_strewn_one_by_one(kind: Scatterers) -> None:
    """Poisson drops in every beam: how often one is seen, how strong and how far it is."""
    rng, count, end = np.random.default_rng(0), 6000, 25.0
    far = np.linspace(0, end, 2001)
    area = math.pi / 4 * beam_width(MODEL, far) ** 2
    volume = np.concatenate([[0], np.cumsum((area[1:] + area[:-1]) / 2 * np.diff(far))])
    least_mm = 0.6  # smaller ones are too faint
    number = kind.wider(np.array([least_mm]))
    numbers = rng.poisson(volume[-1] * number, count)
    beam = np.repeat(np.arange(count), numbers)
    r = np.interp(rng.random(len(beam)) * volume[-1], volume, far)
    wider = rng.random(len(beam)) * number
    diameter = np.interp(wider, kind.wider_per_m3[::-1], kind.diameters_mm[::-1])
    share = np.minimum((1e-3 * diameter / beam_width(MODEL, r)) ** 2, 1) * seen_share(MODEL, r)
    power = signal(kind.reflectance * share, np.maximum(r, 0.1))
    power *= np.exp(-2 * kind.extinction_per_m * r)
    best = np.zeros(count)
    np.maximum.at(best, beam, power)
    table = echo_table(kind, MODEL)
    strength, ranges = strongest_drops(table, np.full(count * 10, end), rng)
    noise = MODEL.noise_signal
    for threshold in (noise, 2 * noise, 5 * noise):
        expected, got = (best > threshold).mean(), (strength > threshold).mean()
        assert got == pytest.approx(expected, abs=4 * math.sqrt((expected + 2e-4) / count))
    seen = power == best[beam]
    seen &= power > noise
    for quantile in (0.25, 0.5, 0.75):
        expected = np.quantile(r[seen], quantile)
        assert np.quantile(ranges[strength > 0], quantile) == pytest.approx(expected, rel=0.15)


def test_no_drop_is_seen_behind_a_surface_and_more_rain_is_never_weaker() -> None:
    ends = np.linspace(0.2, 40, 20_000)
    before = np.zeros(len(ends))
    for rate in (1, 10, 50, 300):
        table = echo_table(rain(rate), MODEL)
        strength, ranges = strongest_drops(table, ends, np.random.default_rng(3))
        assert (ranges <= ends).all() and (strength[ends < MODEL.overlap_from_m] == 0).all()
        assert (ranges[strength > 0] >= MODEL.overlap_from_m).all()
        # What is denser dims, too: by less than 3 % of what a drop 10 m away gives.
        assert (strength >= 0.75 * before).all()
        before = strength
    assert (before > 0).mean() > 0.1


def test_rain_takes_and_adds_by_its_rate() -> None:
    points = some_points(4000)
    kept, seen = [], []
    for rate in (2.5, 25, 250):
        echoes = echoes_of(points, 0.05)
        clear = echoes.ranges_m.copy()
        precipitation_echoes(echoes, rain(rate), np.random.default_rng(1))
        echoes.lose_faint()
        sweep = echoes.sweep()
        codes = sweep.columns["weather_code"]
        hard = codes == ATTENUATED
        assert not (codes == UNCHANGED).any()
        dimmed = 0.05 * np.exp(-2 * rain(rate).extinction_per_m * clear)
        np.testing.assert_allclose(sweep.columns["intensity"][hard], dimmed[hard], rtol=1e-5)
        drops = codes == PRECIPITATION
        assert (echoes.ranges_m[drops] < clear[drops]).all()
        assert np.isnan(sweep.points_m[codes == LOST]).all()
        kept.append(hard)
        seen.append(drops.mean())
    assert all((thin | ~dense).all() for thin, dense in itertools.pairwise(kept))
    assert seen[0] < 1e-3 < seen[1] < seen[2]


def test_ranges_are_as_noisy_as_what_is_left_of_their_echo() -> None:
    distance, count = 60.0, 20_000
    points = np.tile([distance, 0.0, SENSOR_M[2]], (count, 1))
    echoes = echoes_of(points)
    kind = rain(25)
    gain = math.exp(-2 * kind.extinction_per_m * distance)
    echoes.gain *= gain
    echoes.spread_ranges(np.ones(count), np.random.default_rng(0).standard_normal(count))
    level = 0.3 / MODEL.noise_reflectance(np.full(1, distance))[0]
    sigma = 0.09 / math.sqrt(2 * level) * math.sqrt(1 / gain - 1)
    assert echoes.ranges_m.std() == pytest.approx(sigma, rel=0.03)
    assert 0.001 < sigma < 0.05
    untouched = echoes_of(points)
    untouched.spread_ranges(np.ones(count), np.ones(count))
    assert (untouched.codes == UNCHANGED).all() and not untouched.is_moved.any()


def test_fog_and_rain_dim_together_whichever_comes_first() -> None:
    points, fog = some_points(2000), Fog(0.003, (0.7, 0.7, 0.7))

    def dimmed(order: str) -> np.ndarray:
        echoes = echoes_of(points)
        for what in order.split():
            rng = np.random.default_rng(5)
            if what == "fog":
                fog_echoes(echoes, fog, rng)
            else:
                precipitation_echoes(echoes, rain(10), rng)
        return echoes.gain

    one, other = dimmed("fog rain"), dimmed("rain fog")
    np.testing.assert_allclose(one, other, rtol=0.02)  # ranges have their noise


def test_precipitation_of_every_density_stays_finite() -> None:
    points = np.vstack([some_points(50), [[np.nan, 0, 0], [0.0, 0.0, 1.8]]])
    for kind in (
        rain(1e-6),
        rain(300),
        scatterers_of("snow", 1e-6),
        scatterers_of("snow", 300.0),
        Scatterers(np.array([1.0, 50.0]), np.array([1e9, 0.0]), 1e3, 1.0),
        Scatterers(np.array([1.0, 2.0]), np.zeros(2), 0.0, DROP_REFLECTANCE),
    ):
        echoes = echoes_of(points)
        precipitation_echoes(echoes, kind, np.random.default_rng(0))
        echoes.lose_faint()
        found = echoes.sweep()
        assert np.isfinite(echoes.ranges_m).all() and np.isfinite(echoes.gain).all()
        assert (found.columns["weather_code"][-2:] == UNCHANGED).all()
        assert np.isfinite(found.columns["intensity"][:-2]).all()
