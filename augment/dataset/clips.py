"""Clips: consecutive frames of all cameras, for models that look at time or around the car."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from augment.dataset.collate import IMAGES
from augment.dataset.files import WeatherDataset
from augment.dataset.rows import Rows

MOST_LATE = 1.5  # a frame later than this many usual intervals comes after a gap
_PER_FRAME = ("sizes_m", "labels", "track_ids", "attributes", "frame")
_PLACED = ("centers_m", "quats")


class ClipDataset(Dataset):
    """Clips of `length` frames of one scene under one variant, each with all cameras.

    length: frames a clip, T. step: of how many recorded frames each is taken. stride: recorded
    frames from one clip's first to the next's. cameras: names in the order of the samples, None for
    all that a variant has. transform: called with every clip.

    Frames follow each other where their numbers do (by the smallest distance that the variant's
    numbers have) and their times: one that comes later than 1.5 of the usual intervals, or lacks a
    camera, ends the clips before it. So a clip never spans a gap, two scenes or two variants.

    A clip is a sample (`augment.dataset.samples`) with two dimensions more, of T frames and C
    cameras:

        image             [T, C, 3, H, W]; where sizes differ, a list of T lists of C; likewise
                          depth, semantic, instance, water, snow
        boxes             a list of T: a frame's boxes once, its numbers for each image [C, B]
                          (visibility, hidden_fraction, ...); in the camera's frame centers_m
                          [C, B, 3] and quats [C, B, 4] too
        lidar             a list of T
        camera            name: a list of C. K [T, C, 3, 3], world_from_camera [T, C, 4, 4],
                          world_from_ego [T, 4, 4]; width, height, timestamp_ns int64 [T, C]
        paths             a list of T lists of C
        frame             int64 [T]
        scene, variant, weather, recipe_hash, surface: as in a sample

    The frames' dataset is asked without its own `transform`.

    Raises:
        ValueError: numbers below 1, or a camera that no variant has.
    """

    def __init__(
        self,
        frames: WeatherDataset,
        length: int,
        *,
        step: int = 1,
        stride: int = 1,
        cameras: Sequence[str] | None = None,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        numbers = {"length": length, "step": step, "stride": stride}
        if min(numbers.values()) < 1:
            raise ValueError(f"length, step and stride must be >= 1; got {numbers}")
        self.frames, self.length, self.transform = frames, length, transform
        self._runs = list(_runs(frames.rows, cameras))
        reach = (length - 1) * step
        # Of each clip: its run, and the place of its first frame there.
        self._starts = np.array(
            [
                (number, start)
                for number, run in enumerate(self._runs)
                for start in range(0, len(run) - reach, stride)
            ],
            np.int64,
        ).reshape(-1, 2)
        self._steps = np.arange(length) * step

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"clip {index} of a dataset of {len(self)}")
        clip = join_clip(list(self._frames(index)))
        return clip if self.transform is None else self.transform(clip)

    def row_numbers(self, index: int) -> np.ndarray:
        """int64 [T, C]: the numbers of the clip's images in `frames`."""
        run, start = self._starts[index]
        return self._runs[run][start + self._steps]

    def _frames(self, index: int) -> Iterator[list[dict[str, Any]]]:
        for rows in self.row_numbers(index):
            # All cameras see the same sweep.
            yield [
                self.frames.sample(int(row), without=("lidar",) if number else ())
                for number, row in enumerate(rows)
            ]


