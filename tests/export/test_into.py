"""``neurad export --into``: what was recovered on the objects of the file that its room came from."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.blender_dump import lamp, moved
from helpers.clients import blender_python, cache_folder
from helpers.exported import GREY, assembled, exported
from helpers.flash_room import flash
from helpers.gltf_writer import FACES, QUAD, UVS, Document
from PIL import Image

from neurad.assembly.build import Assembly, build_world
from neurad.assembly.relight import paths
from neurad.core.errors import InputError
from neurad.core.scene_records import EnvironmentMap, Mesh
from neurad.export.copies import Copies, Matcher, _charts
from neurad.export.cycles import render_views
from neurad.export.into import _verify, export_into, place_beside
from neurad.export.into import read_scene as read_again
from neurad.export.into_blend import BlendRoom
from neurad.export.layouts import Polygons, lay_out
from neurad.export.run import ExportSettings
from neurad.formats.blender.cameras_and_lamps import lamp_of
from neurad.formats.blender.process import find_blender
from neurad.formats.cameras.write import shown_alike
from neurad.formats.gltf.file import GltfFile
from neurad.formats.gltf.read import read_scene
from neurad.formats.load import read_folder
from neurad.formats.meshes.triangles import in_world
from neurad.images.image_io import from_srgb, read_exr, read_mask
from neurad.integrators.film import render
from neurad.integrators.method import SceneModel
from neurad.integrators.renderer import MethodRenderer
from neurad.runtime.progress import phase
from neurad.scene import builtin
from neurad.scene.builtin.plain import views
from neurad.scene.description import Scene
from neurad.scene.flatten import flatten_planes
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials

pytest.importorskip("xatlas")
HELPERS = Path(__file__).parent.parent / "helpers"


def patterned(scene):
    """The parts of a run whose fields vary over the room."""
    found = assembled(scene)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, values in found.materials.named_parameters():
            if "table" in name:
                values.copy_(torch.randn(values.shape, generator=generator))
    return found


def put_into(assembly, source, bars=None, beyond=(), **settings):
    """``neurad export --into``, without verification unless it is asked for; returns the copy."""
    out = place_beside(source)
    out.unlink(missing_ok=True)
    settings = {"target": "exact", "verify": False, **settings}
    found = export_into(assembly, source, ExportSettings(out=out, into=source, **settings), bars)
    assert [words.partition(" shows ")[0] for words in found] == [*beyond]
    return out


# ---- glTF


def surface(made, places, faces, material, uvs=None, normals=None):
    """A mesh of a document."""
    attributes = {"POSITION": made.accessor(places, min=places.min(0).tolist(), max=places.max(0).tolist())}
    if uvs is not None:
        attributes["TEXCOORD_0"] = made.accessor(uvs)
    if normals is not None:
        attributes["NORMAL"] = made.accessor(normals)
    return made.mesh(attributes, made.accessor(faces.ravel(), "u2"), material=material)


def corners_of_box():
    """Faces of a cube from -0.5 to 0.5, corners apart: vertices [24, 3] and triangles [12, 3]."""
    places = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            u, v = (u, v) if side > 0 else (v, u)
            places += [
                side * np.eye(3)[axis] + a * u + b * v for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
            ]
    faces = np.concatenate([[[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]] for i in range(6)])
    return np.array(places, np.float32), faces


@pytest.fixture(scope="module")
def glb(tmp_path_factory):
    """A floor whose coordinates tile, a poster whose own serve, two cubes that share a mesh, one of them mirrored, and
    a lamp; cubes and floor have one material, and the poster has a picture.
    """
    made = Document()
    made.json["materials"] = []
    wood = made.add("materials", {"name": "wood", "extras": {"of": "mine"}})
    up = np.tile(np.float32([0, 1, 0]), (4, 1))
    made.node(name="floor", mesh=surface(made, QUAD * 2, FACES, wood, UVS * 4, up))
    poster = made.add("materials", {
        "name": "poster", "pbrMetallicRoughness": {"baseColorTexture": made.texture(np.full((4, 4, 3), 99))},
    })  # fmt: skip
    made.node(name="poster", mesh=surface(made, QUAD, FACES, poster, 0.2 + 0.6 * UVS), translation=[0, 0.5, -1.5],
              rotation=[0.5**0.5, 0, 0, 0.5**0.5])  # fmt: skip
    box = surface(made, *corners_of_box(), wood)
    made.node(name="cube", mesh=box, translation=[-0.8, 0.5, 0.3])
    made.node(name="cube.001", mesh=box, translation=[0.8, 0.45, 0], scale=[-0.9, 0.9, 0.9])
    shines = made.add("materials", {"name": "lamp", "emissiveFactor": [1, 1, 1]})
    made.node(name="lamp", mesh=surface(made, QUAD[[0, 3, 2, 1]], FACES, shines), translation=[0, 3, 0])
    return made.glb(tmp_path_factory.mktemp("into") / "room.glb")


@pytest.fixture(scope="module")
def of_glb(glb):
    """A run of it."""
    eyes = [((2.5, 1.5, 2.5), (0, 0.3, 0)), ((-2.5, 1.5, 2.0), (0, 0.3, 0)), ((0.5, 2.0, 2.8), (0, 0.3, -0.5))]
    return patterned(replace(read_scene(glb), train=views("train", eyes, 0.9, 48)))


def off_of(assembly, path):
    """By how much albedos of a file read again differ from the run's, by mesh: [n, 3] each at points on it."""
    scene = read_scene(path)
    world = build_world(scene)
    materials = TrueMaterials(scene, world.geometry)
    prim = torch.arange(len(world.geometry.faces)).repeat(400)
    u, v = torch.rand(2, len(prim), generator=torch.Generator().manual_seed(0))
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    towards = world.geometry.face_normal[prim]
    si, before = (g.interact_at(prim, u, v, towards, torch.ones_like(prim, dtype=torch.bool))
                  for g in (world.geometry, assembly.world.geometry))  # fmt: skip
    assert torch.allclose(si.p, before.p, atol=1e-5)
    with torch.no_grad():
        off = (materials(si).albedo - assembly.materials(before).albedo).numpy()
    index = world.geometry.mesh_index[prim].numpy()
    return {mesh.name: off[index == i] for i, mesh in enumerate(scene.meshes)}


