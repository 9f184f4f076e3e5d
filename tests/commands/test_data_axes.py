"""Meshes and cameras whose axes differ: ``--axes``, and what is known of programs that turn cameras without a word."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import layouts

from neurad.cli import main
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr, to_srgb

pytest.importorskip("mitsuba")

CASE = Path(__file__).resolve().parents[3] / "shared/cases/c28"


def through_nerfstudio(folder, cameras, **changes):
    """As ``ns-process-data polycam`` writes cameras: their rows in another order, and no ``applied_transform``."""
    frames = []
    for index, camera in enumerate(cameras):
        layouts.noise(folder / f"images/frame_{index + 1:05d}.exr", camera, "image", index)
        frames.append({
            "fl_x": camera.fl_x, "fl_y": camera.fl_y, "cx": camera.cx, "cy": camera.cy, "w": camera.width,
            "h": camera.height, "file_path": f"./images/frame_{index + 1:05d}.jpg",
            "transform_matrix": camera.to_world[[2, 0, 1, 3]].tolist(),
        })  # fmt: skip
    described = {"camera_model": "OPENCV", "orientation_override": "none", "frames": frames, **changes}
    kept = {key: value for key, value in described.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(kept))
    return folder


def made(*words):
    mesh = layouts.write_mesh(Path("mesh"))
    main(["data", "nerfstudio", *map(str, words), "--mesh", str(mesh), "--out", "room"])
    return load_scene("room", None, 0)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"orientation_override": None},
        {"camera_model": "SIMPLE_PINHOLE"},
        {"applied_transform": np.eye(4)[:3].tolist()},
    ],
)
def test_polycam_through_nerfstudio_is_turned_back_and_other_cameras_stay_as_they_are(place, changes, capfd):
    cameras = layouts.cameras()
    scene = made(through_nerfstudio(place / "src", cameras, **changes))
    for view, camera in zip(scene.train, cameras, strict=True):
        expected = camera.to_world[[2, 0, 1, 3]] if changes else camera.to_world
        np.testing.assert_allclose(view.camera.to_world, expected, atol=1e-12)
    np.testing.assert_allclose(scene.bounds, [[-2, 0, -2], [2, 3, 2]], atol=1e-6)
    said = "its cameras are Polycam's as ns-process-data turns them"
    assert ("" if changes else said) in (found := capfd.readouterr().err)
    assert ("Polycam" in found) == (not changes)


@pytest.mark.parametrize("axes", ["zxy", "z,x,y", "+z +x +y", "0 0 1 1 0 0 0 1 0", "[[0,0,1],[1,0,0],[0,1,0]]"])
def test_a_mesh_is_brought_to_cameras_whose_rows_are_permuted(place, axes):
    """Where nothing in the file tells it: what cameras see is what those of before see of the mesh as it was."""
    cameras = layouts.cameras()
    source = through_nerfstudio(place / "src", cameras, orientation_override=None)
    before, after = layouts.write_mesh(place / "again"), made(source, "--axes", axes, "--scale", "0.5")
    corners = np.array([line.split()[1:] for line in before.read_text().splitlines() if line[:2] == "v "], float)
    found = np.concatenate([mesh.vertices for mesh in after.meshes])
    expected = 0.5 * corners[:, [2, 0, 1]]
    assert {tuple(row) for row in np.round(found, 5)} == {tuple(row) for row in np.round(expected, 5)}
    lamp = next(mesh for mesh in after.meshes if mesh.radiance is not None)
    a, b, c = lamp.vertices[lamp.faces[0]].astype(float)
    down = np.cross(b - a, c - a)
    np.testing.assert_allclose(down / np.linalg.norm(down), [0, 0, -1], atol=1e-6)  # -Y of the mesh is -Z now


def test_a_rotation_is_rounded_to_the_nearest(place):
    c, s = round(np.cos(0.3), 3), round(np.sin(0.3), 3)
    scene = made(layouts.write_nerfstudio(place / "src", layouts.cameras()), f"--axes={c} {-s} 0 {s} {c} 0 0 0 1")
    floor = next(mesh for mesh in scene.meshes if mesh.radiance is None)
    corners = np.sort(np.linalg.norm(floor.vertices, axis=1))
    np.testing.assert_allclose(corners, np.full(len(corners), np.sqrt(8.0)), rtol=1e-6)


@pytest.mark.skipif(not CASE.is_dir(), reason="the shared cases are not here")
def test_the_shared_case_of_permuted_rows(place):
    """Rendered from its cameras it is what the photographs show."""
    words = [str(CASE), "--mesh", str(CASE / "room.obj"), "--axes", "x,-z,y"]
    main(["data", "nerfstudio", *words, "--out", "room"])
    main(["render", "--root", "room", "--out", "out", "--spp", "32", "--map-spp", "1"])
    for path in sorted((CASE / "images").iterdir()):
        truth, found = read_exr(path)[..., :3], read_exr(place / "out/images" / path.name)
        exposure = 0.8 / np.percentile(truth, 90)
        error = to_srgb(np.clip(truth * exposure, 0, 1)) - to_srgb(np.clip(found * exposure, 0, 1))
        assert -10 * np.log10(np.mean(error**2)) > 26.0  # noise alone: 27 to 30 dB
