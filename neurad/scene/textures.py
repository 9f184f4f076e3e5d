"""Materials that are known: a scene's own textures, looked up as Mitsuba does, and the same everywhere."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO, ROUGHNESS, SurfaceParameter
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.scene_records import Bitmap, Constant, Texture, VertexAttribute, constant
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.lanes import lanes_of, put, where_needed
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry


class ConstantMaterials(nn.Module):
    """One grey albedo and one roughness everywhere: numbers, or parameters, which every method differentiates by."""

    def __init__(self, grey: float | Tensor, roughness: float | Tensor = 1.0) -> None:
        super().__init__()
        self.grey = grey
        self.roughness = roughness

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3]."""
        return self.grey * torch.ones_like(si.p)

    def forward(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        return Surface(self.albedo(si), self.roughness * torch.ones_like(si.p[:, :1]))


class TrueMaterials(nn.Module):
    """BSDF parameters as the scene file gives them. No parameters to train; buffers are not part of checkpoints.

    Raises:
        InputError: a material cannot be rendered, or it reads a vertex attribute that no mesh has.
    """

    model: Tensor

    def __init__(self, scene: Scene, geometry: Geometry) -> None:
        super().__init__()
        if reason := next((model.unsupported for model in scene.features.models if model.unsupported), None):
            raise InputError(reason)
        self.geometry = geometry
        shaded = dict.fromkeys((ALBEDO, ROUGHNESS, *scene.parameters))  # a Surface has the first two in any scene
        self.fields = nn.ModuleDict({p.name: SceneTexture(scene, p, geometry) for p in shaded})
        index = {model: i for i, model in enumerate(scene.features.models)}
        model = torch.tensor([index.get(m.model, -1) for m in scene.materials], dtype=torch.int64)
        self.register_buffer("model", model, persistent=False)
        self.is_mixed = scene.features.is_mixed

    def forward(self, si: SurfaceInteraction) -> Surface:
        """Parameters at the lanes of ``si``; zeros where there is no surface."""
        values = {name: texture(si) for name, texture in self.fields.items()}
        return Surface(**values, model=self.model[self.geometry.material_at(si)] if self.is_mixed else None)

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3]; zeros where there is no surface."""
        albedo: Tensor = self.fields[ALBEDO.name](si)
        return albedo


class SceneTexture(nn.Module):
    """A surface parameter as the scene's files have it."""

    def __init__(self, scene: Scene, parameter: SurfaceParameter, geometry: Geometry) -> None:
        super().__init__()
        self.table = TextureTable([getattr(m, parameter.name) for m in scene.materials], parameter.channels)
        self.geometry = geometry

    @torch.no_grad()
    def forward(self, si: SurfaceInteraction, albedo: Tensor | None = None) -> Tensor:
        """Values [n, channels] at the lanes of ``si``, zeros where there is no surface; the albedo plays no part."""
        values: Tensor = self.table(self.geometry.material_at(si), si, self.geometry)
        return values


class KnownSurfaces(nn.Module):
    """Puts the scene's own values on smooth surfaces, which a fit keeps, and on those that emit light, as they belong
    to what is known of the light.

    A photograph of a lamp does not show what the lamp reflects, but whatever is taken for it lights the room: in a
    kitchen whose lamps reflect 2 %, a fit that was free to think 60 % had 7 % too much light and albedos 4 % too low.

    Args:
        geometry: says which triangles emit.
        meshes: further meshes that are treated so: lamps that are off now.
    """

    known: Tensor

    def __init__(
        self, scene: Scene, parameter: SurfaceParameter, geometry: Geometry, meshes: frozenset[int] = frozenset()
    ) -> None:
        super().__init__()
        known = geometry.emission.amax(-1) > 0
        if meshes := meshes | scene.smooth_meshes:
            known |= torch.isin(geometry.mesh_index, torch.tensor(sorted(meshes), device=known.device))
        used = set(geometry.material[known].tolist())
        textures = [
            getattr(material, parameter.name) if i in used else constant(0.0)
            for i, material in enumerate(scene.materials)
        ]
        self.table = TextureTable(textures, parameter.channels)
        self.geometry = geometry
        self.register_buffer("known", known, persistent=False)

    def forward(self, si: SurfaceInteraction, values: Tensor) -> Tensor:
        """``values`` [n, channels] at the lanes of ``si``, replaced where these are known."""
        return where_needed(self._at(si), values, lambda lane: self._own(si, lane))

    def replace_(self, si: SurfaceInteraction, values: Tensor) -> Tensor:
        """Replace ``values`` [n, channels], which have no gradient, in place; the lanes where that was done [n]."""
        if use_kernel(self.table.is_constant, values, self.table.constant):
            from neurad.scene import geometry_kernels as kernels  # imported at first use: numba is slow to load

            replaced = torch.empty_like(si.valid)
            read = si.prim, si.valid, self.known, self.geometry.material, self.table.constant
            given: list[Any] = [x.contiguous().numpy() for x in (*read, values, replaced)]
            kernels.put_known(*given)
            return replaced
        replaced = self._at(si)
        if (lanes := lanes_of(replaced)) is not None:
            values.copy_(put(values, replaced, lanes, self._own(si, lanes)))
        return replaced

    def _at(self, si: SurfaceInteraction) -> Tensor:
        """Lanes whose values are known [n]."""
        return self.known[si.prim.clamp_min(0)] & si.valid

    def _own(self, si: SurfaceInteraction, lane: Tensor | slice) -> Tensor:
        """The scene's values at some lanes."""
        here = si[lane]
        material = self.geometry.material_at(here)
        if self.table.is_constant:
            return self.table.constant[material]
        value: Tensor = self.table(material, here, self.geometry)
        return value


