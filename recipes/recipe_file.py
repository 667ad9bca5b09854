"""Reading of a recipe file: its ranges, its checks, and messages that name lines.

The YAML tree becomes plain values and ranges. A few recipes at the ends of the ranges are checked
by `Recipe` itself, and the location of an error there leads back to the line of the YAML. So all
that is allowed is stated in `schema`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Container, Iterator, Mapping
from typing import Annotated, Any

from pydantic import Field, ValidationError
from pydantic_core import ErrorDetails

from recipes.curve import Shape
from recipes.errors import Place, Problems, dotted
from recipes.fields import FilePath, Number
from recipes.guesses import guess_section, guess_value, show, why_no_key, why_no_range
from recipes.ranges import (
    FIELD_KINDS,
    Choice,
    End,
    Location,
    NamedFile,
    Normal,
    Timeline,
    TripleLine,
    Uniform,
    ends,
    faults,
    format_value,
    is_number,
)
from recipes.schema import Recipe
from recipes.sections import Leaf, Section, recipe_file
from recipes.speed import MOVED_FIELDS
from recipes.timeline import TIMELINE, TimeUnit
from recipes.yaml_tree import ListNode, MapNode, Node, ScalarNode, plain

# Largest number of ranges whose values a message about a rule lists.
MAX_LISTED = 4

Case = Mapping[Location, End]  # an end for each field that is no plain value


def read_file(tree: MapNode, problems: Problems) -> dict[str, Any]:
    """Return the values and ranges of the fields that a tree gives, by section.

    Everything that is wrong with the tree is added to `problems`.
    """
    values = _read_mapping(tree, recipe_file())
    if values.pop("timelines", None) is not None:
        text = "timelines: unknown field; write a timeline in the place of the field that changes"
        problems.add(tree["timelines"].place, text)
    messages = _Messages(tree)
    for case in _cases(values):
        try:
            Recipe.model_validate(_data(values, recipe_file(), case))
        except ValidationError as error:
            for item in error.errors(include_url=False):
                messages.add_error(item, case)
    for field in _fields(values, recipe_file()):
        messages.add_faults(*field)
    for place, text in messages.all():
        problems.add(place, text)
    return values


# ---- YAML to values ------------------------------------------------------------------------------


def _read_mapping(node: MapNode, section: Section) -> dict[str, Any]:
    """Return the values of a section. Unknown keys stay, for `Recipe` to refuse."""
    known_keys = [key for key in section.keys if key in node]
    values = {}
    for key in dict.fromkeys((*known_keys, *node)):
        child = node[key]
        if key in section.leaves:
            values[key] = _read_value(child, section.leaves[key])
        elif key not in section.sections:
            values[key] = plain(child)
        elif not _is_null(child):
            # 'weather:' with nothing below it is empty, or an effect that is absent
            values[key] = _read_section(child, section.sections[key])
    return values


def _read_section(node: Node, section: Section) -> Any:
    if section.max_items is None:
        if isinstance(node, ScalarNode) and section.shorthand is not None:
            return {section.shorthand: node.value}
        return _read_mapping(node, section) if isinstance(node, MapNode) else plain(node)
    if not isinstance(node, ListNode):
        return plain(node)
    if len(node) > section.max_items:
        return len(node)  # refused as a whole, and not each of many items
    return [_read_mapping(i, section) if isinstance(i, MapNode) else plain(i) for i in node]


def _read_value(node: Node, leaf: Leaf) -> Any:
    """Return a field's value or range. A mapping that is no range stays one."""
    kind = _range_kind(node, leaf)
    if isinstance(node, MapNode) and kind is not None:
        return _read_range(kind, node, leaf)
    if isinstance(node, ListNode):
        if leaf.channel is not None and len(node) == 3:
            return tuple(_read_value(item, leaf.channel) for item in node)
        return tuple(map(plain, node))
    value = plain(node)
    if leaf.kind is str and isinstance(node, ScalarNode) and value is not None:
        # a name may look like a number
        return NamedFile(node.text, node.place.folder) if leaf.annotation == FilePath else node.text
    is_whole = leaf.kind is float and is_number(value) and abs(value) < 1e300
    return float(value) if is_whole else value  # type: ignore[arg-type]


