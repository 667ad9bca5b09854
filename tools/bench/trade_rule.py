"""The tiers of `quality`, by a rule, from the figures of docs/trade/*.json; and what shows them.

1. Of each knob the values that save time: those faster than every more accurate one by at least
   MIN_SAVED of the reference's time. A value's time is the geometric mean of its ratios to the
   reference, over all recipes and scenes in which it changes the picture.
2. Knob after knob, that which saves most first, takes the fastest of them with which the worst FLIP
   of all that are chosen so far, rendered together, is within the bound: over all recipes, scenes
   and views (augment.jobs.quality.within_flip).

    python -m tools.bench.trade_rule [TABLE.json=SCENE_URI ...]

renders what step 2 asks for and the tables lack, adds it to them, then the tiers themselves, in
place of rows of earlier ones, with TABLE_tiers.jpg beside; and makes docs/trade.md's tables anew.
"""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from augment.errors import ClimateGSError
from augment.jobs.quality import Cost, Settings, useful, within_flip
from recipes.schema import BY_PATH, KNOBS, TIERS, Knob, Value
from tools.bench.harness import machine_line, replace_marked
from tools.bench.trade import (
    DEFAULTS,
    DEPTH,
    JPEG,
    REFERENCE,
    WHOLE,
    Row,
    Trade,
    TradeCase,
    bench_trade,
    table_of,
    views_line,
)
from tools.drawing import captioned, strip, write_jpeg

# What a viewer takes for the same picture: on every published scene under every recipe it is below
# the FLIP of a JPEG at quality 92, which is what people who look at pictures take for lossless.
INVISIBLE_FLIP, INVISIBLE_QUALITY = 0.02, 92
# What differs plainly and shows the same: reconstructions differ as much from the recordings that
# they are made of (docs/reconstruction.md: 0.05 to 0.11 on held-out views).
DRAFT_FLIP = 0.10
BOUNDS = {"draft": DRAFT_FLIP, "balanced": INVISIBLE_FLIP}

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = DOCS / "trade.md"
SCENES = {"street": "street", "pandaset": "PandaSet 002"}
START = "<!-- {name}: made by python -m tools.bench.trade_rule -->"
END = "<!-- end of {name} -->"
CROP_PX, CROP_AT = 300, (0.5, 0.56)  # height, and middle within the picture, of what is shown
Tables = Sequence[Mapping[str, Any]]


