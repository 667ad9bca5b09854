"""Lamps that photographs show lit."""

from __future__ import annotations

import numpy as np
import pytest

from augment.lamps.lamp import LampKind
from augment.lamps.recorded_lamps import (
    SIGNAL_LUMINANCE_CD_M2,
    STOP_LUMINANCE_CD_M2,
    VehiclePixels,
    find_recorded_lamps,
    vehicle_pixels,
)
from augment.light.srgb import LUMINANCE_WEIGHTS
from tests.augment.test_vehicle_lamps import ParkedLabels, car, scene_of, straight_track
from tests.scenes import camera_ahead

GREY = (120, 122, 125)
HOUSING = (25, 25, 28)
LIT_RED = (255, 110, 90)
LIT_GREEN = (90, 250, 225)


def street_photo() -> np.ndarray:
    photo = np.empty((216, 384, 3), np.uint8)
    photo[:] = GREY
    return photo


def disc(photo: np.ndarray, row: int, column: int, color, radius: float = 2.6) -> None:
    rows, columns = np.ogrid[: photo.shape[0], : photo.shape[1]]
    photo[(rows - row) ** 2 + (columns - column) ** 2 <= radius**2] = color


def signal(photo: np.ndarray, row: int, column: int, color) -> None:
    photo[row - 14 : row + 15, column - 8 : column + 9] = HOUSING
    disc(photo, row, column, color)


def test_a_lit_brake_lamp_and_signals_of_both_colours_are_found():
    photo = street_photo()
    disc(photo, 150, 100, LIT_RED)
    signal(photo, 60, 200, LIT_RED)
    signal(photo, 60, 300, LIT_GREEN)
    vehicles = np.zeros(photo.shape[:2], bool)
    vehicles[120:200, 60:140] = True
    result = find_recorded_lamps(photo, VehiclePixels(vehicles, np.zeros_like(vehicles)))
    facts = [(lamp.kind, lamp.is_red, round(lamp.row), lamp.column) for lamp in result.lamps]
    assert facts == [
        (LampKind.SIGNAL, True, 60, 200.5),
        (LampKind.SIGNAL, False, 60, 300.5),
        (LampKind.STOP, True, 150, 100.5),
    ]
    assert result.share[150, 100] == result.share[60, 200] == 1
    assert (result.share > 0).sum() < 3 * 60  # the discs and one pixel around them
    luminance = result.luminance_cd_m2 @ np.array(LUMINANCE_WEIGHTS)
    assert luminance[150, 100] == pytest.approx(STOP_LUMINANCE_CD_M2, rel=1e-4)
    assert luminance[60, 300] == pytest.approx(SIGNAL_LUMINANCE_CD_M2, rel=1e-4)


def test_dark_lamps_paint_and_banners_are_no_lit_lamps():
    photo = street_photo()
    disc(photo, 150, 100, (190, 40, 45))  # a brake lamp that is off
    disc(photo, 60, 200, LIT_RED)  # a red spot without a housing
    signal(photo, 60, 300, LIT_GREEN)
    photo[46:57, 292:309] = GREY  # a green spot whose upper half has none
    signal(photo, 190, 30, LIT_RED)  # a reflector of a parked car
    photo[20:60, 20:80] = (255, 60, 60)  # a banner
    photo[100:110, 300:380] = (250, 70, 60)  # a stripe on a bus
    photo[160:190, 300:360] = (250, 80, 70)  # the side of a red car
    vehicles = np.zeros(photo.shape[:2], bool)
    vehicles[120:200, 60:140] = True
    vehicles[150:200, 290:370] = True
    parked = np.zeros_like(vehicles)
    parked[165:210, 5:55] = True
    result = find_recorded_lamps(photo, VehiclePixels(vehicles, parked))
    assert result.lamps == () and not result.share.any() and not result.luminance_cd_m2.any()


def test_vehicles_that_are_parked_or_hidden_by_parked_ones_are_not_searched():
    moving = car("a", straight_track(lambda s: 20 + 5 * s))
    camera = camera_ahead(320, 200, 200.0, position=(0.0, 0.0, 1.5))
    alone = vehicle_pixels(scene_of([moving]), camera).moving
    assert alone[105:125, 140:165].mean() > 0.5 and not alone[:80].any()
    scene = scene_of([moving], labels=ParkedLabels(3, "Parked"))
    pixels = vehicle_pixels(scene, camera)
    assert pixels.moving.sum() <= alone.sum() and pixels.parked.any()
    assert not (pixels.moving & pixels.parked).any()
    stopped = scene_of([moving], labels=ParkedLabels(3, "Stopped"))
    assert vehicle_pixels(stopped, camera).moving.sum() > alone.sum()
