"""Whether an image file is whole, told before anything relies on it."""

from __future__ import annotations

from pathlib import Path

from adapters.lidar_scene.image_views import read_image
from recipes.files import open_file

_ENDS = ((b"\x89PNG\r\n\x1a\n", b"IEND"), (b"\xff\xd8", b"\xff\xd9"))


def read_image_size(path: Path) -> tuple[int, int] | str:
    """Width and height of a PNG or JPEG, decoded once to be sure of it, or what is wrong with it as
    the end of a sentence."""
    try:
        with open_file(path) as file:
            data = file.read()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    # Decoders fill what is cut off with grey.
    if not any(data.startswith(start) and end in data[-64:] for start, end in _ENDS):
        return "is cut short, or neither PNG nor JPEG"
    image = read_image(path, 1.0)
    return "cannot be decoded" if image is None else (image.shape[1], image.shape[0])
