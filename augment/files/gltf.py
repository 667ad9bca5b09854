"""Gaussians in glTF 2.0 files, .glb and .gltf, by KHR_gaussian_splatting as Khronos ratified it.

A primitive of points has POSITION, and after the extension's name and a colon ROTATION (xyzw),
SCALE (linear), OPACITY and SH_DEGREE_l_COEF_n. Nodes place its mesh in the scene, y up, metres.
Facts by the glTF 2.0 specification and the extension's README (KhronosGroup/glTF). Until 2026 its
drafts stored logarithms of scales: where a scale is negative, which is forbidden now, they are read
as such, and it is said. Compressed splats (SPZ, meshopt) and linear colours are refused.

A file is not trusted: counts are compared with the bytes that are there, placed copies with the
file's size, and buffers lie in the file, in its text, or beside it.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from urllib.parse import unquote

import numpy as np
import torch
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    ValidationError,
)

from augment.errors import SceneError
from augment.files.limits import check_memory, parsed_json
from augment.files.ply import SplatFile, join_placed
from augment.geometry import rotmat_from_quat
from augment.jobs.atomic import replaced_file
from augment.scene import SH_COUNTS, Gaussians

EXTENSION = "KHR_gaussian_splatting"
GLB = b"glTF"
NOTES = {"up": "+y", "unit": "metre"}
_CHUNKS = struct.Struct("<4sIIII"), struct.Struct("<II")  # with the first chunk's; of the second
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MAX_JSON = 256 << 20  # bytes of text, with buffers in it
_MAX_VALUES = 2_000_000  # in the JSON, buffers left out
_MAX_NODES = 20_000
_MAX_ATTRIBUTES = 1000  # of a primitive
_MAX_PLACED = 10_000  # primitives in the scene, copies among them
_KNOWN = {EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit"}
_COLOURS = (None, "srgb_rec709_display", "BT.709-sRGB", "BT.709")  # the drafts' names are the rest
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_IS_COLOUR = ":SH_DEGREE_"  # in the names of attributes
_LEAST_ROW = 12  # bytes of a Gaussian, whose first coefficients are floats
_MAX_COPIES = 16  # of all Gaussians that the file has room for

# ---- The document, as far as it is used ----------------------------------------------------------


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True)


class _Buffer(_Entry):
    byteLength: NonNegativeInt
    uri: str | None = None


class _View(_Entry):
    buffer: NonNegativeInt
    byteLength: NonNegativeInt
    byteOffset: NonNegativeInt = 0
    byteStride: int | None = Field(None, ge=1, le=252)
    extensions: dict[str, Any] = {}


class _Accessor(_Entry):
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: int = Field(ge=1)
    type: str
    bufferView: NonNegativeInt | None = None
    byteOffset: NonNegativeInt = 0
    normalized: bool = False
    sparse: Any = None


class _Splatting(_Entry):
    kernel: str | None = None
    colorSpace: str | None = None
    extensions: dict[str, Any] = {}


class _PrimitiveExtensions(_Entry):
    KHR_gaussian_splatting: _Splatting | None = None


def _of_few_keys(value: object) -> object:
    if isinstance(value, dict) and len(value) > _MAX_ATTRIBUTES:
        raise ValueError(f"it has {len(value)} attributes; at most {_MAX_ATTRIBUTES} are read")
    return value


class _Primitive(_Entry):
    attributes: Annotated[dict[str, NonNegativeInt], BeforeValidator(_of_few_keys)] = {}
    mode: int = 4
    extensions: _PrimitiveExtensions = _PrimitiveExtensions()


class _Mesh(_Entry):
    primitives: Annotated[tuple[_Primitive, ...], Field(fail_fast=True)]


# A list with a wrong item is not looked at to its end: of millions of errors each costs a kilobyte.
_Numbers = Annotated[tuple[FiniteFloat, ...], Field(fail_fast=True)]
_Indices = Annotated[tuple[NonNegativeInt, ...], Field(fail_fast=True)]


class _Node(_Entry):
    mesh: NonNegativeInt | None = None
    children: _Indices = ()
    matrix: _Numbers | None = Field(None, min_length=16, max_length=16)
    translation: _Numbers = Field((0, 0, 0), min_length=3, max_length=3)
    rotation: _Numbers = Field((0, 0, 0, 1), min_length=4, max_length=4)
    scale: _Numbers = Field((1, 1, 1), min_length=3, max_length=3)

    @property
    def parent_from_node(self) -> np.ndarray:
        """float64 [4, 4]."""
        if self.matrix is not None:  # column after column
            return np.array(self.matrix, np.float64).reshape(4, 4).T
        x, y, z, w = self.rotation
        out = np.eye(4)
        turn = np.eye(3)
        if self.rotation != (0, 0, 0, 1):
            turn = rotmat_from_quat(torch.tensor([w, x, y, z], dtype=torch.float64)).numpy()
        out[:3, :3] = turn * np.array(self.scale)
        out[:3, 3] = self.translation
        return out


class _Scene(_Entry):
    nodes: _Indices = ()


class _Document(_Entry):
    asset: dict[str, Any]
    extensionsRequired: Annotated[tuple[str, ...], Field(fail_fast=True)] = ()
    buffers: Annotated[tuple[_Buffer, ...], Field(fail_fast=True)] = ()
    bufferViews: Annotated[tuple[_View, ...], Field(fail_fast=True)] = ()
    accessors: Annotated[tuple[_Accessor, ...], Field(fail_fast=True)] = ()
    meshes: Annotated[tuple[_Mesh, ...], Field(fail_fast=True)] = ()
    nodes: Annotated[tuple[_Node, ...], Field(fail_fast=True)] = ()
    scenes: Annotated[tuple[_Scene, ...], Field(fail_fast=True)] = ()
    scene: NonNegativeInt = 0


class _Columns(NamedTuple):
    """Of one primitive, in its own axes. is_log: of a draft whose scales were logarithms."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    is_log: bool


