"""Scene URIs: parsing and its inverse, dispatch, recognition, and what is said if nothing fits."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.base import detect_scheme_of_path, expand_job_scenes, open_scene
from adapters.camera_files.camera_files import read_views
from adapters.datasets import DATASETS
from adapters.detect_format import describe_unrecognised, detect_scheme
from adapters.drivestudio.drive import read_config as drivestudio_config
from adapters.lidar_scene.image_views import read_image
from adapters.nuscenes.tables import read_rows
from adapters.pandaset.adapter import PandaSetLabels
from adapters.plain_files import check_image, read_json, read_numbers, read_pose, resolve_inside
from adapters.recording.adapter import read_sweep
from adapters.safe_pickle import read_array, read_frame
from adapters.scene_folder import prepare_for_storage
from adapters.street_gaussians.model import read_config as street_gaussians_config
from adapters.training_views.depth_priors import read_metric
from adapters.uri import format_uri, parse_uri
from augment.effects.style.images import read_style_image
from augment.effects.style.network import load_network
from augment.effects.style.style import parse_statistics
from augment.errors import AdapterError, SceneError, StyleError
from augment.files.checkpoints import load_checkpoint
from augment.files.ply import write_ply
from augment.files.scene_file import load_scene_parts, save_scene, save_scene_file
from augment.jobs.processes import share_scene
from recipes.errors import RecipeError
from recipes.job import JobScene, load_job
from recipes.load import load_recipe
from tests.adapters.pandaset_files import write_as_pandaset
from tests.adapters.splat_scenes import street
from tests.fitted_scenes import assert_same, fitted_scene


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("procedural:street?seed=3", ("procedural", "street", {"seed": "3"})),
        ("procedural:street", ("procedural", "street", {})),
        ("gaussians:/b.ply?up=+z&scale=1", ("gaussians", "/b.ply", {"up": "+z", "scale": "1"})),
        ("gaussians:a.ply?up=-y&", ("gaussians", "a.ply", {"up": "-y"})),
        ("PandaSet:x", ("pandaset", "x", {})),
        ("a folder/b c.ply", (None, "a folder/b c.ply", {})),
        ("a%20folder/b.ply?cameras=c%26d.json", (None, "a folder/b.ply", {"cameras": "c&d.json"})),
        ("./x:y.ply", (None, "x:y.ply", {})),
        ("gaussians:a.ply?cameras=b=c", ("gaussians", "a.ply", {"cameras": "b=c"})),
    ],
)  # fmt: skip
def test_parse_uri(uri: str, expected: tuple) -> None:
    assert parse_uri(uri) == expected


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("", "no path"),
        ("gaussians:", r"no path.*procedural:street\?seed=3"),
        ("gaussians:?up=z", "no path"),
        ("gaussians:a.ply?up", "expected key=value after.*got 'up'"),
        ("gaussians:a.ply?=3", "expected key=value"),
        ("gaussians:a.ply?up=z&up=y", "'up' is given twice"),
    ],
)
def test_bad_uris(uri: str, message: str) -> None:
    with pytest.raises(AdapterError, match=message):
        parse_uri(uri)


NEARLY = {
    "a PandaSet sequence: lidar/ is there, camera/ not": ["lidar/00.pkl.gz"],
    "a nuScenes dataset: samples/ is there, v1.0-*/scene.json not": ["samples/CAM_FRONT/a.jpg"],
    "a KITTI drive: image_02/, velodyne_points/ are there, calib_cam_to_cam.txt not": [
        "image_02/data/0000000000.png", "velodyne_points/data/0000000000.bin",
    ],
    "a KITTI object folder: velodyne/, calib/ are there, image_2/ not": [
        "velodyne/000000.bin", "calib/000000.txt",
    ],
    "a segment of the Waymo Open Dataset v2: camera_image/, lidar/ are there, vehicle_pose/, "
    "camera_calibration/, lidar_calibration/, lidar_pose/ not": [
        "training/camera_image/a.parquet", "training/lidar/a.parquet",
    ],
    "an Argoverse 2 log: sensors/lidar/, sensors/cameras/ are there, "
    "city_SE3_egovehicle.feather, calibration/intrinsics.feather not": [
        "sensors/lidar/1.feather", "sensors/cameras/ring_front_center/1.jpg",
    ],
    "a recording: images/<camera>/000000.jpg is there, calibration.json not": [
        "images/front/000000.jpg",
    ],
}  # fmt: skip


@pytest.mark.parametrize("said", NEARLY)
def test_an_unknown_folder_says_what_it_nearly_is(said: str, tmp_path: Path) -> None:
    for name in NEARLY[said]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(AdapterError) as caught:
        open_scene(str(tmp_path))
    assert re.findall(r"It is nearly ([^.]*(?:\.[^ ][^.]*)*)\. ", str(caught.value)) == [said]


def test_names_with_special_characters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What exists as written is taken as written; the query starts after it."""
    monkeypatch.chdir(tmp_path)
    for name in ("what?.ply", "100%20.ply", "a b#c.ply", "gaussians:odd.ply"):
        Path(name).touch()
        assert parse_uri(name) == (None, name, {})
        if ":" not in name:
            assert parse_uri(f"gaussians:{name}?up=z") == ("gaussians", name, {"up": "z"})
            written = format_uri("gaussians", name, {"up": "+z", "cameras": "a&b=c?.json"})
            expected = {"up": "+z", "cameras": "a&b=c?.json"}
            assert parse_uri(written) == ("gaussians", name, expected)


