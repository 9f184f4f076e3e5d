"""``scene.xml``, ``scene.glb`` and the camera files of an export keep what the scene said."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.delta_scenes import delta_gallery, window_room
from helpers.exported import Glb, assembled, exported
from helpers.object_scene import object_scene, photographed, sky
from helpers.pathtraced import picture
from helpers.tiny_scene import as_png, read_json, write_json, write_scene
from PIL import Image

from neurad.core.lens import Lens
from neurad.core.reflection import ConductorModel, DielectricModel, DiffuseModel, PrincipledModel, RoughPlasticModel
from neurad.core.scene_records import Camera, EnvironmentMap, PunctualLight, View
from neurad.export.verify import _photograph
from neurad.formats.cameras.nerf import read_views
from neurad.formats.cameras.write import named_apart, shown_alike, write_views
from neurad.formats.gltf.read import read_scene
from neurad.formats.load import load_scene
from neurad.formats.mitsuba.read import read_xml
from neurad.images.image_io import read_exr, to_srgb, write_exr
from neurad.scene.builtin import build_cornell
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials

pytest.importorskip("xatlas")
pytest.importorskip("mitsuba")

TURN = np.array([[0, 0, 1, 0], [0.6, 0.8, 0, 0], [-0.8, 0.6, 0, 0], [0, 0, 0, 1]], np.float32)


def read_again(scene, folder, **settings):
    return read_xml(exported(scene, folder / "room", **settings) / "scene.xml").check()


def both(scene, folder, **settings):
    """An exported folder read by its ``scene.xml``, and without it."""
    room = exported(scene, folder / "room", target="exact", **settings)
    views = {"train": scene.train, "test": scene.test}
    return replace(read_xml(room / "scene.xml"), **views), replace(read_scene(room / "scene.glb"), **views)


def same_room(by_xml, by_glb):
    """Triangles, lamps, bounds, lights and depths to the bit; colours to half a step of 8 bits."""
    assert len(by_xml.meshes) == len(by_glb.meshes)
    for one, other in zip(by_xml.meshes, by_glb.meshes, strict=True):
        np.testing.assert_array_equal(one.vertices[one.faces], other.vertices[other.faces])
        assert (one.radiance is None) == (other.radiance is None)
        if one.radiance is not None:
            np.testing.assert_allclose(one.radiance, other.radiance, rtol=1e-6)
        if one.normals is not None:
            np.testing.assert_allclose(one.normals[one.faces], other.normals[other.faces], atol=1e-6)
        surface, found = by_xml.materials[one.material], by_glb.materials[other.material]
        assert surface.two_sided == found.two_sided
        assert surface.model == found.model
    np.testing.assert_array_equal(by_xml.bounds, by_glb.bounds)
    one, other = surfaces(by_xml), surfaces(by_glb)
    assert np.abs(to_srgb(one.albedo.numpy()) - to_srgb(other.albedo.numpy())).max() < 0.51 / 255
    if not by_xml.features.is_diffuse:
        assert float((one.roughness - other.roughness).abs().max()) < 0.51 / 255
    assert (by_xml.max_depth, by_xml.rr_depth) == (by_glb.max_depth, by_glb.rr_depth)


def surfaces(scene):
    """Albedo and roughness at a point of each triangle."""
    geometry = Geometry(scene)
    prim = torch.arange(len(geometry.faces))
    u, v = torch.rand(2, len(prim), generator=torch.Generator().manual_seed(1)) / 2
    wo = torch.tensor([[0.0, 1.0, 0.0]]).expand(len(prim), 3)
    return TrueMaterials(scene, geometry)(geometry.interact_at(prim, u, v, wo, torch.ones(len(prim), dtype=torch.bool)))


def shown(scene):
    """The first view; the same seed draws the same random numbers."""
    return picture(scene, scene.test[0].camera, 16, size=24)


def test_a_constant_emitter(mi, tmp_path):
    radiance = np.array([1.0, 0.5, 0.25], np.float32)
    environment = EnvironmentMap(np.broadcast_to(radiance, (2, 4, 3)).copy())
    scene = object_scene(environment)
    again = read_again(scene, tmp_path)
    assert np.array_equal(again.environment.pixels.max((0, 1)), radiance)
    assert np.array_equal(again.environment.pixels.min((0, 1)), radiance)
    theirs = np.array(mi.render(mi.load_file(str(tmp_path / "room/scene.xml")), spp=16))[..., :3]
    assert np.allclose(theirs[0, 0], radiance, rtol=1e-3)  # past the floor
    ours = picture(again, scene.test[0].camera, 16)
    assert np.allclose(ours.mean((0, 1)), theirs.mean((0, 1)), rtol=0.05)


def test_mirrors_and_glass(tmp_path):
    scene = delta_gallery()
    again, by_glb = both(scene, tmp_path)
    same_room(again, by_glb)
    for mesh, found in zip(scene.meshes, again.meshes, strict=True):
        material, read = scene.materials[mesh.material], again.materials[found.material]
        assert type(read.model) is type(material.model)
        assert read.two_sided == material.two_sided
        if isinstance(material.model, DielectricModel):
            assert read.model.eta == pytest.approx(material.model.eta)
            assert not read.model.thin
        if isinstance(material.model, ConductorModel):
            assert np.allclose(read.albedo.value, material.albedo.value, atol=1e-6)
    described = {name: material for name, _, material in Glb(tmp_path / "room/scene.glb").meshes()}
    glass = [m for m in described.values() if "KHR_materials_transmission" in m.get("extensions", {})]
    assert len(glass) == 2
    assert all(m["extensions"]["KHR_materials_ior"]["ior"] == pytest.approx(1.5) for m in glass)


def test_a_thin_pane_has_no_volume(tmp_path):
    scene = window_room(thin=True)
    again, by_glb = both(scene, tmp_path)
    for read in (again, by_glb):
        assert [m.model.thin for m in read.materials if isinstance(m.model, DielectricModel)] == [True]


def test_glass_in_something_denser_has_an_index_that_gltf_allows(tmp_path, validator):
    scene = delta_gallery()
    wet = [
        replace(m, model=DielectricModel(1 / 1.33)) if isinstance(m.model, DielectricModel) else m
        for m in scene.materials
    ]
    room = exported(replace(scene, materials=wet), tmp_path / "room")
    assert validator.issues(room / "scene.glb") == []
    read = [m.model for m in read_xml(room / "scene.xml").materials]
    assert [m.eta for m in read if isinstance(m, DielectricModel)] == pytest.approx([1 / 1.33] * 2)


@pytest.mark.parametrize("depth", [5, 2**31 - 1])
def test_a_lambertian_scene_and_the_depths(tmp_path, depth):
    scene = replace(build_cornell(), max_depth=depth, rr_depth=3)
    again = read_again(scene, tmp_path)
    assert again.features.is_diffuse
    assert {type(m.model) for m in again.materials} == {DiffuseModel}
    assert (again.max_depth, again.rr_depth) == (depth, 3)
    lamp, found = (next(m for m in s.meshes if m.radiance is not None) for s in (scene, again))
    assert np.array_equal(lamp.radiance, found.radiance)


def test_what_a_fit_recovers_is_principled_and_sides_stay(tmp_path):
    scene = object_scene(sky(), RoughPlasticModel(1.5, 0.1))
    one_sided = [replace(material, two_sided=False) for material in scene.materials]
    again = read_again(replace(scene, materials=one_sided), tmp_path)
    assert {m.model for m in again.materials} == {PrincipledModel()}
    assert not any(m.two_sided for m in again.materials)
    assert not any("doubleSided" in m for _, _, m in Glb(tmp_path / "room/scene.glb").meshes())


@pytest.mark.parametrize("unit", [0.03, 1e5])
def test_the_length_of_the_unit_does_not_matter(mi, tmp_path, unit):
    """Light knows no lengths: Mitsuba shows a scene of another unit as before; below 1e-2 its own ray offsets show."""
    scene, means = build_cornell(), []
    for factor in (1.0, unit):
        meshes = [replace(mesh, vertices=mesh.vertices * np.float32(factor)) for mesh in scene.meshes]
        views = []
        for view in scene.test:
            pose = np.array(view.camera.to_world)
            pose[:3, 3] *= factor
            views.append(replace(view, camera=replace(view.camera, to_world=pose)))
        room = exported(replace(scene, meshes=meshes, train=views, test=views), tmp_path / f"{factor:g}")
        loaded = mi.load_file(str(room / "scene.xml"))
        means.append([np.array(mi.render(loaded, sensor=i, spp=8, seed=i)).mean() for i in range(len(views))])
    assert min(means[0]) > 0
    assert means[1] == pytest.approx(means[0], rel=0.02)


@pytest.mark.parametrize("copy", [False, True])
def test_photographs_with_alpha_and_a_second_light(tmp_path, copy):
    scene = photographed(object_scene(sky()), tmp_path, spp=1, relit=sky(seed=1))
    room = exported(scene, tmp_path / "room", hide_environment=True, copy=copy)
    again = load_scene(str(room), None)
    for before, after in zip((*scene.train, *scene.test), (*again.train, *again.test), strict=True):
        assert (before.name, before.camera.fov_x) == (after.name, after.camera.fov_x)
        assert np.array_equal(before.camera.to_world, after.camera.to_world)
        assert before.files.keys() == after.files.keys()
        for kind, file in before.files.items():
            assert np.array_equal(read_exr(file), read_exr(after.files[kind])), kind
    assert (scene.relight is None) == (again.relight is None)
    links = [path for path in room.rglob("*.exr") if path.is_symlink()]
    assert bool(links) is not copy
    assert json.loads((room / "room.json").read_text())["hide_environment"]


def pose(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 0.1], [0, 1, 0, 0.2], [-s, 0, c, 0.3], [0, 0, 0, 1]])


def test_every_view_keeps_its_own_angle(tmp_path):
    views = [View(f"v{i}", Camera(pose(i), fov, 12, 8), str(tmp_path / "x.exr")) for i, fov in enumerate((0.5, 0.9))]
    (tmp_path / "x.exr").touch()
    write_views(replace(build_cornell(), train=views, test=[]), tmp_path, copy=True)
    again = read_views(tmp_path / "transforms_train.json", tmp_path)
    for before, after in zip(views, again, strict=True):
        assert (before.camera.fov_x, before.camera.width, before.camera.height) == (after.camera.fov_x, 12, 8)
        assert np.array_equal(before.camera.to_world, after.camera.to_world)


def test_lenses_that_others_do_not_have_stay_in_the_camera_files(mi, tmp_path, capfd):
    """A room with a camera that distorts: other programs get the plain ones, which are compared; masks come along."""
    scene = build_cornell()
    bent = replace(scene.test[0], camera=replace(scene.test[0].camera, lens=Lens(numerator=(-0.1,))))
    mask = tmp_path / "mask.PNG"
    Image.new("L", (scene.test[1].camera.width, scene.test[1].camera.height), 255).save(mask)
    scene = replace(scene, test=[bent, replace(scene.test[1], mask=str(mask))])
    assert [view.name for view in shown_alike(scene)] == [scene.test[1].name]
    room = exported(scene, tmp_path / "room")
    assert len(mi.load_file(str(room / "scene.xml")).sensors()) == 1
    names = [camera["name"] for camera in Glb(room / "scene.glb").json["cameras"]]
    assert bent.name not in names
    assert scene.test[1].name in names
    again = load_scene(str(room), None).test
    assert again[0].camera.lens == bent.camera.lens
    assert Path(again[1].mask).read_bytes() == mask.read_bytes()
    left_out = json.loads((room / "room.json").read_text())["left_out"]
    assert any("1 cameras: other programs' cameras" in note for note in left_out)
    exported(replace(scene, train=[bent], test=[]), tmp_path / "only", verify=True)
    assert "nothing is rendered again: other programs' cameras have no lens distortion" in capfd.readouterr().err


def test_views_without_photographs_keep_their_cameras(tmp_path):
    bare = object_scene(sky())
    assert write_views(bare, tmp_path, copy=False) == ["train", "test"]
    for part in ("train", "test"):
        described = json.loads((tmp_path / f"transforms_{part}.json").read_text())
        views = getattr(bare, part)
        assert [f["file_path"] for f in described["frames"]] == [f"images/{view.name}.exr" for view in views]
        found = [f["transform_matrix"] for f in described["frames"]]
        assert np.array_equal(found, [view.camera.to_world for view in views])
    assert not (tmp_path / "images").exists()


@pytest.mark.parametrize("name", ["r_0", "R_0", "x" * 57, "Küche\n", "ü" * 29])
def test_names_of_views_serve_as_those_of_files_and_cameras(name):
    scene = build_cornell()
    first = replace(scene, train=[replace(scene.train[0], name="r_0"), *scene.train[1:]])
    named = named_apart(replace(first, test=[replace(scene.test[0], name=name)]))
    assert [v.name for v in (named.train[0], named.test[0])] == ["train_000", "test_000"]
    assert named_apart(scene) is scene


def test_photographs_of_codes_are_verified_with_their_exposures(tmp_path):
    """PNG, each view twice as bright as the lights make it, which its exposure says."""
    folder = write_scene(tmp_path / "source")
    first = load_scene(str(folder), None)
    truth = {view.name: read_exr(view.image)[..., :3].mean() for view in first.test}
    as_png(folder, 2.0)
    for part in ("train", "test"):
        described = read_json(folder, part)
        write_json(folder, part, {**described, "frames": [{**f, "exposure": 2.0} for f in described["frames"]]})
    assembly = assembled(load_scene(str(folder), None))
    for view in assembly.scene.test:
        assert _photograph(view, assembly).mean() == pytest.approx(truth[view.name], rel=0.25)  # some are clipped
    room = exported(assembly.scene, tmp_path / "room", verify=True, spp=1)
    assert json.loads((room / "verify.json").read_text())["renderers"]["baked"]["psnr_below_white"] is not None


@pytest.mark.parametrize(
    ("scene", "hidden"),
    [(build_cornell(), "false"), (object_scene(sky()), "true"), (replace(build_cornell(), environment=sky()), "false")],
    ids=["lamps", "sky", "both"],
)
def test_mitsuba_hides_the_environment_and_no_lamp(tmp_path, scene, hidden):
    """Its switch leaves out both, which is said; photographs with alpha may be of a closed room."""
    room = exported(scene, tmp_path / "room", hide_environment=True)
    assert f'name="hide_emitters" value="{hidden}"' in (room / "scene.xml").read_text()
    said = [t for t in json.loads((room / "room.json").read_text())["left_out"] if "environment" in t]
    assert len(said) == (scene.environment is not None and hidden == "false")
    assert all("it shows the environment, which the photographs leave out" in t for t in said)


def test_the_spread_of_photographs_goes_along(tmp_path):
    """Without it what every exposure clipped would be fitted as it is."""
    folder = write_scene(tmp_path / "source")
    (folder / "spread").mkdir()
    scene = load_scene(str(folder), None)
    for view in scene.train:
        camera = view.camera
        spread = np.random.default_rng(1).random((camera.height, camera.width, 3), np.float32)
        write_exr(folder / f"spread/{view.name}.exr", spread, half=False)
    scene = load_scene(str(folder), None)
    assert all(view.spread for view in scene.train)
    again = load_scene(str(exported(scene, tmp_path / "room", copy=True)), None)
    for before, after in zip(scene.train, again.train, strict=True):
        np.testing.assert_array_equal(read_exr(before.spread), read_exr(after.spread))


def test_materials_and_meshes_may_have_each_others_names(tmp_path):
    """Labels of materials begin with a word that a mesh may begin with, too."""
    scene = build_cornell()
    names = ["wall", "material-wall", *(mesh.name for mesh in scene.meshes[2:])]
    meshes = [replace(mesh, name=name) for mesh, name in zip(scene.meshes, names, strict=True)]
    again = read_again(replace(scene, meshes=meshes), tmp_path)
    assert len(again.meshes) == len(meshes)


# ---- scene.glb reads back as the same room


@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_a_room_of_any_up(tmp_path, up):
    scene = object_scene(EnvironmentMap(sky(9, 16).pixels, TURN))
    by_xml, by_glb = both(scene, tmp_path, up=up)
    same_room(by_xml, by_glb)
    np.testing.assert_array_equal(by_xml.environment.pixels, by_glb.environment.pixels)
    np.testing.assert_allclose(by_xml.environment.to_world, by_glb.environment.to_world, atol=1e-6)
    if up == "y":
        np.testing.assert_array_equal(by_xml.environment.pixels, scene.environment.pixels)
        np.testing.assert_allclose(by_xml.environment.to_world, TURN, atol=1e-6)
        notes = json.loads((tmp_path / "room/room.json").read_text())
        assert notes["environment"] == {"file": "environment.exr", "to_world": TURN[:3, :3].tolist()}
        for mesh, found in zip(scene.meshes, by_xml.meshes, strict=True):
            assert (mesh.normals is None) == (found.normals is None)
            if mesh.normals is not None:
                np.testing.assert_allclose(mesh.normals[mesh.faces], found.normals[found.faces], atol=1e-6)
    first, second = shown(by_xml), shown(by_glb)
    assert np.abs(second - first).mean() < 0.01 * first.mean()


def test_a_room_with_a_lamp(tmp_path):
    by_xml, by_glb = both(build_cornell(), tmp_path)
    same_room(by_xml, by_glb)
    first, second = shown(by_xml), shown(by_glb)
    assert np.abs(second - first).mean() < 0.02 * first.mean()  # what 8 bits leave of colours, over many bounces


@pytest.mark.parametrize("up", ["y", "-z"])
def test_lights_without_extent(tmp_path, validator, up):
    side = np.array([0.6, -0.8, 0.0], np.float32)
    lights = (
        PunctualLight("bulb", "point", np.array([3, 2, 1], np.float32), np.array([0, 1, 0.5], np.float32)),
        PunctualLight("beam", "spot", np.array([9, 9, 9], np.float32), side, -side, 40.0, 30.0),
        PunctualLight("sun", "directional", np.array([1, 0.5, 0], np.float32), direction=side),
    )
    by_xml, by_glb = both(replace(build_cornell(), punctual=lights), tmp_path, up=up)
    assert validator.issues(tmp_path / "room/scene.glb") == []
    same_room(by_xml, by_glb)
    found = {light.name: light for light in by_glb.punctual}
    for light in by_xml.punctual:
        other = found[light.name]
        assert light.kind == other.kind
        np.testing.assert_allclose(light.intensity, other.intensity, rtol=1e-5)
        if light.kind != "directional":
            np.testing.assert_allclose(light.position, other.position, atol=1e-6)
        if light.kind != "point":
            np.testing.assert_allclose(light.direction, other.direction, atol=1e-6)
        if light.kind == "spot":
            angles = other.cutoff_angle, other.beam_width
            assert angles == pytest.approx((light.cutoff_angle, light.beam_width), rel=1e-5)


def test_colours_for_other_programs_are_said(tmp_path):
    room = exported(build_cornell(), tmp_path / "room", target="gltf")
    assert any("base colours were changed for gltf" in note for note in read_scene(room / "scene.glb").notes)


# ---- lights without extent, as other programs read them

LIGHTS = tuple(
    PunctualLight(name, kind, *(np.asarray(x, np.float32) for x in (rgb, at, along)), 50.0, 20.0)  # type: ignore[arg-type]
    for name, kind, rgb, at, along in (
        ("bulb", "point", (2, 1, 0.5), (0.1, 0.4, 0.2), (0, 0, 1)),
        ("beam", "spot", (1, 3, 2), (0.3, 0.9, -0.2), (0.6, -0.8, 0.0)),
        ("sun", "directional", (0.5, 0.5, 1), (0, 0, 0), (0, -0.6, -0.8)),
        ("off", "point", (0, 0, 0), (0, 0, 0), (0, 0, 1)),
    )
)


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    return exported(replace(build_cornell(), punctual=LIGHTS), tmp_path_factory.mktemp("export") / "room")


def test_the_notes_have_them_for_blender(lit):
    notes = json.loads((lit / "room.json").read_text())
    assert [light["name"] for light in notes["lights"]] == ["bulb", "beam", "sun"]
    assert notes["lights"][1]["intensity"] == [1.0, 3.0, 2.0]
    if (lit / "room.usdc").exists():
        assert any("room.usdc: it lacks 3 lights" in said for said in notes["left_out"])


def test_lights_of_one_name_are_told_apart_in_all_files(tmp_path):
    """Blender finds them by names, of which it keeps 63 bytes."""
    lights = tuple(replace(light, name=name) for light, name in zip(LIGHTS, ("lamp", "lamp", "x" * 80), strict=False))
    room = exported(replace(build_cornell(), punctual=lights), tmp_path / "room")
    listed = [light["name"] for light in json.loads((room / "room.json").read_text())["lights"]]
    assert len(set(listed)) == 3
    assert max(map(len, listed)) <= 56
    glb = Glb(room / "scene.glb").json["extensions"]["KHR_lights_punctual"]["lights"]
    assert [light["name"] for light in glb] == listed
    again = read_xml(room / "scene.xml")
    assert sorted(light.name for light in again.punctual) == sorted(listed)
