"""Scenes by URI: `open_scene("scheme:path?key=value&…")`.

Schemes and syntax are those of adapters.uri; a path without a scheme is recognised by what it
holds. Two keys work with every scheme:
`camera_path=FILE` replaces the scene's cameras (see adapters.cameras.paths), and `ground_z=HEIGHT`
says how high the road is (scene world, metres) where the scene does not know or is wrong.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from pathlib import Path

from adapters.cameras.paths import with_camera_path
from adapters.signatures import looked_for, recognised
from adapters.uri import (
    CAMERA_PATH_KEY,
    GROUND_KEY,
    SCHEMES,
    Scheme,
    add_to_uri,
    known_schemes,
    parse_uri,
)
from augment.errors import AdapterError
from augment.ground import Ground
from augment.scene import Scene
from recipes.nearest import nearest_word


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
    entry = SCHEMES.get(scheme)
    if entry is None:
        near = nearest_word(scheme, tuple(SCHEMES))
        guess = f"; did you mean {near}?" if near else ";"
        raise AdapterError(f"unknown scheme {scheme!r} in {uri!r}{guess} known: {known_schemes()}")
    if entry.builtin:
        scene = _open_builtin(scheme, entry, path, query)
    else:
        _check_there(Path(path))
        try:
            scene = _load(entry)(path, query)
        except OSError as error:
            raise AdapterError(f"{uri!r}: cannot be read: {error}") from error
    if ground_z is not None:
        scene = _with_ground(scene, ground_z)
    if camera_path is None:
        return scene
    return with_camera_path(scene, Path(camera_path))


def _with_ground(scene: Scene, text: str) -> Scene:
    try:
        height = float(text)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise AdapterError(f"{GROUND_KEY} must be the road's height in metres; got {text!r}")
    source = add_to_uri(scene.source, GROUND_KEY, text)
    ground = Ground(height, height, "stated")
    return dataclasses.replace(scene, ground_z_m=height, ground=ground, source=source)


def recognise(path: Path) -> str:
    """The scheme of a path by its contents.

    Raises:
        AdapterError: nothing there, or nothing known; says what was looked for.
    """
    _check_there(path)
    scheme = recognised(path)
    if scheme is None:
        raise AdapterError(
            f"{path}: not recognised as a scene; looked for {looked_for(path)}. "
            f"Or name the scheme: {known_schemes()}"
        )
    return scheme


def _open_builtin(scheme: str, entry: Scheme, path: str, query: dict[str, str]) -> Scene:
    if path not in entry.builtin:
        raise AdapterError(
            f"{scheme}:{path}: {scheme} scenes are {', '.join(entry.builtin)}; got {path!r}. "
            f"Example: {entry.example}"
        )
    return _load(entry)(query)


def _load(entry: Scheme):
    return getattr(importlib.import_module(entry.module), entry.function)


def _check_there(path: Path) -> None:
    if path.is_dir() or path.is_file():
        return
    if path.exists():
        raise AdapterError(f"{path}: a pipe or device; a scene is a regular file or a folder")
    absolute = path.absolute()
    parent = next((p for p in absolute.parents if p.exists()), Path("/"))
    where = "" if parent == absolute.parent else f"; the path exists up to {parent}"
    raise AdapterError(f"{path}: no such file or folder (looked at {absolute}{where})")
