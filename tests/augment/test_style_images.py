"""Style images from files of every kind, and the regions found in them."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from augment.effects.style import images
from augment.effects.style.images import StyleImage, image_statistics, read_style_image
from augment.effects.style.statistics import LAND, REST, ROAD, SKY, VEGETATION, WHOLE
from augment.errors import StyleError


def png(pixels: np.ndarray, color_type: int, *extra: tuple[bytes, bytes]) -> bytes:
    """A PNG of rows of uint8 or uint16 pixels [H, W, ...] with further chunks before the pixels."""
    height, width = pixels.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, color_type, 0, 0, 0)
    big = pixels.astype(pixels.dtype.newbyteorder(">"))
    rows = b"".join(b"\0" + row.tobytes() for row in big)
    chunks = [(b"IHDR", header), *extra, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    """The JPEG with EXIF's tag 0x112."""
    entry = struct.pack("<HHIHH", 0x112, 3, 1, orientation, 0)
    exif = b"Exif\0\0" + b"II*\0" + struct.pack("<IH", 8, 1) + entry + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


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


def street(sky=(0.55, 0.68, 0.88), ground=(0.3, 0.29, 0.28)):
    """Float RGB [96, 128, 3]: sky, a skyline of boxes, hedges, and a smooth grey road."""
    picture = noisy(ground, (96, 128), 0.12)
    border = 30 + 12 * (np.arange(128) // 16 % 2)
    above = np.arange(96)[:, None] < border
    picture[above] = noisy(sky, (96, 128), 0.004, seed=1)[above]
    picture[50:66, :50] = noisy((0.15, 0.4, 0.1), (16, 50), 0.03)
    picture[66:] = noisy((0.4, 0.4, 0.41), (30, 128), 0.005)
    return picture, above


def as_image(picture, sky=None):
    height, width = picture.shape[:2]
    sky = np.zeros((height, width), bool) if sky is None else sky
    return StyleImage(picture.astype(np.float32), np.ones((height, width), np.float32), sky)


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


SKIES = {
    "day": ((0.55, 0.68, 0.88), (0.3, 0.29, 0.28)),
    "overcast": ((0.8, 0.8, 0.8), (0.3, 0.29, 0.28)),
    "dusk": ((0.75, 0.5, 0.35), (0.2, 0.18, 0.18)),
    "blue hour": ((0.2, 0.3, 0.5), (0.1, 0.1, 0.1)),
    "deep blue over bright ground": ((0.2, 0.4, 0.75), (0.55, 0.52, 0.5)),
}


@pytest.mark.parametrize("name", SKIES)
def test_skies_are_found(tmp_path, name):
    picture, above = street(*SKIES[name])
    image = read_style_image(saved(tmp_path, "s.png", np.uint8(picture * 255)))
    assert (image.sky & above).sum() > 0.85 * above.sum()
    assert (image.sky & ~above).sum() < 0.03 * above.sum()
    found = image_statistics(image)
    assert found[SKY].share + found[LAND].share == pytest.approx(1)
    assert found[SKY].mean == pytest.approx(SKIES[name][0], abs=0.02)


NO_SKIES = {
    "darker than below": ((0.1, 0.1, 0.12), (0.5, 0.5, 0.5)),
    "black": ((0.02, 0.02, 0.02), (0.2, 0.2, 0.2)),
    "leaves": ((0.4, 0.7, 0.3), (0.3, 0.29, 0.28)),
    "a brown wall": ((0.45, 0.35, 0.25), (0.3, 0.29, 0.28)),
}


@pytest.mark.parametrize("name", NO_SKIES)
def test_what_may_be_no_sky_is_none(name):
    picture, _ = street(*NO_SKIES[name])
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
    picture, above = street()
    found = image_statistics(as_image(picture, above))
    assert set(found) == {WHOLE, SKY, LAND, VEGETATION, ROAD, REST}
    assert found[VEGETATION].share == pytest.approx(16 * 50 / picture[..., 0].size, rel=0.1)
    assert found[ROAD].mean == pytest.approx([0.4, 0.4, 0.41], abs=0.02)
    parts = sum(found[region].share for region in (VEGETATION, ROAD, REST))
    assert parts == pytest.approx(found[LAND].share)
    assert ROAD not in image_statistics(as_image(picture)), "without a sky it may be a table"
