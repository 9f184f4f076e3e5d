"""Edits of a scene: lamps, environment, materials, things that are put in; and the files that describe them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.tiny_scene import write_scene

from neurad.core.errors import InputError
from neurad.core.records import Bitmap, Constant, EnvironmentMap
from neurad.formats.edits.edit import Edit, coloured, edited, lamps_of
from neurad.formats.edits.edit_file import edit_of, read_edit
from neurad.images.image_io import write_exr
from neurad.scene.builtin import build
from neurad.scene.light import light_of


def cornell():
    return build("cornell")


def mesh(scene, name):
    return next(m for m in scene.meshes if m.name == name)


def apply(scene, tree, folder=None):
    return edited(scene, edit_of(tree) if folder is None else edit_of(tree, folder=folder))


@pytest.fixture
def two_lamps():
    """A Cornell box with a second lamp and an environment."""
    scene = cornell()
    lamp = mesh(scene, lamps_of(scene)[0])
    second = replace(lamp, name="lamp two", vertices=lamp.vertices - np.float32([0, 0.2, 0]))
    sky = np.random.default_rng(0).random((8, 16, 3), np.float32)
    return replace(scene, meshes=[*scene.meshes, second], environment=EnvironmentMap(sky)).check()


def test_an_empty_edit_changes_nothing(two_lamps):
    made = apply(two_lamps, None)
    assert not made.changes
    assert light_of(made.scene) == light_of(two_lamps)
    assert made.scene.geometry_fingerprint == two_lamps.geometry_fingerprint
    assert edited(two_lamps, Edit()).scene.meshes == two_lamps.meshes


def test_lamps_are_switched_scaled_coloured_and_moved(two_lamps):
    first = lamps_of(two_lamps)[0]
    before = mesh(two_lamps, first)
    assert mesh(apply(two_lamps, {"lamps": {first: False}}).scene, first).radiance is None
    assert mesh(apply(two_lamps, {"lamps": {first: "off"}}).scene, first).radiance is None
    assert mesh(apply(two_lamps, {"lamps": {first: 0}}).scene, first).radiance is None
    scaled = apply(two_lamps, {"lamps": {first: 2.5}})
    np.testing.assert_allclose(mesh(scaled.scene, first).radiance, before.radiance * 2.5, rtol=1e-6)
    assert not scaled.reshaped
    tint = mesh(apply(two_lamps, {"lamps": {first: {"color": [1, 0.5, 0.25]}}}).scene, first).radiance
    weights = np.array((0.212671, 0.715160, 0.072169))
    assert tint @ weights == pytest.approx(before.radiance @ weights, rel=1e-5)
    np.testing.assert_allclose(tint / tint[0], [1, 0.5, 0.25], rtol=1e-5)
    both = {"lamps": {first: {"radiance": [1, 2, 3], "scale": 2, "move": [0, 0.1, 0]}}}
    moved = apply(two_lamps, both)
    np.testing.assert_allclose(mesh(moved.scene, first).radiance, [2, 4, 6])
    np.testing.assert_allclose(mesh(moved.scene, first).vertices, before.vertices + np.float32([0, 0.1, 0]), atol=1e-6)
    assert moved.reshaped
    assert moved.said == (
        f"lamp {first} 2, 4, 6 instead of {', '.join(f'{x:.4g}' for x in before.radiance)}",
        f"lamp {first} moved by 0, 0.1, 0",
    )
    everything = apply(two_lamps, {"lamps": {"*": 0.5, "lamp two": 0.5}})
    np.testing.assert_allclose(mesh(everything.scene, first).radiance, before.radiance * 0.5)
    np.testing.assert_allclose(mesh(everything.scene, "lamp two").radiance, before.radiance * 0.25)


def test_the_environment_is_turned_scaled_replaced_and_removed(two_lamps, tmp_path):
    """Counterclockwise from above: what came from +x comes from -z after a quarter turn, with +y up."""
    turned = apply(two_lamps, {"environment": {"turn": 90, "scale": 3}}).scene.environment
    np.testing.assert_allclose(turned.to_world[:3, :3] @ [1, 0, 0], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(turned.to_world[:3, :3] @ [0, 1, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(turned.pixels, 3 * two_lamps.environment.pixels)
    tinted = apply(two_lamps, {"environment": {"color": 1}}).scene.environment.pixels
    np.testing.assert_array_equal(tinted[..., 0], tinted[..., 2])
    write_exr(tmp_path / "sky.exr", np.full((4, 8, 3), 0.5, np.float32))
    other = apply(two_lamps, {"environment": {"file": "sky.exr"}}, tmp_path).scene.environment
    assert other.pixels.shape == (4, 8, 3)
    assert apply(two_lamps, {"environment": False}).scene.environment is None
    lit = replace(two_lamps, environment=None)
    assert apply(lit, {"environment": {"file": "sky.exr"}}, tmp_path).scene.features.has_environment


def test_materials_change_by_mesh_and_leave_others_that_share_them():
    scene = cornell()
    shared = next(m for m in scene.meshes if m.radiance is None)
    made = apply(scene, {"materials": {shared.name: {"albedo": [0.1, 0.2, 0.3]}}})
    index = [m.name for m in scene.meshes].index(shared.name)
    np.testing.assert_allclose(made.scene.materials[made.scene.meshes[index].material].albedo.value, [0.1, 0.2, 0.3])
    assert made.scene.materials[: len(scene.materials)] == scene.materials
    assert {name: meshes for name, meshes in made.painted.items() if meshes} == {"albedo": {index}}


def box(path, **material):
    """A box of 1 x 2 x 4 with its lower side at y = 0, in glTF with a material."""
    solid = trimesh.creation.box(extents=(1, 2, 4), transform=trimesh.transformations.translation_matrix((5, 1, 7)))
    if material:
        pbr = trimesh.visual.material.PBRMaterial(**material)
        solid.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(solid.vertices), 2)), material=pbr)
    solid.export(path)


def test_a_thing_is_put_in_where_it_is_to_stand(tmp_path):
    scene = cornell()
    box(tmp_path / "box.glb", baseColorFactor=[0.8, 0.4, 0.2, 1.0], roughnessFactor=0.3)
    entry = {"file": "box.glb", "at": [0.1, 0.2, 0.3], "size": 2}
    made = apply(scene, {"objects": [entry]}, tmp_path)
    thing = made.scene.meshes[-1]
    assert thing.name == "box"
    low, high = thing.vertices.min(0), thing.vertices.max(0)
    np.testing.assert_allclose(high - low, [0.5, 1.0, 2.0], atol=1e-5)
    np.testing.assert_allclose((low + high) / 2 - [0, 0.5, 0], [0.1, 0.2, 0.3], atol=1e-5)
    material = made.scene.materials[thing.material]
    np.testing.assert_allclose(material.albedo.value, [0.8, 0.4, 0.2], atol=3e-3)
    np.testing.assert_allclose(material.roughness.value, [0.3], atol=1e-3)
    last = len(made.scene.meshes) - 1
    assert set(made.painted.values()) == {frozenset({last})}
    assert made.reshaped
    turned = apply(scene, {"objects": [{**entry, "turn": 90, "albedo": 0.7, "radiance": 2}]}, tmp_path).scene
    thing = turned.meshes[-1]
    np.testing.assert_allclose(np.ptp(thing.vertices, axis=0), [2.0, 1.0, 0.5], atol=1e-5)
    np.testing.assert_allclose(turned.materials[thing.material].albedo.value, [0.7] * 3, atol=1e-6)
    assert thing.name in lamps_of(turned)


def test_the_picture_of_a_thing_lies_on_it_as_the_file_has_it(tmp_path):
    """The corner of a square at u = v = 0 in OBJ is the lower left of the picture, which here is its last row."""
    from PIL import Image

    pixels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "paint.png")
    (tmp_path / "square.mtl").write_text("newmtl paint\nKd 1 1 1\nmap_Kd paint.png\n")
    text = "mtllib square.mtl\nusemtl paint\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "square.obj").write_text(text + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    made = apply(cornell(), {"objects": [{"file": "square.obj", "at": [0, 0, 0]}]}, tmp_path).scene
    thing = made.meshes[-1]
    texture = made.materials[thing.material].albedo
    assert isinstance(texture, Bitmap)
    corner = int(np.argmin(thing.vertices.sum(1)))
    u, v = thing.uvs[corner]
    np.testing.assert_allclose(texture.pixels[int(v * 1.99), int(u * 1.99)], [0, 0, 1], atol=1e-6)
    assert isinstance(made.materials[thing.material].roughness, Constant)


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"lamps": {"lihgt": 0}}, r"--edit: lamps: there is no lamp lihgt; did you mean light\?"),
        ({"lamps": {"floor": 0}}, r"mesh floor is no lamp; there are light"),
        ({"lamps": {"light": -1}}, r"lamps: light is -1, which has to be a number from 0"),
        ({"lamps": {"light": True}}, r"lamps: light: it is True, but off, a factor, or a mapping"),
        ({"lamps": {"light": {"colour": [1, 1, 1]}}}, r"there is no key colour; did you mean color\?"),
        ({"lamps": {"light": {"color": [1, 1]}}}, r"color is \[1, 1\], which is not three numbers"),
        ({"lamps": {"light": {"color": [0, 0, 0]}}}, r"color is black"),
        ({"lamps": {"light": {"scale": float("nan")}}}, r"scale is nan"),
        ({"lamps": {"light": {"scale": 1e17}}}, r"the radiance of light then is"),
        ({"lamps": [1]}, r"lamps has to be a mapping"),
        ({"lamps": {"light": 0}}, r"it leaves no light in the scene"),
        ({"environment": {"turn": 90}}, r"environment: the scene has none to change; give it a file"),
        ({"environment": {"file": "nowhere.exr"}}, r"nowhere.exr: there is no such file"),
        ({"environment": {"turn": "left"}}, r"environment: turn is 'left', not a number"),
        ({"materials": {"flor": {"albedo": 0.5}}}, r"materials: there is no mesh flor; did you mean floor\?"),
        ({"materials": {"floor": {"albedo": 2}}}, r"floor: albedo is 2, which has to be a number from 0 to 1"),
        ({"materials": {"floor": {"roughness": 0.5}}}, r"mesh floor is diffuse and has no roughness"),
        ({"objects": {"file": "x"}}, r"objects has to be a list"),
        ({"objects": [{"at": [0, 0, 0]}]}, r"objects: entry 1: it has no file"),
        ({"objects": [{"file": "x.obj"}]}, r"objects: entry 1: it has no place"),
        ({"objects": [{"file": "x.obj", "at": [0, 0, 0]}]}, r"x.obj: there is no such object"),
        ({"objects": [{"file": "x.obj", "at": [0, 0, 0], "up": "w"}]}, r"up is w, which is none of x, -x"),
        ({"lights": {}}, r"--edit: there is no key lights; there are lamps"),
        ([1], r"--edit: it is \[1\], but a mapping"),
    ],
)
def test_what_is_wrong_in_an_edit_gets_one_sentence(tree, said):
    with pytest.raises(InputError, match=said) as raised:
        apply(cornell(), tree)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["broken.glb", "broken.obj", "empty.obj", "thing.fbx", "huge.obj"])
def test_a_thing_that_does_not_load_gets_one_sentence(tmp_path, name):
    text = {"broken.glb": "no glTF", "broken.obj": "f 1 2 3\n", "empty.obj": "v 0 0 0\n", "thing.fbx": "x"}
    huge = "v 0 0 0\nv 1e30 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / name).write_text(text.get(name, huge))
    with pytest.raises(InputError, match=name) as raised:
        apply(cornell(), {"objects": [{"file": name, "at": [0, 0, 0]}]}, tmp_path)
    assert "\n" not in str(raised.value)


def test_edits_are_read_from_files_beside_which_their_files_lie(tmp_path):
    box(tmp_path / "box.glb")
    (tmp_path / "evening.yaml").write_text("lamps: {light: {scale: 0.5}}\nobjects: [{file: box.glb, at: 0}]\n")
    edit = read_edit(tmp_path / "evening.yaml")
    assert edit.lamps["light"].scale == 0.5
    assert edit.files == [str(tmp_path / "box.glb")]
    (tmp_path / "evening.yaml").write_text("lamps: {light: off}\n")
    assert read_edit(tmp_path / "evening.yaml").lamps["light"].off
    for text, said in (("a: [", "not readable YAML"), ("- 1", "a mapping")):
        (tmp_path / "evening.yaml").write_text(text)
        with pytest.raises(InputError, match=f"--edit .*evening.yaml: .*{said}"):
            read_edit(tmp_path / "evening.yaml")
    with pytest.raises(InputError, match="there is no such file"):
        read_edit(tmp_path / "night.yaml")


def test_a_scene_file_and_its_lamps(tmp_path):
    pytest.importorskip("mitsuba")
    from neurad.formats.load import load_scene

    scene = load_scene(str(write_scene(tmp_path / "room")), None)
    assert lamps_of(scene) == ["lamp"]
    made = edited(scene, edit_of({"materials": {"floor": {"albedo": 0.2, "roughness": 0.9}}}))
    assert made.said == ("floor of albedo 0.2, 0.2, 0.2 and roughness 0.9",)


def test_colour_keeps_luminance():
    light = np.array([[3.0, 1.0, 2.0], [0.0, 0.0, 0.0]], np.float32)
    made = coloured(light, (2.0, 1.0, 0.5))
    weights = np.array((0.212671, 0.715160, 0.072169))
    np.testing.assert_allclose(made @ weights, light @ weights, rtol=1e-5)
