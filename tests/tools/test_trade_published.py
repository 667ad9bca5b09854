"""What is published of the trade agrees with itself: tables, tiers, document."""

import pytest

from recipes.schema import TIERS
from tools.bench.trade_rule import (
    DOCS,
    INVISIBLE_FLIP,
    PAGE,
    SCENES,
    document,
    draw_chart,
    invisible_evidence,
    pareto,
    read_tables,
    tiers_from,
)

MAX_BYTES = 150_000


@pytest.fixture(scope="module")
def tables():
    return read_tables()


def test_tiers_are_what_the_rule_gives_for_the_published_tables(tables):
    assert {name: dict(settings) for name, settings in TIERS.items()} == tiers_from(tables)


def test_the_invisible_bound_is_below_a_good_jpegs_error(tables):
    evidence = invisible_evidence(tables)
    assert len(evidence) == sum(len(table["recipes"]) for table in tables)
    assert min(evidence) >= INVISIBLE_FLIP


def test_the_document_agrees_with_the_tables(tables):
    assert PAGE.read_text() == document(PAGE.read_text(), tables)
    for name in SCENES:
        assert (DOCS / "trade" / f"{name}.json").stat().st_size < MAX_BYTES


def test_published_figures_make_a_chart(tables, tmp_path):
    pytest.importorskip("matplotlib")
    draw_chart(tmp_path / "chart.png", tables[0])
    assert (tmp_path / "chart.png").stat().st_size > 10_000
    points = [(3.0, 0.0), (1.0, 0.5), (2.0, 0.6), (2.0, 0.2), (4.0, 0.0)]
    assert pareto(points) == [(1.0, 0.5), (2.0, 0.2), (3.0, 0.0)]
