"""3D boxes and LiDAR sweeps, kept exactly as the dataset gave them.

Coordinates here are the dataset's own world in float64, before the recentring that rendering
needs: `scene = dataset - Scene.world_origin_m`. That is what lets them pass through unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

# The label of an actor that is the recording car itself, as one camera sees it: no dataset labels
# it, no box stands for it, and no LiDAR return is its own.
EGO_VEHICLE = "ego_vehicle"


@dataclass(frozen=True, eq=False)
class Boxes:
    """The labelled boxes of one frame.

    track_ids, labels: one string a box. centers_m: float64 [B, 3], dataset world.
    sizes_m: float64 [B, 3] as length (box x), width (y), height (z). quats: float64 [B, 4] wxyz,
    world_from_box. attributes: the dataset's further columns, each with B entries.
    """

    track_ids: tuple[str, ...]
    labels: tuple[str, ...]
    centers_m: np.ndarray
    sizes_m: np.ndarray
    quats: np.ndarray
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)

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
        return Boxes((), (), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)))


@dataclass(frozen=True, eq=False)
class LidarSweep:
    """One frame's LiDAR returns as named columns of equal length, in the dataset's order.

    Always holds x, y, z (metres, dataset world); usually intensity, timestamp_ns, sensor, semantic
    (dataset's own class numbers) under the names its adapter documents.
    """

    columns: Mapping[str, np.ndarray]

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
        """float64 [N, 3], dataset world."""
        return np.stack([np.asarray(self.columns[c], dtype=np.float64) for c in "xyz"], axis=1)


@runtime_checkable
class LabelSource(Protocol):
    """Reads labels and LiDAR of a frame when asked, so that a scene stays small in memory.

    Implementations are picklable (they hold paths, not open files).
    """

    def boxes(self, frame_index: int) -> Boxes:
        """Boxes of the frame; empty where the dataset has none."""
        ...

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """The sweep of the frame, or None where the dataset has no file for it."""
        ...


@runtime_checkable
class ClassifiesLidar(Protocol):
    """A LabelSource that also knows what the class numbers of its sweeps mean."""

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """The SemanticClass of each of the sweep's returns, int16 [N], negative where no surface
        made it; None where the sweep has no classes, or they are not known to mean anything.
        """
        ...


@runtime_checkable
class KnowsLidarOrigins(Protocol):
    """A LabelSource that also knows where its sensors were, for weather along the beams."""

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Where the beam of each of the sweep's returns started, float64 [N, 3], dataset world;
        None where it is not known for this frame.
        """
        ...


@runtime_checkable
class KnowsLidarTop(Protocol):
    """A LabelSource with lasers of several reaches, of which the near ones see higher. Else the
    returns tell."""

    @property
    def lidar_top_rad(self) -> float:
        """The highest elevation that the laser of the longest reach looks at."""
        ...


@runtime_checkable
class StoresLidar(Protocol):
    """A LabelSource whose sweeps lie in files of their own, which can be written anew."""

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """The file of the frame's returns, and those that say something of each of them in the
        same order; none where the frame has no sweep.
        """
        ...

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """What one of those files holds when the sensor has seen `sweep` in place of the frame's
        own: returns of that, some moved, as `source_index` names them, in that order. Returns that
        the weather in the air made (see codes) have the dataset's class for that, or none.
        """
        ...
