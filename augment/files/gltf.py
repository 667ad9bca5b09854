"""Reads and writes Gaussians in glTF 2.0 files, .glb and .gltf, by Khronos' KHR_gaussian_splatting.

A primitive of points has POSITION, and after the extension's name and a colon ROTATION (xyzw),
SCALE (linear), OPACITY and SH_DEGREE_l_COEF_n. Nodes place its mesh in the scene, y up, metres.
Sources: the glTF 2.0 specification and the extension's README (KhronosGroup/glTF) as ratified.
Until 2026 its drafts stored logarithms of scales. The ratified extension forbids negative scales:
where a scale is negative, all are read as logarithms, and a problem is reported. Splats may be a
.spz in a buffer view (the drafts KHR_gaussian_splatting_compression_spz and _spz_2), whose axes are
then those of the node. Other compression (meshopt) and linear colours are refused.

A file is not trusted: counts are compared with the bytes that exist, placed copies with the file's
size, and buffers must lie in the file, in its text, or beside it.
"""

from __future__ import annotations

import base64
import binascii
import io
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
from augment.files.limits import check_memory, parse_json_object
from augment.files.splat_format import (
    FileFacts,
    Loss,
    SplatFile,
    SplatFormat,
    SplatWriter,
    join_positioned_parts,
    rotate_z_to_y,
)
from augment.files.spz import UP as SPZ_UP
from augment.files.spz import read_spz_stream
from augment.output.atomic import write_file_atomically
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians
from augment.scene.transform import transform_gaussians

EXTENSION = "KHR_gaussian_splatting"  # the extension's name
_GLB_MARK = b"glTF"  # first bytes of a .glb
NOTES = {"up": "+y", "unit": "metre"}  # facts that hold for every glTF file
_HEADERS = (
    struct.Struct("<4sIIII"),  # the file's header and that of its first chunk
    struct.Struct("<II"),  # the header of the second chunk
)
_JSON_CHUNK = 0x4E4F534A  # type of a chunk of JSON
_BINARY_CHUNK = 0x004E4942  # type of a chunk of bytes
_MAX_JSON_BYTES = 256 << 20  # bytes of text, including buffers inside it
_MAX_VALUES = 2_000_000  # values in the JSON, without buffers
_MAX_NODES = 20_000  # nodes of a file
_MAX_ATTRIBUTES = 1000  # attributes of a primitive
_MAX_PRIMITIVES = 10_000  # primitives in the scene, copies included
# Names of the extension that stores a .spz in place of the columns.
_SPZ_EXTENSIONS = tuple(f"{EXTENSION}_compression_{name}" for name in ("spz_2", "spz"))
_READ_EXTENSIONS = {*_SPZ_EXTENSIONS, EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit"}
# Accepted colour spaces: none stated, the ratified name, and two names of the drafts.
_COLOUR_SPACES = (None, "srgb_rec709_display", "BT.709-sRGB", "BT.709")
# numpy's type codes of glTF's component types.
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}  # numbers of each type of accessor
_SH_INFIX = ":SH_DEGREE_"  # part of the names of colour attributes
_MIN_ROW_BYTES = 12  # bytes of a Gaussian: at least its first coefficients are floats
_MAX_COPIES = 16  # copies of all Gaussians that the file has room for

# ---- The document, as far as it is used ----------------------------------------------------------


class _Entry(BaseModel):
    """Base of the JSON document's objects."""

    model_config = ConfigDict(frozen=True)


class _Buffer(_Entry):
    """Bytes in the file, in a data URI, or in another file."""

    byteLength: NonNegativeInt
    uri: str | None = None


class _View(_Entry):
    """A part of a buffer."""

    buffer: NonNegativeInt
    byteLength: NonNegativeInt
    byteOffset: NonNegativeInt = 0
    byteStride: int | None = Field(None, ge=1, le=252)
    extensions: dict[str, Any] = {}


class _Accessor(_Entry):
    """The type and the count of the numbers in a view."""

    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: int = Field(ge=1)
    type: str
    bufferView: NonNegativeInt | None = None
    byteOffset: NonNegativeInt = 0
    normalized: bool = False
    sparse: Any = None


class _Splatting(_Entry):
    """The object KHR_gaussian_splatting of a primitive."""

    kernel: str | None = None
    colorSpace: str | None = None
    extensions: dict[str, Any] = {}

    @property
    def spz_view(self) -> int | None:
        """Return the buffer view of a .spz; None where the attributes hold the splats."""
        entry = next(
            (self.extensions.get(n) for n in _SPZ_EXTENSIONS if n in self.extensions), None
        )
        if entry is None or len(self.extensions) > 1:
            return None
        number = entry.get("bufferView") if isinstance(entry, dict) else None
        return number if type(number) is int and number >= 0 else None


