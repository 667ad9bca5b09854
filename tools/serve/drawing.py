"""Threads that draw images for all requests, and the bytes of finished images."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from augment.output.codecs import encode_image
from augment.render.backends import renders_on_gpu
from augment.render.threads import num_concurrent_views, split_threads, wait_for_result
from augment.scene.cameras import Camera
from augment.scene.pinhole_views import layout_of
from augment.scene.scene import Scene
from augment.timing import watched
from augment.view.render_view import begin_view
from augment.view.results import PendingView, WeatheredView
from recipes.schema import Recipe
from tools.serve.errors import invalid, unimplemented
from tools.serve.messages import enum_numbers

Result = TypeVar("Result")
# Pixels of the pinhole views that a lens is drawn from, at most, over the pixels of its image. The
# lenses of cars need up to 4; senseless numbers would need hundreds.
MAX_VIEW_SHARE = 12
# Pixels of such views that are always drawn: margins of small images count much.
MIN_VIEW_PIXELS = 1 << 18


class DrawingThreads:
    """Threads that draw one view each, in the order in which the views were begun.

    They divide the machine's cores. On a GPU one thread begins views, and each request waits for
    its own. A large scene has fewer threads, since each of them has a work space of its own.
    """

    def __init__(self) -> None:
        self._changing = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._count = 0

    def fit_to(self, scene: Scene, backend: str) -> None:
        """Have no more threads than drawing a scene allows."""
        num_gaussians = sum(map(len, scene.all_gaussians))
        count = 1 if renders_on_gpu(backend) else num_concurrent_views(num_gaussians)
        with self._changing:
            if self._pool is not None and self._count <= count:
                return
            old_pool = self._pool
            self._pool = split_threads(count)
            self._count = count
        if old_pool is not None:  # it still finishes what was submitted
            old_pool.shutdown(wait=False)

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Begin work on one of the threads."""
        with self._changing:
            assert self._pool is not None, "no scene was opened"
            return self._pool.submit(work)

    def begin_view(
        self, scene: Scene, camera: Camera, recipe: Recipe, backend: str, check: Callable[[], None]
    ) -> Callable[[], WeatheredView]:
        """Begin a view; return the function that waits for it.

        Args:
            scene: the scene.
            camera: the camera, at the size of the image.
            recipe: the weather.
            backend: name of the rasteriser's backend.
            check: called between passes; an exception that it raises gives up the view.
        """
        on_gpu = renders_on_gpu(backend)

        def draw() -> WeatheredView | PendingView:
            check()
            if camera.lens is not None:
                _check_lens_views(camera)
            with watched(lambda progress: check()):
                pending = begin_view(scene, camera, recipe, backend=backend)
                return pending if on_gpu else pending.result()

        future = self.submit(draw)

        def finish() -> WeatheredView:
            view = wait_for_result(future)
            return view.result() if isinstance(view, PendingView) else view

        return finish

    def close(self) -> None:
        """Begin no further work; what runs is finished, and nobody waits for it."""
        with self._changing:
            if self._pool is not None:
                self._pool.shutdown(wait=False, cancel_futures=True)


def _check_lens_views(camera: Camera) -> None:
    """Refuse a lens that sees nothing, or that takes far more pixels to draw than it shows."""
    try:
        views = layout_of(camera).views
    except ValueError as error:
        raise invalid(f"camera_intrinsics: {error}") from error
    num_pixels = sum(view.width * view.height for view in views)
    if num_pixels > MAX_VIEW_SHARE * camera.width * camera.height + MIN_VIEW_PIXELS:
        raise invalid(
            f"camera_intrinsics: this lens would take {num_pixels} pixels to draw an image of "
            f"{camera.width}x{camera.height}; at most {MAX_VIEW_SHARE} times its pixels are drawn. "
            f"Check the numbers of the lens"
        )


def check_format(request: Any) -> None:
    """Refuse an image format or quality that cannot be written, before the image is drawn."""
    quality = request.image_quality
    if quality != 0 and not 1 <= quality <= 100:  # NaN is refused, too
        raise invalid(f"image_quality must be from 1 to 100, or 0 for the default; got {quality}")
    formats = enum_numbers("ImageFormat")
    names = {number: name for name, number in formats.items()}
    name = names.get(request.image_format)
    if name in ("PNG", "JPEG", "RGB_UINT8_PLANAR"):
        return
    expected = "PNG (1), JPEG (2) or RGB_UINT8_PLANAR (4)"
    if name is None or name == "UNDEFINED":
        raise invalid(f"image_format must be {expected}; got {request.image_format}")
    raise unimplemented(f"image_format {name} is not written by this server; ask for {expected}")


def encode_for(request: Any, rgb: np.ndarray, recipe: Recipe) -> bytes:
    """Return an image in the format of a request.

    PNG and JPEG have the bytes of files that `climategs render` writes, a JPEG with the quality of
    the request, or of the recipe where the request has none.

    Args:
        request: an `RGBRenderRequest` that `check_format` has passed.
        rgb: uint8 [H, W, 3].
        recipe: the recipe.
    """
    formats = enum_numbers("ImageFormat")
    if request.image_format == formats["RGB_UINT8_PLANAR"]:
        return np.ascontiguousarray(rgb.transpose(2, 0, 1)).tobytes()
    if request.image_format == formats["PNG"]:
        return encode_image(rgb, recipe.output.model_copy(update={"image": "png"}))
    quality = round(request.image_quality) or recipe.output.jpeg_quality
    changes = {"image": "jpg", "jpeg_quality": quality}
    return encode_image(rgb, recipe.output.model_copy(update=changes))
