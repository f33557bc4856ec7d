"""Rates in other digits are the same rate; film's and television's are not."""

from fractions import Fraction

import numpy as np
import pytest

from dsar.errors import ConfigError
from dsar.geometry.frame_rates import exact_rate, parse_rate, same_rate

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


@pytest.mark.parametrize(("first", "second"), [*SAME, *DIFFERENT])
def test_rates_stand_for_one_fraction_exactly_if_they_are_the_same(first: float, second: float) -> None:
    assert (exact_rate(first) == exact_rate(second)) == same_rate(first, second)


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        *(("24", Fraction(24)), ("24.0", Fraction(24)), (" 25 ", Fraction(25)), ("12.5", Fraction(25, 2))),
        *((text, Fraction(24000, 1001)) for text in ("23.976", "23.98", "23.976024", "24000/1001")),
        *((text, Fraction(30000, 1001)) for text in ("29.97", "30000/1001", "30000 / 1001")),
        *((text, Fraction(60000, 1001)) for text in ("59.94", "60000/1001")),
        *(
            ("119.88", Fraction(120000, 1001)),
            ("1", Fraction(1)),
            ("1000", Fraction(1000)),
            ("48/2", Fraction(24)),
        ),
    ],
)
def test_a_rate_is_read_as_people_write_it(text: str, meant: Fraction) -> None:
    assert parse_rate(text) == float(meant)
    assert exact_rate(parse_rate(text)) == meant


@pytest.mark.parametrize(
    "text",
    ["nan", "inf", "0", "-24", "1e6", "1e1", "1001", "0.5", "film", "", "24/0", "24/", "/2", "9" * 5000],
)
def test_what_is_no_rate_is_refused_with_the_flag(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^--fps .*from 1 to 1000, such as 24, 23\.976 or 24000/1001$"):
        parse_rate(text)
