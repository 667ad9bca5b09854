"""Upper outline of the recording car along the edges of its images.

In: images of one camera. Out: the first row of the car in each column. `refine_outline` moves a
rough outline to the edge that stands still. `find_symmetric_outline` looks for the outline where
the car did not move: the roof, bonnet or boot that a camera sees along the car's own axis ends in
an edge that reaches across the whole image, is equally high on the left and right, bows down to
both sides, and is brighter on the same side all along. A kerb, a stop line and the edge of a shadow
lack one of these. `augment.photo.own_car` calls both.

Symbols: d is the column's distance from the car's axis in half widths of the image, and an outline
is row(d) = apex + bow d^2 + tilt d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64, Int64

# Columns of the images in which an outline is searched, at most.
_SEARCH_WIDTH = 640
# Columns of the images in which an outline is refined, at most.
_REFINE_WIDTH = 960
# Images whose edges are averaged, at most.
_MAX_IMAGES = 8
# Standard deviation of the blur before differences are taken, pixels.
_BLUR_PX = 1.0
# Width and height of the window whose mean contrast an edge is compared with, pixels.
_WINDOW_PX = (31, 15)
# Contrast of a smooth surface, which keeps noise from counting, levels of 255.
_SMOOTH_LEVELS = 3.0
# Contrast relative to the window's mean from which an edge counts no more.
_MAX_RELATIVE_CONTRAST = 2.5

# Width of images that show a bow, at least, pixels.
_MIN_SEARCH_WIDTH = 240
# Step between apexes that are tried, pixels.
_APEX_STEP_PX = 1.0
# Bows that are tried, parts of the image's width.
_BOWS = np.arange(0.02, 0.165, 0.01)
# Tilts that are tried, parts of the image's width.
_TILTS = np.arange(-2, 3) * 0.005
# Step between columns that are read, pixels.
_COLUMN_STEP_PX = 4
# Share of the columns in which the outline must lie inside the image.
_MIN_COLUMN_SHARE = 0.6
# Mean relative contrast, times the share of the contrast that has one sign, from which an outline
# is the car's. Images along the car's axis that show it have 2.09 to 2.38 (27 of PandaSet and
# nuScenes), those that do not 1.33 at most (33), other driving images 1.57, other photos 1.60.
_MIN_SCORE = 1.85
# Median contrast of an outline, at least, levels of 255.
_MIN_CONTRAST_LEVELS = 15.0

# Rows above and below a rough outline in which the edge is looked for, parts of the width.
_ABOVE_PART = 0.006
_BELOW_PART = 0.024
# The same for an outline that was searched by its edge.
_BESIDE_PART = 0.012
# Cost of lying at the end of that range, in relative contrast.
_OFFSET_COST = 1.5
# Columns whose median outline counts.
_MEDIAN_PX = 5
# Standard deviation of the blur along the outline, pixels.
_SMOOTHING_PX = 4.0
# Cost of a step by one row between two columns, in relative contrast.
_STEP_COST = 0.35
# Largest step between two columns, pixels.
_MAX_STEP_PX = 3


def refine_outline(
    images: Sequence[np.ndarray], tops: Float[np.ndarray, " w"], *, by_edge: bool = False
) -> Float64[np.ndarray, " W"]:
    """Return the first row of the car in each column, at the edge that stands still in all images.

    Edges that move cancel in the images' mean, so that the outline lies on the clearest edge near
    the rough one, in small steps (Viterbi).

    Args:
        images: images of one camera, uint8 [H, W, 3], of one size.
        tops: rough first row of the car in columns of any coarser width, as a part of the height;
            1 or more where the column shows no car.
        by_edge: True if the rough outline lies on an edge already; else it lies above the car.

    Returns:
        The first row in each column of the images, in their pixels; the height where there is no
        car.
    """
    height, width = images[0].shape[:2]
    differences = _mean_differences(images, _REFINE_WIDTH)
    num_rows, num_columns = differences.shape[:2]
    contrast = np.linalg.norm(differences, axis=-1)
    relative = _relative_contrast(contrast)
    centres = (np.arange(num_columns) + 0.5) / num_columns
    rough = np.interp(centres, (np.arange(len(tops)) + 0.5) / len(tops), tops) * num_rows
    above_px = round((_BESIDE_PART if by_edge else _ABOVE_PART) * num_columns)
    # An outline that leaves the image just below its border may enter it.
    has_car = rough < num_rows - 1 + (above_px if by_edge else 0)
    below_px = round((_BESIDE_PART if by_edge else _BELOW_PART) * num_columns)
    offsets = np.arange(-above_px, below_px + 1)
    rows = np.rint(rough).astype(int)[:, None] + offsets  # [columns, offsets]
    is_inside = (rows >= 0) & (rows < num_rows)
    gain = np.where(
        is_inside, relative[rows.clip(0, num_rows - 1), np.arange(num_columns)[:, None]], 0.0
    )
    if by_edge:  # edges of what stands behind may be clearer, but lie elsewhere
        gain = gain - _OFFSET_COST * (offsets / below_px) ** 2
    best = _best_path(gain, rows)
    top = rows[np.arange(num_columns), best].astype(np.float64)
    # Bodies are smooth; the path has steps of whole pixels, and single columns that leave the edge.
    top = cv2.medianBlur(top.astype(np.float32)[None], _MEDIAN_PX)[0]
    top = cv2.GaussianBlur(top[None], (0, 0), _SMOOTHING_PX, borderType=cv2.BORDER_REPLICATE)[0]
    # The contrast is greatest in the middle of an edge, a pixel below its upper end.
    top = top.astype(np.float64) - 0.5
    top = np.where(has_car, top, num_rows) / num_rows
    columns = (np.arange(width) + 0.5) / width
    return np.interp(columns, centres, top) * height


def _best_path(gain: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the index of the row in each column with most gain and smallest steps, int [C].

    Args:
        gain: gain of each candidate, [C, K].
        rows: row of each candidate, [C, K], rising by one along K.
    """
    num_columns, count = gain.shape
    score = gain[0]
    came_from = np.zeros((num_columns, count), np.int64)
    for column in range(1, num_columns):
        shift = int(rows[column, 0] - rows[column - 1, 0])
        best = np.full(count, -np.inf)
        for step in range(-_MAX_STEP_PX, _MAX_STEP_PX + 1):
            # Index k of this column lies `step` rows below index k + shift - step of the last one.
            last = np.arange(count) + shift - step
            is_there = (last >= 0) & (last < count)
            value = np.where(is_there, score[last.clip(0, count - 1)], -np.inf)
            value = value - _STEP_COST * abs(step)
            is_better = value > best
            best = np.where(is_better, value, best)
            came_from[column] = np.where(is_better, last, came_from[column])
        is_lost = ~np.isfinite(best)  # beyond the reach of every step: any of the last column's
        came_from[column, is_lost] = score.argmax()
        score = np.where(is_lost, score.max() - _STEP_COST * count, best) + gain[column]
    path = np.empty(num_columns, np.int64)
    path[-1] = score.argmax()
    for column in range(num_columns - 1, 0, -1):
        path[column - 1] = came_from[column, path[column]]
    return path


