"""Finds a scene's exposed surface once. It is remembered while the scene lives, and stored.

`search.find_exposed_surface` does the work. Callers: effects that fall from the sky
(`exposed_surface_of` for pictures and sweeps, `share_exposed_surface` at the start of a job).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from augment.errors import SceneError
from augment.exposure.cells import FLUSH, ExposedCells, ExposedSurface
from augment.exposure.search import ExposureSettings, find_exposed_surface
from augment.exposure.vehicle_cells import parked_vehicles
from augment.memo import memo_of
from augment.output.atomic import write_atomic
from augment.render.buffers import AUTO, CUDA
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Scene

logger = logging.getLogger(__name__)

# Name of the file format. Its number goes up whenever the same scene would give another exposed
# surface, or a file would hold it otherwise.
FORMAT = "climategs-exposed-surface-9"
_METADATA_KEY = "exposed_surface"  # key of the metadata in a file
# Pattern of the names that files had up to version 7 of the format, which nobody reads any more.
# They were named after their first user.
_OLD_FILES = f"snow-{40 * '[0-9a-f]'}.safetensors"
# Types of the fields of ExposedCells other than float32.
_DTYPES = {
    "neighbours": torch.int32,
    "semantic": torch.int16,
    "hideable_ids": torch.int32,
    "covering_cells": torch.int32,
}
# Second dimension of the fields of ExposedCells that have one.
_COLUMNS = {
    "centers_m": 3,
    "normals": 3,
    "neighbours": 4,
    "obstacle_vectors": 2,
    "covering_cells": 5,
}
# Fields of ExposedCells that have a row for each Gaussian that can be hidden, not for each cell.
_FIELDS_OF_GAUSSIANS = ("hideable_ids", "covering_cells")


def exposed_surface_key(
    scene: Scene, cameras: Sequence[Camera], settings: ExposureSettings, *, backend: str = AUTO
) -> str:
    """Return a hex digest of everything that an exposed surface depends on.

    That is Gaussians, tracks, boxes of parked vehicles, cameras, poses, settings, the backend that
    finds it (the GPU rounds otherwise than the CPU), and the version of this code. Of colours, it
    covers those that all directions share. The order of the cameras counts.
    """
    digest = hashlib.blake2b(FORMAT.encode(), digest_size=20)
    if backend == CUDA:
        digest.update(CUDA.encode())
    digest.update(repr((settings.cell_m, settings.max_slope_deg, settings.estimator)).encode())
    _add_gaussians(digest, scene.background)
    for actor in scene.actors:
        digest.update(repr((actor.track_id, actor.label, actor.size_m)).encode())
        _add_gaussians(digest, actor.gaussians)
        _add_tensors(digest, actor.track.timestamps_ns, actor.track.world_from_actor)
    for vehicle in parked_vehicles(scene):
        digest.update(repr((vehicle.label, vehicle.size_m)).encode())
        digest.update(np.concatenate([vehicle.centre_m, vehicle.rotation.ravel()]).tobytes())
    for camera in cameras:
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        camera_values = (camera.name, *numbers, camera.timestamp_ns, camera.is_orthographic)
        digest.update(repr(camera_values).encode())
        _add_tensors(digest, camera.camera_from_world)
    _add_tensors(digest, *(frame.world_from_ego for frame in scene.frames))
    if scene.seen_frames is not None:  # wheel tracks are those of the recorded drive
        digest.update(repr(settings.has_tracks_without_drive).encode())
        _add_tensors(digest, *(frame.world_from_ego for frame in scene.seen_frames))
    return digest.hexdigest()


def save_exposed_surface(path: Path, exposed_surface: ExposedSurface, key: str) -> None:
    """Write an exposed surface, as a whole or not at all.

    Equal surfaces are equal bytes, because no time is stored.

    Raises:
        OutputError: the system refused (disk full, no permission ...); `path` is then as it was.
    """
    tensors = _named_tensors("ground", exposed_surface.ground)
    for number, cells in enumerate(exposed_surface.actors.values()):
        tensors |= _named_tensors(f"actors.{number}", cells)
    metadata = {"format": FORMAT, "key": key, "track_ids": list(exposed_surface.actors)}
    # The metadata has a single entry, since several would be written in any order.
    write_atomic(
        path, save(tensors, metadata={_METADATA_KEY: json.dumps(metadata, sort_keys=True)})
    )


def load_exposed_surface(path: Path, key: str) -> ExposedSurface:
    """Read the exposed surface of a file.

    Raises:
        SceneError: there is no such file, it is damaged, it holds no exposed surface, or its key is
            not `key`.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get(_METADATA_KEY, "{}"))
            _check_metadata(path, metadata, key)
            track_ids = metadata["track_ids"]
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        actors = {
            track_id: _cells_from_tensors(path, tensors, f"actors.{number}")
            for number, track_id in enumerate(track_ids)
        }
        return ExposedSurface(_cells_from_tensors(path, tensors, "ground"), actors)
    except FileNotFoundError as error:
        raise SceneError(f"{path}: no such file, so there is no exposed surface to read") from error
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise SceneError(
            f"{path} is damaged or holds no exposed surface ({type(error).__name__}: {error}); "
            f"delete it, and it is made anew"
        ) from error


