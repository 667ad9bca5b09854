"""Job files: what they say, and where messages point."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recipes.errors import RecipeError
from recipes.job import MAX_BYTES, Job, load_job, load_job_recipes, parse_job, seed_for_scene
from recipes.schema import parse_frames

WHOLE = """\
name: winter
scenes:
  - data/002
  - {uri: "runs/*", name: other, frames: "::5", cameras: [front], recipes: [fog]}
recipes:
  - dense-fog
  - {recipe: files/fog.yaml, variants: 4}
draws: shared
scale: 0.5
block_images: 16
"""


def parse(text: str) -> Job:
    return parse_job(text, source="job.yaml")


def message(text: str) -> str:
    with pytest.raises(RecipeError) as caught:
        parse(text)
    return str(caught.value)


def test_a_job_in_full() -> None:
    job = parse(WHOLE)
    assert (job.name, job.draws, job.scale, job.block_images) == ("winter", "shared", 0.5, 16)
    first, second = job.scenes
    assert (first.uri, first.name, first.frames, first.cameras) == ("data/002", None, "all", None)
    assert (second.name, second.frames, second.cameras, second.recipes) == (
        "other", "::5", ("front",), ("fog",))  # fmt: skip
    assert [(r.recipe, r.variants) for r in job.recipes] == [
        ("dense-fog", None), ("files/fog.yaml", 4)]  # fmt: skip


SCENES, RECIPES = "scenes: [a]\n", "recipes: [dense-fog]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "job.yaml:1: the file is empty"),
        ("- a\n", "job.yaml:1: a job is a mapping with scenes and recipes"),
        (RECIPES, "job.yaml:1: scenes: is missing"),
        (SCENES, "job.yaml:1: recipes: is missing"),
        (RECIPES + "scenes: []\n", "job.yaml:2: scenes: names none"),
        (RECIPES + "scenes: a\n", "job.yaml:2: scenes: must be a list"),
        (RECIPES + "scenes:\n  - a\n  - 5\n", "job.yaml:4: scenes[1]: must be a text, or a map"),
        (RECIPES + "scenes:\n  - {uri: a, frames: 0:x}\n",
         "job.yaml:3: scenes[0].frames: '0:x' is not understood; write all, 4"),
        (RECIPES + "scenes:\n  - {uri: a, cameras: front}\n",
         "job.yaml:3: scenes[0].cameras: must be a list"),
        (RECIPES + "scenes:\n  - {uri: a, frame: '1'}\n",
         "job.yaml:3: scenes[0].frame: unknown field; did you mean frames?"),
        (RECIPES + "scenes:\n  - {uri: a, name: ../b}\n", "job.yaml:3: scenes[0].name: "),
        (RECIPES + "scenes:\n  - {uri: a, recipes: [dense-fg]}\n", "did you mean dense-fog?"),
        (SCENES + "recipes:\n  - {recipe: a, variants: 0}\n",
         "job.yaml:3: recipes[0].variants: must be greater"),
        (SCENES + "recipes: [a/fog.yaml, b/fog.yaml]\n", "recipes are called the same: fog; give"),
        (SCENES + RECIPES + "block_images: 0\n", "job.yaml:3: block_images: "),
        (SCENES + RECIPES + "draws: once\n", "job.yaml:3: draws: "),
        (SCENES + RECIPES + "scale: .nan\n", "job.yaml:3: scale: "),
        (SCENES + RECIPES + "version: 2\n", "job.yaml:3: version: "),
        (SCENES + RECIPES + "name: a/b\n", "job.yaml:3: name: "),
        (SCENES + SCENES + RECIPES, "job.yaml:2: "),
    ],
)  # fmt: skip
def test_messages_name_file_line_and_field(text: str, said: str) -> None:
    assert said in message(text)


def test_all_problems_are_told_at_once() -> None:
    said = message("scenes:\n  - {uri: a, frames: x}\nrecipes:\n  - {recipe: b, variants: -1}\n")
    assert "job.yaml:2:" in said and "job.yaml:4:" in said


def test_files_that_are_no_jobs(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="no such file; a job is a YAML file"):
        load_job(tmp_path / "none.yaml")
    with pytest.raises(RecipeError, match="is a folder"):
        load_job(tmp_path)
    path = tmp_path / "winter.yaml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(RecipeError, match="not UTF-8 text"):
        load_job(path)
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(RecipeError, match="larger than"):
        load_job(path)
    path.write_text(SCENES + RECIPES)
    assert load_job(path).name == "winter"


@given(st.text(alphabet="abn:{}[],-*&!?|>'\"# \n\t0.9", max_size=60))
@settings(max_examples=150, deadline=None)
def test_any_text_is_a_job_or_a_recipe_error(text: str) -> None:
    try:
        parse("scenes: [a]\nrecipes: [b]\n" + text)
    except RecipeError as error:
        assert "job.yaml:" in str(error)


def test_recipes_come_from_presets_and_files(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    text = "seed: 3\nvariants: 2\nweather: {smog: {visibility_m: {uniform: [20, 90]}}}\n"
    (tmp_path / "files" / "fog.yaml").write_text(text)
    recipes = load_job_recipes(parse(WHOLE), tmp_path)
    assert list(recipes.templates) == ["dense-fog", "fog"]
    named = recipes.resolve_for_scene(recipes.job.scenes[1], "x")
    assert [(r.name, r.variant, r.render.scale) for r in named] == [
        ("fog", k, 0.5) for k in range(4)
    ]
    assert recipes.resolve_for_scene(recipes.job.scenes[1], "y") == named  # draws: shared
    with pytest.raises(RecipeError, match=r"fog\.yaml"):
        load_job_recipes(parse(WHOLE), tmp_path / "files")


def test_recipes_that_write_to_the_same_folders(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text("name: fog\n")
    job = parse(SCENES + "recipes: [one.yaml, two.yaml]\n")
    with pytest.raises(RecipeError, match="write to the same folders: fog"):
        load_job_recipes(job, tmp_path)
    job = parse(SCENES + "recipes:\n  - one.yaml\n  - {recipe: two.yaml, name: second}\n")
    assert [t.name for t in load_job_recipes(job, tmp_path).templates.values()] == ["fog", "second"]


def test_a_scale_beyond_the_limits(tmp_path: Path) -> None:
    (tmp_path / "fog.yaml").write_text("render: {scale: 4}\n")
    job = parse(SCENES + "recipes: [fog.yaml]\nscale: 4\n")
    with pytest.raises(RecipeError, match=r"a scale of 4\.0 times the recipe's render\.scale 4"):
        load_job_recipes(job, tmp_path).resolve_for_scene(job.scenes[0], "x")


def test_scenes_have_seeds_of_their_own() -> None:
    seeds = {seed_for_scene(seed, name) for seed in range(50) for name in "abcd"}
    assert len(seeds) == 200 and all(0 <= seed < 2**63 for seed in seeds)
    assert seed_for_scene(5, "street") == seed_for_scene(5, "street")


TEN = range(10)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("all", None),
        (" all ", None),
        ("4", (4,)),
        ("5,0,9", (5, 0, 9)),
        ("0:6:2", (0, 2, 4)),
        ("::4", (0, 4, 8)),
        ("7:", (7, 8, 9)),
        (":2, 1:3", (0, 1, 2)),
        ("8:12", (8, 9, 10, 11)),
        ("12", (12,)),
    ],
)
def test_patterns(text: str, wanted: tuple[int, ...] | None) -> None:
    assert parse_frames(text).select(TEN) == wanted


@pytest.mark.parametrize("text", ["", " ", ",", "1,", "-1", "a", "1:2:0", "3:3", "5:2", "1:2:3:4",
                                  "1.5", "0x2", "1 2", "::-1", "all,1"])  # fmt: skip
def test_what_is_no_pattern(text: str) -> None:
    with pytest.raises(ValueError, match="is not understood; write all, 4, 0,5,9"):
        parse_frames(text)


def test_ranges_that_are_clipped_and_numbers_that_are_not() -> None:
    pattern = parse_frames("0:100:30,64")
    assert pattern.select([0, 30, 31, 33]) == (0, 30, 60, 90, 64)
    assert pattern.select([0, 30, 31, 33], clip=True) == (0, 30, 64)
    assert parse_frames("0:5").select([], clip=True) == ()


@given(st.sets(st.integers(0, 40)), st.integers(0, 40), st.integers(1, 40), st.integers(1, 7))
def test_a_range_is_pythons(numbers: set[int], start: int, length: int, step: int) -> None:
    stop = start + length
    found = parse_frames(f"{start}:{stop}:{step}").select(sorted(numbers), clip=True)
    assert found == tuple(n for n in range(start, stop, step) if n in numbers)
