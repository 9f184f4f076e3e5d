"""Which parameters the optimizers move, and what weight decay does to them."""

import pytest
import torch

from neurad.assembly.build import assemble
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.settings import Optimization
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.direct import Direct
from neurad.scene.builtin import build
from neurad.training.optimizers import make_optimizers

GRID = GridConfig(levels=3, coarsest=4, finest=16, log2_size=10)


def optimizers(decay, kind="hash"):
    torch.manual_seed(0)
    roughness = RoughnessConfig(GRID, 16, kind=kind, size=8)
    settings = ModelSettings(
        albedo=FieldConfig(GRID, 16), roughness=roughness, radiance=RadianceConfig(GRID, 16), method=Direct(),
        optimization=Optimization(roughness=0.1, roughness_decay=decay),
    )  # fmt: skip
    made = assemble(build("patterns"), settings)
    return made.materials, make_optimizers(made)


def step(optimizer, gradient):
    for group in optimizer.param_groups:
        for p in group["params"]:
            p.grad = gradient(p)
    optimizer.step()


def test_only_the_table_in_front_of_a_network_decays():
    materials, made = optimizers(2.0)
    before = [p.detach().clone() for p in materials.parameters()]
    for optimizer in made.values():
        step(optimizer, torch.zeros_like)
    table = materials.recovered["roughness"].grid.table
    for p, start in zip(materials.parameters(), before, strict=True):
        torch.testing.assert_close(p.detach(), start * (0.8 if p is table else 1.0))


def test_a_grid_without_a_network_does_not_decay():
    materials, made = optimizers(2.0, kind="dense")
    table = materials.recovered["roughness"].grid.table
    table.data.fill_(1.0)
    step(made["roughness"], torch.zeros_like)
    assert bool((table == 1.0).all())


def test_noise_adds_up_without_decay_and_fades_with_it():
    """Gradients of mean zero: entries walk ever further, as the square root of the steps; decayed ones do not."""
    spread = {}
    for decay in (0.0, 1.0):
        materials, made = optimizers(decay)
        generator = torch.Generator().manual_seed(1)
        table, sizes = materials.recovered["roughness"].grid.table, []
        for count in (400, 1200):
            for _ in range(count):
                step(made["roughness"], lambda p, g=generator: torch.randn(p.shape, generator=g))
            sizes.append(float(table.detach().std()))
        spread[decay] = sizes
    assert spread[0.0][1] > 1.7 * spread[0.0][0]
    assert spread[1.0][1] == pytest.approx(spread[1.0][0], rel=0.1)
    assert spread[1.0][1] < 0.2 * spread[0.0][1]


@pytest.mark.parametrize(("before", "after"), [(0.0, 2.0), (2.0, 0.0), (2.0, 1.0)])
def test_a_state_saved_with_one_decay_continues_with_another(before, after):
    old = optimizers(before)[1]["roughness"]
    step(old, torch.zeros_like)
    materials, made = optimizers(after)
    made["roughness"].load_state_dict(old.state_dict())
    start = materials.recovered["roughness"].grid.table.detach().clone()
    step(made["roughness"], torch.zeros_like)
    torch.testing.assert_close(materials.recovered["roughness"].grid.table.detach(), start * (1.0 - 0.1 * after))
