"""How much of boxes' light comes through smog, against distances and integrals worked by hand."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from batch_scenes import ORIGIN_M
from box_views import CAR_M, UPRIGHT, boxes_at_random, make_boxes, make_camera, placed

from augment.boxes import BOTTOM_M, NOT_COUNTED, SIDES_M
from augment.effects.smog import box_transmittance
from augment.geometry import rotmat_from_quat
from augment.labels import Boxes
from augment.render.fog import Fog, optical_depth, optical_depth_of_arrays

GREY = (0.7, 0.7, 0.7)
THICK = Fog(0.05, GREY)
LAYERED = Fog(0.08, GREY, scale_height_m=3.0, base_z_m=-0.5)
SHAPE = (106, 160)
POINT_M = (1e-6, 1e-6, 1e-6)
EYE_Z_M = 1.6


def wall(depth_m: float) -> np.ndarray:
    return np.full(SHAPE, depth_m, np.float32)


def measure(boxes: Boxes, medium=THICK, depth_m=None, camera=None, **options):
    return box_transmittance(placed(boxes), camera or make_camera(), medium, depth_m, **options)


def test_a_box_at_a_known_distance() -> None:
    """Exactly, without pixels; with them, by the depth that they show."""
    boxes = make_boxes(((40, 0, EYE_Z_M), POINT_M, UPRIGHT), ((0, 30, EYE_Z_M), POINT_M, UPRIGHT))
    got = measure(boxes)
    # The origin, 4e6 m away, costs 5e-10 m of the box's coordinates.
    np.testing.assert_allclose(got.transmittance, [math.exp(-2), math.exp(-1.5)], rtol=1e-8)
    assert got.pixels.tolist() == [NOT_COUNTED] * 2
    far_off = measure(boxes, depth_m=wall(20))
    np.testing.assert_array_equal(far_off.transmittance, got.transmittance)
    assert far_off.pixels.tolist() == [0, 0]
    seen = measure(make_boxes(((40, 0, EYE_Z_M), CAR_M, UPRIGHT)), depth_m=wall(38))
    assert seen.pixels[0] > 20
    # 4 m of width at 38 m: rays are longer than their depth by 2 cm at most, a thousandth of tau.
    assert seen.transmittance[0] == pytest.approx(math.exp(-0.05 * 38), rel=2e-3)
    assert seen.transmittance[0] < math.exp(-0.05 * 38)


@pytest.mark.parametrize("medium", [THICK, LAYERED])
def test_the_mean_is_that_over_the_pixels_that_show_the_box(medium: Fog) -> None:
    """Every pixel by hand, by the definition that images are fogged with."""
    rng = np.random.default_rng(4)
    boxes, camera = boxes_at_random(rng), make_camera(pitch=0.15)
    depth = rng.uniform(-1, 25, SHAPE).clip(0).astype(np.float32)
    got = measure(boxes, medium, depth, camera)
    rays = camera.ray_directions(torch.float64)
    z = torch.from_numpy(depth).double()
    distance, height = z * rays.norm(dim=-1), EYE_Z_M + z * rays[..., 2]
    through = torch.exp(-optical_depth(medium, distance, EYE_Z_M, height)).numpy()
    for k, size in enumerate(boxes.sizes_m):
        low, high = -size / 2 - SIDES_M, size / 2 + SIDES_M
        low[2] = -size[2] / 2 + min(BOTTOM_M, size[2] / 4)
        rotation = rotmat_from_quat(torch.from_numpy(boxes.quats[k])).numpy()
        points = camera.centre.numpy() + depth[..., None].astype(np.float64) * rays.numpy()
        along = (points - (boxes.centers_m[k] - ORIGIN_M)) @ rotation
        shows = ((along >= low) & (along <= high)).all(axis=-1) & (depth > 0)
        assert got.pixels[k] == shows.sum()
        if shows.any():
            assert got.transmittance[k] == pytest.approx(through[shows].mean(), rel=1e-12)
            continue
        signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        corners = (signs * size) @ rotation.T + boxes.centers_m[k] - ORIGIN_M
        points = np.concatenate([corners, boxes.centers_m[k : k + 1] - ORIGIN_M])
        distance = np.linalg.norm(points - camera.centre.numpy(), axis=1)
        tau = optical_depth(
            medium, torch.from_numpy(distance), EYE_Z_M, torch.from_numpy(points[:, 2].copy())
        )
        # The origin costs 5e-10 m, as above.
        assert got.transmittance[k] == pytest.approx(torch.exp(-tau).mean().item(), rel=1e-8)
    assert (got.pixels > 0).sum() > 30 and (got.pixels == 0).sum() > 5


@pytest.mark.parametrize("medium", [THICK, LAYERED, Fog(100.0, GREY, 0.1, -50.0)])
def test_the_optical_depth_is_that_of_the_image(medium: Fog) -> None:
    rng = np.random.default_rng(1)
    distance, z = rng.uniform(0, 300, 500), rng.uniform(-20, 80, 500)
    z[:3] = EYE_Z_M, EYE_Z_M + 1e-9, EYE_Z_M - 3e-5
    got = optical_depth_of_arrays(medium, distance, EYE_Z_M, z)
    tensors = torch.from_numpy(distance), torch.from_numpy(z)
    expected = optical_depth(medium, tensors[0], EYE_Z_M, tensors[1]).numpy()
    # The image's takes a straight line below 1e-4, which float32 does not tell from the curve.
    np.testing.assert_allclose(got, expected, rtol=2e-9)


def test_boxes_behind_the_camera_around_it_and_of_no_number() -> None:
    behind = ((-20, 0, EYE_Z_M), CAR_M, UPRIGHT)
    ahead = ((20, 0, EYE_Z_M), CAR_M, UPRIGHT)
    around = ((0, 0, EYE_Z_M), (4, 4, 4), UPRIGHT)
    lost, unturned = ((np.nan, 0, 0), CAR_M, UPRIGHT), ((5, 0, 0.5), CAR_M, (0.0, 0, 0, 0))
    empty = np.zeros(SHAPE, np.float32)  # nothing but sky
    for medium in (THICK, LAYERED, None):
        got = measure(make_boxes(behind, ahead, around, lost, unturned), medium, empty)
        t = got.transmittance
        assert t[0] == pytest.approx(t[1], rel=1e-8) and t[1] <= t[2] <= 1
        assert np.isnan(t[3:]).all() and np.isfinite(t[:3]).all()
        assert (got.pixels <= 0).all()


def test_denser_smog_lets_less_through_and_none_all() -> None:
    boxes, camera = boxes_at_random(np.random.default_rng(7)), make_camera(pitch=0.1)
    depth = np.random.default_rng(8).uniform(0, 20, SHAPE).astype(np.float32)
    for medium in (THICK, LAYERED):
        densities = [0.0, 1e-9, 1e-3, 0.02, 0.5, 10.0, 1e4]
        media = [dataclasses.replace(medium, sigma_per_m=sigma) for sigma in densities]
        rows = np.stack([measure(boxes, m, depth, camera).transmittance for m in media])
        assert (rows[0] == 1).all() and (np.diff(rows, axis=0) <= 0).all()
        assert (rows >= 0).all() and (rows[-1] < 0.2).all()  # a pixel of a box around the eye
        assert (np.diff(rows[2:5], axis=0) < 0).all()
    clear = measure(boxes, None, depth, camera)
    assert (clear.transmittance == 1).all() and (clear.pixels == NOT_COUNTED).all()


def test_smog_is_in_the_air_alone_for_an_eye_in_the_water() -> None:
    """As images show it: from above, water does not change the smog before what lies in it."""
    boxes = make_boxes(((10, 0, 0.5), (2, 2, 0.4), UPRIGHT), ((10, 0, 4.5), (2, 2, 0.4), UPRIGHT))
    for depth in (None, wall(10)):
        dry, below, above = (
            measure(boxes, depth_m=depth, water_level_z_m=level) for level in (None, 2.0, 1.5)
        )
        np.testing.assert_array_equal(above.transmittance, dry.transmittance)
        assert below.transmittance[0] == 1 and below.transmittance[1] == dry.transmittance[1]
