"""The trade as pictures: error against time with the Pareto front, and tiers side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tools.drawing import (
    Color,
    captioned,
    linear_ticks,
    log_ticks,
    short_number,
    strip,
    text_width,
    write,
    write_jpeg,
)
from tools.trade_cases import DEFAULTS, DEPTH, JPEG, REFERENCE, WHOLE, knob_order
from tools.trade_measure import Row

WIDTH, HEIGHT = 560, 400  # of one recipe's panel, pixels
LEFT, RIGHT, TOP, BOTTOM = 62, 16, 40, 44
LEGEND_PX, LEGEND_COLUMNS = 22, 4
FLOOR = 1e-4  # FLIP below it is drawn at the bottom: no picture of 8 bits shows it
TIERS = ("draft", "balanced")
INK, SOFT, GRID, FRONT = (40, 40, 40), (120, 120, 120), (228, 228, 228), (150, 150, 150)
COLORS: tuple[Color, ...] = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233),
    (120, 94, 40), (0, 0, 0), (150, 60, 200), (90, 160, 40), (200, 30, 60),
)  # fmt: skip
CROP_PX = 300  # of a picture at REFERENCE_WIDTH, enlarged where it is smaller
CROP_AT = (0.5, 0.56)  # its middle, of the picture


def draw_trade(
    folder: Path, figures: Mapping[str, Any], pictures: Mapping[str, Mapping[str, np.ndarray]]
) -> list[Path]:
    """trade_<scene>.png, the chart, and trade_<scene>_tiers.jpg, for people to look at."""
    folder.mkdir(parents=True, exist_ok=True)
    name = "".join(c if c.isalnum() else "_" for c in figures["scene"])
    chart = folder / f"trade_{name}.png"
    cv2.imwrite(str(chart), draw_chart(figures)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    rows = [
        draw_tiers(recipe, by_name, figures)
        for recipe, by_name in pictures.items()
        if {REFERENCE, *TIERS} <= by_name.keys()
    ]
    if not rows:
        return [chart]
    tiers = folder / f"trade_{name}_tiers.jpg"
    write_jpeg(tiers, np.concatenate(rows))
    return [chart, tiers]


def pareto(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points (time, error) that none beats in both, by time."""
    front: list[tuple[float, float]] = []
    for point in sorted(points):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


