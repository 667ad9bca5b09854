"""What the cameras of a drive can see of what lies on the ground."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.render.backends import AUTO, CUDA
from augment.render.buffers import ALPHA, EXPECTED_DEPTH
from augment.render.clip import UNCUT
from augment.render.rasterize import rasterize
from augment.render.threads import kernel_threads
from augment.scene import PosedGaussians
from augment.snow import visibility_kernels
from augment.snow.height_map import COVERED
from augment.snow.in_threads import on_device
from augment.snow.visibility_layout import CENTRE, PARALLEL, VIEW

WIDTH_PX = 200  # of the depth images: they tell houses apart, not posts
LIFTS_M = (0.0, 0.3, 1.0)  # depths of snow at which a cell may be seen
_FAR_SHARE, _FAR_M = 1.05, 0.3  # of the depth there, and beyond it: what blurred images hide
_BELOW_SHARE = 1.02  # of the depth there: snow on top of what shows its underside
_GRAZING = math.sin(math.radians(3))  # how far normals may be off
_MARGIN_PX = 3.0
_ROWS = 256  # points a thread takes at a time


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras with the depth that they see. See visibility_kernels.find_seen.

    on_gpu: depths lie there, and that is where points are looked at.
    """

    views: np.ndarray
    sizes: np.ndarray
    depths: Tensor
    on_gpu: bool = False

    @property
    def lowest_m(self) -> float:
        """z of the lowest of them; infinite where there are none."""
        return float(self.views[:, CENTRE + 2].min(initial=np.inf))

    def near(self, low: np.ndarray, high: np.ndarray, reach_m: float) -> Views:
        """Those whose centre is within reach_m of the rectangle between two corners (x, y)."""
        centres = self.views[:, CENTRE : CENTRE + 2]
        gap = np.maximum(np.maximum(low - centres, centres - high), 0)
        chosen = (np.hypot(gap[:, 0], gap[:, 1]) <= reach_m) | (self.views[:, PARALLEL] == 1)
        return replace(self, views=self.views[chosen], sizes=self.sizes[chosen])

    def see(self, points: np.ndarray, normals: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
        """bool [C]: points float64 [C, 3], of surfaces with unit normals [C, 3], that one sees.

        What most views look through, where they should show it, is not there for any of them, but
        where is_sure, bool [C].
        """
        points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
        lifts = np.array(LIFTS_M)
        tolerances = np.array([_FAR_SHARE, _FAR_M, _BELOW_SHARE, _GRAZING, _MARGIN_PX])
        if self.on_gpu:
            from augment.snow import cuda_visibility

            given = (self.views, self.sizes, self.depths, lifts, tolerances)
            return on_device(
                lambda: cuda_visibility.find_seen(points, normals, is_sure, *given), CUDA
            )
        seen = np.empty(len(points), bool)
        with kernel_threads(_ROWS):
            visibility_kernels.find_seen(
                np.ascontiguousarray(points),
                np.ascontiguousarray(normals),
                np.ascontiguousarray(is_sure),
                self.views,
                self.sizes,
                self.depths.numpy(),
                lifts,
                tolerances,
                seen,
            )
        return seen


def draw_views(
    cameras: Sequence[Camera],
    parts: Sequence[PosedGaussians],
    *,
    backend: str = AUTO,
    after_each: Callable[[], object] = lambda: None,
) -> Views:
    """The depth that each camera sees of the parts, in small images; drawn by `backend`."""
    views, sizes, start = [], [], 0
    depths: list[Tensor] = []
    for camera in cameras:
        small = camera.scaled(min(1.0, WIDTH_PX / max(camera.width, camera.height)))
        out = rasterize(parts, small, buffers=(ALPHA, EXPECTED_DEPTH), clip=UNCUT, backend=backend)
        assert out.alpha is not None and out.expected_depth is not None
        depths.append(torch.where(out.alpha >= COVERED, out.expected_depth, math.inf).flatten())
        views.append(_numbers(small))
        sizes.append((small.width, small.height, start))
        start += small.width * small.height
        after_each()
    return Views(
        np.array(views, np.float64).reshape(-1, VIEW),
        np.array(sizes, np.int64).reshape(-1, 3),
        torch.cat(depths) if depths else torch.zeros(0),
        on_gpu=backend == CUDA and len(depths) > 0,
    )


def _numbers(camera: Camera) -> np.ndarray:
    out = np.empty(VIEW)
    out[:9] = camera.camera_from_world[:3, :3].numpy().ravel()
    out[9:12] = camera.fx, camera.cx, camera.fy
    out[CENTRE : CENTRE + 3] = camera.centre.numpy()
    out[PARALLEL:] = float(camera.is_orthographic), camera.cy
    return out
