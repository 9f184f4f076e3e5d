"""What emitters and smooth surfaces reflect is known, and is not fitted."""

import torch

from neurad.assembly.build import build_materials, build_world
from neurad.core.parameters import RECOVERED
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.formats.load import load_scene
from neurad.scene.textures import TrueMaterials

SMALL = FieldConfig(GridConfig(levels=2, coarsest=2, finest=4, log2_size=8), width=8)


def middles(scene):
    """Geometry, fitted materials, and the middles of all triangles."""
    geometry = build_world(scene).geometry
    made = build_materials(scene, dict.fromkeys(RECOVERED, SMALL), geometry)
    prim = torch.arange(len(geometry.emission))
    third = torch.full((len(prim),), 1 / 3)
    si = geometry.interact_at(prim, third, third, torch.zeros(len(prim), 3), torch.ones(len(prim), dtype=torch.bool))
    return geometry, made, si


def test_emitters_keep_the_materials_of_the_scene():
    scene = load_scene(None, "patterns")
    geometry, made, si = middles(scene)
    found, true = made(si), TrueMaterials(scene, geometry)(si)
    lamp = geometry.emission.amax(-1) > 0
    assert 0 < int(lamp.sum()) < len(lamp)
    assert torch.equal(found.albedo[lamp], true.albedo[lamp])
    assert torch.equal(found.roughness[lamp], true.roughness[lamp])
    free = build_materials(scene, dict.fromkeys(RECOVERED, SMALL), geometry, known_emitters=False)
    free.load_state_dict(made.state_dict())  # nothing known is in a checkpoint
    assert torch.equal(found.albedo[~lamp], free(si).albedo[~lamp])

    (found.albedo.sum() + found.roughness.sum()).backward()
    bias = made.fields["albedo"].mlp.layers[-1].bias.grad
    made.zero_grad()
    (lambda s: (s.albedo.sum() + s.roughness.sum()).backward())(made(si[~lamp]))
    torch.testing.assert_close(bias, made.fields["albedo"].mlp.layers[-1].bias.grad)


def test_smooth_surfaces_keep_the_materials_of_the_scene():
    scene = load_scene(None, "kitchen")
    geometry, made, si = middles(scene)
    smooth = torch.tensor([m.model.is_delta for m in scene.materials])[geometry.material]
    assert 0 < int(smooth.sum()) < len(smooth)
    found, true = made(si), TrueMaterials(scene, geometry)(si)
    assert torch.equal(found.albedo[smooth], true.albedo[smooth])
    assert torch.equal(found.roughness[smooth], true.roughness[smooth])
    rough = smooth.logical_not() & (geometry.emission.amax(-1) == 0)
    assert not torch.equal(found.albedo[rough], true.albedo[rough])