@pytest.mark.parametrize("group", ["mesh", "material"])
def test_a_gltf_file_keeps_its_nodes_and_shows_what_was_recovered(glb, of_glb, validator, capfd, group):
    before = glb.read_bytes()
    out = put_into(of_glb, glb, group=group, size=512)
    assert glb.read_bytes() == before
    said = capfd.readouterr().out
    assert f"{3 if group == 'mesh' else 2} textures ({3 if group == 'mesh' else 2} of 512 x 512)" in said
    assert "their albedo differs by 0." in said
    old, new = GltfFile(glb).json, GltfFile(out).json
    assert new["nodes"] == old["nodes"]
    assert new["scenes"] == old["scenes"]
    assert new["materials"][: len(old["materials"])] == old["materials"]
    for one, other in zip(old["meshes"], new["meshes"], strict=True):
        assert set(one["primitives"][0]["attributes"]) <= set(other["primitives"][0]["attributes"])
    floor, poster, box, lamp = (mesh["primitives"][0] for mesh in new["meshes"])
    assert "TEXCOORD_1" in floor["attributes"]
    assert "TEXCOORD_1" not in poster["attributes"]  # the first serves
    assert lamp["material"] == 2
    assert (floor["material"] == box["material"]) == (group == "material")
    kept = GltfFile(out).accessor(floor["attributes"]["TEXCOORD_0"], "", "VEC2")
    assert kept.max() == 4.0
    assert validator.issues(out) == []
    off = off_of(of_glb, out)
    for name in ("floor", "poster"):
        assert np.abs(off[name]).mean() < 2 / 255, name
    # One texture shows the mean of both cubes: what the one has too much the other lacks, at one place of the mesh.
    assert np.abs(off["cube"]).mean() > 10 / 255
    assert not off["lamp"].any()


