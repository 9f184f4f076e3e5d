import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.random_vertices import random_vertices
from helpers.torch_threads import torch_threads
from scipy.interpolate import RegularGridInterpolator

from neurad.assembly.build import build_world
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.records import SurfaceInteraction
from neurad.core.scene_records import Mesh
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.hash_grid import HashGrid, keys_of
from neurad.fields.material import MaterialField
from neurad.fields.mlp import MLP
from neurad.fields.outputs import START
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import AlbedoConfig, FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.fields.unit_cube import UnitCube
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.runtime.threads import at_most, threads, torch_on_one
from neurad.scene.builtin import build
from neurad.scene.geometry import Geometry
from neurad.scene.parts import SurfaceParts, segments
from neurad.scene.textures import KnownSurfaces

BOUNDS = torch.tensor([[-1.0, 0.0, -3.0], [1.0, 0.5, 5.0]])
SMALL = GridConfig(levels=4, coarsest=2, finest=64, log2_size=10)
SIZES = [
    dict(levels=6, coarsest=2, finest=64, log2_size=10),  # dense and hashed levels
    dict(levels=1, coarsest=9, finest=9, log2_size=10),  # 10^3 vertices fit: dense
    dict(levels=1, coarsest=10, finest=10, log2_size=10),  # 11^3 do not: hashed
    dict(levels=2, coarsest=64, finest=65536, log2_size=3),  # eight entries: everything collides
    dict(levels=2, coarsest=128, finest=300, log2_size=18),  # larger than the cache: points looked ahead
]


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(7)


def points(n):
    x = torch.rand(n, 3)
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    return torch.cat((x, corners, torch.full((1, 3), 0.5)))


def surface(n, spread=1.0):
    unit = lambda: torch.nn.functional.normalize(torch.randn(n, 3), dim=-1)  # noqa: E731
    p = BOUNDS[0] + (BOUNDS[1] - BOUNDS[0]) * (0.5 + spread * (torch.rand(n, 3) - 0.5))
    index = torch.zeros(n, dtype=torch.int64)
    return SurfaceInteraction(p, unit(), unit(), unit(), torch.rand(n, 2), torch.rand(n, 2), index, index == 0)


# ---- grids, hashed and dense


def filled(grid):
    with torch.no_grad():
        grid.table.normal_()
    return grid


def hash_grid(size, **options):
    return filled(HashGrid(**size, **options))


@pytest.mark.parametrize(("size", "keys"), [*((size, 0) for size in SIZES), (SIZES[0], 1 << 20), (SIZES[4], 7)])
def test_compiled_grid_equals_plain_torch(size, keys):
    """Values and gradients; the sparse gradient names each touched row once."""
    grid, x = hash_grid(size), points(2000)
    on = (keys_of(keys)[torch.randint(keys, (len(x),))],) if keys else ()
    kernel, reference = grid(x, *on), grid.reference(x, *on)
    torch.testing.assert_close(kernel, reference, rtol=1e-6, atol=1e-6)
    cotangent = torch.randn_like(kernel)
    (sparse,) = torch.autograd.grad(kernel, grid.table, cotangent)
    (dense,) = torch.autograd.grad(reference, grid.table, cotangent)
    assert sparse.is_sparse
    assert (sparse.to_dense() - dense).norm() < 1e-5 * dense.norm()
    torch.testing.assert_close(sparse.to_dense(), dense, rtol=1e-5, atol=1e-5 * float(dense.abs().max()))
    rows = sparse._indices()[0]
    assert (rows[1:] > rows[:-1]).all()
    assert set(dense.abs().sum(1).nonzero().flatten().tolist()) <= set(rows.tolist())


