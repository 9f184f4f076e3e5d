"""Times as people write them, and names that they nearly got right."""

import argparse

import pytest

from neurad.core.durations import clock, dd_hh_mm_ss, has_unit, seconds_of, short, time_option
from neurad.core.errors import InputError
from neurad.core.ranges import Positive
from neurad.core.suggest import did_you_mean, nearest


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("60s", 60), ("4m", 240), ("1h", 3600), ("1h30m", 5400), ("1h 30min", 5400), ("2d", 172800), ("1.5h", 5400),
        ("90", 90), ("0.5", 0.5), ("00:00:04:00", 240), ("04:00", 240), ("1:00:00", 3600), ("2M", 120), (" 4m ", 240),
    ],
)  # fmt: skip
def test_a_time_is_read(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "4x", "m", "4m!", "-4m", "1:2:3:4:5", "4 parsecs"])
def test_what_is_no_time_is_said(text):
    with pytest.raises(InputError, match="is not a time, such as 60s, 4m"):
        seconds_of(text)


def test_units_are_told_from_numbers():
    assert has_unit("4m")
    assert not has_unit("240")
    assert not has_unit("00:00:04:00")


@pytest.mark.parametrize("seconds", [1, 59, 60, 240, 3600, 5400, 86399, 90061])
def test_what_is_written_is_read_again(seconds):
    assert seconds_of(dd_hh_mm_ss(seconds)) == seconds
    assert seconds_of(short(seconds)) == seconds


def test_parts_of_seconds_are_rounded_up():
    assert dd_hh_mm_ss(1.2) == "00:00:00:02"


def test_a_clock_never_goes_below_zero():
    assert [clock(x) for x in (0, -2, -0.5, 9.9, 60, 3599, 3600)] == [
        "0:00", "0:00", "0:00", "0:09", "1:00", "59:59", "1:00:00",
    ]  # fmt: skip


def test_an_option_takes_times_and_keeps_to_its_range():
    read = time_option(Positive)
    assert read("2m") == 120
    for bad in ("0", "-1", "nan", "inf", "later"):
        with pytest.raises(argparse.ArgumentTypeError):
            read(bad)


def test_the_nearest_name_is_suggested():
    names = ["fit", "validate", "test", "predict"]
    assert did_you_mean("fti", names) == ", did you mean fit?"
    assert did_you_mean("tets", names) == ", did you mean test?"
    assert did_you_mean("KITCHEN.yaml", ["kitchen.yaml"]) == ", did you mean kitchen.yaml?"
    assert did_you_mean("sing", names) == ""
    assert nearest("x", []) is None
