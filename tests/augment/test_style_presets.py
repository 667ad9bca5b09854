"""Style presets: files that are as they should be, and moods that are what they say."""

import json

import numpy as np
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
from augment.effects.style.statistics import LAND, SKY, WHOLE, closed_maps, statistics_of
from augment.effects.style.style import SHARES, parse_statistics, preset_statistics, together
from augment.errors import StyleError
from recipes.style import style_preset_names, style_preset_text

NAMES = style_preset_names()
GOOD = """
land:
  mean: [0.3, 0.4, 0.5]
  covariance: [[0.02, 0.01, 0.01], [0.01, 0.02, 0.01], [0.01, 0.01, 0.02]]
sky:
  mean: [1, 0, 0.5]
  covariance: [[0, 0, 0], [0, 0, 0], [0, 0, 0]]
"""


def street():
    """The statistics of a street by day with a skewed, bounded spread, as photographs have."""
    rng = np.random.default_rng(0)
    light = rng.beta(2, 4.5, (3000, 1))
    land = np.clip(light * (1, 1.02, 1.04) + 0.02 * rng.standard_normal((3000, 3)), 0, 1)
    height = rng.uniform(0, 1, (1000, 1))
    sky = (0.5, 0.6, 0.75) + height * (0.25, 0.2, 0.1) + 0.01 * rng.standard_normal((1000, 3))
    both = np.concatenate([land, sky])
    found = {WHOLE: statistics_of(both)}
    found |= {LAND: statistics_of(land, total=4000.0), SKY: statistics_of(sky, total=4000.0)}
    return {LAND: land, SKY: sky}, found


def styled(name, **keywords):
    pixels, content = street()
    maps = closed_maps(
        content,
        preset_statistics(name),
        **({"method": "mkl", "strength": 1.0, "per_region": False} | keywords),
    )
    of = {LAND: maps.splats[0].double().numpy(), SKY: maps.sky.double().numpy()}
    return {region: pixels[region] @ m[:, :3].T + m[:, 3] for region, m in of.items()}


@pytest.mark.parametrize("name", NAMES)
def test_presets_are_statistics_and_say_where_they_come_from(name):
    found = preset_statistics(name)
    assert set(found) == {WHOLE, LAND, SKY}
    for statistics in found.values():
        assert ((statistics.mean > 0) & (statistics.mean < 1)).all()
        assert np.linalg.eigvalsh(statistics.covariance)[0] > 0
    comment = [line for line in style_preset_text(name).splitlines() if line.startswith("#")]
    assert len(comment) >= 3 and "CC BY 4.0" in " ".join(comment)


@pytest.mark.parametrize("name", NAMES)
def test_presets_cut_off_few_colours_of_a_street_and_keep_roads_nearly_grey(name):
    after = styled(name)
    for region, pixels in after.items():
        cut = np.maximum(np.maximum(-pixels, pixels - 1), 0).max(1)
        assert (cut > 0.02).mean() < 0.06, region
    mean = after[LAND].mean(0)
    assert (mean.max() - mean.min()) < 0.15, "land is tinted, not dyed"


def test_moods_are_what_their_names_say():
    def light(name, region):
        return preset_statistics(name)[region].mean.mean()

    def warmth(name, region=LAND):
        mean = preset_statistics(name)[region].mean
        return mean[0] - mean[2]

    assert light("night", LAND) < light("blue-hour", LAND) < light("rain", LAND)
    assert light("rain", LAND) < light("overcast", LAND) < light("snow-light", LAND)
    assert light("night", SKY) < light("dusk", SKY) < light("overcast", SKY)
    assert warmth("golden-hour") > 0.1 > warmth("hazy-summer") > 0 > warmth("snow-light")
    assert warmth("blue-hour") < -0.08 and warmth("blue-hour", SKY) < -0.2


def test_the_whole_is_put_together_from_shares():
    rng = np.random.default_rng(1)
    land, sky = rng.random((750, 3)), 0.5 + 0.1 * rng.random((250, 3))
    assert SHARES == {LAND: 0.75, SKY: 0.25}
    parts = (statistics_of(land, total=1000.0), statistics_of(sky, total=1000.0))
    found, expected = together(parts), statistics_of(np.concatenate([land, sky]))
    assert found.mean == pytest.approx(expected.mean) and found.share == 1
    assert found.covariance == pytest.approx(expected.covariance)


