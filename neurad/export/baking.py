"""A room from the parts of a run: every mesh gets a texture, every texture what was recovered."""

from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from neurad.assembly.build import Assembly
from neurad.assembly.relight import shown_environment, with_lamps
from neurad.core.errors import InputError
from neurad.core.reflection import PrincipledModel, ReflectionModel
from neurad.core.scene_records import Bitmap, Constant, Material, Mesh
from neurad.export.bake import Baked, BakedRoom, bake
from neurad.export.charts import Chart
from neurad.export.texel_means import TexelMeans
from neurad.export.texels import densities
from neurad.export.unwrap import unwrap
from neurad.formats.axes import Up, up_axis
from neurad.formats.cameras.write import named_apart
from neurad.formats.mitsuba.write import file_names
from neurad.runtime import threads
from neurad.runtime.extras import need
from neurad.runtime.progress import Phase
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials


def bake_room(assembly: Assembly, texels: int, size: int | None, up: Up | None, progress: Phase) -> BakedRoom:
    """Bake what a run recovered.

    Args:
        assembly: of the run, on the CPU.
        texels: most of all textures together.
        size: side of every texture instead of what each needs.
        up: axis that points up; None takes the one that the cameras hold up.

    Raises:
        InputError: the package xatlas or something that a mesh needs is missing, or a material cannot be baked.
    """
    need("xatlas", "export", "export: a texture atlas")
    scene, world = named_apart(assembly.scene), assembly.world
    model = None if isinstance(assembly.materials, TrueMaterials) else assembly.fitted_model
    described = [_material(scene, mesh, model) for mesh in scene.meshes]
    density, seen = densities(world.tracer.tracer, world.geometry, scene, progress)
    textured = [i for i, material in enumerate(described) if not material.model.is_delta]
    progress.stage("texture coordinates", len(textured))
    made = unwrap([scene.meshes[i] for i in textured], density[textured], texels, size, progress.step, seen[textured])
    charts: list[Chart | None] = [None] * len(scene.meshes)
    for index, chart in zip(textured, made, strict=True):
        charts[index] = chart
    baked = _bake_all(charts, assembly, progress)
    names = file_names([mesh.name for mesh in scene.meshes])
    return BakedRoom(
        scene=_baked_scene(scene, assembly, described, names, charts, baked),
        names=names,
        charts=charts,
        baked=baked,
        up=up or up_axis(scene),
        hide_environment=world.hide_environment,
    )


def _bake_all(charts: list[Chart | None], assembly: Assembly, progress: Phase) -> list[Baked | None]:
    """The texture of every mesh that has a chart: large ones in turn on all threads, then small ones a thread each."""
    first = np.cumsum([0, *(len(mesh.faces) for mesh in assembly.scene.meshes)])
    baked: list[Baked | None] = [None] * len(charts)
    sizes = [0 if chart is None else chart.texels for chart in charts]
    large_from = sum(sizes) / (2 * threads.threads(len(charts), 1))
    progress.stage("textures", sum(sizes))

    def one(index: int) -> Baked | None:
        chart, geometry = charts[index], assembly.world.geometry
        if chart is None:
            return None
        return bake(TexelMeans(chart, int(first[index]), geometry, assembly.materials, assembly.parameters))

    largest_first = sorted(range(len(charts)), key=lambda index: -sizes[index])
    large = [index for index in largest_first if sizes[index] > large_from]
    small = largest_first[len(large) :]
    for index, texture in zip(largest_first, chain(map(one, large), threads.parallel_map(one, small)), strict=True):
        baked[index] = texture
        progress.step(sizes[index])
    return baked


def _material(scene: Scene, mesh: Mesh, model: ReflectionModel | None) -> Material:
    """What a mesh is written with: the recovered model, or for smooth surfaces and known materials the scene's own."""
    own = scene.materials[mesh.material]
    if own.model.is_delta:
        return own
    if model is not None:
        return replace(own, model=model)
    if not isinstance(own.model, PrincipledModel) and not own.model.is_diffuse:
        raise InputError(f"material {own.name}: it is known and a {own.model.label}, which textures do not describe")
    return own


def _baked_scene(
    scene: Scene,
    assembly: Assembly,
    described: list[Material],
    names: list[str],
    charts: list[Chart | None],
    baked: list[Baked | None],
) -> Scene:
    meshes, materials = [], []
    for index, (mesh, material, chart, texture) in enumerate(zip(scene.meshes, described, charts, baked, strict=True)):
        if chart is not None and texture is not None:
            maps: dict[str, Any] = {name: _shortest(pixels) for name, pixels in texture.maps.items()}
            material = replace(material, **maps)
            mesh = chart.mesh
        materials.append(replace(material, name=names[index]))
        meshes.append(replace(mesh, name=names[index], material=index, attributes={}))
    environment = None if scene.environment is None else shown_environment(assembly)
    lights = file_names([light.name for light in scene.punctual], names)  # Blender finds them by their names, too
    punctual = tuple(replace(light, name=name) for light, name in zip(scene.punctual, lights, strict=True))
    made = replace(scene, meshes=meshes, materials=materials, environment=environment, punctual=punctual)
    return with_lamps(made, assembly)


def _shortest(pixels: np.ndarray) -> Bitmap | Constant:
    first = pixels[:1, :1]
    if (pixels == first).all():
        return Constant(first.reshape(-1).astype(np.float32))
    return Bitmap(pixels)
