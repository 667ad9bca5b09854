"""Encoding of image files: pictures, depth, class and instance numbers, masks; and their decoding.

In: arrays. Out: bytes of PNG and JPEG files, and back. Jobs and `augment.dataset.live` encode;
readers of an output decode. The same arrays always give the same bytes.
"""

from __future__ import annotations

import cv2
import numpy as np

from augment.files.image_size import decode_pixels
from recipes.schema import Output

# PNG settings by time and size at 960x540 on one core: libpng's run-length strategy with one fixed
# filter takes 20 ms for a photograph (Paeth, 0.53 MB) and 10 ms for a depth map (Sub), against
# 30 ms and 0.59 MB for zlib's level 1 and 118 ms and 0.51 MB for its level 6.

# Depth steps per metre, as in KITTI's depth maps: uint16 = metres x 256, 0 = none.
DEPTH_STEPS_PER_M = 256
# First and last bytes of every PNG file.
_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"


def _png_settings(filter_name: str) -> list[int]:
    """Return OpenCV's settings of a PNG file.

    Args:
        filter_name: Filter of libpng: PAETH, SUB or UP.
    """
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    settings += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    # Older OpenCV cannot choose the filter: files are then larger, and hold the same pixels.
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        settings += [cv2.IMWRITE_PNG_FILTER, getattr(cv2, f"IMWRITE_PNG_FILTER_{filter_name}")]
    return settings


def encode_image(rgb: np.ndarray, output: Output) -> bytes:
    """Return uint8 [H, W, 3] RGB as a PNG or JPEG file.

    A JPEG has the recipe's quality and no chroma subsampling.
    """
    _require(rgb, np.uint8, 3, "rgb")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if output.image == "png":
        return _encode(".png", bgr, _png_settings("PAETH"))
    quality = [cv2.IMWRITE_JPEG_QUALITY, output.jpeg_quality]
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return _encode(".jpg", bgr, quality + sampling)


def decode_image(data: bytes) -> np.ndarray:
    """Return the image in a file's bytes, uint8 [H, W, 3] RGB.

    Raises:
        ValueError: The bytes are no complete image.
    """
    bgr = _decode(data, cv2.IMREAD_COLOR)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def quantise_depth(depth_m: np.ndarray) -> np.ndarray:
    """Return depth in metres [H, W] as uint16 steps of 1/256 m; 0 where there is no depth.

    There is no depth where the value is 0, negative, NaN, infinite, or more than 65535/256 =
    255.996 m.
    """
    steps = np.rint(np.asarray(depth_m, np.float64) * DEPTH_STEPS_PER_M)
    is_valid = (steps >= 1) & (steps <= 65535)  # false for NaN
    return np.where(is_valid, steps, 0).astype(np.uint16)


def depth_in_metres(steps: np.ndarray) -> np.ndarray:
    """Return uint16 steps as float32 metres, exactly (16 bits and a power of two)."""
    return steps.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M)


def encode_depth(depth_m: np.ndarray) -> bytes:
    """Return float32 [H, W] metres as a 16-bit PNG."""
    _require(depth_m, np.float32, 2, "depth_m")
    return _encode(".png", quantise_depth(depth_m), _png_settings("SUB"))


def encode_ids(ids: np.ndarray, dtype: type) -> bytes:
    """Return class or instance numbers [H, W] as a PNG.

    It has 8 bits for np.uint8 and 16 bits for np.uint16.
    """
    _require(ids, dtype, 2, "ids")
    return _encode(".png", ids, _png_settings("UP"))


def encode_mask(mask: np.ndarray) -> bytes:
    """Return uint8 [H, W] of 0 and 255 as a PNG of 8 bits."""
    _require(mask, np.uint8, 2, "mask")
    if not ((mask == 0) | (mask == 255)).all():
        raise ValueError(f"mask must hold 0 and 255 only; got {np.unique(mask)[:8].tolist()}")
    return _encode(".png", mask, _png_settings("UP"))


def decode_png(data: bytes, dtype: type) -> np.ndarray:
    """Return the image in a PNG file's bytes, [H, W] of `dtype`.

    Raises:
        ValueError: The bytes are not a complete PNG of that kind.
    """
    # libpng returns the first part of a truncated file, so the end mark is checked.
    if not (data.startswith(_PNG_START) and data.endswith(_PNG_END)):
        raise ValueError(f"not a complete PNG file ({len(data)} bytes)")
    image = _decode(data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != dtype:
        raise ValueError(
            f"expected one channel of {np.dtype(dtype)}; got {list(image.shape)} {image.dtype}"
        )
    return image


def _encode(extension: str, array: np.ndarray, settings: list[int]) -> bytes:
    """Return an array as an image file."""
    is_encoded, data = cv2.imencode(extension, np.ascontiguousarray(array), settings)
    if not is_encoded:
        raise ValueError(f"OpenCV could not encode {list(array.shape)} {array.dtype} {extension}")
    return data.tobytes()


def _decode(data: bytes, flags: int) -> np.ndarray:
    """Return the array in an image file."""
    image = decode_pixels(data, flags)
    if image is None:
        raise ValueError(f"not a readable image file ({len(data)} bytes)")
    return image


def _require(array: np.ndarray, dtype: type, ndim: int, name: str) -> None:
    """Raise ValueError unless the array has this type and number of dimensions."""
    shape = "[H, W, 3]" if ndim == 3 else "[H, W]"
    has_shape = array.ndim == ndim and (ndim == 2 or array.shape[2] == 3)
    if not has_shape or array.dtype != dtype or array.size == 0:
        raise ValueError(
            f"{name} must be {np.dtype(dtype)} {shape}; got {array.dtype} {list(array.shape)}"
        )
