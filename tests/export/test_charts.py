"""Every mesh gets texture coordinates that name one place each, and textures without seams."""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.exported import GREY, assembled
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neurad.core.records import Surface
from neurad.core.scene_records import Bitmap, Mesh
from neurad.export.atlas import AtlasMaker
from neurad.export.bake import bake
from neurad.export.charts import Chart, find_charts, is_unique, own_chart, triangle_areas
from neurad.export.evidence import CoarseTexels, coarse_size, coarse_texels, grouped, seen_texels
from neurad.export.texel_means import TexelMeans
from neurad.export.texels import LARGEST, TextureSize, rounded, wanted_size
from neurad.export.unwrap import grid_chart, unwrap
from neurad.metrics.seen import SeenBy
from neurad.runtime import threads
from neurad.scene.builtin import build
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TextureTable

SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def mesh(vertices, faces, uvs=None):
    return Mesh("m", np.asarray(vertices, np.float32), np.asarray(faces, np.int64), 0, uvs=uvs)


def quad(uvs=SQUARE):
    return mesh(np.pad(SQUARE, ((0, 0), (0, 1))), FACES, uvs)


def soup(count, rng, size=0.1):
    points = rng.random((count, 1, 3)) + size * rng.standard_normal((count, 3, 3))
    return mesh(points.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


class Position:
    """Materials that say where they are asked."""

    def __call__(self, si):
        return Surface(si.p, si.p[:, :1])


def baked_error(chart, values):
    """Largest difference between bilinear lookups all over a mesh and the positions that were baked into it."""
    geometry = Geometry(Scene("s", [chart.mesh], [GREY]))
    generator = np.random.default_rng(1)
    faces = np.repeat(np.arange(len(chart.mesh.faces)), 8)
    u, v = generator.random((2, len(faces)))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    at = torch.from_numpy(np.stack((u, v)).astype(np.float32))
    si = geometry.interact_at(torch.from_numpy(faces), at[0], at[1], geometry.face_normal[faces], at[0] >= 0)
    table = TextureTable([Bitmap(values[..., :3].astype(np.float32))], 3)
    found = table(torch.zeros(len(faces), dtype=torch.int64), si, geometry)
    return (found - si.p.clamp(0, 1)).abs().amax(-1)


def test_a_square_keeps_its_coordinates_drawn_in_from_the_sides():
    found = own_chart(quad(), 64, 64)
    assert found is not None
    assert found.kind == "own"
    assert np.array_equal(found.mesh.vertices, quad().vertices)
    assert found.corners.min() == pytest.approx(1.5)
    assert found.corners.max() == pytest.approx(62.5)


@pytest.mark.parametrize(
    "uvs",
    [
        SQUARE * 3,  # repeats
        SQUARE - 0.5,
        np.array([[0, 0], [1, 0], [1, 1], [1, 0]], np.float32),  # one half mirrored onto the other
        np.zeros((4, 2), np.float32),
        np.full((4, 2), np.nan, np.float32),
        None,
    ],
)
def test_coordinates_that_name_two_places_are_not_kept(uvs):
    assert own_chart(quad(uvs), 64, 64) is None


def test_charts_that_touch_in_the_texture_only_are_not_kept():
    corners = np.array([[0.1, 0.1], [0.8, 0.1], [0.1, 0.8], [0.8, 0.8], [0.1, 0.8], [0.8, 0.1]], np.float32)
    places = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]]
    two = mesh(places, [[0, 1, 2], [3, 4, 5]], corners)
    assert len(np.unique(find_charts(two))) == 2
    assert own_chart(two, 64, 64) is None
    apart = replace(two, uvs=np.where(np.arange(6)[:, None] < 3, two.uvs - 0.08, two.uvs + 0.08))
    assert own_chart(apart, 64, 64) is not None


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(1, 200), st.integers(0, 1 << 16), st.floats(1e-4, 10.0), st.floats(0.1, 3000.0))
def test_squares_hold_any_triangles(count, seed, size, density):
    rng = np.random.default_rng(seed)
    loose = soup(count, rng, size)
    if seed % 3 == 0:  # slivers
        loose = replace(loose, vertices=loose.vertices * np.float32([1, 1e-6, 1]))
    found = grid_chart(loose, density, 1024)
    assert is_unique(found)
    assert found.corners.min() >= 0
    assert (found.corners <= [found.width, found.height]).all()
    assert np.array_equal(found.mesh.vertices[found.mesh.faces], loose.vertices[loose.faces])


