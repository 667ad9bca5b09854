"""The URI of a scene, `scheme:path?key=value&…`, parsed and formatted.

Special characters in paths and values (% ? & and, in values, = too) may be percent-encoded. A path
that exists as written is taken as written. `+` stands for itself.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import quote, unquote

from pydantic import BaseModel, ConfigDict, ValidationError

from augment.errors import AdapterError
from recipes.errors import nearest_word

if TYPE_CHECKING:  # torch would be loaded with them
    from augment.scene.labels import LabelSource
    from augment.scene.scene import Scene

CAMERA_PATH_KEY = "camera_path"
GROUND_KEY = "ground_z"
WAYMO_SPLITS = ("training", "validation", "testing")
WAYMO_REQUIRED = (
    *("vehicle_pose", "camera_calibration", "camera_image"),
    *("lidar_calibration", "lidar", "lidar_pose"),
)
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9_+.-]*):(?!\\)")


@dataclass(frozen=True)
class Scheme:
    """Openers of one kind of scene. Functions are given as module:name, and imported when used.

    Attributes:
        opener: function from path and query to a Scene whose `source` is `format_uri(scheme, path,
            query)`. It raises an AdapterError for unknown keys.
        builtin: names that the path may be if it is no file. The opener then takes the query alone.
        labels: function from path and query to the labels alone (None without any), which a scene
            fitted to such data needs.
        is_raw: True if opening builds the scene from raw data, which takes long (see
            adapters.scene_cache).
    """

    opener: str
    example: str
    builtin: tuple[str, ...] = ()
    labels: str | None = None
    is_raw: bool = False

    def open(self, *path_and_query: object) -> Scene:
        return _imported(self.opener)(*path_and_query)

    def open_labels(self, path: str, query: Mapping[str, str]) -> LabelSource | None:
        return _imported(self.labels)(path, query) if self.labels else None


def _imported(name: str) -> Callable[..., Any]:
    module, function = name.split(":")
    return getattr(importlib.import_module(module), function)


SCHEMES = {
    "procedural": Scheme(
        "adapters.procedural:open_procedural",
        "procedural:street?seed=3",
        ("street",),
        "adapters.procedural:procedural_labels",
    ),
    "pandaset": Scheme(
        "adapters.pandaset:open_pandaset",
        "pandaset:data/pandaset/002",
        labels="adapters.pandaset:pandaset_labels",
        is_raw=True,
    ),
    "nuscenes": Scheme(
        "adapters.nuscenes.adapter:open_nuscenes",
        "nuscenes:data/nuscenes?scene=scene-0061",
        labels="adapters.nuscenes.adapter:nuscenes_labels",
        is_raw=True,
    ),
    "kitti": Scheme(
        "adapters.kitti.adapter:open_kitti",
        "kitti:data/kitti/2011_09_26/2011_09_26_drive_0001_sync",
        labels="adapters.kitti.adapter:kitti_labels",
        is_raw=True,
    ),
    "waymo": Scheme(
        "adapters.waymo.adapter:open_waymo",
        "waymo:data/waymo/training?segment=10023947602400723454_1120_000_1140_000",
        labels="adapters.waymo.adapter:waymo_labels",
        is_raw=True,
    ),
    "av2": Scheme(
        "adapters.av2.adapter:open_av2",
        "av2:data/av2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede",
        labels="adapters.av2.adapter:av2_labels",
        is_raw=True,
    ),
    "street_gaussians": Scheme(
        "adapters.street_gaussians.adapter:open_street_gaussians",
        "street_gaussians:output/waymo/002?data=data/waymo/002",
        labels="adapters.street_gaussians.adapter:street_gaussians_labels",
    ),
    "drivestudio": Scheme(
        "adapters.drivestudio.adapter:open_drivestudio",
        "drivestudio:output/omnire/run?data=data/waymo/processed/training/023",
        labels="adapters.drivestudio.adapter:drivestudio_labels",
    ),
    "recording": Scheme(
        "adapters.recording.adapter:open_recording",
        "recording:out/street-seed3/clear-000",
        labels="adapters.recording.adapter:recording_labels",
        is_raw=True,
    ),
    "gaussians": Scheme(
        "adapters.gaussian_files:open_gaussians", "gaussians:model/point_cloud.ply?up=-y"
    ),
    "scene": Scheme("adapters.scene_folder:open_scene_folder", "scene:out/fitted"),
}


def parse_uri(uri: str) -> tuple[str | None, str, dict[str, str]]:
    """Return scheme (None without one), path and query of a scene's URI, decoded."""
    if Path(uri).exists() and uri:
        return None, uri, {}
    match = _SCHEME.match(uri)
    scheme = match[1].lower() if match else None
    path, query = _split_query(uri[match.end() :] if match else uri, uri)
    if not path:
        raise AdapterError(
            f"{uri!r}: no path in this scene URI; expected one of: {known_schemes()}"
        )
    if not Path(path).exists():
        path = unquote(path)
    return scheme, str(Path(path).expanduser()), query


