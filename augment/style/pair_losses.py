"""What a style network learns from photographs alone (see augment.style.pairs).

Errors of colours are logarithms of mean squares, as their figures are (dB): a pair that is nearly
right goes on counting. With N and S the folded stages of GSCM, x a photo, p its recolouring:

    same         S(p x) N(x) x = p x, and back
    half         the same, with the style from one half of the picture and the colours of the other
    look         S(p y) N(x) x = p x with y another photo, and back
    consistency  N(x) x = N(p x) p x: the paper's L_con
    cycle        S(x) N(x) x = x: the paper's L_cyc
    range        colours of photo x in the style of photo y that are not displayable
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from augment.style.network import Gscm, apply_map, compose
from augment.style.pairs import PairBatch

_ERROR_FLOOR = 1e-4  # mean square: nothing is gained beyond 40 dB
_STRIDE_PX = 2  # of the pixels whose colours are compared


@dataclass(frozen=True)
class PairWeights:
    """Of the losses in their sum."""

    same: float = 1.0
    half: float = 0.5
    look: float = 1.0
    consistency: float = 1.0
    cycle: float = 1.0
    range: float = 4.0


def pair_losses(net: Gscm, batch: PairBatch) -> dict[str, Float[Tensor, ""]]:
    """Each loss, by name, unweighted."""
    count, _, _, size = batch.photos.shape
    pictures = {
        "x": batch.photos,
        "px": batch.recolored,
        "y": batch.others,
        "py": batch.others_recolored,
    }
    # The left half's style on the right half's colours.
    halves = {
        f"{side}{name}": functional.interpolate(part, (size, size), mode="bilinear")
        for name in ("x", "px")
        for side, part in zip(
            "lr", pictures[name].split([size // 2, size - size // 2], 3), strict=True
        )
    }
    names = [*pictures, *halves]
    f_c, f_s = net.encode(torch.cat([*pictures.values(), *halves.values()]))
    normal = dict(zip(names, net.content_map(f_c).split(count), strict=True))
    style = dict(zip(names, net.style_map(f_s).split(count), strict=True))
    colors = {name: _colors(picture) for name, picture in pictures.items()}
    colors |= {name: _colors(halves[name]) for name in ("rx", "rpx")}

    def styled(content: str, by: str) -> Tensor:
        return apply_map(compose(style[by], normal[content]), colors[content])

    def error(content: str, by: str, target: str) -> Tensor:
        return _log_error(styled(content, by), colors[target])

    in_content_space = [apply_map(normal[name], colors[name]) for name in ("x", "px")]
    mixed = torch.cat([styled("x", "y"), styled("px", "y"), styled("x", "py")])
    return {
        "same": (error("x", "px", "px") + error("px", "x", "x")) / 2,
        "half": (error("rx", "lpx", "rpx") + error("rpx", "lx", "rx")) / 2,
        "look": (error("x", "py", "px") + error("px", "y", "x")) / 2,
        "consistency": (in_content_space[0] - in_content_space[1]).abs().mean(),
        "cycle": (styled("x", "x") - colors["x"]).abs().mean(),
        "range": ((mixed - 1).relu() + (-mixed).relu()).mean(),
    }


def weighted(losses: dict[str, Tensor], weights: PairWeights) -> Float[Tensor, ""]:
    """Their sum."""
    return torch.stack([getattr(weights, name) * loss for name, loss in losses.items()]).sum()


def _colors(pictures: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "B N 3"]:
    return pictures[:, :, ::_STRIDE_PX, ::_STRIDE_PX].flatten(2).transpose(1, 2)


def _log_error(got: Float[Tensor, "B N 3"], wanted: Float[Tensor, "B N 3"]) -> Float[Tensor, ""]:
    """Mean log of the mean square, of what a display would show."""
    square = (got.clamp(0, 1) - wanted).square().mean((1, 2))
    return (square + _ERROR_FLOOR).log().mean()
