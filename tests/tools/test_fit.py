"""The driver of reconstruction, on stand-ins for what it drives."""

import dataclasses
import json
import os
import signal

import numpy as np
import pytest
from safetensors import SafetensorError

from adapters.base import open_scene
from augment.errors import ClimateGSError, OutputError
from augment.files.scene_file import FORMAT
from augment.jobs.processes import OutputLock
from tests.adapters.recording_files import write_as_recording
from tests.tools.fake_fit import Fakes, FakeTrainer
from tools import fit, training
from tools.cli import main
from tools.fit import fit_scene, held_out_range, open_to_fit, state_folder
from tools.options import FitOptions
from tools.training import Checkpoint, load_checkpoint, save_checkpoint


@pytest.fixture
def drive(tmp_path):
    """A folder that a URI can name; the stand-ins never look into it."""
    (tmp_path / "drive").mkdir()
    return f"recording:{tmp_path / 'drive'}"


@pytest.fixture
def options(drive, tmp_path) -> FitOptions:
    return FitOptions(scene=drive, out=tmp_path / "scene", steps=120)


def but(options, **changes) -> FitOptions:
    """The options with these changed."""
    return FitOptions(**{**dict(options), **changes})


def run(options, fakes, **more):
    with pytest.MonkeyPatch.context() as patch:
        fakes.install(patch)
        return fit_scene(options, progress=False, **more)


def warnings_of(options, fakes):
    """The warnings of `open_to_fit`."""
    with pytest.MonkeyPatch.context() as patch:
        fakes.install(patch)
        return open_to_fit(options)[1]


def written(out) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(out.iterdir())}


def learnt(rows) -> list:
    """A history without what the clock decides."""
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


def test_a_run_writes_scene_checkpoint_and_report(options, capsys):
    fakes = Fakes()
    outcome = run(options, fakes)
    assert outcome.code == 0 and outcome.report["complete"] and outcome.report["step"] == 120
    assert set(written(options.out)) == {"scene.json", "gaussians.bin"}
    saved = load_checkpoint(state_folder(options.out))
    assert saved.finished and saved.step == saved.steps == 120 and saved.data["train views"] == 6
    streams = capsys.readouterr()
    assert "| 6 | 20.0 |" in streams.out and f"scene:{options.out}" in streams.out
    assert streams.err.count("a view lacks its mask") == 1  # said by scene and views alike
    assert outcome.report["problems"] == ["frame 3 has no sweep", "a view lacks its mask"]


def test_a_loss_that_is_no_number_ends_the_run(options, monkeypatch):
    real = FakeTrainer.run_step

    def breaks(self):
        record = real(self)
        return dataclasses.replace(record, loss=float("nan")) if self.step == 30 else record

    monkeypatch.setattr(FakeTrainer, "run_step", breaks)
    with pytest.raises(ClimateGSError, match=r"nan in step 30 \(frame \d, camera '(front|left)'"):
        run(options, Fakes())
    assert not options.out.exists()


class Killed(BaseException):
    pass


def killer(at):
    def kill(step):
        if step == at:
            raise Killed

    return kill


def interrupter(at, number=signal.SIGINT, times=1):
    def interrupt(step):
        if step == at:
            for _ in range(times):
                os.kill(os.getpid(), number)

    return interrupt


def assert_goes_on_to_the_same_bits(options, tmp_path):
    """As a run that nothing stopped. Returns the outcome."""
    resumed = run(options, Fakes())
    plain = but(options, out=tmp_path / "plain")
    whole = run(plain, Fakes())
    assert resumed.code == 0 and written(options.out) == written(plain.out)
    assert learnt(resumed.report["history"]) == learnt(whole.report["history"])
    return resumed