def find_symmetric_outline(
    images: Sequence[np.ndarray], axis_column: float, min_apex: float
) -> Float64[np.ndarray, " w"] | None:
    """Return the outline of a car that a camera sees along the car's axis; None without any.

    Args:
        images: images of one camera, uint8 [H, W, 3], of one size; one is enough.
        axis_column: column of the image in which the car's axis vanishes, as a part of the width.
        min_apex: least row of the outline on the axis, as a part of the height. Above it lie the
            road's borders, which meet on the axis as an outline's sides do.

    Returns:
        The first row of the car in each column of a small image, as a part of the height; 1 or
        more where the column shows no car.
    """
    if images[0].shape[1] < _MIN_SEARCH_WIDTH:
        return None
    search = _OutlineSearch.of(images, axis_column)
    bows = _BOWS * search.num_columns
    apexes = np.arange(min_apex * search.num_rows, search.num_rows - 4, _APEX_STEP_PX)
    if len(apexes) == 0:
        return None
    line, score = search.best_line(apexes, bows)
    if score < _MIN_SCORE:
        return None
    # Straight edges across the road resemble a slight bow; then a straight line fits better.
    straight_apexes = np.arange(line.apex - 2, line.apex + line.bow + 2, _APEX_STEP_PX)
    if search.best_line(straight_apexes, np.zeros(1))[1] >= score:
        return None
    d = (np.arange(search.num_columns) + 0.5) / search.num_columns
    d = 2 * (d - axis_column)
    return (line.apex + 0.5 + line.bow * d**2 + line.tilt * d) / search.num_rows


class _Line(NamedTuple):
    """A symmetric outline: row(d) = apex + bow d^2 + tilt d, pixels."""

    apex: float
    """Row on the car's axis."""
    bow: float
    """Rows by which it lies lower half a width beside the axis."""
    tilt: float
    """Rows by which it lies lower on the right of the axis than on it."""


