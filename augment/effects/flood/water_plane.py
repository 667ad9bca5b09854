"""The pixels in which a camera sees a level plane, and the camera mirrored in that plane."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from augment.scene.cameras import Camera
from augment.scene.geometry import any_in_squares, rigid

# ---- Which rays meet the plane -------------------------------------------------------------------


def image_coordinates(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates at unit depth of columns [W] and rows [H].

    They are float64 and rounded as in `Camera.ray_directions`.
    """
    u = (np.arange(camera.width, dtype=np.float64) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height, dtype=np.float64) + 0.5 - camera.cy) / camera.fy
    return u, v


def ray_z(camera: Camera, device: torch.device | None = None) -> Float[Tensor, "H W"]:
    """Return the world z of `Camera.ray_directions`, float64, with the same bits.

    Its sign decides which pixels see water.
    """
    u, v = (torch.from_numpy(part).to(device) for part in image_coordinates(camera))
    right, down, ahead = camera.world_from_camera[2, :3].tolist()
    return (u * right + (v * down)[:, None]) + ahead


def falling(camera: Camera, device: torch.device | None = None) -> Bool[Tensor, "H W"]:
    """Return the mask of pixels whose rays meet a level plane somewhere below the eye."""
    return ray_z(camera, device) < 0


def plane_depth(
    camera: Camera, level_z_m: float, device: torch.device | None = None
) -> Float[Tensor, "H W"]:
    """Return the depth z at which each pixel's ray meets the plane, float64, metres.

    It is infinite where the ray does not meet the plane in front of the eye.
    """
    height = float(camera.centre[2]) - level_z_m
    fall = -ray_z(camera, device)
    meets = fall > 0 if height > 0 else fall < 0
    depth = height / torch.where(meets, fall, torch.ones_like(fall))
    return torch.where(meets, depth, torch.full_like(depth, math.inf))


# ---- Windows of an image -------------------------------------------------------------------------

GRAIN = 16  # side of the squares in which masks are grown, pixels


