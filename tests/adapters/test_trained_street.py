"""The procedural street in the files of trained models looks as it does without them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from street_models import (
    NAMES,
    SELECTED,
    STEP_S,
    WAYMO_NAMES,
    DrivestudioRun,
    StreetGaussiansRun,
    ego,
    picture,
    street_of,
    write_drivestudio,
    write_street_gaussians,
)

from adapters.base import open_scene
from augment.ground import ground_of
from augment.scene import Scene
from augment.semantics import SemanticClass
from augment.views import render_view
from recipes.schema import Recipe
from tests.streets import open_street

MIN_DB = 55.0
FLIPS = 0.002  # share of pixels on the other side of a threshold of the rasteriser


@pytest.fixture(scope="module")
def street():
    return street_of(open_street())


@pytest.fixture(scope="module")
def street_gaussians(tmp_path_factory, street) -> tuple[StreetGaussiansRun, Scene]:
    run = write_street_gaussians(tmp_path_factory.mktemp("street_gaussians"), street)
    return run, open_scene(f"street_gaussians:{run.model}")


@pytest.fixture(scope="module")
def drivestudio(tmp_path_factory, street) -> tuple[DrivestudioRun, Scene]:
    run = write_drivestudio(tmp_path_factory.mktemp("drivestudio"), street)
    return run, open_scene(f"drivestudio:{run.folder}")


def shown(scene: Scene, frame: int, name: str) -> np.ndarray:
    return render_view(scene, scene.frame(frame).cameras[name], Recipe()).rgb


def decibels(actual: np.ndarray, expected: np.ndarray) -> float:
    """PSNR of all pixels but a few."""
    assert actual.shape == expected.shape
    error = np.sort(((actual.astype(np.float64) - expected) ** 2).mean(-1).ravel())
    kept = error[: int(len(error) * (1 - FLIPS))]
    return 10 * np.log10(255**2 / max(kept.mean(), 1e-9))


# The second shows an object after the last frame in which it is tracked.
VIEWS = [(1, 0), (4, 1), (2, 3), (3, 2), (6, 0)]


@pytest.mark.parametrize(("frame", "cam"), VIEWS)
def test_street_gaussians(street_gaussians, street, frame, cam) -> None:
    run, scene = street_gaussians
    expected = picture(street, run.shot(frame, cam), cam)
    assert decibels(shown(scene, frame, NAMES[cam]), expected) > MIN_DB


@pytest.mark.parametrize(("frame", "cam"), VIEWS)
def test_drivestudio(drivestudio, frame, cam) -> None:
    run, scene = drivestudio
    expected = picture(run.street, run.shot(frame, cam), cam)
    assert decibels(shown(scene, frame, WAYMO_NAMES[cam]), expected) > MIN_DB


def test_a_point_cloud_shows_the_poses_of_the_track_file(street_gaussians, street) -> None:
    run, _ = street_gaussians
    scene = open_scene(f"street_gaussians:{run.model}?weights=ply")
    dark = dataclasses.replace(street, sky=np.zeros_like)
    expected = picture(dark, run.shot(2, 0, corrected=False), 0)
    assert decibels(shown(scene, 2, "FRONT"), expected) > MIN_DB


def test_pictures_tell_what_would_be_wrong(street_gaussians, street) -> None:
    """Each thing that a model says of an image changes it by more than the tests above allow."""
    run, scene = street_gaussians
    rgb, shot = shown(scene, 4, "FRONT"), run.shot(4, 0)
    turning = street.movers[7]
    assert abs(turning.rate) * (len(SELECTED) - 1) * STEP_S > np.radians(60)
    # Colours that turn with the car, instead of staying with the world.
    turn = Rotation.from_matrix(shot.poses[7][:3, :3]).as_matrix()
    x, y, z = turn @ np.stack([
        -turning.splats.rest[:, 2], -turning.splats.rest[:, 0], turning.splats.rest[:, 1]
    ], axis=1).transpose(1, 0, 2).reshape(3, -1)  # fmt: skip
    rest = np.stack([v.reshape(-1, 3) for v in (-y, z, -x)], 1)
    turned = dataclasses.replace(turning, splats=dataclasses.replace(turning.splats, rest=rest))
    raw = run.shot(4, 0, corrected=False)
    for other, wrong in (
        (dataclasses.replace(street, movers={**street.movers, 7: turned}), shot),
        (street, dataclasses.replace(shot, phases=dict.fromkeys(shot.phases, 0.0))),
        (street, dataclasses.replace(shot, poses=raw.poses)),
        (street, dataclasses.replace(shot, affine=None)),
        (dataclasses.replace(street, sky=lambda d: street.sky(d * [1, 1, -1])), shot),
    ):
        assert decibels(rgb, picture(other, wrong, 0)) < MIN_DB - 10


def test_the_world_is_as_level_as_the_dataset_says(street_gaussians, drivestudio) -> None:
    """Though the car stands on a slope where drivestudio's own world begins: water would run."""
    for _, scene in (street_gaussians, drivestudio):
        tilts = [scene.frame(f).world_from_ego[2, :3].numpy() for f in SELECTED]
        np.testing.assert_allclose(tilts, [ego(f * STEP_S)[2, :3] for f in SELECTED], atol=1e-9)
        heights = [float(scene.frame(f).world_from_ego[2, 3]) for f in SELECTED]
        rises = [ego(f * STEP_S)[2, 3] - ego(STEP_S)[2, 3] for f in SELECTED]
        np.testing.assert_allclose(np.array(heights) - heights[0], rises, atol=1e-9)


def test_the_road_is_found(street_gaussians, drivestudio) -> None:
    """There are neither LiDAR nor classes to tell it."""
    road_m = open_street().ground_z_m
    for _, scene in (street_gaussians, drivestudio):
        lift = float(scene.frame(1).world_from_ego[2, 3]) - ego(STEP_S)[2, 3]
        assert abs(ground_of(scene).median_z_m - (road_m + lift)) < 0.06


def test_objects_are_what_their_labels_say(street_gaussians, drivestudio, street) -> None:
    for (_, scene), prefix in ((street_gaussians, ""), (drivestudio, "waymo-")):
        actors = {actor.track_id: actor for actor in scene.actors}
        assert set(actors) == {f"{prefix}{number}" for number in street.movers}
        for number, mover in street.movers.items():
            actor = actors[f"{prefix}{number}"]
            np.testing.assert_allclose(actor.size_m, mover.size_m, atol=1e-5)
            kind = SemanticClass.VEHICLE if mover.label == "vehicle" else SemanticClass.TWO_WHEELER
            assert torch.all(actor.gaussians.semantic == int(kind))


def test_boxes_are_where_objects_are(drivestudio) -> None:
    _, scene = drivestudio
    boxes, moment = scene.boxes(3), scene.frame(3).timestamp_ns
    assert len(boxes) == 3
    for name, centre in zip(boxes.track_ids, boxes.centers_m, strict=True):
        (actor,) = (a for a in scene.actors if a.track_id == name)
        pose = actor.track.pose_at(moment)
        np.testing.assert_allclose(centre, pose[:3, 3], atol=1e-5)
