"""The search for the mildest weather in which a condition holds."""

from __future__ import annotations

import json
import math
import random
import stat
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from augment.errors import OutputError
from augment.jobs.block_worker import JobWorkerSetup
from augment.output.manifest import read_manifest
from augment.suite.search import Condition, SearchError, search
from augment.suite.searched_weather import (
    NumberRenderer,
    command_judge,
    search_range,
    search_weather,
    suite_at,
)
from recipes.errors import RecipeError
from recipes.job import JobScene
from recipes.smog import MOR_DEPTH
from recipes.suite import Suite, SuiteVariant, load_suite
from recipes.tags import tags_of
from tests.augment.batch_scenes import fake_render, must_not_render, open_fake
from tools.cli import main

SUITE = load_suite("weather-c-v1")


def recall_in_fog(mor_m: float) -> dict[str, float]:
    """A detector that sees a fifth of the cars by day, half of them at a MOR of 120 m."""
    return {"recall": 1 / (1 + 120 / mor_m)}


@pytest.mark.parametrize("breaks_at_m", [37.5, 61.0, 120.0, 299.0, 590.0])
def test_the_interval_holds_the_number_at_which_a_detector_breaks(breaks_at_m: float) -> None:
    numbers = []

    def score_at(mor_m: float) -> Mapping[str, float]:
        numbers.append(mor_m)
        return {"recall": 1 / (1 + breaks_at_m / mor_m), "precision": 0.9}

    result = search(score_at, "recall<0.5", 600.0, 37.0, tolerance=0.02)
    mild, harsh = result.interval
    assert harsh <= breaks_at_m <= mild and mild / harsh <= 1.02
    assert result.estimate == pytest.approx(breaks_at_m, rel=1e-3)
    assert result.num_evaluations == len(numbers) == len(set(numbers)) <= 11
    assert [e.number for e in result.evaluations] == sorted(numbers, reverse=True)
    assert [e.holds for e in result.evaluations] == sorted(e.holds for e in result.evaluations)
    assert result.largest_reversal == 0
    assert json.loads(json.dumps(result.to_json()))["num_evaluations"] == len(numbers)


def test_numbers_that_grow_with_the_weather_are_searched_as_well() -> None:
    result = search(lambda rate: {"miss": 1 - math.exp(-rate / 20)}, "miss >= 0.5", 1.0, 100.0)
    assert result.interval[0] < 20 * math.log(2) <= result.interval[1]
    assert result.condition == "miss>=0.5"


def test_a_step_is_found_within_the_tolerance() -> None:
    result = search(lambda mor_m: {"ok": float(mor_m > 100)}, "ok<1", 600.0, 37.0, tolerance=0.001)
    assert result.interval[1] <= 100 < result.interval[0]
    assert result.interval[0] / result.interval[1] <= 1.001


def test_the_number_of_evaluations_is_limited() -> None:
    result = search(recall_in_fog, "recall<0.5", 600.0, 37.0, tolerance=1e-6, max_evaluations=8)
    assert result.num_evaluations == 8
    assert result.interval[1] < 120 < result.interval[0]


def test_searches_without_an_answer_are_refused() -> None:
    with pytest.raises(SearchError, match=r"holds at the mildest number 600 already.* 0.8333"):
        search(recall_in_fog, "recall<0.9", 600.0, 37.0)
    with pytest.raises(SearchError, match=r"never holds: at the harshest number 37 recall is 0.2"):
        search(recall_in_fog, "recall<0.1", 600.0, 37.0)
    dips = lambda mor_m: {"recall": 0.4 if 100 < mor_m < 200 or mor_m < 50 else 0.8}  # noqa: E731
    with pytest.raises(SearchError, match=r"is not monotone: it holds at 149 and not in .* 74.25"):
        search(dips, "recall<0.5", 600.0, 37.0)


