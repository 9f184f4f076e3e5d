"""Scenes of mirrors and glass."""

import numpy as np

from neurad.core.reflection import ConductorModel, DielectricModel
from neurad.core.scene_records import Constant, EnvironmentMap, Material
from neurad.scene.builtin.plain import diffuse, room, views
from neurad.scene.builtin.shapes import box, join, quad, rotated
from neurad.scene.description import Scene

TINT = np.array([0.9, 0.6, 0.3], np.float32)
LIGHT = np.array([2.0, 3.0, 4.0], np.float32)
ETA = 1.5


def delta_material(model, tint=(1.0, 1.0, 1.0), two_sided=True):
    roughness = Constant(np.zeros(1, np.float32))
    return Material(model.label, model, Constant(np.array(tint, np.float32)), roughness, two_sided)


def scene_of(*parts, **settings):
    """A scene of (solid, material, radiance) parts, all flat."""
    meshes = [s.mesh(m.name, i, smooth_shading=False, radiance=light) for i, (s, m, light) in enumerate(parts)]
    return Scene("delta", meshes, [m for _, m, _ in parts], **settings).check()


def fresnel(cos):
    """Reflectance of a face of glass by the cosine outside."""
    cos_t = np.sqrt(1 - (1 - cos**2) / ETA**2)
    s, p = (cos - ETA * cos_t) / (cos + ETA * cos_t), (ETA * cos - cos_t) / (ETA * cos + cos_t)
    return (s * s + p * p) / 2


def bright_sky(seed=3):
    """A map without any symmetry, with one bright texel."""
    pixels = np.random.default_rng(seed).uniform(0.2, 1.0, (8, 16, 3)).astype(np.float32)
    pixels[2, 3] = 5.0
    return EnvironmentMap(pixels)


def delta_gallery():
    """A closed room with a mirror, a glass block, a pane without volume and a mirror seen from behind."""
    block = rotated(box((0.1, -0.98, -0.5), (0.6, 0.1, -0.1)), 25.0, (0.35, 0, -0.3))
    parts = [
        (join(*room((-1, -1, -1), (1, 1, 1)).values()), diffuse("walls", (0.6, 0.5, 0.4)), None),
        (quad((-0.9, -0.7, -0.9), (0.9, 0, -0.05), (0, 1.4, 0)), delta_material(ConductorModel(), TINT), None),
        (block, delta_material(DielectricModel()), None),
        (quad((-0.75, -0.9, 0.1), (0.5, 0, -0.2), (0, 0.9, 0)), delta_material(DielectricModel()), None),
        (quad((0.95, -0.2, -0.3), (-0.3, 0, -0.5), (0, 0.7, 0)), delta_material(ConductorModel(), TINT, False), None),
        (quad((-0.7, 0.99, -0.7), (1.4, 0, 0), (0, 0, 1.4)), diffuse("lamp", 0.5), LIGHT),
    ]
    train = [((0.1, 0.0, 0.95), (0.0, -0.15, -0.3)), ((-0.8, 0.2, 0.8), (0.5, -0.4, -0.5))]
    return scene_of(*parts, train=views("train", train, 75.0, 12), test=views("test", train[:1], 75.0, 12))


def window_room(thin, environment=None):
    """A room whose window at x = 1 has a pane, a sheet or a slab, with a lamp outside and perhaps a sky."""
    low, high = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    walls = room(low, high)
    del walls["right"]
    around = [
        quad((1, -1, -1), (0, 0, 2), (0, 0.6, 0)), quad((1, 0.6, -1), (0, 0, 2), (0, 0.4, 0)),
        quad((1, -0.4, -1), (0, 0, 0.5), (0, 1, 0)), quad((1, -0.4, 0.3), (0, 0, 0.7), (0, 1, 0)),
    ]  # fmt: skip
    pane = quad((1, -0.4, -0.5), (0, 0, 0.8), (0, 1, 0)) if thin else box((1, -0.4, -0.5), (1.04, 0.6, 0.3))
    parts = [
        (join(*walls.values(), *around), diffuse("walls", (0.6, 0.5, 0.4)), None),
        (pane, delta_material(DielectricModel(ETA, thin)), None),
        (quad((3, -1, -0.2), (0, 0, 0.7), (0.5, 1, 0)), diffuse("lamp", 0.5), LIGHT),
    ]
    train = [((-0.9, 0.3, 0.8), (0.9, -0.3, -0.4)), ((0.6, 0.4, 0.6), (-0.9, -0.4, -0.3))]
    return scene_of(*parts, environment=environment, train=views("train", train, 75.0, 12))
