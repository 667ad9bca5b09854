"""Recolourings, pairs, losses and scores on them: drawn from a seed, in range, and learnable."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from augment.effects.style.losses import weighted_sum
from augment.effects.style.network import Gscm
from augment.effects.style.pairs import (
    GREY,
    PAIR_WEIGHTS,
    PairBatch,
    RecolorSettings,
    closed_method,
    network_method,
    pair_losses,
    recolor,
    sample_pairs,
    sample_recolorings,
    score_pairs,
)
from augment.effects.style.statistics import reinhard_map

STILL = RecolorSettings(*[0.0] * 11)


def photos(count: int = 3, px: int = 24) -> torch.Tensor:
    generator = torch.Generator().manual_seed(count)
    rough = torch.rand((count, 3, 4, 4), generator=generator)
    return torch.nn.functional.interpolate(rough, (px, px), mode="bilinear")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_seed_is_a_recolouring():
    images = photos()
    first, again, other = (recolor(images, seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.min() >= 0 and first.max() <= 1
    assert not torch.equal(first, images)


def test_grey_and_night_are_reached():
    images = photos(1).expand(64, -1, -1, -1)
    grey = sample_recolorings(64, seeded(), replace(STILL, grey_share=1.0))(images)
    spread = images.std(1).mean()
    assert (grey.std(1).mean((1, 2)) < 0.31 * spread).all()
    luma = torch.tensor(GREY)
    torch.testing.assert_close(  # what is taken away is colour alone
        torch.einsum("c,bchw->bhw", luma, grey), torch.einsum("c,bchw->bhw", luma, images)
    )
    night = sample_recolorings(64, seeded(), replace(STILL, night_share=1.0))(images)
    assert (night.mean((1, 2, 3)) < 0.4 * images.mean((1, 2, 3))).all()
    assert (night.mean((2, 3))[:, 2] / night.mean((2, 3))[:, 0]).mean() > 1.3 * (
        images.mean((2, 3))[:, 2] / images.mean((2, 3))[:, 0]
    ).mean()


def test_pairs_share_a_recolouring():
    state = torch.random.get_rng_state()
    batch, again = (sample_pairs(photos(4), seeded(), 5, size_px=16) for _ in range(2))
    assert batch.photos.shape == (5, 3, 16, 16)
    assert all(torch.equal(*both) for both in zip(batch, again, strict=True))
    assert (batch.photos - batch.others).abs().mean((1, 2, 3)).min() > 0.01
    # One recolouring for both: colours that both hold become the same colour.
    one = PairBatch(*(part[:1] for part in batch))
    near = torch.cdist(*(picture[0].flatten(1).T for picture in (one.photos, one.others)))
    first, second = divmod(int(near.argmin()), near.shape[1])
    became = (one.recolored[0].flatten(1)[:, first], one.others_recolored[0].flatten(1)[:, second])
    assert (became[0] - became[1]).abs().max() < 0.05 + 3 * float(near.min())
    assert torch.equal(torch.random.get_rng_state(), state)
    with pytest.raises(ValueError, match="at least 2 photos; got 1"):
        sample_pairs(photos(1), seeded(), 2, size_px=16)


def test_losses_fall_by_training():
    torch.manual_seed(0)
    net = Gscm()
    batch = sample_pairs(photos(6), seeded(), 2, size_px=32)
    optimizer = torch.optim.Adam(net.parameters(), 3e-4)
    totals = []
    for _ in range(8):
        losses = pair_losses(net, batch)
        total = weighted_sum(losses, PAIR_WEIGHTS | {"range": 4.0})
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < totals[0] - 0.1
    assert losses.keys() == {*PAIR_WEIGHTS, "range"}


# ---- scores -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scored() -> torch.Tensor:
    return 0.1 + 0.7 * photos(4, 32)


def test_order_of_methods(scored):
    none, half, full = (
        score_pairs(closed_method(strength=strength), scored, repeats=1)
        for strength in (0.0, 0.5, 1.0)
    )
    assert none["same"] < half["same"] < full["same"]
    assert none["same"] == pytest.approx(none["look"])  # the style does not matter to it
    assert full["same"] > max(full["half"], full["below"], full["look"])
    first, again = (score_pairs(closed_method(reinhard_map), scored, repeats=1) for _ in range(2))
    assert first == again != full


def test_untrained_network_is_near_the_closed_form(scored):
    closed = score_pairs(closed_method(), scored, repeats=1)
    network = score_pairs(network_method(Gscm().eval()), scored, repeats=1)
    assert abs(network["same"] - closed["same"]) < 4
