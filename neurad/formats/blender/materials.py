"""Blender's materials as :class:`~neurad.core.scene_records.Material` records.

As in glTF files, what lets light through in a way that cannot be rendered is refused. What is opaque and cannot be
rendered gets the albedo and roughness 0.5 and a note: a fit recovers surfaces anew.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import FloatArray
from neurad.core.reflection import ConductorModel, DielectricModel, DiffuseModel, PrincipledModel, ReflectionModel
from neurad.core.scene_records import DIELECTRIC, METAL, Bitmap, Constant, Material, Texture, constant
from neurad.formats.gltf.textures import LEVELS
from neurad.images.image_io import from_srgb
from neurad.runtime.numbers import RADIANCE, TEXEL, matrix, number, within
from neurad.runtime.reading import native, regular_file, shown
from neurad.scene.description import is_dielectric

START = 0.5
"""Albedo and roughness of what is not known."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Cycles' of a colour that is taken for a number
_OPAQUE = 0.999
_LARGEST_INDEX = 100.0
_LAYERS = {
    "subsurface": "light that scatters below it", "coat": "a coat", "sheen": "sheen", "film": "a thin film",
    "anisotropic": "anisotropy", "diffuse_roughness": "a rough diffuse lobe", "normals": "a map of normals or bumps",
    "displaced": "displacement", "volume": "a volume",
}  # fmt: skip


@dataclass(frozen=True)
class Emission:
    """What a surface sends to both sides."""

    radiance: FloatArray
    """[3]; times the picture, where there is one."""
    picture: Bitmap | None = None
    uv: str = ""


@dataclass(frozen=True)
class Painted:
    """A material and what else belongs to its surface."""

    material: Material | None
    """None of what has a volume and no surface."""
    emission: Emission | None = None
    uv: str = ""
    """Name of the texture coordinates that its pictures use."""


class MaterialReader:
    """Materials of a folder of ``write_room.py``."""

    def __init__(self, folder: Path, where: str) -> None:
        self.folder = folder
        self.where = where
        self.anew: dict[str, list[str]] = {}
        """What is not as in Blender, by material."""
        self._pictures: dict[Any, FloatArray] = {}

    def paint(self, described: Mapping[str, Any]) -> Painted:
        """A material.

        Raises:
            InputError: it is transparent, emits light in a way that is not read, or a number is out of range.
        """
        name = str(described.get("name"))
        about = f"{self.where}: material {shown(name)}"
        shader = described.get("shader")
        if shader == "NONE":
            return Painted(None if described.get("volume") else black(name))
        if shader not in _SHADERS:
            self._check_other(described, shader, about)
            self.anew.setdefault(name, []).append(f"{shown(shader)}")
            return Painted(Material(name, PrincipledModel(), constant(START, 3), constant(START)))
        emission = self._emission(described, about)
        if shader == "EMISSION":
            return Painted(black(name), emission, emission.uv if emission else "")
        albedo, uv = self._texture(described, "color", 3, name, about)
        roughness, second = self._texture(described, "roughness", 1, name, about)
        metallic, third = self._texture(described, "metallic", 1, name, about, 0.0)
        if len({x for x in (uv, second, third) if x is not None}) > 1:
            self.anew.setdefault(name, []).append("pictures on two sets of texture coordinates")
            roughness = roughness if second in (None, uv) else constant(START)
            metallic = metallic if third in (None, uv) else DIELECTRIC
        if found := [said for key, said in _LAYERS.items() if described.get(key)]:
            self.anew.setdefault(name, []).append(" and ".join(found))
        metallic = METAL if shader == "BSDF_GLOSSY" else metallic
        model = _SHADERS[shader](
            described, Material(name, PrincipledModel(), albedo, roughness, metallic=metallic), about
        )
        if emission is not None and isinstance(model, PrincipledModel) and is_dielectric(metallic):
            model = PrincipledModel()  # a lamp's highlight is not worth a model of its own
        material = Material(name, model, albedo, roughness, metallic=metallic)
        return Painted(material, emission, next((x for x in (uv, second, third) if x is not None), ""))

    def _check_other(self, described: Mapping[str, Any], shader: object, about: str) -> None:
        if described.get("lets_through"):
            raise _lets_through(f"{about} ({shown(shader)})")
        if described.get("emits"):
            raise InputError(
                f"{about} emits light through other nodes ({shown(shader)}), which are not read; link an Emission or a "
                "Principled BSDF to its output"
            )

    def _emission(self, described: Mapping[str, Any], about: str) -> Emission | None:
        strength, colour = described.get("strength", 0.0), described.get("emission", [1.0] * 3)
        if strength == 0.0 or (isinstance(colour, list) and not any(colour)):
            return None
        if isinstance(strength, dict) or (isinstance(colour, dict) and "unread" in colour):
            raise InputError(
                f"{about} emits light by nodes that are not read; give it one strength, and a colour or picture"
            )
        times = number(strength, f"{about}: its emission strength", 0.0, RADIANCE)
        if not isinstance(colour, dict):
            radiance = np.array(_colour(colour, f"{about}: its emission", RADIANCE)) * times
            within(radiance, f"{about}: its emission", 0.0, RADIANCE)
            return Emission(radiance.astype(np.float32))
        picture = Bitmap(self._pixels(colour, 3, about, RADIANCE), _to_uv(colour, about))
        return Emission(np.full(3, times, np.float32), picture, str(colour.get("uv", "")))

    def _texture(
        self, described: Mapping[str, Any], key: str, channels: int, name: str, about: str, start: float = START
    ) -> tuple[Texture, str | None]:
        """A texture and, of a picture, the name of its coordinates."""
        value = described.get(key, [start] * 3 if channels == 3 else start)
        if not isinstance(value, dict):
            colour = _colour(value, f"{about}: its {key}", math.inf)
            chosen = (
                colour if channels == 3 else [float(value)] if not isinstance(value, list) else [colour @ _LUMINANCE]
            )
            return Constant(np.clip(np.array(chosen, np.float32), 0.0, 1.0)), None
        if "unread" in value:
            self.anew.setdefault(name, []).append(
                f"its {'base colour' if key == 'color' else key}: {shown(value['unread'])}"
            )
            return constant(start, channels), None
        pixels = np.clip(self._pixels(value, channels, about, math.inf), 0.0, 1.0)
        return Bitmap(pixels, _to_uv(value, about)), str(value.get("uv", ""))

    def _pixels(self, place: Mapping[str, Any], channels: int, about: str, most: float) -> FloatArray:
        """Linear values of a picture [h, w, channels]."""
        key = place.get("file"), place.get("coded"), place.get("channel"), channels
        if key not in self._pictures:
            path = file_in(self.folder, place.get("file"))
            with native(path, "it is no picture that write_room.py has written"):
                pixels = np.load(path, allow_pickle=False)
                if pixels.dtype.str[1:] not in ("u1", "f4") or pixels.shape[2:] != (3,) or 0 in pixels.shape:
                    raise ValueError(path)
            if pixels.dtype == np.uint8:
                linear = LEVELS[pixels] if place.get("coded") else pixels.astype(np.float32) / np.float32(255.0)
            else:
                linear = from_srgb(pixels) if place.get("coded") else pixels
            channel = place.get("channel")
            if channel is not None and (type(channel) is not int or not 0 <= channel <= 2):
                raise InputError(f"{about}: its picture has no channel {shown(repr(channel))}")
            if channels == 1:
                linear = linear @ _LUMINANCE[:, None] if channel is None else linear[..., channel : channel + 1]
            elif channel is not None:
                linear = np.repeat(linear[..., channel : channel + 1], 3, -1)
            within(linear, f"{about}: its picture", -most, most)
            self._pictures[key] = np.ascontiguousarray(linear, np.float32)
        return self._pictures[key]


