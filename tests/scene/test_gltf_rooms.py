"""Rooms of other people as glTF: the shared ones, written by the tests' own writer, and the files that assimp is tested
with.
"""

import math
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
    """The extension for a transform that scales, turns and moves."""
    if isinstance(texture, Constant):
        return {}
    m = texture.to_uv.astype(float)
    angle, x = math.atan2(-m[1, 0], m[0, 0]), math.hypot(m[0, 0], m[1, 0])
    y = np.linalg.det(m[:2, :2]) / x
    np.testing.assert_allclose(m[:2, 1], [y * math.sin(angle), y * math.cos(angle)], atol=1e-5)
    about = {"scale": [x, y], "rotation": angle, "offset": m[:2, 2].tolist()}
    return {"extensions": {"KHR_texture_transform": about}}


def shown(material):
    """What glTF can say of a material: it has no roughness of vertices, and its conductors have no index."""
    if isinstance(material.roughness, VertexAttribute):
        material = replace(material, roughness=Constant(np.full(1, 0.5, np.float32)))
    kept = isinstance(material.model, (PrincipledModel, DiffuseModel))
    return material if kept else replace(material, model=PrincipledModel())


def written(scene, path):
    """A room as glTF, below a node that turns, scales and moves it, in coordinates that this undoes."""
    document = Document()
    materials = {}
    for mesh in scene.meshes:
        key = mesh.material, None if mesh.radiance is None else tuple(mesh.radiance.tolist())
        if key in materials:
            continue
        material = scene.materials[mesh.material]
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
        if key[1] is not None and (most := max(key[1])) > 0:
            described["emissiveFactor"] = [x / most for x in key[1]]
            described["extensions"]["KHR_materials_emissive_strength"] = {"emissiveStrength": most}
        materials[key] = document.add("materials", described)
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
        key = mesh.material, None if mesh.radiance is None else tuple(mesh.radiance.tolist())
        made = document.mesh(attributes, wide, material=materials[key])
        children.append(document.node(root=False, name=mesh.name, mesh=made))
    document.node(children=children, matrix=turn.T.ravel().tolist())
    return document.glb(path)


def picture(scene, view, seed=0, spp=16):
    """A small picture by paths of at most six vertices."""
    world = build_world(scene)
    with torch.no_grad():
        tracer = path_tracer(world, TrueMaterials(scene, world.geometry), 6, 8)
        return render(replace(view.camera, width=24, height=24), tracer, spp, seed).numpy()


@pytest.mark.slow
@pytest.mark.parametrize("room", ["veach-ajar", "staircase", "living-room-2", "kitchen", "bunny"])
def test_shared_rooms(room, tmp_path):
    """Triangles and lamps as in ``scene.xml`` to what float32 keeps, and the same picture but for its noise."""
    pytest.importorskip("mitsuba")
    if not (ROOMS / room).is_dir():
        pytest.skip("the shared scenes are not here")
    scene = read_folder(ROOMS / room)
    scene = replace(scene, materials=[shown(material) for material in scene.materials])
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
    first, other, second = picture(scene, view), picture(scene, view, 1), picture(again, view)
    noise = np.abs(other - first).mean()
    assert np.abs(second - first).mean() < 1.2 * noise + 0.01 * first.mean()
    assert second.mean() == pytest.approx(
        first.mean(), abs=float(0.02 * first.mean() + 3 * noise / math.sqrt(first.size))
    )


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
