"""Boxes and sweeps of a recording, passed through with every column."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.recording.calibration import read_lidar_classes
from adapters.recording.classes import class_numbers, class_table
from adapters.recording.files import block_files, inside, numbered_files
from adapters.recording.tables import TimedBoxes, read_frame_boxes, read_sweep, sweep_content
from augment.labels import Boxes, LidarSweep


def boxes_files(root: Path) -> list[Path]:
    """labels/boxes.parquet where there is one, else those of a job's blocks."""
    path = root / "labels" / "boxes.parquet"
    return [inside(root, path)] if path.exists() else block_files(root, "labels/boxes", ".parquet")


def lidar_files(root: Path) -> dict[int, Path]:
    """The sweeps' files by frame number."""
    return numbered_files(root, "lidar", (".parquet",))


def all_boxes(root: Path) -> dict[int, TimedBoxes]:
    """The boxes of every frame that has any; none without a file. Blocks that share a frame have
    all of its boxes each.
    """
    found: dict[int, TimedBoxes] = {}
    for path in boxes_files(root):
        found = read_frame_boxes(path) | found
    return found


@dataclass(frozen=True)
class RecordingLabels:
    """Labels of one recording, read when asked, in the recording's own world."""

    root: Path

    def boxes(self, frame_index: int) -> Boxes:
        timed = all_boxes(self.root).get(frame_index)
        return Boxes.empty() if timed is None else timed.boxes

    def lidar(self, frame_index: int) -> LidarSweep | None:
        path = lidar_files(self.root).get(frame_index)
        return None if path is None else read_sweep(path)

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        path = lidar_files(self.root).get(frame_index)
        return () if path is None else (path,)

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        return sweep_content(file, sweep)

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """The SemanticClass of each return, or NO_SURFACE; None where the numbers are not known to
        mean anything.
        """
        column = sweep.columns.get("semantic")
        if column is None:
            return None
        numbers = class_numbers(self.root / "lidar", column)
        meanings = read_lidar_classes(self.root)
        table, _ = class_table(self.root, np.unique(numbers), meanings)
        return None if table is None else table[numbers]

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """The columns origin_x, origin_y, origin_z, in the world of the returns, where all three
        hold numbers.
        """
        columns = [sweep.columns.get(f"origin_{axis}") for axis in "xyz"]
        if any(c is None or np.asarray(c).dtype.kind not in "fiu" for c in columns):
            return None
        return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)


def recording_labels(path: str, query: dict[str, str]) -> RecordingLabels:
    """The labels of a folder; whatever the query, they are those of all its frames."""
    return RecordingLabels(Path(path))
