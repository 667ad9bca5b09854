"""Rain and snowfall on LiDAR beams: what drops give back, how often, and what they take."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from augment import effects
from augment.effects.effect import LabelInputs
from augment.effects.falling.lidar import (
    DROP_REFLECTANCE,
    Scatterers,
    beam_width,
    echo_table,
    precipitation_echoes,
    receiver_overlap,
    scatterers_of,
    sphere_reflectance,
    strongest_drops,
)
from augment.effects.lidar import ATTENUATED, LOST, MOVED, PRECIPITATION, UNCHANGED
from augment.effects.lidar.beam import Echoes, LidarModel, signal
from augment.effects.smog import fog_echoes
from augment.effects.wet.drying import RoadFilm, drying_map
from augment.effects.wet.film_kernels import EXPOSURE, NUM_CHANNELS, PUDDLE_ORDER
from augment.effects.wet.ground_map import GROUND_CELL_M, NO_PUDDLES, WetGround
from augment.effects.wet.lidar import dim_echoes_by_film, dim_wet_echoes, wet_echo_ratio
from augment.output.box_weather import box_tables, combine_visibility
from augment.output.manifest import effect_masks
from augment.output.tables import lidar_bytes
from augment.render.fog import Fog
from augment.scene.boxes import NOT_COUNTED, WorldBoxes
from augment.scene.labels import Boxes
from augment.view.plan import make_plan
from augment.view.weathered_sweep import weathered_sweep
from recipes.road_water import MAX_FILM_MM
from recipes.schema import Output, Rain, Recipe, Snow, Snowfall, Weather
from tests.lidar_sweeps import (
    SENSOR_M,
    WORLD_ORIGIN_M,
    ground_points,
    ranges_of,
    some_points,
    street,
    sweep_of,
)
from tests.scenes import camera_ahead

MODEL = LidarModel()


def rain(rate_mm_h: float) -> Scatterers:
    return scatterers_of("rain", float(rate_mm_h))


def echoes_of(points: np.ndarray, intensity: float | np.ndarray = 0.3) -> Echoes:
    origins = np.tile(SENSOR_M + WORLD_ORIGIN_M, (len(points), 1))
    return Echoes.from_sweep(sweep_of(points, intensity), origins, WORLD_ORIGIN_M, MODEL)


@pytest.mark.parametrize(
    ("recorded", "highest"),
    [
        (np.float32([0.1, 1.0, 0.5]), 1.0),  # fractions
        (np.float32([3.0, 180.0, 20.0]), 255.0),
        (np.float32([3.0, 4000.0, 20.0]), 4000.0),  # another scale: as bright as the sweep has it
        (np.float32([np.nan, np.inf, 20.0]), 255.0),
        (np.uint8([3, 180, 20]), 255),
        (np.int32([3, 180, 20]), 255),
    ],
)
def test_no_echo_is_brighter_than_the_sensor_reports(recorded: np.ndarray, highest: float) -> None:
    echoes = echoes_of(some_points(3), recorded)
    echoes.source.columns["intensity"] = recorded
    echoes.replace_echoes(np.array([2]), np.array([2.0]), np.array([1e4]), PRECIPITATION)
    found = echoes.to_sweep().columns["intensity"]
    assert found.dtype == recorded.dtype and found[2] == highest
    np.testing.assert_array_equal(found[:2], recorded[:2])


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
    share = np.minimum((1e-3 * diameter / beam_width(MODEL, r)) ** 2, 1) * receiver_overlap(
        MODEL, r
    )
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
        echoes.drop_faint()
        sweep = echoes.to_sweep()
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
    echoes.add_range_noise(np.ones(count), np.random.default_rng(0).standard_normal(count))
    level = 0.3 / MODEL.noise_reflectance(np.full(1, distance))[0]
    sigma = 0.09 / math.sqrt(2 * level) * math.sqrt(1 / gain - 1)
    assert echoes.ranges_m.std() == pytest.approx(sigma, rel=0.03)
    assert 0.001 < sigma < 0.05
    untouched = echoes_of(points)
    untouched.add_range_noise(np.ones(count), np.ones(count))
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
        echoes.drop_faint()
        found = echoes.to_sweep()
        assert np.isfinite(echoes.ranges_m).all() and np.isfinite(echoes.gain).all()
        assert (found.columns["weather_code"][-2:] == UNCHANGED).all()
        assert np.isfinite(found.columns["intensity"][:-2]).all()


# ---- Wet ground ----------------------------------------------------------------------------------


def ground_of(open_: float = 1.0, hollow: float = 0.0) -> WetGround:
    """Level ground at z = 0, 60 m about the origin."""
    side = round(120 / GROUND_CELL_M)
    channels = torch.zeros(side, side, NUM_CHANNELS)
    channels[..., EXPOSURE], channels[..., PUDDLE_ORDER] = open_, hollow
    flat = torch.zeros(side, side)
    return WetGround(-60.0, -60.0, channels, flat, flat + 1, np.array([-1.0, 0.0, 1.0], np.float32))


def test_water_takes_what_fresnel_and_the_film_take() -> None:
    """By hand, straight down (1 - R0)^2 / (n^2 (1 - p a)); less the flatter."""
    p = 1 - (1 - 0.0659) / 1.33**2
    down = 0.9799**2 / (1.33**2 * (1 - p * 0.3))
    one, flat = np.ones(1), np.array([0.2])
    for puddle in (0 * one, one):
        assert wet_echo_ratio(one, 0.3 * one, puddle)[0] == pytest.approx(down, rel=0.005)
    cosines = np.linspace(0, 1, 300)
    for puddle in (np.zeros(300), np.ones(300)):
        gains = wet_echo_ratio(cosines, 0.1 * cosines, puddle)
        assert (np.diff(gains) > -1e-6).all() and (gains >= 0).all() and gains[-1] < 0.6
    rs, rp = (float(np.square(r)) for r in fresnel(0.2, 1.33))
    mirrored = (1 - (rs + rp) / 2) ** 2 / (1.33**2 * (1 - p * 0.1))
    assert wet_echo_ratio(flat, 0.1 * flat, one)[0] == pytest.approx(mirrored, rel=0.02)


def fresnel(cosine: float, index: float) -> tuple[float, float]:
    inside = math.sqrt(1 - (1 - cosine**2) / index**2)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return s, p


def test_wet_ground_returns_less_and_nothing_else_does() -> None:
    high = np.array([[8.0, 0.0, 1.0], [20.0, 3.0, 2.5], [200.0, 0.0, 0.0]])
    points = np.vstack([ground_points(np.linspace(2, 40, 50)), high])

    def gains(ground: WetGround, wetness: float = 1.0, puddles: float = 0.0) -> np.ndarray:
        echoes = echoes_of(points, 0.02)
        dim_wet_echoes(echoes, ground, wetness, puddles)
        return echoes.gain

    soaked, damp = gains(ground_of()), gains(ground_of(), wetness=0.5)
    assert (soaked[:50] < damp[:50]).all() and (damp[:50] < 1).all()
    assert (soaked[50:] == 1).all()  # a wall, a sign, what lies beyond the map
    assert (gains(ground_of(open_=0.0)) == 1).all() and (gains(ground_of(), wetness=0.0) == 1).all()
    standing = gains(ground_of(hollow=2.0), puddles=0.3)
    assert (standing[20:50] < 0.7 * soaked[20:50]).all()
    assert (gains(ground_of(hollow=-2.0), puddles=0.3) == soaked).all()
    covered = echoes_of(points, 0.02)
    covered.codes[:] = MOVED  # onto snow
    dim_wet_echoes(covered, ground_of(), 1.0, 0.0)
    assert (covered.gain == 1).all()


def test_a_drying_road_gives_its_echoes_back() -> None:
    points = ground_points(np.linspace(2, 40, 200))
    ground = ground_of()
    order = drying_map(ground, 3)

    def gains(film: RoadFilm) -> np.ndarray:
        echoes = echoes_of(points, 0.02)
        dim_echoes_by_film(echoes, ground, order, film, NO_PUDDLES)
        return echoes.gain

    full = RoadFilm(MAX_FILM_MM, MAX_FILM_MM, 1.0, 1.0, 0.0, 1.0)
    plain = echoes_of(points, 0.02)
    dim_wet_echoes(plain, ground, 1.0, 0.0)
    np.testing.assert_allclose(gains(full), plain.gain, rtol=1e-6)
    states = [
        gains(RoadFilm(MAX_FILM_MM * share, MAX_FILM_MM, 1.0, 1.0, 1.0, 0.0))
        for share in (1.0, 0.7, 0.4, 0.2, 0.0)
    ]
    for wetter, drier in itertools.pairwise(states):
        assert (drier >= wetter).all() and drier.mean() > wetter.mean()
    assert (states[-1] == 1).all()
    assert 0.1 < (states[3] == 1).mean() < 0.95  # some places are dry, others not


# ---- By a recipe ---------------------------------------------------------------------------------


def wet(rate_mm_h: float, **weather) -> Recipe:
    fields = {"rain": Rain(rate_mm_h=rate_mm_h, wetness=0.0), **weather}
    return Recipe(weather=Weather(**fields), output=Output(lidar="weather"))


def test_a_recipes_rain_is_on_its_sweeps_and_at_rate_0_is_not() -> None:
    sweep, scene = sweep_of(some_points(3000), 0.05, ring=np.arange(3000)), street()
    out = weathered_sweep(scene, wet(100.0), 0, sweep)
    again = weathered_sweep(scene, wet(100.0), 0, sweep)
    assert lidar_bytes(out) == lidar_bytes(again)
    codes = out.columns["weather_code"]
    assert {ATTENUATED, LOST, PRECIPITATION} == set(codes.tolist())
    np.testing.assert_array_equal(out.columns["ring"], sweep.columns["ring"])
    other = weathered_sweep(scene, wet(100.0), 1, sweep)
    assert lidar_bytes(other) != lidar_bytes(out)  # of each frame its own drops
    dry = weathered_sweep(scene, wet(0.0), 0, sweep)
    for name, column in sweep.columns.items():
        np.testing.assert_array_equal(dry.columns[name], column)
    assert not dry.columns["weather_code"].any()


def test_flakes_end_more_beams_than_drops_of_the_same_rate() -> None:
    sweep, output = sweep_of(some_points(3000), 0.05), Output(lidar="weather")
    falls = Rain(rate_mm_h=2.0, wetness=0.0), Snowfall(rate_mm_h=2.0)
    shares, ranges = [], []
    for each in (Weather(rain=falls[0]), Weather(snowfall=falls[1])):
        out = weathered_sweep(street(), Recipe(weather=each, output=output), 0, sweep)
        drops = out.columns["weather_code"] == PRECIPITATION
        shares.append(drops.mean())
        ranges.append(ranges_of(out)[drops])
    assert shares[0] < 0.01 < 0.1 < shares[1]
    assert 2 < np.median(ranges[1]) < 15
    assert box_tables()["box_snowfall"].sample_columns == (
        "snowfall_transmittance",
        "flake_fraction",
    )


def test_manifests_know_rain_by_what_falls_or_lies() -> None:
    columns = {"rain_rate_mm_h": [0, 0, 5, 5, 0], "rain_wetness": [0, 0.6, 0, 1, np.nan]}
    masks = effect_masks({n: np.array(c, np.float64) for n, c in columns.items()}, 5)
    assert masks["rain"].tolist() == [False, True, True, True, False]
    assert not masks["other"].any()


def test_auto_leaves_sweeps_as_recorded_unless_the_weather_has_surfaces() -> None:
    rain_alone = Weather(rain=Rain(rate_mm_h=5.0))
    assert Recipe(weather=rain_alone).lidar == "clean"
    assert Recipe(weather=rain_alone).lidar_note("clean") is None
    on_snow = Weather(rain=Rain(rate_mm_h=5.0), snow=Snow(depth_m=0.1))
    assert Recipe(weather=on_snow).lidar == "weather"


def test_boxes_say_what_rain_leaves_of_them() -> None:
    """Koschmieder's law over the box's pixels, and the pixels that streaks cross."""
    effect = next(e for e in effects.EFFECTS if e.name == "rain")
    camera = camera_ahead(40, 30, 40.0)
    depth = np.full((30, 40), 20.0, np.float32)
    mask = np.zeros((30, 40), np.uint8)
    mask[:, 10:20] = 255
    boxes = Boxes(
        *(("car", "car", "car"), ("a", "b", "c")),
        np.array([[20.0, 0, 0], [20.0, 300, 0], [np.nan, 0, 0]]),
        np.full((3, 3), 4.0),
        np.tile([1.0, 0, 0, 0], (3, 1)),
    )
    placed = WorldBoxes.from_labels(boxes, np.zeros(3))
    scene = street()
    plan = make_plan(wet(100.0), scene).effect_plans["rain"]
    found = effect.measure_boxes(placed, camera, LabelInputs(plan, depth, mask, None))
    numbers = effect.box_table.make_numbers(boxes.track_ids, **found)
    sigma = rain(100.0).extinction_per_m
    assert numbers["rain_transmittance"][0] == pytest.approx(math.exp(-20 * sigma), abs=1e-3)
    far = math.exp(-math.hypot(20, 300) * sigma)
    assert numbers["rain_transmittance"][1] == pytest.approx(far, rel=0.05)
    assert np.isnan(numbers["rain_transmittance"][2])
    assert numbers["pixels"][0] > 50 and numbers["pixels"][1] == 0
    assert numbers["streak_fraction"][0] == numbers["streak_pixels"][0] / numbers["pixels"][0] > 0
    left = combine_visibility({"box_rain": numbers}, 3)
    np.testing.assert_array_equal(left[:2], numbers["rain_transmittance"][:2])
    unseen = effect.measure_boxes(placed, camera, LabelInputs(plan, None, None, None))
    assert (unseen["pixels"] == NOT_COUNTED).all() and (unseen["streak_pixels"] == 0).all()
    dry = make_plan(wet(0.0), scene).effect_plans["rain"]
    clear = effect.measure_boxes(placed, camera, LabelInputs(dry, None, None, None))
    np.testing.assert_array_equal(clear["rain_transmittance"], [1, 1, np.nan])


REFUSED = (
    ({"rate_mm_h": -1.0}, "rate_mm_h"),
    ({"rate_mm_h": 301.0}, "rate_mm_h"),
    ({"rate_mm_h": math.nan}, "rate_mm_h"),
    ({"rate_mm_h": 1.0, "wind_mps": 100.0}, "wind_mps"),
    ({"rate_mm_h": 1.0, "wind_mps": -1.0}, "wind_mps"),
    ({}, "rate_mm_h"),
    ({"rate_mm_h": 1.0, "sleet": 1.0}, "sleet"),
)


@pytest.mark.parametrize(("fields", "named"), REFUSED)
def test_absurd_rain_is_refused_by_its_fields_name(fields: dict, named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        Rain(**fields)


def test_scenes_that_do_not_know_their_scale_or_times_say_what_is_assumed() -> None:
    scene = street()
    for other, said in (
        (dataclasses.replace(scene, has_metric_scale=False), "not known to be a metre"),
        (dataclasses.replace(scene, has_known_gravity=False), "not known to point down"),
        (dataclasses.replace(scene, frames=scene.frames[:1]), "the cameras' speed is not known"),
    ):
        steps = [step for step in make_plan(wet(5.0), other).steps if step.runs]
        assert any(said in step.why for step in steps)
