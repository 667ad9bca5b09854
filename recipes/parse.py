"""A recipe file's tree -> RecipeTemplate, with every problem of the file reported at once."""

from __future__ import annotations

import itertools
import logging
from typing import Any

from pydantic import ValidationError

from recipes.errors import Problems, short
from recipes.fields import ROOT, SectionSpec, join
from recipes.hints import show
from recipes.parse_value import ValueParser
from recipes.schema import VERSION
from recipes.suggest import unknown_key
from recipes.template import RecipeTemplate, readable
from recipes.values import Fixed, Plain, Value, as_number, is_number, words
from recipes.yaml_tree import EMPTY, MapNode, Node, ScalarNode, read_tree

_LOG = logging.getLogger(__name__)


def parse_recipe(text: str, *, source: str, name: str | None = None) -> RecipeTemplate:
    """The template in YAML `text`.

    source: stands before the line number in messages. name: the recipe's name where the text gives
    none; the schema's default without it.

    Raises:
        RecipeError: anything is wrong with the text; one line for each problem.
    """
    problems = Problems(source)
    tree = read_tree(text, problems)
    if isinstance(tree, ScalarNode) and tree.value is None:
        raise problems.fail(1, EMPTY)
    if not isinstance(tree, MapNode):
        raise problems.fail(tree.line, f"a recipe is a mapping of fields; got {show(tree)}")
    _check_version(tree, problems)
    return _Compiler(problems).template(tree, source, name)


def _check_version(tree: MapNode, problems: Problems) -> None:
    """A later format may well rename fields, so nothing else is said about such a file."""
    if "version" not in tree.entries:
        return
    line, node = tree.entries["version"]
    value = node.value if isinstance(node, ScalarNode) else None
    if type(value) is not int or value != VERSION:
        raise problems.fail(
            line, f"version = {show(node)}: this package reads version {VERSION} of the format"
        )


class _Compiler:
    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self._parser = ValueParser(problems)
        self._values: dict[str, Value] = {}
        self._effects: dict[str, float] = {}

    def template(self, tree: MapNode, source: str, file_name: str | None) -> RecipeTemplate:
        """The template of a whole file; raises all that was found wrong."""
        self._section(tree, ROOT, line=1)
        name = self._take("name", file_name)
        if "name" not in tree.entries and not ROOT.fields["name"].accepts(name):
            allowed = ROOT.fields["name"].allowed()
            self._problems.add(
                1,
                f"name: the file's name, {short(str(name))!r}, cannot serve as it; "
                f"add 'name: ...', {allowed}",
            )
        seed, first = int(self._take("seed")), int(self._take("variant"))
        variants = int(self._take("variants"))
        if not ROOT.fields["variant"].accepts(first + variants - 1):
            line = tree.entries["variant"][0]
            self._problems.add(line, f"variant = {first}: too large with variants = {variants}")
        self._problems.raise_if_any()
        self._values.pop("version", None)
        if variants > 1 and not self._differs():
            _LOG.warning(
                "%s: variants = %d, but no field has a range: all have the same numbers",
                source,
                variants,
            )
        values, effects = tuple(self._values.items()), tuple(self._effects.items())
        return RecipeTemplate(str(name), source, seed, variants, first, values, effects)

    def _take(self, key: str, absent: str | None = None) -> Any:
        """The value of a top field, which is no part of what is drawn."""
        value = self._values.pop(key, None)
        if isinstance(value, Fixed):
            return value.value
        return {**ROOT.fields, **ROOT.extra}[key].default if absent is None else absent

    def _differs(self) -> bool:
        drawn = any(value.is_range for value in self._values.values())
        return drawn or any(0 < probability < 1 for probability in self._effects.values())

    def _section(self, node: Node, spec: SectionSpec, line: int) -> None:
        if isinstance(node, ScalarNode) and node.value is None:
            return  # 'weather:' with nothing below it: the section is empty, the effect absent
        if not isinstance(node, MapNode):
            known = ", ".join(spec.known)
            text = f"{spec.path} = {show(node)}: must be a mapping, with {known}"
            self._problems.add(node.line, text)
            return
        found_before = len(self._problems)
        if spec.effect:
            self._effects[spec.path] = 1.0
        given: dict[str, Value] = {}
        for key, (key_line, child) in node.entries.items():
            path = join(spec.path, key)
            if key in spec.sections:
                self._section(child, spec.sections[key], key_line)
            elif key in spec.fields:
                field = spec.fields[key]
                read = self._parser.parse if field.rangeable else self._parser.literal
                value = read(child, field, path)
                if value is not None:
                    given[key] = self._values[path] = value
            elif key in spec.extra:
                self._extra(child, spec, key, path)
            else:
                shown = join(spec.path, short(key))
                self._problems.add(key_line, f"{shown}: {unknown_key(key, spec)}")
        if spec.path and len(self._problems) == found_before:
            self._check_together(spec, given, line)

    def _extra(self, node: Node, spec: SectionSpec, key: str, path: str) -> None:
        value = self._parser.literal(node, spec.extra[key], path)
        if value is None:
            return
        if spec.effect and key == "probability":
            self._effects[spec.path] = as_number(value.value)
        else:
            self._values[path] = value

    def _check_together(self, spec: SectionSpec, given: dict[str, Value], line: int) -> None:
        """The section's own rules, at every combination of its ranges' ends."""
        said: set[str] = set()
        corners = {name: _ends(value) for name, value in given.items()}
        for combination in itertools.product(*corners.values()):
            corner = dict(zip(corners, combination, strict=True))
            try:
                spec.model.model_validate(corner)
            except ValidationError as error:
                ranged = [name for name, value in given.items() if value.is_range]
                drawn = [f"{name} = {words(corner[name])}" for name in ranged]
                where = f" (in a draw with {', '.join(drawn)})" if drawn else ""
                fresh = [text for text in readable(error) if text not in said]
                said.update(fresh)
                for text in fresh:
                    self._problems.add(line, f"{spec.path}: {text}{where}")


def _ends(value: Value) -> list[Plain]:
    """What a rule between fields can depend on: the extreme numbers, null, and every word.

    A handful, so that the product over a section's fields stays in the hundreds. No rule compares
    colours, so one stands for all.
    """
    probes = value.probes()
    numbers = [p for p in probes if is_number(p)]
    colours = [p for p in probes if isinstance(p, tuple)]
    others = [p for p in probes if p is None or isinstance(p, str | bool)]
    ends = [min(numbers), max(numbers)] if numbers else []
    return list(dict.fromkeys([*ends, *colours[:1], *others]))
