"""Base colours for other programs' models."""

import numpy as np
import pytest
import torch

from neurad.export.base_colour import ANGLES, base_for, energy, over_angles


@pytest.mark.parametrize(
    ("roughness", "blender", "gltf"),
    [(0.1, 1.061, 1.020), (0.2, 1.068, 1.032), (0.35, 1.071, 1.050), (0.5, 1.070, 1.065), (1.0, 1.083, 1.113)],
)
def test_factors_at_a_base_of_one_half(roughness, blender, gltf):
    """Against a quadrature made apart from this one."""
    base, rough = np.full((1, 3), 0.5, np.float32), np.full((1, 1), roughness, np.float32)
    assert base_for("blender", base, rough)[0, 0] / 0.5 == pytest.approx(blender, abs=1.5e-3)
    assert base_for("gltf", base, rough)[0, 0] / 0.5 == pytest.approx(gltf, abs=1.5e-3)
    assert base_for("exact", base, rough) is base


def test_energy_is_what_the_shaded_model_sends_back():
    """Against the mean of the weights of samples."""
    from neurad.bsdf.principled import Principled
    from neurad.core.records import Surface

    torch.manual_seed(0)
    n, roughness = 200_000, 0.5
    cosine = torch.rand(n).sqrt()
    wo = torch.stack(((1 - cosine * cosine).sqrt(), torch.zeros(n), cosine), -1)
    surface = Surface(torch.full((n, 3), 0.8), torch.full((n, 1), roughness))
    mean = float(Principled().sample(surface, wo, torch.rand(n, 3)).weight.mean())
    found = energy()
    at = int(roughness * 64)
    assert 0.8 * found.diffuse[at] + found.separable[at] == pytest.approx(mean, abs=3e-3)


def test_the_table_over_angles_leaves_the_mean_over_them_alone():
    """What Cycles sends back in all, its base colour times what the coat leaves and the coat, is all the same."""
    from neurad.bsdf.microfacet import fresnel_dielectric, reflectance

    table, found = over_angles(), energy()
    steps = (np.arange(ANGLES) + 0.5) / ANGLES
    for row in (8, 31, 60):
        alpha = steps[row] ** 2
        coat = reflectance(
            torch.from_numpy(steps), alpha, lambda c: fresnel_dielectric(c, 1.5)[:, None], correlated=True
        )
        coat = coat[:, 0].numpy()
        mean = base_for("blender", np.ones((1, 3), np.float32), np.full((1, 1), steps[row], np.float32))[0, 0]
        back = (2.0 * steps * (mean * table[row] * (1.0 - coat) + coat)).mean()
        expected = np.interp(steps[row], np.linspace(0, 1, 65), found.diffuse + found.separable)
        assert back == pytest.approx(expected, rel=2e-3)
    assert table[31, -1] < 1.0 < table[31, 8]  # head-on Cycles is too bright without it, at grazing angles too dark
