"""Scores of style methods: perfect, useless and harmful methods get what they deserve."""

from __future__ import annotations

import pytest
import torch

from augment.effects.style.network import Gscm
from augment.effects.style.scores import (
    closed_method,
    identity_method,
    least_squares_limit,
    network_method,
    score_harm,
    score_pairs,
)


@pytest.fixture(scope="module")
def photos() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    rough = torch.rand((4, 3, 6, 6), generator=generator)
    smooth = torch.nn.functional.interpolate(rough, (32, 32), mode="bicubic")
    return (0.1 + 0.7 * smooth).clamp(0, 1)


def test_order_of_methods(photos):
    identity = score_pairs(identity_method, photos, repeats=1)
    half = score_pairs(closed_method("mkl", 0.5), photos, repeats=1)
    full = score_pairs(closed_method("mkl"), photos, repeats=1)
    assert identity.same < half.same < full.same
    assert identity.same == pytest.approx(identity.look)  # the style does not matter to it
    assert full.same > full.half and full.same > full.below and full.same > full.look
    # No linear map beats the best one; without an offset there are fewer.
    best = least_squares_limit(photos, offset=True, repeats=1)
    assert full.same <= best + 0.1  # the best before clamping
    assert least_squares_limit(photos, offset=False, repeats=1) < best
    assert score_pairs(closed_method("reinhard"), photos, repeats=1).same <= best + 0.1


def test_same_seed_same_scores(photos):
    first, again = (score_pairs(closed_method("reinhard"), photos, repeats=1) for _ in range(2))
    assert first == again
    assert score_pairs(closed_method("reinhard"), photos, repeats=1, seed=1) != first


def test_untrained_network_is_near_the_closed_form(photos):
    closed = score_pairs(closed_method("mkl"), photos, repeats=1)
    network = score_pairs(network_method(Gscm().eval()), photos, repeats=1)
    assert abs(network.same - closed.same) < 4


def test_no_change_does_no_harm(photos):
    found = score_harm(identity_method, photos)
    assert found.gradient_ssim == pytest.approx(1)
    assert found.oversaturated == 0
    assert found.conditioning == pytest.approx(1)


def test_harm_is_seen(photos):
    def bright(content, style):
        return 3 * torch.eye(3, 4)

    def thin(content, style):
        return torch.diag(torch.tensor([1.0, 0.5, 0.1]))[:, [0, 1, 2, 2]] * torch.tensor(
            [1, 1, 1, 0]
        )

    found = score_harm(bright, photos)
    assert found.oversaturated > 0.9
    assert found.gradient_ssim < 0.95
    assert score_harm(thin, photos).conditioning == pytest.approx(10)
