"""The blending of radiance field and sampled bounces against its two ends, closed forms and central differences."""

from dataclasses import replace

import pytest
import torch
from helpers.method_oracles import Oracle, Textures, camera_vertices, gallery
from helpers.oracles import half_difference
from helpers.small_step import GRID, SmallStep
from scipy import stats

from neurad.assembly.build import build_radiance, build_world
from neurad.core.rng import Stream
from neurad.fields.settings import RadianceConfig
from neurad.integrators.blend import Blend
from neurad.integrators.method import SceneModel
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS


class Weighted(torch.nn.Module):
    """A radiance that differs by place and direction, with given weights."""

    def __init__(self, weights):
        super().__init__()
        self.weights = weights

    def forward(self, si, albedo):
        return 0.2 + 0.1 * si.p.abs() + 0.3 * si.wo.abs()


class Fixed(Oracle):
    """A closed scene whose field is off by a factor and weighed by ``w``."""

    def __init__(self, rho, w):
        super().__init__("furnace", rho)
        self.w = w

    def parts(self, wrong=1.0):
        field = super().parts(wrong).radiance

        def weighed(si, albedo):
            return field(si, albedo)

        weighed.weights = lambda si: torch.full_like(si.p[:, :1], self.w)
        return SceneModel(self.world, self.materials, weighed)


@pytest.fixture(scope="module")
def seen():
    """World, textures and vertices of a room with a mirror and glass."""
    world = build_world(gallery())
    return world, Textures(), camera_vertices(world, 3000, 1)


def value(seen, method, weights):
    world, materials, si = seen
    scene = SceneModel(world, materials, Weighted(weights))
    return method.reflected(scene, si, materials(si), Stream(5).uniform(3000, DIMENSIONS), Stream(7))


@pytest.mark.parametrize(("w", "k", "same"), [(1.0, 2, 1), (1.0, 4, 1), (0.0, 2, 2), (0.0, 3, 3)])
def test_weights_of_one_and_zero_are_the_paper_s_method_bit_by_bit(seen, w, k, same):
    """Values, and their derivatives by albedo and roughness up to rounding: sums of the same terms with some zeros."""
    weights = lambda si: torch.full_like(si.p[:, :1], w)  # noqa: E731
    found, expected = (value(seen, method, weights) for method in (Blend(k), Radiometric(same)))
    assert torch.equal(found.value, expected.value)
    assert torch.equal(found.Li_bsdf, expected.Li_bsdf)
    parameters = list(seen[1].parameters())
    pairs = zip(*(torch.autograd.grad(x.value.sum(), parameters) for x in (found, expected)), strict=True)
    for own, other in pairs:
        torch.testing.assert_close(own, other, rtol=1e-4, atol=1e-4 * float(other.abs().max()))


def test_a_field_without_weights_answers_alone(seen):
    assert torch.equal(value(seen, Blend(), None).value, value(seen, Radiometric(), None).value)


@pytest.mark.parametrize("w", [0.3, 0.8, 1.0])
def test_value_and_derivative_in_a_closed_scene(w):
    """The field is 20 % too bright: with E the direct light over the albedo and F the field, the value is
    ``rho (E + w F + (1 - w) rho (E + F))``; 99.9 % confidence each, errors of at most 2 %. With a weight of 1 it is the
    paper's method, whose derivative is ``E + F``."""
    oracle = Fixed(0.6, w)
    rho, light, field = oracle.rho, oracle.light, 1.2 * oracle.exact
    expected = (
        light + w * field + 2 * (1 - w) * rho * (light + field),
        rho * (light + w * field + (1 - w) * rho * (light + field)),
    )
    for (mean, error), truth in zip(oracle.estimate(Blend(), 16_000, 11, 1.2), expected, strict=True):
        assert error < 0.02 * truth
        assert 2 * stats.t.sf(abs(mean - truth) / max(error, 1e-6 * truth), 15) > 1e-3


def test_derivatives_equal_central_differences_with_common_random_numbers(seen):
    """By a grid and network of weights, and by the albedo: neither moves a path."""
    torch.manual_seed(3)
    config = RadianceConfig(grid=GRID, width=16, hidden_layers=1)
    weights = build_radiance(gallery(), config, weighted=True).weights
    with torch.no_grad():
        weights.grid.table.normal_()
    fixed = weights(seen[2]).detach()
    assert float(fixed.max() - fixed.min()) > 0.4
    for parameters in ([*weights.parameters()], [seen[1].colour]):
        found = torch.autograd.grad(value(seen, Blend(3), weights).value.sum(), parameters)
        steps = [0.01 * g.to_dense() / g.to_dense().norm() for g in found]  # where there is most to see
        along = sum(float((g.to_dense() * step).sum()) for g, step in zip(found, steps, strict=True))
        moves = list(zip(parameters, steps, strict=True))
        ends = half_difference(lambda: value(seen, Blend(3), weights).value.double().sum(), moves)
        assert ends == pytest.approx(along, rel=5e-3)


def test_gradients_of_a_step_reach_the_weights_by_the_photographs_alone():
    made = SmallStep(method=Blend())
    config = RadianceConfig(grid=GRID, width=16, hidden_layers=1)
    radiance = build_radiance(made.scene, config, weighted=True)
    made.step = replace(made.step, estimator=replace(made.estimator, radiance=radiance))
    weights = list(radiance.weights.parameters())
    made.groups["weights"] = weights
    made.groups["radiance"] = [p for p in radiance.parameters() if all(p is not w for w in weights)]
    terms = made.step(made.batch(), Stream(3)).all
    reached = {name: made.reached(loss.surrogate) for name, (_, loss) in terms.items()}
    field = {"radiance"}
    assert reached == {
        "photometric": {"albedo", "roughness", "weights"}, "prior": field, "prior_extra_bounce": field, "lhs": field,
    }  # fmt: skip
