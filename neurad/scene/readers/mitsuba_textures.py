"""Textures of a Mitsuba scene file as :class:`~neurad.core.records.Texture` records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.colour import LUMINANCE
from neurad.core.errors import InputError
from neurad.core.records import Bitmap, Constant, FloatArray, Texture, VertexAttribute
from neurad.scene.image_io import read_bitmap

_LUMINANCE = np.array(LUMINANCE, np.float32)  # Mitsuba's, for a scalar from a colour bitmap
_BITMAP_DEFAULTS = {"filter_type": ("bilinear",), "wrap_mode": ("repeat",)}
_BITMAP_KNOWN = ("filename", "raw", "to_uv", "format", "accel")
_PLANE = (0, 1, 3)  # rows and columns of a transform of space that act on homogeneous uv
_BY_MITSUBA = (".hdr", ".rgbe", ".pfm")


class Unsupported(InputError):
    """An opaque BSDF, or a parameter of one, that cannot be rendered; a fit replaces it.

    Args:
        message: one sentence, for who wants the true material.
        what: the same in a few words; empty where it is the kind of BSDF.
    """

    def __init__(self, message: str, what: str = "") -> None:
        super().__init__(message)
        self.what = what


class TextureReader:
    """Converts the textures of BSDFs, reading every image file once.

    Attributes:
        mi: the package, in a scalar variant.
        path: of the scene file.
        nodes: of the parsed file.
    """

    def __init__(self, mi: Any, path: Path, nodes: Any) -> None:
        self.mi = mi
        self.path = path
        self.nodes = nodes
        self._pixels: dict[tuple[str, bool], FloatArray] = {}
        self._scalar: dict[tuple[str, bool], FloatArray] = {}

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

    def references(self, node: Any) -> dict[str, Any]:
        """The nodes that a node refers to, by the name of the parameter."""
        wanted = self.mi.Properties.Type.ResolvedReference
        return {key: self.nodes[node.props[key].index()] for key in node.props if node.props.type(key) == wanted}

    def texture(self, node: Any, key: str, where: str, default: Constant, scalar: bool = False) -> Texture:
        """The texture under ``key``: three channels, or one if ``scalar``; one channel may stand for three.

        Raises:
            InputError: a file is missing or unreadable, or the value is no reflectance.
            Unsupported: a kind of texture that is not supported.
        """
        props = node.props
        if key not in props:
            return default
        if (referred := self.references(node).get(key)) is not None:
            return self._textured(referred, key, where, scalar)
        if isinstance(props[key], int | float):  # a number is not clipped to [0, 1] as a reflectance spectrum is
            return Constant(np.full(1 if scalar else 3, props[key], np.float32))
        try:
            texture = props.get_texture(key)
        except RuntimeError as error:
            raise InputError(f"{self.path}: the {key} of {where} is not a colour in [0, 1]") from error
        value = np.array(texture.eval(self.mi.SurfaceInteraction3f()), np.float32).reshape(-1) * np.ones(3, np.float32)
        return Constant((value @ _LUMINANCE).reshape(1) if scalar else value)

    def number(self, node: Any, key: str, where: str, default: float) -> float:
        """The constant under ``key``.

        Raises:
            Unsupported: it is textured.
        """
        value = node.props.get(key, default)
        if not isinstance(value, int | float):
            message = f"{self.path}: the {key} of {where} is textured, which is not supported"
            raise Unsupported(message, f"textured {key}")
        return float(value)

    def _textured(self, node: Any, key: str, where: str, scalar: bool) -> Texture:
        plugin, props = node.props.plugin_name(), node.props
        if plugin == "mesh_attribute":
            if abs(float(props.get("scale", 1.0)) - 1.0) > 1e-6:
                message = f"{self.path}: the {key} of {where} sets scale, which is not supported"
                raise Unsupported(message, f"scaled {key}")
            return VertexAttribute(str(props["name"]))
        if plugin != "bitmap":
            message = (
                f"{self.path}: the {key} of {where} is a texture of type {plugin}; there are: bitmap, mesh_attribute"
            )
            raise Unsupported(message, f"{plugin} as {key}")
        for name in props:
            if name not in _BITMAP_KNOWN and props[name] not in _BITMAP_DEFAULTS.get(name, ()):
                message = f"{self.path}: the bitmap for {key} of {where} sets {name}, which is not supported"
                raise Unsupported(message, f"{name} of {key}")
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
