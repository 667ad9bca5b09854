"""`climategs generate`: its arguments, what it prints, and how it ends."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from augment.errors import ClimateGSError
from augment.jobs.atomic import write_atomic
from tools.cli import GenerateOptions, main
from tools.render import ended_by_sigterm, generate_dataset


def test_what_is_no_shard() -> None:
    assert GenerateOptions(out="o", status=True, shard="07/8")
    for text in ("", "1", "/", "0/3", "4/3", "-1/3", "1/3/5", "a/b", "1 of 3", "1/", "1.0/2",
                 "1/" + "9" * 5000):  # fmt: skip
        with pytest.raises(ClimateGSError, match="write i/n with i from 1 to n, as in 2/8"):
            GenerateOptions(out="o", status=True, shard=text)


def test_sigterm_is_as_ctrl_c() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), ended_by_sigterm():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_job_whose_scenes_cannot_be_opened(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "job.yaml").write_text("scenes: [missing]\nrecipes: [clear]\n")
    job, out = tmp_path / "job.yaml", tmp_path / "out"
    assert main(["generate", str(job), "--out", str(out), "--executor", "serial"]) == 2
    said = capsys.readouterr().err
    assert "none of its scenes can be used" in said and str(tmp_path / "missing") in said
    with pytest.raises(ClimateGSError, match="none of its scenes"):
        generate_dataset(GenerateOptions(job=job, out=str(out), executor="serial", dry_run=True))


def test_a_damaged_plan_is_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_atomic(tmp_path / ".climategs/jobs/j.json", b'{"format":1}')
    assert main(["generate", "--out", str(tmp_path), "--status"]) == 2
    assert "j.json is damaged" in capsys.readouterr().err
