"""`recipe.yaml` of a variant, with copies of the files that the recipe names.

In: a recipe and the variant's folder. Out: files there, those of a style in `<variant>/style/`.
With these copies the recipe renders the variant again wherever the folder is moved. Jobs and the
viewer call it.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path, PurePath

from augment.errors import OutputError
from augment.output.atomic import path_below, read_file, write_atomic
from augment.output.names import folder_name
from recipes.fields import section_at, with_unchecked_field
from recipes.files import read_files
from recipes.load import dump_recipe
from recipes.schema import SECTIONS, Recipe

# Name of the recipe in a variant's folder.
RECIPE_FILE = "recipe.yaml"
# Suffixes of file names that are safe on every system.
_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,16}")


def file_folders() -> tuple[str, ...]:
    """Return the folders inside a variant's folder that hold files which recipes name."""
    return tuple(path.split(".")[-1] for path, model in SECTIONS.items() if model.file_fields)


def stored_names(recipe: Recipe) -> dict[str, str]:
    """Return the name of each of the recipe's files in the variant's folder, by dotted field path.

    A file keeps its own name where that is safe. A second file of the same name gets its field's
    name in front.
    """
    name_of_field: dict[str, str] = {}
    for section_path, section in recipe.sections().items():
        names: dict[str, str] = {}
        for key, path in section.files.items():
            name = _safe_name(path)
            while name.casefold() in {other_name.casefold() for other_name in names.values()}:
                name = f"{key}-{name}"
            names[key] = name
        folder = section_path.split(".")[-1]
        name_of_field |= {
            f"{section_path}.{key}": f"{folder}/{name}" for key, name in names.items()
        }
    return name_of_field


def portable_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe with its files named relative to the variant's folder.

    Its hash is the same.
    """
    for path, name in stored_names(recipe).items():
        recipe = with_unchecked_field(recipe, path, name)
    return recipe


def check_not_overwritten(recipe: Recipe, folders: Collection[Path]) -> None:
    """Refuse to overwrite `folders` where the recipe needs files in them."""
    for path in stored_names(recipe):
        real_path = Path(section_at(recipe, path)).resolve()
        for folder in folders:
            if real_path.is_relative_to(folder.resolve()):
                raise OutputError(
                    f"{path} of recipe {recipe.name} is {real_path}, in the folder {folder}, "
                    f"which is to be overwritten: copy the recipe and its files out of it first"
                )


def copy_files(recipe: Recipe, folder: Path) -> None:
    """Put the recipe's files where `portable_recipe` names them.

    Args:
        folder: Folder of the variant.

    Raises:
        RecipeError: A file is unreadable, or is not the one of the recipe's digest.
    """
    names = stored_names(recipe)
    for section_path, section in recipe.sections().items():
        for key, data in read_files(section).items() if section.files else ():
            path = folder / names[f"{section_path}.{key}"]
            if not (path.is_file() and read_file(path) == data):
                write_atomic(path, data)


def write_recipe(recipe: Recipe, folder: Path) -> None:
    """Write `recipe.yaml` and the files that it names.

    Args:
        folder: Folder of the variant.

    Raises:
        RecipeError: As of copy_files.
        OutputError: The system refuses, or a link leads out of the output.
    """
    variant_parts = folder.parent.name, folder.name
    for name in stored_names(recipe).values():
        path_below(folder.parents[1], (*variant_parts, *PurePath(name).parts[:-1]))
    copy_files(recipe, folder)
    write_atomic(folder / RECIPE_FILE, dump_recipe(portable_recipe(recipe)).encode())


def lacks_recipe(recipe: Recipe, folder: Path) -> bool:
    """Return True if `recipe.yaml` or a file that it names is missing.

    Args:
        folder: Folder of the variant.
    """
    names = (RECIPE_FILE, *stored_names(recipe).values())
    return not all((folder / name).is_file() for name in names)


def _safe_name(path: str) -> str:
    """Return the file's name as `folder_name` makes it, with its suffix still at the end."""
    file_path = PurePath(path)
    if _SUFFIX.fullmatch(file_path.suffix):
        return folder_name(file_path.stem) + file_path.suffix
    return folder_name(file_path.name)
