"""A map as a sum of random effects: read as dense tables are, with the variance of what is not known."""

import numpy as np
import pytest
import torch

from neurad.fields.hierarchy import MIDDLE, Coefficients, Hierarchy, Places, effects_of, keyed

PARTS, CELLS = 3, 8
MESH = torch.tensor([0, 1, 1])
"""Of each part."""
OWNERS = {"room": 1, "mesh": 2, "part": PARTS}


def places(n, seed=0):
    rng = np.random.default_rng(seed)
    x, albedo = (torch.from_numpy(rng.random((n, 3))).float() for _ in range(2))
    part = torch.from_numpy(rng.integers(0, PARTS, n))
    return Places(x, albedo, part, MESH[part])


def all_coefficients(hierarchy, seed=1):
    """Coefficients of every node."""
    counts = [effect.nodes * OWNERS[effect.of] for effect in hierarchy.effects]
    keys = torch.cat([keyed(index, torch.arange(count)) for index, count in enumerate(counts)])
    values = torch.from_numpy(np.random.default_rng(seed).normal(size=(len(keys), 3))).float()
    return Coefficients(keys, values, torch.linspace(0.1, 0.2, len(counts))), counts


def hats(x, cells):
    """Trilinear weights of all nodes [n, (cells + 1)^3], the last axis fastest."""
    near = np.maximum(1.0 - np.abs(x[:, :, None] * cells - np.arange(cells + 1)), 0.0)
    return np.einsum("mi,mj,mk->mijk", *near.transpose(1, 0, 2)).reshape(len(x), -1)


def dense(hierarchy, at):
    """Rows of all coefficients, in dense matrices."""
    columns = []
    for effect in hierarchy.effects:
        read = {"position": at.x, "color": at.albedo ** (1.0 / 3.0), "nothing": at.x}[effect.reads].double().numpy()
        weight = hats(read, effect.cells) if effect.cells else np.ones((len(at), 1))
        own = np.zeros((len(at), OWNERS[effect.of], effect.nodes))
        own[np.arange(len(at)), {"room": 0, "mesh": at.mesh.numpy(), "part": at.part.numpy()}[effect.of]] = weight
        columns.append(own.reshape(len(at), -1))
    return columns


def finer(hierarchy, at):
    """Variance of what is finer than the finest grid: as much as that has."""
    if not hierarchy.effects[-1].is_detail:
        return np.zeros(len(at))
    return np.full(len(at), float(hierarchy.stds[-1]) ** 2)


@pytest.mark.parametrize("use_kernels", [True, False])
@pytest.mark.parametrize("structure", ["auto", "groups", "smooth"])
def test_it_reads_what_dense_tables_say(structure, use_kernels):
    hierarchy, at = Hierarchy(structure, CELLS), places(500)
    found, _ = all_coefficients(hierarchy)
    hierarchy.use_kernels = use_kernels
    hierarchy.set(found)
    rows = np.concatenate(dense(hierarchy, at), 1)
    expected = rows @ found.values.double().numpy()
    np.testing.assert_allclose(hierarchy(at)[:, 0].numpy(), MIDDLE + expected[:, 0], atol=2e-5)
    variance = finer(hierarchy, at) + np.square(expected[:, 1:]).mean(1)
    np.testing.assert_allclose(hierarchy.std(at)[:, 0].numpy() ** 2, variance, rtol=1e-4)


def test_what_no_photograph_tells_has_the_variance_of_the_prior():
    hierarchy, at = Hierarchy("auto", CELLS), places(200)
    found, _ = all_coefficients(hierarchy)
    hierarchy.set(Coefficients(found.keys[:1], found.values[:1], found.stds))
    parts = finer(hierarchy, at) + float(found.values[0, 1:].square().mean())
    for rows, std in list(zip(dense(hierarchy, at), found.stds.numpy(), strict=True))[1:]:
        parts += std**2 * np.square(rows).sum(1)
    np.testing.assert_allclose(hierarchy.std(at)[:, 0].numpy() ** 2, parts, rtol=1e-4)
    torch.testing.assert_close(hierarchy(at), torch.full((200, 1), MIDDLE + float(found.values[0, 0])))
    hierarchy.set(found)
    prior = parts - float(found.values[0, 1:].square().mean()) + float(found.stds[0]) ** 2
    np.testing.assert_allclose(hierarchy.std(at, known=False)[:, 0].numpy() ** 2, prior, rtol=1e-4)


def test_the_kernel_reads_as_the_reference_where_coefficients_are_missing():
    hierarchy, at = Hierarchy("auto", CELLS), places(2000)
    found, _ = all_coefficients(hierarchy)
    some = torch.from_numpy(np.random.default_rng(3).random(len(found.keys)) < 0.6)
    hierarchy.set(Coefficients(found.keys[some], found.values[some], found.stds))
    part = at.part.repeat(2)
    order = torch.argsort(part)  # neighbours share cells
    x, albedo, part = torch.cat((at.x, at.x.round()))[order], at.albedo.repeat(2, 1)[order], part[order]
    edges = Places(x, albedo, part, MESH[part])
    by_kernel = hierarchy(edges)
    hierarchy.use_kernels = False
    torch.testing.assert_close(by_kernel, hierarchy(edges), atol=1e-5, rtol=0.0)


def test_it_travels_with_a_state_of_any_size_and_can_be_made_again():
    hierarchy, at = Hierarchy("groups", CELLS), places(50)
    assert not hierarchy.done
    hierarchy.set(all_coefficients(hierarchy)[0])
    other = Hierarchy("groups", CELLS)
    other.load_state_dict(hierarchy.state_dict())
    assert other.done
    assert other.found
    torch.testing.assert_close(other(at), hierarchy(at))
    torch.testing.assert_close(other.std(at), hierarchy.std(at))
    assert not list(other.parameters())
    other.reopen()
    assert not other.done
    assert not other.found
    other.set(None)
    assert other.done
    assert not other.found


def test_grids_of_details_are_octaves():
    assert [effect.cells for effect in effects_of("smooth", 64) if effect.is_detail] == [16, 32, 64]
    assert not any(effect.is_detail for effect in effects_of("groups", 64))
