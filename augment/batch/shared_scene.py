"""Hands an open scene to worker processes without opening it again, and holds it in memory once.

Opening a scene may take minutes, and a scene may take gigabytes. All its tensors are laid into one
temporary file, which workers map into their memory: the system keeps a single copy for all. The
rest of the scene is small, and travels through the pipe that starts the process.
"""

from __future__ import annotations

import functools
import io
import pickle
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from augment.batch.atomic import make_folder, output_error, temporary_beside
from augment.scene import Scene

ALIGNMENT = 64  # bytes: a cache line, and any vector register


@dataclass(frozen=True)
class SharedScene:
    """A scene whose tensors lie in a file. Valid until `remove`."""

    path: str
    skeleton: bytes

    def open(self) -> Scene:
        """The scene, its tensors mapped from the file; writes to them stay in this process.

        The skeleton is a pickle, as everything that multiprocessing sends: it comes from the
        parent through the pipe, never from a file.
        """
        load = ForkingPickler.loads  # pyright: ignore[reportAttributeAccessIssue]
        return load(self.skeleton)

    def remove(self) -> None:
        """Delete the file. Processes that have opened the scene keep their mapping."""
        Path(self.path).unlink(missing_ok=True)


def share_scene(scene: Scene, folder: Path) -> SharedScene:
    """Lay the scene's tensors into a temporary file of `folder`, which a later job clears away
    once it holds the folder.

    Raises:
        OutputError: the file cannot be written. ValueError: a part of the scene, such as its label
            source, cannot be sent to another process.
    """
    path = temporary_beside(folder / "scene")
    try:
        make_folder(folder)
        with path.open("xb") as file:
            skeleton = io.BytesIO()
            try:
                _ScenePickler(skeleton, file, str(path)).dump(scene)
            except (AttributeError, TypeError, pickle.PicklingError) as error:
                raise ValueError(
                    f"scene {scene.name!r} cannot be sent to worker processes: {error}; its label "
                    f"source and sky must be of importable classes that hold no open files. "
                    f"workers=1 works with any scene"
                ) from error
            file.write(b"\0" * ALIGNMENT)  # an empty file cannot be mapped
    except OSError as error:
        path.unlink(missing_ok=True)
        raise output_error(path, error) from error
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return SharedScene(str(path), skeleton.getvalue())


class _ScenePickler(pickle.Pickler):
    """Writes tensors to a file and keeps only where they lie."""

    def __init__(self, skeleton: io.BytesIO, file: BinaryIO, path: str) -> None:
        super().__init__(skeleton, protocol=pickle.HIGHEST_PROTOCOL)
        self._file, self._path = file, path

    def reducer_override(self, obj: Any) -> Any:
        if not isinstance(obj, torch.Tensor):
            return NotImplemented
        array = obj.detach().contiguous().numpy()
        self._file.write(b"\0" * (-self._file.tell() % ALIGNMENT))
        offset = self._file.tell()
        self._file.write(array.data)
        return _map_tensor, (self._path, offset, array.dtype.str, array.shape)


def _map_tensor(path: str, offset: int, dtype: str, shape: tuple[int, ...]) -> torch.Tensor:
    array = np.ndarray(shape, dtype, buffer=_mapping(path), offset=offset)
    return torch.from_numpy(array)


@functools.lru_cache(maxsize=1)
def _mapping(path: str) -> np.memmap:
    return np.memmap(path, np.uint8, mode="c")  # copy on write
