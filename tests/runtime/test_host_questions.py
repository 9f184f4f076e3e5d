"""The guard of code for a CUDA graph sees every kind of question to the device, also where that is a CPU."""

import pytest
import torch
from helpers.host_questions import HostQuestion, no_host_questions

X = torch.rand(5, 3)
MASK = X > 0.5
QUESTIONS = {
    "item": lambda x: x.sum().item(),
    "float": lambda x: float(x.sum()),
    "int": lambda x: int(x.sum()),
    "bool": lambda x: bool(x.sum() > 0),
    "if": lambda x: 1 if x.sum() > 0 else 0,
    "index": lambda x: [7, 8][x.sum().long() * 0],
    "tolist": lambda x: x.tolist(),
    "numpy": lambda x: x.numpy(),
    "cpu": lambda x: x.cpu(),
    "other device": lambda x: x.to("meta"),
    "copy": lambda x: torch.empty(5, 3, device="meta").copy_(x),
    "tensor": lambda x: x * torch.tensor(2.0),
    "new_tensor": lambda x: x.new_tensor([1.0]),
    "nonzero": lambda x: x.nonzero(),
    "where": lambda x: torch.where(x > 0.5),
    "mask": lambda x: x[x > 0.5],
    "rows by mask": lambda x: x[x[:, 0] > 0.5],
    "write by mask": lambda x: x.clone().__setitem__(x > 0.5, X[MASK]),
    "masked_select": lambda x: x.masked_select(x > 0.5),
    "unique": lambda x: x.unique(),
    "equal": lambda x: torch.equal(x, x),
    "allclose": lambda x: torch.allclose(x, x),
    "repeat_interleave": lambda x: x.repeat_interleave((x[:, 0] > 0.5).long() + 1, 0),
    "coalesce": lambda x: torch.sparse_coo_tensor(torch.zeros(1, 5, dtype=torch.long), x, (9, 3)).coalesce(),
}
NONE = {
    "arithmetic": lambda x: (x * 2.0 + 1.0).sum(),
    "fill": lambda x: x.clone().fill_(3.0),
    "fill by mask": lambda x: x.clone().__setitem__(x > 0.5, 0.0),
    "where": lambda x: torch.where(x > 0.5, x, 0.0),
    "rows": lambda x: x[torch.arange(3)],
    "slice": lambda x: x[1:3],
    "full": lambda x: torch.full((2,), 3.0),
    "matrix product": lambda x: x @ x.T,
    "conversion": lambda x: x.double().float(),
    "repeat_interleave": lambda x: x.repeat_interleave(3, 1),
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_question_to_the_device_is_refused(name):
    with pytest.raises(HostQuestion), no_host_questions():
        QUESTIONS[name](X)


@pytest.mark.parametrize("name", NONE)
def test_what_stays_on_the_device_is_let_through(name):
    with no_host_questions():
        NONE[name](X)


class _Asks(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x * 1.0

    @staticmethod
    def backward(ctx, gradient):
        return gradient * float(gradient.sum())


def test_backward_passes_are_watched_too():
    x = X.clone().requires_grad_()
    with pytest.raises(HostQuestion), no_host_questions():
        _Asks.apply(x).sum().backward()
    with pytest.raises(HostQuestion), no_host_questions():  # the gradient of a mask's rows writes by mask
        x[torch.arange(5)].square()[MASK].sum().backward()
    with no_host_questions():
        x.square().sum().backward()
