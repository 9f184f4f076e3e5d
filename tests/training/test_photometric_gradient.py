"""The photometric gradient of the training step: unbiased in one pass and in two, less noisy by stratified samples."""

from dataclasses import replace

import numpy as np
import torch
from helpers.oracles import accept, z_test_samples
from helpers.small_step import SmallStep

from neurad.assembly.settings import Objective, Sampling
from neurad.core.rng import Stream
from neurad.integrators.direct import Direct
from neurad.training import objective


def test_spread_samples_keep_the_mean_of_the_gradient():
    """Groups of jointly stratified samples against all of them independent, in one pass and in two: z-tests at
    99 % over the gradients' projections on a mean one of other seeds, by albedo and by roughness."""

    def rows(groups, samples_per_vertex, estimator, seeds=100):
        sampling = Sampling(spp=8, samples_per_vertex=samples_per_vertex, cached_spp=8, sample_groups=groups)
        made = SmallStep(sampling, Objective(normaliser="photograph", estimator=estimator))
        batch, key = made.batch(64), (groups, samples_per_vertex, len(estimator))
        terms = (made.step(batch, Stream(*key, k)).materials["photometric"][1].surrogate for k in range(seeds))
        found = [made.gradients(term) for term in terms]
        return [torch.stack([g[name] for g in found]).double() for name in ("albedo", "roughness")]

    loose, other = rows(8, 1, "leave_one_out"), rows(8, 1, "two_pass", 30)
    along = [torch.nn.functional.normalize(x.mean(0), dim=0) for x in other]
    p = []
    for settings in ((4, 1, "leave_one_out"), (2, 1, "leave_one_out"), (2, 2, "leave_one_out"), (2, 2, "two_pass")):
        p += [float(z_test_samples(x @ a, y @ a)) for x, y, a in zip(rows(*settings), loose, along, strict=True)]
    assert accept(p), p


def test_spread_samples_have_less_noise():
    """Variance of a pixel's mean over 8 positions whose samples are stratified, relative to independent ones."""
    made = SmallStep(Sampling(spp=8, samples_per_vertex=1, cached_spp=8))
    first = made.primary(made.batch(256), 8, Stream(1))
    with torch.no_grad():
        surface = made.materials(first.si)
        estimator = replace(made.estimator, method=Direct())

        def variance(together):
            samples = [estimator.image(first.si, surface, 1, Stream(2, k), together).value for k in range(40)]
            return float(torch.stack(samples).view(40, 256, 8, 3).mean(2).var(0).mean())

        one, two, four, eight = (variance(together) for together in (1, 2, 4, 8))
    assert two < 0.9 * one
    assert four < 0.8 * one
    assert eight < 0.7 * one


def projections(estimator, seeds, normaliser="photograph"):
    """Photometric gradients over seeds, projected on a few numbers: [seeds, 6].

    They are the biases of the last layers, which make everything brighter or rougher and so feel a bias most, and two
    random directions over all weights.
    """
    made = SmallStep(
        Sampling(spp=2, samples_per_vertex=1, extra_bounce_fraction=0.0),
        Objective(estimator="leave_one_out" if estimator == "naive" else estimator, normaliser=normaliser),
    )
    made.radiance.requires_grad_(False)
    batch = made.batch(48, where=~made.emitter_mask)
    batch = replace(batch, color=batch.color * 0.5)
    rows = []
    for seed in seeds:
        terms = made.step(batch, Stream(seed))
        g = made.gradients(terms.materials["photometric"][1].surrogate)
        a, r = g["albedo"], g["roughness"]
        generator = torch.Generator().manual_seed(1)
        directions = [torch.randn(len(a) + len(r), generator=generator) for _ in range(2)]
        both = torch.cat((a, r))
        rows.append([*a[-3:].tolist(), r[-1].item(), *(float(both @ d) for d in directions)])
    return np.array(rows)


SEEDS = 300


def test_both_photometric_gradients_of_the_real_step_agree_in_the_mean(monkeypatch):
    """300 seeds each, six numbers, 99 % confidence over all; as many reveal a biased form."""
    once = projections("leave_one_out", range(SEEDS))
    twice = projections("two_pass", range(10_000, 10_000 + SEEDS))
    assert accept(z_test_samples(once, twice))

    def naive(samples, target, weight, *_, **__):
        loss = (weight * (samples.mean(1) - target) ** 2).mean()
        return objective.Loss(loss, loss.detach())

    monkeypatch.setattr(objective, "leave_one_out_censored", naive)
    assert not accept(z_test_samples(projections("naive", range(20_000, 20_000 + SEEDS)), twice))
