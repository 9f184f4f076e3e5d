"""The damages of ``neurad bench capture`` have the amounts that they state, and lamps stay as they are."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.lamp_room import lamp_room
from helpers.tables import csv_rows

from benchmarks.bench import capture as bench
from benchmarks.bench import damage
from benchmarks.bench.damage import Capture, divided
from neurad.cli import main
from neurad.core.scene_records import Development
from neurad.images.photographs import read_view

SIZE = 28


def captured(seed=0):
    rng, scene = np.random.default_rng(7), lamp_room()
    ramp = np.linspace(0.1, 0.8, SIZE, dtype=np.float32)[:, None, None] * np.ones((1, SIZE, 3), np.float32)
    pictures = [ramp * rng.uniform(0.5, 1.0, 3).astype(np.float32) for _ in scene.train]
    return Capture(scene, pictures, np.random.default_rng(seed))


def dark(capture):
    return [mesh for mesh in capture.scene.meshes if mesh.radiance is None]


def area(meshes):
    return sum(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area for mesh in meshes)


def test_cameras_are_turned_and_moved_by_what_is_said():
    capture = captured()
    before = [view.camera.to_world for view in capture.scene.train]
    damage.turn_cameras(capture, 0.3, 5.0)
    for old, view in zip(before, capture.scene.train, strict=True):
        new = view.camera.to_world
        angle = math.degrees(math.acos(min(1.0, (np.trace(new[:3, :3] @ old[:3, :3].T) - 1.0) / 2.0)))
        assert angle == pytest.approx(0.3, abs=1e-3)
        assert np.linalg.norm(new[:3, 3] - old[:3, 3]) == pytest.approx(0.005)


def test_divided_meshes_have_short_edges_and_stay_whole():
    mesh = dark(captured())[-1]  # the table, a box
    made = divided(replace(mesh, uvs=mesh.vertices[:, :2].copy()), 0.1)
    corners = made.vertices[made.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max() <= 0.1 + 1e-6
    assert area([made]) == pytest.approx(area([mesh]), rel=1e-5)
    assert trimesh.Trimesh(made.vertices, made.faces).is_watertight  # once equal corners are merged
    np.testing.assert_allclose(made.uvs, made.vertices[:, :2], atol=1e-6)


@pytest.mark.parametrize("change", [damage.wave_mesh, damage.roughen_mesh])
def test_surfaces_move_by_what_is_said_and_normals_with_them(change):
    capture = captured()
    whole = {mesh.name: mesh for mesh in capture.scene.meshes}
    capture.scene = replace(
        capture.scene, meshes=[replace(mesh, normals=_normals(mesh)) for mesh in capture.scene.meshes]
    )
    change(capture, 5.0)
    moved, off = [], []
    for mesh in dark(capture):
        exact = divided(whole[mesh.name], damage.EDGE)
        moved.append(mesh.vertices - exact.vertices)
        off.append((_normals(mesh) * mesh.normals).sum(-1))
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1.0, atol=1e-5)
    moved, off = np.concatenate(moved), np.concatenate(off)
    if change is damage.wave_mesh:
        assert 0.0049 < np.abs(moved).max() <= 0.005 + 1e-6
        assert moved.std() == pytest.approx(0.005 / math.sqrt(2.0), rel=0.1)
    else:
        assert moved.std() == pytest.approx(0.005, rel=0.15)
    assert np.degrees(np.arccos(np.median(off))) < 5.0
    assert all(mesh.vertices is whole[mesh.name].vertices for mesh in capture.scene.meshes if mesh.radiance is not None)


def _normals(mesh):
    return np.asarray(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals, np.float32)


def test_holes_take_what_is_said():
    capture = captured()
    before = area(dark(capture))
    damage.pierce_mesh(capture, 0.02)
    assert 0.97 < area(dark(capture)) / before <= 0.98
    damage.close_mesh(capture)
    assert 0.99 < area(dark(capture)) / before <= 1.0 + 1e-6


def test_decimation_leaves_what_is_said():
    pytest.importorskip("open3d")
    capture = captured()
    capture.with_meshes(lambda mesh: divided(mesh, 0.1))
    before = {mesh.name: len(mesh.faces) for mesh in dark(capture)}
    damage.decimate_mesh(capture, 0.2)
    for mesh in dark(capture):
        assert len(mesh.faces) == pytest.approx(max(4, 0.2 * before[mesh.name]), abs=2)


def test_ignored_distortion_moves_a_point_as_the_lens_would():
    capture, size = captured(), 101
    view = capture.scene.train[0]
    camera = replace(view.camera, width=size, height=size)
    capture.scene = replace(capture.scene, train=[replace(view, camera=camera)])
    y, x = np.mgrid[:size, :size] + 0.5
    at = np.array([80.0, 70.0])
    capture.photographs = [
        np.repeat(np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 8.0)[..., None], 3, 2).astype(np.float32)
    ]
    damage.distort(capture)
    shown = capture.photographs[0][..., 0]
    place = np.array([(shown * x).sum(), (shown * y).sum()]) / shown.sum()
    plane = (at - size / 2) / camera.fl_x
    expected = size / 2 + camera.fl_x * plane * (1.0 + damage.K1 * (plane**2).sum())
    np.testing.assert_allclose(place, expected, atol=0.05)
    assert capture.right[0].lens.numerator == (damage.K1,)
    assert not capture.scene.train[0].camera.lens.bends


def test_cameras_say_a_focal_length_that_is_off():
    capture = captured()
    damage.change_focal_length(capture)
    for right, view in zip(capture.right, capture.scene.train, strict=True):
        assert view.camera.fl_x == pytest.approx(damage.FOCAL * right.fl_x)


def test_exposures_differ_by_half_a_stop_at_most():
    capture = captured()
    before = [image.mean() for image in capture.photographs]
    damage.change_exposures(capture, fitted=True)
    stops = np.log2([image.mean() / old for image, old in zip(capture.photographs, before, strict=True)])
    assert 0.1 < np.ptp(stops) <= 2 * damage.STOP
    assert stops.mean() == pytest.approx(0.0, abs=1e-5)
    assert capture.scene.photography.exposure == "fit"


def test_photographs_are_written_as_they_are_or_as_jpeg(tmp_path):
    capture = captured()
    for coded, tolerance in ((False, 1e-3), (True, 0.04)):
        capture.coded = coded
        scene = capture.written(tmp_path, 14)
        for view, image in zip(scene.train, capture.photographs, strict=True):
            means = image.reshape(14, 2, 14, 2, 3).mean((1, 3))
            found = read_view(view)
            assert (view.development == Development()) != coded
            np.testing.assert_allclose(found, means, atol=tolerance)
            assert found.mean() == pytest.approx(means.mean(), rel=0.02)


def test_fits_are_kept_and_not_made_again(tmp_path, monkeypatch):
    made = []

    def measure(options, name, seed):
        made.append((name, seed))
        scores = dict.fromkeys(bench.SCORES, 20.0 + seed - 2.0 * (name != bench.EXACT))
        return {"damage": name, "seed": seed, **scores, "pixels": 0.5 * seed, "seconds": 1.0}

    monkeypatch.setattr(bench, "measure", measure)
    words = ["bench", "capture", "--only", "0.3 degrees and", "--fits", str(tmp_path / "fits.csv")]
    main([*words, "--seeds", "1"])
    main([*words, "--seeds", "1,2", "--out", str(tmp_path / "table.csv")])
    name = "poses 0.3 degrees and 5 mm"
    assert made == [(bench.EXACT, 1), (name, 1), (bench.EXACT, 2), (name, 2)]
    exact, lost = csv_rows(tmp_path / "table.csv")
    assert (exact["damage"], float(exact["albedo"]), int(exact["seeds"])) == (bench.EXACT, 21.5, 2)
    assert (lost["damage"], float(lost["albedo"]), float(lost["roughness_error"])) == (name, 2.0, 0.0)
    assert float(lost["pixels"]) == 0.75
    with pytest.raises(SystemExit):
        main([*words, "--seeds", "one"])


@pytest.mark.slow
def test_a_damaged_room_is_fitted_and_scored(tmp_path):
    small = ["data.patches=32", "model.sampling.spp=2", "model.sampling.cached_spp=2"]
    words = ["bench", "capture", "--config", "patterns.yaml", *(word for one in small for word in ("--set", one))]
    words += ["--side=16", "--steps=2", "--seeds=1", "--only=EV fitted", f"--out={tmp_path / 'table.csv'}"]
    main(words)
    exact, lost = csv_rows(tmp_path / "table.csv")
    assert lost["damage"].startswith("0.3 degrees")
    assert float(exact["albedo"]) > 5.0
    assert float(exact["pixels"]) < 1e-3 < float(lost["pixels"])
    assert math.isfinite(float(lost["albedo"]))
