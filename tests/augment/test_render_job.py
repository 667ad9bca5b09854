"""`climategs render`: what a job writes, goes on with, and says when something is wrong."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import shutil
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

import augment
from augment.errors import OutputError, SceneError
from augment.jobs.processes import OutputLock, process_mark
from augment.jobs.render_job import RenderJob
from augment.output.layout import item_paths
from augment.output.manifest import read_manifest
from augment.output.names import resolve_inside
from augment.output.tables import read_boxes, read_lidar
from augment.scene.cameras import Frame
from recipes.load import load_recipe
from recipes.schema import Render
from tests.augment.batch_scenes import (
    ORIGIN_M,
    SIZE,
    FakeLabels,
    fake_render,
    fog_job,
    make_camera,
    make_frame,
    make_recipe,
    must_not_render,
    open_fake,
    run_fake,
    tree_digest,
)

IDENTITY = ("source", "recipe_hash", "trajectory", "version", "backend")
FOLDER = Path("street") / "fog-000"


@pytest.fixture(scope="module")
def finished_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one uninterrupted run; shared, so nobody writes to it."""
    out = tmp_path_factory.mktemp("whole") / "out"
    result = run_fake(fog_job(out))
    assert (result.written, result.skipped, result.failed) == (8, 0, 0)
    return out


@pytest.fixture
def copied_dir(finished_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_dir, tmp_path / "copied"))


# ---- Files ---------------------------------------------------------------------------------------


def assert_same_column(got: np.ndarray, expected: np.ndarray) -> None:
    assert got.dtype == expected.dtype and got.shape == expected.shape
    if expected.dtype == object:  # pointers: compare what they point at
        assert [repr(v) for v in got] == [repr(v) for v in expected]
    else:
        assert got.tobytes() == expected.tobytes()


def test_files_hold_what_was_rendered(finished_dir: Path) -> None:
    recipe = make_recipe()
    scene = open_fake("fake:street")
    for frame in scene.frames:
        for name, camera in frame.cameras.items():
            paths = item_paths("street", recipe, name, frame.index)
            view = fake_render(scene, camera, recipe, backend="auto")
            image = cv2.imread(str(finished_dir / paths["image"]), cv2.IMREAD_COLOR_RGB)
            np.testing.assert_array_equal(image, view.rgb)
            depth = cv2.imread(str(finished_dir / paths["depth"]), cv2.IMREAD_UNCHANGED)
            assert depth.dtype == np.uint16
            none = (view.depth_m < 1 / 512) | (view.depth_m > 65535.5 / 256)
            assert none.any() and not none.all()
            np.testing.assert_array_equal(depth == 0, none)
            # Half a step of 1/256 m.
            assert np.abs(depth / 256 - view.depth_m)[~none].max() <= 1 / 512
            for kind, ids in (("semantic", view.semantic), ("instance", view.instance)):
                written = cv2.imread(str(finished_dir / paths[kind]), cv2.IMREAD_UNCHANGED)
                np.testing.assert_array_equal(written, ids)


def test_manifest_has_a_row_for_every_image(tmp_path: Path) -> None:
    recipe = make_recipe(image="jpg")
    run_fake(RenderJob("fake:street", [recipe], tmp_path, frames=[3, 2], cameras=["front"]))
    rows = read_manifest(tmp_path).to_pylist()
    assert [row["frame"] for row in rows] == [2, 3]
    row = rows[0]
    image = tmp_path / row["image_path"]
    expected = {
        "scene": "street",
        "source": "fake:street",
        "variant": "fog-000",
        "camera": "front",
        "timestamp_ns": make_frame(2).cameras["front"].timestamp_ns,
        "image_path": "street/fog-000/images/front/000002.jpg",
        "depth_path": "street/fog-000/depth/front/000002.png",
        "semantic_path": "street/fog-000/semantic/front/000002.png",
        "instance_path": "street/fog-000/instance/front/000002.png",
        "lidar_path": "street/lidar/000002.parquet",
        "labels_path": "street/fog-000/labels/boxes.parquet",
        "calibration_path": "street/fog-000/calibration.json",
        "width": SIZE[0],
        "height": SIZE[1],
        "surface": "solid",
        "render_scale": 1.0,
        "box_2d_path": "street/fog-000/labels/boxes_2d.parquet",
        "box_smog_path": "street/fog-000/labels/smog.parquet",
        "seed": 7,
        "recipe": "fog",
        "recipe_hash": recipe.hash,
        "trajectory": "recorded",
        "version": augment.__version__,
        "backend": "auto",
        "checksum": hashlib.sha256(image.read_bytes()).hexdigest(),
        "status": "ok",
        "message": "",
    }
    assert {name: row[name] for name in expected} == expected
    absent = ("style", "quality", "settings", "water_path", "snow_path", "box_snow_path")
    assert {row[name] for name in absent} == {None}
    numbers = recipe.columns()
    assert numbers.keys() <= row.keys()
    assert row["smog_extinction_per_m"] == numbers["smog_extinction_per_m"]
    assert rows[1]["lidar_path"] is None  # the dataset has no sweep there
    files = [row[name] for name in row if name.endswith("_path") and row[name] is not None]
    assert len(files) == 9 and all((tmp_path / file).is_file() for file in files)


