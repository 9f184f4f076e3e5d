"""``neurad data blender``: scene folders of Blender files, with programs that pass for Blender."""

import copy
import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.blender_dump import CAMERA, GREY, lamp, moved, room, square, write_blender, write_dump
from helpers.tiny_fit import fails
from PIL import Image

from neurad.cli import main
from neurad.core.reflection import ConductorModel, DielectricModel, PrincipledModel
from neurad.formats.load import read_folder
from neurad.images.image_io import read_exr, write_exr

pytest.importorskip("mitsuba")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with a Blender file, a program that passes for Blender and reads it, and a photograph."""
    here = tmp_path / "Räume 1"
    here.mkdir()
    monkeypatch.chdir(here)
    write_dump("dump")
    Path("raum.blend").write_bytes(b"BLENDER-v405RENDH" + bytes(64))
    write_blender("blender", "dump")
    Path("fotos").mkdir()
    write_exr("fotos/Camera.exr", np.full((9, 12, 3), 0.25, np.float32))
    return here


def describe(**other):
    """Change what the Blender file has."""
    write_dump("dump", room(**other))


def convert(*words, source="raum.blend"):
    """Make the folder ``room`` and read it as ``render`` does."""
    blender = ["--blender", str(Path("blender").resolve())] if source == "raum.blend" else []
    main(["data", "blender", source, "--out", "room", *blender, *words])
    return read_folder("room", hold_out=0)


def power(mesh):
    """What a mesh that shines sends in all [3]."""
    return math.pi * trimesh.triangles.area(mesh.vertices[mesh.faces].astype(np.float64)).sum() * mesh.radiance


def across(mesh):
    """Normals of the triangles by their winding [f, 3]."""
    p = mesh.vertices[mesh.faces].astype(np.float64)
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def test_a_room_with_photographs(place, capsys):
    describe(lamps=[lamp(size=0.5, size_y=0.2)])
    scene = convert("--images", "fotos")
    assert [mesh.name for mesh in scene.meshes] == ["floor", "Area"]
    floor, area = scene.meshes
    assert np.allclose(np.ptp(floor.vertices, 0), (2, 2, 0))
    assert floor.normals is None
    assert np.allclose(power(area), (60, 50, 40), rtol=1e-5)
    assert (across(area)[:, 2] < 0).all()
    material = scene.materials[floor.material]
    assert material.model == PrincipledModel(diffuse="lambert")  # as Cycles has it, which took the photographs
    assert np.allclose(material.albedo.value, (0.4, 0.3, 0.2))
    assert float(material.roughness.value[0]) == pytest.approx(0.6)
    (view,) = scene.train
    assert Path(view.image).resolve() == (place / "fotos/Camera.exr").resolve()
    assert view.camera.fov_x == pytest.approx(2 * math.atan(0.5), rel=1e-6)
    mask = np.asarray(Image.open(view.mask))
    # the lamp, 0.5 x 0.2 at a distance of 1, before a film of 12 x 9 pixels whose focal length is 12
    assert mask.shape == (9, 12)
    assert (mask[3:6, 3:9] == 0).all()
    assert (mask[[0, -1]] == 255).all()
    assert (mask[:, [0, -1]] == 255).all()
    said = capsys.readouterr()
    assert "cameras do not see the lamps Area" in said.out
    assert said.err == ""
    assert sorted(file.name for file in Path("room").iterdir()) == [
        "images", "masks", "meshes", "scene.xml", "transforms.json",
    ]  # fmt: skip


def test_blender_itself_and_the_one_on_the_path(place, monkeypatch):
    write_blender("blender", "dump", python=False)
    monkeypatch.setenv("PATH", str(place), prepend=":")
    main(["data", "blender", "raum.blend", "--out", "room"])
    assert len(read_folder("room").meshes) == 2


def test_a_folder_that_blender_wrote_elsewhere_without_photographs(place, capsys):
    scene = convert(source="dump")
    assert scene.train == []
    assert [(view.name, view.image) for view in scene.test] == [("Camera", None)]
    assert "neurad render --root" in capsys.readouterr().out
    main(["render", "--root", "room", "--out", "seen", "--spp", "4", "--map-spp", "1"])
    seen = read_exr("seen/images/Camera.exr")
    assert seen.shape == (9, 12, 3)
    assert (seen > 0).any()


def test_instances_mirrors_and_materials(place):
    mirrored = np.diag([-1.0, 1.0, 2.0, 1.0])
    two = square("both", mesh="two.npz", materials=[0, 1], to_world=moved(0, 0, 1))
    describe(objects=[square("a"), square("a", to_world=moved(3, 0, 0, mirrored)), two],
             materials=[GREY, {**GREY, "name": "red", "color": [0.9, 0.1, 0.1]}])  # fmt: skip
    with np.load("dump/square.npz") as found:
        np.savez("dump/two.npz", **{**found, "material": np.array([0, 1], np.int32)})
    scene = convert()
    assert [mesh.name for mesh in scene.meshes[:-1]] == ["a", "a-2", "both_grey", "both_red"]
    assert all((across(mesh)[:, 2] > 0).all() for mesh in scene.meshes[:2])
    assert [len(mesh.faces) for mesh in scene.meshes[2:4]] == [1, 1]
    assert np.allclose(scene.materials[scene.meshes[3].material].albedo.value, (0.9, 0.1, 0.1))


def test_corners_of_one_normal_are_one_vertex(place):
    normals = np.zeros((2, 3, 3), np.float32)
    normals[..., 2] = 1.0
    normals[1, 0] = (0.6, 0.0, 0.8)
    describe(objects=[square(flat=False, uvs={})])
    write_dump("dump", json.loads(Path("dump/blender.json").read_text()), normals=normals)
    floor = convert().meshes[0]
    assert len(floor.vertices) == 5  # the first corner twice
    assert np.allclose(sorted(floor.normals[:, 2]), [0.8, 1, 1, 1, 1])


def test_lamps_of_all_kinds(place, capsys):
    turned = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]  # -Z becomes -Y
    describe(lamps=[
        lamp(name="disk", shape="DISK", size=0.6, to_world=moved(0, 0, 2, np.diag([2.0, 1.0, 1.0, 1.0]))),
        lamp(name="bare", normalize=False, watts=[3.0, 3.0, 3.0], to_world=moved(0, 0, 4)),
        lamp("POINT", name="bulb", shadow_soft_size=0.1, to_world=moved(5, 0, 2)),
        lamp("POINT", name="point", to_world=moved(1, 2, 3)),
        lamp("SPOT", name="spot", to_world=moved(1, 2, 3, turned)),
        lamp("SUN", name="sun", watts=[3.0, 2.0, 1.0], to_world=moved(0, 0, 9, turned), angle=0.3),
        lamp("AREA", name="dark", watts=[0.0, 0.0, 0.0]),
    ])  # fmt: skip
    scene = convert()
    lamps = {mesh.name: mesh for mesh in scene.meshes}
    assert list(lamps) == ["floor", "disk", "bare", "bulb"]
    assert np.allclose(power(lamps["disk"]), (60, 50, 40), rtol=1e-5)
    assert np.allclose(np.ptp(lamps["disk"].vertices, 0)[:2], (1.2, 0.6), rtol=2e-3)
    assert np.allclose(lamps["bare"].radiance, 3 / math.pi, rtol=1e-5)
    assert np.allclose(power(lamps["bulb"]), (60, 50, 40), rtol=1e-5)
    outwards = lamps["bulb"].vertices[lamps["bulb"].faces].mean(1) - (5, 0, 2)
    assert (np.einsum("fx,fx->f", outwards, across(lamps["bulb"])) > 0).all()
    point, spot, sun = scene.punctual
    assert np.allclose(point.intensity, np.array([60, 50, 40]) / (4 * math.pi), rtol=1e-5)
    assert np.allclose(point.position, (1, 2, 3))
    assert np.allclose(spot.direction, (0, -1, 0), atol=1e-6)
    assert spot.cutoff_angle == pytest.approx(math.degrees(0.6), rel=1e-5)
    assert np.allclose(sun.intensity, (3, 2, 1))
    assert np.allclose(sun.direction, (0, -1, 0), atol=1e-6)
    assert "sun is 17.2 degrees wide" in capsys.readouterr().err


UNDER_A_PANE = [square(), square("pane", materials=[1], to_world=moved(0, 0, 2))]


def test_surfaces_that_shine(place, capsys):
    glow = {"name": "glow", "shader": "EMISSION", "emission": [1.0, 0.5, 0.25], "strength": 8.0}
    describe(objects=UNDER_A_PANE, materials=[GREY, glow], lamps=[])
    scene = convert()
    front, back = scene.meshes[1:]
    assert np.allclose(front.radiance, (8, 4, 2))
    assert np.allclose(back.radiance, (8, 4, 2))
    assert (across(front)[:, 2] * across(back)[:, 2] < 0).all()
    assert "shines from both sides" in capsys.readouterr().err


def test_a_picture_that_shines(place):
    np.save("dump/image.npy", np.array([[[0, 0, 0], [255, 255, 255]]], np.uint8).repeat(2, 0))
    picture = {"file": "image.npy", "coded": True, "channel": None, "uv": "", "to_uv": np.eye(3).tolist()}
    glow = {"name": "glow", "shader": "EMISSION", "emission": picture, "strength": 4.0}
    describe(objects=UNDER_A_PANE, materials=[GREY, glow], lamps=[])
    lit = [mesh for mesh in convert().meshes if mesh.radiance is not None and (across(mesh)[:, 2] > 0).all()]
    assert len(lit) > 2
    assert sum(power(mesh) for mesh in lit) == pytest.approx(np.full(3, math.pi * 4 * 2), rel=0.02)  # half of 4 x 4


def test_textures(place, capfd):
    coded = np.zeros((2, 3, 3), np.uint8)
    coded[0, 0] = (188, 255, 0)  # the lowest row of the picture, at v = 0
    np.save("dump/colour.npy", coded)
    np.save("dump/rough.npy", np.full((1, 1, 3), (0, 128, 0), np.uint8))
    place = {"uv": "Map", "to_uv": [[2, 0, 0.5], [0, 2, 0], [0, 0, 1]]}
    paint = {**GREY, "color": {"file": "colour.npy", "coded": True, "channel": None, **place},
             "roughness": {"file": "rough.npy", "coded": False, "channel": 1, **place}}  # fmt: skip
    describe(materials=[paint])
    scene = convert()
    material = scene.materials[scene.meshes[0].material]
    assert np.allclose(material.albedo.pixels[0, 0], (0.503, 1, 0), atol=2e-3)
    assert np.allclose(material.albedo.pixels[1], 0)
    assert np.allclose(material.albedo.to_uv, place["to_uv"])
    assert np.allclose(material.roughness.pixels if hasattr(material.roughness, "pixels") else material.roughness.value,
                       128 / 255, atol=1e-3)  # fmt: skip
    describe(materials=[{**paint, "color": {**paint["color"], "channel": 7}}])
    assert "its picture has no channel 7" in fails(capfd, "data", "blender", "dump", "--out", "other")


@pytest.mark.parametrize(
    ("paint", "model", "note"),
    [
        ({"shader": "BSDF_DIFFUSE"}, "diffuse", ""),
        (
            {"shader": "BSDF_GLASS", "color": [1.0] * 3, "roughness": 0.0, "ior": 1.375},
            DielectricModel(1.375),
            "glass of a single sheet",
        ),
        ({"transmission": 1.0, "color": [1.0] * 3, "roughness": 0.0}, DielectricModel(1.5), "glass of a single sheet"),
        ({"metallic": 1.0, "roughness": 0.0}, ConductorModel(), ""),
        ({"shader": "BSDF_GLOSSY", "roughness": 0.0}, ConductorModel(), ""),
        ({"ior": 1.45}, "principled, eta 1.45", ""),
        ({"specular": 0.0}, "diffuse", ""),
        ({"metallic": 0.5}, "principled", ""),
        ({"coat": 1.0}, "principled", "a coat"),
        ({"color": {"unread": "it comes from the node Noise Texture"}}, "principled", "Noise Texture"),
        ({"shader": "Mix Shader"}, "principled", "Mix Shader"),
    ],
)
def test_models(place, capsys, paint, model, note):
    describe(materials=[GREY, {**GREY, "name": "paint", **paint}], objects=[square(), square("x", materials=[1])])
    scene = convert()
    found = scene.materials[scene.meshes[1].material].model
    assert (found.label if isinstance(model, str) else found) == model
    said = capsys.readouterr().err
    about = "(x)" if "glass" in note else "material paint"
    assert (note in said and about in said) if note else said == ""


def test_what_cannot_be_rendered_is_named(place, capsys):
    describe(
        left_out={"hair": ["Kopf", "Kopf"], "a volume": ["Rauch"]}, notes=["the world has a volume, which is left out"],
        objects=[square(), square("Wand", unseen_by=["camera"]), square("x", materials=[1])],
        materials=[GREY, {"name": "fog", "shader": "NONE", "volume": True}],
        cycles={"diffuse_bounces": 4, "max_bounces": 12, "sample_clamp_indirect": 10.0},
        cameras=[CAMERA, {**CAMERA, "names": ["Karte"], "type": "ORTHO"}],
    )  # fmt: skip
    convert()
    said = capsys.readouterr().err
    for part in ("Kopf: hair cannot", "Rauch: a volume cannot", "the world has a volume", "Wand is special",
                 "object x is a volume alone", "after 4 diffuse bounces", "clamps light", "Karte (ORTHO)"):  # fmt: skip
        assert part in said, part


@pytest.mark.parametrize(
    ("caustics", "unseen_by", "material", "named"),
    [(True, "shadow", 0, True), (False, "shadow", 0, False), (True, "camera", 0, False), (True, "shadow", 1, False)],
)
def test_glass_without_a_shadow_is_named_where_caustics_bring_its_light_again(
    place, capsys, caustics, unseen_by, material, named
):
    glass = {**GREY, "shader": "BSDF_GLASS", "color": [1.0] * 3, "roughness": 0.0, "ior": 1.375}
    things = [square(materials=[1]), square("pane", unseen_by=[unseen_by], materials=[material])]
    describe(objects=things, materials=[glass, GREY], cycles={"caustics_refractive": caustics})
    convert()
    assert ("pane is glass that casts no shadow" in capsys.readouterr().err) == named


def test_photographs_of_frames_names_and_sizes(place, capsys):
    frames = [{**CAMERA, "names": [f"Fahrt_{i:04d}", f"{i:04d}"], "to_world": moved(0.1 * i, 0, 3)} for i in (1, 2, 3)]
    others = [{**CAMERA, "names": [name]} for name in ("Camera", "Camera.001", "ohne")]
    describe(cameras=[*frames, *others], cycles={"film_exposure": 2.0}, lamps=[lamp("POINT")])
    for name, value in (("0001", 0.1), ("Fahrt_0002", 0.2), ("0003", 0.3), ("Camera.001", 0.4)):
        write_exr(f"fotos/{name}.exr", np.full((18, 24, 3), value, np.float32))
    scene = convert("--images", "fotos", "--copy")
    found = {view.name: float(read_exr(view.image).mean()) for view in scene.train}
    expected = {"Fahrt_0001": 0.1, "Fahrt_0002": 0.2, "Fahrt_0003": 0.3, "Camera": 0.25, "Camera_001": 0.4}
    assert found == pytest.approx(expected, abs=1e-3)
    assert {view.camera.width for view in scene.train} == {12, 24}
    assert {view.development.exposure for view in scene.train} == {2.0}
    assert [view.mask for view in scene.train] == [None] * 5
    assert not Path("room/images/Camera.exr").is_symlink()
    assert "1 cameras have no photograph and are left out (ohne)" in capsys.readouterr().err


def test_worlds(place):
    sky = np.zeros((8, 16, 3), np.float32)
    sky[:, 8:] = (1.0, 2.0, 3.0)
    write_exr("himmel.exr", sky, half=False)
    describe(world={"color": [0.5, 0.25, 0.125]}, lamps=[])
    assert np.allclose(convert().environment.pixels, (0.5, 0.25, 0.125))
    main(["data", "blender", "dump", "--out", "other", "--environment", "himmel.exr"])
    found = read_folder("other").environment
    assert np.allclose(found.pixels[:, 8:], (1, 2, 3))
    # Blender has +X in the middle of such a picture and +Y a quarter left of it
    phi = 2 * math.pi * np.array([8.0, 4.0]) / 16
    towards = np.stack((np.sin(phi), 0 * phi, -np.cos(phi)), -1) @ np.asarray(found.to_world)[:3, :3].T
    assert np.allclose(towards, [[1, 0, 0], [0, 1, 0]], atol=1e-6)


NAN = float("nan")
SHEARED = [[1, 0.3, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
GLOW = {**GREY, "strength": {"unread": "x"}, "emission": [1.0, 1.0, 1.0]}
PICTURE = {"file": "fehlt.npy", "coded": True, "channel": None, "uv": "", "to_uv": np.eye(3).tolist()}
NO_MESH = "square.npz: it is no mesh that write_room.py has written"
BROKEN = {
    "no camera": ({"cameras": []}, "its scene has no camera"),
    "no mesh": ({"objects": []}, "its scene shows no mesh"),
    "no light": ({"lamps": []}, "nothing in its scene shines"),
    "another version": ({"neurad_blender": 2}, "another version of neurad's write_room.py"),
    "no materials": ({"materials": []}, "it is not as write_room.py writes it"),
    "rough glass": ({"materials": [{**GREY, "transmission": 1.0}]}, "material grey lets light through"),
    "part glass": ({"materials": [{**GREY, "transmission": 0.5}]}, "material grey lets light through"),
    "thin": ({"materials": [{**GREY, "alpha": 0.5}]}, "material grey lets light through"),
    "transparent mix": ({"materials": [{"name": "m", "shader": "Mix Shader", "lets_through": True}]}, "lets light"),
    "emitting mix": ({"materials": [{"name": "m", "shader": "Mix Shader", "emits": True}]}, "emits light through"),
    "emission by nodes": ({"materials": [GLOW]}, "emits light by nodes"),
    "NaN in a colour": ({"materials": [{**GREY, "color": [NAN, 0, 0]}]}, "its color is nan"),
    "index of refraction": ({"materials": [{**GREY, "ior": -1.0}]}, "its IOR is -1"),
    "missing picture": ({"materials": [{**GREY, "color": PICTURE}]}, "fehlt.npy: there is no such file"),
    "picture elsewhere": ({"materials": [{**GREY, "color": {**PICTURE, "file": "../x.npy"}}]}, "leads out of"),
    "spread": ({"lamps": [lamp(spread=1.0)]}, "lamp Area has a spread of 57.3 degrees"),
    "lamp's nodes": ({"lamps": [lamp(unread="its nodes are more than an Emission")]}, "its nodes are more"),
    "no shadow": ({"lamps": [lamp(shadow=False)]}, "casts no shadow"),
    "negative lamp": ({"lamps": [lamp(watts=[1.0, -1.0, 1.0])]}, "takes light away"),
    "endless lamp": ({"lamps": [lamp(watts=[1e400] * 3)]}, "its power is inf"),
    "unknown lamp": ({"lamps": [lamp("HEMI")]}, "a lamp of the type 'HEMI'"),
    "flat lamp": ({"lamps": [lamp(size=0.0)]}, "has no extent"),
    "wide spot": ({"lamps": [lamp("SPOT", spot_size=3.1415927)]}, "its cone has 180 degrees"),
    "bare point": ({"lamps": [lamp("POINT", normalize=False)]}, "has Normalize off"),
    "NaN in a pose": ({"objects": [square(to_world=moved(0, NAN, 0))]}, "its to_world: row 2, column 4 is nan"),
    "mesh elsewhere": ({"objects": [square(mesh="../square.npz")]}, "leads out of the folder"),
    "missing mesh": ({"objects": [square(mesh="fehlt.npz")]}, "fehlt.npz: there is no such file"),
    "mirrored camera": ({"cameras": [{**CAMERA, "to_world": np.diag([-1.0, 1, 1, 1]).tolist()}]}, "mirrors it"),
    "sheared camera": ({"cameras": [{**CAMERA, "to_world": SHEARED}]}, "is not rigid"),
    "no lens": ({"cameras": [{**CAMERA, "lens": 0.0}]}, "its lens is 0"),
    "no film": ({"film": [0, 9]}, "its resolution is 0"),
    "unknown fit": ({"cameras": [{**CAMERA, "sensor_fit": "x"}]}, "its sensor_fit is 'x'"),
    "missing world": ({"world": {"file": "world.exr"}}, "world.exr: there is no such file"),
    "world elsewhere": ({"world": {"file": "../world.exr"}}, "leads out of the folder"),
    "negative world": ({"world": {"color": [-1.0, 0, 0]}}, "its world is -1"),
    "an index too large": ({}, NO_MESH, {"faces": np.array([[0, 1, 4], [0, 2, 3]], np.int32)}),
    "another shape": ({}, NO_MESH, {"normals": np.zeros((2, 3), np.float32)}),
    "no triangle": ({}, NO_MESH, {"faces": np.zeros((0, 3), np.int32), "material": np.zeros(0, np.int32),
                                  "uv0": np.zeros((0, 3, 2))}),
    "a mesh of objects": ({}, NO_MESH, {"vertices": np.array([None] * 4)}),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_rooms_that_cannot_be_read(place, capfd, name):
    other, sentence, *arrays = copy.deepcopy(BROKEN[name])
    write_dump("dump", room(**other), **(arrays[0] if arrays else {}))
    words = ["--blender", str(Path("blender").resolve()), "--out", "room"]
    assert sentence in fails(capfd, "data", "blender", "raum.blend", *words)


WORDS = {
    "missing": (["nichts.blend"], "there is no such Blender file"),
    "text": (["text.blend"], "it is no file that Blender has saved"),
    "an empty folder": (["fotos"], "it has 0 Blender files"),
    "no program": (["raum.blend", "--blender", "nirgends"], "neither a Python with the package bpy nor Blender"),
    "none on the path": (["raum.blend"], "there is no blender on the PATH"),
    "an old one": (["raum.blend", "--blender", "./old"], "it has to be 4.2 or newer"),
    "one that fails": (["raum.blend", "--blender", "./fails"], "Blender 4.5.0 cannot read it (Error: bad header)"),
    "Blender for a folder": (["dump", "--blender", "./blender"], "is written already"),
    "out is there": (["raum.blend", "--out", "fotos"], "it is there already"),
    "mesh": (["raum.blend", "--mesh", "a.obj"], "are about meshes beside cameras"),
    "no images": (["dump", "--images", "nichts"], "--images: there is no folder"),
    "no camera's": (["dump", "--images", "leer"], "it has no photograph of any camera, such as Camera.exr"),
    "proportions": (["dump", "--images", "hoch"], "as wide as high, but its photograph Camera.exr has 9 x 12"),
    "no photograph": (["dump", "--images", "kaputt"], "Camera.exr"),
    "no environment": (["dump", "--environment", "nichts.exr"], "there is no such environment map"),
}  # fmt: skip


@pytest.mark.parametrize("name", WORDS)
def test_bad_words(place, capfd, monkeypatch, name):
    words, sentence = WORDS[name]
    Path("text.blend").write_text("kein Blender")
    Path("leer.blend").touch()
    for folder in ("leer", "hoch", "kaputt"):
        Path(folder).mkdir()
    write_exr("hoch/Camera.exr", np.ones((12, 9, 3), np.float32))
    Path("kaputt/Camera.exr").write_text("kein Bild")
    write_blender("old", "dump", version="3.6.5")
    write_blender("fails", None, said="Error: bad header")
    monkeypatch.setattr("neurad.formats.blender.process.shutil.which", lambda name: None)
    out = [] if "--out" in words else ["--out", "room"]
    assert sentence in fails(capfd, "data", "blender", *words, *out)


@pytest.mark.parametrize(("shader", "diffuse"), [("BSDF_DIFFUSE", True), ("BSDF_PRINCIPLED", False)])
def test_lamps_have_the_model_of_their_room(place, shader, diffuse):
    glow = {"name": "glow", "shader": "EMISSION", "emission": [1.0, 1.0, 1.0], "strength": 1.0}
    describe(materials=[{**GREY, "shader": shader}, glow], objects=[square(), square("x", materials=[1])])
    features = convert().features
    assert features.is_diffuse == diffuse
    assert not features.is_mixed
    assert len(features.models) == 1
