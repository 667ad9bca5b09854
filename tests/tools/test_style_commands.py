"""`climategs style`: what its commands take and where their words go."""

import dataclasses

import pytest

from augment.effects.style.train import StyleTrainConfig
from recipes.weather import style_preset_names
from tools import cli
from tools.options import StyleTrainOptions


def test_the_training_s_defaults_are_the_library_s():
    known = {field.name: field.default for field in dataclasses.fields(StyleTrainConfig)}
    named = {f.name: f.default for f in dataclasses.fields(StyleTrainOptions) if f.name in known}
    del named["steps"], named["learning_rate"], named["pair_weights"]  # None, "": the library's
    assert named == {name: known[name] for name in named}


def test_presets_are_listed_and_printed(capsys):
    assert cli.main(["style", "presets"]) == 0
    assert tuple(capsys.readouterr().out.split()) == style_preset_names()
    assert cli.main(["style", "presets", "dusk"]) == 0
    assert "covariance:" in capsys.readouterr().out


def test_mistakes_exit_with_2_and_one_message(tmp_path, capsys):
    out = str(tmp_path / "out")
    for words, message in (
        (["presets", "dawn-mits"], "dawn-mist"),
        (["train", "--out", out], "there is nothing to learn from"),
        (["apply", "procedural:street", "dsuk", "--out", out], "dusk"),
    ):
        assert cli.main(["style", *words]) == 2
        error = capsys.readouterr().err
        assert message in error and "Traceback" not in error


def test_the_group_is_listed_with_the_other_commands(capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["style"])
    assert "{apply, train, presets}" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--help"])
    assert "• style" in capsys.readouterr().out
