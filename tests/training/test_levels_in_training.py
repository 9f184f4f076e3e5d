"""When and from which pixels training takes noise out of the levels."""

from types import SimpleNamespace

import pytest
import torch

from neurad.core.records import PixelBatch
from neurad.evidence.validation import LevelFit
from neurad.training import validation
from neurad.training.validation import EVERY, should_filter, shrink_levels, update_levels


def test_when_levels_are_shrunk():
    assert [i for i in range(3 * EVERY + 1) if should_filter(i)] == [EVERY, 2 * EVERY, 3 * EVERY]


class Shrunk:
    """In place of the averages: the factors that training went on from, turn by turn."""

    def __init__(self):
        self.levels, self.turns = SimpleNamespace(set=self.take), []

    def take(self, factors):
        self.factors = factors

    def shrink(self):
        self.turns.append(self.factors)


def turns_of(batch, turns=(4, 5)):
    average = Shrunk()
    for turn in turns:
        photographs = SimpleNamespace(validation_batch=lambda: batch)
        shrink_levels(SimpleNamespace(average=average), None, photographs, turn * EVERY)
    return average.turns


def pixels(count):
    pixel = torch.arange(count)
    return PixelBatch(0 * pixel, pixel, torch.zeros(count, 3), torch.ones(count), 0)


def test_each_turn_asks_all_pixels(monkeypatch):
    """And shrinks the levels; without such pixels nothing happens."""
    asked = []
    monkeypatch.setattr(validation, "_fit", lambda a, v, batch, iteration, quick: asked.append(batch.pixel.tolist()))
    assert turns_of(pixels(7)) == [None, None]
    assert asked == [list(range(7))] * 2
    assert turns_of(None) == []
    assert len(asked) == 2


def test_training_goes_on_from_clear_factors_alone(monkeypatch):
    """A field whose gain is within two standard errors keeps its levels whole, though results show what was found."""
    factors = torch.tensor([1.0, 0.5])
    found = [LevelFit(factors, 3.0, 1.0, True), LevelFit(factors, 1.0, 1.0, True)]
    assert [fit.holds for fit in found] == [True, True]
    monkeypatch.setattr(validation, "_fit", lambda *_, **__: found)
    ((clear, unclear),) = turns_of(pixels(4), turns=(1,))
    assert clear.tolist() == [1.0, 0.5]
    assert unclear.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("settled", [False, True])
def test_only_noise_is_taken_out_before_rates_have_come_down(monkeypatch, settled):
    average, asked = Shrunk(), torch.tensor([1.2, 0.7, 0.9, 0.5])
    monkeypatch.setattr(validation, "_fit", lambda *_, **__: [LevelFit(asked, 3.0, 1.0, True)])
    photographs = SimpleNamespace(validation_batch=lambda: pixels(4))
    update_levels(SimpleNamespace(average=average), None, photographs, 100, settled)
    torch.testing.assert_close(average.factors[0], asked if settled else torch.tensor([1.0, 0.9, 0.9, 0.5]))


def test_training_takes_no_more_from_a_level_than_from_finer_ones(monkeypatch):
    found = [LevelFit(torch.tensor([0.8, 1.1, 0.6, 0.9, 0.5]), 3.0, 1.0, True)]
    monkeypatch.setattr(validation, "_fit", lambda *_, **__: found)
    ((factors,),) = turns_of(pixels(4), turns=(1,))
    torch.testing.assert_close(factors, torch.tensor([1.0, 1.0, 0.9, 0.9, 0.5]))
