"""Raw scenes have no holes below the horizon: what is put there, of which class and whose."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from adapters.lidar_scene.closing import close_parts
from adapters.lidar_scene.image_views import View
from adapters.lidar_scene.split import PointSet, join_tracks
from adapters.pandaset.adapter import open_pandaset
from adapters.raw_drive import BoxSample
from augment.render.buffers import ALPHA
from augment.render.rasterize import rasterize
from augment.scene.scene import Gaussians
from augment.scene.semantics import SemanticClass as Class
from tests.adapters import pandaset_files
from tests.adapters.test_image_views import camera

GREY, RED = (90, 90, 90), (200, 30, 30)
HEIGHT_M = 1.5  # of the camera, over the road


def road(nearest_m: float) -> tuple[Gaussians, PointSet]:
    """A level road 1.5 m below the camera, from a distance on, and its points."""
    x, y = np.meshgrid(np.arange(nearest_m, 30, 0.2), np.arange(-15, 15, 0.2))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, -HEIGHT_M)], 1).astype(np.float32)
    classes = np.full(len(points), Class.ROAD, np.int16)
    count = len(points)
    gaussians = Gaussians(
        means=torch.from_numpy(points),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.tensor([0.2, 0.2, 0.01]).repeat(count, 1),
        opacities=torch.full((count,), 0.99),
        sh=torch.zeros(count, 1, 3),
        semantic=torch.from_numpy(classes),
    )
    return gaussians, PointSet(points, classes)


def photo(path, colour) -> View:
    cam = camera()
    image = np.full((cam.height, cam.width, 3), colour, np.uint8)
    cv2.imwrite(str(path), image[..., ::-1])
    return View(cam, path, 0)


def test_the_road_before_the_car_is_closed_at_its_height_in_the_photos_colour(tmp_path):
    background, points = road(6.0)
    view = photo(tmp_path / "a.png", RED)
    (closed,) = close_parts([background], (), (), [view], points, max_gaussians=10**6)
    new = closed.select(torch.arange(len(background), len(closed)))
    assert len(new) > 50 and (new.semantic == Class.ROAD).all()
    near = new.means[:, 0] < 20  # the horizon leaks too, and those discs hang above the ground
    assert (new.means[near, 2] + HEIGHT_M).abs().max() < 0.1
    before = new.means[:, 0] < 5
    assert before.any()
    colours = new.sh[before, 0] * 0.28209479 + 0.5
    torch.testing.assert_close(
        colours, torch.tensor(RED).expand_as(colours) / 255, atol=0.02, rtol=0
    )
    # Of an image that is closed, nothing is closed again.
    (again,) = close_parts([closed], (), (), [view], points, max_gaussians=10**6)
    assert len(again) - len(closed) < 0.05 * len(new)


def test_no_disc_stands_before_the_lens_where_the_ground_rises_above_the_camera(tmp_path):
    background, points = road(6.0)[0], road(0.0)[1]
    xyz = points.points.copy()
    patch = (xyz[:, :2] // 2).astype(int) @ [31, 1] % 997  # of 2 m
    heights = np.random.default_rng(7).uniform(-HEIGHT_M, 3.0, 997)
    xyz[:, 2] = np.where(xyz[:, 0] > 9, heights[patch], xyz[:, 2])
    rough = PointSet(xyz, points.semantic)
    view = photo(tmp_path / "a.png", GREY)
    (closed,) = close_parts([background], (), (), [view], rough, max_gaussians=10**6)
    new = closed.means[len(background) :]
    assert len(new) > 50 and (new[:, 0] > 1).all()


def test_nothing_is_closed_where_no_distance_is_known(tmp_path):
    nothing = PointSet(np.zeros((0, 3), np.float32), np.zeros(0, np.int16))
    view = photo(tmp_path / "a.png", GREY)
    (closed,) = close_parts([empty()], (), (), [view], nothing, max_gaussians=10**6)
    assert len(closed) == 0


def test_the_hole_in_a_moving_object_is_of_the_object(tmp_path):
    background, points = road(4.0)
    pose = np.eye(4)
    pose[:3, 3] = 6.5, 0, -HEIGHT_M + 0.9
    sample = BoxSample("c", None, "Car", 0, 0, pose, np.array([3.0, 4.0, 1.6]))
    keep = (np.abs(points.points[:, 1]) > 2.2) | (points.points[:, 0] < 5)
    hollow = background.select(torch.from_numpy(keep))
    world, car = close_parts(
        [hollow, empty()],
        join_tracks([sample]),
        (),
        [photo(tmp_path / "a.png", GREY)],
        PointSet(points.points[keep], points.semantic[keep]),
        max_gaussians=10**6,
    )
    assert len(car) >= 12 and (car.semantic == Class.VEHICLE).all()
    assert (car.means.abs() <= torch.tensor([1.5, 2.0, 0.8]) + 0.1).all()
    new = world.means[len(hollow) :]
    in_box = (new - torch.tensor(pose[:3, 3]).float()).abs() < torch.tensor([1.2, 1.6, 0.5])
    assert not in_box.all(1).any()


def empty() -> Gaussians:
    none = Gaussians.empty()
    return Gaussians(
        none.means,
        none.quats,
        none.scales,
        none.opacities,
        none.sh,
        torch.zeros(0, dtype=torch.int16),
    )


def test_a_budget_makes_discs_larger_and_is_kept(tmp_path):
    background, points = road(6.0)
    view, count = photo(tmp_path / "a.png", RED), len(background)
    fine, coarse, fewest = (
        close_parts([background], (), (), [view], points, max_gaussians=count + more)[0]
        for more in (10**6, 60, 6)
    )
    assert len(fine) > len(coarse) > count and len(coarse) <= count + 60
    size_m = [own.scales[count:].max(1).values for own in (fine, coarse, fewest)]
    assert size_m[1].median() > 1.5 * size_m[0].median()
    # No disc becomes so large that it stands before the sky (8 pixels are 1.5 m at 6 m); what is
    # nearest is closed first.
    assert 1 <= len(size_m[2]) <= 6 and size_m[2].max() < 1.5
    assert (
        fewest.means[count:, :2].norm(dim=1) < fine.means[count:, :2].norm(dim=1).median()
    ).all()


def test_a_raw_scene_has_no_openings_below_the_horizon(tmp_path):
    root = pandaset_files.write_as_pandaset(tmp_path / "002")
    scene = open_pandaset(str(root), {"voxel_m": "0.1", "image_scale": "1", "sky_size": "8"})
    for frame in scene.frames:
        for own in frame.cameras.values():
            alpha = rasterize(scene.parts_for(own), own, buffers=(ALPHA,)).alpha
            alpha = alpha[own.ray_directions()[..., 2] < 0]
            # Frame 1 lies between those that are closed. As measured by the LiDAR alone the front
            # camera has 10 % of openings, and 14 to 26 % of both cameras' pixels leak: through 2 %
            # of leaking white fog shine 5 of 255 levels, and 1 in 200 such pixels is no patch.
            assert (alpha >= 0.5).all(), (frame.index, own.name)
            assert (alpha < 0.98).float().mean() < 0.005, (frame.index, own.name)
