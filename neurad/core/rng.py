"""Counter-based random numbers: a stream is a pure function of its key, so any step can be replayed."""

import torch
from torch import Tensor

_MASK = (1 << 64) - 1


def mix(*key: int) -> int:
    """A 63-bit hash of integers (splitmix64 chained), the same on every machine."""
    state = 0x9E3779B97F4A7C15
    for k in key:
        state = (state ^ (k & _MASK)) & _MASK
        state = (state + 0x9E3779B97F4A7C15) & _MASK
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
        state ^= state >> 31
    return state >> 1


class Stream:
    """Uniform numbers for one key, such as (seed, iteration, rank). The same key gives the same numbers."""

    def __init__(self, *key: int, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.generator = torch.Generator(self.device).manual_seed(mix(*key))

    def restart(self, *key: int) -> None:
        """Give the numbers of another key from here on."""
        self.generator.manual_seed(mix(*key))

    def uniform(self, *shape: int) -> Tensor:
        """Uniform float32 in [0, 1)."""
        return torch.rand(*shape, generator=self.generator, device=self.device)

    def integers(self, high: int, *shape: int) -> Tensor:
        """Uniform int64 in 0 .. high - 1."""
        return torch.randint(high, shape, generator=self.generator, device=self.device)
