"""What a job writes of smog: how much of each box's light comes through it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from batch_scenes import (
    ORIGIN_M,
    FakeLabels,
    fake_render,
    make_recipe,
    must_not_render,
    open_fake,
    tree_digest,
)

from augment.dataset import SceneDataset, WeatherDataset
from augment.effects.smog import box_transmittance
from augment.jobs.files import TABLES, visibility
from augment.jobs.layout import box_weather_files
from augment.jobs.manifest import read_manifest
from augment.jobs.render_job import JobResult, RenderJob, run_job
from recipes.schema import Recipe, Smog, Weather
from recipes.weather import Flood, Snow

FOLDER = Path("street") / "fog-000"
TABLE = FOLDER / "labels" / "smog.parquet"


def run(job: RenderJob, renderer=fake_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


def in_fog(**options) -> RenderJob:
    out = options.pop("out")
    return RenderJob("fake:street", [make_recipe()], out, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one uninterrupted run; shared, so nobody writes to it."""
    out = tmp_path_factory.mktemp("smog") / "out"
    assert run(in_fog(out=out)).failed == 0
    return out


@pytest.fixture
def older(whole: Path, tmp_path: Path) -> Path:
    """The same folder as a version without this table left it."""
    out = tmp_path / "older"
    shutil.copytree(whole, out)
    (out / TABLE).unlink()
    table = pq.read_table(out / "manifest.parquet")
    pq.write_table(table.drop_columns(["box_smog_path"]), out / "manifest.parquet")
    return out


def test_boxes_have_their_numbers_beside_the_labels(whole: Path) -> None:
    table = pq.read_table(whole / TABLE)
    assert table.column_names == [
        "frame", "camera", "track_id", "box", "transmittance", "pixels",
    ]  # fmt: skip
    scene, seen, estimated = open_fake("fake:street"), 0, 0
    rows = table.to_pylist()
    assert len(rows) == 2 * (0 + 1 + 2 + 3)
    for row in rows:
        boxes, k = FakeLabels().boxes(row["frame"]), row["box"]
        camera = scene.frame(row["frame"]).cameras[row["camera"]]
        smoggy = fake_render(scene, camera, make_recipe(), backend="auto").smoggy
        assert smoggy is not None
        got = box_transmittance(boxes, ORIGIN_M, camera, smoggy.medium, smoggy.surface_depth_m)
        assert row["track_id"] == boxes.track_ids[k]
        assert (row["transmittance"], row["pixels"]) == (got.transmittance[k], got.pixels[k])
        seen, estimated = seen + (row["pixels"] > 0), estimated + (row["pixels"] == 0)
    assert seen and estimated
    for row in read_manifest(whole).to_pylist():
        assert row["box_smog_path"] == TABLE.as_posix()


def test_without_density_all_comes_through_and_without_smog_nothing_is_said(tmp_path) -> None:
    thin = make_recipe().model_copy(update={"weather": Weather(smog=Smog(extinction_per_m=0))})
    run(RenderJob("fake:street", [thin, make_recipe("clear")], tmp_path))
    rows = pq.read_table(tmp_path / TABLE).to_pylist()
    assert {(row["transmittance"], row["pixels"]) for row in rows} == {(1.0, None)}
    assert not (tmp_path / "street/clear-000/labels/smog.parquet").exists()
    paths = {row["variant"]: row["box_smog_path"] for row in read_manifest(tmp_path).to_pylist()}
    assert paths == {"fog-000": TABLE.as_posix(), "clear-000": None}


def test_a_finished_folder_of_before_stays_as_it_is(older: Path) -> None:
    """Rendering all of it again would be the only way to the numbers: nobody asked for that."""
    before = tree_digest(older)
    result = run(in_fog(out=older), must_not_render)
    assert (result.written, result.skipped) == (0, 8)
    assert tree_digest(older) == before
    sample = WeatherDataset(older)[5]
    assert sample["paths"]["box_smog"] is None and sample["boxes"]["transmittance"] is None