# ---- Reading -------------------------------------------------------------------------------------


def read_gltf(path: str | Path) -> SplatFile:
    """Read all Gaussians of the file's scene, in its axes. Raises SceneError: damaged, without
    Gaussians, or with extensions that are not read.
    """
    path = Path(path)
    try:
        return _File(path).read()
    except (IndexError, RecursionError) as error:
        raise SceneError(f"{path}: not a whole glTF file ({error}); export it again") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise SceneError(f"{path}: its JSON is not glTF 2.0's: {where}: {first['msg']}") from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error


class _File:
    def __init__(self, path: Path) -> None:
        self.path = path
        text, self.chunk = _parts(path)
        document = parsed_json(text, str(path), max_values=_MAX_VALUES)
        self.document = _Document.model_validate(document)
        self.buffers: dict[int, np.ndarray] = {}
        self.problems: list[str] = []
        unknown = sorted(set(self.document.extensionsRequired) - _KNOWN)
        if unknown:
            raise self.error(f"it requires {', '.join(unknown)}, which is not read; export without")
        if not str(self.document.asset.get("version", "")).startswith("2."):
            raise self.error(f"expected glTF 2; its asset says {self.document.asset}")

    def error(self, what: str) -> SceneError:
        return SceneError(f"{self.path}: {what}")

    def read(self) -> SplatFile:
        placed = list(self.placed_primitives())
        if not placed:
            raise self.error(f"its scene has no primitive with {EXTENSION}; splats are needed")
        self.check_rows([primitive for primitive, _ in placed])
        read: dict[int, _Columns] = {}
        parts = []
        for primitive, matrix in placed:
            if id(primitive) not in read:
                read[id(primitive)] = self.columns(primitive)
            parts.append(_placed(read[id(primitive)], matrix))
        if any(columns.is_log for columns in read.values()):
            self.problems.append(
                f"{self.path}: negative scales are taken as logarithms, as an earlier draft of "
                f"{EXTENSION} stored all scales"
            )
        return join_placed(parts, self.path, NOTES, self.problems)

    def check_rows(self, primitives: Sequence[_Primitive]) -> None:
        """Refuse more Gaussians, or copies of them, than the buffers that are there can hold."""
        document = self.document
        accessors = [document.accessors[p.attributes.get("POSITION", 0)] for p in primitives]
        rows = sum(accessor.count for accessor in accessors)
        views = {a.bufferView for a in accessors if a.bufferView is not None}
        numbers = {document.bufferViews[view].buffer for view in views}
        sizes = {document.buffers[n].uri: len(self.buffer(n)) for n in numbers}  # once a file
        room = sum(sizes.values()) // _LEAST_ROW
        if rows > _MAX_COPIES * room:
            raise self.error(
                f"it places {rows} Gaussians, more than {_MAX_COPIES} times the {room} that its "
                "buffers have room for; place fewer copies"
            )
        functions = max(sum(_IS_COLOUR in name for name in p.attributes) for p in primitives)
        check_memory(str(self.path), rows, functions=functions, size=sum(sizes.values()))

    def placed_primitives(self) -> Iterator[tuple[_Primitive, np.ndarray]]:
        """Primitives of Gaussians with world_from_node, in the order of the scene's nodes."""
        document, seen, others = self.document, set(), 0
        if len(document.nodes) > _MAX_NODES:
            raise self.error(f"it has {len(document.nodes)} nodes; at most {_MAX_NODES} are read")
        count, roots = 0, tuple[int, ...]()
        if document.scenes:
            roots = document.scenes[document.scene].nodes
        else:
            children = {child for node in document.nodes for child in node.children}
            roots = tuple(n for n in range(len(document.nodes)) if n not in children)
        waiting = [(number, np.eye(4)) for number in reversed(roots)]
        while waiting:
            number, world_from_parent = waiting.pop()
            if number in seen:
                raise self.error(f"node {number} has two parents; nodes must be a tree")
            seen.add(number)
            node = document.nodes[number]
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = world_from_parent @ node.parent_from_node
                volume = np.linalg.det(matrix[:3, :3])
            if not np.isfinite(matrix).all():
                raise self.error(
                    f"node {number} has no place in the scene: its rotation must be a quaternion "
                    f"of length 1, its other numbers within float64; got the rotation "
                    f"{list(node.rotation)}, translation {list(node.translation)}, scale "
                    f"{list(node.scale)}"
                )
            if node.mesh is not None:
                for primitive in document.meshes[node.mesh].primitives:
                    if primitive.extensions.KHR_gaussian_splatting is not None:
                        if not volume > 0:
                            raise self.error(f"node {number} mirrors or flattens its Gaussians")
                        count += 1
                        if count > _MAX_PLACED:
                            raise self.error(
                                f"it places more than {_MAX_PLACED} primitives of Gaussians; join "
                                "them, or place fewer copies"
                            )
                        yield primitive, matrix
                    else:
                        others += 1
            waiting += [(child, matrix) for child in reversed(node.children)]
        if others:
            self.problems.append(f"{self.path}: left out {others} meshes and points, not Gaussians")

    def columns(self, primitive: _Primitive) -> _Columns:
        extension = primitive.extensions.KHR_gaussian_splatting
        assert extension is not None
        if extension.extensions:
            raise self.error(f"{', '.join(extension.extensions)} is not read; export without")
        if extension.kernel not in (None, "ellipse") or extension.colorSpace not in _COLOURS:
            raise self.error(
                f"expected the kernel ellipse and colours in srgb_rec709_display; it has "
                f"{extension.kernel} and {extension.colorSpace}"
            )
        found = {
            name.removeprefix(f"{EXTENSION}:"): accessor
            for name, accessor in primitive.attributes.items()
        }
        lacking = [
            n for n in ("POSITION", "ROTATION", "SCALE", "OPACITY", _sh(0, 0)) if n not in found
        ]
        if lacking:
            raise self.error(
                f"a primitive of Gaussians lacks {', '.join(lacking)}, which the ratified "
                f"{EXTENSION} requires; it has {', '.join(primitive.attributes) or 'nothing'}"
            )
        names = [_sh(0, 0)]
        for degree in range(1, len(SH_COUNTS)):
            band = [_sh(degree, n) for n in range(2 * degree + 1)]
            if not any(name in found for name in band):
                break
            names += band
        lacking = [name for name in names if name not in found]
        surplus = [name for name in found if name.startswith("SH_") and name not in names]
        if lacking or surplus:
            raise self.error(
                f"spherical harmonics must be whole bands from 0 to 3: lacking "
                f"{', '.join(lacking) or 'none'}, beyond {', '.join(surplus) or 'none'}"
            )
        count = self.document.accessors[found["POSITION"]].count

        def column(name: str, kind: str) -> np.ndarray:
            return self.column(name, found[name], kind, count)

        scales = column("SCALE", "VEC3")
        is_log = bool((scales < 0).any())
        if is_log:
            with np.errstate(over="ignore"):  # infinite ones are left out, and reported
                scales = np.exp(scales)
        return _Columns(
            means=column("POSITION", "VEC3"),
            quats=np.ascontiguousarray(column("ROTATION", "VEC4")[:, [3, 0, 1, 2]]),
            scales=scales,
            opacities=column("OPACITY", "SCALAR")[:, 0],
            sh=np.stack([column(name, "VEC3") for name in names], axis=1),
            is_log=is_log,
        )

    def column(self, name: str, number: int, kind: str, count: int) -> np.ndarray:
        """float32 [N, width]."""
        accessor = self.document.accessors[number]
        if accessor.type != kind or accessor.count != count:
            raise self.error(
                f"{name} must be {count} of {kind}; got {accessor.count} of {accessor.type}"
            )
        if accessor.bufferView is None or accessor.sparse is not None:
            raise self.error(f"{name} is sparse or in no buffer view, which is not read")
        view = self.document.bufferViews[accessor.bufferView]
        if view.extensions:
            raise self.error(f"{', '.join(view.extensions)} is not read; export without")
        data, dtype, width = self.buffer(view.buffer), np.dtype(_TYPES[accessor.componentType]), 0
        width = _WIDTHS[kind]
        size = width * dtype.itemsize
        stride = view.byteStride or size
        end = accessor.byteOffset + stride * (count - 1) + size
        if stride < size or end > view.byteLength or view.byteOffset + view.byteLength > len(data):
            raise self.error(
                f"{name} takes {end} bytes, {stride} apart, of a view with {view.byteLength} at "
                f"{view.byteOffset} of a buffer with {len(data)}: truncated or damaged"
            )
        start = view.byteOffset + accessor.byteOffset
        strides = (stride, dtype.itemsize)
        values = np.ndarray((count, width), dtype, data.data, start, strides).astype(np.float32)
        if accessor.normalized and dtype.kind != "f":
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1))
        return values

    def buffer(self, number: int) -> np.ndarray:
        """Its bytes."""
        if number not in self.buffers:
            entry = self.document.buffers[number]
            data = self.chunk if entry.uri is None and number == 0 else None
            if entry.uri is not None:
                data = self.by_uri(entry.uri)
            if data is None or len(data) < entry.byteLength:
                held = "none" if data is None else len(data)
                raise self.error(f"buffer {number} has {entry.byteLength} bytes; found {held}")
            self.buffers[number] = data[: entry.byteLength]
        return self.buffers[number]

    def by_uri(self, uri: str) -> np.ndarray:
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                if not head.endswith(";base64"):
                    raise binascii.Error("its data URI is not base64")
                return np.frombuffer(base64.b64decode(text, validate=True), np.uint8)
            except binascii.Error as error:
                raise self.error(f"a buffer's data cannot be read: {error}") from error
        root = self.path.parent.resolve()
        file = root / unquote(uri)
        if ":" in uri or "\0" in unquote(uri) or not file.resolve().is_relative_to(root):
            raise self.error(f"a buffer must lie in the file's folder; got {uri[:200]!r}")
        if not file.is_file() or not file.stat().st_size:
            raise self.error(f"its buffer {uri[:200]!r} is not there; copy it beside the file")
        return np.memmap(file, np.uint8, "r")


