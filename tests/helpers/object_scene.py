"""A ball on a floor under an environment, photographed from the upper hemisphere with an alpha channel."""

import math
from dataclasses import replace

import numpy as np
import torch

from benchmarks.rooms.solids import ball
from neurad.assembly.build import build_world
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, EnvironmentMap, Material
from neurad.images.image_io import write_exr
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.scene.builtin.plain import views
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

SIZE = 16


def sky(height=8, width=16, seed=0):
    """A map of random colours."""
    return EnvironmentMap(np.random.default_rng(seed).uniform(0.2, 3.0, (height, width, 3)).astype(np.float32))


PAINT = PrincipledModel()


def object_scene(environment, model=PAINT, albedo=(0.6, 0.4, 0.2), size=SIZE):
    """Six training and two held-out views, without files."""
    paint = Material("paint", model, Constant(np.array(albedo, np.float32)), Constant(np.array([0.3], np.float32)))
    diffuse = replace(paint, name="diffuse", albedo=Constant(np.full(3, 0.5, np.float32)))
    ring = [(math.cos(a) * 3.0, 2.0 + 0.5 * (i % 2), math.sin(a) * 3.0) for i, a in enumerate(np.arange(8) * 0.8)]
    eyes = [(eye, (0.0, 0.4, 0.0)) for eye in ring]
    return Scene(
        name="object",
        meshes=[
            ball((0.0, 0.5, 0.0), 0.5, 1.0, 8, 12).mesh("ball", 0),
            quad((-1.0, 0.0, -1.0), (0.0, 0.0, 2.0), (2.0, 0.0, 0.0)).mesh("floor", 1),
        ],
        materials=[paint, diffuse],
        environment=environment,
        train=views("train", eyes[:6], 45.0, size),
        test=views("test", eyes[6:], 45.0, size),
        max_depth=8,
    )


def photographed(scene, folder, spp=64, relit=None):
    """The scene with photographs, under an environment [r, g, b, alpha], and true albedo; with those under ``relit``,
    another map, too.
    """
    hides = scene.environment is not None
    world = build_world(scene, hide_environment=hides)
    materials = TrueMaterials(scene, world.geometry)
    worlds = {"image": world}
    if relit is not None:
        write_exr(folder / "env_relight.exr", relit.pixels, half=False)
        worlds["relight"] = build_world(replace(scene, environment=relit), hide_environment=True)

    def alpha(rays, seed):
        return world.intersect(rays).valid.float().unsqueeze(-1)

    def albedo(rays, seed):
        si = world.intersect(rays)
        return materials(si).albedo * si.valid.unsqueeze(-1)

    found = []
    for view in [*scene.train, *scene.test]:
        files, true = {}, str(folder / f"{view.name}_albedo.exr")
        write_exr(true, render(view.camera, albedo, 16, 5).numpy(), half=False)
        cover = [render(view.camera, alpha, spp, 5)] if hides else []
        for name, lit in worlds.items():
            color = render(view.camera, path_tracer(lit, materials, scene.max_depth), spp, 5)
            files[name] = str(folder / f"{view.name}_{name}.exr")
            write_exr(files[name], torch.cat((color, *cover), -1).numpy(), half=False)
        found.append(replace(view, maps={"albedo": true}, **files))
    count = len(scene.train)
    other = None if relit is None else str(folder / "env_relight.exr")
    return replace(scene, train=found[:count], test=found[count:], relight=other)
