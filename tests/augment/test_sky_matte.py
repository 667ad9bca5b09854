"""Sky mattes: regions of sky, soft edges, and colours without the sky."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from augment.photo.lidar_view import elevation_rad
from augment.photo.sky_matte import find_sky_matte, sky_matte
from augment.photo.sky_regions import SKY, SOFT_EDGE, SURFACE, find_sky_regions
from augment.render.buffers import ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from augment.view.render_view import render_view
from recipes.load import load_recipe
from tests.scenes import camera_ahead, one_gaussian
from tests.streets import SMALL_STREET, open_street

WIDTH = 320
HEIGHT = 200
SKY_RGB = (170, 190, 230)
WALL_RGB = (120, 100, 80)


@pytest.fixture
def camera() -> Camera:
    """A level camera, whose horizon is in row 100."""
    return camera_ahead(WIDTH, HEIGHT, 200.0)


def photo(wall_row: int = 60, wall_rgb: tuple[int, int, int] = WALL_RGB) -> np.ndarray:
    """A wall from a row down, and a smooth sky."""
    rgb = np.full((HEIGHT, WIDTH, 3), SKY_RGB, np.uint8)
    rgb[wall_row:] = wall_rgb
    return rgb


def returns(from_row: int, columns: slice = slice(None)) -> np.ndarray:
    """LiDAR returns in every fourth row from a row down."""
    has_return = np.zeros((HEIGHT, WIDTH), bool)
    has_return[from_row::4, columns] = True
    return has_return


def top_of(camera: Camera, row: int) -> float:
    return float(elevation_rad(camera)[row, WIDTH // 2])


def test_what_lies_over_a_wall_is_sky_and_the_wall_is_not(camera):
    matte = find_sky_matte(photo(), camera, returns(62), top_of(camera, 20))
    assert (matte.sky_share[:58] == 1).all() and (matte.sky_share[62:] == 0).all()
    assert (matte.surface_rgb[62:] == WALL_RGB).all()
    assert np.abs(matte.sky_rgb[:58].astype(int) - SKY_RGB).max() <= 1


def test_a_wall_as_pale_as_the_sky_ends_at_its_edge_above_the_lidars_view(camera):
    """The LiDAR looks up to row 80; a wall goes on to row 40, and beside it the sky is open."""
    rgb = photo(90)
    rgb[40:, :160] = (185, 186, 196)
    has_return = returns(90) | returns(80, slice(0, 160))
    matte = find_sky_matte(rgb, camera, has_return, top_of(camera, 80))
    assert (matte.sky_share[44:90, :156] == 0).all()
    assert (matte.sky_share[:36] == 1).all() and (matte.sky_share[:86, 166:] == 1).all()


def test_a_wall_over_the_whole_view_is_no_sky(camera):
    """It reaches the LiDAR's highest channel everywhere, and windows above mirror the sky."""
    rgb = photo(0, (190, 186, 180))
    rgb[4:24, 40:300] = SKY_RGB
    rgb[4:24, 40:300:12] = 60
    matte = find_sky_matte(rgb, camera, returns(50), top_of(camera, 50))
    assert (matte.sky_share == 0).all() and np.array_equal(matte.surface_rgb, rgb)


def test_clouds_and_glare_are_sky_and_a_tower_beyond_the_lidars_range_is_not(camera):
    rgb = photo().astype(np.float32)
    clouds = np.zeros((HEIGHT, WIDTH), np.float32)
    cv2.circle(clouds, (80, 25), 18, 1.0, -1)
    clouds = cv2.GaussianBlur(clouds, (0, 0), 7)[..., None]
    rgb[:60] += ((255, 240, 215) - rgb[:60]) * clouds[:60]
    rgb[20:60, 220:250] = 130
    rgb[20:60, 226:250:6] = 200
    matte = find_sky_matte(rgb.astype(np.uint8), camera, returns(62), top_of(camera, 10))
    assert (matte.sky_share[:57, :210] == 1).all()
    assert (matte.sky_share[24:60, 223:247] == 0).all()


def test_the_share_at_an_edge_and_the_colours_below_it_are_those_that_were_mixed(camera):
    """A roof at a slant, drawn at 8 times the size: shares and colours are known."""
    large = np.zeros((HEIGHT * 8, WIDTH * 8), np.float32)
    corners = np.array([[0, 300], [WIDTH * 8, 620], [WIDTH * 8, HEIGHT * 8], [0, HEIGHT * 8]])
    cv2.fillPoly(large, [corners.astype(np.int32)], 1.0)
    solid = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)[..., None]
    rgb = np.rint(solid * WALL_RGB + (1 - solid) * SKY_RGB).astype(np.uint8)
    matte = find_sky_matte(rgb, camera, returns(84), top_of(camera, 5))
    share = 1 - solid[..., 0]
    is_mixed = (share[:80] > 0.3) & (share[:80] < 0.7)
    assert is_mixed.sum() > 100
    # A pixel with less than 35 % of the surface counts as sky if none of its neighbours is purer.
    assert np.abs(matte.sky_share - share)[:80].max() < 0.35
    assert np.abs(matte.sky_share - share)[:80][is_mixed].mean() < 0.02
    color_error = np.abs(matte.surface_rgb.astype(int) - WALL_RGB).max(axis=2)[:80]
    recorded_error = np.abs(rgb.astype(int) - WALL_RGB).max(axis=2)[:80]
    assert color_error[is_mixed].mean() < 0.2 * recorded_error[is_mixed].mean()