@dataclass(frozen=True)
class Margins:
    """Margins around a window, pixels on each side."""

    left: int
    top: int
    right: int
    bottom: int

    def around(self, mask: Bool[Tensor, "h w"], reach: Margins) -> Bool[Tensor, "H W"]:
        """Return a window's mask in the grown window, grown by the reach in whole squares."""
        left, up, right, down = (-(-side // GRAIN) for side in dataclasses.astuple(reach))
        height = mask.shape[0] + self.top + self.bottom
        width = mask.shape[1] + self.left + self.right
        rows = -(-height // GRAIN)
        columns = -(-width // GRAIN)
        inside = np.zeros((height, width), bool)
        inside[self.top :, self.left :][: mask.shape[0], : mask.shape[1]] = mask.cpu().numpy()
        coarse = np.pad(any_in_squares(inside, GRAIN), ((down, up), (right, left)))
        coarse = np.any([coarse[k : k + rows] for k in range(up + down + 1)], 0)
        coarse = np.any([coarse[:, k : k + columns] for k in range(left + right + 1)], 0)
        fine = np.repeat(np.repeat(coarse, GRAIN, 0), GRAIN, 1)[:height, :width]
        return torch.from_numpy(np.ascontiguousarray(fine)).to(mask.device)


@dataclass(frozen=True)
class Window:
    """Columns left to right - 1 and rows top to bottom - 1 of an image.

    A window may reach beyond the image.
    """

    left: int
    top: int
    right: int
    bottom: int

    def of(self, camera: Camera) -> Camera:
        """Return the camera's view through this window."""
        return camera.cropped(self.left, self.top, self.right - self.left, self.bottom - self.top)

    def grown(self, margins: Margins) -> Window:
        """Return the window with margins around it."""
        return Window(
            self.left - margins.left,
            self.top - margins.top,
            self.right + margins.right,
            self.bottom + margins.bottom,
        )

    def overlap(self, image: Tensor) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Return the slices (rows, columns) of the window's overlap with an image [H, W, ...].

        The first pair of slices indexes the image, the second pair the window.
        """
        height, width = image.shape[:2]
        rows = slice(max(self.top, 0), min(self.bottom, height))
        columns = slice(max(self.left, 0), min(self.right, width))
        window_rows = slice(rows.start - self.top, rows.stop - self.top)
        window_columns = slice(columns.start - self.left, columns.stop - self.left)
        return (rows, columns), (window_rows, window_columns)

    def cut(self, image: Tensor) -> Tensor:
        """Return the window's pixels of an image [H, W, ...] that contains it."""
        return image[self.top : self.bottom, self.left : self.right]


def window_offset(outer: Camera, inner: Camera) -> tuple[int, int]:
    """Return (left, top) of the window `inner` in the window `outer` of the same image, pixels.

    Raises:
        ValueError: they are not windows of one image.
    """
    left = outer.cx - inner.cx
    top = outer.cy - inner.cy
    focal_difference = max(abs(outer.fx / inner.fx - 1), abs(outer.fy / inner.fy - 1))
    pose_difference = float((outer.camera_from_world - inner.camera_from_world).abs().max())
    off_grid = max(abs(left - round(left)), abs(top - round(top)))
    if focal_difference > 1e-9 or pose_difference > 1e-6 or off_grid > 1e-3:
        raise ValueError(
            f"cameras {outer.name!r} and {inner.name!r} must be windows of one image; focal "
            f"lengths differ by a factor of {1 + focal_difference:.6g}, poses by "
            f"{pose_difference:.3g}, offsets are ({left:.6g}, {top:.6g}) pixels"
        )
    return round(left), round(top)


def scale_and_offset(outer: Camera, inner: Camera) -> Float64[np.ndarray, "4"]:
    """Return the scale and offset of columns, then of rows, from `inner` to `outer`.

    Both cameras show the same eye's image in different pixels. A coordinate x in `inner` is
    scale x + offset in `outer`.

    Raises:
        ValueError: the cameras' poses differ.
    """
    pose_difference = float((outer.camera_from_world - inner.camera_from_world).abs().max())
    if pose_difference > 1e-6:
        raise ValueError(
            f"cameras {outer.name!r} and {inner.name!r} must be windows of one image; their poses "
            f"differ by {pose_difference:.3g}"
        )
    x_scale = outer.fx / inner.fx
    y_scale = outer.fy / inner.fy
    return np.array(
        [x_scale, outer.cx - x_scale * inner.cx, y_scale, outer.cy - y_scale * inner.cy]
    )


def plane_window(camera: Camera, level_z_m: float) -> Window | None:
    """Return the smallest window with all pixels whose rays meet the plane; None if no ray does.

    From an eye above the plane, falling rays meet it. From an eye in or below it, rising rays do.
    """
    side = -1.0 if float(camera.centre[2]) > level_z_m else 1.0
    # World z along the camera's axes. The world z of a ray is linear in column and row.
    right, down, ahead = (side * v for v in camera.camera_from_world[:3, 2].tolist())
    from_columns = _max_sum(right / camera.fx, camera.width, camera.cx)
    from_rows = _max_sum(down / camera.fy, camera.height, camera.cy)
    columns = _span(right / camera.fx, from_rows + ahead, camera.width, camera.cx)
    rows = _span(down / camera.fy, from_columns + ahead, camera.height, camera.cy)
    if columns is None or rows is None:
        return None
    return Window(columns[0], rows[0], columns[1], rows[1])


def _max_sum(slope: float, size: int, centre: float) -> float:
    """Return the largest slope (i + 0.5 - centre) over the pixels i."""
    return max(slope * (0.5 - centre), slope * (size - 0.5 - centre))


def _span(slope: float, best: float, size: int, centre: float) -> tuple[int, int] | None:
    """Return the first and one past the last i with slope (i + 0.5 - centre) + best > 0.

    i is in [0, size).
    """
    first = 0
    last = size
    if slope == 0:
        return (0, size) if best > 0 else None
    edge = centre - 0.5 - best / slope  # where the sum is zero
    if slope > 0:
        first = max(first, math.floor(max(min(edge, size), -1.0)) + 1)
    else:
        last = min(last, math.ceil(max(min(edge, size), -1.0)))
    return (first, last) if first < last else None


def mirrored_camera(camera: Camera, level_z_m: float) -> Camera:
    """Return the camera whose pictures are the reflections that `camera` sees in the plane.

    Mirroring swaps left- and right-handed axes, so the image is turned upside down too: its pixel
    (column, row) is the reflection in the pixel (column, height - 1 - row).
    """
    mirror = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    flip = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    rotation = flip[:, None] * camera.camera_from_world[:3, :3] * mirror
    eye = camera.centre * mirror
    eye[2] += 2 * level_z_m
    return dataclasses.replace(
        camera, camera_from_world=rigid(rotation, -rotation @ eye), cy=camera.height - camera.cy
    )


def resized(mask: Bool[Tensor, "H W"], camera: Camera) -> Bool[Tensor, "h w"]:
    """Return the mask at a camera's smaller size: True where any part of the pixel is True."""
    if mask.device.type != "cpu":
        image = mask.float()[None, None]
        size = (camera.height, camera.width)
        return torch.nn.functional.adaptive_max_pool2d(image, size)[0, 0] > 0
    size = (camera.width, camera.height)
    share = cv2.resize(mask.float().numpy(), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(share > 0).reshape(camera.height, camera.width)


def mirrored_window(window: Window, camera: Camera) -> Window:
    """Return the window of the mirrored camera's image that holds a window's reflections."""
    top = camera.height - window.bottom
    bottom = camera.height - window.top
    return Window(window.left, top, window.right, bottom)
