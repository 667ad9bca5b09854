"""A recipe in numbers -> the YAML that reads back as the same recipe."""

from __future__ import annotations

import yaml

from recipes.knobs import free_knobs
from recipes.schema import Recipe
from recipes.values import is_number


class _Dumper(yaml.SafeDumper):
    """Colours and rates on one line; no anchors."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _sequence(dumper: _Dumper, data: tuple[object, ...]) -> yaml.Node:
    flat = all(map(is_number, data))
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


_Dumper.add_representer(tuple, _sequence)


def dump_recipe(recipe: Recipe) -> str:
    """YAML with every field written out, defaults included, and the hash in a comment.

    `parse_recipe(dump_recipe(r), ...).resolve(0)` equals r: floats keep all their bits, and the
    variant's number is kept. Paths of files are written as they are, and a recipe file names files
    from its own folder only: give them such names first, as a job does. Settings that the recipe's
    quality has still to choose, in view of a scene, are left out.
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
