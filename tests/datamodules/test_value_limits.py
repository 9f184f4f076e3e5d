"""What batches say of values that are clipped, rounded, or of a known spread."""

import numpy as np
import pytest
import torch
from helpers.tiny_scene import SIZE, as_png, write_scene

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.core.errors import InputError
from neurad.images.image_io import write_exr

pytest.importorskip("mitsuba")


def batch_of(folder, **settings):
    data = SceneData(DataSettings(str(folder), patches=3 * SIZE * SIZE, **settings))
    data.setup("fit")
    return data, data.batch(0)


def test_linear_photographs_have_no_limits(tmp_path):
    data, batch = batch_of(write_scene(tmp_path / "room"))
    assert batch.clipped is None
    assert batch.variance is None
    assert data.clipped(batch.view, batch.pixel) is None


@pytest.mark.parametrize("resident", [None, 1])
def test_codes_are_clipped_and_rounded(tmp_path, resident):
    data, batch = batch_of(as_png(write_scene(tmp_path / "room"), 2.0), resident=resident)
    at_top = batch.color >= 1.0
    assert torch.equal(batch.clipped, at_top)
    assert 0.3 < float(at_top.float().mean()) < 0.7
    assert torch.equal(data.clipped(batch.view, batch.pixel), at_top)
    step = 2.4 / 1.055 * (batch.color.clamp_min(0.0031) ** (1 / 2.4)) ** 1.4 / 255
    middle = (batch.color > 0.05) & ~at_top
    ratio = batch.variance[middle] / (step[middle] ** 2 / 12)
    torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=0.05, atol=0)


def test_a_ceiling_that_is_given(tmp_path):
    _, batch = batch_of(write_scene(tmp_path / "room"), ceiling=0.75)
    assert torch.equal(batch.clipped, batch.color >= 0.75 * (1 - 1e-4))
    assert batch.variance is None


def test_photographs_that_are_clipped_everywhere(tmp_path, capfd):
    folder = as_png(write_scene(tmp_path / "room"), 1e6)
    with pytest.raises(InputError, match="every photograph is at its ceiling everywhere and says nothing"):
        batch_of(folder)
    other = write_scene(tmp_path / "other")
    write_exr(other / "images/train_1.exr", np.full((SIZE, SIZE, 3), 2.0, np.float32))
    batch_of(other, ceiling=1.5)
    assert "warning: at their ceiling everywhere, so they say nothing: train_1" in capfd.readouterr().err


def test_a_known_spread(tmp_path):
    folder = write_scene(tmp_path / "room")
    (folder / "spread").mkdir()
    spread = np.random.default_rng(1).random((SIZE, SIZE, 3), np.float32)
    write_exr(folder / "spread/train_1.exr", spread, half=False)
    data, batch = batch_of(folder)
    assert batch.clipped is None
    assert data.clipped(batch.view, batch.pixel) is None  # nothing says from where on photographs are clipped
    spread[0, 0], spread[0, 1, 0] = np.inf, np.inf
    write_exr(folder / "spread/train_1.exr", spread, half=False)
    data, batch = batch_of(folder)
    mine = batch.view == 1
    blown = np.isinf(spread)
    want = torch.from_numpy(np.ma.masked_array(spread, blown).mean(-1).filled(0.0)).view(-1)[batch.pixel[mine]] ** 2
    want = want.float().unsqueeze(-1).expand(-1, 3).clone()
    clipped = torch.from_numpy(blown).view(-1, 3)[batch.pixel[mine]]
    want[clipped] = 0.0  # a lower bound has none; the other channels of its pixel keep theirs
    torch.testing.assert_close(batch.variance[mine], want, rtol=0.01, atol=0)
    assert not bool(batch.variance[~mine].any())
    assert torch.equal(batch.clipped[mine], clipped)
    assert clipped.sum() == 4
    assert not bool(batch.clipped[~mine].any())
    assert torch.equal(data.clipped(batch.view, batch.pixel), batch.clipped)
    write_exr(folder / "spread/train_1.exr", spread[:4])
    with pytest.raises(InputError, match=r"spread/train_1\.exr: it has 8 x 4 pixels, its camera 8 x 8"):
        batch_of(folder)
    write_exr(folder / "spread/train_1.exr", -spread)
    with pytest.raises(InputError, match="negative or not a number"):
        batch_of(folder)
