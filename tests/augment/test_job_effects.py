"""What a job writes of its effects, and what it finds once for all of its images."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from augment.dataset import WeatherDataset
from augment.effects.flood.effect import count_hidden_pixels, submerged_fraction
from augment.effects.smog import box_transmittance
from augment.effects.snow.snowy_boxes import count_snow_pixels
from augment.effects.style import style as scene_maps
from augment.errors import OutputError, StyleError
from augment.jobs.render_job import JobResult, RenderJob
from augment.output.box_weather import box_tables, combine_visibility
from augment.output.manifest import later_columns, read_manifest
from augment.output.recipe_files import stored_names
from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.labels import Boxes
from recipes.errors import RecipeError
from recipes.files import with_digest
from recipes.flood import Flood
from recipes.load import load_recipe
from recipes.schema import Recipe, Smog, Weather
from recipes.snow import Snow
from recipes.style import Style
from tests.augment.batch_scenes import (
    LEVEL_Z_M,
    ORIGIN_M,
    THICKNESS_M,
    FakeLabels,
    FakeView,
    fake_render,
    make_maps,
    make_recipe,
    must_not_render,
    open_fake,
    run_fake,
    style_render,
    tree_digest,
)

# Snow of no depth is not laid, so no place is looked for; the stand-in draws some all the same.
SNOW = Snow(depth_m=0)
FLOOD = Flood(level_m=0.3)
FOLDER = Path("street") / "fog-000"
LABELS = FOLDER / "labels"
CLEAR = make_recipe("clear")


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """All effects: none may get into another one's files."""
    return make_recipe(snow=SNOW, flood=FLOOD)


