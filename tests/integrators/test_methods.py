"""The methods against closed forms: each derivative is exact, or short by what theory says."""

import math
from dataclasses import replace

import pytest
import torch
from helpers.method_oracles import Oracle, Textures, camera_vertices, gallery
from helpers.oracles import accept, z_test_samples
from helpers.small_step import SmallStep
from helpers.tiny_fit import checkpoint, fit, metrics
from scipy import stats

from neurad.assembly.build import build_world
from neurad.assembly.settings import Objective
from neurad.cli import main
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream, mix
from neurad.core.scene_records import METAL, constant
from neurad.fields.settings import GridConfig, RadianceConfig
from neurad.integrators.debiased import Debiased
from neurad.integrators.direct import Direct
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.losses.relative import moving_prior
from neurad.runs.model_settings import model_settings
from neurad.scene.builtin import build_cornell, build_furnace
from neurad.scene.textures import TrueMaterials
from neurad.training.train_radiance import train_radiance

METHODS = [  # what their field is off by; bounces after which the field answers, where the derivative is short of rho^k
    (PRB(None), 1.0, 0),
    (PathTracing(None), 1.0, 0),
    (Debiased(), 1.0, 0),
    (Debiased(), 1.2, 0),
    (Debiased(k=3), 0.8, 0),
    *((Radiometric(k), 1.0, k) for k in (1, 2, 4)),
]
OVERLAYS = "ours", "no_prior", "path"
"""Those that train in slow tests alone."""


def check(oracle, paths, largest):
    """Derivatives and values of all methods: p-values; every error at most ``largest``.

    Errors come from 16 batches, so z-scores have Student's distribution of 15 degrees of freedom.
    """
    p_values = []
    for index, (method, wrong, k) in enumerate(METHODS):
        fraction, budget = (1.0 - oracle.rho**k, paths // 4) if k else (1.0, paths)
        grad, value = oracle.estimate(method, budget, mix(index, round(100 * oracle.rho), len(oracle.name)), wrong)
        for (mean, error), truth in ((grad, fraction * oracle.derivative), (value, oracle.exact)):
            z = (mean - truth) / max(error, 1e-6 * truth)
            assert error <= largest * truth, method
            p_values.append(2 * stats.t.sf(abs(z), 15))
    return p_values


@pytest.mark.parametrize("name", ["furnace", "sphere"])
def test_derivatives_in_closed_diffuse_scenes(name):
    """Albedo 0.5 and 0.8, no cap of depth: 99 % confidence over all, standard errors of at most 3 %."""
    p_values = [p for rho in (0.5, 0.8) for p in check(Oracle(name, rho), 12_000, 0.03)]
    assert accept(p_values)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["furnace", "sphere"])
def test_derivatives_in_closed_diffuse_scenes_tightly(name):
    """Albedo 0.5, 0.8, 0.95: standard errors of at most 0.5 %."""
    p_values = []
    for rho, paths in ((0.5, 120_000), (0.8, 240_000), (0.95, 500_000)):
        p_values += check(Oracle(name, rho), paths, 0.005)
    assert accept(p_values)


def test_facets_do_not_bias_the_mean_over_the_sphere():
    """From points spread by area the closed form is exact on the polyhedron; at one point it is off a little."""
    oracle = Oracle("sphere", 0.5)
    _, (mean, error) = oracle.estimate(Direct(), 60_000, 3)
    assert abs(mean - oracle.light * oracle.rho) < 3.3 * error
    assert error < 2e-3 * mean


