"""Learning rates over a run."""

from __future__ import annotations

import pytest

from neurad.assembly.settings import Optimization
from neurad.training.schedule import learning_rate, rate_factor

SETTINGS = Optimization(albedo=1e-2, roughness=2e-3, warmup=4, roughness_warmup=100, final=0.1)


def test_rates_rise_and_fall() -> None:
    """A linear rise, then half a cosine from 1 to ``final``."""
    assert [rate_factor(SETTINGS, i, 0.0) for i in range(5)] == [0.25, 0.5, 0.75, 1.0, 1.0]
    assert [rate_factor(SETTINGS, 50, p) for p in (0.5, 1.0)] == pytest.approx([0.55, 0.1])


def test_roughness_may_rise_later_than_the_others() -> None:
    factor = rate_factor(SETTINGS, 9, 0.0)
    assert learning_rate(SETTINGS, "albedo", 9, factor) == 1e-2
    assert learning_rate(SETTINGS, "roughness", 9, factor) == pytest.approx(2e-4)
    assert learning_rate(SETTINGS, "roughness", 99, factor) == 2e-3
    assert learning_rate(Optimization(roughness=2e-3), "roughness", 30, factor) == 2e-3
