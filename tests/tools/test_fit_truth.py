"""Depth of the procedural street's own splats against its exact surfaces."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from adapters.procedural import StreetTruth, TrueView, open_procedural, open_truth
from augment.cameras import Camera
from augment.geometry import rigid
from augment.scene import Scene
from augment.semantics import SemanticClass
from tests.scenes import one_gaussian
from tools.fit_report import render_recorded, true_depth_errors

QUERY = {"seed": "3", "gaussians": "60000", "frames": "2", "width": "96", "height": "54"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return open_procedural(QUERY)


@pytest.fixture(scope="module")
def truth() -> StreetTruth:
    return open_truth(QUERY)


def cameras(scene: Scene) -> list[Camera]:
    return list(scene.frames[1].cameras.values())[:2]


def test_the_streets_own_splats_are_near_the_truth(scene, truth):
    errors = true_depth_errors(scene, truth, cameras(scene))
    assert errors["views"] == 2
    # In so small an image a splat's blur of half a pixel spans metres of the road ahead.
    assert errors["median"]["abs_rel"] < 0.1 and errors["expected"]["abs_rel"] < 0.1
    assert errors["no_surface"] < 0.05 and errors["sky_covered"] < 0.4
    assert sum(e["pixels"] for e in errors["by_class"].values()) == errors["median"]["pixels"]
    assert "road" in errors["by_class"] and "sky" not in errors["by_class"]


class OwnTruth:
    """A truth that is the scene itself, 0.25 m farther on the right half, with sky at the top."""

    def __init__(self, scene: Scene):
        self.scene = scene

    def render(self, camera: Camera) -> TrueView:
        depth = render_recorded(self.scene, camera).median_depth_m.astype(np.float64)
        depth[depth == 0] = 7.0
        semantic = np.full(depth.shape, SemanticClass.ROAD, np.int16)
        half = camera.width // 2
        depth[:, half:] += 0.25
        semantic[:, half:] = SemanticClass.BUILDING
        depth[:10], semantic[:10] = np.inf, SemanticClass.SKY
        nothing = np.zeros((*depth.shape, 3), np.float32)
        return TrueView(nothing, depth, nothing, semantic, semantic.astype(np.int32))


def test_figures_are_those_of_a_known_difference(scene):
    camera = cameras(scene)[0]
    seen = render_recorded(scene, camera)
    errors = true_depth_errors(scene, OwnTruth(scene), [camera, camera])
    assert errors["by_class"].keys() == {"road", "building"}
    assert errors["by_class"]["road"]["p90_m"] == 0
    assert errors["by_class"]["building"]["median_m"] == pytest.approx(0.25)
    solid, below = seen.has_surface, np.arange(camera.height) >= 10
    assert errors["median"]["pixels"] == 2 * solid[below].sum()
    assert errors["no_surface"] == pytest.approx(1 - solid[below].mean())
    assert errors["sky_covered"] == pytest.approx(solid[:10].mean())
    assert errors["sky_alpha"] == pytest.approx(seen.alpha[:10].mean())


def test_a_moved_origin_changes_nothing(scene, truth):
    shift = torch.tensor([100.0, -20.0, 3.0], dtype=torch.float64)
    back = rigid(torch.eye(3, dtype=torch.float64), shift)  # dataset from scene
    still = dataclasses.replace(scene, actors=())
    background = scene.background
    background = dataclasses.replace(background, means=background.means - shift.float())
    moved = dataclasses.replace(still, background=background, world_origin_m=shift.numpy())
    camera = cameras(still)[0]
    there = dataclasses.replace(camera, camera_from_world=camera.camera_from_world @ back)
    expected = true_depth_errors(still, truth, [camera])
    actual = true_depth_errors(moved, truth, [there])
    # float32 means 100 m away: 1e-5 m each, and a few pixels choose another median splat.
    assert actual["median"]["median_m"] == pytest.approx(expected["median"]["median_m"], abs=1e-3)
    assert actual["sky_alpha"] == pytest.approx(expected["sky_alpha"], abs=1e-3)


def test_a_scene_that_shows_nothing_has_no_surface(scene, truth):
    nothing = dataclasses.replace(
        scene, background=one_gaussian(mean=(0.0, 0.0, -500.0), opacity=0.01), actors=()
    )
    errors = true_depth_errors(nothing, truth, cameras(scene)[:1])
    assert errors["no_surface"] == 1 and errors["sky_alpha"] == 0 and errors["sky_covered"] == 0
    assert errors["median"]["pixels"] == 0 and math.isnan(errors["median"]["median_m"])
    assert all(e["pixels"] == 0 for e in errors["by_class"].values())
    errors = true_depth_errors(nothing, truth, [])
    assert errors["views"] == 0 and errors["by_class"] == {} and np.isnan(errors["sky_alpha"])


def test_a_wall_before_the_camera_covers_the_sky(scene, truth):
    camera = cameras(scene)[0]
    at = camera.centre + 2 * camera.ray_directions(torch.float64)[27, 48]
    wall = one_gaussian(mean=at.tolist(), scale=50.0, opacity=0.99)
    covered = dataclasses.replace(scene, background=wall, actors=())
    errors = true_depth_errors(covered, truth, [camera])
    assert errors["sky_covered"] == 1 and errors["sky_alpha"] > 0.9 and errors["no_surface"] == 0
