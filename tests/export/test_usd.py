"""``room.usdc`` as usd-core reads it; Blender reads it in test_blender.py."""

import json

import numpy as np
import pytest
import torch
from helpers.delta_scenes import delta_gallery
from helpers.exported import assembled, exported
from helpers.object_scene import object_scene, sky
from helpers.small_files import small_files
from PIL import Image

from neurad.core.camera import project, to_camera
from neurad.core.errors import InputError
from neurad.core.reflection import DielectricModel, DiffuseModel
from neurad.export import run
from neurad.export.baking import bake_room
from neurad.formats.load import load_scene
from neurad.runtime.progress import Phase
from neurad.scene.builtin import build_cornell

pytest.importorskip("pxr")
pytest.importorskip("xatlas")

from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade, UsdValidation

from neurad.export import usd


def opened(folder):
    return Usd.Stage.Open(str(folder / usd.FILE))


def prims(stage, kind):
    return [kind(prim) for prim in stage.Traverse() if prim.IsA(kind)]


def surface_of(mesh):
    """The inputs of a mesh's surface by name: a value, or the file and the colour space of its texture."""
    material = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0]
    assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
    found = {}
    for name in (i.GetBaseName() for i in shader.GetInputs()):
        source = shader.GetInput(name).GetConnectedSources()[0]
        if source:
            texture = UsdShade.Shader(source[0].source.GetPrim())
            file = texture.GetInput("file").Get().resolvedPath
            found[name] = file, texture.GetInput("sourceColorSpace").Get(), source[0].sourceName
        else:
            found[name] = shader.GetInput(name).Get()
    return found


def test_the_kitchen_is_read_as_it_was_written(kitchen, kitchen_room):
    stage = opened(kitchen_room)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/room"
    meshes = prims(stage, UsdGeom.Mesh)
    assert len(meshes) == len(kitchen.meshes)
    again = load_scene(str(kitchen_room), None)
    described = json.loads((kitchen_room / "room.json").read_text())["meshes"]
    for prim, mesh, written, notes in zip(meshes, kitchen.meshes, again.meshes, described, strict=True):
        points = np.array(prim.GetPointsAttr().Get(), np.float32)
        corners = points[np.array(prim.GetFaceVertexIndicesAttr().Get())].reshape(-1, 3, 3)
        assert np.array_equal(corners.view(np.uint32), mesh.vertices[mesh.faces].view(np.uint32)), mesh.name
        assert prim.GetDoubleSidedAttr().Get() == kitchen.materials[mesh.material].two_sided
        st = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get())
        assert np.allclose(st, written.uvs * [1, -1] + [0, 1], atol=1e-6)
        surface = surface_of(prim)
        for key, space, channel in (("diffuseColor", "sRGB", "rgb"), ("roughness", "raw", "g")):
            file, found_space, found_channel = surface[key]
            assert (found_space, found_channel) == (space, channel)
            assert list(Image.open(file).size) == [notes["texture"][side] for side in ("width", "height")]
        radiance = np.zeros(3) if mesh.radiance is None else mesh.radiance
        assert np.array_equal(surface.get("emissiveColor", np.zeros(3)), radiance)


def test_its_validators_find_nothing(kitchen_room):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    found = UsdValidation.ValidationContext(validators).Validate(opened(kitchen_room))
    assert [error.GetMessage() for error in found] == []


def test_cameras_see_points_where_ours_do(kitchen, kitchen_room):
    points = np.random.default_rng(0).uniform(*kitchen.bounds, (200, 3))
    stage = opened(kitchen_room)  # its prims live as long as it does
    cameras = prims(stage, UsdGeom.Camera)
    views = (*kitchen.train, *kitchen.test)
    assert [camera.GetPrim().GetDisplayName() for camera in cameras] == [view.name for view in views]
    for prim, view in zip(cameras, views, strict=True):
        frustum = prim.GetCamera(Usd.TimeCode.Default()).frustum
        seen = np.array([frustum.ComputeViewMatrix().Transform(Gf.Vec3d(*p)) for p in points.tolist()])
        before = seen[:, 2] < 0
        ndc = np.array([frustum.ComputeProjectionMatrix().Transform(Gf.Vec3d(*p)) for p in seen[before].tolist()])
        film = (ndc[:, :2] * (0.5, -0.5) + 0.5) * (view.camera.width, view.camera.height)
        ours = project(view.camera, to_camera(view.camera, torch.from_numpy(points)))[before].numpy()
        assert np.abs(film - ours).max() < 1e-5 * np.abs(ours).max()


@pytest.mark.parametrize(("up", "axis"), [("y", "Y"), ("z", "Z"), ("-z", "Y"), ("x", "Y")])
def test_up_is_up(tmp_path, up, axis):
    room = exported(build_cornell(), tmp_path / "room", up=up)
    stage = opened(room)
    assert UsdGeom.GetStageUpAxis(stage) == axis
    to_world = UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(0)
    ours = np.zeros(3)
    ours["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    assert np.allclose(to_world.TransformDir(Gf.Vec3d(*ours)), [0, axis == "Y", axis == "Z"])


def test_an_environment_is_a_dome_turned_as_it_was(tmp_path):
    turn = np.eye(4, dtype=np.float32)
    turn[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    environment = sky()
    environment = type(environment)(environment.pixels, turn)
    room = exported(object_scene(environment), tmp_path / "room")
    stage = opened(room)
    (dome,) = prims(stage, UsdLux.DomeLight)
    assert dome.GetTextureFileAttr().Get().resolvedPath == str(room / "environment.exr")
    found = np.array(UsdGeom.Xformable(dome).ComputeLocalToWorldTransform(0)).T
    assert np.allclose(found, turn)


def test_mirrors_glass_and_lambertian_surfaces(tmp_path):
    room = exported(delta_gallery(), tmp_path / "room")
    stage, scene = opened(room), delta_gallery()
    for prim, mesh in zip(prims(stage, UsdGeom.Mesh), scene.meshes, strict=True):
        surface, model = surface_of(prim), scene.materials[mesh.material].model
        if isinstance(model, DiffuseModel):
            assert tuple(surface["specularColor"]) == (0, 0, 0)
            assert surface["useSpecularWorkflow"] == 1
        elif isinstance(model, DielectricModel):
            assert (surface["opacity"], surface["ior"]) == (0.0, pytest.approx(1.5))
        else:
            assert (surface["metallic"], surface["roughness"]) == (1.0, 0.0)
            assert np.allclose(surface["diffuseColor"], scene.materials[mesh.material].albedo.value)


def test_without_the_package_the_rest_is_written_and_it_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "find_spec", lambda name: None)
    room = exported(build_cornell(), tmp_path / "room")
    assert not (room / usd.FILE).exists()
    assert (room / "scene.glb").is_file()
    assert "left out: room.usdc: the package usd-core is missing" in capsys.readouterr().out


def test_a_full_disk_gets_a_sentence(tmp_path):
    room = bake_room(assembled(build_cornell()), 1 << 16, 16, None, Phase("export"))
    with small_files(2000), pytest.raises(InputError, match=r"room.usdc: usd-core cannot write it; is its disk full"):
        usd.write_usd(room, tmp_path, "exact")
