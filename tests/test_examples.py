"""The examples of docs/examples run, and each writes the picture that it names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "docs" / "examples"
# Examples that take some 10 s of processor time; the others take 6 s, most of it for imports.
LONG_EXAMPLES = {
    "closed_loop",
    "own_drive",
    "own_effect",
    "robust_detector",
    "train_detector",
    "train_on_fog",
    "weather_env",
}
MAX_LINES = 64  # an example is read from top to bottom in a few minutes


def fades_to_the_right(picture: np.ndarray) -> bool:
    """Clear beside foggy: fog takes contrast from houses and sky, the upper half.

    It leaves 0.42 of it in dense fog, 0.71 in the thinner fog of own_drive, and 1 without fog.
    """
    clear, foggy = np.split(picture[: len(picture) // 2], 2, axis=1)
    return clear.std() > 10 and foggy.std() < 0.85 * clear.std()


def is_sepia_far_away(picture: np.ndarray) -> bool:
    """The sky, which is far, is yellow (-46 of 255) instead of blue; the road stays grey (-3)."""
    blue_minus_red = (picture[..., 0] - picture[..., 2]).mean(1)
    return blue_minus_red[:60].mean() < -30 and abs(blue_minus_red[-30:].mean()) < 15


def predicts_the_road(picture: np.ndarray) -> bool:
    """Image, true road, predicted road: the prediction is 243 on the road, 6 off it, of 255."""
    _, road, prediction = np.split(picture[..., 0], 3, axis=1)
    return prediction[road > 127].mean() > 100 + prediction[road < 127].mean()


def finds_the_cars(picture: np.ndarray) -> bool:
    """Image, true heat map, learnt heat map: 129 of 255 in middles of cars, 1 off cars."""
    _, truth, prediction = np.split(picture[..., 0], 3, axis=1)
    return prediction[truth > 127].mean() > 60 + prediction[truth == 0].mean()


# What the picture of each example must show, by name.
SHOWS = {
    "closed_loop": fades_to_the_right,
    "first_fog": fades_to_the_right,
    "own_drive": fades_to_the_right,
    "own_effect": is_sepia_far_away,
    "robust_detector": fades_to_the_right,
    "train_detector": finds_the_cars,
    "train_on_fog": predicts_the_road,
    "weather_env": fades_to_the_right,
}

NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def test_there_are_examples_and_each_is_short():
    assert set(NAMES) == set(SHOWS)
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
    assert picture is not None
    assert SHOWS[name](picture.astype(np.float64))
