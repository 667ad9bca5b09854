"""The losses of photo pairs, as the trainer takes them."""

from __future__ import annotations

import torch
from torch import Tensor

from augment.style.network import Gscm
from augment.style.pair_losses import PairWeights, pair_losses, weighted
from augment.style.pairs import sample_pairs
from augment.style.train_pool import TrainingPool
from augment.style.trainer import PairLoss


def pair_loss_of(pool: TrainingPool, weights: PairWeights) -> PairLoss | None:
    """The pairs' losses in sum, over the pool's photos and views, on the device where they lie;
    None where it holds only one.
    """
    pictures = pool.pictures()
    if len(pictures) < 2:
        return None

    def loss(net: Gscm, generator: torch.Generator, batch: int) -> Tensor:
        pairs = sample_pairs(pictures, generator, batch, size_px=pool.size_px)
        return weighted(pair_losses(net, pairs), weights)

    return loss
