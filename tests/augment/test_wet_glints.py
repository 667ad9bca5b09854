"""Lamps in wet ground and water: their mirrored place, energy, streaks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from augment.lamps.lamp import Lamps
from augment.lamps.patterns import Pattern
from augment.lamps.road_unevenness import water_of_road
from augment.lamps.wet_glints import add_wet_glints, fresnel_reflectance, glint_luminance
from augment.lamps.wet_surface import WetRoad, WetSurface
from augment.scene.cameras import Camera
from tests.lamp_scenes import camera_at, lamps_at, road_depth

EYE_M = 1.5
LAMP_M = 0.65


def flat_water(camera: Camera, m: float, share: float = 1.0) -> WetSurface:
    depth = road_depth(camera)
    water = np.where(depth > 0, share, 0).astype(np.float32)
    return WetSurface(water, np.full_like(water, m), depth, (0.0, 0.0, 1.0))


def glints(
    lamps: Lamps, camera: Camera, water: WetSurface | WetRoad, **options: float
) -> np.ndarray:
    picture = np.zeros((camera.height, camera.width, 3), np.float32)
    add_wet_glints(picture, lamps, camera, water, min_luminance_cd_m2=1e-6, **options)
    return picture


@pytest.mark.parametrize("y_m", [0.0, -3.0, 4.0])
@pytest.mark.parametrize("distance_m", [12.0, 30.0])
def test_mirrored_lamp_lies_on_the_mirrored_pixel(distance_m: float, y_m: float) -> None:
    camera = camera_at(EYE_M, width=600, height=400, focal_px=500)
    lamp = lamps_at([(distance_m, y_m, LAMP_M)], radius_m=0.01)
    picture = glints(lamp, camera, flat_water(camera, 0.003))[..., 1]
    row, column = np.array(np.unravel_index(picture.argmax(), picture.shape)) + 0.5
    expected_row = camera.cy + camera.fy * (EYE_M + LAMP_M) / distance_m
    expected_column = camera.cx - camera.fx * y_m / distance_m
    assert abs(row - expected_row) <= 1
    assert abs(column - expected_column) <= 1


def test_mirror_has_the_energy_of_fresnels_share() -> None:
    camera = camera_at(EYE_M, width=400, height=700, focal_px=1200, pitch_deg=18)
    distance_m = 6.0
    lamp = lamps_at([(distance_m, 0, LAMP_M)], candela=500, radius_m=0.001)
    picture = glints(lamp, camera, flat_water(camera, 0.02))[..., 1]
    slopes = camera.ray_lengths().double().numpy()
    solid_angles = 1 / (camera.fx * camera.fy * slopes**3)
    lux = float((picture * solid_angles).sum())
    path = math.hypot(distance_m, EYE_M + LAMP_M)
    cosine = (EYE_M + LAMP_M) / path
    expected = float(fresnel_reflectance(np.array([cosine]))[0]) * 500 / path**2
    # The path and Fresnel's share vary over the streak, and Smith's masking takes under 1 %.
    assert lux == pytest.approx(expected, rel=0.03)


def test_light_of_a_far_streak_does_not_depend_on_where_the_pixels_are() -> None:
    camera = camera_at(EYE_M, width=120, height=200, focal_px=500)
    water = flat_water(camera, 0.02)
    sums = [
        glints(lamps_at([(50.0, y_m, LAMP_M)], radius_m=0.01), camera, water).sum()
        for y_m in (0.0, 0.025, 0.05, 0.075)  # a quarter of a pixel apart
    ]
    assert max(sums) / min(sums) < 1.03


def test_streak_is_as_many_times_longer_than_wide_as_the_grazing_angle_says() -> None:
    camera = camera_at(EYE_M, width=800, height=500, focal_px=1500, pitch_deg=6)
    lamp = lamps_at([(30.0, 0, LAMP_M)], radius_m=0.001)
    picture = glints(lamp, camera, flat_water(camera, 0.03))[..., 1].astype(np.float64)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    total = picture.sum()
    row = (picture * rows).sum() / total
    column = (picture * columns).sum() / total
    length = math.sqrt((picture * (rows - row) ** 2).sum() / total)
    width = math.sqrt((picture * (columns - column) ** 2).sum() / total)
    # 1 / sin(4.1 degrees) = 14. The streak's upper end is cut where it nears the horizon.
    assert 10 < length / width < 16


def test_fresnel_reflectance_is_that_of_water() -> None:
    cosines = np.cos(np.radians([0, 60, 70, 75, 80, 85, 88]))
    expected = [0.020, 0.059, 0.133, 0.211, 0.347, 0.583, 0.804]
    np.testing.assert_allclose(fresnel_reflectance(cosines), expected, atol=6e-3)


@pytest.mark.parametrize("m", [0.02, 0.085, 0.15])
def test_kernel_equals_definition(m: float) -> None:
    camera = camera_at(EYE_M, width=161, height=117, focal_px=120)
    rng = np.random.default_rng(3)
    places = rng.uniform((6, -8, 0.4), (50, 8, 8), (8, 3)).tolist()
    lamps = Lamps.concatenate(
        [
            lamps_at(places[:4], candela=9000, pattern=Pattern.STREET, color=(1.3, 0.9, 0.3)),
            lamps_at(places[4:], candela=60, pattern=Pattern.REAR, color=(4.0, 0.2, 0.05)),
        ]
    )
    water = flat_water(camera, m, 0.8)
    picture = glints(lamps, camera, water, extinctions_per_m=0.02)
    expected = glint_luminance(lamps, camera, water, extinctions_per_m=0.02) @ lamps.colors
    # float32 sums; what is below the threshold is left out.
    np.testing.assert_allclose(picture, expected, rtol=1e-4, atol=1e-4)


def test_waves_break_the_mirror_as_the_definition_says() -> None:
    camera = camera_at(EYE_M, width=96, height=80, focal_px=70)
    water = flat_water(camera, 0.03)
    rng = np.random.default_rng(5)
    tilts = (0.04 * rng.standard_normal((camera.height, camera.width, 2))).astype(np.float32)
    wavy = WetSurface(water.share, water.roughness, water.depth_m, water.up, tilts)
    lamps = lamps_at([(15, 1, 3), (25, -2, 1)])
    picture = glints(lamps, camera, wavy)
    expected = glint_luminance(lamps, camera, wavy) @ lamps.colors
    np.testing.assert_allclose(picture, expected, rtol=1e-4, atol=1e-4)
    assert not np.array_equal(picture, glints(lamps, camera, water))


def test_lamps_that_face_away_leave_the_water_dark() -> None:
    camera = camera_at(EYE_M)
    away = lamps_at([(20, 0, 0.65)], (1, 0, 0), pattern=Pattern.LAMBERT)
    assert not glints(away, camera, flat_water(camera, 0.05)).any()


def test_dry_pixels_keep_their_bits() -> None:
    camera = camera_at(EYE_M)
    water = flat_water(camera, 0.1)
    share = water.share.copy()
    share[:, : camera.width // 2] = 0
    half = WetSurface(share, water.roughness, water.depth_m, water.up)
    picture = glints(lamps_at([(20, 0, 0.65)]), camera, half)
    assert not picture[:, : camera.width // 2].any()
    assert picture.any()


def test_road_shines_as_the_water_that_the_definition_puts_on_it() -> None:
    camera = camera_at(EYE_M, width=150, height=110, focal_px=220, pitch_deg=12)
    depth = road_depth(camera)
    rng = np.random.default_rng(8)
    film = np.empty((28, 38, 3), np.float32)
    film[..., 0] = rng.uniform(0.03, 0.15, film.shape[:2])
    film[..., 1] = rng.uniform(0.5, 1, film.shape[:2])
    film[..., 2] = rng.uniform(0, 0.25, film.shape[:2])
    share = np.where(depth > 0, 0.8, 0).astype(np.float32)
    slope = np.array([0.01, -0.02, 1]) / math.hypot(0.01, 0.02, 1)
    road = WetRoad(share, depth, film, (slope[0], slope[1], slope[2]))
    lamps = lamps_at([(9, 1, 5), (14, -2, 0.7)], candela=3000)
    water = water_of_road(road, camera)
    assert water.tilts is not None and water.tilts.any()
    picture = glints(lamps, camera, road)
    expected = glint_luminance(lamps, camera, water) @ lamps.colors
    # Places and lattices are in float32, which turns the finest waves by 1e-4 of their height.
    np.testing.assert_allclose(picture, expected, rtol=3e-3, atol=1e-3 * expected.max())
    assert np.abs(picture - expected).mean() < 1e-4 * expected.mean()


def test_water_without_some_pixels_keeps_the_others() -> None:
    water = flat_water(camera_at(EYE_M, width=8, height=6, focal_px=6, pitch_deg=40), 0.1, 0.7)
    pixels = np.zeros((6, 8), bool)
    pixels[3:] = True
    part = water.without(pixels)
    assert not part.share[3:].any()
    np.testing.assert_array_equal(part.share[:3], water.share[:3])


def test_images_of_other_sizes_are_refused() -> None:
    camera = camera_at(EYE_M)
    water = flat_water(camera, 0.1)
    with pytest.raises(ValueError, match="picture must be"):
        add_wet_glints(np.zeros((3, 3, 3), np.float32), lamps_at([(9, 0, 1)]), camera, water)