def file_in(folder: Path, name: Any) -> Path:
    """A file that ``blender.json`` names, which lies beside it.

    Raises:
        InputError: it is missing, or the name leads out of the folder.
    """
    if Path(str(name)).name != name:
        raise InputError(f"{shown(folder)}: the name {shown(repr(name))} leads out of the folder")
    return regular_file(folder / name)


def _principled(described: Mapping[str, Any], read: Material, about: str) -> ReflectionModel:
    alpha, transmission = described.get("alpha", 1.0), described.get("transmission", 0.0)
    if not isinstance(alpha, float) or alpha < _OPAQUE:
        raise _lets_through(about)
    ior = described.get("ior", 1.5)
    eta = number(ior, f"{about}: its IOR", 0.0, _LARGEST_INDEX) if isinstance(ior, float) else 1.5
    if isinstance(transmission, dict) or transmission > 0:
        if transmission != 1.0 or not is_dielectric(read.metallic):
            raise _lets_through(about)
        return _glass(described, read, about)
    if isinstance(read.metallic, Constant) and read.metallic.value[0] == 1.0 and _is_mirror(read):
        return ConductorModel()
    level = described.get("specular", 0.5)
    normal = ((eta - 1.0) / (eta + 1.0)) ** 2 * (2.0 * level if isinstance(level, float) else 1.0)
    if normal <= 0.0 and is_dielectric(read.metallic):
        return DiffuseModel()
    root = math.sqrt(min(max(normal, 2.5e-7), 0.96))
    return PrincipledModel(float(np.round((1.0 + root) / (1.0 - root), 5)))


def _is_mirror(read: Material) -> bool:
    """Whether it is smooth, of one colour."""
    rough = read.roughness
    return isinstance(rough, Constant) and float(rough.value[0]) == 0.0 and isinstance(read.albedo, Constant)


def _glass(described: Mapping[str, Any], read: Material, about: str) -> ReflectionModel:
    clear = isinstance(read.albedo, Constant) and float(read.albedo.value.min()) >= _OPAQUE
    ior = described.get("ior", 1.5)
    if not clear or not _is_mirror(read) or not isinstance(ior, float) or not 1.0 <= ior <= _LARGEST_INDEX:
        raise _lets_through(about)
    return DielectricModel(ior)


_SHADERS: dict[Any, Callable[[Mapping[str, Any], Material, str], ReflectionModel]] = {
    "BSDF_PRINCIPLED": _principled,
    "BSDF_DIFFUSE": lambda described, read, about: DiffuseModel(),
    "BSDF_GLOSSY": lambda described, read, about: ConductorModel() if _is_mirror(read) else PrincipledModel(),
    "BSDF_GLASS": _glass,
    "EMISSION": lambda described, read, about: DiffuseModel(),
}


def _lets_through(about: str) -> InputError:
    return InputError(
        f"{about} lets light through, which is not supported: only smooth clear glass is (transmission 1, roughness 0, "
        "white, alpha 1); make it opaque, or hide its objects from renders"
    )


def black(name: str) -> Material:
    """A material that reflects nothing."""
    return Material(name, PrincipledModel(), constant(0.0, 3), constant(1.0))


def _colour(value: Any, where: str, most: float) -> Any:
    values = value if isinstance(value, list) else [value] * 3
    if len(values) != 3:
        raise InputError(f"{where} is not a colour")
    return np.array([max(number(x, where, -1e30, min(most, 1e30)), 0.0) for x in values], np.float64)


def _to_uv(place: Mapping[str, Any], about: str) -> FloatArray:
    return matrix(place.get("to_uv"), f"{about}: the place of its picture", -TEXEL, TEXEL, 3).astype(np.float32)
