"""Tables and headed sections of a report's page."""

from __future__ import annotations

from collections.abc import Sequence

from tools.report_html import Html, joined, tag

MAX_ROWS = 40  # of a table
OPEN_ROWS = 12  # tables of more are folded


def section(identity: str, title: str, *parts: Html | None) -> Html:
    """Nothing where all parts are empty."""
    inside = [part for part in parts if part]
    if not inside:
        return Html("")
    return tag("section", tag("h2", title), inside, id=identity)


def facts(rows: Sequence[tuple[str, Sequence[str]]]) -> Html:
    """What all images share, or the few values that they have."""
    pairs = [
        tag("div", tag("dt", name), tag("dd", ", ".join(values))) for name, values in rows if values
    ]
    return tag("dl", pairs, class_="facts")


def folded_table(
    title: str, heads: Sequence[str], rows: Sequence[list[Html]], note: str | None, words: int
) -> Html:
    return tag(
        "details",
        tag("summary", title),
        table(heads, rows, note, words),
        open=len(rows) <= OPEN_ROWS,
    )


def table(
    heads: Sequence[str] | None, rows: Sequence[list[Html]], note: str | None, words: int
) -> Html:
    """words: how many columns from the left hold words; the rest are numbers."""
    head = None
    if heads is not None:
        cells = [
            tag("th", name, scope="col", class_="n" if i >= words and name != "Message" else None)
            for i, name in enumerate(heads)
        ]
        head = tag("thead", tag("tr", cells))
    body = tag("tbody", [tag("tr", row) for row in rows])
    inside = tag("div", tag("table", head, body), class_="scroll")
    return joined([inside, tag("p", note, class_="note") if note else None])


def number_cell(said: str) -> Html:
    return tag("td", said, class_="n")
