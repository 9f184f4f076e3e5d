"""Records that describe a scene, as files have it: cameras and photographs, textures, materials, meshes, lights.

Conventions are those of :mod:`neurad.core.records`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from neurad.core.lens import Lens
from neurad.core.parameters import PARAMETERS
from neurad.core.records import BoolArray, FloatArray, IntArray
from neurad.core.reflection import ReflectionModel

PINHOLE = Lens()


@dataclass(frozen=True)
class Camera:
    """A camera: a pinhole over the middle of square pixels unless its lens says otherwise.

    With another ``width`` and ``height`` of the same proportions it is the same camera with larger or smaller pixels.
    """

    to_world: FloatArray
    """Camera-to-world matrix [4, 4], OpenGL axes, rigid; float64 is kept."""
    fov_x: float
    """Horizontal field of view in radians that the focal length has over the middle of the film, undistorted."""
    width: int
    height: int
    lens: Lens = PINHOLE
    flash: PunctualLight | None = None
    """A point or spot that moves with it, placed and turned in the camera's space; None where there is none."""

    @property
    def fl_x(self) -> float:
        """Focal length in pixels, along x."""
        return 0.5 * self.width / math.tan(0.5 * self.fov_x)

    @property
    def fl_y(self) -> float:
        """Focal length in pixels, along y."""
        return self.fl_x * self.lens.aspect

    @property
    def cx(self) -> float:
        """Place of the axis in pixels from the left edge of the film; the centre of the first pixel is at 0.5."""
        return self.lens.centre[0] * self.width

    @property
    def cy(self) -> float:
        """Place of the axis in pixels from the upper edge of the film."""
        return self.lens.centre[1] * self.height


@dataclass(frozen=True)
class Development:
    """How the values of a photograph become radiance: ``response(value) / exposure``."""

    response: str = ""
    """As in :func:`neurad.images.response.linear_values`; empty for values that are linear already."""
    levels: int = 0
    """Largest code of the format, 255 or 65535; 0 for floating point."""
    ceiling: float | None = None
    """Value from which on the photograph is clipped, a fraction of the largest code; None where there is no such."""
    exposure: float | None = None
    """What the radiance was multiplied by, 1 where it is not given."""

    @property
    def gain(self) -> float:
        """The exposure, 1 where it is not given."""
        return 1.0 if self.exposure is None else self.exposure


@dataclass(frozen=True)
class View:
    """A camera and the files that belong to it. Ground-truth files are opened by metrics only."""

    name: str
    camera: Camera
    image: str | None = None
    """Path of the photograph."""
    maps: Mapping[str, str] = field(default_factory=dict)
    """Paths of the true maps of surface parameters, by name."""
    relight: str | None = None
    """Path of a photograph of the view under another environment, ``Scene.relight``."""
    mask: str | None = None
    """Path of a picture of the photograph's size: what is black in it is ignored."""
    development: Development = Development()
    spread: str | None = None
    """Path of the standard deviation of the photograph's values (EXR), as ``neurad data hdr`` writes it."""
    left_out: BoolArray | None = None
    """Pixels that are ignored like those of ``mask`` [h, w]."""

    @property
    def files(self) -> dict[str, str]:
        """Paths of its files by what they are."""
        named = {kind: getattr(self, kind) for kind in ("image", "relight", "mask", "spread")}
        return {kind: path for kind, path in (*named.items(), *self.maps.items()) if path is not None}


@dataclass(frozen=True)
class Constant:
    """A texture of one value."""

    value: FloatArray
    """[channels]."""


@dataclass(frozen=True)
class Bitmap:
    """A bilinear, repeated bitmap. Row 0, the first of the file, lies at v = 0 as in Mitsuba; v runs down the rows."""

    pixels: FloatArray
    """Linear values [h, w, channels]; sRGB files are decoded already."""
    to_uv: FloatArray = field(default_factory=lambda: np.eye(3, dtype=np.float32))
    """Transform of homogeneous uv before the lookup [3, 3]."""


@dataclass(frozen=True)
class VertexAttribute:
    """Values given at the vertices of the mesh, interpolated linearly over its triangles."""

    name: str
    """Key in ``Mesh.attributes``."""


Texture = Constant | Bitmap | VertexAttribute


def constant(value: float, channels: int = 1) -> Constant:
    """A texture of one number in all channels."""
    return Constant(np.full(channels, value, np.float32))


