"""Copies of datasets with weathered images, as the datasets' own loaders find them."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.base import open_scene
from adapters.detect_format import source_tree
from adapters.uri import format_uri, parse_uri
from augment.errors import AdapterError
from augment.files.scene_file import save_scene
from augment.jobs.mirror import survey
from augment.jobs.render_job import RenderJob, run_job
from augment.scene.scene import Scene
from recipes.schema import Recipe
from tests.adapters import (
    av2_files,
    drivestudio_files,
    kitti_files,
    nuscenes_files,
    pandaset_files,
    street,
    street_gaussians_files,
)
from tests.adapters.recording_files import write_as_recording
from tests.augment.batch_scenes import fake_render, make_recipe, open_fake
from tests.augment.mirror_trees import contents, listing, snapshot
from tools.mirror import clear_notes, mirror_outputs, recipes_for_source

SMALL = {"voxel_m": "0.5", "image_scale": "0.5", "sky_size": "16", "max_gaussians": "3000"}


def weather(scene: Scene, out: Path, *, scale: float = 1.0, **selection) -> tuple[Path, list[str]]:
    """Images by a stand-in renderer, and the dataset's copy: its folder, and what was said."""
    recipe = make_recipe(semantic=False, instance=False, depth="none", lidar=False)
    settings = recipe.render.model_copy(update={"scale": scale})
    (recipe,) = recipes_for_source(scene, out, [recipe.model_copy(update={"render": settings})])
    job = RenderJob(scene.source, [recipe], out, **selection)
    result = run_job(job, scene_loader=lambda _: scene, renderer=fake_render, progress=False)
    assert result.failed == 0
    said = mirror_outputs(scene, out, progress=False)
    return out / "source" / "fog-000", said


def changed_files(source: Path, copy: Path) -> set[str]:
    """Files that differ; there are no others in either."""
    assert listing(copy) == listing(source)
    a, b = contents(source), contents(copy)
    return {name for name in a if a[name] != b[name]}


def relative_images(scene: Scene, root: Path) -> set[str]:
    return {
        str(Path(path).relative_to(root))
        for frame in scene.frames
        for path in frame.image_paths.values()
    }


def assert_same_but_colours(scene: Scene, again: Scene, old: Path, new: Path) -> None:
    """Calibration, times, poses, labels, LiDAR; recorded images by another path."""
    assert len(again.frames) == len(scene.frames)
    for a, b in zip(scene.frames, again.frames, strict=True):
        assert (a.index, a.timestamp_ns) == (b.index, b.timestamp_ns)
        assert (a.world_from_ego == b.world_from_ego).all()
        assert a.cameras.keys() == b.cameras.keys()
        for name, camera in a.cameras.items():
            other = b.cameras[name]
            assert camera.timestamp_ns == other.timestamp_ns
            assert (camera.width, camera.height, camera.fx) == (other.width, other.height, other.fx)
            assert (camera.camera_from_world == other.camera_from_world).all()
        moved = {name: path.replace(str(old), str(new)) for name, path in a.image_paths.items()}
        assert moved == dict(b.image_paths)
        boxes, same = scene.boxes(a.index), again.boxes(a.index)
        assert boxes.track_ids == same.track_ids
        assert (boxes.centers_m == same.centers_m).all() and (boxes.quats == same.quats).all()
        sweep, equal = scene.lidar(a.index), again.lidar(a.index)
        assert (sweep is None) == (equal is None)
        if sweep is not None:
            for name, column in sweep.columns.items():
                assert np.array_equal(column, equal.columns[name])


def _street_gaussians(folder: Path) -> str:
    root = street_gaussians_files.write_as_street_gaussians(folder / "002", frames=2).root
    return f"street_gaussians:{root}?"


