"""Files of one view: first its buffers, last its image.

In: a rendered view, its paths and its recipe. Out: files and the image's checksum. `worker` calls
it. Every file is complete or absent.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from augment import effects
from augment.output.atomic import write_atomic
from augment.output.codecs import encode_depth, encode_ids, encode_image, encode_mask
from augment.output.layout import TRUST, mask_share_columns
from augment.scene.cameras import Camera
from augment.view.results import ViewResult
from recipes.schema import Recipe


@dataclass(frozen=True)
class ViewFiles:
    """Files of one view."""

    checksum: str
    """SHA-256 of the image file, hexadecimal."""
    files: tuple[str, ...]
    """Paths relative to the output folder."""
    encode_s: float
    """Seconds of encoding."""
    write_s: float
    """Seconds of writing."""
    measures: Mapping[str, float] = field(default_factory=dict)
    """Numbers that were measured of the image, by the manifest's column."""


# Field of a view, and the function that encodes it, by kind of path.
_BUFFERS: Mapping[str, tuple[str, Callable[[Any], bytes]]] = {
    "depth": ("depth_m", encode_depth),
    "semantic": ("semantic", partial(encode_ids, dtype=np.uint8)),
    "instance": ("instance", partial(encode_ids, dtype=np.uint16)),
}


def write_view(
    out_dir: Path, paths: Mapping[str, str | None], view: ViewResult, camera: Camera, recipe: Recipe
) -> ViewFiles:
    """Encode and write all files of a view that `check_view` has passed.

    Args:
        out_dir: Output folder.
        paths: Paths relative to the output folder, by kind.
        view: The view.
        camera: Camera of the view, at the written resolution.
        recipe: Recipe of the view.

    Raises:
        ValueError: A buffer has another type or shape than ViewResult says.
        OutputError: The system refuses; no partial file is left.
    """
    start_s = time.perf_counter()
    files: dict[str, bytes] = {}
    path_of_kind = {kind: path for kind, path in paths.items() if path is not None}
    for kind, (buffer, encode) in _BUFFERS.items():
        if kind in path_of_kind:
            files[path_of_kind[kind]] = encode(getattr(view, buffer))
    files |= {
        path_of_kind[name]: encode_ids(mask, np.uint8) if name == TRUST else encode_mask(mask)
        for name, mask in view.masks.items()
    }
    files[path_of_kind["image"]] = image = encode_image(view.rgb, recipe.output)
    checksum = hashlib.sha256(image).hexdigest()
    encoded_s = time.perf_counter()
    for relative, data in files.items():
        write_atomic(out_dir / relative, data, clear=False)
    write_s = time.perf_counter() - encoded_s
    measures = _measure(view, camera)
    return ViewFiles(checksum, tuple(files), encoded_s - start_s, write_s, measures)


def _measure(view: ViewResult, camera: Camera) -> dict[str, float]:
    """Return the numbers that the manifest has of a view: shares of masks, and effects' numbers."""
    columns = {mask: c for mask, c in mask_share_columns().items() if mask in view.masks}
    measures = {column: _mean_share(view.masks[mask]) for mask, column in columns.items()}
    for effect in effects.EFFECTS:
        if effect.measured_columns and effect.name in view.effects:
            measures |= effect.measure_view(camera, view.effects[effect.name])
    return measures


def _mean_share(mask: np.ndarray) -> float:
    """Return the mean of a mask, 0 to 1."""
    return int(mask.sum(dtype=np.int64)) / (255 * mask.size)
