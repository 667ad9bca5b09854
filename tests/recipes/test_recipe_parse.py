"""Every message a wrong recipe gets, and what right ones mean."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from recipes.errors import MAX_SHOWN, Place, Problems, RecipeError
from recipes.files import digest_of, read_files, with_digest
from recipes.load import MAX_BYTES, dump_recipe, load_recipe, parse_recipe, preset_names
from recipes.ranges import Choice, Normal, TripleLine, Uniform
from recipes.schema import Recipe
from recipes.sections import recipe_file
from recipes.style import Style
from recipes.template import RecipeTemplate
from recipes.yaml_tree import ListNode, MapNode, plain, plain_value, read_tree


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml")
    return caught.value.problems


def smog(field: str) -> str:
    """A recipe whose line 4 is `field`."""
    return f"version: 1\nweather:\n  smog:\n    {field}\n    extinction_per_m: 0.01\n"


def value_of(field: str):
    template = parse_recipe(smog(field), source="r.yaml")
    return template.values["weather.smog." + field.split(":")[0]]


S = "r.yaml:4: weather.smog."


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("visibility_m: -5", "visibility_m = -5: must be > 0 and <= 1000000 (metres)"),
        ("visibility_m: far", "visibility_m = 'far': must be a number > 0 and <= 1000000 (metres)"),
        ("base_height_m: .nan", "base_height_m = .nan: must be a number >= -10000 and <= 10000"),
        ("base_height_m: 5 m", "(metres); write the number alone"),
        ("base_height_m: 0,5", "(metres); decimals take a point"),
        ("base_height_m: '5'", "= '5': must be a number >= -10000 and <= 10000 (metres); write it"),
        ("base_height_m:", "base_height_m = null: must be a number >= -10000"),
        ("visibility_km: 3", "visibility_km: unknown field; did you mean visibility_m (metres)?"),
        ("Visibility-M: 3", "Visibility-M: unknown field; did you mean visibility_m (metres)?"),
        ("density: 3", "density: unknown field; did you mean extinction_per_m (1/metre)?"),
        ("colour: [0, 0, 0]", "colour: unknown field; did you mean color?"),
        ("probabilty: 1", "probabilty: unknown field; did you mean probability?"),
        ("scale: 1", "scale: unknown field here; did you mean render.scale?"),
        ("seed: 1", "seed: unknown field here; did you mean seed at the top or weather.flood.wave"),
        ("qqq: 1", "qqq: unknown field; known here: visibility_m, extinction_per_m, mor_m, color"),
        ('"a\\nb": 1', "a\\nb: unknown field"),
        ("model: defered", "= 'defered': must be one of per_gaussian, deferred; did you mean def"),
        ("model: {uniform: [a, b]}", "uniform is for numbers; a range here is choice"),
        ("color: grey", "color = 'grey': must be [red, green, blue], each a number >= 0 and <= 1"),
        ("color: [194, 0.2, 0]", "color[0] = 194: must be >= 0 and <= 1; divide 0-255 values by"),
        ("color: [0, 0, {uniform: [0, 2]}]", "color[2].uniform[1] = 2: must be >= 0 and <= 1"),
        ("color: {uniform: [0, [1, 1, 1]]}", "color.uniform[0] = 0: must be [red, green, blue]"),
        ("color: {uniform: [[0, 0, 0]]}", "must be [from, to], each [red, green, blue]"),
        ("color: {normal: {mean: 1}}", "normal is for numbers; a range here is uniform or choice"),
        (
            "color: {uniform: [[0, 0, 0], [0, 0, {uniform: [0, 1]}]]}",
            "color.uniform[1][2] = {uniform: ...}: must be a nu",
        ),
        ("probability: 1.5", "probability = 1.5: must be >= 0 and <= 1"),
        ("probability: {uniform: [0, 1]}", "probability = {uniform: ...}: must be a number >= 0 a"),
        # ranges: both ends, mean and options
        ("base_height_m: {uniform: [-1e5, 0]}", "base_height_m.uniform[0] = -1e5: must be >= -1"),
        ("base_height_m: {uniform: [0, x]}", "base_height_m.uniform[1] = 'x': must be a number"),
        ("visibility_m: {uniform: [null, 1]}", "uniform[0] = null: must be a number > 0"),
        ("base_height_m: {uniform: [3, 1]}", "the low end comes first"),
        ("base_height_m: {uniform: [3]}", "base_height_m.uniform = [3]: must be [low, high]"),
        ("base_height_m: {log_uniform: [0, 1]}", "log_uniform[0] = 0: must be > 0"),
        ("base_height_m: {normal: [1, 2]}", "base_height_m.normal = [1, 2]: must be"),
        ("base_height_m: {normal: {mean: 1, std: 1, min: 0}}", "_m.normal.max: must be given"),
        ("base_height_m: {normal: {mean: 1, std: 1, min: -1e5, max: 2}}", "base_height_m.normal.m"),
        ("base_height_m: {normal: {mean: 1, std: 1, min: 0, max: 1e5}}", "base_height_m.normal.ma"),
        ("base_height_m: {normal: {mean: 5, std: 1, min: 0, max: 2}}", "mean must be from min to"),
        ("base_height_m: {normal: {mean: 1, std: 0, min: 0, max: 2}}", "base_height_m.normal.std"),
        ("base_height_m: {normal: {mean: 1, std: 1, min: 1, max: 1}}", "max must be > min"),
        ("base_height_m: {choice: [0, 1, 1e5]}", "choice[2] = 1e5: must be >= -10000"),
        ("base_height_m: {choice: []}", "choice = []: must be a list of at least one option"),
        ("base_height_m: {choice: [0, {uniform: [0, 1e5]}]}", "base_height_m.choice[1].uniform[1]"),
        ("base_height_m: {choice: [0, 1], weights: [1]}", "weights must be 2 numbers, one"),
        ("base_height_m: {choice: [0], weights: [x]}", "weights[0] = 'x': must be a number"),
        ("base_height_m: {choice: [0], weights: [0]}", "each weight is 0 or from 1e-9"),
        ("base_height_m: {choice: [0], weight: [1]}", "base_height_m.weight: no part of a range"),
        ("base_height_m: {uniform: [0, 1], choice: [1]}", "or a range: a mapping with one of"),
        ("base_height_m: {unifrom: [0, 1]}", "no range is called 'unifrom'; did you mean uniform?"),
        ("base_height_m: {}", "or a range: a mapping with one of uniform, log_uniform, normal, ch"),
        # a word for a switch
        ("scale_height_m: off", "or null; write null"),
        ("overcast: off", "and <= 1; write 0"),
        ("visibility_m: off", "or null; write null"),
        ("model: false", "one of per_gaussian, deferred; leave it out for per_gaussian"),
    ],
)
def test_a_wrong_field_is_named_with_its_line_and_what_is_allowed(field: str, message: str) -> None:
    (problem,) = problems(smog(field))
    assert problem.startswith(S)
    assert message in problem


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version: 2\nanything: else", "r.yaml:1: version = 2: this package reads version 1"),
        ("version: 1.0", "r.yaml:1: version = 1.0: this package reads version 1"),
        ("[1, 2]", "r.yaml:1: a recipe is a mapping of fields; got [1, 2]"),
        ("just text", "r.yaml:1: a recipe is a mapping of fields; got 'just text'"),
        ("null", "r.yaml:1: the file is empty"),
        ("seed: 1.0", "r.yaml:1: seed = 1.0: must be a whole number >= 0 and < 922337203"),
        ("seed: 9223372036854775808", "must be >= 0 and < 9223372036854775808"),
        ("seed: {choice: [1]}", "seed = {choice: ...}: must be a whole number >= 0 and < 92"),
        ("name: a b", "r.yaml:1: name = 'a b': must be up to 64 letters, digits, '.', '_' or '-'"),
        ("variants: 0", "r.yaml:1: variants = 0: must be >= 1 and <= 1000000"),
        ("variant: 2147483647\nvariants: 2", "r.yaml:1: variant = 2147483647: too large with var"),
        ("fog: {}", "r.yaml:1: fog: unknown field here; did you mean weather.smog?"),
        ("wether: {}", "r.yaml:1: wether: unknown field; did you mean weather?"),
        ("weather: 3", "r.yaml:1: weather = 3: must be a mapping, with smog"),
        ("weather: {smog: {choice: [1]}}", "weather.smog.choice: a range stands for one field"),
        (
            "render: {speed: {antialiased: yes}}",
            "antialiased = 'yes': must be true or false; write true",
        ),
        ("render: {sh_degree: 1.5}", "render.sh_degree = 1.5: must be a whole number >= 0 and <="),
        ("output: {jpeg_quality: {uniform: [1, 9.5]}}", "uniform[1] = 9.5: must be a whole number"),
        ("output: {image: PNG}", "image = 'PNG': must be one of png, jpg; did you mean png?"),
        ("\nweather:\n  smog: {}", "r.yaml:3: weather.smog: needs a density: give visibility_m (m"),
        ("weather: {smog: {visibility_m: 1, extinction_per_m: 1}}", "weather.smog: visibility_m a"),
        ("weather: {smog: {visibility_m: {choice: [100, null]}}}", "needs a density: give visibil"),
        ("weather: {smog: {visibility_m: {uniform: [0.01, 100]}}}", "means an extinction of 391/m"),
        ("snow: {depth_m: 0.1}", "snow: unknown field here; did you mean weather.snow?"),
        ("weather: {snows: 1}", "weather.snows: unknown field; did you mean snow?"),
        ("weather: {snow: 0.1}", "weather.snow = 0.1: must be a mapping, with depth_m, coverage"),
        ("weather: {depth_m: 0.1}", "weather.snow.depth_m or weather.snow.road.depth_m or"),
        ("weather: {wind: {}}", "did you mean weather.snow.wind or weather.flood.waves?"),
        ("weather: {flood: {level_m: 1, wind: 3}}", "wind: unknown field; did you mean waves?"),
        ("weather: {flood: {level_m: 1, depth_cm: 3}}", "unknown field; did you mean level_m (m"),
        ("output: {surface: snow}", "surface = 'snow': must be one of solid, scene, first"),
        ("stile: {preset: dusk}", "stile: unknown field; did you mean style?"),
        ("weather: {style: {preset: dusk}}", "here; did you mean style at the top?"),
        ("preset: dusk", "did you mean weather.flood.waves.preset or style.preset?"),
        ("per_region: true", "per_region: unknown field here; did you mean style.per_region?"),
        ("style: dusk", "style = 'dusk': must be a mapping, with image, preset, mask, method"),
        ("style: {smog: 1}", "did you mean weather.smog?"),
    ],
)
def test_a_wrong_file(text: str, message: str) -> None:
    (problem,) = problems(text)
    assert message in problem


def test_all_problems_are_reported_in_the_order_of_the_lines() -> None:
    text = """
