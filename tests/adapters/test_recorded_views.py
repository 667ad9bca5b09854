"""Recorded drives as views to learn from."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.plain_files import ImageFault
from adapters.training_views.views import RecordedViews, holdout_step
from augment.errors import AdapterError
from augment.files.recorded_images import read_scaled
from augment.reconstruct.view import ViewKey
from tests.adapters import drives


def rig(frame):
    x = 0.8 * frame
    return {
        "front": drives.camera("front", frame, position=(x, 0, 1.5)),
        "left": drives.camera("left", frame, position=(x, 0, 1.5), rotation=drives.LEFT),
    }


def returns() -> np.ndarray:
    """A floor from 3 to 30 m."""
    x, y = np.meshgrid(np.arange(3, 30, 0.5), np.arange(-8, 8, 0.5))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


@pytest.fixture
def scene(tmp_path):
    sweeps = {frame: returns() for frame in range(4)}
    return drives.drive(tmp_path / "images", 4, cameras=rig, sweeps=sweeps)


def test_a_view_holds_image_camera_and_depth(scene):
    views = RecordedViews(scene, scale=0.5)
    assert [(k.frame, k.camera) for k in views.train[:3]] == [
        (0, "front"),
        (0, "left"),
        (1, "front"),
    ]
    assert views.test == () and len(views.train) == 8
    key = ViewKey(2, "front")
    view = views.load(key)
    camera = views.camera(key)
    assert view.camera is camera and (camera.width, camera.height) == (32, 24)
    assert camera.timestamp_ns == scene.frame(2).cameras["front"].timestamp_ns
    # Each pixel is the mean of four of the recorded ones: 4 x + 1, 6 y + 1.5, and one level.
    assert view.rgb[:, :, 0].tolist() == [[4 * x + 1 for x in range(32)]] * 24
    assert np.abs(view.rgb[:, 0, 1] - (6 * np.arange(24) + 1.5)).max() <= 0.5
    assert (view.rgb[..., 2] == 40).all() and (view.weight == 1).all()
    rows = view.depth_pixels // 32
    assert (
        len(rows) > 50 and (np.diff(view.depth_pixels) > 0).all() and (view.depth_weight == 1).all()
    )
    # The floor is 1.5 m below the camera: z = fy 1.5 / (v - cy), within the pixel's own rows.
    low, high = 20 * 1.5 / (rows + 1 - 12), 20 * 1.5 / np.maximum(rows - 12, 1e-9)
    assert (view.depth_m >= low - 1e-3).all() and (view.depth_m <= high + 1e-3).all()


def test_two_sources_give_the_same_bits_whatever_the_memory(scene):
    big, small = (RecordedViews(scene, scale=0.4, cache_bytes=size) for size in (1 << 30, 0))
    for key in (*big.train, *reversed(big.train)):
        a, b = big.load(key), small.load(key)
        for name in ("rgb", "weight", "sky", "depth_pixels", "depth_m", "depth_weight"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_frames_are_held_out_by_position(scene):
    views = RecordedViews(scene, scale=0.5, holdout="every-2nd", cameras=["left"])
    assert [k.frame for k in views.train] == [0, 2] and [k.frame for k in views.test] == [1, 3]
    assert {k.camera for k in views.test} == {"left"}
    views = RecordedViews(scene, scale=0.5, holdout="every-3rd")
    assert sorted({k.frame for k in views.test}) == [2]
    assert not any("held out" in p for p in views.problems)


def test_holdout_words():
    assert holdout_step("none") is None and holdout_step("every-8th") == 8
    for bad in ("every-1st", "every-0th", "every", "every-2", "2", "", "every-2nd "):
        with pytest.raises(AdapterError, match="every-Nth"):
            holdout_step(bad)


def test_one_camera_and_one_frame_work(tmp_path):
    one = drives.drive(tmp_path, 1)
    views = RecordedViews(one, scale=1.0, holdout="every-2nd")
    assert views.train == (ViewKey(0, "front"),) and views.test == ()
    text = " ".join(views.problems)
    assert "nothing is held out" in text and "no depth priors" in text and "no sky masks" in text
    view = views.load(views.train[0])
    assert len(view.depth_pixels) == 0 and not view.sky.any()
    np.testing.assert_array_equal(view.rgb, drives.plain(view.camera, 0))


def test_unusable_images_are_left_out_and_named(scene):
    paths = [scene.frame(f).image_paths["left"] for f in range(3)]
    Path(paths[0]).unlink()
    Path(paths[1]).write_bytes(b"no picture")
    drives.paint(Path(paths[2]), np.zeros((48, 60, 3), np.uint8))
    views = RecordedViews(scene, scale=0.5)
    assert [k.frame for k in views.train if k.camera == "left"] == [3]
    assert len(views.train) == 5
    said = views.problems
    assert f"camera left, frame 0: image {paths[0]} does not exist; left out" in said
    assert f"camera left, frame 1: image {paths[1]} cannot be decoded; left out" in said
    assert (
        f"camera left, frame 2: image {paths[2]} is of 60x48 pixels; its camera is of 64x48; "
        f"left out" in said
    )
    with pytest.raises(AdapterError, match=r"camera 'left' in frame 1"):
        views.load(ViewKey(1, "left"))


def test_no_usable_image_says_what_to_do(scene):
    for frame in scene.frames:
        for path in frame.image_paths.values():
            os.truncate(path, 10)
    with pytest.raises(AdapterError, match=r"no usable recorded image.*First: camera front"):
        RecordedViews(scene, scale=0.5)


def test_an_image_that_vanishes_later_is_an_error_that_names_it(scene):
    views = RecordedViews(scene, scale=0.5, cache_bytes=0)
    Path(scene.frame(1).image_paths["front"]).unlink()
    with pytest.raises(AdapterError, match=r"camera front, frame 1: .* does not exist; it could"):
        views.load(ViewKey(1, "front"))


def test_wrong_arguments(scene):
    with pytest.raises(AdapterError, match=r"no camera 'rear'; it has front, left"):
        RecordedViews(scene, scale=0.5, cameras=["front", "rear"])
    with pytest.raises(AdapterError, match="has no camera named"):
        RecordedViews(scene, scale=0.5, cameras=[])
    for scale in (0, 1.5, float("nan")):
        with pytest.raises(ValueError, match="scale"):
            RecordedViews(scene, scale=scale)


def test_jpegs_are_reduced_by_area(tmp_path):
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (128, 96))
    path = Path(drives.paint(tmp_path / "a.jpg", smooth))
    full = drives.camera(size=(128, 96))
    for scale in (1.0, 0.5, 0.3, 0.25, 0.125):
        scaled = full.scaled(scale)
        got = read_scaled(path, full, scaled).astype(int)
        wanted = cv2.resize(smooth, (scaled.width, scaled.height), interpolation=cv2.INTER_AREA)
        # The JPEG's own error; a shift of half a pixel would cost several levels on average.
        assert np.abs(got - wanted).mean() < 1.5


def test_a_jpeg_that_is_cut_short_is_no_image(tmp_path):
    path = Path(drives.paint(tmp_path / "a.jpg", np.full((96, 128, 3), 90, np.uint8)))
    path.write_bytes(path.read_bytes()[:-20])
    full = drives.camera(size=(128, 96))
    with pytest.raises(ImageFault, match="is cut short"):
        read_scaled(path, full, full)
