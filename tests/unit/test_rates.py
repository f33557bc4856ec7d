"""Rates in other digits are the same rate; film's and television's are not."""

import numpy as np
import pytest

from dsar.geometry.rates import same_rate

SAME = [
    (29.97, 30000 / 1001),
    (float(np.float32(29.97)), 29.97),
    (23.976, 24000 / 1001),
    (23.98, 24000 / 1001),
    (59.94, 60000 / 1001),
    (1 / 0.0083333, 120.0),
    (119.88, 120000 / 1001),
]
DIFFERENT = [(24.0, 24000 / 1001), (30.0, 29.97), (60.0, 59.94), (25.0, 24.0), (120.0, 119.88), (30.0, 60.0)]


@pytest.mark.parametrize(("first", "second"), SAME)
def test_rates_in_other_digits_are_the_same(first: float, second: float) -> None:
    assert same_rate(first, second)
    assert same_rate(second, first)


@pytest.mark.parametrize(("first", "second"), DIFFERENT)
def test_rates_a_thousandth_apart_differ(first: float, second: float) -> None:
    assert not same_rate(first, second)
    assert not same_rate(second, first)
