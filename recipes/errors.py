"""The error of this package, the places to which it points, and the words of its guesses."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

# Largest number of lines of an error. If there are more, their cause is elsewhere.
MAX_SHOWN = 40


class RecipeError(Exception):
    """Raised if a recipe cannot be used.

    It has one line per problem: file and line, dotted field, value, and the allowed values.
    """

    @property
    def problems(self) -> tuple[str, ...]:
        """Return the lines, without the newlines between them."""
        return tuple(str(problem) for problem in self.args)

    def __str__(self) -> str:
        return "\n".join(self.problems)


@dataclass(frozen=True)
class Place:
    """Source, line and folder of a piece of text, for messages.

    Attributes:
        source: a file, a preset or an option of the command line.
        line: counted from 1. None without lines.
        folder: folder of the files that the text names. None if it can name none.
    """

    source: str
    line: int | None = 1
    folder: Path | None = None

    def __str__(self) -> str:
        return self.source if self.line is None else f"{self.source}:{self.line}"

    def error(self, text: str) -> RecipeError:
        """Return the error for a problem after which nothing else can be checked."""
        return RecipeError(f"{self}: {text}")


class Problems:
    """Collects problems, so that all of them are reported at once."""

    def __init__(self) -> None:
        self._entries: list[tuple[Place, str]] = []

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, place: Place, text: str) -> None:
        self._entries.append((place, text))

    def raise_if_any(self) -> None:
        """Raise every problem so far, in the order of the lines of each source.

        Raises:
            RecipeError: there is at least one.
        """
        sources = list(dict.fromkeys(place.source for place, _ in self._entries))
        ordered = sorted(
            self._entries, key=lambda entry: (sources.index(entry[0].source), entry[0].line or 0)
        )
        lines = [f"{place}: {text}" for place, text in ordered]
        if len(lines) > MAX_SHOWN:
            lines[MAX_SHOWN:] = [f"{sources[0]}: and {len(lines) - MAX_SHOWN} problems more"]
        if lines:
            raise RecipeError(*lines)


def nearest_word(word: str, words: Iterable[str]) -> str | None:
    """Return the option that is most like `word`, or None."""
    matches = difflib.get_close_matches(word.lower(), words, n=1, cutoff=0.6)
    return matches[0] if matches else None


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return a guess as a part of a message, with a space after it; '' without one."""
    guess = nearest_word(word, words)
    return f"did you mean {guess}? " if guess else ""


def short(text: str, limit: int = 60) -> str:
    """Return one printable line of at most `limit` characters."""
    printable = text if text.isprintable() else repr(text)[1:-1]
    return printable if len(printable) <= limit else printable[: limit - 1] + "…"


def join(path: str, name: str) -> str:
    """Return the dotted path of a key in a section; '' is the top."""
    return f"{path}.{name}" if path else name


def dotted(location: Iterable[int | str]) -> str:
    """Return pydantic's location of an error as a path: `waves.components[1].steepness`."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{short(part)}" for part in location)
    return "".join(parts).removeprefix(".")


def readable(error: ValidationError) -> list[str]:
    """Return pydantic's problems, one line each: the field, then the problem."""
    lines = []
    for item in error.errors(include_url=False):
        path = dotted(item["loc"])
        cause = item.get("ctx", {}).get("error")
        text = str(cause) if isinstance(cause, ValueError) else item["msg"]
        lines.append(f"{path}: {text}" if path else text)
    return lines