seed: x
weather:
  smog:
    visibility_m: -1
    visibility_m: 5
    color: [2, 0.5, -1]
output: {image: gif}
"""
    found = problems(text)
    assert [problem.split(":")[1] for problem in found] == ["2", "5", "6", "7", "7", "8"]
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml")
    assert str(caught.value) == "\n".join(found)


def test_a_flood_of_problems_is_cut_short() -> None:
    found = problems("\n".join(f"qqq{i}: 1" for i in range(MAX_SHOWN + 10)))
    assert len(found) == MAX_SHOWN + 1
    assert found[-1] == "r.yaml: and 10 problems more"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("base_height_m: 5", 5.0),
        ("base_height_m: 1e-3", 0.001),
        ("scale_height_m: null", None),
        ("scale_height_m:", None),
        ("model: deferred", "deferred"),
        ("color: [0, 0.5, 1]", (0.0, 0.5, 1.0)),
        ("base_height_m: {uniform: [0, 2]}", Uniform(0.0, 2.0)),
        ("base_height_m: {uniform: [2, 2]}", Uniform(2.0, 2.0)),
        ("base_height_m: {log_uniform: [1, 2]}", Uniform(1.0, 2.0, log=True)),
        ("base_height_m: {normal: {mean: 1, std: 2, min: 0, max: 3}}", Normal(1.0, 2.0, 0.0, 3.0)),
        ("scale_height_m: {choice: [null, 5]}", Choice((None, 5.0), (1.0, 1.0))),
        ("model: {choice: [deferred], weights: [2]}", Choice(("deferred",), (2.0,))),
        ("color: {uniform: [[0, 0, 0], [1, 1, 1]]}", TripleLine((0.0,) * 3, (1.0,) * 3)),
        ("color: [0, {uniform: [0, 1]}, 1]", (0.0, Uniform(0.0, 1.0), 1.0)),
        ("color: {choice: [[0, 0, 0]]}", Choice(((0.0, 0.0, 0.0),), (1.0,))),
    ],
)
def test_right_fields(field: str, value: object) -> None:
    got = value_of(field)
    assert got == value and repr(got) == repr(value)  # repr tells 5 from 5.0


def test_whole_numbers_stay_whole_in_ranges() -> None:
    text = "output: {jpeg_quality: {normal: {mean: 80.5, std: 2.5, min: 70, max: 95}}}"
    (value,) = parse_recipe(text, source="r").values.values()
    assert repr(value) == "Normal(mean=80.5, std=2.5, low=70, high=95)"


def test_a_name_is_taken_as_written() -> None:
    for name in ("2024", "1e3", "0x1F", "true", "'null'"):
        assert parse_recipe(f"name: {name}", source="r").name == name.strip("'")


def test_aliases_may_repeat_a_range() -> None:
    text = "render: {scale: &r {choice: [0.5, 1]}, near_m: *r}"
    values = parse_recipe(text, source="r").values
    assert values["render.scale"] == values["render.near_m"]


def test_variants_without_a_range_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    parse_recipe("variants: 3", source="r.yaml")
    assert "r.yaml: variants = 3, but no field has a range" in caplog.text
    caplog.clear()
    parse_recipe("variants: 3\nrender: {scale: {choice: [0.5, 1]}}", source="r.yaml")
    parse_recipe("variants: 3\nweather: {smog: {visibility_m: 9, probability: 0.5}}", source="r")
    assert caplog.text == ""


def read(text: str) -> object:
    problems = Problems()
    tree = read_tree(text, Place("f.yaml"), problems, empty="the file is empty")
    problems.raise_if_any()
    return plain(tree)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),  # YAML 1.1 reads this as text
        ("1E3", 1000.0),
        ("-.5", -0.5),
        ("3.", 3.0),
        ("+7", 7),
        ("010", 10),  # octal in YAML 1.1
        ("0x1F", 31),
        ("0o17", 15),
        ("-inf", "-inf"),
        ("-.inf", -math.inf),
        ("true", True),
        ("False", False),
        ("yes", "yes"),
        ("on", "on"),
        ("12:30", "12:30"),  # base 60 in YAML 1.1
        ("1_000", "1_000"),
        ("2024-01-01", "2024-01-01"),
        ("~", None),
        ("", None),
        ("null", None),
        ("1" * 401, "1" * 401),
    ],
)
def test_plain_scalars_follow_yaml_1_2(text: str, value: object) -> None:
    got = plain_value(text)
    assert got == value and type(got) is type(value)


def test_keys_are_text_whatever_they_look_like() -> None:
    assert read("on: 1\nyes: 2\n5: 3\nnull: 4\n") == {"on": 1, "yes": 2, "5": 3, "null": 4}


def test_lines_count_from_one() -> None:
    text = "# comment\na: 1\nb:\n  - x\n  - y\n"
    tree = read_tree(text, Place("f"), Problems(), empty="")
    assert isinstance(tree, MapNode) and isinstance(items := tree["b"], ListNode)
    assert [node.place.line for node in (tree["a"], items, *items)] == [2, 3, 4, 5]


def test_aliases_stand_for_their_anchor() -> None:
    assert read("a: &x [1, 2]\nb: *x\n") == {"a": [1, 2], "b": [1, 2]}


def test_a_byte_order_mark_is_ignored() -> None:
    assert read("\ufeffa: 1") == {"a": 1}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "f.yaml:1: the file is empty"),
        ("# only a comment\n", "f.yaml:1: the file is empty"),
        ("a: 1\na: 2\n", "f.yaml:2: a is given twice (first on line 1)"),
        ("w:\n  s: {v: 1, v: 2}\n", "f.yaml:2: w.s.v is given twice (first on line 2)"),
        ("a:\n\tb: 1\n", "f.yaml:2: not valid YAML: while scanning"),
        ("a:\n\tb: 1\n", "the line holds a tab: indent and separate with spaces"),
        ("a: [1\nb: 2", "f.yaml:2: not valid YAML: while parsing a flow sequence"),
        ("a: 'x", "found unexpected end of stream"),
        ("a: 1\n---\nb: 1", "f.yaml:2: one document a file"),
        ("a: !!python/object:os.system x", "f.yaml:1: the tag 'tag:yaml.org,2002:python/"),
        ("a: !!float 3", "tags are not allowed"),
        ("!x {a: 1}", "f.yaml:1: the tag '!x': tags are not allowed"),
        ("a: 1\n<<: {b: 1}", "f.yaml:2: merge keys (<<) are not read"),
        ("? [a]\n: 1", "f.yaml:1: a key must be plain text"),
        ("a: *q", "f.yaml:1: *q refers to no anchor that ends above it"),
        ("a: &q [*q]", "f.yaml:1: *q refers to no anchor that ends above it"),
        ("a: 1\nb: \x01", "f.yaml:2: not valid YAML: it holds the character U+0001"),
        ('a: "\\UFFFFFFFF"', "f.yaml:1: not valid YAML"),  # PyYAML lets chr() raise
        ('a: 1\nb: "\\uD800"', "f.yaml:2: \\ud800 holds '\\ud800', which is no character"),
        ('"\\uD800": 1', "f.yaml:1: \\ud800 holds '\\ud800', which is no character"),
        ("%YAML 9.1\n--- a", "incompatible YAML document"),
        ("[" * 40 + "]" * 40, "f.yaml:1: nested more than 32 levels deep"),
        ("a: [" + "1, " * 20_001 + "]", "more than 20000 values"),
    ],
)
def test_what_is_refused(text: str, message: str) -> None:
    with pytest.raises(RecipeError) as caught:
        read(text)
    assert message in str(caught.value)


def test_nested_aliases_cannot_multiply() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    for i in range(1, 10):
        lines.append(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]")
    with pytest.raises(RecipeError, match="more than 20000 values, aliases expanded"):
        read("\n".join(lines))


def test_aliases_cannot_deepen_the_tree() -> None:
    lines = ["a0: &a0 [x]"] + [f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 40)]
    with pytest.raises(RecipeError, match="nested more than 32 levels deep"):
        read("\n".join(lines))


@pytest.mark.parametrize(
    "text",
    ["[" * 65_000, "a: " + "x " * 32_000, "? " * 32_000, "{" + "a: b, " * 10_000, "a:" * 32_000],
    ids=["brackets", "words", "keys", "flow", "colons"],
)
def test_hostile_text_is_refused_or_read_quickly(text: str) -> None:
    start = time.perf_counter()
    try:
        read(text)
    except RecipeError as error:
        assert len(str(error)) < 400, "a message stays one readable line"
    assert time.perf_counter() - start < 30  # about 1 s on an idle core; a hang would be minutes


TEXT = "weather: {smog: {visibility_m: 300}}\n"


def test_a_file_gives_its_name_and_source(tmp_path: Path) -> None:
    path = tmp_path / "foggy.night.yaml"
    path.write_text(TEXT)
    for named in (path, str(path)):
        template = load_recipe(named)
        assert (template.name, template.source) == ("foggy.night", str(path))
    path.write_text("name: other\n" + TEXT)
    assert load_recipe(path).name == "other"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", ":1: the file is empty"),
        (b"a: 1\nb: \xff\xfe\n", ":2: not UTF-8 text (byte 0xff): save the file as UTF-8"),
        ("a: 1".encode("utf-16"), ":1: not UTF-8 text (byte 0xff)"),
        (b"#" * (MAX_BYTES + 1), f": larger than {MAX_BYTES} bytes: this is no recipe"),
        (b"\x00", ":1: not valid YAML: it holds the character U+0000"),
    ],
    ids=["empty", "latin", "utf-16", "large", "binary"],
)
def test_files_that_are_no_recipes(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "r.yaml"
    path.write_bytes(data)
    with pytest.raises(RecipeError) as caught:
        load_recipe(path)
    assert str(caught.value).startswith(f"{path}{message}")


def test_paths_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="is a folder, not a YAML file"):
        load_recipe(tmp_path)
    with pytest.raises(RecipeError, match=r"missing.yaml: no such file, and no such preset; pres"):
        load_recipe(tmp_path / "missing.yaml")
    with pytest.raises(RecipeError, match=r"did you mean light-haze\? presets are blizzard, brown"):
        load_recipe("lite-haze")
    with pytest.raises(RecipeError, match="cannot be read: embedded null byte"):
        load_recipe("a\0b")


def test_recipes_need_neither_torch_nor_the_library() -> None:
    code = "import sys, recipes.load, recipes.job; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "numpy", "augment", "adapters", "tools"} & set(ran.stdout.split())


def test_a_preset_comes_before_a_file_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clear").write_text("seed: 99")
    assert load_recipe("clear").source == "preset clear"
    assert load_recipe("./clear").seed == 99
    assert load_recipe(Path("clear")).seed == 99


def test_the_presets_are_there() -> None:
    assert preset_names() == (
        *("blizzard", "brown-smog", "clear", "deep-flood", "deep-snow", "dense-fog", "downpour"),
        *("drizzle", "drying-road", "dusk-lamps", "dusting", "evening", "first-snow", "flurries"),
        *("fog-bank", "foggy-lamps", "fresh-snow"),
        *("light-haze", "night", "night-fog", "night-rain", "overcast", "passing-shower"),
        *("puddled", "rain", "slush", "snowfall", "storm", "street-flood", "winter-day"),
        *("winter-fog", "winter-street"),
    )
    for name in preset_names():
        template = load_recipe(name)
        assert template.name == name
        template.resolve(0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recipe's folder, beside a file that is none of its business."""
    inside = tmp_path / "recipes"
    (inside / "looks").mkdir(parents=True)
    (inside / "sunset.jpg").write_bytes(b"an image")
    (inside / "looks" / "sky.png").write_bytes(b"a mask")
    (inside / "net.safetensors").write_bytes(b"a network")
    (tmp_path / "secret.jpg").write_bytes(b"an image")
    return inside