class _PrimitiveExtensions(_Entry):
    """Extensions of a primitive."""

    KHR_gaussian_splatting: _Splatting | None = None


def _check_num_attributes(value: object) -> object:
    """Refuse a primitive with too many attributes, before each is checked."""
    if isinstance(value, dict) and len(value) > _MAX_ATTRIBUTES:
        raise ValueError(f"it has {len(value)} attributes; at most {_MAX_ATTRIBUTES} are read")
    return value


class _Primitive(_Entry):
    """Points, triangles or Gaussians of a mesh."""

    attributes: Annotated[dict[str, NonNegativeInt], BeforeValidator(_check_num_attributes)] = {}
    mode: int = 4
    extensions: _PrimitiveExtensions = _PrimitiveExtensions()


class _Mesh(_Entry):
    """A list of primitives."""

    primitives: Annotated[tuple[_Primitive, ...], Field(fail_fast=True)]


# Checks of a list stop at its first wrong item: each of millions of errors would cost a kilobyte.
_Numbers = Annotated[tuple[FiniteFloat, ...], Field(fail_fast=True)]
_Indices = Annotated[tuple[NonNegativeInt, ...], Field(fail_fast=True)]


class _Node(_Entry):
    """A node of the scene's tree, with its mesh and children."""

    mesh: NonNegativeInt | None = None
    children: _Indices = ()
    matrix: _Numbers | None = Field(None, min_length=16, max_length=16)
    translation: _Numbers = Field((0, 0, 0), min_length=3, max_length=3)
    rotation: _Numbers = Field((0, 0, 0, 1), min_length=4, max_length=4)
    scale: _Numbers = Field((1, 1, 1), min_length=3, max_length=3)

    @property
    def parent_from_node(self) -> np.ndarray:
        """Return the node's transform, float64 [4, 4]."""
        if self.matrix is not None:  # stored column by column
            return np.array(self.matrix, np.float64).reshape(4, 4).T
        x, y, z, w = self.rotation
        transform = np.eye(4)
        rotation = np.eye(3)
        if self.rotation != (0, 0, 0, 1):
            rotation = rotmat_from_quat(torch.tensor([w, x, y, z], dtype=torch.float64)).numpy()
        transform[:3, :3] = rotation * np.array(self.scale)
        transform[:3, 3] = self.translation
        return transform


class _Scene(_Entry):
    """The roots of the scene's tree."""

    nodes: _Indices = ()


