"""The benchmark of opening trained scenes on a model of a few splats."""

from __future__ import annotations

import json

import pytest

from tools import bench_open, bench_open_model


@pytest.fixture(scope="module")
def result():
    apart = bench_open._apart
    memory: list[float] = []

    def mostly_here(uri: str, what: str) -> float:
        """Processes of their own take seconds: one is enough, for the memory of the model."""
        if what == "time":
            return bench_open._open_once(uri, what)
        memory[:] = memory or [apart(uri, what)]
        return memory[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_open, "GAUSSIANS", 3000)
        patch.setattr(bench_open, "ACTORS", 2)
        patch.setattr(bench_open_model, "_SKY_TEXELS", 32)
        patch.setattr(bench_open, "_apart", mostly_here)
        return bench_open.bench_open(repeats=1)


def test_figures_are_of_every_way(result):
    assert json.loads(json.dumps(result))["rows"] == result["rows"]
    assert (result["gaussians"], result["actors"]) == (3000, 2)
    assert [row["what"] for row in result["rows"]] == [
        "Street Gaussians model (.pth)",
        "scene folder",
        "scene file",
        "scene file, half precision",
    ]
    for row in result["rows"]:
        assert row["open_s"] > 0 and row["tensor_mib"] > 0 and row["memory"] > 0


def test_the_text_has_a_row_for_every_way(result):
    text = bench_open.open_text(result)
    assert "3,000 Gaussians, 2 actors among them" in text
    lines = text.splitlines()[-4:]
    for line, row in zip(lines, result["rows"], strict=True):
        assert line.startswith(row["what"]) and line.endswith(f" {row['memory']:.2f}")


def test_what_opens_apart_prints_its_figure(tmp_path, capsys):
    from fitted_scenes import fitted_scene

    from augment.files.scene_file import save_scene

    save_scene(fitted_scene(), tmp_path / "scene")
    bench_open.main([json.dumps({"uri": f"scene:{tmp_path / 'scene'}", "what": "time"})])
    assert float(capsys.readouterr().out) > 0
