"""Recordings of COLMAP models: a street whose metres are known, in a model that knows none."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adapters.raw_drive import DriveOptions
from adapters.recording.adapter import back_project, read_recording
from adapters.recording.from_colmap import record_colmap
from augment.errors import AdapterError

pytest.importorskip("pycolmap")
KITTI = Path(__file__).parents[2] / "../shared/data/kitti_raw_seq/2011_09_26/image_02/data"
FRAMES, HEIGHT_M, STEP_M = 8, 1.5, 1.2
WIDTH, HEIGHT, FOCAL, RADIAL = 160, 100, 110.0, -0.08
# The model's world: another unit, turned and moved.
SCALE, TURN, SHIFT = 0.21, Rotation.from_euler("xyz", [100, -20, 65], degrees=True), [3.0, -1, 7]
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def world_from_camera(frame: int) -> np.ndarray:
    """Along x, nodding and turning a little, as a hand holds a phone."""
    wobble = Rotation.from_euler("zyx", [2.0 * frame, 3 - frame % 3, frame % 2], degrees=True)
    pose = np.eye(4)
    pose[:3, :3] = wobble.as_matrix() @ AHEAD
    pose[:3, 3] = [STEP_M * frame, 0.05 * frame**2, HEIGHT_M + 0.02 * (frame % 2)]
    return pose


def distorted(xy: np.ndarray) -> np.ndarray:
    """Pixels of directions x / z, y / z by COLMAP's SIMPLE_RADIAL."""
    factor = 1 + RADIAL * (xy**2).sum(-1, keepdims=True)
    return FOCAL * factor * xy + [WIDTH / 2, HEIGHT / 2]


def colours(xy: np.ndarray) -> np.ndarray:
    """What is seen along directions: a smooth picture, BGR 0 to 255."""
    return np.stack([128 + 150 * xy[..., 0], 128 + 200 * xy[..., 1], 100 + 0 * xy[..., 0]], -1)


def write_model(root: Path, *, frames: int = FRAMES, road: bool = True) -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-5, 30, 900), rng.uniform(-5, 5, 900), np.zeros(900)])
    walls = np.column_stack([rng.uniform(-5, 40, 600), 7 * rng.choice([-1, 1], 600),
                             rng.uniform(0.5, 6, 600)])  # fmt: skip
    points = np.concatenate([ground, walls]) if road else walls
    points = points + rng.normal(0, 0.005, points.shape)
    model = SCALE * TURN.apply(points) + SHIFT
    lines, tracks = [], [[] for _ in points]
    for frame in range(frames):
        pose = world_from_camera(frame)
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        uv = distorted(local[:, :2] / np.maximum(local[:, 2:], 1e-3))
        seen = np.flatnonzero((local[:, 2] > 1) & ((uv > 0) & (uv < [WIDTH, HEIGHT])).all(1))
        turn = pose[:3, :3].T @ TURN.as_matrix().T
        centre = SCALE * TURN.apply(pose[:3, 3]) + SHIFT
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        place = " ".join(map(repr, map(float, [w, x, y, z, *(-turn @ centre)])))
        lines.append(f"{frame + 1} {place} 1 {frame:06d}.jpg")
        lines.append(" ".join(f"{uv[i, 0]} {uv[i, 1]} {i + 1}" for i in seen))
        for number, i in enumerate(seen):
            tracks[i] += [frame + 1, number]
    sparse = root / "sparse/0"
    sparse.mkdir(parents=True)
    camera = f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} {RADIAL}\n"
    (sparse / "cameras.txt").write_text(camera)
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    rows = (
        f"{i + 1} {p[0]} {p[1]} {p[2]} 9 9 9 0.5 {' '.join(map(str, track))}\n"
        for i, (p, track) in enumerate(zip(model, tracks, strict=True))
        if track
    )
    (sparse / "points3D.txt").write_text("".join(rows))
    fine = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
    xy = cv2.undistortPoints(
        fine.reshape(-1, 1, 2),
        np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]),
        np.array([RADIAL, 0, 0, 0]),
    ).reshape(HEIGHT, WIDTH, 2)
    (root / "frames").mkdir()
    for frame in range(frames + 1):  # the last one was not registered
        image = np.clip(colours(xy), 0, 255).astype(np.uint8)
        path = str(root / "frames" / f"{frame:06d}.jpg")
        assert cv2.imwrite(path, image, [cv2.IMWRITE_JPEG_QUALITY, 100])


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("colmap")
    write_model(root)
    return root


def record(project: Path, out: Path, **options):
    return record_colmap(project, project / "frames", out, fps=5.0, **options)


