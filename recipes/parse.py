"""A recipe file's tree -> RecipeTemplate, with every problem of the file reported at once."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from recipes.errors import Problems, short
from recipes.fields import ROOT, ListSpec, SectionSpec, join
from recipes.hints import show
from recipes.parse_value import ValueParser
from recipes.rules import Items, broken_rules
from recipes.schema import VERSION
from recipes.suggest import unknown_key
from recipes.template import RecipeTemplate
from recipes.values import Fixed, Value, as_number
from recipes.yaml_tree import EMPTY, ListNode, MapNode, Node, ScalarNode, read_tree

_LOG = logging.getLogger(__name__)


def parse_recipe(
    text: str, *, source: str, name: str | None = None, folder: Path | None = None
) -> RecipeTemplate:
    """The template in YAML `text`.

    source: stands before the line number in messages. name: the recipe's name where the text gives
    none; the schema's default without it. folder: where the files that the text names lie; without
    it, it can name none.

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
    return _Compiler(problems, folder).template(tree, source, name)


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
    def __init__(self, problems: Problems, folder: Path | None) -> None:
        self._problems, self._folder = problems, folder
        self._parser = ValueParser(problems, folder)
        self._values: dict[str, Value] = {}
        self._effects: dict[str, float] = {}
        self._lists: dict[str, int] = {}

    def template(self, tree: MapNode, source: str, file_name: str | None) -> RecipeTemplate:
        """The template of a whole file; raises all that was found wrong."""
        self._section(tree, ROOT, "", line=1)
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
        return RecipeTemplate(
            name=str(name),
            source=source,
            seed=seed,
            variants=variants,
            first_variant=first,
            values=tuple(self._values.items()),
            effects=tuple(self._effects.items()),
            lists=tuple(self._lists.items()),
            folder=self._folder,
        )

    def _take(self, key: str, absent: str | None = None) -> Any:
        """The value of a top field, which is no part of what is drawn."""
        value = self._values.pop(key, None)
        if isinstance(value, Fixed):
            return value.value
        return {**ROOT.fields, **ROOT.extra}[key].default if absent is None else absent

    def _differs(self) -> bool:
        drawn = any(value.is_range for value in self._values.values())
        return drawn or any(0 < probability < 1 for probability in self._effects.values())

    def _section(
        self, node: Node, spec: SectionSpec, path: str, line: int
    ) -> dict[str, Value | Items]:
        """Read a mapping; its fields' values, for the rules of the section that holds it.

        path: the section's, with numbers in place of the [] of lists. line: the one of its key.
        """
        given: dict[str, Value | Items] = {}
        if isinstance(node, ScalarNode) and node.value is None and spec.items is None:
            return given  # 'weather:' with nothing below it: it is empty, an effect absent
        if isinstance(node, ScalarNode) and spec.shorthand is not None:
            value = self._parser.literal(node, spec.fields[spec.shorthand].without_null, path)
            if value is not None:
                given[spec.shorthand] = self._values[join(path, spec.shorthand)] = value
            return given
        if not isinstance(node, MapNode):
            known = ", ".join(spec.known)
            text = f"{path} = {show(node)}: must be a mapping, with {known}"
            self._problems.add(node.line, text)
            return given
        found_before = len(self._problems)
        if spec.effect:
            self._effects[path] = 1.0
        for key, (key_line, child) in node.entries.items():
            value = self._entry(child, spec, key, join(path, key), key_line)
            if value is not None:
                given[key] = value
        for name, field in spec.fields.items():
            if field.required and name not in node.entries:
                self._problems.add(line, f"{join(path, name)}: must be given, {field.allowed()}")
        if path and len(self._problems) == found_before:
            for text in broken_rules(spec, given):
                self._problems.add(line, f"{path}: {text}")
        return given

    def _entry(
        self, node: Node, spec: SectionSpec, key: str, path: str, line: int
    ) -> Value | Items | None:
        """Read what stands under a key; None where the section's rules do not ask for it."""
        below = spec.sections.get(key)
        if below is not None and below.items is not None:
            return self._list(node, below, below.items, path)
        if below is not None:
            self._section(node, below, path, line)
        elif key in spec.fields:
            field = spec.fields[key]
            read = self._parser.parse if field.rangeable else self._parser.literal
            value = read(node, field, path)
            if value is not None:
                self._values[path] = value
            return value
        elif key in spec.extra:
            self._extra(node, spec, key, path)
        else:
            shown = path.removesuffix(key) + short(key)
            self._problems.add(line, f"{shown}: {unknown_key(key, spec)}")
        return None

    def _list(self, node: Node, spec: SectionSpec, items: ListSpec, path: str) -> Items | None:
        if isinstance(node, ScalarNode) and node.value is None:
            return None
        if not isinstance(node, ListNode) or len(node.items) > items.most:
            known = ", ".join(spec.known)
            allowed = f"a list of up to {items.most} mappings, each with {known}; or null"
            self._problems.add(node.line, f"{path} = {show(node)}: must be {allowed}")
            return None
        self._lists[path] = len(node.items)
        mappings = [
            self._section(item, spec, f"{path}[{index}]", item.line)
            for index, item in enumerate(node.items)
        ]
        return Items(tuple(mappings))

    def _extra(self, node: Node, spec: SectionSpec, key: str, path: str) -> None:
        value = self._parser.literal(node, spec.extra[key], path)
        if value is None:
            return
        if spec.effect and key == "probability":
            self._effects[spec.path] = as_number(value.value)
        else:
            self._values[path] = value
