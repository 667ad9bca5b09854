"""Models of a recipe file, derived from those of `schema`: each field takes a value or a range.

With them pydantic reads the nodes of a YAML tree and writes the JSON Schema. The result of reading
is a mapping of the fields that the file gives, with a `ranges.Value` for each.
"""

from __future__ import annotations

import functools
import itertools
import json
import operator
import types
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Union, get_args, get_origin

from annotated_types import Gt, MaxLen
from pydantic import (
    BaseModel,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Strict,
    TypeAdapter,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    create_model,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError
from pydantic_core import core_schema as cs
from typing_extensions import TypeAliasType

from recipes.errors import Place, Problems, dotted, join, readable
from recipes.fields import ClosedModel, Digest, FilePath, Number, Unit, Whole
from recipes.files import file_below
from recipes.guesses import RANGE_KINDS, guess_section, guess_value, show, why_no_key, why_no_range
from recipes.ranges import (
    Channels,
    Choice,
    Fixed,
    NamedFile,
    Normal,
    Plain,
    TripleLine,
    Uniform,
    Value,
    as_number,
    as_triple,
    format_value,
    is_number,
)
from recipes.schema import SECTIONS, Recipe
from recipes.speed import MOVED_FIELDS
from recipes.yaml_tree import MAX_NODES, ListNode, MapNode, Node, ScalarNode

# Largest standard deviation of a normal range over its width. A wider normal is uniform for all
# purposes, and loses digits.
MAX_STD_PER_WIDTH = 1000

# Units in words, by the end of a field's name.
UNITS = {
    "_per_m": "1/metre",
    "_mm": "millimetres",
    "_m": "metres",
    "_s": "seconds",
    "_deg": "degrees",
    "_ntu": "nephelometric turbidity units",
}
# Signs of the limits in messages, by their keywords in JSON Schema.
_LIMITS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}

# Fields of a section: a Value for a field, SectionFields for a section, or a list of them.
SectionFields = dict[str, Any]


_TAGS = [f"<{form}>" for form in ("value", *RANGE_KINDS)]  # in pydantic's locations of errors


# ---- One value, or a range of values -------------------------------------------------------------


