"""LPIPS against a plain computation with torch's own layers, on random weights."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from augment.errors import MetricError
from augment.metrics.lpips import ALEX, VGG16, Conv, Lpips, expected_shapes, load_lpips
from augment.metrics.lpips import picture_lpips as lpips_of

SIZE = 40
# torchvision's `features` as its own lists have them: channels, and M for a pooling.
VGG_LIST = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]
BIAS = "net.slice3.6.bias"
NARROW = 16  # times fewer channels of VGG-16 in tests


def random_weights(architecture):
    generator = torch.Generator().manual_seed(3)
    return {
        name: torch.randn(shape, generator=generator).abs() / 50
        if name.startswith("lin")
        else torch.randn(shape, generator=generator) / max(1, np.prod(shape[1:])) ** 0.5
        for name, shape in expected_shapes(architecture).items()
    }


def pictures(seed):
    return torch.rand(2, 3, SIZE, SIZE + 6, generator=torch.Generator().manual_seed(seed))


def torchvision_alexnet():
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip


def torchvision_vgg16(narrow):
    layers, channels = [], 3
    for width in VGG_LIST:
        if width == "M":
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(channels, width // narrow, 3, padding=1), nn.ReLU()]
        channels = width // narrow
    return nn.Sequential(*layers)


def plainly(layers, taken, heads, a, b):
    """The metric as its definition says it, pixel by pixel."""
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    total, one, other = 0.0, (2 * a - 1 - shift) / scale, (2 * b - 1 - shift) / scale
    with torch.no_grad():
        for number, layer in enumerate(layers):
            one, other = layer(one), layer(other)
            if number not in taken:
                continue
            head = heads[taken.index(number)].flatten()
            f, g = one.flatten(1).T, other.flatten(1).T  # [pixels, channels]
            f, g = (x / x.norm(dim=1, keepdim=True).clamp(min=1e-10) for x in (f, g))
            total += float(((f - g).square() @ head).mean())
    return total


def heads_of(weights):
    return {name: value for name, value in weights.items() if name.startswith("lin")}


def as_torchvision(weights):
    named = {re.sub(r"net\.slice\d\.", "features.", n): v for n, v in weights.items()}
    rest = {"classifier.1.weight": torch.zeros(2, 2)}
    return {n: v for n, v in named.items() if not n.startswith("lin")} | rest


@pytest.fixture(scope="module")
def alex():
    return random_weights(ALEX)


def test_alex_is_the_definition(alex):
    layers = torchvision_alexnet()
    state = {n.removeprefix("features."): v for n, v in as_torchvision(alex).items()}
    del state["classifier.1.weight"]
    layers.load_state_dict(state)
    a, b = pictures(1), pictures(2)
    found = Lpips(ALEX, alex)(a, b)
    heads = list(heads_of(alex).values())
    for number in range(2):
        wanted = plainly(layers, [1, 4, 7, 9, 11], heads, a[number], b[number])
        assert wanted > 0.01
        assert float(found[number]) == pytest.approx(wanted, rel=1e-4)  # float32 sums


def test_vgg_is_the_definition():
    slices = tuple(
        tuple(Conv(c.index, c.channels // NARROW) for c in convs) for convs in VGG16.slices
    )
    narrow = dataclasses.replace(VGG16, slices=slices)
    weights = random_weights(narrow)
    layers = torchvision_vgg16(NARROW)
    names = {n.split(".", 2)[2]: v for n, v in weights.items() if n.startswith("net.")}
    layers.load_state_dict(names)
    a, b = pictures(1), pictures(2)
    heads = list(heads_of(weights).values())
    wanted = plainly(layers, [3, 8, 15, 22, 29], heads, a[0], b[0])
    assert float(Lpips(narrow, weights)(a, b)[0]) == pytest.approx(wanted, rel=1e-4)


def test_equal_pictures_are_0_apart_and_order_does_not_matter(alex):
    network = Lpips(ALEX, alex)
    a, b = pictures(1), pictures(2)
    assert (network(a, a) == 0).all()
    assert torch.allclose(network(a, b), network(b, a), rtol=1e-6)
    black = torch.zeros_like(a)  # biases alone: features without a length must not be NaN
    assert torch.isfinite(network(black, a)).all()


def test_what_does_not_count_is_the_reference(alex):
    network = Lpips(ALEX, alex)
    a, b = (p[0].permute(1, 2, 0).numpy() for p in (pictures(1), pictures(2)))
    nothing = np.zeros(a.shape[:2], bool)
    assert lpips_of(network, a, b, nothing) == 0
    assert lpips_of(network, a, b, ~nothing) == lpips_of(network, a, b)
    half = nothing.copy()
    half[:, :20] = True
    assert 0 < lpips_of(network, a, b, half) < lpips_of(network, a, b)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_files_of_both_layouts(alex, tmp_path, suffix):
    def written(name, tensors):
        path = tmp_path / f"{name}{suffix}"
        save = save_file if suffix == ".safetensors" else torch.save
        save(tensors, path)
        return path

    scaling = {"scaling_layer.shift": torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]}
    copies = {f"lins.{n[3]}.{n[5:]}": v.clone() for n, v in heads_of(alex).items()}
    whole = load_lpips(written("whole", alex | scaling | copies))
    parts = load_lpips(written("net", as_torchvision(alex)), written("heads", heads_of(alex)))
    a, b = pictures(1), pictures(2)
    wanted = Lpips(ALEX, alex)(a, b)
    assert whole.name == parts.name == "alex"
    assert torch.equal(whole(a, b), wanted) and torch.equal(parts(a, b), wanted)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"lin2.model.1.weight": None}, r"lacks lin2.model.1.weight, a tensor \[1, 384, .*own"),
        ({BIAS: torch.zeros(3)}, r"net.slice3.6.bias must be floats \[384\]; .*\[3\]"),
        ({BIAS: torch.zeros(384, dtype=torch.int8)}, r"floats \[384\]; got torch.int8"),
        ({BIAS: torch.full((384,), torch.nan)}, "NaN or infinite"),
        ({"net.slice1.0.weight": torch.zeros(64, 3, 7, 7)}, r"AlexNet .*it is \[64, 3, 7, 7\]"),
        ({"net.slice1.0.weight": None}, "there is none. The file holds lin0.model.1.weight"),
        ({"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}, r"scaling_layer.shift is \[0.0"),
    ],
)  # fmt: skip
def test_other_tensors_are_refused(alex, tmp_path, change, told):
    tensors = {n: v for n, v in (alex | change).items() if v is not None}
    save_file(tensors, tmp_path / "w.safetensors")
    with pytest.raises(MetricError, match=told):
        load_lpips(tmp_path / "w.safetensors")


def test_other_files_are_refused(tmp_path):
    with pytest.raises(MetricError, match="no such file"):
        load_lpips(tmp_path / "none.pth")
    (tmp_path / "text.pth").write_text("weights")
    with pytest.raises(MetricError, match="cannot be read as weights"):
        load_lpips(tmp_path / "text.pth")
    torch.save(nn.Conv2d(3, 3, 3), tmp_path / "model.pth")  # a pickle: never unpickled
    with pytest.raises(MetricError, match="cannot be read as weights"):
        load_lpips(tmp_path / "model.pth")
    torch.save([torch.zeros(1)], tmp_path / "list.pth")
    with pytest.raises(MetricError, match="holds a list and not a state dict"):
        load_lpips(tmp_path / "list.pth")


def test_small_pictures_are_refused(alex):
    network = Lpips(ALEX, alex)
    small = torch.zeros(1, 3, 31, 31)
    assert float(network(small, small)) == 0
    with pytest.raises(ValueError, match="H, W >= 31 for alex"):
        network(small[..., 1:], small[..., 1:])
