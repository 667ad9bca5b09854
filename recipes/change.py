"""Fields of nested models by dotted path: read, given or not, and changed in a copy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel

Model = TypeVar("Model", bound=BaseModel)


def found(model: BaseModel, path: str) -> Any:
    """The value at a dotted path; None where a section on the way is absent."""
    value: Any = model
    for name in path.split("."):
        if value is None:
            return None
        value = getattr(value, name)
    return value


def is_given(model: BaseModel, path: str) -> bool:
    """Whether the field was set when the model was made, and does not just have its default."""
    value: Any = model
    for name in path.split("."):
        if value is None or name not in value.model_fields_set:
            return False
        value = getattr(value, name)
    return True


def replaced(model: Model, path: str, value: object) -> Model:
    """A copy with one field set, unchecked, and given; KeyError where a section is absent."""
    name, _, rest = path.partition(".")
    if rest:
        section = getattr(model, name)
        if section is None:
            raise KeyError(f"{name} is absent, so {path} cannot be set")
        value = replaced(section, rest, value)
    return model.model_copy(update={name: value})


def changed(model: Model, values: Mapping[str, object]) -> Model:
    """A copy with fields set by their dotted paths; what else is given stays so.

    Raises:
        ValueError: what comes out breaks a rule of the model.
        KeyError: a section on the way is absent.
    """
    for path, value in values.items():
        model = replaced(model, path, value)
    type(model).model_validate(model.model_dump())
    return model
