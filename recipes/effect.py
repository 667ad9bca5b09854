"""Base classes of a recipe's sections, and how an effect declares its knobs and manifest columns.

Recipes, manifests and reports walk the models in `recipes.schema.SECTIONS`; they know no effect by
name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from recipes.fields import ClosedModel
from recipes.moment import Moment

Value = float | int | str | bool | None


@dataclass(frozen=True)
class Knob:
    """Field of a recipe that trades speed for accuracy. `climategs bench trade` measures each
    value.

    Attributes:
        path: dotted path of the field; in a model, from the model's section.
        values: from the fastest to the most accurate, which is the reference.
        description: the setting in a few words, for tables.
        rank: order in which knobs use up an allowed error; knobs that save most have the lowest
            ranks.
        is_selectable: if True, a tier or a target may set the knob. If False, it is only measured:
            the field says what is written, or none of its values saves time.
        tiers: value by tier, if it is not the reference.
        applies_to: function of a section that returns True if the knob changes anything there.
        section: dotted path of the section that `applies_to` takes; without it the knob has no
            effect. In a model, empty for the model's section.
    """

    path: str
    values: tuple[Value, ...]
    description: str
    rank: float
    is_selectable: bool = True
    tiers: Mapping[str, Value] = field(default_factory=dict, hash=False)
    applies_to: Callable[[Any], bool] = lambda section: True
    section: str = ""

    @property
    def reference(self) -> Value:
        return self.values[-1]


@dataclass(frozen=True)
class Column:
    """Column of manifests, with the words that describe its content.

    Attributes:
        value: function of a section; NaN and None mean that there is no value.
        value_if_absent: value if the recipe has no such section; None for a column of words.
        presence_values: numbers that mean that the effect is present: "all", or all but 0
            ("nonzero"). None if the column says nothing about that.
        decides_absence: if True, any other number means that the effect is absent, whatever other
            columns say.
        title: title of the number on an axis.
        unit: unit of that number, which is `factor` times the column's, or `over` divided by it.
        linear: if True, the axis is never logarithmic.
        label: words before the number in a short description of an image's weather.
        caption: template of a contact sheet's caption; it takes the number of every column by name.
    """

    name: str
    value: Callable[[Any], Value]
    title: str = ""
    unit: str = ""
    value_if_absent: float | None = math.nan
    presence_values: Literal["all", "nonzero", None] = None
    decides_absence: bool = True
    factor: float = 1.0
    numerator: float | None = None
    linear: bool = False
    label: str = ""
    caption: str = ""

    @property
    def is_number(self) -> bool:
        return self.value_if_absent is not None

    @property
    def formula(self) -> str:
        return self.name if self.numerator is None else f"{self.numerator} / {self.name}"

    def value_of(self, section: ClosedModel | None) -> float | str | None:
        """Return the column's value in a manifest row."""
        value: Any = self.value_if_absent if section is None else self.value(section)
        return math.nan if value is None and self.is_number else value

    def to_unit(self, numbers: Any) -> Any:
        """Return a manifest number, or an array of them, in `unit`."""
        return self.factor * numbers if self.numerator is None else self.numerator / numbers

    def is_present(self, numbers: Any) -> Any:
        """Return True where a manifest number says that the effect is present; also for arrays."""
        return (numbers == numbers) & ((numbers != 0) | (self.presence_values == "all"))


class Section(ClosedModel):
    """Part of a recipe.

    knobs: the knobs among its fields. later_fields: fields that are younger than the section.
    Hashes leave them out at their defaults.
    """

    knobs: ClassVar[tuple[Knob, ...]] = ()
    later_fields: ClassVar[tuple[str, ...]] = ()


class EffectModel(Section):
    """Section of an effect, which is null if the effect is absent.

    Attributes:
        columns: its columns of manifests.
        in_first_release: if True, hashes of recipes without the effect contain its null. Hashes
            leave out later effects that are absent.
        file_fields: fields that name files. The field `digest` covers the contents of these files.
        synonyms: pairs of a field and its synonyms, separated by spaces.
    """

    columns: ClassVar[tuple[Column, ...]] = ()
    in_first_release: ClassVar[bool] = False
    file_fields: ClassVar[tuple[str, ...]] = ()
    synonyms: ClassVar[tuple[tuple[str, str], ...]] = ()

    @property
    def has_effect(self) -> bool:
        """Return True if the effect changes anything with these settings."""
        return True

    @property
    def files(self) -> dict[str, str]:
        """Return the paths of the files that the section names, by field."""
        paths = {name: getattr(self, name) for name in self.file_fields}
        return {name: path for name, path in paths.items() if path is not None}

    def state_at(self, path: str, moment: Moment) -> EffectModel:
        """Return the section with the numbers that follow from the weather up to a moment.

        Its own timelines have been put in before: the fields hold their numbers at the moment.

        Args:
            path: dotted path of the section in the recipe.
            moment: the moment, with the course of all numbers that change.
        """
        return self

    def beam_surface(self, output_surface: str) -> tuple[str, bool] | None:
        """Return the surface on which a LiDAR beam can end, and whether depth images show it.

        The result is None if the effect has no such surface. output_surface: the recipe's
        output.surface.
        """
        return None
