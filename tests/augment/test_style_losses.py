"""The losses of the style network: hand-made values, and gradients against finite differences."""

import math

import pytest
import torch

from augment.effects.style.losses import (
    GaussianColors,
    color_distance,
    moments,
    picture_distance,
    style_loss,
    weighted_sum,
)


def colors(base, bands=None) -> GaussianColors:
    base = torch.tensor(base, dtype=torch.float64)[None]
    bands = torch.zeros(1, base.shape[1], 0, 3) if bands is None else torch.tensor(bands)[None]
    return GaussianColors(base, bands.double())


def random(*shape, seed=0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def test_higher_bands_take_the_linear_part_alone():
    swap = torch.tensor([[[0.0, 2, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3]]], dtype=torch.float64)
    mapped = colors([[0.5, 0.25, 1.0]], [[[0.3, 0.1, 0.0]]]).mapped(swap)
    assert mapped.base[0, 0].tolist() == pytest.approx([0.6, 0.7, 1.3])
    assert mapped.bands[0, 0, 0].tolist() == pytest.approx([0.2, 0.3, 0.0])


def test_every_item_has_its_own_map():
    maps = torch.stack([2 * torch.eye(3, 4), 3 * torch.eye(3, 4)])
    base, bands = torch.ones(2, 5, 3), torch.ones(2, 5, 3, 3)
    mapped = GaussianColors(base, bands).mapped(maps)
    for value in (mapped.base, mapped.bands):
        assert value[0].unique().tolist() == [2] and value[1].unique().tolist() == [3]


def test_distances_are_means():
    a = colors([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    b = colors([[0.3, 0.0, 0.0], [1.0, 0.4, 1.0]])
    assert float(color_distance(a, b)) == pytest.approx(0.9 / 6)
    banded = [colors([[0.5, 0.5, 0.5]], [[[x, 0.0, 0.0]] * 3]) for x in (0.0, 0.9)]
    assert float(color_distance(*banded)) == pytest.approx(0.3)  # base alike, bands by 0.9 / 3
    assert float(picture_distance(torch.zeros(1, 3, 2, 2), torch.full((1, 3, 2, 2), 0.25))) == 0.25


def test_style_loss_of_shifted_and_stretched_features():
    feature = random(2, 4, 6, 5)
    spread = moments(feature)[1]
    assert float(style_loss((feature,), (feature + 0.3,))) == pytest.approx(0.3, rel=1e-5)
    # Deviations double, means stay: what is left is the root mean square of the deviations.
    mean = feature.mean((2, 3), keepdim=True)
    wanted = float(spread.square().mean(1).sqrt().mean())
    stretched = mean + 2 * (feature - mean)
    assert float(style_loss((feature,), (stretched,))) == pytest.approx(wanted, rel=1e-4)
    both = style_loss((feature, feature), (feature + 0.3, stretched))
    assert float(both) == pytest.approx(0.3 + wanted, rel=1e-4)  # layers add up


def test_style_knows_nothing_of_places():
    feature = random(1, 3, 4, 4)
    shuffled = feature.flatten(2)[..., torch.randperm(16)].reshape(1, 3, 4, 4)
    other_size = feature.repeat(1, 1, 2, 3)
    for same in (shuffled, other_size):
        assert float(style_loss((feature,), (same,))) < 1e-5


def test_style_loss_has_gradients_also_of_constant_features():
    feature = random(1, 2, 3, 3).requires_grad_(True)
    target = random(1, 2, 3, 3, seed=1)
    assert torch.autograd.gradcheck(lambda x: style_loss((x,), (target,)), (feature,))
    constant = torch.full((1, 2, 3, 3), 0.5, requires_grad=True)
    style_loss((constant,), (target.float(),)).backward()
    assert torch.isfinite(constant.grad).all() and (constant.grad != 0).any()


def test_only_terms_that_weigh_something_count():
    terms = {"a": torch.tensor(2.0), "b": torch.tensor(math.nan), "c": torch.tensor(3.0)}
    assert float(weighted_sum(terms, {"a": 10.0, "b": 0.0, "c": 0.5})) == 21.5
    with pytest.raises(ValueError, match="none of the losses a, b, c weighs anything"):
        weighted_sum(terms, {"b": 0.0})