@dataclass(frozen=True, eq=False)
class _OutlineSearch:
    """Contrast of small images, in some of whose columns outlines are compared."""

    num_rows: int
    """Height of the small images."""
    num_columns: int
    """Width of the small images."""
    columns: Int64[np.ndarray, " C"]
    """Columns that are read."""
    d: Float64[np.ndarray, " C"]
    """Distance of these columns from the car's axis, half widths of the image."""
    contrast: Float[np.ndarray, "h w"]
    """Contrast from row to row, levels of 255."""
    relative: Float[np.ndarray, "h w"]
    """The same over its surroundings', where an outline may pass a row above or below an edge."""
    signed: Float[np.ndarray, "h w"]
    """Sum of the colours' differences: positive where it gets brighter downwards."""

    @staticmethod
    def of(images: Sequence[np.ndarray], axis_column: float) -> _OutlineSearch:
        """Return the search in some images; the arguments are those of
        `find_symmetric_outline`.
        """
        differences = _mean_differences(images, _SEARCH_WIDTH)
        num_rows, num_columns = differences.shape[:2]
        contrast = np.linalg.norm(differences, axis=-1)
        relative = np.minimum(_relative_contrast(contrast), np.float32(_MAX_RELATIVE_CONTRAST))
        columns = np.arange(_COLUMN_STEP_PX // 2, num_columns, _COLUMN_STEP_PX)
        return _OutlineSearch(
            num_rows=num_rows,
            num_columns=num_columns,
            columns=columns,
            d=2 * ((columns + 0.5) / num_columns - axis_column),
            contrast=contrast,
            relative=cv2.dilate(relative, np.ones((3, 1), np.uint8)),
            signed=differences.sum(-1),
        )

    def best_line(
        self, apexes: Float64[np.ndarray, " A"], bows: Float64[np.ndarray, " B"]
    ) -> tuple[_Line, float]:
        """Return the line with the highest score among all apexes, bows and tilts, and the score.

        The score is the mean relative contrast along the line, times the share of the contrast that
        has one sign; 0 where too little of the line lies in the image, or contrast is low.
        """
        best_score = 0.0
        best_line = _Line(0.0, 0.0, 0.0)
        for bow in bows.tolist():
            for tilt in (_TILTS * self.num_columns).tolist():
                lines = apexes[:, None] + bow * self.d**2 + tilt * self.d  # [apexes, columns]
                is_inside = (lines < self.num_rows - 2) & (lines >= 1)
                rows = np.rint(lines).astype(int).clip(0, self.num_rows - 1)
                count = np.maximum(is_inside.sum(axis=1), 1)
                mean = np.where(is_inside, self.relative[rows, self.columns], 0).sum(1) / count
                sums = np.where(is_inside, self.signed[rows, self.columns], 0)
                same_sign = np.abs(sums.sum(1)) / np.maximum(np.abs(sums).sum(1), 1e-6)
                is_long = is_inside.mean(axis=1) >= _MIN_COLUMN_SHARE
                score = np.where(is_long, mean * same_sign, 0)
                index = int(score.argmax())
                if score[index] <= best_score:
                    continue
                levels = self.contrast[rows[index], self.columns][is_inside[index]]
                if np.median(levels) >= _MIN_CONTRAST_LEVELS:
                    best_score = float(score[index])
                    best_line = _Line(float(apexes[index]), bow, tilt)
        return best_line, best_score


def _mean_differences(images: Sequence[np.ndarray], max_width: int) -> np.ndarray:
    """Return the mean over images of the difference between the rows below and above each pixel.

    Args:
        images: the images, of which _MAX_IMAGES are taken, evenly spread.
        max_width: width of the result, at most, pixels.

    Returns:
        Differences of red, green and blue, levels of 255, float32 [h, w, 3].
    """
    height, width = images[0].shape[:2]
    num_columns = min(max_width, width)
    size = (num_columns, max(4, round(height * num_columns / width)))
    places = np.linspace(0, len(images) - 1, min(_MAX_IMAGES, len(images))).round().astype(int)
    total = np.zeros((size[1], size[0], 3), np.float32)
    for place in places:
        small = cv2.resize(images[place], size, interpolation=cv2.INTER_AREA).astype(np.float32)
        small = cv2.GaussianBlur(small, (0, 0), _BLUR_PX)
        total[1:-1] += small[2:] - small[:-2]
    return total / np.float32(len(places))


def _relative_contrast(contrast: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return contrast over the mean contrast of its surroundings."""
    return contrast / (cv2.blur(contrast, _WINDOW_PX) + np.float32(_SMOOTH_LEVELS))
