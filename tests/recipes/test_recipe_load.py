"""Files and presets."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from recipes.errors import RecipeError
from recipes.load import MAX_BYTES, load_recipe, preset_names

TEXT = "weather: {smog: {visibility_m: 300}}\n"


def test_a_file_gives_its_name_and_source(tmp_path: Path) -> None:
    path = tmp_path / "foggy.night.yaml"
    path.write_text(TEXT)
    for given in (path, str(path)):
        template = load_recipe(given)
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
    with pytest.raises(RecipeError, match=r"did you mean light-haze\? presets are brown-smog, c"):
        load_recipe("lite-haze")
    with pytest.raises(RecipeError, match="cannot be read: embedded null byte"):
        load_recipe("a\0b")


def test_recipes_need_neither_torch_nor_the_library() -> None:
    code = "import sys, recipes.load, recipes.load, recipes.json_schema; print(*sys.modules)"
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
        *("brown-smog", "clear", "deep-flood", "deep-snow", "dense-fog", "dusting", "evening"),
        *("fresh-snow", "light-haze", "overcast", "puddled", "rainy-day", "street-flood"),
        *("winter-day", "winter-fog"),
    )
    for name in preset_names():
        template = load_recipe(name)
        assert template.name == name
        template.resolve(0)
