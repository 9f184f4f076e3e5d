"""The base colour with which another program's model sends back as much light as neurad's.

Mitsuba adds Burley's diffuse lobe under the coat; glTF viewers and Cycles scale a Lambertian one by what the coat
leaves; neurad has the lobe that photographs ask for. With the same base colour the second sends back less, and in a
closed room that adds up to a fifth of the light. Here the means over all directions of both are equated. What remains
are differences between angles, about 3 %: textures cannot say them, nodes in Blender can, by a table over the angle of
the viewer.
"""

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from neurad.bsdf.microfacet import MIN_ALPHA, fresnel_dielectric, reflectance
from neurad.bsdf.principled import lobes_pdf
from neurad.core.parameters import ALBEDO, METALLIC, ROUGHNESS
from neurad.core.records import Array, FloatArray
from neurad.core.reflection import DiffuseLobe, PrincipledModel
from neurad.core.scene_records import Bitmap, Constant, Material, Texture
from neurad.images.image_io import png, write_exr
from neurad.pages.colours import encode
from neurad.runtime import threads
from neurad.scene.description import is_dielectric

Target = Literal["blender", "gltf", "exact"]
"""Whose model the colour is for: Cycles', the sample BRDF of the Khronos group, or Mitsuba's ``principled``."""
BY_ANGLES: tuple[Target, DiffuseLobe] = "blender", "burley"
"""What is multiplied by :func:`over_angles`: Burley's lobe in Cycles."""
ETA = 1.5
"""Refractive index of the coat in all three."""
ROUGHNESSES = 65
"""Entries of the tables, evenly over roughness 0 to 1."""
ANGLES = 64
"""Sides of the table over angles and roughness."""
ROWS = 1024
"""Rows of texels that are coded at once: bounds the memory."""
_NODES = 24
_F0 = 0.04
_FRESNEL = functools.partial(fresnel_dielectric, eta=ETA)


@dataclass(frozen=True)
class Energy:
    """What lobes send back of light that is the same from everywhere, over roughness [ROUGHNESSES]."""

    diffuse: Array
    """E_d: Burley's diffuse lobe of base colour 1."""
    separable: Array
    """The coat over it, whose masking and shadowing are independent, as in Mitsuba."""
    correlated: Array
    """The coat over Lambert's lobe, as in Cycles."""
    schlick: Array
    """That coat with Schlick's Fresnel factor, as glTF has it."""
    under_schlick: float
    """E_g: Lambert's lobe of colour 1 as glTF has it, scaled by what Schlick's factor at the half-vector leaves."""


@functools.cache
def energy() -> Energy:
    """The tables, by Gauss-Legendre quadrature."""
    cosine, weight = _nodes()
    mean = 2.0 * weight * cosine  # over the directions of the viewer, by their cosine
    roughness = torch.linspace(0.0, 1.0, ROUGHNESSES, dtype=torch.float64)
    rows = []
    for r in roughness.tolist():
        coats = _coat(cosine, r, False), _coat(cosine, r, True), _coat(cosine, r, True, _schlick)
        rows.append([float(mean @ part) for part in (_diffuse(cosine, r), *coats)])
    wo, wi, solid = _pairs(cosine)
    half = torch.nn.functional.normalize(wo + wi, dim=-1)
    left = (1.0 - _schlick((wo * half).sum(-1))) * wi[:, 2] / math.pi
    under = float(mean @ (left * solid).view(len(cosine), -1).sum(1))
    diffuse, separable, correlated, schlick = np.array(rows).T
    return Energy(diffuse, separable, correlated, schlick, under)


def is_converted(material: Material) -> bool:
    """Whether other programs need other base colours: where diffuse light has a coat, and none of it is metal."""
    return isinstance(material.model, PrincipledModel) and is_dielectric(material.metallic)


def conversion(material: Material, target: Target) -> tuple[Target, DiffuseLobe]:
    """Whose base colours a material gets in files for ``target``, and from which diffuse lobe."""
    return (target, lobe_of(material)) if is_converted(material) else ("exact", "burley")


def lobe_of(material: Material) -> DiffuseLobe:
    """Its diffuse lobe under a coat."""
    return material.model.diffuse if isinstance(material.model, PrincipledModel) else "burley"


def for_mitsuba(material: Material) -> Material:
    """A material whose textures are constants or of one size, as Mitsuba's ``principled`` has it."""
    if not isinstance(material.model, PrincipledModel) or material.model.diffuse == "burley":
        return material
    values = []
    for known in (material.albedo, material.roughness):
        assert isinstance(known, Constant | Bitmap)
        values.append(np.asarray(known.value if isinstance(known, Constant) else known.pixels, np.float32))
    albedo, rough = values
    base = base_for("exact", albedo, rough, "lambert") if is_converted(material) else albedo
    texture: Texture = Constant(base.reshape(-1)) if base.ndim == 1 else Bitmap(np.ascontiguousarray(base))
    return replace(material, albedo=texture, model=replace(material.model, diffuse="burley"))


def base_for(target: Target, base: FloatArray, roughness: FloatArray, lobe: DiffuseLobe = "burley") -> FloatArray:
    """The base colour that ``target`` needs for neurad's [..., 3] and roughness [..., 1]; it may leave 0 to 1."""
    if target == ("exact" if lobe == "burley" else "blender"):
        return base
    found = energy()

    def at(values: Array) -> FloatArray:
        return np.interp(roughness, np.linspace(0.0, 1.0, ROUGHNESSES), values).astype(np.float32)

    correlated = at(found.correlated)
    mitsuba, cycles = (at(found.diffuse), at(found.separable)), (1.0 - correlated, correlated)
    diffuse, coat = mitsuba if lobe == "burley" else cycles
    if target == "gltf":
        of_target, its_coat = np.full_like(coat, found.under_schlick), at(found.schlick)
    else:
        of_target, its_coat = mitsuba if target == "exact" else cycles
    result: FloatArray = (base * diffuse + coat - its_coat) / of_target
    return result


