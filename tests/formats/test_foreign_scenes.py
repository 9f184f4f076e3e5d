"""What scene files of other programs use beyond plain meshes: instances, units, lights, several faults at once."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.gltf_writer import FACES, QUAD, Document

from neurad.core.errors import InputError
from neurad.formats.cameras.nerf import read_views
from neurad.formats.gltf.read import read_gltf
from neurad.formats.load import load_scene
from neurad.formats.meshes.files import read_meshes
from neurad.formats.mitsuba.read import read_xml

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
ASSIMP = Path(os.environ.get("NEURAD_ASSIMP", "/usr/share/assimp/models"))
"""Where Debian's assimp-testmodels puts its files, or where they lie instead."""
TURNED = [0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)]
"""The quaternion (x, y, z, w) of a quarter turn around +Y."""

SPHERE = """#usda 1.0
(
{head}
)
{body}
"""
FIVE = """def Mesh "five" {{
    int[] faceVertexCounts = [5]
    int[] faceVertexIndices = [0, 1, 2, 3, 4]
    point3f[] points = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (2, 1, 0), (0, 4, 0)]
    {more}
}}
"""


def area(mesh):
    return trimesh.triangles.area(np.asarray(mesh.vertices, np.float64)[mesh.faces]).sum()


def instanced(required=False, as_bytes=False, **attributes):
    """A square that a node shows several times, two metres to the right of the origin."""
    document = Document()
    mesh = document.mesh({"POSITION": document.accessor(QUAD)}, document.accessor(FACES.ravel(), "u2"))
    document.use("EXT_mesh_gpu_instancing", required=required)
    values = {key: document.accessor(value) for key, value in attributes.items()}
    if as_bytes:
        turned = np.round(np.array(attributes["ROTATION"]) * 127)
        values["ROTATION"] = document.accessor(turned, "i1", normalized=True)
    document.node(
        mesh=mesh, name="tile", translation=[2, 0, 0], extensions={"EXT_mesh_gpu_instancing": {"attributes": values}}
    )
    return document


@pytest.mark.parametrize("required", [False, True])
def test_instances_stand_where_they_are_told(tmp_path, required):
    places = [[0, 0, 0], [0, 5, 0], [0, 0, 7]]
    document = instanced(required, TRANSLATION=places, ROTATION=[[0, 0, 0, 1], TURNED, [0, 0, 0, 1]],
                         SCALE=[[1, 1, 1], [1, 1, 3], [2, 1, 1]])  # fmt: skip
    room = read_gltf(document.glb(tmp_path / "a.glb"))
    assert len(room.meshes) == 3
    assert len({mesh.name for mesh in room.meshes}) == 3
    assert [area(mesh) for mesh in room.meshes] == pytest.approx([4.0, 12.0, 8.0])
    for mesh, place in zip(room.meshes, places, strict=True):
        np.testing.assert_allclose(np.mean(mesh.vertices, 0), np.add(place, [2, 0, 0]), atol=1e-6)
    extent = np.ptp(room.meshes[1].vertices, axis=0)
    np.testing.assert_allclose(extent, [6.0, 0.0, 2.0], atol=1e-6)  # scaled along z, then turned to x


def test_turns_of_instances_may_be_bytes_and_a_bomb_is_refused_by_its_count(tmp_path):
    room = read_gltf(instanced(as_bytes=True, ROTATION=[TURNED], SCALE=[[1, 1, 3]]).glb(tmp_path / "a.glb"))
    np.testing.assert_allclose(np.ptp(room.meshes[0].vertices, axis=0), [6.0, 0.0, 2.0], atol=0.05)

    document = instanced(TRANSLATION=[[0, 0, 0]])
    document.json["accessors"][-1] |= {"count": 1 << 26}
    with pytest.raises(InputError, match=r"134217728 triangles with all copies"):
        read_gltf(document.glb(tmp_path / "a.glb"))


@pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not there")
def test_the_instances_of_the_exporters_own_test():
    room = read_gltf(CASES / "24_gpu_instancing" / "24_gpu_instancing.gltf")
    assert sum(mesh.name != "plane" for mesh in room.meshes) == 1899


