"""Lights send, evaluate and weigh the same on every device."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.devices import close, on_devices
from helpers.object_scene import object_scene, sky
from helpers.random_vertices import random_vertices

from neurad.assembly.build import build_world
from neurad.core.rng import Stream
from neurad.core.scene_records import PunctualLight
from neurad.emitters.fitted import FittedEnvironment
from neurad.scene.builtin import build, build_cornell

N = 3000
PUNCTUAL = (
    PunctualLight("bulb", "point", np.float32([1, 2, 3]), np.float32([0.2, 0.3, 0.1])),
    PunctualLight("beam", "spot", np.float32([4, 2, 1]), np.float32([0, 0.9, 0]), np.float32([0.3, -1, 0]), 60.0, 20.0),
    PunctualLight("sun", "directional", np.float32([1, 1, 1]), direction=np.float32([0.3, -1, 0.2])),
)


def lights_of(name):
    """A scene's world, whose lights are of one kind, of another, or of several."""
    if name == "environment":
        return build_world(object_scene(sky()))
    if name == "fitted environment":
        light = FittedEnvironment(sky(), 16, 8)
        with torch.no_grad():
            light.values.copy_(torch.randn(16 * 8, 3))
        light.refresh()
        return build_world(object_scene(sky()), fitted=light)
    scene = build("patterns") if name == "both" else build_cornell()
    if name == "points":
        scene = replace(scene, meshes=[replace(mesh, radiance=None) for mesh in scene.meshes], punctual=PUNCTUAL)
    if name == "all":
        scene = replace(scene, environment=sky(), punctual=PUNCTUAL)
    if name == "both":
        scene = type(scene)(**{**vars(scene), "environment": sky()})
    return build_world(scene)


@on_devices
@pytest.mark.parametrize("name", ["area lights", "environment", "fitted environment", "both", "points", "all"])
def test_lights_give_the_same_on_every_device(device, name):
    world = lights_of(name)
    si, u = random_vertices(world, N, 3), Stream(4).uniform(N, 3)
    there = copy.deepcopy(world.lights).to(device)
    expected, found = world.lights.sample(si.p, u), there.sample(si.p.to(device), u.to(device))
    # A number on the border of two cells or triangles may choose the other one.
    for field, tolerance in (("wi", 1e-3), ("distance", 1e-3), ("radiance", 1e-2), ("pdf", 1e-2)):
        close(getattr(found, field), getattr(expected, field), rtol=tolerance, atol=1e-4, stray=2e-3)
    close(there.eval(si.to(device)), world.lights.eval(si), rtol=1e-3, atol=1e-4, stray=2e-3)
    close(there.pdf(si.p.to(device), si.to(device)), world.lights.pdf(si.p, si), rtol=1e-2, atol=1e-4, stray=2e-3)
    assert float(expected.radiance.max()) > 0


@on_devices
def test_a_fitted_environment_samples_by_its_present_map(device):
    light = FittedEnvironment(sky(), 16, 8).to(device)
    flat = light.density.clone()
    with torch.no_grad():
        light.values[:] = torch.linspace(-2, 2, 16 * 8, device=device)[:, None]
    assert torch.equal(light.density, flat)
    light.refresh()
    assert light.density.device.type == device
    assert float(light.density.max()) > 1.5 * float(flat.max())
    (light.radiance(torch.nn.functional.normalize(torch.randn(500, 3, device=device), dim=-1)).sum()).backward()
    assert bool(light.values.grad.isfinite().all())
    assert isinstance(light.map(), np.ndarray)
