"""The training step: which term trains what, the prior's two forms, emitters, and units of light."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.small_step import SmallStep, small_scene

from neurad.assembly.settings import Objective, Sampling
from neurad.core.rng import Stream
from neurad.integrators.radiometric import Radiometric
from neurad.scene.builtin import build_cube
from neurad.training import objective

# ---- which term trains what

ROUTES = {
    "photometric": {"albedo", "roughness"},
    "prior": {"radiance"},
    "prior_extra_bounce": {"radiance"},
    "lhs": {"radiance"},
}
FIELD = {"prior", "prior_extra_bounce", "lhs"}


@pytest.mark.parametrize(
    ("sampling", "settings", "expected"),
    [
        *[(Sampling(), Objective(estimator=e, prior_gradient=g, normaliser=n), {"photometric", *FIELD})
          for e in ("leave_one_out", "two_pass") for g in ("semi", "full") for n in ("photograph", "prediction")],
        (Sampling(), Objective(), {"photometric", *FIELD}),
        (Sampling(extra_bounce_fraction=0), Objective(), {"photometric", "prior", "lhs"}),
        (Sampling(), Objective(lhs=0), {"photometric", "prior", "prior_extra_bounce"}),
        (Sampling(), Objective(prior=0), {"photometric", "lhs"}),
        (Sampling(), Objective(prior=0, lhs=0, estimator="two_pass"), {"photometric"}),
        (Sampling(spp=1), Objective(estimator="two_pass", lhs=0), {"photometric", "prior", "prior_extra_bounce"}),
        (Sampling(spp=4, samples_per_vertex=1, extra_bounce_fraction=1.0), Objective(prior_gradient="full"),
         {"photometric", *FIELD}),
        (Sampling(spp=8, samples_per_vertex=2, cached_spp=8, field_fraction=0.25), Objective(),
         {"photometric", *FIELD}),
        (Sampling(spp=8, samples_per_vertex=1, cached_spp=8, field_fraction=0.5), Objective(prior_gradient="full"),
         {"photometric", *FIELD}),
    ],
)  # fmt: skip
def test_every_term_that_is_wanted_is_there_and_reaches_only_what_it_trains(sampling, settings, expected):
    made = SmallStep(sampling, settings)
    terms = made.step(made.batch(), Stream(3))
    assert set(terms.materials) | set(terms.field) == expected
    assert set(terms.field) == expected & FIELD
    for name, (_, loss) in {**terms.materials, **terms.field}.items():
        assert made.reached(loss.surrogate) == ROUTES[name], name
        assert not loss.value.requires_grad
        assert torch.isfinite(loss.value)


class Pale(Radiometric):
    def regulariser(self, si, surface):
        return surface.albedo.var(-1) * si.valid


def test_a_method_may_have_a_loss_of_its_own():
    """Its mean over pixels, by their weights, with a gradient to materials alone."""
    made = SmallStep(method=Pale())
    batch = made.batch()
    found = made.step(batch, Stream(3))
    weight, loss = found.materials["regulariser"]
    assert weight == 1.0
    assert made.reached(loss.surrogate) == {"albedo"}
    assert set(found.all) == {"photometric", "regulariser", *FIELD}
    twice = made.step(replace(batch, weight=torch.full_like(batch.alpha, 2.0)), Stream(3))
    torch.testing.assert_close(twice.materials["regulariser"][1].value, 2.0 * loss.value)


def test_the_field_learns_the_same_from_some_of_the_first_hits():
    """A fraction of the positions gives the field's losses the same mean, and leaves the photometric one as it is."""
    rows = {}
    for fraction in (1.0, 0.25):
        made = SmallStep(
            Sampling(spp=8, samples_per_vertex=1, cached_spp=8, field_fraction=fraction),
            Objective(normaliser="photograph"),
        )
        assert made.step._field_samples == round(8 * fraction)
        batch = made.batch(64)
        terms = [made.step(batch, Stream(k)).all for k in range(60)]
        rows[fraction] = {name: np.array([float(t[name][1].value) for t in terms]) for name in terms[0]}
    every, some = rows[1.0], rows[0.25]
    np.testing.assert_array_equal(every["photometric"], some["photometric"])
    error = math.sqrt((every["prior"].var() + some["prior"].var()) / 59)
    assert abs(every["prior"].mean() - some["prior"].mean()) < 3.3 * error  # 99.9 %
    assert some["prior"].std() < 4 * every["prior"].std()
    # The weight of the LHS loss is the inverse square of a mean over fewer positions, which is a little larger.
    assert some["lhs"].mean() == pytest.approx(every["lhs"].mean(), rel=0.01)