@pytest.mark.parametrize(("size", "channels"), [(2, 1), (9, 3), (40, 3), (33, 5)])
def test_dense_grid_interpolates(size, channels):
    """As scipy does; a sparse gradient is the dense one."""
    grid, x = filled(DenseGrid(size, channels)), points(2000)
    ends = torch.linspace(0.0, 1.0, size, dtype=torch.float64).numpy()
    values = grid.table.detach().double().view(size, size, size, channels).numpy()  # by z, y, x
    expected = RegularGridInterpolator([ends] * 3, values)(x.double().flip(-1).numpy())
    torch.testing.assert_close(grid(x).double(), torch.from_numpy(expected), rtol=1e-5, atol=1e-4)
    cotangent, gradients = torch.randn(len(x), channels), []
    for grid.sparse in (True, False):
        gradients += torch.autograd.grad(grid(x), grid.table, cotangent)
    assert gradients[0].is_sparse
    assert not gradients[1].is_sparse
    torch.testing.assert_close(gradients[0].to_dense(), gradients[1], rtol=1e-5, atol=1e-5)


def test_surfaces_of_other_keys_share_no_entry_of_a_hashed_level():
    """At one place; a dense level is theirs together."""
    dense, hashed = (HashGrid(1, 12, 12, log2_size=size) for size in (14, 9))
    x, keys = (torch.rand(1, 3)).expand(64, 3), keys_of(64)

    def entries(grid):
        """Those that each of the surfaces reads."""
        rows = [torch.autograd.grad(grid(x[:1], key[None]).sum(), grid.table)[0] for key in keys]
        return [set(row.coalesce().indices()[0].tolist()) for row in rows]

    assert len({frozenset(rows) for rows in entries(dense)}) == 1
    rows = entries(hashed)
    shared = [len(a & b) for i, a in enumerate(rows) for b in rows[:i]]
    assert sum(shared) / len(shared) < 2 * 8 * 8 / 512  # twice what chance makes of eight corners each
    assert keys_of(1 << 20).unique().shape == (1 << 20,)


def test_gradient_names_no_row_that_is_not_touched():
    grid = hash_grid(SIZES[0])
    grid(points(50)).sum().backward()
    assert grid.table.grad._nnz() < len(grid.table)


