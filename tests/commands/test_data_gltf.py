"""``neurad data gltf`` and ``--mesh`` of glTF and USD, and one sentence for all that can be wrong with such files."""

import copy
import json
import math
import re
import struct

import numpy as np
import pytest
from helpers import layouts
from helpers.gltf_writer import QUAD, Document
from helpers.tiny_fit import fails, write_tiny_config

from neurad.cli import main
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr, write_exr

PBR = "pbrMetallicRoughness"
LAMP = {"emissiveFactor": [1, 1, 1], PBR: {"metallicFactor": 0}, "name": "Glühbirne",
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 5}}}  # fmt: skip


def room(cameras=2):
    """A floor, a lamp above it that shines down, and cameras of one size."""
    document = Document()
    document.quad(name="Fußboden", scale=[2, 1, 2], material={PBR: {"metallicFactor": 0.0}})
    document.quad(name="lamp", translation=[0, 3, 0], rotation=[1, 0, 0, 0], material=copy.deepcopy(LAMP))
    for index in range(cameras):
        lens = {"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 12 / 9, "znear": 0.1}}
        document.node(name=f"Blick {index}", camera=document.add("cameras", lens), translation=[0, 1 + index / 2, 4])
    return document


def photographs(folder, cameras=2, size=(9, 12)):
    folder.mkdir()
    for index in range(cameras):
        write_exr(
            folder / f"Blick {index}.exr", np.random.default_rng(index).random((*size, 3), np.float32), half=False
        )
    return folder


@pytest.mark.parametrize("form", ["glb", "gltf", "beside"])
def test_a_room_with_photographs(place, form, capfd):
    source = place / "raum.glb" if form == "glb" else place / "raum.gltf"
    if form == "glb":
        room().glb(source)
    else:
        room().gltf(source, "teile/puffer ä.bin" if form == "beside" else None)
    words = ["data", "gltf", str(source), "--images", str(photographs(place / "fotos"))]
    main([*words, "--out", "room"])
    assert "2 meshes, 4 triangles, 2 cameras" in capfd.readouterr().out
    scene = load_scene("room", None, 0)
    assert [mesh.name for mesh in scene.meshes] == ["Fußboden", "lamp"]
    np.testing.assert_array_equal(scene.meshes[1].radiance, [5, 5, 5])
    np.testing.assert_allclose(scene.bounds, [[-2, 0, -2], [2, 3, 2]], atol=1e-6)
    for index, view in enumerate(scene.train):
        np.testing.assert_array_equal(read_exr(view.image), read_exr(place / f"fotos/Blick {index}.exr"))
        assert (view.camera.width, view.camera.height) == (12, 9)
        assert 2 * math.atan(math.tan(view.camera.fov_x / 2) * 9 / 12) == pytest.approx(0.8)
        np.testing.assert_allclose(view.camera.to_world[:3, 3], [0, 1 + index / 2, 4])
    assert (place / "room" / f"scene{source.suffix}").is_symlink()
    main([*words, "--out", "copied", "--copy"])
    assert not any(path.is_symlink() for path in (place / "copied").rglob("*"))
    assert len(load_scene("copied", None, 0).meshes) == 2


def test_a_rendering_and_a_fit_without_photographs(place, capfd):
    room().glb(place / "raum.glb")
    main(["data", "gltf", "raum.glb", "--out", "room"])
    assert "no --images were given" in capfd.readouterr().out
    main(["render", "--root", "room", "--out", "pictures", "--spp", "4", "--map-spp", "1", "--size", "12"])
    found = sorted((place / "pictures/images").glob("*.exr"))
    assert [path.stem for path in found] == ["Blick 0", "Blick 1"]
    assert read_exr(found[0]).shape == (9, 12, 3)
    assert read_exr(found[0]).max() > 0
    write_tiny_config(base="scene.yaml", data={"patches": 4})
    sentence = fails(capfd, "fit", "--config", "tiny.yaml", "--data.root", "room", "--trainer.max_steps", "2")
    assert "scene room: it has no photograph to learn from" in sentence


def test_an_environment_beside_the_scene(place):
    document = Document()
    document.quad()
    document.glb(place / "raum.glb")
    sky = np.random.default_rng(1).random((5, 8, 3), np.float32)
    write_exr(place / "himmel.exr", sky, half=False)
    main(["data", "gltf", "raum.glb", "--environment", "himmel.exr", "--out", "room"])
    (place / "room/transforms_train.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": [
        {"file_path": "a", "transform_matrix": np.eye(4).tolist()}]}))  # fmt: skip
    write_exr(place / "room/a.exr", sky)
    np.testing.assert_array_equal(load_scene("room", None).environment.pixels, sky)


