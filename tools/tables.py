"""Tables of text, in columns for a terminal and in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def aligned(rows: Sequence[Sequence[str]], left: int = 2) -> list[str]:
    """Lines of columns, the first `left` to the left and all others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if n < left else cell.rjust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 2) -> list[str]:
    """Lines of a table; all columns but the first `left` to the right."""
    marks = ["---" if n < left else "---:" for n in range(len(header))]
    return [f"| {' | '.join(line)} |" for line in (header, marks, *rows)]