class Unmeasured(Exception):
    """Settings that the rule has to know the error of, and no row has."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(f"not measured together: {settings}")
        self.settings = settings


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
    rows = _all_rows(tables)
    costs = {knob.path: knob_costs(rows, knob) for knob in KNOBS if knob.chosen}
    # From the fastest to reference, as within_flip takes them.
    ladders = {path: useful(each)[::-1] for path, each in costs.items()}
    flips = {path: {cost.value: cost.flip for cost in each} for path, each in costs.items()}

    def least_ms(path: str) -> float:
        """Of the values that are within the bound alone."""
        return min(cost.ms for cost in ladders[path] if cost.flip <= bound)

    chosen = within_flip(
        {path: [cost.value for cost in ladders[path]] for path in sorted(ladders, key=least_ms)},
        bound,
        lambda path, value: flips[path][value],
        lambda settings: whole_flip(rows, settings) > bound,
    )
    return {path: value for path, value in chosen.items() if value != BY_PATH[path].reference}


def knob_costs(rows: Sequence[Row], knob: Knob) -> list[Cost]:
    """Of its values, fast to accurate. ms: here per cent of the reference's time. flip: the worst.

    Values that no table has, and those that change no picture, are left out: of the latter a time
    would be noise.
    """
    costs = []
    for value in knob.values[:-1]:
        own = [row for row in _of_value(rows, knob, value) if row["worst_flip"] > 0]
        if own:
            worst = max(row["worst_flip"] for row in own)
            costs.append(Cost(value, 100 * _mean_ratio(own), worst))
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


def _is_of(row: Row, settings: Settings) -> bool:
    given = row.get("settings")
    return (
        row["knob"] == WHOLE
        and given is not None
        and all(settings.get(path, value) == value for path, value in given.items())
    )


def _all_rows(tables: Tables) -> list[Row]:
    return [row for table in tables for row in table_of(table)]


def _of_value(rows: Sequence[Row], knob: Knob, value: Value) -> list[Row]:
    return [row for row in rows if (row["knob"], row["value"]) == (knob.path, value)]


def _mean_ratio(rows: Sequence[Row]) -> float:
    return math.exp(sum(math.log(row["over_reference"]) for row in rows) / len(rows))


# ---- measuring what the rule asks for -----------------------------------------------------------


def settle(
    tables: Sequence[dict[str, Any]], uris: Sequence[str], case: TradeCase
) -> dict[str, dict[str, Value]]:
    """The tiers; what the rule has to know and the tables lack is rendered and added to them."""
    while True:
        try:
            return tiers_from(tables)
        except Unmeasured as missing:
            for table, uri in zip(tables, uris, strict=True):
                rows = table_of(table)
                tried = {r["value"] for r in rows if str(r["value"]).startswith("candidate")}
                measure_wholes(table, uri, {f"candidate {len(tried) + 1}": missing.settings}, case)


def measure_wholes(
    table: dict[str, Any], uri: str, wholes: Mapping[str, Mapping[str, Value]], case: TradeCase
) -> Trade:
    """Render settings on the table's scene and put their rows in place of those of their names."""
    names = [entry["recipe"] for entry in table["recipes"]]
    trade = bench_trade(uri, names, case, wholes=wholes)
    for entry, new in zip(table["recipes"], trade.figures["recipes"], strict=True):
        kept = [row for row in entry["rows"] if row["knob"] != WHOLE or row["value"] not in wholes]
        entry["rows"] = kept + [row for row in new["rows"] if row["value"] in wholes]
    return trade


def invisible_evidence(tables: Tables) -> list[float]:
    """Mean FLIP of JPEGs of INVISIBLE_QUALITY against PNG, by scene and recipe."""
    rows = _of_value(_all_rows(tables), BY_PATH[JPEG], INVISIBLE_QUALITY)
    return [row["flip"] for row in rows]


# ---- docs/trade.md ------------------------------------------------------------------------------


def read_tables(folder: Path = DOCS / "trade") -> list[dict[str, Any]]:
    """The kept figures of SCENES, under the names that people know them by."""
    files = {title: folder / f"{name}.json" for name, title in SCENES.items()}
    return [{**json.loads(path.read_text()), "scene": title} for title, path in files.items()]


def document(text: str, tables: Tables) -> str:
    """The document with its tables made anew.

    Raises:
        ValueError: it lacks a marker.
    """
    sections = {
        "machine": [f"- {machine_line(t)}; {views_line(t)}." for t in tables],
        "tiers": _tier_lines(),
        "wholes": _whole_lines(tables),
        "knobs": _knob_lines(tables),
    }
    for name, lines in sections.items():
        start, end = START.format(name=name), END.format(name=name)
        text = replace_marked(text, start, end, "\n".join(lines))
    return text


def _tier_lines() -> list[str]:
    rows = []
    for knob in (knob for knob in KNOBS if knob.chosen):
        values = [TIERS[name].get(knob.path, knob.reference) for name in BOUNDS]
        rows.append([f"`{knob.path}`", knob.what, *map(_text, [*values, knob.reference])])
    return _lines(["knob", "what it is", *BOUNDS, REFERENCE], rows)


