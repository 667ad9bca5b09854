"""Finds a scene's support once: it is remembered while the scene lives, and stored in a folder.

`placement.find_exposed_surface` does the work. Callers: snow and wet ground (`exposed_surface_of`
for pictures and sweeps, `share_exposed_surface` at the start of a job).
"""

from __future__ import annotations

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

from augment.cameras import Camera
from augment.effects.effect import JobContext
from augment.effects.snow.cells import FLUSH, ExposedCells, ExposedSurface
from augment.effects.snow.placement import ExposureSettings, find_exposed_surface
from augment.errors import SceneError
from augment.jobs.atomic import write_atomic
from augment.memo import memo_of
from augment.render.buffers import AUTO, CUDA
from augment.scene import Gaussians, Scene

logger = logging.getLogger(__name__)

# Name of the file format. Its number goes up whenever the same scene would give another support, or
# a file would hold it otherwise.
FORMAT = "climategs-exposed-surface-8"
_METADATA_KEY = "exposed_surface"  # key of the metadata in a file
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


def exposed_surface_key(
    scene: Scene, cameras: Sequence[Camera], settings: ExposureSettings, *, backend: str = AUTO
) -> str:
    """Return a hex digest of everything that a support depends on.

    That is Gaussians, tracks, cameras, poses, settings, the backend that places it (the GPU rounds
    otherwise than the CPU), and the version of this code. Of colours, it covers those that all
    directions share. The order of the cameras counts.
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
    for camera in cameras:
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        camera_values = (camera.name, *numbers, camera.timestamp_ns, camera.is_orthographic)
        digest.update(repr(camera_values).encode())
        _add_tensors(digest, camera.camera_from_world)
    _add_tensors(digest, *(frame.world_from_ego for frame in scene.frames))
    if scene.seen_frames is not None:  # wheel tracks are those of the recorded drive
        digest.update(repr(settings.has_invented_tracks).encode())
        _add_tensors(digest, *(frame.world_from_ego for frame in scene.seen_frames))
    return digest.hexdigest()


def save_exposed_surface(path: Path, support: ExposedSurface, key: str) -> None:
    """Write a support, as a whole or not at all. Equal supports are equal bytes: no time is stored.

    Raises:
        OutputError: the system refused (disk full, no permission ...); `path` is then as it was.
    """
    tensors = _named_tensors("ground", support.ground)
    for number, cells in enumerate(support.actors.values()):
        tensors |= _named_tensors(f"actors.{number}", cells)
    metadata = {"format": FORMAT, "key": key, "track_ids": list(support.actors)}
    # The metadata has a single entry, since several would be written in any order.
    write_atomic(
        path, save(tensors, metadata={_METADATA_KEY: json.dumps(metadata, sort_keys=True)})
    )


def load_exposed_surface(path: Path, key: str) -> ExposedSurface:
    """Read the support of a file.

    Raises:
        SceneError: there is no such file, it is damaged or no snow support, or not that of `key`.
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
        raise SceneError(f"{path}: no such file, so no snow support to read") from error
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise SceneError(
            f"{path} is damaged or no snow support ({type(error).__name__}: {error}); delete it, "
            f"and it is made anew"
        ) from error


def _check_metadata(path: Path, metadata: Any, key: str) -> None:
    """Check the format and the key in a file's metadata."""
    metadata = metadata if isinstance(metadata, dict) else {}
    if metadata.get("format") != FORMAT:
        raise SceneError(
            f"{path} is no snow support of this version: its format is {metadata.get('format')!r}, "
            f"expected {FORMAT!r}; delete it, and it is made anew"
        )
    if metadata.get("key") != key:
        raise SceneError(
            f"{path} is the snow support of something else: its key is {metadata.get('key')!r}, "
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
    num_hideable = len(fields_by_name["hideable_ids"])
    for name, tensor in fields_by_name.items():
        rows = num_hideable if name in ("hideable_ids", "covering_cells") else num_cells
        shape = (rows, _COLUMNS[name]) if name in _COLUMNS else (rows,)
        dtype = _DTYPES.get(name, torch.float32)
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise ValueError(
                f"{part}.{name} must be {dtype} {list(shape)}; got {tensor.dtype} "
                f"{list(tensor.shape)}"
            )
    for name, min_index in (("neighbours", FLUSH), ("covering_cells", -1)):
        values = fields_by_name[name]
        if values.numel() and not (min_index <= int(values.min()) <= int(values.max()) < num_cells):
            raise ValueError(f"{part}.{name} names cells that are not there")
    if num_hideable and int(fields_by_name["hideable_ids"].min()) < 0:
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
    """Return the support of a scene: remembered, read from the folder, or placed and written there.

    A scene and its settings have one support, so that its pictures, sweeps and labels agree.

    Args:
        scene: the scene.
        settings: settings of the cells.
        cameras: cameras that must see the snow; None for all of the scene's.
        folder: folder that keeps supports as snow-<key>.safetensors. A file that cannot be used is
            replaced, with a warning.
        backend: backend that places a support which is not remembered yet, see
            find_exposed_surface.
        progress: if True, a progress bar is shown.

    Raises:
        SceneError: as find_exposed_surface.
        OutputError: the folder cannot be written.
    """

    def find_support() -> ExposedSurface:
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
                logger.warning("the snow of %s is placed anew: %s", scene.name, error)
        support = find_exposed_surface(
            scene, viewing_cameras, settings, backend=backend, progress=progress
        )
        if path is not None:
            save_exposed_surface(path, support, key)
        return support

    return memo_of(scene).get(("snow support", settings), find_support)


@dataclass(frozen=True)
class StoredExposedSurface:
    """Support in its file."""

    path: str
    key: str

    def load(self) -> ExposedSurface:
        """Read the support."""
        return load_exposed_surface(Path(self.path), self.key)


def share_exposed_surface(context: JobContext, settings: ExposureSettings) -> None:
    """Find the support of a job's scene and share it with the processes that take over its memo.

    It is shared as a file where the job has a folder.
    """
    support = exposed_surface_of(
        context.scene,
        settings,
        cameras=context.cameras,
        folder=context.folder,
        backend=context.backend,
        progress=context.progress,
    )
    stored: ExposedSurface | StoredExposedSurface = support
    if context.folder is not None:
        viewing_cameras = all_cameras(context.scene) if context.cameras is None else context.cameras
        key = exposed_surface_key(context.scene, viewing_cameras, settings, backend=context.backend)
        path = exposed_surface_path(context.folder, key)
        if not path.is_file():  # this process remembers it from a job in another folder
            save_exposed_surface(path, support, key)
        stored = StoredExposedSurface(str(path), key)
    memo = memo_of(context.scene)
    memo.put(("snow support", settings), stored, shared=True)
    memo.put(("snow support", settings), support)


def all_cameras(scene: Scene) -> list[Camera]:
    """Return all cameras of the scene's frames."""
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


def exposed_surface_path(folder: Path, key: str) -> Path:
    """Return the file in which a folder keeps the support of a key."""
    return folder / f"snow-{key}.safetensors"
