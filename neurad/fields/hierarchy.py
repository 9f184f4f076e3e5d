"""A map of surfaces as a sum of random effects: of the room, a mesh, a colour, a connected part, and a place.

A room is made of some tens of materials, most of one roughness each. So a value is the sum of what the room has in
common, what a mesh has, what surfaces of like colour have, what a connected part of a mesh has, what a colour of a part
has, and details of a place, which most parts have none of. Each effect is a trilinear grid over the unit cube of
positions or of colours, or one number; each has a variance. :mod:`neurad.evidence.random_effects` finds coefficients
and variances from photographs; here the map is read at any point, with its posterior deviation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.grid import trilinear
from neurad.fields.settings import Structure
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import GRAIN, split

COLOR_CELLS, PART_COLOR_CELLS = (4, 8, 16), 8
"""Cells along the cube of colours of what surfaces of like colour share, and those of one part."""
DETAILS = (4, 2, 1)
"""Cells of the finest grid along one of each grid of details."""
_INDEX = 1 << 56  # keys of one effect lie before those of the next one
MIDDLE = 0.5
"""What is expected where nothing is known."""
CHUNK = 1 << 16
"""Points that are read at once."""


@dataclass(frozen=True)
class Places:
    """Points on surfaces."""

    x: Tensor
    """In the unit cube of the fields [n, 3]."""
    albedo: Tensor
    """[n, 3]."""
    part: Tensor
    """Connected part of a mesh [n], see :class:`neurad.scene.parts.SurfaceParts`."""
    mesh: Tensor
    """That mesh [n]."""

    def __len__(self) -> int:
        return len(self.x)

    def chunks(self) -> Iterator[Places]:
        """A few points at a time, to bound the memory."""
        for begin in range(0, max(len(self), 1), CHUNK):
            part = slice(begin, begin + CHUNK)
            yield Places(self.x[part], self.albedo[part], self.part[part], self.mesh[part])


@dataclass(frozen=True)
class Effect:
    """One of the terms."""

    reads: Literal["position", "color", "nothing"]
    cells: int = 0
    """Along an edge of the cube of what it reads."""
    of: Literal["room", "mesh", "part"] = "room"
    """Whether the room has them in common, or each mesh or part has its own."""

    @property
    def nodes(self) -> int:
        """Coefficients of the room, or of a mesh or part."""
        return (self.cells + 1) ** 3

    @property
    def is_detail(self) -> bool:
        """Whether it says how a part varies from place to place."""
        return self.reads == "position"

    def rows(self, places: Places) -> tuple[Tensor, Tensor]:
        """Numbers of the coefficients that points read, and their weights [n, 1 or 8]."""
        if self.reads == "nothing":
            node, weight = torch.zeros_like(places.part)[:, None], torch.ones_like(places.x[:, :1])
        else:
            node, weight = trilinear(places.x if self.is_detail else _spread(places.albedo), self.cells)
        if self.of == "room":
            return node, weight
        owner = places.part if self.of == "part" else places.mesh
        return node + self.nodes * owner[:, None], weight


def _spread(albedo: Tensor) -> Tensor:
    """Colours about as far apart as they look: cube roots of the albedo."""
    return albedo.clamp(0.0, 1.0).pow(1.0 / 3.0)


def effects_of(structure: Structure, cells: int) -> tuple[Effect, ...]:
    """The terms of a map of which the finest grid of details has so many cells along the unit cube."""
    room = Effect("nothing")
    colors = [Effect("color", n) for n in COLOR_CELLS]
    parts = [Effect("nothing", of="part"), Effect("color", PART_COLOR_CELLS, "part")]
    groups = [Effect("nothing", of="mesh"), *colors, *parts]
    details = [Effect("position", cells // coarser, "part") for coarser in DETAILS]
    terms = {"auto": [room, *groups, *details], "groups": [room, *groups], "smooth": [room, *details], "free": []}
    return tuple(terms[structure])


@dataclass(frozen=True)
class Coefficients:
    """What was found of the effects of a map."""

    keys: Tensor
    """Numbers of the coefficients, ascending [k], int64."""
    values: Tensor
    """Their posterior mean, then deviations of posterior samples from it [k, 1 + samples]."""
    stds: Tensor
    """Standard deviations of the effects before anything is known [effects]."""


def keyed(index: int, key: Tensor) -> Tensor:
    """Numbers of an effect's coefficients among those of all."""
    return key + index * _INDEX


