"""Depth of image pixels from a LiDAR sweep, and the time of each return.

The callers are `adapters.training_views` and `adapters.recording`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.lidar_scene.split import FLOOR_M, SKIN_M, Motion, inside_box
from augment.errors import AdapterError
from augment.scene.cameras import Camera
from augment.scene.labels import EGO_VEHICLE, ClassifiesLidar, LidarSweep
from augment.scene.scene import Scene

_NEAR_M = 0.1  # smallest depth of a return that a camera sees
# Difference from the frame's time beyond which a sweep's times count from some other start.
_SAME_DRIVE_NS = 10_000_000_000


def sweep_times(sweep: LidarSweep, frame_ns: int) -> np.ndarray | None:
    """Return the time of each return in nanoseconds, int64 [N].

    It is read from the column timestamp_ns, or t in seconds. The result is None without either,
    with gaps in t, or if the times do not belong to the drive of frame_ns (such as times from a
    sweep's start).

    Raises:
        ValueError: timestamp_ns holds anything but whole numbers or dates.
    """
    times = sweep.columns.get("timestamp_ns")
    if times is None:
        seconds = sweep.columns.get("t")
        if seconds is None or seconds.dtype.kind not in "fiu" or not np.isfinite(seconds).all():
            return None
        # Beyond 9e9 s int64 has no nanoseconds; such times are no times of this drive either.
        times = np.round(seconds.astype(np.float64).clip(-9e9, 9e9) * 1e9)
    times = whole_numbers(times, "timestamp_ns")
    near = len(times) == 0 or abs(int(np.median(times)) - frame_ns) <= _SAME_DRIVE_NS
    return times if near else None


def whole_numbers(column: np.ndarray, name: str) -> np.ndarray:
    """Return a column of whole numbers, or of dates (nanoseconds since 1970), as int64.

    Raises:
        ValueError: the column holds anything else, or gaps.
    """
    if len(column) == 0:  # Arrow's type of an empty column may be anything
        return np.zeros(0, np.int64)
    if column.dtype.kind == "M" and not np.isnat(column).any():
        return column.astype("datetime64[ns]").astype(np.int64)
    is_whole = column.dtype.kind in "iu" or (
        column.dtype.kind == "f" and np.isfinite(column).all() and (column % 1 == 0).all()
    )
    if not is_whole:
        raise ValueError(
            f"column {name} must hold whole numbers without gaps; it is {column.dtype}"
        )
    if max(abs(float(column.min())), abs(float(column.max()))) > 2**62:
        raise ValueError(
            f"column {name} must hold numbers from -2^62 to 2^62; it holds {column.min()} to "
            f"{column.max()}"
        )
    return column.astype(np.int64)


@dataclass(frozen=True, eq=False)
class DepthPixels:
    """Measured depth at M pixels of one image.

    Attributes:
        pixels: int32 [M], flat indices (row W + column), increasing.
        depth_m: float32 [M], along the optical axis.
        weight: float32 [M], how much each depth is trusted.
    """

    pixels: np.ndarray
    depth_m: np.ndarray
    weight: np.ndarray

    def __len__(self) -> int:
        return len(self.pixels)

    @staticmethod
    def of(pixels: np.ndarray, depth_m: np.ndarray, weight: float = 1.0) -> DepthPixels:
        """Return the depths of pixels in any order.

        Of a pixel that comes several times, the nearest counts.
        """
        return DepthPixels._at(_nearest_of_each(pixels, depth_m), pixels, depth_m, weight)

    @staticmethod
    def _at(
        index: np.ndarray, pixels: np.ndarray, depth_m: np.ndarray, weight: float
    ) -> DepthPixels:
        return DepthPixels(
            pixels[index].astype(np.int32),
            depth_m[index].astype(np.float32),
            np.full(len(index), weight, np.float32),
        )

    def select(self, keep: np.ndarray) -> DepthPixels:
        return DepthPixels(self.pixels[keep], self.depth_m[keep], self.weight[keep])

    def image(self, camera: Camera) -> np.ndarray:
        """Return the depths as an image, float32 [H, W], 0 where unknown."""
        out = np.zeros((camera.height, camera.width), np.float32)
        out.reshape(-1)[self.pixels] = self.depth_m
        return out


def _nearest_of_each(pixels: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Return the indices of the nearest depth of each pixel, in order of pixels.

    Of equal ones the first.
    """
    order = np.lexsort((depth_m, pixels))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(pixels[order]) > 0
    return order[first]


def project_points(
    points: np.ndarray, camera: Camera, *, near_m: float, margin_px: int = 0
) -> tuple[DepthPixels, np.ndarray]:
    """Project points [N, 3] beyond near_m into the camera, and return their depths and indices.

    Of each pixel the nearest point is kept; none within margin_px of the image's border. A pixel
    may show the depth of something that a nearer object hides from the camera.
    """
    transform = camera.camera_from_world.numpy()
    local = points @ transform[:3, :3].T + transform[:3, 3]
    index = np.flatnonzero(local[:, 2] > near_m)
    x, y, z = local[index].T
    u = np.floor(camera.fx * x / z + camera.cx)
    v = np.floor(camera.fy * y / z + camera.cy)
    inside = (u >= margin_px) & (u < camera.width - margin_px)
    inside &= (v >= margin_px) & (v < camera.height - margin_px)
    u = u[inside].astype(np.int64)
    v = v[inside].astype(np.int64)
    z = z[inside]
    index = index[inside]
    pixels = v * camera.width + u
    nearest = _nearest_of_each(pixels, z)
    return DepthPixels._at(nearest, pixels, z, 1.0), index[nearest]


@dataclass(frozen=True, eq=False)
class FrameReturns:
    """A frame's sweep, prepared for all cameras of the frame.

    Attributes:
        points: float64 [N, 3], scene world, as the LiDAR saw them.
        timestamps_ns: int64 [N].
        carried: for each actor with returns, its motion, the indices of its returns, and their
            places in its own frame.
    """

    points: np.ndarray
    timestamps_ns: np.ndarray
    carried: tuple[tuple[Motion, np.ndarray, np.ndarray], ...]

    def seen_by(self, camera: Camera) -> DepthPixels:
        """Return the sweep as the camera would see it.

        Returns on a moving object are carried along its track to the camera's time, and left out if
        it does not exist then. The lowest FLOOR_M of its box counts as ground.
        """
        points = self.points.copy()
        present = np.ones(len(points), dtype=bool)
        for motion, index, local in self.carried:
            pose = motion.pose_at(camera.timestamp_ns)
            if pose is None:
                present[index] = False
            else:
                points[index] = local @ pose[:3, :3].T + pose[:3, 3]
        return project_points(points[present], camera, near_m=_NEAR_M)[0]


def read_returns(
    scene: Scene, frame_index: int, *, of_surfaces: bool = False
) -> FrameReturns | None:
    """Read the frame's sweep. None without one.

    of_surfaces: if True, returns that no surface made, such as mirror images, are left out, if the
    labels tell them.
    """
    sweep = scene.lidar(frame_index)
    if sweep is None:
        return None
    points = sweep.points_m - scene.world_origin_m
    frame_ns = scene.frame(frame_index).timestamp_ns
    try:
        times = sweep_times(sweep, frame_ns)
    except ValueError as error:
        raise AdapterError(f"frame {frame_index}: its sweep's {error}") from None
    if times is None:
        times = np.full(len(sweep), frame_ns, np.int64)
    keep = np.isfinite(points).all(axis=1)
    if of_surfaces and isinstance(scene.labels, ClassifiesLidar):
        classes = scene.labels.lidar_classes(sweep)
        keep &= True if classes is None else classes >= 0
    points = points[keep]
    times = times[keep]
    carried = []
    for actor in scene.actors:
        if actor.label == EGO_VEHICLE:
            continue
        motion = Motion.of(actor.track)
        size_m = np.array(actor.size_m)
        near = motion.near(points, times, size_m)
        local = motion.into_actor(points[near], times[near])
        is_actor = inside_box(local, size_m, SKIN_M) & (local[:, 2] > FLOOR_M - size_m[2] / 2)
        if is_actor.any():
            carried.append((motion, near[is_actor], local[is_actor]))
    return FrameReturns(points, times, tuple(carried))
