"""Closed-form colour maps, presets and style images: what they match, and where they stop."""

from __future__ import annotations

import dataclasses
import itertools
import json
import struct
import zlib

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from augment.effects.style import images
from augment.effects.style.color_maps import NUM_CLASSES
from augment.effects.style.images import StyleImage, image_statistics, read_style_image
from augment.effects.style.network import (
    METADATA_KEY,
    SHIPPED_CHECKPOINT,
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
)
from augment.effects.style.style import parse_statistics, preset_statistics
from augment.errors import StyleError
from augment.scene.semantics import SemanticClass
from recipes.style import style_preset_names, style_preset_text
from tests.exif import with_orientation

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
def test_mkl_matches_mean_and_covariance_reinhard_the_spread_of_each_channel(seed):
    content, style = photo_like(seed), photo_like(seed + 10)
    mean, covariance = mapped(mkl_map(content, style, FREE), content)
    assert mean == pytest.approx(style.mean, abs=1e-12)
    assert covariance == pytest.approx(style.covariance, abs=1e-11)
    color_map = reinhard_map(content, style, FREE)
    mean, covariance = mapped(color_map, content)
    assert mean == pytest.approx(style.mean, abs=1e-12)
    assert np.diag(covariance) == pytest.approx(np.diag(style.covariance), abs=1e-11)
    matrix, _ = parts(color_map)
    assert np.array_equal(matrix, np.diag(np.diag(matrix)))


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


def scene(seed, *regions):
    """Statistics of WHOLE and the regions, each a quarter of it."""
    shares = {WHOLE: 1.0} | dict.fromkeys(regions, 0.25)
    photos = {region: photo_like(seed + number) for number, region in enumerate(shares)}
    return {
        region: dataclasses.replace(photo, share=shares[region]) for region, photo in photos.items()
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
    assert found.splats.shape == (NUM_CLASSES, 3, 4)

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


# ---- presets -------------------------------------------------------------------------------------

NAMES = style_preset_names()
GOOD = """
land:
  mean: [0.3, 0.4, 0.5]
  covariance: [[0.02, 0.01, 0.01], [0.01, 0.02, 0.01], [0.01, 0.01, 0.02]]
sky:
  mean: [1, 0, 0.5]
  covariance: [[0, 0, 0], [0, 0, 0], [0, 0, 0]]
"""


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
    assert light("night", SKY) < light("grey-dusk", SKY) < light("rain", SKY)
    assert light("grey-dusk", LAND) < light("rain", LAND)
    assert warmth("blue-hour") < warmth("grey-dusk") < 0
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


# ---- networks in files ---------------------------------------------------------------------------


def test_round_trip(tmp_path):
    path, net = tmp_path / "deep" / "net.safetensors", Gscm()
    for value in net.parameters():
        torch.nn.init.normal_(value, std=0.05, generator=torch.Generator().manual_seed(3))
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


@pytest.fixture
def path(tmp_path):
    """A file of an untrained network."""
    path = tmp_path / "net.safetensors"
    save_network(path, Gscm(), {})
    return path


def test_a_header_that_lies(path):
    tensors, right_header = load_file(path), network_facts(path)
    for change, message in (
        ({"format": 2}, "format must be 1; got 2"),
        ({"encoder": "vgg"}, "encoder must be one of"),
        ({"encoder": 3}, "encoder must be one of small, b0; got 3"),
        ({"k": 8}, "k must be 16; got 8"),
        ({"offset": False}, "offset must be True; got False"),
        ({"size": 128}, "size must be 256; got 128"),
        ({"moments": None}, "moments must be True; got None: the file is of another version"),
    ):
        save_file(tensors, path, {METADATA_KEY: json.dumps(right_header | change)})
        with pytest.raises(StyleError, match=message) as caught:
            load_network(path)
        assert str(path) in str(caught.value)


def test_tensors_of_another_network(path):
    tensors, header = load_file(path), json.dumps(network_facts(path))
    bias = tensors.pop("head.bias")
    for change, message in (
        ({}, r"'head.bias' must be torch.float32 \[512\]; got nothing"),
        ({"head.bias": bias, "more": torch.zeros(1)}, r"of another network: \['more'\]"),
        ({"head.bias": bias * torch.nan}, "not finite"),
        ({"head.bias": bias.int()}, "torch.int32"),
    ):
        save_file(tensors | change, path, {METADATA_KEY: header})
        with pytest.raises(StyleError, match=message):
            load_network(path)


def test_other_files(tmp_path, path):
    for content in (b"", b"no tensors at all", path.read_bytes()[:-100], None):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(StyleError, match="cannot be read"):
            load_network(path)
    for metadata, message in (
        ({METADATA_KEY: "[]"}, "must be an object"),
        ({METADATA_KEY: "3"}, "must be an object"),
        ({METADATA_KEY: "{"}, "is not JSON"),
        (None, "no 'climategs.gscm'"),
    ):
        save_file({"a": torch.zeros(1)}, path, metadata)
        with pytest.raises(StyleError, match=message):
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
    assert SHIPPED_CHECKPOINT.stat().st_size < 10 * 2**20


# ---- images --------------------------------------------------------------------------------------


def png(pixels: np.ndarray, color_type: int) -> bytes:
    """A PNG of rows of uint8 or uint16 pixels [H, W, ...]."""
    height, width = pixels.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, color_type, 0, 0, 0)
    big = pixels.astype(pixels.dtype.newbyteorder(">"))
    rows = b"".join(b"\0" + row.tobytes() for row in big)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )


