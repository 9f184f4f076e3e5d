"""The materials of a Blender scene, for ``write_room.py``: what a Principled BSDF and its like are set to."""

import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

_LETS_THROUGH = {"BSDF_TRANSPARENT", "BSDF_GLASS", "BSDF_REFRACTION", "BSDF_TRANSLUCENT", "HOLDOUT"}
_PLAIN = {
    "BSDF_PRINCIPLED": {
        "color": "Base Color", "roughness": "Roughness", "metallic": "Metallic", "ior": "IOR", "alpha": "Alpha",
        "transmission": "Transmission Weight", "specular": "Specular IOR Level", "tint": "Specular Tint",
        "subsurface": "Subsurface Weight", "coat": "Coat Weight", "sheen": "Sheen Weight",
        "anisotropic": "Anisotropic", "diffuse_roughness": "Diffuse Roughness", "film": "Thin Film Thickness",
        "emission": "Emission Color", "strength": "Emission Strength",
    },
    "BSDF_DIFFUSE": {"color": "Color", "diffuse_roughness": "Roughness"},
    "BSDF_GLOSSY": {"color": "Color", "roughness": "Roughness"},
    "BSDF_GLASS": {"color": "Color", "roughness": "Roughness", "ior": "IOR"},
    "EMISSION": {"emission": "Color", "strength": "Strength"},
}  # fmt: skip
"""The inputs that are read of each kind of surface."""
_OF_KINDS: dict[str, Callable[[float, float], float]] = {
    "ADD": operator.add, "SUBTRACT": operator.sub, "MULTIPLY": operator.mul, "MAXIMUM": max, "MINIMUM": min,
}  # fmt: skip
"""What kinds of rays are put together by."""
_WHOLE = 0.999  # alpha from which on a picture lets nothing through


def plain_shader(tree: Any) -> Any:
    """The node that the surface of a material, world or lamp comes from; None if there is none. Of a mix by Light Path
    it is what a camera sees.
    """
    output = tree.get_output_node("CYCLES")
    node = None if output is None else _source(output.inputs["Surface"])[0]
    while node is not None and node.type == "MIX_SHADER":
        factor = _seen_by_camera(node.inputs[0])
        if factor not in (0.0, 1.0):
            break
        node = _source(node.inputs[1 + int(factor)])[0]
    return node


def _seen_by_camera(socket: Any) -> float | None:
    """What a factor is for a camera's own rays; None if it depends on more than the kind of ray."""
    node, output = _source(socket)
    if node is None:
        return float(socket.default_value)
    if node.type == "LIGHT_PATH" and output.name.startswith("Is "):
        return float(output.name == "Is Camera Ray")
    if node.type == "MATH" and node.operation in _OF_KINDS:
        a, b = (_seen_by_camera(one) for one in node.inputs[:2])
        return None if a is None or b is None else _OF_KINDS[node.operation](a, b)
    return None


def _source(socket: Any) -> tuple[Any, Any]:
    """Node and output that an input is linked to; None where it is not."""
    while socket.is_linked:
        link = socket.links[0]
        if link.from_node.type != "REROUTE":
            return link.from_node, link.from_socket
        socket = link.from_node.inputs[0]
    return None, None