@pytest.mark.parametrize(("at", "checkpoint_s"), [(77, 0), (60, 3600)])
def test_a_killed_run_goes_on_to_the_same_bits(options, tmp_path, at, checkpoint_s):
    with pytest.raises(Killed):
        run(options, Fakes(before_step=killer(at)), checkpoint_s=checkpoint_s)
    assert not options.out.exists()
    assert load_checkpoint(state_folder(options.out)).step == (0 if checkpoint_s else at)
    assert_goes_on_to_the_same_bits(options, tmp_path)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_scene_and_goes_on(options, tmp_path, number, capfd):
    before = signal.getsignal(number)
    outcome = run(options, Fakes(before_step=interrupter(70, number)))
    assert outcome.code == 130 and outcome.report["step"] == 71  # the step it was in is finished
    assert not outcome.report["complete"] and (options.out / "scene.json").is_file()
    assert signal.getsignal(number) is before
    assert "interrupt again to stop at once" in capfd.readouterr().err
    resumed = assert_goes_on_to_the_same_bits(options, tmp_path)
    assert resumed.report["seconds"] > resumed.report["seconds_of_this_run"] > 0


def test_a_second_interruption_stops_at_once(options):
    with pytest.raises(KeyboardInterrupt, match="last checkpoint"):
        run(options, Fakes(before_step=interrupter(70, times=2)))
    assert load_checkpoint(state_folder(options.out)).step == 0


def test_a_finished_run_does_nothing_and_says_so(options, capsys):
    first = run(options, Fakes())
    before = {p: p.stat().st_mtime_ns for p in options.out.iterdir()}
    capsys.readouterr()
    fakes = Fakes()
    again = run(options, fakes)
    assert again.code == 0 and again.report == json.loads(json.dumps(first.report))
    assert fakes.opened == [] and fakes.trainers == []
    assert {p: p.stat().st_mtime_ns for p in options.out.iterdir()} == before
    assert "finished already (120 steps); nothing was done" in capsys.readouterr().out


def test_a_scene_that_was_deleted_is_written_again_from_the_checkpoint(options):
    run(options, Fakes())
    before = written(options.out)
    for path in options.out.iterdir():
        path.unlink()
    fakes = Fakes(before_step=killer(0))  # no step is needed
    run(options, fakes)
    assert written(options.out) == before


def test_other_settings_are_refused_by_name(options):
    run(options, Fakes())
    before = written(options.out)
    for change, message in (
        ({"scale": 0.5}, "scale was 0.25, now 0.5"),
        ({"seed": 3}, "seed was 0, now 3"),
        ({"cameras": "front"}, "cameras was all, now front"),
        ({"depth_weight": 0.0}, r"depth_weight was 2.0, now 0.0"),
        ({"densify": "none"}, "densify was absgrad, now none"),
        ({"steps": 200}, r"its length was --steps 120 \(120 steps\), now --steps 200"),
        ({"steps": None}, r"now --minutes 10"),
    ):
        with pytest.raises(OutputError, match=message):
            run(but(options, **change), Fakes())
    assert written(options.out) == before


def test_minutes_become_steps_once(drive, tmp_path, capsys):
    options = FitOptions(scene=drive, out=tmp_path / "scene", minutes=1e-6)
    fakes = Fakes()
    outcome = run(options, fakes)
    steps = outcome.report["steps"]
    assert len(fakes.trainers) == 2  # the first was thrown away
    assert f"--steps {steps} gives the same scene again" in capsys.readouterr().err
    by_steps = FitOptions(scene=drive, out=tmp_path / "by-steps", steps=steps)
    run(by_steps, Fakes())
    assert written(options.out) == written(by_steps.out)
    # naming the number of steps it became is the same request
    asked = but(options, minutes=None, steps=steps)
    assert run(asked, Fakes()).code == 0


def test_held_out_frames_as_a_range():
    for numbers, step, expected in (
        (range(6), 2, "1::2"),
        (range(26), 8, "7::8"),
        (range(5, 12), 2, "6::2"),
        (range(0, 20, 2), 2, "2::4"),
        (range(1), 2, None),
        (range(3), 3, "2::1"),
        ((0, 1, 2, 5, 6, 9), 2, "1::4"),
        ((0, 1, 2, 4, 5, 6), 2, None),  # no range holds 1, 4 and 6 alone
    ):
        assert held_out_range(list(numbers), step) == expected


