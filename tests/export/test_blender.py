"""``scene.glb`` and ``room.usdc`` as Blender imports them."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.clients import blender_python, cache_folder
from helpers.exported import exported
from helpers.object_scene import object_scene, sky
from helpers.pathtraced import picture

from neurad.core.camera import project, to_camera
from neurad.core.scene_records import DIELECTRIC, METAL, EnvironmentMap
from neurad.export.cycles import render_views
from neurad.formats.blender.process import find_blender
from neurad.formats.mitsuba.read import read_xml
from neurad.images.image_io import read_exr
from neurad.scene.builtin.plain import views

IMPORT = Path(__file__).parent.parent / "helpers/blender_import.py"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def python(request):
    """A Python that has bpy."""
    return blender_python(cache_folder(request, "blender"))


@pytest.fixture(scope="module")
def imported(python, kitchen, kitchen_room, tmp_path_factory):
    """What Blender has after an import, and where its cameras see some points, by file."""
    pytest.importorskip("pxr")
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


def test_a_surface_sends_as_much_light_into_each_direction(python, tmp_path):
    """Under an environment that is 1 everywhere, from nearly above to grazing."""
    scene = object_scene(EnvironmentMap(np.ones((4, 8, 3), np.float32)), size=8)
    eyes = [(4.0 * np.sin(a), 4.0 * np.cos(a), 0.0) for a in np.radians((5, 45, 70, 80))]
    test = views("test", [(eye, (0.0, 0.0, 0.0)) for eye in eyes], 3.0, 8)
    scene = replace(scene, meshes=[replace(scene.meshes[1])], test=test)
    room = exported(scene, tmp_path / "room")
    again = read_xml(room / "scene.xml").check()
    ours = [picture(again, view.camera, 1024).mean((0, 1)) for view in test]
    notes = json.loads((room / "room.json").read_text())
    found = {}
    for table in (notes["base_color_over_angles"], None):
        (room / "room.json").write_text(json.dumps({**notes, "base_color_over_angles": table}))
        found[table] = [x.mean((0, 1)) for x in render_views(find_blender(python), room, test, 1024, 1)]
    assert np.allclose(found[notes["base_color_over_angles"]], ours, rtol=0.01)
    assert not np.allclose(found[None], ours, rtol=0.025)


def test_metal_is_rendered_again_within_all_bounds(python, tmp_path):
    """By Mitsuba from ``scene.xml`` and by Cycles from ``scene.glb``; without its metal the room would not be."""
    pytest.importorskip("mitsuba")
    scene = object_scene(sky())
    scene = replace(scene, materials=[replace(material, metallic=METAL) for material in scene.materials])
    room = exported(scene, tmp_path / "room", verify=True, spp=64, blender=python)
    found = json.loads((room / "verify.json").read_text())
    assert [bound["verdict"] for bound in found["bounds"]] == ["kept"] * 3
    ratios = {name: shown["ratio_of_means"] for name, shown in found["renderers"].items()}
    assert ratios.keys() == {"baked", "fields", "mitsuba", "cycles"}
    assert ratios["fields"] == pytest.approx(1.0, abs=0.002)
    again = read_xml(room / "scene.xml")
    paint = replace(again, materials=[replace(material, metallic=DIELECTRIC) for material in again.materials])
    metal, plain = (picture(x, scene.test[0].camera, 64).mean() for x in (again, paint))
    assert abs(plain / metal - 1.0) > 0.05


def sky_of_directions():
    """A map whose colours are its directions, turned about all axes."""
    theta, phi = np.linspace(0, np.pi, 32)[:, None], (np.arange(64) + 0.5) * (2 * np.pi / 64)
    sine = np.sin(theta)
    towards = np.stack((sine * np.sin(phi), np.cos(theta) + 0 * phi, -sine * np.cos(phi)), -1)
    turn = np.array([[0, 0, 1, 0], [0.6, 0.8, 0, 0], [-0.8, 0.6, 0, 0], [0, 0, 0, 1]], np.float32)
    return EnvironmentMap((0.6 + 0.5 * towards).astype(np.float32), turn)


@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_an_environment_lies_and_lights_as_it_did(python, tmp_path, up):
    pytest.importorskip("pxr")
    scene = object_scene(sky_of_directions(), size=32)
    view = scene.test[0]
    room = exported(scene, tmp_path / "room", up=up)
    again = read_xml(room / "scene.xml").check()
    ours = picture(again, view.camera, 64)
    job = {"file": str(room / "room.usdc"), "out": str(tmp_path / "usd.exr"), "width": 32, "height": 32}
    (tmp_path / "job.json").write_text(json.dumps({**job, "view": view.name, "samples": 64, "points": []}))
    subprocess.run([python, str(IMPORT), str(tmp_path / "job.json")], check=True, capture_output=True)
    pictures = {
        "scene.glb": render_views(find_blender(python), room, [view], 64, 1)[0],
        "room.usdc": read_exr(tmp_path / "usd.exr")[..., :3],
    }
    assert np.ptp(ours, (0, 1)).min() > 0.2  # a map that is turned otherwise would show
    for name, theirs in pictures.items():
        assert np.abs(theirs - ours).mean() < 0.02, name
        assert theirs.mean() == pytest.approx(ours.mean(), rel=0.02), name