# ---- Ranges --------------------------------------------------------------------------------------

_MEAN = Leaf("mean", Annotated[Number, Field(allow_inf_nan=False)], rangeable=False)
_STD = Leaf("std", Annotated[Number, Field(gt=0, allow_inf_nan=False)], rangeable=False)
# Parts of a timeline.
TIME = Leaf("time", Annotated[Number, Field(ge=-1e7, le=1e7)])
SHAPE = Leaf("shape", Shape, rangeable=False)
TIMES = Leaf("times", TimeUnit, rangeable=False)
_WEIGHT = Leaf("weight", Annotated[Number, Field(ge=0, le=1e9)], rangeable=False)

Message = tuple[Place, str]


def _range_kind(node: Node, leaf: Leaf) -> str | None:
    """Return the kind of a range; None for any other node, also for a range with a fault."""
    kind = _named_kind(node, leaf)
    return None if kind is None or any(_range_faults(kind, node, leaf, ())) else kind


def _named_kind(node: Node, leaf: Leaf) -> str | None:
    """Return the kind of range that a mapping names, if the field takes it."""
    kinds = [kind for kind in FIELD_KINDS if isinstance(node, MapNode) and kind in node]
    return kinds[0] if len(kinds) == 1 and kinds[0] in leaf.range_kinds else None


def _read_range(kind: str, node: MapNode, leaf: Leaf) -> Any:
    body: Any = node[kind]
    if kind == TIMELINE:
        points = tuple(
            (_read_value(time, TIME), _read_value(value, leaf.point)) for time, value in body
        )
        default_shape = "step" if leaf.only_steps else "linear"
        shape: Any = plain(node["shape"]) if "shape" in node else default_shape
        times: Any = plain(node["times"]) if "times" in node else "seconds"
        return Timeline(points, shape, times, str(node.place))
    if kind == "choice":
        options = tuple(_read_value(option, leaf) for option in body)
        weights: Any = node.get("weights")
        if weights is None:
            return Choice(options, (1.0,) * len(options))
        return Choice(options, tuple(_read_value(weight, _WEIGHT) for weight in weights))
    if kind == "normal":
        parts = {"mean": _MEAN, "std": _STD, "min": leaf.end, "max": leaf.end}
        return Normal(*(_read_value(body[name], part) for name, part in parts.items()))
    low, high = (_read_value(end, leaf.end) for end in body)
    if leaf.channel is not None:
        return TripleLine(low, high)
    return Uniform(low, high, log=kind == "log_uniform")


def _range_faults(kind: str, node: Any, leaf: Leaf, location: Location) -> Iterator[Message]:
    """Yield what is wrong with a range, but for its ends and options: `Recipe` checks those."""
    body: Any = node[kind]
    inside = (*location, kind)
    if kind == TIMELINE:
        yield from _timeline_faults(node, leaf, location)
        return
    keys = (kind, "weights") if kind == "choice" else (kind,)
    yield from _unknown_parts(node, keys, location)
    if kind == "choice":
        if not isinstance(body, ListNode) or not body:
            yield _message(body, inside, "must be a list of at least one option")
        weights = node.get("weights", ListNode(node.place))
        if not isinstance(weights, ListNode):
            yield _message(weights, (*location, "weights"), "must be a list of numbers")
            return
        for i, weight in enumerate(weights):
            yield from _number_faults(weight, _WEIGHT, (*location, "weights", i))
    elif kind == "normal":
        if not isinstance(body, MapNode):
            yield _message(body, inside, "must be a mapping with mean, std, min and max")
            return
        parts = {"mean": _MEAN, "std": _STD, "min": leaf.end, "max": leaf.end}
        yield from _unknown_parts(body, parts, inside)
        for name, part in parts.items():
            if name not in body:
                yield body.place, f"{dotted((*inside, name))}: must be given"
            elif part is not leaf.end or _is_null(body[name]):
                yield from _number_faults(body[name], part, (*inside, name))
    elif not isinstance(body, ListNode) or len(body) != 2:
        text = "[low, high]" if leaf.channel is None else "[from, to], each [red, green, blue]"
        yield _message(body, inside, f"must be {text}")
    else:
        for i, end in enumerate(body):
            value = plain(end)
            if value is None:
                yield from _explain(end, leaf.end, (*inside, i))
            elif kind == "log_uniform" and is_number(value) and value <= 0:
                yield _message(end, (*inside, i), "must be > 0")


