"""Base classes of a recipe's sections, and how an effect declares its knobs and manifest columns.

Recipes, manifests and reports walk the models in `recipes.schema.SECTIONS`; they know no effect by
name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from recipes.fields import Closed

Value = float | int | str | bool | None


@dataclass(frozen=True)
class Knob:
    """A field that trades speed for accuracy; `climategs bench trade` measures each value.

    path: dotted, on a model from its section. values: from the fastest to the most accurate, which
    is reference. what: of which error and which time, in a few words. rank: those that save most
    have the lowest, and first call on an error that is allowed. chosen: whether a tier or a target
    may set it; else it is only measured: it says what is written, or has no value that saves time.
    tiers: what a tier sets in place of reference. works: whether it has an effect in a section.
    section: its dotted path.
    """

    path: str
    values: tuple[Value, ...]
    what: str
    rank: float
    chosen: bool = True
    tiers: Mapping[str, Value] = field(default_factory=dict, hash=False)
    works: Callable[[Any], bool] = lambda section: True
    section: str = ""

    @property
    def reference(self) -> Value:
        return self.values[-1]


@dataclass(frozen=True)
class Column:
    """A column of manifests, and how people are told what it holds.

    value: of a section; NaN and null are absent. absent: without the section; None makes it a
    column of words. shows: which numbers say that the effect is there: all, or all but 0. refutes:
    whether the others say that it is not, whatever further columns say. title,
    unit: of the number shown, which is `factor` times the column's or `over` over it. linear: its
    axis is not logarithmic, however far it is spread. label: before it, where an image's weather is
    told in a few words. caption: of a contact sheet, from all shown numbers by column.
    """

    name: str
    value: Callable[[Any], Value]
    title: str = ""
    unit: str = ""
    absent: float | None = math.nan
    shows: Literal["all", "nonzero", None] = None
    refutes: bool = True
    factor: float = 1.0
    over: float | None = None
    linear: bool = False
    label: str = ""
    caption: str = ""

    @property
    def is_number(self) -> bool:
        return self.absent is not None

    @property
    def formula(self) -> str:
        return self.name if self.over is None else f"{self.over} / {self.name}"

    def of(self, section: Closed | None) -> float | str | None:
        """Return the column's value in a manifest row."""
        value: Any = self.absent if section is None else self.value(section)
        return math.nan if value is None and self.is_number else value

    def shown(self, numbers: Any) -> Any:
        """Return a manifest number, or an array of them, in `unit`."""
        return self.factor * numbers if self.over is None else self.over / numbers

    def is_present(self, numbers: Any) -> Any:
        """Return True where a manifest number says that the effect is present; also for arrays."""
        return (numbers == numbers) & ((numbers != 0) | (self.shows == "all"))


class Section(Closed):
    """A part of a recipe. knobs: of its fields. later_fields: younger than the section; hashes
    leave them out at their defaults.
    """

    knobs: ClassVar[tuple[Knob, ...]] = ()
    later_fields: ClassVar[tuple[str, ...]] = ()


class EffectModel(Section):
    """A section that is null where its effect is absent.

    in_first_release: hashes of recipes without it say so; of a later one they say nothing.
    file_fields: those that name files, whose contents go into the field `digest`. meant_by: keys,
    each with the words that people write for it.
    """

    columns: ClassVar[tuple[Column, ...]] = ()
    in_first_release: ClassVar[bool] = False
    file_fields: ClassVar[tuple[str, ...]] = ()
    meant_by: ClassVar[tuple[tuple[str, str], ...]] = ()

    @property
    def changes(self) -> bool:
        """True if the effect changes anything with these settings."""
        return True

    @property
    def files(self) -> dict[str, str]:
        """Paths of the files that the section names, by field."""
        paths = {name: getattr(self, name) for name in self.file_fields}
        return {name: path for name, path in paths.items() if path is not None}

    def surface(self, shown: str) -> tuple[str, bool] | None:
        """Return the surface on which a LiDAR beam can end, and whether depth images show it.

        None if the effect has no such surface. shown: the recipe's output.surface.
        """
        return None
