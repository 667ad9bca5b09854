"""Lower side of a moving object: a car's wheels stand on the ground, its ends hang over it.

In: the splats of an object. Out: an `Underside`, which tells pixels that show the ground below the
object from pixels that show the object. The shadow below a bumper is as dark as the bumper, so that
no edge of the photo parts them. Caller: `photo_objects`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians

# Quantile of the heights of an object's splats that is its bottom.
LOWEST_QUANTILE = 0.01
# Distance between stations along an object, metres.
STATION_M = 0.25
# Quantile of the heights of a station's splats that is the object's lower side there.
STATION_QUANTILE = 0.05
# Fewest splats of a station that has a height.
MIN_STATION_SPLATS = 8
# Fewest stations of an object whose ends may lie higher than its bottom.
MIN_STATIONS = 6
# Largest height of an end above the bottom, metres.
MAX_OVERHANG_M = 0.4
# Sine of the angle between the view and the object's length from which on its side view counts
# alone. Seen from its ends, the wheels beside a bumper hide the ground below it.
SIDE_VIEW_SINE = 0.5


@dataclass(frozen=True, eq=False)
class Underside:
    """Lower side of an object, as a line along its length."""

    bottom_z_m: float
    """Height of the lowest splats in the world."""
    stations_m: Float[np.ndarray, " K"]
    """Places along the object, in its frame; none where only the bottom is known."""
    heights_m: Float[np.ndarray, " K"]
    """Heights above the bottom at these places, a convex line: straight from wheel to wheel."""
    object_from_world: Float[np.ndarray, "4 4"]
    """Pose of the object."""

    def lowest_at(
        self, rows: np.ndarray, columns: np.ndarray, depths_m: np.ndarray, camera: Camera
    ) -> Float[np.ndarray, "..."]:
        """Return the height in the world below which places in an image are not the object's.

        Args:
            rows: rows of the places, any shape, 0.5 in the middle of the first.
            columns: columns of the places.
            depths_m: z of the object there, metres.
            camera: the camera of the image.
        """
        lowest_m = np.full(depths_m.shape, self.bottom_z_m)
        if not len(self.stations_m):
            return lowest_m
        x = (columns - camera.cx) / camera.fx
        y = (rows - camera.cy) / camera.fy
        object_from_camera = self.object_from_world @ camera.world_from_camera.numpy()
        forward, aside = (a[0] * x + a[1] * y + a[2] for a in object_from_camera[:2, :3])
        along_m = forward * depths_m + object_from_camera[0, 3]
        sine = np.abs(aside) / np.maximum(np.hypot(forward, aside), 1e-9)
        rise_m = np.interp(along_m, self.stations_m, self.heights_m)
        return lowest_m + np.clip(sine / SIDE_VIEW_SINE, 0, 1) * rise_m


def underside_of(
    parts: Sequence[PosedGaussians], world_from_object: Float[np.ndarray, "4 4"] | None = None
) -> Underside:
    """Return the lower side of an object.

    Args:
        parts: its parts, without what lies on them; one at least.
        world_from_object: its pose, x along its length; None takes that of its parts.
    """
    means = [_means_in_world(part) for part in parts]
    bottom_z_m = float(np.quantile(np.concatenate(means)[:, 2], LOWEST_QUANTILE))
    none = np.empty(0)
    if world_from_object is None:
        if len(parts) > 1 or parts[0].world_from_part is None:
            return Underside(bottom_z_m, none, none, np.eye(4))
        world_from_object = parts[0].world_from_part.detach().cpu().double().numpy()
    object_from_world = np.linalg.inv(world_from_object)
    points = np.concatenate(means)
    x_m = points @ object_from_world[0, :3] + object_from_world[0, 3]
    stations_m, lowest_m = _lowest_by_station(x_m, points[:, 2] - bottom_z_m)
    if len(stations_m) < MIN_STATIONS:
        return Underside(bottom_z_m, none, none, object_from_world)
    hull = _lower_hull(stations_m, lowest_m)
    heights_m = np.clip(np.interp(stations_m, stations_m[hull], lowest_m[hull]), 0, MAX_OVERHANG_M)
    return Underside(bottom_z_m, stations_m, heights_m, object_from_world)


def _means_in_world(part: PosedGaussians) -> Float[np.ndarray, "N 3"]:
    """Return the middles of a part's splats in the world."""
    means = part.gaussians.means.detach().cpu().double().numpy()
    if part.world_from_part is None:
        return means
    pose = part.world_from_part.detach().cpu().double().numpy()
    return means @ pose[:3, :3].T + pose[:3, 3]


def _lowest_by_station(
    x_m: Float[np.ndarray, " N"], z_m: Float[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Return the stations that have splats, and the heights of the lower side there."""
    numbers = np.floor(x_m / STATION_M).astype(np.int64)
    order = np.lexsort((z_m, numbers))
    stations, first, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    has_height = counts >= MIN_STATION_SPLATS
    rows = first + np.round(STATION_QUANTILE * (counts - 1)).astype(np.int64)
    return (stations[has_height] + 0.5) * STATION_M, z_m[order][rows[has_height]]


def _lower_hull(x: Float[np.ndarray, " K"], z: Float[np.ndarray, " K"]) -> list[int]:
    """Return the numbers of the points on the lower convex hull; x rises."""
    hull = list[int]()
    for point in range(len(x)):
        while len(hull) >= 2:
            first, middle = hull[-2:]
            turn = (x[middle] - x[first]) * (z[point] - z[first])
            turn -= (z[middle] - z[first]) * (x[point] - x[first])
            if turn > 0:
                break
            hull.pop()
        hull.append(point)
    return hull


def height_numbers(camera: Camera) -> tuple[float, ...]:
    """Return the numbers of `heights_at`: the camera's height, the rise of its axes, its lens."""
    x, y, z = camera.world_from_camera[2, :3].tolist()
    return float(camera.centre[2]), x, y, z, camera.cx, camera.cy, camera.fx, camera.fy


def heights_at(
    pixels: Int64[np.ndarray, " M"], depth_m: float | Float[np.ndarray, " M"], camera: Camera
) -> Float[np.ndarray, " M"]:
    """Return the height in the world of points at a depth in pixels.

    Args:
        pixels: flat indices of pixels.
        depth_m: z of the points, metres.
        camera: the camera of the photo.
    """
    rows, columns = np.divmod(pixels, camera.width)
    eye_z_m, x, y, z, cx, cy, fx, fy = height_numbers(camera)
    rise = x * (columns + 0.5 - cx) / fx + y * (rows + 0.5 - cy) / fy
    return eye_z_m + depth_m * (rise + z)
