"""The styles that come with the package: statistics of colours, in YAML, and no picture."""

from __future__ import annotations

import functools
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from recipes.errors import RecipeError
from recipes.nearest import nearest_word


@functools.cache
def style_preset_names() -> tuple[str, ...]:
    """Their names, in alphabetical order."""
    stems = (Path(entry.name) for entry in _styles().iterdir())
    return tuple(sorted(path.stem for path in stems if path.suffix == ".yaml"))


def style_preset_text(name: str) -> str:
    """The YAML of a style: mean and covariance of the colours of land and of sky.

    Raises:
        RecipeError: there is no style of that name.
    """
    if name not in style_preset_names():
        raise RecipeError(f"style {name!r}: {no_such_style(name)}")
    return _styles().joinpath(f"{name}.yaml").read_text(encoding="utf-8")


def no_such_style(name: str) -> str:
    """What to say of a name that no style has."""
    names = style_preset_names()
    near = nearest_word(name, names)
    guess = f"did you mean {near}? " if near else ""
    return f"no such style; {guess}styles are {', '.join(names)}"


def _styles() -> Traversable:
    return resources.files("recipes").joinpath("styles")
