"""`scene:` URIs: recognised, opened, and the labels of the recording they were made from."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from fitted_scenes import assert_same, fitted_scene
from pandaset_folder import write_sequence

from adapters.base import open_scene, recognise
from adapters.pandaset.files import PandaSetLabels
from adapters.scene_folder import storable
from augment.errors import AdapterError, SceneError
from augment.files.scene_file import save_scene, save_scene_file
from augment.jobs.processes import share_scene

STREET = (
    "procedural:street?seed=5&frames=6&gaussians=60000&lidar_columns=16"
    "&parked=1&moving=1&pedestrians=0"
)


def save(tmp_path: Path, **changes) -> Path:
    save_scene(fitted_scene(**changes), tmp_path / "fit")
    return tmp_path / "fit"


def test_a_scene_folder_is_recognised_and_opened(tmp_path):
    folder = save(tmp_path)
    assert recognise(folder) == "scene"
    for uri in (f"scene:{folder}", str(folder)):
        scene = open_scene(uri)
        assert scene.source == f"scene:{folder}"
        assert_same(scene, fitted_scene(), but=("source", "problems"))
        assert scene.labels is None
        assert "test:recording, which the scene was made from, is not there" in scene.problems[-1]
    again = open_scene(open_scene(f"scene:{folder}?ground_z=-3").source)
    assert again.ground_z_m == -3


def test_bad_uris_and_folders(tmp_path):
    folder = save(tmp_path)
    with pytest.raises(AdapterError, match=r"does not know 'frames'; it takes data"):
        open_scene(f"scene:{folder}?frames=2")
    with pytest.raises(AdapterError, match="no such file or folder"):
        open_scene(f"scene:{folder}?data={tmp_path}/nowhere")
    with pytest.raises(AdapterError, match="no such file or folder"):
        open_scene(f"scene:{folder}?data=pandaset:{tmp_path}/nowhere")
    with pytest.raises(AdapterError, match="no recording is named so"):
        open_scene(f"scene:{folder}?data=scene:{folder}")
    with pytest.raises(SceneError, match=r"no scene folder: it has no scene\.json"):
        open_scene(f"scene:{tmp_path}")
    (folder / "sky.safetensors").unlink()
    assert recognise(folder) == "scene"  # so that what is wrong with it is said
    with pytest.raises(SceneError, match=r"it has no sky\.safetensors"):
        open_scene(str(folder))


def test_a_scene_file_is_recognised_and_opened(tmp_path):
    path = tmp_path / "fit.CLIMATEGS"
    save_scene_file(fitted_scene(recorded_source=STREET), path)
    assert recognise(path) == "scene"
    scene = open_scene(str(path))
    assert scene.source == f"scene:{path}" and scene.problems == fitted_scene().problems
    assert_same(scene, fitted_scene(), but=("source", "labels", "recorded_source"))
    assert scene.labels is not None and open_scene(scene.source).labels == scene.labels
    assert open_scene(f"scene:{path}?data={STREET.replace('&', '%26')}").labels == scene.labels
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(SceneError, match=r"fit\.CLIMATEGS is damaged"):
        open_scene(str(path))
    path.rename(tmp_path / "other")
    with pytest.raises(AdapterError, match=r"a scene file \(\.climategs\)"):
        open_scene(str(tmp_path / "other"))


def test_what_is_saved_again_is_storable(tmp_path, monkeypatch):
    """Also where the recording, named relative to another folder, is not there today."""
    monkeypatch.chdir(tmp_path)
    folder = save(tmp_path, recorded_source="pandaset:raw/002")
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    scene = open_scene(f"scene:{folder}")
    assert "boxes and LiDAR are left out" in scene.problems[-1]
    kept = storable(scene)
    assert kept.problems == fitted_scene().problems
    assert kept.recorded_source == f"pandaset:{tmp_path}/raw/002"
    street = open_scene(STREET)
    assert storable(street) is street


def test_labels_come_from_the_recording(tmp_path):
    folder = save(tmp_path, recorded_source=STREET)
    scene, street = open_scene(f"scene:{folder}"), open_scene(STREET)
    assert scene.problems == fitted_scene().problems
    ours, theirs = scene.boxes(1), street.boxes(1)
    assert ours.track_ids == theirs.track_ids and len(ours) > 0
    assert np.array_equal(ours.centers_m, theirs.centers_m)
    assert np.array_equal(scene.lidar(0).points_m, street.lidar(0).points_m)
    save(tmp_path, recorded_source=f"{STREET}&ground_z=1")
    assert len(open_scene(f"scene:{folder}").boxes(1)) == len(theirs)
    save(tmp_path, recorded_source="procedural:street?seed=x")
    broken = open_scene(f"scene:{folder}")
    assert broken.labels is None and "boxes and LiDAR are left out" in broken.problems[-1]


def test_a_recording_is_found_from_anywhere_and_after_it_moved(tmp_path, monkeypatch):
    """Its URI and its images are given relative to where the scene was saved."""
    (tmp_path / "raw").mkdir()
    write_sequence(tmp_path / "raw" / "002")
    monkeypatch.chdir(tmp_path)
    image = {"ahead": "raw/002/camera/front_camera/00.jpg"}
    frames = (dataclasses.replace(fitted_scene().frames[0], image_paths=image),)
    save(tmp_path, source="pandaset:raw/002?frames=0:2", recorded_source=None, frames=frames)
    monkeypatch.chdir("/")
    scene = open_scene(f"scene:{tmp_path}/fit")
    assert scene.labels == PandaSetLabels(tmp_path / "raw" / "002")
    assert scene.recorded_source == f"pandaset:{tmp_path}/raw/002?frames=0:2"
    assert scene.frames[0].image_paths == {"ahead": f"{tmp_path}/{image['ahead']}"}

    shutil.move(tmp_path / "raw", tmp_path / "moved")
    gone = open_scene(f"scene:{tmp_path}/fit")
    assert gone.labels is None and "is not there" in gone.problems[-1]
    for uri in (f"pandaset:{tmp_path}/moved/002", f"{tmp_path}/moved/002"):
        found = open_scene(f"scene:{tmp_path}/fit?data={uri}")
        assert found.labels == PandaSetLabels(tmp_path / "moved" / "002")
        assert found.problems == fitted_scene().problems
        paths = found.frames[0].image_paths
        assert paths == {"ahead": f"{tmp_path}/moved/002/camera/front_camera/00.jpg"}
        assert open_scene(found.source).labels == found.labels


def test_a_scene_made_from_a_fitted_scene_keeps_its_recording(tmp_path):
    first = open_scene(f"scene:{save(tmp_path, recorded_source=STREET)}")
    save_scene(first, tmp_path / "fit")  # in its own place
    again = open_scene(f"scene:{tmp_path}/fit")
    assert again.recorded_source == first.recorded_source
    assert again.labels == first.labels


def test_workers_share_a_scene_folders_scene(tmp_path):
    scene = open_scene(f"scene:{save(tmp_path, recorded_source=STREET)}")
    shared = share_scene(scene, scene.frames, tmp_path)
    again, _ = shared.open()
    shared.remove()
    assert_same(scene, again, but=("labels",))
    assert again.labels == scene.labels
