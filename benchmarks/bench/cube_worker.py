"""A process of ``neurad bench cube``: builds one method at one albedo, then takes a step for each command it reads."""

import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from benchmarks.bench.machine import peak_bytes
from benchmarks.closed_form import reflected_radiance
from benchmarks.photos import PhotosInMemory
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.model_settings import ModelSettings
from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.mlp import MLP
from neurad.fields.outputs import START
from neurad.fields.settings import AlbedoConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.runs.model_settings import model_settings
from neurad.runtime.allocator import keep_freed_memory
from neurad.runtime.memory import resident_memory
from neurad.scene.builtin import build_cube
from neurad.scene.geometry import Geometry
from neurad.training.session import TrainingRun

WARMUP = 2
"""Steps that do not count."""
LAST_LAYER_SCALE = 0.01
"""Factor on the last layer's random weights, so that they change the albedo by less than a thousandth of its range."""

SHIPPED = "scene.yaml"
"""Config that the settings of the step come from."""

Step = Callable[[], int]
"""Takes a training step and returns how many rays it cast."""


def main(job: dict[str, Any]) -> None:
    """Do a job of ``neurad bench cube`` and answer on standard output, a line of JSON for every command read."""
    keep_freed_memory()
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print goes to standard error

    def answer(**values: Any) -> None:
        print(json.dumps(values), file=output, flush=True)

    try:
        step = mitsuba_step(job) if job["method"] == "mitsuba" else make_step(make_run(job))
        base = resident_memory() or peak_bytes()
        for _ in range(WARMUP):
            step()
    except InputError as error:
        answer(error=str(error))
        return
    answer(ready=True)
    for command in sys.stdin:
        if command.strip() == "end":
            answer(base=base, peak=peak_bytes())
            return
        begin = time.perf_counter()
        rays = step()
        answer(seconds=time.perf_counter() - begin, rays=rays)


def make_run(job: dict[str, Any]) -> TrainingRun:
    """A run of one method in the cube, with the shipped step and all learning rates at 0.

    The radiance field has the closed room's unit of radiance, and albedo fields the room's albedo everywhere.
    """
    scene = build_cube(job["albedo"])
    light = reflected_radiance(Geometry(scene), job["albedo"])
    camera = scene.train[0].camera
    photographs = torch.full((len(scene.train), camera.width * camera.height, 3), light)
    source = PhotosInMemory(photographs, camera.width, job["pixels"])
    run = TrainingRun.of_scene(scene, source, cube_settings(job))
    assert isinstance(run.assembly.materials, FittedMaterials)
    set_albedo(run.assembly.materials, job["albedo"])
    if run.assembly.radiance is not None:
        run.assembly.radiance.set_scale(light / START)
    return run


def make_step(run: TrainingRun) -> Step:
    """The run's step, which counts its rays."""
    tracer = run.assembly.world.tracer

    def step() -> int:
        cast = tracer.rays_cast
        run.advance(0.0)
        return tracer.rays_cast - cast

    return step


def cube_settings(job: dict[str, Any]) -> ModelSettings:
    """The shipped settings with the job's fields, method and numbers of samples; learning rates are 0.

    'prb' and 'path' end paths by roulette from the first bounce, and after the ``limit``.
    """
    shipped = model_settings(SHIPPED)
    dense = {"kind": "dense", "grid": GridConfig(coarsest=1, finest=job["size"] - 1)}
    sizes: dict[str, Any] = dense if job["fields"] == "dense" else {}
    paths = {"prb": PRB, "path": PathTracing}.get(job["method"])
    spp = job["spp"]
    return replace(
        shipped,
        albedo=AlbedoConfig(**sizes),
        roughness=RoughnessConfig(**sizes),
        radiance=RadianceConfig(**sizes),
        sampling=replace(shipped.sampling, spp=spp, samples_per_vertex=1, cached_spp=spp, field_fraction=0.25),
        optimization=replace(shipped.optimization, albedo=0.0, roughness=0.0, radiance=0.0, average=0.0),
        tracer="embree",
        method=shipped.method if paths is None else paths(job["limit"] + 1, 1, job["rr_prob"]),
    )


@torch.no_grad()
def set_albedo(materials: FittedMaterials, albedo: float) -> None:
    """Set a new albedo field to ``albedo`` everywhere, so that throughput is the scene's; it stays trainable."""
    value = math.log(albedo / (1.0 - albedo))
    for part in materials.recovered[ALBEDO.name].modules():
        if isinstance(part, DenseGrid):
            part.table.fill_(value)
        elif isinstance(part, MLP):
            last: Any = part.layers[-1]
            last.weight.mul_(LAST_LAYER_SCALE)
            last.bias.fill_(value)


def mitsuba_step(job: dict[str, Any]) -> Step:
    """A step of Mitsuba's ``prb`` on the same number of pixels and samples, its albedo in voxels, no optimizer.

    Raises:
        InputError: the package or the LLVM library is missing.
    """
    import numpy as np

    from benchmarks.loaded import load_mitsuba
    from benchmarks.peer.replay import Replay
    from benchmarks.peer.voxels import SurfaceVoxels

    mi = load_mitsuba()
    scene = build_cube(job["albedo"])
    voxels = SurfaceVoxels(scene, job["size"] - 1)
    camera = scene.train[0].camera
    light = reflected_radiance(Geometry(scene), job["albedo"])
    photographs = np.full((len(scene.train), camera.width * camera.height, 3), light, np.float32)
    # Its max_depth counts the camera's first hit as 1, and Russian roulette starts after rr_depth bounces.
    replay = Replay(mi, scene, voxels, photographs, job["limit"] + 1, 1)
    values = np.full((len(voxels), 4), job["albedo"], np.float32)

    def step() -> int:
        replay.step(values, job["pixels"], job["spp"])
        return 0  # Mitsuba does not count rays

    return step
