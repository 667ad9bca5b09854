"""Closed-form colour maps and presets: what they match, that none moves colours less, limits."""

import itertools
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from augment.effects.style.color_maps import CLASSES
from augment.effects.style.network import (
    METADATA_KEY,
    SHIPPED,
    Gscm,
    load_network,
    network_facts,
    save_network,
)
from augment.effects.style.statistics import (
    LAND,
    LAND_LIMITS,
    REST,
    ROAD,
    SKY,
    SKY_LIMITS,
    VEGETATION,
    WHOLE,
    ColorStatistics,
    Limits,
    closed_maps,
    mkl_map,
    reinhard_map,
    statistics_of,
)
from augment.effects.style.style import parse_statistics, preset_statistics
from augment.errors import StyleError
from augment.semantics import SemanticClass
from recipes.style import style_preset_names, style_preset_text

# Nothing of the limits acts on ordinary statistics with these; the floor is far below any spread.
FREE = Limits(floor=1e-9, max_gain=1e6, min_gain=1e-6, min_contrast=1e-6)
METHODS = {"mkl": mkl_map, "reinhard": reinhard_map}


def spread(values, seed):
    """A covariance with these standard deviations along random axes."""
    axes, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return axes @ np.diag(np.square(values)) @ axes.T


def photo_like(seed, mean=None, scale=1.0):
    """Mostly grey variation, as photographs have."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(0.3, 0.6, 3) if mean is None else np.array(mean, float)
    grey = np.full((3, 3), rng.uniform(0.02, 0.04))
    covariance = scale**2 * (grey + spread(rng.uniform(0.03, 0.06, 3), seed))
    return ColorStatistics(mean, covariance)


def constant(*color):
    return ColorStatistics(np.array(color, float), np.zeros((3, 3)))


def parts(color_map):
    values = color_map.numpy()
    return values[:, :3], values[:, 3]


def mapped(color_map, statistics):
    """Mean and covariance after the map."""
    matrix, offset = parts(color_map)
    return matrix @ statistics.mean + offset, matrix @ statistics.covariance @ matrix.T


@pytest.mark.parametrize("seed", range(4))
def test_mkl_matches_mean_and_covariance(seed):
    content, style = photo_like(seed), photo_like(seed + 10)
    mean, covariance = mapped(mkl_map(content, style, FREE), content)
    assert mean == pytest.approx(style.mean, abs=1e-12)
    assert covariance == pytest.approx(style.covariance, abs=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_reinhard_matches_mean_and_spread_of_each_channel(seed):
    content, style = photo_like(seed), photo_like(seed + 10)
    color_map = reinhard_map(content, style, FREE)
    mean, covariance = mapped(color_map, content)
    assert mean == pytest.approx(style.mean, abs=1e-12)
    assert np.diag(covariance) == pytest.approx(np.diag(style.covariance), abs=1e-11)
    assert np.count_nonzero(parts(color_map)[0] - np.diag(np.diag(parts(color_map)[0]))) == 0


@pytest.mark.parametrize("seed", range(3))
def test_mkl_is_symmetric_positive_definite_and_moves_colours_least(seed):
    content, style = photo_like(seed), photo_like(seed + 10)
    matrix, _ = parts(mkl_map(content, style, FREE))
    assert np.array_equal(matrix, matrix.T) and np.linalg.eigvalsh(matrix)[0] > 0

    def cost(linear):  # the mean squared move, but for the means' part, the same for all
        moved = linear - np.eye(3)
        return np.trace(moved @ content.covariance @ moved.T)

    def root(covariance):
        values, vectors = np.linalg.eigh(covariance)
        return (vectors * np.sqrt(values)) @ vectors.T

    # Every linear map with the style's covariance is S^1/2 R C^-1/2, R orthogonal.
    inverse = np.linalg.inv(root(content.covariance))
    rng = np.random.default_rng(seed)
    for _ in range(200):
        rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        other = root(style.covariance) @ rotation @ inverse
        assert other @ content.covariance @ other.T == pytest.approx(style.covariance)
        assert cost(other) >= cost(matrix) - 1e-12


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "statistics",
    [photo_like(0), photo_like(1, mean=(0.99, 0.01, 1.2)), constant(0, 0, 0), constant(1, 0, 0)],
)
def test_the_scene_itself_as_style_changes_nothing(method, statistics):
    color_map = METHODS[method](statistics, statistics)
    assert color_map == pytest.approx(np.eye(3, 4), abs=1e-6)


EXTREMES = {
    "black": constant(0, 0, 0),
    "white": constant(1, 1, 1),
    "grey": constant(0.5, 0.5, 0.5),
    "red": constant(1, 0, 0),
    "greys only": ColorStatistics(np.full(3, 0.4), np.full((3, 3), 0.04)),
    "one channel": ColorStatistics(np.array([0.5, 0, 0]), np.diag([0.08, 0.0, 0.0])),
    "noise": ColorStatistics(np.full(3, 0.5), np.eye(3) / 12),
    "black and white": ColorStatistics(np.full(3, 0.5), np.full((3, 3), 0.25)),
    "night": ColorStatistics(np.full(3, 0.03), np.full((3, 3), 1e-3) + 1e-4 * np.eye(3)),
    "street": photo_like(0),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("limits", [LAND_LIMITS, SKY_LIMITS])
def test_any_pair_of_extremes_stays_within_the_limits(method, limits):
    for content, style in itertools.product(EXTREMES.values(), repeat=2):
        matrix, offset = parts(METHODS[method](content, style, limits))
        gains = np.linalg.eigvalsh(matrix)
        assert np.isfinite(matrix).all() and np.isfinite(offset).all()
        assert gains[0] >= limits.min_gain - 1e-9
        # The contrast that is given back may lie along no axis of the rest: at most their sum.
        assert gains[-1] <= limits.max_gain + limits.min_contrast + 1e-9
        assert matrix.sum() / 3 >= limits.min_contrast - 1e-9, "contrast along grey"
        mean = matrix @ content.mean + offset
        assert (mean > -1e-12).all() and (mean < 1 + 1e-12).all()


def shared(seed, share, **keywords):
    statistics = photo_like(seed, **keywords)
    return ColorStatistics(statistics.mean, statistics.covariance, share)


def scene(seed, *regions, share=0.25):
    """Statistics of WHOLE and the regions."""
    return {WHOLE: shared(seed, 1.0)} | {
        region: shared(seed + 1 + at, share) for at, region in enumerate(regions)
    }


def maps(content, style, *, method="mkl", strength=1.0, per_region=False):
    return closed_maps(content, style, method=method, strength=strength, per_region=per_region)


def test_sky_and_land_have_their_own_maps_where_both_sides_show_them():
    content, style = scene(0, SKY, LAND), scene(20, SKY, LAND)
    found = maps(content, style)
    assert found.splats.shape == (1, 3, 4) and found.splats.dtype == torch.float32
    assert torch.equal(found.sky, mkl_map(content[SKY], style[SKY], SKY_LIMITS).float())
    assert torch.equal(found.splats[0], mkl_map(content[LAND], style[LAND]).float())
    assert torch.equal(found.picture, mkl_map(content[WHOLE], style[WHOLE]).float())


def test_regions_have_maps_of_their_own_by_class():
    regions = (SKY, LAND, ROAD, VEGETATION, REST)
    content, style = scene(0, *regions), scene(20, *regions)
    found = maps(content, style, per_region=True)
    assert found.splats.shape == (CLASSES, 3, 4)

    def own(region):
        return mkl_map(content[region], style[region]).float()

    for kind, expected in (
        (SemanticClass.ROAD, own(ROAD)),
        (SemanticClass.LANE_MARKING, own(ROAD)),
        (SemanticClass.VEGETATION, own(VEGETATION)),
        (SemanticClass.VEHICLE, own(REST)),
        (SemanticClass.SKY, found.sky),
        (SemanticClass.UNKNOWN, own(LAND)),
        (SemanticClass.SNOW, own(LAND)),
    ):
        assert torch.equal(found.splats[kind], expected), kind


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("per_region", [False, True])
def test_strength_zero_is_the_identity_to_the_bit_and_half_lies_between(method, per_region):
    regions = (SKY, LAND, ROAD)
    content, style = scene(0, *regions), scene(20, *regions)
    full = maps(content, style, method=method, per_region=per_region)
    none = maps(content, style, method=method, strength=0.0, per_region=per_region)
    half = maps(content, style, method=method, strength=0.5, per_region=per_region)
    for name in ("splats", "sky", "picture"):
        value = getattr(full, name)
        assert torch.equal(getattr(none, name), torch.eye(3, 4).expand_as(value))
        assert torch.allclose(
            getattr(half, name), torch.lerp(torch.eye(3, 4), value, 0.5), atol=1e-6
        )


def test_wrong_method_and_strength_are_refused(unchecked):
    content = {WHOLE: photo_like(0)}
    with pytest.raises(ValueError, match="mkl or reinhard; got 'gscm'"):
        maps(content, content, method="gscm")
    for strength in (-0.1, 2.1, float("nan")):
        with pytest.raises(ValueError, match="strength must be in"):
            maps(content, content, strength=strength)


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


@pytest.mark.parametrize("name", NAMES)
def test_presets_are_statistics_and_say_where_they_come_from(name):
    found = preset_statistics(name)
    assert set(found) == {WHOLE, LAND, SKY}
    for statistics in found.values():
        assert ((statistics.mean > 0) & (statistics.mean < 1)).all()
        assert np.linalg.eigvalsh(statistics.covariance)[0] > 0
    comment = [line for line in style_preset_text(name).splitlines() if line.startswith("#")]
    assert len(comment) >= 3 and "CC BY 4.0" in " ".join(comment)


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
