"""`climategs style train` on tiny photos and a tiny scene."""

import json
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from augment.effects.style.network import load_network, network_facts
from augment.effects.style.train import StyleTrainer
from augment.errors import ClimateGSError, OutputError, StyleError
from augment.files.scene_file import save_scene
from tests.fitted_scenes import fitted_scene
from tools import style
from tools.options import StyleTrainOptions
from tools.style import checkpoint_folder, train_style


@pytest.fixture(autouse=True)
def light(monkeypatch):
    """Few pictures to score by; torch in one thread, as trainings are."""
    monkeypatch.setattr(style, "SCORED", 2)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def without_curves(monkeypatch):
    """Which take ten times as long to draw as what they show."""
    monkeypatch.setattr(style, "write_curves", lambda *_: False)


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(4):
        coarse = rng.integers(0, 256, (4, 5, 3), np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), cv2.resize(coarse, (30, 24)))
    return folder


def options_of(out: Path, photos: Path, **changes) -> StyleTrainOptions:
    made = {
        "out": out, "photos": (photos,), "steps": 5, "size_px": 16, "batch": 1, "pair_batch": 1,
        "pairs": 0.0, "holdout": 0, **changes,
    }  # fmt: skip
    return StyleTrainOptions(**made)


def run(options, **more):
    return train_style(options, progress=False, **more)


def learnt(out: Path) -> bytes:
    return (out / "network.safetensors").read_bytes()


def test_photos_and_a_scene_become_a_network(tmp_path, photos, capsys):
    save_scene(fitted_scene(), tmp_path / "scene")
    out = tmp_path / "out"
    options = options_of(out, photos, scenes=(f"scene:{tmp_path / 'scene'}",), views=2, pairs=1.0)
    outcome = run(options)
    assert outcome.code == 0 and outcome.report["complete"] and outcome.report["steps"] == 5
    assert outcome.report == json.loads((out / "report.json").read_bytes())
    assert set(fitted_scene().problems) < set(outcome.report["problems"])
    assert outcome.report["data"]["photos"] == 4 and outcome.report["data"]["views"] == 2
    assert {"content_rmse", "restoration_psnr", "style_loss"} <= set(outcome.report["scores"])
    steps = [row["step"] for row in outcome.report["history"] if "loss" in row]
    assert steps == [1, 2, 3, 4, 5]
    assert cv2.imread(str(out / "curves.png")) is not None
    about = network_facts(out / "network.safetensors")["about"]
    settings = about["settings"]
    assert settings["scenes"] == ["scene:scene"] and settings["photos"] == ["photos"]
    assert (settings["learning_rate"], settings["cycle"], settings["pair_range"]) == (1e-3, 10, 4)
    assert str(tmp_path) not in json.dumps(about)  # the same bytes wherever it was trained
    assert not load_network(out / "network.safetensors").training
    assert "4 photos and 2 views of 1 scenes" in capsys.readouterr().err

    again = run(options)
    assert "finished already" in capsys.readouterr().out and again.report == outcome.report


@pytest.mark.usefixtures("without_curves")
def test_an_interrupted_training_ends_with_the_same_bytes(tmp_path, photos, monkeypatch, capsys):
    whole = options_of(tmp_path / "whole", photos)
    run(whole)
    parted = options_of(tmp_path / "parted", photos)
    step = StyleTrainer.run_step

    def interrupted(trainer):
        record = step(trainer)
        if record.step == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return record

    with monkeypatch.context() as patch:
        patch.setattr(StyleTrainer, "run_step", interrupted)
        outcome = run(parted)
    assert outcome.code == 130 and outcome.report["step"] == 2 and not outcome.report["complete"]
    assert "stopped after step 2 of 5; the same command goes on" in capsys.readouterr().err
    assert learnt(parted.out) != learnt(whole.out)
    torch.set_num_threads(2)
    outcome = run(parted)
    assert "going on after step 2 of 5" in capsys.readouterr().err
    assert outcome.code == 0 and learnt(parted.out) == learnt(whole.out)
    rows = [json.loads((o.out / "report.json").read_bytes())["history"] for o in (whole, parted)]
    learning = [[{k: v for k, v in row.items() if k != "seconds"} for row in r] for r in rows]
    assert learning[0] == learning[1]
    other = options_of(tmp_path / "other", photos, seed=1)
    run(other)
    assert learnt(other.out) != learnt(whole.out)


@pytest.mark.usefixtures("without_curves")
def test_minutes_become_steps(tmp_path, photos, capsys):
    outcome = run(options_of(tmp_path / "out", photos, steps=None, minutes=0.002))
    assert outcome.report["steps"] >= 1 and outcome.report["complete"]
    assert f"--steps {outcome.report['steps']} gives the same network" in capsys.readouterr().err


@pytest.mark.usefixtures("without_curves")
def test_other_settings_or_data_need_another_folder(tmp_path, photos):
    out = tmp_path / "out"
    run(options_of(out, photos, steps=1))
    with pytest.raises(OutputError, match=r"cycle was 10\.0, now 5\.0.*--overwrite"):
        run(options_of(out, photos, steps=1, cycle=5.0))
    with pytest.raises(OutputError, match="its length was --steps 1"):
        run(options_of(out, photos, steps=2))
    plan = checkpoint_folder(out) / "fit.json"
    plan.write_text(plan.read_text().replace("true", "false"))
    (photos / "3.png").unlink()
    with pytest.raises(
        OutputError, match=r"not those .* was trained on so far: photos was 4, now 3"
    ):
        run(options_of(out, photos, steps=1))
    run(options_of(out, photos, steps=1, overwrite=True))
    for path in checkpoint_folder(out).iterdir():
        path.unlink()
    with pytest.raises(OutputError, match="no checkpoint to go on from"):
        run(options_of(out, photos, steps=1))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        run(options_of(tmp_path / "file", photos))


def test_options_that_cannot_be_are_named(tmp_path, photos):
    for changes, match in (
        ({"minutes": 1.0}, "--minutes or --steps, not both"),
        ({"encoder": "b1"}, "--encoder must be 'small' or 'b0'; got b1"),
        ({"encoder_weights": photos / "0.png"}, "add --encoder b0"),
        ({"vgg": Path("absent.pth")}, "--vgg .*there is no file absent.pth"),
        ({"steps": 0}, "--steps must be greater than or equal to 1; got 0"),
        ({"size_px": 4}, "--size-px must be .* 16; got 4"),
        ({"cycle": -1.0}, "--cycle must be .* 0; got -1"),
        ({"learning_rate": float("nan")}, "--learning-rate must be a finite number; got nan"),
        (dict.fromkeys(["style", "consistency", "cycle", "pairs"], 0.0), "nothing would be learnt"),
    ):
        with pytest.raises(ClimateGSError, match=match):
            options_of(tmp_path / "out", photos, **changes)
    with pytest.raises(ClimateGSError, match="give --photos FOLDER, --scene URI"):
        StyleTrainOptions(out=tmp_path / "out")


def test_no_images_leave_no_training_behind(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(StyleError, match="holds no images"):
        run(options_of(tmp_path / "out", tmp_path / "empty"))
    assert not (tmp_path / "out").exists()
