"""The content of a SOG's meta.json, versions 1 and 2, and the numbers that its images' bytes mean.

`augment.files.sog` names the sources.
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

CODEBOOK_SIZE = 256  # numbers of a codebook
NUM_SH_REST = (0, 3, 8, 15)  # coefficients a channel beyond the first, by bands
MAX_PALETTE = 1 << 16  # entries of a palette


class _Part(BaseModel):
    """Base of meta.json's objects."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, strict=True)


def _patch_codebook(codebook: object) -> object:
    """Replace a null in the first place of a codebook, as PlayCanvas does; early files have it."""
    if isinstance(codebook, list) and codebook[:1] == [None] and len(codebook) == CODEBOOK_SIZE:
        second = codebook[1]
        last = codebook[-1]
        if isinstance(second, int | float) and isinstance(last, int | float):
            return [second + (second - last) / (CODEBOOK_SIZE - 1), *codebook[1:]]
    return codebook


_Codebook = Annotated[
    list[float],
    BeforeValidator(_patch_codebook),
    Field(min_length=CODEBOOK_SIZE, max_length=CODEBOOK_SIZE),
]
_Three = Annotated[list[float], Field(min_length=3, max_length=3)]
_OneFile = Annotated[list[str], Field(min_length=1, max_length=1)]
_TwoFiles = Annotated[list[str], Field(min_length=2, max_length=2)]
_Four = Annotated[list[float], Field(min_length=4, max_length=4)]
_Shape = Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1, max_length=4)]


class _Means(_Part):
    """Ranges and files of the positions."""

    mins: _Three  # smallest signed logarithm of each coordinate
    maxs: _Three  # largest
    files: _TwoFiles  # images of the low and the high bytes


class _Coded(_Part):
    """Numbers stored by a codebook."""

    codebook: _Codebook
    files: _OneFile


class _Quats(_Part):
    """The file of the rotations."""

    files: _OneFile


class Palette(_Part):
    """Spherical harmonics stored by a palette."""

    count: int = Field(ge=1, le=MAX_PALETTE)  # entries
    bands: int = Field(ge=1, le=3)  # bands of spherical harmonics beyond the first
    codebook: _Codebook
    files: _TwoFiles  # images of the entries and of each Gaussian's entry


class _Asset(_Part):
    """Facts about the file."""

    generator: str = ""  # the program that wrote it


class SogMeta(_Part):
    """The content of meta.json."""

    version: Literal[2]
    count: int = Field(ge=1)
    means: _Means
    scales: _Coded
    quats: _Quats
    sh0: _Coded
    shN: Palette | None = None
    climategs: dict[str, str] = {}
    asset: _Asset = _Asset()
    antialias: bool = False  # True if the splats were trained for an antialiasing renderer


class _MeansWithShape(_Means):
    """Ranges, files and shape of the positions in version 1."""

    shape: _Shape  # the number of Gaussians, and 3


class _RangedScales(_Part):
    """Logarithms of scales in version 1."""

    mins: _Three
    maxs: _Three
    files: _OneFile


class _RangedColours(_Part):
    """Colours and logits of opacities in version 1."""

    mins: _Four
    maxs: _Four
    files: _OneFile


class RangedPalette(_Part):
    """Spherical harmonics of version 1, stored by a palette whose size its image tells."""

    mins: float
    maxs: float
    files: _TwoFiles


class SogMetaVersion1(_Part):
    """The content of meta.json in version 1."""

    means: _MeansWithShape
    scales: _RangedScales
    quats: _Quats
    sh0: _RangedColours
    shN: RangedPalette | None = None

    @property
    def count(self) -> int:
        """Return the number of Gaussians."""
        return self.means.shape[0]


class CodeNumbers(NamedTuple):
    """The numbers that the bytes of the images stand for; float32."""

    scales: np.ndarray  # [256, 3], logarithms
    colours: np.ndarray  # [256, 3]
    opacities: np.ndarray  # [256]
    sh: np.ndarray | None  # [256], beyond the first


def code_numbers(meta: SogMeta | SogMetaVersion1) -> CodeNumbers:
    """Return the numbers that the bytes of the images stand for."""
    with np.errstate(over="ignore", invalid="ignore"):  # infinite ones are left out, and reported
        if isinstance(meta, SogMeta):
            return CodeNumbers(
                scales=np.repeat(_as_column(meta.scales.codebook), 3, axis=1),
                colours=np.repeat(_as_column(meta.sh0.codebook), 3, axis=1),
                opacities=(np.arange(256) / 255.0).astype(np.float32),
                sh=None if meta.shN is None else _as_column(meta.shN.codebook)[:, 0],
            )
        fractions = np.arange(256)[:, None] / 255.0
        scales = _in_range(fractions, meta.scales.mins, meta.scales.maxs)
        colours = _in_range(fractions, meta.sh0.mins, meta.sh0.maxs)
        logits = torch.from_numpy(colours[:, 3].astype(np.float64))
        sh = None
        if meta.shN is not None:
            sh = _in_range(fractions, [meta.shN.mins], [meta.shN.maxs])[:, 0]
        return CodeNumbers(scales, colours[:, :3], logits.sigmoid().float().numpy(), sh)


def _as_column(codebook: list[float]) -> np.ndarray:
    """Return a codebook as float32 [256, 1]."""
    return np.array(codebook).astype(np.float32)[:, None]


def _in_range(fractions: np.ndarray, mins: list[float], maxs: list[float]) -> np.ndarray:
    """Return numbers between the ends of ranges, float32 [256, C]."""
    low = np.array(mins, np.float64)
    return (low + (np.array(maxs, np.float64) - low) * fractions).astype(np.float32)
