"""The style network and its losses: GSCM, VGG-19's weights from real files, the bank of filters."""

from __future__ import annotations

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
)
from augment.effects.style.network import (
    FLOOR_STD,
    B0Encoder,
    Gscm,
    apply_map,
    compose,
    gscm_map,
    load_imagenet_weights,
)
from augment.errors import StyleError


def pictures(count: int, seed: int = 0, px: int = 256) -> torch.Tensor:
    """Smooth pictures of different colour moments."""
    generator = torch.Generator().manual_seed(seed)
    rough = torch.rand((count, 3, 5, 5), generator=generator)
    scale = 0.3 + 0.7 * torch.rand((count, 3, 1, 1), generator=generator)
    smooth = torch.nn.functional.interpolate(rough, (px, px), mode="bilinear")
    return (smooth * scale).clamp(0, 1)


def trained() -> Gscm:
    """A network whose every weight is away from its start."""
    net = Gscm()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in (*net.head.parameters(), net.content_p, net.content_q, net.style_p):
            value.add_(0.05 * torch.randn(value.shape, generator=generator))
    return net.eval()


def test_folded_is_factor_by_factor():
    net = trained()
    f_c, f_s = net.encode(pictures(2))
    colors = torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(2))
    folded = apply_map(compose(net.style_map(f_s), net.content_map(f_c)), colors)
    # 1e-5: the sums of float32 products of values near 1, in two orders.
    content = F.pad(colors, (0, 1), value=1.0) @ net.content_p @ f_c @ net.content_q
    factors = F.pad(content, (0, 1), value=1.0) @ net.style_p @ f_s @ net.style_q
    torch.testing.assert_close(folded, factors, atol=1e-5, rtol=1e-5)
    untrained = gscm_map(Gscm(), pictures(1), pictures(1))
    torch.testing.assert_close(untrained, torch.eye(3, 4), atol=1e-4, rtol=0)


def test_untrained_carries_moments_from_content_to_style():
    content, style = pictures(2, seed=4).split(1)
    mapped = apply_map(gscm_map(Gscm(), content, style)[None], content.permute(0, 2, 3, 1))
    got, wanted = (image.reshape(-1, 3).T for image in (mapped, style.permute(0, 2, 3, 1)))
    torch.testing.assert_close(got.mean(1), wanted.mean(1), atol=1e-3, rtol=0)
    # Up to the floor of the covariances.
    torch.testing.assert_close(torch.cov(got), torch.cov(wanted), atol=4 * FLOOR_STD**2, rtol=0.03)


def test_plain_pictures_give_finite_maps_of_bounded_gain():
    net, usual = trained(), pictures(1)
    black, red = torch.zeros_like(usual), torch.tensor([1.0, 0.0, 0.0]).reshape(1, 3, 1, 1)
    for image in (black, black + 1, black + red, usual[:, :1].expand_as(usual)):
        for content, style in ((image, usual), (usual, image), (image, image)):
            found = gscm_map(net, content, style)
            assert torch.isfinite(found).all()
            assert torch.linalg.matrix_norm(found[:, :3], 2) < 0.6 / FLOOR_STD


def test_bits_do_not_depend_on_threads_and_threads_come_back():
    net, content, style = trained(), pictures(3, seed=5), pictures(1, seed=6)
    before = torch.get_num_threads()
    net.train()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(gscm_map(net, content, style))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)
    assert net.training


def test_every_weight_is_trained():
    net = trained()
    content, style = pictures(2, seed=7, px=64), pictures(2, seed=8, px=64)
    f_c, _ = net.encode(content)
    _, f_s = net.encode(style)
    maps = compose(net.style_map(f_s), net.content_map(f_c))
    maps.square().sum().backward()
    for name, value in net.named_parameters():
        assert value.grad is not None and value.grad.abs().sum() > 0, name


def test_bad_arguments(monkeypatch):
    with pytest.raises(ValueError, match="small, b0; got 'vgg'"):
        Gscm("vgg")
    monkeypatch.setitem(__import__("sys").modules, "monai.networks.nets.efficientnet", None)
    with pytest.raises(StyleError, match=r"climategs\[efficientnet\]"):
        Gscm("b0")


@pytest.fixture(scope="module")
def b0() -> B0Encoder:
    pytest.importorskip("monai")
    return B0Encoder().eval()


def torchvision_names(state):
    """MONAI's state under torchvision's names, built by order: both list layers as they run."""
    stages = [1, 2, 2, 3, 3, 4, 1]
    values = [(n.rsplit(".", 1)[1], v) for n, v in state.items()]
    ends = iter(values)
    norm = ["weight", "bias", "running_mean", "running_var", "num_batches_tracked"]
    names: dict[str, torch.Tensor] = {}

    def take(prefix, parts):
        for part in parts:
            end, value = next(ends)
            assert end == part
            names[f"{prefix}.{part}"] = value

    take("features.0.0", ["weight"])
    take("features.0.1", norm)
    for stage, blocks in enumerate(stages, 1):
        for block in range(blocks):
            inner = f"features.{stage}.{block}.block"
            layers = ["conv"] * (stage > 1) + ["conv", "squeeze", "conv"]
            for index, layer in enumerate(layers):
                if layer == "squeeze":
                    take(f"{inner}.{index}.fc1", ["weight", "bias"])
                    take(f"{inner}.{index}.fc2", ["weight", "bias"])
                else:
                    take(f"{inner}.{index}.0", ["weight"])
                    take(f"{inner}.{index}.1", norm)
    take("features.8.0", ["weight"])
    take("features.8.1", norm)
    assert next(ends, None) is None
    return names | {"classifier.1.weight": torch.zeros(1000, 1280)}


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["lukemelas", "torchvision"])
def test_imagenet_weights_by_path(b0, scheme, tmp_path):
    own = b0.net.state_dict()
    given = {n: v + 0.5 if v.is_floating_point() else torch.tensor(7) for n, v in own.items()}
    path = tmp_path / "weights.pth"
    if scheme == "lukemelas":
        parts = {n: n.split(".") for n in given}
        luke = {
            ".".join([p[0], *p[2:]] if p[0] == "_blocks" else p): given[n] for n, p in parts.items()
        }
        torch.save(luke | {"_fc.weight": torch.zeros(1000, 1280)}, path)
    else:
        from safetensors.torch import save_file

        path = tmp_path / "weights.safetensors"
        save_file(torchvision_names(given), path)
    fresh = B0Encoder()
    load_imagenet_weights(fresh, path)
    found = fresh.net.state_dict()
    assert [name for name, value in given.items() if not torch.equal(found[name], value)] == []


@pytest.mark.long
def test_weights_of_another_network(b0, tmp_path):
    path = tmp_path / "weights.pth"
    for content, message in (
        ({"features.0.0.weight": torch.zeros(8, 3, 3, 3)}, r"0.weight' must be .*\[32, 3, 3, 3\]"),
        ({"features.0.0.weight": torch.zeros(32, 3, 3, 3)}, "got nothing; give torchvision's"),
        ([1, 2], "not a state dict"),
        (b"no weights", "cannot be read as weights"),
        (None, r"weights\.pth: there is no such file"),
    ):
        path.unlink(missing_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content is not None:
            torch.save(content, path)
        with pytest.raises(StyleError, match=message):
            load_imagenet_weights(b0, path)


# ---- losses and their features -------------------------------------------------------------------


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
