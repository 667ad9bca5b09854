"""What a job writes under a flood: water masks, and what the water does to the boxes."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from batch_scenes import (
    LEVEL_Z_M,
    ORIGIN_M,
    FakeLabels,
    FakeView,
    fake_render,
    make_camera,
    make_frame,
    make_recipe,
    must_not_render,
    open_fake,
    tree_digest,
)

from augment.cameras import Frame
from augment.dataset import WeatherDataset
from augment.effects.flood.flood import hidden_pixels, submerged_fraction
from augment.jobs.files import TABLES
from augment.jobs.manifest import LATER, read_manifest
from augment.jobs.render_job import JobResult, RenderJob, run_job
from recipes.schema import Recipe
from recipes.weather import Flood

FLOOD = Flood(level_m=0.3)
FOLDER = Path("street") / "fog-000"


def run(job: RenderJob, renderer=fake_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    return make_recipe(flood=FLOOD)


@pytest.fixture(scope="module")
def whole(recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one uninterrupted run; shared, so nobody writes to it."""
    out = tmp_path_factory.mktemp("water") / "out"
    assert run(RenderJob("fake:street", [recipe], out)).failed == 0
    return out


def test_masks_hold_what_was_rendered(whole: Path, recipe: Recipe) -> None:
    scene = open_fake("fake:street")
    rows = read_manifest(whole).to_pylist()
    assert {row["water_path"] for row in rows} == {
        f"street/fog-000/water/{camera}/00000{frame}.png"
        for camera in ("front", "rear_left-16c859cb")
        for frame in range(4)
    }
    for row in rows:
        camera = scene.frame(row["frame"]).cameras[row["camera"]]
        view = fake_render(scene, camera, recipe, backend="auto")
        mask = cv2.imread(str(whole / row["water_path"]), cv2.IMREAD_UNCHANGED)
        assert mask.dtype == np.uint8
        np.testing.assert_array_equal(mask, view.water)
    assert {row["surface"] for row in rows} == {"solid"}


def test_boxes_have_their_numbers_beside_the_labels(whole: Path, recipe: Recipe) -> None:
    """Read with any Parquet reader, a row per frame, camera and box."""
    path = whole / FOLDER / "labels" / "water.parquet"
    rows = pq.read_table(path).to_pylist()
    keys = [(row["frame"], row["camera"], row["box"]) for row in rows]
    assert keys == [
        (frame, camera, box)
        for frame in range(4)
        for camera in ("front", "rear/left")
        for box in range(frame % 4)
    ]
    scene, seen, hidden = open_fake("fake:street"), 0, 0
    for row in rows:
        boxes = FakeLabels().boxes(row["frame"])
        camera = scene.frame(row["frame"]).cameras[row["camera"]]
        view = fake_render(scene, camera, recipe, backend="auto")
        k = row["box"]
        assert row["track_id"] == boxes.track_ids[k]
        assert row["submerged_fraction"] == submerged_fraction(boxes, ORIGIN_M, LEVEL_Z_M)[k]
        if view.flood.scene_depth_m is None:
            assert (row["frame"], row["camera"]) == (3, "rear/left")
            numbers = [row[n] for n in ("pixels", "hidden_pixels", "hidden_fraction")]
            assert numbers == [None, 0, 0.0]
            continue
        counted = hidden_pixels(boxes, ORIGIN_M, camera, view.flood.scene_depth_m, view.water)
        assert (row["pixels"], row["hidden_pixels"]) == (counted.pixels[k], counted.marked[k])
        seen, hidden = seen + row["pixels"], hidden + row["hidden_pixels"]
        if row["pixels"]:
            assert row["hidden_fraction"] == row["hidden_pixels"] / row["pixels"]
        else:
            assert np.isnan(row["hidden_fraction"])
    assert seen > hidden > 0
    row = read_manifest(whole).to_pylist()[0]
    assert whole / row["box_water_path"] == path
    # The labels themselves are those of a clear day.
    run(RenderJob("fake:street", [make_recipe()], whole.parent / "dry"))
    dry = whole.parent / "dry" / FOLDER / "labels"
    assert (dry / "boxes.parquet").read_bytes() == (path.parent / "boxes.parquet").read_bytes()
    assert not (dry / "water.parquet").exists() and not (dry.parent / "water").exists()


