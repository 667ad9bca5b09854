"""Masks and checks on a real drive, without building its Gaussians."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from adapters.ego_masks import read_ego_masks
from adapters.pandaset.adapter import PandaSetLabels, read_frames
from adapters.raw_drive import DriveOptions
from adapters.training_views.checks import check_views
from adapters.training_views.views import RecordedViews
from augment.photo.own_car import own_car_mask
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from tests.adapters import drives


@pytest.fixture(scope="module")
def scene(shared_dir) -> Scene:
    root = shared_dir / "data/pandaset_mini/002"
    frames, _, origin, _ = read_frames(root, DriveOptions())
    return Scene(
        "002", "pandaset:002", drives.one_splat(), (), ConstantSky(torch.ones(3)), frames[::2],
        PandaSetLabels(root), origin,
    )  # fmt: skip


@pytest.mark.parametrize("frames", [slice(None), slice(0, 4), slice(6, 7)])
def test_the_own_car_is_found_where_hands_have_marked_it(scene, frames):
    """The back camera alone sees it: in a drive, in a clip of 0.5 m and in a single image."""
    scene = dataclasses.replace(scene, frames=scene.frames[frames])
    cameras = scene.frames[0].cameras
    marks = read_ego_masks(Path(__file__).parents[1] / "data/own_car", cameras)
    assert list(marks) == ["back_camera"]
    for name, camera in cameras.items():
        mask = own_car_mask(scene, camera)
        assert (mask is not None) == (name in marks), name
    mask, mark = own_car_mask(scene, cameras["back_camera"]), marks["back_camera"]
    # Hands are some pixels off an edge of three.
    assert mask is not None and (mask & mark).sum() / mark.sum() > 0.995
    assert (mask & mark).sum() / mask.sum() > 0.992
    assert np.median(np.abs(mask.argmax(axis=0) - mark.argmax(axis=0))) <= 2


def test_only_the_back_camera_sees_the_own_car(scene):
    views = RecordedViews(scene, scale=0.25)
    assert list(views.ego_masks) == ["back_camera"]
    mask = views.ego_masks["back_camera"]
    # The roof's highest point was read off the images: 0.763 of the height.
    assert mask.any(axis=1).argmax() / len(mask) == pytest.approx(0.763, abs=0.006)
    assert mask[-1].all() and (mask[1:] >= mask[:-1]).all()
    assert views.problems == ()


@pytest.mark.long
def test_its_calibration_is_right_and_a_turned_camera_is_noticed(scene):
    few = dataclasses.replace(scene, frames=scene.frames[::2])
    cameras = ["front_camera", "right_camera", "left_camera"]
    checks = check_views(few, RecordedViews(few, scale=0.25, cameras=cameras))
    assert checks.problems == () and len(checks.offsets) == 3
    # Images show the world some 20 ms before their stamps: half a rolling shutter, it seems.
    assert -0.03 < checks.time_offset_s < -0.01

    def turned(camera):
        a = math.radians(0.5)
        yaw = torch.eye(4, dtype=torch.float64)
        yaw[[0, 0, 2, 2], [0, 2, 0, 2]] = torch.tensor(
            [math.cos(a), math.sin(a), -math.sin(a), math.cos(a)], dtype=torch.float64
        )
        return dataclasses.replace(camera, camera_from_world=yaw @ camera.camera_from_world)

    frames = tuple(
        dataclasses.replace(
            frame, cameras={**frame.cameras, "front_camera": turned(frame.cameras["front_camera"])}
        )
        for frame in few.frames
    )
    wrong = dataclasses.replace(few, frames=frames)
    said = check_views(wrong, RecordedViews(wrong, scale=0.25, cameras=cameras[:2])).problems
    assert len(said) == 1, said
    assert said[0].startswith("camera front_camera: its images lie 0.")
