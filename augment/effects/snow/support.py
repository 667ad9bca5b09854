"""Where snow can lie, found once: remembered while the scene lives, and kept in a folder."""

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
from augment.effects.effect import Sharing
from augment.effects.snow.cells import FLUSH, SnowCells, SnowSupport
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.errors import SceneError
from augment.jobs.atomic import write_atomic
from augment.memo import memo_of
from augment.render.buffers import AUTO, CUDA
from augment.scene import Gaussians, Scene

logger = logging.getLogger(__name__)

# Raised whenever the same scene would give another support, or a file hold it otherwise.
FORMAT = "climategs-snow-bed-7"
_ABOUT = "snow_bed"
_DTYPES = {
    "neighbours": torch.int32,
    "semantic": torch.int16,
    "buried": torch.int32,
    "buried_by": torch.int32,
}
_COLUMNS = {"centers_m": 3, "normals": 3, "neighbours": 4, "banks": 2, "buried_by": 5}


def support_key(
    scene: Scene, cameras: Sequence[Camera], settings: PlacementSettings, *, backend: str = AUTO
) -> str:
    """Hex digest of all that a support depends on: Gaussians, tracks, cameras, poses, settings,
    what places it (the GPU rounds otherwise than the CPU), and this code's version. Of colours,
    what all directions share. Order of the cameras counts.
    """
    digest = hashlib.blake2b(FORMAT.encode(), digest_size=20)
    if backend == CUDA:
        digest.update(CUDA.encode())
    digest.update(repr((settings.cell_m, settings.max_slope_deg, settings.estimator)).encode())
    _add_gaussians(digest, scene.background)
    for actor in scene.actors:
        digest.update(repr((actor.track_id, actor.label, actor.size_m)).encode())
        _add_gaussians(digest, actor.gaussians)
        _add(digest, actor.track.timestamps_ns, actor.track.world_from_actor)
    for camera in cameras:
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        about = (camera.name, *numbers, camera.timestamp_ns, camera.is_orthographic)
        digest.update(repr(about).encode())
        _add(digest, camera.camera_from_world)
    _add(digest, *(frame.world_from_ego for frame in scene.frames))
    if scene.seen_frames is not None:  # wheel tracks are those of the recorded drive
        digest.update(repr(settings.invented_tracks).encode())
        _add(digest, *(frame.world_from_ego for frame in scene.seen_frames))
    return digest.hexdigest()


def save_support(path: Path, support: SnowSupport, key: str) -> None:
    """Write a support, as a whole or not at all, without its seconds: equal ones are equal bytes.

    Raises:
        OutputError: the system refused (disk full, no permission ...); `path` is then as it was.
    """
    tensors = _named("ground", support.ground)
    for number, cells in enumerate(support.actors.values()):
        tensors |= _named(f"actors.{number}", cells)
    about = {"format": FORMAT, "key": key, "track_ids": list(support.actors)}
    # A single entry: several are written in any order.
    write_atomic(path, save(tensors, metadata={_ABOUT: json.dumps(about, sort_keys=True)}))


def load_support(path: Path, key: str) -> SnowSupport:
    """The support of a file.

    Raises:
        SceneError: there is no such file, it is damaged or no snow support, or not that of `key`.
    """
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get(_ABOUT, "{}"))
            _check_about(path, about, key)
            track_ids = about["track_ids"]
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        actors = {
            track_id: _cells(path, tensors, f"actors.{number}")
            for number, track_id in enumerate(track_ids)
        }
        return SnowSupport(_cells(path, tensors, "ground"), actors)
    except FileNotFoundError as error:
        raise SceneError(f"{path}: no such file, so no snow support to read") from error
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise SceneError(
            f"{path} is damaged or no snow support ({type(error).__name__}: {error}); delete it, "
            f"and it is made anew"
        ) from error


def _check_about(path: Path, about: Any, key: str) -> None:
    about = about if isinstance(about, dict) else {}
    if about.get("format") != FORMAT:
        raise SceneError(
            f"{path} is no snow support of this version: its format is {about.get('format')!r}, "
            f"expected {FORMAT!r}; delete it, and it is made anew"
        )
    if about.get("key") != key:
        raise SceneError(
            f"{path} is the snow support of something else: its key is {about.get('key')!r}, "
            f"expected {key!r}; the scene, the cameras or the settings have changed since"
        )