def test_images_without_boxes_are_listed(whole: Path) -> None:
    water = TABLES["box_water"].read(whole / FOLDER / "labels" / "water.parquet")
    assert {(f, len(numbers.track_ids)) for (f, _), numbers in water.items()} == {
        (0, 0),
        (1, 1),
        (2, 2),
        (3, 3),
    }
    assert len(water) == 8


def test_a_camera_path_has_them_where_it_has_labels(tmp_path: Path, recipe: Recipe) -> None:
    recorded = make_frame(1)
    path = [
        Frame(1, recorded.timestamp_ns, recorded.world_from_ego,
              {"front": make_camera("front", recorded.timestamp_ns, 0.5)}),
        Frame(2, 5, recorded.world_from_ego, {"front": make_camera("front", 5, 0.7)}),
    ]  # fmt: skip
    job = RenderJob("fake:street", [recipe], tmp_path, camera_path=path)
    assert run(job).written == 2
    rows = read_manifest(tmp_path).to_pylist()
    assert [row["box_water_path"] is None for row in rows] == [False, True]
    assert list(TABLES["box_water"].read(tmp_path / FOLDER / "labels" / "water.parquet")) == [
        (1, "front")
    ]
    assert run(job, must_not_render).skipped == 2


def test_the_manifest_says_which_surface_is_shown(tmp_path: Path) -> None:
    run(RenderJob("fake:s", [make_recipe(flood=FLOOD, surface="first")], tmp_path, frames=[0]))
    assert set(read_manifest(tmp_path)["surface"].to_pylist()) == {"first"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"water": None}, "returned no water buffer"),
        ({"water": np.zeros((8, 12), np.uint8)}, r"water of \[8, 12\].*16 rows of 24 pixels"),
        ({"water": np.ones((16, 24), np.uint8)}, r"mask must hold 0 and 255 only; got \[1\]"),
        ({"water": np.zeros((16, 24), bool)}, "mask must be uint8"),
        ({"flood": None}, "returned no water level for a recipe with a flood"),
    ],
)
def test_a_renderer_that_breaks_its_contract_is_recorded(
    tmp_path, recipe, unchecked, change, message
) -> None:
    def render(scene, camera, recipe, *, backend):
        view = fake_render(scene, camera, recipe, backend=backend)
        return FakeView(**{**vars(view), **change})

    job = RenderJob("fake:s", [recipe], tmp_path, frames=[1], cameras=["front"])
    result = run(job, render)
    assert result.failed == 1
    assert re.search(message, result.failures[0])
    assert not TABLES["box_water"].read(tmp_path / "s" / "fog-000" / "labels" / "water.parquet")


def test_a_view_of_water_under_a_recipe_without_is_recorded(tmp_path: Path) -> None:
    def render(scene, camera, recipe, *, backend):
        return fake_render(scene, camera, make_recipe(flood=FLOOD), backend=backend)

    job = RenderJob("fake:s", [make_recipe(semantic=False)], tmp_path, frames=[1])
    result = run(job, render)
    assert result.failed == 2 and "a water level for a recipe without a flood" in result.failures[0]


def test_a_damaged_table_counts_as_lost(whole: Path, recipe, tmp_path: Path, caplog) -> None:
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    table = out / FOLDER / "labels" / "water.parquet"
    table.write_bytes(table.read_bytes()[:100])
    assert run(RenderJob("fake:street", [recipe], out)).written == 8
    assert "water.parquet is missing or not a readable" in caplog.text
    assert tree_digest(out) == tree_digest(whole)


def test_a_journal_carries_the_numbers(whole: Path, recipe, tmp_path: Path) -> None:
    """As a kill leaves a folder: a journal, and neither tables nor manifest."""
    out = tmp_path / "out"

    def stops(scene, camera, recipe, *, backend):
        if camera.name == "front" and camera.timestamp_ns == make_frame(2).timestamp_ns:
            raise SystemExit("stopped without a chance to tidy up")
        return fake_render(scene, camera, recipe, backend=backend)

    with pytest.raises(SystemExit):
        run(RenderJob("fake:street", [recipe], out), stops)
    assert not (out / "manifest.parquet").exists()
    assert not (out / FOLDER / "labels").exists()
    result = run(RenderJob("fake:street", [recipe], out))
    assert (result.skipped, result.written) == (4, 4)
    assert tree_digest(out) == tree_digest(whole)


