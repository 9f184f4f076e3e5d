"""Adam whose cost is proportional to the touched entries of hash-grid tables."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

from neurad.fields.sparse import unique_rows
from neurad.optim.eager import EagerOptimizer
from neurad.runtime.dispatch import use_kernel, use_warp
from neurad.runtime.threads import split


class SparseRowAdam(EagerOptimizer):
    """Adam (Kingma and Ba 2015) with lazy updates of tables, of which a step touches few rows.

    A sparse gradient moves the rows that it names and leaves every other row and its moments unchanged, as
    ``torch.optim.SparseAdam`` does, but for decay; the step counter behind the bias correction is that of the whole
    parameter. A dense gradient of one of the ``tables`` names the rows in which it is not zero. A gradient that names
    every row makes the two the same as Adam. All else goes to torch's own Adam, fused where possible.

    On a GPU a step asks the device nothing, so it may be captured in a CUDA graph. Learning rates are taken from
    ``param_groups`` at every step; before a replayed one ``rates.write()`` does that.

    Args:
        lr: step size; read at every step, so it may be changed in ``param_groups``.
        betas: decay of the two moments. The second is shorter than Adam's usual 0.999, since few table entries are
            touched a thousand times.
        eps: added to the root of the second moment. As in instant-ngp far below usual gradients: those of table
            entries are tiny, and a larger floor would freeze them.
        weight_decay: by parameter, as in AdamW (Loshchilov and Hutter 2019): a step multiplies all values by
            ``1 - lr * weight_decay``, also in rows that a sparse gradient does not name. Not part of the state: a
            continued run uses what its settings say.
        tables: those of ``params`` that are tables [entries, features].
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 5e-3,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-15,
        weight_decay: Mapping[Tensor, float] | None = None,
        tables: Iterable[Tensor] = (),
        use_kernels: bool = True,
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})
        self.weight_decay = dict(weight_decay or {})
        self.tables = set(tables)
        self.use_kernels = use_kernels

    def update(self, index: int, group: dict[str, Any], params: list[Tensor]) -> None:
        """Update the parameters of a group one by one, but those that are no tables together."""
        dense = []
        for p in params:
            gradient = p.grad
            assert gradient is not None
            lr = group["lr"] if gradient.is_sparse else self._rate(index, p)
            state, decay = self.state[p], self.weight_decay.get(p, 0.0)
            if not state:
                state["step"] = torch.zeros((), device=p.device)
                state["exp_avg"] = torch.zeros_like(p, memory_format=torch.preserve_format)
                state["exp_avg_sq"] = torch.zeros_like(p, memory_format=torch.preserve_format)
            state["step"] = state["step"].to(p.device)  # torch leaves that of a checkpoint where it was read
            if p in self.tables and use_warp(self.use_kernels and not gradient.is_sparse and p.is_contiguous(), p):
                from neurad.optim.sparse_row_adam_warp import update_table  # Warp is optional

                update_table(p, state, lr, group["betas"], group["eps"], decay)
                continue
            if decay > 0.0:
                p.mul_(1.0 - lr * decay)
            if gradient.is_sparse:
                _update_rows(p, gradient, state, group)
            elif p in self.tables:
                _update_table(p, gradient, state, lr, group)
            else:
                dense.append(p)
        if dense:
            _update_dense(dense, [self.state[p] for p in dense], self._rate(index, dense[0]), group)

    def _rate(self, index: int, p: Tensor) -> Any:
        """The learning rate of a group: where ``p`` is a table or lies on a GPU, a scalar on its device."""
        if p.device.type == "cpu" and p not in self.tables and self.rates.gate is None:
            return self.param_groups[index]["lr"]
        return self.rates.of(index, p.device)


def _update_dense(params: list[Tensor], states: list[dict[str, Tensor]], lr: Any, group: dict[str, Any]) -> None:
    adam(
        params,
        [p.grad for p in params],  # type: ignore[misc]
        [s["exp_avg"] for s in states],
        [s["exp_avg_sq"] for s in states],
        [],
        [s["step"] for s in states],
        fused=params[0].device.type in ("cpu", "cuda") or None,
        amsgrad=False,
        beta1=group["betas"][0],
        beta2=group["betas"][1],
        lr=lr,
        weight_decay=0.0,
        eps=group["eps"],
        maximize=False,
    )


def _update_table(p: Tensor, gradient: Tensor, state: dict[str, Tensor], lr: Tensor, group: dict[str, Any]) -> None:
    """Adam on the rows of ``p`` [e, c] whose dense gradient is not zero."""
    state["step"] += 1
    step = state["step"].double()
    beta1, beta2 = group["betas"]
    rate, root = lr / (1.0 - beta1**step), (1.0 - beta2**step).sqrt()
    m, v = state["exp_avg"], state["exp_avg_sq"]
    touched = (gradient != 0.0).any(-1, keepdim=True)  # NaN is not 0
    torch.where(touched, torch.lerp(m, gradient, 1.0 - beta1), m, out=m)
    torch.where(touched, beta2 * v + (1.0 - beta2) * gradient * gradient, v, out=v)
    p -= torch.where(touched, rate * m / (v.sqrt() / root + group["eps"]), 0.0)


def _update_rows(p: Tensor, gradient: Tensor, state: dict[str, Tensor], group: dict[str, Any]) -> None:
    """Adam on the rows of ``p`` that a sparse gradient names."""
    state["step"] += 1
    step = float(state["step"])
    beta1, beta2 = group["betas"]
    rate, root = group["lr"] / (1.0 - beta1**step), (1.0 - beta2**step) ** 0.5
    m, v = state["exp_avg"], state["exp_avg_sq"]
    rows, values = unique_rows(gradient)
    if use_kernel(p.dim() == 2 and p.is_contiguous(), p, differentiable=True):
        from neurad.fields import hash_grid_kernels as kernels

        factors = np.array((rate, 1.0 / root, beta1, beta2, group["eps"]), np.float32)
        arrays = p.detach().numpy(), m.numpy(), v.numpy(), rows.numpy(), values.numpy(), factors
        split(lambda low, high: kernels.adam_rows(*arrays, low, high), len(rows), 8192)
        return
    m[rows] = torch.lerp(m[rows], values, 1.0 - beta1)
    v[rows] = beta2 * v[rows] + (1.0 - beta2) * values * values
    p[rows] -= rate * m[rows] / (v[rows].sqrt() / root + group["eps"])
