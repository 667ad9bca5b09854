"""What a scene.json may hold, and reading one that may come from anywhere.

The models are closed: an unknown key is an error, since it would be lost without a word.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from augment.errors import SceneError
from augment.ground_heights import GroundSource

FORMAT = "climategs-scene"
VERSION = 1
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


Text = Annotated[str, AfterValidator(_plain_text)]
Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Count = Annotated[int, Field(ge=0, lt=2**31)]
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


class ActorEntry(_Closed):
    """An actor. gaussians: how many it has in gaussians.safetensors."""

    track_id: Text
    label: Text
    size_m: Row3
    gaussians: Count
    track: TrackEntry


class GroundEntry(_Closed):
    """The record augment.ground.Ground."""

    lowest_z_m: float
    median_z_m: float
    source: GroundSource
    residual_m: float | None
    points: Count
    tilt_deg: float | None


class SceneDocument(_Closed):
    """The whole file. working_folder: what relative paths in recorded_source start from. The keys
    with a default are not in older files.
    """

    format: Literal["climategs-scene"]
    version: Literal[1]
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
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise SceneError(f"{path}: {size} bytes; a scene.json has at most {MOST_BYTES}")
        raw = json.loads(path.read_bytes().decode("utf-8"), parse_constant=_no_constant)
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # also what is no UTF-8
        raise SceneError(f"{path} is no JSON: {error or 'nested too deeply'}") from None
    found = raw.get("format") if isinstance(raw, dict) else None
    if found != FORMAT:
        raise SceneError(
            f'{path} describes no scene: its "format" must be {FORMAT!r}; got {found!r:.80}'
        )
    if raw.get("version") != VERSION:
        raise SceneError(
            f"{path}: this version reads scene folders of version {VERSION}; got "
            f"{raw.get('version')!r:.80}. A newer one is read by a newer ClimateGS"
        )
    return checked_document(raw, str(path))


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
