"""docs/trade.md's tables, from the kept figures of docs/trade/*.json.

`python -m tools.trade_docs` rewrites what lies between the document's markers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from recipes.schema import KNOBS, TIERS, Knob, Value
from tools.bench_trade import table_of
from tools.machine import machine_line
from tools.tables import markdown
from tools.trade_cases import DEFAULTS, DEPTH, JPEG, REFERENCE, WHOLE
from tools.trade_measure import Row
from tools.trade_text import number, percent, value_text, views_line
from tools.trade_tiers import BOUNDS

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = DOCS / "trade.md"
SCENES = {"street": "street", "pandaset": "PandaSet 002"}
START, END = "<!-- {name}: made by python -m tools.trade_docs -->", "<!-- end of {name} -->"


def read_tables(folder: Path = DOCS / "trade") -> list[dict[str, Any]]:
    """The kept figures of SCENES, under the names that people know them by."""
    files = {said: folder / f"{name}.json" for name, said in SCENES.items()}
    return [{**json.loads(path.read_text()), "scene": said} for said, path in files.items()]


def document(text: str, tables: Sequence[Mapping[str, Any]]) -> str:
    """The document with its tables made anew.

    Raises:
        ValueError: it lacks a marker.
    """
    for name, lines in _sections(tables).items():
        start, end = START.format(name=name), END.format(name=name)
        before, found, rest = text.partition(start)
        _, closed, after = rest.partition(end)
        if not (found and closed):
            raise ValueError(f"the document has no '{start}' with '{end}' after it")
        text = "\n".join([before + start, "", *lines, "", end]) + after
    return text


def _sections(tables: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    return {
        "machine": [f"- {machine_line(t)}; {views_line(t)}." for t in tables],
        "tiers": list(_tier_table()),
        "wholes": list(_whole_table(tables)),
        "knobs": list(_knob_table(tables)),
    }


def _tier_table() -> Iterator[str]:
    rows = []
    for knob in KNOBS:
        if knob.chosen:
            set_to = [TIERS[name].get(knob.path, knob.reference) for name in BOUNDS]
            values = (*set_to, knob.reference)
            rows.append((f"`{knob.path}`", knob.what, *map(value_text, values)))
    yield from markdown(("knob", "what it is", *BOUNDS, REFERENCE), rows)


def _whole_table(tables: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Settings as a whole, a row a recipe: time over the reference's, and the worst view's FLIP."""
    settings = (DEFAULTS, *BOUNDS)
    header = ("scene", "recipe", "reference ms", *(f"{name}: x, FLIP" for name in settings))
    rows = []
    for table in tables:
        found = {(r["recipe"], r["value"]): r for r in table_of(table) if r["knob"] == WHOLE}
        for recipe in dict.fromkeys(recipe for recipe, _ in found):
            cells = [
                f"{number(row['over_reference'], '.2f')}, {number(row['worst_flip'], '.3f')}"
                for row in (found[recipe, name] for name in settings)
            ]
            milliseconds = number(found[recipe, REFERENCE]["ms"], ".0f")
            rows.append((table["scene"], recipe, milliseconds, *cells))
    yield from markdown(header, rows)


def _knob_table(tables: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Over all recipes that a knob has an effect on: mean ratio of times and the worst errors."""
    each = ("x reference", "worst FLIP", "depth off")
    header = ("knob", "value", *(f"{t['scene']}: {name}" for t in tables for name in each))
    rows = []
    for knob in KNOBS:
        if knob.path == JPEG:
            continue
        for value in knob.values if knob.path == DEPTH else knob.values[:-1]:
            cells = [cell for table in tables for cell in _knob_cells(table, knob, value)]
            rows.append((f"`{knob.path}`", value_text(value), *cells))
    yield from markdown(header, rows)


def _knob_cells(table: Mapping[str, Any], knob: Knob, value: Value) -> tuple[str, str, str]:
    rows = [r for r in table_of(table) if r["knob"] == knob.path and r["value"] == value]
    if not rows:
        return "-", "-", "-"
    ratios = [row["over_reference"] for row in rows]
    mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
    return (
        f"{mean:.2f} ({min(ratios):.2f}-{max(ratios):.2f})",
        number(max(row["worst_flip"] for row in rows), ".3f"),
        percent(_most(rows, "off_5cm")),
    )


def _most(rows: Sequence[Row], name: str) -> float | None:
    known = [row[name] for row in rows if row[name] is not None]
    return max(known, default=None)


def main() -> None:
    PAGE.write_text(document(PAGE.read_text(), read_tables()))


if __name__ == "__main__":
    main()
