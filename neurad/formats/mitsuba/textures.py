"""Textures of a Mitsuba scene file as :class:`~neurad.core.scene_records.Texture` records."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.colour import LUMINANCE
from neurad.core.errors import InputError
from neurad.core.records import FloatArray
from neurad.core.scene_records import Bitmap, Constant, Texture, VertexAttribute
from neurad.formats.mitsuba.xml_check import found_in
from neurad.images.image_io import read_bitmap
from neurad.images.picture_headers import check_hdr, check_pfm
from neurad.runtime.numbers import RADIANCE, UNIT, number, within
from neurad.runtime.reading import native, regular_file, shown

_LUMINANCE = np.array(LUMINANCE, np.float32)  # Mitsuba's, for a scalar from a colour bitmap
_BITMAP_DEFAULTS = {"filter_type": ("bilinear",), "wrap_mode": ("repeat",)}
_BITMAP_KNOWN = ("filename", "raw", "to_uv", "format", "accel")
_PLANE = (0, 1, 3)  # rows and columns of a transform of space that act on homogeneous uv
_BY_MITSUBA = {".hdr": check_hdr, ".rgbe": check_hdr, ".pfm": check_pfm}
_HEAD = 1 << 16  # bytes that have the header of a picture


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
    """Converts the textures of BSDFs, reading every image file once; ``nodes`` are those of the parsed file."""

    def __init__(self, mi: Any, path: Path, folders: Sequence[Path], nodes: Any) -> None:
        self.mi = mi
        self.path = path
        self.folders = folders
        self.nodes = nodes
        self._pixels: dict[tuple[str, bool, bool], FloatArray] = {}
        self._checked: set[tuple[str, bool, float]] = set()

    def pixels(self, filename: str, raw: bool, scalar: bool = False) -> FloatArray:
        """The linear pixels [h, w, 1 or 3], one channel if ``scalar``, of an image file beside the scene file, read
        once.
        """
        key = filename, raw, scalar
        if key not in self._pixels and scalar:
            pixels = self.pixels(filename, raw)
            self._pixels[key] = pixels if pixels.shape[2] == 1 else (pixels @ _LUMINANCE)[..., None]
        elif key not in self._pixels:
            file = found_in(self.folders, filename)
            check = _BY_MITSUBA.get(file.suffix.lower())
            self._pixels[key] = read_bitmap(file, raw) if check is None else self._by_mitsuba(file, check)
        return self._pixels[key]

    def _by_mitsuba(self, file: Path, check: Callable[[Path, bytes], object]) -> FloatArray:
        """The linear pixels [h, w, 3] of a file that only Mitsuba reads."""
        said = "it cannot be read as an image"
        regular_file(file, "there is no such texture file")
        with native(file, said), file.open("rb") as stream:
            check(file, stream.read(_HEAD))
        with native(file, said):
            bitmap = self.mi.Bitmap(str(file))
            rgb = bitmap.convert(self.mi.Bitmap.PixelFormat.RGB, self.mi.Struct.Type.Float32, srgb_gamma=False)
            return np.array(rgb, np.float32)

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
        said = f"the {key} of {where}"
        if isinstance(props[key], int | float):
            return Constant(
                np.full(1 if scalar else 3, number(props[key], f"{self.path}: {said}", 0.0, 1.0), np.float32)
            )
        with native(self.path, f"{said} is not a colour in [0, 1]"):
            texture = props.get_texture(key)
            value = np.array(texture.eval(self.mi.SurfaceInteraction3f()), np.float32).reshape(-1)
        within(value, f"{self.path}: {said}", 0.0, 1.0)
        value = value * np.ones(3, np.float32)
        return Constant((value @ _LUMINANCE).reshape(1) if scalar else value)

    def emitted(self, node: Any, key: str, where: str) -> Bitmap | None:
        """The picture that an emitter shines by [h, w, 3], linear; None where ``key`` is no texture.

        Raises:
            InputError: a file is missing or unreadable, a value is none to compute with, or it is another texture.
        """
        if (referred := self.references(node).get(key)) is None:
            return None
        made = self._textured(referred, key, where, False, RADIANCE)
        if not isinstance(made, Bitmap):
            raise InputError(f"{self.path}: the {key} of {where} is a mesh_attribute, which is not supported")
        return Bitmap(np.broadcast_to(made.pixels, (*made.pixels.shape[:2], 3)), made.to_uv)

    def number(self, node: Any, key: str, where: str, default: float, low: float, high: float) -> float:
        """The constant under ``key``.

        Raises:
            InputError: it is outside of [low, high].
            Unsupported: it is textured.
        """
        value = node.props.get(key, default)
        if not isinstance(value, int | float):
            message = f"{self.path}: the {key} of {where} is textured, which is not supported"
            raise Unsupported(message, f"textured {key}")
        return number(value, f"{self.path}: the {key} of {where}", low, high)

    def _textured(self, node: Any, key: str, where: str, scalar: bool, most: float = UNIT) -> Texture:
        plugin, props = node.props.plugin_name(), node.props
        if plugin == "mesh_attribute":
            if props.get("scale", 1.0) not in (1, 1.0):
                message = f"{self.path}: the {key} of {where} sets scale, which is not supported"
                raise Unsupported(message, f"scaled {key}")
            if not isinstance(props.get("name", None), str):
                raise InputError(f"{self.path}: the mesh_attribute for {key} of {where} has no name")
            return VertexAttribute(props["name"])
        if plugin != "bitmap":
            message = (
                f"{self.path}: the {key} of {where} is a texture of type {plugin}; there are: bitmap, mesh_attribute"
            )
            raise Unsupported(message, f"{plugin} as {key}")
        for name in props:
            if name not in _BITMAP_KNOWN and props[name] not in _BITMAP_DEFAULTS.get(name, ()):
                message = f"{self.path}: the bitmap for {key} of {where} sets {name}, which is not supported"
                raise Unsupported(message, f"{name} of {key}")
        filename, raw = props.get("filename", None), props.get("raw", False)
        if not isinstance(filename, str) or not isinstance(raw, bool):
            raise InputError(
                f"{self.path}: the bitmap for {key} of {where} has no filename, or a raw that is not a boolean"
            )
        to_uv = np.eye(3, dtype=np.float32)
        if "to_uv" in props:
            to_uv = np.array(getattr(props["to_uv"], "matrix", np.full((4, 4), np.nan)), np.float32)[
                np.ix_(_PLANE, _PLANE)
            ]
            within(to_uv, f"{self.path}: the to_uv of the bitmap for {key} of {where}", -1e6, 1e6)
        pixels = self.pixels(filename, raw, scalar)
        if (filename, raw, most) not in self._checked:
            kind = key if scalar or most != UNIT else "reflectance"
            within(pixels, f"{shown(found_in(self.folders, filename))}: {kind}", 0.0, most)
            self._checked.add((filename, raw, most))
        return Bitmap(pixels, to_uv)
