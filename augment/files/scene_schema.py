"""What a scene.json may hold, and reading one that may come from anywhere.

The models are closed: an unknown key is an error, since it would be lost without a word.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from torch import Tensor

from augment.errors import SceneError
from augment.ground_heights import GroundSource
from augment.scene import (
    SH_COUNTS,
    Gaussians,
    Scene,
    SemanticClass,
    check_gaussians,
    drawable_rows,
    is_drawable,
)
from augment.sky import ConstantSky, CubemapSky, LatLongSky, Sky
from recipes.files import open_file

# ---- The arrays of a saved scene: their names, their shapes, and that every number can be drawn --
#
#     background.means [n, 3], quats [n, 4], scales [n, 3], opacities [n], sh [n, K, 3]: float32
#     background.semantic [n]: int16, where classes are known
#     actors.0.means ...: the same of each actor; actors.0.waves [n, F - 1, 3] of its colour waves
#     rgb [3], image [H, W, 3] or faces [6, R, R, 3]: the sky, float32
#
# At precision float16, quats, opacities, sh, waves and the sky are float16.

SKY_KINDS: dict[type, str] = {ConstantSky: "constant", LatLongSky: "latlong", CubemapSky: "cubemap"}
MAX_WAVES = 1000  # terms; what is summed for every image must not take for ever
_SKY_ARRAYS = {"constant": "rgb", "latlong": "image", "cubemap": "faces"}
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")
_HALVED = ("quats", "opacities", "sh", "waves")
_ROWS = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
_FLOAT16_END = 65520  # rounds to infinity


@dataclass(frozen=True, eq=False)
class SavedPart:
    """Gaussians, and the coefficients [n, F - 1, 3] of their colour waves where they have some."""

    gaussians: Gaussians
    waves: Tensor | None = None


def part_arrays(scene: Scene, precision: Precision) -> dict[str, np.ndarray]:
    """The arrays of the scene's Gaussians."""
    arrays = {}
    waves = [None, *(actor.color_waves for actor in scene.actors)]
    for number, gaussians in enumerate(scene.all_gaussians):
        part = _part_name(number)
        tensors = {name: getattr(gaussians, name) for name in _ARRAYS}
        if (colours := waves[number]) is not None:
            tensors["waves"] = colours.coefficients
            if colours.coefficients.shape[1] > MAX_WAVES:
                raise SceneError(
                    f"scene {scene.name!r}: {part} has colour waves of "
                    f"{colours.coefficients.shape[1]} terms; saved scenes hold {MAX_WAVES}"
                )
        for name, tensor in tensors.items():
            where = f"scene {scene.name!r}: {part}.{name}"
            if tensor.dtype != torch.float32:
                raise SceneError(f"{where}: saved scenes hold float32; got {tensor.dtype}")
            is_halved = precision == "float16" and name in _HALVED
            arrays[f"{part}.{name}"] = _array(_half(tensor, where) if is_halved else tensor)
        if gaussians.semantic is not None:
            arrays[f"{part}.semantic"] = _array(gaussians.semantic)
    return arrays


def sky_arrays(scene: Scene, precision: Precision) -> dict[str, np.ndarray]:
    """The one array of the scene's sky, whose class is among SKY_KINDS."""
    name = _SKY_ARRAYS[SKY_KINDS[type(scene.sky)]]
    values = getattr(scene.sky, name)
    is_halved = precision == "float16"
    return {name: _array(_half(values, f"scene {scene.name!r}: sky") if is_halved else values)}


