"""Materials averaged over the last part of a run."""

import copy
import math

import pytest
import torch
from torch import nn

from neurad.optim.polyak_average import EVERY, PolyakAverage


def test_it_is_the_moving_average_by_hand():
    part = nn.Linear(2, 1)
    average = PolyakAverage(part, 0.5)
    start = part.weight.detach().clone()
    expected = None
    for iteration in range(1, 10 * EVERY + 1):
        with torch.no_grad():
            part.weight.add_(0.01 * iteration)
        average.update(iteration)
        if iteration % EVERY == 0:
            weight = 1.0 if expected is None else min(1.0, EVERY / (0.5 * iteration))
            now = part.weight.detach().clone()
            expected = now if expected is None else expected + weight * (now - expected)
    assert int(average.updates) == 10
    last = part.weight.detach().clone()
    with average.used():
        torch.testing.assert_close(part.weight.detach(), expected)
        assert bool((part.weight < last).all())
        assert bool((part.weight > start).all())
    assert torch.equal(part.weight.detach(), last)


def test_before_the_first_update_nothing_changes_and_an_error_inside_changes_nothing():
    part = nn.Linear(3, 2)
    average = PolyakAverage(part, 0.1)
    with torch.no_grad():
        part.bias.fill_(7.0)
    with average.used():
        assert bool((part.bias == 7.0).all())
    average.update(EVERY - 1)
    assert int(average.updates) == 0
    average.update(EVERY)
    with torch.no_grad():
        part.bias.fill_(9.0)
    with pytest.raises(KeyError), average.used():
        raise KeyError(float(part.bias[0]))
    assert bool((part.bias == 9.0).all())


def test_it_has_a_state_and_no_parameters():
    part = nn.Linear(3, 2)
    average = PolyakAverage(part, 0.1)
    assert not list(average.parameters())
    with torch.no_grad():
        part.weight.fill_(2.0)
    average.update(EVERY)
    state = copy.deepcopy(average.state_dict())
    other = nn.Linear(3, 2)
    fresh = PolyakAverage(other, 0.1)
    fresh.load_state_dict(state)
    with fresh.used():
        assert bool((other.weight == 2.0).all())


def test_noise_about_a_minimum_is_averaged_out():
    """Adam with noisy gradients of a quadratic: the average over a fifth of the way is more than twice as close."""
    generator = torch.Generator().manual_seed(1)
    part = nn.Linear(200, 1, bias=False)
    average = PolyakAverage(part, 0.2)
    optimizer = torch.optim.Adam(part.parameters(), lr=3e-2)
    for iteration in range(1, 6001):
        noise = torch.randn(part.weight.shape, generator=generator)
        part.weight.grad = part.weight.detach() - 1.0 + 3.0 * noise
        optimizer.step()
        average.update(iteration)
    present = float((part.weight.detach() - 1.0).norm()) / math.sqrt(200)
    with average.used():
        mean = float((part.weight.detach() - 1.0).norm()) / math.sqrt(200)
    assert mean < 0.5 * present
