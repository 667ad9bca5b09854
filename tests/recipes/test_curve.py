"""Curves of numbers over time: values, exact integrals, parts."""

from __future__ import annotations

import pytest

from recipes.curve import Curve, Shape


def sum_of(curve: Curve, start_s: float, end_s: float, count: int = 20000) -> float:
    width = (end_s - start_s) / count
    return width * sum(curve.value(start_s + (i + 0.5) * width) for i in range(count))


@pytest.mark.parametrize("shape", ["linear", "step", "smooth"])
def test_integrals_are_those_of_many_small_steps(shape: Shape):
    curve = Curve((0.0, 10.0, 40.0), (1.0, 5.0, 2.0), shape)
    for start_s, end_s in ((-5.0, 60.0), (3.0, 7.0), (5.0, 25.0), (12.0, 39.0)):
        assert curve.integral(start_s, end_s) == pytest.approx(
            sum_of(curve, start_s, end_s), rel=1e-3 if shape == "step" else 1e-7
        )


def test_values_between_points():
    times = (0.0, 10.0)
    assert Curve(times, (2.0, 6.0)).value(2.5) == 3.0
    assert Curve(times, (2.0, 6.0), "step").value(9.9) == 2.0
    assert Curve(times, (2.0, 6.0), "step").value(10.0) == 6.0
    assert Curve(times, (2.0, 6.0), "smooth").value(5.0) == pytest.approx(4.0)
    assert Curve(times, (2.0, 6.0)).value(-3.0) == 2.0
    assert Curve(times, (2.0, 6.0)).value(30.0) == 6.0


@pytest.mark.parametrize("shape", ["linear", "step", "smooth"])
def test_parts_have_the_values_of_the_curve(shape: Shape):
    curve = Curve((0.0, 10.0, 40.0), (1.0, 5.0, 2.0), shape)
    parts = list(curve.pieces(-3.0, 55.0))
    assert [p.start_s for p in parts] == [-3.0, 0.0, 10.0, 40.0]
    assert parts[-1].end_s == 55.0
    for part in curve.pieces(4.0, 50.0):
        middle = (part.start_s + part.end_s) / 2
        assert part.value(middle) == pytest.approx(curve.value(middle), abs=1e-12)


def test_the_largest_number_is_that_of_a_point_or_an_end():
    curve = Curve((0.0, 10.0, 40.0), (1.0, 5.0, 2.0))
    assert curve.largest(-5.0, 5.0) == 3.0
    assert curve.largest(0.0, 50.0) == 5.0
    assert curve.largest(25.0, 60.0) == 3.5
    assert Curve.constant(4.0).largest(0.0, 1.0) == 4.0
