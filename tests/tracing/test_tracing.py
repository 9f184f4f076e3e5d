"""All ray casters against the brute-force twin in float64."""

from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from helpers.brute_force import BruteForceTracer
from helpers.directions import directions as random_directions
from helpers.torch_threads import torch_threads

from neurad.core.errors import InputError
from neurad.core.records import Rays
from neurad.core.reflection import DiffuseModel
from neurad.core.sampling import uniform_triangle
from neurad.core.scene_records import Constant, Material, Mesh
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.tracing.counting import CountingTracer
from neurad.tracing.select import make_tracer


@pytest.fixture(params=["embree", "open3d", "warp"])
def backend(request):
    if request.param == "open3d":
        pytest.importorskip("open3d", exc_type=ImportError)
    if request.param == "warp":
        pytest.importorskip("warp")
    return request.param


directions = partial(random_directions, upper=False)


def uniform(*shape, seed=1):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def tensors(mesh, scale=1.0, offset=(0.0, 0.0, 0.0)):
    vertices = torch.tensor(np.asarray(mesh.vertices) * scale + np.asarray(offset), dtype=torch.float32)
    return vertices, torch.tensor(np.asarray(mesh.faces), dtype=torch.int64)


def soup(count, seed=3):
    """Random triangles that overlap in depth."""
    centre = 2.0 * uniform(count, 1, 3, seed=seed) - 1.0
    corners = centre + 0.6 * (uniform(count, 3, 3, seed=seed + 1) - 0.5)
    return corners.reshape(-1, 3), torch.arange(3 * count).reshape(-1, 3)


def ball(subdivisions=3, tilt=True):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    if tilt:
        mesh.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.5, 0.7))
    return mesh


def geometry(vertices, faces):
    one = Constant(np.ones(3, np.float32))
    mesh = Mesh("m", vertices.numpy(), faces.numpy(), 0)
    return Geometry(Scene("s", [mesh], [Material("m", DiffuseModel(), one, one)]))


def test_closest_hits_agree_with_brute_force(backend):
    vertices, faces = soup(600)
    rays = Rays(4.0 * uniform(3000, 3) - 2.0, directions(3000))
    hit = make_tracer(backend, vertices, faces).closest(rays)
    brute = BruteForceTracer(vertices, faces)
    truth = brute.closest(rays)
    same = (hit.valid == truth.valid) & (hit.prim == truth.prim)
    assert same.float().mean() > 0.999  # float32 may decide otherwise at an edge
    assert 0.2 < truth.valid.float().mean() < 0.8
    both = same & truth.valid
    for name in ("t", "u", "v"):
        torch.testing.assert_close(getattr(hit, name)[both], getattr(truth, name)[both], rtol=1e-4, atol=1e-4)
    assert (hit.t.dtype, hit.prim.dtype, hit.valid.dtype) == (torch.float32, torch.int64, torch.bool)


def test_misses_are_dense_and_harmless_also_without_triangles_or_rays(backend):
    vertices, faces = tensors(ball(1))
    d = directions(64)
    hit = make_tracer(backend, vertices, faces).closest(Rays(3.0 * d, d))
    assert not hit.valid.any()
    assert torch.isinf(hit.t).all()
    assert (hit.prim == -1).all()
    assert (hit.u == 0).all()
    assert (hit.v == 0).all()

    rays = Rays(torch.zeros(5, 3), directions(5))
    for vertices in (torch.zeros(0, 3), torch.zeros(4, 3)):
        tracer = make_tracer(backend, vertices, torch.zeros(0, 3, dtype=torch.int64))
        assert not tracer.closest(rays).valid.any()
        assert not tracer.occluded(rays, torch.full((5,), torch.inf)).any()

    tracer = make_tracer(backend, *tensors(ball(0)))
    rays = Rays(torch.zeros(0, 3), torch.zeros(0, 3))
    assert len(tracer.closest(rays)) == 0
    assert tracer.occluded(rays, torch.zeros(0)).shape == (0,)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_closed_mesh_does_not_leak_at_edges_and_vertices(backend, scale):
    vertices, faces = tensors(ball(3), scale)
    corners = vertices[faces]
    weight = uniform(len(faces), 3, 1)
    edges = weight * corners + (1.0 - weight) * corners.roll(1, dims=1)
    targets = torch.cat((vertices, edges.reshape(-1, 3)))
    origins = 0.3 * scale * (uniform(len(targets), 3, seed=5) - 0.5)
    rays = Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1))
    tracer = make_tracer(backend, vertices, faces)
    hit = tracer.closest(rays)
    assert hit.valid.all()
    torch.testing.assert_close(hit.t, (targets - origins).norm(dim=-1), rtol=1e-4, atol=0.0)
    assert tracer.occluded(rays, torch.full_like(hit.t, torch.inf)).all()