def _named(part: str, cells: SnowCells) -> dict[str, Tensor]:
    return {
        f"{part}.{field.name}": getattr(cells, field.name).contiguous().clone()
        for field in fields(SnowCells)
    }


def _cells(path: Path, tensors: Mapping[str, Tensor], part: str) -> SnowCells:
    """The cells of one part, after a look at every shape and at every number that is an index."""
    found = {field.name: tensors[f"{part}.{field.name}"] for field in fields(SnowCells)}
    counts = {"cell": len(found["sizes_m"]), "buried": len(found["buried"])}
    for name, tensor in found.items():
        rows = counts["buried" if name.startswith("buried") else "cell"]
        shape = (rows, _COLUMNS[name]) if name in _COLUMNS else (rows,)
        dtype = _DTYPES.get(name, torch.float32)
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise ValueError(
                f"{part}.{name} must be {dtype} {list(shape)}; got {tensor.dtype} "
                f"{list(tensor.shape)}"
            )
    for name, least in (("neighbours", FLUSH), ("buried_by", -1)):
        values = found[name]
        if values.numel() and not least <= int(values.min()) <= int(values.max()) < counts["cell"]:
            raise ValueError(f"{part}.{name} names cells that are not there")
    if counts["buried"] and int(found["buried"].min()) < 0:
        raise ValueError(f"{part}.buried names Gaussians that are not there")
    return SnowCells(**found)


def _add_gaussians(digest: hashlib.blake2b, gaussians: Gaussians) -> None:
    g = gaussians
    own = (g.means, g.quats, g.scales, g.opacities, g.sh[:, 0])
    _add(digest, *own, *(() if g.semantic is None else (g.semantic,)))


def _add(digest: hashlib.blake2b, *tensors: Tensor) -> None:
    for tensor in tensors:
        array = np.ascontiguousarray(tensor.detach().numpy())
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(array.view(np.uint8).data if array.size else b"")


def support_of(
    scene: Scene,
    settings: PlacementSettings,
    *,
    cameras: Sequence[Camera] | None = None,
    folder: Path | None = None,
    backend: str = AUTO,
    progress: bool = False,
) -> SnowSupport:
    """The support of a scene: remembered, else read from the folder, else placed and written there.

    cameras: those that must see the snow; None for all of the scene's. folder: supports
    are kept there as snow-<key>.safetensors; a file that cannot be used is replaced, with a
    warning. backend: that places what is not remembered yet, see place_snow_support. A scene and
    its settings have one support, so that its pictures, sweeps and labels agree.

    Raises:
        SceneError: as place_snow_support.
        OutputError: the folder cannot be written.
    """

    def find() -> SnowSupport:
        every = every_camera(scene) if cameras is None else cameras
        key = "" if folder is None else support_key(scene, every, settings, backend=backend)
        path = None if folder is None else support_path(folder, key)
        if path is not None and path.is_file():
            try:
                return load_support(path, key)
            except SceneError as error:
                logger.warning("the snow of %s is placed anew: %s", scene.name, error)
        support = place_snow_support(scene, every, settings, backend=backend, progress=progress)
        if path is not None:
            save_support(path, support, key)
        return support

    return memo_of(scene).get(("snow support", settings), find)


@dataclass(frozen=True)
class StoredSupport:
    """A support in its file."""

    path: str
    key: str

    def load(self) -> SnowSupport:
        return load_support(Path(self.path), self.key)


def share_support(job: Sharing, settings: PlacementSettings) -> None:
    """Find the support and share it, in a file of the folder where there is one, with whoever
    takes over the scene's memo.
    """
    support = support_of(
        job.scene,
        settings,
        cameras=job.cameras,
        folder=job.folder,
        backend=job.backend,
        progress=job.progress,
    )
    stored: SnowSupport | StoredSupport = support
    if job.folder is not None:
        every = every_camera(job.scene) if job.cameras is None else job.cameras
        key = support_key(job.scene, every, settings, backend=job.backend)
        path = support_path(job.folder, key)
        if not path.is_file():  # this process knew it from a job in another folder
            save_support(path, support, key)
        stored = StoredSupport(str(path), key)
    memo = memo_of(job.scene)
    memo.put(("snow support", settings), stored, shared=True)
    memo.put(("snow support", settings), support)


def every_camera(scene: Scene) -> list[Camera]:
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


def support_path(folder: Path, key: str) -> Path:
    """Where the support of a key is kept in a folder."""
    return folder / f"snow-{key}.safetensors"
