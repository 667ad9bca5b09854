"""Names and paths that are safe in an output folder, whoever chose them.

In: names of scenes and cameras, and paths that a manifest gives. Out: one path component, or a path
below the folder.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path, PurePosixPath

from augment.errors import OutputError
from augment.output.atomic import path_below

# File of the table of all images.
MANIFEST_FILE = "manifest.parquet"
# Folder of the jobs' state.
STATE_FOLDER = ".climategs"

# Names that stay as they are.
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_UNSAFE_CHARACTERS = re.compile(r"[^A-Za-z0-9._-]+")


def folder_name(name: str) -> str:
    """Return the name of a scene or camera as one safe path component.

    A name of at most 100 letters, digits, `.`, `_` and `-`, the first a letter or digit, stays as
    it is. In any other name the other characters are replaced by `_`, and eight hex digits of the
    name's SHA-256 are added. Therefore two names never share a folder, and no name leads out of the
    output folder.
    """
    if _SAFE_NAME.fullmatch(name) and name != MANIFEST_FILE:
        return name
    digest = hashlib.sha256(name.encode()).hexdigest()[:8]
    readable = _UNSAFE_CHARACTERS.sub("_", name).lstrip("._-")[:80]
    return f"{readable or 'unnamed'}-{digest}"


def relative_parts(path: str) -> tuple[str, ...] | None:
    """Return the components of a path that stays below its root; None for any other path.

    Other paths are empty, absolute, or lead upwards.
    """
    parts = PurePosixPath(path).parts
    if not parts or parts[0].startswith("/") or ".." in parts or "\\" in path or "\0" in path:
        return None
    return parts


def resolve_inside(root: Path, relative: str) -> Path:
    """Return the file that a path in a manifest names.

    Raises:
        OutputError: The path leads out of the output folder.
    """
    parts = relative_parts(relative)
    if parts is None:
        raise OutputError(
            f"{root / MANIFEST_FILE} names the file {relative!r}; paths there must be relative to "
            f"{root}, without '..'. The manifest is damaged or not from this project: do not "
            f"trust the folder"
        )
    return path_below(root, parts)
