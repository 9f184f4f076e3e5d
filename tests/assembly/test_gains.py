"""Gains of photographs by the surface points that they share."""

import numpy as np
import torch

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.assembly.build import build_world
from neurad.assembly.gains import shared_gains
from neurad.integrators.primary_hits import PrimaryHits


def test_gains_show_in_surfaces_that_photographs_share():
    """Within some per cent: the walls are matt, the photographs have noise."""
    data = SceneData(DataSettings(scene="cornell"))
    views = data.scene.train
    log = torch.from_numpy(np.random.default_rng(4).uniform(-0.7, 0.7, (len(views), 3))).float()
    log = log - log.mean(0)
    data._pixels = data._pixels.clone()
    data._pixels[..., :3] *= log.exp().unsqueeze(1)
    primary = PrimaryHits(build_world(data.scene), [view.camera for view in views], 1, 0, torch.device("cpu"))
    mask = primary.sees_emitter()
    sample = data.dataset_stats(mask).sample
    error = shared_gains(primary, data, sample, mask, 0) - log
    assert float(error.abs().max()) < 0.03
    assert float(error.mean(0).abs().max()) < 1e-5
    alone = torch.full_like(mask, True)  # nothing is shared
    assert not bool(shared_gains(primary, data, sample, alone, 0).any())