@dataclass(frozen=True)
class Leaf:
    """Field that holds a value. Its `type`, in a model, reads a node into a `ranges.Value`.

    Attributes:
        path: as in a file, with [] for the items of a list.
        annotation: type of a value that is not null.
        nullable: True if null is allowed.
        rangeable: True if a range is allowed.
        info: further facts that pydantic has on the field.
    """

    path: str
    annotation: Any
    nullable: bool = False
    rangeable: bool = True
    info: FieldInfo = field(default_factory=FieldInfo)

    @classmethod
    def of(cls, path: str, info: FieldInfo, *, rangeable: bool) -> Leaf:
        """Return the leaf of a model's field."""
        value_type, nullable = _without_none(info.annotation)
        annotation = Annotated[value_type, *info.metadata] if info.metadata else value_type
        return cls(path, annotation, nullable, rangeable, info)

    @property
    def description(self) -> str:
        return _one_line(self.info.description)

    @cached_property
    def type(self) -> Any:
        """Return a named type for annotations. An option of a choice is of the same type."""
        return TypeAliasType(self.path, Annotated[Any, self])  # pyright: ignore

    @cached_property
    def kind(self) -> Any:
        """Return float, int, bool, str, tuple (a colour or three rates), Literal, or a union of
        these.
        """
        kind = self.annotation
        while get_origin(kind) is Annotated:
            kind = get_args(kind)[0]
        return get_origin(kind) or kind

    @property
    def is_number(self) -> bool:
        return self.kind in (int, float)

    @cached_property
    def word_list(self) -> tuple[str, ...]:
        """Return the words that a list in the field's place may hold; none if it takes no list."""
        items = [part.get("items", {}) for part in self._schema.get("anyOf", ())]
        return tuple(str(word) for item in items for word in item.get("enum", ()))

    @cached_property
    def channel(self) -> Leaf | None:
        """Return the leaf of one of the three numbers of a colour or rates, or None for any
        other field.
        """
        if self.kind is not tuple:
            return None
        return Leaf(f"{self.path}[]", get_args(self.annotation)[0], rangeable=self.rangeable)

    @property
    def unit(self) -> str | None:
        """Return the unit in words, or None for a pure number."""
        name = self.path.removesuffix("[]")
        return next((unit for end, unit in UNITS.items() if name.endswith(end)), None)

    # ---- What is allowed, by the value's JSON Schema

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        return TypeAdapter(self.annotation)

    @cached_property
    def _schema(self) -> JsonSchemaValue:
        return self._adapter.json_schema()

    @property
    def limits(self) -> tuple[tuple[str, float], ...]:
        """Return pairs such as (">", 0.0)."""
        return tuple((sign, self._schema[k]) for k, sign in _LIMITS.items() if k in self._schema)

    @property
    def allowed_words(self) -> tuple[str, ...]:
        """Return the words that the field takes besides true and false; empty if they cannot be
        listed.
        """
        parts = (self._schema, *self._schema.get("anyOf", ()))
        enums = [part.get("enum", [part["const"]] if "const" in part else []) for part in parts]
        return tuple(str(word) for enum in enums for word in enum)

    def accepts(self, value: object) -> bool:
        """Return True if the recipe's model takes this value."""
        if value is None:
            return self.nullable
        try:
            self._adapter.validate_python(value)
        except ValidationError:
            return False
        return True

    def describe_allowed_values(self, value: object = None) -> str:
        """Return in words which values the field takes.

        value: the refused value; conditions that it meets are left out.
        """
        if self.channel is not None:
            text = f"[red, green, blue], each {self.channel.describe_allowed_values()}"
        elif self.is_number:
            text = self._allowed_number(value) + (f" ({self.unit})" if self.unit else "")
        elif self.word_list:
            text = f"true, false or a list of {', '.join(self.word_list)}"
        elif self.kind is bool or "anyOf" in self._schema:
            *first, last = ("true", "false", *self.allowed_words)
            text = f"{', '.join(first)} or {last}"
        elif self.allowed_words:
            text = f"one of {', '.join(self.allowed_words)}"
        else:
            text = self.info.title or self._schema.get("title", "text")
        return text + (", or null" if self.nullable and not is_number(value) else "")

    def _allowed_number(self, value: object) -> str:
        limits = " and ".join(f"{sign} {_plain(bound)}" for sign, bound in self.limits)
        right_type = is_number(value) and (isinstance(value, int) or self.kind is float)
        if limits and right_type and value == value:
            return limits
        return f"{'a number' if self.kind is float else 'a whole number'} {limits}".strip()

    # ---- Reading

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        literal = self._literal_schema(handler)
        if not self.rangeable:
            return literal
        schemas = {"value": literal, **_range_schemas(self, handler)}

        def form_of(node: Node) -> str:
            kinds = [kind for kind in RANGE_KINDS if isinstance(node, MapNode) and kind in node]
            return f"<{kinds[0]}>" if len(kinds) == 1 and kinds[0] in schemas else "<value>"

        tagged_schemas = {f"<{form}>": schema for form, schema in schemas.items()}
        return cs.tagged_union_schema(tagged_schemas, form_of)

    def _literal_schema(self, handler: GetCoreSchemaHandler) -> CoreSchema:
        if self.channel is not None:
            schema: CoreSchema = cs.tuple_schema([handler.generate_schema(self.channel.type)] * 3)
        else:
            schema = handler.generate_schema(self.annotation)
        if self.nullable:
            schema = cs.nullable_schema(schema)
        return cs.no_info_wrap_validator_function(self._read, schema)

    def _read(self, node: Node, handler: ValidatorFunctionWrapHandler) -> Value:
        if isinstance(node, MapNode):
            raise refusal(why_no_range(node, self))
        if self.channel is not None and isinstance(node, ListNode) and len(node) == 3:
            channels = handler(node)
            numbers = [channel.value for channel in channels if isinstance(channel, Fixed)]
            return Fixed(as_triple(numbers)) if len(numbers) == 3 else Channels(channels)
        if self.word_list and isinstance(node, ListNode):
            value: Any = tuple(getattr(item, "value", None) for item in node)
        elif isinstance(node, ListNode):
            raise refusal(f"must be {self.describe_allowed_values()}{guess_value(node, self)}")
        else:  # a name may look like a number
            value = node.text if self.kind is str and node.value is not None else node.value
        try:
            checked_value = handler(value)
        except ValidationError:
            raise refusal(
                f"must be {self.describe_allowed_values(value)}{guess_value(node, self)}"
            ) from None
        is_file = self.annotation == FilePath and checked_value is not None
        return _named_file(node) if is_file else Fixed(checked_value)  # type: ignore[arg-type]


