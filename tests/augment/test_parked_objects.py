"""Parked objects as parts of their own, and the lower side of objects."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from augment.photo.object_underside import Underside, underside_of
from augment.photo.parked_objects import (
    BOTTOM_MARGIN_M,
    BOTTOM_MARGIN_OF_SNOW_M,
    OTHER_CLASSES,
    SIDE_MARGIN_M,
    TOP_MARGIN_M,
    TOP_MARGIN_OF_SNOW_M,
    ObjectBox,
    ParkedObjects,
    take_objects,
)
from augment.photo.photo_objects import find_edges
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene.labels import Boxes
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.schema import Recipe, Render, Weather
from recipes.snow import Snow
from tests.augment.test_photo_outlines import SIZE, paint, photo_of_car
from tests.snow_scenes import drive, sheet, splats, stack_all, wall

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


class OneBox:
    """Labels with the box of a parked car in every frame."""

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes(
            ("parked",),
            ("Car",),
            BOX.centre_m[None],
            np.array([BOX.size_m]),
            np.array([[1.0, 0, 0, 0]]),
        )

    def lidar(self, frame_index: int) -> None:
        return None


def test_snow_on_a_photo_reaches_the_edge_that_the_photo_shows_of_a_parked_car(tmp_path):
    camera, road, car, _ = parked_car()
    car_part = PosedGaussians(car, instance_id=1)
    # The splats of the car reach 5 pixels beyond the car of the photo, before a road under snow.
    pixels = paint(photo_of_car(camera, (car_part,), -5), 30, 120)
    path = tmp_path / "0.png"
    assert cv2.imwrite(str(path), pixels)
    scene = drive(road, car, ground_z_m=0.0)
    frame = replace(scene.frames[0], cameras={"ahead": camera}, image_paths={"ahead": str(path)})
    scene = replace(scene, frames=(frame,))
    snow = Snow(depth_m=0.1, cell_m=0.2, tracks="never")
    recipe = Recipe(weather=Weather(snow=snow), render=Render(base="recorded"))
    ring = photo_of_car(camera, (car_part,), -1) & ~photo_of_car(camera, (car_part,), -4)
    ring &= np.arange(SIZE[1])[:, None] > camera.cy + 12
    ring &= np.arange(SIZE[1])[:, None] < camera.cy + camera.fy * 1.3 / 8  # above the car's foot
    assert ring.sum() > 100
    snow_shares = []
    for labels in (None, OneBox()):
        labelled = replace(scene, labels=labels)
        buffers = render_buffers(labelled, camera, make_plan(recipe, labelled), backend="cpu")
        snow_shares.append(buffers.raster.overlay.numpy())
    without_box, with_box = snow_shares
    # Edges of the car's splats let some of the snow behind through, and snow some of the road.
    assert without_box[ring].mean() < 0.3
    assert (with_box[ring] > 0.8).mean() > 0.9
    core = photo_of_car(camera, (car_part,), -9)
    core &= np.arange(SIZE[1])[:, None] < camera.cy + camera.fy * 1.3 / 8
    core &= np.arange(SIZE[1])[:, None] > camera.cy + 12
    assert with_box[core].mean() < 0.1


def test_splats_of_a_box_are_in_its_margins_and_of_no_other_class():
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # its length lies along the world's y
    box = ObjectBox(np.array([10.0, 5.0, 1.75]), turned, (4.0, 2.0, 1.5))  # z from 1 to 2.5 m
    inside = 0.01
    half_x_m = 1.0 + SIDE_MARGIN_M
    half_y_m = 2.0 + SIDE_MARGIN_M
    offsets_m = [
        (half_x_m - inside, 0, 0),
        (half_x_m + inside, 0, 0),
        (0, -half_y_m + inside, 0),
        (0, -half_y_m - inside, 0),
        (0, 0, -0.75 + BOTTOM_MARGIN_M + inside),
        (0, 0, -0.75 + BOTTOM_MARGIN_M - inside),
        (0, 0, 0.75 + TOP_MARGIN_M - inside),
        (0, 0, 0.75 + TOP_MARGIN_M + inside),
        (0, 0, -0.75 + BOTTOM_MARGIN_OF_SNOW_M + inside),
        (0, 0, -0.75 + BOTTOM_MARGIN_OF_SNOW_M - inside),
        (0, 0, 0.75 + TOP_MARGIN_OF_SNOW_M - inside),
        (0, 0, 0.75 + TOP_MARGIN_OF_SNOW_M + inside),
    ]
    points = splats(box.centre_m + np.array(offsets_m), [0.02] * 3)
    assert box.rows_in(points, is_overlay=False).tolist() == [0, 2, 4, 6, 8, 9]
    assert box.rows_in(points, is_overlay=True).tolist() == [0, 2, 6, 7, 8, 10]
    classes = list(SemanticClass)
    middles = splats(np.tile(box.centre_m, (len(classes), 1)), [0.02] * 3)
    numbers = torch.tensor([int(c) for c in classes], dtype=torch.int16)
    middles = replace(middles, semantic=numbers)
    rows = box.rows_in(middles, is_overlay=False)
    assert {classes[row] for row in rows} == set(classes) - set(OTHER_CLASSES)
    assert SemanticClass.VEHICLE in {classes[row] for row in rows}
    assert len(box.rows_in(middles, is_overlay=True)) == len(classes)  # snow has its own class


def test_an_overhang_counts_in_full_from_the_side_and_not_from_the_end():
    """From an end, the wheels beside a bumper hide the ground below it."""
    camera, *_ = parked_car()
    side_on = np.eye(4)
    side_on[:2, :2] = [[0, 1], [-1, 0]]  # the object's x is the world's y, across the view
    side_on[:2, 3] = [0.0, 8.0]
    stations_m = np.array([-2.0, -1.0, 1.0, 2.0])
    heights_m = np.array([0.3, 0.0, 0.0, 0.2])
    rows = np.full(4, camera.cy + 20.0)
    columns = camera.cx - camera.fx * np.array([-2.0, -1.0, 1.0, 2.0]) / 8  # +y is to the left
    depths_m = np.full(4, 8.0)
    underside = Underside(0.1, stations_m, heights_m, side_on)
    np.testing.assert_allclose(
        underside.lowest_at(rows, columns, depths_m, camera), 0.1 + heights_m, atol=1e-6
    )
    end_on = np.eye(4)
    end_on[0, 3] = -10.0  # its end is 8 m ahead, in the middle of the image
    ahead = np.full(1, camera.cx)
    underside = Underside(0.1, stations_m, heights_m, end_on)
    lowest_m = underside.lowest_at(rows[:1], ahead, depths_m[:1], camera)
    np.testing.assert_allclose(lowest_m, 0.1, atol=1e-6)
    unknown = Underside(0.1, np.empty(0), np.empty(0), np.eye(4))
    np.testing.assert_array_equal(unknown.lowest_at(rows, columns, depths_m, camera), 0.1)


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
