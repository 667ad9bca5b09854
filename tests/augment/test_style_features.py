"""Features: VGG-19's weights from real files, and what the bank of filters sees."""

import pickle

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from augment.effects.style.losses import FilterBank, Vgg19, load_vgg19, open_features, style_loss
from augment.errors import StyleError

NARROW = 1 / 32  # of VGG-19's channels: 2, 4, 8 and 16


def random(*shape, seed=0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def weights() -> dict[str, torch.Tensor]:
    """As torchvision's file holds them, also of layers that are not looked at."""
    generator = torch.Generator().manual_seed(0)
    own = Vgg19(width=NARROW).state_dict()
    made = {n: 0.3 * torch.randn(t.shape, generator=generator) for n, t in own.items()}
    return {**made, "features.21.weight": torch.ones(4), "classifier.0.bias": torch.ones(2)}


def test_layers_are_vgg_19_s():
    shapes = {name: tuple(t.shape) for name, t in Vgg19().state_dict().items()}
    widths = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256, 16: 256, 19: 512}
    assert {int(name.split(".")[1]): shape[0] for name, shape in shapes.items()} == widths
    assert shapes["features.0.weight"] == (64, 3, 3, 3)
    assert shapes["features.19.weight"] == (512, 256, 3, 3) and len(shapes) == 18


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_weights_of_a_file_are_used_layer_by_layer(tmp_path, weights, suffix):
    path = tmp_path / f"vgg19{suffix}"
    (save_file if suffix == ".safetensors" else torch.save)(weights, path)
    picture = random(1, 3, 18, 16)
    found = load_vgg19(path, width=NARROW)(picture)
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


def test_gradients_reach_pictures_and_no_weights(weights, tmp_path):
    save_file(weights, tmp_path / "w.safetensors")
    network = load_vgg19(tmp_path / "w.safetensors", width=NARROW)
    picture = random(1, 3, 8, 8).requires_grad_(True)
    sum(layer.sum() for layer in network(picture)).backward()
    assert (picture.grad != 0).any() and all(p.grad is None for p in network.parameters())


class Evil:
    def __reduce__(self):
        return (print, ("run by a file of weights",))


def test_files_that_are_no_weights_are_refused(tmp_path, weights, capsys):
    path = tmp_path / "w.pth"

    def refused(content, match, save=torch.save):
        save(content, path)
        with pytest.raises(StyleError, match=match):
            load_vgg19(path, width=NARROW)

    name = "features.7.weight"
    refused({n: t for n, t in weights.items() if n != name}, rf"lacks {name}")
    refused({**weights, name: torch.ones(4, 4, 1, 1)}, rf"{name} must be floats \[4, 4, 3, 3\]")
    refused({**weights, name: weights[name].to(torch.int8)}, "got torch.int8")
    refused({**weights, name: weights[name] * torch.nan}, f"{name} holds NaN")
    refused([torch.ones(3)], "holds a list and not a state dict")
    refused({"model": weights}, "not a state dict of tensors")
    refused(Evil(), "cannot be read as weights")
    refused(Evil(), "cannot be read as weights", lambda c, p: p.write_bytes(pickle.dumps(c)))
    assert "run by" not in capsys.readouterr().out
    (tmp_path / "w.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(StyleError, match=r"cannot be read as weights: .*header"):
        open_features(tmp_path / "w.safetensors")
    with pytest.raises(StyleError, match="there is no such file"):
        open_features(tmp_path / "absent.pth")
    with pytest.raises(ValueError, match="at least 8 px a side"):
        Vgg19(width=NARROW)(random(1, 3, 7, 20))


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
    edges = FilterBank(levels=1)(ramp)[1][..., 2:-2, 2:-2]
    slope = 2 * 3**0.5 * 2 / 63  # gain, luminance, the pixels of half the size
    rises, falls = edges[0, :12:3], edges[0, 12::3]  # of luminance, along x, y and diagonals
    assert torch.allclose(rises[0], torch.tensor(slope), atol=1e-5)
    assert rises[1].abs().max() < 1e-6 and falls[:2].abs().max() < 1e-6
    assert torch.allclose(rises[2], torch.tensor(slope / 2**0.5), atol=1e-5)


def test_colours_that_vary_together_or_apart_are_told_apart():
    """Means and deviations of the channels alone would not see it."""
    a, b = random(1, 1, 64, 64), random(1, 1, 64, 64, seed=1)
    together = torch.cat([a, a, a], 1)
    apart = torch.cat([a, b - b.mean() + a.mean(), a], 1)
    apart[:, 1] = (apart[:, 1] - apart[:, 1].mean()) * a.std() / b.std() + a.mean()
    bank = FilterBank()
    told_apart = style_loss(bank(together), bank(apart))
    assert told_apart > 4 * style_loss(bank(together), bank(together.flip(3))) > 0


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