@given(
    path=st.text(st.characters(codec="utf-8", exclude_characters="\0/"), min_size=1),
    query=st.dictionaries(st.sampled_from(["up", "scale", "cameras"]), st.text(max_size=8)),
)
def test_format_uri_is_the_inverse(path: str, query: dict[str, str]) -> None:
    path = "absent/" + path
    normal = str(Path(path))
    assert parse_uri(format_uri("gaussians", path, query)) == ("gaussians", normal, query)


def test_what_opens_no_scene_is_answered_with_what_would(tmp_path: Path) -> None:
    (tmp_path / "text.txt").write_text("hello")
    for uri, message in {
        "argoverse:/data": r"unknown scheme 'argoverse'.*pandaset.*gaussians.*up=-y",
        "procedural:forest": "procedural scenes are street; got 'forest'",
        f"gaussians:{tmp_path}/a/b.ply": f"no such file or folder.*exists up to {tmp_path}",
        f"pandaset:{tmp_path}/x": "no such file or folder",
        f"{tmp_path}/x?up=z": "no such file or folder",
        f"{tmp_path}/text.txt": r"Looked for .*\.ply, \.splat, \.ksplat, .*or \.usd file",
        str(tmp_path): r"not recognised as a scene\. It holds 1 \.txt\. Looked for .*a PandaSet",
    }.items():
        with pytest.raises(AdapterError, match=message):
            open_scene(uri)


def test_bare_paths_open_and_reopen(tmp_path: Path) -> None:
    path = tmp_path / "a street?.ply"
    write_ply(path, street())
    scene = open_scene(f"{path}?scale=2")
    again = open_scene(scene.source)
    assert scene.source.startswith("gaussians:") and again.source == scene.source
    assert again.background.means.equal(scene.background.means)
    assert scene.has_metric_scale


def test_unreadable_files_are_adapter_errors(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, street(length=8))

    def refuse(*_args, **_keywords):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(AdapterError, match=r"cannot be read: .*Permission denied"):
        open_scene(f"gaussians:{path}")


