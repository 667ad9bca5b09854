"""The benchmarks of effects on a scene of sheets, and measures whose answer is known."""

import dataclasses
import json

import numpy as np
import pytest

from augment.metrics.consistency import DepthView
from tests.streets import SMALL_STREET, open_street
from tools.bench import effects, flood, smog, snow, style
from tools.bench.effects import EffectCase, MaskedView, mask_agreement, neighbours

TINY = EffectCase(
    scene=SMALL_STREET,
    width=96,
    height=64,
    street=SMALL_STREET,
    frames=(0,),
    cameras=("front",),
    scale=0.2,
    cell_m=0.2,
)
BENCHES = {
    "smog": smog.bench_smog,
    "flood": flood.bench_flood,
    "snow": snow.bench_snow,
    "style": style.bench_style,
}


@pytest.mark.parametrize("name", BENCHES)
def test_every_subject_has_its_tables(name, monkeypatch):
    for module in (effects, snow, style):
        monkeypatch.setattr(module, "open_scene", open_street)
    monkeypatch.setattr(style, "PRESETS", ("overcast",))
    monkeypatch.setattr(smog, "SMOGS", dict(list(smog.SMOGS.items())[:1]))
    monkeypatch.setattr(flood, "WAVES", ("calm",))
    found = BENCHES[name](case=TINY, repeats=1, memory=False)
    assert json.loads(json.dumps(found, allow_nan=False))["bench"] == name
    assert all(table["rows"] for table in found["tables"])
    frames, stages = (
        next(t for t in found["tables"] if t["title"].startswith(title))
        for title in ("Frames", "Stages")
    )
    assert all(min(row[1:]) > 0 for row in frames["rows"])
    assert "rasterise" in [row[0] for row in stages["rows"]]
    if name == "style":  # the shipped network is one map
        assert found["facts"]["folding_error"] < 1e-5


def test_neighbours_go_once_around():
    cameras = open_street().frames[0].cameras
    ring = ["front", "front_right", "right", "back", "left", "front_left"]
    assert neighbours(cameras) == list(zip(ring, [*ring[1:], ring[0]], strict=True))


def test_views_agree_with_themselves_and_not_with_what_is_elsewhere():
    camera = open_street().frames[0].cameras["front"].scaled(0.1)
    size = (camera.height, camera.width)
    rgb = np.random.default_rng(0).uniform(0.1, 0.9, (*size, 3))
    mask = np.zeros(size, bool)
    mask[: size[0] // 2] = True

    def agreement(rgb2, mask2, depth_m):
        other = dataclasses.replace(camera)
        views = {
            camera: MaskedView(DepthView(camera, rgb, np.full(size, 10.0), np.ones(size)), mask),
            other: MaskedView(DepthView(other, rgb2, np.full(size, depth_m), np.ones(size)), mask2),
        }
        return mask_agreement([("same", camera, other)], views.__getitem__)[0][1:]

    points, agreeing, worst, rms = agreement(rgb, mask, 10.0)
    assert points > 0.9 * mask.size and agreeing == worst == 1
    assert rms == pytest.approx(0, abs=1e-6)
    assert agreement(rgb + 0.1, mask, 10.0)[3] == pytest.approx(25.5)
    assert agreement(rgb, ~mask, 10.0)[1:] == [0, 0, None]
    assert agreement(rgb, mask, 11.0) == [0, None, None, None]
