"""label_2/NNNNNN.txt of the object benchmark: a line an object,

    type truncated occluded alpha left top right bottom h w l x y z rotation_y [score]

x y z is the middle of the box's bottom in the rectified camera 0 (x right, y down, z forward),
rotation_y the heading about its y, 0 along x. Lines of type DontCare mark image regions: no boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.plain_files import read_text
from augment.errors import AdapterError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes

DONT_CARE = "DontCare"
_ATTRIBUTES = (
    "truncated", "occluded", "alpha", "bbox_left", "bbox_top", "bbox_right", "bbox_bottom",
)  # fmt: skip
_COLUMNS = 15


@dataclass(frozen=True, eq=False)
class ObjectLines:
    """The objects of a file. rows: their lines' numbers, from 0. labels: their types. values:
    float64 [B, 14], the columns after the type. scores: float64 [B], NaN without one. dont_care:
    how many lines are regions."""

    rows: tuple[int, ...]
    labels: tuple[str, ...]
    values: np.ndarray
    scores: np.ndarray
    dont_care: int


def read_object_lines(path: Path) -> ObjectLines:
    """The objects of a label file.

    Raises:
        AdapterError: missing, or a line that has other columns or sizes that are none.
    """
    rows, labels, values, scores, dont_care = [], [], [], [], 0
    for row, line in enumerate(read_text(path).splitlines()):
        words = line.split()
        if not words:
            continue
        if words[0] == DONT_CARE:
            dont_care += 1
            continue
        numbers = _numbers(words, f"{path}, line {row + 1}")
        rows.append(row)
        labels.append(words[0])
        values.append(numbers[: _COLUMNS - 1])
        scores.append(numbers[_COLUMNS - 1] if len(numbers) == _COLUMNS else np.nan)
    return ObjectLines(
        tuple(rows),
        tuple(labels),
        np.array(values, np.float64).reshape(-1, _COLUMNS - 1),
        np.array(scores, np.float64),
        dont_care,
    )


def boxes_of_lines(lines: ObjectLines, velodyne_from_rectified: np.ndarray) -> Boxes:
    """The objects as boxes in the Velodyne's frame. A track_id is the line's number from 0.
    Attributes: truncated, occluded, alpha, bbox_left, bbox_top, bbox_right, bbox_bottom as in the
    file, and score where a line has one, float64.
    """
    height, width, length = lines.values[:, 7:10].T
    heading = lines.values[:, 13]
    zero, one = np.zeros_like(heading), np.ones_like(heading)
    forward = np.stack([np.cos(heading), zero, -np.sin(heading)], axis=1)
    up = np.stack([zero, -one, zero], axis=1)
    rectified_from_box = np.stack([forward, np.cross(up, forward), up], axis=2)
    centres = lines.values[:, 10:13] + up * height[:, None] / 2
    turn = velodyne_from_rectified[:3, :3]
    attributes = {name: lines.values[:, i].copy() for i, name in enumerate(_ATTRIBUTES)}
    if np.isfinite(lines.scores).any():
        attributes["score"] = lines.scores
    return Boxes(
        track_ids=tuple(map(str, lines.rows)),
        labels=lines.labels,
        centers_m=centres @ turn.T + velodyne_from_rectified[:3, 3],
        sizes_m=np.stack([length, width, height], axis=1),
        quats=quat_from_rotmat(torch.from_numpy(turn @ rectified_from_box)).numpy(),
        attributes=attributes,
    )


def _numbers(words: list[str], where: str) -> list[float]:
    if len(words) not in (_COLUMNS, _COLUMNS + 1):
        raise AdapterError(
            f"{where}: expected a type and 14 numbers, and maybe a score; got {len(words)} words"
        )
    try:
        numbers = [float(word) for word in words[1:]]
    except ValueError as error:
        raise AdapterError(f"{where}: expected numbers after the type ({error})") from None
    if not np.isfinite(numbers).all():
        raise AdapterError(f"{where}: numbers must be finite; got {' '.join(words)}")
    if min(numbers[7:10]) <= 0:
        raise AdapterError(f"{where}: h, w, l must be metres > 0; got {numbers[7:10]}")
    return numbers
