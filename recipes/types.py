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
# In a recipe file a path below its folder; in a recipe in numbers any path.
FilePath = Annotated[str, Strict(), Field(min_length=1, max_length=4096)]
Digest = Annotated[str, Strict(), Field(pattern=r"^[0-9a-f]{64}$")]


class Closed(BaseModel):
    """Frozen, and an unknown key is an error: what every section of a recipe derives from."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
