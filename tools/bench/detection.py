"""The small detector of `climategs bench detector`: its targets, its training, its detections.

The network is the U-Net of `tools.bench.segmentation`. Each cell has the score of every category
that an object's middle lies there, as in CenterNet (Zhou et al. 2019, "Objects as Points"), and its
distances from the sides of that object's box, as in FCOS (Tian et al. 2019) and TTFNet (Liu et al.
2020). There are no anchors. A cell is two by two pixels. Symbols: N views, C categories, T objects,
H rows and W columns of cells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tools.bench.segmentation import (
    WEIGHT_DECAY,
    Schedule,
    SmallUNet,
    TrainingSettings,
    make_schedule,
    rate_at,
)

# The number of channels of the distances from left, top, right and bottom.
NUM_SIDES = 4
# The side of a cell, pixels.
CELL_PX = 2
# The standard deviation of an object's mark in the heat map, over the sides of its box.
MARK_SIGMA = 0.15
# The mark above which a cell teaches the box.
MIN_BOX_MARK = 0.2
# The weight of the loss of boxes against that of the heat map.
BOX_WEIGHT = 2.0
# The exponents of the heat map's focal loss, as in CenterNet: of the error, and of the distance
# from a mark.
FOCAL_EXPONENT = 2
MARK_EXPONENT = 4
# The scores of a new network: few cells are middles.
FIRST_SCORE = 0.02
# Distances are this many pixels times the exponential of a channel.
DISTANCE_UNIT_PX = 8.0
# The greatest absolute value of that channel.
MAX_LOG_DISTANCE = 5.0
# The side of the square in which a detection is the highest score of its category, cells.
PEAK_CELLS = 3
# The number of detections of an image.
MAX_DETECTIONS = 40
# The lowest score of a detection.
MIN_SCORE = 0.02
# The overlap above which the lower of two detections of a category is dropped.
MAX_OVERLAP = 0.5


@dataclass(frozen=True, eq=False)
class Objects:
    """Objects of one image."""

    boxes: Tensor
    """Left, top, right, bottom of the pixels that show each object, float32 [T, 4]."""
    categories: Tensor
    """Number of the category of each object, int64 [T]."""
    is_ignored: Tensor
    """True for objects that neither teach nor count, bool [T]."""


class Targets(NamedTuple):
    """Targets of images."""

    heat: Tensor
    """Marks of the middles, 0 to 1, float32 [N, C, H, W]; NaN where the cell teaches nothing."""
    distances: Tensor
    """Distances of a cell's middle from left, top, right and bottom of its object, pixels,
    [N, 4, H, W]."""
    weights: Tensor
    """Weight of the cell's box, [N, H, W]; the weights of an object sum to 1."""


@dataclass(frozen=True, eq=False)
class DetectionViews:
    """Images of the same views in several kinds of weather, in memory, with their targets."""

    images: Tensor
    """uint8 [N, K, 3, 2 H, 2 W]: K images of each view. The first is the clean one."""
    kinds: tuple[str, ...]
    """The kind of weather of each of the K images."""
    targets: Targets
    """Targets of the N views: those of the clean images."""

    def __len__(self) -> int:
        return len(self.images)


class Detections(NamedTuple):
    """Detections of one image, by descending score."""

    boxes: Tensor
    """Left, top, right, bottom, pixels, float32 [D, 4]."""
    categories: Tensor
    """Number of the category of each, int64 [D]."""
    scores: Tensor
    """Score of each, 0 to 1, float32 [D]."""


# ---- targets ------------------------------------------------------------------------------------