def join_clip(frames: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Samples [T][C] as one clip."""
    first = frames[0][0]
    clip = {**first}
    for key in IMAGES:
        clip[key] = _joined([[sample[key] for sample in frame] for frame in frames])
    clip["boxes"] = None if first["boxes"] is None else [_boxes(frame) for frame in frames]
    clip["lidar"] = [frame[0]["lidar"] for frame in frames]
    if all(sweep is None for sweep in clip["lidar"]):
        clip["lidar"] = None
    clip["camera"] = _cameras([[sample["camera"] for sample in frame] for frame in frames])
    clip["paths"] = [[sample["paths"] for sample in frame] for frame in frames]
    clip["frame"] = torch.tensor([frame[0]["frame"] for frame in frames])
    return clip


def _joined(values: list[list[Any]]) -> Any:
    """[T][C] tensors as one; None where there are only None; else the lists."""
    flat = [value for frame in values for value in frame]
    if all(value is None for value in flat):
        return None
    if any(value is None for value in flat) or len({value.shape for value in flat}) > 1:
        return values
    return torch.stack(flat).unflatten(0, (len(values), -1))


def _boxes(frame: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A frame's boxes: what does not depend on the image once, the rest for every camera."""
    every = [sample["boxes"] for sample in frame]
    once = _PER_FRAME if every[0]["frame"] == "camera" else (*_PER_FRAME, *_PLACED)
    return {
        key: value if key in once or value is None else torch.stack([b[key] for b in every])
        for key, value in every[0].items()
    }


def _cameras(cameras: list[list[Mapping[str, Any]]]) -> dict[str, Any]:
    first = cameras[0]
    whole = {
        key: torch.tensor([[camera[key] for camera in frame] for frame in cameras])
        for key in ("width", "height", "timestamp_ns")
    }
    return {
        "name": [camera["name"] for camera in first],
        **whole,
        "K": _joined([[camera["K"] for camera in frame] for frame in cameras]),
        "world_from_camera": _joined([[c["world_from_camera"] for c in f] for f in cameras]),
        "world_from_ego": torch.stack([frame[0]["world_from_ego"] for frame in cameras]),
    }


def _runs(rows: Rows, cameras: Sequence[str] | None) -> Iterator[np.ndarray]:
    """Row numbers int64 [F, C] of frames that follow each other without a gap."""
    column, frames, times = (
        rows.coded("camera"),
        rows.numbers("frame"),
        rows.numbers("timestamp_ns"),
    )
    known = {column.values[code]: int(code) for code in np.unique(column.codes)}
    if cameras is not None and (unknown := [name for name in cameras if name not in known]):
        raise ValueError(f"no camera {unknown}; there are {', '.join(known) or 'none'}")
    asked = None if cameras is None else [known[name] for name in cameras]
    for numbers in _by_variant(rows):
        codes = column.codes[numbers]
        wanted = np.unique(codes) if asked is None else np.array(asked, codes.dtype)
        yield from _runs_of(numbers, frames[numbers], times[numbers], codes, wanted)


def _by_variant(rows: Rows) -> Iterator[np.ndarray]:
    """The numbers of the rows of each scene under each variant, in the order of the rows."""
    keys = rows.variants()[1]
    order = np.argsort(keys, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(keys[order])) + 1) if len(order) else ()


def _runs_of(
    numbers: np.ndarray,
    frames: np.ndarray,
    times: np.ndarray,
    codes: np.ndarray,
    wanted: np.ndarray,
) -> Iterator[np.ndarray]:
    """The runs of one variant. numbers, frames, times, codes (of cameras): [N] of its rows."""
    present, place = np.unique(frames, return_inverse=True)
    table = np.full((len(present), len(wanted)), -1, np.int64)
    clock_ns = np.zeros_like(table)
    for column, code in enumerate(wanted):
        own = codes == code
        table[place[own], column] = numbers[own]
        clock_ns[place[own], column] = times[own]
    whole = (table >= 0).all(axis=1)
    if whole.any():
        breaks = _gaps(present, present[whole]) | _late(clock_ns[whole])
        yield from np.split(table[whole], np.flatnonzero(breaks) + 1)


def _gaps(every: np.ndarray, present: np.ndarray) -> np.ndarray:
    """bool [F - 1]: where frame numbers are farther apart than the variant's closest ones."""
    usual = np.diff(every).min(initial=np.iinfo(np.int64).max)
    return np.diff(present) > usual


def _late(clock_ns: np.ndarray) -> np.ndarray:
    """bool [F - 1]: where any camera's next image comes late. clock_ns: int64 [F, C]."""
    waits = np.diff(clock_ns, axis=0)
    usual = np.median(waits, axis=0) if len(waits) else np.zeros(clock_ns.shape[1])
    late = (waits > MOST_LATE * usual) | (waits < 0)
    return np.logical_or.reduce(late, axis=1)