class _Document(_Entry):
    """The whole JSON document."""

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
    """Gaussians of one primitive, in its own axes; float32."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4], wxyz
    scales: np.ndarray  # [N, 3]
    opacities: np.ndarray  # [N]
    sh: np.ndarray  # [N, K, 3]
    is_log: bool  # True where the file, by an earlier draft, stored logarithms of the scales


# ---- Reading -------------------------------------------------------------------------------------


def read_gltf(path: str | Path) -> SplatFile:
    """Read all Gaussians of the file's scene, in its axes.

    Raises:
        SceneError: the file is damaged, has no Gaussians, or has extensions that are not read.
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
    """An opened glTF file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        text, self.chunk = _read_chunks(path)
        document = parse_json_object(text, str(path), max_values=_MAX_VALUES)
        self.document = _Document.model_validate(document)
        self.buffers: dict[int, np.ndarray] = {}
        self.problems: list[str] = []
        unknown = sorted(set(self.document.extensionsRequired) - _READ_EXTENSIONS)
        if unknown:
            raise self.error(f"it requires {', '.join(unknown)}, which is not read; export without")
        if not str(self.document.asset.get("version", "")).startswith("2."):
            raise self.error(f"expected glTF 2; its asset says {self.document.asset}")

    def error(self, reason: str) -> SceneError:
        """Return an error that names the file."""
        return SceneError(f"{self.path}: {reason}")

    def read(self) -> SplatFile:
        """Read the Gaussians of all nodes."""
        primitives = list(self.placed_primitives())
        if not primitives:
            raise self.error(f"its scene has no primitive with {EXTENSION}; splats are needed")
        for primitive, _ in primitives:
            self.check_extension(primitive)
        self.check_rows([primitive for primitive, _ in primitives])
        columns_by_primitive: dict[int, _Columns] = {}
        parts = []
        for primitive, matrix in primitives:
            if id(primitive) not in columns_by_primitive:
                columns_by_primitive[id(primitive)] = self.columns(primitive)
            parts.append(_place_columns(columns_by_primitive[id(primitive)], matrix))
        if any(columns.is_log for columns in columns_by_primitive.values()):
            self.problems.append(
                f"{self.path}: negative scales are taken as logarithms, as an earlier draft of "
                f"{EXTENSION} stored all scales"
            )
        return join_positioned_parts(parts, self.path, NOTES, self.problems)

    def check_rows(self, primitives: Sequence[_Primitive]) -> None:
        """Refuse more Gaussians, or copies of them, than the buffers that exist can hold."""
        document = self.document
        accessors = [document.accessors[p.attributes.get("POSITION", 0)] for p in primitives]
        num_gaussians = sum(accessor.count for accessor in accessors)
        views = {a.bufferView for a in accessors if a.bufferView is not None}
        numbers = [_spz_view(primitive) for primitive in primitives]
        spz_views = {number for number in numbers if number is not None}
        views |= spz_views
        buffer_numbers = {document.bufferViews[view].buffer for view in views}
        sizes = {
            document.buffers[n].uri: len(self.buffer(n)) for n in buffer_numbers
        }  # each file once
        max_gaussians = sum(sizes.values()) // _MIN_ROW_BYTES
        if num_gaussians > _MAX_COPIES * max_gaussians:
            raise self.error(
                f"it places {num_gaussians} Gaussians, more than {_MAX_COPIES} times the "
                f"{max_gaussians} that its buffers have room for; place fewer copies"
            )
        num_sh = max(sum(_SH_INFIX in name for name in p.attributes) for p in primitives)
        num_sh = NUM_SH_BY_DEGREE[-1] if spz_views else num_sh
        check_memory(str(self.path), num_gaussians, num_sh=num_sh, file_bytes=sum(sizes.values()))

    def placed_primitives(self) -> Iterator[tuple[_Primitive, np.ndarray]]:
        """Yield primitives of Gaussians with world_from_node, in the order of the scene's nodes."""
        document = self.document
        visited_nodes = set()
        num_other = 0
        if len(document.nodes) > _MAX_NODES:
            raise self.error(f"it has {len(document.nodes)} nodes; at most {_MAX_NODES} are read")
        num_placed = 0
        roots = tuple[int, ...]()
        if document.scenes:
            roots = document.scenes[document.scene].nodes
        else:
            children = {child for node in document.nodes for child in node.children}
            roots = tuple(n for n in range(len(document.nodes)) if n not in children)
        pending_nodes = [(number, np.eye(4)) for number in reversed(roots)]
        while pending_nodes:
            number, world_from_parent = pending_nodes.pop()
            if number in visited_nodes:
                raise self.error(f"node {number} has two parents; nodes must be a tree")
            visited_nodes.add(number)
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
                        num_placed += 1
                        if num_placed > _MAX_PRIMITIVES:
                            raise self.error(
                                f"it places more than {_MAX_PRIMITIVES} primitives of Gaussians; "
                                "join them, or place fewer copies"
                            )
                        yield primitive, matrix
                    else:
                        num_other += 1
            pending_nodes += [(child, matrix) for child in reversed(node.children)]
        if num_other:
            self.problems.append(
                f"{self.path}: left out {num_other} meshes and points, not Gaussians"
            )

    def check_extension(self, primitive: _Primitive) -> None:
        """Refuse splats of other kernels, colours and compressions, by their names."""
        extension = primitive.extensions.KHR_gaussian_splatting
        assert extension is not None
        if extension.extensions and extension.spz_view is None:
            raise self.error(f"{', '.join(extension.extensions)} is not read; export without")
        if extension.kernel not in (None, "ellipse") or extension.colorSpace not in _COLOUR_SPACES:
            raise self.error(
                f"expected the kernel ellipse and colours in srgb_rec709_display; it has "
                f"{extension.kernel} and {extension.colorSpace}"
            )

    def columns(self, primitive: _Primitive) -> _Columns:
        """Read the columns of one primitive."""
        spz_view = _spz_view(primitive)
        if spz_view is not None:
            return self.spz_columns(primitive, spz_view)
        accessors = {
            name.removeprefix(f"{EXTENSION}:"): accessor
            for name, accessor in primitive.attributes.items()
        }
        missing_names = [
            n
            for n in ("POSITION", "ROTATION", "SCALE", "OPACITY", _sh_name(0, 0))
            if n not in accessors
        ]
        if missing_names:
            raise self.error(
                f"a primitive of Gaussians lacks {', '.join(missing_names)}, which the ratified "
                f"{EXTENSION} requires; it has {', '.join(primitive.attributes) or 'nothing'}"
            )
        names = [_sh_name(0, 0)]
        for degree in range(1, len(NUM_SH_BY_DEGREE)):
            band_names = [_sh_name(degree, n) for n in range(2 * degree + 1)]
            if not any(name in accessors for name in band_names):
                break
            names += band_names
        missing_names = [name for name in names if name not in accessors]
        surplus_names = [name for name in accessors if name.startswith("SH_") and name not in names]
        if missing_names or surplus_names:
            raise self.error(
                f"spherical harmonics must be whole bands from 0 to 3: lacking "
                f"{', '.join(missing_names) or 'none'}, beyond {', '.join(surplus_names) or 'none'}"
            )
        count = self.document.accessors[accessors["POSITION"]].count

        def column(name: str, kind: str) -> np.ndarray:
            return self.column(name, accessors[name], kind, count)

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

    def spz_columns(self, primitive: _Primitive, view_number: int) -> _Columns:
        """Read the columns of one primitive from a .spz in a buffer view."""
        view = self.document.bufferViews[view_number]
        data = self.buffer(view.buffer)
        end = view.byteOffset + view.byteLength
        if end > len(data):
            raise self.error(
                f"a .spz takes bytes {view.byteOffset} to {end} of a buffer with {len(data)}: "
                "truncated or damaged"
            )
        packed = data[view.byteOffset : end].tobytes()
        content = read_spz_stream(io.BytesIO(packed), len(packed), f"{self.path}: its .spz")
        gaussians = content.gaussians
        count = self.document.accessors[primitive.attributes.get("POSITION", 0)].count
        if len(gaussians) != count:
            raise self.error(f"its .spz holds {len(gaussians)} Gaussians; POSITION says {count}")
        if content.up != SPZ_UP:
            raise self.error(f"its .spz says that {content.up} is up; {SPZ_UP} is in glTF")
        self.problems += content.problems
        return _Columns(
            means=gaussians.means.numpy(),
            quats=gaussians.quats.numpy(),
            scales=gaussians.scales.numpy(),
            opacities=gaussians.opacities.numpy(),
            sh=gaussians.sh.numpy(),
            is_log=False,
        )

    def column(self, name: str, number: int, kind: str, count: int) -> np.ndarray:
        """Read one column as float32 [N, width]."""
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
        data = self.buffer(view.buffer)
        dtype = np.dtype(_TYPES[accessor.componentType])
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
        """Return the bytes of a buffer."""
        if number not in self.buffers:
            entry = self.document.buffers[number]
            data = self.chunk if entry.uri is None and number == 0 else None
            if entry.uri is not None:
                data = self.by_uri(entry.uri)
            if data is None or len(data) < entry.byteLength:
                num_bytes = "none" if data is None else len(data)
                raise self.error(f"buffer {number} has {entry.byteLength} bytes; found {num_bytes}")
            self.buffers[number] = data[: entry.byteLength]
        return self.buffers[number]

    def by_uri(self, uri: str) -> np.ndarray:
        """Return the bytes that a buffer's URI names."""
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                if not head.endswith(";base64"):
                    raise binascii.Error("its data URI is not base64")
                return np.frombuffer(base64.b64decode(text, validate=True), np.uint8)
            except ValueError as error:  # binascii's, or letters beyond ASCII
                raise self.error(f"a buffer's data cannot be read: {error}") from error
        root = self.path.parent.resolve()
        file = root / unquote(uri)
        if ":" in uri or "\0" in unquote(uri) or not file.resolve().is_relative_to(root):
            raise self.error(f"a buffer must lie in the file's folder; got {uri[:200]!r}")
        if not file.is_file() or not file.stat().st_size:
            raise self.error(f"its buffer {uri[:200]!r} is not there; copy it beside the file")
        return np.memmap(file, np.uint8, "r")


