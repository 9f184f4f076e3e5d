"""A small fully connected network."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class MLP(nn.Module):
    """Linear layers with ReLU in between, none after the last.

    Args:
        inputs: channels read.
        outputs: channels returned.
        width: neurons of every hidden layer.
        hidden_layers: number of hidden layers; 0 is one linear map.
    """

    def __init__(self, inputs: int, outputs: int, width: int, hidden_layers: int) -> None:
        super().__init__()
        sizes = [inputs, *[width] * hidden_layers, outputs]
        layers = [nn.Linear(a, b) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
        for layer in layers[:-1]:
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        nn.init.kaiming_uniform_(layers[-1].weight, nonlinearity="linear")
        nn.init.zeros_(layers[-1].bias)
        self.layers = nn.ModuleList(layers)

    def forward(self, x: Tensor) -> Tensor:
        """Values [n, outputs] for inputs [n, inputs]."""
        *hidden, last = self.layers
        for layer in hidden:
            x = torch.relu_(torch.addmm(layer.bias, x, layer.weight.t()))
        return torch.addmm(last.bias, x, last.weight.t())
