"""Parts of messages about a recipe: a value as it was written, and a guess at its meaning."""

from __future__ import annotations

import contextlib
import re

from recipes.errors import join, nearest_word, short
from recipes.ranges import RANGE_KINDS
from recipes.schema import SECTIONS
from recipes.sections import Leaf, Section
from recipes.yaml_tree import ListNode, MapNode, Node, ScalarNode

# Words for a switch: YAML 1.1 read some of them as true and false, and other programs the rest.
_SWITCHES = {
    **dict.fromkeys(("true", "yes", "on", "1"), True),
    **dict.fromkeys(("false", "no", "off", "none", "null", "nil", "0"), False),
}
_OFF_WORDS = ("none", "never", "still")
_ON_WORDS = ("always",)
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+")
_NUMBER_WITH_UNIT = re.compile(r"[-+]?[0-9.]+\s*[A-Za-z/%]+[0-9]?")
_UNIT = re.compile(
    r"_(per_)?(k|c|m)?(m|metres?|meters?|ft|feet|mi|miles?|yards?|mps|kmh|kph|mph|deg|rad|ntu|fnu)$"
)


def show(node: Node) -> str:
    """Return the node as written, on one short line. Text that is no number is quoted."""
    if isinstance(node, ScalarNode):
        if node.value is None:
            return "null"
        text = short(node.text)
        return repr(text) if isinstance(node.value, str) else text
    if isinstance(node, ListNode):
        if len(node) <= 4 and all(isinstance(item, ScalarNode) for item in node):
            return f"[{', '.join(map(show, node))}]"
        return f"a list of {len(node)}"
    keys = [f"{short(key, 20)}: ..." for key in list(node)[:4]]
    return "{" + ", ".join(keys) + ("}" if len(keys) == len(node) else ", ...}")


# ---- Values --------------------------------------------------------------------------------------


def guess_value(node: Node, leaf: Leaf) -> str:
    """Return a guess at the intended value, as the end of a message; '' without a guess."""
    if isinstance(node, ListNode) and leaf.is_number and leaf.rangeable and len(node) == 2:
        return f"; a range is written {{uniform: {show(node)}}}"
    if isinstance(node, ScalarNode) and (guess := _guess_switch(node, leaf)):
        return guess
    value = node.value if isinstance(node, ScalarNode) else None
    if isinstance(value, str):
        return _guess_text(value.strip(), leaf)
    is_channel = leaf.path.endswith("color[]")
    if is_channel and isinstance(value, int | float) and 1 < value <= 255:
        return "; divide 0-255 values by 255"
    return ""


def _switch(node: ScalarNode) -> bool | None:
    """Return True for a word that means on, False for off or null; None for any other."""
    if node.value is None:
        return False
    return _SWITCHES.get(node.text.strip().lower())


def _guess_switch(node: ScalarNode, leaf: Leaf) -> str:
    """Return the hint for a refused word such as `on` or `off`; '' without one."""
    is_on = _switch(node)
    is_number = isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if is_on is None or (leaf.is_number and (is_on or is_number)):
        return ""
    if not is_on and leaf.nullable:
        return "; write null"
    if leaf.is_number:
        return "; write 0" if leaf.accepts(0) else ""
    if leaf.accepts(is_on):
        return f"; write {str(is_on).lower()}"
    word = next((w for w in (_ON_WORDS if is_on else _OFF_WORDS) if w in leaf.allowed_words), None)
    if word is not None:
        return f"; write {word}"
    has_default = leaf.allowed_words and not leaf.info.is_required()
    return f"; leave it out for {leaf.info.default}" if has_default else ""


def guess_section(node: Node, path: str) -> str:
    """Return the hint for a value in the place of the section `path`; '' without one."""
    if path not in SECTIONS or not isinstance(node, ScalarNode):
        return ""
    return "; write null to leave it out" if _switch(node) is False else ""


def _guess_text(text: str, leaf: Leaf) -> str:
    if leaf.allowed_words:
        word = nearest_word(text, leaf.allowed_words)
        return f"; did you mean {word}?" if word else ""
    if leaf.is_number:
        if _DECIMAL_COMMA.fullmatch(text):
            return "; decimals take a point"
        if _NUMBER_WITH_UNIT.fullmatch(text):
            return "; write the number alone"
        with contextlib.suppress(ValueError):
            float(text)
            return "; write it without quotes"
    return ""


def why_no_range(node: MapNode, leaf: Leaf) -> str:
    """Return why a mapping in the place of a value is no range."""
    if not leaf.rangeable:
        return f"must be {leaf.describe_allowed_values()}; it cannot be a range"
    kinds = [key for key in node if key in RANGE_KINDS]
    if len(kinds) == 1:
        return f"{kinds[0]} is for numbers; a range here is {' or '.join(leaf.range_kinds)}"
    for key in node:
        kind = nearest_word(key, RANGE_KINDS)
        if kind is not None and kind != key:
            return f"no range is called {short(key)!r}; did you mean {kind}?"
    ranges = ", ".join(RANGE_KINDS)
    return f"must be {leaf.describe_allowed_values()}, or a range: a mapping with one of {ranges}"


# ---- Keys ----------------------------------------------------------------------------------------


def why_no_key(key: str, section: Section, root: Section) -> str:
    """Return why a section refuses `key`, and the nearest field that it has."""
    if key in RANGE_KINDS:
        return "a range stands for one field, not for a whole section"
    nearest = _nearest_key(key, section, root)
    if nearest is not None:
        leaf = section.leaves.get(nearest)
        unit = f" ({leaf.unit})" if leaf and leaf.unit else ""
        return f"unknown field; did you mean {nearest}{unit}?"
    other_places = [
        (other.path, name)
        for name in dict.fromkeys((key, _synonyms().get(key, key)))
        for other in root.walk()
        if name in other.keys and other is not section
    ]
    places_below = [place for place in other_places if place[0].startswith(f"{section.path}.")]
    if other_places:
        places = [
            join(path, name) if path else f"{name} at the top"
            for path, name in places_below or other_places
        ]
        return f"unknown field here; did you mean {' or '.join(places)}?"
    return f"unknown field; known here: {', '.join(section.keys)}"


def _nearest_key(key: str, section: Section, root: Section) -> str | None:
    fields = section.keys
    name = key.lower().replace("-", "_")
    if name in fields:
        return name
    bases = {_base(field): field for field in fields}
    if _base(name) in bases:  # visibility_km, visibility: the unit is what was wrong
        return bases[_base(name)]
    synonyms = _synonyms()
    for field in (synonyms.get(name), synonyms.get(_base(name))):
        if field in fields:
            return field
    if any(name in other.keys for other in root.walk()):
        return None  # spelt well, but in another place
    base = nearest_word(_base(name), bases)
    return nearest_word(name, fields) or (bases[base] if base else None)


def _synonyms() -> dict[str, str]:
    """Return the field that each synonym stands for, from the models' `synonyms`."""
    pairs = (pair for model in SECTIONS.values() for pair in model.synonyms)
    return {word: key for key, words in pairs for word in words.split()}


def _base(name: str) -> str:
    """Return the name without its unit."""
    return _UNIT.sub("", name) or name
