"""Reads and writes scenes in files of our own format: a folder, or a single file to share.

A folder holds

    scene.json              facts, cameras over time, tracks, colour maps (scene_document)
    gaussians.safetensors   background.means, ..., actors.0.means, ... (scene_tensors)
    sky.safetensors         rgb, image or faces

and NAME.climategs is one safetensors file with the arrays of both (the sky's as sky.rgb, ...) and
the metadata `format`, `version` and `document`, the text of scene.json.

Arrays hold activated values, as `Gaussians` does, and are mapped into memory, so that a scene opens
in an instant without a copy. Every number is checked once, since the files may come from anywhere.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    model_serializer,
    model_validator,
)
from torch import Tensor

from augment.detail.lod import store_levels
from augment.errors import OutputError, SceneError
from augment.files.checkpoints import checked_tensor
from augment.files.lens_records import LensRecord, ShutterRecord, lens_record, shutter_record
from augment.files.level_file import LEVELS, read_levels
from augment.files.limits import check_values, validate_model
from augment.files.tensors import read_tensors, write_tensors
from augment.output.atomic import write_file_atomically, write_folder_atomically
from augment.scene.cameras import Camera, Frame
from augment.scene.lenses import FisheyeLens, FThetaLens, OpenCVLens
from augment.scene.scene import (
    NUM_SH_BY_DEGREE,
    Actor,
    ColorSeries,
    Gaussians,
    Ground,
    GroundSource,
    Scene,
    Track,
    check_gaussians,
    drawable_rows,
    is_drawable,
)
from augment.scene.semantics import SemanticClass
from augment.scene.shutter import RollingShutter
from augment.scene.sky import ConstantSky, CubemapSky, LatLongSky, Sky
from recipes.files import open_file

# ---- The arrays of a saved scene: names, shapes, and the check that every number can be rendered -
#
#     background.means [n, 3], quats [n, 4], scales [n, 3], opacities [n], sh [n, K, 3]: float32
#     background.semantic [n]: int16, where classes are known
#     actors.0.means ...: the same of each actor; actors.0.waves [n, F - 1, 3] of its colour waves
#     rgb [3], image [H, W, 3] or faces [6, R, R, 3]: the sky, float32
#
# At precision float16, quats, opacities, sh, waves and the sky are float16.

# The name in scene.json of each class of sky.
SKY_KINDS: dict[type, str] = {ConstantSky: "constant", LatLongSky: "latlong", CubemapSky: "cubemap"}
MAX_WAVES = 1000  # terms of colour waves: they are summed for every image
_SKY_ARRAYS = {"constant": "rgb", "latlong": "image", "cubemap": "faces"}  # the array of each sky
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")  # arrays of Gaussians
_HALF_ARRAYS = ("quats", "opacities", "sh", "waves")  # arrays that float16 files store as float16
_ROW_SHAPES = {  # shape of a row of each array; None stands for any length
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (),
    "sh": (None, 3),
    "waves": (None, 3),
    "rgb": (),
    "image": (None, 3),
    "faces": (None, None, 3),
}
_MIN_FLOAT16_OVERFLOW = 65520  # the smallest number that float16 rounds to infinity


class SavedPart(NamedTuple):
    """The arrays of the background or of one actor."""

    gaussians: Gaussians
    waves: Tensor | None = None  # coefficients [n, F - 1, 3] of the colour waves, if it has any


def part_arrays(scene: Scene, precision: Precision) -> dict[str, np.ndarray]:
    """Return the arrays of the scene's Gaussians.

    Raises:
        SceneError: the files cannot hold them.
    """
    arrays = {}
    waves = [None, *(actor.color_waves for actor in scene.actors)]
    for number, gaussians in enumerate(scene.all_gaussians):
        part_name = _part_name(number)
        tensors = {name: getattr(gaussians, name) for name in _ARRAYS}
        if (color_waves := waves[number]) is not None:
            tensors["waves"] = color_waves.coefficients
            if color_waves.coefficients.shape[1] > MAX_WAVES:
                raise SceneError(
                    f"scene {scene.name!r}: {part_name} has colour waves of "
                    f"{color_waves.coefficients.shape[1]} terms; saved scenes hold {MAX_WAVES}"
                )
        for name, values in tensors.items():
            where = f"scene {scene.name!r}: {part_name}.{name}"
            if values.dtype != torch.float32:
                raise SceneError(f"{where}: saved scenes hold float32; got {values.dtype}")
            is_halved = precision == "float16" and name in _HALF_ARRAYS
            arrays[f"{part_name}.{name}"] = _array(_half(values, where) if is_halved else values)
        if gaussians.semantic is not None:
            arrays[f"{part_name}.semantic"] = _array(gaussians.semantic)
    return arrays


def sky_arrays(scene: Scene, precision: Precision) -> dict[str, np.ndarray]:
    """Return the one array of the scene's sky, whose class is among SKY_KINDS."""
    name = _SKY_ARRAYS[SKY_KINDS[type(scene.sky)]]
    values = getattr(scene.sky, name)
    is_halved = precision == "float16"
    return {name: _array(_half(values, f"scene {scene.name!r}: sky") if is_halved else values)}


