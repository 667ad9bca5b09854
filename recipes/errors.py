"""The one error of this package, and the list in which a file's problems are gathered."""

from __future__ import annotations

import difflib


def nearest_word(word: str, words: tuple[str, ...]) -> str | None:
    """The option that is most like `word`, if any is."""
    close = difflib.get_close_matches(word.lower(), words, n=1, cutoff=0.6)
    return close[0] if close else None


def did_you_mean(word: str, words: tuple[str, ...]) -> str:
    """The guess as a part of a message, with a space after it; '' without one."""
    near = nearest_word(word, words)
    return f"did you mean {near}? " if near else ""


MAX_SHOWN = 40  # beyond this many lines the first cause is elsewhere


class RecipeError(Exception):
    """A recipe cannot be used.

    One line a problem: file and line, dotted field, value, and what is allowed.
    """

    @property
    def problems(self) -> tuple[str, ...]:
        """The lines, without the newlines between them."""
        return tuple(str(problem) for problem in self.args)

    def __str__(self) -> str:
        return "\n".join(self.problems)


class Problems:
    """Collects what is wrong with one file, so that all of it is reported at once."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._found: list[tuple[int, str]] = []

    def __len__(self) -> int:
        return len(self._found)

    def add(self, line: int, text: str) -> None:
        """Record a problem found at `line`, counted from 1."""
        self._found.append((line, text))

    def raise_if_any(self) -> None:
        """Raise every problem so far, in the order of the lines.

        Raises:
            RecipeError: there is at least one.
        """
        if not self._found:
            return
        ordered = sorted(self._found, key=lambda found: found[0])
        lines = [f"{self.source}:{line}: {text}" for line, text in ordered]
        if len(lines) > MAX_SHOWN:
            lines[MAX_SHOWN:] = [f"{self.source}: and {len(lines) - MAX_SHOWN} problems more"]
        raise RecipeError(*lines)

    def fail(self, line: int, text: str) -> RecipeError:
        """The error for a problem after which nothing else can be judged."""
        return RecipeError(f"{self.source}:{line}: {text}")


def short(text: str, limit: int = 60) -> str:
    """One printable line of at most `limit` characters."""
    printable = text if text.isprintable() else repr(text)[1:-1]
    return printable if len(printable) <= limit else printable[: limit - 1] + "…"
