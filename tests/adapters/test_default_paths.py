"""Paths made for scenes without cameras: along the road, above it, and past what stands in it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_scenes import gaussians_at, street

from adapters.camera_files.paths import (
    CAMERA_HEIGHT_M,
    NO_CAMERAS,
    frames_from_views,
    ground_grid,
    make_default_path,
    solid_points,
)
from adapters.world import WorldChange
from augment.files.ply import read_splats


def along_and_across(positions: np.ndarray, heading_deg: float) -> tuple[np.ndarray, np.ndarray]:
    angle = math.radians(heading_deg)
    forward = np.array([math.cos(angle), math.sin(angle)])
    left = np.array([-forward[1], forward[0]])
    return positions[:, :2] @ forward, positions[:, :2] @ left


@pytest.mark.parametrize(("heading_deg", "slope"), [(0.0, 0.0), (30.0, 0.05), (117.0, -0.05)])
def test_drive_follows_the_road(heading_deg: float, slope: float) -> None:
    path = make_default_path(street(heading_deg=heading_deg, slope=slope), is_metric=True)
    front = [v for v in path.views if v.camera == "front"]
    assert [v.frame for v in front] == list(range(len(front)))
    assert {v.camera for v in path.views} == {"front", "left", "right"}
    eyes = np.stack([v.world_from_camera[:3, 3] for v in front])
    along, across = along_and_across(eyes, heading_deg)
    assert np.ptp(along) > 30  # of 60 m of road, 30 % are left ahead
    # In the free part of the road: cars stand at -4 to -2 m, the wall at 4 m, a car is 2.5 m wide.
    assert across.min() > -1.5 and across.max() < 3.5
    # The ground is a low quantile within cells of 1 m: half a metre of slope off, and smoothed.
    np.testing.assert_allclose(eyes[:, 2] - slope * along, CAMERA_HEIGHT_M, atol=0.35)
    ahead = front[0].world_from_camera[:2, 2]
    angle = math.radians(heading_deg)
    assert abs(ahead @ [math.cos(angle), math.sin(angle)]) > math.cos(math.radians(6))
    assert path.ground_z_m == pytest.approx(min(0, slope * along.max()), abs=0.6)
    assert path.note.startswith(NO_CAMERAS) and "straight drive" in path.note


def test_a_scene_of_any_extent_gets_a_drive_of_a_kilometre_at_most(ends_soon) -> None:
    for size in (500.0, 4e3, 1e7):
        ground = torch.rand(5000, 3, generator=torch.Generator().manual_seed(1))
        ground = gaussians_at(ground * torch.tensor([size, 0.5 * size, 0.4]))
        path = make_default_path(replace(ground, scales=ground.scales + size / 500), is_metric=True)
        positions = np.array([v.world_from_camera[:3, 3] for v in path.views])
        extent = np.ptp(positions[:, :2], axis=0)
        assert 300 < np.hypot(*extent) <= 1000.1
        assert (positions[:, :2] >= 0).all() and (positions[:, :2] <= [size, size / 2]).all()


def test_what_floats_far_away_does_not_move_the_drive() -> None:
    rng = torch.Generator().manual_seed(4)
    road = street(heading_deg=0)
    far = 900 + 300 * torch.rand(len(road) // 4, 3, generator=rng)
    alone = make_default_path(road, is_metric=True)
    path = make_default_path(gaussians_at(torch.cat([road.means, far])), is_metric=True)
    for one, other in zip(alone.views, path.views, strict=True):
        np.testing.assert_array_equal(one.world_from_camera, other.world_from_camera)


def test_a_road_above_its_foundations_is_driven_on() -> None:
    """Layers some decimetres below a road, as foundations and floaters leave them."""
    road = street(heading_deg=0)
    rng = torch.Generator().manual_seed(6)
    low = torch.rand(2000, 3, generator=rng) * torch.tensor([60.0, 8, 0.15])
    low += torch.tensor([0.0, -4, -0.45])
    path = make_default_path(gaussians_at(torch.cat([road.means, low])), is_metric=True)
    eyes = np.stack([view.world_from_camera[:3, 3] for view in path.views])
    np.testing.assert_allclose(eyes[:, 2], CAMERA_HEIGHT_M, atol=0.05)
    assert path.ground_z_m == pytest.approx(0, abs=0.05)


def test_drive_ends_with_scene_ahead() -> None:
    gaussians = street(heading_deg=0)
    path = make_default_path(gaussians, is_metric=True)
    last = [v for v in path.views if v.camera == "front"][-1].world_from_camera
    ahead = (gaussians.means[:, :2].numpy() - last[:2, 3]) @ last[:2, 2]
    assert ahead.max() > 15


def test_what_blocks_the_road_is_avoided() -> None:
    """A truck across two thirds of the road: the line passes on the free side or stops before."""
    rng = torch.Generator().manual_seed(1)
    low, high = torch.tensor([25.0, -4.0, 0.0]), torch.tensor([33.0, 1.0, 3.0])
    truck = low + (high - low) * torch.rand(3000, 3, generator=rng)
    road = street(heading_deg=0)
    path = make_default_path(gaussians_at(torch.cat([road.means, truck])), is_metric=True)
    eyes = np.stack([v.world_from_camera[:3, 3] for v in path.views])
    inside = (eyes[:, 0] > 25) & (eyes[:, 0] < 33) & (eyes[:, 1] < 1)
    assert not inside.any()


@pytest.mark.parametrize("is_metric", [True, False])
def test_an_object_is_orbited(is_metric: bool) -> None:
    rng = torch.Generator().manual_seed(2)
    ball = torch.nn.functional.normalize(torch.randn(500, 3, generator=rng), dim=1) + 5.0
    path = make_default_path(gaussians_at(ball), is_metric=is_metric)
    assert "orbit of 48 frames" in path.note
    assert ("METRES_PER_UNIT" in path.note) is not is_metric
    for view in path.views:
        pose = view.world_from_camera
        towards = np.array([5.0, 5, 5]) - pose[:3, 3]
        assert pose[:3, 2] @ towards / np.linalg.norm(towards) > 0.99
        # All of the unit ball is in view: its angle from the axis is within half the image height.
        assert math.asin(1 / np.linalg.norm(towards)) < math.atan(view.height / 2 / view.fy)


def test_kinds_can_be_insisted_on() -> None:
    assert "orbit" in make_default_path(street(), is_metric=True, kind="orbit").note
    assert "orbit" in make_default_path(street(), is_metric=False).note
    assert "drive" in make_default_path(street(), is_metric=False, kind="drive").note


@pytest.mark.parametrize("kind", ["auto", "drive", "orbit"])
@pytest.mark.parametrize("count", [1, 2, 40])
def test_degenerate_scenes_get_a_path(kind, count: int) -> None:
    """One Gaussian, or many in one place: no division by their extent."""
    made = make_default_path(gaussians_at(torch.ones(count, 3)), is_metric=True, kind=kind)
    assert frames_from_views(made.views, WorldChange())[0] and made.note.startswith(NO_CAMERAS)


def test_real_tiles_are_driven(shared_dir: Path) -> None:
    """30 m tiles of a street, so blurred that nothing is free: a drive nonetheless, inside them."""
    for tile in sorted((shared_dir / "data" / "splats").glob("*.splat")):
        gaussians = read_splats(tile).gaussians
        path = make_default_path(gaussians, is_metric=True)
        assert "straight drive" in path.note
        eyes = np.stack([v.world_from_camera[:3, 3] for v in path.views])
        assert np.ptp(eyes[:, :2], axis=0).max() > 8
        low, high = np.quantile(gaussians.means.numpy(), [0.005, 0.995], axis=0)
        assert (eyes > low).all() and (eyes < high).all()
        above = eyes[:, 2] - ground_grid(solid_points(gaussians), cell=1.0).at(eyes)
        # Their ground jumps by metres from cell to cell; the path is smoothed, so only on average.
        assert np.nanmedian(above) == pytest.approx(CAMERA_HEIGHT_M, abs=0.8)
