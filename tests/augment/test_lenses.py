"""Lenses against OpenCV's own functions, their inverses, their limits, and cameras with them."""

from __future__ import annotations

import dataclasses
import math
import pickle

import cv2
import numpy as np
import pytest
import torch

from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.lenses import FisheyeLens, Intrinsics, Lens, OpenCVLens
from augment.scene.shutter import RollingShutter, interpolate_pose
from tests.lenses import F_THETA, F_THETA_CENTRE_PX

# Distortion of KITTI's unrectified image 02 of 2011_09_26, as published.
KITTI = OpenCVLens.from_coefficients(
    [-3.691481e-01, 1.968681e-01, 1.353473e-03, 5.677587e-04, -6.770705e-02]
)
# Its focal lengths and principal point; KITTI counts pixel centres at whole numbers.
KITTI_INTRINSICS = Intrinsics(959.791, 956.9251, 696.0217 + 0.5, 224.1806 + 0.5)
# Every coefficient that OpenCV has without tilting the sensor.
RATIONAL = OpenCVLens(
    radial=(0.31, -0.08, 0.004, 0.52, -0.05, -0.003),
    tangential=(0.002, -0.001),
    thin_prism=(0.003, -0.001, -0.002, 0.0005),
)
FISHEYE = FisheyeLens(radial=(-0.02, 0.003, -0.001, 0.0001), limit_rad=math.radians(100.0))
FISHEYE_INTRINSICS = Intrinsics(400.0, 410.0, 480.5, 300.0)
F_THETA_INTRINSICS = Intrinsics(
    F_THETA.slope_px, F_THETA.slope_px, F_THETA_CENTRE_PX[0] + 0.5, F_THETA_CENTRE_PX[1] + 0.5
)
F_THETA_BACKWARDS = dataclasses.replace(F_THETA, reference="distance_to_angle")
LENSES: dict[str, tuple[Lens, Intrinsics, tuple[int, int]]] = {
    "kitti": (KITTI, KITTI_INTRINSICS, (1392, 512)),
    "rational": (RATIONAL, Intrinsics(700.0, 690.0, 400.0, 310.0), (800, 600)),
    "no distortion": (OpenCVLens(), Intrinsics(700.0, 690.0, 400.0, 310.0), (800, 600)),
    "fisheye": (FISHEYE, FISHEYE_INTRINSICS, (960, 600)),
    "f-theta": (F_THETA, F_THETA_INTRINSICS, (960, 740)),
    "f-theta by distance": (F_THETA_BACKWARDS, F_THETA_INTRINSICS, (960, 740)),
}


def opencv_matrix(intrinsics: Intrinsics) -> np.ndarray:
    """Return the intrinsic matrix as OpenCV counts pixels, centres at whole numbers."""
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])


def directions_ahead(count: int, max_angle_deg: float) -> np.ndarray:
    """Return directions of any length up to an angle from the axis, [count, 3]."""
    generator = np.random.default_rng(7)
    angle = np.radians(generator.uniform(0, max_angle_deg, count))
    turn = generator.uniform(0, 2 * np.pi, count)
    length = generator.uniform(0.5, 60, count)
    x = np.sin(angle) * np.cos(turn)
    y = np.sin(angle) * np.sin(turn)
    return np.stack([x, y, np.cos(angle)], -1) * length[:, None]


def camera_of(name: str) -> Camera:
    """Return the camera of LENSES at the origin."""
    lens, intrinsics, (width, height) = LENSES[name]
    pose = torch.eye(4, dtype=torch.float64)
    return Camera("front", width, height, *intrinsics, pose, lens=lens)


@pytest.mark.parametrize("name", ["kitti", "rational", "no distortion"])
def test_opencv_lens_projects_as_opencv_does(name):
    lens, intrinsics, _ = LENSES[name]
    assert isinstance(lens, OpenCVLens)
    k1, k2, k3, k4, k5, k6 = lens.radial
    coefficients = np.array([k1, k2, *lens.tangential, k3, k4, k5, k6, *lens.thin_prism])
    directions = directions_ahead(500, 45.0)
    pixels, is_inside = lens.project(directions, intrinsics)
    expected, _ = cv2.projectPoints(
        directions[:, None], np.zeros(3), np.zeros(3), opencv_matrix(intrinsics), coefficients
    )
    assert is_inside.all()
    # Both are float64; the numbers go up to some thousand pixels.
    np.testing.assert_allclose(pixels, expected[:, 0] + 0.5, atol=1e-9)


def test_fisheye_lens_projects_as_opencv_does():
    directions = directions_ahead(500, 85.0)  # OpenCV divides by z, so it ends below 90 degrees
    pixels, is_inside = FISHEYE.project(directions, FISHEYE_INTRINSICS)
    expected, _ = cv2.fisheye.projectPoints(
        directions[:, None],
        np.zeros(3),
        np.zeros(3),
        opencv_matrix(FISHEYE_INTRINSICS),
        np.array(FISHEYE.radial),
    )
    assert is_inside.all()
    np.testing.assert_allclose(pixels, expected[:, 0] + 0.5, atol=1e-9)


