"""Script and style that a page has in addition to viser's: which keys fly, and how it looks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

# viser's camera hears keys on the document, and lets only those pass that are typed into a text or
# a number. Sliders, tabs and lists move by the arrow keys themselves: what has the focus gets them,
# and below the document nothing else hears them. A click on the picture gives it the keys again.
ARROWS_STAY_WITH_WIDGETS = """
const moves = "[role=slider], [role=tab], [role=option], [role=listbox], [role=menuitem]";
document.body.addEventListener("keydown", (event) => {
  const widget = event.target instanceof Element && event.target.closest(moves);
  if (widget && event.key.startsWith("Arrow")) event.stopPropagation();
});
document.body.addEventListener("pointerdown", (event) => {
  const focused = document.activeElement;
  if (event.target instanceof HTMLCanvasElement && focused instanceof HTMLElement) focused.blur();
}, true);
"""


def page_style(position_sliders: Iterable[Any], headings: Iterable[Any]) -> str:
    """Return the page's style as HTML.

    Args:
        position_sliders: Handles of sliders whose numbers are positions and not values. The style
            hides viser's box beside them, since the value has a separate box, and leaves room for
            their marks.
        headings: Handles of checkboxes that begin a part of the page; their labels are bold.
    """
    sliders = [f"[id='{handle._impl.uuid}']" for handle in position_sliders]
    labels = [f"label[for='{handle._impl.uuid}']" for handle in headings]
    rules = {
        ", ".join(f"{slider} + *" for slider in sliders): "display: none",
        ", ".join(sliders): "margin-bottom: 1em",
        ", ".join(labels): "font-weight: bold; color: black",
    }
    text = " ".join(f"{selector} {{ {style} }}" for selector, style in rules.items() if selector)
    return f"<style>{text}</style>"