def write(folder: Path, style: str) -> Path:
    path = folder / "warm.yaml"
    path.write_text(f"version: 1\nstyle:\n  strength: 0.5\n  {style}\n")
    return path


def problem(folder: Path, style: str) -> str:
    with pytest.raises(RecipeError) as caught:
        load_recipe(write(folder, style))
    (text,) = caught.value.problems
    assert text.startswith(f"{folder}/warm.yaml:4: style.")
    return text


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def test_a_file_is_found_from_the_recipes_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(folder, "image: looks/../sunset.jpg\n  mask: looks/sky.png")
    expected = sha(f"image {sha(b'an image')}\nmask {sha(b'a mask')}\n".encode())
    monkeypatch.chdir(folder.parent)
    for named in (folder / "warm.yaml", "recipes/warm.yaml"):
        style = load_recipe(named).resolve(0).style
        assert style is not None and style.digest == expected
        assert style.image is not None and Path(style.image).is_absolute()
        assert Path(style.image).read_bytes() == b"an image" and style.name == "sunset.jpg"
    monkeypatch.chdir(folder)
    assert load_recipe("warm.yaml").resolve(0).style == style


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("/etc/hostname", "must be a path from the recipe's folder; put the file beside the rec"),
        ("C:/sunset.jpg", "must be a path from the recipe's folder"),
        ("'\\\\server\\x.jpg'", "must be a path from the recipe's folder"),
        ("looks\\sky.png", "must have / between folders"),
        ("../secret.jpg", "leads out of the recipe's folder; put the file beside the recipe, in "),
        ("looks/../../secret.jpg", "leads out of the recipe's folder"),
        ("../recipes/sunset.jpg", "leads out of the recipe's folder"),
        ("sunst.jpg", "; did you mean sunset.jpg?"),
        ("sunset.jpg/x", "there is no such file in "),
        ("nowhere/sunset.jpg", "; put the file beside the recipe or below it"),
        ("looks", "is a folder, not a file"),
        (".", "is a folder, not a file"),
        ('"a\\0b"', "cannot be found: "),
        ("x" * 300, "cannot be"),
    ],
)
def test_other_files_are_refused(folder: Path, name: str, message: str) -> None:
    assert message in problem(folder, f"image: {name}")