def test_noise_that_does_not_cross_the_threshold_is_stated() -> None:
    rng = random.Random(1)
    result = search(
        lambda rate: {"recall": 1 / (1 + rate / 10) + rng.uniform(-0.01, 0.01)},
        "recall<0.5", 1.0, 100.0, tolerance=0.1,
    )  # fmt: skip
    assert result.interval[0] < 10.5 and result.interval[1] > 9.5
    back = search(lambda rate: {"r": 0.9 + 0.1 * (rate > 5) - rate / 100}, "r<0.5", 1.0, 100.0)
    assert back.largest_reversal > 0.01


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        ({}, "there is no score 'recall'; got none"),
        ({"map": 0.4}, "there is no score 'recall'; got map"),
        ({"recall": math.nan}, "recall must be a finite number; got nan"),
        ({"recall": "0.4"}, "must be a finite number; got '0.4'"),
        ({"recall": True}, "must be a finite number; got True"),
    ],
)
def test_scores_that_are_no_numbers_are_refused(scores: dict, message: str) -> None:
    with pytest.raises(SearchError, match=f"at 600: .*{message}"):
        search(lambda number: scores, "recall<0.5", 600.0, 37.0)


def test_conditions_that_are_none_are_refused() -> None:
    for text in ("", "recall", "recall=0.5", "recall<", "<0.5", "recall<0.5.1", "recall<a"):
        with pytest.raises(SearchError, match="is no condition; write SCORE<NUMBER"):
            Condition.parse(text)
    assert Condition.parse(" AP@50 <= 1e-2 ") == Condition("AP@50", "<=", 0.01)
    for ends in ((0.0, 1.0), (-1.0, 1.0), (math.inf, 1.0), (2.0, 2.0)):
        with pytest.raises(ValueError, match="mildest and harshest"):
            search(recall_in_fog, "recall<0.5", *ends)
    with pytest.raises(ValueError, match="max_evaluations must be at least"):
        search(recall_in_fog, "recall<0.5", 600.0, 37.0, max_evaluations=4)


# ---- Weather of a suite at any number ------------------------------------------------------------


def recipe_at(effect: str, number: float):
    return suite_at(SUITE, effect, number).recipe(SuiteVariant(effect, 1), "a scene")


@pytest.mark.parametrize("effect", ["fog", "rain", "snowfall", "snow", "flood", "lens"])
def test_weather_at_a_levels_number_is_the_levels(effect: str) -> None:
    for number, level in enumerate(SUITE.effects[effect].levels, 1):
        recipe = recipe_at(effect, level.value)
        expected = SUITE.recipe(SuiteVariant(effect, number), "a scene")
        assert recipe.weather == expected.weather and recipe.camera == expected.camera
    low, high = sorted(search_range(SUITE, effect))
    for number in (low, math.sqrt(low * high), high):
        assert recipe_at(effect, number).seed == recipe_at(effect, low).seed


def test_fog_between_levels_has_the_range_that_was_asked_for() -> None:
    for mor_m in (500.0, 210.0, 101.0, 55.0):
        tags = tags_of(recipe_at("fog", mor_m))
        # Levels are called by a rounded MOR: 37 m for 37.4 m.
        assert tags.mor_m == pytest.approx(mor_m, rel=0.015)
        assert tags.extinction_per_m == pytest.approx(MOR_DEPTH / mor_m, rel=0.015)
    assert recipe_at("snow", 20.0).weather.snow.depth_m == pytest.approx(0.2)


def test_effects_without_a_single_number_are_refused() -> None:
    for effect in ("night", "combined"):
        with pytest.raises(SearchError, match=f"{effect} of weather-c-v1 cannot be searched.*fog"):
            search_range(SUITE, effect)
    with pytest.raises(RecipeError, match="no effect 'frog'"):
        search_range(SUITE, "frog")
    with pytest.raises(SearchError, match=r"700 m is not between the levels .* 600 to 37 m"):
        suite_at(SUITE, "fog", 700.0)


# ---- Judges --------------------------------------------------------------------------------------


