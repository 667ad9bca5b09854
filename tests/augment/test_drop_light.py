"""Light of lamps on near drops and flakes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from augment.effects.falling.air import Precipitation, cell_walk, find_drops
from augment.effects.falling.drop_covers import LIT_DISTANCES_M, cover_of_drops
from augment.effects.falling.shutter import STANDING
from augment.lamps.drop_cover import DropCover
from augment.lamps.drop_light import CELL_PX, add_drop_light, cell_luminance, phase_function
from augment.lamps.lamp import Lamps
from augment.lamps.patterns import Pattern
from tests.lamp_scenes import camera_at, lamps_at


@pytest.mark.parametrize("is_snow", [False, True])
def test_phase_function_sends_out_all_light(is_snow: bool) -> None:
    cosine = np.linspace(-1, 1, 200_001)
    total = 2 * math.pi * np.trapezoid(phase_function(cosine, is_snow=is_snow), cosine)
    assert float(total) == pytest.approx(1, abs=1e-3)


def test_drops_before_a_lamp_shine_more_than_those_lit_from_behind_the_eye() -> None:
    forward, backward = phase_function(np.array([0.98, -0.98]), is_snow=False)
    assert forward > 20 * backward
    forward, backward = phase_function(np.array([0.98, -0.98]), is_snow=True)
    assert backward > forward


@pytest.mark.parametrize("is_snow", [False, True])
def test_kernel_equals_definition(is_snow: bool) -> None:
    camera = camera_at(1.5, width=4 * CELL_PX, height=3 * CELL_PX, focal_px=50)
    lamps = Lamps.concatenate(
        [
            lamps_at([(9, 2, 8), (20, -3, 8)], candela=9000, pattern=Pattern.STREET),
            lamps_at([(0.5, 0.6, 0.65)], (1, 0, 0), candela=8000, color=(1.1, 1.0, 0.7)),
        ]
    )
    distances = np.array([1.0, 4.2])
    covers = np.zeros((2, camera.height, camera.width), np.float32)
    covers[0] = 0.3
    covers[1, :, ::2] = 0.2
    picture = np.zeros((camera.height, camera.width, 3), np.float32)
    sigma = 0.05
    add_drop_light(
        picture,
        lamps,
        camera,
        DropCover(covers, distances, is_snow),
        extinction_per_m=sigma,
        min_luminance_cd_m2=0.0,
    )
    near, far = (
        cell_luminance(lamps, camera, d, is_snow=is_snow, extinction_per_m=sigma)
        * math.exp(-sigma * d)
        for d in distances
    )
    # Even columns have drops of both ranges; between middles of cells it is linear.
    half = CELL_PX // 2
    expected = 0.3 * near + 0.7 * 0.2 * far
    corners = (expected[0, 0], expected[0, 1], expected[1, 0], expected[1, 1])
    weight = 0.5 / CELL_PX
    found = picture[half, half]
    mixed = (
        corners[0] * (1 - weight) ** 2
        + (corners[1] + corners[2]) * weight * (1 - weight)
        + corners[3] * weight**2
    )
    np.testing.assert_allclose(found, mixed, rtol=1e-5)
    assert (picture[:, 1::2] <= picture[:, ::2]).all()


def test_covers_are_those_of_the_drops_that_are_drawn() -> None:
    camera = camera_at(1.5, width=160, height=96, focal_px=120)
    rain = Precipitation("rain", 30.0, (0.0, 0.0), 0.0, 3, 0.01, 0.5, None)
    alpha, depth = (np.ones((96, 160), np.float32), np.full((96, 160), 5.0, np.float32))
    cover = _cover(rain, camera, alpha, depth)
    assert cover.covers.shape == (len(LIT_DISTANCES_M), 96, 160)
    assert cover.covers[0].any()
    assert not cover.covers[3:].any()  # behind the surface at 5 m
    assert ((cover.covers >= 0) & (cover.covers <= 1)).all()
    np.testing.assert_array_equal(cover.covers, _cover(rain, camera, alpha, depth).covers)


def _cover(rain: Precipitation, camera, alpha: np.ndarray, depth: np.ndarray) -> DropCover:
    import torch

    drops = find_drops(cell_walk(rain, camera, STANDING, "street"))
    images = torch.from_numpy(alpha), torch.from_numpy(depth)
    return cover_of_drops(drops, *images, camera, is_snow=False)


def test_no_lamps_and_no_drops_change_nothing() -> None:
    camera = camera_at(1.5, width=32, height=32, focal_px=50)
    picture = np.full((32, 32, 3), 0.25, np.float32)
    before = picture.copy()
    nothing = DropCover(np.zeros((1, 32, 32), np.float32), np.ones(1), False)
    some = DropCover(np.ones((1, 32, 32), np.float32), np.ones(1), False)
    add_drop_light(picture, lamps_at([(5, 0, 2)]), camera, nothing)
    add_drop_light(picture, Lamps.none(), camera, some)
    np.testing.assert_array_equal(picture, before)
    with pytest.raises(ValueError, match="picture must be"):
        add_drop_light(picture[1:], lamps_at([(5, 0, 2)]), camera, some)
