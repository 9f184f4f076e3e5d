"""Whole rooms as glTF by the tests' own writer."""

import math
from dataclasses import replace

import numpy as np

from helpers.gltf_writer import Document
from neurad.core.records import Bitmap, Constant, VertexAttribute
from neurad.core.reflection import DiffuseModel, PrincipledModel
from neurad.images.image_io import to_srgb


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


def written(scene, path, views=()):
    """A room and the cameras of views as glTF, below a node that turns, scales and moves them, in coordinates that this
    undoes.
    """
    document = Document()
    materials = {}
    for mesh in scene.meshes:
        key = mesh.material, None if mesh.radiance is None else tuple(mesh.radiance.tolist())
        if key in materials:
            continue
        material = scene.materials[mesh.material]
        surface = {"metallicFactor": float(material.metallic.value[0])}
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
    for view in views:
        camera = view.camera
        lens = {"yfov": 2 * math.atan(0.5 * camera.height / camera.fl_y), "aspectRatio": camera.width / camera.height}
        made = document.add("cameras", {"type": "perspective", "perspective": {**lens, "znear": 0.01}})
        pose = (np.linalg.inv(turn) @ camera.to_world).T.ravel().tolist()
        children.append(document.node(root=False, name=view.name, camera=made, matrix=pose))
    document.node(children=children, matrix=turn.T.ravel().tolist())
    return document.glb(path)