@pytest.mark.parametrize("gradient", ["semi", "full"])
def test_sides_of_the_prior(monkeypatch, gradient):
    """With 'full' theta's gradient passes through both estimates of T as well, and phi's through none of them."""
    sides = []

    def spy(function):
        def wrapped(field, *rest):
            sides.append((function.__name__, [x for x in rest if isinstance(x, torch.Tensor) and x.dim() == 2]))
            return function(field, *rest)

        return wrapped

    for function in (objective.full_gradient_prior, objective.semi_gradient_prior):
        monkeypatch.setattr(objective, function.__name__, spy(function))
    made = SmallStep(settings=Objective(prior_gradient=gradient))
    made.step(made.batch(), Stream(3))
    names = [name for name, _ in sides]
    if gradient == "semi":
        assert names == ["semi_gradient_prior"] * 2
        return
    assert names == ["full_gradient_prior", "semi_gradient_prior"]
    first, second = sides[0][1]
    assert not torch.equal(first, second)
    for side in (first, second):
        assert made.reached(side.sum()) == {"radiance"}


def test_two_estimates_take_the_noise_out_of_the_prior():
    """The full form estimates the squared residual itself; the other adds the variance of its one estimate, which is
    most of it here."""
    values = {}
    for gradient in ("semi", "full"):
        made = SmallStep(
            Sampling(samples_per_vertex=2),
            Objective(prior_gradient=gradient, epsilon=1.0),
            method=Radiometric(control_variate=False),
        )
        batch = made.batch(128)
        with torch.no_grad():
            for module in (made.materials, made.radiance):
                module.requires_grad_(False)
        values[gradient] = [float(made.step(batch, Stream(k)).field["prior"][1].value) for k in range(100)]
    full, semi = (np.array(values[k]) for k in ("full", "semi"))
    error = math.sqrt((full.var() + semi.var()) / 100)
    assert full.mean() < semi.mean() - 3 * error
    assert full.mean() > 0


# ---- units of light


@pytest.mark.parametrize("normaliser", ["photograph", "prediction"])
def test_a_scene_a_million_times_brighter_trains_the_same(normaliser):
    settings = Objective(normaliser=normaliser, prior_gradient="full")
    found = []
    for unit in (1.0, 1e6):
        made = SmallStep(settings=settings, unit=unit)
        terms = made.step(made.batch(unit=unit), Stream(3))
        weighted = [weight * loss.surrogate for weight, loss in {**terms.materials, **terms.field}.values()]
        found.append(made.gradients(torch.stack(weighted).sum()))
    for name, g in found[0].items():
        assert g.norm() > 0
        assert (found[1][name] - g).norm() < 1e-3 * g.norm(), name


def test_what_a_batch_holds_is_a_function_of_its_stream():
    made = SmallStep()
    batch = made.batch()
    a, b, c = (made.step(batch, Stream(seed)).materials["photometric"][1].surrogate.item() for seed in (3, 3, 4))
    assert a == b != c


# ---- emitters


def test_pixels_that_an_emitter_covers_train_nothing():
    made = SmallStep(settings=Objective(prior=0.0), scene=small_scene(build_cube))  # the Cornell views miss its lamp
    assert 0 < made.emitter_mask.sum() < made.emitter_mask.numel() / 4
    emission = made.estimator.world.geometry.emission.amax(-1) > 0
    kept = made.primary.prim.view(*made.emitter_mask.shape, -1).long()
    torch.testing.assert_close(made.emitter_mask, emission[kept].any(-1))
    assert not emission[kept].all(-1)[made.emitter_mask].all(), "pixels that it covers in part are among them"

    only = made.step(made.batch(64, where=made.emitter_mask), Stream(2))
    for _, loss in [*only.materials.values(), *only.field.values()]:
        assert made.reached(loss.surrogate) == set()
        assert loss.value == 0

    batch = made.batch(600)
    covered = made.emitter_mask[batch.view, batch.pixel]
    assert covered.sum() > 5
    spoilt = replace(batch, color=torch.where(covered.unsqueeze(-1), 1e4, batch.color))
    for name in ("photometric", "lhs"):
        pair = [made.step(b, Stream(2)) for b in (batch, spoilt)]
        first, second = (made.gradients({**t.materials, **t.field}[name][1].surrogate) for t in pair)
        for group in first:
            assert torch.equal(first[group], second[group])
