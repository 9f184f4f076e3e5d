"""Reflection models as data: which one a material has, and its constants.

:mod:`neurad.bsdf.table` has the implementation of each. All other modules read these properties.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

from neurad.core.errors import InputError

DiffuseLobe = Literal["burley", "lambert"]
"""The diffuse lobe of a principled model, with the coat that it lies under: Mitsuba's or that of Cycles and glTF."""
LOBES: tuple[str, ...] = get_args(DiffuseLobe)


@dataclass(frozen=True)
class ReflectionModel:
    """Properties of any model. Two equal descriptions reflect alike."""

    plugin: ClassVar[str]
    """Mitsuba's."""
    is_diffuse: ClassVar[bool] = False
    """Lambertian: no roughness and no specular lobe."""
    is_delta: ClassVar[bool] = False
    """A smooth surface, which paths pass through: it scatters into one direction, or into one of two."""

    @property
    def label(self) -> str:
        """Its name in messages."""
        return self.plugin

    @property
    def unsupported(self) -> str | None:
        """Why it cannot be rendered, in words that follow "which"; None of a model that can."""
        return None

    def mitsuba(self, albedo: Any, roughness: Any, metallic: Any = 0.0) -> dict[str, Any]:
        """Mitsuba's one-sided BSDF of the same, with these textures or numbers; only ``principled`` has a metalness."""
        raise InputError(f"a {self.label} cannot be given to Mitsuba")


@dataclass(frozen=True)
class DiffuseModel(ReflectionModel):
    """Lambert's law."""

    plugin = "diffuse"
    is_diffuse = True

    def mitsuba(self, albedo: Any, roughness: Any, metallic: Any = 0.0) -> dict[str, Any]:
        """``diffuse``."""
        return {"type": self.plugin, "reflectance": albedo}


@dataclass(frozen=True)
class PrincipledModel(ReflectionModel):
    """Burley's model, of base colour, roughness and metalness; by default the one that unknown surfaces have."""

    plugin = "principled"
    eta: float = 1.5
    """Refractive index of the dielectric's specular lobe, inside over outside; 1.5 is ``specular`` 0.5."""
    diffuse: DiffuseLobe = "burley"
    """Burley's lobe as in Mitsuba, or Lambert's as in Cycles and glTF, in whose coat microfacets mask and shadow one
    another by their height.
    """

    @property
    def label(self) -> str:
        """Mitsuba's plugin and what differs from its defaults."""
        eta = "" if self.eta == 1.5 else f", eta {self.eta:g}"
        return self.plugin + eta + ("" if self.diffuse == "burley" else ", Lambertian")

    def mitsuba(self, albedo: Any, roughness: Any, metallic: Any = 0.0) -> dict[str, Any]:
        """``principled``."""
        textures = {"base_color": albedo, "roughness": roughness, "metallic": metallic}
        return {"type": self.plugin, "eta": self.eta, **textures}


@dataclass(frozen=True)
class ConductorModel(ReflectionModel):
    """A smooth mirror; the albedo is its reflectance at every angle."""

    plugin = "conductor"
    is_delta = True

    def mitsuba(self, albedo: Any, roughness: Any, metallic: Any = 0.0) -> dict[str, Any]:
        """``conductor`` of the material "none", which reflects the tint alone."""
        return {"type": self.plugin, "material": "none", "specular_reflectance": albedo}


@dataclass(frozen=True)
class DielectricModel(ReflectionModel):
    """Smooth glass; the albedo is its tint (ones)."""

    plugin = "dielectric"
    is_delta = True
    eta: float = 1.5
    """Refractive index, inside over outside."""
    thin: bool = False
    """Both faces of a thin sheet in one surface, which light leaves in the direction that it came in, as Mitsuba's
    ``thindielectric``."""

    @property
    def label(self) -> str:
        """Mitsuba's plugin."""
        return "thindielectric" if self.thin else "dielectric"

    def mitsuba(self, albedo: Any, roughness: Any, metallic: Any = 0.0) -> dict[str, Any]:
        """``dielectric`` or ``thindielectric``."""
        return {"type": self.label, "int_ior": self.eta, "ext_ior": 1.0}


@dataclass(frozen=True)
class RoughConductorModel(ReflectionModel):
    """A metal with a GGX surface. The albedo is its reflectance at normal incidence, ``specular_reflectance`` included;
    the roughness is the root of ``alpha``.
    """

    plugin = "roughconductor"
    eta: tuple[float, float, float]
    """Real part of the refractive index, by colour."""
    k: tuple[float, float, float]
    """Its imaginary part."""
    alpha: float
    """GGX width, the same in all directions."""

    @property
    def normal_reflectance(self) -> tuple[float, ...]:
        """Reflectance of the bare metal at normal incidence, by colour."""
        pairs = zip(self.eta, self.k, strict=True)
        return tuple(((eta - 1.0) ** 2 + k * k) / ((eta + 1.0) ** 2 + k * k) for eta, k in pairs)

    def mitsuba(self, albedo: Any, roughness: Any, metallic: Any = 0.0) -> dict[str, Any]:
        """``roughconductor``, for an albedo that is constant."""
        tint = [float(a) / n for a, n in zip(albedo["value"], self.normal_reflectance, strict=True)]
        index = {key: {"type": "rgb", "value": list(value)} for key, value in (("eta", self.eta), ("k", self.k))}
        width = {"distribution": "ggx", "alpha": self.alpha}
        return {"type": self.plugin, "specular_reflectance": {"type": "rgb", "value": tint}, **index, **width}


@dataclass(frozen=True)
class RoughPlasticModel(ReflectionModel):
    """A diffuse base, whose is the albedo, below a dielectric GGX surface; the roughness is the root of ``alpha``."""

    plugin = "roughplastic"
    eta: float
    """Refractive index of the surface, inside over outside."""
    alpha: float
    """GGX width, the same in all directions."""
    specular: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Tint of what the surface reflects."""
    nonlinear: bool = False
    """Whether colours saturate as light is reflected within."""

    def mitsuba(self, albedo: Any, roughness: Any, metallic: Any = 0.0) -> dict[str, Any]:
        """``roughplastic``."""
        tint = {"type": "rgb", "value": list(self.specular)}
        shape = {"distribution": "ggx", "alpha": self.alpha, "int_ior": self.eta, "ext_ior": 1.0}
        colours = {"diffuse_reflectance": albedo, "specular_reflectance": tint, "nonlinear": self.nonlinear}
        return {"type": self.plugin, **shape, **colours}


@dataclass(frozen=True)
class UnsupportedModel(ReflectionModel):
    """An opaque BSDF of a scene file that cannot be rendered. A fit, which recovers surfaces anew, replaces it."""

    name: str
    """Mitsuba's plugin, and what of it is not supported in a few words."""
    reason: str
    """A sentence that says what is not supported."""

    @property
    def label(self) -> str:
        """Its name."""
        return self.name

    @property
    def unsupported(self) -> str:
        """The reason."""
        return self.reason
