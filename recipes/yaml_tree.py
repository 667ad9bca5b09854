"""YAML text as mappings, lists and scalars that know where they were written.

No object of YAML's choice is ever built, and depth and size are limited whatever the text. Scalars
follow YAML 1.2's core schema; keys are always text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
)
from ruamel.yaml.reader import ReaderError

from recipes.errors import Place, Problems, short

# Largest depth of nesting.
MAX_DEPTH = 32
# Largest number of nodes, counted after aliases are expanded, so that nested aliases cannot
# multiply.
MAX_NODES = 20_000
# A longer run of digits is no number that any field takes.
MAX_DIGITS = 400

_WHOLE = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WORDS: dict[str, bool | float | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf", "+.Inf", "+.INF"), float("inf")),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), float("-inf")),
}

ScalarValue = bool | int | float | str | None
PlainValue = ScalarValue | list["PlainValue"] | dict[str, "PlainValue"]


@dataclass(frozen=True, eq=False)
class ScalarNode:
    """Scalar of a tree. text: as written, without quotes. value: its meaning."""

    place: Place
    text: str
    value: ScalarValue


class ListNode(list["Node"]):
    def __init__(self, place: Place, items: list[Node] | None = None) -> None:
        super().__init__(items or ())
        self.place = place


class MapNode(dict[str, "Node"]):
    """Mapping of a tree. The value of a key has the place of that key."""

    def __init__(self, place: Place, entries: dict[str, Node] | None = None) -> None:
        super().__init__(entries or {})
        self.place = place


Node = ScalarNode | ListNode | MapNode


def read_tree(text: str, place: Place, problems: Problems, *, empty: str) -> Node:
    """Return the tree of the one document in `text`. Duplicate keys are added to `problems`.

    place: place of the text's first line.

    Raises:
        RecipeError: the text is not YAML, is YAML that a recipe may not use, or is empty (`empty`
            is the message).
    """
    tree = None
    events = _events(text, place)
    for event in events:
        if isinstance(event, DocumentStartEvent):
            if tree is not None:
                raise _place(place, event).error("one document a file: remove the second '---'")
            tree = _Reader(events, place, problems).node(next(events))
    if tree is None:
        raise place.error(empty)
    return tree


def read_plain(text: str, *, source: str) -> PlainValue:
    """Return YAML text as plain mappings, lists and scalars; RecipeError as for read_tree."""
    problems = Problems()
    tree = read_tree(text, Place(source), problems, empty="the file is empty")
    problems.raise_if_any()
    return plain(tree)


def plain(node: Node) -> PlainValue:
    """Return a tree without its lines."""
    if isinstance(node, MapNode):
        return {key: plain(value) for key, value in node.items()}
    if isinstance(node, ListNode):
        return [plain(item) for item in node]
    return node.value


def plain_value(text: str) -> ScalarValue:
    """Return the value of an unquoted scalar by YAML 1.2's core schema."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) <= MAX_DIGITS:
        if _WHOLE.fullmatch(text):
            base = {"0o": 8, "0x": 16}.get(text[:2], 10)
            return int(text, base)
        if _NUMBER.fullmatch(text):
            return float(text)
    return text


