"""What camera rays take of the memory, said before."""

import pytest
from helpers.tiny_fit import fails, fit

from neurad.assembly import memory


@pytest.mark.usefixtures("tiny")
def test_much_memory_is_announced_and_too_much_refused(monkeypatch, capfd):
    monkeypatch.setattr(memory, "LARGE", 1000)
    fit("--trainer.max_steps=1")
    assert "3 views of 64 x 64 pixels take 0.000602 GB of memory" in capfd.readouterr().err
    monkeypatch.setattr(memory, "free_memory", lambda: 100)
    error = fails(capfd, "fit", "--config", "tiny.yaml", "--trainer.max_steps=1")
    assert "--model.sampling.cached_spp 0 --data.resident 1" in error
    fit("--trainer.max_steps=1", "--model.sampling.cached_spp=0", "--data.resident=1")