def _timeline_faults(node: MapNode, leaf: Leaf, location: Location) -> Iterator[Message]:
    """Yield what is wrong with a timeline, but for its values: `Recipe` checks those."""
    body: Any = node[TIMELINE]
    inside = (*location, TIMELINE)
    yield from _unknown_parts(node, (TIMELINE, "shape", "times"), location, "a timeline")
    for name, part in {"shape": SHAPE, "times": TIMES}.items():
        if name in node:
            yield from _value_faults(node[name], part, (*location, name))
    if "shape" in node and leaf.only_steps and plain(node["shape"]) in ("linear", "smooth"):
        text = "must be step: whole numbers and words have nothing between them"
        yield _message(node["shape"], (*location, "shape"), text)
    if not isinstance(body, ListNode) or not body:
        yield _message(body, inside, "must be a list of at least one point, [time, value]")
        return
    for i, point in enumerate(body):
        if not isinstance(point, ListNode) or len(point) != 2:
            yield _message(point, (*inside, i), "must be a point, [time, value]")
            continue
        time, value = point
        yield from _value_faults(time, TIME, (*inside, i, 0))
        if _is_null(value):
            yield from _explain(value, leaf.point, (*inside, i, 1))


def _value_faults(node: Node, leaf: Leaf, location: Location) -> Iterator[Message]:
    """Yield what is wrong with a value or a range, its ends included."""
    value = _read_value(node, leaf)
    for end in ends(value):
        if not leaf.end.accepts(end.value):
            inner = end.parts.get((), ())
            at_end = leaf.end if inner else leaf
            yield from _explain(_node_at(node, inner), at_end, (*location, *inner))


def _unknown_parts(
    node: MapNode, keys: Container[str], location: Location, kind: str = "a range"
) -> Iterator[Message]:
    for key, part in node.items():
        if key not in keys:
            yield part.place, f"{dotted((*location, key))}: no part of {kind}"


def _number_faults(node: Node, leaf: Leaf, location: Location) -> Iterator[Message]:
    if isinstance(node, MapNode | ListNode) or not leaf.accepts(node.value):
        yield from _explain(node, leaf, location)


def _message(node: Node, location: Location, text: str) -> Message:
    return node.place, f"{dotted(location)} = {show(node)}: {text}"


def _is_null(node: Node) -> bool:
    return isinstance(node, ScalarNode) and node.value is None


# ---- Recipes at the ends -------------------------------------------------------------------------


def _fields(
    value: Any, section: Section, location: Location = ()
) -> Iterator[tuple[Location, Section, Any]]:
    """Yield the location, the section and the value of every field that is given."""
    if isinstance(value, list):
        for i, item in enumerate(value):
            yield from _fields(item, section, (*location, i))
    elif isinstance(value, dict):
        for key, item in value.items():
            if key in section.leaves:
                yield (*location, key), section, item
            elif key in section.sections:
                yield from _fields(item, section.sections[key], (*location, key))