@pytest.mark.parametrize(
    ("method", "bounces", "field"),
    [
        (Direct(), 1, 0),
        (Radiometric(1), 1, 1),
        (Radiometric(3), 3, 1),
        (PathTracing(6, 100), 5, 0),
        (PRB(6, 100), 5, 0),
    ],
    ids=["direct", "ours", "ours, three bounces", "path", "prb"],
)
def test_white_metal_keeps_all_light_in_a_furnace(method, bounces, field):
    """Walls that shine with 1 and reflect all: each bounce adds 1, and the last of ours what the field says."""
    scene = build_furnace(0.5, 1.0)
    walls = replace(scene.materials[0], model=PrincipledModel(), metallic=METAL, roughness=constant(0.1))
    scene = replace(scene, materials=[replace(walls, albedo=constant(1.0, 3))])
    world = build_world(scene)
    materials, oracle = TrueMaterials(scene, world.geometry), Oracle("furnace", 0.5)
    si = oracle.vertices(4000, Stream(1))
    assert world.bsdf.kernels(materials(si)) is not None
    model = SceneModel(world, materials, lambda si, albedo: torch.full_like(albedo, 2.5))
    u = Stream(2).uniform(len(si), DIMENSIONS)
    found = method.reflected(model, si, materials(si), u, Stream(3)).value.detach().double().mean(-1)
    error = float(found.std()) / len(si) ** 0.5
    assert error < 0.05 * bounces
    assert abs(float(found.mean()) - bounces - 2.5 * field) < 3.3 * error + 2e-3 * (bounces + 2.5 * field)


# ---- finite differences


def test_detached_roughness_derivative_is_right_in_the_mean():
    """Independent streams on both sides of the difference: 99 % confidence. Roughness enters through the sampling
    density as well, whose derivative integrates to nothing."""
    world, materials = build_world(gallery()), Textures()
    si = camera_vertices(world, 500, 1)
    grads, differences = [], []

    def value(seed, shift):
        with torch.no_grad():
            materials.rough += shift
        surface = materials(si)
        stream = Stream(seed)
        out = PathTracing(4, 100).reflected(
            SceneModel(world, materials), si, surface, stream.uniform(500, DIMENSIONS), stream
        )
        return out.value.clamp_max(50.0).sum() / 500

    for seed in range(40):
        (grad,) = torch.autograd.grad(value(seed, 0.0), [materials.rough])
        grads.append(float(grad.sum()))
        with torch.no_grad():
            high = value(1000 + seed, 0.05)
            low = value(1000 + seed, -0.1)
            materials.rough += 0.05
        differences.append(float(high - low) / 0.1)
    assert accept(z_test_samples(grads, differences))


# ---- the training step


BY_FIELD = {name: {"radiance"} for name in ("prior", "prior_extra_bounce", "lhs")}


@pytest.mark.parametrize(
    ("method", "of_field"),
    [
        *((method, {}) for method in (Direct(), PathTracing(), PRB())),  # without a field
        *((method, BY_FIELD) for method in (Radiometric(2), Radiometric(4), Debiased(), Debiased(k=3))),
    ],
)
def test_methods_route_gradients_as_the_paper_does(method, of_field):
    made = SmallStep(method=method)
    if not of_field:
        made.step = replace(made.step, estimator=replace(made.estimator, radiance=None))
    terms = made.step(made.batch(), Stream(3)).all
    reached = {name: made.reached(loss.surrogate) for name, (_, loss) in terms.items()}
    assert reached == {"photometric": {"albedo", "roughness"}, **of_field}


@pytest.mark.parametrize("gradient", ["semi", "full"])
def test_the_prior_moves_the_materials_where_it_is_asked_to(gradient):
    """The field's own gradient stays what it was."""
    found = {}
    for trains in ("field", "both"):
        made = SmallStep(settings=Objective(prior_trains=trains, prior_gradient=gradient))
        terms = made.step(made.batch(), Stream(3))
        found[trains] = {name: made.gradients(loss.surrogate) for name, (_, loss) in terms.all.items()}
        expected = {"radiance"} if trains == "field" else {"radiance", "albedo", "roughness"}
        for name in ("prior", "prior_extra_bounce"):
            assert {k for k, g in found[trains][name].items() if g.abs().sum() > 0} == expected
    torch.testing.assert_close(found["both"]["prior"]["radiance"], found["field"]["prior"]["radiance"])