@pytest.mark.parametrize("has_bars", [False, True])
def test_two_cubes_get_the_mean_by_what_is_known(glb, of_glb, monkeypatch, has_bars):
    """A photograph shows the one cube alone, or its error bars are a hundredth of the other's: it has its albedo."""
    first = iter([True, False] if has_bars else [True] + [False] * 10)

    def stds(texels, bars, assembly):
        return (
            {} if bars is None else {"albedo": np.full((*texels.shape, 3), 0.002 if next(first) else 0.2, np.float32)}
        )

    def seen(texels, by):
        return [np.full(len(texels[0].lane), not has_bars and next(first))]

    monkeypatch.setattr("neurad.export.copies.std_maps", stds)
    monkeypatch.setattr("neurad.export.copies.seen_texels", seen)
    off = off_of(of_glb, put_into(of_glb, glb, object() if has_bars else None, size=256))
    assert np.abs(off["cube"]).mean() < 3 / 255
    assert np.abs(off["cube.001"]).mean() > 10 / 255


@pytest.mark.parametrize(("target", "brighter", "state"), [("blender", 1.0, "kept"), ("exact", 1.1, "missed")])
def test_a_gltf_copy_is_rendered_again(glb, of_glb, monkeypatch, capfd, target, brighter, state):
    """By the lobe that its base colours are for; a lamp that is too bright in the file shows."""

    def read(path):
        scene = read_again(path)
        lit = [
            m if m.radiance is None else replace(m, radiance=m.radiance * np.float32(brighter)) for m in scene.meshes
        ]
        return replace(scene, meshes=lit)

    monkeypatch.setattr("neurad.export.into.read_scene", read)
    put_into(of_glb, glb, beyond=["copy"] if state == "missed" else [], target=target, size=512, verify=True)
    assert f"(bound 5 %): {state}" in capfd.readouterr().out


def lamp_in_a_ceiling():
    """A floor below a ceiling of four squares, one of which shines, as a fit finds it in one mesh: vertices [v, 3] and
    triangles [t, 3] of floor and ceiling, +Z up, and the scene in which the lamp is a mesh of its own.
    """
    floor = FLOOR * np.float32([2, 2, 1])
    squares = [FLOOR[::-1] + np.float32([x, y, 1.5]) for x in (-1, 1) for y in (-1, 1)]
    above = np.concatenate(squares), np.concatenate([FLAT + 4 * i for i in range(4)]).astype(np.int64)
    meshes = [
        Mesh("floor", floor, FLAT.astype(np.int64), 0),
        Mesh("ceiling", above[0], above[1][2:], 0),
        Mesh("ceiling_lamp_1", above[0], above[1][:2], 0, radiance=np.float32([2.0, 1.5, 1.0])),
    ]
    eyes = [((0.5, -1.8, 0.5), (0, 1, 0.6)), ((-1.5, 1, 1.2), (1, -1, 0))]  # the first sees nothing
    return (floor, FLAT), above, Scene("room", meshes, [GREY], None, views("train", eyes, 1.2, 32))


@pytest.mark.parametrize("coordinates", [True, False])
def test_a_lamp_inside_a_surface_shines_in_a_gltf_copy(tmp_path, monkeypatch, capfd, coordinates):
    """As a picture, since a material shines as a whole; a surface without coordinates cannot, and that is said."""
    made = Document()
    made.json["materials"] = []
    number = made.add("materials", {"name": "paint"})
    *surfaces, scene = lamp_in_a_ceiling()
    for name, (places, faces) in zip(("floor", "ceiling"), surfaces, strict=True):
        made.node(name=name, mesh=surface(made, places, faces, number))
    glb = made.glb(tmp_path / "room.glb")
    if not coordinates:
        monkeypatch.setattr("neurad.export.layouts._unwrapped", lambda meshes, *rest: [[] for _ in meshes])
    out = put_into(patterned(scene), glb, size=64, verify=coordinates)
    said = capfd.readouterr().out
    assert ("ceiling: a part of it shines, which its one value cannot say" in said) != coordinates
    if not coordinates:
        return
    assert "(bound 5 %): kept" in said
    shining = [mesh for mesh in read_scene(out).meshes if mesh.radiance is not None]
    lit = max(shining, key=lambda mesh: (not mesh.name.endswith("(back)"), len(mesh.faces)))
    assert lit.radiance == pytest.approx([2.0, 1.5, 1.0], rel=0.02)
    places = lit.vertices[lit.faces].reshape(-1, 3)
    assert places.min(0) == pytest.approx([-2, -2, 1.5], abs=0.1)
    assert places.max(0) == pytest.approx([0, 0, 1.5], abs=0.1)


