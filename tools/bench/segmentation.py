"""The small network of `climategs bench training`, how it is trained, and how it is scored.

The network is a U-Net (Ronneberger et al. 2015) with group normalisation (Wu and He 2018) and a
pixel shuffle at its end (Shi et al. 2016). Nothing here knows of weather: views have several images
each, and a training says which of them it may show. No global random state is used, and one thread
trains, so that the same views and seed give the same bits.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from augment.rng import rng_for

# The label of pixels that neither teach nor count.
IGNORED_LABEL = 255
# The number of channels that are normalised together.
GROUP_CHANNELS = 8
# Brightness, contrast and saturation of a jittered image are each multiplied by 1 - this to 1 +
# this.
JITTER_RANGE = 0.5
# The share of the images that a training with weather shows under weather.
WEATHER_SHARE = 0.5
# The share of the steps in which the learning rate rises.
WARM_UP_SHARE = 0.1
# The weight decay of AdamW.
WEIGHT_DECAY = 1e-2
# The share of red, green and blue in the grey of a colour (ITU-R BT.601).
GREY_WEIGHTS = (0.299, 0.587, 0.114)
# The number of images that are scored at once.
SCORED_BATCH = 16


@dataclass(frozen=True, eq=False)
class Views:
    """Images of the same views in several kinds of weather, in memory."""

    images: Tensor
    """uint8 [N, K, 3, H, W]: K images of each view. The first is the clean one."""
    labels: Tensor
    """uint8 [N, K, H, W]: the class of each pixel, or IGNORED_LABEL."""
    kinds: tuple[str, ...]
    """The kind of weather of each of the K images."""

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class TrainingSettings:
    """The settings of every training."""

    steps: int
    """The number of steps."""
    batch: int
    """The number of images of a step."""
    learning_rate: float
    """The highest learning rate."""
    widths: tuple[int, ...]
    """The number of channels of each level; sides halve from level to level."""
    num_classes: int
    """The number of classes."""


class SmallUNet(nn.Module):
    """Scores of classes, [N, C, H, W], of images [N, 3, H, W] in [0, 1].

    The first level has half the image's resolution. The scores of four pixels come from one place
    of it; with an `upscale` of 1 instead of 2 there is one score a place, [N, C, H/2, W/2].
    Channels are normalised within an image, so that no statistics of training images are applied
    to images in other weather.
    """

    def __init__(self, num_classes: int, widths: Sequence[int], upscale: int = 2) -> None:
        super().__init__()
        pairs = list(itertools.pairwise(widths))
        self.stem = _convolution(3, widths[0], stride=2)
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(a, b, stride=2), _convolution(b, b)) for a, b in pairs
        )
        self.up = nn.ModuleList(_convolution(a + b, a) for a, b in pairs)
        self.scores = nn.Conv2d(widths[0], upscale**2 * num_classes, 1)
        self.upscale = upscale

    def forward(self, images: Tensor) -> Tensor:
        levels = [self.stem(4 * images - 2)]
        for down in self.down:
            levels.append(down(levels[-1]))
        features = levels.pop()
        for up in reversed(self.up):
            finer = levels.pop()
            coarse = nn.functional.interpolate(features, size=finer.shape[-2:], mode="nearest")
            features = up(torch.cat([coarse, finer], 1))
        return nn.functional.pixel_shuffle(self.scores(features), self.upscale)


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
        nn.GroupNorm(outputs // GROUP_CHANNELS, outputs),
        nn.ReLU(inplace=True),
    )


def new_network(settings: TrainingSettings, seed: int) -> SmallUNet:
    """Return a network whose first weights are a function of the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = SmallUNet(settings.num_classes, settings.widths)
    return network.to(memory_format=torch.channels_last)