def take_parts(
    tensors: dict[str, Tensor],
    document: SceneDocument,
    where: str,
    *,
    skips_background_check: bool = False,
) -> tuple[list[SavedPart], list[str]]:
    """Remove the arrays of background and actors from `tensors` and check them.

    Args:
        tensors: the arrays of the file.
        document: the scene's document.
        where: the file, for messages.
        skips_background_check: if True, the background's numbers are not checked yet.

    Returns:
        The parts, and one sentence about each thing that was left out.
    """
    counts = [document.background_gaussians, *(actor.gaussians for actor in document.actors)]
    has_waves = [False, *(actor.color_waves is not None for actor in document.actors)]
    parts = []
    problems = []
    for number, count in enumerate(counts):
        name = _part_name(number)
        is_read = number > 0 or not skips_background_check
        part = _take_part(
            tensors, name, count, document.precision, has_waves[number], where, is_read=is_read
        )
        if not is_read:
            parts.append(part)
            continue
        waves = part.waves  # one look at each number tells whether all of them are valid
        has_finite_waves = waves is None or bool(np.isfinite(_range(waves)).all())
        if not (has_finite_waves and is_drawable(part.gaussians)):
            part, part_problems = _drawable(part, f"{where}, {name}")
            problems += part_problems
        parts.append(part)
    if tensors:
        raise SceneError(
            f"{where} holds arrays that its document does not know: {sorted(tensors)[:5]}"
        )
    return parts, problems


def take_sky(tensors: dict[str, Tensor], kind: str, precision: Precision, where: str) -> Sky:
    """Return the sky that its one array describes."""
    sky_class = next(cls for cls, name in SKY_KINDS.items() if name == kind)
    name = _SKY_ARRAYS[kind]
    if list(tensors) != [name]:
        raise SceneError(f"{where}: a {kind} sky is one array {name!r}; got {sorted(tensors)[:5]}")
    count = {"rgb": 3, "image": None, "faces": 6}[name]
    values = _take_array(tensors, name, name, count, precision, where)
    if values.numel() == 0 or (name == "faces" and values.shape[1] != values.shape[2]):
        raise SceneError(
            f"{where}: {name} must not be empty, and faces square; got {list(values.shape)}"
        )
    if not np.isfinite(_range(values)).all():
        raise SceneError(f"{where}: {name} holds NaN or infinite values")
    return sky_class(values)


def _part_name(number: int) -> str:
    """Return the prefix of a part's arrays: part 0 is the background."""
    return "background" if number == 0 else f"actors.{number - 1}"


def _array(values: Tensor) -> np.ndarray:
    """Return a tensor as a contiguous array."""
    return np.ascontiguousarray(values.detach().cpu().numpy())


def _half(values: Tensor, where: str) -> Tensor:
    """Return float16 values.

    Raises:
        SceneError: a value is too large for float16.
    """
    low, high = _range(values)
    if not max(-low, high) < _MIN_FLOAT16_OVERFLOW:
        raise SceneError(
            f"{where}: float16 holds numbers up to 65504; got {low} to {high}. Write it at full "
            f"precision"
        )
    return values.half()


