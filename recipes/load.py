"""Loading of recipes from files and presets, with every problem reported at once."""

from __future__ import annotations

import functools
import io
import json
import logging
import operator
from collections.abc import Iterable, Mapping
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.nodes import Node as YamlNode
from ruamel.yaml.representer import SafeRepresenter

from recipes.errors import Place, Problems, RecipeError, did_you_mean, short
from recipes.fields import packaged_names, packaged_text
from recipes.files import file_below, open_file
from recipes.guesses import show
from recipes.ranges import is_number
from recipes.recipe_file import read_file
from recipes.schema import VERSION, Recipe, free_knobs, idle_speed_knobs
from recipes.sections import Section, recipe_file
from recipes.speed import MOVED_FIELDS
from recipes.template import RecipeTemplate
from recipes.yaml_tree import MapNode, Node, ScalarNode, check_text, read_tree

_LOG = logging.getLogger(__name__)

# Largest recipe file, bytes. A recipe is a page of text; a bigger file is something else.
MAX_BYTES = 65_536
# Message about an empty file.
EMPTY = "the file is empty; a recipe is a mapping such as 'weather: {smog: {visibility_m: 300}}'"

# Beginning of a recipe in numbers, as jobs leave it beside their images.
_NUMBERS_HEADER = "# A recipe in numbers, hash "

Overrides = Mapping[str, object]  # dotted path -> what replaces the field: a Node, or plain YAML


# ---- Files and presets ---------------------------------------------------------------------------


def load_recipe(
    path_or_preset_name: str | Path, overrides: Overrides | None = None
) -> RecipeTemplate:
    """Return the template in a file, or the preset of that name.

    A text that names a preset is the preset (write ./NAME for a file of that name). Any other text,
    and every Path, is a file. A file's stem is the recipe's name unless the file gives one.
    overrides: fields that replace those of the file.

    Raises:
        RecipeError: the file or preset does not exist, holds no valid recipe, or names a file that
            cannot be read.
    """
    text, place, name = _read(path_or_preset_name)
    return _template(text, place, name, overrides)


def recipe_text(path_or_preset_name: str | Path) -> str:
    """Return the YAML of a file or a preset, as a start for a user's own.

    Raises:
        RecipeError: there is no such file or preset.
    """
    return _read(path_or_preset_name)[0]


def parse_recipe(
    text: str,
    *,
    source: str,
    name: str | None = None,
    folder: Path | None = None,
    overrides: Overrides | None = None,
) -> RecipeTemplate:
    """Return the template in YAML `text`.

    Args:
        text: the YAML.
        source: words before the line number in messages.
        name: name of the recipe if the text gives none.
        folder: folder of the files that the text names. Without it, it can name none.
        overrides: fields that replace those of the text.

    Raises:
        RecipeError: the text has faults; one line for each problem.
    """
    return _template(text, Place(source, folder=folder), name, overrides)


def read_overrides(
    texts: Iterable[str], option: str = "--set", folder: Path | None = None
) -> dict[str, Node]:
    """Return the overrides of a command line, such as `weather.smog.visibility_m=60`.

    Files are named from `folder`, or else the working folder.

    Raises:
        RecipeError: one is not PATH=VALUE, or its value is no YAML.
    """
    overrides = {}
    for text in texts:
        path, equals, value = text.partition("=")
        place = Place(f"{option} {short(text, 100)}", None, folder or Path())
        if not equals or not path.strip():
            raise place.error("write PATH=VALUE, as in weather.smog.visibility_m=60")
        check_text(path, place)
        overrides[path.strip()] = _value_node(value, place)
    return overrides


def preset_names() -> tuple[str, ...]:
    """Return the names of the recipes that come with the package, in alphabetical order."""
    return packaged_names("presets")


def describe_preset(name: str) -> str:
    """Return the purpose of a preset: the first line of its comment."""
    return packaged_text("presets", name).partition("\n")[0].removeprefix("# ")


def _read(path_or_preset_name: str | Path) -> tuple[str, Place, str]:
    """Return the text of a file or preset, its place, and the name that it gives the recipe."""
    source = str(path_or_preset_name)
    if path_or_preset_name in preset_names():
        return packaged_text("presets", source), Place(f"preset {source}"), source
    path = Path(path_or_preset_name)
    names = preset_names()
    missing = f"no such file, and no such preset; {did_you_mean(source, names)}presets are "
    missing += ", ".join(names)
    text = read_text(path, MAX_BYTES, missing=missing, too_large="this is no recipe")
    return text, Place(source, folder=path.parent), path.stem


