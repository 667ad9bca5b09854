"""Clean and weathered images of the same moment: side by side, or mixed into one dataset."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from augment.dataset.files import WeatherDataset
from augment.dataset.rows import Rows

# What says that an effect is there; its other numbers may be given without it. Water at a level of
# 0 is water.
_PRESENCE = {
    "smog": ("smog_extinction_per_m", False),
    "flood": ("flood_level_m", True),
    "snow": ("snow_depth_m", False),
    "style": ("style_strength", False),
}


def clean_frames(dataset: WeatherDataset, variant: str | None = None) -> WeatherDataset:
    """The images without weather and style, or those of one variant.

    Without a variant's name: those whose manifest says no smog, flood, snow or style, and whose
    other weather numbers are all zero or absent.

    Raises:
        ValueError: there is no such variant.
    """
    rows = dataset.rows
    if variant is None:
        return dataset.select(clean_mask(rows))
    names = rows.coded("variant")
    if variant not in names.values:
        raise ValueError(f"no variant {variant!r}; there are {', '.join(sorted(names.values))}")
    return dataset.select(names.codes == names.values.index(variant))


def clean_mask(rows: Rows) -> np.ndarray:
    """bool [N]: rows without weather and style."""
    clean = np.ones(len(rows), bool)
    for name in rows.weather:
        leading, zero_is_present = _PRESENCE.get(name.partition("_")[0], (name, False))
        if name != leading:
            continue
        numbers = rows.numbers(name).astype(np.float64)
        clean &= np.isnan(numbers) | ((numbers == 0) & (not zero_is_present))
    return clean


class PairedDataset(Dataset):
    """Every weathered image with the clean one of the same scene, frame and camera.

    clean, weathered: over one output folder or two; each with its own options and transform. A
    sample is `{"clean": sample, "weathered": sample}`, in the order of the weathered ones; those
    without a clean one are left out, `unpaired` of them. Cameras of a pair have the same pose, and
    the same size if their recipes' scale is the same.

        frames = WeatherDataset("out/fog")
        pairs = PairedDataset.of(frames)

    Raises:
        ValueError: two clean images of one moment, or no pair at all though both have images.
    """

    def __init__(self, clean: WeatherDataset, weathered: WeatherDataset) -> None:
        self.clean, self.weathered = clean, weathered
        partner = _partners(clean.rows, weathered.rows)
        self._weathered_rows = np.flatnonzero(partner >= 0)
        self._clean_rows = partner[self._weathered_rows]
        self.unpaired = len(partner) - len(self._weathered_rows)
        if len(clean) and len(weathered) and not len(self):
            raise ValueError(
                "no clean image has the scene, frame and camera of a weathered one; render the "
                "same frames and cameras under both recipes"
            )

    @staticmethod
    def of(dataset: WeatherDataset, clean_variant: str | None = None) -> PairedDataset:
        """The pairs within one dataset: its clean images (`clean_frames`) and all others."""
        clean = clean_frames(dataset, clean_variant)
        if clean_variant is None:
            others = ~clean_mask(dataset.rows)
        else:
            names = dataset.rows.coded("variant")
            others = names.codes != names.values.index(clean_variant)
        return PairedDataset(clean, dataset.select(others))

    def __len__(self) -> int:
        return len(self._weathered_rows)

    def __getitem__(self, index: int) -> dict[str, Any]:
        clean, weathered = int(self._clean_rows[index]), int(self._weathered_rows[index])
        return {"clean": self.clean[clean], "weathered": self.weathered[weathered]}


class MixedDataset(Dataset):
    """The clean images, a part of them exchanged for weathered ones of the same moment.

    As long as `clean`. fraction: the probability of an exchange, where there is a weathered image;
    which of several is drawn too, each as likely. What an index yields depends on the seed, the
    epoch and the index only: not on the worker, nor on what was asked before. Both datasets need
    the same `image_type` and `transform`, or their samples do not stack.

    Raises:
        ValueError: a fraction outside 0 to 1, two clean images of one moment, or one dataset's
            samples have what the other's lack (masks of water and snow excepted).
    """

    def __init__(
        self, clean: WeatherDataset, weathered: WeatherDataset, fraction: float, *, seed: int = 0
    ) -> None:
        if not 0 <= fraction <= 1:
            raise ValueError(f"fraction must be 0 to 1; got {fraction}")
        if len(clean) and len(weathered):
            _check_alike(clean, weathered)
        self.clean, self.weathered, self.fraction, self.seed = clean, weathered, fraction, seed
        partner = _partners(clean.rows, weathered.rows)
        # The weathered rows of clean row i are _rows[_ends[i]:_ends[i + 1]].
        self._rows = np.argsort(partner, kind="stable")[np.count_nonzero(partner < 0) :]
        counts = np.bincount(partner[partner >= 0], minlength=len(clean))
        self._ends = np.concatenate([[0], np.cumsum(counts)])
        # Shared memory: workers that live on (persistent_workers) see a new epoch too.
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def set_epoch(self, epoch: int) -> None:
        """Draw anew, as another epoch does; before its first sample is asked for."""
        self._epoch.fill_(epoch)

    def __len__(self) -> int:
        return len(self.clean)

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of a dataset of {len(self)}")
        row = self.weathered_row(index % len(self))
        return self.clean[index] if row is None else self.weathered[row]

    def weathered_row(self, index: int) -> int | None:
        """Which weathered image this epoch has in place of a clean one; None: the clean one."""
        start, end = self._ends[index], self._ends[index + 1]
        if start == end:
            return None
        rng = np.random.default_rng([self.seed, int(self._epoch), index])
        if rng.random() >= self.fraction:
            return None
        return int(self._rows[rng.integers(start, end)])


def _check_alike(clean: WeatherDataset, weathered: WeatherDataset) -> None:
    sides = {"clean": clean, "weathered": weathered}
    for name, other in (("clean", "weathered"), ("weathered", "clean")):
        if lacking := sorted(sides[other].given() - sides[name].given()):
            raise ValueError(
                f"samples of `{name}` ({', '.join(sides[name].uris)}) have no "
                f"{', '.join(lacking)}, those of `{other}` ({', '.join(sides[other].uris)}) have: "
                f"batches would not stack. Open both with a `load` without it, or render it for "
                f"`{name}` too"
            )


def _partners(clean: Rows, weathered: Rows) -> np.ndarray:
    """int64: of each weathered row the clean row of its scene, frame and camera, or -1."""
    wanted, keys = _keys(clean, weathered)
    order = np.argsort(wanted, kind="stable")
    ordered = wanted[order]
    if (twice := np.flatnonzero(ordered[1:] == ordered[:-1])).size:
        row = int(order[twice[0]])
        raise ValueError(
            f"scene {clean['scene'][row]!r}, frame {clean['frame'][row]}, camera "
            f"{clean['camera'][row]!r} has more than one clean image; choose a variant: "
            f"clean_frames(dataset, variant)"
        )
    if not len(ordered):
        return np.full(len(keys), -1)
    place = np.searchsorted(ordered, keys).clip(max=len(ordered) - 1)
    return np.where(ordered[place] == keys, order[place], -1)


def _keys(one: Rows, other: Rows) -> tuple[np.ndarray, np.ndarray]:
    """A number for each row's scene, frame and camera, the same in both."""
    keys, sizes = np.zeros(len(one) + len(other), np.int64), []
    for name in ("scene", "frame", "camera"):
        columns = one.coded(name), other.coded(name)
        values = {
            value: n for n, value in enumerate(dict.fromkeys(columns[0].values + columns[1].values))
        }
        codes = [
            np.array([values[value] for value in column.values], np.int64)[column.codes]
            for column in columns
            if len(column)
        ]
        sizes.append(len(values))
        keys = keys * len(values) + np.concatenate([np.zeros(0, np.int64), *codes])
    assert math.prod(sizes) < 2**63
    return keys[: len(one)], keys[len(one) :]