def _take_part(
    tensors: dict[str, Tensor],
    part: str,
    count: int,
    precision: Precision,
    has_waves: bool,
    where: str,
    *,
    is_read: bool = True,
) -> SavedPart:
    """Remove the arrays of one part from `tensors`; check shapes, types and classes."""
    columns = {
        name: _take_array(tensors, f"{part}.{name}", name, count, precision, where)
        for name in (*_ARRAYS, *(["waves"] if has_waves else []))
    }
    if columns["sh"].shape[1] not in NUM_SH_BY_DEGREE:
        shape = list(columns["sh"].shape)
        raise SceneError(
            f"{where}: {part}.sh must be [N, K, 3] with K in {NUM_SH_BY_DEGREE}; got {shape}"
        )
    waves = columns.pop("waves", None)
    if waves is not None and waves.shape[1] > MAX_WAVES:
        raise SceneError(
            f"{where}: {part}.waves must have at most {MAX_WAVES} terms; got {waves.shape[1]}"
        )
    if precision == "float16":
        columns["quats"] = torch.nn.functional.normalize(columns["quats"], dim=1)
    semantic = None
    name = f"{part}.semantic"
    if name in tensors:
        semantic = checked_tensor(
            tensors, name, (count,), where, dtype=torch.int16, error=SceneError
        )
        del tensors[name]
        low, high = _range(semantic) if is_read else (0, 0)
        if low < min(SemanticClass) or high > max(SemanticClass):
            raise SceneError(
                f"{where}: {name} must hold classes from {min(SemanticClass):d} to "
                f"{max(SemanticClass):d}; got {low:.0f} to {high:.0f}"
            )
    return SavedPart(Gaussians(**columns, semantic=semantic), waves)


def _take_array(
    tensors: dict[str, Tensor],
    name: str,
    kind: str,
    count: int | None,
    precision: Precision,
    where: str,
) -> Tensor:
    """Remove an array of `count` rows from `tensors` and check it.

    Args:
        kind: the array's name in _ROW_SHAPES.
    """
    is_halved = precision == "float16" and (kind in _HALF_ARRAYS or kind in _SKY_ARRAYS.values())
    dtype = torch.float16 if is_halved else torch.float32
    values = checked_tensor(
        tensors, name, (count, *_ROW_SHAPES[kind]), where, dtype=dtype, error=SceneError
    )
    del tensors[name]
    return values.float() if is_halved else values


def _drawable(part: SavedPart, where: str) -> tuple[SavedPart, tuple[str, ...]]:
    """Leave out Gaussians that cannot be rendered, as check_gaussians; waves follow them."""
    gaussians = part.gaussians
    waves = part.waves
    if waves is None:
        gaussians, problems = check_gaussians(gaussians, where=where)
        return SavedPart(gaussians), problems
    is_finite = torch.isfinite(waves.sum((1, 2)))
    nan_offsets = torch.where(
        is_finite, 0.0, torch.nan
    )  # check_gaussians leaves out means that are NaN
    gaussians = replace(gaussians, means=gaussians.means + nan_offsets[:, None])
    drawable = drawable_rows(gaussians)
    gaussians, problems = check_gaussians(gaussians, where=where)
    return SavedPart(gaussians, waves[drawable]), problems


def _range(values: Tensor) -> tuple[float, float]:
    """Return the lowest and the highest value; NaN if a value is NaN. NumPy starts no threads."""
    array = values.detach().cpu().numpy()
    if array.size == 0:
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        return float(array.min()), float(array.max())


# ---- scene.json ----------------------------------------------------------------------------------

FORMAT = "climategs-scene"  # the format that a scene.json names
VERSION = 2  # the version that is read and written
MAX_BYTES = 256 << 20  # bytes of a scene.json; a drive of an hour has about 30 MB
_MAX_KEYS = 10_000  # keys of one object, such as a frame's cameras
# Largest error of R R^T - I in a pose; the camera's own class allows 1e-4.
_ROTATION_TOLERANCE = 1e-3


def _plain_text(text: str) -> str:
    """Check that a text can be printed and, if it is a path, opened."""
    if "\0" in text:
        raise ValueError("text must not hold a NUL character")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError("text must not hold unpaired surrogates") from None
    return text


def _as_list(value: object) -> object:
    """Return an array as a list."""
    return value.tolist() if isinstance(value, Tensor | np.ndarray) else value


def _pose_as_list(value: object) -> object:
    """Return a float64 pose as a list."""
    if isinstance(value, Tensor) and value.dtype != torch.float64:
        raise ValueError(f"poses must be float64; got {value.dtype}")
    return _as_list(value)


def _lens_as_record(value: object) -> object:
    """Return a lens as its JSON object."""
    is_lens = isinstance(value, OpenCVLens | FisheyeLens | FThetaLens)
    return lens_record(value) if is_lens else value


def _shutter_as_record(value: object) -> object:
    """Return a shutter as its JSON object."""
    return shutter_record(value) if isinstance(value, RollingShutter) else value


