"""What a page needs of the browser beside viser's widgets: which keys fly, and one style."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from viser import ClientHandle

# viser's camera hears keys on the document, and lets only those pass that are typed into a text or
# a number. Sliders, tabs and lists move by the arrow keys themselves: what has the focus gets them,
# and below the document nothing else hears them. A click on the picture gives it the keys again.
_ARROWS_STAY_WITH_WIDGETS = """
if (!window.climategsKeys) {
  window.climategsKeys = true;
  const moves = "[role=slider], [role=tab], [role=option], [role=listbox], [role=menuitem]";
  document.body.addEventListener("keydown", (event) => {
    const widget = event.target instanceof Element && event.target.closest(moves);
    if (widget && event.key.startsWith("Arrow")) event.stopPropagation();
  });
  document.body.addEventListener("pointerdown", (event) => {
    const focused = document.activeElement;
    if (event.target instanceof HTMLCanvasElement && focused instanceof HTMLElement) focused.blur();
  }, true);
}
"""


def keep_arrow_keys_with_widgets(client: ClientHandle) -> None:
    """Have the arrow keys move the slider, tab or list that has the focus, and not the camera."""
    from viser._messages import RunJavascriptMessage

    client.gui._websock_interface.queue_message(RunJavascriptMessage(_ARROWS_STAY_WITH_WIDGETS))


def style_of_place_sliders(sliders: Iterable[Any]) -> str:
    """HTML that hides the number boxes which viser puts beside sliders, and leaves room for marks.

    Args:
        sliders: Handles of sliders whose numbers are places along their way, which tell nobody
            anything: the value stands in a box of its own.
    """
    names = [f"[id='{slider._impl.uuid}']" for slider in sliders]
    if not names:
        return ""
    boxes = ", ".join(f"{name} + *" for name in names)
    rules = f"{boxes} {{ display: none }} {', '.join(names)} {{ margin-bottom: 1em }}"
    return f"<style>{rules}</style>"