def _check_metadata(path: Path, metadata: Any, key: str) -> None:
    """Check the format and the key in a file's metadata."""
    metadata = metadata if isinstance(metadata, dict) else {}
    if metadata.get("format") != FORMAT:
        raise SceneError(
            f"{path} holds no exposed surface of this version: its format is "
            f"{metadata.get('format')!r}, expected {FORMAT!r}; delete it, and it is made anew"
        )
    if metadata.get("key") != key:
        raise SceneError(
            f"{path} is the exposed surface of something else: its key is {metadata.get('key')!r}, "
            f"expected {key!r}; the scene, the cameras or the settings have changed since"
        )


def _named_tensors(part: str, cells: ExposedCells) -> dict[str, Tensor]:
    """Return the tensors of one part's cells, by their names in a file."""
    return {
        f"{part}.{field.name}": getattr(cells, field.name).contiguous().clone()
        for field in fields(ExposedCells)
    }


def _cells_from_tensors(path: Path, tensors: Mapping[str, Tensor], part: str) -> ExposedCells:
    """Return the cells of one part, after a check of every shape and every index."""
    fields_by_name = {field.name: tensors[f"{part}.{field.name}"] for field in fields(ExposedCells)}
    num_cells = len(fields_by_name["sizes_m"])
    num_gaussians = len(fields_by_name["hideable_ids"])
    for name, tensor in fields_by_name.items():
        rows = num_gaussians if name in _FIELDS_OF_GAUSSIANS else num_cells
        shape = (rows, _COLUMNS[name]) if name in _COLUMNS else (rows,)
        dtype = _DTYPES.get(name, torch.float32)
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise ValueError(
                f"{part}.{name} must be {dtype} {list(shape)}; got {tensor.dtype} "
                f"{list(tensor.shape)}"
            )
    for name, min_index in (("neighbours", FLUSH), ("covering_cells", -1)):
        values = fields_by_name[name]
        if values.numel() and not min_index <= int(values.min()) <= int(values.max()) < num_cells:
            raise ValueError(f"{part}.{name} names cells that are not there")
    if num_gaussians and int(fields_by_name["hideable_ids"].min()) < 0:
        raise ValueError(f"{part}.hideable_ids names Gaussians that are not there")
    return ExposedCells(**fields_by_name)


def _add_gaussians(digest: hashlib.blake2b, gaussians: Gaussians) -> None:
    """Add Gaussians to a digest."""
    g = gaussians
    tensors = (g.means, g.quats, g.scales, g.opacities, g.sh[:, 0])
    _add_tensors(digest, *tensors, *(() if g.semantic is None else (g.semantic,)))


def _add_tensors(digest: hashlib.blake2b, *tensors: Tensor) -> None:
    """Add tensors to a digest, with their shapes and types."""
    for tensor in tensors:
        array = np.ascontiguousarray(tensor.detach().numpy())
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(array.view(np.uint8).data if array.size else b"")