def test_an_extension_that_is_used_and_not_read_is_named(tmp_path):
    document = Document()
    document.quad()
    document.use("KHR_animation_pointer_of_mine", "KHR_materials_emissive_strength")
    (note,) = read_gltf(document.glb(tmp_path / "a.glb")).notes
    assert "KHR_animation_pointer_of_mine" in note
    assert "emissive_strength" not in note


def test_a_camera_without_perspective_is_left_out_and_said(tmp_path):
    document = Document()
    document.quad()
    flat = {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "znear": 0.1, "zfar": 9}}
    good = {"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1}}
    document.node(name="plan", camera=document.add("cameras", flat))
    document.node(name="eye", camera=document.add("cameras", good))
    room = read_gltf(document.glb(tmp_path / "a.glb"))
    assert [camera.names for camera in room.cameras] == [("eye",)]
    assert any("orthographic cameras are left out: plan" in note for note in room.notes)


@pytest.mark.parametrize("kind", ["glTF", "glTF2"])
def test_files_that_assimp_is_tested_with(kind):
    """Each is read, or refused in one sentence that names the file."""
    files = [file for ending in ("gltf", "glb") for file in sorted((ASSIMP / kind).rglob(f"*.{ending}"))]
    if not files:
        pytest.skip("Debian's assimp-testmodels is not installed")
    read = 0
    for file in files:
        said = None
        try:
            room = read_gltf(file)
            read += 1
            assert all(np.isfinite(mesh.vertices).all() for mesh in room.meshes)
        except InputError as error:
            said = str(error)
        if said is not None:
            assert file.stem.split("_")[0] in said  # also where a file beside it is missing
            assert "\n" not in said
    assert (read > 0) == (kind == "glTF2")


# ---- USD


def usd(tmp_path, body, head='    upAxis = "Y"', name="a.usda"):
    pytest.importorskip("pxr")
    path = tmp_path / name
    path.write_text(SPHERE.format(head=head, body=body))
    return path


def test_a_concave_polygon_of_usd_keeps_its_area_and_is_told_to_be_smooth_by_default(tmp_path):
    read = read_meshes(usd(tmp_path, FIVE.format(more="")))
    assert area(read.meshes[0]) == pytest.approx(10.0)  # 16 less the notch of 6
    assert any("no subdivisionScheme" in note for note in read.notes)
    plain = read_meshes(usd(tmp_path, FIVE.format(more='uniform token subdivisionScheme = "none"'), name="b.usda"))
    assert not any("subdivisionScheme" in note for note in plain.notes)


def test_lengths_of_usd_are_metres(tmp_path):
    read = read_meshes(usd(tmp_path, FIVE.format(more=""), '    metersPerUnit = 0.01\n    upAxis = "Z"'))
    assert area(read.meshes[0]) == pytest.approx(10.0e-4)
    assert read.up == "z"
    assert any("its unit is 0.01 m" in note for note in read.notes)
    unsaid = read_meshes(usd(tmp_path, FIVE.format(more=""), name="b.usda"))
    assert area(unsaid.meshes[0]) == pytest.approx(10.0)
    assert any("has no metersPerUnit" in note for note in unsaid.notes)


@pytest.mark.parametrize("normalize", [False, True])
def test_a_rect_light_has_the_radiance_of_the_specification(tmp_path, normalize):
    body = f"""def RectLight "lamp" {{
    float inputs:width = 2
    float inputs:height = 3
    float inputs:intensity = 5
    float inputs:exposure = 1
    color3f inputs:color = (1, 0.5, 0.25)
    bool inputs:normalize = {int(normalize)}
    double3 xformOp:translate = (0, 4, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""
    read = read_meshes(usd(tmp_path, FIVE.format(more="") + body))
    (lamp,) = [mesh for mesh in read.meshes if mesh.radiance is not None]
    assert area(lamp) == pytest.approx(6.0, rel=1e-6)
    np.testing.assert_allclose(lamp.radiance, np.array([10.0, 5.0, 2.5]) / (6.0 if normalize else 1.0), rtol=1e-6)
    a, b, c = np.asarray(lamp.vertices, np.float64)[lamp.faces[0]]
    assert np.cross(b - a, c - a)[2] < 0  # it shines along -Z
    np.testing.assert_allclose(np.mean(lamp.vertices, 0), [0, 4, 0], atol=1e-6)


def test_a_lamp_on_a_subset_of_a_mesh_shines_alone(tmp_path):
    body = """def Mesh "panel" {
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (3, 0, 0), (0, 1, 0), (1, 1, 0), (3, 1, 0)]
    uniform token subdivisionScheme = "none"
    def GeomSubset "glowing" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token elementType = "face"
        int[] indices = [1]
        rel material:binding = </glow>
    }
}
def Material "glow" {
    token outputs:surface.connect = </glow/shader.outputs:surface>
    def Shader "shader" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:emissiveColor = (3, 2, 1)
        token outputs:surface
    }
}
"""
    read = read_meshes(usd(tmp_path, body))
    shining = [mesh for mesh in read.meshes if mesh.radiance is not None]
    dark = [mesh for mesh in read.meshes if mesh.radiance is None]
    assert [area(mesh) for mesh in shining] == pytest.approx([2.0])
    assert [area(mesh) for mesh in dark] == pytest.approx([1.0])
    np.testing.assert_allclose(shining[0].radiance, [3.0, 2.0, 1.0])


def test_a_package_of_usd_is_read(tmp_path):
    pytest.importorskip("pxr")
    from pxr import UsdUtils

    source = usd(tmp_path, FIVE.format(more=""))
    assert UsdUtils.CreateNewUsdzPackage(str(source), str(tmp_path / "room.usdz"))
    assert area(read_meshes(tmp_path / "room.usdz").meshes[0]) == pytest.approx(10.0)


# ---- Mitsuba


def scene(tmp_path, body):
    pytest.importorskip("mitsuba")
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{body}</scene>')
    return path


SHAPE = '<shape type="obj" id="{0}"><string name="filename" value="{0}.obj"/><emitter type="area"/></shape>'


def test_a_path_is_another_place_for_files(tmp_path):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "a.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 2 0\nf 1 2 3\n")
    (mesh,) = read_xml(scene(tmp_path, '<path value="models"/>' + SHAPE.format("a"))).meshes
    assert area(mesh) == pytest.approx(2.0)
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")  # beside the scene goes first
    (mesh,) = read_xml(tmp_path / "scene.xml").meshes
    assert area(mesh) == pytest.approx(0.5)


# ---- what cannot be read gets a sentence that says what to do


@pytest.mark.parametrize(
    ("ending", "said"), [(".arw", "merge it with `neurad data hdr`"), (".webp", "save it in one of these formats")]
)
def test_photographs_of_other_formats(tmp_path, ending, said):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / f"000{ending}").write_bytes(b"x")
    cameras = tmp_path / "transforms_train.json"
    frame = {"file_path": f"images/000{ending}", "transform_matrix": []}
    cameras.write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}))
    with pytest.raises(InputError, match=rf"000\{ending}: .*none of \.exr, \.hdr.*{said}"):
        read_views(cameras, tmp_path)


def test_a_scene_of_another_program(tmp_path):
    sentences = {
        "room.glb": "`neurad data gltf room.glb --out DIR` makes",
        "room.blend": "`neurad data blender room.blend --out DIR` makes",
    }
    for name, sentence in sentences.items():
        folder = tmp_path / name[5:]
        folder.mkdir()
        file = folder / name
        file.write_bytes(b"x")
        with pytest.raises(InputError, match=rf"{name}: .*{sentence}"):
            load_scene(str(file), None)
        with pytest.raises(InputError, match=rf"scene\.xml: the scene folder lacks this file .*; {name}: .*{sentence}"):
            load_scene(str(folder), None)
    with pytest.raises(InputError, match=r"room\.blend: it is no mesh that can be read; export it as one of \.obj"):
        read_meshes(file)
