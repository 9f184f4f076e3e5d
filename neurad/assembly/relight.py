"""What a run recovered, under other light and with other things: the world after an edit, and its materials."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from neurad.assembly.build import Assembly, build_world
from neurad.assembly.fitted_materials import FittedMaterials, pin_known_materials
from neurad.core.parameters import PARAMETERS
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.scene_records import EnvironmentMap
from neurad.formats.edits.edit import Edited
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials

SHARPER = 4
"""How many times finer than the recovered map one is that holds the sun, too."""


def recovered_scene(assembly: Assembly) -> Scene:
    """The scene of a run as the run has it: surfaces reflect by the model that was fitted to them, and an environment
    and lamps that were recovered are as they were found. Edits apply to it.
    """
    scene = assembly.scene
    if isinstance(assembly.materials, FittedMaterials):
        model = assembly.fitted_model
        scene = replace(scene, materials=[m if m.model.is_delta else replace(m, model=model) for m in scene.materials])
    if assembly.environment is not None:
        scene = replace(scene, environment=shown_environment(assembly))
    return with_lamps(scene, assembly)


def with_lamps(scene: Scene, assembly: Assembly) -> Scene:
    """The scene with the radiance that a run found for its lamps, where it was not known."""
    lamps = assembly.lamps
    if lamps is None:
        return scene
    found = dict(zip(lamps.mesh.tolist(), lamps.found().astype(np.float32), strict=True))
    return replace(
        scene, meshes=[replace(m, radiance=found[i]) if i in found else m for i, m in enumerate(scene.meshes)]
    )


def shown_environment(assembly: Assembly) -> EnvironmentMap | None:
    """The environment that a run found, in the frame of the scene's own, or the scene's own where that is known."""
    own = assembly.scene.environment
    if assembly.environment is None:
        return own
    found = assembly.environment.map(SHARPER if assembly.environment.sun.shines else 1)
    return EnvironmentMap(found, **({} if own is None else {"to_world": own.to_world}))


class EditedMaterials(nn.Module):
    """Recovered materials, but what an edit says where it says something, and on known lamps the scene's own.

    Args:
        fields: what was recovered; read by position, so what was moved or put in does not disturb it.
        edited: the scene after the edit of :func:`recovered_scene`.
        triangles: of the scene before it; those of things that were put in follow.
    """

    given: Tensor
    """Which meshes have what they are given [parameters, meshes], bool."""

    def __init__(self, fields: FittedMaterials, edited: Edited, geometry: Geometry, triangles: int) -> None:
        super().__init__()
        self.triangles = triangles
        self.fields = fields
        self.known = TrueMaterials(edited.scene, geometry)
        self.geometry = geometry
        given = torch.zeros(len(PARAMETERS), len(edited.scene.meshes), dtype=torch.bool)
        for row, parameter in enumerate(PARAMETERS):
            given[row, sorted(edited.painted.get(parameter.name, frozenset()) | fields.known_meshes)] = True
        self.register_buffer("given", given, persistent=False)

    @torch.no_grad()
    def forward(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        known: Surface = self.known(si)
        mesh = self.geometry.mesh_index[si.prim.clamp_min(0)]
        given = dict(zip((parameter.name for parameter in PARAMETERS), self.given[:, mesh].unsqueeze(-1), strict=True))
        recovered = self.fields.at(si.p, torch.where(si.prim < self.triangles, si.prim, -1))
        own = {name: getattr(known, name) for name in recovered}
        values = {
            name: torch.where(given[name], torch.zeros_like(found) if own[name] is None else own[name], found)
            for name, found in recovered.items()
        }
        return replace(known, **values)

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3]."""
        return self(si).albedo  # type: ignore[no-any-return]


def relit(assembly: Assembly, edited: Edited) -> SceneModel:
    """World and materials of a run after an edit, without a radiance field: paths need none, and the run's own belongs
    to the light that it was fitted under.

    Args:
        edited: the edit of :func:`recovered_scene`, or of another scene of the same geometry that is treated so.
    """
    device = assembly.world.geometry.vertices.device
    settings = assembly.settings
    world = build_world(
        edited.scene, settings.tracer, assembly.world.hide_environment,
        specular_fraction=settings.sampling.specular_fraction,
    ).to(device)  # fmt: skip
    if world.flash is not None and assembly.world.flash is not None:
        world.flash = assembly.world.flash  # with the power that was recovered
    if isinstance(assembly.materials, FittedMaterials):
        triangles = len(assembly.world.geometry.faces)
        materials = EditedMaterials(assembly.materials, edited, world.geometry, triangles)
        return SceneModel(world, materials.to(device))
    return SceneModel(world, TrueMaterials(edited.scene, world.geometry).to(device))


def in_other_light(assembly: Assembly, fitted_lamps: frozenset[int]) -> Assembly:
    """The parts of a run in a scene with another light than that of its fit: without radiance field and guide, which
    belong to the light of the fit; pictures are path traced.

    Args:
        assembly: made for the scene as it is now, with the weights of the fit.
        fitted_lamps: meshes that shone in the fit.
    """
    if isinstance(assembly.materials, FittedMaterials):
        pin_known_materials(assembly.materials, assembly.scene, assembly.world.geometry, fitted_lamps)
    assembly.world.guide = None
    return replace(assembly, radiance=None, settings=replace(assembly.settings, method=paths(assembly.scene)))


def paths(scene: Scene) -> PathTracing:
    """Path tracing as deep as a scene wants it."""
    return PathTracing(scene.max_depth, scene.rr_depth)


def sentence_of_light(changes: list[str]) -> str:
    """What is said where the light is not that of the fit."""
    return (
        f"another light than in the fit: {'; '.join(changes)}; pictures are path traced, as the radiance field belongs "
        "to the light of the fit"
    )
