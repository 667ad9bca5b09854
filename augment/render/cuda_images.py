"""The images of a view, made on the GPU and brought back in one copy."""

from __future__ import annotations

from collections.abc import Callable

from augment.cameras import Camera
from augment.view_images import ViewImages, Wanted


def begin_cuda_images(wanted: Wanted, camera: Camera) -> Callable[[], ViewImages]:
    raise NotImplementedError
