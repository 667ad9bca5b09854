"""Scenes by URI: `open_scene("scheme:path?key=value&…")`.

Schemes are in the table below; a path without one is recognised by what it holds. Special
characters in paths and values (% ? & and, in values, = too) may be percent-encoded; a path that
exists as written is taken as written. `+` stands for itself. Two keys work with every scheme:
`camera_path=FILE` replaces the scene's cameras (see adapters.camera_paths), and `ground_z=HEIGHT`
says how high the road is (scene world, metres) where the scene does not know or is wrong.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from urllib.parse import quote, unquote

from augment.errors import AdapterError
from augment.scene import Scene

CAMERA_PATH_KEY = "camera_path"
GROUND_KEY = "ground_z"
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9_+.-]*):(?!\\)")


class Adapter(Protocol):
    """Turns a dataset or file into a Scene.

    query: the URI's keys and values; an adapter raises AdapterError for keys it does not know.
    The scene's `source` is `format_uri(scheme, path, query)`, so that it can be opened again.
    """

    def __call__(self, path: str, query: dict[str, str]) -> Scene: ...


@dataclass(frozen=True)
class _Scheme:
    """module, function: imported when used. builtin: the names the path may be, if no file."""

    module: str
    function: str
    example: str
    builtin: tuple[str, ...] = ()


_SCHEMES = {
    "procedural": _Scheme(
        "adapters.procedural", "open_procedural", "procedural:street?seed=3", ("street",)
    ),
    "pandaset": _Scheme("adapters.pandaset", "open_pandaset", "pandaset:data/pandaset/002"),
    "gaussians": _Scheme(
        "adapters.gaussian_files", "open_gaussians", "gaussians:model/point_cloud.ply?up=-y"
    ),
}


def open_scene(uri: str) -> Scene:
    """Open a scene.

    Raises:
        AdapterError: an unknown scheme (lists the known ones), a missing path, a path that no
            adapter recognises, or a dataset that its adapter cannot use.
    """
    scheme, path, query = parse_uri(uri)
    camera_path = query.pop(CAMERA_PATH_KEY, None)
    ground_z = query.pop(GROUND_KEY, None)
    if scheme is None:
        scheme = recognise(Path(path))
    entry = _SCHEMES.get(scheme)
    if entry is None:
        raise AdapterError(f"{uri!r}: unknown scheme {scheme!r}; known: {_known_schemes()}")
    if entry.builtin:
        scene = _open_builtin(scheme, entry, path, query)
    else:
        if not Path(path).exists():
            raise AdapterError(_missing(path))
        try:
            scene = _load(entry)(path, query)
        except OSError as error:
            raise AdapterError(f"{uri!r}: cannot be read: {error}") from error
    if ground_z is not None:
        scene = _with_ground(scene, ground_z)
    if camera_path is None:
        return scene
    from adapters.camera_paths import with_camera_path

    return with_camera_path(scene, Path(camera_path))


def _with_ground(scene: Scene, text: str) -> Scene:
    try:
        height = float(text)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise AdapterError(f"{GROUND_KEY} must be the road's height in metres; got {text!r}")
    source = add_to_uri(scene.source, GROUND_KEY, text)
    return dataclasses.replace(scene, ground_z_m=height, source=source)


def parse_uri(uri: str) -> tuple[str | None, str, dict[str, str]]:
    """Scheme (None where there is none), path and query of a scene's URI, decoded.

    Raises:
        AdapterError: an empty path, or a query that is not key=value&key=value.
    """
    if Path(uri).exists() and uri:
        return None, uri, {}
    match = _SCHEME.match(uri)
    scheme = match[1].lower() if match else None
    path, query = _split_query(uri[match.end() :] if match else uri, uri)
    if not path:
        raise AdapterError(
            f"{uri!r}: no path in this scene URI; expected one of: {_known_schemes()}"
        )
    if not Path(path).exists():
        path = unquote(path)
    return scheme, str(Path(path).expanduser()), query


def format_uri(scheme: str, path: str | Path, query: Mapping[str, str]) -> str:
    """The URI that `parse_uri` takes apart into these, with keys in the order given."""
    encoded = "&".join(f"{key}={quote(value, safe='/+,:.~-')}" for key, value in query.items())
    return f"{scheme}:{quote(str(path), safe='/+,:=&@ ')}" + (f"?{encoded}" if encoded else "")


def add_to_uri(uri: str, key: str, value: str) -> str:
    """The URI with one more key, which replaces what it said before."""
    scheme, path, query = parse_uri(uri)
    return format_uri(scheme or recognise(Path(path)), path, {**query, key: value})


def recognise(path: Path) -> str:
    """The scheme of a path by its contents.

    Raises:
        AdapterError: nothing there, or nothing known; says what was looked for.
    """
    if not path.exists():
        raise AdapterError(_missing(str(path)))
    if path.is_file():
        if path.suffix.lower() == ".splat" or _starts_with_ply(path):
            return "gaussians"
        looked_for = "a .ply or .splat file"
    else:
        if (path / "camera").is_dir() and (path / "lidar").is_dir():
            return "pandaset"
        if _holds_splats(path):
            return "gaussians"
        looked_for = (
            "a PandaSet sequence (camera/ and lidar/), a trained 3DGS model "
            "(point_cloud/iteration_N/point_cloud.ply), or a single .ply or .splat file in it"
        )
        below = sorted(
            p.parent.name for p in path.glob("*/lidar") if (p.parent / "camera").is_dir()
        )
        if below:
            looked_for += f". It holds PandaSet sequences: give one, such as {path / below[0]}"
    raise AdapterError(
        f"{path}: not recognised as a scene; looked for {looked_for}. "
        f"Or name the scheme: {_known_schemes()}"
    )


def _holds_splats(folder: Path) -> bool:
    if any(folder.glob("point_cloud/iteration_*/point_cloud.ply")):
        return True
    return sum(1 for p in folder.iterdir() if p.suffix.lower() in (".ply", ".splat")) == 1


def _starts_with_ply(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(4) in (b"ply\n", b"ply\r")
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error}") from error


def _split_query(text: str, uri: str) -> tuple[str, dict[str, str]]:
    """Path and query. A path may hold '?': the shortest beginning that exists is the path, and
    where none does, all before the first '?'.
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


def _open_builtin(scheme: str, entry: _Scheme, path: str, query: dict[str, str]) -> Scene:
    if path not in entry.builtin:
        raise AdapterError(
            f"{scheme}:{path}: {scheme} scenes are {', '.join(entry.builtin)}; got {path!r}. "
            f"Example: {entry.example}"
        )
    return _load(entry)(query)


def _load(entry: _Scheme):
    return getattr(importlib.import_module(entry.module), entry.function)


def _missing(path: str) -> str:
    absolute = Path(path).absolute()
    parent = next((p for p in absolute.parents if p.exists()), Path("/"))
    where = "" if parent == absolute.parent else f"; the path exists up to {parent}"
    return f"{path}: no such file or folder (looked at {absolute}{where})"


def _known_schemes() -> str:
    return ", ".join(f"{name} ({entry.example})" for name, entry in _SCHEMES.items())
