"""Parked objects as parts of their own, and the lower side of objects."""

from __future__ import annotations

import numpy as np
import torch

from augment.photo.object_underside import underside_of
from augment.photo.parked_objects import ObjectBox, ParkedObjects, take_objects
from augment.photo.photo_objects import find_edges
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene.scene import Gaussians, PosedGaussians
from tests.augment.test_photo_outlines import SIZE, paint, photo_of_car
from tests.snow_scenes import drive, sheet, stack_all, wall

# The box of a car whose back is a wall 8 m ahead.
BOX = ObjectBox(np.array([8.0, 0.0, 0.7]), np.eye(3), (1.0, 3.0, 1.4))


def parked_car():
    """Return a camera above a road, and the background with a car's back 8 m ahead in it."""
    scene = drive(sheet((0.6, 40), (-20, 20)), ground_z_m=0.0)
    camera = scene.frames[0].cameras["ahead"].resized(*SIZE)
    road = scene.parts_for(camera)[0].gaussians
    car = wall(8.0, (-1.5, 1.5), (0.0, 1.4))
    return camera, road, car, (PosedGaussians(stack_all([road, car])),)


def test_a_parked_car_ends_where_the_photo_shows_its_edge():
    camera, road, car, parts = parked_car()
    objects = take_objects(parts, ParkedObjects((BOX,), parts[0].gaussians), camera)
    assert set(objects.poses) == {1}
    buffers = frozenset({"alpha", "expected_depth", "splat_ids"})
    raster = rasterize(parts, camera, buffers=buffers)
    car_part = PosedGaussians(car, instance_id=1)
    photo_mask = photo_of_car(camera, (car_part,), -5)
    settings = RasterSettings()
    edges = find_edges(
        parts,
        raster,
        camera,
        paint(photo_mask, 30, 120),
        settings=settings,
        parked=objects,
        backend="cpu",
    )
    assert edges is not None and edges.instance_ids == {1}
    ring = photo_of_car(camera, (car_part,), -1) & ~photo_of_car(camera, (car_part,), -4)
    ring &= np.arange(SIZE[1])[:, None] > camera.cy + 12
    assert edges.shows_background[ring].mean() > 0.9
    background = rasterize(
        edges.background_of(objects.hide(parts, edges.instance_ids)),
        edges.window_of(camera),
        buffers=buffers,
    )
    moved = edges.apply(raster, background, parts)
    is_road = moved.splat_ids.numpy()[ring & edges.shows_background] < len(road)
    assert is_road.all()


def test_objects_that_are_far_or_have_few_splats_keep_the_outlines_of_their_splats():
    camera, _, _, parts = parked_car()
    background = parts[0].gaussians
    far = ObjectBox(np.array([38.0, 0.0, 0.7]), BOX.rotation, BOX.size_m)
    empty = ObjectBox(np.array([8.0, 8.0, 0.7]), BOX.rotation, BOX.size_m)
    behind = ObjectBox(np.array([-8.0, 0.0, 0.7]), BOX.rotation, BOX.size_m)
    objects = take_objects(parts, ParkedObjects((far, empty, behind), background), camera)
    assert not objects.parts and not objects.bare_parts
    assert objects.hide(parts, frozenset({1})) == parts


def test_a_car_hangs_over_the_ground_at_its_ends_and_not_between_its_wheels():
    x = np.linspace(-2.2, 2.2, 4000)
    bottom = np.where(np.abs(np.abs(x) - 1.4) < 0.3, 0.0, 0.25)  # wheels, sills and bumpers
    z = bottom + np.random.default_rng(0).uniform(0, 1.2, len(x)) * (np.arange(len(x)) % 3 > 0)
    num_splats = len(x)
    gaussians = Gaussians(
        means=torch.tensor(np.stack([x, 0 * x, z], 1), dtype=torch.float32),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(num_splats, 1),
        scales=torch.full((num_splats, 3), 0.02),
        opacities=torch.ones(num_splats),
        sh=torch.zeros(num_splats, 1, 3),
    )
    side = underside_of([PosedGaussians(gaussians, world_from_part=torch.eye(4).double())])
    heights = np.interp([-2.1, -1.4, 0.0, 1.4, 2.1], side.stations_m, side.heights_m)
    np.testing.assert_allclose(heights[1:4], 0, atol=0.03)
    assert heights[0] > 0.12 and heights[4] > 0.12
