"""The depth of rendered surfels is that of the surface that their returns are on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from adapters.lidar_scene.split import PointSet
from adapters.lidar_scene.surfels import (
    gaussians_from_surfels,
    set_back,
    surfels_from_points,
    thin_points,
)
from augment.render.buffers import ALPHA, MEDIAN_DEPTH
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians
from augment.scene.semantics import SemanticClass as Class

EYE = np.array([0.0, 0.0, 1.6])
EDGE_M = 0.05
NOISE_M = 0.02  # standard deviation of a return along the normal, as of PandaSet's sweeps together


def noisy(surface, semantic, seed=0):
    """Thinned returns of many sweeps on a wall 10 m ahead, or on the ground from 6 to 14 m."""
    rng = np.random.default_rng(seed)
    count = 120_000
    a = rng.uniform(-2, 2, count)
    if surface == "wall":
        points = np.stack([10 + rng.normal(0, NOISE_M, count), a, rng.uniform(0, 3, count)], 1)
    else:
        points = np.stack([rng.uniform(6, 14, count), a, rng.normal(0, NOISE_M, count)], 1)
    classes = np.full(count, semantic, np.int16)
    return thin_points(
        PointSet(points.astype(np.float32), classes), np.zeros((1, 3)), voxel_m=EDGE_M
    )


def camera():
    """A camera at EYE that looks along x."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = EYE
    lens = {"fx": 900.0, "fy": 900.0, "cx": 160.0, "cy": 100.0}
    return Camera(
        "front", 320, 320, **lens, camera_from_world=torch.from_numpy(np.linalg.inv(pose))
    )


def depth_error(points, surfels):
    """Error of the rendered depth over the pixels that show the surface, metres."""
    grey = np.full((len(points), 3), 0.5, np.float32)
    gaussians = gaussians_from_surfels(surfels, grey, points.semantic)
    view = camera()
    raster = rasterize([PosedGaussians(gaussians)], view, buffers=(ALPHA, MEDIAN_DEPTH))
    depth = raster.median_depth.numpy()
    rays = view.ray_directions(torch.float64).numpy()
    if points.semantic[0] == Class.ROAD:
        true = EYE[2] / np.maximum(-rays[..., 2], 1e-9)
        counts = (true > 8) & (true < 12)
    else:
        true = np.full(depth.shape, 10.0)
        counts = np.abs(rays[..., 2] * 10 + EYE[2] - 1.5) < 1
    counts &= (np.abs(rays[..., 1]) * true < 1.5) & (raster.alpha.numpy() > 0.9)
    assert counts.sum() > 5000
    return (depth - true)[counts]


def test_settled_points_are_nearer_to_the_surface_than_the_returns():
    points, edge_m = noisy("wall", Class.BUILDING)
    surfels = surfels_from_points(points.points, edge_m, semantic=points.semantic)
    inner = (np.abs(points.points[:, 1]) < 1.8) & (np.abs(points.points[:, 2] - 1.5) < 1.3)
    before = points.points[inner, 0].std()
    after = surfels.centres[inner, 0].std()
    # Twelve neighbours share two or three layers of voxels, so the mean is not of twelve returns.
    assert after < 0.6 * before
    # Voxels count alike, however many returns they hold: that shifts the middle by millimetres.
    assert abs(surfels.centres[inner, 0].mean() - 10) < 0.01
    # Along the surface nothing moves but by the normals' tilt.
    assert np.abs(surfels.centres - points.points)[inner, 1:].mean() < 0.01


@pytest.mark.parametrize(("surface", "semantic"), [("wall", Class.BUILDING), ("road", Class.ROAD)])
def test_the_rendered_depth_of_a_surface_is_that_of_its_returns(surface, semantic):
    points, edge_m = noisy(surface, semantic)
    surfels = surfels_from_points(points.points, edge_m, semantic=points.semantic)
    shifted = set_back(surfels, points.semantic, EYE[None])
    # Noise of 2 cm and discs in the order of their centres: without both steps it is 3 cm too near
    # on the wall, and 25 cm on the road.
    assert abs(np.median(depth_error(points, shifted))) < 0.03
    assert np.median(depth_error(points, surfels)) < np.median(depth_error(points, shifted))


def test_discs_move_away_from_the_eye_whichever_way_their_normals_point():
    points, edge_m = noisy("wall", Class.BUILDING)
    surfels = surfels_from_points(points.points, edge_m, semantic=points.semantic)
    faces = np.abs(surfels.normals[:, 0]) > 0.9
    for sign in (-1, 1):
        turned = dataclasses.replace(surfels, normals=sign * surfels.normals)
        moved = set_back(turned, points.semantic, EYE[None])
        assert (moved.centres[faces, 0] > surfels.centres[faces, 0]).all()
    behind = set_back(surfels, points.semantic, np.array([[20.0, 0, 1.6]]))
    assert (behind.centres[faces, 0] < surfels.centres[faces, 0]).all()


def test_ground_moves_down_and_nothing_moves_without_surfels():
    points, edge_m = noisy("road", Class.ROAD)
    surfels = surfels_from_points(points.points, edge_m, semantic=points.semantic)
    # The eye lies on the ground, as the origin of a car's axes does.
    moved = set_back(surfels, points.semantic, np.zeros((1, 3)))
    level = np.abs(surfels.normals[:, 2]) > 0.9
    assert (moved.centres[level, 2] < surfels.centres[level, 2]).all()
    none = surfels.select(np.zeros(0, np.int64))
    assert len(set_back(none, points.semantic[:0], EYE[None])) == 0
