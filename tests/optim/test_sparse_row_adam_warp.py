"""Adam on the rows of a table that have a gradient, dense on a GPU or Warp's CPU, against the sparse one on the CPU."""

import pytest
import torch
from helpers.devices import close, on_devices
from helpers.host_questions import no_host_questions

from neurad.fields.hash_grid import HashGrid
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam

pytestmark = pytest.mark.usefixtures("warp_on_cpu")

STEPS, ROWS = 200, 1000


def steps(width):
    """Rows and gradients of every step: few rows, gradients over many orders of magnitude, one that is not a row's."""
    generator = torch.Generator().manual_seed(3)
    for _ in range(STEPS):
        rows = torch.randperm(ROWS, generator=generator)[:80].sort().values
        values = torch.randn(80, width, generator=generator) * 10 ** (8 * torch.rand(80, 1, generator=generator) - 6)
        values[::7, 0] = 0.0  # a row counts where any of its channels does
        yield rows, values


def run(device, width, decay, sparse=False, use_kernels=True, watched=True):
    """A table and its moments after 200 steps with a schedule, beside a matrix that is no table."""
    p = torch.nn.Parameter(torch.linspace(-1, 1, ROWS * width).view(ROWS, width).to(device))
    q = torch.nn.Parameter(torch.ones(4, 3, device=device))
    settings = {"weight_decay": {p: decay}, "tables": [p], "use_kernels": use_kernels}
    optimizer = SparseRowAdam([p, q], betas=(0.9, 0.97), **settings)
    for k, (rows, values) in enumerate(steps(width)):
        optimizer.param_groups[0]["lr"] = 0.05 * (1.0 - k / STEPS)
        gradient = torch.sparse_coo_tensor(rows[None], values, (ROWS, width), check_invariants=True)
        p.grad = gradient if sparse else gradient.to_dense().to(device)
        q.grad = torch.full((4, 3), float(k % 3), device=device)
        if sparse or not watched:
            optimizer.step()
            continue
        with no_host_questions():
            optimizer.step()
    return p, q, optimizer.state[p]


@on_devices
@pytest.mark.parametrize("width", [2, 3])
@pytest.mark.parametrize("decay", [0.0, 0.4])
@pytest.mark.parametrize("use_kernels", [True, False])
def test_two_hundred_steps_are_those_of_sparse_gradients(device, width, decay, use_kernels):
    expected, matrix, moments = run("cpu", width, decay, sparse=True)
    found, other, own = run(device, width, decay, use_kernels=use_kernels)
    assert found.device.type == device
    close(found, expected, rtol=1e-4, atol=2e-5)
    close(other, matrix)
    for name in ("exp_avg", "exp_avg_sq"):
        close(own[name], moments[name], rtol=1e-4, atol=1e-6 * float(moments[name].abs().max()))
        assert torch.equal(own[name].cpu() == 0.0, moments[name] == 0.0)  # rows without a gradient keep theirs
    assert float(own["step"]) == STEPS
    assert not torch.equal(expected, torch.linspace(-1, 1, ROWS * width).view(ROWS, width))


@on_devices
def test_a_gradient_that_is_not_a_number_is_not_hidden(device):
    p = torch.nn.Parameter(torch.ones(5, 2, device=device))
    optimizer = SparseRowAdam([p], tables=[p])
    p.grad = torch.zeros(5, 2, device=device)
    p.grad[3, 1] = float("nan")
    optimizer.step()
    assert bool(p[3, 1].isnan())
    assert torch.equal(p[:3].cpu(), torch.ones(3, 2))


@on_devices
@pytest.mark.parametrize("pyramid", [False, True])
def test_a_step_reads_the_learning_rate_that_was_written_last(device, pyramid):
    """As a graph on a GPU does, which replays the memory that it was captured with."""
    p = torch.nn.Parameter(torch.ones(128, 2, device=device))
    p.grad = torch.ones_like(p)
    optimizer = PyramidAdam([p], 16, lr=0.1) if pyramid else SparseRowAdam([p], lr=0.1, tables=[p])
    optimizer.step()
    rate = optimizer.rates.of(0, p.device)
    assert rate.device == p.device
    optimizer.param_groups[0]["lr"] = 0.0
    optimizer.rates.write()
    assert float(rate) == 0.0
    before = p.detach().clone()
    optimizer.step()
    assert torch.equal(p, before)


@on_devices
def test_the_environments_step_asks_the_device_nothing(device):
    p = torch.nn.Parameter(torch.ones(128, 3, device=device))
    p.grad = torch.rand(128, 3, device=device)
    optimizer = PyramidAdam([p], 16)
    optimizer.step()  # makes its matrices
    with no_host_questions():
        optimizer.step()
    assert bool(p.isfinite().all())


@on_devices
def test_a_hash_grid_learns_as_on_the_cpu(device, monkeypatch):
    """The whole of it, with gradients as the kernels give them, against the CPU's own kernels and sparse gradients."""
    from neurad.runtime import dispatch

    def learnt(where, warp):
        monkeypatch.setattr(dispatch, "WARP_DEVICES", ("cpu", "cuda") if warp else ())
        generator = torch.Generator().manual_seed(5)
        grid = HashGrid(5, 2, 40, log2_size=9)
        with torch.no_grad():
            grid.table.copy_(0.1 * torch.randn(grid.table.shape, generator=generator))
        grid.to(where)
        optimizer = SparseRowAdam(grid.parameters(), lr=0.02, tables=[grid.table])
        for _ in range(20):
            x = torch.rand(20, 3, generator=generator)
            optimizer.zero_grad()
            (grid(x.to(where)).sum(1) - x[:, 0].to(where)).square().mean().backward()
            assert grid.table.grad.is_sparse != warp
            optimizer.step()
        return grid.table

    close(learnt(device, True), learnt("cpu", False), rtol=1e-3, atol=1e-3, stray=1e-2)
