"""Random directions and numbers for tests of reflection models."""

import math

import torch


def directions(count, seed=0, upper=True, dtype=torch.float32):
    """Uniform unit vectors [count, 3], of the upper half-space or of all."""
    generator = torch.Generator().manual_seed(seed)
    w = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    if upper:
        w[:, 2] = w[:, 2].abs()
    return w.to(dtype)


def uniform(*shape, seed=0, dtype=torch.float32):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def toward(cos, count=1, dtype=torch.float32):
    """One direction, ``count`` times [count, 3]."""
    sin, phi = math.sqrt(1 - cos * cos), 0.7
    return torch.tensor([[sin * math.cos(phi), sin * math.sin(phi), cos]], dtype=dtype).expand(count, 3)