def test_the_road_height_can_be_given_to_any_scene(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", street())
    uri = f"gaussians:{tmp_path}/a.ply?scale=1"
    scene = open_scene(f"{uri}&ground_z=-1.5")
    assert scene.ground_z_m == -1.5
    assert open_scene(scene.source).ground_z_m == -1.5  # a worker opens the same scene
    with pytest.raises(AdapterError, match=r"ground_z must be the road's height.*got 'low'"):
        open_scene(f"{uri}&ground_z=low")


MULTI_PART = b"ply\nformat binary_little_endian 1.0\nelement vertex_background 1\n"
PLAIN = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
CLOUD = "point_cloud/iteration_7/point_cloud.ply"
TREES = (
    ("pandaset", ["camera/", "lidar/"]),
    ("nuscenes", ["samples/", "v1.0-mini/scene.json"]),
    ("street_gaussians", ["ego_pose/", "extrinsics/", "track/", "images/"]),
    ("street_gaussians", ["trained_model/iteration_30000.pth", "configs/"]),
    ("drivestudio", ["config.yaml", "checkpoint_final.pth"]),
    ("kitti", ["calib/", "image_2/", "label_2/", "velodyne/"]),
    ("kitti", ["training/calib/", "training/image_2/"]),
    ("kitti", ["velodyne_points/", "calib_cam_to_cam.txt"]),
    ("recording", ["calibration.json", "images/"]),
    ("gaussians", [CLOUD]),
    (None, ["velodyne_points/", "image_02/"]),  # without the day's calibration
    (None, ["point_cloud/iteration_7/"]),
)


def grow(root: Path, names: list[str], data: bytes = PLAIN) -> Path:
    for name in names:
        path = root / name
        (path if name.endswith("/") else path.parent).mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            path.write_bytes(data)
    return root


def test_folders_are_recognised(tmp_path):
    for number, (scheme, names) in enumerate(TREES):
        assert detect_scheme(grow(tmp_path / str(number), names)) == scheme, names
    day = grow(tmp_path / "2011_09_26", ["calib_cam_to_cam.txt"])
    assert detect_scheme(grow(day / "drive", ["velodyne_points/", "image_02/"])) == "kitti"
    many, one = grow(tmp_path / "many", [CLOUD], MULTI_PART), grow(tmp_path / "one", [CLOUD])
    assert detect_scheme(many) == detect_scheme(many / CLOUD) == "street_gaussians"
    assert detect_scheme(one / CLOUD) == detect_scheme((one / CLOUD).parent) == "gaussians"


def test_files_are_recognised(tmp_path):
    known = {
        "a.climategs": "scene",
        "a.pth": None,
        "a.splat": "gaussians",
        "checkpoint_final.pth": "drivestudio",
        "iteration_7.pth": "street_gaussians",
    }
    grow(tmp_path, list(known), b"x")
    assert {path.name: detect_scheme(path) for path in sorted(tmp_path.iterdir())} == known
    write_ply(tmp_path / "a.bin", street(length=8))
    assert detect_scheme_of_path(tmp_path / "a.bin") == "gaussians"


def test_what_is_not_known_is_answered_with_what_was_looked_for(tmp_path):
    grow(tmp_path / "set" / "seq", dict(TREES)["nuscenes"])
    with pytest.raises(AdapterError) as caught:
        detect_scheme_of_path(tmp_path / "set")
    folders = [dataset.folder for dataset in DATASETS.values() if dataset.folder]
    assert all(signature.describe() in str(caught.value) for signature in folders)
    assert f"give one, such as {tmp_path}/set/seq. Looked for" in str(caught.value)
    (tmp_path / "a.txt").write_text("hello")
    text = describe_unrecognised(tmp_path / "a.txt")
    assert all(dataset.file.describe() in text for dataset in DATASETS.values() if dataset.file)


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ([], r"It holds no files\. Looked for"),
        (["a/1.jpg", "a/2.jpg", "b/3.jpg", "x.db"], r"It holds 3 \.jpg \(a/ and others\), 1 \.db\. "
         r"Its images make a recording with their poses: images/<camera>/000000\.jpg and calib"),
        (["drive.mp4"], r"It holds 1 \.mp4\. Of a video's frames COLMAP and `climategs record`"),
        (["sensors/lidar/1.feather"], r"nearly an Argoverse 2 log: sensors/lidar/ is there, "
         r"city_SE3_egovehicle\.feather, calibration/intrinsics\.feather, sensors/cameras/ not"),
        (["frames/1.jpg", "sparse/0/cameras.bin", "sparse/0/images.bin"],
         r"a COLMAP model: `climategs record .*/sparse/0 --images FOLDER"),
    ],
)  # fmt: skip
def test_an_unknown_folder_is_told_what_it_lacks(tmp_path, files, said):
    grow(tmp_path / "new", files, b"x")
    (tmp_path / "new").mkdir(exist_ok=True)
    with pytest.raises(AdapterError, match=said):
        detect_scheme_of_path(tmp_path / "new")


def uris(folder: Path, *entries: str | JobScene) -> list[str]:
    given = [JobScene(uri=e) if isinstance(e, str) else e for e in entries]
    return [scene.uri for scene in expand_job_scenes(given, folder)]


