"""What recovered materials answer where no photograph shows the surface: the mean over a box of fine cells."""

import torch

from neurad.assembly.build import build_materials, build_world
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream
from neurad.fields.material import REACH
from neurad.fields.settings import FieldConfig, GridConfig, RoughnessConfig
from neurad.studies.stress.scenes import small_cube, with_material

FINEST = 128
GRID = GridConfig(levels=4, coarsest=4, finest=FINEST, log2_size=12)


def materials_and_points():
    torch.manual_seed(3)
    scene = with_material(small_cube(), PrincipledModel(), 0.5, 0.3)
    geometry = build_world(scene).geometry
    made = build_materials(scene, FieldConfig(GRID, width=16), RoughnessConfig(GRID, width=16))
    with torch.no_grad():
        for field in (made.albedo, made.roughness):
            field.grid.table.normal_(0.0, 1.0)
    prim = torch.arange(len(geometry.emission)).repeat_interleave(40)
    u, v = Stream(5).uniform(len(prim), 2).mul(0.5).unbind(1)
    return made, geometry.interact_at(prim, u, v, geometry.face_normal[prim], torch.ones_like(prim, dtype=torch.bool))


def test_a_guess_is_the_mean_over_the_box():
    """Against many random places: within four standard errors of these, and of what 27 even ones can miss."""
    made, si = materials_and_points()
    found = made.guess(si)
    count = 4000
    lanes = torch.arange(0, len(si), max(len(si) // 8, 1))
    x = made.albedo.cube(si.p[lanes]).repeat_interleave(count, 0)
    x = (x + (2.0 * Stream(7).uniform(len(x), 3) - 1.0) * REACH / FINEST).clamp(0.0, 1.0)
    with torch.no_grad():
        albedo = made.albedo.of_features(made.albedo.grid(x))
        roughness = made.roughness.of_features(made.roughness.grid(x), albedo)
    for guess, values in ((found.albedo, albedo), (found.roughness, roughness)):
        values = values.view(len(lanes), count, -1)
        spread = values.std(1)
        assert ((guess[lanes] - values.mean(1)).abs() < 4.0 * spread / 27**0.5 + 1e-6).all()
        assert (values.mean(1) - values[:, 0]).abs().max() > 4.0 * (guess[lanes] - values.mean(1)).abs().mean()


def test_a_guess_forgets_what_only_the_finest_level_says():
    """Random values in the finest level alone: places differ less in their guesses than in the fields."""
    made, si = materials_and_points()
    with torch.no_grad():
        for field in (made.albedo, made.roughness):
            field.grid.table[: int(field.grid.level_table[-1, 2])] = 0.0
        plain, guess = made(si), made.guess(si)
    assert guess.albedo.std(0).mean() < 0.6 * plain.albedo.std(0).mean()
    assert guess.roughness.std() < 0.6 * plain.roughness.std()


def test_a_guess_has_no_gradient():
    made, si = materials_and_points()
    assert not made.guess(si[:4]).albedo.requires_grad
