"""Scenes of the cases: copies of built-in ones with one thing changed."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from benchmarks.stress.fit import resized
from neurad.assembly.build import build_world
from neurad.core.reflection import ReflectionModel
from neurad.core.scene_records import Constant, Material, Mesh
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.scene.builtin import build_cube
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials


def with_meshes(scene: Scene, change: Callable[[Mesh], Mesh]) -> Scene:
    """The scene with every mesh changed."""
    return replace(scene, meshes=[change(mesh) for mesh in scene.meshes])


def with_light(scene: Scene, factor: float) -> Scene:
    """The scene with its lights ``factor`` times as bright."""
    return with_meshes(
        scene, lambda m: m if m.radiance is None else replace(m, radiance=m.radiance * np.float32(factor))
    )


def with_material(scene: Scene, model: ReflectionModel, albedo: float, roughness: float = 1.0) -> Scene:
    """The scene with another material in the place of its first."""
    value = Constant(np.full(3, albedo, np.float32))
    made = Material("extreme", model, value, Constant(np.full(1, roughness, np.float32)))
    return replace(scene, materials=[made, *scene.materials[1:]])


def moved(scene: Scene, scale: float, offset: float) -> Scene:
    """The scene with its geometry and cameras scaled, then moved along all axes."""

    def pose(to_world: np.ndarray) -> np.ndarray:
        found = np.array(to_world, np.float64)
        found[:3, 3] = found[:3, 3] * scale + offset
        return found

    parts = [
        [replace(v, camera=replace(v.camera, to_world=pose(v.camera.to_world))) for v in views]
        for views in (scene.train, scene.test)
    ]
    changed = with_meshes(
        scene, lambda m: replace(m, vertices=(m.vertices.astype(np.float64) * scale + offset).astype(np.float32))
    )
    return replace(changed, train=parts[0], test=parts[1])


def with_panel(scene: Scene, model: ReflectionModel, corner: tuple[float, float, float], size: float) -> Scene:
    """The scene with a square panel parallel to the floor, of glass or mirror."""
    material = Material("panel", model, Constant(np.ones(3, np.float32)), Constant(np.ones(1, np.float32)))
    panel = quad(corner, (size, 0.0, 0.0), (0.0, 0.0, size))
    mesh = panel.mesh("panel", len(scene.materials), smooth_shading=False)
    return replace(scene, meshes=[*scene.meshes, mesh], materials=[*scene.materials, material])


def picture(scene: Scene, spp: int, view: int = 0, seed: int = 3, depth: int | None = None) -> Tensor:
    """A training view by path tracing with the true materials [h, w, 3]."""
    world = build_world(scene)
    path = path_tracer(world, TrueMaterials(scene, world.geometry), depth or scene.max_depth, scene.rr_depth)
    return render(scene.train[view].camera, path, spp, seed)


def difference(a: Tensor, b: Tensor) -> float:
    """Mean absolute difference of two pictures over the mean of ``b``.

    Raises:
        FloatingPointError: a value is not finite.
    """
    if not bool(torch.isfinite(a).all() and torch.isfinite(b).all()):
        raise FloatingPointError("the picture has values that are not finite")
    return float((a - b).abs().mean() / b.abs().mean())


def mean_difference(a: Tensor, b: Tensor) -> float:
    """Difference of the means of two pictures over that of ``b``.

    Raises:
        FloatingPointError: a value is not finite.
    """
    difference(a, b)
    return abs(float(a.mean() / b.mean()) - 1.0)


def small_cube(size: int = 16, albedo: float = 0.5) -> Scene:
    """The ceiling-lit cube with small views and paths of at most eight vertices."""
    return replace(resized(build_cube(albedo), size), max_depth=8)