class _Reader:
    """Recursive reader of a tree, at most MAX_DEPTH deep."""

    def __init__(self, events: Iterator[Event], place: Place, problems: Problems) -> None:
        self._events = events
        self._place = place
        self._problems = problems
        self._anchors: dict[str, Node] = {}
        self._count = 0

    def node(
        self, event: Event, *, place: Place | None = None, path: str = "", depth: int = 1
    ) -> Node:
        """Return the node that begins with `event`. place: of the key above it, if there is one."""
        event_place = _place(self._place, event)
        place = place or event_place
        if isinstance(event, AliasEvent):
            if (node := self._anchors.get(event.anchor)) is None:
                raise event_place.error(
                    f"*{short(event.anchor)} refers to no anchor that ends above it"
                )
            self._count_nodes(node, event_place, depth)
            return node
        self._count_node(event_place, depth)
        assert isinstance(event, ScalarEvent | CollectionStartEvent)
        if event.tag is not None:
            raise event_place.error(f"the tag {short(str(event.tag))!r}: tags are not allowed")
        if isinstance(event, ScalarEvent):
            check_text(event.value, place)
            value = plain_value(event.value) if event.implicit[0] else event.value
            node = ScalarNode(place, event.value, value)
        elif isinstance(event, SequenceStartEvent):
            node = ListNode(place)
            while not isinstance(event_of_item := next(self._events), SequenceEndEvent):
                item_path = f"{path}[{len(node)}]"
                node.append(self.node(event_of_item, path=item_path, depth=depth + 1))
        else:
            node = MapNode(place)
            while not isinstance(event_of_key := next(self._events), MappingEndEvent):
                self._read_entry(node, event_of_key, path, depth)
        if event.anchor is not None:
            self._anchors[event.anchor] = node
        return node

    def _read_entry(self, into: MapNode, event: Event, path: str, depth: int) -> None:
        place = _place(self._place, event)
        self._count_node(place, depth)
        if not isinstance(event, ScalarEvent) or event.tag is not None:
            raise place.error("a key must be plain text, not a list, a mapping or an alias")
        key = event.value
        check_text(key, place)
        if key == "<<":
            text = "merge keys (<<) are not read; write the fields out, or use *alias as a value"
            raise place.error(text)
        entry_path = f"{path}.{short(key)}" if path else short(key)
        value = self.node(next(self._events), place=place, path=entry_path, depth=depth + 1)
        if key in into:
            first_line = into[key].place.line
            self._problems.add(place, f"{entry_path} is given twice (first on line {first_line})")
        else:
            into[key] = value

    def _count_node(self, place: Place, depth: int) -> None:
        self._count += 1
        if self._count > MAX_NODES:
            raise place.error(f"more than {MAX_NODES} values, aliases expanded")
        if depth > MAX_DEPTH:
            raise place.error(f"nested more than {MAX_DEPTH} levels deep")

    def _count_nodes(self, node: Node, place: Place, depth: int) -> None:
        self._count_node(place, depth)
        items = node.values() if isinstance(node, MapNode) else node
        for item in () if isinstance(items, ScalarNode) else items:
            self._count_nodes(item, place, depth + 1)


def check_text(text: str, place: Place) -> None:
    """Refuse text that no file can hold as UTF-8.

    This is an escape of half a surrogate, or bytes of a command line in another encoding.

    Raises:
        RecipeError: the text is such.
    """
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise place.error(
            f"{short(text)} holds {text[error.start]!a}, which is no character; write it in UTF-8"
        ) from None


def _place(place: Place, event: Event) -> Place:
    """Return the place of an event. place: place of the text's first line."""
    if place.line is None:
        return place
    return replace(place, line=place.line + event.start_mark.line)


def _events(text: str, place: Place) -> Iterator[Event]:
    """Yield the parser's events, with its errors turned into ours."""
    try:
        yield from YAML(typ="safe", pure=True).parse(text)
    except ReaderError as error:
        line = text.count("\n", 0, error.position)
        raise _invalid(place, line, f"it holds the character U+{error.character:04X}") from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line if mark else 0
        problem = short(" ".join(filter(None, (error.context, error.problem))), 160)
        tab = "\t" in "".join(text.splitlines()[line : line + 1])
        hint = "; the line holds a tab: indent and separate with spaces" if tab else ""
        raise _invalid(place, line, problem + hint) from None
    except (YAMLError, ValueError, OverflowError) as error:
        # The parser lets chr() and int() raise on escapes and directives that are out of range.
        raise _invalid(place, 0, short(str(error), 160)) from None


def _invalid(place: Place, line: int, problem: str) -> Exception:
    if place.line is not None:
        place = replace(place, line=place.line + line)
    return place.error(f"not valid YAML: {problem}")
