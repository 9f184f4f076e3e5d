"""Ranges of settings and the function that checks them, times as people write them, and names."""

import argparse
import math

import pytest

from neurad.core.durations import clock, seconds_of, short
from neurad.core.names import make_unique
from neurad.core.ranges import (
    Count,
    Finite,
    Fraction,
    NonNegative,
    OpenFraction,
    Positive,
    PositiveFraction,
    option,
    range_of,
)


@pytest.mark.parametrize(
    ("hint", "inside", "outside"),
    [
        (Positive, [1e-30, 5], [0.0, -1.0]),
        (NonNegative, [0, 1e30], [-1e-30]),
        (Fraction, [0.0, 1], [-0.1, 1.1]),
        (PositiveFraction, [1e-9, 1.0], [0.0, 1.1]),
        (OpenFraction, [0.5], [0.0, 1.0]),
        (Count, [1, 2**31 - 1], [0, -1, 2**31, 10**400]),
        (Finite, [-1e30, 0], []),
    ],
)
def test_what_lies_in_a_range(hint, inside, outside):
    allowed = range_of(hint)
    assert all(value in allowed for value in inside)
    assert not any(value in allowed for value in [*outside, math.nan, math.inf, -math.inf, True, "1", None])


# ---- times as people write them


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("60s", 60), ("4m", 240), ("1h", 3600), ("1h30m", 5400), ("1h 30min", 5400), ("2d", 172800), ("1.5h", 5400),
        ("90", 90), ("0.5", 0.5), ("00:00:04:00", 240), ("04:00", 240), ("1:00:00", 3600), ("2M", 120), (" 4m ", 240),
    ],
)  # fmt: skip
def test_a_time_is_read(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("seconds", [1, 59, 60, 240, 3600, 5400, 86399, 90061])
def test_what_is_written_is_read_again(seconds):
    assert seconds_of(short(seconds)) == seconds


def test_a_clock_never_goes_below_zero_and_options_take_times():
    assert [clock(x) for x in (0, -2, -0.5, 9.9, 60, 3599, 3600)] == [
        "0:00", "0:00", "0:00", "0:09", "1:00", "59:59", "1:00:00",
    ]  # fmt: skip

    read = option(Positive, seconds_of)
    assert read("2m") == 120
    for bad in ("0", "-1", "nan", "inf", "later"):
        with pytest.raises(argparse.ArgumentTypeError):
            read(bad)


# ---- names that no two things share, also where a number that would be given is taken


@pytest.mark.parametrize(
    ("names", "joint", "capitals", "made"),
    [
        (["a", "a", "a"], "-", True, ["a", "a-2", "a-3"]),
        (["a", "a-2", "a", "a"], "-", True, ["a", "a-2", "a-3", "a-4"]),
        (["a", "a", "a-2"], "-", True, ["a", "a-2", "a-2-2"]),
        (["Wand", "wand"], "_", True, ["Wand", "wand"]),
        (["Wand", "wand", "WAND"], "_", False, ["Wand", "wand_2", "WAND_3"]),
    ],
)
def test_no_two_names_are_equal(names, joint, capitals, made):
    taken: set[str] = set()
    assert [make_unique(name, taken, joint, capitals) for name in names] == made
    assert len(taken) == len(names)
