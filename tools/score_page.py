"""The page of `climategs score`: curves, tables and the images that the weather costs most."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from augment.output.codecs import decode_image
from augment.output.store import Store
from augment.scores.suite_scores import (
    EffectScores,
    Interval,
    RecallBinScore,
    SuiteScores,
    WorstImage,
)
from tools.report import make_environment, page_asset
from tools.report_pictures import Picture, embed

# Sizes of a chart, in SVG units.
CHART_WIDTH = 340
CHART_HEIGHT = 190
LEFT = 30
RIGHT = 10
TOP = 12
FLOOR = 150  # height, from the top, of the value 0
# Width and largest size of a worst image on the page.
PICTURE_WIDTH_PX = 640
PICTURE_BYTES = 90_000
# Colours of boxes, RGB: found, and missed though found in the clean render, and missed in both.
FOUND_COLOR = (64, 200, 90)
LOST_COLOR = (230, 50, 50)
MISSED_COLOR = (240, 200, 60)


class Curve(NamedTuple):
    """A line of a chart."""

    name: str
    """Name in the legend."""
    css: str
    """CSS colour."""
    points: list[tuple[float, float, str]]
    """Place in the chart, and a text, of each value; the clean value first."""
    whiskers: list[tuple[float, float, float]]
    """Place, upper and lower end of each interval."""


class Chart(NamedTuple):
    """Values of one effect over its levels."""

    name: str
    """Name of the effect."""
    effect: EffectScores
    """Scores of the effect."""
    curves: list[Curve]
    """Lines."""
    ticks: list[tuple[float, str]]
    """Place and text of the marks under the chart: clean, then the number of each level."""


class WorstFigure(NamedTuple):
    """A worst image, in the clean render and in the weather."""

    image: WorstImage
    """Facts of the image."""
    pictures: tuple[Picture, Picture]
    """Clean render and variant."""


def make_score_page(scores: SuiteScores, store: Store) -> str:
    """Return the page's text.

    Args:
        scores: Scores of a network.
        store: Output of the suite, for pictures.
    """
    environment = make_environment()
    figures = [WorstFigure(image, _pictures(image, store)) for image in scores.worst_images]
    return environment.get_template("score.html").render(
        scores=scores,
        charts=[make_chart(name, effect) for name, effect in scores.effects.items()],
        figures=figures,
        levels=sorted({row.level for effect in scores.effects.values() for row in effect.levels}),
        style=page_asset(environment, "report.css"),
        bins=bin_tables(scores),
        sizes={"width": CHART_WIDTH, "height": CHART_HEIGHT, "left": LEFT, "floor": FLOOR,
               "right": CHART_WIDTH - RIGHT, "top": TOP},
    )  # fmt: skip


def make_chart(name: str, effect: EffectScores) -> Chart:
    """Return the chart of an effect: the metric, and recall where there is one, over its levels."""
    count = len(effect.levels)
    places_x = np.linspace(LEFT + 8, CHART_WIDTH - RIGHT - 8, count + 1).tolist()
    texts = ["clean", *(f"level {level.level}" for level in effect.levels)]

    def line(title: str, css: str, values: Sequence[float]) -> Curve:
        points = [
            (x, height_of(value), f"{title}, {text}: {value:.3f}")
            for x, value, text in zip(places_x, values, texts, strict=True)
        ]
        return Curve(title, css, points, [])

    def whiskers_of(intervals: Sequence[Interval | None]) -> list[tuple[float, float, float]]:
        pairs = zip(places_x[1:], intervals, strict=True)
        return [
            (x, height_of(interval[1]), height_of(interval[0]))
            for x, interval in pairs
            if interval is not None
        ]

    metric_line = line(
        "metric", "var(--accent)", [effect.clean, *(v.metric for v in effect.levels)]
    )
    metric_whiskers = whiskers_of([level.metric_interval for level in effect.levels])
    curves = [metric_line._replace(whiskers=metric_whiskers)]
    recalls = [effect.clean_recall, *(level.recall for level in effect.levels)]
    if None not in recalls:
        recall_line = line("recall", "var(--s2)", [value or 0.0 for value in recalls])
        recall_whiskers = whiskers_of([level.recall_interval for level in effect.levels])
        curves.append(recall_line._replace(whiskers=recall_whiskers))
    numbers = ["clean"] + [
        str(level.level) if level.value is None else f"{level.value:g}" for level in effect.levels
    ]
    return Chart(name, effect, curves, list(zip(places_x, numbers, strict=True)))


def height_of(value: float) -> float:
    """Return the height in a chart, from the top, of a value of 0 to 1."""
    return FLOOR - (FLOOR - TOP) * min(max(value, 0.0), 1.0)


def bin_tables(scores: SuiteScores) -> list[tuple[str, list[str], list[tuple[str, Any]]]]:
    """Return recall by what was visible: title, names of the bins, and the bins by effect."""
    titles = {
        "transmittance": ("Share of the object's light that the weather lets through", "%"),
        "visible_fraction": ("Share of the object that other objects leave visible", "%"),
        "range_m": ("Distance from the camera", "m"),
    }
    tables = []
    for column, (title, unit) in titles.items():
        rows = [(name, getattr(bins, column)) for name, bins in scores.recall_bins.items()]
        if rows:
            names = [_bin_name(counted, unit) for counted in rows[0][1]]
            tables.append((title, names, rows))
    return tables


def _bin_name(counted: RecallBinScore, unit: str) -> str:
    """Return the name of a bin."""
    scale = 100 if unit == "%" else 1
    if counted.upper is None:
        return f"over {counted.lower * scale:g} {unit}"
    return f"{counted.lower * scale:g}–{counted.upper * scale:g} {unit}"


def _pictures(image: WorstImage, store: Store) -> tuple[Picture, Picture]:
    """Return the clean render and the variant of an image, with the boxes of its objects."""
    pictures = []
    for path, is_clean in ((image.clean_path, True), (image.path, False)):
        pixels = np.ascontiguousarray(decode_image(store.read(path)))
        line_width = max(2, round(pixels.shape[1] / 500))
        for obj in image.objects:
            is_found = obj.is_found_clean if is_clean else obj.is_found
            color = FOUND_COLOR if is_found else LOST_COLOR if obj.is_found_clean else MISSED_COLOR
            left, top, right, bottom = (round(side) for side in obj.box)
            cv2.rectangle(pixels, (left, top), (right - 1, bottom - 1), color, line_width)
        pictures.append(embed(pixels, PICTURE_WIDTH_PX, PICTURE_BYTES))
    return pictures[0], pictures[1]