@pytest.mark.parametrize("lost", ["labels/boxes.parquet", "calibration.json"])
def test_what_else_is_lost_in_it_comes_back_without_rendering(whole, older, lost: str) -> None:
    (older / FOLDER / lost).unlink()
    assert run(in_fog(out=older), must_not_render).skipped == 8
    assert (older / FOLDER / lost).read_bytes() == (whole / FOLDER / lost).read_bytes()
    assert not (older / TABLE).exists()


def test_new_images_of_an_older_folder_have_their_numbers(whole: Path, older: Path) -> None:
    """The others keep none, and the next run has nothing to do."""
    images = older / FOLDER / "images" / "front"
    for frame in (0, 2):
        (images / f"{frame:06d}.png").unlink()
    assert run(in_fog(out=older)).written == 2
    table = TABLES["box_smog"].read(older / TABLE)
    assert set(table) == {(0, "front"), (2, "front")}
    expected = TABLES["box_smog"].read(whole / TABLE)
    np.testing.assert_array_equal(
        table[2, "front"]["transmittance"], expected[2, "front"]["transmittance"]
    )
    has = {
        (r["frame"], r["camera"]) for r in read_manifest(older).to_pylist() if r["box_smog_path"]
    }
    assert has == set(table)
    assert len([s for s in WeatherDataset(older) if s["boxes"]["transmittance"] is not None]) == 2
    assert run(in_fog(out=older), must_not_render).skipped == 8
    (older / TABLE).unlink()
    assert run(in_fog(out=older)).written == 2


def test_samples_hold_them_read_or_rendered(whole: Path) -> None:
    sample = WeatherDataset(whole, cameras=["front"], frames=[2])[0]
    numbers = TABLES["box_smog"].read(whole / TABLE)[2, "front"]
    np.testing.assert_array_equal(sample["boxes"]["transmittance"], numbers["transmittance"])
    live = SceneDataset(open_fake("fake:street"), make_recipe(), renderer=fake_render)[4]
    assert (live["frame"], live["camera"]["name"]) == (2, "front")
    np.testing.assert_array_equal(live["boxes"]["transmittance"], numbers["transmittance"])


def test_visibility_is_what_all_effects_leave() -> None:
    names = ("a", "b", "c", "d")
    smog = TABLES["box_smog"].from_json([names, [0.5, 0.25, 1.0, np.nan], [9, 0, 9, -1]])
    water = TABLES["box_water"].from_json([names, [0.0] * 4, [10, 0, 4, 0], [5, 0, 4, 0]])
    snow = TABLES["box_snow"].from_json([names, [-1, -1, 8, -1], [0, 0, 2, 0]])
    np.testing.assert_array_equal(visibility({}, 4), np.ones(4))
    np.testing.assert_array_equal(visibility({"box_smog": smog}, 4), [0.5, 0.25, 1, 1])
    np.testing.assert_array_equal(visibility({"box_water": water}, 4), [0.5, 1, 0, 1])
    np.testing.assert_array_equal(visibility({"box_snow": snow}, 4), [1, 1, 0.75, 1])
    everything = {"box_smog": smog, "box_water": water, "box_snow": snow}
    assert everything.keys() == TABLES.keys() - {"box_2d"}  # which is not of the weather
    np.testing.assert_array_equal(visibility(everything, 4), [0.25, 0.25, 0, 1])
    assert visibility({}, 0).shape == (0,) and visibility({}, 0).dtype == np.float64


def test_visibility_of_a_variant_with_all_effects(tmp_path: Path) -> None:
    recipe: Recipe = make_recipe(flood=Flood(level_m=0.3), snow=Snow(depth_m=0))
    run(RenderJob("fake:street", [recipe], tmp_path, frames=[3]))
    files = box_weather_files(recipe)
    tables = {kind: TABLES[kind].read(tmp_path / FOLDER / files[kind]) for kind in files}
    assert tables.keys() == TABLES.keys()
    for item in tables["box_smog"]:
        left = visibility({kind: table[item] for kind, table in tables.items()}, 3)
        assert ((left >= 0) & (left <= 1)).all()
        assert (left <= tables["box_smog"][item]["transmittance"]).all()
