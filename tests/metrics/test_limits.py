"""How much of the albedo sits at its limits, and what is said of it."""

import numpy as np
import pytest

from neurad.metrics.limits import albedo_at_limits, sentence_of_limits


def test_fractions_are_of_counted_channel_values():
    albedo = np.full((2, 5, 3), 0.5, np.float32)
    albedo[0, 0] = 0.995, 0.5, 0.001
    albedo[0, 1] = 1.0
    albedo[1, 4] = 0.0  # does not count
    counted = np.ones((2, 5), bool)
    counted[1, 4] = False
    found = albedo_at_limits([{"albedo": albedo}, {}], [counted, counted])
    assert found["albedo_at_0"] == pytest.approx(1 / 27)
    assert found["albedo_at_1"] == pytest.approx(4 / 27)
    assert sentence_of_limits(found) == (
        "albedo at its limits: 3.7 % below 0.01, 14.8 % above 0.99; so much white may mean that lights are brighter "
        "than they are taken for"
    )
    few = sentence_of_limits({"albedo_at_0": 0.2, "albedo_at_1": 0.01})
    assert few == "albedo at its limits: 20.0 % below 0.01, 1.0 % above 0.99"


def test_nothing_is_said_where_nothing_was_recovered():
    assert albedo_at_limits([{}], [np.ones((2, 2), bool)]) == {}
    assert albedo_at_limits([{"albedo": np.ones((2, 2, 3), np.float32)}], [np.zeros((2, 2), bool)]) == {}
    assert sentence_of_limits({}) == ""
