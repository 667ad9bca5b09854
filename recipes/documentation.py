"""The table of fields in the documentation, made from the schema."""

from __future__ import annotations

from recipes.fields import ROOT, FieldSpec, Kind
from recipes.values import RANGE_KINDS, words

_HEADER = "| Field | Allowed | Default | Meaning |\n| --- | --- | --- | --- |\n"


def field_table() -> str:
    """A Markdown table of every key of a recipe file, one row each, sections in their order."""
    rows = []
    for section in ROOT.walk():
        if section.items is not None:
            path = section.path.removesuffix("[]")
            allowed = f"a list of up to {section.items.most} mappings, or null"
            rows.append(f"| `{path}` | {allowed} | `null` | {section.items.description} |\n")
        rows += [_row(spec) for spec in (*section.fields.values(), *section.extra.values())]
    return _HEADER + "".join(rows)


def _row(spec: FieldSpec) -> str:
    allowed = spec.allowed()
    if spec.rangeable:
        allowed += f"; {_ranges(spec)}"
    default = "" if spec.default is None else f"`{words(spec.default)}`"
    if spec.nullable:
        default = "`null`"
    if spec.required:
        default = "required"
    return f"| `{spec.path}` | {allowed} | {default} | {spec.description} |\n"


def _ranges(spec: FieldSpec) -> str:
    if spec.kind in (Kind.NUMBER, Kind.WHOLE):
        return f"ranges: {', '.join(RANGE_KINDS)}"
    return "ranges: choice" if spec.channel is None else "ranges: uniform, choice"
