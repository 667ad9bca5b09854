"""What `draft` and `balanced` set, by a rule, from the tables that `climategs bench trade` makes.

1. Of each knob the values that save time: those faster than every more accurate one by at least
   MIN_SAVED of the reference's time. A value's time is the geometric mean of its ratios to the
   reference, over all recipes and scenes in which it changes the picture.
2. Knob after knob, that which saves most first, takes the fastest of them with which the worst FLIP
   of all that are chosen so far, rendered together, is within the bound: over all recipes, scenes
   and views (augment.jobs.quality.within_flip).

    python -m tools.trade_tiers TABLE.json=SCENE_URI ...

renders what step 2 asks for and the tables lack, adds it to them, then the tiers themselves, in
place of rows of earlier ones, and prints what they set. TABLE_tiers.jpg beside a table shows them.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from augment.jobs.quality import Cost, Settings, useful, within_flip
from recipes.schema import BY_PATH, KNOBS, Knob, Value
from tools.bench_trade import Trade, bench_trade, table_of
from tools.drawing import write_jpeg
from tools.trade_cases import JPEG, WHOLE, TradeCase
from tools.trade_measure import Row
from tools.trade_plots import draw_tiers

# What a viewer takes for the same picture: on every published scene under every recipe it is below
# the FLIP of a JPEG at quality 92, which is what people who look at pictures take for lossless.
INVISIBLE_FLIP = 0.02
INVISIBLE_QUALITY = 92
# What differs plainly and shows the same: reconstructions differ as much from the recordings that
# they are made of (docs/reconstruction.md: 0.05 to 0.11 on held-out views).
DRAFT_FLIP = 0.10
BOUNDS = {"draft": DRAFT_FLIP, "balanced": INVISIBLE_FLIP}


class Unmeasured(Exception):
    """Settings that the rule has to know the error of, and no row has."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(f"not measured together: {settings}")
        self.settings = settings


Tables = Sequence[Mapping[str, Any]]


def tiers_from(tables: Tables) -> dict[str, dict[str, Value]]:
    """What each tier sets, by the knobs' paths; knobs at reference are left out.

    Raises:
        Unmeasured: the tables lack settings that have to be rendered together.
    """
    return {name: tier_from(tables, bound) for name, bound in BOUNDS.items()}


def tier_from(tables: Tables, bound: float) -> dict[str, Value]:
    """The rule for one bound.

    Raises:
        Unmeasured: see tiers_from.
    """
    rows = [row for table in tables for row in table_of(table)]
    costs = {knob.path: knob_costs(rows, knob) for knob in KNOBS if knob.chosen}
    # From the fastest to reference, as within_flip takes them.
    ladders = {path: useful(each)[::-1] for path, each in costs.items()}
    flips = {path: {cost.value: cost.flip for cost in each} for path, each in costs.items()}
    by_saving = sorted(ladders, key=lambda path: _least_ms(ladders[path], bound))
    chosen = within_flip(
        {path: [cost.value for cost in ladders[path]] for path in by_saving},
        bound,
        lambda path, value: flips[path][value],
        lambda settings: whole_flip(rows, settings) > bound,
    )
    references = {knob.path: knob.reference for knob in KNOBS}
    return {path: value for path, value in chosen.items() if value != references[path]}


def _least_ms(ladder: Sequence[Cost], bound: float) -> float:
    """Of the values that are within the bound alone."""
    return min(cost.ms for cost in ladder if cost.flip <= bound)


def knob_costs(rows: Sequence[Row], knob: Knob) -> list[Cost]:
    """Of its values, fast to accurate. ms: here per cent of the reference's time. flip: the worst.

    Values that no table has, and those that change no picture, are left out: of the latter a time
    would be noise.
    """
    costs = []
    for value in knob.values[:-1]:
        own = [
            row
            for row in rows
            if row["knob"] == knob.path and row["value"] == value and row["worst_flip"] > 0
        ]
        if own:
            ratio = math.exp(sum(math.log(row["over_reference"]) for row in own) / len(own))
            costs.append(Cost(value, 100 * ratio, max(row["worst_flip"] for row in own)))
    return [*costs, Cost(knob.reference, 100.0, 0.0)]


