"""Materials of glTF as :class:`~neurad.core.scene_records.Material` records.

What lets light through in a way that cannot be rendered, opacity masks first of all, is refused, as it changes what is
seen behind it. What is opaque and cannot be rendered becomes an :class:`~neurad.core.reflection.UnsupportedModel`: a
fit recovers such a surface anew, and whoever wants its true material gets the reason.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from neurad.core.parameters import METALLIC, ROUGHNESS, SurfaceParameter
from neurad.core.records import Array, FloatArray
from neurad.core.reflection import (
    ConductorModel,
    DielectricModel,
    DiffuseModel,
    PrincipledModel,
    ReflectionModel,
    UnsupportedModel,
)
from neurad.core.scene_records import Bitmap, Constant, Material, Texture, VertexAttribute, constant
from neurad.formats.gltf.file import GltfFile, Json
from neurad.formats.gltf.textures import LEVELS, Place, TextureReader, affine_between
from neurad.runtime.numbers import LENGTH, RADIANCE
from neurad.runtime.reading import shown

COLOUR = "colour"
"""The vertex attribute that colours of vertices become."""
_ONES = constant(1.0, 3)
_LARGEST_INDEX = 100.0
_OPAQUE = 254  # of 255: what writers round down to
_LAYERS = {
    "KHR_materials_clearcoat": "clearcoatFactor",
    "KHR_materials_sheen": "sheenColorFactor",
    "KHR_materials_iridescence": "iridescenceFactor",
    "KHR_materials_anisotropy": "anisotropyStrength",
}
"""Extensions that change how an opaque surface reflects, and what is 0 where they do not."""
_PACKED = {ROUGHNESS: 1, METALLIC: 2}
"""Channels of the picture that has both."""
_NONE: Json = {"pbrMetallicRoughness": {"metallicFactor": 0.0}}
"""What a primitive without a material has. By the format it would be metal, which nothing is that nobody described."""
_OTHERS = ("KHR_materials_unlit", "KHR_materials_pbrSpecularGlossiness")


@dataclass(frozen=True)
class Corners:
    """What a primitive has at its vertices besides places."""

    uvs: dict[int, Array] = field(default_factory=dict)
    """Sets of texture coordinates [v, 2] by their numbers."""
    colours: Array | None = None
    """Linear [v, 3 or 4]."""

    def of(self, file: GltfFile, uv_set: int, where: str) -> Array:
        """A set of texture coordinates.

        Raises:
            InputError: there is none of this number.
        """
        if uv_set not in self.uvs:
            raise file.error(f"{where} has no TEXCOORD_{uv_set}, which the textures of its material need")
        return self.uvs[uv_set]


@dataclass(frozen=True)
class Painted:
    """A material on a primitive."""

    material: int
    """Index into :attr:`MaterialReader.materials`."""
    uv_set: int | None = None
    """The texture coordinates that its textures are looked up by."""
    colours: FloatArray | None = None
    """Values of the vertex attribute :data:`COLOUR` [v, 3], if the material reads it."""


@dataclass(frozen=True)
class Emission:
    """What a material emits."""

    radiance: FloatArray
    """Linear [3]; what the picture, if there is one, is multiplied by."""
    place: Place | None
    both_sides: bool


class MaterialReader:
    """Reads the materials that primitives use.

    Args:
        own: whether neurad wrote it: then ``doubleSided`` says what reflects from behind.
    """

    def __init__(self, file: GltfFile, own: bool) -> None:
        self.file = file
        self.own = own
        self.textures = TextureReader(file)
        self.materials: list[Material] = []
        self._index: dict[object, int] = {}
        self._pixels: dict[object, FloatArray] = {}

    def _described(self, index: object, where: str) -> tuple[Json, str]:
        """What the file says of a material, and its name in sentences."""
        if index is None:
            return _NONE, f"the default material of {where}"
        item = self.file.item("materials", index, where)
        return item, f"material {shown(self.file.name(item, str(index)))}"

    def emission(self, index: object, where: str) -> Emission | None:
        """What a material emits; None if that is nothing."""
        item, about = self._described(index, where)
        factor = self.file.vector(item, "emissiveFactor", [0.0, 0.0, 0.0], about, 0.0, 1.0)
        strength = self.file.extension(item, "KHR_materials_emissive_strength", about) or {}
        factor = factor * self.file.number(strength, "emissiveStrength", 1.0, about, 0.0, RADIANCE)
        if not factor.any():
            return None
        extras = item.get("extras")
        one_side = isinstance(extras, dict) and "emits_to" in extras
        both = item.get("doubleSided") is True and not one_side
        return Emission(factor.astype(np.float32), self.textures.place(item, "emissiveTexture", about), both)

    def paint(self, index: object, corners: Corners, where: str) -> Painted:
        """The material of a primitive.

        Raises:
            InputError: the material lets light through in a way that is not supported, or something in it is broken.
        """
        item, about = self._described(index, where)
        surface = self.file.object(item, "pbrMetallicRoughness", about)
        base = self.textures.place(surface, "baseColorTexture", about)
        rough = self.textures.place(surface, "metallicRoughnessTexture", about)
        problems = [name for name in _OTHERS if self.file.extension(item, name, about) is not None]
        if base is not None and rough is not None and base.uv_set != rough.uv_set:
            one, other = (corners.of(self.file, place.uv_set, where) for place in (base, rough))
            between = affine_between(one, other)
            if between is None:
                problems.append("textures on two sets of texture coordinates")
            rough = None if between is None else replace(rough, uv_set=base.uv_set, to_uv=rough.to_uv @ between)
        factor = self.file.vector(surface, "baseColorFactor", [1.0] * 4, about, 0.0, 1.0)
        albedo, colours = self._albedo(item, base, factor, corners, about, where)
        if base is not None and colours is not None:
            problems.append("vertex colours over a texture")
        place = (
            None if rough is None else self.textures.continued(rough, corners.of(self.file, rough.uv_set, where), where)
        )
        roughness, metallic = (self._scalar(surface, parameter, place, about) for parameter in _PACKED)
        model = self._model(item, albedo, roughness, metallic, about)
        if problems or (problems := self._layers(item, about)):
            if model.is_delta:
                raise self.file.error(f"{about} is smooth and has {problems[0]}, which is not supported")
            said = f"{about} has {problems[0]}, which is not supported"
            model = UnsupportedModel(f"glTF with {problems[0]}", str(self.file.error(said)))
        is_glass = isinstance(model, DielectricModel)
        if is_glass:
            albedo = _ONES
        two_sided = item.get("doubleSided") is True or not self.own or is_glass  # a volume must not be doubleSided
        name = self.file.name(item, "default" if index is None else f"material {shown(index)}")
        material = Material(name, model, albedo, roughness, two_sided, metallic)
        key = index, _key(albedo), _key(roughness), _key(metallic)
        if key not in self._index:
            self._index[key] = len(self.materials)
            self.materials.append(material)
        reads = isinstance(albedo, VertexAttribute)
        set_read = next((place.uv_set for place in (base, rough) if place is not None), None)
        return Painted(self._index[key], set_read, colours if reads else None)

    def _albedo(
        self, item: Json, base: Place | None, factor: Array, corners: Corners, about: str, where: str
    ) -> tuple[Texture, FloatArray | None]:
        """The base colour, and the colours of vertices [v, 3] if these vary."""
        colours, tint = corners.colours, factor[:3].astype(np.float32)
        self._check_opaque(item, base, factor[3], colours, about)
        rgb = None if colours is None else np.asarray(np.clip(colours[:, :3], 0.0, 1.0) * tint, np.float32)
        if rgb is not None and np.ptp(rgb, 0).max() == 0:
            tint, rgb = np.asarray(rgb[0], np.float32), None
        if base is None:
            return (Constant(tint) if rgb is None else VertexAttribute(COLOUR)), rgb
        picture, matrix = self.textures.continued(base, corners.of(self.file, base.uv_set, where), where)
        key = id(picture), tint.tobytes()
        if key not in self._pixels:
            self._pixels[key] = LEVELS[picture[..., :3]] * tint
        return Bitmap(self._pixels[key], matrix.astype(np.float32)), rgb

    def _scalar(
        self, surface: Json, parameter: SurfaceParameter, place: tuple[Array, Array] | None, about: str
    ) -> Texture:
        """Roughness or metalness: a factor and, where there is a picture, its channel."""
        factor = np.float32(self.file.number(surface, f"{parameter.gltf}Factor", 1.0, about, 0.0, 1.0))
        channel = _PACKED[parameter]
        if place is None or factor == 0 or np.ptp(place[0][..., channel]) == 0:
            return constant(float(factor if place is None else factor * (place[0][0, 0, channel] / np.float32(255.0))))
        picture, matrix = place
        key = id(picture), parameter.name, float(factor)
        if key not in self._pixels:
            self._pixels[key] = picture[..., channel : channel + 1].astype(np.float32) * (factor / np.float32(255.0))
        return Bitmap(self._pixels[key], matrix.astype(np.float32))

    def _check_opaque(self, item: Json, base: Place | None, alpha: float, colours: Array | None, about: str) -> None:
        mode = item.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise self.file.error(f"{about} has the alphaMode {shown(repr(mode))}, which is not known")
        if mode == "OPAQUE":
            return
        least = alpha if colours is None or colours.shape[1] == 3 else alpha * float(colours[:, 3].min())
        if base is not None and base.coded.shape[2] == 4:
            coded = int(base.coded[..., 3].min())
            least *= 1.0 if coded >= _OPAQUE else coded / 255.0
        cutoff = self.file.number(item, "alphaCutoff", 0.5, about, 0.0, 1e6) if mode == "MASK" else 1.0
        if least < cutoff - 1e-6:
            raise self.file.error(
                f"{about} has the alphaMode {mode} and is transparent in places, which is not supported: cut its "
                "surface out as geometry, or make it opaque"
            )

    def _model(self, item: Json, albedo: Texture, roughness: Texture, metallic: Texture, about: str) -> ReflectionModel:
        ior = self.file.extension(item, "KHR_materials_ior", about) or {}
        eta = self.file.number(ior, "ior", 1.5, about, 0.0, _LARGEST_INDEX)
        if eta < 1.0:
            raise self.file.error(f"{about}: its ior is {eta:g}, which is not supported; it has to be at least 1")
        smooth, dielectric, metal = _is(roughness, 0.0), _is(metallic, 0.0), _is(metallic, 1.0)
        diffuse = self.file.extension(item, "KHR_materials_diffuse_transmission", about) or {}
        if diffuse.get("diffuseTransmissionFactor", 0) != 0:
            raise self.file.error(f"{about} transmits light diffusely, which is not supported")
        if self._transmits(item, albedo, smooth and dielectric, about):
            volume = self.file.extension(item, "KHR_materials_volume", about) or {}
            return DielectricModel(eta, self.file.number(volume, "thicknessFactor", 0.0, about, 0.0, LENGTH) == 0.0)
        if metal and smooth and isinstance(albedo, Constant):
            return ConductorModel()
        specular = self.file.extension(item, "KHR_materials_specular", about) or {}
        if dielectric and specular.get("specularFactor", 1.0) == 0:
            return DiffuseModel()
        if specular.get("specularFactor", 1.0) != 1 or specular.get("specularColorFactor", [1, 1, 1]) != [1, 1, 1]:
            said = f"{about} has a coat of its own (KHR_materials_specular), which is not supported"
            return UnsupportedModel("glTF with KHR_materials_specular", str(self.file.error(said)))
        return PrincipledModel(float(np.round(max(eta, 1.001), 6)))

    def _transmits(self, item: Json, albedo: Texture, smooth: bool, about: str) -> bool:
        """Whether it is smooth clear glass; all other transmission is refused."""
        found = self.file.extension(item, "KHR_materials_transmission", about) or {}
        factor = self.file.number(found, "transmissionFactor", 0.0, about, 0.0, 1.0)
        if factor == 0.0:
            return False
        volume = self.file.extension(item, "KHR_materials_volume", about) or {}
        colour = self.file.vector(volume, "attenuationColor", [1.0] * 3, about, 0.0, 1.0)
        dispersion = self.file.extension(item, "KHR_materials_dispersion", about) or {}
        clear = isinstance(albedo, Constant) and float(np.min(albedo.value)) == 1.0
        wrong = (
            "transmits light in part" if factor < 1.0 or "transmissionTexture" in found
            else "is rough glass" if not smooth
            else "is coloured glass" if not clear or ("attenuationDistance" in volume and colour.min() < 1.0)
            else "splits light by colour" if dispersion.get("dispersion", 0) != 0
            else None
        )  # fmt: skip
        if wrong:
            raise self.file.error(
                f"{about} {wrong}, which is not supported: only smooth clear glass is (transmissionFactor 1, "
                "roughnessFactor 0, metallicFactor 0, a white baseColorFactor)"
            )
        return True

    def _layers(self, item: Json, about: str) -> list[str]:
        """What lies on a surface or turns its normals."""
        found = [
            name
            for name, key in _LAYERS.items()
            if (layer := self.file.extension(item, name, about)) is not None and layer.get(key, 0) not in (0, [0, 0, 0])
        ]
        return [*found, *(["a map of normals"] if "normalTexture" in item else [])]


def _is(texture: Texture, value: float) -> bool:
    """Whether a texture of one channel has this value everywhere."""
    return isinstance(texture, Constant) and float(texture.value[0]) == value


def _key(texture: Texture) -> object:
    """What is the same for two textures that show the same."""
    if isinstance(texture, Constant):
        return texture.value.tobytes()
    return (id(texture.pixels), texture.to_uv.tobytes()) if isinstance(texture, Bitmap) else texture
