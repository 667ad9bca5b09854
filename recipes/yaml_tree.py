"""YAML text -> a small tree that remembers lines; no object of YAML's choice is ever built.

The tree is built from PyYAML's events, without recursion, so that depth and size are bounded
whatever the text. Scalars follow YAML 1.2's core schema; keys are always text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import yaml

from recipes.errors import Problems, short

MAX_DEPTH = 32
MAX_NODES = 20_000  # counted after aliases are expanded, so nested aliases cannot multiply
EMPTY = "the file is empty; a recipe is a mapping such as 'weather: {smog: {visibility_m: 300}}'"
MAX_DIGITS = 400  # a longer run of digits is no number that any field takes

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
    """text: as written, without quotes. value: what it means."""

    line: int
    text: str
    value: ScalarValue
    size: int = 1
    height: int = 1


@dataclass(eq=False)
class ListNode:
    """size: how many nodes it has, aliases expanded. height: how many levels."""

    line: int
    items: list[Node] = field(default_factory=list)
    size: int = 1
    height: int = 1


@dataclass(eq=False)
class MapNode:
    """entries: key -> (line of the key, value), in the order of the file."""

    line: int
    entries: dict[str, tuple[int, Node]] = field(default_factory=dict)
    size: int = 1
    height: int = 1


Node = ScalarNode | ListNode | MapNode


@dataclass
class _Open:
    """A list or mapping whose end has not been read. key: line and text of the one before."""

    node: ListNode | MapNode
    anchor: str | None
    key: tuple[int, str] | None = None


def read_tree(text: str, problems: Problems, *, empty: str = EMPTY) -> Node:
    """The tree of the one document in `text`; duplicate keys are added to `problems`.

    Raises:
        RecipeError: not YAML, YAML that a recipe may not use, or nothing (`empty` says so).
    """
    tree = _Builder(problems).build(_events(text, problems))
    if tree is None:
        raise problems.fail(1, empty)
    return tree


def read_plain(text: str, *, source: str) -> PlainValue:
    """What YAML says as mappings, lists and scalars; RecipeError as for read_tree."""
    problems = Problems(source)
    tree = read_tree(text, problems, empty="the file is empty")
    problems.raise_if_any()
    return plain(tree)


def plain(node: Node) -> PlainValue:
    """A tree without its lines."""
    if isinstance(node, MapNode):
        return {key: plain(value) for key, (_, value) in node.entries.items()}
    if isinstance(node, ListNode):
        return [plain(item) for item in node.items]
    return node.value


def plain_value(text: str) -> ScalarValue:
    """What an unquoted scalar means in YAML 1.2's core schema."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) <= MAX_DIGITS:
        if _WHOLE.fullmatch(text):
            base = {"0o": 8, "0x": 16}.get(text[:2], 10)
            return int(text, base)
        if _NUMBER.fullmatch(text):
            return float(text)
    return text


class _Builder:
    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self._open: list[_Open] = []
        self._anchors: dict[str, Node | None] = {}  # None: named, but its end has not been read
        self._root: Node | None = None

    def build(self, events: Iterator[yaml.Event]) -> Node | None:
        documents = 0
        for event in events:
            line = event.start_mark.line + 1
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise self._problems.fail(line, "one document a file: remove the second '---'")
            elif isinstance(event, yaml.AliasEvent):
                node = self._anchors.get(event.anchor)
                if node is None:
                    is_open = event.anchor in self._anchors
                    wrong = "stands inside its own" if is_open else "refers to no"
                    end = "" if is_open else " above it"
                    text = f"*{short(event.anchor)} {wrong} anchor{end}"
                    raise self._problems.fail(line, text)
                self._attach(line, node)
            elif isinstance(event, yaml.CollectionEndEvent):
                done = self._open.pop()
                if done.anchor is not None:
                    self._anchors[done.anchor] = done.node
                self._attach(done.node.line, done.node)
            elif isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent):
                self._start(line, event)
        return self._root

    def _start(self, line: int, event: yaml.ScalarEvent | yaml.CollectionStartEvent) -> None:
        if event.tag is not None:
            text = f"the tag {short(str(event.tag))!r}: tags are not allowed"
            raise self._problems.fail(line, text)
        if isinstance(event, yaml.ScalarEvent):
            value = plain_value(event.value) if event.implicit[0] else event.value
            node = ScalarNode(line, event.value, value)
            if event.anchor is not None:
                self._anchors[event.anchor] = node
            self._attach(line, node)
            return
        if event.anchor is not None:
            self._anchors[event.anchor] = None
        if len(self._open) >= MAX_DEPTH:
            raise self._problems.fail(line, f"nested more than {MAX_DEPTH} levels deep")
        kind = MapNode if isinstance(event, yaml.MappingStartEvent) else ListNode
        self._open.append(_Open(kind(line), event.anchor))

    def _attach(self, line: int, node: Node) -> None:
        if not self._open:
            self._root = node
            return
        level, parent = self._open[-1], self._open[-1].node
        parent.size += node.size
        parent.height = max(parent.height, 1 + node.height)
        if parent.size > MAX_NODES:
            raise self._problems.fail(line, f"more than {MAX_NODES} values, aliases expanded")
        if parent.height > MAX_DEPTH:
            raise self._problems.fail(line, f"nested more than {MAX_DEPTH} levels deep")
        if isinstance(parent, ListNode):
            parent.items.append(node)
        elif level.key is None:
            level.key = (line, self._key_text(line, node))
        else:
            (key_line, key), level.key = level.key, None
            self._insert(parent, key_line, key, node)

    def _key_text(self, line: int, node: Node) -> str:
        if not isinstance(node, ScalarNode):
            raise self._problems.fail(line, "a key must be plain text, not a list or a mapping")
        if node.text == "<<":
            text = "merge keys (<<) are not read; write the fields out, or use *alias as a value"
            raise self._problems.fail(line, text)
        return node.text

    def _insert(self, parent: MapNode, line: int, key: str, node: Node) -> None:
        if key in parent.entries:
            first = parent.entries[key][0]
            above = [level.key[1] for level in self._open if level.key is not None]
            path = ".".join(short(part) for part in [*above, key])
            self._problems.add(line, f"{path} is given twice (first on line {first})")
        else:
            parent.entries[key] = (line, node)


def _events(text: str, problems: Problems) -> Iterator[yaml.Event]:
    """PyYAML's events, its errors turned into ours."""
    try:
        yield from yaml.parse(text, Loader=yaml.SafeLoader)
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        code = error.character if isinstance(error.character, int) else ord(error.character)
        raise problems.fail(line, f"not valid YAML: it holds the character U+{code:04X}") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        what = " ".join(filter(None, (error.context, error.problem)))
        hint = _tab_hint(text, line)
        raise problems.fail(line, f"not valid YAML: {short(what, 160)}{hint}") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # PyYAML lets chr() and int() raise on escapes and directives that are out of range.
        raise problems.fail(1, f"not valid YAML: {short(str(error), 160)}") from None


def _tab_hint(text: str, line: int) -> str:
    lines = text.splitlines()
    written = lines[line - 1] if line <= len(lines) else ""
    if "\t" in written:
        return "; the line holds a tab: indent and separate with spaces"
    return ""
