"""The examples of docs/examples run, and each writes the picture that it names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "docs" / "examples"
# Examples that take some 10 s of processor time; the others take 6 s, most of it for imports.
LONG_EXAMPLES = {"own_drive", "train_on_fog"}
MAX_LINES = 64  # an example is read from top to bottom in a few minutes

NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def test_there_are_examples_and_each_is_short():
    assert {"first_fog", "own_drive", "own_effect", "train_on_fog"} <= set(NAMES)
    for name in NAMES:
        num_lines = len((EXAMPLES / f"{name}.py").read_text().splitlines())
        assert num_lines <= MAX_LINES, f"{name}.py has {num_lines} lines"


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long if n in LONG_EXAMPLES else ()) for n in NAMES]
)
def test_example_writes_its_picture(name, tmp_path):
    # Without TRITON_INTERPRET and the like, as a reader runs it.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TRITON")}
    environment["PYTHONPATH"] = str(ROOT)
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py"), str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert f"picture: {tmp_path / name}.png" in result.stdout
    picture = cv2.imread(str(tmp_path / f"{name}.png"))
    assert picture is not None and picture.std() > 10  # grey levels of 255: not one colour