class TextureTable(nn.Module):
    """One texture a material, all bitmaps packed into one table so that a lookup takes no loop over materials.

    Args:
        textures: by material.
        channels: of every result; a texture of one channel is repeated.
    """

    constant: Tensor
    kind: Tensor
    texels: Tensor
    place: Tensor
    to_uv: Tensor

    def __init__(self, textures: list[Texture], channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.names = sorted({t.name for t in textures if isinstance(t, VertexAttribute)})
        constant = np.zeros((len(textures), channels), np.float32)
        kind = np.full(len(textures), -2, np.int64)  # -2 constant, -1 bitmap, else index of a vertex attribute
        place = np.ones((len(textures), 3), np.int64)  # first texel, width, height
        to_uv = np.zeros((len(textures), 2, 3), np.float32)
        packed: list[np.ndarray] = []
        first: dict[int, int] = {}  # materials may share a bitmap
        total = 0
        for i, texture in enumerate(textures):
            if isinstance(texture, Constant):
                constant[i] = texture.value
            elif isinstance(texture, Bitmap):
                kind[i] = -1
                height, width = texture.pixels.shape[:2]
                if id(texture.pixels) not in first:
                    first[id(texture.pixels)] = total
                    packed.append(np.broadcast_to(texture.pixels, (height, width, channels)).reshape(-1, channels))
                    total += height * width
                place[i] = first[id(texture.pixels)], width, height
                to_uv[i] = texture.to_uv[:2]
            else:
                kind[i] = self.names.index(texture.name)
        texels = np.concatenate([np.zeros((0, channels), np.float32), *packed])
        tables = {"constant": constant, "kind": kind, "texels": texels, "place": place, "to_uv": to_uv}
        for name, value in tables.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(value)), persistent=False)

    @property
    def is_constant(self) -> bool:
        """Whether no texture varies over a surface."""
        return len(self.texels) == 0 and not self.names

    def forward(self, material: Tensor, si: SurfaceInteraction, geometry: Geometry) -> Tensor:
        """Values [n, channels] at the lanes of ``si``, which have these materials [n]; zeros where not valid."""
        out = self.constant[material] * si.valid.unsqueeze(-1)
        if self.is_constant:
            return out
        kind = torch.where(si.valid, self.kind[material], -2)
        if len(self.texels):
            out = where_needed(kind == -1, out, lambda lane: self._bilinear(material[lane], si.uv[lane]))
        for index, name in enumerate(self.names):
            out = where_needed(kind == index, out, lambda lane: geometry.attribute(name, si[lane]))  # noqa: B023
        return out

    def _bilinear(self, material: Tensor, uv: Tensor) -> Tensor:
        """Texel (row j, column i) has its centre at uv ((i + 0.5) / w, (j + 0.5) / h); the picture repeats."""
        matrix = self.to_uv[material]
        place = self.place[material]
        first, size = place[:, :1], place[:, 1:]
        # Sums, no matrix products, which a GPU may be allowed to round.
        xy = ((matrix[:, :, :2] * uv.unsqueeze(-2)).sum(-1) + matrix[:, :, 2]) * size - 0.5
        low = xy.floor()
        part = xy - low
        fx, fy = part[:, :1], part[:, 1:]
        wrapped = torch.remainder(low.long(), size)
        x0, y0 = wrapped[:, :1], wrapped[:, 1:]
        width, height = size[:, :1], size[:, 1:]
        x1, y1 = torch.where(x0 + 1 == width, 0, x0 + 1), torch.where(y0 + 1 == height, 0, y0 + 1)
        index = torch.cat((y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1), -1) + first
        weight = torch.cat(((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy), -1)
        return (weight.unsqueeze(-1) * self.texels[index]).sum(1)
