"""The URI of a scene, `scheme:path?key=value&…`, parsed and formatted.

Special characters in paths and values (% ? & and, in values, = too) may be percent-encoded. A path
that exists as written is taken as written. `+` stands for itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Self
from urllib.parse import quote, unquote

from pydantic import BaseModel, ConfigDict, ValidationError

from adapters.datasets import DATASETS
from augment.errors import AdapterError
from recipes.errors import nearest_word

CAMERA_PATH_KEY = "camera_path"
GROUND_KEY = "ground_z"
EGO_MASKS_KEY = "ego_masks"
TRACKS_KEY = "tracks"
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9_+.-]*):(?!\\)")


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
    return ", ".join(f"{name} ({dataset.example})" for name, dataset in DATASETS.items())


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
