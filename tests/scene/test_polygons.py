"""Triangles of polygons: their areas, sides and number."""

import numpy as np
import pytest

from neurad.core.errors import InputError
from neurad.scene.polygons import MAX_TRIANGLES, check_triangle_count, triangulate_polygons

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


def doubled(corners, triangles):
    """Normals of triangles, twice their areas long [f, 3]."""
    a, b, c = np.asarray(corners, float)[triangles.T]
    return np.cross(b - a, c - a)


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
    normals = doubled(corners, triangles) / 2.0
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(area, abs=1e-9)
    assert normals.sum(0) == pytest.approx((-1 if backwards else 1) * area * normal, abs=1e-9)
    assert len(crossing) == 0


def test_a_random_star_has_its_area_and_covers_what_lies_inside():
    generator = np.random.default_rng(3)
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    radius = 1.0 + generator.random(200)
    corners, _ = in_space(np.stack((radius * np.cos(angle), radius * np.sin(angle)), -1), 2)
    triangles, _ = triangulate_polygons(corners, [200])
    true = 0.5 * (radius * np.roll(radius, -1)).sum() * np.sin(2 * np.pi / 200)
    assert np.linalg.norm(doubled(corners, triangles), axis=1).sum() / 2 == pytest.approx(true, rel=1e-9)
    assert len(triangles) == 198
    assert np.unique(triangles).tolist() == list(range(200))


def test_polygons_stay_in_order_and_convex_ones_become_fans():
    shapes = [CASES["L from an outer corner"][0], SQUARE, [(0, 0), (1, 1)], CASES["comb"][0], CASES["triangle"][0]]
    corners = np.concatenate([in_space(shape, 4)[0] for shape in shapes])
    counts = [len(shape) for shape in shapes]
    triangles, _ = triangulate_polygons(corners, counts)
    polygon = np.searchsorted(np.cumsum(counts), triangles, side="right")
    assert (polygon == polygon[:, :1]).all()
    assert polygon[:, 0].tolist() == [0] * 4 + [1] * 2 + [3] * 8 + [4]
    assert triangles[4:6].tolist() == [[6, 7, 8], [6, 8, 9]]


def test_a_bent_quad_keeps_its_two_triangles():
    corners = [(0, 0, 0), (1, 0, 0.4), (1, 1, 0), (0, 1, 0.4)]
    triangles, crossing = triangulate_polygons(corners, [4])
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert len(crossing) == 0


def test_polygons_whose_edges_cross_are_told():
    bow, star = [(0, 0), (2, 2), (2, 0), (0, 1)], [(np.cos(k * 2.513), np.sin(k * 2.513)) for k in range(5)]
    corners = np.concatenate([in_space(shape, 5)[0] for shape in (SQUARE, bow, star)])
    triangles, crossing = triangulate_polygons(corners, [4, 4, 5])
    assert crossing.tolist() == [1, 2]
    assert triangles[:2].tolist() == [[0, 1, 2], [0, 2, 3]]


def test_nothing_has_no_triangles():
    triangles, crossing = triangulate_polygons(np.zeros((0, 3)), [])
    assert triangles.shape == (0, 3)
    assert len(crossing) == 0


def test_too_many_triangles_are_counted():
    check_triangle_count(MAX_TRIANGLES, "room.glb")
    with pytest.raises(InputError, match=f"room.glb: it would have {MAX_TRIANGLES + 1} triangles"):
        check_triangle_count(MAX_TRIANGLES + 1, "room.glb")
