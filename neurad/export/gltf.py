"""glTF 2.0 in one binary file: meshes, textures, lamps and cameras.

Written by hand, as no library at hand knows the extensions: ``KHR_materials_emissive_strength`` for lamps,
``KHR_materials_specular`` for surfaces without a coat, ``KHR_materials_ior`` and ``KHR_materials_transmission`` for
glass, ``KHR_lights_punctual`` for lights without extent.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import neurad
from neurad.core.records import Array, FloatArray
from neurad.core.reflection import DielectricModel, PrincipledModel, ReflectionModel
from neurad.core.scene_records import Mesh, PunctualLight, View
from neurad.export.bake import BakedRoom
from neurad.export.base_colour import Coded, Target, coded, conversion, smooth_colour, texture_files
from neurad.formats.axes import rotation
from neurad.formats.cameras.write import clip_planes, is_plain
from neurad.formats.gltf.glb import GlbWriter, Json
from neurad.runtime import threads
from neurad.scene.punctual import LUMENS_PER_WATT, pose

_PUNCTUAL = "KHR_lights_punctual"


def write_glb(room: BakedRoom, path: Path, target: Target, apart: bool, done: Callable[[int], None]) -> int:
    """Write a room as ``scene.glb``.

    Args:
        target: whose base colours it gets; stands in ``asset.extras``.
        apart: write its textures as files of their own, too, see :func:`neurad.export.base_colour.texture_files`.
        done: called with 1 for each mesh.

    Returns:
        Texels whose base colour was clipped to [0, 1].
    """
    part = path.with_name(path.name + ".bin")
    clipped = 0
    with part.open("wb") as buffer, ThreadPoolExecutor(threads.threads(len(room.names), 1)) as pool:
        glb = GlbWriter(buffer)
        pictures = pool.map(lambda index: _coded(room, index, target), range(len(room.names)))
        children = []
        for index, files in enumerate(pictures):
            children.append(_add_mesh(glb, room, index, files))
            clipped += files.clipped if files is not None else 0
            if apart and files is not None:
                for file, data in zip(texture_files(room.names[index]), (files.base, files.orm), strict=True):
                    (path.parent / file).write_bytes(data)
            done(1)
        views = [view for view in (*room.scene.train, *room.scene.test) if is_plain(view.camera)]
        children += [_add_camera(glb, room, view) for view in views]
        children += [_add_light(glb, light) for light in room.scene.punctual if light.intensity.any()]
        root: Json = {"name": "room", "children": children}
        if room.up != "y":
            root["rotation"] = _quaternion(rotation(room.up))
        if any(room.scene.origin):
            root["translation"] = (rotation(room.up) @ room.scene.origin).tolist()
        glb.json["scenes"] = [{"nodes": [glb.add("nodes", root)], "name": room.scene.name}]
        glb.json["scene"] = 0
        depths = {"max_depth": room.scene.max_depth, "rr_depth": room.scene.rr_depth}
        extras: Json = {"base_color_for": target, "up": room.up, **depths}
        if room.scene.environment is not None:
            turn = np.asarray(room.scene.environment.to_world, np.float64)[:3, :3]
            extras["environment_to_world"] = turn.ravel().tolist()
        glb.json["asset"] = {"version": "2.0", "generator": f"neurad {neurad.__version__}", "extras": extras}
    glb.finish(path, part)
    part.unlink()
    return clipped


def _coded(room: BakedRoom, index: int, target: Target) -> Coded | None:
    baked = room.baked[index]
    if baked is None:
        return None
    material = room.scene.materials[room.scene.meshes[index].material]
    return coded(baked.maps, *conversion(material, target))


def _add_mesh(glb: GlbWriter, room: BakedRoom, index: int, files: Coded | None) -> int:
    """Append a mesh, its material and its node; returns the number of the node."""
    mesh, name = room.scene.meshes[index], room.names[index]
    attributes = {"POSITION": glb.vertices(mesh.vertices, bounds=True)}
    if mesh.normals is not None:
        attributes["NORMAL"] = glb.vertices(unit_normals(mesh))
    if mesh.uvs is not None and files is not None:
        attributes["TEXCOORD_0"] = glb.vertices(mesh.uvs)
    primitive: Json = {
        "attributes": attributes,
        "indices": glb.triangles(mesh.faces, len(mesh.vertices)),
        "material": glb.add("materials", _material(glb, room, index, files)),
    }
    return glb.add("nodes", {"name": name, "mesh": glb.add("meshes", {"name": name, "primitives": [primitive]})})


def _material(glb: GlbWriter, room: BakedRoom, index: int, files: Coded | None) -> Json:
    mesh, name = room.scene.meshes[index], room.names[index]
    material = room.scene.materials[mesh.material]
    model = material.model
    surface: Json
    extensions: Json = {}
    if files is not None:
        surface = {
            "baseColorTexture": glb.texture(files.base, f"{name}_base_color"),
            "metallicRoughnessTexture": glb.texture(files.orm, f"{name}_orm"),
        }
    else:
        surface = {"baseColorFactor": [*np.clip(smooth_colour(material), 0.0, 1.0).tolist(), 1.0]}
    if model.is_delta:
        surface |= {"roughnessFactor": 0.0, "metallicFactor": 0.0 if isinstance(model, DielectricModel) else 1.0}
        if isinstance(model, DielectricModel):
            extensions["KHR_materials_transmission"] = {"transmissionFactor": 1.0}
            extensions["KHR_materials_ior"] = {"ior": _index(model.eta)}
            if not model.thin:
                sides = np.ptp(mesh.vertices, axis=0)
                extensions["KHR_materials_volume"] = {
                    "thicknessFactor": float(sides[sides > 0].min(initial=sides.max()))
                }
    else:
        extensions |= coat(model)
    described: Json = {"name": name, "pbrMetallicRoughness": surface}
    if material.two_sided and "KHR_materials_volume" not in extensions:
        described["doubleSided"] = True
    if mesh.radiance is not None and mesh.radiance.max() > 0:
        described["emissiveFactor"], extensions["KHR_materials_emissive_strength"] = emission(mesh.radiance)
        described["extras"] = {"emits_to": "the side of the geometric normal"}
    if extensions:
        described["extensions"] = extensions
        glb.extensions |= extensions.keys()
    return described


def coat(model: ReflectionModel) -> Json:
    """The extensions by which a surface has the coat of a model, or none."""
    if model.is_diffuse:
        return {"KHR_materials_specular": {"specularFactor": 0.0}}
    if isinstance(model, PrincipledModel) and model.eta != 1.5:
        return {"KHR_materials_ior": {"ior": _index(model.eta)}}
    return {}


def emission(radiance: FloatArray) -> tuple[list[float], Json]:
    """``emissiveFactor`` and ``KHR_materials_emissive_strength`` of a radiance [3]."""
    strength = float(radiance.max())
    return [min(float(x) / strength, 1.0) for x in radiance], {"emissiveStrength": strength}


def _index(eta: float) -> float:
    """A refractive index as glTF has it, at least 1: of a thing inside a denser one, that of the pair turned round."""
    return max(eta, 1.0 / eta)


def unit_normals(mesh: Mesh) -> FloatArray:
    """Vertex normals [v, 3] of length 1; where a file has none that can be scaled to it, that of a triangle there."""
    assert mesh.normals is not None
    points = mesh.vertices[mesh.faces].astype(np.float64)
    flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normals = np.asarray(mesh.normals, np.float64).copy()
    length = np.linalg.norm(normals, axis=1)
    bad = ~np.isfinite(length) | (length < 1e-20)
    of_face = np.zeros_like(normals)
    of_face[mesh.faces.ravel()] = flat.repeat(3, 0)
    normals[bad] = of_face[bad]
    normals[np.linalg.norm(normals, axis=1) < 1e-30] = 0.0, 0.0, 1.0
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None], np.float32)


def _quaternion(matrix: Array) -> list[float]:
    """A rotation matrix [3, 3] as a unit quaternion (x, y, z, w)."""
    found: list[float] = Rotation.from_matrix(matrix).as_quat().tolist()
    return found


def _add_light(glb: GlbWriter, light: PunctualLight) -> int:
    """Append a light without extent and its node.

    The units are candela and lux there, :data:`LUMENS_PER_WATT` of them to a unit of the scene's. A spot falls between
    its angles with a square of the cosine there, where it is linear in the angle here.
    """
    strength = float(light.intensity.max())
    described: Json = {
        "name": light.name,
        "type": light.kind,
        "color": [min(float(x) / strength, 1.0) for x in light.intensity],
        "intensity": strength * LUMENS_PER_WATT,
    }
    if light.kind == "spot":
        # the inner angle has to be less than the outer one
        outer = math.radians(light.cutoff_angle)
        inner = min(math.radians(light.beam_width), outer * (1.0 - 1e-6))
        described["spot"] = {"innerConeAngle": inner, "outerConeAngle": outer}
    lights = glb.json.setdefault("extensions", {}).setdefault(_PUNCTUAL, {"lights": []})["lights"]
    lights.append(described)
    glb.extensions.add(_PUNCTUAL)
    at = pose(light, -1.0)  # glTF's lights shine along -Z
    node: Json = {"name": light.name, "extensions": {_PUNCTUAL: {"light": len(lights) - 1}}}
    if light.kind != "directional":
        node["translation"] = at[:3, 3].tolist()
    if light.kind != "point":
        node["rotation"] = _quaternion(at[:3, :3])
    return glb.add("nodes", node)


def _add_camera(glb: GlbWriter, room: BakedRoom, view: View) -> int:
    camera = view.camera
    aspect = camera.width / camera.height
    lens = {
        "yfov": 2.0 * math.atan(math.tan(0.5 * camera.fov_x) / aspect),
        "aspectRatio": aspect,
        "znear": clip_planes(room.scene, camera)[0],
    }
    pose = np.asarray(camera.to_world, np.float64)
    node = {
        "name": view.name,
        "camera": glb.add("cameras", {"name": view.name, "type": "perspective", "perspective": lens}),
        "translation": pose[:3, 3].tolist(),
        "rotation": _quaternion(pose[:3, :3]),
    }
    return glb.add("nodes", node)
