"""Training pixels that are never drawn: which ones, in memory and streamed."""

import pytest
import torch
from helpers.tiny_scene import SIZE, write_scene

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.core.patch_sampler import PatchSampler, validation_pixels

VIEWS = 5


@pytest.fixture
def folder(tmp_path):
    pytest.importorskip("mitsuba")
    return write_scene(tmp_path / "room", VIEWS)


def ready(folder, **settings):
    data = SceneData(DataSettings(str(folder), validation_pixels=0.1, **settings))
    data.setup("fit")
    return data


def drawn(data):
    """All (view, pixel) of enough batches to see every pixel."""
    batches = [data.batch(i) for i in range(-(-2 * VIEWS * SIZE * SIZE // data.settings.patches))]
    return set(
        zip(torch.cat([b.view for b in batches]).tolist(), torch.cat([b.pixel for b in batches]).tolist(), strict=True)
    )


def test_batches_draw_all_pixels_but_these(folder):
    data = ready(folder)
    kept = data.validation_batch()
    apart = set(zip(kept.view.tolist(), kept.pixel.tolist(), strict=True))
    assert len(apart) == len(kept.view) == VIEWS * round(0.1 * SIZE * SIZE)
    found = drawn(data)
    assert not found & apart
    assert len(found | apart) == VIEWS * SIZE * SIZE
    assert torch.equal(kept.color, data.photographs[kept.view, kept.pixel])


def test_streamed_photographs_leave_out_the_same_ones(folder):
    resident, streamed = ready(folder), ready(folder, resident=2, replace_every=1)
    ours, theirs = resident.validation_batch(), streamed.validation_batch()
    for name in ("view", "pixel", "color", "alpha"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name))
    assert not drawn(streamed) & set(zip(theirs.view.tolist(), theirs.pixel.tolist(), strict=True))


def test_without_any_everything_stays_as_it_was(folder):
    data = SceneData(DataSettings(str(folder)))
    data.setup("fit")
    assert data.validation_batch() is None
    sizes = [(SIZE, SIZE)] * VIEWS
    assert torch.equal(data._sampler.corners, PatchSampler.build(sizes, 1, None, 0).corners)
    assert len(validation_pixels((SIZE, SIZE), 0, 0.0)) == 0


def test_patches_have_none(folder):
    assert ready(folder, patch_size=2).validation_batch() is None