def _cases(values: dict[str, Any]) -> Iterator[Case]:
    """Yield ends of all fields, such that each end is tried.

    The first case takes the first end of every range, the next the second end, until the last has
    the last end of all. Pairs of ends follow, within sections that have rules between fields.
    """
    fields = {
        location: (section, ends(value))
        for location, section, value in _fields(values, recipe_file())
    }
    for row in range(max((len(few) for _, few in fields.values()), default=1)):
        yield {location: few[min(row, len(few) - 1)] for location, (_, few) in fields.items()}
    first_ends = {location: few[0] for location, (_, few) in fields.items()}
    ranges_of: dict[Location, dict[Location, list[End]]] = {}
    for location, (section, few) in fields.items():
        if len(few) > 1 and section.has_rules:
            leaf = section.leaves[str(location[-1])]
            ranges_of.setdefault(location[:-1], {})[location] = _telling_ends(few, leaf)
    for ranges in ranges_of.values():
        for pair in itertools.combinations(ranges, 2):
            for combination in itertools.product(*(ranges[location] for location in pair)):
                yield first_ends | dict(zip(pair, combination, strict=True))


def _telling_ends(field_ends: list[End], leaf: Leaf) -> list[End]:
    """Return the ends on which a rule between fields can depend: extreme numbers, null, each word.

    No rule compares colours or names of files, so that one of them is enough.
    """
    numbers = sorted((e for e in field_ends if is_number(e.value)), key=lambda end: end.value)
    words: dict[object, End] = {}
    for end in field_ends:
        if not is_number(end.value):
            is_word = end.value is None or (
                leaf.kind is not str and isinstance(end.value, str | bool)
            )
            words.setdefault(end.value if is_word else type(end.value), end)
    return [*numbers[:1], *numbers[1:][-1:], *words.values()]


def _data(value: Any, section: Section, case: Case, location: Location = ()) -> Any:
    """Return what `Recipe` is to check: plain mappings, lists and values."""
    if location in case:
        return case[location].value
    if isinstance(value, list):
        return [_data(item, section, case, (*location, i)) for i, item in enumerate(value)]
    if isinstance(value, dict):
        return {
            key: _data(item, section.sections.get(key, section), case, (*location, key))
            for key, item in value.items()
            if key not in section.file_keys
        }
    return value


# ---- Messages ------------------------------------------------------------------------------------


class _Messages:
    """Everything that is wrong with a tree, each thing once."""

    def __init__(self, tree: MapNode) -> None:
        self._tree = tree
        self._fields: dict[Message, Location] = {}
        self._rules: dict[tuple[Location, str], Message] = {}

    def add_error(self, item: ErrorDetails, case: Case) -> None:
        """Add an error of pydantic's, met with the ends of `case`."""
        section, leaf, location = _resolve(item["loc"])
        is_missing = item["type"] == "missing"
        if is_missing and isinstance(location[-1], int):  # a colour of two channels
            section, leaf, location = _resolve(location[:-1])
            is_missing = False
        in_file = _in_file(location, case)
        node = _node_at(self._tree, in_file)
        path = dotted(in_file)
        if item["type"] == "extra_forbidden":
            why = why_no_key(str(location[-1]), section, recipe_file())
            if path in MOVED_FIELDS:
                why = f"has moved; write {MOVED_FIELDS[path]}"
            messages = [(node.place, f"{path}: {why}")]
        elif leaf is not None and is_missing:
            allowed = leaf.describe_allowed_values()
            messages = [(node.place, f"{path}: must be given, {allowed}")]
        elif leaf is not None:
            is_end = not {"uniform", "log_uniform", "normal"}.isdisjoint(in_file)
            messages = _explain(node, leaf.end if is_end else leaf, in_file)
        elif item["type"] == "value_error":
            text = str(item.get("ctx", {})["error"])
            # The same rule with other numbers is the same fault.
            key = (location, re.sub(r"[0-9.e+-]+", "0", text))
            text = f"{path}: {text}{_describe_case(location, case)}"
            self._rules.setdefault(key, (node.place, text))
            return
        else:
            messages = [_message(node, in_file, _no_section(node, section, location))]
        for message in messages:
            self._fields.setdefault(message, location)

    def add_faults(self, location: Location, section: Section, value: Any) -> None:
        """Add what `Recipe` cannot see in a field whose ends it takes."""
        if self._is_in(location):
            return
        leaf = section.leaves[str(location[-1])]
        if location[-1] in section.file_keys and not leaf.accepts(value):
            for message in _explain(_node_at(self._tree, location), leaf, location):
                self._fields.setdefault(message, location)
            return
        for part, text in faults(value):
            in_file = (*location, *part)
            message = _message(_node_at(self._tree, in_file), in_file, text)
            self._fields.setdefault(message, location)

    def _is_in(self, location: Location) -> bool:
        """Return True if a fault is at the location or below it."""
        return any(other[: len(location)] == location for other in self._fields.values())

    def all(self) -> Iterator[Message]:
        """Yield place and text of each. A rule between fields counts if the fields are right."""
        yield from self._fields
        for (location, _), message in self._rules.items():
            if not self._is_in(location):
                yield message