def test_f_theta_lens_follows_its_published_polynomial():
    angle = 1.0
    direction = np.array([[math.sin(angle), 0.0, math.cos(angle)]])
    distance_px = sum(a * angle**power for power, a in enumerate(F_THETA.angle_to_distance))
    c, _, e = F_THETA.linear
    pixel, is_inside = F_THETA.project(direction, F_THETA_INTRINSICS)
    assert is_inside
    expected = (F_THETA_INTRINSICS.cx + c * distance_px, F_THETA_INTRINSICS.cy + e * distance_px)
    np.testing.assert_allclose(pixel[0], expected, rtol=1e-14)


@pytest.mark.parametrize("name", LENSES)
def test_rays_of_all_pixels_project_back_to_them(name):
    lens, intrinsics, (width, height) = LENSES[name]
    rows, columns = np.mgrid[0 : height + 1 : 7, 0 : width + 1 : 7].astype(np.float64)
    pixels = np.stack([columns, rows], -1)
    rays, sees = lens.rays(pixels, intrinsics)
    back, is_inside = lens.project(rays, intrinsics)
    assert sees.mean() > 0.9
    assert is_inside[sees].all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(back[sees], pixels[sees], atol=1e-6)


def test_lens_shows_nothing_beyond_its_limits():
    behind = np.array([[0.1, 0.0, -1.0], [0.0, 0.0, 0.0]])
    for name, (lens, intrinsics, _) in LENSES.items():
        limit = lens.max_angle_rad
        for angle, is_shown in ((limit - 1e-3, True), (limit + 1e-3, False)):
            direction = np.array([[0.0, math.sin(angle), math.cos(angle)]])
            pixel, is_inside = lens.project(direction, intrinsics)
            assert bool(is_inside) == is_shown, name
            assert bool(np.isnan(pixel).all()) != is_shown, name
        assert not lens.project(behind, intrinsics)[1].any(), name


def test_pixels_beyond_a_radial_turn_see_nothing():
    turning = OpenCVLens(radial=(-0.5, 0.0, 0.0, 0.0, 0.0, 0.0))
    # r (1 - r^2 / 2) turns back at r = sqrt(2 / 3), where it is 2 r / 3.
    end = math.sqrt(2 / 3)
    assert turning.max_angle_rad == pytest.approx(math.atan(end), rel=1e-12)
    unit = Intrinsics(1.0, 1.0, 0.0, 0.0)
    pixels = np.array([[2 / 3 * end - 1e-4, 0.0], [2 / 3 * end + 1e-4, 0.0]])
    rays, sees = turning.rays(pixels, unit)
    assert sees.tolist() == [True, False]
    np.testing.assert_array_equal(rays[1], [0.0, 0.0, 1.0])
    fisheye = FisheyeLens(radial=(-0.3, 0.0, 0.0, 0.0))
    assert fisheye.max_angle_rad == pytest.approx(1 / math.sqrt(0.9), rel=1e-12)


def test_bad_lens_numbers_are_refused():
    bad = [
        (lambda: OpenCVLens(radial=(math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)), "6 finite numbers"),
        (lambda: OpenCVLens.from_coefficients([0.1] * 14), "tilted sensor"),
        (lambda: FisheyeLens(limit_rad=4.0), "at most pi"),
        (lambda: dataclasses.replace(F_THETA, angle_to_distance=(1.0, 400.0)), "begin with 0"),
        (lambda: dataclasses.replace(F_THETA, angle_to_distance=(0.0,)), "2 or more"),
        (lambda: dataclasses.replace(F_THETA, linear=(-1.0, 0.0, 0.0)), "orientation"),
        (lambda: dataclasses.replace(F_THETA, limit_rad=0.0), "above 0"),
    ]
    for make, message in bad:
        with pytest.raises(ValueError, match=message):
            make()


