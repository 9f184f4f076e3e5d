"""The one rule that chooses between a kernel and its reference."""

from __future__ import annotations

import pytest
import torch

from neurad.runtime.dispatch import use_kernel


def test_plain_floats_on_the_processor_get_the_kernel() -> None:
    assert use_kernel(True, torch.zeros(3), torch.zeros(2, 3))
    assert not use_kernel(False, torch.zeros(3))


@pytest.mark.parametrize(
    "other", [torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.bfloat16), torch.zeros(3, device="meta")]
)
def test_any_other_tensor_gets_the_reference(other: torch.Tensor) -> None:
    assert not use_kernel(True, torch.zeros(3), other)
    assert not use_kernel(True, other, differentiable=True)


def test_gradients_need_a_kernel_that_has_them() -> None:
    free = torch.zeros(3, requires_grad=True)
    assert not use_kernel(True, free)
    assert use_kernel(True, free, differentiable=True)
