"""Texts for a page. Every text from outside is made safe here before a widget shows it.

viser compiles the content of its Markdown widgets as MDX, in which braces hold JavaScript, and puts
the content of its HTML widgets into the page as it is. So pages use no Markdown, and HTML is made
by these functions only. All other texts (labels, tooltips, options, titles) are shown letter for
letter, and need `printable`, since a name of a file need not be valid Unicode.
"""

from __future__ import annotations

import html
import unicodedata
from collections.abc import Iterable, Sequence

# The longest text on a page, characters. A page is no reader for files of megabytes.
MAX_LENGTH = 20_000
# The CSS of all texts.
STYLE = "font-size:0.875em;overflow-wrap:anywhere;padding:0 0.7em"
# The Unicode categories of characters that are invisible but change the text around them: controls,
# formats (also those that turn the direction of writing), and surrogates, which cannot be sent.
_HIDDEN = ("Cc", "Cf", "Cs")


def printable(text: str) -> str:
    """Return the text with every character that cannot be seen as its escape, on one line."""
    if len(text) > MAX_LENGTH:
        text = f"{text[:MAX_LENGTH]} ..."
    return "".join(map(_visible, text))


def escaped(text: object) -> str:
    """Return HTML that shows a text letter for letter; the lines of the text stay apart."""
    lines = str(text)[: MAX_LENGTH + 1].splitlines()
    return "<br>".join(html.escape(printable(line)) for line in lines)


def paragraph(text: object, *, style: str = "", bold: bool = False) -> str:
    """Return HTML of a paragraph that shows a text letter for letter.

    Args:
        text: Any text.
        style: Further CSS; it must not come from outside.
        bold: If True, the text is bold.
    """
    inner = f"<b>{escaped(text)}</b>" if bold else escaped(text)
    return f'<div style="{STYLE};{style}">{inner}</div>'


def table(
    head: Sequence[object], rows: Iterable[Sequence[object]], bold: Sequence[bool] = ()
) -> str:
    """Return HTML of a table that shows its texts letter for letter.

    Args:
        head: Titles of the columns.
        rows: Texts of the cells, row by row.
        bold: One a row: if True, its first cell is bold.
    """
    lines = [_row("th", head)]
    for number, cells in enumerate(rows):
        lines.append(_row("td", cells, is_bold=number < len(bold) and bold[number]))
    body = "".join(lines)
    attributes = 'border="1" bordercolor="#c8c8c8" cellpadding="4" style="border-collapse:collapse"'
    return f'<div style="{STYLE}"><table {attributes}>{body}</table></div>'


def _row(tag: str, cells: Iterable[object], *, is_bold: bool = False) -> str:
    texts = [escaped(cell) for cell in cells]
    if is_bold and texts:
        texts[0] = f"<b>{texts[0]}</b>"
    return "<tr>" + "".join(f"<{tag}>{text}</{tag}>" for text in texts) + "</tr>"


def _visible(character: str) -> str:
    if character.isprintable() or unicodedata.category(character) not in _HIDDEN:
        return character
    return character.encode("unicode_escape", "backslashreplace").decode("ascii")
