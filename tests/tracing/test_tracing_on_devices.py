"""Ray casters give the same hits wherever the rays lie."""

import math

import pytest
import torch
from helpers.brute_force import BruteForceTracer
from helpers.devices import close, on_devices

from neurad.core.records import Rays
from neurad.core.rng import Stream
from neurad.scene.builtin import build
from neurad.scene.geometry import Geometry
from neurad.tracing.select import make_tracer

N = 1000


@pytest.fixture(scope="module")
def geometry():
    return Geometry(build("patterns"))


@pytest.fixture(scope="module")
def rays(geometry):
    stream = Stream(3)
    low, high = geometry.vertices.amin(0), geometry.vertices.amax(0)
    d = torch.nn.functional.normalize(stream.uniform(N, 3) - 0.5, dim=-1)
    return Rays(low + stream.uniform(N, 3) * (high - low), d)


@pytest.fixture(scope="module")
def expected(geometry, rays):
    return BruteForceTracer(geometry.vertices, geometry.faces).closest(rays)


@on_devices
@pytest.mark.parametrize("backend", ["embree", "open3d", "warp"])
def test_hits_are_those_of_brute_force(geometry, rays, expected, device, backend):
    if backend != "embree":
        pytest.importorskip(backend)
    tracer = make_tracer(backend, geometry.vertices, geometry.faces)
    hit = tracer.closest(rays.to(device))
    assert {getattr(hit, name).device.type for name in ("t", "prim", "u", "v", "valid")} == {device}
    same = hit.prim.cpu() == expected.prim
    assert float((~same).float().mean()) <= 5e-3  # an edge that two triangles share
    close(hit.valid, expected.valid, stray=2e-3)
    close(hit.t.cpu()[same], expected.t[same], rtol=1e-3, atol=1e-4)
    for name in ("u", "v"):
        close(getattr(hit, name).cpu()[same], getattr(expected, name)[same], rtol=0, atol=2e-3, stray=5e-3)


@on_devices
@pytest.mark.parametrize("backend", ["embree", "open3d", "warp"])
def test_occlusion_is_that_of_the_nearest_hit(geometry, rays, device, backend):
    if backend != "embree":
        pytest.importorskip(backend)
    tracer = make_tracer(backend, geometry.vertices, geometry.faces)
    there = rays.to(device)
    t = tracer.closest(there).t
    for factor, expected in ((0.99, False), (1.01, True)):
        blocked = tracer.occluded(there, t * factor)
        assert blocked.device.type == device
        assert float((blocked[t.isfinite()] != expected).float().mean()) <= 5e-3
    assert torch.equal(tracer.occluded(there, torch.full_like(t, math.inf)).cpu(), t.isfinite().cpu())
