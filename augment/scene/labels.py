"""Records of 3D boxes and LiDAR sweeps, and protocols of what can read them.

Coordinates here are the dataset's own world in float64, before the recentring that rendering needs:
`scene = dataset - Scene.world_origin_m`. So they pass through to the output unchanged. Adapters
implement `LabelSource`, and the further protocols where their datasets know more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

# Label of an actor that is the recording car itself, as one camera sees it: no dataset labels it,
# no box stands for it, and no LiDAR return is its own.
EGO_VEHICLE = "ego_vehicle"


@dataclass(frozen=True, eq=False)
class Boxes:
    """The B labelled boxes of one frame."""

    track_ids: tuple[str, ...]
    """Track of each box."""
    labels: tuple[str, ...]
    """Dataset's name for the kind of each box."""
    centers_m: np.ndarray
    """Centres, float64 [B, 3], dataset world."""
    sizes_m: np.ndarray
    """Length (box x), width (y) and height (z), float64 [B, 3]."""
    quats: np.ndarray
    """Rotations world_from_box, float64 [B, 4] wxyz."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Further columns of the dataset, each with B entries."""

    def __post_init__(self) -> None:
        count = len(self.track_ids)
        shapes = {"centers_m": 3, "sizes_m": 3, "quats": 4}
        for name, columns in shapes.items():
            value = getattr(self, name)
            if value.dtype != np.float64 or value.shape != (count, columns):
                raise ValueError(
                    f"{name} must be float64 [{count}, {columns}] (from {count} track_ids); "
                    f"got {value.dtype} {list(value.shape)}"
                )
        for name, value in {"labels": self.labels, **self.attributes}.items():
            if len(value) != count:
                raise ValueError(f"{name} must have {count} entries; got {len(value)}")

    def __len__(self) -> int:
        return len(self.track_ids)

    @staticmethod
    def empty() -> Boxes:
        """Return no boxes."""
        return Boxes((), (), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)))


@dataclass(frozen=True, eq=False)
class LidarSweep:
    """One frame's LiDAR returns, in the dataset's order."""

    columns: Mapping[str, np.ndarray]
    """Columns of equal length by name. There are always x, y, z (metres, dataset world); usually
    also intensity, timestamp_ns, sensor, semantic (the dataset's own class numbers), under the
    names that the adapter documents."""

    def __post_init__(self) -> None:
        missing = [name for name in "xyz" if name not in self.columns]
        if missing:
            raise ValueError(f"a LiDAR sweep needs columns x, y, z; missing {missing}")
        lengths = {name: len(column) for name, column in self.columns.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"LiDAR columns must have equal lengths; got {lengths}")

    def __len__(self) -> int:
        return len(self.columns["x"])

    @property
    def points_m(self) -> np.ndarray:
        """Return the returns' places, float64 [N, 3], dataset world."""
        return np.stack([np.asarray(self.columns[c], dtype=np.float64) for c in "xyz"], axis=1)


@runtime_checkable
class LabelSource(Protocol):
    """Reads labels and LiDAR of a frame when asked, so that a scene stays small in memory.

    Implementations are picklable (they hold paths, not open files).
    """

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame; empty where the dataset has none."""
        ...

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """Return the sweep of a frame, or None where the dataset has no file for it."""
        ...


@runtime_checkable
class ClassifiesLidar(Protocol):
    """A LabelSource that also knows the meaning of its sweeps' class numbers."""

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """Return the SemanticClass of each return, int16 [N].

        It is negative where no surface made the return. None where the sweep has no classes, or
        their meaning is not known.
        """
        ...


@runtime_checkable
class KnowsLidarOrigins(Protocol):
    """A LabelSource that also knows the places of its sensors, for weather along the beams."""

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return where the beam of each return started, float64 [N, 3], dataset world.

        None where it is not known for this frame.
        """
        ...


@runtime_checkable
class KnowsLidarElevation(Protocol):
    """A LabelSource with lasers of several reaches, of which the near ones see higher.

    For other sources the returns themselves show how high the LiDAR sees.
    """

    @property
    def max_lidar_elevation_rad(self) -> float:
        """Return the highest elevation that the laser of the longest reach looks at."""
        ...


@runtime_checkable
class StoresLidar(Protocol):
    """A LabelSource whose sweeps lie in files of their own, which can be written anew."""

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """Return the file of a frame's returns, and files with a row for each of them in the same
        order.

        Empty where the frame has no sweep.
        """
        ...

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Return the bytes of one of those files for a changed sweep.

        Args:
            frame_index: number of the frame.
            file: the file.
            sweep: what the sensor has seen in place of the frame's own sweep: returns of that, some
                moved, as `source_index` names them, in that order. Returns that the weather in the
                air made (see codes) get the dataset's class for that, or none.
        """
        ...
