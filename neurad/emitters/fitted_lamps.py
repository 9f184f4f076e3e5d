"""Lamps whose radiance is not known and gets recovered from photographs."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.colour import luminance
from neurad.core.records import Float64Array
from neurad.emitters.area import AreaLights
from neurad.scene.geometry import Geometry

PER_LAMP = ("values", "sampled", "photographed", "reflected", "counts", "scale_seen")
"""What of the state has a row for each lamp."""
MIN_CHANNEL = 1e-4
"""Smallest radiance of a channel in units of the lamp's brightest: what is positive has a logarithm."""
UNIFORM_FRACTION = 0.1
"""Fraction of the samples that all lamps share alike, whatever their present power: one that seems dark may not have
been fitted yet."""


class FittedLamps(AreaLights):
    """Area lights with the radiance ``exp(values)`` of each lamp, a mesh: positive, and equally quick for dim and for
    bright lamps.

    ``emission``, which kernels read, always has the present radiance; gradients flow through :meth:`radiance_of`. The
    choice of triangles is that of the last :meth:`refresh`, and no gradient flows into it. What photographs say of
    each lamp is kept beside it, and is part of the state as well: a continued run is the same as one never stopped.

    Args:
        meshes: index of each lamp's mesh, ascending.
        radiance: of each lamp to begin with [m, 3].
        train: whether an optimizer moves the radiance.

    Raises:
        InputError: no lamp has an area.
    """

    values: nn.Parameter
    """Logarithm of each lamp's radiance [m, 3]."""
    sampled: Tensor
    photographed: Tensor
    """Radiance that photographs show of each lamp, with what it reflects [m, 3]; 0 where no photograph says."""
    reflected: Tensor
    """What each lamp reflects towards the cameras of all light [m, 3]."""
    counts: Tensor
    """Pixels that show nothing but the lamp, views that these are of, and how many of them do not count, because they
    or half of the lamp in their view are clipped [m, 3]."""
    scale_seen: Tensor
    """Whether some photograph fixes the scale of the lamp's radiance, directly or by light that meets its own [m]."""
    begun: Tensor
    """Whether the photographs have been asked."""
    balanced: Tensor
    """How often the albedo has been asked what it says of the lamps."""
    mesh: Tensor
    """Index of each lamp's mesh [m]."""
    lamp: Tensor
    lit: Tensor
    area: Tensor
    fraction: Tensor

    def __init__(self, geometry: Geometry, meshes: Sequence[int], radiance: Float64Array, train: bool = True) -> None:
        mesh = torch.tensor(list(meshes), dtype=torch.int64, device=geometry.vertices.device)
        of_mesh = mesh.new_full((max(int(geometry.mesh_index.max()), *meshes) + 1,), -1)
        of_mesh[mesh] = torch.arange(len(mesh), device=mesh.device)
        lamp = of_mesh[geometry.mesh_index]  # lamp of each triangle, -1 without one [F]
        lit = (lamp >= 0).nonzero().squeeze(-1)
        values = logarithm(torch.from_numpy(np.asarray(radiance, np.float64)).to(mesh.device))
        emission = torch.zeros_like(geometry.emission)
        emission[lit] = values.exp()[lamp[lit]]
        super().__init__(geometry, emission)
        self.values = nn.Parameter(values, requires_grad=train)
        for name in ("sampled", "photographed", "reflected"):
            self.register_buffer(name, torch.zeros_like(values))
        self.register_buffer("counts", mesh.new_zeros(len(mesh), 3))
        self.register_buffer("scale_seen", mesh.new_zeros(len(mesh), dtype=torch.bool))
        self.register_buffer("begun", mesh.new_zeros((), dtype=torch.bool))
        self.register_buffer("balanced", mesh.new_zeros(()))
        face_area = geometry.face_area.double()
        area = torch.zeros(len(mesh), dtype=torch.float64, device=mesh.device).index_add_(0, lamp[lit], face_area[lit])
        fraction = face_area[self.face] / area[lamp[self.face]]  # of its lamp's area, for each emitting triangle [k]
        for name, value in {"mesh": mesh, "lamp": lamp, "lit": lit, "area": area, "fraction": fraction}.items():
            self.register_buffer(name, value, persistent=False)
        self.register_load_state_dict_post_hook(lambda module, _: module.loaded())  # type: ignore[no-untyped-call]
        self.refresh()

    @property
    def trains(self) -> bool:
        """Whether the derivative by the radiance is wanted now."""
        return self.values.requires_grad and torch.is_grad_enabled()

    @property
    def radiance(self) -> Tensor:
        """Radiance of each lamp [m, 3], with the gradient of ``values``."""
        return self.values.exp()

    def found(self) -> Float64Array:
        """Radiance of each lamp [m, 3], without gradient."""
        return self.values.detach().double().exp().cpu().numpy()

    @property
    def unclipped(self) -> Tensor:
        """Pixels that show nothing but the lamp and say how bright it is [m]."""
        return self.counts[:, 0] - self.counts[:, 2]

    def radiance_of(self, face: Tensor) -> Tensor:
        """Radiance [n, 3] that leaves triangles [n], with the gradient of ``values`` while that is wanted."""
        if not self.trains:
            return super().radiance_of(face)
        table = torch.cat((self.values.new_zeros(1, 3), self.radiance))  # zeros first: no lamp is -1
        return table.index_select(0, self.lamp.index_select(0, face) + 1)

    @torch.no_grad()
    def set_radiance(self, radiance: Float64Array) -> None:
        """Take the radiance [m, 3] as the present one, and sample by it."""
        self.values.copy_(logarithm(torch.from_numpy(np.asarray(radiance, np.float64)).to(self.values.device)))
        self.update()
        self.refresh()

    @torch.no_grad()
    def update(self) -> None:
        """Let ``emission`` have the present radiance: after every step of ``values``."""
        self.emission[self.lit] = self.radiance.index_select(0, self.lamp.index_select(0, self.lit))

    def loaded(self) -> None:
        """After a checkpoint was loaded radiance and tables belong to it."""
        self.update()
        self.tabulate()

    @torch.no_grad()
    def refresh(self) -> None:
        """Sample by the present radiance from now on."""
        self.sampled.copy_(self.radiance)
        self.tabulate()

    @torch.no_grad()
    def tabulate(self) -> None:
        """Rebuild the choice of triangles from the radiance of the last refresh."""
        light = luminance(self.sampled.double()) * self.area  # [m]
        self.power = math.pi * float(light.sum())
        uniform = (self.area > 0) / (self.area > 0).sum()
        chance = (1.0 - UNIFORM_FRACTION) * light / light.sum() + UNIFORM_FRACTION * uniform
        density = (chance / self.area.clamp_min(1e-300)).float()  # of a point on the lamp, 1 / area
        self.pdf_area.zero_()
        self.pdf_area[self.face] = density[self.lamp[self.face]]
        of_face = chance[self.lamp[self.face]] * self.fraction
        self.cdf.copy_((of_face / of_face.sum()).cumsum(0)[:-1])


def logarithm(radiance: Tensor) -> Tensor:
    """Logarithms (float32) of radiance [m, 3] (float64); a channel that is black counts as :data:`MIN_CHANNEL`."""
    least = (MIN_CHANNEL * radiance.amax(-1, keepdim=True)).clamp_min(float(np.finfo(np.float32).tiny))
    return torch.maximum(radiance, least).log().float()