def poses(out: Path) -> np.ndarray:
    frames = json.loads((out / "calibration.json").read_text())["frames"]
    return np.array([frame["cameras"]["camera"]["world_from_camera"] for frame in frames])


def test_a_cameras_height_gives_metres_and_the_road_says_what_is_level(project, tmp_path):
    out = tmp_path / "drive"
    made = record(project, out, camera_height_m=1.51)
    assert (made.frames, made.images, made.num_images_without_pose) == (FRAMES, FRAMES, 1)
    assert made.metres == pytest.approx(1 / SCALE, rel=0.01)
    found, known = poses(out), np.stack([world_from_camera(f) for f in range(FRAMES)])
    # The world begins under the first camera, which looks along x: it was turned by nothing.
    first = np.array([0.0, 0, HEIGHT_M])
    # Points stray by 5 mm, pixels of the model are exact: a path of 9 m is right to a centimetre.
    np.testing.assert_allclose(
        found[:, :3, 3] - found[0, :3, 3] + first, known[:, :3, 3], atol=0.02
    )
    np.testing.assert_allclose(found[:, :3, :3], known[:, :3, :3], atol=0.005)
    assert found[:, 2, 3] == pytest.approx(known[:, 2, 3], abs=0.02)
    calibration = json.loads((out / "calibration.json").read_text())
    assert calibration["has_metric_scale"] is True
    assert [f["timestamp_ns"] for f in calibration["frames"][:3]] == [0, 200_000_000, 400_000_000]


def test_images_lose_their_distortion_and_depth_lies_between_the_points(project, tmp_path):
    out = tmp_path / "drive"
    record(project, out, camera_height_m=1.51)
    drive, _ = read_recording(str(out), {}, DriveOptions.from_query("recording", {}))
    assert [p for p in drive.problems if "image" in p] == []
    camera = drive.frames[3].cameras["camera"]
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    xy = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)
    image = cv2.imread(drive.frames[3].image_paths["camera"])
    inner = (slice(3, -3), slice(3, -3))
    # JPEG twice, and bilinear sampling between levels: two or three of 255.
    assert np.abs(image[inner].astype(float) - colours(xy)[inner]).max() < 5
    steps = cv2.imread(str(out / "depth/camera/000003.png"), cv2.IMREAD_UNCHANGED)
    depth = steps / 256.0
    turned = np.dstack([xy, np.ones_like(u)]) @ camera.world_from_camera[:3, :3].numpy().T
    ground = -camera.centre[2].item() / np.minimum(turned[..., 2], -1e-3)
    near = (ground < 12) & (depth > 0)
    assert near.sum() > 1000
    # A lane of points every half a metre, on a plane that is right to a centimetre.
    error = np.abs(depth[near] / ground[near] - 1)
    assert np.median(error) < 0.01 and np.quantile(error, 0.9) < 0.05


def test_images_and_lens_are_kept_on_request(project, tmp_path):
    out = tmp_path / "drive"
    record(project, out, camera_height_m=1.51, keeps_lens=True)
    query = {"lens": "recorded"}
    drive, _ = read_recording(str(out), query, DriveOptions.from_query("recording", query))
    assert drive.recorded_frames is not None
    frame = drive.recorded_frames[3]
    camera = frame.cameras["camera"]
    source = project / "frames/000003.jpg"
    assert Path(frame.image_paths["camera"]).read_bytes() == source.read_bytes()
    xy = np.array([[0.3, -0.2], [-0.4, 0.1], [0.05, 0.25]])
    pixels, _ = camera.lens.project(np.column_stack([xy, np.ones(3)]), camera.intrinsics)
    np.testing.assert_allclose(pixels, distorted(xy), atol=1e-9)
    # The depth image has the lens of the image: points on the ground lie at the road's height.
    steps = cv2.imread(str(out / "depth/camera/000003.png"), cv2.IMREAD_UNCHANGED)
    points = back_project(steps / np.float32(256), camera).points
    near = points[(np.linalg.norm(points - camera.centre.numpy(), axis=1) < 12)]
    assert len(near) > 1000
    assert np.median(np.abs(near[:, 2])) < 0.03
    # The scene is made from undistorted copies, whose cameras are pinholes.
    assert drive.frames[3].cameras["camera"].is_pinhole


