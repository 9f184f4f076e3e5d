"""A step as a GPU does it, on the CPU: all lanes work together, by Warp's kernels, and nothing asks the device."""

from dataclasses import replace

import pytest
import torch
from helpers.devices import CUDA, close
from helpers.host_questions import no_host_questions

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.runs.model_settings import model_settings
from neurad.runtime import dispatch, lanes
from neurad.scene import builtin
from neurad.training import step
from neurad.training.guard import NotFinite
from neurad.training.schedule import Progress
from neurad.training.session import TrainingRun

ROOMS = {"cornell": "patterns.yaml", "patterns": "patterns.yaml", "kitchen": "scene.yaml"}
"""A room that is diffuse, a rough one, textured; a room with panes of glass, and lamps measured by photographs."""
PROGRESS = Progress(0.1, None, 1.0)


@pytest.fixture
def as_on_a_gpu(warp_on_cpu, monkeypatch):
    monkeypatch.setattr(dispatch, "KERNEL_DEVICES", ())
    monkeypatch.setattr(lanes, "FULL_DEVICES", ("cpu",))


def made(room, device="cpu", cuda_graph=True):
    """The parts of a fit of three views, and their photographs."""
    scene = builtin.build(room)
    settings = model_settings(ROOMS[room])
    settings = replace(settings, optimization=replace(settings.optimization, cuda_graph=cuda_graph))
    sampling = replace(settings.sampling, spp=4, cached_spp=4)
    photographs = SceneData(DataSettings(scene=room, patches=64))
    photographs.scene = replace(scene, train=scene.train[:3], test=[])
    photographs.setup("fit")
    torch.manual_seed(0)
    return TrainingRun.of_scene(
        photographs.scene, photographs, replace(settings, tracer="warp", sampling=sampling), device
    ), photographs


def weights(run):
    return [p.detach().clone() for p in run.assembly.materials.parameters()]


@pytest.mark.parametrize("room", ROOMS)
def test_a_step_asks_the_device_nothing(as_on_a_gpu, room):
    run, photographs = made(room)
    for iteration in range(2):  # makes tables of the lights, moments of the optimizers
        run.step(photographs.batch(iteration), PROGRESS)
    batch, before = photographs.batch(2), weights(run)
    with no_host_questions():
        run.step(batch, PROGRESS)
    assert any(not torch.equal(new, old) for new, old in zip(weights(run), before, strict=True))
    assert run.iteration == 3


def test_a_step_that_may_be_replayed_is_the_step_that_asks(as_on_a_gpu, monkeypatch):
    def trained():
        run, photographs = made("patterns")
        for iteration in range(4):
            run.step(photographs.batch(iteration), PROGRESS)
        return run, weights(run)

    run, replayed = trained()
    assert run.step.replayed is not None
    rays = run.assembly.world.tracer.rays_cast
    monkeypatch.setattr(step, "why_not_replayed", lambda _: "it asks")
    other, asking = trained()
    assert other.step.replayed is None
    assert other.assembly.world.tracer.rays_cast == rays > 0
    assert other.step.counters == run.step.counters
    for one, expected in zip(replayed, asking, strict=True):
        torch.testing.assert_close(one, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("device", [CUDA])
@pytest.mark.parametrize("room", ROOMS)
def test_graphs_replay_what_a_step_does(device, room, capsys):
    runs = []
    for cuda_graph in (True, False):
        run, _ = made(room, device, cuda_graph)
        losses = [float(run.advance(0.1)) for _ in range(80)]
        runs.append((run, losses, weights(run)))
    (replayed, losses, found), (asking, expected, known) = runs
    assert capsys.readouterr().err.count("without a CUDA graph") == 1  # where that is asked for
    assert replayed.step.replayed is not None
    assert 1 <= replayed.step.replayed.captures[0] == replayed.step.replayed.captures[1] <= 2
    assert asking.step.replayed is None
    assert replayed.assembly.world.tracer.rays_cast == asking.assembly.world.tracer.rays_cast
    assert losses[:10] == pytest.approx(expected[:10], rel=0.02)  # sums have no order: later steps drift apart
    for one, other in zip(found, known, strict=True):
        assert float((one - other).norm()) < 0.1 * float(other.norm()) + 1e-3


def test_from_the_first_step_that_is_not_finite_nothing_moves(as_on_a_gpu):
    run, photographs = made("patterns")
    guide = run.assembly.world.guide
    for iteration in range(2):
        run.step(photographs.batch(iteration), PROGRESS)
    before = weights(run)
    batch = photographs.batch(2)
    batch.color[3] = float("nan")
    for bad in (batch, photographs.batch(3)):
        run.step(bad, PROGRESS)
    assert all(torch.equal(new, old) for new, old in zip(weights(run), before, strict=True))
    assert guide is None or bool(guide.squares.isfinite().all())
    assert run.iteration == 4
    with pytest.raises(NotFinite, match="iteration 2: the photographs are not finite"):
        run.step.check()
    assert run.iteration == 2


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
