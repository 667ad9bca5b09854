"""What a scene.json may hold, and reading one that may come from anywhere.

The models are closed: an unknown key is an error, since it would be lost without a word.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from augment.errors import SceneError
from augment.ground_heights import GroundSource
from recipes.files import open_file

FORMAT = "climategs-scene"
VERSION = 2  # of what is written
READABLE = (1, 2)
MOST_BYTES = 256 << 20  # of a scene.json; a drive of an hour has about 30 MB
_MOST_PROBLEMS_SHOWN = 5


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
    """The checked contents of a scene.json.

    Raises:
        SceneError: unreadable, no JSON, another format or version, or wrong contents; says where.
    """
    try:
        with open_file(path) as file:
            text = file.read(MOST_BYTES + 1)
        if len(text) > MOST_BYTES:
            raise SceneError(f"{path}: a scene.json has at most {MOST_BYTES} bytes")
        return parsed_document(text, str(path))
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from error


def parsed_document(text: bytes | str, where: str) -> SceneDocument:
    """The checked contents of a scene's JSON text.

    Raises:
        SceneError: no JSON, another format or version, or wrong contents.
    """
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
    """That this is a scene, and of a version that is known.

    Raises:
        SceneError: it is not.
    """
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
    """The document as a record.

    Raises:
        SceneError: names the fields that are wrong, and what was expected.
    """
    try:
        return SceneDocument.model_validate(raw)
    except (ValidationError, RecursionError, OverflowError) as error:
        if not isinstance(error, ValidationError):
            raise SceneError(f"{where}: nested too deeply or numbers too large") from None
        problems = error.errors(include_url=False, include_context=False)
    shown = [
        f"{'.'.join(map(str, p['loc']))}: {p['msg']}; got {p['input']!r:.60}"
        for p in problems[:_MOST_PROBLEMS_SHOWN]
    ]
    more = len(problems) - len(shown)
    raise SceneError(f"{where}: " + "; ".join(shown) + (f"; and {more} more" if more else ""))


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")
