"""How messages show what was written, and what they guess was meant."""

from __future__ import annotations

import re

from recipes.errors import short
from recipes.fields import FieldSpec, Kind
from recipes.nearest import nearest_word
from recipes.values import RANGE_KINDS, is_number
from recipes.yaml_tree import ListNode, MapNode, Node, ScalarNode

_YAML_1_1_FLAGS = {"yes": "true", "on": "true", "no": "false", "off": "false"}
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+")
_NUMBER_WITH_UNIT = re.compile(r"[-+]?[0-9.]+\s*[A-Za-z/%]+[0-9]?")


def show(node: Node) -> str:
    """The node as written, on one short line; text that is no number in quotes."""
    if isinstance(node, ScalarNode):
        if node.value is None:
            return "null"
        text = short(node.text)
        return repr(text) if isinstance(node.value, str) else text
    if isinstance(node, ListNode):
        scalars = all(isinstance(item, ScalarNode) for item in node.items)
        if scalars and len(node.items) <= 4:
            return f"[{', '.join(map(show, node.items))}]"
        return f"a list of {len(node.items)}"
    keys = [f"{short(key, 20)}: ..." for key in list(node.entries)[:4]]
    return "{" + ", ".join(keys) + ("}" if len(keys) == len(node.entries) else ", ...}")


def hint(node: ScalarNode, spec: FieldSpec) -> str:
    """What was probably meant, as the end of a message; '' without a guess."""
    value = node.value
    if isinstance(value, str):
        return _text_hint(value.strip(), spec)
    if spec.path == "channel" and is_number(value) and 1 < value <= 255:
        return "; divide 0-255 values by 255"
    return ""


def which_range(node: MapNode, spec: FieldSpec) -> str:
    """Why a mapping in the place of a value is no range."""
    for key in node.entries:
        near = nearest_word(key, RANGE_KINDS)
        if near is not None and near != key:
            return f"no range is called {short(key)!r}; did you mean {near}?"
    ranges = ", ".join(RANGE_KINDS)
    return f"must be {spec.allowed()}, or a range: a mapping with one of {ranges}"


def _text_hint(text: str, spec: FieldSpec) -> str:
    if spec.kind is Kind.FLAG and text.lower() in _YAML_1_1_FLAGS:
        return f"; write {_YAML_1_1_FLAGS[text.lower()]}"
    if spec.words:
        near = nearest_word(text, spec.words)
        return f"; did you mean {near}?" if near else ""
    if spec.kind in (Kind.NUMBER, Kind.WHOLE):
        if _DECIMAL_COMMA.fullmatch(text):
            return "; decimals take a point"
        if _NUMBER_WITH_UNIT.fullmatch(text):
            return "; write the number alone"
        return "; write it without quotes" if _is_quoted_number(text) else ""
    return ""


def _is_quoted_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
