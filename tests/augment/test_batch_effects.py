"""What a job writes of flood, snow and smog: masks, and what they do to the boxes."""

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
    THICKNESS_M,
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

from augment.boxes import PlacedBoxes
from augment.cameras import Camera, Frame
from augment.dataset import SceneDataset, WeatherDataset, collate_frames
from augment.effects.flood.effect import hidden_pixels, submerged_fraction
from augment.effects.smog import box_transmittance
from augment.effects.snow.snow import snow_pixels
from augment.jobs.files import box_tables, visibility
from augment.jobs.manifest import later_columns, read_manifest
from augment.jobs.render_job import JobResult, RenderJob, run_job
from augment.labels import Boxes
from recipes.flood import Flood
from recipes.schema import Recipe, Smog, Weather
from recipes.snow import Snow

# Snow of no depth is not laid, so no place is looked for; the stand-in draws some all the same.
SNOW, FLOOD = Snow(depth_m=0), Flood(level_m=0.3)
FOLDER = Path("street") / "fog-000"
LABELS = FOLDER / "labels"
CLEAR = make_recipe("clear")


def run(job: RenderJob, renderer=fake_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """All effects: none may get into another one's files."""
    return make_recipe(snow=SNOW, flood=FLOOD)


@pytest.fixture(scope="module")
def whole(recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one uninterrupted run; shared, so nobody writes to it."""
    out = tmp_path_factory.mktemp("effects") / "out"
    assert run(RenderJob("fake:street", [recipe], out)).failed == 0
    return out


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "copied"))


def rows_of(out: Path) -> list[dict]:
    return read_manifest(out).to_pylist()


def camera_and_view(row: dict, recipe: Recipe) -> tuple[Camera, FakeView]:
    scene = open_fake("fake:street")
    camera = scene.frame(row["frame"]).cameras[row["camera"]]
    return camera, fake_render(scene, camera, recipe, backend="auto")


@pytest.mark.parametrize("kind", ["water", "snow"])
def test_masks_hold_what_was_rendered(whole: Path, recipe: Recipe, kind: str) -> None:
    assert {row[f"{kind}_path"] for row in rows_of(whole)} == {
        f"street/fog-000/{kind}/{camera}/00000{frame}.png"
        for camera in ("front", "rear_left-16c859cb")
        for frame in range(4)
    }
    for row in rows_of(whole):
        mask = cv2.imread(str(whole / row[f"{kind}_path"]), cv2.IMREAD_UNCHANGED)
        assert mask.dtype == np.uint8
        np.testing.assert_array_equal(mask, camera_and_view(row, recipe)[1].masks[kind])
        assert (row["snow_depth_m"], row["surface"]) == (0.0, "solid")


def expected_numbers(kind: str, boxes: Boxes, camera: Camera, view: FakeView) -> dict:
    """Of what the file has of each box, without what follows from it."""
    placed = PlacedBoxes.of(boxes, ORIGIN_M)
    if kind == "smog":
        seen = view.effects["smog"]
        found = box_transmittance(placed, camera, seen.placed.data.fog, seen.depth_m)
        return {"transmittance": found.transmittance, "pixels": found.pixels}
    seen = view.effects["flood" if kind == "water" else kind]
    if kind == "snow":
        if seen.depth_m is None:
            return {}
        counted = snow_pixels(placed, camera, seen.depth_m, view.masks["snow"], THICKNESS_M)
        return {"pixels": counted.pixels, "snow_pixels": counted.marked}
    found = {"submerged_fraction": submerged_fraction(placed, LEVEL_Z_M)}
    if seen.depth_m is not None:
        counted = hidden_pixels(placed, camera, seen.depth_m, view.masks["water"])
        found |= {"pixels": counted.pixels, "hidden_pixels": counted.marked}
    return found


@pytest.mark.parametrize(
    ("kind", "marked", "fraction"),
    [
        ("water", "hidden_pixels", "hidden_fraction"),
        ("snow", "snow_pixels", "snow_fraction"),
        ("smog", None, None),
    ],
)
def test_boxes_have_their_numbers_beside_the_labels(
    whole: Path, recipe: Recipe, kind, marked, fraction
) -> None:
    """Read with any Parquet reader, a row per frame, camera and box."""
    path = whole / LABELS / f"{kind}.parquet"
    rows = pq.read_table(path).to_pylist()
    assert [(row["frame"], row["camera"], row["box"]) for row in rows] == [
        (frame, camera, box)
        for frame in range(4)
        for camera in ("front", "rear/left")
        for box in range(frame % 4)
    ]
    for row in rows:
        boxes, k = FakeLabels().boxes(row["frame"]), row["box"]
        assert row["track_id"] == boxes.track_ids[k]
        expected = expected_numbers(kind, boxes, *camera_and_view(row, recipe))
        assert {name: row[name] for name in expected} == {n: v[k] for n, v in expected.items()}
        if "pixels" not in expected:  # none of it is in view
            assert (row["frame"], row["camera"]) == (3, "rear/left")
            assert (row["pixels"], row[marked], row[fraction]) == (None, 0, 0.0)
        elif fraction is not None and row["pixels"]:
            assert row[fraction] == row[marked] / row["pixels"]
        elif fraction is not None:
            assert np.isnan(row[fraction])
    pixels = [row["pixels"] or 0 for row in rows]
    assert 0 in pixels and max(pixels) > 0
    assert marked is None or sum(pixels) > sum(row[marked] for row in rows) > 0
    assert all(whole / row[f"box_{kind}_path"] == path for row in rows_of(whole))


def test_a_clear_day_has_the_same_labels_and_no_tables(whole: Path, tmp_path: Path) -> None:
    names = ["boxes", "boxes_2d", "smog", "snow", "water"]
    assert sorted(p.name for p in (whole / LABELS).iterdir()) == [f"{n}.parquet" for n in names]
    run(RenderJob("fake:street", [CLEAR], tmp_path))
    clear = tmp_path / "street/clear-000"
    assert sorted(p.name for p in (clear / "labels").iterdir()) == [
        f"{n}.parquet" for n in names[:2]
    ]
    boxes = (whole / LABELS / "boxes.parquet").read_bytes()
    assert (clear / "labels/boxes.parquet").read_bytes() == boxes
    assert not (clear / "snow").exists() and not (clear / "water").exists()
    for row in rows_of(tmp_path):
        kinds = ("snow", "water", "box_snow", "box_water", "box_smog")
        assert {row[f"{kind}_path"] for kind in kinds} == {None}
        assert np.isnan(row["snow_depth_m"])


def test_images_without_boxes_are_listed(whole: Path) -> None:
    water = box_tables()["box_water"].read(whole / LABELS / "water.parquet")
    assert {(f, len(numbers.track_ids)) for (f, _), numbers in water.items()} == {
        (number, number) for number in range(4)
    }
    assert len(water) == 8


def test_a_camera_path_has_them_where_it_has_labels(tmp_path: Path, recipe: Recipe) -> None:
    recorded = make_frame(1)
    path = [
        Frame(number, time, recorded.world_from_ego, {"front": make_camera("front", time, 0.5)})
        for number, time in ((1, recorded.timestamp_ns), (2, 5))
    ]
    job = RenderJob("fake:street", [recipe], tmp_path, camera_path=path)
    assert run(job).written == 2
    assert [row["box_water_path"] is None for row in rows_of(tmp_path)] == [False, True]
    water = box_tables()["box_water"].read(tmp_path / LABELS / "water.parquet")
    assert list(water) == [(1, "front")]
    assert run(job, must_not_render).skipped == 2


def test_the_manifest_says_which_surface_is_shown(tmp_path: Path) -> None:
    run(RenderJob("fake:s", [make_recipe(flood=FLOOD, surface="first")], tmp_path, frames=[0]))
    assert {row["surface"] for row in rows_of(tmp_path)} == {"first"}


@pytest.mark.parametrize(
    ("uri", "output"), [("fake:street?unlabelled=1", {}), ("fake:street", {"labels": False})]
)
def test_without_labels_there_are_only_the_masks(tmp_path: Path, uri: str, output: dict) -> None:
    job = RenderJob(uri, [make_recipe(snow=SNOW, flood=FLOOD, **output)], tmp_path)
    assert run(job).failed == 0
    rows = rows_of(tmp_path)
    assert all(row["snow_path"] and row["water_path"] for row in rows)
    assert {row[f"{kind}_path"] for row in rows for kind in box_tables()} == {None}
    assert not (tmp_path / LABELS).exists()
    assert run(job, must_not_render).skipped == 8


def without(name: str):
    return lambda images: {key: image for key, image in images.items() if key != name}


def test_a_view_that_breaks_its_contract_is_recorded(tmp_path, recipe, unchecked) -> None:
    small, ones = np.zeros((8, 12), np.uint8), np.ones((16, 24), np.uint8)
    for number, (field, change, message) in enumerate([
        ("rgb", lambda _: np.zeros((16, 24, 3), np.float32), "rgb must be uint8"),
        ("rgb", lambda rgb: rgb[:8, :12], r"rgb of \[8, 12, 3\].*16 rows of 24 pixels"),
        ("depth_m", lambda _: None, "returned no depth_m buffer"),
        ("masks", without("water"), "returned no water buffer"),
        ("masks", lambda m: m | {"water": small}, r"water of \[8, 12\].*16 rows of 24 pixels"),
        ("masks", lambda m: m | {"water": ones}, r"mask must hold 0 and 255 only; got \[1\]"),
        ("masks", lambda m: m | {"water": ones > 1}, "mask must be uint8"),
        ("masks", lambda m: m | {"rain": ones}, "a rain buffer, which the recipe does not ask for"),
        ("effects", without("flood"), "labels of smog, snow are .* recipe with flood, smog, snow"),
    ]):  # fmt: skip

        def render(scene, camera, recipe, *, backend, field=field, change=change):
            view = fake_render(scene, camera, recipe, backend=backend)
            return dataclasses.replace(view, **{field: change(getattr(view, field))})

        out = tmp_path / str(number)
        result = run(RenderJob("fake:s", [recipe], out, frames=[1], cameras=["front"]), render)
        assert result.failed == 1 and re.search(message, result.failures[0]), result.failures
        for kind in ("water", "snow"):
            table = box_tables()[f"box_{kind}"]
            assert not table.read(out / "s/fog-000/labels" / f"{kind}.parquet")


def test_what_a_recipe_does_not_ask_for_is_recorded(tmp_path: Path) -> None:
    for number, (more, message) in enumerate((
        ({"flood": FLOOD}, "labels of flood, smog are measured from, for a recipe with smog"),
        ({"instance": True}, "a instance buffer, which the recipe does not ask for"),
    )):  # fmt: skip

        def render(scene, camera, recipe, *, backend, more=more):
            given = make_recipe(**{"instance": False, **more})
            return fake_render(scene, camera, given, backend=backend)

        job = RenderJob("fake:s", [make_recipe(instance=False)], tmp_path / str(number), frames=[1])
        result = run(job, render)
        assert result.failed == 2 and message in result.failures[0]


@pytest.mark.parametrize(
    ("lost", "rendered"),
    [
        (["snow/front/000001.png", "water/front/000002.png"], 2),
        (["labels/snow.parquet", "labels/water.parquet", "labels/smog.parquet"], 8),
        (["labels/smog.parquet"], 8),
        (["labels/boxes.parquet"], 0),  # which the scene still has
    ],
)
def test_what_is_lost_is_made_again(whole: Path, recipe, copied: Path, lost, rendered) -> None:
    for name in lost:
        (copied / FOLDER / name).unlink()
    assert run(RenderJob("fake:street", [recipe], copied)).written == rendered
    assert tree_digest(copied) == tree_digest(whole)


def test_a_damaged_table_counts_as_lost(whole: Path, recipe, copied: Path, caplog) -> None:
    table = copied / LABELS / "water.parquet"
    table.write_bytes(table.read_bytes()[:100])
    assert run(RenderJob("fake:street", [recipe], copied)).written == 8
    assert "water.parquet is missing or not a readable" in caplog.text
    assert tree_digest(copied) == tree_digest(whole)


def test_parts_in_any_order_give_the_files_of_one_run(whole: Path, recipe, tmp_path: Path) -> None:
    run(RenderJob("fake:street", [recipe], tmp_path, frames=[3, 1], cameras=["rear/left"]))
    assert len(box_tables()["box_snow"].read(tmp_path / LABELS / "snow.parquet")) == 2
    run(RenderJob("fake:street", [recipe], tmp_path, cameras=["front"]))
    assert run(RenderJob("fake:street", [recipe], tmp_path)).skipped == 6
    assert tree_digest(tmp_path) == tree_digest(whole)


def test_a_progress_log_carries_the_numbers(whole: Path, recipe, tmp_path: Path) -> None:
    """As a kill leaves a folder: a log, and neither tables nor manifest."""

    def stops(scene, camera, recipe, *, backend):
        if camera.name == "front" and camera.timestamp_ns == make_frame(2).timestamp_ns:
            raise SystemExit("stopped without a chance to tidy up")
        return fake_render(scene, camera, recipe, backend=backend)

    with pytest.raises(SystemExit):
        run(RenderJob("fake:street", [recipe], tmp_path), stops)
    assert not (tmp_path / "manifest.parquet").exists() and not (tmp_path / LABELS).exists()
    result = run(RenderJob("fake:street", [recipe], tmp_path))
    assert (result.skipped, result.written) == (4, 4)
    assert tree_digest(tmp_path) == tree_digest(whole)


def test_an_image_that_fails_later_loses_its_rows(whole: Path, recipe, copied: Path) -> None:
    (copied / FOLDER / "images" / "front" / "000003.png").unlink()

    def fails(scene, camera, recipe, *, backend):
        raise RuntimeError("no such luck")

    assert run(RenderJob("fake:street", [recipe], copied), fails).failed == 1
    assert (3, "front") not in box_tables()["box_water"].read(copied / LABELS / "water.parquet")
    assert run(RenderJob("fake:street", [recipe], copied)).written == 1
    assert tree_digest(copied) == tree_digest(whole)


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


@pytest.mark.parametrize("kept", ["manifest", "progress log"])
def test_outputs_of_the_first_version_are_gone_on_with(tmp_path: Path, kept: str) -> None:
    """Without the columns that came later: no style; no weather, so surfaces are alike."""
    whole, old = tmp_path / "whole", tmp_path / "old"
    run(RenderJob("fake:street", [CLEAR], whole))
    run(RenderJob("fake:street", [CLEAR], old, frames=[0, 1]))
    manifest = old / "manifest.parquet"
    table = pq.read_table(manifest)
    if kept == "manifest":
        numbers = [
            n
            for n in table.column_names
            if n.startswith(("flood_", "snow_", "style_")) and n not in later_columns()
        ]
        assert len(numbers) == 6
        pq.write_table(table.drop_columns([*numbers, *later_columns()]), manifest)
        assert read_manifest(old).column_names == [
            name for name in table.column_names if name not in numbers
        ]
        assert read_manifest(old)["surface"].to_pylist() == ["solid"] * 4
        sample = WeatherDataset(old)[0]
        assert sample["surface"] == "solid" and sample["water"] is sample["snow"] is None
        assert sample["boxes"]["submerged_fraction"] is sample["boxes"]["transmittance"] is None
    else:
        rows = table.to_pylist()
        manifest.unlink()
        identity = ("source", "recipe_hash", "trajectory", "version", "backend")
        lines = [{name: rows[0][name] for name in identity}]
        lines += [{name: row[name] for name in row if name not in later_columns()} for row in rows]
        log = old / ".climategs" / "journal" / "street" / "clear-000.jsonl"
        log.parent.mkdir(parents=True)
        log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert run(RenderJob("fake:street", [CLEAR], old)).skipped == 4
    assert without_2d(old) == without_2d(whole)
    measured = [row["box_2d_path"] is not None for row in rows_of(old)]
    assert measured == [False] * 4 + [True] * 4  # only rendering tells


def without_2d(out: Path) -> tuple[dict[str, str], list[str]]:
    """Files and rows, without what only rendering tells."""
    files = tree_digest(out / "street")
    assert files.pop("clear-000/labels/boxes_2d.parquet")
    unknown = dict.fromkeys(("box_2d_path", "lidar", "lidar_note"))
    return files, [repr({**row, **unknown}) for row in rows_of(out)]


def test_folders_from_before_there_was_snow_are_gone_on_with(tmp_path: Path) -> None:
    """A manifest that knows of floods, and of `scene` as the surface shown."""
    recipe = make_recipe(flood=FLOOD)
    whole, old = tmp_path / "whole", tmp_path / "old"
    run(RenderJob("fake:street", [recipe], whole))
    run(RenderJob("fake:street", [recipe], old, frames=[0, 1]))
    table = pq.read_table(old / "manifest.parquet")
    later = [name for name in table.column_names if "snow" in name]
    assert len(later) == 4
    table = table.drop_columns(later)
    place = table.column_names.index("surface")
    table = table.set_column(place, "surface", [["scene"] * table.num_rows])
    pq.write_table(table, old / "manifest.parquet")
    sample = WeatherDataset(old)[3]
    assert sample["snow"] is None and sample["water"] is not None
    assert sample["boxes"]["snow_fraction"] is None and sample["surface"] == "scene"
    assert run(RenderJob("fake:street", [recipe], old)).skipped == 4
    assert tree_digest(old) == tree_digest(whole)


@pytest.fixture
def older(copied: Path) -> Path:
    """The folder as a version without the table of smog left it."""
    (copied / LABELS / "smog.parquet").unlink()
    table = pq.read_table(copied / "manifest.parquet")
    pq.write_table(table.drop_columns(["box_smog_path"]), copied / "manifest.parquet")
    return copied


def test_a_finished_folder_of_before_stays_as_it_is(whole, recipe, older: Path) -> None:
    """Rendering all of it again would be the only way to the numbers: nobody asked for that."""
    before = tree_digest(older)
    result = run(RenderJob("fake:street", [recipe], older), must_not_render)
    assert (result.written, result.skipped) == (0, 8)
    assert tree_digest(older) == before
    sample = WeatherDataset(older)[5]
    assert sample["paths"]["box_smog"] is None and sample["boxes"]["transmittance"] is None
    for lost in ("labels/boxes.parquet", "calibration.json"):  # comes back without rendering
        (older / FOLDER / lost).unlink()
        assert run(RenderJob("fake:street", [recipe], older), must_not_render).skipped == 8
        assert (older / FOLDER / lost).read_bytes() == (whole / FOLDER / lost).read_bytes()
    assert not (older / LABELS / "smog.parquet").exists()


def test_new_images_of_an_older_folder_have_their_numbers(whole, recipe, older: Path) -> None:
    """The others keep none, and the next run has nothing to do."""
    for frame in (0, 2):
        (older / FOLDER / "images" / "front" / f"{frame:06d}.png").unlink()
    job, path = RenderJob("fake:street", [recipe], older), LABELS / "smog.parquet"
    assert run(job).written == 2
    table, expected = (box_tables()["box_smog"].read(out / path) for out in (older, whole))
    assert set(table) == {(0, "front"), (2, "front")}
    item = 2, "front"
    np.testing.assert_array_equal(table[item]["transmittance"], expected[item]["transmittance"])
    has = {(r["frame"], r["camera"]) for r in rows_of(older) if r["box_smog_path"]}
    assert has == set(table)
    assert len([s for s in WeatherDataset(older) if s["boxes"]["transmittance"] is not None]) == 2
    assert run(job, must_not_render).skipped == 8


def test_samples_hold_them_read_or_rendered(whole: Path, recipe: Recipe) -> None:
    files = WeatherDataset(whole, cameras=["front"], frames=[2])
    (row,) = files.table.to_pylist()
    sample, view = files[0], camera_and_view(row, recipe)[1]
    live = SceneDataset(open_fake("fake:street"), recipe, renderer=fake_render)[4]
    assert (live["frame"], live["camera"]["name"]) == (2, "front")
    np.testing.assert_array_equal(sample["snow"].numpy(), view.masks["snow"] > 0)
    np.testing.assert_array_equal(live["snow"], sample["snow"])
    for kind, name in (("snow", "snow_fraction"), ("smog", "transmittance")):
        table = box_tables()[f"box_{kind}"].read(whole / LABELS / f"{kind}.parquet")
        numbers = table[2, "front"][name]
        np.testing.assert_array_equal(sample["boxes"][name], numbers)
        np.testing.assert_array_equal(live["boxes"][name], numbers)
    assert sample["paths"]["snow"].endswith("snow/front/000002.png")
    assert sample["weather"]["snow_depth_m"] == 0.0
    assert collate_frames([sample, live])["snow"].shape == (2, 16, 24)


def test_all_comes_through_smog_without_density(tmp_path: Path) -> None:
    thin = make_recipe().model_copy(update={"weather": Weather(smog=Smog(extinction_per_m=0))})
    run(RenderJob("fake:street", [thin], tmp_path, frames=[1]))
    rows = pq.read_table(tmp_path / LABELS / "smog.parquet").to_pylist()
    assert {(row["transmittance"], row["pixels"]) for row in rows} == {(1.0, None)}


def test_visibility_is_what_all_effects_leave(whole: Path) -> None:
    names = ("a", "b", "c", "d")
    smog = box_tables()["box_smog"].from_json([names, [0.5, 0.25, 1.0, np.nan], [9, 0, 9, -1]])
    water = box_tables()["box_water"].from_json([names, [0.0] * 4, [10, 0, 4, 0], [5, 0, 4, 0]])
    snow = box_tables()["box_snow"].from_json([names, [-1, -1, 8, -1], [0, 0, 2, 0]])
    everything = {"box_smog": smog, "box_water": water, "box_snow": snow}
    assert everything.keys() == box_tables().keys() - {"box_2d"}  # which is not of the weather
    for effects, expected in (
        ({}, [1, 1, 1, 1]),
        ({"box_smog": smog}, [0.5, 0.25, 1, 1]),
        ({"box_water": water}, [0.5, 1, 0, 1]),
        ({"box_snow": snow}, [1, 1, 0.75, 1]),
        (everything, [0.25, 0.25, 0, 1]),
    ):
        np.testing.assert_array_equal(visibility(effects, 4), expected)
    assert visibility({}, 0).shape == (0,) and visibility({}, 0).dtype == np.float64
    tables = {f"box_{k}": box_tables()[f"box_{k}"].read(whole / LABELS / f"{k}.parquet")
              for k in ("smog", "water", "snow")}  # fmt: skip
    for item, numbers in tables["box_smog"].items():
        left = visibility({k: table[item] for k, table in tables.items()}, len(numbers.track_ids))
        assert ((left >= 0) & (left <= 1) & (left <= numbers["transmittance"])).all()
