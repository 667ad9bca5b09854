"""Scores of a segmentation: confusion counts, intersection over union, and means over seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from tools.training_case import TrainingCase
from tools.training_data import CLASSES, IGNORED, Views

BATCH = 16


def views_under(views: Views, condition: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Images uint8 [N, 3, H, W] and labels uint8 [N, H, W]: every view under a recipe's draw.

    Raises:
        ValueError: a view has no image of that recipe.
    """
    places = [[name.rpartition("-")[0] for name in own].index(condition) for own in views.variants]
    chosen = torch.arange(len(views)), torch.tensor(places)
    return views.images[chosen], views.labels[chosen]


@torch.no_grad()
def predict(network: nn.Module, images: torch.Tensor) -> torch.Tensor:
    """uint8 [N, H, W], the class of the highest score. images: uint8 [N, 3, H, W]."""
    found = [
        network((part.float() / 255).contiguous(memory_format=torch.channels_last)).argmax(1)
        for part in images.split(BATCH)
    ]
    return torch.cat(found).to(torch.uint8)


def confusion(labels: torch.Tensor, predicted: torch.Tensor, classes: int) -> np.ndarray:
    """int64 [C, C]: pixels by true class (row) and predicted class. IGNORED labels do not count."""
    counts = labels != IGNORED
    pairs = labels[counts].long() * classes + predicted[counts].long()
    return torch.bincount(pairs, minlength=classes**2).reshape(classes, classes).numpy()


def intersection_over_union(counts: np.ndarray) -> np.ndarray:
    """float64 [C]: true positives over all pixels that are or are called the class.

    NaN for a class that no pixel is; pixels wrongly called so still lower the others.
    """
    right = np.diag(counts).astype(np.float64)
    either = counts.sum(0) + counts.sum(1) - right
    return np.where(counts.sum(1) > 0, right / np.maximum(either, 1), np.nan)


def evaluate(network: nn.Module, views: Views, case: TrainingCase) -> dict[str, dict[str, Any]]:
    """By condition: `miou`, the mean over the classes that occur, and `iou` of each class.

    Pixels of all views are counted together, so that a class counts by its pixels and not by the
    views that happen to show it.
    """
    scores = {}
    for condition in case.conditions:
        images, labels = views_under(views, condition)
        counts = confusion(labels, predict(network, images), len(CLASSES))
        iou = intersection_over_union(counts)
        scores[condition] = {
            "miou": float(np.nanmean(iou)),
            "iou": {
                name: None if math.isnan(value) else float(value)
                for name, value in zip(CLASSES, iou, strict=True)
            },
        }
    return scores


def summarise(
    runs: Mapping[str, Sequence[Mapping[str, Any]]], case: TrainingCase
) -> dict[str, dict[str, Any]]:
    """By regime: figures over the seeds of each condition, of groups of conditions, and of classes.

    runs: by regime, for each seed what `evaluate` found. A group's score is the mean over its
    conditions, each seed on its own.
    """
    summary = {}
    for regime, scores in runs.items():
        groups = {
            group: [statistics.fmean(run[name]["miou"] for name in names) for run in scores]
            for group, names in case.test_weather.items()
        }
        summary[regime] = {
            "conditions": {
                name: spread([run[name]["miou"] for run in scores]) for name in case.conditions
            },
            "groups": {group: spread(values) for group, values in groups.items()},
            "classes": {
                name: {
                    label: spread([run[name]["iou"][label] for run in scores])
                    for label, value in scores[0][name]["iou"].items()
                    if value is not None
                }
                for name in case.conditions
            },
        }
    return summary


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Mean, least, greatest and sample standard deviation (None of a single value)."""
    return {
        "mean": statistics.fmean(values),
        "std": statistics.stdev(values) if len(values) > 1 else None,
        "min": min(values),
        "max": max(values),
        "values": list(values),
    }