def test_a_radial_lens_without_distortion_keeps_its_images(tmp_path, monkeypatch):
    """As COLMAP is told by the guide: SIMPLE_RADIAL with its last number 0, and not refined."""
    monkeypatch.setattr(sys.modules[__name__], "RADIAL", 0.0)
    write_model(tmp_path / "plain")
    out = tmp_path / "out"
    record(tmp_path / "plain", out, camera_height_m=HEIGHT_M)
    for frame in range(FRAMES):
        recorded = tmp_path / f"plain/frames/{frame:06d}.jpg"
        assert (out / f"images/camera/{frame:06d}.jpg").read_bytes() == recorded.read_bytes()
    camera = json.loads((out / "calibration.json").read_text())["frames"][0]["cameras"]["camera"]
    expected = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL}
    assert expected.items() <= camera.items()
    assert (camera["cx"], camera["cy"]) == (WIDTH / 2, HEIGHT / 2)


@pytest.mark.long
@pytest.mark.skipif(not KITTI.is_dir(), reason="no KITTI frames here")
def test_four_frames_of_a_queue_are_refused(tmp_path):
    """0.6 m of KITTI, with poses as the guide has them made: the road has too few points."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions(
        camera_model="SIMPLE_RADIAL", camera_params="721.54,621,187.5,0"
    )
    database, images = tmp_path / "colmap.db", KITTI
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
    )
    pycolmap.match_sequential(database)
    options = pycolmap.IncrementalPipelineOptions()
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_tri_angle = 2.0
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    (tmp_path / "sparse").mkdir()
    pycolmap.incremental_mapping(database, images, tmp_path / "sparse", options)
    refused = "no road is seen|no road is clear|moved by|holds no COLMAP model"
    with pytest.raises(AdapterError, match=refused):
        record_colmap(tmp_path, images, tmp_path / "out", fps=10.0, camera_height_m=1.65)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["metres", "degrees"])
def test_positions_give_metres_and_north(project, tmp_path, kind):
    known = np.stack([world_from_camera(f)[:2, 3] for f in range(FRAMES)])
    north = Rotation.from_euler("z", 50, degrees=True).as_matrix()[:2, :2]
    east_north = known @ north.T
    rows = ["image,x,y"] + [f"{f:06d}.jpg,{x},{y}" for f, (x, y) in enumerate(east_north)]
    if kind == "degrees":
        degrees = np.degrees(east_north / 6_378_137.0)
        degrees[:, 0] /= np.cos(np.radians(48.0))
        rows = ["image,lat,lon"]
        rows += [
            f"{f:06d}.jpg,{48 + lat:.12f},{11 + lon:.12f}" for f, (lon, lat) in enumerate(degrees)
        ]
    (tmp_path / "gps.csv").write_text("\n".join(rows))
    made = record(project, tmp_path / "drive", positions=tmp_path / "gps.csv")
    assert made.metres == pytest.approx(1 / SCALE, rel=0.005)
    assert made.residual_m < 0.02
    found = poses(tmp_path / "drive")[:, :2, 3]
    np.testing.assert_allclose(found - found[0], east_north - east_north[0], atol=0.03)


def test_without_either_a_unit_is_no_metre(project, tmp_path):
    assert record(project, tmp_path / "drive").metres is None
    calibration = json.loads((tmp_path / "drive/calibration.json").read_text())
    assert calibration["has_metric_scale"] is False


def test_what_cannot_be_recorded_is_refused(project, tmp_path):
    write_model(tmp_path / "short", frames=3)
    write_model(tmp_path / "walls", road=False)
    write_model(tmp_path / "small")
    assert cv2.imwrite(str(tmp_path / "small/frames/000002.jpg"), np.zeros((9, 9, 3), np.uint8))
    (tmp_path / "few.csv").write_text("image,x,y\n000000.jpg,0,0\n")
    (tmp_path / "odd.csv").write_text("name,x,y\n000000.jpg,0,0\n")
    (tmp_path / "text.csv").write_text("image,x,y\n000000.jpg,here,0\n")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/a").write_text("")
    cases = {
        r"moved by 1\.6 of their height above the road": (tmp_path / "short", "a", None),
        r"no road is seen under the cameras: at most \d+ of": (tmp_path / "walls", "b", None),
        r"000002\.jpg is 9x9 pixels, the model's camera 160x100": (tmp_path / "small", "c", None),
        r"few\.csv gives positions of 1 of the 8 images": (project, "d", "few.csv"),
        r"odd\.csv must be a table with the columns": (project, "e", "odd.csv"),
        r"text\.csv, line 2: x, y must be numbers; got": (project, "f", "text.csv"),
        r"full is not empty": (project, "full", None),
        r"holds no COLMAP model": (tmp_path / "full", "g", None),
    }
    for message, (model, out, positions) in cases.items():
        table = None if positions is None else tmp_path / positions
        frames = model / "frames"
        with pytest.raises(AdapterError, match=message):
            record_colmap(model, frames, tmp_path / out, fps=5.0, positions=table)
