"""Which pixels of an image's rows see the water's plane, by float64 once a row.

Whether a ray falls is the sign of a sum that float64 has to decide, and near the horizon the small
fall is what distances are divided by. Along a row the fall is linear in the column, and so the rays
that fall are an interval of columns. Kernels that know it and the fall at its end nearest to the
horizon need no float64: from there the fall only grows, and nothing cancels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Int32, Int64

from augment.cameras import Camera

BEGIN, END, ANCHOR, FALL = range(4)  # of a row's numbers
ROW = 4

Holds = Callable[[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]], Bool[np.ndarray, " n"]]


def falling_rows(camera: Camera) -> Int32[np.ndarray, "H 4"]:
    """Of each row: the first and one past the last column whose rays fall, a column of these, and
    the bits of float32 world z of its ray, the one nearest to zero.

    The signs are those of `Camera.ray_directions` in float64.
    """
    u, v = image_coordinates(camera)
    rise = camera.world_from_camera[2, :3].numpy()

    def fall(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return (u[columns] * rise[0] + v[rows] * rise[1]) + rise[2]

    begin, end = column_intervals(camera, lambda rows, columns: fall(rows, columns) < 0)
    anchor = np.where(rise[0] > 0, np.maximum(end - 1, 0), np.minimum(begin, camera.width - 1))
    out = np.empty((camera.height, ROW), np.int32)
    out[:, BEGIN], out[:, END], out[:, ANCHOR] = begin, end, anchor
    out[:, FALL] = fall(np.arange(camera.height), anchor).astype(np.float32).view(np.int32)
    return out


def image_coordinates(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Of columns [W] and rows [H] at unit depth, float64, rounded as in `ray_directions`."""
    u = (np.arange(camera.width, dtype=np.float64) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height, dtype=np.float64) + 0.5 - camera.cy) / camera.fy
    return u, v


def column_intervals(
    camera: Camera, holds: Holds
) -> tuple[Int64[np.ndarray, " H"], Int64[np.ndarray, " H"]]:
    """First and one past the last column of each row in which something holds; equal where it holds
    in none. holds(rows, columns): in every row true up to some column or from some column on.
    """
    rows, last = np.arange(camera.height), camera.width - 1
    left, right = holds(rows, np.zeros_like(rows)), holds(rows, np.full_like(rows, last))
    begin, end = np.zeros_like(rows), np.where(left & right, camera.width, 0)
    mixed = np.nonzero(left != right)[0]
    if len(mixed):
        low, high = np.zeros_like(mixed), np.full_like(mixed, last)
        for _ in range(last.bit_length()):
            middle = (low + high) // 2
            is_left = holds(mixed, middle) == left[mixed]
            low, high = np.where(is_left, middle, low), np.where(is_left, high, middle)
        begin[mixed] = np.where(left[mixed], 0, high)
        end[mixed] = np.where(left[mixed], high, camera.width)
    return begin, end
