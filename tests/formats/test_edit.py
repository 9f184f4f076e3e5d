"""Edits of a scene: lamps, environment, materials, things that are put in; and the files that describe them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from helpers.pathtraced import paths

from benchmarks.loaded import to_mitsuba
from neurad.core.errors import InputError
from neurad.core.scene_records import Bitmap, Camera, Constant, EnvironmentMap, PunctualLight
from neurad.formats.edits.edit import edited, lamps_of
from neurad.formats.edits.edit_file import edit_of, read_edit
from neurad.formats.edits.placement import path_of
from neurad.images.image_io import write_exr
from neurad.integrators.film import render
from neurad.scene.builtin import build, build_cornell
from neurad.scene.light import light_changes, light_of


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


# ---- edits of lights without extent, and what a checkpoint keeps of them


@pytest.fixture(scope="module")
def scene():
    """The Cornell box with a bulb and a sun beside its lamp."""
    one = np.ones(3, np.float32)
    bulb = PunctualLight("bulb", "point", 2 * one, np.float32([0, 0.5, 0]))
    sun = PunctualLight("sun", "directional", one, direction=np.float32([0, -1, 0]))
    return replace(build_cornell(), punctual=(bulb, sun))


def changed(scene, **lamps):
    return edited(scene, edit_of({"lamps": lamps}))


def test_scaled_coloured_moved_and_off(scene):
    made = changed(scene, bulb={"scale": 0.5, "color": [1, 0, 0], "move": [0, 0.25, 0]}, sun=False)
    bulb, sun = made.scene.punctual
    np.testing.assert_allclose(bulb.intensity, [1 / 0.212671, 0, 0], rtol=1e-3)  # of the luminance that it had
    assert bulb.position.tolist() == [0, 0.75, 0]
    assert not sun.intensity.any()
    assert made.said == ("lamp bulb 4.702, 0, 0 instead of 2, 2, 2", "lamp bulb moved by 0, 0.25, 0", "lamp sun off")
    assert not made.reshaped  # no triangle has moved
    assert made.scene.meshes == scene.meshes


def test_a_pattern_takes_both_kinds(scene):
    made = changed(scene, **{"*": 2})
    assert made.scene.punctual[0].intensity.tolist() == [4, 4, 4]
    light = next(mesh for mesh in made.scene.meshes if mesh.name == "light")
    before = next(mesh for mesh in scene.meshes if mesh.name == "light")
    np.testing.assert_array_equal(light.radiance, before.radiance * 2)


def test_a_room_that_they_alone_light(scene):
    dark = replace(scene, meshes=[replace(mesh, radiance=None) for mesh in scene.meshes])
    assert changed(dark, bulb=False).scene.features.has_light
    with pytest.raises(InputError, match="it leaves no light in the scene"):
        changed(dark, **{"*": False})


@pytest.mark.parametrize(
    ("lamps", "sentence"),
    [
        ({"bulb": {"radiance": [1, 1, 1]}}, "bulb is a point light and has no radiance; give a scale"),
        ({"sun": {"move": [1, 0, 0]}}, "sun is a directional light, which has no place to move from"),
        ({"bulb": 1e17}, "the intensity of bulb then is 2e"),
    ],
)
def test_what_cannot_be_done(scene, lamps, sentence):
    with pytest.raises(InputError, match=sentence):
        changed(scene, **lamps)


def test_another_light_is_told_from_the_one_of_a_fit(scene):
    kept = light_of(scene)
    assert light_changes(kept, scene) == []
    made = changed(scene, bulb=2, sun=False).scene
    assert light_changes(kept, made) == ["light bulb 4, 4, 4 instead of 2, 2, 2", "light sun off instead of 1, 1, 1"]
    turned = replace(scene.punctual[1], direction=np.float32([0, -1, 0.1]))
    assert light_changes(kept, replace(scene, punctual=(scene.punctual[0], turned))) == ["light sun moved or turned"]
    assert light_changes(kept, replace(scene, punctual=()))[0] == "light bulb off instead of 2, 2, 2"


# ---- an edited scene in Mitsuba 3 looks as it does here: lamps, environment, materials and things that are put in


SIZE, SPP, PARTS = 16, 64, 8


def test_the_same_edit_in_mitsuba(mi, tmp_path):
    """A Cornell box without its ceiling under a sky that differs all round: both renderers' means of a view and of its
    quarters agree within five standard errors of theirs, which several passes tell, and within 2 %.
    """
    sky = np.random.default_rng(3).random((6, 12, 3), np.float32) ** 4 * 3.0
    write_exr(tmp_path / "sky.exr", sky, half=False)
    trimesh.creation.icosphere(2).export(tmp_path / "ball.glb")
    scene = build("cornell")
    scene = replace(scene, meshes=[m for m in scene.meshes if m.name != "ceiling"])
    ball = {"file": "ball.glb", "at": [0.3, -0.4, 0.2], "size": 0.6, "albedo": [0.8, 0.3, 0.1], "roughness": 0.3}
    tree = {
        "lamps": {"light": {"color": [1.0, 0.5, 0.2], "scale": 0.3, "move": [0.3, -0.2, 0.1]}},
        "environment": {"file": "sky.exr", "turn": 70},
        "materials": {"floor": {"albedo": [0.2, 0.6, 0.3]}},
        "objects": [ball],
    }
    made = edited(scene, edit_of(tree, folder=tmp_path)).scene
    view = made.test[0]
    view = replace(view, camera=replace(view.camera, width=SIZE, height=SIZE))
    theirs = to_mitsuba(made, view, SIZE, SPP)
    other = np.stack([np.asarray(mi.render(theirs, spp=SPP, seed=i))[..., :3] for i in range(PARTS)])
    tracer = paths(made)
    ours = np.stack([render(view.camera, tracer, SPP, i) for i in range(PARTS)])
    half = SIZE // 2
    for rows, columns in ((0, 0), (0, half), (half, 0), (half, half)):
        a, b = (x[:, rows : rows + half, columns : columns + half].mean((1, 2)) for x in (ours, other))  # [PARTS, 3]
        error = np.hypot(a.std(0, ddof=1), b.std(0, ddof=1)) / np.sqrt(PARTS)
        assert (np.abs(a.mean(0) - b.mean(0)) < 5.0 * error + 0.005 * b.mean(0)).all()
    assert ours.mean() == pytest.approx(other.mean(), rel=0.02)


# ---- paths of cameras: where they are and what they look at


UP = np.array([0.0, 1.0, 0.0])


def camera(x=0.0, y=1.0, z=3.0, fov=0.8):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return Camera(pose, fov, 16, 12)


def test_a_turntable_keeps_its_distance_and_looks_at_the_middle():
    middle = np.array([0.5, 0.0, 0.0])
    made = path_of("turntable", [camera()], 8, UP, middle)
    eyes = np.array([c.to_world[:3, 3] for c in made])
    np.testing.assert_allclose(np.linalg.norm(eyes - middle, axis=1), np.linalg.norm([-0.5, 1.0, 3.0]))
    np.testing.assert_allclose(eyes[:, 1], 1.0)
    for c, eye in zip(made, eyes, strict=True):
        ahead = -c.to_world[:3, 2]
        np.testing.assert_allclose(ahead, (middle - eye) / np.linalg.norm(middle - eye), atol=1e-12)
        np.testing.assert_allclose(c.to_world[:3, :3].T @ c.to_world[:3, :3], np.eye(3), atol=1e-12)
        assert c.to_world[1, 0] == pytest.approx(0.0, abs=1e-12)  # upright
    np.testing.assert_allclose(eyes[0], [0.0, 1.0, 3.0])
    np.testing.assert_allclose(eyes[0] + eyes[4], 2 * middle + [0, 2, 0], atol=1e-12)
    with pytest.raises(InputError, match="right above or below"):
        path_of("turntable", [camera(0.5, 2.0, 0.0)], 8, UP, middle)


def test_a_pan_stays_where_it_is():
    made = path_of("pan", [camera()], 4, UP, [9, 9, 9])
    np.testing.assert_allclose([c.to_world[:3, 3] for c in made], [[0, 1, 3]] * 4, atol=1e-12)
    np.testing.assert_allclose(-made[1].to_world[:3, 2], [-1, 0, 0], atol=1e-12)  # counterclockwise from above


def test_a_flight_passes_all_cameras_at_an_even_pace():
    turned = camera(3.0, 1.0, 0.0, 1.0)
    turned.to_world[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    cameras = [camera(), camera(1.0, 1.5, 2.0), turned]
    made = path_of("fly", cameras, 101, UP, np.zeros(3))
    eyes = np.array([c.to_world[:3, 3] for c in made])
    np.testing.assert_allclose(made[0].to_world, cameras[0].to_world, atol=1e-6)
    np.testing.assert_allclose(made[-1].to_world, turned.to_world, atol=1e-6)
    assert np.linalg.norm(eyes - [1.0, 1.5, 2.0], axis=1).min() < 0.05
    assert made[-1].fov_x == pytest.approx(1.0)
    for c in made:
        np.testing.assert_allclose(c.to_world[:3, :3].T @ c.to_world[:3, :3], np.eye(3), atol=1e-6)
    turns = np.array([np.linalg.norm(a.to_world[:3] - b.to_world[:3]) for a, b in pairwise(made)])
    assert turns.max() < 3 * turns.min()
    with pytest.raises(InputError, match="two cameras or more"):
        path_of("fly", [camera()], 5, UP, np.zeros(3))
