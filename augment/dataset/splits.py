"""Training, validation and test sets that share no scene."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from augment.dataset.files import WeatherDataset

Splittable = TypeVar("Splittable", WeatherDataset, pa.Table)
DEFAULT_FRACTIONS: Mapping[str, float] = {"train": 0.8, "val": 0.2}


def split_by_scene(
    whole: Splittable,
    fractions: Mapping[str, float] = DEFAULT_FRACTIONS,
    seed: int = 0,
    *,
    exact: bool = False,
) -> dict[str, Splittable]:
    """The parts of a dataset, or of a manifest's table, by name; each scene is in one of them.

    All variants, frames and cameras of a scene stay together. Which part a scene belongs to follows
    from its name and the seed: it does not change when other scenes are added or filtered out, when
    a part is renamed, or between machines. The price is that fractions hold on average only: of ten
    scenes, 0.2 is often none or four.

    fractions: of the scenes, in order; they add up to 1. exact: deal the scenes that there are
    such that each part's number is off by less than one; a scene's part then depends on the others.

    Raises:
        ValueError: fractions that are negative or do not add up to 1.
    """
    shares = list(fractions.values())
    if not shares or min(shares) < 0 or not math.isclose(sum(shares), 1, abs_tol=1e-9):
        raise ValueError(f"fractions must be >= 0 and add up to 1; got {dict(fractions)}")
    names, codes = _scenes(whole)
    places = np.array([_place(name, seed) for name in names])
    if exact:
        order = np.argsort(np.argsort(places, kind="stable"), kind="stable")
        places = (order + 0.5) / max(len(names), 1)
    ends = np.cumsum(shares)[:-1]
    part_of = np.searchsorted(ends, places, side="right")
    rows = part_of[codes] if len(names) else np.zeros(0, np.int64)
    parts = {}
    for number, name in enumerate(fractions):
        mask = rows == number
        part = whole.select(mask) if isinstance(whole, WeatherDataset) else _filtered(whole, mask)
        parts[name] = part
    return parts


def _filtered(table: Any, mask: np.ndarray) -> Any:
    return table.filter(pa.array(mask))


def _scenes(whole: WeatherDataset | pa.Table) -> tuple[list[str], np.ndarray]:
    """The names of the scenes that there are, sorted, and each row's number of its scene."""
    if isinstance(whole, WeatherDataset):
        column = whole.rows.coded("scene")
        present, codes = np.unique(column.codes, return_inverse=True)
        names = [column.values[code] for code in present]
    else:
        found, codes = np.unique(
            whole["scene"].to_numpy(zero_copy_only=False).astype(str), return_inverse=True
        )
        names = found.tolist()
    return names, codes


def _place(scene: str, seed: int) -> float:
    """Where a scene stands between 0 and 1."""
    digest = hashlib.sha256(f"climategs split 1 {seed} {scene}".encode()).digest()
    return int.from_bytes(digest[:7], "big") / 2**56
