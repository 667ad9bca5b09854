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
from augment.effects.snow.snow import snow_pixels

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


def raised(height_m: float, pitch: float) -> torch.Tensor:
    """camera_from_world of a camera at (0, 0, height_m), looking along +x and down by pitch."""
    pose = make_camera(pitch=pitch).camera_from_world.clone()
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0, 0, height_m], dtype=torch.float64)
    return pose
