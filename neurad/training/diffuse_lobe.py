"""Which diffuse lobe recovered surfaces have: Burley's, as in Mitsuba, or Lambert's under a coat, as in Cycles.

A rough surface of the one is bright at grazing angles, of the other it is not, and a fit that has the wrong one bends
roughness and albedo until they explain the difference. All pixels of a room tell of it. So in the first part of a fit
the lobe is a mixture of both, whose parts are found by gradient descent together with roughness and albedo; then the
larger part is taken.
"""

from __future__ import annotations

import torch

from neurad.assembly.build import Assembly, FittedMaterials
from neurad.core.reflection import PrincipledModel

DECIDED, DECIDED_AGAIN = 0.4, 0.75
"""Fraction of a fit after which one of the two is taken, and after which that is done again where metals were found:
metals that are taken for dielectrics have no diffuse lobe of either kind.
"""


@torch.no_grad()
def keep_in_range(materials: FittedMaterials) -> None:
    """Keep the part of Lambert's lobe between none and all."""
    assert materials.lambert is not None
    materials.lambert.clamp_(0.0, 1.0)


@torch.no_grad()
def look_again(assembly: Assembly) -> None:
    """Forget what was found, and look from where the fit began to."""
    materials, model = assembly.materials, assembly.scene.features.fitted_model
    if isinstance(materials, FittedMaterials) and materials.lambert is not None and isinstance(model, PrincipledModel):
        begin = float(model.diffuse == "lambert")
        materials.lambert.fill_(begin)
        materials.keep_lobe(False)
        assembly.world.set_lambert(begin)


@torch.no_grad()
def decide(assembly: Assembly) -> str | None:
    """Take the larger part, for good; a sentence if that is Lambert's."""
    materials = assembly.materials
    assert isinstance(materials, FittedMaterials)
    assert materials.lambert is not None
    part = float(materials.lambert)
    assembly.world.set_lambert(float(part > 0.5))
    materials.keep_lobe()
    if part <= 0.5:
        return None
    return "by the photographs, what lies under the surfaces' coat is Lambertian, as in Cycles and glTF"
