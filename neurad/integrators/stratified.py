"""Uniform numbers for the bounces of a pixel, spread evenly instead of drawn one by one."""

import math
from functools import cache

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import FloatArray, IntArray
from neurad.core.rng import Stream
from neurad.integrators.vertex import DIMENSIONS
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.jit import kernel
from neurad.runtime.threads import GRAIN, split

_FIRST = [0, 2, 3, 4, 6]
"""First number of each decision of a bounce: point on an emitter, emitter, lobe, direction, glass."""
_PAIRS = [0, 3]
"""Which of them take two numbers."""
_SECOND = [1, 5]
"""Their second ones."""
_ONE = np.float32(1.0)


def stratified_samples(groups: int, count: int, stream: Stream, use_kernels: bool = True) -> Tensor:
    """Uniform numbers for ``groups`` times ``count`` bounces that are spread evenly [groups * count, DIMENSIONS].

    Every bounce's numbers are uniform, and groups are independent. Within a group each number stands once in every
    ``count``-th part of its range (the second ones of pairs do if ``count`` is a power of two). The pairs that make a
    direction or a point on an emitter are those of a Hammersley set, randomly shifted; what belongs to different
    decisions is paired by random affine maps of the indices (padding, Kollig and Keller 2002), of which powers of two
    have most.
    """
    if count == 1:
        return stream.uniform(groups, DIMENSIONS)
    random = stream.uniform(groups, DIMENSIONS + len(_FIRST))  # shifts, then a choice of each decision's affine map
    units, mirrored = _units(count, random.device), _mirrored(count, random.device)
    if not use_kernel(use_kernels, random):
        return _stratified_reference(random, units, mirrored, count)
    out = torch.empty(groups * count, DIMENSIONS)
    arrays = random.numpy(), units.numpy(), mirrored.numpy(), count, out.numpy()
    split(lambda low, high: stratified_kernel(low, high, *arrays), groups, -(-GRAIN // count))
    return out


def _stratified_reference(random: Tensor, units: Tensor, mirrored: Tensor, count: int) -> Tensor:
    """:func:`stratified_samples` in plain torch, from its random numbers [groups, DIMENSIONS + 5]."""
    shift, choice = random.unsqueeze(1).tensor_split((DIMENSIONS,), -1)
    maps = count * len(units)
    choice = (choice * maps).long().clamp_max(maps - 1)
    start, factor = choice % count, units[choice // count]
    order = (start + factor * torch.arange(count, device=random.device).view(1, -1, 1)) % count
    numbers = shift.repeat(1, count, 1)
    numbers[..., _FIRST] += order / count
    numbers[..., _SECOND] += mirrored[order[..., _PAIRS]]
    wrapped: Tensor = numbers % 1.0
    return wrapped.view(-1, DIMENSIONS)


@kernel
def stratified_kernel(
    low: int, high: int, random: FloatArray, units: IntArray, mirrored: FloatArray, count: int, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Numbers ``out`` [groups * count, 7] of groups ``low .. high - 1`` from ``random`` [groups, 12]: shifts, then
    choices of affine maps.

    ``units`` are the factors to choose from, ``mirrored`` [count] is van der Corput's sequence.
    """
    maps = count * units.shape[0]
    for g in range(low, high):
        for decision in range(5):
            first = (0, 2, 3, 4, 6)[decision]
            second = (1, -1, -1, 5, -1)[decision]
            choice = min(np.int64(random[g, 7 + decision] * np.float32(maps)), maps - 1)
            order, factor = choice % count, units[choice // count]
            for k in range(count):
                value = random[g, first] + np.float32(order) / np.float32(count)
                out[g * count + k, first] = value - _ONE if value >= _ONE else value
                if second >= 0:
                    value = random[g, second] + mirrored[order]
                    out[g * count + k, second] = value - _ONE if value >= _ONE else value
                order = (order + factor) % count


@cache
def _units(count: int, device: torch.device) -> Tensor:
    """Factors of the affine maps that reach every index."""
    return torch.tensor([k for k in range(1, count) if math.gcd(k, count) == 1], device=device)


@cache
def _mirrored(count: int, device: torch.device) -> Tensor:
    """Van der Corput's sequence in base 2 [count]."""
    bits = max(1, (count - 1).bit_length())
    return torch.tensor([int(f"{k:0{bits}b}"[::-1], 2) / (1 << bits) for k in range(count)], device=device)
