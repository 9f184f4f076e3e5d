"""What a Lambertian scene does not need is left out, and what stands in its place gives the same numbers."""

from dataclasses import replace

import pytest
import torch
from helpers.trainer_fit import fit

from benchmarks.stress.features import make, parts
from benchmarks.stress.field import Lab
from benchmarks.stress.fit import Fit, Plan, glossy, photographs, plan_of, resized
from neurad.assembly.build import build_radiance
from neurad.assembly.settings import Optimization, Sampling
from neurad.core.rng import Stream
from neurad.fields.mlp import products
from neurad.fields.settings import GridConfig, RadianceConfig
from neurad.integrators.method import query_radiance
from neurad.scene.builtin import build_cornell, build_sphere
from neurad.scene.geometry import Geometry
from neurad.training.inverse import InverseRenderer

GRID = GridConfig(levels=3, coarsest=4, finest=16, log2_size=10)


# ---- interactions and weights


@pytest.mark.parametrize("build_scene", [build_cornell, build_sphere])
def test_the_compiled_interaction_is_the_plain_one(build_scene):
    geometry = Geometry(build_scene())
    stream = Stream(2)
    prim = stream.integers(len(geometry.faces) + 1, 5000) - 1
    u, v = stream.uniform(5000) / 2, stream.uniform(5000) / 2
    given = prim, u, v, torch.nn.functional.normalize(stream.uniform(5000, 3), dim=-1), prim >= 0
    kernel, reference = geometry.interact_at(*given), geometry.interact_reference(*given)
    for key in ("p", "ng", "n", "wo", "uv", "bary"):
        torch.testing.assert_close(getattr(kernel, key), getattr(reference, key), rtol=1e-6, atol=1e-6)
    assert torch.equal(kernel.prim, prim)
    assert torch.equal(kernel.valid, prim >= 0)


# ---- the radiance field


def test_the_radiance_of_a_lambertian_scene_depends_on_the_viewer_by_the_side_alone():
    lab = Lab(build_cornell())
    field = build_radiance(lab.scene, RadianceConfig(grid=GRID))
    si = lab.points(200, Stream(1))
    other = replace(si, wo=torch.nn.functional.normalize(si.ng + 0.3 * si.wo, dim=-1))
    with torch.no_grad():
        assert torch.equal(field(si, None), field(other, torch.rand(200, 3)))
        assert not torch.allclose(field(si, None), field(replace(si, wo=-si.wo), None))

    class Silent:
        def albedo(self, si):
            raise AssertionError("nobody needs the albedo")

    assert torch.equal(query_radiance(field, Silent(), si), field(si, None))
    shiny = build_radiance(glossy(lab.scene), RadianceConfig(grid=GRID))
    with pytest.raises(ValueError, match="albedo"):
        shiny(si, None)
    with pytest.raises(AssertionError):
        query_radiance(shiny, Silent(), si)


def test_inputs_come_from_the_scene_unless_given():
    assert RadianceConfig().resolved(False).inputs == ("direction", "normal", "albedo")
    lean = RadianceConfig(hidden_layers=3).resolved(True)
    assert (lean.inputs, lean.hidden_layers) == (("faceforward",), 2)
    assert RadianceConfig(hidden_layers=0).resolved(True).hidden_layers == 0
    given = RadianceConfig(inputs=("normal",))
    assert given.resolved(True) == given


def test_a_fit_of_a_lambertian_scene_finds_the_albedo():
    scene = resized(build_cornell(), 16)
    made = Fit(scene, photographs(replace(scene, max_depth=6), 16), Plan(steps=90, pixels=64))
    before = made.albedo_error()[0]
    assert made.run().albedo_error()[0] < 0.75 * before


# ---- products of lower precision


def test_precision_of_products_ends_with_the_block():
    with pytest.raises(KeyError), products("high"):
        raise KeyError
    assert torch.get_float32_matmul_precision() == "highest"


def test_a_run_with_rounded_networks_learns(monkeypatch):
    scene = resized(glossy(build_cornell()), 12, 4)
    images = photographs(replace(scene, max_depth=4), 8)
    high = Optimization(albedo=2e-2, radiance=2e-2, matmul="high")
    step = InverseRenderer.training_step

    def watched(*args):
        loss = step(*args)
        assert torch.get_float32_matmul_precision() == "highest"
        assert bool(loss.isfinite())
        return loss

    monkeypatch.setattr(InverseRenderer, "training_step", watched)
    module, _ = fit(scene, images, 100, sampling=Sampling(), optimization=high)
    si = Fit(scene, images).seen(500)
    truth = Lab(scene).materials.albedo(si)
    with torch.no_grad():
        error = float((module.assembly.materials.albedo(si) - truth).abs().mean())
    assert error < 0.7 * float((0.5 - truth).abs().mean())
    assert all(p.dtype == torch.float32 for p in module.parameters())


# ---- the rows of neurad stress


def test_parts_that_are_built_and_left_out():
    images = torch.full((8, 64, 3), 0.3)
    scene = resized(build_cornell(), 8)
    built, left_out = parts(make("needed", scene, images, Plan()))
    assert built == ["area lights"]
    assert parts(make("forced", scene, images, Plan())) == ([*built, *left_out], [])


def test_the_plan_of_a_config_has_its_settings():
    plan = plan_of("patterns.yaml")
    assert plan.pixels * plan.settings.sampling.spp == 4096
    assert plan.settings.roughness.reads_albedo
    assert plan.settings.albedo.grid.finest == 256
    assert plan.settings.objective.chroma_weight == 2.5
    assert plan.settings.optimization.roughness == 6e-3
