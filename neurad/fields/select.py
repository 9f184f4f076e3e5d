"""The layers between a position and a field's output activation, by the field's settings."""

from collections.abc import Sequence
from typing import Any, assert_never

import torch
from torch import Tensor, nn

from neurad.fields.dense_grid import DenseGrid
from neurad.fields.encoding import Encoding
from neurad.fields.hash_grid import HashGrid
from neurad.fields.mlp import MLP
from neurad.fields.outputs import Output
from neurad.fields.settings import FieldConfig
from neurad.fields.unit_cube import UnitCube


def make_layers(config: FieldConfig, channels: int, extra: int = 0) -> tuple[nn.Module, nn.Module]:
    """An encoding of positions [n, 3] in the unit cube, and a layer from its features to values [n, channels].

    Args:
        extra: channels that a network reads beside the encoding; a dense grid has no network, so it reads none.
    """
    match config.kind:
        case "dense":
            assert config.grid.finest is not None, "RecoverySettings refuses it"
            return DenseGrid(config.grid.finest + 1, channels), nn.Identity()
        case "hash":
            encoding: Any = HashGrid.from_config(config.grid)
        case Encoding():
            encoding = config.kind.make()
        case _:
            assert_never(config.kind)
    return encoding, MLP(encoding.channels + extra, channels, config.width, config.hidden_layers)


def evaluate_layers(
    cube: UnitCube,
    encoding: nn.Module,
    layer: nn.Module,
    p: Tensor,
    output: Output,
    others: Sequence[Tensor] = (),
    key: Tensor | None = None,
) -> Tensor:
    """Values [n, channels] of the layers that :func:`make_layers` made, at positions ``p`` [n, 3] in the scene: one
    operation where all have kernels.

    Args:
        others: what a network reads beside the encoding [n, ...], without gradient.
        key: of the surfaces that the positions lie on [n], as :func:`neurad.fields.hash_grid.keys_of` has it; None for
            none.
    """
    if isinstance(layer, MLP) and isinstance(encoding, HashGrid) and encoding.has_kernel() and layer.has_kernel(p):
        return layer.of_position(cube, encoding, p.detach(), output, others, key)
    features = encoding(cube(p)) if key is None else encoding(cube(p), key)
    return output(layer(torch.cat((features, *others), -1) if others else features))
