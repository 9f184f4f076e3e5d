"""Devices that tests of device code run on: the CPU, and a GPU where there is one.

The same body runs on both: what ships, on the device, against the reference in plain torch on the CPU.
"""

import pytest
import torch

NO_GPU = "torch.cuda.is_available() is False: this needs a CUDA device"
CUDA = pytest.param(
    "cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason=NO_GPU)]
)  # fmt: skip
on_devices = pytest.mark.parametrize("device", ["cpu", CUDA])
on_cuda = pytest.mark.parametrize("device", [CUDA])  # what other tests show of the CPU


def close(found, expected, rtol=1e-4, atol=1e-5, stray=0.0):
    """Values of a device agree with those of the CPU, but for a fraction ``stray`` of the rows, where rounding may
    decide otherwise."""
    found, expected = found.detach().cpu(), expected.detach().cpu()
    assert found.shape == expected.shape
    assert bool(found.isfinite().all() == expected.isfinite().all())
    if stray == 0.0:
        torch.testing.assert_close(found, expected, rtol=rtol, atol=atol)
        return
    off = (found.double() - expected.double()).abs() > atol + rtol * expected.double().abs()
    assert float(off.flatten(1).any(1).float().mean() if off.dim() > 1 else off.float().mean()) <= stray


def dense(gradient):
    return (gradient.to_dense() if gradient.is_sparse else gradient).detach().cpu()