def test_lamps_of_one_material_shine_as_they_were_found_each(tmp_path, monkeypatch, capfd):
    made = Document()
    made.json["materials"] = []
    paint = made.add("materials", {"name": "paint"})
    lamp = made.add("materials", {"name": "lamp", "emissiveFactor": [1, 1, 1]})
    for name, height, size, material in (("floor", 0, 3, paint), ("left", 2, 0.5, lamp), ("right", 2, 1, lamp)):
        places = FLOOR[:: -1 if material == lamp else 1] * np.float32([size, size, 1])
        places += np.float32([{"left": -2, "right": 2}.get(name, 0), 0, height])
        made.node(name=name, mesh=surface(made, places, FLAT, material))
    glb = made.glb(tmp_path / "room.glb")
    assembly = patterned(replace(read_scene(glb), train=views("train", [((0, -2, 1.5), (0, 0.5, 0))], 1.2, 32)))
    radiances = np.float32([[4, 3, 2], [0.5, 1, 2]])
    monkeypatch.setattr(Assembly, "lamps", property(lambda self: SimpleNamespace(
        mesh=torch.tensor([1, 2]), found=lambda: radiances)))  # fmt: skip
    out = put_into(assembly, glb, size=64)
    again = {mesh.name: mesh.radiance for mesh in read_scene(out).meshes}
    assert again["left"] == pytest.approx(radiances[0])
    assert again["right"] == pytest.approx(radiances[1])
    assert GltfFile(out).json["materials"][:2] == GltfFile(glb).json["materials"]


def test_what_cannot_be_rendered_again_is_said(glb, of_glb, monkeypatch, capfd):
    """Base colours for a model that neurad lacks, and a room that only a flash lights, which no file has."""
    monkeypatch.setattr("neurad.export.into.verify_copy", None)
    dark = [replace(mesh, radiance=None) for mesh in of_glb.scene.meshes]
    held = [replace(v, camera=replace(v.camera, flash=flash())) for v in of_glb.scene.train]
    flashed = assembled(replace(of_glb.scene, meshes=dark, train=held))
    for made, target, why in (
        (of_glb, "gltf", "its base colours are for other programs"),
        (flashed, "exact", "only a flash lights the room"),
    ):
        put_into(made, glb, target=target, size=64, verify=True)
        assert f"nothing is rendered again: {why}" in capfd.readouterr().err


def test_what_is_refused(glb, of_glb, tmp_path):
    out = place_beside(glb)
    out.touch()
    with pytest.raises(InputError, match=r"room_recovered.glb is there already; name another file"):
        export_into(of_glb, glb, ExportSettings(out=out, into=glb), None)
    with pytest.raises(InputError, match="is the file itself, which is only read"):
        export_into(of_glb, glb, ExportSettings(out=glb, into=glb), None)
    out.unlink()
    other = Document()
    other.quad(name="elsewhere", translation=[7, 0, 0])
    path = other.glb(tmp_path / "other.glb")
    with pytest.raises(InputError, match=r"other.glb: it is not the room of the run, which has 0 % of its surface"):
        put_into(of_glb, path)
    with pytest.raises(InputError, match="neither a Blender file"):
        put_into(of_glb, tmp_path / "room.obj")
    with pytest.raises(InputError, match="is glTF, Blender has nothing to do with it"):
        put_into(of_glb, glb, blender="python")
    with pytest.raises(InputError, match=r"--texels 4096: 4 textures have 16384 texels at least; allow more, or share"):
        put_into(of_glb, glb, texels=4096)
    assert not list(tmp_path.glob("*recovered*"))


# ---- Parts


def test_polygons_stay_whole(monkeypatch):
    """A strip of bent quads: no polygon is torn, and no texel belongs to two."""
    x = np.linspace(0, 6, 25)
    rim = np.stack((np.cos(x), np.sin(x), 0 * x), 1)
    points = np.concatenate((rim, rim + np.array([0.0, 0.0, 0.4]))).astype(np.float32)
    quads = np.array([[i, i + 1, i + 26, i + 25] for i in range(24)])
    corner = np.arange(96).reshape(-1, 4)  # each polygon has corners of its own
    faces = np.concatenate((corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]))
    part = Polygons(points[quads.ravel()], faces, np.tile(np.arange(24), 2), None)
    for side in (64, 256):
        (layout,) = lay_out([[part, part]], 64.0, 1 << 20, side, "mesh")
        assert layout.side == side
        for uvs in layout.uvs:
            assert np.isfinite(uvs).all()
            assert (uvs > 0).all()
            assert (uvs < 1).all()
        a, b = layout.uvs
        assert not np.allclose(a, b)  # two parts lie beside each other


