"""Training pixels taken in turn for a look at all of them."""

import pytest
import torch

from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.evidence.pixel_derivatives import batches_without_replacement

VIEWS, PIXELS = 2, 60


class InTurn(PhotoSource):
    """Every pixel once in a round, seven at a time."""

    def batch(self, iteration):
        place = (7 * iteration + torch.arange(7)) % (VIEWS * PIXELS)
        color = torch.ones(7, 3)
        return PixelBatch(place // PIXELS, place % PIXELS, color, torch.ones(7), 0)


def taken(mask, pixels):
    parts = list(batches_without_replacement(InTurn(), mask, 3, pixels))
    return torch.cat([part.view * PIXELS + part.pixel for part in parts]) if parts else torch.zeros(0).long()


@pytest.mark.parametrize("pixels", [10, 40, 60, 1000])
def test_masked_pixels_are_not_counted(pixels):
    """Half of the pixels are left out: as many of the others are taken as were asked for, as long as there are some."""
    mask = torch.arange(PIXELS).expand(VIEWS, -1) % 2 == 0
    found = taken(mask, pixels)
    assert not bool(mask.flatten()[found].any())
    assert len(found) == min(pixels, len(found))
    assert abs(len(found) - min(pixels, 60)) <= 4  # a round ends within a batch
    assert len(torch.unique(found)) >= len(found) - 4


def test_where_all_is_masked_nothing_is_waited_for():
    assert len(taken(torch.ones(VIEWS, PIXELS, dtype=torch.bool), 10)) == 0
