"""Scenes with the lenses of their datasets: conventions of numbers, images, and what is written."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from adapters.base import open_scene
from adapters.camera_files.camera_files import read_views
from adapters.camera_files.lenses import colmap_lens, nerfstudio_lens
from adapters.camera_files.paths import with_camera_path
from adapters.ego_masks import with_ego_masks
from adapters.kitti.adapter import open_kitti
from adapters.pandaset.adapter import read_pandaset
from adapters.raw_drive import DriveOptions, RawDrive
from adapters.recorded_lenses import undistorted_scene, with_lenses_of
from adapters.recording.files import read_calibration
from adapters.street_gaussians.adapter import open_raw
from adapters.waymo.adapter import WaymoOptions, read_waymo
from augment.dataset import SceneDataset, boxes_2d
from augment.errors import AdapterError
from augment.files.lens_records import lens_record, shutter_record
from augment.files.recorded_images import decode_image, has_image
from augment.files.scene_file import read_saved_scene, save_scene_file, scene_document
from augment.output.calibration import frame_entry, read_camera, trajectory_id
from augment.scene.boxes import WorldBoxes, outline_world_boxes
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rotmat_from_quat
from augment.scene.lenses import FisheyeLens, FThetaLens, Intrinsics, OpenCVLens
from augment.scene.scene import Gaussians, Scene
from augment.scene.shutter import RollingShutter
from augment.scene.sky import ConstantSky
from augment.view.render_view import render_view
from recipes.schema import Recipe, Render
from tests.adapters import drivestudio_files as drivestudio
from tests.adapters import kitti_files as kitti
from tests.adapters import pandaset_files as pandaset
from tests.adapters import street_gaussians_files as street_gaussians
from tests.adapters import waymo_files as waymo

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


# ---- Waymo: lens and rolling shutter -------------------------------------------------------------

WAYMO_STAMPS = waymo.stamps_of(3, 2)


@pytest.fixture(scope="module")
def waymo_drive(tmp_path_factory) -> RawDrive:
    root = waymo.write_as_waymo(tmp_path_factory.mktemp("waymo"))
    query = {"lens": "recorded"}
    return read_waymo(str(root), query, WaymoOptions.from_query("waymo", query))


def test_waymos_lenses_project_as_opencv_at_the_middle_of_the_read_out(waymo_drive: RawDrive):
    assert waymo_drive.recorded_frames is not None
    rng = np.random.default_rng(0)
    for frame, stamp in zip(waymo_drive.recorded_frames, WAYMO_STAMPS, strict=True):
        for n, name in enumerate(waymo.CAMERA_NAMES):
            middle = stamp + waymo.MIDDLES_S[n]
            camera = frame.cameras[name]
            assert abs(camera.timestamp_ns * 1e-9 - waymo.T0 - middle) < 2e-6
            pose = waymo.car_pose(middle) @ waymo.camera_extrinsic(n)
            local = np.column_stack(
                [rng.uniform(3, 40, 50), rng.uniform(-0.4, 0.4, 50), rng.uniform(-0.25, 0.25, 50)]
            )
            local[:, 1:] *= local[:, :1]
            points = local @ pose[:3, :3].T + pose[:3, 3]
            u, v, _ = waymo.pixels_of(waymo.Rig(), n, middle, points)
            camera_from_world = camera.camera_from_world.numpy()
            seen = (points - waymo_drive.world_origin_m) @ camera_from_world[:3, :3].T
            assert camera.lens is not None
            pixels, is_inside = camera.lens.project(
                seen + camera_from_world[:3, 3], camera.intrinsics
            )
            assert is_inside.all()
            # Going on with a velocity over 4 ms of a bend at 1 m/s2 leaves 8 micrometres.
            np.testing.assert_allclose(pixels, np.column_stack([u, v]), atol=2e-3)


def test_waymos_columns_are_read_from_left_to_right_while_the_car_drives(waymo_drive: RawDrive):
    assert waymo_drive.recorded_frames is not None
    for frame, stamp in zip(waymo_drive.recorded_frames, WAYMO_STAMPS, strict=True):
        for n, name in enumerate(waymo.CAMERA_NAMES):
            camera = frame.cameras[name]
            shutter = camera.shutter
            assert shutter is not None and shutter.read_out == "left_to_right"
            assert shutter.duration_ns == pytest.approx(waymo.READOUT_S * 1e9, abs=2000)
            for share in (0.0, 0.25, 1.0):
                moved = camera.at_read_out(share)
                offset_s = (share - 0.5) * waymo.READOUT_S
                pose = waymo.car_pose(stamp + waymo.MIDDLES_S[n] + offset_s)
                pose = pose @ waymo.camera_extrinsic(n)
                # Axes of the dataset's cameras are x out of the lens, y left, z up.
                turned = pose[:3, :3] @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
                # The velocity is constant here, over 22 ms of a bend at 1 m/s2: 0.25 mm.
                centre = moved.centre.numpy() + waymo_drive.world_origin_m
                np.testing.assert_allclose(centre, pose[:3, 3], atol=5e-4)
                np.testing.assert_allclose(
                    moved.world_from_camera[:3, :3].numpy(), turned, atol=1e-4
                )
                assert moved.timestamp_ns - camera.timestamp_ns == pytest.approx(
                    offset_s * 1e9, abs=2000
                )


def test_waymos_recorded_images_keep_their_bytes(waymo_drive: RawDrive):
    assert waymo_drive.recorded_frames is not None
    root = waymo_drive.labels.segment.files.path("camera_image")
    recorded = {bytes(v.as_py()) for v in pq.read_table(root)["[CameraImageComponent].image"]}
    files = set()
    for frame, undistorted in zip(waymo_drive.recorded_frames, waymo_drive.frames, strict=True):
        for name, path in frame.image_paths.items():
            decoded(path)
            files.add(Path(path).read_bytes())
            assert path != undistorted.image_paths[name]
            assert undistorted.cameras[name].is_pinhole
    assert files <= recorded and len(files) == 5 * len(waymo_drive.frames)
    assert not [p for p in waymo_drive.problems if "without their lens distortion" in p]


# ---- COLMAP, nerfstudio, camera paths ------------------------------------------------------------

COLMAP_MODELS = {
    "SIMPLE_RADIAL": (400.0, 321.0, 239.0, -0.11),
    "RADIAL": (400.0, 321.0, 239.0, -0.11, 0.03),
    "OPENCV": (400.0, 410.0, 321.0, 239.0, -0.11, 0.03, 0.002, -0.003),
    "FULL_OPENCV": (400.0, 410.0, 321.0, 239.0, -0.11, 0.03, 0.002, -0.003, 0.01, 0.02, 0.03, 0.01),
    "OPENCV_FISHEYE": (300.0, 310.0, 321.0, 239.0, -0.04, 0.01, 0.002, -0.001),
    "SIMPLE_RADIAL_FISHEYE": (300.0, 321.0, 239.0, -0.04),
    "RADIAL_FISHEYE": (300.0, 321.0, 239.0, -0.04, 0.01),
}


@pytest.mark.parametrize("model", COLMAP_MODELS)
def test_colmaps_lenses_project_as_colmap(model: str):
    pycolmap = pytest.importorskip("pycolmap")
    numbers = COLMAP_MODELS[model]
    camera = pycolmap.Camera(model=model, width=640, height=480, params=numbers)
    lens = colmap_lens(camera)
    assert lens is not None
    intrinsics = Intrinsics(
        camera.focal_length_x,
        camera.focal_length_y,
        camera.principal_point_x,
        camera.principal_point_y,
    )
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.7, 0.7, (200, 2)), np.ones(200)])
    pixels, is_inside = lens.project(points, intrinsics)
    assert is_inside.all()
    np.testing.assert_allclose(pixels, camera.img_from_cam(points), atol=1e-9)


def test_nerfstudios_lenses_project_as_opencv_and_a_k4_is_none():
    coefficients = {"k1": -0.1, "k2": 0.03, "p1": 0.002, "p2": -0.003, "k3": 0.01, "k4": 0.0}
    lens = nerfstudio_lens("OPENCV", coefficients)
    assert lens is not None
    points = np.column_stack([np.random.default_rng(1).uniform(-0.7, 0.7, (50, 2)), np.ones(50)])
    matrix = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    order = [coefficients[name] for name in ("k1", "k2", "p1", "p2", "k3")]
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(order))
    pixels, _ = lens.project(points, Intrinsics(500.0, 510.0, 320.0, 240.0))
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)
    assert nerfstudio_lens("OPENCV", coefficients | {"k4": 0.1}) is None
    assert nerfstudio_lens("OPENCV", dict.fromkeys(coefficients, 0.0)) is None


# ---- What is written is read back ----------------------------------------------------------------

LENSES = {
    "opencv": OpenCVLens.from_coefficients(
        [-0.37, 0.2, 1e-3, 6e-4, -0.07, 0.1, 0.0, 0.0, 0.0, 1e-4]
    ),
    "fisheye": FisheyeLens((-0.04, 0.01, 1 / 3, -0.001), 1.7),
    "ftheta": FThetaLens(
        (0.0, 473.6, -9.6, 24.9),
        (0.0, 0.0021, 1.4e-7),
        "angle_to_distance",
        1.34,
        (0.9997, 6e-5, -1e-4),
    ),
    "pinhole": None,
}


def lens_camera(name: str) -> Camera:
    """Return a camera with the lens of this name, a pose of many digits, and a shutter."""
    pose = torch.from_numpy(kitti.unrectified_from_velo())
    later = pose.clone()
    later[:3, 3] += 1 / 7
    shutter = RollingShutter.between(
        pose, later, read_out="top_to_bottom", duration_ns=30_000_000, camera_from_world=pose
    )
    return Camera(
        "front",
        *(960, 740, 473.6, 471.1, 478.3, 371.9),
        camera_from_world=pose,
        timestamp_ns=12,
        lens=LENSES[name],
        shutter=None if name == "pinhole" else shutter,
    )


def assert_same_optics(camera: Camera, expected: Camera) -> None:
    assert camera.lens == expected.lens
    assert camera.intrinsics == expected.intrinsics
    assert (camera.shutter is None) == (expected.shutter is None)
    if camera.shutter is not None and expected.shutter is not None:
        assert camera.shutter.start_from_camera.equal(expected.shutter.start_from_camera)
        assert camera.shutter.end_from_camera.equal(expected.shutter.end_from_camera)
        for name in ("read_out", "duration_ns", "first_share", "last_share"):
            assert getattr(camera.shutter, name) == getattr(expected.shutter, name)


@pytest.mark.parametrize("name", LENSES)
def test_calibrations_hold_lens_and_shutter_to_the_bit(name: str, tmp_path: Path):
    camera = lens_camera(name)
    frame = Frame(3, 12, torch.eye(4, dtype=torch.float64), {"front": camera})
    entry = frame_entry(frame, ["front"], 0.5, np.array([100.0, 0, 0]))
    record = read_camera(json.loads(json.dumps(entry)), "front")
    assert_same_optics(record.camera, camera.scaled(0.5))
    assert ("lens" in entry["cameras"]["front"]) == (name != "pinhole")
    # A recording of this calibration has the same camera.
    calibration = {"frames": [entry]}
    (tmp_path / "calibration.json").write_text(json.dumps(calibration))
    (recorded,) = read_calibration(tmp_path).frames
    assert_same_optics(recorded.cameras["front"], camera.scaled(0.5))


@pytest.mark.parametrize("name", LENSES)
def test_scene_files_and_camera_paths_hold_lens_and_shutter(name: str, tmp_path: Path):
    camera = lens_camera(name)
    frame = Frame(3, 12, torch.eye(4, dtype=torch.float64), {"front": camera})
    scene = kitti_like_scene((frame,))
    save_scene_file(scene, tmp_path / "a.climategs")
    (stored,) = read_saved_scene(tmp_path / "a.climategs").scene.frames
    assert_same_optics(stored.cameras["front"], camera)
    text = json.dumps(scene_document(scene))
    assert ('"lens"' in text) == ('"shutter"' in text) == (name != "pinhole")
    content = {
        **{"width": 960, "height": 740, **camera.intrinsics._asdict()},
        "frames": [
            {
                "camera": "front",
                "world_from_camera": camera.world_from_camera.tolist(),
                **({"shutter": shutter_record(camera.shutter)} if camera.shutter else {}),
            }
        ],
        **({"lens": lens_record(camera.lens)} if camera.lens else {}),
    }
    (tmp_path / "path.json").write_text(json.dumps(content))
    (path_frame,) = with_camera_path(scene, tmp_path / "path.json").frames
    assert_same_optics(path_frame.cameras["front"], camera)


def test_the_identity_of_a_camera_path_depends_on_its_lens():
    ids = {
        trajectory_id(
            [Frame(3, 12, torch.eye(4, dtype=torch.float64), {"front": lens_camera(name)})]
        )
        for name in LENSES
    }
    assert len(ids) == len(LENSES)


WRONG_LENSES = {
    "an unknown model": ({"model": "brown"}, "brown"),
    "an unknown coefficient": ({"model": "opencv", "k9": 1.0}, "k9"),
    "no number": ({"model": "opencv", "k1": "0.1"}, "k1"),
    "not finite": ({"model": "opencv", "k1": float("nan")}, "k1"),
    "an angle beyond the sphere": ({"model": "opencv_fisheye", "max_angle_rad": 4.0}, "max_angle"),
    "no polynomial": ({"model": "ftheta"}, "angle_to_distance"),
    "no object": ([1.0, 2.0], "lens"),
}


@pytest.mark.parametrize("wrong", WRONG_LENSES)
def test_wrong_lenses_are_refused_in_words(wrong: str, tmp_path: Path):
    content, word = WRONG_LENSES[wrong]
    path = {"width": 64, "height": 48, "fx": 40.0, "lens": content}
    entry = {"camera": "front", "position": [0, 0, 1], "look_at": [9, 0, 1]}
    (tmp_path / "path.json").write_text(json.dumps({**path, "frames": [entry]}))
    with pytest.raises(AdapterError, match=word):
        read_views(tmp_path / "path.json")


def kitti_like_scene(frames: tuple[Frame, ...]) -> Scene:
    """Return a scene of one splat with these frames."""
    one = Gaussians(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.ones(1, 3),
        opacities=torch.ones(1),
        sh=torch.zeros(1, 1, 3),
    )
    sky = ConstantSky(torch.zeros(3))
    return Scene("a", "kitti:a", one, (), sky, frames)


# ---- Processed data of other projects ------------------------------------------------------------


def test_a_drivestudio_run_keeps_lenses_that_its_training_took_out(tmp_path: Path):
    numbers = drivestudio.write_as_drivestudio(tmp_path / "kept")
    scene = open_scene(f"drivestudio:{numbers.folder}?lens=recorded&frames=3:5")
    plain = open_scene(f"drivestudio:{numbers.folder}?frames=3:5")
    lens = OpenCVLens.from_coefficients([float(k) for k in drivestudio.DISTORTION])
    assert scene.seen_frames is not None
    for frame, pinholes, expected in zip(
        scene.frames, scene.seen_frames, plain.frames, strict=True
    ):
        for name, camera in frame.cameras.items():
            assert camera.lens == lens
            assert camera.intrinsics == expected.cameras[name].intrinsics
            assert camera.camera_from_world.equal(expected.cameras[name].camera_from_world)
            assert pinholes.cameras[name].is_pinhole
        assert frame.image_paths == expected.image_paths
    assert scene.background.means.equal(plain.background.means)


def test_a_drivestudio_run_on_distorted_images_has_no_lens_and_says_so(tmp_path: Path):
    changes = {"data.pixel_source.undistort": False}
    numbers = drivestudio.write_as_drivestudio(tmp_path / "distorted", config=changes)
    scene = open_scene(f"drivestudio:{numbers.folder}?lens=recorded&frames=3:4")
    assert scene.seen_frames is None
    assert all(camera.is_pinhole for camera in scene.frames[0].cameras.values())
    assert [p for p in scene.problems if "lens=recorded changes nothing" in p]


def test_a_street_gaussians_dataset_keeps_its_lenses(tmp_path: Path):
    street_gaussians.write_as_street_gaussians(tmp_path / "data", frames=2, cameras=1)
    scene = open_raw(tmp_path / "data", QUERY | {"lens": "recorded"})
    (camera,) = scene.frames[0].cameras.values()
    assert camera.lens == OpenCVLens.from_coefficients([0.04, -0.34, 0.001, -0.0003, 0.0])
    assert Path(scene.frames[0].image_paths[camera.name]).parent == tmp_path / "data/images"
    assert scene.seen_frames is not None
    assert scene.seen_frames[0].cameras[camera.name].is_pinhole


def test_published_images_without_lenses_change_nothing_and_say_so(tmp_path: Path):
    root = pandaset.write_as_pandaset(tmp_path / "001")
    query = {"lens": "recorded"}
    drive = read_pandaset(str(root), query, DriveOptions.from_query("pandaset", query))
    assert drive.recorded_frames is None
    assert [p for p in drive.problems if "PandaSet's images show no lens distortion" in p]
    with pytest.raises(AdapterError, match="lens must be one of undistorted, recorded; got 'raw'"):
        DriveOptions.from_query("pandaset", {"lens": "raw"})


# ---- The recording car, fits, samples ------------------------------------------------------------


def test_masks_of_the_recording_car_are_of_the_images_as_recorded(
    kitti_scene: Scene, tmp_path: Path
):
    """A mask of what lies straight below the lens's middle is that of the copies' pixels there."""
    width, height = kitti.LENS_SIZE
    mask = np.zeros((height, width), np.uint8)
    mask[height - 20 :] = 255
    assert cv2.imwrite(str(tmp_path / "image_02.png"), mask)
    scene = with_ego_masks(kitti_scene, tmp_path)
    assert scene.ego_masks is not None and scene.seen_frames is not None
    copy = scene.seen_frames[0].cameras["image_02"]
    lens_camera = scene.frames[0].cameras["image_02"]
    rows, columns = np.mgrid[: copy.height, : copy.width] + 0.5
    rays = np.stack(
        [(columns - copy.cx) / copy.fx, (rows - copy.cy) / copy.fy, np.ones_like(rows)], -1
    )
    assert lens_camera.lens is not None
    pixels, _ = lens_camera.lens.project(rays, lens_camera.intrinsics)
    expected = pixels[..., 1] > height - 20
    is_at_border = np.abs(pixels[..., 1] - (height - 20)) < 1
    stated = scene.ego_masks["image_02"]
    np.testing.assert_array_equal(stated[~is_at_border], expected[~is_at_border])


def test_a_fit_learns_from_copies_and_keeps_lenses_at_its_poses(kitti_scene: Scene):
    start = undistorted_scene(kitti_scene)
    assert start.seen_frames is None
    assert all(c.is_pinhole for f in start.frames for c in f.cameras.values())

    def moved(frame: Frame) -> Frame:
        cameras = {}
        for name, camera in frame.cameras.items():
            pose = camera.camera_from_world.clone()
            pose[0, 3] += 0.01
            cameras[name] = dataclasses.replace(camera, camera_from_world=pose)
        return dataclasses.replace(frame, cameras=cameras)

    fitted = dataclasses.replace(start, frames=tuple(map(moved, start.frames)))
    scene = with_lenses_of(fitted, kitti_scene.frames)
    assert scene.seen_frames == fitted.frames
    for frame, recorded, corrected in zip(
        scene.frames, kitti_scene.frames, fitted.frames, strict=True
    ):
        camera = frame.cameras["image_02"]
        assert camera.lens == recorded.cameras["image_02"].lens
        assert frame.image_paths == recorded.image_paths
        pose = corrected.cameras["image_02"].camera_from_world
        assert camera.camera_from_world.equal(pose)


def test_samples_of_cameras_with_lenses_refuse_projections_of_pinholes(kitti_scene: Scene):
    recipe = Recipe(name="clear")
    (sample, *_) = SceneDataset(kitti_scene, recipe)
    camera = sample["camera"]
    assert camera["lens"] == lens_record(kitti_scene.frames[0].cameras["image_02"].lens)
    assert camera["shutter"] is None
    boxes = {
        "centers_m": torch.zeros(1, 3),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "sizes_m": torch.ones(1, 3),
        "labels": ["Car"],
        "track_ids": ["a"],
        "frame": "world",
    }
    with pytest.raises(ValueError, match="has a lens or a rolling shutter"):
        boxes_2d({**sample, "boxes": boxes})


# ---- Pictures ------------------------------------------------------------------------------------


def test_the_recorded_photo_comes_back_without_weather(kitti_scene: Scene):
    recipe = Recipe(name="photo", render=Render(base="recorded"))
    for frame in kitti_scene.frames:
        camera = frame.cameras["image_02"]
        view = render_view(kitti_scene, camera, recipe)
        recorded = cv2.imread(frame.image_paths["image_02"])
        assert recorded is not None
        np.testing.assert_array_equal(view.rgb, recorded[..., ::-1])


def test_boxes_are_within_a_pixel_of_their_edges_by_opencv(waymo_drive: RawDrive):
    assert waymo_drive.recorded_frames is not None
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    pairs = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]
    share = np.linspace(0, 1, 200)[:, None]
    num_compared = 0
    for frame, stamp in zip(waymo_drive.recorded_frames, WAYMO_STAMPS, strict=True):
        boxes = waymo_drive.labels.boxes(frame.index)
        for n, name in enumerate(waymo.CAMERA_NAMES):
            camera = dataclasses.replace(frame.cameras[name], shutter=None)
            outlines = outline_world_boxes(
                WorldBoxes.from_labels(boxes, waymo_drive.world_origin_m), camera
            )
            for k, centre in enumerate(boxes.centers_m):
                rotation = rotmat_from_quat(torch.from_numpy(boxes.quats[k])).numpy()
                places = corners * boxes.sizes_m[k] @ rotation.T + centre
                edges = np.concatenate(
                    [places[a] + share * (places[b] - places[a]) for a, b in pairs]
                )
                u, v, is_inside = waymo.pixels_of(waymo.Rig(), n, stamp + waymo.MIDDLES_S[n], edges)
                if not is_inside.all():  # cut by the image's border
                    continue
                expected = np.array([u.min(), v.min(), u.max(), v.max()])
                assert outlines.in_view[k]
                np.testing.assert_allclose(outlines.xyxy[k], expected, atol=1.0)
                num_compared += 1
    assert num_compared >= 2