@pytest.mark.parametrize("grid", [HashGrid(1, 8, 8, log2_size=10), DenseGrid(9, 2)], ids=["hash", "dense"])
def test_trilinear_reproduces_a_linear_function(grid):
    z, y, x = torch.meshgrid(*[torch.arange(9.0) / 8] * 3, indexing="ij")
    with torch.no_grad():
        grid.table.copy_(torch.stack((2 * x - y + 3 * z, x), -1).view(-1, 2))
        p = points(300)
        expected = torch.stack((2 * p[:, 0] - p[:, 1] + 3 * p[:, 2], p[:, 0]), -1)
        for read in (grid, getattr(grid, "reference", grid)):
            torch.testing.assert_close(read(p), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("wall", [False, True])
@pytest.mark.parametrize("make", [lambda: HashGrid(**SIZES[0]), lambda: HashGrid(**SIZES[4]), lambda: DenseGrid(33, 5)])
def test_results_are_the_same_bit_by_bit_for_any_number_of_threads(make, wall):
    grid, x = filled(make()), points(5000)
    if wall:  # all in one layer of cells: ranges are empty
        x[:, 2] = 0.5
        x[7] = float("nan")
    results = []
    for count in (1, 1, 2, 2, 3):
        with torch_threads(count):
            out = grid(x)
            (gradient,) = torch.autograd.grad(out.nan_to_num().square().sum(), grid.table)
            results.append((out.detach(), gradient._indices(), gradient._values()))
    for result in results[1:]:
        for a, b in zip(result, results[0], strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("make", [lambda: HashGrid(**SIZES[0]), lambda: DenseGrid(9, 3)])
def test_no_points_odd_points_and_points_with_gradient(make):
    grid = filled(make())
    out = grid(torch.empty(0, 3))
    out.sum().backward()
    assert out.shape == (0, grid.channels)
    assert grid.table.grad._nnz() == 0
    x = torch.tensor([[float("nan"), 0.5, 2.0], [-3.0, float("inf"), 0.1], [0.2, 0.3, 0.4]])
    torch.testing.assert_close(grid(x)[2:], getattr(grid, "reference", grid)(x[2:]), rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="detach"):
        grid(torch.rand(2, 3, requires_grad=True))
    assert HashGrid(3, 2, 8, log2_size=10)(points(5)).shape == (14, 6)


def test_table_takes_what_its_levels_need():
    assert len(HashGrid(1, 9, 9, log2_size=10).table) == 1000
    assert len(HashGrid(1, 10, 10, log2_size=10).table) == 1024
    paper = HashGrid(16, 2, 1 << 16)
    assert paper.level_table[0, 0] == 2
    assert paper.level_table[-1, 0] == 1 << 16
    assert paper.channels == 32
    assert paper.table.abs().max() <= 1e-4


@pytest.mark.usefixtures("three_threads")
def test_longest_side_fills_the_unit_cube():
    x = UnitCube(BOUNDS)(BOUNDS)
    assert x.min() > 0.0
    assert x.max() < 1.0
    side = x[1] - x[0]
    torch.testing.assert_close(side / side[2], torch.tensor([0.25, 0.0625, 1.0]))
    assert side[2] > 0.97
    p = torch.cat((20 * torch.rand(40000, 3) - 10, torch.tensor([[math.nan, math.inf, -math.inf]])))
    cube = UnitCube(BOUNDS)
    torch.testing.assert_close(cube(p), cube.reference(p), rtol=0, atol=0, equal_nan=True)
    flat = UnitCube(torch.zeros(2, 3))(torch.zeros(1, 3))
    assert flat.isfinite().all()


# ---- network


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_networks_give_the_same_on_several_threads(mode):
    """Each thread has its own mode: what one computes may be written nowhere in another."""
    mlp, x = MLP(11, 3, 32, 2), torch.rand(5000, 11)
    with mode(), at_most(1):
        one = mlp(x)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with mode(), torch_on_one():
            assert torch.get_num_threads() == 1
            assert threads(3, 1) == 3
            assert torch.equal(mlp(x), one)
            with at_most(2):
                assert threads(3, 1) == 2
        assert torch.get_num_threads() == threads(3, 1) == 3
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("parameter", [ALBEDO, ROUGHNESS])
def test_a_field_with_known_surfaces_is_the_same_in_one_operation(parameter):
    scene = build("kitchen")
    world = build_world(scene)
    corners = world.geometry.vertices
    config = RoughnessConfig(SMALL, reads_albedo=True) if parameter == ROUGHNESS else FieldConfig(SMALL)
    field = MaterialField(parameter, config, torch.stack((corners.amin(0), corners.amax(0))))
    field.known = KnownSurfaces(scene, parameter, world.geometry)
    si, albedo = random_vertices(world, 3000, 3), torch.rand(3000, 3)
    known = field.known.known[si.prim.clamp_min(0)] & si.valid
    assert 0 < int(known.sum()) < 3000
    with torch.no_grad():
        field.grid.table.normal_(std=0.5)
    cotangent, found = torch.randn(3000, parameter.channels), []
    for use_kernels in (True, False):
        field.grid.use_kernels = field.mlp.use_kernels = use_kernels
        values = field(si, albedo)
        with torch.no_grad():
            torch.testing.assert_close(field(si, albedo), values)
        found.append((values, *torch.autograd.grad(values, list(field.parameters()), cotangent)))
    for one, other in zip(*found, strict=True):
        one, other = one.to_dense(), other.to_dense()
        assert (one - other).norm() <= 1e-5 * other.norm()


# ---- fields of dense grids


def test_radiance_is_the_same_in_all_directions():
    si = surface(200)
    field = RadianceField(RadianceConfig(GridConfig(finest=15), kind="dense"), BOUNDS)
    assert len(field.grid.table) == 16**3
    with torch.no_grad():
        field.grid.table.normal_()
    other = replace(si, wo=-si.wo, n=si.wo)
    assert torch.equal(field(si, torch.rand(200, 3)), field(other, torch.rand(200, 3)))


# ---- fields


@pytest.mark.parametrize("config", [FieldConfig(SMALL), FieldConfig(SMALL, kind="dense")])
@pytest.mark.parametrize("parameter", [ALBEDO, ROUGHNESS])
def test_materials_start_in_the_middle_and_stay_in_range(parameter, config):
    si, field = surface(400), MaterialField(parameter, config, BOUNDS)
    start = field(si)
    assert start.shape == (400, parameter.channels)
    assert (start - 0.5).abs().max() < 0.02
    with torch.no_grad():
        field.grid.table.normal_(std=30.0)
    value = field(si)
    assert parameter.low <= value.min() < 0.1
    assert 0.9 < value.max() <= 1.0
    torch.testing.assert_close(value, field.at(si.p))


def test_roughness_may_read_the_albedo_and_gives_it_no_gradient():
    si, albedo = surface(100), torch.rand(100, 3, requires_grad=True)
    field = MaterialField(ROUGHNESS, RoughnessConfig(SMALL, reads_albedo=True), BOUNDS)
    with torch.no_grad():
        field.mlp.layers[-1].weight.normal_()
    value = field(si, albedo)
    value.sum().backward()
    assert albedo.grad is None
    assert not torch.equal(value, field(si, 1.0 - albedo))
    with pytest.raises(ValueError, match="albedo"):
        field(si)
    plain = MaterialField(ROUGHNESS, RoughnessConfig(SMALL), BOUNDS)
    assert torch.equal(plain(si, albedo), plain(si))


def test_positions_outside_the_bounds_take_the_nearest_value():
    field = MaterialField(ALBEDO, FieldConfig(SMALL), BOUNDS)
    with torch.no_grad():
        field.grid.table.normal_()
        far = field.at(torch.tensor([[1e6, 1e6, 1e6], [1e30, 1e30, 1e30]]))
    assert far.isfinite().all()
    assert torch.equal(far[0], far[1])


@pytest.mark.parametrize("config", [RadianceConfig(SMALL), RadianceConfig(SMALL, kind="dense")], ids=["hash", "dense"])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_radiance_starts_at_a_share_of_its_scale_and_is_positive(scale, config):
    field = RadianceField(config, BOUNDS, scale)
    si = surface(2000)
    value = field(si, torch.rand(2000, 3)).detach() / scale
    assert value.min() > 0
    assert abs(float(value.mean()) - START) < 0.1
    assert "scale" in field.state_dict()


def test_radiance_gives_the_albedo_no_gradient_and_reads_its_inputs():
    si = surface(50)
    albedo = torch.rand(50, 3, requires_grad=True)
    field = RadianceField(RadianceConfig(SMALL, inputs=("direction", "reflection", "normal", "albedo")), BOUNDS)
    field(si, albedo).sum().backward()
    assert albedo.grad is None
    assert all(p.grad is not None for p in field.parameters())
    blind = RadianceField(RadianceConfig(SMALL, inputs=()), BOUNDS)
    turned = SurfaceInteraction(si.p, -si.ng, -si.n, -si.wo, si.uv, si.bary, si.prim, si.valid)
    assert torch.equal(blind(si, albedo), blind(turned, 1 - albedo))
    assert not torch.equal(field(si, albedo), field(turned, albedo))


# ---- optimizer


@pytest.mark.parametrize("decay", [0.0, 3.0])
def test_dense_gradients_equal_torch_adam_bit_by_bit(decay):
    a, b = torch.nn.Parameter(torch.randn(40, 3)), torch.nn.Parameter(torch.randn(7))
    c, d = (torch.nn.Parameter(p.detach().clone()) for p in (a, b))
    ours = SparseRowAdam([a, b], lr=1e-2, weight_decay={a: decay, b: decay})
    torchs = torch.optim.AdamW([c, d], lr=1e-2, betas=(0.9, 0.99), eps=1e-15, fused=True, weight_decay=decay)
    for step in range(5):
        for group in (*ours.param_groups, *torchs.param_groups):
            group["lr"] = 1e-2 / (step + 1)
        for p, q in ((a, c), (b, d)):
            p.grad = torch.randn_like(p)
            q.grad = p.grad.clone()
        ours.step()
        torchs.step()
    assert torch.equal(a, c)
    assert torch.equal(b, d)


@pytest.mark.parametrize("decay", [0.0, 3.0])
@pytest.mark.parametrize("compiled", [True, False])
def test_sparse_gradients_of_every_row_equal_adam(compiled, decay):
    kind = torch.float32 if compiled else torch.float64  # the kernel takes float32, other kinds plain torch
    p = torch.nn.Parameter(torch.randn(300, 2, dtype=kind))
    q = torch.nn.Parameter(p.detach().clone())
    ours = SparseRowAdam([p], lr=1e-2, weight_decay={p: decay})
    torchs = torch.optim.AdamW([q], lr=1e-2, betas=(0.9, 0.99), eps=1e-15, weight_decay=decay)
    for _ in range(5):
        q.grad = torch.randn_like(q)
        order = torch.randperm(300)
        p.grad = torch.sparse_coo_tensor(order.unsqueeze(0), q.grad[order], q.shape, check_invariants=True)
        ours.step()
        torchs.step()
    torch.testing.assert_close(p, q, rtol=1e-5, atol=1e-6)


def test_sparse_steps_leave_other_rows_alone_and_add_up_repeated_rows():
    p = torch.nn.Parameter(torch.randn(100, 2))
    before = p.detach().clone()
    optimizer = SparseRowAdam([p], lr=1e-2)
    rows = torch.tensor([70, 3, 3, 99, 70, 70])
    values = torch.randn(6, 2)
    p.grad = torch.sparse_coo_tensor(rows.unsqueeze(0), values, p.shape, check_invariants=True)
    optimizer.step()
    moved = (p != before).any(1).nonzero().flatten()
    assert moved.tolist() == [3, 70, 99]
    expected = torch.zeros(100, 2).index_add_(0, rows, values)
    state = optimizer.state[p]
    torch.testing.assert_close(state["exp_avg"], 0.1 * expected)
    torch.testing.assert_close(state["exp_avg_sq"], 0.01 * expected**2)
    torch.testing.assert_close(p[moved], before[moved] - 1e-2 * expected[moved].sign(), rtol=1e-4, atol=1e-6)


def _two_sheets():
    """Two squares of the unit cube's middle that touch along x = 0.5, at a right angle: a scene's geometry."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32) * np.float32(0.5)
    flat, up = square + np.float32([0, 0, 0.5]), square[:, [2, 1, 0]] + np.float32([0.5, 0, 0.5])
    mesh = Mesh("room", np.concatenate((flat, up)), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]), 0)
    return Geometry(replace(build("cornell"), meshes=[mesh]))


def test_a_colour_ends_at_the_edge_of_its_segment():
    """Trained with black on one side of an edge and white on the other, sheets are so up to the edge, where a grid
    alone has grey for half a cell."""
    geometry = _two_sheets()
    parts = SurfaceParts(geometry, segments(geometry, 0.0))
    prim = torch.randint(4, (4096,))
    u, v = torch.rand(2, 4096, 1)
    corner = geometry.vertices[geometry.faces[prim]].unbind(1)
    p = corner[0] + u.sqrt() * ((1 - v) * (corner[1] - corner[0]) + v * (corner[2] - corner[0]))
    near = (p[:, 0] > 0.49) & (p[:, 2] < 0.51)  # at the edge
    white = (prim >= 2).float()[:, None].expand(-1, 3)
    errors = []
    for own in (parts, None):
        torch.manual_seed(1)
        field = MaterialField(ALBEDO, AlbedoConfig(SMALL), BOUNDS, segments=own)
        optimizer = torch.optim.Adam([x for x in field.parameters() if x is not field.grid.table], lr=0.03)
        table = SparseRowAdam([field.grid.table], lr=0.03, tables=[field.grid.table])
        for _ in range(60):
            loss = (field.at(p, prim=prim) - white).square().mean()
            loss.backward()
            for step in (optimizer, table):
                step.step()
                step.zero_grad()
        errors.append(float((field.at(p, prim=prim).detach() - white)[near].abs().mean()))
    assert int(near.sum()) > 10
    assert errors[0] < 0.1 < errors[1]
    inside = (p[:, 0] - 0.5).abs() + (p[:, 2] - 0.5).abs() > 1e-4
    assert torch.equal(parts.at(p)[inside], parts.of(prim)[inside])  # of the nearest triangle, where nobody says which