def cmyk_jpeg(blocks: list[tuple[int, int, int, int]], *, adobe: bool) -> bytes:
    """A row of 8 x 8 blocks of one colour each: four components as stored, without conversion.

    Baseline, with the DC coefficients alone: a quantiser of 8 makes them the samples less 128.
    """
    parts = [b"\xff\xd8"]

    def segment(marker: int, data: bytes) -> None:
        parts.append(bytes((0xFF, marker)) + struct.pack(">H", len(data) + 2) + data)

    if adobe:  # transform 0: CMYK as it is, neither YCCK nor YCbCr
        segment(0xEE, b"Adobe" + struct.pack(">HHHB", 100, 0, 0, 0))
    segment(0xDB, bytes([0]) + bytes([8] * 64))
    components = b"".join(bytes((number, 0x11, 0)) for number in (1, 2, 3, 4))
    segment(0xC0, struct.pack(">BHHB", 8, 8, 8 * len(blocks), 4) + components)
    # Twelve sizes of DC in codes of 4 bits; one AC code of 1 bit, the end of a block.
    segment(0xC4, bytes([0x00, 0, 0, 0, 12, *[0] * 12]) + bytes(range(12)))
    segment(0xC4, bytes([0x10, 1, *[0] * 15]) + bytes([0]))
    scan = b"".join(bytes((number, 0x00)) for number in (1, 2, 3, 4))
    segment(0xDA, bytes([4]) + scan + bytes([0, 63, 0]))
    bits, before = "", [0, 0, 0, 0]
    for block in blocks:
        for at, value in enumerate(block):
            step, before[at] = value - 128 - before[at], value - 128
            size = abs(step).bit_length()
            coded = step if step >= 0 else step + (1 << size) - 1
            bits += f"{size:04b}" + (f"{coded:0{size}b}" if size else "") + "0"
    bits += "1" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
    return b"".join(parts) + data + b"\xff\xd9"


RED, BLUE = (255, 0, 0), (0, 0, 255)


def saved(folder, name, data):
    """data: bytes, or RGB(A) or grey pixels that OpenCV encodes by the name's ending."""
    path = folder / name
    if not isinstance(data, bytes):
        pixels = np.asarray(data)
        if pixels.ndim == 3:
            pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
        data = cv2.imencode(path.suffix, pixels)[1].tobytes()
    path.write_bytes(data)
    return path