DIELECTRIC, METAL = constant(0.0), constant(1.0)
"""Textures of a metalness."""


@dataclass(frozen=True)
class Material:
    """What a surface is made of."""

    name: str
    model: ReflectionModel
    """How it reflects, with the constants of that model."""
    albedo: Texture
    """Base colour; of a conductor its reflectance at normal incidence; of a dielectric its tint (ones)."""
    roughness: Texture
    """Burley roughness; not read by diffuse and smooth models."""
    two_sided: bool = True
    """Whether the BSDF is the same on both sides; a one-sided surface is black from behind."""
    metallic: Texture = DIELECTRIC
    """0 of a dielectric, 1 of a metal; 1 of conductors. Read by the principled model, and kept by a fit."""

    @property
    def textures(self) -> dict[str, Texture]:
        """By the names of surface parameters."""
        return {parameter.name: getattr(self, parameter.name) for parameter in PARAMETERS}


@dataclass(frozen=True)
class Mesh:
    """Triangles that share one material and one emission."""

    name: str
    vertices: FloatArray
    """[v, 3], world space; float64 in readers until a scene is put together, see :mod:`neurad.scene.origin`."""
    faces: IntArray
    """[f, 3]."""
    material: int
    """Index into ``Scene.materials``."""
    normals: FloatArray | None = None
    """Unit vertex normals [v, 3], or None for flat shading."""
    uvs: FloatArray | None = None
    """[v, 2]."""
    attributes: dict[str, FloatArray] = field(default_factory=dict)
    """Named vertex values [v, channels]."""
    radiance: FloatArray | None = None
    """Emitted radiance [3] to the side of the geometric normal, or None."""
    radiance_known: bool = True
    """Whether :attr:`radiance` says how much, and not only that the mesh shines: photographs have to say it then."""
    part_of: str | None = None
    """Name of the mesh that this is a connected part of, where lamps were split."""
    as_read: FloatArray | None = None
    """Vertices as the file has them [v, 3], where its planes were made flat, see :mod:`neurad.scene.flatten`."""

    def of_triangles(self, chosen: IntArray) -> Mesh:
        """The mesh with some of its triangles [t] alone, and the vertices that these use."""
        used, corners = np.unique(self.faces[chosen], return_inverse=True)
        return self.of_vertices(used, corners.reshape(-1, 3).astype(self.faces.dtype))

    def of_vertices(self, chosen: IntArray, faces: IntArray) -> Mesh:
        """The mesh with some of its vertices [v], each perhaps several times, and triangles of these [f, 3]."""
        return replace(
            self,
            vertices=self.vertices[chosen],
            faces=faces,
            normals=None if self.normals is None else self.normals[chosen],
            uvs=None if self.uvs is None else self.uvs[chosen],
            attributes={name: values[chosen] for name, values in self.attributes.items()},
            as_read=None if self.as_read is None else self.as_read[chosen],
        )


@dataclass(frozen=True)
class EnvironmentMap:
    """A lat-long map, +Y up: texel (row i, column j) lies at phi = 2 pi (j + 0.5) / W and theta = pi i / (H - 1), in
    direction (sin theta sin phi, cos theta, -sin theta cos phi), bilinear in between.
    """

    pixels: FloatArray
    """Linear radiance, already multiplied by the emitter's scale [H, W, 3]."""
    to_world: FloatArray = field(default_factory=lambda: np.eye(4, dtype=np.float32))
    """Rotation from the map's frame to the world [4, 4]."""


PunctualKind = Literal["point", "spot", "directional"]


@dataclass(frozen=True)
class PunctualLight:
    """A light without extent: all of it comes from one point, or from one direction. Rays never hit it."""

    name: str
    kind: PunctualKind
    intensity: FloatArray
    """Linear RGB [3]: power per solid angle of a point and along the axis of a spot, irradiance on a surface that faces
    a directional light."""
    position: FloatArray = field(default_factory=lambda: np.zeros(3, np.float32))
    """World place of a point or spot [3]."""
    direction: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0], np.float32))
    """World direction in which a spot or directional light shines, of any length but 0 [3]."""
    cutoff_angle: float = 20.0
    """Degrees from a spot's axis from which on it is dark, in (0, 90)."""
    beam_width: float = 15.0
    """Degrees from a spot's axis up to which it has its full intensity, in [0, cutoff_angle]; between both it falls
    linearly with the angle, as Mitsuba's does."""
