"""The documentation's pictures of snow, on a street small enough to be quick."""

import cv2
import numpy as np

from tests.streets import SMALL_STREET, open_street
from tools import snow_pictures
from tools.drawing import CAPTION_PX, GAP_PX


def test_four_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(snow_pictures, "STREET", SMALL_STREET)
    monkeypatch.setattr(snow_pictures, "open_scene", open_street)
    monkeypatch.setattr(snow_pictures, "FRAME", 0)
    monkeypatch.setattr(snow_pictures, "SCALE", 0.25)
    monkeypatch.setattr(snow_pictures, "REPEATS", 1)
    monkeypatch.setattr(snow_pictures, "CELL_M", 0.2)
    paths = snow_pictures.draw_snow_pictures(tmp_path / "images")
    names = ["snow-depths", "snow-shading", "snow-masks", "snow-estimators"]
    assert [path.stem for path in paths] == names
    images = {path.stem: cv2.imread(str(path)).astype(int) for path in paths}
    height, width = round(540 * 0.25), round(960 * 0.25)
    for name in ("snow-depths", "snow-masks"):
        assert images[name].shape == (height + CAPTION_PX, 3 * width + 2 * GAP_PX, 3)
        caption = images[name][height:]
        assert (caption < 128).any() and (caption > 250).mean() > 0.7  # dark text on white
    assert images["snow-shading"].shape[1] == 2 * width + GAP_PX
    road = np.s_[100:130, 60:180]
    assert images["snow-depths"][road].mean() > 170  # white
    mask = images["snow-masks"][100:130, width + GAP_PX + 60 : width + GAP_PX + 180]
    assert (mask[..., 0] - mask[..., 2]).mean() > 60  # blue