def test_labels_and_lidar_pass_through_to_the_bit(finished_dir: Path) -> None:
    folder = finished_dir / FOLDER
    written = read_boxes(folder / "labels" / "boxes.parquet")
    assert list(written) == [0, 1, 2, 3]
    for number in range(4):
        expected = FakeLabels().boxes(number)
        got = written[number].boxes
        assert written[number].timestamp_ns == make_frame(number).timestamp_ns
        assert (got.track_ids, got.labels) == (expected.track_ids, expected.labels)
        for name in ("centers_m", "sizes_m", "quats"):
            assert_same_column(getattr(got, name), getattr(expected, name))
        assert list(got.attributes) == list(expected.attributes)
        for name in expected.attributes:
            assert_same_column(got.attributes[name], expected.attributes[name])
    for number in range(3):
        expected = FakeLabels().lidar(number)
        got = read_lidar(folder.parent / "lidar" / f"{number:06d}.parquet")
        assert list(got.columns) == list(expected.columns)
        for name in expected.columns:
            assert_same_column(got.columns[name], expected.columns[name])
    assert not (folder.parent / "lidar" / "000003.parquet").exists()


def test_calibration_is_in_the_datasets_world(tmp_path: Path) -> None:
    recipe = make_recipe().model_copy(update={"render": Render(scale=0.5)})
    run_fake(RenderJob("fake:street", [recipe], tmp_path))
    calibration = json.loads((tmp_path / FOLDER / "calibration.json").read_text())
    assert [entry["frame"] for entry in calibration["frames"]] == [0, 1, 2, 3]
    entry = calibration["frames"][2]
    camera = entry["cameras"]["rear/left"]
    scaled = make_frame(2).cameras["rear/left"].scaled(0.5)
    assert (camera["width"], camera["height"]) == (12, 8)
    assert [camera[k] for k in ("fx", "fy", "cx", "cy")] == [
        scaled.fx, scaled.fy, scaled.cx, scaled.cy,
    ]  # fmt: skip
    pose = np.array(camera["world_from_camera"])
    np.testing.assert_array_equal(pose[:3, 3], ORIGIN_M + np.array([0.2, 0, 1]))
    np.testing.assert_array_equal(pose[:3, :3], scaled.world_from_camera[:3, :3].numpy())
    assert entry["world_from_ego"][0][3] == ORIGIN_M[0] + 0.2
    assert calibration["world_origin_m"] == ORIGIN_M.tolist()
    again = load_recipe(tmp_path / FOLDER / "recipe.yaml").resolve(0)
    assert again == recipe and again.hash == recipe.hash


