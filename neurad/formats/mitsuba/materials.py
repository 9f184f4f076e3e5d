"""BSDFs of a Mitsuba scene file as :class:`~neurad.core.scene_records.Material` records.

Smooth conductors and dielectrics are read as they are, as paths pass through them in a fit, too. Of the other BSDFs
those that can be rendered are read with their parameters. What is opaque but cannot be rendered becomes an
:class:`~neurad.core.reflection.UnsupportedModel`: a fit recovers such a surface as principled, and whoever wants its
true material gets the reason. Bump and normal maps are ignored in the same way: they turn shading normals only, not the
surface, so light travels as before and the fit sees the mean of what they do. BSDFs that let light through, opacity
masks first of all, change what is seen behind them and are refused.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO, METALLIC, PARAMETERS, ROUGHNESS
from neurad.core.records import FloatArray
from neurad.core.reflection import (
    ConductorModel,
    DielectricModel,
    DiffuseModel,
    PrincipledModel,
    ReflectionModel,
    RoughConductorModel,
    RoughPlasticModel,
    UnsupportedModel,
)
from neurad.core.scene_records import DIELECTRIC, METAL, Bitmap, Constant, Material, Texture, VertexAttribute, constant
from neurad.formats.mitsuba.textures import TextureReader, Unsupported
from neurad.runtime.numbers import UNIT, number, within
from neurad.runtime.reading import native

_GREY, _BLACK, _ONES = constant(0.5, 3), constant(0.0, 3), constant(1.0, 3)
_HALF, _SMOOTH = constant(0.5), constant(0.0)

_IRRELEVANT = ("diffuse_reflectance_sampling_rate", "main_specular_sampling_rate", "clearcoat_sampling_rate",
               "clearcoat_gloss", "spec_tint", "sheen_tint")  # fmt: skip
PLASTIC_ALPHA = 0.01
"""GGX width that smooth plastic gets: half a degree, a pixel of a photograph."""
BECKMANN = 0.873
"""GGX width over that of a Beckmann distribution: the one whose slopes differ least (total variation, 0.18)."""
_LARGE = 100.0
"""Largest refractive index, and smallest one over it; those of materials are below 10."""


def _nameless(
    model: ReflectionModel,
    albedo: Texture = _GREY,
    roughness: Texture = _SMOOTH,
    metallic: Texture = DIELECTRIC,
    two_sided: bool = False,
) -> Material:
    return Material("", model, albedo, roughness, two_sided, metallic)


class MaterialReader:
    """Converts the BSDFs that shapes use, each once."""

    def __init__(self, mi: Any, path: Path, folders: Sequence[Path], nodes: Any) -> None:
        self.mi = mi
        self.path = path
        self.textures = TextureReader(mi, path, folders, nodes)
        self.materials: list[Material] = []
        self._index: dict[tuple[int, int], int | InputError] = {}
        self._converted: dict[str, list[str]] = {}
        self._readers: dict[str, Callable[[Any, str], Material]] = {
            "principled": self._principled,
            "diffuse": self._diffuse,
            "conductor": self._conductor,
            "dielectric": self._dielectric,
            "thindielectric": self._dielectric,
            "roughconductor": self._rough_conductor,
            "roughplastic": self._rough_plastic,
            "plastic": self._rough_plastic,
            "twosided": self._two_sided,
            "blendbsdf": self._blend,
            **dict.fromkeys(("pplastic", "phong", "ward", "measured"), self._opaque),
            **dict.fromkeys(("bumpmap", "normalmap"), self._turned_normals),
        }

    def index(self, node: Any | None, shape: str, shines: bool) -> int:
        """The index in ``materials`` of a BSDF node; a shape without one gets Mitsuba's default.

        Args:
            node: of the BSDF, or None.
            shines: whether the shape is an emitter: its default is black, that of others is grey.

        Raises:
            InputError: a BSDF that lets light through in a way that is not supported, or one of an emitter, which a fit
                does not replace, whose reflectance is not known; it names the shape.
        """
        key = (-1, int(shines)) if node is None else (node.file_index, node.offset)
        if key not in self._index:
            default = replace(_nameless(DiffuseModel(), _BLACK if shines else _GREY), name="default")
            try:
                material = default if node is None else self._material(node, shape)
            except InputError as error:  # said once, not for every shape that has it
                self._index[key] = error
            else:
                self._index[key] = len(self.materials)
                self.materials.append(material)
        found = self._index[key]
        if isinstance(found, InputError):
            raise found
        model = self.materials[found].model
        if shines and model.unsupported:
            raise InputError(f"{model.unsupported}; it is the BSDF of an emitter, {shape}, which has to be known")
        return found

    @property
    def notes(self) -> list[str]:
        """What was decided for the user, a sentence each."""
        return [f"{said}: {', '.join(names)}" for said, names in self._converted.items()]

    def attributes(self, material: int) -> set[str]:
        """The mesh attributes that a material reads."""
        return {t.name for t in self.materials[material].textures.values() if isinstance(t, VertexAttribute)}

    def has_bitmaps(self, material: int) -> bool:
        """Whether a material reads texture coordinates."""
        return any(isinstance(t, Bitmap) for t in self.materials[material].textures.values())

    def _material(self, node: Any, shape: str) -> Material:
        inner = node
        while inner.props.plugin_name() == "twosided" and len(inside := self._inside(inner)) == 1:
            inner = inside[0]
        name = node.props.id() or inner.props.id() or f"{inner.props.plugin_name()} {len(self.materials)}"
        where = f"bsdf {name} of shape {shape}"
        read = self._read(node, where)
        for name_, texture in read.textures.items():
            if isinstance(texture, Constant):  # those that follow from other parameters, too
                what = "reflectance" if name_ == ALBEDO.name else name_
                within(texture.value, f"{self.path}: the {what} of {where}", 0.0, UNIT)
        return replace(read, name=name)

    def _read(self, node: Any, where: str) -> Material:
        plugin = node.props.plugin_name()
        if plugin not in self._readers:
            raise InputError(
                f"{self.path}: {where} has type {plugin}, which is not read, so that it is not known whether it lets "
                "light through; make it a principled BSDF, or one of "
                f"{', '.join(sorted(set(self._readers) - {'principled'}))}"
            )
        try:
            return self._readers[plugin](node, where)
        except Unsupported as error:
            if plugin in ("conductor", "dielectric", "thindielectric"):  # a fit keeps them, as paths go through them
                raise InputError(str(error)) from error
            label = f"{plugin} with {error.what}" if error.what else plugin
            metallic = METAL if plugin == "roughconductor" else DIELECTRIC
            return _nameless(UnsupportedModel(label, str(error)), roughness=_HALF, metallic=metallic)

    def _inside(self, node: Any) -> list[Any]:
        return [child for child in self.textures.references(node).values() if child.type.name == "BSDF"]

    # ---- BSDFs that can be rendered

    def _principled(self, node: Any, where: str) -> Material:
        props = node.props
        spec_trans = props.get("spec_trans", 0.0)
        if not isinstance(spec_trans, int | float) or spec_trans != 0.0:
            raise InputError(f"{self.path}: {where} sets spec_trans, which lets light through and is not supported")
        for key in props:
            known = (*(parameter.mitsuba for parameter in PARAMETERS), "specular", "eta", *_IRRELEVANT)
            if key not in known and self.textures.number(node, key, where, 0.0, 0.0, _LARGE) != 0.0:
                raise Unsupported(f"{self.path}: {where} sets {key}, which is not supported (leave it at 0)", key)
        eta = self.textures.number(node, "eta", where, 1.5, 1.0, _LARGE)
        if "specular" in props:
            eta = 2.0 / (1.0 - (0.08 * self.textures.number(node, "specular", where, 0.5, 0.0, 1.0)) ** 0.5) - 1.0
        defaults = {ALBEDO: _GREY, ROUGHNESS: _HALF, METALLIC: DIELECTRIC}
        textures: dict[str, Any] = {
            parameter.name: self.textures.texture(
                node, parameter.mitsuba, where, default, scalar=parameter.channels == 1
            )
            for parameter, default in defaults.items()
        }
        return _nameless(PrincipledModel(float(np.round(max(eta, 1.001), 6))), **textures)

    def _diffuse(self, node: Any, where: str) -> Material:
        return _nameless(DiffuseModel(), self.textures.texture(node, "reflectance", where, _GREY))

    def _conductor(self, node: Any, where: str) -> Material:
        """A smooth conductor with its reflectance at normal incidence."""
        bsdf = self._load(self._plain(node, where), where)
        si = self.mi.SurfaceInteraction3f()
        si.wi = self.mi.Vector3f(0.0, 0.0, 1.0)
        weight = bsdf.sample(self.mi.BSDFContext(), si, 0.5, self.mi.Point2f(0.5, 0.5))[1]
        return _nameless(ConductorModel(), Constant(np.array(weight, np.float32)), metallic=METAL)

    def _dielectric(self, node: Any, where: str) -> Material:
        """A smooth dielectric, or a thin sheet of it, with its refractive index, inside over outside."""
        described = self._plain(node, where)
        for key in ("specular_reflectance", "specular_transmittance"):
            if described.get(key, 1.0) != 1.0:
                raise InputError(f"{self.path}: {where} sets {key}, which is not supported")
        eta = self._ratio(described, where)
        return _nameless(DielectricModel(eta, node.props.plugin_name() == "thindielectric"), _ONES, two_sided=True)

    def _rough_conductor(self, node: Any, where: str) -> Material:
        alpha = self._alpha(node, where)
        described = self._plain(node, where, but=("specular_reflectance",))
        loaded = self.mi.traverse(self._load(described, where))
        eta, k = (self._colour(loaded[f"{key}.value"]) for key in ("eta", "k"))
        for key, value in (("eta", eta), ("k", k)):
            within(value, f"{self.path}: the {key} of {where}", 0.0, _LARGE)
        model = RoughConductorModel(eta, k, alpha)
        if min(model.normal_reflectance) == 0.0:
            message = f"{self.path}: {where} has a refractive index of 1 in some colour, which reflects nothing"
            raise Unsupported(message, "a refractive index of 1")
        tint = self.textures.texture(node, "specular_reflectance", where, _ONES)
        normal = np.array(model.normal_reflectance, np.float32)
        return _nameless(model, self._scaled(tint, normal, where), constant(alpha**0.5), METAL)

    def _rough_plastic(self, node: Any, where: str) -> Material:
        """A rough plastic, or a smooth one, which is as good as one of a small alpha."""
        alpha = self._alpha(node, where)
        tint = self.textures.texture(node, "specular_reflectance", where, _ONES)
        if not isinstance(tint, Constant):
            message = f"{self.path}: the specular_reflectance of {where} is textured, which is not supported"
            raise Unsupported(message, "textured specular_reflectance")
        described = self._plain(node, where, but=("diffuse_reflectance", "specular_reflectance"))
        eta = self._ratio(described, where)
        model = RoughPlasticModel(eta, alpha, self._colour(tint.value), bool(node.props.get("nonlinear", False)))
        return _nameless(model, self.textures.texture(node, "diffuse_reflectance", where, _GREY), constant(alpha**0.5))

    # ---- BSDFs around others

    def _two_sided(self, node: Any, where: str) -> Material:
        inner = [self._read(child, where) for child in self._inside(node)]
        if len(inner) == 1:
            return replace(inner[0], two_sided=True)
        reason = f"{self.path}: {where} is twosided with {len(inner)} BSDFs inside, which is not supported"
        if len(inner) != 2 or any(read.model.is_delta for read in inner):
            raise InputError(reason)
        return _nameless(UnsupportedModel("twosided with 2 BSDFs", reason), roughness=_HALF, two_sided=True)

    def _blend(self, node: Any, where: str) -> Material:
        inner = [self._read(child, where) for child in self._inside(node)]
        if any(isinstance(read.model, DielectricModel) for read in inner):
            raise InputError(f"{self.path}: {where} blends in a dielectric, which is not supported")
        reason = f"{self.path}: {where} has type blendbsdf, which is not supported"
        return _nameless(UnsupportedModel("blendbsdf", reason), two_sided=any(read.two_sided for read in inner))

    def _turned_normals(self, node: Any, where: str) -> Material:
        plugin, inner = node.props.plugin_name(), [self._read(child, where) for child in self._inside(node)]
        if len(inner) != 1 or inner[0].model.is_delta:
            raise InputError(f"{self.path}: {where} is a {plugin} on a smooth surface, which is not supported")
        reason = f"{self.path}: {where} has type {plugin}, which is not supported"
        return replace(inner[0], model=UnsupportedModel(f"{inner[0].model.label}, {plugin} ignored", reason))

    def _opaque(self, node: Any, where: str) -> Material:
        known = "principled, diffuse, conductor, dielectric, thindielectric, roughconductor, roughplastic, twosided"
        plugin = node.props.plugin_name()
        raise Unsupported(f"{self.path}: {where} has type {plugin}, which is not supported; there are: {known}")

    # ---- parameters

    def _alpha(self, node: Any, where: str) -> float:
        """The GGX width of a rough BSDF, or what comes nearest to it."""
        name = where.removeprefix("bsdf ").partition(" of shape ")[0]
        if node.props.plugin_name() == "plastic":
            said = f"smooth plastic is read as roughplastic with an alpha of {PLASTIC_ALPHA:g}"
            self._converted.setdefault(said, []).append(name)
            return PLASTIC_ALPHA
        distribution = node.props.get("distribution", "beckmann")
        if distribution not in ("ggx", "beckmann"):
            message = f"{self.path}: {where} has distribution {distribution}; there are: ggx, beckmann"
            raise Unsupported(message, f"distribution {distribution}")
        one = self.textures.number(node, "alpha", where, 0.1, 0.0, 1.0)
        u, v = (self.textures.number(node, key, where, one, 0.0, 1.0) for key in ("alpha_u", "alpha_v"))
        if u != v:
            message = f"{self.path}: {where} has alpha_u and alpha_v that differ, which is not supported"
            raise Unsupported(message, "alpha_u unlike alpha_v")
        if distribution == "beckmann":
            said = f"a beckmann distribution is read as ggx with {BECKMANN:g} of its alpha, which comes nearest"
            self._converted.setdefault(said, []).append(name)
            u *= BECKMANN
        return max(u, 1e-4)  # as Mitsuba has it

    def _scaled(self, texture: Texture, factor: FloatArray, where: str) -> Texture:
        """A texture of three channels times a colour."""
        if isinstance(texture, Constant):
            return Constant(texture.value * factor)
        if isinstance(texture, Bitmap):
            return replace(texture, pixels=texture.pixels * factor)
        message = f"{self.path}: the reflectance of {where} is a mesh attribute, which is not supported"
        raise Unsupported(message, "a mesh attribute as reflectance")

    def _colour(self, value: Any) -> tuple[float, float, float]:
        r, g, b = np.array(value, np.float64).reshape(-1) * np.ones(3)
        return float(r), float(g), float(b)

    def _plain(self, node: Any, where: str, but: tuple[str, ...] = ()) -> dict[str, Any]:
        """A BSDF without textures, for ``load_dict``, and without the parameters ``but``."""
        props = node.props
        if texture := next((key for key in self.textures.references(node) if key not in but), None):
            message = f"{self.path}: the {texture} of {where} is textured, which is not supported"
            raise Unsupported(message, f"textured {texture}")
        return {"type": props.plugin_name(), **{key: props[key] for key in props if key not in but}}

    def _ratio(self, described: dict[str, Any], where: str) -> float:
        """The refractive index of a dielectric, inside over outside."""
        eta = float(self.mi.traverse(self._load(described, where))["eta"])
        return number(eta, f"{self.path}: the refractive index of {where}, inside over outside,", 1.0 / _LARGE, _LARGE)

    def _load(self, described: dict[str, Any], where: str) -> Any:
        try:
            with native(self.path, ""):
                return self.mi.load_dict(described)
        except InputError as error:
            message = f"{self.path}: {where} has parameters that Mitsuba does not accept"
            raise Unsupported(message, "parameters that Mitsuba does not accept") from error
