"""When and from which pixels training takes noise out of the levels."""

from types import SimpleNamespace

import torch

from neurad.core.records import PixelBatch
from neurad.training import validation
from neurad.training.validation import EVERY, FIRST, is_due, shrink_levels


def test_when_levels_are_shrunk():
    assert [i for i in range(3 * EVERY + 1) if is_due(i)] == [FIRST, EVERY, 2 * EVERY, 3 * EVERY]


def test_halves_of_the_pixels_take_turns(monkeypatch):
    """Two turns together ask every pixel once, and each of them shrinks; without such pixels nothing happens."""
    asked, shrunk = [], []
    monkeypatch.setattr(validation, "_fit", lambda a, v, batch, iteration, groups: asked.append(batch.pixel.tolist()))
    pixel = torch.arange(7)
    batch = PixelBatch(0 * pixel, pixel, torch.zeros(7, 3), torch.ones(7), 0)
    assembly = SimpleNamespace(average=SimpleNamespace(shrink=lambda: shrunk.append(len(asked))))
    for turn in (4, 5):
        shrink_levels(assembly, None, SimpleNamespace(validation_batch=lambda: batch), turn * EVERY)
    assert asked == [[0, 2, 4, 6], [1, 3, 5]]
    assert shrunk == [1, 2]
    shrink_levels(assembly, None, SimpleNamespace(validation_batch=lambda: None), EVERY)
    assert len(asked) == len(shrunk) == 2