def _sh(degree: int, number: int) -> str:
    return f"SH_DEGREE_{degree}_COEF_{number}"


def _parts(path: Path) -> tuple[bytes, np.ndarray | None]:
    """The JSON, and the binary chunk of a .glb."""
    data = np.memmap(path, np.uint8, "r")
    if bytes(data[:4]) != GLB:
        if len(data) > _MAX_JSON:
            raise SceneError(f"{path}: a .gltf has at most {_MAX_JSON} bytes; save it as .glb")
        return data.tobytes(), None
    first, second = _CHUNKS
    if len(data) < first.size:
        raise SceneError(f"{path}: its header ends early; it is truncated: copy it again")
    _, version, _, size, kind = first.unpack(data[: first.size].tobytes())
    end = first.size + size
    if version != 2 or kind != _JSON or size > _MAX_JSON or end > len(data):
        raise SceneError(
            f"{path}: expected a .glb of version 2 that begins with JSON of at most {_MAX_JSON} "
            f"bytes; got version {version}, a chunk {kind:#x} of {size} bytes in {len(data)}"
        )
    text, rest = data[first.size : end].tobytes(), data[end:]
    if len(rest) < second.size:
        return text, None
    size, kind = second.unpack(rest[: second.size].tobytes())
    return text, rest[second.size : second.size + size] if kind == _BIN else None