@pytest.mark.parametrize("name", LENSES)
def test_scaled_and_cropped_cameras_keep_their_rays(name):
    camera = camera_of(name)
    assert camera.lens is not None
    pixels = np.array([[100.5, 80.5], [400.0, 300.0], [250.0, 17.0]])
    rays, _ = camera.lens.rays(pixels, camera.intrinsics)
    half = camera.resized(camera.width // 2, camera.height // 4)
    assert half.lens is not None
    squeezed = pixels * (half.width / camera.width, half.height / camera.height)
    np.testing.assert_allclose(half.lens.rays(squeezed, half.intrinsics)[0], rays, atol=1e-12)
    window = camera.cropped(30, 11, 200, 100)
    assert window.lens is not None
    moved = pixels - (30, 11)
    np.testing.assert_allclose(window.lens.rays(moved, window.intrinsics)[0], rays, atol=1e-12)


def test_lenses_are_equal_by_value_and_survive_pickling():
    for lens, intrinsics, _ in LENSES.values():
        lens.rays(np.array([[100.0, 100.0]]), intrinsics)  # fills what it computes once
        copy = pickle.loads(pickle.dumps(lens))
        assert copy == lens
        assert hash(copy) == hash(lens)


def test_pinhole_code_refuses_a_camera_with_a_lens():
    camera = camera_of("kitti")
    shutter = RollingShutter(
        torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64), "top_to_bottom", 1000
    )
    for refused in (camera, dataclasses.replace(camera, lens=None, shutter=shutter)):
        for call in (
            lambda c=refused: c.K,
            refused.ray_directions,
            refused.ray_lengths,
            lambda c=refused: rasterize([], c),
        ):
            with pytest.raises(ValueError, match=r"camera 'front' has a .*cannot be used for"):
                call()
    assert camera.without_lens().is_pinhole
    assert camera.without_lens().K[0, 0] == camera.fx
    with pytest.raises(ValueError, match="orthographic camera has neither lens nor shutter"):
        dataclasses.replace(camera, is_orthographic=True)


# ---- Rolling shutters ----------------------------------------------------------------------------


def moving_camera(read_out: str = "top_to_bottom") -> Camera:
    """Return a camera that moves 1 m along x and turns by 0.1 rad while it is read."""
    start = torch.eye(4, dtype=torch.float64)
    cosine = math.cos(0.1)
    sine = math.sin(0.1)
    world_from_end = torch.tensor(
        [[cosine, 0, sine, 1], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]],
        dtype=torch.float64,
    )
    end = torch.linalg.inv(world_from_end)
    shutter = RollingShutter.between(start, end, read_out=read_out, duration_ns=40_000_000)
    middle = interpolate_pose(start, end, 0.5)
    return Camera("front", 80, 60, 50.0, 50.0, 40.0, 30.0, middle, 10**9, shutter=shutter)


def test_poses_of_a_shutter_go_from_its_start_to_its_end():
    camera = moving_camera()
    start = camera.at_read_out(0.0)
    end = camera.at_read_out(1.0)
    assert start.shutter is None
    torch.testing.assert_close(
        start.centre, torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0
    )
    torch.testing.assert_close(end.centre, torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert start.timestamp_ns == 10**9 - 20_000_000
    assert end.timestamp_ns == 10**9 + 20_000_000
    quarter = camera.at_read_out(0.25)
    torch.testing.assert_close(quarter.centre, torch.tensor([0.25, 0, 0], dtype=torch.float64))
    # A constant rate of turn: a quarter of the way has a quarter of the angle.
    assert float(quarter.camera_from_world[0, 0]) == pytest.approx(math.cos(0.025), abs=1e-12)


def test_a_moved_camera_keeps_its_shutter():
    camera = moving_camera()
    moved_from_world = torch.eye(4, dtype=torch.float64)
    moved_from_world[:3, 3] = torch.tensor([5.0, 6.0, 7.0])
    moved = dataclasses.replace(
        camera, camera_from_world=camera.camera_from_world @ torch.linalg.inv(moved_from_world)
    )
    expected = camera.at_read_out(0.9).centre + moved_from_world[:3, 3]
    torch.testing.assert_close(moved.at_read_out(0.9).centre, expected)


@pytest.mark.parametrize(
    ("read_out", "window", "shares"),
    [
        ("top_to_bottom", (0, 15, 80, 30), (0.25, 0.75)),
        ("bottom_to_top", (0, 0, 80, 15), (0.75, 1.0)),
        ("left_to_right", (20, 7, 20, 3), (0.25, 0.5)),
        ("right_to_left", (60, 0, 40, 60), (-0.25, 0.25)),
    ],
)
def test_windows_of_an_image_keep_the_times_of_their_rows(read_out, window, shares):
    camera = moving_camera(read_out)
    left, top, width, height = window
    part = camera.cropped(left, top, width, height).shutter
    assert part is not None
    assert (part.first_share, part.last_share) == pytest.approx(shares)
    assert camera.shutter is not None
    row = camera.shutter.share_at(top + 3.0, 60)
    column = camera.shutter.share_at(left + 3.0, 80)
    size = height if part.is_along_rows else width
    assert part.share_at(3.0, size) == pytest.approx(row if part.is_along_rows else column)


def test_bad_shutters_are_refused():
    identity = torch.eye(4, dtype=torch.float64)
    bad = [
        ({"duration_ns": -1}, "must be from 0"),
        ({"duration_ns": 10**12}, "must be from 0"),
        ({"start_from_camera": identity * 2}, "must be rigid"),
        ({"end_from_camera": identity * math.nan}, "must be rigid"),
        ({"end_from_camera": identity.float()}, "float64"),
    ]
    good = RollingShutter(identity, identity, "top_to_bottom", 1000)
    for change, message in bad:
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(good, **change)