def test_links_may_not_lead_out(folder: Path) -> None:
    (folder / "out.jpg").symlink_to(folder.parent / "secret.jpg")
    (folder / "up").symlink_to(folder.parent)
    (folder / "circle.jpg").symlink_to("circle.jpg")
    (folder / "in.jpg").symlink_to("sunset.jpg")
    for name in ("out.jpg", "up/secret.jpg"):
        said = problem(folder, f"image: {name}")
        assert f"leads through a link to {folder.parent}/secret.jpg, out of the recipe's" in said
    assert "cannot be" in problem(folder, "image: circle.jpg")
    assert load_recipe(write(folder, "image: in.jpg")).resolve(0).style is not None


def test_a_folder_reached_through_a_link_is_a_folder(folder: Path) -> None:
    (folder.parent / "alias").symlink_to(folder)
    write(folder, "image: sunset.jpg")
    recipe = load_recipe(folder.parent / "alias" / "warm.yaml").resolve(0)
    assert recipe.hash == load_recipe(folder / "warm.yaml").resolve(0).hash


def test_all_options_are_looked_for_and_all_is_said_at_once(folder: Path) -> None:
    path = write(folder, "image: {choice: [sunset.jpg, dawn.jpg]}\n  checkpoint: nut.safetensors")
    with pytest.raises(RecipeError) as caught:
        load_recipe(path)
    first, second = caught.value.problems
    assert "style.image.choice[1] = 'dawn.jpg': there is no such file" in first
    assert "style.checkpoint = 'nut.safetensors': there is no such file" in second
    assert second.endswith("; did you mean net.safetensors?")