def _check_rigid(rows: list) -> list:
    """Check that poses [4, 4] or [N, 4, 4] are rotations and translations."""
    poses = np.array(rows, np.float64).reshape(-1, 4, 4)
    rotation = poses[:, :3, :3]
    with np.errstate(all="ignore"):  # products of very large numbers overflow
        error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3))
        determinant = np.linalg.det(rotation)
    is_rotation = (error < _ROTATION_TOLERANCE).all() and (determinant > 0).all()
    if not (is_rotation and (poses[:, 3, :] == np.eye(4)[3]).all()):
        raise ValueError("a pose must be a rotation and a translation, 0 0 0 1 in its last row")
    return rows


Precision = Literal["float32", "float16"]
Text = Annotated[str, AfterValidator(_plain_text)]
Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]
# Checks of a list stop at its first wrong item: each of millions of errors would cost a kilobyte.
Times = Annotated[list[Int64], Field(fail_fast=True), BeforeValidator(_as_list)]
Count = Annotated[int, Field(ge=0, lt=2**31)]
Phase = Annotated[float, Field(ge=-1e9, le=1e9)]  # radians, small enough for an exact sine
Pixels = Annotated[int, Field(ge=1, le=100_000)]
Row3 = Annotated[list[float], Field(min_length=3, max_length=3), BeforeValidator(_as_list)]
Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix3x4 = Annotated[list[Row4], Field(min_length=3, max_length=3), BeforeValidator(_as_list)]
_Matrix4x4 = Annotated[list[Row4], Field(min_length=4, max_length=4)]
_POSE = BeforeValidator(_pose_as_list), AfterValidator(_check_rigid)
Pose = Annotated[_Matrix4x4, *_POSE]
Poses = Annotated[list[_Matrix4x4], Field(fail_fast=True), *_POSE]


def _check_num_keys(value: object) -> object:
    """Refuse an object with too many keys before each is checked."""
    if isinstance(value, Mapping) and len(value) > _MAX_KEYS:
        raise ValueError(f"it has {len(value)} keys; at most {_MAX_KEYS} are read")
    return value


class _Closed(BaseModel):
    """Base of the document's objects; made from JSON, or from the record that it describes."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, from_attributes=True
    )

    @model_validator(mode="before")
    @classmethod
    def _has_few_keys(cls, value: object) -> object:
        return _check_num_keys(value)


class CameraEntry(_Closed):
    """A camera of a frame. Its name is its key in FrameEntry.cameras."""

    width: Pixels
    height: Pixels
    fx: float
    fy: float
    cx: float
    cy: float
    timestamp_ns: Int64
    camera_from_world: Pose
    is_orthographic: bool = False
    lens: Annotated[LensRecord | None, BeforeValidator(_lens_as_record)] = None
    shutter: Annotated[ShutterRecord | None, BeforeValidator(_shutter_as_record)] = None

    @model_serializer(mode="wrap")
    def _omit_defaults(self, serialize: Callable[..., dict[str, Any]]) -> dict[str, Any]:
        entry = serialize(self)
        for name in ("is_orthographic", "lens", "shutter"):  # so that older versions still read it
            if not entry[name]:
                del entry[name]
        if self.lens is not None:
            entry["lens"] = lens_record(self.lens.lens())
        return entry


class FrameEntry(_Closed):
    """A frame of the drive."""

    index: Int64
    timestamp_ns: Int64
    world_from_ego: Pose
    cameras: Annotated[dict[Text, CameraEntry], BeforeValidator(_check_num_keys)]
    # Absolute paths, by camera.
    image_paths: Annotated[dict[Text, Text], BeforeValidator(_check_num_keys)]


class TrackEntry(_Closed):
    """The poses of an actor over time."""

    hold_ns: Int64
    max_gap_ns: Int64 | None
    timestamps_ns: Times
    world_from_actor: Poses


class WavesEntry(_Closed):
    """The times of an actor's colour waves; their coefficients are its array `waves`."""

    timestamps_ns: Times
    phases: Annotated[list[Phase], Field(fail_fast=True), BeforeValidator(_as_list)]

    @model_validator(mode="after")
    def _check_lengths(self) -> WavesEntry:
        if len(self.timestamps_ns) != len(self.phases):
            raise ValueError("there must be as many phases as timestamps")
        return self


class ActorEntry(_Closed):
    """An actor."""

    track_id: Text
    label: Text
    size_m: Annotated[Row3, BeforeValidator(lambda v: list(v) if type(v) is tuple else v)]
    # The number of rows of its arrays.
    gaussians: Annotated[
        Count, BeforeValidator(lambda v: len(v) if isinstance(v, Gaussians) else v)
    ]
    track: TrackEntry
    color_waves: WavesEntry | None
    colors_in_world: bool


class ImageColorMapEntry(_Closed):
    """A colour map of a single image, which its camera and its time identify."""

    camera: Text
    timestamp_ns: Int64
    rows: Matrix3x4


