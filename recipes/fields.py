"""Parts of recipe models: types of fields, models that refuse unknown keys, access by dotted
path.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Strict,
)
from pydantic.config import JsonDict
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from recipes.errors import did_you_mean

# Largest extinction, 1/metre: a micrometre is opaque.
MAX_PER_M = 1e6

Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Unit = Annotated[float, Strict(), Field(ge=0.0, le=1.0)]
Colour = tuple[Unit, Unit, Unit]
PerMetre = Annotated[float, Strict(), Field(ge=0.0, le=MAX_PER_M)]
Rates = tuple[PerMetre, PerMetre, PerMetre]
Angle = Annotated[float, Strict(), Field(ge=-360, le=360)]
Seed = Annotated[int, Strict(), Field(ge=0, lt=2**63)]
# In a recipe file a path below its folder; in a recipe in numbers any path.
FilePath = Annotated[
    str,
    Strict(),
    Field(
        min_length=1,
        max_length=4096,
        title="a file in the recipe's folder or below it",
        json_schema_extra={"pattern": r"^[^/\\][^\\]*$"},
    ),
]
Digest = Annotated[
    str, Strict(), Field(pattern=r"^[0-9a-f]{64}$", title="64 hexadecimal digits, small letters")
]


@dataclass(frozen=True)
class OneOf:
    """Annotation of a text that must be one of `names`. noun: the kind of thing that they name."""

    noun: str
    names: Callable[[], tuple[str, ...]]

    def refusal(self, name: str) -> str:
        """Return the message for a name that is not among `names`."""
        names = self.names()
        guess = did_you_mean(name, names)
        return f"no such {self.noun}; {guess}{self.noun}s are {', '.join(names)}"

    def check(self, name: str) -> str:
        if name not in self.names():
            raise ValueError(self.refusal(name))
        return name

    def __get_pydantic_core_schema__(self, of: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(of))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return {"enum": list(self.names())}


class Closed(BaseModel):
    """Base of every section of a recipe: frozen, and an unknown key is an error.

    The text below a field is its description.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )


# ---- Fields of nested models by dotted path: read, given or not, and changed in a copy -----------

Model = TypeVar("Model", bound=BaseModel)


def found(model: BaseModel, path: str) -> Any:
    """Return the value at a dotted path, or None if a section on the path is absent."""
    value: Any = model
    for name in path.split("."):
        if value is None:
            return None
        value = getattr(value, name)
    return value


def is_given(model: BaseModel, path: str) -> bool:
    """Return True if the field was set when the model was made; False for a mere default."""
    value: Any = model
    for name in path.split("."):
        if value is None or name not in value.model_fields_set:
            return False
        value = getattr(value, name)
    return True


def replaced(model: Model, path: str, value: object) -> Model:
    """Return a copy with one field set, unchecked. The field then counts as given.

    Raises:
        KeyError: a section on the path is absent.
    """
    name, _, inner_path = path.partition(".")
    if inner_path:
        section = getattr(model, name)
        if section is None:
            raise KeyError(f"{name} is absent, so {path} cannot be set")
        value = replaced(section, inner_path, value)
    return model.model_copy(update={name: value})


def changed(model: Model, values: Mapping[str, object]) -> Model:
    """Return a copy with fields set by their dotted paths. Other given fields stay given.

    Raises:
        ValueError: the result breaks a rule of the model.
        KeyError: a section on the path is absent.
    """
    for path, value in values.items():
        model = replaced(model, path, value)
    type(model).model_validate(model.model_dump())
    return model


PRESENT: JsonDict = {"not": {"type": "null"}}


def one_of(*names: str) -> JsonDict:
    """Return the JSON Schema of "exactly one of the fields is present and not null"."""
    return {"oneOf": [{"required": [name], "properties": {name: PRESENT}} for name in names]}


# ---- YAML that comes with the package ------------------------------------------------------------


@functools.cache
def packaged_names(folder: str) -> tuple[str, ...]:
    """Return the stems of the YAML files in a folder of this package, in alphabetical order."""
    names = (Path(entry.name) for entry in resources.files("recipes").joinpath(folder).iterdir())
    return tuple(sorted(path.stem for path in names if path.suffix == ".yaml"))


def packaged_text(folder: str, name: str) -> str:
    """Return the text of one of these files."""
    file = resources.files("recipes").joinpath(folder, f"{name}.yaml")
    return file.read_text(encoding="utf-8")
