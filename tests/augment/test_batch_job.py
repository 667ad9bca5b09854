"""What a job writes, and what it says when something is wrong."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import lock_holder
import numpy as np
import pytest
from batch_scenes import (
    ORIGIN_M,
    SIZE,
    FakeLabels,
    fake_render,
    make_camera,
    make_frame,
    make_recipe,
    open_fake,
    tree_digest,
)

import augment
from augment.cameras import Frame
from augment.errors import OutputError, SceneError
from augment.jobs.layout import item_paths, resolve_inside
from augment.jobs.manifest import read_manifest, write_manifest
from augment.jobs.processes import OutputLock, process_mark
from augment.jobs.render_job import JobResult, RenderJob, run_job
from augment.jobs.tables import read_boxes, read_lidar
from recipes.load import load_recipe


def run(job: RenderJob, renderer=fake_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


def assert_same_column(got: np.ndarray, expected: np.ndarray) -> None:
    assert got.dtype == expected.dtype and got.shape == expected.shape
    if expected.dtype == object:  # pointers: compare what they point at
        assert [repr(v) for v in got] == [repr(v) for v in expected]
    else:
        assert got.tobytes() == expected.tobytes()


def test_files_hold_what_was_rendered(tmp_path: Path) -> None:
    recipe = make_recipe()
    result = run(RenderJob("fake:street", [recipe], tmp_path))
    assert (result.written, result.skipped, result.failed) == (8, 0, 0)
    scene = open_fake("fake:street")
    for frame in scene.frames:
        for name, camera in frame.cameras.items():
            paths = item_paths("street", recipe, name, frame.index)
            view = fake_render(scene, camera, recipe, backend="auto")
            image = cv2.imread(str(tmp_path / paths["image"]), cv2.IMREAD_COLOR_RGB)
            np.testing.assert_array_equal(image, view.rgb)
            depth = cv2.imread(str(tmp_path / paths["depth"]), cv2.IMREAD_UNCHANGED)
            assert depth.dtype == np.uint16
            none = (view.depth_m < 1 / 512) | (view.depth_m > 65535.5 / 256)
            assert none.any() and not none.all()
            np.testing.assert_array_equal(depth == 0, none)
            # Half a step of 1/256 m.
            assert np.abs(depth / 256 - view.depth_m)[~none].max() <= 1 / 512
            for path, ids in (
                (paths["semantic"], view.semantic),
                (paths["instance"], view.instance),
            ):
                np.testing.assert_array_equal(
                    cv2.imread(str(tmp_path / path), cv2.IMREAD_UNCHANGED), ids
                )


def test_manifest_has_a_row_for_every_image(tmp_path: Path) -> None:
    recipe = make_recipe(image="jpg")
    run(RenderJob("fake:street", [recipe], tmp_path, frames=[3, 2], cameras=["front"]))
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
        "style": None,
        "style_method": None,
        "quality": None,
        "render_scale": 1.0,
        "settings": None,
        "water_path": None,
        "snow_path": None,
        "box_2d_path": "street/fog-000/labels/boxes_2d.parquet",
        "box_water_path": None,
        "box_snow_path": None,
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
    numbers = recipe.columns()
    assert numbers.keys() <= row.keys()
    assert row["smog_extinction_per_m"] == numbers["smog_extinction_per_m"]
    assert rows[1]["lidar_path"] is None  # the dataset has no sweep there
    files = [row[name] for name in row if name.endswith("_path") and row[name] is not None]
    assert len(files) == 9 and all((tmp_path / file).is_file() for file in files)


def test_labels_and_lidar_pass_through_to_the_bit(tmp_path: Path) -> None:
    run(RenderJob("fake:street", [make_recipe()], tmp_path))
    folder = tmp_path / "street" / "fog-000"
    written = read_boxes(folder / "labels" / "boxes.parquet")
    assert list(written) == [0, 1, 2, 3]
    for number in range(4):
        expected, got = FakeLabels().boxes(number), written[number].boxes
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
    recipe = make_recipe().model_copy(update={"render": make_recipe().render})
    recipe = recipe.model_copy(update={"render": recipe.render.model_copy(update={"scale": 0.5})})
    run(RenderJob("fake:street", [recipe], tmp_path))
    text = (tmp_path / "street" / "fog-000" / "calibration.json").read_text()
    calibration = json.loads(text)
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


def test_recipe_yaml_reads_back_as_the_recipe(tmp_path: Path) -> None:
    recipe = make_recipe(variant=4)
    run(RenderJob("fake:street", [recipe], tmp_path, frames=[0]))
    again = load_recipe(tmp_path / "street" / "fog-004" / "recipe.yaml").resolve(0)
    assert again == recipe and again.hash == recipe.hash


def test_a_bad_frame_is_recorded_and_the_rest_goes_on(tmp_path: Path) -> None:
    def render(scene, camera, recipe, *, backend):
        if camera.timestamp_ns == make_frame(2).cameras["rear/left"].timestamp_ns:
            raise RuntimeError("the covariance of splat 7\nis singular")
        return fake_render(scene, camera, recipe, backend=backend)

    job = RenderJob("fake:street?unreadable=1", [make_recipe()], tmp_path)
    result = run(job, render)
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
    whole = RenderJob("fake:street", [make_recipe()], tmp_path)
    result = run(whole)
    assert (result.written, result.skipped, result.failed) == (3, 5, 0)
    run(RenderJob("fake:street", [make_recipe()], tmp_path / "new"))
    new = tree_digest(tmp_path / "new")
    assert {k: v for k, v in tree_digest(tmp_path).items() if not k.startswith("new/")} == new


def test_an_unreadable_sweep_fails_its_frame(tmp_path: Path) -> None:
    class Labels(FakeLabels):
        def lidar(self, frame_index):
            raise EOFError("compressed file ended early")

    def open_scene(uri):
        return dataclasses.replace(open_fake(uri), labels=Labels())

    job = RenderJob("fake:street", [make_recipe()], tmp_path, frames=[0], cameras=["front"])
    result = run(job, scene_loader=open_scene)
    assert result.failures[0].endswith(
        "reading the LiDAR sweep: EOFError: compressed file ended early"
    )
    without = RenderJob("fake:street", [make_recipe("clear", lidar=False)], tmp_path, frames=[0])
    assert run(without, scene_loader=open_scene).failed == 0


def test_unknown_frames_and_cameras_list_what_there_is(tmp_path: Path) -> None:
    job = RenderJob("fake:street", [make_recipe()], tmp_path / "out", frames=[2, 9, 11])
    with pytest.raises(SceneError, match=r"no frame 9, 11; it has 0-3"):
        run(job)
    job = RenderJob("fake:street", [make_recipe()], tmp_path / "out", cameras=["back"])
    with pytest.raises(SceneError, match=r"no camera back; it has front, rear/left"):
        run(job)
    assert not (tmp_path / "out").exists()


def test_jobs_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="workers must be >= 1; got 0"):
        RenderJob("fake:s", [make_recipe()], "out", workers=0)
    with pytest.raises(ValueError, match="at least one recipe"):
        RenderJob("fake:s", [], "out")
    with pytest.raises(ValueError, match=r"repeated: \['fog-000'\]"):
        RenderJob("fake:s", [make_recipe(), make_recipe(depth="none")], "out")


def test_a_camera_path_replaces_the_frames(tmp_path: Path) -> None:
    """Labels pass where number and time are those of a frame of the scene."""
    recorded = make_frame(1)
    side = {"front": make_camera("front", recorded.timestamp_ns, 0.5)}
    path = [
        Frame(1, recorded.timestamp_ns, recorded.world_from_ego, side),
        Frame(2, 5, recorded.world_from_ego, {"front": make_camera("front", 5, 0.7)}),
    ]
    job = RenderJob("fake:street", [make_recipe()], tmp_path, camera_path=path)
    assert run(job).written == 2
    rows = read_manifest(tmp_path).to_pylist()
    assert [row["labels_path"] is None for row in rows] == [False, True]
    assert [row["lidar_path"] is None for row in rows] == [False, True]
    assert rows[0]["trajectory"] == rows[1]["trajectory"] != "recorded"
    with pytest.raises(OutputError, match=r"camera path there 'path-.*', here 'recorded'"):
        run(RenderJob("fake:street", [make_recipe()], tmp_path))


def test_a_second_job_on_the_same_folder_is_refused(tmp_path: Path) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def render(scene, camera, recipe, *, backend):
        begun.set()
        go_on.wait(20)
        return fake_render(scene, camera, recipe, backend=backend)

    first = threading.Thread(
        target=run, args=(RenderJob("fake:a", [make_recipe()], tmp_path), render)
    )
    first.start()
    begun.wait(20)
    try:
        with pytest.raises(OutputError, match=r"is being written by another job \(process \d+\)"):
            run(RenderJob("fake:b", [make_recipe()], tmp_path))
    finally:
        go_on.set()
        first.join()
    assert run(RenderJob("fake:b", [make_recipe()], tmp_path)).written == 8


def test_the_lock_of_a_dead_process_does_not_last(tmp_path: Path) -> None:
    state = tmp_path / ".climategs"
    state.mkdir()
    (state / "lock").write_text("4194305 1")  # above the kernel's largest process number
    with OutputLock(tmp_path):
        assert (state / "lock").read_text() == process_mark(os.getpid())
    assert (state / "lock").read_bytes() == b""


@pytest.mark.long
def test_a_worker_keeps_its_share_of_the_lock(tmp_path, monkeypatch) -> None:
    """As after the parent was killed: the folder is free once the last worker has gone."""
    monkeypatch.setattr("augment.jobs.processes.ORPHANS_S", 0.1)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    with OutputLock(tmp_path) as lock:
        child = context.Process(target=lock_holder.hold, args=(lock.inherited(), theirs))
        child.start()
        assert ours.recv() == "holding"
    with pytest.raises(OutputError, match="is being written by another job; wait"):
        OutputLock(tmp_path).__enter__()
    # The dead parent had this process's number, as in another run of a container.
    (tmp_path / ".climategs" / "lock").write_text(f"{os.getpid()} 1")
    monkeypatch.setattr("augment.jobs.processes.ORPHANS_S", 20)
    threading.Timer(0.2, ours.send, ["end"]).start()
    OutputLock(tmp_path).__enter__().__exit__()
    child.join()
    with OutputLock(tmp_path):
        pass
    for connection in (ours, theirs):
        connection.close()


def test_an_output_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match=r"out.*(is a file|is in the way)"):
        run(RenderJob("fake:street", [make_recipe()], tmp_path / "out"))
    assert (tmp_path / "out").read_text() == "mine"


FULL_DISK = """
import resource, sys
sys.path.insert(0, sys.argv[2])
from batch_scenes import fake_render, make_recipe, open_fake
from augment.jobs.render_job import RenderJob, run_job
from augment.errors import OutputError
resource.setrlimit(resource.RLIMIT_FSIZE, (1500, 1500))  # the LiDAR fits not, images do
job = RenderJob("fake:street", [make_recipe(semantic=False)], sys.argv[1])
try:
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
except OutputError as error:
    print(error)