class GroundEntry(_Closed):
    """The fields of the record augment.scene.ground.Ground."""

    lowest_z_m: float
    median_z_m: float
    source: GroundSource
    residual_m: float | None
    points: Count
    tilt_deg: float | None


class SceneDocument(_Closed):
    """The content of scene.json."""

    format: Literal["climategs-scene"]
    version: Literal[2]
    precision: Precision  # the type that quaternions, opacities and colours are stored as
    name: Text
    recorded_source: Text
    working_folder: Text  # the folder that relative paths in recorded_source start from
    world_origin_m: Row3
    ground_z_m: float | None
    has_metric_scale: bool
    ground: GroundEntry | None
    has_known_gravity: bool
    sky: Literal["constant", "latlong", "cubemap"]
    background_gaussians: Count
    color_maps: Annotated[dict[Text, Matrix3x4], BeforeValidator(_check_num_keys)]
    image_color_maps: Annotated[list[ImageColorMapEntry], Field(fail_fast=True)]
    made_by: dict[str, Any]
    problems: Annotated[list[Text], Field(fail_fast=True)]
    actors: Annotated[list[ActorEntry], Field(fail_fast=True)]
    frames: Annotated[list[FrameEntry], Field(fail_fast=True)]
    seen_frames: Annotated[list[FrameEntry], Field(fail_fast=True)] | None = None

    @model_serializer(mode="wrap")
    def _omit_defaults(self, serialize: Callable[..., dict[str, Any]]) -> dict[str, Any]:
        document = serialize(self)
        if self.seen_frames is None:  # so that older versions still read it
            del document["seen_frames"]
        return document


def read_document(path: Path) -> SceneDocument:
    """Read and check a scene.json."""
    try:
        with open_file(path) as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from error
    if len(text) > MAX_BYTES:
        raise SceneError(f"{path}: a scene.json has at most {MAX_BYTES} bytes")
    return parse_document(text, str(path))