def program(folder: Path, text: str) -> str:
    path = folder / "detector.py"
    path.write_text(f"#!{sys.executable}\nimport sys, json, pathlib, time\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def test_a_program_judges_folders(tmp_path: Path) -> None:
    rendered = []

    def render(suite: Suite, variant: SuiteVariant, name: str) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        mor_m = tags_of(suite.recipe(variant, "a scene")).mor_m
        (folder / "mor.txt").write_text(f"{mor_m}")
        rendered.append(name)
        return folder

    command = program(
        tmp_path,
        "mor_m = float((pathlib.Path(sys.argv[2]) / 'mor.txt').read_text())\n"
        "print('detecting'); print(json.dumps({sys.argv[1]: 1 / (1 + 120 / mor_m)}))",
    )
    result = search_weather(SUITE, "fog", render, command_judge(f"{command} recall"), "recall<0.5")
    assert result.interval[1] < 120 < result.interval[0]
    assert rendered[:2] == ["fog-600", "fog-37"] and len(rendered) == result.num_evaluations


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("print('0.5')", "must be a JSON object of scores.* got '0.5'"),
        ("print('recall 0.5')", "must be a JSON object"),
        ("", "must be a JSON object .* got ''"),
        ("sys.exit('no weights')", "ended with 1: no weights"),
        ("time.sleep(60)", "took longer than 2 s"),
    ],
)
def test_programs_that_say_no_scores_are_refused(text: str, message: str, tmp_path: Path) -> None:
    judge: Callable = command_judge(program(tmp_path, text), timeout_s=2.0)
    with pytest.raises(SearchError, match=message):
        judge(tmp_path)


def test_commands_that_cannot_be_run_are_refused(tmp_path: Path) -> None:
    for command, message in (
        ("", "the command is empty"),
        ("'detect", "cannot be read"),
        (str(tmp_path / "none"), "cannot be run: there is no such program"),
    ):
        with pytest.raises(SearchError, match=message):
            command_judge(command)(tmp_path)


# ---- Images and the command ----------------------------------------------------------------------


def renderer_in(out: Path, renderer: Callable = fake_render) -> NumberRenderer:
    def setup_of(folder: str) -> JobWorkerSetup:
        return JobWorkerSetup(folder, None, "auto", open_fake, renderer)

    scenes = [JobScene(uri="fake:a?frames=2"), JobScene(uri="fake:b?frames=2")]
    return NumberRenderer(scenes, setup_of, out, {"output.image": "png"}, progress=False)


@pytest.mark.long
def test_each_number_is_a_folder_that_a_detector_reads_and_a_second_search_takes_over(
    tmp_path: Path,
) -> None:
    def judge(folder: Path) -> Mapping[str, float]:
        table = read_manifest(folder)
        assert table.num_rows == 8 and set(table["status"].to_pylist()) == {"ok"}
        (mor_m,) = set(table["mor_m"].to_pylist())
        return {"recall": 1 / (1 + 120 / mor_m)}

    options = {"tolerance": 0.5, "num_checks": 1}
    first = search_weather(
        SUITE, "fog", renderer_in(tmp_path).render, judge, "recall<0.5", **options
    )
    assert first.interval[1] < 120 < first.interval[0]
    folders = {f"fog-{e.number:.6g}" for e in first.evaluations}
    assert {path.name for path in tmp_path.iterdir()} == folders
    again = renderer_in(tmp_path, must_not_render)
    assert search_weather(SUITE, "fog", again.render, judge, "recall<0.5", **options) == first


def broken_render(*args: object, **options: object) -> None:
    raise ValueError("no memory")


def test_images_that_fail_end_the_search(tmp_path: Path) -> None:
    broken = renderer_in(tmp_path, broken_render)
    with pytest.raises(OutputError, match="fog-600: 8 images failed and 0 scenes"):
        search_weather(SUITE, "fog", broken.render, recall_in_fog, "recall<0.5")


def test_the_command_refuses_before_it_renders(tmp_path: Path, capsys) -> None:
    command = ["suite", "search", "procedural:street?seed=3", "--out", str(tmp_path / "out")]
    for options, message in (
        (["--effect", "night", "--until", "r<1", "--command", "true"], "night of weather-c-v1"),
        (["--effect", "fog", "--until", "r=1", "--command", "true"], "is no condition"),
        (["--effect", "fog", "--until", "r<1", "--command", "no-such-x"], "no such program"),
    ):
        assert main([*command, *options]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
