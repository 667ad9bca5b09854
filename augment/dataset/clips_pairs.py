"""Datasets made of other datasets: shards, splits, clean and weathered pairs, and clips.

Clips are consecutive frames of all cameras, for models that look at time or around the car.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
import torch
from torch import distributed
from torch.utils.data import Dataset, Sampler

from augment.dataset.samples import (
    Sample,
    buffers,
    check_choice,
    check_index,
    stack_cameras,
    stack_same_shape,
)
from augment.dataset.weather_dataset import Rows, WeatherDataset, number_groups
from augment.output.manifest import effect_masks

# ---- Samples dealt to all processes, the same again after an interruption ------------------------

Remainder = Literal["exact", "pad", "drop"]


class ShardedSampler(Sampler[int]):
    """One rank's share of an epoch, for `DataLoader(sampler=...)`.

    Every sample exactly once an epoch over all ranks, whatever their number and that of their
    workers: a DataLoader deals what its sampler gives out to its workers. The order depends on the
    seed and the epoch only, and rank r of R has its places r, r + R, r + 2 R, ...

    Args:
        samples: the dataset, or the number of samples.
        rank: number of this process; None takes torch.distributed's where it runs, else 0.
        ranks: number of processes; None takes torch.distributed's where it runs, else 1.
        shuffle: if False, the order is that of the samples.
        seed: seed of the order.
        remainder: what happens where the number of samples is no multiple of the ranks. `exact`:
            some ranks have one sample more. `pad`: the first places come again, so that all ranks
            have as many (collective operations wait for each other). `drop`: the last places are
            left out this epoch.

    To go on after an interruption, keep `state_dict(num_trained)` and load it into a sampler of the
    same samples and seed; the number of ranks may then be another. A DataLoader asks its sampler
    ahead of what it yields, so say how many samples of this rank were trained on.

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
        remainder: Remainder = "exact",
    ) -> None:
        process_rank, num_processes = _process_rank()
        self.rank = process_rank if rank is None else rank
        self.ranks = num_processes if ranks is None else ranks
        self.count = samples if isinstance(samples, int) else len(samples)
        self.shuffle = shuffle
        self.seed = seed
        self.remainder = remainder
        if not 0 <= self.rank < self.ranks:
            raise ValueError(f"rank must be 0 to {self.ranks - 1} of {self.ranks}; got {self.rank}")
        check_choice("remainder", remainder, Remainder)
        self.epoch = 0
        self._num_done = 0  # samples of all ranks before the place where the epoch goes on
        self._num_yielded = 0

    def set_epoch(self, epoch: int) -> None:
        """Begin another epoch, which has another order, at its start."""
        self.epoch = epoch
        self._num_done = 0
        self._num_yielded = 0

    def __iter__(self) -> Iterator[int]:
        self._num_yielded = 0
        for sample in self._share():
            self._num_yielded += 1
            yield sample

    def __len__(self) -> int:
        """Return the number of samples of this rank that the epoch still has."""
        num_remaining = max(self.count - self._num_done, 0)
        if self.remainder == "exact":
            return len(range(self.rank, num_remaining, self.ranks))
        return (
            -(-num_remaining // self.ranks)
            if self.remainder == "pad"
            else num_remaining // self.ranks
        )

    def state_dict(self, num_trained: int | None = None) -> dict[str, Any]:
        """Return the place in the epoch, in plain numbers that JSON holds.

        Args:
            num_trained: number of samples of this rank that were trained on since the epoch began
                or the last state was loaded: batches times their size. Every rank must have trained
                on the same number. None takes the number that this sampler yielded, which is right
                if no worker reads ahead.
        """
        ahead = (self._num_yielded if num_trained is None else num_trained) * self.ranks
        return {
            "epoch": self.epoch,
            "done": min(self._num_done + ahead, self.count),
            "seed": self.seed,
            "shuffle": self.shuffle,
            "count": self.count,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` stood.

        Raises:
            ValueError: the state is of another seed, order or number of samples.
        """
        expected_state = {"seed": self.seed, "shuffle": self.shuffle, "count": self.count}
        if wrong := {k: (state.get(k), v) for k, v in expected_state.items() if state.get(k) != v}:
            message = ", ".join(
                f"{name} {was} there and {now} here" for name, (was, now) in wrong.items()
            )
            raise ValueError(f"the state is of another sampler: {message}")
        # Both numbers are read before either is stored: a damaged state changes nothing.
        epoch = int(state["epoch"])
        num_done = int(state["done"])
        self.epoch = epoch
        self._num_done = num_done
        self._num_yielded = 0

    def _share(self) -> list[int]:
        """Return the samples of this rank that the epoch still has."""
        order = np.arange(self.count)
        if self.shuffle:
            np.random.default_rng([self.seed, self.epoch]).shuffle(order)
        remaining_samples = order[self._num_done :]
        if self.remainder == "pad" and len(remaining_samples):
            num_missing = -len(remaining_samples) % self.ranks
            remaining_samples = np.concatenate([remaining_samples, np.resize(order, num_missing)])
        return remaining_samples[self.rank :: self.ranks][: len(self)].tolist()


def _process_rank() -> tuple[int, int]:
    """Return rank and number of processes of torch.distributed, or 0 and 1."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


# ---- Splits --------------------------------------------------------------------------------------

_MOMENT = ("scene", "frame", "camera")  # columns that name the moment of an image
Splittable = TypeVar("Splittable", WeatherDataset, pa.Table)
DEFAULT_FRACTIONS: Mapping[str, float] = {"train": 0.8, "val": 0.2}


def split_by_scene(
    dataset: Splittable,
    fractions: Mapping[str, float] = DEFAULT_FRACTIONS,
    seed: int = 0,
    *,
    exact: bool = False,
) -> dict[str, Splittable]:
    """Split a dataset, or a manifest's table, by scenes; returns the parts by name.

    All variants, frames and cameras of a scene stay together. The part of a scene follows from its
    name and the seed. It does not change when other scenes are added or filtered out, when a part
    is renamed, or between machines. The price is that fractions hold on average only: of ten
    scenes, 0.2 is often none or four.

    Args:
        dataset: the dataset or table.
        fractions: parts of the scenes by name, in order; they add up to 1.
        seed: seed of the split.
        exact: if True, deal the scenes such that each part's number is off by less than one; a
            scene's part then depends on the others.

    Raises:
        ValueError: fractions are negative or do not add up to 1.
    """
    shares = list(fractions.values())
    if not shares or min(shares) < 0 or not math.isclose(sum(shares), 1, abs_tol=1e-9):
        raise ValueError(f"fractions must be >= 0 and add up to 1; got {dict(fractions)}")
    source: Any = dataset
    is_dataset = isinstance(dataset, WeatherDataset)
    column = source.rows["scene"] if is_dataset else source["scene"].combine_chunks()
    scenes = column.dictionary_encode()
    places = np.array([_place(name, seed) for name in scenes.dictionary.to_pylist()])
    if exact:
        places = (np.argsort(np.argsort(places, kind="stable")) + 0.5) / max(len(places), 1)
    part = np.searchsorted(np.cumsum(shares)[:-1], places, side="right")[scenes.indices.to_numpy()]
    select = source.select if is_dataset else lambda rows: source.filter(pa.array(rows))
    return {name: select(part == number) for number, name in enumerate(fractions)}


def _place(scene: str, seed: int) -> float:
    """Return a number in [0, 1) that depends on the scene's name and the seed only."""
    digest = hashlib.sha256(f"climategs split 1 {seed} {scene}".encode()).digest()
    return int.from_bytes(digest[:7], "big") / 2**56


# ---- Clean and weathered images of the same moment: side by side, or mixed into one dataset ------


def clean_frames(dataset: WeatherDataset, variant: str | None = None) -> WeatherDataset:
    """Select the images without weather and style, or those of one variant.

    Args:
        dataset: the dataset.
        variant: name of the variant; None selects images whose manifest lists no effect, and whose
            other weather numbers are all zero or absent.

    Raises:
        ValueError: the variant does not exist.
    """
    return dataset.select(clean_mask(dataset.rows, variant))


def clean_mask(rows: Rows, variant: str | None = None) -> np.ndarray:
    """Return the mask of rows that `clean_frames` selects, bool [N].

    Raises:
        ValueError: the variant does not exist.
    """
    if variant is None:
        return ~np.logical_or.reduce(list(masks_of(rows).values()))
    codes, names = rows.codes("variant")
    if variant not in names:
        raise ValueError(f"no variant {variant!r}; there are {', '.join(sorted(names))}")
    return codes == names.index(variant)


def masks_of(rows: Rows) -> dict[str, np.ndarray]:
    """Return, by the effects' names, the mask of rows that have the effect, bool [N]."""
    return effect_masks({name: rows.numbers(name) for name in rows.weather}, len(rows))


class PairedDataset(Dataset):
    """Every weathered image with the clean one of the same scene, frame and camera.

    clean, weathered: over one output folder or two; each with its own options and transform. A
    sample is `{"clean": sample, "weathered": sample}`, in the order of the weathered ones; those
    without a clean one are left out, `num_unpaired` of them. Cameras of a pair have the same pose,
    and the same size if their recipes' scale is the same.

        frames = WeatherDataset("out/fog")
        pairs = PairedDataset.of(frames)

    Raises:
        ValueError: two clean images of one moment, or no pair at all though both have images.
    """

    def __init__(self, clean: WeatherDataset, weathered: WeatherDataset) -> None:
        self.clean = clean
        self.weathered = weathered
        partner = _partners(clean.rows, weathered.rows)
        self._weathered_rows = np.flatnonzero(partner >= 0)
        self._clean_rows = partner[self._weathered_rows]
        self.num_unpaired = len(partner) - len(self._weathered_rows)
        if len(clean) and len(weathered) and not len(self):
            raise ValueError(
                "no clean image has the scene, frame and camera of a weathered one; render the "
                "same frames and cameras under both recipes"
            )

    @staticmethod
    def of(dataset: WeatherDataset, clean_variant: str | None = None) -> PairedDataset:
        """Return the pairs within one dataset: its clean images (`clean_frames`) and all others."""
        clean = clean_mask(dataset.rows, clean_variant)
        return PairedDataset(dataset.select(clean), dataset.select(~clean))

    def __len__(self) -> int:
        return len(self._weathered_rows)

    def __getitem__(self, index: int) -> dict[str, Any]:
        clean = int(self._clean_rows[index])
        weathered = int(self._weathered_rows[index])
        return {"clean": self.clean[clean], "weathered": self.weathered[weathered]}


class MixedDataset(Dataset):
    """The clean images, a part of them exchanged for weathered ones of the same moment.

    It is as long as `clean`. The sample of an index depends on the seed, the epoch and the index
    only: not on the worker, nor on earlier samples. Both datasets need the same `image_type` and
    `transform`, or their samples do not stack.

    Args:
        clean: the clean images.
        weathered: the weathered images; of several for one moment, each is as likely.
        fraction: probability of an exchange, where there is a weathered image.
        seed: seed of the exchanges.

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
            _check_alike(clean=clean, weathered=weathered)
            _check_alike(weathered=weathered, clean=clean)
        self.clean = clean
        self.weathered = weathered
        self.fraction = fraction
        self.seed = seed
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
        index = check_index(index, len(self))
        row = self.weathered_row(index)
        return self.clean[index] if row is None else self.weathered[row]

    def weathered_row(self, index: int) -> int | None:
        """Return the weathered row that replaces a clean image in this epoch; None: no row does."""
        start = self._ends[index]
        end = self._ends[index + 1]
        if start == end:
            return None
        rng = np.random.default_rng([self.seed, int(self._epoch), index])
        if rng.random() >= self.fraction:
            return None
        return int(self._rows[rng.integers(start, end)])


def _check_alike(**sides: WeatherDataset) -> None:
    """Raise ValueError where the first dataset lacks what the second one's samples have."""
    (name, first), (other, second) = sides.items()
    if names := sorted(second.available_kinds() - first.available_kinds()):
        raise ValueError(
            f"samples of `{name}` ({', '.join(first.uris)}) have no {', '.join(names)}, those of "
            f"`{other}` ({', '.join(second.uris)}) have: batches would not stack. Open both with a "
            f"`load` without it, or render it for `{name}` too"
        )


def _partners(clean: Rows, weathered: Rows) -> np.ndarray:
    """Return for each weathered row the clean row of its scene, frame and camera or -1, int64."""
    moment_columns = [pa.concat_arrays([clean[name], weathered[name]]) for name in _MOMENT]
    moments = number_groups(
        [column.dictionary_encode().indices.to_numpy() for column in moment_columns]
    )
    clean_moments = moments[: len(clean)]
    clean_rows = np.arange(len(clean))
    row_of = np.full(moments.max(initial=-1) + 1, -1)
    row_of[clean_moments] = clean_rows
    if (repeated_rows := np.flatnonzero(row_of[clean_moments] != clean_rows)).size:
        row = clean.row(int(repeated_rows[0]))
        raise ValueError(
            f"scene {row['scene']!r}, frame {row['frame']}, camera {row['camera']!r} has more than "
            f"one clean image; choose a variant: clean_frames(dataset, variant)"
        )
    return row_of[moments[len(clean) :]]


# ---- Clips ---------------------------------------------------------------------------------------

MAX_LATE = 1.5  # longest time between frames without a gap, in usual intervals
_PER_FRAME = ("sizes_m", "labels", "track_ids", "attributes", "frame")  # keys equal for all cameras
_POSES = ("centers_m", "quats")  # keys equal for all cameras unless in the camera's frame


class ClipDataset(Dataset):
    """Clips of `length` frames of one scene under one variant, each with all cameras.

    Args:
        frames: the dataset of the frames, which is used without its own `transform`.
        length: frames a clip, T.
        step: recorded frames from one frame of a clip to the next.
        stride: recorded frames from one clip's first frame to the next clip's.
        cameras: names in the order of the samples; None for all that a variant has.
        transform: called with every clip.

    Frames follow each other where their numbers do (by the smallest distance that the variant's
    numbers have) and their times: one that comes later than 1.5 of the usual intervals, or lacks a
    camera, ends the clips before it. So a clip never spans a gap, two scenes or two variants.

    A clip is a sample (`augment.dataset.samples`) with two dimensions more, of T frames and C
    cameras:

        image             [T, C, 3, H, W]; where sizes differ, a list of T lists of C; likewise
                          depth, semantic, instance, water, snow
        boxes             a list of T: a frame's boxes once, its numbers for each image [C, B]
                          (visibility, hidden_fraction, ...); in the camera's frame centers_m
                          [C, B, 3] and quats [C, B, 4] too
        lidar             a list of T
        camera            name: a list of C. K [T, C, 3, 3], world_from_camera [T, C, 4, 4],
                          world_from_ego [T, 4, 4]; width, height, timestamp_ns int64 [T, C]
        paths             a list of T lists of C
        frame             int64 [T]
        scene, variant, weather, recipe_hash, surface: as in a sample

    Raises:
        ValueError: numbers below 1, or a camera that no variant has.
    """

    def __init__(
        self,
        frames: WeatherDataset,
        length: int,
        *,
        step: int = 1,
        stride: int = 1,
        cameras: Sequence[str] | None = None,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        numbers = {"length": length, "step": step, "stride": stride}
        if min(numbers.values()) < 1:
            raise ValueError(f"length, step and stride must be >= 1; got {numbers}")
        self.frames = frames
        self.transform = transform
        self._runs = list(_runs(frames.rows, cameras))
        self._steps = np.arange(length) * step
        # Each clip has the number of its run and the place of its first frame in the run.
        starts = [
            (run, start)
            for run in range(len(self._runs))
            for start in range(0, len(self._runs[run]) - int(self._steps[-1]), stride)
        ]
        self._starts = np.array(starts, np.int64).reshape(-1, 2)

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, index: int) -> Any:
        clip = join_clip(
            [
                # All cameras see the same sweep.
                [
                    self.frames.sample(row, without=("lidar",) if camera else ())
                    for camera, row in enumerate(rows)
                ]
                for rows in self.row_numbers(index).tolist()
            ]
        )
        return clip if self.transform is None else self.transform(clip)

    def row_numbers(self, index: int) -> np.ndarray:
        """Return the numbers of the clip's images in `frames`, int64 [T, C]."""
        run, start = self._starts[check_index(index, len(self), "clip")]
        return self._runs[run][start + self._steps]


def join_clip(frames: Sequence[Sequence[Sample]]) -> dict[str, Any]:
    """Join samples [T][C] to one clip."""
    first = [frame[0] for frame in frames]
    clip = dict(first[0])
    for key in ("image", *buffers()):
        clip[key] = _joined([[sample[key] for sample in frame] for frame in frames])
    if clip["boxes"] is not None:
        clip["boxes"] = [_boxes([sample["boxes"] for sample in frame]) for frame in frames]
    sweeps = [sample["lidar"] for sample in first]
    clip["lidar"] = None if all(sweep is None for sweep in sweeps) else sweeps
    clip["camera"] = _cameras([[sample["camera"] for sample in frame] for frame in frames])
    clip["paths"] = [[sample["paths"] for sample in frame] for frame in frames]
    clip["frame"] = torch.tensor([sample["frame"] for sample in first])
    return clip


def _joined(values: list[list[Any]]) -> Any:
    """Stack tensors [T][C].

    Returns:
        The stack; None if all are None; the lists if they differ in shape.
    """
    stack = stack_same_shape([value for frame in values for value in frame])
    if isinstance(stack, torch.Tensor):
        return stack.unflatten(0, (len(values), -1))
    return None if stack is None else values


def _boxes(camera_boxes: list[dict[str, Any]]) -> dict[str, Any]:
    """Join a frame's boxes. Values that depend on the camera gain a dimension of C cameras."""
    shared_keys = _PER_FRAME if camera_boxes[0]["frame"] == "camera" else (*_PER_FRAME, *_POSES)
    return {
        key: value
        if key in shared_keys or value is None
        else torch.stack([b[key] for b in camera_boxes])
        for key, value in camera_boxes[0].items()
    }


def _cameras(cameras: list[list[Mapping[str, Any]]]) -> dict[str, Any]:
    """Stack cameras [T][C]."""
    stack = stack_cameras([stack_cameras(frame, torch.stack) for frame in cameras], torch.stack)
    ego = stack["world_from_ego"][:, 0]
    return {**stack, "name": stack["name"][0], "world_from_ego": ego}


def _runs(rows: Rows, cameras: Sequence[str] | None) -> Iterator[np.ndarray]:
    """Yield row numbers int64 [F, C] of frames that follow each other without a gap."""
    camera, names = rows.codes("camera")
    frames = rows.numbers("frame")
    times = rows.numbers("timestamp_ns")
    code_of_camera = {names[code]: code for code in np.unique(camera)}
    if cameras is not None and (
        unknown := [name for name in cameras if name not in code_of_camera]
    ):
        raise ValueError(f"no camera {unknown}; there are {', '.join(code_of_camera) or 'none'}")
    for numbers in _by_variant(rows):
        codes = camera[numbers]
        camera_codes = (
            np.unique(codes) if cameras is None else [code_of_camera[name] for name in cameras]
        )
        frame_numbers, place = np.unique(frames[numbers], return_inverse=True)
        table = np.full((len(frame_numbers), len(camera_codes)), -1, np.int64)
        for column, code in enumerate(camera_codes):
            camera_mask = codes == code
            table[place[camera_mask], column] = numbers[camera_mask]
        is_complete = (table >= 0).all(axis=1)
        if is_complete.any():
            # Frame numbers farther apart than the variant's closest ones, and late images.
            frame_step = np.diff(frame_numbers).min(initial=np.iinfo(np.int64).max)
            breaks = (np.diff(frame_numbers[is_complete]) > frame_step) | _late(
                times[table[is_complete]]
            )
            yield from np.split(table[is_complete], np.flatnonzero(breaks) + 1)


def _by_variant(rows: Rows) -> Iterator[np.ndarray]:
    """Yield the numbers of the rows of each scene under each variant, in the order of the rows."""
    group = rows.groups()[1]
    order = np.argsort(group, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(group[order])) + 1) if len(order) else ()


def _late(clock_ns: np.ndarray) -> np.ndarray:
    """Return the mask of frames before which any camera's image is late, bool [F - 1].

    Args:
        clock_ns: times of the images, int64 [F, C].
    """
    waits_ns = np.diff(clock_ns, axis=0)
    interval_ns = np.median(waits_ns, axis=0) if len(waits_ns) else np.zeros(clock_ns.shape[1])
    is_late = (waits_ns > MAX_LATE * interval_ns) | (waits_ns < 0)
    return np.logical_or.reduce(is_late, axis=1)
