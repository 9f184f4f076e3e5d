"""``scene.glb`` and ``room.usdc`` as Blender imports them."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.clients import blender_python, cache_folder

from neurad.core.camera import project, to_camera

IMPORT = Path(__file__).parent.parent / "helpers/blender_import.py"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def imported(request, kitchen, kitchen_room, tmp_path_factory):
    """What Blender has after an import, and where its cameras see some points, by file."""
    if (kitchen_room / "room.usdc").is_file() is False:
        pytest.skip("room.usdc was not written: pxr is missing")
    python = blender_python(cache_folder(request, "blender"))
    out = tmp_path_factory.mktemp("blender")
    points = np.random.default_rng(0).uniform(*kitchen.bounds, (200, 3))
    camera = kitchen.train[0].camera
    job = {"points": points.tolist(), "width": camera.width, "height": camera.height}
    found = {}
    for name in ("scene.glb", "room.usdc"):
        (out / "job.json").write_text(json.dumps({**job, "file": str(kitchen_room / name), "out": str(out / name)}))
        subprocess.run([python, str(IMPORT), str(out / "job.json")], check=True, capture_output=True)
        found[name] = json.loads((out / name).read_text())
    return points, found


@pytest.mark.parametrize("name", ["scene.glb", "room.usdc"])
def test_blender_has_all_meshes_textures_and_lamps(kitchen, imported, name):
    found = imported[1][name]
    assert len(found["meshes"]) == len(kitchen.meshes)
    assert found["images"] == {"sRGB": len(kitchen.meshes), "Non-Color": len(kitchen.meshes)}
    low, high = (np.array(found["bounds"][i]) for i in (0, 1))
    ours = np.stack((kitchen.bounds[:, 0], -kitchen.bounds[::-1, 2], kitchen.bounds[:, 1]), 1)  # z is up there
    assert np.allclose((low, high), ours, atol=1e-5)
    lamps = [mesh for mesh in kitchen.meshes if mesh.radiance is not None]
    shining = [m["emission"] for m in found["meshes"] if max(m["emission"]) > 0]
    assert np.allclose(sorted(shining), sorted(m.radiance.tolist() for m in lamps), rtol=1e-6)
    assert all(m["textured"] == ["Base Color", "Roughness"] for m in found["meshes"])
    assert sum(m["triangles"] for m in found["meshes"]) >= 0.999 * sum(len(m.faces) for m in kitchen.meshes)


@pytest.mark.parametrize("name", ["scene.glb", "room.usdc"])
def test_its_cameras_see_points_where_ours_do(kitchen, imported, name):
    points, found = imported[0], imported[1][name]["cameras"]
    views = (*kitchen.train, *kitchen.test)
    assert len(found) == len(views)
    for view in views:
        film = np.array(found[view.name]) * (view.camera.width, view.camera.height, 1)
        seen = to_camera(view.camera, torch.from_numpy(points))
        before = seen[:, 2] < -0.1
        assert np.allclose(film[before, :2], project(view.camera, seen)[before], atol=0.02, rtol=1e-4)