def test_a_bad_frame_is_recorded_and_the_rest_goes_on(finished_dir: Path, tmp_path: Path) -> None:
    def render(scene, camera, recipe, *, backend):
        if camera.timestamp_ns == make_frame(2).cameras["rear/left"].timestamp_ns:
            raise RuntimeError("the covariance of splat 7\nis singular")
        return fake_render(scene, camera, recipe, backend=backend)

    result = run_fake(fog_job(tmp_path, "fake:street?unreadable=1"), render)
    assert (result.written, result.failed) == (5, 3)
    assert len(result.failures) == 3 and "street/fog-000, frame 1" in result.failures[0]
    failed = [row for row in read_manifest(tmp_path).to_pylist() if row["status"] == "failed"]
    assert [(row["frame"], row["camera"]) for row in failed] == [
        (1, "front"), (1, "rear/left"), (2, "rear/left"),
    ]  # fmt: skip
    assert failed[0]["message"] == (
        "reading the boxes of frame 1: AdapterError: cuboids/01.pkl.gz is cut short"
    )
    assert failed[2]["message"] == (
        "rendering: RuntimeError: the covariance of splat 7 is singular"
    )
    assert all(row["image_path"] is None and row["checksum"] == "" for row in failed)

    # Mended, only those are tried again, and the result is that of a run without failures.
    result = run_fake(fog_job(tmp_path))
    assert (result.written, result.skipped, result.failed) == (3, 5, 0)
    assert tree_digest(tmp_path) == tree_digest(finished_dir)


def test_an_unreadable_sweep_fails_its_frame(tmp_path: Path) -> None:
    class Labels(FakeLabels):
        def lidar(self, frame_index):
            raise EOFError("compressed file ended early")

    scene = dataclasses.replace(open_fake("fake:street"), labels=Labels())
    result = run_fake(fog_job(tmp_path, frames=[0]), scene_loader=lambda _uri: scene)
    assert result.failures[0].endswith(
        "reading the LiDAR sweep: EOFError: compressed file ended early"
    )
    without = RenderJob("fake:street", [make_recipe("clear", lidar=False)], tmp_path, frames=[0])
    assert run_fake(without, scene_loader=lambda _uri: scene).failed == 0


def test_jobs_that_cannot_be_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    recipe = make_recipe()
    for error, message, recipes, options in (
        (SceneError, r"no frame 9, 11; it has 0-3", [recipe], {"frames": [2, 9, 11]}),
        (SceneError, r"no camera back; it has front, rear/left", [recipe], {"cameras": ["back"]}),
        (ValueError, "workers must be >= 1; got 0", [recipe], {"workers": 0}),
        (ValueError, "at least one recipe", [], {}),
        (ValueError, r"repeated: \['fog-000'\]", [recipe, make_recipe(depth="none")], {}),
        (ValueError, r"backend must be one of auto, .*'vulkan'", [recipe], {"backend": "vulkan"}),
    ):
        with pytest.raises(error, match=message):
            run_fake(RenderJob("fake:street", recipes, out, **options), None)
        assert not out.exists()
    out.write_text("mine")
    with pytest.raises(OutputError, match=r"out.*(is a file|is in the way)"):
        run_fake(fog_job(out))
    assert out.read_text() == "mine"


def test_a_camera_path_replaces_the_frames(tmp_path: Path) -> None:
    """Labels pass where number and time are those of a frame of the scene."""
    recorded = make_frame(1)
    side = {"front": make_camera("front", recorded.timestamp_ns, 0.5)}
    path = [
        Frame(1, recorded.timestamp_ns, recorded.world_from_ego, side),
        Frame(2, 5, recorded.world_from_ego, {"front": make_camera("front", 5, 0.7)}),
    ]
    assert run_fake(fog_job(tmp_path, camera_path=path)).written == 2
    rows = read_manifest(tmp_path).to_pylist()
    assert [row["labels_path"] is None for row in rows] == [False, True]
    assert [row["lidar_path"] is None for row in rows] == [False, True]
    assert rows[0]["trajectory"] == rows[1]["trajectory"] != "recorded"
    with pytest.raises(OutputError, match=r"camera path there 'path-.*', here 'recorded'"):
        run_fake(fog_job(tmp_path))


def test_a_second_job_on_the_same_folder_is_refused(tmp_path: Path) -> None:
    begun = threading.Event()
    go_on = threading.Event()

    def render(scene, camera, recipe, *, backend):
        begun.set()
        go_on.wait(20)
        return fake_render(scene, camera, recipe, backend=backend)

    first = threading.Thread(target=run_fake, args=(fog_job(tmp_path, "fake:a"), render))
    first.start()
    begun.wait(20)
    try:
        with pytest.raises(OutputError, match=r"is being written by another job \(process \d+\)"):
            run_fake(fog_job(tmp_path, "fake:b"))
    finally:
        go_on.set()
        first.join()
    assert run_fake(fog_job(tmp_path, "fake:b")).written == 8


