"""The documentation's pictures of floods, on a street small enough to be quick."""

import cv2

from tests.streets import open_street
from tools import flood_pictures
from tools.drawing import CAPTION_PX, GAP_PX


def test_three_pictures_of_three_panels(tmp_path, monkeypatch):
    monkeypatch.setattr(flood_pictures, "open_scene", lambda _: open_street())
    monkeypatch.setattr(flood_pictures, "FRAME", 0)
    monkeypatch.setattr(flood_pictures, "SCALE", 0.25)
    monkeypatch.setattr(flood_pictures, "REPEATS", 1)
    paths = flood_pictures.draw_flood_pictures(tmp_path / "images")
    assert [path.name for path in paths] == [
        "flood-levels.jpg",
        "flood-waves.jpg",
        "flood-tiers.jpg",
    ]
    for path in paths:
        image = cv2.imread(str(path))
        height, width = round(540 * 0.25), round(960 * 0.25)
        assert image.shape[1] == 3 * width + 2 * GAP_PX
        assert image.shape[0] == height + CAPTION_PX
        caption = image[height:]
        assert (caption < 128).any() and (caption > 250).mean() > 0.7  # dark text on white
    tiers = cv2.imread(str(paths[2]))[:135].astype(int)
    sky, mirrored = tiers[90:, :240], tiers[90:, -240:]
    assert abs(sky - mirrored).mean() > 3  # water with and without facades in it
