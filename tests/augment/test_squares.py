"""Masks in squares against a look at every pixel."""

import numpy as np
import pytest

from augment.geometry import any_in_squares


@pytest.mark.parametrize("shape", [(1, 1), (16, 16), (17, 31), (5, 40), (48, 7), (64, 96)])
def test_squares_with_a_true_pixel(shape):
    mask = np.random.default_rng(0).random(shape) < 0.01
    mask[-1, -1] = True
    expected = np.zeros((-(-shape[0] // 16), -(-shape[1] // 16)), bool)
    for row, column in np.argwhere(mask):
        expected[row // 16, column // 16] = True
    assert np.array_equal(any_in_squares(mask, 16), expected)
    assert not any_in_squares(np.zeros(shape, bool), 16).any()
