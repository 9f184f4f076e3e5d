"""Scales of error bars from what halves of the pixels ask for at a closing step."""

import numpy as np
import pytest

from neurad.evidence import closing_calibration
from neurad.evidence.bar_calibration import PRIOR, RoughnessBars
from neurad.evidence.closing_calibration import POWER, RESPONSE, calibrate_at_closing, robust_weight

PER_CELL = 4


def halves_of(prior, gain, seed, patches=20_000, alike=0.7):
    """What halves of the pixels ask of patches before a closing step, whose error has these scales: information of both
    over six orders of magnitude, gradients, the information around and the cell that a patch lies in. The part
    ``alike`` of the squared error is common to a cell's patches.
    """
    rng = np.random.default_rng(seed)
    cells = patches // PER_CELL
    around = np.repeat(np.exp(rng.uniform(np.log(0.1), np.log(1e5), cells)), PER_CELL)
    information = around * rng.uniform(0.1, 0.4, (2, patches))
    common = np.repeat(rng.standard_normal(cells), PER_CELL)
    error = np.sqrt(alike) * common + np.sqrt(1.0 - alike) * rng.standard_normal(patches)
    error *= np.sqrt(RoughnessBars(gain, prior, POWER).variance(around))
    noise = rng.standard_normal((2, patches)) * np.sqrt(information)
    place = np.repeat(np.arange(cells), PER_CELL)
    return information, RESPONSE * information * error + noise, around, place


@pytest.mark.parametrize(("prior", "gain"), [(0.05, 4.0), (0.14, 0.5), (0.2, 1.5)])
@pytest.mark.parametrize("alike", [0.3, 1.0])
def test_both_scales_are_found_from_halves(prior, gain, alike):
    """Without the truth and of many patches: the prior within a quarter, the gain within a half, and so bars that
    cover what they say, whether patches of a cell are off by the same or not."""
    halves = halves_of(prior, gain, seed=3, patches=200_000, alike=alike)
    found = calibrate_at_closing(*halves)
    assert found.prior == pytest.approx(prior, rel=0.25)
    assert 1.0 / 1.5 < found.gain / gain < 1.5
    around = halves[2]
    true = RoughnessBars(gain, prior, POWER).variance(around)
    assert np.abs(np.log(found.variance(around) / true)).max() < 0.5


def test_cells_tell_the_prior_of_a_room_better_than_patches_alone(monkeypatch):
    """Of a room's 20 000 patches, in 48 rooms whose prior is far from the usual one: nearer to it with sums over cells
    by more than three standard errors of the difference."""
    rooms = [halves_of(0.05, 4.0, seed) for seed in range(48)]
    together = np.array([np.log(calibrate_at_closing(*room).prior / 0.05) for room in rooms])
    monkeypatch.setattr(closing_calibration._Equations, "summed", lambda self, place: self)
    monkeypatch.setattr(closing_calibration, "RATIO", 1.0)
    alone = np.array([np.log(calibrate_at_closing(*room).prior / 0.05) for room in rooms])
    gain = np.abs(alone) - np.abs(together)
    assert gain.mean() > 3.0 * gain.std() / np.sqrt(len(rooms))


@pytest.mark.parametrize("taken", [0.3, 0.8])
def test_bars_are_of_what_the_step_leaves(taken):
    """A step that takes this part of the power of what pixels ask for leaves the rest, and the part of the error that
    they do not ask for.
    """
    information, gradient, around, place = halves_of(0.14, 0.5, seed=4, patches=200_000)
    before = RoughnessBars(0.5, 0.14, POWER).variance(around)
    explained = taken * float((robust_weight(information) * information * RESPONSE**2 * before).sum())
    found = calibrate_at_closing(information, gradient, around, place, explained)
    left = ((1.0 - RESPONSE) ** 2 * taken + 1.0 - taken) * before
    some = around > 10.0  # where there is less the prior keeps bars as wide as usual
    assert np.abs(np.log(found.variance(around) / left))[some].mean() < 0.3


def test_halves_that_tell_nothing_leave_the_usual_scales():
    none = np.zeros((2, 50))
    found = calibrate_at_closing(none, none, np.zeros(50), np.zeros(50, int))
    assert found.prior == pytest.approx(PRIOR, rel=0.05)
    assert found.gain == pytest.approx(closing_calibration.GAIN, rel=0.1)
