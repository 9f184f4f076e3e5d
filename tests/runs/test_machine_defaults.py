"""What ``auto`` becomes: a GPU only where all of a step runs on it, and the batch that suits the device."""

import pytest
import torch

from neurad.runs import machine_defaults
from neurad.runs.machine_defaults import accelerator, patches, rates_for
from neurad.runtime import warp
from neurad.tracing import select


@pytest.mark.parametrize(
    ("installed", "usable", "tracer", "chosen", "says"),
    [
        (True, True, "auto", "gpu", ""),
        (True, True, "warp", "gpu", ""),
        (True, True, "embree", "cpu", "model.tracer embree casts rays on the CPU"),
        (False, False, "auto", "cpu", "pip install 'neurad[gpu]'"),
        (True, False, "auto", "cpu", "R580"),
    ],
)
def test_a_gpu_is_taken_where_it_does_everything(monkeypatch, capsys, installed, usable, tracer, chosen, says):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(machine_defaults, "find_spec", lambda _: object() if installed else None)
    for module in (warp, select):
        monkeypatch.setattr(module, "is_available", lambda _: installed and usable)
    assert accelerator("auto", tracer) == chosen
    said = capsys.readouterr().err
    assert said.count("\n") == (1 if says else 0)
    assert says in said
    assert accelerator("gpu", tracer) == "gpu"
    assert select.tracer_for("auto", "cuda") == ("warp" if installed and usable else "embree")
    assert select.tracer_for("auto", "cpu") == "embree"
    assert select.tracer_for("open3d", "cuda") == "open3d"
    assert capsys.readouterr().err == ""


def test_a_machine_without_a_gpu_says_nothing_unless_its_driver_is_too_old(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(machine_defaults, "_DRIVER", tmp_path / "gpus")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert accelerator("auto", "auto") == "cpu"
    assert capsys.readouterr().err == ""
    (tmp_path / "gpus").mkdir()
    assert accelerator("auto", "auto") == "cpu"
    assert "torch is built for CUDA 13.0, for which its driver is too old" in capsys.readouterr().err


@pytest.mark.parametrize(("threads", "pixels"), [(1, 512), (2, 1024), (16, 1024)])
def test_batches_follow_the_device_unless_they_are_given(monkeypatch, threads, pixels):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    assert patches("auto", 1, "cpu") == pixels
    assert patches("auto", 1, "gpu") == patches("auto", 1, "cuda") == 4096
    assert patches("auto", 16, "cpu") == pixels // 256
    assert patches("auto", 16, "gpu") == 16
    assert patches("auto", 64, "cpu") == 1
    assert patches(17, 1, "gpu") == 17


def test_the_rate_of_roughness_follows_the_batch_once():
    rates = {"batch": 256, "roughness": 0.01}
    for _ in range(2):  # a run goes on with what was resolved
        rates_for(rates, 1024)
        assert (rates["batch"], rates["roughness"]) == (1024, pytest.approx(0.02))
    rates_for(rates, 256)
    assert rates["roughness"] == pytest.approx(0.01)
    rates_for(rates, 4096)  # as of the largest batch that was tried
    assert rates["roughness"] == pytest.approx(0.02)
    fixed = {"batch": None, "roughness": 0.01}
    rates_for(fixed, 1024)
    assert fixed == {"batch": None, "roughness": 0.01}