def test_scenes_are_opened_without_the_held_out_frames(drive, tmp_path):
    for numbers, query, last in (
        (range(6), "", "held_out=1::2"),
        (range(4, 9), "?frames=4:9", "held_out=5::2"),
        (range(0, 12, 2), "", "held_out=2::4"),
    ):
        fakes = Fakes(numbers=list(numbers))
        options = FitOptions(scene=drive + query, out=tmp_path / "scene", steps=1)
        assert warnings_of(options, fakes) == () and fakes.opened[-1].endswith(last)
        assert len(fakes.opened) == (2 if last == "held_out=2::4" else 1)


def test_a_scheme_that_cannot_hold_out_is_a_problem(tmp_path):
    (tmp_path / "a.ply").touch()
    options = FitOptions(scene=f"gaussians:{tmp_path / 'a.ply'}", out=tmp_path / "o", steps=1)
    fakes = Fakes()
    assert "may be too good" in warnings_of(options, fakes)[0]
    assert "held_out=" not in fakes.opened[0]


def test_a_scene_without_images_is_refused_with_the_way_out(tmp_path):
    options = FitOptions(scene="procedural:street?seed=3", out=tmp_path / "scene", steps=1)
    render = r"climategs render clear --scene 'procedural:street\?seed=3' --out raw"
    with pytest.raises(ClimateGSError, match=f"(?s){render}.*fit recording:raw/street/clear-000"):
        run(options, Fakes(recorded=False))


