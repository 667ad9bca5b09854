"""Pinhole and orthographic cameras, and the frames of a drive."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.errors import SceneError
from augment.geometry import invert_rigid

MIN_FIELD_OF_VIEW_DEG = 1.0  # over the longer side of the image; docs/stability.md
MAX_FIELD_OF_VIEW_DEG = 170.0
MAX_CENTRE_OFFSET = 10  # longer sides of the image: of the principal point from its centre
_ROUNDING = 1e-6  # part of a focal length by which a camera at a limit may be beyond it


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Width and height at another resolution: rounded, at least 1 pixel."""
    return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera at one instant. OpenCV axes: x right, y down, z forward; pixel centres +0.5.

    A pinhole camera shows the point (x, y, z) at pixel (fx x / z + cx, fy y / z + cy), an
    orthographic one, whose rays are parallel, at (fx x + cx, fy y + cy); for both, depth is z.
    width, height: pixels. fx, fy: pixels, or, of an orthographic camera, pixels per metre. cx, cy:
    pixels. camera_from_world: float64 [4, 4], rigid. timestamp_ns: the moment this image was taken,
    which poses the actors. is_orthographic: for maps seen from above; weather, labels and training
    know pinhole cameras only.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_world: Float[Tensor, "4 4"]
    timestamp_ns: int = 0
    is_orthographic: bool = False

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(
                f"camera {self.name!r}: width and height must be >= 1 px; "
                f"got {self.width}x{self.height}"
            )
        numbers = {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy}
        for name, value in numbers.items():
            if not math.isfinite(value) or (name in ("fx", "fy") and value <= 0):
                raise ValueError(
                    f"camera {self.name!r}: {name} must be finite"
                    f"{' and > 0' if name[0] == 'f' else ''} ({self._unit(name)}); got {value}"
                )
        pose = self.camera_from_world
        if pose.dtype != torch.float64 or tuple(pose.shape) != (4, 4):
            raise ValueError(
                f"camera {self.name!r}: camera_from_world must be float64 [4, 4]; "
                f"got {pose.dtype} {list(pose.shape)}"
            )
        # In numpy: every view of a frame is checked, and torch takes ten times as long for it.
        rotation = pose.detach().numpy()[:3, :3]
        with np.errstate(invalid="ignore"):
            error = np.abs(rotation @ rotation.T - np.eye(3)).max()
            determinant = np.linalg.det(rotation)
        if not error < 1e-4 or determinant < 0:  # `not <` also catches NaN
            raise ValueError(
                f"camera {self.name!r}: camera_from_world must be rigid with determinant +1; "
                f"its rotation is off orthonormal by {error:.3g}, "
                f"determinant {determinant:.3g}"
            )

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix, float64, of a pinhole camera."""
        self._check_pinhole("an intrinsic matrix")
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    @functools.cached_property
    def world_from_camera(self) -> Float[Tensor, "4 4"]:
        return invert_rigid(self.camera_from_world)

    @functools.cached_property
    def centre(self) -> Float[Tensor, "3"]:
        """Optical centre in the world, metres, float64; where depth is 0 and, of an orthographic
        camera, the ray through (cx, cy) begins.
        """
        return self.world_from_camera[:3, 3]

    def scaled(self, scale: float) -> Camera:
        """The same view at another resolution; both image sides are rounded, at least 1 px."""
        if not (math.isfinite(scale) and scale > 0):
            raise ValueError(f"scale must be a finite number > 0; got {scale}")
        if scale == 1:
            return self
        return self.resized(*scaled_size(self.width, self.height, scale))

    def resized(self, width: int, height: int) -> Camera:
        """The same view in an image of another size, squeezed where its shape is another."""
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The view through a window of the image, which may reach beyond its borders; pixels keep
        their rays.
        """
        return dataclasses.replace(
            self, width=width, height=height, cx=self.cx - left, cy=self.cy - top
        )

    def ray_directions(
        self, dtype: torch.dtype = torch.float32, device: torch.device | None = None
    ) -> Float[Tensor, "H W 3"]:
        """World directions through the pixel centres with unit z in the camera (not unit length).

        A point at depth z along pixel p is `centre + z * ray_directions()[p]`; its ray distance is
        `z * norm(ray_directions()[p])`. device: where they are wanted; the CPU if None.

        Raises:
            ValueError: the camera is orthographic.
        """
        self._check_pinhole("rays of its own at every pixel")
        u, v = self._slopes(device)
        rotation = self.world_from_camera[:3, :3].to(u.device)
        rays = (
            u[None, :, None] * rotation[:, 0] + v[:, None, None] * rotation[:, 1] + rotation[:, 2]
        )
        return rays.to(dtype)

    def ray_lengths(
        self, dtype: torch.dtype = torch.float32, device: torch.device | None = None
    ) -> Float[Tensor, "H W"]:
        """Ray distance per unit of depth at each pixel: sqrt(1 + u^2 + v^2).

        Raises:
            ValueError: the camera is orthographic.
        """
        self._check_pinhole("ray lengths that differ")
        u, v = self._slopes(device)
        return torch.sqrt(1 + u[None, :] ** 2 + v[:, None] ** 2).to(dtype)

    def _slopes(self, device: torch.device | None) -> tuple[Float[Tensor, "W"], Float[Tensor, "H"]]:
        """x / z of the rays of every column and y / z of every row, float64."""
        columns = torch.arange(self.width, dtype=torch.float64, device=device)
        rows = torch.arange(self.height, dtype=torch.float64, device=device)
        return (columns + 0.5 - self.cx) / self.fx, (rows + 0.5 - self.cy) / self.fy

    def _unit(self, name: str) -> str:
        return "pixels per metre" if self.is_orthographic and name[0] == "f" else "pixels"

    def _check_pinhole(self, what: str) -> None:
        if self.is_orthographic:
            raise ValueError(
                f"camera {self.name!r} is orthographic and has not {what}: its rays are parallel, "
                f"along world_from_camera[:3, 2]; use a pinhole camera here"
            )


