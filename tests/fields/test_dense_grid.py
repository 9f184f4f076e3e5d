"""The dense grid: its compiled kernels against plain torch, its optimizer, and the fields made of it."""

import pytest
import torch

from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.records import SurfaceInteraction
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.material import MaterialField
from neurad.fields.radiance import START, RadianceField
from neurad.fields.settings import FieldConfig, RadianceConfig
from neurad.optim.sparse_row_adam import SparseRowAdam

BOUNDS = torch.tensor([[-1.0, 0.0, -3.0], [1.0, 0.5, 5.0]])


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(7)


def make_grid(size, channels, **options):
    grid = DenseGrid(size, channels, **options)
    with torch.no_grad():
        grid.table.normal_()
    return grid


def points(n):
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    return torch.cat((torch.rand(n, 3), corners, torch.full((1, 3), 0.5)))


def surface(n):
    unit = lambda: torch.nn.functional.normalize(torch.randn(n, 3), dim=-1)  # noqa: E731
    p = BOUNDS[0] + (BOUNDS[1] - BOUNDS[0]) * torch.rand(n, 3)
    index = torch.zeros(n, dtype=torch.int64)
    return SurfaceInteraction(p, unit(), unit(), unit(), torch.rand(n, 2), torch.rand(n, 2), index, index == 0)


@pytest.mark.parametrize(("size", "channels"), [(2, 1), (9, 3), (40, 3), (33, 5)])
def test_compiled_grid_equals_plain_torch(size, channels):
    grid = make_grid(size, channels)
    x = points(2000)
    kernel, reference = grid(x), grid.reference(x)
    torch.testing.assert_close(kernel, reference, rtol=1e-5, atol=1e-5)
    cotangent = torch.randn_like(kernel)
    (sparse,) = torch.autograd.grad(kernel, grid.table, cotangent)
    (dense,) = torch.autograd.grad(reference, grid.table, cotangent)
    assert sparse.is_sparse
    assert (sparse.to_dense() - dense).norm() < 1e-5 * dense.norm()
    rows = sparse._indices()[0]
    assert (rows[1:] > rows[:-1]).all()
    assert set(dense.abs().sum(1).nonzero().flatten().tolist()) <= set(rows.tolist())


def test_trilinear_reproduces_a_linear_function():
    grid = DenseGrid(9, 2)
    z, y, x = torch.meshgrid(*[torch.arange(9.0) / 8] * 3, indexing="ij")
    with torch.no_grad():
        grid.table.copy_(torch.stack((2 * x - y + 3 * z, x), -1).view(-1, 2))
        p = points(300)
        expected = torch.stack((2 * p[:, 0] - p[:, 1] + 3 * p[:, 2], p[:, 0]), -1)
        torch.testing.assert_close(grid(p), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("wall", [False, True])
def test_results_are_the_same_bit_by_bit_for_any_number_of_threads(wall: bool) -> None:
    grid, x = make_grid(32, 3), points(5000)
    if wall:  # all in one layer of cells: ranges are empty
        x[:, 2] = 0.5
        x[7] = float("nan")
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            out = grid(x)
            (gradient,) = torch.autograd.grad(out.nan_to_num().square().sum(), grid.table)
            results.append((out.detach(), gradient._indices(), gradient._values()))
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        for a, b in zip(result, results[0], strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


def test_no_points_odd_points_and_points_with_gradient():
    grid = make_grid(8, 3)
    out = grid(torch.empty(0, 3))
    out.sum().backward()
    assert out.shape == (0, 3)
    assert grid.table.grad._nnz() == 0
    x = torch.tensor([[float("nan"), 0.5, 2.0], [-3.0, float("inf"), 0.1], [0.2, 0.3, 0.4]])
    torch.testing.assert_close(grid(x)[2:], grid.reference(x[2:]), rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="detach"):
        grid(torch.rand(2, 3, requires_grad=True))


def test_fields_start_where_networks_start_and_stay_in_range():
    si, config = surface(400), FieldConfig(kind="dense", size=24)
    for field, channels, low in (
        (MaterialField(ALBEDO, config, BOUNDS), 3, 0.0),
        (MaterialField(ROUGHNESS, config, BOUNDS), 1, ROUGHNESS.low),
    ):
        out = field(si)
        assert out.shape == (400, channels)
        torch.testing.assert_close(out, torch.full_like(out, low + (1.0 - low) * 0.5))
        with torch.no_grad():
            field.grid.table.normal_(0.0, 30.0)
        assert (field(si) >= low).all()
        assert (field(si) <= 1.0).all()
        assert list(field.state_dict()) == ["cube.low", "cube.inverse_side", "cube.shell", "grid.table"]
    radiance = RadianceField(RadianceConfig(kind="dense", size=24), BOUNDS, scale=5.0)
    out = radiance(si, torch.rand(400, 3))
    torch.testing.assert_close(out, torch.full_like(out, 5.0 * START))


def test_radiance_is_the_same_in_all_directions():
    si = surface(200)
    field = RadianceField(RadianceConfig(kind="dense", size=16), BOUNDS)
    with torch.no_grad():
        field.grid.table.normal_()
    from dataclasses import replace

    other = replace(si, wo=-si.wo, n=si.wo)
    assert torch.equal(field(si, torch.rand(200, 3)), field(other, torch.rand(200, 3)))


@pytest.mark.parametrize("use_kernels", [True, False])
def test_grid_fits_a_smooth_function(use_kernels):
    field = MaterialField(ALBEDO, FieldConfig(kind="dense", size=12), BOUNDS)
    field.grid.use_kernels = use_kernels
    optimizer = SparseRowAdam(field.parameters(), lr=0.05)
    truth = lambda p: 0.5 + 0.3 * torch.sin(torch.stack((p[:, 0], p[:, 1], p[:, 2]), -1))  # noqa: E731
    for _ in range(150):
        si = surface(2000)
        optimizer.zero_grad()
        ((field(si) - truth(si.p)) ** 2).mean().backward()
        optimizer.step()
    si = surface(2000)
    assert (field(si) - truth(si.p)).square().mean().sqrt() < 0.02


def test_impossible_sizes_are_refused():
    with pytest.raises(InputError, match="at least 2 and at most 1024"):
        FieldConfig(kind="dense", size=1)
    with pytest.raises(InputError, match="sparse"):
        FieldConfig(kind="sparse")
