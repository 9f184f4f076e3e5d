"""BSDFs and textures of a Mitsuba scene file as :class:`~neurad.core.records.Material` records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.colour import LUMINANCE
from neurad.core.errors import InputError
from neurad.core.records import Bitmap, Constant, FloatArray, Material, Texture, VertexAttribute
from neurad.core.reflection import ConductorModel, DielectricModel, DiffuseModel, PrincipledModel
from neurad.scene.image_io import read_bitmap

_LUMINANCE = np.array(LUMINANCE, np.float32)  # Mitsuba's, for a scalar from a colour bitmap
_GREY = Constant(np.full(3, 0.5, np.float32))
_BLACK = Constant(np.zeros(3, np.float32))
_ONES = Constant(np.ones(3, np.float32))
_HALF = Constant(np.full(1, 0.5, np.float32))
_SMOOTH = Constant(np.zeros(1, np.float32))

_IRRELEVANT = ("diffuse_reflectance_sampling_rate", "main_specular_sampling_rate", "clearcoat_sampling_rate",
               "clearcoat_gloss", "spec_tint", "sheen_tint")  # fmt: skip
_DEFAULTS = {"specular": 0.5, "eta": 1.5}  # the same thing said in two ways; all other parameters have to be 0
_BITMAP_DEFAULTS = {"filter_type": ("bilinear",), "wrap_mode": ("repeat",)}
_BITMAP_KNOWN = ("filename", "raw", "to_uv", "format", "accel")
_PLANE = (0, 1, 3)  # rows and columns of a transform of space that act on homogeneous uv
_BY_MITSUBA = (".hdr", ".rgbe", ".pfm")


class MaterialReader:
    """Converts the BSDFs that shapes use, each once.

    Attributes:
        materials: what has been converted so far.
    """

    def __init__(self, mi: Any, path: Path, nodes: Any) -> None:
        self.mi = mi
        self.path = path
        self.nodes = nodes
        self.materials: list[Material] = []
        self._index: dict[tuple[int, int], int] = {}
        self._pixels: dict[tuple[str, bool], FloatArray] = {}
        self._scalar: dict[tuple[str, bool], FloatArray] = {}

    def index(self, node: Any | None, shape: str, shines: bool) -> int:
        """The index in ``materials`` of a BSDF node; a shape without one gets Mitsuba's default.

        Args:
            node: of the BSDF, or None.
            shape: name for messages.
            shines: whether the shape is an emitter: its default is black, that of others is grey.

        Raises:
            InputError: a type or parameter that neurad does not render; it names the shape.
        """
        key = (-1, int(shines)) if node is None else (node.file_index, node.offset)
        if key not in self._index:
            default = Material("default", DiffuseModel(), _BLACK if shines else _GREY, _SMOOTH, False)
            material = default if node is None else self._bsdf(node, shape)
            self._index[key] = len(self.materials)
            self.materials.append(material)
        return self._index[key]

    def attributes(self, material: int) -> set[str]:
        """The mesh attributes that a material reads."""
        described = self.materials[material]
        return {t.name for t in (described.albedo, described.roughness) if isinstance(t, VertexAttribute)}

    def pixels(self, filename: str, raw: bool) -> FloatArray:
        """The linear pixels [h, w, 1 or 3] of an image file beside the scene file, read once."""
        key = (filename, raw)
        if key not in self._pixels:
            file = self.path.parent / filename
            if file.suffix.lower() in _BY_MITSUBA and file.is_file():
                bitmap = self.mi.Bitmap(str(file))
                rgb = bitmap.convert(self.mi.Bitmap.PixelFormat.RGB, self.mi.Struct.Type.Float32, srgb_gamma=False)
                self._pixels[key] = np.array(rgb, np.float32)
            else:
                self._pixels[key] = read_bitmap(file, raw)
        return self._pixels[key]

    def _bsdf(self, node: Any, shape: str) -> Material:
        name, two_sided = node.props.id(), False
        if node.props.plugin_name() == "twosided":
            inner = [self._referred(node, key) for key in self._references(node)]
            if len(inner) != 1:
                raise InputError(
                    f"{self.path}: bsdf {name} of shape {shape} is twosided with {len(inner)} BSDFs inside"
                )
            node, two_sided = inner[0], True
        plugin = node.props.plugin_name()
        name = name or node.props.id() or f"{plugin} {len(self.materials)}"
        where = f"bsdf {name} of shape {shape}"
        if plugin == "principled":
            self._check_principled(node, where)
            albedo = self._texture(node, "base_color", where, _GREY)
            roughness = self._texture(node, "roughness", where, _HALF, scalar=True)
            return Material(name, PrincipledModel(), albedo, roughness, two_sided)
        if plugin == "diffuse":
            return Material(name, DiffuseModel(), self._texture(node, "reflectance", where, _GREY), _SMOOTH, two_sided)
        if plugin == "conductor":
            return Material(name, ConductorModel(), self._mirror(node, where), _SMOOTH, two_sided)
        if plugin == "dielectric":
            return Material(name, DielectricModel(self._eta(node, where)), _ONES, _SMOOTH)
        known = "principled, diffuse, conductor, dielectric, twosided"
        raise InputError(f"{self.path}: {where} has type {plugin}, which is not supported; there are: {known}")

    def _references(self, node: Any) -> list[str]:
        wanted = self.mi.Properties.Type.ResolvedReference
        return [key for key in node.props if node.props.type(key) == wanted]

    def _referred(self, node: Any, key: str) -> Any:
        return self.nodes[node.props[key].index()]

    def _check_principled(self, node: Any, where: str) -> None:
        for key in node.props:
            if key in ("base_color", "roughness", *_IRRELEVANT):
                continue
            value, wanted = node.props[key], _DEFAULTS.get(key, 0.0)
            if not isinstance(value, int | float) or abs(value - wanted) > 1e-6:
                raise InputError(f"{self.path}: {where} sets {key}, which is not supported (leave it at {wanted:g})")

    def _texture(self, node: Any, key: str, where: str, default: Constant, scalar: bool = False) -> Texture:
        """The texture under ``key``: three channels, or one if ``scalar``; one channel may stand for three."""
        props = node.props
        if key not in props:
            return default
        if key in self._references(node):
            return self._textured(self._referred(node, key), key, where, scalar)
        if isinstance(props[key], int | float):  # a number is not clipped to [0, 1] as a reflectance spectrum is
            return Constant(np.full(1 if scalar else 3, props[key], np.float32))
        try:
            texture = props.get_texture(key)
        except RuntimeError as error:
            raise InputError(f"{self.path}: the {key} of {where} is not a colour in [0, 1]") from error
        value = np.array(texture.eval(self.mi.SurfaceInteraction3f()), np.float32).reshape(-1) * np.ones(3, np.float32)
        return Constant((value @ _LUMINANCE).reshape(1) if scalar else value)

    def _textured(self, node: Any, key: str, where: str, scalar: bool) -> Texture:
        plugin, props = node.props.plugin_name(), node.props
        if plugin == "mesh_attribute":
            if abs(float(props.get("scale", 1.0)) - 1.0) > 1e-6:
                raise InputError(f"{self.path}: the {key} of {where} sets scale, which is not supported")
            return VertexAttribute(str(props["name"]))
        if plugin != "bitmap":
            raise InputError(
                f"{self.path}: the {key} of {where} is a texture of type {plugin}; there are: bitmap, mesh_attribute"
            )
        for name in props:
            if name not in _BITMAP_KNOWN and props[name] not in _BITMAP_DEFAULTS.get(name, ()):
                raise InputError(f"{self.path}: the bitmap for {key} of {where} sets {name}, which is not supported")
        if "filename" not in props:
            raise InputError(f"{self.path}: the bitmap for {key} of {where} has no filename")
        to_uv = np.eye(3, dtype=np.float32)
        if "to_uv" in props:
            to_uv = np.array(props["to_uv"].matrix, np.float32)[np.ix_(_PLANE, _PLANE)]
        file = (str(props["filename"]), bool(props.get("raw", False)))
        return Bitmap(self._one_channel(*file) if scalar else self.pixels(*file), to_uv)

    def _one_channel(self, filename: str, raw: bool) -> FloatArray:
        key = (filename, raw)
        if key not in self._scalar:
            pixels = self.pixels(filename, raw)
            self._scalar[key] = pixels if pixels.shape[2] == 1 else (pixels @ _LUMINANCE)[..., None]
        return self._scalar[key]

    def _plain(self, node: Any, where: str) -> dict[str, Any]:
        """A BSDF without textures, for ``load_dict``."""
        if texture := next(iter(self._references(node)), None):
            raise InputError(f"{self.path}: the {texture} of {where} is textured, which is not supported")
        props = node.props
        return {"type": props.plugin_name(), **{key: props[key] for key in props}}

    def _load(self, described: dict[str, Any], where: str) -> Any:
        try:
            return self.mi.load_dict(described)
        except (RuntimeError, TypeError) as error:
            raise InputError(f"{self.path}: {where} has parameters that Mitsuba does not accept") from error

    def _mirror(self, node: Any, where: str) -> Constant:
        """Reflectance of a smooth conductor at normal incidence [3]."""
        bsdf = self._load(self._plain(node, where), where)
        si = self.mi.SurfaceInteraction3f()
        si.wi = self.mi.Vector3f(0.0, 0.0, 1.0)
        weight = bsdf.sample(self.mi.BSDFContext(), si, 0.5, self.mi.Point2f(0.5, 0.5))[1]
        return Constant(np.array(weight, np.float32))

    def _eta(self, node: Any, where: str) -> float:
        """Refractive index of a smooth dielectric, inside over outside."""
        described = self._plain(node, where)
        for key in ("specular_reflectance", "specular_transmittance"):
            if described.get(key, 1.0) != 1.0:
                raise InputError(f"{self.path}: {where} sets {key}, which is not supported")
        return float(self.mi.traverse(self._load(described, where))["eta"])
