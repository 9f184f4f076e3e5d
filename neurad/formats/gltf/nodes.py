"""The nodes of a glTF scene: where meshes, cameras and lights stand."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from neurad.core.records import Array
from neurad.core.scene_records import PunctualLight
from neurad.formats.cameras.intrinsics import SceneCamera
from neurad.formats.gltf.file import GltfFile, Json
from neurad.runtime.numbers import LENGTH, RADIANCE, within
from neurad.runtime.reading import shown
from neurad.scene.punctual import KINDS, LUMENS_PER_WATT, check_punctual

_LIGHTS, _INSTANCING = "KHR_lights_punctual", "EXT_mesh_gpu_instancing"
_PLACES = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
"""What instances may have, a value each."""
_FAR = 1e9  # largest factor of a node's scale
_STRAIGHT = 1e-4  # how far a camera's axes may be from perpendicular
_LONGEST = 512  # pixels of the longer side of a picture whose size nothing says


@dataclass(frozen=True)
class Node:
    """A node of the scene."""

    item: Json
    name: str
    to_world: Array
    """[4, 4], float64."""


def is_own(file: GltfFile) -> bool:
    """Whether ``neurad export`` wrote a file."""
    generator = file.object(file.json, "asset", "it").get("generator")
    return isinstance(generator, str) and generator.startswith("neurad ")


def nodes_of(file: GltfFile) -> Iterator[Node]:
    """The visible nodes of the scene, parents first.

    A file that neurad wrote is turned back to the frame of the cameras beside it.

    Raises:
        InputError: a node is reached twice, refers to what there is not, or its transform cannot be used.
    """
    roots = _roots(file)
    start = np.eye(4)
    if is_own(file) and len(roots) == 1:
        start = np.linalg.inv(_local(file, file.item("nodes", roots[0], "the scene"), "the first node"))
    waiting = [(index, start, "the scene") for index in reversed(roots)]
    reached: set[object] = set()
    while waiting:
        index, above, parent = waiting.pop()
        item = file.item("nodes", index, parent)
        if index in reached:
            raise file.error(f"node {index} has more than one parent, or is among its own children")
        reached.add(index)
        name = file.name(item, f"node {index}")
        about = f"node {shown(name)}"
        visible = file.extension(item, "KHR_node_visibility", about) or {}
        if visible.get("visible") is False:
            continue
        to_world = above @ _local(file, item, about)
        if np.abs(to_world).max() > LENGTH:
            raise file.error(f"{about} stands at or has a scale of {np.abs(to_world).max():.3g}, which is too large")
        is_identity = np.abs(to_world - np.eye(4)).max() < 1e-12  # but for rounding: vertices then keep all their bits
        yield Node(item, name, np.eye(4) if is_identity else to_world)
        waiting += [(child, to_world, about) for child in reversed(file.array(item, "children", about))]


def _roots(file: GltfFile) -> list[object]:
    """The nodes of the scene that the file shows; in a file without scenes those that have no parent."""
    if file.array(file.json, "scenes", "it"):
        scene = file.item("scenes", file.json.get("scene", 0), "it")
        if file.extension(scene, "EXT_lights_image_based", "its scene") is not None:
            raise file.error(
                "its scene has a light of pictures (EXT_lights_image_based), which is not read: take that out, and "
                "give an environment map (environment.exr)"
            )
        return file.array(scene, "nodes", "its scene")
    nodes = file.array(file.json, "nodes", "it")
    below = {
        child
        for i, _ in enumerate(nodes)
        for child in file.array(file.item("nodes", i, "it"), "children", f"node {i}")
        if isinstance(child, int)
    }
    return [i for i in range(len(nodes)) if i not in below]


def _local(file: GltfFile, item: Json, about: str) -> Array:
    if "matrix" in item:
        matrix = file.vector(item, "matrix", [0.0] * 16, about, -LENGTH, LENGTH).reshape(4, 4).T
        if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
            raise file.error(f"{about}: its matrix is a projection, not a transform of space")
        return np.asarray(matrix)
    turn = file.vector(item, "rotation", [0.0, 0.0, 0.0, 1.0], about, -_FAR, _FAR)
    scale = file.vector(item, "scale", [1.0, 1.0, 1.0], about, -_FAR, _FAR)
    move = file.vector(item, "translation", [0.0, 0.0, 0.0], about, -LENGTH, LENGTH)
    local: Array = _posed(file, move[None], turn[None], scale[None], about)[0]
    return local


def _posed(file: GltfFile, move: Array, turn: Array, scale: Array, about: str) -> Array:
    """The matrices [n, 4, 4] that scale, then turn by quaternions (x, y, z, w), then move."""
    from scipy.spatial.transform import Rotation  # imported where it is needed: it loads slowly

    if np.linalg.norm(turn, axis=1).min() < 1e-6:
        raise file.error(f"{about}: its rotation is 0, which is no quaternion")
    made = np.tile(np.eye(4), (len(move), 1, 1))
    made[:, :3, :3] = Rotation.from_quat(turn).as_matrix() * scale[:, None, :]
    made[:, :3, 3] = move
    return made


def instances_of(file: GltfFile, node: Node) -> tuple[int, Callable[[], Array]]:
    """How many times a node shows its mesh, and what reads where: matrices to world [n, 4, 4].

    A node is one, unless ``EXT_mesh_gpu_instancing`` makes instances in its frame.

    Raises:
        InputError: their values are broken, or differ in number.
    """
    about = f"node {shown(node.name)}"
    found = file.extension(node.item, _INSTANCING, about)
    attributes = {} if found is None else file.object(found, "attributes", about)
    about = f"{about}: {_INSTANCING}"
    counts = {
        key: file.count(file.item("accessors", attributes[key], f"{about}: {key}"), "count", None, f"{about}: {key}")
        for key in _PLACES
        if key in attributes
    }
    if not counts:
        return 1, lambda: node.to_world[None]
    if len(set(counts.values())) > 1:
        raise file.error(f"{about} has {' and '.join(f'{n} of {key}' for key, n in counts.items())}")
    count = next(iter(counts.values()))

    def read() -> Array:
        values = {"TRANSLATION": np.zeros((count, 3)), "ROTATION": np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))}
        values["SCALE"] = np.ones((count, 3))
        for key in counts:
            values[key] = file.accessor(attributes[key], f"{about}: {key}", _PLACES[key]).astype(np.float64)
            within(values[key], f"{shown(file.path)}: {about}: {key}", -_FAR, _FAR)
        to_world = node.to_world @ _posed(file, values["TRANSLATION"], values["ROTATION"], values["SCALE"], about)
        within(to_world, f"{shown(file.path)}: {about}: places", -LENGTH, LENGTH)
        return to_world

    return count, read


def camera_of(file: GltfFile, node: Node) -> SceneCamera | None:
    """The camera of a node that has one; None of an orthographic one.

    Raises:
        InputError: it is of an unknown kind, has no usable angle, or its node is scaled unevenly.
    """
    about = f"camera {shown(node.name)}"
    item = file.item("cameras", node.item["camera"], about)
    if item.get("type") == "orthographic":
        return None
    if item.get("type") != "perspective":
        raise file.error(f"{about} is {shown(repr(item.get('type')))}; only perspective cameras are supported")
    lens = file.object(item, "perspective", about)
    fov = file.number(lens, "yfov", math.nan, about, 1e-4, 3.1)
    aspect = file.number(lens, "aspectRatio", 1.0, about, 1e-4, 1e4) if "aspectRatio" in lens else None
    axes, pose = node.to_world[:3, :3], np.eye(4)
    length = np.linalg.norm(axes, axis=0)
    if length.min() == 0 or np.abs((axes / length).T @ (axes / length) - np.eye(3)).max() > _STRAIGHT:
        raise file.error(f"{about}: its node's transform bends it; only turned, moved and scaled cameras are supported")
    if np.linalg.det(axes) < 0:
        raise file.error(f"{about}: its node's transform mirrors it, which is not supported")
    pose[:3, :3], pose[:3, 3] = axes / length, node.to_world[:3, 3]
    wide = 4.0 / 3.0 if aspect is None else aspect
    height = _LONGEST / max(wide, 1.0)
    film = max(round(wide * height), 1), max(round(height), 1)
    focal, where = 0.5 / math.tan(0.5 * fov), f"{shown(file.path)}: {about}"
    return SceneCamera((node.name,), pose.astype(np.float64), focal, film, aspect, where)


def light_of(file: GltfFile, node: Node) -> PunctualLight | None:
    """The light without extent of a node, which shines along its -Z, or None.

    Intensities are candela and lux there; they become W/sr and W/m2 by :data:`LUMENS_PER_WATT`. Between its two angles
    a spot falls linearly with the angle here, and with a square of the cosine in most viewers.

    Raises:
        InputError: it is broken or of an unknown kind.
    """
    named = file.extension(node.item, _LIGHTS, f"node {shown(node.name)}")
    if named is None:
        return None
    about = f"light {shown(node.name)}"
    item = file.item("lights", named.get("light"), about, file.extension(file.json, _LIGHTS, "it") or {})
    if item.get("type") not in KINDS:
        raise file.error(f"{about} is no light of the type {', '.join(KINDS)}")
    intensity = file.number(item, "intensity", 1.0, about, 0.0, RADIANCE)
    color = file.vector(item, "color", [1.0, 1.0, 1.0], about, 0.0, 1.0)
    spot, right = file.object(item, "spot", about), math.pi / 2
    inner = file.number(spot, "innerConeAngle", 0.0, about, 0.0, right)
    outer = file.number(spot, "outerConeAngle", math.pi / 4, about, 0.0, right)
    axis = -node.to_world[:3, 2]
    light = PunctualLight(
        node.name,
        item["type"],
        (color * (intensity / LUMENS_PER_WATT)).astype(np.float32),
        node.to_world[:3, 3],
        (axis / max(float(np.linalg.norm(axis)), 1e-300)).astype(np.float32),
        math.degrees(outer),
        math.degrees(inner),
    )
    return check_punctual(light, f"{shown(file.path)}: {about}")
