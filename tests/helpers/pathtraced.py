"""Scenes by paths, with their own materials."""

from dataclasses import replace

import numpy as np
import torch

from neurad.assembly.build import build_world
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.scene.textures import TrueMaterials


def paths(scene, *depths):
    """What traces paths of a scene; ``depths`` are the longest and that from which roulette is played, the scene's own
    where there are none.
    """
    world = build_world(scene)
    depths = depths or (scene.max_depth, scene.rr_depth)
    return path_tracer(world, TrueMaterials(scene, world.geometry), *depths)


def picture(scene, camera, spp, seed=0, size=None):
    """A picture [h, w, 3] of a scene; ``size`` is another number of pixels each way."""
    if size is not None:
        camera = replace(camera, width=size, height=size)
    with torch.no_grad():
        return np.asarray(render(camera, paths(scene), spp, seed))
