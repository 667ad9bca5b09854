"""Where a camera sees a level plane, and the camera mirrored in it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from augment.cameras import Camera
from augment.geometry import any_in_squares, rigid

# ---- Which rays meet the plane -------------------------------------------------------------------


def image_coordinates(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Of columns [W] and rows [H] at unit depth, float64, rounded as in `ray_directions`."""
    u = (np.arange(camera.width, dtype=np.float64) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height, dtype=np.float64) + 0.5 - camera.cy) / camera.fy
    return u, v


def ray_z(camera: Camera, device: torch.device | None = None) -> Float[Tensor, "H W"]:
    """World z of `Camera.ray_directions`, float64, to the bit: its sign says who sees water."""
    u, v = (torch.from_numpy(part).to(device) for part in image_coordinates(camera))
    right, down, ahead = camera.world_from_camera[2, :3].tolist()
    return (u * right + (v * down)[:, None]) + ahead


def falling(camera: Camera, device: torch.device | None = None) -> Bool[Tensor, "H W"]:
    """Whose rays meet a level plane somewhere below the eye."""
    return ray_z(camera, device) < 0


def plane_depth(
    camera: Camera, level_z_m: float, device: torch.device | None = None
) -> Float[Tensor, "H W"]:
    """z in metres, float64, at which pixels' rays meet the plane before the eye; else infinite."""
    height = float(camera.centre[2]) - level_z_m
    fall = -ray_z(camera, device)
    meets = fall > 0 if height > 0 else fall < 0
    depth = height / torch.where(meets, fall, torch.ones_like(fall))
    return torch.where(meets, depth, torch.full_like(depth, math.inf))


# ---- Windows of an image -------------------------------------------------------------------------

GRAIN = 16  # pixels a side of the squares that masks are grown in