def test_pipes_and_large_files_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(folder / "pipe.jpg")
    assert "cannot be read: a pipe or device, not a regular file" in problem(
        folder, "image: pipe.jpg"
    )
    with (folder / "huge.jpg").open("wb") as file:
        file.truncate(513 * 2**20)  # takes no room on the disk
    assert "holds 513 MiB, more than the 512 MiB" in problem(folder, "image: huge.jpg")


def test_a_file_without_permission(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = os.open

    def refuse(path, *options):
        if Path(path).suffix == ".jpg":
            raise PermissionError(13, "Permission denied", str(path))
        return original(path, *options)

    path = write(folder, "image: sunset.jpg")
    monkeypatch.setattr(os, "open", refuse)  # permissions themselves do not bind root
    with pytest.raises(RecipeError, match=r"style.image = 'sunset.jpg': cannot be read: Perm"):
        load_recipe(path)


def test_a_text_that_is_no_file_names_none(folder: Path) -> None:
    with pytest.raises(RecipeError, match="in no file, so there is no folder to look in"):
        parse_recipe("style: {image: sunset.jpg}", source="text")


def test_a_file_that_goes_after_loading_is_named(folder: Path) -> None:
    template = load_recipe(write(folder, "image: sunset.jpg"))
    (folder / "sunset.jpg").unlink()
    with pytest.raises(
        RecipeError, match=r"variant 0: style.image = 'sunset.jpg': there is no suc"
    ):
        template.resolve(0)


def test_a_given_digest_is_checked(folder: Path) -> None:
    digest = digest_of({"image": sha(b"an image")})
    path = write(folder, f"image: sunset.jpg\n  digest: {digest}")
    style = load_recipe(path).resolve(0).style
    assert style is not None and style.digest == digest
    (folder / "sunset.jpg").write_bytes(b"another one")
    with pytest.raises(RecipeError) as caught:
        load_recipe(path).resolve(0)
    assert "warm.yaml" in str(caught.value) and digest in str(caught.value)
    assert "the file has changed since" in str(caught.value)
    with pytest.raises(RecipeError, match="changed since"):
        read_files(style)


def test_the_hash_is_of_what_the_files_hold(folder: Path, tmp_path: Path) -> None:
    here = load_recipe(write(folder, "image: sunset.jpg\n  mask: looks/sky.png")).resolve(0)
    there = tmp_path / "elsewhere"
    shutil.copytree(folder, there)
    (there / "sunset.jpg").rename(there / "evening.jpg")
    moved = load_recipe(write(there, "image: evening.jpg\n  mask: looks/sky.png")).resolve(0)
    assert moved.hash == here.hash and moved != here
    hashes = {here.hash}
    for style in ("image: evening.jpg", "image: looks/sky.png\n  mask: evening.jpg"):
        hashes.add(load_recipe(write(there, style)).resolve(0).hash)
    (there / "looks" / "sky.png").write_bytes(b"a mesk")
    hashes.add(
        load_recipe(write(there, "image: evening.jpg\n  mask: looks/sky.png")).resolve(0).hash
    )
    assert len(hashes) == 4


def test_recipes_made_in_python_get_their_digest(folder: Path) -> None:
    image, net = str(folder / "sunset.jpg"), str(folder / "net.safetensors")
    bare = Recipe(style=Style(image=image, method="gscm", checkpoint=net))
    full = with_digest(bare)
    assert full.style is not None and bare.style is not None
    expected = digest_of({"image": sha(b"an image"), "checkpoint": sha(b"a network")})
    assert full.style.digest == expected and full.style.image == image
    assert full.hash != bare.hash and with_digest(full) == full
    assert read_files(full.style) == {"image": b"an image", "checkpoint": b"a network"}
    for without in (Recipe(), Recipe(style=Style(preset="dusk"))):
        assert with_digest(without) is without
    (folder / "net.safetensors").write_bytes(b"another")
    with pytest.raises(RecipeError, match="one of the files has changed since"):
        with_digest(full)
    (folder / "sunset.jpg").unlink()
    with pytest.raises(RecipeError, match=r"recipe recipe, variant 0: style.image = .* no such"):
        with_digest(bare)


def test_what_is_written_from_the_folder_reads_back(folder: Path) -> None:
    recipe = load_recipe(write(folder, "image: sunset.jpg")).resolve(0)
    assert recipe.style is not None
    named = recipe.style.model_copy(update={"image": "sunset.jpg"})
    (folder / "numbers.yaml").write_text(
        dump_recipe(recipe.model_copy(update={"style": named})), encoding="utf-8"
    )
    assert load_recipe(folder / "numbers.yaml").resolve(0) == recipe
    assert Recipe.model_validate(recipe.model_dump()) == recipe


KEYS = sorted(
    {key for section in recipe_file().walk() for key in section.keys}
    | {"uniform", "log_uniform", "normal", "choice", "weights", "mean", "std", "min", "max"}
    | {"<<", "visibility_km", "on"}
)
SCALARS = st.sampled_from(
    [
        *("0", "1", "-5", "0.5", "1e-3", "1e400", ".nan", "-.inf", "300", "2", "010"),
        *("null", "", "true", "yes", "png", "dusk", "deferred", "x", "'1'", '"\\ud800"'),
        *("0x" + "f" * 300, "9" * 399, "*a", "&a 1", "!!int 3"),
        *("[0.1, 0.2, 0.3]", "{uniform: [1, 2]}"),
    ]
)


def flow(entries: dict[str, str]) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in entries.items()) + "}"


