"""The kernels of :mod:`neurad.optim.sparse_row_adam` for a GPU, by NVIDIA Warp; imported where a table lies on one.

All that changes from step to step lies on the device: a step asks it nothing and may be part of a CUDA graph.
"""
# mypy: disable-error-code="attr-defined, valid-type, no-untyped-call"
# No postponed annotations here: Warp reads the argument types when a kernel is declared.

import warp as wp
from torch import Tensor

from neurad.runtime.warp import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin(
    lr: wp.array(dtype=wp.float32),
    beta1: wp.float64,
    beta2: wp.float64,
    weight_decay: wp.float64,
    step: wp.array(dtype=wp.float32),
    factors: wp.array(dtype=wp.float32),
) -> None:
    """Count a ``step`` [1] and fill ``factors``: lr / (1 - beta1^t), 1 / sqrt(1 - beta2^t) and what decay leaves."""
    t, one, rate = wp.float64(step[0] + 1.0), wp.float64(1.0), wp.float64(lr[0])
    step[0] = float(t)
    factors[0] = float(rate / (one - wp.pow(beta1, t)))
    factors[1] = float(one / wp.sqrt(one - wp.pow(beta2, t)))
    factors[2] = float(one - rate * weight_decay)


@wp.kernel
def update(
    p: wp.array2d(dtype=wp.float32),
    m: wp.array2d(dtype=wp.float32),
    v: wp.array2d(dtype=wp.float32),
    gradient: wp.array2d(dtype=wp.float32),
    factors: wp.array(dtype=wp.float32),
    beta1: wp.float32,
    beta2: wp.float32,
    eps: wp.float32,
) -> None:
    """Adam on the rows of ``p`` [e, c] and its moments that have a ``gradient``; decay on all."""
    row = wp.tid()
    touched = wp.bool(False)
    for j in range(p.shape[1]):
        touched = touched or gradient[row, j] != 0.0  # NaN is not 0
    kept = factors[2]
    if not touched and kept == 1.0:
        return
    for j in range(p.shape[1]):
        value = p[row, j] * kept
        if touched:
            g = gradient[row, j]
            mean = m[row, j] + (1.0 - beta1) * (g - m[row, j])
            square = beta2 * v[row, j] + (1.0 - beta2) * g * g
            m[row, j] = mean
            v[row, j] = square
            value -= factors[0] * mean / (wp.sqrt(square) * factors[1] + eps)
        p[row, j] = value


def update_table(
    p: Tensor, state: dict[str, Tensor], lr: Tensor, betas: tuple[float, float], eps: float, weight_decay: float
) -> None:
    """One step of a table [e, c] with a dense gradient; ``lr`` [] lies on its device."""
    assert p.grad is not None
    device, factors, step = p.device, p.new_empty(3), state["step"]
    launch(begin, 1, device, lr.view(1), *betas, weight_decay, step.view(1), factors)
    moments = state["exp_avg"], state["exp_avg_sq"]
    launch(update, len(p), device, p.detach(), *moments, p.grad.detach(), factors, *betas, eps)
