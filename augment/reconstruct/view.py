"""Records that reconstruction learns from: recorded images with masks and depth priors.

Adapters implement `ViewSource`, which loads the images on demand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from augment.scene.cameras import Camera


@dataclass(frozen=True)
class ViewKey:
    """Identifies an image."""

    frame: int  # the dataset's frame number
    camera: str  # the camera's name


@dataclass(frozen=True, eq=False)
class RecordedView:
    """One recorded image, ready to be compared with a render of `camera`."""

    camera: Camera  # at the training resolution, H x W
    rgb: np.ndarray  # uint8 [H, W, 3]
    weight: np.ndarray  # float32 [H, W], each pixel's weight; 0 where nothing must be learnt
    sky: np.ndarray  # bool [H, W], pixels that show sky: opacity is pulled to 0 there
    depth_pixels: np.ndarray  # int32 [M], increasing flat indices (row W + column) of depth priors
    depth_m: np.ndarray  # float32 [M], z of the depth priors
    depth_weight: np.ndarray  # float32 [M], their weights

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
    """The recorded views of a drive.

    Loading is deterministic; each source limits its own memory.
    """

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

    def load(self, key: ViewKey) -> RecordedView:
        """Load the view's image, masks and depth priors."""
        ...
