"""The gallery with lights without extent, or seen from one place with a flash there."""

from dataclasses import replace

import numpy as np
import torch

from helpers.method_oracles import camera_vertices, gallery
from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays
from neurad.core.scene_records import EnvironmentMap, PunctualLight, View
from neurad.scene.builtin.shapes import look_at


def light(kind, intensity, at=(0.0, 0.0, 0.0), along=(0.0, -1.0, 0.0), cutoff=40.0, beam=25.0):
    rgb, place, axis = (np.asarray(x, np.float32) for x in (intensity, at, along))
    return PunctualLight(kind, kind, rgb, place, axis, cutoff, beam)


LAMPS = (
    light("point", (1.0, 0.8, 0.5), (0.5, 0.6, 0.4)),
    light("spot", (2.0, 3.0, 4.0), (-0.5, 0.9, 0.3), (0.2, -1.0, -0.3)),
    light("directional", (0.3, 0.2, 0.6), along=(0.3, -1.0, -0.4)),
)


def lit_gallery(area=True, sky=False):
    """The gallery with lights without extent; without its ceiling, so that the directional one gets in."""
    scene = gallery()
    meshes = [mesh if area else replace(mesh, radiance=None) for mesh in scene.meshes]
    meshes = [mesh for mesh in meshes if mesh.vertices[:, 1].min() < 0.995 or mesh.radiance is not None]
    above = EnvironmentMap(np.full((4, 8, 3), 0.4, np.float32)) if sky else None
    return replace(scene, meshes=meshes, punctual=LAMPS, environment=above).check()


def gallery_lit(flash, area):
    """The gallery seen from one place with a flash there, its own lamps on or gone."""
    scene = gallery()
    meshes = [mesh for mesh in scene.meshes if area or mesh.radiance is None]
    camera = replace(look_at((0.0, 0.3, 0.7), (0.1, -0.2, 0.0), 75.0, 8), flash=flash)
    return replace(scene, meshes=meshes, train=[View("v", camera)]).check()


def from_the_camera(scene, n, seed):
    """A scene's world, and points that all directions from its camera meet."""
    world = build_world(scene)
    return world, camera_vertices(world, n, seed, camera_rays(scene.train[0].camera, torch.zeros(1, 2)).flash)