def refusal(text: str) -> PydanticCustomError:
    """Return the error with which pydantic refuses a node."""
    return PydanticCustomError("recipe", text)  # type: ignore[arg-type]


def _named_file(node: ScalarNode) -> NamedFile:
    """Return the name of a file as it is written, if that file can be read."""
    folder = node.place.folder
    if folder is None:
        text = "this text is in no file, so there is no folder to look in; save it as one"
        raise refusal(text)
    try:
        file_below(folder, node.text)
    except ValueError as error:
        raise refusal(str(error)) from None
    return NamedFile(node.text, folder)


# ---- Ranges --------------------------------------------------------------------------------------

_MEAN = Leaf("mean", Annotated[Number, Field(allow_inf_nan=False)], rangeable=False)
_STD = Leaf("std", Annotated[Number, Field(gt=0, allow_inf_nan=False)], rangeable=False)
_WEIGHT = Leaf("weight", Annotated[Number, Field(ge=0, le=1e9)], rangeable=False)


def _range_schemas(leaf: Leaf, handler: GetCoreSchemaHandler) -> dict[str, CoreSchema]:
    """Return the schema of each kind of range that the field takes, by kind."""
    generate = handler.generate_schema
    options = cs.list_schema(generate(leaf.type), min_length=1)
    schemas = {
        "choice": _mapping_schema(
            _choice,
            choice=_list_schema(options, range(1, MAX_NODES), "a list of at least one option"),
            weights=cs.list_schema(generate(_WEIGHT.type)),
        )
    }
    end = replace(leaf, nullable=False, rangeable=False)

    def pair(end: Leaf, text: str = "[low, high]") -> CoreSchema:
        pair_schema = cs.tuple_schema([generate(end.type)] * 2)
        return _list_schema(pair_schema, [2], text)

    if leaf.channel is not None:
        line = pair(end, "[from, to], each [red, green, blue]")
        schemas["uniform"] = _mapping_schema(_line, uniform=line)
    elif leaf.is_number:
        above_0 = replace(end, annotation=Annotated[end.annotation, Gt(0)])
        schemas["uniform"] = _mapping_schema(_interval, uniform=pair(end))
        schemas["log_uniform"] = _mapping_schema(_interval, log_uniform=pair(above_0))
        parts = {"mean": _MEAN, "std": _STD, "min": end, "max": end}
        normal = {name: generate(part.type) for name, part in parts.items()}
        schemas["normal"] = _mapping_schema(_normal, normal=_mapping_schema(dict, **normal))
    return schemas


def _mapping_schema(build: Callable[[SectionFields], Any], **fields: CoreSchema) -> CoreSchema:
    keys = {
        name: cs.typed_dict_field(schema, required=name != "weights")
        for name, schema in fields.items()
    }
    dict_schema = cs.typed_dict_schema(keys, extra_behavior="forbid")
    return cs.no_info_after_validator_function(build, dict_schema)


def _list_schema(schema: CoreSchema, counts: Container[int], text: str) -> CoreSchema:
    """Return the schema of a list. text: expected list, for the message about anything else."""

    def check(node: Node) -> Node:
        if not isinstance(node, ListNode) or len(node) not in counts:
            raise refusal(f"must be {text}")
        return node

    return cs.no_info_before_validator_function(check, schema)


def _interval(fields: SectionFields) -> Uniform:
    ((kind, ends),) = fields.items()
    low, high = (as_number(end.value) for end in ends)
    if low > high:
        raise refusal("the low end comes first")
    return Uniform(low, high, log=kind == "log_uniform")


def _normal(fields: SectionFields) -> Normal:
    parts = fields["normal"]
    mean, std, low, high = (as_number(parts[name].value) for name in ("mean", "std", "min", "max"))
    if not low < high:
        raise refusal("max must be > min")
    if not low <= mean <= high:
        raise refusal(f"mean must be from min to max, {low:g} to {high:g}")
    if std > MAX_STD_PER_WIDTH * (high - low):
        raise refusal(f"std must be <= {MAX_STD_PER_WIDTH} (max - min); wider is uniform")
    return Normal(mean, std, low, high)


