"""One exposure for everything that weather adds to the pictures of several cameras.

A camera of a fitted scene has a colour map M, which the finished picture gets: p' = M p + m. A
colour A that weather adds would therefore look different in every camera. With a = M^-1 C(A) in its
place it looks as in the common exposure C, the mean of all maps, while surfaces and sky keep the
exposure of their camera. Maps are affine, so this holds for every mixture:

    M(t p + (1 - t) a) = t M(p) + (1 - t) C(A)

The inverse is damped, a = A + (M'M + d)^-1 M' (C - M)(A) with d = DAMPING, so that none of its
gains exceeds 1 / (2 sqrt d) = 50. A colour keeps its value where a camera records almost nothing of
it, and keeps its bits where M equals C.

Callers: `augment.view.render_view` for all effects but smog, and `augment.effects.smog`.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from augment.memo import memo_of
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians, Scene

DAMPING = 1e-4  # added to the squared gains of a camera's colour map when it is inverted


def exposure_change(
    color_map: Float[Tensor, "3 4"] | None, common: Float[Tensor, "3 4"]
) -> Float64[Tensor, "3 4"]:
    """Return the affine change of added colours, a - A = change[:, :3] A + change[:, 3].

    Args:
        color_map: M and m, the camera's map; None for the identity.
        common: C, the mean of all maps.
    """
    camera_map = torch.eye(3, 4, dtype=torch.float64) if color_map is None else color_map.double()
    left, gains, right = torch.linalg.svd(camera_map[:, :3])
    damped = (gains / (gains**2 + DAMPING))[:, None]
    return right.T @ (damped * (left.T @ (common.double() - camera_map)))


@dataclasses.dataclass(frozen=True, eq=False)
class AddedColors:
    """Map of the colours that weather adds in one camera, before the camera's own colour map."""

    matrix: Float[Tensor, "3 4"]
    """a = matrix[:, :3] A + matrix[:, 3], display-encoded, float32."""

    @cached_property
    def _color_maps(self) -> Float[Tensor, "1 3 4"]:
        """Return the matrix as `PosedGaussians` take it; one object, which a GPU then keeps."""
        return self.matrix[None]

    def of_color(self, rgb: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return a colour in the common exposure, not below 0."""
        red, green, blue = self._mapped(np.asarray(rgb, np.float64)).tolist()
        return red, green, blue

    def of_light(self, light: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        """Return light, in squares of display-encoded colours, in the common exposure."""
        return self._mapped(np.sqrt(np.maximum(light, 0))) ** 2

    def slope_of_light(
        self, light: Float64[np.ndarray, "3"], slope: Float64[np.ndarray, "3 3"]
    ) -> Float64[np.ndarray, "3 3"]:
        """Return a small change of light, by channel and axis, in the common exposure.

        Args:
            light: the light that changes, squares of display-encoded colours.
            slope: change of its channels (rows) along axes (columns).
        """
        colors = np.sqrt(np.maximum(light, 1e-6))
        linear = self.matrix[:, :3].double().numpy()
        return self._mapped(colors)[:, None] * linear / colors @ slope

    def of_part(self, part: PosedGaussians) -> PosedGaussians:
        """Return Gaussians that weather adds in the common exposure.

        Gaussians that are lit pixel by pixel change their colours and slopes, once a camera.
        """
        if part.shading is None:
            return dataclasses.replace(part, color_maps=self._color_maps, color_rows=None)
        gaussians, slopes = memo_of(part.gaussians).get(
            ("in common exposure", tuple(self.matrix.flatten().tolist())),
            lambda: self._lit_per_pixel(part.gaussians, part.shading and part.shading.slopes),
        )
        shading = dataclasses.replace(part.shading, slopes=slopes)
        return dataclasses.replace(part, gaussians=gaussians, shading=shading)

    def _lit_per_pixel(
        self, gaussians: Gaussians, slopes: Tensor | None
    ) -> tuple[Gaussians, Tensor]:
        """Return Gaussians of one colour each, and the slopes of their light, mapped."""
        assert slopes is not None
        linear = self.matrix[:, :3].T
        color = 0.5 + SH_C0 * gaussians.sh[:, 0]
        mapped = (color @ linear + self.matrix[:, 3] - 0.5) / SH_C0
        sh = gaussians.sh.clone()
        sh[:, 0] = mapped
        return dataclasses.replace(gaussians, sh=sh), slopes @ linear

    def _mapped(self, rgb: np.ndarray) -> np.ndarray:
        """Return a colour [3], mapped, not below 0."""
        matrix = self.matrix.double().numpy()
        return np.maximum(matrix[:, :3] @ rgb + matrix[:, 3], 0.0)


def added_colors(scene: Scene, camera: Camera) -> AddedColors | None:
    """Return the map of the colours that weather adds in a camera; None if it changes nothing."""
    common = scene.common_color_map
    if common is None:
        return None
    color_map = scene.color_map(camera)

    def compute() -> AddedColors:
        change = exposure_change(color_map, common)
        identity = torch.eye(3, 4, dtype=torch.float64)
        return AddedColors((identity + change).float().contiguous())

    if color_map is not None and torch.equal(color_map.double(), common):
        return None
    numbers = None if color_map is None else tuple(color_map.flatten().tolist())
    return memo_of(scene.as_recorded).get(("colours that weather adds", numbers), compute)
