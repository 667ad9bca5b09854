"""Frame numbers as people write them, against Python's own ranges."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recipes.schema import parse_frames

TEN = range(10)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("all", None),
        (" all ", None),
        ("4", (4,)),
        ("5,0,9", (5, 0, 9)),
        ("0:6:2", (0, 2, 4)),
        ("::4", (0, 4, 8)),
        ("7:", (7, 8, 9)),
        (":2, 1:3", (0, 1, 2)),
        ("8:12", (8, 9, 10, 11)),
        ("12", (12,)),
    ],
)
def test_patterns(text: str, wanted: tuple[int, ...] | None) -> None:
    assert parse_frames(text).select(TEN) == wanted


@pytest.mark.parametrize("text", ["", " ", ",", "1,", "-1", "a", "1:2:0", "3:3", "5:2", "1:2:3:4",
                                  "1.5", "0x2", "1 2", "::-1", "all,1"])  # fmt: skip
def test_what_is_no_pattern(text: str) -> None:
    with pytest.raises(ValueError, match="is not understood; write all, 4, 0,5,9"):
        parse_frames(text)


def test_ranges_that_are_clipped_and_numbers_that_are_not() -> None:
    pattern = parse_frames("0:100:30,64")
    assert pattern.select([0, 30, 31, 33]) == (0, 30, 60, 90, 64)
    assert pattern.select([0, 30, 31, 33], clip=True) == (0, 30, 64)
    assert parse_frames("0:5").select([], clip=True) == ()


@given(st.sets(st.integers(0, 40)), st.integers(0, 40), st.integers(1, 40), st.integers(1, 7))
def test_a_range_is_pythons(numbers: set[int], start: int, length: int, step: int) -> None:
    stop = start + length
    found = parse_frames(f"{start}:{stop}:{step}").select(sorted(numbers), clip=True)
    assert found == tuple(n for n in range(start, stop, step) if n in numbers)
