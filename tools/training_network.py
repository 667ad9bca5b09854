"""A small U-Net for semantic segmentation."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import nn

_GROUP = 8  # channels that are normalised together


class SmallUNet(nn.Module):
    """Scores of classes [N, C, H, W] of images [N, 3, H, W] in [0, 1]; sides divide by 16.

    It starts at half resolution, and widths[1:] halve it each; the scores of four pixels come from
    one place of the half resolution (a pixel shuffle, Shi et al. 2016).

    Channels are normalised in groups within an image (Wu and He 2018) and not over a batch: so
    nothing that was measured on training images is used on others, which would be a handicap of
    its own in weather that is new.
    """

    def __init__(self, classes: int, widths: Sequence[int] = (16, 24, 32, 48)) -> None:
        super().__init__()
        pairs = list(itertools.pairwise(widths))
        self.stem = _convolution(3, widths[0], stride=2)
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(a, b, stride=2), _convolution(b, b)) for a, b in pairs
        )
        self.up = nn.ModuleList(_convolution(a + b, a) for a, b in pairs)
        self.scores = nn.Conv2d(widths[0], 4 * classes, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        levels = [self.stem(4 * images - 2)]
        for down in self.down:
            levels.append(down(levels[-1]))
        found = levels.pop()
        for up in reversed(self.up):
            skipped = levels.pop()
            wide = nn.functional.interpolate(found, size=skipped.shape[-2:], mode="nearest")
            found = up(torch.cat([wide, skipped], 1))
        return nn.functional.pixel_shuffle(self.scores(found), 2)


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
        nn.GroupNorm(outputs // _GROUP, outputs),
        nn.ReLU(inplace=True),
    )


def new_network(classes: int, widths: Sequence[int], seed: int) -> SmallUNet:
    """First weights are a function of the seed; torch's own random state is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return SmallUNet(classes, widths).to(memory_format=torch.channels_last)