def test_a_wire_darkens_another_sky_and_leaves_no_pale_line(camera):
    rgb = photo()
    rgb[30] = (110, 125, 155)  # a wire of a third of a pixel, or so
    matte = find_sky_matte(rgb, camera, returns(62), top_of(camera, 10))
    assert 0.2 < matte.sky_share[30].mean() < 0.8
    new_sky = np.float32([70, 75, 80])
    share = matte.sky_share[..., None]
    picture = share * new_sky + (1 - share) * matte.surface_rgb
    assert (picture[30].max(axis=1) < 75).all() and np.allclose(picture[20], new_sky)


def test_bright_rims_of_sharpening_beside_a_dark_pole_are_sky(camera):
    rgb = photo()
    rgb[:60, 100:106] = 40
    rgb[:60, 98:100] = rgb[:60, 106:108] = (205, 215, 235)
    matte = find_sky_matte(rgb, camera, returns(62), top_of(camera, 10))
    assert (matte.sky_share[5:55, 101:105] < 0.05).all()
    assert (matte.sky_share[5:55, 98] > 0.95).all() and (matte.sky_share[5:55, 107] > 0.95).all()


def test_dark_images_tell_nothing_and_images_below_the_horizon_hold_no_sky(camera):
    assert find_sky_matte(np.full((HEIGHT, WIDTH, 3), 20, np.uint8), camera) is None
    kinds = find_sky_regions(photo(), np.full((HEIGHT, WIDTH), -0.1))
    assert kinds is not None and (kinds == SURFACE).all()


def test_without_lidar_the_bright_smooth_top_of_the_image_is_sky(camera):
    rgb = photo()
    rgb[60::3] = 60
    rgb[20:60, 200:240] = 90
    kinds = find_sky_regions(rgb, elevation_rad(camera))
    assert (kinds[:56, :190] >= SOFT_EDGE).all() and (kinds[70:] != SKY).all()
    assert (kinds[25:60, 204:236] != SKY).all()


def recorded_street(folder: Path, uri: str = SMALL_STREET) -> Scene:
    """The street with its own clear renders, at half size, as recorded images of frame 0."""
    street = open_street(uri)
    frame = street.frames[0]
    recipe = load_recipe("clear").resolve(0)
    cameras = {name: frame.cameras[name].scaled(0.5) for name in ("front", "right", "back")}
    paths = {}
    for name, camera in cameras.items():
        path = folder / f"{name}.png"
        cv2.imwrite(str(path), render_view(street, camera, recipe).rgb[..., ::-1])
        paths[name] = str(path)
    recorded = dataclasses.replace(frame, cameras=cameras, image_paths=paths)
    return dataclasses.replace(street, frames=(recorded, *street.frames[1:]))


def test_the_streets_sky_is_what_no_splat_covers(tmp_path):
    scene = recorded_street(tmp_path, "procedural:street?seed=3&frames=2")
    for name, camera in scene.frames[0].cameras.items():
        matte = sky_matte(scene, camera)
        assert matte is not None
        alpha = rasterize(scene.parts_for(camera), camera, buffers=(ALPHA,)).alpha.numpy()
        assert (alpha < 0.01).any() == (name != "right")
        # Measured: 0.07 to 0.09 %, at soft edges of crowns and chimneys; and 0.001 to 0.03 %.
        assert ((matte.sky_share > 0.5) & (alpha > 0.5)).mean() < 0.002
        assert ((matte.sky_share < 0.5) & (alpha < 0.01)).mean() < 0.001


def test_a_recorded_image_gives_one_matte_at_any_scale(tmp_path):
    scene = recorded_street(tmp_path)
    camera = scene.frames[0].cameras["front"]
    small, again = (sky_matte(scene, camera.scaled(0.5)) for _ in range(2))
    for first, second in zip(small, again, strict=True):
        np.testing.assert_array_equal(first, second)
    fresh = sky_matte(dataclasses.replace(scene), camera.scaled(0.5))
    np.testing.assert_array_equal(small.sky_share, fresh.sky_share)
    smaller = sky_matte(scene, camera.scaled(0.25)).sky_share
    size = smaller.shape[::-1]
    halved = cv2.resize(small.sky_share, size, interpolation=cv2.INTER_AREA)
    assert np.abs(halved - smaller).mean() < 0.01


def test_without_a_readable_image_there_is_no_matte(tmp_path):
    camera = camera_ahead(64, 48, 60.0)
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"ahead": camera})
    scene = Scene("s", "test:", one_gaussian(), (), ConstantSky(torch.zeros(3)), (frame,))
    assert sky_matte(scene, camera) is None
    path = tmp_path / "broken.png"
    path.write_bytes(b"no image")
    frame = dataclasses.replace(frame, image_paths={"ahead": str(path)})
    assert sky_matte(dataclasses.replace(scene, frames=(frame,)), camera) is None
