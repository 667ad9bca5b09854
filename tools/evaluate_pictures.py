"""Pictures of the pairs of images that agree least."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from augment.errors import OutputError
from augment.jobs.layout import folder_name
from tools.drawing import GAP_PX, captioned, color_mapped, strip
from tools.evaluate_views import Views

PANEL_PX = 640  # wide
ERROR_GAIN = 5.0  # of the error's picture: white is a fifth of the range
# Of the mask: what does not count, counts, went along with a box, shows water.
_COLORS = {"not": (0, 0, 0), "counts": (190, 190, 190), "moved": (240, 160, 30)}
_WATER = (60, 120, 230)


def write_pictures(folder: Path, views: Views, worst: Sequence[dict[str, Any]]) -> list[Path]:
    """A PNG for each record of a pair: its frame, the other one warped, their error and the mask.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    written = []
    for record in worst:
        picture = pair_picture(views, record)
        path = folder / f"{folder_name(record['recipe'])}-{record['kind']}.png"
        data = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        written.append(path)
    return written


def pair_picture(views: Views, record: dict[str, Any]) -> np.ndarray:
    """uint8 [H', W', 3]."""
    from tools.evaluate import compare

    seen = compare(views, record["rows"])
    own = seen.a.depth_view.picture
    counts = seen.warp.counts
    error = np.abs(seen.warped - own).mean(2) * counts
    mask = np.full(own.shape, _COLORS["not"], np.uint8)
    mask[counts] = _COLORS["counts"]
    if seen.water is not None:
        mask[counts & seen.water] = _WATER
    mask[seen.moved] = _COLORS["moved"]
    numbers = record["all"]
    frames, cameras = record["frames"], record["cameras"]
    panels = (
        (
            _bytes(own),
            f"{cameras[0]}, frame {frames[0]}",
            f"{record['scene']}, {record['variant']}",
        ),
        (
            _bytes(np.where(counts[..., None], seen.warped, 0.0)),
            f"{cameras[1]}, frame {frames[1]}, warped into it",
            f"{record['meters_apart']:.2f} m and {record['seconds_apart']:.2f} s apart",
        ),
        (
            color_mapped(ERROR_GAIN * error, cv2.COLORMAP_INFERNO),
            f"error, x{ERROR_GAIN:g}",
            f"RMSE {numbers['rmse']:.4f}",
        ),
        (
            mask,
            f"what counts: {100 * numbers['share']:.0f} % of the pixels",
            "blue: water; orange: went along with a box",
        ),
    )
    drawn = [captioned(_small(image), *texts) for image, *texts in panels]
    between = np.full((GAP_PX, 2 * drawn[0].shape[1] + GAP_PX, 3), 255, np.uint8)
    return np.concatenate([strip(drawn[:2]), between, strip(drawn[2:])])


def _bytes(picture: np.ndarray) -> np.ndarray:
    return (np.clip(picture, 0, 1) * 255).round().astype(np.uint8)


def _small(image: np.ndarray) -> np.ndarray:
    height = max(1, round(image.shape[0] * PANEL_PX / image.shape[1]))
    larger = image.shape[1] < PANEL_PX
    how = cv2.INTER_NEAREST if larger else cv2.INTER_AREA
    return cv2.resize(image, (PANEL_PX, height), interpolation=how)
