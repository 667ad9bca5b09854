"""What the colour mapping network learns from (ClimateGS, "Joint Training Strategy").

Of a content scene or photograph Y_o, seen as the picture I_o, and a style image I_s:

    Z_c = N(f_c(I_o)) Y_o          Y_o in content space (nGSCM)
    Y_s = S(f_s(I_s)) Z_c          the transferred colours (sGSCM)
    Z_s = N(f_c(R(Y_s))) Y_s       what is transferred, taken back to content space
    Y_c = S(f_s(I_o)) Z_c          what is to be Y_o again

    L_con = |Z_c - Z_s| + |R(Z_c) - R(Z_s)|                                   eq. consistency
    L_cyc = |Y_c - Y_o| + |R(Y_c) - I_o|                                      eq. cycle
    L_s   = sum_i |mean phi_i(R(Y_s)) - mean phi_i(I_s)| + |deviation - deviation|   eq. style
    L     = L_s + lambda_con L_con + lambda_cyc L_cyc                         eq. total

The paper does not say which code takes Y_s back: that of its own render is taken here, since with
that of I_s L_con would be L_cyc again, of the style image. Norms are means over colours and pixels,
and over a layer's channels in L_s, so that no loss grows with the number of Gaussians, pixels or
channels. A map acts on Gaussians through their lowest band's colour; on the higher bands, which
hold differences of colours, with its linear part alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from augment.style.features import Features

LEAST_VARIANCE = 1e-6  # under the root: a constant feature has a deviation with a gradient


@dataclass(frozen=True, eq=False)
class GaussianColors:
    """Colours of Gaussians. base [B, N, 3]: of the lowest band, display-encoded, 0.5 where it is 0.
    bands [B, N, K - 1, 3]: what the higher bands add, in the same unit at their basis functions'
    value of the lowest one's.
    """

    base: Float[Tensor, "B N 3"]
    bands: Float[Tensor, "B N L 3"]

    def mapped(self, maps: Float[Tensor, "B 3 4"]) -> GaussianColors:
        """The colours that maps, one an item, make of these."""
        linear = maps[:, :, :3].mT  # rows of colours are mapped from the right
        bands = self.bands @ linear[:, None] if self.bands.shape[2] else self.bands
        return GaussianColors(self.base @ linear + maps[:, None, :, 3], bands)


class Transfer(NamedTuple):
    """The maps of one training step, [B, 3, 4] each, in the module's letters: all are of Y_o."""

    content: Tensor  # Z_c
    styled: Tensor  # Y_s
    returned: Tensor  # Z_s
    cycled: Tensor  # Y_c


def color_distance(first: GaussianColors, second: GaussianColors) -> Float[Tensor, ""]:
    """Mean absolute difference of the base colours, plus that of the higher bands."""
    distance = (first.base - second.base).abs().mean()
    if first.bands.shape[2]:
        distance = distance + (first.bands - second.bands).abs().mean()
    return distance


def picture_distance(
    first: Float[Tensor, "B 3 H W"], second: Float[Tensor, "B 3 H W"]
) -> Float[Tensor, ""]:
    """Mean absolute difference."""
    return (first - second).abs().mean()


def style_loss(rendered: Features, style: Features) -> Float[Tensor, ""]:
    """L_s of two lists of features [B, C, h, w], layer by layer; pictures may differ in size.

    A layer counts with the root mean square over its channels, averaged over B.
    """
    total = rendered[0].new_zeros(())
    for ours, theirs in zip(rendered, style, strict=True):
        for a, b in zip(moments(ours), moments(theirs), strict=True):
            total = total + ((a - b).square().mean(1) + LEAST_VARIANCE**2).sqrt().mean()
    return total


def moments(feature: Float[Tensor, "B C H W"]) -> tuple[Tensor, Tensor]:
    """Mean and deviation [B, C] over the pixels."""
    mean = feature.mean((2, 3))
    variance = (feature - mean[:, :, None, None]).square().mean((2, 3))
    return mean, (variance + LEAST_VARIANCE).sqrt()


def weighted_sum(terms: dict[str, Tensor], weights: dict[str, float]) -> Tensor:
    """Of the terms that weigh something; the others may be anything.

    Raises:
        ValueError: there are none.
    """
    parts: Sequence[Tensor] = [
        weights[name] * term for name, term in terms.items() if weights.get(name)
    ]
    if not parts:
        raise ValueError(f"none of the losses {', '.join(terms)} weighs anything: {weights}")
    return torch.stack(list(parts)).sum()
