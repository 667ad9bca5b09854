"""Recipes from files and presets, with every problem of a file reported at once."""

from __future__ import annotations

import contextlib
import logging
import re
from pathlib import Path
from typing import Any

import yaml

from recipes.errors import Problems, RecipeError, did_you_mean, nearest_word, short
from recipes.fields import packaged, packaged_text
from recipes.files import file_below, open_file
from recipes.schema import SECTIONS, VERSION, Recipe, free_knobs
from recipes.template import (
    ANY_NUMBER,
    RANGE_KINDS,
    Channels,
    Choice,
    FieldSpec,
    Fixed,
    Items,
    Kind,
    Normal,
    RecipeTemplate,
    SectionSpec,
    TripleLine,
    Uniform,
    Value,
    as_number,
    as_triple,
    broken_rules,
    is_number,
    join,
    root,
)
from recipes.yaml_tree import EMPTY, ListNode, MapNode, Node, ScalarNode, read_tree

# ---- Files and presets ---------------------------------------------------------------------------

MAX_BYTES = 65_536  # a recipe is a page of text; a bigger file is something else


def load_recipe(path_or_preset_name: str | Path) -> RecipeTemplate:
    """The template in a file, or the preset of that name.

    A text that names a preset is the preset (write ./NAME for a file of that name); anything else,
    and every Path, is a file. A file's stem is the recipe's name unless the file gives one.

    Raises:
        RecipeError: there is no such file or preset, it holds no valid recipe, or it names a
            file that cannot be read.
    """
    if isinstance(path_or_preset_name, str) and path_or_preset_name in preset_names():
        name = path_or_preset_name
        return parse_recipe(preset_text(name), source=f"preset {name}", name=name)
    path = Path(path_or_preset_name)
    source = str(path_or_preset_name)
    text = read_text(path, MAX_BYTES, missing=_missing(source), too_large="this is no recipe")
    return parse_recipe(text, source=source, name=path.stem, folder=path.parent)


def preset_names() -> tuple[str, ...]:
    """The recipes that come with the package, in alphabetical order."""
    return packaged("presets")


def preset_text(name: str) -> str:
    """The YAML of a preset, a start for one's own recipe.

    Raises:
        RecipeError: there is no preset of that name.
    """
    if name not in preset_names():
        raise RecipeError(f"{name}: {_missing(name)}")
    return packaged_text("presets", name)


def _missing(source: str) -> str:
    names, guess = preset_names(), did_you_mean(source, preset_names())
    return f"no such file, and no such preset; {guess}presets are {', '.join(names)}"


def read_text(path: Path, max_bytes: int, *, missing: str, too_large: str) -> str:
    """A file's text. missing, too_large: what to say then.

    Raises:
        RecipeError: there is none, or it cannot be read as text.
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
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        text = f"not UTF-8 text (byte 0x{data[error.start]:02x}): save the file as UTF-8"
        raise RecipeError(f"{source}:{line}: {text}") from None


# ---- How messages show what was written, and what they guess was meant ---------------------------

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
        with contextlib.suppress(ValueError):
            float(text)
            return "; write it without quotes"
    return ""


NORMAL_KEYS = ("mean", "std", "min", "max")
MAX_STD_PER_WIDTH = 1000  # a wider normal is uniform for all purposes, and loses digits


# ---- Guesses what a misspelt key was meant to be -------------------------------------------------

_UNIT = re.compile(
    r"_(per_)?(k|c|m)?(m|metres?|meters?|ft|feet|mi|miles?|yards?|mps|kmh|kph|mph|deg|rad|ntu|fnu)$"
)


def _synonyms() -> dict[str, str]:
    """What a key may have been meant to be, where the section has it."""
    meant = (pair for model in SECTIONS.values() for pair in model.meant_by)
    return {word: key for key, words in meant for word in words.split()}


def unknown_key(key: str, section: SectionSpec) -> str:
    """Why `key` is refused and which known one is nearest."""
    if key in RANGE_KINDS:
        return "a range stands for one field, not for a whole section"
    nearest = _nearest(key, section)
    if nearest is not None:
        spec = {**section.fields, **section.extra}.get(nearest)
        unit = f" ({spec.unit})" if spec and spec.unit else ""
        return f"unknown field; did you mean {nearest}{unit}?"
    elsewhere = [
        (other, name)
        for name in dict.fromkeys((key, _synonyms().get(key, key)))
        for other in root().walk()
        if name in other.known and other is not section
    ]
    below = [place for place in elsewhere if place[0].path.startswith(f"{section.path}.")]
    elsewhere = below or elsewhere
    if elsewhere:
        places = [join(o.path, name) if o.path else f"{name} at the top" for o, name in elsewhere]
        return f"unknown field here; did you mean {' or '.join(places)}?"
    return f"unknown field; known here: {', '.join(section.known)}"


def _nearest(key: str, section: SectionSpec) -> str | None:
    known, low = section.known, key.lower().replace("-", "_")
    if low in known:
        return low
    bases = {_base(name): name for name in known}
    if _base(low) in bases:  # visibility_km, visibility: the unit is what was wrong
        return bases[_base(low)]
    synonyms = _synonyms()
    for meant in (synonyms.get(low), synonyms.get(_base(low))):
        if meant in known:
            return meant
    if any(low in other.known for other in root().walk()):
        return None  # spelt well, but in another place
    close = nearest_word(low, known)
    if close is None:
        base = nearest_word(_base(low), tuple(bases))
        close = bases[base] if base else None
    return close


def _base(name: str) -> str:
    """The name without its unit."""
    return _UNIT.sub("", name) or name


# ---- The whole file ------------------------------------------------------------------------------

_LOG = logging.getLogger(__name__)


def parse_recipe(
    text: str, *, source: str, name: str | None = None, folder: Path | None = None
) -> RecipeTemplate:
    """The template in YAML `text`.

    source: stands before the line number in messages. name: the recipe's, where the text gives
    none. folder: where the files that the text names lie; without it, it can name none.

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
    return _Reader(problems, folder).template(tree, source, name)