def test_copies_are_laid_in_layers():
    """Three squares on the same texels, one of them mirrored where it hangs together with another; a fourth apart."""
    square = np.array([[0, 0], [0.4, 0], [0.4, 0.4], [0, 0.4]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    flat = np.concatenate((square, np.zeros((4, 1))), 1)
    mirrored = flat * [-1, 1, 1]
    points = np.concatenate([flat[faces], mirrored[faces][:, [0, 2, 1]], flat[faces] + 5, flat[faces] + [0.5, 0, 0]])
    uvs = np.concatenate([square[faces], square[faces][:, [0, 2, 1]], square[faces] + 1, square[faces] + [0.5, 0]])
    thing = np.array([0, 0, 0, 0, 1, 1, 0, 0])
    layers = _charts(Copies(points, uvs, np.arange(8), thing), 32)
    assert sorted(len(prims) for _, prims in layers) == [2, 2, 4]
    assert sorted(int(prim) for _, prims in layers for prim in prims) == list(range(8))


def test_triangles_are_found_again_in_another_order(of_glb):
    geometry: Geometry = of_glb.world.geometry
    corners = geometry.vertices[geometry.faces].numpy().astype(np.float64)
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(len(corners))
    turned = corners[shuffled][:, [1, 2, 0]] + rng.uniform(-1e-6, 1e-6, corners.shape)
    prims, order = Matcher(of_glb.scene.meshes, geometry)(np.concatenate((turned, turned + 0.1)))
    assert (prims[: len(shuffled)] == shuffled).all()
    assert (prims[len(shuffled) :] == -1).all()
    assert (order[: len(shuffled)] == [2, 0, 1]).all()


def test_triangles_of_a_scan_are_found_again_where_planes_were_made_flat():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(21) / 10, np.arange(21) / 10))
    bent = np.stack((x, y, np.random.default_rng(0).uniform(-0.003, 0.003, x.size)), -1).astype(np.float32)
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    faces = np.stack((corner, corner + 1, corner + 22, corner, corner + 22, corner + 21), -1).reshape(-1, 3)
    scan = Mesh("scan", bent, faces, 0, normals=np.tile(np.float32([0, 0, 1]), (len(bent), 1)))
    found = flatten_planes([scan])
    assert found.planes == 1
    scene = Scene("room", found.meshes, [GREY])
    geometry = Geometry(scene)
    moved = geometry.vertices[geometry.faces].numpy() - bent[faces]
    assert np.abs(moved).max() > 0.001
    prims, _ = Matcher(scene.meshes, geometry)(bent[faces].astype(np.float64))
    assert np.array_equal(prims, np.arange(len(faces)))


# ---- Blender


class StandIn:
    """What passes for Blender with a file of two squares, one of them mirrored, which have one mesh."""

    version = "4.5.0"

    def __init__(self):
        self.jobs = {}

    def run(self, program, arguments):
        job = json.loads(Path(arguments[0]).read_text())
        self.jobs[job["do"]] = job
        made = getattr(self, job["do"])(job, Path(job["out"]))
        Path(job["answer"]).write_text(json.dumps(made))
        return ""

    def read(self, job, out):
        np.savez(out / "base.npz", vertices=FLOOR, vertex=np.arange(4, dtype=np.int32), corners=FLAT,
                 polygon=np.zeros(2, np.int32), slot=np.zeros(2, np.int32))  # fmt: skip
        mesh = {"file": "base.npz", "scale": 1.0, "slots": ["wood"], "full": False}
        return {"meshes": {"square": mesh}, "objects": ["a", "b"], "linked": ["vase"], "libraries": ["//more.blend"]}

    def lay(self, job, out):
        self.laid = second = np.load(job["meshes"]["square"]["file"])
        np.savez(out / "mesh.npz", vertices=FLOOR, faces=FLAT, material=np.zeros(2, np.int32), uv0=second[FLAT])
        thing = {"mesh": "mesh.npz", "uvs": {"neurad": "uv0"}, "materials": [0]}
        placed = [{**thing, "name": name, "to_world": pose.tolist()} for name, pose in PLACED.items()]
        made = {"material": "wood recovered", "old": "wood", "layout": 0, "uv": "neurad", "object": "a", "fake": False}
        return {"made": [made], "objects": placed, "lamps": [LAMP], "materials": ["wood recovered"], "second": "neurad"}

    def paint(self, job, out):
        self.pictures = {file.name: np.asarray(Image.open(file)) for file in out.glob("*.png")}
        self.world = read_exr(out / job["environment"]["file"])
        Path(job["save"]).write_bytes(b"BLENDER-again")
        return {}


