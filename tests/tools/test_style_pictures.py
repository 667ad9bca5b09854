"""The documentation's pictures of styles, on a scene of sheets."""

import itertools

import cv2
import numpy as np
import pytest

from augment.effects.style.network import save_network
from tests.tools.test_bench_style import sheets, write_photo
from tools import style_pictures
from tools.bench_style_network import random_network
from tools.drawing import CAPTION_PX, GAP_PX

NAMES = ["methods", "presets", "strengths", "regions", "order", "failures"]
WIDTH = 64
HEIGHT = 36  # of a panel of a picture 160 x 90


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(style_pictures, "open_scene", lambda _: sheets(2))
    monkeypatch.setattr(style_pictures, "CAMERA", "ahead")
    monkeypatch.setattr(style_pictures, "FRAME", 0)
    monkeypatch.setattr(style_pictures, "PANEL_PX", WIDTH)


def size_of(columns, rows):
    width = columns * WIDTH + (columns - 1) * GAP_PX
    return rows * (HEIGHT + CAPTION_PX) + (rows - 1) * GAP_PX, width, 3


def panel(image, column, row):
    top, left = row * (HEIGHT + CAPTION_PX + GAP_PX), column * (WIDTH + GAP_PX)
    return image[top : top + HEIGHT, left : left + WIDTH].astype(int)


def drawn(paths):
    assert [path.name for path in paths] == [f"style-{name}.jpg" for name in NAMES]
    return {path.stem.removeprefix("style-"): cv2.imread(str(path)) for path in paths}


def test_presets_stand_in_for_photos(tmp_path):
    images = drawn(style_pictures.draw_style_pictures(tmp_path / "images"))
    assert images["methods"].shape == size_of(3, 3)
    assert images["presets"].shape == size_of(5, 2)
    assert images["strengths"].shape == size_of(4, 2)
    assert images["regions"].shape == size_of(4, 1)
    assert images["order"].shape == size_of(4, 2)
    assert images["failures"].shape == size_of(2, 1)
    names = ["as captured", *style_pictures.style_preset_names()]
    night = panel(images["presets"], names.index("night") % 5, names.index("night") // 5)
    assert night.mean() < 0.4 * panel(images["presets"], 0, 0).mean()
    same, half, whole, _ = (panel(images["strengths"], column, 0) for column in range(4))
    assert np.abs(same - panel(images["presets"], 0, 0)).mean() < 2  # of 255: JPEG
    assert np.abs(whole - same).mean() > np.abs(half - same).mean() > 2


def test_rows_of_photos(tmp_path):
    rng = np.random.default_rng(0)
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("b", "a"):
        write_photo(folder / f"{name}.png", rng)
    (folder / "notes.txt").write_text("no image")
    network = tmp_path / "network.safetensors"
    save_network(network, random_network(), {})
    paths = style_pictures.draw_style_pictures(
        tmp_path / "images", photos=folder, checkpoint=network
    )
    images = drawn(paths)
    assert images["methods"].shape == size_of(5, 2)
    assert images["regions"].shape == size_of(5, 2)
    assert images["strengths"].shape == size_of(4, 3)
    photo = panel(images["methods"], 1, 0)
    first = cv2.imread(str(folder / "a.png"))
    middle = photo[:, 10:54].mean((0, 1))
    np.testing.assert_allclose(middle, first.mean((0, 1)), atol=12)
    shown = [panel(images["methods"], column, 0) for column in (0, 2, 3, 4)]
    for one, other in itertools.pairwise(shown):
        assert np.abs(one - other).mean() > 2
