"""Lights without extent: their choice against its probabilities, their light against closed forms and Mitsuba."""

import math

import numpy as np
import pytest
import torch
from helpers.oracles import accept, pooled_chi2

from neurad.core.errors import InputError
from neurad.core.rng import Stream
from neurad.core.scene_records import PunctualLight
from neurad.emitters.punctual import PunctualLights
from neurad.scene.punctual import pose


def light(kind: str, intensity=(1.0, 2.0, 3.0), at=(0.0, 0.0, 2.0), along=(0.0, 0.0, -1.0), cutoff=30.0, beam=10.0):
    rgb, place, axis = (np.asarray(x, np.float32) for x in (intensity, at, along))
    return PunctualLight(kind, kind, rgb, place, axis, cutoff, beam)  # type: ignore[arg-type]


def points(n: int, seed: int) -> torch.Tensor:
    return 3.0 * (Stream(seed).uniform(n, 3) - 0.5)


SEVERAL = [
    light("point", (3, 0, 0), (0.4, 0.3, 1.0)),
    light("spot", (0, 9, 0), (0.0, 0.0, 2.0), cutoff=40.0),
    light("directional", (0, 0, 1.0), along=(0.3, 0.2, -2.0)),
    light("point", (1, 1, 1), (-5.0, 0.0, 1.0)),
]


def test_lights_are_chosen_with_their_probabilities():
    """At points where all shine, where the spot does not, and on the far side: chi-square at 99 % over all."""
    lights = PunctualLights(SEVERAL)
    n, p_values = 20_000, []
    for index, at in enumerate([(0.1, 0.0, 0.0), (1.2, 1.2, 1.9), (-4.0, 0.0, 1.0), (0.4, 0.3, 1.001)]):
        p = torch.tensor([at])
        chances = lights.chances(p)[0].double()
        assert float(chances.sum()) == pytest.approx(1.0, abs=1e-6)
        s = lights.sample(p.expand(n, 3).contiguous(), Stream(index).uniform(n, 3))
        # every light has a direction of its own here
        alone = [PunctualLights([one]).sample(p, torch.zeros(1, 3)) for one in SEVERAL]
        which = torch.stack([(s.wi - one.wi).norm(dim=1) for one in alone], 1).argmin(1)
        for k, one in enumerate(alone):
            mine = which == k
            if mine.any():
                torch.testing.assert_close(s.pdf[mine], chances[k].float().expand(int(mine.sum())))
                torch.testing.assert_close(s.radiance[mine], one.radiance.expand(int(mine.sum()), 3))
        p_values.append(pooled_chi2(np.bincount(which.numpy(), minlength=4), chances.numpy() * n))
    assert float(lights.chances(torch.tensor([[1.2, 1.2, 1.9]]))[0, 1]) == 0.0  # outside the cone
    assert accept(p_values)


def test_the_sum_over_choices_is_the_light_of_all():
    """One sample over its probability has the mean of all lights, exactly, if each is taken with its probability."""
    lights, p = PunctualLights(SEVERAL), points(200, 3)
    total = sum(PunctualLights([one]).sample(p, torch.zeros(200, 3)).radiance for one in SEVERAL)
    chances = lights.chances(p)
    end = chances.cumsum(1)
    found = torch.zeros(200, 3)
    for k in range(len(SEVERAL)):
        middle = (end[:, k] - chances[:, k] / 2) / end[:, -1]
        s = lights.sample(p, torch.cat((torch.zeros(200, 2), middle[:, None]), 1))
        share = torch.where(chances[:, k] > 0, chances[:, k], 0.0)
        found += torch.where(s.pdf > 0, share / s.pdf.clamp_min(1e-30), 0.0)[:, None] * s.radiance
    torch.testing.assert_close(found, total, rtol=1e-5, atol=1e-6)


def test_a_choice_among_many_is_made_in_pieces(monkeypatch):
    monkeypatch.setattr("neurad.emitters.punctual._AT_ONCE", 1000)
    lights, p, u = PunctualLights(SEVERAL), points(999, 5), Stream(6).uniform(999, 3)
    pieces = lights.sample(p, u)
    monkeypatch.undo()
    whole = lights.sample(p, u)
    torch.testing.assert_close(pieces.radiance, whole.radiance)
    torch.testing.assert_close(pieces.pdf, whole.pdf)