def test_an_image_that_fails_later_loses_its_rows(whole: Path, recipe, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    (out / FOLDER / "images" / "front" / "000003.png").unlink()

    def fails(scene, camera, recipe, *, backend):
        raise RuntimeError("no such luck")

    assert run(RenderJob("fake:street", [recipe], out), fails).failed == 1
    assert (3, "front") not in TABLES["box_water"].read(out / FOLDER / "labels" / "water.parquet")
    assert run(RenderJob("fake:street", [recipe], out)).written == 1
    assert tree_digest(out) == tree_digest(whole)


def test_labels_that_cannot_be_measured_fail_their_image(recipe, tmp_path: Path) -> None:
    class Labels(FakeLabels):
        calls = 0

        def boxes(self, frame_index):
            Labels.calls += 1
            if Labels.calls > 5:  # the job itself has read this frame's, and all four for tracks
                raise EOFError("compressed file ended early")
            return super().boxes(frame_index)

    def open_scene(uri):
        return dataclasses.replace(open_fake(uri), labels=Labels())

    job = RenderJob("fake:street", [recipe], tmp_path, frames=[2], cameras=["front"])
    result = run(job, scene_loader=open_scene)
    assert result.failures[0].endswith("measuring the boxes: EOFError: compressed file ended early")


def test_manifests_of_older_versions_are_read_and_gone_on_with(tmp_path: Path) -> None:
    """Without the columns that came later: no style; no weather, so surfaces are alike."""
    whole, old = tmp_path / "whole", tmp_path / "old"
    run(RenderJob("fake:street", [make_recipe("clear")], whole))
    run(RenderJob("fake:street", [make_recipe("clear")], old, frames=[0, 1]))
    manifest = old / "manifest.parquet"
    table = pq.read_table(manifest)
    numbers = [
        n
        for n in table.column_names
        if n.startswith(("flood_", "snow_", "style_")) and n not in LATER
    ]
    later = [*numbers, *LATER]
    assert len(numbers) == 6
    pq.write_table(table.drop_columns(later), manifest)
    assert read_manifest(old).column_names == [
        name for name in table.column_names if name not in numbers
    ]
    assert read_manifest(old)["surface"].to_pylist() == ["solid"] * 4
    sample = WeatherDataset(old)[0]
    assert sample["surface"] == "solid" and sample["water"] is sample["snow"] is None
    assert sample["boxes"]["submerged_fraction"] is sample["boxes"]["transmittance"] is None
    assert run(RenderJob("fake:street", [make_recipe("clear")], old)).skipped == 4
    assert digest_without_2d(old) == digest_without_2d(whole)
    assert rows_without_2d(old) == rows_without_2d(whole)
    measured = [row["box_2d_path"] is not None for row in read_manifest(old).to_pylist()]
    assert measured == [False] * 4 + [True] * 4  # only rendering tells


def digest_without_2d(out: Path) -> dict[str, str]:
    files = tree_digest(out / "street")
    assert files.pop("clear-000/labels/boxes_2d.parquet")
    return files


def rows_without_2d(out: Path) -> list[str]:
    """Without what only rendering tells."""
    unknown = dict.fromkeys(("box_2d_path", "lidar", "lidar_note"))
    return [repr({**row, **unknown}) for row in read_manifest(out).to_pylist()]


def test_journals_of_older_versions_are_gone_on_with(tmp_path: Path) -> None:
    run(RenderJob("fake:street", [make_recipe("clear")], tmp_path / "whole"))
    out = tmp_path / "old"
    run(RenderJob("fake:street", [make_recipe("clear")], out, frames=[0, 1]))
    rows = read_manifest(out).to_pylist()
    (out / "manifest.parquet").unlink()
    identity = ("source", "recipe_hash", "trajectory", "version", "backend")
    lines = [{name: rows[0][name] for name in identity}]
    lines += [{name: row[name] for name in row if name not in LATER} for row in rows]
    progress_log = out / ".climategs" / "journal" / "street" / "clear-000.jsonl"
    progress_log.parent.mkdir(parents=True)
    progress_log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert run(RenderJob("fake:street", [make_recipe("clear")], out)).skipped == 4
    assert digest_without_2d(out) == digest_without_2d(tmp_path / "whole")
    assert rows_without_2d(out) == rows_without_2d(tmp_path / "whole")
