"""Cameras (pinhole, with a lens, orthographic), and the frames of a drive.

Adapters build `Camera` and `Frame`; every other module reads them. `check_lens` refuses intrinsics
that effects and kernels are not made for.
"""

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
from augment.scene.geometry import invert_rigid
from augment.scene.lenses import Intrinsics, Lens
from augment.scene.shutter import RollingShutter

# Field of view over the longer side of the image, at least (docs/stability.md).
MIN_FIELD_OF_VIEW_DEG = 1.0
# Field of view over the longer side of the image, at most.
MAX_FIELD_OF_VIEW_DEG = 170.0
# Distance of the principal point from the image's centre, at most, in longer sides of the image.
MAX_CENTRE_OFFSET = 10
# Part of a limit by which a camera may be beyond it.
_ROUNDING = 1e-6


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Return width and height at another resolution, rounded, at least 1 pixel."""
    return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera at one instant. OpenCV axes: x right, y down, z forward; pixel centres +0.5.

    A pinhole camera shows the point (x, y, z) at pixel (fx x / z + cx, fy y / z + cy). An
    orthographic one, whose rays are parallel, shows it at (fx x + cx, fy y + cy). For both, depth
    is z. A camera with a lens shows it where the lens says (`augment.scene.lenses`); its depth is z
    or the distance along the ray, as the lens says. Code for pinhole cameras refuses the others:
    `augment.view.lens_view` draws pinhole views and brings their pictures to the lens's pixels.
    """

    name: str
    """Name of the camera in its scene."""
    width: int
    """Width of the image, pixels."""
    height: int
    """Height of the image, pixels."""
    fx: float
    """Focal length along x, pixels; pixels per metre for an orthographic camera."""
    fy: float
    """Focal length along y, in the same units."""
    cx: float
    """Column of the principal point, pixels."""
    cy: float
    """Row of the principal point, pixels."""
    camera_from_world: Float[Tensor, "4 4"]
    """Pose, float64 [4, 4], rigid."""
    timestamp_ns: int = 0
    """Moment at which the image was taken, which poses the actors."""
    is_orthographic: bool = False
    """If True, rays are parallel, for maps seen from above; weather, labels and training know
    pinhole cameras only."""
    lens: Lens | None = None
    """Lens in front of the image; None for a pinhole."""
    shutter: RollingShutter | None = None
    """Read-out of the rows while the camera moves; None if all are exposed at `timestamp_ns`. With
    a shutter, pose and timestamp are those of the middle of the read-out."""

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
        if self.is_orthographic and (self.lens is not None or self.shutter is not None):
            raise ValueError(
                f"camera {self.name!r}: an orthographic camera has neither lens nor shutter; "
                f"got {self.lens} and {self.shutter}"
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
    def intrinsics(self) -> Intrinsics:
        """Return focal lengths and principal point, pixels, as lenses take them."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy)

    @property
    def is_pinhole(self) -> bool:
        """Return True for a camera that the rasteriser can draw in perspective as it is."""
        return not self.is_orthographic and self.lens is None and self.shutter is None

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Return the intrinsic matrix of a pinhole camera, float64."""
        self._check_pinhole("an intrinsic matrix")
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    @functools.cached_property
    def world_from_camera(self) -> Float[Tensor, "4 4"]:
        """Return the inverse of camera_from_world."""
        return invert_rigid(self.camera_from_world)

    @functools.cached_property
    def centre(self) -> Float[Tensor, "3"]:
        """Return the optical centre in the world, metres, float64.

        Depth is 0 there. For an orthographic camera, it is where the ray through (cx, cy) begins.
        """
        return self.world_from_camera[:3, 3]

    def scaled(self, scale: float) -> Camera:
        """Return the same view at another resolution; sides are rounded, at least 1 px."""
        if not (math.isfinite(scale) and scale > 0):
            raise ValueError(f"scale must be a finite number > 0; got {scale}")
        if scale == 1:
            return self
        return self.resized(*scaled_size(self.width, self.height, scale))

    def resized(self, width: int, height: int) -> Camera:
        """Return the same view in an image of another size, squeezed where its shape is another."""
        sx = width / self.width
        sy = height / self.height
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
        """Return the view through a window of the image, whose pixels keep their rays.

        The window may reach beyond the image's borders.

        Args:
            left: column of the window's first pixel.
            top: row of the window's first pixel.
            width: width of the window, pixels.
            height: height of the window, pixels.
        """
        shutter = self.shutter
        if shutter is not None:
            shutter = shutter.cropped(left, top, (width, height), (self.width, self.height))
        return dataclasses.replace(
            self, width=width, height=height, cx=self.cx - left, cy=self.cy - top, shutter=shutter
        )

    def without_lens(self) -> Camera:
        """Return the pinhole camera with the same pose and intrinsics: no lens, no shutter."""
        if self.lens is None and self.shutter is None:
            return self
        return dataclasses.replace(self, lens=None, shutter=None)

    def at_read_out(self, share: float) -> Camera:
        """Return the camera, without its shutter, at a share of the read-out.

        Args:
            share: 0 at the start, 0.5 at the middle, 1 at the end.
        """
        shutter = self.shutter
        if shutter is None:
            return self
        return dataclasses.replace(
            self,
            camera_from_world=shutter.camera_at(share, self.camera_from_world),
            timestamp_ns=self.timestamp_ns + shutter.time_at_ns(share),
            shutter=None,
        )

    def ray_directions(
        self, dtype: torch.dtype = torch.float32, device: torch.device | None = None
    ) -> Float[Tensor, "H W 3"]:
        """Return world directions through the pixel centres with unit z in the camera (not unit
        length).

        A point at depth z along pixel p is `centre + z * ray_directions()[p]`; its ray distance is
        `z * norm(ray_directions()[p])`.

        Args:
            dtype: dtype of the result.
            device: device of the result; None for the CPU.

        Raises:
            ValueError: the camera is no pinhole.
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
        """Return the ray distance per unit of depth at each pixel, sqrt(1 + u^2 + v^2).

        Args:
            dtype: dtype of the result.
            device: device of the result; None for the CPU.

        Raises:
            ValueError: the camera is no pinhole.
        """
        self._check_pinhole("ray lengths that differ")
        u, v = self._slopes(device)
        return torch.sqrt(1 + u[None, :] ** 2 + v[:, None] ** 2).to(dtype)

    def _slopes(self, device: torch.device | None) -> tuple[Float[Tensor, "W"], Float[Tensor, "H"]]:
        """Return x / z of every column's rays and y / z of every row's, float64."""
        columns = torch.arange(self.width, dtype=torch.float64, device=device)
        rows = torch.arange(self.height, dtype=torch.float64, device=device)
        return (columns + 0.5 - self.cx) / self.fx, (rows + 0.5 - self.cy) / self.fy

    def _unit(self, name: str) -> str:
        """Return the unit of an intrinsic number."""
        return "pixels per metre" if self.is_orthographic and name[0] == "f" else "pixels"

    def check_no_lens(self, purpose: str) -> None:
        """Refuse a camera with a lens or a shutter, for code that draws with straight rays only.

        Args:
            purpose: ends the sentence "has a lens and cannot be used for ...".

        Raises:
            ValueError: the camera has a lens or a shutter.
        """
        if self.lens is None and self.shutter is None:
            return
        part = "a rolling shutter" if self.lens is None else f"a lens ({type(self.lens).__name__})"
        raise ValueError(
            f"camera {self.name!r} has {part} and cannot be used for {purpose}; expected a camera "
            "without lens and shutter. Draw its pinhole views (augment.view.lens_view does so for "
            "views in weather), or take camera.without_lens() where the distortion does not matter"
        )

    def _check_pinhole(self, property_name: str) -> None:
        """Raise ValueError if the camera is orthographic, or has a lens or a shutter."""
        self.check_no_lens(f"{property_name} of a pinhole camera")
        if self.is_orthographic:
            raise ValueError(
                f"camera {self.name!r} is orthographic and has not {property_name}: its rays are "
                f"parallel, along world_from_camera[:3, 2]; use a pinhole camera here"
            )


def check_lens(camera: Camera, where: str) -> None:
    """Refuse a pinhole camera beyond the limits that effects and kernels are made for.

    Windows of an image and the views that effects draw for themselves are not checked.

    Args:
        camera: the camera, as a dataset, a camera path or a caller states it.
        where: names the camera in the message.

    Raises:
        SceneError: over the longer side of the image, fx or fy sees less than MIN_FIELD_OF_VIEW_DEG
            or more than MAX_FIELD_OF_VIEW_DEG; or the principal point lies further from the image's
            centre than MAX_CENTRE_OFFSET longer sides.
    """
    if camera.is_orthographic:
        return
    size = f"{camera.width}x{camera.height}"
    side_px = max(camera.width, camera.height)
    hint = "Check the intrinsics, their unit (pixels), and that they are of images of this size"
    min_focal_px, max_focal_px = (
        side_px / (2 * math.tan(math.radians(angle_deg) / 2))
        for angle_deg in (MAX_FIELD_OF_VIEW_DEG, MIN_FIELD_OF_VIEW_DEG)
    )
    for name, focal_px in (("fx", camera.fx), ("fy", camera.fy)):
        if not min_focal_px * (1 - _ROUNDING) <= focal_px <= max_focal_px * (1 + _ROUNDING):
            raise SceneError(
                f"{where}: {name} must be from {min_focal_px:.4g} to {max_focal_px:.4g} px in an "
                f"image of {size} (a field of view from {MAX_FIELD_OF_VIEW_DEG:g} to "
                f"{MIN_FIELD_OF_VIEW_DEG:g} degrees over its longer side); got {focal_px:.6g}. "
                f"{hint}"
            )
    max_offset_px = MAX_CENTRE_OFFSET * side_px
    for name, centre_px, length_px in (
        ("cx", camera.cx, camera.width),
        ("cy", camera.cy, camera.height),
    ):
        if not abs(centre_px - length_px / 2) <= max_offset_px * (1 + _ROUNDING):
            raise SceneError(
                f"{where}: {name} must lie within {max_offset_px:g} px of the centre of an image "
                f"of {size}; got {centre_px:.6g}. {hint}"
            )


@dataclass(frozen=True, eq=False)
class Frame:
    """One step of a drive: the cameras as they stood when each took its image.

    Raises:
        SceneError: `check_lens` refuses one of the cameras.
    """

    index: int
    """The dataset's own frame number."""
    timestamp_ns: int
    """Reference time of the frame."""
    world_from_ego: Float[Tensor, "4 4"]
    """Pose of the car, float64 [4, 4]; ego x forward, y left, z up."""
    cameras: Mapping[str, Camera]
    """Cameras of the frame, by name."""
    image_paths: Mapping[str, str] = field(default_factory=dict)
    """Path of the recorded image of each camera that has one (reference only)."""

    def __post_init__(self) -> None:
        for name, camera in self.cameras.items():
            check_lens(camera, f"frame {self.index}, camera {name!r}")