def test_the_lock_of_a_dead_process_does_not_last(tmp_path: Path) -> None:
    state = tmp_path / ".climategs"
    state.mkdir()
    (state / "lock").write_text("4194305 1")  # above the kernel's largest process number
    with OutputLock(tmp_path):
        assert (state / "lock").read_text() == process_mark(os.getpid())
    assert (state / "lock").read_bytes() == b""


def test_a_full_disk_stops_the_job_and_says_what_to_do(tmp_path, monkeypatch) -> None:
    real = os.fsync
    left = [80]

    def flush(descriptor):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor)

    job = fog_job(tmp_path)
    monkeypatch.setattr(os, "fsync", flush)
    with pytest.raises(OutputError, match=r"cannot write .*: No space left.*free some space"):
        run_fake(job)
    monkeypatch.undo()
    assert not list(tmp_path.rglob("*.climategs-tmp"))
    assert not (tmp_path / "manifest.parquet").exists()
    result = run_fake(job)
    assert result.skipped > 0 and result.failed == 0
    assert result.written + result.skipped == 8


def test_paths_from_a_manifest_must_stay_inside(tmp_path: Path) -> None:
    root = tmp_path / "out"
    (root / "a").mkdir(parents=True)
    (root / "link").symlink_to(tmp_path)
    assert resolve_inside(root, "a/b.png") == root / "a" / "b.png"
    for path in ("/etc/passwd", "../x", "a/../../x", "a\\..\\x", "", "link/x"):
        with pytest.raises(OutputError, match=r"relative to|outside"):
            resolve_inside(root, path)


def test_the_librarys_own_renderer(tmp_path: Path) -> None:
    """`auto` is written down as the backend that it stood for."""
    job = RenderJob(
        "fake:street", [make_recipe()], tmp_path, frames=[0], cameras=["front"], backend="reference"
    )
    assert run_fake(job, renderer=None).failures == ()
    row = read_manifest(tmp_path).to_pylist()[0]
    assert row["backend"] == "reference"
    image = cv2.imread(str(tmp_path / row["image_path"]))
    assert image.std() > 1  # something of the scene is in it


# ---- Going on ------------------------------------------------------------------------------------


def test_a_complete_job_renders_nothing_and_touches_nothing(copied_dir: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in copied_dir.rglob("*") if path.is_file()}
    result = run_fake(fog_job(copied_dir), must_not_render)
    assert (result.written, result.skipped, result.failed) == (0, 8, 0)
    lock = copied_dir / ".climategs" / "lock"
    after = {path: path.stat().st_mtime_ns for path in before}
    assert {p for p in before if before[p] != after[p]} <= {lock}


def test_leftovers_of_a_killed_run_go(finished_dir: Path, copied_dir: Path) -> None:
    for place in (copied_dir / FOLDER / "images" / "front", copied_dir, copied_dir / ".climategs"):
        (place / ".000001.png.99-0.climategs-tmp").write_bytes(b"half")
    assert run_fake(fog_job(copied_dir), must_not_render).skipped == 8
    assert tree_digest(copied_dir) == tree_digest(finished_dir)


def test_any_file_that_was_deleted_is_made_again(tmp_path: Path) -> None:
    """One of every folder: images, masks, labels, sweeps, calibration, recipe."""
    job = fog_job(tmp_path, uri="fake:street?frames=2")
    run_fake(job)
    digests = tree_digest(tmp_path)
    firsts = {path.rpartition("/")[0]: path for path in digests}
    singles = ("recipe.yaml", "calibration.json", "boxes.parquet", "boxes_2d.parquet")
    names = {*firsts.values(), *(path for path in digests if path.endswith(singles))}
    deleted = {path for path in names if "/" in path and not path.startswith(".climategs")}
    assert {"images", "depth", "labels"} <= {path.split("/")[2] for path in deleted}
    for path in sorted(deleted):
        (tmp_path / path).unlink()
        written = run_fake(job).written
        assert written == 1 or "/images/" not in path
        assert tree_digest(tmp_path) == digests, path


