"""One picture for the sake of its time and its errors, at the size of those it is compared with."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from augment.batch.runner import Renderer, default_renderer
from augment.cameras import Camera
from augment.scene import Scene
from recipes.schema import Recipe


@dataclass(frozen=True, eq=False)
class Trial:
    """A rendered view. picture: uint8 [H, W, 3], display-encoded. depth: float32 [H, W], metres,
    0 = none; None where the recipe writes none. Both at the size of the reference, however small
    they were rendered. seconds: of rendering alone, without the enlarging.
    """

    picture: np.ndarray
    depth: np.ndarray | None
    seconds: float


def render_trial(
    scene: Scene,
    camera: Camera,
    recipe: Recipe,
    backend: str = "auto",
    *,
    size: tuple[int, int] | None = None,
    renderer: Renderer | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Trial:
    """The view of `camera` (before recipe.render.scale) under the recipe, in 8 bits as in files.

    size: width and height of the reference, pixels; None for the camera's own, which is that of
    render.scale 1. renderer: `augment.apply.render_view` if None. clock: in seconds.

    The first picture of a scene in some snow or style also takes what finding the places of the one
    and the colours of the other does.

    Raises:
        SceneError: the scene cannot be rendered so. RecipeError: the recipe is not settled.
    """
    render = renderer or default_renderer()
    started = clock()
    view = render(scene, camera, recipe, backend=backend)
    seconds = clock() - started
    width, height = size or (camera.width, camera.height)
    depth = view.depth_m
    if depth is not None and depth.shape != (height, width):
        # Nearest: a mean of near and far would be a surface that is in neither.
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return Trial(upsampled(view.rgb, width, height), depth, seconds)


def upsampled(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """The picture [H, W, 3] at another size, in its own type, as a viewer would show it.

    Bilinear where it grows, means over areas where it shrinks, else the same array.
    """
    if picture.shape[:2] == (height, width):
        return picture
    shrinks = picture.shape[0] > height or picture.shape[1] > width
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(picture, (width, height), interpolation=how)
