"""What reconstruction learns from: recorded images with their masks and depth priors, on demand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from augment.cameras import Camera


@dataclass(frozen=True)
class ViewKey:
    """Which image: the dataset's frame number and the camera's name."""

    frame: int
    camera: str


@dataclass(frozen=True, eq=False)
class RecordedView:
    """One recorded image, ready to be compared with a render of `camera`.

    camera: at the training resolution, H x W. rgb: uint8 [H, W, 3].
    weight: float32 [H, W], how much a pixel counts; 0 where it must not be learnt from.
    sky: bool [H, W], pixels that show sky: opacity is pulled to 0 there.
    depth_pixels: int32 [M], flat indices (row W + column), increasing; depth_m: float32 [M], z of
    the depth prior there; depth_weight: float32 [M], how much each is trusted.
    """

    camera: Camera
    rgb: np.ndarray
    weight: np.ndarray
    sky: np.ndarray
    depth_pixels: np.ndarray
    depth_m: np.ndarray
    depth_weight: np.ndarray

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        count = len(self.depth_pixels)
        expected = {
            "rgb": ((*size, 3), np.uint8),
            "weight": (size, np.float32),
            "sky": (size, np.bool_),
            "depth_pixels": ((count,), np.int32),
            "depth_m": ((count,), np.float32),
            "depth_weight": ((count,), np.float32),
        }
        for name, (shape, dtype) in expected.items():
            value = getattr(self, name)
            if value.shape != shape or value.dtype != dtype:
                raise ValueError(
                    f"view of camera {self.camera.name!r}: {name} must be {np.dtype(dtype)} "
                    f"{list(shape)}; got {value.dtype} {list(value.shape)}"
                )


@runtime_checkable
class ViewSource(Protocol):
    """The recorded views of a drive. Loading is deterministic; memory is the source's own care."""

    @property
    def train(self) -> tuple[ViewKey, ...]:
        """Views to learn from, in order of frame, then camera."""
        ...

    @property
    def test(self) -> tuple[ViewKey, ...]:
        """Held-out views, never learnt from."""
        ...

    def camera(self, key: ViewKey) -> Camera:
        """The view's camera at the training resolution, without loading its image."""
        ...

    def load(self, key: ViewKey) -> RecordedView: ...
