"""Polynomials of one number: values, sums, products, integrals, roots.

A polynomial is a tuple of the coefficients of 1, t, t^2, and so on.
"""

from __future__ import annotations

import itertools

Polynomial = tuple[float, ...]


def value(polynomial: Polynomial, t: float) -> float:
    """Return a polynomial's value at t."""
    total = 0.0
    for coefficient in reversed(polynomial):
        total = total * t + coefficient
    return total


def add(a: Polynomial, b: Polynomial) -> Polynomial:
    """Return a + b."""
    return tuple(x + y for x, y in itertools.zip_longest(a, b, fillvalue=0.0))


def scale(polynomial: Polynomial, factor: float) -> Polynomial:
    """Return a polynomial times a number."""
    return tuple(factor * coefficient for coefficient in polynomial)


def multiply(a: Polynomial, b: Polynomial) -> Polynomial:
    """Return a times b."""
    total = [0.0] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            total[i + j] += x * y
    return tuple(total)


def integral(polynomial: Polynomial) -> Polynomial:
    """Return the integral from 0 to t."""
    return (0.0, *(c / (power + 1) for power, c in enumerate(polynomial)))


def derivative(polynomial: Polynomial) -> Polynomial:
    """Return the derivative by t."""
    return tuple(power * c for power, c in enumerate(polynomial))[1:]


def shift(polynomial: Polynomial, offset: float) -> Polynomial:
    """Return p(t + offset)."""
    result = list(polynomial)
    for start in range(len(result) - 1):
        for power in range(len(result) - 2, start - 1, -1):
            result[power] += offset * result[power + 1]
    return tuple(result)


def roots(polynomial: Polynomial, end: float) -> list[float]:
    """Return the points inside (0, end) at which a polynomial changes its sign."""
    if len(polynomial) < 2 or end <= 0:
        return []
    stops = [0.0, *roots(derivative(polynomial), end), end]
    points = list[float]()
    for low, high in itertools.pairwise(stops):
        at_low = value(polynomial, low)
        if at_low * value(polynomial, high) >= 0:
            continue
        for _ in range(100):
            middle = (low + high) / 2
            if not low < middle < high:
                break
            if (value(polynomial, middle) < 0) == (at_low < 0):
                low = middle
            else:
                high = middle
        points.append(high)
    return points