@pytest.fixture(scope="module")
def finished_dir(recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one uninterrupted run; shared, so nobody writes to it."""
    out = tmp_path_factory.mktemp("effects") / "out"
    assert run_fake(RenderJob("fake:street", [recipe], out)).failed == 0
    return out


@pytest.fixture
def copied_dir(finished_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_dir, tmp_path / "copied"))


def rows_of(out: Path) -> list[dict]:
    return read_manifest(out).to_pylist()


def camera_and_view(row: dict, recipe: Recipe) -> tuple[Camera, FakeView]:
    scene = open_fake("fake:street")
    camera = scene.frame(row["frame"]).cameras[row["camera"]]
    return camera, fake_render(scene, camera, recipe, backend="auto")


@pytest.mark.parametrize("kind", ["water", "snow"])
def test_masks_hold_what_was_rendered(finished_dir: Path, recipe: Recipe, kind: str) -> None:
    assert {row[f"{kind}_path"] for row in rows_of(finished_dir)} == {
        f"street/fog-000/{kind}/{camera}/00000{frame}.png"
        for camera in ("front", "rear_left-16c859cb")
        for frame in range(4)
    }
    for row in rows_of(finished_dir):
        mask = cv2.imread(str(finished_dir / row[f"{kind}_path"]), cv2.IMREAD_UNCHANGED)
        assert mask.dtype == np.uint8
        np.testing.assert_array_equal(mask, camera_and_view(row, recipe)[1].masks[kind])
        assert (row["snow_depth_m"], row["surface"]) == (0.0, "solid")


def expected_numbers(kind: str, boxes: Boxes, camera: Camera, view: FakeView) -> dict:
    """Of what the file has of each box, without what follows from it."""
    world_boxes = WorldBoxes.from_labels(boxes, ORIGIN_M)
    if kind == "smog":
        effect_view = view.effects["smog"]
        columns = box_transmittance(
            world_boxes, camera, effect_view.plan.data.fog, effect_view.depth_m
        )
        return {"transmittance": columns.transmittance, "pixels": columns.num_pixels}
    effect_view = view.effects["flood" if kind == "water" else kind]
    if kind == "snow":
        if effect_view.depth_m is None:
            return {}
        counted = count_snow_pixels(
            world_boxes, camera, effect_view.depth_m, view.masks["snow"], THICKNESS_M
        )
        return {"pixels": counted.num_pixels, "snow_pixels": counted.num_marked}
    columns = {"submerged_fraction": submerged_fraction(world_boxes, LEVEL_Z_M)}
    if effect_view.depth_m is not None:
        counted = count_hidden_pixels(world_boxes, camera, effect_view.depth_m, view.masks["water"])
        columns |= {"pixels": counted.num_pixels, "hidden_pixels": counted.num_marked}
    return columns


@pytest.mark.parametrize(
    ("kind", "marked", "fraction"),
    [
        ("water", "hidden_pixels", "hidden_fraction"),
        ("snow", "snow_pixels", "snow_fraction"),
        ("smog", None, None),
    ],
)
def test_boxes_have_their_numbers_beside_the_labels(
    finished_dir: Path, recipe: Recipe, kind, marked, fraction
) -> None:
    """Read with any Parquet reader, a row per frame, camera and box."""
    path = finished_dir / LABELS / f"{kind}.parquet"
    rows = pq.read_table(path).to_pylist()
    assert [(row["frame"], row["camera"], row["box"]) for row in rows] == [
        (frame, camera, box)
        for frame in range(4)
        for camera in ("front", "rear/left")
        for box in range(frame % 4)
    ]
    for row in rows:
        boxes = FakeLabels().boxes(row["frame"])
        k = row["box"]
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
    assert all(finished_dir / row[f"box_{kind}_path"] == path for row in rows_of(finished_dir))


def test_a_clear_day_has_the_same_labels_and_no_tables(finished_dir: Path, tmp_path: Path) -> None:
    names = ["boxes", "boxes_2d", "smog", "snow", "water"]
    assert sorted(p.name for p in (finished_dir / LABELS).iterdir()) == [
        f"{n}.parquet" for n in names
    ]
    run_fake(RenderJob("fake:street", [CLEAR], tmp_path))
    clear = tmp_path / "street/clear-000"
    assert sorted(p.name for p in (clear / "labels").iterdir()) == [
        f"{n}.parquet" for n in names[:2]
    ]
    boxes = (finished_dir / LABELS / "boxes.parquet").read_bytes()
    assert (clear / "labels/boxes.parquet").read_bytes() == boxes
    assert not (clear / "snow").exists() and not (clear / "water").exists()
    for row in rows_of(tmp_path):
        kinds = ("snow", "water", "box_snow", "box_water", "box_smog")
        assert {row[f"{kind}_path"] for kind in kinds} == {None}
        assert np.isnan(row["snow_depth_m"])


@pytest.mark.parametrize(
    ("uri", "output"), [("fake:street?unlabelled=1", {}), ("fake:street", {"labels": False})]
)
def test_without_labels_there_are_only_the_masks(tmp_path: Path, uri: str, output: dict) -> None:
    job = RenderJob(uri, [make_recipe(snow=SNOW, flood=FLOOD, **output)], tmp_path)
    assert run_fake(job).failed == 0
    rows = rows_of(tmp_path)
    assert all(row["snow_path"] and row["water_path"] for row in rows)
    assert {row[f"{kind}_path"] for row in rows for kind in box_tables()} == {None}
    assert not (tmp_path / LABELS).exists()
    assert run_fake(job, must_not_render).skipped == 8


def test_a_view_that_breaks_its_contract_is_recorded(tmp_path, recipe, unchecked) -> None:
    def without(name: str):
        return lambda images: {key: image for key, image in images.items() if key != name}

    small = np.zeros((8, 12), np.uint8)
    ones = np.ones((16, 24), np.uint8)
    foggy = make_recipe(instance=False)
    flooded = make_recipe(instance=False, flood=FLOOD)
    as_asked = lambda image: image  # noqa: E731
    for number, (requested_recipe, rendered_recipe, field, change, message) in enumerate([
        (recipe, recipe, "rgb", lambda _: np.zeros((16, 24, 3), np.float32), "rgb must be uint8"),
        (recipe, recipe, "rgb", lambda rgb: rgb[:8, :12], r"rgb of \[8, 12, 3\].*16 rows"),
        (recipe, recipe, "depth_m", lambda _: None, "returned no depth_m buffer"),
        (recipe, recipe, "masks", without("water"), "returned no water buffer"),
        (recipe, recipe, "masks", lambda m: m | {"water": small}, r"water of \[8, 12\].*16 rows"),
        (recipe, recipe, "masks", lambda m: m | {"water": ones}, r"hold 0 and 255 only; got \[1\]"),
        (recipe, recipe, "masks", lambda m: m | {"water": ones > 1}, "mask must be uint8"),
        (recipe, recipe, "masks", lambda m: m | {"rain": ones}, "a rain buffer, which the recipe"),
        (recipe, recipe, "effects", without("flood"), "labels of smog, snow are .* flood, smog"),
        (foggy, flooded, "rgb", as_asked, "labels of flood, smog are measured from, .* with smog"),
        (foggy, make_recipe(), "rgb", as_asked, "a instance buffer, which the recipe does not ask"),
    ]):  # fmt: skip

        def render(
            scene,
            camera,
            _,
            *,
            backend,
            rendered_recipe=rendered_recipe,
            field=field,
            change=change,
        ):
            view = fake_render(scene, camera, rendered_recipe, backend=backend)
            return dataclasses.replace(view, **{field: change(getattr(view, field))})

        out = tmp_path / str(number)
        result = run_fake(
            RenderJob("fake:s", [requested_recipe], out, frames=[1], cameras=["front"]), render
        )
        assert result.failed == 1 and re.search(message, result.failures[0]), result.failures
        for kind in ("water", "snow") if requested_recipe is recipe else ():
            table = box_tables()[f"box_{kind}"]
            assert not table.read(out / "s/fog-000/labels" / f"{kind}.parquet")


def test_what_is_lost_or_damaged_is_made_again(
    finished_dir: Path, recipe, copied_dir: Path, caplog
) -> None:
    for lost, rendered in (
        (["snow/front/000001.png", "water/front/000002.png"], 2),
        (["labels/snow.parquet", "labels/water.parquet", "labels/smog.parquet"], 8),
        (["labels/boxes.parquet"], 0),  # which the scene still has
    ):
        for name in lost:
            (copied_dir / FOLDER / name).unlink()
        assert run_fake(RenderJob("fake:street", [recipe], copied_dir)).written == rendered
        assert tree_digest(copied_dir) == tree_digest(finished_dir)
    table = copied_dir / LABELS / "water.parquet"
    table.write_bytes(table.read_bytes()[:100])
    assert run_fake(RenderJob("fake:street", [recipe], copied_dir)).written == 8
    assert "water.parquet is missing or not a readable" in caplog.text
    assert tree_digest(copied_dir) == tree_digest(finished_dir)


def test_parts_in_any_order_give_the_files_of_one_run(
    finished_dir: Path, recipe, tmp_path: Path
) -> None:
    run_fake(RenderJob("fake:street", [recipe], tmp_path, frames=[3, 1], cameras=["rear/left"]))
    assert len(box_tables()["box_snow"].read(tmp_path / LABELS / "snow.parquet")) == 2
    run_fake(RenderJob("fake:street", [recipe], tmp_path, cameras=["front"]))
    assert run_fake(RenderJob("fake:street", [recipe], tmp_path)).skipped == 6
    assert tree_digest(tmp_path) == tree_digest(finished_dir)


def test_a_finished_folder_of_an_older_version_stays_as_it_is(
    finished_dir, recipe, copied_dir: Path
) -> None:
    """Rendering all of it again would be the only way to the numbers: nobody asked for that. What
    is rendered anew has them.
    """
    (copied_dir / LABELS / "smog.parquet").unlink()
    manifest = copied_dir / "manifest.parquet"
    pq.write_table(pq.read_table(manifest).drop_columns(["box_smog_path"]), manifest)
    before = tree_digest(copied_dir)
    job = RenderJob("fake:street", [recipe], copied_dir)
    assert run_fake(job, must_not_render).skipped == 8
    assert tree_digest(copied_dir) == before
    sample = WeatherDataset(copied_dir)[5]
    assert sample["paths"]["box_smog"] is None and sample["boxes"]["transmittance"] is None
    for lost in ("labels/boxes.parquet", "calibration.json"):  # comes back without rendering
        (copied_dir / FOLDER / lost).unlink()
        assert run_fake(job, must_not_render).skipped == 8
        assert (copied_dir / FOLDER / lost).read_bytes() == (
            finished_dir / FOLDER / lost
        ).read_bytes()
    for frame in (0, 2):
        (copied_dir / FOLDER / "images" / "front" / f"{frame:06d}.png").unlink()
    assert run_fake(job).written == 2
    table = box_tables()["box_smog"].read(copied_dir / LABELS / "smog.parquet")
    has = {(r["frame"], r["camera"]) for r in rows_of(copied_dir) if r["box_smog_path"]}
    assert has == set(table) == {(0, "front"), (2, "front")}
    assert run_fake(job, must_not_render).skipped == 8


def test_outputs_of_the_first_version_are_gone_on_with(tmp_path: Path) -> None:
    """Without the columns that came later: no style; no weather, so surfaces are alike."""
    run_fake(RenderJob("fake:street", [CLEAR], tmp_path, frames=[0, 1]))
    table = pq.read_table(tmp_path / "manifest.parquet")
    young = [n for n in table.column_names if n.startswith(("flood_", "snow_", "style_"))]
    pq.write_table(table.drop_columns([*{*young, *later_columns()}]), tmp_path / "manifest.parquet")
    assert read_manifest(tmp_path)["surface"].to_pylist() == ["solid"] * 4
    sample = WeatherDataset(tmp_path)[0]
    assert sample["surface"] == "solid" and sample["water"] is sample["snow"] is None
    assert run_fake(RenderJob("fake:street", [CLEAR], tmp_path)).skipped == 4
    measured = [row["box_2d_path"] is not None for row in rows_of(tmp_path)]
    assert measured == [False] * 4 + [True] * 4  # only rendering tells


def test_all_comes_through_smog_without_density(tmp_path: Path) -> None:
    thin = make_recipe().model_copy(update={"weather": Weather(smog=Smog(extinction_per_m=0))})
    run_fake(RenderJob("fake:street", [thin], tmp_path, frames=[1]))
    rows = pq.read_table(tmp_path / LABELS / "smog.parquet").to_pylist()
    assert {(row["transmittance"], row["pixels"]) for row in rows} == {(1.0, None)}


def test_visibility_is_what_all_effects_leave(finished_dir: Path) -> None:
    names = ("a", "b", "c", "d")
    smog = box_tables()["box_smog"].from_json([names, [0.5, 0.25, 1.0, np.nan], [9, 0, 9, -1]])
    water = box_tables()["box_water"].from_json([names, [0.0] * 4, [10, 0, 4, 0], [5, 0, 4, 0]])
    snow = box_tables()["box_snow"].from_json([names, [-1, -1, 8, -1], [0, 0, 2, 0]])
    rain = box_tables()["box_rain"].from_json([names, [0.5] * 4, [9] * 4, [0] * 4])
    snowfall = box_tables()["box_snowfall"].from_json([names, [1.0] * 4, [9] * 4, [0] * 4])
    everything = {"box_smog": smog, "box_water": water, "box_snow": snow, "box_rain": rain,
                  "box_snowfall": snowfall}  # fmt: skip
    # The other tables do not say what can be seen of a box.
    hiding = {n for n, t in box_tables().items() if t.visible_column or t.hidden_column}
    assert everything.keys() == hiding
    for effects, expected in (
        ({}, [1, 1, 1, 1]),
        ({"box_smog": smog}, [0.5, 0.25, 1, 1]),
        ({"box_water": water}, [0.5, 1, 0, 1]),
        ({"box_snow": snow}, [1, 1, 0.75, 1]),
        ({"box_rain": rain}, [0.5] * 4),
        (everything, [0.125, 0.125, 0, 0.5]),
    ):
        np.testing.assert_array_equal(combine_visibility(effects, 4), expected)
    assert combine_visibility({}, 0).shape == (0,) and combine_visibility({}, 0).dtype == np.float64
    tables = {f"box_{k}": box_tables()[f"box_{k}"].read(finished_dir / LABELS / f"{k}.parquet")
              for k in ("smog", "water", "snow")}  # fmt: skip
    for item, numbers in tables["box_smog"].items():
        left = combine_visibility(
            {k: table[item] for k, table in tables.items()}, len(numbers.track_ids)
        )
        assert ((left >= 0) & (left <= 1) & (left <= numbers["transmittance"])).all()


@pytest.mark.long
def test_the_librarys_own_snow_does_not_depend_on_how_a_job_went(tmp_path: Path) -> None:
    """Real beds and real pictures: whole, by two workers, and in parts that search anew. Another
    depth finds the bed in its file.
    """
    recipe = make_recipe(snow=Snow(depth_m=0.15, cell_m=0.2))
    uri = "fake:street?frames=2"
    one_run_dir, shared, parts = (tmp_path / name for name in ("whole", "shared", "parts"))
    result = run_fake(RenderJob(uri, [recipe], one_run_dir), None)
    assert (result.written, result.failures) == (4, ())
    assert run_fake(RenderJob(uri, [recipe], shared, workers=2), None).failures == ()
    run_fake(RenderJob(uri, [recipe], parts, frames=[1], cameras=["front"]), None)
    for bed in (parts / ".climategs").glob("exposed-*"):
        bed.unlink()
    assert run_fake(RenderJob(uri, [recipe], parts), None).skipped == 1
    for out in (shared, parts):
        assert tree_digest(out / "street") == tree_digest(one_run_dir / "street")
        assert (out / "manifest.parquet").read_bytes() == (
            one_run_dir / "manifest.parquet"
        ).read_bytes()
    masks = [
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in one_run_dir.rglob("snow/*/*.png")
    ]
    assert len(masks) == 4 and max(mask.mean() for mask in masks) > 0
    (bed,) = (one_run_dir / ".climategs").glob("exposed-*")
    before = bed.stat().st_mtime_ns
    deeper = make_recipe(variant=1, snow=Snow(depth_m=0.3, cell_m=0.2))
    assert run_fake(RenderJob(uri, [deeper], one_run_dir), None).failures == ()
    assert [p.stat().st_mtime_ns for p in (one_run_dir / ".climategs").glob("exposed-*")] == [
        before
    ]


# ---- Maps of styles: found once a job, and what renders its images again -------------------------


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[Exception]:
    """Working out maps costs nothing, or raises what is in the list."""
    fails: list[Exception] = []

    def find_maps(scene, style, cameras):
        if fails:
            raise fails[0]
        return make_maps(style.strength)

    monkeypatch.setattr(scene_maps, "_find_maps", find_maps)
    return fails


def styled(strength: float = 1.0, variant: int = 0, **style) -> Recipe:
    source = {} if "image" in style else {"preset": "dusk"}
    return make_recipe(variant=variant, style=Style(strength=strength, **source, **style))


def run_styled(job: RenderJob, renderer=style_render) -> JobResult:
    return run_fake(job, renderer)


def image_at(path: Path, colour: int = 90) -> str:
    """Writes a small picture: a sky over a ground."""
    rng = np.random.default_rng(colour)
    pixels = rng.integers(0, 60, (24, 32, 3), dtype=np.uint8) + np.uint8(colour)
    pixels[:8] += 60
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)
    return str(path)


def test_a_style_that_cannot_be_used_leaves_all_as_it_was(searches, tmp_path: Path) -> None:
    run_styled(RenderJob("fake:street", [make_recipe()], tmp_path / "out", frames=[0]))
    before = tree_digest(tmp_path / "out")
    searches.append(StyleError("sunset.jpg is cut short"))
    image = image_at(tmp_path / "sunset.png")
    changed = with_digest(styled(image=image))
    image_at(tmp_path / "sunset.png", 91)
    for overwrite in (False, True):
        variant = 0 if overwrite else 1
        bad = {
            "is cut short": styled(1, variant),
            "no such file": styled(1, variant, image=str(tmp_path / "dawn.png")),
            "has changed since": changed.model_copy(update={"variant": variant}),
        }
        for message, recipe in bad.items():
            job = RenderJob("fake:street", [recipe], tmp_path / "out", overwrite=overwrite)
            with pytest.raises((StyleError, RecipeError), match=message):
                run_styled(job)
            assert tree_digest(tmp_path / "out") == before


def test_the_recipe_in_the_folder_renders_it_again(searches, tmp_path: Path) -> None:
    """Wherever the folder is taken, without the files that it was made from."""
    (tmp_path / "looks").mkdir()
    image_at(tmp_path / "looks" / "my sunset.png")
    image_at(tmp_path / "looks" / "masks" / "my sunset.png", 30)
    (tmp_path / "looks" / "fog.yaml").write_text(
        "weather: {smog: {visibility_m: 50}}\n"
        "style: {image: my sunset.png, mask: masks/my sunset.png, strength: {uniform: [0, 1]}}\n"
    )
    recipe = load_recipe(tmp_path / "looks" / "fog.yaml").resolve(2)
    run_styled(RenderJob("fake:street", [recipe], tmp_path / "out"))
    before = tree_digest(tmp_path / "out")
    for path in [*(tmp_path / "out").rglob("style/*"), *(tmp_path / "out").rglob("recipe.yaml")]:
        path.unlink()
        run_styled(RenderJob("fake:street", [recipe], tmp_path / "out"), must_not_render)
        assert tree_digest(tmp_path / "out") == before  # what was deleted is made again
    (tmp_path / "out").rename(tmp_path / "taken")
    images = [p for p in (tmp_path / "looks").rglob("*.png")]
    contents = {p.read_bytes() for p in images}
    for path in images:
        path.unlink()
    folder = tmp_path / "taken" / "street" / "fog-002"
    style_files = sorted((folder / "style").iterdir())
    assert len(style_files) == 2 and {p.read_bytes() for p in style_files} == contents
    again = load_recipe(folder / "recipe.yaml").resolve(0)
    assert again.hash == recipe.hash and again.style is not None
    assert Path(again.style.image or "").parent == folder / "style"
    run_styled(RenderJob("fake:street", [again], tmp_path / "again"))
    assert tree_digest(tmp_path / "again" / "street" / "fog-002" / "images") == tree_digest(
        folder / "images"
    )
    # And the names are safe now: they stay.
    assert (tmp_path / "again" / "street" / "fog-002" / "recipe.yaml").read_bytes() == (
        folder / "recipe.yaml"
    ).read_bytes()
    # The job goes on in its own folder, and does not overwrite what it needs.
    (folder / "images" / "front" / "000001.png").unlink()
    assert run_styled(RenderJob("fake:street", [again], tmp_path / "taken")).written == 1
    before = tree_digest(tmp_path / "taken")
    with pytest.raises(OutputError, match="copy the recipe and its files out of it first"):
        run_styled(RenderJob("fake:street", [again], tmp_path / "taken", overwrite=True))
    assert tree_digest(tmp_path / "taken") == before


def test_files_keep_their_names_but_for_collisions() -> None:
    for files, names in (
        ({"image": "/a/x.png"}, ["x.png"]),
        ({"image": "x.png", "mask": "/b/x.png"}, ["x.png", "mask-x.png"]),
        ({"image": "mask-X.png", "mask": "b/mask-x.png"}, ["mask-X.png", "mask-mask-x.png"]),
        (
            {"image": "x", "mask": "b/x", "checkpoint": "c/mask-x", "method": "gscm"},
            ["x", "mask-x", "checkpoint-mask-x"],
        ),
    ):
        assert list(stored_names(Recipe(style=Style(**files))).values()) == [
            f"style/{name}" for name in names
        ]


def test_unsafe_names_become_safe_ones_and_then_stay() -> None:
    def stored(image: str) -> str:
        return stored_names(Recipe(style=Style(image=image)))["style.image"]

    for name in ("été 3.JPG", "..png", "-x.png", "a.b c", "a" * 200, "b" * 200 + ".png"):
        first = stored(f"/photos/{name}")
        assert first != f"style/{name}" and first.isascii() and " " not in first
        assert first.endswith((".JPG", ".png")) == name.endswith((".JPG", ".png"))
        assert len(first) < 140
        assert stored(f"/out/{first}") == first
        assert stored(f"/photos/x{name}") != first


def test_a_picture_under_another_name_is_the_same_style(searches, tmp_path: Path) -> None:
    """And the rows that were there say the new name, as all others do."""
    out = tmp_path / "out"
    first = styled(image=image_at(tmp_path / "a" / "sunset.png"))
    run_styled(RenderJob("fake:street", [first], out, frames=[0]))
    second = styled(image=image_at(tmp_path / "b" / "evening.png"))
    result = run_styled(RenderJob("fake:street", [second], out))
    assert (result.written, result.skipped) == (6, 2)
    assert set(read_manifest(out)["style"].to_pylist()) == {"evening.png"}
    other = styled(image=image_at(tmp_path / "c" / "evening.png", 50))
    with pytest.raises(OutputError, match="recipe hash there"):
        run_styled(RenderJob("fake:street", [other], out), must_not_render)


@pytest.mark.long
def test_the_librarys_own_style_does_not_depend_on_how_a_job_went(tmp_path: Path) -> None:
    """Real maps and real pictures, whole and in parts that search anew."""
    image = image_at(tmp_path / "sunset.png", 150)
    uri = "fake:street?frames=2"
    recipes = [styled(1, 0, image=image), styled(1, 1, image=image, applied_to="picture")]
    one_run_dir, parts, plain = (tmp_path / name for name in ("whole", "parts", "plain"))
    result = run_styled(RenderJob(uri, recipes, one_run_dir), None)
    assert (result.written, result.failures) == (8, ())
    run_styled(RenderJob(uri, recipes, parts, frames=[1], cameras=["front"]), None)
    assert run_styled(RenderJob(uri, recipes, parts), None).skipped == 2
    assert tree_digest(parts) == tree_digest(one_run_dir)
    run_styled(RenderJob(uri, [make_recipe()], plain), None)
    unstyled = tree_digest(plain / "street" / "fog-000" / "images")
    for variant in ("fog-000", "fog-001"):
        pictures = tree_digest(one_run_dir / "street" / variant / "images")
        assert not set(pictures.values()) & set(unstyled.values())
