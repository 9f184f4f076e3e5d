"""A process of ``neurad bench cube``: builds one method at one albedo, then takes a step whenever it is told to."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neurad.assembly.build import FittedMaterials, build_materials, build_radiance, build_world
from neurad.assembly.settings import Objective, Sampling
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.mlp import MLP
from neurad.fields.radiance import START
from neurad.fields.settings import FieldConfig, RadianceConfig
from neurad.integrators.estimator import Estimator
from neurad.integrators.method import Method
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.walk import Roulette, walk
from neurad.losses.relative import total
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.runtime.allocator import keep_freed_memory
from neurad.runtime.threads import of_step
from neurad.scene.builtin import build_cube
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials
from neurad.studies.bench.machine import peak_bytes, pick_device, wait
from neurad.training.objective import ObjectiveStep

WARMUP = 2
"""Steps that do not count."""
PATHS = 1 << 15
"""Walks whose lengths are counted."""
CALM = 0.01
"""What is left of the last layer's random weights: they ripple the albedo by less than a thousandth of its range."""

Step = Callable[[], int]
"""Takes a training step and tells how many rays it cast."""


def main(job: dict[str, Any]) -> None:
    """Do a job of ``neurad bench cube`` and answer on standard output, a line of JSON for every word heard."""
    keep_freed_memory()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer

    def say(**answer: Any) -> None:
        print(json.dumps(answer), file=answers, flush=True)

    try:
        if job["method"] == "lengths":
            say(lengths=[path_lengths(albedo, job["rr_prob"], job["tracer"]) for albedo in job["albedos"]])
            return
        device = pick_device(job["device"])
        step = mitsuba_step(job) if job["method"] == "mitsuba" else make_step(job, device)
        base = resident_bytes(device)
        for _ in range(WARMUP):
            step()
    except InputError as error:
        say(error=str(error))
        return
    say(ready=True)
    for word in sys.stdin:
        if word.strip() == "end":
            say(base=base, peak=peak_bytes(device))
            return
        wait(device)
        begin = time.perf_counter()
        rays = step()
        wait(device)
        say(seconds=time.perf_counter() - begin, rays=rays)


def make_method(name: str, limit: int, rr_prob: float) -> Method:
    """'ours', 'prb' or 'path'; the latter two end paths by roulette from the first bounce, and after ``limit``."""
    if name == "ours":
        return Radiometric()
    return (PRB if name == "prb" else PathTracing)(limit + 1, 1, rr_prob)


def make_step(job: dict[str, Any], device: torch.device) -> Step:
    """A whole training step: objective, backward pass and optimizers (at rate 0) of one method in the cube."""
    torch.manual_seed(0)
    scene = build_cube(job["albedo"])
    world = build_world(scene, job["tracer"]).to(device)
    config = FieldConfig(kind=job["fields"], size=job["size"])
    materials = build_materials(scene, config, config).to(device)
    light = reflected_radiance(scene)
    set_albedo(materials, job["albedo"])
    method = make_method(job["method"], job["limit"], job["rr_prob"])
    fields = [materials.albedo]
    radiance = None
    if method.needs_field:
        radiance = build_radiance(scene, RadianceConfig(kind=job["fields"], size=job["size"])).to(device)
        radiance.set_scale(light / START)
        fields.append(radiance)
    optimizers = [SparseRowAdam(part.parameters(), lr=0.0) for part in fields]  # type: ignore[attr-defined]
    cameras = [view.camera for view in scene.train]
    positions, pixels = job["positions"], job["pixels"]
    primary = PrimaryHits(world, cameras, positions, 0, device)
    objective = ObjectiveStep(
        estimator=Estimator(world, materials, radiance, method),
        primary=primary,
        sampling=Sampling(
            spp=positions,
            samples_per_vertex=1,
            cached_spp=positions,
            field_fraction=job["field_fraction"],
            extra_bounce_fraction=0.125,
        ),
        settings=Objective(),
        epsilon=0.01 * light * light,
        emitter_mask=primary.sees_emitter(),
    )
    color = torch.full((pixels, 3), light, device=device)
    iteration = 0

    @of_step(pixels * positions, job["fields"] == "hash")
    def step() -> int:
        nonlocal iteration
        stream = Stream(0, iteration, device=device)
        cast = world.tracer.rays_cast
        view, pixel = stream.integers(len(cameras), pixels), stream.integers(primary.pixels, pixels)
        batch = PixelBatch(view, pixel, color, torch.ones_like(color[:, 0]), iteration)
        for optimizer in optimizers:
            optimizer.zero_grad()
        total(objective(batch, stream).all).backward()  # type: ignore[no-untyped-call]
        for optimizer in optimizers:
            optimizer.step()
        iteration += 1
        return world.tracer.rays_cast - cast

    return step


