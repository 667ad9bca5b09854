"""Gaussians in SOG files: what is kept, bytes against the format's rules, and refusals."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.detect_format import detect_scheme
from augment.errors import SceneError
from augment.files import sog
from augment.files.formats import read_splats
from augment.files.sog import read_sog, write_sog
from augment.scene.scene import Gaussians
from tests.augment.test_splat_formats import some_gaussians

LEVELS = [float(level) for level in range(256)]


def gaussians_on_x(count: int, bands: int) -> Gaussians:
    """Gaussians in the order in which the file has them: y and z are 0."""
    gaussians = some_gaussians(count, bands)
    gaussians.means[:, 1:] = 0
    return gaussians


def test_few_values_and_colours_of_the_invisible_are_kept(tmp_path: Path) -> None:
    before = gaussians_on_x(40, 1)
    before.opacities[:] = 0  # where an encoder may drop the colours
    write_sog(tmp_path / "a.sog", before)
    after = read_sog(tmp_path / "a.sog").gaussians
    assert torch.equal(after.sh, before.sh) and not after.opacities.any()
    assert (after.scales / before.scales - 1).abs().max() < 1e-6


def test_a_palette_that_does_not_hold_all_is_near_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """600 rows around 20 centres in a palette of 64: what is left is the spread around them."""
    monkeypatch.setattr(sog, "MAX_PALETTE", 64)
    monkeypatch.setattr(sog, "_NUM_GROUPS", 8)
    before = gaussians_on_x(600, 4)
    rng = torch.Generator().manual_seed(2)
    centres = torch.rand(20, 3, 3, generator=rng) - 0.5
    near = centres[torch.arange(600) % 20] + 0.01 * torch.randn(600, 3, 3, generator=rng)
    before.sh[:, 1:] = near
    write_sog(tmp_path / "a.sog", before)
    after = read_sog(tmp_path / "a.sog").gaussians
    error = (after.sh - before.sh)[:, 1:]
    assert error.std() < 0.02 < near.std() / 10


# ---- Files by hand -------------------------------------------------------------------------------


def webp(*pixels: tuple[int, ...], wide: int = 0, suffix: str = ".webp") -> bytes:
    """A lossless image of RGBA pixels in one row, filled up to `wide` with zeros."""
    row = [*pixels, *[(0, 0, 0, 255)] * (wide - len(pixels))]
    image = cv2.cvtColor(np.array([row], np.uint8), cv2.COLOR_RGBA2BGRA)
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
    return cv2.imencode(suffix, image, quality)[1].tobytes()


def one_gaussian() -> tuple[dict[str, Any], dict[str, bytes]]:
    """meta.json and the files of a Gaussian at (e - 1, 0, 1 - e), with a band of harmonics."""
    logs = [(level - 128) / 16 for level in LEVELS]
    meta = {
        "version": 2,
        "count": 1,
        "later": "ignored",
        "means": {"mins": [-1, -1, -1], "maxs": [1, 1, 1], "files": ["l", "u"]},
        "scales": {"codebook": logs, "files": ["s"]},
        "quats": {"files": ["q"]},
        "sh0": {"codebook": LEVELS, "files": ["c"]},
        "shN": {"count": 3, "bands": 1, "codebook": LEVELS, "files": ["p", "i"]},
    }
    entries = [(number, number + 50, number + 100, 255) for number in range(9)]
    images = {
        "l": webp((255, 255, 0, 255)),
        "u": webp((255, 127, 0, 255)),
        "s": webp((128, 144, 112, 255)),
        "q": webp((255, 128, 128, 254)),
        "c": webp((1, 2, 3, 51)),
        "p": webp(*entries, wide=192),
        "i": webp((2, 0, 0, 255)),
    }
    return meta, images


def one_gaussian_of_version_1() -> tuple[dict[str, Any], dict[str, bytes]]:
    """meta.json and the files of the same Gaussian with ranges; its opacity's logit is 1."""
    meta, images = one_gaussian()
    del meta["version"], meta["count"], meta["shN"]["count"], meta["shN"]["bands"]
    meta["means"]["shape"] = [1, 3]
    meta["scales"] = {"mins": [-8, -8, -16], "maxs": [7.9375] * 3, "files": ["s"]}
    meta["sh0"] = {"mins": [0, 0, 10, -5], "maxs": [255, 510, 265, 25], "files": ["c"]}
    meta["shN"] = {"mins": -1, "maxs": 1, "quantization": 8, "files": ["p", "i"]}
    return meta, images


