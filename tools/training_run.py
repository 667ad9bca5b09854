"""Training of the worked example: regimes that see the same views in the same order."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from augment.rng import rng_for
from tools.training_case import TrainingCase
from tools.training_data import CLASSES, IGNORED, Views

# clean: clean images. jitter: clean images of changed brightness, contrast and saturation, as is
# usual. weather: each image clean, or under one of its view's weathers, half and half.
REGIMES = ("clean", "jitter", "weather")
JITTER = 0.5  # brightness, contrast and saturation are each multiplied by 1 -+ this
WEATHER_SHARE = 0.5
WARM_UP = 0.1  # share of the steps in which the learning rate rises
WEIGHT_DECAY = 1e-2


@dataclass(frozen=True)
class Schedule:
    """What every step shows, the same for all regimes.

    views: int [S, B], which. flipped: bool [S, B], left and right. weather: int [S, B], which of
    the view's images the regime `weather` shows; 0 is the clean one. jitter: float [S, B, 3],
    factors of brightness, contrast and saturation in the regime `jitter`.
    """

    views: np.ndarray
    flipped: np.ndarray
    weather: np.ndarray
    jitter: np.ndarray


def make_schedule(views: int, variants: int, *, steps: int, batch: int, seed: int) -> Schedule:
    """Every view once, in random order, before any comes again. variants: beside the clean one."""
    order = rng_for(seed=seed, scene="training", effect="training.views")
    shape, size = (steps, batch), steps * batch
    rounds = [order.permutation(views) for _ in range(-(-size // views))]
    flipped = order.random(shape) < 0.5
    weather = rng_for(seed=seed, scene="training", effect="training.weather")
    shown = weather.integers(1, variants + 1, shape)
    shown[weather.random(shape) >= WEATHER_SHARE] = 0
    jitter = rng_for(seed=seed, scene="training", effect="training.jitter")
    factors = jitter.uniform(1 - JITTER, 1 + JITTER, (*shape, 3)).astype(np.float32)
    return Schedule(np.concatenate(rounds)[:size].reshape(shape), flipped, shown, factors)


def make_batch(
    views: Views, schedule: Schedule, step: int, regime: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images float32 [B, 3, H, W] in [0, 1] and labels int64 [B, H, W] of one step."""
    if regime not in REGIMES:
        raise ValueError(f"regime must be one of {REGIMES}; got {regime!r}")
    chosen = torch.from_numpy(schedule.views[step])
    shown = torch.from_numpy(schedule.weather[step]) if regime == "weather" else 0
    images, labels = views.images[chosen, shown].float() / 255, views.labels[chosen, shown]
    if regime == "jitter":
        images = jittered(images, torch.from_numpy(schedule.jitter[step]))
    flipped = torch.from_numpy(schedule.flipped[step])
    images[flipped], labels[flipped] = images[flipped].flip(-1), labels[flipped].flip(-1)
    return images.contiguous(memory_format=torch.channels_last), labels.long()


def jittered(images: torch.Tensor, factors: torch.Tensor) -> torch.Tensor:
    """Brightness, contrast (about the image's mean grey) and saturation, in this order.

    images: [B, 3, H, W] in [0, 1]. factors: [B, 3]; ones change nothing.
    """
    brightness, contrast, saturation = factors[:, :, None, None, None].unbind(1)
    weights = torch.tensor([0.299, 0.587, 0.114])[None, :, None, None]  # ITU-R BT.601
    images = (images * brightness).clamp(0, 1)
    mean = (images * weights).sum(1, keepdim=True).mean((2, 3), keepdim=True)
    images = (mean + contrast * (images - mean)).clamp(0, 1)
    grey = (images * weights).sum(1, keepdim=True)
    return (grey + saturation * (images - grey)).clamp(0, 1)


def class_weights(labels: torch.Tensor) -> torch.Tensor:
    """float32 [C], 1 / sqrt(share of the pixels), of mean 1 over the pixels that count.

    So that people and poles, a hundredth of the pixels, are learnt in a few hundred steps.
    """
    counts = torch.bincount(labels.flatten().long(), minlength=256)[: len(CLASSES)].double()
    shares = counts / counts.sum()
    weights = torch.where(counts > 0, shares.clamp(min=1e-12).rsqrt(), 0.0)
    return (weights / (weights * shares).sum()).float()


def train(
    network: nn.Module, views: Views, case: TrainingCase, regime: str, seed: int
) -> np.ndarray:
    """Train a network in place. Returns its loss in each step, float64 [S].

    No global random state is used, so that trainings can run side by side.
    """
    schedule = make_schedule(
        len(views), views.images.shape[1] - 1, steps=case.steps, batch=case.batch, seed=seed
    )
    loss_of = nn.CrossEntropyLoss(class_weights(views.labels[:, 0]), ignore_index=IGNORED)
    optimiser = torch.optim.AdamW(
        network.parameters(), case.learning_rate, weight_decay=WEIGHT_DECAY
    )
    losses = np.zeros(case.steps)
    for step in range(case.steps):
        for group in optimiser.param_groups:
            group["lr"] = case.learning_rate * rate_at(step / case.steps)
        images, labels = make_batch(views, schedule, step, regime)
        loss = loss_of(network(images), labels)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses[step] = loss.item()
    network.eval()
    return losses


def rate_at(progress: float) -> float:
    """The learning rate over its highest: a linear rise, then half a cosine down to nothing."""
    if progress < WARM_UP:
        return (progress + 0.01) / (WARM_UP + 0.01)
    return 0.5 + 0.5 * float(np.cos(np.pi * (progress - WARM_UP) / (1 - WARM_UP)))


@contextmanager
def deterministic() -> Iterator[None]:
    """Torch refuses operations whose result could differ from run to run."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)
