"""The benchmark of reading on a few small images."""

from __future__ import annotations

import json

import pytest

from tools import bench_dataset
from tools.bench_dataset import Case


@pytest.fixture(scope="module")
def result():
    with pytest.MonkeyPatch.context() as patch:
        # Processes take seconds: three ways of ten show what is measured.
        patch.setattr(bench_dataset, "WAYS", bench_dataset.WAYS[-3:])
        patch.setattr(bench_dataset, "_memory_apart", lambda f, w: bench_dataset._memory(str(f), w))
        return bench_dataset.bench_dataset(Case(images=9, width=48, height=32, rows=700), repeats=1)


def test_figures_are_of_every_way(result):
    assert json.loads(json.dumps(result))["rows"] == result["rows"]
    assert (result["images"], result["width"], result["height"]) == (9, 48, 32)
    assert [row["workers"] for row in result["rows"]] == [1, 1, 1]
    assert result["rows"][0]["of_limit"] == 1
    assert all(row["images_per_s"] > 0 and row["of_limit"] > 0 for row in result["rows"])
    memory = result["memory"]
    # Some eighty bytes a row, where the Arrow table has 440.
    assert memory["rows"] == 700 and 700 * 32 < memory["held_mib"] * 2**20 < 700 * 200


def test_the_text_has_a_row_for_every_way(result):
    text = bench_dataset.dataset_text(result)
    assert "9 images of 48x32" in text and "a manifest of 700 rows" in text
    for row in result["rows"]:
        assert any(line.startswith(row["what"]) for line in text.splitlines())