def make_targets(objects: Objects, num_categories: int, size: tuple[int, int]) -> Targets:
    """Return the targets of one image, without the dimension N.

    Where objects overlap, the smaller one has the cell.

    Args:
        objects: The objects.
        num_categories: The number of categories.
        size: Height and width of the image, pixels.
    """
    height = size[0] // CELL_PX
    width = size[1] // CELL_PX
    heat = torch.zeros(num_categories, height, width)
    distances = torch.ones(NUM_SIDES, height, width)
    weights = torch.zeros(height, width)
    y_px = CELL_PX * (torch.arange(height)[:, None] + 0.5)
    x_px = CELL_PX * (torch.arange(width)[None, :] + 0.5)
    sizes = objects.boxes[:, 2:] - objects.boxes[:, :2]
    for k in sizes.prod(dim=1).argsort(descending=True).tolist():
        left, top, right, bottom = objects.boxes[k].tolist()
        category = int(objects.categories[k])
        if objects.is_ignored[k]:
            is_inside = (x_px > left) & (x_px < right) & (y_px > top) & (y_px < bottom)
            heat[category][is_inside] = torch.nan
            continue
        # The middle of the middle cell, so that its mark is 1.
        middle_x_px = CELL_PX * (math.floor((left + right) / 2 / CELL_PX) + 0.5)
        middle_y_px = CELL_PX * (math.floor((top + bottom) / 2 / CELL_PX) + 0.5)
        sigma_x_px = max(MARK_SIGMA * (right - left), CELL_PX / 2)
        sigma_y_px = max(MARK_SIGMA * (bottom - top), CELL_PX / 2)
        mark = torch.exp(
            -((x_px - middle_x_px) ** 2) / (2 * sigma_x_px**2)
            - (y_px - middle_y_px) ** 2 / (2 * sigma_y_px**2)
        )
        heat[category] = torch.where(mark > heat[category].nan_to_num(2.0), mark, heat[category])
        heat[category][mark == 1] = 1.0  # also in the middle of an ignored object
        is_taught = (mark > MIN_BOX_MARK) & (x_px > left) & (x_px < right)
        is_taught &= (y_px > top) & (y_px < bottom)
        sides = (x_px - left, y_px - top, right - x_px, bottom - y_px)
        for number, side in enumerate(sides):
            distances[number] = torch.where(is_taught, side, distances[number])
        mark_sum = mark[is_taught].sum().clamp(min=1e-6)
        weights = torch.where(is_taught, mark / mark_sum, weights)
    return Targets(heat, distances, weights)


def stack_targets(targets: Sequence[Targets]) -> Targets:
    """Return the targets of several images as one record."""
    return Targets(*map(torch.stack, zip(*targets, strict=True)))


def flip_targets(targets: Targets, is_flipped: Tensor) -> Targets:
    """Return targets with left and right exchanged in some images, bool [N]."""
    heat = targets.heat.clone()
    distances = targets.distances.clone()
    weights = targets.weights.clone()
    heat[is_flipped] = heat[is_flipped].flip(-1)
    distances[is_flipped] = distances[is_flipped].flip(-1)[:, [2, 1, 0, 3]]
    weights[is_flipped] = weights[is_flipped].flip(-1)
    return Targets(heat, distances, weights)


# ---- loss and training --------------------------------------------------------------------------


def split_output(output: Tensor) -> tuple[Tensor, Tensor]:
    """Return logits [N, C, H, W] and distances [N, 4, H, W] in pixels of a network's output."""
    logits = output[:, :-NUM_SIDES]
    channels = output[:, -NUM_SIDES:].clamp(-MAX_LOG_DISTANCE, MAX_LOG_DISTANCE)
    return logits, DISTANCE_UNIT_PX * channels.exp()


def detection_loss(output: Tensor, targets: Targets) -> Tensor:
    """Return the focal loss of the heat map plus the overlap loss of the boxes, per object.

    The overlap loss is -ln of the intersection over union (Yu et al. 2016, UnitBox).
    """
    logits, distances = split_output(output)
    heat = targets.heat.nan_to_num(0.0)
    is_taught = ~targets.heat.isnan()
    is_middle = targets.heat == 1
    num_objects = is_middle.sum().clamp(min=1)
    scores = logits.sigmoid()
    middle_loss = (1 - scores) ** FOCAL_EXPONENT * nn.functional.softplus(-logits)
    other_weight = (1 - heat) ** MARK_EXPONENT * scores**FOCAL_EXPONENT
    other_loss = other_weight * nn.functional.softplus(logits)
    heat_loss = torch.where(is_middle, middle_loss, other_loss)[is_taught].sum() / num_objects
    box_loss = -(_overlaps(distances, targets.distances).log() * targets.weights).sum()
    return heat_loss + BOX_WEIGHT * box_loss / num_objects


def _overlaps(distances: Tensor, true_distances: Tensor) -> Tensor:
    """Return the overlap of boxes about the same cell, [N, H, W], above 0."""
    shared = torch.minimum(distances, true_distances)
    shared_area = _area(shared)
    return shared_area / (_area(distances) + _area(true_distances) - shared_area)


def _area(distances: Tensor) -> Tensor:
    """Return the areas of boxes of distances [N, 4, H, W]."""
    left, top, right, bottom = distances.unbind(1)
    return (left + right) * (top + bottom)


