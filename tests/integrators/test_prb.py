"""Path replay: the same values and derivatives as autograd through all bounces, in memory that does not grow."""

from dataclasses import replace

import pytest
import torch
from helpers.method_oracles import Textures, camera_vertices, gallery
from helpers.random_vertices import uneven_guide

from neurad.assembly.build import build_world
from neurad.assembly.fitted_materials import build_materials
from neurad.core.parameters import RECOVERED
from neurad.core.rng import Stream
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB, GradientSum, merge
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.geometry import Geometry

GRID = GridConfig(levels=4, coarsest=4, finest=64, log2_size=12)


@pytest.fixture(scope="module")
def world():
    return build_world(gallery())


def networks():
    torch.manual_seed(2)
    made = build_materials(
        gallery(), dict.fromkeys(RECOVERED, FieldConfig(GRID, 32)), Geometry(gallery()), known_emitters=False
    )
    with torch.no_grad():  # far from the even start, so that every parameter matters
        for p in made.parameters():
            p.add_(0.3 * torch.randn(p.shape))
    return made


class Mixed(Textures):
    """Textures of surfaces whose diffuse lobe is being found."""

    def __init__(self):
        super().__init__()
        self.part = torch.nn.Parameter(torch.full((1, 1), 0.3))

    def forward(self, si):
        surface = super().forward(si)
        return replace(surface, lambert=self.part.expand(len(surface), 1))


def gradients(method, world, materials, n, stream, probe=3):
    """Values [n, 3] (the estimate, and with control the incident light and the deviation) and dense gradients of random
    projections of estimate and deviation, each alone and then both."""
    si = camera_vertices(world, n, 1)
    u = Stream(5).uniform(n, DIMENSIONS)
    sample = method.reflected(SceneModel(world, materials), si, materials(si), u, stream)
    parameters = list(materials.parameters())
    scalars = [(sample.value * Stream(probe).uniform(n, 3)).sum()]
    values = [sample.value]
    if sample.sample_stats is not None:
        assert sample.Li_bsdf is not None
        assert not sample.Li_bsdf.requires_grad
        scalars.append((sample.Li_bsdf * sample.sample_stats.deviation * Stream(probe, 1).uniform(n, 3)).sum())
        scalars.append(scalars[0] - 2.0 * scalars[1])
        values += [sample.Li_bsdf, sample.sample_stats.deviation]
    found = [g for scalar in scalars for g in torch.autograd.grad(scalar, parameters, retain_graph=True)]
    return [value.detach() for value in values], [g.to_dense() for g in found]


def same_stream(seed):
    """The streams with which path and replay draw the same numbers."""
    return Stream(int(Stream(seed).integers(1 << 62, 1))), Stream(seed)


def test_replay_equals_autograd_with_a_guide():
    """Guided directions are drawn again as they were, whatever the guide prefers."""
    world, materials = build_world(gallery()), networks()
    world.guide = uneven_guide(world)
    found = []
    for method, stream in zip((PathTracing(16, 3), PRB(16, 3)), same_stream(9), strict=True):
        found.append(gradients(method, world, materials, 3000, stream))
    world.guide = None
    plain = gradients(PathTracing(16, 3), world, materials, 3000, same_stream(9)[0])
    assert (plain[0][0] - found[0][0][0]).norm() > 1e-2 * plain[0][0].norm()
    for one, other in zip(*found, strict=True):
        for e, f in zip(one, other, strict=True):
            assert (f - e).norm() <= 1e-4 * e.norm()


