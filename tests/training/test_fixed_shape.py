"""A step as a GPU does it, on the CPU: all lanes work together, by Warp's kernels, and nothing asks the device."""

from dataclasses import replace

import pytest
import torch
from helpers.devices import close
from helpers.host_questions import no_host_questions

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.runs.model_settings import model_settings
from neurad.runtime import dispatch, lanes
from neurad.scene import builtin
from neurad.training.guard import Guard
from neurad.training.schedule import Progress
from neurad.training.session import TrainingRun

ROOMS = {"patterns": "patterns.yaml", "kitchen": "scene.yaml"}
"""Rough surfaces alone, textured ones; a room with panes of glass, and lamps that are measured by photographs."""


@pytest.fixture
def as_on_a_gpu(warp_on_cpu, monkeypatch):
    monkeypatch.setattr(dispatch, "KERNEL_DEVICES", ())
    monkeypatch.setattr(lanes, "FULL_DEVICES", ("cpu",))


def made(room):
    """The parts of a fit of three views, and their photographs."""
    scene = builtin.build(room)
    settings = model_settings(ROOMS[room])
    sampling = replace(settings.sampling, spp=4, cached_spp=4)
    photographs = SceneData(DataSettings(scene=room, patches=64))
    photographs.scene = replace(scene, train=scene.train[:3], test=[])
    photographs.setup("fit")
    torch.manual_seed(0)
    return TrainingRun.of_scene(
        photographs.scene, photographs, replace(settings, tracer="warp", sampling=sampling)
    ), photographs


@pytest.mark.parametrize("room", ROOMS)
def test_a_step_asks_the_device_nothing_but_whether_all_is_finite(as_on_a_gpu, monkeypatch, room):
    run, photographs = made(room)
    progress = Progress(0.1, None, 1.0)
    for iteration in range(2):  # makes tables of the lights, moments of the optimizers
        run.step(photographs.batch(iteration), progress)
    checked = []
    monkeypatch.setattr(Guard, "check", lambda self, *_: checked.append(self))
    batch, before = photographs.batch(2), [p.detach().clone() for p in run.assembly.materials.parameters()]
    with no_host_questions():
        run.step(batch, progress)
    assert checked
    assert any(not torch.equal(p, old) for p, old in zip(run.assembly.materials.parameters(), before, strict=True))


@pytest.mark.parametrize("room", ROOMS)
def test_all_lanes_together_find_what_picked_ones_find(as_on_a_gpu, monkeypatch, room):
    run, photographs = made(room)
    batch = photographs.batch(0)

    def terms():
        for p in run.assembly.materials.parameters():
            p.grad = None
        found = run.step.terms(batch)
        values = torch.stack([loss.value for _, loss in found.all.values()])
        sum(weight * loss.surrogate for weight, loss in found.all.values()).backward()
        return values, [p.grad.to_dense() for p in run.assembly.materials.parameters() if p.grad is not None]

    together, gradients = terms()
    monkeypatch.setattr(lanes, "FULL_DEVICES", ())
    picked, expected = terms()
    close(together, picked, rtol=1e-5)
    assert len(gradients) == len(expected) > 0
    for one, other in zip(gradients, expected, strict=True):
        close(one, other, rtol=1e-4, atol=1e-4 * float(other.abs().max()))
