"""Frame numbers as people write them: `all`, `4`, `0,5,9`, `0:20:2`, `::5`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

GRAMMAR = "write all, 4, 0,5,9, 0:20:2 or ::5 (start:stop:step, stop excluded)"


@dataclass(frozen=True)
class FramePattern:
    """Numbers and ranges of numbers, in the order written. pieces: None stands for all frames."""

    text: str
    pieces: tuple[int | slice, ...] | None

    def select(self, numbers: Sequence[int], *, clip: bool = False) -> tuple[int, ...] | None:
        """The wanted numbers, each once, in the order written; None for all.

        numbers: those there are, to which an open range goes. clip: leave out what of a range is
        not among them; a number on its own is kept even so, for whoever looks it up to refuse.
        """
        if self.pieces is None:
            return None
        there, end = set(numbers), max(numbers, default=-1) + 1
        wanted: list[int] = []
        for piece in self.pieces:
            if isinstance(piece, int):
                wanted.append(piece)
                continue
            start = 0 if piece.start is None else piece.start
            stop = end if piece.stop is None else piece.stop
            is_open = piece.start is None or piece.stop is None
            run = range(start, min(stop, end) if clip else stop, piece.step or 1)
            wanted += [n for n in run if n in there] if clip or is_open else run
        return tuple(dict.fromkeys(wanted))


def parse_frames(text: str) -> FramePattern:
    """The pattern in a text.

    Raises:
        ValueError: the text is none; says what is.
    """
    if text.strip() == "all":
        return FramePattern(text, None)
    try:
        return FramePattern(text, tuple(_piece(piece) for piece in text.split(",")))
    except ValueError:
        raise ValueError(f"{text!r} is not understood; {GRAMMAR}") from None


def _piece(text: str) -> int | slice:
    if ":" not in text:
        return _number(text)
    values = [None if not part.strip() else _number(part) for part in text.split(":")]
    if len(values) > 3 or (len(values) == 3 and values[2] == 0):
        raise ValueError
    start, stop, step = [*values, None][:3]
    if start is not None and stop is not None and stop <= start:
        raise ValueError
    return slice(start, stop, step)


def _number(text: str) -> int:
    if not text.strip().isdecimal():
        raise ValueError
    return int(text)