FLOOR = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
FLAT = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
PLACED = {"a": np.eye(4), "b": np.diag([-1.0, 1.0, 1.0, 1.0])}
PLACED["b"][0, 3] = 2.5
LAMP = lamp(to_world=moved(1.0, 0.0, 3.0))


def test_the_steps_of_a_blender_file(tmp_path, monkeypatch, capfd):
    """Without Blender: what it is asked for, pictures with v upwards, and a file that is there all at once."""
    sky = EnvironmentMap(np.ones((4, 8, 3), np.float32), np.eye(4, dtype=np.float32)[[0, 2, 1, 3]])
    meshes = [Mesh(name, *in_world(pose, FLOOR, None, FLAT.astype(np.int64))[::2], 0) for name, pose in PLACED.items()]
    lit = replace(lamp_of(LAMP, 0, "", []), name="lamp")
    scene = Scene("two", [*meshes, lit], [GREY], sky, views("train", [((1, -3, 2), (1, 0, 0))], 0.9, 32))
    assembly = patterned(scene)
    shines = SimpleNamespace(mesh=torch.tensor([2]), found=lambda: lit.radiance[None] * np.float32([2.0, 1.0, 0.5]))
    monkeypatch.setattr(Assembly, "lamps", property(lambda self: shines))
    around = SimpleNamespace(map=lambda times: np.full((4, 8, 3), 0.25, np.float32), sun=SimpleNamespace(shines=False))
    monkeypatch.setattr(Assembly, "environment", property(lambda self: around))
    assembly.materials.albedo = lambda si: si.p.abs() / 4.0  # of both the same along y
    blend = tmp_path / "room.blend"
    blend.write_bytes(b"BLENDER-v405")
    blender = StandIn()
    monkeypatch.setattr("neurad.export.into.find_blender", lambda program: blender)
    put_into(assembly, blend, size=64)
    assert (tmp_path / "room_recovered.blend").read_bytes() == b"BLENDER-again"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["room.blend", "room_recovered.blend"]
    said = capfd.readouterr().out
    assert "1 textures (1 of 64 x 64), 0.00 M texels" in said
    assert "linked libraries are left alone (//more.blend): vase" in said
    assert blender.jobs["paint"]["meshes"]["square"]["used"]
    assert blender.jobs["paint"]["lamps"] == {"Area": pytest.approx([2.0, 1.0, 0.5])}
    assert blender.jobs["paint"]["environment"]["to_world"] == sky.to_world[:3, :3].tolist()
    assert (blender.world == 0.25).all()
    surface = blender.jobs["paint"]["made"][0]["surface"]
    assert not surface["diffuse"]
    picture = from_srgb(blender.pictures[surface["base"]].astype(np.float32) / 255)
    at = np.rint(blender.laid[:, ::-1] * 64 - 0.5).astype(int)  # rows upwards, columns
    for (row, column), corner in zip(at, FLOOR, strict=True):
        here = picture[63 - row, column]
        assert here[1] == pytest.approx(abs(corner[1]) / 4, abs=0.03)
    middle = np.rint(blender.laid.mean(0)[::-1] * 64 - 0.5).astype(int)
    assert picture[63 - middle[0], middle[1], 1] == pytest.approx(0.0, abs=0.03)
    # x is between -1 and 1 on one square and 1.5 and 3.5 on the other: the mean of both
    edge = [picture[63 - row, column, 0] for row, column in at]
    assert edge == pytest.approx([(1 + 3.5) / 8, (1 + 1.5) / 8, (1 + 1.5) / 8, (1 + 3.5) / 8], abs=0.03)


