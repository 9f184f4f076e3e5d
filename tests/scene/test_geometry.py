"""Surface points, vertex data, camera rays."""

import numpy as np
import pytest
import torch
from helpers.brute_force import BruteForceTracer

from neurad.core.errors import InputError
from neurad.core.records import Rays
from neurad.core.reflection import DiffuseModel
from neurad.core.scene_records import Constant, Material, Mesh
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.polygons import triangulate_polygons

ONE = Constant(np.ones(3, np.float32))
TRIANGLE = np.array([[0, 1, 2]])


def array(*rows):
    return np.array(rows, np.float32)


def scene():
    """A flat triangle in z = 0, a smooth one in z = -1 with uv, attributes and light, and one without area."""
    flat = Mesh("flat", array([0, 0, 0], [1, 0, 0], [0, 1, 0]), TRIANGLE, 1)
    corners = array([0, 0, -1], [2, 0, -1], [0, 2, -1])
    normals = array([0, 0, 1], [1, 0, 1], [0, 1, 1]) / np.sqrt(array([1], [2], [2]))
    uvs = array([0.1, 0.2], [0.9, 0.2], [0.1, 0.6])
    heat = {"vertex heat.0": array([1, 0], [3, 0], [5, 8])}
    smooth = Mesh("smooth", corners, TRIANGLE, 0, normals, uvs, heat, radiance=array(3, 2, 1))
    line = Mesh("line", array([0, 0, 0], [1, 1, 1], [2, 2, 2]), TRIANGLE, 1)
    return Scene("s", [flat, smooth, line], [Material(name, DiffuseModel(), ONE, ONE) for name in "ab"])


def at(g, prim, u, v):
    n = len(prim)
    valid = torch.tensor(prim) >= 0
    return g.interact_at(
        torch.tensor(prim), torch.tensor(u), torch.tensor(v), torch.tensor([[0.0, 0.0, 1.0]] * n), valid
    )


def test_hits_and_misses_of_a_tracer():
    g = Geometry(scene())
    o = torch.tensor([[0.2, 0.3, 2.0], [1.5, 0.2, 2.0], [5.0, 5.0, 2.0]])
    rays = Rays(o, torch.tensor([[0.0, 0.0, -1.0]]).expand(3, 3))
    hit = BruteForceTracer(g.vertices, g.faces).closest(rays)
    assert hit.prim.tolist() == [0, 1, -1]
    assert not g.state_dict()  # checkpoints have no geometry
    si = g.interact(rays, hit)
    torch.testing.assert_close(si.p[:2], (o + hit.t[:, None] * rays.d)[:2])
    torch.testing.assert_close(si.wo, -rays.d)
    assert si.valid.tolist() == [True, True, False]
    assert si.prim.tolist() == [0, 1, -1]
    for values in (si.p, si.n, si.ng, si.uv):
        assert torch.isfinite(values).all()


def test_normals_that_cancel_become_the_geometric_one_and_attributes_are_interpolated():
    corners = array([0, 0, 0], [1, 0, 0], [0, 1, 0])
    zero = Mesh("zero", corners, TRIANGLE, 0, array([0, 0, 0], [0, 0, 0], [0, 0, 0]))
    apart = Mesh("apart", corners, TRIANGLE, 0, array([1, 0, 0], [-1, 0, 0], [0, 1, 0]))
    g = Geometry(Scene("s", [zero, apart], [Material("a", DiffuseModel(), ONE, ONE)]))
    si = at(g, [0, 1], [0.3, 0.5], [0.3, 0.0])
    torch.testing.assert_close(si.n, torch.tensor([[0.0, 0.0, 1.0]] * 2))

    g = Geometry(scene())
    heat = g.attribute("vertex heat.0", at(g, [1, 0, -1], [0.25, 0.25, 0.0], [0.5, 0.5, 0.0]))
    torch.testing.assert_close(heat, torch.tensor([[3.5, 4.0], [0.0, 0.0], [0.0, 0.0]]))
    with pytest.raises(InputError, match=r"cold.*vertex heat"):
        g.attribute("cold", at(g, [0], [0.0], [0.0]))

    corners = array([0, 0, 0], [1, 0, 0], [0, 1, 0])
    meshes = [Mesh(str(c), corners, TRIANGLE, 0, attributes={"a": np.ones((3, c), np.float32)}) for c in (1, 3)]
    with pytest.raises(InputError, match="attribute a"):
        Geometry(Scene("s", meshes, [Material("a", DiffuseModel(), ONE, ONE)]))


def test_a_scene_without_triangles_gives_misses():
    g = Geometry(Scene("s", [], []))
    rays = Rays(torch.zeros(4, 3), torch.tensor([[0.0, 1.0, 0.0]] * 4))
    hit = BruteForceTracer(g.vertices, g.faces).closest(rays)
    si = g.interact(rays, hit)
    assert not si.valid.any()
    assert torch.equal(g.spawn(si, rays.d).o, si.p)
    assert g.scale == 0


