"""The losses of photo pairs, as the trainer takes them."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from augment.style.network import Gscm
from augment.style.pair_losses import PairWeights, pair_losses, weighted
from augment.style.pairs import PairBatch, sample_pairs
from augment.style.train_pool import TrainingPool
from augment.style.trainer import PairLoss


def pair_loss_of(pool: TrainingPool, weights: PairWeights, device: str = "cpu") -> PairLoss | None:
    """The pairs' losses in sum, over the pool's photos and views; None where it holds only one."""
    pictures = pool.pictures()
    if len(pictures) < 2:
        return None

    def loss(net: Gscm, generator: torch.Generator, batch: int) -> Tensor:
        pairs = sample_pairs(pictures, generator, batch, size_px=pool.size_px)
        if device != "cpu":
            fields = (field.name for field in dataclasses.fields(pairs))
            pairs = PairBatch(**{name: getattr(pairs, name).to(device) for name in fields})
        return weighted(pair_losses(net, pairs), weights)

    return loss
