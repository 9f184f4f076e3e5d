"""Rooms of other people as glTF: the shared ones, written by the tests' own writer, and the files that assimp is tested
with.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.gltf_writer import Document

from neurad.assembly.build import build_world
from neurad.core.errors import InputError
from neurad.core.records import Bitmap, Constant, VertexAttribute
from neurad.core.reflection import DiffuseModel, PrincipledModel
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.scene.image_io import to_srgb
from neurad.scene.load import read_folder
from neurad.scene.readers.gltf import read_gltf
from neurad.scene.readers.gltf_scene import read_scene
from neurad.scene.textures import TrueMaterials

ROOMS = Path(__file__).resolve().parents[3] / "shared" / "scenes"
ASSIMP = Path(os.environ.get("NEURAD_ASSIMP", "/usr/share/assimp/models"))
"""Where Debian's assimp-testmodels puts its files, or where they lie instead."""


def coded(texture, srgb):
    """A texture as bytes [h, w, 3]."""
    pixels = texture.pixels if isinstance(texture, Bitmap) else texture.value.reshape(1, 1, -1)
    pixels = np.broadcast_to(pixels, (*pixels.shape[:2], 3))
    return np.rint((to_srgb(pixels) if srgb else np.clip(pixels, 0, 1)) * 255).astype(np.uint8)


def moved(texture):
    """The extension for a transform without a turn."""
    if isinstance(texture, Constant):
        return {}
    to_uv = texture.to_uv.astype(float)
    assert to_uv[0, 1] == to_uv[1, 0] == 0
    scale, offset = [to_uv[0, 0], to_uv[1, 1]], to_uv[:2, 2].tolist()
    return {"extensions": {"KHR_texture_transform": {"scale": scale, "offset": offset}}}


def written(scene, path):
    """A room as glTF, below a node that turns, mirrors, scales and moves it, in coordinates that this undoes."""
    document = Document()
    materials = []
    emitted = {mesh.material: mesh.radiance for mesh in scene.meshes if mesh.radiance is not None}
    for index, material in enumerate(scene.materials):
        surface = {"metallicFactor": getattr(material.model, "metallic", 0.0)}
        if not isinstance(material.albedo, VertexAttribute):
            surface["baseColorTexture"] = {**document.texture(coded(material.albedo, True)), **moved(material.albedo)}
        rough = coded(material.roughness, False)
        rough[..., 2] = 255
        surface["metallicRoughnessTexture"] = {**document.texture(rough), **moved(material.roughness)}
        described = {"pbrMetallicRoughness": surface, "extensions": {}}
        if isinstance(material.model, DiffuseModel):
            described["extensions"]["KHR_materials_specular"] = {"specularFactor": 0}
        elif isinstance(material.model, PrincipledModel):
            described["extensions"]["KHR_materials_ior"] = {"ior": material.model.eta}
        if index in emitted and (most := float(emitted[index].max())) > 0:
            described["emissiveFactor"] = (emitted[index] / most).astype(float).tolist()
            described["extensions"]["KHR_materials_emissive_strength"] = {"emissiveStrength": most}
        materials.append(document.add("materials", described))
    turn = np.array([[0, 0, -2.0, 1], [0, 2, 0, -3], [2, 0, 0, 5], [0, 0, 0, 1]])
    children = []
    for mesh in scene.meshes:
        local = (mesh.vertices - turn[:3, 3]) @ np.linalg.inv(turn[:3, :3]).T
        attributes = {"POSITION": document.accessor(local)}
        if mesh.normals is not None:
            attributes["NORMAL"] = document.accessor(mesh.normals @ turn[:3, :3] / 2)
        if isinstance(albedo := scene.materials[mesh.material].albedo, VertexAttribute):
            attributes["COLOR_0"] = document.accessor(mesh.attributes[albedo.name])
        bary = np.zeros((len(local), 2))
        attributes["TEXCOORD_0"] = document.accessor(bary if mesh.uvs is None else mesh.uvs)
        wide = document.accessor(mesh.faces.ravel(), "u4")
        made = document.mesh(attributes, wide, material=materials[mesh.material])
        children.append(document.node(root=False, name=mesh.name, mesh=made))
    document.node(children=children, matrix=turn.T.ravel().tolist())
    return document.glb(path)


def picture(scene, view, spp=16):
    """A small picture by paths of at most six vertices."""
    world = build_world(scene)
    with torch.no_grad():
        tracer = path_tracer(world, TrueMaterials(scene, world.geometry), 6, 8)
        return render(replace(view.camera, width=24, height=24), tracer, spp, 0).numpy()


@pytest.mark.slow
@pytest.mark.parametrize("room", ["veach-ajar", "staircase", "living-room-2", "kitchen", "bunny"])
def test_shared_rooms(room, tmp_path):
    """Triangles and lamps as in ``scene.xml`` to what float32 keeps, and the same picture."""
    pytest.importorskip("mitsuba")
    if not (ROOMS / room).is_dir():
        pytest.skip("the shared scenes are not here")
    scene = read_folder(ROOMS / room)
    if any(m.model.is_delta or m.model.unsupported for m in scene.materials):
        opaque = [
            replace(m, model=PrincipledModel()) if m.model.is_delta or m.model.unsupported else m
            for m in scene.materials
        ]
        scene = replace(scene, materials=opaque)
    again = read_scene(written(scene, tmp_path / "room.glb"))
    again = replace(again, environment=scene.environment)
    extent = float(np.ptp(scene.bounds, axis=0).max())
    assert [len(mesh.faces) for mesh in again.meshes] == [len(mesh.faces) for mesh in scene.meshes]
    for mesh, found in zip(scene.meshes, again.meshes, strict=True):
        corners, there = mesh.vertices[mesh.faces], found.vertices[found.faces]
        assert np.abs(corners - there).max() < 1e-6 * extent
        if mesh.radiance is not None:
            np.testing.assert_allclose(mesh.radiance, found.radiance, rtol=1e-6)
    np.testing.assert_allclose(scene.bounds, again.bounds, atol=1e-6 * extent)
    view = (*scene.test, *scene.train)[0]
    first, second = picture(scene, view), picture(again, view)
    assert second.mean() == pytest.approx(first.mean(), rel=0.02)
    assert np.abs(second - first).mean() < 0.05 * first.mean()


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
