"""What ``neurad export`` writes as ``scene.glb`` reads back as the same room."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.delta_scenes import delta_gallery
from helpers.exported import exported
from helpers.object_scene import object_scene, sky
from helpers.pathtraced import picture

from neurad.core.records import EnvironmentMap, PunctualLight
from neurad.core.reflection import ConductorModel, DielectricModel
from neurad.formats.gltf.gltf_scene import read_scene
from neurad.formats.mitsuba.read import read_xml
from neurad.formats.usd.read import read_usd
from neurad.images.image_io import to_srgb
from neurad.scene.builtin import build_cornell
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials

pytest.importorskip("xatlas")
pytest.importorskip("mitsuba")

TURN = np.array([[0, 0, 1, 0], [0.6, 0.8, 0, 0], [-0.8, 0.6, 0, 0], [0, 0, 0, 1]], np.float32)


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


@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_a_room_of_any_up(tmp_path, up):
    scene = object_scene(EnvironmentMap(sky(9, 16).pixels, TURN))
    by_xml, by_glb = both(scene, tmp_path, up=up)
    same_room(by_xml, by_glb)
    np.testing.assert_array_equal(by_xml.environment.pixels, by_glb.environment.pixels)
    np.testing.assert_allclose(by_xml.environment.to_world, by_glb.environment.to_world, atol=1e-6)
    first, second = shown(by_xml), shown(by_glb)
    assert np.abs(second - first).mean() < 0.01 * first.mean()


def test_a_room_with_a_lamp(tmp_path):
    by_xml, by_glb = both(build_cornell(), tmp_path)
    same_room(by_xml, by_glb)
    first, second = shown(by_xml), shown(by_glb)
    assert np.abs(second - first).mean() < 0.02 * first.mean()  # what 8 bits leave of colours, over many bounces


@pytest.mark.parametrize("up", ["y", "-z"])
def test_lights_without_extent(tmp_path, up):
    side = np.array([0.6, -0.8, 0.0], np.float32)
    lights = (
        PunctualLight("bulb", "point", np.array([3, 2, 1], np.float32), np.array([0, 1, 0.5], np.float32)),
        PunctualLight("beam", "spot", np.array([9, 9, 9], np.float32), side, -side, 40.0, 30.0),
        PunctualLight("sun", "directional", np.array([1, 0.5, 0], np.float32), direction=side),
    )
    by_xml, by_glb = both(replace(build_cornell(), punctual=lights), tmp_path, up=up)
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


def test_usd_has_the_same_triangles_and_lamps(tmp_path):
    pytest.importorskip("pxr")
    room = exported(build_cornell(), tmp_path / "room")
    by_xml = read_xml(room / "scene.xml")
    found = {mesh.name: mesh for mesh in read_usd(room / "room.usdc").meshes}
    assert len(found) == len(by_xml.meshes)
    for mesh in by_xml.meshes:
        other = found[mesh.name.replace(" ", "_").replace("-", "_")]
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], other.vertices[other.faces])
        assert (mesh.radiance is None) == (other.radiance is None)
        if mesh.radiance is not None:
            np.testing.assert_allclose(mesh.radiance, other.radiance, rtol=1e-6)


def test_mirrors_and_glass(tmp_path):
    by_xml, by_glb = both(delta_gallery(), tmp_path)
    same_room(by_xml, by_glb)
    kinds = [type(by_glb.materials[mesh.material].model) for mesh in by_glb.meshes]
    assert kinds.count(DielectricModel) == kinds.count(ConductorModel) == 2


def test_colours_for_other_programs_are_said(tmp_path):
    room = exported(build_cornell(), tmp_path / "room", target="gltf")
    assert any("base colours were changed for gltf" in note for note in read_scene(room / "scene.glb").notes)
