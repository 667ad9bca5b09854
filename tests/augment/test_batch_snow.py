"""What a job writes of snow: masks, and how much of each box is covered."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from batch_scenes import (
    ORIGIN_M,
    THICKNESS_M,
    FakeLabels,
    FakeView,
    fake_render,
    make_recipe,
    must_not_render,
    open_fake,
    tree_digest,
)

from augment.dataset import SceneDataset, WeatherDataset, collate_frames
from augment.effects.snow.snow import snow_pixels
from augment.jobs.files import TABLES
from augment.jobs.manifest import read_manifest
from augment.jobs.render_job import JobResult, RenderJob, run_job
from recipes.schema import Recipe
from recipes.weather import Flood, Snow

# Snow of no depth is not laid, so no place is looked for; the stand-in draws some all the same.
SNOW = Snow(depth_m=0)
FLOOD = Flood(level_m=0.3)
FOLDER = Path("street") / "fog-000"


def run(job: RenderJob, renderer=fake_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """Snow and a flood: neither may get into the other's files."""
    return make_recipe(snow=SNOW, flood=FLOOD)


@pytest.fixture(scope="module")
def whole(recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one uninterrupted run; shared, so nobody writes to it."""
    out = tmp_path_factory.mktemp("snow") / "out"
    assert run(RenderJob("fake:street", [recipe], out)).failed == 0
    return out


def view_of(row: dict, recipe: Recipe) -> FakeView:
    scene = open_fake("fake:street")
    camera = scene.frame(row["frame"]).cameras[row["camera"]]
    return fake_render(scene, camera, recipe, backend="auto")


def test_masks_hold_what_was_rendered(whole: Path, recipe: Recipe) -> None:
    rows = read_manifest(whole).to_pylist()
    assert {row["snow_path"] for row in rows} == {
        f"street/fog-000/snow/{camera}/00000{frame}.png"
        for camera in ("front", "rear_left-16c859cb")
        for frame in range(4)
    }
    for row in rows:
        mask = cv2.imread(str(whole / row["snow_path"]), cv2.IMREAD_UNCHANGED)
        assert mask.dtype == np.uint8
        np.testing.assert_array_equal(mask, view_of(row, recipe).snow)
        assert (row["snow_depth_m"], row["snow_coverage"]) == (0.0, 1.0)


def test_boxes_have_their_numbers_beside_the_labels(whole: Path, recipe: Recipe) -> None:
    path = whole / FOLDER / "labels" / "snow.parquet"
    table = pq.read_table(path)
    assert table.column_names == [
        "frame", "camera", "track_id", "box", "pixels", "snow_pixels", "snow_fraction",
    ]  # fmt: skip
    rows = table.to_pylist()
    assert [(row["frame"], row["camera"], row["box"]) for row in rows] == [
        (frame, camera, box)
        for frame in range(4)
        for camera in ("front", "rear/left")
        for box in range(frame % 4)
    ]
    seen = snowy = 0
    for row in rows:
        boxes, view, k = FakeLabels().boxes(row["frame"]), view_of(row, recipe), row["box"]
        assert row["track_id"] == boxes.track_ids[k]
        if view.snowy.surface_depth_m is None:
            assert (row["frame"], row["camera"]) == (3, "rear/left")
            assert (row["pixels"], row["snow_pixels"], row["snow_fraction"]) == (None, 0, 0.0)
            continue
        camera = open_fake("fake:street").frame(row["frame"]).cameras[row["camera"]]
        depth = view.snowy.surface_depth_m
        counted = snow_pixels(boxes, ORIGIN_M, camera, depth, view.snow, THICKNESS_M)
        assert (row["pixels"], row["snow_pixels"]) == (counted.pixels[k], counted.marked[k])
        seen, snowy = seen + row["pixels"], snowy + row["snow_pixels"]
        if row["pixels"]:
            assert row["snow_fraction"] == row["snow_pixels"] / row["pixels"]
        else:
            assert np.isnan(row["snow_fraction"])
    assert seen > snowy > 0
    for row in read_manifest(whole).to_pylist():
        assert whole / row["box_snow_path"] == path


def test_a_flood_and_snow_do_not_change_each_others_numbers(whole: Path, tmp_path: Path) -> None:
    """The stand-in's water does not depend on whether it draws snow too."""
    labels = whole / FOLDER / "labels"
    assert sorted(path.name for path in labels.iterdir()) == [
        "boxes.parquet", "boxes_2d.parquet", "smog.parquet", "snow.parquet", "water.parquet",
    ]  # fmt: skip
    run(RenderJob("fake:street", [make_recipe()], tmp_path))
    bare = tmp_path / FOLDER
    assert (bare / "labels/boxes.parquet").read_bytes() == (labels / "boxes.parquet").read_bytes()
    assert not (bare / "labels/snow.parquet").exists() and not (bare / "snow").exists()
    rows = read_manifest(tmp_path).to_pylist()
    assert all(row["snow_path"] is row["box_snow_path"] is None for row in rows)
    assert all(np.isnan(row["snow_depth_m"]) and np.isnan(row["snow_coverage"]) for row in rows)


@pytest.mark.parametrize(
    ("uri", "output"), [("fake:street?unlabelled=1", {}), ("fake:street", {"labels": False})]
)
def test_without_labels_there_is_only_the_mask(tmp_path: Path, uri: str, output: dict) -> None:
    recipe = make_recipe(snow=SNOW, flood=FLOOD, **output)
    assert run(RenderJob(uri, [recipe], tmp_path)).failed == 0
    rows = read_manifest(tmp_path).to_pylist()
    assert all(row["snow_path"] and row["water_path"] for row in rows)
    assert {row[f"{kind}_path"] for row in rows for kind in TABLES} == {None}
    assert not (tmp_path / FOLDER / "labels").exists()
    assert run(RenderJob(uri, [recipe], tmp_path), must_not_render).skipped == 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"snow": None}, "returned no snow buffer"),
        ({"snow": np.zeros((8, 12), np.uint8)}, r"snow of \[8, 12\].*16 rows of 24 pixels"),
        ({"snow": np.ones((16, 24), np.uint8)}, r"mask must hold 0 and 255 only; got \[1\]"),
        ({"snowy": None}, "returned no snow depth for a recipe with snow"),
    ],
)
def test_a_view_that_breaks_its_promise_is_recorded(tmp_path, recipe, change, message) -> None:
    def render(scene, camera, recipe, *, backend):
        view = fake_render(scene, camera, recipe, backend=backend)
        return FakeView(**{**vars(view), **change})

    job = RenderJob("fake:s", [recipe], tmp_path, frames=[1], cameras=["front"])
    result = run(job, render)
    assert result.failed == 1
    assert re.search(message, result.failures[0])
    assert not TABLES["box_snow"].read(tmp_path / "s" / "fog-000" / "labels" / "snow.parquet")


