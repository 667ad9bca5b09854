"""How much of what an image shows of a labelled box is snow, against boxes whose snow is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from box_views import (
    CAR_M,
    UPRIGHT,
    boxes_at_random,
    count_by_hand,
    make_boxes,
    make_camera,
    placed,
    plane_depth,
)

from augment.boxes import SIDES_M
from augment.effects.flood.effect import hidden_pixels
from augment.effects.snow.snow import snow_pixels
from augment.labels import Boxes

ALL = np.full((106, 160), 255, np.uint8)


@pytest.mark.parametrize("thickness_m", [0.0, 1e-4, 0.02, 0.3, 10.0])
def test_pixels_are_those_counted_one_by_one(thickness_m: float) -> None:
    rng = np.random.default_rng(5)
    boxes, camera = boxes_at_random(rng), make_camera(pitch=0.15)
    depth = rng.uniform(-1, 25, (106, 160)).clip(0).astype(np.float32)
    snow = np.where(rng.random((106, 160)) < 0.4, 255, 0).astype(np.uint8)
    extents = []
    for size in boxes.sizes_m:
        low, high = -size / 2 - SIDES_M, size / 2 + SIDES_M
        bottom = max(min(0.08, size[2] / 4), min(thickness_m + 0.05, size[2] * 3 / 4))
        low[2] = -size[2] / 2 + bottom
        high[2] = size[2] / 2 + max(0.10, 1.5 * thickness_m + 0.05)
        extents.append((low, high))
    got = snow_pixels(placed(boxes), camera, depth, snow, thickness_m)
    pixels, marked = count_by_hand(boxes, extents, camera, depth, snow)
    assert sum(p > 0 for p in pixels) > 30 and sum(marked) > 0
    np.testing.assert_array_equal(got.pixels, pixels)
    np.testing.assert_array_equal(got.marked, marked)


def test_boxes_without_snow_own_what_they_own_in_a_flood() -> None:
    rng = np.random.default_rng(6)
    camera, depth = make_camera(), rng.uniform(0, 25, (106, 160)).astype(np.float32)
    boxes = make_boxes(*[
        (rng.uniform((2, -8, 0), (25, 8, 2)), rng.uniform(0.4, 5, 3), rng.normal(size=4))
        for _ in range(20)
    ])  # fmt: skip
    bare = snow_pixels(placed(boxes), camera, depth, ALL, 0.0)
    flooded = hidden_pixels(placed(boxes), camera, depth, ALL)
    assert bare.pixels.sum() > 0
    np.testing.assert_array_equal(bare.pixels, flooded.pixels)


@pytest.mark.parametrize("thickness_m", [0.02, 0.1, 0.3])
def test_snow_on_the_roof_is_the_cars_and_snow_around_its_wheels_is_not(thickness_m: float) -> None:
    boxes = make_boxes(((8, 0, 0.75), CAR_M, UPRIGHT))  # from the road to 1.5 m
    high = dataclasses.replace(make_camera(pitch=0.5), camera_from_world=raised(4.0, 0.5))
    roof = plane_depth(high, 1.5 + thickness_m)
    got = snow_pixels(placed(boxes), high, roof, ALL, thickness_m)
    assert got.pixels[0] == got.marked[0] > 300
    # Drifts on the roof are half as deep again.
    drift = plane_depth(high, 1.5 + 1.5 * thickness_m)
    assert snow_pixels(placed(boxes), high, drift, ALL, thickness_m).pixels[0] > 300
    ground = plane_depth(high, thickness_m)
    assert snow_pixels(placed(boxes), high, ground, ALL, thickness_m).pixels[0] == 0


@pytest.mark.parametrize("resolution", [0.5, 1.0, 2.0])
def test_the_snowy_part_is_that_of_the_cap(resolution: float) -> None:
    """A face straight ahead, 2 m high and bare, with 40 cm of snow on it."""
    camera = dataclasses.replace(make_camera(), cx=80.0, cy=53.0).scaled(resolution)
    boxes = make_boxes(((10, 0, 1.0), (1, 2, 2), UPRIGHT))  # face at x = 9.5 m, from 0 to 2 m
    rays = camera.ray_directions(torch.float64).numpy()
    z = 1.6 + 9.5 * rays[..., 2]
    depth = np.where(z < 2.4, 9.5, 0).astype(np.float32)  # the snow's top, and sky
    snow = np.where(z > 2.0, 255, 0).astype(np.uint8)
    got = snow_pixels(placed(boxes), camera, depth, snow, 0.4)
    expected = 0.4 / (2.4 - 0.45)  # the lowest 45 cm stand in snow
    # Each edge is off by half a pixel, of the 20 that the face has at resolution 1.
    assert got.marked[0] / got.pixels[0] == pytest.approx(expected, abs=1 / 20 / resolution)


def test_a_low_box_keeps_its_top_quarter_in_any_snow() -> None:
    """A kerb stone, 40 cm high, in 10 m of snow: from 30 cm up what is seen still counts."""
    boxes = make_boxes(((8, 0, 0.2), (4, 4, 0.4), UPRIGHT))
    camera = make_camera(pitch=0.2)
    for height_m, owned in {0.29: False, 0.31: True, 1.0: True}.items():
        depth = plane_depth(camera, height_m)
        got = snow_pixels(placed(boxes), camera, depth, ALL, 10.0)
        assert (got.pixels[0] > 0) == owned, height_m


def test_boxes_of_no_number_and_no_boxes() -> None:
    camera, depth = make_camera(), np.full((106, 160), 5.0, np.float32)
    boxes = make_boxes(((np.nan, 0, 0.5), CAR_M, UPRIGHT), ((5, 0, 1.6), CAR_M, UPRIGHT))
    got = snow_pixels(placed(boxes), camera, depth, ALL, 0.1)
    assert got.pixels[0] == got.marked[0] == 0 < got.pixels[1]
    none = snow_pixels(placed(Boxes.empty()), camera, depth, ALL, 0.1)
    assert none.pixels.shape == none.marked.shape == (0,)


def raised(height_m: float, pitch: float) -> torch.Tensor:
    """camera_from_world of a camera at (0, 0, height_m), looking along +x and down by pitch."""
    pose = make_camera(pitch=pitch).camera_from_world.clone()
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0, 0, height_m], dtype=torch.float64)
    return pose
