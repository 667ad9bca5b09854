"""Guesses which of some words was meant."""

from __future__ import annotations

import difflib


def nearest_word(word: str, words: tuple[str, ...]) -> str | None:
    """The option that is most like `word`, if any is."""
    close = difflib.get_close_matches(word.lower(), words, n=1, cutoff=0.6)
    return close[0] if close else None
