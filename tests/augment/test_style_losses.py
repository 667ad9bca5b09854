"""What the style network's losses see and are: VGG-19's weights from real files, the bank of
filters, hand-made values, and gradients against finite differences.
"""

import math
import pickle
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from augment.effects.style.losses import (
    FilterBank,
    GaussianColors,
    Vgg19,
    color_distance,
    moments,
    open_features,
    picture_distance,
    style_loss,
    weighted_sum,
)
from augment.errors import StyleError


def random(*shape, seed=0, dtype=torch.float32) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def random64(*shape, seed=0) -> torch.Tensor:
    return random(*shape, seed=seed, dtype=torch.float64)


@pytest.fixture
def weights() -> dict[str, torch.Tensor]:
    """As torchvision's file holds them, also of layers that are not looked at."""
    generator = torch.Generator().manual_seed(0)
    own = Vgg19().state_dict()
    made = {n: 0.05 * torch.randn(t.shape, generator=generator) for n, t in own.items()}
    return {**made, "features.21.weight": torch.ones(4), "classifier.0.bias": torch.ones(2)}


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_weights_of_a_file_are_used_layer_by_layer(tmp_path, weights, suffix):
    path = tmp_path / f"vgg19{suffix}"
    (save_file if suffix == ".safetensors" else torch.save)(weights, path)
    network = open_features(path)
    picture = random(1, 3, 18, 16)
    found = network(picture)
    x = (picture - torch.tensor([0.485, 0.456, 0.406])[:, None, None]) / torch.tensor(
        [0.229, 0.224, 0.225]
    )[:, None, None]
    wanted = []
    for number in (0, 2, "pool", 5, 7, "pool", 10, 12, 14, 16, "pool", 19):
        if number == "pool":
            x = F.max_pool2d(x, 2)
            continue
        name = f"features.{number}"
        x = F.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], padding=1).relu()
        if number in (0, 5, 10, 19):
            wanted.append(x)
    assert [tuple(f.shape) for f in found] == [tuple(w.shape) for w in wanted]
    assert all(torch.equal(f, w) for f, w in zip(found, wanted, strict=True))
    picture.requires_grad_(True)
    sum(layer.sum() for layer in network(picture)).backward()
    assert (picture.grad != 0).any() and all(p.grad is None for p in network.parameters())


class Evil:
    def __reduce__(self):
        return (print, ("run by a file of weights",))


def test_files_that_are_no_weights_are_refused(tmp_path, weights, capsys):
    name = "features.7.weight"
    pickled = tmp_path / "evil.pth"
    pickled.write_bytes(pickle.dumps(Evil()))
    text = tmp_path / "w.safetensors"
    text.write_bytes(b"nothing of the kind")
    for content, match in (
        ({n: t for n, t in weights.items() if n != name}, rf"'{name}' must be .*; got nothing"),
        ({**weights, name: torch.ones(4, 4, 1, 1)}, rf"'{name}' must be .* \[128, 128, 3, 3\]"),
        ({**weights, name: weights[name].to(torch.int8)}, "got torch.int8"),
        ({**weights, name: weights[name] * torch.nan}, f"'{name}' holds values .* not finite"),
        ([torch.ones(3)], "holds a list and not a state dict"),
        ({"model": weights}, "not a state dict of tensors"),
        (Evil(), "cannot be read as weights"),
        (pickled, "cannot be read as weights"),
        (text, r"cannot be read as weights: .*header"),
        (tmp_path / "absent.pth", "there is no such file"),
    ):
        path = content if isinstance(content, Path) else tmp_path / "w.pth"
        if path is not content:
            torch.save(content, path)
        with pytest.raises(StyleError, match=match):
            open_features(path)
    assert "run by" not in capsys.readouterr().out
    with pytest.raises(ValueError, match="at least 8 px a side"):
        Vgg19()(random(1, 3, 7, 20))


# ---- the bank of filters ----------------------------------------------------------------------


def test_a_constant_picture_has_colours_and_no_edges():
    color = torch.tensor([0.9, 0.5, 0.1])
    features = FilterBank()(color[None, :, None, None].expand(1, 3, 41, 34))
    assert len(features) == 6  # three levels of colours and edges
    for colors, edges in zip(features[::2], features[1::2], strict=True):
        assert torch.allclose(colors.std((2, 3)), torch.zeros(8), atol=1e-6)
        assert float(colors[0, 0, 0, 0]) == pytest.approx(1.5 / 3**0.5, abs=1e-6)
        assert colors[0, 3:6, 0, 0].tolist() == pytest.approx([0.9, 0.5, 0.1], abs=1e-6)
        assert edges.abs().max() < 1e-6


