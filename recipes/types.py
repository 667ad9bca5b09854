"""The types of a recipe's fields, shared by its models."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, Strict

MOST_PER_M = 1e6  # a micrometre of it is opaque

Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Unit = Annotated[float, Strict(), Field(ge=0.0, le=1.0)]
Colour = tuple[Unit, Unit, Unit]
PerMetre = Annotated[float, Strict(), Field(ge=0.0, le=MOST_PER_M)]
Rates = tuple[PerMetre, PerMetre, PerMetre]


class Closed(BaseModel):
    """Frozen, and an unknown key is an error: what every section of a recipe derives from."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