@pytest.mark.parametrize("make", [Textures, networks, Mixed])
@pytest.mark.parametrize(
    ("max_depth", "control"), [(2, False), (2, True), (3, True), (16, False), (16, True), (None, True)]
)
def test_replay_equals_autograd_on_one_random_stream(world, make, max_depth, control):
    materials = make()
    one, other = same_stream(9)
    values, expected = gradients(PathTracing(max_depth, 3, control_variate=control), world, materials, 3000, one)
    again, found = gradients(PRB(max_depth, 3, control_variate=control), world, materials, 3000, other)
    assert len(values) == (3 if control else 1)
    for index, (e, f) in enumerate(zip(values, again, strict=True)):
        assert e.abs().max() > 0 or (index == 1 and max_depth == 2)  # no light arrives along paths of one bounce
        assert (f - e).norm() <= 1e-4 * e.norm()
    for e, f in zip(expected, found, strict=True):
        if max_depth == 2 and e.norm() == 0:  # the deviation times that light
            assert control
            assert f.norm() == 0
            continue
        assert e.norm() > 0
        assert (f - e).norm() <= 1e-4 * e.norm()


def test_pictures_need_no_replay(world):
    """``neurad predict`` runs in inference mode, where nothing can be kept for a backward pass."""
    materials, si, u = networks(), camera_vertices(world, 500, 1), Stream(5).uniform(500, DIMENSIONS)
    with torch.inference_mode():
        value = PRB(5, 3).reflected(SceneModel(world, materials), si, materials(si), u, Stream(7)).value
    assert torch.isfinite(value).all()
    assert value.max() > 0


def test_another_stream_would_not_pass(world):
    materials = Textures()
    values, expected = gradients(PathTracing(16, 3), world, materials, 3000, Stream(9))
    again, found = gradients(PRB(16, 3), world, materials, 3000, Stream(9))
    assert all((f - e).norm() > 1e-2 * e.norm() for e, f in zip(values[:2], again[:2], strict=True))
    assert all((f - e).norm() > 1e-2 * e.norm() for e, f in zip(expected, found, strict=True))


def peak_bytes(method, world, materials, n):
    """Most bytes that a forward and backward pass has allocated at a time."""
    si = camera_vertices(world, n, 1)
    u = Stream(5).uniform(n, DIMENSIONS)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        sample = method.reflected(SceneModel(world, materials), si, materials(si), u, Stream(7))
        total = sample.value.sum() - (sample.Li_bsdf * sample.sample_stats.deviation).sum()
        found = torch.autograd.grad(total, list(materials.parameters()))
    assert all(torch.isfinite(g.to_dense()).all() for g in found)
    events = [e for e in profile.profiler.kineto_results.events() if e.name() == "[memory]"]
    now, peak = 0, 0
    for event in sorted(events, key=lambda e: e.start_ns()):
        now += event.nbytes()
        peak = max(peak, now)
    return peak


def test_memory_does_not_grow_with_the_length_of_paths(world):
    materials = networks()
    never = 1000  # no roulette: paths have the full length, but for those that the lobe samples below the surface
    size = {bounces: peak_bytes(PRB(bounces + 1, never), world, materials, 8000) for bounces in (2, 32)}
    grown = {bounces: peak_bytes(PathTracing(bounces + 1, never), world, materials, 8000) for bounces in (2, 16)}
    assert size[32] <= 1.1 * size[2]
    assert grown[16] > 2 * grown[2]


@pytest.mark.parametrize("shape", [(50, 2), (50, 2, 2)])
def test_sum_of_sparse_gradients(shape):
    """Equals the dense sum and never keeps more than three times the rows there are."""
    total, expected = GradientSum(), torch.zeros(shape)
    for index in range(40):
        rows = Stream(index).integers(shape[0], 1, 30)
        piece = torch.sparse_coo_tensor(rows, torch.randn(30, *shape[1:]), shape)
        expected += piece.to_dense()
        total.add(piece)
        total.add(None)
        assert sum(kept._nnz() for kept in total.pieces) <= 3 * shape[0]
    torch.testing.assert_close(total.value.to_dense(), expected)
    assert total.value._nnz() <= shape[0]
    total.add(torch.ones(shape))
    torch.testing.assert_close(total.value.to_dense(), expected + 1.0)
    assert GradientSum().value is None
    rows = merge([torch.sparse_coo_tensor([[3, 1, 3]], torch.ones(3, 2), (5, 2))])._indices()[0]
    assert rows.tolist() == [1, 3]
