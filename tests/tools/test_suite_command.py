"""`climategs suite`: what its commands print, and their exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from augment.output.store import open_store
from augment.suite.run import run_suite
from augment.suite.suite_file import read_suite_file
from tests.augment.suite_runs import make_run
from tests.tools.test_mirror_outputs import scene_of, write_sequence
from tools.cli import main
from tools.mirror import mirror_outputs


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("suite")
    run_suite(make_run(out, scenes=["fake:a?frames=2"], effects=["fog"], levels=[3]))
    return out


def test_verify_says_which_file_has_changed(finished: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["suite", "verify", str(finished)]) == 0
    assert "weather-c-v1: all " in capsys.readouterr().out
    path = next((finished / "a/fog-3-000/images/front").glob("*.jpg"))
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    assert main(["suite", "verify", str(finished)]) == 1
    out = capsys.readouterr().out
    assert f"changed: {path.relative_to(finished)}\n" in out and "1 changed, 0 missing" in out
    path.write_bytes(data)
    assert main(["suite", "verify", str(finished)]) == 0


def test_a_changed_byte_in_a_copy_of_the_dataset_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    scene = scene_of(write_sequence(tmp_path / "002"))
    out = tmp_path / "out"
    run = make_run(
        out, scenes=["fake:street"], effects=["fog"], levels=[3], opener=lambda uri: scene
    )
    run_suite(run, before_hashes=lambda: mirror_outputs(scene, out, progress=False))
    suite_file = read_suite_file(open_store(out))
    copies = [path for path in suite_file.files if path.startswith("source/")]
    # Two cameras in four frames, of the clean render and of fog. Other files are the dataset's own.
    assert len(copies) == 16 and "source/fog-3-000/002/camera/left/02.jpg" in copies
    path = out / "source/fog-3-000/002/camera/left/02.jpg"
    data = path.read_bytes()
    path.unlink()  # it may be a link to the rendered image
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert main(["suite", "verify", str(out)]) == 1
    printed = capsys.readouterr().out
    assert "changed: source/fog-3-000/002/camera/left/02.jpg" in printed
    assert "1 changed, 0 missing" in printed


def test_probe_names_the_files_of_a_variant(finished: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["suite", "probe", str(finished), "--variant", "fog-3"]) == 0
    lines = [line.split(" ") for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 3 and {line[0] for line in lines} == {"fog-3"}
    assert all((finished / line[2]).is_file() and len(line[1]) == 64 for line in lines)
    assert main(["suite", "probe", str(finished), "--variant", "fog-4"]) == 2
    assert "has no variant 'fog-4'; it has clean-0, fog-3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["weather-c", "procedural:street"], "--out is missing"),
        (["weather-c", "procedural:street", "--out", "o", "--levels", "7"], "levels 0 to 5; got 7"),
        (["weather-c", "procedural:street", "--out", "o", "--levels", "x"], "levels separated by"),
        (
            ["weather-c", "procedural:street", "--out", "o", "--effects", "snwo"],
            "did you mean snow",
        ),
        (
            ["weather-c", "procedural:street", "--out", "o", "--set", "weather.smog=null"],
            "weather.smog cannot be changed in weather-c-v1",
        ),
        (["plan", "procedural:street", "--quarter", "--frames", "1"], "--quarter has its own"),
        (["verify", "nowhere"], "no suite was rendered there"),
    ],
)
def test_wrong_requests_are_refused(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["suite", *arguments]) == 2
    assert message in capsys.readouterr().err
