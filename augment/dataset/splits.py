"""Training, validation and test sets that share no scene."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sized
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
import torch.distributed
from torch.utils.data import Sampler

from augment.dataset.weather_dataset import WeatherDataset

# ---- Who trains on which sample: dealt to all processes, the same again after an interruption ----

Uneven = Literal["exact", "pad", "drop"]
_UNEVEN = ("exact", "pad", "drop")


class ShardedSampler(Sampler[int]):
    """One rank's share of an epoch, for `DataLoader(sampler=...)`.

    Every sample exactly once an epoch over all ranks, whatever their number and that of their
    workers: a DataLoader deals what its sampler gives out to its workers. The order depends on the
    seed and the epoch only, and rank r of R has its places r, r + R, r + 2 R, ...

    samples: the dataset, or how many there are. ranks, rank: of torch.distributed where it runs,
    else 1 and 0. uneven: what happens where the count is no multiple of the ranks': `exact`, some
    ranks have one sample more; `pad`, the first places come again, so that all ranks have as many
    (collective operations wait for each other); `drop`, the last places are left out this epoch.

    To go on after an interruption, keep `state_dict(given)` and load it into a sampler of the same
    samples and seed; the number of ranks may then be another. A DataLoader asks its sampler ahead
    of what it yields, so say how many samples of this rank were trained on.

    Raises:
        ValueError: arguments that do not fit each other.
    """

    def __init__(
        self,
        samples: Sized | int,
        *,
        rank: int | None = None,
        ranks: int | None = None,
        shuffle: bool = True,
        seed: int = 0,
        uneven: Uneven = "exact",
    ) -> None:
        own_rank, own_ranks = _process_rank()
        self.rank = own_rank if rank is None else rank
        self.ranks = own_ranks if ranks is None else ranks
        self.count = samples if isinstance(samples, int) else len(samples)
        self.shuffle, self.seed, self.uneven = shuffle, seed, uneven
        if not 0 <= self.rank < self.ranks:
            raise ValueError(f"rank must be 0 to {self.ranks - 1} of {self.ranks}; got {self.rank}")
        if uneven not in _UNEVEN:
            raise ValueError(f"uneven must be one of {', '.join(_UNEVEN)}; got {uneven!r}")
        self.epoch = 0
        self._done = 0  # of all ranks' samples: where the epoch goes on
        self._given = 0

    def set_epoch(self, epoch: int) -> None:
        """Begin another epoch: another order, from its start."""
        self.epoch, self._done, self._given = epoch, 0, 0

    def __iter__(self) -> Iterator[int]:
        self._given = 0
        for sample in self._share():
            self._given += 1
            yield sample

    def __len__(self) -> int:
        """Samples of this rank that the epoch still has."""
        left = max(self.count - self._done, 0)
        if self.uneven == "exact":
            return len(range(self.rank, left, self.ranks))
        return -(-left // self.ranks) if self.uneven == "pad" else left // self.ranks

    def state_dict(self, given: int | None = None) -> dict[str, Any]:
        """Where the epoch stands, in plain numbers that JSON holds. given: samples of this rank
        that were trained on since the epoch began or the last state was loaded: batches times their
        size. None: those that this sampler gave out, which is right where no worker reads ahead.
        Every rank has given as many.
        """
        ahead = (self._given if given is None else given) * self.ranks
        return {
            "epoch": self.epoch,
            "done": min(self._done + ahead, self.count),
            "seed": self.seed,
            "shuffle": self.shuffle,
            "count": self.count,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` stood. Raises ValueError: the state is of another seed, order or
        number of samples.
        """
        own = {"seed": self.seed, "shuffle": self.shuffle, "count": self.count}
        if wrong := {k: (state.get(k), v) for k, v in own.items() if state.get(k) != v}:
            message = ", ".join(
                f"{name} {was} there and {now} here" for name, (was, now) in wrong.items()
            )
            raise ValueError(f"the state is of another sampler: {message}")
        self.epoch, self._done, self._given = int(state["epoch"]), int(state["done"]), 0

    def _share(self) -> list[int]:
        order = np.arange(self.count)
        if self.shuffle:
            np.random.default_rng([self.seed, self.epoch]).shuffle(order)
        left = order[self._done :]
        if self.uneven == "pad" and len(left):
            missing = -len(left) % self.ranks
            left = np.concatenate([left, np.resize(order, missing)])
        return left[self.rank :: self.ranks][: len(self)].tolist()


def _process_rank() -> tuple[int, int]:
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


# ---- splits --------------------------------------------------------------------------------------

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