def take_parts(
    tensors: dict[str, Tensor], document: SceneDocument, where: str
) -> tuple[list[SavedPart], list[str]]:
    """Background and actors, whose arrays are taken out of `tensors`, and what was left out."""
    counts = [document.background_gaussians, *(actor.gaussians for actor in document.actors)]
    has_waves = [False, *(actor.color_waves is not None for actor in document.actors)]
    parts, problems = [], []
    for number, count in enumerate(counts):
        name = _part_name(number)
        part = _take_part(tensors, name, count, document.precision, has_waves[number], where)
        waves = part.waves  # one look at each number tells whether every bit can stay as it is
        has_finite_waves = waves is None or bool(np.isfinite(_range(waves)).all())
        if not (has_finite_waves and is_drawable(part.gaussians)):
            part, found = _drawable(part, f"{where}, {name}")
            problems += found
        parts.append(part)
    if tensors:
        raise SceneError(
            f"{where} holds arrays that its document does not know: {sorted(tensors)[:5]}"
        )
    return parts, problems


def take_sky(tensors: dict[str, Tensor], kind: str, precision: Precision, where: str) -> Sky:
    """The sky of its one array."""
    sky_class = next(cls for cls, name in SKY_KINDS.items() if name == kind)
    name = _SKY_ARRAYS[kind]
    if list(tensors) != [name]:
        raise SceneError(f"{where}: a {kind} sky is one array {name!r}; got {sorted(tensors)[:5]}")
    values = tensors[name]
    shape = tuple(values.shape)
    fits, expected = {
        "rgb": (shape == (3,), "[3]"),
        "image": (len(shape) == 3 and shape[2] == 3, "[H, W, 3]"),
        "faces": (len(shape) == 4 and shape == (6, shape[1], shape[1], 3), "[6, R, R, 3]"),
    }[name]
    is_type = values.dtype == (torch.float16 if precision == "float16" else torch.float32)
    if not fits or not is_type or values.numel() == 0:
        raise SceneError(
            f"{where}: {name} must be {precision} {expected}; got {values.dtype} {list(shape)}"
        )
    values = values.float()
    if not np.isfinite(_range(values)).all():
        raise SceneError(f"{where}: {name} holds NaN or infinite values")
    return sky_class(values)


def _part_name(number: int) -> str:
    return "background" if number == 0 else f"actors.{number - 1}"


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def _half(tensor: Tensor, where: str) -> Tensor:
    low, high = _range(tensor)
    if not max(-low, high) < _FLOAT16_END:
        raise SceneError(
            f"{where}: float16 holds numbers up to 65504; got {low} to {high}. Write it at full "
            f"precision"
        )
    return tensor.half()


def _take_part(
    tensors: dict[str, Tensor],
    part: str,
    count: int,
    precision: Precision,
    has_waves: bool,
    where: str,
) -> SavedPart:
    names = (*_ARRAYS, "waves") if has_waves else _ARRAYS
    missing = [f"{part}.{name}" for name in names if f"{part}.{name}" not in tensors]
    if missing:
        raise SceneError(f"{where} lacks {', '.join(missing)}")
    own = {name: tensors.pop(f"{part}.{name}") for name in names}
    semantic = tensors.pop(f"{part}.semantic", None)
    for name, tensor in own.items():
        is_halved = precision == "float16" and name in _HALVED
        _check_array(tensor, name, count, is_halved=is_halved, where=f"{where}: {part}.{name}")
        if is_halved:
            own[name] = tensor.float()
    if precision == "float16":
        own["quats"] = torch.nn.functional.normalize(own["quats"], dim=1)
    if semantic is not None:
        _check_semantic(semantic, count, f"{where}: {part}.semantic")
    waves = own.pop("waves", None)
    return SavedPart(Gaussians(**own, semantic=semantic), waves)


def _check_array(tensor: Tensor, name: str, count: int, *, is_halved: bool, where: str) -> None:
    shape = tuple(tensor.shape)
    expected = torch.float16 if is_halved else torch.float32
    if tensor.dtype != expected:
        raise SceneError(f"{where} must be {str(expected)[6:]}; got {tensor.dtype}")
    if not shape or shape[0] != count:
        raise SceneError(
            f"{where} must have {count} rows, as the document says; got {list(shape)}: they "
            f"do not belong together"
        )
    if name in _ROWS and shape[1:] != _ROWS[name]:
        raise SceneError(f"{where} must be {[count, *_ROWS[name]]}; got {list(shape)}")
    is_colour = len(shape) == 3 and shape[2] == 3
    if name == "sh" and not (is_colour and shape[1] in SH_COUNTS):
        raise SceneError(f"{where} must be [N, K, 3] with K in {SH_COUNTS}; got {list(shape)}")
    if name == "waves" and not (is_colour and shape[1] <= MAX_WAVES):
        raise SceneError(
            f"{where} must be [N, terms, 3], at most {MAX_WAVES} terms; got {list(shape)}"
        )


