"""Lamps in a picture: energy over their pixels, and what hides them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from augment.lamps.emitters import (
    HALO_RADIUS_M,
    add_emitters,
    illuminance_at_camera,
    lamp_visibility,
)
from augment.lamps.fog_phase import AirExtinction
from augment.lamps.lamp import Lamps
from augment.lamps.patterns import Pattern
from tests.augment.test_air_light import FOG, camera, lamp, sky


def solid_angles(view) -> np.ndarray:
    """Return the solid angle of each pixel, sr."""
    lengths = view.ray_lengths().double().numpy()
    return 1 / (view.fx * view.fy * lengths**3)


def draw(lamps, view, air, visibility=None) -> np.ndarray:
    """Return a black picture with the lamps in it."""
    picture = np.zeros((view.height, view.width, 3), np.float32)
    add_emitters(
        picture, lamps, view, np.ones(len(lamps)) if visibility is None else visibility, air
    )
    return picture


@pytest.mark.parametrize("distance", [2.0, 10.0, 50.0, 200.0])
@pytest.mark.parametrize("aside", [0.0, 0.213])
def test_energy_over_the_pixels_is_the_illuminance(distance, aside):
    view = camera(focal_px=900.0)
    position = np.array([aside * 0.3, 0.03 * aside, 1.0]) * distance
    length = float(np.linalg.norm(position))
    picture = draw(lamp(tuple(position)), view, FOG)
    energy = (picture[..., 1] * solid_angles(view)).sum()
    assert energy == pytest.approx(1000 * math.exp(-0.02 * length) / length**2, rel=0.01)


def test_near_lamp_is_a_disc_of_its_own_luminance():
    view = camera(focal_px=900.0)
    picture = draw(lamp((0.0, 0.0, 2.0)), view, AirExtinction())[..., 1]
    # 1,000 cd on a disc of radius 0.05 m.
    assert picture.max() == pytest.approx(1000 / (math.pi * 0.05**2), rel=0.02)
    radius_px = math.sqrt((picture > picture.max() / 2).sum() / math.pi)
    assert radius_px == pytest.approx(0.05 / 2 * 900, rel=0.02)


def test_energy_does_not_depend_on_the_place_between_pixels():
    view = camera(focal_px=900.0)
    energies = [
        (draw(lamp((x, 0.0, 150.0)), view, FOG)[..., 1] * solid_angles(view)).sum()
        for x in np.linspace(0, 0.17, 8)
    ]
    assert np.ptp(energies) < 1e-4 * np.mean(energies)


def test_pattern_decides_what_a_camera_sees():
    view = camera()
    towards = lamp((0.0, 0.0, 30.0), Pattern.REAR)
    away = lamp((0.0, 0.0, 30.0), Pattern.REAR, axis=(0.0, 0.0, 1.0))
    assert illuminance_at_camera(towards, view, AirExtinction())[0] == pytest.approx(1000 / 900)
    assert not draw(away, view, AirExtinction()).any()
    behind = lamp((0.0, 0.0, -30.0), Pattern.ISOTROPIC)
    assert not draw(behind, view, AirExtinction()).any()


def test_surfaces_before_a_lamp_hide_it_by_their_alpha_and_place():
    view = camera(focal_px=900.0)
    lamps = Lamps.concatenate([lamp((0.0, 0.0, 10.0)), lamp((0.0, 0.0, 500.0))])
    alpha = np.ones((view.height, view.width), np.float32)
    depth = sky(view)
    assert lamp_visibility(lamps, view, depth, alpha).tolist() == [1.0, 1.0]
    depth[:, : int(view.cx)] = 5.0
    # The far lamp is smaller than a pixel, and the near one is tested at 32 points.
    near, far = lamp_visibility(lamps, view, depth, alpha)
    assert near == pytest.approx(0.5, abs=0.13)
    assert far == 1
    halo = lamp_visibility(lamps, view, depth, alpha, radius_m=HALO_RADIUS_M)
    assert halo[0] == pytest.approx(0.5, abs=0.05)
    depth[:] = 5.0
    assert lamp_visibility(lamps, view, depth, 0.25 * alpha) == pytest.approx([0.75, 0.75])
    # Its own vehicle's surface, a hand's width before it, does not hide a lamp.
    depth[:] = 9.7
    assert lamp_visibility(lamps, view, depth, alpha).tolist() == [1.0, 0.0]
    outside = lamp((30.0, 0.0, 10.0))
    assert lamp_visibility(outside, view, depth, alpha).tolist() == [1.0]


def test_wrong_shapes_are_refused():
    view = camera()
    source = lamp((0.0, 0.0, 9.0))
    depth = sky(view)
    with pytest.raises(ValueError, match=r"depth_m and alpha must be \[107, 161\]"):
        lamp_visibility(source, view, depth[:5], depth[:5])
    with pytest.raises(ValueError, match=r"visibility must be \[1\]; got \[2\]"):
        draw(source, view, FOG, np.ones(2))
    with pytest.raises(ValueError, match=r"picture must be float32 \[107, 161, 3\]"):
        add_emitters(np.zeros((5, 161, 3), np.float32), source, view, np.ones(1), FOG)