def test_a_worker_that_does_not_end_is_replaced_by_squares(monkeypatch):
    pytest.importorskip("xatlas")
    monkeypatch.setattr("neurad.export.atlas.SECONDS", 1e-4)
    made = unwrap([soup(30, np.random.default_rng(1))], np.array([50.0]), 1 << 16)
    assert [found.kind for found in made] == ["grid"]
    assert is_unique(made[0])


@pytest.mark.parametrize("slow", ["first", "second"])
def test_what_is_left_of_the_budget_goes_to_whom_most_is_photographed_of(monkeypatch, slow):
    """Whichever thread asks first: one export's textures are those of the next."""
    pytest.importorskip("xatlas")
    meshes = [replace(sphere(), name="second"), replace(sphere(), name="first")]
    make = AtlasMaker.make

    def make_late(self, mesh, density):
        if mesh.name == slow:
            time.sleep(0.3)  # the other one is through by then, or waits
        return make(self, mesh, density)

    monkeypatch.setattr(AtlasMaker, "make", make_late)
    monkeypatch.setattr(threads, "threads", lambda count, grain: 2)
    budget = 6 << 16
    second, first = unwrap(meshes, np.full(2, 600.0), budget, share=np.array([1.0, 2.0]))
    assert (first.width * first.height, second.width * second.height) == (4 << 16, 1 << 16)


def sphere():
    import trimesh

    ball = trimesh.creation.icosphere(3, 0.45)
    return mesh(ball.vertices + 0.5, ball.faces)


@pytest.mark.parametrize("kind", ["atlas", "grid"])
def test_no_seam_shows(kind):
    """Looked up bilinearly, the texture of a smooth function is that function on both sides of every border."""
    if kind == "atlas":
        pytest.importorskip("xatlas")
        found = unwrap([sphere()], np.array([200.0]), 1 << 18)[0]
    else:
        found = grid_chart(sphere(), 100.0, LARGEST)
    assert found.kind == kind
    geometry = Geometry(Scene("s", [found.mesh], [GREY]))
    texture = bake(TexelMeans(found, 0, geometry, Position()))
    assert float(baked_error(found, texture.pixels).max()) < 2 / 255


def test_nothing_bleeds_into_smaller_levels():
    found = grid_chart(sphere(), 100.0, LARGEST)
    geometry = Geometry(Scene("s", [found.mesh], [GREY]))

    class White(Position):
        def __call__(self, si):
            return Surface(torch.ones_like(si.p), torch.ones_like(si.p[:, :1]))

    level = bake(TexelMeans(found, 0, geometry, White())).pixels.astype(np.float32)
    for _ in range(3):
        height, width, channels = level.shape
        level = level.reshape(height // 2, 2, width // 2, 2, channels).mean((1, 3))
    assert level.min() == 1.0


def test_textures_fit_into_the_budget():
    sizes = [TextureSize(3000.0, 700.0), TextureSize(20.0, 20.0), TextureSize(0.0, 0.0)]
    assert rounded(sizes, 1 << 30).tolist() == [[4096, 512], [16, 16], [8, 8]]
    assert rounded(sizes, 1 << 16).prod(1).sum() <= 1 << 16
    assert rounded(sizes, 1 << 16, 64).tolist() == [[64, 64]] * 3


def test_size_follows_the_stretch_of_the_coordinates():
    wide = replace(quad(), vertices=quad().vertices * np.float32([4, 1, 1]))
    size = wanted_size(wide, 10.0)
    assert size == TextureSize(pytest.approx(40.0), pytest.approx(10.0), 64.0)
    assert rounded([size], 1 << 20).tolist() == [[128, 32]]  # as many as 64 x 64
    assert rounded([TextureSize(4096.0, 4096.0), size], 100_000).tolist() == [[256, 256], [128, 32]]
    assert rounded([size] * 8, 8 * 512).prod(1).sum() <= 8 * 512  # a budget that is too small for that holds, too
    assert float(triangle_areas(wide.vertices[wide.faces]).sum()) == pytest.approx(4.0)
    assert isinstance(own_chart(wide, 32, 8), Chart)


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


# ---- which texels photographs show: many meshes at once as each by itself


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
