"""GSCM: two linear stages that fold, start at the transport of colour moments, and train."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

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
