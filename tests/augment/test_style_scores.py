"""Scores of style methods: perfect, useless and harmful methods get what they deserve."""

from __future__ import annotations

import pytest
import torch

from augment.effects.style.network import Gscm
from augment.effects.style.scores import (
    closed_method,
    network_method,
    oversaturated_share,
    score_pairs,
)

IDENTITY = closed_method("mkl", 0.0)


@pytest.fixture(scope="module")
def photos() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    rough = torch.rand((4, 3, 6, 6), generator=generator)
    smooth = torch.nn.functional.interpolate(rough, (32, 32), mode="bicubic")
    return (0.1 + 0.7 * smooth).clamp(0, 1)


def test_order_of_methods(photos):
    none, half, full = (
        score_pairs(closed_method("mkl", strength), photos, repeats=1)
        for strength in (0.0, 0.5, 1.0)
    )
    assert none.same < half.same < full.same
    assert none.same == pytest.approx(none.look)  # the style does not matter to it
    assert full.same > full.half and full.same > full.below and full.same > full.look


def test_same_seed_same_scores(photos):
    first, again = (score_pairs(closed_method("reinhard"), photos, repeats=1) for _ in range(2))
    assert first == again
    assert score_pairs(closed_method("reinhard"), photos, repeats=1, seed=1) != first


def test_untrained_network_is_near_the_closed_form(photos):
    closed = score_pairs(closed_method("mkl"), photos, repeats=1)
    network = score_pairs(network_method(Gscm().eval()), photos, repeats=1)
    assert abs(network.same - closed.same) < 4


def test_harm_is_seen(photos):
    def bright(content, style):
        return 3 * torch.eye(3, 4)

    assert oversaturated_share(IDENTITY, photos) == 0
    assert oversaturated_share(bright, photos) > 0.9