def draw_chart(figures: Mapping[str, Any]) -> np.ndarray:
    """uint8 [H, W, 3] RGB: a panel for each recipe, two in a row, and the knobs' colours below."""
    recipes = figures["recipes"]
    knobs = sorted(
        {row["knob"] for entry in recipes for row in entry["rows"]} - {WHOLE, DEPTH, JPEG},
        key=knob_order().__getitem__,
    )
    colors = {knob: COLORS[n % len(COLORS)] for n, knob in enumerate(knobs)}
    lines = -(-(len(knobs) + 1) // LEGEND_COLUMNS)
    columns, rows = min(2, len(recipes)), -(-len(recipes) // 2)
    sheet = np.full((rows * HEIGHT + (lines + 1) * LEGEND_PX, 2 * WIDTH, 3), 255, np.uint8)
    for number, entry in enumerate(recipes):
        y, x = number // columns * HEIGHT, number % columns * WIDTH
        sheet[y : y + HEIGHT, x : x + WIDTH] = _panel(entry["recipe"], entry["rows"], colors)
    _legend(sheet, rows * HEIGHT, colors)
    return sheet


def draw_tiers(
    recipe: str, pictures: Mapping[str, np.ndarray], figures: Mapping[str, Any]
) -> np.ndarray:
    """The same part of the reference and the tiers, with their time and error below."""
    entry = next(entry for entry in figures["recipes"] if entry["recipe"] == recipe)
    whole = {row["value"]: row for row in entry["rows"] if row["knob"] == WHOLE}
    panels = []
    for name in (REFERENCE, *TIERS[::-1]):
        row = whole[name]
        said = f"{row['ms']:.0f} ms, FLIP {row['flip']:.4f}"
        if name == REFERENCE:
            said = f"{row['ms']:.0f} ms"
        panels.append(captioned(cropped(pictures[name]), f"{recipe}, {name}", said))
    return strip(panels)


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


def _panel(recipe: str, rows: Sequence[Row], colors: Mapping[str, Color]) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    drawn = [row for row in rows if row["knob"] not in (DEPTH, JPEG) and not _is_candidate(row)]
    times = [row["over_reference"] for row in drawn]
    flips = [max(row["flip"], FLOOR) for row in drawn]
    most = 1.08 * max(times)
    high = 1.6 * max(max(flips), 10 * FLOOR)

    def place(row: Row) -> tuple[float, float]:
        return at(row["over_reference"], row["flip"])

    def at(time: float, flip: float) -> tuple[float, float]:
        share = np.log(max(flip, FLOOR) / FLOOR) / np.log(high / FLOOR)
        x = LEFT + (WIDTH - LEFT - RIGHT) * time / most
        return x, HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * share

    _axes(image, recipe, at, most, high)
    _front(
        image,
        [
            at(*point)
            for point in pareto([(r["over_reference"], max(r["flip"], FLOOR)) for r in drawn])
        ],
    )
    reference = next(r for r in drawn if (r["knob"], r["value"]) == (WHOLE, REFERENCE))
    for knob, color in colors.items():
        own = [row for row in drawn if row["knob"] == knob]
        points = [place(row) for row in [*own, reference]]
        for start, end in pairwise(points):
            _line(image, start, end, color, 1)
        for row in own:
            cv2.circle(image, _whole(place(row)), 4, color, -1, cv2.LINE_AA)
    for row in drawn:
        if row["knob"] == WHOLE:
            _mark(image, place(row), str(row["value"]))
    return image


def _axes(image: np.ndarray, recipe: str, at: Any, most: float, high: float) -> None:
    left, bottom = at(0.0, FLOOR)
    right, top = at(most, high)
    write(image, recipe, left, 26, size=0.6, color=INK)
    for flip in log_ticks(FLOOR, high):
        _, y = at(0.0, flip)
        _line(image, (left, y), (right, y), GRID, 1)
        write(image, f"{flip:g}", left - 6, y + 4, size=0.4, align="right")
    for time in linear_ticks(0.0, most):
        x, _ = at(time, FLOOR)
        _line(image, (x, bottom), (x, top), GRID, 1)
        write(image, short_number(time), x, bottom + 16, size=0.4, align="centre")
    cv2.rectangle(image, _whole((left, top)), _whole((right, bottom)), SOFT, 1)
    write(
        image,
        "time of a frame over the reference's",
        right,
        bottom + 34,
        size=0.4,
        color=SOFT,
        align="right",
    )
    write(image, "mean FLIP against the reference", left, bottom + 34, size=0.4, color=SOFT)


def _front(image: np.ndarray, points: Sequence[tuple[float, float]]) -> None:
    """Thick and grey, in steps: what can be had by one knob or a tier."""
    for (x1, y1), (x2, y2) in pairwise(points):
        _line(image, (x1, y1), (x2, y1), FRONT, 3)
        _line(image, (x2, y1), (x2, y2), FRONT, 3)


def _mark(image: np.ndarray, place: tuple[float, float], name: str) -> None:
    """A diamond and the whole's name."""
    x, y = _whole(place)
    corners = np.array([(x - 7, y), (x, y - 7), (x + 7, y), (x, y + 7)], np.int32)
    fill = (255, 255, 255) if name in (REFERENCE, DEFAULTS) else (250, 210, 60)
    cv2.fillPoly(image, [corners], fill, cv2.LINE_AA)
    cv2.polylines(image, [corners], True, INK, 1, cv2.LINE_AA)
    ends_at = x + 10 + text_width(name, 0.42)
    beside = (x - 10, "right") if ends_at > WIDTH - RIGHT else (x + 10, "left")
    lift = {REFERENCE: -6, DEFAULTS: -18, "balanced": -30, "draft": -42}.get(name, 4)
    write(image, name, beside[0], y + lift, size=0.42, align=beside[1])


def _legend(sheet: np.ndarray, top: int, colors: Mapping[str, Color]) -> None:
    step = sheet.shape[1] // LEGEND_COLUMNS
    entries = [*colors.items(), ("Pareto front", FRONT)]
    for number, (knob, color) in enumerate(entries):
        x = number % LEGEND_COLUMNS * step + 14
        y = top + number // LEGEND_COLUMNS * LEGEND_PX + 12
        cv2.line(sheet, (x, y), (x + 20, y), color, 3, cv2.LINE_AA)
        write(sheet, knob.removeprefix("weather."), x + 28, y + 4, size=0.45)


def _is_candidate(row: Row) -> bool:
    return row["knob"] == WHOLE and str(row["value"]).startswith("candidate")


def _line(
    image: np.ndarray,
    start: tuple[float, float],
    end: tuple[float, float],
    color: Color,
    thickness: int,
) -> None:
    cv2.line(image, _whole(start), _whole(end), color, thickness, cv2.LINE_AA)


def _whole(point: tuple[float, float]) -> tuple[int, int]:
    return round(point[0]), round(point[1])
