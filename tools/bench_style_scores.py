"""How well methods do on photographs that no network was trained on
(augment.effects.style.scores).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import UInt8
from torch import Tensor
from tqdm import tqdm

from augment.effects.style.scores import (
    Method,
    closed_method,
    identity_method,
    least_squares_limit,
    network_method,
    score_harm,
    score_pairs,
)
from augment.effects.style.train import read_photos
from tools.bench_style_network import BenchNetwork

HOLDOUT = 8  # as `climategs style train` holds photos out by default
MIN_PHOTOS = 2


@dataclass(frozen=True)
class ScoreCase:
    """size_px: of the square photos. repeats: recolourings a photo. pairs: of different photos."""

    size_px: int = 256
    repeats: int = 1
    pairs: int = 60


def bench_scores(
    network: BenchNetwork,
    photos: Sequence[Path],
    case: ScoreCase,
    *,
    holdout: int = HOLDOUT,
    progress: bool = True,
) -> dict[str, Any]:
    """Scores by method, or the reason why there are none. holdout: every so many photos are
    scored on where the network's file does not say which it was not trained on.
    """
    if not photos:
        return {"skipped": "no photos were given"}
    held_out = held_out_photos(photos, network.held_out, case.size_px, holdout)
    if len(held_out) < MIN_PHOTOS:
        return {"skipped": f"{len(held_out)} photos are held out; {MIN_PHOTOS} are needed"}
    pictures = held_out.float() / 255
    methods: dict[str, Method] = {
        "none": identity_method,
        "reinhard": closed_method("reinhard"),
        "mkl": closed_method("mkl"),
        "mkl, half": closed_method("mkl", 0.5),
    }
    if network.is_trained:
        methods[f"gscm ({network.facts['name']})"] = network_method(network.net)
    rows = []
    for name, method in tqdm(methods.items(), "scores", disable=not progress):
        good = score_pairs(method, pictures, repeats=case.repeats)
        harm = score_harm(method, pictures, pairs=case.pairs)
        rows.append({"method": name, **dataclasses.asdict(good), **dataclasses.asdict(harm)})
    return {
        "photos": len(pictures),
        "size_px": case.size_px,
        "methods": rows,
        "limits_db": {
            name: least_squares_limit(pictures, offset=offset, repeats=case.repeats)
            for name, offset in (("3x3", False), ("3x4", True))
        },
        "skipped": None if network.is_trained else "the network: no checkpoint is there",
    }


def held_out_photos(
    photos: Sequence[Path], names: Sequence[str], size_px: int, holdout: int
) -> UInt8[Tensor, "P 3 S S"]:
    """Squares of the photos of these names, with the folder's before them; of every `holdout`th
    photo where there are no names.
    """
    if not names:
        return read_photos(photos, size_px, holdout=holdout).held_out
    files = [f for path in photos for f in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    chosen = [file for file in files if file.as_posix().endswith(tuple(f"/{n}" for n in names))]
    return read_photos(chosen, size_px, holdout=0).train
