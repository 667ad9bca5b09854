"""Gaussians in glTF files: round trips, nodes and packed columns against the format, refusals."""

from __future__ import annotations

import base64
import copy
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.files.formats import read_splats
from augment.files.gltf import read_gltf, write_glb
from augment.files.spz import write_spz
from augment.render.sh import evaluate_sh
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians
from tests.augment.test_splat_formats import some_gaussians
from tests.augment.test_spz import packed_4, record, version_4_of

KHR = "KHR_gaussian_splatting"
HALF = math.sqrt(0.5)
# A Gaussian at (1, 2, 3), a turn of 90 degrees about z, opacity 0.2.
COLUMNS = {
    "POSITION": np.array([[1, 2, 3]], "<f4"),
    "ROTATION": np.array([[0, 0, HALF, HALF]], "<f4"),
    "SCALE": np.array([[0.5, 1, 2]], "<f4"),
    "OPACITY": np.array([[51]], "<u1"),
    "SH_DEGREE_0_COEF_0": np.array([[0.1, 0.2, 0.3]], "<f4"),
}
COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}


def document(columns: dict[str, np.ndarray] = COLUMNS, stride: int = 16) -> dict[str, Any]:
    """A .gltf whose columns lie `stride` bytes apart in one data URI; integers are normalised."""
    blob, views, accessors = b"", [], []
    for column in columns.values():
        rows = [row.tobytes().ljust(stride, b"\xff") for row in column]
        views.append(
            {
                "buffer": 0,
                "byteOffset": len(blob),
                "byteLength": stride * len(rows),
                "byteStride": stride,
            }
        )
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": COMPONENTS[column.dtype.str[1:]],
                "normalized": column.dtype.kind != "f",
                "count": len(rows),
                "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[column.shape[1]],
            }
        )
        blob += b"".join(rows)
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    names = [name if name == "POSITION" else f"{KHR}:{name}" for name in columns]
    primitive = {
        "mode": 0,
        "attributes": {name: n for n, name in enumerate(names)},
        "extensions": {KHR: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return {
        "asset": {"version": "2.0"},
        "extensionsUsed": [KHR],
        "buffers": [{"byteLength": len(blob), "uri": uri}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }


def saved(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "a.gltf"
    path.write_text(json.dumps(content))
    return path


def compressed_document(packed: bytes, count: int, name: str = "spz_2") -> dict[str, Any]:
    """A .gltf whose splats are a .spz, with the accessors of attributes that hold nothing."""
    content = document()
    uri = "data:application/octet-stream;base64," + base64.b64encode(b"1234" + packed).decode()
    content["buffers"] = [{"byteLength": 4 + len(packed), "uri": uri}]
    content["bufferViews"] = [{"buffer": 0, "byteOffset": 4, "byteLength": len(packed)}]
    for accessor in content["accessors"]:
        del accessor["bufferView"]
        accessor["count"] = count
    compression = f"{KHR}_compression_{name}"
    content["extensionsRequired"] = [KHR, compression]
    splatting = content["meshes"][0]["primitives"][0]["extensions"][KHR]
    splatting["extensions"] = {compression: {"bufferView": 0}}
    return content


def covariance(gaussians: Gaussians) -> torch.Tensor:
    axes = rotmat_from_quat(gaussians.quats.double()) * gaussians.scales.double()[:, None]
    return axes @ axes.transpose(1, 2)


def test_columns_may_be_packed_strided_and_beside_the_file(tmp_path: Path) -> None:
    packed = COLUMNS | {
        "ROTATION": np.array([[0, 0, 23170, 23170]], "<i2"),
        "SCALE": np.array([[0, 51, 255]], "<u1"),
    }
    packed["SCALE"][0, 0] = 5
    content = document(packed)
    data = base64.b64decode(content["buffers"][0]["uri"].partition(",")[2])
    (tmp_path / "the data.bin").write_bytes(data)
    content["buffers"][0]["uri"] = "the%20data.bin"
    found = read_gltf(saved(tmp_path, content)).gaussians
    assert found.means.tolist() == [[1, 2, 3]]
    assert found.opacities.item() == pytest.approx(0.2)
    assert found.scales[0].tolist() == pytest.approx([5 / 255, 0.2, 1])
    assert found.quats[0].tolist() == pytest.approx([HALF, 0, 0, HALF], abs=1e-6)
    assert found.sh[0, 0].tolist() == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize("name", ["spz", "spz_2"])
@pytest.mark.parametrize("version", [3, 4])
def test_splats_may_be_a_spz(tmp_path: Path, name: str, version: int) -> None:
    """Its axes are those of the node, which turns y into z here."""
    spz = tmp_path / "a.spz"
    write_spz(spz, some_gaussians(50, 4))
    packed = spz.read_bytes() if version == 3 else version_4_of(spz)
    content = compressed_document(packed, 50, name)
    expected = read_splats(spz).gaussians
    read = read_gltf(saved(tmp_path, content))
    assert read.notes == {"up": "+y", "unit": "metre"} and read.problems == ()
    assert torch.equal(read.gaussians.means, expected.means)
    assert torch.equal(read.gaussians.sh, expected.sh)
    content["nodes"][0]["rotation"] = [HALF, 0, 0, HALF]
    turned = read_gltf(saved(tmp_path, content)).gaussians.means
    x, y, z = expected.means.unbind(1)
    torch.testing.assert_close(turned, torch.stack([x, -z, y], dim=1), rtol=0, atol=1e-5)


def test_refusals_of_a_spz(tmp_path: Path) -> None:
    spz = tmp_path / "a.spz"
    write_spz(spz, some_gaussians(50, 4))
    packed = spz.read_bytes()
    bomb = packed_4([bytes(9 * 10**7), b"", b"", b"", b""], count=10**7)
    nan = packed_4([bytes(9), b"\0", bytes(3), bytes(3), bytes(4)])
    left_handed = version_4_of(spz, flags=2, records=record(0xADBE0003, b"\x08\0\0\0"))
    downward = version_4_of(spz, flags=2, records=record(0xADBE0003, b"\x06\0\0\0"))
    good = compressed_document(packed, 50)
    splatting = ("meshes", 0, "primitives", 0, "extensions", KHR, "extensions")
    name = f"{KHR}_compression_spz_2"
    view = ("bufferViews", 0)
    cases: dict[str, tuple[dict[str, Any], tuple[Any, ...], Any, str]] = {
        "cut": (compressed_document(packed[:90], 50), (), None, "its .spz: .*(truncat|whole)"),
        "empty": (compressed_document(b"", 50), (), None, "not a .spz|places 50 Gaussians"),
        "noise": (compressed_document(b"x" * 999, 50), (), None, "not a whole .spz"),
        "a bomb": (compressed_document(bomb, 50), (), None, "announces 10000000 Gaussians"),
        "many": (compressed_document(packed, 10**9), (), None, "places 1000000000 Gaussians"),
        "few": (compressed_document(packed, 49), (), None, "holds 50 Gaussians; POSITION says 49"),
        "one": (compressed_document(nan, 2), (), None, "holds 1 Gaussians; POSITION says 2"),
        "mirrored": (compressed_document(left_handed, 50), (), None, "RUF are left-handed"),
        "down": (compressed_document(downward, 50), (), None, r"-y is up; \+y is in glTF"),
        "version": (compressed_document(b"NGSP\x09" + bytes(99), 50), (), None, "version 9"),
        "no view": (good, (*splatting, name), {}, f"{name} is not read"),
        "a text": (good, (*splatting, name, "bufferView"), "0", f"{name} is not read"),
        "below": (good, (*splatting, name, "bufferView"), -1, f"{name} is not read"),
        "beyond": (good, (*splatting, name, "bufferView"), 7, "not a whole glTF"),
        "true": (good, (*splatting, name, "bufferView"), True, f"{name} is not read"),
        "a list": (good, (*splatting, name), [0], f"{name} is not read"),
        "two": (good, (*splatting, "EXT_other"), {}, "EXT_other is not read"),
        "length": (good, (*view, "byteLength"), 10**12, "4 to 1000000000004 of a buffer with"),
        "offset": (good, (*view, "byteOffset"), 10**12, "takes bytes 1000000000000"),
        "path": (good, ("buffers", 0, "uri"), "../a.spz", "must lie in the file's folder"),
        "link": (good, ("buffers", 0, "uri"), "http://a/b", "must lie in the file's folder"),
        "required": (good, ("extensionsRequired", 0), "KHR_other", "requires KHR_other"),
    }
    for case, (content, keys, value, message) in cases.items():
        changed = copy.deepcopy(content)
        target = changed
        for key in keys[:-1]:
            target = target[key]
        if keys:
            target[keys[-1]] = value
        with pytest.raises(SceneError, match=message):
            read_splats(saved(tmp_path, changed))
            pytest.fail(case)


def test_negative_scales_are_an_earlier_drafts_logarithms(tmp_path: Path) -> None:
    logs = COLUMNS | {"SCALE": np.log(COLUMNS["SCALE"])}
    read = read_gltf(saved(tmp_path, document(logs)))
    assert read.gaussians.scales[0].tolist() == pytest.approx([0.5, 1, 2])
    assert "earlier draft" in read.problems[0]
    for beyond in (1e4, np.inf):
        columns = {name: np.repeat(values, 2, axis=0) for name, values in logs.items()}
        columns["SCALE"][1] = beyond
        read = read_gltf(saved(tmp_path, document(columns)))
        assert len(read.gaussians) == 1 and "left out 1 of 2" in " ".join(read.problems)


def test_nodes_place_turn_and_stretch(tmp_path: Path) -> None:
    """Covariances are M S M^T; colours are seen from the turned direction."""
    before = some_gaussians(count=20)
    columns = {
        "POSITION": before.means.numpy(),
        "ROTATION": before.quats[:, [1, 2, 3, 0]].numpy(),
        "SCALE": before.scales.numpy(),
        "OPACITY": before.opacities[:, None].numpy(),
    }
    for number in range(16):
        degree = math.isqrt(number)
        columns[f"SH_DEGREE_{degree}_COEF_{number - degree**2}"] = before.sh[:, number].numpy()
    content = document(columns)
    turn = rotmat_from_quat(torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64))
    directions = torch.nn.functional.normalize(before.means.double(), dim=1)
    for stretch in ([2.0, 2.0, 2.0], [1.0, 2.0, 3.0]):
        matrix = np.eye(4)
        matrix[:3, 3] = [10, 20, 30]
        content["nodes"] = [
            {"children": [1], "matrix": matrix.T.ravel().tolist()},
            {"mesh": 0, "rotation": [0.5, 0.5, 0.5, 0.5], "scale": stretch},
        ]
        after = read_gltf(saved(tmp_path, content)).gaussians
        linear = turn @ torch.tensor(stretch, dtype=torch.float64).diag()
        moved = before.means.double() @ linear.T + torch.tensor([10.0, 20, 30])
        assert (after.means - moved).abs().max() < 1e-4  # float32 at 300
        expected = linear @ covariance(before) @ linear.T
        size = expected.abs().amax((1, 2), keepdim=True)
        assert ((covariance(after) - expected).abs() / size).max() < 1e-5  # of float32 columns
        colours = evaluate_sh(after.sh.double(), directions @ turn.T)
        # SH in float32, turned by a float32 matrix.
        assert (colours - evaluate_sh(before.sh.double(), directions)).abs().max() < 1e-5


def test_places_far_away_keep_their_precision(tmp_path: Path) -> None:
    content = document()
    content["nodes"][0]["translation"] = [4e6, 0, 5e6]
    read = read_gltf(saved(tmp_path, content))
    assert (read.gaussians.means.double().numpy() + read.origin).tolist() == [[4000001, 2, 5000003]]


def test_refusals(tmp_path: Path) -> None:
    (tmp_path.parent / "outside.bin").write_bytes(bytes(80))

    def changed(*path: Any, to: Any) -> dict[str, Any]:
        content = copy.deepcopy(document())
        at: Any = content
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = to
        return content

    primitive = ("meshes", 0, "primitives", 0)
    extension = (*primitive, "extensions", KHR)
    lacking = {name: c for name, c in COLUMNS.items() if name != "OPACITY"}
    partial = COLUMNS | {"SH_DEGREE_1_COEF_1": COLUMNS["SCALE"]}
    many = [{"mesh": 0} for _ in range(200)]
    cases = {
        "no splats": (changed(*primitive, "extensions", to={}), f"no primitive with {KHR}"),
        "a draft": (document(lacking), "lacks OPACITY"),
        "half a band": (document(partial), "lacking SH_DEGREE_1_COEF_0, SH_DEGREE_1_COEF_2"),
        "required": (changed("extensionsRequired", to=["EXT_x"]), "requires EXT_x"),
        "compressed": (changed(*extension, "extensions", to={"SPZ": {}}), "SPZ is not read"),
        "kernel": (changed(*extension, "kernel", to="disk"), "kernel ellipse"),
        "linear": (changed(*extension, "colorSpace", to="lin_rec709_display"), "srgb_rec709"),
        "version": (changed("asset", to={"version": "1.0"}), "expected glTF 2"),
        "count": (changed("accessors", 1, "count", to=2), "ROTATION must be 1 of VEC4; got 2"),
        "a bomb": (changed("accessors", 0, "count", to=1 << 40), "places 1099511627776 Gaussians"),
        "beyond the view": (changed("accessors", 0, "byteOffset", to=8), "truncated or damaged"),
        "beyond the buffer": (changed("bufferViews", 0, "byteOffset", to=999), "of a buffer with"),
        "copies": (changed("nodes", to=many) | {"scenes": [{"nodes": [*range(200)]}]}, "copies"),
        "a loop": (changed("nodes", to=[{"children": [0]}]), "two parents"),
        "a mirror": (changed("nodes", 0, "scale", to=[-1, 1, 1]), "mirrors"),
        "no rotation": (changed("nodes", 0, "rotation", to=[0, 0, 0, 0]), "node 0 has no place"),
        "beyond float64": (changed("nodes", 0, "scale", to=[1e200] * 3), "no usable Gaussians"),
        "nodes": (changed("nodes", to=[{}] * 20_001), "20001 nodes; at most 20000"),
        "placed": (
            changed("nodes", to=[{"mesh": 0}] * 10_001) | {"scenes": [{"nodes": [*range(10_001)]}]},
            "more than 10000 primitives",
        ),
        "an absent buffer": (
            changed("nodes", to=many)
            | {
                "scenes": [{"nodes": [*range(200)]}],
                "buffers": [*document()["buffers"], {"byteLength": 10**9, "uri": "none"}],
            },
            "copies",
        ),
        "half a character": (changed("buffers", 0, "uri", to="\ud800"), "half a character"),
        "a zero byte": (changed("buffers", 0, "uri", to="a%00/b"), "in the file's folder"),
        "no node": (changed("scenes", 0, "nodes", to=[7]), "not a whole glTF"),
        "a type": (changed("accessors", 0, "count", to="many"), "accessors.0.count"),
        "outside": (changed("buffers", 0, "uri", to="../outside.bin"), "in the file's folder"),
        "a URL": (changed("buffers", 0, "uri", to="http://a/b.bin"), "in the file's folder"),
        "not there": (changed("buffers", 0, "uri", to="b.bin"), "is not there"),
        "not base64": (changed("buffers", 0, "uri", to="data:;base64,*"), "cannot be read"),
        "not ASCII": (changed("buffers", 0, "uri", to="data:;base64,\u00e9"), "cannot be read"),
        "too short": (changed("buffers", 0, "byteLength", to=999), "has 999 bytes; found 80"),
        "no data": (changed("buffers", 0, to={"byteLength": 80}), "found none"),
    }
    for name, (content, message) in cases.items():
        with pytest.raises(SceneError, match=message):
            read_splats(saved(tmp_path, content))
            pytest.fail(name)
    path = tmp_path / "a.glb"
    write_glb(path, some_gaussians(bands=1))
    whole = path.read_bytes()
    for data, message in (
        (whole[:12], "header ends early"),
        (whole[:8] + struct.pack("<III", 0, 1 << 31, 0x4E4F534A) + whole[20:], "begins with JSON"),
        (whole.replace(b'"scene":0', b'"scene":9' + b"9" * 5000), "its JSON cannot be read"),
        (whole.replace(b"{", b"[", 1), "its JSON cannot be read"),
    ):
        path.write_bytes(data)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