def _resolve(location: Location) -> tuple[Section, Leaf | None, Location]:
    """Return the section and the leaf at a location of pydantic's, and the location up to there.

    The leaf is None at a section, and at a key that the section does not know.
    """
    section = recipe_file()
    for depth, part in enumerate(location):
        if isinstance(part, int):
            continue
        if part not in section.sections:
            leaf = section.leaves.get(part)
            end = depth + 1
            channel = leaf.channel if leaf is not None else None
            if channel is not None and len(location) > end and isinstance(location[end], int):
                return section, channel, location[: end + 1]
            return section, leaf, location[:end]
        section = section.sections[part]
    return section, None, location


def _in_file(location: Location, case: Case) -> Location:
    """Return where a value of the case is written: with the parts of ranges."""
    for depth in range(1, len(location) + 1):
        if (end := case.get(location[:depth])) is not None:
            channel = location[depth:]
            parts = end.parts.get((), ()), channel, end.parts.get(channel, ()) if channel else ()
            return (*location[:depth], *itertools.chain(*parts))
    return location


def _node_at(tree: Node, location: Location) -> Node:
    """Return the node at a location, or the nearest one above it."""
    node = tree
    for part in location:
        if isinstance(node, MapNode) and part in node:
            node = node[str(part)]
        elif isinstance(node, ListNode) and isinstance(part, int) and part < len(node):
            node = node[part]
        else:
            break
    return node


def _describe_case(location: Location, case: Case) -> str:
    """Return the values of the ranges in a section, as the end of a message."""
    depth = len(location)
    texts = [
        f"{dotted(path[depth:])} = {format_value(end.value)}"
        for path, end in case.items()
        if end.parts and path[:depth] == location
    ]
    if len(texts) > MAX_LISTED:
        texts[MAX_LISTED:] = ["..."]
    return f" (in a draw with {', '.join(texts)})" if texts else ""


def _no_section(node: Node, section: Section, location: Location) -> str:
    """Return what should stand in the place of a node that is no section."""
    keys = ", ".join(section.keys)
    if section.max_items is not None and not isinstance(location[-1], int):
        return f"must be a list of up to {section.max_items} mappings, each with {keys}; or null"
    return f"must be a mapping, with {keys}{guess_section(node, dotted(location))}"


def _explain(node: Node, leaf: Leaf, location: Location) -> Iterator[Message]:
    """Yield why a field or an end refuses a node."""
    kind = _named_kind(node, leaf)
    if kind is not None:
        yield from _range_faults(kind, node, leaf, location)
    elif isinstance(node, MapNode):
        yield _message(node, location, why_no_range(node, leaf))
    else:
        allowed = leaf.describe_allowed_values(_read_value(node, leaf))
        yield _message(node, location, f"must be {allowed}{guess_value(node, leaf)}")
