"""Depth priors: what the camera sees of the LiDAR's returns, and depth maps from folders."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.lidar_scene.depth import DepthPixels, read_returns
from adapters.training_views.depth_priors import (
    DepthPriors,
    align,
    find_maps,
    find_sparse,
    is_visible_return,
    join_priors,
    read_relative,
)
from adapters.training_views.views import RecordedViews
from augment.errors import AdapterError
from augment.reconstruct.view import ViewKey
from tests.adapters import drives

BOX_LOW, BOX_HIGH, WALL_X = np.array([8.0, -2, 0]), np.array([10.0, 2, 2.2]), 20.0
KEY = ViewKey(0, "front")


def entry(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """How far along rays the box begins; infinite where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (BOX_LOW - origin) / ray, (BOX_HIGH - origin) / ray
    enter, leave = np.fmin(a, b).max(-1), np.fmax(a, b).min(-1)
    return np.where((enter > 0) & (enter < leave), enter, np.inf)


def sweep(origin: np.ndarray) -> np.ndarray:
    """Returns of a LiDAR on a box 8 m ahead and a wall 20 m ahead, float64 [N, 3]."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-30, 30, 0.2)), np.radians(np.arange(-12, 14, 0.4))
    )
    ray = np.stack([np.ones_like(azimuth), np.tan(azimuth), np.tan(elevation)], -1).reshape(-1, 3)
    along = np.minimum(entry(origin, ray), WALL_X)
    return origin + along[:, None] * ray


def test_returns_that_a_nearer_object_hides_from_the_camera_are_dropped(tmp_path):
    # The LiDAR looks over the box at a part of the wall that the box hides from the camera.
    points = sweep(np.array([0, 0, 2.6]))
    cam = drives.camera(size=(240, 160), focal_px=200.0)
    scene = drives.drive(tmp_path, 1, cameras=lambda f: {"front": cam}, sweeps={0: points})
    seen = read_returns(scene, 0).seen_by(cam)
    kept = is_visible_return(seen, cam)
    rays = cam.ray_directions().double().numpy().reshape(-1, 3)[seen.pixels]
    hidden = entry(cam.centre.numpy(), rays) < seen.depth_m - 2.5  # behind the box, not its roof
    assert hidden.sum() > 300 and (~hidden).sum() > 5000
    # Hidden returns in the last row below the box's edge have nearer ones on one side only.
    assert (~kept[hidden]).mean() > 0.9
    assert kept[~hidden].mean() > 0.99


def test_slopes_poles_and_edges_hide_nothing():
    cam = drives.camera(size=(240, 160), focal_px=200.0)
    v, u = np.mgrid[90:160:2, 0:240:2]
    floor = 200.0 * 1.5 / (v - 80.0 + 0.5)  # 30 m to 4 m
    wall = np.full((40, 120), 30.0)
    wall[:, 60] = 6.0  # a pole before a wall
    wall[:, 90:] = 12.0  # the corner of a house
    depth = np.concatenate([wall, np.minimum(floor, wall[:1])]).astype(np.float32)
    rows, columns = np.mgrid[10:90:2, 0:240:2]
    pixels = np.concatenate([rows, v]) * 240 + np.concatenate([columns, u])
    seen = DepthPixels.of(pixels.ravel(), depth.ravel())
    kept = is_visible_return(seen, cam).reshape(depth.shape)
    # Only far floor beside the pole or the house may go: it has nearer floor below it too.
    assert set(np.nonzero(~kept)[1]) <= {58, 59, 61, 62, 88, 89} and kept.mean() > 0.99
    assert kept[:39].all()
    assert len(is_visible_return(DepthPixels.of(np.zeros(0, int), np.zeros(0)), cam)) == 0


def test_the_first_prior_of_a_pixel_is_believed_and_the_nearest_of_one_prior():
    a = DepthPixels.of(np.array([7, 3, 7]), np.array([5.0, 2.0, 4.0]))
    assert a.pixels.tolist() == [3, 7] and a.depth_m.tolist() == [2, 4]
    b = DepthPixels.of(np.array([1, 7]), np.array([9.0, 9.0]), 0.5)
    both = join_priors([a, b])
    assert both.pixels.tolist() == [1, 3, 7] and both.depth_m.tolist() == [9, 2, 4]
    assert both.weight.tolist() == [0.5, 1, 1] and both.pixels.dtype == np.int32


def test_alignment_survives_outliers_and_refuses_what_does_not_agree():
    rng = np.random.default_rng(0)
    depth = rng.uniform(3, 60, 2000).astype(np.float32)
    relative = (1 / depth - 0.02) * 750 + rng.normal(0, 0.5, 2000)
    relative[:400] = rng.uniform(0, 250, 400)  # a fifth says nothing
    found = align(relative.astype(np.float32), depth)
    assert found.scale == pytest.approx(1 / 750, rel=0.02)
    assert found.shift == pytest.approx(0.02, abs=0.0005)
    assert np.isnan(found.depth_m(np.array([-1e6, 1e6]))).all()
    assert align(depth, depth) is None  # depth, not inverse depth
    for useless in (rng.normal(size=2000), np.ones(2000), np.full(2000, np.nan)):
        assert align(useless, depth) is None
    assert align(1 / depth[:20], depth[:20]) is None


def floor_returns() -> np.ndarray:
    x, y = np.meshgrid(np.arange(3, 30, 0.5), np.arange(-8, 8, 0.5))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def floor_depth(cam) -> np.ndarray:
    """What the camera sees of the ground, metres [H, W]; 0 above the horizon."""
    below = np.arange(cam.height) + 0.5 - cam.cy
    column = np.where(below > 0, cam.fy * 1.5 / np.maximum(below, 1e-9), 0)
    return np.tile(column[:, None], (1, cam.width)).astype(np.float32)


@pytest.fixture
def scene(tmp_path):
    return drives.drive(tmp_path / "images", 2, speed_mps=0, sweeps={0: floor_returns()})


@pytest.mark.parametrize("kind", ["npy", "png"])
def test_relative_depth_is_aligned_to_the_lidar(scene, tmp_path, kind):
    folder = tmp_path / "relative" / "front"
    folder.mkdir(parents=True)
    depth = floor_depth(drives.camera())
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0)
    relative = 3000 * inverse + 100
    if kind == "npy":
        np.save(folder / "000.npy", relative.astype(np.float32))
    else:
        cv2.imwrite(str(folder / "000.png"), relative.astype(np.uint16))
    options = DepthPriors(relative_dir=folder.parent)
    views = RecordedViews(scene, scale=1.0, depth=options)
    view = views.load(KEY)
    mono = view.depth_weight < 1
    assert mono.sum() > 10 and (view.depth_weight[mono] == np.float32(0.1)).all()
    truth = depth.ravel()[view.depth_pixels[mono]]
    # Returns fall anywhere in their pixel: up to a row away, which is 0.017 / m of inverse depth.
    assert np.abs(1 / view.depth_m[mono] - 1 / truth).max() < 0.017
    assert any("no relative depth for 1 of 2 images, first camera front, frame 1" in p
               for p in views.problems)  # fmt: skip


def test_relative_depth_without_lidar_takes_given_distances(tmp_path):
    scene = drives.drive(tmp_path / "images", 1)
    cam = drives.camera()
    depth = floor_depth(cam)
    folder = tmp_path / "relative" / "front"
    folder.mkdir(parents=True)
    np.save(folder / "0.npy", np.where(depth > 0, 7 / np.maximum(depth, 1e-6), 0))
    options = DepthPriors(relative_dir=folder.parent)
    view = RecordedViews(
        scene, scale=1.0, depth=options, reference_depth=lambda key, camera: depth
    ).load(KEY)
    truth = depth.ravel()[view.depth_pixels]
    assert len(truth) > 50
    np.testing.assert_allclose(view.depth_m, truth, rtol=1e-3)  # exact but for float32
    views = RecordedViews(scene, scale=1.0, depth=options)
    assert len(views.load(KEY).depth_pixels) == 0
    assert any("0 known distances" in p and "frame 0" in p for p in views.problems)


def test_metric_depth_is_read_as_climategs_writes_it(tmp_path):
    scene = drives.drive(tmp_path / "images", 1)
    folder = tmp_path / "depth" / "front"
    folder.mkdir(parents=True)
    depth = floor_depth(drives.camera())
    cv2.imwrite(str(folder / "000000.png"), np.round(depth * 256).astype(np.uint16))
    options = DepthPriors(metric_dir=folder.parent)
    view = RecordedViews(scene, scale=0.5, depth=options).load(KEY)
    rows, columns = view.depth_pixels // 32, view.depth_pixels % 32
    assert sorted(set(columns % 4)) == [2] and (view.depth_weight == 1).all()
    truth = depth[2 * rows + 1, 2 * columns + 1]
    np.testing.assert_allclose(view.depth_m, truth, atol=1 / 512 + 1e-6)  # half a level
    assert rows.min() >= 12  # nothing above the horizon


def test_sparse_depth_of_street_gaussians(tmp_path):
    scene = drives.drive(tmp_path / "images", 2)
    folder = tmp_path / "lidar_depth"
    folder.mkdir()
    mask = np.zeros((48, 64), bool)
    mask[[10, 10, 11, 47], [20, 21, 20, 63]] = True
    value = np.array([9.0, 8.0, 7.0, 3.0], np.float32)
    np.save(folder / "000000_0.npy", {"mask": mask, "value": value})
    np.save(folder / "000001_front.npy", {"mask": mask, "value": value})
    views = RecordedViews(scene, scale=0.5, depth=DepthPriors(sparse_dir=folder))
    assert len(views.problems) == 1
    for frame in (0, 1):
        view = views.load(ViewKey(frame, "front"))
        assert view.depth_pixels.tolist() == [5 * 32 + 10, 23 * 32 + 31]
        assert view.depth_m.tolist() == [7, 3]


class Attack:
    def __reduce__(self):
        return (eval, ("1/0",))


def test_hostile_and_damaged_depth_files_are_refused_and_named(tmp_path):
    scene = drives.drive(tmp_path / "images", 4)
    folder = tmp_path / "lidar_depth"
    folder.mkdir()
    np.save(folder / "000000_0.npy", {"mask": Attack()}, allow_pickle=True)
    (folder / "000001_0.npy").write_bytes(b"\x93NUMPY\x01\x00")
    mask = np.ones((48, 64), bool)
    np.save(folder / "000002_0.npy", {"mask": mask, "value": np.ones(5)})
    np.save(folder / "000003_0.npy", {"mask": mask.T, "value": np.ones(mask.size)})
    views = RecordedViews(scene, scale=0.5, depth=DepthPriors(sparse_dir=folder))
    for key in views.train:
        assert len(views.load(key).depth_pixels) == 0
    said = [p for p in views.problems if "its depth is left out" in p]
    assert [p.split(":")[0] for p in said] == [f"camera front, frame {f}" for f in range(4)]
    for text, sentence in zip(
        ("asks for builtins.eval", "damaged", "'value' must hold", "of 48x64 pixels"),
        said,
        strict=True,
    ):
        assert text in sentence


def test_relative_files_that_are_no_inverse_depth(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((4, 4, 3)))
    with pytest.raises(AdapterError, match="not colours"):
        read_relative(path)
    np.save(path, {"a": 1})
    with pytest.raises(AdapterError, match="no readable array"):
        read_relative(path)
    np.save(path, np.array([[[1.0, np.inf]]]))
    assert np.isnan(read_relative(path)).tolist() == [[False, True]]
    png = Path(drives.paint(tmp_path / "a.png", np.full((3, 4, 3), 7, np.uint8)))
    assert (read_relative(png) == 7).all()
    png.write_bytes(b"x")
    with pytest.raises(AdapterError, match="cannot be decoded"):
        read_relative(png)


def test_maps_are_found_by_image_name_or_frame_number(tmp_path):
    keys = [ViewKey(3, "front"), ViewKey(4, "front")]
    folder = tmp_path / "front"
    folder.mkdir()
    for name in ("000003.png", "img_a.png", "img_b.png", "notes.txt"):
        (folder / name).touch()
    stems = {keys[0]: "img_a", keys[1]: "img_b"}
    by_name = find_maps(tmp_path, keys, stems, {".png"})
    assert [by_name[k].name for k in keys] == ["img_a.png", "img_b.png"]
    by_number = find_maps(tmp_path, keys, {}, {".png"})
    assert {k.frame: p.name for k, p in by_number.items()} == {3: "000003.png"}
    for missing in (tmp_path / "nowhere",):
        with pytest.raises(AdapterError, match="no such folder"):
            find_maps(missing, keys, {}, {".png"})
        with pytest.raises(AdapterError, match="no such folder"):
            find_sparse(missing, keys, ["front"])