def read_text(path: Path, max_bytes: int, *, missing: str, too_large: str) -> str:
    """Read a file's text. missing, too_large: messages for these cases.

    Raises:
        RecipeError: the file does not exist, or cannot be read as text.
    """
    source = str(path)
    try:
        with open_file(path) as file:
            data = file.read(max_bytes + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise RecipeError(f"{source}: {missing}") from None
    except IsADirectoryError:
        raise RecipeError(f"{source}: is a folder, not a YAML file") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise RecipeError(f"{source!a}: cannot be read: {error}") from None
    if len(data) > max_bytes:
        raise RecipeError(f"{source}: larger than {max_bytes} bytes: {too_large}")
    try:
        return data.decode("utf-8-sig")  # some editors begin with a byte order mark
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        text = f"not UTF-8 text (byte 0x{data[error.start]:02x}): save the file as UTF-8"
        raise RecipeError(f"{source}:{line}: {text}") from None


# ---- Text -> template ----------------------------------------------------------------------------


def _template(
    text: str, place: Place, name: str | None, overrides: Overrides | None
) -> RecipeTemplate:
    problems = Problems()
    tree = _read_mapping(text, place, problems)
    for path, value in (overrides or {}).items():
        tree = _merge_trees(tree, _override(path, value), recipe_file())
    _check_version(tree)
    if name is not None and "name" not in tree:
        tree["name"] = ScalarNode(place, name, name)
        if not recipe_file().leaves["name"].accepts(name):
            problems.add(place, "the file's name cannot serve as the recipe's; add 'name: ...'")
    fields = read_file(_with_parents(tree, place, problems), problems)
    problems.raise_if_any()
    top = {key: fields.pop(key, leaf.info.default) for key, leaf in recipe_file().leaves.items()}
    last_variant = top["variant"] + top["variants"] - 1
    if not recipe_file().leaves["variant"].accepts(last_variant):
        text = f"variant = {top['variant']}: too large with variants = {top['variants']}"
        raise tree["variant"].place.error(text)
    template = RecipeTemplate(
        name=top["name"],
        source=place.source,
        seed=top["seed"],
        variants=top["variants"],
        first_variant=top["variant"],
        field_values=fields,
    )
    if template.variants > 1 and not template.describe_ranges():
        text = "%s: variants = %d, but no field has a range: all have the same numbers"
        _LOG.warning(text, place.source, template.variants)
    return template


def _read_mapping(text: str, place: Place, problems: Problems) -> MapNode:
    tree = read_tree(text, place, problems, empty=EMPTY)
    if isinstance(tree, ScalarNode) and tree.value is None:
        raise place.error(EMPTY)
    if not isinstance(tree, MapNode):
        raise tree.place.error(f"a recipe is a mapping of fields; got {show(tree)}")
    return _with_moved_fields(tree) if text.startswith(_NUMBERS_HEADER) else tree


def _with_moved_fields(tree: MapNode) -> MapNode:
    """Return the tree of a recipe in numbers, of this or an older version, by today's paths."""
    for former, path in MOVED_FIELDS.items():
        section_path, _, name = former.rpartition(".")
        section: Node | None = tree
        for key in section_path.split("."):
            section = section.get(key) if isinstance(section, MapNode) else None
        if isinstance(section, MapNode) and name in section:
            tree = _merge_trees(tree, _override(path, section.pop(name)), recipe_file())
    return tree


def _check_version(tree: MapNode) -> None:
    """Refuse another version of the format. A later one may rename fields, so nothing else is
    checked.
    """
    version = tree.get("version")
    value = version.value if isinstance(version, ScalarNode) else None
    if version is not None and (type(value) is not int or value != VERSION):
        text = f"version = {show(version)}: this package reads version {VERSION} of the format"
        raise version.place.error(text)


def _with_parents(tree: MapNode, place: Place, problems: Problems) -> MapNode:
    """Return the tree merged over the one that it extends, which is merged over its own, and so
    on.
    """
    chain = [_identity(place)]
    while (parent := tree.pop("extends", None)) is not None:
        if isinstance(parent, ScalarNode) and parent.value is None:
            break
        text, place = _read_parent(parent)
        chain.append(_identity(place))
        if chain[-1] in chain[:-1]:
            circle = " -> ".join(Path(source).name for source in chain)
            raise parent.place.error(f"extends = {show(parent)}: a circle: {circle}")
        parent_tree = _read_mapping(text, place, problems)
        _check_version(parent_tree)
        parent_tree.pop("name", None)
        tree = _merge_trees(parent_tree, tree, recipe_file())
    return tree


def _identity(place: Place) -> str:
    is_file = place.folder is not None
    return str(Path(place.source).resolve()) if is_file else place.source


def _read_parent(parent: Node) -> tuple[str, Place]:
    leaf = recipe_file().leaves["extends"]
    place = parent.place
    name = parent.text if isinstance(parent, ScalarNode) else ""
    if not leaf.accepts(name):
        raise place.error(f"extends = {show(parent)}: must be {leaf.describe_allowed_values()}")
    try:
        if name in preset_names():
            return _read(name)[:2]
        if place.folder is None:
            raise ValueError("no such preset, and this text is in no folder to look in")
        file_below(place.folder, name)
        return _read(place.folder / name)[:2]
    except ValueError as error:
        guess = did_you_mean(name, preset_names())
        text = f"{error}; {guess}presets are {', '.join(preset_names())}"
        raise place.error(f"extends = {show(parent)}: {text}") from None


def _merge_trees(base: MapNode, changes: MapNode, section: Section) -> MapNode:
    """Return `base` with the fields of `changes` in place of its own; sections merge."""
    entries = dict(base)
    for name, node in changes.items():
        inner_section = section.sections.get(name)
        base_node = base.get(name)
        if (
            inner_section is not None
            and isinstance(base_node, MapNode)
            and isinstance(node, MapNode)
        ):
            entries[name] = _merge_trees(base_node, node, inner_section)
        else:
            entries[name] = node
    return MapNode(changes.place, entries)


def _override(path: str, value: object) -> MapNode:
    """Return the tree of a file that gives this field alone."""
    if isinstance(value, Node):
        node = value
    else:
        node = _value_node(json.dumps(value), Place(f"override of {path}", None))
    *sections, name = path.split(".")
    tree = MapNode(node.place, {name: node})
    for section in reversed(sections):
        tree = MapNode(node.place, {section: tree})
    return tree


def _value_node(text: str, place: Place) -> Node:
    problems = Problems()
    node = read_tree(text, place, problems, empty="a value is missing; null removes an effect")
    problems.raise_if_any()
    return node


# ---- A recipe in numbers -> the YAML that reads back as the same recipe --------------------------


class _Representer(SafeRepresenter):
    """Writes colours and rates on one line, without anchors."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _represent_tuple(representer: _Representer, data: tuple[object, ...]) -> YamlNode:
    flat = all(map(is_number, data))
    return representer.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


_Representer.add_representer(tuple, _represent_tuple)


def dump_recipe(recipe: Recipe) -> str:
    """Return YAML with every field written out, defaults included, and the hash in a comment.

    `parse_recipe(dump_recipe(r), ...).resolve(0)` equals r, to the bit. Paths of files are written
    unchanged: make them relative to the recipe's folder first, as a job does. Settings that an open
    quality has still to choose are left out, and so are settings of absent effects: a tier chooses
    them for a recipe that adds the effect.
    """
    data = recipe.model_dump()
    del data["timelines"]
    for timeline in recipe.timelines:
        *sections, name = timeline.path.split(".")
        functools.reduce(operator.getitem, sections, data)[name] = timeline.as_field()
    open_knobs = free_knobs(recipe) if recipe.has_open_choice else ()
    for knob in (*open_knobs, *idle_speed_knobs(recipe)):
        *sections, name = knob.path.split(".")
        holder = data
        for section in sections:
            holder = holder[section]
        del holder[name]
    yaml = YAML(typ="safe", pure=True)
    text = io.StringIO()
    yaml.Representer = _Representer
    yaml.default_flow_style = yaml.allow_unicode = False
    yaml.sort_base_mapping_type_on_output = False  # pyright: ignore[reportAttributeAccessIssue]
    yaml.version = (1, 1)  # quotes what a reader of either version might take for something else
    yaml.dump(data, text)
    body = text.getvalue().removeprefix("%YAML 1.1\n---\n")
    return f"{_NUMBERS_HEADER}{recipe.hash}.\n{body}"
