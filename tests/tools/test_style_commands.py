"""`climategs style`: what its commands take and where their words go."""

import dataclasses

import pytest

from augment.effects.style.train import StyleTrainConfig
from recipes.weather import style_preset_names
from tools import cli
from tools.style_train_options import StyleTrainOptions


def test_the_training_s_defaults_are_the_library_s():
    known = {field.name: field.default for field in dataclasses.fields(StyleTrainConfig)}
    named = {f.name: f.default for f in dataclasses.fields(StyleTrainOptions) if f.name in known}
    del named["steps"], named["learning_rate"], named["pair_weights"]  # None, "": the library's
    assert named == {name: known[name] for name in named}


def test_every_option_reaches_the_training(monkeypatch, tmp_path):
    seen = []

    def train(options):
        seen.append(options)
        return type("Outcome", (), {"code": 7, "report": {}})()

    monkeypatch.setattr("tools.style_train.train_style", train)
    words = ["--out", str(tmp_path), "--photos", str(tmp_path), "--steps", "3", "--half-precision"]
    words += ["--pair-weights", "look=2", "--batch", "5", "--pair-batch", "6", "--matrix", "3x3"]
    assert cli.main(["style", "train", *words]) == 7
    expected = StyleTrainOptions(
        tmp_path,
        photos=(tmp_path,),
        steps=3,
        half_precision=True,
        pair_weights="look=2",
        batch=5,
        pair_batch=6,
        matrix="3x3",
    )
    assert seen == [expected]


def test_presets_are_listed_and_printed(capsys):
    assert cli.main(["style", "presets"]) == 0
    assert tuple(capsys.readouterr().out.split()) == style_preset_names()
    assert cli.main(["style", "presets", "dusk"]) == 0
    assert "covariance:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["presets", "dawn-mits"], "dawn-mist"),
        (["train", "--out", "OUT"], "there is nothing to learn from"),
        (["apply", "procedural:street", "dsuk", "--out", "OUT"], "dusk"),
    ],
)
def test_mistakes_exit_with_2_and_one_message(words, message, tmp_path, capsys):
    words = [str(tmp_path / "out") if word == "OUT" else word for word in words]
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