def test_snow_under_a_recipe_without_is_recorded(tmp_path: Path) -> None:
    def render(scene, camera, recipe, *, backend):
        return fake_render(scene, camera, make_recipe(snow=SNOW), backend=backend)

    result = run(RenderJob("fake:s", [make_recipe()], tmp_path, frames=[1]), render)
    assert result.failed == 2 and "a snow depth for a recipe without snow" in result.failures[0]


def test_parts_in_any_order_give_the_files_of_one_run(whole: Path, recipe, tmp_path: Path) -> None:
    run(RenderJob("fake:street", [recipe], tmp_path, frames=[3, 1], cameras=["rear/left"]))
    assert len(TABLES["box_snow"].read(tmp_path / FOLDER / "labels" / "snow.parquet")) == 2
    run(RenderJob("fake:street", [recipe], tmp_path, cameras=["front"]))
    assert run(RenderJob("fake:street", [recipe], tmp_path)).skipped == 6
    assert tree_digest(tmp_path) == tree_digest(whole)


@pytest.mark.parametrize(
    ("lost", "rendered"),
    [
        (["snow/front/000001.png", "water/front/000002.png"], 2),
        (["labels/snow.parquet", "labels/water.parquet", "labels/smog.parquet"], 8),
        (["labels/water.parquet"], 8),
        (["labels/smog.parquet"], 8),
        (["labels/boxes.parquet"], 0),  # which the scene still has
    ],
)
def test_what_is_lost_is_made_again(whole: Path, recipe, tmp_path: Path, lost, rendered) -> None:
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    for name in lost:
        (out / FOLDER / name).unlink()
    assert run(RenderJob("fake:street", [recipe], out)).written == rendered
    assert tree_digest(out) == tree_digest(whole)


def test_folders_from_before_there_was_snow_are_gone_on_with(tmp_path: Path) -> None:
    """A manifest and a journal that know of floods, and of `scene` as the surface shown."""
    recipe = make_recipe(flood=FLOOD)
    whole, old = tmp_path / "whole", tmp_path / "old"
    run(RenderJob("fake:street", [recipe], whole))
    run(RenderJob("fake:street", [recipe], old, frames=[0, 1]))
    manifest = old / "manifest.parquet"
    table = pq.read_table(manifest)
    later = [name for name in table.column_names if "snow" in name]
    assert len(later) == 4
    table = table.drop_columns(later)
    place = table.column_names.index("surface")
    table = table.set_column(place, "surface", [["scene"] * table.num_rows])
    pq.write_table(table, manifest)
    sample = WeatherDataset(old)[3]
    assert sample["snow"] is None and sample["water"] is not None
    assert sample["boxes"]["snow_fraction"] is None and sample["surface"] == "scene"
    assert run(RenderJob("fake:street", [recipe], old)).skipped == 4
    assert tree_digest(old) == tree_digest(whole)


def test_samples_hold_the_snow(whole: Path, recipe: Recipe) -> None:
    files = WeatherDataset(whole, cameras=["front"], frames=[2])
    (row,) = files.table.to_pylist()
    sample, view = files[0], view_of(row, recipe)
    np.testing.assert_array_equal(sample["snow"].numpy(), view.snow > 0)
    numbers = TABLES["box_snow"].read(whole / FOLDER / "labels" / "snow.parquet")[2, "front"]
    np.testing.assert_array_equal(sample["boxes"]["snow_fraction"], numbers["snow_fraction"])
    assert sample["paths"]["snow"].endswith("snow/front/000002.png")
    assert sample["weather"]["snow_depth_m"] == 0.0
    live = SceneDataset(open_fake("fake:street"), recipe, renderer=fake_render)[4]
    assert (live["frame"], live["camera"]["name"]) == (2, "front")
    np.testing.assert_array_equal(live["snow"], sample["snow"])
    np.testing.assert_array_equal(live["boxes"]["snow_fraction"], numbers["snow_fraction"])
    batch = collate_frames([sample, live])
    assert batch["snow"].shape == (2, 16, 24)