def _placed(columns: _Columns, matrix: np.ndarray) -> tuple[np.ndarray, Gaussians]:
    """Places in the scene, float64, and Gaussians that are turned and sized as there; their own
    means are unused.
    """
    from augment.files.export import transformed_gaussians  # which writes by this module

    own = Gaussians(
        means=torch.zeros(len(columns.means), 3),
        **{
            name: torch.from_numpy(np.ascontiguousarray(getattr(columns, name), np.float32))
            for name in ("quats", "scales", "opacities", "sh")
        },
    )
    places = columns.means.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return places, transformed_gaussians(own, torch.from_numpy(matrix[:3, :3].copy()))


# ---- Writing -------------------------------------------------------------------------------------


def write_glb(path: str | Path, gaussians: Gaussians) -> None:
    """Write a .glb, atomically, from Gaussians whose y points up: floats, one primitive."""
    columns = {
        "POSITION": gaussians.means,
        "ROTATION": torch.nn.functional.normalize(gaussians.quats, dim=1)[:, [1, 2, 3, 0]],
        "SCALE": gaussians.scales,
        "OPACITY": gaussians.opacities[:, None],
    }
    for degree in range(gaussians.sh_degree + 1):
        for number in range(2 * degree + 1):
            columns[_sh(degree, number)] = gaussians.sh[:, degree * degree + number]
    arrays = [np.ascontiguousarray(c.detach().cpu().numpy(), "<f4") for c in columns.values()]
    ends = np.cumsum([array.nbytes for array in arrays]).tolist()
    kinds = {width: kind for kind, width in _WIDTHS.items()}
    accessors: list[dict[str, Any]] = [
        {"bufferView": n, "componentType": 5126, "count": len(a), "type": kinds[a.shape[1]]}
        for n, a in enumerate(arrays)
    ]
    accessors[0] |= {"min": arrays[0].min(0).tolist(), "max": arrays[0].max(0).tolist()}
    names = [name if name == "POSITION" else f"{EXTENSION}:{name}" for name in columns]
    primitive = {
        "mode": 0,
        "attributes": {name: n for n, name in enumerate(names)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": _COLOURS[1]}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "ClimateGS"},
        "extensionsUsed": [EXTENSION],
        "buffers": [{"byteLength": ends[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": end - array.nbytes, "byteLength": array.nbytes}
            for array, end in zip(arrays, ends, strict=True)
        ],
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    first, second = _CHUNKS
    total = first.size + len(text) + second.size + ends[-1]
    if total >= 1 << 32:
        raise SceneError(f"{path}: {total} bytes; a .glb ends at 4 GiB: export as .ply or .spz")
    with replaced_file(Path(path)) as file:
        file.write(first.pack(GLB, 2, total, len(text), _JSON) + text)
        file.write(second.pack(ends[-1], _BIN))
        for array in arrays:
            file.write(array.tobytes())
