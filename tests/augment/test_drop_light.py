"""Light of lamps on near drops and flakes."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from augment.effects.falling.air import Precipitation, cell_walk, compute_clear_share, find_drops
from augment.effects.falling.drop_covers import LIT_DISTANCES_M, DropsInRanges, cover_of_drops
from augment.effects.falling.shutter import STANDING
from augment.lamps.drop_light import CELL_PX, add_drop_light, cell_luminance, phase_function
from augment.lamps.lamp import Lamps
from augment.lamps.patterns import Pattern
from tests.lamp_scenes import camera_at, lamps_at


@dataclass(frozen=True)
class PlainCover:
    """Drops that cover a known share of each pixel: the definition of `DropCover.add_light`."""

    covers: np.ndarray
    """Share of each pixel that drops of each range cover, [K, H, W]."""
    distances_m: np.ndarray
    """Distance of each range."""
    is_snow: bool
    """True for flakes."""

    @property
    def size_px(self) -> tuple[int, int]:
        return self.covers.shape[1:]

    @property
    def has_drops(self) -> bool:
        return bool(self.covers.any())

    def add_light(self, picture: np.ndarray, cells: np.ndarray, step_px: int) -> None:
        height, width = self.size_px
        rows = -(-height // step_px)
        columns = -(-width // step_px)
        v = np.clip((np.arange(height) + 0.5) / step_px - 0.5, 0, rows - 1)
        u = np.clip((np.arange(width) + 0.5) / step_px - 0.5, 0, columns - 1)
        clear = np.ones((height, width))
        for cover, light in zip(self.covers, cells.astype(np.float64), strict=True):
            by_row = np.array([_lerp(light[..., :columns], y) for y in v])  # [H, 3, w]
            by_pixel = np.array([_lerp(np.moveaxis(by_row, 2, 0), x) for x in u])  # [W, H, 3]
            picture += ((clear * cover)[..., None] * by_pixel.swapaxes(0, 1)).astype(np.float32)
            clear *= 1 - cover


def _lerp(values: np.ndarray, place: float) -> np.ndarray:
    """Return what lies at a place between the rows of an array."""
    i = min(int(place), max(len(values) - 2, 0))
    beside = min(i + 1, len(values) - 1)
    return values[i] + (values[beside] - values[i]) * (place - i)


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
        PlainCover(covers, distances, is_snow),
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


@pytest.mark.parametrize("width", [160, 93, 5])
def test_drops_shine_as_their_covers_say(width: int) -> None:
    camera = camera_at(1.5, width=width, height=90, focal_px=120)
    rain = Precipitation("rain", 80.0, (2.0, 0.0), 0.0, 3, 0.01, 0.5, None)
    alpha, depth = (np.ones((90, width), np.float32), np.full((90, width), 5.0, np.float32))
    drops = find_drops(cell_walk(rain, camera, STANDING, "street"))
    cover = cover_of_drops(drops, *map(torch.from_numpy, (alpha, depth)), is_snow=False)
    assert cover.size_px == (90, width)
    covers = []
    for start, end in itertools.pairwise([0, *cover.ends]):
        part = np.ascontiguousarray(cover.drops[start:end])
        covers.append(1 - compute_clear_share(part, alpha, depth))
    assert covers[0].any()
    assert not np.any(covers[3:])  # behind the surface at 5 m
    shape = (len(LIT_DISTANCES_M), -(-90 // CELL_PX), 3, -(-width // CELL_PX) + 3)
    cells = np.random.default_rng(1).uniform(0, 5, shape).astype(np.float32)
    pictures = np.zeros((3, 90, width, 3), np.float32)
    cover.add_light(pictures[0], cells, CELL_PX)
    cover.add_light(pictures[1], cells, CELL_PX)
    PlainCover(np.array(covers), cover.distances_m, False).add_light(pictures[2], cells, CELL_PX)
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_allclose(pictures[0], pictures[2], atol=2e-6)  # float32
    empty = DropsInRanges(drops[:0], 0 * cover.ends, alpha, depth, False, LIT_DISTANCES_M)
    assert not empty.has_drops


def test_no_lamps_and_no_drops_change_nothing() -> None:
    camera = camera_at(1.5, width=32, height=32, focal_px=50)
    picture = np.full((32, 32, 3), 0.25, np.float32)
    before = picture.copy()
    nothing = PlainCover(np.zeros((1, 32, 32), np.float32), np.ones(1), False)
    some = PlainCover(np.ones((1, 32, 32), np.float32), np.ones(1), False)
    add_drop_light(picture, lamps_at([(5, 0, 2)]), camera, nothing)
    add_drop_light(picture, Lamps.none(), camera, some)
    np.testing.assert_array_equal(picture, before)
    with pytest.raises(ValueError, match="picture must be"):
        add_drop_light(picture[1:], lamps_at([(5, 0, 2)]), camera, some)
