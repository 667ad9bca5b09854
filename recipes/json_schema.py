"""JSON Schema of a recipe file, for editors that complete and check YAML."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from recipes.recipe_file import SHAPE, TIME, TIMES
from recipes.schema import Recipe
from recipes.sections import Leaf, recipe_file
from recipes.timeline import TIMELINE

_NULL = {"type": "null"}


class _FileSchema(GenerateJsonSchema):
    """Generator of a schema in which text may stand without quotes, even if it looks like a
    number.
    """

    def str_schema(self, schema: core_schema.StringSchema) -> JsonSchemaValue:
        return {**super().str_schema(schema), "type": ["string", "number", "boolean"]}


def recipe_json_schema() -> JsonSchemaValue:
    """Return the JSON Schema (draft 2020-12) of a recipe file: that of `Recipe`, in which a field
    takes a range, too.

    Rules that JSON Schema cannot express (the order of two ends, rules between draws) are left to
    loading.
    """
    schema = Recipe.model_json_schema(schema_generator=_FileSchema)
    definitions = schema["$defs"]
    del definitions["FieldTimeline"]
    for section in recipe_file().walk():
        node = definitions[section.model.__name__] if section.path else schema
        properties = {}
        for key in section.keys:
            if key in section.leaves:
                properties[key] = _field(section.leaves[key], definitions)
            elif (inner := section.sections[key]).max_items is not None:
                properties[key] = node["properties"][key]
            else:
                reference: dict[str, Any] = {"$ref": f"#/$defs/{inner.model.__name__}"}
                words = inner.leaves[inner.shorthand].allowed_words if inner.shorthand else ()
                short = [{"enum": [*words]}] if words else []
                properties[key] = {"anyOf": [reference, *short, _NULL], "default": None}
        node["properties"] = properties
    schema |= {"$schema": _FileSchema.schema_dialect, "title": "ClimateGS recipe"}
    return schema


def _field(leaf: Leaf, definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the property of a field. What it takes becomes a definition, for options of choices
    are the same.
    """
    text = leaf.description + (f" [{leaf.unit}]" if leaf.unit else "")
    schema = {**_reference(leaf, definitions), "description": text}
    if not leaf.info.is_required():
        default = leaf.info.default
        schema["default"] = [*default] if isinstance(default, tuple) else default
    return schema


def _reference(leaf: Leaf, definitions: dict[str, Any]) -> dict[str, Any]:
    name = re.sub(r"\W+", "_", leaf.path)
    if name not in definitions:
        value = _value(leaf)
        if leaf.channel is not None:
            value = _list(*[_reference(leaf.channel, definitions)] * 3)
        reference = {"$ref": f"#/$defs/{name}"}
        nulls = [_NULL] if leaf.nullable else []
        ranges = _ranges(leaf, reference)
        timelines = []
        if leaf.takes_timeline:
            time = _reference(TIME, definitions)
            definitions[f"{name}_point"] = {"anyOf": [value, *_ranges(leaf.point, reference)]}
            point = {"$ref": f"#/$defs/{name}_point"}
            timelines = [_timeline(leaf, time, point)]
        definitions[name] = {"anyOf": [value, *nulls, *ranges, *timelines]}
    return {"$ref": f"#/$defs/{name}"}


def _value(leaf: Leaf) -> dict[str, Any]:
    """Return the schema of a value that is not null."""
    return TypeAdapter(leaf.annotation).json_schema(schema_generator=_FileSchema)


def _ranges(leaf: Leaf, reference: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a schema for each kind of range. reference: to that of an option."""
    end = _value(leaf)
    above_0 = {"allOf": [end, {"exclusiveMinimum": 0}]}
    weights = {"type": "array", "items": {"type": "number", "minimum": 0, "maximum": 1e9}}
    number = {"type": "number"}
    normal = {"mean": number, "std": {**number, "exclusiveMinimum": 0}, "min": end, "max": end}
    options = {"type": "array", "items": reference, "minItems": 1}
    kinds = {
        "uniform": _mapping({"uniform": _list(end, end)}),
        "log_uniform": _mapping({"log_uniform": _list(above_0, above_0)}),
        "normal": _mapping({"normal": _mapping(normal)}),
        "choice": _mapping({"choice": options}, weights=weights),
    }
    return [kinds[kind] for kind in leaf.range_kinds if kind in kinds]


def _timeline(leaf: Leaf, time: dict[str, Any], value: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a timeline. time, value: the schemas of a point's parts."""
    points = {"type": "array", "items": _list(time, value), "minItems": 1}
    shapes = ("step",) if leaf.only_steps else SHAPE.allowed_words
    options = {"shape": {"enum": [*shapes]}, "times": {"enum": [*TIMES.allowed_words]}}
    return _mapping({TIMELINE: points}, **options)


def _mapping(required: dict[str, Any], **optional: Any) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": required | optional,
        "required": [*required],
        "additionalProperties": False,
    }


def _list(*items: dict[str, Any]) -> dict[str, Any]:
    count = len(items)
    return {"type": "array", "prefixItems": [*items], "minItems": count, "maxItems": count}


def write_schema(path: str | Path) -> None:
    """Write the schema to a file, as indented UTF-8 JSON.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(recipe_json_schema(), indent=2, ensure_ascii=False)
    Path(path).write_text(text + "\n", encoding="utf-8")
