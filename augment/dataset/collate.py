"""Batches of samples for a DataLoader."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.utils.data import get_worker_info

IMAGES = ("image", "depth", "semantic", "instance", "water", "snow")
_MATRICES = ("K", "world_from_camera", "world_from_ego")


def collate_frames(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A batch of samples, for `DataLoader(collate_fn=collate_frames)`.

    Images and buffers of one size are stacked to [N, ...]; of unlike sizes they stay a list, as do
    masks of water and snow where a sample has none. camera: K [N, 3, 3], world_from_camera and
    world_from_ego [N, 4, 4] and int64 [N] tensors, name a list. weather: float64 [N] per number,
    NaN where a sample lacks it. Everything else, boxes above all, is a list with one entry a
    sample.

    Clips gain the same dimension in front: image [N, T, C, 3, H, W], K [N, T, C, 3, 3], frame
    [N, T]. Pairs become a dictionary of two batches.

    Raises:
        ValueError: some samples have an image or buffer that others lack, masks excepted: datasets
            of unlike outputs or `load` are mixed.
    """
    first = samples[0]
    if "weathered" in first and "clean" in first:
        return {side: collate_frames([pair[side] for pair in samples]) for side in first}
    batch: dict[str, Any] = {key: [sample[key] for sample in samples] for key in first}
    for key in IMAGES:
        if key not in ("water", "snow"):  # only such weather has these masks
            _check_all_have(key, samples)
        batch[key] = stacked(batch[key])
    batch["camera"] = _cameras(batch["camera"])
    numbers = dict.fromkeys(name for sample in samples for name in sample["weather"])
    batch["weather"] = {
        name: torch.tensor(
            [sample["weather"].get(name, float("nan")) for sample in samples], dtype=torch.float64
        )
        for name in numbers
    }
    batch["frame"] = _whole(batch["frame"])
    return batch


def _check_all_have(key: str, samples: Sequence[Mapping[str, Any]]) -> None:
    lacking = [sample for sample in samples if sample[key] is None]
    if 0 < len(lacking) < len(samples):
        names = {f"{sample['scene']}/{sample['variant']}": None for sample in lacking}
        raise ValueError(
            f"{len(lacking)} of a batch's {len(samples)} samples have no {key}: of scene/variant "
            f"{', '.join(names)}. Leave {key!r} out of `load` in all datasets that are mixed, or "
            f"mix only outputs that have it"
        )


def stacked(values: Sequence[Any]) -> Any:
    """Tensors of one shape as one tensor, in memory that a worker process shares with its parent;
    None where there are only None; else the list.
    """
    tensors = [value for value in values if isinstance(value, torch.Tensor)]
    if len(tensors) < len(values):
        return None if all(value is None for value in values) else list(values)
    first = tensors[0]
    if len({tensor.shape for tensor in tensors}) > 1:
        return tensors
    if get_worker_info() is None:
        return torch.stack(tensors)
    # Else the queue to the parent would copy the batch once more, as torch's own collate knows.
    size = (len(tensors), *first.shape)
    storage = first._typed_storage()._new_shared(first.numel() * len(tensors), device=first.device)
    return torch.stack(tensors, out=first.new(storage).resize_(size))


def _cameras(cameras: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    values = {key: [camera[key] for camera in cameras] for key in cameras[0]}
    return {
        key: column if key == "name" else stacked(column) if key in _MATRICES else _whole(column)
        for key, column in values.items()
    }


def _whole(values: Sequence[Any]) -> Any:
    """Numbers as int64 [N]; tensors stacked."""
    return stacked(values) if isinstance(values[0], torch.Tensor) else torch.tensor(values)
