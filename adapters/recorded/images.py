"""Recorded images at the training resolution, read on demand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from adapters.plain_files import decode_image
from adapters.recorded.byte_cache import ByteCache
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.reconstruct.view import ViewKey
from recipes.files import open_file

# JPEG decoders can leave out the finest parts of each 8x8 block, which costs far less.
_REDUCED = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    1: cv2.IMREAD_COLOR,
}
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_TAIL_BYTES = 64  # some cameras pad the file behind the end marker


class ImageFault(Exception):
    """What is wrong with an image file, as the end of a sentence that starts with its path."""


def read_scaled(path: Path, full: Camera, scaled: Camera) -> np.ndarray:
    """The image of camera `full` at the size of camera `scaled`: RGB uint8 [H, W, 3].

    Each pixel is the mean of the area it covers. Files may be any kind that OpenCV decodes; their
    size may differ from the camera's by less than the reduction of the decoder (8 pixels at most).

    Raises:
        ImageFault: missing, cut short, not decodable, or not of the camera's size.
    """
    is_jpeg = _check_file(path)
    step = _reduction(full, scaled) if is_jpeg else 1
    image = decode_image(path, _REDUCED[step])
    if image is None:
        raise ImageFault("cannot be decoded")
    size = (-(-full.height // step), -(-full.width // step))
    if image.shape[:2] != size:
        height, width = image.shape[0] * step, image.shape[1] * step
        about = "about " if step > 1 else ""
        raise ImageFault(
            f"is of {about}{width}x{height} pixels; its camera is of {full.width}x{full.height}"
        )
    if (scaled.height, scaled.width) != size:
        image = cv2.resize(image, (scaled.width, scaled.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _reduction(full: Camera, scaled: Camera) -> int:
    """The most that a JPEG can be reduced while it is decoded: not below the size wanted, and only
    if it divides both sides, since an odd remainder would shift pixels."""
    for step in (8, 4, 2):
        divides = full.width % step == 0 and full.height % step == 0
        if divides and full.width // step >= scaled.width and full.height // step >= scaled.height:
            return step
    return 1


def _check_file(path: Path) -> bool:
    """Whether the file is a JPEG; its ends are looked at since decoders fill what is missing."""
    try:
        with open_file(path) as file:
            head = file.read(2)
            size = file.seek(0, 2)
            file.seek(max(0, size - _TAIL_BYTES))
            tail = file.read()
    except FileNotFoundError:
        raise ImageFault("does not exist") from None
    except OSError as error:
        raise ImageFault(f"cannot be read ({error.strerror or error})") from None
    if head != _JPEG_START:
        return False
    if _JPEG_END not in tail:
        raise ImageFault("is cut short")
    return True


class Images:
    """All recorded images by view; as many as fit in `cache_bytes` stay decoded."""

    def __init__(self, cache_bytes: int) -> None:
        self._sources: dict[ViewKey, tuple[Path, Camera, Camera]] = {}
        self._cache: ByteCache[np.ndarray] = ByteCache(cache_bytes)

    def add(self, key: ViewKey, path: Path, full: Camera, scaled: Camera) -> np.ndarray:
        """Decode an image for the first time, and keep it while there is room for all so far.

        Raises:
            ImageFault: it is unusable, and was not added.
        """
        image = read_scaled(path, full, scaled)
        self._sources[key] = (path, full, scaled)
        if self._cache.has_room(image.nbytes):
            self._cache.put(key, image, image.nbytes)
        return image

    def load(self, key: ViewKey) -> np.ndarray:
        """uint8 [H, W, 3]; callers do not write into it.

        Raises:
            AdapterError: the file has changed since it was added.
        """
        image = self._cache.get(key)
        if image is not None:
            return image
        path, full, scaled = self._sources[key]
        try:
            image = read_scaled(path, full, scaled)
        except ImageFault as fault:
            raise AdapterError(
                f"camera {key.camera}, frame {key.frame}: image {path} {fault}; it could be read "
                f"when the scene was opened, leave the files as they are while they are in use"
            ) from None
        self._cache.put(key, image, image.nbytes)
        return image