def test_the_floor_of_a_huge_scene_hides_nothing_small():
    corners = 1e5 * array([-1, 0, -1], [-1, 0, 1], [1, 0, 1])
    g = Geometry(Scene("s", [Mesh("floor", corners, TRIANGLE, 0)], [Material("a", DiffuseModel(), ONE, ONE)]))
    si = at(g, [0], [0.25], [0.25])
    up = torch.tensor([[0.0, 1.0, 0.0]])
    near = g.spawn(g.interact_at(si.prim, torch.tensor([0.0]), torch.tensor([0.5]), up, si.valid), up)
    assert 0 < near.o[0, 1] < 1e-4  # at the world's origin, in a scene of 1e5 units


def test_shadow_rays_end_before_the_light_and_may_be_endless():
    g = Geometry(scene())
    si = at(g, [0, 0], [0.2, 0.2], [0.3, 0.3])
    wi = torch.nn.functional.normalize(torch.tensor([[0.0, 0.6, 0.8], [0.0, 0.6, -0.8]]), dim=-1)
    rays, t_max = g.spawn_towards(si, wi, torch.tensor([5.0, torch.inf]))
    assert 4.99 < t_max[0] < 5.0
    assert torch.isinf(t_max[1])
    assert rays.o[0, 2] > 0 > rays.o[1, 2]
    torch.testing.assert_close(rays.d, wi)
    torch.testing.assert_close((rays.o + 5.0 * rays.d)[0], si.p[0] + 5.0 * wi[0])


# ---- triangles of polygons: their areas, sides and number


SQUARE = [(0, 0), (2, 0), (2, 2), (0, 2)]
CASES = {
    "triangle": ([(0, 0), (1, 0), (0, 1)], 0.5),
    "square": (SQUARE, 4.0),
    "dart": ([(0, 0), (2, 0), (0.3, 0.3), (0, 2)], 0.6),
    "dart from its tip": ([(2, 0), (0.3, 0.3), (0, 2), (0, 0)], 0.6),
    "L": ([(1, 1), (1, 2), (0, 2), (0, 0), (2, 0), (2, 1)], 3.0),
    "L from an outer corner": ([(2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0)], 3.0),
    "comb": ([(0, 0), (7, 0), *((x, 3 if x % 2 else 1) for x in range(7, -1, -1))], 14.0),
    "corners on a line": ([(0, 0), (1, 0), (2, 0), (2, 2), (1, 2), (0, 2)], 4.0),
    "repeated corners": ([(0, 0), (2, 0), (2, 0), (2, 2), (0, 2), (0, 0)], 4.0),
    "hole on a bridge": (
        [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)],
        12.0,
    ),
    "a point": ([(1, 1)] * 5, 0.0),
    "a line": ([(0, 0), (1, 0), (2, 0), (3, 0)], 0.0),
}  # fmt: skip


def in_space(points, turn):
    """Points of a plane [n, 2] in one that stands askew, far from the origin."""
    basis, _ = np.linalg.qr(np.random.default_rng(turn).normal(size=(3, 3)))
    return np.asarray(points, float) @ basis[:2] + 10.0, np.cross(basis[0], basis[1])


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("backwards", [False, True])
def test_triangles_have_the_area_and_the_side_of_their_polygon(case, backwards):
    points, area = CASES[case]
    corners, normal = in_space(points[::-1] if backwards else points, 1)
    triangles, crossing = triangulate_polygons(corners, [len(corners)])
    a, b, c = corners[triangles.T]
    normals = np.cross(b - a, c - a) / 2.0
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(area, abs=1e-9)
    assert normals.sum(0) == pytest.approx((-1 if backwards else 1) * area * normal, abs=1e-9)
    assert len(crossing) == 0


def test_polygons_stay_in_order_as_fans_and_those_whose_edges_cross_are_told():
    shapes = [CASES["L from an outer corner"][0], SQUARE, [(0, 0), (1, 1)], CASES["comb"][0], CASES["triangle"][0]]
    corners = np.concatenate([in_space(shape, 4)[0] for shape in shapes])
    counts = [len(shape) for shape in shapes]
    triangles, _ = triangulate_polygons(corners, counts)
    polygon = np.searchsorted(np.cumsum(counts), triangles, side="right")
    assert (polygon == polygon[:, :1]).all()
    assert polygon[:, 0].tolist() == [0] * 4 + [1] * 2 + [3] * 8 + [4]
    assert triangles[4:6].tolist() == [[6, 7, 8], [6, 8, 9]]

    corners = [(0, 0, 0), (1, 0, 0.4), (1, 1, 0), (0, 1, 0.4)]
    triangles, crossing = triangulate_polygons(corners, [4])
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert len(crossing) == 0

    bow, star = [(0, 0), (2, 2), (2, 0), (0, 1)], [(np.cos(k * 2.513), np.sin(k * 2.513)) for k in range(5)]
    corners = np.concatenate([in_space(shape, 5)[0] for shape in (SQUARE, bow, star)])
    triangles, crossing = triangulate_polygons(corners, [4, 4, 5])
    assert crossing.tolist() == [1, 2]
    assert triangles[:2].tolist() == [[0, 1, 2], [0, 2, 3]]

    triangles, crossing = triangulate_polygons(np.zeros((0, 3)), [])
    assert triangles.shape == (0, 3)
    assert len(crossing) == 0