def _spz_view(primitive: _Primitive) -> int | None:
    """Return the buffer view of a primitive's .spz; None if it has none."""
    extension = primitive.extensions.KHR_gaussian_splatting
    return None if extension is None else extension.spz_view


def _sh_name(degree: int, number: int) -> str:
    """Return the name of an SH attribute."""
    return f"SH_DEGREE_{degree}_COEF_{number}"


def _read_chunks(path: Path) -> tuple[bytes, np.ndarray | None]:
    """Return the JSON text, and the binary chunk of a .glb."""
    data = np.memmap(path, np.uint8, "r")
    if bytes(data[:4]) != _GLB_MARK:
        if len(data) > _MAX_JSON_BYTES:
            raise SceneError(
                f"{path}: a .gltf has at most {_MAX_JSON_BYTES} bytes; save it as .glb"
            )
        return data.tobytes(), None
    first_header, second_header = _HEADERS
    if len(data) < first_header.size:
        raise SceneError(f"{path}: its header ends early; it is truncated: copy it again")
    _, version, _, size, kind = first_header.unpack(data[: first_header.size].tobytes())
    end = first_header.size + size
    if version != 2 or kind != _JSON_CHUNK or size > _MAX_JSON_BYTES or end > len(data):
        raise SceneError(
            f"{path}: expected a .glb of version 2 that begins with JSON of at most "
            f"{_MAX_JSON_BYTES} bytes; got version {version}, a chunk {kind:#x} of {size} bytes in "
            f"{len(data)}"
        )
    text = data[first_header.size : end].tobytes()
    chunk = data[end:]
    if len(chunk) < second_header.size:
        return text, None
    size, kind = second_header.unpack(chunk[: second_header.size].tobytes())
    return text, chunk[
        second_header.size : second_header.size + size
    ] if kind == _BINARY_CHUNK else None