@functools.cache
def over_angles() -> FloatArray:
    """What base colours for Blender have yet to be multiplied by for a viewer at an angle [ANGLES, ANGLES].

    With it a surface in Cycles sends as much of a light that is the same from everywhere into each direction as it does
    here. Rows are roughness, columns the cosine to the viewer, both at the centres of ANGLES equal steps over [0, 1].
    """
    steps = (torch.arange(ANGLES, dtype=torch.float64) + 0.5) / ANGLES
    found, nodes = energy(), np.linspace(0.0, 1.0, ROUGHNESSES)

    def row(r: float) -> Array:
        mean = np.interp(r, nodes, found.diffuse) / (1.0 - np.interp(r, nodes, found.correlated))
        of_row: Array = (_diffuse(steps, r) / (1.0 - _coat(steps, r, True))).numpy() / mean
        return of_row

    return np.asarray(list(threads.parallel_map(row, steps.tolist())), np.float32)


def _coat(cosine: Tensor, roughness: float, correlated: bool, fresnel: Callable[[Tensor], Tensor] = _FRESNEL) -> Tensor:
    """Directional albedo [c] of a coat."""
    alpha = max(roughness * roughness, MIN_ALPHA)
    return reflectance(cosine, alpha, lambda c: fresnel(c)[:, None], correlated=correlated)[:, 0]


def _schlick(cosine: Tensor) -> Tensor:
    return _F0 + (1.0 - _F0) * (1.0 - cosine).clamp(0.0, 1.0) ** 5


def _nodes() -> tuple[Tensor, Tensor]:
    """Nodes and weights over [0, 1]."""
    at, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(_NODES))
    return 0.5 + 0.5 * at, 0.5 * weight


def _pairs(cosine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Directions towards viewers and lights [c * k, 3], and the solid angles [c * k] of the latter."""
    at, weight = _nodes()
    phi = (torch.arange(2 * _NODES, dtype=torch.float64) + 0.5) * (math.pi / _NODES)
    z, angle = (x.reshape(-1) for x in torch.meshgrid(at, phi, indexing="ij"))
    r = (1.0 - z * z).sqrt()
    wi = torch.stack((r * angle.cos(), r * angle.sin(), z), -1)
    solid = weight.repeat_interleave(2 * _NODES) * (math.pi / _NODES)
    wo = torch.stack(((1.0 - cosine * cosine).sqrt(), torch.zeros_like(cosine), cosine), -1)
    return wo.repeat_interleave(len(wi), 0), wi.repeat(len(wo), 1), solid.repeat(len(wo))


def _diffuse(cosine: Tensor, roughness: float) -> Tensor:
    """Directional albedo [c] of Burley's diffuse lobe of colour 1."""
    wo, wi, solid = _pairs(cosine)
    d = lobes_pdf(torch.full_like(wo[:, :1], roughness), wo, wi, ETA)[0]
    return (d * solid).view(len(cosine), -1).sum(1)


@dataclass(frozen=True)
class Coded:
    """The textures of a mesh as files."""

    base: bytes
    """Base colour, sRGB, 8 bits."""
    orm: bytes
    """Occlusion (1), roughness and metalness, linear, 8 bits."""
    clipped: int
    """Texels whose base colour would have left [0, 1]."""


def coded(maps: Mapping[str, FloatArray], target: Target, lobe: DiffuseLobe = "burley") -> Coded:
    """Textures of a mesh [h, w, channels], by the name of the surface parameter, as the two files that glTF and USD
    read; ``lobe`` is the diffuse one of the maps.
    """
    albedo = maps[ALBEDO.name]
    base = np.empty((*albedo.shape[:2], 3), np.uint8)
    orm = np.full(base.shape, 255, np.uint8)
    clipped = 0
    for top in range(0, len(albedo), ROWS):
        part = slice(top, top + ROWS)
        roughness, metallic = (
            maps[p.name][part].astype(np.float32) if p.name in maps else np.full(1, p.absent, np.float32)
            for p in (ROUGHNESS, METALLIC)
        )
        wanted = base_for(target, albedo[part].astype(np.float32), roughness, lobe)
        clipped += int(((wanted > 1.0) | (wanted < 0.0)).any(-1).sum())
        base[part] = encode(wanted)
        for channel, values in ((1, roughness), (2, metallic)):
            orm[part, :, channel] = np.rint(np.clip(values[..., 0], 0.0, 1.0) * 255.0)
    return Coded(png(base), png(orm), clipped)


def texture_files(name: str) -> tuple[str, str]:
    """Where the two files of a mesh lie in a folder."""
    return f"textures/{name}_base_color.png", f"textures/{name}_orm.png"


def write_over_angles(path: Path) -> None:
    """Write what :func:`over_angles` says as a picture for Blender, grey and linear."""
    table = np.repeat(over_angles()[::-1, :, None], 3, -1)  # the lowest row of a picture is v = 0 in Blender
    write_exr(path, np.ascontiguousarray(table), half=False)


def smooth_colour(material: Material) -> FloatArray:
    """The colour [3] of a mirror or of glass, which are written as they came and get no texture."""
    value = material.albedo.value if isinstance(material.albedo, Constant) else np.float32(0.5)
    return np.broadcast_to(value, 3).astype(np.float32)
