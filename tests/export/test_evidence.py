"""Which texels photographs show: many meshes at once as each by itself."""

import numpy as np
import pytest
import torch
from helpers.exported import assembled

from neurad.export.evidence import CoarseTexels, coarse_size, coarse_texels, seen_texels
from neurad.export.run import grouped
from neurad.export.unwrap import unwrap
from neurad.metrics.seen import SeenBy
from neurad.scene.builtin import build


def test_meshes_are_asked_together_as_each_alone():
    pytest.importorskip("xatlas")
    assembly = assembled(build("cornell"))
    scene, world = assembly.scene, assembly.world
    first = np.cumsum([0, *(len(mesh.faces) for mesh in scene.meshes)])
    charts = unwrap(scene.meshes, np.full(len(scene.meshes), 30.0), 1 << 20)
    texels = [coarse_texels(chart, int(at), world.geometry) for chart, at in zip(charts, first, strict=False)]
    none = np.zeros(0, np.int64)
    texels.insert(1, CoarseTexels((4, 4), none, texels[0].si[torch.from_numpy(none)]))
    cameras = [view.camera for view in scene.train[:2]]

    def seen_by():
        return SeenBy(world.geometry, world.tracer.tracer, cameras)

    found = seen_texels(texels, seen_by())
    assert len(found[1]) == 0
    alone = [seen_by().any(of_mesh.si).numpy() for of_mesh in texels]
    assert all(np.array_equal(a, b) for a, b in zip(found, alone, strict=True))
    fraction = np.concatenate(alone).mean()
    assert 0.05 < fraction < 0.95, fraction  # else it would not tell one mesh from another
    assert [of_mesh.shape for of_mesh in texels[:1]] == [coarse_size(charts[0])]
    assert seen_texels([], seen_by()) == []


@pytest.mark.parametrize(
    ("sizes", "groups"),
    [
        ({}, []),
        ({3: 4, 5: 6, 6: 1, 9: 9}, [[3, 5], [6, 9]]),
        ({0: 30, 1: 2, 2: 30, 3: 8, 4: 2}, [[0], [1], [2], [3, 4]]),
    ],
)
def test_groups_hold_as_much_as_fits(sizes, groups):
    assert list(grouped(sizes, 10)) == groups
