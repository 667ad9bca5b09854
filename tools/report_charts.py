"""Small charts as inline SVG: histograms with the draws beneath them, and bars of shares.

Colours are the page's CSS variables, so that charts follow its light and dark scheme.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tools.report_html import Html, joined, tag
from tools.report_numbers import count, percent, short, with_unit

WIDTH, HEIGHT = 340, 148  # of a histogram, in SVG units; about CSS pixels
_LEFT, _RIGHT, _TOP, _FLOOR = 6, 6, 14, 104
MAX_BINS = 24
LOG_RATIO = 10  # largest over smallest value from which an axis is logarithmic
MAX_MARKS = 300


@dataclass(frozen=True)
class Histogram:
    """Counts of values. edges: [n + 1], increasing. counts: [n]. log: whether edges are spaced
    evenly in the logarithm.
    """

    edges: np.ndarray
    counts: np.ndarray
    log: bool


def histogram(values: np.ndarray, weights: np.ndarray, *, linear: bool = False) -> Histogram:
    """Of finite values [n], two of them unlike, each counted as often as its whole weight says.

    linear: not logarithmic, however far the values are spread.
    """
    low, high = float(values.min()), float(values.max())
    log = not linear and low > 0 and high / low > LOG_RATIO
    bins = int(min(MAX_BINS, max(6, 2 * math.ceil(math.sqrt(len(values))))))
    edges = np.geomspace(low, high, bins + 1) if log else np.linspace(low, high, bins + 1)
    edges[0], edges[-1] = min(edges[0], low), max(edges[-1], high)
    counts, _ = np.histogram(values, edges, weights=weights)
    return Histogram(edges, counts, log)


def histogram_svg(shape: Histogram, unit: str, noun: str, marks: np.ndarray, title: str) -> Html:
    """Bars, an axis of three to five numbers, and a tick for each of `marks` beneath.

    noun: what is counted. marks: [m] values, drawn as far as MAX_MARKS of them, evenly chosen.
    """
    edges = np.log(shape.edges) if shape.log else shape.edges
    span = float(edges[-1] - edges[0]) or 1.0

    def x_of(value: float) -> float:
        place = math.log(value) if shape.log else value
        return _LEFT + (WIDTH - _LEFT - _RIGHT) * min(1.0, max(0.0, (place - edges[0]) / span))

    tallest = max(float(shape.counts.max()), 1.0)
    bars = [
        _bar(x_of(a), x_of(b), _FLOOR - (_FLOOR - _TOP) * n / tallest, label)
        for a, b, n in zip(shape.edges[:-1], shape.edges[1:], shape.counts, strict=True)
        if n > 0
        for label in [f"{with_unit(a, unit)} to {with_unit(b, unit)}: {count(int(n), noun)}"]
    ]
    line = _line(_LEFT, _FLOOR, WIDTH - _RIGHT, _FLOOR, "axis")
    shown = marks[np.linspace(0, len(marks) - 1, min(len(marks), MAX_MARKS)).astype(int)]
    stems = "".join(f"M{x:.1f} {_FLOOR + 4}v8" for x in sorted({x_of(float(v)) for v in shown}))
    rug = tag("path", d=Html(stems), class_="mark")
    most = tag("text", count(int(tallest)), x=_LEFT, y=_TOP - 4, class_="faint")
    return tag(
        "svg",
        tag("title", title),
        bars, line, rug, _axis_labels(shape, unit, x_of), most,
        viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", class_="histogram",
    )  # fmt: skip


def ticks(low: float, high: float, log: bool) -> list[float]:
    """Round numbers within [low, high]: 1, 2 or 5 times powers of ten."""
    if log:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        every = [m * 10.0**p for p in powers for m in (1, 2, 5)]
        inside = [v for v in every if low <= v <= high]
        tens = [v for v in inside if math.log10(v) % 1 < 1e-9]
        shown = inside if len(inside) <= 5 or len(tens) < 2 else tens
        return shown[:: -(-len(shown) // 5)]
    rough = (high - low) / 6
    if rough < 1e-300:
        return [low]
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(m * unit for m in (1, 2, 5, 10) if m * unit >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    found = [(first + k) * step for k in range(8)]
    return [v for v in found if low - 1e-9 * step <= v <= high + 1e-9 * step]


def share_bar(counts: Sequence[int], names: Sequence[str], classes: Sequence[str]) -> Html:
    """One bar of the width of the page, divided by counts. classes: the colour of each part."""
    total = sum(counts)
    if not total:
        return tag("span", "none", class_="faint")
    parts = [
        tag(
            "i",
            class_=f"part {colour}",
            style=f"flex-grow:{n / total:.5f}",
            title=f"{name}: {count(int(n))} ({percent(n, total)})",
        )
        for n, name, colour in zip(counts, names, classes, strict=True)
        if n
    ]
    said = ", ".join(
        f"{name} {percent(n, total)}" for n, name in zip(counts, names, strict=True) if n
    )
    return tag("span", parts, class_="shares", role="img", aria_label=said)


def legend(names: Sequence[str], classes: Sequence[str]) -> Html:
    """What the colours of share bars mean."""
    items = [
        tag("li", tag("i", class_=f"part {colour}"), name)
        for name, colour in zip(names, classes, strict=True)
    ]
    return tag("ul", items, class_="legend")


def amount_bar(part: float, whole: float) -> Html:
    """A bar whose length is part of whole; for a table's cell."""
    share = part / whole if whole else 0.0
    return tag("span", tag("i", style=f"width:{100 * share:.2f}%"), class_="amount")


def _bar(left: float, right: float, top: float, label: str) -> Html:
    top = min(top, _FLOOR - 1.5)  # one of a million still shows
    return tag(
        "rect",
        tag("title", label),
        x=f"{left + 0.5:.1f}",
        y=f"{top:.1f}",
        width=f"{max(right - left - 1, 1):.1f}",
        height=f"{_FLOOR - top:.1f}",
        rx=1,
        class_="bar",
    )


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> Html:
    places = {"x1": x1, "y1": y1, "x2": x2, "y2": y2}
    return tag("line", class_=kind, **{k: f"{v:.1f}" for k, v in places.items()})


def _axis_labels(shape: Histogram, unit: str, x_of) -> Html:
    low, high = float(shape.edges[0]), float(shape.edges[-1])
    labels = []
    for value in ticks(low, high, shape.log):
        x = x_of(value)
        anchor = "start" if x < _LEFT + 16 else "end" if x > WIDTH - _RIGHT - 16 else "middle"
        labels.append(tag("text", short(value), x=f"{x:.1f}", y=_FLOOR + 26, text_anchor=anchor))
    kind = ", log scale" if shape.log else ""
    labels.append(
        tag("text", f"{unit}{kind}".lstrip(", "), x=WIDTH - _RIGHT, y=_FLOOR + 41,
            text_anchor="end", class_="faint")
    )  # fmt: skip
    return joined(labels)
