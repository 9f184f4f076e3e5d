"""The peer of `neurad bench peer`: its voxels, its gradients, and what is reported of a race."""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tables import csv_rows

from benchmarks.peer import report
from benchmarks.peer.models import Pyramid
from benchmarks.peer.voxels import SurfaceVoxels
from neurad.assembly.region import finest_cells
from neurad.compare.runs import read_other
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.formats.load import load_scene
from neurad.runs import child
from neurad.scene.geometry import Geometry
from neurad.tracing.select import make_tracer


@pytest.fixture(scope="module")
def scene():
    return load_scene(None, "cornell")


@pytest.fixture(scope="module")
def voxels(scene):
    return SurfaceVoxels(scene, 16)


@pytest.fixture(scope="module")
def mi():
    pytest.importorskip("mitsuba")
    from benchmarks.loaded import load_mitsuba

    try:
        return load_mitsuba()
    except InputError as error:
        pytest.skip(f"mitsuba: {error}")


# ---- voxels


@pytest.fixture(scope="module")
def hits(scene):
    """Surface points that a camera sees."""
    geometry = Geometry(scene)
    tracer = make_tracer("embree", geometry.vertices, geometry.faces)
    camera = scene.train[0].camera
    rays = camera_rays(camera, torch.rand(4000, 2, generator=torch.Generator().manual_seed(0)) * camera.width)
    si = geometry.interact(rays, tracer.closest(rays))
    return si[si.valid]


def test_voxels_cover_what_cameras_see(voxels, hits):
    """A linear function comes back exactly, which it does only if all eight corners have their own entries."""
    values = torch.from_numpy(voxels.positions())
    assert torch.allclose(voxels.lookup(values, hits.p), hits.p, atol=1e-4 * voxels.side)
    assert len(voxels) < 0.9 * 17**3


def test_pyramid_gradient_is_the_transpose(voxels):
    pyramid = Pyramid(voxels, 1e-2, 1e-2)
    assert len(pyramid.steps) == 2
    for step in pyramid.steps:
        x = torch.randn(len(step.begin), 3, dtype=torch.float64, requires_grad=True)
        y = torch.randn(len(step.parents), 3, dtype=torch.float64)
        (g,) = torch.autograd.grad((step(x) * y).sum(), x)
        direction = torch.randn_like(x)
        assert torch.allclose((g * direction).sum(), (step(direction) * y).sum())
    assert pyramid().shape == (len(voxels), 4)
    assert torch.allclose(pyramid()[:, :3], torch.tensor(0.5))


# ---- Mitsuba


def test_texture_is_the_lookup_of_the_metrics(mi, voxels, hits):
    from benchmarks.peer.texture import make_texture

    texture = make_texture(mi, voxels)
    values = torch.rand(len(voxels), 4)
    texture.values = mi.Float(values.numpy().ravel())
    si = mi.SurfaceInteraction3f()
    si.p = mi.Point3f(np.ascontiguousarray(hits.p.numpy().T))
    expected = voxels.lookup(values, hits.p).numpy()
    np.testing.assert_allclose(np.array(texture.eval(si)).T, expected[:, :3], atol=2e-5)
    np.testing.assert_allclose(np.array(texture.eval_1(si)), expected[:, 3], atol=2e-5)


def photographs_of(scene, value):
    camera = scene.train[0].camera
    return np.full((len(scene.train), camera.width * camera.height, 3), value, np.float32)


def small(scene, size=16):
    """The scene with one training view of a few pixels."""
    view = scene.train[0]
    return replace(scene, train=[replace(view, camera=replace(view.camera, width=size, height=size))])


def test_gradient_is_that_of_the_loss(mi):
    """Central differences on one random stream; Lambertian, without roulette, so that paths do not depend on albedo."""
    from benchmarks.peer.replay import Replay

    cube = small(load_scene(None, "cube"))
    assert cube.features.is_diffuse
    voxels = SurfaceVoxels(cube, 8)
    rng = np.random.default_rng(1)
    values = rng.uniform(0.3, 0.7, (len(voxels), 4)).astype(np.float32)
    direction = rng.uniform(-1, 1, values.shape).astype(np.float32)

    def run(shift):
        replay = Replay(mi, cube, voxels, photographs_of(cube, 0.4), max_depth=4, rr_depth=99, seed=3)
        return replay.step(values + np.float32(shift) * direction, 256, 4)

    middle, step = run(0.0), 0.02
    expected = (run(step).loss - run(-step).loss) / (2 * step)
    assert middle.not_finite == 0
    assert abs(expected) > 1e-4
    assert float((middle.values * direction).sum()) == pytest.approx(expected, rel=0.02)


SHORT = {"scene": "cornell", "max_steps": 30, "resolution": 16, "pixels": 512, "samples": 2}