def _check_semantic(semantic: Tensor, count: int, where: str) -> None:
    if semantic.dtype != torch.int16 or tuple(semantic.shape) != (count,):
        raise SceneError(
            f"{where} must be int16 [{count}]; got {semantic.dtype} {list(semantic.shape)}"
        )
    classes = [int(value) for value in SemanticClass]
    low, high = _range(semantic) if semantic.numel() else (0, 0)
    if low < min(classes) or high > max(classes):
        raise SceneError(
            f"{where} must hold classes from {min(classes)} to {max(classes)}; got "
            f"{low:.0f} to {high:.0f}"
        )


def _drawable(part: SavedPart, where: str) -> tuple[SavedPart, tuple[str, ...]]:
    """As check_gaussians; colour waves follow their Gaussians."""
    gaussians, waves = part.gaussians, part.waves
    if waves is None:
        gaussians, problems = check_gaussians(gaussians, where=where)
        return SavedPart(gaussians), problems
    finite = torch.isfinite(waves.sum((1, 2)))
    unknown = torch.where(finite, 0.0, torch.nan)  # makes means that check_gaussians leaves out
    gaussians = replace(gaussians, means=gaussians.means + unknown[:, None])
    kept = drawable_rows(gaussians)
    gaussians, problems = check_gaussians(gaussians, where=where)
    return SavedPart(gaussians, waves[kept]), problems


def _range(values: Tensor) -> tuple[float, float]:
    """Lowest and highest value; NaN where there is one. By NumPy, which wakes no threads."""
    array = values.detach().cpu().numpy()
    if array.size == 0:
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        return float(array.min()), float(array.max())


# ---- scene.json ----------------------------------------------------------------------------------

FORMAT = "climategs-scene"
VERSION = 2  # of what is written
READABLE = (1, 2)
MAX_BYTES = 256 << 20  # of a scene.json; a drive of an hour has about 30 MB
_MAX_PROBLEMS_SHOWN = 5


def _plain_text(text: str) -> str:
    """Text that can be printed and, where it is a path, opened."""
    if "\0" in text:
        raise ValueError("text must not hold a NUL character")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError("text must not hold unpaired surrogates") from None
    return text


Precision = Literal["float32", "float16"]
Text = Annotated[str, AfterValidator(_plain_text)]
Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Count = Annotated[int, Field(ge=0, lt=2**31)]
Phase = Annotated[float, Field(ge=-1e9, le=1e9)]  # of which sine and cosine are known
Pixels = Annotated[int, Field(ge=1, le=100_000)]
Row3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix3x4 = Annotated[list[Row4], Field(min_length=3, max_length=3)]
Matrix4x4 = Annotated[list[Row4], Field(min_length=4, max_length=4)]