def test_a_ramp_has_one_edge_everywhere():
    ramp = torch.linspace(0, 1, 64).expand(1, 3, 64, 64)
    edges = FilterBank()(ramp)[1][..., 2:-2, 2:-2]
    slope = 2 * 3**0.5 * 2 / 63  # gain, luminance, the pixels of half the size
    rises, falls = edges[0, :12:3], edges[0, 12::3]  # of luminance, along x, y and diagonals
    assert torch.allclose(rises[0], torch.tensor(slope), atol=1e-5)
    assert rises[1].abs().max() < 1e-6 and falls[:2].abs().max() < 1e-6
    assert torch.allclose(rises[2], torch.tensor(slope / 2**0.5), atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (9, 5), (16, 16)])
def test_pictures_of_any_size_have_features_with_gradients(shape):
    picture = random(1, 3, *shape).double().requires_grad_(True)
    features = FilterBank()(picture)
    assert len(features) >= 1 and all(torch.isfinite(f).all() for f in features)
    weights = [random(*f.shape, seed=2).double() for f in features]
    total = sum((f * w).sum() for f, w in zip(features, weights, strict=True))
    (gradient,) = torch.autograd.grad(total, picture)
    step = 1e-6 * torch.randn(picture.shape, dtype=torch.float64)
    moved = sum((f * w).sum() for f, w in zip(FilterBank()(picture + step), weights, strict=True))
    assert float((moved - total).detach()) == pytest.approx(
        float((gradient * step).sum()), rel=1e-4, abs=1e-9
    )


# ---- losses ------------------------------------------------------------------------------------


def colors(base, bands=None) -> GaussianColors:
    base = torch.tensor(base, dtype=torch.float64)[None]
    bands = torch.zeros(1, base.shape[1], 0, 3) if bands is None else torch.tensor(bands)[None]
    return GaussianColors(base, bands.double())


def test_higher_bands_take_the_linear_part_alone():
    swap = torch.tensor([[[0.0, 2, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3]]], dtype=torch.float64)
    mapped = colors([[0.5, 0.25, 1.0]], [[[0.3, 0.1, 0.0]]]).mapped(swap)
    assert mapped.base[0, 0].tolist() == pytest.approx([0.6, 0.7, 1.3])
    assert mapped.bands[0, 0, 0].tolist() == pytest.approx([0.2, 0.3, 0.0])


def test_distances_are_means():
    a = colors([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    b = colors([[0.3, 0.0, 0.0], [1.0, 0.4, 1.0]])
    assert float(color_distance(a, b)) == pytest.approx(0.9 / 6)
    banded = [colors([[0.5, 0.5, 0.5]], [[[x, 0.0, 0.0]] * 3]) for x in (0.0, 0.9)]
    assert float(color_distance(*banded)) == pytest.approx(0.3)  # base alike, bands by 0.9 / 3
    assert float(picture_distance(torch.zeros(1, 3, 2, 2), torch.full((1, 3, 2, 2), 0.25))) == 0.25


def test_style_loss_of_shifted_and_stretched_features():
    feature = random64(2, 4, 6, 5)
    spread = moments(feature)[1]
    assert float(style_loss((feature,), (feature + 0.3,))) == pytest.approx(0.3, rel=1e-5)
    # Deviations double, means stay: what is left is the root mean square of the deviations.
    mean = feature.mean((2, 3), keepdim=True)
    wanted = float(spread.square().mean(1).sqrt().mean())
    stretched = mean + 2 * (feature - mean)
    assert float(style_loss((feature,), (stretched,))) == pytest.approx(wanted, rel=1e-4)
    both = style_loss((feature, feature), (feature + 0.3, stretched))
    assert float(both) == pytest.approx(0.3 + wanted, rel=1e-4)  # layers add up


def test_only_terms_that_weigh_something_count():
    terms = {"a": torch.tensor(2.0), "b": torch.tensor(math.nan), "c": torch.tensor(3.0)}
    assert float(weighted_sum(terms, {"a": 10.0, "b": 0.0, "c": 0.5})) == 21.5
    with pytest.raises(StyleError, match="none of the losses a, b, c weighs anything"):
        weighted_sum(terms, {"b": 0.0})
