"""The hash grid's kernels for a GPU, there or on Warp's CPU, against the encoding in plain torch."""

import pytest
import torch
from helpers.devices import close, on_devices
from helpers.host_questions import no_host_questions

from neurad.fields.hash_grid import HashGrid, keys_of

pytestmark = pytest.mark.usefixtures("warp_on_cpu")

GRIDS = {
    "dense and hashed levels": lambda: HashGrid(8, 2, 96, log2_size=14),
    "every level small enough for copies": lambda: HashGrid(4, 2, 40, log2_size=9),
    "no level small enough for copies": lambda: HashGrid(2, 32, 48, log2_size=15),
    "the paper's finest level": lambda: HashGrid(1, 65536, 65536, log2_size=17),
}


def positions(n):
    """Of the unit cube, its corners and sides among them, and just outside of it."""
    x = torch.rand(n, 3)
    x[: n // 10] = x[: n // 10].round()
    x[n // 10 : n // 5, 1] = 1.0
    x[n // 5 : n // 4] *= 1.01
    return x


def both(make, device, x):
    """Features and table gradients of the reference on the CPU, and of the kernels on a device."""
    reference = make()
    with torch.no_grad():
        reference.table.normal_()
    grid = make().to(device)
    grid.load_state_dict(reference.state_dict())
    key = keys_of(3)[torch.arange(len(x)) % 3]
    expected = reference.reference(x, key)
    cotangent = torch.randn_like(expected)
    expected.backward(cotangent)
    there, on, back = x.to(device), key.to(device), cotangent.to(device)
    with no_host_questions():
        found = grid(there, on)
        found.backward(back)
    assert type(found.grad_fn).__name__ == "EncodeBackward"  # not the reference once more
    return (expected, reference.table.grad), (found, grid.table.grad)


@on_devices
@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("n", [2000, 1])
def test_values_and_gradients_are_those_of_the_reference(device, name, n):
    (expected, gradient), (found, own) = both(GRIDS[name], device, positions(n))
    assert found.device.type == own.device.type == device
    close(found, expected, rtol=1e-4, atol=2e-5 * (1.0 if name != "the paper's finest level" else 1e3))
    close(own, gradient, rtol=1e-3, atol=1e-4 * float(gradient.abs().max()))


@on_devices
@pytest.mark.parametrize("name", GRIDS)
def test_entries_are_exactly_those_of_the_reference(device, name):
    """Inside of cells all eight corners count, so that what has a gradient is what the hash has named."""
    make = GRIDS[name]
    cells = make().level_table[-1, 0]
    x = (torch.randint(int(cells), (500, 3)) + 0.25 + 0.5 * torch.rand(500, 3)) / cells
    (_, gradient), (_, own) = both(make, device, x)
    first = int(make().level_table[-1, 2])
    touched = (gradient[first:] != 0.0).any(1)
    assert 8 < int(touched.sum()) <= 4000
    assert torch.equal((own.cpu()[first:] != 0.0).any(1), touched)


@on_devices
def test_lanes_without_a_gradient_touch_nothing(device):
    grid = HashGrid(4, 2, 40, log2_size=9).to(device)
    features = grid(torch.rand(100, 3, device=device))
    (features[:0].sum() + 0.0 * features.sum()).backward()
    assert not bool(grid.table.grad.any())
    features = grid(torch.rand(100, 3, device=device))
    cotangent = torch.zeros_like(features)
    cotangent[7] = float("nan")
    features.backward(cotangent)
    assert bool(grid.table.grad.isnan().any())  # what went wrong is not hidden


@on_devices
def test_positions_that_are_not_numbers_read_inside_the_table(device):
    grid = HashGrid(4, 2, 40, log2_size=9).to(device)
    x = torch.full((4, 3), float("nan"), device=device)
    x[1], x[2] = float("inf"), -float("inf")
    x[3] = 0.5
    features = grid(x)
    assert not bool(features[:3].isfinite().any())
    assert bool(features[3].isfinite().all())


@on_devices
def test_no_positions_give_no_features(device):
    grid = HashGrid(4, 2, 40, log2_size=9).to(device)
    features = grid(torch.empty(0, 3, device=device))
    assert features.shape == (0, 8)
    features.sum().backward()
    assert grid.table.grad.shape == grid.table.shape
    assert not bool(grid.table.grad.any())


@on_devices
def test_other_tables_have_no_kernel(device):
    for grid in (HashGrid(2, 2, 4).double(), HashGrid(2, 2, 4, use_kernels=False)):
        x = torch.rand(5, 3, dtype=grid.table.dtype, device=device)
        assert torch.equal(grid.to(device)(x), grid.reference(x))