# ---- training -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Schedule:
    """The views and random numbers of every step: the same for all trainings of a seed."""

    views: np.ndarray
    """int [S, B]: the views."""
    is_flipped: np.ndarray
    """bool [S, B]: True where left and right are exchanged."""
    is_weathered: np.ndarray
    """bool [S, B]: True where a training with weather shows weather."""
    draws: np.ndarray
    """float [S, B] in [0, 1): the place of that weather in the list of a training."""
    jitter: np.ndarray
    """float32 [S, B, 3]: factors of brightness, contrast and saturation of jittered images."""


def make_schedule(num_views: int, settings: TrainingSettings, seed: int) -> Schedule:
    """Return the schedule of a seed. Every view comes once before any comes again."""
    order = rng_for(seed=seed, scene="training", effect="training.views")
    weather = rng_for(seed=seed, scene="training", effect="training.weather")
    jitter = rng_for(seed=seed, scene="training", effect="training.jitter")
    shape = (settings.steps, settings.batch)
    size = settings.steps * settings.batch
    rounds = [order.permutation(num_views) for _ in range(-(-size // num_views))]
    factors = jitter.uniform(1 - JITTER_RANGE, 1 + JITTER_RANGE, (*shape, 3))
    return Schedule(
        views=np.concatenate(rounds)[:size].reshape(shape),
        is_flipped=order.random(shape) < 0.5,
        is_weathered=weather.random(shape) < WEATHER_SHARE,
        draws=weather.random(shape),
        jitter=factors.astype(np.float32),
    )


def make_batch(
    views: Views, schedule: Schedule, step: int, *, kinds: Sequence[str], is_jittered: bool
) -> tuple[Tensor, Tensor]:
    """Return images float32 [B, 3, H, W] in [0, 1] and labels int64 [B, H, W] of one step.

    Args:
        views: The views.
        schedule: The schedule of the training.
        step: The number of the step.
        kinds: The kinds of weather that the training shows; empty for clean images only.
        is_jittered: True if colours are jittered.
    """
    chosen_views = torch.from_numpy(schedule.views[step])
    chosen_images = torch.zeros_like(chosen_views)
    if kinds:
        places = np.array([place for place, kind in enumerate(views.kinds) if kind in kinds])
        drawn_places = places[(schedule.draws[step] * len(places)).astype(int)]
        drawn_places[~schedule.is_weathered[step]] = 0
        chosen_images = torch.from_numpy(drawn_places)
    images = views.images[chosen_views, chosen_images].float() / 255
    labels = views.labels[chosen_views, chosen_images]
    if is_jittered:
        images = jitter_colors(images, torch.from_numpy(schedule.jitter[step]))
    is_flipped = torch.from_numpy(schedule.is_flipped[step])
    images[is_flipped] = images[is_flipped].flip(-1)
    labels[is_flipped] = labels[is_flipped].flip(-1)
    return images.contiguous(memory_format=torch.channels_last), labels.long()


def jitter_colors(images: Tensor, factors: Tensor) -> Tensor:
    """Change brightness, contrast about the image's mean grey, and saturation, in this order.

    Args:
        images: [B, 3, H, W] in [0, 1].
        factors: [B, 3]; ones change nothing.
    """
    brightness, contrast, saturation = factors[:, :, None, None, None].unbind(1)
    weights = torch.tensor(GREY_WEIGHTS)[None, :, None, None]
    images = (images * brightness).clamp(0, 1)
    mean = (images * weights).sum(1, keepdim=True).mean((2, 3), keepdim=True)
    images = (mean + contrast * (images - mean)).clamp(0, 1)
    grey = (images * weights).sum(1, keepdim=True)
    return (grey + saturation * (images - grey)).clamp(0, 1)


def class_weights(labels: Tensor, num_classes: int) -> Tensor:
    """Return the weight of each class in the loss, float32 [C], with mean 1 over all pixels.

    A weight is 1 over the square root of the class's share of the pixels. So people and poles, a
    hundredth of the pixels, are learnt in a few hundred steps.
    """
    counts = torch.bincount(labels.flatten().long(), minlength=256)[:num_classes].double()
    shares = counts / counts.sum()
    weights = torch.where(counts > 0, shares.clamp(min=1e-12).rsqrt(), 0.0)
    return (weights / (weights * shares).sum()).float()


def rate_at(progress: float) -> float:
    """Return the learning rate over its highest: a linear rise, then half a cosine down to 0.

    Args:
        progress: The share of the steps that are done.
    """
    if progress < WARM_UP_SHARE:
        return (progress + 0.01) / (WARM_UP_SHARE + 0.01)
    return 0.5 + 0.5 * math.cos(math.pi * (progress - WARM_UP_SHARE) / (1 - WARM_UP_SHARE))


def train_network(
    views: Views, settings: TrainingSettings, *, kinds: Sequence[str], is_jittered: bool, seed: int
) -> tuple[SmallUNet, list[float]]:
    """Train a network with AdamW. Return it, and its loss in every step.

    Args:
        views: The views to learn from.
        settings: The settings.
        kinds: The kinds of weather to show; empty for clean images only.
        is_jittered: True if colours are jittered.
        seed: The seed of first weights, of the order of views and of what is drawn.
    """
    network = new_network(settings, seed)
    schedule = make_schedule(len(views), settings, seed)
    weights = class_weights(views.labels[:, 0], settings.num_classes)
    loss_of = nn.CrossEntropyLoss(weights, ignore_index=IGNORED_LABEL)
    optimizer = torch.optim.AdamW(
        network.parameters(), settings.learning_rate, weight_decay=WEIGHT_DECAY
    )
    losses = list[float]()
    for step in range(settings.steps):
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * rate_at(step / settings.steps)
        images, labels = make_batch(views, schedule, step, kinds=kinds, is_jittered=is_jittered)
        loss = loss_of(network(images), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return network.eval(), losses


@contextlib.contextmanager
def one_deterministic_thread() -> Iterator[None]:
    """Let torch use one thread, and refuse operations whose result differs from run to run."""
    num_threads = torch.get_num_threads()
    was_deterministic = torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(was_deterministic)
        torch.set_num_threads(num_threads)


# ---- scores -------------------------------------------------------------------------------------


@torch.no_grad()
def predict(network: nn.Module, images: Tensor) -> Tensor:
    """Return the class with the highest score, uint8 [N, H, W], of images uint8 [N, 3, H, W]."""
    classes = [
        network((part.float() / 255).contiguous(memory_format=torch.channels_last)).argmax(1)
        for part in images.split(SCORED_BATCH)
    ]
    return torch.cat(classes).to(torch.uint8)


def count_confusions(labels: Tensor, predicted: Tensor, num_classes: int) -> np.ndarray:
    """Return the number of pixels by class (row) and predicted class (column), int64 [C, C]."""
    counts = labels != IGNORED_LABEL
    pairs = labels[counts].long() * num_classes + predicted[counts].long()
    counted = torch.bincount(pairs, minlength=num_classes**2)
    return counted.reshape(num_classes, num_classes).numpy()


def intersection_over_union(confusions: np.ndarray) -> np.ndarray:
    """Return the IoU of every class, float64 [C]; NaN for a class that no pixel has.

    Pixels that are wrongly given such a class still lower the IoU of their true class.
    """
    hits = np.diag(confusions).astype(np.float64)
    unions = confusions.sum(0) + confusions.sum(1) - hits
    return np.where(confusions.sum(1) > 0, hits / np.maximum(unions, 1), np.nan)


def score_network(network: nn.Module, views: Views, num_classes: int) -> dict[str, np.ndarray]:
    """Return the IoU of every class, float64 [C], by kind of weather.

    The pixels of all views are counted together. So a class counts by its pixels, not by the number
    of views that show it.
    """
    scores = {}
    for kind in dict.fromkeys(views.kinds):
        places = [place for place, name in enumerate(views.kinds) if name == kind]
        confusions = np.zeros((num_classes, num_classes), np.int64)
        for place in places:
            predicted = predict(network, views.images[:, place])
            confusions += count_confusions(views.labels[:, place], predicted, num_classes)
        scores[kind] = intersection_over_union(confusions)
    return scores