def folder_of(path: Path, meta: dict[str, Any], images: dict[str, bytes]) -> Path:
    path.mkdir()
    (path / "meta.json").write_text(json.dumps(meta))
    for name, data in images.items():
        (path / name).write_bytes(data)
    return path / "meta.json"


def zipped(meta: dict[str, Any], images: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", kind) as archive:
        for name, content in {"meta.json": json.dumps(meta).encode(), **images}.items():
            archive.writestr(name, content)
    return data.getvalue()


def test_bytes_mean_what_the_format_says(tmp_path: Path) -> None:
    meta, images = one_gaussian()
    (tmp_path / "a.sog").write_bytes(zipped(meta, images, zipfile.ZIP_DEFLATED))
    png = webp((128, 144, 112, 255), suffix=".png")
    for path in (tmp_path / "a.sog", folder_of(tmp_path / "f", meta, {**images, "s": png})):
        found = read_splats(path).gaussians
        # 32767/65535 of -1 to 1 is 1/65535 below 0.
        assert found.means[0].tolist() == pytest.approx([math.e - 1, 0, 1 - math.e], abs=2e-5)
        assert found.scales[0].tolist() == pytest.approx([1, math.e, 1 / math.e], rel=1e-6)
        assert found.opacities.item() == pytest.approx(0.2)
        assert found.sh[0, 0].tolist() == [1, 2, 3]
        assert found.sh[0, 1:].tolist() == [[6, 56, 106], [7, 57, 107], [8, 58, 108]]
        # 254 says that the third of wxyz is missing; w is sqrt(1/2), and 128 is 1/255 from 0.
        half = math.sqrt(0.5)
        assert found.quats[0].tolist() == pytest.approx([half, 0, half, 0], abs=0.005)
    # The first number of early codebooks is null, and stands for the next in line.
    first = {**meta, "sh0": {"codebook": [None, *LEVELS[1:]], "files": ["c"]}}
    (tmp_path / "a.sog").write_bytes(zipped(first, {**images, "c": webp((0, 1, 255, 255))}))
    colours = read_splats(tmp_path / "a.sog").gaussians.sh[0, 0]
    assert colours.tolist() == pytest.approx([1 - 254 / 255, 1, 255])


def test_a_rotation_that_is_none_is_left_out_and_said(tmp_path: Path) -> None:
    meta, images = one_gaussian()
    images = {name: webp(*[pixel] * 2) for name, pixel in TWICE.items()} | {"p": images["p"]}
    images["q"] = webp((1, 2, 3, 251), (1, 2, 3, 255))
    (tmp_path / "a.sog").write_bytes(zipped({**meta, "count": 2}, images))
    read = read_splats(tmp_path / "a.sog")
    assert len(read.gaussians) == 1 and "1 of 2 Gaussians with a zero quat" in read.problems[0]


TWICE = {name: (0, 0, 0, 255) for name in "luscqi"}


def test_a_folder_is_the_zip_unpacked(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", gaussians_on_x(400, 4))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "folder")
    assert detect_scheme(tmp_path / "folder") == "gaussians"
    opened = open_scene(f"gaussians:{tmp_path}/folder?up=+z&scale=1")
    assert torch.equal(opened.background.means, read_sog(tmp_path / "a.sog").gaussians.means)


@pytest.mark.parametrize("has_sh", [True, False])
def test_version_1_has_ranges_instead_of_codebooks(tmp_path: Path, has_sh: bool) -> None:
    meta, images = one_gaussian_of_version_1()
    if not has_sh:
        del meta["shN"], images["p"], images["i"]
    (tmp_path / "a.sog").write_bytes(zipped(meta, images))
    for path in (tmp_path / "a.sog", folder_of(tmp_path / "unbundled", meta, images)):
        read = read_splats(path).gaussians
        edge = math.e - 1
        assert read.means[0].tolist() == pytest.approx([edge, 0, -edge], abs=4e-5)
        logs = [-8 + 128 / 16, -8 + 144 / 16, -16 + 112 / 255 * 23.9375]
        assert read.scales[0].log().tolist() == pytest.approx(logs, abs=1e-5)
        assert read.sh[0, 0].tolist() == pytest.approx([1, 4, 13], abs=1e-5)
        logit = torch.tensor(-5 + 51 / 255 * 30)
        assert read.opacities.item() == pytest.approx(float(logit.sigmoid()), abs=1e-6)
        assert read.sh_degree == (1 if has_sh else 0)
        if has_sh:  # entry 2 of the palette, pixels 6 to 8
            codes = torch.tensor([[n, n + 50, n + 100] for n in (6, 7, 8)])
            torch.testing.assert_close(read.sh[0, 1:], codes / 255 * 2 - 1, rtol=0, atol=1e-6)


Change = Callable[[dict[str, Any], dict[str, Any]], object]


def check_refusals(
    path: Path,
    content: tuple[dict[str, Any], dict[str, bytes]],
    cases: dict[str, tuple[Change, str]],
) -> None:
    """Each change of meta.json and the files is refused with its message."""
    meta, images = content
    for name, (change, message) in cases.items():
        changed, files = json.loads(json.dumps(meta)), dict(images)
        change(changed, files)
        path.write_bytes(zipped(changed, files))
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)


def test_refusals_of_version_1(tmp_path: Path) -> None:
    tall = cv2.imencode(".png", np.zeros((1025, 192, 3), np.uint8))[1].tobytes()
    cases: dict[str, tuple[Change, str]] = {
        "no shape": (lambda m, f: m["means"].pop("shape"), "means.shape: Field required"),
        "no count": (lambda m, f: m["means"].update(shape=[]), "means.shape"),
        "none": (lambda m, f: m["means"].update(shape=[0, 3]), "means.shape.0"),
        "negative": (lambda m, f: m["means"].update(shape=[-5, 3]), "means.shape.0"),
        "text": (lambda m, f: m["means"].update(shape=["1", 3]), "means.shape.0"),
        "a bomb": (lambda m, f: m["means"].update(shape=[10**9, 3]), "announces 1000000000"),
        "too many": (lambda m, f: m["means"].update(shape=[2, 3]), "1 x 1 pixels for 2 Gaussians"),
        "no logits": (lambda m, f: m["sh0"].update(mins=[0, 0, 0]), "sh0.mins"),
        "NaN": (lambda m, f: m["scales"].update(mins=[math.nan, 0, 0]), "scales.mins.0"),
        "infinite": (lambda m, f: m["shN"].update(maxs=math.inf), "shN.maxs"),
        "a list": (lambda m, f: m["shN"].update(maxs=[1, 1]), "shN.maxs"),
        "one file": (lambda m, f: m["shN"].update(files=["p"]), "shN.files"),
        "outside": (lambda m, f: m["shN"].update(files=["../p", "i"]), "names the file '../p'"),
        "absolute": (lambda m, f: m["quats"].update(files=["/etc/passwd"]), "'/etc/passwd'"),
        "missing": (lambda m, f: f.pop("s"), "'s'"),
        "no image": (lambda m, f: f.update(p=b"x" * 99), "p must be 192, .* got no image"),
        "a width": (lambda m, f: f.update(p=webp(wide=200)), "got 200 x 1"),
        "a height": (lambda m, f: f.update(p=tall), "at most 1024 high; got 192 x 1025"),
        "a label": (lambda m, f: f.update(i=webp((64, 0, 0, 255))), "entry 64 of a palette of 64"),
        "damaged": (lambda m, f: f.update(p=f["p"][:40]), "p .*damaged"),
        "version": (lambda m, f: m.update(version=0), "only versions 1 and 2 .*; got 0"),
    }
    check_refusals(tmp_path / "a.sog", one_gaussian_of_version_1(), cases)


def test_refusals(tmp_path: Path) -> None:
    meta, images = one_gaussian()
    cases: dict[str, tuple[Change, str]] = {
        "version": (lambda m, f: m.update(version=3), "only versions 1 and 2 .*; got 3"),
        "no means": (lambda m, f: m.pop("means"), "does not describe splats"),
        "a codebook": (lambda m, f: m["sh0"].update(codebook=[1.0]), "sh0.codebook: .* 256 items"),
        "not a number": (lambda m, f: m["means"].update(mins=[0, 0, "x"]), "means.mins.2"),
        "bands": (lambda m, f: m["shN"].update(bands=4), "shN.bands"),
        "a bomb": (lambda m, f: m.update(count=10**9), "announces 1000000000 Gaussians"),
        "too few pixels": (lambda m, f: m.update(count=2), "1 x 1 pixels for 2 Gaussians"),
        "missing": (lambda m, f: f.pop("q"), "'q'"),
        "outside": (lambda m, f: m["quats"].update(files=["../q"]), "names the file '../q'"),
        "no image": (lambda m, f: f.update(q=b"x" * 99), "it is another format"),
        "lossy": (lambda m, f: f.update(q=lossy()), "a lossy or other WebP"),
        "damaged": (lambda m, f: f.update(p=f["p"][:60]), "p is damaged"),
        "huge": (lambda m, f: f.update(q=webp(wide=70000, suffix=".png")), "70000 x 1 pixels"),
        "a label": (lambda m, f: f.update(i=webp((3, 0, 0, 255))), "entry 3 of a palette of 3"),
        "width": (lambda m, f: f.update(p=webp(wide=200)), "192 pixels wide for 1 bands; got 200"),
    }
    path = tmp_path / "a.sog"
    check_refusals(path, (meta, images), cases)
    whole = zipped(meta, images)
    for data, message in ((whole[:-40], "not a zip file"), (b"PK\3\4", "not a whole .sog file")):
        path.write_bytes(data)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
    at = folder_of(tmp_path / "folder", meta, {n: d for n, d in images.items() if n != "q"})
    with pytest.raises(SceneError, match="folder/q, which is missing"):
        read_splats(at)
    (tmp_path / "elsewhere").write_bytes(images["q"])
    (tmp_path / "folder/q").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SceneError, match="a link out of its folder"):
        read_splats(at)