@dataclass(frozen=True)
class Margins:
    """Pixels on each side."""

    left: int
    top: int
    right: int
    bottom: int

    def around(self, mask: Bool[Tensor, "h w"], reach: Margins) -> Bool[Tensor, "H W"]:
        """A window's mask as one of the grown window, grown by the reach in whole squares."""
        left, up, right, down = (-(-side // GRAIN) for side in dataclasses.astuple(reach))
        high = mask.shape[0] + self.top + self.bottom
        wide = mask.shape[1] + self.left + self.right
        rows = -(-high // GRAIN)
        columns = -(-wide // GRAIN)
        inside = np.zeros((high, wide), bool)
        inside[self.top :, self.left :][: mask.shape[0], : mask.shape[1]] = mask.cpu().numpy()
        coarse = np.pad(any_in_squares(inside, GRAIN), ((down, up), (right, left)))
        coarse = np.any([coarse[k : k + rows] for k in range(up + down + 1)], 0)
        coarse = np.any([coarse[:, k : k + columns] for k in range(left + right + 1)], 0)
        fine = np.repeat(np.repeat(coarse, GRAIN, 0), GRAIN, 1)[:high, :wide]
        return torch.from_numpy(np.ascontiguousarray(fine)).to(mask.device)


@dataclass(frozen=True)
class Window:
    """Columns left to right - 1 and rows top to bottom - 1 of an image; may reach beyond it."""

    left: int
    top: int
    right: int
    bottom: int

    def of(self, camera: Camera) -> Camera:
        """The camera's view through this window."""
        return camera.cropped(self.left, self.top, self.right - self.left, self.bottom - self.top)

    def grown(self, margins: Margins) -> Window:
        """The window with margins around it."""
        return Window(
            self.left - margins.left,
            self.top - margins.top,
            self.right + margins.right,
            self.bottom + margins.bottom,
        )

    def overlap(self, image: Tensor) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """(rows, columns) of what the window shares with an image [H, W, ...]: in it, in itself."""
        height, width = image.shape[:2]
        rows = slice(max(self.top, 0), min(self.bottom, height))
        columns = slice(max(self.left, 0), min(self.right, width))
        own_rows = slice(rows.start - self.top, rows.stop - self.top)
        own_columns = slice(columns.start - self.left, columns.stop - self.left)
        return (rows, columns), (own_rows, own_columns)

    def paste(self, into: Tensor, values: Tensor) -> None:
        """Write those of the window's pixels [h, w, ...] that lie in the image [H, W, ...]."""
        here, there = self.overlap(into)
        into[here] = values[there]

    def cut(self, image: Tensor) -> Tensor:
        """The window's pixels of an image [H, W, ...] that contains it."""
        return image[self.top : self.bottom, self.left : self.right]


def window_offset(outer: Camera, inner: Camera) -> tuple[int, int]:
    """(left, top) of the window `inner` of an image in the window `outer`, pixels.

    Raises:
        ValueError: they are not windows of one image.
    """
    left = outer.cx - inner.cx
    top = outer.cy - inner.cy
    focal = max(abs(outer.fx / inner.fx - 1), abs(outer.fy / inner.fy - 1))
    apart = float((outer.camera_from_world - inner.camera_from_world).abs().max())
    off_grid = max(abs(left - round(left)), abs(top - round(top)))
    if focal > 1e-9 or apart > 1e-6 or off_grid > 1e-3:
        raise ValueError(
            f"cameras {outer.name!r} and {inner.name!r} must be windows of one image; focal "
            f"lengths differ by a factor of {1 + focal:.6g}, poses by {apart:.3g}, offsets are "
            f"({left:.6g}, {top:.6g}) pixels"
        )
    return round(left), round(top)


def places_in(outer: Camera, inner: Camera) -> Float64[np.ndarray, "4"]:
    """Of the same eye's image in other pixels: scale and offset of columns, then those of rows.

    A place x in the window `inner` is one at scale x + offset in `outer`.

    Raises:
        ValueError: they do not look the same way.
    """
    apart = float((outer.camera_from_world - inner.camera_from_world).abs().max())
    if apart > 1e-6:
        raise ValueError(
            f"cameras {outer.name!r} and {inner.name!r} must be windows of one image; their poses "
            f"differ by {apart:.3g}"
        )
    right = outer.fx / inner.fx
    down = outer.fy / inner.fy
    return np.array([right, outer.cx - right * inner.cx, down, outer.cy - down * inner.cy])


def plane_window(camera: Camera, level_z_m: float) -> Window | None:
    """The least window with all pixels whose rays meet the plane; None where no ray does.

    A ray meets the plane where it falls, from an eye above it, or rises, from one in or below it.
    """
    side = -1.0 if float(camera.centre[2]) > level_z_m else 1.0
    # World z along the camera's axes: of a ray it is linear in column and row.
    right, down, ahead = (side * v for v in camera.camera_from_world[:3, 2].tolist())
    from_columns = _most(right / camera.fx, camera.width, camera.cx)
    from_rows = _most(down / camera.fy, camera.height, camera.cy)
    columns = _span(right / camera.fx, from_rows + ahead, camera.width, camera.cx)
    rows = _span(down / camera.fy, from_columns + ahead, camera.height, camera.cy)
    if columns is None or rows is None:
        return None
    return Window(columns[0], rows[0], columns[1], rows[1])


def _most(slope: float, size: int, centre: float) -> float:
    """The largest slope (i + 0.5 - centre) over the pixels i."""
    return max(slope * (0.5 - centre), slope * (size - 0.5 - centre))


def _span(slope: float, best: float, size: int, centre: float) -> tuple[int, int] | None:
    """First and one past the last i with slope (i + 0.5 - centre) + best > 0 in [0, size)."""
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
    """The camera whose pictures are the reflections that `camera` sees in the plane.

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
    """The mask at a camera's smaller size: true where any of a pixel is."""
    if mask.device.type != "cpu":
        wide = mask.float()[None, None]
        size = (camera.height, camera.width)
        return torch.nn.functional.adaptive_max_pool2d(wide, size)[0, 0] > 0
    size = (camera.width, camera.height)
    share = cv2.resize(mask.float().numpy(), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(share > 0).reshape(camera.height, camera.width)


def mirrored_window(window: Window, camera: Camera) -> Window:
    """Where the reflections of a window's pixels stand in the mirrored camera's image."""
    top = camera.height - window.bottom
    bottom = camera.height - window.top
    return Window(window.left, top, window.right, bottom)
