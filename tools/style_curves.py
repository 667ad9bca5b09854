"""A style training's history as a picture: its losses, and what they are worth, over the steps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tools import fit_curves
from tools.drawing import Color
from tools.fit_curves import HEIGHT, WIDTH, Line, Panel

_COLORS: tuple[Color, ...] = ((0, 114, 178), (213, 94, 0), (0, 158, 115))
# By the history's name: title, whether its axis is logarithmic.
_PANELS = {
    "loss": ("loss: weighted sum, mean of some steps", False),
    "pairs": ("loss of pairs: logarithms of errors", False),
    "restoration_psnr": ("restored after content space, PSNR, dB", False),
    "content_rmse": ("content space: RMSE of Z_s, in deviations of Z_c (log scale)", True),
}
TERMS = ("cycle", "consistency", "style")


def draw_style_curves(history: Sequence[Mapping[str, Any]]) -> np.ndarray | None:
    """uint8 RGB, a panel for each quantity that the history knows; None if it knows none.

    history: rows {"step", "seconds", ...} with means of "loss", TERMS, "pairs", and rows of scores.
    """

    def line(name: str, label: str, color: Color, *, marked: bool = False) -> Line | None:
        points = tuple(
            (float(row["step"]), float(row[name]))
            for row in history
            if isinstance(row.get(name), int | float) and math.isfinite(row[name])
        )
        return Line(label, points, color, marked) if points else None

    terms = [line(name, name, color) for name, color in zip(TERMS, _COLORS, strict=True)]
    panels = [Panel("losses (log scale)", _known(terms), log=True)]
    for name, (title, log) in _PANELS.items():
        own = line(name, "", _COLORS[0], marked=name not in ("loss", "pairs"))
        panels.append(Panel(title, _known([own]), log=log))
    panels = [panel for panel in panels if panel.lines]
    if not panels:
        return None
    last_step = max(point[0] for panel in panels for one in panel.lines for point in one.points)
    clock = sorted({(float(row["step"]), float(row["seconds"])) for row in history})
    rows = -(-len(panels) // 2)
    sheet = np.full((rows * HEIGHT, 2 * WIDTH, 3), 255, np.uint8)
    for i, panel in enumerate(panels):
        y, x = i // 2 * HEIGHT, i % 2 * WIDTH
        fit_curves.draw_panel(
            sheet[y : y + HEIGHT, x : x + WIDTH], panel, max(last_step, 1.0), clock
        )
    return sheet


def _known(lines: Sequence[Line | None]) -> tuple[Line, ...]:
    return tuple(line for line in lines if line is not None)