def exposed_surface_of(
    scene: Scene,
    settings: ExposureSettings,
    *,
    cameras: Sequence[Camera] | None = None,
    folder: Path | None = None,
    backend: str = AUTO,
    progress: bool = False,
) -> ExposedSurface:
    """Return the exposed surface of a scene.

    It is remembered, read from the folder, or found and written there. A scene and its settings
    have one exposed surface, so that its pictures, sweeps and labels agree.

    Args:
        scene: the scene.
        settings: settings of the cells.
        cameras: cameras that must see the surface; None for all of the scene's.
        folder: folder that keeps exposed surfaces as exposed-<key>.safetensors. A file that cannot
            be used is replaced, with a warning. Files of older versions are deleted.
        backend: backend that finds a surface which is not remembered yet, see
            find_exposed_surface.
        progress: if True, a progress bar is shown.

    Raises:
        SceneError: as find_exposed_surface.
        TooManyCellsError: as find_exposed_surface.
        OutputError: the folder cannot be written.
    """

    scene = scene.as_recorded

    def find_surface() -> ExposedSurface:
        viewing_cameras = all_cameras(scene) if cameras is None else cameras
        key = (
            ""
            if folder is None
            else exposed_surface_key(scene, viewing_cameras, settings, backend=backend)
        )
        path = None if folder is None else exposed_surface_path(folder, key)
        if path is not None and path.is_file():
            try:
                return load_exposed_surface(path, key)
            except SceneError as error:
                logger.warning("the exposed surface of %s is found again: %s", scene.name, error)
        exposed_surface = find_exposed_surface(
            scene, viewing_cameras, settings, backend=backend, progress=progress
        )
        if path is not None:
            save_exposed_surface(path, exposed_surface, key)
            delete_old_files(path.parent)
        return exposed_surface

    return memo_of(scene).get(("exposed surface", settings), find_surface)


@dataclass(frozen=True)
class StoredExposedSurface:
    """Exposed surface in its file."""

    path: str
    key: str

    def load(self) -> ExposedSurface:
        """Read the exposed surface."""
        return load_exposed_surface(Path(self.path), self.key)


def share_exposed_surface(
    scene: Scene,
    settings: ExposureSettings,
    *,
    cameras: Sequence[Camera] | None,
    folder: Path | None,
    backend: str,
    progress: bool,
) -> None:
    """Find the exposed surface of a job's scene, and share it through the scene's memo.

    Arguments and errors are those of `exposed_surface_of`. Other processes of the job take over the
    memo. Where the job has a folder, the memo holds the file instead of the surface.
    """
    scene = scene.as_recorded
    exposed_surface = exposed_surface_of(
        scene, settings, cameras=cameras, folder=folder, backend=backend, progress=progress
    )
    stored: ExposedSurface | StoredExposedSurface = exposed_surface
    if folder is not None:
        viewing_cameras = all_cameras(scene) if cameras is None else cameras
        key = exposed_surface_key(scene, viewing_cameras, settings, backend=backend)
        path = exposed_surface_path(folder, key)
        if not path.is_file():  # this process remembers it from a job in another folder
            save_exposed_surface(path, exposed_surface, key)
        stored = StoredExposedSurface(str(path), key)
    memo = memo_of(scene)
    memo.put(("exposed surface", settings), stored, shared=True)
    memo.put(("exposed surface", settings), exposed_surface)


def all_cameras(scene: Scene) -> list[Camera]:
    """Return all cameras of the scene's frames."""
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


def exposed_surface_path(folder: Path, key: str) -> Path:
    """Return the file in which a folder keeps the exposed surface of a key."""
    return folder / f"exposed-{key}.safetensors"


def delete_old_files(folder: Path) -> None:
    """Delete the files that older versions have left in a folder; no version reads both."""
    for path in folder.glob(_OLD_FILES):
        with contextlib.suppress(OSError):  # such a file takes room, and does no other harm
            path.unlink()