def block(entries: dict[str, str], head: str = "", indent: str = "") -> str:
    return head + "".join(f"{indent}{key}: {value}\n" for key, value in entries.items())


FLOW = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4).map(lambda items: f"[{', '.join(items)}]")
        | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4).map(flow)
    ),
    max_leaves=12,
)
TOP = st.dictionaries(st.sampled_from(KEYS), FLOW, max_size=5).map(block)
EFFECTS = recipe_file().sections["weather"].sections
WAVE_KEYS = list(EFFECTS["flood"].sections["waves"].sections["components"].keys)
WAVES = st.lists(st.dictionaries(st.sampled_from(WAVE_KEYS), SCALARS).map(flow), max_size=3).map(
    lambda items: "{components: [" + ", ".join(items) + "]}"
)


def effect(name: str, given: dict[str, str], extra: st.SearchStrategy) -> st.SearchStrategy[str]:
    """A recipe of one effect, with what it needs given."""
    keys = [key for key in EFFECTS[name].keys if key not in given and key != "waves"]
    head = f"weather:\n  {name}:\n"
    fields = st.dictionaries(st.sampled_from(keys), FLOW)
    return st.builds(lambda d, e: block({**given, **d, **e}, head, "    "), fields, extra)


NONE = st.just({})
SMOG, SNOW = effect("smog", {}, NONE), effect("snow", {"depth_m": "0.1"}, NONE)
FLOOD = effect("flood", {"level_m": "1"}, NONE | WAVES.map(lambda waves: {"waves": waves}))
GOOD = """version: 1
seed: 7
variants: 2
weather:
  smog: &s
    visibility_m: {log_uniform: [100, 2000]}
    color: {choice: [[0.7, 0.7, 0.7], [0.7, {uniform: [0.6, 0.8]}, 0.7]], weights: [1, 2]}
    scale_height_m: {normal: {mean: 60, std: 10, min: 50, max: 90}}
  flood:
    level_m: {uniform: [0.1, 0.5]}
    absorption_per_m: {uniform: [[1, 2, 3], [2, 3, 4]]}
    waves:
      components:
        - {amplitude_m: 0.01, wavelength_m: {uniform: [1, 2]}, steepness: 0.06}
        - {amplitude_m: 0.002, wavelength_m: 0.3}
  snow:
    depth_m: {uniform: [0.02, 0.2]}
    light: {sun: {choice: [null, 0.5]}}
style: {preset: dusk, strength: {uniform: [0.5, 1]}, method: {choice: [mkl, reinhard]}}
output: {image: png, jpeg_quality: {uniform: [60, 95]}}
"""
# Without derandomize, one run in a thousand would test something that no other run repeats.
FUZZ = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)