def _place_columns(columns: _Columns, matrix: np.ndarray) -> tuple[np.ndarray, Gaussians]:
    """Return positions in the scene, float64, and Gaussians rotated and scaled as there.

    The means of these Gaussians are unused.
    """
    gaussians = Gaussians(
        means=torch.zeros(len(columns.means), 3),
        **{
            name: torch.from_numpy(np.ascontiguousarray(getattr(columns, name), np.float32))
            for name in ("quats", "scales", "opacities", "sh")
        },
    )
    positions = columns.means.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return positions, transform_gaussians(gaussians, torch.from_numpy(matrix[:3, :3].copy()))


# ---- Writing -------------------------------------------------------------------------------------


def write_glb(path: str | Path, gaussians: Gaussians) -> None:
    """Write a .glb of floats with one primitive, atomically.

    Args:
        path: the file.
        gaussians: Gaussians whose y axis points up.
    """
    columns = {
        "POSITION": gaussians.means,
        "ROTATION": torch.nn.functional.normalize(gaussians.quats, dim=1)[:, [1, 2, 3, 0]],
        "SCALE": gaussians.scales,
        "OPACITY": gaussians.opacities[:, None],
    }
    for degree in range(gaussians.sh_degree + 1):
        for number in range(2 * degree + 1):
            columns[_sh_name(degree, number)] = gaussians.sh[:, degree * degree + number]
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
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": _COLOUR_SPACES[1]}},
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
    first_header, second_header = _HEADERS
    total = first_header.size + len(text) + second_header.size + ends[-1]
    if total >= 1 << 32:
        raise SceneError(f"{path}: {total} bytes; a .glb ends at 4 GiB: export as .ply or .spz")
    with write_file_atomically(Path(path)) as file:
        file.write(first_header.pack(_GLB_MARK, 2, total, len(text), _JSON_CHUNK) + text)
        file.write(second_header.pack(ends[-1], _BINARY_CHUNK))
        for array in arrays:
            file.write(array.tobytes())


def describe_gltf(path: Path) -> FileFacts:
    """Return the facts of a glTF file's JSON."""
    document = _File(path).document
    generator = document.asset.get("generator", "")
    names = {
        name
        for mesh in document.meshes
        for primitive in mesh.primitives
        if primitive.extensions.KHR_gaussian_splatting is not None
        for name in primitive.extensions.KHR_gaussian_splatting.extensions
    }
    warnings = []
    if names:
        warnings.append(
            f"splats are stored by {', '.join(sorted(names))}, a draft: viewers of the ratified "
            f"{EXTENSION} show nothing"
        )
    return FileFacts(
        version=f"glTF {document.asset.get('version')}",
        writer=generator[:80] if isinstance(generator, str) else "",
        **NOTES,
        warnings=tuple(warnings),
    )


_AXES = "its unit is the metre, y points up in it; cameras are left out"
GLB = SplatFormat(
    name=".glb",
    describe=describe_gltf,
    reader=read_gltf,
    suffixes=(".glb",),
    first_bytes=(_GLB_MARK,),
    writer=SplatWriter(
        kind="glb",
        suffix=".glb",
        write=lambda path, gaussians, _facts: write_glb(path, rotate_z_to_y(gaussians)),
        world_losses=(
            Loss(_AXES, lambda scene: scene.has_metric_scale),
            Loss(
                f"how long the scene's unit is is not known; {_AXES}",
                lambda scene: not scene.has_metric_scale,
            ),
        ),
    ),
)
GLTF = SplatFormat(name=".gltf", reader=read_gltf, suffixes=(".gltf",), describe=describe_gltf)
