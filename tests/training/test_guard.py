"""A run stops at the first number that is not finite, names it, and can be repeated from there."""

import math

import pytest
import torch
from helpers.tiny_fit import fails
from helpers.tiny_scene import write_scene

from neurad.cli import main
from neurad.integrators import vertex_principled_kernels
from neurad.training.guard import first_bad
from neurad.training.inverse import InverseRenderer

SMALL = ("--model.albedo.grid.log2_size=8", "--model.roughness.grid.log2_size=8", "--model.radiance.grid.log2_size=8")


@pytest.fixture(autouse=True)
def _place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pytest.importorskip("mitsuba")


def words(folder, *args):
    return [
        "fit", "--config", "scene.yaml", f"--data.root={folder}", "--trainer.accelerator=cpu", *SMALL,
        "--trainer.enable_progress_bar=false", "--trainer.max_steps=6", "--trainer.max_time=null",
        "--data.patches=32", "--evaluation.every_n_steps=100", "--evaluation.spp=1", *args,
    ]  # fmt: skip


def stops(capfd, folder, *args):
    """The sentence that a fit ends with."""
    return fails(capfd, *words(folder, *args), alone=False, leaves=True)


def plant(monkeypatch, at, where):
    """Let ``where(module)`` spoil something before iteration ``at``."""
    plain = InverseRenderer.training_step

    def step(self, batch, batch_idx):
        if self.iteration == at:
            with torch.no_grad():
                where(self)
        return plain(self, batch, batch_idx)

    monkeypatch.setattr(InverseRenderer, "training_step", step)


def test_a_nan_weight_stops_the_run_and_is_repeated_from_its_folder(tmp_path, capfd, monkeypatch):
    folder = write_scene(tmp_path / "scene")

    def spoil(module):
        module.assembly.radiance.mlp.layers[0].weight[1, 2] = math.nan

    with monkeypatch.context() as patch:
        plant(patch, 3, spoil)
        error = stops(capfd, folder)
    assert "iteration 3: the weight radiance.mlp.layers.0.weight is not finite (1 of" in error
    assert "pixels of views 0, 1, 2, the first view" in error
    run = tmp_path / "lightning_logs/version_0"
    kept = torch.load(run / "bad_batch.pt", weights_only=True)
    assert kept["iteration"] == 3
    assert len(kept["pixel"]) == 32
    assert not (run / "checkpoints/last.ckpt").exists()  # nothing broken under the name that `last` finds
    again = stops(capfd, folder, f"--ckpt_path={run / 'checkpoints/bad.ckpt'}")  # nothing is planted now
    assert "iteration 3: the weight radiance.mlp.layers.0.weight is not finite" in again
    assert torch.equal(torch.load(run / "bad_batch.pt", weights_only=True)["pixel"], kept["pixel"])


def test_an_infinite_sample_is_named_and_the_run_goes_on_once_it_is_mended(tmp_path, capfd, monkeypatch):
    folder = write_scene(tmp_path / "scene")
    plain = vertex_principled_kernels.resolve_hits_principled

    def broken(*arrays):
        plain(*arrays)
        arrays[-1].value[0, :1] = math.inf  # the direct light of the first lane

    with monkeypatch.context() as patch:
        plant(patch, 2, lambda _: patch.setattr(vertex_principled_kernels, "resolve_hits_principled", broken))
        error = stops(capfd, folder)
    assert "iteration 2: what integrators.vertex_principled._bounce.values returned is not finite (3 of" in error
    main(words(folder, f"--ckpt_path={tmp_path / 'lightning_logs/version_0/checkpoints/bad.ckpt'}"))
    state = torch.load(tmp_path / "lightning_logs/version_0/checkpoints/last.ckpt", weights_only=True)
    assert state["neurad"]["iteration"] == 6


def test_a_bad_gradient_is_named(tmp_path, capfd, monkeypatch):
    """The loss is finite, its derivative is not."""
    folder = write_scene(tmp_path / "scene")

    def spoil(module):
        module.assembly.materials.fields["albedo"].mlp.layers[-1].bias.register_hook(lambda g: g * math.inf)

    plant(monkeypatch, 1, spoil)
    error = stops(capfd, folder)
    assert "iteration 1: the gradient of materials.fields.albedo.mlp.layers.1.bias is not finite" in error


def test_the_first_bad_value_is_found_and_none_in_a_clean_call():
    from neurad.bsdf.diffuse import Diffuse
    from neurad.core.records import Surface

    up = torch.tensor([[0.0, 0.0, 1.0]])
    good, bad = (Surface(torch.full((1, 3), x), torch.ones(1, 1)) for x in (0.5, math.nan))
    assert first_bad(lambda: Diffuse().eval(good, up, up)) is None
    assert "bsdf.diffuse.Diffuse.eval" in first_bad(lambda: Diffuse().eval(bad, up, up))
