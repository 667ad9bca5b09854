"""Style networks in files: what goes in comes out, and nothing else is taken for a network."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from augment.effects.style.network import (
    METADATA_KEY,
    SHIPPED,
    Gscm,
    load_network,
    network_facts,
    save_network,
)
from augment.errors import StyleError


def different(**options) -> Gscm:
    net = Gscm(**options)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for value in net.parameters():
            value.add_(torch.randn(value.shape, generator=generator) * 0.05)
    return net


@pytest.mark.parametrize("options", [{}, {"offset": False, "k": 5}])
def test_round_trip(options, tmp_path):
    path, net = tmp_path / "deep" / "net.safetensors", different(**options)
    save_network(path, net, {"steps": 12, "licences": ["CC0"]})
    found = load_network(path)
    assert not found.training
    assert (found.k, found.offset) == (net.k, net.offset)
    own, read = net.state_dict(), found.state_dict()
    assert own.keys() == read.keys() and all(torch.equal(own[name], read[name]) for name in own)
    assert network_facts(path)["about"] == {"steps": 12, "licences": ["CC0"]}


def test_half_precision_is_half_the_size_and_read_as_float32(tmp_path):
    full, half, net = tmp_path / "full.safetensors", tmp_path / "half.safetensors", different()
    save_network(full, net, {})
    save_network(half, net, {}, half_precision=True)
    assert half.stat().st_size < 0.55 * full.stat().st_size
    found = load_network(half).state_dict()
    for name, value in net.state_dict().items():
        assert found[name].dtype == value.dtype
        torch.testing.assert_close(found[name], value, atol=1e-4, rtol=1e-3)


def test_no_weight_that_is_not_finite_is_written(tmp_path):
    net = Gscm()
    with torch.no_grad():
        net.head.bias[0] = float("nan")
    with pytest.raises(StyleError, match=r"'head.bias' is not finite"):
        save_network(tmp_path / "net.safetensors", net, {})
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("net") / "net.safetensors"
    save_network(path, Gscm(), {})
    return path


def test_a_header_that_lies(written, tmp_path):
    path = tmp_path / "net.safetensors"
    for change, message in (
        ({"format": 2}, "format must be 1; got 2"),
        ({"encoder": "vgg"}, "encoder must be one of"),
        ({"encoder": 3}, "'encoder' must be of type str; got 3"),
        ({"k": True}, "'k' must be of type int; got True"),
        ({"k": 100000}, "k must be 4 to 256"),
        ({"k": 8}, "must be .*; got"),
        ({"offset": False}, "must be .*; got"),
        ({"offset": None}, "'offset' must be of type bool; got None"),
        ({"size": 128, "moments": False}, "size 256 and moments true; got 16, 128 and False"),
    ):
        header = network_facts(written) | change
        save_file(load_file(written), path, {METADATA_KEY: json.dumps(header)})
        with pytest.raises(StyleError, match=message) as caught:
            load_network(path)
        assert str(path) in str(caught.value)


def test_tensors_of_another_network(written, tmp_path):
    own, path = load_file(written), tmp_path / "net.safetensors"
    bias = own.pop("head.bias")
    for change, message in (
        ({}, r"missing \['head.bias'\]"),
        ({"head.bias": bias, "more": torch.zeros(1)}, r"unknown \['more'\]"),
        ({"head.bias": bias * torch.nan}, "not finite"),
        ({"head.bias": bias.int()}, "torch.int32"),
    ):
        save_file(own | change, path, {METADATA_KEY: json.dumps(network_facts(written))})
        with pytest.raises(StyleError, match=message):
            load_network(path)


def test_other_files(tmp_path, written):
    path = tmp_path / "net.safetensors"
    with pytest.raises(StyleError, match="cannot be read"):
        load_network(path)
    for content in (b"", b"no tensors at all", written.read_bytes()[:-100]):
        path.write_bytes(content)
        with pytest.raises(StyleError, match="cannot be read"):
            load_network(path)
    for text in ("[]", "{", "3"):
        save_file({"a": torch.zeros(1)}, path, {METADATA_KEY: text})
        with pytest.raises(StyleError, match=r"JSON|object"):
            load_network(path)
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(StyleError, match=r"no 'climategs.gscm'"):
        load_network(path)
    with pytest.raises(StyleError, match="climategs style train"):
        load_network(tmp_path)


def test_the_shipped_network():
    net, facts = load_network(), network_facts()
    assert facts["encoder"] == "small" and net.offset
    assert facts["about"]["licences"] and facts["about"]["data"]["held_out"]
    assert not set(facts["about"]["data"]["train"]) & set(facts["about"]["data"]["held_out"])
    figures = facts["about"]["figures"]
    assert figures["network"]["look"] > figures["mkl"]["look"] > 0
    assert SHIPPED.stat().st_size < 10 * 2**20