def whole_flip(rows: Sequence[Row], settings: Settings) -> float:
    """The worst of the rows of these settings together.

    Raises:
        Unmeasured: a recipe has none.
    """
    worst = 0.0
    for recipe in sorted({(row["scene"], row["recipe"]) for row in rows}):
        own = [row for row in rows if (row["scene"], row["recipe"]) == recipe]
        found = [row["worst_flip"] for row in own if _is_of(row, settings)]
        found += _alone(own, settings)
        if not found:
            raise Unmeasured(settings)
        worst = max(worst, *found)
    return worst


def _alone(rows: Sequence[Row], settings: Settings) -> list[float]:
    """The error of settings of which one, or none, differs from reference for a recipe."""
    knobs = {row["knob"] for row in rows}
    moved = {p: v for p, v in settings.items() if p in knobs and v != BY_PATH[p].reference}
    if not moved:
        return [0.0]
    if len(moved) > 1:
        return []
    return [row["worst_flip"] for row in rows if (row["knob"], row["value"]) in moved.items()]


def invisible_evidence(tables: Tables) -> list[float]:
    """Mean FLIP of JPEGs of INVISIBLE_QUALITY against PNG, by scene and recipe."""
    rows = [row for table in tables for row in table_of(table)]
    return [row["flip"] for row in rows if (row["knob"], row["value"]) == (JPEG, INVISIBLE_QUALITY)]


def settle(
    tables: Sequence[dict[str, Any]], uris: Sequence[str], case: TradeCase
) -> dict[str, Any]:
    """The tiers; what the rule has to know and the tables lack is rendered and added to them."""
    while True:
        try:
            return tiers_from(tables)
        except Unmeasured as missing:
            for table, uri in zip(tables, uris, strict=True):
                _measure(table, uri, missing.settings, case)


def _measure(table: dict[str, Any], uri: str, settings: Settings, case: TradeCase) -> None:
    names = [entry["recipe"] for entry in table["recipes"]]
    tried = {row["value"] for row in table_of(table) if str(row["value"]).startswith("candidate")}
    name = f"candidate {len(tried) + 1}"
    added = bench_trade(uri, names, case, wholes={name: settings}).figures
    for entry, new in zip(table["recipes"], added["recipes"], strict=True):
        entry["rows"] += [row for row in new["rows"] if row["value"] == name]


def measure_tiers(
    table: dict[str, Any], uri: str, tiers: Mapping[str, Mapping[str, Value]], case: TradeCase
) -> Trade:
    """Render the tiers on the table's scene and put their rows in place of the table's own."""
    names = [entry["recipe"] for entry in table["recipes"]]
    trade = bench_trade(uri, names, case, wholes=tiers)
    for entry, new in zip(table["recipes"], trade.figures["recipes"], strict=True):
        kept = [row for row in entry["rows"] if row["knob"] != WHOLE or row["value"] not in tiers]
        added = [row for row in new["rows"] if row["knob"] == WHOLE and row["value"] in tiers]
        entry["rows"] = kept + added
    return trade


def _is_of(row: Row, settings: Settings) -> bool:
    given = row.get("settings")
    return (
        row["knob"] == WHOLE
        and given is not None
        and all(settings.get(path, value) == value for path, value in given.items())
    )


def main(arguments: Sequence[str]) -> None:
    """TABLE.json=SCENE_URI ...: see the module."""
    pairs = [argument.partition("=") for argument in arguments]
    if not pairs or not all(uri for _, _, uri in pairs):
        raise SystemExit("usage: python -m tools.trade_tiers TABLE.json=SCENE_URI ...")
    paths, uris = [Path(path) for path, _, _ in pairs], [uri for _, _, uri in pairs]
    tables = [json.loads(path.read_text()) for path in paths]
    width = max(view["width"] for view in tables[0]["views"])
    case = TradeCase(width=width, repeats=tables[0]["repeats"])
    tiers = settle(tables, uris, case)
    for path, uri, table in zip(paths, uris, tables, strict=True):
        trade = measure_tiers(table, uri, tiers, case)
        rows = [draw_tiers(name, drawn, trade.figures) for name, drawn in trade.pictures.items()]
        write_jpeg(path.with_name(f"{path.stem}_tiers.jpg"), np.concatenate(rows))
        path.write_text(json.dumps(table, indent=1) + "\n")
    for name, settings in tiers.items():
        print(f"{name}: {settings}")


if __name__ == "__main__":
    main(sys.argv[1:])
