"""Which images and which sweep make a frame, and what the frames' files are in the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from adapters.nuscenes.options import NuScenesOptions
from adapters.nuscenes.tables import LIDAR, SceneTables, SensorFile, read_tables

# The LiDAR turns in 50 ms; further from a sweep than two turns an image belongs to none.
_NEAR_NS = 100_000_000


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame. sweep: its LiDAR file, whose time is the frame's. images: by camera, those taken
    nearest to that; a camera that took none near it is absent."""

    index: int
    sweep: SensorFile
    images: Mapping[str, SensorFile]


@dataclass(frozen=True)
class FrameToken:
    """What a frame's image or sweep is in the tables. token: of its row in sample_data. filename:
    relative to the dataset's folder."""

    token: str
    filename: str
    is_key_frame: bool


def scene_frames(
    tables: SceneTables, *, sweeps: bool
) -> tuple[tuple[FrameFiles, ...], tuple[str, ...]]:
    """The frames of a scene, numbered from 0 in order of time, and a sentence for each camera that
    has images in none of them.

    sweeps: one frame a LiDAR file, of keyframes and between them (20 a second; cameras take 12
    images a second, so most frames lack some); else one a keyframe. A keyframe has its own images,
    those of its sample; each other image goes to the nearest frame in time that has none of its
    camera yet, nearest pairs first, and to no second one.
    """
    chosen = [file for file in tables.lidar if sweeps or file.is_key_frame]
    images: list[dict[str, SensorFile]] = [{} for _ in chosen]
    problems = []
    for channel, files in tables.images.items():
        if not sweeps:
            files = tuple(file for file in files if file.is_key_frame)
        matches = _match(chosen, files)
        for number, file in matches.items():
            images[number][channel] = file
        unused = len(files) - len(matches)
        if unused:
            problems.append(
                f"camera {channel}: {unused} of {len(files)} images have no frame, since no sweep "
                f"of {LIDAR} that lacks an image of this camera lies within "
                f"{_NEAR_NS / 1e9:.1f} s of them"
            )
    frames = zip(chosen, images, strict=True)
    return tuple(FrameFiles(i, *frame) for i, frame in enumerate(frames)), tuple(problems)


def frame_tokens(path: str, query: dict[str, str]) -> dict[int, dict[str, FrameToken]]:
    """What every frame of a scene is in the dataset's tables: frame number (Frame.index) to channel
    (LIDAR_TOP among them) to row of sample_data. Frames that frames= leaves out are there too, and
    so are files that the tables name but that are missing.

    Raises:
        AdapterError: as open_nuscenes for the tables.
    """
    options = NuScenesOptions.from_query(query)
    tables = read_tables(Path(path), options.version, options.scene)
    frames, _ = scene_frames(tables, sweeps=options.sweeps)
    return {
        frame.index: {
            file.channel: FrameToken(file.token, file.filename, file.is_key_frame)
            for file in (frame.sweep, *frame.images.values())
        }
        for frame in frames
    }


def _match(sweeps: Sequence[SensorFile], files: Sequence[SensorFile]) -> dict[int, SensorFile]:
    """One camera's images by the number of their sweep."""
    pairs = []
    for j, file in enumerate(files):
        for i, sweep in enumerate(sweeps):
            apart = abs(sweep.timestamp_ns - file.timestamp_ns)
            own = sweep.is_key_frame and file.is_key_frame
            own = own and sweep.sample_token == file.sample_token
            if own or apart <= _NEAR_NS:
                pairs.append((not own, apart, i, j))
    matches: dict[int, SensorFile] = {}
    taken: set[int] = set()
    for _, _, i, j in sorted(pairs):
        if i not in matches and j not in taken:
            matches[i] = files[j]
            taken.add(j)
    return matches
