"""`neurad bench cube` and `neurad bench gradients`: their processes, their statistics, and tiny runs of both."""

import math

import pytest
import torch
from helpers.oracles import accept
from helpers.tables import csv_rows
from scipy import stats

from benchmarks.bench import cube, cube_worker, gradients
from benchmarks.closed_form import Sphere, reflected_radiance
from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays
from neurad.core.rng import Stream
from neurad.integrators.film import render
from neurad.integrators.method import SceneModel
from neurad.integrators.renderer import path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.walk import Roulette, walk
from neurad.scene.builtin import build_cube
from neurad.scene.textures import TrueMaterials

JOB = {
    "albedo": 0.5, "fields": "hash", "size": 16, "method": "ours", "limit": 4, "rr_prob": 0.95,
    "spp": 2, "pixels": 32,
}  # fmt: skip


def main(words):
    from neurad.cli import main

    main(["bench", *words])


# ---- cube


@pytest.mark.parametrize(("albedo", "roulette", "going_on"), [(0.3, 0.95, 0.3), (0.9, 0.95, 0.9), (0.97, 0.8, 0.8)])
def test_walk_lengths_are_those_of_a_coin(albedo, roulette, going_on):
    """The number of bounces is geometric; mean within 3.9 standard errors (99.99 %), percentile within 15 %."""
    scene, stream, counts = build_cube(albedo), Stream(1), []
    world = build_world(scene)
    materials = TrueMaterials(scene, world.geometry)
    for camera in (view.camera for view in scene.train):
        si = world.intersect(camera_rays(camera, stream.uniform(8192 // len(scene.train), 2) * camera.width))
        count = torch.zeros(len(si))
        u = stream.uniform(len(si), DIMENSIONS)
        for vertex in walk(SceneModel(world, materials), si, materials(si), u, stream, Roulette(1, roulette), None):
            count[vertex.lane] += 1
        counts.append(count)
    counts = torch.cat(counts)
    mean, limit = cube.path_lengths(albedo, roulette)
    assert mean == 1 / (1 - going_on)
    assert abs(float(counts.mean()) - mean) < 3.9 * math.sqrt(going_on / len(counts)) / (1 - going_on)
    assert limit == pytest.approx(float(torch.quantile(counts, 0.999)), rel=0.15, abs=2)


@pytest.mark.parametrize("method", cube.METHODS)
@pytest.mark.parametrize("kind", cube.FIELDS)
def test_a_step_moves_nothing(method, kind):
    """Rate 0: the second step with the same numbers casts the same rays, so nothing has changed."""
    run = cube_worker.make_run({**JOB, "method": method, "fields": kind})
    step, parameters = cube_worker.make_step(run), list(run.assembly.materials.parameters())
    before = [p.detach().clone() for p in parameters]
    rays = [step(), step()]
    assert min(rays) > 2 * 64
    assert all(torch.equal(a, b) for a, b in zip(before, parameters, strict=True))
    assert any(p.grad is not None and float(p.grad.to_dense().abs().max()) > 0 for p in parameters)


def test_work_grows_with_albedo_for_paths_alone():
    rays = {}
    for method in ("ours", "prb"):
        for albedo, limit in ((0.3, 6), (0.9, 60)):
            job = {**JOB, "method": method, "albedo": albedo, "limit": limit}
            step = cube_worker.make_step(cube_worker.make_run(job))
            rays[method, albedo] = step() + step()
    assert rays["ours", 0.9] == pytest.approx(rays["ours", 0.3], rel=0.05)
    assert rays["prb", 0.9] > 4 * rays["prb", 0.3]


def test_reflected_radiance_is_that_of_paths():
    """The closed form against paths; the light hangs off the ceiling and views are not the area, so roughly."""
    scene = build_cube(0.5)
    world = build_world(scene)
    materials = TrueMaterials(scene, world.geometry)
    image = render(scene.train[0].camera, path_tracer(world, materials, None, 6), 4, 1)
    dark = image[image.amax(-1) < 4.0]  # without the light itself
    assert float(dark.mean()) == pytest.approx(reflected_radiance(world.geometry, 0.5), rel=0.35)


def test_a_process_that_dies_leaves_a_row(monkeypatch):
    """As one that runs out of memory would: the others are measured, and the reason is kept."""
    monkeypatch.setattr(cube, "WORKER", ["bash", "-c", "echo no memory >&2; exit 3", "--"])
    (cell,) = cube.measure([JOB], 3, 1.0)
    assert (cell.failed, cell.missing, cell.seconds) == ("no memory", "", [])
    found = cube._row(cell, 2.0, 5)
    assert found["ms"] is None
    assert found["failed"] == "no memory"
    assert not cell.log.exists()


def test_bench_cube(tmp_path, capsys):
    words = ["--albedos", "0.3", "0.7", "--methods", "ours", "--fields", "dense", "--size", "8", "--pixels", "16"]
    main(["cube", *words, "--spp", "2", "--steps", "3", "--out", str(tmp_path / "cube.csv")])
    out = capsys.readouterr().out
    assert "albedo 0.3: paths of 1.4" in out
    rows = csv_rows(tmp_path / "cube.csv")
    assert [r["albedo"] for r in rows] == ["0.3", "0.7"]
    for r in rows:
        assert 0 < float(r["ms"]) < 60000
        assert float(r["peak_mib"]) > 50
        assert r["steps"] == "3"


# ---- gradients


def test_closed_form_on_the_sphere():
    """All methods, with a field that is right and one that is 20 % too bright: 99 % confidence over all."""
    p_values = []
    for factor, names in ((1.0, ("direct", "prb", "ours", "debiased")), (1.2, ("ours", "debiased"))):
        sphere = Sphere(0.5, "embree", factor)
        for method in (method for key, method in gradients.methods().items() if key[0] in names):
            fraction, error = sphere.gradient_fraction(method, 2400)
            assert error < 0.08
            p_values.append(2 * stats.t.sf(abs(fraction - sphere.predicted(method)) / max(error, 1e-6), 15))
    assert accept(p_values)


def test_bench_gradients(tmp_path, capsys):
    main(["gradients", "--albedos", "0.5", "--paths", "160", "--out", str(tmp_path / "gradients.csv")])
    assert "fraction of the derivative" in capsys.readouterr().out
    rows = csv_rows(tmp_path / "gradients.csv")
    assert len(rows) == 11
    assert {r["method"] for r in rows} == {"direct", "prb", "ours", "debiased", "reference"}
