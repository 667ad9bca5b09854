"""The road's height of real and made-up scenes: what the sources say of one road, and `inspect`."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.gaussian_files import open_gaussians
from adapters.recording.adapter import RecordingLabels
from adapters.street.layout import CAMBER, EGO_Y_M, road_z
from augment.errors import BackendUnavailable
from augment.files.ply import write_ply
from augment.scene.ground import ground_of, load_open3d
from augment.scene.labels import ClassifiesLidar, LidarSweep
from augment.scene.scene import Ground, Scene
from augment.scene.semantics import SemanticClass
from tests.adapters import pandaset_files, splat_scenes, street
from tests.adapters.recording_files import write_as_recording
from tests.adapters.splat_scenes import gaussians_at
from tools.inspect import describe_scene, scene_text

SMALL = "voxel_m=0.15&image_scale=0.25&sky_size=16"


@pytest.fixture(scope="module")
def drive() -> Scene:
    return open_scene("procedural:street?frames=12&gaussians=60000&width=64&height=48")


@pytest.fixture(scope="module")
def real(shared_dir: Path) -> Scene:
    root = shared_dir / "data" / "pandaset_mini" / "002"
    if not root.is_dir():
        pytest.skip(f"no PandaSet sequence at {root}")
    return open_scene(f"pandaset:{root}?frames=10:16&{SMALL}")


def needs_open3d() -> None:
    try:
        load_open3d()
    except BackendUnavailable as error:
        pytest.skip(str(error))


def by_source(scene: Scene) -> dict[str, Ground]:
    """The scene's ground as each source tells it, the better ones withheld."""
    bare = dataclasses.replace(scene, ground=None, ground_z_m=None)
    unclassed = dataclasses.replace(bare.background, semantic=None)
    blind = dataclasses.replace(bare, labels=None)
    faint = dataclasses.replace(unclassed, opacities=0 * unclassed.opacities)
    found = [
        ground_of(bare),
        ground_of(blind),
        ground_of(dataclasses.replace(blind, background=unclassed)),
        ground_of(dataclasses.replace(blind, background=faint)),
    ]
    return {ground.source: ground for ground in found}


def test_all_sources_agree_on_the_made_up_street(drive: Scene) -> None:
    """Its road falls from the crown to the kerb; the car drives 1.7 m beside the crown."""
    needs_open3d()
    grounds = by_source(drive)
    assert list(grounds) == ["lidar labels", "road splats", "ransac", "ego path"]
    truth = float(road_z(EGO_Y_M))
    # So few Gaussians are large, and those of the road have a second layer that much lower.
    tolerance_m = {"lidar labels": 0.01, "road splats": 0.1, "ransac": 0.1, "ego path": 0.005}
    for source, ground in grounds.items():
        assert ground.median_z_m == pytest.approx(truth, abs=tolerance_m[source])
        assert ground.lowest_z_m == pytest.approx(ground.median_z_m, abs=0.02)  # no hill
    lidar, path = grounds["lidar labels"], grounds["ego path"]
    assert path.lowest_z_m == pytest.approx(drive.ground_z_m, abs=1e-12)
    # A plane through one side of the camber is tilted by it, and the crown takes some away.
    assert lidar.tilt_deg == pytest.approx(math.degrees(CAMBER), abs=0.3)
    assert lidar.residual_m is not None and lidar.residual_m < 0.01


@pytest.mark.long
def test_the_real_streets_sources_agree(real: Scene) -> None:
    needs_open3d()
    grounds = by_source(real)
    assert list(grounds) == ["lidar labels", "road splats", "ransac", "ego path"]
    labels = grounds["lidar labels"]
    for source in ("road splats", "ransac"):
        # Six frames at voxels of 15 cm; what is sampled where differs on a road that tilts.
        assert grounds[source].lowest_z_m == pytest.approx(labels.lowest_z_m, abs=0.06)
        assert grounds[source].median_z_m == pytest.approx(labels.median_z_m, abs=0.06)
    # The ego origin is about 0.3 m above the road, which nothing in the files says.
    assert grounds["ego path"].median_z_m == pytest.approx(labels.median_z_m, abs=0.5)
    assert real.ground is not None and real.ground.source == "lidar labels"
    assert real.ground_z_m == real.ground.lowest_z_m
    # Opening has all sweeps where measuring has a handful.
    assert real.ground.lowest_z_m == pytest.approx(labels.lowest_z_m, abs=0.03)
    assert real.ground.residual_m < 0.04 and 0 < real.ground.tilt_deg < 6