def lossy() -> bytes:
    image = np.zeros((4, 4, 3), np.uint8)
    return cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()


# ---- Streamed SOG: levels of detail in chunks ----------------------------------------------------


def streamed(folder: Path, **changes: Any) -> Path:
    """Two levels of 6 and 2 Gaussians along x, the finer in two chunks, and an environment."""
    chunks = {"0_0": (4, 4), "0_1": (2, 1), "1_0": (2, 1), "env": (3, 1)}  # counts, functions
    for name, (count, bands) in chunks.items():
        write_sog(folder / "one.sog", gaussians_on_x(count, bands), notes={"up": "-y"})
        with zipfile.ZipFile(folder / "one.sog") as archive:
            archive.extractall(folder / name)
    (folder / "one.sog").unlink()

    def leaf(**lods: tuple[int, int, int]) -> dict[str, Any]:
        fields = ("file", "offset", "count")
        lods_by_level = {k[1:]: dict(zip(fields, run, strict=True)) for k, run in lods.items()}
        return {"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}, "lods": lods_by_level}

    meta = {
        "version": 1,
        "asset": {"generator": "a test"},
        "count": 8,
        "counts": [6, 2],
        "lodLevels": 2,
        "environment": "env/meta.json",
        "filenames": ["0_0/meta.json", "0_1/meta.json", "1_0/meta.json"],
        "tree": {
            "bound": {"min": [0, 0, 0], "max": [1, 1, 1]},
            "children": [
                leaf(_0=(0, 3, 1), _1=(2, 0, 2)),
                {"children": [leaf(_0=(1, 0, 2)), leaf(_0=(0, 0, 3))]},
            ],
        },
    }
    (folder / "lod-meta.json").write_text(json.dumps(meta | changes))
    return folder / "lod-meta.json"


def test_a_streamed_scene_is_one_level_of_all_chunks(tmp_path: Path) -> None:
    path = streamed(tmp_path)
    assert detect_scheme(tmp_path) == detect_scheme(path) == "gaussians"
    fine = open_scene(f"{tmp_path}?path=orbit")
    assert fine.name == tmp_path.name and len(fine.background) == 6
    assert any("the finest, level 0 of 2 is taken; lod=N" in text for text in fine.problems)
    assert any("environment, env/meta.json, " in text for text in fine.problems)
    stored = read_splats(path)
    chunks = [read_splats(tmp_path / name / "meta.json").gaussians for name in ("0_0", "0_1")]
    assert torch.equal(stored.gaussians.means, torch.cat([chunk.means for chunk in chunks]))
    assert torch.equal(stored.gaussians.sh[:4], chunks[0].sh)
    assert not stored.gaussians.sh[4:, 1:].any() and stored.notes == {"up": "-y"}
    coarse = open_scene(f"gaussians:{path}?lod=1&path=orbit")
    assert len(coarse.background) == 2
    around = open_scene(f"gaussians:{tmp_path}/env/meta.json?path=orbit")
    assert len(around.background) == 3
    one = streamed(tmp_path, tree={"lods": {"0": {"file": 0, "offset": 1, "count": 2}}})
    assert torch.equal(read_splats(one).gaussians.means, chunks[0].means[1:3])


def test_streamed_scenes_that_are_refused(tmp_path: Path) -> None:
    (tmp_path / "f").mkdir()
    one = {"file": 0, "offset": 0, "count": 4}
    tree = {"lods": {"0": one}}
    (tmp_path / "outside.sog").write_bytes(b"")
    cases = {
        "version": ({"version": 2}, "version 1 of streamed SOG is read; got 2"),
        "levels": ({"lodLevels": 0}, "lodLevels"),
        "no tree": ({"tree": None}, "a node of its tree must be an object; got None"),
        "neither": ({"tree": {"bound": 1}}, "either children, a list, or lods"),
        "both": ({"tree": {"children": [tree], "lods": tree["lods"]}}, "either children"),
        "empty": ({"tree": {"children": []}}, "names no Gaussians of level 0"),
        "negative": ({"tree": {"lods": {"0": one | {"offset": -1}}}}, "offset"),
        "no chunk": ({"tree": {"lods": {"0": one | {"file": 9}}}}, "chunk 9 of 3 filenames"),
        "beyond": ({"tree": {"lods": {"0": one | {"count": 5}}}}, "up to 5 of .*which holds 4"),
        "a bomb": ({"tree": {"lods": {"0": one | {"count": 10**9}}}}, "announces 1000000000"),
        "shared": ({"tree": {"children": [tree, tree]}}, "two leaves share Gaussians of"),
        "twice": (
            {
                "filenames": ["0_0/meta.json", "./0_0/meta.json"],
                "tree": {"children": [tree, {"lods": {"0": one | {"file": 1}}}]},
            },
            "names a chunk twice",
        ),
        "outside": ({"filenames": ["../outside.sog"], "tree": tree}, "in the same folder or below"),
        "a URL": ({"filenames": ["http://a/meta.json"], "tree": tree}, "in the same folder"),
        "another file": ({"filenames": ["lod-meta.json"], "tree": tree}, "in the same folder"),
        "a link": ({"filenames": ["link.sog"], "tree": tree}, "a link out of its folder"),
        "absent": ({"filenames": ["2_0/meta.json"], "tree": tree}, "2_0/meta.json, which is not"),
        "a long name": ({"filenames": ["a" * 999 + ".sog"], "tree": tree}, "name too long"),
        "names": ({"filenames": [1] * 1000, "tree": tree}, r"filenames.0: .*; got 1$"),
    }
    (tmp_path / "f" / "link.sog").symlink_to(tmp_path / "outside.sog")
    for name, (changes, message) in cases.items():
        path = streamed(tmp_path / "f")
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)
    path.write_text('{"version": 1, "tree": ' + '{"children": [' * 50_000)
    with pytest.raises(SceneError, match="nested too deeply"):
        read_splats(path)
    with pytest.raises(SceneError, match="no level 2; it has 0, the finest, to 1"):
        read_splats(streamed(tmp_path / "f"), level=2)
