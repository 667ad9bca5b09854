"""Scenes with the lenses of their datasets: conventions of numbers, images, and what is written."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.kitti.adapter import open_kitti
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from tests.adapters import kitti_files as kitti

QUERY = {"voxel_m": "0.2", "image_scale": "1", "sky_size": "32"}
# Level of a picture's noise: JPEG of quality 95 at hard edges, and one pixel beside an edge.
MAX_MEDIAN_LEVELS = 3.0


def colours_through(camera: Camera, image: np.ndarray, colours) -> np.ndarray:
    """Return the differences of an image, BGR, from what is seen along the camera's rays."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([u, v], -1)
    if camera.lens is None:
        rays = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1
        )
    else:
        rays, is_inside = camera.lens.rays(pixels, camera.intrinsics)
        assert is_inside.all()
    pose = camera.world_from_camera.numpy()
    expected = colours(pose[:3, 3], rays @ pose[:3, :3].T)
    return np.abs(image[..., ::-1].astype(float) - expected).max(-1)


# ---- KITTI's release before rectification --------------------------------------------------------


@pytest.fixture(scope="module")
def extract(tmp_path_factory) -> Path:
    day = tmp_path_factory.mktemp("kitti-extract") / "2011_09_26"
    return kitti.write_as_kitti_extract(day)


@pytest.fixture(scope="module")
def kitti_scene(extract: Path) -> Scene:
    return open_kitti(str(extract), QUERY | {"lens": "recorded"})


def kitti_colours(scene: Scene, moment: float):
    """Return the colours of the street along rays in the scene's world."""
    world = kitti.world_from_street()
    world[:3, 3] -= scene.world_origin_m

    def colours(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        street = np.linalg.inv(world)
        return kitti.colour_at(
            street[:3, :3] @ origin + street[:3, 3], rays @ street[:3, :3].T, moment
        )

    return colours


def test_kittis_unrectified_cameras_have_k_d_r_t_and_project_as_opencv(kitti_scene: Scene):
    for frame in kitti_scene.frames:
        camera = frame.cameras["image_02"]
        assert (camera.width, camera.height) == kitti.LENS_SIZE
        assert camera.timestamp_ns == kitti.START_NS + 100_000_000 * frame.index + 30_000_000
        # Points of the sweep through the files' numbers, by OpenCV alone.
        world = kitti_scene.lidar(frame.index).points_m - kitti_scene.world_origin_m
        origin = kitti.world_from_street()
        origin[:3, 3] -= kitti_scene.world_origin_m
        moment = frame.index + kitti.IMAGE_OFFSET_MS / 100
        camera_from_world = kitti.unrectified_from_velo() @ np.linalg.inv(
            origin @ kitti.street_from_velo(moment)
        )
        local = world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        radius = np.hypot(local[:, 0], local[:, 1]) / local[:, 2]
        local = local[(local[:, 2] > 2) & (radius < 1)]
        expected, _ = cv2.projectPoints(
            local.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), kitti.LENS_K, kitti.LENS_D
        )
        turned = local @ camera_from_world[:3, :3] - (
            camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
        )
        pose = camera.camera_from_world.numpy()
        assert camera.lens is not None
        pixels, is_inside = camera.lens.project(
            turned @ pose[:3, :3].T + pose[:3, 3], camera.intrinsics
        )
        assert len(local) > 500 and is_inside.all()
        # Poses have 2 micrometres of rounding in the files; OpenCV's whole numbers are centres.
        np.testing.assert_allclose(pixels - 0.5, expected.reshape(-1, 2), atol=1e-3)


def test_kittis_recorded_photos_show_the_street_through_the_lens(kitti_scene: Scene, extract: Path):
    for frame, seen in zip(kitti_scene.frames, kitti_scene.seen_frames, strict=True):
        path = Path(frame.image_paths["image_02"])
        assert path.parent == extract / "image_02/data"
        assert path.stem == f"{frame.index + kitti.IMAGE_LEAD:010d}"
        colours = kitti_colours(kitti_scene, frame.index + kitti.IMAGE_OFFSET_MS / 100)
        recorded = cv2.imread(str(path))
        difference = colours_through(frame.cameras["image_02"], recorded, colours)
        assert (difference > 2).mean() < 0.005  # poses' rounding at edges
        copy = decoded(seen.image_paths["image_02"])
        pinhole = seen.cameras["image_02"]
        assert pinhole.is_pinhole and pinhole.timestamp_ns == frame.cameras["image_02"].timestamp_ns
        difference = colours_through(pinhole, copy, colours)
        assert np.median(difference) <= MAX_MEDIAN_LEVELS
        assert (difference > 25).mean() < 0.06  # pixels at hard edges


def decoded(path: str) -> np.ndarray:
    """Return the pixels of an image that may not be written yet, BGR."""
    from augment.files.recorded_images import decode_image, has_image

    assert has_image(Path(path))
    image = decode_image(Path(path), cv2.IMREAD_COLOR)
    assert image is not None
    return image


def test_kittis_unrectified_images_are_undistorted_by_default(extract: Path, kitti_scene: Scene):
    scene = open_kitti(str(extract), QUERY)
    assert scene.seen_frames is None
    assert [p for p in scene.problems if "lens=recorded keeps the lenses" in p]
    assert not [p for p in kitti_scene.problems if "lens=recorded" in p]
    for frame, seen in zip(scene.frames, kitti_scene.seen_frames, strict=True):
        assert frame.image_paths == seen.image_paths
        camera = frame.cameras["image_02"]
        assert camera.is_pinhole
        assert camera.intrinsics == seen.cameras["image_02"].intrinsics
    # The Gaussians do not depend on the option.
    assert scene.background.means.equal(kitti_scene.background.means)
    assert scene.background.sh.equal(kitti_scene.background.sh)


def test_rectified_images_have_no_lens_and_say_so(tmp_path: Path):
    drive = kitti.write_as_kitti(tmp_path / "2011_09_26")
    scene = open_kitti(str(drive), QUERY | {"lens": "recorded"})
    assert scene.seen_frames is None
    assert scene.frames[0].cameras["image_02"].is_pinhole
    assert [p for p in scene.problems if "lens=recorded changes nothing" in p]
