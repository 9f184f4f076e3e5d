"""Vertices that random rays find in a scene, and a guide there."""

from dataclasses import replace

import torch

from neurad.core.records import Rays
from neurad.core.rng import Stream
from neurad.integrators.guide import Guide


def one_sided(scene):
    return replace(scene, materials=[replace(m, two_sided=False) for m in scene.materials])


def random_vertices(world, count, seed):
    """What random rays through the scene end at, seen from both sides, with some misses among them."""
    stream = Stream(seed)
    low, high = world.geometry.vertices.amin(0), world.geometry.vertices.amax(0)
    o = low - 0.2 * (high - low) + stream.uniform(count, 3) * 1.4 * (high - low)
    d = torch.nn.functional.normalize(stream.uniform(count, 3) - 0.5, dim=-1)
    return world.intersect(Rays(o, d))


def uneven_guide(world):
    """A guide that has recorded something uneven."""
    guide = Guide(torch.stack((world.geometry.vertices.amin(0), world.geometry.vertices.amax(0))), 4)
    guide.squares.copy_(Stream(9).uniform(*guide.squares.shape) ** 4 * 20)
    guide.counts.fill_(10.0)
    guide.update()
    return guide
