"""Lamps that no photograph shows are changed, while a fit runs, by what the albedo says of them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lamp_room import CEILING, lamp_room

from benchmarks.stress.fit import Fit, Plan, photographs, small_settings
from neurad.training import stages
from neurad.training.light_balance import balance_light, unsure

STRIP = np.array([2.0, 3.0, 4.0], np.float32)
TRUTH = np.stack([CEILING, STRIP])
WRONG = np.array([[1.5], [0.6]])
"""What lamps are taken for over what they are."""


@pytest.fixture(scope="module")
def trained():
    """A fit under two lamps of the wrong radiance, which it leaves as it is, as if photographs clipped them."""
    scene, settings = lamp_room(strip=STRIP), small_settings()
    lamps, rates = replace(settings.lighting, emitters="fit"), replace(settings.optimization, light=0.0)
    plan = Plan(steps=400, settings=replace(settings, lighting=lamps, optimization=rates))
    fit = Fit(scene, photographs(scene, 128), plan)
    found = fit.training.assembly.lamps
    found.set_radiance(TRUTH * WRONG)
    found.counts[:, 2] = found.counts[:, 0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "TIMES", ())
        fit.run()
    np.testing.assert_allclose(found.found(), TRUTH * WRONG, rtol=1e-5)
    return fit


def test_they_come_closer_to_what_they_are(trained):
    """Both, in all channels, by half of what they lack or more."""
    assembly, views = trained.training.assembly, trained.training.views
    changed = balance_light(assembly, views, 400)
    assert 0.0 < changed < 1.0
    left = np.log(assembly.lamps.found() / TRUTH)
    assert (np.abs(left) < np.abs(np.log(WRONG)) / 2.0).all(), left


def test_lamps_that_are_photographed_are_not_asked_for(trained):
    assembly = trained.training.assembly
    assert unsure(assembly) == [assembly.lamps]
    assembly.lamps.counts[:, 2] = 0
    assert unsure(assembly) == []
