"""Recipes from files and presets."""

from __future__ import annotations

from pathlib import Path

import yaml

from recipes.errors import RecipeError, did_you_mean
from recipes.fields import packaged, packaged_text
from recipes.files import open_file
from recipes.parse import parse_recipe
from recipes.schema import Recipe, free_knobs
from recipes.template import RecipeTemplate, is_number

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
