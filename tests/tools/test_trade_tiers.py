"""The rule that makes tiers of tables; the package's tiers, tables and document agree with it."""

import pytest

from recipes.schema import KNOBS, TIERS
from tools.bench.trade import (
    DOCS,
    INVISIBLE_FLIP,
    PAGE,
    SCENES,
    WHOLE,
    Unmeasured,
    document,
    draw_chart,
    invisible_evidence,
    measure_wholes,
    read_tables,
    settle,
    tier_from,
    tiers_from,
)

STOP, CLIP, FRESNEL = "render.transmittance_stop", "render.radius_clip_px", "weather.flood.fresnel"


def row(knob, value, over_reference, worst_flip, settings=None):
    found = {
        "knob": knob,
        "value": value,
        "over_reference": over_reference,
        "flip": worst_flip / 2,
        "worst_flip": worst_flip,
    }
    return found if settings is None else {**found, "settings": settings}


def table(**recipes):
    entries = [{"recipe": name, "rows": rows} for name, rows in recipes.items()]
    return {"scene": "made up", "recipes": entries}


def whole(worst_flip, **settings):
    """Of STOP and CLIP."""
    given = {STOP: settings.get("stop", 1e-4), CLIP: settings.get("clip", 0.0)}
    return row(WHOLE, "some name", 0.5, worst_flip, given)


SINGLE = [
    row(STOP, 0.05, 0.80, 0.03),
    row(STOP, 0.01, 0.90, 0.01),
    row(STOP, 1e-3, 0.95, 0.001),
    row(CLIP, 2.0, 0.70, 0.04),
    row(CLIP, 1.0, 0.85, 0.015),
]


def test_the_fastest_value_within_the_bound():
    rows = [*SINGLE, whole(0.018, stop=0.01, clip=1.0)]
    assert tier_from([table(clean=rows)], 0.02) == {STOP: 0.01, CLIP: 1.0}


def test_the_worst_recipe_counts():
    good, bad = [*SINGLE], [*SINGLE, row(STOP, 0.01, 0.90, 0.05)]
    rest = whole(0.018, stop=1e-3, clip=1.0)
    assert tier_from([table(clean=[*good, rest], snow=[*bad, rest])], 0.02) == {
        STOP: 1e-3,
        CLIP: 1.0,
    }


def test_the_knob_that_saves_most_comes_first_and_the_others_fit_beside_it():
    beyond = [whole(0.03, stop=0.01, clip=1.0), whole(0.019, stop=1e-3, clip=1.0)]
    assert tier_from([table(clean=[*SINGLE, *beyond])], 0.02) == {STOP: 1e-3, CLIP: 1.0}
    beyond = [whole(0.03, stop=0.01, clip=1.0), whole(0.021, stop=1e-3, clip=1.0)]
    assert tier_from([table(clean=[*SINGLE, *beyond])], 0.02) == {CLIP: 1.0}


def test_a_knob_alone_needs_no_rendering_together():
    """The snow's recipe has one knob that differs, and one that is not its own."""
    snow = [row for row in SINGLE if row["knob"] == STOP]
    rows = [*SINGLE, whole(0.018, stop=0.01, clip=1.0)]
    assert tier_from([table(clean=rows, snow=snow)], 0.02) == {STOP: 0.01, CLIP: 1.0}


def test_times_of_values_that_change_nothing_are_noise():
    noise = [row(STOP, 0.05, 0.5, 0.0), row(CLIP, 2.0, 0.5, 0.0)]
    alone = [row(STOP, 0.05, 0.5, 0.0), row(CLIP, 2.0, 1.0, 0.01)]
    assert tier_from([table(clean=noise, snow=alone)], 0.02) == {}


def test_what_has_not_been_rendered_together_is_asked_for():
    with pytest.raises(Unmeasured) as asked:
        tier_from([table(clean=SINGLE)], 0.02)
    assert {k: v for k, v in asked.value.settings.items() if v != KNOBS[k].reference} == {
        STOP: 0.01,
        CLIP: 1.0,
    }


def test_a_value_that_saves_nothing_is_never_taken():
    rows = [row(STOP, 0.05, 1.02, 0.001), row(STOP, 0.01, 0.99, 0.001), row(CLIP, 2.0, 0.5, 0.01)]
    rows.append(whole(0.01, clip=2.0))
    assert tier_from([table(clean=rows)], 0.02) == {CLIP: 2.0}


def test_a_slower_value_that_errs_more_is_passed_over():
    rows = [row(STOP, 0.05, 0.9, 0.015), row(STOP, 0.01, 0.8, 0.01), whole(0.01, stop=0.01)]
    assert tier_from([table(clean=rows)], 0.02) == {STOP: 0.01}


def test_settling_adds_what_the_rule_asks_for(monkeypatch):
    made_up = table(clean=[*SINGLE])
    asked = []

    def measured(uri, names, case, *, wholes):
        (name,) = wholes
        asked.append((uri, names, dict(wholes[name])))
        given = {path: wholes[name][path] for path in (STOP, CLIP)}
        rows = [row(WHOLE, "reference", 1.0, 0.0, {}), row(WHOLE, name, 0.5, 0.005, given)]
        return type("Trade", (), {"figures": table(clean=rows)})

    monkeypatch.setattr("tools.bench.trade.bench_trade", measured)
    tiers = settle([made_up], ["some:scene"], None)
    assert tiers["balanced"] == {STOP: 0.01, CLIP: 1.0}
    assert tiers["draft"] == {STOP: 0.05, CLIP: 2.0}
    names = [r["value"] for r in made_up["recipes"][0]["rows"] if r["knob"] == WHOLE]
    assert names == ["candidate 1", "candidate 2"]
    assert [uri for uri, *_ in asked] == ["some:scene"] * 2


def test_rows_of_tiers_replace_those_of_earlier_ones(monkeypatch):
    old = [row(WHOLE, "reference", 1.0, 0.0, {}), row(WHOLE, "draft", 0.9, 0.3, {}), *SINGLE]
    made_up = table(clean=old)
    new = [row(WHOLE, "reference", 1.0, 0.0, {}), row(WHOLE, "draft", 0.5, 0.1, {CLIP: 2.0})]
    trade = type("Trade", (), {"figures": table(clean=new)})
    monkeypatch.setattr("tools.bench.trade.bench_trade", lambda *_, **__: trade)
    assert measure_wholes(made_up, "some:scene", {"draft": {CLIP: 2.0}}, None) is trade
    assert made_up["recipes"][0]["rows"] == [old[0], *SINGLE, new[1]]


# ---- what is published --------------------------------------------------------------------------

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
