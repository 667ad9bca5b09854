"""Pictures of the worked example: scores as bars with a dot a seed, and images with predictions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from tools.bench_training import Trained
from tools.drawing import CAPTION_PX, GAP_PX, Color, captioned, strip, text_width, write, write_jpeg
from tools.sheet import write_rgb
from tools.training_data import CLASSES, IGNORED
from tools.training_scores import confusion, intersection_over_union, predict, views_under
from tools.training_text import REGIME_NAMES

# Okabe and Ito 2008: told apart with any colour vision.
REGIME_COLORS: dict[str, Color] = {
    "clean": (0, 114, 178),
    "jitter": (230, 159, 0),
    "weather": (0, 158, 115),
}
CLASS_COLORS: dict[str, Color] = {
    "road": (110, 90, 120),
    "sidewalk": (225, 150, 200),
    "nature": (90, 150, 50),
    "building": (165, 150, 135),
    "pole, sign": (240, 200, 40),
    "vehicle": (20, 60, 190),
    "person": (220, 30, 50),
    "sky": (140, 200, 240),
}
_INK, _SOFT, _GRID = (40, 40, 40), (110, 110, 110), (225, 225, 225)
_LEFT, _TOP, _BOTTOM, _PLOT = 62, 84, 66, 330  # pixels around the axes, and their height
_BAR, _APART = 26, 26  # px of a bar, and between conditions
_ENLARGED = 1.5  # of the images


def draw_training_pictures(folder: Path, trained: Trained) -> list[Path]:
    """training-scores.png and training-samples.jpg."""
    folder.mkdir(parents=True, exist_ok=True)
    scores, samples = folder / "training-scores.png", folder / "training-samples.jpg"
    write_rgb(scores, draw_scores(trained.figures))
    write_jpeg(samples, draw_samples(trained))
    return [scores, samples]


def draw_scores(figures: Mapping[str, Any]) -> np.ndarray:
    """uint8 RGB: for each condition a bar a regime, the mean over seeds, and a dot a seed."""
    summary, weather = figures["summary"], figures["case"]["test_weather"]
    wide = len(summary) * _BAR + _APART
    count = sum(map(len, weather.values()))
    width, height = _LEFT + count * wide + (len(weather) - 1) * _APART + 30, _TOP + _PLOT + _BOTTOM
    image = np.full((height, max(width, 640), 3), 255, np.uint8)
    seeds = len(figures["case"]["seeds"])
    title = f"mIoU on streets not trained on, %; bars: mean, dots: {seeds} seeds"
    write(image, title, _LEFT, 26, size=0.6, color=_INK)
    _draw_names(
        image, {REGIME_NAMES[r]: REGIME_COLORS[r] for r in summary}, _LEFT, 52, "trained on"
    )
    for percent in range(0, 101, 20):
        y = _height(percent / 100)
        cv2.line(image, (_LEFT, y), (width - 20, y), _GRID, 1)
        write(image, f"{percent}", _LEFT - 8, y + 5, size=0.45, align="right")
    x = _LEFT + _APART // 2
    for group, names in weather.items():
        middle = x + (len(names) * wide - _APART) / 2
        label = group if len(names) > 1 or group != names[0] else ""
        write(image, label, middle, _height(0) + 46, size=0.48, color=_SOFT, align="centre")
        for name in names:
            for place, regime in enumerate(summary):
                spread = summary[regime]["conditions"][name]
                _draw_bar(image, x + place * _BAR, spread, REGIME_COLORS[regime])
            write(image, name, x + (wide - _APART) / 2, _height(0) + 22, size=0.45, align="centre")
            x += wide
        x += _APART
    cv2.line(image, (_LEFT, _height(0)), (width - 20, _height(0)), _SOFT, 1)
    return image


def _height(share: float) -> int:
    return round(_TOP + _PLOT * (1 - share))


def _draw_bar(image: np.ndarray, x: int, spread: Mapping[str, Any], color: Color) -> None:
    pale = tuple(round(0.55 * c + 0.45 * 255) for c in color)
    cv2.rectangle(image, (x + 2, _height(spread["mean"])), (x + _BAR - 2, _height(0)), pale, -1)
    values = spread["values"]
    for place, value in enumerate(values):
        at = x + round(_BAR * (place + 1) / (len(values) + 1)), _height(value)
        cv2.circle(image, at, 3, color, -1, cv2.LINE_AA)
    write(
        image,
        f"{100 * spread['mean']:.0f}",
        x + _BAR / 2,
        _height(max(values)) - 8,
        size=0.38,
        align="centre",
    )


def _draw_names(
    image: np.ndarray, colors: Mapping[str, Color], x: float, y: int, head: str = ""
) -> None:
    """A legend in one line."""
    if head:
        write(image, head, x, y, size=0.48, color=_SOFT)
        x += text_width(head, 0.48) + 14
    for name, color in colors.items():
        cv2.rectangle(image, (round(x), y - 11), (round(x) + 14, y + 2), color, -1)
        write(image, name, x + 20, y, size=0.48)
        x += 20 + text_width(name, 0.48) + 18


def draw_samples(trained: Trained) -> np.ndarray:
    """uint8 RGB, a row a condition: image, labels, and what the first seed's networks see.

    It shows the middle view of the first test scene, whatever it holds.
    """
    first = [n for n, name in enumerate(trained.test.names) if name[0] == trained.test.names[0][0]]
    shown = first[len(first) // 2]
    case = trained.figures["case"]
    rows = []
    for condition in (name for names in case["test_weather"].values() for name in names):
        images, labels = views_under(trained.test, condition)
        picture = images[shown].permute(1, 2, 0).numpy()
        panels = [captioned(_enlarged(picture), condition, "image")]
        panels.append(captioned(_enlarged(_painted(labels[shown])), "labels", "of the scene"))
        for regime, network in trained.networks.items():
            found = predict(network, images[shown : shown + 1])[0]
            iou = _mean_iou(labels[shown], found)
            found[labels[shown] == IGNORED] = IGNORED
            title = f"trained on {REGIME_NAMES[regime]}"
            panels.append(
                captioned(
                    _enlarged(_painted(found)), title, f"mIoU of this image {100 * iou:.0f} %"
                )
            )
        rows.append(strip(panels))
    legend = np.full((CAPTION_PX, rows[0].shape[1], 3), 255, np.uint8)
    _draw_names(legend, CLASS_COLORS, 4, 26)
    gap = np.full((GAP_PX, rows[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([legend, *(part for row in rows for part in (row, gap))][:-1])


def _mean_iou(labels: torch.Tensor, found: torch.Tensor) -> float:
    counts = confusion(labels, found, len(CLASSES))
    return float(np.nanmean(intersection_over_union(counts)))


def _painted(classes: torch.Tensor) -> np.ndarray:
    """uint8 [H, W, 3] RGB of class indices [H, W]; IGNORED is black."""
    table = np.zeros((256, 3), np.uint8)
    for index, name in enumerate(CLASSES):
        table[index] = CLASS_COLORS[name]
    return table[classes.numpy()]


def _enlarged(image: np.ndarray) -> np.ndarray:
    size = round(image.shape[1] * _ENLARGED), round(image.shape[0] * _ENLARGED)
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