# Datasets whose images are all jpg or png files below one folder, and how many of them a scene has.
COPIED = {
    "pandaset": (
        lambda folder: f"pandaset:{pandaset_files.write_as_pandaset(folder / '002')}?",
        "6 of 6 camera images are weathered",
    ),
    "recording": (
        lambda folder: f"recording:{write_as_recording(folder / 'drive', depth=True)}?",
        "6 of 6 camera images are weathered",
    ),
    # Images come twice as often as sweeps.
    "av2": (
        lambda folder: f"av2:{av2_files.write_as_av2(folder / av2_files.NAME)}?",
        "12 of 27 camera images are weathered; 15 stay clear, as recorded",
    ),
    # Of two scenes with five images of each of two cameras, keyframes of one.
    "nuscenes": (
        lambda folder: (
            f"nuscenes:{nuscenes_files.write_as_nuscenes(folder / 'nuscenes')}"
            "?scene=scene-0001&sweeps=0&"
        ),
        "6 of 20 camera images are weathered; 14 stay clear, as recorded",
    ),
    "street_gaussians": (_street_gaussians, "10 of 10 camera images are weathered"),
}


@pytest.mark.parametrize("scheme", COPIED)
def test_a_copy_differs_in_its_images_alone(scheme, tmp_path):
    write, sentence = COPIED[scheme]
    uri = write(tmp_path / "data") + "&".join(f"{key}={value}" for key, value in SMALL.items())
    root = Path(parse_uri(uri)[1])
    scene = open_scene(uri)
    before = snapshot(root)
    folder, said = weather(scene, tmp_path / "out")
    copy = folder / root.name
    assert changed_files(root, copy) == relative_images(scene, root)
    again = open_scene(uri.replace(str(root), str(copy)))
    assert again.problems == scene.problems
    assert_same_but_colours(scene, again, root, copy)
    assert snapshot(root) == before
    assert any(sentence in line for line in said), said


def test_a_copys_pictures_are_the_rendered_ones(tmp_path):
    root = pandaset_files.write_as_pandaset(tmp_path / "002")
    copy, said = weather(open_scene(format_uri("pandaset", root, SMALL)), tmp_path / "out")
    shown = cv2.imread(str(copy / "002/camera/left_camera/01.jpg"))
    rendered = cv2.imread(str(tmp_path / "out/002/fog-000/images/left_camera/000001.jpg"))
    assert shown.shape == (street.HEIGHT, street.WIDTH, 3)
    assert (shown == rendered).all()
    assert "stay clear" not in said[1]  # of the images


def test_some_frames_and_cameras_of_a_sequence(tmp_path):
    root = pandaset_files.write_as_pandaset(tmp_path / "002")
    scene = open_scene(format_uri("pandaset", root, {**SMALL, "frames": "0:2"}))
    copy, said = weather(scene, tmp_path / "out", frames=[1], cameras=["front_camera"])
    assert changed_files(root, copy / "002") == {"camera/front_camera/01.jpg"}
    assert "  1 of 6 camera images are weathered; 5 stay clear, as recorded" in said


def test_all_images_of_an_argoverse_log(tmp_path):
    """Those before the first sweep and after the last belong to no span."""
    root = av2_files.write_as_av2(tmp_path / av2_files.NAME)
    (note,) = clear_notes(open_scene(format_uri("av2", root, SMALL)), of_sweeps=False)
    assert note.endswith("; images=all in its URI takes those between its sweeps")
    scene = open_scene(format_uri("av2", root, {**SMALL, "images": "all"}))
    assert len(scene.frames) == 7
    copy, said = weather(scene, tmp_path / "out")
    assert changed_files(root, copy / root.name) == relative_images(scene, root)
    assert "  21 of 27 camera images are weathered; 6 stay clear, as recorded" in said
    assert "images=all" not in clear_notes(scene, of_sweeps=False)[0]


DEVKIT = """
import json, sys
from nuscenes.nuscenes import NuScenes
found = []
for root in sys.argv[1:]:
    nusc = NuScenes(version="v1.0-mini", dataroot=root, verbose=False)
    shown = {}
    for sample in nusc.sample:
        for channel, token in sample["data"].items():
            path, boxes, intrinsic = nusc.get_sample_data(token)
            key = path.replace(root, "")
            shown[key] = [
                open(path, "rb").read()[:8].hex(),
                [[b.name, list(b.center), list(b.orientation.q)] for b in boxes],
                None if intrinsic is None else [list(row) for row in intrinsic],
            ]
    found.append(shown)
assert found[0].keys() == found[1].keys()
for key in found[0]:
    assert found[0][key][1:] == found[1][key][1:], key
print(json.dumps(sorted(found[0])))
"""