def check_lens(camera: Camera, where: str) -> None:
    """Refuse a pinhole camera beyond the limits that effects and kernels are made for.

    Windows of an image and the views that effects draw for themselves are not asked.

    Args:
        camera: as a dataset, a camera path or a caller states it.
        where: names the camera in the message.

    Raises:
        SceneError: over the longer side of the image, fx or fy sees less than
            MIN_FIELD_OF_VIEW_DEG or more than MAX_FIELD_OF_VIEW_DEG; or the principal point lies
            further from the image's centre than MAX_CENTRE_OFFSET longer sides.
    """
    if camera.is_orthographic:
        return
    size, side_px = f"{camera.width}x{camera.height}", max(camera.width, camera.height)
    hint = "Check the intrinsics, their unit (pixels), and that they are of images of this size"
    shortest, longest = (
        side_px / (2 * math.tan(math.radians(angle_deg) / 2))
        for angle_deg in (MAX_FIELD_OF_VIEW_DEG, MIN_FIELD_OF_VIEW_DEG)
    )
    for name, focal_px in (("fx", camera.fx), ("fy", camera.fy)):
        if not shortest * (1 - _ROUNDING) <= focal_px <= longest * (1 + _ROUNDING):
            raise SceneError(
                f"{where}: {name} must be from {shortest:.4g} to {longest:.4g} px in an image of "
                f"{size} (a field of view from {MAX_FIELD_OF_VIEW_DEG:g} to "
                f"{MIN_FIELD_OF_VIEW_DEG:g} degrees over its longer side); got {focal_px:.6g}. "
                f"{hint}"
            )
    reach_px = MAX_CENTRE_OFFSET * side_px
    for name, middle_px, length_px in (
        ("cx", camera.cx, camera.width),
        ("cy", camera.cy, camera.height),
    ):
        if not abs(middle_px - length_px / 2) <= reach_px * (1 + _ROUNDING):
            raise SceneError(
                f"{where}: {name} must lie within {reach_px:g} px of the centre of an image of "
                f"{size}; got {middle_px:.6g}. {hint}"
            )


@dataclass(frozen=True, eq=False)
class Frame:
    """One step of a drive: the cameras as they stood when each took its image.

    index: the dataset's own frame number. timestamp_ns: the frame's reference time.
    world_from_ego: float64 [4, 4], ego x forward, y left, z up.
    image_paths: the recorded image of each camera where there is one (reference only).

    Raises:
        SceneError: of `check_lens`, for any of the cameras.
    """

    index: int
    timestamp_ns: int
    world_from_ego: Float[Tensor, "4 4"]
    cameras: Mapping[str, Camera]
    image_paths: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, camera in self.cameras.items():
            check_lens(camera, f"frame {self.index}, camera {name!r}")