def new_detector(settings: TrainingSettings, seed: int) -> SmallUNet:
    """Return a network whose first weights are a function of the seed; its scores are low.

    Args:
        settings: The settings; `num_classes` counts categories and NUM_SIDES.
        seed: The seed.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = SmallUNet(settings.num_classes, settings.widths, upscale=1)
    assert network.scores.bias is not None, "a convolution with bias"
    with torch.no_grad():
        network.scores.bias.zero_()
        network.scores.bias[:-NUM_SIDES] = -math.log(1 / FIRST_SCORE - 1)
    return network.to(memory_format=torch.channels_last)


def choose_images(
    views: DetectionViews, schedule: Schedule, step: int, kinds: Sequence[str]
) -> Tensor:
    """Return the images of one step, float32 [B, 3, 2 H, 2 W] in [0, 1]."""
    chosen_views = torch.from_numpy(schedule.views[step])
    chosen_images = torch.zeros_like(chosen_views)
    places = torch.tensor([place for place, kind in enumerate(views.kinds) if kind in kinds])
    if len(places):
        draws = torch.from_numpy(schedule.draws[step])
        is_weathered = torch.from_numpy(schedule.is_weathered[step])
        drawn_places = places[(draws * len(places)).long()]
        chosen_images = torch.where(is_weathered, drawn_places, chosen_images)
    images = views.images[chosen_views, chosen_images].float() / 255
    is_flipped = torch.from_numpy(schedule.is_flipped[step])
    images[is_flipped] = images[is_flipped].flip(-1)
    return images.contiguous(memory_format=torch.channels_last)


def train_detector(
    views: DetectionViews, settings: TrainingSettings, *, kinds: Sequence[str], seed: int
) -> SmallUNet:
    """Train a detector with AdamW.

    Args:
        views: The views to learn from.
        settings: The settings; `num_classes` counts categories and NUM_SIDES.
        kinds: The kinds of weather to show in half of the images; empty for clean images only.
        seed: The seed of first weights, of the order of views and of what is drawn.
    """
    network = new_detector(settings, seed)
    schedule = make_schedule(len(views), settings, seed)
    optimizer = torch.optim.AdamW(
        network.parameters(), settings.learning_rate, weight_decay=WEIGHT_DECAY
    )
    for step in range(settings.steps):
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * rate_at(step / settings.steps)
        rows = torch.from_numpy(schedule.views[step])
        targets = Targets(*(part[rows] for part in views.targets))
        targets = flip_targets(targets, torch.from_numpy(schedule.is_flipped[step]))
        loss = detection_loss(network(choose_images(views, schedule, step, kinds)), targets)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
    return network.eval()


# ---- detections ---------------------------------------------------------------------------------


@torch.no_grad()
def detect(network: nn.Module, image: Tensor) -> Detections:
    """Return the detections of an image, uint8 [3, 2 H, 2 W]."""
    pixels = (image[None].float() / 255).contiguous(memory_format=torch.channels_last)
    logits, distances = split_output(network(pixels))
    return decode(logits[0].sigmoid(), distances[0])


def decode(scores: Tensor, distances: Tensor) -> Detections:
    """Return the boxes at the peaks of a heat map.

    Args:
        scores: Scores of the middles, [C, H, W].
        distances: Distances from the sides, pixels, [4, H, W].
    """
    height, width = scores.shape[1:]
    highest = nn.functional.max_pool2d(scores[None], PEAK_CELLS, 1, PEAK_CELLS // 2)[0]
    peaks = torch.where(scores == highest, scores, 0.0).flatten()
    peak_scores, places = peaks.topk(min(4 * MAX_DETECTIONS, len(peaks)))
    places = places[peak_scores >= MIN_SCORE]
    peak_scores = peak_scores[peak_scores >= MIN_SCORE]
    categories = places // (height * width)
    rows = places % (height * width) // width
    columns = places % width
    left, top, right, bottom = distances[:, rows, columns]
    x_px = CELL_PX * (columns + 0.5)
    y_px = CELL_PX * (rows + 0.5)
    boxes = torch.stack(
        [
            (x_px - left).clamp(min=0),
            (y_px - top).clamp(min=0),
            (x_px + right).clamp(max=CELL_PX * width),
            (y_px + bottom).clamp(max=CELL_PX * height),
        ],
        dim=1,
    )
    chosen = suppress(boxes, categories)
    return Detections(boxes[chosen], categories[chosen], peak_scores[chosen])


def suppress(boxes: Tensor, categories: Tensor) -> list[int]:
    """Return the places of at most MAX_DETECTIONS boxes that overlap no better one of their kind.

    Args:
        boxes: Boxes by descending score, [D, 4].
        categories: Category of each, [D].
    """
    chosen = list[int]()
    corners = boxes.tolist()
    kinds = categories.tolist()
    for place, box in enumerate(corners):
        if len(chosen) == MAX_DETECTIONS:
            break
        better_boxes = (corners[k] for k in chosen if kinds[k] == kinds[place])
        if all(_overlap(box, better_box) <= MAX_OVERLAP for better_box in better_boxes):
            chosen.append(place)
    return chosen


def _overlap(box: Sequence[float], other: Sequence[float]) -> float:
    """Return the intersection over union of two boxes."""
    width = min(box[2], other[2]) - max(box[0], other[0])
    height = min(box[3], other[3]) - max(box[1], other[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(b[2] - b[0]) * (b[3] - b[1]) for b in (box, other)]
    return width * height / (sum(areas) - width * height)
