"""Widgets of a page for the controls of a recipe. A widget shows a value and reports changes."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tools.view.controls import STEPS, Control
from tools.view.edits import as_yaml

if TYPE_CHECKING:
    from viser import GuiApi

MAX_EXACT = 2**53 - 1  # The largest whole number that a browser tells from its neighbours.
# The upper end of a slider that has positions and not values, percent of its length.
MAX_POSITION = 100.0
NONE = "(none)"  # The word for null in a dropdown.

Subscribe = Callable[..., None]
OnChange = Callable[[Control, str], None]
OnUpload = Callable[[Control, str, bytes], None]


class Field:
    """One control on a page.

    Args:
        gui: viser's interface of the page.
        control: The control.
        label: The label on the page; None for the field's name.
        subscribe: A function of a widget and a listener. It calls the listener with each new value
            of the widget.
        on_change: A function of the control and the field's new value as YAML.
        on_upload: A function of the control, and a file's name and content.
    """

    def __init__(
        self,
        gui: GuiApi,
        control: Control,
        subscribe: Subscribe,
        on_change: OnChange,
        on_upload: OnUpload,
        label: str | None = None,
    ) -> None:
        self.control = control
        self._subscribe = subscribe
        self._on_change = on_change
        self.label = label or control.label
        self.position_slider: Any = None  # it has positions, not values
        self._set_checkbox: Any = None
        self._parts: list[Any] = []
        make = getattr(self, f"_make_{control.kind}")
        if control.nullable and control.kind in ("slider", "number", "rates", "flag", "colour"):
            self._set_checkbox = gui.add_checkbox(f"set {self.label}", False, hint=control.tooltip)
            self._hear(self._set_checkbox, lambda is_set: control.start if is_set else None)
        make(gui, control)
        if control.kind == "file":
            button = gui.add_upload_button(f"upload {self.label}")
            subscribe(button, lambda file: on_upload(control, file.name, file.content), "on_upload")

    def show(self, value: Any) -> None:
        """Show a value, without calling `on_change`."""
        if self._set_checkbox is not None:
            self._set_checkbox.value = value is not None
            for part in self._parts:
                part.visible = value is not None
        if value is None and self.control.kind not in ("words", "file", "text", "list"):
            return
        for part, part_value in zip(self._parts, self._part_values(value), strict=True):
            part.value = part_value

    def _part_values(self, value: Any) -> tuple[Any, ...]:
        """Return the value in the form that each widget of the field takes."""
        control = self.control
        if control.kind in ("slider", "number"):
            kind = int if control.is_integer else float
            if control.kind == "slider" and control.has_box:
                return (kind(value), MAX_POSITION * control.position_at(value))
            value = min(max(value, control.low), min(control.high, MAX_EXACT))
            return (kind(value),)
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
        def on_change(part_value: Any) -> None:
            value = value_of(part_value)
            if part is self._set_checkbox or self.position_slider is not None:
                self.show(value)
            text = value if self.control.kind == "list" and value else as_yaml(value)
            self._on_change(self.control, text)

        self._subscribe(part, on_change)

    # ---- One for every kind of control

    def _make_slider(self, gui: GuiApi, control: Control) -> None:
        kind = int if control.is_integer else float
        start = kind(min(max(control.start, control.low), control.high))
        if not control.has_box:
            low, high, step = map(kind, (control.low, control.high, control.step))
            slider = gui.add_slider(self.label, low, high, step, start, hint=control.tooltip)
            self._add(slider)
            return
        least, most = map(kind, control.valid)
        number = gui.add_number(
            self.label, start, min=least, max=most, step=control.box_step, hint=control.tooltip
        )
        number.precision = control.box_digits
        self._add(number)
        marks = tuple(
            (MAX_POSITION * control.position_at(value), word) for value, word in control.marks
        )
        position = MAX_POSITION * control.position_at(start)
        is_linear = control.scale == "linear"
        steps = (control.high - control.low) / control.step if is_linear else STEPS
        self.position_slider = gui.add_slider(
            control.unit or " ",
            0.0,
            MAX_POSITION,
            MAX_POSITION / steps,
            position,
            marks=marks,
            hint=control.tooltip,
        )
        self._add(self.position_slider, lambda value: kind(control.value_at(value / MAX_POSITION)))

    def _make_number(self, gui: GuiApi, control: Control) -> None:
        kind = int if control.is_integer else float
        low = kind(max(control.low, -MAX_EXACT))
        high = kind(min(control.high, MAX_EXACT))
        number = gui.add_number(
            self.label, kind(control.start), min=low, max=high, hint=control.tooltip
        )
        self._add(number)

    def _make_flag(self, gui: GuiApi, control: Control) -> None:
        self._add(gui.add_checkbox(self.label, bool(control.default), hint=control.tooltip))

    def _make_words(self, gui: GuiApi, control: Control) -> None:
        words = (NONE, *control.words) if control.nullable else control.words
        box = gui.add_dropdown(self.label, words, hint=control.tooltip)
        plain = {NONE: None, "true": True, "false": False}
        self._add(box, lambda word: plain.get(word, word))

    def _make_colour(self, gui: GuiApi, control: Control) -> None:
        rgb = tuple(round(255 * channel) for channel in control.start)
        part = gui.add_rgb(self.label, rgb, hint=control.tooltip)
        self._add(part, lambda rgb: [round(channel / 255, 4) for channel in rgb])

    def _make_rates(self, gui: GuiApi, control: Control) -> None:
        red, green, blue = map(float, control.start)
        least = (0.0, 0.0, 0.0)
        part = gui.add_vector3(
            self.label, (red, green, blue), min=least, step=0.01, hint=control.tooltip
        )
        self._add(part, list)

    def _make_text(self, gui: GuiApi, control: Control) -> None:
        self._add(gui.add_text(self.label, "", hint=control.tooltip), lambda text: text or None)

    _make_file = _make_list = _make_text
