"""`climategs score`: what it prints and writes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.augment.suite_folders import SuiteFolder, write_coco, write_suite
from tools.cli import main

pytest.importorskip("pycocotools")


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> SuiteFolder:
    return write_suite(tmp_path_factory.mktemp("suite") / "out")


@pytest.fixture(scope="module")
def predictions(suite, tmp_path_factory) -> Path:
    return write_coco(tmp_path_factory.mktemp("predictions"), suite)


def test_score_prints_a_table_and_writes_page_and_json(suite, predictions, tmp_path, capsys):
    html = tmp_path / "page.html"
    facts = tmp_path / "scores.json"
    assert main([
        "score", str(suite.path), "--predictions", str(predictions),
        "--baseline", str(predictions), "--html", str(html), "--json", str(facts),
    ]) == 0  # fmt: skip
    printed = capsys.readouterr().out
    assert re.search(r"fog +0\.\d{4}  0\.\d{4}  0\.\d{4}  0\.\d{4}  0\.\d{4}  RR 0\.\d", printed)
    assert "mCE 1.000  mRRA +0.000" in printed
    assert "V50 150 m" in printed
    page = html.read_text()
    assert page.count("<polyline") == 2  # the metric and recall
    assert page.count("data:image/jpeg") == 4  # two worst images, each with its clean render
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert "Recall has halved at <b>150 m</b>" in page
    scores = json.loads(facts.read_text())
    assert scores["robustness"]["mce"] == 1.0
    assert scores["suite"] == "weather-c-v1"
    main(["score", str(suite.path), "--predictions", str(predictions), "--baseline", str(facts),
          "--html", str(html)])  # fmt: skip
    assert "mCE 1.000" in capsys.readouterr().out
    page_again = html.read_text()
    main(["score", str(suite.path), "--predictions", str(predictions), "--baseline", str(facts),
          "--html", str(html)])  # fmt: skip
    assert html.read_text() == page_again


def test_names_in_a_suite_are_escaped_on_the_page(tmp_path):
    suite = write_suite(tmp_path / "out", name="<script>alert(1)</script>")
    predictions = write_coco(tmp_path / "p", suite)
    assert main(["score", str(suite.path), "--predictions", str(predictions)]) == 0
    page = (predictions / "score.html").read_text()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


def test_truth_is_written_for_every_variant(suite, tmp_path, capsys):
    assert (
        main(["score", str(suite.path), "--truth", str(tmp_path), "--categories", "Thing=*"]) == 0
    )
    assert "18 objects that count; categories Thing" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        f"{variant}.json" for variant in suite.variants
    )


def test_refusals_are_errors_with_exit_code_2(suite, predictions, tmp_path, capsys):
    cases = (
        (["--predictions", str(tmp_path / "none")], "is no folder"),
        (["--predictions", str(predictions), "--categories", "Car"], "write NAME=LABEL"),
        (["--predictions", str(predictions), "--effects", "hail"], "its effects are fog"),
    )
    for options, message in cases:
        assert main(["score", str(suite.path), *options]) == 2
        assert message in capsys.readouterr().err