@pytest.fixture(params=["plain", "odd [1] *"])
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Of a job; its own name may look like a pattern."""
    root = tmp_path / request.param
    for name in ("runs/b", "runs/a", "runs/c/deep", "other"):
        (root / name).mkdir(parents=True)
    return root


def test_patterns_stand_for_all_that_match_in_order(folder: Path) -> None:
    assert uris(folder, "runs/*") == [str(folder / "runs" / name) for name in "abc"]
    assert uris(folder, "runs/[ab]") == [str(folder / "runs" / name) for name in "ab"]
    assert uris(folder, "**/deep") == [str(folder / "runs/c/deep")]
    found = uris(folder, "pandaset:runs/*?k=v")
    assert [uri.split("/")[-1] for uri in found] == ["a?k=v", "b?k=v", "c?k=v"]
    assert all(uri.startswith("pandaset:/") for uri in found)


def test_each_keeps_what_the_entry_says(folder: Path) -> None:
    entry = JobScene(uri="runs/*", frames="::5", cameras=("front",), recipes=("fog",))
    for scene in expand_job_scenes([entry], folder):
        assert (scene.frames, scene.cameras, scene.recipes) == ("::5", ("front",), ("fog",))


def test_paths_are_the_jobs_and_not_the_shells(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert uris(folder, "other") == [str(folder / "other")]
    assert uris(folder, "missing") == [str(folder / "missing")]  # told where it is opened
    monkeypatch.chdir(folder.parent)
    assert uris(Path(folder.name), "runs/a") == [str(folder / "runs/a")]


def test_files_that_the_query_names_lie_beside_the_job(folder: Path) -> None:
    (folder / "path.json").write_text("{}")
    for uri in ("procedural:street?seed=3&camera_path=path.json",
                "pandaset:runs/a?seed=3&camera_path=path.json"):  # fmt: skip
        (found,) = uris(folder, uri)
        assert found.partition("?")[2].startswith("seed=3&camera_path=/")
        assert "path.json" in found
    assert uris(folder, "procedural:street?seed=3") == ["procedural:street?seed=3"]
    assert uris(folder, "unheard:of?x=1") == ["unheard:of?x=1"]


def test_what_is_refused(folder: Path) -> None:
    with pytest.raises(AdapterError, match=r"'none/\*': nothing matches"):
        uris(folder, "none/*")
    with pytest.raises(AdapterError, match="stands for 3 scenes, which cannot all be called 'x'"):
        uris(folder, JobScene(uri="runs/*", name="x"))
    with pytest.raises(AdapterError, match=r"names the scene '.*runs/a' twice \(by 'runs/a'\)"):
        uris(folder, "runs/*", "runs/a")


def test_a_pattern_that_would_look_through_too_much_is_refused(tmp_path, monkeypatch, ends_soon):
    for place in ("a", "b"):  # links back to the top: 2^40 ways down
        (tmp_path / place / "deep").mkdir(parents=True)
        for link in ("one", "two"):
            (tmp_path / place / link).symlink_to(tmp_path)
    assert uris(tmp_path, "**/deep") == [str(tmp_path / p / "deep") for p in ("a", "b")]
    assert uris(tmp_path, "a/*/b/deep") == [str(tmp_path / f"a/{n}/b/deep") for n in ("one", "two")]
    (tmp_path / ".hidden" / "deep").mkdir(parents=True)
    assert len(uris(tmp_path, "*/deep")) == 2 and len(uris(tmp_path, ".*/deep")) == 1
    assert set(uris(tmp_path, "**")) == {str(tmp_path / n) for n in (
        "", "a", "a/deep", "a/one", "a/two", "b", "b/deep", "b/one", "b/two"
    )}  # fmt: skip
    monkeypatch.setattr("adapters.base.MAX_ENTRIES", 5)
    with pytest.raises(AdapterError, match=r"'\*\*/no': looked at 5 files and folders and saw no"):
        uris(tmp_path, "**/no")


STREET = (
    "procedural:street?seed=5&frames=6&gaussians=60000&lidar_columns=16"
    "&parked=1&moving=1&pedestrians=0"
)


def save(tmp_path: Path, **changes) -> Path:
    save_scene(fitted_scene(**changes), tmp_path / "fit")
    return tmp_path / "fit"


def test_a_scene_folder_is_recognised_and_opened(tmp_path):
    folder = save(tmp_path)
    assert detect_scheme_of_path(folder) == "scene"
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
    for uri, message in {
        f"scene:{folder}?frames=2": "does not know 'frames'; it takes data",
        f"scene:{folder}?data={tmp_path}/nowhere": "no such file or folder",
        f"scene:{folder}?data=pandaset:{tmp_path}/nowhere": "no such file or folder",
        f"scene:{folder}?data=scene:{folder}": "no recording is named so",
        f"scene:{tmp_path}": r"no scene folder: it has no scene\.json",
    }.items():
        with pytest.raises((AdapterError, SceneError), match=message):
            open_scene(uri)
    (folder / "sky.safetensors").unlink()
    assert detect_scheme_of_path(folder) == "scene"  # so that what is wrong with it is said
    with pytest.raises(SceneError, match=r"it has no sky\.safetensors"):
        open_scene(str(folder))


def test_a_scene_file_is_recognised_and_opened(tmp_path):
    path = tmp_path / "fit.CLIMATEGS"
    save_scene_file(fitted_scene(recorded_source=STREET), path)
    assert detect_scheme_of_path(path) == "scene"
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
    kept = prepare_for_storage(scene)
    assert kept.problems == fitted_scene().problems
    assert kept.recorded_source == f"pandaset:{tmp_path}/raw/002"
    street = open_scene(STREET)
    assert prepare_for_storage(street) is street


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
    write_as_pandaset(tmp_path / "raw" / "002")
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


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_numbers_are_finite_and_as_many_as_expected(tmp_path):
    path = write(tmp_path / "a.txt", "1, 2\n3e1 -4\n")
    assert read_numbers(path).tolist() == [1, 2, 30, -4]
    assert read_numbers(path, (2, 2)).tolist() == [[1, 2], [30, -4]]
    with pytest.raises(AdapterError, match=r"none\.txt does not exist"):
        read_numbers(tmp_path / "none.txt")
    for text, message in (
        ("1 2", "must hold 3 x 3 numbers; it holds 2"),
        ("1 two", "numbers only"),
        ("1 nan", "NaN or infinite"),
    ):
        with pytest.raises(AdapterError, match=rf"b\.txt .*{message}"):
            read_numbers(write(tmp_path / "b.txt", text), (3, 3))


def test_poses_are_rotations_and_translations(tmp_path):
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]])

    def read(matrix: np.ndarray) -> np.ndarray:
        return read_pose(write(tmp_path / "pose.txt", " ".join(map(str, matrix.reshape(-1)))))

    pose = read(turn + 1e-6)
    assert np.allclose(pose[:3], turn, atol=1e-5) and pose[3].tolist() == [0, 0, 0, 1]
    assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-12
    mirrored, scaled = np.diag([1.0, 1, -1, 1]), np.diag([2.0, 2, 2, 1])
    projective = np.eye(4) + np.array([[0.0] * 4] * 3 + [[1, 0, 0, 0]])
    for matrix in (mirrored, scaled, projective):
        with pytest.raises(AdapterError, match=r"pose\.txt must be a rotation"):
            read(matrix)
    with pytest.raises(AdapterError, match="must hold 4 x 4 numbers"):
        read(np.arange(3))


def test_json_is_of_the_kind_expected(tmp_path):
    path = write(tmp_path / "a.json", "[1]")
    assert read_json(path, list) == [1]
    with pytest.raises(AdapterError, match=r"a\.json must hold an object; got list"):
        read_json(path)
    nested = "[" * 900 + "]" * 900
    for text in ("{", "[" * 50_000, nested, '{"a": 1, "a": 2}', r'["\ud800"]', "1" * 5000):
        with pytest.raises(AdapterError, match="is not readable JSON"):
            read_json(write(tmp_path / "bad.json", text))
    (tmp_path / "latin.json").write_bytes(b'{"a": "\xff"}')
    with pytest.raises(AdapterError, match="cannot be read as text"):
        read_json(tmp_path / "latin.json")


def test_names_in_tables_stay_inside_the_folder_or_where_its_owner_linked_it(tmp_path):
    root, elsewhere = tmp_path / "set", tmp_path / "elsewhere"
    grow(root, ["samples/a.jpg"])
    grow(elsewhere, ["a.jpg"])
    assert resolve_inside(root, "samples/a.jpg", "row 1") == root / "samples" / "a.jpg"
    (root / "samples" / "own.jpg").symlink_to(root / "samples" / "a.jpg")
    (root / "sweeps").symlink_to(elsewhere)  # another disk
    for name in ("samples/own.jpg", "sweeps/a.jpg"):
        assert resolve_inside(root, name, "row 1").read_bytes() == PLAIN
    for name in ("samples/link.jpg", "one.jpg"):
        (root / name).symlink_to(elsewhere / "a.jpg")
        with pytest.raises(AdapterError, match=rf"row 7 names '{name}'.*outside"):
            resolve_inside(root, name, "row 7")
    for name in ("../elsewhere/a.jpg", "/etc/passwd", "", "samples/../../a", "a\\b", "a\0b"):
        with pytest.raises(AdapterError, match=r"without '\.\.'"):
            resolve_inside(root, name, "row 7")


def merged(levels: int) -> str:
    """A merge key that copies 9^levels entries."""
    lines = ["a0: &a0 {x: 1}"]
    for n in range(levels):
        lines.append(f"a{n + 1}: &a{n + 1} {{<<: [{', '.join(9 * [f'*a{n}'])}]}}")
    return "\n".join(lines)


def aliased(levels: int) -> str:
    """A list of 9^levels items."""
    lines = ["a0: &a0 [1]"]
    lines += [f"a{n + 1}: &a{n + 1} [{', '.join(9 * [f'*a{n}'])}]" for n in range(levels)]
    return "\n".join(lines)


HOSTILE_YAML = {
    merged(9): r"merge keys \(<<\) are not read",
    aliased(9): "more than 20000 values, aliases expanded",
    "a: &a [*a]": "anchor",
    "[" * 50_000: "nested more than 32 levels deep",
    "a: !!python/object/apply:os.system ['true']": "tags are not allowed",
    "x" * 300_000: "larger than|at most 262144 characters|is a mapping",
    "a: 1\na: 2": "a is given twice",
    "": "the file is empty",
}
READERS = {
    "street gaussians": street_gaussians_config,
    "drivestudio": drivestudio_config,
    "recipe": load_recipe,
    "job": load_job,
    "style": lambda path: parse_statistics(path.read_text(), source=str(path)),
}


@pytest.mark.parametrize("reader", READERS)
def test_yaml_that_multiplies_or_runs_code_is_refused_at_once(tmp_path, reader, ends_soon):
    path = tmp_path / "file.yaml"
    for text, message in HOSTILE_YAML.items():
        if reader == "style" and len(text) > 200_000:
            continue  # those come with the package
        path.write_text(text)
        with pytest.raises((AdapterError, RecipeError, StyleError), match=message) as caught:
            READERS[reader](path)
        assert str(path) in str(caught.value)


def test_pipes_devices_and_folders_are_no_files(tmp_path, ends_soon):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    hurt = tmp_path / "scene"
    hurt.mkdir()
    os.mkfifo(hurt / "scene.json")
    readers = {
        **READERS,
        "text": read_json,
        "style image": read_style_image,
        "network": load_network,
        "scene": open_scene,
        "scene by scheme": lambda path: open_scene(f"gaussians:{path}"),
        "scene file": load_scene_parts,
        "camera path": read_views,
    }
    del readers["style"]
    for name, read in readers.items():
        for path in (pipe, Path("/dev/zero"), tmp_path, hurt):
            with pytest.raises((AdapterError, RecipeError, StyleError, SceneError)) as caught:
                read(path)
            assert str(path) in str(caught.value), name


def test_pipes_inside_datasets_are_faults_of_theirs(tmp_path, ends_soon):
    for suffix in ("png", "npy", "pkl.gz", "pth", "safetensors", "parquet", "json"):
        os.mkfifo(tmp_path / f"pipe.{suffix}")
    refused = {
        "png": read_metric,
        "npy": read_array,
        "pkl.gz": read_frame,
        "pth": load_checkpoint,
        "parquet": read_sweep,
        "json": lambda path: list(read_rows(path)),
    }
    for suffix, read in refused.items():
        path = tmp_path / f"pipe.{suffix}"
        with pytest.raises(AdapterError, match=re.escape(str(path))):
            read(path)
    picture = tmp_path / "pipe.png"
    assert read_image(picture, 1.0) is None
    assert check_image(picture) == "cannot be read (a pipe or device, not a regular file)"
