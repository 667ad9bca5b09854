"""What a LiDAR sweep says of the depth at an image's pixels, and when each return was measured."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from adapters.lidar_scene.split import FLOOR_M, SKIN_M, Motion, inside_box
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.labels import EGO_VEHICLE, LidarSweep
from augment.scene import Scene

_NEAR_M = 0.1
_SAME_DRIVE_NS = 10_000_000_000  # times further from the frame's count from some other start


def sweep_times(sweep: LidarSweep, frame_ns: int) -> np.ndarray | None:
    """int64 [N] nanoseconds from the column timestamp_ns, or t in seconds; None without either,
    with gaps in t, or where the times are not of the drive of frame_ns (as those from a sweep's
    start).

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
    """A column of whole numbers, or of dates (nanoseconds since 1970), as int64; ValueError for
    anything else, or gaps."""
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


def project_points(
    points: np.ndarray, camera: Camera, *, near_m: float, margin_px: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the points [N, 3] beyond near_m that the camera sees, not within margin_px of its
    border; their columns and rows, int64 [M]; and depths, float64 [M]."""
    transform = camera.camera_from_world.numpy()
    local = points @ transform[:3, :3].T + transform[:3, 3]
    index = np.flatnonzero(local[:, 2] > near_m)
    x, y, z = local[index].T
    u, v = np.floor(camera.fx * x / z + camera.cx), np.floor(camera.fy * y / z + camera.cy)
    inside = (u >= margin_px) & (u < camera.width - margin_px)
    inside &= (v >= margin_px) & (v < camera.height - margin_px)
    return index[inside], u[inside].astype(np.int64), v[inside].astype(np.int64), z[inside]


def nearest_of_each(pixels: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Indices of the nearest of each pixel, in order of pixels; of equal depths the first."""
    order = np.lexsort((depth_m, pixels))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(pixels[order]) > 0
    return order[first]


@dataclass(frozen=True, eq=False)
class SparseDepth:
    """Depth at M pixels of one image, at most one a pixel, by rows. uv: int32 [M, 2], column and
    row. depth_m: float32 [M], along the optical axis. timestamp_ns: int64 [M], of the return."""

    uv: np.ndarray
    depth_m: np.ndarray
    timestamp_ns: np.ndarray

    def __len__(self) -> int:
        return len(self.depth_m)


@dataclass(frozen=True, eq=False)
class FrameReturns:
    """A frame's sweep, ready to be seen by any camera of the frame.

    points: float64 [N, 3], scene world, as the LiDAR saw them. timestamps_ns: int64 [N].
    carried: for each actor that has any, its motion, the indices of its returns, and their places
    in its own frame."""

    points: np.ndarray
    timestamps_ns: np.ndarray
    carried: tuple[tuple[Motion, np.ndarray, np.ndarray], ...]


def lidar_depth(scene: Scene, frame_index: int, camera: Camera) -> SparseDepth:
    """The frame's sweep as the camera would see it, the nearest return of each pixel; none without.

    Returns on a moving object are carried along its track to the camera's time, and left out if it
    is not there then; the lowest FLOOR_M of its box counts as ground. A pixel may show the depth of
    something that a nearer object hides from the camera."""
    returns = read_returns(scene, frame_index)
    if returns is None:
        return SparseDepth(np.zeros((0, 2), np.int32), np.zeros(0, np.float32), np.zeros(0, int))
    return depth_seen(returns, camera)


def read_returns(
    scene: Scene, frame_index: int, *, without_semantic: Collection[int] = ()
) -> FrameReturns | None:
    """The part of `lidar_depth` that all cameras of a frame share; None without a sweep.
    without_semantic: class numbers of returns that are no surface, such as mirror images."""
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
    if without_semantic and "semantic" in sweep.columns:
        keep &= ~np.isin(sweep.columns["semantic"], list(without_semantic))
    points, times = points[keep], times[keep]
    carried = []
    for actor in scene.actors:
        if actor.label == EGO_VEHICLE:
            continue
        motion, size_m = Motion.of(actor.track), np.array(actor.size_m)
        near = motion.near(points, times, size_m)
        local = motion.into_actor(points[near], times[near])
        own = inside_box(local, size_m, SKIN_M) & (local[:, 2] > FLOOR_M - size_m[2] / 2)
        if own.any():
            carried.append((motion, near[own], local[own]))
    return FrameReturns(points, times, tuple(carried))


def depth_seen(returns: FrameReturns, camera: Camera) -> SparseDepth:
    """The part of `lidar_depth` that is the camera's own."""
    points = returns.points.copy()
    present = np.ones(len(points), dtype=bool)
    for motion, own, local in returns.carried:
        pose = motion.pose_at(camera.timestamp_ns)
        if pose is None:
            present[own] = False
        else:
            points[own] = local @ pose[:3, :3].T + pose[:3, 3]
    seen, u, v, z = project_points(points[present], camera, near_m=_NEAR_M)
    depth_m, uv = z.astype(np.float32), np.stack([u, v], 1).astype(np.int32)
    chosen = nearest_of_each(v * camera.width + u, depth_m)
    times = returns.timestamps_ns[present][seen]
    return SparseDepth(uv[chosen], depth_m[chosen], times[chosen])
