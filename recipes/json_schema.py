"""JSON Schema of a recipe file, for editors that complete and check YAML while it is typed.

It describes the file, not the recipe in numbers: every field takes a literal or a range. What JSON
Schema cannot say (which end is the lower, rules between draws) is left to `load_recipe`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from recipes.schema import VERSION
from recipes.template import CHANNEL, RATE, FieldSpec, Kind, SectionSpec, root

DIALECT = "https://json-schema.org/draft/2020-12/schema"

_LIMITS = {">": "exclusiveMinimum", ">=": "minimum", "<": "exclusiveMaximum", "<=": "maximum"}

_PATTERNS = {Kind.PATH: {"pattern": r"^[^/\\][^\\]*$"}, Kind.DIGEST: {"pattern": "^[0-9a-f]{64}$"}}

Schema = dict[str, Any]


def recipe_json_schema() -> Schema:
    """The schema (draft 2020-12), a fresh dict made of JSON's own types."""
    definitions = {spec.path: _with_ranges(spec, spec.path) for spec in (CHANNEL, RATE)}
    schema = _section(root(), definitions)
    schema["properties"]["version"] = {"const": VERSION, "description": "Version of this format."}
    return {
        "$schema": DIALECT,
        "title": "ClimateGS recipe",
        **schema,
        "description": "A recipe file: which weather a scene gets, with ranges to draw from.",
        "$defs": definitions,
    }


def write_schema(path: str | Path) -> None:
    """Write the schema to a file, as indented UTF-8 JSON.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(recipe_json_schema(), indent=2, ensure_ascii=False)
    Path(path).write_text(text + "\n", encoding="utf-8")


def _section(section: SectionSpec, definitions: Schema) -> Schema:
    specs = {**section.fields, **section.extra}
    properties: Schema = {name: _field(spec, definitions) for name, spec in specs.items()}
    for name, below in section.sections.items():
        schema = _section(below, definitions)
        if below.max_items is not None:
            described = {"description": below.list_description, "maxItems": below.max_items}
            schema = {"type": "array", "items": schema, **described}
        # 'weather:' with nothing after it is null
        ways = [schema, {"type": "null"}]
        if below.shorthand is not None:
            ways.append(_literal(below.fields[below.shorthand].without_null))
        properties[name] = {"oneOf": ways}
    required = [name for name, spec in section.fields.items() if spec.required]
    extra = section.model.model_config.get("json_schema_extra") or {}
    assert isinstance(extra, dict), "the models state what else holds as JSON, not as functions"
    return {
        "type": "object",
        "description": section.description,
        "properties": properties,
        **({"required": required} if required else {}),
        "additionalProperties": False,
        **extra,
    }


def _field(spec: FieldSpec, definitions: Schema) -> Schema:
    unit = f" [{spec.unit}]" if spec.unit else ""
    described: Schema = {"description": spec.description + unit}
    if (default := spec.default) is not None:
        described["default"] = list(default) if isinstance(default, tuple) else default
    if not spec.rangeable:
        return {**_literal(spec), **described}
    definitions[spec.path] = _with_ranges(spec, spec.path)
    return {"$ref": f"#/$defs/{spec.path}", **described}


def _literal(spec: FieldSpec) -> Schema:
    null = ["null"] if spec.nullable else []
    if spec.kind is Kind.WORD or (spec.kind is Kind.FLAG and spec.words):
        flags = [True, False] if spec.kind is Kind.FLAG else []
        return {"enum": [*flags, *spec.words, *(None for _ in null)]}
    if spec.channel is not None:
        items = {"$ref": f"#/$defs/{spec.channel.path}"}
        return {"type": ["array", *null], "items": items, "minItems": 3, "maxItems": 3}
    if spec.kind.is_text:  # taken as it is written
        return {"type": ["string", "number", "boolean", *null], **_PATTERNS.get(spec.kind, {})}
    name = {Kind.NUMBER: "number", Kind.WHOLE: "integer", Kind.FLAG: "boolean"}[spec.kind]
    limits = {_LIMITS[sign]: bound for sign, bound in spec.limits}
    return {"type": [name, *null] if null else name, **limits}


def _with_ranges(spec: FieldSpec, definition: str) -> Schema:
    literal, end = _literal(spec), _literal(spec.without_null)
    ranges = [_choice(definition)]
    if spec.channel is not None:
        plain = {**end, "items": _literal(spec.channel)}
        ranges.append(_closed({"uniform": _pair(plain)}))
    elif spec.kind in (Kind.NUMBER, Kind.WHOLE):
        above_0 = {"allOf": [end, {"exclusiveMinimum": 0}]}
        spread = {"type": "number", "exclusiveMinimum": 0}
        normal = {"mean": {"type": "number"}, "std": spread, "min": end, "max": end}
        ranges.append(_closed({"uniform": _pair(end)}))
        ranges.append(_closed({"log_uniform": _pair(above_0)}))
        ranges.append(_closed({"normal": _closed(normal)}))
    return {"oneOf": [literal, *ranges]}


def _choice(definition: str) -> Schema:
    weights = {"type": "array", "items": {"type": "number", "minimum": 0, "maximum": 1e9}}
    options = {"type": "array", "items": {"$ref": f"#/$defs/{definition}"}, "minItems": 1}
    schema = _closed({"choice": options})
    schema["properties"]["weights"] = weights
    return schema


def _pair(item: Schema) -> Schema:
    return {"type": "array", "items": item, "minItems": 2, "maxItems": 2}


def _closed(properties: Schema) -> Schema:
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }
