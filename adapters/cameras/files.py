"""Camera files: which there are, which lies beside a scene, and their views.

Read are INRIA's cameras.json, nerfstudio's transforms.json, this project's camera paths
(`adapters.cameras.path_json`) and COLMAP sparse models, all told apart by their contents.
"""

from __future__ import annotations

from pathlib import Path

from adapters.cameras.colmap import find_colmap_model, read_colmap_views
from adapters.cameras.json_formats import inria_views, nerfstudio_views
from adapters.cameras.path_json import path_views
from adapters.cameras.posed_views import ViewSet
from adapters.plain_files import read_json
from augment.errors import AdapterError

_JSON_NAMES = ("cameras.json", "transforms.json")


def read_views(path: Path) -> ViewSet:
    """Views of a camera file, or of a folder that holds a COLMAP model or a JSON of a known name.

    Raises:
        AdapterError: no such file, an unknown format, or a damaged one; says what was expected.
    """
    if not path.exists():
        raise AdapterError(
            f"{path}: no such file; expected an INRIA cameras.json, a nerfstudio transforms.json, "
            "a camera path (JSON) or a COLMAP sparse model"
        )
    found = find_camera_file(path) if path.is_dir() else path
    if found is None:
        raise AdapterError(
            f"{path}: no cameras in this folder; looked for {', '.join(_JSON_NAMES)} and a COLMAP "
            "sparse model (cameras and images, .bin or .txt) in it, sparse/0 and sparse"
        )
    return read_colmap_views(found) if found.is_dir() else read_camera_json(found)


def find_camera_file(folder: Path) -> Path | None:
    """The camera file of a folder (a COLMAP model is itself a folder), or None."""
    for name in _JSON_NAMES:
        if (folder / name).is_file():
            return folder / name
    return find_colmap_model(folder)


def read_camera_json(path: Path) -> ViewSet:
    """Read any of the three JSON formats, told apart by their keys.

    Raises:
        AdapterError: not JSON, none of the formats, or a field that is missing or out of range
            (named with its place in the file).
    """
    content = read_json(path, object)
    if isinstance(content, list):
        return inria_views(content, path)
    frames = content.get("frames") if isinstance(content, dict) else None
    first = frames[0] if isinstance(frames, list) and frames else None
    if isinstance(first, dict) and "transform_matrix" in first:
        return nerfstudio_views(content, path)
    if isinstance(content, dict) and "frames" in content:
        return path_views(content, path)
    raise AdapterError(
        f"{path}: expected a list of cameras (INRIA cameras.json), 'frames' with "
        "'transform_matrix' (nerfstudio transforms.json), or 'frames' with 'position' and "
        f"'look_at' or 'world_from_camera' (a camera path); got {_describe(content)}"
    )


def _describe(content: object) -> str:
    if isinstance(content, dict):
        return f"an object with keys {sorted(content)[:8]}"
    return f"a {type(content).__name__}"