def test_a_short_run_finds_albedo(mi, tmp_path):
    """As the race starts it, in a process of its own."""
    out, described = tmp_path / "peer.csv", tmp_path / "peer.json"
    described.write_text(json.dumps({**SHORT, "kind": "grid", "seconds": 1e6, "out": str(out), "average": 0.0}))
    subprocess.run([*child.NEURAD, "bench", "peer-worker", str(described)], check=True)
    rows = csv_rows(out)
    assert len(rows) == 20
    assert float(rows[-1]["albedo_psnr"]) > float(rows[0]["albedo_psnr"]) + 1.0
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)


def test_averages_lag_behind_while_values_still_rise(mi, tmp_path):
    """And averages over less than an iteration are the values themselves."""
    from benchmarks.peer.fit import PeerSettings, fit

    found = []
    for fraction in (0.0, 1e-6, 0.5):
        out = tmp_path / f"{fraction}.csv"
        fit(PeerSettings("grid", 1e6, str(out), **{**SHORT, "max_steps": 8}, average=fraction))
        found.append([float(row["albedo_psnr"]) for row in csv_rows(out)])
    present, same, mean = found
    assert same == pytest.approx(present, abs=0.01)  # sums over threads come in any order
    assert mean[4] < present[4] - 0.02


def test_networks_are_as_fine_as_the_photographs_where_the_config_leaves_it_open(mi, tmp_path):
    from benchmarks.peer.fit import PeerSettings, _held_out, _sizes, fit

    out = tmp_path / "peer.csv"
    sizes = {"grid": {"levels": 2, "coarsest": 4, "finest": None, "log2_size": 10}, "width": 8, "hidden_layers": 1}
    few = {"max_steps": 2, "resolution": 8, "pixels": 64, "samples": 2}
    settings = PeerSettings("network", 1e6, str(out), scene="cornell", albedo=sizes, roughness=sizes, **few)
    fit(settings)
    assert math.isfinite(float(csv_rows(out)[-1]["albedo_psnr"]))
    scene = load_scene(None, "cornell")
    held_out = _held_out(scene)
    finest = finest_cells(held_out.tracer, scene)
    assert finest > 4
    assert [field.grid.finest for field in _sizes(settings, scene, held_out.tracer)] == [finest, finest]


def test_compare_draws_a_run_of_the_peer(mi, tmp_path, monkeypatch):
    from benchmarks.bench import peer
    from benchmarks.peer.fit import PeerSettings, fit

    def process(name, budget, words):
        """As a process of its own, for few steps."""
        fit(PeerSettings(**json.loads(Path(words[-1]).read_text())))

    monkeypatch.setattr(peer, "_process", process)
    path = peer._peer(tmp_path, "grid", 240.0, {**SHORT, "max_steps": 2})
    run = read_other(f"Mitsuba PRB={path.parent}")
    assert path.parent.name == "peer_grid_240"
    assert (run.method, run.last["iteration"]) == ("Mitsuba PRB", 2)
    assert math.isfinite(run.last["albedo_psnr"])


def test_a_missing_llvm_is_one_sentence(tmp_path):
    pytest.importorskip("mitsuba")
    words = ["bench", "peer", "--scene", "cornell", "--budget", "1", "--out", str(tmp_path / "out")]
    code = f"from neurad.cli import main; main({words!r})"
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    line = done.stderr.strip().splitlines()[-1]
    assert line.startswith("neurad: error: bench peer: ")
    assert "libllvm19" in line
    assert not (tmp_path / "out").exists()


# ---- reports


def curve(name, points, budget=10.0):
    rows = [{"seconds": str(s), "iteration": "1", "albedo_psnr": str(v)} for s, v in points]
    return report.Curve(name, budget, rows)


def test_ratio_is_that_of_the_faster_peer(tmp_path):
    curves = [
        curve("ours", [(1, 20), (2, 24)]),
        curve("ours", [(5, 26)], budget=20),
        curve("peer_grid", [(4, 20), (8, 22)]),
        curve("peer_network", [(6, 23)]),
    ]
    rows = report.write(tmp_path, curves, "test")
    table = {float(row["target_db"]): row for row in csv_rows(tmp_path / "peer.csv")}
    assert list(table) == [18.0, 19.0, 20.0, 22.0, 24.0, 26.0, 28.0, 30.0]
    assert float(table[20]["ratio"]) == pytest.approx(4.0)
    assert float(table[22]["ours_seconds"]) == pytest.approx(1.5)
    assert float(table[22]["ratio"]) == pytest.approx(4.0)
    assert table[24]["peer_grid_seconds"] == table[24]["peer_network_seconds"] == table[24]["ratio"] == ""
    assert table[28]["ours_seconds"] == ""
    assert float(table[26]["ours_seconds"]) == pytest.approx(5.0)
    assert len(csv_rows(tmp_path / "curves.csv")) == 6
    assert (tmp_path / "curves.png").stat().st_size > 1000
    assert "peer_network" in report.text(rows, curves)
