"""The figures of `climategs bench trade` as text for a terminal, and as Markdown for a document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tools.machine import machine_line
from tools.tables import aligned, markdown
from tools.trade_cases import JPEG, WHOLE, knob_order
from tools.trade_measure import Row

COLUMNS = (
    "knob", "value", "ms", "x reference", "x clean", "FLIP", "worst", "PSNR", "SSIM",
    "depth off", "abs-rel", "flicker", "MiB", "kept",
)  # fmt: skip
JPEG_COLUMNS = ("quality", "ms", "kB", "FLIP", "worst", "PSNR", "SSIM")


def trade_text(figures: Mapping[str, Any]) -> str:
    """Every recipe's table, in columns."""
    lines = [machine_line(figures), views_line(figures)]
    for entry in figures["recipes"]:
        knobs, files = _parted(entry["rows"])
        lines += ["", f"{entry['recipe']}:"]
        lines += aligned([COLUMNS, *map(cells, knobs)])
        if files:
            lines += ["", *aligned([JPEG_COLUMNS, *map(jpeg_cells, files)])]
    return "\n".join(lines)


def trade_markdown(figures: Mapping[str, Any]) -> str:
    """The same as a page."""
    lines = [f"# The trade on {figures['scene']}", "", f"{machine_line(figures)}.", ""]
    lines += [f"{views_line(figures)}. What the columns mean: [trade.md](../trade.md).", ""]
    for entry in figures["recipes"]:
        knobs, files = _parted(entry["rows"])
        lines += [f"## {entry['recipe']}", "", *markdown(COLUMNS, map(cells, knobs)), ""]
        if files:
            lines += ["Files:", "", *markdown(JPEG_COLUMNS, map(jpeg_cells, files)), ""]
    return "\n".join(lines).rstrip() + "\n"


def views_line(figures: Mapping[str, Any]) -> str:
    views = [
        f"{v['camera']} of frame {v['frame']} ({v['width']}x{v['height']})"
        for v in figures["views"]
    ]
    return (
        f"{figures['scene']}, {figures['gaussians']:,} Gaussians; {', '.join(views)}; "
        f"{figures['repeats']} timed frames of each view and setting"
    )


def cells(row: Row) -> tuple[str, ...]:
    return (
        row["knob"].removeprefix("weather."),
        value_text(row["value"]),
        f"{row['ms']:.0f} ({row['ms_min']:.0f}-{row['ms_p90']:.0f})",
        number(row["over_reference"], ".2f"),
        number(row["over_clean"], ".2f"),
        number(row["flip"], ".4f"),
        number(row["worst_flip"], ".4f"),
        _psnr(row),
        number(row["ssim"], ".4f"),
        percent(row["off_5cm"]),
        percent(row["abs_rel"]),
        number(row["flicker"], ".4f"),
        number(row.get("mib"), ".0f"),
        number(row.get("kept_mib"), ".0f"),
    )


def jpeg_cells(row: Row) -> tuple[str, ...]:
    return (
        value_text(row["value"]),
        number(row["ms"], ".1f"),
        number(row["kilobytes"], ".0f"),
        number(row["flip"], ".4f"),
        number(row["worst_flip"], ".4f"),
        _psnr(row),
        number(row["ssim"], ".4f"),
    )


def value_text(value: Any) -> str:
    return "all" if value is None else str(value)


def number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f} %"


def _parted(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Rows of rendering, wholes first, then in the order of the table of knobs; rows of files."""
    order = knob_order()
    rendered = [row for row in rows if row["knob"] != JPEG]
    rendered.sort(key=lambda row: -1 if row["knob"] == WHOLE else order[row["knob"]])
    return rendered, [row for row in rows if row["knob"] == JPEG]


def _psnr(row: Row) -> str:
    return "same" if row["psnr"] is None else f"{row['psnr']:.1f}"