def _choice(fields: SectionFields) -> Choice:
    options = tuple(fields["choice"])
    weights = [as_number(weight.value) for weight in fields.get("weights", ())]
    if "weights" in fields and len(weights) != len(options):
        raise refusal(f"weights must be {len(options)} numbers, one for each option")
    # bounds keep the sum finite and every share representable
    if weights and (not any(weights) or any(0 < weight < 1e-9 for weight in weights)):
        raise refusal("each weight is 0 or from 1e-9 to 1e9, and one is above 0")
    return Choice(options, tuple(weights) or (1.0,) * len(options))


def _line(fields: SectionFields) -> TripleLine:
    start, end = fields["uniform"]
    return TripleLine(start.value, end.value)


# ---- Sections: mappings of fields ----------------------------------------------------------------


class Section(ClosedModel):
    """Base of the models of a file's mappings. Reading one gives a dict of the given fields.

    PATH: dotted, with [] for the items of a list. MODEL: the model of `schema` that checks draws.
    LEAVES, INNER: its fields and sections. MAX_ITEMS: largest number of such mappings in a list, if
    there is one, which LIST_DESCRIPTION describes.
    """

    PATH: ClassVar[str] = ""
    MODEL: ClassVar[type[BaseModel]]
    LEAVES: ClassVar[dict[str, Leaf]]
    INNER: ClassVar[dict[str, type[Section]]]
    MAX_ITEMS: ClassVar[int | None] = None
    LIST_DESCRIPTION: ClassVar[str] = ""

    @classmethod
    def walk(cls) -> Iterator[type[Section]]:
        """Yield this section, then all below it."""
        yield cls
        for section in cls.INNER.values():
            yield from section.walk()

    @model_validator(mode="wrap")
    @classmethod
    def _read(cls, node: Any, handler: ValidatorFunctionWrapHandler) -> Any:
        shorthand = getattr(cls.MODEL, "SHORTHAND", None)
        if isinstance(node, ScalarNode) and node.value is None and cls.MAX_ITEMS is None:
            return None  # 'weather:' with nothing below it: it is empty, an effect absent
        if isinstance(node, ScalarNode) and shorthand is not None:
            node = MapNode(node.place, {shorthand: node})
        if not isinstance(node, MapNode):
            guess = guess_section(node, cls.PATH)
            raise refusal(f"must be a mapping, with {', '.join(cls.model_fields)}{guess}")
        section = handler(node)
        values = {name: getattr(section, name) for name in section.model_fields_set}
        fields = {name: values[name] for name in cls.model_fields if values.get(name) is not None}
        if texts := list(broken_rules(cls, fields)) if cls.PATH else []:
            raise PydanticCustomError("rule", "\n".join(texts))  # type: ignore[arg-type]
        return fields

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        json_schema = handler(schema)
        extra = cls.MODEL.model_config.get("json_schema_extra") or {}
        assert isinstance(extra, dict), "the models state what else holds as JSON, not as functions"
        handler.resolve_ref_schema(json_schema).update(extra)
        if (shorthand := getattr(cls.MODEL, "SHORTHAND", None)) is not None:
            return {"anyOf": [json_schema, {"enum": [*cls.LEAVES[shorthand].allowed_words]}]}
        return json_schema


def recipe_file() -> type[Section]:
    """Return the model of a recipe file, which holds those of all its sections."""
    return _recipe_file(tuple(SECTIONS.items()))


@functools.lru_cache(2)
def _recipe_file(sections: tuple[tuple[str, type[BaseModel]], ...]) -> type[Section]:
    """Return the model for the present sections of Recipe, which are the key of the cache."""
    return _section("", Recipe, _FileFields)


def read_file(tree: MapNode, problems: Problems) -> SectionFields:
    """Return the fields that a tree gives; add everything that is wrong with it to `problems`."""
    try:
        return recipe_file().model_validate(tree)  # type: ignore[return-value]
    except ValidationError as error:
        for item in error.errors(include_url=False, include_context=False):
            place, text = _problem(item)
            for line in text.splitlines():
                problems.add(place, line)
    return {}