def test_folders_that_lead_out_of_the_output_are_not_written_to(tmp_path: Path) -> None:
    for number, inner in enumerate(
        ("street", "street/fog-000", "street/fog-000/images", "street/fog-000/depth/front")
    ):
        out = tmp_path / f"out{number}"
        elsewhere = tmp_path / f"elsewhere{number}"
        elsewhere.mkdir()
        (out / inner).parent.mkdir(parents=True)
        (out / inner).symlink_to(elsewhere)
        with pytest.raises(OutputError, match="leads through a link"):
            run_fake(fog_job(out))
        assert list(elsewhere.iterdir()) == []


def test_an_interrupt_finishes_what_is_at_hand_and_can_be_resumed(tmp_path: Path) -> None:
    recipes = [make_recipe(), make_recipe(variant=1)]
    run_fake(RenderJob("fake:street", recipes, tmp_path / "whole"))
    calls = []

    def interrupted(scene, camera, recipe, *, backend):
        calls.append(camera.name)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return fake_render(scene, camera, recipe, backend=backend)

    job = RenderJob("fake:street", recipes, tmp_path / "stopped")
    with pytest.raises(KeyboardInterrupt, match="stopped with 3 of 16 images finished; run the"):
        run_fake(job, interrupted)
    assert read_manifest(tmp_path / "stopped").num_rows == 3
    assert run_fake(job).skipped == 3
    assert tree_digest(tmp_path / "stopped") == tree_digest(tmp_path / "whole")


@pytest.mark.parametrize("folders", [["progress"], ["journal"], ["progress", "journal"]])
def test_half_a_line_in_a_progress_log_is_not_believed(tmp_path: Path, folders) -> None:
    """As a kill in the midst of a write leaves it; whole lines before it still count.

    Older versions kept the logs in `journal`: a job that one of them began goes on.
    """
    recipes = [make_recipe("clear", labels=False)]  # whose rows are all that a line holds
    run_fake(RenderJob("fake:street", recipes, tmp_path / "whole"))
    out = tmp_path / "torn"
    run_fake(RenderJob("fake:street", recipes, out, frames=[0, 1]))
    rows = read_manifest(out).to_pylist()
    (out / "manifest.parquet").unlink()
    lines = [{name: rows[0][name] for name in IDENTITY}, *rows]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    for folder in folders:
        progress_log = out / ".climategs" / folder / "street" / "clear-000.jsonl"
        progress_log.parent.mkdir(parents=True)
        progress_log.write_text(text[:-20])
    assert run_fake(RenderJob("fake:street", recipes, out)).skipped == 3
    assert sorted(path.name for path in (out / ".climategs").iterdir()) == ["lock"]
    assert tree_digest(out) == tree_digest(tmp_path / "whole")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("image_path", 1e308),
        ("image_path", "../victim.png"),
        ("frame", "x"),
        ("camera", None),
        ("status", []),
        ("variant", "fog-001"),
        ("new", {}),
        ("width", 2**70),
        ("box_2d", {"pixels": 3}),
    ],
)
def test_a_damaged_progress_log_is_reported(tmp_path: Path, field: str, value: object) -> None:
    """Whose lines are rows of the manifest, and come from anybody as that does."""
    job = fog_job(tmp_path, frames=[0])
    run_fake(job)
    identity, *rows = read_manifest(tmp_path).to_pylist()[:1] * 2
    (tmp_path / "manifest.parquet").unlink()
    progress_log = tmp_path / ".climategs" / "progress" / "street" / "fog-000.jsonl"
    progress_log.parent.mkdir(parents=True)
    lines = [{name: identity[name] for name in IDENTITY}, {**rows[0], field: value}]
    progress_log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(OutputError, match=f"{progress_log}"):
        run_fake(job)
    progress_log.unlink()
    assert run_fake(job).written == 2