def parse_document(text: bytes | str, where: str) -> SceneDocument:
    """Check a scene's JSON text and return its content."""
    try:
        data = text if isinstance(text, bytes) else text.encode()
        check_values(data, where)
        raw = json.loads(data.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # also what is no UTF-8
        raise SceneError(f"{where} is no JSON: {error or 'nested too deeply'}") from None
    if not isinstance(raw, dict):
        raise SceneError(f"{where} describes no scene: expected an object; got {raw!r:.80}")
    check_format(raw.get("format"), raw.get("version"), where)
    return validate_model(SceneDocument, raw, where)


def check_format(format_name: object, version: object, where: str) -> None:
    """Check that a file is a scene, and of the version that is read."""
    if format_name != FORMAT:
        raise SceneError(
            f'{where} describes no scene: its "format" must be {FORMAT!r}; got {format_name!r:.80}'
        )
    if version != VERSION:
        raise SceneError(
            f"{where}: this ClimateGS reads scenes of version {VERSION}; got {version!r:.80}. A "
            f"newer one is read by a newer ClimateGS"
        )


def _no_constant(name: str) -> float:
    """Refuse NaN and Infinity, which Python's reader would accept."""
    raise ValueError(f"{name} is no number of JSON")


# ---- scene.json: everything of a saved scene but its arrays, in numbers that read back to the bit

# Lists that are written with one item a line.
_LISTS = ("actors", "frames", "seen_frames", "problems", "image_color_maps")


def scene_document(scene: Scene, precision: Precision = "float32") -> dict[str, Any]:
    """Return the content of scene.json.

    Where precision is not float32, made_by records it permanently.
    """
    if scene.moved_instances:
        raise SceneError(
            f"scene {scene.name!r} has moved actors, and a scene file keeps where they were "
            f"recorded; save it without tracks, and name the file of tracks when it is opened"
        )
    kind = SKY_KINDS.get(type(scene.sky))
    if kind is None:
        raise SceneError(
            f"scene {scene.name!r}: a sky of class {type(scene.sky).__name__} cannot be saved; "
            f"only {', '.join(t.__name__ for t in SKY_KINDS)} can"
        )
    for frame in scene.frames:
        if wrong_names := [name for name, camera in frame.cameras.items() if camera.name != name]:
            raise SceneError(
                f"frame {frame.index}: cameras must stand under their own names; {wrong_names} do "
                "not"
            )
    made_by = _json_facts(scene) | ({} if precision == "float32" else {"precision": precision})
    content = {
        "format": FORMAT,
        "version": VERSION,
        "precision": precision,
        "name": scene.name,
        "recorded_source": scene.recorded_source or scene.source,
        "working_folder": os.getcwd(),
        "world_origin_m": np.asarray(scene.world_origin_m, np.float64),
        "ground_z_m": None if scene.ground_z_m is None else float(scene.ground_z_m),
        "has_metric_scale": bool(scene.has_metric_scale),
        "ground": scene.ground,
        "has_known_gravity": bool(scene.has_known_gravity),
        "sky": kind,
        "background_gaussians": len(scene.background),
        "color_maps": dict(scene.color_maps),
        "image_color_maps": [
            {"camera": name, "timestamp_ns": int(timestamp_ns), "rows": matrix}
            for (name, timestamp_ns), matrix in scene.image_color_maps.items()
        ],
        "made_by": made_by,
        "problems": list(scene.problems),
        "actors": list(scene.actors),
        "frames": _stored_frames(scene.frames),
        "seen_frames": None if scene.seen_frames is None else _stored_frames(scene.seen_frames),
    }
    return validate_model(SceneDocument, content, f"scene {scene.name!r}").model_dump()


def _stored_frames(frames: Sequence[Frame]) -> list[Frame]:
    """Return frames with plain dictionaries and absolute paths."""
    return [
        replace(
            frame,
            cameras=dict(frame.cameras),
            image_paths={n: os.path.abspath(path) for n, path in frame.image_paths.items()},
        )
        for frame in frames
    ]


def document_text(document: dict[str, Any]) -> str:
    """Return JSON, one key a line and one actor, frame, problem or image's colour map a line."""

    def text(value: Any) -> str:
        return json.dumps(value, ensure_ascii=False, allow_nan=False)

    lines = []
    for key, value in document.items():
        if key in _LISTS and value:
            rows = ",\n".join(f"  {text(item)}" for item in value)
            lines.append(f"{text(key)}: [\n{rows}\n]")
        else:
            lines.append(f"{text(key)}: {text(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def scene_of(
    document: SceneDocument, parts: list[SavedPart], sky: Sky, *, source: str, where: str
) -> Scene:
    """Build the scene of a document. It has no labels.

    Args:
        document: the content of scene.json.
        parts: the background first, then the actors.
        sky: the sky.
        source: the scene's URI.
        where: the file, for messages.
    """
    try:
        actors = tuple(
            _actor(entry, part) for entry, part in zip(document.actors, parts[1:], strict=True)
        )
        frames = tuple(_frame(entry) for entry in document.frames)
        seen_entries = document.seen_frames
        seen_frames = (
            None if seen_entries is None else tuple(_frame(entry) for entry in seen_entries)
        )
        num_repeated = len(frames) - len({frame.index for frame in frames})
        if num_repeated:
            raise ValueError(f"{num_repeated} frame numbers are given twice")
        image_color_maps = {
            (entry.camera, entry.timestamp_ns): torch.tensor(entry.rows, dtype=torch.float32)
            for entry in document.image_color_maps
        }
        num_repeated = len(document.image_color_maps) - len(image_color_maps)
        if num_repeated:
            raise ValueError(f"{num_repeated} images' colour maps are given twice")
        shared_fields = (
            "name",
            "ground_z_m",
            "has_metric_scale",
            "has_known_gravity",
            "recorded_source",
            "made_by",
        )
        return Scene(
            source=source,
            background=parts[0].gaussians,
            actors=actors,
            sky=sky,
            frames=frames,
            seen_frames=seen_frames,
            world_origin_m=np.array(document.world_origin_m, np.float64),
            ground=None if document.ground is None else Ground(**document.ground.model_dump()),
            problems=tuple(document.problems),
            color_maps={
                name: torch.tensor(rows, dtype=torch.float32)
                for name, rows in document.color_maps.items()
            },
            image_color_maps=image_color_maps,
            **{name: getattr(document, name) for name in shared_fields},
        )
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from error


def track_entry(track: Track, where: str) -> dict[str, Any]:
    """Return a track as JSON stores it."""
    return validate_model(TrackEntry, track, where).model_dump()


def _actor(entry: ActorEntry, part: SavedPart) -> Actor:
    """Build an actor."""

    def times(entry: TrackEntry | WavesEntry) -> Tensor:
        return torch.tensor(entry.timestamps_ns, dtype=torch.int64)

    poses = torch.tensor(entry.track.world_from_actor, dtype=torch.float64).reshape(-1, 4, 4)
    length, width, height = entry.size_m
    try:
        track = Track(times(entry.track), poses, entry.track.hold_ns, entry.track.max_gap_ns)
        waves = None
        if entry.color_waves is not None:
            assert part.waves is not None
            phases = torch.tensor(entry.color_waves.phases, dtype=torch.float64)
            waves = ColorSeries(part.waves, times(entry.color_waves), phases)
    except ValueError as error:
        raise ValueError(f"actor {entry.track_id!r}: {error}") from error
    size_m = (length, width, height)
    return Actor(
        entry.track_id, entry.label, part.gaussians, track, size_m, waves, entry.colors_in_world
    )


def _frame(entry: FrameEntry) -> Frame:
    """Build a frame."""

    def pose(rows: list) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64)

    cameras = {}
    for name, camera in entry.cameras.items():
        numbers = {field: getattr(camera, field) for field in CameraEntry.model_fields}
        numbers["camera_from_world"] = pose(camera.camera_from_world)
        numbers["lens"] = None if camera.lens is None else camera.lens.lens()
        numbers["shutter"] = None if camera.shutter is None else camera.shutter.shutter()
        cameras[name] = Camera(name=name, **numbers)
    world_from_ego = pose(entry.world_from_ego)
    return Frame(entry.index, entry.timestamp_ns, world_from_ego, cameras, entry.image_paths)


