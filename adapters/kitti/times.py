"""When the frames of a raw drive were taken.

A timestamps.txt has a line a frame, line 0 for frame 0: `2011-09-26 13:02:25.964389445`. Its clock
has no zone; it is read as UTC, nanoseconds since 1970.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from adapters.kitti.layout import file_in, some
from adapters.plain_files import read_text
from augment.errors import AdapterError

FRAME_NS = 100_000_000  # the Velodyne turns ten times a second and triggers the cameras
_TIME = re.compile(r"(19[7-9]\d|20\d\d|21\d\d)-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")


def read_times(root: Path, folder: str) -> dict[int, int]:
    """Nanoseconds by frame number from a folder's timestamps.txt, without the frames whose line is
    empty; nothing without the file.

    Raises:
        AdapterError: a line is no time.
    """
    path = file_in(root, f"{folder}/timestamps.txt")
    if not path.exists():
        return {}
    times = {}
    for number, line in enumerate(read_text(path).splitlines()):
        text = line.strip()
        if not text:
            continue
        try:
            if not _TIME.fullmatch(text):
                raise ValueError(text)
            times[number] = int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
        except ValueError:
            raise AdapterError(
                f"{path}, line {number + 1}: expected a time such as "
                f"2011-09-26 13:02:25.964389445; got {text[:60]!r}"
            ) from None
    return times


def frame_times(
    root: Path, known: Mapping[int, int], numbers: Sequence[int]
) -> tuple[dict[int, int], tuple[str, ...]]:
    """The time of every frame, and a sentence where it had to be assumed: ten frames a second from
    the nearest frame whose time is known, or from 0 at frame 0.

    Raises:
        AdapterError: times do not increase with the frames' numbers.
    """
    missing = [number for number in numbers if number not in known]
    anchors = np.array(sorted(known) or [0])
    times = {}
    for number in numbers:
        anchor = int(anchors[np.abs(anchors - number).argmin()])
        times[number] = known.get(anchor, 0) + (number - anchor) * FRAME_NS
    for before, after in itertools.pairwise(numbers):
        if times[after] <= times[before]:
            raise AdapterError(
                f"{root}: by timestamps.txt frame {after} was not taken after frame {before} "
                f"({times[after]} ns and {times[before]} ns); copy the file again"
            )
    if not missing:
        return times, ()
    what = "its timestamps.txt has no times" if not known else "timestamps.txt has no line"
    said = f"{root}: {what} for {some(missing)}; ten frames a second are assumed"
    return times, (said,)
