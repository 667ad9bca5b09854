"""Scores of style methods on photographs that were recoloured by known functions."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import torch

from augment.effects.style.network import load_network, network_facts
from augment.effects.style.pairs import (
    Method,
    closed_form_method,
    mapped_picture,
    network_method,
    score_pairs,
)
from augment.effects.style.statistics import reinhard_map
from augment.effects.style.train import read_photos
from tools.bench.harness import Table

PHOTO_PX = 256  # The side of the squares of photographs, pixels.
SCORED_EVERY = 8  # Every so many photographs one is scored, if the network's record names none.
PAIRS = 60  # The number of pairs of photographs that are checked for oversaturation.
# The share of further saturated pixels above which a picture is oversaturated.
OVERSATURATED = 0.2
SATURATED = 254.5 / 255  # The least channel of a saturated pixel: it is displayed as full.


def score_table(photos: Path) -> Table:
    """Score methods on photographs that the network was not trained on."""
    about = network_facts().get("about") or {}
    names = tuple(f"/{name}" for name in about.get("data", {}).get("held_out", ()))
    held_out = [file for file in sorted(photos.rglob("*")) if file.as_posix().endswith(names)]
    squares = (
        read_photos(held_out, PHOTO_PX, holdout=0).train
        if held_out
        else read_photos([photos], PHOTO_PX, holdout=SCORED_EVERY).held_out
    )
    pictures = squares.float() / 255
    methods = {
        "none": closed_form_method(strength=0.0),
        "reinhard": closed_form_method(reinhard_map),
        "mkl": closed_form_method(),
        "mkl, half": closed_form_method(strength=0.5),
        "gscm": network_method(load_network(None)),
    }
    rows = []
    for name, method in methods.items():
        scores = score_pairs(method, pictures, repeats=1)
        rows.append([name, *scores.values(), _oversaturated_share(method, pictures)])
    columns = ("method", "same", "half", "below", "look", "oversaturated")
    return Table(f"Methods on {len(pictures)} photos that are held out, PSNR in dB", columns, rows)


def _oversaturated_share(method: Method, photos: torch.Tensor) -> float:
    """Return the share of oversaturated pictures among PAIRS pairs of different photos.

    A picture is oversaturated if more of its pixels have a full channel than in content and style,
    by OVERSATURATED of all pixels.
    """

    def saturated(color_map: torch.Tensor, photo: torch.Tensor) -> float:
        return float((mapped_picture(color_map, photo) > SATURATED).any(0).float().mean())

    photo_pairs = list(itertools.permutations(photos, 2))
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(photo_pairs), generator=generator)[:PAIRS].tolist()
    eye = torch.eye(3, 4)
    beyond = []
    for content, style in (photo_pairs[index] for index in chosen):
        before = max(saturated(eye, photo) for photo in (content, style))
        beyond.append(saturated(method(content, style), content) - before)
    return float(np.mean(np.array(beyond) > OVERSATURATED))