class Hierarchy(nn.Module):
    """Values [n] at places; no optimizer has its coefficients.

    Args:
        cells: of the finest grid of details along the unit cube.
    """

    use_kernels = True
    made: Tensor
    keys: Tensor
    values: Tensor
    stds: Tensor

    def __init__(self, structure: Structure, cells: int) -> None:
        super().__init__()
        self.effects, self.cells = effects_of(structure, cells), cells
        self.register_buffer("made", torch.zeros((), dtype=torch.int64))
        self.register_buffer("keys", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("values", torch.zeros(0, 1))
        self.register_buffer("stds", torch.zeros(len(self.effects)))
        self._ends: list[int] = [0] * (len(self.effects) + 1)
        self.done = self.found = False
        """Whether the step that finds it was made, and whether it found something."""
        self.register_load_state_dict_post_hook(lambda module, _: module._refresh())  # type: ignore[no-untyped-call]

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        for name in ("keys", "values"):  # as many as were found
            if (given := state.get(prefix + name)) is not None:
                setattr(self, name, torch.empty_like(given, device=self.made.device))
        super()._load_from_state_dict(state, prefix, *rest)

    @torch.no_grad()
    def set(self, found: Coefficients | None) -> None:
        """The step was made, and found these coefficients; None for none."""
        device = self.made.device
        if found is not None:
            self.keys, self.values = found.keys.to(device), found.values.to(device)
            self.stds.copy_(found.stds)
        else:
            self.keys, self.values = self.keys[:0], self.values[:0, :1]
        self.made.fill_(1)
        self._refresh()

    @torch.no_grad()
    def reopen(self) -> None:
        """The step is to be made again, by what gradients say until then."""
        self.set(None)
        self.made.zero_()
        self._refresh()

    def _refresh(self) -> None:
        self.done, self.found = bool(self.made), len(self.keys) > 0
        first = _INDEX * torch.arange(len(self.effects) + 1)
        self._ends = torch.searchsorted(self.keys.cpu(), first).tolist()

    def forward(self, places: Places) -> Tensor:
        """Posterior means [n, 1]."""
        if use_kernel(self.use_kernels, places.x, places.albedo, self.values):
            return self._mean_kernel(places)[:, None]
        return torch.cat([self._mean(part) for part in places.chunks()])[:, None]

    def std(self, places: Places, known: bool = True) -> Tensor:
        """Posterior standard deviations [n, 1], those of coefficients that no photograph tells of included; those of
        the prior where photographs are not ``known``.
        """
        return torch.cat([self._variance(part, known) for part in places.chunks()]).sqrt()[:, None]

    def _mean(self, places: Places) -> Tensor:
        total = torch.full_like(places.x[:, 0], MIDDLE)
        for at, weight, found in self._read(places):
            total += (torch.where(found, weight, 0.0) * self.values[at, 0]).sum(-1)
        return total

    def _mean_kernel(self, places: Places) -> Tensor:
        from neurad.fields import hierarchy_kernels as kernels  # imported at first use: numba is slow to load

        reads = [("nothing", "position", "color").index(effect.reads) for effect in self.effects]
        ends = zip(self._ends[:-1], self._ends[1:], strict=True)
        effects = np.array([
            [read, effect.cells, ("room", "part", "mesh").index(effect.of), *end]
            for read, effect, end in zip(reads, self.effects, ends, strict=True)
        ])  # fmt: skip
        total = torch.full_like(places.x[:, 0], MIDDLE)
        x, color, out = (t.contiguous().numpy() for t in (places.x, _spread(places.albedo), total))
        part, mesh = places.part.contiguous().numpy(), places.mesh.contiguous().numpy()
        keys, values = self.keys.numpy(), self.values[:, 0].contiguous().numpy()

        def work(low: int, high: int) -> None:
            lanes, node = slice(low, high), np.empty(8, np.int64)
            kernels.means(
                x[lanes], color[lanes], part[lanes], mesh[lanes], effects, _INDEX, keys, values, node, out[lanes]
            )

        split(work, len(out), GRAIN)
        return total

    def _variance(self, places: Places, known: bool) -> Tensor:
        last = len(self.effects) - 1
        finest = self.stds[last] if self.effects[last].is_detail else self.stds.new_zeros(())
        variance = places.x.new_zeros(len(places)) + finest.square()  # what is finer still varies as much
        deviation = places.x.new_zeros(len(places), self.values.shape[1] - 1)
        for (at, weight, stored), std in zip(self._read(places), self.stds, strict=True):
            found = stored & known
            deviation = deviation + (torch.where(found, weight, 0.0)[..., None] * self.values[at, 1:]).sum(1)  # [n, s]
            variance = variance + std.square() * torch.where(found, 0.0, weight.square()).sum(-1)
        total: Tensor = variance + deviation.square().mean(-1)
        return total

    def _read(self, places: Places) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Indices of the coefficients of each effect, their weights, and whether they are there [n, 1 or 8]."""
        for index, effect in enumerate(self.effects):
            key, weight = effect.rows(places)
            key = keyed(index, key)
            begin, end = self._ends[index : index + 2]
            at = (begin + torch.searchsorted(self.keys[begin:end], key)).clamp(max=len(self.keys) - 1)
            yield at, weight, self.keys[at] == key
