"""Text and colour bars on pictures, and what they need: round numbers on an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

FONT = cv2.FONT_HERSHEY_SIMPLEX
CAPTION_PX, GAP_PX = 42, 8
Color = tuple[int, int, int]


def write(
    image: np.ndarray,
    text: str,
    x: float,
    y: float,
    *,
    size: float = 0.5,
    color: Color = (40, 40, 40),
    align: str = "left",
    thickness: int = 1,
) -> None:
    """Text with its baseline at y and its left end, centre or right end at x."""
    shift = {"left": 0.0, "centre": 0.5, "right": 1.0}[align] * text_width(text, size, thickness)
    at = (round(x - shift), round(y))
    cv2.putText(image, text, at, FONT, size, color, thickness, cv2.LINE_AA)


def captioned(image: np.ndarray, title: str, text: str) -> np.ndarray:
    """A picture uint8 [H, W, 3] with two lines under it."""
    caption = np.full((CAPTION_PX, image.shape[1], 3), 255, np.uint8)
    write(caption, title, 4, 17, size=0.48)
    write(caption, text, 4, 36, size=0.42, color=(110, 110, 110))
    return np.concatenate([image, caption])


def strip(panels: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one height side by side on white."""
    gap = np.full((panels[0].shape[0], GAP_PX, 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)][1:], 1)


def write_jpeg(path: Path, image: np.ndarray) -> None:
    """uint8 [H, W, 3] RGB, at a quality for documents."""
    cv2.imwrite(str(path), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def text_width(text: str, size: float, thickness: int = 1) -> int:
    """Pixels."""
    return cv2.getTextSize(text, FONT, size, thickness)[0][0]


def color_mapped(values: np.ndarray, color_map: int) -> np.ndarray:
    """uint8 [H, W, 3] RGB of values [H, W] in [0, 1] (clamped), by one of OpenCV's colour maps."""
    levels = (np.clip(values, 0, 1) * 255).round().astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, color_map), cv2.COLOR_BGR2RGB)


def color_bar(width: int, height: int, color_map: int) -> np.ndarray:
    """uint8 [H, W, 3]: 0 at the left, 1 at the right."""
    ramp = np.broadcast_to(np.linspace(0, 1, width), (height, width))
    return color_mapped(ramp, color_map)


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """At most about `most` round numbers within [low, high]."""
    span = high - low
    if not span > 0:
        return [low]
    raw = span / most
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 2.5, 5, 10) if unit * m >= raw * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten within [low, high]; powers alone where those are
    many, and any round numbers where there would be none or one.
    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1, 2, 5), (1,)):
        ticks = [d * 10.0**e for e in decades for d in digits]
        ticks = [t for t in ticks if low * (1 - 1e-9) <= t <= high * (1 + 1e-9)]
        if len(ticks) <= 7:
            break
    return ticks if len(ticks) > 1 else linear_ticks(low, high)


def short_number(value: float) -> str:
    """For an axis: 5000 as 5k, 1.5e6 as 1.5M, 0.02 as it is."""
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:g}{suffix}"
    return f"{value:.6g}"