def test_grazing_rays_agree_with_brute_force(backend):
    vertices, faces = tensors(trimesh.creation.box())  # top at z = 0.5
    n = 2000
    height = 0.5 + torch.where(uniform(n) > 0.5, 1.0, -1.0) * 10.0 ** (-2.0 - 3.0 * uniform(n, seed=2))
    angle = 6.28 * uniform(n, seed=4)
    d = torch.stack((angle.cos(), angle.sin(), torch.zeros(n)), -1)
    o = -3.0 * d
    o[:, 2] = height
    rays = Rays(o, d)
    hit, truth = make_tracer(backend, vertices, faces).closest(rays), BruteForceTracer(vertices, faces).closest(rays)
    assert (hit.valid == (height < 0.5)).all()
    torch.testing.assert_close(hit.t, truth.t, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_rays_that_start_on_a_triangle_hit_what_comes_next(backend, scale):
    layer = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    vertices = scale * torch.cat((layer, layer + torch.tensor([0.0, 0.0, 1.0])))
    tracer = make_tracer(backend, vertices, torch.tensor([[0, 1, 2], [3, 4, 5]]))
    o = scale * torch.tensor([[0.2, 0.3, 0.0], [0.2, 0.3, 0.0], [0.0, 0.0, 0.0], [0.2, 0.3, 1.0], [0.2, 0.3, 0.0]])
    d = torch.tensor([[0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, 1], [1, 0, 0]]).float()
    hit = tracer.closest(Rays(o, d))
    assert hit.prim.tolist() == [1, -1, 1, -1, -1]
    torch.testing.assert_close(hit.t, torch.where(hit.valid, scale, torch.inf), rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("offset", [1e3, 1e5])
def test_far_from_the_origin_agrees_with_brute_force(backend, offset):
    vertices, faces = tensors(ball(2), 1.0, (offset, -0.7 * offset, 0.3 * offset))
    centre = 0.5 * (vertices.amin(0) + vertices.amax(0))
    d = directions(2000)
    rays = Rays(centre + 3.0 * directions(2000, seed=7), d)
    rays = Rays(rays.o, torch.nn.functional.normalize(centre + 1.2 * d - rays.o, dim=-1))
    hit, truth = make_tracer(backend, vertices, faces).closest(rays), BruteForceTracer(vertices, faces).closest(rays)
    assert (hit.valid == truth.valid).float().mean() > 0.999
    same = hit.valid & truth.valid & (hit.prim == truth.prim)
    assert same.sum() > 0.99 * truth.valid.sum() > 500
    torch.testing.assert_close(hit.t[same], truth.t[same], rtol=1e-4, atol=1e-4)
    inside = make_tracer(backend, vertices, faces).closest(Rays(centre.expand_as(d), d))
    assert inside.valid.all()


def test_degenerate_triangles_are_never_hit(backend):
    good, index = soup(20)
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    flat = torch.tensor([[0, 0, 0], [0, 1, 1], [0, 1, 2]]) + len(good)
    vertices, faces = torch.cat((good, points)), torch.cat((index, flat))
    target = torch.cat((points.repeat(300, 1), 2.0 * uniform(900, 3) - 1.0))
    o = target + directions(1800)
    rays = Rays(o, torch.nn.functional.normalize(target - o, dim=-1))
    hit = make_tracer(backend, vertices, faces).closest(rays)
    assert (hit.prim < len(index)).all()
    only = make_tracer(backend, points, flat - len(good))
    assert not only.closest(rays).valid.any()
    assert not only.occluded(rays, torch.full((1800,), torch.inf)).any()


def test_occluded_agrees_with_closest_and_leaves_its_inputs_alone(backend):
    vertices, faces = soup(150)
    tracer = make_tracer(backend, vertices, faces)
    rays = Rays(4.0 * uniform(5000, 3) - 2.0, directions(5000))
    hit = tracer.closest(rays)
    assert torch.equal(tracer.occluded(rays, torch.full_like(hit.t, torch.inf)), hit.valid)
    reach = torch.where(hit.valid, hit.t, 1.0)
    t_max = 1.001 * reach
    for _ in range(2):
        assert torch.equal(tracer.occluded(rays, t_max)[hit.valid], hit.valid[hit.valid])
    assert torch.equal(t_max, 1.001 * reach)
    assert not tracer.occluded(rays, 0.999 * reach)[hit.valid].any()
    assert not tracer.occluded(rays, torch.zeros_like(hit.t)).any()
    assert not tracer.occluded(rays, torch.full_like(hit.t, torch.inf))[~hit.valid].any()


@pytest.mark.parametrize("count", [1, 2049, 40001])
def test_threads_do_not_change_the_answer(backend, count):
    vertices, faces = soup(200)
    rays, t_max = Rays(2.0 * uniform(count, 3) - 1.0, directions(count)), uniform(count)
    tracer, found = make_tracer(backend, vertices, faces), []
    for threads in (1, 3):
        with torch_threads(threads):
            found.append((tracer.closest(rays), tracer.occluded(rays, t_max)))
    (a, blocked), (b, again) = found
    for name in ("t", "prim", "u", "v", "valid"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert torch.equal(blocked, again)


def test_strided_float64_and_grad_inputs_are_accepted(backend):
    vertices, faces = tensors(ball(2))
    packed = torch.cat((0.2 * directions(500, seed=9), directions(500)), -1)
    strided = Rays(packed[:, :3].double(), packed[:, 3:].requires_grad_())
    plain = Rays(packed[:, :3].contiguous(), packed[:, 3:].detach().contiguous())
    wide = torch.stack((vertices, vertices), 1)[:, 0]
    tracer = make_tracer(backend, wide, faces.T.contiguous().T)
    a, b = tracer.closest(strided), make_tracer(backend, vertices, faces).closest(plain)
    assert torch.equal(a.t, b.t)
    assert torch.equal(a.prim, b.prim)
    assert not a.t.requires_grad
    t_max = torch.stack((b.t, b.t), -1)[:, 0] * 1.01
    assert tracer.occluded(strided, t_max).all()


@pytest.mark.parametrize(
    ("scale", "offset", "leaks"),
    # Where float32 resolves 1/100 of the size, rounding puts some points behind the neighbouring face of an edge.
    [(1e-3, 0.0, 0.0), (1.0, 0.0, 0.0), (1e5, 0.0, 0.0), (1.0, 1e3, 1e-4), (1.0, 1e5, 3e-3)],
)
@pytest.mark.parametrize("shape", ["ball", "box"])
def test_spawned_rays_leave_their_surface(backend, shape, scale, offset, leaks):
    mesh = ball() if shape == "ball" else trimesh.creation.box()
    mesh.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.5, 0.7))
    vertices, faces = tensors(mesh, scale, (offset, -0.7 * offset, 0.3 * offset))
    g = geometry(vertices, faces)
    tracer = make_tracer(backend, g.vertices, g.faces)
    n = 20000
    prim = torch.randint(len(faces), (n,), generator=torch.Generator().manual_seed(2))
    u, v = uniform_triangle(uniform(n, 2)).unbind(-1)
    wi = directions(n)
    si = g.interact_at(prim, u, v, wi, torch.ones(n, dtype=torch.bool))
    outside = (wi * si.ng).sum(-1) > 0
    hit = tracer.closest(g.spawn(si, wi))
    assert not (hit.prim == prim).any()
    assert (hit.valid & outside).sum() <= leaks * n
    assert (~hit.valid & ~outside).sum() <= leaks * n
    origin = g.spawn(si, wi).o
    assert (origin - si.p).norm(dim=-1).max() < max(1e-5 * scale, 4e-7 * offset)  # no more than float32 asks for


@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0.0), (1.0, 0.0), (1e5, 0.0), (1.0, 1e3)])
def test_shadow_rays_reach_the_light_and_see_what_is_between(backend, scale, offset):
    floor = [[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]  # normal +y
    light = [[-0.5, 1, -0.5], [0.5, 1, -0.5], [0.5, 1, 0.5], [-0.5, 1, 0.5]]  # normal -y
    block = [[-2, 0.5, -2], [2, 0.5, -2], [2, 0.5, 2], [-2, 0.5, 2]]
    turn = trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)[:3, :3].T
    corners = np.array(floor + light + block) @ turn * scale + np.array([offset, -0.7 * offset, 0.3 * offset])
    vertices = torch.tensor(corners, dtype=torch.float32)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [8, 9, 10], [8, 10, 11]])
    n = 4000
    prim = torch.randint(2, (n,), generator=torch.Generator().manual_seed(2))
    u, v = uniform_triangle(uniform(2 * n, 2)).reshape(n, 2, 2).unbind(-1)
    for count, blocked in ((4, False), (6, True)):
        g = geometry(vertices, faces[:count])
        valid = torch.ones(n, dtype=torch.bool)
        si = g.interact_at(prim, u[:, 0], v[:, 0], torch.zeros(n, 3), valid)
        there = g.interact_at(prim + 2, u[:, 1], v[:, 1], torch.zeros(n, 3), valid)
        distance = (there.p - si.p).norm(dim=-1)
        rays, t_max = g.spawn_towards(si, (there.p - si.p) / distance[:, None], distance)
        occluded = make_tracer(backend, g.vertices, g.faces).occluded(rays, t_max)
        assert (occluded == blocked).all()
        assert (t_max > 0.99 * distance).all()


def test_missing_warp_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "warp", None)
    with pytest.raises(InputError, match=r"neurad\[gpu\].*embree"):
        make_tracer("warp", *tensors(ball(0)))


def test_rays_are_counted_unless_paused():
    vertices, faces = tensors(ball(0))
    tracer = CountingTracer(make_tracer("embree", vertices, faces))
    plain = make_tracer("embree", vertices, faces)
    d = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    rays = Rays(3.0 * d, -d)
    far = torch.full((50,), torch.inf)
    assert torch.equal(tracer.closest(rays).t, plain.closest(rays).t)
    assert torch.equal(tracer.occluded(rays[:20], far[:20]), plain.occluded(rays[:20], far[:20]))
    assert tracer.rays_cast == 70
    with tracer.uncounted():
        tracer.closest(rays)
        with tracer.uncounted(False):  # a block inside does not switch it on again
            tracer.occluded(rays, far)
    with tracer.uncounted(False):
        tracer.closest(rays[:3])
    with pytest.raises(TypeError), tracer.uncounted():  # an error ends the block like its end
        tracer.closest(None)
    assert tracer.rays_cast == 73
    tracer.closest(rays)
    assert tracer.rays_cast == 123