@pytest.mark.parametrize(("brighter", "state"), [(1.0, "kept"), (1.02, "kept"), (1.05, "missed")])
def test_a_copy_is_held_to_the_pictures_of_the_run(tmp_path, monkeypatch, capfd, brighter, state):
    """Cycles, stood in for by our own paths, may show a view 3 % brighter; masks and flashes do not count."""
    cornell = builtin.build("cornell")
    left_out = np.zeros((24, 24), bool)
    left_out[:8] = True
    held = [replace(v, camera=replace(v.camera, width=24, height=24), image=None) for v in cornell.test[:2]]
    held[1] = replace(held[1], left_out=left_out)
    dark = [replace(view, camera=replace(view.camera, flash=None)) for view in held]
    held[0] = replace(held[0], camera=replace(held[0].camera, flash=flash()))  # which no file has
    assembly = assembled(replace(cornell, test=held, origin=(10.0, 0.0, 0.0)))
    asked = []

    def cycles(blender, file, shown, samples, seed, transparent):
        asked.append((file.name, seed, shown[0].camera.to_world[0, 3]))
        tracer = MethodRenderer(paths(assembly.scene), SceneModel(assembly.world, assembly.materials))
        pictures = [brighter * render(view.camera, tracer, samples, seed).numpy() for view in dark]
        pictures[1][:8] = 100.0  # what the run does not know
        return pictures

    monkeypatch.setattr("neurad.export.into.render_views", cycles)
    settings = ExportSettings(out=tmp_path / "out.blend", into=tmp_path / "in.blend", spp=64)
    with phase("export") as bar:
        beyond = _verify(assembly, BlendRoom(settings.into, None, "mesh", tmp_path), settings, bar)
    assert [words.partition(" shows ")[0] for words in beyond] == (["cycles"] if state == "missed" else [])
    assert f"(bound 3 %): {state}" in capfd.readouterr().out
    assert [words[:2] for words in asked] == [("out.blend", 1), ("out.blend", 2)]
    assert asked[0][2] == pytest.approx(held[0].camera.to_world[0, 3] + 10.0)  # as the file has it


@pytest.fixture(scope="module")
def python(request):
    """A Python that has bpy."""
    return blender_python(cache_folder(request, "blender"))


def described(python, path):
    """What a Blender file has, by a program of the tests' own."""
    ended = subprocess.run([python, str(HELPERS / "blender_objects.py"), str(path)], check=True, capture_output=True)
    return json.loads(ended.stdout.decode().splitlines()[-1])


MADE = """
import sys
from pathlib import Path
import bpy
import numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
lamp = bpy.data.materials.new("lamp")
lamp.use_nodes = True
lamp.node_tree.nodes["Principled BSDF"].inputs["Emission Strength"].default_value = 1.0
for file in Path(sys.argv[-1]).glob("*.npz"):
    mesh, arrays, name = bpy.data.meshes.new(file.stem), np.load(file), file.stem
    mesh.from_pydata(arrays["places"].tolist(), [], arrays["faces"].tolist())
    mesh.materials.append(lamp if name in ("left", "right") else bpy.data.materials.new(name))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))
bpy.ops.wm.save_as_mainfile(filepath=f"{sys.argv[-1]}/room.blend")
"""


@pytest.mark.slow
def test_a_lamp_inside_a_surface_shines_in_a_blender_copy(python, tmp_path, capfd):
    *surfaces, scene = lamp_in_a_ceiling()
    for name, (places, faces) in zip(("floor", "ceiling"), surfaces, strict=True):
        np.savez(tmp_path / f"{name}.npz", places=places, faces=faces)
    subprocess.run([python, "-c", MADE, str(tmp_path)], check=True, capture_output=True)
    assembly = patterned(replace(scene, train=scene.train[1:]).with_diffuse("lambert"))  # Cycles' own
    put_into(assembly, tmp_path / "room.blend", blender=python, target="blender", size=256, spp=64, verify=True)
    assert "(bound 3 %): kept" in capfd.readouterr().out