def _problem(item: ErrorDetails) -> tuple[Place, str]:
    """Return the place of a problem and its text."""
    kind = item["type"]
    node = item["input"]
    key = item["loc"][-1]
    parents = [part for part in item["loc"][:-1] if part not in _TAGS]
    location = [*parents, key] if kind == "extra_forbidden" or key not in _TAGS else parents
    path = dotted(location)
    section = recipe_file()
    for part in parents:
        section = section.INNER.get(str(part), section)
    in_range = len(item["loc"]) > len(location)
    if kind == "extra_forbidden" and path in MOVED_FIELDS:
        return node.place, f"{path}: has moved; write {MOVED_FIELDS[path]}"
    if kind == "extra_forbidden":
        why = why_no_key(str(key), section, recipe_file())
        return node.place, f"{path}: {'no part of a range' if in_range else why}"
    if kind == "missing":
        expectation = "" if in_range else f", {section.LEAVES[str(key)].describe_allowed_values()}"
        return node.place, f"{path}: must be given{expectation}"
    if kind == "rule":
        return node.place, "\n".join(f"{path}: {text}" for text in item["msg"].splitlines())
    return node.place, f"{path} = {show(node)}: {item['msg'].replace('Input should', 'must', 1)}"


class _FileFields(ClosedModel):
    """Fields of a recipe file that a recipe in numbers does not have."""

    variants: Whole = Field(default=1, ge=1, le=1_000_000)
    """How many recipes are drawn from this file."""
    extends: Annotated[str, Strict()] | None = Field(
        default=None,
        min_length=1,
        max_length=4096,
        title="a preset's name, or a file in the recipe's folder or below it",
    )
    """The recipe whose fields hold where this file gives none."""


class _EffectFields(ClosedModel):
    """Fields of an effect in a recipe file that its model does not have."""

    probability: Unit = 1.0
    """Share of the variants that have this effect."""


def _section(
    path: str, model: type[BaseModel], extra: type[ClosedModel] = ClosedModel
) -> type[Section]:
    """Return the model of a section. extra: further fields besides those of the model, without
    ranges.
    """
    leaves: dict[str, Leaf] = {}
    inner: dict[str, type[Section]] = {}
    fields: dict[str, Any] = {}
    for name, info in {**model.model_fields, **extra.model_fields}.items():
        field_path = join(path, name)
        kind, nullable = _without_none(info.annotation)
        arguments = get_args(kind)
        if get_origin(kind) is tuple and arguments[1:] == (...,):
            item = inner[name] = _section(f"{field_path}[]", arguments[0])
            (item.MAX_ITEMS,) = (m.max_length for m in info.metadata if isinstance(m, MaxLen))
            item.LIST_DESCRIPTION = _one_line(info.description)
            validator = WrapValidator(partial(_read_list, item))
            limit = Field(max_length=item.MAX_ITEMS)
            fields[name] = (Annotated[list[item] | None, limit, validator], None)
        elif isinstance(kind, type) and issubclass(kind, BaseModel):
            inner[name] = _section(field_path, kind, _EffectFields if nullable else ClosedModel)
            fields[name] = (inner[name] | None, None)
        else:
            rangeable = bool(path) and name not in extra.model_fields and kind != Digest
            leaf = leaves[name] = Leaf.of(field_path, info, rangeable=rangeable)
            text = leaf.description + (f" [{leaf.unit}]" if leaf.unit else "")
            fields[name] = (leaf.type, Field(default=info.default, description=text))
    title = model.__name__ if path else "ClimateGS recipe"
    section = create_model(title, __base__=Section, __doc__=_one_line(model.__doc__), **fields)
    section.PATH = path
    section.MODEL = model
    section.LEAVES = leaves
    section.INNER = inner
    return section


def _read_list(item: type[Section], node: Node, handler: ValidatorFunctionWrapHandler) -> Any:
    if isinstance(node, ScalarNode) and node.value is None:
        return None
    if not isinstance(node, ListNode) or len(node) > (item.MAX_ITEMS or 0):
        with_fields = f"each with {', '.join(item.model_fields)}"
        raise refusal(f"must be a list of up to {item.MAX_ITEMS} mappings, {with_fields}; or null")
    return handler(node)