def format_uri(scheme: str, path: str | Path, query: Mapping[str, str]) -> str:
    """Return the URI of scheme, path and query, with keys in the order given. parse_uri is the
    inverse.
    """
    encoded = "&".join(f"{key}={quote(value, safe='/+,:.~-')}" for key, value in query.items())
    return f"{scheme}:{quote(str(path), safe='/+,:=&@ ')}" + (f"?{encoded}" if encoded else "")


def add_to_uri(uri: str, key: str, value: str) -> str:
    """Return a URI, which names its scheme, with one more key.

    It replaces an earlier value of the key.
    """
    scheme, path, query = parse_uri(uri)
    assert scheme is not None, f"a scene's source names its scheme; got {uri!r}"
    return format_uri(scheme, path, {**query, key: value})


def known_schemes() -> str:
    """Return every scheme with an example, for messages."""
    return ", ".join(f"{name} ({entry.example})" for name, entry in SCHEMES.items())


class UriOptions(BaseModel):
    """Options of one opening, from a URI's query. A field's description says what it must be."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    @classmethod
    def from_query(cls, scheme: str, query: Mapping[str, str]) -> Self:
        meanings = {name: field.description or "" for name, field in cls.model_fields.items()}
        check_query(scheme, query, meanings)
        try:
            return cls.model_validate(dict(query))
        except ValidationError as error:
            key = str(error.errors()[0]["loc"][0])
            message = f"{scheme}: {key} must be {meanings[key]}; got {query[key]!r}"
            raise AdapterError(message) from None


def check_query(scheme: str, query: Mapping[str, str], meanings: Mapping[str, str]) -> None:
    """Refuse options that are not among the keys of meanings, which hold each option's meaning."""
    if unknown := sorted(set(query) - set(meanings)):
        near = nearest_word(unknown[0], tuple(meanings))
        guess = "" if near is None else f"did you mean {near!r}? "
        allowed = "; ".join(f"{key}: {meaning}" for key, meaning in meanings.items())
        raise AdapterError(f"{scheme}: unknown option {unknown[0]!r}; {guess}allowed are {allowed}")


def _split_query(text: str, uri: str) -> tuple[str, dict[str, str]]:
    """Return path and query.

    A path may hold '?': the shortest beginning that exists is the path. If none exists, it is all
    before the first '?'.
    """
    marks = [i for i, character in enumerate(text) if character == "?"]
    if not marks or Path(text).exists():
        return text, {}
    existing = [i for i in marks if i and Path(text[:i]).exists()]
    mark = existing[0] if existing else marks[0]
    query: dict[str, str] = {}
    for item in filter(None, text[mark + 1 :].split("&")):
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise AdapterError(
                f"{uri!r}: expected key=value after '?'; got {item!r} (write %3F for a '?' and %26 "
                "for a '&' that belong to a name)"
            )
        if key in query:
            raise AdapterError(f"{uri!r}: the key {key!r} is given twice")
        query[key] = unquote(value)
    return text[:mark], query
