"""Very bright, very dim and very small lights."""

from dataclasses import replace

import numpy as np
import torch

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, photographs, resized
from benchmarks.stress.scenes import difference, mean_difference, picture, small_cube, with_light
from neurad.core.scene_records import Camera
from neurad.scene.builtin.shapes import look_at, quad
from neurad.scene.description import Scene

UNIT = 5.0
"""Radiance of the cube's own light."""


def _radiance(value: float) -> Case:
    def measure(quick: bool) -> Outcome:
        scene = small_cube()
        found = picture(with_light(scene, value / UNIT), 8) / (value / UNIT)
        return Outcome(difference(found, picture(scene, 8)), 1e-5)

    return Case("light", f"radiance {value:g}", "the same picture times the factor", measure)


def _materials(value: float) -> Case:
    """A fit does not depend on the unit of radiance."""

    def measure(quick: bool) -> Outcome:
        scene = resized(small_cube(12), 12, 4)
        images = photographs(scene, 8)
        factor = value / UNIT
        plan = Plan(steps=40 if quick else 200)
        fits = [Fit(with_light(scene, f), images * f, plan).run() for f in (1.0, factor)]
        si = fits[0].seen()
        a, b = (fit.surface(si).albedo for fit in fits)
        return Outcome(float((a - b).abs().mean()), 0.01, f"{plan.steps} steps, mean absolute difference of albedos")

    return Case("light", f"light and photographs scaled to {value:g}: fitted", "the albedo of the scene as it was",
                measure, value in (1e-6, 1e6))  # fmt: skip


def _both() -> Case:
    """A light of 1e6 and one of 1e-6 in the same room: light adds up."""

    def measure(quick: bool) -> Outcome:
        scene = small_cube()
        lamp = quad((-0.4, 0.5, -0.99), (0.8, 0.0, 0.0), (0.0, 0.4, 0.0))
        dim = lamp.mesh("dim", 1, smooth_shading=False, radiance=np.full(3, 1e-6, np.float32))
        bright = with_light(replace(scene, meshes=[*scene.meshes, dim]), 1.0)
        bright = replace(
            bright,
            meshes=[
                m if m.name != "light" else replace(m, radiance=np.full(3, 1e6, np.float32)) for m in bright.meshes
            ],
        )
        dark = replace(dim, radiance=None)
        alone = replace(bright, meshes=[*bright.meshes[:-1], dark])
        return Outcome(mean_difference(picture(bright, 64), picture(alone, 64)), 0.02, "light of 1e-6 adds nothing")

    return Case("light", "radiance 1e6 and 1e-6 in one scene", "picture without the dim one, means", measure)


def _small(side: float) -> Case:
    """A light of 1e-4 of the room with the power of the large one, far from all that it lights: a point light."""

    def measure(quick: bool) -> Outcome:
        scene = replace(small_cube(24), max_depth=2)
        lamp = quad((-side / 2, 0.5, -side / 2), (side, 0.0, 0.0), (0.0, 0.0, side))
        radiance = np.full(3, 1.0 / side**2, np.float32)  # intensity 1 along the normal
        mesh = lamp.mesh("light", 1, smooth_shading=False, radiance=radiance)
        camera = look_at((0.1, 0.4, 0.1), (0.1, -1.0, 0.11), 60.0, 24)
        view = replace(scene.train[0], camera=camera)
        found = picture(replace(scene, meshes=[scene.meshes[0], mesh], train=[view]), 4)
        expected = _point_light(camera)
        return Outcome(difference(found, expected), 0.02, "pixels of the floor")

    return Case("light", f"light of {side / 2:g} of the room", "point light, closed form", measure)


def _point_light(camera: Camera) -> torch.Tensor:
    """Radiance of the floor y = -1 of albedo 0.5 under a downward cosine light of intensity 1 at (0, 0.5, 0)."""
    from neurad.core.camera import camera_rays
    from neurad.core.rng import Stream
    from neurad.integrators.film import pixel_positions

    pixels = torch.arange(camera.width * camera.height)
    xy = pixel_positions(camera.width, pixels, 16, Stream(4))
    rays = camera_rays(camera, xy.reshape(-1, 2))
    t = (-1.0 - rays.o[:, 1]) / rays.d[:, 1]
    p = rays.o + t.unsqueeze(-1) * rays.d
    d = p - torch.tensor([0.0, 0.5, 0.0])
    squared = (d * d).sum(-1)
    cos = -d[:, 1] / squared.sqrt()
    value = 0.5 / torch.pi * cos * cos / squared
    image = value.view(-1, 16).mean(1).view(camera.height, camera.width, 1)
    return image.expand(-1, -1, 3)


def _into_the_light() -> Case:
    def measure(quick: bool) -> Outcome:
        scene = small_cube(8)
        view = replace(scene.train[0], camera=look_at((0.0, 0.5, 0.0), (0.0, 1.0, 0.001), 20.0, 8))
        scene = replace(scene, train=[view])
        found = picture(scene, 64)
        reflected = picture(with_light(scene, 1.0), 64, depth=1)
        return Outcome(abs(float(reflected.mean()) - UNIT) / UNIT + float((found < reflected - 1e-4).any()), 1e-5,
                       f"emission {UNIT:g} exactly, with reflections {float(found.mean()):.4f}")  # fmt: skip

    return Case("light", "a view into the light", "its radiance, in every pixel", measure)


def _only_light_seen() -> Case:
    def measure(quick: bool) -> Outcome:
        from benchmarks.stress.runs import sentence

        scene = small_cube(8)
        view = replace(scene.train[0], camera=look_at((0.0, 0.5, 0.0), (0.0, 1.0, 0.001), 20.0, 8))
        text = sentence(replace(scene, train=[view]))
        return Outcome(float("emitter" not in text), 0.0, text)

    return Case("light", "every photograph shows the light alone", "one sentence that says so", measure)


def _grazing() -> Case:
    def measure(quick: bool) -> Outcome:
        scene: Scene = replace(small_cube(12), max_depth=2)
        camera = look_at((0.9, -0.9999, 0.0), (-1.0, -1.0, 0.01), 4.0, 12)
        scene = replace(scene, train=[replace(scene.train[0], camera=camera)])
        found, again = picture(scene, 256, seed=1), picture(scene, 256, seed=2)
        return Outcome(mean_difference(found, again), 0.03, f"mean {float(found.mean()):.4f}")

    return Case("light", "a camera 1e-4 above the floor", "finite, another seed gives the same mean", measure)


def cases() -> list[Case]:
    """Brightness, size, and views that show nothing but a light."""
    values = (1e-6, 1e-3, 1e3, 1e6)
    return [
        *(_radiance(v) for v in values),
        *(_materials(v) for v in (1e-6, 5e-3, 5e3, 1e6)),
        _both(),
        _small(2e-4),
        _into_the_light(),
        _only_light_seen(),
        _grazing(),
    ]
