"""Pixels of the recording car, and how high the LiDAR looks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from adapters.ego_masks import read_ego_mask
from adapters.training_views.views import RecordedViews
from augment.errors import AdapterError
from augment.photo.lidar_view import lidar_top_rad
from augment.photo.own_car import find_own_car_mask, moving_frames, own_car_mask
from augment.reconstruct.view import ViewKey
from augment.scene.cameras import Frame
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from tests.adapters import drives
from tests.scenes import one_gaussian

SIZE = (160, 120)


def wall_scene(tmp_path, top_m: float, *, sweeps=None):
    """A wall 20 m ahead, left of the middle up to top_m, right of it up to 2 m."""
    y, z = np.meshgrid(np.arange(-20, 20, 0.25), np.arange(0, 20, 0.25))
    wall = np.stack([np.full(y.size, 20.0), y.ravel(), z.ravel()], 1)
    height = np.where(wall[:, 1] > 0, top_m, 2.0)
    wall = wall[wall[:, 2] < height]
    return drives.drive(
        tmp_path,
        1,
        cameras=lambda f: {"front": drives.camera(size=SIZE, focal_px=100.0)},
        background=drives.flat_splats(wall, 0.15),
        sweeps=sweeps,
    )


def test_the_lidars_highest_view_is_measured(tmp_path):
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-180, 180, 2.0)), np.radians(np.linspace(-20, 15, 64))
    )
    ray = np.stack(
        [np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], -1
    ).reshape(-1, 3)  # fmt: skip
    points = np.array([0, 0, 1.5]) + 30 * ray
    stray = np.array([[12.0, 0, 30]])
    scene = wall_scene(tmp_path, 8.0, sweeps={0: np.concatenate([points, stray])})
    assert np.degrees(lidar_top_rad(scene, [0])) == pytest.approx(15, abs=0.6)  # a channel
    for few in ({0: points[:100]}, None):  # nothing is sure then
        scene = wall_scene(tmp_path, 8.0, sweeps=few)
        assert lidar_top_rad(scene, [0]) is None
        assert not RecordedViews(scene, scale=1.0).load(ViewKey(0, "front")).sky.any()


def road_texture() -> np.ndarray:
    """Grey values of a rough road, 5 cm a cell, for 60 m x 40 m; with a kerb along the drive."""
    rng = np.random.default_rng(1)
    rough = cv2.GaussianBlur(rng.uniform(0, 255, (1200, 800)).astype(np.float32), (0, 0), 2)
    rough = np.clip((rough - 127) * 1.5 + 90, 0, 255)  # deviates by 15 levels, as asphalt does
    rough[:, 300:303] = 250
    return rough


ROAD = road_texture()


def road_picture(camera, car_rows: np.ndarray | None, *, lead_car: bool = False) -> np.ndarray:
    """The road at z = 0 and a bright sky; below car_rows [W] a smooth bonnet."""
    if camera.width == SIZE[0]:  # several rays a pixel, as a lens takes them
        rows = None if car_rows is None else np.repeat(4 * np.asarray(car_rows), 4)
        fine = road_picture(camera.scaled(4.0), rows, lead_car=lead_car)
        return cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)
    rays = camera.ray_directions().double().numpy()
    grey = np.full(rays.shape[:2], 220.0)
    down = rays[..., 2] < -1e-3
    along = camera.centre[2].item() / -rays[down][:, 2]
    points = camera.centre.numpy() + along[:, None] * rays[down]
    x = np.clip((points[:, 0] * 20).astype(int), 0, len(ROAD) - 1)
    y = np.clip(((points[:, 1] + 20) * 20).astype(int), 0, ROAD.shape[1] - 1)
    grey[down] = ROAD[x, y]
    if lead_car:  # always twelve metres ahead
        grey[248:288, 240:400] = 30
    rows = np.arange(camera.height)[:, None]
    if car_rows is not None:
        body = 180 - 0.1 * rows + 0.02 * np.arange(camera.width)
        grey = np.where(rows >= car_rows, body, grey)
    return np.repeat(grey[..., None], 3, 2).clip(0, 255).astype(np.uint8)


def drive_pictures(*, rotation=drives.AHEAD, frames=12, step_m=0.6, **what):
    cameras = [
        drives.camera(
            "a", f, size=SIZE, focal_px=80.0, position=(step_m * f, 0, 1.6), rotation=rotation
        )
        for f in range(frames)
    ]
    return cameras, [road_picture(camera, **what) for camera in cameras]


def test_a_bonnet_is_found_where_it_is():
    rows = 95 - 8 * np.sin(np.linspace(0, np.pi, 160))
    cameras, pictures = drive_pictures(car_rows=rows)
    mask = find_own_car_mask(cameras, pictures)
    top = np.where(mask.any(axis=0), mask.argmax(axis=0), 120)
    # The window that evidence is averaged in reaches four pixels over the edge, less two.
    assert np.abs(top - rows).max() < 4 and np.abs(np.median(top - rows)) < 2.5


def test_nothing_is_found_where_the_car_is_not_seen(monkeypatch):
    for rotation in (drives.AHEAD, drives.LEFT):
        assert not find_own_car_mask(*drive_pictures(car_rows=None, rotation=rotation)).any()
    # A smooth road, and a car ahead that always keeps its distance.
    monkeypatch.setitem(globals(), "ROAD", np.full_like(ROAD, 100))
    assert not find_own_car_mask(*drive_pictures(car_rows=None, lead_car=True)).any()


@pytest.mark.parametrize("missing", [0, 8])
def test_a_scene_tells_the_recording_car_in_its_photos_at_any_size(tmp_path, missing):
    """Of twelve images; fewer than six tell nothing."""
    cameras, pictures = drive_pictures(car_rows=np.full(160, 90))
    frames = []
    for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        large, path = camera.scaled(4.0), tmp_path / f"{i}.png"
        if i >= missing:
            cv2.imwrite(str(path), cv2.resize(picture, (large.width, large.height)))
        pose = torch.eye(4, dtype=torch.float64)
        frames.append(Frame(i, camera.timestamp_ns, pose, {"a": large}, {"a": str(path)}))
    scene = Scene("s", "test:", one_gaussian(), (), ConstantSky(torch.zeros(3)), tuple(frames))
    whole = frames[3].cameras["a"]
    mask = own_car_mask(scene, whole.scaled(0.5))
    if missing:
        assert mask is None
        return
    assert mask is not None and mask.shape == (240, 320)
    assert np.abs(mask.argmax(axis=0) - 180).max() < 8 and mask[-1].all()
    window = own_car_mask(scene, whole.cropped(100, 200, 300, 280))
    assert window is not None and np.abs(window.argmax(axis=0) - 160).max() < 16


def test_frames_are_taken_where_the_car_moved():
    def standing(count: int, step_m: float):
        return [drives.camera("a", f, position=(step_m * f, 0, 1.6)) for f in range(count)]

    assert moving_frames(standing(20, 0.0)) == list(range(20))  # all alike: the edge has to tell
    assert moving_frames(standing(8, 0.13)) == list(range(8))  # a short clip, in shorter steps
    chosen = moving_frames(standing(100, 0.2))
    assert len(chosen) == 24 and chosen == sorted(set(chosen))
    assert not find_own_car_mask(*drive_pictures(frames=1, car_rows=np.full(160, 90))).any()
    assert find_own_car_mask([], []).shape == (0, 0)


@pytest.fixture
def bonnet_drive(tmp_path):
    rows = np.full(160, 96)

    def cameras(frame):
        position = (0.6 * frame, 0, 1.6)
        return {"front": drives.camera("front", frame, size=SIZE, focal_px=80.0, position=position)}

    x, y = np.meshgrid(np.arange(2, 30, 0.3), np.arange(-8, 8, 0.3))
    floor = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    return drives.drive(
        tmp_path / "images", 12, cameras=cameras, speed_mps=6.0,
        picture=lambda camera, number: road_picture(camera, rows),
        sweeps={frame: floor + np.array([0.6 * frame, 0, 0]) for frame in range(12)},
    )  # fmt: skip


def test_views_know_the_own_car(bonnet_drive):
    views = RecordedViews(bonnet_drive, scale=1.0)
    mask = views.ego_masks["front"]
    assert mask[100:].all() and not mask[:92].any()
    view = views.load(views.train[0])
    assert (view.weight == 1).all() and len(view.depth_pixels) > 100
    # The floor behind the bonnet is not seen.
    assert not mask.reshape(-1)[view.depth_pixels].any()


def test_images_that_differ_by_a_few_rows_share_a_mask(bonnet_drive):
    def cut(frame):
        """The frame without up to four of its lowest rows."""
        camera = frame.cameras["front"]
        height = camera.height - 2 * (frame.index % 3)
        path = Path(frame.image_paths["front"])
        drives.paint(path, cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)[:height])
        camera = camera.cropped(0, 0, camera.width, height)
        return dataclasses.replace(frame, cameras={"front": camera})

    whole = RecordedViews(bonnet_drive, scale=1.0).ego_masks["front"]
    drive = dataclasses.replace(bonnet_drive, frames=tuple(map(cut, bonnet_drive.frames)))
    views = RecordedViews(drive, scale=1.0)
    assert (views.ego_masks["front"] != whole).mean() < 0.03
    for key in views.train:
        mask = views.own_car(key)
        assert mask.shape == (120 - 2 * (key.frame % 3), 160)
        assert mask[102:].all() and not mask[:90].any()
        assert not mask.reshape(-1)[views.load(key).depth_pixels].any()


def test_masks_from_files(bonnet_drive, tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    with pytest.raises(AdapterError, match=r"holds no mask; expected .*front\.png"):
        RecordedViews(bonnet_drive, scale=0.5, masks_dir=folder)
    mask = np.zeros((240, 320), np.uint8)
    mask[200:, :160] = 255
    cv2.imwrite(str(folder / "front.png"), mask)
    views = RecordedViews(bonnet_drive, scale=0.5, masks_dir=folder)
    wanted = np.zeros((60, 80), bool)
    wanted[50:, :40] = True
    np.testing.assert_array_equal(views.ego_masks["front"], wanted)
    cv2.imwrite(str(folder / "front.png"), mask[:, :200])
    with pytest.raises(AdapterError, match="proportions"):
        read_ego_mask(folder / "front.png", bonnet_drive.frame(0).cameras["front"])
    (folder / "front.png").write_bytes(b"?")
    with pytest.raises(AdapterError, match="cannot be decoded"):
        RecordedViews(bonnet_drive, scale=0.5, masks_dir=folder)