class Materials:
    """Materials as JSON, each once."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.described: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self._known: dict[str, int] = {}
        self._images: dict[str, dict[str, Any]] = {}

    def index(self, material: Any) -> int:
        """The number of a material; None is what Blender shows surfaces without one with."""
        key = "" if material is None else material.name_full
        if key not in self._known:
            self._known[key] = len(self.described)
            self.described.append(self._describe(material))
        return self._known[key]

    def _describe(self, material: Any) -> dict[str, Any]:
        if material is None:
            return {"name": "no material", "shader": "BSDF_DIFFUSE", "color": [0.8, 0.8, 0.8]}
        if not material.use_nodes or material.node_tree is None:
            return {"name": material.name, "shader": "BSDF_DIFFUSE", "color": list(material.diffuse_color[:3])}
        made: dict[str, Any] = {"name": material.name}
        output = material.node_tree.get_output_node("CYCLES")
        if output is not None:
            made["volume"] = output.inputs["Volume"].is_linked
            made["displaced"] = output.inputs["Displacement"].is_linked
        shader = plain_shader(material.node_tree)
        if shader is None:
            return {**made, "shader": "NONE"}
        if shader.type not in _PLAIN:
            kinds = _reachable(shader)
            lets = bool(kinds & _LETS_THROUGH)
            return {**made, "shader": shader.bl_label, "lets_through": lets, "emits": "EMISSION" in kinds}
        if any(node.type == "LIGHT_PATH" for node in material.node_tree.nodes):
            self.notes.append(f"material {material.name} differs by Light Path: it is taken as a camera sees it")
        made["shader"] = shader.type
        for key, name in _PLAIN[shader.type].items():
            if name in shader.inputs:
                made[key] = self._value(shader.inputs[name], key == "alpha")
        normal = shader.inputs.get("Normal")
        made["normals"] = normal is not None and normal.is_linked
        return made

    def _value(self, socket: Any, is_alpha: bool = False) -> Any:
        """A number, a colour, a picture's place, or a sentence why it is none of these."""
        node, output = _source(socket)
        if node is None:
            value = socket.default_value
            return float(value) if isinstance(value, int | float) else [float(x) for x in value[:3]]
        if node.type == "RGB":
            return [float(x) for x in output.default_value[:3]]
        if node.type == "VALUE":
            return float(output.default_value)
        channel = None
        if node.type in ("SEPARATE_COLOR", "SEPRGB") and getattr(node, "mode", "RGB") == "RGB":
            channel = list(node.outputs).index(output)
            node, output = _source(node.inputs[0])
        if node is not None and node.type == "TEX_IMAGE" and output.name == ("Alpha" if is_alpha else "Color"):
            return self._picture(node, channel, is_alpha)
        return {"unread": f"it comes from {'other nodes' if node is None else 'the node ' + node.bl_label}"}

    def _picture(self, node: Any, channel: int | None, is_alpha: bool) -> Any:
        image = node.image
        # Asking for its pixels loads a picture that is not in memory yet.
        if image is None or image.size[0] == 0 or (not image.has_data and not len(image.pixels)):
            return {"unread": f"its picture {'' if image is None else image.name} is missing"}
        if is_alpha:
            return 1.0 if image.channels < 4 or self._image(image)["least_alpha"] >= _WHOLE else 0.0
        if node.projection != "FLAT" or node.extension != "REPEAT" or image.source not in ("FILE", "GENERATED"):
            return {"unread": f"its picture {image.name} is not simply repeated over the surface"}
        place = _place(node.inputs["Vector"])
        if place is None:
            return {"unread": f"its picture {image.name} is not placed by UV coordinates"}
        found = self._image(image)
        if found["space"] not in ("sRGB", "Non-Color", "Linear", "Linear Rec.709", "Raw") and not image.is_float:
            return {"unread": f"its picture {image.name} has the colour space {found['space']}"}
        return {"file": found["file"], "coded": found["coded"], "channel": channel, **place}

    def _image(self, image: Any) -> dict[str, Any]:
        """A picture in a file, its lowest row first, as v runs."""
        if image.name_full not in self._images:
            width, height = image.size
            pixels = np.empty(width * height * image.channels, np.float32)
            image.pixels.foreach_get(pixels)
            pixels = pixels.reshape(height, width, image.channels)
            least = float(pixels[..., 3].min()) if image.channels == 4 else 1.0
            colours = pixels[..., :3] if image.channels >= 3 else np.repeat(pixels[..., :1], 3, -1)
            space = image.colorspace_settings.name
            coded = not image.is_float and space == "sRGB"
            if not image.is_float:
                colours = np.rint(colours * 255.0).astype(np.uint8)
            file = f"image{len(self._images):05d}.npy"
            np.save(self.out / file, np.ascontiguousarray(colours))
            self._images[image.name_full] = {"file": file, "coded": coded, "space": space, "least_alpha": least}
        return self._images[image.name_full]


def _place(socket: Any) -> dict[str, Any] | None:
    """Coordinates of a picture: their name, empty for those of the render, and what turns them [3, 3]."""
    matrix = np.eye(3)
    node, output = _source(socket)
    if node is not None and node.type == "MAPPING":
        inputs = [node.inputs[name] for name in ("Location", "Rotation", "Scale")]
        if node.vector_type not in ("POINT", "VECTOR") or any(x.is_linked for x in inputs):
            return None
        move, turn, scale = (np.array(x.default_value[:]) for x in inputs)
        if turn[0] != 0.0 or turn[1] != 0.0:
            return None
        cos, sin = np.cos(turn[2]), np.sin(turn[2])
        matrix[:2, :2] = np.array([[cos, -sin], [sin, cos]]) * scale[:2]
        matrix[:2, 2] = move[:2] if node.vector_type == "POINT" else 0.0
        node, output = _source(node.inputs["Vector"])
        if node is None:  # an unlinked Mapping reads no coordinates
            return None
    if node is None:
        return {"uv": "", "to_uv": matrix.tolist()}
    if node.type == "UVMAP" and not node.from_instancer:
        return {"uv": node.uv_map, "to_uv": matrix.tolist()}
    if node.type == "TEX_COORD" and output.name == "UV" and not node.from_instancer:
        return {"uv": "", "to_uv": matrix.tolist()}
    return None


def _reachable(node: Any) -> set[str]:
    """The kinds of all nodes that a node depends on, those in groups included."""
    kinds: set[str] = set()
    waiting, seen = [node], set()
    while waiting:
        here = waiting.pop()
        if here.as_pointer() in seen:
            continue
        seen.add(here.as_pointer())
        kinds.add(here.type)
        if here.type == "BSDF_PRINCIPLED":
            kinds |= _of_principled(here)
        if here.type == "GROUP" and here.node_tree is not None:
            waiting += [inner for inner in here.node_tree.nodes if inner.type == "GROUP_OUTPUT"]
        waiting += [link.from_node for socket in here.inputs for link in socket.links]
    return kinds


def _of_principled(node: Any) -> set[str]:
    """What a Principled BSDF stands for besides itself."""
    found = set()
    transmission, alpha = node.inputs["Transmission Weight"], node.inputs["Alpha"]
    if transmission.is_linked or transmission.default_value > 0 or alpha.is_linked or alpha.default_value < _WHOLE:
        found.add("BSDF_GLASS")
    strength, colour = node.inputs["Emission Strength"], node.inputs["Emission Color"]
    if strength.is_linked or (strength.default_value > 0 and (colour.is_linked or max(colour.default_value[:3]) > 0)):
        found.add("EMISSION")
    return found
