"""A recipe's controls as widgets of a page, each of which takes a value and tells of changes."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tools.view.controls import Control
from tools.view.edits import as_yaml

if TYPE_CHECKING:
    from viser import GuiApi

MAX_EXACT = 2**53 - 1  # the largest whole number that a browser tells from its neighbours
WAY = 100.0  # of a slider that does not stand for its values themselves
NONE = "(none)"

When = Callable[..., None]
Changed = Callable[[Control, str], None]
Uploaded = Callable[[Control, str, bytes], None]


class Field:
    """One control on a page. when: has a function told what people do to a widget. changed: hears
    the field's new value as YAML; uploaded: a file's name and content.
    """

    def __init__(
        self, gui: GuiApi, control: Control, when: When, changed: Changed, uploaded: Uploaded
    ) -> None:
        self.control, self._when, self._changed = control, when, changed
        self._given: Any = None
        self._parts: list[Any] = []
        make = getattr(self, f"_make_{control.kind}")
        if control.nullable and control.kind in ("slider", "number", "rates", "flag", "colour"):
            self._given = gui.add_checkbox(control.label, False, hint=control.hint)
            self._hear(self._given, lambda there: control.start if there else None)
        make(gui, control)
        if control.kind == "file":
            button = gui.add_upload_button(f"upload {control.label}")
            when(button, lambda file: uploaded(control, file.name, file.content), "on_upload")

    def show(self, value: Any) -> None:
        """Stand at a value; telling nobody."""
        if self._given is not None:
            self._given.value = value is not None
            for part in self._parts:
                part.visible = value is not None
        if value is None and self.control.kind not in ("words", "file", "text", "list"):
            return
        for part, shown in zip(self._parts, self._shown(value), strict=True):
            part.value = shown

    def _shown(self, value: Any) -> tuple[Any, ...]:
        """The value as each of the widgets says it."""
        control = self.control
        if control.kind == "slider" and control.way != "linear":
            return (float(value), WAY * control.way_of(value))
        if control.kind in ("slider", "number"):
            value = min(max(value, control.low), min(control.high, MAX_EXACT))
            return (int(value) if control.whole else float(value),)
        if control.kind == "colour":
            return (tuple(round(255 * channel) for channel in value),)
        if control.kind == "rates":
            return (tuple(map(float, value)),)
        if control.kind == "words":
            return (NONE if value is None else json.dumps(value).strip('"'),)
        if control.kind == "list":
            items = [item.model_dump(mode="json") for item in value or ()]
            return ("" if value is None else as_yaml(items),)
        return ("" if value is None else value,)

    def _add(self, part: Any, value_of: Callable[[Any], Any] = lambda value: value) -> None:
        self._parts.append(part)
        self._hear(part, value_of)

    def _hear(self, part: Any, value_of: Callable[[Any], Any]) -> None:
        def heard(shown: Any) -> None:
            value = value_of(shown)
            if part is self._given or self.control.way != "linear":
                self.show(value)
            text = value if self.control.kind == "list" and value else as_yaml(value)
            self._changed(self.control, text)

        self._when(part, heard)

    # ---- One for every kind of control

    def _make_slider(self, gui: GuiApi, control: Control) -> None:
        hint, start = control.hint, control.start
        if control.way != "linear":
            low, high, step = control.low, control.high, control.step
            number = gui.add_number(
                control.label, float(start), min=low, max=high, step=step, hint=hint
            )
            self._add(number)
            marks = tuple((WAY * control.way_of(value), word) for value, word in control.marks)
            way = WAY * control.way_of(start)
            slider = gui.add_slider(" ", 0.0, WAY, 0.5, way, marks=marks, hint=hint)
            self._add(slider, lambda way: control.value_at(way / WAY))
            return
        kind = int if control.whole else float
        low, high, step = map(kind, (control.low, control.high, control.step))
        self._add(gui.add_slider(control.label, low, high, step, kind(start), hint=hint))

    def _make_number(self, gui: GuiApi, control: Control) -> None:
        kind = int if control.whole else float
        low, high = kind(max(control.low, -MAX_EXACT)), kind(min(control.high, MAX_EXACT))
        number = gui.add_number(
            control.label, kind(control.start), min=low, max=high, hint=control.hint
        )
        self._add(number)

    def _make_flag(self, gui: GuiApi, control: Control) -> None:
        self._add(gui.add_checkbox(control.label, bool(control.default), hint=control.hint))

    def _make_words(self, gui: GuiApi, control: Control) -> None:
        words = (NONE, *control.words) if control.nullable else control.words
        box = gui.add_dropdown(control.label, words, hint=control.hint)
        plain = {NONE: None, "true": True, "false": False}
        self._add(box, lambda word: plain.get(word, word))

    def _make_colour(self, gui: GuiApi, control: Control) -> None:
        rgb = tuple(round(255 * channel) for channel in control.start)
        part = gui.add_rgb(control.label, rgb, hint=control.hint)
        self._add(part, lambda rgb: [round(channel / 255, 4) for channel in rgb])

    def _make_rates(self, gui: GuiApi, control: Control) -> None:
        red, green, blue = map(float, control.start)
        least = (0.0, 0.0, 0.0)
        part = gui.add_vector3(
            control.label, (red, green, blue), min=least, step=0.01, hint=control.hint
        )
        self._add(part, list)

    def _make_text(self, gui: GuiApi, control: Control) -> None:
        self._add(gui.add_text(control.label, "", hint=control.hint), lambda text: text or None)

    _make_file = _make_list = _make_text