@pytest.mark.parametrize("kind", ["point", "spot", "directional"])
def test_light_at_random_points_is_mitsubas(mi, kind: str):
    one = light(kind, at=(0.2, -0.1, 2.0), along=(0.3, 0.1, -0.9), cutoff=50.0, beam=17.0)
    key = "irradiance" if kind == "directional" else "intensity"
    plugin = {"type": kind, "to_world": mi.ScalarTransform4f(pose(one).tolist())}
    plugin[key] = {"type": "rgb", "value": [float(x) for x in one.intensity]}
    if kind == "spot":
        plugin |= {"cutoff_angle": 50.0, "beam_width": 17.0}
    scene = mi.load_dict({"type": "scene", "light": plugin, "ball": {"type": "sphere", "radius": 0.01}})
    p = points(300, 8)
    s = PunctualLights([one]).sample(p, torch.zeros(300, 3))
    where = mi.SurfaceInteraction3f()
    expected, towards = [], []
    for at in p.tolist():
        where.p = mi.Point3f(at)
        ds, value = scene.emitters()[0].sample_direction(where, [0.5, 0.5])
        assert ds.delta
        expected.append(np.array(value))
        towards.append(np.array(ds.d))
    np.testing.assert_allclose(s.radiance.numpy(), np.stack(expected), rtol=2e-4, atol=1e-5)
    np.testing.assert_allclose(s.wi.numpy(), np.stack(towards), atol=1e-5)
    assert (s.pdf == (s.radiance[:, 0] > 0)).all()
    assert s.is_delta is not None
    assert s.is_delta.all()


def test_power_is_what_passes_a_sphere_around():
    """A point's and a spot's by quadrature over directions of equal solid angle, to 0.1 %."""
    n = 200_000
    z = 1 - 2 * (torch.arange(n) + 0.5) / n
    phi = torch.arange(n) * math.pi * (3 - math.sqrt(5))
    s = (1 - z * z).sqrt()
    d = torch.stack((s * phi.cos(), s * phi.sin(), z), 1)
    for one in (light("point", at=(0, 0, 0)), light("spot", at=(0, 0, 0)), light("spot", at=(0, 0, 0), beam=30.0)):
        lights = PunctualLights([one])
        found = lights.sample(d, torch.zeros(n, 3)).radiance.double().mean(0) * 4 * math.pi
        luminance = float(found @ torch.tensor([0.212671, 0.715160, 0.072169], dtype=torch.float64))
        assert lights.power(7.0) == pytest.approx(luminance, rel=1e-3)
    far = PunctualLights([light("directional", (2, 2, 2))])
    assert far.power(3.0) == pytest.approx(2 * math.pi * 9, rel=1e-5)


def test_no_ray_ends_at_them_and_places_of_no_light_give_zero():
    lights = PunctualLights([light("point", at=(1, 1, 1)), light("spot")])
    p = torch.tensor([[1.0, 1.0, 1.0], [5.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    s = lights.sample(p, torch.tensor([[0.0, 0.0, 0.01]]).repeat(3, 1))
    for values in (s.wi, s.radiance, s.pdf):
        assert torch.isfinite(values).all()
    assert (s.radiance[0] == 0).all()  # on the light itself
    assert float(s.pdf[0]) == 0.0
    alone = PunctualLights([light("spot")]).sample(p, torch.zeros(3, 3))
    assert alone.pdf.tolist() == [0.0, 0.0, 1.0]


def test_the_irradiance_is_differentiable_in_the_intensity():
    lights = PunctualLights(SEVERAL)
    lights.intensity = lights.intensity.clone().requires_grad_()
    s = lights.sample(points(500, 9), Stream(9).uniform(500, 3))
    s.radiance.sum().backward()
    expected = torch.where(s.pdf > 0, 1.0, 0.0).sum()
    assert lights.intensity.grad is not None
    assert float(expected) > 0
    assert torch.isfinite(lights.intensity.grad).all()
    total = float((lights.intensity.grad * lights.intensity.detach()).sum())
    assert total == pytest.approx(float(s.radiance.detach().sum()), rel=1e-5)  # linear in it


def test_only_black_lights():
    with pytest.raises(InputError, match="they are black"):
        PunctualLights([light("point", (0, 0, 0))])
