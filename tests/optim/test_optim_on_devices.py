"""Optimizers and averages take the same steps on every device."""

import pytest
import torch
from helpers.devices import close, on_devices

from neurad.optim.polyak_average import PolyakAverage
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam

STEPS = 20


def gradients(shape, rows=None):
    """A gradient for every step; with ``rows``, zero in all others."""
    generator = torch.Generator().manual_seed(1)
    found = [torch.randn(shape, generator=generator) for _ in range(STEPS)]
    for g in found:
        if rows is not None:
            mask = torch.zeros(shape[0], dtype=torch.bool)
            mask[rows] = True
            g[~mask] = 0.0
    return found


def stepped(make, shape, device, given, sparse=False):
    p = torch.nn.Parameter(torch.linspace(-1, 1, shape[0] * shape[1]).view(shape).to(device))
    optimizer = make(p)
    for k, g in enumerate(given):
        optimizer.param_groups[0]["lr"] = 0.05 * (1.0 - k / STEPS)
        p.grad = (g.to_sparse(1) if sparse else g).to(device)
        optimizer.step()
    return p, optimizer


@on_devices
@pytest.mark.parametrize("sparse", [False, True])
def test_sparse_row_adam_goes_on_from_a_file_read_on_the_cpu(device, sparse, tmp_path):
    given = gradients((200, 4), torch.arange(0, 200, 3))
    p, optimizer = stepped(lambda p: SparseRowAdam([p]), (200, 4), device, given, sparse)
    torch.save(optimizer.state_dict(), tmp_path / "state")
    again = torch.nn.Parameter(p.detach().clone())
    other = SparseRowAdam([again])
    other.load_state_dict(torch.load(tmp_path / "state", map_location="cpu", weights_only=True))
    for which, of in ((p, optimizer), (again, other)):
        which.grad = (given[0].to_sparse(1) if sparse else given[0]).to(device)
        of.step()
    assert torch.equal(p, again)


@on_devices
def test_pyramid_adam_steps_as_on_the_cpu(device):
    given = gradients((8 * 16, 3))
    (found, _), (expected, _) = (
        stepped(lambda p: PyramidAdam([p], 16, detail_decay=0.3), (8 * 16, 3), where, given)
        for where in (device, "cpu")
    )
    close(found, expected, rtol=1e-4, atol=1e-4)
    assert not torch.equal(expected, torch.linspace(-1, 1, 384).view(128, 3))


@on_devices
def test_the_average_is_kept_and_shown_where_the_parameters_are(device):
    layer = torch.nn.Linear(3, 2).to(device)
    average = PolyakAverage(layer, 0.5, every=1).to(device)
    seen = []
    for k in range(1, 9):
        with torch.no_grad():
            layer.weight.fill_(float(k))
        average.update(k)
        seen.append(float(k))
    before = layer.weight.detach().clone()
    with average.used():
        shown = layer.weight.detach().clone()
    assert shown.device.type == device
    assert torch.equal(layer.weight.detach(), before)
    assert min(seen) < float(shown.mean()) < max(seen)
