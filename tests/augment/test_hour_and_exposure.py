"""The hour, the camera's exposure and glare: numbers that a light meter would show."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from augment.effects.lamps.exposure import (
    MAX_BALANCE,
    READ_NOISE,
    ROAD_TARGET,
    auto_exposure,
    electrons_per_cd_m2,
    fixed_exposure,
    response,
    white_balance,
)
from augment.effects.lamps.glare import (
    NARROW_SHARE,
    WIDE_SHARE,
    spread_glare,
    tail_levels,
    widen_glare,
)
from augment.effects.lamps.hour import night_sky
from augment.effects.lamps.picture_light import (
    develop,
    find_reflectance,
    find_surfaces,
    halve_excess,
    relight,
)
from augment.lamps.lamp import color_of_temperature
from augment.light.srgb import LUMINANCE_WEIGHTS, display_from_linear, linear_from_display
from augment.render.sensor import draw_noise
from recipes.light import Light
from tests.scenes import camera_ahead

NIGHT = Light(time="night")
RNG = np.random.default_rng(7)
PICTURE = RNG.uniform(-0.1, 1.3, (37, 61, 3)).astype(np.float32)
ADDED = (RNG.uniform(0, 1, (37, 61, 3)) ** 12 * 1e4).astype(np.float32)


def code_of(light: np.ndarray) -> np.ndarray:
    return display_from_linear(light.astype(np.float64)).astype(np.float32)


def glare_of(light: np.ndarray, focal_px: float, strength: float = 1.0) -> np.ndarray:
    excess = halve_excess(code_of(light))
    assert excess is not None
    height, width = light.shape[:2]
    half = spread_glare(excess, max(width, height), focal_px, strength)
    return widen_glare(half, width, height)


def test_a_pixel_counts_39_electrons_at_one_candela_a_square_metre() -> None:
    # f/2, 10 ms, 3 um, quantum efficiency 0.6: half an electron for the rounding of the text
    assert electrons_per_cd_m2(10.0, 2.0) == pytest.approx(39.0, abs=0.5)


def test_a_stop_more_light_doubles_the_exposure() -> None:
    base = fixed_exposure(Light(time="night", exposure="fixed", exposure_ms=10, iso=400))
    for fields in ({"exposure_ms": 20}, {"iso": 800}, {"f_number": math.sqrt(2)}):
        light = Light(
            **{"time": "night", "exposure": "fixed", "exposure_ms": 10, "iso": 400} | fields
        )
        assert fixed_exposure(light).scale == pytest.approx(2 * base.scale)


def test_auto_exposure_shows_a_road_alike_until_its_limits() -> None:
    for road_cd_m2 in (0.5, 2.0, 1000.0):
        exposure = auto_exposure(NIGHT, road_cd_m2)
        assert exposure.scale * road_cd_m2 == pytest.approx(ROAD_TARGET)
    limit = fixed_exposure(NIGHT)
    assert auto_exposure(NIGHT, 1e-4).scale == limit.scale
    assert auto_exposure(NIGHT, 0.0).scale == limit.scale
    # ISO 100 is the lowest: brighter scenes shorten the time, and each pixel counts fewer
    assert auto_exposure(NIGHT, 1000.0).electrons < limit.electrons


def test_the_response_is_straight_in_shadows_and_never_clips() -> None:
    levels = np.linspace(0, 6, 1000)
    curve = response(levels)
    assert np.array_equal(curve[levels < 0.6], levels[levels < 0.6])
    assert (np.diff(curve) > 0).all() and curve[-1] < 1


@pytest.mark.parametrize("time", ["dusk", "night"])
@pytest.mark.parametrize("glow", [0.0, 5.0])
def test_the_sky_lights_level_ground_with_pi_times_its_mean(time: str, glow: float) -> None:
    light = Light(time=time, glow=glow)
    mean_cd_m2 = light.sky_luminance
    assert mean_cd_m2 is not None
    sky = night_sky(light, mean_cd_m2, 0.5)
    angles = np.radians(np.arange(0.05, 90, 0.1))
    rays = np.stack([np.cos(angles), np.zeros_like(angles), np.sin(angles)], 1)
    rgb = sky.sample(torch.from_numpy(rays.astype(np.float32))).double().numpy()
    # code of white is 0.5 of linear light
    luminance = linear_from_display(rgb) @ [0.2126, 0.7152, 0.0722] / 0.5 * mean_cd_m2
    weights = np.sin(angles) * np.cos(angles)
    lux = 2 * math.pi * (luminance * weights).sum() * math.radians(0.1)
    assert lux == pytest.approx(math.pi * mean_cd_m2, rel=0.01)
    assert luminance[0] / luminance[-1] == pytest.approx(1 + glow, rel=0.02)


def test_lens_scatters_its_share_of_a_lamps_light() -> None:
    light = np.zeros((401, 601, 3), np.float32)
    light[200, 300] = 1e5 + 1
    glare = glare_of(light, 1200.0)
    shares = tail_levels(1200.0, 601)
    # the widest Gaussians reach beyond the picture
    inside = glare.astype(np.float64).sum((0, 1)) / 1e5
    assert inside == pytest.approx(np.full(3, sum(shares)), rel=0.2)
    narrow = glare_of(light, 120.0)
    assert (glare >= 0).all() and (narrow >= 0).all()


def test_tails_of_the_point_spread_function_have_their_share_of_the_light() -> None:
    big = np.zeros((1024, 1024, 3), np.float32)  # no tail reaches beyond it
    big[512, 512] = 1e6 + 1
    glare = glare_of(big, 4000.0)
    tails = glare.astype(np.float64).sum((0, 1)) / 1e6
    share = sum(tail_levels(4000.0, 1024))
    # measured: 1e-6, of float32 in the display code and the blurs
    assert tails == pytest.approx(np.full(3, share), rel=1e-5)
    # the core keeps what both tails have within their first octave
    assert 0.5 * (NARROW_SHARE + WIDE_SHARE) < share < NARROW_SHARE + WIDE_SHARE


def test_glare_falls_off_and_knows_no_direction() -> None:
    light = np.zeros((512, 512, 3), np.float32)
    light[255:257, 255:257] = 1e5
    glare = glare_of(light, 1200.0)
    green = glare[..., 1]
    profile = green[256, 256:500]
    assert (np.diff(profile) <= 1e-6 * profile[:-1]).all()
    assert np.allclose(green, green[::-1], rtol=1e-4, atol=1e-3)
    assert np.allclose(green, green.T, rtol=1e-4, atol=1e-3)


def test_pictures_below_saturation_have_no_glare() -> None:
    assert halve_excess(np.ones((9, 9, 3), np.float32)) is None
    assert not glare_of(np.full((9, 9, 3), 9, np.float32), 500.0, 0.0).any()


def test_kernels_equal_their_definitions() -> None:
    for added, gain, min_added in ((ADDED, 0.03, -1.0), (ADDED, 1.0, 3e-5), (None, 0.5, -1.0)):
        out, mask = relight(PICTURE, added, gain, 2e-3, min_added)
        expected, expected_mask = relight(PICTURE, added, gain, 2e-3, min_added, uses_kernels=False)
        assert np.allclose(out, expected, rtol=1e-4, atol=1e-5)
        assert np.array_equal(mask, expected_mask)
    codes = code_of(ADDED[..., ::-1])
    halves = [halve_excess(codes, uses_kernels=uses) for uses in (True, False)]
    assert halves[0] is not None and halves[1] is not None
    assert np.allclose(*halves, rtol=1e-4, atol=1e-4)  # light about 1 is 1e-5 off, and loses 1
    share = RNG.uniform(0, 1, PICTURE.shape[:2]).astype(np.float32)
    for fog in (None, share):
        numbers = (PICTURE, 0.6, fog, (0.7, 0.75, 0.8))
        assert np.allclose(
            find_reflectance(*numbers), find_reflectance(*numbers, uses_kernels=False), atol=1e-5
        )
    alpha = RNG.choice(np.array([0, 0.01, 0.5, 1], np.float32), (9, 17))
    z = RNG.choice(np.array([0, 3, np.inf, np.nan], np.float32), (9, 17))
    surfaces = [find_surfaces(alpha, z, uses_kernels=uses) for uses in (True, False)]
    np.testing.assert_array_equal(*surfaces)
    light = ADDED[:, :, ::-1] * np.float32(1e-3)
    draws = RNG.integers(0, 256, light.shape, np.uint8)
    for glare, levels in ((None, None), (light[:19, :31] * np.float32(0.1), draws)):
        numbers = (code_of(light), glare, levels, 300.0, READ_NOISE, 1.0)
        for balance in (None, np.array([0.8, 1.0, 2.1])):
            out, expected = (
                develop(*numbers, balance=balance, uses_kernels=uses) for uses in (True, False)
            )
            assert np.allclose(out, expected, atol=1e-4)


def test_pixels_that_get_no_light_keep_their_bits() -> None:
    added = ADDED.copy()
    added[:20] = 1e-3
    out, mask = relight(PICTURE, added, 1.0, 1e-3, 3e-5)
    assert np.array_equal(out[:20], PICTURE[:20]) and not mask[:20].any()
    assert (out[20:] >= PICTURE[20:] - 1e-5).all() and (out[20:] != PICTURE[20:]).any()


def test_noise_is_that_of_the_electrons() -> None:
    camera = camera_ahead(400, 300)
    draws = draw_noise(camera, seed=3, scene="s")
    light = np.full((300, 400, 3), 0.2, np.float32)
    electrons = 500.0
    noisy, quiet = (
        linear_from_display(develop(code_of(light), None, levels, electrons, READ_NOISE, 1.0))
        for levels in (draws, None)
    )
    sigma = math.sqrt(0.2 / electrons + (READ_NOISE / electrons) ** 2)
    # demosaicing leaves about three quarters of it
    assert (noisy - quiet).std() == pytest.approx(0.77 * sigma, rel=0.05)
    assert (noisy - quiet).mean() == pytest.approx(0, abs=0.02 * sigma)


def test_overexposed_red_lamps_are_pink_in_the_middle() -> None:
    light = np.zeros((1, 3, 3), np.float32)
    light[0, :, 0] = [0.9, 5.0, 5000.0]
    out = develop(code_of(light), None, None, 1000.0, READ_NOISE, 0.0)
    assert out[0, 0, 1] == 0 and 0.3 < out[0, 1, 1] < 0.6
    assert 0.6 < out[0, 2, 1] < 0.8


def test_white_balance_makes_the_road_grey_as_far_as_asked() -> None:
    warm = color_of_temperature(4000.0)
    weights = np.asarray(LUMINANCE_WEIGHTS)
    for share in (0.0, 0.5, 1.0):
        balanced = 7.0 * warm * white_balance(7.0 * warm, share)
        assert balanced @ weights == pytest.approx(7.0 * (warm @ weights))
        ratio = (warm[0] / warm[2]) ** (1 - share)
        assert balanced[0] / balanced[2] == pytest.approx(ratio)
    out = develop(
        code_of(np.tile(0.2 * warm, (4, 4, 1))),
        None,
        None,
        1000.0,
        READ_NOISE,
        0.0,
        balance=white_balance(warm, 1.0),
    )
    assert np.ptp(out) < 1e-3
    assert (white_balance(np.array([1.0, 0.5, 0.0]), 1.0) <= MAX_BALANCE).all()
