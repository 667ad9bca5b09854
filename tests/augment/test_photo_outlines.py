"""Outlines of objects on photos: found edges, pixels that change sides, and the best path."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from augment.photo import outline_kernels as kernels
from augment.photo.outlines import Silhouette, fill_polygons, find_outlines
from augment.photo.photo_objects import find_edges
from augment.render.constants import RasterSettings
from augment.render.layout import ABOVE, HeightClip
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians
from tests.snow_scenes import drive, sheet, wall

SIZE = (480, 270)
# Perimeter of the thing of `thing`, pixels.
PERIMETER_PX = 573
# Mean distance of an outline from the edge of a photo with noise of 6 levels, pixels.
MEAN_ERROR_PX = 0.8


def paint(mask: np.ndarray, inside: int, outside: int, noise: int = 6) -> np.ndarray:
    """Return a gray photo of a thing on a plain ground."""
    gray = np.where(mask, inside, outside)
    gray = gray + np.random.default_rng(0).integers(-noise, noise + 1, mask.shape)
    return np.repeat(gray.clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def thing(grown_px: int) -> np.ndarray:
    """Return the mask of a rounded thing, grown by some pixels."""
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.ellipse(mask, (240, 140), (110 + grown_px, 70 + grown_px), 0, 0, 360, 1, -1)
    return mask > 0


def outlined(mask: np.ndarray, pixels: np.ndarray, reach_px: float) -> np.ndarray:
    """Return the mask of the outlines that are found for a silhouette of the photo's size."""
    silhouette = Silhouette(mask, 0, 0, (1.0, 1.0), reach_px)
    image = np.zeros(mask.shape, np.uint8)
    fill_polygons(find_outlines(silhouette, pixels), image, 1)
    return image > 0


def test_a_best_path_has_the_largest_sum_of_all_paths():
    gains = np.random.default_rng(1).normal(size=(5, 6)).astype(np.float32)
    path = np.empty(5, np.int64)
    kernels.find_best_path(gains, np.float32(0.3), path)

    def total(offsets) -> float:
        bends = np.abs(np.diff(offsets))
        return float(gains[np.arange(5), list(offsets)].sum() - 0.3 * bends.sum())

    smooth = (o for o in itertools.product(range(6), repeat=5) if np.abs(np.diff(o)).max() <= 2)
    assert total(path) == pytest.approx(max(map(total, smooth)), abs=1e-5)


@pytest.mark.parametrize(("inside", "outside"), [(40, 120), (200, 120)])
def test_an_outline_moves_from_the_splats_to_the_edge_of_the_photo(inside, outside):
    true = thing(0)
    pixels = paint(true, inside, outside)
    for grown_px in (3, 9):
        found = outlined(thing(grown_px), pixels, 20.0)
        assert (found ^ true).sum() <= 2.0 * np.hypot(110, 70) * np.pi / np.sqrt(2)


def test_without_an_edge_in_the_photo_an_outline_keeps_its_form():
    silhouette = thing(0)
    found = outlined(silhouette, paint(silhouette, 90, 90), 16.0)
    inner = cv2.erode(silhouette.astype(np.uint8), np.ones((33, 33), np.uint8)) > 0
    assert found[inner].all() and not found[~thing(6)].any()


def test_an_outline_leaves_the_image_where_the_photo_shows_it():
    """The lower edge of a car that the image cuts is nearly level, and so meets the border late."""
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    true = (rows > 100) & (columns > 60) & (rows + 0.3 * columns < 330)
    grown = (rows > 92) & (columns > 52) & (rows + 0.3 * columns < 342)
    outline = outlined(grown, paint(true, 30, 120), 24.0)
    below = (rows > 250) & (columns > 150)
    # 40 columns of the silhouette's 270th row are not the car's.
    assert (outline ^ true)[below].sum() < 0.25 * (grown ^ true)[below].sum()


def road_and_car() -> tuple[Camera, tuple[PosedGaussians, ...]]:
    """Return a camera above a road, and a car's back 8 m ahead as an actor of its own."""
    scene = drive(sheet((0.6, 40), (-20, 20)), ground_z_m=0.0)
    camera = scene.frames[0].cameras["ahead"].resized(*SIZE)
    car = wall(8.0, (-1.5, 1.5), (0.0, 1.4))
    return camera, (*scene.parts_for(camera), PosedGaussians(car, instance_id=1))


def photo_of_car(camera: Camera, parts: tuple[PosedGaussians, ...], grown_px: int) -> np.ndarray:
    """Return a photo in which the car ends some pixels beside its splats."""
    alpha = rasterize(parts[-1:], camera, buffers={"alpha"}).alpha
    assert alpha is not None
    mask = (alpha.numpy() > 0.5).astype(np.uint8)
    side = 2 * abs(grown_px) + 1
    change = cv2.erode if grown_px < 0 else cv2.dilate
    return change(mask, np.ones((side, side), np.uint8)) > 0


