"""Metalness of triangles: nothing until something is found, then 0 or 1, and it is kept with the weights."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neurad.assembly.fitted_materials import build_materials
from neurad.core.parameters import RECOVERED
from neurad.core.records import SurfaceInteraction
from neurad.fields.metalness import Metalness
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.scene.builtin import build_cornell
from neurad.scene.geometry import Geometry
from neurad.scene.parts import SurfaceParts


@pytest.fixture(scope="module")
def geometry():
    return Geometry(build_cornell())


def centres(geometry):
    """The middle of every triangle, as it is seen along its normal."""
    p = geometry.vertices[geometry.faces].mean(1)
    count = len(p)
    normal, flat, prim = geometry.face_normal, torch.full((count, 2), 1 / 3), torch.arange(count)
    return SurfaceInteraction(p, normal, normal, normal, flat, flat, prim, torch.ones(count, dtype=torch.bool))


def test_parts_of_several_meshes_are_several_groups(geometry):
    groups = SurfaceParts(geometry, geometry.mesh_index)
    group = groups.of(torch.arange(len(geometry.faces)))
    assert groups.count >= int(geometry.mesh_index.max()) + 1
    for index in range(groups.count):
        assert len(geometry.mesh_index[group == index].unique()) == 1
        assert int(group[groups.triangles[index]]) == index
    joined = SurfaceParts(geometry)
    assert joined.count <= groups.count


def test_what_is_found_is_kept(geometry):
    field, si = Metalness(SurfaceParts(geometry, geometry.mesh_index), len(geometry.faces)), centres(geometry)
    assert not field.done
    assert field(si) is None
    probability = torch.zeros(len(geometry.faces))
    field.set(probability)
    assert field.done
    assert field(si) is None, "nothing was found, so that nothing is paid for it"
    probability[:2] = torch.tensor([0.9, 0.4])
    field.set(probability)
    values, std = field(si), field.std(si.p, si.prim)
    assert torch.equal(values.squeeze(-1) > 0, si.prim == 0)
    np.testing.assert_allclose(std[:3, 0], [0.3, np.sqrt(0.24), 0.0], atol=1e-6)
    other = Metalness(SurfaceParts(geometry, geometry.mesh_index), len(geometry.faces))
    other.load_state_dict(field.state_dict())
    assert other.done
    assert torch.equal(other(si), values)


def test_materials_have_it_once_it_is_found(geometry):
    scene = build_cornell()
    config = FieldConfig(GridConfig(levels=2, coarsest=4, finest=8, log2_size=8), 8)
    materials = build_materials(scene, dict.fromkeys(RECOVERED, config), geometry, finds_metal=True)
    assert "metallic" not in build_materials(scene, dict.fromkeys(RECOVERED, config), geometry).fields
    si = centres(geometry)
    assert materials(si).metallic is None
    assert "metallic" not in materials.at(si.p)
    probability = torch.zeros(len(geometry.faces))
    probability[::3] = 1.0
    materials.metalness.set(probability)
    assert torch.equal(materials(si).metallic, materials.at(si.p, si.prim)["metallic"])
    assert torch.equal(materials(replace(si, uv=si.uv + 1)).metallic, materials(si).metallic)
    assert torch.equal(materials.at(si.p)["metallic"], materials(si).metallic)
    assert materials.std(si.p)["metallic"].max() == 0.0
