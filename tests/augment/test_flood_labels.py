"""What a flood hides of labelled boxes, against counting every pixel and every millimetre."""

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

from augment.boxes import BOTTOM_M, SIDES_M
from augment.effects.flood.effect import hidden_pixels, submerged_fraction
from augment.labels import Boxes


def test_an_upright_box_is_submerged_by_its_height() -> None:
    boxes = make_boxes(((5, 0, 0.75), CAR_M, UPRIGHT))  # from 0 to 1.5 m
    levels = {-1.0: 0.0, 0.0: 0.0, 0.3: 0.2, 0.75: 0.5, 1.5: 1.0, 9.0: 1.0}
    got = [submerged_fraction(placed(boxes), level)[0] for level in levels]
    # The origin, 4e6 m away, costs 5e-10 m of the box's coordinates.
    np.testing.assert_allclose(got, list(levels.values()), atol=1e-8)


def test_turning_about_the_vertical_changes_nothing_and_tilting_does() -> None:
    half = np.sqrt(0.5)
    boxes = make_boxes(
        ((5, 0, 0.75), CAR_M, (half, 0, 0, half)),
        ((5, 0, 0.75), CAR_M, (half, half, 0, 0)),  # on its side: its 2 m stand up
        ((5, 0, 0.75), CAR_M, (np.cos(0.1), 0, np.sin(0.1), 0)),  # nose 0.2 rad down
    )
    got = submerged_fraction(placed(boxes), 0.3)
    height = 4 * np.sin(0.2) + 1.5 * np.cos(0.2)
    expected = [0.2, (0.3 - (0.75 - 1.0)) / 2, (0.3 - (0.75 - height / 2)) / height]
    np.testing.assert_allclose(got, expected, atol=1e-8)  # as above


def test_boxes_of_no_height_and_of_no_number() -> None:
    flat = ((5, 0, 0.5), (4, 2, 0), UPRIGHT)
    lost = ((np.nan, 0, 0.5), CAR_M, UPRIGHT)
    unturned = ((5, 0, 0.5), CAR_M, (0.0, 0, 0, 0))
    boxes = make_boxes(flat, lost, unturned)
    np.testing.assert_array_equal(submerged_fraction(placed(boxes), 0.6), [1, np.nan, np.nan])
    np.testing.assert_array_equal(submerged_fraction(placed(boxes), 0.4), [0, np.nan, np.nan])
    camera = make_camera()
    depth = np.full((106, 160), 5.0, np.float32)
    counted = hidden_pixels(placed(boxes), camera, depth, np.zeros((106, 160), np.uint8))
    assert counted.pixels[0] > 0  # a sign lying in the air is seen, thick by the tolerance
    assert counted.pixels[1:].tolist() == [0, 0]


def test_pixels_are_those_counted_one_by_one() -> None:
    rng = np.random.default_rng(4)
    boxes = boxes_at_random(rng)
    camera = make_camera(pitch=0.15)
    # Surfaces everywhere in the boxes' space, with holes.
    depth = rng.uniform(-1, 25, (106, 160)).clip(0).astype(np.float32)
    water = np.where(rng.random((106, 160)) < 0.4, 255, 0).astype(np.uint8)
    got = hidden_pixels(placed(boxes), camera, depth, water)
    extents = []
    for size in boxes.sizes_m:
        low, high = -size / 2 - SIDES_M, size / 2 + SIDES_M
        low[2] = -size[2] / 2 + min(BOTTOM_M, size[2] / 4)
        extents.append((low, high))
    pixels, hidden = count_by_hand(boxes, extents, camera, depth, water)
    assert sum(p > 0 for p in pixels) > 30 and sum(p == 0 for p in pixels) > 5
    assert pixels[-2] > 0  # the camera stands inside that one
    np.testing.assert_array_equal(got.pixels, pixels)
    np.testing.assert_array_equal(got.marked, hidden)


def test_the_road_under_a_car_is_not_the_car() -> None:
    """Ground inside the box's lowest centimetres, and beside it, counts for nothing."""
    camera = make_camera(pitch=0.2)
    boxes = make_boxes(((8, 0, 0.72), CAR_M, UPRIGHT))  # its bottom is 3 cm under the road
    none = np.zeros((106, 160), np.uint8)
    assert hidden_pixels(placed(boxes), camera, plane_depth(camera, 0.0), none).pixels[0] == 0
    # A bonnet or sill at 15 cm is.
    assert hidden_pixels(placed(boxes), camera, plane_depth(camera, 0.15), none).pixels[0] > 100


def test_what_stands_in_front_is_not_the_box() -> None:
    """A wall before the box shows nothing of it; the same wall within shows it."""
    camera = make_camera()
    boxes = make_boxes(((10, 0, 1.6), CAR_M, UPRIGHT))  # from 8 to 12 m
    water = np.full((106, 160), 255, np.uint8)
    wall = np.full((106, 160), 7.8, np.float32)
    assert hidden_pixels(placed(boxes), camera, wall, water).pixels[0] == 0
    seen = hidden_pixels(placed(boxes), camera, wall + np.float32(0.3), water)
    assert seen.pixels[0] == seen.marked[0] > 0


def test_a_windows_boxes_may_be_none() -> None:
    camera = make_camera()
    image = np.zeros((106, 160), np.uint8)
    counted = hidden_pixels(placed(Boxes.empty()), camera, image.astype(np.float32), image)
    assert counted.pixels.shape == counted.marked.shape == (0,)
    assert submerged_fraction(placed(Boxes.empty()), 0.0).shape == (0,)


@pytest.mark.parametrize("resolution", [0.5, 1.0, 2.0])
def test_the_hidden_part_is_that_under_the_water_line(resolution: float) -> None:
    """A box face straight ahead, under water below half its height: half of its pixels."""
    camera = dataclasses.replace(make_camera(), cx=80.0, cy=53.0).scaled(resolution)
    boxes = make_boxes(((10, 0, 1.6), (1, 2, 2), UPRIGHT))  # face at x = 9.5 m, 0.6 to 2.6 m
    depth = np.full((camera.height, camera.width), 9.5, np.float32)
    rays = camera.ray_directions(torch.float64).numpy()
    z = 1.6 + depth * rays[..., 2]
    water = np.where(z < 1.6, 255, 0).astype(np.uint8)
    counted = hidden_pixels(placed(boxes), camera, depth, water)
    assert submerged_fraction(placed(boxes), 1.6)[0] == pytest.approx(0.5, abs=1e-8)
    # Below, 1 - BOTTOM_M of the metre counts, above 1 + SIDES_M; the water line and
    # each edge are off by half a pixel, of the 21 that the face has at resolution 1.
    expected = (1 - BOTTOM_M) / (2 - BOTTOM_M + SIDES_M)
    assert counted.marked[0] / counted.pixels[0] == pytest.approx(expected, abs=1 / 21 / resolution)