def _json_facts(scene: Scene) -> dict[str, Any]:
    """Return made_by as plain JSON types."""
    try:
        text = json.dumps(dict(scene.made_by), allow_nan=False, ensure_ascii=False)
        return json.loads(text.encode())  # unpaired surrogates cannot be written
    except (TypeError, ValueError) as error:
        raise SceneError(
            f"scene {scene.name!r}: made_by must hold JSON's own types and finite numbers: {error}"
        ) from error


# ---- Folders and single files --------------------------------------------------------------------

DOCUMENT = "scene.json"  # everything but the arrays
GAUSSIANS = "gaussians.safetensors"  # the arrays of background and actors
SKY = "sky.safetensors"  # the array of the sky
FILES = (DOCUMENT, GAUSSIANS, SKY)  # the files that a scene folder must have
SCENE_SUFFIX = ".climategs"  # the end of a scene file's name
_SKY_PREFIX = "sky."  # start of the names of the sky's arrays in a scene file
_FORMAT_PATTERN = re.compile(rb'\s*\{\s*"format"\s*:\s*"' + FORMAT.encode() + rb'"')


def is_scene_folder(folder: Path) -> bool:
    """Return True if a folder's scene.json names the format; it may still be damaged."""
    try:
        with open_file(folder / DOCUMENT) as file:
            return _FORMAT_PATTERN.match(file.read(200)) is not None
    except OSError:
        return False


def is_scene_file(path: Path) -> bool:
    """Return True if a file's name ends as that of a scene file; it may still be damaged."""
    return path.suffix.lower() == SCENE_SUFFIX


def save_scene(
    scene: Scene,
    folder: str | Path,
    *,
    levels: Mapping[str, np.ndarray] | None = None,
    finest_m: float = 0.0,
) -> None:
    """Write a scene folder, completely or not at all.

    `load_scene_parts` reads back an equal scene, to the bit, except for the labels, which stay with
    the recording. An existing scene folder is replaced in one step; other files in it are kept.

    Args:
        scene: the scene.
        folder: the folder.
        levels: arrays of `augment.files.level_file`, which writes large scenes.
        finest_m: their size of the finest squares, metres.

    Raises:
        SceneError: the files cannot hold a part of the scene (a sky of another class, Gaussians
            that
            are not float32).
        OutputError: the folder holds something else than a scene, or the system refused (disk full,
            no permission ...); the earlier content is then unchanged.
    """
    folder = Path(folder)
    document = scene_document(scene)
    arrays = {GAUSSIANS: part_arrays(scene, "float32"), SKY: sky_arrays(scene, "float32")}
    if folder.is_dir() and any(folder.iterdir()) and not is_scene_folder(folder):
        raise OutputError(
            f"{folder} holds other files and no scene, so it is not replaced; choose another folder"
        )
    facts: dict[str, dict[str, str] | None] = dict.fromkeys(arrays)
    if levels is not None:
        arrays[LEVELS] = dict(levels)
        facts[LEVELS] = {"finest_m": repr(finest_m)}
    with write_folder_atomically(folder, (*FILES, LEVELS)) as new:
        (new / DOCUMENT).write_text(document_text(document), encoding="utf-8")
        for name, tensors in arrays.items():
            with (new / name).open("wb") as file:
                write_tensors(file, tensors, facts[name])


