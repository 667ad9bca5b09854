"""A reconstruction's history as a picture: loss, PSNR, depth error and Gaussians over its steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from tools.drawing import Color, linear_ticks, log_ticks, short_number, text_width, write

WIDTH, HEIGHT = 720, 440  # of one panel, pixels
_LEFT, _RIGHT, _TOP, _BOTTOM = 72, 24, 74, 48  # margins around its axes
_INK, _SOFT, _GRID = (40, 40, 40), (110, 110, 110), (225, 225, 225)
_BLUE, _ORANGE, _GREEN = (0, 114, 178), (213, 94, 0), (0, 158, 115)
_SHIFT = 4  # fractional bits of OpenCV's line ends

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Line:
    """points: (step, value), in order of steps."""

    name: str
    points: tuple[tuple[float, float], ...]
    color: Color
    marked: bool = False


@dataclass(frozen=True)
class Panel:
    """last: how a line's last value is written in the legend."""

    title: str
    lines: tuple[Line, ...]
    log: bool = False
    from_zero: bool = False
    last: str = "{:.4g}"


def draw_curves(history: Sequence[Row]) -> np.ndarray | None:
    """uint8 RGB, a panel for each quantity that the history knows; None if it knows none.

    history: rows of averages {"step", "seconds", "loss", "splats", ...} and evaluation rows with
    "split" (test or train), "psnr", "depth_median_m". Values that are no number are left out.
    """
    panels = [panel for panel in _panels(history) if panel.lines]
    if not panels:
        return None
    last_step = max(point[0] for panel in panels for line in panel.lines for point in line.points)
    clock = sorted({(float(r["step"]), float(r["seconds"])) for r in history if "seconds" in r})
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    sheet = np.full((rows * HEIGHT, columns * WIDTH, 3), 255, np.uint8)
    for i, panel in enumerate(panels):
        y, x = i // columns * HEIGHT, i % columns * WIDTH
        draw_panel(sheet[y : y + HEIGHT, x : x + WIDTH], panel, max(last_step, 1.0), clock)
    return sheet


def _panels(history: Sequence[Row]) -> list[Panel]:
    splits = (("test", "held-out views", _ORANGE), ("train", "training views", _BLUE))

    def of(name: str, split: str | None) -> tuple[tuple[float, float], ...]:
        rows = (row for row in history if row.get("split") == split and _known(row.get(name)))
        return tuple((float(row["step"]), float(row[name])) for row in rows)

    def evaluated(name: str) -> tuple[Line, ...]:
        lines = (Line(label, of(name, split), c, marked=True) for split, label, c in splits)
        return tuple(line for line in lines if line.points)

    def averaged(name: str, color: Color) -> tuple[Line, ...]:
        return (Line("", points, color),) if (points := of(name, None)) else ()

    return [
        Panel("loss, mean of 50 steps (log scale)", averaged("loss", _BLUE), log=True),
        Panel("PSNR, dB", evaluated("psnr"), last="{:.2f}"),
        Panel(
            "median depth error, m (log scale)",
            evaluated("depth_median_m"),
            log=True,
            last="{:.2g}",
        ),
        Panel("Gaussians", averaged("splats", _GREEN), from_zero=True),
    ]


def _known(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def draw_panel(
    panel_image: np.ndarray, panel: Panel, last_step: float, clock: Sequence[tuple[float, float]]
) -> None:
    """Into a view of the sheet, [HEIGHT, WIDTH, 3]."""
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)  # contiguous, as OpenCV wants it
    low, high, scaled = _scale([v for line in panel.lines for _, v in line.points], panel)
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT

    def x_of(step: float) -> float:
        return _LEFT + (right - _LEFT) * step / last_step

    def y_of(value: float) -> float:
        return bottom + (_TOP - bottom) * (scaled(value) - scaled(low)) / (
            scaled(high) - scaled(low)
        )

    write(image, panel.title, _LEFT, 28, size=0.6, color=_INK)
    for value in log_ticks(low, high) if panel.log else linear_ticks(low, high):
        _line(image, (_LEFT, y_of(value)), (right, y_of(value)), _GRID)
        write(image, short_number(value), _LEFT - 8, y_of(value) + 5, size=0.5, align="right")
    _draw_steps(image, x_of, last_step, clock)
    cv2.rectangle(image, (_LEFT, _TOP), (right, bottom), _SOFT, 1)
    for line in panel.lines:
        _draw_line(image, [(x_of(s), y_of(max(v, low))) for s, v in line.points], line)
    _draw_legend(image, panel, right)
    panel_image[:] = image


def _scale(values: list[float], panel: Panel) -> tuple[float, float, Callable[[float], float]]:
    """Lowest and highest value of the axis, and what is drawn in even steps along it."""
    if panel.log:
        positive = [v for v in values if v > 0] or [1.0]
        return min(positive) / 1.15, max(positive) * 1.15, math.log
    low, high = (0.0 if panel.from_zero else min(values)), max(values)
    room = 0.08 * (high - low) or max(abs(high), 1.0) * 0.05
    return low if panel.from_zero else low - room, high + room, lambda value: value


def _draw_steps(
    image: np.ndarray,
    x_of: Callable[[float], float],
    last_step: float,
    clock: Sequence[tuple[float, float]],
) -> None:
    """Steps below the axes, and above them the time at which they were reached."""
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    steps = linear_ticks(0, last_step)
    for step in steps:
        _line(image, (x_of(step), _TOP), (x_of(step), bottom), _GRID)
        write(image, short_number(step), x_of(step), bottom + 19, size=0.5, align="centre")
    write(image, "steps", right, bottom + 38, size=0.45, color=_SOFT, align="right")
    seconds = np.array([s for _, s in clock])
    if len(clock) < 2 or seconds[-1] <= seconds[0]:
        return
    unit, name = (60.0, "min") if seconds[-1] >= 180 else (1.0, "s")
    at = np.array([step for step, _ in clock])
    # From the first row on: what was spent before it is compiling and opening, not steps.
    for tick in linear_ticks(seconds[0] / unit, seconds[-1] / unit):
        x = x_of(float(np.interp(tick * unit, np.maximum.accumulate(seconds), at)))
        _line(image, (x, _TOP), (x, _TOP - 5), _SOFT)
        label = f"{short_number(tick)} {name}"
        write(image, label, x, _TOP - 10, size=0.4, color=_SOFT, align="centre")


def _draw_line(image: np.ndarray, points: list[tuple[float, float]], line: Line) -> None:
    fixed = np.round(np.array(points) * 2**_SHIFT).astype(np.int32)
    cv2.polylines(image, [fixed[:, None]], False, line.color, 2, cv2.LINE_AA, _SHIFT)
    if line.marked or len(points) == 1:
        for x, y in fixed.tolist():
            cv2.circle(image, (x, y), 4 << _SHIFT, line.color, -1, cv2.LINE_AA, _SHIFT)


def _draw_legend(image: np.ndarray, panel: Panel, right: int) -> None:
    """On the title's line, from the right, each name with the line's last value."""
    x = float(right)
    for line in reversed([line for line in panel.lines if line.name]):
        text = f"{line.name}: {panel.last.format(line.points[-1][1])}"
        write(image, text, x, 28, size=0.45, align="right")
        x -= text_width(text, 0.45) + 10
        cv2.circle(image, (round(x - 2), 23), 5, line.color, -1, cv2.LINE_AA)
        x -= 24


def _line(
    image: np.ndarray, start: tuple[float, float], end: tuple[float, float], color: Color
) -> None:
    a, b = (tuple(round(v) for v in p) for p in (start, end))
    cv2.line(image, a, b, color, 1)