"""


def test_a_refused_write_leaves_no_partial_file(tmp_path: Path) -> None:
    """A limit on file sizes stands in for a full disk: the kernel cuts the write in its midst."""
    run(RenderJob("fake:street", [make_recipe(semantic=False)], tmp_path / "whole"))
    whole = tree_digest(tmp_path / "whole")
    out = tmp_path / "out"
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, out, Path(__file__).parent],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "cannot write" in done.stdout and "File too large" in done.stdout, done.stderr
    left = {k: v for k, v in tree_digest(out).items() if not k.startswith(".climategs")}
    assert all(whole[name] == digest for name, digest in left.items())
    run(RenderJob("fake:street", [make_recipe(semantic=False)], out))
    assert tree_digest(out) == whole


def test_a_full_disk_stops_the_job_and_says_what_to_do(tmp_path, monkeypatch) -> None:
    real, left = os.fsync, [80]

    def flush(descriptor):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor)

    job = RenderJob("fake:street", [make_recipe()], tmp_path)
    monkeypatch.setattr(os, "fsync", flush)
    with pytest.raises(OutputError, match=r"cannot write .*: No space left.*free some space"):
        run(job)
    monkeypatch.undo()
    assert not list(tmp_path.rglob("*.climategs-tmp"))
    assert not (tmp_path / "manifest.parquet").exists()
    result = run(job)
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


def test_unlabelled_scenes_have_no_label_files(tmp_path: Path) -> None:
    run(RenderJob("fake:s?unlabelled=1", [make_recipe()], tmp_path, frames=[1]))
    rows = read_manifest(tmp_path).to_pylist()
    assert all(row["labels_path"] is None and row["lidar_path"] is None for row in rows)
    assert not (tmp_path / "s" / "fog-000" / "labels").exists()


def test_backends_are_checked_before_anything_is_written(tmp_path: Path) -> None:
    job = RenderJob("fake:street", [make_recipe()], tmp_path / "out", backend="vulkan")
    with pytest.raises(ValueError, match=r"backend must be one of auto, .*got 'vulkan'"):
        run(job, renderer=None)
    assert not (tmp_path / "out").exists()


def test_the_librarys_own_renderer(tmp_path: Path) -> None:
    """`auto` is written down as the backend that it stood for."""
    job = RenderJob(
        "fake:street", [make_recipe()], tmp_path, frames=[0], cameras=["front"], backend="reference"
    )
    assert run(job, renderer=None).failures == ()
    row = read_manifest(tmp_path).to_pylist()[0]
    assert row["backend"] == "reference"
    image = cv2.imread(str(tmp_path / row["image_path"]))
    assert image.std() > 1  # something of the scene is in it


def test_rows_that_are_merged_while_a_job_runs_stay(tmp_path: Path) -> None:
    """As `generate` does in the same output."""
    run(RenderJob("fake:other", [make_recipe()], tmp_path / "other"))
    others, out = read_manifest(tmp_path / "other"), tmp_path / "out"
    street = RenderJob("fake:street", [make_recipe()], out)
    run(street, on_outcome=lambda _: write_manifest(out, others))
    scenes = read_manifest(out)["scene"].to_pylist()
    assert scenes.count("other") == scenes.count("street") == others.num_rows