def _whole_lines(tables: Tables) -> list[str]:
    """Settings as a whole, a row a recipe: time over the reference's, and the worst view's FLIP."""
    settings, rows = (DEFAULTS, *BOUNDS), []
    for table in tables:
        found = {(r["recipe"], r["value"]): r for r in table_of(table) if r["knob"] == WHOLE}
        for recipe in dict.fromkeys(recipe for recipe, _ in found):
            of = [found[recipe, name] for name in settings]
            cells = [f"{row['over_reference']:.2f}, {row['worst_flip']:.3f}" for row in of]
            ms = f"{found[recipe, REFERENCE]['ms']:.0f}"
            rows.append([table["scene"], recipe, ms, *cells])
    header = ["scene", "recipe", "reference ms", *(f"{name}: x, FLIP" for name in settings)]
    return _lines(header, rows)


def _knob_lines(tables: Tables) -> list[str]:
    """Over all recipes that a knob has an effect on: mean ratio of times and the worst errors."""
    each, rows = ("x reference", "worst FLIP", "depth off"), []
    for knob in (knob for knob in KNOBS if knob.path != JPEG):
        for value in knob.values if knob.path == DEPTH else knob.values[:-1]:
            of = [_of_value(table_of(table), knob, value) for table in tables]
            cells = [cell for own in of for cell in _knob_cells(own)]
            rows.append([f"`{knob.path}`", _text(value), *cells])
    return _lines(
        ["knob", "value", *(f"{t['scene']}: {name}" for t in tables for name in each)], rows
    )


