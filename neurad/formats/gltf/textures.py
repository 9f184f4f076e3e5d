"""Textures of glTF: pictures, their place on a surface, and how they go on beyond their edges."""

import math
from dataclasses import dataclass

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, Bytes
from neurad.formats.gltf.file import GltfFile, Json
from neurad.images.image_io import from_srgb, read_coded
from neurad.runtime.numbers import TEXEL, within
from neurad.runtime.reading import shown

_CLAMP, _MIRROR, _REPEAT = 33071, 33648, 10497
_TRANSFORM, _WEBP = "KHR_texture_transform", "EXT_texture_webp"
_PADDED = 4
"""Times the side of a picture that a clamped one may be continued."""
_SAME = 1e-6  # difference of texture coordinates that does not count, in pictures
LEVELS = from_srgb(np.arange(256, dtype=np.float32) / 255.0)
"""Linear values of sRGB's 256 steps."""


@dataclass(frozen=True)
class Place:
    """A picture, and where it lies on a surface."""

    coded: Bytes
    """As it is coded [h, w, 3 or 4]; row 0 lies at v = 0."""
    uv_set: int
    to_uv: Array
    """What takes texture coordinates to the picture's [3, 3], float64."""
    wrap: tuple[int, int]
    """How it goes on along u and v."""


class TextureReader:
    """Reads the pictures of a file, each once."""

    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self._coded: dict[int, Bytes] = {}
        self._continued: dict[tuple[int, tuple[int, ...]], Bytes] = {}

    def place(self, parent: Json, key: str, where: str) -> Place | None:
        """The texture under a key, or None.

        Raises:
            InputError: it refers to what there is not, or its picture cannot be read.
        """
        if key not in parent:
            return None
        info, about = self.file.object(parent, key, where), f"{where}: {key}"
        texture = self.file.item("textures", info.get("index"), about)
        uv_set, to_uv = self.file.count(info, "texCoord", 0, about), np.eye(3)
        if (moved := self.file.extension(info, _TRANSFORM, about)) is not None:
            uv_set = self.file.count(moved, "texCoord", uv_set, about)
            to_uv = self._transform(moved, about)
        sampler = self.file.item("samplers", texture["sampler"], about) if "sampler" in texture else {}
        wrap = sampler.get("wrapS", _REPEAT), sampler.get("wrapT", _REPEAT)
        if not all(isinstance(x, int) and x in (_CLAMP, _MIRROR, _REPEAT) for x in wrap):
            raise self.file.error(f"{about}: its sampler wraps by {shown(wrap)}, which is not known")
        webp = self.file.extension(texture, _WEBP, about)
        source = texture.get("source") if webp is None else webp.get("source")
        if source is None:
            self.file.check_uncompressed(texture, about)
        return Place(self._picture(source, about), uv_set, to_uv, wrap)

    def _transform(self, moved: Json, about: str) -> Array:
        """The matrix of a texture transform as Blender and Khronos' viewer apply it: scaled, turned, moved."""
        offset = self.file.vector(moved, "offset", [0.0, 0.0], about, -TEXEL, TEXEL)
        scale = self.file.vector(moved, "scale", [1.0, 1.0], about, -TEXEL, TEXEL)
        angle = self.file.number(moved, "rotation", 0.0, about, -1e6, 1e6)
        c, s = math.cos(angle), math.sin(angle)
        turn = np.array([[c, s], [-s, c]])
        matrix = np.eye(3)
        matrix[:2, :2], matrix[:2, 2] = turn * scale, offset
        return matrix

    def _picture(self, source: object, about: str) -> Bytes:
        item = self.file.item("images", source, about)
        assert isinstance(source, int)
        if source not in self._coded:
            name = f"image {source} ({shown(self.file.name(item, str(item.get('uri', ''))[:80]))})"
            if "bufferView" in item:
                data = bytes(self.file.view(item["bufferView"], name)[0])
            elif "uri" in item:
                data = self.file.resource(item, name)
            else:
                raise self.file.error(f"{name} has no data")
            self._coded[source] = read_coded(data, f"{shown(self.file.path)}: {name}")
        return self._coded[source]

    def continued(self, place: Place, uvs: Array, where: str) -> tuple[Bytes, Array]:
        """The picture and its matrix such that repeating it shows the same on a surface as wrapping it does.

        Args:
            uvs: texture coordinates that occur on the surface [v, 2].

        Raises:
            InputError: a clamped picture ends far inside the surface.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # what is no number is said below
            at = uvs @ place.to_uv[:2, :2].T + place.to_uv[:2, 2]
        within(at, f"{shown(self.file.path)}: {where}: texture coordinates", -TEXEL, TEXEL)
        changes, matrix = list[int](), place.to_uv.copy()
        for axis, side in ((0, place.coded.shape[1]), (1, place.coded.shape[0])):
            low, high = float(at[:, axis].min()), float(at[:, axis].max())
            edge = 0.5 / side - _SAME
            before, after, mirrored = 0, 0, 0
            if place.wrap[axis] != _REPEAT and (low < edge or high > 1.0 - edge):
                mirrored = int(place.wrap[axis] == _MIRROR)
                before = 0 if mirrored else max(math.ceil(0.5 - low * side), 0)
                after = 0 if mirrored else max(math.ceil(0.5 + (high - 1.0) * side), 0)
            if before + after > _PADDED * side + 2:
                raise InputError(
                    f"{shown(self.file.path)}: {where} has a texture that is clamped far inside the surface, which is "
                    "not supported; let it repeat, or unwrap the surface within the picture"
                )
            changes += [before, after, mirrored]
            matrix[axis] *= side / ((side + before + after) * (1 + mirrored))
            matrix[axis, 2] += before / (side + before + after)
        key = id(place.coded), tuple(changes)
        if key not in self._continued:
            x0, x1, x_mirrored, y0, y1, y_mirrored = changes
            picture = np.pad(place.coded, ((y0, y1), (x0, x1), (0, 0)), "edge") if any(changes) else place.coded
            picture = np.concatenate((picture, picture[:, ::-1]), 1) if x_mirrored else picture
            self._continued[key] = np.concatenate((picture, picture[::-1])) if y_mirrored else picture
        return self._continued[key], matrix


def affine_between(one: Array, other: Array) -> Array | None:
    """The matrix [3, 3] that takes texture coordinates [v, 2] to others; None where no single one does."""
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return None
    full = np.column_stack((one, np.ones(len(one)))).astype(np.float64)
    solved = np.linalg.lstsq(full, other.astype(np.float64), rcond=None)[0]
    if not np.isfinite(solved).all() or np.abs(full @ solved - other).max() > _SAME:
        return None
    return np.vstack((solved.T, (0.0, 0.0, 1.0)))


def look_up(coded: Array, matrix: Array, uvs: Array) -> Array:
    """Values [..., c] of a repeated picture [h, w, c], bilinear, at texture coordinates [..., 2]."""
    uv = np.asarray(uvs, np.float64)
    height, width = coded.shape[:2]
    xy = (uv @ matrix[:2, :2].T + matrix[:2, 2]) * (width, height) - 0.5
    low = np.floor(xy)
    x, y = np.moveaxis(low.astype(np.int64), -1, 0)
    fx, fy = np.moveaxis((xy - low)[..., None], -2, 0)
    x0, x1, y0, y1 = x % width, (x + 1) % width, y % height, (y + 1) % height
    above = coded[y0, x0] * (1 - fx) + coded[y0, x1] * fx
    below = coded[y1, x0] * (1 - fx) + coded[y1, x1] * fx
    return np.asarray(above * (1 - fy) + below * fy)
