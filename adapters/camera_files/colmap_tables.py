"""Check that the tables of a COLMAP model are whole, before pycolmap reads them.

pycolmap does not notice the end of a file: numbers beyond it are random memory. The layouts are
COLMAP's (src/colmap/scene/reconstruction_io_*.cc): a binary table begins with the number of its
entries; a text that COLMAP wrote says it in a comment. The caller is
`adapters.camera_files.camera_files`.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable
from pathlib import Path

from augment.errors import AdapterError
from recipes.files import open_file

# Numbers of parameters of COLMAP's camera models, by the models' numbers.
_CAMERA_PARAMETERS = {
    **{0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5},
    **{10: 12, 11: 16, 12: 4, 13: 5, 14: 3, 15: 4, 16: 6, 17: 2},
}
# Largest table. The largest models have some gigabytes.
_MAX_BYTES = 1 << 33
# Size of a pose: a quaternion and a translation.
_POSE_BYTES = 7 * 8
# Longest name of an image.
_MAX_NAME_BYTES = 4096
_ADVICE = "copy the model again, or save it again from COLMAP"


class _CutShort(Exception):
    """Raised if a table ends within an entry."""


def check_colmap_tables(model: Path) -> None:
    """Check all tables of the model in a folder.

    Raises:
        AdapterError: a table ends before its last entry, or holds a value that no table can hold.
    """
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    for name, (entry_end, word) in _TABLES.items():
        path = model / f"{name}{suffix}"
        if not path.exists():  # rigs and frames came with COLMAP 3.12
            continue
        try:
            with open_file(path) as file:
                size = os.fstat(file.fileno()).st_size
                if size > _MAX_BYTES:
                    raise AdapterError(f"{path} is larger than {_MAX_BYTES} bytes; no model is")
                data = file.read()
        except OSError as error:
            raise AdapterError(f"{path} cannot be read ({error.strerror or error})") from None
        if suffix == ".bin":
            _check_binary(data, path, entry_end, word)
        else:
            _check_text(data, path, word)


def _check_binary(
    data: bytes, path: Path, entry_end: Callable[[bytes, int, str], int], word: str
) -> None:
    if len(data) < 8:
        raise AdapterError(f"{path} is cut short: it has {len(data)} bytes; {_ADVICE}")
    (count,) = struct.unpack_from("<Q", data)
    position = 8
    for number in range(1, count + 1):
        try:
            position = entry_end(data, position, f"{path}: {word} {number} of {count}")
        except (struct.error, _CutShort):
            position = len(data) + 1
        if position > len(data):
            raise AdapterError(
                f"{path.name} is cut short at {word} {number} of {count}: {path} has {len(data)} "
                f"bytes; {_ADVICE}"
            )


def _check_text(data: bytes, path: Path, word: str) -> None:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise AdapterError(f"{path} is no UTF-8 text ({error}); {_ADVICE}") from None
    stated_count = next(
        (int(m[1]) for line in lines if (m := re.match(r"# Number of \w+: (\d{1,18})\b", line))),
        None,
    )
    entries = [line for line in lines if not line.startswith("#")]
    if word == "image":  # its second line, of points, may be empty
        entries = [line for line in entries[::2] if line.strip()]
    count = sum(bool(line.strip()) for line in entries)
    if count == 0 and word in _REQUIRED_ENTRIES:
        raise AdapterError(f"{path} holds no {word}; {_ADVICE}")
    # COLMAP ends the last line, too.
    is_cut = stated_count is not None and (count < stated_count or not data.endswith(b"\n"))
    if is_cut:
        number = count + (count < stated_count)
        raise AdapterError(
            f"{path.name} is cut short at {word} {number} of {stated_count}: {path} has "
            f"{len(lines)} lines; {_ADVICE}"
        )


# ---- Where an entry of a binary table ends -------------------------------------------------------


def _camera_end(data: bytes, start: int, where: str) -> int:
    """Return the position behind a camera's entry."""
    (model_number,) = struct.unpack_from("<i", data, start + 4)
    if model_number not in _CAMERA_PARAMETERS:
        raise AdapterError(
            f"{where} is of the model number {model_number}, which is not known; {_ADVICE} in a "
            f"version that is"
        )
    return start + 24 + 8 * _CAMERA_PARAMETERS[model_number]


def _image_end(data: bytes, start: int, where: str) -> int:
    """Return the position behind an image's entry."""
    name_start = start + 4 + _POSE_BYTES + 4
    end = data.find(b"\0", name_start, name_start + _MAX_NAME_BYTES)
    if end < 0:
        if name_start + _MAX_NAME_BYTES < len(data):
            raise AdapterError(f"{where} has a name without an end; {_ADVICE}")
        raise _CutShort
    (num_points,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + 24 * num_points


def _point_end(data: bytes, start: int, where: str) -> int:
    """Return the position behind a point's entry."""
    (num_entries,) = struct.unpack_from("<Q", data, start + 43)
    return start + 51 + 8 * num_entries


def _rig_end(data: bytes, at: int, where: str) -> int:
    """Return the position behind a rig's entry."""
    (sensors,) = struct.unpack_from("<I", data, at + 4)
    at += 8 + 8 * (sensors > 0)
    for _ in range(sensors - 1):
        (has_pose,) = struct.unpack_from("<B", data, at + 8)
        at += 9 + _POSE_BYTES * (has_pose > 0)
    return at


def _frame_end(data: bytes, start: int, where: str) -> int:
    """Return the position behind a frame's entry."""
    (num_images,) = struct.unpack_from("<I", data, start + 8 + _POSE_BYTES)
    return start + 12 + _POSE_BYTES + 16 * num_images


_REQUIRED_ENTRIES = ("camera", "rig", "frame")  # of which a model has at least one
# The word for an entry stands in messages.
_TABLES = {
    "cameras": (_camera_end, "camera"),
    "rigs": (_rig_end, "rig"),
    "frames": (_frame_end, "frame"),
    "images": (_image_end, "image"),
    "points3D": (_point_end, "point"),
}