@pytest.mark.slow
def test_blenders_lamps_of_one_material_shine_as_they_were_found_each(python, tmp_path, monkeypatch):
    meshes = [Mesh("floor", FLOOR * np.float32([3, 3, 1]), FLAT.astype(np.int64), 0)]
    for name, x in (("left", -2), ("right", 2)):
        places = FLOOR[::-1] * np.float32(0.5) + np.float32([x, 0, 2])
        meshes.append(Mesh(name, places, FLAT.astype(np.int64), 0, radiance=np.ones(3, np.float32)))
    for mesh in meshes:
        np.savez(tmp_path / f"{mesh.name}.npz", places=mesh.vertices, faces=mesh.faces)
    subprocess.run([python, "-c", MADE, str(tmp_path)], check=True, capture_output=True)
    radiances = np.float32([[4, 3, 2], [0.5, 1, 2]])
    monkeypatch.setattr(Assembly, "lamps", property(lambda self: SimpleNamespace(
        mesh=torch.tensor([1, 2]), found=lambda: radiances)))  # fmt: skip
    scene = Scene("room", meshes, [GREY], None, views("train", [((0, -2, 1.5), (0, 0.5, 0))], 1.2, 32))
    out = put_into(patterned(scene), tmp_path / "room.blend", blender=python, size=64)
    shines = described(python, out)["shines"]
    assert shines["left"] == [pytest.approx(radiances[0].tolist())]
    assert shines["right"] == [pytest.approx(radiances[1].tolist())]


@pytest.mark.slow
@pytest.mark.parametrize("group", ["mesh", "material"])
def test_a_blender_file_renders_as_the_export_does(python, tmp_path, capfd, group):
    """Modifiers, instances, tiled coordinates, several materials on one object, a script and a linked library."""
    pytest.importorskip("mitsuba")
    from neurad.cli import main

    blend = tmp_path / "zimmer.blend"
    job = {"blend": str(blend), "pictures": str(tmp_path / "fotos"), "threads": 1, "views": 5, "size": [48, 36]}
    (tmp_path / "job.json").write_text(json.dumps({**job, "samples": 4, "crowd": True}))
    subprocess.run(
        [python, str(HELPERS / "blender_room.py"), str(tmp_path / "job.json")], check=True, capture_output=True
    )
    main(["data", "blender", str(blend), "--images", str(tmp_path / "fotos"), "--blender", python,
          "--out", str(tmp_path / "room")])  # fmt: skip
    assembly = patterned(read_folder(tmp_path / "room", hold_out=2))
    before = blend.read_bytes()
    sizes = {"size": 256} if group == "mesh" else {"texels": 4_000_000}
    verify = group == "mesh"
    out = put_into(assembly, blend, blender=python, group=group, target="blender", verify=verify, spp=64, **sizes)
    assert blend.read_bytes() == before
    assert not (tmp_path / "ran").exists()
    said = capfd.readouterr().out
    assert "their albedo differs by 0." in said
    assert "left alone, as no recovered" not in said
    assert ("(bound 3 %): kept" in said) == verify
    assert "linked libraries are left alone (//library.blend): vase\n" in said
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "fotos", "job.json", "library.blend", "room", "zimmer.blend", out.name
    ]  # fmt: skip
    old, new = described(python, blend), described(python, out)
    for key in ("objects", "modifiers", "instances", "uvs", "vertices", "scripts", "lamps"):
        assert new[key] == old[key], key
    assert {name for name, slots in new["materials"].items() if "recovered" not in str(slots)} == {"vase"}
    assert len({slot for slots in new["materials"].values() for slot in slots}) == (14 if group == "mesh" else 9)
    assert new["second"]["poster"] == ([] if group == "mesh" else ["neurad"])
    assert new["second"]["room"] == ["neurad"]
    if group == "material":
        return
    plain = exported(assembly.scene, tmp_path / "plain", size=256, made=assembly)
    shown = shown_alike(assembly.scene)
    assert len(shown) > 1
    theirs, again = (render_views(find_blender(python), room, shown, 256, 1) for room in (plain, out))
    for view, one, other in zip(shown, theirs, again, strict=True):
        kept = read_mask(view) if view.mask else np.ones(one.shape[:2], bool)
        assert other[kept].mean() == pytest.approx(one[kept].mean(), rel=0.03), view.name
        blocks = [np.where(kept[..., None], x, 0.0).reshape(6, 6, 6, 8, 3).sum((1, 3)) for x in (one, other)]
        assert np.abs(blocks[0] - blocks[1]).mean() < 0.05 * blocks[0].mean()
    assert read_exr(shown[0].image).shape[:2] == again[0].shape[:2]
