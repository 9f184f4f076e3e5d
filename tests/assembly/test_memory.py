"""What camera rays take of the memory, said before."""

import pytest
from helpers.tiny_fit import fails, fit

from neurad.assembly import memory
from neurad.assembly.memory import camera_ray_bytes
from neurad.scene.builtin import build_cornell


def test_bytes_are_those_of_twelve_a_ray_and_a_mask():
    cameras = [view.camera for view in build_cornell().train]
    assert camera_ray_bytes(cameras, 16, False) == 8 * 64 * 64 * (12 * 16 + 1)
    assert camera_ray_bytes(cameras, 0, True) == 8 * 64 * 64


@pytest.mark.main
@pytest.mark.usefixtures("tiny")
def test_much_memory_is_announced_and_too_much_refused(monkeypatch, capfd):
    monkeypatch.setattr(memory, "LARGE", 1000)
    fit("--trainer.max_steps=1")
    assert "3 views of 64 x 64 pixels take 0.000602 GB of memory" in capfd.readouterr().err
    monkeypatch.setattr(memory, "free_memory", lambda: 100)
    error = fails(capfd, "fit", "--config", "tiny.yaml", "--trainer.max_steps=1")
    assert "--model.sampling.cached_spp 0 --data.resident 1" in error
    fit("--trainer.max_steps=1", "--model.sampling.cached_spp=0", "--data.resident=1")
