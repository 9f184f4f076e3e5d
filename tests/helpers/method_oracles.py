"""Scenes whose derivative is known in closed form, and a small one that has everything."""

import math

import numpy as np
import torch

from benchmarks.rooms.solids import ball
from neurad.assembly.build import build_world
from neurad.core.records import Rays, Surface
from neurad.core.reflection import ConductorModel, DielectricModel, PrincipledModel
from neurad.core.rng import Stream
from neurad.core.scene_records import Constant, Material
from neurad.integrators.method import SceneModel
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build_furnace, build_sphere
from neurad.scene.builtin.plain import room
from neurad.scene.builtin.shapes import box, quad, rotated
from neurad.scene.description import Scene
from neurad.scene.textures import ConstantMaterials


class Oracle:
    """A closed diffuse scene of albedo rho in which reflected light is the same everywhere in the mean:
    ``light * rho / (1 - rho)``, its derivative ``light / (1 - rho)^2``."""

    def __init__(self, name, rho):
        self.name, self.rho = name, rho
        scene = build_furnace(rho, 1.0) if name == "furnace" else build_sphere(rho, subdivisions=3)
        self.world = build_world(scene)
        self.grey = torch.nn.Parameter(torch.tensor(float(rho)))
        self.materials = ConstantMaterials(self.grey)
        geometry = self.world.geometry
        area = geometry.face_area.double()
        self.light = float((area * geometry.emission[:, 0].double()).sum() / area.sum())
        self.exact = self.light * rho / (1 - rho)
        self.derivative = self.light / (1 - rho) ** 2
        self.cdf = (area.cumsum(0) / area.sum()).float()

    def vertices(self, n, stream):
        """Points distributed evenly over the area. In a closed convex diffuse scene light that starts so stays so at
        every bounce, on facets too, which makes the closed form exact for their mean."""
        geometry = self.world.geometry
        prim = torch.searchsorted(self.cdf, stream.uniform(n)).clamp_max(len(self.cdf) - 1)
        root, second = stream.uniform(n).sqrt(), stream.uniform(n)
        wo = geometry.face_normal[prim]
        return geometry.interact_at(prim, root * (1 - second), root * second, wo, torch.ones(n, dtype=torch.bool))

    def parts(self, wrong=1.0):
        value = wrong * self.exact
        return SceneModel(self.world, self.materials, lambda si, albedo: torch.full_like(albedo, value))

    def estimate(self, method, paths, seed, wrong=1.0):
        """Mean derivative and mean value with their standard errors, from 16 independent batches: two pairs."""
        found, batches = [], 16
        for index in range(batches):
            stream = Stream(seed, index)
            si = self.vertices(paths // batches, stream)
            u = stream.uniform(len(si), DIMENSIONS)
            value = method.reflected(self.parts(wrong), si, self.materials(si), u, stream).value.mean()
            (grad,) = torch.autograd.grad(value, [self.grey])
            found.append((grad.item(), value.item()))
        rows = np.array(found)
        means, errors = rows.mean(0), rows.std(0, ddof=1) / math.sqrt(batches)
        return (means[0], errors[0]), (means[1], errors[1])


def gallery():
    """A room with textures to be, two lights of different colour, a mirror and a glass ball."""
    white = Constant(np.full(3, 0.5, np.float32))
    rough = Constant(np.full(1, 0.5, np.float32))
    wall = Material("wall", PrincipledModel(), white, rough)
    mirror = Material("mirror", ConductorModel(), Constant(np.array([0.9, 0.8, 0.7], np.float32)), rough)
    glass = Material("glass", DielectricModel(), Constant(np.ones(3, np.float32)), rough)
    parts = [(solid, 0, None) for solid in room((-1, -1, -1), (1, 1, 1)).values()]
    parts += [
        (rotated(box((-0.7, -1.0, -0.6), (-0.1, 0.1, 0.0)), 20.0, (-0.4, 0.0, -0.3)), 0, None),
        (rotated(box((0.2, -1.0, -0.8), (0.8, 0.3, -0.6)), -15.0, (0.5, 0.0, -0.7)), 1, None),
        (ball((0.4, -0.6, 0.3), 0.3, 1.0), 2, None),
        (quad((-0.3, 0.99, -0.3), (0.6, 0, 0), (0, 0, 0.6)), 0, np.array([6.0, 5.0, 4.0], np.float32)),
        (quad((-0.99, -0.2, 0.2), (0, 0.4, 0), (0, 0, 0.5)), 0, np.array([1.0, 3.0, 8.0], np.float32)),
    ]
    meshes = [s.mesh(f"part {i}", m, smooth_shading=m == 2, radiance=light) for i, (s, m, light) in enumerate(parts)]
    return Scene("gallery", meshes, [wall, mirror, glass]).check()


class Textures(torch.nn.Module):
    """Bilinear textures of albedo, roughness and, where ``metal`` is asked for, metalness over uv, with parameters:
    surfaces from smooth to rough.
    """

    def __init__(self, metal=False):
        super().__init__()
        generator = torch.Generator().manual_seed(4)
        self.colour = torch.nn.Parameter(torch.rand(1, 3, 8, 8, generator=generator) * 0.6 + 0.2)
        self.rough = torch.nn.Parameter(torch.rand(1, 1, 8, 8, generator=generator) * 0.85 + 0.15)
        self.metal = torch.nn.Parameter(torch.rand(1, 1, 8, 8, generator=generator)) if metal else None

    def _read(self, texture, si):
        place = (si.uv % 1.0 * 2.0 - 1.0).view(1, 1, -1, 2)
        return torch.nn.functional.grid_sample(texture, place, padding_mode="border", align_corners=True)[0, :, 0].t()

    def albedo(self, si):
        return self._read(self.colour, si)

    def forward(self, si):
        metallic = None if self.metal is None else self._read(self.metal, si)
        return Surface(self.albedo(si), self._read(self.rough, si), metallic=metallic)


def camera_vertices(world, n, seed, flash=None):
    """Where rays from the middle of the gallery end, smooth surfaces passed through; with a flash that is there."""
    stream = Stream(seed)
    d = torch.nn.functional.normalize(stream.uniform(n, 3) - 0.5, dim=-1)
    o = torch.tensor([0.0, 0.3, 0.7]).expand(n, 3).contiguous()
    return world.trace_past_delta(Rays(o, d, flash and flash.repeat(n)), stream.uniform(n)).si