def save_scene_file(scene: Scene, path: str | Path, *, half: bool = False) -> None:
    """Write a scene into one file named *.climategs, completely or not at all.

    An existing file is replaced. `load_scene_parts` reads back an equal scene, to the bit, except
    for the labels.

    With `half`, quaternions, opacities, colours, their waves and the sky are stored as float16, for
    about half the size (55 % at SH degree 3); made_by records it permanently. Measured: colours
    move
    by up to 0.09/255 at degree 3 and 0.04/255 at degree 0 (of colours from 0 to 1), rotations by up
    to 0.05 degrees, opacities by up to 0.00024; 99.9 % of a street's pixels by less than 0.1/255.

    Args:
        scene: the scene.
        path: the file.
        half: whether to store float16.

    Raises:
        SceneError: the file cannot hold a part of the scene: as for save_scene, text beyond 100 MB,
            or, with half, numbers beyond 65504.
        OutputError: the file has another name, or the system refused; the earlier content is then
            unchanged.
    """
    path = Path(path)
    if not is_scene_file(path):
        raise OutputError(f"{path}: a scene file must be named *{SCENE_SUFFIX}")
    precision = "float16" if half else "float32"
    document = document_text(scene_document(scene, precision))
    sky = {_SKY_PREFIX + name: array for name, array in sky_arrays(scene, precision).items()}
    metadata = {"format": FORMAT, "version": str(VERSION), "document": document}
    arrays = part_arrays(scene, precision) | sky
    with write_file_atomically(path) as file:
        write_tensors(file, arrays, metadata)


@dataclass(frozen=True, eq=False)
class SavedScene:
    """The content of a scene folder or file."""

    scene: Scene  # without labels
    working_folder: Path  # the folder that relative paths in scene.recorded_source start from


def load_scene_parts(path: str | Path) -> Scene:
    """Return the scene of `read_saved_scene` without its working folder."""
    return read_saved_scene(path).scene


def read_saved_scene(path: str | Path) -> SavedScene:
    """Open a scene folder or a scene file.

    Its arrays are mapped: writes to them stay in memory. Gaussians that cannot be rendered are left
    out, each group with a sentence in `problems`.

    Raises:
        SceneError: a file is missing, damaged, of another version or format, or the files do not
            belong together.
    """
    path = Path(path)
    opened = _open_file(path) if path.is_file() else _open_folder(path)
    document = opened.document
    (in_document, in_parts, in_sky) = opened.sources
    levels = path / LEVELS
    is_large = levels.is_file()
    parts, problems = take_parts(opened.parts, document, in_parts, skips_background_check=is_large)
    if problems:
        all_problems = [*document.problems, *problems]
        document = document.model_copy(update={"problems": all_problems})
    sky = take_sky(opened.sky, document.sky, document.precision, in_sky)
    scene = scene_of(document, parts, sky, source=f"scene:{path}", where=in_document)
    if is_large:
        store_levels(scene.background, read_levels(levels, scene.background))
    return SavedScene(scene, Path(document.working_folder))


class _Opened(NamedTuple):
    """An opened folder or file whose arrays are not checked yet."""

    document: SceneDocument
    parts: dict[str, Tensor]  # arrays of background and actors
    sky: dict[str, Tensor]  # the array of the sky
    sources: tuple[str, str, str]  # the files of document, parts and sky, for messages


def _open_folder(folder: Path) -> _Opened:
    """Open the files of a scene folder."""
    for name in FILES:
        if not (folder / name).is_file():
            raise SceneError(f"{folder} is no scene folder: it has no {name}")
    paths = [folder / name for name in FILES]
    document = read_document(paths[0])
    parts, sky = (read_tensors(path)[0] for path in paths[1:])
    return _Opened(document, parts, sky, (str(paths[0]), str(paths[1]), str(paths[2])))


def _open_file(path: Path) -> _Opened:
    """Open a scene file."""
    tensors, metadata = read_tensors(path)
    version = metadata.get("version", "none")
    stated_version = VERSION if version == str(VERSION) else version
    check_format(metadata.get("format"), stated_version, str(path))
    if "document" not in metadata:
        raise SceneError(f"{path} is damaged: its metadata has no 'document'")
    document = parse_document(metadata["document"], f"{path}, document")
    sky = {
        name.removeprefix(_SKY_PREFIX): tensors.pop(name)
        for name in list(tensors)
        if name.startswith(_SKY_PREFIX)
    }
    return _Opened(document, tensors, sky, (str(path), str(path), str(path)))