class _Closed(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class CameraEntry(_Closed):
    """A camera of a frame; its name is the key it stands under."""

    width: Pixels
    height: Pixels
    fx: float
    fy: float
    cx: float
    cy: float
    timestamp_ns: Int64
    camera_from_world: Matrix4x4
    is_orthographic: bool = False


class FrameEntry(_Closed):
    """A frame. image_paths: absolute, by camera."""

    index: Int64
    timestamp_ns: Int64
    world_from_ego: Matrix4x4
    cameras: dict[Text, CameraEntry]
    image_paths: dict[Text, Text]


class TrackEntry(_Closed):
    hold_ns: Int64
    timestamps_ns: list[Int64]
    world_from_actor: list[Matrix4x4]
    max_gap_ns: Int64 | None = None


class WavesEntry(_Closed):
    """The times of an actor's colour waves; their coefficients are its array `waves`."""

    timestamps_ns: list[Int64]
    phases: list[Phase]

    @model_validator(mode="after")
    def _belong_together(self) -> WavesEntry:
        if len(self.timestamps_ns) != len(self.phases):
            raise ValueError("there must be as many phases as timestamps")
        return self


class ActorEntry(_Closed):
    """An actor. gaussians: how many rows its arrays have."""

    track_id: Text
    label: Text
    size_m: Row3
    gaussians: Count
    track: TrackEntry
    color_waves: WavesEntry | None = None
    colors_in_world: bool = False


class ImageColorMapEntry(_Closed):
    """A colour map of a single image, which is known by its camera and its time."""

    camera: Text
    timestamp_ns: Int64
    rows: Matrix3x4


class GroundEntry(_Closed):
    """The record augment.ground.Ground."""

    lowest_z_m: float
    median_z_m: float
    source: GroundSource
    residual_m: float | None
    points: Count
    tilt_deg: float | None


class SceneDocument(_Closed):
    """The whole file. working_folder: what relative paths in recorded_source start from. precision:
    what quaternions, opacities and colours are stored as. The keys with a default are not in older
    files.
    """

    format: Literal["climategs-scene"]
    version: Literal[1, 2]
    precision: Precision = "float32"
    name: Text
    recorded_source: Text
    working_folder: Text
    world_origin_m: Row3
    ground_z_m: float | None
    has_metric_scale: bool
    ground: GroundEntry | None = None
    has_known_gravity: bool = True
    sky: Literal["constant", "latlong", "cubemap"]
    background_gaussians: Count
    color_maps: dict[Text, Matrix3x4]
    image_color_maps: list[ImageColorMapEntry] = []
    made_by: dict[str, Any]
    problems: list[Text]
    actors: list[ActorEntry]
    frames: list[FrameEntry]


def read_document(path: Path) -> SceneDocument:
    """The checked contents of a scene.json."""
    try:
        with open_file(path) as file:
            text = file.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise SceneError(f"{path}: a scene.json has at most {MAX_BYTES} bytes")
        return parsed_document(text, str(path))
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from error


def parsed_document(text: bytes | str, where: str) -> SceneDocument:
    """The checked contents of a scene's JSON text."""
    try:
        text = text.decode("utf-8") if isinstance(text, bytes) else text
        raw = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # also what is no UTF-8
        raise SceneError(f"{where} is no JSON: {error or 'nested too deeply'}") from None
    if not isinstance(raw, dict):
        raise SceneError(f"{where} describes no scene: expected an object; got {raw!r:.80}")
    check_format(raw.get("format"), raw.get("version"), where)
    return checked_document(raw, where)


def check_format(found: object, version: object, where: str) -> None:
    """That this is a scene, and of a version that is known."""
    if found != FORMAT:
        raise SceneError(
            f'{where} describes no scene: its "format" must be {FORMAT!r}; got {found!r:.80}'
        )
    if version not in READABLE:
        known = " and ".join(map(str, READABLE))
        raise SceneError(
            f"{where}: this ClimateGS reads scenes of versions {known}; got {version!r:.80}. "
            f"A newer one is read by a newer ClimateGS"
        )


def checked_document(raw: dict[str, Any], where: str) -> SceneDocument:
    """The document as a record."""
    try:
        return SceneDocument.model_validate(raw)
    except (ValidationError, RecursionError, OverflowError) as error:
        if not isinstance(error, ValidationError):
            raise SceneError(f"{where}: nested too deeply or numbers too large") from None
        problems = error.errors(include_url=False, include_context=False)
    shown = [
        f"{'.'.join(map(str, p['loc']))}: {p['msg']}; got {p['input']!r:.60}"
        for p in problems[:_MAX_PROBLEMS_SHOWN]
    ]
    more = len(problems) - len(shown)
    raise SceneError(f"{where}: " + "; ".join(shown) + (f"; and {more} more" if more else ""))


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")