def test_pandaset_keeps_what_opening_measured(tmp_path: Path) -> None:
    root = pandaset_files.write_as_pandaset(tmp_path / "002")
    scene = open_scene(f"pandaset:{root}?{SMALL}")
    assert scene.ground is not None and scene.ground.source == "lidar labels"
    assert scene.ground_z_m == scene.ground.lowest_z_m
    assert ground_of(scene) is scene.ground
    again = ground_of(dataclasses.replace(scene, ground=None))
    # Points on a plane, in files of float64 against the scene's float32.
    assert again.lowest_z_m == pytest.approx(street.GROUND_Z, abs=1e-5)
    assert again.residual_m == pytest.approx(0, abs=1e-6)


def test_a_guessed_recording_says_that_the_path_is_all_it_knows(tmp_path: Path) -> None:
    scene = open_scene(f"recording:{write_as_recording(tmp_path / 'drive', lidar=False)}?{SMALL}")
    ground = ground_of(scene)
    assert ground.source == "ego path" and ground.points == 0
    assert ground.lowest_z_m == pytest.approx(street.GROUND_Z)
    assert scene.ground_z_m == ground.lowest_z_m


def test_recordings_say_what_their_classes_mean(tmp_path: Path) -> None:
    root = write_as_recording(tmp_path / "drive")
    labels = RecordingLabels(root)
    assert isinstance(labels, ClassifiesLidar)
    sweep = labels.lidar(0)
    assert sweep is not None
    classes = labels.lidar_classes(sweep)
    assert classes is not None and SemanticClass.ROAD in classes and len(classes) == len(sweep)
    odd = LidarSweep(dict(sweep.columns) | {"semantic": np.full(len(sweep), 200)})
    assert (labels.lidar_classes(odd) == SemanticClass.UNKNOWN).all()  # not in lidar_classes
    calibration = json.loads((root / "calibration.json").read_text())
    del calibration["lidar_classes"]
    (root / "calibration.json").write_text(json.dumps(calibration))
    assert labels.lidar_classes(odd) is None  # nor one of our own
    assert labels.lidar_classes(LidarSweep({axis: sweep.columns[axis] for axis in "xyz"})) is None


def test_a_stated_height_is_the_ground() -> None:
    scene = open_scene(
        "procedural:street?frames=1&gaussians=60000&width=16&height=16&ground_z=-1.5"
        "&parked=0&moving=0&pedestrians=0"
    )
    assert ground_of(scene) == Ground(-1.5, -1.5, "stated")
    assert scene.ground_z_m == -1.5


@pytest.mark.parametrize(
    ("query", "notes", "known"),
    [({}, {}, False), ({"up": "+z"}, {}, True), ({}, {"up": "+z"}, True)],
)
def test_gravity_of_a_splat_file_without_a_ground_is_what_someone_said(
    tmp_path, query, notes, known
) -> None:
    write_ply(tmp_path / "a.ply", gaussians_at(torch.randn(500, 3)), notes=notes)
    scene = open_gaussians(tmp_path / "a.ply", {"scale": "1", **query})
    assert scene.has_metric_scale and scene.has_known_gravity is known


def test_a_splat_file_has_a_ground_once_scale_and_up_are_given(tmp_path: Path) -> None:
    needs_open3d()
    write_ply(tmp_path / "a.ply", splat_scenes.street())
    source = f"gaussians:{tmp_path / 'a.ply'}"
    ground = ground_of(open_scene(f"{source}?up=%2Bz&scale=1"))
    assert ground.source == "ransac"
    # Splats lie within 2 cm of the road at z = 0.
    assert ground.lowest_z_m == pytest.approx(0, abs=0.02)
    assert ground.median_z_m == pytest.approx(0, abs=0.02)


def test_inspect_prints_height_source_and_residual(tmp_path: Path, drive: Scene) -> None:
    facts = describe_scene(drive)
    assert facts["ground"]["source"] == "lidar labels" and facts["ground"]["points"] > 1000
    line = next(line for line in scene_text(facts).splitlines() if "  ground  " in line)
    assert "under the path; lidar labels, " in line and "residual 0." in line and "tilt" in line
    write_ply(tmp_path / "a.ply", gaussians_at(torch.randn(500, 3)))
    source = f"gaussians:{tmp_path / 'a.ply'}"
    facts = describe_scene(open_scene(source))
    assert f"{source}?up=-y&scale=0.35" in facts["ground"]["sentence"]
    text = scene_text(facts)
    assert not facts["has_known_gravity"] and "lowest_z_m" not in facts["ground"]
    assert "not known: which way is up and how long a unit is. Give both" in text
    assert "up          taken as +z, not known" in text
