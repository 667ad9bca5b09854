"""The linear maps that a style becomes in a scene: colour' = M[:, :3] @ colour + M[:, 3]."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from augment.semantics import SemanticClass

CLASSES = max(SemanticClass) + 1


@dataclass(frozen=True, eq=False)
class StyleMaps:
    """Float32 maps of display-encoded colours.

    splats [C, 3, 4]: of Gaussians; one for all (C = 1), or one a SemanticClass value (C = CLASSES).
    sky [3, 4]: of the sky. picture [3, 4]: of a finished picture, weather and all. seen_sky [3, 4]:
    where the sky has a map of its own, covariance [:, :3] and mean [:, 3] of its colours as the
    cameras see them before they are mapped (see augment.style.sky_splats); else None.
    """

    splats: Float[Tensor, "C 3 4"]
    sky: Float[Tensor, "3 4"]
    picture: Float[Tensor, "3 4"]
    seen_sky: Float[Tensor, "3 4"] | None = None

    def __post_init__(self) -> None:
        _check("splats", self.splats, (len(self.splats), 3, 4))
        _check("sky", self.sky, (3, 4))
        _check("picture", self.picture, (3, 4))
        if self.seen_sky is not None:
            _check("seen_sky", self.seen_sky, (3, 4))
        if len(self.splats) not in (1, CLASSES):
            raise ValueError(
                f"splats must hold one map, or one for each of {CLASSES} classes; "
                f"got {len(self.splats)}"
            )


def _check(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape or value.dtype != torch.float32:
        raise ValueError(
            f"{name} must be float32 {list(shape)}; got {value.dtype} {list(value.shape)}"
        )
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name} must be finite; got {value.tolist()}")


def identity_map() -> Float[Tensor, "3 4"]:
    """The map that changes nothing."""
    return torch.eye(3, 4)


def with_strength(color_map: Float[Tensor, "*B 3 4"], strength: float) -> Float[Tensor, "*B 3 4"]:
    """The identity at strength 0, the map at 1, straight between and beyond."""
    return torch.lerp(torch.eye(3, 4, dtype=color_map.dtype), color_map, strength)
