"""LiDAR of a drive in Street Gaussians' layout: pointcloud.npz, a ZIP of pickled dictionaries.

    pointcloud[frame]           float [N, 3], vehicle frame at the frame's time
    camera_projection[frame]    int16 [N, 6]: camera, x, y of the first camera that sees the point
                                and of the second; camera -1 for none

The file holds the whole drive, compressed, in no way to get at one frame. It is therefore read
forward, and where reading stopped is kept: frames asked for in their order cost one pass.
"""

from __future__ import annotations

import os
import threading
import zipfile
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from adapters.recorded.byte_cache import ByteCache
from adapters.safe_pickle import check_holds_object, stream_arrays
from augment.errors import AdapterError
from augment.files.pickles import PickleError

FILE = "pointcloud.npz"
_POINTS, _PROJECTIONS = "pointcloud.npy", "camera_projection.npy"
_KEPT_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class PointCloud:
    """points: float64 [N, 3], vehicle frame. projections: int16 [N, 6], or None where the file has
    none."""

    points: np.ndarray
    projections: np.ndarray | None

    @property
    def nbytes(self) -> int:
        return self.points.nbytes + (0 if self.projections is None else self.projections.nbytes)


def read_point_cloud(root: Path, frame: int) -> PointCloud | None:
    """The returns of a frame; None where there is no file, or no such frame in it.

    Raises:
        AdapterError: the file is damaged, asks for anything but arrays, or holds others.
    """
    path = root / FILE
    if not path.exists():
        return None
    with _lock:
        return _reader_of(path).read(frame)


def iterate_point_clouds(root: Path) -> Iterator[tuple[int, PointCloud]]:
    """Frame number and returns of every frame, in the file's order; nothing without the file.

    Raises:
        AdapterError: as for read_point_cloud.
    """
    path = root / FILE
    if path.exists():
        yield from _clouds(path)


class _Reader:
    """One file being read forward, and the frames that were last passed by."""

    def __init__(self, path: Path, state: tuple[int, ...]) -> None:
        self.path = path
        self.state = state
        self._recent: ByteCache[PointCloud] = ByteCache(_KEPT_BYTES)
        self._all: frozenset[int] | None = None  # frames of the file, known after a whole pass
        self._passed: set[int] = set()
        self._clouds = _clouds(path)

    def read(self, frame: int) -> PointCloud | None:
        found = self._recent.get(frame)
        if found is not None:
            return found
        if self._all is not None and frame not in self._all:
            return None
        if frame in self._passed:
            self.close()
        try:
            for number, cloud in self._clouds:
                self._passed.add(number)
                self._recent.put(number, cloud, cloud.nbytes)
                if number == frame:
                    return cloud
        except BaseException:
            self.close()
            raise
        self._all = frozenset(self._passed)
        self.close()
        return None

    def close(self) -> None:
        """Leave the file; the next reading starts at its beginning."""
        self._clouds.close()
        self._clouds = _clouds(self.path)
        self._passed = set()


_lock = threading.Lock()
_readers: list[_Reader] = []  # of the file last read from


def _reader_of(path: Path) -> _Reader:
    stat = path.stat()
    # A forked process shares its parent's place in an open file: it opens the file itself.
    state = (stat.st_mtime_ns, stat.st_size, os.getpid())
    if not _readers or (_readers[0].path, _readers[0].state) != (path, state):
        for reader in _readers:
            reader.close()
        _readers[:] = [_Reader(path, state)]
    return _readers[0]


def _clouds(path: Path) -> Generator[tuple[int, PointCloud]]:
    """Every frame of the file."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if _POINTS not in names:
                raise AdapterError(
                    f"{path} must hold the arrays pointcloud and camera_projection; it holds "
                    f"{names[:5]}"
                )
            with archive.open(_POINTS) as points:
                if _PROJECTIONS not in names:
                    yield from _checked(path, _entries(path, _POINTS, points), None)
                    return
                with archive.open(_PROJECTIONS) as projections:
                    yield from _checked(
                        path,
                        _entries(path, _POINTS, points),
                        _entries(path, _PROJECTIONS, projections),
                    )
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise AdapterError(
            f"{path} is no whole .npz file of dictionaries ({error}); copy it again"
        ) from error
    except OSError as error:
        raise AdapterError(f"{path} cannot be read: {error}") from error


def _entries(path: Path, member: str, file: BinaryIO) -> Iterator[tuple[int, np.ndarray]]:
    where = f"{path}, {member}"
    try:
        check_holds_object(file)
        yield from stream_arrays(file)
    except PickleError as error:
        raise AdapterError(
            f"{where} was not read: {error}. Only a dictionary of arrays of numbers by frame is "
            f"accepted"
        ) from None


def _checked(
    path: Path,
    points: Iterator[tuple[int, np.ndarray]],
    projections: Iterator[tuple[int, np.ndarray]] | None,
) -> Iterator[tuple[int, PointCloud]]:
    for frame, xyz in points:
        if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
            raise AdapterError(
                f"{path}: pointcloud[{frame}] must be floats [N, 3]; got {xyz.dtype} "
                f"{list(xyz.shape)}"
            )
        seen = None
        if projections is not None:
            number, seen = next(projections, (None, None))
            if number != frame:
                raise AdapterError(
                    f"{path}: pointcloud and camera_projection must hold the same frames in the "
                    f"same order; got {frame} and {number}"
                )
            if seen.shape != (len(xyz), 6) or seen.dtype.kind not in "iu":
                raise AdapterError(
                    f"{path}: camera_projection[{frame}] must be whole numbers [{len(xyz)}, 6], a "
                    f"row for each point; got {seen.dtype} {list(seen.shape)}"
                )
            seen = seen.astype(np.int16)
        yield frame, PointCloud(xyz.astype(np.float64), seen)