def test_the_official_devkit_reads_the_copy(tmp_path):
    python = os.environ.get("CLIMATEGS_NUSCENES_DEVKIT")
    if python is None:
        pytest.skip("CLIMATEGS_NUSCENES_DEVKIT names no Python with nuscenes-devkit")
    root = nuscenes_files.write_as_nuscenes(tmp_path / "nuscenes", scenes=["scene-0001"])
    scene = open_scene(format_uri("nuscenes", root, SMALL))
    copy, _ = weather(scene, tmp_path / "out")
    command = [python, "-c", DEVKIT, str(root), str(copy / "nuscenes")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    images = {name for name in json.loads(done.stdout) if "CAM_" in name}
    assert len(images) == 2 * nuscenes_files.SAMPLES


def write_kitti_drive(folder: Path, *, calibration: str) -> Path:
    """A drive whose calibration is in its own folder or the day's, beside another drive."""
    drive = kitti_files.write_as_kitti(folder / "2011_09_26", cameras=("02",))
    if calibration == "drive":
        for path in drive.parent.glob("calib_*.txt"):
            path.rename(drive / path.name)
    (drive.parent / "another_drive_sync").mkdir()
    return drive


def test_drives_of_one_day_share_a_copy(tmp_path):
    """As `pykitti.raw(folder, date, drive)` reads them; the day's third drive stays out."""
    drive = write_kitti_drive(tmp_path, calibration="day")
    other = Path(shutil.copytree(drive, drive.with_name("2011_09_26_drive_0002_sync")))
    for place in (drive, other):
        scene = open_scene(format_uri("kitti", place, {**SMALL, "frames": "2:3"}))
        copy, said = weather(scene, tmp_path / "out", scale=0.1)
        assert not any("not the source's" in sentence for sentence in said)
    day = copy / "2011_09_26"
    for place in (drive, other):
        assert changed_files(place, day / place.name) == {"image_02/data/0000000002.png"}
    assert not (day / "another_drive_sync").exists()


@pytest.mark.parametrize("calibration", ["day", "drive"])
def test_a_kitti_drive(tmp_path, calibration):
    drive = write_kitti_drive(tmp_path, calibration=calibration)
    query = {**SMALL, "frames": "1:2"}
    scene = open_scene(format_uri("kitti", drive, query))
    root = drive.parent if calibration == "day" else drive
    copy, said = weather(scene, tmp_path / "out", scale=0.1)
    copy = copy / root.name
    again = copy / drive.name if calibration == "day" else copy
    assert changed_files(drive, again) == {"image_02/data/0000000001.png"}
    if calibration == "day":
        assert sorted(path.name for path in copy.iterdir()) == sorted(
            [
                drive.name,
                *(f"calib_{what}.txt" for what in ("cam_to_cam", "imu_to_velo", "velo_to_cam")),
            ]
        )
    assert_same_but_colours(scene, open_scene(format_uri("kitti", again, query)), drive, again)
    assert "  1 of 3 camera images are weathered; 2 stay clear, as recorded" in said
    recorded = cv2.imread(str(drive / "image_02/data/0000000001.png"))
    shown = cv2.imread(str(again / "image_02/data/0000000001.png"))
    assert shown.shape == recorded.shape
    (resized,) = (sentence for sentence in said if "rendered at another size" in sentence)
    assert resized.endswith(f" to {recorded.shape[1]}x{recorded.shape[0]} pixels")


def test_kitti_object_frames(tmp_path):
    """Each is a scene of its own: one copy of the dataset takes the images of all of them."""
    root = tmp_path / "object"
    kitti_files.write_as_kitti_object(root / "training", numbers=(1, 2, 3))
    (root / "ImageSets").mkdir()
    expected = set()
    for frame in ("1", "2"):
        scene = open_scene(format_uri("kitti", root, {**SMALL, "frame": frame}))
        copy, _ = weather(scene, tmp_path / "out", scale=0.1)
        expected |= relative_images(scene, root)
        assert changed_files(root, copy / "object") == expected
    assert expected == {f"training/image_2/00000{frame}.png" for frame in (1, 2)}


def street_scene(root: Path, **changes) -> Scene:
    """A scene of Street Gaussians' data, or of a model trained on it, by its images alone."""
    scene = open_fake("fake:waymo")
    names = {"front": 0, "rear/left": 3}
    frames = tuple(
        dataclasses.replace(
            frame,
            image_paths={
                name: str(root / "images" / f"{frame.index:06d}_{number}.png")
                for name, number in names.items()
            },
        )
        for frame in scene.frames
    )
    return dataclasses.replace(scene, frames=frames, **changes)


def test_a_street_gaussians_model_has_its_datas_tree(tmp_path):
    """Rendered at another size than recorded, as the project's own models are."""
    root = tmp_path / "data" / "waymo" / "002"
    (root / "images").mkdir(parents=True)
    for frame in range(4):
        for camera in (0, 3, 4):
            image = np.full((19, 29, 3), 10 * camera, np.uint8)
            cv2.imwrite(str(root / "images" / f"{frame:06d}_{camera}.png"), image)
    model = {"source": f"street_gaussians:{tmp_path}/model"}
    scene = street_scene(root, **model, recorded_source=f"street_gaussians:{root}")
    copy, said = weather(scene, tmp_path / "out")
    assert changed_files(root, copy / "002") == relative_images(scene, root)
    assert cv2.imread(str(copy / "002/images/000001_3.png")).shape == (19, 29, 3)
    assert "  8 of 12 camera images are weathered; 4 stay clear, as recorded" in said


def test_a_drivestudio_run_has_its_datas_tree(tmp_path):
    numbers = drivestudio_files.write_as_drivestudio(tmp_path)
    scene = open_scene(f"drivestudio:{numbers.folder}?data={numbers.data}&ground_z=0")
    frame = scene.frames[1].index
    copy, _ = weather(scene, tmp_path / "out", scale=0.05, frames=[frame])
    changed = changed_files(numbers.data, copy / "007")
    assert changed == {
        os.path.relpath(path, numbers.data) for path in scene.frame(frame).image_paths.values()
    }
    name = min(changed)
    assert cv2.imread(str(copy / "007" / name)).shape == cv2.imread(str(numbers.data / name)).shape


def test_a_fitted_scene_has_its_recordings_tree(tmp_path):
    root = pandaset_files.write_as_pandaset(tmp_path / "002")
    scene = open_scene(format_uri("pandaset", root, SMALL))
    save_scene(scene, tmp_path / "fitted")
    fitted = open_scene(f"scene:{tmp_path / 'fitted'}")
    assert source_tree(fitted).root == root
    root.rename(tmp_path / "moved")
    with pytest.raises(AdapterError, match=r"002, which the scene was made from, .*data=URI"):
        source_tree(open_scene(f"scene:{tmp_path / 'fitted'}"))
    moved = open_scene(f"scene:{tmp_path / 'fitted'}?data=pandaset:{tmp_path / 'moved'}")
    copy, _ = weather(moved, tmp_path / "out")
    assert changed_files(tmp_path / "moved", copy / "moved") == relative_images(
        moved, tmp_path / "moved"
    )


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("procedural:street?seed=3", "has no dataset's folder .*pandaset, nuscenes, kitti, "),
        ("gaussians:model.ply", "has no dataset's folder"),
        ("fake:street", "has no dataset's folder"),
        ("pandaset:/no/such/002", "/no/such/002, which the scene was made from, is not there"),
        ("pandaset:.?camera_path=path.json", "shows the frames of a camera path"),
    ],
)
def test_scenes_without_a_tree_are_refused(source, message):
    scene = dataclasses.replace(open_fake("fake:street"), source=source)
    with pytest.raises(AdapterError, match=message):
        source_tree(scene)


def test_a_dataset_without_images_is_refused(tmp_path):
    (tmp_path / "model").mkdir()
    scene = street_scene(tmp_path, source=f"street_gaussians:{tmp_path / 'model'}")
    recipe: Recipe = make_recipe()
    with pytest.raises(AdapterError, match=r"model, which .* names, holds no camera images"):
        recipes_for_source(scene, tmp_path / "out", [recipe])


def test_images_are_counted_by_their_place(tmp_path):
    root = nuscenes_files.write_as_nuscenes(tmp_path / "nuscenes")
    (root / "maps").mkdir(exist_ok=True)
    (root / "maps" / "more.png").write_bytes(b"")
    tree = source_tree(dataclasses.replace(open_fake("fake:x"), source=f"nuscenes:{root}"))
    assert survey(tree).images == 20
