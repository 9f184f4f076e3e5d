"""The compiled bounces at diffuse and principled surfaces give the numbers and derivatives of their reference twin; and
two sets of materials along the same paths."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import pytest
import torch
from helpers.delta_scenes import delta_gallery, window_room
from helpers.object_scene import object_scene, sky
from helpers.oracles import accept, z_test_samples
from helpers.random_vertices import one_sided, random_vertices, uneven_guide
from helpers.torch_threads import torch_threads

from benchmarks.stress.fit import glossy
from neurad.assembly.build import build_world
from neurad.bsdf.directional import directional_albedo, mean_lobes
from neurad.core.camera import camera_rays
from neurad.core.records import Surface
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream
from neurad.integrators import vertex_diffuse, vertex_principled
from neurad.integrators.bounce import bounce
from neurad.integrators.correlated import CorrelatedBSDF, CorrelatedPaths
from neurad.integrators.renderer import path_tracer
from neurad.integrators.stratified import stratified_samples
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build, build_cornell, build_furnace
from neurad.scene.textures import TrueMaterials

N = 4000


def random_surface(n, seed, metal=False):
    stream = Stream(seed)
    albedo, roughness = stream.uniform(n, 3), 0.05 + 0.95 * stream.uniform(n, 1)
    metallic = (2.0 * stream.uniform(n, 1) - 0.5).clamp(0.0, 1.0).requires_grad_(True) if metal else None
    return Surface(albedo.requires_grad_(True), roughness.requires_grad_(True), metallic=metallic)


@pytest.mark.parametrize("name", ["patterns", "cornell"])
def test_threads_share_a_bounce_and_change_nothing(name):
    """Three threads, where each has its own part of the rays, give what one gives."""
    world = build_world(build(name))
    world.guide = uneven_guide(world) if name == "patterns" else None

    def found(count):
        with torch_threads(count):
            si, u = random_vertices(world, 5 * N, 3), stratified_samples(5 * N // 2, 2, Stream(4))
            surface = random_surface(5 * N, 5, metal=name == "patterns")
            before = world.tracer.rays_cast
            step = bounce(world, si, surface, u, sample_stats=True)
            stats = [] if step.sample_stats is None else list(vars(step.sample_stats).values())
            (step.direct * step.weight + sum(x.sum() for x in stats[:1])).sum().backward()
        grads = [x.grad for x in surface.parameters.values() if x.grad is not None]
        end = step.next
        assert (len(stats) > 0) == (name == "patterns")
        kept = [si.p, si.n, u, step.direct, step.weight, end.p, end.wo, end.prim, world.lights.eval(end)]
        return world.tracer.rays_cast - before, [*kept, *stats, *grads]

    (rays, one), (again, shared) = found(1), found(3)
    assert rays == again > 5 * N
    assert all(torch.equal(a, b) for a, b in zip(one, shared, strict=True))


PRINCIPLED = {
    "patterns": lambda: build("patterns"),
    "glossy cornell": lambda: glossy(build_cornell()),
    "one-sided": lambda: one_sided(glossy(build_cornell())),
}
DIFFUSE = {name: partial(build, name) for name in ("cornell", "cube", "sphere", "furnace")}
DIFFUSE |= {f"{name}, one-sided": lambda make=make: one_sided(make()) for name, make in DIFFUSE.items()}
SMOOTH = {"mirrors and glass": delta_gallery, "lamp behind a pane": lambda: window_room(True)}
SWITCHES = list(product((False, True), repeat=3))


@pytest.mark.parametrize(
    ("scene", "control", "guided", "metal"),
    [
        *((scene, *on) for scene in PRINCIPLED for on in SWITCHES),
        *((scene, True, False, False) for scene in DIFFUSE | SMOOTH),
    ],
)
def test_the_compiled_bounce_is_the_plain_one(scene, control, guided, metal):
    kind = vertex_diffuse if scene in DIFFUSE else vertex_principled
    room = (DIFFUSE | PRINCIPLED | SMOOTH)[scene]()
    if scene in SMOOTH:
        kinds = [replace(m, model=PrincipledModel()) if m.model.is_diffuse else m for m in room.materials]
        room = replace(room, materials=kinds)
    world = build_world(room)
    assert (world.delta is not None) == (scene in SMOOTH)
    world.guide = uneven_guide(world) if guided else None
    si = random_vertices(world, N, 3)
    assert not si.valid.all()
    surface, u = random_surface(N, 5, metal), Stream(4).uniform(N, DIMENSIONS)
    assert kind.has_kernel(True, world, si, *([surface] if kind is vertex_principled else []))
    free = [surface.albedo] if kind is vertex_diffuse else list(surface.parameters.values())
    scale = float(bounce(world, si, surface, u, use_kernels=False).direct.detach().mean()) * 100
    assert scale > 0
    found = []
    for use_kernels in (True, False):
        before = world.tracer.rays_cast
        step = bounce(world, si, surface, u, sample_stats=control, use_kernels=use_kernels)
        total = step.direct.square().sum() / scale + (step.weight * torch.linspace(0.1, 1, 3)).sum()
        assert (step.sample_stats is not None) == (control and scene not in DIFFUSE)  # whose weights do not deviate
        if step.sample_stats is not None:
            total = total + 0.7 * step.sample_stats.deviation.square().sum()
        grads = torch.autograd.grad(total, free)
        found.append((step, grads, world.tracer.rays_cast - before))
    (kernel, kernel_grads, kernel_rays), (reference, grads, rays) = found
    same = (kernel.next.prim == reference.next.prim) & (kernel.next.valid == reference.next.valid)
    assert float((~same).float().mean()) < 2e-3  # rounding at an edge
    pairs = [(kernel.direct, reference.direct, scale), (kernel.weight, reference.weight, 1.0)]
    pairs += [(a, b, 1.0 + b.abs()) for a, b in zip(kernel_grads, grads, strict=True)]
    if kernel.sample_stats is not None:
        pairs += [
            (getattr(kernel.sample_stats, k), getattr(reference.sample_stats, k), 1.0)
            for k in ("deviation", "relative", "wi")
        ]
    for a, b, unit in pairs:
        assert a.shape == b.shape
        assert bool(a.isfinite().all())
        assert float(b.detach().abs().max()) > 0
        off = (a.detach() - b.detach()).abs() > 5e-4 * unit * (1.0 if torch.is_tensor(unit) else 1.0 + b.detach().abs())
        assert float(off.any(-1)[same].float().mean()) < 3e-3
    for key in ("p", "n", "ng", "wo"):
        torch.testing.assert_close(
            getattr(kernel.next, key)[same], getattr(reference.next, key)[same], rtol=1e-3, atol=1e-3
        )
    assert abs(rays - kernel_rays) <= 0.01 * N
    for values in (kernel.direct, kernel.weight, reference.direct, reference.weight):
        assert not values[~si.valid].any()
    assert kernel_grads[0][~si.valid].abs().max() == 0


def test_derivatives_are_those_of_known_parts_alone():
    world = build_world(glossy(build_cornell()))
    si, u = random_vertices(world, 100, 1), Stream(2).uniform(100, DIMENSIONS)
    free = random_surface(100, 3)
    for albedo, roughness in ((True, False), (False, True), (False, False)):
        surface = Surface(
            free.albedo.detach().requires_grad_(albedo), free.roughness.detach().requires_grad_(roughness)
        )
        step = bounce(world, si, surface, u)
        assert step.weight.requires_grad == (albedo or roughness)
        if albedo or roughness:
            step.weight.sum().backward()
            assert (surface.albedo.grad is not None, surface.roughness.grad is not None) == (albedo, roughness)
    with torch.no_grad():
        assert not bounce(world, si, free, u).weight.requires_grad


def test_the_compiled_mean_is_the_plain_one():
    stream = Stream(7)
    roughness, cosine = stream.uniform(5000, 1), stream.uniform(5000)
    roughness[:3, 0], cosine[:3] = torch.tensor([0.0, 1.0, 0.5]), torch.tensor([1.0, 0.0, 1.0])
    broken = torch.full((1, 1), torch.nan)
    surface = Surface(torch.ones(5000, 3), roughness)
    metal = replace(surface, metallic=stream.uniform(5000, 1))
    # Nothing is read beyond the table.
    assert bool(mean_lobes(Surface(broken.expand(1, 3), broken), broken[0], 1.5).isfinite().all())
    both = replace(metal, lambert=torch.full((5000, 1), 0.3))
    for lanes in (surface, metal, replace(both, metallic=None), both):
        compiled, plain = (mean_lobes(lanes, cosine, 1.5, use_kernels=use) for use in (True, False))
        torch.testing.assert_close(compiled, plain, rtol=1e-5, atol=1e-5)
    d = mean_lobes(surface, cosine, 1.5)[0]
    value = directional_albedo(surface, cosine, 1.5)
    assert bool((value[:, 0] >= d).all())
    assert 0.8 < float(d.mean()) < 1.2
    found = [mean_lobes(replace(both, lambert=torch.full((5000, 1), part)), cosine, 1.5) for part in (0.0, 0.3, 1.0)]
    torch.testing.assert_close(found[1][4:6], (found[2] - found[0])[:2])  # linear in the part of Lambert's lobe
    torch.testing.assert_close(found[1][:4], torch.lerp(found[0], found[2], 0.3)[:4])


@pytest.mark.parametrize("guided", [False, True])
def test_lanes_with_their_own_fraction_of_the_specular_lobe(guided):
    """The compiled bounce is the plain one, and the mean is that of any other fraction: a z-test at 99 %."""
    world = build_world(glossy(build_cornell()))
    world.guide = uneven_guide(world) if guided else None
    si, surface, u = random_vertices(world, N, 3), random_surface(N, 5).detach(), Stream(4).uniform(N, DIMENSIONS)
    own = replace(surface, specular_fraction=0.05 + 0.9 * Stream(6).uniform(N, 1))
    fast, plain = (bounce(world, si, own, u, guided=True, use_kernels=kernels) for kernels in (True, False))
    same = (fast.next.prim == plain.next.prim).float().mean()
    assert same > 0.999
    for name in ("direct", "weight"):
        off = ((getattr(fast, name) - getattr(plain, name)).abs() > 1e-3 * (1.0 + getattr(plain, name).abs())).any(-1)
        assert float(off.float().mean()) < 1e-3

    def means(surface):
        rows = []
        for k in range(60):
            step = bounce(world, si, surface, Stream(7, k).uniform(N, DIMENSIONS), guided=True)
            rows.append((step.direct + step.weight * 0.3)[si.valid].clamp_max(50.0).mean())
        return torch.stack(rows).double()

    assert accept([float(z_test_samples(means(own), means(surface)))])


# ---- two sets of materials: each as path tracing shows it alone, the difference nearly exact


SCENES = {
    "diffuse": build_cornell,
    "glossy": lambda: glossy(build_cornell()),
    "one-sided": lambda: one_sided(glossy(build_cornell())),
    "mirrors and glass": delta_gallery,
    "environment": lambda: object_scene(sky()),
}


@dataclass(frozen=True)
class Changed:
    materials: TrueMaterials
    albedo_factor: float
    roughness_factor: float

    def __call__(self, si):
        surface = self.materials(si)
        return replace(
            surface,
            albedo=surface.albedo * self.albedo_factor,
            roughness=(surface.roughness * self.roughness_factor).clamp(0.05, 1.0),
        )

    def albedo(self, si):
        return self(si).albedo


def seen(scene):
    """World, true materials and rays of a camera."""
    world, camera = build_world(scene), scene.train[0].camera
    pixels = Stream(3).uniform(N, 2) * torch.tensor([camera.width, camera.height])
    return world, TrueMaterials(scene, world.geometry), camera_rays(camera, pixels)


@pytest.fixture(params=list(SCENES))
def room(request):
    scene = replace(SCENES[request.param](), max_depth=7, rr_depth=3)
    return scene, *seen(scene)


@pytest.mark.usefixtures("three_threads")
def test_the_same_materials_twice_are_path_tracing_twice(room):
    scene, world, truth, rays = room
    first, second = CorrelatedPaths(world, truth, truth, scene.max_depth, scene.rr_depth)(rays, 7).split(3, -1)
    alone = path_tracer(world, truth, scene.max_depth, scene.rr_depth)(rays, 7)
    assert float(alone.mean()) > 0
    assert torch.equal(first, alone)
    torch.testing.assert_close(second, first, rtol=1e-3, atol=1e-5)


def test_others_look_as_path_tracing_shows_them_alone(room):
    """Means over 40 passes of 4000 samples, by channel: a z-test at 99 %."""
    scene, world, truth, rays = room
    others = Changed(truth, 0.8, 1.5)
    pair = CorrelatedPaths(world, truth, others, scene.max_depth, scene.rr_depth)
    alone = path_tracer(world, others, scene.max_depth, scene.rr_depth)
    found = [
        torch.stack([x(rays, k).mean(0) for k in seeds]) for x, seeds in ((pair, range(40)), (alone, range(50, 90)))
    ]
    assert accept(z_test_samples(found[0][:, 3:], found[1]))
    assert not accept(z_test_samples(found[0][:, :3], found[1]))  # the change is seen


def test_a_furnace_of_another_albedo_has_its_closed_form():
    """Emission over 1 - 0.6 along paths of albedo 0.5: a z-test at 99 %."""
    world, truth, rays = seen(build_furnace(0.5, 1.0))
    pair = CorrelatedPaths(world, truth, Changed(truth, 1.2, 1.0), None, 4)
    found = torch.stack([pair(rays, k).mean(0) for k in range(30)])
    assert accept(z_test_samples(found, np.repeat([1.0 / (1.0 - 0.5), 1.0 / (1.0 - 0.6)], 3)))


def test_a_small_change_is_known_far_better_than_by_the_same_numbers():
    """Each sample's change has a hundredth of the variance that it has between two path tracers of one seed."""
    scene = replace(glossy(build_cornell()), max_depth=12, rr_depth=3)
    world, truth, rays = seen(scene)
    others = Changed(truth, 1.01, 1.01)
    pair = CorrelatedPaths(world, truth, others, scene.max_depth, scene.rr_depth)(rays, 1)
    one, two = (path_tracer(world, m, scene.max_depth, scene.rr_depth)(rays, 1) for m in (truth, others))
    assert float((pair[:, 3:] - pair[:, :3]).var()) < 0.01 * float((two - one).var())