def test_mistakes_exit_with_2_before_anything_is_opened(tmp_path, capsys):
    out = tmp_path / "scene"
    for arguments, message in (
        (["--steps", "5", "--minutes", "1"], "--minutes or --steps, not both"),
        (["--steps", "0"], "--steps must be greater than or equal to 1; got 0"),
        (["--minutes", "nan"], "--minutes must be a finite number; got nan"),
        (["--minutes", "inf"], "got inf"),
        (["--scale", "0"], "--scale must be greater than 0; got 0.0"),
        (["--scale", "2"], "got 2.0"),
        (["--holdout", "every-1st"], "every-2nd or every-8th"),
        (["--holdout", "half"], "got 'half'"),
        (["--seed", "-1"], "--seed must be greater than or equal to 0; got -1"),
        (["--sh-degree", "4"], "--sh-degree must be less than or equal to 3; got 4"),
        (["--max-splats", "0"], "--max-splats"),
        (["--depth-weight", "-1"], "--depth-weight must be greater than or equal to 0"),
        (["--image-cache-mb", "-1"], "--image-cache-mb"),
        (["--depth", "/nowhere/depth"], "there is no folder '/nowhere/depth'"),
        (["--depth", "relative:"], "--depth is lidar, none, or lidar and folders"),
        (["--depth", "lidar,lidar"], "lidar is given twice"),
        (["--ego-masks", "/nowhere/masks"], "--ego-masks: there is no folder /nowhere/masks"),
        (["--cameras", "a,,b"], "--cameras is names separated by commas"),
    ):
        assert main(["fit", "procedural:street", "--out", str(out), *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and "Traceback" not in error
        assert list(tmp_path.iterdir()) == []


def test_what_else_is_in_the_output_folder_is_kept(options):
    options.out.mkdir()
    (options.out / "diary.txt").write_text("mine")
    anew = but(options, overwrite=True)
    for refused in (options, anew):
        with pytest.raises(OutputError, match="holds something else than a scene"):
            run(refused, Fakes())
    assert (options.out / "diary.txt").read_text() == "mine"
    (options.out / "scene.json").write_text(json.dumps({"format": FORMAT}))
    with pytest.raises(OutputError, match=r"there is no .*scene\.fit to go on from"):
        run(options, Fakes())
    assert run(anew, Fakes()).code == 0


def test_two_runs_at_once_are_refused(options):
    refused = pytest.raises(OutputError, match="being written by another job")
    with OutputLock(state_folder(options.out)), refused:
        run(options, Fakes())


def checkpoint(**more) -> Checkpoint:
    values = {"settings": {"scale": 0.25}, "length": {"steps": 9}, "steps": 9, "data": {}}
    return Checkpoint(**{**values, **more})


def test_checkpoints_keep_every_type_to_the_bit(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "f8": np.array([np.nan, np.inf, -0.0, 5e-324]),
        "i2": np.array([-3], np.int16),
        "flag": np.array([True, False]),
        "none": np.zeros((0, 4), np.float32),
        "scalar": np.array(2.5),
        "turned": rng.normal(size=(4, 3)).astype(np.float32).T,
    }
    facts = {"rng": rng.bit_generator.state, "rate": 0.1 + 0.2, "names": ["a", "ß"]}
    save_checkpoint(tmp_path, checkpoint(step=4, arrays=arrays, facts=facts))
    loaded = load_checkpoint(tmp_path)
    assert loaded.facts == facts and loaded.step == 4
    assert loaded.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        back = loaded.arrays[name]
        assert back.dtype == array.dtype and back.shape == array.shape and back.flags.writeable
        assert back.tobytes() == array.tobytes()


def test_a_new_checkpoint_replaces_the_old_and_failing_keeps_it(tmp_path, monkeypatch):
    save_checkpoint(tmp_path, checkpoint(step=1, arrays={"a": np.ones(3)}))
    save_checkpoint(tmp_path, checkpoint(step=2, arrays={"a": np.full(3, 2.0)}))
    assert [p.name for p in tmp_path.glob("state-*")] == ["state-0000002.safetensors"]
    replace = os.replace

    def full(source, target):
        if str(target).endswith("fit.json"):
            raise OSError(28, "No space left on device")
        replace(source, target)

    def half(arrays, path):
        path.with_name(".tmpAbC").write_bytes(b"half")
        raise SafetensorError("Error while serializing: No space left on device (os error 28)")

    for place, name, fails, message in (
        (os, "replace", full, "disk is full"),
        (training, "save_file", half, r"state-0000003.safetensors: .*No space left"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, fails)
            with pytest.raises(OutputError, match=message):
                save_checkpoint(tmp_path, checkpoint(step=3, arrays={"a": np.full(3, 3.0)}))
        assert load_checkpoint(tmp_path).arrays["a"][0] == 2.0
    save_checkpoint(tmp_path, checkpoint(step=3, arrays={"a": np.zeros(3)}))
    assert {p.name for p in tmp_path.iterdir()} == {"fit.json", "state-0000003.safetensors"}


def test_a_damaged_checkpoint_is_named(tmp_path):
    cut, garbage = (lambda path: path.read_bytes()[:40]), (lambda _: b"\x00garbage")
    for name in ("fit.json", "state-0000001.safetensors"):
        for damage in (cut, garbage, None):
            save_checkpoint(tmp_path, checkpoint(step=1, arrays={"a": np.ones(100)}))
            path = tmp_path / name
            path.write_bytes(damage(path)) if damage else path.unlink()
            if not (tmp_path / "fit.json").exists():
                assert load_checkpoint(tmp_path) is None
                continue
            with pytest.raises(OutputError, match=rf"{name} is damaged.*--overwrite"):
                load_checkpoint(tmp_path)


@pytest.fixture
def recording(tmp_path) -> str:
    """A street of 3 m with a moving car, recorded by small cameras."""
    folder = write_as_recording(tmp_path / "drive")
    return f"recording:{folder}?voxel_m=0.5&image_scale=1&sky_size=8"


def real_fit(recording, out, before_step=lambda step: None):
    run_step = fit.Trainer.run_step

    def noting(trainer):
        before_step(trainer.step)
        return run_step(trainer)

    options = FitOptions(scene=recording, out=out, steps=6, scale=1.0, max_splats=20_000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit.Trainer, "run_step", noting)
        return fit_scene(options, progress=False)


@pytest.mark.long
def test_a_recording_is_fitted_and_interruptions_change_no_bit(tmp_path, recording):
    whole = real_fit(recording, tmp_path / "whole")
    assert whole.code == 0
    stopped = real_fit(recording, tmp_path / "parts", interrupter(2))
    assert stopped.code == 130
    so_far = open_scene(f"scene:{tmp_path / 'parts'}")
    assert so_far.actors and so_far.frames
    assert real_fit(recording, tmp_path / "parts").code == 0
    assert written(tmp_path / "whole") == written(tmp_path / "parts")
    scored = [row["psnr"] for row in whole.report["history"] if row.get("split") == "train"]
    assert scored[-1] > scored[0]