def test_cameras_without_photographs_are_left_out(place, capfd):
    room(3).glb(place / "raum.glb")
    main(["data", "gltf", "raum.glb", "--images", str(photographs(place / "fotos")), "--out", "room"])
    assert "1 cameras have no photograph and are left out (Blick 2)" in capfd.readouterr().err
    assert len(load_scene("room", None, 0).train) == 2


# ---- meshes for other sources


def test_gltf_as_mesh(place):
    source = layouts.write_nerfstudio(place / "src", layouts.cameras())
    document = room(0)
    glass = {PBR: {"metallicFactor": 0, "roughnessFactor": 0}}
    glass["extensions"] = {"KHR_materials_transmission": {"transmissionFactor": 1}, "KHR_materials_ior": {"ior": 1.4}}
    document.quad(name="pane", translation=[0, 1, 0], material=glass)
    mirror = {PBR: {"roughnessFactor": 0, "baseColorFactor": [0.9, 0.8, 0.7, 1]}}
    document.quad(name="mirror", translation=[0, 2, 0], material=mirror)
    mesh = document.glb(place / "raum.glb")
    main(["data", "nerfstudio", str(source), "--mesh", str(mesh), "--out", "room"])
    scene = load_scene("room", None)
    meshes = {mesh.name: mesh for mesh in scene.meshes}
    np.testing.assert_array_equal(meshes["lamp"].radiance, [5, 5, 5])
    assert scene.materials[meshes["pane"].material].model.eta == pytest.approx(1.4)
    np.testing.assert_allclose(scene.materials[meshes["mirror"].material].albedo.value, [0.9, 0.8, 0.7], atol=1e-6)
    np.testing.assert_allclose(scene.bounds, [[-2, 0, -2], [2, 3, 2]], atol=1e-6)
    lamp = scene.materials[meshes["lamp"].material]
    np.testing.assert_array_equal(lamp.albedo.value, [1, 1, 1])


@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_usd_as_mesh(place, ending):
    pytest.importorskip("pxr")
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

    stage = Usd.Stage.CreateNew(str(place / f"raum.{ending}"))
    group = UsdGeom.Xform.Define(stage, "/group")
    group.AddTranslateOp().Set(Gf.Vec3d(0, 3, 0))
    floor = UsdGeom.Mesh.Define(stage, "/floor")
    lamp = UsdGeom.Mesh.Define(stage, "/group/lamp")
    for prim, points in ((floor, QUAD * 2), (lamp, QUAD)):
        prim.CreatePointsAttr(points.astype(float).tolist())
        prim.CreateFaceVertexCountsAttr([4])
        prim.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        prim.CreateSubdivisionSchemeAttr("none")
    lamp.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)  # so that it shines down
    floor.CreateNormalsAttr([(0, 1, 0)] * 4)
    floor.SetNormalsInterpolation("faceVarying")
    material = UsdShade.Material.Define(stage, "/glow")
    shader = UsdShade.Shader.Define(stage, "/glow/s")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set((3, 2, 1))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(lamp.GetPrim()).Bind(material)
    hidden = UsdGeom.Mesh.Define(stage, "/hidden")
    hidden.CreateVisibilityAttr("invisible")
    stage.GetRootLayer().Save()
    source = layouts.write_nerfstudio(place / "src", layouts.cameras())
    main(["data", "nerfstudio", str(source), "--mesh", f"raum.{ending}", "--out", "room"])
    scene = load_scene("room", None)
    meshes = {mesh.name: mesh for mesh in scene.meshes}
    assert {name: len(mesh.faces) for name, mesh in meshes.items()} == {"floor": 2, "lamp": 2}
    np.testing.assert_array_equal(meshes["lamp"].radiance, [3, 2, 1])
    p = meshes["lamp"].vertices[meshes["lamp"].faces]
    np.testing.assert_allclose(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), [[0, -4, 0]] * 2, atol=1e-6)
    np.testing.assert_allclose(scene.bounds, [[-2, 0, -2], [2, 3, 2]], atol=1e-6)