def test_good_numbers_are_read_as_they_are():
    found = parse_statistics(GOOD, source="good")
    assert found[SKY].mean.tolist() == [1, 0, 0.5] and not found[SKY].covariance.any()
    assert found[LAND].covariance[0].tolist() == [0.02, 0.01, 0.01]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0.3, 0.4, 0.5", "0.3, 0.4", r"land.mean\[2\]: Field required"),
        ("0.3, 0.4, 0.5", "0.3, 0.4, .nan", r"land.mean\[2\]: .*finite number"),
        ("0.3, 0.4, 0.5", "0.3, 0.4, a", r"land.mean\[2\]: .*valid number"),
        ("0.3, 0.4, 0.5", "0.3, 0.4, 1.5", r"land.mean\[2\]: .*less than or equal to 1"),
        ("[0.3, 0.4, 0.5]", "true", "land.mean: .*valid tuple"),
        ("[0.02, 0.01, 0.01]", "[0.02, 0.01]", r"land.covariance\[0\]\[2\]: Field required"),
        ("[0.02, 0.01, 0.01]", "[0.02, 0.03, 0.01]", "land.covariance: must be symmetric"),
        ("[[0, 0, 0]", "[[-0.1, 0, 0]", "sky.covariance: must have no variance below zero"),
        ("[[0, 0, 0]", "[[.inf, 0, 0]", r"sky.covariance\[0\]\[0\]: .*finite number"),
        ("mean: [1", "means: [1", "sky.mean: Field required; sky.means: Extra"),
        ("sky:", "sea:", "sky: Field required; sea: Extra"),
        ("sky:", "land: {}\nsky", "not valid YAML"),
        ("sky:", "extra: 1\nsky:", "extra: Extra inputs"),
    ],
)
def test_wrong_files_say_where(old, new, words):
    assert old in GOOD
    with pytest.raises(StyleError, match=f"^here(:7)?: .*({words})"):
        parse_statistics(GOOD.replace(old, new, 1), source="here")


def test_unknown_names_list_the_styles():
    with pytest.raises(StyleError, match=r"did you mean dusk.*overcast"):
        preset_statistics("dsk")


@pytest.mark.parametrize("text", ["", "3", "[1, 2]", "{"])
def test_what_is_no_mapping_is_refused(text):
    with pytest.raises(StyleError, match=r"^here(:1)?: "):
        parse_statistics(text, source="here")


def different() -> Gscm:
    net = Gscm()
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for value in net.parameters():
            value.add_(torch.randn(value.shape, generator=generator) * 0.05)
    return net


def test_round_trip(tmp_path):
    path, net = tmp_path / "deep" / "net.safetensors", different()
    save_network(path, net, {"steps": 12, "licences": ["CC0"]})
    found = load_network(path)
    own, read = net.state_dict(), found.state_dict()
    assert not found.training
    assert own.keys() == read.keys() and all(torch.equal(own[name], read[name]) for name in own)
    assert network_facts(path)["about"] == {"steps": 12, "licences": ["CC0"]}
    halves = {name: value.half().contiguous() for name, value in own.items()}
    save_file(halves, path, {METADATA_KEY: json.dumps(network_facts(path))})
    for name, value in load_network(path).state_dict().items():  # read as float32
        torch.testing.assert_close(value, own[name], atol=1e-4, rtol=1e-3)


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
        ({"encoder": 3}, "encoder must be one of small, b0; got 3"),
        ({"k": 8}, "k must be 16; got 8"),
        ({"offset": False}, "offset must be True; got False"),
        ({"size": 128}, "size must be 256; got 128"),
        ({"moments": None}, "moments must be True; got None: the file is of another version"),
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
        ({}, r"'head.bias' must be torch.float32 \[512\]; got nothing"),
        ({"head.bias": bias, "more": torch.zeros(1)}, r"of another network: \['more'\]"),
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
    assert facts["encoder"] == net.encoder_name == "small" and facts["offset"]
    assert facts["about"]["licences"] and facts["about"]["data"]["held_out"]
    assert not set(facts["about"]["data"]["train"]) & set(facts["about"]["data"]["held_out"])
    figures = facts["about"]["figures"]
    assert figures["network"]["look"] > figures["mkl"]["look"] > 0
    assert SHIPPED.stat().st_size < 10 * 2**20
