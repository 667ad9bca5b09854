"""Depth beyond the LiDAR's view: walls, dense completion, a user's maps, and what images refute."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from adapters.lidar_scene.dense_depth import FAR_M, KnownSurface, complete_depth
from adapters.lidar_scene.depth_maps import DepthMaps
from adapters.lidar_scene.sky_conflicts import measure_agreement, without_sky_splats
from adapters.lidar_scene.sky_edges import shorten_ends_in_sky, trim_at_sky
from adapters.lidar_scene.solid_views import SolidView
from adapters.lidar_scene.surfels import Surfels, gaussians_from_surfels
from adapters.lidar_scene.wall_planes import find_wall_planes
from adapters.raw_drive import DriveOptions
from augment.errors import AdapterError
from augment.photo.sky_matte import SkyMatte
from augment.reconstruct.view import ViewKey
from augment.scene.scene import Gaussians
from augment.scene.semantics import SemanticClass
from tests.adapters import drives

SIZE = (160, 120)
FOCAL_PX = 100.0
LIDAR_TOP_RAD = np.radians(10.0)
AWAY_M = 20.0
KEY = ViewKey(0, "front")
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0]])


def camera():
    return drives.camera(size=SIZE, focal_px=FOCAL_PX)


def wall_splats(points):
    gaussians = drives.flat_splats(points, 0.2)
    semantic = torch.full((len(points),), int(SemanticClass.BUILDING)).short()
    return dataclasses.replace(gaussians, semantic=semantic)


def test_a_wall_is_found_where_its_splats_stand():
    normal = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    tangent = np.array([-normal[1], normal[0], 0.0])
    along, height = (a.ravel() for a in np.meshgrid(np.arange(-8, 8, 0.2), np.arange(0, 4, 0.2)))
    points = AWAY_M * normal + along[:, None] * tangent + height[:, None] * [0, 0, 1.0]
    count = len(points)
    surfels = Surfels.discs(
        points, np.tile(normal, (count, 1)), np.tile(tangent, (count, 1)), np.full(count, 0.2)
    )
    semantic = np.full(count, int(SemanticClass.BUILDING), np.int16)
    colors = np.full((count, 3), 0.5, np.float32)
    walls = find_wall_planes(gaussians_from_surfels(surfels, colors, semantic))
    assert len(walls) == 1
    side = np.sign(walls.normals[0] @ normal[:2])
    np.testing.assert_allclose(side * walls.normals[0], normal[:2], atol=0.01)
    assert side * walls.offsets[0] == pytest.approx(AWAY_M, abs=0.05)
    assert walls.ends[0] - walls.starts[0] == pytest.approx(16, abs=0.5)
    # A ray along the normal meets it at its distance; one to its far end, further than the ends
    # reach, does not.
    beyond = AWAY_M * normal[:2] + 20 * tangent[:2]
    rays = np.stack([normal[:2], beyond / np.linalg.norm(beyond)])
    distances = walls.meet(0, np.zeros(2), rays, 1.0)
    assert distances[0] == pytest.approx(AWAY_M, abs=0.05)
    assert np.isinf(distances[1])


def exact_depth(view):
    """Depth of the plane x = AWAY_M in a camera that looks along x."""
    rays = view.ray_directions(torch.float64).numpy()
    centre = view.centre.numpy()
    return (AWAY_M - centre[0]) / rays[..., 0]


def solid_view(sky_rows: int, rgb=(120, 100, 90)):
    view = camera()
    photo = np.full((SIZE[1], SIZE[0], 3), rgb, np.uint8)
    share = np.zeros((SIZE[1], SIZE[0]), np.float32)
    share[:sky_rows] = 1
    lab = cv2.cvtColor(photo.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    matte = SkyMatte(share, photo, photo)
    return SolidView(view, photo, lab, matte, np.zeros(share.shape, np.bool_), KEY)


def test_a_wall_goes_on_straight_up_and_what_returned_nothing_is_far():
    view = solid_view(10)
    truth = exact_depth(view.camera)
    known_m = np.full(truth.shape, np.inf)
    known_m[45:, :80] = truth[45:, :80]  # the right half returned nothing at all
    semantic = np.full(truth.shape, int(SemanticClass.BUILDING), np.int16)
    known = KnownSurface(known_m, semantic, np.zeros(truth.shape, np.bool_))
    rgb = view.rgb.copy()
    rgb[:, 80:] = 220
    no_walls = find_wall_planes(wall_splats(np.zeros((1, 3))))
    depth = complete_depth(view.camera, rgb, view.matte.sky_share, known, no_walls, LIDAR_TOP_RAD)
    above = depth.depth_m[12:45, :70]
    # Straight up keeps the distance in plan: of a plane across the view, the depth.
    np.testing.assert_allclose(above, truth[12:45, :70], rtol=0.02)
    assert (depth.semantic[12:45, :70] == SemanticClass.BUILDING).all()
    # Within the LiDAR's view and away from all surfaces.
    assert depth.is_far[50:58, 100:].all()
    assert depth.depth_m[50:58, 100:].min() > 0.7 * FAR_M
    np.testing.assert_array_equal(depth.depth_m[45:, :80], truth[45:, :80])


def test_an_image_refutes_points_in_its_sky_and_before_its_surfaces():
    view = solid_view(40)
    view = dataclasses.replace(view, known_m=np.full((SIZE[1], SIZE[0]), AWAY_M))
    eye = view.camera.centre.numpy()
    rays = view.camera.ray_directions(torch.float64).numpy()
    wall = eye + AWAY_M * rays[80, 80]
    before = eye + 0.5 * AWAY_M * rays[80, 80]
    in_sky = eye + AWAY_M * rays[20, 80]
    same = view.lab[80, 80]
    other = same + np.float32(50)
    points = np.stack([wall, before, before, in_sky])
    agreement = measure_agreement(points, np.stack([same, same, other, same]), [view] * 2)
    assert agreement.conflicts.tolist() == [0, 0, 1, 1]
    assert agreement.has_support.tolist() == [True, True, False, False]
    splats = wall_splats(np.stack([wall, in_sky]))
    below_sky = without_sky_splats(splats, [view] * 2, max_conflicts=0.4)
    assert below_sky.means.numpy() == pytest.approx(wall[None], abs=1e-4)
    # One image is too few for a measured splat, and enough for a guessed one.
    assert len(without_sky_splats(splats, [view], max_conflicts=0.4)) == 2
    assert len(without_sky_splats(splats, [view], min_views=1, max_conflicts=0.4)) == 1


def upright_splat(point, width_m: float) -> Gaussians:
    """A round splat in the plane across the view along x."""
    scales = torch.tensor([[0.01, width_m, width_m]])
    return dataclasses.replace(wall_splats(point[None]), scales=scales, quats=UPRIGHT)


def test_a_splat_below_the_sky_line_is_shortened_upward_only():
    view = solid_view(40)
    rays = view.camera.ray_directions(torch.float64).numpy()
    point = view.camera.centre.numpy() + AWAY_M * rays[42, 80]
    pixel_m = AWAY_M / FOCAL_PX
    splat = upright_splat(point, 10 * pixel_m)
    _, aside_m, upward_m = trim_at_sky(splat, [view]).scales[0].tolist()
    assert aside_m == pytest.approx(10 * pixel_m)
    assert upward_m < 2.5 * pixel_m
    # A surface before the splat hides it, and with it whatever it reaches.
    hidden = dataclasses.replace(view, known_m=np.full((SIZE[1], SIZE[0]), AWAY_M / 2))
    assert trim_at_sky(splat, [hidden]).scales.equal(splat.scales)
    # Thin splats below the line do not reach it.
    thin = upright_splat(point, 0.5 * pixel_m)
    assert trim_at_sky(thin, [view]).scales.equal(thin.scales)


def test_a_splat_beside_the_image_is_shortened_where_its_end_lies_in_sky():
    view = solid_view(40)
    rays = view.camera.ray_directions(torch.float64).numpy()
    pixel_m = AWAY_M / FOCAL_PX
    left = np.array([0.0, 10 * pixel_m, 0.0])
    in_sky = view.camera.centre.numpy() + AWAY_M * rays[20, 0] + left
    splat = upright_splat(in_sky, 10 * pixel_m)
    _, aside_m, upward_m = shorten_ends_in_sky(splat, [view]).scales[0].tolist()
    assert aside_m == pytest.approx(5 * pixel_m)
    assert upward_m == pytest.approx(10 * pixel_m)
    below_sky = view.camera.centre.numpy() + AWAY_M * rays[60, 0] + left
    splat = upright_splat(below_sky, 10 * pixel_m)
    assert shorten_ends_in_sky(splat, [view]).scales.equal(splat.scales)


def write_map(folder: Path, values: np.ndarray, suffix: str) -> None:
    (folder / "front").mkdir(parents=True, exist_ok=True)
    if suffix == ".npy":
        np.save(folder / "front" / "0.npy", values)
    else:
        cv2.imwrite(str(folder / "front" / "0.png"), values)


@pytest.mark.parametrize("kind", ["", "relative:"])
def test_a_relative_map_is_aligned_to_known_depths(tmp_path, kind):
    depth_m = np.linspace(5, 60, SIZE[0] * SIZE[1]).reshape(SIZE[1], SIZE[0])
    write_map(tmp_path, (3.0 / depth_m + 0.2).astype(np.float32), ".npy")
    known_m = np.where(np.arange(SIZE[1])[:, None] > 60, depth_m, np.inf)
    maps = DepthMaps.find(f"{kind}{tmp_path}", {KEY: Path("images/0.jpg")})
    aligned = maps.read(KEY, camera(), known_m)
    assert aligned is not None
    np.testing.assert_allclose(aligned.depth_m, depth_m, rtol=1e-3)
    assert aligned.error < 1e-3


def test_a_metric_map_with_a_wrong_scale_is_aligned_as_well(tmp_path):
    depth_m = np.linspace(5, 60, SIZE[0] * SIZE[1]).reshape(SIZE[1], SIZE[0])
    write_map(tmp_path, (1.3 * depth_m * 256).astype(np.uint16), ".png")
    known_m = np.where(np.arange(SIZE[1])[:, None] > 60, depth_m, np.inf)
    maps = DepthMaps.find(str(tmp_path), {KEY: Path("images/0.jpg")})
    aligned = maps.read(KEY, camera(), known_m)
    assert aligned is not None
    np.testing.assert_allclose(aligned.depth_m, depth_m, rtol=2e-3)


def test_maps_that_are_missing_or_of_something_else_are_told(tmp_path):
    with pytest.raises(AdapterError, match="no such folder"):
        DepthMaps.find(str(tmp_path / "none"), {KEY: Path("images/0.jpg")})
    rng = np.random.default_rng(0)
    write_map(tmp_path, rng.random((SIZE[1], SIZE[0]), np.float32), ".npy")
    maps = DepthMaps.find(str(tmp_path), {KEY: Path("images/0.jpg")})
    known_m = np.full((SIZE[1], SIZE[0]), 10.0) + rng.random((SIZE[1], SIZE[0]))
    with pytest.raises(AdapterError, match="does not agree with the"):
        maps.read(KEY, camera(), known_m)
    assert maps.read(ViewKey(1, "front"), camera(), known_m) is None
    assert DriveOptions.from_query("pandaset", {"depth": "relative:x"}).depth == "relative:x"