def _check_version(tree: MapNode, problems: Problems) -> None:
    """A later format may well rename fields, so nothing else is said about such a file."""
    if "version" not in tree.entries:
        return
    line, node = tree.entries["version"]
    value = node.value if isinstance(node, ScalarNode) else None
    if type(value) is not int or value != VERSION:
        text = f"version = {show(node)}: this package reads version {VERSION} of the format"
        raise problems.fail(line, text)


class _Reader:
    """folder: where the files that the recipe names lie; None for a text that is in no file."""

    def __init__(self, problems: Problems, folder: Path | None) -> None:
        self._problems, self._folder = problems, folder
        self._values: dict[str, Value] = {}
        self._effects: dict[str, float] = {}
        self._lists: dict[str, int] = {}

    def template(self, tree: MapNode, source: str, file_name: str | None) -> RecipeTemplate:
        """The template of a whole file; raises all that was found wrong."""
        self._section(tree, root(), "", line=1)
        name = self._take("name", file_name)
        if "name" not in tree.entries and not root().fields["name"].accepts(name):
            allowed = root().fields["name"].allowed()
            text = f"the file's name, {short(str(name))!r}, cannot serve as it; add 'name: ...'"
            self._problems.add(1, f"name: {text}, {allowed}")
        seed, first = int(self._take("seed")), int(self._take("variant"))
        variants = int(self._take("variants"))
        if not root().fields["variant"].accepts(first + variants - 1):
            line = tree.entries["variant"][0]
            self._problems.add(line, f"variant = {first}: too large with variants = {variants}")
        self._problems.raise_if_any()
        self._values.pop("version", None)
        if variants > 1 and not self._differs():
            text = "%s: variants = %d, but no field has a range: all have the same numbers"
            _LOG.warning(text, source, variants)
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
        return {**root().fields, **root().extra}[key].default if absent is None else absent

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
        if isinstance(node, ScalarNode) and node.value is None and spec.max_items is None:
            return given  # 'weather:' with nothing below it: it is empty, an effect absent
        if isinstance(node, ScalarNode) and spec.shorthand is not None:
            value = self._literal(node, spec.fields[spec.shorthand].without_null, path)
            if value is not None:
                given[spec.shorthand] = self._values[join(path, spec.shorthand)] = value
            return given
        if not isinstance(node, MapNode):
            text = f"{path} = {show(node)}: must be a mapping, with {', '.join(spec.known)}"
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
        if below is not None and below.max_items is not None:
            return self._list(node, below, below.max_items, path)
        if below is not None:
            self._section(node, below, path, line)
        elif key in spec.fields:
            field = spec.fields[key]
            read = self._field if field.rangeable else self._literal
            if (value := read(node, field, path)) is not None:
                self._values[path] = value
            return value
        elif key in spec.extra:
            self._extra(node, spec, key, path)
        else:
            shown = path.removesuffix(key) + short(key)
            self._problems.add(line, f"{shown}: {unknown_key(key, spec)}")
        return None

    def _list(self, node: Node, spec: SectionSpec, most: int, path: str) -> Items | None:
        if isinstance(node, ScalarNode) and node.value is None:
            return None
        if not isinstance(node, ListNode) or len(node.items) > most:
            allowed = f"up to {most} mappings, each with {', '.join(spec.known)}; or null"
            self._problems.add(node.line, f"{path} = {show(node)}: must be a list of {allowed}")
            return None
        self._lists[path] = len(node.items)
        mappings = [
            self._section(item, spec, f"{path}[{index}]", item.line)
            for index, item in enumerate(node.items)
        ]
        return Items(tuple(mappings))

    def _extra(self, node: Node, spec: SectionSpec, key: str, path: str) -> None:
        value = self._literal(node, spec.extra[key], path)
        if value is not None and spec.effect and key == "probability":
            self._effects[spec.path] = as_number(value.value)
        elif value is not None:
            self._values[path] = value

    # ---- One field: a literal or a range, checked against the field's limits where it stands;
    # None where something is wrong

    def _field(self, node: Node, spec: FieldSpec, path: str) -> Value | None:
        if isinstance(node, MapNode):
            return self._range(node, spec, path)
        if isinstance(node, ListNode) and spec.channel is not None and len(node.items) == 3:
            return self._triple(node, spec.channel, path)
        return self._literal(node, spec, path)

    def _literal(self, node: Node, spec: FieldSpec, path: str) -> Fixed | None:
        """Of a field that must be written out."""
        if isinstance(node, MapNode) and not spec.rangeable:
            return self._bad(node, path, f"must be {spec.allowed()}; it cannot be a range")
        if not isinstance(node, ScalarNode):
            return self._bad(node, path, f"must be {spec.allowed()}")
        value = node.value
        if spec.kind.is_text and value is not None:
            value = node.text  # a name may look like a number
        if not spec.accepts(value):
            return self._bad(node, path, f"must be {spec.allowed(value)}{hint(node, spec)}")
        if spec.kind is Kind.PATH and value is not None:
            return self._file(node, path)
        if spec.kind is Kind.NUMBER and value is not None:
            return Fixed(float(as_number(value)))
        return Fixed(value)

    def _file(self, node: ScalarNode, path: str) -> Fixed | None:
        """The name of a file as it is written, where that file can be read."""
        if self._folder is None:
            text = "this text is in no file, so there is no folder to look in; save it as one"
            return self._bad(node, path, text)
        try:
            file_below(self._folder, node.text)
        except ValueError as error:
            return self._bad(node, path, str(error))
        return Fixed(node.text)

    def _bad(self, node: Node, path: str, text: str) -> None:
        self._problems.add(node.line, f"{path} = {show(node)}: {text}")

    def _number(self, node: Node, spec: FieldSpec, path: str) -> float | None:
        fixed = self._literal(node, spec.without_null, path)
        return None if fixed is None else as_number(fixed.value)

    def _each(self, node: ListNode, spec: FieldSpec, path: str) -> list[Value | None]:
        return [self._field(item, spec, f"{path}[{i}]") for i, item in enumerate(node.items)]

    def _numbers(self, node: ListNode, spec: FieldSpec, path: str) -> list[float | None]:
        return [self._number(item, spec, f"{path}[{i}]") for i, item in enumerate(node.items)]

    def _triple(self, node: ListNode, spec: FieldSpec, path: str) -> Value | None:
        red, green, blue = channels = self._each(node, spec, path)
        if red is None or green is None or blue is None:
            return None
        fixed = [channel.value for channel in channels if isinstance(channel, Fixed)]
        return Fixed(as_triple(fixed)) if len(fixed) == 3 else Channels((red, green, blue))

    def _range(self, node: MapNode, spec: FieldSpec, path: str) -> Value | None:
        kinds = [key for key in node.entries if key in RANGE_KINDS]
        if len(kinds) != 1:
            return self._bad(node, path, which_range(node, spec))
        kind = kinds[0]
        allowed = {kind, "weights"} if kind == "choice" else {kind}
        for key, (line, _) in node.entries.items():
            if key not in allowed:
                self._problems.add(line, f"{path}.{short(key)}: no part of a range {kind!r}")
                return None
        body, below = node.entries[kind][1], f"{path}.{kind}"
        if kind == "choice":
            return self._choice(node, spec, path)
        if spec.channel is not None and kind == "uniform":
            return self._line(body, spec, below)
        if spec.kind not in (Kind.NUMBER, Kind.WHOLE):
            possible = "choice" if spec.channel is None else "uniform or choice"
            return self._bad(node, path, f"{kind} is for numbers; a range here is {possible}")
        if kind == "normal":
            return self._normal(body, spec, below)
        return self._interval(body, spec, below, log=kind == "log_uniform")

    def _interval(self, body: Node, spec: FieldSpec, path: str, *, log: bool) -> Value | None:
        if not isinstance(body, ListNode) or len(body.items) != 2:
            return self._bad(body, path, "must be [low, high]")
        low, high = self._numbers(body, spec, path)
        if low is None or high is None:
            return None
        if low > high:
            return self._bad(body, path, "the low end comes first")
        if log and low <= 0:
            return self._bad(body.items[0], f"{path}[0]", "must be > 0: its logarithm is taken")
        return Uniform(low, high, spec.kind is Kind.WHOLE, log)

    def _normal(self, body: Node, spec: FieldSpec, path: str) -> Value | None:
        if not isinstance(body, MapNode) or set(body.entries) != set(NORMAL_KEYS):
            form = ", ".join(f"{key}: ..." for key in NORMAL_KEYS)
            return self._bad(body, path, f"must be {{{form}}}, all four")
        # neither the mean nor the deviation of whole numbers need be whole
        specs = dict(zip(NORMAL_KEYS, (ANY_NUMBER, ANY_NUMBER, spec, spec), strict=True))
        mean, std, low, high = (
            self._number(body.entries[key][1], part, f"{path}.{key}") for key, part in specs.items()
        )
        if mean is None or std is None or low is None or high is None:
            return None
        if not low < high:
            return self._bad(body.entries["max"][1], f"{path}.max", "must be > min")
        if not low <= mean <= high:
            text = f"must be from min to max, {low:g} to {high:g}"
            return self._bad(body.entries["mean"][1], f"{path}.mean", text)
        if not 0 < std <= MAX_STD_PER_WIDTH * (high - low):
            text = f"must be > 0 and <= {MAX_STD_PER_WIDTH} (max - min); wider is uniform"
            return self._bad(body.entries["std"][1], f"{path}.std", text)
        return Normal(mean, std, low, high, spec.kind is Kind.WHOLE)

    def _choice(self, node: MapNode, spec: FieldSpec, path: str) -> Value | None:
        body, below = node.entries["choice"][1], f"{path}.choice"
        if not isinstance(body, ListNode) or not body.items:
            return self._bad(body, below, "must be a list of at least one option")
        count = len(body.items)
        options = tuple(o for o in self._each(body, spec, below) if o is not None)
        weights: tuple[float, ...] | None = (1.0,) * count
        if "weights" in node.entries:
            weights = self._weights(node.entries["weights"][1], count, f"{path}.weights")
        if weights is None or len(options) < count:
            return None
        return Choice(options, weights)

    def _weights(self, node: Node, count: int, path: str) -> tuple[float, ...] | None:
        if not isinstance(node, ListNode) or len(node.items) != count:
            return self._bad(node, path, f"must be {count} numbers, one for each option")
        weights = tuple(w for w in self._numbers(node, ANY_NUMBER, path) if w is not None)
        if len(weights) < count:
            return None
        # bounds keep the sum finite and every share representable
        if not any(weights) or any(w != 0 and not 1e-9 <= w <= 1e9 for w in weights):
            return self._bad(node, path, "each is 0 or from 1e-9 to 1e9, and one is above 0")
        return weights

    def _line(self, body: Node, spec: FieldSpec, path: str) -> Value | None:
        ends = "colours" if spec.kind is Kind.COLOUR else "triples of rates"
        if not isinstance(body, ListNode) or len(body.items) != 2:
            return self._bad(body, path, f"must be [from, to], two {ends}")
        start, end = self._each(body, spec, path)
        if start is None or end is None:
            return None
        if not (isinstance(start, Fixed) and isinstance(end, Fixed)):
            return self._bad(body, path, f"the two {ends} must be written out, without ranges")
        assert isinstance(start.value, tuple) and isinstance(end.value, tuple)
        return TripleLine(start.value, end.value)


# ---- A recipe in numbers -> the YAML that reads back as the same recipe --------------------------


class _Dumper(yaml.SafeDumper):
    """Colours and rates on one line; no anchors."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _sequence(dumper: _Dumper, data: tuple[object, ...]) -> yaml.Node:
    flat = all(map(is_number, data))
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flat)


_Dumper.add_representer(tuple, _sequence)


def dump_recipe(recipe: Recipe) -> str:
    """YAML with every field written out, defaults included, and the hash in a comment.

    `parse_recipe(dump_recipe(r), ...).resolve(0)` equals r, to the bit. Paths of files are written
    as they are: give them names from the recipe's folder first, as a job does. Settings that an
    open quality has still to choose are left out.
    """
    data = recipe.model_dump()
    for knob in free_knobs(recipe) if recipe.quality.is_open else ():
        *sections, name = knob.path.split(".")
        holder = data
        for section in sections:
            holder = holder[section]
        del holder[name]
    body = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=False)
    return f"# A recipe in numbers, hash {recipe.hash}.\n{body}"
