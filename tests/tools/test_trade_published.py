"""What is published of the trade agrees with itself: tables, tiers, document."""

import pytest

from recipes.schema import TIERS
from tools.trade_docs import DOCS, PAGE, SCENES, START, document, read_tables
from tools.trade_tiers import INVISIBLE_FLIP, invisible_evidence, tiers_from

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


def test_a_document_without_markers_is_refused(tables):
    with pytest.raises(ValueError, match="end of machine"):
        document("nothing", tables)
    assert START.format(name="tiers") in PAGE.read_text()
