"""`climategs style train` on tiny photos and a tiny scene."""

import dataclasses
import json
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from augment.cameras import Camera, Frame
from augment.effects.style.network import load_network, network_facts
from augment.effects.style.train import StyleTrainConfig, StyleTrainer
from augment.errors import ClimateGSError, OutputError, StyleError
from augment.geometry import rigid
from augment.scene import Gaussians, Scene
from augment.sky import ConstantSky
from tools import style
from tools.options import StyleTrainOptions, parse_pair_weights
from tools.style import checkpoint_folder, train_style

STREET = "procedural:street?seed=3"


@pytest.fixture(autouse=True)
def light(monkeypatch):
    """Few pictures to score by; torch in one thread, as trainings are."""
    monkeypatch.setattr(style, "SCORED", 2)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(4):
        coarse = rng.integers(0, 256, (4, 5, 3), np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), cv2.resize(coarse, (30, 24)))
    return folder


@pytest.fixture
def street(monkeypatch) -> str:
    """A URI that opens as fifty Gaussians, so that no street has to be made."""
    rng = np.random.default_rng(0)
    means = np.stack([rng.uniform(3, 8, 50), *rng.uniform(-2, 2, (2, 50))], -1)
    gaussians = Gaussians(
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(50, 1),
        scales=torch.full((50, 3), 0.3),
        opacities=torch.full((50,), 0.8),
        sh=torch.from_numpy(rng.normal(0, 0.4, (50, 1, 3))).float(),
    )
    forward = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    pose = rigid(forward, torch.zeros(3, dtype=torch.float64))
    camera = Camera("ahead", 24, 16, 20.0, 20.0, 12.0, 8.0, pose)
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"ahead": camera})
    sky = ConstantSky(torch.tensor([0.5, 0.7, 0.9]))
    scene = Scene("tiny", STREET, gaussians, (), sky, (frame,), problems=("it is tiny",))
    monkeypatch.setattr(style, "open_scene", lambda uri: scene)
    assert open_scene is not style.open_scene
    return STREET


def options_of(out: Path, photos: Path, **changes) -> StyleTrainOptions:
    made = {
        "out": out, "photos": (photos,), "steps": 5, "size_px": 16, "batch": 1, "pair_batch": 1,
        "warm_up": 0.2, "pairs": 0.0, "holdout": 0, **changes,
    }  # fmt: skip
    return StyleTrainOptions(**made)


def run(options, **more):
    return train_style(options, progress=False, **more)


def learnt(out: Path) -> bytes:
    return (out / "network.safetensors").read_bytes()


def test_photos_and_a_scene_become_a_network(tmp_path, photos, street, capsys):
    out = tmp_path / "out"
    options = options_of(out, photos, scenes=(street,), pairs=1.0)
    outcome = run(options)
    assert outcome.code == 0 and outcome.report["complete"] and outcome.report["steps"] == 5
    assert outcome.report == json.loads((out / "report.json").read_bytes())
    assert outcome.report["problems"] == ["it is tiny"]
    assert outcome.report["data"]["photos"] == 4 and outcome.report["data"]["views"] == 1
    assert {"content_rmse", "restoration_psnr", "style_loss"} <= set(outcome.report["scores"])
    steps = [row["step"] for row in outcome.report["history"] if "loss" in row]
    assert steps == [1, 2, 3, 4, 5]
    assert cv2.imread(str(out / "curves.png")) is not None
    about = network_facts(out / "network.safetensors")["about"]
    assert about["settings"]["scenes"] == [STREET] and about["settings"]["photos"] == ["photos"]
    assert str(tmp_path) not in json.dumps(about)  # the same bytes wherever it was trained
    assert not load_network(out / "network.safetensors").training
    streams = capsys.readouterr()
    assert "4 photos and 1 views of 1 scenes" in streams.err and "note: it is tiny" in streams.err

    again = run(options)
    assert "finished already" in capsys.readouterr().out and again.report == outcome.report


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


@pytest.mark.long
def test_the_seed_and_the_form_decide(tmp_path, photos):
    first, second, square = (
        options_of(tmp_path / name, photos, steps=1, warm_up=0.0, **changes)
        for name, changes in {"a": {}, "b": {"seed": 1}, "c": {"matrix": "3x3"}}.items()
    )
    for options in (first, second, square):
        run(options)
    assert learnt(first.out) != learnt(second.out)
    assert load_network(first.out / "network.safetensors").offset
    assert not load_network(square.out / "network.safetensors").offset


def test_minutes_become_steps(tmp_path, photos, capsys):
    outcome = run(options_of(tmp_path / "out", photos, steps=None, minutes=0.002))
    assert outcome.report["steps"] >= 1 and outcome.report["complete"]
    assert f"--steps {outcome.report['steps']} gives the same network" in capsys.readouterr().err


def test_other_settings_or_data_need_another_folder(tmp_path, photos, capsys):
    options = options_of(tmp_path / "out", photos, steps=1, warm_up=0.0)
    run(options)
    with pytest.raises(OutputError, match=r"cycle was 10\.0, now 5\.0.*--overwrite"):
        run(dataclasses.replace(options, cycle=5.0))
    with pytest.raises(OutputError, match="its length was --steps 1"):
        run(dataclasses.replace(options, steps=2))
    (checkpoint_folder(options.out) / "fit.json").write_text(
        (checkpoint_folder(options.out) / "fit.json").read_text().replace("true", "false")
    )
    (photos / "3.png").unlink()
    with pytest.raises(
        OutputError, match=r"not those .* was trained on so far: photos was 4, now 3"
    ):
        run(options)
    run(dataclasses.replace(options, overwrite=True))
    for path in checkpoint_folder(options.out).iterdir():
        path.unlink()
    with pytest.raises(OutputError, match="no checkpoint to go on from"):
        run(options)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        run(dataclasses.replace(options, out=tmp_path / "file"))


def test_options_out_of_range_are_named(tmp_path, photos):
    for changes, match in (
        ({"minutes": 1.0}, "--minutes or --steps, not both"),
        ({"encoder": "b1"}, "--encoder is one of small, b0; got 'b1'"),
        ({"encoder_weights": Path("w.pth")}, "add --encoder b0"),
        ({"vgg": Path("absent.pth")}, "--vgg: there is no file absent.pth"),
        ({"steps": 0}, "--steps must be at least 1; got 0"),
        ({"size_px": 4}, "--size-px must be at least 16"),
        ({"cycle": -1.0}, "--cycle must be finite"),
        ({"through": "renderer"}, "--through renderer is for scenes"),
        ({"pair_weights": "same=1,lok=2"}, "one of same, half, look, .*; got 'lok=2'"),
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


def test_pair_weights_keep_what_is_not_named():
    weights = parse_pair_weights("same=2,look=0")
    assert (weights.same, weights.look, weights.half) == (2.0, 0.0, parse_pair_weights("").half)


def test_the_training_s_defaults_are_the_library_s():
    known = {field.name: field.default for field in dataclasses.fields(StyleTrainConfig)}
    named = {f.name: f.default for f in dataclasses.fields(StyleTrainOptions) if f.name in known}
    del named["steps"], named["learning_rate"], named["pair_weights"]  # None, "": the library's
    assert named == {name: known[name] for name in named}