def _without_none(annotation: Any) -> tuple[Any, bool]:
    """Return the annotation without `| None`, and whether None was part of it."""
    if get_origin(annotation) not in (Union, types.UnionType):
        return annotation, False
    members = [member for member in get_args(annotation) if member is not type(None)]
    return functools.reduce(operator.or_, members), len(members) < len(get_args(annotation))


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def _plain(number: float) -> str:
    """Return a number without exponent or trailing zeros if it is short so."""
    is_whole = isinstance(number, int) or (number.is_integer() and abs(number) < 1e15)
    return str(int(number)) if is_whole else repr(number)


# ---- Rules between the fields of a section, tried at the ends of their ranges before any draw ----


def broken_rules(section: type[Section], fields: SectionFields) -> Iterator[str]:
    """Yield every error of the section's model at a combination of the ranges' ends, once."""
    known_texts: set[str] = set()
    ends = [
        _ends(name, value, section.LEAVES.get(name))
        for name, value in fields.items()
        if name in section.MODEL.model_fields and not isinstance(value, dict)
    ]
    for corner in itertools.product(*ends):
        try:
            section.MODEL.model_validate({name: end for name, end, _ in corner})
        except ValidationError as error:
            draw = ", ".join(text for _, _, text in corner if text)
            texts = dict.fromkeys(readable(error))
            new_texts = [text for text in texts if text not in known_texts]
            yield from (f"{text} (in a draw with {draw})" if draw else text for text in new_texts)
            known_texts.update(texts)


def _ends(
    name: str, value: Value | list[SectionFields], leaf: Leaf | None
) -> list[tuple[str, Any, str]]:
    """Return the values of a field that a rule between fields can depend on.

    They are the extreme numbers, null, and every word. Each comes as (name of the field, value,
    text for messages); the text is empty where all draws have the same value. They are few, since
    broken_rules forms their product over a section's fields. No rule compares colours or names of
    files.
    """
    if isinstance(value, list):
        low, high = (tuple(_extremes(item, end) for item in value) for end in (min, max))
        if low == high:
            return [(name, low, "")]
        text = f"all {name} at the %s ends of their ranges"
        return [(name, low, text % "low"), (name, high, text % "high")]
    probes = value.probes()
    numbers = [p for p in probes if is_number(p)]
    options = [p for p in probes if p is None or isinstance(p, str | bool)]
    if leaf is not None and leaf.kind is str:
        options = sorted(options, key=lambda p: p is not None)[: 1 + (None in options)]
    triples = [p for p in probes if isinstance(p, tuple)]
    extremes: list[Plain] = [min(numbers), max(numbers)] if numbers else []
    ends: dict[Plain, None] = dict.fromkeys([*extremes, *triples[:1], *options])
    return [(name, end, f"{name} = {format_value(end)}" if value.is_range else "") for end in ends]


def _extremes(item: SectionFields, pick: Callable[[Any], Any]) -> dict[str, Any]:
    """Return a mapping of a list with all its numbers at one end. pick: min or max.

    Not every combination, of which there may be 2^300: no rule over a list's items trades one
    number off against another.
    """
    extremes = {}
    for name, value in item.items():
        numbers = [probe for probe in value.probes() if is_number(probe)]
        extremes[name] = pick(numbers) if numbers else value.probes()[0]
    return extremes


# ---- JSON Schema ---------------------------------------------------------------------------------


class _FileSchema(GenerateJsonSchema):
    """Generator of a schema in which text may stand without quotes, even if it looks like a
    number.
    """

    def str_schema(self, schema: cs.StringSchema) -> JsonSchemaValue:
        return {**super().str_schema(schema), "type": ["string", "number", "boolean"]}


def recipe_json_schema() -> JsonSchemaValue:
    """Return the JSON Schema (draft 2020-12) of a recipe file, for editors that complete and
    check YAML.

    Rules that JSON Schema cannot express (the order of two ends, rules between draws) are left to
    loading.
    """
    schema = recipe_file().model_json_schema(schema_generator=_FileSchema)
    return {"$schema": _FileSchema.schema_dialect, **schema}


def write_schema(path: str | Path) -> None:
    """Write the schema to a file, as indented UTF-8 JSON.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(recipe_json_schema(), indent=2, ensure_ascii=False)
    Path(path).write_text(text + "\n", encoding="utf-8")