def test_gradient_of_the_moving_prior_is_unbiased():
    """Against the residual of two independent estimates, on numbers instead of light: d/dt (f - E T)^2 w."""
    field = torch.full((200_000, 3), 0.7)
    noise = torch.randn(2, 200_000, 3)
    t = torch.tensor(1.3, requires_grad=True)
    one, other = (t * (1.0 + n) for n in noise)
    mask = torch.ones(200_000, dtype=torch.bool)
    loss = moving_prior(field.requires_grad_(), one, other, 0.01, mask)
    (grad,) = torch.autograd.grad(loss.surrogate, [t])
    weight = 1.0 / (0.7**2 + 0.01)
    assert math.isclose(grad.item(), 2 * weight * (1.3 - 0.7), rel_tol=0.03)
    assert math.isclose(loss.value.item(), weight * (1.3 - 0.7) ** 2, rel_tol=0.06)


# ---- settings


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Radiometric(0), "k"),
        (lambda: Debiased(exponent=2.0), "exponent"),
        (lambda: Debiased(first_prob=0.0), "first_prob"),
        (lambda: PathTracing(0), "max_depth"),
        (lambda: PathTracing(None, rr_prob=1.0), "rr_prob"),
        (lambda: PRB(rr_depth=0), "rr_depth"),
    ],
)
def test_settings_that_end_no_path_are_refused(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_a_depth_of_one_shows_emitters():
    world = build_world(build_cornell())
    materials = TrueMaterials(build_cornell(), world.geometry)
    rays = camera_rays(build_cornell().test[0].camera, 32 * torch.rand(200, 2, generator=torch.manual_seed(1)))
    first = world.trace_past_delta(rays, torch.zeros(len(rays)))
    assert torch.equal(path_tracer(world, materials, max_depth=1)(rays, 3), world.emitted(first.si))


def test_continuation_exceeds_the_square_of_the_albedo():
    for rho in (0.1, 0.5, 0.9, 0.99):
        weight = torch.full((1, 3), rho)
        later = Debiased().continuation(2, weight, weight)
        assert rho**2 < float(later) <= rho + 1e-6


@pytest.mark.parametrize(
    "name", ["direct", "prb", "debiased", "blend", *(pytest.param(n, marks=pytest.mark.slow) for n in OVERLAYS)]
)
def test_overlays_train_and_continue_exactly(name, tiny):
    """Eight iterations in one go and in two: the same weights; fewer optimizers and no field where none is needed."""
    words = ["--config", f"methods/{name}.yaml", "--model.optimization.schedule=constant"]
    fit(*words, "--trainer.max_steps=8")
    fit(*words, "--trainer.max_steps=5")
    main(["fit", "--ckpt_path=version_1", "--trainer.max_steps=8"])
    whole, continued = checkpoint(0), checkpoint(1)
    for key, value in whole["state_dict"].items():
        assert torch.equal(value, continued["state_dict"][key]), key
    has_field = any(key.startswith("radiance") for key in whole["state_dict"])
    assert has_field == (name in ("ours", "no_prior", "debiased", "blend"))
    assert len(whole["optimizer_states"]) == (2 if has_field else 1)
    assert continued["neurad"]["samples"] == float(metrics(1)[-1]["samples"]) == 8 * 16 * 4
    assert float(metrics(1)[-1]["psnr_linear"]) > 0


# ---- forward neural radiosity


def test_a_radiance_field_of_known_materials_finds_the_furnace():
    oracle = Oracle("furnace", 0.6)
    scene = build_furnace(0.6)
    grid = GridConfig(levels=2, coarsest=4, finest=8, log2_size=10)
    small = RadianceConfig(grid=grid, width=16, hidden_layers=1)
    settings = replace(model_settings("scene.yaml"), radiance=small)
    cameras = [v.camera for v in scene.train]
    field = train_radiance(scene, oracle.world, oracle.materials, cameras, settings, 200, pixels=128)
    si = oracle.vertices(500, Stream(8))
    with torch.no_grad():
        found = field(si, oracle.materials.albedo(si))
    assert math.isclose(float(found.mean()), oracle.exact, rel_tol=0.03)