@pytest.mark.parametrize("ended", [True, False], ids=["finished", "only begun"])
def test_another_recipe_under_the_same_name_is_refused(tmp_path: Path, ended: bool) -> None:
    run_fake(RenderJob("fake:street", [make_recipe()], tmp_path, frames=[0]))
    if not ended:  # as a kill leaves it: a progress log and no manifest
        identity = read_manifest(tmp_path).to_pylist()[0]
        (tmp_path / "manifest.parquet").unlink()
        progress_log = tmp_path / ".climategs" / "progress" / "street" / "fog-000.jsonl"
        progress_log.parent.mkdir(parents=True)
        progress_log.write_text(json.dumps({name: identity[name] for name in IDENTITY}) + "\n")
    before = tree_digest(tmp_path)
    changed = make_recipe(depth="none")
    pattern = f"fog-000 already holds.*recipe hash there '{make_recipe().hash}'.*overwrite"
    with pytest.raises(OutputError, match=pattern):
        run_fake(RenderJob("fake:street", [changed], tmp_path), must_not_render)
    assert tree_digest(tmp_path) == before

    calls = []

    def stops_at_the_third(scene, camera, recipe, *, backend):
        calls.append(camera.name)
        if len(calls) == 3:
            raise SystemExit("stopped without a chance to tidy up")
        return fake_render(scene, camera, recipe, backend=backend)

    with pytest.raises(SystemExit, match="stopped without"):
        run_fake(RenderJob("fake:street", [changed], tmp_path, overwrite=True), stops_at_the_third)
    assert run_fake(RenderJob("fake:street", [changed], tmp_path)).skipped == 2
    assert {row["recipe_hash"] for row in read_manifest(tmp_path).to_pylist()} == {changed.hash}
    digest = tree_digest(tmp_path)
    run_fake(RenderJob("fake:street", [changed], tmp_path / "new"))
    assert digest == tree_digest(tmp_path / "new")


def test_overwriting_replaces_the_variant_and_no_other(tmp_path: Path) -> None:
    run_fake(RenderJob("fake:street", [make_recipe(), make_recipe(variant=1)], tmp_path))
    changed = make_recipe(depth="none")
    result = run_fake(RenderJob("fake:street", [changed], tmp_path, frames=[0], overwrite=True))
    assert (result.written, result.skipped) == (2, 0)
    run_fake(RenderJob("fake:street", [changed], tmp_path / "new", frames=[0]))
    fog = "street/fog-000/"
    fog_digests = {k: v for k, v in tree_digest(tmp_path).items() if k.startswith(fog)}
    new = {k: v for k, v in tree_digest(tmp_path / "new").items() if k.startswith(fog)}
    assert fog_digests == new
    assert (
        read_manifest(tmp_path).column("variant").to_pylist() == ["fog-000"] * 2 + ["fog-001"] * 8
    )


# ---- What the scene's files held when its images were made ---------------------------------------


def test_a_scene_whose_content_has_changed_is_refused(tmp_path: Path) -> None:
    job = fog_job(tmp_path, frames=[1], source_digest="content1")
    run_fake(job)
    before = tree_digest(tmp_path)
    assert set(read_manifest(tmp_path)["source_digest"].to_pylist()) == {"content1"}
    assert run_fake(job, must_not_render).skipped == 2
    changed = dataclasses.replace(job, frames=[1, 2], source_digest="content2")
    with pytest.raises(OutputError, match=r"have changed since.*content1.*content2.*overwr"):
        run_fake(changed, must_not_render)
    assert {k: v for k, v in tree_digest(tmp_path).items() if "/" in k} == {
        k: v for k, v in before.items() if "/" in k
    }
    assert run_fake(dataclasses.replace(changed, overwrite=True)).written == 4
    assert set(read_manifest(tmp_path)["source_digest"].to_pylist()) == {"content2"}


@pytest.mark.parametrize("ended", [True, False])
def test_an_output_without_a_digest_is_taken_for_the_scene_as_it_is_once(
    tmp_path: Path, caplog, ended: bool
) -> None:
    old = fog_job(tmp_path)
    if ended:
        run_fake(old)
    else:
        calls = []

        def killed(*arguments, backend):
            calls.append(arguments)
            if len(calls) == 3:
                raise SystemExit("killed")
            return fake_render(*arguments, backend=backend)

        with pytest.raises(SystemExit, match="killed"):
            run_fake(old, killed)
    new_job = dataclasses.replace(old, source_digest="content1")
    run_fake(new_job)
    assert caplog.text.count("of an older version") == 1
    assert set(read_manifest(tmp_path)["source_digest"].to_pylist()) == {"content1"}
    run_fake(new_job, must_not_render)
    assert caplog.text.count("of an older version") == 1
    with pytest.raises(OutputError, match="have changed since"):
        run_fake(dataclasses.replace(old, source_digest="content2"))
