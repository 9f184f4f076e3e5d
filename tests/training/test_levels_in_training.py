"""When training takes noise out of the levels, and what it makes of the factors that pixels ask for."""

from types import SimpleNamespace

import pytest
import torch

from neurad.evidence.validation import LevelFit
from neurad.training import stages, validation
from neurad.training.schedule import Progress
from neurad.training.validation import EVERY, shrink_levels, update_levels


@pytest.mark.parametrize(("progress", "times"), [(0.99, [EVERY, 2 * EVERY, 3 * EVERY]), (1.0, [])])
def test_when_levels_are_shrunk(monkeypatch, progress, times):
    monkeypatch.setattr(stages, "shrink_levels", lambda *_: None)
    assembly = SimpleNamespace(hierarchy=None)

    def due(iteration):
        training = SimpleNamespace(
            assembly=assembly, views=None, photographs=None, counters=SimpleNamespace(iteration=iteration)
        )
        return stages.filter_levels(training, Progress(progress, None, 0.0))

    assert [i for i in range(3 * EVERY + 1) if due(i)] == times


def shrink(assembly, photographs):
    shrink_levels(assembly, None, photographs, EVERY)


def update(assembly, photographs):
    update_levels(assembly, None, photographs, 100, settled=False)


def update_at_the_end(assembly, photographs):
    update_levels(assembly, None, photographs, 100, settled=True)


@pytest.mark.parametrize(
    ("turn", "gain", "asked", "taken"),
    [
        (shrink, 3.0, [1.0, 0.5], [1.0, 0.5]),
        (shrink, 1.0, [1.0, 0.5], [1.0, 1.0]),  # within two standard errors
        (shrink, 3.0, [0.8, 1.1, 0.6, 0.9, 0.5], [1.0, 1.0, 0.9, 0.9, 0.5]),  # no more than from finer levels
        (update, 1.0, [1.2, 0.7, 0.9, 0.5], [1.0, 0.9, 0.9, 0.5]),
        (update_at_the_end, 1.0, [1.2, 0.7, 0.9, 0.5], [1.2, 0.7, 0.9, 0.5]),
    ],
)
def test_what_is_taken_out_of_levels(monkeypatch, turn, gain, asked, taken):
    """Training goes on from clear factors alone; of what is shown only noise is taken before rates have come down."""
    asks, found, shrunk = [], [], []
    fits = [LevelFit(torch.tensor(asked), gain, 1.0, True)]
    monkeypatch.setattr(validation, "_fit", lambda a, v, batch, *_, **__: asks.append(batch) or fits)
    average = SimpleNamespace(levels=SimpleNamespace(set=found.append), shrink=lambda: shrunk.append(True))
    for batch in ("pixels", None):  # without such pixels nothing happens
        turn(SimpleNamespace(average=average), SimpleNamespace(validation_batch=lambda batch=batch: batch))
    assert asks == ["pixels"]
    ((factors,),) = found
    torch.testing.assert_close(factors, torch.tensor(taken))
    assert len(shrunk) == (turn is shrink)
