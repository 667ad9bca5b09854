"""The files of a style beside the images that it made: `<variant>/style/`, and what names them.

With them a variant's `recipe.yaml` renders it again wherever the folder is taken.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path, PurePath

from augment.batch.atomic import write_atomic
from augment.batch.layout import folder_name
from augment.errors import OutputError
from recipes.files import read_files
from recipes.schema import Recipe
from recipes.style import Style

STYLE_FOLDER = "style"
_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,16}")


def stored_names(style: Style) -> dict[str, str]:
    """The name of each of the style's files inside the variant's folder, by field.

    The image keeps its name where that is safe; another file of the same name gets its field's
    name before its own.
    """
    names: dict[str, str] = {}
    for field, path in style.files.items():
        name = _safe_name(path)
        while name.casefold() in {taken.casefold() for taken in names.values()}:
            name = f"{field}-{name}"
        names[field] = name
    return {field: f"{STYLE_FOLDER}/{name}" for field, name in names.items()}


def portable_recipe(recipe: Recipe) -> Recipe:
    """The recipe with its style's files named from the variant's folder; its hash is the same."""
    style = recipe.style
    if style is None or not style.files:
        return recipe
    return recipe.model_copy(update={"style": style.model_copy(update=stored_names(style))})


def check_kept(recipe: Recipe, folders: Collection[Path]) -> None:
    """Refuse to overwrite the files that the recipe is about to need. folders: to be overwritten.

    Raises:
        OutputError: one of the style's files lies in such a folder.
    """
    files = {} if recipe.style is None else recipe.style.files
    for field, path in files.items():
        real = Path(path).resolve()
        for folder in folders:
            if real.is_relative_to(folder.resolve()):
                raise OutputError(
                    f"style.{field} of recipe {recipe.name} is {real}, in the folder {folder}, "
                    f"which is to be overwritten: copy the recipe and its files out of it first"
                )


def copy_style_files(recipe: Recipe, folder: Path) -> None:
    """Put the style's files where `portable_recipe` names them. folder: the variant's.

    Raises:
        RecipeError: they cannot be read or are not those of the recipe's digest.
        OutputError: they cannot be written.
    """
    if recipe.style is None or not recipe.style.files:
        return
    names = stored_names(recipe.style)
    for field, data in read_files(recipe.style).items():
        path = folder / names[field]
        if not (path.is_file() and path.read_bytes() == data):
            write_atomic(path, data)


def _safe_name(path: str) -> str:
    """The file's name as `folder_name` has it, with its suffix still at the end."""
    name = PurePath(path)
    if _SUFFIX.fullmatch(name.suffix):
        return folder_name(name.stem) + name.suffix
    return folder_name(name.name)
