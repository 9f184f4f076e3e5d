"""``scene.glb`` of the built-in patterned kitchen as others read it: Khronos' validator, trimesh and Open3D."""

import json
import math

import numpy as np
import pytest
import torch
from helpers.exported import Glb

from neurad.core.camera import project, to_camera


@pytest.fixture(scope="module")
def glb(kitchen_room):
    return Glb(kitchen_room / "scene.glb")


@pytest.fixture(scope="module")
def sizes(kitchen_room):
    """Width and height of the textures of each mesh."""
    notes = json.loads((kitchen_room / "room.json").read_text())
    return {mesh["name"]: (mesh["texture"]["width"], mesh["texture"]["height"]) for mesh in notes["meshes"]}


def test_the_validator_finds_nothing(kitchen_room, validator):
    report = validator.report(kitchen_room / "scene.glb")
    assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0, report["issues"]["messages"]
    assert report["info"]["drawCallCount"] == 73
    assert report["info"]["hasTextures"]


def test_materials_are_those_of_the_input(kitchen, glb):
    for mesh, (name, _, material) in zip(kitchen.meshes, glb.meshes(), strict=True):
        described = kitchen.materials[mesh.material]
        assert material.get("doubleSided", False) == described.two_sided, name
        factor = np.array(material.get("emissiveFactor", (0, 0, 0)))
        strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1)
        radiance = np.zeros(3, np.float32) if mesh.radiance is None else mesh.radiance
        assert np.array_equal((factor * strength).astype(np.float32), radiance), name
        if radiance.max() > 0:
            assert factor.max() == 1.0


def turned(quaternion):
    """The matrix [3, 3] of a unit quaternion (x, y, z, w), each column by its definition q v q*."""
    v, w = np.array(quaternion[:3]), quaternion[3]
    axes = [e + 2 * np.cross(v, np.cross(v, e) + w * e) for e in np.eye(3)]
    return np.stack(axes, 1)


def test_cameras_see_points_where_ours_do(kitchen, glb):
    points = np.random.default_rng(0).uniform(*kitchen.bounds, (500, 3))
    views = (*kitchen.train, *kitchen.test)
    nodes = [node for node in glb.json["nodes"] if "camera" in node]
    assert [node["name"] for node in nodes] == [view.name for view in views]
    for node, view in zip(nodes, views, strict=True):
        lens = glb.json["cameras"][node["camera"]]["perspective"]
        x, y, z = ((points - node["translation"]) @ turned(node["rotation"])).T
        before = z < -lens["znear"]
        focal = 1.0 / math.tan(0.5 * lens["yfov"])
        ndc = np.stack((focal / lens["aspectRatio"] * x / -z, focal * y / -z), -1)[before]
        film = (ndc * (0.5, -0.5) + 0.5) * (view.camera.width, view.camera.height)
        ours = project(view.camera, to_camera(view.camera, torch.from_numpy(points)))[before]
        assert np.abs(film - ours.numpy()).max() < 1e-6 * np.abs(film).max()


def test_trimesh_loads_it(kitchen, kitchen_room, sizes):
    import trimesh

    loaded = trimesh.load(kitchen_room / "scene.glb", process=False)
    assert len(loaded.geometry) == len(kitchen.meshes)
    assert np.allclose(loaded.bounds, kitchen.bounds, atol=1e-6)
    assert loaded.geometry.keys() == sizes.keys()
    for name, geometry in loaded.geometry.items():
        material = geometry.visual.material
        assert material.baseColorTexture.size == material.metallicRoughnessTexture.size == sizes[name]
        assert geometry.visual.uv.shape == (len(geometry.vertices), 2)
        assert 0 < geometry.visual.uv.min() < geometry.visual.uv.max() < 1


def test_open3d_loads_it(kitchen, kitchen_room, sizes):
    open3d = pytest.importorskip("open3d")
    model = open3d.io.read_triangle_model(str(kitchen_room / "scene.glb"))
    assert len(model.meshes) == len(model.materials) == len(kitchen.meshes)
    for part, size in zip(model.meshes, sizes.values(), strict=True):
        material = model.materials[part.material_idx]
        assert np.asarray(material.albedo_img).shape == (*size[::-1], 3)
    low = np.min([np.asarray(part.mesh.vertices).min(0) for part in model.meshes], 0)
    high = np.max([np.asarray(part.mesh.vertices).max(0) for part in model.meshes], 0)
    assert np.allclose((low, high), kitchen.bounds, atol=1e-6)