@pytest.mark.parametrize(
    "scene", [glossy(build_cornell()), one_sided(glossy(build_cornell()))], ids=["glossy", "sided"]
)
def test_the_compiled_bounce_of_other_materials_is_the_plain_one(scene):
    world, stream = build_world(scene), Stream(5)
    si, u = random_vertices(world, N, 3), Stream(4).uniform(N, DIMENSIONS)
    drawn, surface = (Surface(stream.uniform(N, 3), 0.05 + 0.95 * stream.uniform(N, 1)) for _ in range(2))
    drawn = replace(drawn, specular_fraction=0.1 + 0.8 * stream.uniform(N, 1))
    along = world.reflecting_by(CorrelatedBSDF(world.bsdf, drawn))
    fast, plain = (bounce(along, si, surface, u, use_kernels=kernels) for kernels in (True, False))
    own = bounce(world, si, drawn, u)
    assert float((fast.next.prim == plain.next.prim).float().mean()) > 0.998
    assert torch.equal(fast.next.prim, own.next.prim)
    assert float(plain.direct.mean()) > 0
    for name in ("direct", "weight"):
        a, b = getattr(fast, name), getattr(plain, name)
        assert float(((a - b).abs() > 1e-3 * (1.0 + b.abs())).any(-1).float().mean()) < 2e-3
