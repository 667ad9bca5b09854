"""Photographs to train the style network on, and to score it with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from augment.errors import StyleError
from augment.style.images import read_style_image

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
LEAST_TO_HOLD_OUT = 5  # of fewer photos none is spared


@dataclass(frozen=True, eq=False)
class Photos:
    """Photographs as squares. train, held_out: uint8 [P, 3, S, S], RGB. problems: a sentence for
    each file that could not be read.
    """

    train: UInt8[Tensor, "P 3 S S"]
    held_out: UInt8[Tensor, "Q 3 S S"]
    problems: tuple[str, ...] = ()


def read_photos(paths: Sequence[Path], size_px: int, *, holdout: int) -> Photos:
    """The images of files and folders, searched through, squeezed to size_px x size_px.

    holdout: every so many of them, in order of their paths, is kept apart; 0 for none.

    Raises:
        StyleError: no such file or folder, one without images, or no image that can be read.
    """
    files = _find(paths)
    squares: list[np.ndarray] = []
    problems: list[str] = []
    for file in files:
        try:
            rgb = read_style_image(file).rgb
        except StyleError as error:
            problems.append(f"left out: {error}")
            continue
        small = cv2.resize(rgb, (size_px, size_px), interpolation=cv2.INTER_AREA)
        squares.append((small.clip(0, 1) * 255).round().astype(np.uint8).transpose(2, 0, 1))
    if problems:
        problems.append(f"{len(problems)} of {len(files)} images were left out")
    if files and not squares:
        raise StyleError(f"none of {len(files)} images can be read; the first: {problems[0]}")
    if not squares:
        empty = torch.zeros(0, 3, size_px, size_px, dtype=torch.uint8)
        return Photos(empty, empty)
    pixels = torch.from_numpy(np.stack(squares))
    apart = torch.zeros(len(pixels), dtype=torch.bool)
    if holdout and len(pixels) >= LEAST_TO_HOLD_OUT:
        apart[holdout - 1 :: holdout] = True
    return Photos(pixels[~apart], pixels[apart], tuple(problems))


def _find(paths: Sequence[Path]) -> list[Path]:
    found: dict[Path, None] = {}
    for path in paths:
        if path.is_file():
            found[path] = None
            continue
        if not path.is_dir():
            raise StyleError(f"photos: there is no file or folder {path}")
        inside = sorted(p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
        if not inside:
            raise StyleError(
                f"photos: {path} holds no images ({', '.join(SUFFIXES)}), nor do folders in it"
            )
        found.update(dict.fromkeys(inside))
    return list(found)
