"""Histories of trainings as pictures: curves over the steps, drawn by matplotlib (an extra)."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from augment.jobs.atomic import write_atomic
from tools.output import print_note

_BLUE, _ORANGE, _GREEN = "#0072b2", "#d55e00", "#009e73"
Row = Mapping[str, Any]


class Line(NamedTuple):
    """A number of the history's rows, those of a split (test, train) alone where one is named."""

    key: str
    label: str = ""
    color: str = _BLUE
    split: str | None = None
    is_marked: bool = False


class Panel(NamedTuple):
    """last: how a line's last value is written in the legend."""

    title: str
    lines: tuple[Line, ...]
    log: bool = False
    from_zero: bool = False
    last: str = "{:.4g}"


def _by_split(key: str) -> tuple[Line, Line]:
    return (
        Line(key, "held-out views", _ORANGE, "test", True),
        Line(key, "training views", _BLUE, "train", True),
    )


FIT_PANELS = (
    Panel("loss, mean of 50 steps (log scale)", (Line("loss"),), log=True),
    Panel("PSNR, dB", _by_split("psnr"), last="{:.2f}"),
    Panel(
        "median depth error, m (log scale)", _by_split("depth_median_m"), log=True, last="{:.2g}"
    ),
    Panel("Gaussians", (Line("splats", color=_GREEN),), from_zero=True),
)
_TERMS = (
    Line("cycle", "cycle", _BLUE),
    Line("consistency", "consistency", _ORANGE),
    Line("style", "style", _GREEN),
)
STYLE_PANELS = (
    Panel("losses (log scale)", _TERMS, log=True),
    Panel("loss: weighted sum, mean of some steps", (Line("loss"),)),
    Panel("loss of pairs: logarithms of errors", (Line("pairs"),)),
    Panel("restored after content space, PSNR, dB", (Line("restoration_psnr", is_marked=True),)),
    Panel(
        "content space: RMSE of Z_s, in deviations of Z_c (log scale)",
        (Line("content_rmse", is_marked=True),),
        log=True,
    ),
)


def write_curves(path: Path, history: Sequence[Row], panels: Sequence[Panel]) -> bool:
    """A PNG with a panel for each quantity that the history knows. False, and a note on stderr,
    where matplotlib is not installed; False where nothing is known.

    history: rows {"step", "seconds", ...}. Values that are no number are left out.

    Raises:
        OutputError: the file cannot be written.
    """
    known = [(p, {line: points for line in p.lines if (points := _points(history, line))})
             for p in panels]  # fmt: skip
    known = [(panel, lines) for panel, lines in known if lines]
    if not known:
        return False
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print_note(
            f"note: {path.name} is not drawn, for which matplotlib is missing: "
            f"`pip install 'climategs[plots]'`. The report holds the same numbers as `history`"
        )
        return False
    columns = min(2, len(known))
    rows = -(-len(known) // columns)
    figure = Figure(figsize=(7.2 * columns, 4.4 * rows), layout="constrained")
    clock = sorted({(float(r["step"]), float(r["seconds"])) for r in history if "seconds" in r})
    last_step = max(step for _, lines in known for points in lines.values() for step, _ in points)
    for number, (panel, lines) in enumerate(known, 1):
        axes = figure.add_subplot(rows, columns, number)
        _draw_panel(axes, panel, lines, max(last_step, 1.0), clock)
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    write_atomic(path, data.getvalue())
    return True


def _points(history: Sequence[Row], line: Line) -> list[tuple[float, float]]:
    """(step, value), in order of steps."""
    return [
        (float(row["step"]), float(value))
        for row in history
        if isinstance(value := row.get(line.key), int | float)
        and math.isfinite(value)
        and row.get("split") == line.split
    ]


def _draw_panel(
    axes: Any,
    panel: Panel,
    lines: Mapping[Line, Sequence[tuple[float, float]]],
    last_step: float,
    clock: Sequence[tuple[float, float]],
) -> None:
    axes.set_title(panel.title, loc="left")
    axes.set_xlabel("steps")
    axes.set_xlim(0, last_step)
    axes.grid(color="#e1e1e1")
    positive = [value for points in lines.values() for _, value in points if value > 0]
    lowest = min(positive, default=1.0) / 1.15
    if panel.log:
        axes.set_yscale("log")
    for line, points in lines.items():
        steps, values = zip(*points, strict=True)
        drawn = [max(value, lowest) for value in values] if panel.log else values
        marker = "o" if line.is_marked or len(points) == 1 else ""
        label = f"{line.label}: {panel.last.format(values[-1])}" if line.label else None
        axes.plot(steps, drawn, color=line.color, marker=marker, markersize=4, label=label)
    if panel.from_zero:
        axes.set_ylim(bottom=0)
    if any(line.label for line in lines):
        axes.legend(fontsize="small")
    _draw_clock(axes, clock)


def _draw_clock(axes: Any, clock: Sequence[tuple[float, float]]) -> None:
    """Above the axes, the time at which steps were reached."""
    from matplotlib.ticker import MaxNLocator

    at, seconds = np.array(clock).reshape(-1, 2).T
    if len(clock) < 2 or seconds[-1] <= seconds[0]:
        return
    unit, name = (60.0, "min") if seconds[-1] >= 180 else (1.0, "s")
    # From the first row on: what was spent before it is compiling and opening, not steps.
    first, last = seconds[0] / unit, seconds[-1] / unit
    ticks = [t for t in MaxNLocator(6).tick_values(first, last) if first <= t <= last]
    above = axes.secondary_xaxis("top")
    steps = np.interp([t * unit for t in ticks], np.maximum.accumulate(seconds), at)
    above.set_xticks(steps, [f"{t:g} {name}" for t in ticks], fontsize="small")
