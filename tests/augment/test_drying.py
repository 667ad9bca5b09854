"""A road that gets wet and dries: the order of drying, stains of drops, pictures, beams, spray."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.effects.spray.puffs import film_depth_m, lifted_water_m
from augment.effects.wet.drying import (
    RoadFilm,
    drying_map,
    local_water,
    road_film,
    stain_levels,
    stain_table,
    stained_share,
)
from augment.effects.wet.film_kernels import (
    DRYING_RANK,
    EXPOSURE,
    HEIGHT,
    NUM_CHANNELS,
    NUM_STAIN_LEVELS,
    STAIN_SIDE,
    STAIN_TEXEL_M,
    WHEEL_TRACK,
)
from augment.effects.wet.ground_map import GROUND_CELL_M, NO_PUDDLES, WetGround, wet_ground
from augment.effects.wet.lidar import wet_echo_ratio
from augment.effects.wet.reflection import find_ground, wet_by_film
from augment.view.render_view import render_view
from recipes.curve import Curve
from recipes.moment import Air
from recipes.rain import Rain, RoadWater
from recipes.road_water import MAX_FILM_MM, AirCurves, road_state
from recipes.schema import Recipe, Weather
from tests.augment.test_wet import QUIET, flat_map, street
from tests.snow_beds import looking

FULL = RoadFilm(MAX_FILM_MM, MAX_FILM_MM, 1.0, 1.0, 0.0, 1.0)
SHOWER = Curve((0.0, 120.0, 900.0, 1000.0), (0.0, 10.0, 10.0, 0.0))
AIR = AirCurves.constant(Air(temperature_c=25.0, humidity=0.5, road_warmer_k=5.0))


def drying(film_mm: float, **more) -> RoadFilm:
    """Film of a road that was full once."""
    return dataclasses.replace(FULL, film_mm=film_mm, tracks=1.0, spots=0.0, **more)


def cambered_map() -> WetGround:
    """A road along x: a crown in the middle, gutters 6 cm lower, wheel tracks on one side."""
    ground = flat_map(24.0)
    count = len(ground.channels)
    y = (np.arange(count) + 0.5) * GROUND_CELL_M - 12
    channels = torch.zeros(count, count, NUM_CHANNELS)
    channels[..., HEIGHT] = torch.from_numpy(-0.06 * (np.abs(y) / 12) ** 6).float()[:, None]
    channels[..., EXPOSURE] = 1.0
    channels[..., WHEEL_TRACK] = torch.from_numpy(np.abs(y - 4) < 0.5).float()[:, None]
    return dataclasses.replace(ground, channels=channels)


def recipe(rate_mm_h: float = 0.0, **road) -> Recipe:
    rain = Rain(rate_mm_h=rate_mm_h, road=RoadWater(**road), puddles=0.0)
    return Recipe(weather=Weather(rain=rain), output=QUIET, seed=3)


def recipe_at(time_s: float) -> Recipe:
    """The recipe of a moment of the shower."""
    state = vars(road_state(SHOWER, AIR, time_s))
    rain = Rain(rate_mm_h=SHOWER.value(time_s), road=RoadWater(**state))
    return Recipe(weather=Weather(rain=rain), output=QUIET, seed=3)


# ---- The order of drying -------------------------------------------------------------------------


def test_ranks_are_even_and_tracks_dry_before_gutters():
    ground = cambered_map()
    rank = drying_map(ground, 3).channels[..., DRYING_RANK].numpy()
    shares = [(rank < level).mean() for level in (0.25, 0.5, 0.75)]
    assert shares == pytest.approx([0.25, 0.5, 0.75], abs=0.02)
    track = ground.channels[..., WHEEL_TRACK].numpy() > 0.5
    gutter = np.zeros_like(track)
    gutter[:4] = gutter[-4:] = True
    assert rank[track].mean() < 0.3 < 0.5 < rank[~track].mean() < 0.7 < rank[gutter].mean()
    assert drying_map(ground, 3) is drying_map(ground, 3)
    assert not torch.equal(drying_map(ground, 3).channels, drying_map(ground, 4).channels)


def test_wet_places_only_shrink_as_a_road_dries():
    rank = torch.linspace(0, 1, 501)
    zero = torch.zeros(501)
    before = torch.full((501,), math.inf)
    shares = []
    for film_mm in np.linspace(MAX_FILM_MM, 0, 61):
        wetness, mirror = local_water(drying(float(film_mm)), rank, zero, zero, zero)
        assert bool((wetness <= before + 1e-6).all()) and bool((mirror <= wetness + 1e-6).all())
        assert bool((wetness.diff() >= -1e-6).all())  # the last places are the wettest
        shares.append(float((wetness > 0.5).float().mean()))
        before = wetness
    assert shares[0] == 1 and shares[-1] == 0
    assert shares[20] > 0.9 and 0.2 < shares[40] < 0.8  # patches in the last half of the time


def test_a_film_that_has_never_been_larger_is_even():
    rank = torch.linspace(0, 1, 11)
    zero = torch.zeros(11)
    for film_mm in (0.02, 0.2, MAX_FILM_MM):
        film = RoadFilm(film_mm, film_mm, 0.8, 0.8, 0.0, 0.0)
        wetness, mirror = local_water(film, rank, zero, zero, zero)
        assert float(wetness.max() - wetness.min()) < 1e-6 > float(mirror.max() - mirror.min())
    assert float(wetness[0]) == pytest.approx(0.8) and float(mirror[0]) == 1


def test_first_drops_leave_dry_ground_between_them():
    rank = torch.full((2,), 0.5)
    zero = torch.zeros(2)
    spots = torch.tensor([0.0, 1.0])
    for film_mm, darkest in ((0.01, 0.02), (0.03, 0.1)):
        film = RoadFilm(film_mm, film_mm, 1.0, 1.0, 0.0, 0.5)
        wetness, _ = local_water(film, rank, zero, spots, zero)
        assert float(wetness[0]) < darkest and float(wetness[1]) == 1


def test_wheels_dry_their_tracks_and_puddles_stay():
    rank = torch.full((3,), 0.6)
    track = torch.tensor([0.0, 1.0, 0.0])
    puddle = torch.tensor([0.0, 0.0, 1.0])
    zero = torch.zeros(3)
    _, mirror = local_water(drying(0.5), rank, track, zero, puddle)
    assert float(mirror[1]) < 0.3 * float(mirror[0]) and float(mirror[2]) == 1
    wetness, mirror = local_water(drying(0.0), rank, track, zero, puddle)
    assert wetness.tolist() == [0, 0, 1] and mirror.tolist() == [0, 0, 1]


# ---- Stains --------------------------------------------------------------------------------------


def test_stains_cover_their_share_and_have_the_size_of_drops():
    table = stain_table()
    for share in (0.1, 0.5, 0.9):
        assert (table < share).mean() == pytest.approx(share, abs=1e-4)
    assert bool(((table < 0.2) <= (table < 0.3)).all())  # no stain dries while others fall
    # Discs of radius r that cover a small share s have an autocorrelation of 1/2 at 0.81 r.
    hit = (table < 0.03).astype(float) - 0.03
    same = [(hit * np.roll(hit, step, 1)).mean() / (hit * hit).mean() for step in (1, 3, 10)]
    assert same[0] > 0.7 and 0.2 < same[1] < 0.6 and abs(same[2]) < 0.05


def test_pixels_larger_than_stains_show_their_mean():
    gen = torch.Generator().manual_seed(0)
    x, y = (40 * torch.rand(20_000, generator=gen).double() - 20 for _ in range(2))
    deviations = []
    for size_m in (0.0005, 0.004, 0.02, 0.1, 1.0):
        hit = stained_share(0.4, x, y, torch.full((20_000,), size_m))
        assert float(hit.mean()) == pytest.approx(0.4, abs=0.02)
        deviations.append(float(hit.std()))
    assert deviations == sorted(deviations, reverse=True) and deviations[-1] < 1e-6
    assert len(stain_levels(0.4)) == sum((STAIN_SIDE >> k) ** 2 for k in range(NUM_STAIN_LEVELS))
    assert STAIN_SIDE * STAIN_TEXEL_M > 1


# ---- Pictures ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "film",
    [
        drying(0.3),
        drying(0.12, film_wetness=0.7),
        RoadFilm(0.01, 0.01, 0.8, 0.9, 0.5, 0.4),
        RoadFilm(0.0, 0.0, 0.0, 0.9, 1.0, 0.0),
    ],
)
def test_the_kernel_darkens_as_the_definition_does(film):
    gen = torch.Generator().manual_seed(1)
    ground = cambered_map()
    ground.channels[..., 4] = torch.rand(ground.channels.shape[:2], generator=gen)
    camera = looking((-10.0, 0.3, 1.5), (0.0, 0.0, 0.3), 97, 61, 90.0)
    rays = camera.ray_directions(torch.float64)
    depth = torch.where(rays[..., 2] < -0.02, 1.5 / (-rays[..., 2]).clamp_min(1e-9), 0.0).float()
    share, _ = find_ground(camera, depth, torch.ones_like(depth), ground)
    rgb = torch.rand(61, 97, 3, generator=gen)
    arguments = (camera, depth, share, ground, drying_map(ground, 3), film, 0.6, 0.7)
    defined, defined_mirror = wet_by_film(rgb, *arguments, backend="reference")
    copies = (rgb.clone(), camera, depth, share.clone(), *arguments[3:])
    actual, mirror = wet_by_film(*copies)
    assert bool((share > 0).any()) and not torch.equal(actual, rgb)
    # Stains have edges: a pixel at one moves by float rounding of its place.
    assert float((actual - defined).abs().quantile(0.99)) < 2e-4
    assert float((mirror - defined_mirror).abs().quantile(0.99)) < 2e-4
    assert torch.equal(actual[share == 0], rgb[share == 0]) and not bool(mirror[share == 0].any())


def test_a_full_road_looks_as_rain_of_its_rate_does():
    scene, eye = street()
    plain = render_view(scene, eye, Recipe(weather=Weather(rain=Rain(rate_mm_h=5.0)), output=QUIET))
    full = RoadWater(peak_rate_mm_h=5.0, puddle_rate_mm_h=5.0, spots=1.0)
    rain = Rain(rate_mm_h=5.0, road=full)
    timed = render_view(scene, eye, Recipe(weather=Weather(rain=rain), output=QUIET))
    error = np.abs(plain.rgb.astype(int) - timed.rgb.astype(int))
    # Splats are darkened one by one, pictures by pixel: they differ where the road ends.
    assert error.mean() < 0.5 and np.quantile(error, 0.98) <= 6


def test_a_road_darkens_and_dries_to_its_bits():
    scene, eye = street()
    clean = render_view(scene, eye, Recipe(output=QUIET)).rgb
    dry = recipe(film_mm=0.0, tracks=1.0)
    assert np.array_equal(render_view(scene, eye, dry).rgb, clean)
    light = [
        render_view(scene, eye, recipe(film_mm=film_mm, tracks=1.0)).rgb[40:].mean()
        for film_mm in (0.05, 0.2, 0.35)
    ]
    assert clean[40:].mean() > light[0] > light[1] > light[2]
    spotted = render_view(scene, eye, recipe(film_mm=0.0, spots=0.5)).rgb
    assert clean[40:].mean() > spotted[40:].mean() and np.array_equal(spotted[:20], clean[:20])


def test_a_frame_alone_is_the_frame_of_the_sequence():
    scene, eye = street()
    times = (30.0, 400.0, 2500.0, 4500.0)
    in_sequence = [render_view(scene, eye, recipe_at(t)).rgb for t in times]
    for time_s, rgb in zip(times, in_sequence, strict=True):
        alone, alone_eye = street()
        assert np.array_equal(render_view(alone, alone_eye, recipe_at(time_s)).rgb, rgb)
    assert not np.array_equal(in_sequence[2], in_sequence[3])


@pytest.mark.parametrize("time_s", [0.5, 40.0, 119.9, 700.0, 950.0, 1000.0, 3000.0, 6250.0])
def test_pictures_change_gently(time_s):
    scene, eye = street()
    before, after = (
        render_view(scene, eye, recipe_at(t)).rgb.astype(int) for t in (time_s, time_s + 0.1)
    )
    quiet = np.abs(after - before)[40:]
    assert quiet.mean() < 1.5  # of 255; rings and drops of the rain move meanwhile


def test_the_ground_is_found_once_for_all_moments():
    scene, eye = street()
    ground = wet_ground(scene, 3)
    for time_s in (40.0, 600.0, 3000.0):
        render_view(scene, eye, recipe_at(time_s))
    assert wet_ground(scene, 3) is ground


# ---- Puddles, beams, spray -----------------------------------------------------------------------


def test_the_threshold_of_puddles_is_continuous_and_covers_their_share():
    order = np.sort(np.random.Generator(np.random.PCG64(0)).standard_normal(4000))
    ground = dataclasses.replace(flat_map(), sorted_puddle_order=order.astype(np.float32))
    assert ground.interpolate_puddle_threshold(0.0) == NO_PUDDLES
    shares = np.linspace(0.006, 0.9, 2000)
    thresholds = np.array([ground.interpolate_puddle_threshold(s) for s in shares])
    assert (np.diff(thresholds) < 0).all() and np.abs(np.diff(thresholds)).max() < 0.05
    for share in (0.01, 0.1, 0.3):
        covered = (order > ground.interpolate_puddle_threshold(share)).mean()
        assert covered == pytest.approx(share, abs=0.001)
        today = ground.find_puddle_threshold(share)
        assert ground.interpolate_puddle_threshold(share) == pytest.approx(today, abs=0.05)


def test_damp_asphalt_loses_less_of_a_flat_beam_than_a_film():
    cosine = np.array([0.05, 0.3, 1.0])
    reflectance = 0.1 * cosine
    dry = np.zeros(3)
    film, damp = (wet_echo_ratio(cosine, reflectance, dry, share) for share in (1.0, 0.0))
    assert (damp[:2] > film[:2]).all() and damp[2] == pytest.approx(film[2])
    assert (damp < 0.7).all()  # it stays dark


def test_spray_follows_the_film_and_outlasts_the_rain():
    plain = Rain(rate_mm_h=10.0)
    full = Rain(rate_mm_h=10.0, road=RoadWater())
    assert lifted_water_m(full) == pytest.approx(lifted_water_m(plain), rel=1e-9)
    assert lifted_water_m(plain) == film_depth_m(10.0) * plain.ground_wetness
    after = [
        lifted_water_m(Rain(rate_mm_h=0.0, road=RoadWater(film_mm=film_mm)))
        for film_mm in (0.6, 0.3, 0.05)
    ]
    assert 1e-4 < after[0] < lifted_water_m(full) and after[0] > after[1] > after[2] == 0
    first = Rain(rate_mm_h=10.0, road=RoadWater(film_mm=0.1, peak_film_mm=0.1, puddle_fill=0.0))
    assert lifted_water_m(first) == pytest.approx(lifted_water_m(plain) / 6, rel=1e-6)


def test_water_of_a_recipe_is_the_films():
    assert road_film(Rain(rate_mm_h=5.0)) is None
    film = road_film(Rain(rate_mm_h=0.0, road=RoadWater(film_mm=0.2, peak_film_mm=0.1)))
    assert film is not None and film.peak_mm == film.film_mm == 0.2 and film.film_share == 1
