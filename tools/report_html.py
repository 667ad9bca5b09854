"""HTML that is escaped unless it was made here: names and messages of a manifest are untrusted."""

from __future__ import annotations

import html
import re
from typing import Any

MAX_TEXT = 300  # characters of one name or message
_VOID = {"br", "img", "input", "meta"}
# Control characters and lone surrogates have no place in HTML; others could turn the line's
# direction and so show a name as what it is not.
_INVISIBLE = re.compile(
    "[\0-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)


class Html(str):
    """Text that is markup already."""


def text(value: object) -> Html:
    """Any value as text of a page: escaped, cut to MAX_TEXT, invisible characters shown."""
    said = str(value)
    if len(said) > MAX_TEXT:
        said = said[: MAX_TEXT - 1] + "…"
    return Html(html.escape(_INVISIBLE.sub("\ufffd", said), quote=True))


def tag(name: str, /, *children: object, **attributes: Any) -> Html:
    """An element. Children that are Html stay as they are, None is left out, all else is escaped.

    attributes: `class_` is class, and `_` becomes `-`; True is an attribute without a value, None
    and False leave it out.
    """
    inside = "".join(child if isinstance(child, Html) else text(child) for child in _flat(children))
    words = "".join(_attribute(key, value) for key, value in attributes.items())
    return Html(f"<{name}{words}>" + ("" if name in _VOID else f"{inside}</{name}>"))


def joined(parts: Any) -> Html:
    """Several pieces one after another, escaped as `tag` does."""
    return Html("".join(p if isinstance(p, Html) else text(p) for p in _flat([parts])))


def _flat(children: Any) -> Any:
    for child in children:
        if isinstance(child, list | tuple):
            yield from _flat(child)
        elif child is not None:
            yield child


def _attribute(key: str, value: Any) -> str:
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    if value is True:
        return f" {name}"
    # Data URIs are longer than any text, and are made here.
    said = value if isinstance(value, Html) else text(value)
    return f' {name}="{said}"'
