import pytest

from dsar.errors import ConfigError
from dsar.geometry.frame_numbers import parse_frames


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1001", [1001]),
        ("1001-1004", [1001, 1002, 1003, 1004]),
        ("1001-1007x3", [1001, 1004, 1007]),
        ("1010,1001-1003", [1001, 1002, 1003, 1010]),
        ("3-1x-1", [1, 2, 3]),
        ("1-3,2-4", [1, 2, 3, 4]),
        ("-2--1", [-2, -1]),
    ],
)
def test_a_range_names_its_frames_once_and_ascending(text, expected):
    assert parse_frames(text) == expected


@pytest.mark.parametrize("text", ["", "first-last", "1-10x0", "1-2x0.5"])
def test_what_is_no_range_of_whole_frames_is_refused(text):
    with pytest.raises(ConfigError, match="frames"):
        parse_frames(text)