def _knob_cells(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return ["-", "-", "-"]
    ratios = [row["over_reference"] for row in rows]
    off = max((row["off_5cm"] for row in rows if row["off_5cm"] is not None), default=None)
    return [
        f"{_mean_ratio(rows):.2f} ({min(ratios):.2f}-{max(ratios):.2f})",
        f"{max(row['worst_flip'] for row in rows):.3f}",
        "-" if off is None else f"{100 * off:.2f} %",
    ]


def _lines(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Of a Markdown table; all columns but the first two to the right."""
    marks = ["---", "---", *["---:"] * (len(header) - 2)]
    return [f"| {' | '.join(line)} |" for line in (header, marks, *rows)]


def _text(value: Value) -> str:
    return "all" if value is None else str(value)


# ---- pictures -----------------------------------------------------------------------------------


def draw_trade(
    folder: Path, figures: Mapping[str, Any], pictures: Mapping[str, Mapping[str, np.ndarray]]
) -> list[Path]:
    """trade_<scene>.png, FLIP against time by recipe, and trade_<scene>_tiers.jpg.

    Raises:
        ClimateGSError: matplotlib is not installed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name = "".join(c if c.isalnum() else "_" for c in figures["scene"])
    chart, tiers = folder / f"trade_{name}.png", folder / f"trade_{name}_tiers.jpg"
    draw_chart(chart, figures)
    whole = {r: shown for r, shown in pictures.items() if {REFERENCE, *BOUNDS} <= shown.keys()}
    if not whole:
        return [chart]
    draw_tiers(tiers, whole, figures)
    return [chart, tiers]


def draw_chart(path: Path, figures: Mapping[str, Any]) -> None:
    """A panel for each recipe: a line a knob, from its values to the reference; settings as a
    whole; and the Pareto front of them all.
    """
    check_matplotlib()
    from matplotlib.figure import Figure

    recipes = figures["recipes"]
    lines = -(-len(recipes) // 2)
    figure = Figure(figsize=(13, 4.6 * lines), layout="constrained")
    for number, entry in enumerate(recipes, 1):
        axes = figure.add_subplot(lines, min(2, len(recipes)), number, title=entry["recipe"])
        points: dict[str, list[tuple[float, float]]] = {}
        for row in entry["rows"]:
            if row["knob"] not in (DEPTH, JPEG) and not str(row["value"]).startswith("candidate"):
                name = (
                    row["value"] if row["knob"] == WHOLE else row["knob"].removeprefix("weather.")
                )
                points.setdefault(name, []).append((row["over_reference"], row["flip"]))
        front = pareto([point for own in points.values() for point in own])
        axes.step(*zip(*front, strict=True), where="post", color="#999999", linewidth=3)
        for name, own in points.items():
            is_whole = name in (REFERENCE, DEFAULTS, *BOUNDS)
            shown = own if is_whole else [*own, (1.0, 0.0)]
            axes.plot(*zip(*shown, strict=True), marker="D" if is_whole else ".", label=name)
        axes.set_yscale("symlog", linthresh=1e-3)  # 0 is on it
        axes.set_xlim(left=0)
        axes.set_xlabel("time over the reference's")
        axes.set_ylabel("mean FLIP against the reference")
        axes.legend(fontsize="x-small")
    figure.savefig(path, metadata={"Software": None})


def check_matplotlib() -> None:
    """Raises ClimateGSError where it is not installed, which takes no minutes to find out."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ClimateGSError("the trade's chart needs matplotlib: pip install 'climategs[plots]'")


def pareto(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points (time, error) that none beats in both, by time."""
    front: list[tuple[float, float]] = []
    for point in sorted(points):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


def draw_tiers(
    path: Path, pictures: Mapping[str, Mapping[str, np.ndarray]], figures: Mapping[str, Any]
) -> None:
    """A row a recipe: the same part of the reference and the tiers, with their time and error."""
    lines = []
    for entry in (entry for entry in figures["recipes"] if entry["recipe"] in pictures):
        whole = {row["value"]: row for row in entry["rows"] if row["knob"] == WHOLE}
        panels = []
        for name in (REFERENCE, *list(BOUNDS)[::-1]):
            error = "" if name == REFERENCE else f", FLIP {whole[name]['flip']:.4f}"
            shown = cropped(pictures[entry["recipe"]][name])
            title = f"{entry['recipe']}, {name}"
            panels.append(captioned(shown, title, f"{whole[name]['ms']:.0f} ms{error}"))
        lines.append(strip(panels))
    write_jpeg(path, np.concatenate(lines))


def cropped(picture: np.ndarray) -> np.ndarray:
    """A window of half the picture's height about CROP_AT, CROP_PX high; pixels are not smoothed,
    for they are what is compared.
    """
    height, width = picture.shape[:2]
    tall, wide = height // 2, min(width, height * 2 // 3)
    top = min(max(0, round(CROP_AT[1] * height - tall / 2)), height - tall)
    left = min(max(0, round(CROP_AT[0] * width - wide / 2)), width - wide)
    part = picture[top : top + tall, left : left + wide]
    size = (round(CROP_PX * wide / tall), CROP_PX)
    return cv2.resize(part, size, interpolation=cv2.INTER_NEAREST)


def main(arguments: Sequence[str]) -> None:
    """[TABLE.json=SCENE_URI ...]: see the module."""
    pairs = [argument.partition("=") for argument in arguments]
    if not all(uri for _, _, uri in pairs):
        raise SystemExit("usage: python -m tools.bench.trade_rule [TABLE.json=SCENE_URI ...]")
    paths, uris = [Path(path) for path, _, _ in pairs], [uri for _, _, uri in pairs]
    tables = [json.loads(path.read_text()) for path in paths]
    if tables:
        width = max(view["width"] for view in tables[0]["views"])
        case = TradeCase(width=width, repeats=tables[0]["repeats"])
        tiers = settle(tables, uris, case)
        for path, uri, table in zip(paths, uris, tables, strict=True):
            trade = measure_wholes(table, uri, tiers, case)
            draw_tiers(path.with_name(f"{path.stem}_tiers.jpg"), trade.pictures, trade.figures)
            path.write_text(json.dumps(table, indent=1) + "\n")
        for name, settings in tiers.items():
            print(f"{name}: {settings}")
    PAGE.write_text(document(PAGE.read_text(), read_tables()))


if __name__ == "__main__":
    main(sys.argv[1:])
