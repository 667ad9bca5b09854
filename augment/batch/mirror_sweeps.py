"""Weathered LiDAR sweeps in the place and form of a dataset's own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from augment.batch.label_files import read_lidar
from augment.batch.layout import resolve_inside
from augment.batch.manifest import OK
from augment.batch.mirror_tree import SourceTree
from augment.labels import LabelSource, StoresLidar
from augment.lidar_weather.codes import drop_lost


@dataclass(frozen=True)
class WeatheredSweep:
    """One of the dataset's files of a frame's returns, and the weathered sweep that is to be in it.

    scene: whose sweep it is. path: of our sweep. name: the same, relative to the output folder.
    content: makes the file's bytes; None where only another scene's labels could.
    """

    scene: str
    path: Path
    name: str
    content: Callable[[], bytes] | None

    @staticmethod
    def of_row(
        out_dir: Path, row: Mapping[str, Any], content: Callable[[], bytes] | None = None
    ) -> WeatheredSweep:
        """The sweep of a manifest's row.

        Raises:
            OutputError: the row names a file outside the output folder.
        """
        name = row["lidar_path"]
        return WeatheredSweep(row["scene"], resolve_inside(out_dir, name), name, content)


def weathered_sweeps(
    out_dir: Path,
    rows: Iterable[Mapping[str, Any]],
    labels: LabelSource | None,
    tree: SourceTree,
) -> tuple[dict[str, WeatheredSweep], list[str]]:
    """The dataset's files that a variant's weathered sweeps change, by their place in it, and a
    sentence for the sweeps that change none. Lost returns are left out of the files.

    Raises:
        OutputError: a row names a file outside the output folder.
    """
    frames = {row["frame"]: row for row in rows if row["status"] == OK and is_weathered(row)}
    found: dict[str, WeatheredSweep] = {}
    unplaced = []
    for frame, row in sorted(frames.items()):
        files = labels.lidar_files(frame) if isinstance(labels, StoresLidar) else ()
        places = [tree.relative(file) for file in files]
        if not files or None in places:
            unplaced.append(frame)
            continue
        assert isinstance(labels, StoresLidar)
        for file, place in zip(files, places, strict=True):
            content = _content(labels, frame, file, resolve_inside(out_dir, row["lidar_path"]))
            found[str(place)] = WeatheredSweep.of_row(out_dir, row, content)
    if not unplaced:
        return found, []
    return found, [
        f"{len(unplaced)} weathered LiDAR sweeps, the first of frame {unplaced[0]}, have no file "
        f"of their own in the dataset: its copy keeps the recorded ones, and {out_dir} has these"
    ]


def is_weathered(row: Mapping[str, Any]) -> bool:
    """Whether the row of an image names a sweep that has met the weather."""
    return row["lidar"] == "weather" and row["lidar_path"] is not None


def _content(labels: StoresLidar, frame: int, file: Path, sweep: Path) -> Callable[[], bytes]:
    return lambda: labels.lidar_content(frame, file, drop_lost(read_lidar(sweep)))
