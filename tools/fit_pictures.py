"""Recorded views beside their renders, where they differ, and the depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from augment.metrics.image import flip_map
from augment.reconstruct.view import ViewKey, ViewSource
from augment.scene import Scene
from tools.drawing import Color, color_bar, color_mapped, log_ticks, short_number, write
from tools.fit_scores import ViewScore, found_camera, render_recorded

MAX_ROWS = 12
MAX_OF_A_CAMERA = 3
CELL_WIDTH = 480  # px of one image
_GAP, _EDGE = 6, 16
_HEAD, _TITLE = 70, 34  # px above the first row, and above each row's images
_BACKGROUND, _INK, _SOFT, _NOTHING = (250, 250, 250), (30, 30, 30), (110, 110, 110), (90, 90, 90)
_BAR = (200, 10)
_FLIP_COLORS, _DEPTH_COLORS = cv2.COLORMAP_MAGMA, cv2.COLORMAP_TURBO


@dataclass(frozen=True, eq=False)
class _Row:
    """Images at the size they are drawn; depth_m [H, W], 0 where there is no surface; counts [H, W]
    bool, False where a pixel is left out of the scores."""

    score: ViewScore
    recorded: np.ndarray
    rendered: np.ndarray
    error: np.ndarray
    depth_m: np.ndarray
    counts: np.ndarray


def choose_views(scores: Sequence[ViewScore]) -> list[ViewScore]:
    """A few views of every camera, evenly spread over the drive, at most MAX_ROWS in all.

    Of more cameras than that, the first ones.
    """
    cameras = list(dict.fromkeys(score.key.camera for score in scores))[:MAX_ROWS]
    each = max(1, min(MAX_OF_A_CAMERA, MAX_ROWS // max(1, len(cameras))))
    chosen: list[ViewScore] = []
    for camera in cameras:
        own = [score for score in scores if score.key.camera == camera]
        count = min(each, len(own))
        chosen += [own[int((i + 0.5) / count * len(own))] for i in range(count)]
    return chosen


def draw_views(scene: Scene, source: ViewSource, scores: Sequence[ViewScore]) -> np.ndarray:
    """uint8 RGB: a row for every view, recorded | rendered | FLIP | depth, with its figures."""
    rows = [_row(scene, source, score) for score in scores]
    nearest, farthest = _depth_range(rows)
    heights = [_TITLE + row.recorded.shape[0] + _GAP for row in rows]
    width = 2 * _EDGE + 4 * CELL_WIDTH + 3 * _GAP
    sheet = np.full((_HEAD + sum(heights) + _EDGE, width, 3), _BACKGROUND, np.uint8)
    unit = " m" if scene.has_metric_scale else ""
    _draw_head(sheet, nearest, farthest, unit)
    top = _HEAD
    for row, height in zip(rows, heights, strict=True):
        write(sheet, _title(row.score.key), _EDGE, top + 24, size=0.6, color=_INK)
        write(sheet, _figures(row.score, unit), _column(1), top + 24, size=0.5, color=_INK)
        images = (
            row.recorded,
            row.rendered,
            _masked(color_mapped(row.error, _FLIP_COLORS), row.counts),
            _depth_image(row.depth_m, nearest, farthest),
        )
        for i, image in enumerate(images):
            y, x = top + _TITLE, _column(i)
            sheet[y : y + image.shape[0], x : x + CELL_WIDTH] = image
        top += height
    return sheet


def _row(scene: Scene, source: ViewSource, score: ViewScore) -> _Row:
    view = source.load(score.key)
    rendered = render_recorded(scene, found_camera(scene, score.key, view.camera))
    counts = view.weight > 0
    if counts.any():
        error = flip_map(rendered.rgb, view.rgb, counts)
    else:
        error = np.zeros(counts.shape, np.float32)
    depth = np.where(rendered.has_surface, rendered.median_depth_m, np.float32(0))
    return _Row(
        score=score,
        recorded=_fitted(view.rgb),
        rendered=_fitted(rendered.rgb),
        error=_fitted(error),
        # Depths and masks do not average: between two surfaces there is none.
        depth_m=_fitted(depth, cv2.INTER_NEAREST),
        counts=_fitted(counts.astype(np.uint8), cv2.INTER_NEAREST) > 0,
    )


def _fitted(image: np.ndarray, how: int | None = None) -> np.ndarray:
    """The image at CELL_WIDTH."""
    height = max(1, round(image.shape[0] * CELL_WIDTH / image.shape[1]))
    shrinks = image.shape[1] > CELL_WIDTH
    how = how if how is not None else cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(image, (CELL_WIDTH, height), interpolation=how)


def _depth_range(rows: Sequence[_Row]) -> tuple[float, float]:
    """Nearest and farthest depth of the colour scale: all but 1 % at both ends, 2 digits."""
    depths = np.concatenate([row.depth_m[row.depth_m > 0] for row in rows] or [np.zeros(0)])
    if not len(depths):
        return 1.0, 100.0
    low, high = (float(f"{v:.1g}") for v in np.quantile(depths, (0.01, 0.99)))
    return low, max(high, 2 * low)


def _depth_image(depth_m: np.ndarray, nearest: float, farthest: float) -> np.ndarray:
    seen = depth_m > 0
    part = np.log(np.where(seen, depth_m, nearest) / nearest) / np.log(farthest / nearest)
    return _masked(color_mapped(1 - part, _DEPTH_COLORS), seen)  # near is red, far is blue


def _masked(image: np.ndarray, shown: np.ndarray) -> np.ndarray:
    return np.where(shown[..., None], image, np.array(_NOTHING, np.uint8))


def _draw_head(sheet: np.ndarray, nearest: float, farthest: float, unit: str) -> None:
    for i, name in enumerate(("recorded", "rendered", "FLIP error", "depth")):
        write(sheet, name, _column(i), 34, size=0.8, color=_INK, thickness=2)
    flip_ticks = {f"{v:g}": v for v in (0.0, 0.5, 1.0)}
    _draw_scale(sheet, 2, color_bar(*_BAR, _FLIP_COLORS), flip_ticks, "left out")
    span = np.log(farthest / nearest)
    depths = {
        f"{short_number(v)}{unit}": float(np.log(v / nearest) / span)
        for v in _few(log_ticks(nearest, farthest))
    }
    bar = color_bar(*_BAR, _DEPTH_COLORS)[:, ::-1]
    _draw_scale(sheet, 3, bar, depths, "no surface")


def _draw_scale(
    sheet: np.ndarray, column: int, bar: np.ndarray, ticks: dict[str, float], nothing: str
) -> None:
    """A colour bar at the right end of a column's head, and what grey means to its left."""
    height, width = bar.shape[:2]
    x, y = _column(column) + CELL_WIDTH - width - 20, 22
    sheet[y : y + height, x : x + width] = bar
    for text, part in ticks.items():
        at = x + part * width
        cv2.line(sheet, (round(at), y + height), (round(at), y + height + 4), _SOFT, 1)
        write(sheet, text, at, y + height + 20, size=0.45, color=_INK, align="centre")
    left = x - 106
    _square(sheet, left, y, height, _NOTHING)
    write(sheet, nothing, left + height + 5, y + height, size=0.45, color=_INK)


def _square(sheet: np.ndarray, x: int, y: int, side: int, color: Color) -> None:
    sheet[y : y + side, x : x + side] = color


def _few(ticks: list[float]) -> list[float]:
    """At most four of them, so that their texts do not meet."""
    step = -(-len(ticks) // 4)
    return ticks[::step]


def _column(number: int) -> int:
    return _EDGE + number * (CELL_WIDTH + _GAP)


def _title(key: ViewKey) -> str:
    return f"{key.camera}, frame {key.frame}"


def _figures(score: ViewScore, unit: str) -> str:
    """The row's figures that are known, in one line."""
    numbers = score.numbers()
    texts = {
        "psnr": "PSNR {:.2f} dB",
        "ssim": "SSIM {:.3f}",
        "flip": "FLIP {:.3f}",
        "depth_median_m": f"depth error {{:.3f}}{unit} (median)",
        "depth_p90_m": f"{{:.2f}}{unit} (90 %)",
    }
    return "     ".join(
        text.format(numbers[name]) for name, text in texts.items() if not np.isnan(numbers[name])
    )