def halves(first, second, height=8, width=16):
    """uint8 RGB [height, width, 3], the left half of one colour, the right of another."""
    pixels = np.empty((height, width, len(first)), np.uint8)
    pixels[:, : width // 2], pixels[:, width // 2 :] = first, second
    return pixels


def noisy(color, shape, spread, seed=0):
    rng = np.random.default_rng(seed)
    return np.clip(np.asarray(color) + spread * rng.standard_normal((*shape, 1)), 0, 1)


def street_picture(sky, ground):
    """Float RGB [96, 128, 3]: sky, a skyline of boxes, hedges, and a smooth grey road."""
    picture = noisy(ground, (96, 128), 0.12)
    border = 30 + 12 * (np.arange(128) // 16 % 2)
    above = np.arange(96)[:, None] < border
    picture[above] = noisy(sky, (96, 128), 0.004, seed=1)[above]
    picture[50:66, :50] = noisy((0.15, 0.4, 0.1), (16, 50), 0.03)
    picture[66:] = noisy((0.4, 0.4, 0.41), (30, 128), 0.005)
    return picture, above


def test_colours_are_rgb_in_every_format(tmp_path):
    for name in ("a.png", "a.bmp", "a.tif", "a.webp", "a.jpg"):
        image = read_style_image(saved(tmp_path, name, halves(RED, BLUE, 32, 32)))
        assert image.rgb.shape == (32, 32, 3) and (image.weights == 1).all()
        tolerance = 0.03 if name in ("a.webp", "a.jpg") else 0  # these lose
        assert image.rgb[4, 4] == pytest.approx([1, 0, 0], abs=tolerance)
        assert image.rgb[4, -4] == pytest.approx([0, 0, 1], abs=tolerance)


def test_depths_and_channels(tmp_path):
    pixels = np.full((4, 4, 3), 12345, np.uint16)
    image = read_style_image(saved(tmp_path, "deep.png", pixels))
    assert image.rgb == pytest.approx(12345 / 65535, abs=1e-7)
    pixels = np.array([[[100, 255], [200, 0]]], np.uint16) * 257  # grey with alpha
    image = read_style_image(saved(tmp_path, "ga.png", png(pixels, 4)))
    assert image.weights.tolist() == [[1, 0]]
    assert image.rgb[0, 0] == pytest.approx(100 / 255)
    image = read_style_image(saved(tmp_path, "grey.png", np.full((4, 6), 51, np.uint8)))
    assert image.rgb.shape == (4, 6, 3) and (image.rgb == np.float32(0.2)).all()


@pytest.mark.parametrize("adobe", [True, False])
def test_cmyk_is_read_as_photoshop_writes_it(tmp_path, adobe):
    # 255 is no ink; every second colour is left to the neighbour's rounding of 1/255.
    stored = [(255, 0, 0, 255), (0, 255, 0, 255), (255, 255, 255, 128), (255, 255, 255, 0)]
    image = read_style_image(saved(tmp_path, "c.jpg", cmyk_jpeg(stored, adobe=adobe)))
    expected = [[1, 0, 0], [0, 1, 0], [0.5, 0.5, 0.5], [0, 0, 0]]
    assert image.rgb[4, 4::8] == pytest.approx(np.array(expected), abs=1.5 / 255)


@pytest.mark.parametrize(("orientation", "corner"), [(1, 0), (3, 3), (6, 1), (8, 2)])
def test_orientation_puts_the_sky_on_top(tmp_path, orientation, corner):
    pixels = np.zeros((32, 48, 3), np.uint8)
    pixels[:16, :24] = 255
    data = cv2.imencode(".jpg", pixels)[1].tobytes()
    rgb = read_style_image(saved(tmp_path, "e.jpg", with_orientation(data, orientation))).rgb
    assert rgb.shape[:2] == ((32, 48) if orientation in (1, 3) else (48, 32))
    corners = [rgb[4, 4, 0], rgb[4, -4, 0], rgb[-4, 4, 0], rgb[-4, -4, 0]]
    assert int(np.argmax(corners)) == corner and sorted(corners)[2] < 0.1


def bad_files(folder):
    whole = cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    bitmap = cv2.imencode(".png", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    return {
        "no such file": folder / "none.png",
        "is a folder": folder,
        "is empty": saved(folder, "empty.png", b""),
        "no JPEG, PNG, WebP": saved(folder, "text.png", b"a picture, honestly"),
        "within its header": saved(folder, "head.jpg", whole[:30]),
        "cut short": saved(folder, "cut.jpg", whole[:-40]),
        "cannot be decoded as PNG": saved(folder, "cut.png", bitmap[:-30]),
        "float32 pixels": saved(folder, "f.tif", np.zeros((4, 4, 3), np.float32)),
        "fully transparent": saved(folder, "t.png", np.zeros((4, 4, 4), np.uint8)),
        "60000 x 60000 pixels": saved(
            folder, "bomb.png", bitmap[:16] + b"\0\0\xea\x60\0\0\xea\x60" + bitmap[24:]
        ),
        "cannot be read": folder / "nul\0.png",
    }


def test_bad_files_say_what_is_wrong(tmp_path, capfd, monkeypatch):
    for message, path in bad_files(tmp_path).items():
        with pytest.raises(StyleError, match=message):
            read_style_image(path)
    capfd.readouterr()  # decoders complain there too
    monkeypatch.setattr(images, "MAX_BYTES", 50)
    with pytest.raises(StyleError, match="larger than 50 bytes"):
        read_style_image(saved(tmp_path, "a.png", halves(RED, BLUE)))


GROUND = (0.3, 0.29, 0.28)
SKIES = {
    "day": ((0.55, 0.68, 0.88), GROUND),
    "overcast": ((0.8, 0.8, 0.8), GROUND),
    "dusk": ((0.75, 0.5, 0.35), (0.2, 0.18, 0.18)),
    "blue hour": ((0.2, 0.3, 0.5), (0.1, 0.1, 0.1)),
    "deep blue over bright ground": ((0.2, 0.4, 0.75), (0.55, 0.52, 0.5)),
}


@pytest.mark.parametrize("colors", SKIES.values(), ids=SKIES)
def test_skies_are_found(tmp_path, colors):
    picture, above = street_picture(*colors)
    image = read_style_image(saved(tmp_path, "s.png", np.uint8(picture * 255)))
    assert (image.sky & above).sum() > 0.85 * above.sum()
    assert (image.sky & ~above).sum() < 0.03 * above.sum()
    found = image_statistics(image)
    assert found[SKY].share + found[LAND].share == pytest.approx(1)
    assert found[SKY].mean == pytest.approx(colors[0], abs=0.02)


NO_SKIES = {
    "darker than below": ((0.1, 0.1, 0.12), (0.5, 0.5, 0.5)),
    "black": ((0.02, 0.02, 0.02), (0.2, 0.2, 0.2)),
    "leaves": ((0.4, 0.7, 0.3), GROUND),
    "a brown wall": ((0.45, 0.35, 0.25), GROUND),
}


@pytest.mark.parametrize("colors", NO_SKIES.values(), ids=NO_SKIES)
def test_what_may_be_no_sky_is_none(colors):
    picture, _ = street_picture(*colors)
    assert not images.find_sky(picture.astype(np.float32), np.ones((96, 128), np.float32)).any()


def test_sky_by_mask(tmp_path):
    image = saved(tmp_path, "i.png", halves(RED, BLUE, 16, 32))
    mask = np.zeros((8, 16), np.uint8)
    mask[:4] = 255
    read = read_style_image(image, saved(tmp_path, "m.png", mask))
    assert read.sky.tolist() == [[row < 8] * 32 for row in range(16)]
    found = image_statistics(read)
    assert found[SKY].share == pytest.approx(0.5)
    no_sky = read_style_image(image, saved(tmp_path, "b.png", np.zeros((8, 16), np.uint8)))
    assert not no_sky.sky.any() and set(image_statistics(no_sky)) == {WHOLE}


def test_masks_of_another_shape_or_kind_are_refused(tmp_path):
    image = saved(tmp_path, "i.png", halves(RED, BLUE, 100, 200))
    with pytest.raises(StyleError, match=r"mask .*200 x 150.*200 x 100"):
        read_style_image(image, saved(tmp_path, "m.png", np.zeros((150, 200), np.uint8)))
    with pytest.raises(StyleError, match=r"sky mask .*no such file"):
        read_style_image(image, tmp_path / "none.png")
    read_style_image(image, saved(tmp_path, "m.png", np.zeros((33, 67), np.uint8)))  # rounded


def test_regions_of_a_street():
    picture, above = street_picture(*SKIES["day"])
    picture = picture.astype(np.float32)
    weights = np.ones(above.shape, np.float32)
    found = image_statistics(StyleImage(picture, weights, above))
    assert set(found) == {WHOLE, SKY, LAND, VEGETATION, ROAD, REST}
    assert found[VEGETATION].share == pytest.approx(16 * 50 / picture[..., 0].size, rel=0.1)
    assert found[ROAD].mean == pytest.approx([0.4, 0.4, 0.41], abs=0.02)
    region_shares = sum(found[region].share for region in (VEGETATION, ROAD, REST))
    assert region_shares == pytest.approx(found[LAND].share)
    no_sky = StyleImage(picture, weights, np.zeros_like(above))
    assert ROAD not in image_statistics(no_sky), "without a sky it may be a table"