# ---- what bad input gets


def set_in(document, path, value):
    """Change an entry of the JSON, named like 'meshes.0.primitives.0.mode'."""
    place = document.json
    *parents, last = [int(word) if word.isdigit() else word for word in path.split(".")]
    for word in parents:
        place = place[word]
    place[last] = value


def _nan(document):
    values = QUAD.copy()
    values[2, 1] = math.nan
    set_in(document, "meshes.0.primitives.0.attributes.POSITION", document.accessor(values))


P, M = "meshes.0.primitives.0.", "materials."
TRANSMISSION, DIFFUSE = "KHR_materials_transmission", "KHR_materials_diffuse_transmission"
WRONG = {
    "required Draco": (lambda d: d.use("KHR_draco_mesh_compression", required=True), "compressed by KHR_draco"),
    "required other": (lambda d: d.use("ACME_rooms", required=True), "requires the extension ACME_rooms"),
    "version": (("asset.version", "1.0"), "glTF of version 1.0; only 2.0 is read"),
    "minVersion": (("asset.minVersion", "2.1"), "needs a reader of glTF 2.1"),
    "asset": (("asset", []), r"asset is \[\], not an object"),
    "NaN": (_nan, "the coordinates of mesh Fußboden: 3 of 12 values are not numbers"),
    "index": (("accessors.1.count", 9), "accessor 1 .* more than its buffer view holds"),
    "far index": (lambda d: set_in(d, P + "indices", d.accessor([0, 1, 9], "u1")), "an index names vertex 9, of 4"),
    "float index": (lambda d: set_in(d, P + "indices", d.accessor([0, 1, 2], "f4")), "its indices are not whole"),
    "two corners": (lambda d: set_in(d, P + "indices", d.accessor([0, 1], "u1")), "no whole number of triangles"),
    "mode": ((P + "mode", 9), "has the mode 9"),
    "no position": ((P + "attributes", {}), "has no POSITION"),
    "accessor": ((P + "attributes.POSITION", 99), "names number 99 of accessors, of which there are"),
    "component": (("accessors.0.componentType", 1), "componentType 1, which is not known"),
    "type": (("accessors.0.type", "VEC9"), "has the type .*VEC9"),
    "count": (("accessors.0.count", -1), "count is -1, not a whole number"),
    "huge count": (("accessors.0", {"componentType": 5126, "type": "VEC3", "count": 2**31}), "GB|memory|values"),
    "view end": (("bufferViews.0.byteLength", 10**6), "buffer view 0 ends at byte"),
    "view offset": (("bufferViews.0.byteOffset", 1.5), "byteOffset is 1.5, not a whole number"),
    "buffer": (("bufferViews.0.buffer", 3), "names number 3 of buffers"),
    "singular": (("nodes.0.scale", [1, 0, 1]), "its transform flattens its mesh"),
    "infinite": (("nodes.0.translation", [1e300, 0, 0]), r"translation is 1e\+300"),
    "no rotation": (("nodes.0.rotation", [0, 0, 0, 0]), "its rotation is 0"),
    "rotation of three": (("nodes.0.rotation", [0, 0, 1]), "not 4 numbers"),
    "projection": (("nodes.0.matrix", [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "is a projection"),
    "circle": (("nodes.0.children", [0]), "more than one parent, or is among its own children"),
    "child": (("nodes.0.children", ["a"]), "names number .* of nodes"),
    "scene": (("scene", 4), "names number 4 of scenes"),
    "scenes": (("scenes", {}), "scenes is {}, not a list"),
    "mesh": (("nodes.0.mesh", 7), "names number 7 of meshes"),
    "primitives": (("meshes.0.primitives", [1]), "primitive 0 is not an object"),
    "material": ((P + "material", 12), "names number 12 of materials"),
    "skin": (("nodes.0.skin", 0), "has a skin"),
    "morph": (("meshes.0.weights", [0.5]), "is morphed"),
    "factor": (("materials.0.pbrMetallicRoughness.baseColorFactor", [2, 0, 0, 1]), "baseColorFactor is 2"),
    "roughness": (("materials.0.pbrMetallicRoughness.roughnessFactor", -1), "roughnessFactor is -1"),
    "metalness": (("materials.0.pbrMetallicRoughness.metallicFactor", "1"), "metallicFactor is .*not a number"),
    "texture": (("materials.0.pbrMetallicRoughness.baseColorTexture", {"index": 0}), "of textures, of which there"),
    "strength": ((M + "1.extensions.KHR_materials_emissive_strength.emissiveStrength", 1e30), "emissiveStrength is 1e"),
    "alpha": (("materials.0.alphaMode", "GLASS"), "alphaMode .*GLASS"),
    "rough glass": ((M + "0.extensions", {TRANSMISSION: {"transmissionFactor": 1}}), "is rough glass"),
    "some glass": ((M + "0.extensions", {TRANSMISSION: {"transmissionFactor": 0.5}}), "transmits light in part"),
    "leaf": ((M + "0.extensions", {DIFFUSE: {"diffuseTransmissionFactor": 1}}), "transmits light diffusely"),
    "ior": (("materials.0.extensions", {"KHR_materials_ior": {"ior": 0}}), "its ior is 0"),
    "panorama": (("cameras.0", {"type": "panorama"}), "only perspective cameras"),
    "yfov": (("cameras.0.perspective.yfov", 4.0), "yfov is 4"),
    "bent camera": (("nodes.2.matrix", [1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "bends it"),
    "picture light": (("scenes.0.extensions", {"EXT_lights_image_based": {"light": 0}}), "EXT_lights_image_based"),
    "light": (("nodes.0.extensions", {"KHR_lights_punctual": {"light": 0}}), "names number 0 of lights"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_scenes_get_a_sentence(place, kind, capfd):
    document, (change, said) = room(), WRONG[kind]
    if callable(change):
        change(document)
    else:
        set_in(document, *change)
    document.glb(place / "raum.glb")
    sentence = fails(capfd, "data", "gltf", "raum.glb", "--out", "room")
    assert "raum.glb" in sentence
    assert re.search(said, sentence), sentence


NO_GLB = "raum.glb: it does not begin as a binary glTF file does"
BYTES = {
    "empty": (b"", "not valid JSON"),
    "not UTF-8": (b"\xff\xfe\x00", "neither a binary glTF file nor JSON"),
    "list": (b"[]", "its JSON is no object"),
    "deep": (b'{"asset": ' + b"[" * 200000, "nested too deeply|not valid JSON"),
    "twice": (b'{"asset": {"version": "2.0", "version": "2.0"}}', "has the key 'version' twice"),
    "no mesh": (b'{"asset": {"version": "2.0"}}', "has no triangle"),
    "GLB of text": (b"solid room", NO_GLB),
    "short header": (b"glTF\2", "ends within the header"),
    "version 1": (struct.pack("<4sII", b"glTF", 1, 12), "binary glTF of version 1"),
    "cut off": (struct.pack("<4sII", b"glTF", 2, 500), "ends after 12 of the 500 bytes"),
    "no JSON": (struct.pack("<4sII", b"glTF", 2, 12), "has no JSON"),
    "chunk": (struct.pack("<4sIII4s", b"glTF", 2, 20, 900, b"JSON"), "ends within a chunk"),
    "other chunk": (struct.pack("<4sIII4s", b"glTF", 2, 20, 0, b"BIN\0"), "its first chunk is not JSON"),
}


@pytest.mark.parametrize("kind", BYTES)
def test_files_that_are_none_get_a_sentence(place, kind, capfd):
    data, said = BYTES[kind]
    name = "raum.glb" if data.startswith(b"glTF") or kind.startswith("GLB") else "raum.gltf"
    (place / name).write_bytes(data)
    sentence = fails(capfd, "data", "gltf", name, "--out", "room")
    assert re.search(said, sentence), sentence


URIS = (
    "../puffer.bin", "/etc/passwd", "%2e%2e/puffer.bin", "http://host/a.bin", "C:/a.bin", "..\\a.bin", "fehlt.bin", ".",
    "",
)  # fmt: skip


@pytest.mark.parametrize("uri", URIS)
def test_names_that_leave_the_folder(place, uri, capfd):
    (place / "in").mkdir()
    room().gltf(place / "in/raum.gltf", "a.bin")
    (place / "puffer.bin").write_bytes((place / "in/a.bin").read_bytes())
    described = json.loads((place / "in/raum.gltf").read_text())
    described["buffers"][0]["uri"] = uri
    (place / "in/raum.gltf").write_text(json.dumps(described))
    sentence = fails(capfd, "data", "gltf", "in/raum.gltf", "--out", "room")
    assert ("which is missing" if uri == "fehlt.bin" else "leads out of the folder") in sentence


WORDS = {
    "missing": (["nichts.glb"], "there is no such glTF file"),
    "another kind": (["bild.png"], "it is no glTF file"),
    "an empty folder": (["fotos"], "it has 0 glTF files"),
    "no camera's": (["raum.glb", "--images", "leer"], "it has no photograph of any camera, such as Blick 0.exr"),
    "proportions": (["raum.glb", "--images", "hoch"], "as wide as high, but its photograph Blick 0.exr has 9 x 12"),
    "mesh": (["raum.glb", "--mesh", "raum.glb"], "are about meshes beside cameras"),
    "environment": (["raum.glb", "--environment", "nichts.exr"], "there is no such environment map"),
    "no images": (["raum.glb", "--images", "nichts"], "--images: there is no folder"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WORDS)
def test_wrong_words(place, kind, capfd):
    room().glb(place / "raum.glb")
    (place / "bild.png").write_bytes(b"x")
    (place / "leer").mkdir()
    photographs(place / "fotos")
    photographs(place / "hoch", size=(12, 9))
    words, said = WORDS[kind]
    sentence = fails(capfd, "data", "gltf", *words, "--out", "room")
    assert said in sentence


TRIANGLE = """#usda 1.0
def Mesh "a"
{{
 {more}
 int[] faceVertexCounts = [3]
 int[] faceVertexIndices = [0, 1, {last}]
 point3f[] points = [({x},0,0), (1,0,0), (0,1,0)]
}}
"""
LOOP = 'uniform token subdivisionScheme = "loop"'
USD = {
    "broken": ("#usda 1.0\ndef Mesh", "cannot be read as USD"),
    "empty": ("#usda 1.0\n", "has no triangle"),
    "sphere": ('#usda 1.0\ndef Sphere "ball" {}\n', "/ball is a Sphere; only meshes are read"),
    "subdivided": (TRIANGLE.format(more=LOOP, last=2, x=0), "is a surface of loop subdivision"),
    "indices": (TRIANGLE.format(more="", last=9, x=0), "name vertices that there are not"),
    "NaN": (TRIANGLE.format(more="", last=2, x="nan"), "its points: 1 of 9 values are not numbers"),
}


@pytest.mark.parametrize("name", USD)
def test_usd_that_cannot_be_read(place, name, capfd):
    pytest.importorskip("pxr")
    source = layouts.write_nerfstudio(place / "src", layouts.cameras(count=2))
    text, said = USD[name]
    (place / f"{name}.usda").write_text(text)
    assert said in fails(capfd, "data", "nerfstudio", source, "--mesh", f"{name}.usda", "--out", "room")
