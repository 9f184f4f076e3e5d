"""The materials of a run: what photographs show of them is in fields, the rest is the scene's."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from neurad.assembly.lighting import lamps_of_scene
from neurad.assembly.region import Region
from neurad.core.parameters import ALBEDO, METALLIC, ROUGHNESS, SurfaceParameter
from neurad.core.records import BoolArray, Surface, SurfaceInteraction
from neurad.fields.hierarchy import DETAILS
from neurad.fields.material import HIERARCHY_CELLS, MaterialField
from neurad.fields.metalness import Metalness
from neurad.fields.settings import AlbedoConfig, FieldConfig, RoughnessConfig
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.parts import SurfaceParts, segments
from neurad.scene.textures import KnownSurfaces, SceneTexture


class FittedMaterials(nn.Module):
    """Surface parameters by name, each read from a field or, where a fit does not recover it, from the scene.

    Args:
        fields: of the parameters that the scene has, the albedo first.
        lambert: part of Lambert's lobe in the diffuse one from which a fit looks for it, see
            :mod:`neurad.training.diffuse_lobe`; None in a fit that does not.
        nearest: the triangle nearest to each position; None where no field asks on which one it lies.
    """

    lobe_found: Tensor

    def __init__(
        self,
        fields: Mapping[str, nn.Module],
        lambert: float | None = None,
        nearest: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self._nearest = nearest
        self.fields = nn.ModuleDict(fields)
        self.lambert = None if lambert is None else nn.Parameter(torch.full((1, 1), lambert))
        """That part, until it is known; None in a fit that does not look for it."""
        self.looks_for_lobe = lambert is not None
        """Whether it is still looked for."""
        self.register_buffer("lobe_found", torch.tensor(float(lambert is None)))
        self.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda module, _: module.keep_lobe(bool(module.lobe_found))
        )
        self.known_meshes: frozenset[int] = frozenset()
        """Meshes on which the scene's own values hold, see :func:`pin_known_materials`."""

    def keep_lobe(self, found: bool = True) -> None:
        """Look no longer for the diffuse lobe if it was found."""
        self.lobe_found.fill_(found)
        self.looks_for_lobe = not found

    @property
    def metalness(self) -> Metalness | None:
        """What finds metals; None where the scene's own metalness holds."""
        found = [field for field in self.fields.values() if isinstance(field, Metalness)]
        return found[0] if found else None

    @property
    def recovered(self) -> dict[str, MaterialField]:
        """The fields that are trained, by name of their parameter."""
        return {name: field for name, field in self.fields.items() if isinstance(field, MaterialField)}

    def forward(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        albedo = self.albedo(si)
        values = {name: albedo if name == ALBEDO.name else field(si, albedo) for name, field in self.fields.items()}
        if ROUGHNESS.name not in values:  # not read: one number for all lanes
            values[ROUGHNESS.name] = albedo.new_full((1, 1), ROUGHNESS.absent).expand(len(albedo), 1)
        part = self.lambert if self.looks_for_lobe else None
        searched = None if part is None else part.expand(len(albedo), 1)
        return Surface(**values, lambert=searched)

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3]."""
        albedo: Tensor = self.fields[ALBEDO.name](si)
        return albedo

    def to_unit_cube(self, p: Tensor) -> Tensor:
        """Positions [n, 3] in the scene's frame, on any device, to the unit cube that the fields span [n, 3]."""
        cube = self.recovered[ALBEDO.name].cube
        inside: Tensor = cube(p.to(next(iter(cube.buffers())).device))
        return inside

    def albedo_at(self, p: Tensor, prim: Tensor | None = None) -> Tensor:
        """The albedo alone [n, 3]; as :meth:`at`."""
        p, prim = self._places(p, prim)
        return self.recovered[ALBEDO.name].at(p, prim=prim)

    def _places(self, p: Tensor, prim: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Positions on the device of the fields, and triangles; those that lie nearest where none are given."""
        p = p.to(next(iter(self.recovered[ALBEDO.name].parameters())).device)
        return p, self._nearest(p) if prim is None and self._nearest is not None else prim

    def at(self, p: Tensor, prim: Tensor | None = None) -> dict[str, Tensor]:
        """Recovered parameters [n, channels] at positions [n, 3] in the scene's frame, on any device, by name; on the
        triangles ``prim`` [n], or on what lies nearest.
        """
        p, prim = self._places(p, prim)
        fields, albedo, metal = self.recovered, self.albedo_at(p, prim), self.metalness
        found = {name: albedo if name == ALBEDO.name else field.at(p, albedo, prim) for name, field in fields.items()}
        return found if metal is None or not metal.found else {**found, METALLIC.name: metal.at(p, prim)}

    def std(self, p: Tensor, prim: Tensor | None = None, known: bool = True) -> dict[str, Tensor]:
        """Standard deviations [n, channels] of the parameters whose fields know them; as :meth:`at`. Those of the prior
        where photographs are not ``known``.
        """
        p, prim = self._places(p, prim)
        fields, albedo, metal = self.recovered, self.albedo_at(p, prim), self.metalness
        found = {name: field.std(p, albedo, prim, known) for name, field in fields.items() if name != ALBEDO.name}
        if metal is not None and metal.found:
            found[METALLIC.name] = metal.std(p, prim) if known else torch.full_like(albedo[:, :1], 0.5)
        return {name: std for name, std in found.items() if std is not None}

    def std_by_albedo(self, p: Tensor, std: Tensor, prim: Tensor | None = None) -> dict[str, Tensor]:
        """Deviations [n, channels] that parameters whose fields read the albedo have from the deviations ``std``
        [n, 3] of that, one channel after the other; otherwise as :meth:`at`.
        """
        p, prim = self._places(p, prim)
        albedo = self.albedo_at(p, prim)
        steps = torch.diag_embed(std.to(albedo)).unbind(1)  # [n, 3] each
        found = {}
        for name, field in self.recovered.items():
            if field.hierarchy is not None and field.hierarchy.found:
                high, low = (
                    torch.stack([field.at(p, (albedo + sign * step).clamp(0.0, 1.0), prim) for step in steps])
                    for sign in (1.0, -1.0)
                )
                found[name] = 0.5 * (high - low).square().sum(0).sqrt()
        return found


def build_materials(
    scene: Scene,
    configs: Mapping[str, FieldConfig],
    geometry: Geometry,
    region: Region | None = None,
    known_emitters: bool = True,
    lambert: float | None = None,
    finds_metal: bool = False,
) -> FittedMaterials:
    """A field for each of the scene's parameters that a fit recovers; the others are read from the scene.

    Args:
        region: what the grids span, by default all triangles.
        known_emitters: emitting surfaces keep what the scene file says of them: that is part of the light, and
            photographs do not show it. They are shaded by the fitted model (principled, or diffuse in a Lambertian
            scene) like every recovered surface, whatever model the file gives them.
    """
    region = region or Region(scene.bounds)
    bounds, cells = torch.from_numpy(region.bounds), region.cells(HIERARCHY_CELLS, max(DETAILS))

    has_structure = any(isinstance(c, RoughnessConfig) and c.structure != "free" for c in configs.values())
    joined = one_material(scene, geometry)
    parts = SurfaceParts(geometry, geometry.mesh_index, joined) if has_structure or finds_metal else None
    own: SurfaceParts | None = None
    config = configs[ALBEDO.name]
    if isinstance(config, AlbedoConfig) and config.by_segments and config.has_levels:
        cell = float((bounds[1] - bounds[0]).max()) / cells
        own = SurfaceParts(geometry, segments(geometry, cell * cell), joined)

    def made(parameter: SurfaceParameter) -> nn.Module:
        if not parameter.is_recovered:
            return SceneTexture(scene, parameter, geometry)
        config = region.stretched(configs[parameter.name])
        of_segments = own if parameter == ALBEDO else None
        return MaterialField(parameter, config, bounds, region.contracted, parts, cells, of_segments)

    fields = {parameter.name: made(parameter) for parameter in scene.parameters}
    if finds_metal:
        assert parts is not None
        fields[METALLIC.name] = Metalness(parts, len(geometry.faces))
    asks = parts is not None or own is not None
    materials = FittedMaterials(fields, lambert, geometry.nearest if asks else None)
    if known_emitters:
        pin_known_materials(materials, scene, geometry)
    return materials


def one_material(scene: Scene, geometry: Geometry) -> list[BoolArray]:
    """Triangles [f] at the places that hints say to be one material, an entry each."""
    entries = scene.hints.one_material
    vertices, faces = (x.cpu().numpy() for x in (geometry.vertices, geometry.faces))
    return [np.logical_or.reduce([t.triangles(vertices, faces, scene.origin) for t in entry]) for entry in entries]


def pin_known_materials(
    materials: FittedMaterials, scene: Scene, geometry: Geometry, meshes: frozenset[int] = frozenset()
) -> None:
    """Let emitting and smooth surfaces have what the scene file says of them.

    Args:
        meshes: further meshes that are known: those that shone while the fields were fitted, and photographs did not
            show what they reflect.
    """
    if scene.features.has_area_lights or scene.features.has_delta or meshes:
        for field in materials.recovered.values():
            field.known = KnownSurfaces(scene, field.parameter, geometry, meshes).to(geometry.vertices.device)
    materials.known_meshes = meshes | scene.smooth_meshes | set(lamps_of_scene(scene))
