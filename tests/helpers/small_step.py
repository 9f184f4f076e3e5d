"""A training step over a small scene, with its parts at hand and its gradients by group of parameters."""

from dataclasses import replace

import numpy as np
import torch

from neurad.assembly.build import build_radiance, build_world
from neurad.assembly.fitted_materials import build_materials
from neurad.assembly.settings import Objective, Sampling
from neurad.core.parameters import RECOVERED
from neurad.core.records import PixelBatch
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream
from neurad.core.scene_records import View
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig
from neurad.integrators.estimator import Estimator
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.radiometric import Radiometric
from neurad.scene.builtin import build_cornell
from neurad.scene.geometry import Geometry
from neurad.training.objective import ObjectiveStep

SIZE = 12
GRID = GridConfig(levels=3, coarsest=4, finest=16, log2_size=10)


def small_scene(build=build_cornell, glossy=True, size=SIZE):
    """A built-in scene at a few pixels; ``glossy`` makes every surface principled, so that there is a roughness."""
    scene = build()
    train, test = (
        [View(view.name, replace(view.camera, width=size, height=size)) for view in part]
        for part in (scene.train, scene.test)
    )
    materials = [replace(m, model=PrincipledModel()) if glossy else m for m in scene.materials]
    return replace(scene, materials=materials, train=train, test=test)


class SmallStep:
    """An ObjectiveStep over the scene, with what it is made of at hand."""

    def __init__(self, sampling=Sampling(), settings=Objective(), unit=1.0, scene=None, method=None):
        torch.manual_seed(0)
        scene = scene or small_scene()
        meshes = [m if m.radiance is None else replace(m, radiance=m.radiance * np.float32(unit)) for m in scene.meshes]
        self.scene = replace(scene, meshes=meshes)
        self.materials = build_materials(
            scene, dict.fromkeys(RECOVERED, FieldConfig(GRID, 16)), Geometry(scene), known_emitters=False
        )
        self.radiance = build_radiance(scene, RadianceConfig(grid=GRID, width=16, hidden_layers=1))
        self.radiance.set_scale(0.5 * unit)
        self.estimator = Estimator(build_world(self.scene), self.materials, self.radiance, method or Radiometric())
        cameras = [view.camera for view in scene.train]
        self.primary = PrimaryHits(self.estimator.world, cameras, sampling.cached_spp, 0, torch.device("cpu"))
        self.emitter_mask = self.primary.sees_emitter()
        self.step = ObjectiveStep(
            self.estimator, self.primary, sampling, settings, settings.epsilon * (0.5 * unit) ** 2, self.emitter_mask,
        )  # fmt: skip
        self.groups = {
            **{name: [] for name in RECOVERED},
            **{name: list(field.parameters()) for name, field in self.materials.recovered.items()},
            "radiance": list(self.radiance.parameters()),
        }

    def gradients(self, surrogate):
        """Dense gradients of a scalar by group, each one vector."""
        parameters = [p for group in self.groups.values() for p in group]
        for p in parameters:
            p.grad = None
        surrogate.backward(retain_graph=True)
        found = {}
        for name, group in self.groups.items():
            parts = [torch.zeros_like(p) if p.grad is None else p.grad.to_dense() for p in group]
            found[name] = torch.cat([part.flatten() for part in parts]).clone()
        return found

    def reached(self, surrogate):
        found = self.gradients(surrogate)
        assert all(torch.isfinite(g).all() for g in found.values())
        return {name for name, g in found.items() if g.abs().sum() > 0}

    def batch(self, n=64, seed=1, unit=1.0, where=None):
        """``n`` random pixels, those of ``where`` [views, pixels] only, with random colours."""
        stream = Stream(seed)
        candidates = (torch.ones_like(self.emitter_mask) if where is None else where).nonzero()
        view, pixel = candidates[stream.integers(len(candidates), n)].unbind(-1)
        return PixelBatch(view, pixel, stream.uniform(n, 3) * unit, torch.ones(n), 0)
