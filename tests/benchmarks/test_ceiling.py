"""What the fields could do at best, and what the mean of every mesh does."""

import numpy as np
import pytest
import torch
from helpers.tiny_fit import few_views

from benchmarks.bench.supervised import SupervisedStep, SurfaceMeans
from neurad.assembly.build import build_world
from neurad.cli import main
from neurad.core.records import PixelBatch, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.primary_hits import PrimaryHits
from neurad.scene.builtin import build_cornell


def step_of(truth):
    scene = build_cornell()
    cameras = [view.camera for view in scene.train[:2]]
    primary = PrimaryHits(build_world(scene), cameras, 1, 0, torch.device("cpu"))
    emitter_mask = torch.zeros(2, primary.pixels, dtype=torch.bool)
    seen = []
    for view in range(2):
        pixel = torch.arange(primary.pixels)
        batch = PixelBatch(torch.full_like(pixel, view), pixel, torch.zeros(len(pixel), 3), torch.ones(len(pixel)), 0)
        seen.append(primary(batch, 1, Stream(0)).si)
    maps = {name: torch.stack([f(si) for si in seen]) for name, f in truth.items()}
    return SupervisedStep(None, primary, emitter_mask, maps), seen


def test_meshes_have_their_mean_and_what_is_not_seen_has_that_of_all():
    """One kept position a pixel, so a pixel's mesh is certain. Values that vary with position average out by mesh."""
    step, seen = step_of({"albedo": lambda si: si.p, "roughness": lambda si: si.p[:, :1] ** 2})
    means = SurfaceMeans.of(step)
    si = SurfaceInteraction.cat(*seen)
    mesh = step.primary.world.geometry.mesh_index[si.prim.clamp_min(0)]
    found = means(si)
    for k in mesh[si.valid].unique():
        here = si.valid & (mesh == k)
        torch.testing.assert_close(
            found.albedo[here], si.p[here].mean(0).expand(int(here.sum()), 3), atol=1e-5, rtol=1e-5
        )
        expected = (si.p[here, :1] ** 2).mean()
        torch.testing.assert_close(found.roughness[here], expected.expand(int(here.sum()), 1), atol=1e-5, rtol=1e-5)
    assert torch.equal(means.albedo(si), found.albedo)
    whole = torch.cat((si.p[si.valid], si.p[si.valid, :1] ** 2), -1).mean(0)
    torch.testing.assert_close(means.whole, whole, atol=1e-5, rtol=1e-5)
    assert bool((means.of_room().means == means.whole).all())
    unseen = torch.ones(len(means.means), dtype=torch.bool)
    unseen[mesh[si.valid]] = False
    if unseen.any():
        torch.testing.assert_close(means.means[unseen][0, :3], si.p[si.valid].mean(0), atol=1e-5, rtol=1e-5)


def test_without_true_roughness_it_is_one():
    step, seen = step_of({"albedo": lambda si: si.p})
    assert bool((SurfaceMeans.of(step)(seen[0]).roughness == 1.0).all())


@pytest.mark.main
def test_the_command_shows_the_fields_and_the_means(capsys, monkeypatch):
    few_views(monkeypatch, "patterns")
    settings = ["data.patches=64", "model.sampling.spp=2", "model.sampling.cached_spp=2"]
    words = [word for setting in settings for word in ("--set", setting)]
    main(["bench", "ceiling", "--config", "patterns.yaml", "--seconds", "1", *words])
    lines = capsys.readouterr().out.splitlines()
    albedo = {}
    for line in lines:
        for who in ("the fields", "means of meshes", "mean of the room", "best constant"):
            if line.startswith(who):
                albedo.setdefault(who, []).append(float(line.removeprefix(who).split()[0]))
    lookup = float(next(line for line in lines if line.startswith("true colour's lookup")).split()[-3])
    r2 = float(next(line for line in lines if "R2 of the lookup" in line).rstrip(")").split()[-1])
    constant = float(next(line for line in lines if line.startswith("best constant")).split()[-3])
    assert lookup - constant == pytest.approx(-10 * np.log10(1 - r2), abs=0.02)
    assert any(line.startswith("Held-out views, glossy pixels with light on them") for line in lines)
    assert len(albedo["the fields"]) == len(albedo["means of meshes"]) == len(albedo["mean of the room"]) == 3
    everywhere, glossy = (albedo["best constant"][k] - albedo["mean of the room"][k] for k in (0, 2))
    assert 0.0 <= everywhere < 0.5, "training views show about the mean of held-out ones"
    assert glossy > everywhere, "a constant fitted to the chosen pixels does better"
    assert albedo["means of meshes"][0] > albedo["best constant"][0] + 3.0