def reflected_radiance(scene: Scene) -> float:
    """``E a rho / (1 - rho)`` with ``a`` the lights' share of the area: mean reflected light of a closed room."""
    geometry = Geometry(scene)
    light = float((geometry.face_area * geometry.emission[:, 0]).sum() / geometry.face_area.sum())
    albedo = float(TrueMaterials(scene, geometry).albedo_table.constant[0, 0])
    return light * albedo / (1.0 - albedo)


@torch.no_grad()
def set_albedo(materials: FittedMaterials, albedo: float) -> None:
    """Make a fresh albedo field say ``albedo`` everywhere, so that throughput is the scene's; it stays trainable."""
    value = math.log(albedo / (1.0 - albedo))
    for part in materials.albedo.modules():  # type: ignore[attr-defined]
        if isinstance(part, DenseGrid):
            part.table.fill_(value)
        elif isinstance(part, MLP):
            last: Any = part.layers[-1]
            last.weight.mul_(CALM)
            last.bias.fill_(value)


@torch.no_grad()
def path_lengths(albedo: float, rr_prob: float, tracer: str, paths: int = PATHS) -> tuple[float, int]:
    """Average number of bounces of walks that roulette alone ends, from the cameras, and the 99.9 percentile."""
    scene = build_cube(albedo)
    world = build_world(scene, tracer)
    materials = TrueMaterials(scene, world.geometry)
    stream = Stream(1)
    cameras = [view.camera for view in scene.train]
    lengths = []
    for camera in cameras:
        size = torch.tensor([camera.width, camera.height])
        si = world.intersect(camera_rays(camera, stream.uniform(paths // len(cameras), 2) * size))
        u = stream.uniform(len(si), DIMENSIONS)
        length = torch.zeros(len(si))
        for vertex in walk(world, materials, si, materials(si), u, stream, Roulette(1, rr_prob), None):
            length[vertex.lane] += 1
        lengths.append(length)
    found: Tensor = torch.cat(lengths).sort().values
    return float(found.mean()), int(found[math.ceil(0.999 * len(found)) - 1])


def mitsuba_step(job: dict[str, Any]) -> Step:
    """A step of Mitsuba's ``prb`` on the same number of pixels and samples, its albedo in voxels, no optimizer.

    Raises:
        InputError: the package or the LLVM library is missing.
    """
    import numpy as np

    from neurad.studies.peer.replay import Replay
    from neurad.studies.peer.variant import load_mitsuba
    from neurad.studies.peer.voxels import SurfaceVoxels

    mi = load_mitsuba()
    scene = build_cube(job["albedo"])
    voxels = SurfaceVoxels(scene, job["size"] - 1)
    camera = scene.train[0].camera
    photographs = np.full((len(scene.train), camera.width * camera.height, 3), reflected_radiance(scene), np.float32)
    # Its max_depth counts the camera's first hit as 1, and it asks roulette once rr_depth bounces are done.
    replay = Replay(mi, scene, voxels, photographs, job["limit"] + 1, 1)
    values = np.full((len(voxels), 4), job["albedo"], np.float32)

    def step() -> int:
        replay.step(values, job["pixels"], job["positions"])
        return 0  # it does not tell

    return step


def resident_bytes(device: torch.device) -> int:
    """Memory in use now: of the process on a CPU, of torch's allocations on a GPU (whose peak begins anew)."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return int(torch.cuda.memory_allocated(device))
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return peak_bytes(device)
    import resource

    return pages * resource.getpagesize()