def test_beside_a_car_of_the_photo_the_buffers_are_those_of_the_road():
    camera, parts = road_and_car()
    buffers = frozenset({"rgb", "alpha", "expected_depth", "splat_ids"})
    raster = rasterize(parts, camera, buffers=buffers)
    road = rasterize(parts[:1], camera, buffers=buffers)
    true = photo_of_car(camera, parts, -5)
    pixels = paint(true, 30, 120)
    settings = RasterSettings()
    edges = find_edges(parts, raster, camera, pixels, settings=settings, backend="cpu")
    assert edges is not None and edges.instance_ids == {1}
    assert edges.background_of(parts) == parts[:1]
    in_torch = replace(
        raster,
        **{name: getattr(raster, name).clone().requires_grad_() for name in ("rgb", "alpha")},
        expected_depth=raster.expected_depth.clone(),
        splat_ids=raster.splat_ids.clone(),
    )
    rows, columns = edges.window
    window = {name: getattr(road, name)[rows, columns].contiguous() for name in buffers}
    behind = replace(road, **window)
    view = rasterize(parts[:1], edges.window_of(camera), buffers=buffers)
    assert torch.allclose(view.expected_depth, behind.expected_depth, rtol=1e-3)
    moved_in_torch = edges.apply(in_torch, behind, parts)
    moved = edges.apply(raster, behind, parts)
    for name in buffers:
        assert torch.equal(getattr(moved, name), getattr(moved_in_torch, name).detach())
    splats = cv2.dilate(photo_of_car(camera, parts, 0).astype(np.uint8), np.ones((3, 3)))
    rows = np.arange(SIZE[1])[:, None] > camera.cy + 12  # the road behind the car is in view
    ring = (splats > 0) & ~true & rows
    ring &= cv2.erode((~true).astype(np.uint8), np.ones((5, 5))) > 0  # 2 pixels beside the edge
    is_road = moved.splat_ids.numpy() < len(parts[0].gaussians)
    assert ring.sum() > 500 and is_road[ring].mean() > 0.97
    depth_error = np.abs(moved.expected_depth.numpy() - road.expected_depth.numpy())[ring & is_road]
    assert depth_error.max() == 0
    core = cv2.erode(true.astype(np.uint8), np.ones((5, 5))) > 0
    core &= np.arange(SIZE[1])[:, None] < camera.cy + camera.fy * 1.4 / 8  # above the road
    assert (~is_road)[core].mean() > 0.97


def test_a_car_that_the_photo_shows_beyond_its_splats_reaches_that_far():
    camera, parts = road_and_car()
    raster = rasterize(parts, camera, buffers={"alpha", "expected_depth"})
    true = photo_of_car(camera, parts, 2)
    pixels = paint(true, 30, 120)
    edges = find_edges(parts, raster, camera, pixels, settings=RasterSettings(), backend="cpu")
    assert edges is not None and len(edges.targets)
    assert true.reshape(-1)[edges.targets].mean() > 0.9
    depth = raster.expected_depth.numpy().reshape(-1)
    # Splats at the edge of the car let some of the road behind through.
    assert np.abs(depth[edges.sources] - 8.0).max() < 2.0


def test_under_water_a_car_is_not_drawn_above_its_line():
    camera, parts = road_and_car()
    clip = HeightClip(0.7, ABOVE)
    raster = rasterize(parts, camera, buffers={"alpha", "expected_depth"}, clip=clip)
    pixels = paint(photo_of_car(camera, parts, 2), 30, 120)
    edges = find_edges(
        parts, raster, camera, pixels, settings=RasterSettings(), clip=clip, backend="cpu"
    )
    assert edges is not None
    rows = edges.targets // camera.width
    waterline = camera.cy + camera.fy * (float(camera.centre[2]) - 0.7) / 8
    alpha = raster.alpha.numpy().reshape(-1)[edges.sources]
    assert (alpha[rows < waterline - 4] > 0.5).all() and (alpha[rows > waterline + 4] < 0.5).all()


def test_without_moving_parts_there_are_no_edges():
    camera, parts = road_and_car()
    raster = rasterize(parts[:1], camera, buffers={"alpha", "expected_depth"})
    pixels = paint(thing(0), 30, 120)
    assert (
        find_edges(parts[:1], raster, camera, pixels, settings=RasterSettings(), backend="cpu")
        is None
    )


def test_pixels_that_a_car_lacks_take_whole_values_of_pixels_that_were_looked_at():
    """Patterns within the pixels of the small copy must not be repeated beside them."""
    camera, parts = road_and_car()
    large = camera.resized(2 * SIZE[0], 2 * SIZE[1])
    raster = rasterize(parts, large, buffers={"alpha", "expected_depth"})
    pixels = paint(photo_of_car(large, parts, 4), 30, 120)
    edges = find_edges(parts, raster, large, pixels, settings=RasterSettings(), backend="cpu")
    assert edges is not None and len(edges.sources) > 100
    rows, columns = np.divmod(edges.sources, large.width)
    assert (rows % 2 == 0).all() and (columns % 2 == 0).all()