def loads_or_explains(text: str) -> RecipeTemplate | None:
    try:
        template = parse_recipe(text, source="fuzz.yaml")
    except RecipeError as error:
        assert error.problems
        for problem in error.problems:
            assert problem.startswith("fuzz.yaml:") and "\n" not in problem
            problem.encode()  # can be printed, even where the text held half a surrogate pair
            assert len(problem) < 1000
        return None
    recipe = template.resolve(0)
    assert parse_recipe(dump_recipe(recipe), source="dump").resolve(0) == recipe
    template.describe_ranges()
    return template


@FUZZ
@given(st.text())
@example("a: \ud800")
@example("? ")
@example("%")
@example("- - - -")
@example("!")
@example("&a *a")
def test_any_text(text: str) -> None:
    loads_or_explains(text)


@FUZZ
@given(st.text(alphabet="ab:-?,[]{}&*!|>'\"%@`#~ \n\t0.1e<=", max_size=60))
def test_text_of_yaml_signs(text: str) -> None:
    loads_or_explains(text)


@settings(FUZZ, max_examples=200)
@given(st.one_of(TOP, SMOG, FLOOD, SNOW))
def test_known_keys_with_any_values(text: str) -> None:
    loads_or_explains(text)


@FUZZ
@given(st.data())
def test_a_good_file_with_a_few_characters_changed(data: st.DataObject) -> None:
    text = GOOD
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 12))
        text = text[:at] + data.draw(st.text(max_size=4)) + text[at + length :]
    loads_or_explains(text)
